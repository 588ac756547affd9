import dataclasses
import math
import re

import numpy as np
import pytest
from placement_cases import home
from predictor_links import (
    LOS,
    QUIET,
    arrays,
    assert_valid,
    context_predictor,
    corridor_of,
    make_links,
    make_seen_links,
    quick_predictor,
)

import sionna_partial as sp
from sionna_partial.errors import PredictorError
from sionna_partial.prediction.paper_networks import STD_RANGE_DB, parts
from sionna_partial.prediction.predictor import SHIPPED, Predictor
from sionna_partial.prediction.rule import LinkPrediction

pytestmark = QUIET


@pytest.fixture(scope="module")
def quick():
    return quick_predictor()


@pytest.fixture(params=["paths", "map"])
def seeing(request):
    return context_predictor(request.param)


def predictor_of(networks):
    return quick_predictor() if networks == "paper" else context_predictor(networks)


@pytest.fixture
def saved(quick, tmp_path):
    quick.save(tmp_path / "mine.keras")
    return tmp_path / "mine.keras"


@pytest.mark.parametrize("networks", ["paper", "paths", "map"])
def test_valid_on_other_links_and_on_none(networks):
    model, phi = predictor_of(networks), make_seen_links(500, seed=2)[0]
    answer = model.predict(phi)
    assert_valid(answer)
    for std_db in (answer.gain_los_std_db, answer.gain_nlos_std_db):
        assert networks != "paper" or std_db.min() >= STD_RANGE_DB[0] - 1e-5
        assert 1.0 < std_db.max() <= STD_RANGE_DB[1] + 20.0  # mixtures are wider than their parts
    empty = phi.take(slice(0))
    assert all(values.shape == (0,) for values in arrays(model.predict(empty)).values())
    assert model.predict_indoor(empty).shape == (0,)


def test_total_expectation_and_variance():
    probabilities = np.array([[0.2], [0.5], [0.3]])
    means_db, stds_db = np.array([[-150.0], [-60.0], [-90.0]]), np.array([[0.0], [2.0], [7.0]])
    answer = LinkPrediction.of_parts(probabilities, means_db, stds_db)
    assert answer.gain_mean_db == pytest.approx([-87.0])
    second_moment = 0.2 * 150.0**2 + 0.5 * (60.0**2 + 2.0**2) + 0.3 * (90.0**2 + 7.0**2)
    assert answer.gain_std_db == pytest.approx([math.sqrt(second_moment - 87.0**2)])
    assert answer.link_state.tolist() == [LOS]


def test_of_trace():
    phi = make_links(50)[0]
    answer = LinkPrediction.of_trace(phi)
    assert_valid(answer)
    assert np.array_equal(answer.link_state, phi.link_state)
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


@pytest.mark.parametrize("networks", ["paper", "paths", "map"])
def test_save_and_load(networks, saved):
    phi, _, _ = make_seen_links(500, seed=5)
    model = predictor_of(networks).fit_indoor(phi, phi.unobserved_distance_m < 4.0)
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


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_predictor(name):
    model = Predictor.load(name)
    assert model.name == model.settings.networks == name
    assert (Predictor.load().fingerprint == model.fingerprint) == (name == "map")
    assert not set(model.homes) & set(model.metrics["held_out_homes"])
    assert model.predict_indoor(make_seen_links(500)[0]).min() < 0.999
    for stage in model.metrics["exploration_steps"].values():
        assert 0.8 < stage["predictor"]["coverage_90"] < 0.98
        assert stage["predictor"]["rmse_db"] < stage["majority"]["rmse_db"]


class TestNetworksOfMapsAndPaths:
    def test_the_trace_is_the_prediction_where_nothing_is_in_doubt(self, seeing):
        phi = make_seen_links(200, seed=3)[0]
        sure = np.isin(corridor_of(phi), [1, 3])
        exposure, noise = (np.where(sure, 0.0, each) for each in (phi.context.exposure.T, phi.context.wall_noise))
        mixed = dataclasses.replace(
            phi, context=dataclasses.replace(phi.context, exposure=exposure.T, wall_noise=noise)
        )
        answer, traced, unsure = seeing.predict(mixed), LinkPrediction.of_trace(phi), seeing.predict(phi)
        assert_valid(answer)
        for name, values in arrays(answer).items():
            np.testing.assert_array_equal(values[sure], getattr(traced, name)[sure], err_msg=name)
            np.testing.assert_allclose(values[~sure], getattr(unsure, name)[~sure], rtol=1e-5, err_msg=name)
        assert answer.gain_std_db[~sure].min() > 0.1

    def test_without_a_context_the_papers_networks_answer(self, seeing):
        """They are fitted to the same links, whatever other networks there are."""
        phi, state, gain_db = make_seen_links(300)
        settings = dataclasses.replace(seeing.settings, networks="paper")
        paper = Predictor.fit(phi, state, gain_db, settings=settings)
        blind = dataclasses.replace(phi, context=None)
        for name, values in arrays(seeing.predict(blind)).items():
            np.testing.assert_array_equal(values, getattr(paper.predict(blind), name), err_msg=name)
            np.testing.assert_array_equal(values, getattr(paper.predict(phi), name), err_msg=name)
        assert abs(seeing.predict(phi).p_los - seeing.predict(blind).p_los).max() > 0.05

    def test_fit_indoor_keeps_its_networks(self, seeing):
        phi = make_seen_links(400, seed=4)[0]
        settings = dataclasses.replace(seeing.settings, minimum_links=50)
        able = dataclasses.replace(seeing, settings=settings)
        model = able.fit_indoor(phi, phi.unobserved_distance_m < 4.0)
        assert set(parts(model.model)) == set(parts(seeing.model))
        for name, values in arrays(model.predict(phi)).items():
            np.testing.assert_array_equal(values, getattr(seeing.predict(phi), name), err_msg=name)
        assert model.predict_indoor(phi).min() < 0.5 < 0.999 < seeing.predict_indoor(phi).min()
        assert model.fingerprint != seeing.fingerprint


def test_what_is_refused(quick):
    phi, state, gain_db = make_links(5)
    paths = context_predictor("paths")
    for features, states, gains_db, settings, message in (
        (make_links(0)[0], [], [], None, "features has no links: give at least one."),
        (phi, state + 3, gain_db, None, "use LinkState: OUTAGE 0, LOS 1, NLOS 2."),
        (phi, state, gain_db * np.nan, None, "gain_db[0] = nan is not allowed: give finite numbers."),
        ("phi", state, gain_db, None, "features is of type str: give the LinkFeatures of link_features."),
        (phi, state, gain_db, paths.settings, "features has no context, which all networks but the paper's need: give"),
        (dataclasses.replace(phi, frequency_hz=5e9), state, gain_db, None, "features are at 5 GHz, settings at 28 GHz"),
    ):
        with pytest.raises(PredictorError, match=re.escape(message)):
            Predictor.fit(features, states, gains_db, settings=settings)
    with pytest.raises(PredictorError, match="features is of type NoneType"):
        quick.predict(None)
    with pytest.raises(PredictorError, match=r"inside has shape \(4,\)"):
        quick.fit_indoor(phi, np.ones(4))
    for p_indoor, message in (
        ([0.5] * 4 + [1.1], "p_indoor[4] = 1.1 is not allowed"),
        ([0.5], "p_indoor has shape (1,)"),
    ):
        with pytest.raises(PredictorError, match=re.escape(message)):
            LinkPrediction.of_trace(phi).anywhere(p_indoor)


HALF_SEEN = "#####???\n#..#????\n#......?\n#..#????\n#####???"
TX = (0.75, 1.25, 1.5)


class Constant:
    """A model of the user that predicts the same for all links."""

    def __init__(self, **columns: float) -> None:
        self.columns = {"p_los": 0.25, "p_nlos": 0.5, "p_outage": 0.25, "gain_mean_db": -90.0, "gain_std_db": 5.0}
        self.columns |= columns

    def predict(self, phi: sp.LinkFeatures) -> dict[str, np.ndarray]:
        assert phi.context is not None
        return {name: np.full(len(phi), value) for name, value in self.columns.items() if not np.isinf(value)}


def test_a_model_of_the_user_predicts_what_is_not_certain() -> None:
    model = sp.LinkModel(home(HALF_SEEN), Constant())
    found = model.predict(TX, [[3.2, 0.4, 1.5]])
    assert found.p_los.tolist() == pytest.approx([0.25], abs=1e-6)
    assert found.gain_mean_db[0] == pytest.approx(0.75 * -90.0 + 0.25 * -150.0)
    coverage = sp.predict_map(home(HALF_SEEN), TX, predictor=Constant(), spacing_m=0.5)
    assert "Constant" in coverage.attrs["predictor"]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"p_los": 0.9}, "p_los.*the three probabilities sum to 1"),
        ({"gain_std_db": -1.0}, "std.*give 0 or more"),
        ({"gain_mean_db": np.nan}, "gain_los_mean_db.*give finite numbers"),
        ({"gain_mean_db": np.inf}, "returned no 'gain_los_mean_db'"),
    ],
)
def test_what_is_no_distribution_is_refused(columns: dict[str, float], message: str) -> None:
    with pytest.raises(PredictorError, match=message):
        sp.LinkModel(home(HALF_SEEN), Constant(**columns)).predict(TX, [[3.2, 0.4, 1.5]])


def test_distributions_by_material_are_kept():
    rng, weights = np.random.default_rng(0), np.array([0.25, 0.75])

    def links(count=6):
        means_db = np.stack([np.full(count, -150.0), *rng.uniform(-140.0, -60.0, (2, count))])
        stds_db = np.stack([np.zeros(count), *rng.uniform(0.3, 20.0, (2, count))])
        return LinkPrediction.of_parts(rng.dirichlet(np.ones(3), count).T, means_db, stds_db)

    mixed, plain = LinkPrediction.over_materials([links(), links()], weights, 5.0), links()
    assert (plain.by_material, len(plain.materials[0])) == (None, 1)
    taken = np.arange(6) % 2 == 0
    half = np.full((2, 6), 0.5)
    for found, change in (
        (mixed.where(taken, plain), lambda part: part.where(taken, plain)),
        (mixed.take(taken), lambda part: part.take(taken)),
        (mixed.reshaped((2, 3)), lambda part: part.reshaped((2, 3))),
        (mixed.anywhere(np.full(6, 0.5)), lambda part: part.anywhere(np.full(6, 0.5))),
        (LinkPrediction.mixture([mixed, plain], half), lambda part: LinkPrediction.mixture([part, plain], half)),
        (LinkPrediction.concatenate([plain, mixed]), lambda part: LinkPrediction.concatenate([plain, part])),
    ):
        parts, kept = found.by_material
        assert kept is weights
        for part, first in zip(parts, mixed.by_material[0], strict=True):
            for name in LinkPrediction.COLUMNS:
                np.testing.assert_array_equal(getattr(part, name), getattr(change(first), name))
