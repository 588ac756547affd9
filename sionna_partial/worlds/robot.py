"""The exploring robot: frontiers, goals and routes, after Active Neural SLAM (Chaplot et al., ICLR 2020).

Randomly drawn frontiers and shortest paths over seen cells replace the learnt policies.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sionna_partial.arrays import Bools, Floats, Indices, States, grid_edges, largest_part
from sionna_partial.constants import CellState
from sionna_partial.maps.environment import frontier_cells
from sionna_partial.settings import SensorSettings
from sionna_partial.worlds.camera import Camera

_FREE, _WALL, _UNKNOWN = int(CellState.FREE), int(CellState.WALL), int(CellState.UNKNOWN)

WIDE_M = 0.35
"""Length of a frontier that is about as wide as a robot [m]."""

FORWARD_M = 0.25
"""Length of a forward action [m] (Active Neural SLAM, Section 4)."""

TURN_DEG = 10
"""Angle of a turn [degree] (Active Neural SLAM, Section 4)."""

ROBOT_RADII_M = (0.18, 0.14, 0.1, 0.06, 0.0)
"""Possible radii of the robot [m]; the largest fitting one is used."""

ROAMED_FRACTION = 0.95
"""Fraction of the free area that the robot must reach."""

GOAL_RANGES = 2.0
"""Sensor ranges that the robot drives before it chooses a new goal [1].

25 actions with the 3.2 m camera of Active Neural SLAM (Section 4).
"""

GOAL_SHARPNESS = 3.0
"""Exponent of a frontier's promise in its odds to become the goal [1].

Fitted to the paper's mean observed fractions on real homes; always taking the best frontier would see more.
"""

_AHEAD_M = 0.3

_BUMP_M = 0.25

_ARRIVAL_M = 0.3

_DECISION_STEPS = 5.0

_EIGHT = np.ones((3, 3), dtype=bool)

_SMALLEST_FRONTIER_CELLS = 3

_COMFORT_M = 0.3

_COMFORT_COST = 3.0

_TIGHT_COST = 15.0


class Frontier(NamedTuple):
    """Free cells (n, 2) beside unseen ones, and the route (m, 2) to their middle."""

    cells: Indices
    route: Indices
    cost_m: float
    """Length of the route [m], weighted beside walls."""


Choice = Callable[["Robot", list[Frontier]], int]


class Robot:
    """Pose, map and plan of a robot in a home (ny, nx) with free cells, and unknown cells all around.

    Lengths are in cells, x along columns, y along rows. The robot at `position` plans with `believed_position` on its
    map `seen`.
    """

    def __init__(
        self, truth: States, resolution_m: float, seed: int, sensor: SensorSettings, choose: Choice | None = None
    ) -> None:
        self._choose = choose
        self._rng, errors = np.random.default_rng(seed), np.random.default_rng((seed, 1))
        self._cell_m = resolution_m
        self._radius, self._roomy = _fitting_radius(truth == _FREE, resolution_m)
        rows, columns = np.mgrid[-int(self._radius) : int(self._radius) + 1, -int(self._radius) : int(self._radius) + 1]
        self._footprint = np.argwhere(np.hypot(rows, columns) <= self._radius) - int(self._radius)
        self._goal_steps = max(1, int(GOAL_RANGES * sensor.range_m / FORWARD_M))
        self._given_up = np.zeros(truth.shape, dtype=bool)
        self._bumps = np.zeros(truth.shape, dtype=bool)
        self._route: Indices | None = None  # cells (n, 2), the last of them the goal
        self._route_steps = 0
        self.is_finished = False
        row, column = self._rng.choice(np.argwhere(self._roomy))
        self.position = column + 0.5, row + 0.5
        self.heading_deg = float(self._rng.integers(360 // TURN_DEG) * TURN_DEG)
        self._shift = 0.0, 0.0
        direction = errors.uniform(0.0, math.tau)
        self._drift = sensor.drift_m_per_m * math.cos(direction), sensor.drift_m_per_m * math.sin(direction)
        self._camera = Camera(truth, resolution_m, sensor, errors)
        self._pictured = (math.inf, math.inf), 0.0
        self._look()

    @property
    def seen(self) -> States:
        return self._camera.seen

    @property
    def map(self) -> States:
        return self._camera.map

    @property
    def believed_position(self) -> tuple[float, float]:
        """Position in the estimate of the robot."""
        return self.position[0] + self._shift[0], self.position[1] + self._shift[1]

    def act(self) -> None:
        """Do one action towards a frontier, and look; do nothing if none can be reached."""
        if self.is_finished:
            return
        route = self._route
        if route is None or self._route_steps >= self._goal_steps or self._is_done(route[-1]):
            frontiers = self.frontiers()
            if not frontiers:
                self.is_finished = True
                return
            if self._choose is None:
                chosen = frontiers[self._draw(frontiers)]
            else:
                wide = wide_frontiers(frontiers, self._cell_m)
                chosen = wide[self._choose(self, wide)]
            route = self._route = chosen.route
            self._route_steps = 0
        self._route_steps += 1
        ahead = int(np.argmin(self._distances_to(route))) + max(1, round(_AHEAD_M / self._cell_m))
        error_deg = self._turn_to(route[min(ahead, len(route) - 1)])
        if abs(error_deg) > TURN_DEG / 2:
            self.heading_deg = (self.heading_deg + math.copysign(TURN_DEG, error_deg)) % 360.0
        elif not self._step_forward():
            self._bump(route[-1])
        self._look()

    def _look(self) -> None:
        (x, y), heading_deg = self._pictured
        turned_deg = abs((self.heading_deg - heading_deg + 180.0) % 360.0 - 180.0)
        moved_m = math.hypot(self.position[0] - x, self.position[1] - y) * self._cell_m
        if moved_m < self._camera.fusion.travel_m and turned_deg < self._camera.fusion.turn_deg:
            return
        self._pictured = self.position, self.heading_deg
        under = self._footprint + self._cell()
        inside = ((under >= 0) & (under < self.seen.shape)).all(axis=1)
        self._camera.look(*self.position, self.heading_deg, self._shift, under[inside])

    def _cell(self) -> tuple[int, int]:
        (x, y), (ny, nx) = self.believed_position, self.seen.shape
        return min(max(int(y), 0), ny - 1), min(max(int(x), 0), nx - 1)

    def _turn_to(self, cell: Indices) -> float:
        """Return the turn that faces a cell [degree], from -180 to 180."""
        x, y = self.believed_position
        bearing_deg = math.degrees(math.atan2(int(cell[0]) + 0.5 - y, int(cell[1]) + 0.5 - x))
        return (bearing_deg - self.heading_deg + 180.0) % 360.0 - 180.0

    def frontiers(self) -> list[Frontier]:
        return find_frontiers(self.seen, self._cell(), self._cell_m, self._radius, self._bumps, self._given_up)

    def steps_to(self, frontier: Frontier) -> float:
        return frontier.cost_m / FORWARD_M + abs(self._turn_to(frontier.route[-1])) / TURN_DEG

    def _draw(self, frontiers: list[Frontier]) -> int:
        promises = [math.sqrt(len(goal.cells)) / (self.steps_to(goal) + _DECISION_STEPS) for goal in frontiers]
        odds = np.array(promises) ** GOAL_SHARPNESS
        return int(self._rng.choice(len(frontiers), p=odds / odds.sum()))

    def _distances_to(self, cells: Indices) -> Floats:
        x, y = self.believed_position
        distances: Floats = np.hypot(cells[..., 0] + 0.5 - y, cells[..., 1] + 0.5 - x)
        return distances

    def _is_done(self, goal: Indices) -> bool:
        around = part_of((goal[0] - 1, goal[1] - 1), (goal[0] + 2, goal[1] + 2))
        middle = min(int(goal[0]), 1), min(int(goal[1]), 1)
        arrived = self._distances_to(goal) * self._cell_m < _ARRIVAL_M
        may_turn = self._choose is not None and self._route_steps >= _DECISION_STEPS
        return bool((arrived or may_turn) and not (frontier_cells(self.seen[around]) & ~self._given_up[around])[middle])

    def _step_forward(self) -> bool:
        """Move ahead, sliding along walls; return whether at least half of the step was made."""
        angle, length = math.radians(self.heading_deg), FORWARD_M / self._cell_m
        parts = math.ceil(2 * length)
        along_x, along_y = math.cos(angle) * length / parts, math.sin(angle) * length / parts
        (x, y), length_moved = self.position, 0.0
        for _ in range(parts):
            for move_x, move_y in ((along_x, along_y), (along_x, 0.0), (0.0, along_y)):
                if self._has_room(x + move_x, y + move_y, (int(y), int(x))):
                    x, y, length_moved = x + move_x, y + move_y, length_moved + math.hypot(move_x, move_y)
                    break
        made = math.hypot(x - self.position[0], y - self.position[1])
        self.position = x, y
        self._shift = self._shift[0] + self._drift[0] * length_moved, self._shift[1] + self._drift[1] * length_moved
        return made >= length / 2

    def _has_room(self, x: float, y: float, cell: tuple[int, int]) -> bool:
        """Return whether the robot fits at x, y and gets there; walls that meet at a corner block it."""
        row, column = int(y), int(x)
        beside = self._roomy[row, cell[1]] or self._roomy[cell[0], column]
        return bool(self._roomy[row, column] and beside)

    def _bump(self, goal: Indices) -> None:
        apart = _BUMP_M / self._cell_m
        angle, (x, y) = math.radians(self.heading_deg), self.believed_position
        x, y = x + math.cos(angle) * apart / 2, y + math.sin(angle) * apart / 2
        rows, columns = self._cells_around(y, x, apart)
        self._bumps[rows, columns] |= np.hypot(rows + 0.5 - y, columns + 0.5 - x) < apart / 2
        if self._distances_to(goal) < 2 * apart:
            rows, columns = self._cells_around(int(goal[0]), int(goal[1]), apart)
            self._given_up[rows, columns] |= np.hypot(rows - goal[0], columns - goal[1]) <= apart
        self._route = None

    def _cells_around(self, row: float, column: float, apart: float) -> tuple[Indices, Indices]:
        ny, nx = self.seen.shape
        rows = np.arange(max(0, int(row - apart)), max(0, min(ny, int(row + apart) + 2)))
        columns = np.arange(max(0, int(column - apart)), max(0, min(nx, int(column + apart) + 2)))
        return rows[:, None], columns[None]


def _fitting_radius(free: Bools, resolution_m: float) -> tuple[float, Bools]:
    """Return the largest radius [cells] that gets around, and the possible cells of its centre."""
    distance = ndimage.distance_transform_edt(free) - 0.5
    part = largest_part(free)
    for radius in np.array(ROBOT_RADII_M) / resolution_m:
        roomy = largest_part(part & (distance >= radius))
        covered = part & (ndimage.distance_transform_edt(~roomy) <= radius + 1.0)
        if roomy.any() and covered.sum() >= ROAMED_FRACTION * part.sum():
            break
    return float(radius), roomy


def find_frontiers(
    state: States, start: tuple[int, int], cell_m: float, radius: float, tight: Bools, left_out: Bools
) -> list[Frontier]:
    """Find the frontiers of a map (ny, nx) that a robot of some radius [cells] can reach.

    `tight` cells are hard to cross; `left_out` cells belong to no frontier.
    """
    known = state != _UNKNOWN
    known[start] = True
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    part = part_of((rows[0] - 1, columns[0] - 1), (rows[-1] + 2, columns[-1] + 2))
    corner = np.array([part[0].start, part[1].start])
    labels, count = ndimage.label(frontier_cells(state[part]) & ~left_out[part], structure=_EIGHT)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    cost = _travel_cost(state[part], cell_m, radius, tight[part])
    router = _Router(cost, tuple(start - corner))
    found = []
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        if sizes[label - 1] < _SMALLEST_FRONTIER_CELLS:
            continue
        cells = np.argwhere(labels[box] == label) + np.add(corner, [side.start for side in box])
        middle = cells[np.argmin(np.hypot(*(cells - cells.mean(axis=0)).T))]
        cost_m = float(router.costs[tuple(middle - corner)] * cell_m)
        if math.isfinite(cost_m):
            found.append(Frontier(cells, router.path_to(middle - corner) + corner, cost_m))
    return found


def wide_frontiers(frontiers: list[Frontier], cell_m: float) -> list[Frontier]:
    return [frontier for frontier in frontiers if len(frontier.cells) * cell_m >= WIDE_M] or frontiers


def part_of(low: Sequence[int], high: Sequence[int]) -> tuple[slice, slice]:
    """Return a part of a map, clipped to it."""
    return slice(max(0, int(low[0])), int(high[0])), slice(max(0, int(low[1])), int(high[1]))


def _travel_cost(state: States, cell_m: float, radius: float, tight: Bools) -> Floats:
    """Return costs of cells: 1 in the open, more beside walls, 0 (impassable) where not seen free."""
    distance = ndimage.distance_transform_edt(state != _WALL) - 0.5
    nearness = np.clip(1.0 - distance * cell_m / _COMFORT_M, 0.0, 1.0)
    cost = 1.0 + _COMFORT_COST * nearness
    cost[(distance < radius) | tight] = _TIGHT_COST
    cost[state != _FREE] = 0.0
    return cost


class _Router:
    """Shortest paths from one cell in eight directions; cost 0 blocks."""

    def __init__(self, cost: Floats, start: tuple[int, ...]) -> None:
        self._cells = np.argwhere(cost > 0)
        self._index = np.full(cost.shape, -1)
        self._index[tuple(self._cells.T)] = np.arange(len(self._cells))
        ends, costs = grid_edges(cost)
        graph = csr_array((costs, self._index.ravel()[ends]), shape=(len(self._cells),) * 2)
        options = {"directed": False, "indices": self._index[start], "return_predecessors": True}
        cheapest, self._before = dijkstra(graph, **options)
        self.costs = np.full(cost.shape, np.inf)
        self.costs[tuple(self._cells.T)] = cheapest

    def path_to(self, cell: Indices) -> Indices:
        path = [self._index[tuple(cell)]]
        while self._before[path[-1]] >= 0:
            path.append(self._before[path[-1]])
        return self._cells[path[::-1]]
