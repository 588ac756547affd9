"""Reflection off a slab, against Sionna RT and against what is known without it."""

import numpy as np
import pytest

from sionna_partial.llvm import load_sionna
from sionna_partial.tracing.power import VACUUM_F_M, reflection_loss_db

FREQUENCY_HZ = 28e9
ANGLES_DEG = np.array([0.0, 20.0, 45.0, 70.0, 85.0])


@pytest.mark.parametrize("thickness_m", [0.003, 0.02])
@pytest.mark.parametrize(("permittivity", "conductivity_s_m"), [(2.94, 0.1226), (5.24, 0.6), (3.9, 0.0), (1.5, 3.0)])
def test_as_sionna_has_it(permittivity: float, conductivity_s_m: float, thickness_m: float) -> None:
    load_sionna()
    import mitsuba as mi
    from sionna.rt.utils import itu_coefficients_single_layer_slab

    loss = conductivity_s_m / (2.0 * np.pi * FREQUENCY_HZ * VACUUM_F_M)
    cosine = mi.Float(np.cos(np.radians(ANGLES_DEG)).astype(np.float32))
    wavelength = mi.Float(299_792_458.0 / FREQUENCY_HZ)
    eta = mi.Complex2f(permittivity, -loss)
    te, tm, *_ = itu_coefficients_single_layer_slab(cosine, eta, mi.Float(thickness_m), wavelength)
    for name, theirs in (("te", te), ("tm", tm)):
        ours_db = reflection_loss_db(permittivity, conductivity_s_m, thickness_m, FREQUENCY_HZ, ANGLES_DEG, name)
        amplitude = np.hypot(theirs.real.numpy(), theirs.imag.numpy())
        np.testing.assert_allclose(10.0 ** (-ours_db / 20.0), amplitude, atol=2e-4)


def test_analytic_identities() -> None:
    assert reflection_loss_db(9.0, 0.5, 1.0, FREQUENCY_HZ, 0.0) == pytest.approx(20.0 * np.log10(2.0), abs=0.02)
    brewster_deg = np.degrees(np.arctan(2.0))
    assert reflection_loss_db(4.0, 0.0, 0.0123, FREQUENCY_HZ, brewster_deg, "tm") > 100.0
    assert reflection_loss_db(1.0, 1e9, 0.1, FREQUENCY_HZ, 45.0) == pytest.approx(0.0, abs=0.01)
    assert reflection_loss_db(3.0, 0.1, 0.1, FREQUENCY_HZ, 90.0) == pytest.approx(0.0, abs=1e-9)
