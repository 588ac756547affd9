"""The power of candidates before Sionna RT has verified them, and which of them a link can do without.

Between vertically polarised antennas the power of a path follows from its geometry: the slab's reflection coefficients
(ITU-R P.2040-3) at walls, floor and ceiling, and the uniform theory of diffraction (UTD) at an edge. It is an upper
bound where a slanting path has a horizontal component for a while, which is added up by magnitude.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fresnel

from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S
from sionna_partial.process import njit
from sionna_partial.tracing.slab import reflection_coefficients

LEVELS = 96
"""Number of levels that bounds are sorted into. Level 0 holds the direct path alone, the last all that is too weak for
any of the others."""

_STRONGEST = -25
"""Level of a power of 0 dB: there are two levels for a factor of 2, 1.5 dB each."""

_ANGLES, _MARGIN = 1024, 1.01
_FOUND = 0.8
_CANCELLED = 0.02
"""Fraction of the terms of a diffraction that single precision may leave where they cancel each other."""

NEGLIGIBLE = 3e-6
"""Power of diffracted paths, relative to all reflected ones of a link, below which a rough bound will do."""

_STEPS, _ASYMPTOTIC = 128, 3.0
"""Entries of the table of the UTD transition function per unit, and where its asymptotic series takes over."""


class Strengths(NamedTuple):
    """What interactions leave of a field, and the levels of the candidates that are asked for.

    `largest` (M, K, 4) are the largest |TE|, |TM| and |TE + TM| of each material where the cosine of the angle of
    incidence is k / K to (k + 1) / K, and the largest of the first two where it is k / K or more. `faces` (M, K + 1, 2)
    are the coefficients TE and TM where it is k / K, `transition` is F(y^2) / y of the UTD transition function F.
    Candidates of each receiver are written whose level is at least `first` (N,) and below `last` (N,). The bounds of
    all candidates are added to `power` (N, LEVELS), those of paths without diffraction to `reflected` (N,).
    """

    wavelength_m: float
    largest: NDArray[np.float64]
    faces: NDArray[np.complex128]
    transition: NDArray[np.complex128]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    power: NDArray[np.float64]
    reflected: NDArray[np.float64]


def strengths_of(materials: Iterable[NDArray[np.float64]], frequency_hz: float, receivers: int) -> Strengths:
    """Prepare bounds for materials, each permittivity, conductivity and thickness (3,), and ask for all candidates."""
    cosine = np.linspace(0.0, 1.0, 8 * _ANGLES + 1)
    largest, faces = [], []
    for permittivity, conductivity_s_m, thickness_m in materials:
        te, tm = reflection_coefficients(permittivity, conductivity_s_m, thickness_m, frequency_hz, cosine)
        sizes = np.abs([te, tm, te + tm]).T
        ends = np.maximum(sizes[:-1], sizes[1:]).reshape(_ANGLES, 8, 3).max(axis=1)
        beyond = np.maximum.accumulate(ends[::-1, :2].max(axis=1))[::-1, None]
        largest.append(np.minimum(_MARGIN * np.hstack([ends, beyond]), [1.0, 1.0, 2.0, 1.0]))
        faces.append(np.stack([te, tm], axis=1)[::8])
    return Strengths(
        SPEED_OF_LIGHT_M_S / frequency_hz,
        np.reshape(largest, (-1, _ANGLES, 4)),
        np.reshape(faces, (-1, _ANGLES + 1, 2)).astype(np.complex128),
        _transition_table(),
        np.zeros(receivers, np.int64),
        np.full(receivers, LEVELS, np.int64),
        np.zeros((receivers, LEVELS)),
        np.zeros(receivers),
    )


def _transition_table() -> NDArray[np.complex128]:
    """F(y^2) / y (Kouyoumjian and Pathak 1974) for y = k / _STEPS."""
    y = np.arange(_STEPS * _ASYMPTOTIC + 2) / _STEPS
    sine, cosine = fresnel(math.sqrt(2.0 / math.pi) * y)
    table: NDArray[np.complex128] = np.exp(1j * y**2) * (1.0 + 1j - 2j * (cosine - 1j * sine))
    return math.sqrt(0.5 * math.pi) * table


def levels_needed(power: NDArray[np.float64], allowed: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return up to which level (N,) candidates are needed, if those beyond may add up to `allowed` (N,) at most."""
    beyond = np.cumsum(power[:, ::-1], axis=1)[:, ::-1]
    return 1 + np.sum(beyond[:, 1:] > allowed[:, None], axis=1)


def expected_power(power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Guess the power (N,) that indirect paths have at least from the sums of their bounds (N, LEVELS)."""
    expected: NDArray[np.float64] = _FOUND * power[:, 1:].sum(axis=1)
    return expected


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
    mantissa, exponent = math.frexp(power)
    level = _STRONGEST - 2 * exponent + (mantissa < math.sqrt(0.5))
    return min(max(level, 1), LEVELS - 1)


@njit(cache=True)
def reflected_power(largest, cosine):  # type: ignore[no-untyped-def]
    """Largest fraction of the power that a reflection by one of the materials leaves, however polarised."""
    at = min(int(abs(cosine) * _ANGLES), _ANGLES - 1)
    return max(largest[at, 0], largest[at, 1]) ** 2


@njit(cache=True)
def transmitted_power(transmission, cosine):  # type: ignore[no-untyped-def]
    """Largest fraction of the power that a wall leaves, however polarised, by its coefficients (K + 1, 2)."""
    te, tm = transmission[min(int(cosine * (len(transmission) - 1) + 0.5), len(transmission) - 1)]
    return max(te.real**2 + te.imag**2, tm.real**2 + tm.imag**2)


@njit(cache=True)
def most_at_wall(largest, material, cosine):  # type: ignore[no-untyped-def]
    """Upper bound of what a reflection leaves of any field, if the cosine of the angle of incidence is no smaller."""
    return largest[material, min(int(abs(cosine) * _ANGLES), _ANGLES - 1), 3]


@njit(cache=True)
def at_wall(largest, material, cosine, sine, slope, field):  # type: ignore[no-untyped-def]
    """Bounds of a field after a reflection at a wall: vertical, horizontal, and what of the vertical always was.

    `cosine` is that of the angle of incidence seen from above; `sine` and `slope` are the horizontal and the vertical
    part of the direction of the path.
    """
    cosine = min(abs(cosine), 1.0)
    at = min(int(cosine * sine * _ANGLES), _ANGLES - 1)
    te, tm, both = largest[material, at, 0], largest[material, at, 1], largest[material, at, 2]
    part = _te_part(1.0 - cosine * cosine, sine, slope)
    kept, mixed, other = te * part + tm * (1.0 - part), both * math.sqrt(part * (1.0 - part)), te + (tm - te) * part
    vertical, horizontal, pure = field
    return kept * vertical + mixed * horizontal, mixed * vertical + other * horizontal, kept * pure


@njit(cache=True)
def at_edge(tables, material, terms, boundary, cosines, sine, slope, field):  # type: ignore[no-untyped-def]
    """Bounds of a field after a diffraction likewise, but for the spread of the wave.

    `tables` are `faces` and `transition` of `Strengths`, `boundary` is sqrt(2 k L), and `cosines` are those of the
    angles of incidence at both faces.
    """
    (faces, transition), (cosine_0, cosine_n) = tables, cosines
    by_0 = utd_term(transition, terms, 0, boundary) - utd_term(transition, terms, 3, boundary)
    by_n = utd_term(transition, terms, 1, boundary) - utd_term(transition, terms, 2, boundary)
    size_0, size_n = _size(by_0), _size(by_n)
    own_0, mixed_0, other_0 = _at_face(faces, material, cosine_0, sine, slope)
    own_n, mixed_n, other_n = _at_face(faces, material, cosine_n, sine, slope)
    kept = _size(own_0 * by_0 + own_n * by_n) + _CANCELLED * (_size(own_0) * size_0 + _size(own_n) * size_n)
    vertical, horizontal, pure = field
    mixed, other = mixed_0 * size_0 + mixed_n * size_n, other_0 * size_0 + other_n * size_n
    return kept * vertical + mixed * horizontal, mixed * vertical + other * horizontal, kept * pure


@njit(cache=True)
def most_at_edge(terms, boundary, face_0, face_n):  # type: ignore[no-untyped-def]
    """Rough upper bound of a field after a diffraction, from what both faces reflect at most."""
    size = 0.0
    for k, other, face in ((0, 3, face_0), (1, 2, face_n)):
        first, second = terms[k, 0], terms[other, 0]
        here, there = boundary * terms[k, 1], boundary * terms[other, 1]
        if min(here, there) > _ASYMPTOTIC:
            size += face * (abs(first - second) + abs(first) / (here * here) + abs(second) / (there * there))
        else:
            size += face * (abs(first) * min(1.0, 2.0 * here) + abs(second) * min(1.0, 2.0 * there))
    return size


@njit(cache=True)
def at_flats(largest, material, slope, bounces, field):  # type: ignore[no-untyped-def]
    """Bound of a vertical field after reflections off floor and ceiling, wherever they are in the path."""
    at = min(int(slope * _ANGLES), _ANGLES - 1)
    te, tm = largest[material, at, 0], largest[material, at, 1]
    vertical, _, pure = field
    return tm**bounces * pure + max(te, tm) ** bounces * (vertical - pure)


@njit(cache=True)
def _te_part(along, sine, slope):  # type: ignore[no-untyped-def]
    """Part of a vertical field's power that is perpendicular to the plane of incidence at a wall.

    `along` is the square of the cosine of the angle between path and wall, seen from above.
    """
    return along / (slope * slope + sine * sine * along) if slope * slope > 1e-12 else 1.0


@njit(cache=True)
def _at_face(faces, material, cosine, sine, slope):  # type: ignore[no-untyped-def]
    """Coefficient of a vertical field at a face of a wedge, and sizes of the others.

    A face in the shadow, where the cosine is negative, is a perfect mirror to Sionna RT.
    """
    if cosine < 0.0:
        return 1.0 + 0.0j, 0.0, 1.0
    at = cosine * sine * _ANGLES
    k = min(int(at), _ANGLES - 1)
    te = faces[material, k, 0] + (at - k) * (faces[material, k + 1, 0] - faces[material, k, 0])
    if slope < 1e-6:
        return te, 0.0, 0.0
    tm = faces[material, k, 1] + (at - k) * (faces[material, k + 1, 1] - faces[material, k, 1])
    part = _te_part(1.0 - cosine * cosine, sine, slope)
    mixed = _size(te + tm) * math.sqrt(part * (1.0 - part))
    return part * te - (1.0 - part) * tm, mixed, (1.0 - part) * _size(te) + part * _size(tm)


@njit(cache=True)
def _size(number):  # type: ignore[no-untyped-def]
    """Magnitude of a complex number; `abs` is slower, as it cannot overflow."""
    return math.sqrt(number.real * number.real + number.imag * number.imag)


@njit(cache=True)
def wedge_angle(angle, exterior):  # type: ignore[no-untyped-def]
    """Sine and cosine of an angle / 2 n, and of half of it, for `utd_terms`; n is the exterior angle / pi."""
    scaled = angle * 0.5 * math.pi / exterior
    return math.sin(scaled), math.cos(scaled), math.sin(0.5 * angle), math.cos(0.5 * angle)


def wedge_constants(exterior_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (W, 5) of wedges for `utd_terms`: sine and cosine of pi / 2 n and of n pi, and 1 / 2 n."""
    half = 0.5 * math.pi**2 / exterior_rad
    parts = np.sin(half), np.cos(half), np.sin(exterior_rad), np.cos(exterior_rad), half / math.pi
    return np.stack(parts, axis=1)


@njit(cache=True)
def utd_terms(wedge, arrival, departure, terms):  # type: ignore[no-untyped-def]
    """Prepare the four terms of the UTD coefficient of a wedge, cot(psi) F(k L a) / 2 n, for any L.

    Written are cot(psi) / 2 n, y = sqrt(a / 2), the sine of n times the angle from psi to the nearest pole of the
    cotangent, and 1 / y^2 (4, 3). Directions count from the 0-face; they are given by
    `wedge_angle`, and `wedge` by `wedge_constants`.
    """
    for k in range(4):
        sign, turn = -1.0 if k < 2 else 1.0, 1.0 if k % 2 == 0 else -1.0
        sine = departure[0] * arrival[1] + sign * departure[1] * arrival[0]
        cosine = departure[1] * arrival[1] - sign * departure[0] * arrival[0]
        half_sine = departure[2] * arrival[3] + sign * departure[3] * arrival[2]
        half = departure[3] * arrival[3] - sign * departure[2] * arrival[2]
        sine, cosine = wedge[0] * cosine + turn * wedge[1] * sine, wedge[1] * cosine - turn * wedge[0] * sine
        if cosine < 0.0:  # beyond pi / 2 the nearest pole is another
            half = half * wedge[3] + turn * (1.0 if k < 3 else -1.0) * half_sine * wedge[2]
        y = max(abs(half), 1e-9)
        cotangent = wedge[4] * cosine / sine if abs(sine) > 1e-9 else 0.5 * cosine / y
        terms[k, 0], terms[k, 1], terms[k, 2] = cotangent, y, 1.0 / (y * y)


@njit(cache=True)
def utd_term(transition, terms, k, boundary):  # type: ignore[no-untyped-def]
    """Return one of the terms of `utd_terms` for sqrt(2 k L)."""
    y = boundary * terms[k, 1]
    if y < _ASYMPTOTIC:
        at = int(y * _STEPS)
        return terms[k, 0] * y * (transition[at] + (y * _STEPS - at) * (transition[at + 1] - transition[at]))
    x = terms[k, 2] / (boundary * boundary)
    return complex(terms[k, 0] * (1.0 - 0.75 * x * x), terms[k, 0] * x * (0.5 - 1.875 * x * x))
