import math

import numpy as np
import pytest
from link_tables import make_table
from predictor_links import LOS, NLOS, OUTAGE, QUICK, QUIET, assert_valid, make_links

from sionna_partial.constants import LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.evaluation import (
    Baselines,
    Majority,
    baseline_predictions,
    indoor_gain_db,
    indoor_los_probability,
    nothing_seen,
    tr38901_indoor,
)
from sionna_partial.prediction.features import LinkFeatures

pytestmark = QUIET


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


class TestBaselines:
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

    @pytest.mark.parametrize("content", [None, '{"OUTAGE": 1}'])
    def test_missing_or_damaged_file(self, content, tmp_path):
        if content is not None:
            (tmp_path / "majority.json").write_text(content)
        with pytest.raises(PredictorError, match=r"majority\.json' cannot be read.*train the predictor beside it anew"):
            Baselines.load(tmp_path)


def test_all_of_the_link_is_unobserved():
    phi = nothing_seen(make_links(20)[0], 28e9)
    assert set(phi.link_state) == {LOS}
    np.testing.assert_array_equal(phi.unobserved_distance_m, phi.distance_m)
    wavelength_m = 299_792_458.0 / 28e9
    np.testing.assert_allclose(phi.gain_db, 20.0 * np.log10(wavelength_m / (4.0 * math.pi * phi.distance_m)))


@pytest.mark.parametrize(
    ("office", "distance_m", "expected"),
    [
        *(("mixed", 1.2, 1.0), ("mixed", 5.9, 0.36788), ("mixed", 39.1, 0.11772)),
        *(("open", 5.0, 1.0), ("open", 40.4, 0.60653), ("open", 260.7, 0.19865)),
    ],
)
def test_los_probability_of_table_7_4_2_of_tr_38901(office, distance_m, expected):
    assert indoor_los_probability(np.array([distance_m]), office)[0] == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize(
    ("distance_m", "frequency_hz", "los_db", "nlos_db"),
    [
        (1.0, 1e9, -32.4, -32.4),  # NLOS is never stronger than LOS
        (10.0, 28e9, -78.6432, -91.6342),
        (100.0, 10e9, -87.0, -118.8),
    ],
)
def test_gain_of_table_7_4_1_of_tr_38901(distance_m, frequency_hz, los_db, nlos_db):
    """InH - Office, by hand."""
    gains_db = indoor_gain_db(np.array([distance_m]), frequency_hz)
    assert gains_db[LinkState.LOS][0] == pytest.approx(los_db, abs=1e-3)
    assert gains_db[LinkState.NLOS][0] == pytest.approx(nlos_db, abs=1e-3)


@pytest.mark.parametrize("office", ["mixed", "open"])
def test_tr_38901_is_a_mixture_without_outage(office):
    distance_m = np.array([0.005, 0.5, 5.9, 30.0, 1e5])
    phi = LinkFeatures(np.full(5, LOS), np.zeros(5), distance_m, np.full(5, -90.0))
    answer = tr38901_indoor(phi, 28e9, office)
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
