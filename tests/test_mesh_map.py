"""Meshes on cells: walls without gaps, and what has been observed."""

import re
from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import OBSERVED, box, room, scene_mesh
from scipy import ndimage
from small_maps import states

from sionna_partial.constants import CellState
from sionna_partial.coverage.job import predict_map
from sionna_partial.errors import MapError, SettingsError
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.mesh.cells import MeshReading, cut_to_known, mesh_map
from sionna_partial.maps.mesh.scene_mesh import SceneMesh
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.tracing.trace import trace_links

FREE, WALL, UNKNOWN = (int(state) for state in CellState)
ROOM = scene_mesh(*room().geometry.values())
SIGN = {FREE: ".", WALL: "#", UNKNOWN: "?"}


def drawn(partial: PartialMap) -> str:
    return " ".join("".join(SIGN[int(cell)] for cell in row) for row in partial.state[::-1])


def upright(ends: list[tuple[float, float]], height_m: float = 3.0) -> SceneMesh:
    low = np.array([(x, y, 0.0) for x, y in ends])
    vertices, count = np.concatenate([low, np.add(low, (0, 0, height_m))]), len(low)
    steps = [(i, i + 1) for i in range(count - 1)]
    triangles = [t for a, b in steps for t in ((a, b, b + count), (a, b + count, a + count))]
    return SceneMesh(vertices, triangles, [0] * len(triangles))


class TestState:
    def test_room(self) -> None:
        partial = mesh_map(ROOM, MeshReading(observed=OBSERVED, resolution_m=0.5))
        assert (partial.origin_m, partial.shape) == ((-0.5, -0.5), (11, 13))
        inside = ["?#....##..#??"] * 6
        rows = ["?" * 13, "?" * 13, "?##########??", *inside, "?##########??", "?" * 13]
        assert drawn(partial).split() == rows
        assert partial.is_complete
        assert partial.mesh == ROOM

    def test_unobserved_cells_are_unknown_and_their_mesh_is_gone(self) -> None:
        partial = mesh_map(ROOM, MeshReading(observed=[(0, 0), (2, 0), (2, 4), (0, 4)], resolution_m=0.5))
        assert partial.mesh is not None
        np.testing.assert_allclose(partial.mesh.bounds_m, [[0, 0, 0], [2, 4, 3]], atol=1e-12)
        assert partial.height_range_m == (0.0, 3.0)
        columns = np.nonzero((partial.state != UNKNOWN).any(axis=0))[0]
        assert (columns.min(), columns.max()) == (1, 4)

    def test_observed_by_another_map(self) -> None:
        state = np.full((4, 2), UNKNOWN)
        state[:, 0] = FREE
        other = PartialMap(state, 1.0, (1.0, 0.0))
        partial = mesh_map(ROOM, MeshReading(observed=other, resolution_m=0.25))
        y, x = np.nonzero(partial.state != UNKNOWN)
        low, high = np.array([x.min(), y.min()]) * 0.25 - 0.25, np.array([x.max(), y.max()]) * 0.25
        np.testing.assert_allclose([low, high], [[1, 0], [2, 4]])
        nothing = mesh_map(ROOM, MeshReading(observed=PartialMap(np.full((2, 2), UNKNOWN), 1.0)))
        assert (nothing.state == UNKNOWN).all()
        assert nothing.mesh is not None
        assert len(nothing.mesh.triangles) == 0

    def test_height_band(self) -> None:
        table = scene_mesh(box((0, 0, 0), (5, 4, 3)), box((2.1, 2.1, 0.6), (2.9, 2.9, 0.7)))
        low, high = (
            mesh_map(table, MeshReading(height_band_m=band, observed=OBSERVED, resolution_m=0.5))
            for band in ((0.5, 0.8), (1.0, 1.8))
        )
        assert (low.state == WALL).sum() - (high.state == WALL).sum() == 4
        touching = mesh_map(table, MeshReading(height_band_m=(0.0, 3.0), observed=OBSERVED, resolution_m=0.5))
        assert touching == mesh_map(table, MeshReading(height_band_m=(0.5, 0.8), observed=OBSERVED, resolution_m=0.5))

    def test_wall_that_ends_on_a_lattice_line_does_not_reach_over_it(self) -> None:
        partial = mesh_map(upright([(0.0, 0.25), (1.0, 0.25)]), MeshReading(resolution_m=0.5))
        assert drawn(partial) == "????? ?##?? ?????"

    @pytest.mark.parametrize("noise", [0.0, 1e-7, -1e-7])
    def test_wall_along_a_lattice_line_is_above_it(self, noise: float) -> None:
        partial = mesh_map(upright([(0.25, 1.0 + noise), (1.75, 1.0 - noise)]), MeshReading(resolution_m=0.5))
        rows = np.nonzero((partial.state == WALL).any(axis=1))[0]
        np.testing.assert_array_equal(rows * 0.5 + partial.origin_m[1], [1.0])

    @pytest.mark.filterwarnings("ignore:the mesh has no floor")
    @settings(max_examples=60)
    @given(
        st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), min_size=2, max_size=5),
        st.sampled_from([0.0, 1e-7, 1e-6, 1e-3]),
        st.integers(0, 9),
    )
    def test_walls_have_no_gaps(self, ends: list[tuple[int, int]], noise_m: float, seed: int) -> None:
        corners = np.array(ends) * 0.25 + np.random.default_rng(seed).normal(0.0, noise_m, (len(ends), 2))
        if (np.abs(np.diff(corners, axis=0)).max(axis=1) < 0.1).any():
            return
        partial = mesh_map(upright(corners.tolist()), MeshReading(resolution_m=0.5))
        _, parts = ndimage.label(partial.state == WALL, np.ones((3, 3)))
        assert parts == 1

    @settings(max_examples=30)
    @given(st.integers(0, 2**32 - 1))
    def test_cells_are_those_that_surfaces_reach(self, seed: int) -> None:
        vertices = np.random.default_rng(seed).uniform(0, 3, (9, 3))
        mesh = SceneMesh(vertices, np.arange(9).reshape(3, 3), [0, 0, 0])
        partial = mesh_map(mesh, MeshReading(resolution_m=0.25))
        rows, columns = np.indices(partial.shape)
        x, y = (index * 0.25 + start for index, start in zip((columns, rows), partial.origin_m, strict=True))
        cells = shapely.box(x, y, x + 0.25, y + 0.25)
        seen = shapely.union_all(shapely.polygons(mesh.corners_m[..., :2]))
        reached = shapely.area(shapely.intersection(cells, seen)) > 1e-7
        known = partial.state != UNKNOWN
        assert reached[known].all()
        rims, inside = np.pad(reached & ~known, 1), np.ones((3, 3))
        assert not ndimage.binary_erosion(rims, inside).any()

    def test_rims_of_the_floor_beyond_the_walls_are_not_rooms(self) -> None:
        walls = trimesh.creation.box(
            (4.0, 3.0, 2.5), transform=trimesh.transformations.translation_matrix((0, 0, 1.25))
        )
        walls.update_faces(np.abs(walls.face_normals[:, 2]) < 0.5)
        floor = trimesh.creation.box((4.4, 3.4, 0.01))
        both = trimesh.util.concatenate([walls, floor])
        mesh = SceneMesh(both.vertices, both.faces, np.zeros(len(both.faces), int))
        assert mesh_map(mesh, MeshReading(resolution_m=0.05)).is_complete


class TestKnown:
    def test_maps_whose_lattice_is_not_on_multiples(self) -> None:
        cut = cut_to_known(PartialMap(np.zeros((3, 3), int), 0.5, (1.1, 0.7), mesh=ROOM))
        assert cut.mesh is not None
        np.testing.assert_allclose(cut.mesh.bounds_m, [[1.1, 0.7, 0], [2.6, 2.2, 3]], atol=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"up": "x"}, 'up = \'x\' is not allowed: choose "z", "y", "-z" or "-y".'),
        ({"height_band_m": (2, 1)}, "height_band_m = (2, 1) is not allowed: give (low, high), z in metres, low <"),
        ({"observed": [(0, 0), (1, 1), (1, 0), (0, 1)]}, "] is no polygon (Self-intersection"),
        ({"observed": [(9, 9), (10, 9), (9, 10)]}, "observed holds no cell of the map, which spans x -0.05 to 5.1 m"),
    ],
)
def test_refused(given: dict, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(MapError, match=re.escape(message)):
        mesh_map(ROOM, MeshReading(**given))


@pytest.mark.parametrize(("factor", "end"), [(100, "or give the height_band_m of the walls"), (0.001, "kilometres")])
def test_other_units_than_metres(factor: float, end: str) -> None:
    scaled = SceneMesh(ROOM.vertices_m * factor, ROOM.triangles, ROOM.material)
    with pytest.raises(MapError, match=r"the mesh spans .* m: give unit_m, the length of its unit.*" + re.escape(end)):
        mesh_map(scaled, MeshReading(resolution_m=1.0))
    if factor > 1:
        assert mesh_map(scaled, MeshReading(resolution_m=1.0, height_band_m=(1.0, 2.0))).state.any()


def test_feet() -> None:
    """A house of two storeys in feet, and a hall of the same height in metres."""
    house = scene_mesh(box((0, 0, 0), (40, 30, 8.5)), box((0, 0, 9.5), (40, 30, 18)))
    with pytest.warns(MapWarning, match=r"the mesh spans 40 x 30 m, with a storey of 8.5 m, as if it were in feet"):
        mesh_map(house, MeshReading(resolution_m=0.5))
    partial = mesh_map(house, MeshReading(resolution_m=0.1, unit_m=0.3048))
    assert partial.height_range_m == pytest.approx((0.0, 18 * 0.3048))
    assert partial.bounds_m[2] == pytest.approx(40 * 0.3048, abs=0.21)
    mesh_map(scene_mesh(box((0, 0, 0), (12, 8, 9))), MeshReading(resolution_m=0.5))
    mesh_map(house, MeshReading(resolution_m=0.5), is_metric=True)  # as scenes of Mitsuba are


def test_receivers_are_between_the_ends_of_the_mesh() -> None:
    lifted = SceneMesh(np.add(ROOM.vertices_m, (0, 0, 7.0)), ROOM.triangles, ROOM.material)
    partial = mesh_map(lifted, MeshReading())
    assert partial.height_range_m == (7.0, 10.0)
    np.testing.assert_array_equal(partial.state, mesh_map(ROOM, MeshReading()).state)
    with pytest.raises(SettingsError, match=r"rx_height_m = 1.5 is not allowed: give a number in \(7, 10\]"):
        predict_map(partial, (1.0, 1.0, 8.5), rx_height_m=1.5)


REPORTS = Path(__file__).parent / "reports"


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_scans_whose_y_points_down(suffix: str) -> None:
    """The door of the flat is at y = 2.05 m, as with z up, and not mirrored to -2.05 m."""
    path = REPORTS / "upside_down" / f"y_down.{suffix}"
    with pytest.warns(MapWarning, match='looks as if -y pointed up.*: give up="-y" to turn it'):
        load_map(path)
    right, found = load_map(REPORTS / "upside_down" / "z_up.ply"), load_map(path, up="-y")
    assert states(found, (0.02, 2.05), (0.02, -2.05)) == [FREE, WALL]
    assert found.import_report.free_area_m2 == pytest.approx(right.import_report.free_area_m2)
    np.testing.assert_allclose(found.mesh.bounds_m, right.mesh.bounds_m, atol=1e-6)


@pytest.mark.parametrize("lean_deg", [2, 5])
def test_leaning_scans_are_levelled(lean_deg: int) -> None:
    with pytest.warns(MapWarning, match=rf"leans by {lean_deg}\.0 degrees, and is levelled about its middle"):
        partial = load_map(REPORTS / "leaning" / f"lean{lean_deg}_mesh.ply")
    assert 158.0 <= partial.import_report.free_area_m2 <= 161.0
    assert np.ptp(partial.mesh.height_range_m) == pytest.approx(2.8, abs=0.01)  # with floor and ceiling of 0.1 m


def test_scans_that_lean_too_far(tmp_path: Path) -> None:
    scan = trimesh.load(REPORTS / "leaning" / "lean5_mesh.ply")
    up = scan.face_normals[np.argmax(scan.area_faces)]
    axis = np.cross((0.0, 0.0, 1.0), up * np.sign(up[2]))
    scan.apply_transform(trimesh.transformations.rotation_matrix(np.radians(10.0), axis))
    scan.export(tmp_path / "scan.ply")
    with pytest.raises(
        MapError, match=r"leans by 15\.0 degrees, so that its floor is not level: turn it in the program"
    ):
        load_map(tmp_path / "scan.ply")


def test_roofs_are_no_lean(tmp_path: Path) -> None:
    """Both slopes of a roof have more area than the floor, but walls are upright."""
    corners = [(0, 0, 0), (10, 0, 0), (10, 8, 0), (0, 8, 0), *((x, y, 2.5) for x in (0, 10) for y in (0, 8))]
    corners += [(0, 8, 5.5), (10, 8, 5.5)]
    faces = [
        (0, 1, 2),
        (0, 2, 3),
        (4, 6, 9),
        (4, 9, 8),
        (0, 1, 6),
        (0, 6, 4),
        (3, 2, 7),
        (3, 7, 5),
        (5, 7, 9),
        (5, 9, 8),
    ]
    trimesh.Trimesh(corners, faces, process=False).export(tmp_path / "roof.ply")
    mesh = load_map(tmp_path / "roof.ply").mesh
    np.testing.assert_allclose(mesh.bounds_m, [[0, 0, 0], [10, 8, 5.5]], atol=1e-6)


def test_walls_without_a_floor() -> None:
    """Space between them is observed, as with a floor."""
    with pytest.warns(MapWarning, match="has no floor, so that all space between its walls is observed: give its obs"):
        alone = load_map(REPORTS / "walls_alone" / "walls.ply")
    floor = load_map(REPORTS / "walls_alone" / "walls_and_floor.ply")
    assert alone.import_report.free_area_m2 == floor.import_report.free_area_m2 == pytest.approx(43.8, abs=0.1)
    rx, gain_db = [(6.0, 3.0, 1.5), (2.0, 4.5, 1.5), (6.0, 5.0, 1.5)], [-89.6, -70.5, -75.7]
    found = trace_links(alone, (2.0, 1.5, 1.5), rx)
    assert found.gain_db == pytest.approx(gain_db, abs=0.8)  # without the reflection at the floor


def test_triangle_strips() -> None:
    with pytest.raises(MapError, match=r"tristrips.ply' holds triangle strips, which are not read: save it with faces"):
        load_map(REPORTS / "strips" / "tristrips.ply")
