"""Antennas: patterns, Sionna RT's arrays as NumPy arrays, and the transmit antenna of a map."""

import logging
import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from sionna_partial.arrays import Floats, read_only
from sionna_partial.checks import (
    Checked,
    Within,
    float_array,
    require,
    require_choice,
    require_number,
    require_type,
    require_whole,
)
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.display import Shown
from sionna_partial.errors import SettingsError
from sionna_partial.llvm import load_sionna
from sionna_partial.tracing.engine import to_device
from sionna_partial.tracing.paths import SolvedPaths, zenith_azimuth
from sionna_partial.tracing.power import ISOTROPIC, Gains

PATTERNS, POLARISATIONS = ("iso", "dipole", "hw_dipole", "tr38901"), ("V", "H", "VH", "cross")
"""Antenna patterns and polarisations of Sionna RT."""

MAX_ANTENNAS = 4096
"""Largest number of antennas of a codebook."""

MAX_GAIN_DBI, MAX_LOSS_DB = 60.0, 200.0
"""Largest gain of a pattern [dBi], and largest loss relative to it [dB]."""

MAX_RADIATED, NOTED_RADIATED = 2.0, 1.25
"""Radiated fraction of the fed power above which patterns are refused, and logged: two cuts give it to 2 dB only."""

FREQUENCY_RATIO = 1.3
"""Ratio of frequencies from which the pattern of an antenna differs."""

_PHASES_AT_ONCE = 2_000_000

_log = logging.getLogger(__name__)


def planar_array(rows: int, columns: int, pattern: str = "iso", polarization: str = "V") -> Any:
    """Make a `sionna.rt.PlanarArray` whose antennas are half a wavelength apart."""
    require_choice("pattern", pattern, PATTERNS)
    require_choice("polarization", polarization, POLARISATIONS)
    for name, value in (("rows", rows), ("columns", columns)):
        require_whole(name, value, 1, 1024)
    return load_sionna().PlanarArray(num_rows=rows, num_cols=columns, pattern=pattern, polarization=polarization)


def dft_codebook(rows: int, columns: int, polarisations: int = 1) -> NDArray[np.complex128]:
    """Return the orthogonal beams of a planar array as weights of its antennas.

    Parameters
    ----------
    rows, columns : int
        Size of the `sionna.rt.PlanarArray`, whose antennas are numbered column by column.
    polarisations : int
        2 for a dual-polarised array: beams of the first polarisation come first.

    Returns
    -------
    (polarisations * rows * columns, polarisations * rows * columns) complex128 array
        One beam of unit power in each row.

    Raises
    ------
    SettingsError
        For numbers out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.channels.dft_codebook(8, 8).shape
    (64, 64)
    """
    for name, value in (("rows", rows), ("columns", columns)):
        require_whole(name, value, 1, MAX_ANTENNAS)
    require_whole("polarisations", polarisations, 1, 2)
    count = polarisations * rows * columns
    require(count <= MAX_ANTENNAS, "rows, columns", (rows, columns), f"give {MAX_ANTENNAS} antennas at most.")
    vertical, horizontal = (np.fft.fft(np.eye(size)) / np.sqrt(size) for size in (rows, columns))
    return np.kron(np.eye(polarisations), np.kron(horizontal, vertical)).astype(np.complex128)


@dataclass(frozen=True)
class Antennas:
    """Antenna array at every transmitter or at every receiver.

    As in Sionna RT, all positions (A, 3) [m] with the first of K patterns come first. Rotations from array to world are
    (1, 3, 3), or (E, 3, 3) for E ends.
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
        angles = float_array(name, np.zeros(3) if orientation_rad is None else orientation_rad, SettingsError, remedy)
        require(angles.shape in ((3,), (count, 3)) and bool(np.isfinite(angles).all()), name, orientation_rad, remedy)
        wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz
        positions_m = wavelength_m * np.array(array.normalized_positions, dtype=np.float64).T
        rotation = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix()  # TR 38.901, eq. 7.1-4
        return cls(positions_m, array.antenna_pattern.patterns, rotation)

    def __len__(self) -> int:
        return len(self.patterns) * len(self.positions_m)

    @property
    def of_each_antenna_m(self) -> Floats:
        """Positions [m] of each antenna, all of the first polarisation first."""
        return np.tile(self.positions_m, (len(self.patterns), 1))

    def rotations(self, end: NDArray[np.integer[Any]]) -> Floats:
        """Return (P, 3, 3) for the ends (P,) of paths, or (1, 3, 3) if all are the same."""
        return self.rotation if len(self.rotation) == 1 else self.rotation[end]

    def advance_m(self, angles_rad: Floats, end: NDArray[np.integer[Any]]) -> Floats:
        """Return the path advance (P, A) [m] of plane waves from zenith and azimuth (P, 2) at each antenna."""
        return self._local(directions(angles_rad)[0], end) @ self.positions_m.T

    def fields(self, angles_rad: Floats, end: NDArray[np.integer[Any]]) -> NDArray[np.complex128]:
        """Return the patterns (P, K, 2) along the world's theta and phi, for zenith and azimuth (P, 2)."""
        toward, theta, phi = directions(angles_rad)
        local_rad = zenith_azimuth(self._local(toward, end))
        local_theta = np.einsum("pij,pj->pi", self.rotations(end), directions(local_rad)[1])
        cosine, sine = np.sum(theta * local_theta, axis=1), np.sum(phi * local_theta, axis=1)
        found = [_evaluated(pattern, local_rad) for pattern in self.patterns]
        return np.stack([np.stack([cosine * t - sine * p, sine * t + cosine * p], axis=1) for t, p in found], axis=1)

    def _local(self, vectors: Floats, end: NDArray[np.integer[Any]]) -> Floats:
        if len(self.rotation) == 1:
            return vectors @ self.rotation[0]
        return np.einsum("pji,pj->pi", self.rotation[end], vectors)


@read_only
@dataclass(frozen=True, eq=False)
class AntennaPattern(Shown):
    """Power pattern of an antenna from its horizontal and vertical cut, vertically polarised.

    The loss in a direction is the sum of both cuts, at most the largest of them (3GPP TR 38.901, table 7.3-1).

    Parameters
    ----------
    name : str
    gain_dbi : float
        Gain in the main direction [dBi].
    horizontal_db, vertical_db : (360,) array-like
        Loss relative to it at 0, 1, ... 359 degrees [dB]: counterclockwise from the main direction seen from
        above, and downwards from the horizon.
    frequency_hz : float, optional
        Frequency of the measurement; traces that differ by a factor above 1.3 log a warning.

    Raises
    ------
    SettingsError
        For a gain above 60 dBi, cuts of another shape or outside 0 to 200 dB, or more than twice the fed power
        radiated. A uniform gain above 0 dBi is an amplifier and logs a warning.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sector = sp.AntennaPattern.sector(gain_dbi=15.0, horizontal_beamwidth_deg=65.0, vertical_beamwidth_deg=10.0)
    >>> float(sector.horizontal_db[65 // 2].round(1)), float(sector.horizontal_db[180])
    (2.9, 30.0)
    """

    name: str
    gain_dbi: float
    horizontal_db: Floats
    vertical_db: Floats
    frequency_hz: float | None = None

    def __post_init__(self) -> None:
        named = isinstance(self.name, str) and 0 < len(self.name) <= 100 and self.name.isprintable()
        require(named, "name", self.name, "give up to 100 printable characters.")
        require_number("gain_dbi", self.gain_dbi, -MAX_GAIN_DBI, MAX_GAIN_DBI)
        for name in ("horizontal_db", "vertical_db"):
            remedy = f"give 360 losses below the largest gain, 0 to {MAX_LOSS_DB:g} dB."
            values = float_array(name, getattr(self, name), SettingsError, remedy)
            require(values.shape == (360,), name, f"array of shape {values.shape}", remedy)
            good = (values >= 0.0) & (values <= MAX_LOSS_DB)
            require(bool(good.all()), name, values[~good][:1], remedy)
            object.__setattr__(self, name, values)
        if self.frequency_hz is not None:
            require_number("frequency_hz", self.frequency_hz, 0.0, 1e12, open_low=True)
        if self.uniform_gain_dbi is None:
            self._require_passive()
            fault = f"it radiates {self.radiated:.2f} times the power that it is fed: its gain or cuts are too large"
        else:
            fault = f"a gain of {self.gain_dbi:g} dBi in all directions is no antenna, unless it has an amplifier"
        if self.radiated > NOTED_RADIATED:
            _log.warning("antenna %r: %s", self.name, fault)

    def _require_passive(self) -> "AntennaPattern":
        radiated = self.radiated
        most_dbi = self.gain_dbi - 10.0 * math.log10(radiated)
        remedy = (
            f"antenna {self.name!r} with these cuts would radiate {radiated:.3g} times the power that it is fed: give "
            f"narrower cuts, or at most {most_dbi:z.1f} dBi."
        )
        require(radiated <= MAX_RADIATED, "gain_dbi", self.gain_dbi, remedy)
        return self

    @cached_property
    def radiated(self) -> float:
        """Radiated fraction of the fed power."""
        angles_rad, weights = _sphere()
        return float(weights @ np.abs(self.amplitude(angles_rad)) ** 2)

    @classmethod
    def sector(
        cls,
        gain_dbi: float = 8.0,
        horizontal_beamwidth_deg: float = 65.0,
        vertical_beamwidth_deg: float = 65.0,
        front_to_back_db: float = 30.0,
    ) -> "AntennaPattern":
        """Return the pattern of 3GPP TR 38.901, table 7.3-1, with its values as defaults.

        Raises
        ------
        SettingsError
            For values out of range, or a gain that the beamwidths do not allow.
        """
        require_number("front_to_back_db", front_to_back_db, 0.0, MAX_LOSS_DB)
        angle_deg, cuts = (np.arange(360.0) + 180.0) % 360.0 - 180.0, []
        widths = {
            "horizontal_beamwidth_deg": horizontal_beamwidth_deg,
            "vertical_beamwidth_deg": vertical_beamwidth_deg,
        }
        for name, width_deg in widths.items():
            require_number(name, width_deg, 0.0, 360.0, open_low=True)
            cuts.append(np.minimum(12.0 * (angle_deg / width_deg) ** 2, front_to_back_db))
        name = f"sector of {horizontal_beamwidth_deg:g} x {vertical_beamwidth_deg:g} deg"
        return cls(name, gain_dbi, cuts[0], cuts[1])._require_passive()

    @property
    def uniform_gain_dbi(self) -> float | None:
        """Gain if it is the same in all directions [dBi], otherwise None."""
        cuts = self.horizontal_db, self.vertical_db
        return None if any(np.ptp(cut) for cut in cuts) else self.gain_dbi - max(float(cut[0]) for cut in cuts)

    def amplitude(self, local_rad: Floats) -> NDArray[np.complex128]:
        """Return the square root (P,) of the gain towards zenith and azimuth (P, 2)."""
        down_deg, left_deg = np.degrees(local_rad[:, 0]) - 90.0, np.degrees(local_rad[:, 1])
        cuts = ((left_deg, self.horizontal_db), (down_deg, self.vertical_db))
        loss_db = sum(np.interp(angle_deg, np.arange(360), cut, period=360.0) for angle_deg, cut in cuts)
        largest_db = max(cut.max() for _, cut in cuts)
        return np.asarray(10.0 ** ((self.gain_dbi - np.minimum(loss_db, largest_db)) / 20.0), np.complex128)


@dataclass(frozen=True)
class Antenna(Checked):
    """Antenna of a transmitter: a pattern, or a planar array of it with a beam, and its direction.

    Parameters
    ----------
    pattern : {"iso", "dipole", "hw_dipole", "tr38901"} or AntennaPattern
        A pattern of Sionna RT, from `AntennaPattern.sector`, or from `load_antenna`.
    azimuth_deg : float
        Counterclockwise from x, seen from above [degree].
    downtilt_deg : float
        Below the horizon; negative for an elevation [degree].
    rows, columns : int
        Numbers of antennas of the array, half a wavelength apart.
    beam : int
        Row of ``dft_codebook(rows, columns)``; 0 is the beam in the main direction.

    Raises
    ------
    SettingsError
        For a value out of range, or an array of patterns that radiates more than twice the fed power.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> print(sp.Antenna("tr38901", azimuth_deg=90.0, downtilt_deg=10.0, rows=8, columns=4))
    tr38901, 8 x 4, beam 0, azimuth 90 deg, downtilt 10 deg
    """

    pattern: str | AntennaPattern = "iso"
    azimuth_deg: Annotated[float, Within(-360.0, 360.0)] = 0.0
    downtilt_deg: Annotated[float, Within(-90.0, 90.0)] = 0.0
    rows: Annotated[int, Within(1, 64)] = 1
    columns: Annotated[int, Within(1, 64)] = 1
    beam: Annotated[int, Within(0, MAX_ANTENNAS - 1)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.pattern, AntennaPattern):
            require_choice("pattern", self.pattern, PATTERNS)
        count = self.rows * self.columns
        require(self.beam < count, "beam", self.beam, f"an array of {count} antennas has beams up to {count - 1}.")
        if isinstance(self.pattern, AntennaPattern) and self.pattern.uniform_gain_dbi is None and count > 1:
            angles_rad, weights = _sphere()
            radiated = weights @ (np.abs(self.pattern.amplitude(angles_rad)) ** 2 * self._array_gain(angles_rad))
            remedy = (
                f"this array would radiate {radiated:.3g} times the power that it is fed: give one element's pattern."
            )
            require(bool(radiated <= MAX_RADIATED), "rows, columns", (self.rows, self.columns), remedy)

    def _array_gain(self, local_rad: Floats) -> Floats:
        toward, (column, row) = directions(local_rad)[0], divmod(self.beam, self.rows)
        gain = np.ones(len(local_rad))
        for along, size, beam in ((toward[:, 1], self.columns, column), (-toward[:, 2], self.rows, row)):
            step_rad = np.pi * along - 2.0 * np.pi * beam / size
            gain *= np.abs(np.exp(1j * np.outer(step_rad, np.arange(size))).sum(axis=1)) ** 2 / size
        return gain

    @classmethod
    def of(cls, value: "Antenna | AntennaPattern | str | None") -> "Antenna":
        """Return an antenna as it is, or one of a pattern that points along x."""
        if isinstance(value, (str, AntennaPattern, type(None))):
            return cls("iso" if value is None else value)
        require_type("tx_antenna", value, cls, "give sp.Antenna(...), the name of a pattern, or an AntennaPattern.")
        return value

    def __str__(self) -> str:
        pattern = self.pattern
        parts = [f"{pattern.name}, {pattern.gain_dbi:g} dBi" if isinstance(pattern, AntennaPattern) else pattern]
        parts += [f"{self.rows} x {self.columns}, beam {self.beam}"] if self.rows * self.columns > 1 else []
        if parts != ["iso"] or self.downtilt_deg:
            parts += [f"azimuth {self.azimuth_deg:g} deg", f"downtilt {self.downtilt_deg:g} deg"]
        return ", ".join(parts)

    @property
    def uniform_gain_dbi(self) -> float | None:
        """Gain of an upright antenna if the same in all directions [dBi], otherwise None."""
        if self.rows * self.columns > 1 or self.downtilt_deg:
            return None
        if isinstance(self.pattern, AntennaPattern):
            return self.pattern.uniform_gain_dbi
        return 0.0 if self.pattern == "iso" else None

    def fields(self, angles_rad: Floats, frequency_hz: float) -> NDArray[np.complex128]:
        """Return the field (P, 2) along the world's theta and phi, for zenith and azimuth (P, 2)."""
        measured = isinstance(self.pattern, AntennaPattern)
        array = planar_array(self.rows, self.columns, "iso" if measured else str(self.pattern))
        turned = np.radians([self.azimuth_deg, self.downtilt_deg, 0.0])
        antennas = Antennas.of("tx", array, turned, count=1, frequency_hz=frequency_hz)
        antennas = replace(antennas, patterns=[self.pattern]) if measured else antennas
        weights = dft_codebook(self.rows, self.columns)[self.beam]
        radians, at_once = 2j * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S, max(1, _PHASES_AT_ONCE // len(weights))
        found = np.zeros((len(angles_rad), 2), np.complex128)
        for start in range(0, len(angles_rad), at_once):
            here = slice(start, start + at_once)
            one = np.zeros(len(angles_rad[here]), np.intp)
            phases = np.exp(radians * antennas.advance_m(angles_rad[here], one)) @ weights
            found[here] = antennas.fields(angles_rad[here], one)[:, 0] * phases[:, None]
        return found

    def warn_of_frequency(self, frequency_hz: float) -> None:
        """Log a warning for a pattern that was measured at another frequency."""
        measured_hz = getattr(self.pattern, "frequency_hz", None)
        if measured_hz and abs(math.log(frequency_hz / measured_hz)) > math.log(FREQUENCY_RATIO):
            message = "antenna '%s' was measured at %g GHz, and is used at %g GHz, where its pattern is another one"
            _log.warning(message, self, measured_hz / 1e9, frequency_hz / 1e9)

    def gain(self, angles_rad: Floats, frequency_hz: float) -> Floats:
        """Return the gain (P,) of vertical polarisation towards zenith and azimuth (P, 2)."""
        return np.asarray(np.abs(self.fields(angles_rad, frequency_hz)[:, 0]) ** 2)

    def largest_gains(self, frequency_hz: float) -> Gains:
        """Return upper bounds of the gain of both polarisations, within a degree of each direction."""
        return _largest_gains(self, frequency_hz)

    def power(self, paths: SolvedPaths, frequency_hz: float, *, at_rx: bool = False) -> Floats:
        """Return the power (P,) of paths with both polarisations, with an isotropic, vertical antenna opposite."""
        fields = self.fields(paths.arrival_rad if at_rx else paths.departure_rad, frequency_hz)
        transfer = paths.transfer[:, :, 0] if at_rx else paths.transfer[:, 0]
        return np.asarray(np.abs(np.einsum("pi,pi->p", transfer, fields)) ** 2)

    def averaged(self, frequency_hz: float) -> "Antenna":
        """Return the antenna for an unknown orientation: its mean gain in every direction."""
        if self.uniform_gain_dbi is not None:
            return self
        angles_rad, weights = _sphere()
        power = weights @ (np.abs(self.fields(angles_rad, frequency_hz)) ** 2).sum(axis=1)
        gain_dbi = max(10.0 * math.log10(power), -MAX_GAIN_DBI)
        return Antenna(AntennaPattern("mean over all directions", gain_dbi, np.zeros(360), np.zeros(360)))


def _sphere() -> tuple[Floats, Floats]:
    """Return directions (P, 2) of a grid on the sphere, and their fractions (P,) of it."""
    zenith_rad, azimuth_rad = np.radians(np.arange(0.5, 180.0)), np.radians(np.arange(360.0))
    angles_rad = np.stack(np.meshgrid(zenith_rad, azimuth_rad, indexing="ij"), axis=-1).reshape(-1, 2)
    weights = np.sin(angles_rad[:, 0])
    return angles_rad, weights / weights.sum()


@lru_cache(8)
def _largest_gains(antenna: Antenna, frequency_hz: float) -> Gains:
    if antenna.uniform_gain_dbi == 0.0:
        return ISOTROPIC
    angles_deg = np.stack(np.meshgrid(np.arange(181.0), np.arange(360.0), indexing="ij"), axis=-1)
    fields = antenna.fields(np.radians(angles_deg.reshape(-1, 2)), frequency_hz)
    gain = (np.abs(fields) ** 2).sum(axis=1).reshape(181, 360)
    table = maximum_filter(gain, 3, mode=("nearest", "wrap"))
    return Gains(table, table.max(axis=0), float(table.max()))


def _evaluated(pattern: Any, local_rad: Floats) -> list[NDArray[np.complex128]]:
    import mitsuba as mi

    if not len(local_rad):  # Dr.Jit would abort
        return [np.zeros(0, np.complex128)] * 2
    if isinstance(pattern, AntennaPattern):
        return [pattern.amplitude(local_rad), np.zeros(len(local_rad), np.complex128)]
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
