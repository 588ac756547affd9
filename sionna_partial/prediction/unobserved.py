"""How much of straight lines has not been observed: the grid integral behind d_unobs (paper, Section III-C)."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sionna_partial.constants import CellState
from sionna_partial.cores import core_count
from sionna_partial.maps.partial_map import PartialMap, alike_cells

_FREE, _WALL, _UNKNOWN = int(CellState.FREE), int(CellState.WALL), int(CellState.UNKNOWN)

GRAZE = 1e-9
"""Fraction of a line up to which a wall is only grazed: lines between grid points meet many corners, to rounding."""

_BORDER_CELLS = 1e-6
"""Distance within which a segment runs along the border of cells [cells]."""

_ALONG_CELLS = 1e-3
"""Extent along one axis below which a segment may run along the border of cells [cells]."""

_SEGMENTS_OF_CORE = 20_000
"""Number of segments that are worth another core."""


def unobserved_lengths_m(
    partial: PartialMap, start_m: NDArray[np.float64], end_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Measure the length of segments inside unknown cells, exact to rounding.

    Everything outside the grid is unknown. On a complete map nothing unknown can be reached from a known cell, and the
    length of a segment that has an end in one is 0 by definition. A segment along the border of cells is in the freest
    of them, as in `PartialMap.state_at`.

    Parameters
    ----------
    partial : PartialMap
    start_m, end_m : (N, 3) float64 arrays
        Ends of the segments [m]; one may be (3,).

    Returns
    -------
    (N,) float64 array
        Between 0 and the lengths of the segments [m].
    """
    start_m, end_m = np.broadcast_arrays(start_m, end_m)
    lengths_m, open_ended = np.zeros(len(end_m)), ~is_enclosed(partial, start_m, end_m)
    start_m, end_m = start_m[open_ended], end_m[open_ended]
    shares = map_line_shares(partial, in_cells(partial, start_m), in_cells(partial, end_m))[:, CellState.UNKNOWN]
    lengths_m[open_ended] = shares * np.linalg.norm(end_m - start_m, axis=1)
    return lengths_m


def is_enclosed(partial: PartialMap, start_m: NDArray[np.float64], end_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether a complete map holds at least one end of each link (N,), so that nothing unknown is on its way."""
    if not partial.is_complete:
        return np.zeros(len(end_m), dtype=bool)
    known = (partial.state_at(points_m) != CellState.UNKNOWN for points_m in (start_m, end_m))
    enclosed: NDArray[np.bool_] = np.logical_or(*known)
    return enclosed


def walled_lengths_m(
    partial: PartialMap, start_m: NDArray[np.float64], end_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Measure the length of segments inside cells of known walls, exact to rounding.

    Nothing outside the grid is a known wall. A segment along the border of cells is in a wall if all of them are.

    Parameters
    ----------
    partial : PartialMap
    start_m, end_m : (N, 3) float64 arrays
        Ends of the segments [m]; one may be (3,).

    Returns
    -------
    (N,) float64 array
        Between 0 and the lengths of the segments [m].
    """
    start_m, end_m = np.broadcast_arrays(start_m, end_m)
    shares = map_line_shares(partial, in_cells(partial, start_m), in_cells(partial, end_m))[:, CellState.WALL]
    return shares * np.linalg.norm(end_m - start_m, axis=1)


def in_cells(partial: PartialMap, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x and y of points (..., 2 or 3) [m] in cells of a map's grid, rounded to 1e-6: borders are met exactly."""
    return np.round((points_m[..., :2] - partial.origin_m) / partial.resolution_m, 6)


def map_line_shares(partial: PartialMap, starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `line_shares` on the cells of a map."""
    return _shares(partial.state, partial.alike_cells, starts, ends)


def line_shares(
    state: NDArray[np.uint8], starts: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the fractions (N, 3), in [0, 1], of segments from `starts` to `ends` (N, 2) [cells] in each CellState.

    All cells outside the grid are unknown.
    """
    return _shares(state, alike_cells(state), starts, ends)


def _shares(
    state: NDArray[np.uint8], alike: NDArray[np.int32], starts: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    shares = np.zeros((len(ends), len(CellState)))
    bounds = np.linspace(0, len(ends), 1 + min(core_count(), 1 + len(ends) // _SEGMENTS_OF_CORE))
    blocks = [slice(int(low), int(high)) for low, high in itertools.pairwise(bounds)]

    def fill(block: slice) -> None:
        _fill_shares(state, alike, starts[block], ends[block], shares[block])

    if len(blocks) == 1:
        fill(blocks[0])
    else:
        with ThreadPoolExecutor(len(blocks)) as pool:
            list(pool.map(fill, blocks))
    return np.clip(shares, 0.0, 1.0)


@njit(cache=True, nogil=True)
def _fill_shares(
    state: NDArray[np.uint8],
    alike: NDArray[np.int32],
    starts: NDArray[np.float64],
    ends: NDArray[np.float64],
    shares: NDArray[np.float64],
) -> None:
    """Add the shares of segments in cells of each state to `shares` (N, 3)."""
    for i in range(len(ends)):
        start_x, start_y = starts[i, 0], starts[i, 1]
        step_x, step_y = ends[i, 0] - start_x, ends[i, 1] - start_y
        if min(abs(step_x), abs(step_y)) < _ALONG_CELLS:
            _add_along_axis(state, start_x, start_y, step_x, step_y, shares[i])
        else:
            _add_across(state, alike, start_x, start_y, step_x, step_y, shares[i])


@njit(cache=True)
def _add_across(
    state: NDArray[np.uint8],
    alike: NDArray[np.int32],
    start_x: float,
    start_y: float,
    step_x: float,
    step_y: float,
    shares: NDArray[np.float64],
) -> None:
    """Add the shares of a segment that runs along no border of cells.

    The grid is walked from line to line (Amanatides and Woo 1987), and over cells that are all alike at once. The
    distance to each line is computed afresh, so that rounding does not add up.
    """
    ny, nx = state.shape
    here, leave = _inside_grid(state, start_x, start_y, step_x, step_y, shares)
    turn_x, turn_y = (1 if step_x > 0.0 else -1), (1 if step_y > 0.0 else -1)
    pace_x, pace_y = 1.0 / step_x, 1.0 / step_y
    line_x = int(first_line(start_x + here * step_x, step_x))
    line_y = int(first_line(start_y + here * step_y, step_y))
    while here < leave:
        column = line_x - 1 if turn_x > 0 else line_x
        row = line_y - 1 if turn_y > 0 else line_y
        within = 0 <= row < ny and 0 <= column < nx
        over = alike[row, column] if within else 0
        reach_x = (line_x + turn_x * over - start_x) * pace_x
        reach_y = (line_y + turn_y * over - start_y) * pace_y
        there = min(max(here, min(reach_x, reach_y)), leave)
        shares[state[row, column] if within else _UNKNOWN] += there - here
        if reach_x <= there:
            line_x += turn_x * (over + 1)
        elif over:
            line_x = int(first_line(start_x + there * step_x, step_x))
        if reach_y <= there:
            line_y += turn_y * (over + 1)
        elif over:
            line_y = int(first_line(start_y + there * step_y, step_y))
        here = there


@njit(cache=True)
def _add_along_axis(
    state: NDArray[np.uint8], start_x: float, start_y: float, step_x: float, step_y: float, shares: NDArray[np.float64]
) -> None:
    """Add the shares of a segment along an axis, which may run along the border of cells for a while."""
    here, leave = _inside_grid(state, start_x, start_y, step_x, step_y, shares)
    line_x = first_line(start_x + here * step_x, step_x)
    line_y = first_line(start_y + here * step_y, step_y)
    while here < leave:
        reach_x = (line_x - start_x) / step_x if step_x != 0.0 else np.inf
        reach_y = (line_y - start_y) / step_y if step_y != 0.0 else np.inf
        there = min(max(here, min(reach_x, reach_y)), leave)
        middle = 0.5 * (here + there)
        shares[_freest(state, start_x + middle * step_x, start_y + middle * step_y)] += there - here
        if reach_x <= there:
            line_x += np.sign(step_x)
        if reach_y <= there:
            line_y += np.sign(step_y)
        here = there


@njit(cache=True)
def _inside_grid(
    state: NDArray[np.uint8], start_x: float, start_y: float, step_x: float, step_y: float, shares: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the shares of a segment at which it enters and leaves the grid, and add that outside as unknown."""
    ny, nx = state.shape
    enter_x, leave_x = shares_inside(start_x, step_x, nx)
    enter_y, leave_y = shares_inside(start_y, step_y, ny)
    enter, leave = max(enter_x, enter_y), min(leave_x, leave_y)
    shares[_UNKNOWN] += 1.0 - max(0.0, leave - enter)
    return enter, leave


@njit(cache=True)
def shares_inside(start: float, step: float, size: int) -> tuple[float, float]:
    """Return the shares of a segment at which it enters and leaves [0, size] along one axis; enter > leave if never."""
    if step == 0.0:
        return (0.0, 1.0) if 0.0 <= start <= size else (1.0, 0.0)
    low, high = -start / step, (size - start) / step
    return max(0.0, min(low, high)), min(1.0, max(low, high))


@njit(cache=True)
def first_line(place: float, step: float) -> float:
    """Return the first grid line that is met from `place` in the direction of `step`."""
    return np.floor(place) + 1.0 if step > 0.0 else np.ceil(place) - 1.0


@njit(cache=True)
def _freest(state: NDArray[np.uint8], x: float, y: float) -> int:
    """Return the state of the freest cell within 1e-6 cells of a point [cells]: FREE before UNKNOWN before WALL."""
    ny, nx = state.shape
    row, column = int(np.floor(y)), int(np.floor(x))
    deep_x = _BORDER_CELLS < x - column < 1.0 - _BORDER_CELLS
    deep_y = _BORDER_CELLS < y - row < 1.0 - _BORDER_CELLS
    if deep_x and deep_y and 0 <= row < ny and 0 <= column < nx:
        return int(state[row, column])
    found = _WALL
    for row in range(int(np.floor(y - _BORDER_CELLS)), int(np.floor(y + _BORDER_CELLS)) + 1):
        for column in range(int(np.floor(x - _BORDER_CELLS)), int(np.floor(x + _BORDER_CELLS)) + 1):
            cell = state[row, column] if 0 <= row < ny and 0 <= column < nx else _UNKNOWN
            if cell == _FREE:
                return _FREE
            if cell == _UNKNOWN:
                found = _UNKNOWN
    return found
