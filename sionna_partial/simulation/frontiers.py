"""Frontiers between seen and unseen cells, and the routes to them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import frontier_cells
from sionna_partial.planar import grid_edges

WIDE_M = 0.35
"""Length of a frontier that is about as wide as a robot [m]."""

_FREE, _WALL, _UNKNOWN = int(CellState.FREE), int(CellState.WALL), int(CellState.UNKNOWN)
_EIGHT = np.ones((3, 3), dtype=bool)
_SMALLEST_FRONTIER_CELLS = 3
_COMFORT_M = 0.3
_COMFORT_COST = 3.0
_TIGHT_COST = 15.0


class Frontier(NamedTuple):
    """Free cells (n, 2) beside unseen ones, and the route (m, 2) to the one in their middle, rows and columns."""

    cells: Indices
    route: Indices
    cost_m: float
    """Length of the route [m], where cells beside walls are longer."""


def find_frontiers(
    state: NDArray[np.uint8], start: tuple[int, int], cell_m: float, radius: float, tight: Bools, left_out: Bools
) -> list[Frontier]:
    """Find the frontiers of a map (ny, nx) that a robot of some radius [cells] can reach.

    It gets badly through `tight` cells; those that are `left_out` belong to no frontier.
    """
    known = state != _UNKNOWN
    known[start] = True
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    part = part_of((rows[0] - 1, columns[0] - 1), (rows[-1] + 2, columns[-1] + 2))
    corner = np.array([part[0].start, part[1].start])
    labels, count = ndimage.label(frontier_cells(state[part]) & ~left_out[part], structure=_EIGHT)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    cost = _travel_cost(state[part], cell_m, radius, tight[part])
    router = _Router(cost, tuple(start - corner))
    found = []
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        if sizes[label - 1] < _SMALLEST_FRONTIER_CELLS:
            continue
        cells = np.argwhere(labels[box] == label) + np.add(corner, [side.start for side in box])
        middle = cells[np.argmin(np.hypot(*(cells - cells.mean(axis=0)).T))]
        cost_m = float(router.costs[tuple(middle - corner)] * cell_m)
        if math.isfinite(cost_m):
            found.append(Frontier(cells, router.path_to(middle - corner) + corner, cost_m))
    return found


def wide_frontiers(frontiers: list[Frontier], cell_m: float) -> list[Frontier]:
    """Return those of at least a robot's width, or all if none is."""
    return [each for each in frontiers if len(each.cells) * cell_m >= WIDE_M] or frontiers


def part_of(low: Sequence[int], high: Sequence[int]) -> tuple[slice, slice]:
    """Part of a map from one row and column up to, and without, others; it ends where the map does."""
    return slice(max(0, int(low[0])), int(high[0])), slice(max(0, int(low[1])), int(high[1]))


def _travel_cost(state: NDArray[np.uint8], cell_m: float, radius: float, tight: Bools) -> Floats:
    """Cost of crossing a cell: 1 in the open, more beside walls, 0 (impassable) where not seen free."""
    distance = ndimage.distance_transform_edt(state != _WALL) - 0.5
    nearness = np.clip(1.0 - distance * cell_m / _COMFORT_M, 0.0, 1.0)
    cost = 1.0 + _COMFORT_COST * nearness
    cost[(distance < radius) | tight] = _TIGHT_COST
    cost[state != _FREE] = 0.0
    return cost


class _Router:
    """Shortest paths from one cell to all others, in eight directions, where a cell costs more than 0 to cross."""

    def __init__(self, cost: Floats, start: tuple[int, ...]) -> None:
        self._cells = np.argwhere(cost > 0)
        self._index = np.full(cost.shape, -1)
        self._index[tuple(self._cells.T)] = np.arange(len(self._cells))
        ends, costs = grid_edges(cost)
        graph = csr_array((costs, self._index.ravel()[ends]), shape=(len(self._cells),) * 2)
        options = {"directed": False, "indices": self._index[start], "return_predecessors": True}
        cheapest, self._before = dijkstra(graph, **options)
        self.costs = np.full(cost.shape, np.inf)
        self.costs[tuple(self._cells.T)] = cheapest

    def path_to(self, cell: Indices) -> Indices:
        """Cells (n, 2) from the start to `cell`."""
        path = [self._index[tuple(cell)]]
        while self._before[path[-1]] >= 0:
            path.append(self._before[path[-1]])
        return self._cells[path[::-1]]
