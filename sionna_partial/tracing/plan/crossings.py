"""Candidates of floor plans that go through walls, without diffraction: their powers, and which of them links need.

A path in the plan has five variants: without reflections at floor and ceiling, with one at either, and with both in
either order. Its power between vertical antennas is the power of a Jones vector along it.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.floor_plan import bin_points
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.interactions import REFLECTION, REFRACTION
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.plan.crossing_beams import (
    Building,
    CrossingBeams,
    Task,
    first_beams,
    follow_beams,
    needed_of,
)
from sionna_partial.tracing.plan.legs import (
    FACES,
    Leg,
    columns_of,
    cross_leg,
    empty_paths,
    has_long_legs,
    trail_of,
    write_kinds,
)
from sionna_partial.tracing.plan.obstacles import Lowered
from sionna_partial.tracing.plan.specular import (
    CEILING,
    FLOOR,
    WALLS,
    Room,
    can_bounce,
    height_at,
    merge_heights,
    unfolded_height,
)
from sionna_partial.tracing.power import (
    Materials,
    at_slab,
    gain_at_azimuth,
    gain_towards,
    power_near,
    received_power,
    vertical_field,
)
from sionna_partial.tracing.select import Limits, Listed
from sionna_partial.tracing.walls import Interior

VARIANTS = 5
"""Reflections at floor and ceiling that a path through walls may have: none, floor, ceiling, both in either order."""

_BEAMS_AT_ONCE, _PAIRS_AT_ONCE = 256, 5_000
"""Number of beams, and of pairs, that one thread works on at a time."""


class Tree(NamedTuple):
    """All M beams: their `parent` (M,), -1 for the roots, `piece` (M,) of a wall and image `source_m` (M, 2)."""

    parent: NDArray[np.int32]
    piece: NDArray[np.int32]
    source_m: Floats


class _Rise(NamedTuple):
    """The height [m] that a path covers, unfolded, in all and to the first of its reflections at floor and ceiling.

    `up` is 1 where it rises at first, -1 where it falls.
    """

    height: float
    to_first: float
    up: float
    bounces: int


@njit(cache=True)
def can_bounce_as(variant, room):  # type: ignore[no-untyped-def]
    """Bounces at floor and ceiling of a variant, which comes first, and whether the room allows them."""
    bounces = 0 if variant == 0 else (1 if variant < 3 else 2)
    first = CEILING if variant == 2 or variant == 4 else FLOOR
    return bounces, first, can_bounce(bounces, first, room)


@njit(cache=True)
def _unfold(tree, node, plan, room, target, trail):  # type: ignore[no-untyped-def]
    """Write the reflections at walls of a path: their number, -1 if there is no path, and its length in the plan."""
    k, above = 0, node
    while above >= 0 and tree.parent[above] >= 0:
        k, above = k + 1, tree.parent[above]
    x, y = target[0], target[1]
    sx, sy = (tree.source_m[node, 0], tree.source_m[node, 1]) if node >= 0 else (room.tx_m[0], room.tx_m[1])
    total = np.hypot(x - sx, y - sy)
    for level in range(k - 1, -1, -1):
        sx, sy = tree.source_m[node, 0], tree.source_m[node, 1]
        wall = plan.pieces_m[tree.piece[node]]
        dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
        from_source = dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])
        from_point = dx * (y - wall[0, 1]) - dy * (x - wall[0, 0])
        if abs(from_source - from_point) < 1e-15 or total == 0.0:
            return -1, total
        fraction = from_source / (from_source - from_point)
        x, y = sx + fraction * (x - sx), sy + fraction * (y - sy)
        away = np.hypot(x - sx, y - sy)
        trail.walls[level] = tree.piece[node]
        trail.bounce[level, 0], trail.bounce[level, 1], trail.bounce[level, 2] = x, y, away / total
        trail.bounce[level, 3] = abs(from_source) / max(away * np.hypot(dx, dy), 1e-15)
        node = tree.parent[node]
    return k, total


@njit(cache=True)
def _cross(k, building, target, trail):  # type: ignore[no-untyped-def]
    """Write all that a path with `k` reflections meets in the plan: its number (-1 if there is no path), and walls."""
    count = crossed = 0
    start, done, own = (building.room.tx_m[0], building.room.tx_m[1]), 0.0, np.int64(-1)
    for level in range(k + 1):
        end, stop, other = (target[0], target[1]), 1.0, np.int64(-1)
        if level < k:
            end, stop = (trail.bounce[level, 0], trail.bounce[level, 1]), trail.bounce[level, 2]
            other = trail.walls[level]
        leg = Leg(start, end, own, other, done, stop)
        count, more = cross_leg(building.plan, building.interior, leg, count, trail)
        crossed += more
        if count < 0 or crossed > building.limits.walls or count >= len(trail.surface) - 1:
            return -1, crossed
        if level < k:
            trail.surface[count], trail.kind[count], trail.same_wall[count] = other, REFLECTION, False
            trail.points[count, 0], trail.points[count, 1], trail.points[count, 2] = end[0], end[1], stop
            count += 1
        start, done, own = end, stop, other
    return count, crossed


@njit(cache=True)
def _bounds(k, length, through, building, target, least, trail, possible):  # type: ignore[no-untyped-def]
    """Mark the variants of a path that may have the power `least`; whether there is any."""
    room, table, some = building.room, building.materials.reflection, False
    x, y = (trail.bounce[0, 0], trail.bounce[0, 1]) if k > 0 else (target[0], target[1])
    through *= gain_at_azimuth(room.gains, x - room.tx_m[0], y - room.tx_m[1])
    for variant in range(VARIANTS):
        bounces, first, possible[variant] = can_bounce_as(variant, room)
        possible[variant] &= k + bounces <= building.limits.depth
        if not possible[variant]:
            continue
        height = unfolded_height(room, target, bounces, first)
        total = np.hypot(length, height)
        power = through * (building.materials.wavelength_m / (4.0 * np.pi * total)) ** 2
        power *= power_near(table[room.flat_material], height / total) ** bounces
        for level in range(k):
            material = building.material[trail.walls[level]]
            power *= power_near(table[material], trail.bounce[level, 3] * length / total)
        possible[variant] = 1.01 * power >= least
        some |= possible[variant]
    return some


@njit(cache=True, nogil=True)
def pair_powers(tree, pair, through, building, needed, trail):  # type: ignore[no-untyped-def]
    """Power (K, V) of each variant of pairs (beam, receiver), of which walls leave no more than `through` (K,).

    It is 0 where there is no path that goes through a wall, or none that has the power `needed` (N,).
    """
    power, possible = np.zeros((len(pair), VARIANTS)), np.empty(VARIANTS, np.bool_)
    for i in range(len(pair)):
        target, least = building.room.rx_m[pair[i, 1]], needed[pair[i, 1]]
        k, length = _unfold(tree, pair[i, 0], building.plan, building.room, target, trail)
        if k < 0 or not _bounds(k, length, through[i], building, target, least, trail, possible):
            continue
        count, crossed = _cross(k, building, target, trail)
        if count < 0 or crossed == 0 or not has_long_legs(trail, count, length):
            continue
        for variant in range(VARIANTS):
            if possible[variant]:
                power[i, variant] = _path_power(trail, count, length, variant, building, target)
    return power


@njit(cache=True)
def _path_power(trail, count, length, variant, building, target):  # type: ignore[no-untyped-def]
    """Power between vertical antennas of a path that the plan has, with reflections at floor and ceiling."""
    room, rise = building.room, _rise_of(variant, building.room, target)
    total = np.hypot(length, rise.height)
    end = (trail.points[0, 0], trail.points[0, 1]) if count > 0 else (target[0], target[1])
    ax, ay, done = room.tx_m[0], room.tx_m[1], 0.0
    size = max(np.hypot(end[0] - ax, end[1] - ay), 1e-12) * total / length
    k = (end[0] - ax) / size, (end[1] - ay) / size, rise.up * rise.height / total
    e, gain = vertical_field(k), gain_towards(room.gains, k[0], k[1], k[2])
    item = turn = 0
    while item < count or turn < rise.bounces:
        fraction = (rise.to_first + turn * room.height_m) / rise.height if turn < rise.bounces else 2.0
        if item < count and trail.points[item, 2] <= fraction:
            ax, ay, done = trail.points[item]
            piece = trail.surface[item]
            above = building.plan.low[piece] and trail.kind[item] == REFRACTION
            if above:
                above = _is_above(piece, done, variant, building, target)
            if not (trail.same_wall[item] or above):
                normal, material = _normal(building.plan, piece), building.material[piece]
                k, e = at_slab(k, e, normal, building.materials, material, trail.kind[item])
            item += 1
            continue
        bx, by, stop = target[0], target[1], 1.0
        if item < count:
            bx, by, stop = trail.points[item]
        part = (fraction - done) / (stop - done) if stop > done else 0.0
        if not _has_floor(building.interior, ax + part * (bx - ax), ay + part * (by - ay)):
            return 0.0
        k, e = at_slab(k, e, (0.0, 0.0, 1.0), building.materials, room.flat_material, REFLECTION)
        turn += 1
    return (building.materials.wavelength_m / (4.0 * np.pi * total)) ** 2 * received_power(k, e) * gain


@njit(cache=True)
def _is_above(piece, fraction, variant, building, target):  # type: ignore[no-untyped-def]
    """Return whether a path is above a piece of a wall after a fraction of its length."""
    room, (bounces, first, _) = building.room, can_bounce_as(variant, building.room)
    to_first = room.tx_m[2] if first == FLOOR else room.height_m - room.tx_m[2]
    unfolded = unfolded_height(room, target, bounces, first) if bounces else 1.0
    top_m = room.top_m[building.plan.owner[piece]]
    return height_at(fraction, room, target, bounces, first, to_first, unfolded) > top_m


@njit(cache=True)
def _rise_of(variant, room, target):  # type: ignore[no-untyped-def]
    """Heights of a variant of a path."""
    bounces, first, _ = can_bounce_as(variant, room)
    if bounces == 0:
        rise = target[2] - room.tx_m[2]
        return _Rise(abs(rise), 0.0, 1.0 if rise >= 0.0 else -1.0, 0)
    height = unfolded_height(room, target, bounces, first)
    if first == FLOOR:
        return _Rise(height, room.tx_m[2], -1.0, bounces)
    return _Rise(height, room.height_m - room.tx_m[2], 1.0, bounces)


@njit(cache=True)
def _normal(plan, piece):  # type: ignore[no-untyped-def]
    """Give the unit vector across a piece of a wall."""
    wx = plan.pieces_m[piece, 1, 0] - plan.pieces_m[piece, 0, 0]
    wy = plan.pieces_m[piece, 1, 1] - plan.pieces_m[piece, 0, 1]
    size = np.hypot(wx, wy)
    return wy / size, -wx / size, 0.0


@njit(cache=True)
def _has_floor(interior, x, y):  # type: ignore[no-untyped-def]
    """Return whether there is floor at a point, and ceiling."""
    column, row = int(x / interior.cell_m), int(y / interior.cell_m)
    return 0 <= row < interior.floor.shape[0] and 0 <= column < interior.floor.shape[1] and interior.floor[row, column]


@njit(cache=True, nogil=True)
def write_paths(tree, pair, variants, building, trail):  # type: ignore[no-untyped-def]
    """Write chosen pairs: surfaces, kinds (C, D) and vertices (C, D, 3) of interactions, and `same_wall` (C, D)."""
    surface, kind, vertices, same_wall = empty_paths(len(pair), trail)
    room, item = building.room, WALLS + np.arange(len(trail.surface))
    for c in range(len(pair)):
        target = room.rx_m[pair[c, 1]]
        k, _ = _unfold(tree, pair[c, 0], building.plan, room, target, trail)
        count, _ = _cross(k, building, target, trail)
        bounces, first, _ = can_bounce_as(variants[c], room)
        merge_heights(item[:count], trail.points[:count], room, target, bounces, first, surface[c], vertices[c])
        write_kinds(trail, building.plan, count + bounces, surface[c], kind[c], same_wall[c])
    return surface, kind, vertices, same_wall


class _Paths(NamedTuple):
    """Paths: `pair` (K, 2) of beam, -1 for straight lines, and receiver, `variant` (K,), and `power` (K,)."""

    pair: Indices
    variant: Indices
    power: Floats

    def sums(self, count: int) -> Floats:
        """Sum up the power of each of `count` receivers."""
        return np.bincount(self.pair[:, 1], self.power, count).astype(np.float64)


class CrossingCandidates:
    """Paths between the transmitter and the receivers of a room that go through walls, without diffraction.

    They have at most two reflections at floor and ceiling, and are limited by `Limits`.
    """

    name = "paths through walls"

    def __init__(
        self,
        geometry: SceneGeometry,
        room: Room,
        interior: Interior,
        settings: TraceSettings,
        materials: Materials,
    ) -> None:
        self._geometry = geometry
        walls = FACES if geometry.plan.low.any() else settings.max_walls  # obstacles below a path are counted later
        limits = Limits.of(settings, walls, directed=len(room.gains.table) > 1)
        material = room.wall_material[geometry.plan.owner]
        self.lowered = Lowered.of(geometry, room, interior, settings.max_walls)
        self.building = Building(geometry.plan, interior, room, materials, material, limits)

    def listed(self, found: Floats) -> Iterator[Listed]:
        """List the paths that links may need whose indirect paths without walls have the power `found` (N,)."""
        tree, (pair, variant, power) = self._found(found)
        yield Listed(pair[:, 1], power, partial(self._written, tree, pair, variant), 1.0)

    def _found(self, found: Floats) -> tuple[Tree, _Paths]:
        """List all beams, and the paths that links need, by the number of their reflections.

        The paths of few reflections decide how strong paths of more have to be.
        """
        room, limits, count = self.building.room, self.building.limits, len(found)
        receivers, beams = bin_points(room.rx_m[:, :2]), first_beams(room)
        tree, first = Tree(beams.parent, beams.piece, beams.window[:, :2]), 0
        straight = np.stack([np.full(count, -1), np.arange(count)], axis=1)
        listed = [self._paths(tree, straight, np.ones(count), np.zeros(count))]
        total = found + listed[0].sums(count)
        for order in range(limits.reflections + 1):
            weakest = limits.min_power(total)
            needed = needed_of(weakest, room, self.building.materials.wavelength_m)
            reflected, pair, through = self._followed(beams, Task(order, receivers, self.building, needed))
            new = first_of_each(beams.sequence[pair[:, 0]], pair[:, 1])
            listed.append(self._paths(tree, pair[new] + np.array([first, 0]), through[new], weakest))
            total += listed[-1].sums(count)
            first, beams = len(tree.parent), reflected._replace(parent=reflected.parent + first)
            parent, piece = np.append(tree.parent, beams.parent), np.append(tree.piece, beams.piece)
            tree = Tree(parent, piece, np.concatenate([tree.source_m, beams.window[:, :2]]))
        return tree, _Paths(*(np.concatenate(column) for column in zip(*listed, strict=True)))

    def _followed(self, beams: CrossingBeams, task: Task) -> tuple[CrossingBeams, NDArray[np.int64], Floats]:
        """Follow beams: those that walls reflect, pairs (K, 2), and what walls leave of these at most (K,)."""

        def followed(first: int) -> tuple[Any, ...]:
            stop = min(first + _BEAMS_AT_ONCE, len(beams.parent))
            return follow_beams(beams, first, stop, task)  # type: ignore[no-any-return]

        nothing = (tuple(column[:0] for column in beams), np.zeros((0, 2), np.int32), np.zeros(0))
        parts = [nothing, *in_order(followed, range(0, len(beams.parent), _BEAMS_AT_ONCE))]
        children, pair, through = zip(*parts, strict=True)
        reflected = CrossingBeams(*(np.concatenate(column) for column in zip(*children, strict=True)))
        return reflected, np.concatenate(pair).astype(np.int64), np.concatenate(through)

    def _paths(self, tree: Tree, pair: NDArray[np.int64], through: Floats, needed: Floats) -> _Paths:
        """Find the paths of pairs (beam, receiver) of which walls leave no more than `through` (K,)."""

        def of_pairs(start: int) -> Floats:
            rows = slice(start, start + _PAIRS_AT_ONCE)
            trail = trail_of(self._geometry.plan)
            return pair_powers(tree, pair[rows], through[rows], self.building, needed, trail)  # type: ignore[no-any-return]

        parts = in_order(of_pairs, range(0, len(pair), _PAIRS_AT_ONCE))
        power = np.concatenate([np.zeros((0, VARIANTS)), *parts])
        which, variant = np.nonzero(power)
        return _Paths(pair[which], variant, power[which, variant])

    def _written(self, tree: Tree, pair: Indices, variant: Indices, rows: Indices) -> Candidates:
        written = write_paths(tree, pair[rows], variant[rows], self.building, trail_of(self._geometry.plan))
        return self.lowered(Candidates(pair[rows, 1].astype(np.int32), **columns_of(self._geometry, *written)))


def first_of_each(first: NDArray[np.int64], second: NDArray[np.int64]) -> Indices:
    """Rows of the first of each pair of values, in their order."""
    order = np.lexsort((second, first))
    a, b = first[order], second[order]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (a[1:] != a[:-1]) | (b[1:] != b[:-1])
    return order[new]
