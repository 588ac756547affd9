"""Where a transmitter may stand, and where it shall be heard: PartialMap -> PlacementArea."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.coverage import clear_of_walls
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.prediction.unobserved import unobserved_lengths_m, walled_lengths_m

CLEARANCE_M = 0.1
"""How near a transmitter may come to a known wall [m], at most a tenth more by the size of cells."""

RECEIVER_SPACING_M, MAX_RECEIVERS = 0.5, 4000
"""Distance between receivers [m], which grows where there would be more of them."""

PLACE_SPACING_M, MAX_PLACES = 0.25, 500
"""Distance between the places that are compared by sight [m], which grows where there would be more of them."""

NEGLIGIBLE = 0.02
"""Probability of being indoors below which a receiver is left out."""

_VIEWS = 8
"""Number of places whose views say which unknown places are indoors."""

_FINEST_M = 0.05
"""Cells larger than this are divided, so that the clearance is not that of whole cells [m]."""

_UNSEEN_REACH_M, _WALL_REACH_M, _WALL_SHARE = 4.0, 4.0, 0.8
"""How sight fades: by exp(-u / 4 m) over u of unobserved space, and where walls stand between to 0.8 exp(-d / 4 m) of
that over a distance d. On made homes (other than those of `benchmarks/placement.py`) this follows what the predictor
says of -100 dB."""


@dataclass(frozen=True, eq=False)
class PlacementArea:
    """The free cells of a map away from its walls, and receivers all over it, each with a weight.

    A receiver counts 1 in a free cell, and in an unknown one the probability that it is indoors. That is the mean over
    views from places all over the free cells: it does not depend on where the transmitter is, so that no place is
    better for making the building seem larger. On a complete map unknown cells are outside.

    Parameters
    ----------
    partial : PartialMap
    height_m : float
        Height of the transmitter [m].
    room : PartialMap
        FREE where the transmitter may stand, in cells of at most 5 cm or of the map's size.
    rx_m : (N, 3) float64 array
        Receivers [m].
    weight : (N,) float64 array
        How much each counts, above 0.
    spacing_m : float
        Distance between them [m].
    """

    partial: PartialMap
    height_m: float
    room: PartialMap
    rx_m: NDArray[np.float64]
    weight: NDArray[np.float64]
    spacing_m: float

    @cached_property
    def size_m2(self) -> float:
        """Area where the transmitter may stand [m^2]."""
        return float((self.room.state == CellState.FREE).sum()) * self.room.resolution_m**2

    def stands(self, places_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether a transmitter may stand at each of the places (..., 3) [m]."""
        return self.room.state_at(places_m) == CellState.FREE

    def reaches(self, start_m: NDArray[np.float64], end_m: NDArray[np.float64]) -> bool:
        """Whether a transmitter may stand all along the way between two places (3,) [m]."""
        if not self.stands(np.stack([start_m, end_m])).all():
            return False
        return bool(unobserved_lengths_m(self.room, start_m, end_m[None])[0] <= 1e-6)

    def places(self, seed: int) -> NDArray[np.float64]:
        """Places (C, 3) all over the area [m]: a grid that starts somewhere, or cells where that meets none."""
        rng = np.random.default_rng(seed)
        spacing_m = max(PLACE_SPACING_M, math.sqrt(self.size_m2 / MAX_PLACES))
        x0, y0, x1, y1 = self.room.bounds_m
        start = rng.uniform(0.0, spacing_m, 2)
        x, y = np.meshgrid(np.arange(x0 + start[0], x1, spacing_m), np.arange(y0 + start[1], y1, spacing_m))
        xy_m = np.round(np.column_stack([x.ravel(), y.ravel()]), 3)
        places_m = np.column_stack([xy_m, np.full(len(xy_m), self.height_m)])
        places_m = places_m[self.stands(places_m)]
        return places_m if len(places_m) else self._cells(rng)

    def _cells(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Centres of some cells of the room."""
        cells = np.argwhere(self.room.state == CellState.FREE)
        chosen = cells[np.sort(rng.choice(len(cells), min(len(cells), MAX_PLACES), replace=False))]
        xy_m = (chosen[:, ::-1] + 0.5) * self.room.resolution_m + self.room.origin_m
        return np.column_stack([xy_m, np.full(len(xy_m), self.height_m)])

    def thinned(self, count: int) -> "PlacementArea":
        """Return the area with at most `count` of the receivers, more of them where they weigh more."""
        if len(self.rx_m) <= count:
            return self
        order = _winding(self.rx_m)
        share = np.cumsum(self.weight[order]) / self.weight.sum()
        picks = np.searchsorted(share, (np.arange(count) + 0.5) / count)
        weight = np.bincount(order[np.minimum(picks, len(order) - 1)], minlength=len(order)).astype(np.float64)
        return replace(self, rx_m=self.rx_m[weight > 0.0], weight=weight[weight > 0.0])

    def sight(self, places_m: NDArray[np.float64], reach_m: float = math.inf) -> NDArray[np.float64]:
        """Say without tracing how well each receiver is seen from places (C, 3): (C, N).

        Values are in [0, 1], and 0 beyond `reach_m`.
        """
        start_m = np.repeat(places_m, len(self.rx_m), axis=0)
        end_m = np.tile(self.rx_m, (len(places_m), 1))
        walled = walled_lengths_m(self.partial, start_m, end_m) > 1e-6
        seen = np.exp(-unobserved_lengths_m(self.partial, start_m, end_m) / _UNSEEN_REACH_M)
        distance_m = np.linalg.norm(end_m - start_m, axis=1)
        seen *= np.where(walled, _WALL_SHARE * np.exp(-distance_m / _WALL_REACH_M), distance_m <= reach_m)
        return seen.reshape(len(places_m), len(self.rx_m))


def placement_area(partial: PartialMap, height_m: float, rx_height_m: float, model: Predictor | None) -> PlacementArea:
    """Find out where a transmitter may stand on a map, and which receivers count how much.

    Parameters
    ----------
    partial : PartialMap
    height_m, rx_height_m : float
        Heights of transmitter and receivers [m].
    model : Predictor, optional
        Says which unknown places are indoors; without one all are outside, as on a complete map.

    Returns
    -------
    PlacementArea

    Raises
    ------
    PositionError
        If a transmitter or a receiver can stand nowhere.
    """
    room = _room(partial)
    rx_m, spacing_m = _receivers(partial, rx_height_m)
    area = PlacementArea(partial, float(height_m), room, rx_m, np.ones(len(rx_m)), spacing_m)
    weight = _weights(area, model)
    kept = weight > NEGLIGIBLE
    if not kept.any():
        raise PositionError(
            "no receiver can stand anywhere: all places of a grid of "
            f"{spacing_m:g} m are in walls or outside. Give a map with more free cells."
        )
    return replace(area, rx_m=rx_m[kept], weight=weight[kept])


def _room(partial: PartialMap) -> PartialMap:
    """Return the cells where a transmitter may stand, as a map in which all others are unknown."""
    fine = max(1, math.ceil(partial.resolution_m / _FINEST_M - 1e-9))
    fine = max(1, min(fine, int(math.sqrt(4e6 / partial.state.size))))
    state = partial.state.repeat(fine, axis=0).repeat(fine, axis=1)
    cell_m = partial.resolution_m / fine
    around = 2 * math.ceil(CLEARANCE_M / cell_m - 1e-9) + 1
    near_wall = ndimage.maximum_filter(state == CellState.WALL, size=around)
    stands = (state == CellState.FREE) & ~near_wall
    if not stands.any():
        free = int((partial.state == CellState.FREE).sum())
        raise PositionError(
            f"a transmitter can stand nowhere: the map has {free} free cells, and none of their area is {CLEARANCE_M:g}"
            " m away from all walls. Give a map with more free cells, such as one of a longer exploration."
        )
    rooms = np.where(stands, CellState.FREE, CellState.UNKNOWN).astype(np.uint8)
    return PartialMap(rooms, cell_m, partial.origin_m, partial.wall_height_m)


def _receivers(partial: PartialMap, rx_height_m: float) -> tuple[NDArray[np.float64], float]:
    """Place receivers (N, 3) where `predict_map` has valid ones, and say how far apart they are [m]."""
    x0, y0, x1, y1 = partial.bounds_m
    spacing_m = max(RECEIVER_SPACING_M, math.sqrt((x1 - x0) * (y1 - y0) / MAX_RECEIVERS))
    spacing_m = min(spacing_m, x1 - x0, y1 - y0)
    x, y = np.meshgrid(
        np.arange(x0 + spacing_m / 2, x1, spacing_m),
        np.arange(y0 + spacing_m / 2, y1, spacing_m),
    )
    points_m = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, float(rx_height_m))])
    return points_m[clear_of_walls(partial, points_m)], spacing_m


def _weights(area: PlacementArea, model: Predictor | None) -> NDArray[np.float64]:
    """Weight (N,) of each receiver: 1 in free cells, else the mean P(indoor) as seen from some places."""
    free = area.partial.state_at(area.rx_m) == CellState.FREE
    if model is None or free.all():
        return free.astype(np.float64)
    places_m = area.places(0)
    views = places_m[np.unique(np.linspace(0, len(places_m) - 1, _VIEWS).astype(np.intp))]
    unseen_m = area.rx_m[~free]
    start_m, end_m = np.repeat(views, len(unseen_m), axis=0), np.tile(unseen_m, (len(views), 1))
    walled = walled_lengths_m(area.partial, start_m, end_m) > 1e-6
    distance_m = np.linalg.norm(end_m - start_m, axis=1)
    phi = LinkFeatures(
        link_state=np.where(walled, LinkState.NLOS, LinkState.LOS).astype(np.uint8),
        unobserved_distance_m=np.minimum(unobserved_lengths_m(area.partial, start_m, end_m), distance_m),
        distance_m=distance_m,
        gain_db=np.full(len(distance_m), GAIN_FLOOR_DB),
    )
    weight = np.ones(len(free))
    weight[~free] = model.predict_indoor(phi).reshape(len(views), -1).mean(axis=0)
    return weight


def _winding(points_m: NDArray[np.float64]) -> NDArray[np.intp]:
    """Order of points (N, 3) along rows that are walked to and fro, in stripes four rows wide."""
    x, y = points_m[:, 0], points_m[:, 1]
    rows = np.unique(np.round(y, 6), return_inverse=True)[1]
    stripe = rows // 4
    forth = np.where(stripe % 2 == 0, x, -x)
    return np.lexsort((rows, np.round(forth, 6), stripe))
