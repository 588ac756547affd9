import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SensorSettings
from sionna_partial.worlds.camera import FUSIONS, Camera, _fuse, view_corners_m

NOWHERE = np.empty((0, 2), dtype=np.intp)
EXACT, LIDAR = SensorSettings(), SensorSettings(field_of_view_deg=360.0)


def camera(truth, sensor=EXACT, resolution_m=0.1, seed=0):
    return Camera(truth, resolution_m, sensor, np.random.default_rng(seed))


def surrounded(state):
    return np.pad(np.asarray(state, dtype=np.uint8), 1, constant_values=CellState.UNKNOWN)


def corridor(length=30, wall_at=20):
    state = np.full((5, length), CellState.WALL, dtype=np.uint8)
    state[1:4, 1:-1] = CellState.FREE
    state[:, wall_at] = CellState.WALL
    return surrounded(state)


@settings(deadline=None, max_examples=60)
@given(
    arrays(np.uint8, (14, 14), elements=st.sampled_from([0, 0, 0, 1, 2])),
    st.tuples(st.integers(1, 14), st.integers(1, 14)),
    st.tuples(st.sampled_from([0.5, 0.25, 0.01, 0.99]), st.sampled_from([0.5, 0.125, 0.75])),
    st.integers(0, 35),
)
def test_rays_pass_no_corner_where_two_walls_meet(state, cell, part, tens):
    truth = surrounded(state)
    truth[cell] = CellState.FREE
    eye = camera(truth)
    eye.look(cell[1] + part[0], cell[0] + part[1], 10.0 * tens, (0.0, 0.0), NOWHERE)
    known = eye.seen != CellState.UNKNOWN
    assert (eye.seen[known] == truth[known]).all()
    labels, _ = ndimage.label(eye.seen == CellState.FREE)
    assert labels[cell] > 0
    assert (labels[eye.seen == CellState.FREE] == labels[cell]).all()


@pytest.mark.parametrize("heading_deg", [40, 230])
@pytest.mark.parametrize("sensor", [EXACT, SensorSettings(field_of_view_deg=30.0, range_m=5.0), LIDAR])
def test_cells_are_seen_just_as_far_and_wide_as_the_camera_reaches(heading_deg, sensor):
    eye, middle = camera(np.zeros((121, 121), dtype=np.uint8), sensor), 60.5
    eye.look(middle, middle, heading_deg, (0.0, 0.0), NOWHERE)
    rows, columns = np.indices(eye.seen.shape) + 0.5
    distance = np.hypot(rows - middle, columns - middle)
    bearing = np.degrees(np.arctan2(rows - middle, columns - middle)) - heading_deg
    off_axis_deg = np.abs((bearing + 180) % 360 - 180)
    slack_deg = np.where(distance < 0.75, 180.0, np.degrees(np.arcsin(0.75 / np.maximum(distance, 0.75))))
    range_cells, half_deg = sensor.range_m / 0.1, sensor.field_of_view_deg / 2
    seen = eye.seen == CellState.FREE
    assert seen[(distance < range_cells - 1) & (off_axis_deg < half_deg - slack_deg)].all()
    assert not seen[(distance > range_cells + 1) | (off_axis_deg > half_deg + slack_deg)].any()


def test_belief_shifts_the_map_by_as_many_cells():
    truth = np.pad(corridor(), 6, constant_values=CellState.UNKNOWN)
    here, there = camera(truth), camera(truth)
    here.look(9.5, 9.5, 0.0, (0.0, 0.0), NOWHERE)
    there.look(9.5, 9.5, 0.0, (3.0, -2.0), NOWHERE)
    assert np.array_equal(there.seen, np.roll(here.seen, (-2, 3), axis=(0, 1)))


def test_readings_beyond_the_grid_are_dropped():
    eye = camera(corridor())
    for shift in ((100.0, 0.0), (-100.0, 0.0), (0.0, -2.6)):
        eye.look(3.5, 3.5, 0.0, shift, NOWHERE)
    assert (eye.seen[:3] != CellState.UNKNOWN).any()
    assert (eye.seen[4:] == CellState.UNKNOWN).all()


def test_rays_to_a_missed_wall_are_dropped():
    eye = camera(corridor(), SensorSettings(missed_wall_fraction=1.0))
    eye.look(3.5, 3.5, 0.0, (0.0, 0.0), NOWHERE)
    assert (eye.seen == CellState.UNKNOWN).all()


def test_where_the_robot_stands_is_free_whatever_was_seen():
    eye = camera(corridor())
    under = np.array([[3, 21]])
    eye.look(3.5, 3.5, 0.0, (0.0, 0.0), NOWHERE)
    assert eye.seen[3, 21] == CellState.WALL
    eye.look(3.5, 3.5, 180.0, (0.0, 0.0), under)
    assert eye.seen[3, 21] == CellState.FREE


def fused(fusion, hits, passes):
    all_hits, all_passes = np.zeros((2, 1, 1), dtype=np.int32)
    seen = np.full((1, 1), CellState.UNKNOWN, dtype=np.uint8)
    for hit, passed in zip(hits, passes, strict=True):
        counts = (np.full((1, 1), number, dtype=np.int32) for number in (hit, passed))
        _fuse(all_hits, all_passes, *counts, FUSIONS[fusion], seen)
    return seen[0, 0]


FREE, WALL, UNKNOWN = CellState.FREE, CellState.WALL, CellState.UNKNOWN


@pytest.mark.parametrize(
    ("fusion", "hits", "passes", "state"),
    [
        ("exact", [1], [0], WALL),
        ("slam_toolbox", [1], [0], UNKNOWN),  # two passes, of the ray and of its hit
        ("slam_toolbox", [0], [2], UNKNOWN),
        ("slam_toolbox", [1, 0], [0, 7], WALL),  # 1 / 9
        ("slam_toolbox", [1, 0], [0, 8], FREE),  # 1 / 10
        ("gmapping", [1], [2], WALL),  # 1 / 3
        ("gmapping", [1], [3], FREE),  # 1 / 4
        ("vacuum", [2, 0], [0, 6], FREE),
        ("cartographer", [5], [100], WALL),  # one hit
        ("cartographer", [1, 0, 0, 0, 0, 0], [0, 9, 9, 9, 9, 9], WALL),  # 0.2007 - 5 * 0.0400
        ("cartographer", [1, 0, 0, 0, 0, 0, 0], [0, 1, 1, 1, 1, 1, 1], FREE),
    ],
)
def test_rules_of_mappers(fusion, hits, passes, state):
    assert fused(fusion, hits, passes) == state


@pytest.mark.parametrize(("fusion", "cells"), [("slam_toolbox", 24), ("gmapping", 24), ("cartographer", 15)])
def test_open_space_is_cleared_as_far_as_the_mapper_does(fusion, cells):
    sensor = SensorSettings(0.001, field_of_view_deg=90.0, range_m=8.0, fusion=fusion)
    eye = camera(np.zeros((121, 121), dtype=np.uint8), sensor, resolution_m=1 / 3)
    for _ in range(3):
        eye.look(60.5, 60.5, 0.0, (0.0, 0.0), NOWHERE)
    assert np.flatnonzero(eye.seen[60] == FREE).tolist() == list(range(60, 61 + cells))


def test_grazed_walls_and_lost_rays_return_nothing():
    truth = surrounded(np.zeros((40, 60), dtype=np.uint8))
    truth[30] = WALL  # 4 degrees from the first ray
    for sensor, seen in (
        (SensorSettings(0.001, field_of_view_deg=1.0, range_m=8.0), False),
        (SensorSettings(field_of_view_deg=1.0, range_m=8.0), True),
    ):
        eye = camera(truth, sensor)
        for _ in range(3):
            eye.look(5.5, 28.5, 4.0, (0.0, 0.0), NOWHERE)
        assert (eye.seen == WALL).any() == seen
    eye = camera(truth, SensorSettings(missed_return_fraction=1.0))
    eye.look(5.5, 28.5, 90.0, (0.0, 0.0), NOWHERE)
    assert (eye.seen == UNKNOWN).all()


def test_errors_of_the_heading_turn_the_map():
    truth = surrounded(np.zeros((60, 60), dtype=np.uint8))
    truth[29:32, 45] = WALL
    eye = camera(truth, SensorSettings(heading_noise_deg=20.0, field_of_view_deg=60.0, fusion="gmapping"), seed=2)
    eye.look(25.5, 30.5, 0.0, (0.0, 0.0), NOWHERE)
    rows, columns = np.nonzero(eye.seen == WALL)
    assert np.hypot(rows - 30, columns - 25) == pytest.approx(20.0, abs=1.5)
    assert np.abs(rows - 30).min() > 1


def test_vacuum_robots_thin_walls():
    """Three layers of wall beside free cells: the first stays, what is behind is unknown."""
    eye = camera(surrounded(np.zeros((12, 30), dtype=np.uint8)), SensorSettings(0.01, fusion="vacuum"), 0.05)
    eye.seen[:6], eye.seen[6:9] = FREE, WALL
    assert eye.map[:6].tolist() == eye.seen[:6].tolist()
    assert (eye.map[6, 1:-1] == WALL).all()
    assert (eye.map[7:, 1:-1] == UNKNOWN).all()


class TestViewCorners:
    def test_it_ends_in_the_wall(self):
        home = PartialMap(corridor()[1:-1, 1:-1], 0.1)
        corners = view_corners_m(home, np.array([0.25, 0.25, 0.0]), EXACT)
        assert corners[:, 0].max() == pytest.approx(2.05, abs=0.05 + 1e-9)
        assert (corners[:, 1].min(), corners[:, 1].max()) == pytest.approx((0.05, 0.45), abs=0.05 + 1e-9)
        assert math.isclose(corners[len(corners) // 2, 0], 2.05, abs_tol=0.06)
