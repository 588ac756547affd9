"""Walls of several materials: on the map, in its files, in the scene, and found again by a calibration."""

from dataclasses import replace
from pathlib import Path

import ezdxf
import numpy as np
import pytest
import shapely
import yaml

import sionna_partial as sp
from sionna_partial.errors import MapError
from sionna_partial.tracing.power import wall_loss_db

CONCRETE, GLASS = sp.Material.named("concrete"), sp.Material.named("glass")


def room() -> sp.PartialMap:
    """A room of 6 x 4 m whose left half has walls of concrete, with a window in the lower wall, right."""
    state = np.zeros((40, 60), dtype=np.uint8)
    state[[0, -1]], state[:, [0, -1]] = 1, 1
    partial = sp.PartialMap(state, 0.1, (2.0, -1.0))
    partial = partial.with_wall_material("concrete", [(1.9, -2.0), (5.0, -2.0), (5.0, 4.0), (1.9, 4.0)])
    return partial.with_wall_material(GLASS, [(6.0, -1.0), (7.0, -1.0), (7.0, -0.9), (6.0, -0.9)])


class TestMap:
    def test_cells_have_the_material_of_their_area(self) -> None:
        partial = room()
        assert partial.wall_materials == (CONCRETE, GLASS)
        assert partial.wall_material is not None
        assert np.bincount(partial.wall_material.ravel()).tolist() == [2400 - 98 - 10, 98, 10]
        assert partial.wall_material[partial.state == sp.CellState.FREE].max() == 0

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"wall_material": np.ones((3, 3), int)}, r"wall_material has shape \(3, 3\)"),
            (
                {"wall_material": np.full((40, 60), 3)},
                "wall_material has values 3 to 3, and wall_materials has 2",
            ),
        ],
    )
    def test_what_is_refused(self, changes: dict[str, object], message: str) -> None:
        with pytest.raises(MapError, match=message):
            replace(room(), **changes)  # type: ignore[arg-type]

    @pytest.mark.parametrize(
        ("where", "message"),
        [
            (np.zeros((3, 3), bool), r"where has shape \(3, 3\): give booleans \(40, 60\), or corners \(M, 2\)"),
            ("door", "where = 'door' is not numeric: give cells"),
            ([(0, 0), (4, 4), (4, 0), (0, 4)], r"where = .* is no polygon \(Self-intersection.*: give the corners"),
            (shapely.Polygon([(0, 0), (4, 4), (4, 0), (0, 4)]), r"where is no area \(Self-inters.*shapely.make_valid"),
        ],
    )
    def test_areas_that_are_none(self, where: object, message: str) -> None:
        for change in (
            lambda: room().with_wall_material("brick", where),
            lambda: room().with_obstacle_height(1, where),
        ):
            with pytest.raises(MapError, match=message):
                change()


class TestFiles:
    @pytest.mark.parametrize("name", ["map.yaml", "map.npz", "scene"])
    def test_read_back_as_they_were(self, name: str, tmp_path: Path) -> None:
        (sp.export_scene if name == "scene" else sp.save_map)(room(), tmp_path / name)
        assert sp.load_map(tmp_path / name) == room()

    def test_a_layer_may_be_painted_by_hand(self, tmp_path: Path) -> None:
        sp.save_map(room(), tmp_path / "map.yaml")
        sheet = yaml.safe_load((tmp_path / "map.yaml").read_text())
        sheet["wall_material"]["materials"] = ["brick", "metal"]
        (tmp_path / "map.yaml").write_text(yaml.safe_dump(sheet))
        read = sp.load_map(tmp_path / "map.yaml")
        assert [each.itu for each in read.wall_materials] == ["brick", "metal"]
        assert np.array_equal(read.wall_material, room().wall_material)  # type: ignore[arg-type]

    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("materials", ["brick"], "has shades up to 2 for 1 materials"),
            ("materials", ["brick", "cheese"], "wall_material = 'cheese' is not allowed"),
            ("material", ["brick"], r"wall_material has the unknown keys \['material'\]: give image and materi"),
        ],
    )
    def test_damaged_ones_are_refused(self, key: str, value: object, message: str, tmp_path: Path) -> None:
        sp.save_map(room(), tmp_path / "map.yaml")
        sheet = yaml.safe_load((tmp_path / "map.yaml").read_text())
        sheet["wall_material"][key] = value
        (tmp_path / "map.yaml").write_text(yaml.safe_dump(sheet))
        with pytest.raises(MapError, match=message):
            sp.load_map(tmp_path / "map.yaml")

    def test_layers_of_a_drawing(self, tmp_path: Path) -> None:
        drawing = ezdxf.new(units=6)
        for layer, corners in {
            "WALL-EXT": [(0, 0), (6, 0), (6, 4), (0, 4), (0, 0)],
            "WALL-INT": [(3, 0), (3, 2)],
        }.items():
            drawing.modelspace().add_lwpolyline(corners, dxfattribs={"layer": layer})
        drawing.saveas(tmp_path / "plan.dxf")
        read = sp.load_map(tmp_path / "plan.dxf", layer_materials={"*-ext": "concrete"})
        row, column = read.cell_index(np.array([[3.01, 1.0], [0.01, 2.0]]))
        assert read.wall_material is not None
        assert read.wall_material[row, column].tolist() == [0, 1]
        with pytest.raises(MapError, match=r"layer_materials\['roof'\] names no layer with walls"):
            sp.load_map(tmp_path / "plan.dxf", layer_materials={"roof": "concrete"})


class TestScene:
    def test_each_wall_reflects_as_its_material_does(self) -> None:
        """A wall of metal brings back more than one of glass, and only where it stands."""
        settings = sp.TraceSettings(frequency_hz=5e9, max_depth=1, diffraction=False, power_tolerance_db=0.0)
        tx, rx = (5.5, 0.0, 1.5), [(7.5, 0.0, 1.5)]
        powers = []
        for material in ("glass", "metal"):
            partial = replace(room(), wall_materials=(CONCRETE, sp.Material.named(material)))
            links = sp.trace_links(partial, tx, rx, trace_settings=settings)
            low = np.abs(links.vertices_m[:, 0, 1] + 0.95) < 0.01
            powers.append((np.abs(links.a[low]).sum(), np.abs(links.a[~low]).sum()))
        assert powers[1][0] > 1.1 * powers[0][0]
        assert powers[1][1] == pytest.approx(powers[0][1], rel=1e-6)


@pytest.mark.usefixtures("short_search")
def test_calibration_finds_what_a_kind_of_wall_lets_through() -> None:
    """Links on either side of a wall through the middle, at 5 GHz; the outer walls are of another material."""
    state = np.zeros((40, 60), dtype=np.uint8)
    state[[0, -1]], state[:, [0, -1, 30]] = 1, 1
    mask = np.zeros(state.shape, dtype=bool)
    mask[:, 30] = True
    outer, inner = sp.Material(2.9, 0.05, 0.02), sp.Material(5.2, 0.15, 0.03)
    truth = sp.PartialMap(state, 0.1, material=outer).with_wall_material(inner, mask)
    settings = sp.TraceSettings(frequency_hz=5e9, max_depth=1, diffraction=False)
    rx = np.array([[x, y, 1.5] for x in (0.7, 1.9, 3.9, 5.1) for y in (0.52, 1.57, 2.63, 3.48)])
    gain_db = sp.trace_links(truth, (1.3, 2.1, 1.5), rx, trace_settings=settings).gain_db
    unknown = replace(truth, wall_materials=(sp.Material(4.5, 0.05, 0.03),))
    found = sp.calibrate_materials(unknown, sp.Measurements((1.3, 2.1, 1.5), rx, gain_db), trace_settings=settings)
    losses = [wall_loss_db(partial.wall_materials[0], 5e9) for partial in (found.scene, truth)]
    assert losses[0] == pytest.approx(losses[1], abs=1.0)
