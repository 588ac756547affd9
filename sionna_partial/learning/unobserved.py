"""How much of straight lines has not been observed: the grid integral behind d_unobs (paper, Section III-C)."""

import itertools
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap

_FREE, _UNKNOWN = int(CellState.FREE), int(CellState.UNKNOWN)

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

    Everything outside the grid is unknown. On a complete map nothing unknown can be reached, and the length is 0 by
    definition. A segment along the border of cells is in the freest of them, as in `PartialMap.state_at`.

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
    if partial.is_complete:
        return np.zeros(len(end_m))
    shares = unknown_shares(partial.state, in_cells(partial, start_m), in_cells(partial, end_m))
    return shares * np.linalg.norm(end_m - start_m, axis=1)


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
    shares = wall_shares(partial.state, in_cells(partial, start_m), in_cells(partial, end_m))
    return shares * np.linalg.norm(end_m - start_m, axis=1)


def in_cells(partial: PartialMap, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x and y of points (..., 2 or 3) [m] in cells of a map's grid, rounded to 1e-6: borders are met exactly."""
    return np.round((points_m[..., :2] - partial.origin_m) / partial.resolution_m, 6)


def unknown_shares(
    state: NDArray[np.uint8], starts: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shares (N,), in [0, 1], of the segments from `starts` to `ends` (N, 2) [cells] that are unknown."""
    return _shares(state, _UNKNOWN, starts, ends)


def wall_shares(
    state: NDArray[np.uint8], starts: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shares (N,), in [0, 1], of the segments from `starts` to `ends` (N, 2) [cells] in known walls."""
    walls = np.where(state == CellState.WALL, CellState.UNKNOWN, CellState.FREE).astype(np.uint8)
    return _shares(walls, _FREE, starts, ends)


def _shares(
    state: NDArray[np.uint8], outside: int, starts: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shares of segments that are unknown, where all cells outside the grid are in one state."""
    shares, alike = np.empty(len(ends)), _alike_cells(state == _UNKNOWN)
    bounds = np.linspace(0, len(ends), 1 + min(len(os.sched_getaffinity(0)), 1 + len(ends) // _SEGMENTS_OF_CORE))
    blocks = [slice(int(low), int(high)) for low, high in itertools.pairwise(bounds)]

    def fill(block: slice) -> None:
        _fill_shares(state, alike, outside, starts[block], ends[block], shares[block])

    if len(blocks) == 1:
        fill(blocks[0])
    else:
        with ThreadPoolExecutor(len(blocks)) as pool:
            list(pool.map(fill, blocks))
    return shares


def _alike_cells(unknown: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return how many cells in every direction, corners included, are unknown or known as the cell is."""
    alike = np.full(unknown.shape, max(unknown.shape), dtype=np.int32)
    for kind in (unknown, ~unknown):
        if not kind.all():
            alike[kind] = ndimage.distance_transform_cdt(kind, "chessboard")[kind] - 1
    return alike


@njit(cache=True, nogil=True)
def _fill_shares(
    state: NDArray[np.uint8],
    alike: NDArray[np.int32],
    outside: int,
    starts: NDArray[np.float64],
    ends: NDArray[np.float64],
    shares: NDArray[np.float64],
) -> None:
    for i in range(len(ends)):
        start_x, start_y = starts[i, 0], starts[i, 1]
        step_x, step_y = ends[i, 0] - start_x, ends[i, 1] - start_y
        if min(abs(step_x), abs(step_y)) < _ALONG_CELLS:
            shares[i] = _share_along_axis(state, outside, start_x, start_y, step_x, step_y)
        else:
            shares[i] = _share_across(state, alike, outside, start_x, start_y, step_x, step_y)


@njit(cache=True)
def _share_across(
    state: NDArray[np.uint8],
    alike: NDArray[np.int32],
    outside: int,
    start_x: float,
    start_y: float,
    step_x: float,
    step_y: float,
) -> float:
    """Return the share of a segment that is unknown, where it runs along no border of cells.

    The grid is walked from line to line (Amanatides and Woo 1987), and over cells that are all alike at once. The
    distance to each line is computed afresh, so that rounding does not add up.
    """
    ny, nx = state.shape
    here, leave, share = _inside_grid(state, outside, start_x, start_y, step_x, step_y)
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
        if (state[row, column] if within else outside) == _UNKNOWN:
            share += there - here
        if reach_x <= there:
            line_x += turn_x * (over + 1)
        elif over:
            line_x = int(first_line(start_x + there * step_x, step_x))
        if reach_y <= there:
            line_y += turn_y * (over + 1)
        elif over:
            line_y = int(first_line(start_y + there * step_y, step_y))
        here = there
    return min(max(share, 0.0), 1.0)


@njit(cache=True)
def _share_along_axis(
    state: NDArray[np.uint8], outside: int, start_x: float, start_y: float, step_x: float, step_y: float
) -> float:
    """Return the share of a segment along an axis that is unknown: it may run along the border of cells for a while."""
    here, leave, share = _inside_grid(state, outside, start_x, start_y, step_x, step_y)
    line_x = first_line(start_x + here * step_x, step_x)
    line_y = first_line(start_y + here * step_y, step_y)
    while here < leave:
        reach_x = (line_x - start_x) / step_x if step_x != 0.0 else np.inf
        reach_y = (line_y - start_y) / step_y if step_y != 0.0 else np.inf
        there = min(max(here, min(reach_x, reach_y)), leave)
        middle = 0.5 * (here + there)
        if _is_unknown(state, outside, start_x + middle * step_x, start_y + middle * step_y):
            share += there - here
        if reach_x <= there:
            line_x += np.sign(step_x)
        if reach_y <= there:
            line_y += np.sign(step_y)
        here = there
    return min(max(share, 0.0), 1.0)


@njit(cache=True)
def _inside_grid(
    state: NDArray[np.uint8], outside: int, start_x: float, start_y: float, step_x: float, step_y: float
) -> tuple[float, float, float]:
    """Return the shares of a segment at which it enters and leaves the grid, and the unknown share of it outside."""
    ny, nx = state.shape
    enter_x, leave_x = shares_inside(start_x, step_x, nx)
    enter_y, leave_y = shares_inside(start_y, step_y, ny)
    enter, leave = max(enter_x, enter_y), min(leave_x, leave_y)
    return enter, leave, (1.0 - max(0.0, leave - enter) if outside == _UNKNOWN else 0.0)


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
def _is_unknown(state: NDArray[np.uint8], outside: int, x: float, y: float) -> bool:
    """Whether the freest cell within 1e-6 cells of a point [cells] is unknown."""
    ny, nx = state.shape
    row, column = int(np.floor(y)), int(np.floor(x))
    deep_x = _BORDER_CELLS < x - column < 1.0 - _BORDER_CELLS
    deep_y = _BORDER_CELLS < y - row < 1.0 - _BORDER_CELLS
    if deep_x and deep_y and 0 <= row < ny and 0 <= column < nx:
        return state[row, column] == _UNKNOWN
    found = False
    for row in range(int(np.floor(y - _BORDER_CELLS)), int(np.floor(y + _BORDER_CELLS)) + 1):
        for column in range(int(np.floor(x - _BORDER_CELLS)), int(np.floor(x + _BORDER_CELLS)) + 1):
            within = 0 <= row < ny and 0 <= column < nx
            cell = state[row, column] if within else outside
            if cell == _FREE:
                return False
            found |= cell == _UNKNOWN
    return found
