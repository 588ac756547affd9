"""Sionna RT's internals: candidates in, verified paths out.

`ImageMethod` and `FieldCalculator` run on our candidates. `Scene.targets()`, which compiles a kernel for each receiver,
is avoided. Symbolic loops are fastest, but Dr.Jit differentiates evaluated loops only: `_Verification` has each kind.
"""

import functools
import gc
import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.llvm import load_sionna
from sionna_partial.scene.scene import power_laws
from sionna_partial.settings import Material, TraceSettings
from sionna_partial.tracing.paths import Candidates, SolvedPaths, Wedges, join_paths

TESTED_VERSION = "2.2"
"""Release of Sionna RT whose internals are used."""

REMEDY = f"""run pip install "sionna-rt=={TESTED_VERSION}.*" to have the fast engine back."""

_BUFFER_COLUMNS = "_vertices_x", "_vertices_y", "_vertices_z", "_shapes", "_primitives", "_interaction_types"
_BUFFER_FIELDS = {*_BUFFER_COLUMNS, "_valid", "_src_indices", "_tgt_indices", "_paths_counter", "_diffracting_wedges"}
"""Private fields of `PathsBuffer` that are filled here."""

_log = logging.getLogger(__name__)


@functools.cache
def engine_fault() -> str:
    """Return why this module cannot run on the installed Sionna RT, "" if it can; a fault is logged once."""
    rt, version = load_sionna(), metadata.version("sionna-rt")
    missing = _BUFFER_FIELDS - vars(rt.path_solvers.paths_buffer.PathsBuffer(1, 1, True)).keys()
    if missing:
        fault = f"sionna-rt {version} has no PathsBuffer.{min(missing)}, which the fast engine fills"
    elif not version.startswith(f"{TESTED_VERSION}."):
        fault = f"sionna-rt {version} is not of the release {TESTED_VERSION}, for which the fast engine was made"
    else:
        return ""
    message = "%s. Its public path solver is used, which finds most paths and takes seconds for each receiver: %s"
    _log.warning(message, fault, REMEDY)
    return fault


_RAYS = 1_000_000
"""Number of rays of a transmitter, which only diffuse reflections depend on: candidates have none."""


_PLACES = 256
"""Least number up to which kernels count shapes and materials."""

_placeholders: dict[tuple[str, int], Any] = {}
_holding = threading.Lock()


def open_scene(scene_xml: Path, frequency_hz: float, materials: Mapping[str, Material] | None = None) -> Any:
    """Load a scene with separate shapes and vertical isotropic antennas.

    `materials`, by their names in the scene, follow the frequency.
    """
    scene = load_sionna().load_scene(str(scene_xml), merge_shapes=False)
    import drjit as dr
    import mitsuba as mi

    with _holding:
        _hold_places(scene.mi_scene.shapes())
    set_antennas(scene, 1)
    opaque_hz = dr.opaque(mi.Float, frequency_hz)
    _follow_frequency(scene, materials or {}, opaque_hz, frequency_hz)
    _set_frequency(scene, opaque_hz)
    for own in scene.radio_materials.values():
        dr.make_opaque(own.relative_permittivity, own.conductivity, own.thickness)
    return scene


def set_antennas(scene: Any, polarisations: int) -> None:
    """Give a scene isotropic antennas: vertical, or V and H for 2 polarisations."""
    polarization = "V" if polarisations == 1 else "VH"
    array = load_sionna().PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization=polarization)
    scene.tx_array = scene.rx_array = array


def _set_frequency(scene: Any, frequency_hz: Any) -> None:
    """Set the carrier frequency, a `mitsuba.Float` [Hz], with all materials.

    Frozen functions refer to materials of all scenes that there are, and find their variables in attributes only.
    """
    scene.frequency = frequency_hz
    for material in scene.radio_materials.values():
        material.frequency_of_scene = scene.frequency


def _follow_frequency(scene: Any, materials: Mapping[str, Material], frequency_hz: Any, at_load_hz: float) -> None:
    """Give all materials their dependence on frequency in the same form, for which Dr.Jit compiles once."""
    import drjit as dr
    import mitsuba as mi

    def update(laws: Sequence[tuple[Any, Any]], at_hz: Any) -> tuple[Any, ...]:
        return tuple(value * (at_hz / frequency_hz) ** exponent for value, exponent in laws)

    for name in materials.keys() & scene.radio_materials.keys():
        laws = power_laws(materials[name], at_load_hz)
        opaque = [(dr.opaque(mi.Float, law.value), dr.opaque(mi.Float, law.exponent)) for law in laws]
        scene.radio_materials[name].frequency_update_callback = functools.partial(update, opaque)


def _hold_places(shapes: Sequence[Any]) -> None:
    """Let the largest numbers of shapes and of materials in this process, which Dr.Jit reuses, be powers of two.

    Kernels have tables of as many places, so that each number of scenes and each mesh would compile them again.
    """
    import drjit as dr
    import mitsuba as mi

    def placeholder(kind: str, make: Callable[[], Any], pointer: Any, objects: Sequence[Any]) -> Any:
        place = max(_PLACES, 1 << max(number_of(pointer(each)) for each in objects).bit_length())
        waiting = []
        while (kind, place) not in _placeholders:
            waiting.append(make())
            if number_of(pointer(waiting[-1])) >= place:
                _placeholders[kind, place] = waiting[-1]
        return _placeholders[kind, place]

    def number_of(pointer: Any) -> int:
        numbers: Any = dr.reinterpret_array(mi.UInt, pointer)
        return int(numbers[0])

    def new_material() -> Any:
        return mi.load_dict({"type": "null"})

    def new_shape() -> Any:
        properties: Any = mi.Properties()
        properties["bsdf"] = material
        return mi.Mesh("placeholder", 3, 1, properties)

    if len(shapes):
        material = placeholder("material", new_material, mi.BSDFPtr, [each.bsdf() for each in shapes])
        placeholder("shape", new_shape, mi.ShapePtr, shapes)


class _IncoherentScene:
    """A Mitsuba scene that traces every ray for itself.

    `ImageMethod` declares its rays coherent: in Embree, neighbours in a packet then decide whether a wall is hit.
    """

    def __init__(self, scene: Any) -> None:
        self._scene = scene

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scene, name)

    def ray_intersect(self, ray: Any, **options: Any) -> Any:
        return self._scene.ray_intersect(ray, **{**options, "coherent": False})


_evaluated: ContextVar[Any] = ContextVar("scene whose materials are evaluated", default=None)


@functools.cache
def _leave_out_other_scenes() -> None:
    """Let an evaluation trace the materials of its own scene only: Dr.Jit calls those of all scenes that there are."""
    import mitsuba as mi

    kind = load_sionna().RadioMaterial
    evaluate = kind.eval

    @functools.wraps(evaluate)
    def evaluate_own(material: Any, *arguments: Any, **named: Any) -> Any:
        scene = _evaluated.get()
        return evaluate(material, *arguments, **named) if scene in (None, material.scene) else mi.Spectrum(0.0)

    kind.eval = evaluate_own


class _Verification:
    """Sionna RT's image method and field calculator, with loops of one kind."""

    def __init__(self, loop_mode: str) -> None:
        _leave_out_other_scenes()
        solvers = load_sionna().path_solvers
        self._image_method = solvers.image_method.ImageMethod()
        self._field_calculator = solvers.field_calculator.FieldCalculator()
        self._image_method.loop_mode = self._field_calculator.loop_mode = loop_mode

    def verify(self, scene: Any, buffer: Any, source: Any, targets: Any, diffraction: bool) -> Any:
        return self._image_method(
            scene=_IncoherentScene(scene.mi_scene),
            paths=buffer,
            src_positions=source,
            tgt_positions=targets,
            diffraction=diffraction,
            diffraction_lit_region=True,
        )

    def evaluate(
        self, scene: Any, buffer: Any, source: Any, targets: Any, field: tuple[int, Any], diffraction: bool
    ) -> Any:
        """Return verified candidates with coefficients; `field` is a number of samples and the antenna patterns."""
        import drjit as dr
        import mitsuba as mi

        still = dr.zeros(mi.Point3f, dr.width(source)), dr.zeros(mi.Point3f, dr.width(targets))
        dr.make_opaque(*still)
        token = _evaluated.set(scene)
        try:
            return self._field_calculator(
                wavelength=scene.wavelength,
                paths=buffer,
                samples_per_src=field[0],
                diffraction=diffraction,
                src_positions=source,
                tgt_positions=targets,
                src_orientations=still[0],
                tgt_orientations=still[1],
                src_antenna_patterns=field[1],
                tgt_antenna_patterns=field[1],
            )
        finally:
            _evaluated.reset(token)


def _end_at_targets(buffer: Any, targets: Any) -> None:
    """Put the receiver where a path has no more interactions.

    `ImageMethod` leaves images of the edge there, which `FieldCalculator` 2.2 takes for points after the edge.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.constants import InteractionType

    kind = buffer.interaction_types
    target = dr.gather(mi.Point3f, targets, dr.repeat(buffer.target_indices, kind.shape[1]))
    for name, position in zip(("_vertices_x", "_vertices_y", "_vertices_z"), target, strict=True):
        beyond = dr.select(kind.array == InteractionType.NONE, position, getattr(buffer, name).array)
        setattr(buffer, name, type(getattr(buffer, name))(beyond, kind.shape))


def _shortened(buffer: Any, candidates: Candidates, targets: Any) -> Any:
    """Return verified candidates without refractions at further faces of a wall, ended at the receivers."""
    buffer = _without_same_walls(buffer, candidates)
    if candidates.wedges is not None:
        _end_at_targets(buffer, targets)
    return buffer


def _without_same_walls(buffer: Any, candidates: Candidates) -> Any:
    if candidates.same_wall is None:
        return buffer
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.constants import InteractionType
    from sionna.rt.path_solvers.paths_buffer import PathsBuffer

    dropped, none = candidates.same_wall, candidates.kind == InteractionType.NONE
    count, depth = dropped.shape
    kept = np.argsort(dropped, axis=1, kind="stable")
    kept = kept[:, : max(1, int((~dropped & ~none).sum(axis=1).max()))]
    flat = to_device(mi.UInt, (kept + depth * np.arange(count)[:, None]).astype(np.uint32).ravel())
    shorter = PathsBuffer(*kept.shape, buffer.diffracting_wedges is not None)
    for name in _BUFFER_COLUMNS:
        column = getattr(buffer, name)
        values = dr.gather(type(column.array), column.array, flat)
        if name == "_interaction_types":
            ended = to_device(mi.Bool, np.take_along_axis(dropped | none, kept, axis=1).ravel())
            values = dr.select(ended, InteractionType.NONE, values)
        setattr(shorter, name, type(column)(values, kept.shape))
    for name in ("_valid", "_src_indices", "_tgt_indices", "_paths_counter", "_diffracting_wedges"):
        setattr(shorter, name, getattr(buffer, name))
    return shorter


_ALIGNMENT_BYTES = 64


def to_device(kind: Any, values: NDArray[Any]) -> Any:
    """Copy an array to Dr.Jit, aligned as its own arrays: for other mixtures it compiles kernels anew."""
    room = np.empty(values.nbytes + _ALIGNMENT_BYTES, np.uint8)
    skip = -room.ctypes.data % _ALIGNMENT_BYTES
    aligned = room[skip : skip + values.nbytes].view(values.dtype).reshape(values.shape)
    aligned[...] = values
    return kind(aligned)


@dataclass(frozen=True)
class Variables:
    """Variables of the power of paths, as `mitsuba.Float`, to which derivatives lead back.

    `shift_m` is added to x, y, z of the transmitters, each with 1 or T entries [m], `frequency_hz` to the carrier
    frequency, None for an unchanged one. The others are values for each of `SceneSolver.materials`, not changes, which
    would drown in a metal's conductivity; they are multiplied by the materials' change with the frequency.
    """

    shift_m: tuple[Any, ...]
    relative_permittivity: tuple[Any, ...]
    conductivity_s_m: tuple[Any, ...]
    thickness_m: tuple[Any, ...]
    frequency_hz: Any | None


@dataclass(frozen=True)
class HeldPaths:
    """Power (C,) of paths with fixed vertices.

    `evaluate` runs the field calculator; `repeat` replays kernels recorded by Dr.Jit: faster, without derivatives.
    """

    evaluate: Callable[[_Verification], Any]
    repeat: Callable[[], Any]


class SceneSolver:
    """Solver of candidates in one exported scene, with vertical antennas except after `polarised`.

    `shapes` are names in face order; shapes that the scene lacks have no faces. `materials`, by their names in the
    scene, follow the frequency.
    """

    def __init__(
        self,
        scene_xml: Path,
        shapes: tuple[str, ...],
        settings: TraceSettings,
        materials: Mapping[str, Material] | None = None,
    ) -> None:
        load_sionna()
        from sionna.rt.constants import INVALID_PRIMITIVE, INVALID_SHAPE

        self._scene = open_scene(scene_xml, settings.frequency_hz, materials)
        self.mi_scene = self._scene.mi_scene
        self._field = _RAYS, self._scene.tx_array.antenna_pattern.patterns
        objects = [self._scene.objects[name] for name in shapes if name in self._scene.objects]
        self.shapes = [shape.mi_mesh for shape in objects]
        faces = [mesh.face_count() for mesh in self.shapes]
        names = [*self._scene.radio_materials]
        self.material_of_face = np.repeat(
            np.array([names.index(shape.radio_material.name) for shape in objects], np.int64), faces
        )
        shape = np.repeat(np.array([shape.object_id for shape in objects], np.uint32), faces)
        self._shape_of_face = np.append(shape, np.uint32(INVALID_SHAPE))  # the last is for no face, -1
        self._primitive_of_face = np.concatenate([*map(np.arange, faces), [INVALID_PRIMITIVE]]).astype(np.uint32)
        self._symbolic, self._evaluated = _Verification("symbolic"), _Verification("evaluated")

    def polarised(self, polarisations: int) -> "SceneSolver":
        solver = copy(self)
        set_antennas(self._scene, polarisations)
        solver._field = self._field[0], self._scene.tx_array.antenna_pattern.patterns
        return solver

    @property
    def materials(self) -> dict[str, Floats]:
        """Relative permittivity, conductivity [S/m] and thickness [m] (3,) of each material, by name."""
        return {
            name: np.ravel([each.relative_permittivity, each.conductivity, each.thickness]).astype(np.float64)
            for name, each in self._scene.radio_materials.items()
        }

    def verify(self, candidates: Candidates, tx_m: Floats, rx_m: Floats) -> tuple[SolvedPaths, Indices]:
        """Return the verified paths and the candidate (P,) of each path.

        The transmitter (3,) and the receivers (N, 3) are in scene coordinates [m].
        """
        if len(candidates.rx) == 0:
            return join_paths([], candidates.face.shape[1]), np.zeros(0, np.intp)
        ends, diffraction = (_points(tx_m[None]), _points(rx_m)), candidates.wedges is not None
        buffer = self._symbolic.verify(self._scene, self._buffer(candidates), *ends, diffraction)
        buffer = _shortened(buffer, candidates, ends[1])
        buffer = self._symbolic.evaluate(self._scene, buffer, *ends, self._field, diffraction)
        return _read_buffer(buffer, tx_m, rx_m)

    def moved(
        self,
        candidates: Candidates,
        tx_index: NDArray[np.int32],
        tx_m: Floats,
        rx_m: Floats,
        variables: Variables,
        *,
        differentiable: bool,
    ) -> tuple[Any, Any]:
        """Verify candidates from T transmitters to N receivers, in scene coordinates, for other variables.

        Return power (C,), 0 for invalid candidates, and vertices (C D,) [m]. Derivatives need slower loops.
        """
        import drjit as dr
        import mitsuba as mi

        ends = _points(tx_m) + mi.Point3f(*variables.shift_m), _points(rx_m)
        verification = self._evaluated if differentiable else self._symbolic
        # Dr.Jit cannot pass forward through a symbolic call of a material twice
        with self._changed(variables), dr.scoped_set_flag(dr.JitFlag.SymbolicCalls, not differentiable):
            buffer = self._verified(verification, candidates, tx_index, ends)
            power = self._power(verification, buffer, ends, candidates.wedges is not None)
            return power, mi.Point3f(buffer.vertices_x.array, buffer.vertices_y.array, buffer.vertices_z.array)

    def held(self, candidates: Candidates, tx_index: NDArray[np.int32], tx_m: Floats, rx_m: Floats) -> HeldPaths:
        import drjit as dr

        ends, diffraction = (_points(tx_m), _points(rx_m)), candidates.wedges is not None
        buffer = self._verified(self._symbolic, candidates, tx_index, ends)
        buffer.schedule()
        dr.eval(buffer.valid)

        def evaluate(verification: _Verification) -> Any:
            again = copy(buffer)
            again.valid = dr.copy(buffer.valid)
            return self._power(verification, again, ends, diffraction)

        def state() -> Any:
            return self.mi_scene, [*self._scene.radio_materials.values()], self._scene.frequency, vars(buffer), ends

        return HeldPaths(evaluate, dr.freeze(lambda: evaluate(self._symbolic), state_fn=state))

    def power(self, paths: HeldPaths, variables: Variables, *, differentiable: bool) -> Any:
        """Return the power (C,) for other materials and another frequency."""
        import drjit as dr

        with self._changed(variables), dr.scoped_set_flag(dr.JitFlag.SymbolicCalls, not differentiable):
            if differentiable or not self._scene.radio_materials:  # without any, Dr.Jit has nothing to record
                return paths.evaluate(self._evaluated if differentiable else self._symbolic)
            collects = gc.isenabled()
            gc.disable()  # Dr.Jit aborts where a scene is collected while it records
            try:
                return paths.repeat()
            finally:
                if collects:
                    gc.enable()

    def _verified(
        self, verification: _Verification, candidates: Candidates, tx_index: NDArray[np.int32], ends: tuple[Any, Any]
    ) -> Any:
        import mitsuba as mi

        buffer = self._buffer(candidates)
        buffer._src_indices = to_device(mi.UInt, tx_index.astype(np.uint32))
        buffer = verification.verify(self._scene, buffer, *ends, candidates.wedges is not None)
        return _shortened(buffer, candidates, ends[1])

    def _power(self, verification: _Verification, buffer: Any, ends: tuple[Any, Any], diffraction: bool) -> Any:
        import drjit as dr

        buffer = verification.evaluate(self._scene, buffer, *ends, self._field, diffraction)
        a = buffer.a[0][0]
        return dr.select(buffer.valid, dr.square(a.real) + dr.square(a.imag), 0.0)

    @contextmanager
    def _changed(self, variables: Variables) -> Iterator[None]:
        import drjit as dr

        materials = [*self._scene.radio_materials.values()]
        kept = [(each, dict(vars(each))) for each in (self._scene, *materials)]
        constants = [(own, own.relative_permittivity, own.conductivity) for own in materials]
        try:
            if variables.frequency_hz is not None:
                _set_frequency(self._scene, self._scene.frequency + variables.frequency_hz)
            values = variables.relative_permittivity, variables.conductivity_s_m, variables.thickness_m
            for (material, permittivity, conductivity), *new in zip(constants, *values, strict=True):
                material.relative_permittivity = new[0] * (material.relative_permittivity / permittivity)
                grown = dr.select(conductivity > 0.0, material.conductivity / dr.maximum(conductivity, 1e-30), 1.0)
                material.conductivity = new[1] * grown
                material.thickness = new[2]
            yield
        finally:
            for each, attributes in kept:  # their setters would launch kernels
                vars(each).update(attributes)

    def _buffer(self, candidates: Candidates) -> Any:
        import mitsuba as mi
        from sionna.rt.path_solvers.paths_buffer import PathsBuffer

        face, kind = candidates.face, candidates.kind.astype(np.uint32)
        shape, primitive = self._shape_of_face[face], self._primitive_of_face[face]
        buffer = PathsBuffer(*face.shape, candidates.wedges is not None)
        buffer._vertices_x, buffer._vertices_y, buffer._vertices_z = (
            to_device(mi.TensorXf, axis.astype(np.float32)) for axis in np.moveaxis(candidates.vertices_m, 2, 0)
        )
        buffer._shapes, buffer._primitives = to_device(mi.TensorXu, shape), to_device(mi.TensorXu, primitive)
        buffer._interaction_types = to_device(mi.TensorXu, kind)
        buffer._tgt_indices = to_device(mi.UInt, candidates.rx.astype(np.uint32))
        buffer._paths_counter = mi.UInt(len(face))
        if candidates.wedges is not None and candidates.wedge is not None:
            buffer._diffracting_wedges = self._wedge_geometry(candidates.wedges, candidates.wedge)
        buffer.shrink()
        return buffer

    def _wedge_geometry(self, wedges: Wedges, index: NDArray[np.int32]) -> Any:
        """Return the wedges of candidates for Sionna RT: normal of the 0-face x edge points along that face."""
        import drjit as dr
        import mitsuba as mi
        from sionna.rt.utils.wedges import WedgeGeometry

        upward = index < len(wedges.edge_m)
        edge = index % len(wedges.edge_m)
        (x, y), height_m = wedges.edge_m[edge].T, wedges.height_m[edge]
        face, normal, flat = wedges.face[index], wedges.normal[index], np.zeros(len(index))

        def vectors(kind: Any, *columns: Floats) -> Any:
            return kind(*(to_device(mi.Float, column.astype(np.float32)) for column in columns))

        return WedgeGeometry(
            shape=dr.reinterpret_array(mi.MeshPtr, to_device(mi.UInt, self._shape_of_face[face[:, 0]])),
            prim0=to_device(mi.UInt, self._primitive_of_face[face[:, 0]]),
            primn=to_device(mi.UInt, self._primitive_of_face[face[:, 0]] + (face[:, 0] != face[:, 1])),
            local_edge=dr.zeros(mi.UInt, len(index)),
            o=vectors(mi.Point3f, x, y, np.where(upward, 0.0, height_m)),
            e_hat=vectors(mi.Vector3f, flat, flat, np.where(upward, 1.0, -1.0)),
            length=to_device(mi.Float, height_m.astype(np.float32)),
            n0=vectors(mi.Normal3f, *normal[:, 0].T, flat),
            nn=vectors(mi.Normal3f, *normal[:, 1].T, flat),
        )


def _points(positions_m: Floats) -> Any:
    import drjit as dr
    import mitsuba as mi

    points = mi.Point3f(*(to_device(mi.Float, column.astype(np.float32)) for column in positions_m.T))
    dr.make_opaque(points)
    return points


def _read_buffer(buffer: Any, tx_m: Floats, rx_m: Floats) -> tuple[SolvedPaths, Indices]:
    buffer.schedule()
    a = buffer.a[0][0]
    valid = np.flatnonzero(buffer.valid.numpy() & ((a.real.numpy() != 0.0) | (a.imag.numpy() != 0.0)))
    transfer = np.array([[a.real.numpy()[valid] + 1j * a.imag.numpy()[valid] for a in row] for row in buffer.a])
    vertices_m = [getattr(buffer, f"vertices_{axis}").numpy()[valid] for axis in "xyz"]
    paths = SolvedPaths.of_vertices(
        path_rx=buffer.target_indices.numpy()[valid].astype(np.int32),
        transfer=np.moveaxis(transfer, 2, 0).astype(np.complex128),
        delay_s=buffer.tau.numpy()[valid].astype(np.float64),
        interactions=buffer.interaction_types.numpy()[valid].astype(np.uint8),
        vertices_m=np.stack(vertices_m, axis=2),
        tx_m=tx_m,
        rx_m=rx_m,
    )
    return paths, valid
