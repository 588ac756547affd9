"""Rays from a transmitter, and the chains of faces that they meet."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_RAYS_PER_CHUNK = 250_000


class Rays(NamedTuple):
    """What became of some rays that were reflected like light, up to D times.

    Parameters
    ----------
    face : (R, D) int32 array
        Faces that each ray met, counted through the shapes; -1 once it has escaped.
    leg_m : (R, D + 1) float32 array
        Lengths between the faces [m]; inf where nothing was met.
    direction : (R, D + 1, 3) float32 array
        Unit directions of the legs; meaningless once a ray has escaped.
    """

    face: NDArray[np.int32]
    leg_m: NDArray[np.float32]
    direction: NDArray[np.float32]


def shoot_rays(
    mi_scene: Any, shapes: Sequence[Any], tx_m: NDArray[np.float64], count: int, max_depth: int
) -> Iterator[Rays]:
    """Shoot rays in all directions and reflect each up to `max_depth` times.

    Directions form the Fibonacci lattice that Sionna RT's own rays form.

    Parameters
    ----------
    mi_scene : mitsuba.Scene
    shapes : sequence of mitsuba.Mesh
        All shapes of the scene, in the order in which their faces are counted.
    tx_m : (3,) array
        Transmitter [m].
    count : int
        Number of rays.
    max_depth : int
        Largest number of reflections.

    Yields
    ------
    Rays
        Part by part, always in the same order, so that memory stays bounded.
    """
    import drjit as dr
    import mitsuba as mi

    first_face = _first_faces(shapes)
    origin = mi.Point3f(*(float(value) for value in tx_m))
    dr.make_opaque(origin)  # one compiled kernel serves every transmitter
    pending: Any = None
    for start in range(0, count, _RAYS_PER_CHUNK):
        direction = _directions(np.arange(start, min(start + _RAYS_PER_CHUNK, count)), count)
        launched = _launch(mi_scene, first_face, mi.Ray3f(origin, mi.Vector3f(direction.T)), max_depth)
        if pending is not None:
            yield _collect(pending, max_depth)
        pending = launched  # Dr.Jit traces this part while the caller works on the one before
    if pending is not None:
        yield _collect(pending, max_depth)


def _first_faces(shapes: Sequence[Any]) -> Any:
    """Tabulate the first face of each shape by the shape's number in Dr.Jit's registry."""
    import drjit as dr
    import mitsuba as mi

    pointers: Any = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)) for shape in shapes]
    numbers = [int(pointer.numpy()[0]) for pointer in pointers]
    table = np.zeros(max(numbers, default=0) + 1, np.uint32)
    table[numbers] = np.cumsum([0, *(shape.face_count() for shape in shapes)])[:-1]
    return mi.UInt32(table)


def _directions(number: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """Return the unit vectors with the given numbers in the lattice of `count` directions."""
    turn = 2.0 * np.pi * np.modf(number / ((1.0 + np.sqrt(5.0)) / 2.0))[0]
    z = 1.0 - 2.0 * number / max(1, count - 1)
    across = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1).astype(np.float32)


def _launch(mi_scene: Any, first_face: Any, rays: Any, max_depth: int) -> list[tuple[Any, Any, Any]]:
    """Start tracing: face, length and direction of each leg, which Dr.Jit computes in the background."""
    import drjit as dr
    import mitsuba as mi

    legs, active = [], mi.Bool(True)
    for _ in range(max_depth + 1):
        # coherent rays decide in packets what is hit, and lose hits
        met = mi_scene.ray_intersect(rays, ray_flags=mi.RayFlags.Minimal, coherent=False, active=active)
        active &= met.is_valid()
        shape: Any = dr.reinterpret_array(mi.UInt32, met.shape)
        face = mi.Int32(dr.gather(mi.UInt32, first_face, shape, active) + met.prim_index)
        legs.append((dr.select(active, face, -1), dr.select(active, met.t, dr.inf), rays.d))
        rays = met.spawn_ray(rays.d - 2.0 * dr.dot(rays.d, met.n) * met.n)
        dr.eval(legs[-1], rays, active)
    return legs


def _collect(legs: list[tuple[Any, Any, Any]], max_depth: int) -> Rays:
    """Copy traced rays out of Dr.Jit."""
    face = np.stack([leg[0].numpy() for leg in legs], axis=1)[:, :max_depth]
    leg_m = np.stack([leg[1].numpy() for leg in legs], axis=1)
    return Rays(face, leg_m, np.stack([leg[2].numpy().T for leg in legs], axis=1))
