"""Survey files: CSVs, JSON surveys on a plan, and recordings of Valeronoi -> positions, powers and access points."""

from __future__ import annotations

import json
import logging
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.checks import number_of, shown
from sionna_partial.columns import MAX_CSV_BYTES, Columns, read_columns
from sionna_partial.constants import HIGHEST_DB, LOWEST_DB, PICTURE_SUFFIXES
from sionna_partial.errors import MeasurementError
from sionna_partial.files import decoding, input_path, open_regular, read_bytes

VACUUM_HEIGHT_M = 0.1

NAMES = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z", "gain_db", "std_db", "power_dbm")
"""Names of columns of numbers."""

TRANSMITTER_HEADERS = {
    **dict.fromkeys(("bssid", "mac", "mac address", "mac_address"), "bssid"),
    **dict.fromkeys(("tx", "transmitter", "access point", "access_point", "accesspoint", "ap", "ap name"), "tx"),
    **dict.fromkeys(("pci", "eci"), "cell"),
    **dict.fromkeys(("ssid", "essid", "network"), "ssid"),
}
"""Headers of columns that tell transmitters apart, in lower case; the first kind in a file identifies them."""

_LEVELS = ("rssi", "rsrp", "rss", "power", "signal", "signalstrength", "signal strength", "signal_strength")
_HEADERS = {
    **{name: name for name in NAMES},
    **{f"{axis}{unit}": f"rx_{axis}" for axis in "xyz" for unit in ("", "_m", " [m]", " (m)")},
    **{f"{level}{unit}": "power_dbm" for level in _LEVELS for unit in ("", "_dbm", " [dbm]", " (dbm)")},
    **TRANSMITTER_HEADERS,
}
del _HEADERS["power"]  # of unknown unit
"""Headers of survey programs, in lower case, and the names of their columns."""

_DEGREES = re.compile(r"(?:^|_|current|best|gps|min|max|avg)(?:lat|latitude|lon|long|longitude|lng)$")

_EXPORTS = {
    "WiGLE": re.compile(r"wiglewifi-|authmode.*currentlatitude"),
    "Kismet": re.compile(r"nettype[;,]e?ssid|kismet[._-](?:version|device)"),
    "Network Survey": re.compile(r"# created by network survey"),
    "NetSpot": re.compile(r"netspot|bssid.*channel.*(?:security.*vendor|vendor.*security)"),
}
"""Survey programs, and a sign of their exports in one of the first lines, in lower case."""

_BINARY = {b"SQLite format 3": "an SQLite database, as of Kismet or a GeoPackage", b"PK\x03\x04": "a zip, as .xlsx"}

_EXPORT_BYTES, _EXPORT_LINES = 4_000, 4

_METRES = "give a CSV with the columns x, y in metres, in the frame of the map, and rssi"

NAME_COLUMNS = (
    "name the headers of a file, as columns={{'{0}': 'HEADER'}} of load_measurements or --column {0}=HEADER on the "
    "command line"
)

GIVE = (
    f"give a CSV with the columns {', '.join(NAMES[:-1])}, a JSON survey, or a recording of Valeronoi (.vwm); or a "
    "mapping or data frame."
)

_ASK = (
    "give the BSSID or name of one as access_point, or as --access-point on the command line, or leave out the rows of "
    "the others"
)

_log = logging.getLogger(__name__)


class Survey(NamedTuple):
    """Columns of numbers by name, and the names of the transmitter of each row: identity first; () if unknown."""

    table: dict[str, Floats]
    transmitters: Sequence[tuple[str, ...]] = ()

    def of_access_point(self, name: str, access_point: str) -> Survey:
        """Return the rows of one access point, given by any of its names."""
        counts = Counter(self.transmitters)
        asked = {each[0] for each in counts if access_point.lower() in [word.lower() for word in each]}
        if len(asked) != 1:
            listed = f", which are {listed_access_points(counts)}: {_ASK}" if counts else ": leave it out"
            what = f"names {len(asked)} access points of measurements '{name}'"
            raise MeasurementError(f"access_point = {shown(access_point)} {what}{listed}.")
        return self.take(np.array([each[0] in asked for each in self.transmitters]))

    def of_most_measured(self, name: str) -> Survey:
        """Return the rows of the access point with most of them; the others are logged."""
        counts = Counter(self.transmitters)
        if len(counts) > 1:
            message = "measurements '%s' are of %d access points (%s): the first is used; %s"
            _log.warning(message, name, len(counts), listed_access_points(counts), _ASK)
        return self.take(np.array([each == counts.most_common(1)[0][0] for each in self.transmitters]))

    def take(self, used: NDArray[np.bool_]) -> Survey:
        """Select rows by a mask (N,)."""
        rows = [each for each, is_used in zip(self.transmitters, used, strict=True) if is_used]
        return Survey({column: values[used] for column, values in self.table.items()}, rows)


def listed_access_points(counts: Counter[tuple[str, ...]]) -> str:
    """Return the names and numbers of rows of access points, most frequent first."""
    shown_names = [(f"{each[1]} ({each[0]})" if each[1:] else each[0], count) for each, count in counts.most_common()]
    return ", ".join(f"{name}: {count:,}" for name, count in shown_names[:20])


def require_one_transmitter(transmitters: Sequence[tuple[str, ...]], given: str) -> None:
    """Raise a MeasurementError for rows of several access points, whose powers must not be averaged."""
    counts = Counter(transmitters)
    if len({each[0] for each in counts}) > 1:
        raise MeasurementError(
            f"{given} has powers of {len(counts)} access points ({listed_access_points(counts)}): {_ASK}, or give the "
            "positions of several as tx={name: (x, y, z), ...} of load_measurements."
        )


def read_survey(
    path: str | os.PathLike[str], columns: Mapping[str, str] | None, tx_power_dbm: float, pixel_m: float | None
) -> Survey:
    """Read a survey file; `tx_power_dbm` is subtracted from received powers, `pixel_m` is the plan's pixel [m]."""
    source = input_path(path, "measurements", MeasurementError, GIVE)
    suffix = source.suffix.lower()
    is_json = suffix != ".vwm" and is_plan_survey(source)
    for name, value, used in (("columns", columns, suffix != ".vwm" and not is_json), ("pixel_m", pixel_m, is_json)):
        if value is not None and not used:
            kind = "a CSV" if name == "columns" else "a survey on the pixels of a plan (JSON)"
            raise MeasurementError(f"{name} = {shown(value)} is for {kind}, and not for '{source.name}': leave it out.")
    if suffix == ".vwm":
        survey = _read_recording(source)
        return survey._replace(table=survey.table | {"gain_db": survey.table["gain_db"] - tx_power_dbm})
    _refuse_exports(source)
    if is_json:
        return _of_columns(source.name, _read_plan_survey(source, pixel_m), tx_power_dbm)
    names = _names_of_headers(columns)
    found = read_columns(path, "measurements", MeasurementError, names, GIVE, (*{*TRANSMITTER_HEADERS.values()},))
    absent = [header for header in (columns or {}).values() if names[header.strip().lower()] not in found.headers]
    if absent:
        raise MeasurementError(f"measurements '{source.name}' has no column {absent[0]!r}: check columns.")
    return _of_columns(source.name, found, tx_power_dbm)


def is_plan_survey(source: Path) -> bool:
    """Return whether a survey is a JSON, with powers at pixels of a plan."""
    return source.suffix.lower() == ".json" or _head(source).lstrip()[:1] in (b"{", b"[")


def _head(source: Path) -> bytes:
    with open_regular(source, "measurements", MeasurementError, MAX_CSV_BYTES, "leave lines out.") as stream:
        return stream.read(_EXPORT_BYTES)


def _refuse_exports(source: Path) -> None:
    """Raise a MeasurementError that names the program, for exports without positions in metres or pixels."""
    head, given = _head(source), f"measurements '{source.name}'"
    kind = next((kind for magic, kind in _BINARY.items() if head.startswith(magic)), None)
    if kind is not None:
        raise MeasurementError(f"{given} is {kind}, and no CSV: {_METRES}.")
    lines = [line.lower() for line in head.decode("utf-8", "replace").splitlines()[:_EXPORT_LINES]]
    words = {word.strip(' "#') for line in lines for word in re.split(r"[,;\t]", line)}
    program = next((name for name, sign in _EXPORTS.items() if any(map(sign.search, lines))), None)
    if program is not None and not words & {header for header, name in _HEADERS.items() if name == "rx_x"}:
        where = "with positions in degrees" if any(map(_DEGREES.search, words)) else "without positions"
        raise MeasurementError(f"{given} is an export of {program}, {where}: {_METRES}.")


def _of_columns(name: str, found: Columns, tx_power_dbm: float) -> Survey:
    given = f"measurements '{name}'"
    table = {column: np.array(values, dtype=np.float64) for column, values in found.numbers.items()}
    if {"gain_db", "power_dbm"} <= {*table}:
        raise MeasurementError(f"{given} has 2 columns of gain_db (a gain and a power): keep one of them.")
    positions = [found.headers[axis] for axis in ("rx_x", "rx_y") if axis in table] or found.others
    degrees = [header for header in positions if _DEGREES.search(header.strip().lower())]
    if degrees:
        raise MeasurementError(f"{given} has positions in degrees ({', '.join(degrees)}): {_METRES}.")
    missing = [column for column in ("gain_db", "rx_x", "rx_y") if column not in table]
    missing = missing[1:] if "power_dbm" in table else missing
    unused = f" (its other headers are {', '.join(found.others)[:200]})" if found.others else ""
    if missing:
        raise MeasurementError(
            f"{missing[0]} is missing from {given}{unused}: {NAME_COLUMNS.format(missing[0])}; {GIVE}"
        )
    if found.others:
        message = "%s: columns that are not known are not used (%s); " + NAME_COLUMNS.format("rx_x")
        _log.warning(message, given, ", ".join(found.others)[:200])
    _require_numbers(given, found, table, tx_power_dbm)
    if "power_dbm" in table:
        table["gain_db"] = table.pop("power_dbm") - tx_power_dbm
    elif tx_power_dbm:
        _log.warning("%s are path gains: tx_power_dbm = %g is not subtracted", given, tx_power_dbm)
    return Survey(table, transmitters_of(found.texts))


def _require_numbers(given: str, found: Columns, table: Mapping[str, Floats], tx_power_dbm: float) -> None:
    """Raise a MeasurementError that names line, header and unit of the first value that no link has."""
    for column, values in table.items():
        good = np.isfinite(values) | (column.startswith("tx_") & np.isnan(values))
        remedy, unit = "give finite numbers, or leave the line out.", "dB" if column.endswith("db") else "m"
        if column in ("gain_db", "power_dbm") and good.all():
            is_power = column == "power_dbm"
            gain_db, unit = values - tx_power_dbm * is_power, "dBm" if is_power else "dB"
            good = (gain_db >= LOWEST_DB) & (gain_db <= HIGHEST_DB)
            remedy = "path gains are negative; give minus the path loss."
            if is_power:
                remedy = (
                    f"with tx_power_dbm = {tx_power_dbm:g}, received powers are {LOWEST_DB + tx_power_dbm:g} to "
                    f"{HIGHEST_DB + tx_power_dbm:g} dBm; percentages are not read."
                )
        if not good.all():
            first, more = int(np.flatnonzero(~good)[0]), int((~good).sum()) - 1
            value = f"{found.headers[column]} = {values[first]:g} {unit}{f' (and {more:,} more)' if more else ''}"
            raise MeasurementError(f"{given}, line {found.lines[first]}: {value} is not allowed: {remedy}")


def transmitters_of(texts: Mapping[str, Sequence[Any]]) -> list[tuple[str, ...]]:
    """Return the names of the transmitter of each row, identity first; [] without any. Keys are as in `texts`."""
    kinds = [kind for kind in dict.fromkeys(TRANSMITTER_HEADERS.values()) if any(map(str, texts.get(kind, ())))]
    rows = zip(*(map(str, texts[kind]) for kind in kinds), strict=True)
    return [(row[0].lower() if kinds[0] == "bssid" else row[0], *filter(None, row[1:])) for row in rows]


def _names_of_headers(columns: Mapping[str, str] | None) -> dict[str, str]:
    names = dict(_HEADERS)
    if not isinstance(columns, Mapping | None):
        raise MeasurementError(f"columns = {shown(columns)} is no mapping: {NAME_COLUMNS.format('rx_x')}.")
    for name, header in (columns or {}).items():
        if name not in NAMES or not isinstance(header, str):
            raise MeasurementError(f"columns = {shown(columns)}: give a header for some of {', '.join(NAMES)}.")
        key = header.strip().lower()
        same = ("gain_db", "power_dbm") if name in ("gain_db", "power_dbm") else (name,)
        name = "power_dbm" if name == "gain_db" and "gain" not in key else name
        names = {other: value for other, value in names.items() if value not in same} | {key: name}
    return names


def _read_plan_survey(source: Path, pixel_m: float | None) -> Columns:
    """Read a survey of python-wifi-survey-heatmap: powers at pixels of a plan, which lies beside it, with y down."""
    from PIL import Image  # rarely needed

    given = f"measurements '{source.name}'"
    with decoding(source, "no JSON survey", MeasurementError):
        raw = json.loads(read_bytes(source, "measurements", MeasurementError, MAX_CSV_BYTES))
        points = raw.get("survey_points") if isinstance(raw, dict) else raw
        rows = [each | each["result"] for each in points or () if not each.get("failed")]
        xy = np.array([[number_of(row["x"]), number_of(row["y"])] for row in rows]).reshape(-1, 2)
        power_dbm = [number_of(next(row[key] for key in ("rssi", "rss") if key in row)) for row in rows]
        plan = PurePath(str(raw.get("img_path", "") if isinstance(raw, dict) else "")).name
    if not rows:
        raise MeasurementError(f"{given} has no survey points: check that it was written completely.")
    remedy = "give pixel_m, metres per pixel (--pixel on the command line), and keep the plan beside the survey"
    if pixel_m is None or not 1e-4 <= number_of(pixel_m) <= 10.0:
        where = f"{given} has positions in pixels of the plan {plan!r}"
        raise MeasurementError(f"{where}, and pixel_m = {shown(pixel_m)}: {remedy}.")
    plans = [path for path in (source.with_name(plan), *(source.with_suffix(s) for s in PICTURE_SUFFIXES)) if plan]
    picture = next((path for path in plans if path.is_file()), None)
    if picture is None:
        raise MeasurementError(f"{given} has positions in pixels of the plan {plan!r}, which is not there: {remedy}.")
    with decoding(picture, "no picture", MeasurementError), Image.open(picture) as image:
        height = image.size[1]
    xy_m = [xy[:, 0] * pixel_m, (height - xy[:, 1]) * pixel_m]
    numbers = {"rx_x": xy_m[0].tolist(), "rx_y": xy_m[1].tolist(), "power_dbm": power_dbm}
    headers = {"rx_x": "x", "rx_y": "y", "power_dbm": "rssi"}
    texts = {kind: [str(row.get(kind) or "") for row in rows] for kind in ("bssid", "ssid")}
    return Columns(numbers, texts, headers, [*range(1, len(rows) + 1)], [])


def _read_recording(path: Path) -> Survey:
    from sionna_partial.maps.importers.vacuum import read_json  # rarely needed

    raw, _, frame = read_json(path, "measurements", MeasurementError)
    with decoding(path, "no recording of Valeronoi", MeasurementError):
        rows = [row for row in raw["measurements"] if len(row["data"])]
        points_m = frame.world_m([[number_of(row["x"]), number_of(row["y"])] for row in rows])
        power_dbm = np.array([np.mean([number_of(value) for value in row["data"]]) for row in rows], dtype=np.float64)
        points = {number: (str(wifi["bssid"]), str(wifi["ssid"])) for number, wifi in enumerate(raw["wifis"])}
        of_row = [({-1: ("unknown", "unknown")} | points)[row["wifi"]] for row in rows]
    if not rows:
        raise MeasurementError(
            f"measurements '{path.name}' has no measurements: let the robot drive while Valeronoi records."
        )
    height_m = np.full(len(rows), VACUUM_HEIGHT_M)
    table = dict(zip(("rx_x", "rx_y", "rx_z"), [*points_m.T, height_m], strict=True)) | {"gain_db": power_dbm}
    return Survey(table, of_row)
