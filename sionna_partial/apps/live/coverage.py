"""LiveCoverage: messages of a robot -> coverage of its newest map, coarse, then fine."""

import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter

from sionna_partial.apps.live.answers import LiveAnswer, LiveGrid, LiveTransmitter, LiveViews, MapMessage
from sionna_partial.apps.live.incoming import Incoming
from sionna_partial.apps.live.incoming import LiveSettings as LiveSettings
from sionna_partial.apps.refining import GivenWay, Pass, coarse_then_fine
from sionna_partial.arrays import Floats
from sionna_partial.checks import no_progress, reason_of
from sionna_partial.constants import CellState
from sionna_partial.coverage.dataset import probability_above
from sionna_partial.coverage.grid import grid_axes
from sionna_partial.coverage.job import predict_map
from sionna_partial.errors import PositionError
from sionna_partial.exploration.next_views import next_views
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.grid import nearest_free_m
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.selection import can_be_used
from sionna_partial.prediction.unobserved import lengths_in_unknown_m, walled_lengths_m

BETWEEN_DB = 6.0
"""Difference of gains behind walls that paths go through, within two receivers of a coarse grid [dB]."""

LEAST_POWERS = 5
"""Number of measured powers from which a transmitter is located."""

SEARCH_M = 5.0
"""Distance outside the map at which access points are searched: they may be where the robot has not been yet [m]."""

FARTHEST_M = 200.0
"""Distance from the map up to which the map is extended with unknown cells to a transmitter [m]."""


class LiveCoverage(Incoming):
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
        super().__init__(tx, settings, model, await_frequency=await_frequency)
        self._publish = publish
        self._model: LinkModel | None = None
        self._closed = False
        self._gave_way, self._stepped_s = True, -math.inf  # the first final grid gives no way
        self._views_wanted, self._views_s = False, -math.inf
        self._published: dict[str, LiveGrid] = {}

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


def _beyond_m(partial: PartialMap, tx_m: Floats) -> float:
    """Return how far a position is outside the map along x or y [m]."""
    low, high = np.reshape(partial.bounds_m, (2, 2))
    return float(max((low - tx_m[:2]).max(), (tx_m[:2] - high).max(), 0.0))


def _located(name: str, coverage: xr.Dataset, header: dict[str, Any]) -> LiveTransmitter:
    x_m, y_m, probability = (coverage[key].to_numpy() for key in ("tx_x", "tx_y", "p_transmitter"))
    return LiveTransmitter(name, np.asarray(coverage.attrs["transmitter_m"]), x_m, y_m, probability, header)
