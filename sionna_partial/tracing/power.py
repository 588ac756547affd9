"""Power of paths by their geometry, before Sionna RT verifies them: slabs, edges and bounds of docs/physics.md."""

import math
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fresnel

from sionna_partial.arrays import Floats
from sionna_partial.checks import require
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.process import njit
from sionna_partial.scene.scene import constants_of
from sionna_partial.settings import Material
from sionna_partial.tracing.interactions import REFLECTION, REFRACTION

Polarisation = Literal["te", "tm"]
"""Electric field perpendicular to the plane of incidence ("te", as of vertical antennas at walls) or in it ("tm")."""

MOST_LOSS_DB = 60.0
"""Loss from which a wall counts as opaque [dB]."""

_ANGLES_DEG = np.arange(0.0, 61.0, 10.0)
"""Angles of incidence for the mean loss: at one angle, interference fringes are deep."""

VACUUM_F_M = 8.8541878128e-12
"""Permittivity of the vacuum [F/m]."""

COSINES = 2048
"""Steps of the tables over the cosine of incidence."""

_ANGLES, _MARGIN = 1024, 1.01
"""Steps of the table of largest coefficients, and factor that enlarges them."""

_CANCELLED, _ROUGH = 0.02, 0.05
"""Error of a sum of diffraction terms, in single precision and in a rough bound, relative to the sum of magnitudes."""

EXPECTED = 0.5
"""Expected power of unlisted paths, relative to their rough bounds."""

_STEPS, _ASYMPTOTIC = 128, 3.0
"""Entries of the table of the UTD transition function per unit, and the start of its asymptotic series."""


def reflection_loss_db(
    permittivity: ArrayLike,
    conductivity_s_m: ArrayLike,
    thickness_m: ArrayLike,
    frequency_hz: float,
    angle_deg: ArrayLike,
    polarisation: Polarisation = "te",
) -> Floats:
    """Return the reflection loss [dB] of a slab, internal reflections included; infinite if nothing is reflected.

    Arrays are broadcast; angles are from the normal, 0 to 90 degrees. Another angle or polarisation raises a
    SettingsError.
    """
    require(polarisation in ("te", "tm"), "polarisation", polarisation, "choose 'te' or 'tm'.")
    angle = np.asarray(angle_deg, dtype=np.float64)
    require(bool(np.all((angle >= 0.0) & (angle <= 90.0))), "angle_deg", angle_deg, "give degrees from 0 to 90.")
    te, tm = reflection_coefficients(
        permittivity, conductivity_s_m, thickness_m, frequency_hz, np.cos(np.radians(angle))
    )
    with np.errstate(divide="ignore"):
        return -20.0 * np.log10(np.abs(te if polarisation == "te" else tm))


def _refracted(
    permittivity: ArrayLike, conductivity_s_m: ArrayLike, frequency_hz: float, cosine: ArrayLike
) -> tuple[NDArray[np.complex128], Floats, NDArray[np.complex128]]:
    loss = np.asarray(conductivity_s_m) / (2.0 * math.pi * frequency_hz * VACUUM_F_M)
    eta, cosine = np.asarray(permittivity) - 1j * loss, np.asarray(cosine)
    return eta, cosine, np.sqrt(eta - (1.0 - cosine**2))


def reflection_coefficients(
    permittivity: ArrayLike, conductivity_s_m: ArrayLike, thickness_m: ArrayLike, frequency_hz: float, cosine: ArrayLike
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the TE and TM coefficients of a slab by the cosine of incidence."""
    eta, cosine, root = _refracted(permittivity, conductivity_s_m, frequency_hz, cosine)
    inside = np.exp(-4j * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * np.asarray(thickness_m) * root)
    faces = ((first - root) / (first + root) for first in (cosine, eta * cosine))
    te, tm = (face * (1.0 - inside) / (1.0 - face**2 * inside) for face in faces)
    return te, tm


def transmission_coefficients(
    permittivity: ArrayLike, conductivity_s_m: ArrayLike, thickness_m: ArrayLike, frequency_hz: float, cosine: ArrayLike
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    eta, cosine, root = _refracted(permittivity, conductivity_s_m, frequency_hz, cosine)
    once = np.exp(-2j * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * np.asarray(thickness_m) * root)
    faces = ((first - root) / (first + root) for first in (cosine, eta * cosine))
    te, tm = ((1.0 - face**2) * once / (1.0 - face**2 * once**2) for face in faces)
    return te, tm


def wall_loss_db(material: Material, frequency_hz: float) -> float:
    """Return the transmission loss [dB] of a wall, averaged over angles of incidence up to 60 degrees."""
    return mean_loss_db(*constants_of(material, frequency_hz), material.thickness_m, frequency_hz)


def mean_loss_db(permittivity: float, conductivity_s_m: float, thickness_m: float, frequency_hz: float) -> float:
    """Return the loss of `wall_loss_db` for a slab [dB]."""
    cosine = np.cos(np.radians(_ANGLES_DEG))
    te, _ = transmission_coefficients(permittivity, conductivity_s_m, thickness_m, frequency_hz, cosine)
    return float(np.mean(np.minimum(-20.0 * np.log10(np.maximum(np.abs(te), 1e-8)), MOST_LOSS_DB)))


class Materials(NamedTuple):
    """Coefficients of M slabs, TE and TM, and of edges.

    `reflection` and `transmission` (M, K + 1, 2) are by k / K, the cosine of incidence. `most_reflected` (M, K + 1) is
    the largest |R|^2 at this cosine or a larger one, `most_transmitted` the largest |T|^2 at this cosine or a smaller
    one. `largest` (M, L, 4) are the largest |TE|, |TM| and |TE + TM| reflected at cosines from l / L to (l + 1) / L,
    and the largest of the first two from l / L on. `transition` is F(y^2) / y of the UTD transition function F.
    """

    wavelength_m: float
    reflection: NDArray[np.complex128]
    transmission: NDArray[np.complex128]
    most_reflected: Floats
    most_transmitted: Floats
    largest: Floats
    transition: NDArray[np.complex128]


class Gains(NamedTuple):
    """Upper bounds of the gain of the transmit antenna.

    `table` (181, 360) is by degrees of zenith and azimuth, (1, 1) if isotropic; `by_azimuth` (360,) is the largest of
    any zenith.
    """

    table: NDArray[np.float64]
    by_azimuth: NDArray[np.float64]
    largest: float


ISOTROPIC = Gains(np.ones((1, 1)), np.ones(1), 1.0)


@njit(cache=True, borrows=True)
def gain_towards(gains, x, y, z):
    if len(gains.table) == 1:
        return 1.0
    zenith, azimuth = math.degrees(math.atan2(math.hypot(x, y), z)), math.degrees(math.atan2(y, x))
    return gains.table[int(zenith + 0.5), int(azimuth + 360.5) % 360]


@njit(cache=True, borrows=True)
def gain_at_azimuth(gains, x, y):
    if len(gains.by_azimuth) == 1:
        return 1.0
    return gains.by_azimuth[int(math.degrees(math.atan2(y, x)) + 360.5) % 360]


@njit(cache=True, borrows=True)
def gain_between(by_azimuth, first_deg, second_deg):
    """Return the largest gain between two azimuths, counterclockwise."""
    if len(by_azimuth) == 1:
        return by_azimuth[0]
    turn_deg, most = (second_deg - first_deg) % 360.0, 0.0
    for step in range(int(turn_deg) + 2):
        most = max(most, by_azimuth[int(first_deg + min(step, turn_deg) + 720.5) % 360])
    return most


def materials_of(constants: Iterable[ArrayLike], frequency_hz: float) -> Materials:
    """Tabulate the coefficients of materials, each (permittivity, conductivity, thickness)."""
    given = np.array(list(constants), dtype=np.float64).reshape(-1, 3)

    def tabulated(coefficients: Any, steps: int) -> NDArray[np.complex128]:
        cosine = np.linspace(0.0, 1.0, steps + 1)
        tables = [np.stack(coefficients(*own, frequency_hz, cosine), axis=1) for own in given]
        return np.reshape(tables, (-1, steps + 1, 2)).astype(np.complex128)

    reflection, transmission = (
        tabulated(reflection_coefficients, COSINES),
        tabulated(transmission_coefficients, COSINES),
    )
    reflection[:, 0], transmission[:, 0] = -1.0, 0.0
    reflected, transmitted = (np.max(np.abs(table) ** 2, axis=2) for table in (reflection, transmission))
    most_reflected = np.maximum.accumulate(reflected[:, ::-1], axis=1)[:, ::-1].copy()
    most_transmitted = np.maximum.accumulate(transmitted, axis=1)
    fine = tabulated(reflection_coefficients, 8 * _ANGLES)
    sizes = np.abs(np.concatenate([fine, fine.sum(axis=2, keepdims=True)], axis=2))
    ends = np.maximum(sizes[:, :-1], sizes[:, 1:]).reshape(len(given), _ANGLES, 8, 3).max(axis=2)
    beyond = np.maximum.accumulate(ends[:, ::-1, :2].max(axis=2), axis=1)[:, ::-1, None]
    largest = np.minimum(_MARGIN * np.concatenate([ends, beyond], axis=2), [1.0, 1.0, 2.0, 1.0])
    wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz
    slabs = reflection, transmission, most_reflected, most_transmitted, largest
    return Materials(wavelength_m, *slabs, _transition_table())


def _transition_table() -> NDArray[np.complex128]:
    """Return F(y^2) / y (Kouyoumjian and Pathak 1974) for y = k / _STEPS."""
    y = np.arange(_STEPS * _ASYMPTOTIC + 2) / _STEPS
    sine, cosine = fresnel(math.sqrt(2.0 / math.pi) * y)
    table: NDArray[np.complex128] = np.exp(1j * y**2) * (1.0 + 1j - 2j * (cosine - 1j * sine))
    return math.sqrt(0.5 * math.pi) * table


@njit(cache=True, borrows=True)
def reflected_power(largest, cosine):
    """Return the largest fraction of power reflected, for any material and polarisation."""
    at = min(int(abs(cosine) * _ANGLES), _ANGLES - 1)
    return max(largest[at, 0], largest[at, 1]) ** 2


@njit(cache=True, borrows=True)
def power_near(table, material, cosine):
    at = min(int(cosine * COSINES + 0.5), COSINES)
    te, tm = table[material, at, 0], table[material, at, 1]
    return max(te.real**2 + te.imag**2, tm.real**2 + tm.imag**2)


@njit(cache=True, borrows=True)
def _coefficients(table, material, cosine):
    at = cosine * COSINES
    low = min(int(at), COSINES - 1)
    part, te, tm = at - low, table[material, low, 0], table[material, low, 1]
    return te + part * (table[material, low + 1, 0] - te), tm + part * (table[material, low + 1, 1] - tm)


class Field(NamedTuple):
    """Bounds of a field at a path: its vertical and horizontal parts, and the vertical part that is never turned."""

    vertical: float
    horizontal: float
    pure: float


VERTICAL = Field(1.0, 0.0, 1.0)


@njit(cache=True, borrows=True)
def most_at_wall(largest, material, cosine):
    return largest[material, min(int(abs(cosine) * _ANGLES), _ANGLES - 1), 3]


@njit(cache=True, borrows=True)
def _mixed(field, kept, mixed, other):
    vertical, horizontal = (
        kept * field.vertical + mixed * field.horizontal,
        mixed * field.vertical + other * field.horizontal,
    )
    return Field(vertical, horizontal, kept * field.pure)


@njit(cache=True, borrows=True)
def at_wall(largest, material, cosine, sine, slope, field):
    """Return the bounds of a reflected field.

    `cosine` is for incidence seen from above; `sine` and `slope` are the horizontal and vertical part of the direction.
    """
    cosine = min(abs(cosine), 1.0)
    at = min(int(cosine * sine * _ANGLES), _ANGLES - 1)
    te, tm, both = largest[material, at, 0], largest[material, at, 1], largest[material, at, 2]
    part = _te_part(1.0 - cosine * cosine, sine, slope)
    kept, mixed, other = te * part + tm * (1.0 - part), both * math.sqrt(part * (1.0 - part)), te + (tm - te) * part
    return _mixed(field, kept, mixed, other)


@njit(cache=True, borrows=True)
def at_edge(tables, material, terms, boundary, cosines, sine, slope, field):
    """Return bounds of a diffracted field as `at_wall` does, without the spread of the wave.

    `tables` are `reflection` and `transition`, `boundary` is sqrt(2 k L), `cosines` are for incidence at both faces.
    """
    (faces, transition), (cosine_0, cosine_n) = tables, cosines
    by_0 = utd_term(transition, terms, 0, boundary) - utd_term(transition, terms, 3, boundary)
    by_n = utd_term(transition, terms, 1, boundary) - utd_term(transition, terms, 2, boundary)
    size_0, size_n = _size(by_0), _size(by_n)
    own_0, mixed_0, other_0 = at_face(faces, material, cosine_0, sine, slope)
    own_n, mixed_n, other_n = at_face(faces, material, cosine_n, sine, slope)
    kept = _size(own_0 * by_0 + own_n * by_n) + _CANCELLED * (_size(own_0) * size_0 + _size(own_n) * size_n)
    mixed, other = mixed_0 * size_0 + mixed_n * size_n, other_0 * size_0 + other_n * size_n
    return _mixed(field, kept, mixed, other)


@njit(cache=True, borrows=True)
def most_at_edge(terms, boundary, face_0, face_n):
    """Return a rough bound of a field diffracted in the plan, from the coefficients of both faces as of `at_face`."""
    by_0, near_0, sum_0 = _rough_terms(terms, 0, 3, boundary)
    by_n, near_n, sum_n = _rough_terms(terms, 1, 2, boundary)
    if near_0 or near_n:
        return _size(face_0) * abs(by_0) + _size(face_n) * abs(by_n)
    return _size(face_0 * by_0 + face_n * by_n) + _ROUGH * (_size(face_0) * sum_0 + _size(face_n) * sum_n)


@njit(cache=True, borrows=True)
def _rough_terms(terms, k, other, boundary):
    """Return the difference of two terms without phases, whether a shadow boundary is near, and their sum."""
    first, second = terms[k, 0], terms[other, 0]
    here, there = boundary * terms[k, 1], boundary * terms[other, 1]
    size = abs(first) + abs(second)
    if min(here, there) > 2.0 * _ASYMPTOTIC:
        return first - second, False, size
    return abs(first) * min(1.0, 2.0 * here) + abs(second) * min(1.0, 2.0 * there), True, size


@njit(cache=True, borrows=True)
def at_flats(largest, material, slope, bounces, field):
    """Return a bound of a vertical field after reflections off floor and ceiling."""
    at = min(int(slope * _ANGLES), _ANGLES - 1)
    te, tm = largest[material, at, 0], largest[material, at, 1]
    return tm**bounces * field.pure + max(te, tm) ** bounces * (field.vertical - field.pure)


@njit(cache=True, borrows=True)
def _te_part(along, sine, slope):
    """Return the TE fraction of a vertical field's power at a wall.

    `along` is the squared cosine of the angle between path and wall, seen from above (docs/physics.md, Jones vector).
    """
    return min(along / (slope * slope + sine * sine * along), 1.0) if slope * slope > 1e-12 else 1.0


@njit(cache=True, borrows=True)
def at_face(faces, material, cosine, sine, slope):
    """Return the coefficient of a vertical field at a face of a wedge, and magnitudes of the others.

    To Sionna RT, a face in the shadow (negative cosine) is a perfect mirror.
    """
    if cosine < 0.0:
        return 1.0 + 0.0j, 0.0, 1.0
    te, tm = _coefficients(faces, material, cosine * sine)
    if slope < 1e-6:
        return te, 0.0, 0.0
    part = _te_part(1.0 - cosine * cosine, sine, slope)
    mixed = _size(te + tm) * math.sqrt(part * (1.0 - part))
    return part * te - (1.0 - part) * tm, mixed, (1.0 - part) * _size(te) + part * _size(tm)


@njit(cache=True, borrows=True)
def _size(number):
    """Return the magnitude of a complex number; `abs` guards against overflow and is slower."""
    return math.sqrt(number.real * number.real + number.imag * number.imag)


@njit(cache=True, borrows=True)
def wedge_angle(angle, exterior):
    """Return sine and cosine of an angle / 2 n, and of half of it; n is the exterior angle / pi."""
    scaled = angle * 0.5 * math.pi / exterior
    return math.sin(scaled), math.cos(scaled), math.sin(0.5 * angle), math.cos(0.5 * angle)


def wedge_constants(exterior_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (W, 5): sine and cosine of pi / 2 n and of n pi, and 1 / 2 n."""
    half = 0.5 * math.pi**2 / exterior_rad
    parts = np.sin(half), np.cos(half), np.sin(exterior_rad), np.cos(exterior_rad), half / math.pi
    return np.stack(parts, axis=1)


@njit(cache=True, borrows=True)
def utd_terms(wedge, arrival, departure, terms):
    """Prepare the four terms cot(psi) F(k L a) / 2 n of a wedge for any L (docs/physics.md, Wedge).

    `wedge` is from `wedge_constants`, directions from the 0-face from `wedge_angle`. `terms` (4, 3) receives cot(psi) /
    2 n, with y = sqrt(a / 2) the sine of n times the angle from psi to the nearest pole of the cotangent, and 1 / y^2.
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


@njit(cache=True, borrows=True)
def utd_term(transition, terms, k, boundary):
    y = boundary * terms[k, 1]
    if y < _ASYMPTOTIC:
        at = int(y * _STEPS)
        return terms[k, 0] * y * (transition[at] + (y * _STEPS - at) * (transition[at + 1] - transition[at]))
    x = terms[k, 2] / (boundary * boundary)
    return complex(terms[k, 0] * (1.0 - 0.75 * x * x), terms[k, 0] * x * (0.5 - 1.875 * x * x))


@njit(cache=True, borrows=True)
def vertical_field(k):
    """Return the unit vector along theta of spherical coordinates."""
    flat = max(np.hypot(k[0], k[1]), 1e-12)
    return complex(k[0] * k[2] / flat), complex(k[1] * k[2] / flat), complex(-flat)


@njit(cache=True, borrows=True)
def received_power(k, e):
    vertical = vertical_field(k)
    field = e[0] * vertical[0] + e[1] * vertical[1] + e[2] * vertical[2]
    return field.real**2 + field.imag**2


@njit(cache=True, borrows=True)
def at_slab(k, e, n, materials, material, kind):
    """Return direction and field after a reflection at a slab with unit normal `n`, or a refraction."""
    along = k[0] * n[0] + k[1] * n[1] + k[2] * n[2]
    sx, sy, sz = k[1] * n[2] - k[2] * n[1], k[2] * n[0] - k[0] * n[2], k[0] * n[1] - k[1] * n[0]
    norm = np.sqrt(sx * sx + sy * sy + sz * sz)
    if norm < 1e-9:
        sx, sy, sz = (-n[2], 0.0, n[0]) if abs(n[1]) < 0.5 else (0.0, n[2], -n[1])
        norm = np.sqrt(sx * sx + sy * sy + sz * sz)
    sx, sy, sz = sx / norm, sy / norm, sz / norm
    te = e[0] * sx + e[1] * sy + e[2] * sz
    px, py, pz = sy * k[2] - sz * k[1], sz * k[0] - sx * k[2], sx * k[1] - sy * k[0]
    tm = e[0] * px + e[1] * py + e[2] * pz
    table = materials.transmission if kind == REFRACTION else materials.reflection
    of_te, of_tm = _coefficients(table, material, min(abs(along), 1.0))
    te, tm = te * of_te, tm * of_tm
    if kind == REFLECTION:
        k = k[0] - 2.0 * along * n[0], k[1] - 2.0 * along * n[1], k[2] - 2.0 * along * n[2]
        px, py, pz = sy * k[2] - sz * k[1], sz * k[0] - sx * k[2], sx * k[1] - sy * k[0]
    return k, (te * sx + tm * px, te * sy + tm * py, te * sz + tm * pz)
