"""Chains of cells -> few straight runs, each a line within a tolerance of its cells."""

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit

RAGGED_FACTOR = 2.0
"""Largest distance of a line from ragged walls, in tolerances."""

_CORNERS = 64

_RESIDUAL_COST = 3.0

_RAGGED_TURNS = 4

_RAGGED_SPACING = 10.0

_LEVEL_CELLS = 1.0

_ALL_LINES = np.array([[-1.05, -3.0], [1.05, -3.0], [1.05, 3.0], [-1.05, 3.0]])
"""Corners (slope, offset) of the polygon of lines that are not steep and pass near the origin."""


def fit_runs(points: Floats, tolerance: float | Floats) -> tuple[NDArray[np.int64], Floats]:
    """Split a polyline (n, 2) [cells] of straight elements into few straight runs.

    A run is allowed if a line passes within `tolerance` [cells], of all elements or of each (n - 1,), of the middle of
    every unit edge, along the axis that the line is steeper against. Ragged polylines, which turn back at least four
    times and once in 10 cells, get `RAGGED_FACTOR` times the tolerance. The split minimises the number of runs plus
    three times their residual variances, in squared mean tolerances. Lines are least-squares within the tolerance, or
    parallel to an axis for ragged runs if that moves their ends by at most half a cell.

    Returns the first corner of every run (r,), and a point x, y and the direction x, y of its line (r, 4).
    """
    upright, lying = np.ascontiguousarray(points[:, ::-1]), np.ascontiguousarray(points)
    tolerances = np.ascontiguousarray(np.broadcast_to(tolerance + 1e-6, len(points) - 1))
    previous, along_y = np.zeros(len(points), np.int64), np.zeros(len(points), np.bool_)
    _find_runs(lying, upright, tolerances, np.full(len(points), np.inf), previous, along_y)
    starts, lines, end = [], [], len(points) - 1
    while end > 0:
        starts.append(int(previous[end]))
        x, y, along, across = _line(upright if along_y[end] else lying, starts[-1], end, tolerances)
        lines.append((y, x, across, along) if along_y[end] else (x, y, along, across))
        end = starts[-1]
    return np.array(starts[::-1], np.int64), np.array(lines[::-1]).reshape(-1, 4)


@njit(cache=True)
def _find_runs(points, swapped, tolerances, cost, previous, along_y):
    cost[0] = 0.0
    for i in range(len(points) - 1):
        if cost[i] + 1.0 < cost[i + 1]:
            cost[i + 1], previous[i + 1] = cost[i] + 1.0, i
            along_y[i + 1] = abs(points[i + 1, 1] - points[i, 1]) > abs(points[i + 1, 0] - points[i, 0])
        _extend(points, tolerances, i, False, cost, previous, along_y)
        _extend(swapped, tolerances, i, True, cost, previous, along_y)


@njit(cache=True)
def _extend(points, tolerances, start, swap, cost, previous, along_y):
    """Lengthen the run from `start` while a line fits; note cheaper splits."""
    near, near_size = _all_lines()
    far, far_size = _all_lines()
    moments, weighted = np.zeros(6), 0.0
    sign, turn, reversals = 0.0, 0.0, 0
    for k in range(start, len(points) - 1):
        ahead, aside = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        if ahead * sign < 0.0:
            return
        sign = ahead if sign == 0.0 else sign
        reversals += int(aside * turn < 0.0)
        turn = aside if aside != 0.0 else turn
        element = _middles(points, start, k)
        near_size = _clip_element(near, near_size, element, tolerances[k])
        far_size = _clip_element(far, far_size, element, RAGGED_FACTOR * tolerances[k])
        if far_size == 0:
            return
        _accumulate(moments, element)
        weighted += element[4] * tolerances[k]
        length = abs(points[k + 1, 0] - points[start, 0])
        if near_size > 0 or (reversals >= _RAGGED_TURNS and reversals * _RAGGED_SPACING >= length):
            tolerance = max(weighted / moments[0], 0.25)
            total = cost[start] + 1.0 + _RESIDUAL_COST * _residual_variance(moments) / tolerance**2
            if total < cost[k + 1] - 1e-12:
                cost[k + 1], previous[k + 1], along_y[k + 1] = total, start, swap


@njit(cache=True)
def _line(points, start, end, tolerances):
    """Return a point and the direction of the line that fits a run."""
    for factor in (1.0, RAGGED_FACTOR):
        moments = np.zeros(6)
        polygon, size = _all_lines()
        for k in range(start, end):
            element = _middles(points, start, k)
            size = _clip_element(polygon, size, element, factor * tolerances[k])
            _accumulate(moments, element)
        ragged = factor > 1.0
        if size > 0:
            break
    mean_x, mean_y = moments[1] / moments[0], moments[2] / moments[0]
    spread = moments[3] - moments[1] * mean_x
    slope = (moments[4] - moments[1] * mean_y) / spread if spread > 1e-9 else 0.0
    if ragged and abs(slope * (points[end, 0] - points[start, 0])) <= _LEVEL_CELLS:
        slope = 0.0
    offset = mean_y - slope * mean_x
    fits = True
    for k in range(start, end):
        x0, y0, x1, y1, _ = _middles(points, start, k)
        limit = RAGGED_FACTOR * tolerances[k] if ragged else tolerances[k]
        fits = fits and max(abs(slope * x0 + offset - y0), abs(slope * x1 + offset - y1)) <= limit
    if size > 0 and not fits:
        slope, offset = 0.0, 0.0
        for k in range(size):
            slope, offset = slope + polygon[k, 0], offset + polygon[k, 1]
        slope, offset = slope / size, offset / size
    x, y, norm = points[start, 0] + mean_x, points[start, 1] + slope * mean_x + offset, np.sqrt(1.0 + slope * slope)
    return x, y, 1.0 / norm, slope / norm


@njit(cache=True)
def _clip_element(polygon, size, element, tolerance):
    x0, y0, x1, y1, steps = element
    if size > 0:
        size = _clip(polygon, size, x0, y0, tolerance)
    if size > 0 and steps > 1:
        size = _clip(polygon, size, x1, y1, tolerance)
    return size


@njit(cache=True)
def _middles(points, origin, k):
    x, y = points[k, 0] - points[origin, 0], points[k, 1] - points[origin, 1]
    dx, dy = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
    a, b = abs(round(dx)), abs(round(dy))
    while b > 0:
        a, b = b, a % b
    steps = max(a, 1)
    half_x, half_y = 0.5 * dx / steps, 0.5 * dy / steps
    return x + half_x, y + half_y, x + dx - half_x, y + dy - half_y, steps


@njit(cache=True)
def _accumulate(moments, element):
    """Add the middles of unit edges to the moments: sums of 1, x, y, xx, xy, yy."""
    x0, y0, x1, y1, steps = element
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    spread = (steps + 1.0) / (12.0 * (steps - 1.0)) if steps > 1 else 0.0
    dx, dy = x1 - x0, y1 - y0
    moments[0] += steps
    moments[1] += steps * x
    moments[2] += steps * y
    moments[3] += steps * (x * x + spread * dx * dx)
    moments[4] += steps * (x * y + spread * dx * dy)
    moments[5] += steps * (y * y + spread * dy * dy)


@njit(cache=True)
def _residual_variance(moments):
    mean_x, mean_y = moments[1] / moments[0], moments[2] / moments[0]
    xx = moments[3] / moments[0] - mean_x * mean_x
    xy = moments[4] / moments[0] - mean_x * mean_y
    yy = moments[5] / moments[0] - mean_y * mean_y
    return max(0.0, 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)))


@njit(cache=True)
def _all_lines():
    polygon = np.empty((_CORNERS, 2))
    for k in range(len(_ALL_LINES)):
        polygon[k, 0], polygon[k, 1] = _ALL_LINES[k, 0], _ALL_LINES[k, 1]
    return polygon, len(_ALL_LINES)


@njit(cache=True)
def _clip(polygon, size, x, y, tolerance):
    """Keep the lines that pass (x, y) within the tolerance along y; return the number of corners left."""
    kept = np.empty((_CORNERS, 2))
    for side in (1.0, -1.0):
        count = 0
        for k in range(size):
            slope, offset = polygon[k, 0], polygon[k, 1]
            next_slope, next_offset = polygon[(k + 1) % size, 0], polygon[(k + 1) % size, 1]
            inside = tolerance - side * (slope * x + offset - y)
            next_inside = tolerance - side * (next_slope * x + next_offset - y)
            if inside >= 0.0:
                kept[count, 0], kept[count, 1] = slope, offset
                count += 1
            if inside * next_inside < 0.0:
                fraction = inside / (inside - next_inside)
                kept[count, 0] = slope + (next_slope - slope) * fraction
                kept[count, 1] = offset + (next_offset - offset) * fraction
                count += 1
            if count > _CORNERS - 2:
                return 0
        size = count
        for k in range(size):
            polygon[k, 0], polygon[k, 1] = kept[k, 0], kept[k, 1]
    return size
