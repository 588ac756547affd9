import dataclasses

import numpy as np
import pytest
from predictor_links import (
    FREQUENCY_HZ,
    LOS,
    NLOS,
    OUTAGE,
    QUICK,
    QUIET,
    make_links,
    p_kept,
    quick_predictor,
    trained_predictor,
    true_gain,
)

from sionna_partial.constants import LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import PredictorSettings

pytestmark = QUIET


@pytest.fixture(scope="module")
def quick():
    return quick_predictor()


@pytest.fixture(scope="module")
def trained():
    return trained_predictor()


def test_recovers_a_known_model(trained):
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


def test_likelihood_ignores_the_gain_of_outages():
    phi, state, gain_db = make_links(500)
    settings = dataclasses.replace(QUICK, minimum_links=20)
    spoilt_db = np.where(state == OUTAGE, -77.0, gain_db)
    models = [Predictor.fit(phi, state, values, settings=settings).model for values in (gain_db, spoilt_db)]
    for one, other in zip(*(model.get_weights() for model in models), strict=True):
        assert np.array_equal(one, other)


def test_same_training_same_weights(quick):
    again = Predictor.fit(*make_links(900), homes=["a", "b"], settings=QUICK)
    for one, other in zip(quick.model.get_weights(), again.model.get_weights(), strict=True):
        assert np.array_equal(one, other)
    other_seed = Predictor.fit(*make_links(900), settings=dataclasses.replace(QUICK, seed=1))
    assert any(
        not np.array_equal(one, other)
        for one, other in zip(quick.model.get_weights(), other_seed.model.get_weights(), strict=True)
    )


@pytest.mark.parametrize("partial_state", LinkState)
def test_line_of_sight_fades_with_distance_like_free_space(trained, partial_state):
    distance_m = np.geomspace(0.1, 60.0, 60)
    free_db = free_space_gain_db(distance_m, FREQUENCY_HZ)
    traced_db = free_db if partial_state == LOS else np.full(60, -150.0)
    phi = LinkFeatures(np.full(60, partial_state), np.zeros(60), distance_m, traced_db)
    answer = trained.predict(phi)
    assert np.abs(answer.gain_los_mean_db - free_db).max() < 6.0
    assert np.diff(answer.gain_los_mean_db[::4]).max() < 0.0


def test_cells_without_links_fall_back_to_prior_knowledge():
    phi, _, _ = make_links(60)
    sight = phi.take(phi.link_state == LOS)
    model = Predictor.fit(
        sight, np.full(len(sight), LOS), sight.gain_db, settings=PredictorSettings(minimum_links=1000)
    )
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
    with pytest.raises(
        PredictorError, match=r"training of gain_\w+ diverged: learning_rate = 0.01, give a smaller one"
    ):
        Predictor.fit(phi, state, np.where(gain_db > -150.0, gain_db + 1e30, gain_db), settings=settings)
