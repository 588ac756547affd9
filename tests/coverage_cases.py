"""A home of two rooms, partly seen and all of it, and what is predicted on it."""

from functools import cache

import xarray as xr
from extruded import drawn

from sionna_partial.coverage.job import predict_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.predictor import Predictor, warm_predictor

PICTURE = """
????????????
?##########?
?#.....#...?
?#.....#.???
?#.........?
?#.....#..#?
?##########?
????????????
"""
"""A partly seen home of two rooms; the first line holds the largest y."""

COMPLETE = """
????????????
?##########?
?#.....#...#
?#.....#..#?
?#.........#
?#.....#..##
?##########?
????????????
"""
"""All of that home."""

TX = (0.6, 3.6)
"""Where the transmitter stands."""

SEVERAL = {"west": TX, "<b>east$}$": (3.4, 3.1)}
"""Where several stand."""


def map_of(picture: str, resolution_m: float = 0.5, origin_m: tuple[float, float] = (-1.0, 2.0)) -> PartialMap:
    """Make a map of a drawing, off the world's origin."""
    return drawn(picture, resolution_m, origin_m)


def shipped(name: str = "map") -> Predictor:
    """Return a shipped predictor, which is read once in a process."""
    return warm_predictor(name)


@cache
def _predicted(several: bool) -> xr.Dataset:
    return predict_map(map_of(PICTURE), SEVERAL if several else TX, spacing_m=0.25, predictor=shipped())


def small_coverage(*, several: bool = False) -> xr.Dataset:
    """Return a copy of the coverage map of `PICTURE`, with receivers 0.25 m apart."""
    return _predicted(several).copy(deep=True)
