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
HALF_M = RESOLUTION_M / 2
ORIGIN_M = (3.0, -2.0)


def random_map(seed=0, shape=(12, 20), block=1, resolution_m=RESOLUTION_M):
    """Return a map of random blocks of cells."""
    blocks = np.random.default_rng(seed).integers(0, 3, shape)
    return PartialMap(np.kron(blocks, np.ones((block, block), dtype=int)), resolution_m, ORIGIN_M)


def ends_around(partial, count, seed=0, margin_m=1.0):
    """Return random ends (count, 3) twice, some of them outside the map."""
    x0, y0, x1, y1 = partial.bounds_m
    low, high = (x0 - margin_m, y0 - margin_m, 0.2), (x1 + margin_m, y1 + margin_m, 2.8)
    start_m, end_m = np.random.default_rng(seed).uniform(low, high, (2, count, 3))
    return start_m, end_m


def half_plane(edge_m=5.0):
    """Return a free room that is unknown from x = edge_m on, wide enough for the ends of what is measured."""
    state = np.full((40, 40), FREE)
    state[:, round(edge_m / RESOLUTION_M) :] = UNKNOWN
    return PartialMap(state, RESOLUTION_M)


def interpolated(partial, kind):
    """Return the bilinear interpolation of the mask as a function of positions (..., 2) [m], by SciPy."""
    mask = np.pad((partial.state == kind).astype(float), 1, constant_values=float(kind == UNKNOWN))
    middles_m = [
        start + (np.arange(size) - 0.5) * partial.resolution_m
        for start, size in zip(partial.origin_m, mask.shape[::-1], strict=True)
    ]
    return RegularGridInterpolator(middles_m, mask.T, bounds_error=False, fill_value=mask[0, 0])


def quadrature(partial, kind, start_m, end_m, points=20_000):
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
    def test_what_a_complete_map_has_not_seen(self):
        partial = PartialMap(np.pad([[FREE]], 1, constant_values=WALL), RESOLUTION_M, ORIGIN_M)
        assert partial.is_complete
        ends_m = np.array([[100.0, 0.0, 1.0]]), np.array([[102.0, 0.0, 1.0]])
        assert SmoothLengths(partial, UNKNOWN)(*ends_m).tolist() == [2.0]

    def test_half_plane_by_hand(self):
        partial = half_plane(5.0)
        smooth = SmoothLengths(partial, UNKNOWN)
        start_m, end_m = np.array([[2.0, 3.0, 1.0]]), np.array([[8.0, 6.5, 2.0]])
        np.testing.assert_allclose(smooth(start_m, end_m), np.linalg.norm(end_m - start_m, axis=1) / 2, rtol=1e-12)
        into_m = np.linspace(-0.5, 0.5, 21) * RESOLUTION_M
        ends_m = np.column_stack([5.0 + into_m, np.full(21, 3.0), np.full(21, 1.0)])
        ramp_m = (into_m + HALF_M) ** 2 / (2 * RESOLUTION_M)
        np.testing.assert_allclose(smooth(np.array([2.0, 3.0, 1.0]), ends_m), ramp_m, atol=1e-12)

    def test_upright_segment_by_hand(self):
        smooth = SmoothLengths(half_plane(5.0), UNKNOWN)
        x_m = 5.0 + np.array([-0.5, -0.25, 0.0, 0.25, 0.5]) * RESOLUTION_M
        low_m = np.column_stack([x_m, np.full(5, 3.0), np.full(5, 0.5)])
        np.testing.assert_allclose(smooth(low_m, np.add(low_m, (0.0, 0.0, 2.0))), [0.0, 0.5, 1.0, 1.5, 2.0], atol=1e-5)

    @pytest.mark.parametrize("block", [1, 3, 9])
    @pytest.mark.parametrize("kind", CellState)
    def test_agree_with_quadrature(self, kind, block):
        partial = random_map(block=block, resolution_m=RESOLUTION_M / block)
        start_m, end_m = ends_around(partial, 60)
        expected_m = quadrature(partial, kind, start_m, end_m)
        np.testing.assert_allclose(SmoothLengths(partial, kind)(start_m, end_m), expected_m, atol=1e-6)

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

    def test_not_a_number(self):
        smooth = SmoothLengths(random_map(), UNKNOWN)
        start_m, end_m = np.full((3, 3), 1.0), np.full((3, 3), 2.0)
        start_m[[0, 1], [0, 2]] = np.nan
        assert np.isnan(smooth(start_m, end_m)).tolist() == [True, True, False]
        assert np.isnan(smooth.slopes(start_m, end_m)[1]).any(axis=1).tolist() == [True, True, False]


class TestSlopes:
    @pytest.mark.parametrize("kind", CellState)
    def test_agree_with_finite_differences(self, kind):
        partial = random_map(10)
        start_m, end_m = ends_around(partial, 1_000)
        smooth = SmoothLengths(partial, kind)
        found, expected = smooth.slopes(start_m, end_m), differences(smooth, start_m, end_m, 1e-5)
        error = np.abs(np.subtract(found, expected)).max(axis=(0, 2))
        assert np.quantile(error, 0.9) < 1e-7
        assert error.max() < 1e-5

    def test_do_not_jump(self):
        partial, angle = random_map(13), np.linspace(0.1, np.pi / 2 - 0.1, 20_000)
        start_m = np.array([4.4, -1.3, 1.0])
        end_m = start_m + 2.5 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
        slopes = np.concatenate(SmoothLengths(partial, UNKNOWN).slopes(start_m, end_m), axis=1)
        exact = np.gradient(unobserved_lengths_m(partial, start_m, end_m), angle)
        assert np.abs(np.diff(slopes, axis=0)).max() < 0.05
        assert np.abs(np.diff(exact)).max() > 5.0

    def test_coinciding_ends(self):
        partial = random_map(14)
        places_m, _ = ends_around(partial, 100)
        smooth = SmoothLengths(partial, UNKNOWN)
        assert not smooth(places_m, places_m).any()
        assert not np.any(smooth.slopes(places_m, places_m))


positions = st.integers(-6, 46).map(lambda quarters: quarters / 4)
"""Coordinates in quarters of a cell: many are on lines through middles of cells or on borders of cells."""


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 20), st.tuples(positions, positions, positions, positions))
def test_segments_between_quarters_of_cells(seed, ends):
    partial = PartialMap(random_map(seed, (10, 10)).state, 1.0)
    smooth, start_m, end_m = SmoothLengths(partial, WALL), np.array([[*ends[:2], 1.0]]), np.array([[*ends[2:], 1.5]])
    expected_m = quadrature(partial, WALL, start_m, end_m, 4_000)
    np.testing.assert_allclose(smooth(start_m, end_m), expected_m, atol=1e-4)
    np.testing.assert_allclose(smooth.slopes(start_m, end_m), differences(smooth, start_m, end_m, 1e-4), atol=1e-2)
