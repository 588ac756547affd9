"""Candidates of floor plans that go through walls: beams that reflect and cross, and the power of every path.

Beams split at each wall into one that is reflected and one that goes on behind it, from the same image of the
transmitter. What counts as one wall is decided along the ray: consecutive faces without a free cell between them are
one wall if they are at most `depth_m` apart, measured across them. Only one face of a wall costs anything.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S
from sionna_partial.planar import span_in_strip
from sionna_partial.process import in_order, njit
from sionna_partial.scene.floor_plan import Plan, bin_points, grow
from sionna_partial.scene.scene import SceneGeometry, constants_of
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.bounds import dropped_power
from sionna_partial.tracing.candidates import Candidates
from sionna_partial.tracing.interactions import DIFFRACTION, REFLECTION, REFRACTION
from sionna_partial.tracing.plan.beams import TOLERANCE_M, _add_points, _reflect, _root_beams, _Scratch, _visible_pieces
from sionna_partial.tracing.plan.specular import (
    CEILING,
    EDGE,
    FLOOR,
    WALLS,
    Room,
    can_bounce,
    faces_of,
    height_at,
    merge_heights,
    unfolded_height,
)
from sionna_partial.tracing.slab import reflection_coefficients, transmission_coefficients

_COSINES = 2048

_VARIANTS = 5
"""Reflections at floor and ceiling that a path through walls may have: none, floor, ceiling, both in either order."""

_USUAL_REFLECTIONS, _MOST_REFLECTIONS = 3, 4
"""Reflections at walls beyond which beams must be stronger, and the most of them, unless all paths are asked for."""

_WEAKEST, _WEAKEST_OF_ALL = 1e-3, 1e-6
"""Beams that bring less than this fraction of a link's power are left out; the second where every path is asked for."""

_RARER = 0.01
"""Fraction of its power that counts of a beam with more than the usual reflections."""

_CELL_M = 1.0
"""Edge of the cells of receivers that beams are compared with [m]."""

_AT_ONCE = 100_000
"""Number of candidates that are written together, which bounds the memory."""

_PAIRS_AT_ONCE = 5_000
"""Number of pairs whose power is computed by one thread at a time."""

_FACES = 40
"""Most faces of walls that a leg may cross."""

_SHORTEST_LEG_M = 0.0101
"""Sionna RT drops paths with legs of 1 cm or less."""


class Slabs(NamedTuple):
    """Coefficients (M, K + 1, 2) of M materials, TE and TM, where the cosine of the angle of incidence is k / K.

    `most_reflected` (M, K + 1) is the largest |R|^2 at this cosine or a larger one, `most_transmitted` (M, K + 1) the
    largest |T|^2 at this cosine or a smaller one. `material` (P,) is that of the pieces of walls of the plan; floor and
    ceiling are of the first.
    """

    reflection: NDArray[np.complex128]
    transmission: NDArray[np.complex128]
    most_reflected: Floats
    most_transmitted: Floats
    material: NDArray[np.int64]


class Interior(NamedTuple):
    """What lies between walls: cells (ny, nx) of the plan that are free, those with a floor, and their edge [m].

    `depth_m` is how deep one wall may be.
    """

    free: Bools
    floor: Bools
    cell_m: float
    depth_m: float


class Limits(NamedTuple):
    """Most reflections of a path, most of them at walls, and most walls that it goes through.

    `rarer` is what counts of the power of beams for each reflection beyond `_USUAL_REFLECTIONS`.
    """

    depth: int
    reflections: int
    walls: int
    rarer: float


class Needed(NamedTuple):
    """What a beam must bring to matter, from receivers (N,) sorted by their distance from the transmitter in the plan.

    `relative` is the smallest power that matters, relative to free space, to any receiver at least that far away;
    `power` the smallest that matters to any receiver at most that far away, times (4 pi / wavelength)^2, and `cells`
    (ny, nx) the same of the receivers in square cells, whose corner x0 and y0 and edge [m] are `grid` (3,).
    """

    distance_m: Floats
    relative: Floats
    power: Floats
    cells: Floats
    grid: Floats


class Tree(NamedTuple):
    """Beams that reflect at walls and go through them, and the receivers in each.

    `node` (M, 3) has the parent of each beam, its piece of wall and whether it went through; the roots have -1, -1, 0.
    `source` (M, 2) is the image of the transmitter [m], `loss` (M,) bounds what the walls leave of the power. `pair`
    (K, 2) are beams and receivers, each sequence of reflections once for a receiver.
    """

    node: NDArray[np.int32]
    source: Floats
    loss: Floats
    pair: NDArray[np.int64]


class CrossingCandidates:
    """Paths between the transmitter and the receivers of a room that go through walls, without diffraction.

    They have at most three reflections at walls, and two at floor and ceiling. Beams that bring less than a thousandth
    of the power of every link are left out.
    """

    def __init__(self, geometry: SceneGeometry, room: Room, interior: Interior, settings: TraceSettings) -> None:
        self._geometry, self._room, self._interior = geometry, room, interior
        self._tolerance_db = settings.power_tolerance_db
        exact = self._tolerance_db == 0.0
        most, rarer = (settings.max_depth, 1.0) if exact else (_MOST_REFLECTIONS, _RARER)
        walls = most_walls(geometry, settings)
        self._limits = Limits(settings.max_depth, min(settings.max_depth, most), walls, rarer)
        self._wavelength_m = SPEED_OF_LIGHT_M_S / settings.frequency_hz
        of_piece = geometry.wall_material[geometry.plan.owner].astype(np.int64)
        constants = [(*constants_of(each, settings.frequency_hz), each.thickness_m) for each in geometry.materials]
        self.slabs = slabs_of(constants, of_piece, settings.frequency_hz)

    def blocks(self, found: Floats) -> Iterator[tuple[Candidates, float]]:
        """Yield the candidates that links need whose indirect paths without walls have the power `found` (N,)."""
        straight = self._straight()
        power = self._powers(straight, np.zeros(len(found)))
        total = found + np.bincount(straight.pair[:, 1], power.sum(axis=1), len(found))
        needed = weakest_needed(total, self._tolerance_db)
        trees = [(straight, power)]
        if self._limits.depth:
            tree = self._tree(needed)
            trees.append((tree, self._powers(tree, needed)))
        rx = np.concatenate([np.repeat(tree.pair[:, 1], _VARIANTS) for tree, _ in trees])
        least = least_power(rx, np.concatenate([power.ravel() for _, power in trees]), found, self._tolerance_db)
        for number, (tree, power) in enumerate(trees):
            chosen, variant = np.nonzero((power > 0.0) & (power >= least[tree.pair[:, 1], None]))
            for start in range(0, len(chosen), _AT_ONCE):
                rows = slice(start, start + _AT_ONCE)
                yield self._written(tree, chosen[rows], variant[rows]), (number + 1) / len(trees)

    def _straight(self) -> Tree:
        """Return the straight lines to all receivers, as pairs without a beam."""
        count = len(self._room.rx_m)
        pair = np.stack([np.full(count, -1), np.arange(count)], axis=1)
        return Tree(np.zeros((0, 3), np.int32), np.zeros((0, 2)), np.zeros(0), pair)

    def _tree(self, needed: Floats) -> Tree:
        """Trace the beams."""
        room, receivers = self._room, bin_points(self._room.rx_m[:, :2])
        least = _needed_by_distance(room, needed, self._wavelength_m)

        def of_root(root: Floats) -> tuple[Any, ...]:
            fixed = self.slabs, self._interior.depth_m, self._limits, least, 2.0 * room.height_m
            return _trace(self._geometry.plan, root[None].copy(), receivers, *fixed)  # type: ignore[no-any-return]

        parts = list(in_order(of_root, _root_beams(room.tx_m[None, :2])))
        before = np.cumsum([0, *(len(part[0]) for part in parts)])[:-1]
        for (nodes, *_, pairs), first in zip(parts, before, strict=True):
            nodes[:, 0] = np.where(nodes[:, 0] < 0, -1, nodes[:, 0] + first)
            pairs[:, 0] += first
        node, sequence, source, loss, pair = (np.concatenate(column) for column in zip(*parts, strict=True))
        pair = np.stack([pair[:, 0], receivers.order[pair[:, 1]]], axis=1).astype(np.int64)
        order = np.lexsort((pair[:, 1], sequence[pair[:, 0]]))
        pair, same = pair[order], sequence[pair[order, 0]]
        new = np.ones(len(pair), dtype=bool)
        new[1:] = (same[1:] != same[:-1]) | (pair[1:, 1] != pair[:-1, 1])
        return Tree(node, source, loss, pair[new])

    def _powers(self, tree: Tree, needed: Floats) -> Floats:
        """Power (K, V) of the paths of all pairs, and of their variants by floor and ceiling; 0 where there is none."""

        def of_pairs(start: int) -> Floats:
            some = tree._replace(pair=tree.pair[start : start + _PAIRS_AT_ONCE])
            fixed = self._geometry.plan, self._interior, self._room, self.slabs, self._limits, self._wavelength_m
            return pair_powers(some, needed, *fixed, trail_of(self._geometry.plan))  # type: ignore[no-any-return]

        starts = range(0, len(tree.pair), _PAIRS_AT_ONCE)
        return np.concatenate([np.zeros((0, _VARIANTS)), *in_order(of_pairs, starts)])

    def _written(self, tree: Tree, chosen: Indices, variant: Indices) -> Candidates:
        """Write the paths of some pairs."""
        geometry = self._geometry
        written = write_paths(
            tree, chosen, variant, geometry.plan, self._interior, self._room, self._limits, trail_of(geometry.plan)
        )
        return Candidates(tree.pair[chosen, 1].astype(np.int32), **columns_of(geometry, *written))


def most_walls(geometry: SceneGeometry, settings: TraceSettings) -> int:
    """Return the most walls on a line in the plan, where obstacles may lie below it and are counted later."""
    return settings.max_walls if not geometry.plan.low.any() else _FACES


def weakest_needed(power: Floats, tolerance_db: float) -> Floats:
    """Return below which power (N,) paths of links whose paths have some power do not matter."""
    weakest = _WEAKEST_OF_ALL if tolerance_db == 0.0 else _WEAKEST
    return weakest * np.maximum(power, 10.0 ** (GAIN_FLOOR_DB / 10.0))


def least_power(rx: Indices, power: Floats, found: Floats, tolerance_db: float) -> Floats:
    """Return the power (N,) below which links can do without paths, if the others have the power `found` (N,)."""
    rx, power = rx[power > 0.0], power[power > 0.0]
    order = np.lexsort((power, rx))
    rx, power = rx[order], power[order]
    allowed = dropped_power(found + np.bincount(rx, power, len(found)), tolerance_db)
    sums = np.cumsum(power)
    before = np.concatenate([[0.0], sums])[np.searchsorted(rx, np.arange(len(found)))]
    kept = sums - before[rx] > allowed[rx]
    least = np.full(len(found), np.inf)
    np.minimum.at(least, rx[kept], power[kept])
    return least


def columns_of(
    geometry: SceneGeometry, surface: NDArray[np.int32], kind: NDArray[np.uint8], vertices_m: Floats, same_wall: Bools
) -> dict[str, Any]:
    """Return columns of `Candidates` (C, D), of which the first have all that is used."""
    used = max(1, int((kind > 0).sum(axis=1).max(initial=0)))
    columns = (
        ("kind", kind),
        ("face", faces_of(surface, geometry)),
        ("vertices_m", vertices_m),
        ("same_wall", same_wall),
    )
    return {name: column[:, :used] for name, column in columns}


def slabs_of(constants: Iterable[Iterable[float]], material: NDArray[np.int64], frequency_hz: float) -> Slabs:
    """Tabulate the coefficients of materials, each permittivity, conductivity and thickness (3,)."""
    cosine = np.linspace(0.0, 1.0, _COSINES + 1)
    given = [(*each, frequency_hz, cosine) for each in constants]
    reflection, transmission = (
        np.stack([np.stack(coefficients(*each), axis=1) for each in given])
        for coefficients in (reflection_coefficients, transmission_coefficients)
    )
    reflection[:, 0], transmission[:, 0] = -1.0, 0.0
    reflected, transmitted = (np.max(np.abs(each) ** 2, axis=2) for each in (reflection, transmission))
    most_reflected = np.maximum.accumulate(reflected[:, ::-1], axis=1)[:, ::-1].copy()
    return Slabs(reflection, transmission, most_reflected, np.maximum.accumulate(transmitted, axis=1), material)


def _needed_by_distance(room: Room, needed: Floats, wavelength_m: float) -> Needed:
    """Sort what matters to receivers (N,) by distance."""
    distance_m = np.linalg.norm(room.rx_m[:, :2] - room.tx_m[:2], axis=1)
    order = np.argsort(distance_m, kind="stable")
    distance_m, needed = distance_m[order], needed[order] * (4.0 * math.pi / wavelength_m) ** 2
    relative = np.minimum.accumulate((needed * np.maximum(distance_m, 1e-3) ** 2)[::-1])[::-1].copy()
    low = room.rx_m[:, :2].min(axis=0)
    column, row = ((room.rx_m[order, :2] - low) / _CELL_M).astype(np.int64).T
    cells = np.full((row.max() + 1, column.max() + 1), np.inf)
    np.minimum.at(cells, (row, column), needed)
    return Needed(distance_m, relative, np.minimum.accumulate(needed), cells, np.array([*low, _CELL_M]))


@njit(cache=True, nogil=True)
def _trace(plan, beam, receivers, slabs, depth_m, limits, needed, height_m):  # type: ignore[no-untyped-def]
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
            if wall < 0 or _was_met(node, k, wall):
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
                    most_left = slabs.most_transmitted[slabs.material[wall], min(int(most * _COSINES) + 1, _COSINES)]
                    loss *= 1.0 if plan.low[wall] else most_left
                else:
                    cosine = min(value[k, 1], least)
                last = state[k, 0] == limits.reflections
                rarer = limits.rarer ** max(0, state[k, 0] - _USUAL_REFLECTIONS)
                if (
                    crossed <= limits.walls
                    and _matters(loss * rarer, near, needed)
                    and (not last or _reaches(ends, near, loss * rarer, needed))
                ):
                    node[count, 0], node[count, 1], node[count, 2] = k, wall, 1
                    state[count, 0], state[count, 1], state[count, 2], state[count, 3] = state[k, 0], crossed, first, 1
                    value[count, 0], value[count, 1], sequence[count] = loss, cosine, sequence[k]
                    count += 1
            # reflected
            if state[k, 0] < limits.reflections:
                flat = near / np.hypot(near, height_m)
                loss = value[k, 0] * slabs.most_reflected[slabs.material[wall], int(least * flat * _COSINES)]
                last = state[k, 0] + 1 == limits.reflections
                rarer = limits.rarer ** max(0, state[k, 0] + 1 - _USUAL_REFLECTIONS)
                if (
                    _matters(loss * rarer, near, needed)
                    and _reflect(beam[k], piece, walls[wall], beam[count])
                    and (not last or _reaches(beam[count], near, loss * rarer, needed))
                ):
                    node[count, 0], node[count, 1], node[count, 2] = k, wall, 0
                    state[count, 0], state[count, 1] = state[k, 0] + 1, state[k, 1]
                    state[count, 2], state[count, 3] = -1, state[k, 3]
                    value[count, 0], value[count, 1] = loss, 1.0
                    sequence[count] = _mixed(sequence[k], plan.line[wall])
                    count += 1
        k += 1
    return node[:count], sequence[:count], beam[:count, :2].copy(), value[:count, 0].copy(), pair[:pairs]


@njit(cache=True)
def _was_met(node, beam, wall):  # type: ignore[no-untyped-def]
    """Whether a beam has met a wall since it was reflected: no line does twice, slivers at corners would for ever."""
    while beam >= 0:
        if node[beam, 1] == wall:
            return True
        if node[beam, 2] == 0:
            break
        beam = node[beam, 0]
    return False


@njit(cache=True)
def _mixed(sequence, line):  # type: ignore[no-untyped-def]
    """Hash a sequence of lines and one line more (splitmix64)."""
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
def _matters(loss, near, needed):  # type: ignore[no-untyped-def]
    """Whether a beam with this loss, which has come this far at least, may matter to any receiver."""
    at = np.searchsorted(needed.distance_m, near)
    if at < len(needed.distance_m) and loss >= needed.relative[at]:
        return True
    return at > 0 and loss >= needed.power[at - 1] * near * near


@njit(cache=True)
def _reaches(beam, near, loss, needed):  # type: ignore[no-untyped-def]
    """Whether a beam matters to any receiver behind its window, with all that stands there taken away."""
    x0, y0, edge = needed.grid
    rows, columns = needed.cells.shape
    far = np.hypot(
        max(abs(beam[0] - x0), abs(beam[0] - x0 - columns * edge)),
        max(abs(beam[1] - y0), abs(beam[1] - y0 - rows * edge)),
    )
    corner = np.empty((4, 2))
    for e in range(2):
        dx, dy = beam[2 + 2 * e] - beam[0], beam[3 + 2 * e] - beam[1]
        scale = max(1.0, 2.0 * far / max(np.hypot(dx, dy), 1e-9))
        corner[e, 0], corner[e, 1] = beam[2 + 2 * e], beam[3 + 2 * e]
        corner[3 - e, 0], corner[3 - e, 1] = beam[0] + scale * dx, beam[1] + scale * dy
    low, high = np.min(corner[:, 1]) - TOLERANCE_M, np.max(corner[:, 1]) + TOLERANCE_M
    for row in range(max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)):
        left, right = span_in_strip(corner, y0 + row * edge - TOLERANCE_M, y0 + (row + 1) * edge + TOLERANCE_M)
        if left > right:
            continue
        first = max(0, int(np.floor((left - TOLERANCE_M - x0) / edge)))
        last = min(columns - 1, int(np.floor((right + TOLERANCE_M - x0) / edge)))
        for column in range(first, last + 1):
            x, y = x0 + (column + 0.5) * edge - beam[0], y0 + (row + 0.5) * edge - beam[1]
            length = max(near, np.hypot(x, y) - 0.7072 * edge)
            if loss >= needed.cells[row, column] * length * length:
                return True
    return False


class Trail(NamedTuple):
    """Scratch of one path in the plan: its reflections, and all it meets, in order from the transmitter.

    `surface` are pieces of walls, `kind` Sionna RT's number of each interaction, `same_wall` whether it is at a further
    face of a wall that has been crossed, which costs nothing, and `cosine` that of the incidence there; `points` are
    (x, y, fraction of the length).
    """

    walls: NDArray[np.int64]
    bounce: Floats
    surface: NDArray[np.int64]
    kind: NDArray[np.int64]
    same_wall: Bools
    cosine: Floats
    points: Floats
    found: Floats
    wall: NDArray[np.int64]
    visit: NDArray[np.int64]


def trail_of(plan: Plan) -> Trail:
    """Make scratch for paths in a plan."""
    room = 64
    return Trail(
        np.empty(16, np.int64),
        np.empty((16, 3)),
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.empty(room, np.bool_),
        np.empty(room),
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
    total = (
        np.hypot(x - tree.source[node, 0], y - tree.source[node, 1])
        if node >= 0
        else np.hypot(x - tx_m[0], y - tx_m[1])
    )
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
            bx, by, stop, other = (
                trail.bounce[level, 0],
                trail.bounce[level, 1],
                trail.bounce[level, 2],
                trail.walls[level],
            )
        else:
            bx, by, stop, other = target[0], target[1], 1.0, -1
        count, more = cross_leg(plan, interior, ax, ay, bx, by, own, other, done, stop, count, trail)
        crossed += more
        if count < 0 or crossed > limits.walls:
            return -1, crossed, total
        if level < k:
            if count >= len(trail.surface) - 1:
                return -1, crossed, total
            trail.surface[count], trail.kind[count], trail.same_wall[count] = other, REFLECTION, False
            trail.points[count, 0], trail.points[count, 1], trail.points[count, 2] = bx, by, stop
            count += 1
        ax, ay, done, own = bx, by, stop, other
    return count, crossed, total


@njit(cache=True)
def cross_leg(plan, interior, ax, ay, bx, by, own, other, done, stop, count, trail):  # type: ignore[no-untyped-def]
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
            px, py, qx, qy = (
                plan.pieces_m[i, 0, 0],
                plan.pieces_m[i, 0, 1],
                plan.pieces_m[i, 1, 0],
                plan.pieces_m[i, 1, 1],
            )
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
    walls, begin, start, previous, steep = 0, 0, 0.0, 0.0, 1.0
    for j in range(n):
        t, i = trail.found[n - 1 - j if backwards else j], trail.wall[n - 1 - j if backwards else j]
        wx, wy = plan.pieces_m[i, 1, 0] - plan.pieces_m[i, 0, 0], plan.pieces_m[i, 1, 1] - plan.pieces_m[i, 0, 1]
        cosine = abs(wx * dy - wy * dx) / (length * np.hypot(wx, wy))
        same = j > 0 and abs(t - start) * length * min(cosine, steep) <= interior.depth_m
        if same:
            same = not _is_free_between(interior, ax, ay, dx, dy, length, min(t, previous), max(t, previous))
        if not same:
            _choose(trail, count, n, begin, j, backwards)
            walls, begin, start, steep = walls + 1, j, t, 1.0
        entry = count + (n - 1 - j if backwards else j)
        trail.surface[entry], trail.kind[entry], trail.cosine[entry] = i, REFRACTION, cosine
        trail.same_wall[entry] = True
        trail.points[entry, 0], trail.points[entry, 1] = ax + t * dx, ay + t * dy
        trail.points[entry, 2] = done + t * (stop - done)
        previous, steep = t, min(steep, cosine)
    _choose(trail, count, n, begin, n, backwards)
    return walls


@njit(cache=True)
def _choose(trail, count, n, begin, end, backwards):  # type: ignore[no-untyped-def]
    """Let one of the faces of a wall have its loss: that of the median angle, as outlines may be ragged."""
    for j in range(begin, end):
        own, rank = count + (n - 1 - j if backwards else j), 0
        for k in range(begin, end):
            other = count + (n - 1 - k if backwards else k)
            rank += trail.cosine[other] < trail.cosine[own] or (trail.cosine[other] == trail.cosine[own] and k < j)
        if rank == (end - begin) // 2:
            trail.same_wall[own] = False


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
def can_bounce_as(variant, room):  # type: ignore[no-untyped-def]
    """Bounces at floor and ceiling of a variant, which comes first, and whether the room allows them."""
    bounces = 0 if variant == 0 else (1 if variant < 3 else 2)
    first = CEILING if variant == 2 or variant == 4 else FLOOR
    return bounces, first, can_bounce(bounces, first, room)


@njit(cache=True)
def _path_power(trail, count, length, room, target, bounces, first, plan, interior, slabs, wavelength):  # type: ignore[no-untyped-def]
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
            kind, material = trail.kind[item], slabs.material[i]
            wx, wy = plan.pieces_m[i, 1, 0] - plan.pieces_m[i, 0, 0], plan.pieces_m[i, 1, 1] - plan.pieces_m[i, 0, 1]
            norm = np.hypot(wx, wy)
            nx, ny, nz = wy / norm, -wx / norm, 0.0
            ax, ay, done = trail.points[item, 0], trail.points[item, 1], trail.points[item, 2]
            item += 1
            if trail.same_wall[item - 1]:
                continue
            if kind == REFRACTION and plan.low[i] and is_above(i, done, bounces, first, plan, room, target):
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
            nx, ny, nz, kind, material = 0.0, 0.0, 1.0, REFLECTION, 0
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
        table = slabs.transmission if kind == REFRACTION else slabs.reflection
        te *= table[material, low, 0] + part * (table[material, low + 1, 0] - table[material, low, 0])
        tm *= table[material, low, 1] + part * (table[material, low + 1, 1] - table[material, low, 1])
        if kind == REFLECTION:
            kx, ky, kz = kx - 2.0 * along * nx, ky - 2.0 * along * ny, kz - 2.0 * along * nz
            px, py, pz = sy * kz - sz * ky, sz * kx - sx * kz, sx * ky - sy * kx
        ex, ey, ez = te * sx + tm * px, te * sy + tm * py, te * sz + tm * pz
    norm = max(np.hypot(kx, ky), 1e-12)
    field = ex * (kx * kz / norm) + ey * (ky * kz / norm) - ez * norm
    return (wavelength / (4.0 * np.pi * total)) ** 2 * (field.real**2 + field.imag**2)


@njit(cache=True)
def is_above(piece, fraction, bounces, first, plan, room, target):  # type: ignore[no-untyped-def]
    """Whether a path is above a piece of a wall after a fraction of its length."""
    to_first = room.tx_m[2] if first == FLOOR else room.height_m - room.tx_m[2]
    unfolded = unfolded_height(room, target, bounces, first) if bounces else 1.0
    return height_at(fraction, room, target, bounces, first, to_first, unfolded) > room.top_m[plan.owner[piece]]


@njit(cache=True, nogil=True)
def pair_powers(tree, needed, plan, interior, room, slabs, limits, wavelength, trail):  # type: ignore[no-untyped-def]
    """Power (K, V) of each variant of all pairs; 0 where there is none that goes through a wall, or is needed."""
    power = np.zeros((len(tree.pair), _VARIANTS))
    for i in range(len(tree.pair)):
        node, rx = tree.pair[i, 0], tree.pair[i, 1]
        target = room.rx_m[rx]
        if node >= 0:
            far = np.hypot(target[0] - tree.source[node, 0], target[1] - tree.source[node, 1])
            if tree.loss[node] * (wavelength / (4.0 * np.pi * max(far, 1e-3))) ** 2 < needed[rx]:
                continue
        count, crossed, length = _follow(tree, node, plan, interior, room.tx_m, target, limits, trail)
        if count < 0 or crossed == 0 or not has_long_legs(trail, count, length):
            continue
        reflections = np.sum(trail.kind[:count] == REFLECTION)
        for variant in range(_VARIANTS):
            bounces, first, good = can_bounce_as(variant, room)
            if good and bounces > 0 and node >= 0:
                up = unfolded_height(room, target, bounces, first)
                total = np.hypot(length, up)
                flat = slabs.reflection[0, min(int(up / total * _COSINES) + 1, _COSINES)]
                most = tree.loss[node] * max(abs(flat[0]), abs(flat[1])) ** (2 * bounces)
                good = most * (wavelength / (4.0 * np.pi * total)) ** 2 >= needed[rx]
            if good and reflections + bounces <= limits.depth:
                power[i, variant] = _path_power(
                    trail, count, length, room, target, bounces, first, plan, interior, slabs, wavelength
                )
    return power


@njit(cache=True)
def has_long_legs(trail, count, length):  # type: ignore[no-untyped-def]
    """Whether no leg of a path of some length in the plan is so short that Sionna RT drops the path."""
    previous = 0.0
    for k in range(count):
        if (trail.points[k, 2] - previous) * length < _SHORTEST_LEG_M:
            return False
        previous = trail.points[k, 2]
    return (1.0 - previous) * length >= _SHORTEST_LEG_M


@njit(cache=True, nogil=True)
def write_paths(tree, chosen, variants, plan, interior, room, limits, trail):  # type: ignore[no-untyped-def]
    """Write chosen pairs: surfaces, kinds (C, D) and vertices (C, D, 3) of interactions, and `same_wall` (C, D)."""
    surface, kind, vertices, same_wall = empty_paths(len(chosen), trail)
    item = WALLS + np.arange(len(trail.surface))
    for c in range(len(chosen)):
        node, rx = tree.pair[chosen[c], 0], tree.pair[chosen[c], 1]
        target = room.rx_m[rx]
        count, _, _ = _follow(tree, node, plan, interior, room.tx_m, target, limits, trail)
        bounces, first, _ = can_bounce_as(variants[c], room)
        merge_heights(item[:count], trail.points[:count], room, target, bounces, first, surface[c], vertices[c])
        write_kinds(trail, plan, count + bounces, surface[c], kind[c], same_wall[c])
    return surface, kind, vertices, same_wall


@njit(cache=True)
def empty_paths(count, trail):  # type: ignore[no-untyped-def]
    """Surfaces, kinds, vertices and `same_wall` of paths, without any interaction."""
    shape = count, len(trail.surface) + 2
    vertices, same_wall = np.zeros((*shape, 3)), np.zeros(shape, np.bool_)
    return np.zeros(shape, np.int32), np.zeros(shape, np.uint8), vertices, same_wall


@njit(cache=True)
def write_kinds(trail, plan, count, surface, kind, same_wall):  # type: ignore[no-untyped-def]
    """Put surfaces in place of the entries of a trail, which are numbered as walls, and write the kinds of all."""
    for d in range(count):
        entry = surface[d] - WALLS
        if entry < 0:
            kind[d] = REFLECTION
            continue
        kind[d], same_wall[d] = trail.kind[entry], trail.same_wall[entry]
        surface[d] = EDGE if kind[d] == DIFFRACTION else WALLS + plan.owner[trail.surface[entry]]
