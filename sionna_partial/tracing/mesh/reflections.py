"""Specular paths of meshes, with or without walls that they cross, by the sequences of planes that rays met.

A path is a straight line from an image of the transmitter (docs/physics.md, Images and beams). Rays determine the
sequences, and the directions and reach of each last leg, seen from the image. A receiver there is a candidate if the
line to it, folded back, meets a face of each plane. Between opaque faces, Sionna RT finds the faces in the way. Through
walls, every leg is cast through the mesh, and its faces are grouped to walls.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.outlines import grow
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.interactions import REFLECTION
from sionna_partial.tracing.line import add_slab, has_long_legs, jones_power, reflects_inside
from sionna_partial.tracing.mesh.faces import MOST_FACES, MeshPlanes, Met, divide, face_at, faces_between
from sionna_partial.tracing.mesh.sequences import (
    MeshLinks,
    Rays,
    Sequences,
    Views,
    collect_sequences,
    split_rays,
    view_sequences,
)
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.power import ISOTROPIC, Gains, gain_towards, reflected_power
from sionna_partial.tracing.select import Limits, Listed, discount_after, needs_by_distance
from sionna_partial.tracing.walls import MetFaces, SolidMesh, is_inside, mark_walls

_REACH, _REACH_M = 1.1, 0.3
"""Factor and length [m] by which receivers may be farther than the rays reached."""

_LEAF = 8
"""Largest number of receivers in a box."""

_PART = 0.5
"""Fraction of the smallest relevant power down to which sequences are followed, as split rays only sample them."""

_AT_ONCE = 20_000
"""Number of candidates through walls written together, to bound the memory."""

_SEQUENCES_AT_ONCE, _PARTS = 500, 64
"""Number of sequences whose candidates one thread lists at a time, and about the most parts."""

_ENTRIES = 160
"""Largest number of faces on a path through walls."""


_OPAQUE_MARGIN, _MARGIN = 8.0, 4.0
"""Distances in direction from rays to receivers, in spacings of the rays; split rays are sparse."""


class View(NamedTuple):
    """View of one sequence: image (3,), box of directions, its margin, and reach."""

    source: NDArray[np.float64]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    margin: float
    reach: float


class Traced(NamedTuple):
    """Sequences of planes that rays met, and the views of their receivers."""

    sequences: Sequences
    views: Views


class Images(NamedTuple):
    """Columns of `Traced` and of the mesh for `fold_line`: passing both takes longer than its work."""

    parent: NDArray[np.int32]
    plane: NDArray[np.int32]
    depth: NDArray[np.int32]
    source_m: Floats
    planes: MeshPlanes
    material: NDArray[np.int64]
    largest: Floats
    wavelength_m: float


def images_of(traced: Traced, mesh: SolidMesh) -> Images:
    (sequences, views), materials = traced, mesh.materials
    columns = sequences.parent, sequences.plane, views.depth, views.source_m
    return Images(*columns, mesh.planes, mesh.material, materials.largest, materials.wavelength_m)


class Pairs(NamedTuple):
    """Candidates: the sequence of each (C,), -1 for a straight line, its receiver, and a bound of its power."""

    node: NDArray[np.int32]
    rx: NDArray[np.int32]
    power: Floats


class MeshReflections:
    """Specular paths between a transmitter and receivers, all between opaque faces, or all through walls."""

    def __init__(self, name: str, links: MeshLinks, opaque: Traced | None = None, rays: int = 0) -> None:
        self.name, self._links, self._opaque, self._rays = name, links, opaque, rays

    @classmethod
    def between_faces(
        cls,
        mesh: SolidMesh,
        tx_m: Floats,
        rx_m: Floats,
        settings: TraceSettings,
        rays: Iterable[Rays],
        gains: Gains = ISOTROPIC,
    ) -> "MeshReflections":
        """Return the paths between opaque faces; `rays` are from `shoot_rays` for this transmitter and depth."""
        depth, sequences = settings.max_depth, collect_sequences(rays, mesh.planes)
        links = MeshLinks.of(mesh, tx_m, rx_m, Limits(depth, depth, 0, 1.0, 0.0), gains)
        views = view_sequences(sequences, mesh.planes, links.tx_m, _OPAQUE_MARGIN)
        return cls("reflections", links, Traced(sequences, views))

    @classmethod
    def through_walls(
        cls,
        mesh: SolidMesh,
        tx_m: Floats,
        rx_m: Floats,
        settings: TraceSettings,
        rays: int,
        gains: Gains = ISOTROPIC,
        *,
        coarse: bool = False,
    ) -> "MeshReflections":
        """Return the paths that cross 1 to `max_walls` walls, by so many rays that are split at faces."""
        limits = Limits.of(settings, settings.max_walls, directed=len(gains.table) > 1, coarse=coarse)
        return cls("paths through walls", MeshLinks.of(mesh, tx_m, rx_m, limits, gains), rays=rays)

    def listed(self, found: Floats, *, sequences_at_once: int = _SEQUENCES_AT_ONCE) -> Iterator[Listed]:
        links, every = self._links, np.arange(len(self._links.rx_m), dtype=np.int32)
        direct = np.full(len(every), np.inf)
        if self._opaque is None:
            direct[:] = 0.0
            _straight(links, Scratch.of(links), direct)
        needed = links.limits.min_power(found + direct) if self._opaque is None else np.zeros(len(every))
        traced, boxes = self._opaque or self._split(needed), divide(links.rx_m, links.rx_m, _LEAF)
        count = len(traced.views.order)
        step = max(sequences_at_once, count // _PARTS)

        def of_sequences(start: int) -> Pairs:
            nodes, images = traced.views.order[start : start + step], images_of(traced, links.mesh)
            return _pairs(nodes, traced, boxes, needed, links, images, Scratch.of(links))  # type: ignore[no-any-return]

        straight = Pairs(np.full(len(every), -1, np.int32), every, direct)
        parts: Iterable[Pairs] = itertools.chain([straight], in_order(of_sequences, range(0, count, step)))
        if self._opaque is None:
            parts = [Pairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))]
        for number, (node, rx, power) in enumerate(parts):
            done = min(number * step / max(1, count), 1.0)
            yield Listed(rx, power, partial(self._written, traced, node, rx), done, at_once=_AT_ONCE)

    def _split(self, needed: Floats) -> Traced:
        links, sequences = self._links, collect_sequences([], self._links.mesh.planes)
        if links.limits.reflections and len(needed) and len(links.mesh.tree.plane):
            wavelength_m = links.mesh.materials.wavelength_m
            by_distance = needs_by_distance(links.tx_m, links.rx_m, _PART * needed, wavelength_m)
            sequences = split_rays(links, self._rays, by_distance)
        return Traced(sequences, view_sequences(sequences, links.mesh.planes, links.tx_m, _MARGIN))

    def _written(self, traced: Traced, node: NDArray[np.int32], rx: NDArray[np.int32], rows: Indices) -> Candidates:
        room, images = (
            max(1, self._links.limits.depth) if self._opaque else _ENTRIES,
            images_of(traced, self._links.mesh),
        )
        scratch = Scratch.of(self._links, room)
        kind, face, vertices_m, same_wall = _write(node[rows], rx[rows], traced, self._links, images, scratch)
        candidates = Candidates(rx[rows], kind, face, vertices_m)
        return candidates if self._opaque else replace(candidates, same_wall=same_wall).narrowed()


class Scratch(NamedTuple):
    """Scratch of one path: faces on a line, entries, and the faces and points of its reflections."""

    met: Met
    entries: MetFaces
    faces: NDArray[np.int32]
    points: Floats

    @classmethod
    def of(cls, links: MeshLinks, room: int = _ENTRIES) -> "Scratch":
        depth = max(1, links.limits.depth)
        return cls(Met.empty(), MetFaces.empty(room), np.empty(depth, np.int32), np.empty((depth, 3)))


@njit(cache=True, borrows=True, nogil=True)
def _straight(links, scratch, power):
    """Write the powers (N,) of straight paths through walls."""
    for rx in range(len(power)):
        number = _follow(0, links.rx_m[rx], links, scratch)
        if number >= 0:
            power[rx] = _power(scratch.entries, number, links.rx_m[rx], links)


@njit(cache=True, nogil=True)
def _pairs(nodes, traced, boxes, needed, links, images, scratch):
    """Pair sequences with the receivers in their view that need them."""
    (sequences, views), limits, rx_m = traced, links.limits, links.rx_m
    all_node, all_rx, all_power, count = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024), 0
    seen, stack, bounds = np.empty(len(rx_m), np.int64), np.empty(128, np.int64), np.empty((5, 3))
    for node in nodes:
        source, discount = views.source_m[node], discount_after(limits, views.depth[node])
        reach = _REACH * sequences.reach_m[node] + _REACH_M
        view = View(source, sequences.low[node], sequences.high[node], views.margin[node], reach)
        bound_view(view, farthest(source, boxes), links.mesh.planes, sequences.plane[node], bounds)
        number = receivers_in_view(view, boxes, rx_m, bounds, stack, seen)
        for rx in seen[:number]:
            least = needed[rx] / discount
            power = _pair_power(node, rx, least, sequences.left[node], links, images, scratch)
            if power >= least:
                all_node, all_rx = grow(all_node, count + 1), grow(all_rx, count + 1)
                all_power = grow(all_power, count + 1)
                all_node[count], all_rx[count], all_power[count] = node, rx, power
                count += 1
    return Pairs(all_node[:count].copy(), all_rx[:count].copy(), all_power[:count].copy())


@njit(cache=True, borrows=True)
def _pair_power(node, rx, least, left, links, images, scratch):
    """Return the bound of a path, or through walls its power; less than `least` if it is weaker or there is no path."""
    target, tx, points, through = links.rx_m[rx], links.tx_m, scratch.points, links.limits.walls > 0
    sx, sy, sz = images.source_m[node, 0], images.source_m[node, 1], images.source_m[node, 2]
    x, y, z = target[0] - sx, target[1] - sy, target[2] - sz
    most = left * (images.wavelength_m / (4.0 * np.pi)) ** 2
    if through and most < _PART * least * (x * x + y * y + z * z):
        return -1.0
    power = fold_line(node, target, images, scratch.faces, points)
    if power < 0.0:
        return -1.0
    power *= gain_towards(links.gains, points[0, 0] - tx[0], points[0, 1] - tx[1], points[0, 2] - tx[2])
    if not through or power < least:
        return power
    entered = _follow(images.depth[node], target, links, scratch)
    return _power(scratch.entries, entered, target, links) if entered >= 0 else -1.0


@njit(cache=True, nogil=True)
def _write(nodes, rx, traced, links, images, scratch):
    """Return kinds, faces, vertices and further faces of a wall of candidates: sequences and receivers (C,)."""
    entries, room = scratch.entries, len(scratch.entries.face)
    shape, faces, points = (len(nodes), room), scratch.faces, scratch.points
    kind, face, same_wall = np.zeros(shape, np.uint8), np.full(shape, -1, np.int32), np.zeros(shape, np.bool_)
    vertices = np.zeros((len(nodes), room, 3))
    for c in range(len(nodes)):
        node, target, reflections = nodes[c], links.rx_m[rx[c]], 0
        if node >= 0:
            fold_line(node, target, images, faces, points)
            reflections = traced.views.depth[node]
        if links.limits.walls == 0:
            kind[c, :reflections], face[c, :reflections] = REFLECTION, faces[:reflections]
            vertices[c, :reflections] = points[:reflections]
            continue
        number = _follow(reflections, target, links, scratch)
        kind[c, :number], face[c, :number] = entries.kind[:number], entries.face[:number]
        vertices[c, :number], same_wall[c, :number] = entries.point_m[:number], entries.same_wall[:number]
    return kind, face, vertices, same_wall


@njit(cache=True, borrows=True)
def receivers_in_view(view, boxes, rx, bounds, stack, found):
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


@njit(cache=True, borrows=True)
def farthest(source, boxes):
    total = 0.0
    for axis in range(3):
        total += max(source[axis] - boxes.low_m[0, axis], boxes.high_m[0, axis] - source[axis]) ** 2
    return np.sqrt(total) + 1e-3


@njit(cache=True, borrows=True)
def bound_view(view, farthest, planes, p, bounds):
    """Write bounds of the points in view of an image and beyond its last plane.

    Rows 0 and 1 are the corners of a box around them; 2 is the image, 3 the middle of the box of directions, 4 the
    largest distance of a direction from the middle, and the middle's square. A point in view at a distance r from the
    image is within r times that distance of r times the middle.
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


@njit(cache=True, borrows=True)
def _apart(low, high, bounds):
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


@njit(cache=True, borrows=True)
def fold_line(node, target, images, face, points):
    """Write the faces and points at which the line from a sequence's image to a receiver is reflected.

    Return a bound on the power, or -1 where the line, folded back, misses a plane of the sequence.
    """
    parent, plane, depths, sources, planes, material, largest, wavelength = images
    normals, offsets, bins, depth = planes.normal, planes.offset_m, planes.bins, depths[node]
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


@njit(cache=True, borrows=True)
def _follow(reflections, target, links, scratch):
    """Write all faces on a path with reflections; return their number, -1 if it crosses no or too many walls."""
    (met, entries, faces, points), mesh, count, crossed = scratch, links.mesh, 0, 0
    a, own, before = links.tx_m, np.int64(-1), (False, False)
    for k in range(reflections + 1):
        b, other = target, np.int64(-1)
        if k < reflections:
            b, other = points[k], np.int64(mesh.planes.plane[faces[k]])
        number = faces_between(mesh.tree, a, b, own, other, met)
        if number == MOST_FACES or count + number + 1 > len(entries.face):
            return -1
        crossed += mark_walls(mesh, a, b, number, met, entries, count)
        after = False, False
        if k > 0 and number > 0:
            after = is_inside(mesh, faces[k - 1], met.face[0], met.face[0], a, entries.point_m[count])
        if reflects_inside(before, after) or crossed > links.limits.walls:
            return -1
        count, before = count + number, (False, False)
        if k < reflections:
            if number > 0:
                last = met.face[number - 1]
                before = is_inside(mesh, last, faces[k], last, entries.point_m[count - 1], b)
            entries.face[count], entries.kind[count], entries.same_wall[count] = faces[k], REFLECTION, False
            for axis in range(3):
                entries.point_m[count, axis] = b[axis]
            count += 1
        a, own = b, other
    _measure(entries, count, links.tx_m, target)
    return count if crossed > 0 and has_long_legs(entries.at_m, count, entries.at_m[count], 1.0) else -1


@njit(cache=True, borrows=True)
def _measure(entries, count, tx, target):
    """Write the lengths of a path to its `count` entries and to its end."""
    total = 0.0
    for k in range(count + 1):
        before = entries.point_m[k - 1] if k > 0 else tx
        after = entries.point_m[k] if k < count else target
        dx, dy, dz = after[0] - before[0], after[1] - before[1], after[2] - before[2]
        total += np.sqrt(dx * dx + dy * dy + dz * dz)
        entries.at_m[k] = total


@njit(cache=True, borrows=True)
def _power(entries, count, target, links):
    """Return the power of a path with `count` entries, of which `_follow` wrote the lengths."""
    mesh, tx, used = links.mesh, links.tx_m, 0
    first = entries.point_m[0] if count else target
    kx, ky, kz = first[0] - tx[0], first[1] - tx[1], first[2] - tx[2]
    size = entries.at_m[0]
    for j in range(count):
        if not entries.same_wall[j]:
            face = entries.face[j]
            p, normals = mesh.planes.plane[face], mesh.planes.normal
            normal = normals[p, 0], normals[p, 1], normals[p, 2]
            used = add_slab(entries.slabs, used, normal, mesh.material[face], entries.kind[j])
    power = jones_power((kx / size, ky / size, kz / size), entries.at_m[count], entries.slabs, used, mesh.materials)
    return power * gain_towards(links.gains, kx, ky, kz)
