"""LiveCoverage: messages of a robot -> coverage of its newest map, coarse, then fine."""

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
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter

from sionna_partial.apps.live.answers import LiveAnswer, LiveGrid, LiveTransmitter, LiveViews, MapMessage
from sionna_partial.apps.refining import GivenWay, Pass, coarse_then_fine
from sionna_partial.arrays import Floats
from sionna_partial.checks import (
    Checked,
    Within,
    float_array,
    no_progress,
    number_of,
    reason_of,
    require,
    settings_or_default,
    shown,
    with_height,
)
from sionna_partial.constants import COST_THRESHOLD_DB, DEFAULT_HEIGHT_M, GAIN_FLOOR_DB, MAX_COST, CellState
from sionna_partial.coverage.dataset import probability_above
from sionna_partial.coverage.grid import grid_axes
from sionna_partial.coverage.job import predict_map
from sionna_partial.errors import MapError, MeasurementError, PositionError, SettingsError, SionnaPartialError
from sionna_partial.exploration.next_views import next_views
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.environment import grid_array
from sionna_partial.maps.grid import nearest_free_m
from sionna_partial.maps.importers.bags import map_of_percent, occupancy_parts
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.selection import can_be_used
from sionna_partial.prediction.unobserved import lengths_in_unknown_m, walled_lengths_m
from sionna_partial.settings import SceneSettings, TraceSettings

LATE_S = 30.0
"""Maps older than the last by less are dropped; by more, the clock was restarted [s]."""

POSE_AGE_S = 2.0

BETWEEN_DB = 6.0
"""Difference of gains behind walls that paths go through, within two receivers of a coarse grid [dB]."""

SAME_BAND = 0.15
"""Relative difference of frequencies up to which powers are used."""

POWER_CELL_M = 0.25
"""Edge of squares that keep the newest power of a transmitter [m]."""

MOST_POWERS = 500

LEAST_POWERS = 5
"""Number of measured powers from which a transmitter is located."""

MOST_ACCESS_POINTS = 8
"""Number of access points that are located by themselves."""

SEARCH_M = 5.0
"""Distance outside the map at which access points are searched: they may be where the robot has not been yet [m]."""

FARTHEST_M = 200.0
"""Distance from the map up to which the map is extended with unknown cells to a transmitter [m]."""

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
    >>> from sionna_partial.apps.live.coverage import LiveSettings
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
    def take(self: "LiveCoverage", *given: Any, **named: Any) -> None:
        what = method.__name__.removeprefix("on_").replace("_", " ")
        try:
            method(self, *given, **named)
        except SionnaPartialError as error:
            self.report(f"{what} refused: {error}")
        except Exception as error:  # messages may hold anything
            self.report(f"{what} refused: it is ill-formed ({type(error).__name__}: {shown(str(error))}).")

    return take


class LiveCoverage:
    """Coverage of the newest map of a robot, for any transport.

    Any thread may pass messages; newer maps replace each other while one is computed. `start` computes in a thread,
    `step` in the calling one. Refused messages are logged.

    Every grid has the cells of the newest map: nav2 resizes its costmap to a grid of another size, and forgets walls.

    Parameters
    ----------
    tx : (3,) array-like, None, or mapping of names to them
        Transmitter positions [m], in the frame of the map, up to 200 m outside it; None if measured powers shall locate
        the transmitter. An empty mapping locates the access points that connections name.
    publish : callable
        Called with each `LiveGrid`, `LiveTransmitter` and `LiveViews`.
    settings : LiveSettings, optional
    await_frequency : bool
        Whether the carrier frequency comes with the first message of a connection instead of `trace_settings`.
    **model
        `predictor`, `trace_settings` (28 GHz by default) and `scene_settings` of `LinkModel`.

    Raises
    ------
    PositionError, SettingsError
        For invalid positions, or names that no topic can have.

    Examples
    --------
    >>> from types import SimpleNamespace as Message
    >>> from sionna_partial.apps.live.coverage import LiveCoverage, LiveSettings
    >>> grids = []
    >>> live = LiveCoverage((1.5, 1.5, 1.5), grids.append, LiveSettings(spacing_m=0.5))
    >>> origin = Message(position=Message(x=0.0, y=0.0), orientation=Message(x=0.0, y=0.0, z=0.0, w=1.0))
    >>> info = Message(resolution=1.0, width=4, height=3, origin=origin)
    >>> live.on_map(Message(info=info, data=[100, 100, 100, 100, 100, 0, 0, 100, 100, 100, 100, 100]))
    >>> live.step()
    True
    >>> grids[-1].is_final, grids[-1].cost.tolist()
    (True, [[-1, -1, -1, -1], [-1, 0, 0, -1], [-1, -1, -1, -1]])
    """

    def __init__(
        self,
        tx: ArrayLike | Mapping[str, ArrayLike | None] | None,
        publish: Callable[[LiveAnswer], None],
        settings: LiveSettings | None = None,
        *,
        await_frequency: bool = False,
        **model: Any,
    ) -> None:
        self.settings = settings_or_default("settings", settings, LiveSettings)
        self.tx_m = _named_positions(tx)
        self._finds, self._access_points = not self.tx_m, dict[str, str]()
        self._publish, self._model_settings, self._await_frequency = publish, model, await_frequency
        for name, kind in (("trace_settings", TraceSettings), ("scene_settings", SceneSettings)):
            settings_or_default(name, model.get(name), kind)
        self._model: LinkModel | None = None
        self._changed = threading.Condition()
        self._closed = False
        self._newest: MapMessage | None = None
        self._waiting: MapMessage | None = None
        self._answered, self._gave_way, self._stepped_s = 0, True, -math.inf  # the first final grid gives no way
        self.frame = self.settings.frame.lstrip("/")
        self._pose: tuple[float, float, float] | None = None
        self._powers: dict[str, dict[tuple[int, int], tuple[float, float, float]]] = {name: {} for name in self.tx_m}
        self._new_powers, self._views_wanted, self._views_s = False, False, -math.inf
        self._published: dict[str, LiveGrid] = {}
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

    def request_views(self) -> None:
        """Request the best next views once."""
        with self._changed:
            self._views_wanted = True
            self._changed.notify_all()

    def run(self) -> None:
        """Compute maps until `close` is called and none is waiting."""
        if self._waiting is None and not self._closed:
            self._guarded("", self._warm_up)
        while self.step() or not self._closed:
            with self._changed:
                if self._waiting is None and not self._closed:
                    self._changed.wait(0.2)

    def _warm_up(self) -> None:
        """Load libraries, networks and kernels before the first map comes."""
        room = PartialMap(np.array([[1, 1, 1, 1], [1, 0, 0, 2], [1, 1, 1, 1]], dtype=np.uint8), 1.0)
        predict_map(LinkModel(room, **self._model_settings), (1.5, 1.5, 1.5), spacing_m=0.5)

    def start(self) -> threading.Thread:
        """Call `run` in a thread."""
        thread = threading.Thread(target=self.run, name="live coverage", daemon=True)
        thread.start()
        return thread

    def close(self) -> None:
        """End `run` after the current and the waiting map, and the last powers."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def step(self) -> bool:
        """Answer the newest map if it or its powers are new; return whether it was."""
        with self._changed:
            if self._await_frequency:
                if self._waiting is not None:
                    self.report("the map waits for a connection, which has the carrier frequency.")
                return False
            now_s, grid = time.monotonic(), self._waiting
            is_due = self._closed or now_s - self._stepped_s >= self.settings.refresh_s
            if grid is None and self._new_powers and is_due:
                grid = self._newest
            self._waiting, every_s = None, self.settings.views_every_s
            wanted = self._views_wanted or 0.0 < every_s <= now_s - self._views_s
            views = wanted and self._newest is not None and bool(self.tx_m)
        if grid is not None:
            self._new_powers = False
            self._guarded("map", self._compute, grid)
            self._stepped_s = time.monotonic()
        if views and self._model is not None:
            self._views_wanted, self._views_s = False, now_s
            self._guarded("next views", self._compute_views)
        return grid is not None or views

    def report(self, line: str) -> None:
        """Log a refusal, at most once a minute."""
        now_s = time.monotonic()
        if now_s - self._lines_s.get(line, -math.inf) >= REPEATED_S:
            self._lines_s.pop(line, None)
            self._lines_s = dict([*self._lines_s.items()][-MOST_LINES:]) | {line: now_s}
            _log.warning("%s", line)

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

    def _guarded(self, what: str, compute: Callable[..., None], *given: Any) -> None:
        """Compute, and log failures; "" is a coarse answer, which the final one follows."""
        try:
            compute(*given)
        except GivenWay:
            raise
        except Exception as error:  # whatever it is, the next map may be answered
            if what:
                self.report(f"{what} not answered: {reason_of(error)}")

    def _compute(self, grid: MapMessage) -> None:
        partial = self._extended(grid.partial)
        if self._model is None:
            self._model = LinkModel(partial, **self._model_settings)
        self._model.update(partial)
        coarse, fine = coarse_then_fine(self.settings.spacing_m, fine=no_progress if self._gave_way else self._give_way)
        if grid.number != self._answered:
            self._answered = grid.number
            self._clear_removed()
            self._answer_each(grid, coarse)
        try:  # once a newer map comes first, and then not, so that there is a fine answer now and then
            self._gave_way = False
            self._answer_each(grid, fine)
        except GivenWay:
            self._gave_way = True

    def _extended(self, partial: PartialMap) -> PartialMap:
        """Return the map with unknown cells up to the transmitters: space outside a map is unknown."""
        low, high = bounds_m = np.reshape(partial.bounds_m, (2, 2))
        for tx_m in self.tx_m.values():
            if tx_m is None and not partial.is_nearly_complete:
                low, high = np.minimum(low, bounds_m[0] - SEARCH_M), np.maximum(high, bounds_m[1] + SEARCH_M)
            elif tx_m is not None and _beyond_m(partial, tx_m) <= FARTHEST_M:
                low, high = np.minimum(low, tx_m[:2]), np.maximum(high, tx_m[:2])
        cells = np.ceil(np.array([bounds_m[0] - low, high - bounds_m[1]]) / partial.resolution_m - 1e-6).astype(int)
        if not cells.any():
            return partial
        cells += 1  # no radio is on an edge
        (left, below), (right, above) = cells.tolist()
        ny, nx = partial.shape
        return partial.window(-below, -left, (below + ny + above, left + nx + right), CellState.UNKNOWN)

    def _clear_removed(self) -> None:
        for name in self._published.keys() - self.tx_m.keys():
            last = self._published.pop(name)
            with self._changed:
                newest = self._newest
                assert newest is not None
                nothing = np.full(newest.percent.shape, -1, dtype=np.int8)
                empty = last._replace(cost=nothing, unknown_cost=nothing, is_final=True)
                self._publish(empty._replace(header=newest.header, info=newest.info))

    def _give_way(self, fraction: float, message: str) -> None:
        if self._waiting is not None:
            raise GivenWay

    def _answer_each(self, grid: MapMessage, wanted: Pass) -> None:
        for name, tx_m in self.tx_m.items():
            self._guarded(f"map for {name}" if wanted.is_final else "", self._answer, grid, name, tx_m, wanted)

    def _answer(self, grid: MapMessage, name: str, tx_m: Floats | None, wanted: Pass) -> None:
        assert self._model is not None
        measured = self._measured(name, tx_m)
        if tx_m is None and (measured is None or not wanted.is_final):
            return
        beyond_m = 0.0 if tx_m is None else _beyond_m(grid.partial, tx_m)
        if beyond_m > FARTHEST_M:
            remedy = f"more than {FARTHEST_M:g} m: check its unit and its frame."
            raise PositionError(f"tx {name} is {beyond_m:.0f} m outside the map, {remedy}")
        coverage = predict_map(
            self._model,
            tx_m,
            spacing_m=wanted.spacing_m,
            rx_height_m=self.settings.rx_height_m,
            area_m=grid.partial.bounds_m,
            receivers="near" if wanted.is_final and not self.settings.every_unknown else "indoor",
            measurements=measured,
            progress=wanted.report,
        )
        receivers = self._receivers(grid.partial, coverage, None if wanted.is_final else tx_m)
        with self._changed:  # no newer map comes before the grid is published
            newest = self._newest
            if newest is None or name not in self.tx_m or self.tx_m[name] is not tx_m:
                return  # it was moved meanwhile
            cost, unknown = newest.costs(*receivers, self.settings.max_cost)
            age_s = time.monotonic() - grid.came_s
            answer = LiveGrid(
                name, grid.number, wanted.is_final, coverage, cost, unknown, newest.header, newest.info, age_s
            )
            self._published[name] = answer
            self._publish(answer)
            if tx_m is None:
                self._publish(_located(name, coverage, newest.header))

    def _receivers(
        self, partial: PartialMap, coverage: xr.Dataset, tx_m: Floats | None
    ) -> tuple[tuple[Floats, Floats], float, Floats]:
        """Return axes, spacing and P(too small a gain) of receivers; with `tx_m` bounds for a final grid."""
        axes_m, spacing_m = (coverage["y"].to_numpy(), coverage["x"].to_numpy()), float(coverage.attrs["spacing_m"])
        if tx_m is None:
            return axes_m, spacing_m, 1.0 - probability_above(coverage, self.settings.threshold_db)
        assert self._model is not None
        x_m, y_m = grid_axes(partial, self.settings.spacing_m)
        near = [
            np.clip(np.rint((fine_m - coarse_m[0]) / spacing_m).astype(int), 0, len(coarse_m) - 1)
            for fine_m, coarse_m in zip((y_m, x_m), axes_m, strict=True)
        ]

        def largest(size: int, margin_db: float) -> Floats:
            above = probability_above(coverage, min(self.settings.threshold_db + margin_db, 0.0))
            p_below = maximum_filter(np.nan_to_num(1.0 - above, nan=-1.0), size=size, mode="nearest")[np.ix_(*near)]
            return np.where(p_below < 0.0, 1.0, p_below)

        bound = largest(3, 0.0)
        rx_m = np.stack([*np.meshgrid(x_m, y_m), np.full(bound.shape, self.settings.rx_height_m)], axis=-1)
        line_m = np.broadcast_to(tx_m, rx_m.shape).reshape(-1, 3), rx_m.reshape(-1, 3)
        hidden = walled_lengths_m(self._model.partial, *line_m) > 0.0
        hidden |= lengths_in_unknown_m(self._model.partial, *line_m) > 0.0
        # behind opaque walls, a reflection may end between two receivers
        behind = largest(5, BETWEEN_DB) if self._model.simulation.trace_settings.through_walls else 1.0
        return (y_m, x_m), self.settings.spacing_m, np.where(hidden.reshape(bound.shape), behind, bound)

    def _measured(self, name: str, tx_m: Floats | None) -> Measurements | None:
        with self._changed:
            rows = np.array([*self._powers.get(name, {}).values()]).reshape(-1, 3)
        if not len(rows):
            return None
        assert self._model is not None
        rx_m = np.column_stack([rows[:, :2], np.full(len(rows), self.settings.rx_height_m)])
        partial = self._model.partial
        usable = partial.radios_can_stand(rx_m)
        frequency_hz = self._model.simulation.trace_settings.frequency_hz
        sources_m = np.empty((0, 3)) if tx_m is None else tx_m[None]
        usable[usable] = can_be_used(partial, sources_m, rx_m[usable], frequency_hz)
        enough = usable.sum() >= (LEAST_POWERS if tx_m is None else 1)
        return Measurements(tx_m, rx_m[usable], rows[usable, 2]) if enough else None  # type: ignore[arg-type]

    def _compute_views(self) -> None:
        assert self._model is not None
        grid = self._newest
        assert grid is not None
        known = {name: at_m for name, at_m in self.tx_m.items() if at_m is not None}
        found = {name: last.coverage.attrs["transmitter_m"] for name, last in self._published.items()}
        tx_m = np.array([*(found | known).values()]) if found | known else None
        # the nearest free cell: a pose in a wall is an error of the robot's localisation
        starts_m = [] if self._pose is None else [*nearest_free_m(self._model.partial, self._pose[:2])]
        start = starts_m[0] if starts_m else None
        views = next_views(self._model, tx_m, start=start, threshold_db=self.settings.threshold_db)
        self._publish(LiveViews(views, grid.header))


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


def _beyond_m(partial: PartialMap, tx_m: Floats) -> float:
    """Return how far a position is outside the map along x or y [m]."""
    low, high = np.reshape(partial.bounds_m, (2, 2))
    return float(max((low - tx_m[:2]).max(), (tx_m[:2] - high).max(), 0.0))


def _located(name: str, coverage: xr.Dataset, header: dict[str, Any]) -> LiveTransmitter:
    x_m, y_m, probability = (coverage[key].to_numpy() for key in ("tx_x", "tx_y", "p_transmitter"))
    return LiveTransmitter(name, np.asarray(coverage.attrs["transmitter_m"]), x_m, y_m, probability, header)


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
