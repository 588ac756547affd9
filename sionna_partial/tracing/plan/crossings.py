"""Candidates of floor plans that go through walls, without diffraction: which of them links need."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S
from sionna_partial.process import in_order
from sionna_partial.scene.floor_plan import bin_points
from sionna_partial.scene.scene import SceneGeometry, constants_of
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.bounds import dropped_power
from sionna_partial.tracing.candidates import Candidates
from sionna_partial.tracing.plan.crossing_beams import (
    Beams,
    Building,
    Limits,
    Task,
    first_beams,
    follow_beams,
    needed_of,
)
from sionna_partial.tracing.plan.crossing_powers import VARIANTS, Tree, pair_powers, write_paths
from sionna_partial.tracing.plan.legs import FACES, Interior, columns_of, trail_of
from sionna_partial.tracing.plan.slabs import slabs_of
from sionna_partial.tracing.plan.specular import Room

MOST_REFLECTIONS = 4
"""Most reflections at walls of a path through walls, unless all paths are asked for."""

_WEAKEST, _WEAKEST_OF_ALL = 5e-4, 1e-6
"""Paths that bring less than this fraction of a link's power are left out; the second where all are asked for."""

RARER = 0.03
"""Fraction of its power that counts of a beam with more than the usual reflections."""

_AT_ONCE = 100_000
"""Number of candidates that are written together, which bounds the memory."""

_BEAMS_AT_ONCE, _PAIRS_AT_ONCE = 256, 5_000
"""Number of beams, and of pairs, that one thread works on at a time."""


class Listed(NamedTuple):
    """Paths: `pair` (K, 2) of beam, -1 for straight lines, and receiver, `variant` (K,), and `power` (K,)."""

    pair: Indices
    variant: Indices
    power: Floats

    def sums(self, count: int) -> Floats:
        """Sum up the power of each of `count` receivers."""
        return np.bincount(self.pair[:, 1], self.power, count).astype(np.float64)


class CrossingCandidates:
    """Paths between the transmitter and the receivers of a room that go through walls, without diffraction.

    They have at most four reflections at walls, and two at floor and ceiling. Paths that bring less than 5e-4 of the
    power of their link are left out.
    """

    def __init__(self, geometry: SceneGeometry, room: Room, interior: Interior, settings: TraceSettings) -> None:
        self._geometry, self._tolerance_db = geometry, settings.power_tolerance_db
        most, rarer = (settings.max_depth, 1.0) if self._tolerance_db == 0.0 else (MOST_REFLECTIONS, RARER)
        walls = FACES if geometry.plan.low.any() else settings.max_walls  # obstacles below a path are counted later
        limits = Limits(settings.max_depth, min(settings.max_depth, most), walls, rarer)
        constants = ((*constants_of(each, settings.frequency_hz), each.thickness_m) for each in geometry.materials)
        of_piece = geometry.wall_material[geometry.plan.owner].astype(np.int64)
        slabs = slabs_of(constants, of_piece, settings.frequency_hz)
        wavelength_m = SPEED_OF_LIGHT_M_S / settings.frequency_hz
        self.building = Building(geometry.plan, interior, room, slabs, limits, wavelength_m)

    def blocks(self, found: Floats) -> Iterator[tuple[Candidates, float]]:
        """Yield the candidates that links need whose indirect paths without walls have the power `found` (N,)."""
        tree, (pair, variant, power) = self._listed(found)
        kept = power >= least_power(pair[:, 1], power, found, self._tolerance_db)[pair[:, 1]]
        pair, variant = pair[kept], variant[kept]
        for start in range(0, len(pair), _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            yield self._written(tree, pair[rows], variant[rows]), min(1.0, rows.stop / len(pair))

    def _listed(self, found: Floats) -> tuple[Tree, Listed]:
        """List all beams, and the paths that links need, by the number of their reflections.

        The paths of few reflections decide how strong those of more have to be.
        """
        room, limits, count = self.building.room, self.building.limits, len(found)
        receivers, beams = bin_points(room.rx_m[:, :2]), first_beams(room.tx_m[:2])
        tree, first = Tree(beams.parent, beams.piece, beams.window[:, :2]), 0
        straight = np.stack([np.full(count, -1), np.arange(count)], axis=1)
        listed = [self._paths(tree, straight, np.ones(count), np.zeros(count))]
        total = found + listed[0].sums(count)
        for order in range(limits.reflections + 1):
            weakest = weakest_needed(total, self._tolerance_db)
            needed = needed_of(weakest, room, self.building.wavelength_m)
            reflected, pair, through = self._followed(beams, Task(order, receivers, self.building, needed))
            new = first_of_each(beams.sequence[pair[:, 0]], pair[:, 1])
            listed.append(self._paths(tree, pair[new] + np.array([first, 0]), through[new], weakest))
            total += listed[-1].sums(count)
            first, beams = len(tree.parent), reflected._replace(parent=reflected.parent + first)
            parent, piece = np.append(tree.parent, beams.parent), np.append(tree.piece, beams.piece)
            tree = Tree(parent, piece, np.concatenate([tree.source_m, beams.window[:, :2]]))
        return tree, Listed(*(np.concatenate(column) for column in zip(*listed, strict=True)))

    def _followed(self, beams: Beams, task: Task) -> tuple[Beams, NDArray[np.int64], Floats]:
        """Follow beams: those that walls reflect, pairs (K, 2), and what walls leave of these at most (K,)."""

        def followed(first: int) -> tuple[Any, ...]:
            stop = min(first + _BEAMS_AT_ONCE, len(beams.parent))
            return follow_beams(beams, first, stop, task)  # type: ignore[no-any-return]

        nothing = (tuple(column[:0] for column in beams), np.zeros((0, 2), np.int32), np.zeros(0))
        parts = [nothing, *in_order(followed, range(0, len(beams.parent), _BEAMS_AT_ONCE))]
        children, pair, through = zip(*parts, strict=True)
        reflected = Beams(*(np.concatenate(column) for column in zip(*children, strict=True)))
        return reflected, np.concatenate(pair).astype(np.int64), np.concatenate(through)

    def _paths(self, tree: Tree, pair: NDArray[np.int64], through: Floats, needed: Floats) -> Listed:
        """Find the paths of pairs (beam, receiver) of which walls leave no more than `through` (K,)."""

        def of_pairs(start: int) -> Floats:
            rows = slice(start, start + _PAIRS_AT_ONCE)
            trail = trail_of(self._geometry.plan)
            return pair_powers(tree, pair[rows], through[rows], self.building, needed, trail)  # type: ignore[no-any-return]

        parts = in_order(of_pairs, range(0, len(pair), _PAIRS_AT_ONCE))
        power = np.concatenate([np.zeros((0, VARIANTS)), *parts])
        which, variant = np.nonzero(power)
        return Listed(pair[which], variant, power[which, variant])

    def _written(self, tree: Tree, pair: Indices, variant: Indices) -> Candidates:
        """Write some paths."""
        written = write_paths(tree, pair, variant, self.building, trail_of(self._geometry.plan))
        return Candidates(pair[:, 1].astype(np.int32), **columns_of(self._geometry, *written))


def first_of_each(first: NDArray[np.int64], second: NDArray[np.int64]) -> Indices:
    """Rows of the first of each pair of values, in their order."""
    order = np.lexsort((second, first))
    a, b = first[order], second[order]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (a[1:] != a[:-1]) | (b[1:] != b[:-1])
    return order[new]


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
