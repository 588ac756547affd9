"""Candidates of floor plans that go through walls: beams that reflect and cross, and the power of every path.

Beams split at each wall into one that is reflected and one that goes on behind it, from the same image of the
transmitter. What counts as one wall is decided along the ray: consecutive faces without a free cell between them are
one wall if they are at most `depth_m` apart, measured across them. Only the first face of a wall costs anything.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import Plan, PointBins, bin_points, grow
from sionna_partial.tracing.plan.beams import _add_points, _reflect, _root_beams, _Scratch, _visible_pieces
from sionna_partial.tracing.plan.specular import CEILING, FLOOR, Room, can_bounce, merge_heights, unfolded_height
from sionna_partial.tracing.slab import reflection_coefficients, transmission_coefficients

_COSINES = 2048

_VARIANTS = 5
"""Reflections at floor and ceiling that a path through walls may have: none, floor, ceiling, both in either order."""

_FACES = 24
"""Most faces that a path may cross, the two of each wall counted."""

_SHORTEST_LEG_M = 0.0101
"""Sionna RT drops paths with legs of 1 cm or less."""


class Slab(NamedTuple):
    """Coefficients (K + 1, 2) of walls, TE and TM, where the cosine of the angle of incidence is k / K.

    `most_reflected` (K + 1,) is the largest |R|^2 at this cosine or a larger one, `most_transmitted` (K + 1,) the
    largest |T|^2 at this cosine or a smaller one.
    """

    reflection: NDArray[np.complex128]
    transmission: NDArray[np.complex128]
    most_reflected: Floats
    most_transmitted: Floats


class Interior(NamedTuple):
    """What lies between walls: cells (ny, nx) of the plan that are free, those with a floor, and their edge [m].

    `depth_m` is how deep one wall may be.
    """

    free: Bools
    floor: Bools
    cell_m: float
    depth_m: float


class Limits(NamedTuple):
    """Most reflections, of them at walls, and most walls crossed of a path; how weak a beam may be beside its link."""

    depth: int
    reflections: int
    walls: int
    weakest: float


class Prune(NamedTuple):
    """What a beam must reach to matter, from cells of receivers sorted by their distance from the transmitter.

    `loss` (B,) is the smallest relative power, of cells at least that far, and `power` (B,) the smallest power of
    cells at most that far.
    """

    distance_m: Floats
    loss: Floats
    power: Floats


class Tree(NamedTuple):
    """Beams: node (M, 3) with parent, piece of wall and whether it is crossed; image sources (M, 2); pairs (K, 2).

    `loss` (M,) bounds what a path keeps of its power at the walls of a beam.
    """

    node: NDArray[np.int32]
    source: Floats
    loss: Floats
    pair: NDArray[np.int64]


def slab_of(material: Floats, frequency_hz: float) -> Slab:
    """Tabulate the coefficients of a material, its permittivity, conductivity and thickness (3,)."""
    cosine = np.linspace(0.0, 1.0, _COSINES + 1)
    reflection = np.stack(reflection_coefficients(*material, frequency_hz, cosine), axis=1)
    transmission = np.stack(transmission_coefficients(*material, frequency_hz, cosine), axis=1)
    reflection[0], transmission[0] = -1.0, 0.0
    most_r, most_t = (np.max(np.abs(each) ** 2, axis=1) for each in (reflection, transmission))
    return Slab(
        reflection, transmission, np.maximum.accumulate(most_r[::-1])[::-1].copy(), np.maximum.accumulate(most_t)
    )


def prune_of(tx_m: Floats, rx_m: Floats, power: Floats, weakest: float, wavelength_m: float) -> Prune:
    """Prepare what beams are compared with: the links' power (N,), of which `weakest` matters."""
    distance = np.linalg.norm(rx_m[:, :2] - tx_m[:2], axis=1)
    order = np.argsort(distance, kind="stable")
    distance, needed = distance[order], weakest * power[order]
    free = (wavelength_m / (4.0 * math.pi * np.maximum(distance, 1e-3))) ** 2
    return Prune(
        distance,
        np.minimum.accumulate((needed / free)[::-1])[::-1].copy(),
        np.minimum.accumulate(needed) * (4.0 * math.pi / wavelength_m) ** 2,
    )


def trace_tree(plan: Plan, receivers: PointBins, tx_m: Floats, slab: Slab, interior: Interior, limits: Limits,
               prune: Prune, height_m: float) -> Tree:
    """Find the sequences of walls, reflected at or crossed, that a path can have to some receivers, each pair once."""
    node, sequence, source, loss, pair = _trace(
        plan, _root_beams(tx_m[None, :2]), receivers, slab, interior.depth_m, limits, prune, height_m
    )
    pair = pair.astype(np.int64)
    pair[:, 1] = receivers.order[pair[:, 1]]
    key = np.lexsort((pair[:, 1], sequence[pair[:, 0]]))
    pair, same = pair[key], sequence[pair[key, 0]]
    new = np.ones(len(pair), bool)
    new[1:] = (same[1:] != same[:-1]) | (pair[1:, 1] != pair[:-1, 1])
    return Tree(node, source, loss, pair[new])


@njit(cache=True, nogil=True)
def _trace(plan, beam, receivers, slab, depth_m, limits, prune, height_m):  # type: ignore[no-untyped-def]
    """Breadth-first tree of beams: nodes, numbers of their sequences of reflections, image sources and pairs."""
    walls, count = plan.pieces_m, len(beam)
    node = np.empty((count, 3), np.int32)
    state = np.zeros((count, 4), np.int32)  # reflections, walls crossed, first node of the wall, whether any is crossed
    value = np.ones((count, 2))  # bound of the loss, smallest cosine at the first node of the wall
    sequence = np.zeros(count, np.int64)
    for root in range(count):
        node[root, 0], node[root, 1], node[root, 2], state[root, 2] = -1, -1, 0, -1
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
    k = pairs = np.int64(0)
    while k < count:
        own = node[k, 1]
        for i in range(_visible_pieces(plan, beam[k], own, scratch)):
            piece, wall = scratch.piece[i], scratch.piece_wall[i]
            if state[k, 0] > 0 and state[k, 3] > 0:
                pair, pairs = _add_points(beam[k], own >= 0, piece, receivers, k, pair, pairs)
            if wall < 0:
                continue
            beam, node, state = grow(beam, count + 2), grow(node, count + 2), grow(state, count + 2)
            value, sequence = grow(value, count + 2), grow(sequence, count + 2)
            ends = beam[count]
            for e in range(2):
                t, w = piece[2 * e], piece[2 * e + 1]
                for axis in range(2):
                    s = beam[k, axis]
                    ends[2 + 2 * e + axis] = s + ((1.0 - t) * (beam[k, 2 + axis] - s) + t * (beam[k, 4 + axis] - s)) / w
            ends[0], ends[1] = beam[k, 0], beam[k, 1]
            near, least, most = _incidence(ends, walls[wall])
            if near < 1e-6 or np.hypot(ends[2] - ends[4], ends[3] - ends[5]) < 1e-9:
                continue
            area = (ends[2] - ends[0]) * (ends[5] - ends[1]) - (ends[3] - ends[1]) * (ends[4] - ends[0])
            # through the wall
            if abs(area) > 1e-15:
                first, crossed, loss, cosine = state[k, 2], state[k, 1], value[k, 0], least
                same = first >= 0 and depth_m > 0.0
                if same:
                    same = _apart(beam[first, 2:], ends[2:]) * min(value[k, 1], least) <= depth_m
                if not same:
                    first, crossed = count, crossed + 1
                    loss *= slab.most_transmitted[min(int(most * _COSINES) + 1, _COSINES)]
                else:
                    cosine = min(value[k, 1], least)
                if crossed <= limits.walls and _matters(loss, near, prune):
                    node[count, 0], node[count, 1], node[count, 2] = k, wall, 1
                    state[count, 0], state[count, 1], state[count, 2], state[count, 3] = state[k, 0], crossed, first, 1
                    value[count, 0], value[count, 1], sequence[count] = loss, cosine, sequence[k]
                    count += 1
            # reflected
            if state[k, 0] < limits.reflections:
                flat = near / np.hypot(near, height_m)
                loss = value[k, 0] * slab.most_reflected[int(least * flat * _COSINES)]
                if _matters(loss, near, prune) and _reflect(beam[k], piece, walls[wall], beam[count]):
                    node[count, 0], node[count, 1], node[count, 2] = k, wall, 0
                    state[count, 0], state[count, 1] = state[k, 0] + 1, state[k, 1]
                    state[count, 2], state[count, 3] = -1, state[k, 3]
                    value[count, 0], value[count, 1] = loss, 1.0
                    sequence[count] = _mixed(sequence[k], plan.line[wall])
                    count += 1
        k += 1
    return node[:count], sequence[:count], beam[:count, :2].copy(), value[:count, 0].copy(), pair[:pairs]


@njit(cache=True)
def _mixed(sequence, line):  # type: ignore[no-untyped-def]
    """Number of a sequence of lines with one more (splitmix64)."""
    z = np.uint64(sequence) + np.uint64(line + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.int64(z ^ (z >> np.uint64(31)))


@njit(cache=True)
def _incidence(ends, wall):  # type: ignore[no-untyped-def]
    """Distance of a window from the source of its beam, and the smallest and largest cosine of incidence there."""
    wx, wy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
    size = np.hypot(wx, wy)
    away = abs(wx * (ends[1] - wall[0, 1]) - wy * (ends[0] - wall[0, 0])) / size
    first, last = np.hypot(ends[2] - ends[0], ends[3] - ends[1]), np.hypot(ends[4] - ends[0], ends[5] - ends[1])
    before = wx * (ends[2] - ends[0]) + wy * (ends[3] - ends[1])
    after = wx * (ends[4] - ends[0]) + wy * (ends[5] - ends[1])
    near = away if before * after <= 0.0 else min(first, last)
    return near, min(away / max(first, last, 1e-9), 1.0), min(away / max(near, 1e-9), 1.0)


@njit(cache=True)
def _apart(first, second):  # type: ignore[no-untyped-def]
    """Distance between two windows (x, y, x, y) that do not cross."""
    best = np.inf
    for a, b in ((first, second), (second, first)):
        dx, dy = b[2] - b[0], b[3] - b[1]
        square = dx * dx + dy * dy
        for e in range(2):
            px, py = a[2 * e] - b[0], a[2 * e + 1] - b[1]
            u = min(max((px * dx + py * dy) / square, 0.0), 1.0) if square > 0.0 else 0.0
            best = min(best, np.hypot(px - u * dx, py - u * dy))
    return best


@njit(cache=True)
def _matters(loss, near, prune):  # type: ignore[no-untyped-def]
    """Whether a beam with this loss, which has come this far at least, may matter to any receiver."""
    at = np.searchsorted(prune.distance_m, near)
    if at < len(prune.distance_m) and loss >= prune.loss[at]:
        return True
    return at > 0 and loss >= prune.power[at - 1] * near * near


class Trail(NamedTuple):
    """Scratch of one path in the plan: its reflections, and all it meets, in order from the transmitter.

    `surface` are pieces of walls, `kind` 0 where it is reflected, 1 where it crosses into a wall, 2 where it crosses
    another face of the same wall; `points` (x, y, fraction of the length).
    """

    walls: NDArray[np.int64]
    bounce: Floats
    surface: NDArray[np.int64]
    kind: NDArray[np.int64]
    points: Floats
    found: Floats
    wall: NDArray[np.int64]
    visit: NDArray[np.int64]


def trail_of(plan: Plan) -> Trail:
    """Make scratch for paths in a plan."""
    room = _FACES + 16
    return Trail(
        np.empty(16, np.int64),
        np.empty((16, 3)),
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.empty((room, 3)),
        np.empty(room),
        np.empty(room, np.int64),
        np.full(len(plan.pieces_m) + 1, -1, np.int64),
    )


@njit(cache=True)
def _follow(tree, node, plan, interior, tx_m, target, limits, trail):  # type: ignore[no-untyped-def]
    """Write what a path meets in the plan; its number of entries (-1 if there is no path), walls crossed and length."""
    k, above = 0, node
    while above >= 0 and tree.node[above, 0] >= 0:
        k += 1 - tree.node[above, 2]
        above = tree.node[above, 0]
    x, y = target[0], target[1]
    total = np.hypot(x - tree.source[node, 0], y - tree.source[node, 1]) if node >= 0 else np.hypot(
        x - tx_m[0], y - tx_m[1])
    level = k - 1
    while level >= 0:
        while tree.node[node, 2] == 1:
            node = tree.node[node, 0]
        sx, sy = tree.source[node, 0], tree.source[node, 1]
        wall = plan.pieces_m[tree.node[node, 1]]
        dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
        from_source = dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])
        from_point = dx * (y - wall[0, 1]) - dy * (x - wall[0, 0])
        if abs(from_source - from_point) < 1e-15 or total == 0.0:
            return -1, 0, total
        fraction = from_source / (from_source - from_point)
        x, y = sx + fraction * (x - sx), sy + fraction * (y - sy)
        trail.walls[level] = tree.node[node, 1]
        trail.bounce[level, 0], trail.bounce[level, 1] = x, y
        trail.bounce[level, 2] = np.hypot(x - sx, y - sy) / total
        node = tree.node[node, 0]
        level -= 1
    count = crossed = 0
    ax, ay, done, own = tx_m[0], tx_m[1], 0.0, -1
    for level in range(k + 1):
        if level < k:
            bx, by, stop, other = trail.bounce[level, 0], trail.bounce[level, 1], trail.bounce[level, 2], trail.walls[level]
        else:
            bx, by, stop, other = target[0], target[1], 1.0, -1
        count, more = _cross_leg(plan, interior, ax, ay, bx, by, own, other, done, stop, count, trail)
        crossed += more
        if count < 0 or crossed > limits.walls:
            return -1, crossed, total
        if level < k:
            if count >= len(trail.surface) - 1:
                return -1, crossed, total
            trail.surface[count], trail.kind[count] = other, 0
            trail.points[count, 0], trail.points[count, 1], trail.points[count, 2] = bx, by, stop
            count += 1
        ax, ay, done, own = bx, by, stop, other
    return count, crossed, total


@njit(cache=True)
def _cross_leg(plan, interior, ax, ay, bx, by, own, other, done, stop, count, trail):  # type: ignore[no-untyped-def]
    """Add the faces that a leg crosses; the number of entries (-1 if there are too many), and the walls among them."""
    found, wall, n = trail.found, trail.wall, 0
    x0, y0, edge, columns, rows = plan.cells.grid
    columns, rows = int(columns), int(rows)
    dx, dy = bx - ax, by - ay
    length = np.hypot(dx, dy)
    if length < 1e-9:
        return count, 0
    trail.visit[-1] += 1
    stamp = trail.visit[-1]
    low, high = min(ay, by) - 1e-6, max(ay, by) + 1e-6
    for row in range(max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)):
        left, right = min(ax, bx), max(ax, bx)
        if abs(dy) > 1e-12:
            first = ax + dx * ((y0 + row * edge - 1e-6) - ay) / dy
            last = ax + dx * ((y0 + (row + 1) * edge + 1e-6) - ay) / dy
            left, right = max(left, min(first, last)), min(right, max(first, last))
        begin = max(0, int(np.floor((left - 1e-6 - x0) / edge)))
        end = min(columns - 1, int(np.floor((right + 1e-6 - x0) / edge)))
        if begin > end:
            continue
        for entry in range(plan.cells.start[row * columns + begin], plan.cells.start[row * columns + end + 1]):
            i = plan.cells.piece[entry]
            if trail.visit[i] == stamp:
                continue
            trail.visit[i] = stamp
            if (own >= 0 and plan.line[i] == plan.line[own]) or (other >= 0 and plan.line[i] == plan.line[other]):
                continue
            px, py, qx, qy = plan.pieces_m[i, 0, 0], plan.pieces_m[i, 0, 1], plan.pieces_m[i, 1, 0], plan.pieces_m[i, 1, 1]
            side_p, side_q = dx * (py - ay) - dy * (px - ax), dx * (qy - ay) - dy * (qx - ax)
            if (side_p >= 0.0) == (side_q >= 0.0):
                continue
            u = side_p / (side_p - side_q)
            t = ((px + u * (qx - px) - ax) * dx + (py + u * (qy - py) - ay) * dy) / (length * length)
            if t <= 0.0 or t >= 1.0:
                continue
            if n >= _FACES:
                return -1, 0
            at = n
            while at > 0 and found[at - 1] > t:
                found[at], wall[at] = found[at - 1], wall[at - 1]
                at -= 1
            found[at], wall[at] = t, i
            n += 1
    if count + n >= len(trail.surface) - 1:
        return -1, 0
    return count + n, _group(plan, interior, ax, ay, dx, dy, length, n, done, stop, count, trail)


@njit(cache=True)
def _group(plan, interior, ax, ay, dx, dy, length, n, done, stop, count, trail):  # type: ignore[no-untyped-def]
    """Write the faces that a leg crosses as entries, and which of them are one wall; return the number of walls.

    Walls are counted from the end whose coordinates are smaller, so that a link is the same in both directions.
    """
    backwards = dx < 0.0 or (dx == 0.0 and dy < 0.0)
    walls, start, steep = 0, 0.0, 1.0
    previous = -1.0
    for j in range(n):
        at = n - 1 - j if backwards else j
        t, i = trail.found[at], trail.wall[at]
        x, y = ax + t * dx, ay + t * dy
        wx, wy = plan.pieces_m[i, 1, 0] - plan.pieces_m[i, 0, 0], plan.pieces_m[i, 1, 1] - plan.pieces_m[i, 0, 1]
        cosine = abs(wx * dy - wy * dx) / (length * np.hypot(wx, wy))
        same = j > 0 and abs(t - start) * length * min(cosine, steep) <= interior.depth_m
        if same:
            same = not _is_free_between(interior, ax, ay, dx, dy, length, min(t, previous), max(t, previous))
        if same:
            steep = min(steep, cosine)
        else:
            walls, start, steep = walls + 1, t, cosine
        entry = count + at
        trail.surface[entry], trail.kind[entry] = i, 2 if same else 1
        trail.points[entry, 0], trail.points[entry, 1], trail.points[entry, 2] = x, y, done + t * (stop - done)
        previous = t
    return walls


@njit(cache=True)
def _is_free_between(interior, ax, ay, dx, dy, length, first, last):  # type: ignore[no-untyped-def]
    """Whether a leg meets a free cell between two faces; cells that the faces themselves cut do not count."""
    low, high = first * length + interior.cell_m, last * length - interior.cell_m
    s = low
    while s <= high:
        column, row = int((ax + s / length * dx) / interior.cell_m), int((ay + s / length * dy) / interior.cell_m)
        if 0 <= row < interior.free.shape[0] and 0 <= column < interior.free.shape[1] and interior.free[row, column]:
            return True
        s += 0.5 * interior.cell_m
    return False


@njit(cache=True)
def _can_bounce(variant, room):  # type: ignore[no-untyped-def]
    """Bounces at floor and ceiling of a variant, which comes first, and whether the room allows them."""
    bounces = 0 if variant == 0 else (1 if variant < 3 else 2)
    first = CEILING if variant == 2 or variant == 4 else FLOOR
    return bounces, first, can_bounce(bounces, first, room)


@njit(cache=True)
def _path_power(trail, count, length, room, target, bounces, first, plan, interior, slab, wavelength):  # type: ignore[no-untyped-def]
    """Power between vertical antennas of a path that the plan has, with reflections at floor and ceiling."""
    rise = target[2] - room.tx_m[2]
    if bounces:
        up = unfolded_height(room, target, bounces, first)
        to_first = room.tx_m[2] if first == FLOOR else room.height_m - room.tx_m[2]
        sign = -1.0 if first == FLOOR else 1.0
    else:
        up, to_first, sign = abs(rise), 0.0, (1.0 if rise >= 0.0 else -1.0)
    total = np.hypot(length, up)
    flat, slope = length / total, up / total
    # direction and field along theta of the spherical coordinates at the transmitter
    ax, ay, done = room.tx_m[0], room.tx_m[1], 0.0
    item = turn = 0
    bx = trail.points[0, 0] if count > 0 else target[0]
    by = trail.points[0, 1] if count > 0 else target[1]
    size = max(np.hypot(bx - ax, by - ay), 1e-12)
    kx, ky, kz = flat * (bx - ax) / size, flat * (by - ay) / size, sign * slope
    norm = max(np.hypot(kx, ky), 1e-12)
    ex, ey, ez = complex(kx * kz / norm), complex(ky * kz / norm), complex(-norm)
    while item < count or turn < bounces:
        fraction = (to_first + turn * room.height_m) / up if turn < bounces else 2.0
        if item < count and trail.points[item, 2] <= fraction:
            i = trail.surface[item]
            kind = trail.kind[item]
            wx, wy = plan.pieces_m[i, 1, 0] - plan.pieces_m[i, 0, 0], plan.pieces_m[i, 1, 1] - plan.pieces_m[i, 0, 1]
            norm = np.hypot(wx, wy)
            nx, ny, nz = wy / norm, -wx / norm, 0.0
            ax, ay, done = trail.points[item, 0], trail.points[item, 1], trail.points[item, 2]
            item += 1
            if kind == 2:
                continue
        else:
            stop = trail.points[item, 2] if item < count else 1.0
            bx = trail.points[item, 0] if item < count else target[0]
            by = trail.points[item, 1] if item < count else target[1]
            part = (fraction - done) / (stop - done) if stop > done else 0.0
            column, row = int((ax + part * (bx - ax)) / interior.cell_m), int((ay + part * (by - ay)) / interior.cell_m)
            inside = 0 <= row < interior.floor.shape[0] and 0 <= column < interior.floor.shape[1]
            if not (inside and interior.floor[row, column]):
                return 0.0
            nx, ny, nz, kind = 0.0, 0.0, 1.0, 0
            turn += 1
        along = kx * nx + ky * ny + kz * nz
        at = abs(along) * _COSINES
        low = min(int(at), _COSINES - 1)
        part = at - low
        sx, sy, sz = ky * nz - kz * ny, kz * nx - kx * nz, kx * ny - ky * nx
        norm = np.sqrt(sx * sx + sy * sy + sz * sz)
        if norm < 1e-9:
            sx, sy, sz, norm = -ny if nz == 0.0 else 1.0, nx, 0.0, 1.0
        sx, sy, sz = sx / norm, sy / norm, sz / norm
        te = ex * sx + ey * sy + ez * sz
        px, py, pz = sy * kz - sz * ky, sz * kx - sx * kz, sx * ky - sy * kx
        tm = ex * px + ey * py + ez * pz
        table = slab.transmission if kind == 1 else slab.reflection
        te *= table[low, 0] + part * (table[low + 1, 0] - table[low, 0])
        tm *= table[low, 1] + part * (table[low + 1, 1] - table[low, 1])
        if kind == 0:
            kx, ky, kz = kx - 2.0 * along * nx, ky - 2.0 * along * ny, kz - 2.0 * along * nz
            px, py, pz = sy * kz - sz * ky, sz * kx - sx * kz, sx * ky - sy * kx
        ex, ey, ez = te * sx + tm * px, te * sy + tm * py, te * sz + tm * pz
    norm = max(np.hypot(kx, ky), 1e-12)
    field = ex * (kx * kz / norm) + ey * (ky * kz / norm) - ez * norm
    return (wavelength / (4.0 * np.pi * total)) ** 2 * (field.real**2 + field.imag**2)


@njit(cache=True, nogil=True)
def pair_powers(tree, needed, start, stop, plan, interior, room, slab, limits, wavelength, trail):  # type: ignore[no-untyped-def]
    """Power (K, V) of each variant of pairs start to stop; 0 where there is none that crosses a wall."""
    power = np.zeros((stop - start, _VARIANTS))
    for i in range(start, stop):
        node, rx = tree.pair[i, 0], tree.pair[i, 1]
        target = room.rx_m[rx]
        if node >= 0:
            far = np.hypot(target[0] - tree.source[node, 0], target[1] - tree.source[node, 1])
            if tree.loss[node] * (wavelength / (4.0 * np.pi * max(far, 1e-3))) ** 2 < needed[rx]:
                continue
        count, crossed, length = _follow(tree, node, plan, interior, room.tx_m, target, limits, trail)
        if count < 0 or crossed == 0 or not _has_long_legs(trail, count, length):
            continue
        reflections = count - np.sum(trail.kind[:count] > 0)
        for variant in range(_VARIANTS):
            bounces, first, good = _can_bounce(variant, room)
            if good and reflections + bounces <= limits.depth:
                power[i - start, variant] = _path_power(
                    trail, count, length, room, target, bounces, first, plan, interior, slab, wavelength
                )
    return power


@njit(cache=True)
def _has_long_legs(trail, count, length):  # type: ignore[no-untyped-def]
    previous = 0.0
    for k in range(count):
        if (trail.points[k, 2] - previous) * length < _SHORTEST_LEG_M:
            return False
        previous = trail.points[k, 2]
    return (1.0 - previous) * length >= _SHORTEST_LEG_M


@njit(cache=True, nogil=True)
def write_paths(tree, chosen, variants, columns, plan, interior, room, limits, trail):  # type: ignore[no-untyped-def]
    """Write chosen pairs: surfaces (C, D) and kinds of `Trail`, floor and ceiling as kind 3, -1 none; vertices (C, D, 3)."""
    surface, kind = np.full((len(chosen), columns), -1, np.int32), np.full((len(chosen), columns), -1, np.int32)
    vertices = np.zeros((len(chosen), columns, 3))
    item = np.empty(len(trail.surface), np.int64)
    for c in range(len(chosen)):
        node, rx = tree.pair[chosen[c], 0], tree.pair[chosen[c], 1]
        target = room.rx_m[rx]
        count, _, _ = _follow(tree, node, plan, interior, room.tx_m, target, limits, trail)
        bounces, first, _ = _can_bounce(variants[c], room)
        if count + bounces > columns:
            continue
        for k in range(count):
            item[k] = k
        merge_heights(item[:count], trail.points[:count], room, target, bounces, first, surface[c], vertices[c])
        for d in range(count + bounces):
            if surface[c, d] >= 0:
                kind[c, d] = trail.kind[surface[c, d]]
                surface[c, d] = plan.owner[trail.surface[surface[c, d]]]
            else:
                kind[c, d] = 3
    return surface, kind, vertices
