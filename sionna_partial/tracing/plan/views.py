"""Search between opaque walls: the nearest wall in each direction reflects a beam.

The view of a beam is divided into windows, the upper envelope of its walls in (t, 1 / r). A low wall has a window of
its own, and the view continues behind it:

     1 / r |   ___ low                 windows of the low wall and, below it, of walls 1 and 2
           |         ________ 2
           |_____ 1 /
           +------------------ t

Receivers before the nearest high wall are paired with the beam.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit
from sionna_partial.scene.outlines import grow
from sionna_partial.tracing.plan.clipping import (
    THINNEST,
    TOLERANCE_M,
    Children,
    azimuths_of,
    clip_nearest,
    entries_in,
    move_to,
    nearness,
    reaches,
    reflect,
    rows_in,
    window_distance,
    with_room,
)
from sionna_partial.tracing.plan.room import Building
from sionna_partial.tracing.power import COSINES, EXPECTED, gain_between

_FAR_M = 1e6
"""Length at which beams that hit nothing are cut off [m], fixed: no receiver depends on others."""


class Output(NamedTuple):
    """Results of a search, and scratch: beams, pairs (K, 2) of beam and receiver, and bounds (K,) of their power.

    The windows of one beam are `span` (W, 4), as (t0, 1 / r0, t1, 1 / r1), and their clipped walls `wall` (W,), -1 for
    none.
    """

    children: Children
    pair: NDArray[np.int32]
    power: Floats
    span: Floats
    wall: NDArray[np.int64]

    @classmethod
    def empty(cls, size: int = 1024) -> "Output":
        windows = np.empty((size, 4)), np.empty(size, np.int64)
        return cls(Children.empty(size), np.empty((size, 2), np.int32), np.empty(size), *windows)


class Mirrors(NamedTuple):
    """Materials (P,) of the pieces of walls, their table `most_reflected`, and the height of the room."""

    material: NDArray[np.int64]
    most_reflected: Floats
    height_m: float

    @classmethod
    def of(cls, building: Building) -> "Mirrors":
        return cls(building.material, building.materials.most_reflected, building.room.height_m)


class _Ray(NamedTuple):
    """All that decides the power of one beam at a point, with fields as in `Beams` and `Sources`."""

    window: Floats
    by_azimuth: Floats
    reflected: float
    before_m: float
    sign: float
    turn_rad: float


@njit(cache=True, nogil=True)
def follow_opaque(beams, before, plan, mirrors, receivers, sources, scratch, output):
    """Reflect all `beams`, which are numbered from `before`, between opaque walls.

    Each beam is divided into windows and paired with receivers; the windows that receivers need become new beams.
    Return the new beams and pairs, and their numbers.
    """
    children, pair, power, span, wall = output
    needed, unlisted, count, used = sources.needed.power, sources.unlisted, 0, 0
    sign = 1.0 if beams.reflections % 2 == 0 else -1.0
    for k in range(len(beams.piece)):
        walls = clip_nearest(plan, beams.window[k], beams.piece[k], scratch)
        span, wall, windows = _divide(walls, plan, scratch, span, wall)
        by_azimuth, before_m = sources.power[beams.origin[k], beams.reflections], sources.before_m[beams.origin[k]]
        ray = _Ray(beams.window[k], by_azimuth, beams.reflected[k], before_m, sign, beams.turn_rad[k])
        is_root, view, needs = beams.piece[k] < 0, (span, wall, windows), (needed, unlisted)
        pair, power, used = _add_points(
            ray, is_root, before + k, view, plan.low, scratch, receivers, needs, pair, power, used
        )
        if beams.more[k] > 0:
            children = with_room(children, count + windows)
            count = _add_children(beams, k, before + k, view, plan.pieces_m, mirrors, sources, scratch, children, count)
    return children, count, pair, power, used


@njit(cache=True)
def _divide(count, plan, scratch, span, wall):
    """Divide the view of a beam by the nearest wall; return windows, as in `Output`, and their number."""
    edge, active, walls, slope = scratch.edge, scratch.active, scratch.wall, scratch.slope
    low, line, begun, number, windows, last = plan.low, plan.line, 0, 0, 0, -1
    for i in range(2 * count + 1):
        t0, t1 = edge[i], edge[i + 1]
        if t1 - t0 < THINNEST:
            continue
        middle = 0.5 * (t0 + t1)
        begun, number = move_to(middle, scratch, count, begun, number)
        span, wall = grow(span, windows + number + 1), grow(wall, windows + number + 1)
        best, best_w, some_low = np.int64(-1), 0.0, False
        for c in active[:number]:
            w = nearness(scratch, c, middle)
            if low[walls[c]]:
                some_low = True
            elif w > best_w:
                best, best_w = np.int64(c), w
        for c in active[: number if some_low else 0]:
            w = nearness(scratch, c, middle)
            if low[walls[c]] and w > best_w:
                _write_window(span, wall, windows, t0, t1, w, slope[c], c)
                windows += 1
        steep = slope[best] if best >= 0 else 0.0
        before = wall[last] if last >= 0 else -1
        if before >= 0 and best >= 0 and line[walls[before]] == line[walls[best]]:
            span[last, 2], span[last, 3] = t1, best_w + steep * (t1 - middle)
            continue
        _write_window(span, wall, windows, t0, t1, best_w, steep, best)
        last = windows
        windows += 1
    return span, wall, windows


@njit(cache=True, borrows=True)
def _write_window(span, wall, window, t0, t1, w, slope, c):
    """Write the part of clipped wall c from t0 to t1; in the middle, 1 / r is w."""
    middle = 0.5 * (t0 + t1)
    span[window, 0], span[window, 1], span[window, 2] = t0, w + slope * (t0 - middle), t1
    span[window, 3], wall[window] = w + slope * (t1 - middle), c


@njit(cache=True, borrows=True)
def _add_children(beams, k, number, view, pieces_m, mirrors, sources, scratch, children, count):
    """Write beam k, numbered `number`, reflected in each window that a receiver needs; return the new count."""
    (span, wall, windows), source = view, beams.origin[k]
    before_m, more = sources.before_m[source], beams.more[k] - 1
    for i in range(windows):
        if wall[i] < 0:
            continue
        piece, window = scratch.wall[wall[i]], children.window[count]
        part = span[i, 0], span[i, 1], span[i, 2], span[i, 3]
        if not reflect(beams.window[k], part, pieces_m[piece], window):
            continue
        reflected = beams.reflected[k] * _most_reflected(window, before_m, mirrors.material[piece], mirrors)
        if more == 0:
            most = gain_between(sources.power[source, beams.reflections + 1], *azimuths_of(beams, k, window))
            near = window_distance(window)
            if not reaches(window, near, reflected * most, before_m, sources.needed, scratch.corner):
                continue
        children.parent[count], children.piece[count], children.more[count] = number, piece, more
        children.reflected[count], children.left[count], children.crossed[count] = reflected, 1.0, 0
        count += 1
    return count


@njit(cache=True, borrows=True)
def _most_reflected(window, before_m, material, mirrors):
    """Return the largest fraction of power that the window of a new beam reflects."""
    ax, ay, bx, by = window[2] - window[0], window[3] - window[1], window[4] - window[0], window[5] - window[1]
    far, length = max(np.hypot(ax, ay), np.hypot(bx, by)), before_m + window_distance(window)
    cosine = (ax * by - ay * bx) / (np.hypot(ax - bx, ay - by) * far)
    flat = length / np.hypot(length, 2.0 * mirrors.height_m)
    return mirrors.most_reflected[material, int(cosine * flat * COSINES)]


@njit(cache=True)
def _add_points(ray, is_root, number, view, low, scratch, receivers, needs, pair, power, used):
    """Pair a beam, as `number`, with the receivers that see it before high walls, and need it.

    `needs` are the bounds that matter (N,) and the sums (N,) to which the expected power of weaker pairs is added.
    """
    (span, wall, windows), (points, order, start, grid), (needed, unlisted) = view, receivers, needs
    corner, inward, walls, beam = scratch.corner, np.empty((4, 3)), scratch.wall, ray.window
    for window in range(windows):
        if wall[window] >= 0 and low[walls[wall[window]]]:
            continue
        _write_corners(beam, not is_root, span, window, corner)
        _write_inward(corner, inward)
        first, last = rows_in(corner, start, grid)
        for row in range(first, last):
            begin, end = entries_in(corner, start, grid, row)
            for i in range(begin, end):
                x, y, rx = points[i, 0], points[i, 1], order[i]
                if not _is_within(inward, x, y):
                    continue
                bound = _power_at(x - beam[0], y - beam[1], ray)
                if bound < needed[rx]:
                    unlisted[rx] += EXPECTED * bound
                    continue
                if used == len(pair):
                    pair, power = grow(pair, used + 1), grow(power, used + 1)
                pair[used, 0], pair[used, 1], power[used] = number, rx, bound
                used += 1
    return pair, power, used


@njit(cache=True, borrows=True)
def _power_at(dx, dy, ray):
    """Return the bound of a beam's power at a point, relative to its image."""
    length, azimuth_rad = np.sqrt(dx * dx + dy * dy), ray.sign * np.arctan2(dy, dx) + ray.turn_rad
    bound = ray.reflected * ray.by_azimuth[int(np.degrees(azimuth_rad) + 360.5) % len(ray.by_azimuth)]
    return bound / (length * (length + ray.before_m))


@njit(cache=True, borrows=True)
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


@njit(cache=True, borrows=True)
def _write_inward(corner, inward):
    """Write unit inward normals and offsets of a clockwise quadrilateral; an edge of no length bounds nothing."""
    for k in range(4):
        inward[k, 0], inward[k, 1], inward[k, 2] = 0.0, 0.0, -1.0
        dx, dy = corner[(k + 1) % 4, 0] - corner[k, 0], corner[(k + 1) % 4, 1] - corner[k, 1]
        length = np.sqrt(dx * dx + dy * dy)
        if length > 0.0:
            inward[k, 0], inward[k, 1] = dy / length, -dx / length
            inward[k, 2] = inward[k, 0] * corner[k, 0] + inward[k, 1] * corner[k, 1]


@njit(cache=True, borrows=True)
def _is_within(inward, x, y):
    k = 0
    while k < 4 and inward[k, 0] * x + inward[k, 1] * y - inward[k, 2] >= -TOLERANCE_M:
        k += 1
    return k == 4
