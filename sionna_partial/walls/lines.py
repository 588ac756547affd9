"""Chains of lattice edges -> runs that a straight line fits within a tolerance."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

_CORNERS = 64
_RESIDUAL_COST = 16.0
_STEEPEST = 1.05


def fit_runs(points: NDArray[np.float64], tolerance: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Split a polyline of straight elements into few straight runs.

    A run is allowed if one line passes within `tolerance` of the middle of every unit edge, measured along x or y
    (whichever the line is steeper against). The middles of the steps of a digital straight line, 4- or 8-connected,
    lie within half a cell of the line that it samples. The split minimises the number of runs plus eight times
    their residual variances [cells^2]; a line is the least-squares one where that keeps the tolerance.

    Parameters
    ----------
    points : (n, 2) float64 array
        Corners of the polyline [cells].
    tolerance : float
        Largest deviation [cells].

    Returns
    -------
    starts : (r,) int64 array
        Index of the corner where every run begins.
    lines : (r, 4) float64 array
        Point x, y on and direction x, y of every run's line.
    """
    start, swap = _best_split(points, tolerance + 1e-6)
    lines = np.empty((len(start), 4))
    for k in range(len(start)):
        end = start[k + 1] if k + 1 < len(start) else len(points) - 1
        lines[k] = _line(points[start[k] : end + 1], tolerance + 1e-6, bool(swap[k]))
    return start, lines


@njit(cache=True)
def _best_split(points, tolerance):  # type: ignore[no-untyped-def]
    """Find the starts of the cheapest runs, and whether each runs along y rather than x, by dynamic programming."""
    n = len(points)
    cost = np.full(n, np.inf)
    cost[0] = 0.0
    previous = np.zeros(n, np.int64)
    along_y = np.zeros(n, np.bool_)
    for i in range(n - 1):
        if cost[i] + 1.0 < cost[i + 1]:
            cost[i + 1], previous[i + 1] = cost[i] + 1.0, i
            along_y[i + 1] = abs(points[i + 1, 1] - points[i, 1]) > abs(points[i + 1, 0] - points[i, 0])
        for swap in (False, True):
            _extend(points, tolerance, i, swap, cost, previous, along_y)
    count, k = 0, n - 1
    while k > 0:
        count, k = count + 1, previous[k]
    starts, swaps = np.empty(count, np.int64), np.empty(count, np.bool_)
    k = n - 1
    for r in range(count - 1, -1, -1):
        starts[r], swaps[r] = previous[k], along_y[k]
        k = previous[k]
    return starts, swaps


@njit(cache=True)
def _extend(points, tolerance, start, swap, cost, previous, along_y):  # type: ignore[no-untyped-def]
    """Lengthen the run that begins at `start` while a line fits, and note where that makes a split cheaper."""
    polygon, size = _all_lines()
    sums = np.zeros(6)
    sign = 0.0
    for k in range(start, len(points) - 1):
        x0, y0, x1, y1, steps = _middles(points, start, k, swap)
        ahead = x1 - x0 if steps > 1 else points[k + 1, int(swap)] - points[k, int(swap)]
        if ahead * sign < 0.0:
            return
        sign = ahead if sign == 0.0 else sign
        size = _clip(polygon, size, x0, y0, tolerance)
        if steps > 1:
            size = _clip(polygon, size, x1, y1, tolerance)
        if size == 0:
            return
        _accumulate(sums, x0, y0, x1, y1, steps)
        total = cost[start] + 1.0 + _RESIDUAL_COST * _residual_variance(sums)
        if total < cost[k + 1] - 1e-12:
            cost[k + 1], previous[k + 1], along_y[k + 1] = total, start, swap


@njit(cache=True)
def _line(points, tolerance, swap):  # type: ignore[no-untyped-def]
    """Point on and direction of the line that fits a run."""
    polygon, size = _all_lines()
    sums = np.zeros(6)
    for k in range(len(points) - 1):
        x0, y0, x1, y1, steps = _middles(points, 0, k, swap)
        size = _clip(polygon, size, x0, y0, tolerance)
        size = _clip(polygon, size, x1, y1, tolerance)
        _accumulate(sums, x0, y0, x1, y1, steps)
    mean_x, mean_y = sums[1] / sums[0], sums[2] / sums[0]
    spread = sums[3] - sums[1] * mean_x
    slope = (sums[4] - sums[1] * mean_y) / spread if spread > 1e-9 else 0.0
    offset = mean_y - slope * mean_x
    if size > 0 and not _fits(points, tolerance, swap, slope, offset):
        slope, offset = polygon[:size, 0].mean(), polygon[:size, 1].mean()
    x, y = points[0, int(swap)] + mean_x, points[0, 1 - int(swap)] + slope * mean_x + offset
    norm = np.sqrt(1.0 + slope * slope)
    if swap:
        return np.array([y, x, slope / norm, 1.0 / norm])
    return np.array([x, y, 1.0 / norm, slope / norm])


@njit(cache=True)
def _fits(points, tolerance, swap, slope, offset):  # type: ignore[no-untyped-def]
    for k in range(len(points) - 1):
        x0, y0, x1, y1, _ = _middles(points, 0, k, swap)
        if max(abs(slope * x0 + offset - y0), abs(slope * x1 + offset - y1)) > tolerance:
            return False
    return True


@njit(cache=True)
def _middles(points, origin, k, swap):  # type: ignore[no-untyped-def]
    """Middles of the first and last unit edge of element k, relative to a corner, and the number of edges."""
    i, j = int(swap), 1 - int(swap)
    x, y = points[k, i] - points[origin, i], points[k, j] - points[origin, j]
    dx, dy = points[k + 1, i] - points[k, i], points[k + 1, j] - points[k, j]
    a, b = abs(round(dx)), abs(round(dy))
    while b > 0:
        a, b = b, a % b
    steps = max(a, 1)
    half_x, half_y = 0.5 * dx / steps, 0.5 * dy / steps
    return x + half_x, y + half_y, x + dx - half_x, y + dy - half_y, steps


@njit(cache=True)
def _accumulate(sums, x0, y0, x1, y1, steps):  # type: ignore[no-untyped-def]
    """Add `steps` equally spaced points to the sums of 1, x, y, xx, xy, yy."""
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    spread = (steps + 1.0) / (12.0 * (steps - 1.0)) if steps > 1 else 0.0
    dx, dy = x1 - x0, y1 - y0
    sums[0] += steps
    sums[1] += steps * x
    sums[2] += steps * y
    sums[3] += steps * (x * x + spread * dx * dx)
    sums[4] += steps * (x * y + spread * dx * dy)
    sums[5] += steps * (y * y + spread * dy * dy)


@njit(cache=True)
def _residual_variance(sums):  # type: ignore[no-untyped-def]
    """Mean squared distance from the best line: the smaller eigenvalue of the covariance."""
    mean_x, mean_y = sums[1] / sums[0], sums[2] / sums[0]
    xx = sums[3] / sums[0] - mean_x * mean_x
    xy = sums[4] / sums[0] - mean_x * mean_y
    yy = sums[5] / sums[0] - mean_y * mean_y
    return max(0.0, 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)))


@njit(cache=True)
def _all_lines():  # type: ignore[no-untyped-def]
    """Corners (slope, offset) of the polygon of lines that are not steep and pass near the origin."""
    polygon = np.zeros((_CORNERS, 2))
    polygon[0], polygon[1] = (-_STEEPEST, -3.0), (_STEEPEST, -3.0)
    polygon[2], polygon[3] = (_STEEPEST, 3.0), (-_STEEPEST, 3.0)
    return polygon, 4


@njit(cache=True)
def _clip(polygon, size, x, y, tolerance):  # type: ignore[no-untyped-def]
    """Keep the lines that pass (x, y) within the tolerance along y; return the number of corners left."""
    kept = np.empty((_CORNERS, 2))
    for side in (1.0, -1.0):
        count = 0
        for k in range(size):
            a, b = polygon[k], polygon[(k + 1) % size]
            inside_a = tolerance - side * (a[0] * x + a[1] - y)
            inside_b = tolerance - side * (b[0] * x + b[1] - y)
            if inside_a >= 0.0:
                kept[count] = a
                count += 1
            if inside_a * inside_b < 0.0:
                kept[count] = a + (b - a) * (inside_a / (inside_a - inside_b))
                count += 1
            if count > _CORNERS - 2:
                return 0
        size = count
        polygon[:size] = kept[:size]
    return size
