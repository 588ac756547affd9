"""Robot simulator: a complete home -> what a robot has seen of it after so many steps.

The robot is that of Active Neural SLAM (Chaplot et al., ICLR 2020), by which the paper makes its partial maps: one
action a step, a quarter of a metre forward or ten degrees of turn, and a camera of 90 degrees and a few metres. Its
learnt policies are replaced by frontier goals and shortest paths over what it has seen.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.mesh_map import cut_to_known
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.settings import require

FORWARD_M = 0.25
"""Length of a forward action [m] (Active Neural SLAM, Section 4)."""

TURN_DEG = 10
"""Angle of a turn [degree] (Active Neural SLAM, Section 4)."""

FIELD_OF_VIEW_DEG = 90
"""Horizontal field of view of the camera [degree] (Active Neural SLAM, Section 4)."""

CAMERA_RANGE_M = 3.2
"""Range of the camera [m] (the 64 cells of 0.05 m that Active Neural SLAM's mapper predicts ahead)."""

MAX_STEPS = 100_000
"""Largest number of actions: many times what a large building takes."""

ROBOT_RADII_M = (0.18, 0.14, 0.1, 0.06, 0.0)
"""Radii of the robot [m]: it takes the largest with which it gets around in the home."""

ROAMED_SHARE = 0.95
"""Share of the free area that the robot must be able to cover to get around."""

GOAL_STEPS = 25
"""Number of actions after which the goal is reconsidered (as the long-term goal of Active Neural SLAM)."""

_FREE, _WALL, _UNKNOWN = int(CellState.FREE), int(CellState.WALL), int(CellState.UNKNOWN)
_EIGHT = np.ones((3, 3), dtype=bool)
_SMALLEST_FRONTIER_CELLS = 3
_COMFORT_M = 0.3
_COMFORT_COST = 3.0
_TIGHT_COST = 15.0
_AHEAD_M = 0.3
_BUMP_M = 0.25
_ARRIVAL_M = 0.3
_DECISION_STEPS = 5.0


def explore(home: PartialMap, steps: Sequence[int] = (50, 100, 150, 200), seed: int = 0) -> list[PartialMap]:
    """Send a robot through a home and return what it has seen at several moments.

    The robot starts at a random free place and heading. Each step it walks towards a frontier between seen and
    unseen cells, or turns, and then looks: rays run through the cells to the first wall. Range, position and wall
    detection are exact, so whatever is seen is true. When there is nothing left to see, the robot stays.

    Parameters
    ----------
    home : PartialMap
        What is there to be seen. Its unknown cells stop the robot and its view, and stay unknown.
    steps : sequence of int
        Numbers of actions [1], increasing, at most `MAX_STEPS`, after which the map is returned. After 0 nothing has
        been seen.
    seed : int
        Seed of start and heading, at least 0.

    Returns
    -------
    list of PartialMap
        One for each of `steps`, on the grid of `home`, with `interior_cells` set to its number of free cells. Each
        shows everything that the ones before it show. A mesh is cut to what is known.

    Raises
    ------
    MapError
        If the home has no free cell, or is no PartialMap.
    SettingsError
        If `steps` are not increasing whole numbers of 0 to `MAX_STEPS`, or `seed` is not a whole number of 0 or more.
    """
    _check(steps, seed)
    require_map("home", home)
    free = np.argwhere(home.state == _FREE)
    if not len(free):
        raise MapError("home has 0 free cells: a robot needs somewhere to stand; give a map with free cells.")
    (row0, column0), (row1, column1) = free.min(axis=0), free.max(axis=0) + 3
    padded = np.pad(home.state, 1, constant_values=_UNKNOWN)
    robot = _Robot(padded[row0:row1, column0:column1], home.resolution_m, np.random.default_rng(seed))
    maps, done = [], 0
    for count in steps:
        for _ in range(count - done):
            robot.act()
        done = count
        seen = np.full_like(padded, _UNKNOWN)
        if count:
            seen[row0:row1, column0:column1] = robot.seen
        maps.append(cut_to_known(replace(home, state=seen[1:-1, 1:-1], interior_cells=len(free))))
    return maps


def _check(steps: Sequence[int], seed: int) -> None:
    counts = list(steps) if np.iterable(steps) else []
    rising = len(counts) > 0 and all(_whole(count) for count in counts) and bool(np.all(np.diff(counts) > 0))
    remedy = f"give increasing whole numbers of 0 to {MAX_STEPS:,}, such as (50, 100, 150, 200)."
    require(rising and counts[-1] <= MAX_STEPS, "steps", steps, remedy)
    require(_whole(seed), "seed", seed, "give a whole number of 0 or more.")


def _whole(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 0)


@dataclass
class _Goal:
    """A frontier cell and the way there: cells (n, 2) from the robot to it."""

    path: NDArray[np.intp]
    steps: int = 0

    @property
    def cell(self) -> tuple[int, int]:
        return int(self.path[-1, 0]), int(self.path[-1, 1])


class _Robot:
    """Pose, knowledge and plan of the robot. Lengths are in cells; x runs along columns, y along rows."""

    def __init__(self, truth: NDArray[np.uint8], resolution_m: float, rng: np.random.Generator) -> None:
        self._truth = np.ascontiguousarray(truth)
        self._cell_m = resolution_m
        self._radius, self._roomy = _fitting_radius(truth == _FREE, resolution_m)
        self._given_up = np.zeros(truth.shape, dtype=bool)
        self._bumps = np.zeros(truth.shape, dtype=bool)
        self._goal: _Goal | None = None
        self.seen = np.full_like(self._truth, _UNKNOWN)
        row, column = rng.choice(np.argwhere(self._roomy))
        self._x, self._y = column + 0.5, row + 0.5
        self._heading_deg = float(rng.integers(360 // TURN_DEG) * TURN_DEG)
        self._look()

    def act(self) -> None:
        """Do one action towards a frontier, and look."""
        goal = self._goal
        if goal is None or goal.steps >= GOAL_STEPS or self._is_done(goal.cell):
            goal = self._goal = self._choose_goal()
        if goal is None:
            return
        goal.steps += 1
        row, column = self._waypoint(goal)
        error = math.degrees(math.atan2(row + 0.5 - self._y, column + 0.5 - self._x)) - self._heading_deg
        error = (error + 180.0) % 360.0 - 180.0
        if abs(error) > TURN_DEG / 2:
            self._heading_deg = (self._heading_deg + math.copysign(TURN_DEG, error)) % 360.0
        elif not self._step_forward():
            self._bump(goal)
        self._look()

    def _look(self) -> None:
        reach = CAMERA_RANGE_M / self._cell_m
        _cast_rays(self._truth, self.seen, self._x, self._y, math.radians(self._heading_deg), reach)

    def _frontier(self) -> NDArray[np.bool_]:
        """Free cells that touch an unseen one, where the robot has not given up."""
        beside = ndimage.binary_dilation(self.seen == _UNKNOWN)
        return beside & (self.seen == _FREE) & ~self._given_up

    def _choose_goal(self) -> _Goal | None:
        """Frontier that promises much for few steps, or None if none can be reached."""
        labels, count = ndimage.label(self._frontier(), structure=_EIGHT)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        router = _Router(self._travel_cost(), (int(self._y), int(self._x)))
        best, best_score = None, 0.0
        for label in np.nonzero(sizes >= _SMALLEST_FRONTIER_CELLS)[0] + 1:
            cells = np.argwhere(labels == label)
            row, column = cells[np.argmin(np.hypot(*(cells - cells.mean(axis=0)).T))]
            steps = self._steps_to((row, column), router.costs[row, column])
            score = math.sqrt(sizes[label - 1]) / (steps + _DECISION_STEPS)
            if score > best_score:
                best, best_score = (row, column), score
        return None if best is None else _Goal(router.path_to(best))

    def _distance_to(self, cell: tuple[int, int]) -> float:
        return math.hypot(cell[0] + 0.5 - self._y, cell[1] + 0.5 - self._x)

    def _is_done(self, cell: tuple[int, int]) -> bool:
        return self._distance_to(cell) * self._cell_m < _ARRIVAL_M and not self._frontier()[cell]

    def _steps_to(self, cell: tuple[int, int], cost: float) -> float:
        """Count the actions to a cell: the way, and the turn towards it."""
        bearing = math.degrees(math.atan2(cell[0] + 0.5 - self._y, cell[1] + 0.5 - self._x))
        turn = abs((bearing - self._heading_deg + 180.0) % 360.0 - 180.0)
        return float(cost * self._cell_m / FORWARD_M + turn / TURN_DEG)

    def _travel_cost(self) -> NDArray[np.float64]:
        """Cost per cell of the way: 1 in the open, more beside walls, 0 (no way) where not seen free."""
        distance = ndimage.distance_transform_edt(self.seen != _WALL) - 0.5
        nearness = np.clip(1.0 - distance * self._cell_m / _COMFORT_M, 0.0, 1.0)
        cost = 1.0 + _COMFORT_COST * nearness
        cost[(distance < self._radius) | self._bumps] = _TIGHT_COST
        cost[self.seen != _FREE] = 0.0
        return cost

    def _waypoint(self, goal: _Goal) -> NDArray[np.intp]:
        """Cell of the path a little ahead of the robot."""
        away = np.hypot(goal.path[:, 0] + 0.5 - self._y, goal.path[:, 1] + 0.5 - self._x)
        ahead = int(np.argmin(away)) + max(1, round(_AHEAD_M / self._cell_m))
        return goal.path[min(ahead, len(goal.path) - 1)]

    def _step_forward(self) -> bool:
        """Move ahead, sliding along walls; return whether at least half of the way was made."""
        angle, length = math.radians(self._heading_deg), FORWARD_M / self._cell_m
        parts = math.ceil(2 * length)
        along_x, along_y = math.cos(angle) * length / parts, math.sin(angle) * length / parts
        x, y = self._x, self._y
        for _ in range(parts):
            for move_x, move_y in ((along_x, along_y), (along_x, 0.0), (0.0, along_y)):
                if self._roomy[int(self._y + move_y), int(self._x + move_x)]:
                    self._x, self._y = self._x + move_x, self._y + move_y
                    break
        return math.hypot(self._x - x, self._y - y) >= length / 2

    def _bump(self, goal: _Goal) -> None:
        """Avoid what stopped the robot; give up what is too near to be approached further."""
        rows, columns = np.indices(self.seen.shape)
        reach = _BUMP_M / self._cell_m
        angle = math.radians(self._heading_deg)
        x, y = self._x + math.cos(angle) * reach / 2, self._y + math.sin(angle) * reach / 2
        self._bumps |= np.hypot(rows + 0.5 - y, columns + 0.5 - x) < reach / 2
        row, column = goal.cell
        if math.hypot(row + 0.5 - self._y, column + 0.5 - self._x) < 2 * reach:
            self._given_up |= np.hypot(rows - row, columns - column) <= reach
        self._goal = None


class _Router:
    """Shortest ways from one cell to all others, in eight directions, where a cell costs more than 0 to cross."""

    def __init__(self, cost: NDArray[np.float64], start: tuple[int, int]) -> None:
        self._cells = np.argwhere(cost > 0)
        self._index = np.full(cost.shape, -1)
        self._index[tuple(self._cells.T)] = np.arange(len(self._cells))
        ny, nx = cost.shape
        ends, weights = [], []
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here = slice(0, ny - down), slice(max(0, -right), nx - max(0, right))
            there = slice(down, ny), slice(max(0, right), nx + min(0, right))
            linked = (cost[here] > 0) & (cost[there] > 0)
            ends.append([self._index[here][linked], self._index[there][linked]])
            weights.append(math.hypot(down, right) * (cost[here][linked] + cost[there][linked]) / 2)
        size = len(self._cells)
        graph = coo_array((np.concatenate(weights), np.concatenate(ends, axis=1)), shape=(size, size)).tocsr()
        cheapest, self._before = dijkstra(graph, directed=False, indices=self._index[start], return_predecessors=True)
        self.costs = np.full(cost.shape, np.inf)
        self.costs[tuple(self._cells.T)] = cheapest

    def path_to(self, cell: tuple[int, int]) -> NDArray[np.intp]:
        """Cells (n, 2) from the start to `cell`."""
        way = [self._index[cell]]
        while self._before[way[-1]] >= 0:
            way.append(self._before[way[-1]])
        return self._cells[way[::-1]]


def _fitting_radius(free: NDArray[np.bool_], resolution_m: float) -> tuple[float, NDArray[np.bool_]]:
    """Largest radius [cells] of a robot that gets around, and the cells where its centre can be."""
    distance = ndimage.distance_transform_edt(free) - 0.5
    part = _largest_part(free)
    for radius in np.array(ROBOT_RADII_M) / resolution_m:
        roomy = _largest_part(part & (distance >= radius))
        covered = part & (ndimage.distance_transform_edt(~roomy) <= radius + 1.0)
        if roomy.any() and covered.sum() >= ROAMED_SHARE * part.sum():
            break
    return float(radius), roomy


def _largest_part(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    labels, _ = ndimage.label(mask)
    return mask & (labels == np.argmax(np.bincount(labels[mask], minlength=1)))


@njit(cache=True)
def _cast_rays(
    truth: NDArray[np.uint8], seen: NDArray[np.uint8], x: float, y: float, heading: float, reach: float
) -> None:
    """Copy what the camera sees from `truth` to `seen`: exact walks through the cells, from edge to edge."""
    rays = int(2 * FIELD_OF_VIEW_DEG * math.pi / 180.0 * reach) + 2
    for ray in range(rays):
        angle = heading + math.radians(FIELD_OF_VIEW_DEG) * (ray / (rays - 1) - 0.5)
        along_x, along_y = math.cos(angle), math.sin(angle)
        column, row = int(x), int(y)
        step_x, step_y = (1 if along_x > 0 else -1), (1 if along_y > 0 else -1)
        pace_x, pace_y = 1.0 / max(abs(along_x), 1e-12), 1.0 / max(abs(along_y), 1e-12)
        next_x = pace_x * (column + 1 - x if along_x > 0 else x - column)
        next_y = pace_y * (row + 1 - y if along_y > 0 else y - row)
        travelled = 0.0
        while travelled <= reach and truth[row, column] != _UNKNOWN:
            seen[row, column] = truth[row, column]
            if truth[row, column] == _WALL:
                break
            if next_x < next_y:
                column, travelled, next_x = column + step_x, next_x, next_x + pace_x
            else:
                row, travelled, next_y = row + step_y, next_y, next_y + pace_y
