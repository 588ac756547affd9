"""Reflection off a slab, as Sionna RT has it (ITU-R P.2040-3, eq. 31, 37 and 38)."""

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.settings import require

Polarisation = Literal["te", "tm"]
"""Electric field across the plane of incidence ("te"), as that of vertical antennas at walls, or in it ("tm")."""

VACUUM_F_M = 8.8541878128e-12
"""Permittivity of the vacuum [F/m]."""


def reflection_loss_db(
    permittivity: ArrayLike,
    conductivity_s_m: ArrayLike,
    thickness_m: ArrayLike,
    frequency_hz: float,
    angle_deg: ArrayLike,
    polarisation: Polarisation = "te",
) -> NDArray[np.float64]:
    """Loss of a wave that is reflected off a slab, with all reflections inside it.

    Parameters
    ----------
    permittivity, conductivity_s_m, thickness_m : array-like
        Real relative permittivity, conductivity [S/m] and thickness [m].
    frequency_hz : float
        Carrier frequency [Hz].
    angle_deg : array-like
        Angle of incidence from the normal, 0 to 90 [degrees]. All arrays are broadcast together.
    polarisation : {"te", "tm"}

    Returns
    -------
    float64 array
        At least 0 [dB]; infinite where nothing is reflected.

    Raises
    ------
    SettingsError
        For another polarisation, or an angle out of range.
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
    permittivity: ArrayLike,
    conductivity_s_m: ArrayLike,
    thickness_m: ArrayLike,
    frequency_hz: float,
    cosine: ArrayLike,
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the reflection coefficients of a slab, TE and TM (arguments as above, with the cosine of the angle)."""
    loss = np.asarray(conductivity_s_m) / (2.0 * math.pi * frequency_hz * VACUUM_F_M)
    eta, cosine = np.asarray(permittivity) - 1j * loss, np.asarray(cosine)
    root = np.sqrt(eta - (1.0 - cosine**2))
    inside = np.exp(-4j * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * np.asarray(thickness_m) * root)
    faces = ((first - root) / (first + root) for first in (cosine, eta * cosine))
    te, tm = (face * (1.0 - inside) / (1.0 - face**2 * inside) for face in faces)
    return te, tm
