"""The density of errors is one, its slopes are its slopes, and its parameters are found again."""

import numpy as np
import pytest

from sionna_partial.calibration.gain_errors import BLOCKED_DB, MISSED_DB, GainErrors, fit_errors

ERRORS_DB = np.linspace(-90.0, 60.0, 30_001)
KINDS = [GainErrors(3.0, 0.0, 0.0), GainErrors(1.5, 0.35, 0.05), GainErrors(6.0, 0.1, 0.2)]


@pytest.mark.parametrize("is_direct", [True, False])
@pytest.mark.parametrize("errors", KINDS)
class TestCurve:
    def test_density_sums_to_one(self, errors: GainErrors, is_direct: bool) -> None:
        value, *_ = errors.curve(ERRORS_DB, np.full(len(ERRORS_DB), is_direct))
        assert np.trapezoid(np.exp(-value), ERRORS_DB) == pytest.approx(1.0, abs=2e-3)

    def test_derivatives_are_those_of_the_value(self, errors: GainErrors, is_direct: bool) -> None:
        value, first, second = errors.curve(ERRORS_DB, np.full(len(ERRORS_DB), is_direct))
        np.testing.assert_allclose(np.gradient(value, ERRORS_DB)[1:-1], first[1:-1], atol=2e-5)
        np.testing.assert_allclose(np.gradient(first, ERRORS_DB)[1:-1], second[1:-1], atol=2e-5)


def test_far_errors_stay_finite_and_pull_little() -> None:
    value, first, _ = KINDS[0].curve(np.array([-400.0, 400.0]), np.array([True, False]))
    assert np.isfinite(value).all()
    np.testing.assert_allclose(first, [-1.0 / BLOCKED_DB, 1.0 / MISSED_DB], rtol=1e-6)


class TestFitErrors:
    def test_noise_alone(self) -> None:
        error_db = 3.0 * np.random.default_rng(0).standard_normal(400)
        errors, _ = fit_errors(error_db, np.arange(400) % 2 == 0)
        assert errors.noise_db == pytest.approx(3.0, abs=0.35)
        assert (errors.missed_share, errors.blocked_share) == (0.0, 0.0)

    def test_missed_paths_do_not_count_as_noise(self) -> None:
        rng = np.random.default_rng(1)
        missed = np.where(rng.random(400) < 0.35, rng.exponential(MISSED_DB, 400), 0.0)
        errors, _ = fit_errors(2.0 * rng.standard_normal(400) + missed, np.zeros(400, dtype=bool))
        assert errors.missed_share in (0.25, 0.5)
        assert errors.noise_db == pytest.approx(2.0, abs=0.5)

    def test_loss_is_that_of_the_density_and_of_what_was_assumed(self) -> None:
        error_db = 4.0 * np.random.default_rng(2).standard_normal(50)
        is_direct = np.arange(50) < 20
        errors, loss = fit_errors(error_db, is_direct)
        assert loss == pytest.approx(errors.curve(error_db, is_direct)[0].sum() + errors.penalty())
        for other in KINDS:
            assert loss <= other.curve(error_db, is_direct)[0].sum() + other.penalty() + 0.5

    def test_one_wild_link_changes_little(self) -> None:
        error_db = 3.0 * np.random.default_rng(3).standard_normal(100)
        is_direct = np.arange(100) < 50
        wild = error_db.copy()
        wild[7] = -80.0
        assert fit_errors(wild, is_direct)[0].noise_db <= 1.3 * fit_errors(error_db, is_direct)[0].noise_db
