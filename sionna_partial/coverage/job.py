"""predict_map: receivers on a grid -> links -> mean over positions, measurements -> xarray.Dataset."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import (
    Progress,
    float_array,
    no_progress,
    require,
    require_choice,
    require_memory,
    require_names,
    transmitter_names,
    with_height,
)
from sionna_partial.constants import DEFAULT_HEIGHT_M, MEMORY_GB
from sionna_partial.coverage.dataset import ANTENNA, OFFSET
from sionna_partial.coverage.grid import (
    RECEIVERS,
    GridArea,
    Receivers,
    checked_area,
    coverage_map,
    grid_receivers,
    join_transmitters,
    link_columns,
    provenance,
    receivers_at_once,
    with_posterior,
)
from sionna_partial.display import part_of, reporting
from sionna_partial.errors import PositionError
from sionna_partial.link_model import LinkModel, PredictedLinks, link_model_of
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.measurements.kinds import GAIN_OFFSET_STD_DB
from sionna_partial.measurements.localisation import TransmitterPosterior, locate_transmitter
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.selection import measurements_of_each, measurements_of_others, nearest_transmitters
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.settings import SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.antennas import Antenna, AntennaPattern
from sionna_partial.tracing.positions import clear_of_walls, nearest_m
from sionna_partial.tracing.simulation import Simulation

OneAntenna: TypeAlias = Antenna | AntennaPattern | str | None
TxAntenna: TypeAlias = OneAntenna | Sequence[OneAntenna] | Mapping[str, OneAntenna]

POSITIONS = 4
"""Number of positions over which the coverage of an unknown transmitter is averaged."""

OFFSET_DEVIATIONS = 2.0
"""Offset of measurements that is logged, in standard deviations of its estimate and of the offset of path gains."""

UNSURE_P = 0.05
"""Smallest logged probability of the less probable kind of measurements."""

LOCATING_FRACTION = 0.3
"""Fraction of the progress bar for finding a transmitter."""


_log = logging.getLogger(__name__)


@takes_settings
def predict_map(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    tx: ArrayLike | Mapping[str, ArrayLike] | None = None,
    *,
    tx_antenna: TxAntenna = None,
    rx_height_m: float = DEFAULT_HEIGHT_M,
    spacing_m: float = 0.15,
    area_m: tuple[float, float, float, float] | None = None,
    predictor: Predictor | str | Path | None = None,
    scene_settings: SceneSettings | None = None,
    trace_settings: TraceSettings | None = None,
    measurements: Any = None,
    receivers: str = RECEIVERS[0],
    memory_gb: float = MEMORY_GB,
    progress: Progress | bool | None = None,
) -> xr.Dataset:
    """Predict link state and path gain, with their uncertainty, everywhere on a map.

    The known part of the map is traced. The predictor turns the traced links and the unobserved lengths into
    distributions (paper, Section III). On a complete map the trace is the prediction.

    Probabilities and gains are conditional on an indoor receiver; `p_indoor` is its probability. With
    ``receivers="anywhere"`` they include outdoor receivers, which are in outage. On a complete map free cells are
    indoors, all others outdoors.

    Receivers within 1.1 cm of a wall or of the transmitter (or within wavelength / 4 pi, where Friis' formula exceeds 0
    dB) have `valid` False and NaN in floating-point variables and link states; a NetCDF file stores these states as
    255.

    Without `tx`, measurements locate the transmitter: `p_transmitter` is the posterior of its position, and
    probabilities and gains are averaged over 4 positions drawn from it.

    Parameters
    ----------
    scene : PartialMap, path, Simulation or LinkModel
        A map, or a file that `load_map` reads. With a `LinkModel`, later calls are faster.
    tx : (3,) or (2,) array-like, (T, 3) array-like, mapping of names to positions, or None
        Transmitter position [m], also in unknown space; z is 1.5 m by default. Several are named "tx1", "tx2" etc., or
        as in the mapping. None if unknown: `measurements` then are of one transmitter, 1.5 m high unless they have its
        z.
    tx_antenna : Antenna, AntennaPattern or str, a sequence of these or mapping of names to them, optional
        Antenna of the transmitter, or of each of several; isotropic and vertically polarised by default. Gains include
        it; link states do not depend on it, a link in a null of the pattern is no outage.
    rx_height_m : float
        Height of the receivers [m].
    spacing_m : float
        Distance between receivers [m]. The grid starts half of it inside the lower-left corner of the map.
    area_m : (float, float, float, float), optional
        Smallest x and y and largest x and y of the grid [m]; by default those of the map (`PartialMap.bounds_m`).
    predictor : None, "map", "paper", path or Predictor
        None is the shipped default, "map"; a path is a saved predictor. Not used on a complete map.
    scene_settings : SceneSettings, optional
    trace_settings : TraceSettings, optional
    measurements : Measurements, mapping, data frame or path, optional
        Measured gains (see `Measurements`), which improve the prediction of other receivers (`Assimilation`). Gains of
        transmitters farther than 0.5 m from `tx` are not used where walls are opaque; through walls they contribute to
        the material of walls and the offset of powers. Where the material is unknown, the attributes `wall_material`
        and `wall_loss_db` contain its probabilities and the expected loss of a wall.
    receivers : {"indoor", "anywhere", "inside", "near"}
        Receivers that probabilities and gains refer to. "inside" is "indoor" without the receivers outside a complete
        map, and "near" is "indoor" without those farther than 1 m (two spacings, if more) from free cells; these are
        then not `valid`: faster.
    memory_gb : float
        Memory limit of the process [GB]. Receivers are traced and predicted in blocks that fit.
    progress : bool or callable, optional
        False shows none; a callable is called as ``progress(fraction_done, message)``. Default: a bar in terminals and
        notebooks after 2 s.

    Returns
    -------
    xarray.Dataset
        On (y, x) [m]: the variables of `ATTRIBUTES`, with settings, versions and predictor in attributes. Variables
        that depend on several transmitters are on (tx, y, x); ``.sel(tx=name)`` selects one. Without `tx` also
        `p_transmitter` on (tx_y, tx_x), the probability of each cell; the attribute `transmitter_m` is then the
        position with the smallest expected distance, `transmitter_std_m` the root mean square distance from it, and the
        features are from the drawn position nearest to it.

    Raises
    ------
    MapError
        If the map cannot be read.
    MemoryLimitError
        If the job needs more than `memory_gb`, before it begins.
    MeasurementError
        If the measurements cannot be read, or none is usable.
    PositionError
        For a transmitter outside the map or in a wall, or if no receiver is valid.
    SettingsError
        For a height, spacing, area or frequency out of range, or another value of `receivers`.
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
    model = link_model_of(scene, predictor, trace_settings, scene_settings)
    require_choice("receivers", receivers, RECEIVERS)
    require_memory(memory_gb)
    where = GridArea(rx_height_m, spacing_m, checked_area(model.partial, area_m), receivers)
    names, transmitters = _transmitters(model, tx, tx_antenna, measurements, where)
    block = receivers_at_once(model.partial, transmitters[0].grid, memory_gb)
    maps, weights = [], []
    with reporting(progress) as report:
        report(0.0, "building the scene")
        job = CoverageJob(model, where, block).with_others(transmitters, measurements)
        for number, transmitter in enumerate(transmitters):
            part = part_of(report, number / len(transmitters), (number + 1) / len(transmitters))
            coverage, of_materials = job.coverage(transmitter, part)
            maps.append(coverage)
            weights.append(of_materials)
        report(1.0, "done")
    coverage = maps[0] if names is None else join_transmitters(maps, names)
    if model.simulation.material_unknown:
        coverage.attrs |= model.wall_materials.attributes(np.mean(weights, axis=0), model.partial.unnamed_walls)
    return coverage


@dataclass(frozen=True)
class Transmitter:
    """A transmitter to predict, at `position_m` (3,) or located by measurements (None)."""

    name: str
    position_m: Floats | None
    antenna: Antenna
    grid: Receivers
    measured: Measurements | None = None


@dataclass(frozen=True)
class _Source:
    """Possible positions (K, 3) [m] of a transmitter, their weights and assimilations, and the best estimate."""

    tx_m: Floats
    weights: Floats
    assimilations: Sequence[Assimilation]
    position_m: Floats
    antenna: Antenna


@dataclass(frozen=True)
class CoverageJob:
    """Coverage of one transmitter after the other, `block` receivers at a time."""

    model: LinkModel
    area: GridArea
    block: int
    others: Mapping[str, Sequence[Assimilation]] = field(default_factory=dict)
    """Assimilated measurements of other transmitters, by the transmitter they are used for."""

    def coverage(self, transmitter: Transmitter, report: Progress) -> tuple[xr.Dataset, Floats]:
        model, measured, grid = self.model, transmitter.measured, transmitter.grid
        posterior = None
        if transmitter.position_m is None:
            posterior = self.located(transmitter, report)
            source = self._source(transmitter, *posterior.draw(POSITIONS), posterior.position_m)
            grid = grid_receivers(model.simulation, source.tx_m, self.area)
        else:
            source = self._source(transmitter, transmitter.position_m[None], np.ones(1), [None], transmitter.position_m)
        blocks, complete = [], True
        anywhere = self.area.receivers == "anywhere"
        for links in self._averaged(source, grid.rx_m, report):
            blocks.append(link_columns(links.phi, links.prediction, links.p_indoor, anywhere=anywhere))
            complete &= bool(links.complete.all())
        values = {name: np.concatenate([columns[name] for columns in blocks]) for name in blocks[0]}
        attributes = provenance(model.simulation, None if complete else model.predictor) | {
            "transmitter_m": source.position_m,
            ANTENNA: str(source.antenna),
            "rx_height_m": float(self.area.rx_height_m),
            "spacing_m": float(self.area.spacing_m),
            "receivers": "anywhere" if anywhere else RECEIVERS[0],
        }
        if measured is not None and len(measured):
            attributes |= _measurement_attributes(measured, source)
        coverage = coverage_map(model.partial, grid, values, attributes)
        weights = model.wall_materials.prior if model.simulation.material_unknown else np.ones(1)
        if source.assimilations:
            weights = source.weights @ [fitted.material_weights for fitted in source.assimilations]
        return coverage if posterior is None else with_posterior(coverage, posterior), weights

    def with_others(self, transmitters: Sequence[Transmitter], measurements: Any) -> CoverageJob:
        """Return the job with the measurements of other transmitters assimilated, each alone.

        They give the prior of offset and loss of walls, except where walls are opaque or the transmitter is unknown.
        Transmitters that are not predicted are assumed to have the antenna of the predicted one, in an unknown
        orientation.
        """
        settings = self.model.simulation.trace_settings
        sources_m = [each.position_m[None] for each in transmitters if each.position_m is not None]
        if measurements is None or not sources_m or not settings.through_walls:
            return self
        measured = measurements_of_others(self.model.partial, sources_m, measurements, settings.frequency_hz)
        owned = nearest_transmitters(np.reshape([each.tx[0] for each in measured], (-1, 3)), sources_m)
        antennas = [transmitter.antenna for transmitter in transmitters]
        averaged = {antenna: antenna.averaged(settings.frequency_hz) for antenna in {*antennas}} if measured else {}
        fitted: dict[tuple[int, Antenna], Assimilation] = {}
        others: dict[str, list[Assimilation]] = {transmitter.name: [] for transmitter in transmitters}
        for transmitter, own in zip(transmitters, owned, strict=True):
            for at in np.flatnonzero(~own).tolist():
                has_owner, owner = owned[:, at].any(), int(owned[:, at].argmax())
                antenna = antennas[owner] if has_owner else averaged[transmitter.antenna]
                if (at, antenna) not in fitted:
                    fitted[at, antenna] = self._assimilated(measured[at].tx[0], measured[at], antenna)
                others[transmitter.name].append(fitted[at, antenna])
        return replace(self, others=others)

    def _source(
        self,
        transmitter: Transmitter,
        tx_m: Floats,
        weights: Floats,
        p_powers: Sequence[float | None],
        position_m: Floats,
    ) -> _Source:
        p_any = float(weights @ [p or 0.0 for p in p_powers])
        if min(p_any, 1.0 - p_any) > UNSURE_P:
            _log.warning(
                "with probability %.2f powers were measured and no path gains: give gains if their offset is known",
                p_any,
            )
        assimilations: list[Assimilation] = []
        measured, others = transmitter.measured, self.others.get(transmitter.name, ())
        if measured is None and others:
            measured = Measurements(position_m, np.zeros((0, 3)), np.zeros(0))
        if measured is not None:
            for at_m, p in zip(tx_m, p_powers, strict=True):
                walks = assimilations[0].walks if assimilations else None  # of the same receivers
                options = {"p_powers": p, "others": others, "walks": walks}
                assimilations.append(self._assimilated(at_m, measured, transmitter.antenna, **options))
        return _Source(tx_m, weights, assimilations, position_m, transmitter.antenna)

    def _averaged(self, source: _Source, rx_m: Floats, report: Progress) -> Iterator[PredictedLinks]:
        tx_m, begin = source.tx_m, LOCATING_FRACTION * (len(source.tx_m) > 1)
        nearest = int(np.linalg.norm(tx_m - source.position_m, axis=1).argmin())
        for start in range(0, len(rx_m), self.block):
            block_m, found = rx_m[start : start + self.block], []
            for index, at_m in enumerate(tx_m):

                def within(fraction: float, message: str, start: int = start, index: int = index) -> None:
                    done = (start + (index + fraction) / len(tx_m) * self.block) / len(rx_m)
                    report(min(0.99, begin + (1.0 - begin) * done), message)

                links = self.model.links(at_m, block_m, within, source.antenna)
                predicted = links.prediction
                if source.assimilations:
                    predicted = source.assimilations[index].update(block_m, predicted)
                if links.antenna_db.any():
                    predicted = predicted.amplified(links.antenna_db)
                found.append(links._replace(prediction=predicted))
            yield found[nearest]._replace(
                prediction=LinkPrediction.mixture([links.prediction for links in found], source.weights),
                p_indoor=source.weights @ [links.p_indoor for links in found],
                complete=np.all([links.complete for links in found], axis=0),
            )

    def _prior(
        self, tx_m: Floats, rx_m: Floats, antenna: Antenna, *, at_rx: bool = False
    ) -> tuple[LinkPrediction, Floats, Floats]:
        """Predict links to receivers (N, 3) [m] without antenna; also return antenna gain and P(indoor)."""
        parts_m = [rx_m[start : start + self.block] for start in range(0, max(len(rx_m), 1), self.block)]
        blocks = [self.model.links(tx_m, part_m, no_progress, antenna, at_rx=at_rx) for part_m in parts_m]
        antenna_db = np.concatenate([links.antenna_db for links in blocks])
        p_indoor = np.concatenate([links.p_indoor for links in blocks])
        return LinkPrediction.concatenate([links.prediction for links in blocks]), antenna_db, p_indoor

    def located(self, transmitter: Transmitter, report: Progress) -> TransmitterPosterior:
        """Return the posterior over positions of a transmitter with measurements."""
        partial, measured = self.model.partial, transmitter.measured
        assert measured is not None
        measured_at, limit_m = cKDTree(measured.rx), nearest_m(self.model.simulation.trace_settings.frequency_hz)

        def allowed(points_m: Floats) -> Bools:
            return clear_of_walls(partial, points_m) & (measured_at.query(points_m)[0] >= limit_m)

        def predict(tx_m: Floats, rx_m: Floats) -> tuple[LinkPrediction, Floats, Floats]:
            return self._prior(tx_m, rx_m, transmitter.antenna, at_rx=True)

        part = part_of(report, 0.0, LOCATING_FRACTION)
        settings = self.model.simulation.trace_settings
        through_walls_hz = settings.frequency_hz if settings.through_walls else None
        return locate_transmitter(partial, measured, allowed, predict, part, through_walls_hz=through_walls_hz)

    def _assimilated(self, tx_m: Floats, measured: Measurements, antenna: Antenna, **options: Any) -> Assimilation:
        prior, antenna_db, _ = self._prior(tx_m, measured.rx, antenna)
        settings = self.model.simulation.trace_settings
        options |= {
            "antenna_db": antenna_db,
            "frequency_hz": settings.frequency_hz,
            "through_walls": settings.through_walls,
        }
        return Assimilation.fit(self.model.partial, tx_m, measured, prior, **options)


def _transmitters(
    model: LinkModel,
    tx: ArrayLike | Mapping[str, ArrayLike] | None,
    tx_antenna: TxAntenna,
    measurements: Any,
    area: GridArea,
) -> tuple[list[str] | None, list[Transmitter]]:
    partial, frequency_hz = model.partial, model.simulation.trace_settings.frequency_hz
    names: list[str] | None = None
    positions_m: list[Floats | None] = [None]
    if tx is not None or measurements is None:
        names, known_m = transmitter_positions(partial, tx)
        positions_m = [*known_m]
    antennas = antennas_of(tx_antenna, names)
    for antenna in {*antennas}:
        antenna.warn_of_frequency(frequency_hz)
    sources_m = [np.empty((0, 3)) if at_m is None else at_m[None] for at_m in positions_m]
    grids = [grid_receivers(model.simulation, tx_m, area) for tx_m in sources_m]
    measured: list[Measurements | None] = [None] * len(sources_m)
    if measurements is not None:
        measured = measurements_of_each(partial, sources_m, measurements, frequency_hz)
    rows = zip(names or [""], positions_m, antennas, grids, measured, strict=True)
    return names, [Transmitter(*row) for row in rows]


def transmitter_positions(
    partial: PartialMap, tx: ArrayLike | Mapping[str, ArrayLike] | None
) -> tuple[list[str] | None, Floats]:
    """Return the names of several transmitters (None for one), and positions (T, 3) [m]."""
    if tx is None:
        raise PositionError("tx = None: give x, y and z in metres, or measurements that its position is found from.")
    positions = list(tx.values()) if isinstance(tx, Mapping) else tx
    positions = float_array("tx", positions, PositionError, "give x, y and z in metres, the same for all transmitters.")
    names = [str(name) for name in tx] if isinstance(tx, Mapping) else transmitter_names(len(np.atleast_1d(positions)))
    tx_m = partial.require_positions("tx", with_height(positions), names=names)
    require_names("names of tx", names)
    return None if tx_m.ndim == 1 else names, tx_m.reshape(-1, 3)


def antennas_of(tx_antenna: TxAntenna, names: list[str] | None) -> list[Antenna]:
    if names is None or isinstance(tx_antenna, (Antenna, AntennaPattern, str, type(None))):
        return [Antenna.of(tx_antenna)] * len(names or [""])  # type: ignore[arg-type]
    remedy = f"give one antenna for all transmitters, or one for each of {', '.join(names)}."
    by_name = tx_antenna if isinstance(tx_antenna, Mapping) else {}
    sequence = isinstance(tx_antenna, Sequence) and len(tx_antenna) == len(names)
    require(sequence or {*by_name} == {*names}, "tx_antenna", tx_antenna, remedy)
    return [Antenna.of(by_name[name] if by_name else tx_antenna[at]) for at, name in enumerate(names)]  # type: ignore[index]


def _measurement_attributes(measured: Measurements, source: _Source) -> dict[str, Any]:
    of_each = [(each.noise_db, each.offset_db, each.shadow_scale) for each in source.assimilations]
    noise_db, offset_db, shadow_scale = source.weights @ of_each
    square_db2 = source.weights @ [each.offset_std_db**2 + each.offset_db**2 for each in source.assimilations]
    error_db = math.sqrt(max(0.0, square_db2 - offset_db**2))
    if abs(offset_db) > OFFSET_DEVIATIONS * math.hypot(error_db, GAIN_OFFSET_STD_DB):
        _log.warning(
            "measured gains are %.0f ± %.1f dB %s the predicted ones: taken for an offset, as of transmit power and "
            "antennas",
            abs(offset_db),
            error_db,
            "above" if offset_db > 0 else "below",
        )
    return {
        "measured_links": len(measured),
        "measured_noise_db": float(noise_db),
        OFFSET: float(offset_db),
        "measured_shadow_scale": float(shadow_scale),
    }
