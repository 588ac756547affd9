"""Upper bounds on the power of candidates, and which of them a link can do without.

A path keeps at most |R|^2 of its power at every reflection, R being the larger of the slab's two reflection
coefficients at that angle (ITU-R P.2040-3), and at a diffraction at most what the terms of the uniform theory of
diffraction give if they all add up. Both are known before Sionna RT verifies a candidate.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S
from sionna_partial.process import njit
from sionna_partial.tracing.slab import reflection_coefficients

LEVELS = 96
"""Number of levels that bounds are sorted into. Level 0 holds the direct path alone, the last all that is too weak for
any of the others."""

_LEVEL_DB, _STRONGEST_DB = 1.5, -40.0
_ANGLES, _MARGIN = 1024, 1.02
_DIFFRACTED_FRACTION = 0.5


class Strengths(NamedTuple):
    """Upper bounds of interactions, and the levels of the candidates that are asked for.

    `reflection` (M, K) is the largest |R|^2 of each material where the cosine of the angle of incidence is k / K to
    (k + 1) / K.
    Candidates of each receiver are written whose level is at least `first` (N,) and below `last` (N,). The bounds of
    all candidates are added to `power` (N, LEVELS), those of paths that are reflected at walls alone to `reflected`.
    """

    wavelength_m: float
    reflection: NDArray[np.float64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    power: NDArray[np.float64]
    reflected: NDArray[np.float64]


def strengths_of(materials: Iterable[NDArray[np.float64]], frequency_hz: float, receivers: int) -> Strengths:
    """Prepare bounds for materials, each permittivity, conductivity and thickness (3,), and ask for all candidates."""
    cosine = np.linspace(0.0, 1.0, 8 * _ANGLES + 1)
    reflection = []
    for permittivity, conductivity_s_m, thickness_m in materials:
        te, tm = reflection_coefficients(permittivity, conductivity_s_m, thickness_m, frequency_hz, cosine)
        largest = np.maximum(np.abs(te), np.abs(tm)) ** 2
        ends = np.maximum(largest[:-1], largest[1:]).reshape(_ANGLES, 8).max(axis=1)
        reflection.append(np.minimum(_MARGIN * ends, 1.0))
    return Strengths(
        SPEED_OF_LIGHT_M_S / frequency_hz,
        np.reshape(reflection, (-1, _ANGLES)),
        np.zeros(receivers, np.int64),
        np.full(receivers, LEVELS, np.int64),
        np.zeros((receivers, LEVELS)),
        np.zeros(receivers),
    )


def levels_needed(power: NDArray[np.float64], allowed: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return up to which level (N,) candidates are needed, if those beyond may add up to `allowed` (N,) at most."""
    beyond = np.cumsum(power[:, ::-1], axis=1)[:, ::-1]
    return 1 + np.sum(beyond[:, 1:] > allowed[:, None], axis=1)


def expected_power(power: NDArray[np.float64], reflected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Guess the power (N,) of the indirect paths from sums of bounds: reflections reach theirs, diffractions do not."""
    return reflected + _DIFFRACTED_FRACTION * np.maximum(power[:, 1:].sum(axis=1) - reflected, 0.0)


def dropped_power(found: NDArray[np.float64], tolerance_db: float) -> NDArray[np.float64]:
    """Return the power (N,) that links may lack whose indirect paths have the power `found` (N,).

    It changes that power by `tolerance_db` at most; a link without any may lack what no receiver could notice.
    """
    fraction = 10.0 ** (tolerance_db / 10.0) - 1.0
    return np.maximum(fraction * found, 10.0 ** (GAIN_FLOOR_DB / 10.0) - found)


@njit(cache=True)
def level_of(power):  # type: ignore[no-untyped-def]
    """Level of a bound on the power of an indirect path."""
    if power <= 0.0:
        return LEVELS - 1
    level = 1 + int((_STRONGEST_DB - 10.0 * math.log10(power)) / _LEVEL_DB)
    return min(max(level, 1), LEVELS - 1)


@njit(cache=True)
def reflected_power(reflection, cosine):  # type: ignore[no-untyped-def]
    """Largest fraction of the power that a reflection by one of the materials leaves."""
    return reflection[min(int(abs(cosine) * _ANGLES), _ANGLES - 1)]


@njit(cache=True)
def utd_terms(exterior, arrival, departure, most, terms):  # type: ignore[no-untyped-def]
    """Write upper bounds of the four terms of the UTD coefficient of a wedge, times sqrt(2 pi wavenumber).

    The angles [rad] count from the 0-face. A term is cot(psi) F / 2 n. The transition function F is at most 1, and at
    shadow boundaries, where the cotangent has no limit, a term has that of half the incident field, `most`.
    """
    n = exterior / math.pi
    for k in range(4):
        beta = departure - arrival if k < 2 else departure + arrival
        psi = (math.pi + beta if k % 2 == 0 else math.pi - beta) / (2.0 * n)
        tangent = abs(math.tan(psi))
        terms[k] = min(1.0 / (2.0 * n * tangent), most) if tangent > 1e-12 else most
