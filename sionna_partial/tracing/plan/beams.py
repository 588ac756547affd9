"""Beams of a floor plan: sequences of walls that can reflect a path between two points, and the receivers they reach.

A wall of full height reflects a path in the plan as a line does, so that the search has two dimensions. The image of
the transmitter and a window, the part of the last wall that reflects it, bound a beam. Coordinates inside a beam: with
the image source S and the window from A to B, a point is S + r ((1 - t)(A - S) + t (B - S)). The window is r = 1, t
runs over the beam from 0 to 1, and on any line 1 / r is linear in t.

Beams between opaque walls (`trace_beams`) and beams through walls (`follow_beams`) share the geometry: clipping,
windows, reflection, and the bins of receivers in a beam. They remain two searches, which stop at different walls and
select by different rules; one search would clip and sort walls that an opaque wall hides:

- Opaque walls end a beam. The nearest wall is the upper envelope of segments in (t, 1 / r), and walls are clipped in
  strips from the window outwards until those found fill the view. Every sequence is listed, whatever its power, as
  `select.py` needs the sum of all bounds. A beam continues over a low wall as another beam.
- Through walls, all walls behind the window are clipped and sorted by distance between two edges, so that the walls in
  front of any point are known, and with them a bound of the power there. Beams too weak for every receiver end.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices, span_in_strip
from sionna_partial.process import njit
from sionna_partial.scene.outlines import Plan, PointBins, grow
from sionna_partial.tracing.plan.room import FACES, Building, Room
from sionna_partial.tracing.power import COSINES, gain_between
from sionna_partial.tracing.select import discount_after, matters, needs_by_distance

TOLERANCE_M = 1e-4
"""Width by which beams are widened [m]: transmitter, receivers and corners share one lattice, and the solver that
checks the candidates computes in single precision."""

_STRIP_CELLS = 6.0
"""Depth of the strips in which a narrow beam is searched for walls [cells of the index]."""

_CELL_M = 1.0
"""Edge of the cells of receivers that beams are compared with [m]."""

_THINNEST = 1e-12
"""Part of a beam's width below which nothing lies between two edges."""

_FAR_M = 1e6
"""Length at which beams that hit nothing are cut off [m]. It is fixed, so that no receiver depends on the others."""

_ROOT_ANGLE_RAD = 0.1234567
"""Direction of the first root beam [rad]: no wall of a lattice map is parallel to it."""


class BeamTree(NamedTuple):
    """M beams that form trees: a beam is the sequence of walls from a root down to it.

    `parent` (M,) is -1 at the roots, `piece` (M,) the piece of a wall that reflects the beam, and `source_m` (M, 2) the
    image of the transmitter. Beams 4 k to 4 k + 3 are the roots of source k, one for each quadrant of its view.
    """

    parent: NDArray[np.int32]
    piece: NDArray[np.int32]
    source_m: Floats


class _Scratch(NamedTuple):
    """Arrays that one beam after the other is worked out in; `visit` ends with the number of the present beam.

    Of the walls clipped to a beam, `found` (C, 4) are the parts (t0, 1 / r0, t1, 1 / r1), `wall` (C,) the pieces, and
    `order` sorts them by t0. `active` are the walls at a t, and `edge` the sorted ends.
    """

    found: Floats
    wall: NDArray[np.int32]
    order: NDArray[np.int32]
    active: NDArray[np.int32]
    edge: Floats
    visit: NDArray[np.int64]


class Needed(NamedTuple):
    """The power that a beam must have to matter, relative to (wavelength / 4 pi)^2.

    `power` (N,) is the smallest that matters to each receiver; `distance_m`, `relative` and `near` are as in
    `NeedsByDistance`, in the plan. `cells` (ny, nx) is the smallest in square cells, whose corner x0 and y0, edge
    [m] and number of columns are `grid` (4,).
    """

    power: Floats
    distance_m: Floats
    relative: Floats
    near: Floats
    cells: Floats
    grid: Floats


class CrossingBeams(NamedTuple):
    """M beams of one number of reflections.

    `parent` (M,) is the beam before the last reflection, counted through all beams, and `piece` (M,) the piece of wall
    that reflects it; -1 for the roots. `window` (M, 6) are the image of the transmitter and the ends of the window [m].
    `left` (M, 2) bounds what reflections and what walls leave of the power, `crossed` (M,) is the smallest number of
    walls, `sequence` (M,) the number of the sequence of lines.
    """

    parent: NDArray[np.int32]
    piece: NDArray[np.int32]
    window: Floats
    left: Floats
    crossed: NDArray[np.int32]
    sequence: NDArray[np.int64]


class Task(NamedTuple):
    """Inputs for beams of `order` reflections; walls transmit the fraction `most_transmitted` of the power at most."""

    order: int
    receivers: PointBins
    building: Building
    needed: Needed
    most_transmitted: float


class _Beam(NamedTuple):
    """One of `CrossingBeams`: its window, what reflections and walls leave of it, and how many walls it has crossed."""

    window: Floats
    reflected: float
    left: float
    crossed: np.int64


class _Layers(NamedTuple):
    """Scratch of one beam: the walls in it, and the walls between two edges, from the window outwards.

    For clipped wall c, `slope` (C,) is the slope of 1 / r, `along` (C, 2) its direction. For edge i, `ray` (E, 3) is
    the direction and length of the beam there. Between edges i and i + 1 lie `depth` (E,) walls: `wall` (E, D), behind
    which `left` (E, D) of the power is left after `crossed` (E, D) walls. `open` (P,) is the last window of a line.
    """

    clipped: _Scratch
    slope: Floats
    along: Floats
    ray: Floats
    depth: NDArray[np.int64]
    wall: NDArray[np.int64]
    left: Floats
    crossed: NDArray[np.int64]
    open: NDArray[np.int64]


def first_beams(room: Room) -> CrossingBeams:
    """Return the beams from the transmitter, with its largest gain as a bound of what reflections leave."""
    window = _root_beams(room.tx_m[None, :2])
    left = np.tile([room.gains.largest, 1.0], (len(window), 1))
    none, nothing = np.full(len(window), -1, np.int32), np.zeros(len(window), np.int64)
    return CrossingBeams(none, none, window, left, nothing.astype(np.int32), nothing)


def needed_of(power: Floats, room: Room, wavelength_m: float) -> Needed:
    """Sort what matters to receivers (N,)."""
    far = needs_by_distance(room.tx_m[:2], room.rx_m[:, :2], power, wavelength_m)
    power = power * (4.0 * math.pi / wavelength_m) ** 2
    low = room.rx_m[:, :2].min(axis=0)
    column, row = ((room.rx_m[:, :2] - low) / _CELL_M).astype(np.int64).T
    cells = np.full((row.max() + 1, column.max() + 1), np.inf)
    np.minimum.at(cells, (row, column), power)
    return Needed(power, *far, cells, np.array([*low, _CELL_M, cells.shape[1]]))


def trace_beams(
    plan: Plan, receivers: PointBins, sources_m: Floats, max_depth: NDArray[np.int64]
) -> tuple[BeamTree, NDArray[np.int32]]:
    """Find every sequence of opaque walls from sources (E, 2), each with its own largest depth (E,), to receivers.

    Returns the beams and pairs (K, 2) of a beam and a receiver in its view, ordered by sequence and then by receiver,
    each sequence of wall lines once for a receiver.
    """
    beam, node, pair = _trace_beams(plan, _root_beams(sources_m), max_depth, receivers)
    if plan.low.any():
        node, pair = _without_passes(node, pair)
    parent, piece, depth = node[:, :3].T.copy()
    sequence = _sequence_ids(parent, np.append(plan.line, -1)[piece], depth)
    pair[:, 1] = receivers.order[pair[:, 1]]
    return BeamTree(parent, piece, beam[:, :2].copy()), pair[first_pairs(sequence, pair, len(receivers.order))]


def first_pairs(sequence: NDArray[np.int64], pairs: NDArray[np.int32], receivers: int) -> Indices:
    """Return the rows of the first pair (beam, receiver) of each sequence (M,) and receiver, in this order."""
    return np.unique(sequence[pairs[:, 0]] * max(1, receivers) + pairs[:, 1], return_index=True)[1]


def _without_passes(node: NDArray[np.int32], pair: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Replace beams that passed over obstacles by the beams that they continue, which have the same image and walls."""
    node, own = node.copy(), np.arange(len(node), dtype=np.int32)
    passed = np.flatnonzero(node[:, 4])
    for beam in passed:  # parents come first
        own[beam] = own[node[beam, 0]]
    node[:, 0] = np.where(node[:, 0] < 0, -1, own[node[:, 0]])
    node[passed, 0] = own[passed]
    return node[:, :4], np.stack([own[pair[:, 0]], pair[:, 1]], axis=1)


def _sequence_ids(parent: NDArray[np.int32], line: NDArray[np.int32], depth: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the numbers (M,) of sequences of wall lines: beams that a gap in one line splits share a number."""
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
    """Return four quadrants of the view from each source, with a window at 1 m."""
    low = [_ROOT_ANGLE_RAD + 0.5 * np.pi * root for root in range(4)]
    window = [(0.0, 0.0, math.cos(angle), math.sin(angle), -math.sin(angle), math.cos(angle)) for angle in low]
    return (np.tile(sources, 3)[:, None] + np.array(window)).reshape(-1, 6)


@njit(cache=True, nogil=True)
def _trace_beams(plan, beam, left, receivers):  # type: ignore[no-untyped-def]
    """Return breadth-first beam trees and the points inside each beam (see `trace_beams`).

    At a low wall a beam is reflected, and also continues over it. Returns the beams (M, 6), their (parent, segment,
    depth, depth left, whether it passed) and the pairs (node, point).
    """
    walls, low, count = plan.pieces_m, plan.low, len(beam)
    node = np.zeros((count, 5), np.int32)
    for root in range(count):
        node[root, 0], node[root, 1], node[root, 2], node[root, 3] = -1, -1, 0, left[root // 4]
    pair = np.empty((4096, 2), np.int32)
    scratch, view = _scratch_of(plan), np.empty((2 * len(walls) + 3, 4))
    view_wall = np.empty(2 * len(walls) + 3, np.int32)
    k = pairs = np.int64(0)  # numba would compile a function that is called with the literal 0 twice
    while k < count:
        own = node[k, 1]
        for i in range(_visible_pieces(plan, beam[k], own, scratch, view, view_wall)):
            pair, pairs = _add_points(beam[k], own >= 0, view[i], receivers, k, pair, pairs)
            wall = view_wall[i]
            if wall >= 0 and low[wall] and not _was_met(node[:, 0], node[:, 1], node[:, 4], k, wall):
                beam, node = grow(beam, count + 1), grow(node, count + 1)
                if _pass(beam[k], view[i], beam[count]):
                    node[count, 0], node[count, 1] = k, wall
                    node[count, 2], node[count, 3], node[count, 4] = node[k, 2], node[k, 3], 1
                    count += 1
            if wall < 0 or node[k, 3] == 0:
                continue
            beam, node = grow(beam, count + 1), grow(node, count + 1)
            if _reflect(beam[k], view[i], walls[wall], beam[count]):
                node[count, 0], node[count, 1] = k, wall
                node[count, 2], node[count, 3], node[count, 4] = node[k, 2] + 1, node[k, 3] - 1, 0
                count += 1
        k += 1
    return beam[:count], node[:count], pair[:pairs]


@njit(cache=True)
def _clip(beam, wall, reflected):  # type: ignore[no-untyped-def]
    """Return the part of a wall inside a beam and beyond its window, as (t0, w0, t1, w1) with w = 1 / r and t0 < t1.

    t0 >= t1 if there is none.
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
def _visible_pieces(plan, beam, own, scratch, view, view_wall):  # type: ignore[no-untyped-def]
    """Split a beam by the nearest wall; return the number of pieces of the view.

    Pieces are (t0, w0, t1, w1) with w = 1 / r, or 0 where nothing is hit, and their walls.
    """
    count = _walls_in(plan, beam, own, scratch)
    line, low, found, order, walls = plan.line, plan.low, scratch.found, scratch.order, scratch.wall
    active, edge = scratch.active, scratch.edge
    _sort_edges(found, edge, count)
    pieces = begun = number = np.int64(0)
    for i in range(2 * count + 1):
        t0, t1 = edge[i], edge[i + 1]
        if t1 - t0 < _THINNEST:
            continue
        begun, number = _move_to(0.5 * (t0 + t1), found, order, active, count, begun, number)
        best, w0, w1 = _nearest(found, active[:number], t0, t1)
        wall = walls[best] if best >= 0 else -1
        last = view_wall[pieces - 1] if pieces > 0 else -2
        if last == wall or (wall >= 0 and last >= 0 and line[last] == line[wall] and low[last] == low[wall]):
            view[pieces - 1, 2], view[pieces - 1, 3] = t1, w1
        else:
            view[pieces, 0], view[pieces, 1], view[pieces, 2], view[pieces, 3] = t0, w0, t1, w1
            view_wall[pieces] = wall
            pieces += 1
    return pieces


@njit(cache=True)
def _walls_in(plan, beam, own, scratch):  # type: ignore[no-untyped-def]
    """Clip the walls in a beam, from its window outwards, until they hide everything beyond them; return their number.

    Cells of the index are visited in strips across the beam. Other cells lie beyond all strips, so that walls that fill
    the whole view within the strips hide them.
    """
    x0, y0, edge, columns, rows = plan.cells.grid
    x1, y1 = x0 + columns * edge, y0 + rows * edge
    sx, sy = beam[0], beam[1]
    ax, ay, bx, by = beam[2] - sx, beam[3] - sy, beam[4] - sx, beam[5] - sy
    length, width = 0.5 * (np.hypot(ax, ay) + np.hypot(bx, by)), np.hypot(ax - bx, ay - by)
    corner = np.empty((4, 2))
    near, count = 1.0 if own >= 0 else 0.0, np.int64(0)
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
    """Clip the walls in the cells of a strip that were not clipped before; return the number of all clipped walls."""
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
    """Return the first row of square bins that a quadrilateral reaches, and the row after the last."""
    y0, edge, rows = bins.grid[1], bins.grid[2], (len(bins.start) - 1) // int(bins.grid[3])
    low = min(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) - TOLERANCE_M
    high = max(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) + TOLERANCE_M
    return max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)


@njit(cache=True)
def _entries(corner, bins, row):  # type: ignore[no-untyped-def]
    """Return the first entry of the bins of a row that a convex quadrilateral reaches, and the entry after the last."""
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
def _sort_edges(found, edge, count):  # type: ignore[no-untyped-def]
    """Write the sorted ends of the clipped walls, and of the beam."""
    edge[0], edge[1] = 0.0, 1.0
    for i in range(count):
        edge[2 * i + 2], edge[2 * i + 3] = min(max(found[i, 0], 0.0), 1.0), min(max(found[i, 2], 0.0), 1.0)
    _sort(edge, 2 * count + 2)


@njit(cache=True)
def _move_to(t, found, order, active, count, begun, number):  # type: ignore[no-untyped-def]
    """Update the walls that are active at a larger t; return the numbers of walls begun and active."""
    while begun < count and found[order[begun], 0] <= t:
        active[number] = order[begun]
        begun, number = begun + 1, number + 1
    kept = 0
    for k in range(number):
        if found[active[k], 2] >= t:
            active[kept] = active[k]
            kept += 1
    return begun, kept


@njit(cache=True)
def _nearest(found, active, t0, t1):  # type: ignore[no-untyped-def]
    """Return the nearest of the clipped walls that reach from t0 to t1, or -1, and its w0 and w1."""
    middle = 0.5 * (t0 + t1)
    best, best_w, best_slope = -1, 0.0, 0.0
    for k in active:
        slope = (found[k, 3] - found[k, 1]) / (found[k, 2] - found[k, 0])
        w = found[k, 1] + slope * (middle - found[k, 0])
        if w > best_w or (w == best_w and k < best):
            best, best_w, best_slope = k, w, slope
    return best, best_w + best_slope * (t0 - middle), best_w + best_slope * (t1 - middle)


@njit(cache=True)
def _open(beam, piece, child):  # type: ignore[no-untyped-def]
    """Write the rest of a beam beyond one piece of its view; return the width of its window."""
    child[0], child[1] = sx, sy = beam[0], beam[1]
    for k in range(2):
        t, w = piece[2 * k], piece[2 * k + 1]
        child[2 + 2 * k] = sx + ((1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)) / w
        child[3 + 2 * k] = sy + ((1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)) / w
    return np.hypot(child[2] - child[4], child[3] - child[5])


@njit(cache=True)
def _is_wide(beam):  # type: ignore[no-untyped-def]
    """Return whether the source of a beam is in front of its window, and not on it."""
    return (beam[2] - beam[0]) * (beam[5] - beam[1]) - (beam[3] - beam[1]) * (beam[4] - beam[0]) > 1e-15


@njit(cache=True)
def _reflect(beam, piece, wall, child):  # type: ignore[no-untyped-def]
    """Write the beam reflected by one visible piece of a wall; return False if it is too thin to matter."""
    width, sx, sy = _open(beam, piece, child), beam[0], beam[1]
    dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
    away = (dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])) / (dx * dx + dy * dy)
    if width < 1e-9 or abs(away) * np.hypot(dx, dy) < 1e-9:
        return False
    child[0], child[1] = sx + 2.0 * away * dy, sy - 2.0 * away * dx
    child[2], child[3], child[4], child[5] = child[4], child[5], child[2], child[3]
    return _is_wide(child)


@njit(cache=True)
def _pass(beam, piece, child):  # type: ignore[no-untyped-def]
    """Write the beam that passes over one visible piece of a wall; return False if it is too thin to matter."""
    return _open(beam, piece, child) >= 1e-9 and _is_wide(child)


@njit(cache=True)
def _was_met(parent, wall_of, passed, node, wall):  # type: ignore[no-untyped-def]
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
    """Return the corners (4, 2) of a beam between its window and one piece of its view, cut off where it is far."""
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
    """Return unit inward normals and offsets of a clockwise quadrilateral; an edge of no length bounds nothing."""
    normal, offset = np.empty((4, 2)), np.empty(4)
    for k in range(4):
        normal[k, 0], normal[k, 1], offset[k] = 0.0, 0.0, -1.0
        dx, dy = corner[(k + 1) % 4, 0] - corner[k, 0], corner[(k + 1) % 4, 1] - corner[k, 1]
        length = np.hypot(dx, dy)
        if length > 0.0:
            normal[k, 0], normal[k, 1] = dy / length, -dx / length
            offset[k] = normal[k, 0] * corner[k, 0] + normal[k, 1] * corner[k, 1]
    return normal, offset


@njit(cache=True, nogil=True)
def follow_beams(beams, first, stop, task):  # type: ignore[no-untyped-def]
    """Follow some beams through walls: return the beams that walls reflect, pairs (beam, receiver), and powers.

    The power of a pair is a bound of the fraction that walls leave.
    """
    layers, plan = _layers_of(task.building.plan), task.building.plan
    parent, piece = np.empty(64, np.int32), np.empty(64, np.int32)
    window, left = np.empty((64, 6)), np.empty((64, 2))
    crossed, sequence = np.empty(64, np.int32), np.empty(64, np.int64)
    windows = np.empty((64, 4)), np.empty((64, 2), np.int64), np.int64(0)
    pairs = np.empty((1024, 2), np.int32), np.empty(1024), np.int64(0)
    count = np.int64(0)
    for k in range(first, stop):
        beam = _Beam(beams.window[k], beams.left[k, 0], beams.left[k, 1], np.int64(beams.crossed[k]))
        if task.order > 0 and not _is_needed(beam, task.order, task):
            continue
        walls = _clip_walls(plan, beam.window, beams.piece[k], layers)
        windows = _lay(beam, walls, task, layers, (windows[0], windows[1], np.int64(0)))
        if task.order > 0:
            pairs = _add_pairs(beam, k, walls, task, layers, pairs)
        for i in range(windows[2]):
            parent, piece, window = grow(parent, count + 1), grow(piece, count + 1), grow(window, count + 1)
            left, crossed, sequence = grow(left, count + 1), grow(crossed, count + 1), grow(sequence, count + 1)
            span, (wall, behind) = windows[0][i], windows[1][i]
            own = layers.clipped.wall[wall]
            if not _reflect(beam.window, _piece_of(layers, wall, span), plan.pieces_m[own], window[count]):
                continue
            reflected = span[2]
            if task.order == 0:
                gains, new, (x, y) = task.building.room.gains, window[count], (beam.window[0], beam.window[1])
                ends = (new[4] - x, new[5] - y), (new[2] - x, new[3] - y)
                reflected *= gain_between(gains, *ends) / gains.largest
            if not _is_needed(_Beam(window[count], reflected, span[3], behind), task.order + 1, task):
                continue
            parent[count], piece[count], crossed[count] = k, own, behind
            left[count, 0], left[count, 1] = reflected, span[3]
            sequence[count] = _mixed(beams.sequence[k], plan.line[own])
            count += 1
    children = parent[:count], piece[:count], window[:count], left[:count], crossed[:count], sequence[:count]
    return children, pairs[0][: pairs[2]], pairs[1][: pairs[2]]


@njit(cache=True)
def _scratch_of(plan):  # type: ignore[no-untyped-def]
    """Make scratch for the walls in one beam."""
    size = len(plan.pieces_m)
    wall, order, active = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int32)
    return _Scratch(np.empty((size, 4)), wall, order, active, np.empty(2 * size + 2), np.zeros(size + 1, np.int64))


@njit(cache=True)
def _layers_of(plan):  # type: ignore[no-untyped-def]
    """Make scratch for the walls in one beam and their layers."""
    size = len(plan.pieces_m)
    edges = 2 * size + 2
    return _Layers(
        _scratch_of(plan),
        np.empty(size),
        np.empty((size, 2)),
        np.empty((edges, 3)),
        np.empty(edges, np.int64),
        np.empty((edges, FACES), np.int64),
        np.empty((edges, FACES)),
        np.empty((edges, FACES), np.int64),
        np.empty(size, np.int64),
    )


@njit(cache=True)
def _clip_walls(plan, beam, own, layers):  # type: ignore[no-untyped-def]
    """Clip all walls in a beam, and sort their edges; return the number of walls."""
    scratch, grid = layers.clipped, plan.cells.grid
    corner = _cone(beam, own >= 0, grid, int(grid[4]))
    scratch.visit[-1] += 1
    count = _clip_cells(plan, beam, own, corner, np.int64(0), scratch)
    for c in range(count):
        slope = (scratch.found[c, 3] - scratch.found[c, 1]) / (scratch.found[c, 2] - scratch.found[c, 0])
        layers.slope[c] = slope
        ends = plan.pieces_m[scratch.wall[c]]
        wx, wy = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
        size = np.hypot(wx, wy)
        layers.along[c, 0], layers.along[c, 1] = wx / size, wy / size
        layers.open[plan.line[scratch.wall[c]]] = -1
    _sort_edges(scratch.found, scratch.edge, count)
    for i in range(2 * count + 2):
        t = scratch.edge[i]
        x = (1.0 - t) * (beam[2] - beam[0]) + t * (beam[4] - beam[0])
        y = (1.0 - t) * (beam[3] - beam[1]) + t * (beam[5] - beam[1])
        size = np.hypot(x, y)
        layers.ray[i, 0], layers.ray[i, 1], layers.ray[i, 2] = x / size, y / size, size
    return count


@njit(cache=True)
def _cone(beam, reflected, grid, rows):  # type: ignore[no-untyped-def]
    """Return the corners (4, 2) of a beam from its window, or its source if it is a root, to beyond a grid."""
    x0, y0, x1, y1 = grid[0], grid[1], grid[0] + grid[3] * grid[2], grid[1] + rows * grid[2]
    far = np.hypot(max(abs(beam[0] - x0), abs(beam[0] - x1)), max(abs(beam[1] - y0), abs(beam[1] - y1)))
    corner = np.empty((4, 2))
    near = 1.0 if reflected else 0.0
    for e in range(2):
        dx, dy = beam[2 + 2 * e] - beam[0], beam[3 + 2 * e] - beam[1]
        scale = max(1.0, 2.0 * far / max(np.hypot(dx, dy), 1e-9))
        corner[e, 0], corner[e, 1] = beam[0] + near * dx, beam[1] + near * dy
        corner[3 - e, 0], corner[3 - e, 1] = beam[0] + scale * dx, beam[1] + scale * dy
    return corner


@njit(cache=True)
def _lay(beam, count, task, layers, windows):  # type: ignore[no-untyped-def]
    """Put the walls of a beam into layers; return the windows that reflect it.

    Windows are (t from, t to, power after reflections, power after walls), (clipped wall, walls crossed), and their
    number.
    """
    scratch, begun, active = layers.clipped, np.int64(0), np.int64(0)
    for i in range(2 * count + 1):
        layers.depth[i] = 0
        t0, t1 = scratch.edge[i], scratch.edge[i + 1]
        if t1 - t0 < _THINNEST:
            continue
        middle = 0.5 * (t0 + t1)
        begun, active = _move_to(middle, scratch.found, scratch.order, scratch.active, count, begun, active)
        _sort_by_distance(layers, active, middle)
        windows = _lay_one(beam, i, active, task, layers, windows)
    return windows


@njit(cache=True)
def _nearness(layers, c, t):  # type: ignore[no-untyped-def]
    """Return 1 / r of a clipped wall at t."""
    found = layers.clipped.found
    return found[c, 1] + layers.slope[c] * (t - found[c, 0])


@njit(cache=True)
def _sort_by_distance(layers, count, t):  # type: ignore[no-untyped-def]
    """Sort the active walls by their distance at t; they are nearly sorted."""
    active = layers.clipped.active
    for j in range(1, count):
        c, k = active[j], j
        w = _nearness(layers, c, t)
        while k > 0 and _nearness(layers, active[k - 1], t) < w:
            active[k] = active[k - 1]
            k -= 1
        active[k] = c


@njit(cache=True)
def _lay_one(beam, i, active, task, layers, windows):  # type: ignore[no-untyped-def]
    """Put the walls between two edges into layers."""
    scratch, plan_line, low = layers.clipped, task.building.plan.line, task.building.plan.low
    pieces = task.building.plan.pieces_m
    of_piece, solid, depth_m = task.building.material, task.building.interior.solid, task.building.interior.depth_m
    most_reflected = task.building.materials.most_reflected
    most_transmitted = task.building.materials.most_transmitted
    limits, left, crossed = task.building.limits, beam.left, beam.crossed
    discount, next_discount = discount_after(limits, task.order), discount_after(limits, task.order + 1)
    t0, x_0, y_0, size_0 = scratch.edge[i], layers.ray[i, 0], layers.ray[i, 1], layers.ray[i, 2]
    t1, x_1, y_1, size_1 = scratch.edge[i + 1], layers.ray[i + 1, 0], layers.ray[i + 1, 1], layers.ray[i + 1, 2]
    start_0 = start_1 = steep_0 = steep_1 = first = 0.0
    for j in range(min(active, FACES)):
        c = scratch.active[j]
        piece = scratch.wall[c]
        material = of_piece[piece]
        ux, uy = layers.along[c, 0], layers.along[c, 1]
        r_0 = size_0 / max(_nearness(layers, c, t0), 1e-9)
        r_1 = size_1 / max(_nearness(layers, c, t1), 1e-9)
        cos_0, cos_1 = abs(ux * y_0 - uy * x_0), abs(ux * y_1 - uy * x_1)
        across = (ux * x_0 + uy * y_0) * (ux * x_1 + uy * y_1) <= 0.0
        near, most = (r_0 * cos_0, 1.0) if across else (min(r_0, r_1), max(cos_0, cos_1))
        near = max(near, 1e-6)
        layers.wall[i, j], layers.left[i, j], layers.crossed[i, j] = c, 0.0, crossed
        layers.depth[i] = j + 1
        total = beam.reflected * left * (task.most_transmitted if crossed == 0 else 1.0)
        if not matters(total * discount, near, task.needed):
            break
        if task.order < limits.reflections and not _is_solid(pieces, solid, beam.window, piece):
            flat = near / np.hypot(near, 2.0 * task.building.room.height_m)
            part = most_reflected[material, int(min(cos_0, cos_1) * flat * COSINES)]
            if matters(part * total * next_discount, near, task.needed):
                new = t0, t1, part * beam.reflected, left, crossed
                windows = _extend(layers, plan_line, of_piece, c, new, windows)
        through = 1.0 if low[piece] else most_transmitted[material, min(int(most * COSINES) + 1, COSINES)]
        same = j > 0 and first > 0.0
        if same:
            apart = min((r_0 - start_0) * min(cos_0, steep_0), (r_1 - start_1) * min(cos_1, steep_1))
            same = apart <= depth_m and depth_m > 0.0
        if same:
            steep_0, steep_1 = min(steep_0, cos_0), min(steep_1, cos_1)
            if through > first:
                left, first = left * through / first, through
        else:
            start_0, start_1, steep_0, steep_1, first = r_0, r_1, cos_0, cos_1, through
            left, crossed = left * through, crossed + 1
        if crossed > limits.walls:
            break
        layers.left[i, j], layers.crossed[i, j] = left, crossed
    return windows


@njit(cache=True)
def _is_solid(pieces, solid, beam, piece):  # type: ignore[no-untyped-def]
    """Return whether a beam meets a wall from inside it."""
    px, py = pieces[piece, 0, 0], pieces[piece, 0, 1]
    dx, dy = pieces[piece, 1, 0] - px, pieces[piece, 1, 1] - py
    left = dx * (beam[1] - py) - dy * (beam[0] - px) > 0.0
    return solid[piece, 0 if left else 1]


@njit(cache=True)
def _extend(layers, lines, material, c, new, windows):  # type: ignore[no-untyped-def]
    """Add a window that reflects a beam, or enlarge the one beside it."""
    t0, t1, reflected, left, crossed = new
    span, wall, count = windows
    piece = layers.clipped.wall[c]
    line = lines[piece]
    last = layers.open[line]
    beside = last >= 0 and span[last, 1] >= t0 - _THINNEST and wall[last, 1] == crossed
    if beside and material[layers.clipped.wall[wall[last, 0]]] == material[piece]:
        span[last, 1] = t1
        span[last, 2], span[last, 3] = max(span[last, 2], reflected), max(span[last, 3], left)
        return span, wall, count
    span, wall = grow(span, count + 1), grow(wall, count + 1)
    span[count, 0], span[count, 1], span[count, 2], span[count, 3] = t0, t1, reflected, left
    wall[count, 0], wall[count, 1] = c, crossed
    layers.open[line] = count
    return span, wall, count + 1


@njit(cache=True)
def _piece_of(layers, c, span):  # type: ignore[no-untyped-def]
    """Return a part of a view as `_reflect` takes it: (t0, w0, t1, w1)."""
    w0, w1 = _nearness(layers, c, span[0]), _nearness(layers, c, span[1])
    return span[0], max(w0, 1e-9), span[1], max(w1, 1e-9)


@njit(cache=True)
def _is_needed(beam, order, task):  # type: ignore[no-untyped-def]
    """Return whether a beam of so many reflections may matter, as it is or after more of them."""
    limits = task.building.limits
    total = beam.reflected * beam.left * (task.most_transmitted if beam.crossed == 0 else 1.0)
    near = max(_window_distance(beam.window), 1e-6)
    if not matters(total * discount_after(limits, order), near, task.needed):
        return False
    if order < limits.reflections and matters(total * discount_after(limits, order + 1), near, task.needed):
        return True
    return _reaches(beam.window, near, total * discount_after(limits, order), task.needed)


@njit(cache=True)
def _window_distance(beam):  # type: ignore[no-untyped-def]
    """Return the distance of a window from the source of its beam."""
    ax, ay, bx, by = beam[2] - beam[0], beam[3] - beam[1], beam[4] - beam[0], beam[5] - beam[1]
    wx, wy = bx - ax, by - ay
    size = np.hypot(wx, wy)
    if (wx * ax + wy * ay) * (wx * bx + wy * by) <= 0.0 and size > 0.0:
        return abs(ax * by - ay * bx) / size
    return min(np.hypot(ax, ay), np.hypot(bx, by))


@njit(cache=True)
def _reaches(beam, near, left, needed):  # type: ignore[no-untyped-def]
    """Return whether a beam would matter to any receiver behind its window if no wall were there."""
    x0, y0, edge, (rows, columns) = needed.grid[0], needed.grid[1], needed.grid[2], needed.cells.shape
    corner = _cone(beam, True, needed.grid, rows)
    low, high = np.min(corner[:, 1]) - TOLERANCE_M, np.max(corner[:, 1]) + TOLERANCE_M
    for row in range(max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)):
        start, end = span_in_strip(corner, y0 + row * edge - TOLERANCE_M, y0 + (row + 1) * edge + TOLERANCE_M)
        if start > end:
            continue
        first = max(0, int(np.floor((start - TOLERANCE_M - x0) / edge)))
        last = min(columns - 1, int(np.floor((end + TOLERANCE_M - x0) / edge)))
        for column in range(first, last + 1):
            x, y = x0 + (column + 0.5) * edge - beam[0], y0 + (row + 0.5) * edge - beam[1]
            length = max(near, np.hypot(x, y) - 0.7072 * edge)
            if left >= needed.cells[row, column] * length * length:
                return True
    return False


@njit(cache=True)
def _add_pairs(beam, number, count, task, layers, pairs):  # type: ignore[no-untyped-def]
    """Pair a reflected beam with the receivers that need it, behind a wall or after one."""
    window, receivers, (pair, through, used) = beam.window, task.receivers, pairs
    ax, ay, bx, by = window[2] - window[0], window[3] - window[1], window[4] - window[0], window[5] - window[1]
    area, first, second, width = ax * by - ay * bx, np.hypot(ax, ay), np.hypot(bx, by), np.hypot(ax - bx, ay - by)
    corner = _cone(window, True, receivers.grid, (len(receivers.start) - 1) // int(receivers.grid[3]))
    from_row, to_row = _rows(corner, receivers)
    for row in range(from_row, to_row):
        begin, end = _entries(corner, receivers, row)
        for i in range(begin, end):
            ex, ey = receivers.points_m[i, 0] - window[0], receivers.points_m[i, 1] - window[1]
            alpha, beta = (ex * by - ey * bx) / area, (ax * ey - ay * ex) / area
            r = alpha + beta
            if beta * area < -TOLERANCE_M * first or alpha * area < -TOLERANCE_M * second:
                continue
            if r <= 0.0 or (r - 1.0) * area < -TOLERANCE_M * width:  # r may be 0 where the image is close to its wall
                continue
            rx = receivers.order[i]
            least = task.needed.power[rx] * (ex * ex + ey * ey) / beam.reflected
            if beam.left < least:
                continue
            t, aside = beta / r, TOLERANCE_M / (r * width)
            left = max(_left_at(beam, count, layers, t - aside, r), _left_at(beam, count, layers, t + aside, r))
            if left > 0.0 and left >= least:
                pair, through = grow(pair, used + 1), grow(through, used + 1)
                pair[used, 0], pair[used, 1], through[used] = number, rx, left
                used += 1
    return pair, through, used


@njit(cache=True)
def _left_at(beam, count, layers, t, r):  # type: ignore[no-untyped-def]
    """Return a bound of the power that walls leave of a beam at a point; 0 if no wall is in front of it."""
    edge = layers.clipped.edge
    low, high = 0, 2 * count + 1
    t = min(max(t, _THINNEST), 1.0 - _THINNEST)
    while high - low > 1:
        middle = (low + high) // 2
        if edge[middle] <= t:
            low = middle
        else:
            high = middle
    left, crossed = beam.left, beam.crossed
    for j in range(layers.depth[low]):
        if _nearness(layers, layers.wall[low, j], t) * r <= 1.0:
            break
        left, crossed = layers.left[low, j], layers.crossed[low, j]
    return left if crossed > 0 else 0.0


@njit(cache=True)
def _mixed(sequence, line):  # type: ignore[no-untyped-def]
    """Return the hash of a sequence of lines and one more line (splitmix64)."""
    z = np.uint64(sequence) + np.uint64(line + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.int64(z ^ (z >> np.uint64(31)))
