"""Paths of measured links, as functions of the unknown materials of a map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.checks import Progress
from sionna_partial.display import part_of
from sionna_partial.errors import MeasurementError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.prediction.unobserved import path_unobserved_m
from sionna_partial.scene.scene import constants_of
from sionna_partial.settings import Material, SceneSettings, TraceSettings
from sionna_partial.tracing.path_set import PATHS_PER_BLOCK, PathParameters, PathSet
from sionna_partial.tracing.paths import SEEN_M
from sionna_partial.tracing.positions import nearest_m
from sionna_partial.tracing.power import VACUUM_F_M
from sionna_partial.tracing.simulation import Simulation

FEWEST_LINKS = 10

OBSERVED_FRACTION = 0.5
"""Smallest fraction of a used link's power on paths through observed space."""

OUTAGE = "measured outage"
"""Reason for omitting a link before the trace."""

_NO_MATERIAL = "that shows a material: measure links that walls reflect, and trace with max_depth of 1 or more."

_REFLECTING = Material(10.0, 1.0)
"""Material of the trace that finds paths: no reflection is too weak."""

KEPT_FRACTION = 0.96
"""Fraction of a link's power on the kept paths, for all `EXTREMES`."""

EXTREMES = tuple((permittivity, loss) for permittivity in (1.2, 3.0, 8.0, 30.0) for loss in (0.0, 0.03, 3.0))
"""Extreme materials: relative permittivity, and its imaginary part."""


@dataclass(frozen=True, eq=False)
class LinkPaths:
    """P paths of N measured links, whose power depends on unknown materials.

    Parameters
    ----------
    paths : PathSet
    columns : (M,) int array
        Unknown materials of the scene.
    link : (P,) int64 array
        Link of each path.
    """

    paths: PathSet
    columns: Indices
    link: NDArray[np.int64]

    @property
    def is_direct(self) -> Bools:
        return self.paths.is_direct

    def of_links(self, chosen: Bools) -> "LinkPaths":
        kept = chosen[self.link]
        return LinkPaths(self.paths.kept(kept), self.columns, (np.cumsum(chosen) - 1)[self.link[kept]])

    def power(self, permittivity: Floats, conductivity_s_m: Floats) -> Floats:
        return self.paths.at(self._parameters(permittivity, conductivity_s_m))[0]

    def slopes(self, permittivity: Floats, conductivity_s_m: Floats) -> tuple[Floats, Floats]:
        """Return |a|^2 (P,), and its derivatives (P, 2 M) by permittivities, then conductivities."""
        parameters = self._parameters(permittivity, conductivity_s_m)
        slopes = self.paths.slopes(parameters, ("relative_permittivity", "conductivity_s_m")).values()
        return self.paths.at(parameters)[0], np.concatenate([each[:, self.columns] for each in slopes], axis=1)

    def strong(self) -> Bools:
        """Return which paths (P,) have `KEPT_FRACTION` of a link's power for some of `EXTREMES`."""
        strong, ones = np.zeros(len(self.link), dtype=bool), np.ones(len(self.columns))
        scale_s_m = 2.0 * np.pi * float(self.paths.base.frequency_hz) * VACUUM_F_M
        for permittivity, loss in EXTREMES:
            strong |= _strongest(self.link, self.power(permittivity * ones, loss * scale_s_m * ones), KEPT_FRACTION)
        return strong

    def _parameters(self, permittivity: Floats, conductivity_s_m: Floats) -> PathParameters:
        values = {"relative_permittivity": permittivity, "conductivity_s_m": conductivity_s_m}
        all_values = {name: getattr(self.paths.base, name).copy() for name in values}
        for name, own in values.items():
            all_values[name][self.columns] = own
        return replace(self.paths.base, **all_values)


def link_gains_db(power: Floats, link: NDArray[np.int64], links: int) -> Floats:
    """Return the gains (N,) [dB] from the power of the paths (P,); -inf without paths."""
    with np.errstate(divide="ignore"):
        return 10.0 * np.log10(np.bincount(link, weights=power, minlength=links))


def _strongest(link: NDArray[np.int64], power: Floats, fraction: float) -> Bools:
    order = np.lexsort((-power, link))
    total = np.bincount(link, weights=power)
    before = np.cumsum(power[order]) - power[order] - (np.cumsum(total) - total)[link[order]]
    strong = np.zeros(len(link), dtype=bool)
    strong[order] = (before < fraction * total[link[order]]) & (power[order] > 0.0)
    return strong


@dataclass(frozen=True)
class MeasuredBuilding:
    """A map, and its custom materials by their names in the scene."""

    partial: PartialMap
    start: dict[str, Material]

    def with_materials(self, materials: Sequence[Material]) -> PartialMap:
        """Return the map with other materials."""
        new = dict(zip(self.start, materials, strict=True))
        return replace(self.partial, **self.partial.environment.with_materials(new))

    def paths(
        self, measured: Measurements, trace_settings: TraceSettings, scene_settings: SceneSettings, report: Progress
    ) -> LinkPaths:
        """Find the paths of the measured links that may have relevant power.

        The fewer ends transmit, except with diffraction, which is not reciprocal in Sionna RT.
        """
        traced = [*self.start.values()]  # what reflects all lets nothing through
        if not trace_settings.through_walls:
            traced = [replace(_REFLECTING, thickness_m=each.thickness_m) for each in traced]
        every = replace(trace_settings, power_tolerance_db=0.0)  # which paths are weak depends on the materials
        simulation = Simulation(self.with_materials(traced), every, scene_settings)
        if not set(self.start) <= set(simulation.materials):
            raise MeasurementError(f"the map has no walls, floor or ceiling {_NO_MATERIAL}")
        tx, rx = measured.tx, measured.rx
        if len(np.unique(rx, axis=0)) < len(np.unique(tx, axis=0)):
            tx, rx = rx, tx
        tx_m, index = np.unique(tx, axis=0, return_inverse=True)
        links = [np.flatnonzero(index.ravel() == number) for number in range(len(tx_m))]
        nothing = PathSet(simulation, tx_m, rx, [])
        kept, new = nothing, [nothing]
        columns = np.array([simulation.materials.index(name) for name in self.start], dtype=int)

        def link_paths(paths: PathSet) -> LinkPaths:
            return LinkPaths(paths, columns, paths.path_rx.astype(np.int64))

        def strong() -> PathSet:
            paths = PathSet.joined(new)
            return PathSet.joined([kept, paths.kept(link_paths(paths).strong())])

        for block in simulation.path_blocks(tx_m, rx, part_of(report, 0.02, 0.3), links):
            new.append(block)
            if sum(map(len, new)) > PATHS_PER_BLOCK:
                kept, new = strong(), [nothing]
        return link_paths(strong())


def require_positions(partial: PartialMap, measured: Measurements, frequency_hz: float) -> None:
    partial.require_positions("tx", measured.tx, least=0)
    partial.require_positions("rx", measured.rx, least=0)
    distance_m, limit_m = np.linalg.norm(measured.tx - measured.rx, axis=1), nearest_m(frequency_hz)
    if (distance_m < limit_m).any():
        index = int(distance_m.argmin())
        raise MeasurementError(
            f"rx[{index}] = {tuple(measured.rx[index].tolist())} is {distance_m[index]:.3g} m from its transmitter, "
            f"where the path gain has no meaning: leave out links shorter than {limit_m:.3g} m."
        )
    _require_enough(~measured.is_outage, {OUTAGE: int(measured.is_outage.sum())})


def start_materials(
    partial: PartialMap, start: Material | None, scene_settings: SceneSettings, frequency_hz: float
) -> dict[str, Material]:
    """Return the materials of a scene by their names there, with constants instead of formulas."""
    materials = partial.environment.scene_materials(scene_settings.traced_material)
    materials = {name: start or each for name, each in materials.items()}
    for material in materials.values():
        material.require_frequency(frequency_hz)
    constants = {name: constants_of(each, frequency_hz) for name, each in materials.items()}
    return {
        name: Material(float(permittivity), float(conductivity_s_m), materials[name].thickness_m)
        for name, (permittivity, conductivity_s_m) in constants.items()
    }


def usable_links(
    partial: PartialMap, paths: LinkPaths, measured: Measurements, repeats: NDArray[np.int64]
) -> tuple[Bools, dict[str, int]]:
    """Return which links (N,) determine materials, and count the others by reason."""
    count, ones = len(measured), np.ones(len(paths.columns))
    power = paths.power(4.0 * ones, 0.1 * ones)
    found = paths.paths
    start_m, end_m = found.base.tx_m[found.path_tx], found.rx_m[found.path_rx]
    observed = path_unobserved_m(partial, start_m, found.interactions, found.vertices_m, end_m) < SEEN_M
    total = np.bincount(paths.link, weights=power, minlength=count)
    observed_power = np.bincount(paths.link, weights=power * observed, minlength=count)
    unseen_los = np.zeros(count, dtype=bool)
    unseen_los[paths.link[paths.is_direct & ~observed]] = True
    reasons = {
        OUTAGE: measured.is_outage,
        "no path on the map": total == 0.0,
        "runs through unobserved space": unseen_los | (observed_power < OBSERVED_FRACTION * total),
    }
    used, left_out = np.ones(count, dtype=bool), {}
    for reason, applies in reasons.items():
        left_out[reason] = int(repeats[used & applies].sum())
        used &= ~applies
    _require_enough(used, left_out)
    if paths.is_direct[used[paths.link]].all():
        raise MeasurementError(f"the {int(used.sum())} usable links of measurements have no reflection {_NO_MATERIAL}")
    return used, left_out


def _require_enough(used: Bools, left_out: Mapping[str, int]) -> None:
    if used.sum() < FEWEST_LINKS:
        counts = ", ".join(f"{number} ({reason})" for reason, number in left_out.items())
        raise MeasurementError(
            f"measurements has {int(used.sum())} usable links of {len(used)}, fewer than {FEWEST_LINKS}; left out: "
            f"{counts}. Measure more links, behind corners and in line of sight, in the part that has been observed."
        )
