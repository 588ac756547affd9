"""Paths of a floor plan without diffraction: reflections between opaque walls, and paths through walls.

Sequences of walls from `beams.py` are unfolded into points of reflection, with every possible number of reflections at
floor and ceiling. They are selected by their power, as in `power.py`.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.outlines import bin_points
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.interactions import REFLECTION, REFRACTION
from sionna_partial.tracing.line import add_slab, has_long_legs, jones_power
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.plan.beams import Beams, BeamTree, Sources, Task, follow, needed_of, trace_beams
from sionna_partial.tracing.plan.obstacles import Lowered
from sionna_partial.tracing.plan.room import (
    FACES,
    Building,
    Leg,
    Room,
    WrittenPaths,
    add_entry,
    candidates_of,
    cross_leg,
    fraction_at_turn,
    gain_of_departure,
    has_variant,
    height_at,
    is_reflected_inside,
    rise_of,
    trail_of,
    write_path,
)
from sionna_partial.tracing.power import (
    VERTICAL,
    Materials,
    at_flats,
    at_wall,
    gain_at_azimuth,
    gain_towards,
    power_near,
)
from sionna_partial.tracing.select import Limits, Listed
from sionna_partial.tracing.walls import Interior

_VARIANTS = 6
"""Variants of paths through walls: at most two reflections at floor and ceiling."""

_LISTED_AT_ONCE = 200_000
"""Number of pairs of opaque sequence and receiver listed together, which bounds the memory."""

_PAIRS_AT_ONCE = 5_000
"""Number of pairs that one thread works on at a time."""


@njit(cache=True, borrows=True)
def unfold(tree, node, pieces_m, target, walls, bounce):
    """Write the reflections at walls of a path; return their number, -1 without a path, and the length in the plan.

    `walls` and `bounce` are as in `Trail`.
    """
    k, above = 0, node
    while tree.parent[above] >= 0:
        k, above = k + 1, tree.parent[above]
    x, y = target[0], target[1]
    total = np.hypot(x - tree.source_m[node, 0], y - tree.source_m[node, 1])
    for level in range(k - 1, -1, -1):
        sx, sy = tree.source_m[node, 0], tree.source_m[node, 1]
        wall = pieces_m[tree.piece[node]]
        dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
        from_source = dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])
        from_point = dx * (y - wall[0, 1]) - dy * (x - wall[0, 0])
        if abs(from_source - from_point) < 1e-15 or total == 0.0:
            return -1, total
        fraction = from_source / (from_source - from_point)
        x, y = sx + fraction * (x - sx), sy + fraction * (y - sy)
        away = np.hypot(x - sx, y - sy)
        walls[level] = tree.piece[node]
        bounce[level, 0], bounce[level, 1], bounce[level, 2] = x, y, away / total
        bounce[level, 3] = abs(from_source) / max(away * np.hypot(dx, dy), 1e-15)
        node = tree.parent[node]
    return k, total


@njit(cache=True, borrows=True)
def _departure(k, tx_m, target, bounce):
    x, y = (bounce[0, 0], bounce[0, 1]) if k > 0 else (target[0], target[1])
    return x - tx_m[0], y - tx_m[1]


@njit(cache=True, borrows=True)
def _reflect(k, trail):
    """Write the `k` reflections at walls of a path between opaque walls as entries; return their number."""
    count = 0
    for level in range(k):
        x, y, stop = trail.bounce[level, 0], trail.bounce[level, 1], trail.bounce[level, 2]
        count = add_entry(trail, count, trail.walls[level], REFLECTION, x, y, stop)
    return count


@njit(cache=True, borrows=True)
def _meet(k, building, target, trail):
    """Write all that a path with `k` reflections at walls meets in the plan.

    Returns the number of entries, -1 if there is no path, and the number of walls crossed.
    """
    count, crossed, start, done, own = 0, 0, (building.room.tx_m[0], building.room.tx_m[1]), 0.0, np.int64(-1)
    for level in range(k + 1):
        end, stop, other = (target[0], target[1]), 1.0, np.int64(-1)
        if level < k:
            end, stop = (trail.bounce[level, 0], trail.bounce[level, 1]), trail.bounce[level, 2]
            other = trail.walls[level]
        count, more = cross_leg(building.plan, building.interior, Leg(start, end, own, other, done, stop), count, trail)
        crossed += more
        if count < 0 or crossed > building.limits.walls or count >= len(trail.surface) - 1:
            return -1, crossed
        if level < k:
            count = add_entry(trail, count, other, REFLECTION, end[0], end[1], stop)
        start, done, own = end, stop, other
    if building.interior.depth_m > 0.0 and is_reflected_inside(building.plan, building.interior, count, trail):
        return -1, crossed
    return count, crossed


@njit(cache=True, borrows=True, nogil=True)
def _write_opaque(tree, pairs, variants, pieces_m, owner, room, trail, paths):
    """Write the paths of pairs (beam, receiver) between opaque walls."""
    for c in range(len(pairs)):
        target = room.rx_m[pairs[c, 1]]
        k, _ = unfold(tree, pairs[c, 0], pieces_m, target, trail.walls, trail.bounce)
        write_path(trail, _reflect(k, trail), room, owner, target, variants[c], paths, c)


@njit(cache=True, borrows=True, nogil=True)
def _write_crossing(tree, pairs, variants, building, trail, paths):
    """Write the paths of pairs (beam, receiver) through walls."""
    room, owner = building.room, building.plan.owner
    for c in range(len(pairs)):
        target = room.rx_m[pairs[c, 1]]
        k, _ = unfold(tree, pairs[c, 0], building.plan.pieces_m, target, trail.walls, trail.bounce)
        count, _ = _meet(k, building, target, trail)
        write_path(trail, count, room, owner, target, variants[c], paths, c)


class SpecularCandidates:
    """All paths of at most `max_depth` reflections between opaque walls, floor and ceiling."""

    name = "reflections"

    def __init__(self, geometry: SceneGeometry, room: Room, max_depth: int, materials: Materials) -> None:
        self._geometry = geometry
        self._building = Building.opaque(geometry.plan, room, materials, max_depth)

    def listed(self, found: Floats, *, pairs_at_once: int = _LISTED_AT_ONCE) -> Iterator[Listed]:
        room, plan, depth = self._building.room, self._building.plan, self._building.limits.depth
        sources = Sources.equal(room.tx_m[None, :2], depth, len(room.rx_m))
        tree, pairs = trace_beams(self._building, bin_points(room.rx_m[:, :2]), sources)

        def of_pairs(start: int) -> Listed:
            some = pairs[start : start + pairs_at_once]
            size = len(some) * (2 * depth + 2)
            columns: tuple[Any, ...] = np.empty(size, np.int32), np.empty(size, np.int8), np.empty(size)
            inputs = plan.pieces_m, self._building.material, self._building.materials, room, trail_of(plan)
            count = _list_variants(tree, some, depth, *inputs, columns)
            pair, variant, bound = (column[:count].copy() for column in columns)
            write = partial(self._written, tree, some, pair, variant)
            return Listed(some[pair, 1], bound, write, (start + len(some)) / len(pairs))

        yield from in_order(of_pairs, range(0, len(pairs), pairs_at_once))

    def _written(
        self, tree: BeamTree, pairs: NDArray[np.int32], pair: Indices, variant: NDArray[np.int8], rows: Indices
    ) -> Candidates:
        size, trail = max(1, self._building.limits.depth), trail_of(self._building.plan)
        pairs = pairs[pair[rows]]
        paths = WrittenPaths.empty(len(pairs), size)
        plan, room = self._building.plan, self._building.room
        _write_opaque(tree, pairs, variant[rows], plan.pieces_m, plan.owner, room, trail, paths)
        return candidates_of(self._geometry, pairs[:, 1], paths, opaque=True)


@njit(cache=True, borrows=True, nogil=True)
def _list_variants(tree, pairs, depth, pieces_m, material, materials, room, trail, columns):
    """List every variant of pairs (beam, receiver): numbers of pairs, variants and bounds in `columns` (C,).

    Return their number. The bound of a direct path is infinite.
    """
    (pair, variants, bound), walls, bounce, count = columns, trail.walls, trail.bounce, 0
    for i in range(len(pairs)):
        target = room.rx_m[pairs[i, 1]]
        k, length = unfold(tree, pairs[i, 0], pieces_m, target, walls, bounce)
        for variant in range(2 * (depth - k) + 2 if k >= 0 else 0):
            if not has_variant(variant, room):
                continue
            rise = rise_of(variant, room, target)
            total = np.hypot(length, rise.height_m)
            sine, slope, field = length / total, rise.height_m / total, VERTICAL
            for level in range(k):
                field = at_wall(materials.largest, material[walls[level]], bounce[level, 3], sine, slope, field)
            strength = at_flats(materials.largest, room.flat_material, slope, rise.bounces, field)
            power = (materials.wavelength_m / (4.0 * np.pi * total) * strength) ** 2
            if len(room.gains.table) > 1:
                x, y = _departure(k, room.tx_m, target, bounce)
                power *= gain_of_departure(room, x, y, rise, length)
            pair[count], variants[count] = i, variant
            bound[count] = power if k + rise.bounces > 0 else np.inf
            count += 1
    return count


@njit(cache=True, borrows=True)
def _bounds(k, length, through, building, target, least, trail, possible):
    """Mark the variants of a path that may have the power `least`; return whether any has."""
    room, table, some = building.room, building.materials.reflection, False
    x, y = _departure(k, room.tx_m, target, trail.bounce)
    through *= gain_at_azimuth(room.gains, x, y)
    for variant in range(_VARIANTS):
        rise = rise_of(variant, room, target)
        possible[variant] = has_variant(variant, room) and k + rise.bounces <= building.limits.depth
        if not possible[variant]:
            continue
        total = np.hypot(length, rise.height_m)
        power = through * (building.materials.wavelength_m / (4.0 * np.pi * total)) ** 2
        power *= power_near(table, room.flat_material, rise.height_m / total) ** rise.bounces
        for level in range(k):
            material = building.material[trail.walls[level]]
            power *= power_near(table, material, trail.bounce[level, 3] * length / total)
        possible[variant] = 1.01 * power >= least
        some |= possible[variant]
    return some


@njit(cache=True, borrows=True, nogil=True)
def _pair_powers(tree, pair, through, building, needed, trail, possible, power):
    """Write the power (K, V) of each variant of pairs (beam, receiver), of which walls leave at most `through` (K,).

    It stays 0 for paths through no wall or below the power `needed` (N,). `possible` (V,) is scratch.
    """
    for i in range(len(pair)):
        target, least = building.room.rx_m[pair[i, 1]], needed[pair[i, 1]]
        k, length = unfold(tree, pair[i, 0], building.plan.pieces_m, target, trail.walls, trail.bounce)
        if k < 0 or not _bounds(k, length, through[i], building, target, least, trail, possible):
            continue
        count, crossed = _meet(k, building, target, trail)
        if count < 0 or crossed == 0 or not has_long_legs(trail.points[:, 2], count, 1.0, length):
            continue
        for variant in range(_VARIANTS):
            if possible[variant]:
                rise = rise_of(variant, building.room, target)
                power[i, variant] = _path_power(trail, count, length, rise, building, target)


@njit(cache=True, borrows=True)
def _path_power(trail, count, length, rise, building, target):
    """Return the power of one variant of a path; 0 if it is reflected where there is no floor."""
    room, total, slabs, used = building.room, np.hypot(length, rise.height_m), trail.slabs, 0
    x, y = (trail.points[0, 0], trail.points[0, 1]) if count > 0 else (target[0], target[1])
    ax, ay, done = room.tx_m[0], room.tx_m[1], 0.0
    size = max(np.hypot(x - ax, y - ay), 1e-12) * total / length
    k = (x - ax) / size, (y - ay) / size, rise.up * rise.height_m / total
    item = turn = 0
    while item < count or turn < rise.bounces:
        fraction = fraction_at_turn(turn, rise)
        if item < count and trail.points[item, 2] <= fraction:
            ax, ay, done = trail.points[item]
            piece = trail.surface[item]
            above = building.plan.low[piece] and trail.kind[item] == REFRACTION
            if above:
                above = height_at(done, rise) > room.top_m[building.plan.owner[piece]]
            if not (trail.same_wall[item] or above):
                normal, material = _normal(building.plan, piece), building.material[piece]
                used = add_slab(slabs, used, normal, material, trail.kind[item])
            item += 1
            continue
        bx, by, stop = target[0], target[1], 1.0
        if item < count:
            bx, by, stop = trail.points[item]
        part = (fraction - done) / (stop - done) if stop > done else 0.0
        if not _has_floor(building.interior, ax + part * (bx - ax), ay + part * (by - ay)):
            return 0.0
        used = add_slab(slabs, used, (0.0, 0.0, 1.0), room.flat_material, REFLECTION)
        turn += 1
    return jones_power(k, total, slabs, used, building.materials) * gain_towards(room.gains, k[0], k[1], k[2])


@njit(cache=True, borrows=True)
def _normal(plan, piece):
    wx = plan.pieces_m[piece, 1, 0] - plan.pieces_m[piece, 0, 0]
    wy = plan.pieces_m[piece, 1, 1] - plan.pieces_m[piece, 0, 1]
    size = np.hypot(wx, wy)
    return wy / size, -wx / size, 0.0


@njit(cache=True, borrows=True)
def _has_floor(interior, x, y):
    column, row = int(x / interior.cell_m), int(y / interior.cell_m)
    return 0 <= row < interior.floor.shape[0] and 0 <= column < interior.floor.shape[1] and interior.floor[row, column]


class _Paths(NamedTuple):
    """Paths: `pair` (K, 2) of beam and receiver, `variant` (K,), and `power` (K,)."""

    pair: NDArray[np.int32]
    variant: Indices
    power: Floats

    def sums(self, count: int) -> Floats:
        return np.bincount(self.pair[:, 1], self.power, count).astype(np.float64)


class CrossingCandidates:
    """Paths through walls, without diffraction, within `Limits`; at most two reflections at floor and ceiling."""

    name = "paths through walls"

    def __init__(
        self,
        geometry: SceneGeometry,
        room: Room,
        interior: Interior,
        settings: TraceSettings,
        materials: Materials,
        *,
        coarse: bool = False,
    ) -> None:
        self._geometry = geometry
        walls = FACES if geometry.plan.low.any() else settings.max_walls  # obstacles below a path are counted later
        limits = Limits.of(settings, walls, directed=len(room.gains.table) > 1, coarse=coarse)
        self.building = Building.of(geometry.plan, interior, room, materials, limits)
        self.lowered = Lowered.of(geometry, self.building, settings.max_walls)

    def listed(self, found: Floats) -> Iterator[Listed]:
        tree, (pair, variant, power) = self._found(found)
        yield Listed(pair[:, 1], power, partial(self._written, tree, pair, variant), 1.0)

    def _found(self, found: Floats) -> tuple[BeamTree, _Paths]:
        """List all beams and the paths that links need; paths of few reflections decide how strong others must be."""
        room, limits, count = self.building.room, self.building.limits, len(found)
        receivers, sources = bin_points(room.rx_m[:, :2]), Sources.equal(room.tx_m[None, :2], limits.reflections, 0)
        beams = Beams.first(sources.position_m, sources.more, room.gains.largest)
        tree, straight = BeamTree.of(beams), np.arange(count, dtype=np.int32)
        pair = np.stack([np.zeros_like(straight), straight], axis=1)
        listed = [self._paths(tree, pair, np.ones(count), np.zeros(count))]
        total = found + listed[0].sums(count)
        transmitted = float(self.building.materials.most_transmitted.max(initial=0.0))
        for _ in range(limits.reflections + 1):
            weakest = limits.min_power(total)
            needed = needed_of(weakest, room, self.building.materials.wavelength_m)
            task = Task(receivers, self.building, transmitted, sources._replace(needed=needed))
            beams, pair, through = follow(tree, beams, task)
            listed.append(self._paths(tree, pair, through, weakest))
            total += listed[-1].sums(count)
            tree = tree.extended(beams)
        return tree, _Paths(*(np.concatenate(column) for column in zip(*listed, strict=True)))

    def _paths(self, tree: BeamTree, pair: NDArray[np.int32], through: Floats, needed: Floats) -> _Paths:

        def of_pairs(start: int) -> Floats:
            rows = slice(start, start + _PAIRS_AT_ONCE)
            trail, some, power = trail_of(self._geometry.plan), pair[rows], np.zeros((len(pair[rows]), _VARIANTS))
            possible = np.empty(_VARIANTS, np.bool_)
            _pair_powers(tree, some, through[rows], self.building, needed, trail, possible, power)
            return power

        parts = in_order(of_pairs, range(0, len(pair), _PAIRS_AT_ONCE))
        power = np.concatenate([np.zeros((0, _VARIANTS)), *parts])
        which, variant = np.nonzero(power)
        return _Paths(pair[which], variant, power[which, variant])

    def _written(self, tree: BeamTree, pair: NDArray[np.int32], variant: Indices, rows: Indices) -> Candidates:
        pair, trail, variant = pair[rows], trail_of(self._geometry.plan), variant[rows].astype(np.int8)
        paths = WrittenPaths.empty(len(pair), len(trail.surface) + 2)
        _write_crossing(tree, pair, variant, self.building, trail, paths)
        return self.lowered(candidates_of(self._geometry, pair[:, 1], paths, opaque=False))
