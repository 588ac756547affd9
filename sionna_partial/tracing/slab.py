"""Reflection off a slab, as Sionna RT has it (ITU-R P.2040-3, eq. 31, 37 and 38)."""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Floats
from sionna_partial.checks import require
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.scene.scene import constants_of
from sionna_partial.settings import Material

Polarisation = Literal["te", "tm"]
"""Electric field perpendicular to the plane of incidence ("te"), as of vertical antennas at walls, or in it ("tm")."""

MOST_LOSS_DB = 60.0
"""Loss of a wall from which on it counts as opaque [dB]."""

_ANGLES_DEG = np.arange(0.0, 61.0, 10.0)
"""Angles of incidence over which a wall is averaged: that at normal incidence alone has deep interference fringes."""

VACUUM_F_M = 8.8541878128e-12
"""Permittivity of the vacuum [F/m]."""


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


def reflection_coefficients(
    permittivity: ArrayLike, conductivity_s_m: ArrayLike, thickness_m: ArrayLike, frequency_hz: float, cosine: ArrayLike
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the reflection coefficients of a slab, TE and TM, at angles of incidence with these cosines."""
    loss = np.asarray(conductivity_s_m) / (2.0 * math.pi * frequency_hz * VACUUM_F_M)
    eta, cosine = np.asarray(permittivity) - 1j * loss, np.asarray(cosine)
    root = np.sqrt(eta - (1.0 - cosine**2))
    inside = np.exp(-4j * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * np.asarray(thickness_m) * root)
    faces = ((first - root) / (first + root) for first in (cosine, eta * cosine))
    te, tm = (face * (1.0 - inside) / (1.0 - face**2 * inside) for face in faces)
    return te, tm


def transmission_coefficients(
    permittivity: ArrayLike, conductivity_s_m: ArrayLike, thickness_m: ArrayLike, frequency_hz: float, cosine: ArrayLike
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the transmission coefficients of a slab, TE and TM, likewise."""
    loss = np.asarray(conductivity_s_m) / (2.0 * math.pi * frequency_hz * VACUUM_F_M)
    eta, cosine = np.asarray(permittivity) - 1j * loss, np.asarray(cosine)
    root = np.sqrt(eta - (1.0 - cosine**2))
    once = np.exp(-2j * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * np.asarray(thickness_m) * root)
    faces = ((first - root) / (first + root) for first in (cosine, eta * cosine))
    te, tm = ((1.0 - face**2) * once / (1.0 - face**2 * once**2) for face in faces)
    return te, tm


def wall_loss_db(material: Material, frequency_hz: float) -> float:
    """Return the mean loss [dB] of going through a wall at angles of incidence up to 60 degrees."""
    return _mean_loss_db(transmission_coefficients, material, frequency_hz)


def wall_reflection_db(material: Material, frequency_hz: float) -> float:
    """Return the mean loss [dB] of being reflected at a wall, likewise."""
    return _mean_loss_db(reflection_coefficients, material, frequency_hz)


def _mean_loss_db(
    coefficients: Callable[..., tuple[np.ndarray, np.ndarray]], material: Material, frequency_hz: float
) -> float:
    permittivity, conductivity_s_m = constants_of(material, frequency_hz)
    cosine = np.cos(np.radians(_ANGLES_DEG))
    te, _ = coefficients(permittivity, conductivity_s_m, material.thickness_m, frequency_hz, cosine)
    return float(np.mean(np.minimum(-20.0 * np.log10(np.maximum(np.abs(te), 1e-8)), MOST_LOSS_DB)))
