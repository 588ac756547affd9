"""The plan that beams run in: walls that meet only at ends, the lines they lie on, and points sorted into bins."""

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats, cross, span_in_strip
from sionna_partial.process import njit

_SAME_LINE_M = 1e-6
"""Distance from a line within which the ends of collinear walls lie [m]."""

_WALLS_PER_CELL = 4.0
"""Number of wall pieces in a cell of the index, on average over the cells that hold any."""


class WallIndex(NamedTuple):
    """Square cells over a plan, row by row, and the wall pieces that may cross each.

    `grid` (5,) is the corner x0 and y0 and the edge of the cells [m], and the numbers of columns and rows. The pieces
    of a cell are `piece` (E,) from `start` (B + 1,) of the cell to `start` of the next.
    """

    grid: Floats
    start: NDArray[np.int64]
    piece: NDArray[np.int32]


class Plan(NamedTuple):
    """Walls of a floor plan, cut where they cross.

    `pieces_m` (K, 2, 2) are the end points of the pieces [m], `owner` (K,) the wall segments that they are parts of,
    `line` (K,) the numbers of the infinite lines that they lie on, and `low` (K,) whether they end below the ceiling.
    """

    pieces_m: Floats
    owner: NDArray[np.int32]
    line: NDArray[np.int32]
    low: Bools
    cells: WallIndex


class PointBins(NamedTuple):
    """Points (N, 2) [m] sorted into square bins, row by row.

    `order` (N,) is the index of each of them before sorting, `start` (B + 1,) the first point of each bin; `grid` (4,)
    the corner x0 and y0 and the edge of the bins [m], and the number of columns.
    """

    points_m: Floats
    order: NDArray[np.int64]
    start: NDArray[np.int64]
    grid: Floats


def prepare_plan(walls_m: Floats, low: Bools | None = None) -> Plan:
    """Cut walls (S, 2, 2) [m], of which some may be `low` (S,), where they cross, and find collinear ones."""
    pieces_m, owner = _split_at_crossings(walls_m)
    low = np.zeros(len(walls_m), dtype=np.bool_) if low is None else low
    return Plan(pieces_m, owner, _line_ids(pieces_m), low[owner], _index(pieces_m))


def bin_points(points_m: Floats) -> PointBins:
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
    for index in np.ndindex(array.shape):
        larger[index] = array[index]
    return larger


def _split_at_crossings(walls: Floats) -> tuple[Floats, NDArray[np.int32]]:
    """Cut segments where others cross them: the pieces (K, 2, 2), which meet only at ends, and their owners (K,)."""
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    lines = shapely.linestrings(walls)
    own, other = shapely.STRtree(lines).query(lines, predicate="intersects")
    area = cross(along[own], along[other])
    area[np.abs(area) < 1e-12] = np.inf
    away = start[other] - start[own]
    u, v = cross(away, along[other]) / area, cross(away, along[own]) / area
    crossed = (u > 1e-9) & (u < 1.0 - 1e-9) & (v > 1e-9) & (v < 1.0 - 1e-9)
    owner = np.concatenate([np.repeat(np.arange(len(walls)), 2), own[crossed]])
    fraction = np.concatenate([np.tile([0.0, 1.0], len(walls)), u[crossed]])
    order = np.lexsort([fraction, owner])
    owner, fraction = owner[order], fraction[order, None]
    ends = np.where(fraction < 1.0, start[owner] + fraction * along[owner], walls[owner, 1])
    piece = np.flatnonzero(owner[:-1] == owner[1:])
    return np.stack([ends[piece], ends[piece + 1]], axis=1), owner[piece].astype(np.int32)


def _line_ids(walls: Floats) -> NDArray[np.int32]:
    """Give numbers to the infinite lines that the segments lie on; collinear segments share one."""
    if len(walls) == 0:
        return np.zeros(0, np.int32)
    along = walls[:, 1] - walls[:, 0]
    length = np.hypot(*along.T)
    angle = np.arctan2(along[:, 1], along[:, 0])
    middle = walls.mean(axis=(0, 1))
    span = float(np.abs(walls - middle).max()) + 1.0
    offset = cross(along, walls[:, 0] - middle) / length
    flip = np.cos(angle) + 1e-3 * np.sin(angle) < 0.0  # one of the two directions of a line
    normal = np.column_stack([np.cos(2 * angle) * span, np.sin(2 * angle) * span, np.where(flip, -offset, offset)])
    first, second = cKDTree(normal).query_pairs(0.1, output_type="ndarray").T
    away = np.abs(cross(along[first, None], walls[second] - walls[first, :1])) / length[first, None]
    back = np.abs(cross(along[second, None], walls[first] - walls[second, :1])) / length[second, None]
    same = (away < _SAME_LINE_M).all(axis=1) & (back < _SAME_LINE_M).all(axis=1)
    pairs = coo_array((np.ones(same.sum()), (first[same], second[same])), shape=(len(walls),) * 2)
    return np.asarray(connected_components(pairs, directed=False)[1], dtype=np.int32)


def _index(walls: Floats) -> WallIndex:
    """Sort wall pieces into cells."""
    if len(walls) == 0:
        return WallIndex(np.array([0.0, 0.0, 1.0, 1.0, 1.0]), np.zeros(2, np.int64), np.zeros(0, np.int32))
    low, high = walls.min(axis=(0, 1)), walls.max(axis=(0, 1))
    length = float(np.hypot(*(walls[:, 1] - walls[:, 0]).T).sum())
    edge = max(0.05, length * _WALLS_PER_CELL / len(walls) / 2.0, float((high - low).max()) / 1000)
    columns, rows = np.floor((high - low) / edge).astype(np.int64) + 1
    grid = np.array([low[0], low[1], edge, columns, rows])
    cell, piece = _cells_of(walls, grid)
    order = np.argsort(cell, kind="stable")
    start = np.searchsorted(cell[order], np.arange(rows * columns + 1))
    return WallIndex(grid, start, piece[order])


@njit(cache=True)
def _cells_of(walls, grid):  # type: ignore[no-untyped-def]
    """Cells that each wall may cross: their numbers, and the walls."""
    x0, y0, edge, columns, rows = grid[0], grid[1], grid[2], int(grid[3]), int(grid[4])
    cell, piece, count = np.empty(1024, np.int64), np.empty(1024, np.int32), np.int64(0)
    for i in range(len(walls)):
        low, high = min(walls[i, 0, 1], walls[i, 1, 1]), max(walls[i, 0, 1], walls[i, 1, 1])
        first = max(0, int(np.floor((low - y0) / edge - 1e-6)))
        last = min(rows - 1, int(np.floor((high - y0) / edge + 1e-6)))
        for row in range(first, last + 1):
            left, right = span_in_strip(walls[i], y0 + (row - 1e-6) * edge, y0 + (row + 1 + 1e-6) * edge)
            start = max(0, int(np.floor((left - x0) / edge - 1e-6)))
            stop = min(columns - 1, int(np.floor((right - x0) / edge + 1e-6)))
            cell, piece = grow(cell, count + columns), grow(piece, count + columns)
            for column in range(start, stop + 1):
                cell[count], piece[count] = row * columns + column, i
                count += 1
    return cell[:count], piece[:count]
