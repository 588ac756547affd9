"""Windows of a map around transmitters: the images that the map networks read."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sionna_partial.arrays import Floats, Indices, States, grid_edges
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap, aligned_blocks
from sionna_partial.prediction.unobserved import GRAZE, in_cells, line_fractions

WINDOW_CELLS, CELLS_M = 64, (0.3, 1.2)
"""Number of cells along each side of a window, and their edge in each of a transmitter's windows, near to far [m]."""

CHANNELS = ("free", "wall", "seen", "hidden", "detour")
"""Values of a cell of a window, each in 255ths, and 0 where nothing was observed.

free, wall: fraction of the cell's area that is known to be so. seen: fraction of the direct line from the transmitter
that is observed. hidden: whether that line meets a known wall. detour: how much longer the walk is, see `_detours`.
"""

WINDOWS = (len(CELLS_M), WINDOW_CELLS, WINDOW_CELLS, len(CHANNELS))
"""Shape of the windows of a transmitter."""

_FINEST = 4
"""Number of cells of the map along a cell of the window, at most: finer maps are made coarser, once for all windows."""

_WALL_COST = 100.0
"""Cost of walking through a cell of nothing but wall [cells]."""

_LONGEST_DETOUR = 40.0
"""[cells]"""


def transmitters(map_index: NDArray[np.int64], tx_m: Floats) -> tuple[Floats, Indices]:
    """Return map, x and y (W, 3) of the transmitters of links, and which is each link's (N,).

    `map_index` (N,) is the map of each link, `tx_m` (N, 3) its transmitter [m].
    """
    keys, index = np.unique(np.column_stack([map_index, tx_m[:, :2]]), axis=0, return_inverse=True)
    return keys, index.reshape(-1)


def draw_windows(maps: Sequence[PartialMap], keys: Floats) -> NDArray[np.uint8]:
    """Draw the windows (W, *WINDOWS) of transmitters of `transmitters`."""
    windows = np.zeros((len(keys), *WINDOWS), dtype=np.uint8)
    for number in np.unique(keys[:, 0]).astype(int):
        here = keys[:, 0] == number
        windows[here] = map_windows(maps[number], keys[here, 1:])
    return windows


def map_windows(partial: PartialMap, tx_m: Floats) -> NDArray[np.uint8]:
    """Draw the windows (T, *WINDOWS) around transmitters (T, 2) [m] of one map.

    Row 0 of a window has the smallest y, and the transmitter is in the middle.
    """
    windows = np.zeros((len(tx_m), *WINDOWS), dtype=np.uint8)
    if not (partial.state == CellState.UNKNOWN).all():
        for scale, cell_m in enumerate(CELLS_M):
            plan = _coarser(partial, cell_m / _FINEST)
            for window, at_m in zip(windows[:, scale], tx_m, strict=True):
                window[:] = _window(plan, at_m, cell_m, clear_around_tx=plan is not partial)
    return windows


def _coarser(partial: PartialMap, cell_m: float) -> PartialMap:
    """Return a map with the largest multiple of its cells that is no larger than `cell_m`: any wall makes a wall."""
    factor = math.floor(cell_m / partial.resolution_m + 1e-9)
    if factor < 2:
        return partial
    blocks, (x_m, y_m) = aligned_blocks(partial, factor)
    wall, free = (blocks == CellState.WALL).any(axis=(1, 3)), (blocks == CellState.FREE).mean(axis=(1, 3)) >= 0.5
    coarse = np.select([wall, free], [CellState.WALL, CellState.FREE], CellState.UNKNOWN).astype(np.uint8)
    return PartialMap(coarse, factor * partial.resolution_m, (float(x_m), float(y_m)))


def _window(partial: PartialMap, tx_m: Floats, cell_m: float, *, clear_around_tx: bool) -> NDArray[np.uint8]:
    """Draw the window with cells of `cell_m` around a transmitter, which may be in a wall that was drawn coarser."""
    state, start = _surroundings(partial, tx_m, cell_m)
    if clear_around_tx:
        column, row = np.floor(start).astype(int)
        beside = state[row - 1 : row + 2, column - 1 : column + 2]
        beside[beside == CellState.WALL] = CellState.FREE
    steps = cell_m / partial.resolution_m * (np.arange(WINDOW_CELLS + 1) - WINDOW_CELLS / 2)
    edges = start[:, None] + steps
    columns, rows = (overlaps(edge, len(state)) for edge in edges)
    free, wall = (rows @ (state == kind) @ columns.T for kind in (CellState.FREE, CellState.WALL))
    centres = np.stack(np.meshgrid(*0.5 * (edges[:, 1:] + edges[:, :-1])), axis=-1).reshape(-1, 2)
    lines = line_fractions(state, np.tile(start, (len(centres), 1)), centres).reshape(*free.shape, -1)
    hidden = lines[..., CellState.WALL] > GRAZE
    layers = [free, wall, 1.0 - lines[..., CellState.UNKNOWN], hidden, _detours(wall)]
    return np.round(255.0 * np.stack(layers, axis=-1)).astype(np.uint8)


def _surroundings(partial: PartialMap, tx_m: Floats, cell_m: float) -> tuple[States, Floats]:
    """Extend or cut a map to what a window covers, and return where the transmitter is in it [cells]."""
    half = int(np.ceil(0.5 * WINDOW_CELLS * cell_m / partial.resolution_m)) + 1
    start = in_cells(partial, tx_m)
    column, row = np.floor(start).astype(int)
    spans = [(low - half, low + half + 1) for low in (row, column)]
    state = np.full((2 * half + 1, 2 * half + 1), CellState.UNKNOWN, dtype=np.uint8)
    inner = [(max(low, 0), min(high, count)) for (low, high), count in zip(spans, partial.shape, strict=True)]
    if all(low < high for low, high in inner):
        known = partial.state[inner[0][0] : inner[0][1], inner[1][0] : inner[1][1]]
        top, left = inner[0][0] - spans[0][0], inner[1][0] - spans[1][0]
        state[top : top + known.shape[0], left : left + known.shape[1]] = known
    return state, np.round(start - np.array([spans[1][0], spans[0][0]]), 6)  # the same wherever the grid begins


def overlaps(edges: Floats, count: int) -> Floats:
    """Fraction of each interval between `edges` (K + 1,) that each of `count` unit cells covers: (K, count)."""
    cells = np.arange(count)
    low, high = np.maximum(edges[:-1, None], cells), np.minimum(edges[1:, None], cells + 1)
    return np.maximum(high - low, 0.0) / np.diff(edges)[:, None]


def _detours(wall: Floats) -> Floats:
    """How much longer the route around known walls is than the straight one, in [0, 1] of `_LONGEST_DETOUR`.

    Routes go from the four cells in the middle from cell to cell, also across corners; walls are crossed at a cost.
    """
    half = WINDOW_CELLS // 2
    middle = np.s_[half - 1 : half + 1, half - 1 : half + 1]
    cost = 1.0 + _WALL_COST * wall
    cost[middle] = 1.0
    ends, steps = grid_edges(cost)
    graph = csr_array((steps, ends), shape=(cost.size, cost.size))
    start = np.arange(cost.size).reshape(cost.shape)[middle].ravel()
    costs = dijkstra(graph, directed=False, indices=start, min_only=True).reshape(wall.shape)
    offsets = np.abs(np.arange(WINDOW_CELLS) - half + 0.5) - 0.5
    short, long = np.minimum.outer(offsets, offsets), np.maximum.outer(offsets, offsets)
    straight = long + (math.sqrt(2.0) - 1.0) * short
    return np.clip((costs - straight) / _LONGEST_DETOUR, 0.0, 1.0)
