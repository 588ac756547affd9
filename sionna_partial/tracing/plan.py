"""The plan that beams run in: walls that meet only at ends, the lines they lie on, and points sorted into bins."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray


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
    larger[: array.shape[0]] = array
    return larger


@njit(cache=True)
def _split_at_crossings(walls):  # type: ignore[no-untyped-def]
    """Cut segments where others cross them: the pieces (K, 2, 2), which meet only at ends, and their owners (K,)."""
    pieces, owner, count = np.empty((2 * len(walls) + 1, 2, 2)), np.empty(2 * len(walls) + 1, np.int32), 0
    cut = np.empty(len(walls) + 2)
    for i in range(len(walls)):
        ax, ay = walls[i, 1, 0] - walls[i, 0, 0], walls[i, 1, 1] - walls[i, 0, 1]
        cut[0], cut[1], cuts = 0.0, 1.0, 2
        for j in range(len(walls)):
            bx, by = walls[j, 1, 0] - walls[j, 0, 0], walls[j, 1, 1] - walls[j, 0, 1]
            cx, cy = walls[j, 0, 0] - walls[i, 0, 0], walls[j, 0, 1] - walls[i, 0, 1]
            area = ax * by - ay * bx
            if i == j or abs(area) < 1e-12:
                continue
            u, v = (cx * by - cy * bx) / area, (cx * ay - cy * ax) / area
            if 1e-9 < u < 1.0 - 1e-9 and 1e-9 < v < 1.0 - 1e-9:
                cut[cuts] = u
                cuts += 1
        places = np.sort(cut[:cuts])
        pieces, owner = grow(pieces, count + cuts), grow(owner, count + cuts)
        for k in range(cuts - 1):
            for end in range(2):
                u = places[k + end]
                pieces[count, end, 0] = walls[i, 0, 0] + u * ax if u < 1.0 else walls[i, 1, 0]
                pieces[count, end, 1] = walls[i, 0, 1] + u * ay if u < 1.0 else walls[i, 1, 1]
            owner[count] = i
            count += 1
    return pieces[:count].copy(), owner[:count].copy()


@njit(cache=True)
def _line_ids(walls):  # type: ignore[no-untyped-def]
    """Give numbers to the infinite lines that the segments lie on; collinear segments share one."""
    count = walls.shape[0]
    line = np.full(count, -1, np.int32)
    used = 0
    for i in range(count):
        if line[i] >= 0:
            continue
        line[i] = used
        px, py = walls[i, 0, 0], walls[i, 0, 1]
        dx, dy = walls[i, 1, 0] - px, walls[i, 1, 1] - py
        length = np.hypot(dx, dy)
        for j in range(i + 1, count):
            if line[j] >= 0:
                continue
            near = True
            for end in range(2):
                away = (dx * (walls[j, end, 1] - py) - dy * (walls[j, end, 0] - px)) / length
                near = near and abs(away) < 1e-6
            if near:
                line[j] = used
        used += 1
    return line
