"""All faces of a mesh that a line meets, in order: one of each plane."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit

MOST_FACES = 64
"""Most faces that a line may meet: those beyond are left out."""

_LEAF = 4
"""Largest number of faces in a box that is not divided further."""

_INSIDE = 1e-9
"""Part of a face by which a line may miss it: neighbours leave no gap."""


class FaceTree(NamedTuple):
    """F faces in a tree of K boxes; box 0 holds all.

    Box k holds the part `start` to `stop` of the faces in `order` (F,), whose corners are `corner_m` (F, 3, 3) in that
    order, and `child` is the first of the two boxes in it, or -1. `low_m`, `high_m` (K, 3) are the corners of the
    boxes. `plane` (F,) is that of each face, counted as the mesh counts them.
    """

    order: NDArray[np.int64]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    child: NDArray[np.int64]
    low_m: Floats
    high_m: Floats
    corner_m: Floats
    plane: NDArray[np.int32]


def face_tree(corner_m: Floats, plane: NDArray[np.int32]) -> FaceTree:
    """Sort faces with corners (F, 3, 3) [m], each of one of some planes (F,), into boxes."""
    order, start, stop, child, low_m, high_m = _divide(corner_m)
    return FaceTree(order, start, stop, child, low_m, high_m, corner_m[order], plane)


@njit(cache=True)
def _divide(corner):  # type: ignore[no-untyped-def]
    """Divide faces into boxes, each time at the median of their middles along the longest side."""
    count = len(corner)
    size = 4 * (count // _LEAF + 1)
    order, middle = np.arange(count), np.empty((count, 3))
    for f in range(count):
        for axis in range(3):
            middle[f, axis] = corner[f, :, axis].min() + corner[f, :, axis].max()
    start, stop, child = np.zeros(size, np.int64), np.zeros(size, np.int64), np.full(size, -1, np.int64)
    low, high = np.full((size, 3), np.inf), np.full((size, 3), -np.inf)
    stop[0], boxes, box = count, 1, 0
    while box < boxes:
        longest, spread = 0, -1.0
        for axis in range(3):
            least, most = np.inf, -np.inf
            for k in range(start[box], stop[box]):
                low[box, axis] = min(low[box, axis], corner[order[k], :, axis].min())
                high[box, axis] = max(high[box, axis], corner[order[k], :, axis].max())
                least, most = min(least, middle[order[k], axis]), max(most, middle[order[k], axis])
            if most - least > spread:
                longest, spread = axis, most - least
        if stop[box] - start[box] > _LEAF:
            inside = order[start[box] : stop[box]].copy()
            order[start[box] : stop[box]] = inside[np.argsort(middle[inside, longest], kind="mergesort")]
            half = (start[box] + stop[box]) // 2
            start[boxes], stop[boxes], start[boxes + 1], stop[boxes + 1] = start[box], half, half, stop[box]
            child[box] = boxes
            boxes += 2
        box += 1
    return order, start[:boxes], stop[:boxes], child[:boxes], low[:boxes], high[:boxes]


class Met(NamedTuple):
    """Scratch of one line: the faces that it meets, and at which fraction of its length."""

    face: NDArray[np.int64]
    at: Floats
    stack: NDArray[np.int64]


@njit(cache=True)
def scratch():  # type: ignore[no-untyped-def]
    """Make room for one line."""
    return Met(np.empty(MOST_FACES, np.int64), np.empty(MOST_FACES), np.empty(128, np.int64))


@njit(cache=True)
def faces_between(tree, a, b, own, other, met):  # type: ignore[no-untyped-def]
    """Write the faces between two points, but those in the planes `own` and `other`, and return their number.

    Of several faces in one plane there is one.
    """
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ix = 1.0 / dx if dx != 0.0 else 1e300
    iy = 1.0 / dy if dy != 0.0 else 1e300
    iz = 1.0 / dz if dz != 0.0 else 1e300
    count, top = 0, 1
    met.stack[0] = 0
    while top > 0:
        top -= 1
        box = met.stack[top]
        x0, x1 = (tree.low_m[box, 0] - 1e-6 - a[0]) * ix, (tree.high_m[box, 0] + 1e-6 - a[0]) * ix
        y0, y1 = (tree.low_m[box, 1] - 1e-6 - a[1]) * iy, (tree.high_m[box, 1] + 1e-6 - a[1]) * iy
        z0, z1 = (tree.low_m[box, 2] - 1e-6 - a[2]) * iz, (tree.high_m[box, 2] + 1e-6 - a[2]) * iz
        first = max(min(x0, x1), min(y0, y1), min(z0, z1), 0.0)
        if first > min(max(x0, x1), max(y0, y1), max(z0, z1), 1.0):
            continue
        if tree.child[box] >= 0:
            met.stack[top], met.stack[top + 1] = tree.child[box], tree.child[box] + 1
            top += 2
            continue
        for k in range(tree.start[box], tree.stop[box]):
            t = _meets(tree.corner_m[k], a, dx, dy, dz)
            if 0.0 < t < 1.0:
                count = _insert(tree.order[k], t, tree.plane, own, other, met, count)
    return count


@njit(cache=True)
def _meets(corner, a, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Fraction of a line from a point at which it meets a triangle, or -1 (Moeller and Trumbore 1997)."""
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


@njit(cache=True)
def _insert(face, t, plane, own, other, met, count):  # type: ignore[no-untyped-def]
    """Add a face, sorted, unless one of its plane is there or it is in an excluded plane; the new number of faces."""
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
