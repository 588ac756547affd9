"""Which candidates a scene has follows from what it is: exact ones for a plan, those that rays find for a mesh."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial as partial_function
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.beams import trace_beams
from sionna_partial.tracing.candidates import Candidates, Wedges, specular_candidates
from sionna_partial.tracing.diffraction import MAX_REFLECTIONS, diffraction_candidates, find_wedges
from sionna_partial.tracing.mesh_candidates import mesh_candidates
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.rays import shoot_rays
from sionna_partial.tracing.scene import (
    SHAPES,
    SceneGeometry,
    build_scene,
    scene_settings_of,
    write_mesh_scene,
    write_scene,
)
from sionna_partial.tracing.solver import SceneSolver

Generator = Callable[[SceneSolver, NDArray[np.float64], NDArray[np.float64]], Iterator[tuple[Candidates, float, str]]]
"""Gives the candidates between a transmitter (3,) and receivers (N, 3) in scene coordinates [m], block by block: the
candidates, the share of the work done, and what is being done."""


REFLECTION, DIFFRACTION = 1, 8
"""Sionna RT's `InteractionType.SPECULAR` and `DIFFRACTION`."""

SAME_EDGE_M = 1e-3
"""Distance from an edge within which a diffraction is at that edge [m]."""


@dataclass(frozen=True)
class WrittenScene:
    """A scene on disk, and where its candidates come from.

    Parameters
    ----------
    xml : Path
    shapes : tuple of str
        Names of its shapes in the order in which faces are counted.
    wedges : Wedges or None
        Edges at which an extruded floor plan diffracts; None for a mesh.
    candidates : Generator
    """

    xml: Path
    shapes: tuple[str, ...]
    wedges: Wedges | None
    candidates: Generator

    @property
    def is_plan(self) -> bool:
        """Whether it is an extruded floor plan."""
        return self.wedges is not None


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
        With `diffraction` True or False: `checked_settings` puts one of them in place of None.
    scene_settings : SceneSettings
    """
    if partial.mesh is not None:
        xml = write_mesh_scene(
            partial.mesh,
            folder,
            offset_m=partial.origin_m,
            default_material=scene_settings_of(partial, scene_settings).material,
            frequency_hz=settings.frequency_hz,
        )
        shapes = tuple(f"part{index}" for index in range(len(partial.mesh.materials)))
        vertices_m = partial.mesh.vertices_m - [*partial.origin_m, 0.0]
        return WrittenScene(
            xml, shapes, None, partial_function(_mesh_candidates, vertices_m, partial.mesh.triangles, settings)
        )
    geometry = build_scene(partial, scene_settings)
    xml = write_scene(geometry, folder, offset_m=partial.origin_m, frequency_hz=settings.frequency_hz)
    wedges = find_wedges(geometry, open_ends=settings.open_ends)
    return WrittenScene(xml, SHAPES, wedges, partial_function(_plan_candidates, geometry, wedges, settings))


def bends_at(wedges: Wedges, paths: SolvedPaths, walls_a_side: int) -> NDArray[np.bool_]:
    """Whether each path (P,) diffracts as exact candidates do, if it does at all.

    Sionna RT's rays diffract at the rims of floor and ceiling and at junctions of walls as well, and with any number of
    reflections around it.
    """
    bent = (paths.interactions == DIFFRACTION).any(axis=1)
    kept = ~bent
    if bent.any() and len(wedges.edge_m):
        which = (paths.interactions == DIFFRACTION).argmax(axis=1)
        x, y, z = paths.vertices_m[np.arange(len(bent)), which][bent].T
        beside = cKDTree(wedges.edge_m).query(np.column_stack([x, y]))[0] < SAME_EDGE_M
        reflected = paths.interactions[bent] == REFLECTION
        height_m = paths.vertices_m[bent, :, 2]
        mirrored = reflected & (height_m > SAME_EDGE_M) & (height_m < wedges.height_m - SAME_EDGE_M)
        before = np.arange(reflected.shape[1]) < which[bent, None]
        few = reflected.sum(axis=1) <= MAX_REFLECTIONS
        few &= ((mirrored & before).sum(axis=1) <= walls_a_side) & ((mirrored & ~before).sum(axis=1) <= walls_a_side)
        kept[bent] = few & beside & (z > SAME_EDGE_M) & (z < wedges.height_m - SAME_EDGE_M)
    return kept


def _plan_candidates(
    geometry: SceneGeometry,
    wedges: Wedges,
    settings: TraceSettings,
    solver: SceneSolver,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
) -> Iterator[tuple[Candidates, float, str]]:
    """Exact candidates of an extruded floor plan: beams, then beams over edges."""
    part = 0.2 if settings.diffraction else 1.0
    beams = trace_beams(geometry.plan, tx_m[:2], rx_m[:, :2], settings.max_depth)
    for candidates, share in specular_candidates(beams, geometry, tx_m, rx_m, settings.max_depth):
        yield candidates, part * share, "verifying reflections"
    if not settings.diffraction:
        return
    sides = settings.diffraction_walls
    bent = diffraction_candidates(geometry, wedges, tx_m, rx_m, settings.max_depth, walls_a_side=sides)
    for candidates, share in bent:
        yield candidates, part + (1.0 - part) * share, "verifying diffractions"


def _mesh_candidates(
    vertices_m: NDArray[np.float64],
    triangles: NDArray[np.int64],
    settings: TraceSettings,
    solver: SceneSolver,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
) -> Iterator[tuple[Candidates, float, str]]:
    """Candidates of a mesh: chains that rays meet, and the receivers that each can reach."""
    depth = settings.max_depth
    rays = shoot_rays(solver.mi_scene, solver.shapes, tx_m, settings.samples_per_tx, depth)
    for candidates, share in mesh_candidates(vertices_m, triangles, rays, tx_m, rx_m, max_depth=depth):
        yield candidates, share, "verifying reflections"
