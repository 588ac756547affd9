"""Losses, slopes and priors of materials, on made-up gains whose posterior is known."""

import math

import numpy as np
import pytest
from material_fakes import FREQUENCY_HZ, fake_target, point, quiet

from sionna_partial.calibration import material_fit
from sionna_partial.calibration.gain_errors import GainErrors
from sionna_partial.calibration.material_fit import Posterior, descend, lossless_scale_s_m, prior_posterior

GRADIENT_STEP = 1e-5


class TestMaterialTarget:
    def test_slopes_are_those_of_the_loss(self) -> None:
        target = fake_target(4.0, 0.3)
        here = point(target, 3.7, 0.25)
        gradient, curvature = target.slopes(here)
        for number, move in enumerate(np.eye(2) * GRADIENT_STEP):
            losses = []
            for sign in (1, -1):
                place = np.exp(here.logs + sign * move)
                error_db = target.gain_db - target.gains_db(1.0 + place[:1], place[1:])
                prior = material_fit._prior_loss(1.0 + place[:1], place[1:])
                losses.append(here.errors.curve(error_db, target.is_direct)[0].sum() + prior)
            assert gradient[number] == pytest.approx((losses[0] - losses[1]) / (2 * GRADIENT_STEP), rel=1e-3, abs=1e-3)
        assert (np.linalg.eigvalsh(curvature) > 0.0).all()

    def test_what_is_known_is_not_evaluated_again(self, monkeypatch: pytest.MonkeyPatch) -> None:
        target = fake_target(4.0, 0.3)
        first, slopes = point(target, 3.7, 0.25), target.slopes(point(target, 3.7, 0.25))
        monkeypatch.setattr(target, "paths", None)
        assert point(target, 3.7, 0.25) == first
        for one, other in zip(target.slopes(first), slopes, strict=True):
            np.testing.assert_array_equal(one, other)

    def test_vanishing_paths_give_a_floor(self) -> None:
        gains_db = fake_target(4.0, 0.3).gains_db(np.array([1.0]), np.array([0.0]))
        np.testing.assert_array_equal(gains_db, material_fit.LOWEST_GAIN_DB)


class TestDescend:
    def test_each_step_is_better(self) -> None:
        target = fake_target(4.0, 0.3)
        steps, curvature = descend(target, point(target, 3.9, 0.5), quiet)
        losses = [each.loss for each in steps]
        assert losses == sorted(losses, reverse=True)
        assert losses[0] > losses[-1]
        assert np.abs(np.linalg.solve(curvature, target.slopes(steps[-1])[0])).max() < 0.05


class TestPosterior:
    def test_prior_has_the_spread_that_is_said(self) -> None:
        prior = prior_posterior()
        logs = np.log(prior.conductivity_s_m)
        centre = math.log(material_fit.PRIOR_CONDUCTIVITY_S_M)
        assert prior.deviation(logs, centre) == pytest.approx(material_fit.CONDUCTIVITY_SPREAD, rel=0.03)
        low, high = prior.interval(prior.conductivity_s_m)
        assert (low, high) == pytest.approx((0.0044, 5.1), rel=0.1)

    def test_interval_of_equal_weights(self) -> None:
        values = np.arange(1000.0)[::-1]
        posterior = Posterior(values, values, np.full(1000, 1e-3))
        assert posterior.interval(values) == pytest.approx((24.5, 974.5))

    def test_typical_is_no_odd_one(self) -> None:
        """Among slabs that swallow the wave and one comb, the comb is not typical, however likely."""
        posterior = Posterior(
            np.array([2.94, 4.0, 4.1, 4.2]), np.array([1e-3, 1.0, 1.0, 1.0]), np.array([0.3, 0.2, 0.3, 0.2])
        )
        assert posterior.typical(0.1, FREQUENCY_HZ) in (1, 2, 3)

    def test_lossless_scale(self) -> None:
        """At that conductivity the wave that crosses a slab twice loses a factor of e in amplitude."""
        index, scale = 2.0, lossless_scale_s_m(2.0, 0.1)
        loss = scale / (2.0 * math.pi * FREQUENCY_HZ * 8.8541878128e-12)
        root = np.sqrt(index**2 - 1j * loss)
        nepers = -4.0 * math.pi * FREQUENCY_HZ / 299_792_458.0 * 0.1 * root.imag
        assert nepers == pytest.approx(1.0, rel=0.01)


def test_errors_travel_with_the_point() -> None:
    found = point(fake_target(4.0, 0.3, noise_db=2.0), 4.0, 0.3)
    assert isinstance(found.errors, GainErrors)
    assert found.errors.noise_db == pytest.approx(2.0, abs=0.6)
