import dataclasses
import math

import numpy as np
import pytest
from link_tables import fitted_baselines, make_dataset, make_table
from predictor_links import LOS, NLOS, OUTAGE, QUICK, QUIET, assert_valid, make_links, quick_predictor

from sionna_partial.constants import LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.lab.baselines import (
    Baselines,
    Majority,
    baseline_predictions,
    indoor_gain_db,
    indoor_los_probability,
    nothing_seen,
    tr38901_indoor,
)
from sionna_partial.lab.evaluation import WITH_INDOOR, WITHOUT_INDOOR, evaluate
from sionna_partial.lab.metrics import measure
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.resources import PREDICTORS_FOLDER

pytestmark = QUIET

ANSWERS = [
    *("predictor", "paper", "distance only", "majority", "partial trace"),
    *("TR 38.901 mixed office", "TR 38.901 open office", "map"),
]


def trained_on(*homes):
    return dataclasses.replace(quick_predictor(), homes=homes)


@pytest.fixture(scope="module")
def table():
    return make_table(homes=4, links=100)


@pytest.fixture(scope="module")
def evaluation(table):
    unsure = table.take(table.anywhere & ~table.context.rx_seen)
    predictor = trained_on("home 1", "elsewhere").fit_indoor(unsure.phi, unsure.inside)
    return evaluate(predictor, table, baselines=fitted_baselines())


class TestEvaluate:
    def test_every_answer_at_every_stage_for_all_and_by_ends_seen(self, evaluation):
        assert evaluation.homes == {"test": ("home 0", "home 2", "home 3"), "train": ("home 1",)}
        for homes, stage in (("test", 0), ("test", 100), ("train", 0), ("train", 100)):
            rows = evaluation.select(homes=homes, receivers="indoor", stage=stage)
            assert [(row.ends_seen, row.model) for row in rows] == [
                (ends, answer) for ends in ("all", "both", "one", "none") for answer in ANSWERS
            ]
        assert [found.state.links.sum() for found in evaluation.calibrations.values()] == [300, 300]
        rows = evaluation.select(homes="test", receivers="anywhere", stage=0, model=WITH_INDOOR)
        total, *parts = (row.metrics.links for row in rows)
        assert total == sum(parts) == 3 * 100
        assert min(parts) > 0

    def test_figures_are_those_of_the_links(self, table, evaluation):
        chosen = np.isin(table.home, ["home 0", "home 2", "home 3"]) & ~table.anywhere & (table.stage == 100)
        links = table.take(chosen & table.context.tx_seen & table.context.rx_seen)
        (row,) = evaluation.select(homes="test", receivers="indoor", stage=100, ends_seen="both", model="predictor")
        expected = measure(quick_predictor().predict(links.phi), links.link_state, links.gain_db).as_json()
        assert row.metrics.as_json() == pytest.approx(expected)

    def test_the_indoor_model_helps_where_receivers_may_be_outside(self, evaluation):
        rows = evaluation.select(homes="test", receivers="anywhere", stage=100, ends_seen="all")
        found = {row.model: row.metrics for row in rows}
        with_it, without = found[WITH_INDOOR], found[WITHOUT_INDOOR]
        assert with_it.accuracy > without.accuracy + 0.05
        for name in ("rmse_db", "nll_state", "calibration_error"):
            assert getattr(with_it, name) < getattr(without, name), name

    def test_a_receiver_that_is_seen_is_indoors_for_certain(self, table):
        doubtful = quick_predictor().fit_indoor(table.phi, np.zeros(len(table)))
        rows = evaluate(doubtful, table, baselines=fitted_baselines()).select(receivers="anywhere", ends_seen="both")
        one, other = (row.metrics.as_json() for row in rows[:2])
        assert one == pytest.approx(other)

    def test_differences_are_paired_by_home(self, table, evaluation):
        (found,) = (each for each in evaluation.differences if each.baseline == "partial trace" and each.stage == 100)
        accuracies, errors_db = [], []
        for name in ("home 0", "home 2", "home 3"):
            links = table.take((table.home == name) & ~table.anywhere & (table.stage == 100))
            answer = quick_predictor().predict(links.phi)
            one, other = answer.link_state == links.link_state, links.phi.link_state == links.link_state
            accuracies.append(one.mean() - other.mean())
            rmse_db = (
                np.sqrt(np.mean((gain_db - links.gain_db) ** 2)) for gain_db in (answer.gain_mean_db, links.phi.gain_db)
            )
            errors_db.append(next(rmse_db) - next(rmse_db))
        assert found.homes == 3
        assert found.accuracy == pytest.approx(np.mean(accuracies))
        assert found.accuracy_error == pytest.approx(np.std(accuracies, ddof=1) / math.sqrt(3))
        assert found.rmse_db == pytest.approx(np.mean(errors_db))
        assert found.rmse_error_db == pytest.approx(np.std(errors_db, ddof=1) / math.sqrt(3))


class TestBaselines:
    def test_the_papers_is_left_out_at_another_frequency_and_in_its_own_evaluation(self, table):
        calls = []
        settings = dataclasses.replace(quick_predictor().settings, frequency_hz=60e9)
        other = dataclasses.replace(trained_on("home 1", "home 2", "home 3"), settings=settings)
        found = evaluate(other, table, baselines=fitted_baselines(), progress=lambda *call: calls.append(call))
        assert "paper" not in {row.model for row in found.rows}
        assert all(each.homes == 1 and math.isnan(each.accuracy_error) for each in found.differences)
        assert calls[0] == (0.0, "measuring on test homes at 0 steps")
        assert calls[-1] == (0.75, "measuring on train homes at 100 steps")
        found = evaluate("paper", table, baselines=fitted_baselines())
        assert {row.model for row in found.select(receivers="indoor")} == {*ANSWERS} - {"paper"}

    def test_notes_say_what_the_baselines_were_fitted_to_and_which_test_homes_they_know(self, table):
        name = Predictor.load("paper").homes[0]
        known = dataclasses.replace(table, home=np.where(table.home == "home 2", name, table.home))
        fitted = Baselines(fitted_baselines().majority, trained_on("home 1", "home 3"))
        notes = evaluate(trained_on("home 0"), known, baselines=fitted).notes
        assert notes[1:] == (
            "Majority and distance only were fitted to 2 homes, others than those of the predictor.",
            "'paper' was trained on 1 of the 3 test homes.",
            "'distance only' was trained on 2 of the 3 test homes.",
        )
        few, note = evaluate(quick_predictor(), table, baselines=fitted_baselines()).notes
        assert "test homes are too few" in few
        assert note == "Majority and distance only were fitted to 2 homes, those of the predictor."

    def test_beside_the_predictor_else_the_shipped_ones(self, table, tmp_path):
        outage = Majority((0.8, 0.1, 0.1), (-150.0, -65.0, -85.0), (0.0, 6.0, 10.0))
        Baselines(outage, quick_predictor()).save(tmp_path)
        truth = table.link_state[~table.anywhere & (table.stage == 0)]
        for folder, majority in ((tmp_path, OUTAGE), (tmp_path / "alone", NLOS)):
            folder.mkdir(exist_ok=True)
            quick_predictor().save(folder / "mine.keras")
            (row, *_) = evaluate(folder / "mine.keras", table).select(model="majority", receivers="indoor")
            assert row.metrics.accuracy == np.mean(truth == majority)
        shipped = Baselines.load(PREDICTORS_FOLDER)
        found = [evaluate(quick_predictor(), table, baselines=each) for each in (None, shipped)]
        rows = [[row.metrics.as_json() for row in each.select(model="distance only")] for each in found]
        assert rows[0] == rows[1] != []


def test_refused(table, tmp_path):
    wifi = make_dataset(tmp_path, table.take(slice(10)), frequency_hz=60e9)
    for predictor, dataset, baselines, message in (
        (trained_on(), table, 5, "baselines = 5 is not allowed: give Baselines, or None"),
        (trained_on(*set(table.home)), table, None, "was trained on all 4 homes of the data set"),
        (trained_on(), table.take(slice(0)), None, "dataset has no links"),
        (trained_on(), wifi, None, "dataset was traced at 60 GHz with diffraction, predictor 'fitted' was trained on"),
    ):
        with pytest.raises(PredictorError, match=message):
            evaluate(predictor, dataset, baselines=baselines)


@pytest.fixture(scope="module")
def fitted():
    return Baselines.fit(make_table(homes=2), QUICK)


def test_majority_by_hand():
    state = np.array([LOS, LOS, NLOS, OUTAGE], dtype=np.uint8)
    answer = Majority.fit(state, np.array([-60.0, -70.0, -90.0, -150.0])).predict(make_links(3)[0])
    assert_valid(answer)
    never = Majority.fit(np.array([LOS], dtype=np.uint8), np.array([-60.0])).predict(make_links(2)[0])
    assert_valid(never)
    assert never.p_nlos.tolist() == [0.0, 0.0]
    assert (answer.p_los == 0.5).all()
    assert (answer.p_outage == 0.25).all()
    assert (answer.gain_los_mean_db == -65.0).all()
    assert (answer.gain_los_std_db == 5.0).all()
    assert answer.gain_mean_db == pytest.approx([-(60 + 70 + 90 + 150) / 4] * 3)


class TestFittedBaselines:
    def test_distance_alone_counts(self, fitted):
        one, other = make_links(50, seed=1)[0], make_links(50, seed=2)[0]
        moved = LinkFeatures(other.link_state, np.zeros(50), one.distance_m, other.gain_db)
        seen = (fitted.distance.predict(nothing_seen(phi, 28e9)) for phi in (one, moved))
        np.testing.assert_array_equal(*(answer.gain_mean_db for answer in seen))

    def test_save_and_load(self, fitted, tmp_path):
        fitted.save(tmp_path)
        loaded = Baselines.load(tmp_path)
        assert loaded.majority == fitted.majority
        assert loaded.distance.fingerprint == fitted.distance.fingerprint

    def test_missing_or_damaged_file(self, tmp_path):
        for _ in ("missing", "damaged"):
            with pytest.raises(PredictorError, match=r"majority\.json' cannot be read.*train the predictor beside it"):
                Baselines.load(tmp_path)
            (tmp_path / "majority.json").write_text('{"OUTAGE": 1}')


def test_all_of_the_link_is_unobserved():
    phi = nothing_seen(make_links(20)[0], 28e9)
    assert set(phi.link_state) == {LOS}
    np.testing.assert_array_equal(phi.unobserved_distance_m, phi.distance_m)
    wavelength_m = 299_792_458.0 / 28e9
    np.testing.assert_allclose(phi.gain_db, 20.0 * np.log10(wavelength_m / (4.0 * math.pi * phi.distance_m)))


def test_los_probability_of_table_7_4_2_of_tr_38901():
    mixed = indoor_los_probability(np.array([1.2, 5.9, 39.1]), "mixed")
    np.testing.assert_allclose(mixed, [1.0, 0.36788, 0.11772], atol=2e-5)
    open_office = indoor_los_probability(np.array([5.0, 40.4, 260.7]), "open")
    np.testing.assert_allclose(open_office, [1.0, 0.60653, 0.19865], atol=2e-5)


def test_gain_of_table_7_4_1_of_tr_38901():
    """InH - Office, by hand; at 1 m NLOS would be stronger than LOS."""
    for distance_m, frequency_hz, los_db, nlos_db in (
        (1.0, 1e9, -32.4, -32.4),
        (10.0, 28e9, -78.6432, -91.6342),
        (100.0, 10e9, -87.0, -118.8),
    ):
        gains_db = indoor_gain_db(np.array([distance_m]), frequency_hz)
        assert gains_db[LinkState.LOS][0] == pytest.approx(los_db, abs=1e-3)
        assert gains_db[LinkState.NLOS][0] == pytest.approx(nlos_db, abs=1e-3)


@pytest.mark.parametrize("office", ["mixed", "open"])
def test_tr_38901_is_a_mixture_without_outage(office):
    distance_m = np.array([0.005, 0.5, 5.9, 30.0, 1e5])
    answer = tr38901_indoor(LinkFeatures(np.full(5, LOS), np.zeros(5), distance_m, np.full(5, -90.0)), 28e9, office)
    assert_valid(answer)
    assert (answer.p_outage == 0.0).all()
    assert (answer.gain_los_std_db == 3.0).all()
    assert (answer.gain_nlos_std_db == 8.03).all()


def test_all_baselines_answer_for_all_links(fitted):
    phi = make_links(30)[0]
    assert "paper" not in baseline_predictions(fitted, None, phi, 28e9)
    found = baseline_predictions(fitted, fitted.distance, phi, 28e9)
    assert list(found) == [
        *("paper", "distance only", "majority", "partial trace"),
        *("TR 38.901 mixed office", "TR 38.901 open office"),
    ]
    for answer in found.values():
        assert_valid(answer)
        assert len(answer.p_los) == 30
