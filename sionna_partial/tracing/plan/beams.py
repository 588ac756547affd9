"""Beams of a floor plan: sequences of walls that can reflect a path, and the receivers that they reach.

The search has two dimensions. The image S of the transmitter and a window from A to B bound a beam, in which points
have coordinates t and 1 / r (docs/physics.md, Images and beams).

`follow` takes the beams of one number of reflections to the next: between opaque walls (`Limits.walls` is 0) by
`views.py`, where the nearest wall reflects, and every sequence is listed, as `select.py` needs the sum of all bounds;
through walls by `layers.py`, where beams end that are too weak for every receiver. For opaque walls, the second would
be slower.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import sionna_partial.tracing.plan.layers as layers
import sionna_partial.tracing.plan.views as views
from sionna_partial.arrays import Floats
from sionna_partial.process import in_order
from sionna_partial.scene.outlines import PointBins
from sionna_partial.tracing.plan.clipping import Children, Clipped
from sionna_partial.tracing.plan.room import Building, Room
from sionna_partial.tracing.select import needs_by_distance

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
    and the ends of the window [m]. `reflected` and `left` (M,) bound the fractions of power after reflections and after
    walls, `crossed` (M,) is the smallest number of walls, `more` (M,) the largest number of further reflections,
    `origin` (M,) the number of the source, `sequence` (M,) numbers the sequences of lines. A path with the azimuth a at
    its end leaves the source at the azimuth `turn_rad` (M,) + a, or - a after an odd number of reflections.
    """

    parent: NDArray[np.int32]
    piece: NDArray[np.int32]
    window: Floats
    reflected: Floats
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
        none, reflected, left = np.full(count, -1, np.int32), np.full(count, power), np.ones(count)
        crossed, reflections = np.zeros(count, np.int32), np.repeat(more, 4).astype(np.int32)
        origin = np.arange(count) // 4
        fields = none, none, windows_m, reflected, left, crossed, reflections, origin, np.zeros(count), origin
        return cls(*fields, 0)


class Task(NamedTuple):
    """Inputs for beams; walls transmit the fraction `most_transmitted` at most."""

    receivers: PointBins
    building: Building
    most_transmitted: float
    sources: Sources


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
    plan, count, before = task.building.plan, len(beams.parent), len(tree.parent) - len(beams.parent)

    def through(first: int) -> tuple[Any, ...]:
        stop, scratch = min(first + _BEAMS_AT_ONCE, count), layers.Layers.of(plan)
        return _cut(*layers.follow_through(beams, before, first, stop, task, scratch, layers.Output.empty()))

    if task.building.limits.walls:
        found = list(in_order(through, range(0, count, _BEAMS_AT_ONCE)))
    else:
        inputs = plan, views.Mirrors.of(task.building), task.receivers, task.sources
        found = [_cut(*views.follow_opaque(beams, before, *inputs, Clipped.of(plan), views.Output.empty()))]
    children, pair, bound = zip(
        _cut(Children.empty(), 0, np.zeros((0, 2), np.int32), np.zeros(0), 0), *found, strict=True
    )
    columns: list[Any] = [np.concatenate(column) for column in zip(*children, strict=True)]
    above, line, lines = columns[0] - before, plan.line[columns[1]], int(plan.line.max(initial=0)) + 1
    _, sequence = np.unique(beams.sequence[above] * lines + line, return_inverse=True)
    along = plan.pieces_m[columns[1], 1] - plan.pieces_m[columns[1], 0]
    twice = 2.0 * (-1.0) ** beams.reflections * np.arctan2(along[:, 1], along[:, 0])
    turn_rad = (beams.turn_rad[above] + twice) % (2.0 * math.pi)
    pairs, receivers = np.concatenate(pair), max(1, len(task.receivers.order))
    _, once = np.unique(beams.sequence[pairs[:, 0] - before] * receivers + pairs[:, 1], return_index=True)
    columns += [beams.origin[above], turn_rad, sequence, beams.reflections + 1]
    return Beams(*columns), pairs[once], np.concatenate(bound)[once]


def _cut(children: Children, count: int, pair: NDArray[np.int32], bound: Floats, used: int) -> tuple[Any, ...]:
    return [column[:count] for column in children], pair[:used], bound[:used]
