"""The scene of a map on disk, and where its paths come from: exact candidates of a floor plan, rays in a mesh."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.checks import Progress
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.progress import part_of
from sionna_partial.scene.scene import SHAPES, SceneGeometry, build_scene, write_mesh_scene, write_scene
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.bounds import Strengths, dropped_power, expected_power, levels_needed, strengths_of
from sionna_partial.tracing.candidates import Candidates, Wedges
from sionna_partial.tracing.engine import SceneSolver
from sionna_partial.tracing.mesh.candidates import MeshCandidates
from sionna_partial.tracing.mesh.sequences import shoot_rays
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.plan.diffraction import DiffractionCandidates, find_wedges
from sionna_partial.tracing.plan.specular import Room, SpecularCandidates

CANDIDATES_AT_ONCE = 100_000
"""Number of candidates that Sionna RT verifies together, which bounds the memory."""

_Blocks = Iterator[tuple[Candidates, float, str]]
"""Candidates, the fraction of them that is listed with these, and what is being done."""


class FoundPaths(NamedTuple):
    """Candidates that are paths, and these paths, in scene coordinates."""

    candidates: Candidates
    paths: SolvedPaths


@dataclass(frozen=True)
class PlanScene:
    """An extruded floor plan on disk, with the names of its shapes in the order in which faces are counted."""

    xml: Path
    shapes: tuple[str, ...]
    settings: TraceSettings
    geometry: SceneGeometry
    wedges: Wedges

    def paths(
        self, solver: SceneSolver, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], report: Progress
    ) -> Iterator[FoundPaths]:
        """Find the paths between a transmitter (3,) and receivers (N, 3) that are strong enough to matter."""
        kinds = self._kinds(Room.of(self.geometry, tx_m, rx_m))
        ends = (0.0, 1.0) if len(kinds) == 1 else (0.0, 0.2, 1.0)

        def listed(strengths: Strengths) -> _Blocks:
            for (message, kind), (low, high) in zip(kinds.items(), itertools.pairwise(ends), strict=True):
                for candidates, fraction in kind.blocks(strengths):
                    yield candidates, low + (high - low) * fraction, message

        return _strong_paths(solver, listed, tx_m, rx_m, self.settings, report)

    def _kinds(self, room: Room) -> dict[str, SpecularCandidates | DiffractionCandidates]:
        """Kinds of candidates, by what is done with them."""
        geometry, settings = self.geometry, self.settings
        specular = SpecularCandidates(geometry, room, settings.max_depth)
        if not settings.diffraction:
            return {"verifying reflections": specular}
        diffracted = DiffractionCandidates(geometry, self.wedges, room, settings.max_depth, settings.diffraction_walls)
        return {"verifying reflections": specular, "verifying diffractions": diffracted}


@dataclass(frozen=True)
class MeshScene:
    """A mesh on disk, its shapes likewise, with vertices (V, 3) in scene coordinates [m] and triangles (F, 3)."""

    xml: Path
    shapes: tuple[str, ...]
    settings: TraceSettings
    vertices_m: NDArray[np.float64]
    triangles: NDArray[np.int64]

    def paths(
        self, solver: SceneSolver, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], report: Progress
    ) -> Iterator[FoundPaths]:
        """Find the paths likewise, by the sequences of planes that rays meet."""
        depth = self.settings.max_depth
        rays = shoot_rays(solver.mi_scene, solver.shapes, tx_m, self.settings.samples_per_tx, depth)
        mesh = self.vertices_m, self.triangles, solver.material_of_face
        kind = MeshCandidates(*mesh, rays, tx_m, rx_m, depth)

        def listed(strengths: Strengths) -> _Blocks:
            return ((*block, "verifying reflections") for block in kind.blocks(strengths))

        return _strong_paths(solver, listed, tx_m, rx_m, self.settings, report)


def write_scene_of(
    partial: PartialMap, folder: Path, settings: TraceSettings, scene_settings: SceneSettings
) -> PlanScene | MeshScene:
    """Write the scene of a map to an existing folder, its origin the lower-left corner of the map.

    Settings come from `checked_settings`.
    """
    offset_m, frequency_hz = partial.origin_m, settings.frequency_hz
    if partial.mesh is not None:
        mesh, material = partial.mesh, scene_settings.material
        xml = write_mesh_scene(mesh, folder, offset_m=offset_m, default_material=material, frequency_hz=frequency_hz)
        shapes = tuple(f"part{index}" for index in range(len(mesh.materials)))
        return MeshScene(xml, shapes, settings, mesh.vertices_m - [*offset_m, 0.0], mesh.triangles)
    geometry = build_scene(partial, scene_settings)
    xml = write_scene(geometry, folder, offset_m=offset_m, frequency_hz=frequency_hz)
    return PlanScene(xml, SHAPES, settings, geometry, find_wedges(geometry, open_ends=settings.open_ends))


def _strong_paths(
    solver: SceneSolver,
    listed: Callable[[Strengths], _Blocks],
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    settings: TraceSettings,
    report: Progress,
) -> Iterator[FoundPaths]:
    """Verify the candidates that are strong enough to matter.

    First the bounds of all candidates are added up. Those that a link can do without, if its strongest candidates are
    as strong as their bounds, are left out. Where Sionna RT finds less than that, more of them follow.
    """
    if len(rx_m) == 0:
        return
    bounds = strengths_of(solver.materials.values(), settings.frequency_hz, len(rx_m))
    tolerance_db = settings.power_tolerance_db
    if tolerance_db == 0.0:
        yield from _verified(solver, listed(bounds), tx_m, rx_m, report)
        return
    nothing = np.ones(len(rx_m), np.int64)
    for _, fraction, _ in listed(bounds._replace(first=nothing, last=nothing)):
        report(0.4 * fraction, "listing paths")
    power, done = np.zeros(len(rx_m)), bounds.first
    expected = expected_power(bounds.power, bounds.reflected)
    for low, high in ((0.4, 0.9), (0.9, 1.0)):
        needed = levels_needed(bounds.power, dropped_power(expected, tolerance_db))
        more = needed > done
        if not more.any():
            return
        strengths = bounds._replace(first=done, last=np.where(more, needed, 0), power=bounds.power[:0])
        for found in _verified(solver, listed(strengths), tx_m, rx_m, part_of(report, low, high)):
            indirect = ~found.paths.is_direct
            np.add.at(power, found.paths.path_rx[indirect], np.abs(found.paths.a[indirect]) ** 2)
            yield found
        done, expected = needed, power


def _verified(
    solver: SceneSolver,
    blocks: _Blocks,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    report: Progress,
) -> Iterator[FoundPaths]:
    """Verify candidates, many blocks of one kind at once."""
    waiting: list[Candidates] = []
    doing = ""
    for candidates, fraction, message in itertools.chain(blocks, [(None, 1.0, "")]):
        full = sum(len(each.rx) for each in waiting) >= CANDIDATES_AT_ONCE
        if waiting and (candidates is None or full or not candidates.is_like(waiting[0])):
            together = Candidates.concatenate(waiting)
            for start in range(0, len(together.rx), CANDIDATES_AT_ONCE):
                part = together.rows(np.arange(start, min(start + CANDIDATES_AT_ONCE, len(together.rx))))
                paths, rows = solver.verify(part, tx_m, rx_m)
                report(fraction, doing)
                yield FoundPaths(part.rows(rows), paths)
            waiting = []
        if candidates is not None and len(candidates.rx):
            waiting.append(candidates)
            doing = message
