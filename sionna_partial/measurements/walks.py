"""Walks: lengths of the shortest ways around walls, which residuals of predictions are correlated over."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sionna_partial.arrays import Bools, Floats, grid_edges
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap

BLOCK_M = 0.15
"""Largest edge of the blocks of cells that walks lead through [m]: a door of 0.5 m has two at least."""

UNKNOWN_COST = 3.0
"""Cost of a walk through unknown cells, relative to free cells."""

_AROUND = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)

_HIDDEN, _SAME, _STEP_M = 10.0, 1e-6, 1e-9
"""Distance [blocks] added to blocks out of sight, difference of equal distances, and length of the step to a block."""


_AT_ONCE = 32
"""Number of points whose walks are found at once."""


@dataclass(frozen=True, eq=False)
class Walks:
    """Lengths of walks from P points around walls, longer through unknown cells."""

    partial: PartialMap
    points_m: Floats
    longest_m: float

    def lengths_m(self, points_m: Floats) -> Floats:
        """Return the lengths (P, N) of walks to points (N, 3) [m], infinite beyond `longest_m`."""
        lengths_m = np.linalg.norm(self.points_m[:, None, :2] - points_m[:, :2], axis=-1)
        first, *others = self._blocks_at(points_m).T
        walks_m = self._lengths_m[:, first]
        for blocks in others:
            np.minimum(walks_m, self._lengths_m[:, blocks], out=walks_m)
        return np.maximum(walks_m, lengths_m)

    @cached_property
    def _edge_m(self) -> float:
        return self._step * self.partial.resolution_m

    @cached_property
    def _step(self) -> int:
        """Return the largest odd number of map cells in `BLOCK_M`: such blocks can be centred on any map."""
        return max(1, 2 * math.floor((BLOCK_M / self.partial.resolution_m + 1.0) / 2.0 + _SAME) - 1)

    @cached_property
    def _costs(self) -> tuple[Floats, Floats]:
        """Return the cost (ny, nx) of walks through blocks, 0 with a wall, and their lower-left corner [m].

        Blocks are centred on the known cells, with unknown ones around them: neither the map's origin nor its
        orientation nor unknown cells around it change a length.
        """
        step, state = self._step, self.partial.state
        known = np.argwhere(state != CellState.UNKNOWN)
        low, high = (
            (known.min(axis=0), known.max(axis=0) + 1) if len(known) else (np.zeros(2, int), np.array(state.shape))
        )
        margin = -(high - low) * ((step + 1) // 2) % step + step  # the same on both sides, to whole blocks
        inner = state[low[0] : high[0], low[1] : high[1]]
        cells = np.pad(inner, np.column_stack([margin, margin]), constant_values=CellState.UNKNOWN)
        ny, nx = np.array(cells.shape) // step
        blocks = cells.reshape(ny, step, nx, step)
        unknown = (blocks == CellState.UNKNOWN).mean(axis=(1, 3))
        costs = np.where((blocks == CellState.WALL).any(axis=(1, 3)), 0.0, 1.0 + (UNKNOWN_COST - 1.0) * unknown)
        return costs, self.partial.origin_m + (low - margin)[::-1] * self.partial.resolution_m

    @cached_property
    def _nearest(self) -> NDArray[np.intp]:
        costs, _ = self._costs
        block = ndimage.distance_transform_edt(costs == 0.0, return_distances=False, return_indices=True)
        return np.ravel_multi_index(tuple(block), costs.shape)

    @cached_property
    def _lengths_m(self) -> NDArray[np.float32]:
        """Return the lengths (P, blocks) of walks from the points, which are nodes beside the blocks."""
        costs, _ = self._costs
        count = len(self.points_m)
        if not count:
            return np.zeros((0, costs.size), dtype=np.float32)
        ends, steps = grid_edges(costs)
        blocks = self._blocks_at(self.points_m)
        points = np.broadcast_to(costs.size + np.arange(count)[:, None], blocks.shape)
        starts = np.unique(np.stack([points.ravel(), blocks.ravel()]), axis=1)
        lengths_m = np.concatenate([np.tile(steps * self._edge_m, 2), np.full(starts.shape[1], _STEP_M)])
        rows, columns = np.concatenate([ends, ends[::-1], starts], axis=1)
        graph = csr_array((lengths_m, (rows, columns)), shape=(costs.size + count,) * 2)
        found_m = np.empty((count, costs.size), dtype=np.float32)
        for first in range(0, count, _AT_ONCE):  # its result has double precision
            sources = costs.size + np.arange(first, min(first + _AT_ONCE, count))
            found_m[first : first + _AT_ONCE] = dijkstra(graph, indices=sources, limit=self.longest_m)[:, : costs.size]
        return found_m

    def _blocks_at(self, points_m: Floats) -> NDArray[np.intp]:
        """Return the open blocks (N, K) in sight whose centres are nearest to points (N, 3) [m].

        On the border of blocks several are equally near; the first is repeated where there are fewer.
        """
        costs, corner_m = self._costs
        limits = np.array(costs.shape)[::-1] - 1
        at = np.clip(np.round(points_m[:, :2] - corner_m, 9) / self._edge_m, 0.0, limits + 1.0)
        cells = np.clip(np.floor(at).astype(np.intp), 0, limits)[:, None] + _AROUND
        inside = ((cells >= 0) & (cells <= limits)).all(axis=-1)
        column, row = np.moveaxis(np.clip(cells, 0, limits), -1, 0)
        apart = np.linalg.norm(cells + 0.5 - at[:, None], axis=-1)
        apart = np.where(inside & (costs[row, column] > 0.0), apart, np.inf)
        blocked = np.flatnonzero(costs[row[:, 4], column[:, 4]] == 0.0)
        apart[blocked] += _HIDDEN * self._walled(at[blocked], cells[blocked] + 0.5)
        nearest = apart.min(axis=1, keepdims=True, initial=np.inf)
        equal = (apart <= nearest + _SAME) & np.isfinite(apart)
        blocks = np.where(equal, row * costs.shape[1] + column, -1)
        blocks = -np.sort(-blocks, axis=1)[:, : max(1, int(equal.sum(axis=1).max(initial=0)))]
        first = np.where(blocks[:, :1] < 0, self._nearest[row[:, 4], column[:, 4]][:, None], blocks[:, :1])
        return np.where(blocks < 0, first, blocks)

    def _walled(self, at: Floats, centres: Floats) -> Bools:
        """Return whether a wall is on the lines (N, K) from points (N, 2) to centres (N, K, 2) [blocks]."""
        corner_m, parts = self._costs[1], np.linspace(0.0, 1.0, 4 * self._step + 1)[:, None, None, None]
        lines = at[:, None] + parts * (centres - at[:, None])
        walled: Bools = (self.partial.state_at(lines * self._edge_m + corner_m) == CellState.WALL).any(axis=0)
        return walled
