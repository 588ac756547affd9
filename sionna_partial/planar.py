"""Geometry in the plane that several rooms share."""

import math

import numpy as np
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.process import njit


def cross(first: Floats, second: Floats) -> Floats:
    """Cross products of vectors (..., 2)."""
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def largest_part(mask: Bools) -> Bools:
    """Cells (ny, nx) of the largest part of a mask whose cells touch by edges."""
    labels, _ = ndimage.label(mask)
    return mask & (labels == np.argmax(np.bincount(labels[mask], minlength=1)))


def largest_by_area(values: Floats, area: Indices, count: int) -> Floats:
    """Return the largest value in each of the areas 0 to `count`, which `area` numbers. Faster than ndimage.maximum."""
    largest = np.zeros(count + 1)
    np.maximum.at(largest, area.ravel(), values.ravel())
    return largest


def grid_edges(cost: Floats) -> tuple[Indices, Floats]:
    """Pairs of neighbouring cells (2, E) of a grid, in eight directions, and what a step from one to the other costs.

    A cell that costs 0 cannot be crossed, nor can the corner at which two such cells meet (skimage's MCP would take
    that corner).
    """
    cell, (ny, nx), passable = np.arange(cost.size).reshape(cost.shape), cost.shape, cost > 0
    ends, costs = [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, ny - down), slice(max(0, -right), nx - max(0, right))
        there = slice(down, ny), slice(max(0, right), nx + min(0, right))
        beside = passable[here[0], there[1]] | passable[there[0], here[1]]
        linked = passable[here] & passable[there] & beside
        ends.append([cell[here][linked], cell[there][linked]])
        costs.append(math.hypot(down, right) * (cost[here][linked] + cost[there][linked]) / 2)
    return np.concatenate(ends, axis=1), np.concatenate(costs)


@njit(cache=True)
def span_in_strip(corners, low, high):  # type: ignore[no-untyped-def]
    """Smallest and largest x of a convex polygon (n, 2) within the strip low <= y <= high; inf and -inf if outside."""
    left, right = np.inf, -np.inf
    for here in range(len(corners)):
        x, y = corners[here, 0], corners[here, 1]
        next_x, next_y = corners[(here + 1) % len(corners), 0], corners[(here + 1) % len(corners), 1]
        if low <= y <= high:
            left, right = min(left, x), max(right, x)
        for level in (low, high):
            if (y - level) * (next_y - level) < 0.0:
                at = x + (level - y) / (next_y - y) * (next_x - x)
                left, right = min(left, at), max(right, at)
    return left, right
