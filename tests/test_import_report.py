"""The report of an import: rooms and doors of known plans, what it prints, and what is not plausible."""

import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.maps.environment import ImportNotes, MapWarning
from sionna_partial.maps.import_report import rooms_of
from sionna_partial.maps.partial_map import PartialMap


def flat(cell_m: float = 0.05, scale: float = 1.0) -> PartialMap:
    """Three rooms of 4 x 5 m beside each other, with doors of 0.9 and 1.2 m, and unknown cells around."""
    state = np.full((108, 250), CellState.UNKNOWN, dtype=np.uint8)
    state[2:106, 2:248] = CellState.WALL
    for left in (4, 86, 168):
        state[4:104, left : left + 80] = CellState.FREE
    state[20:38, 84:86] = state[60:84, 166:168] = CellState.FREE
    return PartialMap(state, cell_m * scale)


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_rooms_at_any_scale(scale: float) -> None:
    partial = flat(scale=scale)
    rooms = rooms_of(partial.state == CellState.FREE, partial.resolution_m)
    assert rooms.number == 3
    np.testing.assert_allclose(rooms.openings_m / scale, [0.9, 1.2], atol=0.06)


def test_rooms_of_a_large_plan() -> None:
    """Plans of many cells are coarsened; corners of rooms and columns are no rooms."""
    free = np.repeat(np.repeat(flat().state == CellState.FREE, 10, axis=0), 10, axis=1)
    free[200:210, 200:210] = False
    assert rooms_of(free, 0.005).number == 3
    assert rooms_of(np.zeros((3, 3), dtype=bool), 0.05).number == 0


def test_report_of_a_file(tmp_path: Path) -> None:
    assert flat().import_report is None
    sp.save_map(flat(), tmp_path / "map.yaml")
    partial = sp.load_map(tmp_path / "map.yaml")
    report = partial.import_report
    assert report is not None
    assert report.file == str(tmp_path / "map.yaml")
    assert partial == flat()
    assert pickle.loads(pickle.dumps(partial)).import_report == report
    assert "import_source" not in repr(partial)


def test_text() -> None:
    notes = ImportNotes("model.ifc", 0.001, "IfcSIUnit", notes=["cut at 1.2 m"])
    notes.use("IfcWall", 3)
    notes.use("IfcWall", 1)
    notes.skip("IfcLamp", 2, "no wall")
    notes.skip("IfcDoor", 0, "open")
    assert str(notes.attached_to(flat()).import_report).splitlines() == [
        "file       model.ifc",
        "unit       0.001 m (IfcSIUnit)",
        "extent     12.3 x 5.2 m",
        "rooms      3",
        "free area  60.21 m2",
        "doors      2: 0.85 to 1.15 m (median 1.00 m)",
        "used       IfcWall: 4",
        "skipped    IfcLamp: 2 (no wall)",
        "notes      cut at 1.2 m",
    ]
    for number in range(100):
        notes.use(f"part {number:03}")
    assert "           and 71 more\n" in str(notes.attached_to(flat()).import_report)


@pytest.mark.parametrize(
    ("partial", "message"),
    [
        (flat(scale=0.1), r"spans 1\.23 x 0\.52 m, with a unit of 1 m \(format\): give unit_m"),
        (flat(scale=30), r"spans 369 x 156 m"),
        (flat(scale=0.3), r"has doors of 0\.2\d to 0\.3\d m"),
        (flat(scale=5), r"has doors of 4\.25 to 5\.75 m"),
        (
            replace(flat(), state=np.where(np.arange(250) > 10, 1, 0) * np.ones((108, 1), int)),
            r"encloses 2.97 m2 in an",
        ),
    ],
)
def test_not_plausible(partial: PartialMap, message: str) -> None:
    with pytest.warns(MapWarning) as caught:
        result = ImportNotes("x.stl").attached_to(partial, size="give unit_m", doors="give unit_m", area="give layers")
    texts = [str(warning.message) for warning in caught]
    assert [text for text in texts if re.search(rf"path = 'x\.stl' .*{message}", text)]
    assert caught[0].message.report is result.import_report  # type: ignore[union-attr]
    assert ImportNotes("x.stl").attached_to(partial).import_report == result.import_report
    ImportNotes("x.stl").attached_to(flat(), size="a", doors="b", area="c")
