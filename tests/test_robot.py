import numpy as np
import pytest

from sionna_partial.constants import CellState
from sionna_partial.settings import SensorSettings
from sionna_partial.simulation.robot import ROBOT_RADII_M, Robot, _fitting_radius, _Router

FREE, WALL, UNKNOWN = (int(state) for state in (CellState.FREE, CellState.WALL, CellState.UNKNOWN))


def hall(size: int = 80) -> np.ndarray:
    return np.pad(np.full((size, size), FREE, dtype=np.uint8), 1, constant_values=UNKNOWN)


class TestRouter:
    def test_costs_are_lengths_in_the_open(self):
        router = _Router(np.ones((5, 9)), (10, 20), (12, 21))
        assert router.cost_to((12, 27)) == pytest.approx(6.0)
        assert router.cost_to((14, 23)) == pytest.approx(2 * np.sqrt(2))
        assert router.path_to((12, 27)).tolist() == [[12, column] for column in range(21, 28)]

    def test_no_way_between_cells_that_meet_at_a_corner(self):
        cost = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
        assert np.isinf(_Router(cost, (0, 0), (0, 0)).cost_to((1, 2)))
        cost[0, 2] = 1.0
        assert _Router(cost, (0, 0), (0, 0)).cost_to((1, 2)) == pytest.approx(1 + np.sqrt(2))


class TestMoves:
    def test_a_robot_does_not_slip_between_walls_that_meet_at_a_corner(self):
        """Two rooms that touch at one corner, joined by a way round: the smallest robot does not take the corner."""
        truth = hall(20)
        robot = Robot(truth, 0.25, 0, SensorSettings())
        robot._roomy = truth == FREE
        robot._roomy[9, 10] = robot._roomy[10, 9] = False
        robot.place, robot.heading_deg = (9.9, 9.9), 45.0
        assert not robot._step_forward()
        assert robot.place == (9.9, 9.9)
        robot._roomy[9, 10] = True
        assert robot._step_forward()

    def test_it_slides_along_a_wall(self):
        robot = Robot(hall(), 0.05, 0, SensorSettings())
        robot.place, robot.heading_deg = (40.5, 5.2), 340.0
        assert robot._step_forward()
        assert robot.place[0] > 43.0


class TestGoals:
    def test_two_equal_frontiers_are_chosen_equally_often_and_a_far_one_seldom(self):
        """A robot in the middle of what it knows: two frontiers four metres away to the left and right, one 12 m up."""
        chosen = np.array([self._first_goal(seed) for seed in range(60)])
        left, right, up = ((chosen == side).sum() for side in ("left", "right", "up"))
        assert min(left, right) >= 15
        assert up <= 6

    def _first_goal(self, seed: int) -> str:
        truth = np.pad(np.full((160, 160), FREE, dtype=np.uint8), 1, constant_values=UNKNOWN)
        robot = Robot(truth, 0.1, seed, SensorSettings())
        robot.place, robot.heading_deg = (80.5, 20.5), 90.0
        seen = robot.seen
        seen[...] = UNKNOWN
        seen[0:150, 40:122] = WALL
        seen[1:149, 41:121] = FREE
        for place in (np.s_[10:31, 40], np.s_[10:31, 121], np.s_[149, 70:91]):
            seen[place] = UNKNOWN
        goal = robot._choose_goal()
        assert goal is not None
        row, column = goal.cell
        return "up" if row > 100 else ("left" if column < 80 else "right")


class TestFittingRadius:
    def test_narrow_doors_take_a_slim_robot(self):
        free = np.zeros((40, 83), dtype=bool)
        free[1:-1, 1:41] = free[1:-1, 42:-1] = True
        wide, slim = free.copy(), free.copy()
        wide[10:20, 41] = slim[18:22, 41] = True
        radii = [_fitting_radius(each, 0.05)[0] * 0.05 for each in (wide, slim)]
        assert radii[0] == pytest.approx(ROBOT_RADII_M[0])
        assert 0.0 < radii[1] < radii[0]
