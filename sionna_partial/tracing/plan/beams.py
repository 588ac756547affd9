"""Beams of a floor plan: sequences of walls that can reflect a path, and the receivers that they reach.

A wall of full height reflects a path in the plan like a line, so the search has two dimensions. The image S of the
transmitter and a window from A to B, the reflecting part of the last wall, bound a beam. A point in it is
S + r ((1 - t)(A - S) + t (B - S)): the window is r = 1, t runs from 0 to 1, and on any line 1 / r is linear in t.

`follow` takes the beams of one number of reflections to the next:

- Between opaque walls (`Limits.walls` is 0), `_look` splits a beam by the nearest wall, the upper envelope of segments
  in (t, 1 / r), among walls clipped in strips from the window outwards until the view is full. A beam sees low walls,
  and past them. Every sequence is listed, as `select.py` needs the sum of all bounds.
- Through walls, all walls behind the window are clipped, and `_lay` sorts them by distance between two edges, which
  gives the walls before any point and a bound of the power there. Beams too weak for every receiver end. For opaque
  walls, this would be slower.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, span_in_strip
from sionna_partial.process import in_order, njit
from sionna_partial.scene.outlines import PointBins, grow
from sionna_partial.tracing.plan.clipping import (
    THINNEST,
    TOLERANCE_M,
    Clipped,
    add_points,
    clip_cells,
    clip_nearest,
    cone_of,
    entries_in,
    move_to,
    reflect,
    rows_in,
    scratch_of,
    sort_edges,
)
from sionna_partial.tracing.plan.room import FACES, Building, Room
from sionna_partial.tracing.power import COSINES, gain_between
from sionna_partial.tracing.select import discount_after, matters, needs_by_distance
from sionna_partial.tracing.walls import are_in_wall, are_parallel

_BEAMS_AT_ONCE = 256
"""Number of beams through walls that a thread follows at a time."""

_CELL_M = 1.0
"""Edge of the cells of receivers [m]."""

_FAR_M = 1e6
"""Half of the edge of a cell that contains all receivers [m]."""

_ROOT_ANGLE_RAD = 0.1234567
"""Direction of the first root beam [rad]: no wall of a lattice map is parallel to it."""


class BeamTree(NamedTuple):
    """M beams as trees: a beam is the sequence of walls from a root down to it.

    `parent` (M,) is -1 at the roots, `piece` (M,) the reflecting piece of a wall, `source_m` (M, 2) the image of the
    transmitter. Beams 4 k to 4 k + 3 are the roots of source k, by quadrant.
    """

    parent: NDArray[np.int32]
    piece: NDArray[np.int32]
    source_m: Floats

    @classmethod
    def of(cls, beams: "Beams") -> "BeamTree":
        return cls(beams.parent, beams.piece, beams.window[:, :2].copy())

    def extended(self, beams: "Beams") -> "BeamTree":
        columns: Any = zip(self, BeamTree.of(beams), strict=True)
        return BeamTree(*map(np.concatenate, columns))


class Needed(NamedTuple):
    """Smallest power that matters, relative to (wavelength / 4 pi)^2.

    `power` (N,) is by receiver; `distance_m`, `relative` and `near` are as in `NeedsByDistance`, in the plan. `cells`
    (ny, nx) is by square cell; `grid` (4,) are their corner x0 and y0, edge [m] and number of columns.
    """

    power: Floats
    distance_m: Floats
    relative: Floats
    near: Floats
    cells: Floats
    grid: Floats


class Sources(NamedTuple):
    """S sources of beams between opaque walls, and the power that their receivers need.

    `more` (S,) are the largest numbers of reflections. A path of length s after k reflections by perfect mirrors has at
    most the power `power` (S, K, A) / (s (s + `before_m` (S,))), by degrees of azimuth at the source, or A = 1. Weaker
    pairs than receivers need are left out, and their expected power is added to `unlisted` (N,).
    """

    position_m: Floats
    more: NDArray[np.int64]
    power: Floats
    before_m: Floats
    needed: Needed
    unlisted: Floats

    @classmethod
    def equal(cls, position_m: Floats, more: int, receivers: int) -> "Sources":
        """Return sources of which every path is needed."""
        count, nothing = len(position_m), np.zeros(receivers)
        needed = Needed(
            nothing, nothing, nothing, nothing, np.zeros((1, 1)), np.array([-_FAR_M, -_FAR_M, 2.0 * _FAR_M, 1])
        )
        return cls(position_m, np.full(count, more), np.ones((count, more + 1, 1)), np.zeros(count), needed, nothing)


class Beams(NamedTuple):
    """M beams of one number of `reflections`.

    `parent` and `piece` (M,) are as in `BeamTree`, -1 for the roots. `window` (M, 6) are the image of the transmitter
    and the ends of the window [m]. `left` (M, 2) bounds the power after reflections and after walls, `crossed` (M,) is
    the smallest number of walls, `more` (M,) the largest number of further reflections, `origin` (M,) the number of the
    source, `sequence` (M,) numbers the sequences of lines. A path with the azimuth a at its end leaves the source at
    the azimuth `turn_rad` (M,) + a, or - a after an odd number of reflections.
    """

    parent: NDArray[np.int32]
    piece: NDArray[np.int32]
    window: Floats
    left: Floats
    crossed: NDArray[np.int32]
    more: NDArray[np.int32]
    origin: NDArray[np.int64]
    turn_rad: Floats
    sequence: NDArray[np.int64]
    reflections: int

    @classmethod
    def first(cls, sources_m: Floats, more: NDArray[np.integer], power: float) -> "Beams":
        """Return the beams from sources (E, 2) with numbers of reflections (E,) and the antenna's power."""
        low = [_ROOT_ANGLE_RAD + 0.5 * np.pi * root for root in range(4)]
        window = [(0.0, 0.0, math.cos(angle), math.sin(angle), -math.sin(angle), math.cos(angle)) for angle in low]
        windows_m = (np.tile(sources_m, 3)[:, None] + np.array(window)).reshape(-1, 6)
        count = len(windows_m)
        none, left = np.full(count, -1, np.int32), np.tile([power, 1.0], (count, 1))
        crossed, reflections = np.zeros(count, np.int32), np.repeat(more, 4).astype(np.int32)
        origin = np.arange(count) // 4
        return cls(none, none, windows_m, left, crossed, reflections, origin, np.zeros(count), origin, 0)


class Task(NamedTuple):
    """Inputs for beams; walls transmit the fraction `most_transmitted` at most."""

    receivers: PointBins
    building: Building
    most_transmitted: float
    sources: Sources


class _Beam(NamedTuple):
    """One of `Beams`."""

    window: Floats
    reflected: float
    left: float
    crossed: np.int64
    more: np.int64


class _Layers(NamedTuple):
    """Scratch of one beam: its walls, and the walls between two edges, from the window outwards.

    For clipped wall c, `slope` (C,) is the slope of 1 / r, `along` (C, 2) its direction. For edge i, `ray` (E, 3) is
    the direction and length of the beam. Between edges i and i + 1 are `depth` (E,) walls `wall` (E, D), behind which
    `left` (E, D) of the power is left after `crossed` (E, D) walls. `open` (P,) is the last window of a line.
    """

    clipped: Clipped
    slope: Floats
    along: Floats
    ray: Floats
    depth: NDArray[np.int64]
    wall: NDArray[np.int64]
    left: Floats
    crossed: NDArray[np.int64]
    open: NDArray[np.int64]


def needed_of(power: Floats, room: Room, wavelength_m: float) -> Needed:
    far = needs_by_distance(room.tx_m[:2], room.rx_m[:, :2], power, wavelength_m)
    power = power * (4.0 * math.pi / wavelength_m) ** 2
    low = room.rx_m[:, :2].min(axis=0)
    column, row = ((room.rx_m[:, :2] - low) / _CELL_M).astype(np.int64).T
    cells = np.full((row.max() + 1, column.max() + 1), np.inf)
    np.minimum.at(cells, (row, column), power)
    return Needed(power, *far, cells, np.array([*low, _CELL_M, cells.shape[1]]))


def trace_beams(building: Building, receivers: PointBins, sources: Sources) -> tuple[BeamTree, NDArray[np.int32]]:
    """Find every sequence of opaque walls from sources that receivers need.

    Return beams and pairs (K, 2) of beam and receiver, ordered by sequence and then receiver; a receiver has each
    sequence of wall lines once.
    """
    beams = Beams.first(sources.position_m, sources.more, 1.0)
    tree, task, pairs = BeamTree.of(beams), Task(receivers, building, 1.0, sources), []
    while len(beams.parent):
        beams, pair, _ = follow(tree, beams, task)
        tree = tree.extended(beams)
        pairs.append(pair)
    return tree, np.concatenate([np.zeros((0, 2), np.int32), *pairs])


def follow(tree: BeamTree, beams: Beams, task: Task) -> tuple[Beams, NDArray[np.int32], Floats]:
    """Reflect the last beams of a tree; return the new ones, pairs as in `trace_beams`, and bounds (K,) of their power.

    Through walls, the bounds are fractions left after walls.
    """
    building, count, before = task.building, len(beams.parent), len(tree.parent) - len(beams.parent)
    at_once = _BEAMS_AT_ONCE if building.limits.walls else max(1, count)

    def followed(first: int) -> tuple[Any, ...]:
        return _follow_beams(beams, before, first, min(first + at_once, count), task)  # type: ignore[no-any-return]

    starts, nothing = range(0, count, at_once), tuple(column[:0] for column in beams[:6])
    found = in_order(followed, starts) if len(starts) > 1 else map(followed, starts)
    children, pair, through = zip((nothing, np.zeros((0, 2), np.int32), np.zeros(0)), *found, strict=True)
    columns: list[Any] = [np.concatenate(column) for column in zip(*children, strict=True)]
    above, line, lines = columns[0] - before, building.plan.line[columns[1]], int(building.plan.line.max(initial=0)) + 1
    _, sequence = np.unique(beams.sequence[above] * lines + line, return_inverse=True)
    along = building.plan.pieces_m[columns[1], 1] - building.plan.pieces_m[columns[1], 0]
    twice = 2.0 * (-1.0) ** beams.reflections * np.arctan2(along[:, 1], along[:, 0])
    turn_rad = (beams.turn_rad[above] + twice) % (2.0 * math.pi)
    pairs, receivers = np.concatenate(pair), max(1, len(task.receivers.order))
    _, once = np.unique(beams.sequence[pairs[:, 0] - before] * receivers + pairs[:, 1], return_index=True)
    columns += [beams.origin[above], turn_rad, sequence, beams.reflections + 1]
    return Beams(*columns), pairs[once], np.concatenate(through)[once]


@njit(cache=True, nogil=True)
def _follow_beams(beams, before, first, stop, task):
    layers, building = _layers_of(task.building.plan), task.building
    plan, opaque, room, receivers = building.plan, building.limits.walls == 0, building.room, task.receivers
    pieces_m, low, scratch, sources = plan.pieces_m, plan.low, layers.clipped, task.sources
    parent, piece = np.empty(64, np.int32), np.empty(64, np.int32)
    window, left = np.empty((64, 6)), np.empty((64, 2))
    crossed, more = np.empty(64, np.int32), np.empty(64, np.int32)
    span, wall = np.empty((64, 4)), np.empty((64, 2), np.int64)
    pair, through, used = np.empty((1024, 2), np.int32), np.empty(1024), np.int64(0)
    count = np.int64(0)
    for k in range(first, stop):
        own, further = beams.piece[k], np.int64(beams.more[k])
        beam = _Beam(beams.window[k], beams.left[k, 0], beams.left[k, 1], np.int64(beams.crossed[k]), further)
        if not (opaque or own < 0 or _is_needed(beam, task)):
            continue
        walls = _clip_walls(plan, beam.window, own, opaque, layers)
        if opaque:
            span, wall, windows = _look(walls, plan.line, low, layers, span, wall)
            view, strength = (span, wall, windows, scratch.wall, low), _strength_of(beams, k, sources)
            pairs = pair, through, used
            pair, through, used = add_points(beam.window, before + k, view, receivers, strength, pairs)
        else:
            span, wall, windows = _lay(beam, walls, task, layers, (span, wall, np.int64(0)))
            if own >= 0:
                pair, through, used = _add_pairs(beam, before + k, walls, task, layers, (pair, through, used))
        for i in range(windows if further > 0 else 0):
            if count == len(parent):
                parent, piece, window = grow(parent, count + 1), grow(piece, count + 1), grow(window, count + 1)
                left, crossed, more = grow(left, count + 1), grow(crossed, count + 1), grow(more, count + 1)
            c, new, part = wall[i, 0], window[count], span[i]
            ends = (part[0], part[1], part[2], part[3]) if opaque else _piece_of(layers, c, part)
            if c < 0 or not reflect(beam.window, ends, pieces_m[scratch.wall[c]], new):
                continue
            reflected, behind = (beam.reflected, 1.0) if opaque else (part[2], part[3])
            if opaque:
                reflected *= _most_reflected(new, sources.before_m[beams.origin[k]], scratch.wall[c], building)
                if further == 1 and not _is_last_needed(beams, k, new, reflected, sources):
                    continue
            elif own < 0:
                reflected *= gain_between(room.gains.by_azimuth, *_sides(beams, k, new)) / room.gains.largest
            if not (opaque or _is_needed(_Beam(new, reflected, behind, wall[i, 1], further - 1), task)):
                continue
            parent[count], piece[count], crossed[count] = before + k, scratch.wall[c], wall[i, 1]
            left[count, 0], left[count, 1], more[count] = reflected, behind, further - 1
            count += 1
    children = parent[:count], piece[:count], window[:count], left[:count], crossed[:count], more[:count]
    return children, pair[:used], through[:used]


@njit(cache=True)
def _strength_of(beams, k, sources):
    """Return all that decides the power of a beam at receivers, as for `add_points`."""
    source, sign = beams.origin[k], 1.0 if beams.reflections % 2 == 0 else -1.0
    arrays = sources.power[source, beams.reflections], sources.needed.power, sources.unlisted
    return arrays, (beams.left[k, 0], sources.before_m[source], sign, beams.turn_rad[k]), beams.piece[k] >= 0


@njit(cache=True)
def _sides(beams, k, window):
    """Return the azimuths at the source [degrees] between which a window is seen by a beam, counterclockwise."""
    x, y, sign = beams.window[k, 0], beams.window[k, 1], 1.0 if beams.reflections % 2 == 0 else -1.0
    first = np.degrees(sign * np.arctan2(window[5] - y, window[4] - x) + beams.turn_rad[k])
    second = np.degrees(sign * np.arctan2(window[3] - y, window[2] - x) + beams.turn_rad[k])
    return (first, second) if sign > 0.0 else (second, first)


@njit(cache=True)
def _is_last_needed(beams, k, window, reflected, sources):
    source = beams.origin[k]
    most = gain_between(sources.power[source, beams.reflections + 1], *_sides(beams, k, window))
    before_m = sources.before_m[source]
    return _reaches(window, _window_distance(window), reflected * most, before_m, sources.needed)


@njit(cache=True)
def _most_reflected(window, before_m, piece, building):
    """Return the largest fraction of power that the window of a new beam reflects."""
    ax, ay, bx, by = window[2] - window[0], window[3] - window[1], window[4] - window[0], window[5] - window[1]
    far, length = max(np.hypot(ax, ay), np.hypot(bx, by)), before_m + _window_distance(window)
    cosine = (ax * by - ay * bx) / (np.hypot(ax - bx, ay - by) * far)
    flat = length / np.hypot(length, 2.0 * building.room.height_m)
    return building.materials.most_reflected[building.material[piece], int(cosine * flat * COSINES)]


@njit(cache=True)
def _layers_of(plan):
    size = len(plan.pieces_m)
    edges = 2 * size + 2
    return _Layers(
        scratch_of(plan),
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
def _clip_walls(plan, beam, own, opaque, layers):
    scratch, grid = layers.clipped, plan.cells.grid
    scratch.visit[-1] += 1
    if opaque:
        count = clip_nearest(plan, beam, own, scratch)
    else:
        count = clip_cells(plan, beam, own, cone_of(beam, own >= 0, grid, int(grid[4])), np.int64(0), scratch)
    for c in range(count):
        slope = (scratch.found[c, 3] - scratch.found[c, 1]) / (scratch.found[c, 2] - scratch.found[c, 0])
        layers.slope[c] = slope
        if not opaque:
            layers.open[plan.line[scratch.wall[c]]] = -1
            ends = plan.pieces_m[scratch.wall[c]]
            wx, wy = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
            size = np.hypot(wx, wy)
            layers.along[c, 0], layers.along[c, 1] = wx / size, wy / size
    sort_edges(scratch.found, scratch.edge, count)
    for i in range(0 if opaque else 2 * count + 2):
        t = scratch.edge[i]
        x = (1.0 - t) * (beam[2] - beam[0]) + t * (beam[4] - beam[0])
        y = (1.0 - t) * (beam[3] - beam[1]) + t * (beam[5] - beam[1])
        size = np.hypot(x, y)
        layers.ray[i, 0], layers.ray[i, 1], layers.ray[i, 2] = x / size, y / size, size
    return count


@njit(cache=True)
def _look(count, line, low, layers, span, wall):
    """Split a beam by the nearest opaque wall and the low walls before it.

    Return windows (t0, 1 / r0, t1, 1 / r1), their clipped walls, -1 for none, and their number.
    """
    found, order, active, edge = layers.clipped.found, layers.clipped.order, layers.clipped.active, layers.clipped.edge
    slope, walls = layers.slope, layers.clipped.wall
    begun, number, windows, last = np.int64(0), np.int64(0), np.int64(0), np.int64(-1)
    for i in range(2 * count + 1):
        t0, t1 = edge[i], edge[i + 1]
        if t1 - t0 < THINNEST:
            continue
        middle = 0.5 * (t0 + t1)
        begun, number = move_to(middle, found, order, active, count, begun, number)
        best, best_w, some_low = np.int64(-1), 0.0, False
        for c in active[:number]:
            w = found[c, 1] + slope[c] * (middle - found[c, 0])
            if low[walls[c]]:
                some_low = True
            elif w > best_w:
                best, best_w = np.int64(c), w
        for c in active[: number if some_low else 0]:
            w = found[c, 1] + slope[c] * (middle - found[c, 0])
            if low[walls[c]] and w > best_w:
                span, wall = grow(span, windows + 1), grow(wall, windows + 1)
                span[windows, 0], span[windows, 1], span[windows, 2] = t0, w + slope[c] * (t0 - middle), t1
                span[windows, 3], wall[windows, 0], wall[windows, 1] = w + slope[c] * (t1 - middle), c, 0
                windows += 1
        steep = slope[best] if best >= 0 else 0.0
        before = wall[last, 0] if last >= 0 else -1
        if before >= 0 and best >= 0 and line[walls[before]] == line[walls[best]]:
            span[last, 2], span[last, 3] = t1, best_w + steep * (t1 - middle)
            continue
        span, wall, last = grow(span, windows + 1), grow(wall, windows + 1), windows
        span[windows, 0], span[windows, 1], span[windows, 2] = t0, best_w + steep * (t0 - middle), t1
        span[windows, 3], wall[windows, 0], wall[windows, 1] = best_w + steep * (t1 - middle), best, 0
        windows += 1
    return span, wall, windows


@njit(cache=True)
def _lay(beam, count, task, layers, windows):
    """Put the walls of a beam into layers; return the windows that reflect it.

    Windows are (t from, t to, power after reflections, power after walls), (clipped wall, walls crossed), and their
    number.
    """
    scratch, begun, active = layers.clipped, np.int64(0), np.int64(0)
    for i in range(2 * count + 1):
        layers.depth[i] = 0
        t0, t1 = scratch.edge[i], scratch.edge[i + 1]
        if t1 - t0 < THINNEST:
            continue
        middle = 0.5 * (t0 + t1)
        begun, active = move_to(middle, scratch.found, scratch.order, scratch.active, count, begun, active)
        _sort_by_distance(layers, active, middle)
        windows = _lay_one(beam, i, active, task, layers, windows)
    return windows


@njit(cache=True)
def _nearness(layers, c, t):
    """Return 1 / r of a clipped wall at t."""
    found = layers.clipped.found
    return found[c, 1] + layers.slope[c] * (t - found[c, 0])


@njit(cache=True)
def _sort_by_distance(layers, count, t):
    active = layers.clipped.active
    for j in range(1, count):
        c, k = active[j], j
        w = _nearness(layers, c, t)
        while k > 0 and _nearness(layers, active[k - 1], t) < w:
            active[k] = active[k - 1]
            k -= 1
        active[k] = c


@njit(cache=True)
def _lay_one(beam, i, active, task, layers, windows):
    scratch, plan_line, low = layers.clipped, task.building.plan.line, task.building.plan.low
    of_piece, interior = task.building.material, task.building.interior
    depth_m = interior.depth_m
    most_reflected = task.building.materials.most_reflected
    most_transmitted = task.building.materials.most_transmitted
    limits, left, crossed = task.building.limits, beam.left, beam.crossed
    order = limits.reflections - beam.more
    discount, next_discount = discount_after(limits, order), discount_after(limits, order + 1)
    t0, x_0, y_0, size_0 = scratch.edge[i], layers.ray[i, 0], layers.ray[i, 1], layers.ray[i, 2]
    t1, x_1, y_1, size_1 = scratch.edge[i + 1], layers.ray[i + 1, 0], layers.ray[i + 1, 1], layers.ray[i + 1, 2]
    start_0 = start_1 = steep_0 = steep_1 = first = 0.0
    before_0, before_1, may_be_same = size_0, size_1, order > 0 and depth_m > 0.0
    vx, vy = beam.window[4] - beam.window[2], beam.window[5] - beam.window[3]
    width = max(np.hypot(vx, vy), 1e-12)
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
        if not matters(total * discount, near, task.sources.needed):
            break
        rays = (x_0, y_0, cos_0, before_0, r_0), (x_1, y_1, cos_1, before_1, r_1)
        inside = may_be_same and are_parallel((ux * vx + uy * vy) / width)
        inside = inside and are_in_wall(interior, beam.window[0], beam.window[1], rays)
        before_0, before_1, may_be_same = r_0, r_1, depth_m > 0.0 and not low[piece]
        vx, vy, width = ux, uy, 1.0
        if beam.more > 0 and not (inside and j > 0):
            flat = near / np.hypot(near, 2.0 * task.building.room.height_m)
            part = most_reflected[material, int(min(cos_0, cos_1) * flat * COSINES)]
            if matters(part * total * next_discount, near, task.sources.needed):
                new = t0, t1, part * beam.reflected, left, crossed
                windows = _extend(layers, plan_line, of_piece, c, new, windows)
        if inside and j == 0 and not low[piece]:
            break
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
def _extend(layers, lines, material, c, new, windows):
    t0, t1, reflected, left, crossed = new
    span, wall, count = windows
    piece = layers.clipped.wall[c]
    line = lines[piece]
    last = layers.open[line]
    beside = last >= 0 and span[last, 1] >= t0 - THINNEST and wall[last, 1] == crossed
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
def _piece_of(layers, c, span):
    w0, w1 = _nearness(layers, c, span[0]), _nearness(layers, c, span[1])
    return span[0], max(w0, 1e-9), span[1], max(w1, 1e-9)


@njit(cache=True)
def _is_needed(beam, task):
    limits = task.building.limits
    order = limits.reflections - beam.more
    total = beam.reflected * beam.left * (task.most_transmitted if beam.crossed == 0 else 1.0)
    near = max(_window_distance(beam.window), 1e-6)
    if not matters(total * discount_after(limits, order), near, task.sources.needed):
        return False
    if beam.more > 0 and matters(total * discount_after(limits, order + 1), near, task.sources.needed):
        return True
    return _reaches(beam.window, near, total * discount_after(limits, order), 0.0, task.sources.needed)


@njit(cache=True)
def _window_distance(beam):
    ax, ay, bx, by = beam[2] - beam[0], beam[3] - beam[1], beam[4] - beam[0], beam[5] - beam[1]
    wx, wy = bx - ax, by - ay
    size = np.hypot(wx, wy)
    if (wx * ax + wy * ay) * (wx * bx + wy * by) <= 0.0 and size > 0.0:
        return abs(ax * by - ay * bx) / size
    return min(np.hypot(ax, ay), np.hypot(bx, by))


@njit(cache=True)
def _reaches(beam, near, left, before_m, needed):
    """Return whether a beam would matter to any receiver behind its window without walls."""
    x0, y0, edge, (rows, columns) = needed.grid[0], needed.grid[1], needed.grid[2], needed.cells.shape
    corner = cone_of(beam, True, needed.grid, rows)
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
            if left >= needed.cells[row, column] * length * (length + before_m):
                return True
    return False


@njit(cache=True)
def _add_pairs(beam, number, count, task, layers, pairs):
    """Pair a reflected beam with the receivers that need it, behind a wall or after one."""
    window, receivers, (pair, through, used) = beam.window, task.receivers, pairs
    ax, ay, bx, by = window[2] - window[0], window[3] - window[1], window[4] - window[0], window[5] - window[1]
    area, first, second, width = ax * by - ay * bx, np.hypot(ax, ay), np.hypot(bx, by), np.hypot(ax - bx, ay - by)
    corner = cone_of(window, True, receivers.grid, (len(receivers.start) - 1) // int(receivers.grid[3]))
    from_row, to_row = rows_in(corner, receivers.start, receivers.grid)
    for row in range(from_row, to_row):
        begin, end = entries_in(corner, receivers.start, receivers.grid, row)
        for i in range(begin, end):
            ex, ey = receivers.points_m[i, 0] - window[0], receivers.points_m[i, 1] - window[1]
            alpha, beta = (ex * by - ey * bx) / area, (ax * ey - ay * ex) / area
            r = alpha + beta
            if beta * area < -TOLERANCE_M * first or alpha * area < -TOLERANCE_M * second:
                continue
            if r <= 0.0 or (r - 1.0) * area < -TOLERANCE_M * width:  # r may be 0 where the image is close to its wall
                continue
            rx = receivers.order[i]
            least = task.sources.needed.power[rx] * (ex * ex + ey * ey) / beam.reflected
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
def _left_at(beam, count, layers, t, r):
    """Return a bound of a beam's power after walls at a point; 0 if no wall is in front of it."""
    edge = layers.clipped.edge
    low, high = 0, 2 * count + 1
    t = min(max(t, THINNEST), 1.0 - THINNEST)
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
