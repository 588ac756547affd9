"""A home of two rooms, partly seen and all of it, and what is predicted on it."""

from functools import cache

import xarray as xr
from extruded import drawn

from sionna_partial.coverage.job import predict_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.predictor import Predictor, warm_predictor
from sionna_partial.settings import TraceSettings

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
def _predicted(several: bool, settings: TraceSettings) -> xr.Dataset:
    tx = SEVERAL if several else TX
    return predict_map(map_of(PICTURE), tx, spacing_m=0.25, predictor=shipped(), trace_settings=settings)


def small_coverage(*, several: bool = False) -> xr.Dataset:
    """Return a copy of the coverage map of `PICTURE`, with receivers 0.25 m apart, under the settings of the test."""
    return _predicted(several, TraceSettings()).copy(deep=True)
