"""Walls of meshes: the closed bodies that faces bound, and the faces on a line, by the rules of `line.py`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.process import njit
from sionna_partial.tracing.interactions import REFRACTION
from sionna_partial.tracing.line import Slabs, group_faces, is_far_inside, is_free_between
from sionna_partial.tracing.mesh.faces import FaceTree, MeshPlanes
from sionna_partial.tracing.power import Materials


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

    `kind` and `same_wall` are as in `Candidates`, `cosine` is for the angle of incidence, and `at_m` is the length of
    the path to a face.
    """

    face: NDArray[np.int64]
    kind: NDArray[np.uint8]
    same_wall: Bools
    cosine: Floats
    point_m: Floats
    at_m: Floats
    slabs: Slabs

    @classmethod
    def empty(cls, size: int) -> "MetFaces":
        face, kind, same_wall = np.empty(size, np.int64), np.empty(size, np.uint8), np.empty(size, np.bool_)
        return cls(face, kind, same_wall, np.empty(size), np.empty((size, 3)), np.empty(size), Slabs.empty(size))


@njit(cache=True, borrows=True)
def cosine_at(planes, face, dx, dy, dz):
    p = planes.plane[face]
    normal = planes.normal
    return min(abs(normal[p, 0] * dx + normal[p, 1] * dy + normal[p, 2] * dz), 1.0)


@njit(cache=True, borrows=True)
def bound_body(bodies, first, second, dx, dy, dz):
    """Return whether a line in a direction enters a closed body at one face, and leaves it at another."""
    body, outward = bodies.body, bodies.outward
    if body[first] < 0 or body[first] != body[second]:
        return False
    entered = outward[first, 0] * dx + outward[first, 1] * dy + outward[first, 2] * dz < 0.0
    return entered and outward[second, 0] * dx + outward[second, 1] * dy + outward[second, 2] * dz > 0.0


@njit(cache=True, borrows=True)
def is_one_wall(mesh, first, second, a, b, begin, end):
    """Return whether two faces, met in turn at fractions of a line from a to b, may be one wall."""
    if bound_body(mesh.bodies, first, second, b[0] - a[0], b[1] - a[1], b[2] - a[2]):
        return True
    return not is_free_between(mesh.cells, a, b, begin, end)


@njit(cache=True, borrows=True)
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


@njit(cache=True, borrows=True)
def mark_walls(mesh, a, b, count, met, entries, begin):
    """Write the faces on a line from a to b as entries from number `begin`; return the number of walls.

    Walls are counted from the end with smaller coordinates: links are reciprocal.
    """
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    turned = dx < 0.0 or (dx == 0.0 and (dy < 0.0 or (dy == 0.0 and dz < 0.0)))
    for k in range(count):
        entry, face = begin + k, met.face[k]
        entries.face[entry], entries.kind[entry] = face, REFRACTION
        entries.cosine[entry] = cosine_at(mesh.planes, face, dx / length, dy / length, dz / length)
        entries.same_wall[entry] = k > 0 and bound_body(mesh.bodies, met.face[k - 1], face, dx, dy, dz)
        for axis in range(3):
            entries.point_m[entry, axis] = a[axis] + met.at[k] * (b[axis] - a[axis])
    cosine, same_wall = entries.cosine[begin : begin + count], entries.same_wall[begin : begin + count]
    return group_faces(mesh.cells, (a, b, length), met.at[:count], cosine, same_wall, (turned, turned))
