"""Antenna arrays of Sionna RT as NumPy arrays: positions, orientations, and patterns in the directions of paths."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from sionna_partial.arrays import Floats
from sionna_partial.checks import real_array, require, require_choice, require_whole
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.errors import SettingsError
from sionna_partial.tracing.engine import load_sionna, to_device
from sionna_partial.tracing.paths import zenith_azimuth

PATTERNS, POLARISATIONS = ("iso", "dipole", "hw_dipole", "tr38901"), ("V", "H", "VH", "cross")
"""Antenna patterns and polarisations that Sionna RT has."""


def planar_array(rows: int, columns: int, pattern: str = "iso", polarization: str = "V") -> Any:
    """Make a `sionna.rt.PlanarArray` whose antennas are half a wavelength apart."""
    require_choice("pattern", pattern, PATTERNS)
    require_choice("polarization", polarization, POLARISATIONS)
    for name, value in (("rows", rows), ("columns", columns)):
        require_whole(name, value, 1, 1024)
    return load_sionna().PlanarArray(num_rows=rows, num_cols=columns, pattern=pattern, polarization=polarization)


@dataclass(frozen=True)
class Antennas:
    """One antenna array, at every transmitter or at every receiver.

    Antennas are numbered as in Sionna RT: all positions (A, 3) [m] with the first of K patterns, then with the second.
    Rotations from the array to the world are (1, 3, 3), or one for each of E ends.
    """

    positions_m: Floats
    patterns: list[Any]
    rotation: Floats

    @classmethod
    def of(
        cls, side: str, array: Any, orientation_rad: ArrayLike | None, *, count: int, frequency_hz: float
    ) -> "Antennas":
        """Take a `sionna.rt.PlanarArray` (None: one isotropic, vertical antenna) for the `count` ends of a side."""
        rt = load_sionna()
        array = planar_array(1, 1) if array is None else array
        require(
            isinstance(array, rt.antenna_array.AntennaArray),
            f"{side}_array",
            array,
            "give a sionna.rt.PlanarArray, or None for one isotropic, vertically polarised antenna.",
        )
        name = f"{side}_orientation_rad"
        remedy = f"give three angles of rotation about z, y and x [rad], or (N, 3) for the {count} ends."
        angles = real_array(name, np.zeros(3) if orientation_rad is None else orientation_rad, SettingsError, remedy)
        require(angles.shape in ((3,), (count, 3)) and bool(np.isfinite(angles).all()), name, orientation_rad, remedy)
        wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz
        positions_m = wavelength_m * np.array(array.normalized_positions, dtype=np.float64).T
        rotation = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix()  # TR 38.901, eq. 7.1-4
        return cls(positions_m, array.antenna_pattern.patterns, rotation)

    def __len__(self) -> int:
        """Return the number of antennas, K A."""
        return len(self.patterns) * len(self.positions_m)

    def rotations(self, end: NDArray[np.integer[Any]]) -> Floats:
        """Rotation (P, 3, 3) at the end of each path (P,), or (1, 3, 3) if all are the same."""
        return self.rotation if len(self.rotation) == 1 else self.rotation[end]

    def advance_m(self, angles_rad: Floats, end: NDArray[np.integer[Any]]) -> Floats:
        """How much shorter plane waves from zenith and azimuth (P, 2) are at each antenna position: (P, A) [m]."""
        return self._local(directions(angles_rad)[0], end) @ self.positions_m.T

    def fields(self, angles_rad: Floats, end: NDArray[np.integer[Any]]) -> NDArray[np.complex128]:
        """Patterns (P, K, 2) along the world's theta and phi, in directions of zenith and azimuth (P, 2)."""
        toward, theta, phi = directions(angles_rad)
        local_rad = zenith_azimuth(self._local(toward, end))
        local_theta = np.einsum("pij,pj->pi", self.rotations(end), directions(local_rad)[1])
        cosine, sine = np.sum(theta * local_theta, axis=1), np.sum(phi * local_theta, axis=1)
        found = [_evaluated(pattern, local_rad) for pattern in self.patterns]
        return np.stack([np.stack([cosine * t - sine * p, sine * t + cosine * p], axis=1) for t, p in found], axis=1)

    def _local(self, vectors: Floats, end: NDArray[np.integer[Any]]) -> Floats:
        """Vectors (P, 3) of the world in the coordinates of the array."""
        if len(self.rotation) == 1:
            return vectors @ self.rotation[0]
        return np.einsum("pji,pj->pi", self.rotation[end], vectors)


def _evaluated(pattern: Any, local_rad: Floats) -> list[NDArray[np.complex128]]:
    """Zenith and azimuth component (P,) of a pattern, which Sionna RT evaluates."""
    import mitsuba as mi

    if not len(local_rad):  # Dr.Jit would abort
        return [np.zeros(0, np.complex128)] * 2
    angles = (to_device(mi.Float, column.astype(np.float32)) for column in local_rad.T)
    return [np.zeros(len(local_rad)) + (part.real.numpy() + 1j * part.imag.numpy()) for part in pattern(*angles)]


def directions(angles_rad: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the unit vectors r, theta and phi (P, 3) of zenith and azimuth angles (P, 2)."""
    (sin_t, sin_p), (cos_t, cos_p) = np.sin(angles_rad).T, np.cos(angles_rad).T
    return (
        np.stack([sin_t * cos_p, sin_t * sin_p, cos_t], axis=1),
        np.stack([cos_t * cos_p, cos_t * sin_p, -sin_t], axis=1),
        np.stack([-sin_p, cos_p, np.zeros_like(sin_p)], axis=1),
    )
