import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from extruded import blocks_of
from mesh_rays import TURN, load_meshes, opaque, shapes_of
from numpy.typing import NDArray

from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.mesh.reflections import MeshReflections
from sionna_partial.tracing.mesh.sequences import shoot_rays
from sionna_partial.tracing.paths import Candidates

SIZE = np.array([8.0, 6.0, 3.0])
TX = np.array([0.3, -0.2, 0.1])
RX = np.random.default_rng(0).uniform(-0.45 * SIZE, 0.45 * SIZE, (30, 3))


def candidates_of(
    scene: Any,
    meshes: Sequence[trimesh.Trimesh],
    tx: Any,
    rx: Any,
    *,
    depth: int = 3,
    rays: int = 50_000,
    **options: int,
) -> Candidates:
    shot = shoot_rays(scene.mi_scene, shapes_of(scene, len(meshes)), tx, rays, depth)
    kind = MeshReflections(opaque(*meshes), tx, rx, TraceSettings(max_depth=depth), shot)
    parts = blocks_of(kind.listed(np.zeros(len(rx)), **options))
    shares = [share for _, share in parts]
    assert shares == sorted(shares)
    assert depth == 0 or shares[-1] == 1.0
    return Candidates.concatenate([part for part, _ in parts])


def lengths_m(candidates: Candidates, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of all candidates (C,)."""
    ends = rx[candidates.rx][:, None]
    points = np.where(candidates.face[:, :, None] >= 0, candidates.vertices_m, ends)
    way = np.concatenate([np.broadcast_to(tx, ends.shape), points, ends], axis=1)
    return np.linalg.norm(np.diff(way, axis=1), axis=2).sum(axis=1)


def by_receiver(candidates: Candidates, lengths: NDArray[np.float64], count: int) -> list[NDArray[np.float64]]:
    return [np.sort(lengths[candidates.rx == k]) for k in range(count)]


def image_distances_m(rx: NDArray[np.float64], depth: int) -> NDArray[np.float64]:
    """Distances to all images of TX in the box, of order `depth` at most, ascending."""
    orders = [o for o in itertools.product(range(-depth, depth + 1), repeat=3) if np.abs(o).sum() <= depth]
    images = np.array(orders) * SIZE + np.where(np.array(orders) % 2, -TX, TX)
    return np.sort(np.linalg.norm(images - rx, axis=1))


def turned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points @ TURN[:3, :3].T


def room() -> list[trimesh.Trimesh]:
    """A box with a ball, a pillar and a table in it."""
    ball = trimesh.creation.icosphere(1, 0.5).apply_translation((-2, 1, 0.4))
    pillar = trimesh.creation.cylinder(0.3, 3, sections=8).apply_translation((2, -1, 0))
    table = trimesh.creation.box((1.5, 0.8, 0.05)).apply_translation((1, 1.5, -0.7))
    return [trimesh.creation.box(SIZE), ball, pillar, table]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
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
            box, tx, rx = box.apply_transform(TURN), turned(TX), turned(RX)
        half = len(box.faces) // 2 + 1
        parts = [trimesh.Trimesh(box.vertices, faces) for faces in (box.faces[:half], box.faces[half:])]
        meshes = parts if kind == "in two meshes" else [box]
        found = candidates_of(load_meshes(tmp_path, *meshes), meshes, tx, rx, depth=4)
        for k, lengths in enumerate(by_receiver(found, lengths_m(found, tx, rx), len(rx))):
            np.testing.assert_allclose(lengths, image_distances_m(RX[k], 4), atol=1e-5)


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
