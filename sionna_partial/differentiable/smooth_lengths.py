"""Lengths of segments in cells of one kind, smooth in their ends: what derivatives of d_unobs need."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.unobserved import Segment, enter_grid, leave_cells, segment_between
from sionna_partial.process import njit

_BORDER_CELLS = 1e-6
"""Distance within which a segment runs along the border of patches [cells]."""


class SmoothLengths:
    """Length of segments in cells of one kind, smooth in their ends.

    The length that `unobserved_lengths_m` measures is continuous, but its derivatives jump wherever a segment passes
    the corner of a cell. Here the mask of the cells, 1 in cells of the kind and 0 in others, is interpolated bilinearly
    between the centres of cells before it is integrated along the segment. Edges become ramps that are one cell wide.

    For a segment that crosses a straight edge along the axes from side to side, the length is the same. It differs by a
    fraction of a cell where a segment passes a corner or ends within a cell of an edge, and by up to half of the length
    on which it runs along an edge. The first derivatives are continuous, and exact to rounding, except for segments
    that run along a line through the centres of cells, or are upright above one: there they are the mean of both sides.

    Everything outside the grid is unknown. Lengths are those in the cells, also on a complete map.
    """

    def __init__(self, partial: PartialMap, kind: CellState) -> None:
        mask = np.pad(partial.state == kind, 1, constant_values=kind == CellState.UNKNOWN)
        self._mask = mask.astype(np.int8)
        self._even = _even_patches(mask)
        self._first_centre_m = np.array(partial.origin_m) - 0.5 * partial.resolution_m
        self._resolution_m = partial.resolution_m

    def __call__(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the lengths (N,) [m] of segments between (N, 3) or (3,) ends [m]; NaN where an end is."""
        start_m, end_m = np.broadcast_arrays(start_m, end_m)
        return self._integrals(start_m, end_m)[:, 0] * np.linalg.norm(end_m - start_m, axis=1)

    def slopes(self, start_m: Floats, end_m: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives (N, 3) of the lengths with respect to start and end; 0 where the ends coincide."""
        start_m, end_m = np.broadcast_arrays(start_m, end_m)
        integrals, step_m = self._integrals(start_m, end_m), end_m - start_m
        distance_m = np.linalg.norm(step_m, axis=1, keepdims=True)
        stretch = integrals[:, :1] * np.divide(step_m, distance_m, out=np.zeros(step_m.shape), where=distance_m != 0.0)
        start, end = -stretch, stretch
        start[:, :2] += distance_m / self._resolution_m * integrals[:, 1:3]
        end[:, :2] += distance_m / self._resolution_m * integrals[:, 3:5]
        return start, end

    def _integrals(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return what `_fill_integrals` fills in, for segments (N, 3) [m]."""
        starts, ends = ((points[:, :2] - self._first_centre_m) / self._resolution_m for points in (start_m, end_m))
        integrals = np.zeros((len(starts), 5))
        _fill_integrals(self._mask, self._even, starts, ends, integrals)
        return integrals


def _even_patches(mask: Bools) -> NDArray[np.int32]:
    """Return how far the next uneven patch is in every direction, corners included; 0 in uneven patches.

    A patch is what four cell centres enclose, and even if their cells are of one state: there the interpolation is
    constant.
    """
    around = mask[:-1, :-1].astype(np.int8) + mask[:-1, 1:] + mask[1:, :-1] + mask[1:, 1:]
    even = around % 4 == 0
    if even.all():
        return np.full(even.shape, max(even.shape), dtype=np.int32)
    return np.asarray(ndimage.distance_transform_cdt(even, "chessboard"), dtype=np.int32)


@njit(cache=True)
def _fill_integrals(
    mask: NDArray[np.int8], even: NDArray[np.int32], starts: Floats, ends: Floats, integrals: Floats
) -> None:
    """Integrate the interpolated mask u over the parameter t of segments, from 0 at the start to 1 at the end.

    Points (N, 2) are counted in cells from the centre of the first cell of the mask. Zeros in `integrals` (N, 5) become
    the integrals of u, (1 - t) du/dx, (1 - t) du/dy, t du/dx and t du/dy.
    """
    for i in range(len(ends)):
        start_x, start_y, end_x, end_y = starts[i, 0], starts[i, 1], ends[i, 0], ends[i, 1]
        if not np.isfinite(start_x + start_y + end_x + end_y):
            integrals[i] = np.nan
            continue
        aside_x, aside_y = _aside(start_x, end_x), _aside(start_y, end_y)
        if aside_x == 0.0 and aside_y == 0.0:
            _integrate(mask, even, segment_between(start_x, start_y, end_x, end_y), integrals[i])
        else:
            for x in (-aside_x, aside_x):
                for y in (-aside_y, aside_y):
                    segment = segment_between(start_x + x, start_y + y, end_x + x, end_y + y)
                    _integrate(mask, even, segment, integrals[i])
            integrals[i] *= 0.25
        integrals[i, 0] = min(max(integrals[i, 0], 0.0), 1.0)
        integrals[i, 1:3] -= integrals[i, 3:5]


@njit(cache=True)
def _aside(start: float, end: float) -> float:
    """Return how far to step to either side of a border that a segment runs along; 0 if it does not."""
    along = abs(end - start) < _BORDER_CELLS and abs(start - np.round(start)) < _BORDER_CELLS
    return 2.0 * _BORDER_CELLS if along else 0.0


@njit(cache=True)
def _integrate(mask: NDArray[np.int8], even: NDArray[np.int32], segment: Segment, sums: Floats) -> None:
    """Add the integrals of u, du/dx, du/dy, t du/dx and t du/dy along a segment to `sums` (5,)."""
    ny, nx = even.shape
    here, leave, line_x, line_y = enter_grid(segment, ny, nx)
    sums[0] += mask[0, 0] * (1.0 - max(0.0, leave - here))
    while here < leave:
        column = line_x - 1 if segment.step_x > 0.0 else line_x
        row = line_y - 1 if segment.step_y > 0.0 else line_y
        within = 0 <= row < ny and 0 <= column < nx
        skip = max(0, even[row, column] - 1) if within else 0
        there, line_x, line_y = leave_cells(segment, line_x, line_y, skip, here, leave)
        if not within:
            sums[0] += mask[0, 0] * (there - here)
        elif even[row, column]:
            sums[0] += mask[row, column] * (there - here)
        else:
            _add_patch(mask[row : row + 2, column : column + 2], row, column, segment, here, there, sums)
        here = there


@njit(cache=True)
def _add_patch(
    corners: NDArray[np.int8], row: int, column: int, segment: Segment, here: float, there: float, sums: Floats
) -> None:
    """Add what `_integrate` adds between two fractions of a segment that is in one patch there, by Simpson's rule.

    The integrand is quadratic in t, and the rule exact.
    """
    corner, right, up = corners[0, 0], corners[0, 1], corners[1, 0]
    twist = corners[1, 1] - right - up + corner
    width = there - here
    for t, weight in ((here, width / 6.0), (0.5 * (here + there), width / 1.5), (there, width / 6.0)):
        x, y = segment.x + t * segment.step_x - column, segment.y + t * segment.step_y - row
        slope_x, slope_y = right - corner + twist * y, up - corner + twist * x
        sums[0] += weight * (corner + slope_x * x + (up - corner) * y)
        sums[1] += weight * slope_x
        sums[2] += weight * slope_y
        sums[3] += weight * t * slope_x
        sums[4] += weight * t * slope_y
