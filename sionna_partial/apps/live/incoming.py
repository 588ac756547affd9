"""Messages of a robot: maps, poses, received powers and positions of transmitters, which are checked and kept."""

import functools
import logging
import math
import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.apps.live.answers import MapMessage
from sionna_partial.arrays import Floats
from sionna_partial.checks import (
    Checked,
    Within,
    float_array,
    number_of,
    require,
    settings_or_default,
    shown,
    with_height,
)
from sionna_partial.constants import COST_THRESHOLD_DB, DEFAULT_HEIGHT_M, GAIN_FLOOR_DB, MAX_COST
from sionna_partial.errors import MapError, MeasurementError, PositionError, SettingsError, SionnaPartialError
from sionna_partial.maps.environment import grid_array
from sionna_partial.maps.importers.bags import map_of_percent, occupancy_parts
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.settings import SceneSettings, TraceSettings

LATE_S = 30.0
"""Maps older than the last by less are dropped; by more, the clock was restarted [s]."""

POSE_AGE_S = 2.0

SAME_BAND = 0.15
"""Relative difference of frequencies up to which powers are used."""

POWER_CELL_M = 0.25
"""Edge of squares that keep the newest power of a transmitter [m]."""

MOST_POWERS = 500

MOST_ACCESS_POINTS = 8
"""Number of access points that are located by themselves."""

REPEATED_S, MOST_LINES = 60.0, 50
"""Time for which a line is not repeated [s], and number of remembered lines."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LiveSettings(Checked):
    """Settings of live coverage.

    Parameters
    ----------
    frame : str
        Frame of transmitters and maps; "" is the frame of the first map.
    threshold_db : float
        Path gain up to which a cell counts as not covered [dB].
    spacing_m, rx_height_m : float
        Spacing of the receivers in the final answer, and their height [m].
    tx_power_dbm : float
        Subtracted from measured powers [dBm]; 0 if unknown, as a common offset is estimated.
    refresh_s : float
        Shortest time between two answers for one map while powers arrive [s].
    views_every_s : float
        Time between two lists of next views [s]; 0 lists them on request only.
    max_cost : int
        Largest value of a published grid [percent]: nav2 reads 99 as an inscribed obstacle and 100 as an obstacle.
    every_unknown : bool
        Whether final grids have all unknown cells; by default those within 1 m (two spacings, if more) of free ones.

    Examples
    --------
    >>> from sionna_partial.apps.live.incoming import LiveSettings
    >>> LiveSettings(threshold_db=-95.0).spacing_m
    0.15
    """

    frame: str = ""
    threshold_db: Annotated[float, Within(GAIN_FLOOR_DB, 0.0)] = COST_THRESHOLD_DB
    spacing_m: Annotated[float, Within(0.0, 10.0, open_low=True)] = 0.15
    rx_height_m: Annotated[float, Within(0.0, 100.0)] = DEFAULT_HEIGHT_M
    tx_power_dbm: Annotated[float, Within(-200.0, 200.0)] = 0.0
    refresh_s: Annotated[float, Within(0.1, 1e6)] = 10.0
    views_every_s: Annotated[float, Within(0.0, 1e6)] = 0.0
    max_cost: Annotated[int, Within(1, 100)] = MAX_COST
    every_unknown: bool = False


def _refusing(method: Callable[..., None]) -> Callable[..., None]:
    """Log why a message is refused: no message ends the program."""

    @functools.wraps(method)
    def take(self: "Incoming", *given: Any, **named: Any) -> None:
        what = method.__name__.removeprefix("on_").replace("_", " ")
        try:
            method(self, *given, **named)
        except SionnaPartialError as error:
            self.report(f"{what} refused: {error}")
        except Exception as error:  # messages may hold anything
            self.report(f"{what} refused: it is ill-formed ({type(error).__name__}: {shown(str(error))}).")

    return take


class Incoming:
    """Newest map, pose and received powers of a robot, and positions of transmitters; any thread may pass messages.

    Refused messages are logged.
    """

    def __init__(
        self,
        tx: ArrayLike | Mapping[str, ArrayLike | None] | None,
        settings: LiveSettings | None,
        model: dict[str, Any],
        *,
        await_frequency: bool,
    ) -> None:
        self.settings = settings_or_default("settings", settings, LiveSettings)
        self.tx_m = _named_positions(tx)
        self._finds, self._access_points = not self.tx_m, dict[str, str]()
        self._model_settings, self._await_frequency = model, await_frequency
        for name, kind in (("trace_settings", TraceSettings), ("scene_settings", SceneSettings)):
            settings_or_default(name, model.get(name), kind)
        self._changed = threading.Condition()
        self._newest: MapMessage | None = None
        self._waiting: MapMessage | None = None
        self._answered = 0
        self.frame = self.settings.frame.lstrip("/")
        self._pose: tuple[float, float, float] | None = None
        self._powers: dict[str, dict[tuple[int, int], tuple[float, float, float]]] = {name: {} for name in self.tx_m}
        self._new_powers = False
        self._lines_s: dict[str, float] = {}

    @_refusing
    def on_map(self, message: Any) -> None:
        """Take a `nav_msgs/OccupancyGrid`, which replaces a waiting one."""
        values, resolution_m, origin = occupancy_parts(message)
        self._take(message, values, resolution_m, origin)

    @_refusing
    def on_map_update(self, message: Any) -> None:
        """Take a `map_msgs/OccupancyGridUpdate` of the newest map."""
        last = self._newest
        if last is None:
            raise MapError("no map has come before it: it is waited for.")
        x, y, width, height = (int(getattr(message, name)) for name in ("x", "y", "width", "height"))
        ny, nx = last.percent.shape
        if min(x, y) < 0 or min(width, height) < 1 or x + width > nx or y + height > ny:
            raise MapError(f"{width} x {height} cells at ({x}, {y}) are not on the map of {nx} x {ny} cells.")
        part = grid_array("data", np.asarray(message.data).reshape(height, width), "iu").astype(np.int64)
        values = last.percent.astype(np.int64)
        values[y : y + height, x : x + width] = part
        self._take(message, values, last.resolution_m, last.origin)

    def _take(
        self, message: Any, values: NDArray[Any], resolution_m: float, origin: tuple[float, float, float]
    ) -> None:
        frame, stamp = _frame_and_stamp(message)
        if self.frame and frame != self.frame:
            raise MapError(f"frame_id = {shown(frame)}: the transmitters are given in {shown(self.frame)}.")
        last = self._newest
        age_s = 0.0 if last is None or not any(stamp) else _seconds(last.stamp) - _seconds(stamp)
        if 0.0 < age_s < LATE_S:
            raise MapError(f"it is {age_s:.2f} s older than the last one.")
        partial = map_of_percent(values, resolution_m, origin[:2], origin[2])
        number = 1 if last is None else last.number + 1
        grid = MapMessage(
            values.astype(np.int16), resolution_m, origin, frame, stamp, partial, number, time.monotonic()
        )
        if last is None or grid.key != last.key:
            with self._changed:
                self.frame, self._newest, self._waiting = frame, grid, grid
                self._changed.notify_all()

    @_refusing
    def on_pose(self, x_m: float, y_m: float, time_s: float) -> None:
        """Take position [m], in the frame of the map, and time of the robot."""
        values = tuple(map(number_of, (x_m, y_m, time_s)))
        if not all(map(math.isfinite, values)):
            raise PositionError(f"({shown(x_m)}, {shown(y_m)}) m at {shown(time_s)} s is no position.")
        self._pose = values  # type: ignore[assignment]

    @_refusing
    def on_power(self, power_dbm: float, time_s: float, name: str | None = None) -> None:
        """Take a received power [dBm] or path gain [dB] of a transmitter at the robot."""
        name = next(iter(self.tx_m)) if name is None and len(self.tx_m) == 1 else name
        if name not in self._powers:
            raise MeasurementError(f"of {shown(name)}: the transmitters are {', '.join(self.tx_m) or 'none yet'}.")
        gain_db, pose = number_of(power_dbm) - self.settings.tx_power_dbm, self._pose
        if pose is None or not 0.0 <= time_s - pose[2] <= POSE_AGE_S:
            raise MeasurementError("the robot's position is not known: it is read from the transforms.")
        z_m = self.settings.rx_height_m
        if not Measurements(None, [(*pose[:2], z_m)], [gain_db]).is_outage.any():  # type: ignore[arg-type, list-item]
            with self._changed:
                kept, cell = self._powers[name], (int(pose[0] // POWER_CELL_M), int(pose[1] // POWER_CELL_M))
                kept.pop(cell, None)
                kept[cell] = (*pose[:2], gain_db)
                for oldest in [*kept][:-MOST_POWERS]:
                    del kept[oldest]
                self._new_powers = True

    @_refusing
    def on_connection(self, message: Any, time_s: float, name: str | None = None) -> None:
        """Take a `wireless_msgs/Connection`: power, frequency, and access point, which is added if it has no name."""
        if not message.bssid or not message.frequency > 0.0:
            raise MeasurementError("it has no access point or frequency: the robot is not connected.")
        frequency_hz = number_of(message.frequency)
        frequency_hz *= 1e9 if frequency_hz < 1e3 else 1e6 if frequency_hz < 1e6 else 1.0  # iwconfig: GHz; iw: MHz
        given = self._model_settings.get("trace_settings") or TraceSettings()
        if self._await_frequency:
            self._model_settings["trace_settings"] = replace(given, frequency_hz=frequency_hz)
            self._await_frequency = False
        elif not math.isclose(frequency_hz, given.frequency_hz, rel_tol=SAME_BAND):
            raise MeasurementError(f"at {frequency_hz / 1e9:g} GHz: grids are at {given.frequency_hz / 1e9:g} GHz.")
        if name is None and self._finds:
            name = f"ap_{re.sub('[^0-9a-f]', '', message.bssid.lower())}"
            if name not in self.tx_m:
                require(len(self.tx_m) < MOST_ACCESS_POINTS, "access point", name, f"{len(self.tx_m)} are located.")
                self._add({name: None})
        name = next(iter(self.tx_m)) if name is None and len(self.tx_m) == 1 else name
        known = self._access_points.setdefault(str(name), message.bssid)
        if known != message.bssid:
            raise MeasurementError(f"{name} is the access point {known}: powers of {message.bssid} are not used.")
        self.on_power(message.signal_level, time_s, name)

    @_refusing
    def on_transmitter(self, name: str, position_m: ArrayLike | None) -> None:
        """Add, move or (None) remove a transmitter, and forget its measured powers."""
        if position_m is None and name not in self.tx_m:
            raise PositionError(f"{shown(name)} is not known: the transmitters are {', '.join(self.tx_m)}.")
        self._add({} if position_m is None else _named_positions({name: position_m}), without=name)

    def _add(self, added: dict[str, Floats | None], without: str = "") -> None:
        with self._changed:
            self.tx_m = {known: at_m for known, at_m in self.tx_m.items() if known != without} | added
            self._powers = {name: {} if name in added else self._powers[name] for name in self.tx_m}
            self._waiting, self._answered = self._newest, 0
            self._changed.notify_all()

    def report(self, line: str) -> None:
        """Log a refusal, at most once a minute."""
        now_s = time.monotonic()
        if now_s - self._lines_s.get(line, -math.inf) >= REPEATED_S:
            self._lines_s.pop(line, None)
            self._lines_s = dict([*self._lines_s.items()][-MOST_LINES:]) | {line: now_s}
            _log.warning("%s", line)


def _named_positions(tx: ArrayLike | Mapping[str, ArrayLike | None] | None) -> dict[str, Floats | None]:
    found: dict[str, Floats | None] = {}
    for name, position in (tx if isinstance(tx, Mapping) else {"tx": tx}).items():
        if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,60}", name)):
            raise SettingsError(f"tx has the name {shown(name)}: give a letter, then letters, digits or _.")
        found[name] = None
        if position is not None:
            values = with_height(float_array(f"tx {name}", position, PositionError, "give x, y and z in metres."))
            if values.shape != (3,) or not np.isfinite(values).all():
                raise PositionError(f"tx {name} = {shown(position)} is no position: give x, y and z in metres.")
            found[name] = values
    return found


def _frame_and_stamp(message: Any) -> tuple[str, tuple[int, int]]:
    """Return frame and stamp (seconds, nanoseconds), which may be missing."""
    header = getattr(message, "header", None)
    stamp = getattr(header, "stamp", None)
    seconds, nanoseconds = (
        next((int(getattr(stamp, name)) for name in names if hasattr(stamp, name)), 0)
        for names in (("sec", "secs"), ("nanosec", "nsecs"))
    )
    if not (-(2**31) <= seconds < 2**32 and 0 <= nanoseconds < 2**32):
        raise MapError(
            f"header.stamp = ({shown(seconds)}, {shown(nanoseconds)}) is no time: give seconds, nanoseconds."
        )
    return str(getattr(header, "frame_id", "")).lstrip("/"), (seconds, nanoseconds)


def _seconds(stamp: tuple[int, int]) -> float:
    return stamp[0] + stamp[1] / 1e9
