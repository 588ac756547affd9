"""Rules for a path wherever it runs, in floor plans and meshes: faces that are one wall, legs, and power.

A path is a sequence of straight legs; docs/physics.md, One wall, has the rule for the faces on a leg:

    tx ----|#####|----------|##|-----|------ rx      faces at fractions of the leg: two of a thick wall,
           0     1          2  3     4               two of a thinner wall, and one of a wall seen from one side
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit
from sionna_partial.tracing.paths import SHORTEST_LEG_M
from sionna_partial.tracing.power import at_slab, received_power, vertical_field

_PARALLEL = 0.5
"""Smallest cosine of the angle between parallel faces."""

_CUT_CELLS = 1.25
"""Largest distance of a face from the cells of its wall [cells]."""


@njit(cache=True, borrows=True)
def is_as_deep(apart_m, cosine, depth_m):
    """Return whether two faces, so far apart along a line with a cosine of incidence, may be one wall."""
    return depth_m > 0.0 and apart_m * cosine <= depth_m


@njit(cache=True, borrows=True)
def are_parallel(turn):
    return abs(turn) >= _PARALLEL


@njit(cache=True, borrows=True)
def is_far_inside(cells, turn, distance_m):
    """Return whether a face, at a turn and distance from a crossed face, is not in a corner with it."""
    return are_parallel(turn) or distance_m > 0.5 * cells.depth_m


@njit(cache=True, borrows=True)
def reflects_inside(before, after):
    """Return whether a face reflects a path in a wall.

    `before` and `after` are for the legs beside it: whether it is in one wall, and as in `is_far_inside`.
    """
    return (before[0] and (before[1] or after[0])) or (after[0] and after[1])


@njit(cache=True, borrows=True)
def group_faces(cells, leg, at, cosine, same_wall, order):
    """Mark further faces of each wall on a leg; return the number of walls.

    `leg` is (start, end, length [m]). Of n faces, `at` (n,) are ordered fractions of the leg, and `cosine` (n,) is for
    incidence. `same_wall` (n,) enters as True where a face and the one before bound a closed body, and leaves as in
    `Candidates`. `order` is whether faces are counted from the end, as links are reciprocal, and whether free cells
    are sampled from there.
    """
    (start, end, length), (backwards, mirrored) = leg, order
    n, walls, begin, first, previous, steep = len(at), 0, 0, 0.0, 0.0, 1.0
    for j in range(n):
        i = n - 1 - j if backwards else j
        t = 1.0 - at[i] if mirrored else at[i]
        joined = j > 0 and is_as_deep(abs(t - first) * length, min(cosine[i], steep), cells.depth_m)
        if joined and not same_wall[i + 1 if backwards else i]:
            low, high = min(t, previous), max(t, previous)
            if mirrored:
                joined = not is_free_between(cells, end, start, low, high)
            else:
                joined = not is_free_between(cells, start, end, low, high)
        if not joined:
            _choose_face(cosine, same_wall, begin, j, backwards)
            walls, begin, first, steep = walls + 1, j, t, 1.0
        previous, steep = t, min(steep, cosine[i])
    _choose_face(cosine, same_wall, begin, n, backwards)
    return walls


@njit(cache=True, borrows=True)
def _choose_face(cosine, same_wall, begin, end, backwards):
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


@njit(cache=True, borrows=True)
def is_free_between(cells, start, end, first, last):
    """Return whether a leg crosses a free cell between two of its fractions.

    Cells near the fractions do not count: the faces there cut them.
    """
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = np.hypot(dx, dy)
    s, high = first * length + _CUT_CELLS * cells.cell_m, last * length - _CUT_CELLS * cells.cell_m
    while s <= high:
        column, row = int((start[0] + s / length * dx) / cells.cell_m), int((start[1] + s / length * dy) / cells.cell_m)
        if 0 <= row < cells.free.shape[0] and 0 <= column < cells.free.shape[1] and cells.free[row, column]:
            return True
        s += 0.5 * cells.cell_m
    return False


@njit(cache=True, borrows=True)
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


@njit(cache=True, borrows=True)
def has_long_legs(at, count, end, unit_m):
    """Return whether no leg is too short; `at` are positions along a path of `count` interactions, up to `end`."""
    previous = 0.0
    for k in range(count):
        if (at[k] - previous) * unit_m < SHORTEST_LEG_M:
            return False
        previous = at[k]
    return (end - previous) * unit_m >= SHORTEST_LEG_M


class Slabs(NamedTuple):
    """Scratch of one path: the slabs that change its field, in order from the transmitter.

    They have unit normals `normal` (E, 3), materials `material` (E,) and kinds of interaction `kind` (E,).
    """

    normal: Floats
    material: NDArray[np.int64]
    kind: NDArray[np.int64]

    @classmethod
    def empty(cls, size: int) -> "Slabs":
        return cls(np.empty((size, 3)), np.empty(size, np.int64), np.empty(size, np.int64))


@njit(cache=True, borrows=True)
def add_slab(slabs, count, normal, material, kind):
    slabs.normal[count, 0], slabs.normal[count, 1], slabs.normal[count, 2] = normal
    slabs.material[count], slabs.kind[count] = material, kind
    return count + 1


@njit(cache=True, borrows=True)
def jones_power(k, length_m, slabs, count, materials):
    """Return the power of a path between vertical isotropic antennas, which leaves in direction k, after slabs."""
    e = vertical_field(k)
    for i in range(count):
        normal = slabs.normal[i, 0], slabs.normal[i, 1], slabs.normal[i, 2]
        k, e = at_slab(k, e, normal, materials, slabs.material[i], slabs.kind[i])
    return (materials.wavelength_m / (4.0 * np.pi * length_m)) ** 2 * received_power(k, e)
