"""Errors of gains, losses, slopes, priors and the search for materials, on made-up gains whose posterior is known."""

import math

import numpy as np
import pytest
from material_fakes import FREQUENCY_HZ, THICKNESS_M, fake_target, point, quiet

from sionna_partial.calibration import material_fit
from sionna_partial.calibration.material_fit import (
    BLOCKED_DB,
    LOSSLESS,
    MISSED_DB,
    GainErrors,
    Posterior,
    descend,
    fit_errors,
    lossless_scale_s_m,
    prior_loss,
    prior_posterior,
    search,
)

GRADIENT_STEP = 1e-5
ERRORS_DB = np.linspace(-90.0, 60.0, 30_001)
KINDS = [GainErrors(3.0, 0.0, 0.0), GainErrors(1.5, 0.35, 0.05), GainErrors(6.0, 0.1, 0.2)]


@pytest.mark.parametrize("is_direct", [True, False])
@pytest.mark.parametrize("errors", KINDS)
def test_density_of_errors_and_its_derivatives(errors: GainErrors, is_direct: bool) -> None:
    value, first, second = errors.curve(ERRORS_DB, np.full(len(ERRORS_DB), is_direct))
    assert np.trapezoid(np.exp(-value), ERRORS_DB) == pytest.approx(1.0, abs=2e-3)
    np.testing.assert_allclose(np.gradient(value, ERRORS_DB)[1:-1], first[1:-1], atol=2e-5)
    np.testing.assert_allclose(np.gradient(first, ERRORS_DB)[1:-1], second[1:-1], atol=2e-5)


def test_far_errors_stay_finite_and_pull_little() -> None:
    value, first, _ = KINDS[0].curve(np.array([-400.0, 400.0]), np.array([True, False]))
    assert np.isfinite(value).all()
    np.testing.assert_allclose(first, [-1.0 / BLOCKED_DB, 1.0 / MISSED_DB], rtol=1e-6)


class TestFitErrors:
    def test_missed_paths_do_not_count_as_noise(self) -> None:
        rng = np.random.default_rng(1)
        missed = np.where(rng.random(400) < 0.35, rng.exponential(MISSED_DB, 400), 0.0)
        errors, _ = fit_errors(2.0 * rng.standard_normal(400) + missed, np.zeros(400, dtype=bool))
        assert errors.missed_fraction in (0.25, 0.5)
        assert errors.noise_db == pytest.approx(2.0, abs=0.5)

    def test_noise_alone_and_the_loss_of_density_and_prior(self) -> None:
        error_db = 4.0 * np.random.default_rng(2).standard_normal(400)
        is_direct = np.arange(400) < 200
        errors, loss = fit_errors(error_db, is_direct)
        assert errors.noise_db == pytest.approx(4.0, abs=0.4)
        assert (errors.missed_fraction, errors.blocked_fraction) == (0.0, 0.0)
        assert loss == pytest.approx(errors.curve(error_db, is_direct)[0].sum() + errors.penalty())
        for other in KINDS:
            assert loss <= other.curve(error_db, is_direct)[0].sum() + other.penalty() + 0.5

    def test_one_wild_link_changes_little(self) -> None:
        error_db = 3.0 * np.random.default_rng(3).standard_normal(100)
        is_direct = np.arange(100) < 50
        wild = error_db.copy()
        wild[7] = -80.0
        assert fit_errors(wild, is_direct)[0].noise_db <= 1.3 * fit_errors(error_db, is_direct)[0].noise_db


class TestMaterialTarget:
    @pytest.mark.parametrize("weight", [1.0, 0.35])
    def test_slopes_are_those_of_the_loss(self, weight: float) -> None:
        target = fake_target(4.0, 0.3, weight=weight)
        here = point(target, 3.7, 0.25)
        gradient, curvature = target.slopes(here)
        for number, move in enumerate(np.eye(2) * GRADIENT_STEP):
            losses = []
            for sign in (1, -1):
                values = LOSSLESS + np.exp(here.logs + sign * move[:, None])
                error_db = target.gain_db - target.gains_db(target.paths.power(*values))
                losses.append(weight * here.errors.curve(error_db, target.is_direct)[0].sum() + prior_loss(values))
            assert gradient[number] == pytest.approx((losses[0] - losses[1]) / (2 * GRADIENT_STEP), rel=1e-3, abs=1e-3)
        assert (np.linalg.eigvalsh(curvature) > 0.0).all()

    def test_weight_is_the_power_of_the_likelihood(self) -> None:
        full, tempered = (point(fake_target(4.0, 0.3, weight=weight), 3.7, 0.25) for weight in (1.0, 0.35))
        prior = prior_loss(full.values)
        assert tempered.loss - prior == pytest.approx(0.35 * (full.loss - prior))


class TestPosterior:
    def test_prior_has_the_spread_that_is_said(self) -> None:
        prior = prior_posterior()
        logs = np.log(prior.conductivity_s_m)
        centre = math.log(material_fit.PRIOR_MEDIAN[1, 0])
        assert prior.deviation(logs, centre) == pytest.approx(material_fit.PRIOR_SPREAD[1, 0], rel=0.03)
        low, high = prior.interval(prior.conductivity_s_m)
        assert (low, high) == pytest.approx((0.0044, 5.1), rel=0.1)

    def test_interval_of_equal_weights(self) -> None:
        values = np.arange(1000.0)[::-1]
        posterior = Posterior(values, values, np.full(1000, 1e-3))
        assert posterior.interval(values) == pytest.approx((24.5, 974.5))

    def test_typical_is_no_odd_one(self) -> None:
        """Among slabs that absorb the wave and one with fringes, the latter is not typical, however likely."""
        posterior = Posterior(
            np.array([2.94, 4.0, 4.1, 4.2]), np.array([1e-3, 1.0, 1.0, 1.0]), np.array([0.3, 0.2, 0.3, 0.2])
        )
        assert posterior.typical(0.1, FREQUENCY_HZ)[0] in (4.0, 4.1, 4.2)

    def test_lossless_scale(self) -> None:
        """At that conductivity the wave that crosses a slab twice loses a factor of e in amplitude."""
        index, scale = 2.0, lossless_scale_s_m(2.0, 0.1)
        loss = scale / (2.0 * math.pi * FREQUENCY_HZ * 8.8541878128e-12)
        root = np.sqrt(index**2 - 1j * loss)
        nepers = -4.0 * math.pi * FREQUENCY_HZ / 299_792_458.0 * 0.1 * root.imag
        assert nepers == pytest.approx(1.0, rel=0.01)


class TestSearch:
    @pytest.mark.parametrize(("permittivity", "conductivity_s_m"), [(2.94, 0.12), (3.9, 0.02), (6.3, 1e-4)])
    def test_finds_the_fringe(self, permittivity: float, conductivity_s_m: float) -> None:
        target = fake_target(permittivity, conductivity_s_m)
        found, posterior = search(target, point(target, 25.0, 20.0), 0, THICKNESS_M, FREQUENCY_HZ, quiet)
        steps, _ = descend(target, found[0], quiet)
        truth = point(target, permittivity, conductivity_s_m)
        assert steps[-1].loss <= truth.loss + 0.5
        assert steps[-1].values[0, 0] == pytest.approx(permittivity, rel=0.03)
        low, high = posterior.interval(posterior.permittivity)
        assert low - 0.02 <= permittivity <= high + 0.02
        assert posterior.weight.sum() == pytest.approx(1.0)

    def test_posterior_is_that_of_a_fine_grid(self) -> None:
        """A slab of little loss has a narrow, inclined ridge, which cells must follow."""
        target = fake_target(3.9, 0.02, noise_db=3.0)
        _, posterior = search(target, point(target, 3.0, 0.1), 0, THICKNESS_M, FREQUENCY_HZ, quiet)
        logs = np.log([np.sqrt(posterior.permittivity), posterior.conductivity_s_m])
        centre = logs @ posterior.weight
        spread = np.sqrt(((logs - centre[:, None]) ** 2) @ posterior.weight)
        grid = centre[:, None] + spread[:, None] * np.reshape(np.meshgrid(*[np.linspace(-6.0, 6.0, 41)] * 2), (2, -1))
        loss = np.array([point(target, *np.exp([2.0 * row[0], row[1]])).loss for row in grid.T])
        weight = np.exp(loss.min() - loss) / np.exp(loss.min() - loss).sum()
        fine = grid @ weight
        np.testing.assert_allclose((centre - fine) / spread, 0.0, atol=0.1)
        np.testing.assert_allclose(spread, np.sqrt((grid - fine[:, None]) ** 2 @ weight), rtol=0.15)
