"""The jobs of one window, the coverage that they predict, and the models that they keep warm."""

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from sionna_partial.apps.app.answer import Answer
from sionna_partial.apps.app.drawing import drawn
from sionna_partial.apps.app.jobs import Status, WindowJobs, collected_warnings
from sionna_partial.apps.app.radio import RadioSettings, Transmitter
from sionna_partial.apps.app.state import WindowState
from sionna_partial.apps.refining import coarse_then_fine
from sionna_partial.arrays import Floats
from sionna_partial.checks import Progress
from sionna_partial.coverage.job import predict_map
from sionna_partial.coverage.network import predict_network
from sionna_partial.display import part_of
from sionna_partial.errors import MeasurementError
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements


@dataclass(frozen=True)
class _Request:
    """Copies of what a window predicts for, as the window may change during the job."""

    partial: PartialMap
    home: PartialMap | None
    settings: RadioSettings
    transmitters: tuple[Transmitter, ...]
    tx_m: dict[str, tuple[float, float, float]]
    measured: Measurements | None

    @property
    def eirp_dbm(self) -> Floats:
        return np.array([each.eirp_dbm for each in self.transmitters])

    @property
    def counted_dbm(self) -> Floats:
        """Powers of the weaker direction [dBm]."""
        return np.minimum(self.eirp_dbm, [self.settings.uplink_dbm(each) for each in self.transmitters])


class PredictionJobs(WindowJobs):
    """Jobs of a window whose results are its newest coverage, `answer`."""

    def __init__(
        self, state: WindowState, call: Callable[[Callable[[], None]], object], show: Callable[[], None]
    ) -> None:
        super().__init__(call, show)
        self._state = state
        self._models: dict[str, tuple[LinkModel, list[str]]] = {}
        self.answer: Answer | None = None
        self._is_outdated = False

    @property
    def final_answer(self) -> Answer | None:
        """The answer, if it is fine and nothing has changed since."""
        answer = self.answer
        return None if answer is None or self._is_outdated or not answer.is_final else answer

    @property
    def warnings(self) -> list[str]:
        """Warnings of the predictor, if the map needs one, and of the jobs since the last answer."""
        partial = self._state.partial
        on_networks = partial is not None and not partial.is_complete
        of_models = [warning for _, found in [*self._models.values()] for warning in found if on_networks]
        return [*of_models, *self._job_warnings]

    def forget_answer(self) -> None:
        self.answer, self._job_warnings = None, []

    def take_answer(self, answer: Answer) -> None:
        self.answer, self._is_outdated, self._job_warnings = answer, False, []

    def ask(self, message: str) -> None:
        """Cancel the job, and show a message instead of an answer."""
        self.cancel()
        self.answer, self.status = None, Status(message)
        self.show()

    def predict_for(self, transmitters: Mapping[str, Transmitter]) -> None:
        self._state.take_transmitters(transmitters)
        self.predict()

    def predict_without_measurements(self, *warnings: str) -> None:
        self._state.measured, self._state.action_warnings = None, [*warnings]
        self.predict()

    def predict(self) -> None:
        """Predict the coverage: a coarse picture first, then the fine one."""
        state, partial = self._state, self._state.require_map()
        home = state.home and drawn(state.home, state.strokes)
        if not state.transmitters:
            self.ask('Click on the map to put a transmitter, or press "Add".')
            return
        transmitters, tx_m = tuple(state.transmitters.values()), state.require_positions_m()
        request = _Request(partial, home, state.settings, transmitters, tx_m, state.measured)

        def work(report: Progress) -> Iterator[Callable[[], None]]:
            try:
                yield from self._answers(request, report)
            except MeasurementError as error:
                warning = f"The measurements are not used any more: {error}"
                yield functools.partial(self.predict_without_measurements, warning)

        self._is_outdated = True
        self.begin(work)

    def _answers(self, request: _Request, report: Progress) -> Iterator[Callable[[], None]]:
        settings, measured = request.settings, request.measured
        for each in coarse_then_fine(settings.spacing_m, part_of(report, 0.0, 0.2), part_of(report, 0.2, 0.7)):
            found = self._coverage("map", request.partial, request, each.spacing_m, each.report, measured=measured)
            answer = Answer(found, request.counted_dbm, settings, each.is_final)
            if each.is_final and len(request.tx_m) > 1:
                report(0.7, "SINR of the network")
                channels = {name: tx.channel for name, tx in zip(request.tx_m, request.transmitters, strict=True)}
                answer = replace(answer, network=network_of(answer, request.eirp_dbm, channels))
            yield functools.partial(self.take_answer, answer)
        if request.home is not None:
            truth = self._coverage("home", request.home, request, settings.spacing_m, part_of(report, 0.75, 1.0))
            yield functools.partial(self.take_answer, replace(answer, truth=truth))

    def _coverage(
        self,
        of: str,
        where: PartialMap,
        request: _Request,
        spacing_m: float,
        report: Progress,
        measured: Measurements | None = None,
    ) -> xr.Dataset:
        return predict_map(
            self.model(of, where, request.settings),
            request.tx_m,
            spacing_m=spacing_m,
            progress=report,
            tx_antenna=[each.antenna for each in request.transmitters],
            rx_height_m=request.settings.rx_height_m,
            receivers="inside",
            measurements=measured,
        )

    def model(self, of: str, partial: PartialMap, settings: RadioSettings) -> LinkModel:
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


def network_of(answer: Answer, eirp_dbm: Floats, channels: Any) -> xr.Dataset:
    """Return SINR and rates of several transmitters, whose channels are given or to be planned."""
    return predict_network(
        answer.coverage,
        tx_power_dbm=eirp_dbm,
        bandwidth_hz=answer.settings.bandwidth_hz,
        channels=channels,
        standard=answer.settings.schemes[0] or None,
    )
