"""Rays against geometry and Sionna RT, and the sequences of planes that they meet."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_rays import TURN, joined, load_meshes, shapes_of

from sionna_partial.tracing.mesh import sequences as module
from sionna_partial.tracing.mesh.faces import MeshPlanes, group_planes
from sionna_partial.tracing.mesh.sequences import Rays, Sequences, collect_sequences, shoot_rays, view_sequences

TX = np.array([0.3, -0.2, 0.1])


def shoot(folder: Path, *meshes: trimesh.Trimesh, count: int = 2000, max_depth: int = 3) -> Rays:
    scene = load_meshes(folder, *meshes)
    parts = list(shoot_rays(scene.mi_scene, shapes_of(scene, len(meshes)), TX, count, max_depth))
    return Rays(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def points(rays: Rays, depth: int) -> np.ndarray:
    """Where the rays met their faces (R, depth, 3)."""
    steps = rays.leg_m[:, :depth, None].astype(float) * rays.direction[:, :depth]
    return TX + np.cumsum(steps, axis=1)


def box_planes() -> MeshPlanes:
    mesh = trimesh.creation.box((8, 6, 3))
    return group_planes(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def rays_along(face: list[list[int]], leg_m: list[list[float]]) -> Rays:
    """Rays with given faces and lengths; all legs go up."""
    up = np.broadcast_to(np.float32([0.0, 0.0, 1.0]), (len(leg_m), len(leg_m[0]), 3))
    return Rays(np.array(face, np.int32), np.array(leg_m, np.float32), up)


def sequence_planes(sequences: Sequences, node: int) -> list[int]:
    before = sequence_planes(sequences, int(sequences.parent[node])) if sequences.parent[node] >= 0 else []
    return [*before, int(sequences.plane[node])]


class TestShootRays:
    def test_faces_are_counted_through_the_shapes(self, tmp_path: Path) -> None:
        meshes = trimesh.creation.icosphere(2, 0.3), trimesh.creation.box((8, 6, 3))
        meshes[0].apply_translation((-1.0, 1.0, 0.5))
        meshes[1].apply_transform(TURN)
        rays = shoot(tmp_path, *meshes)
        vertices, triangles = joined(*meshes)
        normal = trimesh.Trimesh(vertices, triangles, process=False).face_normals
        assert len(np.unique(rays.face)) > 20
        away = ((points(rays, 3) - vertices[triangles[rays.face, 0]]) * normal[rays.face]).sum(axis=2)
        np.testing.assert_allclose(away, 0.0, atol=1e-3)  # Mitsuba moves a ray off its face
        before, after = rays.direction[:, :3], rays.direction[:, 1:]
        mirrored = before - 2.0 * (before * normal[rays.face]).sum(axis=2)[:, :, None] * normal[rays.face]
        np.testing.assert_allclose(after, mirrored, atol=1e-5)

    def test_directions_are_those_of_sionna_rt(self, tmp_path: Path) -> None:
        rays = shoot(tmp_path, trimesh.creation.box((8, 6, 3)), max_depth=0)
        import mitsuba as mi
        from sionna.rt.utils import fibonacci_lattice

        stock = mi.warp.square_to_uniform_sphere(fibonacci_lattice(2000)).numpy().T
        np.testing.assert_allclose(rays.direction[:, 0], stock, atol=1e-6)

    def test_parts_join_to_the_same_bytes(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        box = trimesh.creation.box((8, 6, 3))
        whole = shoot(tmp_path, box)
        monkeypatch.setattr(module, "_RAYS_PER_CHUNK", 300)
        for one, other in zip(whole, shoot(tmp_path, box), strict=True):
            assert one.tobytes() == other.tobytes()


class TestCollectChains:
    def test_as_many_chains_as_there_are(self) -> None:
        """More than the arrays hold at first, and the same for rays in parts."""
        planes = box_planes()
        first = np.array([np.flatnonzero(planes.plane == plane)[0] for plane in range(6)])
        face = first[np.stack(np.unravel_index(np.arange(6**5), (6,) * 5), axis=1)]
        rays = rays_along(face.tolist(), [[1.0] * 6] * len(face))
        whole = collect_sequences([rays], planes)
        assert whole.size == sum(6**depth for depth in range(1, 6))
        assert len({tuple(sequence_planes(whole, node)) for node in range(whole.size)}) == whole.size
        parts = [Rays(*(field[start : start + 1000] for field in rays)) for start in range(0, len(face), 1000)]
        np.testing.assert_array_equal(collect_sequences(parts, planes).plane[: whole.size], whole.plane[: whole.size])


class TestViewChains:
    def test_margin_is_no_more_than_a_small_plane_can_span(self) -> None:
        corners = np.array([[0, 0, 9], [0.1, 0, 9], [0, 0.1, 9], [-9, -9, -1], [9, -9, -1], [0, 9, -1]], float)
        planes = group_planes(corners, np.array([[0, 1, 2], [3, 4, 5]]))
        rays = rays_along([[0, 1], [1, -1]], [[9, 10, 1], [1, np.inf, np.inf]])
        sequences = collect_sequences([rays], planes)
        margin = view_sequences(sequences, planes, np.zeros(3), 8.0).margin
        assert sequence_planes(sequences, 1) == [planes.plane[0], planes.plane[1]]
        assert 0.1 * np.sqrt(2) / 9 < margin[0] < 0.02
        assert margin[1] == margin[0]
        assert margin[2] > 1.0
        np.testing.assert_allclose(
            view_sequences(sequences._replace(rays=10**6), planes, np.zeros(3), 8.0).margin[2],
            8.0 * 3.545e-3,
            rtol=1e-3,
        )
