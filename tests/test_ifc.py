"""IFC models as maps: storeys, types, materials, units and placement, and what is refused."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.importers.ifc_layers import Layer, constants_at
from sionna_partial.maps.importers.ifc_layers import slab as slab_of_layers

pytest.importorskip("ifcopenshell")
from ifc_building import Building, whole_of
from small_maps import states

REPORTS = Path(__file__).parent / "reports"

FREE, WALL, UNKNOWN = (int(state) for state in CellState)


def material_at(partial: sp.PartialMap, x: float, y: float) -> sp.Material | None:
    assert partial.wall_material is not None
    number = int(partial.wall_material[partial.cell_index(np.array([x, y]))])
    return partial.wall_materials[number - 1] if number else None


def thick(name: str, thickness_m: float | None = None) -> sp.Material:
    material = sp.Material.named(name)
    return material if thickness_m is None else replace(material, thickness_m=thickness_m)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    building, path = Building(0.0, 3.2), tmp_path_factory.mktemp("ifc") / "building.ifc"
    walls = building.rooms(0.0, 0)
    building.made_of(walls[0], ("Gypsum Wall Board", 12.0), ("Concrete, Cast In Situ", 150.0), ("Insulation", 200.0))
    building.rooms(3.2, 1)
    building.model.write(str(path))
    return path


def test_rooms(path: Path) -> None:
    partial = sp.load_map(path, storey="level 0")
    assert states(partial, (2.0, 1.0), (6.0, 4.0), (4.0, 2.5), (1.5, 3.0)) == [FREE] * 4
    assert states(partial, (2.0, 0.0), (8.0, 1.0), (4.0, 1.0), (8.0, 2.5), (6.4, 2.5)) == [WALL] * 5
    assert states(partial, (-1.0, 2.0), (9.0, 2.0)) == [UNKNOWN] * 2
    assert (partial.resolution_m, partial.wall_height_m) == (0.05, pytest.approx(3.2))
    assert (partial.state == FREE).sum() * 0.05**2 == pytest.approx(7.8 * 4.8 - 0.64 - 0.4, rel=0.03)


def test_materials(path: Path) -> None:
    partial = sp.load_map(path, storey="Level 0")
    assert material_at(partial, 2.0, 0.0) == slab_of_layers(
        [Layer("Gypsum", 0.012), Layer("Concrete", 0.15)], None, None
    )
    expected = {(8.0, 2.5): thick("glass"), (6.4, 2.5): thick("concrete")}
    assert {at: material_at(partial, *at) for at in expected} == expected
    given = sp.load_map(path, storey="Level 0", layer_materials={"ifcwall*": "brick", "IfcDoor": "metal"})
    assert [material_at(given, *at) for at in ((2.0, 0.0), (4.0, 2.5), (8.0, 2.5))] == [
        sp.Material.named(name) for name in ("brick", "metal", "glass")
    ]


def test_one_storey_with_walls_placed_and_turned(tmp_path: Path) -> None:
    building = Building(0.0, 3.0)
    building.rooms(3.0, 1)
    building._place(building.building, (100.0, 50.0, 7.0), np.pi / 2)
    for storey in building.storeys:
        storey.ObjectPlacement.PlacementRelTo = building.building.ObjectPlacement
    building.model.write(str(tmp_path / "a.ifc"))
    partial = sp.load_map(tmp_path / "a.ifc", resolution_m=0.1)
    assert states(partial, (99.0, 52.0), (96.0, 56.0), (100.0, 52.0), (97.5, 58.0)) == [FREE, FREE, WALL, WALL]


@pytest.mark.parametrize("name", ["control", "inner_in_layers", "outer_in_layers", "sub_walls"])
def test_bodies_in_parts(name: str) -> None:
    """At 28 GHz a wall with two layers of its own bodies is opaque, as one with a single body is."""
    partial = sp.load_map(REPORTS / "ifc_layers" / f"{name}.ifc")
    assert sp.trace_links(partial, (2.0, 3.0, 1.5), [(6.0, 3.2, 1.5)]).link_state.tolist() == [sp.LinkState.OUTAGE]
    report = partial.import_report
    assert report is not None
    assert report.rooms == 2
    assert report.extent_m == pytest.approx((8.0, 6.0), abs=0.06)
    parts = {row.name: row.count for row in report.used}.get("IfcBuildingElementPart", 0)
    assert parts == {"inner_in_layers": 2, "outer_in_layers": 8}.get(name, 0)


BOARDS = replace(sp.Material(itu="plasterboard"), thickness_m=0.025)


@pytest.mark.parametrize(
    ("layers", "expected"),
    [
        ([("Concrete C30", 240.0)], thick("concrete", 0.24)),
        ([("Metal Stud Layer", 70.0), ("Stahlbeton", 300.0), ("Holzfaserdämmung", 240.0)], thick("concrete", 0.3)),
        ([("Brick", 115.0), ("Air", 40.0), ("Brick", 115.0)], thick("brick", 0.23)),
        ([("Gypsum board", 12.5), ("Glass wool", 75.0), ("Gypsum board", 12.5)], BOARDS),
        ([("Gypsum board", 12.5), ("Wood stud", 75.0), ("Gypsum board", 12.5)], BOARDS),
        ([("Gypsum board", 12.5), ("Fiberglass", 75.0), ("Sheet metal cladding", 0.8)], thick("metal")),
        ([("Fiberglass", 75.0)], sp.Material(1.05, 0.0, 0.075)),
        ([("Béton armé", None)], thick("concrete", 0.1)),
        ([("Type 7", 15.0)], None),
        ([("Type 7", 150.0), ("Gypsum board", 12.5)], None),
    ],
)
def test_thickness_of_layers(tmp_path: Path, layers: list[tuple[str, float]], expected: sp.Material | None) -> None:
    building = Building(0.0)
    inner = building.rooms(0.0, 0)[-1]
    if layers[0][1] is None:
        building.of_list(inner, layers[0][0])
    else:
        building.made_of(inner, *layers)
    building.model.write(str(tmp_path / "a.ifc"))
    assert material_at(sp.load_map(tmp_path / "a.ifc"), 4.0, 1.0) == expected


@pytest.mark.parametrize("frequency_hz", [2.4e9, 5.2e9, 28e9])
def test_slab_of_several_materials(frequency_hz: float) -> None:
    """Its absorption is the sum of the absorptions of its layers."""
    slab = slab_of_layers([Layer("Plaster", 0.03), Layer("Air", 0.05), Layer("Brick", 0.24)], None, None)
    assert slab is not None

    def absorption_db(material: sp.Material) -> float:
        permittivity, conductivity_s_m = constants_at(material, frequency_hz)
        return 1636.0 * conductivity_s_m * material.thickness_m / np.sqrt(permittivity)

    parts = [sp.Material(itu="plasterboard", thickness_m=0.03), sp.Material(itu="brick", thickness_m=0.24)]
    assert slab.thickness_m == 0.27
    assert absorption_db(slab) == pytest.approx(sum(map(absorption_db, parts)), rel=0.08)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("Holzständer", "frame"),
        ("Metal - Furring", "frame"),
        ("Concrete frame", "concrete frame"),
        ("Laine de verre", "insulation"),
        ("Insulation / Thermal Barriers - Rigid", "insulation"),
        ("Insulating glass", "glass"),
        ("Isolierverglasung", "glass"),
        ("Glass fibre reinforced concrete", "concrete"),
        ("Masonry - Concrete Masonry Units", "concrete"),
        ("Concrete with insulation", "concrete"),
        ("Aluminium foil", "metal foil"),
        ("Structure, Wood Joist/Rafter Layer", "frame"),
        ("Generic", None),
    ],
)
def test_names_of_layers(text: str, name: str | None) -> None:
    assert Layer(text, 0.0).name == name


def test_boards_on_studs_lose_what_boards_lose() -> None:
    """ITU-R P.2040 has 1.1 dB for each board of 12.5 mm at 5.2 GHz, the metal stud between them nothing."""
    partial = sp.load_map(REPORTS / "ifc_studs" / "metal_stud.ifc")
    settings = sp.TraceSettings(frequency_hz=5.2e9, max_depth=0, diffraction=False)
    found = sp.trace_links(partial, (2.0, 1.0, 1.5), [(5.5, 1.0, 1.5)], trace_settings=settings)
    free_db = 20 * np.log10(299792458 / 5.2e9 / (4 * np.pi * 3.5))
    assert free_db - found.gain_db[0] == pytest.approx(2.2, abs=0.5)
    layers = "Plasterboard 12.5 mm + Metal Stud Layer 70 mm (no loss) + Plasterboard 12.5 mm"
    slab = f"1 x IfcWall of {layers}: plasterboard of 25 mm, 1.2, 1.9, 5.4 dB at 2.4, 5.2, 28 GHz"
    assert slab in partial.import_report.notes


def test_walls_side_by_side(tmp_path: Path) -> None:
    """Insulation that is a wall of its own beside concrete does not open it from its side."""
    building = Building(0.0)
    inner = building.rooms(0.0, 0)[-1]
    building.made_of(inner, ("Concrete", 100.0))
    building.made_of(building.part("IfcWall", (4.1, 0.0, 0.0), (4.1, 2.0, 2.8), 0, 0.1), ("Mineral wool", 100.0))
    building.model.write(str(tmp_path / "a.ifc"))
    partial = sp.load_map(tmp_path / "a.ifc")
    assert [material_at(partial, x, 1.0) for x in (4.0, 4.1)] == [thick("concrete", 0.1)] * 2
    assert material_at(partial, 2.0, 0.0) is None


def test_members_of_stairs_are_no_walls() -> None:
    partial = sp.load_map(REPORTS / "ifc_studs" / "stair.ifc")
    assert states(partial, *((x, 4.0) for x in (4.5, 5.5, 6.5, 7.5))) == [FREE] * 4
    assert ("IfcMember", 2) in {(row.name, row.count) for row in partial.import_report.skipped}


def test_curtain_walls_alone(tmp_path: Path) -> None:
    building = Building(0.0)
    corners = [(0.0, 0.0), (8.0, 0.0), (8.0, 5.0), (0.0, 5.0)]
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        wall = building.part("IfcCurtainWall", (*a, 0.0), (*a, 0.0))
        wall.Representation = None
        plate = building.part("IfcPlate", (*a, 0.0), (*b, 2.8))
        whole_of(building, wall, plate)
    building.model.write(str(tmp_path / "a.ifc"))
    partial = sp.load_map(tmp_path / "a.ifc")
    assert states(partial, (4.0, 2.5), (4.0, 0.0)) == [FREE, WALL]
    assert material_at(partial, 4.0, 0.0) == thick("glass")


def test_loss_of_layers(tmp_path: Path) -> None:
    """ITU-R P.2040 has 29.3 dB for 24 cm of concrete at 5 GHz."""
    building = Building(0.0)
    for wall in building.rooms(0.0, 0):
        building.made_of(wall, ("Concrete", 240.0))
    building.model.write(str(tmp_path / "a.ifc"))
    settings = sp.TraceSettings(frequency_hz=5e9, max_depth=0, diffraction=False)
    partial = sp.load_map(tmp_path / "a.ifc")
    found = sp.trace_links(partial, (2.0, 1.0, 1.5), [(5.5, 1.0, 1.5)], trace_settings=settings)
    free_db = 20 * np.log10(299792458 / 5e9 / (4 * np.pi * 3.5))
    assert free_db - found.gain_db[0] == pytest.approx(29.3, abs=0.1)


@pytest.mark.parametrize(
    ("materials", "expected"), [(["Holz", "Isolierverglasung"], "glass"), (["Low-E coated glass"], "coated glass")]
)
def test_windows_are_of_their_panes(tmp_path: Path, materials: list[str], expected: str) -> None:
    building = Building(0.0)
    building.rooms(0.0, 0)
    building.of_list(building.model.by_type("IfcWindow")[0], *materials)
    building.model.write(str(tmp_path / "a.ifc"))
    assert material_at(sp.load_map(tmp_path / "a.ifc"), 8.0, 2.5) == sp.Material.named(expected)


def test_report(path: Path) -> None:
    report = sp.load_map(path, storey="Level 0").import_report
    assert report is not None
    assert (report.unit_m, report.unit_source, report.rooms) == (0.001, "units of the IfcProject", 2)
    walls = {"IfcWall": 6, "IfcWallStandardCase": 1, "IfcWindow": 1, "IfcColumn": 1}
    assert {row.name: row.count for row in report.used} == walls
    assert {(row.name, row.count, row.reason) for row in report.skipped} == {
        *((name, count, "nothing 1.2 m above the storey") for name, count in walls.items()),
        ("IfcDoor", 2, "open; layer_materials for IfcDoor closes it"),
        ("IfcFurniture", 2, "no wall"),
    }


def one_wall(path: Path, height_m: float = 3.0) -> None:
    building = Building(0.0)
    building.part("IfcWall", (0.0, 0.0, 0.0), (5.0, 0.0, height_m))
    building.model.write(str(path))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: path.write_text("ISO-10303-21;\nHEADER;"), "is damaged or no IFC (it is no whole STEP file)"),
        (lambda path: path.write_text("ISO-10303-21;\nEND-ISO-10303-21;"), "is damaged or no IFC ("),
        (lambda path: Building(0.0).model.write(str(path)), "has 0 walls on 1 storeys: export a building with both."),
        (one_wall, "has walls that enclose nothing on this storey: give another storey."),
        (lambda path: one_wall(path, 0.3), "has no walls 1.2 m above the storey: give another storey."),
    ],
)
def test_refused(tmp_path: Path, write: Any, message: str) -> None:
    write(tmp_path / "a.ifc")
    with pytest.raises(MapError, match=re.escape(message)):
        sp.load_map(tmp_path / "a.ifc")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, r"storey = None is one of 2 of path = '.*': .* it has 'Level 0' at 0.00 m, 'Level 1' at 3.20 m\."),
        ({"storey": "Roof"}, "storey = 'Roof' is one of 0 of path"),
        ({"storey": "Level 0", "layer_materials": {"IfcSlab": "brick"}}, r"layer_materials\['IfcSlab'\] names no w"),
        ({"storey": "Level 0", "layer_materials": {"IfcWall": 3}}, r"layer_materials\['IfcWall'\] = 3 is no material"),
    ],
)
def test_arguments(path: Path, given: dict[str, Any], message: str) -> None:
    with pytest.raises(MapError, match=message):
        sp.load_map(path, **given)
