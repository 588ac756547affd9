"""Smooth lengths of segments in cells: by hand, against quadrature and finite differences, and by their properties."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from sionna_partial.constants import CellState
from sionna_partial.differentiable import SmoothLengths
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.unobserved import unobserved_lengths_m

FREE, WALL, UNKNOWN = CellState.FREE, CellState.WALL, CellState.UNKNOWN
RESOLUTION_M = 0.25
ORIGIN_M = (3.0, -2.0)


def random_map(seed, shape=(12, 20)):
    """Return a map of random cells."""
    return PartialMap(np.random.default_rng(seed).integers(0, 3, shape), RESOLUTION_M, ORIGIN_M)


def interpolated(partial, kind):
    """Return the bilinear interpolation of the mask as a function of positions (..., 2) [m], by SciPy."""
    mask = np.pad((partial.state == kind).astype(float), 1, constant_values=float(kind == UNKNOWN))
    middles_m = [
        start + (np.arange(size) - 0.5) * partial.resolution_m
        for start, size in zip(partial.origin_m, mask.shape[::-1], strict=True)
    ]
    return RegularGridInterpolator(middles_m, mask.T, bounds_error=False, fill_value=mask[0, 0])


def quadrature(partial, kind, start_m, end_m, points):
    """Return lengths (N,) by the midpoint rule."""
    look_up = interpolated(partial, kind)
    t = ((np.arange(points) + 0.5) / points)[:, None]
    means = [look_up(start + t * (end - start)).mean() for start, end in zip(start_m[:, :2], end_m[:, :2], strict=True)]
    return np.array(means) * np.linalg.norm(end_m - start_m, axis=1)


def differences(smooth, start_m, end_m, step_m):
    """Return central finite differences of the lengths with respect to both ends, (N, 3) each."""
    start, end = np.empty(start_m.shape), np.empty(end_m.shape)
    for axis, shift_m in enumerate(step_m * np.eye(3)):
        start[:, axis] = (smooth(start_m + shift_m, end_m) - smooth(start_m - shift_m, end_m)) / (2.0 * step_m)
        end[:, axis] = (smooth(start_m, end_m + shift_m) - smooth(start_m, end_m - shift_m)) / (2.0 * step_m)
    return start, end


class TestLengths:
    @pytest.mark.parametrize("kind", CellState)
    def test_between_zero_and_the_distance(self, kind):
        # Long segments through cells of the kind, between quarters of cells: rounding would exceed 1.
        state = np.random.default_rng(0).choice([kind, (kind + 1) % 3], (12, 20), p=[0.9, 0.1])
        partial = PartialMap(state, RESOLUTION_M, (0.3, -0.7))
        quarters = np.random.default_rng(1).integers(0, 48, (2, 50_000, 3)) / 4
        start_m, end_m = 0.3 + RESOLUTION_M * quarters - [0.0, 1.0, 0.0]
        found_m = SmoothLengths(partial, kind)(start_m, end_m)
        assert (found_m >= 0.0).all()
        assert (found_m <= np.linalg.norm(end_m - start_m, axis=1)).all()


class TestSlopes:
    def test_do_not_jump(self):
        partial, angle = random_map(13), np.linspace(0.1, np.pi / 2 - 0.1, 20_000)
        start_m = np.array([4.4, -1.3, 1.0])
        end_m = start_m + 2.5 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
        slopes = np.concatenate(SmoothLengths(partial, UNKNOWN).slopes(start_m, end_m), axis=1)
        exact = np.gradient(unobserved_lengths_m(partial, start_m, end_m), angle)
        assert np.abs(np.diff(slopes, axis=0)).max() < 0.05
        assert np.abs(np.diff(exact)).max() > 5.0


positions = st.integers(-6, 46).map(lambda quarters: quarters / 4)
"""Coordinates in quarters of a cell: many are on lines through middles of cells or on borders of cells."""


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 20), st.sampled_from(CellState), st.tuples(positions, positions, positions, positions))
def test_segments_between_quarters_of_cells(seed, kind, ends):
    partial = PartialMap(random_map(seed, (10, 10)).state, 1.0)
    smooth, start_m, end_m = SmoothLengths(partial, kind), np.array([[*ends[:2], 1.0]]), np.array([[*ends[2:], 1.5]])
    expected_m = quadrature(partial, kind, start_m, end_m, 4_000)
    np.testing.assert_allclose(smooth(start_m, end_m), expected_m, atol=1e-4)
    np.testing.assert_allclose(smooth.slopes(start_m, end_m), differences(smooth, start_m, end_m, 1e-4), atol=1e-2)
