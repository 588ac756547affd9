"""Which candidates a scene has follows from what it is: an extruded floor plan has exact ones."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial as partial_function
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.beams import trace_beams
from sionna_partial.tracing.candidates import Candidates, specular_candidates
from sionna_partial.tracing.diffraction import diffraction_candidates, find_wedges
from sionna_partial.tracing.scene import SHAPES, SceneGeometry, build_scene, write_scene
from sionna_partial.tracing.solver import SceneSolver

Generator = Callable[[SceneSolver, NDArray[np.float64], NDArray[np.float64]], Iterator[tuple[Candidates, float, str]]]
"""Gives the candidates between a transmitter (3,) and receivers (N, 3) in scene coordinates [m], block by block: the
candidates, the share of the work done, and what is being done."""


@dataclass(frozen=True)
class WrittenScene:
    """A scene on disk, and where its candidates come from.

    Parameters
    ----------
    xml : Path
    shapes : tuple of str
        Names of its shapes in the order in which faces are counted.
    is_plan : bool
        Whether it is an extruded floor plan.
    candidates : Generator
    """

    xml: Path
    shapes: tuple[str, ...]
    is_plan: bool
    candidates: Generator


def write_scene_of(
    partial: PartialMap, folder: Path, settings: TraceSettings, scene_settings: SceneSettings
) -> WrittenScene:
    """Write the scene of a map, in coordinates whose origin is the lower-left corner of the map.

    Parameters
    ----------
    partial : PartialMap
    folder : Path
        An existing folder.
    settings : TraceSettings
    scene_settings : SceneSettings
    """
    geometry = build_scene(partial, scene_settings)
    xml = write_scene(geometry, folder, offset_m=partial.origin_m, frequency_hz=settings.frequency_hz)
    return WrittenScene(xml, SHAPES, True, partial_function(_plan_candidates, geometry, settings))


def _plan_candidates(
    geometry: SceneGeometry,
    settings: TraceSettings,
    solver: SceneSolver,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
) -> Iterator[tuple[Candidates, float, str]]:
    """Exact candidates of an extruded floor plan: beams, then beams over edges."""
    diffraction = settings.diffraction is not False
    part = 0.2 if diffraction else 1.0
    beams = trace_beams(geometry.walls_m, tx_m[:2], rx_m[:, :2], settings.max_depth)
    for candidates, share in specular_candidates(beams, geometry, tx_m, rx_m, settings.max_depth):
        yield candidates, part * share, "verifying reflections"
    if not diffraction:
        return
    wedges = find_wedges(geometry, open_ends=settings.open_ends)
    for candidates, share in diffraction_candidates(geometry, wedges, tx_m, rx_m, settings.max_depth):
        yield candidates, part + (1.0 - part) * share, "verifying diffractions"
