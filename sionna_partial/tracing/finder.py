"""Scene files of a map, and finders of the paths in them."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import Progress
from sionna_partial.constants import CellState
from sionna_partial.maps.mesh.cells import narrow_areas
from sionna_partial.maps.mesh.scene_mesh import SceneMesh
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.scene import SceneGeometry, floor_cells, write_map
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.antennas import Antenna
from sionna_partial.tracing.engine import SceneSolver, open_scene, set_antennas
from sionna_partial.tracing.interactions import REFRACTION
from sionna_partial.tracing.mesh.faces import FaceTree, MeshPlanes, face_tree, group_planes
from sionna_partial.tracing.mesh.reflections import MeshReflections
from sionna_partial.tracing.mesh.sequences import SPLIT_RAYS, shoot_rays
from sionna_partial.tracing.paths import Candidates, LocatedPaths, SolvedPaths, Wedges
from sionna_partial.tracing.plan.edges import CrossedEdgeCandidates, DiffractionCandidates, find_wedges
from sionna_partial.tracing.plan.reflections import CrossingCandidates, SpecularCandidates
from sionna_partial.tracing.plan.room import Room
from sionna_partial.tracing.power import ISOTROPIC, Gains, materials_of
from sionna_partial.tracing.select import Block, Kind, stages
from sionna_partial.tracing.stock import diffracted_as_exact, stock_paths
from sionna_partial.tracing.walls import Bodies, Cells, Interior, SolidMesh, closed_bodies

CANDIDATES_AT_ONCE = 100_000
"""Number of candidates verified together, to bound the memory."""

Found = tuple[Candidates | None, SolvedPaths]
"""Candidates and their paths in scene coordinates, row by row; no candidates for paths that rays found."""

_DIRECTED, _ESTIMATED = (0.5, 0.5), (4.5, 0.5)
"""Factors of the tolerance, between opaque walls and through walls: with a directive antenna, and where the expected
power of omitted paths is added."""

Purpose = Literal["links", "powers"]
"""Use of paths: as they are, or for powers alone, to which the expected power of omitted paths is added."""

Counted = Callable[[SolvedPaths], tuple[LocatedPaths, Bools]]
"""Function that locates paths, and selects those whose power the tolerance refers to."""

Kinds = tuple[list[Kind], list[Kind]]
"""Kinds of candidates between opaque walls, and through walls."""


@dataclass(frozen=True)
class PlanScene:
    """An extruded floor plan on disk, with its shape names in face order.

    `floor` (ny, nx) are the cells that have a floor.
    """

    xml: Path
    shapes: tuple[str, ...]
    settings: TraceSettings
    geometry: SceneGeometry
    wedges: Wedges
    partial: PartialMap
    floor: Bools

    @cached_property
    def interior(self) -> Interior:
        free = self.partial.state == CellState.FREE
        return Interior.of(free, self.floor, self.partial.resolution_m, self.settings.wall_depth_m)

    def kinds(self, solver: SceneSolver, tx_m: Floats, rx_m: Floats, gains: Gains, *, coarse: bool) -> Kinds:
        """Return the kinds of candidates; with `coarse`, fewer paths through walls are listed."""
        geometry, settings = self.geometry, self.settings
        room = Room.of(geometry, tx_m, rx_m, solver.material_of_face, gains)
        materials = materials_of(solver.materials.values(), settings.frequency_hz)
        opaque: list[Kind] = [SpecularCandidates(geometry, room, settings.max_depth, materials)]
        if settings.diffraction:
            walls = settings.diffraction_walls
            opaque.append(DiffractionCandidates(geometry, self.wedges, room, settings.max_depth, materials, walls))
        if not settings.through_walls:
            return opaque, []
        crossing = CrossingCandidates(geometry, room, self.interior, settings, materials, coarse=coarse)
        if not settings.diffraction:
            return opaque, [crossing]
        return opaque, [crossing, CrossedEdgeCandidates(geometry, self.wedges, crossing)]


@dataclass(frozen=True)
class MeshScene:
    """A mesh on disk, with its shape names in face order and vertices in scene coordinates."""

    xml: Path
    shapes: tuple[str, ...]
    settings: TraceSettings
    vertices_m: Floats
    triangles: NDArray[np.int64]
    cells: Cells

    def kinds(self, solver: SceneSolver, tx_m: Floats, rx_m: Floats, gains: Gains, *, coarse: bool) -> Kinds:
        settings = self.settings
        rays = shoot_rays(solver.mi_scene, solver.shapes, tx_m, settings.samples_per_tx, settings.max_depth)
        materials = materials_of(solver.materials.values(), settings.frequency_hz)
        mesh = SolidMesh(*self.faces, self.cells, materials, solver.material_of_face)
        opaque: list[Kind] = [MeshReflections.between_faces(mesh, tx_m, rx_m, settings, rays, gains)]
        if not settings.through_walls:
            return opaque, []
        count = min(SPLIT_RAYS, settings.samples_per_tx)
        return opaque, [MeshReflections.through_walls(mesh, tx_m, rx_m, settings, count, gains, coarse=coarse)]

    @cached_property
    def faces(self) -> tuple[FaceTree, MeshPlanes, Bodies]:
        crossed = self.triangles if self.settings.through_walls else self.triangles[:0]
        planes = group_planes(self.vertices_m, self.triangles)
        tree = face_tree(self.vertices_m[crossed], planes.plane)
        return tree, planes, closed_bodies(self.vertices_m, crossed)


@dataclass(frozen=True)
class ExactFinder:
    """Finder that verifies candidates. Its limits for powers are coarse if the material of walls is unknown."""

    written: PlanScene | MeshScene
    solver: SceneSolver
    material_unknown: bool = False

    def paths(
        self,
        tx_m: Floats,
        rx_m: Floats,
        polarisations: int,
        report: Progress,
        antenna: Antenna | None = None,
        *,
        purpose: Purpose = "links",
        counted: Counted | None = None,
    ) -> Iterator[Found]:
        """Find the paths between a transmitter (3,) and receivers (N, 3) in scene coordinates [m].

        An antenna needs both polarisations; paths are left out that are weak with it. The tolerance refers to the
        power of the `counted` paths, by default of all.
        """
        if not len(rx_m):
            return
        solver, settings = self.solver.polarised(polarisations), self.written.settings
        gains = ISOTROPIC if antenna is None else antenna.largest_gains(settings.frequency_hz)
        directed = gains is not ISOTROPIC
        estimates = purpose == "powers" and not directed and settings.tolerance_db > 0.0
        factors = _DIRECTED if directed else _ESTIMATED if estimates else (1.0, 1.0)
        tolerances_db = factors[0] * settings.tolerance_db, factors[1] * settings.tolerance_db
        power, reference, left_out = np.zeros((3, len(rx_m)))
        kinds = self.written.kinds(solver, tx_m, rx_m, gains, coarse=purpose == "powers" and self.material_unknown)

        def verified() -> Iterator[Found]:
            for stage in stages(*kinds, reference, tolerances_db, report):
                before = power.copy()
                for blocks in stage.rounds:
                    for candidates, paths in _verified(solver, blocks, tx_m, rx_m, report):
                        indirect = ~paths.is_direct
                        strength = antenna.power(paths, settings.frequency_hz) if antenna and directed else paths.power
                        np.add.at(power, paths.path_rx[indirect], strength[indirect])
                        if counted is not None:
                            paths, observed = counted(paths)
                            indirect &= observed
                        np.add.at(reference, paths.path_rx[indirect], strength[indirect])
                        yield candidates, paths
                if estimates:
                    more = stage.left_out(power - before)
                    left_out[:] += more
                    reference[:] *= 1.0 + more / np.maximum(power, np.finfo(float).tiny)
                    power[:] += more

        yield from (_completed([paths for _, paths in verified()], left_out) if estimates else verified())


class RayFinder:
    """Finder of most paths, of any kind, by Sionna RT's public path solver."""

    def __init__(self, written: PlanScene | MeshScene) -> None:
        self._written, self._scene = written, open_scene(written.xml, written.settings.frequency_hz)

    def paths(
        self,
        tx_m: Floats,
        rx_m: Floats,
        polarisations: int,
        report: Progress,
        antenna: Antenna | None = None,
        *,
        purpose: Purpose = "links",
        counted: Counted | None = None,
    ) -> Iterator[Found]:
        """Find paths as `ExactFinder.paths`, the same for all purposes and antennas."""
        settings = self._written.settings
        set_antennas(self._scene, polarisations)
        for number, paths in enumerate(stock_paths(self._scene, settings, tx_m, rx_m), start=1):
            report(number / len(rx_m), f"shooting rays to {len(rx_m)} receivers")
            if isinstance(self._written, PlanScene):
                paths = paths.take(diffracted_as_exact(self._written.wedges, paths, settings.diffraction_walls))
            yield None, paths


def write_scene_of(
    partial: PartialMap, folder: Path, settings: TraceSettings, scene_settings: SceneSettings
) -> PlanScene | MeshScene:
    """Write the scene of a map to a folder, with the origin at the map's lower-left corner.

    `settings` come from `resolved_settings`.
    """
    offset_m, frequency_hz = partial.origin_m, settings.frequency_hz
    xml, geometry = write_map(partial, folder, scene_settings, offset_m=offset_m, frequency_hz=frequency_hz)
    if isinstance(geometry, SceneMesh):
        shapes = tuple(f"part{index}" for index in range(len(geometry.materials)))
        free = partial.state == CellState.FREE
        free &= ~narrow_areas(free, partial.resolution_m, settings.wall_depth_m)
        cells = Cells(free, partial.resolution_m, settings.wall_depth_m)
        return MeshScene(xml, shapes, settings, geometry.vertices_m - [*offset_m, 0.0], geometry.triangles, cells)
    wedges = find_wedges(geometry, open_ends=settings.open_ends)
    floor = floor_cells(partial, scene_settings.floor_extent)
    return PlanScene(xml, geometry.shapes, settings, geometry, wedges, partial, floor)


def _verified(
    solver: SceneSolver, blocks: Iterator[Block], tx_m: Floats, rx_m: Floats, report: Progress
) -> Iterator[Found]:
    waiting: list[Block] = []
    for block in itertools.chain(blocks, [None]):
        full = sum(len(stored.candidates.rx) for stored in waiting) >= CANDIDATES_AT_ONCE
        if waiting and (block is None or full or not block.candidates.is_like(waiting[0].candidates)):
            together = Candidates.concatenate([stored.candidates for stored in waiting])
            # Dr.Jit follows neighbours together, until the longest of them ends
            order = np.argsort((together.kind > 0).sum(axis=1), kind="stable")
            for start in range(0, len(order), CANDIDATES_AT_ONCE):
                part = together.rows(order[start : start + CANDIDATES_AT_ONCE])
                paths, rows = solver.verify(part, tx_m, rx_m)
                report(waiting[-1].done, waiting[-1].message)
                yield part.rows(rows), paths
            waiting = []
        if block is not None and len(block.candidates.rx):
            waiting.append(block)


def _completed(found: list[SolvedPaths], left_out: Floats) -> Iterator[Found]:
    """Amplify indirect paths by the power (N,) left out; straight ones through walls only where others have less."""
    straight = [np.isin(paths.interactions, (0, REFRACTION)).all(axis=1) for paths in found]
    power, others = np.zeros(len(left_out)), np.zeros(len(left_out))
    for paths, mask in zip(found, straight, strict=True):
        for total, some in ((power, ~paths.is_direct), (others, ~mask)):
            np.add.at(total, paths.path_rx[some], paths.power[some])
    total = np.where(others > left_out, others, power)
    amplitude = np.sqrt(1.0 + np.minimum(left_out, total) / np.maximum(total, np.finfo(float).tiny))
    for paths, mask in zip(found, straight, strict=True):
        kept = paths.is_direct | (mask & (others > left_out)[paths.path_rx])
        yield None, _amplified(paths, np.where(kept, 1.0, amplitude[paths.path_rx]))


def _amplified(paths: SolvedPaths, amplitude: Floats) -> SolvedPaths:
    return replace(paths, transfer=paths.transfer * amplitude[:, None, None])
