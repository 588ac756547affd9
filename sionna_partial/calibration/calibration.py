"""Calibration of materials: map + measured gains -> materials with uncertainty."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.calibration.link_paths import (
    MeasuredBuilding,
    link_gains_db,
    require_positions,
    start_materials,
    usable_links,
)
from sionna_partial.calibration.material_fit import (
    INCOMPLETE_WEIGHT,
    LOSSLESS,
    MaterialTarget,
    Point,
    Posterior,
    descend,
    lossless_scale_s_m,
    prior_posterior,
    search,
)
from sionna_partial.checks import Progress, require
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.display import Pictured, part_of, reporting
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import measurements_of, merged
from sionna_partial.settings import Material, SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.power import Polarisation, reflection_loss_db
from sionna_partial.tracing.simulation import Simulation, simulation_of

DETERMINED = 0.35
"""Largest standard deviation of a determined parameter, as a fraction of its prior."""

LEAST_OFFSET_DB, FEWEST_DIRECT = 6.0, 3
"""Smallest median error of LOS links that no material explains [dB], and number of such links."""

_log = logging.getLogger(__name__)


@read_only
@dataclass(frozen=True, eq=False)
class MaterialCalibration(Pictured, plot="plots.result_plots:plot_calibration"):
    """Materials fitted to measured gains, and their uncertainty.

    Parameters of a single material are numbers, otherwise arrays (M,): the material of floor, ceiling and all other
    walls, then `scene.wall_materials`; or `scene.mesh.materials`, without unused ones.

    Parameters
    ----------
    permittivity, conductivity_s_m : float or (M,) float64 array
        Real relative permittivity, and conductivity [S/m], constant over frequency.
    permittivity_std, conductivity_std_s_m : float or (M,) float64 array
        Posterior standard deviations.
    undetermined : tuple of str
        Parameters that the measurements hardly determine: "permittivity", or "conductivity[2]" of a mesh.
    loss : (K,) float64 array
        Negative logarithm of the posterior density per link, at the start and after each step.
    noise_db : float
        Estimated standard deviation of the noise [dB].
    offset_db : float
        Offset of measured LOS gains [dB], subtracted from all gains; 0 unless it is too large for any material.
    used : (N,) bool array
        Mask of the used links.
    left_out : dict of str to int
        Number of omitted links by reason.
    gain_db, gain_before_db, gain_after_db : (N,) float64 arrays
        Measured gain less the offset, and traced gain with the initial and the calibrated materials [dB].
    start, materials : tuple of M Material
        Initial and calibrated materials.
    posteriors : tuple of M Posterior
        Posterior of each material: arrays (K,) `permittivity`, `conductivity_s_m` [S/m] and `weight`, which sums to 1.
    scene : PartialMap
        The map with the calibrated materials, for `predict_map`.
    trace_settings : TraceSettings

    Examples
    --------
    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> cells = np.pad(np.zeros((3, 4), dtype=int), 1, constant_values=1)
    >>> room, tx = sp.map_from_array(cells, resolution_m=1.0), (1.5, 1.5, 1.5)
    >>> rx = [(x, y, 1.5) for x in (2.2, 2.9, 3.6, 4.3) for y in (1.7, 2.4, 3.1)]
    >>> measured = sp.Measurements(tx, rx, sp.trace_links(room, tx, rx).gain_db)
    >>> found = sp.calibrate_materials(room, measured)
    >>> found.used.sum().item(), found.scene == room
    (12, False)
    """

    permittivity: Any
    conductivity_s_m: Any
    permittivity_std: Any
    conductivity_std_s_m: Any
    undetermined: tuple[str, ...]
    loss: Floats
    noise_db: float
    offset_db: float
    used: Bools
    left_out: dict[str, int]
    gain_db: Floats
    gain_before_db: Floats
    gain_after_db: Floats
    start: tuple[Material, ...]
    materials: tuple[Material, ...]
    posteriors: tuple[Posterior, ...]
    scene: PartialMap
    trace_settings: TraceSettings

    def reflection_loss_db(
        self, angle_deg: ArrayLike, polarisation: Polarisation = "te", *, which: int = 0
    ) -> tuple[Floats, Floats]:
        """Return the loss of a reflection at the calibrated material, and its standard deviation.

        Parameters
        ----------
        angle_deg : array-like
            Angle of incidence from the normal, 0 to 90 [degrees].
        polarisation : {"te", "tm"}
            "te" applies to vertical antennas at walls.
        which : int
            Number of the material.

        Returns
        -------
        loss_db, std_db : float64 arrays of the angle's shape
        """
        angle, material, posterior = np.asarray(angle_deg, float), self.materials[which], self.posteriors[which]
        rest = material.thickness_m, self.trace_settings.frequency_hz
        best = reflection_loss_db(material.relative_permittivity, material.conductivity_s_m, *rest, angle, polarisation)
        others = reflection_loss_db(
            posterior.permittivity, posterior.conductivity_s_m, *rest, angle[..., None], polarisation
        )
        return best, np.sqrt((others - best[..., None]) ** 2 @ posterior.weight)

    def record(self) -> dict[str, Any]:
        """Return the result as plain data, without the map and the gains of single links."""
        numbers = "permittivity", "permittivity_std", "conductivity_s_m", "conductivity_std_s_m"
        plain = {name: np.asarray(getattr(self, name)).tolist() for name in (*numbers, "loss", "noise_db", "offset_db")}
        rmse_db = {
            when: float(np.sqrt(np.mean((gain_db - self.gain_db)[self.used] ** 2)))
            for when, gain_db in (("before", self.gain_before_db), ("after", self.gain_after_db))
        }
        return {
            **plain,
            "undetermined": list(self.undetermined),
            "links_used": int(self.used.sum()),
            "links_left_out": self.left_out,
            "rmse_db": rmse_db,
            "start": [asdict(material) for material in self.start],
            "materials": [asdict(material) for material in self.materials],
            "frequency_hz": self.trace_settings.frequency_hz,
        }


@takes_settings
def calibrate_materials(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    measurements: Any,
    *,
    start: Material | None = None,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    seed: int | None = None,
    progress: Progress | bool | None = None,
) -> MaterialCalibration:
    """Estimate permittivity and conductivity of walls, floor and ceiling from measured path gains.

    Paths are traced once; Sionna RT evaluates their power for any material. The whole plane of permittivity and
    conductivity is searched, so that the result does not depend on the start, and refined by Newton's method. The
    result is the material whose reflection losses are nearest to their posterior mean. The thickness is fixed.

    Repeated measurements (both ends in the same cubes of 1 cm) are averaged. Links of a partial map are used if the
    line of sight, or half of the NLOS power, is in observed space; outages are not used (`docs/calibration.md`).

    `predict_map` with measurements averages over materials below 24 GHz and needs no calibration. Calibrate with a
    hundred or more path gains if reflections matter, or for channels and gradients.

    Parameters
    ----------
    scene : PartialMap, path, Simulation or LinkModel
        Map of the building.
    measurements : Measurements, mapping, data frame, Dataset or path of a CSV
        `tx` (N, 3) [m], `rx` (N, 3) [m] and `gain_db` (N,) [dB] (see `measurements_of`).
    start : Material, optional
        Initial material, also its thickness; by default the material of the scene.
    trace_settings : TraceSettings, optional
        Without diffuse reflection, and on meshes without diffraction.
    scene_settings : SceneSettings, optional
    seed : int, optional
        Seed of the rays on meshes, replaces the one in `trace_settings`.
    progress : bool or callable, optional
        As in `predict_map`.

    Returns
    -------
    MaterialCalibration

    Raises
    ------
    MeasurementError
        For damaged measurements, too few usable links, no reflections, or more than 3,000 links.
    PositionError
        For a position outside the map, inside a wall, or not between floor and ceiling.
    SettingsError
        For a frequency that a material does not cover, or paths that only rays find.
    BackendError
        If LLVM or Sionna RT cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> cells = np.pad(np.zeros((3, 4), dtype=int), 1, constant_values=1)
    >>> room, tx = sp.map_from_array(cells, resolution_m=1.0), (1.5, 1.5, 1.5)
    >>> rx = [(x, y, 1.5) for x in (2.2, 2.9, 3.6, 4.3) for y in (1.7, 2.4, 3.1)]
    >>> measured = sp.Measurements(tx, rx, sp.trace_links(room, tx, rx).gain_db)
    >>> found = sp.calibrate_materials(room, measured)
    >>> abs(found.permittivity - 2.94) < 2.0 * found.permittivity_std
    True
    """
    require(start is None or isinstance(start, Material), "start", start, "give a Material, or None for the scene's.")
    simulation = simulation_of(scene, trace_settings, scene_settings)
    partial, (settings, scene_settings) = simulation.partial, simulation.resolved
    settings = settings if seed is None else replace(settings, seed=seed)
    measured = measurements_of(measurements)
    measured.require_transmitters()
    require_positions(partial, measured, settings.frequency_hz)
    links, link, variance = merged(measured)
    building = MeasuredBuilding(partial, start_materials(partial, start, scene_settings, settings.frequency_hz))
    with reporting(progress) as report:
        report(0.0, "building the scene")
        paths = building.paths(links, settings, scene_settings, report)
        used, left_out = usable_links(partial, paths, links, np.bincount(link))
        weight = 1.0 if partial.is_complete else INCOMPLETE_WEIGHT
        begin = tuple(building.start.values())
        target = MaterialTarget(paths.of_links(used), links.gain_db[used], variance[used], weight)
        target.has_offset = _has_offset(target, begin)
        fit = _fit(target, begin, settings.frequency_hz, report)
        report(1.0, "done")
    materials = tuple(
        Material(float(permittivity), float(conductivity_s_m), each.thickness_m)
        for (permittivity, conductivity_s_m), each in zip(fit.point.values.T, begin, strict=True)
    )
    gains_db = [
        np.maximum(link_gains_db(paths.power(*each.values), paths.link, len(links)), GAIN_FLOOR_DB)[link]
        for each in (fit.steps[0], fit.point)
    ]
    offset_db = target.offset_db(target.paths.power(*fit.point.values)) if target.has_offset else 0.0
    if target.has_offset:
        message = "links in line of sight were measured %.1f dB %s their path gains: subtracted from all as an offset"
        _log.warning(message, abs(offset_db), "above" if offset_db > 0.0 else "below")
    undetermined = _undetermined(begin, fit)
    for message in undetermined.values():
        _log.warning("%s", message)
    values = (*fit.point.values, *fit.deviations)
    numbers = [float(each[0]) if len(materials) == 1 else each for each in values]
    return MaterialCalibration(
        permittivity=numbers[0],
        conductivity_s_m=numbers[1],
        permittivity_std=numbers[2],
        conductivity_std_s_m=numbers[3],
        undetermined=tuple(undetermined),
        loss=np.minimum.accumulate([each.loss for each in fit.steps]) / used.sum(),
        noise_db=fit.point.errors.noise_db,
        offset_db=offset_db,
        used=used[link],
        left_out=left_out,
        gain_db=measured.gain_db - offset_db,
        gain_before_db=gains_db[0],
        gain_after_db=gains_db[1],
        start=begin,
        materials=materials,
        posteriors=tuple(fit.posteriors),
        scene=building.with_materials(materials),
        trace_settings=settings,
    )


@dataclass(frozen=True)
class _Fit:
    """Steps of the search, chosen materials, and their posteriors; deviations are (2, M)."""

    steps: list[Point]
    point: Point
    posteriors: list[Posterior]
    deviations: Floats


def _has_offset(target: MaterialTarget, start: Sequence[Material]) -> bool:
    if target.is_direct.sum() < FEWEST_DIRECT:
        message = "%d links in line of sight do not show an offset of all measured gains: calibrate with path gains"
        _log.warning(message, target.is_direct.sum())
        return False
    values = np.transpose([[each.relative_permittivity, each.conductivity_s_m] for each in start])
    return abs(target.offset_db(target.paths.power(*values))) >= LEAST_OFFSET_DB


def _fit(target: MaterialTarget, start: Sequence[Material], frequency_hz: float, report: Progress) -> _Fit:
    """Search the plane of each material, then descend from the best fringes."""
    values = [[max(each.relative_permittivity, 1.001), max(each.conductivity_s_m, 1e-6)] for each in start]
    begin = target.at(np.transpose(values))
    rounds = [*range(len(start))] * (1 if len(start) == 1 else 2)
    posteriors: dict[int, Posterior] = {}
    best = [begin]
    for number, which in enumerate(rounds):
        advance = part_of(report, *(0.3 + 0.6 * each / len(rounds) for each in (number, number + 1)))
        best, posteriors[which] = search(target, best[0], which, start[which].thickness_m, frequency_hz, advance)
    descents = [descend(target, each, part_of(report, 0.9, 1.0)) for each in best]
    steps, curvature = min(descents, key=lambda found: found[0][-1].loss)
    ordered = [posteriors[which] for which in range(len(start))]
    typical = [each.typical(material.thickness_m, frequency_hz) for each, material in zip(ordered, start, strict=True)]
    point = target.at(np.stack(typical, axis=1))
    better = [each for each in steps if each.loss < begin.loss]
    return _Fit([begin, *better], point, ordered, _deviations(point, ordered, curvature))


def _deviations(point: Point, posteriors: Sequence[Posterior], curvature: Floats) -> Floats:
    """Return the standard deviations (2, M) of permittivities and conductivities.

    A posterior is of one material with the others fixed; the joint curvature gives a lower bound.
    """
    own = np.stack(
        [
            [each.deviation(values, value) for values, value in zip(each.values, best, strict=True)]
            for each, best in zip(posteriors, point.values.T, strict=True)
        ],
        axis=1,
    )
    if len(posteriors) == 1:
        return own
    together = np.sqrt(np.diag(np.linalg.inv(curvature))).reshape(2, -1)
    return np.maximum(own, together * (point.values - LOSSLESS))


def _undetermined(start: Sequence[Material], fit: _Fit) -> dict[str, str]:
    prior, undetermined = prior_posterior(), {}
    for which, (posterior, material) in enumerate(zip(fit.posteriors, start, strict=True)):
        offsets = {"permittivity": 0.0, "conductivity": 0.1 * lossless_scale_s_m(2.0, material.thickness_m)}
        for row, (name, offset) in enumerate(offsets.items()):
            before, after = (np.log(each.values[row] + offset) for each in (prior, posterior))
            spread = prior.deviation(before, float(prior.weight @ before))
            if posterior.deviation(after, math.log(fit.point.values[row, which] + offset)) > DETERMINED * spread:
                low, high = posterior.interval(posterior.values[row])
                full_name = name if len(start) == 1 else f"{name}[{which}]"
                undetermined[full_name] = (
                    f"the measurements cannot determine the {full_name}: its 95 % interval is {low:.2g} to {high:.2g}"
                    f"{' S/m' * row}. Do not take its value for a property of the material."
                )
    return undetermined
