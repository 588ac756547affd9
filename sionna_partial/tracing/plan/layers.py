r"""Search through walls: a beam is divided at its edges, and its walls between two edges are sorted by distance.

            i     i + 1     edges, with rays 0 and 1 from the image
             \     /
      2  _____\___/____     layer 2 of edge i: the power left after the walls 0, 1 and 2
      1   _____\_/_____     layer 1
      0    ____|_|____      layer 0
               S

Every wall of a layer reflects the power that is left before it. The bounds hold for all receivers between two edges.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit
from sionna_partial.scene.outlines import Plan, grow
from sionna_partial.tracing.line import are_in_wall, are_parallel, is_as_deep
from sionna_partial.tracing.plan.clipping import (
    THINNEST,
    TOLERANCE_M,
    Children,
    Clipped,
    azimuths_of,
    clip_all,
    entries_in,
    move_to,
    nearness,
    reaches,
    reflect,
    rows_in,
    window_distance,
    with_room,
    write_cone,
)
from sionna_partial.tracing.plan.room import FACES
from sionna_partial.tracing.power import COSINES, gain_between
from sionna_partial.tracing.select import discount_after, matters


class Beam(NamedTuple):
    """One of `beams.Beams`."""

    window: Floats
    reflected: float
    left: float
    crossed: np.int64
    more: np.int64


class Layers(NamedTuple):
    """Scratch of one beam: its walls, and the walls between two edges, from the window outwards.

    For clipped wall c, `along` (C, 2) is its direction. For edge i, `ray` (E, 3) is the direction and length of the
    beam. Between edges i and i + 1 the beam meets `depth` (E,) walls, which are listed in `wall` (E, D). Behind each of
    them the fraction `left` (E, D) of the power remains, and `crossed` (E, D) walls have been crossed.

    The windows that reflect the beam are `span` (W, 4), as (t from, t to, power after reflections, power after walls),
    and `window` (W, 2), as (clipped wall, walls crossed); `open` (P,) is the last window of a line.
    """

    clipped: Clipped
    along: Floats
    ray: Floats
    depth: NDArray[np.int64]
    wall: NDArray[np.int64]
    left: Floats
    crossed: NDArray[np.int64]
    span: Floats
    window: NDArray[np.int64]
    open: NDArray[np.int64]

    @classmethod
    def of(cls, plan: Plan) -> "Layers":
        size, edges = len(plan.pieces_m), 2 * len(plan.pieces_m) + 2
        wall, crossed = np.empty((2, edges, FACES), np.int64)
        windows = np.empty((edges * FACES, 4)), np.empty((edges * FACES, 2), np.int64)
        depth, left = np.empty(edges, np.int64), np.empty((edges, FACES))
        directions = np.empty((size, 2)), np.empty((edges, 3))
        return cls(Clipped.of(plan), *directions, depth, wall, left, crossed, *windows, np.empty(size, np.int64))


class Output(NamedTuple):
    """Results of a search: beams, pairs (K, 2) of beam and receiver, and fractions (K,) of power left after walls."""

    children: Children
    pair: NDArray[np.int32]
    left: Floats

    @classmethod
    def empty(cls, size: int = 1024) -> "Output":
        return cls(Children.empty(size), np.empty((size, 2), np.int32), np.empty(size))


class _Face(NamedTuple):
    """A wall between two edges: its distances from the image, the cosines of incidence, and bounds of both."""

    r_0: float
    r_1: float
    cos_0: float
    cos_1: float
    near: float
    steepest: float


class _Behind(NamedTuple):
    """State behind some faces: power left, walls crossed, and the wall that was entered last.

    Its first face is at `start_0`, `start_1`, the smallest cosines of its faces are `cos_0`, `cos_1`, and it transmits
    the fraction `through`, 0 where there is none.
    """

    left: float
    crossed: np.int64
    start_0: float
    start_1: float
    cos_0: float
    cos_1: float
    through: float


@njit(cache=True, nogil=True)
def follow_through(beams, before, first, stop, task, layers, output):
    """Reflect the beams `first` to `stop`, which are numbered from `before`, in walls and in walls behind walls.

    Beams are paired with the receivers behind at least one wall that may need them. Return the new beams and pairs, and
    their numbers.
    """
    children, pair, left = output
    receivers, needed, count, used = task.receivers, task.sources.needed.power, 0, 0
    for k in range(first, stop):
        beam = Beam(
            beams.window[k], beams.reflected[k], beams.left[k], np.int64(beams.crossed[k]), np.int64(beams.more[k])
        )
        is_reflected = beams.piece[k] >= 0
        if is_reflected and not _is_needed(beam, task, layers.clipped.corner):
            continue
        walls = _clip(beam, task, beams.piece[k], layers)
        windows = _lay(beam, walls, task, layers)
        if is_reflected:
            pair, left, used = _add_pairs(beam, before + k, walls, layers, needed, receivers, pair, left, used)
        if beam.more > 0:
            children = with_room(children, count + windows)
            count = _add_children(beams, k, before + k, windows, task, layers, children, count)
    return children, count, pair, left, used


@njit(cache=True, borrows=True)
def _clip(beam, task, own, layers):
    """Clip the walls in a beam, and write their directions and the rays at the edges; return the number of walls."""
    plan, scratch, window = task.building.plan, layers.clipped, beam.window
    count = clip_all(plan, window, own, scratch)
    for c in range(count):
        layers.open[plan.line[scratch.wall[c]]] = -1
        ends = plan.pieces_m[scratch.wall[c]]
        wx, wy = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
        size = np.hypot(wx, wy)
        layers.along[c, 0], layers.along[c, 1] = wx / size, wy / size
    for i in range(2 * count + 2):
        t = scratch.edge[i]
        x = (1.0 - t) * (window[2] - window[0]) + t * (window[4] - window[0])
        y = (1.0 - t) * (window[3] - window[1]) + t * (window[5] - window[1])
        size = np.hypot(x, y)
        layers.ray[i, 0], layers.ray[i, 1], layers.ray[i, 2] = x / size, y / size, size
    return count


@njit(cache=True, borrows=True)
def _lay(beam, count, task, layers):
    """Put the walls of a beam into layers; write the windows that reflect it, and return their number."""
    scratch, begun, active, windows = layers.clipped, 0, 0, 0
    for i in range(2 * count + 1):
        layers.depth[i] = 0
        t0, t1 = scratch.edge[i], scratch.edge[i + 1]
        if t1 - t0 < THINNEST:
            continue
        middle = 0.5 * (t0 + t1)
        begun, active = move_to(middle, scratch, count, begun, active)
        _sort_by_distance(scratch, active, middle)
        windows = _lay_between(beam, i, active, task, layers, windows)
    return windows


@njit(cache=True, borrows=True)
def _sort_by_distance(scratch, count, t):
    active = scratch.active
    for j in range(1, count):
        c, k = active[j], j
        w = nearness(scratch, c, t)
        while k > 0 and nearness(scratch, active[k - 1], t) < w:
            active[k] = active[k - 1]
            k -= 1
        active[k] = c


@njit(cache=True, borrows=True)
def _lay_between(beam, i, active, task, layers, windows):
    """Lay the `active` walls of a beam, sorted by distance, between edges i and i + 1; return the number of windows.

    Layers end where the power left matters to no receiver, or too many walls were crossed. Faces of one wall, as in
    `tracing/line.py`, take the loss of the face that transmits most, and do not reflect the beam inside their wall.
    """
    building, needed, depth_m = task.building, task.sources.needed, task.building.interior.depth_m
    limits, materials, order = building.limits, building.materials, building.limits.reflections - beam.more
    discount, next_discount = discount_after(limits, order), discount_after(limits, order + 1)
    behind, may_be_same = _Behind(beam.left, beam.crossed, 0.0, 0.0, 0.0, 0.0, 0.0), order > 0 and depth_m > 0.0
    before_0, before_1 = layers.ray[i, 2], layers.ray[i + 1, 2]
    wx, wy = beam.window[4] - beam.window[2], beam.window[5] - beam.window[3]
    width = max(np.hypot(wx, wy), 1e-12)
    for j in range(min(active, FACES)):
        c = layers.clipped.active[j]
        piece, face = layers.clipped.wall[c], _face_between(c, i, layers)
        material, is_low = building.material[piece], building.plan.low[piece]
        layers.wall[i, j], layers.left[i, j], layers.crossed[i, j] = c, 0.0, behind.crossed
        layers.depth[i] = j + 1
        total = beam.reflected * behind.left * (task.most_transmitted if behind.crossed == 0 else 1.0)
        if not matters(total * discount, face.near, needed):
            break
        ux, uy = layers.along[c, 0], layers.along[c, 1]
        inside = may_be_same and are_parallel((ux * wx + uy * wy) / width)
        inside = inside and are_in_wall(
            building.interior, beam.window[0], beam.window[1], _rays(i, face, before_0, before_1, layers)
        )
        before_0, before_1, may_be_same = face.r_0, face.r_1, depth_m > 0.0 and not is_low
        wx, wy, width = ux, uy, 1.0
        if beam.more > 0 and not (inside and j > 0):
            flat = face.near / np.hypot(face.near, 2.0 * building.room.height_m)
            part = materials.most_reflected[material, int(min(face.cos_0, face.cos_1) * flat * COSINES)]
            if matters(part * total * next_discount, face.near, needed):
                windows = _open_window(i, c, part * beam.reflected, behind, building, layers, windows)
        if inside and j == 0 and not is_low:
            break
        through = materials.most_transmitted[material, min(int(face.steepest * COSINES) + 1, COSINES)]
        behind = _cross(behind, face, 1.0 if is_low else through, depth_m)
        if behind.crossed > limits.walls:
            break
        layers.left[i, j], layers.crossed[i, j] = behind.left, behind.crossed
    return windows


@njit(cache=True, borrows=True)
def _face_between(c, i, layers):
    """Return clipped wall c as seen between edges i and i + 1."""
    scratch, ray, ux, uy = layers.clipped, layers.ray, layers.along[c, 0], layers.along[c, 1]
    r_0 = ray[i, 2] / max(nearness(scratch, c, scratch.edge[i]), 1e-9)
    r_1 = ray[i + 1, 2] / max(nearness(scratch, c, scratch.edge[i + 1]), 1e-9)
    x_0, y_0, x_1, y_1 = ray[i, 0], ray[i, 1], ray[i + 1, 0], ray[i + 1, 1]
    cos_0, cos_1 = abs(ux * y_0 - uy * x_0), abs(ux * y_1 - uy * x_1)
    across = (ux * x_0 + uy * y_0) * (ux * x_1 + uy * y_1) <= 0.0
    near, steepest = (r_0 * cos_0, 1.0) if across else (min(r_0, r_1), max(cos_0, cos_1))
    return _Face(r_0, r_1, cos_0, cos_1, max(near, 1e-6), steepest)


@njit(cache=True, borrows=True)
def _rays(i, face, before_0, before_1, layers):
    """Return both rays from the face before to a face, as for `are_in_wall`."""
    ray = layers.ray
    first = ray[i, 0], ray[i, 1], face.cos_0, before_0, face.r_0
    return first, (ray[i + 1, 0], ray[i + 1, 1], face.cos_1, before_1, face.r_1)


@njit(cache=True, borrows=True)
def _cross(behind, face, through, depth_m):
    """Return the state behind a face that transmits the fraction `through`, or less."""
    left, crossed, start_0, start_1, cos_0, cos_1, first = behind
    if first > 0.0:
        low_0, low_1 = min(face.cos_0, cos_0), min(face.cos_1, cos_1)
        if is_as_deep(face.r_0 - start_0, low_0, depth_m) or is_as_deep(face.r_1 - start_1, low_1, depth_m):
            if through > first:
                left, first = left * through / first, through
            return _Behind(left, crossed, start_0, start_1, low_0, low_1, first)
    return _Behind(left * through, crossed + 1, face.r_0, face.r_1, face.cos_0, face.cos_1, through)


@njit(cache=True, borrows=True)
def _open_window(i, c, reflected, behind, building, layers, windows):
    """Add the part of clipped wall c between two edges to its line's last window, or as another one."""
    span, window, lines, walls = layers.span, layers.window, building.plan.line, layers.clipped.wall
    t0, t1 = layers.clipped.edge[i], layers.clipped.edge[i + 1]
    last = layers.open[lines[walls[c]]]
    beside = last >= 0 and span[last, 1] >= t0 - THINNEST and window[last, 1] == behind.crossed
    if beside and building.material[walls[window[last, 0]]] == building.material[walls[c]]:
        span[last, 1] = t1
        span[last, 2], span[last, 3] = max(span[last, 2], reflected), max(span[last, 3], behind.left)
        return windows
    span[windows, 0], span[windows, 1], span[windows, 2], span[windows, 3] = t0, t1, reflected, behind.left
    window[windows, 0], window[windows, 1] = c, behind.crossed
    layers.open[lines[walls[c]]] = windows
    return windows + 1


@njit(cache=True, borrows=True)
def _add_children(beams, k, number, windows, task, layers, children, count):
    """Write beam k, numbered `number`, reflected in each window that a receiver needs; return the new count."""
    scratch, plan, gains = layers.clipped, task.building.plan, task.building.room.gains
    more = np.int64(beams.more[k]) - 1
    for i in range(windows):
        span, c, crossed, window = layers.span[i], layers.window[i, 0], layers.window[i, 1], children.window[count]
        part = span[0], max(nearness(scratch, c, span[0]), 1e-9), span[1], max(nearness(scratch, c, span[1]), 1e-9)
        if not reflect(beams.window[k], part, plan.pieces_m[scratch.wall[c]], window):
            continue
        reflected, left = span[2], span[3]
        if beams.piece[k] < 0:
            reflected *= gain_between(gains.by_azimuth, *azimuths_of(beams, k, window)) / gains.largest
        if not _is_needed(Beam(window, reflected, left, crossed, more), task, scratch.corner):
            continue
        children.parent[count], children.piece[count], children.crossed[count] = number, scratch.wall[c], crossed
        children.reflected[count], children.left[count], children.more[count] = reflected, left, more
        count += 1
    return count


@njit(cache=True, borrows=True)
def _is_needed(beam, task, corner):
    limits, needed = task.building.limits, task.sources.needed
    order = limits.reflections - beam.more
    total = beam.reflected * beam.left * (task.most_transmitted if beam.crossed == 0 else 1.0)
    near = max(window_distance(beam.window), 1e-6)
    if not matters(total * discount_after(limits, order), near, needed):
        return False
    if beam.more > 0 and matters(total * discount_after(limits, order + 1), near, needed):
        return True
    return reaches(beam.window, near, total * discount_after(limits, order), 0.0, needed, corner)


@njit(cache=True)
def _add_pairs(beam, number, count, layers, needed, receivers, pair, left, used):
    """Pair a reflected beam with the receivers that need it, behind a wall or after one."""
    window, (points, order, start, grid) = beam.window, receivers
    ax, ay, bx, by = window[2] - window[0], window[3] - window[1], window[4] - window[0], window[5] - window[1]
    area, first, second, width = ax * by - ay * bx, np.hypot(ax, ay), np.hypot(bx, by), np.hypot(ax - bx, ay - by)
    corner = layers.clipped.corner
    write_cone(window, True, grid, (len(start) - 1) // int(grid[3]), corner)
    from_row, to_row = rows_in(corner, start, grid)
    for row in range(from_row, to_row):
        begin, end = entries_in(corner, start, grid, row)
        for i in range(begin, end):
            ex, ey = points[i, 0] - window[0], points[i, 1] - window[1]
            alpha, beta = (ex * by - ey * bx) / area, (ax * ey - ay * ex) / area
            r = alpha + beta
            if beta * area < -TOLERANCE_M * first or alpha * area < -TOLERANCE_M * second:
                continue
            if r <= 0.0 or (r - 1.0) * area < -TOLERANCE_M * width:  # r may be 0 where the image is close to its wall
                continue
            rx = order[i]
            least = needed[rx] * (ex * ex + ey * ey) / beam.reflected
            if beam.left < least:
                continue
            t, aside = beta / r, TOLERANCE_M / (r * width)
            most = max(_left_at(beam, count, layers, t - aside, r), _left_at(beam, count, layers, t + aside, r))
            if most > 0.0 and most >= least:
                if used == len(pair):
                    pair, left = grow(pair, used + 1), grow(left, used + 1)
                pair[used, 0], pair[used, 1], left[used] = number, rx, most
                used += 1
    return pair, left, used


@njit(cache=True, borrows=True)
def _left_at(beam, count, layers, t, r):
    """Return a bound of a beam's power after walls at a point; 0 if no wall is in front of it."""
    scratch, low, high = layers.clipped, 0, 2 * count + 1
    t = min(max(t, THINNEST), 1.0 - THINNEST)
    while high - low > 1:
        middle = (low + high) // 2
        if scratch.edge[middle] <= t:
            low = middle
        else:
            high = middle
    left, crossed = beam.left, beam.crossed
    for j in range(layers.depth[low]):
        if nearness(scratch, layers.wall[low, j], t) * r <= 1.0:
            break
        left, crossed = layers.left[low, j], layers.crossed[low, j]
    return left if crossed > 0 else 0.0
