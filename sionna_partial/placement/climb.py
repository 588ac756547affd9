"""Climbs: ascents of a transmitter's place along the slope of an objective, around walls, several at once."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.placement.area import PlacementArea

TRIALS_M = (1.5, 0.5, 0.2)
"""How far from a place the next one is looked for, along the slope [m]; the best of them is taken if it is better."""

_ROUND_DIGITS = 3
"""Places are rounded to millimetres: the last bits of a slope, which depend on the number of threads, do not count."""

_FLAT = 1e-12

Look = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Gives the objective (K,) at places (K, 3) [m]."""

Slope = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Gives the slope (2,) of the objective at a place (3,) along x and y [1/m], and places (K, 3) that were looked at to
find it, which are tried, too."""


@dataclass(frozen=True, eq=False)
class Climb:
    """The way of one ascent.

    Parameters
    ----------
    trajectory_m : (K, 3) float64 array
        Its places, the first is where it started [m].
    scores : (K,) float64 array
        The objective at each, at some of the receivers. It rises.
    ended : bool
        Whether no better place was found in the direction of the last slope.
    """

    trajectory_m: NDArray[np.float64]
    scores: NDArray[np.float64]
    ended: bool = False

    @property
    def record(self) -> dict[str, Any]:
        """It as plain data."""
        return {"trajectory_m": self.trajectory_m.tolist(), "scores": self.scores.tolist(), "ended": self.ended}

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> "Climb":
        """Read a record; it may raise a KeyError, TypeError or ValueError."""
        return cls(np.array(record["trajectory_m"]), np.array(record["scores"]), bool(record["ended"]))


def climb_on(area: PlacementArea, climbs: list[Climb], look: Look, slope: Slope) -> list[Climb]:
    """Take one step of each climb that has not ended.

    A step goes along the slope, or, where walls or unknown cells are in the way, along that axis of it that is free;
    or to a place beside, if the slope was found there.

    Parameters
    ----------
    area : PlacementArea
    climbs : list of Climb
    look : Look
    slope : Slope

    Returns
    -------
    list of Climb
        In their order.
    """
    tried = []
    for climb in climbs:
        place_m = climb.trajectory_m[-1]
        tried.append([] if climb.ended else next_places(area, place_m, *slope(place_m)))
    places_m = [place for places in tried for place in places]
    scores = look(np.array(places_m)) if places_m else np.zeros(0)
    starts = np.cumsum([0, *map(len, tried)])
    return [
        climb if climb.ended else _next(climb, places, scores[start : start + len(places)])
        for climb, places, start in zip(climbs, tried, starts, strict=False)
    ]


def next_places(
    area: PlacementArea, place_m: NDArray[np.float64], slope: NDArray[np.float64], beside_m: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Places (3,) beside a place and along a slope (2,) that can be reached straight from it [m]."""
    found = list(beside_m)
    size = float(np.hypot(*slope))
    if not (math.isfinite(size) and size > _FLAT):
        return found
    for length_m in TRIALS_M[:-1] if found else TRIALS_M:
        for direction in (slope / size, *_along_axes(slope)):
            there_m = place_m + np.append(length_m * direction, 0.0)
            there_m[:2] = np.round(there_m[:2], _ROUND_DIGITS)
            if area.reaches(place_m, there_m):
                found.append(there_m)
                break
    return found


def smoothed_slope(area: PlacementArea, look: Look, reach_m: float) -> Slope:
    """Return the slope of an objective that is averaged along each axis, over `reach_m` to either side of a place.

    The derivative of that average is the difference of the objective at both ends, over their distance. The ends are
    traced, so that paths which appear or vanish between them count: edges of visibility become slopes. Where one end
    cannot be reached, the slope is that of the other half.
    """

    def slope(place_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        ends_m = [place_m + sign * reach_m * axis for axis in np.eye(3)[:2] for sign in (1.0, -1.0)]
        ends_m = [np.append(np.round(end_m[:2], _ROUND_DIGITS), end_m[2]) for end_m in ends_m]
        beside_m = np.array([end_m for end_m in ends_m if area.reaches(place_m, end_m)]).reshape(-1, 3)
        scores = look(np.vstack([place_m, beside_m]))
        steps_m = beside_m[:, :2] - place_m[:2]
        found: NDArray[np.float64] = np.linalg.pinv(steps_m) @ (scores[1:] - scores[0])
        return found, beside_m

    return slope


def _along_axes(slope: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return unit vectors along the axes that rise, the steeper first."""
    axes = [np.array([np.sign(slope[0]), 0.0]), np.array([0.0, np.sign(slope[1])])]
    order = (0, 1) if abs(slope[0]) >= abs(slope[1]) else (1, 0)
    return [axes[axis] for axis in order if slope[axis] != 0.0]


def _next(climb: Climb, places_m: list[NDArray[np.float64]], scores: NDArray[np.float64]) -> Climb:
    best = int(np.argmax(scores)) if len(scores) else -1
    if best < 0 or not scores[best] > climb.scores[-1]:
        return Climb(climb.trajectory_m, climb.scores, ended=True)
    return Climb(np.vstack([climb.trajectory_m, places_m[best]]), np.append(climb.scores, scores[best]))
