"""Meshes: the planes of their faces, the sequences of planes that rays meet, and candidates of reflections."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from extruded import blocks_of
from numpy.typing import NDArray

from sionna_partial.maps.mesh.scene_mesh import SceneMesh
from sionna_partial.scene.scene import write_mesh_scene
from sionna_partial.settings import Material, TraceSettings
from sionna_partial.tracing.engine import open_scene
from sionna_partial.tracing.mesh.faces import (
    PLANE_TOLERANCE_M,
    MeshPlanes,
    Met,
    face_at,
    face_tree,
    faces_between,
    group_planes,
)
from sionna_partial.tracing.mesh.reflections import MeshReflections
from sionna_partial.tracing.mesh.sequences import Rays, Sequences, collect_sequences, shoot_rays, view_sequences
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.power import materials_of
from sionna_partial.tracing.walls import Cells, SolidMesh, closed_bodies

TURN = trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)
"""A rotation that leaves no wall of a box upright."""


def load_meshes(folder: Path, *meshes: trimesh.Trimesh) -> tuple[Any, list[Any]]:
    """Write meshes as the shapes of a scene, and load it into Sionna RT."""
    whole, count = trimesh.util.concatenate(list(meshes)), len(meshes)
    number = np.repeat(np.arange(count), [len(mesh.faces) for mesh in meshes])
    parts = SceneMesh(np.array(whole.vertices), whole.faces, number, (None,) * count)
    xml = write_mesh_scene(parts, folder, offset_m=(0.0, 0.0), default_material=Material())
    scene = open_scene(xml, 28e9)
    return scene, [scene.objects[f"part{part}"].mi_mesh for part in range(count)]


def planes_of(mesh: trimesh.Trimesh) -> MeshPlanes:
    return group_planes(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def opaque(*meshes: trimesh.Trimesh) -> SolidMesh:
    """The faces of all meshes, which let nothing through, of drywall at 28 GHz."""
    whole = trimesh.util.concatenate(list(meshes))
    vertices, none, material = np.asarray(whole.vertices), whole.faces[:0], np.zeros(len(whole.faces), np.int64)
    planes = planes_of(whole)
    cells = Cells(np.zeros((1, 1), bool), 1.0, 0.0)
    faces = face_tree(vertices[none], planes.plane), planes, closed_bodies(vertices, none)
    return SolidMesh(*faces, cells, materials_of([(2.94, 0.1226, 0.1)], 28e9), material)


SIZE = np.array([8.0, 6.0, 3.0])
TX = np.array([0.3, -0.2, 0.1])
RX = np.random.default_rng(0).uniform(-0.45 * SIZE, 0.45 * SIZE, (30, 3))


def candidates_of(
    loaded: tuple[Any, list[Any]], meshes: Sequence[trimesh.Trimesh], tx: Any, rx: Any, depth: int = 3, **options: int
) -> Candidates:
    shot = shoot_rays(loaded[0].mi_scene, loaded[1], tx, 50_000, depth)
    kind = MeshReflections.between_faces(opaque(*meshes), tx, rx, TraceSettings(max_depth=depth), shot)
    parts, shares = zip(*blocks_of(kind.listed(np.zeros(len(rx)), **options)), strict=True)
    assert list(shares) == sorted(shares)
    assert shares[-1] == 1.0
    return Candidates.concatenate(parts)


def lengths_m(candidates: Candidates, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of all candidates (C,)."""
    ends = rx[candidates.rx][:, None]
    points = np.where(candidates.face[:, :, None] >= 0, candidates.vertices_m, ends)
    way = np.concatenate([np.broadcast_to(tx, ends.shape), points, ends], axis=1)
    return np.linalg.norm(np.diff(way, axis=1), axis=2).sum(axis=1)


def image_distances_m(rx: NDArray[np.float64], depth: int) -> NDArray[np.float64]:
    """Distances to all images of TX in the box, of order `depth` at most, ascending."""
    orders = [o for o in itertools.product(range(-depth, depth + 1), repeat=3) if np.abs(o).sum() <= depth]
    images = np.array(orders) * SIZE + np.where(np.array(orders) % 2, -TX, TX)
    return np.sort(np.linalg.norm(images - rx, axis=1))


def room() -> list[trimesh.Trimesh]:
    """A box with a ball, a pillar and a table in it."""
    ball = trimesh.creation.icosphere(1, 0.5).apply_translation((-2, 1, 0.4))
    pillar = trimesh.creation.cylinder(0.3, 3, sections=8).apply_translation((2, -1, 0))
    table = trimesh.creation.box((1.5, 0.8, 0.05)).apply_translation((1, 1.5, -0.7))
    return [trimesh.creation.box(SIZE), ball, pillar, table]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, list[Any]]:
    return load_meshes(tmp_path_factory.mktemp("room"), *room())


class TestBox:
    """In a convex room every image of the transmitter is a path: an exact answer, whatever the faces look like."""

    @pytest.mark.parametrize("kind", ["upright", "turned", "inverted", "subdivided", "in two meshes"])
    def test_every_image_once(self, tmp_path: Path, kind: str) -> None:
        box, tx, rx = trimesh.creation.box(SIZE), TX, RX
        if kind == "subdivided":
            box = box.subdivide().subdivide()
        if kind == "inverted":
            box.invert()
        if kind == "turned":
            box, (tx, rx) = box.apply_transform(TURN), (points @ TURN[:3, :3].T for points in (TX, RX))
        half = len(box.faces) // 2 + 1
        parts = [trimesh.Trimesh(box.vertices, faces) for faces in (box.faces[:half], box.faces[half:])]
        meshes = parts if kind == "in two meshes" else [box]
        found = candidates_of(load_meshes(tmp_path, *meshes), meshes, tx, rx, depth=4)
        lengths = lengths_m(found, tx, rx)
        for k in range(len(rx)):
            np.testing.assert_allclose(np.sort(lengths[found.rx == k]), image_distances_m(RX[k], 4), atol=1e-5)


class TestRoom:
    def test_a_receiver_has_its_candidates_whoever_is_beside(self, scene: Any) -> None:
        crowd = np.random.default_rng(2).uniform(-0.45 * SIZE, 0.45 * SIZE, (3000, 3))
        whole = candidates_of(scene, room(), TX, crowd)
        for k in range(0, 3000, 200):
            kept, alone = whole.rx == k, candidates_of(scene, room(), TX, crowd[k : k + 1])
            assert kept.sum() > 20
            assert whole.face[kept].tobytes() == alone.face.tobytes()
            assert whole.vertices_m[kept].tobytes() == alone.vertices_m.tobytes()

    def test_blocks_join_to_the_same_bytes(self, scene: Any) -> None:
        whole = candidates_of(scene, room(), TX, RX)
        parts = candidates_of(scene, room(), TX, RX, sequences_at_once=50)
        for name in ("rx", "kind", "face", "vertices_m"):
            assert getattr(whole, name).tobytes() == getattr(parts, name).tobytes()


class TestOpenMesh:
    TRIANGLE = trimesh.Trimesh([[2.0, -2.0, -2.0], [2.0, 2.0, -2.0], [2.0, 0.0, 3.0]], [[0, 1, 2]])

    def test_one_triangle_reflects_where_its_mirror_image_shows(self, tmp_path: Path) -> None:
        rx = np.random.default_rng(1).uniform(-6.0, 6.0, (3000, 3))
        found = candidates_of(load_meshes(tmp_path, self.TRIANGLE), [self.TRIANGLE], np.zeros(3), rx, depth=2)
        share = 2.0 / (4.0 - rx[:, 0])
        y, z = share * rx[:, 1], share * rx[:, 2]
        inside = (rx[:, 0] < 2.0) & (z > -2.0) & (np.abs(y) < 2.0 * (3.0 - z) / 5.0)
        near = np.minimum(np.abs(z + 2.0), np.abs(np.abs(y) - 2.0 * (3.0 - z) / 5.0)) < 2e-3
        reflected = np.zeros(len(rx), bool)
        reflected[found.rx[found.face[:, 0] == 0]] = True
        assert inside.sum() > 100
        np.testing.assert_array_equal(reflected[~near], inside[~near])
        assert (found.face[:, 1] == -1).all()
        assert np.bincount(found.rx).tolist() == (1 + reflected.astype(int)).tolist()


def fine_box() -> trimesh.Trimesh:
    return trimesh.creation.box((8, 6, 3)).subdivide().subdivide()


def looked_up(planes: MeshPlanes, plane: NDArray[np.int32], points: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.array([face_at(planes.bins, p, *point) for p, point in zip(plane, points, strict=True)])


class TestGroupPlanes:
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


def test_faces_between_points_are_those_of_brute_force() -> None:
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, 1.0)
    ends = rng.uniform(-1.2, 1.2, (200, 2, 3))
    planes = planes_of(ball)
    tree, met = face_tree(np.asarray(ball.triangles), planes.plane), Met.empty()
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


def rays_along(face: list[list[int]], leg_m: list[list[float]]) -> Rays:
    """Rays with given faces and lengths; all legs go up."""
    up = np.broadcast_to(np.float32([0.0, 0.0, 1.0]), (len(leg_m), len(leg_m[0]), 3))
    return Rays(np.array(face, np.int32), np.array(leg_m, np.float32), up)


def sequence_planes(sequences: Sequences, node: int) -> list[int]:
    before = sequence_planes(sequences, int(sequences.parent[node])) if sequences.parent[node] >= 0 else []
    return [*before, int(sequences.plane[node])]


class TestCollectChains:
    def test_as_many_chains_as_there_are(self) -> None:
        """More than the arrays hold at first, and the same for rays in parts."""
        planes = planes_of(trimesh.creation.box(SIZE))
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
