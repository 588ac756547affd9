"""Paths against Sionna RT's own solver: {plan, mesh} x {opaque, through walls}, at the same points and as strong."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.special import fresnel
from test_crossings import BRICK, EVERY, RX, TX, meshed, of_several_materials, rooms
from test_obstacles import low
from test_trace import SPECULAR, _grid, _half_seen_room, _room, all_paths

import sionna_partial as sp
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, SPEED_OF_LIGHT_M_S
from sionna_partial.files import temporary_folder
from sionna_partial.scene.scene import build_scene
from sionna_partial.tracing.engine import open_scene
from sionna_partial.tracing.finder import MeshScene, PlanScene, write_scene_of
from sionna_partial.tracing.interactions import DIFFRACTION, REFLECTION, REFRACTION
from sionna_partial.tracing.paths import SolvedPaths, join_paths
from sionna_partial.tracing.simulation import resolved_settings
from sionna_partial.tracing.stock import diffracted_as_exact, stock_paths

DRYWALL, RAYS = sp.Material(), 30_000
Compared = Callable[[PlanScene | MeshScene, SolvedPaths], NDArray[np.bool_]]


def all_of_them(_: object, paths: SolvedPaths) -> NDArray[np.bool_]:
    return np.ones(len(paths.a), bool)


def at_edges(scene: PlanScene | MeshScene, paths: SolvedPaths) -> NDArray[np.bool_]:
    """Sionna RT is diffracted at rims and at junctions of three walls as well, where it leaks from room to room.

    It makes a path too long and too weak that has interactions after its diffraction, and fewer than others.
    """
    count = (paths.interactions > 0).sum(axis=1)
    last = paths.interactions[np.arange(len(count)), np.maximum(count, 1) - 1]
    right = (last == DIFFRACTION) | (count == paths.interactions.shape[1])
    assert isinstance(scene, PlanScene)
    bent = (paths.interactions == DIFFRACTION).any(axis=1)
    return right & bent & diffracted_as_exact(scene.wedges, paths, 2)


def at_edges_alone(scene: PlanScene | MeshScene, paths: SolvedPaths) -> NDArray[np.bool_]:
    """Paths through walls have few reflections beside a diffraction."""
    return at_edges(scene, paths) & (paths.interactions != REFLECTION).all(axis=1)


def not_at_tops(_: object, paths: SolvedPaths) -> NDArray[np.bool_]:
    """Tops of obstacles reflect nothing on plans; rays are deeper for the walls that they cross."""
    tops, reflected = np.isin(paths.vertices_m[..., 2].round(2), [0.75, 1.8]), paths.interactions == REFLECTION
    return ~(reflected & tops).any(axis=1) & (reflected.sum(axis=1) <= 2)


@dataclass(frozen=True)
class Case:
    """Links, and the paths of Sionna RT that ours must have: those of a mask above a fraction of their link's power.

    There are at least `count`, and ours have the fraction `found` of them, with a relative difference of power of
    `power` at most. Rays of Sionna RT interact `deeper` times more often.
    """

    partial: Callable[[], sp.PartialMap]
    settings: sp.TraceSettings
    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    count: int
    weakest: float = 0.0
    found: float = 1.0
    power: float = 2e-2
    compared: Compared = all_of_them
    deeper: int = 0
    material: sp.Material = DRYWALL


def furnished() -> sp.PartialMap:
    """A room of 8 x 6 m as a mesh, with a ball, a pillar and a table in it."""
    parts = [trimesh.creation.box((8, 6, 3)).apply_translation((4, 3, 1.5))]
    parts.append(trimesh.creation.icosphere(1, 0.5).apply_translation((2, 4, 1.9)))
    parts.append(trimesh.creation.cylinder(0.3, 3, sections=8).apply_translation((6, 2, 1.5)))
    parts.append(trimesh.creation.box((1.5, 0.8, 0.05)).apply_translation((5, 4.5, 0.8)))
    with temporary_folder() as folder:
        trimesh.util.concatenate(parts).export(folder / "room.ply")
        return sp.load_map(folder / "room.ply", resolution_m=0.1)


INSIDE, OVER = np.array([1.03, 2.93, 1.4]), np.array([1.83, -0.08, 1.1])
PLACES, HALF = (_grid(partial, 0.3) + np.array([0.021, 0.013, 0.3]) for partial in (_room(), _half_seen_room()))
ABOUT = np.array([(2.0, 0.2, 0.35), (3.3, 0.8, 0.9), (4.6, 1.4, 1.5), (5.9, 2.0, 0.35), (3.8, 0.5, 0.9)])
AMONG = np.random.default_rng(0).uniform((0.4, 0.3, 0.2), (7.6, 5.7, 2.8), (5, 3))
OPAQUE = replace(SPECULAR, samples_per_tx=RAYS)
BENT = all_paths(max_depth=3, open_ends=True, samples_per_tx=RAYS)
LOW = replace(OPAQUE, max_depth=2, wall_depth_m=0.0)
LEAKY = replace(EVERY, samples_per_tx=RAYS)
THROUGH: dict[str, Any] = {"weakest": 1e-3, "material": BRICK}

CASES = {
    "plan": Case(_room, OPAQUE, INSIDE, PLACES[5::116], 75),
    "partial plan": Case(_half_seen_room, OPAQUE, INSIDE, HALF[5::116], 75),
    "partial plan, edges": Case(_half_seen_room, BENT, INSIDE, HALF[5::94], 25, compared=at_edges),
    "mesh": Case(furnished, replace(OPAQUE, max_depth=3), np.array([4.3, 2.8, 1.6]), AMONG, 150, found=0.99),
    "materials through walls": Case(of_several_materials, LEAKY, TX, RX, 30, power=2e-3, **THROUGH),
    "edges through walls": Case(
        *(rooms, replace(LEAKY, diffraction=True, max_depth=3), TX, RX, 3, 1e-4),
        power=5e-3,
        compared=at_edges_alone,
        material=BRICK,
    ),
    "obstacles through walls": Case(
        low, replace(LOW, frequency_hz=5e9), OVER, ABOUT, 20, 1e-4, compared=not_at_tops, deeper=3
    ),
    "mesh through walls": Case(meshed, LEAKY, TX, RX, 30, power=5e-3, **THROUGH),
}


def both(case: Case, floor_extent: str = "observed") -> tuple[sp.TracedLinks, SolvedPaths, NDArray[np.bool_]]:
    """Our links, the paths of Sionna RT in the same scene, and which of these are compared."""
    partial, offset_m = case.partial(), np.array([*case.partial().origin_m, 0.0])
    rx = case.rx[partial.radios_can_stand(case.rx)]
    scene_settings = sp.SceneSettings(material=case.material, floor_extent=floor_extent)
    settings, scene_settings = resolved_settings(partial, case.settings, scene_settings)
    links = sp.trace_links(partial, case.tx, rx, trace_settings=settings, scene_settings=scene_settings)
    with temporary_folder() as folder:
        written = write_scene_of(partial, folder, settings, scene_settings)
        scene, deep = open_scene(written.xml, settings.frequency_hz), settings.max_depth + case.deeper
        rays = replace(settings, max_depth=deep)
        shot = join_paths(list(stock_paths(scene, rays, case.tx - offset_m, rx - offset_m)), deep)
    return links, replace(shot, vertices_m=shot.vertices_m + offset_m), case.compared(written, shot)


def has(links: sp.TracedLinks, shot: SolvedPaths, path: int, power: float) -> bool:
    """Return whether a link has the interactions of a path of Sionna RT, at the same points, with the same power."""
    kinds = shot.interactions[path][shot.interactions[path] > 0]
    depth, own = len(kinds), links.path_rx == shot.path_rx[path]
    own &= ((links.interactions > 0).sum(axis=1) == depth) & (links.interactions[:, :depth] == kinds).all(axis=1)
    own &= (np.abs(links.vertices_m[:, :depth] - shot.vertices_m[path, :depth]) < 0.01).all(axis=(1, 2))
    return bool((np.abs(np.abs(links.a[own]) ** 2 / shot.power[path] - 1.0) < power).any())


@pytest.mark.parametrize("name", CASES)
def test_no_path_of_stock_is_missing(name: str) -> None:
    case = CASES[name]
    links, shot, compared = both(case)
    power = np.bincount(shot.path_rx, shot.power, len(links.rx))
    rows = np.flatnonzero(compared & (shot.power > case.weakest * power[shot.path_rx]))
    assert len(rows) >= case.count
    assert np.mean([has(links, shot, path, case.power) for path in rows.tolist()]) >= case.found
    for kind, on in ((REFRACTION, case.settings.through_walls), (DIFFRACTION, case.settings.diffraction is not False)):
        assert (links.interactions == kind).any() == on
    if case.compared is all_of_them and not case.settings.through_walls:
        gain_db = np.maximum(10.0 * np.log10(np.maximum(power, 1e-15)), -150.0)
        assert len(links.a) <= 1.001 * len(shot.a)
        assert ((links.gain_db > -150.0) == (gain_db > -150.0)).all()
        assert (np.abs(links.gain_db - gain_db) < 0.5).mean() >= 0.95


METAL = sp.SceneSettings(floor_extent="none", material=sp.Material(1.0, 1e7, 0.1))
OVER_AN_END = np.array([3.03, 5.51, 1.5])
"""Transmitter, which sees the side and the end face of a wall; both meet at the edge near it [m]."""
ONE_EDGE = sp.TraceSettings(max_depth=1, power_tolerance_db=0.0, samples_per_tx=100_000)
WAVELENGTH_M = SPEED_OF_LIGHT_M_S / CARRIER_FREQUENCY_HZ


def end_of_a_wall(width_m: float) -> tuple[sp.PartialMap, NDArray[np.float64]]:
    """Return a wall of 4 m that ends in the open, and the edge of its end face away from the transmitter [m]."""
    state = np.zeros((400, 400), np.uint8)
    state[:200, 250 : 250 + round(width_m / 0.02)] = sp.CellState.WALL
    partial = sp.PartialMap(state, 0.02)
    vertices_m = build_scene(partial, METAL).vertices_m
    return partial, vertices_m[vertices_m.sum(axis=1).argmax()]


def around(edge_m: NDArray[np.float64], shadow_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Receivers 2 m behind the edge, by their angle in the shadow, below 0 in sight."""
    direction = np.arctan2(*(edge_m - OVER_AN_END[:2])[::-1]) - np.radians(shadow_deg)
    ends_m = edge_m + 2.0 * np.column_stack([np.cos(direction), np.sin(direction)])
    return np.column_stack([ends_m, np.full(len(ends_m), 1.5)])


def transition(x: float) -> complex:
    """Return F(x) of Kouyoumjian and Pathak (1974), eq. 25."""
    sine, cosine = fresnel(np.sqrt(2.0 * x / np.pi))
    return np.sqrt(2.0 * np.pi * x) * 1j * np.exp(1j * x) * (0.5 - cosine - 1j * (0.5 - sine))


def utd_db(edge_m: NDArray[np.float64], shadow_deg: float, reflection: float) -> float:
    """Return the gain over the edge of 90 degrees, field along it, by eq. 17 to 26; both faces reflect that much."""
    back = OVER_AN_END[:2] - edge_m
    arrival, before_m, after_m = np.pi - np.arctan2(back[1], back[0]), float(np.linalg.norm(back)), 2.0
    departure = arrival + np.pi + np.radians(shadow_deg)
    k, n, total = 2.0 * np.pi / WAVELENGTH_M, 1.5, 0.0j
    for angle, factor in ((departure - arrival, 1.0), (departure + arrival, reflection)):
        for side in (1.0, -1.0):
            a = 2.0 * np.cos(np.pi * n * np.round((angle + side * np.pi) / (2.0 * np.pi * n)) - angle / 2.0) ** 2
            part = transition(k * before_m * after_m / (before_m + after_m) * a)
            total += factor * part / np.tan((np.pi + side * angle) / (2.0 * n))
    size = np.abs(total) ** 2 / (4.0 * n**2 * 2.0 * np.pi * k * before_m * after_m * (before_m + after_m))
    return float(10.0 * np.log10((WAVELENGTH_M / 4.0 / np.pi) ** 2 * size))


class TestEndOfAWall:
    """The strongest path behind a wall's end, which stock misses if the end is narrow (docs/results.md)."""

    @pytest.mark.parametrize("width_m", [0.08, 0.2])
    def test_ours_is_the_closed_form(self, width_m: float) -> None:
        """Metal faces in Sionna RT reflect less than perfect ones, and more than black ones."""
        partial, edge_m = end_of_a_wall(width_m)
        shadow_deg = np.array([0.01, 1.0, 3.0, 7.0, 15.0, 30.0])
        rx = around(edge_m, np.append(shadow_deg, -0.01))
        links = sp.trace_links(partial, OVER_AN_END, rx, trace_settings=ONE_EDGE, scene_settings=METAL)
        assert links.path_rx.tolist() == [0, 1, 2, 3, 4, 5, 6, 6]
        low, high = ([utd_db(edge_m, each, reflection) for each in shadow_deg] for reflection in (-1.0, 0.0))
        assert (links.gain_db[:-1] > np.array(low)).all()
        assert (links.gain_db[:-1] < np.array(high)).all()
        assert (np.array(high) - np.array(low))[:3].max() < 0.8
        field_db = 20.0 * np.log10([abs(links.a[links.path_rx == rx].sum()) for rx in (0, 6)])
        length_m = np.linalg.norm(edge_m - OVER_AN_END[:2]) + 2.0
        half_db = 20.0 * np.log10(WAVELENGTH_M / (4.0 * np.pi * length_m)) - 6.02
        np.testing.assert_allclose(field_db, half_db, atol=0.1)  # continuous across the shadow boundary

    @pytest.mark.parametrize(("width_m", "found"), [(0.08, False), (0.2, True)])
    def test_stock_misses_it_over_a_narrow_face(self, width_m: float, found: bool) -> None:
        partial, edge_m = end_of_a_wall(width_m)
        case = Case(lambda: partial, ONE_EDGE, OVER_AN_END, around(edge_m, np.array([1.0, 7.0, 30.0])), 0)
        links, shot, _ = both(replace(case, material=METAL.material), METAL.floor_extent)
        over = (np.abs(shot.vertices_m[:, 0, :2] - edge_m) < 0.01).all(axis=1)
        assert np.unique(shot.path_rx[over]).tolist() == ([0, 1, 2] if found else [])
        assert links.path_rx.tolist() == [0, 1, 2]
        if found:
            np.testing.assert_allclose(shot.power[over], np.abs(links.a) ** 2, rtol=1e-3)
