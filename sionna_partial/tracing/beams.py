"""Which chains of walls can join two points of an extruded floor plan, by exact beam tracing in the plan.

A wall of full height reflects a path in the plan just as a line does, so which chains of walls can join a transmitter
to a receiver is a question in two dimensions. From the image of the transmitter, the visible walls split the view
into beams; each beam reflects about its wall, and the receivers inside a beam are the only ones that its chain of
walls can reach.

Coordinates inside a beam: with the image source S and the window from A to B, a point is S + r ((1 - t)(A - S) +
t (B - S)). The window is r = 1, t runs over the beam from 0 to 1, and on any line 1 / r is linear in t, so the nearest
wall is the upper envelope of straight segments in (t, 1 / r).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sionna_partial.tracing.plan import Plan, PointBins, bin_points, grow, prepare_plan

TOLERANCE_M = 1e-4
"""Width by which beams are widened [m]: transmitter, receivers and corners share one lattice, and the solver that
checks the candidates computes in single precision."""

_FAR_M = 1e6
"""Length at which beams that hit nothing are cut off [m]. It is fixed, so that no receiver depends on the others."""

_ROOT_ANGLE_RAD = 0.1234567
"""Direction of the first root beam [rad]: no wall of a lattice map is parallel to it."""


@dataclass(frozen=True)
class Beams:
    """All (chain of walls, receiver) pairs that a specular path can join.

    Nodes form trees: a node is one beam, its chain the walls from the root down to it. Nodes 4 k to 4 k + 3 are the
    roots of source k, one for each quadrant of its view.

    Parameters
    ----------
    parent, segment : (M,) int32 arrays
        Parent node (-1 at the roots) and the wall segment that reflected the beam.
    source : (M, 2) float64 array
        Image of the transmitter [m].
    pair_node, pair_rx : (K,) int32 arrays
        The pairs, ordered by chain and then by receiver, each chain of wall lines once for a receiver.
    """

    parent: NDArray[np.int32]
    segment: NDArray[np.int32]
    source: NDArray[np.float64]
    pair_node: NDArray[np.int32]
    pair_rx: NDArray[np.int32]


def trace_beams(
    walls_m: NDArray[np.float64], tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], max_depth: int
) -> Beams:
    """Find every chain of at most `max_depth` walls and the receivers it can reach, seen from above.

    Parameters
    ----------
    walls_m : (S, 2, 2) array
        End points of the wall segments [m].
    tx_m : (2,) array
        Transmitter [m].
    rx_m : (N, 2) array
        Receivers [m].
    max_depth : int
        Largest number of wall reflections.
    """
    return trace_beams_in(prepare_plan(walls_m), bin_points(rx_m), tx_m[None], np.array([max_depth]))


def trace_beams_in(
    plan: Plan, receivers: PointBins, sources_m: NDArray[np.float64], max_depth: NDArray[np.int64]
) -> Beams:
    """Do the work of `trace_beams` for several sources (E, 2) [m], each with its own largest depth (E,)."""
    parent, piece, depth, source, pair_node, pair_rx = _trace_beams(
        plan.pieces_m, plan.line, sources_m, max_depth, receivers.points_m, receivers.start, receivers.grid
    )
    chain = _chain_ids(parent, np.append(plan.line, -1)[piece], depth)
    pair_rx = receivers.order[pair_rx].astype(np.int32)
    _, first = np.unique(chain[pair_node] * max(1, len(receivers.order)) + pair_rx, return_index=True)
    segment = np.append(plan.owner, -1)[piece].astype(np.int32)
    return Beams(parent, segment, source, pair_node[first], pair_rx[first])


def _chain_ids(parent: NDArray[np.int32], line: NDArray[np.int32], depth: NDArray[np.int32]) -> NDArray[np.int64]:
    """Give chains of wall lines numbers, so that beams split by a gap in one line share a number."""
    chain = np.arange(len(parent)) // 4
    lines = int(line.max(initial=0)) + 1
    used = int((depth == 0).sum()) // 4
    for level in range(1, int(depth.max(initial=0)) + 1):
        nodes = np.flatnonzero(depth == level)
        _, number = np.unique(chain[parent[nodes]] * lines + line[nodes], return_inverse=True)
        chain[nodes] = used + number
        used += int(number.max(initial=-1)) + 1
    return chain


@njit(cache=True)
def _trace_beams(walls, line, sources, max_depth, points, bins, grid):  # type: ignore[no-untyped-def]
    """Breadth-first beam trees and the points inside each beam (see `trace_beams`)."""
    beam, count = _root_beams(sources), 4 * len(sources)
    parent, segment, depth = np.full(count, -1, np.int32), np.full(count, -1, np.int32), np.zeros(count, np.int32)
    left = np.repeat(max_depth, 4)
    pair_node, pair_rx, pairs = np.empty(4096, np.int32), np.empty(4096, np.int32), 0
    piece = np.empty((2 * len(walls) + 3, 4))
    piece_wall = np.empty(2 * len(walls) + 3, np.int32)
    node = 0
    while node < count:
        pieces = _visible_pieces(walls, line, beam[node], segment[node], piece, piece_wall)
        for i in range(pieces):
            found = _points_in_piece(beam[node], segment[node] >= 0, piece[i], points, bins, grid)
            pair_node, pair_rx = grow(pair_node, pairs + len(found)), grow(pair_rx, pairs + len(found))
            pair_node[pairs : pairs + len(found)] = node
            pair_rx[pairs : pairs + len(found)] = found
            pairs += len(found)
            if piece_wall[i] < 0 or left[node] == 0:
                continue
            beam, parent = grow(beam, count + 1), grow(parent, count + 1)
            segment, depth, left = grow(segment, count + 1), grow(depth, count + 1), grow(left, count + 1)
            if _reflect(beam[node], piece[i], walls[piece_wall[i]], beam[count]):
                parent[count], segment[count] = node, piece_wall[i]
                depth[count], left[count] = depth[node] + 1, left[node] - 1
                count += 1
        node += 1
    return (
        parent[:count].copy(),
        segment[:count].copy(),
        depth[:count].copy(),
        beam[:count, :2].copy(),
        pair_node[:pairs].copy(),
        pair_rx[:pairs].copy(),
    )


@njit(cache=True)
def _root_beams(sources):  # type: ignore[no-untyped-def]
    """Four quadrants of the view from each source, with a window at 1 m."""
    beam = np.empty((4 * len(sources), 6))
    for root in range(len(beam)):
        x, y = sources[root // 4]
        low = _ROOT_ANGLE_RAD + 0.5 * np.pi * (root % 4)
        beam[root] = (x, y, x + np.cos(low), y + np.sin(low), x - np.sin(low), y + np.cos(low))
    return beam


@njit(cache=True)
def _clip(beam, wall, reflected):  # type: ignore[no-untyped-def]
    """Part of a wall inside a beam and beyond its window, as (t0, w0, t1, w1) with w = 1 / r and t0 < t1.

    Returns t0 >= t1 if there is none.
    """
    ax, ay = beam[2] - beam[0], beam[3] - beam[1]
    bx, by = beam[4] - beam[0], beam[5] - beam[1]
    area = ax * by - ay * bx
    px, py = wall[0, 0] - beam[0], wall[0, 1] - beam[1]
    qx, qy = wall[1, 0] - beam[0], wall[1, 1] - beam[1]
    alpha0, beta0 = (px * by - py * bx) / area, (ax * py - ay * px) / area
    alpha1, beta1 = (qx * by - qy * bx) / area, (ax * qy - ay * qx) / area
    nearest = 1.0 + 1e-9 if reflected else 1e-9
    low, high = 0.0, 1.0
    for start, stop in ((alpha0, alpha1), (beta0, beta1), (alpha0 + beta0 - nearest, alpha1 + beta1 - nearest)):
        if start < 0.0 and stop < 0.0:
            return 1.0, 0.0, 0.0, 0.0
        if start < 0.0:
            low = max(low, start / (start - stop))
        elif stop < 0.0:
            high = min(high, start / (start - stop))
    if low >= high:
        return 1.0, 0.0, 0.0, 0.0
    r0 = alpha0 + beta0 + low * (alpha1 + beta1 - alpha0 - beta0)
    r1 = alpha0 + beta0 + high * (alpha1 + beta1 - alpha0 - beta0)
    t0 = (beta0 + low * (beta1 - beta0)) / r0
    t1 = (beta0 + high * (beta1 - beta0)) / r1
    if t0 < t1:
        return t0, 1.0 / r0, t1, 1.0 / r1
    return t1, 1.0 / r1, t0, 1.0 / r0


@njit(cache=True)
def _visible_pieces(walls, line, beam, own, piece, piece_wall):  # type: ignore[no-untyped-def]
    """Split a beam by the nearest wall: pieces (t0, w0, t1, w1), w = 0 where nothing is hit, and their walls."""
    found = np.empty((len(walls), 4))
    index = np.empty(len(walls), np.int32)
    edge = np.empty(2 * len(walls) + 2)
    edge[0], edge[1] = 0.0, 1.0
    count = 0
    for i in range(len(walls)):
        if own >= 0 and line[i] == line[own]:
            continue
        t0, w0, t1, w1 = _clip(beam, walls[i], own >= 0)
        if t1 - t0 > 1e-12:
            found[count] = (t0, w0, t1, w1)
            index[count] = i
            edge[2 * count + 2], edge[2 * count + 3] = min(max(t0, 0.0), 1.0), min(max(t1, 0.0), 1.0)
            count += 1
    edges = np.sort(edge[: 2 * count + 2])
    pieces = 0
    for i in range(len(edges) - 1):
        t0, t1 = edges[i], edges[i + 1]
        if t1 - t0 < 1e-12:
            continue
        best, w0, w1 = _nearest(found[:count], t0, t1)
        wall = index[best] if best >= 0 else -1
        same = pieces > 0 and (
            piece_wall[pieces - 1] == wall
            or (wall >= 0 and piece_wall[pieces - 1] >= 0 and line[piece_wall[pieces - 1]] == line[wall])
        )
        if same:
            piece[pieces - 1, 2], piece[pieces - 1, 3] = t1, w1
        else:
            piece[pieces] = (t0, w0, t1, w1)
            piece_wall[pieces] = wall
            pieces += 1
    return pieces


@njit(cache=True)
def _nearest(found, t0, t1):  # type: ignore[no-untyped-def]
    """Find the nearest of the clipped walls from t0 to t1, where none of them ends: its index (or -1), w0, w1."""
    middle = 0.5 * (t0 + t1)
    best, best_w, best_slope = -1, 0.0, 0.0
    for k in range(len(found)):
        if found[k, 0] <= middle <= found[k, 2]:
            slope = (found[k, 3] - found[k, 1]) / (found[k, 2] - found[k, 0])
            w = found[k, 1] + slope * (middle - found[k, 0])
            if w > best_w:
                best, best_w, best_slope = k, w, slope
    return best, best_w + best_slope * (t0 - middle), best_w + best_slope * (t1 - middle)


@njit(cache=True)
def _reflect(beam, piece, wall, child):  # type: ignore[no-untyped-def]
    """Write the beam reflected by one visible piece of a wall; False if it is too thin to matter."""
    sx, sy = beam[0], beam[1]
    ends = np.empty((2, 2))
    for k in range(2):
        t, w = piece[2 * k], piece[2 * k + 1]
        ends[k, 0] = sx + ((1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)) / w
        ends[k, 1] = sy + ((1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)) / w
    dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
    away = (dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])) / (dx * dx + dy * dy)
    width = np.hypot(ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1])
    distance = abs(away) * np.hypot(dx, dy)
    if width < 1e-9 or distance < 1e-9:
        return False
    child[0], child[1] = sx + 2.0 * away * dy, sy - 2.0 * away * dx
    child[2:4], child[4:6] = ends[1], ends[0]
    area = (child[2] - child[0]) * (child[5] - child[1]) - (child[3] - child[1]) * (child[4] - child[0])
    return area > 1e-15


@njit(cache=True)
def _points_in_piece(beam, reflected, piece, points, bins, grid):  # type: ignore[no-untyped-def]
    """Find the points between the window of a beam and one piece of its view."""
    x0, y0, edge, columns = grid[0], grid[1], grid[2], int(grid[3])
    rows = (len(bins) - 1) // columns
    corner = _corners(beam, reflected, piece)
    normal, offset = _inward_edges(corner)
    found = np.empty(16, np.int32)
    count = 0
    low = corner[:, 1].min() - TOLERANCE_M
    high = corner[:, 1].max() + TOLERANCE_M
    first = max(0, int(np.floor((low - y0) / edge)))
    last = min(rows - 1, int(np.floor((high - y0) / edge)))
    for row in range(first, last + 1):
        left, right = _span(corner, y0 + row * edge - TOLERANCE_M, y0 + (row + 1) * edge + TOLERANCE_M)
        start = max(0, int(np.floor((left - TOLERANCE_M - x0) / edge)))
        stop = min(columns - 1, int(np.floor((right + TOLERANCE_M - x0) / edge)))
        if start > stop:
            continue
        for i in range(bins[row * columns + start], bins[row * columns + stop + 1]):
            inside = True
            for k in range(4):
                side = normal[k, 0] * points[i, 0] + normal[k, 1] * points[i, 1] - offset[k]
                if side < -TOLERANCE_M:
                    inside = False
                    break
            if inside:
                found = grow(found, count + 1)
                found[count] = i
                count += 1
    return found[:count]


@njit(cache=True)
def _corners(beam, reflected, piece):  # type: ignore[no-untyped-def]
    """Corners (4, 2) of the part of a beam between its window and one piece of its view, cut off where it is far."""
    sx, sy = beam[0], beam[1]
    corner = np.empty((4, 2))
    for k in range(2):
        t, w = piece[2 * k], piece[2 * k + 1]
        dx = (1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)
        dy = (1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)
        far = _FAR_M / np.hypot(dx, dy)
        r_far = 1.0 / w if w * far > 1.0 else far
        r_near = 1.0 if reflected else 0.0
        corner[k] = (sx + r_near * dx, sy + r_near * dy)
        corner[3 - k] = (sx + r_far * dx, sy + r_far * dy)
    return corner


@njit(cache=True)
def _inward_edges(corner):  # type: ignore[no-untyped-def]
    """Give unit inward normals and offsets of a clockwise quadrilateral; an edge of no length bounds nothing."""
    normal, offset = np.zeros((4, 2)), np.full(4, -1.0)
    for k in range(4):
        dx, dy = corner[(k + 1) % 4, 0] - corner[k, 0], corner[(k + 1) % 4, 1] - corner[k, 1]
        length = np.hypot(dx, dy)
        if length > 0.0:
            normal[k] = (dy / length, -dx / length)
            offset[k] = normal[k, 0] * corner[k, 0] + normal[k, 1] * corner[k, 1]
    return normal, offset


@njit(cache=True)
def _span(corner, low, high):  # type: ignore[no-untyped-def]
    """Smallest and largest x of a convex quadrilateral within the strip low <= y <= high."""
    left, right = np.inf, -np.inf
    for k in range(4):
        px, py = corner[k, 0], corner[k, 1]
        qx, qy = corner[(k + 1) % 4, 0], corner[(k + 1) % 4, 1]
        if low <= py <= high:
            left, right = min(left, px), max(right, px)
        for level in (low, high):
            if (py - level) * (qy - level) < 0.0:
                x = px + (level - py) / (qy - py) * (qx - px)
                left, right = min(left, x), max(right, x)
    return left, right
