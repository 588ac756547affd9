import dataclasses
import re

import numpy as np
import pytest
from predictor_links import LOS, OUTAGE, QUIET, arrays, assert_valid, make_links, quick_predictor

from sionna_partial.errors import PredictorError
from sionna_partial.learning import predictor as predictor_module
from sionna_partial.learning.networks import STD_RANGE_DB
from sionna_partial.learning.predictor import LinkPrediction, Predictor

pytestmark = QUIET


@pytest.fixture(scope="module")
def quick():
    return quick_predictor()


@pytest.fixture
def saved(quick, tmp_path):
    quick.save(tmp_path / "mine.keras")
    return tmp_path / "mine.keras"


def test_valid_on_other_links(quick):
    phi, _, _ = make_links(2000, seed=2)
    answer = quick.predict(phi)
    assert_valid(answer)
    assert answer.gain_los_std_db.min() >= STD_RANGE_DB[0] - 1e-5
    assert answer.gain_nlos_std_db.max() <= STD_RANGE_DB[1] + 1e-4


def test_no_links(quick):
    empty = make_links(0)[0]
    assert all(values.shape == (0,) for values in arrays(quick.predict(empty)).values())
    assert quick.predict_indoor(empty).shape == (0,)


def test_total_expectation_and_variance():
    probabilities = np.array([[0.2], [0.5], [0.3]])
    means_db, stds_db = np.array([[-150.0], [-60.0], [-90.0]]), np.array([[0.0], [2.0], [7.0]])
    answer = LinkPrediction.of_parts(probabilities, means_db, stds_db)
    rng = np.random.default_rng(0)
    state = rng.choice(3, size=400_000, p=probabilities[:, 0])
    samples_db = means_db[state, 0] + stds_db[state, 0] * rng.normal(size=len(state))
    assert answer.gain_mean_db == pytest.approx([-87.0])
    assert answer.gain_mean_db == pytest.approx([samples_db.mean()], abs=0.3)
    assert answer.gain_std_db == pytest.approx([samples_db.std()], abs=0.3)
    assert answer.link_state.tolist() == [LOS]


def test_prediction_is_the_mixture_of_its_parts(quick):
    answer = quick.predict(make_links(100)[0])
    parts = LinkPrediction.of_parts(
        np.stack([answer.p_outage, answer.p_los, answer.p_nlos]),
        np.stack([np.full(100, -150.0), answer.gain_los_mean_db, answer.gain_nlos_mean_db]),
        np.stack([np.zeros(100), answer.gain_los_std_db, answer.gain_nlos_std_db]),
    )
    np.testing.assert_allclose(parts.gain_mean_db, answer.gain_mean_db)
    np.testing.assert_allclose(parts.gain_std_db, answer.gain_std_db)


def test_of_trace():
    phi = make_links(50)[0]
    answer = LinkPrediction.of_trace(phi)
    assert_valid(answer)
    assert np.array_equal(answer.link_state, phi.link_state)
    assert np.array_equal(answer.p_los, phi.link_state == LOS)
    assert np.array_equal(answer.p_outage, phi.link_state == OUTAGE)
    np.testing.assert_allclose(answer.gain_mean_db, phi.gain_db, rtol=1e-15)
    for name in ("gain_std_db", "gain_los_std_db", "gain_nlos_std_db"):
        np.testing.assert_allclose(getattr(answer, name), 0.0, atol=1e-12)


def test_anywhere_is_indoors_or_in_outage(quick):
    indoors = quick.predict(make_links(200)[0])
    p_indoor = np.linspace(0.0, 1.0, 200)
    answer = indoors.anywhere(p_indoor)
    assert_valid(answer)
    np.testing.assert_allclose(answer.p_los, p_indoor * indoors.p_los)
    np.testing.assert_allclose(answer.p_nlos, p_indoor * indoors.p_nlos)
    np.testing.assert_allclose(answer.gain_mean_db, p_indoor * indoors.gain_mean_db - 150.0 * (1.0 - p_indoor))
    second_moment = p_indoor * (indoors.gain_std_db**2 + indoors.gain_mean_db**2) + 150.0**2 * (1.0 - p_indoor)
    np.testing.assert_allclose(answer.gain_std_db**2 + answer.gain_mean_db**2, second_moment)
    assert answer.p_outage[0] == 1.0


def test_certainly_indoors_changes_nothing(quick):
    indoors = quick.predict(make_links(50)[0])
    for name, values in arrays(indoors.anywhere(np.ones(50))).items():
        np.testing.assert_allclose(values, getattr(indoors, name), rtol=1e-12, err_msg=name)


@pytest.mark.parametrize(
    ("p_indoor", "message"),
    [
        ([0.5, 1.1], "p_indoor[1] = 1.1 is not allowed: it lies between 0 and 1."),
        ([-0.1, 1.0], "p_indoor[0] = -0.1 is not allowed: it lies between 0 and 1."),
        ([0.5], "p_indoor has shape (1,): give one number for each of the 2 links."),
    ],
)
def test_bad_probability_of_being_indoors(p_indoor, message):
    with pytest.raises(PredictorError, match=re.escape(message)):
        LinkPrediction.of_trace(make_links(2)[0]).anywhere(p_indoor)


def test_save_and_load(quick, saved):
    phi, _, _ = make_links(500, seed=5)
    model = quick.fit_indoor(phi, phi.unobserved_distance_m < 4.0)
    model = dataclasses.replace(model, metrics={"accuracy": 0.5})
    model.save(saved)
    loaded = Predictor.load(saved)
    for name, values in arrays(model.predict(phi)).items():
        assert np.array_equal(arrays(loaded.predict(phi))[name], values), name
    assert np.array_equal(loaded.predict_indoor(phi), model.predict_indoor(phi))
    for name in ("settings", "homes", "links", "metrics", "versions", "fingerprint"):
        assert getattr(loaded, name) == getattr(model, name), name
    assert loaded.homes == ("a", "b")
    assert loaded.name == str(saved)
    loaded.save(saved.with_name("again.keras"))
    for suffix in (".keras", ".json"):
        assert saved.with_name(f"again{suffix}").read_bytes() == saved.with_suffix(suffix).read_bytes()


def test_shipped_names(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(predictor_module, "PREDICTORS_FOLDER", tmp_path)
    quick.save(tmp_path / "paper.keras")
    assert Predictor.load().name == Predictor.load("paper").name == "paper"
    assert Predictor.load().fingerprint == quick.fingerprint


def test_shipped_predictor():
    model = Predictor.load()
    assert len(model.homes) >= 10
    assert not set(model.homes) & set(model.metrics["held_out_homes"])
    phi, _, _ = make_links(500)
    assert_valid(model.predict(phi))
    assert model.predict_indoor(phi).min() < 0.999
    for stage in model.metrics["exploration_steps"].values():
        assert 0.8 < stage["predictor"]["coverage_90"] < 0.98
        assert stage["predictor"]["rmse_db"] < stage["majority"]["rmse_db"]


def test_bad_training_data(quick):
    phi, state, gain_db = make_links(5)
    for arguments, message in (
        ((make_links(0)[0], [], []), "features has no links: give at least one."),
        ((phi, state[:4], gain_db), "link_state has shape (4,): give one number for each of the 5 links."),
        ((phi, state + 3, gain_db), "use LinkState: OUTAGE 0, LOS 1, NLOS 2."),
        ((phi, state, gain_db * np.nan), "gain_db[0] = nan is not allowed: give finite numbers."),
        (("phi", state, gain_db), "features is of type str: give the LinkFeatures of link_features."),
    ):
        with pytest.raises(PredictorError, match=re.escape(message)):
            Predictor.fit(*arguments)
    for call in (quick.predict, quick.predict_indoor, lambda phi: quick.fit_indoor(phi, [])):
        with pytest.raises(PredictorError, match="features is of type NoneType"):
            call(None)
    with pytest.raises(PredictorError, match=re.escape("inside has shape (4,)")):
        quick.fit_indoor(phi, np.ones(4))
