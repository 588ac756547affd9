"""Maps of a window: opened, uploaded, explored by a simulated robot, scaled, and drawn on."""

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

from sionna_partial.apps.app.answer import View
from sionna_partial.apps.app.drawing import LENGTH, STROKES, Plan, Source, Stroke, drawn, read_again, uploaded_source
from sionna_partial.apps.app.files import Project, uploaded_map, uploaded_project
from sionna_partial.apps.app.jobs import collected_warnings
from sionna_partial.apps.app.predicting import PredictionJobs
from sionna_partial.apps.app.radio import Transmitter, placed
from sionna_partial.apps.app.state import MEASURE, SAVED_MAP, WindowState
from sionna_partial.checks import Progress, require, require_choice
from sionna_partial.errors import MapError, SettingsError
from sionna_partial.exploration.explore import explore_trajectory
from sionna_partial.files import decoding
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.resources import demo_homes, scenes_folder

FIRST_STEPS, MORE_STEPS = 100, 50
"""Steps of the simulated robot at first, and at each request."""


class Maps:
    """Changes of the map of a window."""

    def __init__(self, state: WindowState, jobs: PredictionJobs) -> None:
        self._state, self._jobs = state, jobs

    def open_map(
        self, partial: PartialMap | None, title: str, warnings: Sequence[str] = (), source: Source | None = None
    ) -> None:
        """Take a map without transmitters, the warnings of its reader, and its file; or a picture without scale."""
        if partial is not None:
            python = (source and source.python) or [f"partial = sp.load_map({title!r})"]
            self._take_map(partial, title, python, warnings, source)
            self._jobs.predict()
        elif isinstance(source, Plan):
            self._state.forget_map()
            self._jobs.forget_answer()
            self._state.partial, self._state.source, self._state.title = None, source, source.name
            self._jobs.ask(MEASURE)

    def open_example(self, name: str) -> None:
        """Open a demo home as a robot has seen it, with its transmitter."""
        require_choice("home", name, demo_homes())

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"opening the {name}")
            home, details = load_map(scenes_folder() / name / "complete" / "map.yaml"), demo_homes()[name]
            yield functools.partial(self._enter, name, home, int(details["exploration_seed"]), details["transmitter"])

        self._jobs.begin(work)

    def _enter(self, name: str, home: PartialMap, seed: int, tx_m: Sequence[float]) -> None:
        state, (x_m, y_m, z_m) = self._state, tx_m
        state.title, state.home, state.steps, state.seed, state.source, state.strokes = name, home, 0, seed, None, ()
        state.transmitters = {"tx1": Transmitter(x_m, y_m, z_m, state.settings.eirp_dbm)}
        state.chosen, state.measured = "tx1", None
        self.explore_more(FIRST_STEPS)

    def explore_more(self, steps: int = MORE_STEPS) -> None:
        state = self._state
        home, name, seed, total = state.home, state.title, state.seed, state.steps + steps
        if home is None:
            raise SettingsError(
                "the robot explores the examples alone: open one, as what is not on a map is not known."
            )

        def take(partial: PartialMap) -> None:
            lines = [
                f'home = sp.load_map("scenes/{name}/complete/map.yaml")',
                f"partial = sp.explore(home, steps=({total},), seed={seed})[0]",
            ]
            state.steps = total
            self._change_map(partial, lines)

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            partial = explore_trajectory(home, (total,), seed, progress=report).maps[0]
            yield functools.partial(take, partial)

        self._jobs.begin(work)

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

        self._jobs.begin(work)

    def _opening(self, project: Project, warnings: Sequence[str]) -> Callable[[], None]:
        """Return the function that opens a project, with its file and strokes if they still give its map."""
        found = {name: placed(project.partial, each) for name, each in project.transmitters.items()}
        bare, source, strokes = read_again(project)
        with decoding(Path("project.zip"), "was not saved by the app", MapError, "save it again."):
            view = View(**project.view)

        def take() -> None:
            state = self._state
            self._take_map(bare, project.title, [SAVED_MAP], warnings, source, strokes)
            state.settings, state.view = project.settings or state.settings, view
            state.measured = project.measured if project.transmitters else None
            self._jobs.predict_for(found)

        return take

    def measure(self, line_m: Sequence[tuple[float, float]], length_m: float) -> None:
        """Set the scale of a plan by the length [m] of a line that was drawn on it."""
        plan = self._state.plan
        require(plan is not None, "known length", length_m, "open a floor plan as a picture first.")
        assert plan is not None
        drawn_m = math.dist(line_m[0], line_m[-1])
        require(drawn_m > 0.0, "known length", length_m, "drag along it on the picture first.")
        self.change_source(pixel_m=(plan.pixel_m or 1.0) * length_m / drawn_m)

    def change_source(self, **values: Any) -> None:
        """Read the file with other settings; another scale removes everything on the map."""
        state = self._state
        source = replace(state.source, **values) if state.source else None
        if source is None or (isinstance(source, Plan) and source.pixel_m is None):
            state.source = source
            self._jobs.show()
            return
        python = source.python or [SAVED_MAP]

        def take(partial: PartialMap, warnings: Sequence[str]) -> None:
            if state.plan is None or state.plan.settings["pixel_m"] == source.settings["pixel_m"]:
                state.source = source
                self._change_map(partial, python)
                state.map_warnings = [*warnings]
            else:
                self._take_map(partial, source.name, python, warnings, source)
                self._jobs.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, f"reading {source.name}")
            with collected_warnings() as warnings:
                partial = source.read()
            yield functools.partial(take, partial, warnings)

        self._jobs.begin(work)

    def draw(self, stroke: Stroke) -> None:
        require_choice("stroke", stroke.kind, [name for name in STROKES if name != LENGTH])
        self._redraw((*self._state.strokes, stroke))

    def undo(self) -> None:
        self._redraw(self._state.strokes[:-1])

    def _redraw(self, strokes: tuple[Stroke, ...]) -> None:
        state = self._state
        state.require_map()
        assert state.bare is not None
        state.partial, state.strokes = drawn(state.bare, strokes), strokes
        self._jobs.predict_for(state.transmitters)

    def _take_map(
        self,
        partial: PartialMap,
        title: str,
        python: list[str],
        warnings: Sequence[str] = (),
        source: Source | None = None,
        strokes: tuple[Stroke, ...] = (),
    ) -> None:
        state = self._state
        state.forget_map()
        self._jobs.forget_answer()
        state.title, state.map_warnings, state.source, state.strokes = title, [*warnings], source, strokes
        state.fit(partial, python)

    def _change_map(self, partial: PartialMap, python: list[str]) -> None:
        """Take another map of the same building, and predict."""
        self._state.map_warnings, self._state.action_warnings = [], []
        self._jobs.forget_answer()
        self._state.fit(partial, python)
        self._jobs.predict_for(self._state.transmitters)
