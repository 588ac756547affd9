"""The examples in the docstrings of the public names run as they stand."""

import doctest
import functools
import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from dataset_fakes import processes_make_fakes
from predictor_links import QUIET
from public_names import EVERY
from rosbag_files import write_drive

import sionna_partial as sp
from sionna_partial.placement import placement, several

pytestmark = [QUIET, pytest.mark.usefixtures("short_search")]

CHAINS = (
    ("lab.build_dataset", "lab.read_dataset", "lab.train", "lab.evaluate"),
    ("save_coverage", "load_coverage", "plots.plot_coverage"),
    ("channels.save_channels", "channels.load_channels"),
)
"""Names whose examples read the files that the first of them wrote."""

ALONE = tuple((name,) for name in EVERY if name not in sum(CHAINS, ()))


SEARCHES = ("calibrate_materials", "place_transmitter", "place_transmitters", "trace_links")
"""Names that several examples call with equal arguments, and that take time."""

FEW = ((placement, "RECEIVERS", 40), (several, "RECEIVERS", 40), (several, "CANDIDATES", 8), (several, "DRAWS", 20))
"""Numbers that placements compare: the examples print nothing that depends on them."""


@pytest.fixture(scope="module", autouse=True)
def searched_once() -> Iterator[None]:
    results: dict[bytes, Any] = {}

    def once(search: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(search)
        def call(*arguments: Any, **options: Any) -> Any:
            fresh = [replace(each) if isinstance(each, sp.PartialMap) else each for each in arguments]
            key = pickle.dumps((search.__name__, fresh, options))  # of maps without what earlier calls have cached
            if key not in results:
                results[key] = search(*arguments, **options)
            return results[key]

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in SEARCHES:
            patch.setattr(sp, name, once(getattr(sp, name)))
        for module, name, value in FEW:
            patch.setattr(module, name, value)
        yield


@pytest.mark.parametrize("names", [*CHAINS, *ALONE], ids=lambda names: names[0])
def test_examples(names: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(processes_make_fakes(tmp_path))
    write_drive(tmp_path / "drive.bag")
    finder, report = doctest.DocTestFinder(exclude_empty=True), list[str]()
    for name in names:
        found = finder.find(EVERY[name], name, globs={})
        assert any(each.examples for each in found), f"{name} has no example"
        for example in found:
            runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
            runner.run(example, out=report.append)
            assert runner.summarize(verbose=False).failed == 0, "".join(report)
