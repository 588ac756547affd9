import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from placement_fakes import TOP_M, two_rooms

from sionna_partial.placement.climb import TRIALS_M, Climb, climb_on, next_places, smoothed_slope

AREA = two_rooms()
NONE_BESIDE = np.zeros((0, 3))


def hill(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    return -((places_m[:, :2] - TOP_M) ** 2).sum(axis=1)


def hill_slope(place_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return -2.0 * (place_m[:2] - TOP_M), NONE_BESIDE


def start_at(x: float, y: float) -> Climb:
    place_m = np.array([[x, y, 1.5]])
    return Climb(place_m, hill(place_m))


class TestClimbOn:
    def test_rises_to_the_top(self) -> None:
        climbs = [start_at(0.8, 0.8), start_at(2.0, 2.2)]
        for _ in range(12):
            climbs = climb_on(AREA, climbs, hill, hill_slope)
        for climb in climbs:
            assert climb.ended
            assert (np.diff(climb.scores) > 0.0).all()
            assert np.linalg.norm(climb.trajectory_m[-1, :2] - TOP_M) <= TRIALS_M[-1] / 2 + 1e-3
            np.testing.assert_allclose(climb.scores, hill(climb.trajectory_m))
            assert (climb.trajectory_m[:, 2] == 1.5).all()

    def test_goes_around_walls(self) -> None:
        """From the right room the slope leads into the wall: the climb slides along it, and never crosses it."""
        climbs = [start_at(3.2, 2.2)]
        for _ in range(20):
            climbs = climb_on(AREA, climbs, hill, hill_slope)
        trajectory_m = climbs[0].trajectory_m
        assert all(AREA.reaches(*ends) for ends in itertools.pairwise(trajectory_m))
        assert climbs[0].ended
        assert trajectory_m[:, 0].min() > 3.0

    def test_ended_climbs_stay(self) -> None:
        done = Climb(np.array([[1.0, 1.0, 1.5]]), np.array([-1.0]), ended=True)
        (same,) = climb_on(AREA, [done], hill, hill_slope)
        assert same is done

    @pytest.mark.parametrize("slope", [(0.0, 0.0), (np.nan, 1.0)])
    def test_no_slope_ends_it(self, slope: tuple[float, float]) -> None:
        (climb,) = climb_on(AREA, [start_at(1.0, 1.0)], hill, lambda place_m: (np.array(slope), NONE_BESIDE))
        assert climb.ended
        assert len(climb.scores) == 1

    def test_looks_at_all_trials_together(self) -> None:
        calls = []

        def look(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
            calls.append(len(places_m))
            return hill(places_m)

        climb_on(AREA, [start_at(0.8, 0.8), start_at(2.0, 0.8)], look, hill_slope)
        assert calls == [2 * len(TRIALS_M)]

    def test_places_are_whole_millimetres(self) -> None:
        (climb,) = climb_on(AREA, [start_at(0.8, 0.8)], hill, hill_slope)
        assert (np.round(climb.trajectory_m[-1], 3) == climb.trajectory_m[-1]).all()


class TestNextPlaces:
    def test_along_the_slope(self) -> None:
        found = next_places(AREA, np.array([0.8, 0.9, 1.5]), np.array([3.0, 4.0]), NONE_BESIDE)
        for place_m, length_m in zip(found, TRIALS_M, strict=True):
            np.testing.assert_allclose(place_m, [0.8 + 0.6 * length_m, 0.9 + 0.8 * length_m, 1.5], atol=1e-3)

    def test_along_the_free_axis_at_a_wall(self) -> None:
        found = next_places(AREA, np.array([2.3, 2.2, 1.5]), np.array([4.0, -1.0]), NONE_BESIDE)
        for place_m, length_m in zip(found, TRIALS_M, strict=True):
            np.testing.assert_allclose(place_m, [2.3, 2.2 - length_m, 1.5])

    def test_in_a_corner(self) -> None:
        assert next_places(AREA, np.array([2.38, 2.38, 1.5]), np.array([1.0, 1.0]), NONE_BESIDE) == []

    def test_places_beside_are_tried_too(self) -> None:
        beside_m = np.array([[1.2, 1.0, 1.5], [0.8, 1.0, 1.5]])
        found = next_places(AREA, np.array([1.0, 1.0, 1.5]), np.array([1.0, 0.0]), beside_m)
        along_m = [[1.0 + length_m, 1.0, 1.5] for length_m in TRIALS_M[1:-1]]
        np.testing.assert_allclose(found, [*beside_m, *along_m])


class TestSmoothedSlope:
    def test_of_a_plane(self) -> None:
        slope, beside_m = smoothed_slope(AREA, lambda at: 3.0 * at[:, 0] - 2.0 * at[:, 1], 0.25)(
            np.array([1.5, 1.5, 1.5])
        )
        np.testing.assert_allclose(slope, [3.0, -2.0], rtol=1e-12)
        assert len(beside_m) == 4

    def test_is_the_slope_of_the_mean_along_each_axis(self) -> None:
        """Half a metre of a function that steps from 0 to 1 rises by 1 / 0.5 m, wherever in it the step is."""
        for edge_m in (1.3, 1.45, 1.74):
            slope, _ = smoothed_slope(AREA, lambda at, edge_m=edge_m: (at[:, 0] > edge_m) * 1.0, 0.25)(
                np.array([1.5, 1.5, 1.5])
            )
            assert slope[0] == pytest.approx(2.0)
            assert slope[1] == pytest.approx(0.0, abs=1e-12)

    def test_beside_a_wall_it_is_that_of_the_other_half(self) -> None:
        slope, beside_m = smoothed_slope(AREA, lambda at: at[:, 0] ** 2, 0.25)(np.array([2.3, 1.8, 1.5]))
        assert slope[0] == pytest.approx((2.3**2 - 2.05**2) / 0.25)
        assert len(beside_m) == 3

    def test_nothing_can_be_reached(self) -> None:
        slope, beside_m = smoothed_slope(AREA, lambda at: at[:, 0], 5.0)(np.array([1.5, 1.5, 1.5]))
        assert slope.tolist() == [0.0, 0.0]
        assert beside_m.shape == (0, 3)


def test_record() -> None:
    climb = Climb(np.array([[0.1, 0.2, 0.3], [1.0 / 3.0, 0.2, 0.3]]), np.array([0.1, 0.7]), ended=True)
    again = Climb.of_record(climb.record)
    assert again.record == climb.record
    assert again.trajectory_m.tobytes() == climb.trajectory_m.tobytes()
