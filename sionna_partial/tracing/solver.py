"""The one place that leans on Sionna RT's internals: candidates in, verified paths out.

Sionna RT's `PathSolver` is a chain of a candidate generator, `ImageMethod` and `FieldCalculator`. Here the same chain
runs on candidates from exact beams, or from Sionna RT's own deterministic generator where rays must be shot. Either
way `ImageMethod` verifies every path and `FieldCalculator` gives every coefficient. Positions go in as plain arrays:
`Scene.targets()`, which compiles a kernel for each receiver, is left out.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.errors import BackendError
from sionna_partial.llvm import load_llvm
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.candidates import CEILING, EDGE, FLOOR, Candidates
from sionna_partial.tracing.diffraction import Wedges

MITSUBA_VARIANT = "llvm_ad_mono_polarized"
"""Mitsuba variant of Sionna RT on a CPU."""


@dataclass(frozen=True)
class SolvedPaths:
    """Verified paths in scene coordinates (fields as in `TracedLinks`; D may be less)."""

    path_rx: NDArray[np.int32]
    a: NDArray[np.complex128]
    delay_s: NDArray[np.float64]
    departure_rad: NDArray[np.float64]
    arrival_rad: NDArray[np.float64]
    interactions: NDArray[np.uint8]
    vertices_m: NDArray[Any]


def load_sionna() -> ModuleType:
    """Import Sionna RT on the CPU, with a working LLVM.

    Raises
    ------
    BackendError
        If LLVM or Sionna RT cannot be used; the message says what to do.
    """
    load_llvm()
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant(MITSUBA_VARIANT)
    if mi.variant() != MITSUBA_VARIANT:
        raise BackendError(
            f"mitsuba variant = {mi.variant()!r} is not supported: call mitsuba.set_variant('{MITSUBA_VARIANT}') "
            "before the first trace, or import sionna_partial in a process of its own."
        )
    import sionna.rt

    return sionna.rt


class _IncoherentScene:
    """A Mitsuba scene that traces every ray for itself.

    `ImageMethod` tells Embree that its rays are coherent. Neighbours in a packet then decide whether a wall is hit: one
    path in 600 was lost, and which ones depended on the other receivers.
    """

    def __init__(self, scene: Any) -> None:
        self._scene = scene

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scene, name)

    def ray_intersect(self, ray: Any, **options: Any) -> Any:
        return self._scene.ray_intersect(ray, **{**options, "coherent": False})


class SceneSolver:
    """Solves paths from one transmitter in one exported scene.

    Parameters
    ----------
    scene_xml : Path
        Exported scene whose shapes are called walls, floor and ceiling.
    settings : TraceSettings
    tx_m : (3,) array
        Transmitter, in scene coordinates [m].
    rx_m : (N, 3) array
        Receivers, in scene coordinates [m].
    """

    def __init__(
        self, scene_xml: Path, settings: TraceSettings, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]
    ) -> None:
        rt = load_sionna()
        import mitsuba as mi

        self._settings = settings
        self._scene = rt.load_scene(str(scene_xml), merge_shapes=False)
        self._scene.frequency = settings.frequency_hz
        antenna = rt.PlanarArray(
            num_rows=1, num_cols=1, vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="V"
        )
        self._scene.tx_array = self._scene.rx_array = antenna
        self._tx_m = tx_m
        self._tx = mi.Point3f(*(mi.Float([float(value)]) for value in tx_m))
        self._rx_m = rx_m
        self._image_method = rt.path_solvers.image_method.ImageMethod()
        self._field_calculator = rt.path_solvers.field_calculator.FieldCalculator()

    def verify(self, candidates: Candidates) -> SolvedPaths:
        """Verify candidates and compute their coefficients; either all of them diffract or none does."""
        buffer = self._candidate_buffer(candidates)
        return self._solve(buffer, self._rx_m, diffraction=len(candidates.wedge) > 0)

    @property
    def wedges(self) -> Wedges:
        """Vertical edges of the walls as Sionna RT sees them: corners, and free ends, which it takes for screens."""
        table, primitive = self._wedge_table
        faces = (normal.numpy()[:2, : len(primitive)].T.astype(np.float64) for normal in (table.n0, table.nn))
        return Wedges(primitive // 2, 1 - primitive % 2, *faces)

    @cached_property
    def _wedge_table(self) -> tuple[Any, NDArray[np.int64]]:
        """Sionna RT's wedges along the vertical edges, as they are and then with faces swapped, and their triangles.

        Segment s of the walls is made of the triangles 2 s and 2 s + 1 (see `write_scene`). Edge 1 of the one and edge
        2 of the other are vertical.
        """
        import drjit as dr
        import mitsuba as mi
        from sionna.rt.utils.wedges import WedgeGeometry, wedge_geometry

        if "walls" not in self._scene.objects:
            return WedgeGeometry.build_with_size(0), np.zeros(0, np.int64)
        walls = self._scene.objects["walls"]
        primitive = np.arange(walls.mi_mesh.face_count(), dtype=np.uint32)
        local_edge = 1 + primitive % 2
        shape = dr.reinterpret_array(mi.MeshPtr, dr.full(mi.UInt, walls.object_id, len(primitive)))
        every = wedge_geometry(shape, mi.UInt(primitive), mi.UInt(local_edge))
        ends = np.sort([every.prim0.numpy(), every.primn.numpy()], axis=0)
        _, first = np.unique(ends, axis=1, return_index=True)
        flat = (every.n0.numpy() * every.nn.numpy()).sum(axis=0) > 1.0 - 1e-6
        kept = first[~flat[first]]
        swapped = mi.Bool(np.repeat([False, True], len(kept)))
        table = dr.gather(WedgeGeometry, every, mi.UInt(np.tile(kept, 2).astype(np.uint32)))
        table.swap_faces(swapped)
        dr.eval(table)
        return table, primitive[kept].astype(np.int64)

    def shoot(self) -> Iterator[SolvedPaths]:
        """Find paths of every enabled kind by shooting rays, one receiver at a time.

        Sionna RT's generator counts chains in a hash table that receivers of one call share, and a collision drops a
        path. With one receiver a call, the answer cannot depend on the other receivers.
        """
        import drjit as dr
        import mitsuba as mi
        from sionna.rt.path_solvers.sb_deterministic import SBDeterministicCandidateGenerator

        settings = self._settings
        generator = SBDeterministicCandidateGenerator()
        rays = settings.samples_per_tx
        for index, position in enumerate(self._rx_m):
            target = mi.Point3f(*(mi.Float([float(value)]) for value in position))
            dr.make_opaque(self._tx, target)
            buffer = generator(
                mi_scene=self._scene.mi_scene,
                src_positions=self._tx,
                tgt_positions=target,
                samples_per_src=rays,
                max_num_paths_per_src=1 + rays * settings.max_depth if settings.diffuse_reflection else 100_000,
                max_depth=settings.max_depth,
                los=True,
                specular_reflection=True,
                diffuse_reflection=settings.diffuse_reflection,
                refraction=settings.refraction,
                diffraction=settings.diffraction,
                edge_diffraction=settings.diffraction,
                seed=settings.seed,
            )
            buffer.schedule()
            dr.eval()
            buffer.shrink()
            buffer.detach_geometry()
            paths = self._solve(buffer, position[None], diffraction=settings.diffraction)
            yield SolvedPaths(paths.path_rx + np.int32(index), *(getattr(paths, name) for name in _FIELDS[1:]))

    def _candidate_buffer(self, candidates: Candidates) -> Any:
        """Fill one of Sionna RT's path buffers with unverified candidates."""
        import drjit as dr
        import mitsuba as mi
        from sionna.rt.constants import INVALID_PRIMITIVE, InteractionType
        from sionna.rt.path_solvers.paths_buffer import PathsBuffer
        from sionna.rt.utils.wedges import WedgeGeometry

        count, depth = candidates.surface.shape
        surface = candidates.surface
        primitive = np.where(surface >= 0, 2 * surface, 0).astype(np.uint32)
        primitive[surface == -1] = INVALID_PRIMITIVE
        kind = np.where(surface == -1, InteractionType.NONE, InteractionType.SPECULAR).astype(np.uint32)
        buffer = PathsBuffer(count, depth, len(candidates.wedge) > 0)
        if len(candidates.wedge):
            wedges = dr.gather(WedgeGeometry, self._wedge_table[0], mi.UInt(candidates.wedge.astype(np.uint32)))
            primitive[surface == EDGE] = wedges.prim0.numpy()
            kind[surface == EDGE] = InteractionType.DIFFRACTION
            buffer._diffracting_wedges = wedges
        float_tensor: Any = mi.TensorXf
        integer_tensor: Any = mi.TensorXu
        x, y, z = np.moveaxis(candidates.vertices_m.astype(np.float32), 2, 0)
        buffer._vertices_x, buffer._vertices_y, buffer._vertices_z = (float_tensor(v.copy()) for v in (x, y, z))
        buffer._shapes, buffer._primitives = integer_tensor(self._shapes(surface)), integer_tensor(primitive)
        buffer._interaction_types = integer_tensor(kind)
        buffer._tgt_indices = mi.UInt(candidates.rx.astype(np.uint32))
        buffer._paths_counter = mi.UInt(count)
        buffer.shrink()
        return buffer

    def _shapes(self, surface: NDArray[np.int32]) -> NDArray[np.uint32]:
        """Identify the shape of each surface for Sionna RT."""
        from sionna.rt.constants import INVALID_SHAPE

        shape = np.full(surface.shape, INVALID_SHAPE, np.uint32)
        walls = (surface >= 0) | (surface == EDGE)
        for name, where in (("walls", walls), ("floor", surface == FLOOR), ("ceiling", surface == CEILING)):
            if where.any():
                shape[where] = self._scene.objects[name].object_id
        return shape

    def _solve(self, buffer: Any, rx_m: NDArray[np.float64], *, diffraction: bool) -> SolvedPaths:
        """Run the image method and the field calculator on a buffer of candidates."""
        import drjit as dr
        import mitsuba as mi

        targets = mi.Point3f(*(mi.Float(column.astype(np.float32)) for column in rx_m.T))
        still = dr.zeros(mi.Point3f, 1), dr.zeros(mi.Point3f, len(rx_m))
        dr.make_opaque(self._tx, targets, *still)
        patterns = self._scene.tx_array.antenna_pattern.patterns
        buffer = self._image_method(
            scene=_IncoherentScene(self._scene.mi_scene),
            paths=buffer,
            src_positions=self._tx,
            tgt_positions=targets,
            diffraction=diffraction,
            diffraction_lit_region=True,
        )
        buffer = self._field_calculator(
            wavelength=self._scene.wavelength,
            paths=buffer,
            samples_per_src=self._settings.samples_per_tx,
            diffraction=diffraction,
            src_positions=self._tx,
            tgt_positions=targets,
            src_orientations=still[0],
            tgt_orientations=still[1],
            src_antenna_patterns=patterns,
            tgt_antenna_patterns=patterns,
        )
        return _read_buffer(buffer, self._tx_m, rx_m)


_FIELDS = tuple(SolvedPaths.__dataclass_fields__)


def join_paths(parts: list[SolvedPaths], max_depth: int) -> SolvedPaths:
    """Join lists of paths, ordered by receiver and then by delay.

    Takes the parts out of the list one by one, so that memory need not hold all paths twice.
    """
    total, depth = sum(len(part.a) for part in parts), max(1, max_depth)
    joined = SolvedPaths(
        path_rx=np.zeros(total, np.int32),
        a=np.zeros(total, np.complex128),
        delay_s=np.zeros(total),
        departure_rad=np.zeros((total, 2)),
        arrival_rad=np.zeros((total, 2)),
        interactions=np.zeros((total, depth), np.uint8),
        vertices_m=np.full((total, depth, 3), math.nan),
    )
    place = np.empty(total, np.int64)
    if parts:
        order = np.lexsort([np.concatenate([getattr(part, key) for part in parts]) for key in ("delay_s", "path_rx")])
        place[order] = np.arange(total)
    start = 0
    while parts:
        part = parts.pop(0)
        at = place[start : start + len(part.a)]
        for name in _FIELDS[:5]:
            getattr(joined, name)[at] = getattr(part, name)
        joined.interactions[at, : part.interactions.shape[1]] = part.interactions
        joined.vertices_m[at, : part.interactions.shape[1]] = part.vertices_m
        start += len(part.a)
    return joined


def _read_buffer(buffer: Any, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> SolvedPaths:
    """Copy the valid paths of a buffer out of Dr.Jit."""
    if buffer.buffer_size == 0:
        return join_paths([], buffer.max_depth)
    buffer.schedule()
    valid = np.flatnonzero(buffer.valid.numpy())
    path_rx = buffer.target_indices.numpy()[valid].astype(np.int32)
    a = buffer.a[0][0]
    interactions = buffer.interaction_types.numpy()[valid].astype(np.uint8)
    vertices = np.stack([v.numpy()[valid] for v in (buffer.vertices_x, buffer.vertices_y, buffer.vertices_z)], axis=2)
    vertices = np.where(interactions[:, :, None] > 0, vertices, np.float32(math.nan))
    count = (interactions > 0).sum(axis=1)
    direct = (count == 0)[:, None]
    first, last = vertices[:, 0], vertices[np.arange(len(valid)), np.maximum(count, 1) - 1]
    return SolvedPaths(
        path_rx=path_rx,
        a=a.real.numpy()[valid].astype(np.float64) + 1j * a.imag.numpy()[valid],
        delay_s=buffer.tau.numpy()[valid].astype(np.float64),
        departure_rad=_zenith_azimuth(np.where(direct, rx_m[path_rx], first) - tx_m),
        arrival_rad=_zenith_azimuth(np.where(direct, tx_m, last) - rx_m[path_rx]),
        interactions=interactions,
        vertices_m=vertices,
    )


def _zenith_azimuth(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Zenith and azimuth angles [rad] (P, 2) of direction vectors (P, 3)."""
    x, y, z = direction.T
    return np.stack([np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)], axis=1)
