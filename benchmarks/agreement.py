"""How far two lists of paths agree, and which of them are real."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from stock import Paths, is_bent

import sionna_partial as sp
from sionna_partial.scene.scene import SceneGeometry, build_scene
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.plan.edges import MAX_REFLECTIONS, find_wedges

SAME_DELAY_S = 1e-11
"""Paths to one receiver whose delays differ by less are the same [s]: 3 mm."""

SAME_POINT_M = 0.03
"""Largest distance between the points of equal paths [m]. Sionna RT reflects at either of two nearly coplanar walls."""

TOUCH_M = 2e-3
"""Distance from the ends of a leg within which it may touch a wall [m]."""


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

    Where three walls or more meet, Sionna RT takes any two of them for a wedge. Only in a sector wider than a
    half-plane there are directions that the walls hide from each other, so both legs must lie in it.
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
    """Shares of a leg at which it passes triangles (Moeller and Trumbore 1997)."""
    first, second, offset = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], start - corners[:, 0]
    normal = np.cross(leg, second)
    side = np.cross(offset, first)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (first * normal).sum(axis=1)
        u, v = (offset * normal).sum(axis=1) * scale, (side * leg).sum(axis=1) * scale
        along = (side * second).sum(axis=1) * scale
        return along[(u > 0) & (v > 0) & (u + v < 1)]
