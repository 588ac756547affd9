"""A home of two rooms, known or half seen, and transmitters placed in it."""

from functools import cache
from typing import Any

from coverage_cases import map_of

import sionna_partial as sp
from sionna_partial.placement.placement import TransmitterPlacement

TWO_ROOMS = """
##########
#....#...#
#....#...#
#........#
#....#...#
##########
"""
"""Two rooms and a door between them, in cells of 0.5 m; the lower left corner is at (0, 0)."""

HALF_SEEN = TWO_ROOMS.replace("...#\n", "..??\n")


def home(picture: str) -> sp.PartialMap:
    return map_of(picture, 0.5, (0.0, 0.0))


@cache
def placed(picture: str = HALF_SEEN, **options: Any) -> TransmitterPlacement:
    settings = sp.TraceSettings(max_depth=0, diffraction=False)
    return sp.place_transmitter(home(picture), predictor="paper", trace_settings=settings, **options)
