"""A building whose materials are sought: the paths of measured links in it, and which links say something."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sionna_partial.calibration.material_paths import MaterialPaths, find_material_paths
from sionna_partial.errors import MeasurementError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.prediction.link_context import SEEN_M
from sionna_partial.scene.scene import itu_constants
from sionna_partial.settings import Material, SceneSettings, TraceSettings
from sionna_partial.tracing.fixed_paths import PathScene
from sionna_partial.tracing.trace import Progress, nearest_m

FEWEST_LINKS = 10
"""Smallest number of measured links that say something."""

SURE_SHARE = 0.5
"""Smallest share of a link's power on paths that run wholly through observed space, for a link that is used."""

OUTAGE = "measured outage"
"""Reason why a link is left out before anything is traced."""

_REFLECTING = Material(10.0, 1.0)
"""While paths are looked for, everything reflects well: none may be missing for a better material."""


@dataclass(frozen=True)
class MeasuredBuilding:
    """A map, and the custom materials by the names that they have in its scene."""

    partial: PartialMap
    start: dict[str, Material]

    def with_materials(self, materials: Sequence[Material]) -> PartialMap:
        """Return the map with other materials."""
        mesh = self.partial.mesh
        if mesh is None:
            return replace(self.partial, material=materials[0])
        new = dict(zip(self.start, materials, strict=True))
        kinds = tuple(new.get(f"material{index}", old) for index, old in enumerate(mesh.materials))
        return replace(self.partial, mesh=replace(mesh, materials=kinds))

    def paths(
        self, measured: Measurements, settings: TraceSettings, scene_settings: SceneSettings, report: Progress
    ) -> MaterialPaths:
        """Find the paths of the measured links."""
        reflecting = [replace(_REFLECTING, thickness_m=each.thickness_m) for each in self.start.values()]
        settings = replace(settings, power_tolerance_db=0.0)  # which paths are weak depends on the materials
        scene = PathScene(self.with_materials(reflecting), settings=settings, scene_settings=scene_settings)
        return find_material_paths(
            scene, tuple(self.start), measured.tx, measured.rx, lambda share, what: report(0.02 + 0.28 * share, what)
        )


def require_places(partial: PartialMap, measured: Measurements, frequency_hz: float) -> None:
    """Check that radios can stand at the measured places, and that there are enough."""
    partial.require_positions("tx", measured.tx)
    partial.require_positions("rx", measured.rx)
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
    """Return the materials of a scene by their names there, with constants in place of ITU's formulas."""
    if partial.mesh is None:
        materials = {"material": start or scene_settings.material}
    else:
        kinds = partial.mesh.materials
        used = np.unique(partial.mesh.material).tolist()
        materials = {f"material{index}": start or kinds[index] or scene_settings.material for index in used}
    for material in materials.values():
        material.require_frequency(frequency_hz)
    return {name: custom_material(each, frequency_hz) for name, each in materials.items()}


def custom_material(material: Material, frequency_hz: float) -> Material:
    """Put constants in place of ITU's formulas."""
    if material.itu is None:
        return material
    permittivity, conductivity_s_m = itu_constants(material.itu, frequency_hz)
    return Material(float(permittivity), float(conductivity_s_m), material.thickness_m)


def usable_links(paths: MaterialPaths, measured: Measurements) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Find the links (N,) that say something about the materials, and count the others."""
    count, ones = len(measured), np.ones(len(paths.materials))
    power = paths.power(4.0 * ones, 0.1 * ones)
    seen = paths.unobserved_m < SEEN_M
    total = np.bincount(paths.link, weights=power, minlength=count)
    sure = np.bincount(paths.link, weights=power * seen, minlength=count)
    doubtful = np.zeros(count, dtype=bool)
    doubtful[paths.link[paths.is_direct & ~seen]] = True
    reasons = {
        OUTAGE: measured.is_outage,
        "no path on the map": total == 0.0,
        "runs through unobserved space": doubtful | (sure < SURE_SHARE * total),
    }
    used, left_out = np.ones(count, dtype=bool), {}
    for reason, matters in reasons.items():
        left_out[reason] = int((used & matters).sum())
        used &= ~matters
    _require_enough(used, left_out)
    return used, left_out


def _require_enough(used: NDArray[np.bool_], left_out: Mapping[str, int]) -> None:
    if used.sum() < FEWEST_LINKS:
        counts = ", ".join(f"{number} ({reason})" for reason, number in left_out.items())
        raise MeasurementError(
            f"measurements has {int(used.sum())} usable links of {len(used)}, fewer than {FEWEST_LINKS}; left out: "
            f"{counts}. Measure more links, behind corners and in line of sight, in the part that has been observed."
        )
