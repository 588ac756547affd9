"""The planes that the faces of a mesh lie on, and which face of a plane is where.

Faces in one plane reflect to one image, so sequences of reflections are distinguished by planes, not by faces. In a
scanned mesh nearly every face is a plane of its own.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.planar import span_in_strip
from sionna_partial.process import njit

PLANE_TOLERANCE_M = 1e-4
"""Distance of corners from a plane [m] up to which a face lies in it. Vertices are single precision."""

_NORMAL_TOLERANCE = 1e-4
"""Difference of unit normals up to which faces are parallel: 1 cm, which the solver accepts, in an image 50 m away."""

_FACE_TOLERANCE_M = 1e-3
"""Distance beyond a face [m] up to which a point counts as on it."""


class FaceBins(NamedTuple):
    """F faces of P planes, sorted into B square bins of each plane.

    `axes` (P, 2) are the two coordinates that distinguish the faces of a plane, in which `low_m` (P, 2) is the
    corner of its bins and `edge_m` (P,) their size; `columns` (P,) is their number in a row, and `first_bin` (P + 1,)
    the first bin. `start` (B + 1,) and `face` are the faces that reach into each bin, one bin after the other, and
    `corner_m` (F, 3, 2) the corners of the faces in the coordinates of their planes.
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

    `plane` (F,) is that of every face; one without area has a plane of its own. A point lies in a plane where
    ``normal @ point == offset_m``. Balls `centre_m` (P, 3), `radius_m` (P,) hold the faces of each plane.
    """

    plane: NDArray[np.int32]
    normal: NDArray[np.float64]
    offset_m: NDArray[np.float64]
    centre_m: NDArray[np.float64]
    radius_m: NDArray[np.float64]
    bins: FaceBins


def group_planes(vertices_m: NDArray[np.float64], triangles: NDArray[np.int64]) -> MeshPlanes:
    """Find the planes of a mesh of vertices (V, 3) [m] and triangles (F, 3), and sort the faces of each."""
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
    columns, rows = (np.floor(size_m / edge_m[:, None]).astype(np.int64) + 1).T
    first_bin = np.concatenate([[0], np.cumsum(columns * rows)])
    flat_m = np.take_along_axis(corner_m, axes[plane][:, None], 2)
    start, face = _fill_bins(plane, flat_m, low_m, edge_m, columns, first_bin)
    bins = FaceBins(axes, low_m, edge_m, columns, first_bin, start, face, flat_m)
    radius_m = 0.5 * np.linalg.norm(high - low, axis=1)
    return MeshPlanes(plane, normal, offset_m, 0.5 * (low + high), radius_m, bins)


@njit(cache=True)
def mix(a, b):  # type: ignore[no-untyped-def]
    """Hash two integers into one."""
    h = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(b) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= h >> np.uint64(29)
    h *= np.uint64(0xBF58476D1CE4E5B9)
    return h ^ (h >> np.uint64(32))


@njit(cache=True)
def _plane_ids(order, normal, offset, corner):  # type: ignore[no-untyped-def]
    """Plane of every face, and the first face of every plane; faces come in the order given, largest first.

    Planes are kept by cells of |normal| and |offset|, and looked for in the 16 cells around a face's own.
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


@njit(cache=True)
def _in_plane(first, f, normal, offset, corner):  # type: ignore[no-untyped-def]
    """Whether a face lies in the plane of the face `first`."""
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
def _fill_bins(plane, corner, low, edge, columns, first_bin):  # type: ignore[no-untyped-def]
    """First entry of every bin, and the faces in bin after bin: row by row, what a face covers of a row of bins."""
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


@njit(cache=True)
def face_at(bins, p, x, y, z):  # type: ignore[no-untyped-def]
    """Face of plane p at a point of it, or -1."""
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


@njit(cache=True)
def _inside(corner, f, x, y):  # type: ignore[no-untyped-def]
    """Whether a point lies on a face or at most the tolerance beyond its edges."""
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
