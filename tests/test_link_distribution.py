"""The predicted distribution as tensors: as `LinkPrediction` has it, and with slopes that are finite."""

from dataclasses import fields

import numpy as np
import pytest
from scipy import stats

from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.differentiable.link_distribution import LinkDistribution
from sionna_partial.prediction.paper_networks import import_keras
from sionna_partial.prediction.predictor import LinkPrediction

THRESHOLD_DB = -100.0


@pytest.fixture(scope="module")
def tf():
    import_keras()
    import tensorflow

    return tensorflow


def random_parts(count=200, seed=0):
    """Return probabilities, means and standard deviations (3, N), some links certain in state, gain or both."""
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet(np.ones(3), count).T
    probabilities[:, :30] = np.eye(3)[:, np.arange(30) % 3]
    means_db = np.stack([np.full(count, GAIN_FLOOR_DB), *rng.uniform(-140.0, -60.0, (2, count))])
    stds_db = np.stack([np.zeros(count), *rng.uniform(0.3, 20.0, (2, count))])
    stds_db[:, ::4] = 0.0
    return probabilities, means_db, stds_db


def of(tf, *parts):
    return LinkDistribution.of_parts(*(tf.constant(np.asarray(part, dtype=np.float64)) for part in parts))


class TestOfParts:
    def test_as_link_prediction(self, tf):
        parts = random_parts()
        found, expected = of(tf, *parts), LinkPrediction.of_parts(*parts)
        assert [field.name for field in fields(found)] == [field.name for field in fields(expected)]
        for field in fields(expected):
            values = getattr(found, field.name)
            assert values.dtype == tf.float64
            np.testing.assert_allclose(values.numpy(), getattr(expected, field.name), rtol=1e-12, err_msg=field.name)

    def test_slopes_by_differences(self, tf):
        parts = [part[:, 30:][:, np.arange(170) % 4 != 2] for part in random_parts()]
        tensors = [tf.constant(part) for part in parts]
        with tf.GradientTape(persistent=True) as tape:
            tape.watch(tensors)
            found = LinkDistribution.of_parts(*tensors)
        for name in ("gain_mean_db", "gain_std_db"):
            for index, tensor in enumerate(tensors):
                slopes = tape.gradient(getattr(found, name), tensor, unconnected_gradients="zero")
                for row in range(3):
                    step = 1e-5 * np.eye(3)[row][:, None]
                    ends = [
                        getattr(of(tf, *(part + sign * step * (k == index) for k, part in enumerate(parts))), name)
                        for sign in (1, -1)
                    ]
                    expected = (ends[0] - ends[1]).numpy() / 2e-5
                    np.testing.assert_allclose(
                        slopes[row], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max() + 1e-5
                    )

    def test_no_spread_has_no_slope(self, tf):
        """A square root has an infinite one at 0, which times 0 is NaN."""
        certain, mean_db = tf.constant([[0.0], [1.0], [0.0]], tf.float64), tf.constant([[-80.0]] * 3, tf.float64)
        with tf.GradientTape(persistent=True) as tape:
            tape.watch(mean_db)
            found = LinkDistribution.of_parts(certain, mean_db, tf.zeros_like(mean_db))
        assert found.gain_std_db.numpy().tolist() == [0.0]
        assert tape.gradient(found.gain_std_db, mean_db).numpy().ravel().tolist() == [0.0, 0.0, 0.0]
        assert tape.gradient(found.gain_mean_db, mean_db).numpy().ravel().tolist() == [0.0, 1.0, 0.0]


class TestCoverage:
    @pytest.mark.parametrize("softness_db", [0.0, 3.0])
    def test_beside_scipy(self, tf, softness_db):
        parts = random_parts()
        found = of(tf, *parts).coverage(THRESHOLD_DB, softness_db).numpy()
        spread = np.hypot(parts[2], softness_db)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = stats.norm.sf(THRESHOLD_DB, parts[1], spread)
        shares = np.where(spread > 0.0, shares, parts[1] > THRESHOLD_DB)
        np.testing.assert_allclose(found, (parts[0][1:] * shares[1:]).sum(axis=0), rtol=1e-10, atol=1e-14)
        assert ((found >= 0.0) & (found <= 1.0)).all()

    def test_step_without_spread(self, tf):
        means_db = [[-150.0] * 3, [-99.0, -100.0, -101.0], [-150.0] * 3]
        certain = of(tf, np.repeat([[0.0], [1.0], [0.0]], 3, axis=1), means_db, np.zeros((3, 3)))
        assert certain.coverage(THRESHOLD_DB).numpy().tolist() == [1.0, 0.0, 0.0]
        np.testing.assert_allclose(certain.coverage(THRESHOLD_DB, 1.0), stats.norm.cdf([1.0, 0.0, -1.0]), rtol=1e-12)

    @pytest.mark.parametrize("softness_db", [0.0, 3.0])
    def test_slopes(self, tf, softness_db):
        """Those of the Gaussian density, and 0 where there is no spread; nowhere NaN, be the gain where it may."""
        probabilities, means_db, stds_db = random_parts()
        means_db[1, :4] = THRESHOLD_DB
        tensors = [tf.constant(part) for part in (probabilities, means_db, stds_db)]
        with tf.GradientTape() as tape:
            tape.watch(tensors)
            covered = LinkDistribution.of_parts(*tensors).coverage(THRESHOLD_DB, softness_db)
        of_probability, of_mean, of_std = (slope.numpy() for slope in tape.gradient(covered, tensors))
        assert all(np.isfinite(slope).all() for slope in (of_probability, of_mean, of_std))
        spread = np.hypot(stds_db, softness_db)
        with np.errstate(divide="ignore", invalid="ignore"):
            density = np.where(spread > 0.0, stats.norm.pdf(THRESHOLD_DB, means_db, spread), 0.0)
        np.testing.assert_allclose(of_mean[1:], (probabilities * density)[1:], rtol=1e-9, atol=1e-15)
        assert not of_mean[0].any()
        np.testing.assert_allclose(of_probability[1:] @ np.ones(200), of_shares(means_db, spread), rtol=1e-9)


def of_shares(means_db, spread):
    """Return the sum over links of the probability of a gain above the threshold, given LOS and given NLOS."""
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = stats.norm.sf(THRESHOLD_DB, means_db, spread)
    return np.where(spread > 0.0, shares, means_db > THRESHOLD_DB)[1:].sum(axis=1)
