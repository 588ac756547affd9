"""Candidates of meshes: sequences of planes that rays have met, and the receivers that each can reach.

A specular path is a straight line from an image of the transmitter, reflected in the planes of its sequence. Rays
determine which sequences there are, and, seen from the image, in which directions their last leg goes and how far. A
receiver that lies there, or a little beside, is a candidate if the line to it, folded back, meets a face of each plane.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import grow
from sionna_partial.tracing.bounds import LEVELS, Strengths, level_of, reflected_power
from sionna_partial.tracing.interactions import REFLECTION
from sionna_partial.tracing.mesh.faces import MeshPlanes, face_at
from sionna_partial.tracing.mesh.sequences import Rays, Sequences, Views, collect_sequences, view_sequences
from sionna_partial.tracing.paths import Candidates

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
    """Where receivers of one sequence are: image (3,), box of directions, width by which it is enlarged, and reach."""

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


class _Found(NamedTuple):
    """Columns of candidates, as in `Candidates`."""

    rx: NDArray[np.int32]
    face: NDArray[np.int32]
    points: NDArray[np.float64]


class MeshCandidates:
    """All paths by the sequences of planes that rays have met, between a transmitter (3,) and receivers (N, 3).

    The faces of the mesh, in some planes, are each of one of the materials of the bounds (F,). `rays` come from
    `shoot_rays`, with the same transmitter and `max_depth`, and count the faces likewise.
    """

    def __init__(
        self,
        planes: MeshPlanes,
        material: NDArray[np.int64],
        rays: Iterable[Rays],
        tx_m: NDArray[np.float64],
        rx_m: NDArray[np.float64],
        max_depth: int,
    ) -> None:
        sequences, self._size = collect_sequences(rays, planes), max(1, max_depth)
        views = view_sequences(sequences, planes, np.asarray(tx_m, np.float64))
        self._images = Images(sequences, views, planes, material)
        self._rx_m = np.ascontiguousarray(rx_m, dtype=np.float64)
        self._boxes = divide(self._rx_m)
        self._best = np.zeros(sequences.size, np.uint8)  # level of the strongest candidate of each sequence

    def blocks(
        self, strengths: Strengths, *, receivers_per_block: int = 1_000_000
    ) -> Iterator[tuple[Candidates, float]]:
        """Yield the candidates that are asked for, and the fraction of the work done; add up the bounds of all.

        Direct paths come first, then sequence after sequence.
        """
        direct = np.flatnonzero((strengths.first == 0) & (strengths.last > 0)).astype(np.int32)
        face, points = np.full((len(direct), self._size), -1, np.int32), np.zeros((len(direct), self._size, 3))
        yield Candidates(direct, np.zeros(face.shape, np.uint8), face, points), 0.0
        count, done = len(self._best), 0
        while done < count:
            rx, face, points, done = _next_block(
                done,
                self._images,
                self._boxes,
                self._rx_m,
                self._size,
                strengths,
                self._best,
                receivers_per_block,
            )
            kind = np.where(face < 0, 0, REFLECTION).astype(np.uint8)
            yield Candidates(rx, kind, face, points), done / count


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
def _next_block(first, images, boxes, rx_m, depth, strengths, best, block):  # type: ignore[no-untyped-def]
    """Candidates of the sequences from number `first` in the order on, and where to go on.

    A block ends once the sequences in it have been in view of `block` receivers in sum.
    """
    sequences, views, planes, _ = images
    out = _Found(np.empty(1024, np.int32), np.empty((1024, depth), np.int32), np.empty((1024, depth, 3)))
    seen, stack, bounds = np.empty(len(rx_m), np.int64), np.empty(128, np.int64), np.empty((5, 3))
    count, in_view, done, weakest = 0, 0, first, strengths.last.max()
    while done < len(views.order) and in_view < block:
        node = views.order[done]
        done += 1
        if best[node] >= weakest:
            continue
        best[node] = LEVELS
        reach = REACH * sequences.reach_m[node] + REACH_M
        view = View(views.source_m[node], sequences.low[node], sequences.high[node], views.margin[node], reach)
        bound_view(view, farthest(view.source, boxes), planes, sequences.plane[node], bounds)
        number = receivers_in_view(view, boxes, rx_m, bounds, stack, seen)
        if number > 0:
            size = count + number
            out = _Found(grow(out.rx, size), grow(out.face, size), grow(out.points, size))
            ends = seen[:number]
            count = _fold(node, ends, images, rx_m, strengths, best, out, count)
            in_view += number
    return out.rx[:count].copy(), out.face[:count].copy(), out.points[:count].copy(), done


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
    """Whether no point of a box is in view."""
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
def _fold(node, found, images, rx_m, strengths, best, out, count):  # type: ignore[no-untyped-def]
    """Append the candidates among the receivers found for a sequence, and return the new number of candidates."""
    rx, face, points = out
    depth = images.views.depth[node]
    for target in found:
        power = fold_line(
            node, rx_m[target], images, strengths.largest, strengths.wavelength_m, face[count], points[count]
        )
        if power >= 0.0:
            level = level_of(power)
            best[node] = min(best[node], level)
            if len(strengths.power):
                strengths.power[target, level] += power
            if not strengths.first[target] <= level < strengths.last[target]:
                continue
            rx[count] = target
            face[count, depth:] = -1
            points[count, depth:] = 0.0
            count += 1
    return count


@njit(cache=True)
def fold_line(node, target, images, largest, wavelength, face, points):  # type: ignore[no-untyped-def]
    """Write the faces and points at which the line from a sequence's image to a receiver is reflected.

    Returns a bound on the power of the path, or -1 where the line, folded back, misses a plane of the sequence.
    """
    sequences, views, planes, material = images
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
