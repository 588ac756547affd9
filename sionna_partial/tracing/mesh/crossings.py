"""Candidates of meshes that go through walls: sequences of planes that rays meet behind walls, and all legs cast.

At every face a ray splits into one that is reflected and one that goes on. The sequences of their reflections list
candidates as in opaque meshes, without regard to faces between them. Then every leg is cast through the mesh,
the faces on it are grouped to walls, and the power of the path follows.
"""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.floor_plan import grow
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.interactions import REFLECTION
from sionna_partial.tracing.mesh.candidates import (
    REACH,
    REACH_M,
    Images,
    View,
    bound_view,
    divide,
    farthest,
    fold_line,
    receivers_in_view,
)
from sionna_partial.tracing.mesh.faces import MOST_FACES, Met, faces_between, scratch
from sionna_partial.tracing.mesh.sequences import (
    Sequences,
    Views,
    collect_sequences,
    find_sequence,
    lattice,
    rehash,
    view_sequences,
)
from sionna_partial.tracing.paths import SHORTEST_LEG_M, Candidates
from sionna_partial.tracing.power import (
    COSINES,
    ISOTROPIC,
    Gains,
    at_slab,
    gain_towards,
    received_power,
    vertical_field,
)
from sionna_partial.tracing.select import Limits, Listed, discount_after, matters, needs_by_distance
from sionna_partial.tracing.walls import SolidMesh, cosine_at, is_inside, is_one_wall, mark_walls, met_faces

_RAYS = 20_000
"""Number of rays that are split at faces; fewer where fewer are asked for."""

_MARGIN = 4.0
"""Distance in direction from a sequence's rays up to which its receivers are looked for, in spacings of the rays."""

_PART = 0.5
"""Part of the weakest power that matters down to which sequences are followed, as rays are only samples of them."""

_AT_ONCE = 20_000
"""Number of candidates that are written together, which bounds the memory."""

_SEQUENCES_AT_ONCE = 500
"""Number of sequences whose paths are cast by one thread at a time."""

_ENTRIES = 160
"""Most faces that a path may meet."""


class CrossingInput(NamedTuple):
    """The mesh, both ends of all paths of a call, their limits, and the gains of the transmit antenna."""

    mesh: SolidMesh
    tx_m: Floats
    rx_m: Floats
    limits: Limits
    gains: Gains


class _RayStack(NamedTuple):
    """Rays that have been split off: origin, direction, length and loss (K, 8); sequence, reflections, walls (K, 3)."""

    value: Floats
    number: NDArray[np.int64]
    end: Floats
    met: Met


@njit(cache=True)
def split_rays(sequences, loss, directions, least, fixed, far):  # type: ignore[no-untyped-def]
    """Add the sequences of rays in some directions (R, 3), and the largest fraction of power that each leaves.

    No line within the mesh is longer than `far`.
    """
    room = MOST_FACES * (fixed.limits.reflections + 1)
    waiting = _RayStack(np.empty((room, 8)), np.empty((room, 3), np.int64), np.empty(3), scratch())
    for i in range(len(directions)):
        for axis in range(3):
            waiting.value[0, axis], waiting.value[0, 3 + axis] = fixed.tx_m[axis], directions[i, axis]
        gain = gain_towards(fixed.gains, directions[i, 0], directions[i, 1], directions[i, 2])
        waiting.value[0, 6], waiting.value[0, 7] = 0.0, gain
        waiting.number[0, 0], waiting.number[0, 1], waiting.number[0, 2] = -1, 0, 0
        top = 1
        while top > 0:
            sequences, loss, top = _go_on(sequences, loss, waiting, top - 1, least, fixed, far)
    parent, plane, low, high, reach, table, count, rays = sequences
    return Sequences(parent, plane, low, high, reach, table, count, rays + len(directions)), loss


@njit(cache=True)
def _go_on(sequences, loss, waiting, top, least, fixed, far):  # type: ignore[no-untyped-def]
    """Follow one ray through all faces, put the reflected ones in its place, and return their number."""
    mesh, limits, met, end = fixed.mesh, fixed.limits, waiting.met, waiting.end
    a, d = waiting.value[top, :3].copy(), waiting.value[top, 3:6].copy()
    length, left = waiting.value[top, 6], waiting.value[top, 7]
    node, depth, crossed = waiting.number[top, 0], waiting.number[top, 1], waiting.number[top, 2]
    for axis in range(3):
        end[axis] = a[axis] + far * d[axis]
    own = sequences.plane[node] if node >= 0 else -1
    discount, next_discount = discount_after(limits, depth), discount_after(limits, depth + 1)
    stop, start, steep = far, 0.0, 1.0
    for j in range(faces_between(mesh.tree, a, end, own, -1, met)):
        face, t = met.face[j], met.at[j]
        cosine, near = cosine_at(mesh.planes, face, d[0], d[1], d[2]), length + t * far
        steep = min(steep, cosine)
        same = j > 0 and (t - start) * far * steep <= mesh.cells.depth_m
        if same and is_one_wall(mesh, met.face[j - 1], face, a, end, met.at[j - 1], t):
            continue
        material = mesh.material[face]
        after = left * mesh.materials.most_reflected[material, int(cosine * COSINES)]
        if depth < limits.reflections and matters(after * next_discount, near, least):
            sequences, loss, child = _add_sequence(sequences, loss, node, mesh.planes.plane[face])
            _reflect(sequences, child, a, d, t * far, mesh.planes, waiting.value[top])
            loss[child] = max(loss[child], after)
            waiting.value[top, 6], waiting.value[top, 7] = near, after
            waiting.number[top, 0], waiting.number[top, 1], waiting.number[top, 2] = child, depth + 1, crossed
            top += 1
        left *= mesh.materials.most_transmitted[material, int(cosine * COSINES)]
        crossed, start, steep = crossed + 1, t, cosine
        if crossed > limits.walls or not matters(left * discount, near, least):
            stop = t * far
            break
    if node >= 0:
        sequences.reach_m[node] = max(sequences.reach_m[node], length + stop)
    return sequences, loss, top


@njit(cache=True)
def _add_sequence(sequences, loss, node, p):  # type: ignore[no-untyped-def]
    """Find the sequence that adds a plane to another, or make it; the sequences, their losses, and its number."""
    parent, plane, low, high, reach, table, count, rays = sequences
    slot = find_sequence(table, parent, plane, node, p)
    if table[slot] >= 0:
        return sequences, loss, np.int64(table[slot])
    parent, plane, reach = grow(parent, count + 1), grow(plane, count + 1), grow(reach, count + 1)
    low, high, loss = grow(low, count + 1), grow(high, count + 1), grow(loss, count + 1)
    parent[count], plane[count], reach[count], loss[count] = node, p, 0.0, 0.0
    low[count], high[count], table[slot] = 1.0, -1.0, count
    if 2 * (count + 1) > len(table):
        table = rehash(parent, plane, count + 1, 2 * len(table))
    return Sequences(parent, plane, low, high, reach, table, count + 1, rays), loss, np.int64(count)


@njit(cache=True)
def _reflect(sequences, child, a, d, length, planes, ray):  # type: ignore[no-untyped-def]
    """Write origin and direction of a ray that is reflected after a length, and enlarge the box of its sequence."""
    p = sequences.plane[child]
    along = d[0] * planes.normal[p, 0] + d[1] * planes.normal[p, 1] + d[2] * planes.normal[p, 2]
    for axis in range(3):
        ray[axis] = a[axis] + length * d[axis]
        ray[3 + axis] = d[axis] - 2.0 * along * planes.normal[p, axis]
        sequences.low[child, axis] = min(sequences.low[child, axis], ray[3 + axis])
        sequences.high[child, axis] = max(sequences.high[child, axis], ray[3 + axis])


class Traced(NamedTuple):
    """Sequences of planes that rays met, where their receivers are, and the fraction of power (M,) that is left."""

    sequences: Sequences
    views: Views
    loss: Floats


class Pairs(NamedTuple):
    """Paths: the sequence of each (K,), -1 for a straight line, its receiver and its power."""

    node: NDArray[np.int64]
    rx: NDArray[np.int64]
    power: Floats


class MeshCrossings:
    """Paths between a transmitter (3,) and receivers (N, 3) that go through walls of a mesh, without diffraction."""

    name = "paths through walls"

    def __init__(
        self,
        mesh: SolidMesh,
        tx_m: Floats,
        rx_m: Floats,
        settings: TraceSettings,
        gains: Gains = ISOTROPIC,
    ) -> None:
        self._rays = min(_RAYS, settings.samples_per_tx)
        limits = Limits.of(settings, settings.max_walls, directed=len(gains.table) > 1)
        ends = np.array(tx_m, np.float64), np.array(rx_m, np.float64)
        self._fixed = CrossingInput(mesh, *ends, limits, gains)

    def listed(self, found: Floats) -> Iterator[Listed]:
        """List the paths that links may need whose indirect paths without walls have the power `found` (N,)."""
        nothing = self._traced(None)
        straight = _straight(nothing, self._fixed)
        needed = self._fixed.limits.min_power(found + straight.power)
        traced = self._traced(needed) if self._fixed.limits.reflections else nothing
        boxes = divide(self._fixed.rx_m)

        def of_sequences(start: int) -> Pairs:
            nodes = traced.views.order[start : start + _SEQUENCES_AT_ONCE]
            return _pairs(nodes, traced, boxes, needed, self._fixed)  # type: ignore[no-any-return]

        starts = range(0, len(traced.views.order), _SEQUENCES_AT_ONCE)
        parts = [straight, *in_order(of_sequences, starts)]
        node, rx, power = (np.concatenate(column) for column in zip(*parts, strict=True))
        yield Listed(rx, power, partial(self._written, traced, node, rx), 1.0, at_once=_AT_ONCE)

    def _written(self, traced: Traced, node: Indices, rx: Indices, rows: Indices) -> Candidates:
        face, kind, vertices_m, same_wall = _written(node[rows], rx[rows], traced, self._fixed)
        used = max(1, int((kind > 0).sum(axis=1).max()))
        columns = kind[:, :used], face[:, :used], vertices_m[:, :used]
        return Candidates(rx[rows].astype(np.int32), *columns, same_wall=same_wall[:, :used])

    def _traced(self, needed: Floats | None) -> Traced:
        """Split rays at all faces; without `needed`, there are none."""
        fixed = self._fixed
        sequences, loss = collect_sequences([], fixed.mesh.planes), np.empty(1024)
        if needed is not None and len(needed) and len(fixed.mesh.tree.order):
            direction = lattice(np.arange(self._rays), self._rays).astype(np.float64)
            least = needs_by_distance(fixed.tx_m, fixed.rx_m, _PART * needed, fixed.mesh.materials.wavelength_m)
            sequences, loss = split_rays(sequences, loss, direction, least, fixed, _spread_m(fixed))
        return Traced(sequences, view_sequences(sequences, fixed.mesh.planes, fixed.tx_m, _MARGIN), loss)


def _spread_m(fixed: CrossingInput) -> float:
    """Length that no line within the mesh exceeds."""
    tree = fixed.mesh.tree
    low, high = np.minimum(tree.low_m[0], fixed.tx_m), np.maximum(tree.high_m[0], fixed.tx_m)
    return float(np.linalg.norm(high - low)) + 1.0


@njit(cache=True)
def _follow(node, target, traced, fixed, met, entries, faces, points):  # type: ignore[no-untyped-def]
    """Write the faces that a path meets; return their number, -1 if no path through walls can matter."""
    mesh, limits = fixed.mesh, fixed.limits
    reflections, count, crossed = 0 if node < 0 else traced.views.depth[node], 0, 0
    a, own = fixed.tx_m, np.int64(-1)
    for k in range(reflections + 1):
        b, other = target, np.int64(-1)
        if k < reflections:
            b, other = points[k], np.int64(mesh.planes.plane[faces[k]])
        number = faces_between(mesh.tree, a, b, own, other, met)
        if number == MOST_FACES or count + number + 1 > len(entries.face):
            return -1
        crossed += mark_walls(mesh, a, b, number, met, entries, count)
        inside = number > 0 and (
            (k > 0 and is_inside(mesh, faces[k - 1], met.face[0], a, b, 0.0, met.at[0]))
            or (k < reflections and is_inside(mesh, met.face[number - 1], faces[k], a, b, met.at[number - 1], 1.0))
        )
        if inside or crossed > limits.walls:
            return -1
        count += number
        if k < reflections:
            entries.face[count], entries.kind[count], entries.same_wall[count] = faces[k], REFLECTION, False
            entries.point_m[count] = b
            count += 1
        a, own = b, other
    return count if crossed > 0 and _has_long_legs(entries, count, fixed.tx_m, target) else -1


@njit(cache=True)
def _has_long_legs(entries, count, tx, target):  # type: ignore[no-untyped-def]
    """Return whether no leg of a path is so short that Sionna RT drops it."""
    for k in range(count + 1):
        square = 0.0
        for axis in range(3):
            before = entries.point_m[k - 1, axis] if k > 0 else tx[axis]
            after = entries.point_m[k, axis] if k < count else target[axis]
            square += (after - before) ** 2
        if square < SHORTEST_LEG_M**2:
            return False
    return True


@njit(cache=True)
def _gain_to(point, fixed):  # type: ignore[no-untyped-def]
    """Gain of the transmit antenna towards a point."""
    return gain_towards(fixed.gains, point[0] - fixed.tx_m[0], point[1] - fixed.tx_m[1], point[2] - fixed.tx_m[2])


@njit(cache=True)
def _power(entries, count, target, fixed):  # type: ignore[no-untyped-def]
    """Power of a path between vertical antennas."""
    planes, materials, tx = fixed.mesh.planes, fixed.mesh.materials, fixed.tx_m
    first = entries.point_m[0] if count else target
    kx, ky, kz = first[0] - tx[0], first[1] - tx[1], first[2] - tx[2]
    total = np.sqrt(kx * kx + ky * ky + kz * kz)
    k = kx / total, ky / total, kz / total
    e, gain = vertical_field(k), _gain_to(first, fixed)
    for j in range(count):
        here, after = entries.point_m[j], entries.point_m[j + 1] if j + 1 < count else target
        total += np.sqrt((after[0] - here[0]) ** 2 + (after[1] - here[1]) ** 2 + (after[2] - here[2]) ** 2)
        if not entries.same_wall[j]:
            face = entries.face[j]
            p = planes.plane[face]
            normal = planes.normal[p, 0], planes.normal[p, 1], planes.normal[p, 2]
            k, e = at_slab(k, e, normal, materials, fixed.mesh.material[face], entries.kind[j])
    return (fixed.mesh.materials.wavelength_m / (4.0 * np.pi * total)) ** 2 * received_power(k, e) * gain


@njit(cache=True, nogil=True)
def _straight(traced, fixed):  # type: ignore[no-untyped-def]
    """Straight lines to all receivers, of power 0 where no wall is on them, or too many."""
    count = len(fixed.rx_m)
    met, entries, power = scratch(), met_faces(_ENTRIES), np.zeros(count)
    faces, points = np.empty(0, np.int32), np.empty((0, 3))
    for rx in range(count):
        number = _follow(-1, fixed.rx_m[rx], traced, fixed, met, entries, faces, points)
        if number >= 0:
            power[rx] = _power(entries, number, fixed.rx_m[rx], fixed)
    return Pairs(np.full(count, -1), np.arange(count), power)


@njit(cache=True, nogil=True)
def _pairs(nodes, traced, boxes, needed, fixed):  # type: ignore[no-untyped-def]
    """Paths through walls by some sequences that matter to receivers in their view."""
    sequences, views, mesh = traced.sequences, traced.views, fixed.mesh
    images = Images(sequences, views, mesh.planes, mesh.material)
    met, entries, count = scratch(), met_faces(_ENTRIES), 0
    all_node, all_rx, all_power = np.empty(1024, np.int64), np.empty(1024, np.int64), np.empty(1024)
    faces, points = np.empty(fixed.limits.depth, np.int32), np.empty((fixed.limits.depth, 3))
    seen, stack, bounds = np.empty(len(fixed.rx_m), np.int64), np.empty(128, np.int64), np.empty((5, 3))
    for node in nodes:
        discount = discount_after(fixed.limits, views.depth[node])
        reach = REACH * sequences.reach_m[node] + REACH_M
        source = views.source_m[node]
        view = View(source, sequences.low[node], sequences.high[node], views.margin[node], reach)
        bound_view(view, farthest(source, boxes), mesh.planes, sequences.plane[node], bounds)
        for k in range(receivers_in_view(view, boxes, fixed.rx_m, bounds, stack, seen)):
            target = fixed.rx_m[seen[k]]
            square = (target[0] - source[0]) ** 2 + (target[1] - source[1]) ** 2 + (target[2] - source[2]) ** 2
            least = needed[seen[k]] / discount
            if traced.loss[node] * (fixed.mesh.materials.wavelength_m / (4.0 * np.pi)) ** 2 < _PART * least * square:
                continue
            bound = fold_line(node, target, images, fixed.mesh.materials, faces, points)
            if bound < 0.0 or bound * _gain_to(points[0], fixed) < least:
                continue
            number = _follow(node, target, traced, fixed, met, entries, faces, points)
            if number < 0:
                continue
            power = _power(entries, number, target, fixed)
            if power >= least:
                all_node, all_rx = grow(all_node, count + 1), grow(all_rx, count + 1)
                all_power = grow(all_power, count + 1)
                all_node[count], all_rx[count], all_power[count] = node, seen[k], power
                count += 1
    return Pairs(all_node[:count].copy(), all_rx[:count].copy(), all_power[:count].copy())


@njit(cache=True, nogil=True)
def _written(nodes, rx, traced, fixed):  # type: ignore[no-untyped-def]
    """Faces and kinds (C, D) of chosen paths, vertices (C, D, 3), and whether each is of a wall that is crossed."""
    images = Images(traced.sequences, traced.views, fixed.mesh.planes, fixed.mesh.material)
    met, entries, shape = scratch(), met_faces(_ENTRIES), (len(nodes), _ENTRIES)
    face, kind, same_wall = np.full(shape, -1, np.int32), np.zeros(shape, np.uint8), np.zeros(shape, np.bool_)
    vertices = np.zeros((len(nodes), _ENTRIES, 3))
    faces, points = np.empty(fixed.limits.depth, np.int32), np.empty((fixed.limits.depth, 3))
    for c in range(len(nodes)):
        target = fixed.rx_m[rx[c]]
        if nodes[c] >= 0:
            fold_line(nodes[c], target, images, fixed.mesh.materials, faces, points)
        number = _follow(nodes[c], target, traced, fixed, met, entries, faces, points)
        face[c, :number], kind[c, :number] = entries.face[:number], entries.kind[:number]
        vertices[c, :number], same_wall[c, :number] = entries.point_m[:number], entries.same_wall[:number]
    return face, kind, vertices, same_wall
