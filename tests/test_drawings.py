"""DXF floor plans as maps: what ezdxf writes, layers, units, and what walls enclose."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import pytest
from ezdxf.document import Drawing

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps import drawing_lines
from sionna_partial.maps.drawings import map_from_drawing
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import MapWarning, PartialMap
from sionna_partial.resources import scenes_folder

FREE, WALL, UNKNOWN = (int(state) for state in CellState)


CORNERS = [(0, 0), (5000, 0), (5000, 4000), (0, 4000)]
"""A room of 5 x 4 m in millimetres, or 50 x 40 m in centimetres."""


def drawing(units: int = 6, unit_m: float = 1.0, layer: str = "A-WALL") -> Drawing:
    """Two rooms of 4 x 5 m with walls of 0.2 m drawn by their faces, a door, an entrance, a window and furniture."""
    doc = ezdxf.new(units=units)
    for name in (layer, "A-GLAZ", "A-DOOR", "A-FURN", "A-WALL-HEAD"):
        doc.layers.add(name)
    space, scale = doc.modelspace(), 1.0 / unit_m

    def wall(x0: float, y0: float, x1: float, y1: float) -> None:
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) * scale
        space.add_lwpolyline(corners.tolist(), close=True, dxfattribs={"layer": layer})

    for rectangle in ((0, 0, 1, 0.2), (2, 0, 8.2, 0.2), (0, 5, 8.2, 5.2), (0, 0, 0.2, 5.2), (8, 0, 8.2, 1)):
        wall(*rectangle)
    wall(8, 3, 8.2, 5)
    wall(4, 0.2, 4.2, 2)
    wall(4, 3, 4.2, 5)
    window = doc.blocks.new("WINDOW")
    for x in (0.0, 0.2):
        window.add_line((x * scale, 0), (x * scale, 2 * scale))  # on layer 0: takes that of the block
    space.add_blockref("WINDOW", (8 * scale, scale), dxfattribs={"layer": "A-GLAZ"})
    space.add_line((scale, 0.1 * scale), (2 * scale, 0.1 * scale), dxfattribs={"layer": "A-WALL-HEAD"})
    space.add_arc((4.1 * scale, 2 * scale), scale, 0, 90, dxfattribs={"layer": "A-DOOR"})
    space.add_circle((2 * scale, 3 * scale), 0.6 * scale, dxfattribs={"layer": "A-FURN"})
    space.add_text("PLAN", height=scale, dxfattribs={"layer": layer})
    return doc


def states(partial: PartialMap, *points: tuple[float, float]) -> list[int]:
    return partial.state_at(np.array(points)).tolist()


def require_rooms(partial: PartialMap) -> None:
    inside, door, furniture = (2.0, 1.0), (4.1, 2.5), (2.6, 3.0)
    assert states(partial, inside, (6.0, 4.0), door, furniture) == [FREE] * 4
    assert states(partial, (4.1, 1.0), (0.1, 2.0), (8.1, 4.0), (8.1, 2.0)) == [WALL] * 4
    assert states(partial, (-1.0, 2.0), (9.0, 2.0), (4.0, 5.5)) == [UNKNOWN] * 3
    assert states(partial, (1.5, 0.3)) == [FREE]
    assert states(partial, (1.5, -0.1)) == [UNKNOWN]
    assert (partial.state == FREE).sum() * partial.resolution_m**2 == pytest.approx(7.6 * 4.8, rel=0.05)


@pytest.mark.parametrize(("units", "unit_m"), [(6, 1.0), (4, 1e-3), (5, 1e-2), (1, 0.0254), (2, 0.3048)])
@pytest.mark.parametrize("fmt", ["asc", "bin"])
def test_rooms(tmp_path: Path, units: int, unit_m: float, fmt: Any) -> None:
    drawing(units, unit_m).saveas(tmp_path / "plan.dxf", fmt=fmt)
    partial = load_map(tmp_path / "plan.dxf")
    require_rooms(partial)
    assert (partial.resolution_m, partial.wall_height_m) == (0.05, 3.0)


def test_options(tmp_path: Path) -> None:
    drawing().saveas(tmp_path / "plan.dxf")
    require_rooms(load_map(tmp_path / "plan.dxf", resolution_m=0.02, wall_height_m=2.5))
    closed = map_from_drawing(tmp_path / "plan.dxf", wall_layers=["a-wall*", "A-GLAZ"])
    assert states(closed, (1.5, 0.12)) == [WALL]
    with pytest.raises(MapError, match=r"height_band_m is for scans alone, but path = '.*dxf' is a drawing: leave"):
        load_map(tmp_path / "plan.dxf", height_band_m=(0, 1))


@pytest.mark.parametrize("unit_m", [1.0, 0.001])
def test_drawing_without_a_unit(tmp_path: Path, unit_m: float) -> None:
    path = tmp_path / "plan.dxf"
    drawing(0, unit_m).saveas(path)
    require_rooms(map_from_drawing(path, unit_m=unit_m))
    with pytest.warns(MapWarning, match=r"has no unit \(\$INSUNITS = 0\), and walls of .* units, which are read as m"):
        require_rooms(load_map(path))


def test_layers_without_names(tmp_path: Path) -> None:
    """All visible layers are walls; hidden ones are not."""
    doc = drawing(layer="LAYER1")
    for name in ("A-FURN", "A-DOOR", "A-WALL-HEAD", "A-GLAZ"):
        doc.layers.get(name).off()
    doc.layers.get("A-GLAZ").rename("LAYER2")
    doc.layers.get("LAYER2").on()
    doc.saveas(tmp_path / "plan.dxf")
    with pytest.warns(MapWarning, match="has no layer whose name looks like walls, so all lines are walls: name them"):
        require_rooms(load_map(tmp_path / "plan.dxf"))


def test_every_kind_of_line(tmp_path: Path) -> None:
    doc = drawing()
    space, on_wall = doc.modelspace(), {"layer": "A-WALL"}
    space.add_line((1, 1, 2.7), (1, 1.5, 2.7), dxfattribs=on_wall)
    space.add_arc((2, 1), 0.5, 0, 90, dxfattribs=on_wall)
    space.add_circle((3, 1), 0.15, dxfattribs=on_wall)
    space.add_ellipse((1, 4), (0.5, 0), 0.5, dxfattribs=on_wall)
    space.add_spline([(2, 4, 0), (2.5, 4.3, 0), (3, 4, 0)], dxfattribs=on_wall)
    space.add_polyline2d([(5, 1), (5, 1.5)], dxfattribs=on_wall)
    space.add_mline([(6, 1), (7, 1)], dxfattribs=on_wall | {"scale_factor": 0.1})
    square = [(6, 3), (6.3, 3), (6.3, 3.3), (6, 3.3)]
    space.add_hatch(dxfattribs=on_wall).paths.add_polyline_path(square, is_closed=True)
    doc.blocks.new("PILLAR").add_lwpolyline([(0, 0), (0.3, 0), (0.3, 0.3), (0, 0.3)], close=True)
    doc.blocks.new("PILLARS").add_blockref("PILLAR", (0, 0))
    space.add_blockref("PILLARS", (5, 4), dxfattribs=on_wall).grid((1, 2), (0, 1))
    doc.saveas(tmp_path / "plan.dxf")
    partial = load_map(tmp_path / "plan.dxf")
    on = [(1, 1.2), (2.354, 1.354), (3, 1), (1.25, 4.216), (2.5, 4.28), (5, 1.2), (6.5, 1.02), (6.15, 3.15)]
    on += [(5.15, 4.15), (6.15, 4.15)]
    assert states(partial, *[(x + 1e-3, y + 1e-3) for x, y in on]) == [WALL] * len(on)
    require_rooms(partial)


def test_shipped_scene_comes_back(tmp_path: Path) -> None:
    """The walls of the shipped apartment, drawn as the borders of their cells."""
    home = sp.load_map(scenes_folder() / "apartment" / "complete")
    doc = ezdxf.new(units=6)
    cell, (x, y) = home.resolution_m, home.origin_m
    for row, column in np.argwhere(home.state == WALL):
        cross = [(x + cell * (column + a), y + cell * (row + b)) for a in (0.1, 0.9) for b in (0.1, 0.9)]
        doc.modelspace().add_lwpolyline(cross, dxfattribs={"layer": "WALLS"})
    doc.saveas(tmp_path / "plan.dxf")
    partial = map_from_drawing(tmp_path / "plan.dxf")
    row, column = np.nonzero(home.state != UNKNOWN)
    state = partial.state_at(np.column_stack([x + (column + 0.5) * cell, y + (row + 0.5) * cell]))
    assert (state == home.state[row, column]).mean() > 0.98


def spoiled(change: Callable[[Drawing], object], units: int = 6, unit_m: float = 1.0) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        doc = drawing(units, unit_m)
        change(doc)
        doc.saveas(path)

    return write


def blocks_in_blocks(doc: Drawing) -> None:
    for level in range(12):
        block = doc.blocks.new(f"B{level}")
        for _ in range(10 if level else 0):
            block.add_blockref(f"B{level - 1}", (0, 0))
    doc.modelspace().add_blockref("B11", (0, 0), dxfattribs={"layer": "A-WALL"})


def endless_block(doc: Drawing) -> None:
    doc.blocks.new("A").add_blockref("A", (0, 0))
    doc.modelspace().add_blockref("A", (0, 0))
    doc.modelspace().add_blockref("A", (0, 0)).grid((10_000, 10_000))


def room_alone(doc: Drawing) -> None:
    doc.modelspace().delete_all_entities()
    doc.modelspace().add_lwpolyline(CORNERS, close=True, dxfattribs={"layer": "A-WALL"})


@pytest.mark.parametrize(
    ("write", "given", "message"),
    [
        (lambda path: None, {}, "cannot be read (No such file or directory)"),
        (lambda path: path.write_bytes(b""), {}, "is damaged or no DXF (it does not end with EOF): export it again."),
        (lambda path: path.write_bytes(b"hello\n  0\nEOF\n"), {}, "is damaged or no DXF ("),
        (spoiled(lambda doc: None), {"wall_layers": ["WALLS"]}, "wall_layers = ['WALLS'] are none of path = "),
        (spoiled(lambda doc: None), {"wall_layers": ["A-DOOR"]}, "the walls of ['a-door'] enclose nothing: name"),
        (spoiled(lambda doc: None), {"wall_layers": ["Defpoints"]}, "has no lines on ['defpoints']: name layers"),
        (spoiled(lambda doc: None), {"wall_layers": "A-WALL"}, "wall_layers = 'A-WALL' is not allowed: give names"),
        (spoiled(lambda doc: None), {"wall_layers": []}, "wall_layers = [] is not allowed"),
        (spoiled(lambda doc: None), {"unit_m": 0}, "unit_m = 0 is not allowed: give the length of a unit in metres"),
        (spoiled(lambda doc: None), {"unit_m": 0.001}, "has walls that span 0.0082 x 0.0052 m with unit_m = 0.001:"),
        (spoiled(room_alone, 0), {}, "has no unit ($INSUNITS = 0), and walls of 5000 units: give unit_m"),
        (spoiled(lambda doc: doc.modelspace().delete_all_entities()), {}, "has no lines on ['a-glaz', 'a-wall']"),
        (spoiled(blocks_in_blocks), {}, "has more than 1,000 entities in blocks, or 1,000,000 pieces of lines: save"),
        (spoiled(endless_block), {}, "has more than 1,000 entities in blocks"),
    ],
)
def test_refused(tmp_path: Path, write: Callable, given: Any, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing_lines, "MAX_PARTS", 1000)
    write(tmp_path / "plan.dxf")
    with pytest.raises(MapError, match=re.escape(message)):
        map_from_drawing(tmp_path / "plan.dxf", **given)


@pytest.mark.parametrize("fmt", ["asc", "bin"])
def test_every_truncation(tmp_path: Path, fmt: Any) -> None:
    path = tmp_path / "plan.dxf"
    drawing().saveas(path, fmt=fmt)
    content = path.read_bytes()
    for size in range(0, len(content) - 10, len(content) // 20):
        path.write_bytes(content[:size])
        with pytest.raises(MapError, match=r"is damaged or no DXF"):
            map_from_drawing(path)


def test_not_a_path() -> None:
    with pytest.raises(MapError, match=r"path = 3 is not a path: give a drawing \(\.dxf\)"):
        map_from_drawing(3)  # type: ignore[arg-type]
