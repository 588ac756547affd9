"""A home of two rooms, and a search in it that answers at once, for tests of what is made of its answers."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from coverage_fakes import FakePredictor, map_of
from numpy.typing import NDArray

from sionna_partial.placement import placement
from sionna_partial.placement.area import PlacementArea, placement_area
from sionna_partial.placement.objective import PlacementObjective
from sionna_partial.settings import SceneSettings, TraceSettings

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

TOP_M = np.array([1.6, 2.1])
"""Where the fake objective is highest, in the left room."""


def two_rooms() -> PlacementArea:
    """Where a transmitter may stand in the home, all of which is known."""
    return placement_area(map_of(TWO_ROOMS, 0.5, (0.0, 0.0)), 1.5, 1.5, None)


class FakeScene:
    """Traces nothing."""

    def __init__(self, partial: Any, *, predictor: Any, trace_settings: Any, scene_settings: Any) -> None:
        self.partial, self.predictor = partial, FakePredictor()
        self.paths = SimpleNamespace(
            settings=trace_settings or TraceSettings(), scene_settings=scene_settings or SceneSettings()
        )


class FakeViews:
    """Covers the more, the nearer the transmitter is to `TOP_M`, and counts what was looked at."""

    looked = 0
    stop_at = 10**9

    def __init__(self, scene: FakeScene, area: PlacementArea, objective: PlacementObjective) -> None:
        self.area, self.objective = area, objective

    def sees_as(self, other: "FakeViews") -> bool:
        return False

    def scores(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        type(self).looked += len(places_m)
        if self.looked > self.stop_at:
            raise KeyboardInterrupt
        return np.exp(-np.linalg.norm(places_m[:, :2] - TOP_M, axis=1) / 3.0)

    def values(self, places_m: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        return [np.linspace(0.0, 1.0, len(self.area.rx_m)) for _ in places_m]

    def slope(self, place_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return TOP_M - place_m[:2], np.zeros((0, 3))


def use_fake_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let place_transmitter use the fakes."""
    monkeypatch.setattr(placement, "DifferentiableScene", FakeScene)
    monkeypatch.setattr(placement, "PlacementViews", FakeViews)
    monkeypatch.setattr(FakeViews, "looked", 0)


def small_placement(monkeypatch: pytest.MonkeyPatch, **options: Any) -> placement.TransmitterPlacement:
    """Place a transmitter in the half seen home."""
    use_fake_search(monkeypatch)
    return placement.place_transmitter(map_of(HALF_SEEN, 0.5, (0.0, 0.0)), **options)
