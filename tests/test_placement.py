"""Positions of transmitters: found again, as good as in the trace, and to the same bytes."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from coverage_cases import COMPLETE, PICTURE, TX, map_of, shipped
from placement_cases import HALF_SEEN, TWO_ROOMS, home, placed
from predictor_links import QUIET, make_links
from scipy.stats import norm

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.coverage.job import predict_map
from sionna_partial.errors import PositionError, SettingsError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.placement.area import CLEARANCE_M, PlacementArea, placement_area
from sionna_partial.placement.placement import STARTS, link_values, placement_score
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.settings import PlacementSettings, TraceSettings

PROBABILITIES = np.array([[0.1, 1.0, 0.0, 0.5], [0.6, 0.0, 0.0, 0.3], [0.3, 0.0, 1.0, 0.2]])
MEANS_DB = np.array([[-150.0] * 4, [-80.0, -90.0, -70.0, -101.0], [-105.0, -110.0, -99.0, -95.0]])
STDS_DB = np.array([[0.0] * 4, [3.0, 4.0, 2.0, 5.0], [8.0, 9.0, 7.0, 6.0]])
PERCENTILE = PlacementSettings("percentile")
DIRECT = sp.TraceSettings(max_depth=0, diffraction=False)


def prediction(spread: float = 1.0) -> LinkPrediction:
    return LinkPrediction.of_parts(PROBABILITIES, MEANS_DB, spread * STDS_DB)


class TestObjective:
    def test_coverage_is_the_weighted_mean_probability(self) -> None:
        found = link_values(prediction(), PlacementSettings())
        np.testing.assert_allclose(found, (PROBABILITIES[1:] * norm.sf(-100.0, MEANS_DB[1:], STDS_DB[1:])).sum(axis=0))
        np.testing.assert_allclose(link_values(prediction(0.0), PlacementSettings()), [0.6, 0.0, 1.0, 0.2])
        score = placement_score(np.array([1.0, 0.5, 0.0]), np.array([1.0, 3.0, 1.0]), PlacementSettings())
        assert score == pytest.approx(0.5)

    def test_percentile_is_the_mean_gain_around_the_tenth(self) -> None:
        """Of ranks u in [0, 1] the mean of u under the weights 1 to 0.05, falling to 0 at 0.15, is 13 / 240."""
        np.testing.assert_array_equal(link_values(prediction(), PERCENTILE), prediction().gain_mean_db)
        values = 100.0 * (np.arange(100_000) + 0.5) / 100_000
        score = placement_score(values, np.ones(len(values)), PERCENTILE)
        assert score == pytest.approx(1300.0 / 240.0, abs=1e-3)
        better = np.where(values > np.quantile(values, 0.16), 1e3, values)
        assert placement_score(better, np.ones(len(values)), PERCENTILE) == score

    def test_weight_is_number(self) -> None:
        rng = np.random.default_rng(0)
        values, weight = rng.normal(size=30), rng.integers(1, 5, 30)
        several = placement_score(np.repeat(values, weight), np.ones(weight.sum()), PERCENTILE)
        assert placement_score(values, weight.astype(float), PERCENTILE) == pytest.approx(several)


def test_refines_the_best_start_at_given_heights() -> None:
    found = placed(tx_height_m=2.5, rx_height_m=0.7)
    assert STARTS[0] == len(found.starts_m) == len(found.start_scores)
    np.testing.assert_array_equal(found.trajectory_m[0], found.starts_m[found.start_scores.argmax()])
    np.testing.assert_array_equal(found.trajectory_m[-1], found.position_m)
    assert (np.diff(found.scores) > 0.0).all()
    assert found.score == placement_score(found.values, found.weight, found.settings)
    tried_m = np.vstack([found.starts_m, found.trajectory_m])
    assert (tried_m[:, 2] == 2.5).all()
    assert (found.rx_m[:, 2] == 0.7).all()
    assert (found.partial.state_at(tried_m) == sp.CellState.FREE).all()


def test_starts_by_size() -> None:
    hall = sp.PartialMap(np.zeros((40, 60), dtype=np.uint8), 0.5)
    assert len(sp.place_transmitter(hall, predictor="paper", trace_settings=DIRECT).starts_m) == STARTS[1]
    closet = sp.PartialMap(np.pad(np.zeros((8, 8), np.uint8), 1, constant_values=1), 0.1)
    found = sp.place_transmitter(closet, trace_settings=DIRECT)
    assert (found.score, len(found.trajectory_m)) == (1.0, 1)


def test_score_is_that_of_traced_and_predicted_links() -> None:
    found = placed(objective="percentile")
    far = np.linalg.norm(found.rx_m - found.position_m, axis=1) > 0.02
    links = sp.trace_links(found.partial, found.position_m, found.rx_m[far], trace_settings=DIRECT)
    model = sp.LinkModel(found.partial, predictor="paper", trace_settings=DIRECT)
    answer = model.predict_features(sp.link_features(found.partial, links))
    np.testing.assert_allclose(found.values[far], link_values(answer, found.settings), atol=1e-3)


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    found = [placed(seed=4), placed.__wrapped__(seed=4), placed(seed=5)]
    for number, placement in enumerate(found):
        placement.save(tmp_path / f"{number}.json")
    first, again, other = ((tmp_path / f"{number}.json").read_bytes() for number in range(3))
    assert first == again != other
    record = json.loads(first)
    assert record["position_m"] == found[0].position_m.tolist()
    assert record["settings"]["trace_settings"]["frequency_hz"] == 28e9
    assert record["settings"]["predictor"] == "paper"


def test_settings_are_checked() -> None:
    for options, message in (
        ({"objective": "all"}, "objective = 'all' is not allowed: choose one of coverage, percentile"),
        ({"tx_height_m": 3.0}, r"tx_height_m = 3\.0 is not allowed: stay below the ceiling at 3 m"),
    ):
        with pytest.raises(SettingsError, match=message):
            sp.place_transmitter(home(HALF_SEEN), **options)


@pytest.mark.parametrize("objective", ["coverage", "percentile"])
def test_finds_the_door(objective: str) -> None:
    """Two closed rooms with a door: from the door both are seen, from nowhere else are as many positions."""
    state = np.zeros((34, 62), dtype=np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = state[:, 30] = sp.CellState.WALL
    state[14:20, 30] = sp.CellState.FREE
    two_rooms, settings = sp.PartialMap(state, 0.1), sp.TraceSettings(max_depth=1, diffraction=False)
    found = sp.place_transmitter(two_rooms, objective=objective, threshold_db=-90.0, seed=1, trace_settings=settings)
    corner = (1.0, 0.6, 1.5)
    rx = found.rx_m[np.linalg.norm(found.rx_m - found.position_m, axis=1) > 0.02]
    gains_db = [sp.trace_links(two_rooms, tx, rx, trace_settings=settings).gain_db for tx in (found.position_m, corner)]
    if objective == "coverage":
        assert found.score == pytest.approx(np.mean(gains_db[0] > -90.0), abs=1.5 / len(rx))
        assert found.score > np.mean(gains_db[1] > -90.0)
    assert np.sort(gains_db[0])[: len(rx) // 10].mean() >= np.sort(gains_db[1])[: len(rx) // 10].mean()


pytestmark = QUIET


@cache
def indoor_in(count: int) -> Predictor:
    """Return a predictor that has learned that one receiver in so many is indoors, wherever it is."""
    phi = make_links(200)[0].take(np.repeat(np.arange(200), count))
    return shipped("paper").fit_indoor(phi, np.arange(len(phi)) % count == 0)


def two_rooms() -> PlacementArea:
    return placement_area(home(TWO_ROOMS), 1.5, 1.5, None)


class TestRoom:
    def test_unknown_cells_are_no_place_but_keep_no_distance(self) -> None:
        area = placement_area(map_of("...??\n...??\n...??", 0.5, (0.0, 0.0)), 1.5, 1.5, None)
        assert area.stands(np.array([[1.45, 0.7, 1.5], [1.55, 0.7, 1.5], [9.0, 0.7, 1.5]])).tolist() == [1, 0, 0]

    def test_distance_to_walls_is_kept_at_any_resolution(self) -> None:
        for cell_m in (0.05, 0.07, 0.3, 1.0):
            count = round(4.0 / cell_m)
            state = np.zeros((count, count), dtype=np.uint8)
            state[:, 0] = CellState.WALL
            area = placement_area(PartialMap(state, cell_m), 1.5, 1.5, None)
            x_m = np.arange(cell_m + 0.001, 3.0, 0.003)
            stands = area.stands(np.column_stack([x_m, np.full_like(x_m, 2.0), np.full_like(x_m, 1.5)]))
            nearest_m = x_m[stands].min() - cell_m
            assert CLEARANCE_M - 1e-6 <= nearest_m <= CLEARANCE_M + 0.05

    def test_nowhere(self) -> None:
        message = "a transmitter can stand nowhere: the map has 0 free cells, and none of their area is 0.1 m away"
        with pytest.raises(PositionError, match=message):
            placement_area(map_of("##\n?#", 0.5), 1.5, 1.5, None)


class TestPositions:
    def test_all_over_the_area_by_seed(self) -> None:
        area = two_rooms()
        positions_m = area.positions(3)
        assert area.stands(positions_m).all()
        assert (positions_m[:, 2] == 1.5).all()
        assert len(positions_m) == pytest.approx(area.size_m2 / 0.25**2, rel=0.25)
        np.testing.assert_array_equal(area.positions(3), positions_m)
        assert not np.isin(area.positions(4)[:, 0], positions_m[:, 0]).any()

    def test_area_that_the_grid_misses(self) -> None:
        state = np.full((40, 40), CellState.UNKNOWN, dtype=np.uint8)
        state[20, 20:23] = CellState.FREE
        area = placement_area(PartialMap(state, 0.05), 1.5, 1.5, indoor_in(4))
        assert area.stands(area.positions(0)).all()


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
        complete = placement_area(map_of(COMPLETE), 1.5, 1.5, None)
        for area in (hardly, complete):
            assert (area.partial.state_at(area.rx_m) == CellState.FREE).all()
            assert (area.weight == 1.0).all()

    def test_no_receiver(self) -> None:
        state = np.full((20, 20), CellState.UNKNOWN, dtype=np.uint8)
        state[1:5, 1:5] = CellState.WALL
        state[2:4, 2:4] = CellState.FREE
        with pytest.raises(PositionError, match=r"no receiver can stand anywhere: all positions of a grid of 0\.5 m"):
            placement_area(PartialMap(state, 0.15), 1.5, 1.5, None)


def test_few_receivers_stand_for_all() -> None:
    partial = PartialMap(np.repeat([[0], [0], [2], [2]], 40, axis=1).repeat(10, axis=0).astype(np.uint8), 0.2)
    area = placement_area(partial, 1.5, 1.5, indoor_in(4))
    thinned = area.thinned(50)
    assert area.thinned(10_000) is area
    free = partial.state_at(thinned.rx_m) == CellState.FREE
    assert thinned.weight[free].sum() / thinned.weight.sum() == pytest.approx(0.8, abs=0.05)
    assert thinned.weight.sum() == 50
    for axis in (0, 1):
        mean_m, all_mean_m = (np.average(each.rx_m[:, axis], weights=each.weight) for each in (thinned, area))
        assert mean_m == pytest.approx(all_mean_m, abs=0.3)


def test_visibility_in_the_open_through_unknown_cells_and_walls() -> None:
    partial = map_of("#####\n....?\n####?", 1.0, (0.0, 0.0))
    area = PlacementArea(
        partial, 1.5, partial, np.array([[3.5, 1.5, 1.5], [4.5, 1.5, 1.5], [4.5, 0.5, 1.5]]), np.ones(3), 0.5
    )
    clear, unseen, walled = area.visibility(np.array([[0.5, 1.5, 1.5]]))[0]
    assert clear == 1.0
    assert unseen == pytest.approx(np.exp(-0.5 / 4.0))
    assert 0.0 < walled < unseen
