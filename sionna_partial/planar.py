"""Geometry in the plane that maps and traces share."""

import numpy as np
from numpy.typing import NDArray

from sionna_partial.process import njit


def cross(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross products of vectors (..., 2)."""
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


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
