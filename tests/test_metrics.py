import json
import math

import numpy as np
import pytest
from predictor_links import LOS, NLOS, OUTAGE, make_links

from sionna_partial.lab.metrics import (
    CONFIDENCE_BINS,
    DEFINITIONS,
    PIT_BINS,
    Metrics,
    calibration,
    measure,
    pit_fractions,
    reliability,
)
from sionna_partial.prediction.rule import LinkPrediction


def prediction(p_outage, p_los, p_nlos, los_db=(-60.0, 2.0), nlos_db=(-90.0, 8.0)):
    """Answer the same for every link but for the probabilities (N,)."""
    probabilities = np.array([p_outage, p_los, p_nlos], dtype=np.float64)
    means_db, stds_db = (
        np.repeat(np.array([floor, los, nlos])[:, None], probabilities.shape[1], axis=1)
        for floor, los, nlos in ((-150.0, los_db[0], nlos_db[0]), (0.0, los_db[1], nlos_db[1]))
    )
    return LinkPrediction.of_parts(probabilities, means_db, stds_db)


def drawn(count, seed=0, narrow=1.0):
    """Predictions, and truth drawn from them; the true gains spread `narrow` times as much."""
    rng = np.random.default_rng(seed)
    answer = prediction(*rng.dirichlet([1.0, 1.0, 1.0], count).T)
    total = np.cumsum([answer.p_outage, answer.p_los], axis=0)
    state = (rng.uniform(size=count) > total).sum(axis=0).astype(np.uint8)
    mean_db, std_db = np.choose(state, [-150.0, -60.0, -90.0]), np.choose(state, [0.0, 2.0, 8.0])
    return answer, state, mean_db + narrow * std_db * rng.normal(size=count)


class TestMeasure:
    def test_by_hand(self):
        answer = prediction([0.5, 0.1, 0.0], [0.3, 0.7, 0.2], [0.2, 0.2, 0.8])
        state, gain_db = np.array([OUTAGE, LOS, LOS], dtype=np.uint8), np.array([-150.0, -61.0, -64.0])
        found = measure(answer, state, gain_db)
        means_db = np.array([-0.5 * 150 - 0.3 * 60 - 0.2 * 90, -0.1 * 150 - 0.7 * 60 - 0.2 * 90, -0.2 * 60 - 0.8 * 90])
        assert found.links == 3
        assert found.accuracy == pytest.approx(2 / 3)
        assert found.rmse_db == pytest.approx(np.sqrt(np.mean((means_db - gain_db) ** 2)))
        assert found.rmse_linked_db == pytest.approx(np.sqrt(np.mean((means_db - gain_db)[1:] ** 2)))
        assert found.nll_state == pytest.approx(-np.log([0.5, 0.7, 0.2]).mean())
        densities = np.exp(-0.5 * np.array([0.5, 2.0]) ** 2) / (2.0 * math.sqrt(2.0 * math.pi))
        assert found.nll == pytest.approx(-(np.log([0.5, 0.7, 0.2]).sum() + np.log(densities).sum()) / 3)
        assert found.calibration_error == pytest.approx((abs(1 - 0.5) + abs(1 - 0.7) + abs(0 - 0.8)) / 3)

    def test_a_trace_has_no_interval(self):
        phi, state, gain_db = make_links(500)
        found = measure(LinkPrediction.of_trace(phi), state, gain_db)
        assert math.isnan(found.coverage_90)
        assert found.calibration_error == pytest.approx(1.0 - found.accuracy)
        assert found.rmse_db > 0.0
        found = measure(LinkPrediction.of_trace(make_links(9)[0]), *make_links(9)[1:]).as_json()
        assert list(found) == list(DEFINITIONS) == list(Metrics.__dataclass_fields__)
        assert json.loads(json.dumps(found, allow_nan=False))["coverage_90"] is None

    def test_a_gain_held_certain_has_a_least_spread_and_density(self):
        answer, los = prediction([0.0, 0.0], [1.0, 1.0], [0.0, 0.0], los_db=(-60.0, 0.0)), np.full(2, LOS, np.uint8)
        right, wrong = math.log(0.1 * math.sqrt(2.0 * math.pi)), -math.log(1e-4 / 150.0)
        assert measure(answer, los, np.array([-60.0, -35.0])).nll == pytest.approx((right + wrong) / 2)

    def test_no_links_and_none_but_outages(self):
        empty = measure(prediction([], [], []), np.zeros(0, dtype=np.uint8), np.zeros(0))
        assert empty.links == 0
        assert all(value is None for name, value in empty.as_json().items() if name != "links")
        outages = measure(prediction([0.5], [0.5], [0.0]), np.array([OUTAGE], dtype=np.uint8), np.array([-99.0]))
        assert math.isnan(outages.rmse_linked_db)
        assert outages.rmse_db == pytest.approx(45.0)


class TestPitShares:
    def test_transforms_by_hand(self):
        answer, state = prediction([0.4], [0.6], [0.0]), np.array([OUTAGE], dtype=np.uint8)
        found = pit_fractions(answer, state, np.array([-150.0]), np.array([0.1, 0.2, 0.4, 0.9]))
        np.testing.assert_allclose(found, [0.25, 0.5, 1.0, 1.0], atol=1e-9)
        answer, state = prediction([0.4], [0.6], [0.0]), np.array([LOS], dtype=np.uint8)
        assert pit_fractions(answer, state, np.array([-60.0]), np.array([0.699, 0.701])).tolist() == [0.0, 1.0]
        answer, state = prediction([0.0], [1.0], [0.0], los_db=(-60.0, 0.0)), np.array([LOS], dtype=np.uint8)
        for gain_db, share in ((-61.0, 1.0), (-60.0, 0.5), (-59.0, 0.0)):
            assert pit_fractions(answer, state, np.array([gain_db]), np.array([0.5])).tolist() == [share]


class TestReliability:
    def test_links_are_sorted_by_confidence(self):
        answer = prediction([0.0, 0.0, 0.1], [1.0, 0.4, 0.3], [0.0, 0.6, 0.6])
        found = reliability(answer, np.array([LOS, NLOS, LOS], dtype=np.uint8))
        assert found.links[-1] == 1
        assert found.links[9] == 2
        assert found.links.sum() == 3
        assert found.confidence[9] == pytest.approx(0.6)
        assert found.accuracy[9] == 0.5
        assert found.error == pytest.approx(2 / 3 * 0.1)
        assert len(found.links) == CONFIDENCE_BINS


class TestCalibration:
    def test_a_prediction_that_knows_the_model_is_calibrated(self):
        drawn_links = drawn(100_000)
        found, figures = calibration(*drawn_links), measure(*drawn_links)
        assert found.gain_pit.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(found.gain_pit, 1.0 / PIT_BINS, atol=0.004)
        assert found.state.error < 0.01
        assert figures.calibration_error < 0.015
        assert figures.coverage_90 == pytest.approx(0.9, abs=0.006)
        assert measure(*drawn(20_000, narrow=2.0)).coverage_90 < 0.86
