"""Sequences of walls that can join two points of an extruded floor plan, by exact beam tracing in the plan.

A wall of full height reflects a path in the plan just as a line does, so which walls can join a transmitter to a
receiver is a question in two dimensions. From the image of the transmitter, the visible walls split the view into
beams; each beam reflects about its wall, and the receivers inside a beam are the only ones that its walls can reach.

Coordinates inside a beam: with the image source S and the window from A to B, a point is S + r ((1 - t)(A - S) +
t (B - S)). The window is r = 1, t runs over the beam from 0 to 1, and on any line 1 / r is linear in t, so the nearest
wall is the upper envelope of straight segments in (t, 1 / r).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, span_in_strip
from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import Plan, PointBins, bin_points, grow

TOLERANCE_M = 1e-4
"""Width by which beams are widened [m]: transmitter, receivers and corners share one lattice, and the solver that
checks the candidates computes in single precision."""

_STRIP_CELLS = 6.0
"""Depth of the strips in which a narrow beam is searched for walls [cells of the index]."""

_FAR_M = 1e6
"""Length at which beams that hit nothing are cut off [m]. It is fixed, so that no receiver depends on the others."""

_ROOT_ANGLE_RAD = 0.1234567
"""Direction of the first root beam [rad]: no wall of a lattice map is parallel to it."""


class Beams(NamedTuple):
    """All (sequence of walls, receiver) pairs that a specular path can join.

    M nodes form trees: a node is one beam, its walls those from the root down to it. Nodes 4 k to 4 k + 3 are the roots
    of source k, one for each quadrant of its view. `parent` is -1 at the roots; `segment` (M,) is the wall that
    reflected the beam, `source` (M, 2) the image of the transmitter [m]. The K pairs are ordered by sequence and then
    by receiver, each sequence of wall lines once for a receiver.
    """

    parent: NDArray[np.int32]
    segment: NDArray[np.int32]
    source: Floats
    pair_node: NDArray[np.int32]
    pair_rx: NDArray[np.int32]


def trace_beams(plan: Plan, tx_m: Floats, rx_m: Floats, max_depth: int) -> Beams:
    """Find every sequence of at most `max_depth` walls from a transmitter (2,), and receivers (N, 2) it can reach."""
    return trace_beams_in(plan, bin_points(rx_m), tx_m[None], np.array([max_depth]))


def trace_beams_in(plan: Plan, receivers: PointBins, sources_m: Floats, max_depth: NDArray[np.int64]) -> Beams:
    """Do the work of `trace_beams` for several sources (E, 2) [m], each with its own largest depth (E,)."""
    beam, node, pair = _trace_beams(plan, _root_beams(sources_m), max_depth, receivers)
    if plan.low.any():
        node, pair = _without_passes(node, pair)
    parent, piece, depth = node[:, :3].T.copy()
    pair_node, pair_rx = pair.T.copy()
    sequence = _sequence_ids(parent, np.append(plan.line, -1)[piece], depth)
    pair_rx = receivers.order[pair_rx].astype(np.int32)
    _, first = np.unique(sequence[pair_node] * max(1, len(receivers.order)) + pair_rx, return_index=True)
    segment = np.append(plan.owner, -1)[piece].astype(np.int32)
    return Beams(parent, segment, beam[:, :2].copy(), pair_node[first], pair_rx[first])


def _without_passes(node: NDArray[np.int32], pair: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Put in place of beams that passed over obstacles those that they are the rest of: the same image, and walls."""
    node, own = node.copy(), np.arange(len(node), dtype=np.int32)
    passed = np.flatnonzero(node[:, 4])
    for each in passed:  # parents come first
        own[each] = own[node[each, 0]]
    node[:, 0] = np.where(node[:, 0] < 0, -1, own[node[:, 0]])
    node[passed, 0] = own[passed]
    return node[:, :4], np.stack([own[pair[:, 0]], pair[:, 1]], axis=1)


def _sequence_ids(parent: NDArray[np.int32], line: NDArray[np.int32], depth: NDArray[np.int32]) -> NDArray[np.int64]:
    """Give sequences of wall lines numbers (M,), so that beams split by a gap in one line share a number."""
    sequence = np.arange(len(parent)) // 4
    lines = int(line.max(initial=0)) + 1
    used = int((depth == 0).sum()) // 4
    for level in range(1, int(depth.max(initial=0)) + 1):
        nodes = np.flatnonzero(depth == level)
        _, number = np.unique(sequence[parent[nodes]] * lines + line[nodes], return_inverse=True)
        sequence[nodes] = used + number
        used += int(number.max(initial=-1)) + 1
    return sequence


def _root_beams(sources: Floats) -> Floats:
    """Four quadrants of the view from each source, with a window at 1 m."""
    low = [_ROOT_ANGLE_RAD + 0.5 * np.pi * root for root in range(4)]
    window = [(0.0, 0.0, math.cos(angle), math.sin(angle), -math.sin(angle), math.cos(angle)) for angle in low]
    return (np.tile(sources, 3)[:, None] + np.array(window)).reshape(-1, 6)


class _Scratch(NamedTuple):
    """Arrays that one beam after the other is worked out in; `visit` ends with the number of the present beam."""

    found: Floats
    wall: NDArray[np.int32]
    order: NDArray[np.int32]
    active: NDArray[np.int32]
    edge: Floats
    piece: Floats
    piece_wall: NDArray[np.int32]
    visit: NDArray[np.int64]


@njit(cache=True, nogil=True)
def _trace_beams(plan, beam, left, receivers):  # type: ignore[no-untyped-def]
    """Breadth-first beam trees and the points inside each beam (see `trace_beams`).

    At a low wall a beam is reflected, and also goes on over it. Returns the beams (M, 6), their (parent, segment,
    depth, depth left, whether it passed) and the pairs (node, point).
    """
    walls, low, count = plan.pieces_m, plan.low, len(beam)
    node = np.zeros((count, 5), np.int32)
    for root in range(count):
        node[root, 0], node[root, 1], node[root, 2], node[root, 3] = -1, -1, 0, left[root // 4]
    pair = np.empty((4096, 2), np.int32)
    size = len(walls)
    scratch = _Scratch(
        np.empty((size, 4)),
        np.empty(size, np.int32),
        np.empty(size, np.int32),
        np.empty(size, np.int32),
        np.empty(2 * size + 2),
        np.empty((2 * size + 3, 4)),
        np.empty(2 * size + 3, np.int32),
        np.zeros(size + 1, np.int64),
    )
    k = pairs = np.int64(0)  # numba would compile a function that is called with the literal 0 twice
    while k < count:
        own = node[k, 1]
        for i in range(_visible_pieces(plan, beam[k], own, scratch)):
            pair, pairs = _add_points(beam[k], own >= 0, scratch.piece[i], receivers, k, pair, pairs)
            wall = scratch.piece_wall[i]
            if wall >= 0 and low[wall] and not was_met(node[:, 0], node[:, 1], node[:, 4], k, wall):
                beam, node = grow(beam, count + 1), grow(node, count + 1)
                if _pass(beam[k], scratch.piece[i], beam[count]):
                    node[count, 0], node[count, 1] = k, wall
                    node[count, 2], node[count, 3], node[count, 4] = node[k, 2], node[k, 3], 1
                    count += 1
            if wall < 0 or node[k, 3] == 0:
                continue
            beam, node = grow(beam, count + 1), grow(node, count + 1)
            if _reflect(beam[k], scratch.piece[i], walls[wall], beam[count]):
                node[count, 0], node[count, 1] = k, wall
                node[count, 2], node[count, 3], node[count, 4] = node[k, 2] + 1, node[k, 3] - 1, 0
                count += 1
        k += 1
    return beam[:count], node[:count], pair[:pairs]


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
def _visible_pieces(plan, beam, own, scratch):  # type: ignore[no-untyped-def]
    """Split a beam by the nearest wall: pieces (t0, w0, t1, w1), w = 0 where nothing is hit, and their walls.

    They are written to `scratch`; returns their number.
    """
    count = _walls_in(plan, beam, own, scratch)
    line, found, index, edge = plan.line, scratch.found, scratch.wall, scratch.edge
    edge[0], edge[1] = 0.0, 1.0
    for i in range(count):
        edge[2 * i + 2], edge[2 * i + 3] = min(max(found[i, 0], 0.0), 1.0), min(max(found[i, 2], 0.0), 1.0)
    _sort(edge, 2 * count + 2)
    pieces = begun = active = 0
    for i in range(2 * count + 1):
        t0, t1 = edge[i], edge[i + 1]
        if t1 - t0 < 1e-12:
            continue
        middle = 0.5 * (t0 + t1)
        while begun < count and found[scratch.order[begun], 0] <= middle:
            scratch.active[active] = scratch.order[begun]
            begun, active = begun + 1, active + 1
        active = _without_ended(found, scratch.active, active, middle)
        best, w0, w1 = _nearest(found, scratch.active[:active], t0, t1)
        wall = index[best] if best >= 0 else -1
        same = pieces > 0 and (
            scratch.piece_wall[pieces - 1] == wall
            or (
                wall >= 0
                and scratch.piece_wall[pieces - 1] >= 0
                and line[scratch.piece_wall[pieces - 1]] == line[wall]
                and plan.low[scratch.piece_wall[pieces - 1]] == plan.low[wall]
            )
        )
        if same:
            scratch.piece[pieces - 1, 2], scratch.piece[pieces - 1, 3] = t1, w1
        else:
            scratch.piece[pieces, 0], scratch.piece[pieces, 1] = t0, w0
            scratch.piece[pieces, 2], scratch.piece[pieces, 3] = t1, w1
            scratch.piece_wall[pieces] = wall
            pieces += 1
    return pieces


@njit(cache=True)
def _walls_in(plan, beam, own, scratch):  # type: ignore[no-untyped-def]
    """Clip the walls in a beam, from its window outwards, until nothing beyond them can be seen; their number.

    Cells of the index are visited in strips across the beam. What has not been visited lies beyond all strips, so that
    walls which fill the whole view within them hide it.
    """
    x0, y0, edge, columns, rows = plan.cells.grid
    x1, y1 = x0 + columns * edge, y0 + rows * edge
    sx, sy = beam[0], beam[1]
    ax, ay, bx, by = beam[2] - sx, beam[3] - sy, beam[4] - sx, beam[5] - sy
    length, width = 0.5 * (np.hypot(ax, ay) + np.hypot(bx, by)), np.hypot(ax - bx, ay - by)
    corner = np.empty((4, 2))
    near, count = 1.0 if own >= 0 else 0.0, 0
    scratch.visit[-1] += 1
    while True:
        far = near + max(_STRIP_CELLS * edge, near * width) / length
        for k, (r, dx, dy) in enumerate(((near, ax, ay), (near, bx, by), (far, bx, by), (far, ax, ay))):
            corner[k, 0], corner[k, 1] = sx + r * dx, sy + r * dy
        if _leaves(corner, x0 - edge, x1 + edge, 0, ax, bx) or _leaves(corner, y0 - edge, y1 + edge, 1, ay, by):
            return count
        count = _clip_cells(plan, beam, own, corner, count, scratch)
        if _is_filled(scratch, count, far):
            return count
        near = far


@njit(cache=True)
def _leaves(corner, low, high, axis, first, second):  # type: ignore[no-untyped-def]
    """Return whether the near side of a strip is beyond [low, high] along one axis and its beam runs on outwards."""
    return (min(corner[0, axis], corner[1, axis]) > high and min(first, second) >= 0.0) or (
        max(corner[0, axis], corner[1, axis]) < low and max(first, second) <= 0.0
    )


@njit(cache=True)
def _clip_cells(plan, beam, own, corner, count, scratch):  # type: ignore[no-untyped-def]
    """Clip the walls in the cells of a strip which were not clipped before, and give their number with the others."""
    visit = scratch.visit[-1]
    first, last = _rows(corner, plan.cells)
    for row in range(first, last):
        begin, end = _entries(corner, plan.cells, row)
        for entry in range(begin, end):
            wall = plan.cells.piece[entry]
            if scratch.visit[wall] == visit:
                continue
            scratch.visit[wall] = visit
            if own >= 0 and plan.line[wall] == plan.line[own]:
                continue
            t0, w0, t1, w1 = _clip(beam, plan.pieces_m[wall], own >= 0)
            if t1 - t0 > 1e-12:
                scratch.found[count, 0], scratch.found[count, 1] = t0, w0
                scratch.found[count, 2], scratch.found[count, 3] = t1, w1
                scratch.wall[count] = wall
                k = count
                while k > 0 and scratch.found[scratch.order[k - 1], 0] > t0:
                    scratch.order[k] = scratch.order[k - 1]
                    k -= 1
                scratch.order[k] = count
                count += 1
    return count


@njit(cache=True)
def _rows(corner, bins):  # type: ignore[no-untyped-def]
    """First row of square bins that a quadrilateral reaches, and the one after the last."""
    y0, edge, rows = bins.grid[1], bins.grid[2], (len(bins.start) - 1) // int(bins.grid[3])
    low = min(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) - TOLERANCE_M
    high = max(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) + TOLERANCE_M
    return max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)


@njit(cache=True)
def _entries(corner, bins, row):  # type: ignore[no-untyped-def]
    """First entry of the bins of a row that a convex quadrilateral reaches, and the one after the last."""
    x0, y0, edge, columns = bins.grid[0], bins.grid[1], bins.grid[2], int(bins.grid[3])
    left, right = span_in_strip(corner, y0 + row * edge - TOLERANCE_M, y0 + (row + 1) * edge + TOLERANCE_M)
    if left > right:
        return 0, 0
    start = max(0, int(np.floor((left - TOLERANCE_M - x0) / edge)))
    stop = min(columns - 1, int(np.floor((right + TOLERANCE_M - x0) / edge)))
    return (bins.start[row * columns + start], bins.start[row * columns + stop + 1]) if start <= stop else (0, 0)


@njit(cache=True)
def _is_filled(scratch, count, far):  # type: ignore[no-untyped-def]
    """Return whether walls no farther than `far` fill the whole view."""
    reach = 1e-12
    for k in range(count):
        i = scratch.order[k]
        if scratch.found[i, 0] > reach:
            return False
        if min(scratch.found[i, 1], scratch.found[i, 3]) * far >= 1.0:
            reach = max(reach, scratch.found[i, 2] + 1e-12)
            if reach >= 1.0:
                return True
    return False


@njit(cache=True)
def _sort(values, count):  # type: ignore[no-untyped-def]
    """Sort the first `count` values in place (Shell 1959); `np.sort` takes a second to compile."""
    gap = 1
    while 3 * gap + 1 < count:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, count):
            value, k = values[i], i
            while k >= gap and values[k - gap] > value:
                values[k] = values[k - gap]
                k -= gap
            values[k] = value
        gap //= 3


@njit(cache=True)
def _without_ended(found, active, count, t):  # type: ignore[no-untyped-def]
    """Leave out the clipped walls that end before t; the number of the others."""
    kept = 0
    for k in range(count):
        if found[active[k], 2] >= t:
            active[kept] = active[k]
            kept += 1
    return kept


@njit(cache=True)
def _nearest(found, active, t0, t1):  # type: ignore[no-untyped-def]
    """Find the nearest of the clipped walls that reach from t0 to t1: its index (or -1), w0, w1."""
    middle = 0.5 * (t0 + t1)
    best, best_w, best_slope = -1, 0.0, 0.0
    for k in active:
        slope = (found[k, 3] - found[k, 1]) / (found[k, 2] - found[k, 0])
        w = found[k, 1] + slope * (middle - found[k, 0])
        if w > best_w or (w == best_w and k < best):
            best, best_w, best_slope = k, w, slope
    return best, best_w + best_slope * (t0 - middle), best_w + best_slope * (t1 - middle)


@njit(cache=True)
def _reflect(beam, piece, wall, child):  # type: ignore[no-untyped-def]
    """Write the beam reflected by one visible piece of a wall; False if it is too thin to matter."""
    sx, sy = beam[0], beam[1]
    for k in range(2):
        t, w = piece[2 * k], piece[2 * k + 1]
        child[4 - 2 * k] = sx + ((1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)) / w
        child[5 - 2 * k] = sy + ((1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)) / w
    dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
    away = (dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])) / (dx * dx + dy * dy)
    width = np.hypot(child[2] - child[4], child[3] - child[5])
    distance = abs(away) * np.hypot(dx, dy)
    if width < 1e-9 or distance < 1e-9:
        return False
    child[0], child[1] = sx + 2.0 * away * dy, sy - 2.0 * away * dx
    area = (child[2] - child[0]) * (child[5] - child[1]) - (child[3] - child[1]) * (child[4] - child[0])
    return area > 1e-15


@njit(cache=True)
def _pass(beam, piece, child):  # type: ignore[no-untyped-def]
    """Write the rest of a beam beyond one visible piece of a wall; False if it is too thin to matter."""
    child[0], child[1] = sx, sy = beam[0], beam[1]
    for k in range(2):
        t, w = piece[2 * k], piece[2 * k + 1]
        child[2 + 2 * k] = sx + ((1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)) / w
        child[3 + 2 * k] = sy + ((1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)) / w
    area = (child[2] - sx) * (child[5] - sy) - (child[3] - sy) * (child[4] - sx)
    return np.hypot(child[2] - child[4], child[3] - child[5]) >= 1e-9 and area > 1e-15


@njit(cache=True)
def was_met(parent, wall_of, passed, node, wall):  # type: ignore[no-untyped-def]
    """Return whether a beam has met a wall since its reflection: prevents endless passes through slivers at corners."""
    while node >= 0:
        if wall_of[node] == wall:
            return True
        if passed[node] == 0:
            break
        node = parent[node]
    return False


@njit(cache=True)
def _add_points(beam, reflected, piece, receivers, node, pair, pairs):  # type: ignore[no-untyped-def]
    """Pair a node with the points between the window of its beam and one piece of its view."""
    points, corner = receivers.points_m, _corners(beam, reflected, piece)
    normal, offset = _inward_edges(corner)
    first, last = _rows(corner, receivers)
    for row in range(first, last):
        begin, end = _entries(corner, receivers, row)
        for i in range(begin, end):
            inside = True
            for k in range(4):
                side = normal[k, 0] * points[i, 0] + normal[k, 1] * points[i, 1] - offset[k]
                if side < -TOLERANCE_M:
                    inside = False
                    break
            if inside:
                pair = grow(pair, pairs + 1)
                pair[pairs, 0], pair[pairs, 1] = node, i
                pairs += 1
    return pair, pairs


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
        corner[k, 0], corner[k, 1] = sx + r_near * dx, sy + r_near * dy
        corner[3 - k, 0], corner[3 - k, 1] = sx + r_far * dx, sy + r_far * dy
    return corner


@njit(cache=True)
def _inward_edges(corner):  # type: ignore[no-untyped-def]
    """Give unit inward normals and offsets of a clockwise quadrilateral; an edge of no length bounds nothing."""
    normal, offset = np.empty((4, 2)), np.empty(4)
    for k in range(4):
        normal[k, 0], normal[k, 1], offset[k] = 0.0, 0.0, -1.0
        dx, dy = corner[(k + 1) % 4, 0] - corner[k, 0], corner[(k + 1) % 4, 1] - corner[k, 1]
        length = np.hypot(dx, dy)
        if length > 0.0:
            normal[k, 0], normal[k, 1] = dy / length, -dx / length
            offset[k] = normal[k, 0] * corner[k, 0] + normal[k, 1] * corner[k, 1]
    return normal, offset
