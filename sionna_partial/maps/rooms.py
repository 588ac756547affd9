"""Rooms of a floor plan, and the openings between them, at any scale."""

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats
from sionna_partial.process import njit

MAX_ROOM_CELLS = 1_000_000
"""Number of cells above which a plan is coarsened before rooms are counted."""

OPENING_RATIO = 0.65
"""Largest width of an opening, as a fraction of the widest circle in the smaller of the rooms that it joins."""

SMALLEST_RADIUS_CELLS = 4.0
"""Radius of the widest circle in the smallest room [cells]."""


class Rooms(NamedTuple):
    """Number of rooms, and the widths [m] of the widest openings that join them, one for each room that is joined."""

    number: int
    openings_m: Floats


def rooms_of(free: Bools, resolution_m: float) -> Rooms:
    """Find rooms and openings among the free cells (ny, nx) of a plan.

    Cells are visited in the order of their distance from walls. An opening is where two areas meet that are both wider
    than it.
    """
    factor = math.ceil(math.sqrt(free.size / MAX_ROOM_CELLS))
    if factor > 1:
        shape = [size // factor * factor for size in free.shape]
        blocks = free[: shape[0], : shape[1]].reshape(shape[0] // factor, factor, shape[1] // factor, factor)
        free = np.asarray(blocks.all(axis=(1, 3)))
    clearance = ndimage.distance_transform_edt(np.pad(free, 1)).astype(np.float32)
    inside = np.flatnonzero(clearance)
    order = inside[np.argsort(-clearance.ravel()[inside], kind="stable")]
    openings, areas = _join(clearance.ravel(), order, clearance.shape[1], OPENING_RATIO, SMALLEST_RADIUS_CELLS)
    return Rooms(areas + len(openings), np.sort((2.0 * openings - 1.0) * resolution_m * factor))


@njit(cache=True)
def _join(clearance, order, nx, ratio, smallest):  # type: ignore[no-untyped-def]
    """Join cells in falling order of clearance; return the clearances of openings, and the number of areas."""
    parent = np.full(len(clearance), -1)
    openings, count, areas = np.zeros(len(order)), 0, 0
    for cell in order:
        parent[cell] = root = cell
        for neighbour in (cell - nx, cell - 1, cell + 1, cell + nx):
            other = neighbour
            if parent[other] < 0:
                continue
            while parent[other] != other:
                parent[other] = parent[parent[other]]
                other = parent[other]
            if other == root:
                continue
            high, low = (root, other) if clearance[root] >= clearance[other] else (other, root)
            if clearance[low] >= smallest and clearance[cell] <= ratio * clearance[low]:
                openings[count] = clearance[cell]
                count += 1
            parent[low] = root = high
    for cell in order:
        areas += parent[cell] == cell and clearance[cell] >= smallest
    return openings[:count].copy(), areas
