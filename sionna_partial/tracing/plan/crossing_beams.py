"""Beams of floor plans that walls reflect and let through, and the receivers that each of them can serve.

A beam is a sequence of reflections: its window is the part of the last wall that reflects it. All walls behind the
window are sorted from edge to edge of the beam, and by distance between two edges, so that the walls in front of any
point are known, and with them a bound of the power there. Coordinates inside a beam are as in `plan.beams`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, span_in_strip
from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import Plan, PointBins, grow
from sionna_partial.tracing.plan.beams import (
    TOLERANCE_M,
    _clip_cells,
    _entries,
    _reflect,
    _root_beams,
    _rows,
    _Scratch,
    _sort,
    _without_ended,
)
from sionna_partial.tracing.plan.legs import FACES
from sionna_partial.tracing.plan.specular import Room
from sionna_partial.tracing.power import COSINES, Materials, gain_between
from sionna_partial.tracing.select import Limits, discount_after, matters, needs_by_distance
from sionna_partial.tracing.walls import Interior

_CELL_M = 1.0
"""Edge of the cells of receivers that beams are compared with [m]."""

_THINNEST = 1e-12
"""Part of a beam's width below which nothing lies between two edges."""


class Building(NamedTuple):
    """A floor plan that paths go through; `material` (P,) are the materials of the pieces of its walls."""

    plan: Plan
    interior: Interior
    room: Room
    materials: Materials
    material: NDArray[np.int64]
    limits: Limits


class Needed(NamedTuple):
    """The power that a beam must have to matter, relative to (wavelength / 4 pi)^2.

    `power` (N,) is the smallest that matters to each receiver; `distance_m`, `relative` and `near` are as in
    `NeedsByDistance`, in the plan. `cells` (ny, nx) is the smallest in square cells, whose corner x0 and y0 and edge
    [m] are `grid` (3,).
    """

    power: Floats
    distance_m: Floats
    relative: Floats
    near: Floats
    cells: Floats
    grid: Floats


class CrossingBeams(NamedTuple):
    """M beams of one number of reflections.

    `parent` (M,) is the beam that each comes from, counted through all of them, and `piece` (M,) the piece of a wall
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
    """Inputs for beams of `order` reflections."""

    order: int
    receivers: PointBins
    building: Building
    needed: Needed


class _Beam(NamedTuple):
    """One of `CrossingBeams`: its window, what reflections and walls leave of it, and how many walls it has crossed."""

    window: Floats
    reflected: float
    left: float
    crossed: np.int64


class _Layers(NamedTuple):
    """Scratch of one beam: the walls in it, and the walls between two edges, from the window outwards.

    For clipped wall c, `slope` (C,) is the one of 1 / r, `along` (C, 2) its direction. For edge i, `ray` (E, 3) is the
    direction and length of the beam there. Between edges i and i + 1 lie `depth` (E,) walls: `wall` (E, D), behind
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
    return Needed(power, *far, cells, np.array([*low, _CELL_M]))


@njit(cache=True, nogil=True)
def follow_beams(beams, first, stop, task):  # type: ignore[no-untyped-def]
    """Follow some beams: those that walls in them reflect, pairs (beam, receiver), and what walls leave of these."""
    layers, plan = _scratch(task.building.plan), task.building.plan
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
def _scratch(plan):  # type: ignore[no-untyped-def]
    """Make scratch for beams in a plan."""
    size = len(plan.pieces_m)
    clipped = _Scratch(
        np.empty((size, 4)),
        np.empty(size, np.int32),
        np.empty(size, np.int32),
        np.empty(size, np.int32),
        np.empty(2 * size + 2),
        np.empty((1, 4)),
        np.empty(1, np.int32),
        np.zeros(size + 1, np.int64),
    )
    edges = 2 * size + 2
    return _Layers(
        clipped,
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
    """Clip all walls in a beam, and sort their edges; the number of walls."""
    x0, y0, edge, columns, rows = plan.cells.grid
    x1, y1 = x0 + columns * edge, y0 + rows * edge
    scratch, corner = layers.clipped, _cone(beam, own >= 0, x0, y0, x1, y1)
    scratch.visit[-1] += 1
    count = _clip_cells(plan, beam, own, corner, 0, scratch)
    scratch.edge[0], scratch.edge[1] = 0.0, 1.0
    for c in range(count):
        t0, w0, t1, w1 = scratch.found[c]
        scratch.edge[2 * c + 2], scratch.edge[2 * c + 3] = min(max(t0, 0.0), 1.0), min(max(t1, 0.0), 1.0)
        layers.slope[c] = (w1 - w0) / (t1 - t0)
        ends = plan.pieces_m[scratch.wall[c]]
        wx, wy = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
        size = np.hypot(wx, wy)
        layers.along[c, 0], layers.along[c, 1] = wx / size, wy / size
        layers.open[plan.line[scratch.wall[c]]] = -1
    _sort(scratch.edge, 2 * count + 2)
    for i in range(2 * count + 2):
        t = scratch.edge[i]
        x = (1.0 - t) * (beam[2] - beam[0]) + t * (beam[4] - beam[0])
        y = (1.0 - t) * (beam[3] - beam[1]) + t * (beam[5] - beam[1])
        size = np.hypot(x, y)
        layers.ray[i, 0], layers.ray[i, 1], layers.ray[i, 2] = x / size, y / size, size
    return count


@njit(cache=True)
def _cone(beam, reflected, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    """Corners (4, 2) of a beam from its window, or its source if it is a root, to beyond a rectangle."""
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
    """Put the walls of a beam into layers, and list the windows that reflect it.

    Windows are (t from, t to, what reflections leave, what walls leave), (clipped wall, walls crossed), and their
    number.
    """
    scratch, begun, active = layers.clipped, 0, 0
    for i in range(2 * count + 1):
        layers.depth[i] = 0
        t0, t1 = scratch.edge[i], scratch.edge[i + 1]
        if t1 - t0 < _THINNEST:
            continue
        middle = 0.5 * (t0 + t1)
        while begun < count and scratch.found[scratch.order[begun], 0] <= middle:
            scratch.active[active] = scratch.order[begun]
            begun, active = begun + 1, active + 1
        active = _without_ended(scratch.found, scratch.active, active, middle)
        _sort_by_distance(layers, active, middle)
        windows = _lay_one(beam, i, active, task, layers, windows)
    return windows


@njit(cache=True)
def _nearness(layers, c, t):  # type: ignore[no-untyped-def]
    """1 / r of a clipped wall at t."""
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
    scratch, building, materials = layers.clipped, task.building, task.building.materials
    limits, depth_m, left, crossed = building.limits, building.interior.depth_m, beam.left, beam.crossed
    discount, next_discount = discount_after(limits, task.order), discount_after(limits, task.order + 1)
    t0, t1, ray, next_ray = scratch.edge[i], scratch.edge[i + 1], layers.ray[i], layers.ray[i + 1]
    start_0 = start_1 = steep_0 = steep_1 = first = 0.0
    for j in range(min(active, FACES)):
        c = scratch.active[j]
        piece = scratch.wall[c]
        material = building.material[piece]
        ux, uy = layers.along[c]
        r_0 = ray[2] / max(_nearness(layers, c, t0), 1e-9)
        r_1 = next_ray[2] / max(_nearness(layers, c, t1), 1e-9)
        cos_0, cos_1 = abs(ux * ray[1] - uy * ray[0]), abs(ux * next_ray[1] - uy * next_ray[0])
        across = (ux * ray[0] + uy * ray[1]) * (ux * next_ray[0] + uy * next_ray[1]) <= 0.0
        near, most = (r_0 * cos_0, 1.0) if across else (min(r_0, r_1), max(cos_0, cos_1))
        near = max(near, 1e-6)
        layers.wall[i, j], layers.left[i, j], layers.crossed[i, j] = c, 0.0, crossed
        layers.depth[i] = j + 1
        total = beam.reflected * left * (most_through(materials) if crossed == 0 else 1.0)
        if not matters(total * discount, near, task.needed):
            break
        if task.order < limits.reflections and not _is_solid(building, beam.window, piece):
            flat = near / np.hypot(near, 2.0 * building.room.height_m)
            part = materials.most_reflected[material, int(min(cos_0, cos_1) * flat * COSINES)]
            if matters(part * total * next_discount, near, task.needed):
                new = t0, t1, part * beam.reflected, left, crossed
                windows = _extend(layers, building, c, new, windows)
        low = building.plan.low[piece]
        through = 1.0 if low else materials.most_transmitted[material, min(int(most * COSINES) + 1, COSINES)]
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
def most_through(materials):  # type: ignore[no-untyped-def]
    """Largest fraction of the power that any wall lets through."""
    most = 0.0
    for material in range(len(materials.most_transmitted)):
        most = max(most, materials.most_transmitted[material, -1])
    return most


@njit(cache=True)
def _is_solid(building, beam, piece):  # type: ignore[no-untyped-def]
    """Return whether a beam meets a wall from inside it."""
    ends = building.plan.pieces_m[piece]
    dx, dy = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    left = dx * (beam[1] - ends[0, 1]) - dy * (beam[0] - ends[0, 0]) > 0.0
    return building.interior.solid[piece, 0 if left else 1]


@njit(cache=True)
def _extend(layers, building, c, new, windows):  # type: ignore[no-untyped-def]
    """Add a window that reflects a beam, or enlarge the one beside it."""
    t0, t1, reflected, left, crossed = new
    span, wall, count = windows
    piece = layers.clipped.wall[c]
    line, material = building.plan.line[piece], building.material
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
    """Part of a view as `_reflect` takes it: (t0, w0, t1, w1)."""
    w0, w1 = _nearness(layers, c, span[0]), _nearness(layers, c, span[1])
    return span[0], max(w0, 1e-9), span[1], max(w1, 1e-9)


@njit(cache=True)
def _is_needed(beam, order, task):  # type: ignore[no-untyped-def]
    """Return whether a beam of so many reflections may matter, as it is or after more of them."""
    limits, needed = task.building.limits, task.needed
    total = beam.reflected * beam.left * (most_through(task.building.materials) if beam.crossed == 0 else 1.0)
    near = max(_nearest(beam.window), 1e-6)
    if not matters(total * discount_after(limits, order), near, needed):
        return False
    if order < limits.reflections and matters(total * discount_after(limits, order + 1), near, needed):
        return True
    return _reaches(beam.window, near, total * discount_after(limits, order), needed)


@njit(cache=True)
def _nearest(beam):  # type: ignore[no-untyped-def]
    """Distance of a window from the source of its beam."""
    ax, ay, bx, by = beam[2] - beam[0], beam[3] - beam[1], beam[4] - beam[0], beam[5] - beam[1]
    wx, wy = bx - ax, by - ay
    size = np.hypot(wx, wy)
    if (wx * ax + wy * ay) * (wx * bx + wy * by) <= 0.0 and size > 0.0:
        return abs(ax * by - ay * bx) / size
    return min(np.hypot(ax, ay), np.hypot(bx, by))


@njit(cache=True)
def _reaches(beam, near, left, needed):  # type: ignore[no-untyped-def]
    """Return whether a beam matters to any receiver behind its window, with all that stands there taken away."""
    x0, y0, edge = needed.grid
    rows, columns = needed.cells.shape
    corner = _cone(beam, True, x0, y0, x0 + columns * edge, y0 + rows * edge)
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
    x0, y0, edge, columns = receivers.grid
    rows = (len(receivers.start) - 1) // int(columns)
    corner = _cone(window, True, x0, y0, x0 + columns * edge, y0 + rows * edge)
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
    """Bound of what walls leave of a beam at a point; 0 if no wall lies before it."""
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
    """Hash a sequence of lines and one line more (splitmix64)."""
    z = np.uint64(sequence) + np.uint64(line + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.int64(z ^ (z >> np.uint64(31)))
