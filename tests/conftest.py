"""What all tests share: runs that draw the same examples, the process as it was, and a coverage map of a small home."""

import logging
import signal
from collections.abc import Iterator

import pytest
import xarray as xr
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("repeatable")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell has started the tests in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def command_line(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Undo what the command line does to its process; pytest itself puts `warnings.showwarning` back."""
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "put back in the end")
    logger = logging.getLogger("sionna_partial")
    handlers = list(logger.handlers)
    yield
    logger.handlers[:] = handlers


@pytest.fixture
def coverage() -> xr.Dataset:
    """A coverage map of one transmitter, which a test may change."""
    from coverage_cases import small_coverage

    return small_coverage()


@pytest.fixture
def several() -> xr.Dataset:
    """A coverage map of two transmitters, which a test may change."""
    from coverage_cases import small_coverage

    return small_coverage(several=True)
