"""Walls of procedural homes that let waves through: a carrier frequency, and materials of all walls, drawn for each."""

import math
from dataclasses import replace

import numpy as np
from scipy import ndimage

from sionna_partial.arrays import Bools
from sionna_partial.constants import CellState
from sionna_partial.errors import SettingsError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import DatasetSettings, Material

MIXED_FREQUENCIES_HZ = (0.7e9, 100e9)
"""Range of carrier frequencies, which are drawn uniformly on a logarithmic scale [Hz]."""

INNER = ("drywall", "drywall", "plasterboard", "brick", "concrete", "wood", "glass", "door")
OUTER = ("brick", "concrete", "reinforced concrete", "wood", "glass", "coated glass", "drywall")
"""Materials that inner and outer walls have, as often as they are listed; of the others, 1 in 20 are metal."""

P_OUTER, P_PART, P_METAL = 0.5, 0.3, 0.05
"""Probability that outer walls are of another material than the inner ones, that those of a part of the home are, and
that a material is metal."""

THICKNESS_SPREAD = 0.35
"""Standard deviation of the logarithm of a thickness over the usual one [1]."""

_OUTER_M = 0.35


def with_drawn_walls(
    home: PartialMap, settings: DatasetSettings, rng: np.random.Generator
) -> tuple[PartialMap, DatasetSettings]:
    """Draw frequency and materials of a home; return it with them, and the settings of its traces through walls."""
    frequency_hz = float(np.exp(rng.uniform(*np.log(MIXED_FREQUENCIES_HZ))))
    inner = _drawn(INNER, frequency_hz, rng)
    if rng.random() < P_OUTER:
        home = home.with_wall_material(_drawn(OUTER, frequency_hz, rng), _outer_walls(home))
    if rng.random() < P_PART:
        home = home.with_wall_material(_drawn(INNER, frequency_hz, rng), _part(home, rng))
    trace = replace(settings.trace, frequency_hz=frequency_hz, refraction=True)
    return home, replace(settings, trace=trace, scene=replace(settings.scene, material=inner), walls="given")


def _drawn(names: tuple[str, ...], frequency_hz: float, rng: np.random.Generator) -> Material:
    """Draw a material that has constants at a frequency, and its thickness."""
    while True:
        name = "metal" if rng.random() < P_METAL else str(rng.choice(names))
        usual = Material.named(name)
        material = replace(usual, thickness_m=usual.thickness_m * math.exp(THICKNESS_SPREAD * rng.standard_normal()))
        try:
            material.require_frequency(frequency_hz)
        except SettingsError:
            continue
        return material


def _outer_walls(home: PartialMap) -> Bools:
    """Wall cells (ny, nx) near what is outside."""
    unknown = np.pad(home.state == CellState.UNKNOWN, 1, constant_values=True)
    regions, _ = ndimage.label(unknown)
    outside = (regions == regions[0, 0])[1:-1, 1:-1]
    border = np.pad(np.zeros(np.subtract(home.shape, 2), dtype=bool), 1, constant_values=True)
    distance = ndimage.distance_transform_edt(~(outside | border))
    return (home.state == CellState.WALL) & (distance * home.resolution_m <= _OUTER_M)


def _part(home: PartialMap, rng: np.random.Generator) -> Bools:
    """Cells (ny, nx) of a rectangle of a quarter to three quarters of the home in each direction."""
    part = np.zeros(home.shape, dtype=bool)
    rows, columns = (
        slice(start, start + round(rng.uniform(0.25, 0.75) * count))
        for count, start in ((count, int(rng.integers(0, max(1, count // 2)))) for count in home.shape)
    )
    part[rows, columns] = True
    return part
