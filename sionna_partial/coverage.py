"""Coverage: map + transmitter + predictor -> coverage map, an xarray.Dataset."""

import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import Progress, no_progress, real_array, require, require_choice, require_number
from sionna_partial.constants import DEFAULT_HEIGHT_M, GAIN_FLOOR_DB, MEMORY_GB, CellState
from sionna_partial.coverage_map import (
    COMPONENTS,
    DISTRIBUTION,
    Receivers,
    coverage_map,
    join_transmitters,
    with_posterior,
)
from sionna_partial.errors import MemoryLimitError, PositionError
from sionna_partial.maps.partial_map import PartialMap, require_height
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.measurements.localisation import TransmitterPosterior, locate_transmitter
from sionna_partial.measurements.measurements import Measurements, measurements_of_each
from sionna_partial.prediction.features import LinkFeatures, features_of_paths
from sionna_partial.prediction.predictor import LinkPrediction, Predictor
from sionna_partial.prediction.unobserved import is_enclosed
from sionna_partial.progress import part_of, reporting
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.simulation import SHORTEST_M, Simulation, clear_of_walls, nearest_m, simulation_of

MAX_RECEIVERS = 2_000_000
"""Largest number of receivers of a coverage map: more is a unit error or a job to cut in pieces."""

RECEIVERS = ("indoor", "anywhere")
"""Whose probabilities and gains they are; the first is the default."""

_LIBRARIES_GB, _CELL_BYTES, _RECEIVER_BYTES, _WORK_BYTES = 1.0, 40, 400, 120_000
"""Memory of the process with all libraries [GB], of each cell of the map, of each receiver, and of each of those that
are predicted together [bytes]; `benchmarks/scale.py` measures it."""

_FEWEST_RECEIVERS, _MOST_RECEIVERS = 500, 8_000
"""Number of receivers that are predicted together."""

LARGE_OFFSET_DB = 15.0
"""Offset of measurements from which on they are no path gains, but powers [dB]."""

POSITIONS = 8
"""Number of positions of an unknown transmitter over which coverage is averaged."""

_LOCATING = 0.3
"""Fraction of the progress that finding a transmitter takes."""

_LEAST_DEPTH = 2
"""Interactions from which on a trace is like those of the training."""

_log = logging.getLogger(__name__)


def predict_map(
    scene: PartialMap | str | Path,
    tx: ArrayLike | Mapping[str, ArrayLike] | None = None,
    *,
    rx_height_m: float = DEFAULT_HEIGHT_M,
    spacing_m: float = 0.15,
    predictor: Predictor | str | Path | None = None,
    scene_settings: SceneSettings | None = None,
    trace_settings: TraceSettings | None = None,
    measurements: Any = None,
    receivers: str = RECEIVERS[0],
    memory_gb: float = MEMORY_GB,
    progress: Progress | bool | None = None,
) -> xr.Dataset:
    """Predict link state and path gain, with their uncertainty, everywhere on a map.

    The known part of the map is traced, and the predictor makes distributions of what the trace found and of how much
    was not observed (paper, Section III). On a complete map the trace itself is the prediction.

    Probabilities and gains are those of a receiver that is indoors, as in the paper; `p_indoor` is how likely that is.
    With ``receivers="anywhere"`` it is mixed in: outdoors, every link counts as an outage. On a complete map
    a receiver is indoors wherever a cell is free, and outdoors elsewhere.

    No receiver is inside a wall, within 1.1 cm of one, or at the transmitter (nearer than 1.1 cm, or than the
    distance of wavelength / 4 pi at which Friis' formula passes 0 dB): `valid` is False there, floating-point
    variables are NaN and link states 255.

    Without `tx`, the position of the transmitter is found from measurements: `p_transmitter` is its posterior, and
    probabilities and gains are averaged over 8 positions drawn from it.

    Parameters
    ----------
    scene : PartialMap or path
        The map, or whatever `load_map` reads.
    tx : (3,) or (2,) array-like, (T, 3) array-like, mapping of names to positions, or None
        Transmitter position [m]; 1.5 m high where no z is given. It may be in unknown space. Several are named "tx0",
        "tx1" and so on, or as in the mapping. None if it is not known: then `measurements` are of one transmitter,
        1.5 m high unless they have its z.
    rx_height_m : float
        Height of the receivers [m].
    spacing_m : float
        Distance between receivers [m]. Their grid starts half of it inside the lower-left corner of the map.
    predictor : None, "map", "paper", path or Predictor
        None is the shipped default, which is "map", a path one that you saved. On a complete map it is read, but not
        used.
    scene_settings : SceneSettings, optional
    trace_settings : TraceSettings, optional
    measurements : Measurements, mapping, data frame or path, optional
        Gains that were measured of this transmitter (see `Measurements`), which improve the prediction of other
        receivers (`Assimilation`). Those of transmitters farther than 0.5 m from `tx` are not used.
    receivers : {"indoor", "anywhere"}
        Probabilities and gains given that a receiver is indoors, or of one that may be outdoors, in outage.
    memory_gb : float
        How much memory the process may take [GB]. Receivers are traced and predicted in blocks that fit.
    progress : bool or callable, optional
        False shows none; a callable is called as ``progress(fraction_done, message)``. By default a bar appears in
        terminals and notebooks after 2 s.

    Returns
    -------
    xarray.Dataset
        On (y, x), in metres: the variables of `ATTRIBUTES`, and the settings, versions and predictor in attributes.
        With several transmitters what depends on them is on (tx, y, x); ``.sel(tx=name)`` is the map of one.
        Without `tx` also `p_transmitter` on (tx_y, tx_x), the probability of each cell; the attribute `transmitter_m`
        is then the position from which the expected distance is smallest, `transmitter_std_m` the root mean square
        distance from it, and features are those of the drawn position next to it.

    Raises
    ------
    MapError
        If the map cannot be read.
    MemoryLimitError
        If the job cannot be done within `memory_gb`; nothing was begun.
    MeasurementError
        If the measurements cannot be read, or none is usable.
    PositionError
        For a transmitter outside the map or in a wall, or if no receiver can be anywhere.
    SettingsError
        For a height, spacing or frequency out of range, or another value of `receivers`.
    PredictorError
        If the predictor cannot be read.
    BackendError
        If LLVM or Sionna RT cannot be used.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> coverage = sp.predict_map(partial, tx=(1.5, 1.5, 1.5), spacing_m=0.5)
    >>> coverage["p_los"].sel(x=3.25, y=2.25).item()
    1.0
    """
    require_choice("receivers", receivers, RECEIVERS)
    simulation = simulation_of(scene, trace_settings, scene_settings)
    partial, trace_settings = simulation.partial, simulation.trace_settings
    require_number("memory_gb", memory_gb, 0.0, 1e6, open_low=True)
    to_be_found = tx is None and measurements is not None
    names, positions_m = (None, np.empty((0, 3))) if to_be_found else transmitter_positions(partial, tx)
    sources_m = [positions_m] if to_be_found else [each[None] for each in positions_m]
    grids = [_receivers(partial, tx_m, rx_height_m, spacing_m, trace_settings.frequency_hz) for tx_m in sources_m]
    at_once = _receivers_at_once(partial, grids[0], memory_gb)
    complete = partial.is_complete and bool(is_enclosed(partial, positions_m, positions_m).all())
    given = None if complete and predictor is None else Predictor.load(predictor)
    model = None if complete else given
    if model is not None:
        _warn_of_other_traces(model, trace_settings, simulation.scene_settings)
    measured_of_each = measurements_of_each(partial, sources_m, measurements, trace_settings.frequency_hz)
    provenance = _provenance(partial, model, simulation.scene_settings, trace_settings)
    maps = []
    links = _Links(partial, simulation, model, at_once)
    with reporting(progress) as report:
        report(0.0, "building the scene")
        for number, (tx_m, grid, measured) in enumerate(zip(sources_m, grids, measured_of_each, strict=True)):
            part = part_of(report, number / len(grids), (number + 1) / len(grids))
            posterior = _located(links, measured, part) if to_be_found and measured is not None else None
            source = _transmitter_of(links, posterior or tx_m[0], measured)
            if posterior is not None:
                grid = _receivers(partial, source.tx_m, rx_height_m, spacing_m, trace_settings.frequency_hz)
            columns = [
                _columns(*block, anywhere=receivers == "anywhere")
                for block in _predictions(links, source, grid.rx_m, part)
            ]
            attributes = {
                **provenance,
                "transmitter_m": source.position_m,
                "rx_height_m": float(rx_height_m),
                "spacing_m": float(spacing_m),
                "receivers": receivers,
            }
            if measured is not None:
                attributes |= _measurement_attributes(measured, source)
            values = {name: np.concatenate([each[name] for each in columns]) for name in columns[0]}
            coverage = coverage_map(partial, grid, values, attributes)
            maps.append(coverage if posterior is None else with_posterior(coverage, posterior))
        report(1.0, "done")
    return maps[0] if names is None else join_transmitters(maps, names)


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
    if not tx_m.size:
        raise PositionError(f"tx has shape {tx_m.shape}: give at least one transmitter.")
    names = [str(name) for name in tx] if isinstance(tx, Mapping) else [f"tx{number}" for number in range(len(tx_m))]
    return None if tx_m.ndim == 1 else names, tx_m.reshape(-1, 3)


def _warn_of_other_traces(model: Predictor, settings: TraceSettings, scene_settings: SceneSettings) -> None:
    """Warn if a predictor is used on traces of another kind than it was trained on."""
    trained = model.settings
    if not math.isclose(trained.frequency_hz, settings.frequency_hz, rel_tol=0.05):
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


def _receivers(
    partial: PartialMap, tx_m: Floats, rx_height_m: float, spacing_m: float, frequency_hz: float
) -> Receivers:
    """Return the receivers, those that are too near a wall or one of the transmitters (T, 3) [m] masked."""
    require_height(partial, "rx_height_m", rx_height_m)
    x_m, y_m = _grid_axes(partial, spacing_m)
    points = np.stack([*np.meshgrid(x_m, y_m), np.full((len(y_m), len(x_m)), rx_height_m)], axis=-1)
    limit_m = nearest_m(frequency_hz)
    cell_state = partial.state_at(points)
    far = np.ones(cell_state.shape, dtype=bool)
    for each_m in tx_m:
        far &= np.linalg.norm(points - each_m, axis=-1) >= limit_m
    valid = far & clear_of_walls(partial, points)
    if not far.any() and limit_m > SHORTEST_M:
        raise PositionError(
            f"every receiver is within {limit_m:.3g} m of the transmitter, where Friis' formula does not hold at "
            f"frequency_hz = {frequency_hz:g}: give a higher frequency, or a larger map."
        )
    if not valid.any():
        raise PositionError(
            "no receiver can stand anywhere, all are inside walls or at the transmitter: "
            f"spacing_m = {spacing_m:g}, give a smaller one."
        )
    return Receivers(x_m, y_m, cell_state, valid, points[valid])


def _grid_axes(partial: PartialMap, spacing_m: float) -> tuple[Floats, Floats]:
    """Return the x (nx,) and y (ny,) of all cell centres that lie on the map [m]."""
    low = partial.resolution_m / 10
    require_number("spacing_m", spacing_m, low, 1e6)
    x0, y0, x1, y1 = partial.bounds_m
    nx, ny = (math.ceil(length / spacing_m - 0.5 - 1e-9) for length in (x1 - x0, y1 - y0))
    size = f"the map is {x1 - x0:g} x {y1 - y0:g} m"
    require(min(nx, ny) > 0, "spacing_m", spacing_m, f"{size}; give {min(x1 - x0, y1 - y0):g} or less.")
    enough = 1.1 * math.sqrt((x1 - x0) * (y1 - y0) / MAX_RECEIVERS)
    remedy = f"{size}, which makes {nx * ny:,} receivers, more than {MAX_RECEIVERS:,}; give {enough:.2g} or more."
    require(nx * ny <= MAX_RECEIVERS, "spacing_m", spacing_m, remedy)
    x_cells, y_cells = (np.arange(count, dtype=np.float64) + 0.5 for count in (nx, ny))
    return x0 + spacing_m * x_cells, y0 + spacing_m * y_cells


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
class _Links:
    """Links that are traced on the known part of the map and predicted, so many at once."""

    partial: PartialMap
    simulation: Simulation
    model: Predictor | None
    at_once: int

    def predict(self, tx_m: Floats, rx_m: Floats, report: Progress) -> tuple[LinkFeatures, LinkPrediction]:
        """Trace and predict the links to receivers (N, 3) [m] that are indoors; without a model the trace predicts."""
        context = self.model is not None and self.model.settings.networks != "paper"
        paths = self.simulation.blocks(tx_m, rx_m, report)
        frequency_hz = self.simulation.trace_settings.frequency_hz
        phi = features_of_paths(self.partial, tx_m, rx_m, paths, frequency_hz, context=context)
        return phi, LinkPrediction.of_trace(phi) if self.model is None else self.model.predict(phi)

    def predict_all(self, tx_m: Floats, rx_m: Floats) -> tuple[LinkPrediction, Floats]:
        """Predict the links to any number of receivers (N, 3) [m], and the probability that each is indoors."""
        predictions, p_indoor = [], []
        for start in range(0, len(rx_m), self.at_once):
            block_m = rx_m[start : start + self.at_once]
            phi, prediction = self.predict(tx_m, block_m, no_progress)
            predictions.append(prediction)
            p_indoor.append(self.p_indoor(block_m, phi))
        return LinkPrediction.concatenate(predictions), np.concatenate(p_indoor)

    def p_indoor(self, rx_m: Floats, phi: LinkFeatures) -> Floats:
        """Probability that each receiver (N,) is indoors."""
        free = self.partial.state_at(rx_m) == CellState.FREE
        return np.where(free, 1.0, 0.0 if self.model is None else self.model.predict_indoor(phi))


@dataclass(frozen=True)
class _Transmitter:
    """Possible positions (T, 3) [m] with weights (T,), the measurements assimilated for each, and the best estimate."""

    tx_m: Floats
    weights: Floats
    assimilations: Sequence[Assimilation]
    position_m: Floats


def _predictions(
    links: _Links, transmitter: _Transmitter, rx_m: Floats, report: Progress
) -> Iterator[tuple[LinkFeatures, LinkPrediction, Floats]]:
    """Yield features, prediction and P(indoor) of blocks of receivers (N, 3) [m], averaged over the positions."""
    tx_m, begin = transmitter.tx_m, _LOCATING * (len(transmitter.tx_m) > 1)
    nearest = int(np.linalg.norm(tx_m - transmitter.position_m, axis=1).argmin())
    for start in range(0, len(rx_m), links.at_once):
        block_m, found = rx_m[start : start + links.at_once], []
        for index, each_m in enumerate(tx_m):

            def within(fraction: float, message: str, start: int = start, index: int = index) -> None:
                done = (start + (index + fraction) / len(tx_m) * links.at_once) / len(rx_m)
                report(min(0.99, begin + (1.0 - begin) * done), message)

            phi, prediction = links.predict(each_m, block_m, within)
            if transmitter.assimilations:
                prediction = transmitter.assimilations[index].update(block_m, prediction)
            found.append((phi, prediction, links.p_indoor(block_m, phi)))
        mixture = LinkPrediction.mixture([prediction for _, prediction, _ in found], transmitter.weights)
        yield found[nearest][0], mixture, transmitter.weights @ [indoor for _, _, indoor in found]


def _located(links: _Links, measured: Measurements, report: Progress) -> TransmitterPosterior:
    """Find a transmitter from what was measured of it."""
    measured_at, limit_m = cKDTree(measured.rx), nearest_m(links.simulation.trace_settings.frequency_hz)

    def allowed(points_m: Floats) -> Bools:
        return clear_of_walls(links.partial, points_m) & (measured_at.query(points_m)[0] >= limit_m)

    return locate_transmitter(links.partial, measured, allowed, links.predict_all, part_of(report, 0.0, _LOCATING))


def _transmitter_of(links: _Links, where: Floats | TransmitterPosterior, measured: Measurements | None) -> _Transmitter:
    """Assimilate the measurements for a position (3,) [m], or for several that are drawn from a posterior."""
    if isinstance(where, TransmitterPosterior):
        (tx_m, weights), position_m = where.draw(POSITIONS), where.position_m
    else:
        tx_m, weights, position_m = where[None], np.ones(1), where
    assimilations = []
    if measured is not None:
        for each_m in tx_m:
            prior, _ = links.predict_all(each_m, measured.rx)
            frequency_hz = links.simulation.trace_settings.frequency_hz
            assimilations.append(Assimilation(links.partial, each_m, measured, prior, frequency_hz))
    return _Transmitter(tx_m, weights, assimilations, position_m)


def _measurement_attributes(measured: Measurements, source: _Transmitter) -> dict[str, Any]:
    """Return attributes of the measurements; a large offset is logged."""
    noise_db, offset_db = source.weights @ [(each.noise_db, each.offset_db) for each in source.assimilations]
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
    }


def _columns(
    phi: LinkFeatures, prediction: LinkPrediction, p_indoor: Floats, *, anywhere: bool
) -> dict[str, NDArray[Any]]:
    """Values (N,) of each variable that depends on the links."""
    if anywhere:
        prediction = prediction.anywhere(p_indoor)
    columns = {name: getattr(prediction, name) for name in (*DISTRIBUTION, *COMPONENTS)} | {
        "p_indoor": p_indoor,
        "partial_gain_db": phi.gain_db,
        "unobserved_distance_m": phi.unobserved_distance_m,
        "distance_m": phi.distance_m,
    }
    columns = {name: values.astype(np.float32) for name, values in columns.items()}
    return columns | {"link_state": prediction.link_state, "partial_link_state": phi.link_state}


def _provenance(
    partial: PartialMap, model: Predictor | None, scene_settings: SceneSettings, trace_settings: TraceSettings
) -> dict[str, Any]:
    """Global attributes on where the numbers come from. No time of day: equal input gives equal files."""
    versions = {}
    for package in ("sionna-partial", "sionna-rt", "mitsuba", "drjit", "keras", "numpy", "xarray"):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    source = ", ".join(f"{package} {number}" for package, number in versions.items())
    return {
        "Conventions": "CF-1.11",
        "title": "Predicted radio coverage of a partially observed environment",
        "source": source,
        "history": "sionna_partial.predict_map",
        "references": "Yin et al., Wireless Channel Prediction in Partially Observed Environments",
        "frequency_hz": float(trace_settings.frequency_hz),
        "gain_floor_db": GAIN_FLOOR_DB,
        "map_resolution_m": partial.resolution_m,
        "map_wall_height_m": partial.wall_height_m,
        "map_observed_fraction": partial.observed_fraction,
        "map_complete": int(model is None),
        "scene_settings": json.dumps(asdict(scene_settings), sort_keys=True),
        "trace_settings": json.dumps(asdict(trace_settings), sort_keys=True),
        "predictor": "none: the map is complete, the trace is the prediction" if model is None else model.name,
        "predictor_sha256": "" if model is None else model.fingerprint,
    }
