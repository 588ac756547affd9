"""The paper's networks: architecture, evaluation, and training on links of a known model."""

import dataclasses
import itertools

import numpy as np
import pytest
from predictor_links import (
    FREQUENCY_HZ,
    LOS,
    NLOS,
    OUTAGE,
    QUICK,
    QUIET,
    assert_valid,
    make_links,
    p_kept,
    quick_predictor,
    true_gain,
)

from sionna_partial.constants import LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.paper_networks import (
    GAIN_NETWORKS,
    free_space_gain_db,
)
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import PredictorSettings

pytestmark = QUIET


@pytest.fixture(scope="module")
def quick():
    return quick_predictor()


def test_free_space():
    """Friis at 1 m and 28 GHz is -61.39 dB (32.45 + 20 log10(MHz km)), and falls by 6.02 dB for twice the distance."""
    found = free_space_gain_db(np.array([0.0, 0.01, 1.0, 2.0]), FREQUENCY_HZ)
    np.testing.assert_allclose(found, [-21.391, -21.391, -61.391, -67.412], atol=2e-3)


def test_gain_networks_are_the_papers(quick):
    """The table of the paper: inputs and hidden units by name; each row once."""
    for name, inputs, units in (
        ("gain_los_given_los", ["distance_m", "unobserved_distance_m", "gain_db"], 20),
        ("gain_los_given_nlos_outage", ["distance_m"], 10),
        ("gain_nlos_given_nlos_outage", ["distance_m", "unobserved_distance_m", "gain_db"], 20),
        ("gain_nlos_given_los", ["distance_m"], 10),
    ):
        network = quick.model.get_layer(name)
        assert list(network.input) == inputs
        assert network.output.shape == (None, 2)
        dense = [layer for layer in network.layers if type(layer).__name__ == "Dense"]
        kernels = [(len(inputs), units), (units, units), (units, 1), (units, 1)]
        assert [layer.kernel.shape for layer in dense] == kernels
        assert [layer.activation.__name__ for layer in dense[:2]] == ["relu", "relu"]
    served = [(row.link_state, partial) for row in GAIN_NETWORKS for partial in row.partial_states]
    assert sorted(served) == [(state, partial) for state in (LOS, NLOS) for partial in LinkState]


def test_sane_far_beyond_the_training_links(quick):
    distance_m = np.array([0.0, 1e-6, 0.1, 1.0, 10.0, 60.0, 1e4, 1e9, 1e200])
    for state, fraction, gain_db in itertools.product(LinkState, (0.0, 1.0), (-150.0, -40.0, 1e300)):
        phi = LinkFeatures(np.full(9, state), fraction * distance_m, distance_m, np.full(9, gain_db))
        assert_valid(quick.predict(phi))


def test_recovers_a_known_model():
    settings = PredictorSettings(steps=400, batch_size=512, learning_rate=0.02)
    trained = Predictor.fit(*make_links(12_000), settings=settings)
    phi, _, _ = make_links(3000, seed=1)
    answer = trained.predict(phi)
    p_partial = np.choose(phi.link_state, [answer.p_outage, answer.p_los, answer.p_nlos])
    assert np.abs(p_partial - p_kept(phi)).mean() < 0.03
    for given, mean_db, std_db in (
        (LOS, answer.gain_los_mean_db, answer.gain_los_std_db),
        (NLOS, answer.gain_nlos_mean_db, answer.gain_nlos_std_db),
    ):
        served = phi.link_state == given
        true_mean_db, true_std_db = true_gain(phi, np.full(len(phi), given))
        assert np.abs(mean_db - true_mean_db)[served].mean() < 0.7
        assert np.abs(std_db / true_std_db - 1.0)[served].mean() < 0.12


def test_same_training_same_weights_whatever_the_gain_of_outages(quick):
    """The likelihood has the gains of links with a path alone."""
    phi, state, gain_db = make_links(900)
    again = Predictor.fit(phi, state, np.where(state == OUTAGE, -77.0, gain_db), homes=["a", "b"], settings=QUICK)
    other_seed = Predictor.fit(phi, state, gain_db, settings=dataclasses.replace(QUICK, seed=1))
    assert again.fingerprint == quick.fingerprint != other_seed.fingerprint


def test_cells_without_links_fall_back_to_prior_knowledge():
    phi, _, _ = make_links(60)
    sight = phi.take(phi.link_state == LOS)
    settings = PredictorSettings(minimum_links=1000)
    model = Predictor.fit(sight, np.full(len(sight), LOS), sight.gain_db, settings=settings)
    answer = model.predict(dataclasses.replace(phi, link_state=np.full(len(phi), OUTAGE)))
    free_db = free_space_gain_db(phi.distance_m, FREQUENCY_HZ)
    np.testing.assert_allclose([answer.p_los, answer.p_nlos, answer.p_outage], 1 / 3, atol=1e-6)
    np.testing.assert_allclose(answer.gain_los_mean_db, free_db, atol=1e-3)
    np.testing.assert_allclose(answer.gain_los_std_db, 6.0, rtol=1e-4)
    np.testing.assert_allclose(answer.gain_nlos_mean_db, free_db - 20.0, atol=1e-3)
    np.testing.assert_allclose(answer.gain_nlos_std_db, 15.0, rtol=1e-4)
    few = model.predict(sight)
    assert (few.p_los > 0.8).all()
    assert (few.gain_los_std_db < 6.0).all()


def test_indoor(quick):
    phi, _, _ = make_links(6000, seed=4)
    assert quick.predict_indoor(phi).min() > 0.999
    p_inside = 1.0 / (1.0 + np.exp(phi.unobserved_distance_m - 4.0))
    inside = np.random.default_rng(0).uniform(size=len(phi)) < p_inside
    model = quick.fit_indoor(phi, inside)
    assert np.abs(model.predict_indoor(phi) - p_inside).mean() < 0.03
    assert np.array_equal(model.predict(phi).p_los, quick.predict(phi).p_los)
    assert quick.predict_indoor(phi).min() > 0.999
    assert model.fingerprint != quick.fingerprint


def test_diverging_training():
    phi, state, gain_db = make_links(300)
    settings = PredictorSettings(steps=3, minimum_links=10)
    with pytest.raises(PredictorError, match=r"training of gain_\w+ diverged: learning_rate = 0.01, give a smaller"):
        Predictor.fit(phi, state, np.where(gain_db > -150.0, gain_db + 1e30, gain_db), settings=settings)
