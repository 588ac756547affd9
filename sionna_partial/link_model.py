"""LinkModel: predicts any links on one map, and keeps the loaded scene and networks between calls."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import Progress, no_progress, require, shown
from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.display import part_of
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.prediction.features import LinkFeatures, context_of, features_of_paths
from sionna_partial.prediction.map_networks import feature_values, rule_values
from sionna_partial.prediction.path_model import AntennaLinks
from sionna_partial.prediction.predictor import AnyPredictor, MeanLosses, OtherPredictor, Predictor, warm_predictor
from sionna_partial.prediction.rule import LinkPrediction, doubt, predicted
from sionna_partial.prediction.unobserved import path_unobserved_m
from sionna_partial.prediction.wall_materials import RESIDUAL_DB, WallMaterials
from sionna_partial.settings import SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.antennas import Antenna
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.positions import checked_positions
from sionna_partial.tracing.simulation import Simulation, simulation_of

KEPT_BLOCKS = 8
"""Number of cached blocks of links."""

_LEAST_DEPTH = 2
"""Smallest `max_depth` for which the networks were trained."""

_log = logging.getLogger(__name__)


class PredictedLinks(NamedTuple):
    """Features and prediction of N indoor receivers, P(indoor), and whether each link meets nothing unknown (N,).

    `prediction` excludes the gain `antenna_db` (N,) of the transmitter's antenna.
    """

    phi: LinkFeatures
    prediction: LinkPrediction
    p_indoor: Floats
    complete: Bools
    antenna_db: Floats

    def amplified(self, gain_db: float) -> PredictedLinks:
        """Return the links of an antenna with that gain in all directions [dB]."""
        has_path = self.phi.link_state != LinkState.OUTAGE
        traced_db = np.where(has_path, np.maximum(self.phi.gain_db + gain_db, GAIN_FLOOR_DB), self.phi.gain_db)
        return self._replace(phi=replace(self.phi, gain_db=traced_db), antenna_db=self.antenna_db + gain_db)


class LinkModel:
    """Predictions of any links on one map. Later calls reuse the scene, the kernels and recent links.

    Every function that predicts on a map also accepts a link model: ``sp.place_transmitter(model)``.

    Parameters
    ----------
    scene : PartialMap, path or Simulation
        The map, or any input of `load_map`.
    predictor : None, "map", "paper", path, Predictor or any object with ``predict(phi)``
        None is the shipped default, which is read for links that are not complete.
    trace_settings : TraceSettings, optional
    scene_settings : SceneSettings, optional

    Attributes
    ----------
    simulation : Simulation
        The trace, with `partial` and settings.
    asked : None, str, path or Predictor
        The argument `predictor`.

    Raises
    ------
    MapError, SettingsError, PredictorError
        As `predict_map`.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> model = sp.LinkModel(sp.map_from_array(cells, resolution_m=1.0))
    >>> model.predict((1.5, 1.5, 1.5), [(3.25, 2.25, 1.5)]).p_los.tolist()
    [1.0]
    >>> cells[1][4] = cells[2][4] = 1  # the robot has seen the wall
    >>> model.update(sp.map_from_array(cells, resolution_m=1.0))
    >>> sp.predict_map(model, (1.5, 1.5, 1.5), spacing_m=0.5).attrs["map_complete"]
    1
    """

    @takes_settings
    def __init__(
        self,
        scene: PartialMap | str | Path | Simulation,
        predictor: Predictor | str | Path | None = None,
        trace_settings: TraceSettings | None = None,
        scene_settings: SceneSettings | None = None,
    ) -> None:
        self.simulation = simulation_of(scene, trace_settings, scene_settings)
        self.asked = predictor
        self._latest: dict[tuple[bytes, bytes, Antenna, bool], PredictedLinks] = {}
        if predictor is not None:
            warm_predictor(predictor)

    def __repr__(self) -> str:
        return f"LinkModel({self.simulation!r}, predictor={shown(self.asked)})"

    @property
    def partial(self) -> PartialMap:
        """The map."""
        return self.simulation.partial

    @cached_property
    def _networks(self) -> Predictor | OtherPredictor:
        networks = warm_predictor(self.asked)
        if isinstance(networks, Predictor) and not self.by_mean_losses:
            warn_of_other_traces(networks, *self.simulation.resolved)
        return networks

    @property
    def by_mean_losses(self) -> bool:
        """True if mean losses predict: the shipped networks were trained on opaque walls."""
        return self.asked is None and self.simulation.trace_settings.through_walls

    @cached_property
    def predictor(self) -> AnyPredictor:
        """The predictor of links that are not complete."""
        if self.by_mean_losses:
            return MeanLosses(self._networks, self.partial, self.simulation.trace_settings.max_walls)
        return self._networks

    @property
    def predictor_of_map(self) -> AnyPredictor | None:
        """The predictor; None on a complete map."""
        return None if self.partial.is_complete else self.predictor

    def update(self, partial: PartialMap) -> None:
        """Replace the map; settings, networks and kernels are kept.

        Raises
        ------
        MapError
            If `partial` is not a PartialMap.
        """
        require_map("partial", partial)
        if partial != self.partial:
            self.simulation = Simulation(partial, self.simulation.trace_settings, self.simulation.scene_settings)
            for of_map in ("_every_path", "predictor"):
                self.__dict__.pop(of_map, None)
            self._latest.clear()

    @cached_property
    def _every_path(self) -> Simulation:
        """Simulation without a tolerance, for antennas at receivers."""
        return self.simulation.with_tolerance(0.0)

    def predict(self, tx: ArrayLike, rx: ArrayLike) -> LinkPrediction:
        """Trace and predict links.

        Parameters
        ----------
        tx : (3,) or (T, 3) array-like
            Transmitter positions [m].
        rx : (N, 3) array-like
            Receiver positions [m], indoors; N may be 0.

        Returns
        -------
        LinkPrediction
            Arrays of shape (N,) or (T, N).

        Raises
        ------
        PositionError
            As `trace_links`.
        """
        phi = self.features(tx, rx)
        return self.predict_features(phi).reshaped((*np.shape(tx)[:-1], len(phi) // max(1, np.size(tx) // 3)))

    def features(self, tx: ArrayLike, rx: ArrayLike) -> LinkFeatures:
        """Return the features of the links in `predict`, sorted by transmitter."""
        tx_m, rx_m = checked_positions(self.partial, tx, rx, self.simulation.trace_settings.frequency_hz)
        return self._features_each([(position_m, rx_m) for position_m in tx_m])

    def predict_each(
        self, ends_m: Sequence[tuple[Floats, Floats]], report: Progress = no_progress
    ) -> tuple[LinkFeatures, LinkPrediction, Bools]:
        """Return features and predictions of links, and a mask of links whose trace is the truth (on complete maps).

        `ends_m` has pairs of a transmitter (3,) and its receivers (N, 3) [m]; links are in this order.
        """
        phi = self._features_each(ends_m, report)
        return phi, self.predict_features(phi), context_of(phi).complete

    def _features_each(self, ends_m: Sequence[tuple[Floats, Floats]], report: Progress = no_progress) -> LinkFeatures:
        share = 1.0 / max(1, len(ends_m))
        parts = (part_of(report, number * share, (number + 1) * share) for number in range(len(ends_m)))
        found = [
            self._features_of_paths(*link_m, self._blocks(*link_m, part))
            for link_m, part in zip(ends_m, parts, strict=True)
        ]
        return LinkFeatures.concatenate(found)

    def _blocks(
        self, tx_m: Floats, rx_m: Floats, report: Progress, antenna: Antenna | None = None
    ) -> Iterator[SolvedPaths]:
        unobserved = None if self.partial.is_complete else functools.partial(path_unobserved_m, self.partial)
        return self.simulation.blocks(tx_m, rx_m, report, antenna, unobserved)

    def _features_of_paths(self, tx_m: Floats, rx_m: Floats, paths: Iterable[SolvedPaths]) -> LinkFeatures:
        settings, unknown = self.simulation.resolved, self.simulation.material_unknown
        return features_of_paths(self.partial, tx_m, rx_m, paths, settings, material_unknown=unknown)

    def predict_features(self, phi: LinkFeatures) -> LinkPrediction:
        """Predict links from their features (`rule.predicted`).

        For an unknown material of walls, the result is the mixture over its candidates.
        """
        features, prior = [phi], np.ones(1)
        if phi.path_power is not None:
            features = self.wall_materials.under(phi, self.partial.unnamed_walls)
            prior = self.wall_materials.prior
        parts = self._predict_under(features, phi)
        if not self.simulation.trace_settings.through_walls:
            return parts[0]
        return LinkPrediction.over_materials(parts, prior, RESIDUAL_DB)

    def _predict_under(self, features: Sequence[LinkFeatures], traced: LinkFeatures) -> list[LinkPrediction]:
        """Predict links under each candidate; networks use the traced features.

        Networks are not loaded where the trace is certain.
        """
        if not doubt(feature_values(traced)).any():
            return [LinkPrediction.of_trace(phi) for phi in features]
        if isinstance(self.predictor, MeanLosses):
            experts = self.predictor.predict_each(features)
        elif self.predictor.has_gate:
            return [self.predictor.predict(traced)] * len(features)
        else:
            experts = [self.predictor.predict(traced)] * len(features)
        of_links = zip(map(rule_values, features), experts, strict=True)
        return [LinkPrediction.of_parts(*predicted(values, expert.by_state)) for values, expert in of_links]

    @property
    def wall_materials(self) -> WallMaterials:
        """The candidates for an unknown material of walls."""
        return WallMaterials.at(self.simulation.trace_settings.frequency_hz, self.partial.wall_class_count)

    def links(
        self,
        tx_m: Floats,
        rx_m: Floats,
        report: Progress = no_progress,
        antenna: Antenna | None = None,
        *,
        at_rx: bool = False,
    ) -> PredictedLinks:
        """Trace and predict the links from (3,) to (N, 3) [m]; the latest blocks are kept."""
        antenna = Antenna.of(antenna)
        if antenna.uniform_gain_dbi:
            return self.links(tx_m, rx_m, report).amplified(antenna.uniform_gain_dbi)
        key = tx_m.tobytes(), rx_m.tobytes(), antenna, at_rx
        if key not in self._latest:
            self._latest[key] = self._new_links(tx_m, rx_m, report, antenna, at_rx)
            _drop_oldest(self._latest)
        return self._latest[key]

    def _new_links(self, tx_m: Floats, rx_m: Floats, report: Progress, antenna: Antenna, at_rx: bool) -> PredictedLinks:
        if antenna.uniform_gain_dbi is not None:
            phi, prediction, complete = self.predict_each([(tx_m, rx_m)], report)
            antenna_db = np.zeros(len(phi))
        else:
            sums = AntennaLinks(antenna, self.simulation.trace_settings.frequency_hz, tx_m, rx_m, at_rx=at_rx)
            found = self._every_path.blocks(tx_m, rx_m, report, Antenna()) if at_rx else None
            paths = sums.added(found or self._blocks(tx_m, rx_m, report, antenna))
            phi = self._features_of_paths(tx_m, rx_m, paths)
            complete = context_of(phi).complete
            phi, prediction, antenna_db = sums.predict(phi, self.predict_features(phi), complete)
        p_indoor = np.zeros(len(phi)) if complete.all() else np.where(complete, 0.0, self.predictor.predict_indoor(phi))
        known = self.partial.state_at(rx_m) != CellState.UNKNOWN
        return PredictedLinks(phi, prediction, np.where(known, 1.0, p_indoor), complete, antenna_db)


def _drop_oldest(kept: dict[Any, Any]) -> None:
    for oldest in [*kept][:-KEPT_BLOCKS]:
        del kept[oldest]


def warn_of_other_traces(model: Predictor, settings: TraceSettings, scene_settings: SceneSettings) -> None:
    """Warn if a predictor was trained on other traces."""
    trained = model.settings
    if trained.through_walls != settings.through_walls:
        then, now = (f"{'through' if kind.through_walls else 'on opaque'} walls" for kind in (trained, settings))
    elif not math.isclose(trained.frequency_hz, settings.frequency_hz, rel_tol=0.05):
        then, now = (f"at {kind.frequency_hz / 1e9:g} GHz" for kind in (trained, settings))
    elif trained.diffraction != settings.diffraction:
        then, now = (f"with{'' if kind.diffraction else 'out'} diffraction" for kind in (trained, settings))
    elif settings.max_depth < _LEAST_DEPTH:
        then, now = (f"with max_depth = {depth}" for depth in (TraceSettings.max_depth, settings.max_depth))
    elif scene_settings.traced_material.itu == "metal":
        then, now = "on walls that transmit", "on walls of metal"
    else:
        return
    message = "predictor %r was trained %s, and is used %s: its predictions of unobserved links are biased"
    _log.warning(message, model.name, then, now)


def link_model_of(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    predictor: Predictor | str | Path | None = None,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
) -> LinkModel:
    """Return a given link model, or make one of a map."""
    if not isinstance(scene, LinkModel):
        return LinkModel(scene, predictor, trace_settings, scene_settings)
    given = {"predictor": predictor, "trace_settings": trace_settings, "scene_settings": scene_settings}
    for name, value in given.items():
        require(value is None, name, value, "the LinkModel that was given has its own: leave it out.")
    return scene
