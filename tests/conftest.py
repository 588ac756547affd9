"""What all tests share: every run draws the same examples, and a command line leaves its process as it was."""

import logging
import signal
import warnings
from collections.abc import Iterator

import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("repeatable")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell has started the tests in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def command_line(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Undo what the command line does to its process."""
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "put back in the end")
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    logger = logging.getLogger("sionna_partial")
    handlers = list(logger.handlers)
    yield
    logger.handlers[:] = handlers
