"""Walls clipped to a beam, in the coordinates of `beams.py`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, span_in_strip
from sionna_partial.process import njit
from sionna_partial.scene.outlines import grow

TOLERANCE_M = 1e-4
"""Width by which beams are widened [m]: points share one lattice, and the solver has single precision."""

_STRIP_CELLS = 6.0
"""Depth of the strips in which a narrow beam is searched for walls [cells of the index]."""

_FAR_M = 1e6
"""Length at which beams that hit nothing are cut off [m], fixed: no receiver depends on others."""

EXPECTED = 0.5
"""Expected power of unlisted paths, relative to their rough bounds."""

THINNEST = 1e-12
"""Smallest part of a beam's width between two edges."""


class Clipped(NamedTuple):
    """Scratch of one beam; `visit` ends with the number of the present beam.

    `found` (C, 4) are the parts (t0, 1 / r0, t1, 1 / r1) of the clipped walls, `wall` (C,) the pieces; `order` sorts
    them by t0. `active` are the walls at a t, `edge` the sorted ends.
    """

    found: Floats
    wall: NDArray[np.int32]
    order: NDArray[np.int32]
    active: NDArray[np.int32]
    edge: Floats
    visit: NDArray[np.int64]


@njit(cache=True)
def scratch_of(plan):
    size = len(plan.pieces_m)
    wall, order, active = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int32)
    return Clipped(np.empty((size, 4)), wall, order, active, np.empty(2 * size + 2), np.zeros(size + 1, np.int64))


@njit(cache=True)
def _clip(beam, pieces_m, wall, reflected):
    """Return the part of a wall in a beam, beyond its window: (t0, w0, t1, w1) with w = 1 / r; t0 >= t1 if none."""
    ax, ay = beam[2] - beam[0], beam[3] - beam[1]
    bx, by = beam[4] - beam[0], beam[5] - beam[1]
    area = ax * by - ay * bx
    px, py = pieces_m[wall, 0, 0] - beam[0], pieces_m[wall, 0, 1] - beam[1]
    qx, qy = pieces_m[wall, 1, 0] - beam[0], pieces_m[wall, 1, 1] - beam[1]
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
def clip_nearest(plan, beam, own, scratch):
    """Clip the walls in a beam, from its window outwards, until they fill the view; return their number.

    Cells of the index are visited in strips across the beam. Walls that fill the view within the strips hide all
    others.
    """
    x0, y0, edge, columns, rows = plan.cells.grid
    x1, y1 = x0 + columns * edge, y0 + rows * edge
    sx, sy = beam[0], beam[1]
    ax, ay, bx, by = beam[2] - sx, beam[3] - sy, beam[4] - sx, beam[5] - sy
    length, width = 0.5 * (np.hypot(ax, ay) + np.hypot(bx, by)), np.hypot(ax - bx, ay - by)
    corner = np.empty((4, 2))
    near, count = 1.0 if own >= 0 else 0.0, np.int64(0)
    while True:
        far = near + max(_STRIP_CELLS * edge, near * width) / length
        for k, (r, dx, dy) in enumerate(((near, ax, ay), (near, bx, by), (far, bx, by), (far, ax, ay))):
            corner[k, 0], corner[k, 1] = sx + r * dx, sy + r * dy
        if _leaves(corner, x0 - edge, x1 + edge, 0, ax, bx) or _leaves(corner, y0 - edge, y1 + edge, 1, ay, by):
            return count
        count = clip_cells(plan, beam, own, corner, count, scratch)
        if _is_filled(plan.low, scratch, count, far):
            return count
        near = far


@njit(cache=True)
def _leaves(corner, low, high, axis, first, second):
    """Return whether the near side of a strip is beyond [low, high] along one axis, running outwards."""
    return (min(corner[0, axis], corner[1, axis]) > high and min(first, second) >= 0.0) or (
        max(corner[0, axis], corner[1, axis]) < low and max(first, second) <= 0.0
    )


@njit(cache=True)
def clip_cells(plan, beam, own, corner, count, scratch):
    pieces_m, lines, start, grid, piece = plan.pieces_m, plan.line, plan.cells.start, plan.cells.grid, plan.cells.piece
    found, wall_of, order, visited, visit = scratch.found, scratch.wall, scratch.order, scratch.visit, scratch.visit[-1]
    first, last = rows_in(corner, start, grid)
    for row in range(first, last):
        begin, end = entries_in(corner, start, grid, row)
        for entry in range(begin, end):
            wall = piece[entry]
            if visited[wall] == visit:
                continue
            visited[wall] = visit
            if own >= 0 and lines[wall] == lines[own]:
                continue
            t0, w0, t1, w1 = _clip(beam, pieces_m, wall, own >= 0)
            if t1 - t0 > 1e-12:
                found[count, 0], found[count, 1], found[count, 2], found[count, 3] = t0, w0, t1, w1
                wall_of[count] = wall
                k = count
                while k > 0 and found[order[k - 1], 0] > t0:
                    order[k] = order[k - 1]
                    k -= 1
                order[k] = count
                count += 1
    return count


@njit(cache=True)
def rows_in(corner, start, grid):
    y0, edge, rows = grid[1], grid[2], (len(start) - 1) // int(grid[3])
    low = min(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) - TOLERANCE_M
    high = max(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) + TOLERANCE_M
    return max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)


@njit(cache=True)
def entries_in(corner, start, grid, row):
    x0, y0, edge, columns = grid[0], grid[1], grid[2], int(grid[3])
    left, right = span_in_strip(corner, y0 + row * edge - TOLERANCE_M, y0 + (row + 1) * edge + TOLERANCE_M)
    if left > right:
        return 0, 0
    first = max(0, int(np.floor((left - TOLERANCE_M - x0) / edge)))
    last = min(columns - 1, int(np.floor((right + TOLERANCE_M - x0) / edge)))
    return (start[row * columns + first], start[row * columns + last + 1]) if first <= last else (0, 0)


@njit(cache=True)
def _is_filled(low, scratch, count, far):
    reach = 1e-12
    for k in range(count):
        i = scratch.order[k]
        if low[scratch.wall[i]]:
            continue
        if scratch.found[i, 0] > reach:
            return False
        if min(scratch.found[i, 1], scratch.found[i, 3]) * far >= 1.0:
            reach = max(reach, scratch.found[i, 2] + 1e-12)
            if reach >= 1.0:
                return True
    return False


@njit(cache=True)
def _sort(values, count):
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
def sort_edges(found, edge, count):
    edge[0], edge[1] = 0.0, 1.0
    for i in range(count):
        edge[2 * i + 2], edge[2 * i + 3] = min(max(found[i, 0], 0.0), 1.0), min(max(found[i, 2], 0.0), 1.0)
    _sort(edge, 2 * count + 2)


@njit(cache=True)
def move_to(t, found, order, active, count, begun, number):
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
def reflect(beam, piece, wall, child):
    """Write the beam reflected in a piece (t0, 1 / r0, t1, 1 / r1) of its view; return False if it is too thin."""
    sx, sy = beam[0], beam[1]
    for k in range(2):  # the ends change places
        t, w = piece[2 - 2 * k], piece[3 - 2 * k]
        child[2 + 2 * k] = sx + ((1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)) / w
        child[3 + 2 * k] = sy + ((1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)) / w
    dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
    away = (dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])) / (dx * dx + dy * dy)
    child[0], child[1] = sx + 2.0 * away * dy, sy - 2.0 * away * dx
    if np.hypot(child[2] - child[4], child[3] - child[5]) < 1e-9 or abs(away) * np.hypot(dx, dy) < 1e-9:
        return False
    ax, ay, bx, by = child[2] - child[0], child[3] - child[1], child[4] - child[0], child[5] - child[1]
    return ax * by - ay * bx > 1e-15  # the source is in front of the window, and not on it


@njit(cache=True)
def cone_of(beam, reflected, grid, rows):
    """Return the corners (4, 2) of a beam from its window, or the source of a root, to beyond a grid."""
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
def _write_corners(beam, reflected, span, window, corner):
    """Write the corners (4, 2) of a beam between its window and one window of its view, cut off far away."""
    sx, sy = beam[0], beam[1]
    for k in range(2):
        t, w = span[window, 2 * k], span[window, 2 * k + 1]
        dx = (1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)
        dy = (1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)
        far = _FAR_M / np.sqrt(dx * dx + dy * dy)
        r_far = 1.0 / w if w * far > 1.0 else far
        r_near = 1.0 if reflected else 0.0
        corner[k, 0], corner[k, 1] = sx + r_near * dx, sy + r_near * dy
        corner[3 - k, 0], corner[3 - k, 1] = sx + r_far * dx, sy + r_far * dy


@njit(cache=True)
def _write_inward(corner, inward):
    """Write unit inward normals and offsets of a clockwise quadrilateral; an edge of no length bounds nothing."""
    for k in range(4):
        inward[k, 0], inward[k, 1], inward[k, 2] = 0.0, 0.0, -1.0
        dx, dy = corner[(k + 1) % 4, 0] - corner[k, 0], corner[(k + 1) % 4, 1] - corner[k, 1]
        length = np.sqrt(dx * dx + dy * dy)
        if length > 0.0:
            inward[k, 0], inward[k, 1] = dy / length, -dx / length
            inward[k, 2] = inward[k, 0] * corner[k, 0] + inward[k, 1] * corner[k, 1]


@njit(cache=True)
def add_points(beam, number, view, receivers, strength, pairs):
    """Pair a beam with the receivers that see it at high walls, and need it.

    `view` are the windows, their walls and their number, and `strength` is from `beams._strength_of`.
    """
    (span, wall, windows, walls, low), (points, order, start, grid) = view, receivers
    (by_azimuth, needed, unlisted), (reflected, before_m, sign, turn_rad), is_reflected = strength
    (pair, through, used), azimuths, corner, inward = pairs, len(by_azimuth), np.empty((4, 2)), np.empty((4, 3))
    for window in range(windows):
        if wall[window, 0] >= 0 and low[walls[wall[window, 0]]]:
            continue
        _write_corners(beam, is_reflected, span, window, corner)
        _write_inward(corner, inward)
        first, last = rows_in(corner, start, grid)
        for row in range(first, last):
            begin, end = entries_in(corner, start, grid, row)
            for i in range(begin, end):
                x, y, k = points[i, 0], points[i, 1], 0
                while k < 4 and inward[k, 0] * x + inward[k, 1] * y - inward[k, 2] >= -TOLERANCE_M:
                    k += 1
                if k < 4:
                    continue
                rx, dx, dy = order[i], x - beam[0], y - beam[1]
                length, azimuth_rad = np.sqrt(dx * dx + dy * dy), sign * np.arctan2(dy, dx) + turn_rad
                power = reflected * by_azimuth[int(np.degrees(azimuth_rad) + 360.5) % azimuths]
                power /= length * (length + before_m)
                if power < needed[rx]:
                    unlisted[rx] += EXPECTED * power
                    continue
                if used == len(pair):
                    pair, through = grow(pair, used + 1), grow(through, used + 1)
                pair[used, 0], pair[used, 1], through[used] = number, rx, power
                used += 1
    return pair, through, used
