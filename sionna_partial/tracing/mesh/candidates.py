"""Candidates of meshes: sequences of planes that rays have met, and the receivers that each can reach.

A specular path is a straight line from an image of the transmitter, reflected in the planes of its sequence. Rays
determine which sequences there are, and, seen from the image, in which directions their last leg goes and how far. A
receiver that lies there, or a little beside, is a candidate if the line to it, folded back, meets a face of each plane.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import grow
from sionna_partial.tracing.interactions import REFLECTION
from sionna_partial.tracing.mesh.faces import MeshPlanes, face_at
from sionna_partial.tracing.mesh.sequences import Rays, Sequences, Views, collect_sequences, view_sequences
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.power import ISOTROPIC, Gains, Materials, gain_towards, reflected_power
from sionna_partial.tracing.select import Listed

REACH, REACH_M = 1.1, 0.3
"""Factor and length [m] by which receivers may lie farther than the sequence's rays went."""

_LEAF = 8
"""Largest number of receivers in a box that is not divided further."""


class Boxes(NamedTuple):
    """N receivers in a tree of K boxes; box 0 holds all.

    Box k holds the part `start` to `stop` of the receivers in `order` (N,), and `child` is the first of the two boxes
    in it, or -1. `low_m`, `high_m` (K, 3) are the corners of the boxes.
    """

    order: NDArray[np.int64]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    child: NDArray[np.int64]
    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]


class View(NamedTuple):
    """The view of one sequence: image (3,), box of directions, width by which it is enlarged, and reach."""

    source: NDArray[np.float64]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    margin: float
    reach: float


class Images(NamedTuple):
    """Images of a transmitter: sequences of planes, their views, the planes, and the material of each face (F,)."""

    sequences: Sequences
    views: Views
    planes: MeshPlanes
    material: NDArray[np.int64]


class MeshCandidates:
    """All paths by the sequences of planes that rays have met, between a transmitter (3,) and receivers (N, 3).

    The faces of the mesh, in some planes, are each of one of the materials of the bounds (F,). `rays` come from
    `shoot_rays`, with the same transmitter and `max_depth`, and count the faces as here.
    """

    name = "reflections"

    def __init__(
        self,
        planes: MeshPlanes,
        material: NDArray[np.int64],
        rays: Iterable[Rays],
        tx_m: NDArray[np.float64],
        rx_m: NDArray[np.float64],
        max_depth: int,
        materials: Materials,
        gains: Gains = ISOTROPIC,
    ) -> None:
        sequences, self._size = collect_sequences(rays, planes), max(1, max_depth)
        views = view_sequences(sequences, planes, np.asarray(tx_m, np.float64))
        self._images = Images(sequences, views, planes, material)
        self._rx_m, self._materials = np.ascontiguousarray(rx_m, dtype=np.float64), materials
        self._antenna = np.array(tx_m, np.float64), gains

    def listed(self, found: Floats, *, receivers_per_part: int = 1_000_000) -> Iterator[Listed]:
        """List direct paths, then the candidates of sequence after sequence; none is negligible."""
        count, done, boxes = self._images.sequences.size, 0, divide(self._rx_m)
        every = np.arange(len(self._rx_m), dtype=np.int32)
        yield Listed(every, np.full(len(every), np.inf), partial(self._written, np.full(len(every), -1), every), 0.0)
        while done < count:
            node, rx, bound, done = _list_part(
                done, self._images, boxes, self._rx_m, self._size, self._materials, self._antenna, receivers_per_part
            )
            yield Listed(rx, bound, partial(self._written, node, rx), done / count)

    def _written(self, node: Indices, rx: NDArray[np.int32], rows: Indices) -> Candidates:
        face, points = _write_folded(node[rows], rx[rows], self._images, self._rx_m, self._size, self._materials)
        return Candidates(rx[rows], np.where(face < 0, 0, REFLECTION).astype(np.uint8), face, points)


@njit(cache=True)
def divide(points):  # type: ignore[no-untyped-def]
    """Divide receivers into boxes, each time at the median of the longest side."""
    size = 4 * (len(points) // _LEAF + 1)
    order = np.arange(len(points))
    start, stop, child = np.zeros(size, np.int64), np.zeros(size, np.int64), np.full(size, -1, np.int64)
    low, high = np.empty((size, 3)), np.empty((size, 3))
    stop[0], count, box = len(points), 1, 0
    while box < count:
        inside = points[order[start[box] : stop[box]]]
        for axis in range(3):
            low[box, axis], high[box, axis] = inside[:, axis].min(), inside[:, axis].max()
        if len(inside) > _LEAF:
            longest = np.argmax(high[box] - low[box])
            order[start[box] : stop[box]] = order[start[box] : stop[box]][
                np.argsort(inside[:, longest], kind="mergesort")
            ]
            middle = (start[box] + stop[box]) // 2
            start[count], stop[count], start[count + 1], stop[count + 1] = start[box], middle, middle, stop[box]
            child[box] = count
            count += 2
        box += 1
    return Boxes(order, start[:count], stop[:count], child[:count], low[:count], high[:count])


@njit(cache=True)
def _list_part(first, images, boxes, rx_m, depth, materials, antenna, most):  # type: ignore[no-untyped-def]
    """List the candidates from sequence `first` in the order on: sequence, receiver, bound (C,); where to go on.

    A part ends once the sequences in it have been in view of `most` receivers in sum.
    """
    (sequences, views, planes, _), (tx_m, gains) = images, antenna
    out_node, out_rx, bound, count = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024), 0
    face, points = np.empty(depth, np.int32), np.empty((depth, 3))
    seen, stack, box = np.empty(len(rx_m), np.int64), np.empty(128, np.int64), np.empty((5, 3))
    in_view, done = 0, first
    while done < len(views.order) and in_view < most:
        node = views.order[done]
        done += 1
        reach = REACH * sequences.reach_m[node] + REACH_M
        view = View(views.source_m[node], sequences.low[node], sequences.high[node], views.margin[node], reach)
        bound_view(view, farthest(view.source, boxes), planes, sequences.plane[node], box)
        number = receivers_in_view(view, boxes, rx_m, box, stack, seen)
        in_view += number
        for rx in seen[:number]:
            power = fold_line(node, rx_m[rx], images, materials, face, points)
            if power < 0.0:
                continue
            out_node, out_rx, bound = grow(out_node, count + 1), grow(out_rx, count + 1), grow(bound, count + 1)
            gain = gain_towards(gains, points[0, 0] - tx_m[0], points[0, 1] - tx_m[1], points[0, 2] - tx_m[2])
            out_node[count], out_rx[count], bound[count] = node, rx, power * gain
            count += 1
    return out_node[:count].copy(), out_rx[:count].copy(), bound[:count].copy(), done


@njit(cache=True)
def _write_folded(nodes, rx, images, rx_m, depth, materials):  # type: ignore[no-untyped-def]
    """Write faces (C, D) and points (C, D, 3) of candidates; the sequence -1 is the direct path."""
    face, points = np.full((len(nodes), depth), -1, np.int32), np.zeros((len(nodes), depth, 3))
    for c in range(len(nodes)):
        if nodes[c] >= 0:
            fold_line(nodes[c], rx_m[rx[c]], images, materials, face[c], points[c])
    return face, points


@njit(cache=True)
def receivers_in_view(view, boxes, rx, bounds, stack, found):  # type: ignore[no-untyped-def]
    """Write the receivers in view of a sequence's image to `found` and count them."""
    source, low, high, margin, reach = view
    count, stack[0], top = 0, 0, 1
    while top > 0:
        top -= 1
        box = stack[top]
        if _apart(boxes.low_m[box], boxes.high_m[box], bounds):
            continue
        if boxes.child[box] >= 0:
            stack[top], stack[top + 1] = boxes.child[box] + 1, boxes.child[box]
            top += 2
            continue
        for k in boxes.order[boxes.start[box] : boxes.stop[box]]:
            x, y, z = rx[k, 0] - source[0], rx[k, 1] - source[1], rx[k, 2] - source[2]
            length = np.sqrt(x * x + y * y + z * z)
            m = margin * length
            if (
                length <= reach
                and low[0] * length - m <= x <= high[0] * length + m
                and low[1] * length - m <= y <= high[1] * length + m
                and low[2] * length - m <= z <= high[2] * length + m
            ):
                found[count] = k
                count += 1
    return count


@njit(cache=True)
def farthest(source, boxes):  # type: ignore[no-untyped-def]
    """Distance that no receiver exceeds."""
    total = 0.0
    for axis in range(3):
        total += max(source[axis] - boxes.low_m[0, axis], boxes.high_m[0, axis] - source[axis]) ** 2
    return np.sqrt(total) + 1e-3


@njit(cache=True)
def bound_view(view, farthest, planes, p, bounds):  # type: ignore[no-untyped-def]
    """Write what bounds the points in view of an image and beyond its last plane, no receiver being farther away.

    Rows 0 and 1 are the corners of a box around them; 2 is the image, 3 the middle of the box of directions, and 4 has
    the largest distance of a direction from the middle, and the middle's square. A point in view at a distance r from
    the image lies within r times that distance of r times the middle.
    """
    source, low, high, margin, reach = view
    reach = min(reach, farthest)
    width, away, slope = 0.0, -planes.offset_m[p], 0.0
    for axis in range(3):
        width += (0.5 * (high[axis] - low[axis]) + margin) ** 2
        away += planes.normal[p, axis] * source[axis]
        slope += planes.normal[p, axis] * 0.5 * (low[axis] + high[axis])
    width = np.sqrt(width)
    near = min(abs(away) / min(1.0, abs(slope) + width), reach)
    for axis in range(3):
        middle, pad = 0.5 * (low[axis] + high[axis]), 0.5 * (high[axis] - low[axis]) + margin
        ends = near * (middle - pad), near * (middle + pad), reach * (middle - pad), reach * (middle + pad)
        bounds[0, axis] = source[axis] + min(ends) - 1e-6
        bounds[1, axis] = source[axis] + max(ends) + 1e-6
        bounds[2, axis], bounds[3, axis] = source[axis], middle
    bounds[4, 0], bounds[4, 1] = width, bounds[3, 0] ** 2 + bounds[3, 1] ** 2 + bounds[3, 2] ** 2


@njit(cache=True)
def _apart(low, high, bounds):  # type: ignore[no-untyped-def]
    """Return whether no point of a box is in view."""
    for axis in range(3):
        if low[axis] > bounds[1, axis] or high[axis] < bounds[0, axis]:
            return True
    along, distance, radius = 0.0, 0.0, 0.0
    for axis in range(3):
        away = 0.5 * (low[axis] + high[axis]) - bounds[2, axis]
        along += away * bounds[3, axis]
        distance += away**2
        radius += (high[axis] - low[axis]) ** 2
    radius = 0.5 * np.sqrt(radius) + 1e-6
    beside = distance - along**2 / max(1e-12, bounds[4, 1])
    return beside > (radius + (np.sqrt(distance) + radius) * bounds[4, 0]) ** 2


@njit(cache=True)
def fold_line(node, target, images, materials, face, points):  # type: ignore[no-untyped-def]
    """Write the faces and points at which the line from a sequence's image to a receiver is reflected.

    Returns a bound on the power of the path, or -1 where the line, folded back, misses a plane of the sequence.
    """
    (sequences, views, planes, material), largest, wavelength = images, materials.largest, materials.wavelength_m
    parent, plane, sources, depth = sequences.parent, sequences.plane, views.source_m, views.depth[node]
    normals, offsets, bins = planes.normal, planes.offset_m, planes.bins
    x, y, z = target[0], target[1], target[2]
    at, power = node, 1.0
    for k in range(depth - 1, -1, -1):
        p = plane[at]
        nx, ny, nz, offset = normals[p, 0], normals[p, 1], normals[p, 2], offsets[p]
        sx, sy, sz = sources[at, 0], sources[at, 1], sources[at, 2]
        behind, before = nx * sx + ny * sy + nz * sz - offset, nx * x + ny * y + nz * z - offset
        if behind * before >= 0.0:  # also where an image coincides with the receiver, at a length of 0
            return -1.0
        length = np.sqrt((x - sx) ** 2 + (y - sy) ** 2 + (z - sz) ** 2)
        if k == depth - 1:
            power = (wavelength / (4.0 * np.pi * length)) ** 2
        fraction = behind / (behind - before)
        x, y, z = sx + fraction * (x - sx), sy + fraction * (y - sy), sz + fraction * (z - sz)
        points[k, 0], points[k, 1], points[k, 2] = x, y, z
        face[k] = face_at(bins, p, x, y, z)
        if face[k] < 0:
            return -1.0
        power *= reflected_power(largest[material[face[k]]], (behind - before) / length)
        at = parent[at]
    return power
