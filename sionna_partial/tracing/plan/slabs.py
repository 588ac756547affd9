"""What walls reflect and let through, tabulated over the angle of incidence."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit
from sionna_partial.tracing.slab import reflection_coefficients, transmission_coefficients

COSINES = 2048
"""Steps of the tables over the cosine of the angle of incidence."""


class Slabs(NamedTuple):
    """Coefficients (M, K + 1, 2) of M materials, TE and TM, where the cosine of the angle of incidence is k / K.

    `most_reflected` (M, K + 1) is the largest |R|^2 at this cosine or a larger one, `most_transmitted` (M, K + 1) the
    largest |T|^2 at this cosine or a smaller one. `material` (P,) is that of the pieces of walls of the plan; floor and
    ceiling are of the first.
    """

    reflection: NDArray[np.complex128]
    transmission: NDArray[np.complex128]
    most_reflected: Floats
    most_transmitted: Floats
    material: NDArray[np.int64]


def slabs_of(constants: Iterable[ArrayLike], material: NDArray[np.int64], frequency_hz: float) -> Slabs:
    """Tabulate the coefficients of materials, each permittivity, conductivity and thickness (3,)."""
    cosine = np.linspace(0.0, 1.0, COSINES + 1)
    given = np.array(list(constants), dtype=np.float64).reshape(-1, 3)
    reflection, transmission = (
        np.stack([np.stack(coefficients(e, s, d, frequency_hz, cosine), axis=1) for e, s, d in given])
        for coefficients in (reflection_coefficients, transmission_coefficients)
    )
    reflection[:, 0], transmission[:, 0] = -1.0, 0.0
    reflected, transmitted = (np.max(np.abs(each) ** 2, axis=2) for each in (reflection, transmission))
    most_reflected = np.maximum.accumulate(reflected[:, ::-1], axis=1)[:, ::-1].copy()
    return Slabs(reflection, transmission, most_reflected, np.maximum.accumulate(transmitted, axis=1), material)


@njit(cache=True)
def reflected_part(slabs, material, cosine):  # type: ignore[no-untyped-def]
    """Largest fraction of the power, however polarised, that a reflection leaves near a cosine."""
    at = min(int(cosine * COSINES + 0.5), COSINES)
    te, tm = slabs.reflection[material, at]
    return max(te.real**2 + te.imag**2, tm.real**2 + tm.imag**2)
