from functools import cache

import numpy as np
import pytest
from coverage_cases import COMPLETE, PICTURE, TX, map_of, shipped
from placement_cases import TWO_ROOMS, home
from predictor_links import QUIET, make_links

from sionna_partial.constants import CellState
from sionna_partial.coverage.predict import predict_map
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.placement.placement import CLEARANCE_M, PlacementArea, placement_area
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import TraceSettings

pytestmark = QUIET


@cache
def indoor_in(count: int) -> Predictor:
    """Return a predictor that has learned that one receiver in so many is indoors, wherever it is."""
    phi = make_links(200)[0].take(np.repeat(np.arange(200), count))
    return shipped("paper").fit_indoor(phi, np.arange(len(phi)) % count == 0)


def two_rooms() -> PlacementArea:
    """Where a transmitter may stand in the home, all of which is known."""
    return placement_area(home(TWO_ROOMS), 1.5, 1.5, None)


class TestRoom:
    def test_free_and_away_from_walls(self) -> None:
        area = two_rooms()
        positions_m = np.array(
            [[1.0, 1.0, 1.5], [0.55, 1.0, 1.5], [0.65, 1.0, 1.5], [0.25, 1.0, 1.5], [2.75, 1.0, 1.5]]
        )
        assert area.stands(positions_m).tolist() == [True, False, True, False, False]

    def test_unknown_cells_are_no_place_but_keep_no_distance(self) -> None:
        area = placement_area(map_of("...??\n...??\n...??", 0.5, (0.0, 0.0)), 1.5, 1.5, None)
        assert area.stands(np.array([[1.45, 0.7, 1.5], [1.55, 0.7, 1.5], [9.0, 0.7, 1.5]])).tolist() == [1, 0, 0]

    def test_distance_to_walls_is_kept_at_any_resolution(self) -> None:
        for cell_m in (0.02, 0.05, 0.07, 0.3, 1.0):
            count = round(4.0 / cell_m)
            state = np.zeros((count, count), dtype=np.uint8)
            state[:, 0] = CellState.WALL
            area = placement_area(PartialMap(state, cell_m), 1.5, 1.5, None)
            x_m = np.arange(cell_m + 0.001, 3.0, 0.003)
            stands = area.stands(np.column_stack([x_m, np.full_like(x_m, 2.0), np.full_like(x_m, 1.5)]))
            nearest_m = x_m[stands].min() - cell_m
            assert CLEARANCE_M - 1e-6 <= nearest_m <= CLEARANCE_M + 0.05

    def test_area(self) -> None:
        assert two_rooms().size_m2 == pytest.approx(1.8 * 1.8 + 1.3 * 1.8 + 0.7 * 0.3, abs=1e-6)

    def test_nowhere(self) -> None:
        message = "a transmitter can stand nowhere: the map has 0 free cells, and none of their area is 0.1 m away"
        with pytest.raises(PositionError, match=message):
            placement_area(map_of("##\n?#", 0.5), 1.5, 1.5, None)
        with pytest.raises(PositionError, match="the map has 1 free cells, and none of their area"):
            placement_area(map_of("###\n#.#\n###", 0.1), 1.5, 1.5, None)


class TestPositions:
    def test_all_over_the_area_by_seed(self) -> None:
        area = two_rooms()
        positions_m = area.positions(3)
        assert area.stands(positions_m).all()
        assert (positions_m[:, 2] == 1.5).all()
        assert len(positions_m) == pytest.approx(area.size_m2 / 0.25**2, rel=0.25)
        np.testing.assert_array_equal(area.positions(3), positions_m)
        assert not np.isin(area.positions(4)[:, 0], positions_m[:, 0]).any()

    def test_no_more_than_wanted_on_a_large_map(self) -> None:
        area = placement_area(PartialMap(np.zeros((200, 300), dtype=np.uint8), 0.2), 1.5, 1.5, None)
        assert 400 < len(area.positions(0)) < 600

    def test_area_that_the_grid_misses(self) -> None:
        state = np.full((40, 40), CellState.UNKNOWN, dtype=np.uint8)
        state[20, 20:23] = CellState.FREE
        area = placement_area(PartialMap(state, 0.05), 1.5, 1.5, indoor_in(4))
        for seed in range(5):
            assert area.stands(area.positions(seed)).all()


class TestReceivers:
    def test_where_predict_map_has_valid_ones(self) -> None:
        partial, settings = map_of(PICTURE), TraceSettings(max_depth=0, diffraction=False)
        coverage = predict_map(partial, TX, spacing_m=0.5, predictor=shipped("paper"), trace_settings=settings)
        rows, columns = np.nonzero(coverage["valid"].to_numpy())
        expected = np.column_stack([coverage["x"].to_numpy()[columns], coverage["y"].to_numpy()[rows]])
        found = placement_area(partial, 1.5, 1.2, indoor_in(4)).rx_m
        np.testing.assert_allclose(found[:, :2], expected)
        assert (found[:, 2] == 1.2).all()

    def test_unknown_ones_count_as_much_as_they_are_indoors(self) -> None:
        partial = map_of(PICTURE)
        area = placement_area(partial, 1.5, 1.5, indoor_in(4))
        free = partial.state_at(area.rx_m) == CellState.FREE
        assert 0 < free.sum() < len(free)
        np.testing.assert_allclose(area.weight, np.where(free, 1.0, 0.25), atol=0.01)
        hardly = placement_area(partial, 1.5, 1.5, indoor_in(100))
        assert (partial.state_at(hardly.rx_m) == CellState.FREE).all()

    def test_outside_of_a_complete_map_does_not_count(self) -> None:
        partial = map_of(COMPLETE)
        area = placement_area(partial, 1.5, 1.5, None)
        assert (partial.state_at(area.rx_m) == CellState.FREE).all()
        assert (area.weight == 1.0).all()

    def test_the_nearer_to_free_cells_the_more(self) -> None:
        """P(indoor) is predicted for lengths that grow with the distance from the free cells."""
        area = placement_area(map_of("....??????", 0.5, (0.0, 0.0)), 1.5, 1.5, shipped("paper"))
        order = np.argsort(area.rx_m[:, 0])
        assert (np.diff(area.weight[order][3:]) < 0.0).all()

    def test_fewer_on_a_huge_map(self) -> None:
        area = placement_area(PartialMap(np.zeros((100, 100), dtype=np.uint8), 1.0), 1.5, 1.5, None)
        assert 3500 < len(area.rx_m) < 4500
        assert area.spacing_m == pytest.approx(100 / np.sqrt(4000))

    def test_no_receiver(self) -> None:
        state = np.full((20, 20), CellState.UNKNOWN, dtype=np.uint8)
        state[1:5, 1:5] = CellState.WALL
        state[2:4, 2:4] = CellState.FREE
        with pytest.raises(PositionError, match=r"no receiver can stand anywhere: all positions of a grid of 0\.5 m"):
            placement_area(PartialMap(state, 0.15), 1.5, 1.5, None)


class TestThinned:
    def test_stands_for_all(self) -> None:
        partial = PartialMap(np.zeros((100, 160), dtype=np.uint8), 0.1)
        area = placement_area(partial, 1.5, 1.5, None)
        thinned = area.thinned(60)
        assert area.thinned(10_000) is area
        assert len(thinned.rx_m) == 60
        for axis in (0, 1):
            mean, all_mean = (np.average(each.rx_m[:, axis], weights=each.weight) for each in (thinned, area))
            assert mean == pytest.approx(all_mean, abs=0.3)

    def test_more_where_they_weigh_more(self) -> None:
        partial = PartialMap(np.repeat([[0], [0], [2], [2]], 40, axis=1).repeat(10, axis=0).astype(np.uint8), 0.2)
        area = placement_area(partial, 1.5, 1.5, indoor_in(4))
        thinned = area.thinned(50)
        free = partial.state_at(thinned.rx_m) == CellState.FREE
        assert thinned.weight[free].sum() / thinned.weight.sum() == pytest.approx(0.8, abs=0.05)
        assert thinned.weight.sum() == 50


class TestVisibility:
    def test_open_unknown_and_walled(self) -> None:
        partial = map_of("#####\n....?\n####?", 1.0, (0.0, 0.0))
        area = PlacementArea(
            partial, 1.5, partial, np.array([[3.5, 1.5, 1.5], [4.5, 1.5, 1.5], [4.5, 0.5, 1.5]]), np.ones(3), 0.5
        )
        clear, unseen, walled = area.visibility(np.array([[0.5, 1.5, 1.5]]))[0]
        assert clear == 1.0
        assert unseen == pytest.approx(np.exp(-0.5 / 4.0))
        assert 0.0 < walled < unseen

    def test_beyond_range(self) -> None:
        area = two_rooms()
        seen = area.visibility(np.array([[1.0, 1.0, 1.5]]), range_m=1.0)[0]
        far = np.linalg.norm(area.rx_m - [1.0, 1.0, 1.5], axis=1) > 1.0
        left = area.rx_m[:, 0] < 2.4
        assert (seen[~far] == 1.0).all()
        assert (seen[far & left] == 0.0).all()
