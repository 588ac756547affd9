"""Positions of transmitters: found again, as good as in the trace, and to the same bytes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from placement_cases import HALF_SEEN, TWO_ROOMS, home, placed
from scipy.stats import norm

import sionna_partial as sp
from sionna_partial.errors import PositionError, SettingsError
from sionna_partial.placement.placement import STARTS, TransmitterPlacement, link_values, placement_score
from sionna_partial.prediction.predictor import LinkPrediction
from sionna_partial.settings import PlacementSettings

PROBABILITIES = np.array([[0.1, 1.0, 0.0, 0.5], [0.6, 0.0, 0.0, 0.3], [0.3, 0.0, 1.0, 0.2]])
MEANS_DB = np.array([[-150.0] * 4, [-80.0, -90.0, -70.0, -101.0], [-105.0, -110.0, -99.0, -95.0]])
STDS_DB = np.array([[0.0] * 4, [3.0, 4.0, 2.0, 5.0], [8.0, 9.0, 7.0, 6.0]])
PERCENTILE = PlacementSettings("percentile")
DIRECT = sp.TraceSettings(max_depth=0, diffraction=False)


def placed_bytes(found: TransmitterPlacement, folder: Path) -> bytes:
    found.save(folder / "placement.json")
    return (folder / "placement.json").read_bytes()


def prediction(spread: float = 1.0) -> LinkPrediction:
    return LinkPrediction.of_parts(PROBABILITIES, MEANS_DB, spread * STDS_DB)


class TestCoverage:
    def test_probability_of_the_mixture(self) -> None:
        found = link_values(prediction(), PlacementSettings())
        np.testing.assert_allclose(found, (PROBABILITIES[1:] * norm.sf(-100.0, MEANS_DB[1:], STDS_DB[1:])).sum(axis=0))

    def test_certain_gains_are_covered_or_not(self) -> None:
        np.testing.assert_allclose(link_values(prediction(0.0), PlacementSettings()), [0.6, 0.0, 1.0, 0.2])

    def test_score_is_the_weighted_mean(self) -> None:
        score = placement_score(np.array([1.0, 0.5, 0.0]), np.array([1.0, 2.0, 1.0]), PlacementSettings())
        assert score == pytest.approx(0.5)


class TestPercentile:
    def test_mean_of_what_is_around_the_tenth(self) -> None:
        """Of ranks u in [0, 1] the mean of u under the weights 1 to 0.05, falling to 0 at 0.15, is 13 / 240."""
        values = 100.0 * (np.arange(100_000) + 0.5) / 100_000
        assert placement_score(values, np.ones(len(values)), PERCENTILE) == pytest.approx(1300.0 / 240.0, abs=1e-3)

    def test_better_receivers_do_not_count(self) -> None:
        values = np.linspace(-150.0, -50.0, 200)
        changed = np.where(values > np.quantile(values, 0.16), 0.0, values)
        scores = [placement_score(each, np.ones(200), PERCENTILE) for each in (changed, values)]
        assert scores[0] == scores[1]

    def test_weight_is_number(self) -> None:
        rng = np.random.default_rng(0)
        values, weight = rng.normal(size=30), rng.integers(1, 5, 30)
        several = placement_score(np.repeat(values, weight), np.ones(weight.sum()), PERCENTILE)
        assert placement_score(values, weight.astype(float), PERCENTILE) == pytest.approx(several)

    def test_values_are_mean_gains(self) -> None:
        np.testing.assert_array_equal(link_values(prediction(), PERCENTILE), prediction().gain_mean_db)


class TestSearch:
    def test_refines_the_best_start(self) -> None:
        found = placed()
        assert STARTS[0] == len(found.starts_m) == len(found.start_scores)
        np.testing.assert_array_equal(found.trajectory_m[0], found.starts_m[found.start_scores.argmax()])
        np.testing.assert_array_equal(found.trajectory_m[-1], found.position_m)
        assert (np.diff(found.scores) > 0.0).all()
        assert found.score == placement_score(found.values, found.weight, found.settings)

    def test_more_starts_on_a_large_map(self) -> None:
        hall = sp.PartialMap(np.zeros((40, 60), dtype=np.uint8), 0.5)
        found = sp.place_transmitter(hall, predictor="paper", trace_settings=DIRECT)
        assert len(found.starts_m) == STARTS[1]

    def test_heights_and_free_cells(self) -> None:
        found = placed(tx_height_m=2.5, rx_height_m=0.7)
        tried_m = np.vstack([found.starts_m, found.trajectory_m])
        assert (tried_m[:, 2] == 2.5).all()
        assert (found.rx_m[:, 2] == 0.7).all()
        assert (found.partial.state_at(tried_m) == sp.CellState.FREE).all()

    def test_receivers_that_are_hardly_indoors_count_less(self) -> None:
        found = placed()
        free = found.partial.state_at(found.rx_m) == sp.CellState.FREE
        assert (found.weight[free] == 1.0).all()
        assert ((found.weight[~free] > 0.0) & (found.weight[~free] < 1.0)).all()

    @pytest.mark.parametrize("options", [{}, {"objective": "percentile"}])
    def test_score_is_that_of_traced_and_predicted_links(self, options: dict[str, Any]) -> None:
        found = placed(**options)
        far = np.linalg.norm(found.rx_m - found.position_m, axis=1) > 0.02
        links = sp.trace_links(found.partial, found.position_m, found.rx_m[far], trace_settings=DIRECT)
        answer = sp.Predictor.load("paper").predict(sp.link_features(found.partial, links))
        np.testing.assert_allclose(found.values[far], link_values(answer, found.settings), atol=1e-6)

    def test_path_of_a_map(self, tmp_path: Path) -> None:
        sp.save_map(home(TWO_ROOMS), tmp_path / "map.yaml")
        found = sp.place_transmitter(tmp_path / "map.yaml", trace_settings=DIRECT)
        np.testing.assert_array_equal(found.position_m, placed(TWO_ROOMS).position_m)

    def test_progress_rises_to_one(self) -> None:
        calls: list[float] = []
        sp.place_transmitter(home(TWO_ROOMS), progress=lambda fraction, message: calls.append(fraction))
        assert calls == sorted(calls)
        assert (calls[0], calls[-1]) == (0.0, 1.0)


class TestRepeats:
    def test_same_seed_same_bytes(self, tmp_path: Path) -> None:
        first, again, other = placed(seed=4), placed.__wrapped__(seed=4), placed(seed=5)
        assert placed_bytes(first, tmp_path) == placed_bytes(again, tmp_path) != placed_bytes(other, tmp_path)

    def test_record(self, tmp_path: Path) -> None:
        found = placed()
        record = json.loads(placed_bytes(found, tmp_path))
        assert record["position_m"] == found.position_m.tolist()
        assert record["score"] == found.score
        assert record["trajectory_m"] == found.trajectory_m.tolist()
        assert record["settings"]["threshold_db"] == -100.0
        assert record["settings"]["trace_settings"]["frequency_hz"] == 28e9
        assert record["settings"]["predictor"] == "paper"


class TestErrors:
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"objective": "all"}, "objective = 'all' is not allowed: choose one of coverage, percentile"),
            ({"threshold_db": -150.0}, r"threshold_db = -150\.0 is not allowed: give a number in \(-150, 0\]"),
            ({"threshold_db": 0.1}, r"threshold_db = 0\.1 is not allowed"),
            ({"threshold_db": "loud"}, "threshold_db = 'loud' is not allowed"),
            ({"tx_height_m": 0.0}, r"tx_height_m = 0\.0 is not allowed: give a number in \(0, 3\]"),
            ({"tx_height_m": 3.0}, r"tx_height_m = 3\.0 is not allowed: stay below the ceiling at 3 m"),
            ({"rx_height_m": 4.0}, r"rx_height_m = 4\.0 is not allowed: give a number in \(0, 3\]"),
            ({"seed": -1}, r"seed = -1 is not allowed: give a whole number in \[0, "),
        ],
    )
    def test_settings(self, options: dict[str, Any], message: str) -> None:
        with pytest.raises(SettingsError, match=message):
            sp.place_transmitter(home(HALF_SEEN), **options)

    @pytest.mark.parametrize("cells", [4, 6, 8])
    def test_rooms_without_space_for_a_neighbour(self, cells: int) -> None:
        state = np.pad(np.zeros((cells, cells), np.uint8), 1, constant_values=1)
        settings = sp.TraceSettings(max_depth=0, diffraction=False)
        found = sp.place_transmitter(sp.PartialMap(state, 0.1), trace_settings=settings)
        assert (found.score, len(found.trajectory_m)) == (1.0, 1)

    def test_no_free_cell(self) -> None:
        with pytest.raises(PositionError, match="a transmitter can stand nowhere: the map has 0 free cells"):
            sp.place_transmitter(home("??#\n###"))

    def test_unknown_option(self) -> None:
        with pytest.raises(TypeError, match="edge_smoothing_m"):
            sp.place_transmitter(home(HALF_SEEN), edge_smoothing_m=0.1)


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
