"""Fields of maps: exposure to unobserved space, routes around walls, images, wherever the map lies."""

import math
import pickle

import numpy as np
import pytest
from extruded import drawn
from scipy import ndimage

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.space import CELL_M, LONGEST_ROUTE, WALK_M, MapSpace

FREE, WALL, UNKNOWN = CellState.FREE, CellState.WALL, CellState.UNKNOWN


def rooms(resolution_m=0.1, *, known=True):
    """Return two rooms of 4 x 3 m with a door at one end between them; beyond the second, nothing is known."""
    cells = round(1.0 / resolution_m)
    state = np.full((3 * cells + 2, 8 * cells + 3), FREE, dtype=np.uint8)
    state[[0, -1]] = WALL
    state[:, [0, 4 * cells + 1, -1]] = WALL
    state[1 : 1 + cells, 4 * cells + 1] = FREE
    if not known:
        state[1:-1, 6 * cells :] = UNKNOWN
        state[cells : 2 * cells, -1] = UNKNOWN
    return PartialMap(state, resolution_m, (-0.37, 2.03))


def at(*points):
    return np.array([(x, y, 1.5) for x, y in points])


def test_exposure_is_0_on_complete_maps_and_1_deep_in_the_unknown():
    complete, whole = MapSpace(rooms()), MapSpace(PartialMap(np.full((30, 30), UNKNOWN), 0.1))
    assert not complete.exposure.any()
    np.testing.assert_allclose(whole.exposure, 1.0)
    space, x = MapSpace(rooms(known=False)), np.linspace(0.5, 7.0, 40)
    along = space.exposure_at(at(*((each, 2.6) for each in x)))
    assert 0.0 < along.min() < 0.15
    assert along.max() > 0.7
    beyond = space.exposure_at(at((20.0, 20.0), (-20.0, 3.0)))
    np.testing.assert_allclose(beyond, 1.0, atol=0.05)


def test_known_walls_close_off_the_unknown():
    state = np.pad(np.zeros((30, 30), dtype=np.uint8), 1, constant_values=WALL)
    state = np.pad(state, 20, constant_values=UNKNOWN)
    assert not MapSpace(PartialMap(state, 0.1)).exposure.any()
    state[20, 35:37] = UNKNOWN  # gaps of up to two cells are closed
    assert not MapSpace(PartialMap(state, 0.1)).exposure.any()
    state[20, 35:38] = UNKNOWN
    assert MapSpace(PartialMap(state, 0.1)).exposure.max() > 0.01


@pytest.mark.parametrize("angle_deg", [0.0, 12.0, 45.0, 71.0])
@pytest.mark.parametrize("resolution_m", [0.05, 0.1])
def test_inclined_walls_are_closed(angle_deg, resolution_m):
    """In a room with walls of one cell, once the space outside can be entered."""
    axis, angle = np.arange(-6.0, 6.0, resolution_m) + resolution_m / 2.0, math.radians(angle_deg)
    x, y = np.meshgrid(axis, axis)
    along, across = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    inside = (np.abs(along) < 3.0) & (np.abs(across) < 2.0)
    state = np.where(inside, FREE, np.where(ndimage.binary_dilation(inside, np.ones((3, 3))), WALL, UNKNOWN))
    state[5, 5] = FREE
    space, ends = MapSpace(PartialMap(state, resolution_m, (-6.0, -6.0))), at((0.0, 0.0), (1.0, 1.0))
    assert space.exposure_at(at((-5.0, -5.0))) > 0.5
    assert space.exposure_at(ends).max() < 1e-6
    assert space.routes(ends[0], at((-5.0, -5.0)))[0] > 15.0


def test_a_far_cell_changes_little():
    """An unknown one in a wall nothing, and a known one far outside almost nothing."""
    whole = rooms(0.05)
    state = whole.state.copy()
    state[30, -1] = UNKNOWN
    assert not MapSpace(PartialMap(state, 0.05, whole.origin_m)).exposure.any()
    state[:60, -1] = UNKNOWN
    expected = MapSpace(PartialMap(np.pad(state, 40, constant_values=UNKNOWN), 0.05)).exposure_at(at((5.0, 4.0)))
    state = np.pad(state, 40, constant_values=UNKNOWN)
    state[0, 0] = WALL
    found = MapSpace(PartialMap(state, 0.05)).exposure_at(at((5.0, 4.0)))
    assert 0.0 < expected[0] == pytest.approx(found[0], abs=1e-3)


class TestRoutes:
    def test_symmetric_finite_and_longer_around_a_wall(self):
        space, rng = MapSpace(rooms()), np.random.default_rng(0)
        points = at(*rng.uniform((-1.0, 1.5), (8.5, 5.5), (30, 2)))
        there = np.stack([space.routes(each, points) for each in points])
        assert np.isfinite(there).all()
        np.testing.assert_allclose(there, there.T, atol=1e-6)
        assert there.max() <= LONGEST_ROUTE
        behind, beside = space.routes(at((3.2, 4.5))[0], at((4.6, 4.5), (1.8, 4.5)))
        assert behind > beside + 1.0
        assert space.routes(at((1.0, 3.0))[0], at((1.0, -3.0)))[0] > 10.0  # through the outer wall

    def test_grow_as_the_distance_does_without_walls(self):
        """By 10 m and half of the logarithm of 3 from 5 to 15 m, and by a formula where nothing is known."""
        open_space, empty = (PartialMap(np.full((80, 80), cell), CELL_M) for cell in (FREE, UNKNOWN))
        start, ends = at((5.0, 12.0))[0], at((10.0, 12.0), (20.0, 12.0), (17.0, 21.0))
        expected = (10.0 / WALK_M) + 0.5 * math.log(3.0)
        for partial in (open_space, empty):
            near, far, aslant = MapSpace(partial).routes(start, ends)
            assert far - near == pytest.approx(expected, rel=0.03)
            assert aslant == pytest.approx(far, rel=0.03)
        np.testing.assert_allclose(*(MapSpace(each).routes(start, ends) for each in (open_space, empty)), rtol=0.03)

    def test_of_several_transmitters(self):
        space = MapSpace(rooms())
        tx, rx = at((1.0, 3.0), (7.0, 3.0), (1.0, 3.0)), at((7.0, 4.0), (2.0, 4.0), (3.0, 2.5))
        expected = [space.routes(start, end[None])[0] for start, end in zip(tx, rx, strict=True)]
        np.testing.assert_allclose(space.routes_of(tx, rx), expected, rtol=1e-12)


def lying_maps(partial):
    """Yield a map turned, mirrored, moved or padded, and the points of the map in it."""
    ny, nx = partial.shape
    origin, resolution_m = np.array(partial.origin_m), partial.resolution_m
    width_m, height_m = nx * resolution_m, ny * resolution_m

    def of(state, move):
        return PartialMap(np.ascontiguousarray(state), resolution_m, (0.0, 0.0)), lambda xy: move(*(xy - origin).T)

    yield of(np.rot90(partial.state), lambda x, y: (y, width_m - x))
    yield of(partial.state[:, ::-1], lambda x, y: (width_m - x, y))
    yield of(partial.state[::-1], lambda x, y: (x, height_m - y))
    yield of(partial.state.T, lambda x, y: (y, x))
    moved = PartialMap(partial.state, resolution_m, (12.3456, -7.891))
    yield moved, lambda xy: (xy - origin + moved.origin_m).T
    padded = PartialMap(
        np.pad(partial.state, ((7, 2), (1, 13)), constant_values=UNKNOWN),
        resolution_m,
        tuple(origin - resolution_m * np.array([1, 7])),
    )
    yield padded, lambda xy: xy.T


@pytest.mark.parametrize("resolution_m", [0.1, 0.05, 0.03, 0.025])
def test_fields_turn_and_move_with_the_map(resolution_m):
    partial = rooms(resolution_m, known=False)
    points = np.random.default_rng(1).uniform((-1.5, 1.0), (9.0, 6.5), (40, 2))

    def fields(partial, points):
        space = MapSpace(partial)
        points = np.column_stack([points, np.full(len(points), 1.5)])
        return np.column_stack(
            [space.read(space.image.astype(float), points), space.exposure_at(points), space.routes(points[0], points)]
        )

    expected = fields(partial, points)
    assert (np.ptp(expected, axis=0) > 0.04).all()
    for other, move in lying_maps(partial):
        np.testing.assert_allclose(fields(other, np.stack(move(points), axis=1)), expected, atol=1e-7)


def test_image_has_the_fractions_of_cells():
    space = MapSpace(drawn("...... .####. ......", CELL_M))
    image = space.image
    assert image.dtype == np.float32
    np.testing.assert_allclose(image.sum(axis=(0, 1))[:2], [14.0, 4.0], rtol=1e-6)
    np.testing.assert_allclose(image.sum(axis=2), 1.0, rtol=1e-6)


def test_without_free_cells_all_that_is_unknown_can_be_entered():
    state = np.pad(np.full((4, 6), UNKNOWN), 1, constant_values=WALL)
    bare, padded = (PartialMap(np.pad(state, pad, constant_values=UNKNOWN), 0.3) for pad in (0, 5))
    np.testing.assert_array_equal(MapSpace(bare).image, MapSpace(padded).image)


def test_fields_are_kept_for_each_map_and_can_be_pickled():
    partial = rooms(known=False)
    space = MapSpace.of(partial)
    assert MapSpace.of(partial) is space
    expected = space.routes(at((1.0, 3.0))[0], at((7.0, 4.0)))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(space)).routes(at((1.0, 3.0))[0], at((7.0, 4.0))), expected)
    addresses = set()
    for count in range(1, 40):
        partial = PartialMap(np.full((3, count), FREE), CELL_M)
        addresses.add(id(partial))
        assert MapSpace.of(partial).image[..., 0].sum() == pytest.approx(3 * count)
        del partial
    assert len(addresses) < 39  # maps that are gone have left their address to others
