"""The scene of a map on disk, and where its paths come from: exact candidates of a floor plan, rays in a mesh."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.checks import Progress
from sionna_partial.constants import CellState
from sionna_partial.errors import BackendError
from sionna_partial.maps.mesh.cells import narrow_areas
from sionna_partial.maps.mesh.mesh import SceneMesh
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.progress import part_of
from sionna_partial.scene.scene import SceneGeometry, floor_cells, write_map
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.bounds import Strengths, dropped_power, expected_power, levels_needed, strengths_of
from sionna_partial.tracing.engine import SceneSolver, load_sionna, open_scene, set_antennas
from sionna_partial.tracing.interactions import DIFFRACTION, DIFFUSE, INTERACTIONS, REFLECTION
from sionna_partial.tracing.mesh.candidates import MeshCandidates
from sionna_partial.tracing.mesh.crossings import MeshCrossings
from sionna_partial.tracing.mesh.faces import FaceTree, MeshPlanes, face_tree, group_planes
from sionna_partial.tracing.mesh.sequences import shoot_rays
from sionna_partial.tracing.mesh.walls import Bodies, Cells, SolidMesh, closed_bodies
from sionna_partial.tracing.paths import Candidates, SolvedPaths, Wedges
from sionna_partial.tracing.plan.crossed_edges import CrossedEdgeCandidates
from sionna_partial.tracing.plan.crossings import CrossingCandidates
from sionna_partial.tracing.plan.diffraction import MAX_REFLECTIONS, DiffractionCandidates, find_wedges
from sionna_partial.tracing.plan.legs import Interior, solid_sides
from sionna_partial.tracing.plan.obstacles import Lowered
from sionna_partial.tracing.plan.specular import Room, SpecularCandidates
from sionna_partial.tracing.slab import slabs_of

CANDIDATES_AT_ONCE = 100_000
"""Number of candidates that Sionna RT verifies together, which bounds the memory."""

_Blocks = Iterator[tuple[Candidates, float, str]]
"""Candidates, the fraction of them that is listed with these, and what is being done."""

Found = tuple[Candidates | None, SolvedPaths]
"""Paths in scene coordinates, and the candidates that they were, one for one; None where rays found them."""

TABLE_SIZE = 3_000_000
"""Entries of the hash table, at least: more lose fewer paths where refraction makes many, and take more memory."""

SAME_POINT_M = 0.03
"""Paths of the same interactions at points closer than this are one path [m]."""

SAME_EDGE_M = 1e-3
"""Distance from an edge within which a diffraction is at that edge [m]."""


@dataclass(frozen=True)
class PlanScene:
    """An extruded floor plan on disk, with the names of its shapes in the order in which faces are counted.

    `floor` (ny, nx) are the cells of its map that have a floor.
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
        """What lies between its walls, for paths through them."""
        depth_m, partial = self.settings.wall_depth_m, self.partial
        walls = (partial.state == CellState.WALL) & (depth_m > 0.0)
        solid = solid_sides(self.geometry.plan, walls, partial.resolution_m)
        return Interior(partial.state == CellState.FREE, self.floor, solid, partial.resolution_m, depth_m)

    def paths(self, solver: SceneSolver, tx_m: Floats, rx_m: Floats, report: Progress) -> Iterator[Found]:
        """Find the paths between a transmitter (3,) and receivers (N, 3) that are strong enough to matter."""
        room = Room.of(self.geometry, tx_m, rx_m, solver.material_of_face)
        kinds = self._kinds(room)
        ends = (0.0, 1.0) if len(kinds) == 1 else (0.0, 0.2, 1.0)

        def listed(strengths: Strengths) -> _Blocks:
            for (message, kind), (low, high) in zip(kinds.items(), itertools.pairwise(ends), strict=True):
                for candidates, fraction in kind.blocks(strengths):
                    yield candidates, low + (high - low) * fraction, message

        if not self.settings.through_walls:
            yield from _strong_paths(solver, listed, tx_m, rx_m, self.settings, report)
            return
        crossing = CrossingCandidates(self.geometry, room, self.interior, self.settings)
        lowered = Lowered.of(self.geometry, room, self.interior, self.settings.max_walls)

        def through_walls(power: Floats) -> Iterator[tuple[Candidates, float]]:
            return ((lowered(block), fraction) for block, fraction in crossing.blocks(power))

        power = np.zeros(len(rx_m))
        part = part_of(report, 0.0, 0.8)
        yield from _with_walls(solver, listed, through_walls, (tx_m, rx_m, power), self.settings, part)
        if self.settings.diffraction and len(rx_m):
            fixed = crossing.building, self.settings.tolerance_db
            edges = CrossedEdgeCandidates(self.geometry, self.wedges, *fixed)
            strengths = strengths_of(solver.materials.values(), self.settings.frequency_hz, len(rx_m))
            doing = "verifying diffractions through walls"
            blocks = ((lowered(block), done, doing) for block, done in edges.blocks(strengths, power))
            yield from _verified(solver, blocks, tx_m, rx_m, part_of(report, 0.8, 1.0))

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
    vertices_m: Floats
    triangles: NDArray[np.int64]
    cells: Cells

    def paths(self, solver: SceneSolver, tx_m: Floats, rx_m: Floats, report: Progress) -> Iterator[Found]:
        """Find the paths likewise, by the sequences of planes that rays meet."""
        depth, frequency_hz = self.settings.max_depth, self.settings.frequency_hz
        rays = shoot_rays(solver.mi_scene, solver.shapes, tx_m, self.settings.samples_per_tx, depth)
        kind = MeshCandidates(self.planes, solver.material_of_face, rays, tx_m, rx_m, depth)

        def listed(strengths: Strengths) -> _Blocks:
            return ((*block, "verifying reflections") for block in kind.blocks(strengths))

        if not self.settings.through_walls:
            yield from _strong_paths(solver, listed, tx_m, rx_m, self.settings, report)
            return
        slabs = slabs_of(solver.materials.values(), solver.material_of_face, frequency_hz)
        largest = strengths_of(solver.materials.values(), frequency_hz, 0).largest
        solid = SolidMesh(self.tree, self.planes, self.bodies, self.cells, slabs)
        crossing = MeshCrossings(solid, tx_m, rx_m, largest, self.settings)
        ends = tx_m, rx_m, np.zeros(len(rx_m))
        yield from _with_walls(solver, listed, crossing.blocks, ends, self.settings, report)

    @cached_property
    def planes(self) -> MeshPlanes:
        """The planes of its faces."""
        return group_planes(self.vertices_m, self.triangles)

    @cached_property
    def tree(self) -> FaceTree:
        """Its faces, for lines through them."""
        return face_tree(self.vertices_m[self.triangles], self.planes.plane)

    @cached_property
    def bodies(self) -> Bodies:
        """Its closed bodies."""
        return closed_bodies(self.vertices_m, self.triangles)


@dataclass(frozen=True)
class ExactFinder:
    """Finds paths by verifying candidates."""

    written: PlanScene | MeshScene
    solver: SceneSolver

    def paths(self, tx_m: Floats, rx_m: Floats, polarisations: int, report: Progress) -> Iterator[Found]:
        """Find the paths between a transmitter (3,) and receivers (N, 3) in scene coordinates [m]."""
        return self.written.paths(self.solver.polarised(polarisations), tx_m, rx_m, report)


class RayFinder:
    """Finds most paths, of any kind, by Sionna RT's public path solver."""

    def __init__(self, written: PlanScene | MeshScene) -> None:
        self._written, self._scene = written, open_scene(written.xml, written.settings.frequency_hz)

    def paths(self, tx_m: Floats, rx_m: Floats, polarisations: int, report: Progress) -> Iterator[Found]:
        """Find the paths likewise."""
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
    """Write the scene of a map to an existing folder, its origin the lower-left corner of the map.

    Settings come from `resolved_settings`.
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


def _strong_paths(
    solver: SceneSolver,
    listed: Callable[[Strengths], _Blocks],
    tx_m: Floats,
    rx_m: Floats,
    settings: TraceSettings,
    report: Progress,
) -> Iterator[Found]:
    """Verify the candidates that are strong enough to matter.

    First the bounds of all candidates are added up. Those that a link can do without, if its strongest candidates are
    as strong as their bounds, are left out. Where Sionna RT finds less than that, more of them follow.
    """
    if len(rx_m) == 0:
        return
    bounds = strengths_of(solver.materials.values(), settings.frequency_hz, len(rx_m))
    tolerance_db = settings.tolerance_db
    if tolerance_db == 0.0:
        yield from _verified(solver, listed(bounds), tx_m, rx_m, report)
        return
    nothing = np.ones(len(rx_m), np.int64)
    for _, fraction, _ in listed(bounds._replace(first=nothing, last=nothing)):
        report(0.4 * fraction, "listing paths")
    power, done = np.zeros(len(rx_m)), bounds.first
    expected = expected_power(bounds.power)
    for low, high in ((0.4, 0.9), (0.9, 1.0)):
        needed = levels_needed(bounds.power, dropped_power(expected, tolerance_db))
        more = needed > done
        if not more.any():
            return
        strengths = bounds._replace(first=done, last=np.where(more, needed, 0), power=bounds.power[:0])
        for candidates, paths in _verified(solver, listed(strengths), tx_m, rx_m, part_of(report, low, high)):
            indirect = ~paths.is_direct
            np.add.at(power, paths.path_rx[indirect], paths.power[indirect])
            yield candidates, paths
        done, expected = needed, power


def _with_walls(
    solver: SceneSolver,
    listed: Callable[[Strengths], _Blocks],
    through_walls: Callable[[Floats], Iterator[tuple[Candidates, float]]],
    ends: tuple[Floats, Floats, Floats],
    settings: TraceSettings,
    report: Progress,
) -> Iterator[Found]:
    """Verify the candidates without walls, and those that `through_walls` lists for links of so much power (N,).

    The powers of the links are added to the third of `ends`, but for the direct path.
    """
    tx_m, rx_m, power = ends
    for candidates, paths in _strong_paths(solver, listed, tx_m, rx_m, settings, part_of(report, 0.0, 0.6)):
        indirect = ~paths.is_direct
        np.add.at(power, paths.path_rx[indirect], paths.power[indirect])
        yield candidates, paths
    blocks = ((*block, "verifying paths through walls") for block in through_walls(power))
    for candidates, paths in _verified(solver, blocks, tx_m, rx_m, part_of(report, 0.6, 1.0)):
        np.add.at(power, paths.path_rx, paths.power)
        yield candidates, paths


def _verified(
    solver: SceneSolver,
    blocks: _Blocks,
    tx_m: Floats,
    rx_m: Floats,
    report: Progress,
) -> Iterator[Found]:
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
                yield part.rows(rows), paths
            waiting = []
        if candidates is not None and len(candidates.rx):
            waiting.append(candidates)
            doing = message


def stock_paths(scene: Any, settings: TraceSettings, tx_m: Floats, rx_m: Floats) -> Iterator[SolvedPaths]:
    """Find paths of every enabled kind from a transmitter (3,) to receivers (N, 3) by Sionna RT's public path solver.

    `scene` comes from `open_scene`; positions and paths are in its coordinates. Most paths are found, not all: the more
    rays, the more. Sionna RT counts the sequences of surfaces that rays meet in a hash table which all receivers of a
    call share, where a collision drops a path: each receiver has a call of its own, and its paths do not depend on the
    others. Sionna RT 2.2 takes paths that are reflected after a diffraction, and have fewer than `max_depth`
    interactions, for longer than they are, and some dB too weak. Raises a BackendError if LLVM or Sionna RT cannot be
    used.
    """
    if len(rx_m) == 0:
        return
    rt = load_sionna()
    try:
        receiver = rt.Receiver("rx", position=_point(rx_m[0]))
        for device in (rt.Transmitter("tx", position=_point(tx_m)), receiver):
            scene.remove(device.name)
            scene.add(device)
        solver = rt.PathSolver(deterministic=True)
        for index, position_m in enumerate(rx_m):
            receiver.position = _point(position_m)
            yield _read_paths(solver(scene, **_options(settings)), max(1, settings.max_depth), index, tx_m, rx_m)
    except Exception as error:
        raise BackendError(
            f"Sionna RT {metadata.version('sionna-rt')} cannot solve the paths ({error!r}): lower samples_per_tx if "
            "memory ran out, or install sionna-partial again."
        ) from error


def _point(position_m: Floats) -> Any:
    """Position as an array on the device: Dr.Jit would compile a literal into its kernels, anew for each receiver."""
    import mitsuba as mi

    return mi.Point3f(*(mi.Float([float(value)]) for value in position_m))


def _options(settings: TraceSettings) -> dict[str, Any]:
    """Arguments of Sionna RT's path solver."""
    rays = settings.samples_per_tx
    every_ray = 1 + rays * settings.max_depth if settings.diffuse_reflection else 0
    return {
        "max_depth": settings.max_depth,
        "max_num_paths_per_src": max(TABLE_SIZE, every_ray),
        "samples_per_src": rays,
        "los": True,
        "seed": settings.seed,
        **{argument: kind.is_on(settings) for kind in INTERACTIONS for argument in kind.arguments},
    }


def _read_paths(found: Any, depth: int, index: int, tx_m: Floats, rx_m: Floats) -> SolvedPaths:
    """Copy the valid paths of one receiver out of Dr.Jit, each once."""
    real, imaginary = (np.transpose(part.numpy()[0, :, 0], (2, 0, 1)) for part in found.a)
    transfer = real + 1j * imaginary
    valid = np.flatnonzero(found.valid.numpy().ravel() & (transfer[:, 0, 0] != 0.0))
    interactions = found.interactions.numpy().reshape(depth, -1)[:, valid].T.astype(np.uint8)
    vertices_m = np.moveaxis(found.vertices.numpy().reshape(depth, -1, 3)[:, valid], 0, 1)
    kept = ~listed_before(interactions, vertices_m)
    return SolvedPaths.of_vertices(
        path_rx=np.full(kept.sum(), index, np.int32),
        transfer=transfer[valid][kept].astype(np.complex128),
        delay_s=found.tau.numpy().ravel()[valid].astype(np.float64)[kept],
        interactions=interactions[kept],
        vertices_m=vertices_m[kept],
        tx_m=tx_m,
        rx_m=rx_m,
    )


def listed_before(interactions: States, vertices_m: NDArray[np.floating[Any]]) -> Bools:
    """Find the paths (P,) of one receiver that repeat an earlier one: the same interactions at the same points.

    Sionna RT identifies sequences by hashes of rounded planes, and rounding can give one plane two hashes. Paths with
    a diffuse reflection are samples of a rough surface, however close, and never repeats.
    """
    repeated = np.zeros(len(interactions), dtype=bool)
    exact = np.flatnonzero((interactions != DIFFUSE).all(axis=1))
    points = np.where(interactions[exact, :, None] > 0, vertices_m[exact], 0.0)
    tree = cKDTree(points.reshape(len(exact), 3 * interactions.shape[1]))
    pairs = tree.query_pairs(SAME_POINT_M, p=np.inf, output_type="ndarray")
    first, second = exact[pairs].T
    repeated[second[(interactions[first] == interactions[second]).all(axis=1)]] = True
    return repeated


def diffracted_as_exact(wedges: Wedges, paths: SolvedPaths, walls_a_side: int) -> Bools:
    """Whether each path (P,) is diffracted as exact candidates are, if it is at all.

    Sionna RT's rays are diffracted at the rims of floor and ceiling and at junctions of walls as well, and with any
    number of reflections around it.
    """
    diffracted = (paths.interactions == DIFFRACTION).any(axis=1)
    kept = ~diffracted
    if diffracted.any() and len(wedges.edge_m):
        which = (paths.interactions == DIFFRACTION).argmax(axis=1)
        x, y, z = paths.vertices_m[np.arange(len(diffracted)), which][diffracted].T
        distance_m, edge = cKDTree(wedges.edge_m).query(np.column_stack([x, y]))
        beside, top_m = distance_m < SAME_EDGE_M, wedges.height_m[edge]
        reflected = paths.interactions[diffracted] == REFLECTION
        height_m = paths.vertices_m[diffracted, :, 2]
        at_walls = reflected & (height_m > SAME_EDGE_M) & (height_m < wedges.height_m.max() - SAME_EDGE_M)
        before = np.arange(reflected.shape[1]) < which[diffracted, None]
        few = reflected.sum(axis=1) <= MAX_REFLECTIONS
        few &= ((at_walls & before).sum(axis=1) <= walls_a_side) & ((at_walls & ~before).sum(axis=1) <= walls_a_side)
        kept[diffracted] = few & beside & (z > SAME_EDGE_M) & (z < top_m - SAME_EDGE_M)
    return kept
