"""Paths against Sionna RT's own solver: {plan, mesh} x {opaque, through walls}, at the same points and as strong."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from test_crossings import BRICK, EVERY, RX, TX, of_several_materials, rooms
from test_obstacles import low
from test_trace import SPECULAR, _grid, _half_seen_room, _room, all_paths

import sionna_partial as sp
from sionna_partial.files import temporary_folder
from sionna_partial.scene.scene import build_scene
from sionna_partial.tracing.engine import open_scene
from sionna_partial.tracing.interactions import DIFFRACTION, REFLECTION, REFRACTION
from sionna_partial.tracing.paths import SolvedPaths, join_paths
from sionna_partial.tracing.plan.diffraction import find_wedges
from sionna_partial.tracing.simulation import resolved_settings
from sionna_partial.tracing.stock import diffracted_as_exact, stock_paths

Mask = NDArray[np.bool_]


def of_all(partial: sp.PartialMap, paths: SolvedPaths) -> Mask:
    return np.ones(len(paths.a), bool)


def at_upright_edges(partial: sp.PartialMap, paths: SolvedPaths) -> Mask:
    """Sionna RT is diffracted at rims and at junctions of three walls as well, where it leaks from room to room.

    A path with fewer interactions than others, reflected after its diffraction, is too long and too weak in it.
    """
    wedges = find_wedges(build_scene(partial), open_ends=True)
    found = diffracted_as_exact(wedges, paths, 2) & (paths.interactions == DIFFRACTION).any(axis=1)
    return found & (paths.interactions[:, -1] > 0)


def not_off_obstacles(partial: sp.PartialMap, paths: SolvedPaths) -> Mask:
    """Tops of obstacles reflect nothing on plans; at most two reflections, as deeper rays are for walls crossed."""
    tops = np.isin(paths.vertices_m[..., 2].round(2), [0.75, 1.8])
    reflected = paths.interactions == REFLECTION
    return ~(reflected & tops).any(axis=1) & (reflected.sum(axis=1) <= 2)


@dataclass(frozen=True)
class Case:
    """A scene, and the paths of Sionna RT that are compared: a mask, above a fraction of the power of their link.

    `count` of them there are at least, `share` of which ours must have, with this relative tolerance of power.
    """

    scene: Callable[[], sp.PartialMap]
    settings: sp.TraceSettings
    tx: Any
    rx: NDArray[np.float64]
    count: int
    weakest: float = 0.0
    share: float = 1.0
    rel: float = 2e-2
    material: sp.SceneSettings = field(default_factory=sp.SceneSettings)
    compared: Callable[[sp.PartialMap, SolvedPaths], Mask] = of_all
    deeper: int = 0


def meshed() -> sp.PartialMap:
    """Three rooms as a mesh: the scene of a plan, without its map."""
    with temporary_folder() as folder:
        scene = sp.export_scene(rooms(), folder / "scene", sp.SceneSettings(material=BRICK))
        (scene / "map.yaml").unlink()
        return sp.load_map(scene / "scene.xml")


def furnished() -> sp.PartialMap:
    """A room of 8 x 6 m with a ball, a pillar and a table in it."""
    ball = trimesh.creation.icosphere(1, 0.5).apply_translation((2, 4, 1.9))
    pillar = trimesh.creation.cylinder(0.3, 3, sections=8).apply_translation((6, 2, 1.5))
    table = trimesh.creation.box((1.5, 0.8, 0.05)).apply_translation((5, 4.5, 0.8))
    shell = trimesh.creation.box((8, 6, 3)).apply_translation((4, 3, 1.5))
    with temporary_folder() as folder:
        trimesh.util.concatenate([shell, ball, pillar, table]).export(folder / "room.ply")
        return sp.load_map(folder / "room.ply", resolution_m=0.1)


def places(partial: sp.PartialMap, step: int) -> NDArray[np.float64]:
    return _grid(partial, 0.3)[5::step] + np.array([0.021, 0.013, 0.3])


INSIDE, BRICKS = np.array([1.03, 2.93, 1.4]), sp.SceneSettings(material=BRICK)
DIFFRACTED = all_paths(max_depth=3, open_ends=True, samples_per_tx=100_000)
LOW = all_paths(max_depth=2, diffraction=False, wall_depth_m=0.0, samples_per_tx=100_000)
ABOUT = np.array([(2.0 + 1.3 * k, 0.2 + 0.6 * (k % 4), (0.35, 0.9, 1.5)[k % 3]) for k in range(4)] + [(3.8, 0.5, 0.9)])
SPECULAR_RAYS = replace(SPECULAR, samples_per_tx=100_000)
CASES = {
    "plan, opaque": Case(_room, SPECULAR_RAYS, INSIDE, places(_room(), 29), 300, share=0.999),
    "partial plan, opaque": Case(
        _half_seen_room, SPECULAR_RAYS, INSIDE, places(_half_seen_room(), 29), 300, share=0.999
    ),
    "plan, edges": Case(_room, DIFFRACTED, INSIDE, places(_room(), 47), 50, compared=at_upright_edges),
    "partial plan, edges": Case(
        _half_seen_room, DIFFRACTED, INSIDE, places(_half_seen_room(), 47), 50, compared=at_upright_edges
    ),
    "plan with obstacles": Case(low, LOW, (1.83, -0.08, 1.1), ABOUT, 20, 1e-4, compared=not_off_obstacles),
    "plan, through walls": Case(rooms, EVERY, TX, RX, 30, 1e-3, rel=2e-3, material=BRICKS),
    "materials, through walls": Case(of_several_materials, EVERY, TX, RX, 30, 1e-3, rel=2e-3, material=BRICKS),
    "plan, edges and walls": Case(
        rooms,
        replace(EVERY, diffraction=True, max_depth=3),
        TX,
        RX,
        3,
        1e-4,
        rel=5e-3,
        material=BRICKS,
        compared=at_upright_edges,
    ),
    "obstacles, through walls": Case(
        low, replace(LOW, frequency_hz=5e9), (1.83, -0.08, 1.1), ABOUT, 20, 1e-4, compared=not_off_obstacles, deeper=3
    ),
    "mesh, opaque": Case(
        furnished,
        replace(SPECULAR_RAYS, max_depth=3),
        np.array([4.3, 2.8, 1.6]),
        np.random.default_rng(0).uniform((0.4, 0.3, 0.2), (7.6, 5.7, 2.8), (10, 3)),
        300,
        share=0.99,
    ),
    "mesh, through walls": Case(meshed, replace(EVERY, samples_per_tx=300_000), TX, RX, 30, 1e-3, rel=5e-3),
}


def both(case: Case) -> tuple[sp.PartialMap, sp.TracedLinks, SolvedPaths]:
    """Our links, and the paths of Sionna RT in the exported scene."""
    partial = case.scene()
    rx = case.rx[partial.radios_can_stand(case.rx)]
    settings, scene_settings = resolved_settings(partial, case.settings, case.material)
    links = sp.trace_links(partial, case.tx, rx, trace_settings=settings, scene_settings=case.material)
    deep = replace(settings, max_depth=settings.max_depth + case.deeper)
    with temporary_folder() as folder:
        exported = sp.export_scene(partial, folder / "scene", scene_settings, frequency_hz=settings.frequency_hz)
        scene = open_scene(exported / "scene.xml", settings.frequency_hz)
        shot = join_paths(list(stock_paths(scene, deep, np.array(case.tx), rx)), deep.max_depth)
    return partial, links, shot


def is_found(links: sp.TracedLinks, shot: SolvedPaths, path: int, rel: float) -> bool:
    """Return whether one of our paths has the interactions of a path of Sionna RT, their points and its power."""
    kinds = shot.interactions[path][shot.interactions[path] > 0]
    depth, own = len(kinds), links.path_rx == shot.path_rx[path]
    if depth > links.interactions.shape[1]:
        return False
    own &= (links.interactions > 0).sum(axis=1) == depth
    own &= (links.interactions[:, :depth] == kinds).all(axis=1)
    own &= (np.abs(links.vertices_m[:, :depth] - shot.vertices_m[path, :depth]) < 0.01).all(axis=(1, 2))
    return bool((np.abs(np.abs(links.a[own]) ** 2 / shot.power[path] - 1.0) < rel).any())


@pytest.mark.parametrize("name", CASES)
def test_every_path_of_stock_is_found(name: str) -> None:
    case = CASES[name]
    partial, links, shot = both(case)
    sums = np.bincount(shot.path_rx, shot.power, len(links.rx))
    compared = np.flatnonzero(case.compared(partial, shot) & (shot.power > case.weakest * sums[shot.path_rx]))
    found = [is_found(links, shot, path, case.rel) for path in compared]
    assert len(found) >= case.count
    assert np.mean(found) >= case.share
    through, edges = ((links.interactions == kind).any() for kind in (REFRACTION, DIFFRACTION))
    assert (bool(through), bool(edges)) == (links.trace_settings.through_walls, bool(links.trace_settings.diffraction))
    if case.compared is of_all:
        gain_db = 10.0 * np.log10(np.maximum(sums, 1e-15))
        assert ((links.gain_db > -150.0) == (gain_db > -150.0)).all()
