"""One window of the app without its page: map, transmitters, settings, cancellable jobs, newest answer."""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import xarray as xr

from sionna_partial.apps.app.answer import LAYERS, NETWORK_LAYERS, RATE, Answer, View, answer_png
from sionna_partial.apps.app.drawing import LENGTH, STROKES, Plan, Source, Stroke, drawn, read_again, uploaded_source
from sionna_partial.apps.app.files import (
    FILES,
    Project,
    coverage_file,
    file_name,
    project_file,
    script,
    uploaded_map,
    uploaded_project,
)
from sionna_partial.apps.app.jobs import Status, WindowJobs, collected_warnings
from sionna_partial.apps.app.marks import Marks, aims_m
from sionna_partial.apps.app.radio import (
    MOST_TRANSMITTERS,
    PRESETS,
    RadioSettings,
    Transmitter,
    fitted,
    placed,
    require_name,
    usual_height_m,
)
from sionna_partial.apps.app.survey import Survey
from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import Progress, require, require_choice
from sionna_partial.constants import COARSER, GAIN_FLOOR_DB, CellState
from sionna_partial.coverage.dataset import OFFSET
from sionna_partial.coverage.job import predict_map
from sionna_partial.coverage.network import predict_network
from sionna_partial.display import part_of
from sionna_partial.errors import MapError, MeasurementError, PositionError, SettingsError
from sionna_partial.exploration.explore import explore_trajectory
from sionna_partial.exploration.next_views import NextViews, next_views
from sionna_partial.files import decoding
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap, cell_centres_m, nearest_free_m
from sionna_partial.measurements.measurements import (
    SAME_TX_M,
    Measurements,
    can_be_used,
    measurements_of_each,
    nearest_transmitters,
)
from sionna_partial.placement.placement import place_transmitter
from sionna_partial.placement.several import NetworkPlacement, place_transmitters
from sionna_partial.plots.logo import read_logo
from sionna_partial.resources import demo_homes, scenes_folder

ROUNDING_M = 0.006
"""Positions of the picture that are nearer than this are equal [m]."""

FIRST_STEPS, MORE_STEPS = 100, 50
"""Steps of the simulated robot at first, and at each request."""

_MEASURE = 'Drag along a length that you know, such as a wall; then type it in "Known length [m]" and press Enter.'
_SAVED_MAP = 'partial = sp.load_map("map.npz")  # in the file of "Save the project", with everything drawn on it'


class Session(WindowJobs):
    """State of one window. Its methods are called in one thread; long computations run in another."""

    def __init__(self, call: Callable[[Callable[[], None]], object], show: Callable[[], None]) -> None:
        super().__init__(call, show)
        self._models: dict[str, tuple[LinkModel, list[str]]] = {}
        self._warnings: dict[str, list[str]] = {"map": [], "act": []}
        self.partial: PartialMap | None = None
        self.source: Source | None = None
        self.strokes: tuple[Stroke, ...] = ()
        self._bare: PartialMap | None = None
        self.home: PartialMap | None = None
        self.title, self.steps, self._seed = "", 0, 0
        self._python_map: list[str] = []
        self.transmitters: dict[str, Transmitter] = {}
        self.chosen = ""
        self.settings, self.view = RadioSettings(), View()
        self.survey: Survey | None = None
        self.measured: Measurements | None = None
        self.logo: tuple[str, bytes] | None = None
        self.answer: Answer | None = None
        self._is_outdated = False
        self.views: NextViews | None = None
        self.is_receiving = False

    @property
    def plan(self) -> Plan | None:
        """The picture of which the map was made."""
        return self.source if isinstance(self.source, Plan) else None

    @property
    def warnings(self) -> list[str]:
        """Warnings of the map, the last action, the predictor, and the jobs since the last answer."""
        on_networks = self.partial is not None and not self.partial.is_complete
        of_models = [warning for _, found in [*self._models.values()] for warning in found if on_networks]
        found = [*self._warnings["map"], *self._warnings["act"], *of_models, *self._job_warnings]
        return list(dict.fromkeys(found))

    # Maps

    def open_map(
        self, partial: PartialMap | None, title: str, warnings: Sequence[str] = (), source: Source | None = None
    ) -> None:
        """Take a map without transmitters, the warnings of its reader, and its file; or a picture without scale."""
        if partial is not None:
            python = (source and source.python) or [f"partial = sp.load_map({title!r})"]
            self._take_map(partial, title, python, warnings, source)
            self.predict()
        elif isinstance(source, Plan):
            self._forget_map()
            self.partial, self.source, self.title = None, source, source.name
            self._ask(_MEASURE)

    def open_example(self, name: str) -> None:
        """Open a demo home as a robot has seen it, with its transmitter."""
        require_choice("home", name, demo_homes())

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"opening the {name}")
            home, details = load_map(scenes_folder() / name / "complete" / "map.yaml"), demo_homes()[name]
            yield functools.partial(self._enter, name, home, int(details["exploration_seed"]), details["transmitter"])

        self.begin(work)

    def _enter(self, name: str, home: PartialMap, seed: int, tx_m: Sequence[float]) -> None:
        self.title, self.home, self.steps, self._seed, self.source, self.strokes = name, home, 0, seed, None, ()
        x_m, y_m, z_m = tx_m
        self.transmitters, self.chosen = {"tx1": Transmitter(x_m, y_m, z_m, self.settings.eirp_dbm)}, "tx1"
        self.survey, self.measured = None, None
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
                project, source = uploaded_project(files), uploaded_source(files)
                partial = None
                if project is None and (source is None or source.is_scaled):
                    partial = source.read() if source else uploaded_map(files)
            if project is not None:
                yield self._opening(project, warnings)
            else:
                yield functools.partial(self.open_map, partial, title, warnings, source)

        self.begin(work)

    def _opening(self, project: Project, warnings: Sequence[str]) -> Callable[[], None]:
        """Return the function that opens a project, with its file and strokes if they still give its map."""
        found = {name: placed(project.partial, each) for name, each in project.transmitters.items()}
        bare, source, strokes = read_again(project)
        with decoding(Path("project.zip"), "was not saved by the app", MapError, "save it again."):
            view = View(**project.view)

        def take() -> None:
            self._take_map(bare, project.title, [_SAVED_MAP], warnings, source, strokes)
            self.settings, self.view = project.settings or self.settings, view
            self.measured, self.logo = project.measured if project.transmitters else None, project.logo
            self._take_transmitters(found)

        return take

    def measure(self, line_m: Sequence[tuple[float, float]], length_m: float) -> None:
        """Set the scale of a plan by the length [m] of a line that was drawn on it."""
        require(self.plan is not None, "known length", length_m, "open a floor plan as a picture first.")
        assert self.plan is not None
        drawn_m = math.dist(line_m[0], line_m[-1])
        require(drawn_m > 0.0, "known length", length_m, "drag along it on the picture first.")
        self.change_source(pixel_m=(self.plan.pixel_m or 1.0) * length_m / drawn_m)

    def change_source(self, **values: Any) -> None:
        """Read the file with other settings; another scale removes everything on the map."""
        source = replace(self.source, **values) if self.source else None
        if source is None or (isinstance(source, Plan) and source.pixel_m is None):
            self.source = source
            self._show()
            return
        python = source.python or [_SAVED_MAP]

        def take(partial: PartialMap, warnings: Sequence[str]) -> None:
            if self.plan is None or self.plan.settings["pixel_m"] == source.settings["pixel_m"]:
                self.source = source
                self._change_map(partial, python)
                self._warnings["map"] = [*warnings]
            else:
                self._take_map(partial, source.name, python, warnings, source)
                self.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"reading {source.name}")
            with collected_warnings() as warnings:
                partial = source.read()
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
        self._warnings, self._job_warnings = {"map": [], "act": []}, []
        self.transmitters, self.chosen, self.measured, self.views, self.answer = {}, "", None, None, None
        self.source, self.strokes, self.home, self.survey = None, (), None, None

    def _take_map(
        self,
        partial: PartialMap,
        title: str,
        python: list[str],
        warnings: Sequence[str] = (),
        source: Source | None = None,
        strokes: tuple[Stroke, ...] = (),
    ) -> None:
        self._forget_map()
        self.title, self._warnings["map"], self.source, self.strokes = title, [*warnings], source, strokes
        self._fit(partial, python)

    def _change_map(self, partial: PartialMap, python: list[str]) -> None:
        """Take another map of the same building, and predict."""
        self._warnings, self._job_warnings, self.answer = {"map": [], "act": []}, [], None
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
        values |= {"model": ""} if "eirp_dbm" in values else {}
        changed = self.settings.powered(replace(self.transmitters[name], **values))
        self.chosen = new_name if self.chosen == name else self.chosen
        pairs = [(new_name, changed) if key == name else (key, old) for key, old in self.transmitters.items()]
        self._take_transmitters(dict(pairs))

    def remove(self, name: str) -> None:
        self._take_transmitters({each: old for each, old in self.transmitters.items() if each != name})

    def use_preset(self, name: str) -> None:
        require_choice("preset", name, PRESETS)
        values = PRESETS[name]._asdict()
        settings = replace(self.settings, **values)
        given = {"eirp_dbm": values["eirp_dbm"], "channel": ""}
        changed = {each: settings.powered(replace(old, **given)) for each, old in self.transmitters.items()}
        self.transmitters = changed
        self.set(**values)

    def set(self, **values: Any) -> None:
        settings = replace(self.settings, **values)
        self.transmitters = {name: settings.powered(each) for name, each in self.transmitters.items()}
        self.settings = settings
        if values.keys() <= {"threshold_dbm"}:
            self._show()
        else:
            self.predict()

    @property
    def layers(self) -> list[str]:
        """Layers of these transmitters and settings."""
        lacking = () if len(self.transmitters) > 1 else NETWORK_LAYERS
        lacking = lacking if self.settings.schemes[0] else (*lacking, RATE)
        return [name for name in LAYERS if name not in lacking]

    @property
    def shown_view(self) -> View:
        """The view, with what there is."""
        several = len(self.transmitters) > 1
        layer = self.view.layer if self.view.layer in self.layers else View.layer
        name = self.view.transmitter if several and self.view.transmitter in self.transmitters else ""
        return replace(self.view, layer=layer, transmitter=name, truth=self.view.truth and self.home is not None)

    def look(self, **values: Any) -> None:
        """Change the picture."""
        self.view = replace(self.view, **values)
        self._show()

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
        return self._of_each(measured).any(axis=0)

    def _of_each(self, measured: Measurements) -> Bools:
        """Return which measured links are of each transmitter (T, N)."""
        sources_m = [np.array([transmitter.position_m]) for transmitter in self.transmitters.values()]
        return np.asarray(nearest_transmitters(measured.tx, sources_m))

    def measured_points(self) -> tuple[Floats, Bools]:
        """Return the measured receivers (N, 3) [m], and which of them are used (N,)."""
        measured, tx_m = self.measured, np.array([each.position_m for each in self.transmitters.values()])
        if measured is None or self.partial is None:
            return np.empty((0, 3)), np.empty(0, dtype=bool)
        used = can_be_used(self.partial, tx_m, measured.rx, self.settings.frequency_hz)
        return measured.rx, used & self._are_ours(measured)

    def measured_names(self) -> list[str]:
        """Return the transmitter of each measured link, "" for others."""
        if self.measured is None:
            return []
        of_each, names = self._of_each(self.measured), [*self.transmitters, ""]
        return [names[at] for at in np.where(of_each.any(axis=0), of_each.argmax(axis=0), -1)]

    def measured_powers(self) -> list[tuple[str, float]]:
        """Return the power that fits the measured powers of each measured transmitter [dBm]."""
        coverage = None if self.answer is None else self.answer.coverage
        if self.measured is None or coverage is None or OFFSET not in coverage.coords:
            return []
        powers = zip(coverage["tx"].to_numpy(), coverage[OFFSET].to_numpy().tolist(), strict=True)
        return [(str(name), power_dbm) for name, power_dbm in powers if math.isfinite(power_dbm)]

    def forget_measurements(self, *warnings: str) -> None:
        self.survey, self.measured, self._warnings["act"] = None, None, [*warnings]
        self.predict()

    def _new_name(self, taken: Sequence[str]) -> str:
        return next(name for name in map("tx{}".format, itertools.count(1)) if name not in taken)

    def _map(self) -> PartialMap:
        if self.partial is None:
            raise MapError(_MEASURE if self.source else "there is no map yet: open one, or an example.")
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
        counted_dbm = np.minimum(eirp_dbm, [settings.uplink_dbm(each) for each in self.transmitters.values()])
        channels = {name: each.channel for name, each in self.transmitters.items()}
        of_links: dict[str, Any] = {
            "tx_antenna": [each.antenna for each in self.transmitters.values()],
            "rx_height_m": settings.rx_height_m,
            "receivers": "inside",
        }

        def coverage(of: str, where: PartialMap, spacing_m: float, report: Progress, **given: Any) -> xr.Dataset:
            model = self._model(of, where, settings)
            return predict_map(model, tx_m, spacing_m=spacing_m, progress=report, **of_links, **given)

        def steps(report: Progress) -> Iterator[Callable[[], None]]:
            coarse_m = COARSER * settings.spacing_m
            found = coverage("map", partial, coarse_m, part_of(report, 0.0, 0.2), measurements=measured)
            answer = Answer(found, counted_dbm, settings, is_final=False)
            yield functools.partial(self._take_answer, answer)
            found = coverage("map", partial, settings.spacing_m, part_of(report, 0.2, 0.7), measurements=measured)
            answer = replace(answer, coverage=found, is_final=True)
            if len(tx_m) > 1:
                report(0.7, "SINR of the network")
                network = predict_network(
                    found,
                    tx_power_dbm=eirp_dbm,
                    bandwidth_hz=settings.bandwidth_hz,
                    channels=channels,
                    standard=settings.schemes[0] or None,
                )
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
        threshold_db = self._threshold_db(old)

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

    def _threshold_db(self, *transmitters: Transmitter) -> float:
        """Return the path gain at the threshold of the weakest transmitter [dB]."""
        weakest_dbm = min(min(each.eirp_dbm, self.settings.uplink_dbm(each)) for each in transmitters)
        return float(np.clip(self.settings.threshold_dbm - weakest_dbm, GAIN_FLOOR_DB + 1.0, 0.0))

    def place_several(self, goal: float, most: int) -> None:
        """Replace the transmitters by the fewest of up to `most` that cover the fraction `goal` of the floor."""
        partial, settings = self._map(), self.settings
        like = self.transmitters.get(self.chosen, self._new_transmitter())
        threshold_db = self._threshold_db(like)

        def take(found: NetworkPlacement) -> None:
            names = [f"tx{number}" for number in range(1, len(found.added) + 1)]
            places_m = [{"x_m": x_m, "y_m": y_m} for x_m, y_m, _ in found.positions_m.round(2).tolist()]
            self._take_transmitters(
                {name: replace(like, **at_m, channel="") for name, at_m in zip(names, places_m, strict=True)}
            )
            texts = [f"{name} {more:.0%}" for name, more in zip(names, found.added, strict=True)]
            reached = "" if found.score >= goal else f" The goal of {goal:.0%} needs more than {most}, or more power."
            self._warnings["act"].append(
                f"Expected covered floor {found.score:.0%}; each adds: {', '.join(texts)}.{reached}"
            )

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            found = place_transmitters(
                self._model("map", partial, settings),
                most,
                goal=goal,
                threshold_db=threshold_db,
                tx_height_m=like.z_m,
                rx_height_m=settings.rx_height_m,
                progress=report,
            )
            yield functools.partial(take, found)

        self.begin(work)

    def plan_channels(self) -> None:
        """Give each transmitter a channel of the band, so that the mean rate is large."""
        answer, channels, names = self.answer, self.settings.channels, [*self.transmitters]
        if answer is None or self._is_outdated or not answer.is_final or answer.network is None:
            raise SettingsError("channels are planned for two or more transmitters with a fine picture: wait for it.")
        network, settings = answer.network, answer.settings

        def take(found: xr.Dataset) -> None:
            plan = dict(zip(names, found["channel"].to_numpy(), strict=True))
            self.transmitters = {name: replace(old, channel=plan[name]) for name, old in self.transmitters.items()}
            before, after = (float(np.nanmean(each["rate_bit_s"])) / 1e6 for each in (network, found))
            self._take_answer(replace(answer, network=found))
            self._warnings["act"] = [f"Mean rate with the plan of channels {after:.0f} Mbit/s, before {before:.0f}."]

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.2, "planning channels")
            powers_dbm = network.attrs["tx_power_dbm"]
            found = predict_network(
                answer.coverage,
                tx_power_dbm=powers_dbm,
                bandwidth_hz=settings.bandwidth_hz,
                channels=channels,
                standard=settings.schemes[0] or None,
            )
            yield functools.partial(take, found)

        self.begin(work)

    def find_views(self) -> None:
        partial, settings, tx_m = self._map(), self.settings, [*self._tx_m().values()]
        threshold_db = self._threshold_db(*self.transmitters.values())

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
        """Take a survey; powers without transmitter are of the chosen one."""
        all_m, plan = self._tx_m(), self.plan
        self._learn_from(lambda: Survey.read(name, content, plan, all_m))

    def assign(self, access_point: str) -> None:
        """Give the chosen transmitter an access point of the survey, or none of them for ""."""
        survey, tx_m = self.survey, self._tx_m()[self.chosen]
        assert survey is not None
        self._learn_from(lambda: survey.with_access_point(access_point, tx_m))

    def _learn_from(self, read: Callable[[], Survey]) -> None:
        partial, all_m, tx_m = self._map(), self._tx_m(), self._tx_m()[self.chosen]
        frequency_hz = self.settings.frequency_hz

        def take(survey: Survey, measured: Measurements | None, *warnings: str) -> None:
            self.survey, self.measured, self._warnings["act"] = survey, measured, [*warnings]
            self.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, "reading measurements")
            survey = read()
            if survey.has_several and not survey.positions_m:
                count = len(survey.access_points)
                what = f'{survey.name} has {count} access points: choose them in "Access point of the survey".'
                yield functools.partial(take, survey, None, what)
                return
            measured = survey.measurements(tx_m)
            if not self._are_ours(measured).any():
                position = ", ".join(f"{each:g}" for each in measured.tx[0])
                raise MeasurementError(
                    f"the measurements are of no transmitter within {SAME_TX_M:g} m: move one to ({position}), "
                    "the first position in the file."
                )
            measurements_of_each(partial, [np.array([each_m]) for each_m in all_m.values()], measured, frequency_hz)
            yield functools.partial(take, survey, measured)

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

    def _conclude(self, status: Status) -> None:
        """Show the end of a job, and remove an outdated answer."""
        if self._is_outdated:
            self.answer, self._is_outdated = None, False
        super()._conclude(status)

    def _take_answer(self, answer: Answer) -> None:
        self.answer, self._is_outdated, self._job_warnings = answer, False, []

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
        threshold_dbm = self.settings.threshold_dbm
        text = answer.settings.text(self._map())
        if kind == "png":
            title = f"{PurePath(self.title).name}\n{text}"
            marks = Marks(*self.measured_points(), aims_m(self.partial, self.transmitters.values()), self.views)
            return answer_png(answer, self.shown_view, threshold_dbm, self._map(), title, self.plan, marks)
        heading = PurePath(self.title).name, f"{answer.made:%Y-%m-%d}", text
        of_window: dict[str, Any] = {"scene": self._map(), "logo": self.logo and self.logo[1]}
        return coverage_file(kind, answer.coverage, answer.eirp_dbm, threshold_dbm, heading, **of_window)

    def take_logo(self, content: bytes, name: str) -> None:
        """Take a picture for the report; none for no content."""
        self.logo = (file_name(name, "logo"), content) if content and len(read_logo(content)) else None
        self._show()

    def python(self) -> str:
        if self.partial is None or not self.transmitters:
            return ""
        return script(self._project(), [_SAVED_MAP] if self.strokes else self._python_map)

    def _project(self) -> Project:
        source = self.source and (self.source.name, self.source.content, self.source.settings)
        strokes = [asdict(each) for each in self.strokes] if source else []
        of_window = self._map(), self.title, self.transmitters, self.settings, self.measured
        return Project(*of_window, asdict(self.view), source or None, strokes, self.logo)
