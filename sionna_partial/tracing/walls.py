"""Rules for the faces along a line that are one wall, for floor plans, obstacles and meshes.

Consecutive faces are one wall if they are at most `depth_m` apart, measured across them, with no free cell of the map
between them; in meshes also where the line enters and leaves a closed body. One face of a wall has its loss, and none
reflects a path in the wall. Where a wall meets another, that one reflects, as if the wall continued behind a mirror.

Plans and meshes group faces in two functions: a mesh counts from the near end of the line, where its cells are also
sampled, and a common function would change the order of close faces.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.process import njit
from sionna_partial.tracing.interactions import REFRACTION
from sionna_partial.tracing.mesh.faces import FaceTree, MeshPlanes
from sionna_partial.tracing.power import Materials

_PARALLEL = 0.5
"""Smallest cosine of the angle between parallel faces."""

_CUT_CELLS = 1.25
"""Largest distance of a face from the cells of its wall [cells]."""


class Interior(NamedTuple):
    """Space between walls: cells (ny, nx) that are free or have a floor, their edge and the largest wall depth [m].

    `free_before` (ny + 1, nx + 1) counts the free cells in smaller rows and columns.
    """

    free: Bools
    free_before: Indices
    floor: Bools
    cell_m: float
    depth_m: float

    @classmethod
    def of(cls, free: Bools, floor: Bools, cell_m: float, depth_m: float) -> "Interior":
        before = np.pad(free.astype(np.int64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        return cls(free, before, floor, cell_m, depth_m)


class Bodies(NamedTuple):
    """The closed body that each of F faces bounds (F,), -1 for none, and its normal out of the body (F, 3)."""

    body: NDArray[np.int64]
    outward: Floats


class Cells(NamedTuple):
    """Free cells (ny, nx) of a map, their edge [m], and the largest depth of one wall [m]."""

    free: Bools
    cell_m: float
    depth_m: float


class SolidMesh(NamedTuple):
    """A mesh that lines go through, and the material of each face (F,)."""

    tree: FaceTree
    planes: MeshPlanes
    bodies: Bodies
    cells: Cells
    materials: Materials
    material: NDArray[np.int64]


def closed_bodies(vertices_m: Floats, triangles: NDArray[np.int64]) -> Bodies:
    """Find the connected pieces of a mesh that enclose a volume, every edge once in each direction."""
    if not len(triangles):
        return Bodies(np.zeros(0, np.int64), np.zeros((0, 3)))
    count = len(vertices_m)
    start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
    edge, which, number = np.unique(start * count + end, return_inverse=True, return_counts=True)
    back = np.searchsorted(edge, end * count + start)
    back[back == len(edge)] = 0
    paired = (edge[back] == end * count + start) & (number[back] == number[which])
    graph = coo_array((np.ones(len(start), bool), (start, end)), (count, count))
    pieces, piece = connected_components(graph, directed=False)
    body = piece[triangles[:, 0]].astype(np.int64)
    opened = np.zeros(pieces, bool)
    opened[body[~paired.reshape(-1, 3).all(axis=1)]] = True
    corner_m = (vertices_m - vertices_m.mean(axis=0))[triangles]
    across = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    volume = np.bincount(body, (corner_m[:, 0] * across).sum(axis=1), pieces)
    outward = np.sign(volume[body])[:, None] * across / np.linalg.norm(across, axis=1)[:, None]
    return Bodies(np.where(opened[body], -1, body), outward)


class MetFaces(NamedTuple):
    """Scratch of one path: the faces that it meets, in order from the transmitter.

    `kind` and `same_wall` are as in `Candidates`, `cosine` is for the angle of incidence.
    """

    face: NDArray[np.int64]
    kind: NDArray[np.uint8]
    same_wall: Bools
    cosine: Floats
    point_m: Floats


@njit(cache=True)
def met_faces(size):
    return MetFaces(
        np.empty(size, np.int64),
        np.empty(size, np.uint8),
        np.empty(size, np.bool_),
        np.empty(size),
        np.empty((size, 3)),
    )


@njit(cache=True)
def cosine_at(planes, face, dx, dy, dz):
    p = planes.plane[face]
    normal = planes.normal
    return min(abs(normal[p, 0] * dx + normal[p, 1] * dy + normal[p, 2] * dz), 1.0)


@njit(cache=True)
def is_one_wall(mesh, first, second, a, b, begin, end):
    """Return whether no free cell is between two faces, met in turn at fractions of a line from a to b."""
    body, outward = mesh.bodies.body, mesh.bodies.outward
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    if body[first] >= 0 and body[first] == body[second]:
        entered = outward[first, 0] * dx + outward[first, 1] * dy + outward[first, 2] * dz < 0.0
        left = outward[second, 0] * dx + outward[second, 1] * dy + outward[second, 2] * dz > 0.0
        if entered and left:
            return True
    return not is_free_between(mesh.cells, a, b, begin, end)


@njit(cache=True)
def is_inside(mesh, first, second, crossed, a, b):
    """Return whether a line is in one wall from a on one face to b on another, and as `is_far_inside`."""
    normal, p, q = mesh.planes.normal, mesh.planes.plane[first], mesh.planes.plane[second]
    turn = normal[p, 0] * normal[q, 0] + normal[p, 1] * normal[q, 1] + normal[p, 2] * normal[q, 2]
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
    kx, ky, kz = dx / length, dy / length, dz / length
    steep = min(cosine_at(mesh.planes, first, kx, ky, kz), cosine_at(mesh.planes, second, kx, ky, kz))
    inside = length * steep <= mesh.cells.depth_m and is_one_wall(mesh, first, second, a, b, 0.0, 1.0)
    return inside, is_far_inside(mesh.cells, turn, length * cosine_at(mesh.planes, crossed, kx, ky, kz))


@njit(cache=True)
def are_parallel(turn):
    return abs(turn) >= _PARALLEL


@njit(cache=True)
def is_far_inside(cells, turn, distance_m):
    """Return whether a face, at a turn and distance from a crossed face, is not in a corner with it."""
    return are_parallel(turn) or distance_m > 0.5 * cells.depth_m


@njit(cache=True)
def reflects_inside(before, after):
    """Return whether a face reflects a path in a wall; `before` and `after` are from `is_inside`."""
    return (before[0] and (before[1] or after[0])) or (after[0] and after[1])


@njit(cache=True)
def mark_walls(mesh, a, b, count, met, entries, begin):
    """Write the faces on a line from a to b as trail entries from number `begin`; return the number of walls.

    Walls are counted from the end with smaller coordinates: links are reciprocal.
    """
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    turned = dx < 0.0 or (dx == 0.0 and (dy < 0.0 or (dy == 0.0 and dz < 0.0)))
    near, far = (b, a) if turned else (a, b)
    cosines, same_wall = entries.cosine[begin : begin + count], entries.same_wall[begin : begin + count]
    walls, opened, start, previous, steep = 0, 0, 0.0, 0.0, 1.0
    for j in range(count):
        k = count - 1 - j if turned else j
        face, t = met.face[k], 1.0 - met.at[k] if turned else met.at[k]
        cosine = cosine_at(mesh.planes, face, dx / length, dy / length, dz / length)
        same = j > 0 and (t - start) * length * min(cosine, steep) <= mesh.cells.depth_m
        if same:
            before = met.face[k + 1 if turned else k - 1]
            same = is_one_wall(mesh, before, face, near, far, previous, t)
        if not same:
            choose_face(cosines, same_wall, opened, j, turned)
            walls, opened, start, steep = walls + 1, j, t, 1.0
        entry = begin + k
        entries.face[entry], entries.kind[entry] = face, REFRACTION
        entries.cosine[entry] = cosine
        for axis in range(3):
            entries.point_m[entry, axis] = a[axis] + met.at[k] * (b[axis] - a[axis])
        previous, steep = t, min(steep, cosine)
    choose_face(cosines, same_wall, opened, count, turned)
    return walls


@njit(cache=True)
def group_faces(interior, start, end, found, cosine, same_wall):
    """Mark further faces of a wall on a leg (n,); return the number of walls.

    `found` (n,) are ordered fractions of the leg, `cosine` (n,) is for incidence. Walls are counted as in `mark_walls`.
    """
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = np.hypot(dx, dy)
    backwards = dx < 0.0 or (dx == 0.0 and dy < 0.0)
    n, walls, begin, first, previous, steep = len(found), 0, 0, 0.0, 0.0, 1.0
    for j in range(n):
        i = n - 1 - j if backwards else j
        t, depth_m = found[i], abs(found[i] - first) * length * min(cosine[i], steep)
        joined = j > 0 and interior.depth_m > 0.0 and depth_m <= interior.depth_m
        if not joined or is_free_between(interior, start, end, min(t, previous), max(t, previous)):
            choose_face(cosine, same_wall, begin, j, backwards)
            walls, begin, first, steep = walls + 1, j, t, 1.0
        previous, steep = t, min(steep, cosine[i])
    choose_face(cosine, same_wall, begin, n, backwards)
    return walls


@njit(cache=True)
def choose_face(cosine, same_wall, begin, end, backwards):
    """Give the loss of a wall to its face with the median angle, as outlines may be ragged.

    The faces are `begin` to `end`, counted from the last one if `backwards`.
    """
    last = len(cosine) - 1
    for j in range(begin, end):
        own, rank = last - j if backwards else j, 0
        for k in range(begin, end):
            other = last - k if backwards else k
            rank += cosine[other] < cosine[own] or (cosine[other] == cosine[own] and k < j)
        same_wall[own] = rank != (end - begin) // 2


@njit(cache=True)
def is_free_between(cells, start, end, first, last):
    """Return whether a leg meets a free cell between two fractions, except cells cut by the faces there."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = np.hypot(dx, dy)
    s, high = first * length + _CUT_CELLS * cells.cell_m, last * length - _CUT_CELLS * cells.cell_m
    while s <= high:
        column, row = int((start[0] + s / length * dx) / cells.cell_m), int((start[1] + s / length * dy) / cells.cell_m)
        if 0 <= row < cells.free.shape[0] and 0 <= column < cells.free.shape[1] and cells.free[row, column]:
            return True
        s += 0.5 * cells.cell_m
    return False


@njit(cache=True)
def are_in_wall(interior, x, y, rays):  # type: ignore[no-untyped-def]
    """Return whether all rays between two from a point stay in one wall from a face to the next.

    The two `rays` are (direction x, y, cosine of incidence at the next face, distances of the two faces).
    """
    left = low = np.inf
    right = high = -np.inf
    for along_x, along_y, cosine, near, far in rays:
        if far < near or (far - near) * cosine > interior.depth_m:
            return False
        for s in (near + interior.cell_m, far - interior.cell_m):
            left, right = min(left, x + s * along_x), max(right, x + s * along_x)
            low, high = min(low, y + s * along_y), max(high, y + s * along_y)
    rows, columns = interior.free.shape
    begin, end = max(int(left / interior.cell_m), 0), min(int(right / interior.cell_m) + 1, columns)
    bottom, top = max(int(low / interior.cell_m), 0), min(int(high / interior.cell_m) + 1, rows)
    if begin >= end or bottom >= top:
        return True
    before = interior.free_before
    return before[top, end] - before[bottom, end] - before[top, begin] + before[bottom, begin] == 0
