"""Rays that split at every face, one that is reflected and one that goes on, and the sequences of their reflections."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import grow
from sionna_partial.tracing.mesh.faces import MOST_FACES, Met, faces_between, scratch
from sionna_partial.tracing.mesh.sequences import Sequences, find_sequence, rehash
from sionna_partial.tracing.mesh.walls import SolidMesh, cosine_at, is_one_wall
from sionna_partial.tracing.plan.crossing_beams import Limits, matters, rarer_by
from sionna_partial.tracing.plan.slabs import COSINES


class Least(NamedTuple):
    """What a ray must bring to matter, from receivers (N,) sorted by their distance from the transmitter.

    `relative` is the smallest power that matters, relative to free space, to any receiver at least that far away,
    `near` the smallest to any at most that far away, times (4 pi / wavelength)^2.
    """

    distance_m: Floats
    relative: Floats
    near: Floats


class Fixed(NamedTuple):
    """What all paths of a call have in common; `largest` is that of `Strengths`."""

    mesh: SolidMesh
    tx_m: Floats
    rx_m: Floats
    limits: Limits
    largest: Floats
    wavelength_m: float


class _Waiting(NamedTuple):
    """Rays that have been split off: origin, direction, length and loss (K, 8); sequence, reflections, walls (K, 3)."""

    value: Floats
    number: NDArray[np.int64]
    end: Floats
    met: Met


def least_needed(tx_m: Floats, rx_m: Floats, needed: Floats, wavelength_m: float) -> Least:
    """Sort what matters to receivers (N, 3) by their distance."""
    distance_m = np.linalg.norm(rx_m - tx_m, axis=1)
    order = np.argsort(distance_m, kind="stable")
    distance_m, needed = distance_m[order], needed[order] * (4.0 * np.pi / wavelength_m) ** 2
    relative = np.minimum.accumulate((needed * np.maximum(distance_m, 1e-3) ** 2)[::-1])[::-1].copy()
    return Least(distance_m, relative, np.minimum.accumulate(needed))


@njit(cache=True)
def split_rays(sequences, loss, directions, least, fixed, far):  # type: ignore[no-untyped-def]
    """Add the sequences of rays in some directions (R, 3), and the largest fraction of power that each leaves.

    No line within the mesh is longer than `far`.
    """
    room = MOST_FACES * (fixed.limits.reflections + 1)
    waiting = _Waiting(np.empty((room, 8)), np.empty((room, 3), np.int64), np.empty(3), scratch())
    for i in range(len(directions)):
        for axis in range(3):
            waiting.value[0, axis], waiting.value[0, 3 + axis] = fixed.tx_m[axis], directions[i, axis]
        waiting.value[0, 6], waiting.value[0, 7] = 0.0, 1.0
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
    rare = rarer_by(limits, depth)
    rarer = rarer_by(limits, depth + 1)
    stop, start, steep = far, 0.0, 1.0
    for j in range(faces_between(mesh.tree, a, end, own, -1, met)):
        face, t = met.face[j], met.at[j]
        cosine, near = cosine_at(mesh.planes, face, d[0], d[1], d[2]), length + t * far
        steep = min(steep, cosine)
        same = j > 0 and (t - start) * far * steep <= mesh.cells.depth_m
        if same and is_one_wall(mesh, met.face[j - 1], face, a, end, met.at[j - 1], t):
            continue
        material = mesh.slabs.material[face]
        after = left * mesh.slabs.most_reflected[material, int(cosine * COSINES)]
        if depth < limits.reflections and matters(after * rarer, near, least):
            sequences, loss, child = _add_sequence(sequences, loss, node, mesh.planes.plane[face])
            _reflect(sequences, child, a, d, t * far, mesh.planes, waiting.value[top])
            loss[child] = max(loss[child], after)
            waiting.value[top, 6], waiting.value[top, 7] = near, after
            waiting.number[top, 0], waiting.number[top, 1], waiting.number[top, 2] = child, depth + 1, crossed
            top += 1
        left *= mesh.slabs.most_transmitted[material, int(cosine * COSINES)]
        crossed, start, steep = crossed + 1, t, cosine
        if crossed > limits.walls or not matters(left * rare, near, least):
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
