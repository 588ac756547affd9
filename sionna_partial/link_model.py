"""LinkModel: a map, its simulation and a predictor -> the prediction of any links, kept warm between calls."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import (
    Progress,
    no_progress,
    real_array,
    require,
    require_choice,
    require_memory,
    require_names,
)
from sionna_partial.constants import DEFAULT_HEIGHT_M, MEMORY_GB, CellState
from sionna_partial.coverage.dataset import (
    ANTENNA,
    Receivers,
    coverage_map,
    grid_receivers,
    join_transmitters,
    link_columns,
    provenance,
    with_posterior,
)
from sionna_partial.errors import MemoryLimitError, PositionError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.measurements.localisation import TransmitterPosterior, locate_transmitter
from sionna_partial.measurements.measurements import (
    SAME_TX_M,
    Measurements,
    measurements_of_each,
    measurements_of_others,
)
from sionna_partial.prediction.features import LinkFeatures, features_of_paths
from sionna_partial.prediction.path_model import AntennaLinks
from sionna_partial.prediction.predictor import LinkPrediction, OtherPredictor, Predictor, warm_predictor
from sionna_partial.prediction.through_walls import WALL_LOSSES
from sionna_partial.prediction.unobserved import is_enclosed
from sionna_partial.prediction.unseen_walls import UnseenWalls, WallDensity
from sionna_partial.prediction.windows import map_windows
from sionna_partial.progress import part_of, reporting
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.antennas import Antenna, AntennaPattern
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.simulation import Simulation, checked_positions, clear_of_walls, nearest_m, simulation_of

RECEIVERS = ("indoor", "anywhere")
"""Whose probabilities and gains they are; the first is the default."""

_LIBRARIES_GB, _CELL_BYTES, _RECEIVER_BYTES, _WORK_BYTES = 1.0, 40, 400, 120_000
"""Memory of the process with all libraries [GB], of each cell of the map, of each receiver, and of each of those that
are predicted together [bytes]; `benchmarks/scale.py` measures it."""

_FEWEST_RECEIVERS, _MOST_RECEIVERS = 500, 8_000
"""Number of receivers that are predicted together."""

KEPT_BLOCKS = 8
"""Number of blocks of links, and of transmitters' windows, that a link model keeps: 20 MB in all."""

LARGE_OFFSET_DB = 15.0
"""Offset of measurements from which on they are no path gains, but powers [dB]."""

UNSURE = 0.05
"""Least probability of either, that powers or that path gains were measured, with which a warning is logged."""

POSITIONS = 8
"""Number of positions of an unknown transmitter over which coverage is averaged."""

_LOCATING = 0.3
"""Fraction of the progress that finding a transmitter takes."""

_LEAST_DEPTH = 2
"""Interactions from which on a trace is like those of the training."""

OneAntenna: TypeAlias = Antenna | AntennaPattern | str | None
TxAntenna: TypeAlias = OneAntenna | Sequence[OneAntenna] | Mapping[str, OneAntenna]
"""Antennas of transmitters: one of all, or one for each."""

_log = logging.getLogger(__name__)


class PredictedLinks(NamedTuple):
    """Features and prediction of links to N receivers that are indoors, and P(indoor) (N,)."""

    phi: LinkFeatures
    prediction: LinkPrediction
    p_indoor: Floats


class LinkModel:
    """The prediction of any links on one map, kept warm: what a call has loaded and compiled serves the next.

    What takes a map and predicts takes a link model, too: ``sp.place_transmitter(model)``.

    Parameters
    ----------
    scene : PartialMap, path or Simulation
        The map, or whatever `load_map` reads.
    predictor : None, "map", "paper", path, Predictor or any object with ``predict(phi)``
        None is the shipped default, which is read where links are not complete.
    trace_settings : TraceSettings, optional
    scene_settings : SceneSettings, optional

    Attributes
    ----------
    simulation : Simulation
        The trace, with `partial`, `trace_settings` and `scene_settings`.
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
    >>> model.coverage((1.5, 1.5, 1.5), spacing_m=0.5).attrs["map_complete"]
    1
    """

    def __init__(
        self,
        scene: PartialMap | str | Path | Simulation,
        predictor: Predictor | str | Path | None = None,
        trace_settings: TraceSettings | None = None,
        scene_settings: SceneSettings | None = None,
    ) -> None:
        self.simulation = simulation_of(scene, trace_settings, scene_settings)
        self._settings = trace_settings, scene_settings
        if isinstance(scene, Simulation):
            self._settings = scene.trace_settings, scene.scene_settings
        self.asked = predictor
        self._latest: dict[tuple[bytes, bytes, Antenna], PredictedLinks] = {}
        self._windows: dict[bytes, NDArray[np.uint8]] = {}
        if predictor is not None:
            warm_predictor(predictor)

    @property
    def partial(self) -> PartialMap:
        """The map."""
        return self.simulation.partial

    @cached_property
    def predictor(self) -> Predictor | OtherPredictor:
        """The predictor, which is read when it is first needed."""
        model = warm_predictor(self.asked)
        if isinstance(model, Predictor) and not self._by_wall_losses:
            warn_of_other_traces(model, self.simulation.trace_settings, self.simulation.scene_settings)
        return model

    @property
    def _by_wall_losses(self) -> bool:
        """Whether the mean loss of walls predicts: networks trained on opaque walls have no gains behind them."""
        return self.asked is None and self.simulation.trace_settings.through_walls

    @property
    def predictor_of_map(self) -> Predictor | OtherPredictor | None:
        """The predictor; None on a complete map, where the trace from a known cell is the prediction."""
        return None if self.partial.is_complete else self.predictor

    def update(self, partial: PartialMap) -> None:
        """Take a map that has changed, as that of a robot which has seen more, with the same settings.

        The predictor and what is compiled are kept. Predictions are those of a new `LinkModel` of the map.
        """
        if partial != self.partial:
            self.simulation = Simulation(partial, *self._settings)
            for of_map in ("_every_path", "_wall_density"):
                self.__dict__.pop(of_map, None)
            self._latest.clear()
            self._windows.clear()

    @cached_property
    def _every_path(self) -> Simulation:
        """The simulation without a tolerance: paths that are weak without an antenna may be strong with it."""
        settings = replace(self.simulation.trace_settings, power_tolerance_db=0.0)
        return Simulation(self.partial, settings, self.simulation.scene_settings)

    @cached_property
    def _wall_density(self) -> WallDensity:
        """The walls that the map does not show, as far as they can be expected."""
        return UnseenWalls.shipped().of_map(self.partial)

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
            Of shape (N,) or (T, N).

        Raises
        ------
        PositionError
            As `trace_links`.
        """
        phi, prediction, _ = self._checked(tx, rx)
        return prediction.reshaped((*np.shape(tx)[:-1], len(phi) // max(1, np.size(tx) // 3)))

    def features(self, tx: ArrayLike, rx: ArrayLike) -> LinkFeatures:
        """Return the features from which `predict` predicts, one link after the other, transmitter by transmitter."""
        return self._checked(tx, rx)[0]

    def _checked(self, tx: ArrayLike, rx: ArrayLike) -> tuple[LinkFeatures, LinkPrediction, Bools]:
        tx_m, rx_m = checked_positions(self.partial, tx, rx, self.simulation.trace_settings.frequency_hz)
        return self.predict_each([(each_m, rx_m) for each_m in tx_m])

    def predict_each(
        self, ends_m: Sequence[tuple[Floats, Floats]], report: Progress = no_progress
    ) -> tuple[LinkFeatures, LinkPrediction, Bools]:
        """Return features and predictions of links from transmitters (3,), each to receivers (N, 3) of its own [m].

        And which of them are complete. Positions have been checked.
        """
        return self._predict_paths(ends_m, [self.simulation.blocks(*each_m, report) for each_m in ends_m])

    def _predict_paths(
        self, ends_m: Sequence[tuple[Floats, Floats]], paths_of_each: Sequence[Iterable[SolvedPaths]]
    ) -> tuple[LinkFeatures, LinkPrediction, Bools]:
        complete = np.concatenate([self._complete(*each_m) for each_m in ends_m])
        traced = self.simulation.trace_settings, self.simulation.scene_settings
        settings, found = None if complete.all() else self.predictor.settings, []
        context = not complete.all() and (settings is None or settings.networks != "paper")
        for (tx_m, rx_m), paths in zip(ends_m, paths_of_each, strict=True):
            windows = self._windows_around(tx_m) if context else None
            found.append(features_of_paths(self.partial, tx_m, rx_m, paths, traced, windows))
        phi = LinkFeatures.concatenate(found)
        return phi, self.predict_features(phi, complete), complete

    def _windows_around(self, tx_m: Floats) -> NDArray[np.uint8]:
        """Draw the map around a transmitter (3,) [m]; the latest windows are kept."""
        key = tx_m.tobytes()
        if key not in self._windows:
            self._windows[key] = map_windows(self.partial, tx_m[None, :2])
            _drop_oldest(self._windows)
        return self._windows[key]

    def predict_features(self, phi: LinkFeatures, complete: Bools) -> LinkPrediction:
        """Predict links from their features; the trace is the prediction of those that are complete."""
        trace = LinkPrediction.of_trace(phi)
        if complete.all():
            return trace
        if self._by_wall_losses:
            return LinkPrediction.of_mean_losses(phi, self._wall_density.counts(phi)).where(complete, trace)
        return self.predictor.predict(phi).where(complete, trace)

    def links(
        self, tx_m: Floats, rx_m: Floats, report: Progress = no_progress, antenna: Antenna | None = None
    ) -> PredictedLinks:
        """Trace and predict the links from (3,) to (N, 3) [m], which have been checked; the latest blocks are kept."""
        antenna = Antenna.of(antenna)
        key = tx_m.tobytes(), rx_m.tobytes(), antenna
        if key not in self._latest:
            self._latest[key] = self._new_links(tx_m, rx_m, report, antenna)
            _drop_oldest(self._latest)
        return self._latest[key]

    def _new_links(self, tx_m: Floats, rx_m: Floats, report: Progress, antenna: Antenna) -> PredictedLinks:
        if antenna.is_isotropic:
            phi, prediction, complete = self.predict_each([(tx_m, rx_m)], report)
        else:
            sums = AntennaLinks(antenna, self.simulation.trace_settings.frequency_hz, tx_m, rx_m)
            paths = sums.added(self._every_path.blocks(tx_m, rx_m, report, polarisations=2))
            phi, prediction, complete = self._predict_paths([(tx_m, rx_m)], [paths])
            phi, prediction = sums.predict(phi, prediction, complete)
        p_indoor = np.zeros(len(phi)) if complete.all() else np.where(complete, 0.0, self.predictor.predict_indoor(phi))
        known = self.partial.state_at(rx_m) != CellState.UNKNOWN
        return PredictedLinks(phi, prediction, np.where(known, 1.0, p_indoor))

    def coverage(
        self,
        tx: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        tx_antenna: TxAntenna = None,
        rx_height_m: float = DEFAULT_HEIGHT_M,
        spacing_m: float = 0.15,
        measurements: Any = None,
        receivers: str = RECEIVERS[0],
        memory_gb: float = MEMORY_GB,
        progress: Progress | bool | None = None,
    ) -> xr.Dataset:
        """Predict links everywhere on the map: see `predict_map`, which has the same arguments.

        Returns
        -------
        xarray.Dataset
        """
        require_choice("receivers", receivers, RECEIVERS)
        require_memory(memory_gb)
        frequency_hz = self.simulation.trace_settings.frequency_hz
        to_be_found = tx is None and measurements is not None
        names, positions_m = (None, np.empty((0, 3))) if to_be_found else transmitter_positions(self.partial, tx)
        antennas = antennas_of(tx_antenna, names)
        sources_m = [positions_m] if to_be_found else [each[None] for each in positions_m]
        grids = [grid_receivers(self.partial, tx_m, rx_height_m, spacing_m, frequency_hz) for tx_m in sources_m]
        at_once = _receivers_at_once(self.partial, grids[0], memory_gb)
        measured_of_each: list[Measurements | None] = [None] * len(sources_m)
        if measurements is not None:
            measured_of_each = measurements_of_each(self.partial, sources_m, measurements, frequency_hz)
        attributes = {"rx_height_m": float(rx_height_m), "spacing_m": float(spacing_m), "receivers": receivers}
        maps = []
        with reporting(progress) as report:
            report(0.0, "building the scene")
            others = [] if to_be_found or measurements is None else _others(self, sources_m, measurements, at_once)
            for number, (tx_m, grid, measured) in enumerate(zip(sources_m, grids, measured_of_each, strict=True)):
                antenna = antennas[number]
                part = part_of(report, number / len(grids), (number + 1) / len(grids))
                posterior = (
                    _located(self, measured, at_once, antenna, part) if to_be_found and measured is not None else None
                )
                source = _transmitter_of(self, posterior or tx_m[0], measured, at_once, antenna, others)
                if posterior is not None:
                    positions_m = source.tx_m
                    grid = grid_receivers(self.partial, positions_m, rx_height_m, spacing_m, frequency_hz)
                blocks = [
                    link_columns(links.phi, links.prediction, links.p_indoor, anywhere=receivers == "anywhere")
                    for links in _averaged(self, source, grid.rx_m, at_once, part)
                ]
                values = {name: np.concatenate([each[name] for each in blocks]) for name in blocks[0]}
                complete = all(self._complete(each_m, grids[0].rx_m).all() for each_m in positions_m)
                where = {"transmitter_m": source.position_m, ANTENNA: str(antenna), **attributes}
                of_all = provenance(self.simulation, None if complete else self.predictor) | where
                of_all |= {"predictor": WALL_LOSSES} if self._by_wall_losses and not complete else {}
                of_all |= {} if measured is None else _measurement_attributes(measured, source)
                coverage = coverage_map(self.partial, grid, values, of_all)
                maps.append(coverage if posterior is None else with_posterior(coverage, posterior))
            report(1.0, "done")
        return maps[0] if names is None else join_transmitters(maps, names)

    def _complete(self, tx_m: Floats, rx_m: Floats) -> Bools:
        """Whether the trace is the truth of each link from (3,) to (N, 3) [m]: nothing unknown is met."""
        return is_enclosed(self.partial, np.broadcast_to(tx_m, rx_m.shape), rx_m)


def _drop_oldest(kept: dict[Any, Any]) -> None:
    for oldest in [*kept][:-KEPT_BLOCKS]:
        del kept[oldest]


def transmitter_positions(
    partial: PartialMap, tx: ArrayLike | Mapping[str, ArrayLike] | None
) -> tuple[list[str] | None, Floats]:
    """Names of several transmitters, None for one, and positions (T, 3) [m]."""
    if tx is None:
        raise PositionError("tx = None: give x, y and z in metres, or measurements that its position is found from.")
    positions = list(tx.values()) if isinstance(tx, Mapping) else tx
    positions = real_array("tx", positions, PositionError, "give x, y and z in metres, the same for all transmitters.")
    if positions.shape[-1:] == (2,):
        positions = np.insert(positions, 2, DEFAULT_HEIGHT_M, axis=-1)
    tx_m = partial.require_positions("tx", positions)
    names = [str(name) for name in tx] if isinstance(tx, Mapping) else [f"tx{number}" for number in range(len(tx_m))]
    require_names("names of tx", names)
    return None if tx_m.ndim == 1 else names, tx_m.reshape(-1, 3)


def antennas_of(tx_antenna: TxAntenna, names: list[str] | None) -> list[Antenna]:
    """Return the antenna of each transmitter; `names` is None for one."""
    if names is None or isinstance(tx_antenna, (Antenna, AntennaPattern, str, type(None))):
        return [Antenna.of(tx_antenna)] * len(names or [""])  # type: ignore[arg-type]
    remedy = f"give one antenna for all transmitters, or one for each of {', '.join(names)}."
    by_name = tx_antenna if isinstance(tx_antenna, Mapping) else {}
    sequence = isinstance(tx_antenna, Sequence) and len(tx_antenna) == len(names)
    require(sequence or {*by_name} == {*names}, "tx_antenna", tx_antenna, remedy)
    return [Antenna.of(by_name[name] if by_name else tx_antenna[at]) for at, name in enumerate(names)]  # type: ignore[index]


def warn_of_other_traces(model: Predictor, settings: TraceSettings, scene_settings: SceneSettings) -> None:
    """Warn if a predictor is used on traces of another kind than it was trained on."""
    trained = model.settings
    if trained.through_walls != settings.through_walls:
        then, now = (f"{'through' if each.through_walls else 'on opaque'} walls" for each in (trained, settings))
    elif not math.isclose(trained.frequency_hz, settings.frequency_hz, rel_tol=0.05):
        then, now = (f"at {each.frequency_hz / 1e9:g} GHz" for each in (trained, settings))
    elif trained.diffraction != settings.diffraction:
        then, now = (f"with{'' if each.diffraction else 'out'} diffraction" for each in (trained, settings))
    elif settings.max_depth < _LEAST_DEPTH:
        then, now = (f"with max_depth = {depth}" for depth in (TraceSettings.max_depth, settings.max_depth))
    elif scene_settings.material.itu == "metal":
        then, now = "on walls that transmit", "on walls of metal"
    else:
        return
    message = "predictor %r was trained %s, and is used %s: its predictions of unobserved links are biased"
    _log.warning(message, model.name, then, now)


def _receivers_at_once(partial: PartialMap, receivers: Receivers, memory_gb: float) -> int:
    """Return how many receivers are predicted together, or raise a MemoryLimitError if the limit is too low."""
    count = len(receivers.rx_m)
    kept_gb = _LIBRARIES_GB + (_CELL_BYTES * partial.state.size + _RECEIVER_BYTES * receivers.valid.size) / 1e9
    needed_gb = kept_gb + _WORK_BYTES * min(count, _FEWEST_RECEIVERS) / 1e9
    if needed_gb > memory_gb:
        raise MemoryLimitError(
            f"memory_gb = {memory_gb:g} is too little: {count:,} receivers on a map of {partial.state.size:,} cells "
            f"take about {needed_gb:.2g} GB. Give more memory_gb, a larger spacing_m, or a part of the map."
        )
    most = (memory_gb - kept_gb) / _WORK_BYTES * 1e9
    return int(min(max(most, _FEWEST_RECEIVERS), _MOST_RECEIVERS))


@dataclass(frozen=True)
class _Transmitter:
    """Possible positions (T, 3) [m] with weights (T,), the measurements assimilated for each, and the best estimate.

    And its antenna.
    """

    tx_m: Floats
    weights: Floats
    assimilations: Sequence[Assimilation]
    position_m: Floats
    antenna: Antenna


def _averaged(
    model: LinkModel, transmitter: _Transmitter, rx_m: Floats, at_once: int, report: Progress
) -> Iterator[PredictedLinks]:
    """Yield blocks of the links to receivers (N, 3) [m], averaged over the positions."""
    tx_m, begin = transmitter.tx_m, _LOCATING * (len(transmitter.tx_m) > 1)
    nearest = int(np.linalg.norm(tx_m - transmitter.position_m, axis=1).argmin())
    for start in range(0, len(rx_m), at_once):
        block_m, found = rx_m[start : start + at_once], []
        for index, each_m in enumerate(tx_m):

            def within(fraction: float, message: str, start: int = start, index: int = index) -> None:
                done = (start + (index + fraction) / len(tx_m) * at_once) / len(rx_m)
                report(min(0.99, begin + (1.0 - begin) * done), message)

            links = model.links(each_m, block_m, within, transmitter.antenna)
            if transmitter.assimilations:
                updated = transmitter.assimilations[index].update(block_m, links.prediction)
                links = links._replace(prediction=updated)
            found.append(links)
        mixture = LinkPrediction.mixture([links.prediction for links in found], transmitter.weights)
        p_indoor = transmitter.weights @ [links.p_indoor for links in found]
        yield found[nearest]._replace(prediction=mixture, p_indoor=p_indoor)


def _prior(
    model: LinkModel, tx_m: Floats, rx_m: Floats, at_once: int, antenna: Antenna
) -> tuple[LinkPrediction, Floats]:
    """Predict the links to any number of receivers (N, 3) [m], and the probability that each is indoors."""
    blocks = [
        model.links(tx_m, rx_m[start : start + at_once], no_progress, antenna) for start in range(0, len(rx_m), at_once)
    ]
    p_indoor = np.concatenate([links.p_indoor for links in blocks])
    return LinkPrediction.concatenate([links.prediction for links in blocks]), p_indoor


def _located(
    model: LinkModel, measured: Measurements, at_once: int, antenna: Antenna, report: Progress
) -> TransmitterPosterior:
    """Find a transmitter from what was measured of it."""
    measured_at, limit_m = cKDTree(measured.rx), nearest_m(model.simulation.trace_settings.frequency_hz)

    def allowed(points_m: Floats) -> Bools:
        return clear_of_walls(model.partial, points_m) & (measured_at.query(points_m)[0] >= limit_m)

    def predict(tx_m: Floats, rx_m: Floats) -> tuple[LinkPrediction, Floats]:
        return _prior(model, tx_m, rx_m, at_once, antenna)

    return locate_transmitter(model.partial, measured, allowed, predict, part_of(report, 0.0, _LOCATING))


def _transmitter_of(
    model: LinkModel,
    where: Floats | TransmitterPosterior,
    measured: Measurements | None,
    at_once: int,
    antenna: Antenna,
    others: Sequence[Assimilation],
) -> _Transmitter:
    """Assimilate the measurements for a position (3,) [m], or for several that are drawn from a posterior.

    Of the others in the building, what their measurements have in common is known.
    """
    if isinstance(where, TransmitterPosterior):
        (tx_m, weights, p_powers), position_m = where.draw(POSITIONS), where.position_m
        p_any = float(weights @ [each or 0.0 for each in p_powers])
        if min(p_any, 1.0 - p_any) > UNSURE:
            message = (
                "with probability %.2f powers were measured and no path gains: give gains if their offset is known"
            )
            _log.warning(message, p_any)
    else:
        tx_m, weights, p_powers, position_m = where[None], np.ones(1), [None], where
    assimilations = []
    if measured is not None:
        for each_m, each_p in zip(tx_m, p_powers, strict=True):
            elsewhere = [each for each in others if np.linalg.norm(each.tx_m - each_m) > SAME_TX_M]
            assimilations.append(
                _assimilated(model, each_m, measured, at_once, antenna, p_powers=each_p, others=elsewhere)
            )
    return _Transmitter(tx_m, weights, assimilations, position_m, antenna)


def _assimilated(
    model: LinkModel, tx_m: Floats, measured: Measurements, at_once: int, antenna: Antenna, **options: Any
) -> Assimilation:
    """Predict the measured links of a transmitter (3,) [m], and fit the process to them."""
    prior, _ = _prior(model, tx_m, measured.rx, at_once, antenna)
    settings = model.simulation.trace_settings
    return Assimilation.fit(
        model.partial,
        tx_m,
        measured,
        prior,
        frequency_hz=settings.frequency_hz,
        through_walls=settings.through_walls,
        **options,
    )


def _others(model: LinkModel, sources_m: Sequence[Floats], measurements: Any, at_once: int) -> list[Assimilation]:
    """Assimilate what was measured of other transmitters, each alone; where walls are opaque it teaches nothing."""
    if not model.simulation.trace_settings.through_walls:
        return []
    frequency_hz = model.simulation.trace_settings.frequency_hz
    others = measurements_of_others(model.partial, sources_m, measurements, frequency_hz)
    return [_assimilated(model, each.tx[0], each, at_once, Antenna()) for each in others]


def _measurement_attributes(measured: Measurements, source: _Transmitter) -> dict[str, Any]:
    """Return attributes of the measurements; a large offset is logged."""
    of_each = [(each.noise_db, each.offset_db, each.shadow_scale) for each in source.assimilations]
    noise_db, offset_db, shadow_scale = source.weights @ of_each
    if abs(offset_db) > LARGE_OFFSET_DB:
        _log.warning(
            "measured gains are %.0f dB %s the predicted ones: taken for an offset, as of transmit power and antennas",
            abs(offset_db),
            "above" if offset_db > 0 else "below",
        )
    return {
        "measured_links": len(measured),
        "measured_noise_db": float(noise_db),
        "measured_offset_db": float(offset_db),
        "measured_shadow_scale": float(shadow_scale),
    }


def link_model_of(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    predictor: Predictor | str | Path | None = None,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
) -> LinkModel:
    """Return a link model as it is, or make one of a map; a link model has its predictor and settings."""
    if not isinstance(scene, LinkModel):
        return LinkModel(scene, predictor, trace_settings, scene_settings)
    given = {"predictor": predictor, "trace_settings": trace_settings, "scene_settings": scene_settings}
    for name, value in given.items():
        require(value is None, name, value, "the LinkModel that was given has its own: leave it out.")
    return scene
