"""Reflection and transmission of slabs, as Sionna RT has them (ITU-R P.2040-3, eq. 31, 37 and 38), and their tables."""

import math
from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Floats
from sionna_partial.checks import require
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.process import njit
from sionna_partial.scene.scene import constants_of
from sionna_partial.settings import Material
from sionna_partial.tracing.interactions import REFLECTION, REFRACTION

Polarisation = Literal["te", "tm"]
"""Electric field perpendicular to the plane of incidence ("te"), as of vertical antennas at walls, or in it ("tm")."""

MOST_LOSS_DB = 60.0
"""Loss of a wall from which on it counts as opaque [dB]."""

_ANGLES_DEG = np.arange(0.0, 61.0, 10.0)
"""Angles of incidence over which a wall is averaged: that at normal incidence alone has deep interference fringes."""

VACUUM_F_M = 8.8541878128e-12
"""Permittivity of the vacuum [F/m]."""

COSINES = 2048
"""Steps of the tables over the cosine of the angle of incidence."""


def reflection_loss_db(
    permittivity: ArrayLike,
    conductivity_s_m: ArrayLike,
    thickness_m: ArrayLike,
    frequency_hz: float,
    angle_deg: ArrayLike,
    polarisation: Polarisation = "te",
) -> Floats:
    """Return the loss [dB] of a wave that is reflected off a slab, with all reflections inside it.

    All arrays are broadcast together; angles of incidence are from the normal, 0 to 90 degrees. The loss is at least 0
    and infinite where nothing is reflected. Another polarisation or angle raises a SettingsError.
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
    """Return the complex permittivity, the cosines as an array, and the index of refraction times those inside."""
    loss = np.asarray(conductivity_s_m) / (2.0 * math.pi * frequency_hz * VACUUM_F_M)
    eta, cosine = np.asarray(permittivity) - 1j * loss, np.asarray(cosine)
    return eta, cosine, np.sqrt(eta - (1.0 - cosine**2))


def reflection_coefficients(
    permittivity: ArrayLike, conductivity_s_m: ArrayLike, thickness_m: ArrayLike, frequency_hz: float, cosine: ArrayLike
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the reflection coefficients of a slab, TE and TM, at angles of incidence with these cosines."""
    eta, cosine, root = _refracted(permittivity, conductivity_s_m, frequency_hz, cosine)
    inside = np.exp(-4j * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * np.asarray(thickness_m) * root)
    faces = ((first - root) / (first + root) for first in (cosine, eta * cosine))
    te, tm = (face * (1.0 - inside) / (1.0 - face**2 * inside) for face in faces)
    return te, tm


def transmission_coefficients(
    permittivity: ArrayLike, conductivity_s_m: ArrayLike, thickness_m: ArrayLike, frequency_hz: float, cosine: ArrayLike
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the transmission coefficients of a slab, TE and TM, likewise."""
    eta, cosine, root = _refracted(permittivity, conductivity_s_m, frequency_hz, cosine)
    once = np.exp(-2j * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * np.asarray(thickness_m) * root)
    faces = ((first - root) / (first + root) for first in (cosine, eta * cosine))
    te, tm = ((1.0 - face**2) * once / (1.0 - face**2 * once**2) for face in faces)
    return te, tm


def wall_loss_db(material: Material, frequency_hz: float) -> float:
    """Return the mean loss [dB] of going through a wall at angles of incidence up to 60 degrees."""
    permittivity, conductivity_s_m = constants_of(material, frequency_hz)
    cosine = np.cos(np.radians(_ANGLES_DEG))
    te, _ = transmission_coefficients(permittivity, conductivity_s_m, material.thickness_m, frequency_hz, cosine)
    return float(np.mean(np.minimum(-20.0 * np.log10(np.maximum(np.abs(te), 1e-8)), MOST_LOSS_DB)))


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


@njit(cache=True)
def vertical_field(k):  # type: ignore[no-untyped-def]
    """Field of a vertical antenna in a direction: the unit vector along theta of spherical coordinates."""
    flat = max(np.hypot(k[0], k[1]), 1e-12)
    return complex(k[0] * k[2] / flat), complex(k[1] * k[2] / flat), complex(-flat)


@njit(cache=True)
def received_power(k, e):  # type: ignore[no-untyped-def]
    """Fraction of the power that a vertical antenna receives of a field that comes in a direction."""
    vertical = vertical_field(k)
    field = e[0] * vertical[0] + e[1] * vertical[1] + e[2] * vertical[2]
    return field.real**2 + field.imag**2


@njit(cache=True)
def at_slab(k, e, n, slabs, material, kind):  # type: ignore[no-untyped-def]
    """Direction and field of a path after a reflection at a slab with the unit normal `n`, or a refraction."""
    along = k[0] * n[0] + k[1] * n[1] + k[2] * n[2]
    at = min(abs(along), 1.0) * COSINES
    low = min(int(at), COSINES - 1)
    part = at - low
    sx, sy, sz = k[1] * n[2] - k[2] * n[1], k[2] * n[0] - k[0] * n[2], k[0] * n[1] - k[1] * n[0]
    norm = np.sqrt(sx * sx + sy * sy + sz * sz)
    if norm < 1e-9:
        sx, sy, sz = (-n[2], 0.0, n[0]) if abs(n[1]) < 0.5 else (0.0, n[2], -n[1])
        norm = np.sqrt(sx * sx + sy * sy + sz * sz)
    sx, sy, sz = sx / norm, sy / norm, sz / norm
    te = e[0] * sx + e[1] * sy + e[2] * sz
    px, py, pz = sy * k[2] - sz * k[1], sz * k[0] - sx * k[2], sx * k[1] - sy * k[0]
    tm = e[0] * px + e[1] * py + e[2] * pz
    table = slabs.transmission if kind == REFRACTION else slabs.reflection
    te *= table[material, low, 0] + part * (table[material, low + 1, 0] - table[material, low, 0])
    tm *= table[material, low, 1] + part * (table[material, low + 1, 1] - table[material, low, 1])
    if kind == REFLECTION:
        k = k[0] - 2.0 * along * n[0], k[1] - 2.0 * along * n[1], k[2] - 2.0 * along * n[2]
        px, py, pz = sy * k[2] - sz * k[1], sz * k[0] - sx * k[2], sx * k[1] - sy * k[0]
    return k, (te * sx + tm * px, te * sy + tm * py, te * sz + tm * pz)
