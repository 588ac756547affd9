"""Functions that benchmarks share: homes and positions, stock's path solver on tiles, and agreement of its paths."""

import itertools
import multiprocessing
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import sionna_partial as sp
from sionna_partial.constants import DEFAULT_HEIGHT_M
from sionna_partial.llvm import load_sionna
from sionna_partial.scene.scene import SceneGeometry, build_scene
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.plan.edges import MAX_REFLECTIONS, find_wedges
from sionna_partial.tracing.stock import listed_before

Paths = dict[str, NDArray[Any]]
"""Paths of one receiver: `a` and `delay_s` (P,), `interactions` (P, D), `vertices_m` (P, D, 3), NaN where none is."""

FIRST_SEED = 300_000
"""Seed of the first procedural home of `given_homes`; no network was trained on it."""

TRUTH_RAYS = 1_000_000
TRUTH_TABLE = 30_000_000
TILE = 100

SAME_DELAY_S = 1e-11
"""Paths to one receiver whose delays differ by less are the same [s]: 3 mm."""

SAME_POINT_M = 0.03
"""Largest distance between the points of equal paths [m]. Sionna RT reflects at either of two nearly coplanar walls."""

TOUCH_M = 2e-3
"""Distance from the ends of a leg within which it may touch a wall [m]."""


def isolated(function: Callable[..., dict], *arguments: object, **options: object) -> dict:
    """Run a measurement in a fresh process, so that memory and warm-up are its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments, options)


def trace_stock(
    folder: str,
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    *,
    tile: int = TILE,
    rays: int = TRUTH_RAYS,
    table: int = TRUTH_TABLE,
    max_depth: int = 6,
    diffraction: bool = False,
    cores: int | None = None,
) -> dict:
    """Run stock `PathSolver` on tiles of receivers: seconds, peak memory, and each receiver's paths, each once."""
    limit_cores(cores)
    rt = load_sionna()
    start = time.perf_counter()
    paths: list[Paths] = []
    repeats = 0
    for first in range(0, len(rx), tile):
        part = rx[first : first + tile]
        found = rt.PathSolver()(
            stock_scene(rt, folder, tx, part),
            max_depth=max_depth,
            refraction=False,
            diffraction=diffraction,
            edge_diffraction=diffraction,
            samples_per_src=rays,
            max_num_paths_per_src=table,
        )
        for index in range(len(part)):
            each, twice = receiver_paths(found, index, len(part), max(1, max_depth))
            paths.append(each)
            repeats += twice
    return {"seconds": time.perf_counter() - start, "memory_gb": peak_memory_gb(), "paths": paths, "repeats": repeats}


def true_paths(folder: str, tx: NDArray[np.float64], rx: NDArray[np.float64], **options: Any) -> dict:
    """Run `trace_stock` for the truth: with diffraction, each diffracted path is taken from a run of just its depth.

    Sionna RT 2.2 counts a part of the length twice where a path is reflected after its diffraction and has fewer
    interactions than the largest depth allows: it is some dB too weak.
    """
    result = trace_stock(folder, tx, rx, **options)
    if not options["diffraction"]:
        return result
    whole = [{name: values[~is_bent(paths)] for name, values in paths.items()} for paths in result["paths"]]
    for depth in range(1, min(1 + MAX_REFLECTIONS, options["max_depth"]) + 1):
        for index, paths in enumerate(trace_stock(folder, tx, rx, **{**options, "max_depth": depth})["paths"]):
            kept = is_bent(paths) & (paths["interactions"] > 0).all(axis=1)
            whole[index] = _joined(whole[index], {name: values[kept] for name, values in paths.items()})
    return result | {"paths": whole}


def is_bent(paths: Paths) -> NDArray[np.bool_]:
    """Return whether each path diffracts."""
    return (paths["interactions"] == DIFFRACTION).any(axis=1)


def _joined(deep: Paths, other: Paths) -> Paths:
    """Paths of both, the second with no more interactions than the first."""
    missing = deep["interactions"].shape[1] - other["interactions"].shape[1]
    kinds = np.pad(other["interactions"], ((0, 0), (0, missing)))
    vertices_m = np.pad(other["vertices_m"], ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)
    padded = {**other, "interactions": kinds, "vertices_m": vertices_m}
    return {name: np.concatenate([values, padded[name]]) for name, values in deep.items()}


def receiver_paths(found: Any, index: int, receivers: int, depth: int) -> tuple[Paths, int]:
    """Paths of one receiver, each once, and how many were listed again."""
    valid = np.flatnonzero(found.valid.numpy().reshape(receivers, -1)[index])
    real, imaginary = (part.numpy().reshape(receivers, -1)[index, valid].astype(float) for part in found.a)
    interactions = found.interactions.numpy().reshape(depth, receivers, -1)[:, index, valid].T.astype(np.uint8)
    vertices_m = np.moveaxis(found.vertices.numpy().reshape(depth, receivers, -1, 3)[:, index, valid], 0, 1)
    once = ~listed_before(interactions, vertices_m)
    paths = {
        "a": real + 1j * imaginary,
        "delay_s": found.tau.numpy().reshape(receivers, -1)[index, valid].astype(float),
        "interactions": interactions,
        "vertices_m": np.where(interactions[:, :, None] > 0, vertices_m.astype(float), np.nan),
    }
    return {name: values[once] for name, values in paths.items()}, int((~once).sum())


def stock_scene(rt: Any, folder: str, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> Any:
    """Stock scene with isotropic antennas at the given positions."""
    scene = rt.load_scene(f"{folder}/scene.xml")
    scene.frequency = 28e9
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="V"
    )
    scene.add(rt.Transmitter("tx", position=[float(value) for value in tx]))
    for index, position in enumerate(rx):
        scene.add(rt.Receiver(f"rx{index}", position=[float(value) for value in position]))
    return scene


def given_homes(paths: Sequence[Path], made: int) -> Iterator[tuple[str, sp.PartialMap]]:
    """Yield the maps of files with their names, or else so many procedural homes."""
    for path in paths:
        yield path.parent.name if path.suffix else path.name, sp.load_map(path)
    for seed in range(FIRST_SEED, FIRST_SEED + made * (not paths)):
        yield f"make_home({seed})", sp.make_home(seed)


def drawn_points_m(
    home: sp.PartialMap, partial: sp.PartialMap, count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw points (count, 3) in free cells of a home where radios can be, also on its partial map [m]."""
    cells = rng.permutation(np.argwhere(home.state == sp.CellState.FREE))
    inside = cells + rng.uniform(0.25, 0.75, cells.shape)
    points_m = np.insert(inside[:, ::-1] * home.resolution_m + home.origin_m, 2, DEFAULT_HEIGHT_M, axis=1)
    return points_m[home.radios_can_stand(points_m) & partial.radios_can_stand(points_m)][:count]


def grid_m(partial: sp.PartialMap, spacing_m: float, height_m: float = DEFAULT_HEIGHT_M) -> NDArray[np.float64]:
    """Return the positions (N, 3) of a square grid that lie in free cells [m]."""
    x0, y0, x1, y1 = partial.bounds_m
    x, y = np.meshgrid(np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m))
    points_m = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_m)])
    return points_m[partial.state_at(points_m) == sp.CellState.FREE]


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """Call a function; return its result and its processor time [s]."""
    start = time.process_time()
    return function(), time.process_time() - start


def limit_cores(cores: int | None) -> None:
    """Keep this process, which has not started Dr.Jit, on so many cores."""
    if cores is not None:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])


def peak_memory_gb() -> float:
    """Largest resident memory of this process so far [GB]; `getrusage` would count the parent's at the fork."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(re.search(r"VmHWM:\s+(\d+) kB", status)[1]) / 1e6


def paths_of(links: sp.TracedLinks) -> list[Paths]:
    """Paths of each receiver of a trace."""
    start = np.searchsorted(links.path_rx, np.arange(len(links.rx) + 1))
    names = ("a", "delay_s", "interactions", "vertices_m")
    return [{name: getattr(links, name)[first:stop] for name in names} for first, stop in itertools.pairwise(start)]


def agreement(
    partial: sp.PartialMap, tx: NDArray[np.float64], rx: NDArray[np.float64], found: list[Paths], truth: list[Paths]
) -> dict[str, int]:
    """Count what agrees.

    Stock Sionna RT misses paths, because no ray met their chain of walls or because its rays travel in packets, and
    lets some through a wall at a corner. So every path that only one side has is checked by itself, in double
    precision: its legs must cross no wall, or no triangle of a mesh.

    Returns
    -------
    dict
        Counts. `links`; `truth`: paths of the truth that are real; `found`: of them, those that are found; `extra`:
        paths that truth lacks; `real`: of them, those that cross no wall; `leaks`: paths of truth that cross a wall;
        `same_state`, `same_gain`: links with equal state, and with gains within 0.5 dB, where every real path counts
        for the truth.
    """
    shift = np.array([*partial.origin_m, 0.0])
    geometry = build_scene(partial) if partial.mesh is None else partial.mesh.corners_m - shift
    count = dict.fromkeys(("links", "truth", "found", "extra", "real", "leaks", "same_state", "same_gain"), 0)
    for position, ours, theirs in zip(rx, found, truth, strict=True):
        pairs = pair_paths(ours, theirs)
        extra, alone = (np.setdiff1d(np.arange(len(p["a"])), k) for p, k in zip((ours, theirs), pairs.T, strict=True))
        real, sound = np.zeros(len(extra), bool), np.ones(len(theirs["a"]), bool)
        ends = tx - shift, position - shift
        real[:] = [is_real(geometry, *ends, each - shift) for each in ours["vertices_m"][extra]]
        sound[alone] = [is_real(geometry, *ends, each - shift) for each in theirs["vertices_m"][alone]]
        best = {name: np.concatenate([theirs[name][sound], ours[name][extra[real]]]) for name in ("a", "interactions")}
        (state, gain_db), (true_state, true_gain_db) = link(ours), link(best)
        count["links"] += 1
        count["truth"] += int(sound.sum())
        count["found"] += len(pairs)
        count["extra"] += len(extra)
        count["real"] += int(real.sum())
        count["leaks"] += int((~sound).sum())
        count["same_state"] += int(state == true_state)
        count["same_gain"] += int(abs(gain_db - true_gain_db) <= 0.5)
    return count


def link(paths: Paths) -> tuple[sp.LinkState, float]:
    """Link state and gain [dB] of one receiver."""
    gain_db = max(10 * np.log10(max(np.sum(np.abs(paths["a"]) ** 2), 1e-20)), -150.0)
    if (paths["interactions"] == 0).all(axis=1).any():
        return sp.LinkState.LOS, gain_db
    return (sp.LinkState.NLOS if gain_db > -150.0 else sp.LinkState.OUTAGE), gain_db


def meant(partial: sp.PartialMap, tx: NDArray[np.float64], rx: NDArray[np.float64], paths: list[Paths]) -> list[Paths]:
    """Leave out diffracted paths that are not traced: with many reflections, at horizontal edges, open ends, junctions.

    Sionna RT takes any two walls of a junction for a wedge. Only in a sector wider than a half-plane there are
    directions that the walls hide from each other, so both legs must be in it.
    """
    wedges, shift = find_wedges(build_scene(partial), open_ends=False), np.array([*partial.origin_m, 0.0])
    edges = cKDTree(wedges.edge_m.reshape(-1, 2))
    kept = []
    for position, each in zip(rx, paths, strict=True):
        stays = ~is_bent(each)
        for k in np.flatnonzero(~stays) if edges.n else ():
            at = int((each["interactions"][k] == DIFFRACTION).argmax())
            vertices = each["vertices_m"][k][np.isfinite(each["vertices_m"][k, :, 0])]
            points = np.concatenate([tx[None], vertices, position[None]]) - shift
            distance, index = edges.query(points[at + 1, :2])
            legs = points[[at, at + 2], :2] - wedges.edge_m[index]
            inside = (legs @ wedges.normal[index].T > 0.0).any(axis=1).all()
            few, upright = len(vertices) <= 1 + MAX_REFLECTIONS, 1e-3 < points[at + 1, 2] < wedges.height_m - 1e-3
            stays[k] = few and distance < 0.01 and inside and upright
        kept.append({name: values[stays] for name, values in each.items()})
    return kept


def pair_paths(first: Paths, second: Paths) -> NDArray[np.intp]:
    """Match paths of one receiver one to one, nearest first: indices (M, 2).

    Paths are the same if their interactions are, their delays within `SAME_DELAY_S` and all points within
    `SAME_POINT_M`: in dense homes many paths have nearly equal delays.
    """
    deep = max(each["interactions"].shape[1] for each in (first, second))
    kinds, points = zip(*(_padded(each, deep) for each in (first, second)), strict=True)
    one, other = np.nonzero(np.abs(first["delay_s"][:, None] - second["delay_s"]) < SAME_DELAY_S)
    apart = np.abs(points[0][one] - points[1][other]).max(axis=1, initial=0.0)
    same = (kinds[0][one] == kinds[1][other]).all(axis=1) & (apart < SAME_POINT_M)
    pairs, taken = [], (set(), set())
    for k in np.flatnonzero(same)[np.argsort(apart[same], kind="stable")]:
        if one[k] not in taken[0] and other[k] not in taken[1]:
            pairs.append((one[k], other[k]))
            taken[0].add(one[k])
            taken[1].add(other[k])
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def _padded(paths: Paths, deep: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Interactions (P, D) and their positions (P, 3 D), 0 where there is none."""
    missing = deep - paths["interactions"].shape[1]
    kinds = np.pad(paths["interactions"], ((0, 0), (0, missing)))
    positions = np.nan_to_num(np.pad(paths["vertices_m"], ((0, 0), (0, missing), (0, 0))))
    return kinds, positions.reshape(len(kinds), 3 * deep)


def is_real(
    geometry: SceneGeometry | NDArray[np.float64],
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    vertices_m: NDArray[np.float64],
) -> bool:
    """Check one path in double precision: its legs cross no wall of a plan, or no triangle (F, 3, 3), within them."""
    points = np.concatenate([tx[None], vertices_m[np.isfinite(vertices_m[:, 0])], rx[None]])
    for start, leg in zip(points[:-1], np.diff(points, axis=0), strict=True):
        margin = TOUCH_M / max(float(np.linalg.norm(leg)), TOUCH_M)
        along = (
            _plan_crossings(geometry, start, leg)
            if isinstance(geometry, SceneGeometry)
            else _hits(geometry, start, leg)
        )
        if ((along > margin) & (along < 1 - margin)).any():
            return False
    return True


def _plan_crossings(
    geometry: SceneGeometry, start: NDArray[np.float64], leg: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Positions along a leg, as fractions of it, at which it crosses walls in the plan."""
    wall = geometry.walls_m[:, 1] - geometry.walls_m[:, 0]
    x, y = (geometry.walls_m[:, 0] - start[:2]).T
    area = leg[0] * wall[:, 1] - leg[1] * wall[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along, across = (x * wall[:, 1] - y * wall[:, 0]) / area, (x * leg[1] - y * leg[0]) / area
    return along[(across > 0) & (across < 1)]


def _hits(corners: NDArray[np.float64], start: NDArray[np.float64], leg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fractions of a leg at which it passes triangles (Moeller and Trumbore 1997)."""
    first, second, offset = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], start - corners[:, 0]
    normal = np.cross(leg, second)
    side = np.cross(offset, first)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (first * normal).sum(axis=1)
        u, v = (offset * normal).sum(axis=1) * scale, (side * leg).sum(axis=1) * scale
        along = (side * second).sum(axis=1) * scale
        return along[(u > 0) & (v > 0) & (u + v < 1)]
