"""Which material makes the measured gains likeliest, how sure that is, and the map with it: measurements -> scene."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial as bind
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.calibration.material_fit import (
    MaterialTarget,
    Point,
    Posterior,
    descend,
    lossless_scale_s_m,
    prior_posterior,
)
from sionna_partial.calibration.material_search import search
from sionna_partial.calibration.measured_building import (
    LinkPaths,
    MeasuredBuilding,
    link_gains_db,
    require_places,
    start_materials,
    usable_links,
)
from sionna_partial.checkpoint import Checkpoint, run_fingerprint
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements, measurements_of
from sionna_partial.settings import Material, SceneSettings, TraceSettings, require
from sionna_partial.tracing.slab import Polarisation, reflection_loss_db
from sionna_partial.tracing.trace import Progress, checked_settings

DETERMINED = 0.35
"""Largest standard deviation of a parameter that counts as determined, as a share of that before measuring."""

SAVE_EVERY_S = 5.0
"""Time between two savings of what has been found [s]."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class MaterialCalibration:
    """Materials that explain measured gains, and how sure they are.

    Of a scene of one material the parameters are numbers; of a mesh with M materials they are arrays (M,), in the
    order of `scene.mesh.materials`, without those that no triangle has.

    Parameters
    ----------
    permittivity, conductivity : float or (M,) float64 array
        Real relative permittivity, and conductivity [S/m]. They do not depend on the frequency.
    permittivity_std, conductivity_std : float or (M,) float64 array
        Their standard deviations about these values, given the measurements.
    undetermined : tuple of str
        Parameters that the measurements say little or nothing about: "permittivity", "conductivity", or
        "conductivity[2]" of a mesh.
    loss : (K,) float64 array
        Negative logarithm of the posterior density for each link, at the start and after each step.
    noise_db : float
        Standard deviation of the measurements' noise [dB], as found.
    used : (N,) bool array
        Which of the measured links were used.
    left_out : dict of str to int
        How many were not, by reason.
    gain_db, gain_before_db, gain_after_db : (N,) float64 arrays
        Gain of the measured links: as measured, and as traced with the start's and with the calibrated materials [dB].
    start, materials : tuple of M Material
        Where the search began, and where it ended.
    posteriors : tuple of M Posterior
        What the measurements leave open about each material.
    scene : PartialMap
        The map with the calibrated materials, for `predict_map`.
    settings : TraceSettings
    """

    permittivity: Any
    conductivity: Any
    permittivity_std: Any
    conductivity_std: Any
    undetermined: tuple[str, ...]
    loss: NDArray[np.float64]
    noise_db: float
    used: NDArray[np.bool_]
    left_out: dict[str, int]
    gain_db: NDArray[np.float64]
    gain_before_db: NDArray[np.float64]
    gain_after_db: NDArray[np.float64]
    start: tuple[Material, ...]
    materials: tuple[Material, ...]
    posteriors: tuple[Posterior, ...]
    scene: PartialMap
    settings: TraceSettings

    def reflection_loss_db(
        self, angle_deg: ArrayLike, polarisation: Polarisation = "te", *, which: int = 0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Loss of a reflection off the calibrated material, and its standard deviation.

        Parameters
        ----------
        angle_deg : array-like
            Angle of incidence from the normal, 0 to 90 [degrees].
        polarisation : {"te", "tm"}
            "te" is that of vertical antennas at walls.
        which : int
            The material.

        Returns
        -------
        loss_db, std_db : float64 arrays of the angle's shape
        """
        angle, material, posterior = np.asarray(angle_deg, float), self.materials[which], self.posteriors[which]
        rest = material.thickness_m, self.settings.frequency_hz
        best = reflection_loss_db(material.relative_permittivity, material.conductivity_s_m, *rest, angle, polarisation)
        others = reflection_loss_db(
            posterior.permittivity, posterior.conductivity_s_m, *rest, angle[..., None], polarisation
        )
        return best, np.sqrt((others - best[..., None]) ** 2 @ posterior.weight)

    def record(self) -> dict[str, Any]:
        """Return the result as plain data, without the map and the gains of single links."""
        plain = {
            name: np.asarray(getattr(self, name)).tolist()
            for name in ("permittivity", "permittivity_std", "conductivity", "conductivity_std", "loss", "noise_db")
        }
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
            "frequency_hz": self.settings.frequency_hz,
        }


def calibrate_materials(
    scene: PartialMap | str | Path,
    measurements: Any,
    *,
    start: Material | None = None,
    settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    seed: int | None = None,
    checkpoint: str | PathLike[str] | None = None,
    progress: Progress | None = None,
) -> MaterialCalibration:
    """Find the permittivity and the conductivity of walls, floor and ceiling from measured path gains.

    Paths are traced once. The power of a link is the sum of the powers of its paths, which Sionna RT evaluates for any
    material. Measured gains are off by noise, by paths that the map does not show, and by things that stand in the way
    (see `gain_errors`), and nearly all materials are likely before anything is measured (see `material_fit`). The whole
    plane of permittivity and conductivity is searched, so that the start does not matter; then Newton's method follows
    the derivatives from Dr.Jit to the likeliest material. Of all that the measurements allow, the material is taken
    whose reflection losses are nearest to their mean: far from what the measurements determine, the likeliest one alone
    would follow the noise. The thickness is held.

    Links of a partial map are used where the line of sight, or half of the power without one, runs through observed
    space. Outages say nothing about the material.

    Parameters
    ----------
    scene : PartialMap or path
        What is known of the building.
    measurements : Measurements, mapping, data frame, Dataset or path of a CSV
        With `tx` (N, 3) [m], `rx` (N, 3) [m] and `gain_db` (N,) [dB] (see `measurements_of`).
    start : Material, optional
        Where the search begins, and whose thickness is held. By default the material of the scene.
    settings : TraceSettings, optional
        Refraction and diffuse reflection must be off; diffraction too on meshes.
    scene_settings : SceneSettings, optional
    seed : int, optional
        Seed of the rays that find the paths of a mesh, in place of that in `settings`. Nothing else is drawn.
    checkpoint : path-like, optional
        JSON file in which what has been found is kept. With the same arguments, a run that was stopped or killed goes
        on from there, to the same result; with others the file is refused.
    progress : callable, optional
        Called as ``progress(share_done, message)``.

    Returns
    -------
    MaterialCalibration

    Raises
    ------
    MeasurementError
        For measurements that are damaged or too few, or of which too few say something on this map.
    PositionError
        For a place outside the map, inside a wall, or not between floor and ceiling.
    SettingsError
        For a frequency that a material does not cover, settings of another kind, or paths that only rays find.
    BackendError
        If LLVM or Sionna RT cannot be used.
    OutputError
        If the checkpoint cannot be written, or is of another calibration.
    """
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    require(start is None or isinstance(start, Material), "start", start, "give a Material, or None for the scene's.")
    settings, scene_settings = checked_settings(partial, settings, scene_settings)
    settings = settings if seed is None else replace(settings, seed=seed)
    measured = measurements_of(measurements)
    require_places(partial, measured, settings.frequency_hz)
    building = MeasuredBuilding(partial, start_materials(partial, start, scene_settings, settings.frequency_hz))
    store = Checkpoint(checkpoint, _fingerprint(building, measured, settings, scene_settings))
    known = store.read(_parsed_losses) or {}
    report = progress or (lambda share, message: None)
    report(0.0, "building the scene")
    paths = building.paths(measured, settings, scene_settings, report)
    used, left_out = usable_links(partial, paths, measured)
    target = MaterialTarget(paths.of_links(used), measured.gain_db[used])
    target.known.update(known)
    kept = _Kept(target, store)
    try:
        fit = _fit(target, building.start, settings.frequency_hz, report)
    finally:
        kept.save()
    report(1.0, "done")
    result = _result(building, fit, measured, used, left_out, paths, settings)
    for name in result.undetermined:
        _log.warning("%s", _doubt(result, name))
    return result


@dataclass(frozen=True)
class _Fit:
    """The way to the likeliest materials, those that are taken, and what is left open: deviations are (2, M)."""

    steps: list[Point]
    point: Point
    posteriors: tuple[Posterior, ...]
    deviations: NDArray[np.float64]


class _Kept:
    """The losses that a target finds, as a checkpoint keeps them."""

    def __init__(self, target: MaterialTarget, checkpoint: Checkpoint) -> None:
        self._target, self._checkpoint, self._saved_s = target, checkpoint, time.monotonic()
        self.save()
        target.on_progress = self._on_progress

    def _on_progress(self) -> None:
        if time.monotonic() - self._saved_s > SAVE_EVERY_S:
            self.save()

    def save(self) -> None:
        """Write the checkpoint."""
        self._checkpoint.write(self._target.known)
        self._saved_s = time.monotonic()


def _parsed_losses(record: Mapping[str, Sequence[float]]) -> dict[str, list[float]]:
    return {str(key): [float(value) for value in values] for key, values in record.items()}


def _fingerprint(
    building: MeasuredBuilding, measured: Measurements, settings: TraceSettings, scene_settings: SceneSettings
) -> str:
    materials = [asdict(each) for each in building.start.values()]
    chosen = {"trace": asdict(settings), "scene": asdict(scene_settings), "start": materials}
    return run_fingerprint(building.partial, chosen, measured.tx, measured.rx, measured.gain_db)


def _fit(target: MaterialTarget, start: Mapping[str, Material], frequency_hz: float, report: Progress) -> _Fit:
    """Search the plane of each material, then follow the slopes from the best teeth of the comb."""
    begin = point = target.at(
        np.array([max(each.relative_permittivity, 1.001) for each in start.values()]),
        np.array([max(each.conductivity_s_m, 1e-6) for each in start.values()]),
    )
    rounds = [*range(len(start))] * (1 if len(start) == 1 else 2)
    posteriors: dict[int, Posterior] = {}
    best = [begin]
    for number, which in enumerate(rounds):
        advance = bind(_report_part, report, 0.3 + 0.6 * number / len(rounds), 0.6 / len(rounds))
        thickness_m = [*start.values()][which].thickness_m
        found, posteriors[which] = search(target, point, which, thickness_m, frequency_hz, advance)
        best, point = found, found[0]
    ways = [descend(target, each, bind(_report_part, report, 0.9, 0.1)) for each in best]
    steps, curvature = min(ways, key=lambda way: way[0][-1].loss)
    chosen = [begin, *(each for each in steps if each.loss < begin.loss)]
    open_now = [posteriors[which] for which in range(len(start))]
    typical = [
        each.typical(material.thickness_m, frequency_hz)
        for each, material in zip(open_now, start.values(), strict=True)
    ]
    point = target.at(
        np.array([each.permittivity[number] for each, number in zip(open_now, typical, strict=True)]),
        np.array([each.conductivity_s_m[number] for each, number in zip(open_now, typical, strict=True)]),
    )
    return _Fit(chosen, point, tuple(open_now), _deviations(point, open_now, curvature))


def _report_part(report: Progress, start: float, length: float, share: float, message: str) -> None:
    report(start + length * share, message)


def _deviations(point: Point, posteriors: Sequence[Posterior], curvature: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviations (2, M) of permittivities and conductivities.

    A posterior is that of one material while the others stay as they are. Where there are others, the curvature of all
    together says how much more is open.
    """
    own = np.array(
        [
            [each.deviation(each.permittivity, point.permittivity[which]) for which, each in enumerate(posteriors)],
            [
                each.deviation(each.conductivity_s_m, point.conductivity_s_m[which])
                for which, each in enumerate(posteriors)
            ],
        ]
    )
    if len(posteriors) == 1:
        return own
    together = np.sqrt(np.diag(np.linalg.inv(curvature))).reshape(2, -1)
    return np.maximum(own, together * [point.permittivity - 1.0, point.conductivity_s_m])


def _undetermined(building: MeasuredBuilding, fit: _Fit) -> tuple[str, ...]:
    """Name the parameters of which little more is known than before."""
    before, point, names = prior_posterior(), fit.point, []
    for which, (posterior, material) in enumerate(zip(fit.posteriors, building.start.values(), strict=True)):
        small_s_m = 0.1 * lossless_scale_s_m(2.0, material.thickness_m)
        fields = {"permittivity": ("permittivity", 0.0), "conductivity": ("conductivity_s_m", small_s_m)}
        for name, (field, added) in fields.items():
            prior, open_now = (np.log(getattr(each, field) + added) for each in (before, posterior))
            best = math.log(getattr(point, field)[which] + added)
            spread = before.deviation(prior, float(before.weight @ prior))
            if posterior.deviation(open_now, best) > DETERMINED * spread:
                names.append(name if len(fit.posteriors) == 1 else f"{name}[{which}]")
    return tuple(names)


def _result(
    building: MeasuredBuilding,
    fit: _Fit,
    measured: Measurements,
    used: NDArray[np.bool_],
    left_out: dict[str, int],
    paths: LinkPaths,
    settings: TraceSettings,
) -> MaterialCalibration:
    begin, point, count = fit.steps[0], fit.point, len(measured)
    materials = tuple(
        Material(float(permittivity), float(conductivity_s_m), each.thickness_m)
        for permittivity, conductivity_s_m, each in zip(
            point.permittivity, point.conductivity_s_m, building.start.values(), strict=True
        )
    )
    gains_db = [
        np.maximum(
            link_gains_db(paths.power(each.permittivity, each.conductivity_s_m), paths.link, count), GAIN_FLOOR_DB
        )
        for each in (begin, point)
    ]
    values = (point.permittivity, point.conductivity_s_m, *fit.deviations)
    numbers = [float(each[0]) if building.partial.mesh is None or len(materials) == 1 else each for each in values]
    return MaterialCalibration(
        permittivity=numbers[0],
        conductivity=numbers[1],
        permittivity_std=numbers[2],
        conductivity_std=numbers[3],
        undetermined=_undetermined(building, fit),
        loss=np.minimum.accumulate([each.loss for each in fit.steps]) / used.sum(),
        noise_db=point.errors.noise_db,
        used=used,
        left_out=left_out,
        gain_db=measured.gain_db,
        gain_before_db=gains_db[0],
        gain_after_db=gains_db[1],
        start=tuple(building.start.values()),
        materials=materials,
        posteriors=fit.posteriors,
        scene=building.with_materials(materials),
        settings=settings,
    )


def _doubt(result: MaterialCalibration, name: str) -> str:
    """Say that the measurements do not determine a parameter, and what they leave open."""
    which = int(name.partition("[")[2].rstrip("]") or 0)
    posterior = result.posteriors[which]
    is_permittivity = name.startswith("permittivity")
    values = posterior.permittivity if is_permittivity else posterior.conductivity_s_m
    low, high = posterior.interval(values)
    unit = "" if is_permittivity else " S/m"
    return (
        f"the measurements cannot determine the {name}: 95 % of what they allow lies between {low:.2g} and "
        f"{high:.2g}{unit}. Do not take its value for a property of the material."
    )
