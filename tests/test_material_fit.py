"""Errors of gains, losses, slopes, priors and the search for materials, on made-up gains whose posterior is known."""

import math
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from sionna_partial.calibration import material_fit
from sionna_partial.calibration.link_paths import LinkPaths
from sionna_partial.calibration.material_fit import (
    BLOCKED_DB,
    LOSSLESS,
    MISSED_DB,
    GainErrors,
    MaterialTarget,
    Point,
    Posterior,
    descend,
    fit_errors,
    lossless_scale_s_m,
    prior_loss,
    prior_posterior,
    search,
)
from sionna_partial.tracing.power import reflection_loss_db

FREQUENCY_HZ, THICKNESS_M = 28e9, 0.03
ANGLES_DEG = np.linspace(2.0, 78.0, 60)


class FakePaths:
    """One reflection a link, at an angle of its own, in double precision."""

    link = np.arange(len(ANGLES_DEG))
    is_direct = np.zeros(len(ANGLES_DEG), dtype=bool)

    def power(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> NDArray[np.float64]:
        loss_db = reflection_loss_db(
            float(permittivity[0]), float(conductivity_s_m[0]), THICKNESS_M, FREQUENCY_HZ, ANGLES_DEG
        )
        return np.asarray(10.0 ** (-(80.0 + loss_db) / 10.0))

    def slopes(
        self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        at = np.concatenate([permittivity, conductivity_s_m])
        ends = [
            [self.power(position[:1], position[1:]) for position in (at + move, at - move)] for move in np.eye(2) * 1e-6
        ]
        slopes = np.stack([(high - low) / 2e-6 for high, low in ends], axis=1)
        return self.power(permittivity, conductivity_s_m), slopes


def fake_target(
    permittivity: float, conductivity_s_m: float, noise_db: float = 1.0, weight: float = 1.0
) -> MaterialTarget:
    gain_db = 10.0 * np.log10(FakePaths().power(np.array([permittivity]), np.array([conductivity_s_m])))
    noise = noise_db * np.random.default_rng(0).standard_normal(len(gain_db))
    return MaterialTarget(cast(LinkPaths, FakePaths()), gain_db + noise, np.zeros(len(gain_db)), weight)


def quiet(share: float, message: str) -> None:
    assert 0.0 <= share <= 1.0
    assert message


def point(target: MaterialTarget, permittivity: float, conductivity_s_m: float) -> Point:
    return target.at(np.array([[permittivity], [conductivity_s_m]]))


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
    def test_noise_alone_and_the_loss_of_density_and_prior(self) -> None:
        error_db = 4.0 * np.random.default_rng(2).standard_normal(400)
        is_direct = np.arange(400) < 200
        errors, loss = fit_errors(error_db, is_direct)
        assert errors.noise_db == pytest.approx(4.0, abs=0.4)
        assert (errors.missed_fraction, errors.blocked_fraction) == (0.0, 0.0)
        assert loss == pytest.approx(errors.curve(error_db, is_direct)[0].sum() + errors.penalty())
        for other in KINDS:
            assert loss <= other.curve(error_db, is_direct)[0].sum() + other.penalty() + 0.5


class TestMaterialTarget:
    def test_slopes_are_those_of_the_loss(self) -> None:
        weight, target = 0.35, fake_target(4.0, 0.3, weight=0.35)
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


class TestPosterior:
    def test_prior_and_scale(self) -> None:
        prior = prior_posterior()
        logs = np.log(prior.conductivity_s_m)
        centre = math.log(material_fit.PRIOR_MEDIAN[1, 0])
        assert prior.deviation(logs, centre) == pytest.approx(material_fit.PRIOR_SPREAD[1, 0], rel=0.03)
        low, high = prior.interval(prior.conductivity_s_m)
        assert (low, high) == pytest.approx((0.0044, 5.1), rel=0.1)
        posterior = Posterior(
            np.array([2.94, 4.0, 4.1, 4.2]), np.array([1e-3, 1.0, 1.0, 1.0]), np.array([0.3, 0.2, 0.3, 0.2])
        )
        assert posterior.typical(0.1, FREQUENCY_HZ)[0] in (4.0, 4.1, 4.2)
        index, scale = 2.0, lossless_scale_s_m(2.0, 0.1)
        loss = scale / (2.0 * math.pi * FREQUENCY_HZ * 8.8541878128e-12)
        root = np.sqrt(index**2 - 1j * loss)
        nepers = -4.0 * math.pi * FREQUENCY_HZ / 299_792_458.0 * 0.1 * root.imag
        assert nepers == pytest.approx(1.0, rel=0.01)


class TestSearch:
    @pytest.mark.parametrize(("permittivity", "conductivity_s_m"), [(2.94, 0.12), (6.3, 1e-4)])
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
