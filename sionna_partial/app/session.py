"""One window of the app without its page: map, transmitters, settings, cancellable jobs, newest answer."""

import functools
import itertools
import logging
import math
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import xarray as xr

from sionna_partial.app.answer import Answer
from sionna_partial.app.drawing import LENGTH, STROKES, Plan, Stroke, drawn, uploaded_plan
from sionna_partial.app.files import (
    FILES,
    Project,
    coverage_file,
    file_name,
    project_file,
    script,
    uploaded_map,
    uploaded_project,
)
from sionna_partial.app.jobs import TURNS, CancelledError, Job, Status, collected_warnings
from sionna_partial.app.radio import (
    MOST_TRANSMITTERS,
    PRESETS,
    RadioSettings,
    Transmitter,
    fitted,
    placed,
    require_name,
    usual_height_m,
)
from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import Progress, reason_of, require, require_choice
from sionna_partial.constants import COARSER, GAIN_FLOOR_DB, CellState
from sionna_partial.coverage.network import network_map
from sionna_partial.display import part_of
from sionna_partial.errors import MapError, MeasurementError, PositionError, SettingsError, SionnaPartialError
from sionna_partial.exploration.explore import explore_trajectory
from sionna_partial.exploration.next_views import NextViews, next_views
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap, cell_centres_m, nearest_free_m
from sionna_partial.measurements.measurements import (
    SAME_TX_M,
    Measurements,
    can_be_used,
    load_measurements,
    measurements_of_each,
    nearest_transmitters,
)
from sionna_partial.placement.placement import place_transmitter
from sionna_partial.resources import demo_homes, scenes_folder

ROUNDING_M = 0.006
"""Positions of the picture that are nearer than this are equal [m]."""

FIRST_STEPS, MORE_STEPS = 100, 50
"""Steps of the simulated robot at first, and at each request."""

_MEASURE = 'Drag along a length that you know, such as a wall; then type it in "Known length [m]" and press Enter.'
_SAVED_MAP = 'partial = sp.load_map("map.npz")  # in the file of "Save the project", with everything drawn on it'

_log = logging.getLogger(__name__)


class Session:
    """State of one window. Its methods are called in one thread; long computations run in another.

    A new job cancels the one before it and drops its results. `call` runs a function in the thread of the session;
    `show` is called in that thread after changes.
    """

    def __init__(self, call: Callable[[Callable[[], None]], object], show: Callable[[], None]) -> None:
        self._call, self._show = call, show
        self._waiting: deque[Callable[[], None]] = deque()
        self._job: Job | None = None
        self._worker = ThreadPoolExecutor(1, "coverage of a window")
        self._models: dict[str, tuple[LinkModel, list[str]]] = {}
        self._warnings: dict[str, list[str]] = {"map": [], "act": [], "job": []}
        self.partial: PartialMap | None = None
        self.plan: Plan | None = None
        self.strokes: tuple[Stroke, ...] = ()
        self._bare: PartialMap | None = None
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
        self.is_receiving = False

    def do(self, function: Callable[[], None]) -> None:
        """Run a function in the thread of the session, after those that wait; called in any thread."""
        self._waiting.append(function)
        self._call(self._do_all)

    def _do_all(self) -> None:
        while self._waiting:
            try:
                self._waiting.popleft()()
            except Exception as error:  # shown by the page, which stays alive
                self.cancel()
                self.refuse(self._reason(error))

    def close(self) -> None:
        """Cancel the job, and accept no other one."""
        self._call, self._show = lambda function: None, lambda: None
        self.cancel()
        self._worker.shutdown(wait=False, cancel_futures=True)

    @property
    def warnings(self) -> list[str]:
        """Warnings of the map, the last action, the predictor, and the jobs since the last answer."""
        on_networks = self.partial is not None and not self.partial.is_complete
        of_models = [warning for _, found in [*self._models.values()] for warning in found if on_networks]
        found = [*self._warnings["map"], *self._warnings["act"], *of_models, *self._warnings["job"]]
        return list(dict.fromkeys(found))

    def cancel(self) -> None:
        if self._job is not None:
            self._job.is_cancelled.set()
            self._job = None
            self._conclude(Status("Cancelled."))

    def refuse(self, error: object) -> None:
        self.status = Status(str(error), is_error=True)
        self._show()

    # Maps

    def open_map(self, partial: PartialMap, title: str, warnings: Sequence[str] = ()) -> None:
        """Take a map without transmitters, and the warnings of its reader."""
        self._take_map(partial, title, [f"partial = sp.load_map({title!r})"], warnings)
        self.predict()

    def open_example(self, name: str) -> None:
        """Open a demo home as a robot has seen it, with its transmitter."""
        require_choice("home", name, demo_homes())

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"opening the {name}")
            home, details = load_map(scenes_folder() / name / "complete" / "map.yaml"), demo_homes()[name]
            yield functools.partial(self._enter, name, home, int(details["exploration_seed"]), details["transmitter"])

        self.begin(work)

    def _enter(self, name: str, home: PartialMap, seed: int, tx_m: Sequence[float]) -> None:
        self.title, self.home, self.steps, self._seed, self.plan, self.strokes = name, home, 0, seed, None, ()
        x_m, y_m, z_m = tx_m
        self.transmitters, self.chosen, self.measured = {"tx1": Transmitter(x_m, y_m, z_m)}, "tx1", None
        self.explore_more(FIRST_STEPS)

    def explore_more(self, steps: int = MORE_STEPS) -> None:
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
            self.steps = total
            self._change_map(partial, lines)

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            partial = explore_trajectory(home, (total,), seed, progress=report).maps[0]
            yield functools.partial(take, partial)

        self.begin(work)

    def upload_map(self, files: Sequence[tuple[str, bytes]]) -> None:
        title = next((PurePath(name).name for name, _ in files), "")

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"reading {title}")
            with collected_warnings() as warnings:
                project, plan = uploaded_project(files), uploaded_plan(files)
                partial = None if project or plan else uploaded_map(files)
            if plan is not None:
                yield functools.partial(self._open_plan, plan)
            elif partial is not None:
                yield functools.partial(self.open_map, partial, title, warnings)
            elif project is not None:
                found = {name: placed(project.partial, each) for name, each in project.transmitters.items()}
                yield functools.partial(self._open_project, replace(project, transmitters=found), warnings)

        self.begin(work)

    def _open_project(self, project: Project, warnings: Sequence[str]) -> None:
        self._take_map(project.partial, project.title, [_SAVED_MAP], warnings)
        self.settings = project.settings or self.settings
        self.measured = project.measured if project.transmitters else None
        self._take_transmitters({**project.transmitters})

    def _open_plan(self, plan: Plan) -> None:
        self._forget_map()
        self.partial, self.plan, self.title = None, plan, plan.name
        self._ask(_MEASURE)

    def measure(self, line_m: Sequence[tuple[float, float]], length_m: float) -> None:
        """Set the scale of a plan by the length [m] of a line that was drawn on it."""
        require(self.plan is not None, "known length", length_m, "open a floor plan as a picture first.")
        assert self.plan is not None
        drawn_m = math.dist(line_m[0], line_m[-1])
        require(drawn_m > 0.0, "known length", length_m, "drag along it on the picture first.")
        self.change_plan(pixel_m=(self.plan.pixel_m or 1.0) * length_m / drawn_m)

    def change_plan(self, **values: Any) -> None:
        """Read a plan with another threshold, or another scale, which removes everything on the map."""
        plan = replace(self.plan, **values) if self.plan else None
        if plan is None or plan.pixel_m is None:
            self.plan = plan
            self._show()
            return

        def take(partial: PartialMap, warnings: Sequence[str]) -> None:
            is_same = self.plan is not None and self.plan.pixel_m == plan.pixel_m
            self.plan = plan
            if is_same:
                self._change_map(partial, [_SAVED_MAP])
                self._warnings["map"] = [*warnings]
            else:
                self._take_map(partial, plan.name, [_SAVED_MAP], warnings)
                self.plan = plan
                self.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"reading {plan.name}")
            with collected_warnings() as warnings:
                partial = plan.read()
            yield functools.partial(take, partial, warnings)

        self.begin(work)

    def draw(self, stroke: Stroke) -> None:
        require_choice("stroke", stroke.kind, [name for name in STROKES if name != LENGTH])
        self._redraw((*self.strokes, stroke))

    def undo(self) -> None:
        self._redraw(self.strokes[:-1])

    def _redraw(self, strokes: tuple[Stroke, ...]) -> None:
        self._map()
        assert self._bare is not None
        partial, self.strokes = drawn(self._bare, strokes), strokes
        self.partial = partial
        self._take_transmitters(self.transmitters)

    def _forget_map(self) -> None:
        self._warnings = {"map": [], "act": [], "job": []}
        self.transmitters, self.chosen, self.measured, self.views, self.answer = {}, "", None, None, None
        self.plan, self.strokes, self.home = None, (), None

    def _take_map(self, partial: PartialMap, title: str, python: list[str], warnings: Sequence[str] = ()) -> None:
        self._forget_map()
        self.title, self._warnings["map"] = title, [*warnings]
        self._fit(partial, python)

    def _change_map(self, partial: PartialMap, python: list[str]) -> None:
        """Take another map of the same building, and predict."""
        self._warnings, self.answer = {"map": [], "act": [], "job": []}, None
        self._fit(partial, python)
        self._take_transmitters(self.transmitters)

    def _fit(self, partial: PartialMap, python: list[str]) -> None:
        self._bare, self._python_map = partial, python
        self.partial = drawn(partial, self.strokes)
        self.settings = fitted(self.settings, self.partial)

    # Transmitters and settings

    def put(self, positions: Sequence[tuple[str, float, float]]) -> None:
        """Take the transmitters (name, x, y) [m] of the picture; new ones have no name yet."""
        if len(positions) > MOST_TRANSMITTERS:
            raise SettingsError(f"there are {MOST_TRANSMITTERS} transmitters already: remove one first.")
        found: dict[str, Transmitter] = {}
        for name, x_m, y_m in positions:
            old = self.transmitters.get(name)
            name = name if old else self._new_name([*self.transmitters, *found])
            x_m, y_m = round(float(x_m), 2), round(float(y_m), 2)
            if old is None:
                self.chosen, found[name] = name, replace(self._new_transmitter(), x_m=x_m, y_m=y_m)
            elif max(abs(x_m - old.x_m), abs(y_m - old.y_m)) > ROUNDING_M:
                self.chosen, found[name] = name, replace(old, x_m=x_m, y_m=y_m)
            else:
                found[name] = old
        if found != self.transmitters:  # a drag of the picture moves none
            self._take_transmitters(found)

    def _new_transmitter(self) -> Transmitter:
        return Transmitter(0.0, 0.0, usual_height_m(self._map()), self.settings.eirp_dbm)

    def add(self) -> None:
        partial = self._map()
        free = np.argwhere(partial.state == CellState.FREE)
        require(len(free) > 0, "free cells", 0, "give a map with some.")
        x_m, y_m = nearest_free_m(partial, cell_centres_m(partial, free.mean(axis=0)))[0]
        self.put([*((name, each.x_m, each.y_m) for name, each in self.transmitters.items()), ("", x_m, y_m)])

    def change(self, name: str, new_name: str | None = None, **values: Any) -> None:
        require_choice("transmitter", name, self.transmitters)
        new_name = name if new_name is None else new_name.strip()
        require_name(new_name)
        require(new_name == name or new_name not in self.transmitters, "name", new_name, "another one has it.")
        changed = replace(self.transmitters[name], **values)
        self.chosen = new_name if self.chosen == name else self.chosen
        pairs = [(new_name, changed) if key == name else (key, old) for key, old in self.transmitters.items()]
        self._take_transmitters(dict(pairs))

    def remove(self, name: str) -> None:
        self._take_transmitters({each: old for each, old in self.transmitters.items() if each != name})

    def use_preset(self, name: str) -> None:
        require_choice("preset", name, PRESETS)
        values = PRESETS[name]._asdict()
        self.transmitters = {each: replace(old, eirp_dbm=values["eirp_dbm"]) for each, old in self.transmitters.items()}
        self.set(**values)

    @property
    def preset(self) -> str:
        """Name of the preset in use, "" for none."""
        same = all(each.eirp_dbm == self.settings.eirp_dbm for each in self.transmitters.values())
        return self.settings.preset if same else ""

    def set(self, **values: Any) -> None:
        self.settings = replace(self.settings, **values)
        if values.keys() <= {"threshold_dbm"}:
            self._show()
        else:
            self.predict()

    def _take_transmitters(self, transmitters: dict[str, Transmitter]) -> None:
        """Predict for transmitters; one that cannot be where it is moves to the nearest free cell."""
        found = {name: placed(self._map(), each) for name, each in transmitters.items()}
        self._warnings["act"] = [
            f"{name} cannot be at ({old.x_m:g}, {old.y_m:g}): ({new.x_m:g}, {new.y_m:g}) is the nearest free cell."
            for (name, old), new in zip(transmitters.items(), found.values(), strict=True)
            if new is not old
        ]
        self.transmitters, self.views = found, None
        if self.chosen not in found:
            self.chosen = next(iter(found), "")
        if self.measured is not None and not self._are_ours(self.measured).any():
            self.measured = None
            self._warnings["act"].append(
                f"The measurements are not used any more: no transmitter is within {SAME_TX_M:g} m of theirs."
            )
        self.predict()

    def _are_ours(self, measured: Measurements) -> Bools:
        """Return which measured links (N,) are of a transmitter of this window."""
        sources_m = [np.array([transmitter.position_m]) for transmitter in self.transmitters.values()]
        return np.asarray(nearest_transmitters(measured.tx, sources_m).any(axis=0))

    def measured_points(self) -> tuple[Floats, Bools]:
        """Return the measured receivers (N, 3) [m], and which of them are used (N,)."""
        measured, tx_m = self.measured, np.array([each.position_m for each in self.transmitters.values()])
        if measured is None or self.partial is None:
            return np.empty((0, 3)), np.empty(0, dtype=bool)
        used = can_be_used(self.partial, tx_m, measured.rx, self.settings.frequency_hz)
        return measured.rx, used & self._are_ours(measured)

    def forget_measurements(self, *warnings: str) -> None:
        self.measured, self._warnings["act"] = None, [*warnings]
        self.predict()

    def _new_name(self, taken: Sequence[str]) -> str:
        return next(name for name in map("tx{}".format, itertools.count(1)) if name not in taken)

    def _map(self) -> PartialMap:
        if self.partial is None:
            raise MapError(_MEASURE if self.plan else "there is no map yet: open one, or an example.")
        return self.partial

    def _tx_m(self) -> dict[str, tuple[float, float, float]]:
        if not self.transmitters:
            raise PositionError("there is no transmitter yet: click on the map where one shall be.")
        return {name: each.position_m for name, each in self.transmitters.items()}

    # Jobs

    def _ask(self, message: str) -> None:
        self.cancel()
        self.answer, self.status = None, Status(message)
        self._show()

    def predict(self) -> None:
        """Predict the coverage: a coarse picture first, then the fine one."""
        partial, settings, measured = self._map(), self.settings, self.measured
        home = self.home and drawn(self.home, self.strokes)
        if not self.transmitters:
            self._ask('Click on the map to put a transmitter, or press "Add".')
            return
        tx_m, eirp_dbm = self._tx_m(), np.array([each.eirp_dbm for each in self.transmitters.values()])
        of_all: dict[str, Any] = {
            "tx_antenna": [each.antenna for each in self.transmitters.values()],
            "rx_height_m": settings.rx_height_m,
        }

        def coverage(of: str, where: PartialMap, spacing_m: float, report: Progress, **given: Any) -> xr.Dataset:
            model = self._model(of, where, settings)
            return model.coverage(tx_m, spacing_m=spacing_m, progress=report, **of_all, **given)

        def steps(report: Progress) -> Iterator[Callable[[], None]]:
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

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            try:
                yield from steps(report)
            except MeasurementError as error:
                yield functools.partial(self.forget_measurements, f"The measurements are not used any more: {error}")

        self._is_outdated = True
        self.begin(work)

    def place(self) -> None:
        partial, settings, name = self._map(), self.settings, self.chosen
        old = self.transmitters.get(name, self._new_transmitter())
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
        partial, settings, tx_m = self._map(), self.settings, [*self._tx_m().values()]
        weakest_dbm = min(each.eirp_dbm for each in self.transmitters.values())
        threshold_db = float(np.clip(settings.threshold_dbm - weakest_dbm, GAIN_FLOOR_DB, 0.0))

        def take(views: NextViews) -> None:
            self.views = views
            if self.answer is None or self._is_outdated or not self.answer.is_final:
                self.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            model = self._model("map", partial, settings)
            views = next_views(model, tx_m, threshold_db=threshold_db, progress=report)
            yield functools.partial(take, views)

        self.begin(work)

    def learn(self, content: bytes, name: str = "measured.csv") -> None:
        """Take measurements; those without transmitter are of the chosen one."""
        partial, all_m, tx_m = self._map(), self._tx_m(), self._tx_m()[self.chosen]
        frequency_hz = self.settings.frequency_hz

        def take(measured: Measurements) -> None:
            self.measured, self._warnings["act"] = measured, []
            self.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, "reading measurements")
            with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
                path = Path(folder) / file_name(name, "measured.csv")
                path.write_bytes(content)
                measured = load_measurements(path)
                if not measured.tx_known.any():
                    measured = load_measurements(path, tx=tx_m)
            if not self._are_ours(measured).any():
                position = ", ".join(f"{each:g}" for each in measured.tx[0])
                raise MeasurementError(
                    f"the measurements are of no transmitter within {SAME_TX_M:g} m: move one to ({position}), "
                    "the first position in the file."
                )
            measurements_of_each(partial, [np.array([each_m]) for each_m in all_m.values()], measured, frequency_hz)
            yield functools.partial(take, measured)

        self.begin(work)

    def _model(self, of: str, partial: PartialMap, settings: RadioSettings) -> LinkModel:
        """Return the warm model of the map, or of the home; called by jobs alone."""
        model, warnings = self._models.get(of, (None, []))
        wanted = settings.trace_settings, settings.scene_settings
        if model is None or (model.simulation.trace_settings, model.simulation.scene_settings) != wanted:
            model, warnings = self._models[of] = LinkModel(partial, None, *wanted), []
        with collected_warnings(warnings):  # logged once for each model
            model.update(partial)
            _ = model.predictor_of_map
        return model

    def begin(self, work: Callable[[Progress], Iterator[Callable[[], None]]]) -> None:
        """Start a job, which yields functions to be called in the session's thread, and cancel the one before."""
        if self._job is not None:
            self._job.is_cancelled.set()
        job = self._job = Job(self._tell)
        self.status = Status("Waiting", 0.0)
        self._show()
        with suppress(RuntimeError):  # a window that was closed computes nothing
            self._worker.submit(self._run, job, work)

    def _run(self, job: Job, work: Callable[[Progress], Iterator[Callable[[], None]]]) -> None:
        """Compute a job in turns with other windows."""
        try:
            with TURNS, collected_warnings(job.warnings):
                job.report(0.0, "starting")
                for change in work(job.report):
                    self.do(functools.partial(self._take, job, change))
                    job.pass_on()
                end = functools.partial(self._conclude, Status("Ready."))
        except CancelledError:
            return
        except Exception as error:  # shown by the page, which stays alive
            end = functools.partial(self._conclude, Status(self._reason(error), is_error=True))
        self.do(functools.partial(self._end, job, end))

    @staticmethod
    def _reason(error: Exception) -> str:
        """Return the reason of an error, whose trace is logged if it is not ours."""
        if not isinstance(error, SionnaPartialError | OSError | MemoryError):
            _log.error("a job of the app failed", exc_info=error)
        return reason_of(error)

    def _tell(self, job: Job, status: Status) -> None:
        def tell() -> None:
            if job is self._job:
                self.status = status
                self._show()

        self.do(tell)

    def _take(self, job: Job, change: Callable[[], None]) -> None:
        if job is self._job:
            change()
            self._warnings["job"] += job.warnings
            self._show()

    def _end(self, job: Job, end: Callable[[], None]) -> None:
        if job is self._job:
            self._job = None
            self._warnings["job"] += job.warnings
            end()

    def _conclude(self, status: Status) -> None:
        """Show the end of a job, and remove an outdated answer."""
        self.status = status
        if self._is_outdated:
            self.answer, self._is_outdated = None, False
        self._show()

    def _take_answer(self, answer: Answer) -> None:
        self.answer, self._is_outdated, self._warnings["job"] = answer, False, []

    # Files

    def file(self, kind: str) -> bytes:
        """Return the newest answer, or the project, as one of `FILES`."""
        require_choice("kind", kind, FILES)
        if kind == "project":
            return project_file(self._project())
        answer = self.answer
        if answer is None or self._is_outdated or not answer.is_final:
            raise SettingsError(
                "there is no coverage yet: put a transmitter on the map, and wait for the fine picture."
            )
        threshold_dbm = answer.settings.threshold_dbm
        heading = self.title, f"{answer.made:%Y-%m-%d}"
        return coverage_file(kind, answer.coverage, answer.eirp_dbm, threshold_dbm, heading, scene=self._map())

    def python(self) -> str:
        if self.partial is None or not self.transmitters:
            return ""
        return script(self._project(), [_SAVED_MAP] if self.strokes else self._python_map)

    def _project(self) -> Project:
        return Project(self._map(), self.title, self.transmitters, self.settings, self.measured)
