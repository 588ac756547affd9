import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from sionna_partial.tracing.mesh.faces import (
    PLANE_TOLERANCE_M,
    MeshPlanes,
    face_at,
    face_tree,
    faces_between,
    group_planes,
    scratch,
)


def planes_of(mesh: trimesh.Trimesh) -> MeshPlanes:
    return group_planes(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def fine_box() -> trimesh.Trimesh:
    return trimesh.creation.box((8, 6, 3)).subdivide().subdivide()


def looked_up(planes: MeshPlanes, plane: NDArray[np.int32], points: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.array([face_at(planes.bins, p, *point) for p, point in zip(plane, points, strict=True)])


class TestGroupPlanes:
    def test_sides_of_a_face_are_one_plane(self) -> None:
        corners = np.array([[0, 0, 0], [1, 0, 1], [0, 1, 2], [5, 5, 15]], float)
        assert len(group_planes(corners, np.array([[0, 1, 2], [2, 1, 0], [0, 3, 1]])).normal) == 1

    @pytest.mark.parametrize(("gap_m", "count"), [(0.5 * PLANE_TOLERANCE_M, 1), (5 * PLANE_TOLERANCE_M, 2)])
    def test_planes_closer_than_the_tolerance_are_one(self, gap_m: float, count: int) -> None:
        mesh = fine_box()
        up = mesh.vertices[mesh.faces].mean(axis=1)[:, 2] > 1.499
        sheet = trimesh.Trimesh(mesh.vertices, mesh.faces[up])
        pair = trimesh.util.concatenate([sheet, sheet.copy().apply_translation((0, 0, gap_m))])
        assert len(planes_of(pair).normal) == count

    def test_nearly_all_noisy_faces_are_planes_of_their_own(self) -> None:
        mesh = fine_box()
        noise = np.random.default_rng(0).normal(0.0, 0.01, mesh.vertices.shape)
        planes = planes_of(trimesh.Trimesh(mesh.vertices + noise, mesh.faces))
        assert len(planes.normal) > 0.98 * len(mesh.faces)

    def test_faces_of_no_area_are_on_no_other_plane(self) -> None:
        corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], float)
        planes = group_planes(corners, np.array([[0, 1, 3], [0, 1, 2], [1, 1, 1]]))
        assert np.bincount(planes.plane)[planes.plane[1]] == 1


class TestFaceAt:
    def test_long_thin_faces(self) -> None:
        """A fan across a plane, as triangulation of a floor makes it."""
        angle = np.linspace(0.1, 1.4, 200)
        corners = np.column_stack([9 * np.cos(angle), 9 * np.sin(angle), np.zeros(200)])
        triangles = np.column_stack([np.zeros(199, int), np.arange(1, 200), np.arange(2, 201)])
        planes = group_planes(np.concatenate([np.zeros((1, 3)), corners]), triangles)
        middle = (corners[:-1] + corners[1:]) / 3
        np.testing.assert_array_equal(looked_up(planes, planes.plane, middle), np.arange(199))
        assert len(planes.bins.face) < 199 * 60

    def test_holes_and_surroundings_hold_no_face(self) -> None:
        corners = np.array([[0, 0], [1, 0], [0, 1], [5, 5], [5, 4], [4, 5]], float)
        planes = group_planes(np.column_stack([np.ones(6), corners]), np.array([[0, 1, 2], [3, 4, 5]]))
        points = np.array([[1, 2.5, 2.5], [1, -1, 0.2], [1, 7, 7], [1, 0.51, 0.51], [1, 0.5004, 0.5004], [1, 4.8, 4.8]])
        assert looked_up(planes, np.zeros(6, np.int32), points).tolist() == [-1, -1, -1, -1, 0, 1]


def test_faces_between_points_are_those_of_brute_force() -> None:
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, 1.0)
    ends = rng.uniform(-1.2, 1.2, (200, 2, 3))
    planes = group_planes(np.asarray(ball.vertices), np.asarray(ball.faces))
    tree, met = face_tree(np.asarray(ball.triangles), planes.plane), scratch()
    for a, b in ends:
        count = faces_between(tree, a, b, -1, -1, met)
        inside = (np.linalg.norm([a, b], axis=1) < 0.97).sum()
        points = a + met.at[:count, None] * (b - a)
        assert np.allclose(np.linalg.norm(points, axis=1), 1.0, atol=0.03)
        assert (np.diff(met.at[:count]) > 0.0).all()
        assert (
            count == {0: count // 2 * 2, 1: 1, 2: 0}[int(inside)]
            or np.abs(np.linalg.norm([a, b], axis=1) - 0.985).min() < 0.016
        )
