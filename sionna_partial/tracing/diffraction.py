"""Exact candidates of paths that bend once around a vertical edge, with few reflections before and after.

An edge is a point in the plan. Beams from the transmitter reach edges, beams from an edge reach receivers, and a path
joins one of each. On a vertical edge Keller's cone keeps the slope of a path, so heights unfold along the whole way in
the plan as they do without the edge.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sionna_partial.tracing.beams import trace_beams_in
from sionna_partial.tracing.candidates import (
    BEND,
    CEILING,
    FLOOR,
    Candidates,
    Wedges,
    can_bounce,
    faces_of,
    merge_heights,
    unfold,
)
from sionna_partial.tracing.plan import Plan, bin_points, grow
from sionna_partial.tracing.scene import SceneGeometry

MAX_REFLECTIONS = 2
"""Largest number of reflections around the diffraction, those off floor and ceiling included."""

_EXTERIOR_M = 1e-5
"""Distance from the plane of a face [m] at which the path solver counts a point as outside a wedge."""

_NEAR_M = 1e-3
"""Shortest leg in the plan next to an edge [m]: walls that meet there do not mirror it."""

_FLAT_RAD = 1e-3
"""Walls that meet at less than this angle from a straight line form no edge [rad]."""

_EDGES_AT_ONCE = 32
"""Number of edges whose beams are held in memory together. It does not depend on the receivers, nor does the order of
the candidates."""


@dataclass(frozen=True)
class _Arrivals:
    """Ways from the transmitter to edges, ordered by edge.

    `start` (E + 1,) gives the first of each edge, `count` (J,) the number of reflections, `length_m` (J,) the way in
    the plan, and `wall` (J, R) and `place` (J, R, 3) the reflections as `unfold` gives them.
    """

    start: NDArray[np.int64]
    count: NDArray[np.int64]
    length_m: NDArray[np.float64]
    wall: NDArray[np.int64]
    place: NDArray[np.float64]


def find_wedges(geometry: SceneGeometry, *, open_ends: bool) -> Wedges:
    """Find the vertical edges of the walls that diffract.

    Parameters
    ----------
    geometry : SceneGeometry
    open_ends : bool
        Whether walls that end because observation did diffract there.
    """
    vertex = geometry.segments.ravel()
    away = geometry.vertices_m[geometry.segments[:, ::-1].ravel()] - geometry.vertices_m[vertex]
    angle = np.arctan2(away[:, 1], away[:, 0])
    order = np.lexsort([angle, vertex])
    vertex, angle = vertex[order], angle[order]
    start, count = np.unique(vertex, return_index=True, return_counts=True)[1:]
    after = np.arange(len(vertex)) + 1
    after[start + count - 1] = start
    width = (angle[after] - angle) % (2 * np.pi)
    width[after == np.arange(len(vertex))] = 2 * np.pi
    wide = np.flatnonzero((width > np.pi + _FLAT_RAD) & (open_ends | ~geometry.open_end[vertex]))
    face = (order ^ 1).astype(np.int32)  # of the two triangles of a wall, the second stands at its first end
    pair = np.stack([face[wide], face[after[wide]]], axis=1)
    first, last = angle[wide], angle[after[wide]]
    normal = np.array([[-np.sin(first), np.cos(first)], [np.sin(last), -np.cos(last)]]).transpose(2, 0, 1)
    return Wedges(
        edge_m=geometry.vertices_m[vertex[wide]],
        height_m=geometry.height_m,
        face=np.concatenate([pair, pair[:, ::-1]]),
        normal=np.concatenate([normal, normal[:, ::-1]]),
    )


def diffraction_candidates(
    geometry: SceneGeometry,
    wedges: Wedges,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    max_depth: int,
    *,
    walls_a_side: int = MAX_REFLECTIONS,
    candidates_per_block: int = 100_000,
) -> Iterator[tuple[Candidates, float]]:
    """Find every way over one vertical edge with at most two reflections, block by block.

    Parameters
    ----------
    geometry : SceneGeometry
    wedges : Wedges
    tx_m, rx_m : (3,) and (N, 3) arrays
        Transmitter and receivers in the local frame [m], between floor (z = 0) and ceiling.
    max_depth : int
        Largest number of interactions of a path, the diffraction included.
    walls_a_side : int
        Largest number of walls that mirror a path before its diffraction, and after it.
    candidates_per_block : int
        Number of candidates in a block, which bounds the memory.

    Yields
    ------
    Candidates
    float
        Share of all edges done with this block.
    """
    reflections = min(MAX_REFLECTIONS, max_depth - 1)
    if reflections < 0 or len(wedges.edge_m) == 0:
        return
    walls_m = geometry.walls_m
    flats = (geometry.floor_face >= 0, geometry.ceiling_face >= 0)
    normals = wedges.normal[: len(wedges.edge_m)].reshape(-1, 4)
    plan, receivers = geometry.plan, bin_points(rx_m[:, :2])
    arrivals = _arrivals(plan, walls_m, wedges.edge_m, tx_m, min(walls_a_side, reflections))
    reached = np.flatnonzero(np.diff(arrivals.start))
    for first in range(0, len(reached), _EDGES_AT_ONCE):
        group = reached[first : first + _EDGES_AT_ONCE]
        fewest = np.minimum.reduceat(arrivals.count, arrivals.start[group])
        onward = np.minimum(walls_a_side, reflections - fewest)
        beams = trace_beams_in(plan, receivers, wedges.edge_m[group], onward)
        common = (beams.parent, beams.segment, beams.source, beams.pair_node, beams.pair_rx, walls_m, rx_m)
        ways = (group, wedges.edge_m, arrivals.start, arrivals.count, arrivals.length_m, arrivals.wall, arrivals.place)
        rows = _combine(*common, *ways, normals, tx_m, reflections, *flats)
        for low in range(0, len(rows), candidates_per_block):
            part = rows[low : low + candidates_per_block]
            rx, surface, vertices_m = _write(part, *common, *ways, tx_m, geometry.height_m, reflections)
            share = (first + len(group) * min(1.0, (low + candidates_per_block) / len(rows))) / len(reached)
            yield Candidates(rx, faces_of(surface, geometry), vertices_m, part[:, 2].copy(), wedges), share


def _arrivals(
    plan: Plan,
    walls_m: NDArray[np.float64],
    edges_m: NDArray[np.float64],
    tx_m: NDArray[np.float64],
    reflections: int,
) -> _Arrivals:
    """Find the ways of at most `reflections` walls from the transmitter to each edge."""
    beams = trace_beams_in(plan, bin_points(edges_m), tx_m[None, :2], np.array([reflections]))
    order = np.argsort(beams.pair_rx, kind="stable")
    node, edge = beams.pair_node[order], beams.pair_rx[order]
    good, count, length_m, wall, place = _unfold_all(
        beams.parent, beams.segment, beams.source, node, edge, walls_m, edges_m, tx_m, max(1, reflections)
    )
    start = np.searchsorted(edge[good], np.arange(len(edges_m) + 1))
    return _Arrivals(start, count[good], length_m[good], wall[good], place[good])


@njit(cache=True)
def _unfold_all(parent, segment, source, node, edge, walls, edges, tx, reflections):  # type: ignore[no-untyped-def]
    """Reflections on the way to each edge, and whether the last of them is not at the edge itself."""
    good, count = np.empty(len(node), np.bool_), np.empty(len(node), np.int64)
    length, wall = np.empty(len(node)), np.empty((len(node), reflections), np.int64)
    place = np.empty((len(node), reflections, 3))
    for i in range(len(node)):
        x, y = edges[edge[i], 0], edges[edge[i], 1]
        count[i], length[i], good[i] = unfold(
            parent, segment, source, node[i], walls, edges[edge[i]], wall[i], place[i]
        )
        px, py = tx[0], tx[1]
        if good[i] and count[i] > 0:
            px, py = place[i, count[i] - 1, 0], place[i, count[i] - 1, 1]
        good[i] = good[i] and np.hypot(px - x, py - y) > _NEAR_M
    return good, count, length, wall, place


@njit(cache=True)
def _root(parent, node):  # type: ignore[no-untyped-def]
    """Root of a node's tree."""
    while parent[node] >= 0:
        node = parent[node]
    return node


@njit(cache=True)
def _outside(normals, x, y):  # type: ignore[no-untyped-def]
    """Whether a point, seen from the edge, is in front of the 0-face of a wedge, and in front of either face."""
    first = normals[0] * x + normals[1] * y > _EXTERIOR_M
    return first, first or normals[2] * x + normals[3] * y > _EXTERIOR_M


@njit(cache=True)
def _combine(  # type: ignore[no-untyped-def]
    parent, segment, source, pair_node, pair_rx, walls, rx,
    group, edges, start, count, length, wall, place,
    normals, tx, reflections, floor, ceiling,
):  # fmt: skip
    """Join arrivals and departures: rows of (pair, arrival, wedge, bounces off floor and ceiling, first of them)."""
    rows, used = np.empty((1024, 5), np.int32), 0
    chain, onward = np.empty(max(1, reflections), np.int64), np.empty((max(1, reflections), 3))
    for i in range(len(pair_node)):
        edge = group[_root(parent, pair_node[i]) // 4]
        target = rx[pair_rx[i]]
        after, _, good = unfold(parent, segment, source, pair_node[i], walls, target, chain, onward)
        ox, oy = (onward[0, 0], onward[0, 1]) if after > 0 else (target[0], target[1])
        ox, oy = ox - edges[edge, 0], oy - edges[edge, 1]
        if not good or np.hypot(ox, oy) < _NEAR_M:
            continue
        for j in range(start[edge], start[edge + 1]):
            left = reflections - count[j] - after
            if left < 0:
                continue
            ix, iy = (place[j, count[j] - 1, 0], place[j, count[j] - 1, 1]) if count[j] > 0 else (tx[0], tx[1])
            lit, outside = _outside(normals[edge], ix - edges[edge, 0], iy - edges[edge, 1])
            if not outside or not _outside(normals[edge], ox, oy)[1]:
                continue
            rows = grow(rows, used + 1 + 2 * left)
            for bounces in range(left + 1):
                for flat in (FLOOR, CEILING):
                    if can_bounce(bounces, flat, floor, ceiling):
                        rows[used, 0], rows[used, 1], rows[used, 2] = i, j, edge if lit else edge + len(edges)
                        rows[used, 3], rows[used, 4] = bounces, flat
                        used += 1
    return rows[:used].copy()


@njit(cache=True)
def _write(  # type: ignore[no-untyped-def]
    rows, parent, segment, source, pair_node, pair_rx, walls, rx,
    group, edges, start, count, length, wall, place,
    tx, height, reflections,
):  # fmt: skip
    """Candidates of the rows that `_combine` gives."""
    out_rx = np.empty(len(rows), np.int32)
    surface = np.full((len(rows), reflections + 1), -1, np.int32)
    vertices = np.zeros((len(rows), reflections + 1, 3))
    chain, way = np.empty(reflections + 1, np.int64), np.empty((reflections + 1, 3))
    for k in range(len(rows)):
        i, j, bounces, flat = rows[k, 0], rows[k, 1], np.int64(rows[k, 3]), np.int64(rows[k, 4])
        edge = group[_root(parent, pair_node[i]) // 4]
        target = rx[pair_rx[i]]
        before = count[j]
        after, onward, _ = unfold(
            parent, segment, source, pair_node[i], walls, target, chain[before + 1 :], way[before + 1 :]
        )
        total = length[j] + onward
        share, size = length[j] / total, before + 1 + after
        for n in range(before):
            chain[n], way[n, 0], way[n, 1] = wall[j, n], place[j, n, 0], place[j, n, 1]
            way[n, 2] = place[j, n, 2] * share
        chain[before], way[before, 0], way[before, 1], way[before, 2] = BEND, edges[edge, 0], edges[edge, 1], share
        for n in range(before + 1, size):
            way[n, 2] = (length[j] + onward * way[n, 2]) / total
        out_rx[k] = pair_rx[i]
        merge_heights(chain[:size], way[:size], tx, target, height, bounces, flat, surface[k], vertices[k])
    return out_rx, surface, vertices
