"""Rays from a transmitter, and the sequences of planes that they meet."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import grow
from sionna_partial.tracing.mesh.faces import MeshPlanes, mix

MARGIN = 8.0
"""Distance in direction from a sequence's rays up to which its receivers are looked for, in spacings of the rays."""

_RAYS_PER_CHUNK = 250_000


class Rays(NamedTuple):
    """R rays that were reflected like light, up to D times.

    `face` (R, D) are the faces that each met, counted through the shapes, -1 once it has escaped; `leg_m` (R, D + 1)
    the lengths between them, inf where nothing was met; `direction` (R, D + 1, 3) the unit directions of the legs.
    """

    face: NDArray[np.int32]
    leg_m: NDArray[np.float32]
    direction: NDArray[np.float32]


def shoot_rays(
    mi_scene: Any, shapes: Sequence[Any], tx_m: NDArray[np.float64], count: int, max_depth: int
) -> Iterator[Rays]:
    """Shoot `count` rays from a transmitter (3,) in all directions, and reflect each up to `max_depth` times.

    Directions form the Fibonacci lattice that Sionna RT's own rays form. `shapes` are all shapes of the scene, in the
    order in which their faces are counted. Rays come part by part, always in the same order.
    """
    import drjit as dr
    import mitsuba as mi

    first_face = _first_faces(shapes)
    origin = mi.Point3f(*(float(value) for value in tx_m))
    dr.make_opaque(origin)  # one compiled kernel serves every transmitter
    pending: Any = None
    for start in range(0, count, _RAYS_PER_CHUNK):
        direction = lattice(np.arange(start, min(start + _RAYS_PER_CHUNK, count)), count)
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


def lattice(number: NDArray[np.int64], count: int) -> NDArray[np.float32]:
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
        # coherent rays are intersected in packets, and lose hits
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


class Sequences(NamedTuple):
    """Every sequence of planes that rays met, as a tree; the first `size` rows of the arrays are used.

    `parent` (M,) is the sequence without its last plane (-1 for none), `plane` (M,) that plane. Boxes `low`, `high`
    (M, 3) hold the unit directions in which rays left it, and `reach_m` (M,) is the unfolded length of the longest of
    these rays, to where it met the next face. `table` is a hash table of the sequences, -1 where it is empty.
    """

    parent: NDArray[np.int32]
    plane: NDArray[np.int32]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    reach_m: NDArray[np.float32]
    table: NDArray[np.int32]
    size: int
    rays: int


class Views(NamedTuple):
    """Views of M sequences, in which their receivers are.

    `order` has each sequence after its parent, with all that begin like it behind it; `depth` is the number of planes,
    `source_m` (M, 3) the image of the transmitter, and `margin` the width by which the box of directions is enlarged.
    """

    order: NDArray[np.int32]
    depth: NDArray[np.int32]
    source_m: NDArray[np.float64]
    margin: NDArray[np.float64]


def collect_sequences(rays: Iterable[Rays], planes: MeshPlanes) -> Sequences:
    """Make the tree of all sequences of planes that rays have met."""
    sequences = Sequences(
        parent=np.empty(1024, np.int32),
        plane=np.empty(1024, np.int32),
        low=np.empty((1024, 3), np.float32),
        high=np.empty((1024, 3), np.float32),
        reach_m=np.empty(1024, np.float32),
        table=np.full(4096, -1, np.int32),
        size=0,
        rays=0,
    )
    for part in rays:
        sequences = _add_rays(sequences, part.face, part.leg_m, part.direction, planes.plane)
    return sequences


@njit(cache=True)
def _add_rays(sequences, face, leg, direction, plane_of):  # type: ignore[no-untyped-def]
    """Add the sequences of some rays to the tree."""
    parent, plane, low, high, reach, table, count, rays = sequences
    for i in range(face.shape[0]):
        room = count + face.shape[1]
        if room > len(parent):
            parent, plane, reach = grow(parent, room), grow(plane, room), grow(reach, room)
            low, high = grow(low, room), grow(high, room)
        if 2 * room > len(table):
            table = rehash(parent, plane, count, 2 * len(table))
        above, length = -1, leg[i, 0]
        for k in range(face.shape[1]):
            if face[i, k] < 0:
                break
            length += leg[i, k + 1]
            slot = find_sequence(table, parent, plane, above, plane_of[face[i, k]])
            node = table[slot]
            if node < 0:
                parent[count], plane[count], reach[count] = above, plane_of[face[i, k]], length
                low[count], high[count] = direction[i, k + 1], direction[i, k + 1]
                table[slot] = node = count
                count += 1
            reach[node] = max(reach[node], length)
            for axis in range(3):
                low[node, axis] = min(low[node, axis], direction[i, k + 1, axis])
                high[node, axis] = max(high[node, axis], direction[i, k + 1, axis])
            above = node
    return Sequences(parent, plane, low, high, reach, table, count, rays + len(face))


@njit(cache=True)
def find_sequence(table, parent, plane, node, last):  # type: ignore[no-untyped-def]
    """Slot in the hash table of the sequence that adds the plane `last` to the sequence `node`, or where it belongs."""
    mask = np.uint64(len(table) - 1)
    slot = mix(node + 1, last) & mask
    while table[slot] >= 0 and (parent[table[slot]] != node or plane[table[slot]] != last):
        slot = (slot + np.uint64(1)) & mask
    return slot


@njit(cache=True)
def rehash(parent, plane, count, size):  # type: ignore[no-untyped-def]
    """Hash table of a larger size."""
    table = np.full(size, -1, np.int32)
    for node in range(count):
        table[find_sequence(table, parent, plane, parent[node], plane[node])] = node
    return table


def view_sequences(
    sequences: Sequences, planes: MeshPlanes, tx_m: NDArray[np.float64], spacings: float = MARGIN
) -> Views:
    """Find the image, the margin, in spacings of the rays, and the order of all sequences."""
    parent, plane = sequences.parent[: sequences.size], sequences.plane[: sequences.size]
    margin = spacings * np.sqrt(4.0 * np.pi / max(1, sequences.rays))
    return Views(_depth_first(parent), *_images(parent, plane, planes, tx_m, margin))


@njit(cache=True)
def _images(parent, plane, planes, tx, margin):  # type: ignore[no-untyped-def]
    """Depth, image of the transmitter and margin of every sequence: a small plane bounds the directions."""
    depth, source, margins = np.empty(len(parent), np.int32), np.empty((len(parent), 3)), np.empty(len(parent))
    for node in range(len(parent)):
        p, above = plane[node], parent[node]
        depth[node] = 1 if above < 0 else depth[above] + 1
        source[node] = tx if above < 0 else source[above]
        margins[node] = margin if above < 0 else margins[above]
        away = -planes.offset_m[p]
        distance = 0.0
        for axis in range(3):
            away += planes.normal[p, axis] * source[node, axis]
            distance += (planes.centre_m[p, axis] - source[node, axis]) ** 2
        gap = np.sqrt(distance) - planes.radius_m[p]
        if gap > 0.0:
            margins[node] = min(margins[node], 2.0 * planes.radius_m[p] / gap)
        for axis in range(3):
            source[node, axis] -= 2.0 * away * planes.normal[p, axis]
    return depth, source, margins


@njit(cache=True)
def _depth_first(parent):  # type: ignore[no-untyped-def]
    """Order of the sequences in which those with the same first planes are together."""
    child, beside = np.full(len(parent) + 1, -1, np.int32), np.empty(len(parent), np.int32)
    for node in range(len(parent) - 1, -1, -1):
        beside[node], child[parent[node] + 1] = child[parent[node] + 1], node
    order, stack = np.empty(len(parent), np.int32), np.empty(len(parent) + 1, np.int32)
    stack[0], top, count = child[0], 1, 0
    while top > 0:
        node = stack[top - 1]
        if node < 0:
            top -= 1
            continue
        order[count] = node
        count += 1
        stack[top - 1] = beside[node]
        stack[top] = child[node + 1]
        top += 1
    return order
