import numpy as np
import pytest

from sionna_partial.constants import CellState
from sionna_partial.settings import SensorSettings
from sionna_partial.simulation.robot import ROBOT_RADII_M, Robot, _fitting_radius, _Router

FREE, WALL, UNKNOWN = (int(state) for state in (CellState.FREE, CellState.WALL, CellState.UNKNOWN))


def hall(size: int = 80) -> np.ndarray:
    return np.pad(np.full((size, size), FREE, dtype=np.uint8), 1, constant_values=UNKNOWN)


def test_costs_are_lengths_in_the_open():
    router = _Router(np.ones((5, 9)), (2, 1))
    assert router.costs[2, 7] == pytest.approx(6.0)
    assert router.costs[4, 3] == pytest.approx(2 * np.sqrt(2))
    assert router.path_to(np.array([2, 7])).tolist() == [[2, column] for column in range(1, 8)]


def test_no_route_between_cells_that_meet_at_a_corner():
    cost = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert np.isinf(_Router(cost, (0, 0)).costs[1, 2])
    cost[0, 2] = 1.0
    assert _Router(cost, (0, 0)).costs[1, 2] == pytest.approx(1 + np.sqrt(2))


def test_a_robot_does_not_slip_between_walls_that_meet_at_a_corner():
    """Two rooms that touch at one corner, joined elsewhere: the smallest robot does not pass the corner."""
    truth = hall(20)
    robot = Robot(truth, 0.25, 0, SensorSettings())
    robot._roomy = truth == FREE
    robot._roomy[9, 10] = robot._roomy[10, 9] = False
    robot.position, robot.heading_deg = (9.9, 9.9), 45.0
    assert not robot._step_forward()
    assert robot.position == (9.9, 9.9)
    robot._roomy[9, 10] = True
    assert robot._step_forward()


def test_it_slides_along_a_wall():
    robot = Robot(hall(), 0.05, 0, SensorSettings())
    robot.position, robot.heading_deg = (40.5, 5.2), 340.0
    assert robot._step_forward()
    assert robot.position[0] > 43.0


def first_goal(seed: int) -> str:
    robot = Robot(hall(160), 0.1, seed, SensorSettings())
    robot.position, robot.heading_deg = (80.5, 20.5), 90.0
    seen = robot.seen
    seen[...] = UNKNOWN
    seen[0:150, 40:122] = WALL
    seen[1:149, 41:121] = FREE
    for frontier in (np.s_[10:31, 40], np.s_[10:31, 121], np.s_[149, 70:91]):
        seen[frontier] = UNKNOWN
    row, column = robot._choose_route()[-1]
    return "up" if row > 100 else ("left" if column < 80 else "right")


def test_two_equal_frontiers_are_chosen_equally_often_and_a_far_one_seldom():
    """A robot in the middle of what it knows: two frontiers four metres away to the left and right, one 12 m up."""
    chosen = [first_goal(seed) for seed in range(60)]
    assert min(chosen.count("left"), chosen.count("right")) >= 15
    assert chosen.count("up") <= 6


def test_narrow_doors_take_a_slim_robot():
    free = np.zeros((40, 83), dtype=bool)
    free[1:-1, 1:41] = free[1:-1, 42:-1] = True
    wide, slim = free.copy(), free.copy()
    wide[10:20, 41] = slim[18:22, 41] = True
    radii = [_fitting_radius(each, 0.05)[0] * 0.05 for each in (wide, slim)]
    assert radii[0] == pytest.approx(ROBOT_RADII_M[0])
    assert 0.0 < radii[1] < radii[0]
