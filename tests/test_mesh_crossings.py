"""Paths through walls of meshes: one body is one wall, and plans are the same as meshes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from meshes import box, scene_mesh
from test_crossings import BRICK, EVERY, LONELY, REFRACTION, RX, STRAIGHT, TX, loss_db, rooms, same_path, slab_loss_db

import sionna_partial as sp
from sionna_partial.tracing.engine import open_scene
from sionna_partial.tracing.mesh.faces import face_tree, faces_between, group_planes, scratch
from sionna_partial.tracing.simulation import resolved_settings
from sionna_partial.tracing.stock import stock_paths

ENDS = (3.0, 2.97, 1.5), (6.0, 3.41, 1.5)
COSINE = 3.0 / np.hypot(3.0, 0.44)


def field(*solids: trimesh.Trimesh, unseen: tuple[int, int] = (0, 0)) -> sp.PartialMap:
    """Bodies in a field of free cells, of which some columns are unknown."""
    state = np.zeros((60, 80), dtype=np.uint8)
    state[:, slice(*unseen)] = 2
    return sp.PartialMap(state, 0.1, mesh=scene_mesh(*solids))


def sheet(x: float) -> trimesh.Trimesh:
    return trimesh.Trimesh([(x, 0, 0), (x, 6, 0), (x, 6, 3), (x, 0, 3)], [(0, 1, 2), (0, 2, 3)], process=False)


def turned_inside_out(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(solid.vertices, solid.faces[:, ::-1], process=False)


WALL = box((4.2, 0, 0), (4.5, 6, 3))


class TestOneWall:
    """What faces cost that a line crosses, in slabs."""

    @pytest.mark.parametrize(
        ("partial", "slabs"),
        [
            (field(WALL), 1),
            (field(turned_inside_out(WALL)), 1),
            (field(box((4, 0, 0), (5, 6, 3))), 2),
            (field(WALL, box((4.8, 0, 0), (4.9, 6, 3))), 2),
            (field(sheet(4.2)), 1),
            (field(sheet(4.2), sheet(4.6)), 2),
            (field(sheet(4.2), sheet(4.6), unseen=(42, 46)), 1),
        ],
        ids=["body", "inside out", "deep body", "two bodies", "sheet", "sheets", "sheets with nothing free between"],
    )
    def test_costs(self, partial: sp.PartialMap, slabs: int) -> None:
        assert loss_db(partial, *ENDS) == pytest.approx(slabs * slab_loss_db(COSINE), abs=0.02)
        assert loss_db(partial, *ENDS[::-1]) == pytest.approx(slabs * slab_loss_db(COSINE), abs=0.02)

    def test_each_face_a_slab(self) -> None:
        assert loss_db(field(WALL), *ENDS, wall_depth_m=0.0) == pytest.approx(2 * slab_loss_db(COSINE), abs=0.02)

    def test_more_walls_than_allowed(self) -> None:
        partial = field(WALL, box((4.8, 0, 0), (4.9, 6, 3)))
        settings = replace(STRAIGHT, max_walls=1)
        links = sp.trace_links(partial, ENDS[0], [ENDS[1]], trace_settings=settings, scene_settings=LONELY)
        assert links.link_state.tolist() == [sp.LinkState.OUTAGE]


@pytest.fixture(scope="module")
def meshed(tmp_path_factory: pytest.TempPathFactory) -> sp.PartialMap:
    """Three rooms as a mesh: the scene of a plan, without its map."""
    plan = replace(rooms(), origin_m=(0.0, 0.0))
    folder = sp.export_scene(plan, tmp_path_factory.mktemp("meshed") / "scene", sp.SceneSettings(material=BRICK))
    (folder / "map.yaml").unlink()
    return sp.load_map(folder / "scene.xml")


SHIFT = np.array([-2.0, 3.0, 0.0])


@pytest.mark.parametrize("depth_m", [0.0, 0.6])
def test_plans_and_meshes_agree(meshed: sp.PartialMap, depth_m: float) -> None:
    settings = replace(EVERY, wall_depth_m=depth_m, power_tolerance_db=0.1)
    plan = sp.trace_links(rooms(), TX, RX, trace_settings=settings, scene_settings=sp.SceneSettings(material=BRICK))
    mesh = sp.trace_links(meshed, TX - SHIFT, RX - SHIFT, trace_settings=settings)
    np.testing.assert_allclose(mesh.gain_db, plan.gain_db, atol=0.3)
    assert mesh.to_dataframe("paths")["walls"].max() >= 2


def test_stock_finds_no_other_paths(meshed: sp.PartialMap, tmp_path: Path) -> None:
    """With each face a slab, all strong paths of the public solver, at the same points, as strong."""
    settings, scene_settings = resolved_settings(meshed, replace(EVERY, samples_per_tx=300_000), sp.SceneSettings())
    ours = sp.trace_links(meshed, TX - SHIFT, RX - SHIFT, trace_settings=settings)
    folder = sp.export_scene(meshed, tmp_path / "scene", scene_settings)
    scene = open_scene(folder / "scene.xml", 5e9)
    found = 0
    for rx, paths in enumerate(stock_paths(scene, settings, TX - SHIFT, RX - SHIFT)):
        for path in np.flatnonzero(paths.power > 1e-3 * paths.power.sum()):
            kinds, same = same_path(ours, rx, paths, path, np.zeros(3))
            assert abs(ours.a[same]) ** 2 == pytest.approx(paths.power[path], rel=5e-3)
            found += REFRACTION in kinds
    assert found > 30


def test_opaque_paths_stay_and_slopes(meshed: sp.PartialMap) -> None:
    """Paths without walls are the same, to the byte; derivatives in the thickness of walls agree with differences."""
    settings = replace(EVERY, wall_depth_m=0.6, max_depth=2, power_tolerance_db=0.1)
    simulation = sp.Simulation(meshed, settings)
    opaque = sp.trace_links(meshed, TX - SHIFT, RX - SHIFT, trace_settings=replace(settings, refraction=False))
    leaky = simulation.links(TX - SHIFT, RX - SHIFT)
    through = (leaky.interactions == REFRACTION).any(axis=1)
    assert through.any()
    assert np.sort(leaky.a[~through]).tobytes() == np.sort(opaque.a).tobytes()
    assert sp.Simulation(meshed, sp.TraceSettings(5e9)).resolved.trace_settings.refraction


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
