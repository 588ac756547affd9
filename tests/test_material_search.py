"""The search finds what explains gains, on made-up gains whose posterior is known."""

import numpy as np
import pytest
from material_fakes import FREQUENCY_HZ, THICKNESS_M, fake_target, point, quiet

from sionna_partial.calibration.material_fit import descend
from sionna_partial.calibration.material_search import search


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
