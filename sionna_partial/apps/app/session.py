"""One window of the app without its page: its state, its jobs, and the parts that change them."""

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import PurePath
from typing import Any

import numpy as np

from sionna_partial.apps.app.answer import Answer, answer_png
from sionna_partial.apps.app.files import FILES, coverage_file, file_name, project_file
from sionna_partial.apps.app.maps import Maps
from sionna_partial.apps.app.planning import Radios, Searches
from sionna_partial.apps.app.predicting import PredictionJobs
from sionna_partial.apps.app.radio import Transmitter
from sionna_partial.apps.app.state import NO_TRANSMITTER, WindowState
from sionna_partial.apps.app.survey import Survey
from sionna_partial.checks import Progress, require_choice
from sionna_partial.errors import PositionError, SettingsError
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.selection import measurements_of_each
from sionna_partial.plots.logo import read_logo


class Surveys:
    """Changes of the measurements of a window."""

    def __init__(self, state: WindowState, jobs: PredictionJobs) -> None:
        self._state, self._jobs = state, jobs

    def learn(self, content: bytes, name: str = "measured.csv") -> None:
        """Take a survey, and add the transmitters whose positions it has; powers without one are of the chosen one."""
        all_m, plan = self._state.positions_m, self._state.plan
        self._learn_from(lambda: Survey.read(name, content, plan, all_m))

    def assign(self, access_point: str) -> None:
        """Give the chosen transmitter an access point of the survey, or none of them for ""."""
        survey, tx_m = self._state.survey, self._state.require_positions_m()[self._state.chosen]
        assert survey is not None
        self._learn_from(lambda: survey.with_access_point(access_point, tx_m))

    def _learn_from(self, read: Callable[[], Survey]) -> None:
        state, partial, frequency_hz = self._state, self._state.require_map(), self._state.settings.frequency_hz
        all_m = state.positions_m
        tx_m = all_m.get(state.chosen)

        def take(survey: Survey, measured: Measurements | None, added: Mapping[str, Transmitter], *told: str) -> None:
            state.take_transmitters({**state.transmitters, **added})
            state.survey, state.measured = survey, measured
            state.action_warnings += told
            self._jobs.predict()

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            report(0.1, "reading measurements")
            survey = read()
            if survey.has_several and not survey.positions_m:
                count = len(survey.access_points)
                what = f'{survey.name} has {count} access points: choose them in "Access point of the survey".'
                yield functools.partial(take, survey, None, {}, what)
                return
            measured = survey.measurements(tx_m)
            added, told = state.transmitters_at(survey.sources(measured))
            every_m = [*all_m.values(), *(each.position_m for each in added.values())]
            if not every_m:
                raise PositionError(told[0] if told else NO_TRANSMITTER)
            measurements_of_each(partial, [np.array([each_m]) for each_m in every_m], measured, frequency_hz)
            yield functools.partial(take, survey, measured, added, *told)

        self._jobs.begin(work)

    def forget_measurements(self) -> None:
        self._jobs.predict_without_measurements()


class Session(WindowState):
    """State of one window, with the parts that change it.

    Methods are called in one thread; `jobs` computes in another. `call` runs a function in the thread of the window,
    and `show` is called there after changes.
    """

    def __init__(self, call: Callable[[Callable[[], None]], object], show: Callable[[], None]) -> None:
        super().__init__()
        self.jobs = PredictionJobs(self, call, show)
        self.maps = Maps(self, self.jobs)
        self.radios = Radios(self, self.jobs)
        self.searches = Searches(self, self.jobs)
        self.surveys = Surveys(self, self.jobs)
        self.is_receiving = False

    @property
    def answer(self) -> Answer | None:
        return self.jobs.answer

    @property
    def warnings(self) -> list[str]:
        """Warnings of the map, the last action, the predictor, and the jobs since the last answer."""
        return list(dict.fromkeys([*self.map_warnings, *self.action_warnings, *self.jobs.warnings]))

    def look(self, **values: Any) -> None:
        """Change the picture."""
        self.view = replace(self.view, **values)
        self.jobs.show()

    def take_logo(self, content: bytes, name: str) -> None:
        """Take a picture for the report; none for no content."""
        if content:
            read_logo(content)
        self.logo = (file_name(name, "logo"), content) if content else None
        self.jobs.show()

    def file(self, kind: str) -> bytes:
        """Return the newest answer, or the project, as one of `FILES`."""
        require_choice("kind", kind, FILES)
        if kind == "project":
            return project_file(self.project())
        answer = self.jobs.final_answer
        if answer is None:
            raise SettingsError(
                "there is no coverage yet: put a transmitter on the map, and wait for the fine picture."
            )
        threshold_dbm, partial = self.settings.threshold_dbm, self.require_map()
        text = answer.settings.text(partial)
        if kind == "png":
            title = f"{PurePath(self.title).name}\n{text}"
            return answer_png(answer, self.shown_view, threshold_dbm, partial, title, self.plan, self.marks)
        heading, logo = (PurePath(self.title).name, f"{answer.made:%Y-%m-%d}", text), self.logo and self.logo[1]
        return coverage_file(kind, answer.coverage, answer.eirp_dbm, threshold_dbm, heading, scene=partial, logo=logo)
