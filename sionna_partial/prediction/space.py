"""Fields of the known and unknown space of a map: exposure, routes between points, images; possible link states.

Fields live on cells of 0.3 m that are centred on the mean known cell of the map, so that neither the grid of the map
nor its origin or orientation matter. A random walk, whose steps known walls stop, defines two of them:

- exposure: probability that a walk from a point, of mean length `WALK_M`, ends in unobserved space.
- route: negative logarithm of the density of walks between two points, which grows like the length of the way around
  known walls. It is symmetric in its ends.
"""

import functools
import itertools
import math
import weakref
from collections import deque
from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from sionna_partial.arrays import Bools, Floats, Indices, States
from sionna_partial.constants import CellState, LinkState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.wall_cells import LEAST_NOISE
from sionna_partial.prediction.evaluate import array_ops
from sionna_partial.prediction.unobserved import (
    GRAZE,
    centred_grid,
    in_cells,
    map_line_fractions,
    overlaps,
    parts_at_walls,
)

CELL_M = 0.3
WALK_M = 2.0
"""Mean length of a random walk [m]."""

MARGIN_CELLS, POOLED_CELLS = 16, 8
"""Unknown cells around the known ones; cells that networks pool, which divide the sides of images."""

LONGEST_ROUTE = 60.0
"""Largest route, in `WALK_M`, also of points that known walls separate."""

_PARTS = 6
"""Points along a cell at which walls are looked up."""

_ASIDE_CELLS = 1e-3
"""Distance of the look-ups on both sides of a point, which may lie on the border of map cells [map cells]."""

_SEPARATE = 1e-9
"""Smallest conductance between neighbouring cells."""

_FREE_ROUTE = math.log(2.0 * math.pi * (WALK_M / CELL_M) ** 2) - 0.5 * math.log(math.pi / 2.0)
"""Route in unobserved space without walls, less distance and half of its logarithm, in `WALK_M` (asymptote of K0)."""

_BESIDE_CELLS = 1.5
"""Offset of the parallel lines in `_crosses_wall` [map cells]."""

_OPAQUE_CELLS = 3.0
"""Length of a line in known walls that excludes LOS, unless it is traced on exact walls [map cells]."""

_BEYOND_CELLS = 2
"""Margin around a map, so that walls that reach its border do not separate the outside [map cells]."""

_FACTORS_KEPT = 8
"""Number of maps with factors in memory, some 10 MB each."""

_Found = TypeVar("_Found")


def kept_by_map(function: Callable[[PartialMap], _Found]) -> Callable[[PartialMap], _Found]:
    """Keep the results of a function of maps as long as its maps are there."""
    kept: dict[int, tuple[Any, _Found]] = {}

    @functools.wraps(function)
    def of(partial: PartialMap) -> _Found:
        known = kept.get(id(partial))
        if known is None or known[0]() is not partial:  # numbers of maps that are gone are used again
            for old in [key for key, (owner, _) in [*kept.items()] if owner() is None]:
                kept.pop(old, None)
            known = kept[id(partial)] = weakref.ref(partial), function(partial)
        return known[1]

    return of


_factorised: deque["MapSpace"] = deque()


class MapSpace:
    """Fields of a map on H x W cells.

    Attributes
    ----------
    image : (H, W, 3) float32 array
        Fractions of free and wall, and of unobserved space that can be entered.
    shape : tuple of int
        H and W, multiples of `POOLED_CELLS`.
    corner_m : (2,) float64 array
        Corner of the first cell [m].
    """

    def __init__(self, partial: PartialMap) -> None:
        known = np.argwhere(partial.state != CellState.UNKNOWN)
        self._is_empty = len(known) == 0
        self._cells = CELL_M / partial.resolution_m
        self.shape, first = centred_grid(known, self._cells, MARGIN_CELLS, POOLED_CELLS)
        self.corner_m = np.array(partial.origin_m) + partial.resolution_m * first[::-1]
        state, walls = partial.state, _without_gaps(partial.state == CellState.WALL)
        entered = _entered(state, walls)
        masks = (state == CellState.FREE, state == CellState.WALL, entered)
        edges = [first[axis] + np.arange(self.shape[axis] + 1) * self._cells for axis in (0, 1)]
        rows, columns = (overlaps(edge, count) for edge, count in zip(edges, state.shape, strict=True))
        fractions = [rows @ mask.astype(np.float64) @ columns.T for mask in masks]
        inside = rows.sum(axis=1)[:, None] * columns.sum(axis=1)
        outside = _outside_is_entered(state, entered)
        fractions[2] = fractions[2] + (1.0 - inside) * outside
        self.image = np.stack(fractions, axis=-1).astype(np.float32)
        centres = [(edge[:-1] + edge[1:]) / 2.0 - 0.5 for edge in edges]
        at_centres = ndimage.map_coordinates(
            entered.astype(np.float64), np.meshgrid(*centres, indexing="ij"), order=1, mode="constant", cval=outside
        )
        # space behind a wall within a cell is not entered from the centre of the cell
        self._unobserved = fractions[2] * np.where(fractions[1] > 0.0, at_centres, 1.0)
        sampled = _sampled_walls(walls, first, self._cells, self.shape)
        self._conductances = _conductances(sampled, self.shape)

    @staticmethod
    @kept_by_map
    def of(partial: PartialMap) -> "MapSpace":
        """Return the fields of a map, which are kept with it."""
        return MapSpace(partial)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_factors"}

    @property
    def _walk(self) -> Any:
        """Factors of the operator of the walk; the latest maps keep them, at most `_FACTORS_KEPT`."""
        factors = vars(self).get("_factors")
        if factors is None:
            factors = self._factors = self._factorised()
            _factorised.append(self)
            while len(_factorised) > _FACTORS_KEPT:
                vars(_factorised.popleft()).pop("_factors", None)
        return factors

    def _factorised(self) -> Any:
        """Return the factors of 1 - (WALK_M / CELL_M)^2 times the Laplacian between walls."""
        across, down = (each.astype(np.float64) for each in self._conductances)
        numbers = np.arange(math.prod(self.shape)).reshape(self.shape)
        pairs = [(numbers[:, :-1], numbers[:, 1:], across), (numbers[:-1], numbers[1:], down)]
        weight = (WALK_M / CELL_M) ** 2
        start, end, value = (
            np.concatenate(each) for each in zip(*((a.ravel(), b.ravel(), c.ravel()) for a, b, c in pairs), strict=True)
        )
        count = numbers.size
        graph = sparse.coo_array((weight * value, (start, end)), shape=(count, count))
        graph = graph + graph.T
        operator = sparse.diags_array(1.0 + np.asarray(graph.sum(axis=1)).ravel()) - graph
        return splu(operator.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    @cached_property
    def exposure(self) -> Floats:
        """Exposure of the cells (H, W)."""
        if not self._unobserved.any():
            return np.zeros(self.shape)
        return np.clip(self._walk.solve(self._unobserved.ravel()), 0.0, 1.0).reshape(self.shape)

    def exposure_at(self, points_m: Any, ops: Any = array_ops) -> Any:
        """Return the exposure (N,) of points (N, 2 or 3) [m]."""
        return self.read(self.exposure[..., None], points_m, ops)[:, 0]

    def routes(self, tx_m: Any, rx_m: Floats, ops: Any = array_ops) -> Any:
        """Return the routes (N,), in `WALK_M`, from a transmitter (3,) to receivers (N, 3) [m]."""
        if self._is_empty:
            distance_m = ops.sqrt(ops.sum((rx_m[:, :2] - tx_m[:2]) ** 2, axis=1) + CELL_M**2)
            return distance_m / WALK_M + 0.5 * ops.log(distance_m / WALK_M) + _FREE_ROUTE
        (tx_cells, tx_weights), (rx_cells, rx_weights) = self.corners(tx_m[None], ops), self.corners(rx_m)
        start = np.zeros((math.prod(self.shape), 4))
        start[tx_cells[0], np.arange(4)] = 1.0
        density = np.maximum(self._walk.solve(start)[rx_cells.ravel()], math.exp(-LONGEST_ROUTE))
        length = (-np.log(density).reshape(*rx_cells.shape, 4) * rx_weights[..., None]).sum(axis=1)
        return ops.sum(length * tx_weights, axis=1)

    def routes_of(self, tx_m: Floats, rx_m: Floats) -> Floats:
        """Return the routes (N,) of links (N, 3) [m] of several transmitters."""
        found = np.zeros(len(rx_m))
        sources_m, source = np.unique(tx_m, axis=0, return_inverse=True)
        for number, source_m in enumerate(sources_m):
            here = source.ravel() == number
            found[here] = self.routes(source_m, rx_m[here])
        return found

    def corners(self, points_m: Any, ops: Any = array_ops) -> tuple[Indices, Any]:
        """Return the four cells (..., 4) around points (..., 2 or 3) [m], and their bilinear weights (..., 4)."""
        limits = np.array(self.shape[::-1]) - 1.0 - 1e-6
        at = ops.minimum(ops.maximum((points_m[..., :2] - self.corner_m) / CELL_M - 0.5, 0.0), limits)
        low = np.floor(np.asarray(at)).astype(np.intp)
        part = at - low
        cells = low[..., 1:] * self.shape[1] + low[..., :1] + np.array([0, 1, self.shape[1], self.shape[1] + 1])
        x, y = part[..., 0], part[..., 1]
        weights = ops.stack([(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y], axis=-1)
        return cells, weights

    def read(self, values: Any, points_m: Any, ops: Any = array_ops) -> Any:
        """Interpolate a field (H, W, C) at points (..., 2 or 3) [m]: return (..., C)."""
        cells, weights = self.corners(points_m, ops)
        flat = ops.reshape(values, (-1, values.shape[-1]))
        return ops.sum(ops.take(flat, cells, axis=0) * ops.cast(weights, flat.dtype)[..., None], axis=-2)


def _without_gaps(wall: Bools) -> Bools:
    """Return walls with gaps of up to two cells closed."""
    closed = ndimage.binary_closing(np.pad(wall, 2), np.ones((3, 3), dtype=bool))
    return np.asarray(closed[2:-2, 2:-2])


def _entered(state: NDArray[np.uint8], walls: Bools) -> Bools:
    """Return the unknown cells that can be entered from free ones without crossing walls."""
    unknown = np.pad((state == CellState.UNKNOWN) & ~walls, 1, constant_values=True)
    labels, count = ndimage.label(unknown)
    free = np.pad(state == CellState.FREE, 1)
    beside = ndimage.binary_dilation(free) & unknown
    entered = np.zeros(count + 1, dtype=bool)
    entered[labels[beside]] = True
    if not free.any():
        entered[1:] = True
    entered[0] = False
    return np.asarray(entered[labels][1:-1, 1:-1])


def _outside_is_entered(state: NDArray[np.uint8], entered: Bools) -> float:
    """Return 1 if the space beyond the grid can be entered, else 0."""
    rim = np.ones(state.shape, dtype=bool)
    rim[1:-1, 1:-1] = False
    free = state == CellState.FREE
    return float((rim & (entered | free)).any() or not free.any())


def _sampled_walls(wall: Bools, first: Floats, cells: float, shape: tuple[int, ...]) -> Bools:
    """Return known walls at `_PARTS` x `_PARTS` points of each cell."""
    step = cells / _PARTS
    spare = max(0, math.ceil(0.5 * (step - 1.0) - 1e-9))  # thin walls lie between points that are further apart
    wall = ndimage.maximum_filter(np.pad(wall, spare), size=2 * spare + 1)
    sampled = np.zeros(tuple(_PARTS * count for count in shape), dtype=bool)
    at = [spare + first[axis] + (np.arange(_PARTS * shape[axis]) + 0.5) * step for axis in (0, 1)]
    for aside in itertools.product((-_ASIDE_CELLS, _ASIDE_CELLS), repeat=2):
        rows, columns = (np.floor(axis + move).astype(np.intp) for axis, move in zip(at, aside, strict=True))
        inside = [(index >= 0) & (index < count) for index, count in zip((rows, columns), wall.shape, strict=True)]
        looked_up = wall[np.ix_(np.clip(rows, 0, wall.shape[0] - 1), np.clip(columns, 0, wall.shape[1] - 1))]
        sampled |= looked_up & np.logical_and.outer(*inside)
    return sampled


def _conductances(walls: Bools, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Return the fractions of open lines between neighbouring cells: (H, W - 1) and (H - 1, W).

    It is 0 where a wall is between the centres: other lines of cells along an inclined wall lead through it.
    """
    half = _PARTS // 2

    def across(lines: Bools, height: int, width: int) -> Floats:
        inner = lines[:, half : half + _PARTS * (width - 1)].reshape(height, _PARTS, width - 1, _PARTS)
        is_open: Bools = np.logical_not(inner.any(axis=3))
        centre_is_open = is_open[:, half - 1 : half + 1].all(axis=1)
        return np.maximum(centre_is_open * is_open.mean(axis=1), _SEPARATE).astype(np.float32)

    return across(walls, shape[0], shape[1]), across(walls.T, shape[1], shape[0]).T


def possible_states(
    partial: PartialMap,
    ends_m: tuple[Floats, Floats],
    link_state: States,
    seen: Bools,
    walled_m: Floats,
    wall_noise: Floats,
) -> Bools:
    """Return the possible link states (N, 3) on a map, for traced states (N,) between two ends (N, 3) [m].

    - A direct line across a known wall has no LOS. It crosses one if both parallel lines 1.5 cells aside meet known
      walls, and it does so itself (`walled_m`) or is blocked in the trace; at a corner or along a face, one line stays
      clear. Outlines of noisy walls leak: three cells in known walls also exclude LOS, unless traced along exact walls.
    - A wholly observed direct line (`seen`) without walls has LOS as traced.
    - Known walls, with gaps of up to two cells closed, separate regions. If the ends are in different regions, or in a
      wholly observed one, a traced outage is certain; a wholly observed region has no other outage.

    Mesh cells do not give the heights of surfaces: only the second rule applies.
    """
    los, states = link_state == LinkState.LOS, np.arange(len(LinkState))
    possible, blocked = np.ones((len(los), len(LinkState)), dtype=bool), np.zeros(len(los), dtype=bool)
    if partial.environment.is_extruded:
        walled = walled_m > 0.0
        doubtful = (walled & ~(seen & los)) | ~los
        blocked[doubtful] = _crosses_wall(partial, *(end_m[doubtful] for end_m in ends_m))
        opaque = walled_m >= _OPAQUE_CELLS * partial.resolution_m
        opaque &= ~los | (wall_noise > LEAST_NOISE)
        blocked |= opaque
        walled_off, enclosed = _regions(partial, *ends_m)
        outage = (walled_off | enclosed) & (link_state == LinkState.OUTAGE)
        possible[outage] = states == LinkState.OUTAGE
        possible[enclosed & ~outage, LinkState.OUTAGE] = False
        seen = seen & ~walled
    possible[blocked | (seen & ~los), LinkState.LOS] = False
    possible[seen & los] = states == LinkState.LOS
    return possible


def _crosses_wall(partial: PartialMap, tx_m: Floats, rx_m: Floats) -> Bools:
    crosses = np.zeros((2, len(rx_m)), dtype=bool)
    for walls, rows, *ends_m in parts_at_walls(partial, tx_m, rx_m):
        starts, ends = (in_cells(partial, end_m) for end_m in ends_m)
        along = ends - starts
        lengths = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), GRAZE)
        aside = _BESIDE_CELLS * np.stack([-along[:, 1], along[:, 0]], axis=1) / lengths
        for side, step in enumerate((aside, -aside)):
            crosses[side, rows] |= map_line_fractions(walls, starts + step, ends + step)[:, CellState.WALL] > GRAZE
    return np.asarray(crosses.all(axis=0))


def _regions(partial: PartialMap, tx_m: Floats, rx_m: Floats) -> tuple[Bools, Bools]:
    """Return whether the ends (N,) are in different regions, and whether both are in a wholly observed one."""
    state = np.pad(partial.wall_levels[0][1].state, _BEYOND_CELLS, constant_values=CellState.UNKNOWN)
    regions, count = ndimage.label(~ndimage.binary_dilation(state == CellState.WALL, np.ones((3, 3), dtype=bool)))
    observed = np.ones(count + 1, dtype=bool)
    observed[regions[state == CellState.UNKNOWN]] = False
    tx, rx = (_region_at(partial, regions, points_m) for points_m in (tx_m, rx_m))
    known = (tx > 0) & (rx > 0)
    return known & (tx != rx), known & (tx == rx) & observed[tx]


def _region_at(partial: PartialMap, regions: NDArray[np.int32], points_m: Floats) -> NDArray[np.int32]:
    """Return the region (N,) at or beside points (N, 3) [m]; 0 if there is none or more than one.

    `regions` include the margin `_BEYOND_CELLS`, and are 0 within a cell of a wall.
    """
    row, column = (index + _BEYOND_CELLS for index in partial.cell_index(points_m))
    around = [
        regions[np.clip(row + up, 0, len(regions) - 1), np.clip(column + right, 0, regions.shape[1] - 1)]
        for up, right in itertools.product((-1, 0, 1), repeat=2)
    ]
    largest = np.max(around, axis=0)
    alone = np.all([(each == 0) | (each == largest) for each in around], axis=0)
    return np.where(alone, largest, 0)
