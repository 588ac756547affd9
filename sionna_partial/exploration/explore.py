"""Robot simulator: a complete home -> the maps of a robot after given numbers of steps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats, States, read_only
from sionna_partial.checks import Progress, are_stages, is_whole, require, require_choice, settings_or_default
from sionna_partial.constants import CellState
from sionna_partial.display import Pictured, reporting
from sionna_partial.errors import MapError
from sionna_partial.maps.mesh.cells import cut_to_known
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.settings import Policy, SensorSettings
from sionna_partial.worlds.robot import Choice, Robot

MAX_STEPS = 100_000

VAIN_STEPS = 1000
"""Actions without progress after which a robot stops: errors of its map may block every route."""

PROGRESS = 0.005

_FREE, _UNKNOWN = int(CellState.FREE), int(CellState.UNKNOWN)
_MARGIN_M = 2.0
_REPORT_STEPS = 10


@read_only
@dataclass(frozen=True, eq=False)
class Exploration(Pictured, plot="plots.exploration_plot:plot_exploration"):
    """Trajectory of a robot through a home, and its map at several moments.

    Parameters
    ----------
    home : PartialMap
    sensor : SensorSettings
    steps : (M,) tuple of int
        Numbers of actions [1], increasing.
    states : (M, ny, nx) uint8 array of CellState
        Robot's map after each of `steps`, on the grid of `home`.
    poses : (N, 3) array
        World x, y [m], and heading from x towards y [degree] after 0, 1, ... actions.
    believed_poses : (N, 3) array
        Robot's estimate; equal to `poses` without drift.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> found = sp.explore_trajectory(sp.make_home(3), steps=(20, 60))
    >>> len(found.maps), found.poses.shape
    (2, (61, 3))
    """

    home: PartialMap
    sensor: SensorSettings
    steps: tuple[int, ...]
    states: States
    poses: Floats
    believed_poses: Floats

    @property
    def maps(self) -> list[PartialMap]:
        """Maps of the robot after each of `steps`, with `interior_cells`; a mesh is cut to the known cells."""
        free = int((self.home.state == _FREE).sum())
        return [cut_to_known(replace(self.home, state=state, interior_cells=free)) for state in self.states]

    @property
    def observed_fractions(self) -> Floats:
        """The `observed_fraction` of each of `maps`, (M,) in [0, 1]."""
        seen = (self.states == _FREE).sum(axis=(1, 2))
        return np.minimum(1.0, seen / (self.home.state == _FREE).sum())

    def at(self, steps: Sequence[int]) -> Exploration:
        """Return the exploration with some of its `steps`.

        Raises
        ------
        SettingsError
            For a step that was not kept.
        """
        remedy = f"choose from the steps that were kept: {', '.join(map(str, self.steps))}."
        require(len(steps) > 0 and set(steps) <= set(self.steps), "steps", steps, remedy)
        index = [k for k, step in enumerate(self.steps) if step in steps]
        kept, last = tuple(self.steps[k] for k in index), self.steps[index[-1]] + 1
        poses, believed = self.poses[:last], self.believed_poses[:last]
        return replace(self, steps=kept, states=self.states[index], poses=poses, believed_poses=believed)


def explore(
    home: PartialMap,
    steps: Sequence[float] = (50, 100, 150, 200),
    seed: int = 0,
    *,
    sensor: SensorSettings | None = None,
    policy: Policy = "random",
    tx: ArrayLike | None = None,
) -> list[PartialMap]:
    """Send a robot through a home and return its map at several moments.

    The robot starts at a random free pose. Each step it drives towards a frontier between seen and unseen cells, or
    turns, and then looks: rays run through the cells to the first wall. It stays when nothing is left to see.

    Parameters
    ----------
    home : PartialMap
        Complete; unknown cells stop the robot and its view.
    steps : sequence of int or float
        Increasing numbers of actions [1], at most 100,000; the map after 0 is empty. Or increasing fractions of the
        free area in [0, 1]: the first map with that fraction, or the last one if nothing is left to see or 1000 actions
        made no progress.
    seed : int
        Seed of start, heading, goals and errors, at least 0.
    sensor : SensorSettings or None
        By default without errors: observations are exact.
    policy : {"random", "coverage"}
        Choice of frontiers: random, or by the expected decrease of the coverage's uncertainty as in `next_views` (about
        a minute for 300 steps).
    tx : (3,), (2,), (T, 3) or (T, 2) array-like, optional
        Transmitters [m] for the policy "coverage"; by default any position.

    Returns
    -------
    list of PartialMap
        One for each of `steps`, on the grid of `home`, with `interior_cells`. Known cells stay known; without errors
        they keep their states. A mesh is cut to the known cells.

    Raises
    ------
    MapError
        If the home is not a PartialMap, or has no free cell.
    SettingsError
        For steps, seed, sensor or policy that are not allowed.
    PositionError
        For a transmitter outside the home or in a wall.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> maps = sp.explore(sp.make_home(3, "apartment"), steps=(50, 200), seed=3)
    >>> maps[0].observed_fraction < maps[1].observed_fraction
    True
    """
    return explore_trajectory(home, steps, seed, sensor=sensor, policy=policy, tx=tx).maps


def explore_trajectory(
    home: PartialMap,
    steps: Sequence[float] = (50, 100, 150, 200),
    seed: int = 0,
    *,
    sensor: SensorSettings | None = None,
    policy: Policy = "random",
    tx: ArrayLike | None = None,
    progress: Progress | bool | None = None,
) -> Exploration:
    """Explore a home as `explore` does, and return the trajectory too.

    Parameters
    ----------
    home, steps, seed, sensor, policy, tx
        As of `explore`.
    progress : bool or callable, optional
        As in `predict_map`.

    Raises
    ------
    MapError, SettingsError, PositionError
        As `explore`.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.explore_trajectory(sp.make_home(3), steps=(20, 60)).poses.shape
    (61, 3)
    """
    remedy = (
        f"give increasing whole numbers of 0 to {MAX_STEPS:,}, such as (50, 100, 150, 200), or increasing fractions "
        "of the free area in [0, 1], such as (0.25, 0.5, 0.75)."
    )
    require(are_stages(steps) and steps[-1] <= MAX_STEPS, "steps", steps, remedy)
    require(is_whole(seed), "seed", seed, "give a whole number of 0 or more.")
    sensor = settings_or_default("sensor", sensor, SensorSettings)
    require_choice("policy", policy, get_args(Policy))
    require_map("home", home)
    if not (home.state == _FREE).any():
        raise MapError("home has 0 free cells: a robot needs somewhere to stand; give a map with free cells.")
    margin = 1 if sensor.is_exact else 1 + math.ceil(_MARGIN_M / home.resolution_m)
    padded = np.pad(home.state, margin, constant_values=_UNKNOWN)
    free = np.argwhere(padded == _FREE)
    (row0, column0), (row1, column1) = free.min(axis=0) - margin, free.max(axis=0) + margin + 1
    corner_m = np.array(home.origin_m) + (np.array([column0, row0]) - margin) * home.resolution_m
    choose: Choice | None = None
    if policy == "coverage":
        from sionna_partial.exploration.next_views import coverage_choice  # xarray, which other robots do without

        corner = int(row0) - margin, int(column0) - margin
        choose = coverage_choice(replace(home, mesh=None), corner, tx, sensor)
    robot = Robot(padded[row0:row1, column0:column1], home.resolution_m, int(seed), sensor, choose)

    by_fraction = not all(map(is_whole, steps))
    best, last_progress = 0.0, 0
    reached: list[int] = []
    states: list[States] = []
    poses: list[Floats] = []
    with reporting(progress) as report:
        for step in itertools.count():
            if step:
                robot.act()
            positions_m = corner_m + np.array([robot.position, robot.believed_position]) * home.resolution_m
            poses.append(np.column_stack([positions_m, [robot.heading_deg] * 2]))
            done, gives_up = float(step), False
            if by_fraction:
                done = int((robot.seen == _FREE).sum()) / len(free) if step else 0.0
                if done > best + PROGRESS:
                    best, last_progress = done, step
                gives_up = robot.is_finished or step >= last_progress + VAIN_STEPS
            while len(reached) < len(steps) and (gives_up or steps[len(reached)] <= done):
                reached.append(step)
                state = np.full_like(padded, _UNKNOWN)
                if step:
                    state[row0:row1, column0:column1] = robot.map
                states.append(state[margin:-margin, margin:-margin])
            is_last = len(reached) == len(steps)
            if step % _REPORT_STEPS == 0 or is_last:
                fraction = len(reached) / len(steps) if by_fraction else step / max(1.0, float(steps[-1]))
                report(fraction, f"exploring: step {step}")
            if is_last:
                break
    true, believed = np.array(poses).transpose(1, 0, 2)
    return Exploration(home, sensor, tuple(reached), np.array(states), true, believed)
