import numpy as np
import pytest
from scipy.stats import norm

from sionna_partial.differentiable.link_distribution import LinkDistribution
from sionna_partial.errors import SettingsError
from sionna_partial.placement.objective import PlacementObjective
from sionna_partial.prediction.predictor import LinkPrediction

PROBABILITIES = np.array([[0.1, 1.0, 0.0, 0.5], [0.6, 0.0, 0.0, 0.3], [0.3, 0.0, 1.0, 0.2]])
MEANS_DB = np.array([[-150.0] * 4, [-80.0, -90.0, -70.0, -101.0], [-105.0, -110.0, -99.0, -95.0]])
STDS_DB = np.array([[0.0] * 4, [3.0, 4.0, 2.0, 5.0], [8.0, 9.0, 7.0, 6.0]])


def prediction(spread: float = 1.0) -> LinkPrediction:
    return LinkPrediction.of_parts(PROBABILITIES, MEANS_DB, spread * STDS_DB)


class TestCoverage:
    @pytest.mark.parametrize("softness_db", [0.0, 6.0])
    def test_probability_of_the_mixture(self, softness_db: float) -> None:
        found = PlacementObjective("coverage", -100.0, softness_db).values(prediction())
        spread = np.hypot(STDS_DB[1:], softness_db)
        np.testing.assert_allclose(found, (PROBABILITIES[1:] * norm.sf(-100.0, MEANS_DB[1:], spread)).sum(axis=0))

    def test_certain_gains_are_covered_or_not(self) -> None:
        found = PlacementObjective("coverage", -100.0).values(prediction(0.0))
        np.testing.assert_allclose(found, [0.6, 0.0, 1.0, 0.2])

    def test_softness_gives_certain_gains_a_slope(self) -> None:
        found = PlacementObjective("coverage", -100.0, 6.0).values(prediction(0.0))
        assert found[2] == pytest.approx(norm.cdf(1.0 / 6.0))

    def test_score_is_the_weighted_mean(self) -> None:
        score = PlacementObjective().score(np.array([1.0, 0.5, 0.0]), np.array([1.0, 2.0, 1.0]))
        assert score == pytest.approx(0.5)

    def test_higher_thresholds_are_met_less(self) -> None:
        scores = [PlacementObjective("coverage", level).values(prediction()).sum() for level in (-140, -100, -60, 0)]
        assert scores == sorted(scores, reverse=True)


class TestPercentile:
    def test_all_alike(self) -> None:
        assert PlacementObjective("percentile").score(np.full(9, -87.0), np.arange(1.0, 10.0)) == pytest.approx(-87.0)

    def test_mean_of_what_is_around_the_tenth(self) -> None:
        """Of ranks u in [0, 1] the mean of u under the weights 1 to 0.05, falling to 0 at 0.15, is 13 / 240."""
        values = (np.arange(100_000) + 0.5) / 100_000
        found = PlacementObjective("percentile").score(values, np.ones(len(values)))
        assert found == pytest.approx(13.0 / 240.0, rel=1e-4)

    def test_better_places_do_not_count(self) -> None:
        values = np.linspace(-150.0, -50.0, 200)
        changed = np.where(values > np.quantile(values, 0.16), 0.0, values)
        objective = PlacementObjective("percentile")
        assert objective.score(changed, np.ones(200)) == objective.score(values, np.ones(200))

    def test_weight_is_number(self) -> None:
        rng = np.random.default_rng(0)
        values, weight = rng.normal(size=30), rng.integers(1, 5, 30)
        objective = PlacementObjective("percentile")
        several = objective.score(np.repeat(values, weight), np.ones(weight.sum()))
        assert objective.score(values, weight.astype(float)) == pytest.approx(several)

    def test_values_are_mean_gains(self) -> None:
        np.testing.assert_array_equal(PlacementObjective("percentile").values(prediction()), prediction().gain_mean_db)


class TestTensor:
    @pytest.mark.parametrize("objective", [PlacementObjective(softness_db=2.0), PlacementObjective("percentile")])
    def test_same_number_and_its_slope(self, objective: PlacementObjective) -> None:
        import tensorflow as tf

        weight, step_db = np.array([1.0, 0.5, 0.25, 1.0]), 1e-4
        shift_db = tf.Variable(np.zeros(4))
        with tf.GradientTape() as tape:
            means_db = tf.constant(MEANS_DB) + shift_db * [[0.0], [1.0], [1.0]]
            found = LinkDistribution.of_parts(tf.constant(PROBABILITIES), means_db, tf.constant(STDS_DB))
            value = objective.tensor(found, weight)
        assert float(value) == pytest.approx(objective.score(objective.values(prediction()), weight))
        slopes = tape.gradient(value, shift_db).numpy()
        for index, moved_db in enumerate(step_db * np.eye(4)):
            ends = [
                LinkPrediction.of_parts(PROBABILITIES, MEANS_DB + sign * moved_db * [[0], [1], [1]], STDS_DB)
                for sign in (1.0, -1.0)
            ]
            up, down = (objective.score(objective.values(end), weight) for end in ends)
            assert slopes[index] == pytest.approx((up - down) / (2 * step_db), rel=1e-4, abs=1e-7)


class TestErrors:
    def test_objective(self) -> None:
        with pytest.raises(SettingsError, match="objective = 'best' is not allowed: give 'coverage' or 'percentile'"):
            PlacementObjective("best")

    @pytest.mark.parametrize("threshold_db", [-150.0, 3.0, float("nan"), "loud"])
    def test_threshold(self, threshold_db: float) -> None:
        with pytest.raises(SettingsError, match=r"threshold_db = .* is not allowed: give a number in \(-150, 0\]"):
            PlacementObjective("coverage", threshold_db)


def test_receiver_at_the_transmitter() -> None:
    assert PlacementObjective().value_at_transmitter == 1.0
    assert PlacementObjective("percentile").value_at_transmitter == 0.0
