import dataclasses
import math
import re

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

UNTRAINED = dataclasses.replace(QUICK, minimum_links=1_000_000)


def links_at(distance_m):
    distance_m = np.asarray(distance_m, dtype=np.float64)
    return LinkFeatures(
        np.full(len(distance_m), LOS), np.zeros_like(distance_m), distance_m, np.full(len(distance_m), -90.0)
    )


@pytest.fixture(scope="module")
def fitted():
    return Baselines.fit(make_table(homes=2), QUICK)


class TestMajority:
    def test_shares_means_and_spreads_by_hand(self):
        state = np.array([LOS, LOS, NLOS, OUTAGE], dtype=np.uint8)
        model = Majority.fit(state, np.array([-60.0, -70.0, -90.0, -150.0]))
        answer = model.predict(make_links(3)[0])
        assert_valid(answer)
        never = Majority.fit(np.array([LOS], dtype=np.uint8), np.array([-60.0])).predict(make_links(2)[0])
        assert_valid(never)
        assert never.p_nlos.tolist() == [0.0, 0.0]
        assert answer.p_los.tolist() == [0.5] * 3
        assert answer.p_outage.tolist() == [0.25] * 3
        assert answer.gain_los_mean_db.tolist() == [-65.0] * 3
        assert answer.gain_los_std_db.tolist() == [5.0] * 3
        assert answer.gain_mean_db == pytest.approx([-(60 + 70 + 90 + 150) / 4] * 3)
        assert set(answer.link_state) == {LOS}


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

    @pytest.mark.parametrize("content", [None, "{", "{}", '{"OUTAGE": 1}'])
    def test_missing_or_damaged_file(self, content, tmp_path):
        path = tmp_path / "majority.json"
        if content is not None:
            path.write_text(content)
        message = f"path = '{path}' cannot be read"
        with pytest.raises(PredictorError, match=re.escape(message) + ".*train the predictor beside it anew"):
            Baselines.load(tmp_path)


class TestNothingSeen:
    def test_all_of_the_link_is_unobserved(self):
        phi = nothing_seen(make_links(20)[0], 28e9)
        assert set(phi.link_state) == {LOS}
        np.testing.assert_array_equal(phi.unobserved_distance_m, phi.distance_m)
        wavelength_m = 299_792_458.0 / 28e9
        np.testing.assert_allclose(phi.gain_db, 20.0 * np.log10(wavelength_m / (4.0 * math.pi * phi.distance_m)))


class TestIndoorLosProbability:
    """By hand from 3GPP TR 38.901, Table 7.4.2-1."""

    @pytest.mark.parametrize(
        ("office", "distance_m", "expected"),
        [
            ("mixed", 1.2, 1.0),
            ("mixed", 5.9, 0.36788),
            ("mixed", 6.5, 0.32),
            ("mixed", 39.1, 0.11772),
            ("open", 5.0, 1.0),
            ("open", 40.4, 0.60653),
            ("open", 49.0, 0.53716),
            ("open", 260.7, 0.19865),
        ],
    )
    def test_by_hand(self, office, distance_m, expected):
        assert indoor_los_probability(np.array([distance_m]), office)[0] == pytest.approx(expected, abs=2e-5)


class TestIndoorGain:
    """By hand from 3GPP TR 38.901, Table 7.4.1-1, InH - Office."""

    @pytest.mark.parametrize(
        ("distance_m", "frequency_hz", "los_db", "nlos_db"),
        [
            (1.0, 1e9, -32.4, -32.4),  # NLOS is never stronger than LOS
            (10.0, 1e9, -49.7, -55.6),
            (10.0, 28e9, -78.6432, -91.6342),
            (100.0, 10e9, -87.0, -118.8),
        ],
    )
    def test_by_hand(self, distance_m, frequency_hz, los_db, nlos_db):
        gains_db = indoor_gain_db(np.array([distance_m]), frequency_hz)
        assert gains_db[LinkState.LOS][0] == pytest.approx(los_db, abs=1e-3)
        assert gains_db[LinkState.NLOS][0] == pytest.approx(nlos_db, abs=1e-3)


class TestTr38901Indoor:
    @pytest.mark.parametrize("office", ["mixed", "open"])
    def test_mixture_without_outage(self, office):
        answer = tr38901_indoor(links_at([0.005, 0.5, 5.9, 30.0, 1e5]), 28e9, office)
        assert_valid(answer)
        assert (answer.p_outage == 0.0).all()
        assert (answer.gain_los_std_db == 3.0).all()
        assert (answer.gain_nlos_std_db == 8.03).all()
        mean_db = answer.p_los * answer.gain_los_mean_db + answer.p_nlos * answer.gain_nlos_mean_db
        np.testing.assert_allclose(answer.gain_mean_db, mean_db)


class TestAnswers:
    def test_all_answer_for_all_links(self, fitted):
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
