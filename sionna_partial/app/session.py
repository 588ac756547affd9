"""One window of the app without its page: map, transmitters, settings, jobs that can be cancelled, newest answer."""

import functools
import io
import itertools
import logging
import math
import re
import tempfile
import threading
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Annotated, Any

import numpy as np
import xarray as xr

from sionna_partial.arrays import Floats
from sionna_partial.checks import Checked, Progress, Within, require, require_choice, shown
from sionna_partial.constants import (
    BAG_SUFFIXES,
    CARRIER_FREQUENCY_HZ,
    DEFAULT_HEIGHT_M,
    DRAWING_SUFFIXES,
    GAIN_FLOOR_DB,
    IFC_SUFFIXES,
    MESH_SUFFIXES,
    POINT_SUFFIXES,
    CellState,
)
from sionna_partial.coverage.dataset import COMPONENTS, DISTRIBUTION
from sionna_partial.coverage.network import network_map
from sionna_partial.errors import MapError, PositionError, SettingsError, SionnaPartialError
from sionna_partial.exploration.explore import explore_trajectory
from sionna_partial.exploration.next_views import NextViews, next_views
from sionna_partial.export import save_coverage, save_network
from sionna_partial.files import unzipped
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.ros_map import read_ros_map
from sionna_partial.measurements.measurements import SAME_TX_M, Measurements, load_measurements
from sionna_partial.placement.placement import place_transmitter
from sionna_partial.plots.coverage_plot import report_pdf
from sionna_partial.prediction.predictor import LinkPrediction
from sionna_partial.progress import part_of
from sionna_partial.resources import demo_homes, scenes_folder
from sionna_partial.settings import FREQUENCIES_HZ, TraceSettings
from sionna_partial.tracing.antennas import Antenna

COARSER = 4
"""Distance between the receivers of the first picture, in those of the final one."""

MOST_BYTES = 200_000_000
"""Size of the files that are uploaded together [bytes]."""

MOST_TRANSMITTERS = 10
"""Number of transmitters of one window."""

FIRST_STEPS, MORE_STEPS = 100, 50
"""Steps of the simulated robot when an example is opened, and at each request."""

FILES = {
    "png": "coverage.png",
    "html": "coverage.html",
    "nc": "coverage.nc",
    "tif": "coverage.tif",
    "yaml": "radio_map.zip",
    "pdf": "report.pdf",
}
"""Kinds of files that can be downloaded, and their names."""

_FINEST_M, _MOST_RECEIVERS = 0.15, 30_000

_IMAGES, _SHEETS = (".pgm", ".png", ".bmp"), (".yaml", ".yml")

MAP_SUFFIXES = (*_SHEETS, ".npz", *MESH_SUFFIXES, *POINT_SUFFIXES, *DRAWING_SUFFIXES, *IFC_SUFFIXES, *BAG_SUFFIXES)
"""Maps that can be uploaded; a ROS map with its image, or as a zip of both."""

_ONE_AT_A_TIME = ThreadPoolExecutor(1, "coverage of the app")
"""Windows take turns: one picture each."""

_log = logging.getLogger(__name__)


class _CancelledError(Exception):
    """A job that is not wanted any more."""


@dataclass(frozen=True)
class Transmitter(Checked):
    """Where a transmitter stands [m], its power [dBm], and its antenna, whose gain comes on top."""

    x_m: Annotated[float, Within(-1e6, 1e6)]
    y_m: Annotated[float, Within(-1e6, 1e6)]
    z_m: Annotated[float, Within(0.0, 1000.0)] = DEFAULT_HEIGHT_M
    eirp_dbm: Annotated[float, Within(-200.0, 200.0)] = 20.0
    antenna: Antenna = field(default_factory=Antenna)

    @property
    def position_m(self) -> tuple[float, float, float]:
        """World x, y and z [m]."""
        return self.x_m, self.y_m, self.z_m


@dataclass(frozen=True)
class RadioSettings(Checked):
    """What is predicted, and how densely."""

    frequency_hz: Annotated[float, Within(*FREQUENCIES_HZ)] = CARRIER_FREQUENCY_HZ
    through_walls: bool | None = None
    rx_height_m: Annotated[float, Within(0.0, 1000.0)] = DEFAULT_HEIGHT_M
    spacing_m: Annotated[float, Within(0.02, 10.0)] = _FINEST_M
    bandwidth_hz: Annotated[float, Within(1e3, 1e11)] = 100e6
    threshold_dbm: Annotated[float, Within(-200.0, 100.0)] = -80.0

    @property
    def trace_settings(self) -> TraceSettings:
        """The settings of the trace."""
        return TraceSettings(self.frequency_hz, refraction=self.through_walls)


@dataclass(frozen=True, eq=False)
class Answer:
    """Coverage of all transmitters on (tx, y, x), of several their network, and the same in the home as it is."""

    coverage: xr.Dataset
    eirp_dbm: Floats
    settings: RadioSettings
    is_final: bool
    network: xr.Dataset | None = None
    truth: xr.Dataset | None = None

    def layers_of(self, name: str, threshold_dbm: float, *, truth: bool = False) -> xr.Dataset:
        """Return variables (y, x) of a transmitter, or of the strongest for "": those of `predict_map` and radio.

        `power_mean_dbm`, `snr_mean_db`, `p_above` (the received power exceeds the threshold), and of several
        transmitters `sinr_mean_db` and `best_server`.
        """
        coverage = self.truth if truth and self.truth is not None else self.coverage
        radio, eirp_dbm = coverage.radio, self.eirp_dbm
        power = radio.power(eirp_dbm=eirp_dbm)
        snr = radio.snr(eirp_dbm=eirp_dbm, bandwidth_hz=self.settings.bandwidth_hz)
        every = coverage.assign(power.data_vars).assign(snr.data_vars)
        best = np.nan_to_num(power["power_mean_dbm"].to_numpy(), nan=-np.inf).argmax(axis=0)
        names = [str(each) for each in coverage["tx"].to_numpy()]
        at = xr.DataArray(best, dims=("y", "x")) if name not in names else names.index(name)
        one = every.isel(tx=at)
        columns = {each: one[each].to_numpy() for each in (*DISTRIBUTION, *COMPONENTS)}
        threshold_db = np.clip(threshold_dbm - eirp_dbm, GAIN_FLOOR_DB, 0.0)[at]
        above = LinkPrediction(**columns).probability_above(threshold_db)
        found: dict[str, Any] = {"p_above": (("y", "x"), above)}
        if self.network is not None:
            found |= {"best_server": (("y", "x"), best), "sinr_mean_db": self.network["sinr_mean_db"]}
        return one.assign(found)

    def agreement(self) -> tuple[float, float] | None:
        """Return how many of the likeliest states on the free floor of the home are true [1], and the RMSE [dB]."""
        if self.truth is None:
            return None
        here = (self.truth["valid"] & self.coverage["valid"]).to_numpy() == 1
        here &= self.truth["cell_state"].to_numpy() == CellState.FREE
        states, gains_db = (
            [each[name].to_numpy()[here] for each in (self.coverage, self.truth)]
            for name in ("link_state", "gain_mean_db")
        )
        if not here.any():
            return None
        return float((states[0] == states[1]).mean()), math.sqrt(float(np.mean((gains_db[0] - gains_db[1]) ** 2)))


@dataclass(frozen=True)
class Status:
    """What the page shows: a message, the fraction of the work that is done or None, and whether it is an error."""

    message: str = ""
    fraction: float | None = None
    is_error: bool = False


class _Job:
    """A piece of work, which ends at its next report when it is cancelled."""

    def __init__(self, tell: Callable[["_Job", float, str], None]) -> None:
        self.is_cancelled = threading.Event()
        self._tell = tell

    def report(self, fraction: float, message: str) -> None:
        if self.is_cancelled.is_set():
            raise _CancelledError
        self._tell(self, fraction, message)


class Session:
    """State of one window. Its methods are called in one thread; what takes time is computed in another.

    A new job cancels the one before it: what that has found is dropped, so that no answer follows that of a newer job.

    Parameters
    ----------
    call : callable
        Runs a function in the thread of the session; called in any thread.
    show : callable
        Called in that thread when something has changed.
    """

    def __init__(self, call: Callable[[Callable[[], None]], object], show: Callable[[], None]) -> None:
        self._call, self._show = call, show
        self._waiting: deque[Callable[[], None]] = deque()
        self._job: _Job | None = None
        self._models: dict[str, LinkModel] = {}
        self.partial: PartialMap | None = None
        self.home: PartialMap | None = None
        self.title, self.steps, self._seed = "", 0, 0
        self._python_map: list[str] = []
        self.transmitters: dict[str, Transmitter] = {}
        self.chosen = ""
        self.settings = RadioSettings()
        self.measured: Measurements | None = None
        self.answer: Answer | None = None
        self._is_outdated = False
        self.views: NextViews | None = None
        self.status = Status()

    def do(self, function: Callable[[], None]) -> None:
        """Run a function in the thread of the session, after those that wait; called in any thread."""
        self._waiting.append(function)
        self._call(self._do_all)

    def _do_all(self) -> None:
        while self._waiting:
            self._waiting.popleft()()

    def close(self) -> None:
        """Cancel what is computed, and compute nothing any more."""
        self.cancel()
        self._call = lambda function: None

    def cancel(self) -> None:
        """End the job, if there is one."""
        if self._job is not None:
            self._job.is_cancelled.set()
            self._job = None
            self._conclude(Status("Cancelled."))

    def refuse(self, error: object) -> None:
        """Show why something was not done."""
        self.status = Status(str(error), is_error=True)
        self._show()

    # Maps

    def open_map(self, partial: PartialMap, title: str) -> None:
        """Take a map, with no transmitter yet."""
        self._take_map(partial, title, [f"partial = sp.load_map({title!r})"])
        self.home = None
        self.predict()

    def open_example(self, name: str) -> None:
        """Open a demo home as a robot has seen it after some steps, with its transmitter."""
        require_choice("home", name, demo_homes())

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"opening the {name}")
            home, details = load_map(scenes_folder() / name / "complete" / "map.yaml"), demo_homes()[name]
            yield functools.partial(self._enter, name, home, int(details["exploration_seed"]), details["transmitter"])

        self.begin(work)

    def _enter(self, name: str, home: PartialMap, seed: int, tx_m: Sequence[float]) -> None:
        self.title, self.home, self.steps, self._seed = name, home, 0, seed
        x_m, y_m, z_m = tx_m
        self.transmitters, self.chosen, self.measured = {"tx1": Transmitter(x_m, y_m, z_m)}, "tx1", None
        self.explore_more(FIRST_STEPS)

    def explore_more(self, steps: int = MORE_STEPS) -> None:
        """Let the simulated robot go on, and predict from what it has seen then."""
        home, name, seed, total = self.home, self.title, self._seed, self.steps + steps
        if home is None:
            raise SettingsError(
                "the robot explores the examples alone: open one, as what is not on a map is not known."
            )

        def take(partial: PartialMap) -> None:
            lines = [
                f'home = sp.load_map("scenes/{name}/complete/map.yaml")',
                f"partial = sp.explore(home, steps=({total},), seed={seed})[0]",
            ]
            transmitters, measured = self.transmitters, self.measured
            self._take_map(partial, name, lines)
            self.steps, self.transmitters, self.measured = total, transmitters, measured
            self.chosen = next(iter(transmitters), "")
            self.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            partial = explore_trajectory(home, (total,), seed, progress=report).maps[0]
            yield functools.partial(take, partial)

        self.begin(work)

    def upload_map(self, files: Sequence[tuple[str, bytes]]) -> None:
        """Read a map of files (name, content)."""
        title = next((PurePath(name).name for name, _ in files), "")

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"reading {title}")
            with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
                path = stored_map(files, Path(folder))
                partial = read_ros_map(path, confined=True) if path.suffix in _SHEETS else load_map(path)
            yield functools.partial(self.open_map, partial, title)

        self.begin(work)

    def _take_map(self, partial: PartialMap, title: str, python: list[str]) -> None:
        self.partial, self.title, self._python_map = partial, title, python
        self.transmitters, self.chosen, self.measured, self.views, self.answer = {}, "", None, None, None
        x0, y0, x1, y1 = partial.bounds_m
        steps = math.ceil(math.sqrt((x1 - x0) * (y1 - y0) / _MOST_RECEIVERS) / 0.05)
        self.settings = replace(self.settings, spacing_m=max(_FINEST_M, round(0.05 * steps, 2)))

    # Transmitters and settings

    def put(self, positions: Sequence[tuple[str, float, float]]) -> None:
        """Take the transmitters (name, x, y) [m] of the picture; a new one has no name yet."""
        if len(positions) > MOST_TRANSMITTERS:
            raise SettingsError(f"there are {MOST_TRANSMITTERS} transmitters already: remove one first.")
        found: dict[str, Transmitter] = {}
        for name, x_m, y_m in positions:
            old = self.transmitters.get(name)
            name = name if old else self._new_name([*self.transmitters, *found])
            x_m, y_m = round(float(x_m), 2), round(float(y_m), 2)
            if old is None or (x_m, y_m) != (old.x_m, old.y_m):
                self.chosen = name
            found[name] = replace(old, x_m=x_m, y_m=y_m) if old else Transmitter(x_m, y_m)
        self._take_transmitters(found)

    def add(self) -> None:
        """Put a transmitter into the middle of the free cell that is nearest to that of the map."""
        partial = self._map()
        free = np.argwhere(partial.state == CellState.FREE)
        require(len(free) > 0, "free cells", 0, "give a map with some.")
        row, column = free[np.abs(free - free.mean(axis=0)).sum(axis=1).argmin()]
        x_m, y_m = (o + (n + 0.5) * partial.resolution_m for o, n in zip(partial.origin_m, (column, row), strict=True))
        self.put([*((name, each.x_m, each.y_m) for name, each in self.transmitters.items()), ("", x_m, y_m)])

    def change(self, name: str, new_name: str | None = None, **values: Any) -> None:
        """Change a transmitter, and its name."""
        require_choice("transmitter", name, self.transmitters)
        new_name = name if new_name is None else new_name.strip()
        good = re.fullmatch(r"[A-Za-z][\w-]{0,30}", new_name, re.ASCII)
        require(bool(good), "name", new_name, "give a letter, then letters, digits, _ or -, up to 31 in all.")
        require(new_name == name or new_name not in self.transmitters, "name", new_name, "another one has it.")
        changed = replace(self.transmitters[name], **values)
        self.chosen = new_name if self.chosen == name else self.chosen
        self._take_transmitters(
            {
                new_name if each == name else each: changed if each == name else old
                for each, old in self.transmitters.items()
            }
        )

    def remove(self, name: str) -> None:
        """Take a transmitter away."""
        self._take_transmitters({each: old for each, old in self.transmitters.items() if each != name})

    def set(self, **values: Any) -> None:
        """Change settings; all but the threshold are of the prediction."""
        self.settings = replace(self.settings, **values)
        if values.keys() <= {"threshold_dbm"}:
            self._show()
        else:
            self.predict()

    def _take_transmitters(self, transmitters: dict[str, Transmitter]) -> None:
        self.transmitters, self.views = transmitters, None
        if self.chosen not in transmitters:
            self.chosen = next(iter(transmitters), "")
        self.measured = self.measured if self.measured is not None and self._is_of_ours(self.measured) else None
        self.predict()

    def _is_of_ours(self, measured: Measurements) -> bool:
        positions_m = np.array([each.position_m for each in self.transmitters.values()]).reshape(-1, 3)
        return bool((np.linalg.norm(measured.tx[:, None] - positions_m, axis=2) <= SAME_TX_M).any())

    def _new_name(self, taken: Sequence[str]) -> str:
        return next(name for name in map("tx{}".format, itertools.count(1)) if name not in taken)

    def _map(self) -> PartialMap:
        if self.partial is None:
            raise MapError("there is no map yet: open one, or an example.")
        return self.partial

    def _tx_m(self) -> dict[str, tuple[float, float, float]]:
        if not self.transmitters:
            raise PositionError("there is no transmitter yet: click on the map where one shall be.")
        return {name: each.position_m for name, each in self.transmitters.items()}

    # Jobs

    def predict(self) -> None:
        """Predict the coverage: a coarse picture first, then the fine one."""
        partial, settings, measured, home = self._map(), self.settings, self.measured, self.home
        if not self.transmitters:
            self.cancel()
            self.answer, self.status = None, Status('Click on the map to put a transmitter, or press "Add".')
            self._show()
            return
        tx_m, eirp_dbm = self._tx_m(), np.array([each.eirp_dbm for each in self.transmitters.values()])
        of_all: dict[str, Any] = {
            "tx_antenna": [each.antenna for each in self.transmitters.values()],
            "rx_height_m": settings.rx_height_m,
        }

        def coverage(of: str, where: PartialMap, spacing_m: float, report: Progress, **given: Any) -> xr.Dataset:
            model = self._model(of, where, settings)
            return model.coverage(tx_m, spacing_m=spacing_m, progress=report, **of_all, **given)

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            coarse_m = COARSER * settings.spacing_m
            found = coverage("map", partial, coarse_m, part_of(report, 0.0, 0.2), measurements=measured)
            answer = Answer(found, eirp_dbm, settings, is_final=False)
            yield functools.partial(self._take_answer, answer)
            found = coverage("map", partial, settings.spacing_m, part_of(report, 0.2, 0.7), measurements=measured)
            answer = replace(answer, coverage=found, is_final=True)
            if len(tx_m) > 1:
                report(0.7, "SINR of the network")
                network = network_map(found, tx_power_dbm=eirp_dbm, bandwidth_hz=settings.bandwidth_hz)
                answer = replace(answer, network=network)
            yield functools.partial(self._take_answer, answer)
            if home is not None:
                truth = coverage("home", home, settings.spacing_m, part_of(report, 0.75, 1.0))
                yield functools.partial(self._take_answer, replace(answer, truth=truth))

        self._is_outdated = True
        self.begin(work)

    def place(self) -> None:
        """Move the chosen transmitter, or put the first one, to where it covers most."""
        partial, settings, name = self._map(), self.settings, self.chosen
        old = self.transmitters.get(name, Transmitter(0.0, 0.0))
        threshold_db = float(np.clip(settings.threshold_dbm - old.eirp_dbm, GAIN_FLOOR_DB + 1.0, 0.0))

        def take(position_m: Floats) -> None:
            x_m, y_m, z_m = (round(float(each), 3) for each in position_m)
            self.chosen = name or self._new_name([])
            self._take_transmitters(self.transmitters | {self.chosen: replace(old, x_m=x_m, y_m=y_m, z_m=z_m)})

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            found = place_transmitter(
                self._model("map", partial, settings),
                threshold_db=threshold_db,
                tx_height_m=old.z_m,
                rx_height_m=settings.rx_height_m,
                progress=report,
            )
            yield functools.partial(take, found.position_m)

        self.begin(work)

    def find_views(self) -> None:
        """Find from where a robot would learn most about the coverage."""
        partial, settings, tx_m = self._map(), self.settings, [*self._tx_m().values()]
        weakest_dbm = min(each.eirp_dbm for each in self.transmitters.values())
        threshold_db = float(np.clip(settings.threshold_dbm - weakest_dbm, GAIN_FLOOR_DB, 0.0))

        def take(views: NextViews) -> None:
            self.views = views
            if self.answer is None or self._is_outdated or not self.answer.is_final:
                self.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.2, "comparing poses")
            views = next_views(self._model("map", partial, settings), tx_m, threshold_db=threshold_db)
            yield functools.partial(take, views)

        self.begin(work)

    def learn(self, content: bytes) -> None:
        """Take measured gains or powers, a CSV; those that name no transmitter are of the chosen one."""
        tx_m = dict(self._tx_m())[self.chosen]

        def take(measured: Measurements) -> None:
            if not self._is_of_ours(measured):
                position = ", ".join(f"{each:g}" for each in measured.tx[0])
                remedy = f"move one to ({position}), where that of the first one is."
                self.cancel()
                self.refuse(f"no transmitter is within {SAME_TX_M:g} m of those of the measurements: {remedy}")
                return
            self.measured = measured
            self.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, "reading measurements")
            with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
                path = Path(folder) / "measured.csv"
                path.write_bytes(content)
                measured = load_measurements(path)
                if not measured.tx_known.any():
                    measured = load_measurements(path, tx=tx_m)
            yield functools.partial(take, measured)

        self.begin(work)

    def _model(self, of: str, partial: PartialMap, settings: RadioSettings) -> LinkModel:
        """Return the warm model of the map, or of the home; called by jobs alone."""
        model = self._models.get(of)
        if model is None or model.simulation.trace_settings != settings.trace_settings:
            model = self._models[of] = LinkModel(partial, trace_settings=settings.trace_settings)
        model.update(partial)
        return model

    def begin(self, work: Callable[[Progress], Iterator[Callable[[], None]]]) -> None:
        """Start a job and cancel the one before: it yields what is to be done in the session's thread."""
        if self._job is not None:
            self._job.is_cancelled.set()
        job = self._job = _Job(self._tell)
        self.status = Status("Waiting", 0.0)
        self._show()
        _ONE_AT_A_TIME.submit(self._advance, job, work(job.report))

    def _advance(self, job: _Job, found: Iterator[Callable[[], None]]) -> None:
        """Compute up to the next thing that a job finds, and let those of other windows have their turn."""
        try:
            job.report(0.0, "starting")
            change = next(found, None)
        except _CancelledError:
            return
        except Exception as error:  # whatever it is, the page shows it and stays alive
            known = isinstance(error, SionnaPartialError | OSError | MemoryError)
            if not known:
                _log.exception("a job of the app failed")
            message = str(error) if known else f"this failed ({type(error).__name__}: {shown(str(error))})."
            self.do(functools.partial(self._end, job, Status(message, is_error=True)))
            return
        if change is None:
            self.do(functools.partial(self._end, job, Status("Ready.")))
        else:
            self.do(functools.partial(self._take, job, change))
            _ONE_AT_A_TIME.submit(self._advance, job, found)

    def _tell(self, job: _Job, fraction: float, message: str) -> None:
        self.do(functools.partial(self._take, job, lambda: setattr(self, "status", Status(message, fraction))))

    def _take(self, job: _Job, change: Callable[[], None]) -> None:
        if job is self._job:
            change()
            self._show()

    def _end(self, job: _Job, status: Status) -> None:
        if job is self._job:
            self._job = None
            self._conclude(status)

    def _conclude(self, status: Status) -> None:
        """Show how a job has ended; an answer to another question than that of the page goes."""
        self.status = status
        if self._is_outdated:
            self.answer, self._is_outdated = None, False
        self._show()

    def _take_answer(self, answer: Answer) -> None:
        self.answer, self._is_outdated = answer, False

    # Files

    def file(self, kind: str) -> bytes:
        """Return the newest answer as a file of one of `FILES`."""
        require_choice("kind", kind, FILES)
        answer = self.answer
        if answer is None or self._is_outdated or not answer.is_final:
            raise SettingsError(
                "there is no coverage yet: put a transmitter on the map, and wait for the fine picture."
            )
        if kind == "pdf":
            return report_pdf(answer.coverage, answer.eirp_dbm, answer.settings.threshold_dbm)
        with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
            path = Path(folder) / f"coverage.{kind}"
            if kind == "yaml" and answer.network is not None:
                save_network(answer.network, path)
            else:
                save_coverage(answer.coverage.isel(tx=0) if kind == "yaml" else answer.coverage, path)
            return path.read_bytes() if kind != "yaml" else _zipped(sorted(Path(folder).iterdir()))

    def python(self) -> str:
        """Return the lines that compute the same coverage."""
        if self.partial is None or not self.transmitters:
            return ""
        settings = self.settings
        given = [f"rx_height_m={settings.rx_height_m!r}", f"spacing_m={settings.spacing_m!r}"]
        trace = [f"frequency_hz={settings.frequency_hz!r}"]
        trace += [] if settings.through_walls is None else [f"refraction={settings.through_walls}"]
        given.append(f"trace_settings=sp.TraceSettings({', '.join(trace)})")
        given += ['measurements="measured.csv"'] if self.measured is not None else []
        antennas = [each.antenna for each in self.transmitters.values()]
        if any(each != Antenna() for each in antennas):
            given.append(f"tx_antenna=[{', '.join(f'sp.{each!r}' for each in antennas)}]")
        powers = [each.eirp_dbm for each in self.transmitters.values()]
        lines = ["import sionna_partial as sp", "", *self._python_map, f"tx = {self._tx_m()!r}"]
        lines += ["coverage = sp.predict_map(", "    partial,", "    tx,", *(f"    {each}," for each in given), ")"]
        lines += [f"power = coverage.radio.power(eirp_dbm={powers!r})"]
        lines += [
            f"area = coverage.radio.area({settings.threshold_dbm!r}, eirp_dbm={powers!r})",
            'coverage.radio.save("coverage.nc")',
        ]
        return "\n".join(lines) + "\n"


def stored_map(files: Sequence[tuple[str, bytes]], folder: Path) -> Path:
    """Write an uploaded map under names of ours: of the names of its files only the suffixes count.

    Raises
    ------
    MapError
        For other files than a map of `MAP_SUFFIXES`, or more than `MOST_BYTES`.
    """
    if len(files) == 1 and PurePath(files[0][0]).suffix.lower() == ".zip":
        files = _unzipped(files[0][1])
    by_suffix = {PurePath(name).suffix.lower(): content for name, content in files}
    sheets = [suffix for suffix in by_suffix if suffix in MAP_SUFFIXES and (suffix in _SHEETS or len(files) == 1)]
    images = [suffix for suffix in by_suffix if suffix in _IMAGES]
    if len(sheets) != 1 or len(by_suffix) != len(files) or len(sheets) + len(images) != len(files) or len(images) > 1:
        names = ", ".join(shown(name) for name, _ in files[:3])
        raise MapError(
            f"{names}: give one map ({', '.join(MAP_SUFFIXES)}); of a ROS map YAML and image together, or a zip."
        )
    path, content = folder / f"map{sheets[0]}", by_suffix[sheets[0]]
    if images:
        (folder / f"map{images[0]}").write_bytes(by_suffix[images[0]])
        content = re.sub(rb"(?m)^image:.*$", f"image: map{images[0]}".encode(), content)
    path.write_bytes(content)
    return path


def _unzipped(content: bytes) -> list[tuple[str, bytes]]:
    """Return the files of a zip, which may not unpack to more than `MOST_BYTES`."""
    try:
        return [*unzipped(content, MOST_BYTES).items()]
    except ValueError as error:
        raise MapError(f"the zip cannot be read ({error}): give a zip of a ROS map's YAML and image.") from error


def _zipped(paths: Sequence[Path]) -> bytes:
    """Return files as a zip; equal files give equal bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in paths:
            archive.writestr(zipfile.ZipInfo(path.name), path.read_bytes())
    return stream.getvalue()
