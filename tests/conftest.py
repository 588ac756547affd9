"""What several tests share: the same examples in every run, a process as it was, a full disk, and coverage maps."""

import gc
import logging
import os
import signal
import stat
from collections.abc import Callable, Iterator
from dataclasses import fields

import pytest
import xarray as xr
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("repeatable")

gc.set_threshold(20_000, 20, 20)  # each collection visits all that TensorFlow and Sionna RT have loaded

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell has started the tests in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)

SLOWEST_FIRST = (
    *("readme", "wheel", "app", "differentiable", "path_set", "calibration", "docstrings", "llvm", "against_stock"),
    *("hostile", "dataset", "app_surveys", "map_networks", "localisation", "train", "channels", "homes", "crossings"),
    *("predictor_files", "predictor", "assimilation", "unseen_walls", "link_model", "trace", "antennas", "cli"),
    *("shipped_predictor", "home_links", "paper_networks", "channel_samples", "export", "evaluate", "finder"),
    *("coincident", "learning_commands", "notebook", "engine"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the slowest files: the last file of a process would leave the other process idle."""
    order = {f"test_{name}": place for place, name in enumerate(SLOWEST_FIRST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


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
    from coverage_cases import small_coverage

    return small_coverage()


@pytest.fixture
def several() -> xr.Dataset:
    from coverage_cases import small_coverage

    return small_coverage(several=True)


@pytest.fixture(scope="module")
def short_search() -> Iterator[None]:
    """Let a calibration search few cells of the plane of a material, which takes little time."""
    from short_searches import short_searches

    with short_searches():
        yield


@pytest.fixture
def few_paths() -> Iterator[None]:
    """Trace paths of few interactions where no settings are given, which takes little time."""
    from sionna_partial.link_model import _LEAST_DEPTH
    from sionna_partial.settings import TraceSettings

    defaults = tuple(_LEAST_DEPTH if each.name == "max_depth" else each.default for each in fields(TraceSettings))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TraceSettings.__init__, "__defaults__", defaults)
        yield


@pytest.fixture
def files_that_fit(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let so many files fit on the disk from now on."""

    def limit(files: int) -> None:
        def sync(descriptor: int) -> None:
            nonlocal files
            files -= stat.S_ISREG(os.fstat(descriptor).st_mode)
            if files < 0:
                raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", sync)

    return limit
