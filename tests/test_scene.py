"""Scenes: literal geometry, files on disk, and what stock Sionna RT makes of them."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from extruded import drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import OBSERVED, room
from numpy.typing import NDArray

from sionna_partial.constants import CellState
from sionna_partial.llvm import load_llvm
from sionna_partial.maps.environment import FAR_M
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.mesh.cells import MeshReading, mesh_map
from sionna_partial.maps.mesh.scene_mesh import merged_mesh
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.export import export_scene
from sionna_partial.scene.scene import build_scene, scene_settings_of, write_scene
from sionna_partial.settings import ITU_BANDS_GHZ, Material, SceneSettings
from sionna_partial.worlds.homes import make_home

ROOM = """
    ????????????
    ?##########?
    ?#........#?
    ?#........#?
    ?#........#?
    ?#........??
    ?#####.####?
    ????????????
"""


def test_a_material_that_is_not_used_is_named(caplog: pytest.LogCaptureFixture) -> None:
    brick, plan = SceneSettings(material=Material(itu="brick")), drawn(ROOM)
    build_scene(replace(plan, material=Material(itu="brick")), brick)
    assert not caplog.messages
    scene_settings_of(replace(plan, material=Material(itu="wood")), brick)
    assert "is not used: the map or mesh has its own; leave it out" in caplog.text


def covered(rectangles_m: NDArray[np.float64], partial: PartialMap) -> NDArray[np.int_]:
    count = np.zeros(partial.shape, dtype=int)
    for x0, y0, x1, y1 in np.rint(rectangles_m / partial.resolution_m).astype(int):
        count[y0:y1, x0:x1] += 1
    return count


def mesh(folder: Path, name: str) -> trimesh.Trimesh:
    return trimesh.load(folder / "meshes" / f"{name}.ply", process=False)


def load(folder: Path):  # type: ignore[no-untyped-def]
    load_llvm()
    import sionna.rt

    return sionna.rt.load_scene(str(folder / "scene.xml"), merge_shapes=False)


def test_floor_covers_free_cells_and_the_walls_they_touch() -> None:
    partial = drawn("?????? ?###?? ?#.#?? ?#..?? ??#?## ??????")
    floor = covered(build_scene(partial).floor_m, partial)
    expected = drawn("?????? ?###?? ?###?? ?###?? ??#?#? ??????").state == CellState.WALL
    np.testing.assert_array_equal(floor, expected)


@pytest.mark.parametrize(
    ("text", "ends"),
    [
        # A wall between two rooms that stops at a door: jambs are ends of the wall.
        ("........ ###..### ........", {(2.5, 1.5): False, (5.5, 1.5): False, (0.0, 1.5): True, (8.0, 1.5): True}),
        # The same wall, seen in part: what lies beyond its end may be more of it.
        ("........ ###????? ........", {(3.0, 1.5): True, (0.0, 1.5): True}),
        (".#. .#. .#. .?. ...", {(1.5, 2.0): True, (1.5, 5.0): True}),
        # Where two walls meet there is no end.
        ("..... .###. .#... .#... .....", {(1.5, 3.5): False, (3.5, 3.5): False, (1.5, 1.5): False}),
    ],
    ids=["door", "half seen", "upright half seen", "corner"],
)
def test_open_ends(text: str, ends: dict[tuple[float, float], bool]) -> None:
    geometry = build_scene(drawn(text, 1.0))
    found = dict(zip(map(tuple, geometry.vertices_m.tolist()), geometry.open_end.tolist(), strict=True))
    assert found == ends


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 15), st.integers(1, 15))
def test_floor_and_its_triangles_cover_the_observed_area_once(seed: int, ny: int, nx: int) -> None:
    state = np.random.default_rng(seed).choice(3, (ny, nx)).astype(np.uint8)
    partial = PartialMap(state, 0.1)
    geometry = build_scene(partial)
    count = covered(geometry.floor_m, partial)
    assert count.max(initial=0) <= 1
    assert (count[state == CellState.FREE] == 1).all()
    assert (count[state == CellState.UNKNOWN] == 0).all()
    corners, triangles = geometry.floor_mesh
    (ax, ay), (bx, by), (cx, cy) = (corners[triangles[:, k]].T for k in range(3))
    areas = ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay)) / 2
    assert (areas > 0.004).all()
    assert areas.sum() == pytest.approx(count.sum() * 0.01)


def test_floor_triangles_share_whole_edges(tmp_path: Path) -> None:
    """The only free edges are the rim of the area, and diffraction sees no other."""
    partial = drawn("...... .?.... .?..?. ...... ??....")
    write_scene(build_scene(partial), tmp_path, offset_m=(0.0, 0.0))
    floor = mesh(tmp_path, "floor")
    edges, counts = np.unique(floor.edges_sorted, axis=0, return_counts=True)
    rim = floor.vertices[edges[counts == 1]]
    length = np.linalg.norm(rim[:, 0] - rim[:, 1], axis=1).sum()
    free = np.pad(partial.state == CellState.FREE, 1).astype(int)
    assert length == pytest.approx(0.5 * (np.abs(np.diff(free, axis=0)).sum() + np.abs(np.diff(free, axis=1)).sum()))


def test_meshes_stand_where_the_map_is(tmp_path: Path) -> None:
    partial = drawn(ROOM, origin_m=(-10.0, 20.0))
    folder = export_scene(partial, tmp_path / "scene")
    walls, floor, ceiling = (mesh(folder, name) for name in ("walls", "floor", "ceiling"))
    np.testing.assert_allclose(walls.bounds, [[-9.25, 20.75, 0.0], [-4.75, 23.25, 3.0]])
    np.testing.assert_allclose(floor.bounds, [[-9.5, 20.5, 0.0], [-4.5, 23.5, 0.0]])
    np.testing.assert_allclose(ceiling.bounds, [[-9.5, 20.5, 3.0], [-4.5, 23.5, 3.0]])
    assert (floor.face_normals[:, 2] > 0.99).all()
    assert (ceiling.face_normals[:, 2] < -0.99).all()
    assert (np.abs(walls.face_normals[:, 2]) < 1e-6).all()


@pytest.mark.parametrize(
    ("text", "settings", "names"),
    [
        ("??? ???", SceneSettings(), set()),
        ("...", SceneSettings(), {"floor", "ceiling"}),
        ("#", SceneSettings(), {"walls"}),
        (ROOM, SceneSettings(ceiling=False), {"walls", "floor"}),
    ],
    ids=["nothing", "no walls", "no floor", "no ceiling"],
)
def test_scenes_without_some_shapes_load(text: str, settings: SceneSettings, names: set[str], tmp_path: Path) -> None:
    folder = export_scene(drawn(text), tmp_path / "scene", settings)
    scene = load(folder)
    assert set(scene.objects) == names
    assert {path.stem for path in (folder / "meshes").iterdir()} == names


def test_every_itu_material_loads_with_its_constants(tmp_path: Path) -> None:
    for name, bands in ITU_BANDS_GHZ.items():
        frequency_hz = float(np.clip(28.0, *bands[0])) * 1e9
        chosen = SceneSettings(material=Material(itu=name, thickness_m=0.07))
        scene = load(export_scene(drawn(ROOM), tmp_path / name, chosen, frequency_hz=frequency_hz))
        from sionna.rt.radio_materials.itu import itu_material

        scene.frequency = frequency_hz
        (material,) = scene.radio_materials.values()
        permittivity, conductivity = itu_material(name, frequency_hz)
        assert material.relative_permittivity.numpy() == pytest.approx(float(permittivity), rel=1e-5)
        assert material.conductivity.numpy() == pytest.approx(float(conductivity), rel=1e-4, abs=1e-12)
        assert material.thickness.numpy() == pytest.approx(0.07)


def test_same_bytes_twice_and_relative_paths(tmp_path: Path) -> None:
    first, second = (export_scene(drawn(ROOM), tmp_path / name) for name in ("one", "two"))
    files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert len(files) == 6
    for file in files:
        assert (first / file).read_bytes() == (second / file).read_bytes()
    names = [node.get("value") for node in ET.parse(first / "scene.xml").iterfind(".//string[@name='filename']")]
    assert names == ["meshes/walls.ply", "meshes/floor.ply", "meshes/ceiling.ply"]


@pytest.mark.parametrize("origin_m", [(-FAR_M, 0.0), (500_000.3, 4_500_000.7)])
def test_far_maps_are_moved_to_the_origin(origin_m: tuple[float, float], tmp_path: Path) -> None:
    folder = export_scene(drawn(ROOM, origin_m=origin_m), tmp_path / "scene")
    offset = yaml.safe_load((folder / "map.yaml").read_text())["scene_offset"]
    far = max(origin_m) > FAR_M
    assert offset == list(origin_m if far else (0.0, 0.0))
    here = mesh(export_scene(drawn(ROOM), tmp_path / "here"), "walls")
    shift = np.subtract(origin_m, offset)
    np.testing.assert_allclose(mesh(folder, "walls").vertices - [*shift, 0.0], here.vertices, atol=1e-4)
    assert load_map(folder).origin_m == pytest.approx(origin_m)


class TestMeshScene:
    WOOD = Material(itu="wood", thickness_m=0.05)

    def partial(self, shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PartialMap:
        walls, inner = room().geometry.values()
        vertices = np.concatenate([walls.vertices, inner.vertices]) + shift_m
        triangles = np.concatenate([walls.faces, inner.faces + len(walls.vertices)])
        material = np.repeat([2, 0], 12)
        whole = merged_mesh(vertices, triangles, material, (None, Material(), self.WOOD))
        corners = np.add(OBSERVED, shift_m[:2])
        return mesh_map(whole, MeshReading(observed=corners, resolution_m=0.1))

    @pytest.mark.parametrize(
        "shift_m", [(500_000.3, 4_500_000.7, 0.25), (0.1, 0.2, 2240.7), (-9000.3, -998.2, -1001.6)]
    )
    def test_reading_back_gives_the_same_map(self, tmp_path: Path, shift_m: tuple[float, float, float]) -> None:
        partial = self.partial(shift_m)
        folder = export_scene(partial, tmp_path / "scene")
        assert load_map(folder) == load_map(folder / "map.yaml") == load_map(folder / "scene.xml") == partial
        assert load_map(folder, wall_height_m=5.0).height_range_m[1] == pytest.approx(shift_m[2] + 5.0)
        assert np.abs(mesh(folder, "part0").vertices).max() <= FAR_M

    def test_material_of_the_map_is_that_of_parts_without_one(self, tmp_path: Path) -> None:
        partial = replace(self.partial(), material=Material(thickness_m=0.2))
        folder = export_scene(partial, tmp_path / "scene", SceneSettings(Material(thickness_m=0.3)))
        thickness_m = {m.name: float(m.thickness[0]) for m in load(folder).radio_materials.values()}
        assert thickness_m == pytest.approx({"material0": 0.2, "material2": 0.05})
        assert load_map(folder) == partial


def test_floors_whose_holes_touch_in_chains_are_triangulated_in_strips():
    """Walls on cells of a turned floor meet at corners only, and GEOS finds no triangles of what is around them."""
    geometry = build_scene(make_home(220097, "floor"))
    area_m2 = np.prod(geometry.floor_m[:, 2:] - geometry.floor_m[:, :2], axis=1).sum()
    corners_m, triangles = geometry.floor_mesh
    (x0, y0), (x1, y1), (x2, y2) = corners_m[triangles].transpose(1, 2, 0)
    assert 0.5 * ((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)).sum() == pytest.approx(area_m2)
