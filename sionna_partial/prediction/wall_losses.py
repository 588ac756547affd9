"""What the known walls of a map lose and reflect on average: materials -> two numbers that networks read."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.scene import constants_of
from sionna_partial.settings import Material, SceneSettings, TraceSettings
from sionna_partial.tracing.slab import reflection_coefficients, transmission_coefficients

MOST_LOSS_DB = 60.0
"""Loss of a wall from which on it counts as opaque [dB]."""

_ANGLES_DEG = np.arange(0.0, 61.0, 10.0)
"""Angles of incidence over which a wall is averaged: that at normal incidence alone has deep interference fringes."""


class WallLosses(NamedTuple):
    """Mean losses of the walls of a map for vertical antennas, at most `MOST_LOSS_DB`: transmitted, reflected [dB]."""

    loss_db: float
    reflection_db: float

    @classmethod
    def of(cls, partial: PartialMap, trace_settings: TraceSettings, scene_settings: SceneSettings) -> "WallLosses":
        """Average over the known wall cells of a map, whose default material is that of the settings.

        Walls that no path goes through lose the most.
        """
        materials = scene_settings.material, *partial.wall_materials
        cells = np.zeros(partial.shape, np.uint8) if partial.wall_material is None else partial.wall_material
        count = np.bincount(cells[partial.state == CellState.WALL], minlength=len(materials)).astype(float)
        weights = count / count.sum() if count.any() else np.eye(len(materials))[0]
        used, frequency_hz = np.flatnonzero(weights), trace_settings.frequency_hz
        loss_db = sum(weights[k] * wall_loss_db(materials[k], frequency_hz) for k in used)
        reflection_db = sum(weights[k] * wall_reflection_db(materials[k], frequency_hz) for k in used)
        return cls(float(loss_db) if trace_settings.through_walls else MOST_LOSS_DB, float(reflection_db))


def wall_loss_db(material: Material, frequency_hz: float) -> float:
    """Return the mean loss [dB] of going through a wall at angles of incidence up to 60 degrees."""
    return _mean_loss_db(transmission_coefficients, material, frequency_hz)


def wall_reflection_db(material: Material, frequency_hz: float) -> float:
    """Return the mean loss [dB] of being reflected at a wall, likewise."""
    return _mean_loss_db(reflection_coefficients, material, frequency_hz)


def _mean_loss_db(
    coefficients: Callable[..., tuple[np.ndarray, np.ndarray]], material: Material, frequency_hz: float
) -> float:
    permittivity, conductivity_s_m = constants_of(material, frequency_hz)
    cosine = np.cos(np.radians(_ANGLES_DEG))
    te, _ = coefficients(permittivity, conductivity_s_m, material.thickness_m, frequency_hz, cosine)
    return float(np.mean(np.minimum(-20.0 * np.log10(np.maximum(np.abs(te), 1e-8)), MOST_LOSS_DB)))
