"""The plan that beams run in: walls that meet only at ends, the lines they lie on, and points sorted into bins."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sionna_partial.planar import cross

_WALLS_AT_ONCE = 64
"""Number of walls that are cut together, which bounds the memory."""


@dataclass(frozen=True)
class Plan:
    """Walls of a floor plan, cut where they cross.

    Parameters
    ----------
    pieces_m : (K, 2, 2) float64 array
        End points of the pieces [m].
    owner, line : (K,) int32 arrays
        Wall segment that each piece is a part of, and number of the infinite line that it lies on.
    """

    pieces_m: NDArray[np.float64]
    owner: NDArray[np.int32]
    line: NDArray[np.int32]


@dataclass(frozen=True)
class PointBins:
    """Points sorted into square bins, row by row.

    Parameters
    ----------
    points_m : (N, 2) float64 array
        The points in the order of their bins [m].
    order : (N,) int64 array
        Index of each of them before sorting.
    start : (B + 1,) int64 array
        First point of each bin.
    grid : (4,) float64 array
        Corner x0 and y0 and edge of the bins [m], and number of columns.
    """

    points_m: NDArray[np.float64]
    order: NDArray[np.int64]
    start: NDArray[np.int64]
    grid: NDArray[np.float64]


def prepare_plan(walls_m: NDArray[np.float64]) -> Plan:
    """Cut walls (S, 2, 2) [m] where they cross and find collinear ones."""
    pieces_m, owner = _split_at_crossings(walls_m)
    return Plan(pieces_m, owner, _line_ids(pieces_m))


def bin_points(points_m: NDArray[np.float64]) -> PointBins:
    """Sort points (N, 2) [m] into bins of a few points each."""
    if len(points_m) == 0:
        return PointBins(points_m, np.zeros(0, np.int64), np.zeros(2, np.int64), np.array([0.0, 0.0, 1.0, 1.0]))
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    edge = max(0.05, float(np.sqrt(np.prod(high - low + 1e-3) / len(points_m))) * 2.0, float((high - low).max()) / 2000)
    columns, rows = np.floor((high - low) / edge).astype(np.int64) + 1
    cell = np.floor((points_m - low) / edge).astype(np.int64)
    index = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(index, kind="stable")
    start = np.searchsorted(index[order], np.arange(rows * columns + 1))
    return PointBins(points_m[order], order, start, np.array([low[0], low[1], edge, columns]))


@njit(cache=True)
def grow(array, size):  # type: ignore[no-untyped-def]
    """Return the array, enlarged to hold `size` rows if it does not."""
    if size <= array.shape[0]:
        return array
    larger = np.empty((max(size, 2 * array.shape[0]),) + array.shape[1:], array.dtype)  # noqa: RUF005 (numba)
    for place in np.ndindex(array.shape):
        larger[place] = array[place]
    return larger


def _split_at_crossings(walls: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Cut segments where others cross them: the pieces (K, 2, 2), which meet only at ends, and their owners (K,)."""
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    owners, places = [np.repeat(np.arange(len(walls)), 2)], [np.tile([0.0, 1.0], len(walls))]
    for first in range(0, len(walls), _WALLS_AT_ONCE):
        own = along[first : first + _WALLS_AT_ONCE, None]
        away = start - start[first : first + _WALLS_AT_ONCE, None]
        area = cross(own, along)
        area[np.abs(area) < 1e-12] = np.inf
        u, v = cross(away, along) / area, cross(away, own) / area
        crossed = (u > 1e-9) & (u < 1.0 - 1e-9) & (v > 1e-9) & (v < 1.0 - 1e-9)
        owners.append(first + np.nonzero(crossed)[0])
        places.append(u[crossed])
    owner, place = np.concatenate(owners), np.concatenate(places)
    order = np.lexsort([place, owner])
    owner, place = owner[order], place[order, None]
    ends = np.where(place < 1.0, start[owner] + place * along[owner], walls[owner, 1])
    piece = np.flatnonzero(owner[:-1] == owner[1:])
    return np.stack([ends[piece], ends[piece + 1]], axis=1), owner[piece].astype(np.int32)


def _line_ids(walls: NDArray[np.float64]) -> NDArray[np.int32]:
    """Give numbers to the infinite lines that the segments lie on; collinear segments share one."""
    line = np.full(len(walls), -1, np.int32)
    for i, (start, end) in enumerate(walls):
        if line[i] < 0:
            away = cross(end - start, walls - start) / np.hypot(*(end - start))
            line[(line < 0) & (np.abs(away) < 1e-6).all(axis=1)] = line.max() + 1
    return line
