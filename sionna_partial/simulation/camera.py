"""The robot's camera: readings of the walls, their errors, and the map that they add up to."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SensorSettings

MISSED_PATCH_M = 0.5
"""Edge of the squares [m] whose walls are missed together, as a pane or a mirror is."""

HIT_LOG_ODDS, MISS_LOG_ODDS = 0.85, -0.4
"""What a look adds to the log odds of a wall where it reports one, and where it reports free space [1].

Those of OctoMap (Hornung et al., Autonomous Robots 34, 2013, Section 5).
"""

LOG_ODDS_LIMITS = (-2.0, 3.5)
"""Least and greatest log odds of a wall [1] (OctoMap, as above), so that a map can still change."""

_FREE, _WALL, _UNKNOWN = int(CellState.FREE), int(CellState.WALL), int(CellState.UNKNOWN)
_NO_ECHO, _WALL_ECHO, _FAR = 0, 1, 2


class Camera:
    """Sees a home from where the robot is, and maps it where the robot believes to be.

    Parameters
    ----------
    truth : (ny, nx) uint8 array of CellState
        The home, with unknown cells all around.
    resolution_m : float
        Edge of a cell [m].
    sensor : SensorSettings
    rng : numpy.random.Generator
        Draws the errors.

    Attributes
    ----------
    seen : (ny, nx) uint8 array of CellState
        The map.
    """

    def __init__(
        self, truth: NDArray[np.uint8], resolution_m: float, sensor: SensorSettings, rng: np.random.Generator
    ) -> None:
        self._truth = np.ascontiguousarray(truth)
        self._missed = _missed_walls(truth, resolution_m, sensor.missed_wall_fraction, rng)
        self._reach = sensor.range_m / resolution_m
        self._view_deg = sensor.field_of_view_deg
        self._noise = sensor.range_noise_m / resolution_m
        self._rng = rng
        self._log_odds = np.zeros(truth.shape)
        self.seen = np.full_like(self._truth, _UNKNOWN)

    def look(self, x: float, y: float, heading_deg: float, shift: tuple[float, float], under: NDArray[np.intp]) -> None:
        """Add one picture to the map.

        Parameters
        ----------
        x, y : float
            Where the robot is, along columns and rows [cells].
        heading_deg : float
            Where it looks, from x towards y [degree].
        shift : (float, float)
            How far from there, along columns and rows, it believes to be [cells].
        under : (N, 2) int array
            Cells that it believes to stand on, which therefore are free: row and column.
        """
        angles = _ray_angles(heading_deg, self._view_deg, self._reach)
        noise = self._noise * self._rng.standard_normal(len(angles))
        middle = np.array([y + shift[1], x + shift[0]])
        reach = max(self._reach, float(np.abs(under - middle).max(initial=0.0)))
        corner = np.clip(middle - reach - 1, 0, self.seen.shape).astype(np.intp)
        end = np.clip(middle + reach + 2, 0, self.seen.shape).astype(np.intp)
        part = slice(corner[0], end[0]), slice(corner[1], end[1])
        log_odds, seen = self._log_odds[part], self.seen[part]
        view = np.full_like(seen, _UNKNOWN)
        rays = _Rays((x, y), shift, angles, noise, self._reach)
        _cast_rays(self._truth, self._missed, view, (int(corner[0]), int(corner[1])), rays)
        rows, columns = (under - corner).T
        view[rows, columns] = _FREE
        log_odds[rows, columns] = LOG_ODDS_LIMITS[0]
        known = view != _UNKNOWN
        change = np.where(view[known] == _WALL, HIT_LOG_ODDS, MISS_LOG_ODDS)
        log_odds[known] = np.clip(log_odds[known] + change, *LOG_ODDS_LIMITS)
        seen[known] = np.where(log_odds[known] > 0, _WALL, _FREE)


def view_corners_m(home: PartialMap, pose: NDArray[np.float64], sensor: SensorSettings) -> NDArray[np.float64]:
    """Outline what the camera has in view: as far as it reaches, and no farther than the first wall.

    Parameters
    ----------
    home : PartialMap
    pose : (3,) array
        World x, y [m], and heading from x towards y [degree].
    sensor : SensorSettings

    Returns
    -------
    (N, 2) array
        World x and y of the corners of a polygon [m], the first of them the camera.
    """
    truth = np.pad(home.state, 1, constant_values=_UNKNOWN)
    reach = sensor.range_m / home.resolution_m
    x, y = (pose[:2] - home.origin_m) / home.resolution_m + 1
    angles = _ray_angles(float(pose[2]), sensor.field_of_view_deg, reach)
    ranges_m = _ranges(truth, float(x), float(y), angles, reach) * home.resolution_m
    ends = pose[:2] + ranges_m[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([pose[None, :2], ends])


def _ray_angles(heading_deg: float, view_deg: float, reach: float) -> NDArray[np.float64]:
    """Directions of the rays [radian], at most half a cell apart where they end."""
    rays = int(2 * math.radians(view_deg) * reach) + 2
    return math.radians(heading_deg) + math.radians(view_deg) * (np.arange(rays) / (rays - 1) - 0.5)


def _missed_walls(
    truth: NDArray[np.uint8], resolution_m: float, share: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Draw the squares of the floor plan whose walls return nothing; return them cell by cell (ny, nx)."""
    rows, columns = (np.arange(size) * resolution_m // MISSED_PATCH_M for size in truth.shape)
    squares = rng.random((int(rows[-1]) + 1, int(columns[-1]) + 1)) < share
    return squares[np.ix_(rows.astype(np.intp), columns.astype(np.intp))]


class _Rays(NamedTuple):
    """Rays of one look: angles [radian]; start, how far from there the robot believes to be, errors, range [cells]."""

    place: tuple[float, float]
    shift: tuple[float, float]
    angles: NDArray[np.float64]
    noise: NDArray[np.float64]
    reach: float


@njit(cache=True)
def _cast_rays(
    truth: NDArray[np.uint8],
    missed: NDArray[np.bool_],
    view: NDArray[np.uint8],
    corner: tuple[int, int],
    rays: _Rays,
) -> None:
    """Write what one picture reports into `view`: free up to the reading, a wall there.

    The first cell of `view` is row and column `corner` of the home. Where several rays disagree about a cell, a wall
    counts (as in OctoMap).
    """
    (x, y), shift, angles, noise, reach = rays
    for ray in range(len(angles)):
        echo, reading = _read(truth, missed, x, y, angles[ray], reach)
        reading += noise[ray]
        walk = _start(x + shift[0], y + shift[1], angles[ray])
        row, column = walk.row - corner[0], walk.column - corner[1]
        while 0 <= row < view.shape[0] and 0 <= column < view.shape[1]:
            if echo != _FAR and walk.leaves > reading:
                if echo == _WALL_ECHO:
                    view[row, column] = _WALL
                break
            if walk.enters > reach:
                break
            if view[row, column] == _UNKNOWN:
                view[row, column] = _FREE
            walk = _next(walk)
            row, column = walk.row - corner[0], walk.column - corner[1]


@njit(cache=True)
def _ranges(
    truth: NDArray[np.uint8], x: float, y: float, angles: NDArray[np.float64], reach: float
) -> NDArray[np.float64]:
    """Return how far each ray gets [cells]."""
    missed, ranges = np.zeros(truth.shape, np.bool_), np.empty(len(angles))
    for ray in range(len(angles)):
        ranges[ray] = _read(truth, missed, x, y, angles[ray], reach)[1]
    return ranges


@njit(cache=True)
def _read(
    truth: NDArray[np.uint8], missed: NDArray[np.bool_], x: float, y: float, angle: float, reach: float
) -> tuple[int, float]:
    """Return what ends a ray, and a distance within that cell: a wall that is noticed, one that is not, or nothing."""
    walk = _start(x, y, angle)
    while walk.enters <= reach:
        if truth[walk.row, walk.column] != _FREE:
            noticed = truth[walk.row, walk.column] == _WALL and not missed[walk.row, walk.column]
            return (_WALL_ECHO if noticed else _NO_ECHO), (walk.enters + walk.leaves) / 2
        walk = _next(walk)
    return _FAR, reach


class _Walk(NamedTuple):
    """A ray in one of the cells along it, and where it enters and leaves the cell [cells].

    A ray through a corner takes one of the two cells beside it, so that it never slips between two walls. Each cell
    keeps a piece of the ray to itself, a billionth of a cell at least, so that a distance names one cell.
    """

    row: int
    column: int
    enters: float
    leaves: float
    step_x: int
    step_y: int
    pace_x: float
    pace_y: float
    next_x: float
    next_y: float


@njit(cache=True)
def _start(x: float, y: float, angle: float) -> _Walk:
    """Return a ray in the cell where it starts."""
    along_x, along_y = math.cos(angle), math.sin(angle)
    column, row = math.floor(x), math.floor(y)
    step_x, step_y = (1 if along_x > 0 else -1), (1 if along_y > 0 else -1)
    pace_x, pace_y = 1.0 / max(abs(along_x), 1e-12), 1.0 / max(abs(along_y), 1e-12)
    next_x = pace_x * (column + 1 - x if along_x > 0 else x - column)
    next_y = pace_y * (row + 1 - y if along_y > 0 else y - row)
    leaves = max(min(next_x, next_y), 1e-9)
    return _Walk(row, column, 0.0, leaves, step_x, step_y, pace_x, pace_y, next_x, next_y)


@njit(cache=True)
def _next(walk: _Walk) -> _Walk:
    """Return the ray in the next cell."""
    row, column, next_x, next_y = walk.row, walk.column, walk.next_x, walk.next_y
    if next_x < next_y:
        column, next_x = column + walk.step_x, next_x + walk.pace_x
    else:
        row, next_y = row + walk.step_y, next_y + walk.pace_y
    leaves = max(min(next_x, next_y), walk.leaves + 1e-9)
    return _Walk(row, column, walk.leaves, leaves, walk.step_x, walk.step_y, walk.pace_x, walk.pace_y, next_x, next_y)
