"""Faces of a mesh: their planes, the face at a point of a plane, and the faces on a line.

Faces in one plane reflect to one image, so that planes distinguish sequences of reflections. In a scanned mesh nearly
every face is a plane of its own.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, span_in_strip
from sionna_partial.process import njit

MOST_FACES = 64
"""Largest number of faces on a line; more are left out."""

_LEAF = 4
"""Largest number of faces in a box."""

_INSIDE = 1e-9
"""Fraction of a face by which a line may miss it, so that neighbours leave no gap."""

PLANE_TOLERANCE_M = 1e-4
"""Distance of corners from a plane [m] up to which a face lies in it, for single precision."""

_NORMAL_TOLERANCE = 1e-4
"""Difference of unit normals of parallel faces: 1 cm, which the solver accepts, in an image 50 m away."""

_FACE_TOLERANCE_M = 1e-3
"""Distance beyond a face [m] up to which a point counts as on it."""


class Boxes(NamedTuple):
    """F items in a tree of K boxes; box 0 holds all.

    Box k has the corners `low_m`, `high_m` (K, 3) and items `start` to `stop` of `order` (F,); `child` is the first of
    its two boxes, or -1.
    """

    order: NDArray[np.int64]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    child: NDArray[np.int64]
    low_m: Floats
    high_m: Floats


class FaceTree(NamedTuple):
    """F faces in boxes: corners (F, 3, 3) in the order of the boxes, and planes (F,)."""

    boxes: Boxes
    corner_m: Floats
    plane: NDArray[np.int32]


def face_tree(corner_m: Floats, plane: NDArray[np.int32]) -> FaceTree:
    boxes = divide(corner_m.min(axis=1), corner_m.max(axis=1), _LEAF)
    return FaceTree(boxes, corner_m[boxes.order], plane)


@njit(cache=True)
def divide(low_m, high_m, leaf):
    """Divide items into boxes of at most `leaf`, each at the median along the longest side."""
    count = len(low_m)
    size = 4 * (count // leaf + 1)
    order, middle = np.arange(count), low_m + high_m
    start, stop, child = np.zeros(size, np.int64), np.zeros(size, np.int64), np.full(size, -1, np.int64)
    low, high = np.full((size, 3), np.inf), np.full((size, 3), -np.inf)
    stop[0], boxes, box = count, 1, 0
    while box < boxes:
        longest, spread = 0, -1.0
        for axis in range(3):
            least, most = np.inf, -np.inf
            for item in order[start[box] : stop[box]]:
                low[box, axis], high[box, axis] = (
                    min(low[box, axis], low_m[item, axis]),
                    max(high[box, axis], high_m[item, axis]),
                )
                least, most = min(least, middle[item, axis]), max(most, middle[item, axis])
            if most - least > spread:
                longest, spread = axis, most - least
        if stop[box] - start[box] > leaf:
            inside = order[start[box] : stop[box]].copy()
            order[start[box] : stop[box]] = inside[np.argsort(middle[inside, longest], kind="mergesort")]
            half = (start[box] + stop[box]) // 2
            start[boxes], stop[boxes], start[boxes + 1], stop[boxes + 1] = start[box], half, half, stop[box]
            child[box] = boxes
            boxes += 2
        box += 1
    return Boxes(order, start[:boxes], stop[:boxes], child[:boxes], low[:boxes], high[:boxes])


class Met(NamedTuple):
    """Scratch of one line: the faces that it meets, and the fractions of its length."""

    face: NDArray[np.int64]
    at: Floats
    stack: NDArray[np.int64]

    @classmethod
    def empty(cls) -> "Met":
        return cls(np.empty(MOST_FACES, np.int64), np.empty(MOST_FACES), np.empty(128, np.int64))


@njit(cache=True, borrows=True)
def faces_between(tree, a, b, own, other, met):
    """Write the faces between two points, one for each plane except `own` and `other`; return their number."""
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ix = 1.0 / dx if dx != 0.0 else 1e300
    iy = 1.0 / dy if dy != 0.0 else 1e300
    iz = 1.0 / dz if dz != 0.0 else 1e300
    boxes, count, top = tree.boxes, 0, 1
    met.stack[0] = 0
    while top > 0:
        top -= 1
        box = met.stack[top]
        x0, x1 = (boxes.low_m[box, 0] - 1e-6 - a[0]) * ix, (boxes.high_m[box, 0] + 1e-6 - a[0]) * ix
        y0, y1 = (boxes.low_m[box, 1] - 1e-6 - a[1]) * iy, (boxes.high_m[box, 1] + 1e-6 - a[1]) * iy
        z0, z1 = (boxes.low_m[box, 2] - 1e-6 - a[2]) * iz, (boxes.high_m[box, 2] + 1e-6 - a[2]) * iz
        first = max(min(x0, x1), min(y0, y1), min(z0, z1), 0.0)
        if first > min(max(x0, x1), max(y0, y1), max(z0, z1), 1.0):
            continue
        if boxes.child[box] >= 0:
            met.stack[top], met.stack[top + 1] = boxes.child[box], boxes.child[box] + 1
            top += 2
            continue
        for k in range(boxes.start[box], boxes.stop[box]):
            t = _meets(tree.corner_m[k], a, dx, dy, dz)
            if 0.0 < t < 1.0:
                count = _insert(boxes.order[k], t, tree.plane, own, other, met, count)
    return count


@njit(cache=True, borrows=True)
def _meets(corner, a, dx, dy, dz):
    """Return the fraction of a line at which it meets a triangle, or -1 (Moeller and Trumbore 1997)."""
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    area = ux * px + uy * py + uz * pz
    if area == 0.0:
        return -1.0
    sx, sy, sz = a[0] - corner[0, 0], a[1] - corner[0, 1], a[2] - corner[0, 2]
    u = (sx * px + sy * py + sz * pz) / area
    if u < -_INSIDE or u > 1.0 + _INSIDE:
        return -1.0
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (dx * qx + dy * qy + dz * qz) / area
    if v < -_INSIDE or u + v > 1.0 + _INSIDE:
        return -1.0
    return (vx * qx + vy * qy + vz * qz) / area


@njit(cache=True, borrows=True)
def _insert(face, t, plane, own, other, met, count):
    p = plane[face]
    if p in (own, other) or count == MOST_FACES:
        return count
    for k in range(count):
        if plane[met.face[k]] == p:
            return count
    at = count
    while at > 0 and met.at[at - 1] > t:
        met.face[at], met.at[at] = met.face[at - 1], met.at[at - 1]
        at -= 1
    met.face[at], met.at[at] = face, t
    return count + 1


class FaceBins(NamedTuple):
    """F faces of P planes, sorted into B square bins of each plane.

    `axes` (P, 2) are the two coordinates used in a plane, in which `low_m` (P, 2) is the corner of its bins, `edge_m`
    (P,) their size, `columns` (P,) their number in a row and `first_bin` (P + 1,) the first. `start` (B + 1,) and
    `face` list the faces of each bin, with corners `corner_m` (F, 3, 2).
    """

    axes: NDArray[np.int64]
    low_m: NDArray[np.float64]
    edge_m: NDArray[np.float64]
    columns: NDArray[np.int64]
    first_bin: NDArray[np.int64]
    start: NDArray[np.int64]
    face: NDArray[np.int32]
    corner_m: NDArray[np.float64]


class MeshPlanes(NamedTuple):
    """F faces of a mesh, grouped by P planes.

    `plane` (F,) is the plane of every face; a face without area has its own. Points of a plane satisfy
    ``normal @ point == offset_m``. Balls `centre_m` (P, 3), `radius_m` (P,) hold its faces.
    """

    plane: NDArray[np.int32]
    normal: NDArray[np.float64]
    offset_m: NDArray[np.float64]
    centre_m: NDArray[np.float64]
    radius_m: NDArray[np.float64]
    bins: FaceBins


def group_planes(vertices_m: NDArray[np.float64], triangles: NDArray[np.int64]) -> MeshPlanes:
    corner_m = np.ascontiguousarray(vertices_m[triangles], dtype=np.float64)
    across = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    area = np.linalg.norm(across, axis=1)
    normal = across / np.where(area > 0.0, area, 1.0)[:, None]
    offset_m = (normal * corner_m[:, 0]).sum(axis=1)
    plane, first = _plane_ids(np.argsort(-area, kind="stable"), normal, offset_m, corner_m)
    normal, offset_m = normal[first], offset_m[first]
    low, high = np.full((len(first), 3), np.inf), np.full((len(first), 3), -np.inf)
    np.minimum.at(low, plane, corner_m.min(axis=1))
    np.maximum.at(high, plane, corner_m.max(axis=1))
    flat = np.argmax(np.abs(normal), axis=1)
    axes = np.stack([(flat + 1) % 3, (flat + 2) % 3], axis=1)
    low_m, size_m = np.take_along_axis(low, axes, 1), np.take_along_axis(high - low, axes, 1) + 1e-6
    count = np.bincount(plane, minlength=len(first))
    edge_m = np.maximum(np.sqrt(size_m.prod(axis=1) / count), size_m.max(axis=1) / (4 * count))
    edge_m[count == 1] = size_m[count == 1].max(axis=1)
    columns, rows = np.floor(size_m / edge_m[:, None]).astype(np.int64).T.copy() + 1
    first_bin = np.concatenate([[0], np.cumsum(columns * rows)])
    flat_m = np.take_along_axis(corner_m, axes[plane][:, None], 2)
    start, face = _fill_bins(plane, flat_m, low_m, edge_m, columns, first_bin)
    bins = FaceBins(axes, low_m, edge_m, columns, first_bin, start, face, flat_m)
    radius_m = 0.5 * np.linalg.norm(high - low, axis=1)
    return MeshPlanes(plane, normal, offset_m, 0.5 * (low + high), radius_m, bins)


@njit(cache=True, borrows=True)
def mix(a, b):
    h = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(b) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= h >> np.uint64(29)
    h *= np.uint64(0xBF58476D1CE4E5B9)
    return h ^ (h >> np.uint64(32))


@njit(cache=True)
def _plane_ids(order, normal, offset, corner):
    """Return the plane of every face, and the first face of every plane; faces come in `order`, largest first.

    Planes are kept by cells of |normal| and |offset|, and looked for in the 16 cells around a face.
    """
    plane, first, count = np.full(len(order), -1, np.int32), np.empty(len(order), np.int32), 0
    size = 16
    while size < 2 * len(order):
        size *= 2
    head, following = np.full(size, -1, np.int32), np.full(len(order), -1, np.int32)
    mask, cell = np.uint64(size - 1), np.empty((4, 2), np.int64)
    for f in order:
        for k in range(4):
            at = abs(normal[f, k]) / 0.02 if k < 3 else abs(offset[f]) / 0.1
            cell[k, 0] = np.int64(np.floor(at))
            cell[k, 1] = cell[k, 0] + (1 if at - np.floor(at) > 0.5 else -1)
        found = -1
        for m in range(16):
            key = mix(mix(cell[0, m & 1], cell[1, (m >> 1) & 1]), mix(cell[2, (m >> 2) & 1], cell[3, m >> 3])) & mask
            candidate = head[key]
            while candidate >= 0 and found < 0:
                if _in_plane(first[candidate], f, normal, offset, corner):
                    found = candidate
                candidate = following[candidate]
            if found >= 0:
                break
        if found < 0:
            found, first[count] = count, f
            key = mix(mix(cell[0, 0], cell[1, 0]), mix(cell[2, 0], cell[3, 0])) & mask
            following[count], head[key] = head[key], count
            count += 1
        plane[f] = found
    return plane, first[:count].copy()


@njit(cache=True, borrows=True)
def _in_plane(first, f, normal, offset, corner):
    nx, ny, nz = normal[first]
    sign = 1.0 if nx * normal[f, 0] + ny * normal[f, 1] + nz * normal[f, 2] > 0.0 else -1.0
    for k in range(3):
        if abs(normal[first, k] - sign * normal[f, k]) > _NORMAL_TOLERANCE:
            return False
    for k in range(3):
        away = nx * corner[f, k, 0] + ny * corner[f, k, 1] + nz * corner[f, k, 2] - offset[first]
        if abs(away) > PLANE_TOLERANCE_M:
            return False
    return True


@njit(cache=True)
def _fill_bins(plane, corner, low, edge, columns, first_bin):
    start = np.zeros(first_bin[-1] + 1, np.int64)
    items = np.empty(0, np.int32)
    for stored in (False, True):
        if stored:
            total = np.cumsum(start)
            start[1:], start[0] = total[:-1], 0
            items, following = np.empty(total[-1], np.int32), start.copy()
        for f in range(len(plane)):
            p, margin = plane[f], 2.0 * _FACE_TOLERANCE_M
            flat = corner[f] - low[p]
            rows = (first_bin[p + 1] - first_bin[p]) // columns[p]
            bottom, top = int((flat[:, 1].min() - margin) / edge[p]), int((flat[:, 1].max() + margin) / edge[p])
            for row in range(max(0, bottom), min(rows - 1, top) + 1):
                left, right = span_in_strip(flat, row * edge[p] - margin, (row + 1) * edge[p] + margin)
                begin, end = int((left - margin) / edge[p]), int((right + margin) / edge[p])
                for column in range(max(0, begin), min(columns[p] - 1, end) + 1):
                    b = first_bin[p] + row * columns[p] + column
                    if stored:
                        items[following[b]] = f
                        following[b] += 1
                    else:
                        start[b] += 1
    return start, items


@njit(cache=True, borrows=True)
def face_at(bins, p, x, y, z):
    axes, low, edge, columns, first_bin, start, face, corner = bins
    u, v = axes[p, 0], axes[p, 1]
    x, y = (x if u == 0 else y if u == 1 else z), (x if v == 0 else y if v == 1 else z)
    right, up, tolerance = x - low[p, 0], y - low[p, 1], _FACE_TOLERANCE_M
    rows = (first_bin[p + 1] - first_bin[p]) // columns[p]
    if min(right, up) < -tolerance or right > columns[p] * edge[p] + tolerance or up > rows * edge[p] + tolerance:
        return -1
    column, row = min(max(int(right / edge[p]), 0), columns[p] - 1), min(max(int(up / edge[p]), 0), rows - 1)
    b = first_bin[p] + row * columns[p] + column
    for k in range(start[b], start[b + 1]):
        if _inside(corner, face[k], x, y):
            return face[k]
    return -1


@njit(cache=True, borrows=True)
def _inside(corner, f, x, y):
    px, py, qx, qy = corner[f, 1, 0], corner[f, 1, 1], corner[f, 2, 0], corner[f, 2, 1]
    turn = (px - corner[f, 0, 0]) * (qy - corner[f, 0, 1]) - (py - corner[f, 0, 1]) * (qx - corner[f, 0, 0])
    sign = 1.0 if turn > 0.0 else -1.0
    for k in range(3):
        px, py, qx, qy = qx, qy, corner[f, k, 0], corner[f, k, 1]
        dx, dy = qx - px, qy - py
        beyond = sign * (dy * (x - px) - dx * (y - py))
        if beyond > 0.0 and beyond * beyond > _FACE_TOLERANCE_M**2 * (dx * dx + dy * dy):
            return False
    return True
