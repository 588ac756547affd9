"""How results are shown: every public class in one line, and some with a picture."""

import base64
import io
import re
import threading
from contextlib import AbstractContextManager, nullcontext, redirect_stderr
from typing import Any

import numpy as np
import pytest
import xarray as xr
from coverage_cases import PICTURE, TX, map_of, shipped
from PIL import Image
from public_names import EVERY

import sionna_partial as sp
from sionna_partial import display, process
from sionna_partial.apps.live.incoming import LiveSettings
from sionna_partial.display import LONGEST, THUMBNAIL_PX, counting, reporting
from sionna_partial.errors import SettingsError
from sionna_partial.process import njit
from sionna_partial.settings import PlacementSettings

LINKS = sp.LinkFeatures(np.ones(50), np.zeros(50), np.full(50, 3.0), np.full(50, -71.0))
PARTIAL = map_of(PICTURE)
EXPLORATION = sp.explore_trajectory(PARTIAL, (0, 4), 0)
SETTINGS = (
    *(sp.SceneSettings, sp.TraceSettings, sp.SensorSettings, sp.lab.DatasetSettings, sp.Material),
    *(sp.lab.PredictorSettings, PlacementSettings, LiveSettings, sp.Antenna),
)


@pytest.mark.parametrize(
    ("value", "start"),
    [
        (PARTIAL, "PartialMap(state=uint8 (8, 12), resolution_m=0.5, origin_m=(-1, 2), "),
        (EXPLORATION, "Exploration(home=PartialMap(...), sensor=SensorSettings(...), steps=(0, 4), states=uint8 ("),
        (LINKS, "LinkFeatures(link_state=uint8 (50,), unobserved_distance_m=float64 (50,), "),
        (shipped(), "Predictor(settings=PredictorSettings(...), homes=tuple of "),
        *((kind(), f"{kind.__name__}(") for kind in SETTINGS),
    ],
    ids=lambda value: type(value).__name__,
)
def test_one_line(value: Any, start: str) -> None:
    line = repr(value)
    assert line.startswith(start)
    assert "\n" not in line
    assert len(line) <= (1000 if isinstance(value, SETTINGS) else LONGEST)  # settings can be pasted


def test_every_public_class_is_shown_in_one_line() -> None:
    classes = {public for public in EVERY.values() if isinstance(public, type)}
    own = {public for public in classes if getattr(public.__repr__, "__module__", "").endswith(".display")}
    others = {"CellState", "LinkState", "SionnaPartialError"}
    others |= {"Simulation", "LinkModel", "DifferentiableScene", "LiveCoverage"}
    assert {public.__name__ for public in classes - own - {*SETTINGS}} == others


def picture(html: str) -> Image.Image:
    (png,) = re.findall(r'<img src="data:image/png;base64,([^"]+)">', html)
    return Image.open(io.BytesIO(base64.b64decode(png)))


@pytest.mark.parametrize("value", [PARTIAL, EXPLORATION], ids=lambda value: type(value).__name__)
def test_picture(value: Any) -> None:
    html = value._repr_html_()
    assert f"<code>{type(value).__name__}(" in html
    assert THUMBNAIL_PX / 2 < picture(html).width <= THUMBNAIL_PX


def test_coverage(coverage: xr.Dataset) -> None:
    line = "<coverage: 24 x 16 receivers, 0.25 m apart, transmitter at (0.60, 3.60, 1.50) m, 28 GHz>"
    assert repr(coverage.radio) == line
    assert picture(coverage.radio._repr_html_()).width <= THUMBNAIL_PX


class TestPlotMap:
    def test_positions_beyond_the_map_are_drawn(self) -> None:
        figure = sp.plots.plot_map(PARTIAL, tx=TX, rx=[(20.0, 3.0, 1.5), (1.0, 3.0, 1.5)])
        (axis,) = figure.axes
        assert axis.get_xlim()[0] < -1.0
        assert axis.get_xlim()[1] > 20.0
        texts = [text.get_text() for text in figure.legends[0].get_texts()]
        assert texts == ["transmitter", "receiver", "wall", "not observed"]

    def test_row_0_is_at_the_bottom(self) -> None:
        figure = sp.plots.plot_map(sp.PartialMap([[0, 1], [0, 0]], 1.0))
        walls = figure.axes[0].get_images()[1]
        assert walls.origin == "lower"
        assert walls.get_extent() == [0.0, 2.0, 0.0, 2.0]
        assert walls.get_array()[0, 1, 3] == 255

    def test_other_values_are_refused(self) -> None:
        with pytest.raises(sp.SionnaPartialError, match=r"tx has shape \(1,\): give x and y"):
            sp.plots.plot_map(PARTIAL, tx=[1.0])
        with pytest.raises(sp.SionnaPartialError, match="tx has values that are not finite"):
            sp.plots.plot_map(PARTIAL, tx=(np.nan, 1.0))
        with pytest.raises(sp.SionnaPartialError, match="partial is of type str: give a PartialMap"):
            sp.plots.plot_map("map.yaml")  # type: ignore[arg-type]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WAIT_S", "COMMAND_WAIT_S", "LINE_S"):
        monkeypatch.setattr(display, name, 0.0)


def test_a_callable_is_called() -> None:
    calls: list[Any] = []
    with reporting(lambda *call: calls.append(call)) as report:
        report(0.5, "half")
    with counting(lambda *call: calls.append(call), "homes") as count:
        count(1, 2, "one")
    assert calls == [(0.5, "half"), (1, 2, "one")]
    with pytest.raises(SettingsError, match=r"progress = 1 is not allowed: give True, False or a callable"):
        reporting(1).__enter__()  # type: ignore[arg-type]


@pytest.mark.usefixtures("at_once")
def test_compilations_are_reported_where_work_stands() -> None:
    """To the first receiver alone: it knows the whole work; without a terminal at once, in a command."""
    calls: list[Any] = []
    with reporting(lambda *call: calls.append(call)) as report:
        report(0.5, "half")
        with reporting(report) as part:
            part(0.7, "a part")
            assert njit()(lambda number: number + 1)(2.0) == 3.0
    assert calls[:2] == [(0.5, "half"), (0.7, "a part")]
    assert [fraction for fraction, _ in calls[2:]] == [0.7]
    assert re.fullmatch(r"compiling, once: kernel \d+ of 90 to 150", calls[2][1])
    with redirect_stderr(Terminal()) as terminal, reporting(None):
        assert njit()(lambda number: number + 2)(2.0) == 4.0
    assert re.search("  0%.*compiling, once: kernel", terminal.getvalue())


def test_compilations_without_a_bar_are_announced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """In calls without a terminal, and in `LinkModel.predict` and others without a bar."""

    def printed(reports: AbstractContextManager[Any]) -> str:
        monkeypatch.setattr(process, "_announced", threading.Event())
        with redirect_stderr(io.StringIO()) as log, reports:
            assert njit()(lambda number: number + 3)(2.0) == 5.0
            assert njit()(lambda number: number + 4)(2.0) == 6.0
        return log.getvalue()

    assert printed(nullcontext()) == printed(reporting(None)) == f"{process.COMPILING_ONCE}\n"
    assert printed(reporting(False)) == printed(reporting(lambda *_: None)) == ""


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("progress", [None, True])
def test_a_bar_in_a_terminal(progress: bool | None) -> None:
    with redirect_stderr(Terminal()) as terminal, reporting(progress) as report:
        report(0.5, "half [of it]")
    assert "100%|" in terminal.getvalue()
    assert "half [of it]" in terminal.getvalue()
    with redirect_stderr(Terminal()) as terminal, counting(None, "homes") as count:
        count(2, 4, "starting")
        count(4, 4, "the end")
    assert "2 of 4 homes" in terminal.getvalue()
    assert "the end" in terminal.getvalue().rpartition("4 of 4 homes")[2]


@pytest.mark.parametrize(
    ("wait_s", "shown", "terminal"), [(0.0, False, Terminal()), (0.0, None, io.StringIO()), (2.0, None, Terminal())]
)
def test_false_a_call_without_a_terminal_and_short_work_are_silent(
    wait_s: float, shown: bool | None, terminal: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(display, "WAIT_S", wait_s)
    with redirect_stderr(terminal), reporting(shown) as report, counting(shown, "homes") as count:
        report(0.5, "half")
        count(1, 2, "one")
    assert terminal.getvalue() == ""


@pytest.mark.usefixtures("at_once")
def test_a_command_reports_without_a_terminal() -> None:
    with redirect_stderr(io.StringIO()) as log, reporting(None, command=True) as report:
        report(1.0, "the end")
    assert log.getvalue().rstrip().endswith("the end")


@pytest.mark.usefixtures("at_once")
def test_a_bar_vanishes_before_an_error() -> None:
    def fail_half_way() -> None:
        with reporting(None, command=True) as report:
            report(0.5, "half")
            raise ValueError("stop")

    with redirect_stderr(Terminal()) as terminal, pytest.raises(ValueError, match="stop"):
        fail_half_way()
    assert terminal.getvalue().endswith(" \r")
