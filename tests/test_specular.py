"""Reflections off floor and ceiling against the textbook image method, and faces against the files on disk."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from extruded import ROOM, extrude, specular_blocks, specular_lengths_m
from numpy.typing import NDArray

from sionna_partial.scene.scene import SHAPES, SceneGeometry, write_scene
from sionna_partial.tracing.candidates import EDGE, Candidates
from sionna_partial.tracing.plan.specular import CEILING, DIFFRACTED, FLOOR, faces_of

TX = np.array([1.1, 0.7, 1.2])
RX = np.array([[2.3, 3.1, 2.1], [4.7, 1.2, 0.4]])
PARTS = {
    "floor and ceiling": extrude(ROOM),
    "floor": extrude(ROOM, ceiling=False),
    "neither": extrude(ROOM, floor_m=()),
}


def _candidates(
    geometry: SceneGeometry, tx: NDArray[np.float64] = TX, rx: NDArray[np.float64] = RX, max_depth: int = 3
) -> Candidates:
    ((candidates, share),) = specular_blocks(geometry, tx, rx, max_depth)
    assert share == 1.0
    return candidates


def _kind(geometry: SceneGeometry, face: int) -> str:
    """Letter of the surface that a face is a part of."""
    if face >= geometry.ceiling_face >= 0:
        return "c"
    return "f" if face >= geometry.floor_face >= 0 else "w"


def _points(candidates: Candidates, row: int, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> NDArray[np.float64]:
    vertices = candidates.vertices_m[row, candidates.face[row] != -1]
    return np.concatenate([tx[None], vertices, rx[candidates.rx[row]][None]])


def _length_m(points: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _normal(geometry: SceneGeometry, face: int) -> NDArray[np.float64]:
    if _kind(geometry, face) != "w":
        return np.array([0.0, 0.0, 1.0])
    x, y = np.diff(geometry.walls_m[face // 2], axis=0)[0]
    return np.array([y, -x, 0.0]) / np.hypot(x, y)


class TestSpecularCandidates:
    def test_floor_and_ceiling_reflections_have_the_unfolded_lengths(self) -> None:
        tx, rx, height = np.array([0.0, 0.0, 1.0]), np.array([[4.0, 0.0, 2.0]]), 3.0
        geometry = extrude([[(-5.0, 2.0), (9.0, 2.0)]], height_m=height)
        candidates = _candidates(geometry, tx, rx)
        lengths = {}
        for row, face in enumerate(candidates.face):
            key = "".join(_kind(geometry, each) for each in face if each != -1)
            lengths[key] = _length_m(_points(candidates, row, tx, rx))
        climb = {"f": tx[2] + rx[0, 2], "c": 2 * height - 3.0, "fc": 2 * height - 1.0, "cf": 2 * height + 1.0, "": 1.0}
        climb |= {"fcf": 2 * height + 3.0, "cfc": 4 * height - 3.0}
        for reflections in climb:
            assert lengths[reflections] == pytest.approx(np.hypot(4.0, climb[reflections]))
        walled = {key: length for key, length in lengths.items() if "w" in key}
        assert len(walled) == 1 + 2 + 2
        for key, length in walled.items():
            assert length == pytest.approx(np.hypot(np.hypot(4.0, 4.0), climb[key.replace("w", "")]))

    @pytest.mark.parametrize("name", PARTS)
    def test_finds_the_paths_of_the_image_method_and_no_other(self, name: str) -> None:
        geometry = PARTS[name]
        candidates = _candidates(geometry)
        for index, place in enumerate(RX):
            rows = np.flatnonzero(candidates.rx == index)
            lengths = np.sort([_length_m(_points(candidates, row, TX, RX)) for row in rows])
            expected = specular_lengths_m(geometry, TX, place, 3)
            assert len(expected) > 0
            np.testing.assert_allclose(lengths, expected)

    def test_reflections_obey_the_law_of_reflection(self) -> None:
        geometry = PARTS["floor and ceiling"]
        candidates = _candidates(geometry, max_depth=4)
        assert len(candidates.rx) > 100
        for row, face in enumerate(candidates.face):
            direction = np.diff(_points(candidates, row, TX, RX), axis=0)
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            for number, before, after in zip(face, direction[:-1], direction[1:], strict=False):
                normal = _normal(geometry, number)
                np.testing.assert_allclose(after, before - 2 * np.dot(before, normal) * normal, atol=1e-9)

    def test_blocks_together_hold_what_one_block_holds(self) -> None:
        geometry = PARTS["floor and ceiling"]
        whole = _candidates(geometry)
        parts, shares = zip(*specular_blocks(geometry, TX, RX, 3, pairs_at_once=3), strict=True)
        assert len(parts) > 3
        assert list(shares) == sorted(shares)
        assert shares[-1] == 1.0
        for name in ("rx", "face", "vertices_m"):
            np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))

    def test_without_walls_floor_and_ceiling_remain(self) -> None:
        geometry = extrude(np.zeros((0, 2, 2)))
        assert (geometry.floor_face, geometry.ceiling_face) == (0, 2)
        candidates = _candidates(geometry, max_depth=2)
        faces = [tuple(face) for face in candidates.face[candidates.rx == 0].tolist()]
        assert faces == [(-1, -1), (0, -1), (2, -1), (0, 2), (2, 0)]


class TestFacesOf:
    def test_names_each_surface_by_its_first_face(self) -> None:
        geometry = extrude(ROOM, floor_m=((0, 0, 6, 4), (6, 1, 7, 2)))
        surface = np.array([[0, 5, FLOOR], [CEILING, DIFFRACTED, -1]], dtype=np.int32)
        triangles = len(geometry.floor_mesh[1])
        assert triangles > 2
        faces = faces_of(surface, geometry)
        assert faces.tolist() == [[0, 10, 12], [12 + triangles, EDGE, -1]]
        assert faces.dtype == np.int32

    @pytest.mark.parametrize("name", PARTS)
    def test_faces_count_through_the_files(self, name: str, tmp_path: Path) -> None:
        geometry = PARTS[name]
        write_scene(geometry, tmp_path, offset_m=(0.0, 0.0))
        files = [tmp_path / "meshes" / f"{shape}.ply" for shape in SHAPES]
        meshes = [trimesh.load(file, process=False) for file in files if file.exists()]
        corners = np.concatenate([mesh.triangles for mesh in meshes])
        assert len(files) - len(meshes) == {"floor and ceiling": 0, "floor": 1, "neither": 2}[name]
        for wall, ends in enumerate(geometry.walls_m):
            seen = {tuple(corner) for corner in corners[2 * wall : 2 * wall + 2, :, :2].reshape(-1, 2).tolist()}
            assert seen == {tuple(end) for end in ends.tolist()}
        count = len(geometry.floor_mesh[1])
        for first, height in ((geometry.floor_face, 0.0), (geometry.ceiling_face, geometry.height_m)):
            if first >= 0:
                assert (corners[first : first + count, :, 2] == height).all()
        assert len(corners) == 12 + count * ((geometry.floor_face >= 0) + (geometry.ceiling_face >= 0))
