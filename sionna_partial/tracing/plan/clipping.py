r"""Beams, and the walls clipped to them, in the coordinates of `beams.py`.

A ____________ B        Window AB of a beam: the part of the last wall that reflects it (r = 1).
 \     :      /         A point in the beam has t, the fraction of the width, and 1 / r.
  \    :     /          Edges are the values of t at which clipped walls begin and end.
   \   :    /
    \  :   /
       S                Image of the transmitter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, span_in_strip
from sionna_partial.process import njit
from sionna_partial.scene.outlines import Plan, grow

TOLERANCE_M = 1e-4
"""Width by which beams are widened [m]: points share one lattice, and the solver has single precision."""

_STRIP_CELLS = 6.0
"""Depth of the strips in which a narrow beam is searched for walls [cells of the index]."""

THINNEST = 1e-12
"""Smallest part of a beam's width between two edges."""


class Clipped(NamedTuple):
    """Scratch of one beam; `visit` ends with the number of the present beam.

    `found` (C, 4) are the parts (t0, 1 / r0, t1, 1 / r1) of the clipped walls, `slope` (C,) the slopes of 1 / r over t,
    `wall` (C,) the pieces; `order` sorts them by t0. `active` are the walls at a t, `edge` the sorted ends, `corner`
    (4, 2) a quadrilateral in which walls or receivers are searched.
    """

    found: Floats
    slope: Floats
    wall: NDArray[np.int32]
    order: NDArray[np.int32]
    active: NDArray[np.int32]
    edge: Floats
    visit: NDArray[np.int64]
    corner: Floats

    @classmethod
    def of(cls, plan: Plan) -> "Clipped":
        size = len(plan.pieces_m)
        wall, order, active = np.empty((3, size), np.int32)
        visit, corner = np.zeros(size + 1, np.int64), np.empty((4, 2))
        return cls(np.empty((size, 4)), np.empty(size), wall, order, active, np.empty(2 * size + 2), visit, corner)


class Children(NamedTuple):
    """Beams after one more reflection, with fields as in `beams.Beams`."""

    parent: NDArray[np.int32]
    piece: NDArray[np.int32]
    window: Floats
    reflected: Floats
    left: Floats
    crossed: NDArray[np.int32]
    more: NDArray[np.int32]

    @classmethod
    def empty(cls, size: int = 64) -> "Children":
        parent, piece, crossed, more = np.empty((4, size), np.int32)
        reflected, left = np.empty((2, size))
        return cls(parent, piece, np.empty((size, 6)), reflected, left, crossed, more)


@njit(cache=True)
def with_room(children, size):
    """Return the beams, enlarged if there is no room for so many."""
    parent, piece, window, reflected, left, crossed, more = children
    parent, piece, crossed, more = grow(parent, size), grow(piece, size), grow(crossed, size), grow(more, size)
    return Children(parent, piece, grow(window, size), grow(reflected, size), grow(left, size), crossed, more)


@njit(cache=True, borrows=True)
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


@njit(cache=True, borrows=True)
def clip_nearest(plan, beam, own, scratch):
    """Clip the walls in a beam, from its window outwards, until they fill the view; return their number.

    Cells of the index are visited in strips across the beam. Walls that fill the view within the strips hide all
    others.
    """
    x0, y0, edge, columns, rows = plan.cells.grid
    x1, y1, corner = x0 + columns * edge, y0 + rows * edge, scratch.corner
    sx, sy = beam[0], beam[1]
    ax, ay, bx, by = beam[2] - sx, beam[3] - sy, beam[4] - sx, beam[5] - sy
    length, width = 0.5 * (np.hypot(ax, ay) + np.hypot(bx, by)), np.hypot(ax - bx, ay - by)
    near, count = 1.0 if own >= 0 else 0.0, 0
    scratch.visit[-1] += 1
    while True:
        far = near + max(_STRIP_CELLS * edge, near * width) / length
        for k, (r, dx, dy) in enumerate(((near, ax, ay), (near, bx, by), (far, bx, by), (far, ax, ay))):
            corner[k, 0], corner[k, 1] = sx + r * dx, sy + r * dy
        if _leaves(corner, x0 - edge, x1 + edge, 0, ax, bx) or _leaves(corner, y0 - edge, y1 + edge, 1, ay, by):
            break
        count = _clip_cells(plan, beam, own, count, scratch)
        if _is_filled(plan.low, scratch, count, far):
            break
        near = far
    _prepare(scratch, count)
    return count


@njit(cache=True, borrows=True)
def clip_all(plan, beam, own, scratch):
    """Clip all walls in a beam beyond its window; return their number."""
    scratch.visit[-1] += 1
    write_cone(beam, own >= 0, plan.cells.grid, int(plan.cells.grid[4]), scratch.corner)
    count = _clip_cells(plan, beam, own, 0, scratch)
    _prepare(scratch, count)
    return count


@njit(cache=True, borrows=True)
def _leaves(corner, low, high, axis, first, second):
    """Return whether the near side of a strip is beyond [low, high] along one axis, running outwards."""
    return (min(corner[0, axis], corner[1, axis]) > high and min(first, second) >= 0.0) or (
        max(corner[0, axis], corner[1, axis]) < low and max(first, second) <= 0.0
    )


@njit(cache=True, borrows=True)
def _clip_cells(plan, beam, own, count, scratch):
    """Clip the walls in the cells within `scratch.corner` in addition to `count` others; return their number."""
    corner = scratch.corner
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
            if t1 - t0 > THINNEST:
                found[count, 0], found[count, 1], found[count, 2], found[count, 3] = t0, w0, t1, w1
                wall_of[count] = wall
                k = count
                while k > 0 and found[order[k - 1], 0] > t0:
                    order[k] = order[k - 1]
                    k -= 1
                order[k] = count
                count += 1
    return count


@njit(cache=True, borrows=True)
def rows_in(corner, start, grid):
    y0, edge, rows = grid[1], grid[2], (len(start) - 1) // int(grid[3])
    low = min(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) - TOLERANCE_M
    high = max(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) + TOLERANCE_M
    return max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)


@njit(cache=True, borrows=True)
def entries_in(corner, start, grid, row):
    x0, y0, edge, columns = grid[0], grid[1], grid[2], int(grid[3])
    left, right = span_in_strip(corner, y0 + row * edge - TOLERANCE_M, y0 + (row + 1) * edge + TOLERANCE_M)
    if left > right:
        return 0, 0
    first = max(0, int(np.floor((left - TOLERANCE_M - x0) / edge)))
    last = min(columns - 1, int(np.floor((right + TOLERANCE_M - x0) / edge)))
    return (start[row * columns + first], start[row * columns + last + 1]) if first <= last else (0, 0)


@njit(cache=True, borrows=True)
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


@njit(cache=True, borrows=True)
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


@njit(cache=True, borrows=True)
def _prepare(scratch, count):
    """Write the slopes of clipped walls, and the sorted edges."""
    found, edge = scratch.found, scratch.edge
    edge[0], edge[1] = 0.0, 1.0
    for i in range(count):
        scratch.slope[i] = (found[i, 3] - found[i, 1]) / (found[i, 2] - found[i, 0])
        edge[2 * i + 2], edge[2 * i + 3] = min(max(found[i, 0], 0.0), 1.0), min(max(found[i, 2], 0.0), 1.0)
    _sort(edge, 2 * count + 2)


@njit(cache=True, borrows=True)
def nearness(scratch, c, t):
    """Return 1 / r of a clipped wall at t."""
    return scratch.found[c, 1] + scratch.slope[c] * (t - scratch.found[c, 0])


@njit(cache=True, borrows=True)
def move_to(t, scratch, count, begun, number):
    """Update `scratch.active` for the next t, up to which `begun` walls began; return that number and the active."""
    found, order, active = scratch.found, scratch.order, scratch.active
    while begun < count and found[order[begun], 0] <= t:
        active[number] = order[begun]
        begun, number = begun + 1, number + 1
    kept = 0
    for k in range(number):
        if found[active[k], 2] >= t:
            active[kept] = active[k]
            kept += 1
    return begun, kept


@njit(cache=True, borrows=True)
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


@njit(cache=True, borrows=True)
def write_cone(beam, reflected, grid, rows, corner):
    """Write the corners (4, 2) of the area that a beam covers, from its window to beyond a grid.

    The beams of a source itself, which no wall reflected, begin at the source.
    """
    x0, y0, x1, y1 = grid[0], grid[1], grid[0] + grid[3] * grid[2], grid[1] + rows * grid[2]
    far = np.hypot(max(abs(beam[0] - x0), abs(beam[0] - x1)), max(abs(beam[1] - y0), abs(beam[1] - y1)))
    near = 1.0 if reflected else 0.0
    for e in range(2):
        dx, dy = beam[2 + 2 * e] - beam[0], beam[3 + 2 * e] - beam[1]
        scale = max(1.0, 2.0 * far / max(np.hypot(dx, dy), 1e-9))
        corner[e, 0], corner[e, 1] = beam[0] + near * dx, beam[1] + near * dy
        corner[3 - e, 0], corner[3 - e, 1] = beam[0] + scale * dx, beam[1] + scale * dy


@njit(cache=True, borrows=True)
def window_distance(beam):
    """Return the smallest distance of a beam's window from its image."""
    ax, ay, bx, by = beam[2] - beam[0], beam[3] - beam[1], beam[4] - beam[0], beam[5] - beam[1]
    wx, wy = bx - ax, by - ay
    size = np.hypot(wx, wy)
    if (wx * ax + wy * ay) * (wx * bx + wy * by) <= 0.0 and size > 0.0:
        return abs(ax * by - ay * bx) / size
    return min(np.hypot(ax, ay), np.hypot(bx, by))


@njit(cache=True, borrows=True)
def azimuths_of(beams, k, window):
    """Return the azimuths at the source [degrees] between which a window is seen by beam k, counterclockwise."""
    x, y, sign = beams.window[k, 0], beams.window[k, 1], 1.0 if beams.reflections % 2 == 0 else -1.0
    first = np.degrees(sign * np.arctan2(window[5] - y, window[4] - x) + beams.turn_rad[k])
    second = np.degrees(sign * np.arctan2(window[3] - y, window[2] - x) + beams.turn_rad[k])
    return (first, second) if sign > 0.0 else (second, first)


@njit(cache=True, borrows=True)
def reaches(beam, near, left, before_m, needed, corner):
    """Return whether a beam would matter to any receiver behind its window without walls; `corner` is scratch."""
    x0, y0, edge, (rows, columns) = needed.grid[0], needed.grid[1], needed.grid[2], needed.cells.shape
    write_cone(beam, True, needed.grid, rows, corner)
    low = min(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) - TOLERANCE_M
    high = max(corner[0, 1], corner[1, 1], corner[2, 1], corner[3, 1]) + TOLERANCE_M
    for row in range(max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)):
        start, end = span_in_strip(corner, y0 + row * edge - TOLERANCE_M, y0 + (row + 1) * edge + TOLERANCE_M)
        if start > end:
            continue
        first = max(0, int(np.floor((start - TOLERANCE_M - x0) / edge)))
        last = min(columns - 1, int(np.floor((end + TOLERANCE_M - x0) / edge)))
        for column in range(first, last + 1):
            x, y = x0 + (column + 0.5) * edge - beam[0], y0 + (row + 0.5) * edge - beam[1]
            length = max(near, np.hypot(x, y) - 0.7072 * edge)
            if left >= needed.cells[row, column] * length * (length + before_m):
                return True
    return False
