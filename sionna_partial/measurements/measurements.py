"""Measured path gains: mappings, data frames and CSV files -> Measurements."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.checks import float_array, number_of, shown
from sionna_partial.constants import DEFAULT_HEIGHT_M, GAIN_FLOOR_DB, HIGHEST_DB, LOWEST_DB
from sionna_partial.display import Shown
from sionna_partial.errors import MeasurementError
from sionna_partial.files import is_path

OUTAGE_DB = GAIN_FLOOR_DB + 10.0
"""Largest gain that counts as an outage, with noise [dB]."""

SAME_M, MOST_LINKS = 0.01, 3000
"""Edge of cubes for ends of repeated links [m]; largest number of links."""

_ROUNDING_DB = 1e-6

LEAST_STD_DB, HIGHEST_STD_DB = 0.1, 30.0
"""Smallest effective and largest allowed standard deviation of a gain [dB]."""

FEW_REPEATS = 10
"""Number of repetitions at which half of their scatter is attributed to noise."""

if TYPE_CHECKING:
    from sionna_partial.measurements.surveys import Survey

_log = logging.getLogger(__name__)

_GIVE = (
    "give a mapping or data frame with tx (N, 3), rx (N, 3) and gain_db (N,), or the path of a file that "
    "load_measurements reads."
)
_STD_REMEDY = f"give a standard deviation of more than 0 and up to {HIGHEST_STD_DB:g} dB, or none."


@read_only
@dataclass(frozen=True, eq=False)
class Measurements(Shown):
    """Measured gains of N links.

    Parameters
    ----------
    tx : (N, 3) float64 array, or None
        Transmitter of each link [m], or one for all, (3,). None, or NaN as x and y, if unknown; z may be known.
    rx : (N, 3) float64 array
        Receivers [m].
    gain_db : (N,) float64 array
        Omnidirectional path gain [dB], negative; -150 is an outage.
    std_db : (N,) float64 array, optional
        Standard deviation of each gain, or one for all [dB], at least 0.1; by default estimated.
    sensitivity_db : float
        Sensitivity of the receiver [dB]; gains up to it are upper bounds.

    Raises
    ------
    MeasurementError
        For wrong shapes, values that are not finite, or gains that no link has.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> measured = sp.Measurements((1.0, 2.0, 1.5), [(3.0, 2.0, 1.5), (5.0, 4.0, 1.5)], [-70.2, -150.0], std_db=2.0)
    >>> len(measured)
    2
    """

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    gain_db: NDArray[np.float64]
    std_db: NDArray[np.float64] | None = None
    sensitivity_db: float = GAIN_FLOOR_DB

    def __post_init__(self) -> None:
        gain_db = _numbers("gain_db", self.gain_db)
        if gain_db.ndim != 1:
            raise MeasurementError(f"gain_db has shape {gain_db.shape}: give one gain for each link, (N,).")
        nowhere = np.full(3, np.nan)
        tx = _positions("tx", nowhere if self.tx is None else self.tx, len(gain_db), known=False)
        object.__setattr__(self, "tx", tx)
        object.__setattr__(self, "rx", _positions("rx", self.rx, len(gain_db)))
        low, high = gain_db < LOWEST_DB, gain_db > HIGHEST_DB
        _require(~high, "gain_db", gain_db, "path gains are negative; give minus the path loss.")
        _require(~low, "gain_db", gain_db, f"give dB, not below {LOWEST_DB:g}; an outage is {GAIN_FLOOR_DB:g}.")
        object.__setattr__(self, "gain_db", gain_db)
        if self.std_db is not None:
            std_db = _numbers("std_db", self.std_db)
            if std_db.shape not in ((), gain_db.shape):
                raise MeasurementError(f"std_db has shape {std_db.shape}: give one for all links, or one for each.")
            _require((std_db > 0.0) & (std_db <= HIGHEST_STD_DB), "std_db", std_db, _STD_REMEDY)
            object.__setattr__(self, "std_db", np.maximum(np.broadcast_to(std_db, gain_db.shape), LEAST_STD_DB))
        sensitivity_db = _numbers("sensitivity_db", self.sensitivity_db)
        if sensitivity_db.shape != () or not GAIN_FLOOR_DB <= sensitivity_db <= HIGHEST_DB:
            remedy = f"give one path gain of {GAIN_FLOOR_DB:g} to {HIGHEST_DB:g} dB."
            raise MeasurementError(f"sensitivity_db = {self.sensitivity_db!r} is not allowed: {remedy}")
        object.__setattr__(self, "sensitivity_db", float(sensitivity_db))

    def __len__(self) -> int:
        return len(self.gain_db)

    def take(self, index: NDArray[np.generic]) -> Measurements:
        """Select links by an index array or a mask (N,)."""
        std_db = None if self.std_db is None else self.std_db[index]
        return Measurements(self.tx[index], self.rx[index], self.gain_db[index], std_db, self.sensitivity_db)

    def of_paths(self, antenna_db: Floats | float) -> tuple[Floats, Bools]:
        """Return the levels (N,) without the antenna's gain [dB], and the mask of received links.

        Without reception the level is an upper limit: the sensitivity, or -150 dB.
        """
        received = self.gain_db > self.sensitivity_db
        limit_db = self.sensitivity_db - antenna_db if self.sensitivity_db > GAIN_FLOOR_DB else GAIN_FLOOR_DB
        level_db = np.maximum(np.where(received, self.gain_db - antenna_db, limit_db), GAIN_FLOOR_DB)
        return level_db, received & (level_db > GAIN_FLOOR_DB + _ROUNDING_DB)

    @property
    def tx_known(self) -> NDArray[np.bool_]:
        """Return whether the position of each transmitter (N,) is known."""
        return np.asarray(np.isfinite(self.tx).all(axis=1))

    def require_transmitters(self) -> None:
        """Raise a MeasurementError if the position of a transmitter is unknown."""
        missing = int((~self.tx_known).sum())
        if missing:
            raise MeasurementError(
                f"measurements has {missing:,} of {len(self):,} links without the position of the transmitter: give tx "
                "(N, 3), or its columns tx_x, tx_y; predict_map with tx=None finds it."
            )

    @property
    def is_outage(self) -> NDArray[np.bool_]:
        """Return whether each link (N,) is an outage."""
        return self.gain_db <= OUTAGE_DB


def measurements_of(source: Any) -> Measurements:
    """Read measurements.

    Parameters
    ----------
    source : Measurements, mapping, data frame, Dataset or path
        With `tx` (N, 3) [m], `rx` (N, 3) [m] and `gain_db` (N,) [dB], or with one column per axis: `tx_x`, `tx_y`,
        `tx_z`, `rx_x`, ... (N,), as in a CSV with a header; heights are 1.5 m by default. Cells of a data frame may
        hold x, y, z. `std_db` (N,), `sensitivity_db` and `tx` are optional.

    Raises
    ------
    MeasurementError
        For a missing field or file, or invalid values.
    """
    if isinstance(source, Measurements):
        return source
    if isinstance(source, str | os.PathLike):
        return load_measurements(source)
    given = f"measurements of type {type(source).__name__}"
    gain_db = _field(source, "gain_db")
    if gain_db is None:
        raise MeasurementError(f"gain_db is missing from {given}: {_GIVE}")
    if all(_field(source, name) is None for name in ("tx", "tx_x")):
        _require_one_transmitter(source, given)
    sensitivity_db = _field(source, "sensitivity_db")
    return Measurements(
        _ends(source, "tx"),
        _ends(source, "rx"),
        gain_db,
        _field(source, "std_db"),
        GAIN_FLOOR_DB if sensitivity_db is None else sensitivity_db,
    )


def load_measurements(
    path: str | os.PathLike[str],
    *,
    columns: Mapping[str, str] | None = None,
    tx: ArrayLike | Mapping[str, ArrayLike] | None = None,
    tx_power_dbm: float = 0.0,
    access_point: str | None = None,
    pixel_m: float | None = None,
) -> Measurements:
    r"""Read measurements from a CSV of a survey app, a JSON survey on a plan, or a recording of Valeronoi.

    Parameters
    ----------
    path : path-like
        A CSV with a header: columns tx_x, tx_y, tx_z, rx_x, rx_y, rx_z (or x, y, z) [m], gain_db and std_db [dB], or
        power_dbm, rssi or rsrp for received powers. Missing heights are 1.5 m. bssid, mac, tx or ssid tell access
        points apart. A JSON survey of python-wifi-survey-heatmap has powers at pixels of the plan beside it, in the
        frame of the map that `load_map` makes of the plan. A recording (.vwm) has mean received powers of a vacuum
        robot, 0.1 m high, on the map that `load_map` reads from the same file; transmitters are unknown.
    columns : mapping, optional
        Headers of these columns, such as ``{"rx_x": "east", "power_dbm": "level"}``. A header for gain_db without the
        word "gain" is a received power.
    tx : (3,) array-like, or mapping of names to them, optional
        Transmitter of all links [m], or of each access point by BSSID or name; links of others are left out.
    tx_power_dbm : float
        Received power without path loss [dBm], subtracted from received powers only. Leave it out if unknown:
        `predict_map` and `calibrate_materials` estimate a common offset.
    access_point : str, optional
        BSSID or name of the access point to read. Required for a file of several without their positions; of a
        recording, by default the one with most measurements.
    pixel_m : float, optional
        Edge of a pixel of the plan of a JSON survey [m].

    Raises
    ------
    MeasurementError
        If the file cannot be read, has no rows, lacks a column or the access point, or has invalid values.

    Examples
    --------
    >>> import pathlib, sionna_partial as sp
    >>> size = pathlib.Path("survey.csv").write_text("x,y,rssi\n3.0,2.0,-52\n5.0,4.0,-61\n")
    >>> sp.load_measurements("survey.csv", tx=(1.0, 2.0, 1.5), tx_power_dbm=20.0).gain_db.tolist()
    [-72.0, -81.0]
    """
    from sionna_partial.measurements.surveys import read_survey, require_one_transmitter

    power_dbm, name = number_of(tx_power_dbm), Path(path).name if is_path(path) else ""
    if not math.isfinite(power_dbm):
        raise MeasurementError(f"tx_power_dbm = {shown(tx_power_dbm)} is not allowed: give a number of dBm.")
    survey = read_survey(path, columns, power_dbm, pixel_m)
    if access_point is not None:
        survey = survey.of_access_point(name, access_point)
    if isinstance(tx, Mapping):
        return measurements_of(_of_transmitters(survey, tx, name))
    has_tx = {"tx_x", "tx_y"} <= {*survey.table}
    if access_point is None and name.lower().endswith(".vwm"):
        survey = survey.of_most_measured(name)
    if tx is not None or not has_tx:
        require_one_transmitter(survey.transmitters, f"measurements '{name}'")
    if tx is not None and has_tx:
        _log.warning("measurements '%s': tx is used instead of the columns tx_x and tx_y", name)
    return measurements_of(survey.table if tx is None else survey.table | {"tx": tx})


def _of_transmitters(survey: Survey, tx: Mapping[str, ArrayLike], given: str) -> dict[str, Floats]:
    """Return the columns of the access points in `tx`, with their positions."""
    parts = [survey.of_access_point(given, name) for name in tx]
    used = sum(len(part.transmitters) for part in parts)
    if used < len(survey.transmitters):
        message = "measurements '%s': %d of %d rows are of access points without a position in tx, and not used"
        _log.warning(message, given, len(survey.transmitters) - used, len(survey.transmitters))
    rows = zip(tx.items(), parts, strict=True)
    tx_m = np.concatenate([_positions(f"tx[{name!r}]", at_m, len(part.transmitters)) for (name, at_m), part in rows]).T
    table = {column: np.concatenate([part.table[column] for part in parts]) for column in survey.table}
    return table | dict(zip(("tx_x", "tx_y", "tx_z"), tx_m, strict=True))


def merged(measured: Measurements) -> tuple[Measurements, NDArray[np.intp], NDArray[np.float64]]:
    """Merge repeated measurements: L links with mean gains, the link of each measurement (N,), and variances (L,).

    The variance [dB^2] of a mean follows from the scatter of repetitions; without any it is 0, and the noise is part
    of the link.
    """
    cubes = np.round(np.hstack([measured.tx, measured.rx]) / SAME_M)
    keys = np.column_stack([cubes, measured.is_outage])
    _, first, link, count = np.unique(keys, axis=0, return_index=True, return_inverse=True, return_counts=True)
    if len(first) > MOST_LINKS:
        raise MeasurementError(
            f"measurements has {len(first):,} links that are not repetitions, more than {MOST_LINKS:,}: give one "
            f"in {math.ceil(len(first) / MOST_LINKS)}, which determines the material as well."
        )
    order = np.argsort(first)
    link, first, count = np.argsort(order)[link.ravel()], first[order], count[order]
    mean_db = np.bincount(link, weights=measured.gain_db) / count
    received = ~measured.is_outage
    square = ((measured.gain_db - mean_db[link])[received] ** 2).sum()
    repeats = received.sum() - received[first].sum()
    return (
        Measurements(measured.tx[first], measured.rx[first], mean_db),
        link,
        square / (repeats + FEW_REPEATS) / count,
    )


def _field(source: Any, name: str) -> Any:
    try:
        return source[name]
    except (KeyError, IndexError, TypeError, ValueError):
        return None


def _require_one_transmitter(source: Any, given: str) -> None:
    from sionna_partial.measurements.surveys import TRANSMITTER_HEADERS, require_one_transmitter, transmitters_of

    keys = {str(key).lower(): key for key in source} if hasattr(source, "keys") else {}
    headers = [header for header in TRANSMITTER_HEADERS if header in keys and header != "tx"]
    texts = {TRANSMITTER_HEADERS[header]: np.asarray(source[keys[header]]).ravel().tolist() for header in headers}
    require_one_transmitter(transmitters_of(texts), given)


def _ends(source: Any, name: str) -> Any:
    positions = _field(source, name)
    if positions is not None:
        return positions
    x, y, z = (_field(source, f"{name}_{axis}") for axis in "xyz")
    if name == "tx" and x is None and y is None:
        return None if z is None else np.insert(np.full((np.size(z), 2), np.nan), 2, z, axis=1)
    if x is None or y is None:
        raise MeasurementError(f"{name} is missing from the measurements: {_GIVE}")
    known = name != "tx"
    columns = [_numbers(f"{name}_{axis}", values, known=known) for axis, values in zip("xy", (x, y), strict=True)]
    columns.append(np.full_like(columns[0], DEFAULT_HEIGHT_M) if z is None else _numbers(f"{name}_z", z, known=known))
    if len({column.shape for column in columns}) > 1:
        shapes = ", ".join(str(column.shape) for column in columns)
        raise MeasurementError(f"{name}_x, {name}_y and {name}_z have shapes {shapes}: give one value for each link.")
    return np.stack(columns, axis=-1)


def _numbers(name: str, values: ArrayLike, *, known: bool = True) -> NDArray[np.float64]:
    """Return a new array of finite numbers, or NaN unless `known`, or raise a MeasurementError."""
    cells = list(np.asarray(values)) if getattr(values, "dtype", None) == np.dtype("O") else values
    array = float_array(name, cells, MeasurementError, "give finite numbers.")
    good = np.isfinite(array) | (np.isnan(array) & (not known))
    _require(good, name, array, "give finite numbers, or leave the link out.")
    return array


def _positions(name: str, values: ArrayLike, count: int, *, known: bool = True) -> NDArray[np.float64]:
    positions = _numbers(name, values, known=known)
    if positions.shape == (3,):
        positions = np.tile(positions, (count, 1))
    if positions.shape != (count, 3):
        raise MeasurementError(
            f"{name} has shape {positions.shape} for {count} gains: give x, y, z of each link in metres, ({count}, 3)."
        )
    unknown = np.isnan(positions)
    unlike = unknown != unknown[:, :1]
    unlike[:, 2] &= unknown[:, 2]
    _require(~unlike, name, positions, "give NaN as both x and y where the transmitter is not known.")
    return positions


def _require(good: NDArray[np.bool_], name: str, values: NDArray[np.float64], remedy: str) -> None:
    if not good.all():
        first = tuple(int(index) for index in np.argwhere(~good)[0])
        more = f" (and {int((~good).sum()) - 1} more)" if (~good).sum() > 1 else ""
        raise MeasurementError(
            f"{name}[{', '.join(map(str, first))}] = {values[first]:g}{more} is not allowed: {remedy}"
        )
