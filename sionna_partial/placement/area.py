"""Where a transmitter may stand, and weighted receivers that it shall cover."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.errors import PositionError
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.predictor import AnyPredictor
from sionna_partial.prediction.unobserved import unobserved_lengths_m, walled_lengths_m
from sionna_partial.tracing.positions import clear_of_walls

CLEARANCE_M, FINEST_M = 0.1, 0.05
"""Smallest distance from known walls, and largest cells that keep it [m]."""

RECEIVER_SPACING_M, MAX_RECEIVERS = 0.5, 4000
POSITION_SPACING_M, MAX_POSITIONS = 0.25, 500
"""Spacings of receivers and positions [m], and largest numbers, beyond which spacings grow."""

NEGLIGIBLE = 0.02
"""Probability of being indoors below which a receiver is omitted."""

_INDOOR_POSITIONS = 8

_UNSEEN_LENGTH_M, _WALL_LENGTH_M, _WALL_FACTOR = 4.0, 4.0, 0.8
"""Visibility is exp(-u / 4 m) with the unobserved length u, and 0.8 exp(-d / 4 m) of it at distance d behind walls.
Fitted to predicted coverage at -100 dB."""


@dataclass(frozen=True, eq=False)
class PlacementArea:
    """Possible positions of a transmitter, and weighted receivers.

    A receiver in a free cell has weight 1, in an unknown cell P(indoor), averaged over transmitter positions: no
    position gains by making the building seem larger.

    Parameters
    ----------
    height_m : height of the transmitter
    room : FREE where the transmitter may be, UNKNOWN elsewhere
    rx_m : (N, 3)
    weight : (N,), above 0
    spacing_m : distance between receivers
    """

    partial: PartialMap
    height_m: float
    room: PartialMap
    rx_m: Floats
    weight: Floats
    spacing_m: float

    @property
    def size_m2(self) -> float:
        """Area of transmitter positions [m^2]."""
        return float((self.room.state == CellState.FREE).sum()) * self.room.resolution_m**2

    def stands(self, positions_m: Floats) -> Bools:
        """Return whether a transmitter may be at positions (..., 3) [m]."""
        return self.room.state_at(positions_m) == CellState.FREE

    def positions(self, seed: int) -> Floats:
        """Return positions (C, 3) [m] on a randomly offset grid, or else cell centres."""
        rng = np.random.default_rng(seed)
        spacing_m = max(POSITION_SPACING_M, math.sqrt(self.size_m2 / MAX_POSITIONS))
        x0, y0, x1, y1 = self.room.bounds_m
        start = rng.uniform(0.0, spacing_m, 2)
        grid_m = np.round(grid_positions((x0 + start[0], x1), (y0 + start[1], y1), spacing_m, self.height_m), 3)
        grid_m = grid_m[self.stands(grid_m)]
        if len(grid_m):
            return grid_m
        cells = np.argwhere(self.room.state == CellState.FREE)
        chosen = cells[np.sort(rng.choice(len(cells), min(len(cells), MAX_POSITIONS), replace=False))]
        return np.column_stack([cell_centres_m(self.room, chosen), np.full(len(chosen), self.height_m)])

    def thinned(self, count: int) -> "PlacementArea":
        """Return the area with at most `count` receivers, drawn evenly by weight."""
        if len(self.rx_m) <= count:
            return self
        order = _boustrophedon(self.rx_m)
        fraction = np.cumsum(self.weight[order]) / self.weight.sum()
        picks = np.searchsorted(fraction, (np.arange(count) + 0.5) / count)
        weight = np.bincount(order[np.minimum(picks, len(order) - 1)], minlength=len(order)).astype(np.float64)
        return replace(self, rx_m=self.rx_m[weight > 0.0], weight=weight[weight > 0.0])

    def visibility(self, positions_m: Floats, range_m: float = math.inf) -> Floats:
        """Return the visibility (C, N) in [0, 1] of receivers from positions (C, 3), 0 beyond `range_m`."""
        walled, unobserved_m, distance_m = _lines(self.partial, positions_m, self.rx_m)
        seen = np.exp(-unobserved_m / _UNSEEN_LENGTH_M)
        seen *= np.where(walled, _WALL_FACTOR * np.exp(-distance_m / _WALL_LENGTH_M), distance_m <= range_m)
        return seen.reshape(len(positions_m), len(self.rx_m))


def placement_area(
    partial: PartialMap,
    height_m: float,
    rx_height_m: float,
    model: AnyPredictor | None,
    frequency_hz: float | None = None,
) -> PlacementArea:
    """Return possible transmitter positions, and receivers as in `predict_map`; a PositionError if there are none.

    `model` predicts which unknown cells are indoors; without one all are outdoors.
    """
    x0, y0, x1, y1 = partial.bounds_m
    spacing_m = max(RECEIVER_SPACING_M, math.sqrt((x1 - x0) * (y1 - y0) / MAX_RECEIVERS))
    spacing_m = min(spacing_m, x1 - x0, y1 - y0)
    rx_m = grid_positions((x0 + spacing_m / 2, x1), (y0 + spacing_m / 2, y1), spacing_m, rx_height_m)
    rx_m = rx_m[clear_of_walls(partial, rx_m)]
    area = PlacementArea(partial, height_m, _room(partial), rx_m, np.ones(len(rx_m)), spacing_m)
    weight = _weights(area, model, frequency_hz)
    kept = weight > NEGLIGIBLE
    if not kept.any():
        raise PositionError(
            f"no receiver can stand anywhere: all positions of a grid of {spacing_m:g} m are in walls or outside. Give "
            "a map with more free cells."
        )
    return replace(area, rx_m=rx_m[kept], weight=weight[kept])


def _room(partial: PartialMap) -> PartialMap:
    fine = max(1, math.ceil(partial.resolution_m / FINEST_M - 1e-9))
    fine = max(1, min(fine, int(math.sqrt(4e6 / partial.state.size))))
    state = partial.state.repeat(fine, axis=0).repeat(fine, axis=1)
    cell_m = partial.resolution_m / fine
    around = 2 * math.ceil(CLEARANCE_M / cell_m - 1e-9) + 1
    stands = (state == CellState.FREE) & ~ndimage.maximum_filter(state == CellState.WALL, size=around)
    if not stands.any():
        free = int((partial.state == CellState.FREE).sum())
        raise PositionError(
            f"a transmitter can stand nowhere: the map has {free} free cells, and none of their area is {CLEARANCE_M:g}"
            " m away from all walls. Give a map with more free cells, such as one of a longer exploration."
        )
    room = np.where(stands, CellState.FREE, CellState.UNKNOWN).astype(np.uint8)
    return PartialMap(room, cell_m, partial.origin_m, partial.wall_height_m)


def _weights(area: PlacementArea, model: AnyPredictor | None, frequency_hz: float | None) -> Floats:
    weight = (area.partial.state_at(area.rx_m) == CellState.FREE).astype(np.float64)
    if model is None or weight.all():
        return weight
    positions_m = area.positions(0)
    some_m = positions_m[np.unique(np.linspace(0, len(positions_m) - 1, _INDOOR_POSITIONS).astype(np.intp))]
    walled, unobserved_m, distance_m = _lines(area.partial, some_m, area.rx_m[weight == 0.0])
    phi = LinkFeatures(
        link_state=np.where(walled, LinkState.NLOS, LinkState.LOS).astype(np.uint8),
        unobserved_distance_m=np.minimum(unobserved_m, distance_m),
        distance_m=distance_m,
        gain_db=np.full(len(distance_m), GAIN_FLOOR_DB),
        frequency_hz=frequency_hz,
    )
    weight[weight == 0.0] = model.predict_indoor(phi).reshape(len(some_m), -1).mean(axis=0)
    return weight


def grid_positions(x_m: tuple[float, float], y_m: tuple[float, float], spacing_m: float, z_m: float) -> Floats:
    """Return positions (N, 3) on a grid at one height [m]."""
    x, y = np.meshgrid(np.arange(*x_m, spacing_m), np.arange(*y_m, spacing_m))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z_m)])


def _lines(partial: PartialMap, start_m: Floats, end_m: Floats) -> tuple[Bools, Floats, Floats]:
    """Return for lines (A B,) if they meet a wall, unobserved lengths and lengths [m]."""
    start_m, end_m = np.repeat(start_m, len(end_m), axis=0), np.tile(end_m, (len(start_m), 1))
    walled = walled_lengths_m(partial, start_m, end_m) > 1e-6
    return walled, unobserved_lengths_m(partial, start_m, end_m), np.linalg.norm(end_m - start_m, axis=1)


def _boustrophedon(points_m: Floats) -> Indices:
    """Order points (N, 3) along stripes of four rows, in alternating directions."""
    x, y = points_m[:, 0], points_m[:, 1]
    rows = np.unique(np.round(y, 6), return_inverse=True)[1]
    stripe = rows // 4
    return np.lexsort((rows, np.round(np.where(stripe % 2 == 0, x, -x), 6), stripe))
