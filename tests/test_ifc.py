"""IFC models as maps: storeys, types, materials, units and placement, and what is refused."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError

pytest.importorskip("ifcopenshell")
from ifc_building import Building

FREE, WALL, UNKNOWN = (int(state) for state in CellState)


def states(partial: sp.PartialMap, *points: tuple[float, float]) -> list[int]:
    return partial.state_at(np.array(points)).tolist()


def material_at(partial: sp.PartialMap, x: float, y: float) -> sp.Material | None:
    assert partial.wall_material is not None
    number = int(partial.wall_material[partial.cell_index(np.array([x, y]))])
    return partial.wall_materials[number - 1] if number else None


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
    expected = {(2.0, 0.0): "concrete", (8.0, 2.5): "glass", (6.4, 2.5): "concrete"}
    assert {at: material_at(partial, *at) for at in expected} == {k: sp.Material.named(v) for k, v in expected.items()}
    assert material_at(partial, 0.0, 2.0) is None
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


def wallless(path: Path) -> None:
    Building(0.0).model.write(str(path))


def one_wall(path: Path) -> None:
    building = Building(0.0)
    building.part("IfcWall", (0.0, 0.0, 0.0), (5.0, 0.0, 3.0))
    building.model.write(str(path))


def kerbs(path: Path) -> None:
    building = Building(0.0)
    building.part("IfcWall", (0.0, 0.0, 0.0), (5.0, 0.0, 0.3))
    building.model.write(str(path))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: path.write_text("ISO-10303-21;\nHEADER;"), "is damaged or no IFC (it is no whole STEP file)"),
        (lambda path: path.write_text("ISO-10303-21;\nEND-ISO-10303-21;"), "is damaged or no IFC ("),
        (lambda path: path.write_bytes(b"PK\3\4"), "is damaged or no IFC"),
        (wallless, "has 0 walls on 1 storeys: export a building with both."),
        (one_wall, "has walls that enclose nothing on this storey: give another storey."),
        (kerbs, "has no walls 1.2 m above the storey: give another storey."),
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
        (
            {"storey": "Level 0", "layer_materials": {"IfcSlab": "brick"}},
            r"layer_materials\['IfcSlab'\] names no walls",
        ),
        ({"storey": "Level 0", "layer_materials": {"IfcWall": 3}}, r"layer_materials\['IfcWall'\] = 3 is no material"),
        ({"height_band_m": (0, 1)}, "height_band_m is for scans alone"),
    ],
)
def test_arguments(path: Path, given: dict[str, Any], message: str) -> None:
    with pytest.raises(MapError, match=message):
        sp.load_map(path, **given)


def test_without_the_library(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ifcopenshell", None)
    with pytest.raises(MapError, match=r"needs ifcopenshell: pip install 'sionna-partial\[ifc\]'\."):
        sp.load_map(path, storey="Level 0")
