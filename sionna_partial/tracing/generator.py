"""Which candidates a scene has follows from what it is: exact ones for a plan, those that rays find for a mesh."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial as partial_function
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.scene import (
    SHAPES,
    SceneGeometry,
    build_scene,
    scene_settings_of,
    write_mesh_scene,
    write_scene,
)
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.mesh.candidates import mesh_candidates
from sionna_partial.tracing.mesh.rays import shoot_rays
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.plan.beams import trace_beams
from sionna_partial.tracing.plan.bounds import Strengths, dropped_power, expected_power, levels_needed, strengths_of
from sionna_partial.tracing.plan.candidates import Candidates, Room, Wedges, specular_candidates
from sionna_partial.tracing.plan.diffraction import MAX_REFLECTIONS, DiffractionCandidates, find_wedges
from sionna_partial.tracing.solver import SceneSolver

Found = tuple[Candidates, SolvedPaths, float, str]
"""Candidates that are paths, these paths, the fraction of the work done, and what is being done."""

Finder = Callable[[SceneSolver, NDArray[np.float64], NDArray[np.float64]], Iterator[Found]]
"""Finds the paths between a transmitter (3,) and receivers (N, 3) in scene coordinates [m], block by block."""

CANDIDATES_AT_ONCE = 100_000
"""Number of candidates that Sionna RT verifies together, which bounds the memory."""

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
    paths : Finder
    """

    xml: Path
    shapes: tuple[str, ...]
    wedges: Wedges | None
    paths: Finder

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
            xml, shapes, None, partial_function(_mesh_paths, vertices_m, partial.mesh.triangles, settings)
        )
    geometry = build_scene(partial, scene_settings)
    xml = write_scene(geometry, folder, offset_m=partial.origin_m, frequency_hz=settings.frequency_hz)
    wedges = find_wedges(geometry, open_ends=settings.open_ends)
    return WrittenScene(xml, SHAPES, wedges, partial_function(_plan_paths, geometry, wedges, settings))


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


def _plan_paths(
    geometry: SceneGeometry,
    wedges: Wedges,
    settings: TraceSettings,
    solver: SceneSolver,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
) -> Iterator[Found]:
    """Find the paths of an extruded floor plan that are strong enough to matter.

    First the bounds of all candidates are added up. Those that a link can do without, if its strongest candidates are
    as strong as their bounds, are left out. Where Sionna RT finds less than that, more of them follow.
    """
    material = next(iter(solver.materials.values()), np.array([2.0, 0.0, 1.0]))  # none is needed without surfaces
    bounds, tolerance_db = strengths_of(material, settings.frequency_hz, len(rx_m)), settings.power_tolerance_db
    candidates = _PlanCandidates(geometry, wedges, settings, tx_m, rx_m)
    if tolerance_db == 0.0:
        yield from _verified(solver, candidates.blocks(bounds), tx_m, rx_m)
        return
    nothing = np.ones(len(rx_m), np.int64)
    for _, share, _ in candidates.blocks(bounds._replace(first=nothing, last=nothing)):
        yield *_nothing(solver, tx_m, rx_m), 0.4 * share, "listing paths"
    power, expected = np.zeros(len(rx_m)), expected_power(bounds.power, bounds.reflected)
    done, wanted = bounds.first, levels_needed(bounds.power, dropped_power(expected, tolerance_db))
    for low, high in ((0.4, 0.9), (0.9, 1.0)):
        if not (wanted > done).any():
            return
        strengths = bounds._replace(first=done, last=np.where(wanted > done, wanted, 0), power=bounds.power[:0])
        for found, paths, share, message in _verified(solver, candidates.blocks(strengths), tx_m, rx_m):
            indirect = ~paths.is_direct
            np.add.at(power, paths.path_rx[indirect], np.abs(paths.a[indirect]) ** 2)
            yield found, paths, low + (high - low) * share, message
        done, wanted = wanted, levels_needed(bounds.power, dropped_power(power, tolerance_db))


class _PlanCandidates:
    """Exact candidates of an extruded floor plan: beams, then beams over edges, both traced once."""

    def __init__(
        self,
        geometry: SceneGeometry,
        wedges: Wedges,
        settings: TraceSettings,
        tx_m: NDArray[np.float64],
        rx_m: NDArray[np.float64],
    ) -> None:
        self._geometry, self._settings, self._room = geometry, settings, Room.of(geometry, tx_m, rx_m)
        self._beams = trace_beams(geometry.plan, tx_m[:2], rx_m[:, :2], settings.max_depth)
        self._best = np.zeros(len(self._beams.pair_rx), np.uint8)
        self._bent = None
        if settings.diffraction:
            self._bent = DiffractionCandidates(
                geometry, wedges, self._room, settings.max_depth, settings.diffraction_walls
            )

    def blocks(self, strengths: Strengths) -> Iterator[tuple[Candidates, float, str]]:
        """List those that are asked for."""
        part, depth = 1.0 if self._bent is None else 0.2, self._settings.max_depth
        for candidates, share in specular_candidates(
            self._beams, self._geometry, self._room, depth, strengths, self._best
        ):
            yield candidates, part * share, "verifying reflections"
        if self._bent is not None:
            for candidates, share in self._bent.blocks(strengths):
                yield candidates, part + (1.0 - part) * share, "verifying diffractions"


def _mesh_paths(
    vertices_m: NDArray[np.float64],
    triangles: NDArray[np.int64],
    settings: TraceSettings,
    solver: SceneSolver,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
) -> Iterator[Found]:
    """Find the paths of a mesh: chains that rays meet, and the receivers that each can reach."""
    depth = settings.max_depth
    rays = shoot_rays(solver.mi_scene, solver.shapes, tx_m, settings.samples_per_tx, depth)
    blocks = mesh_candidates(vertices_m, triangles, rays, tx_m, rx_m, max_depth=depth)
    labelled = ((candidates, share, "verifying reflections") for candidates, share in blocks)
    yield from _verified(solver, labelled, tx_m, rx_m)


def _verified(
    solver: SceneSolver,
    blocks: Iterator[tuple[Candidates, float, str]],
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
) -> Iterator[Found]:
    """Verify candidates, many blocks of one kind at once."""
    waiting: list[Candidates] = []
    doing = ""
    for candidates, share, message in itertools.chain(blocks, [(None, 1.0, "")]):
        full = sum(len(each.rx) for each in waiting) >= CANDIDATES_AT_ONCE
        if waiting and (candidates is None or full or not candidates.is_like(waiting[0])):
            together = Candidates.concatenate(waiting)
            for start in range(0, len(together.rx), CANDIDATES_AT_ONCE):
                part = together.rows(np.arange(start, min(start + CANDIDATES_AT_ONCE, len(together.rx))))
                paths, rows = solver.verify(part, tx_m, rx_m)
                yield part.rows(rows), paths, share, doing
            waiting = []
        if candidates is not None and len(candidates.rx):
            waiting.append(candidates)
            doing = message


def _nothing(
    solver: SceneSolver, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]
) -> tuple[Candidates, SolvedPaths]:
    """No path at all."""
    none = Candidates(np.zeros(0, np.int32), np.zeros((0, 1), np.int32), np.zeros((0, 1, 3)))
    return none, solver.verify(none, tx_m, rx_m)[0]
