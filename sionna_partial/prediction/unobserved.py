"""Straight lines on the cells of a map: d_unobs (paper, Section III-C)."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices, States
from sionna_partial.constants import CellState
from sionna_partial.maps.environment import uniform_cells
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.process import core_count, in_order, njit
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import SEEN_M

_FREE, _WALL, _UNKNOWN = int(CellState.FREE), int(CellState.WALL), int(CellState.UNKNOWN)

GRAZE = 1e-9
"""Fraction of a line up to which cells are only grazed: lines between grid points meet corners, up to rounding."""

_BORDER_CELLS = 1e-6
"""Distance within which a segment follows the border of cells [cells]."""

_ALONG_CELLS = 1e-3
"""Extent along one axis below which a segment may follow the border of cells [cells]."""

_SEGMENTS_PER_CORE = 20_000


def unobserved_lengths_m(partial: PartialMap, start_m: Floats, end_m: Floats) -> Floats:
    """Return the lengths (N,) of segments in unknown cells [m], exact up to rounding; ends are (N, 3) or (3,) [m].

    The outside of the grid is unknown. On a complete map, a segment with an end in a known cell has the length 0. A
    segment along the border of cells is in the freest of them.
    """
    start_m, end_m = np.broadcast_arrays(start_m, end_m)
    lengths_m, open_ended = np.zeros(len(end_m)), ~is_enclosed(partial, start_m, end_m)
    lengths_m[open_ended] = lengths_in_unknown_m(partial, start_m[open_ended], end_m[open_ended])
    return lengths_m


def lengths_in_unknown_m(partial: PartialMap, start_m: Floats, end_m: Floats) -> Floats:
    return _lengths_m(partial, CellState.UNKNOWN, start_m, end_m)


def walled_lengths_m(partial: PartialMap, start_m: Floats, end_m: Floats) -> Floats:
    """Return the lengths (N,) of segments in known wall cells, below the walls' tops [m]; ends are (N, 3) or (3,) [m].

    Outside the grid there is no known wall. A segment along the border of cells is in a wall if all of them are.
    """
    start_m, end_m = np.broadcast_arrays(start_m, end_m)
    lengths_m = np.zeros(len(end_m))
    for walls, rows, *ends_m in parts_at_walls(partial, start_m, end_m):
        lengths_m[rows] += _lengths_m(walls, CellState.WALL, *ends_m)
    return lengths_m


def parts_at_walls(
    partial: PartialMap, start_m: Floats, end_m: Floats
) -> Iterator[tuple[PartialMap, Indices, Floats, Floats]]:
    """Yield, by height of walls, a map with these walls only, the segments (N,) below their top, and their parts."""
    for top_m, walls in partial.wall_levels:
        low, high = np.minimum(start_m[:, 2], end_m[:, 2]), np.maximum(start_m[:, 2], end_m[:, 2])
        rows = np.flatnonzero(low < top_m)
        part = np.clip((top_m - low[rows]) / np.maximum(high - low, 1e-12)[rows], 0.0, 1.0)[:, None]
        start, end = start_m[rows], end_m[rows]
        rises = start[:, 2:] <= end[:, 2:]
        above = part < 1.0
        ends = np.where(above & rises, start + part * (end - start), end)
        yield walls, rows, np.where(above & ~rises, end + part * (start - end), start), ends


def _lengths_m(partial: PartialMap, kind: CellState, start_m: Floats, end_m: Floats) -> Floats:
    fractions = map_line_fractions(partial, in_cells(partial, start_m), in_cells(partial, end_m))[:, kind]
    lengths_m: Floats = np.where(fractions > GRAZE, fractions, 0.0) * np.linalg.norm(end_m - start_m, axis=1)
    return lengths_m


def is_enclosed(partial: PartialMap, start_m: Floats, end_m: Floats) -> Bools:
    """Return whether links (N,) meet nothing unknown: the map is complete and at least one end is known."""
    if not partial.is_complete:
        return np.zeros(len(end_m), dtype=bool)
    known = (partial.state_at(points_m) != CellState.UNKNOWN for points_m in (start_m, end_m))
    enclosed: Bools = np.logical_or(*known)
    return enclosed


def in_cells(partial: PartialMap, points_m: Floats) -> Floats:
    """Return x and y of points (..., 2 or 3) [m] in cells, rounded to 1e-6, so that borders are met exactly."""
    return np.round((points_m[..., :2] - partial.origin_m) / partial.resolution_m, 6)


def map_line_fractions(partial: PartialMap, starts: Floats, ends: Floats) -> Floats:
    return line_fractions(partial.state, starts, ends, partial.uniform_cells)


def line_fractions(state: States, starts: Floats, ends: Floats, uniform: NDArray[np.int32] | None = None) -> Floats:
    """Return the fractions (N, 3) of segments from `starts` to `ends` (N, 2) [cells] in each CellState."""
    uniform = uniform_cells(state) if uniform is None else uniform
    fractions = np.zeros((len(ends), len(CellState)))
    bounds = np.linspace(0, len(ends), 1 + min(core_count(), 1 + len(ends) // _SEGMENTS_PER_CORE)).astype(int)

    def fill(block: slice) -> None:
        _fill_fractions(state, uniform, starts[block], ends[block], fractions[block])

    blocks = itertools.starmap(slice, itertools.pairwise(bounds))
    for _ in map(fill, blocks) if len(bounds) == 2 else in_order(fill, blocks):
        pass
    return np.clip(fractions, 0.0, 1.0)


class Segment(NamedTuple):
    """Segment in the plane: start, extent along each axis, and its inverse [cells]."""

    x: float
    y: float
    step_x: float
    step_y: float
    pace_x: float
    pace_y: float


@njit(cache=True)
def segment_between(x: float, y: float, end_x: float, end_y: float) -> Segment:
    step_x, step_y = end_x - x, end_y - y
    pace_x = 1.0 / step_x if step_x != 0.0 else np.inf
    pace_y = 1.0 / step_y if step_y != 0.0 else np.inf
    return Segment(x, y, step_x, step_y, pace_x, pace_y)


@njit(cache=True)
def enter_grid(segment: Segment, ny: int, nx: int) -> tuple[float, float, int, int]:
    """Return the fractions at which a segment enters and leaves a grid, and the first x and y lines inside."""
    enter_x, leave_x = _enter_axis(segment.x, segment.step_x, nx)
    enter_y, leave_y = _enter_axis(segment.y, segment.step_y, ny)
    enter, leave = max(enter_x, enter_y), min(leave_x, leave_y)
    line_x = _first_line(segment.x + enter * segment.step_x, segment.step_x)
    line_y = _first_line(segment.y + enter * segment.step_y, segment.step_y)
    return enter, leave, line_x, line_y


@njit(cache=True)
def leave_cells(
    segment: Segment, line_x: int, line_y: int, skip: int, here: float, leave: float
) -> tuple[float, int, int]:
    """Walk from fraction `here` out of a cell and `skip` cells around it (Amanatides and Woo 1987).

    Return the fraction reached, at most `leave`, and the next x and y lines. Distances are computed afresh, so that
    rounding errors do not add up.
    """
    turn_x, turn_y = (1 if segment.step_x > 0.0 else -1), (1 if segment.step_y > 0.0 else -1)
    at_x = (line_x + turn_x * skip - segment.x) * segment.pace_x if segment.step_x != 0.0 else np.inf
    at_y = (line_y + turn_y * skip - segment.y) * segment.pace_y if segment.step_y != 0.0 else np.inf
    there = min(max(here, min(at_x, at_y)), leave)
    if at_x <= there:
        line_x += turn_x * (skip + 1)
    elif skip:
        line_x = _first_line(segment.x + there * segment.step_x, segment.step_x)
    if at_y <= there:
        line_y += turn_y * (skip + 1)
    elif skip:
        line_y = _first_line(segment.y + there * segment.step_y, segment.step_y)
    return there, line_x, line_y


@njit(cache=True, nogil=True)
def _fill_fractions(state: States, uniform: NDArray[np.int32], starts: Floats, ends: Floats, fractions: Floats) -> None:
    ny, nx = state.shape
    for i in range(len(ends)):
        segment = segment_between(starts[i, 0], starts[i, 1], ends[i, 0], ends[i, 1])
        along = min(abs(segment.step_x), abs(segment.step_y)) < _ALONG_CELLS
        here, leave, line_x, line_y = enter_grid(segment, ny, nx)
        fractions[i, _UNKNOWN] += 1.0 - max(0.0, leave - here)
        while here < leave:
            column = line_x - 1 if segment.step_x > 0.0 else line_x
            row = line_y - 1 if segment.step_y > 0.0 else line_y
            within = 0 <= row < ny and 0 <= column < nx
            skip = uniform[row, column] if within and not along else 0
            there, line_x, line_y = leave_cells(segment, line_x, line_y, skip, here, leave)
            if along:
                middle = 0.5 * (here + there)
                kind = _freest(state, segment.x + middle * segment.step_x, segment.y + middle * segment.step_y)
            else:
                kind = state[row, column] if within else _UNKNOWN
            fractions[i, kind] += there - here
            here = there


@njit(cache=True)
def _enter_axis(start: float, step: float, size: int) -> tuple[float, float]:
    """Return the fractions at which a segment enters and leaves [0, size] on one axis; enter > leave if never."""
    if step == 0.0:
        return (0.0, 1.0) if 0.0 <= start <= size else (1.0, 0.0)
    low, high = -start / step, (size - start) / step
    return max(0.0, min(low, high)), min(1.0, max(low, high))


@njit(cache=True)
def _first_line(position: float, step: float) -> int:
    return int(np.floor(position)) + 1 if step > 0.0 else int(np.ceil(position)) - 1


@njit(cache=True)
def _freest(state: States, x: float, y: float) -> int:
    """Return the freest cell state within 1e-6 cells of a point: FREE before UNKNOWN before WALL."""
    ny, nx = state.shape
    found = _WALL
    for row in range(int(np.floor(y - _BORDER_CELLS)), int(np.floor(y + _BORDER_CELLS)) + 1):
        for column in range(int(np.floor(x - _BORDER_CELLS)), int(np.floor(x + _BORDER_CELLS)) + 1):
            cell = state[row, column] if 0 <= row < ny and 0 <= column < nx else _UNKNOWN
            if cell == _FREE:
                return _FREE
            if cell == _UNKNOWN:
                found = _UNKNOWN
    return found


def centred_grid(known: Indices, cells: float, border_cells: float, multiple: int) -> tuple[tuple[int, int], Floats]:
    """Return the shape of a grid of coarse cells around the known ones, and its first corner (row, column) [map cells].

    It is centred on the mean of the indices `known` (K, 2), which one more cell hardly moves. An edge of a coarse cell
    has `cells` map cells, and half a side of the grid a multiple of `multiple` coarse ones.
    """
    ends = (known.min(axis=0), known.max(axis=0) + 1) if len(known) else (np.zeros(2), np.zeros(2))
    centre = known.mean(axis=0) + 0.5 if len(known) else np.zeros(2)
    half = np.maximum(centre - ends[0], ends[1] - centre) / cells + border_cells
    half_counts = np.ceil(np.round(half / multiple, 6)).astype(int) * multiple
    ny, nx = (2 * half_counts).tolist()
    return (ny, nx), centre - half_counts * cells


def overlaps(edges: Floats, count: int) -> Floats:
    """Return the fractions (K, count) of intervals between `edges` (K + 1,) covered by unit cells."""
    cells = np.arange(count)
    low, high = np.maximum(edges[:-1, None], cells), np.minimum(edges[1:, None], cells + 1)
    return np.maximum(high - low, 0.0) / np.diff(edges)[:, None]


def path_unobserved_m(
    partial: PartialMap, start_m: Floats, interactions: NDArray[np.uint8], vertices_m: Floats, end_m: Floats
) -> Floats:
    """Return the length (P,) of paths in unknown cells [m]; 0 for links that a complete map encloses.

    Paths lead from `start_m` (P, 3) by `vertices_m` (P, D, 3), where `interactions` (P, D) is not 0, to `end_m` (P, 3).
    """
    total_m = np.zeros(len(start_m))
    rows = np.flatnonzero(~is_enclosed(partial, start_m, end_m))
    here_m = start_m[rows]
    for depth in range(interactions.shape[1] if len(rows) else 0):
        there = interactions[rows, depth] > 0
        there_m = vertices_m[rows[there], depth]
        total_m[rows[there]] += lengths_in_unknown_m(partial, here_m[there], there_m)
        here_m[there] = there_m
    total_m[rows] += lengths_in_unknown_m(partial, here_m, end_m[rows])
    return total_m


def traced_unobserved_m(partial: PartialMap, links: TracedLinks, paths: Indices) -> Floats:
    tx_m, rx_m = links.tx.reshape(-1, 3)[links.path_tx[paths]], links.rx[links.path_rx[paths]]
    return path_unobserved_m(partial, tx_m, links.interactions[paths], links.vertices_m[paths], rx_m)


def attenuation(unobserved_m: Floats, length_m: float) -> Floats:
    return np.exp(-unobserved_m / length_m) if length_m > 0.0 else (unobserved_m < SEEN_M).astype(np.float64)
