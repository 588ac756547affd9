"""Sequences of planes that rays from a transmitter meet.

Between opaque faces, Mitsuba reflects many rays, far faster. Where faces let power through, fewer rays are followed
here; each splits at every face into a reflected and a transmitted ray, down to the power that matters. Both fill the
same tree.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit
from sionna_partial.scene.outlines import grow
from sionna_partial.tracing.line import is_as_deep
from sionna_partial.tracing.mesh.faces import MOST_FACES, MeshPlanes, Met, faces_between, mix
from sionna_partial.tracing.power import COSINES, Gains, gain_towards
from sionna_partial.tracing.select import Limits, NeedsByDistance, discount_after, matters
from sionna_partial.tracing.walls import SolidMesh, cosine_at, is_one_wall

SPLIT_RAYS = 20_000
"""Largest number of rays that are split at faces."""

_RAYS_PER_CHUNK = 250_000


class MeshLinks(NamedTuple):
    """The mesh, both ends of all paths, their limits, and the gains of the transmit antenna."""

    mesh: SolidMesh
    tx_m: Floats
    rx_m: Floats
    limits: Limits
    gains: Gains

    @classmethod
    def of(cls, mesh: SolidMesh, tx_m: Floats, rx_m: Floats, limits: Limits, gains: Gains) -> "MeshLinks":
        return cls(mesh, np.array(tx_m, np.float64), np.array(rx_m, np.float64, order="C"), limits, gains)


class Rays(NamedTuple):
    """R rays that were reflected up to D times.

    `face` (R, D) are the faces met, counted through the shapes, -1 after escape; `leg_m` (R, D + 1) the lengths, inf
    where nothing was met; `direction` (R, D + 1, 3) the unit directions.
    """

    face: NDArray[np.int32]
    leg_m: NDArray[np.float32]
    direction: NDArray[np.float32]


def shoot_rays(
    mi_scene: Any, shapes: Sequence[Any], tx_m: NDArray[np.float64], count: int, max_depth: int
) -> Iterator[Rays]:
    """Shoot `count` rays from a transmitter (3,) on Sionna RT's Fibonacci lattice, with up to `max_depth` reflections.

    `shapes` are all shapes of the scene in face order. Rays come part by part, always in the same order.
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
    import drjit as dr
    import mitsuba as mi

    pointers: Any = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)) for shape in shapes]
    numbers = [int(pointer.numpy()[0]) for pointer in pointers]
    table = np.zeros(max(numbers, default=0) + 1, np.uint32)
    table[numbers] = np.cumsum([0, *(shape.face_count() for shape in shapes)])[:-1]
    return mi.UInt32(table)


def lattice(number: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    turn = 2.0 * np.pi * np.modf(number / ((1.0 + np.sqrt(5.0)) / 2.0))[0]
    z = 1.0 - 2.0 * number / max(1, count - 1)
    across = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1).astype(np.float32)


def _launch(mi_scene: Any, first_face: Any, rays: Any, max_depth: int) -> list[tuple[Any, Any, Any]]:
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
    face = np.stack([leg[0].numpy() for leg in legs], axis=1)[:, :max_depth]
    leg_m = np.stack([leg[1].numpy() for leg in legs], axis=1)
    return Rays(face, leg_m, np.stack([leg[2].numpy().T for leg in legs], axis=1))


class Sequences(NamedTuple):
    """Sequences of planes that rays met, as a tree; the first `size` rows of the arrays are used.

    `parent` (M,) is the sequence without its last plane (-1 for none), `plane` (M,) that plane. Boxes `low`, `high` (M,
    3) hold the unit directions in which rays left it, `reach_m` (M,) is their longest unfolded length to the next face,
    `left` (M,) the largest fraction of power of split rays. `table` is a hash table, -1 where empty.
    """

    parent: NDArray[np.int32]
    plane: NDArray[np.int32]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    reach_m: NDArray[np.float32]
    left: Floats
    table: NDArray[np.int32]
    size: int
    rays: int


class Views(NamedTuple):
    """Views of M sequences, in which their receivers are.

    `order` has each sequence after its parent, followed by all its extensions; `depth` is the number of planes,
    `source_m` (M, 3) the image of the transmitter, `margin` enlarges the box of directions.
    """

    order: NDArray[np.int32]
    depth: NDArray[np.int32]
    source_m: NDArray[np.float64]
    margin: NDArray[np.float64]


def collect_sequences(rays: Iterable[Rays], planes: MeshPlanes) -> Sequences:
    sequences, size = _no_sequences(), 0
    for part in rays:
        added, depth = 0, part.face.shape[1]
        while added < len(part.face):
            if size + depth > len(sequences.parent):
                sequences = _with_room(sequences, size, depth)
            added, size = _add_rays(sequences, size, added, part.face, part.leg_m, part.direction, planes.plane)
        sequences = sequences._replace(size=size, rays=sequences.rays + added)
    return sequences


def _no_sequences() -> Sequences:
    number, box, length = np.empty(0, np.int32), np.empty((0, 3), np.float32), np.empty(0, np.float32)
    return Sequences(number, number, box, box, length, np.empty(0), number, 0, 0)


@njit(cache=True)
def _with_room(sequences, size, more):
    """Return `size` sequences with room for more: at first 1024, then doubled, as a hash table needs it."""
    parent, plane, low, high, reach, left, table, _, rays = sequences
    room = max(1024, size + more)
    parent, plane, reach, left = grow(parent, room), grow(plane, room), grow(reach, room), grow(left, room)
    low, high, table = grow(low, room), grow(high, room), np.full(2 * len(parent), -1, np.int32)
    reach[size:], left[size:], low[size:], high[size:] = 0.0, 0.0, 2.0, -2.0
    for node in range(size):
        table[_slot(table, parent, plane, parent[node], plane[node])] = node
    return Sequences(parent, plane, low, high, reach, left, table, size, rays)


@njit(cache=True, borrows=True)
def _add_rays(sequences, size, added, face, leg, direction, plane_of):
    parent, plane, low, high, reach, _, table, _, _ = sequences  # attributes cost time in a loop
    depth = face.shape[1]
    while added < len(face) and size + depth <= len(parent):
        node, length = -1, leg[added, 0]
        for k in range(depth):
            if face[added, k] < 0:
                break
            length += leg[added, k + 1]
            node = _next_sequence(table, parent, plane, size, node, plane_of[face[added, k]])
            size, reach[node] = max(size, node + 1), max(reach[node], length)
            _widen(low, high, node, direction[added, k + 1])
        added += 1
    return added, size


@njit(cache=True, borrows=True)
def _slot(table, parent, plane, node, last):
    mask = np.uint64(len(table) - 1)
    slot = mix(node + 1, last) & mask
    while table[slot] >= 0 and (parent[table[slot]] != node or plane[table[slot]] != last):
        slot = (slot + np.uint64(1)) & mask
    return slot


@njit(cache=True, borrows=True)
def _next_sequence(table, parent, plane, size, node, last):
    slot = _slot(table, parent, plane, node, last)
    if table[slot] < 0:
        table[slot], parent[size], plane[size] = size, node, last
    return np.int64(table[slot])


@njit(cache=True, borrows=True)
def _widen(low, high, node, direction):
    for axis in range(3):
        low[node, axis], high[node, axis] = (
            min(low[node, axis], direction[axis]),
            max(high[node, axis], direction[axis]),
        )


class _RayStack(NamedTuple):
    """Rays that have been split off.

    `value` (K, 8) are origin, direction, length and fraction of power left; `number` (K, 3) sequence, reflections,
    walls.
    """

    value: Floats
    number: NDArray[np.int64]
    end: Floats
    met: Met


def split_rays(links: MeshLinks, count: int, needed: NeedsByDistance) -> Sequences:
    """Make the tree of sequences met by rays that split at all faces, down to the power needed."""
    boxes = links.mesh.tree.boxes
    low, high = np.minimum(boxes.low_m[0], links.tx_m), np.maximum(boxes.high_m[0], links.tx_m)
    far = float(np.linalg.norm(high - low)) + 1.0
    directions, room = lattice(np.arange(count), count).astype(np.float64), MOST_FACES * (links.limits.reflections + 1)
    stack = _RayStack(np.empty((room, 8)), np.empty((room, 3), np.int64), np.empty(3), Met.empty())
    sequences, size = _split(_no_sequences(), directions, needed, links, far, stack)
    return sequences._replace(size=size, rays=count)  # type: ignore[no-any-return]


@njit(cache=True)
def _split(sequences, directions, needed, links, far, stack):
    """Add the sequences of rays in directions (R, 3), and count them; `far` is the size of the mesh."""
    size = sequences.size
    for direction in directions:
        stack.value[0, :3], stack.value[0, 3:6] = links.tx_m, direction
        gain = gain_towards(links.gains, direction[0], direction[1], direction[2])
        stack.value[0, 6], stack.value[0, 7] = 0.0, gain
        stack.number[0, 0], stack.number[0, 1], stack.number[0, 2] = -1, 0, 0
        top = 1
        while top > 0:
            if size + MOST_FACES > len(sequences.parent):
                sequences = _with_room(sequences, size, MOST_FACES)
            size, top = _go_on(sequences, size, stack, top - 1, needed, links, far)
    return sequences, size


@njit(cache=True)
def _go_on(sequences, size, stack, top, needed, links, far):
    """Follow one ray through all faces and stack the reflected rays; return the numbers of sequences and rays."""
    mesh, limits, met, end = links.mesh, links.limits, stack.met, stack.end
    a, d = stack.value[top, :3].copy(), stack.value[top, 3:6].copy()
    length, left = stack.value[top, 6], stack.value[top, 7]
    node, depth, crossed = stack.number[top, 0], stack.number[top, 1], stack.number[top, 2]
    for axis in range(3):
        end[axis] = a[axis] + far * d[axis]
    own = sequences.plane[node] if node >= 0 else -1
    discount, next_discount = discount_after(limits, depth), discount_after(limits, depth + 1)
    stop, start, steep = far, 0.0, 1.0
    for j in range(faces_between(mesh.tree, a, end, own, -1, met)):
        face, t = met.face[j], met.at[j]
        cosine, near = cosine_at(mesh.planes, face, d[0], d[1], d[2]), length + t * far
        steep = min(steep, cosine)
        same = j > 0 and is_as_deep((t - start) * far, steep, mesh.cells.depth_m)
        if same and is_one_wall(mesh, met.face[j - 1], face, a, end, met.at[j - 1], t):
            continue
        material = mesh.material[face]
        after = left * mesh.materials.most_reflected[material, int(cosine * COSINES)]
        if depth < limits.reflections and matters(after * next_discount, near, needed):
            child = _next_sequence(
                sequences.table, sequences.parent, sequences.plane, size, node, mesh.planes.plane[face]
            )
            size = max(size, child + 1)
            _reflect(a, d, t * far, mesh.planes, mesh.planes.plane[face], stack.value[top])
            _widen(sequences.low, sequences.high, child, stack.value[top, 3:6])
            sequences.left[child] = max(sequences.left[child], after)
            stack.value[top, 6], stack.value[top, 7] = near, after
            stack.number[top, 0], stack.number[top, 1], stack.number[top, 2] = child, depth + 1, crossed
            top += 1
        left *= mesh.materials.most_transmitted[material, int(cosine * COSINES)]
        crossed, start, steep = crossed + 1, t, cosine
        if crossed > limits.walls or not matters(left * discount, near, needed):
            stop = t * far
            break
    if node >= 0:
        sequences.reach_m[node] = max(sequences.reach_m[node], length + stop)
    return size, top


@njit(cache=True, borrows=True)
def _reflect(a, d, length, planes, p, ray):
    along = d[0] * planes.normal[p, 0] + d[1] * planes.normal[p, 1] + d[2] * planes.normal[p, 2]
    for axis in range(3):
        ray[axis] = a[axis] + length * d[axis]
        ray[3 + axis] = d[axis] - 2.0 * along * planes.normal[p, axis]


def view_sequences(sequences: Sequences, planes: MeshPlanes, tx_m: NDArray[np.float64], spacings: float) -> Views:
    parent, plane = sequences.parent[: sequences.size], sequences.plane[: sequences.size]
    margin = spacings * np.sqrt(4.0 * np.pi / max(1, sequences.rays))
    return Views(_depth_first(parent), *_images(parent, plane, planes, tx_m, margin))


@njit(cache=True)
def _images(parent, plane, planes, tx, margin):
    """Return depth, image and margin of every sequence: a small plane bounds the directions."""
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
def _depth_first(parent):
    """Return the order in which sequences with the same first planes are together."""
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
