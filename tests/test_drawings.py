"""DXF floor plans as maps: what ezdxf writes, layers, units, and what walls enclose."""

import re
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import pytest
import shapely
from ezdxf.document import Drawing
from small_maps import states

from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.importers import drawing_lines
from sionna_partial.maps.importers.drawings import map_from_drawing
from sionna_partial.maps.importers.wall_layers import skip_reason
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap

FREE, WALL, UNKNOWN = (int(state) for state in CellState)


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


def require_rooms(partial: PartialMap) -> None:
    inside, door, furniture = (2.0, 1.0), (4.1, 2.5), (2.6, 3.0)
    assert states(partial, inside, (6.0, 4.0), door, furniture) == [FREE] * 4
    assert states(partial, (4.1, 1.0), (0.1, 2.0), (8.1, 4.0), (8.1, 2.0)) == [WALL] * 4
    assert states(partial, (-1.0, 2.0), (9.0, 2.0), (4.0, 5.5)) == [UNKNOWN] * 3
    assert states(partial, (1.5, 0.3)) == [FREE]
    assert states(partial, (1.5, -0.1)) == [UNKNOWN]
    assert (partial.state == FREE).sum() * partial.resolution_m**2 == pytest.approx(7.6 * 4.8, rel=0.05)


@pytest.mark.parametrize(
    ("header", "unit_m", "fmt"),
    [
        *((0, 0.001, "asc"), (0, 0.01, "asc"), (4, 0.001, "asc"), (4, 1.0, "bin"), (6, 0.01, "asc")),
        *((1, 0.0254, "asc"), (2, 0.3048, "bin")),
    ],
)
def test_rooms_in_any_unit(tmp_path: Path, header: int, unit_m: float, fmt: Any) -> None:
    drawing(header, unit_m).saveas(tmp_path / "plan.dxf", fmt=fmt)
    is_right = {1: 0.0254, 2: 0.3048, 4: 0.001}.get(header) == unit_m
    message = "give unit_m" if header else r"has no unit \(\$INSUNITS = 0\), and walls of .* units, which are read as"
    with nullcontext() if is_right else pytest.warns(MapWarning, match=message):
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


REPORTS = Path(__file__).parent / "reports"

CENTIMETRES = r"so it is read in centimetres, with .* give unit_m, 0\.01 if that is right, 0\.%s for the unit of the"


@pytest.mark.parametrize(
    ("name", "unit_m", "message"),
    [
        ("mm_as_mm", 0.001, None),
        ("cm_as_mm", 0.01, CENTIMETRES % "001"),
        ("cm_as_inch", 0.01, CENTIMETRES % "0254"),
        ("mm_as_inch", 0.001, r"has the unit 0\.0254 m \(\$INSUNITS = 1 of the header\), and with it an extent of 305"),
        ("m_as_mm", 1.0, r"so it is read in metres"),
    ],
)
def test_wrong_units(name: str, unit_m: float, message: str | None) -> None:
    path = REPORTS / "dxf_units" / f"{name}.dxf"
    with pytest.warns(MapWarning, match=message) if message else nullcontext():
        report = load_map(path).import_report
    assert report is not None
    assert report.extent_m == pytest.approx((12.0, 8.0), abs=0.06)
    assert (report.unit_m, report.rooms) == (unit_m, 3)
    given = load_map(path, unit_m=unit_m).import_report
    assert given == replace(report, unit_source="unit_m")


@pytest.mark.parametrize(
    ("name", "is_used", "message"),
    [
        ("A-WALL-FULL-N", True, None),
        ("A-WALL-FULL-D", False, None),
        ("A-WALL-DEMO", False, None),
        ("E-LITE-WALL", False, None),
        ("A-WALL-PRHT", True, "has walls of partial height on .* give layer_heights_m to map_from_draw"),
    ],
)
def test_layers_by_the_standard(name: str, is_used: bool, message: str | None) -> None:
    with pytest.warns(MapWarning, match=message) if message else nullcontext():
        partial = load_map(REPORTS / "dxf_layers" / f"{name}.dxf")
    assert partial.import_report is not None
    used = {row.name for row in partial.import_report.used}
    assert (name in used) == is_used
    assert used | {row.name for row in partial.import_report.skipped} == {"A-WALL-FULL-E", name}
    assert states(partial, (6.02, 4)) == [WALL if is_used else FREE]


def test_heights_of_layers() -> None:
    path = REPORTS / "dxf_layers" / "A-WALL-PRHT.dxf"
    partial = map_from_drawing(path, layer_heights_m={"*-prht": 1.1})
    assert partial.obstacle_heights_m == (1.1,)
    points_m = np.array([[6.02, 4, 1.0], [6.02, 4, 1.2], [0.02, 4, 1.2]])
    assert partial.is_wall_at(points_m).tolist() == [True, False, True]
    with pytest.raises(MapError, match=r"layer_heights_m\['\*'\] = -1 is not allowed: give a height"):
        map_from_drawing(path, layer_heights_m={"*": -1})


LAYERS = {
    "": "A-WALL, a-wall-full-e, S-COLS, A-GLAZ-SILL, Wand, AR_Außenwände, Wa\u0308nde, Mur ext, A-WALL-FULL-N, I-WALL, "
    "A-WALL-CORE-2, xref$0$A-WALL, plan|A-GLAZ, A-WALL-PRHT, Ściany nośne, SCIANY, Obvodové stěny, zdivo, "
    "Teherhordó fal, FALAK, Seinät, DUVARLAR, TOIXOS, Εξωτ. τοίχοι, Dinding, Tembok, 墙体, 牆, 外壁, 内壁, 벽체, ผนัง, "
    "جدار, קיר, Perete, ZIDOVI, Наружные стены, Стіни, Vægge, Väggar, Yttervegg, Muros, Paredes, Parede, Tramezzi, "
    "tường, Siena, Fönster, okna",
    "to be demolished": "A-WALL-D, plan|A-WALL-FULL-D, AD-WALL, Wand Abbruch, walls_demo",
    "future work": "A-WALL-F",
    "to be moved": "A-WALL-MOVE-M",
    "temporary": "A-GLAZ-T",
    "lamps or sockets": "Wandleuchten, WALL LIGHTS",
    "furniture": "Wandschrank",
    "major group of no wall (AIA/NCS)": "E-LITE-WALL, P-FIXT-WALL, A-DOOR, A-FLOR-WALL",
    "texts, dimensions or door headers": "A-WALL-HEAD",
    "name of no wall": "Base, Default, Asphalt, Design, organized, mural, residual, 家具, 尺寸, Present, "
    "Stendardo, stupid",
    "doors": "门窗",
    "axes": "壁芯",
}
"""Names of layers by the reason for which they are skipped."""


@pytest.mark.parametrize("reason", LAYERS)
def test_names_of_layers(reason: str) -> None:
    for name in LAYERS[reason].split(", "):
        assert skip_reason(name) == reason, name


def test_walls_on_a_layer_without_such_a_name(tmp_path: Path) -> None:
    """Inner walls on "Wand" enclose hardly any area; the outer ones are on "Base", beside a frame and texts."""
    doc = ezdxf.new(units=6)
    space = doc.modelspace()
    for x in (5, 5.2):
        space.add_line((x, 0.2), (x, 3), dxfattribs={"layer": "Wand"})
    for y in (4, 4.2):
        space.add_line((6, y), (11.8, y), dxfattribs={"layer": "Wand"})
    space.add_lwpolyline([(5, 3), (5.2, 3)], dxfattribs={"layer": "Wand"})
    for inset in (0.0, 0.2):
        corners = [(inset, inset), (12 - inset, inset), (12 - inset, 8 - inset), (inset, 8 - inset)]
        space.add_lwpolyline(corners, close=True, dxfattribs={"layer": "Base"})
    space.add_lwpolyline([(-20, -20), (50, -20), (50, 40), (-20, 40)], close=True, dxfattribs={"layer": "Rahmen"})
    doc.saveas(tmp_path / "plan.dxf")
    message = r"walls on \['wand'\] that enclose hardly any area, so layer 'Base' \(2 lines\) is read"
    with pytest.warns(MapWarning, match=message):
        partial = load_map(tmp_path / "plan.dxf")
    assert states(partial, (2, 2), (8, 2), (8, 6), (0.1, 4), (5.1, 1)) == [FREE, FREE, FREE, WALL, WALL]
    assert partial.import_report is not None
    assert [(row.name, row.count) for row in partial.import_report.used] == [("Base", 2), ("Wand", 5)]
    assert [(row.name, row.reason) for row in partial.import_report.skipped] == [("Rahmen", "name of no wall")]


def test_hardly_any_area(tmp_path: Path) -> None:
    doc = ezdxf.new(units=6)
    for corners in ([(0, 0), (1, 0), (1, 1), (0, 1)], [(0, 9), (12, 9), (12, 9.2), (0, 9.2)]):
        doc.modelspace().add_lwpolyline(corners, close=True, dxfattribs={"layer": "WALL"})
    doc.saveas(tmp_path / "plan.dxf")
    with pytest.warns(MapWarning) as caught:
        load_map(tmp_path / "plan.dxf")
    message = r"encloses 0\.\d+ m2 in an extent of 12\..* wall_layers; it has .* layers: WALL \(2 lines\)"
    assert re.search(message, str(caught[0].message))


def test_degrees(tmp_path: Path) -> None:
    doc = ezdxf.new(units=6)
    corners = [(11.57, 48.15), (11.5708, 48.15), (11.5708, 48.1503), (11.57, 48.1503)]
    doc.modelspace().add_lwpolyline(corners, close=True, dxfattribs={"layer": "WALL"})
    doc.saveas(tmp_path / "plan.dxf")
    message = r"spans x 11.57 to 11.5708 and y 48.15 to 48.1503, as if in degrees of longitude and latitude: project it"
    with pytest.raises(MapError, match=message):
        load_map(tmp_path / "plan.dxf")


def test_lines_closer_than_a_cell(tmp_path: Path) -> None:
    drawing().saveas(tmp_path / "plan.dxf")
    with pytest.warns(MapWarning, match=r"lines 0\.2 m apart, closer than resolution_m = 0\.25, .* of 0\.1"):
        load_map(tmp_path / "plan.dxf", resolution_m=0.25)


def test_skipped_elements_are_listed(tmp_path: Path) -> None:
    doc = drawing()
    space = doc.modelspace()
    space.add_point((1, 1), dxfattribs={"layer": "A-WALL"})
    space.add_line((1, 1), (2, 2), dxfattribs={"layer": "A-WALL-DEMO"})
    doc.layers.add("HIDDEN WALLS").off()
    space.add_line((1, 1), (2, 2), dxfattribs={"layer": "HIDDEN WALLS"})
    doc.add_xref_def("structure.dxf", "STRUCTURE")
    space.add_blockref("STRUCTURE", (0, 0))
    doc.saveas(tmp_path / "plan.dxf")
    text = (tmp_path / "plan.dxf").read_text().replace("  0\nCIRCLE\n", "  0\nAEC_WALL\n", 1)
    (tmp_path / "plan.dxf").write_text(text)
    with pytest.warns(MapWarning, match=r"are not read: AEC_WALL \(1\), STRUCTURE \(1\): explode or bind them"):
        report = load_map(tmp_path / "plan.dxf").import_report
    assert report is not None
    assert [(row.name, row.count) for row in report.used] == [("A-GLAZ", 2), ("A-WALL", 8)]
    assert [(row.name, row.count, row.reason) for row in report.skipped] == [
        *((name, 1, skip_reason(name)) for name in ("A-DOOR", "A-WALL-DEMO", "A-WALL-HEAD")),
        ("AEC_WALL", 1, "object of another program: explode them"),
        ("HIDDEN WALLS", 1, "hidden"),
        ("POINT on A-WALL", 1, "type without lines"),
        ("STRUCTURE", 1, "external reference: bind it"),
        ("TEXT on A-WALL", 1, "type without lines"),
    ]


def test_blocks_are_where_ezdxf_explodes_them(tmp_path: Path) -> None:
    doc = drawing()
    inner, outer = doc.blocks.new("INNER"), doc.blocks.new("OUTER", base_point=(0.1, 0.2))
    inner.add_lwpolyline([(0, 0, 0.3), (0.4, 0), (0.4, 0.2)], format="xyb")
    inner.add_arc((0.2, 0.1), 0.1, 20, 200)
    outer.add_blockref("INNER", (0.3, 0.1), dxfattribs={"rotation": 30, "xscale": -1, "yscale": 2})
    outer.add_line((0, 0), (0.5, 0.1), dxfattribs={"layer": "A-FURN"})
    for x in range(1, 4):
        placed = doc.modelspace().add_blockref("OUTER", (x, 1.5), dxfattribs={"layer": "A-WALL", "rotation": 50 * x})
        placed.set_scale(0.7 * x).grid((2, x), (0.9, 0.8))
    found = drawing_lines.DrawnLines(tmp_path, doc).segments({"a-wall"})[0]

    def exploded(entities: Any) -> Iterator[Any]:
        for entity in entities:
            if entity.dxftype() == "INSERT":
                for one in entity.multi_insert() if entity.mcount > 1 else [entity]:
                    yield from exploded(one.virtual_entities())
            elif entity.dxf.layer in ("0", "A-WALL"):
                yield from (lines[..., :2] for lines in drawing_lines._pieces(entity))

    expected = np.concatenate(list(exploded(doc.modelspace().query("*[layer=='A-WALL']"))))
    near = shapely.MultiLineString(list(expected)).buffer(0.002)
    assert near.covers(shapely.MultiLineString(list(found)))
    length, expected_length = (np.linalg.norm(np.diff(pieces, axis=1)).sum() for pieces in (found, expected))
    assert length == pytest.approx(expected_length, rel=0.01)


def test_layers_without_names(tmp_path: Path) -> None:
    doc = drawing(layer="LAYER1")
    for name in ("A-FURN", "A-DOOR", "A-WALL-HEAD", "A-GLAZ"):
        doc.layers.get(name).off()
    doc.layers.get("A-GLAZ").rename("LAYER2")
    doc.layers.get("LAYER2").on()
    doc.saveas(tmp_path / "plan.dxf")
    with pytest.raises(MapError) as refused:
        load_map(tmp_path / "plan.dxf")
    message = (
        r"looks like walls: give wall_layers \(--wall-layer\), one or more of 'LAYER1' \(8 lines, 58 long, on 8.2 x "
    )
    assert re.search(
        message + r"5.2\), 'LAYER2' \(2 lines, 4 long, on 0.2 x 2\) \[units of the drawing\]", str(refused.value)
    )
    require_rooms(load_map(tmp_path / "plan.dxf", wall_layers=["LAYER?"]))
    doc.layers.get("LAYER2").off()
    doc.saveas(tmp_path / "plan.dxf")
    with pytest.warns(MapWarning, match="has no layer whose name looks like walls, so all lines are walls: name them"):
        load_map(tmp_path / "plan.dxf")


@pytest.mark.parametrize(
    ("name", "free_m2", "rooms"),
    [("p00", 47.1, 2), ("p07", 47.3, 1), ("p10", 47.3, 1), ("p13", 42.0, 2), ("p16", 46.0, 2), ("p17", 47.1, 2)],
)
def test_what_a_drawing_shows(name: str, free_m2: float, rooms: int) -> None:
    """Walls in a block on a frozen layer, invisible, of wide polylines, as solids, and as upright faces."""
    report = load_map(Path(__file__).parent / "reports" / "dxf_visibility" / f"{name}.dxf").import_report
    assert report.free_area_m2 == pytest.approx(free_m2, abs=0.1)
    assert report.rooms == rooms
    reasons = {row.reason for row in report.skipped}
    assert reasons == ({"invisible, or blocks on a frozen layer"} if name in ("p07", "p10") else set())


def test_faces_of_meshes(tmp_path: Path) -> None:
    doc = drawing()
    space, corners = doc.modelspace(), [(2, 1, 0), (3, 1, 0), (3, 1, 3), (2, 1, 3)]
    flat = [(1, 3, 3), (3, 3, 3), (3, 4, 3), (1, 4, 3)]
    with space.add_mesh(dxfattribs={"layer": "A-WALL"}).edit_data() as mesh:
        mesh.vertices, mesh.faces = [*corners, *flat], [(0, 1, 2, 3), (4, 5, 6, 7)]
    face = space.add_polyface(dxfattribs={"layer": "A-WALL"})
    face.append_face([(x + 4, y, z) for x, y, z in corners])
    doc.saveas(tmp_path / "plan.dxf")
    partial = load_map(tmp_path / "plan.dxf")
    assert states(partial, (2.5, 1.02), (6.5, 1.02), (2.0, 3.02)) == [WALL, WALL, FREE]


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


def spoiled(change: Callable[[Drawing], object], units: int = 6) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        doc = drawing(units)
        change(doc)
        doc.saveas(path)

    return write


def endless_block(doc: Drawing) -> None:
    doc.blocks.new("A").add_blockref("A", (0, 0))
    doc.modelspace().add_blockref("A", (0, 0))
    doc.modelspace().add_blockref("A", (0, 0)).grid((10_000, 10_000))


def room_alone(doc: Drawing) -> None:
    doc.modelspace().delete_all_entities()
    corners = [(0, 0), (5000, 0), (5000, 4000), (0, 4000)]
    doc.modelspace().add_lwpolyline(corners, close=True, dxfattribs={"layer": "A-WALL"})


@pytest.mark.parametrize(
    ("write", "given", "message"),
    [
        (lambda path: None, {}, "cannot be read (No such file or directory)"),
        (lambda path: path.write_bytes(b""), {}, "is damaged or no DXF (it does not end with EOF): export it again."),
        (spoiled(lambda doc: None), {"wall_layers": ["WALLS"]}, "wall_layers = ['WALLS'] are none of path = "),
        (spoiled(lambda doc: None), {"wall_layers": ["A-DOOR"]}, "the walls of ['a-door'] enclose nothing: name"),
        (spoiled(lambda doc: None), {"wall_layers": "A-WALL"}, "wall_layers = 'A-WALL' is not allowed: give names"),
        (spoiled(lambda doc: None), {"unit_m": 0.001}, "has walls that span 0.0082 x 0.0052 m with unit_m = 0.001:"),
        (spoiled(room_alone, 0), {}, "has no unit ($INSUNITS = 0), and walls of 5000 units: give unit_m"),
        (spoiled(lambda doc: doc.modelspace().delete_all_entities()), {}, "has no lines on ['a-glaz', 'a-wall']"),
        (spoiled(endless_block), {}, "has more than 1,000 entities in blocks"),
    ],
)
def test_refused(tmp_path: Path, write: Callable, given: Any, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing_lines, "MAX_PARTS", 1000)
    write(tmp_path / "plan.dxf")
    with pytest.raises(MapError, match=re.escape(message)):
        map_from_drawing(tmp_path / "plan.dxf", **given)
