"""The robot's camera: range readings of the walls, their errors, and the map that they add up to."""

import math
from typing import NamedTuple

import numpy as np

from sionna_partial.arrays import Floats, Indices, States
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.process import njit
from sionna_partial.settings import SensorSettings

MISSED_PATCH_M = 0.5
"""Edge of the squares [m] whose walls are missed together, as a pane or a mirror is."""

HIT_LOG_ODDS, MISS_LOG_ODDS = 0.85, -0.4
"""Change of a cell's log odds where a picture reports a wall, and free space (Hornung et al., 2013, Section 5)."""

LOG_ODDS_LIMITS = (-2.0, 3.5)
"""Least and greatest log odds of a wall (as above), so that a map can still change."""

_FREE, _WALL, _UNKNOWN = int(CellState.FREE), int(CellState.WALL), int(CellState.UNKNOWN)
_NO_ECHO, _WALL_ECHO, _FAR = 0, 1, 2


class Camera:
    """Sees a home (ny, nx), with unknown cells all around, from where the robot is; maps it where it believes to be.

    The map is `seen` (ny, nx). Positions are in cells, x along columns and y along rows.
    """

    def __init__(self, truth: States, resolution_m: float, sensor: SensorSettings, rng: np.random.Generator) -> None:
        self._truth = np.ascontiguousarray(truth)
        rows, columns = ((np.arange(size) * resolution_m // MISSED_PATCH_M).astype(np.intp) for size in truth.shape)
        missed = rng.random((rows[-1] + 1, columns[-1] + 1)) < sensor.missed_wall_fraction
        self._missed = missed[np.ix_(rows, columns)]
        self._range_cells = sensor.range_m / resolution_m
        self._view_deg = sensor.field_of_view_deg
        self._noise = sensor.range_noise_m / resolution_m
        self._rng = rng
        self._log_odds = np.zeros(truth.shape)
        self.seen = np.full_like(self._truth, _UNKNOWN)

    def look(self, x: float, y: float, heading_deg: float, shift: tuple[float, float], under: Indices) -> None:
        """Add one picture to the map, taken at x, y but believed to be taken `shift` from there.

        The cells `under` the robot (N, 2), rows and columns where it believes to be, are free.
        """
        angles = _ray_angles(heading_deg, self._view_deg, self._range_cells)
        noise = self._noise * self._rng.standard_normal(len(angles))
        middle = np.array([y + shift[1], x + shift[0]])
        range_cells = max(self._range_cells, float(np.abs(under - middle).max(initial=0.0)))
        corner = np.clip(middle - range_cells - 1, 0, self.seen.shape).astype(np.intp)
        end = np.clip(middle + range_cells + 2, 0, self.seen.shape).astype(np.intp)
        part = slice(corner[0], end[0]), slice(corner[1], end[1])
        log_odds, seen = self._log_odds[part], self.seen[part]
        view = np.full_like(seen, _UNKNOWN)
        rays = _Rays((x, y), shift, angles, noise, self._range_cells)
        _cast_rays(self._truth, self._missed, view, (int(corner[0]), int(corner[1])), rays)
        rows, columns = (under - corner).T
        view[rows, columns] = _FREE
        log_odds[rows, columns] = LOG_ODDS_LIMITS[0]
        known = view != _UNKNOWN
        change = np.where(view[known] == _WALL, HIT_LOG_ODDS, MISS_LOG_ODDS)
        log_odds[known] = np.clip(log_odds[known] + change, *LOG_ODDS_LIMITS)
        seen[known] = np.where(log_odds[known] > 0, _WALL, _FREE)


def unknown_in_view(
    state: States, cell: Indices, headings_deg: Floats, cell_m: float, sensor: SensorSettings
) -> list[Indices]:
    """Unknown cells (N, 2) that a picture taken in a cell would show if none of them were walls, for each heading."""
    range_cells = sensor.range_m / cell_m
    low = np.maximum(cell - math.ceil(range_cells) - 2, 0)
    window = state[tuple(slice(start, end + math.ceil(range_cells) + 3) for start, end in zip(low, cell, strict=True))]
    window = np.pad(window, 1, constant_values=_WALL)
    bright, missed = np.where(window == _WALL, window, np.uint8(_FREE)), np.zeros(window.shape, dtype=np.bool_)
    row, column = cell - low + 1.5
    shown = []
    for heading_deg in headings_deg:
        view = np.full_like(window, _UNKNOWN)
        angles = _ray_angles(heading_deg, sensor.field_of_view_deg, range_cells)
        _cast_rays(
            bright, missed, view, (0, 0), _Rays((column, row), (0.0, 0.0), angles, np.zeros_like(angles), range_cells)
        )
        shown.append(np.argwhere((view == _FREE) & (window == _UNKNOWN)) + low - 1)
    return shown


def view_corners_m(home: PartialMap, pose: Floats, sensor: SensorSettings) -> Floats:
    """Corners (N, 2) [m] of what the camera sees from a pose (x, y [m], heading [degree]), the first at the camera."""
    truth = np.pad(home.state, 1, constant_values=_UNKNOWN)
    range_cells = sensor.range_m / home.resolution_m
    x, y = (pose[:2] - home.origin_m) / home.resolution_m + 1
    angles = _ray_angles(float(pose[2]), sensor.field_of_view_deg, range_cells)
    ranges_m = _ranges(truth, float(x), float(y), angles, range_cells) * home.resolution_m
    ends = pose[:2] + ranges_m[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([pose[None, :2], ends])


def _ray_angles(heading_deg: float, view_deg: float, range_cells: float) -> Floats:
    """Directions of the rays [radian], at most half a cell apart where they end."""
    rays = int(2 * math.radians(view_deg) * range_cells) + 2
    return math.radians(heading_deg) + math.radians(view_deg) * (np.arange(rays) / (rays - 1) - 0.5)


class _Rays(NamedTuple):
    """Rays of one picture: angles [radian]; start, where the robot believes to be less start, errors, range [cells]."""

    start: tuple[float, float]
    shift: tuple[float, float]
    angles: Floats
    noise: Floats
    range_cells: float


class _Walk(NamedTuple):
    """A ray in one of the cells along it, and where it enters and leaves the cell [cells].

    A ray through a corner crosses one of the two cells beside it, so that it never slips between two walls. It is
    at least a billionth of a cell long in each cell, so that a distance belongs to one cell.
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
def _cast_rays(truth, missed, view, corner, rays):  # type: ignore[no-untyped-def]
    """Write what one picture reports into `view`, whose first cell is `corner` of the home: free up to the reading.

    Where rays disagree about a cell, a wall counts (as in OctoMap).
    """
    (x, y), shift, angles, noise, range_cells = rays
    for ray in range(len(angles)):
        echo, reading = _read(truth, missed, x, y, angles[ray], range_cells)
        reading += noise[ray]
        walk = _start(x + shift[0], y + shift[1], angles[ray])
        row, column = walk.row - corner[0], walk.column - corner[1]
        while 0 <= row < view.shape[0] and 0 <= column < view.shape[1]:
            if echo != _FAR and walk.leaves > reading:
                if echo == _WALL_ECHO:
                    view[row, column] = _WALL
                break
            if walk.enters > range_cells:
                break
            if view[row, column] == _UNKNOWN:
                view[row, column] = _FREE
            walk = _next(walk)
            row, column = walk.row - corner[0], walk.column - corner[1]


@njit(cache=True)
def _ranges(truth, x, y, angles, range_cells):  # type: ignore[no-untyped-def]
    """Length of each ray [cells]."""
    missed, ranges = np.zeros(truth.shape, np.bool_), np.empty(len(angles))
    for ray in range(len(angles)):
        ranges[ray] = _read(truth, missed, x, y, angles[ray], range_cells)[1]
    return ranges


@njit(cache=True)
def _read(truth, missed, x, y, angle, range_cells):  # type: ignore[no-untyped-def]
    """Return what ends a ray (a wall that is noticed, one that is not, or nothing), and a distance within that cell."""
    walk = _start(x, y, angle)
    while walk.enters <= range_cells:
        if truth[walk.row, walk.column] != _FREE:
            noticed = truth[walk.row, walk.column] == _WALL and not missed[walk.row, walk.column]
            return (_WALL_ECHO if noticed else _NO_ECHO), (walk.enters + walk.leaves) / 2
        walk = _next(walk)
    return _FAR, range_cells


@njit(cache=True)
def _start(x, y, angle):  # type: ignore[no-untyped-def]
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
def _next(walk):  # type: ignore[no-untyped-def]
    """Return the ray in the next cell."""
    row, column, next_x, next_y = walk.row, walk.column, walk.next_x, walk.next_y
    if next_x < next_y:
        column, next_x = column + walk.step_x, next_x + walk.pace_x
    else:
        row, next_y = row + walk.step_y, next_y + walk.pace_y
    leaves = max(min(next_x, next_y), walk.leaves + 1e-9)
    return _Walk(row, column, walk.leaves, leaves, walk.step_x, walk.step_y, walk.pace_x, walk.pace_y, next_x, next_y)
