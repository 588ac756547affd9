"""The search finds what explains gains, on made-up gains whose posterior is known, without tracing anything."""

import math
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from sionna_partial.inverse import material_fit
from sionna_partial.inverse.gain_errors import GainErrors
from sionna_partial.inverse.material_fit import (
    MaterialTarget,
    Point,
    Posterior,
    descend,
    lossless_scale_s_m,
    prior_posterior,
    search,
)
from sionna_partial.inverse.material_paths import MaterialPaths
from sionna_partial.inverse.slab import reflection_loss_db

FREQUENCY_HZ, THICKNESS_M = 28e9, 0.03
ANGLES_DEG = np.linspace(2.0, 78.0, 60)
GRADIENT_STEP = 1e-5


class FakePaths:
    """One reflection a link, at an angle of its own, in double precision."""

    link = np.arange(len(ANGLES_DEG))
    is_direct = np.zeros(len(ANGLES_DEG), dtype=bool)
    at_once = 7

    def power(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> NDArray[np.float64]:
        loss_db = reflection_loss_db(
            float(permittivity[0]), float(conductivity_s_m[0]), THICKNESS_M, FREQUENCY_HZ, ANGLES_DEG
        )
        return np.asarray(10.0 ** (-(80.0 + loss_db) / 10.0))

    def powers(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> NDArray[np.float64]:
        assert len(permittivity) <= self.at_once
        return np.stack([self.power(*pair) for pair in zip(permittivity, conductivity_s_m, strict=True)])

    def slopes(
        self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        at = np.concatenate([permittivity, conductivity_s_m])
        ends = [[self.power(place[:1], place[1:]) for place in (at + move, at - move)] for move in np.eye(2) * 1e-6]
        slopes = np.stack([(high - low) / 2e-6 for high, low in ends], axis=1)
        return self.power(permittivity, conductivity_s_m), slopes


def fake_target(permittivity: float, conductivity_s_m: float, noise_db: float = 1.0) -> MaterialTarget:
    gain_db = 10.0 * np.log10(FakePaths().power(np.array([permittivity]), np.array([conductivity_s_m])))
    noise = noise_db * np.random.default_rng(0).standard_normal(len(gain_db))
    return MaterialTarget(cast(MaterialPaths, FakePaths()), gain_db + noise)


def quiet(share: float, message: str) -> None:
    assert 0.0 <= share <= 1.0
    assert message


def point(target: MaterialTarget, permittivity: float, conductivity_s_m: float) -> Point:
    return target.at(np.array([permittivity]), np.array([conductivity_s_m]))


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

    def test_many_together_are_judged_as_one_by_one(self) -> None:
        target, other = fake_target(4.0, 0.3), fake_target(4.0, 0.3)
        permittivity, conductivity_s_m = np.linspace(2.0, 6.0, 17)[:, None], np.full((17, 1), 0.3)
        told = []
        target.on_progress = lambda: told.append(len(target.known))
        target.prepare(permittivity, conductivity_s_m)
        assert told == [7, 14, 17]
        target.prepare(permittivity, conductivity_s_m)
        for pair in zip(permittivity, conductivity_s_m, strict=True):
            other.at(*pair)
        assert target.known == other.known
        assert told == [7, 14, 17]

    def test_vanishing_paths_give_a_floor(self) -> None:
        gains_db = fake_target(4.0, 0.3).gains_db(np.array([1.0]), np.array([0.0]))
        np.testing.assert_array_equal(gains_db, material_fit.LOWEST_GAIN_DB)


class TestSearch:
    @pytest.mark.parametrize(("permittivity", "conductivity_s_m"), [(2.94, 0.12), (3.9, 0.02), (6.3, 1e-4)])
    def test_finds_the_tooth(self, permittivity: float, conductivity_s_m: float) -> None:
        target = fake_target(permittivity, conductivity_s_m)
        found, posterior = search(target, point(target, 25.0, 20.0), 0, THICKNESS_M, FREQUENCY_HZ, quiet)
        steps, _ = descend(target, found[0], quiet)
        truth = point(target, permittivity, conductivity_s_m)
        assert steps[-1].loss <= truth.loss + 0.5
        assert steps[-1].permittivity[0] == pytest.approx(permittivity, rel=0.03)
        low, high = posterior.interval(posterior.permittivity)
        assert low - 0.02 <= permittivity <= high + 0.02
        assert posterior.weight.sum() == pytest.approx(1.0)

    def test_opaque_slab_hides_its_conductivity(self) -> None:
        target = fake_target(5.24, 0.8, noise_db=3.0)
        _, posterior = search(target, point(target, 3.0, 0.1), 0, 0.1, FREQUENCY_HZ, quiet)
        low, high = posterior.interval(posterior.conductivity_s_m)
        assert high / low > 5.0

    def test_same_answer_from_any_start(self) -> None:
        answers = []
        for start in ((3.0, 0.1), (30.0, 10.0)):
            target = fake_target(4.0, 0.3)
            answers.append(search(target, point(target, *start), 0, THICKNESS_M, FREQUENCY_HZ, quiet)[1])
        np.testing.assert_array_equal(answers[0].weight, answers[1].weight)


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
