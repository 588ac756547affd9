"""Camera of a robot: range readings, their errors, and the resulting map."""

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from sionna_partial.arrays import Floats, Indices, States
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.wall_cells import wall_cells
from sionna_partial.process import njit
from sionna_partial.settings import SensorSettings

MISSED_PATCH_M = 0.5
"""Edge of the squares whose walls are missed together, like a pane or a mirror [m]."""

GRAZING_DEG = 5.0
"""Angle to a wall's face below which sensors with errors get no return [degree]."""


RAY_DEG = 0.5
"""Least angle between rays of a sensor with errors [degree]; lidars of robots have 0.25 to 1."""


class Fusion(NamedTuple):
    """Rule of a mapper for cells by rays that end in them (hits) and cross them (passes).

    `by_scan` counts each picture once in a cell, as a hit if any of its rays ends there. A hit adds `passes_of_hit`
    passes. From `min_passes` a cell is known, and wall if hits / passes exceeds `max_free`. A distance of `travel_m`
    or a turn of `turn_deg` triggers the next picture. Rays without a wall in range clear up to `cleared_m`.
    """

    by_scan: bool
    passes_of_hit: int
    min_passes: int
    max_free: float
    travel_m: float
    turn_deg: float
    cleared_m: float = math.inf


def _log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))


_SUM_OF_ODDS = _log_odds(0.55) - _log_odds(0.49)

_HALF_RADIAN_DEG = math.degrees(0.5)

FUSIONS = {
    "exact": Fusion(False, 1, 1, 0.0, 0.0, 0.0),
    "slam_toolbox": Fusion(False, 2, 3, 0.1, 0.5, _HALF_RADIAN_DEG),
    "gmapping": Fusion(False, 1, 1, 0.25, 1.0, _HALF_RADIAN_DEG),
    "cartographer": Fusion(True, 1, 1, -_log_odds(0.49) / _SUM_OF_ODDS, 0.2, 1.0, 5.0),
    "vacuum": Fusion(False, 1, 1, 0.25, 0.5, _HALF_RADIAN_DEG),
}
"""Rules of mappers, with their default parameters.

- slam_toolbox (`OccupancyGrid::UpdateCell` in `karto_sdk/Karto.h`): wall where hits / passes > 0.1, known from three
  passes; a hit adds two. `minimum_travel_distance` and `minimum_travel_heading` are 0.5.
- gmapping (`slam_gmapping.cpp`): wall where hits / (hits + passes) > `occ_thresh`, 0.25. `linearUpdate` is 1 m,
  `angularUpdate` 0.5.
- Cartographer (`trajectory_builder_2d.lua`): `hit_probability` 0.55, `miss_probability` 0.49; wall where the log odds
  are positive, here without limits. `motion_filter` has 0.2 m and 1 degree, `missing_data_ray_length` is 5 m.
- vacuum: as gmapping, with thinned walls (`Camera.map`). The rules of firmware are not published.

Rays that return from beyond the range clear it, as with `max_laser_range` and `maxUrange` below the sensor's limit.
Rays without a return are dropped, as in these mappers and their ROS drivers.
"""

_FREE, _WALL, _UNKNOWN = int(CellState.FREE), int(CellState.WALL), int(CellState.UNKNOWN)
_NO_ECHO, _WALL_ECHO, _FAR = 0, 1, 2


class Camera:
    """Camera in a home (ny, nx) with unknown cells all around; it maps with the believed pose.

    The map is `seen` (ny, nx). Positions are in cells, x along columns and y along rows.
    """

    def __init__(self, truth: States, resolution_m: float, sensor: SensorSettings, rng: np.random.Generator) -> None:
        self._truth = np.ascontiguousarray(truth)
        rows, columns = ((np.arange(size) * resolution_m // MISSED_PATCH_M).astype(np.intp) for size in truth.shape)
        missed = rng.random((rows[-1] + 1, columns[-1] + 1)) < sensor.missed_wall_fraction
        self._missed = missed[np.ix_(rows, columns)]
        self._range_cells = sensor.range_m / resolution_m
        self._view_deg = sensor.field_of_view_deg
        self._sensor, self._cell_m, self._rng = sensor, resolution_m, rng
        self.fusion = FUSIONS["exact" if sensor.is_exact else sensor.fusion]
        self._hits, self._passes = np.zeros((2, *truth.shape), dtype=np.int32)
        self.seen = np.full_like(self._truth, _UNKNOWN)

    @property
    def map(self) -> States:
        """The map of the robot; a vacuum robot thins its walls."""
        if self._sensor.is_exact or self._sensor.fusion != "vacuum":
            return self.seen
        thinned = wall_cells(self.seen, self._cell_m, bridge_gap_m=0.0).cells
        beside = ndimage.binary_dilation(self.seen == _FREE)
        without = np.where(self.seen == _WALL, np.where(beside, _FREE, _UNKNOWN), self.seen)
        return np.where(thinned, _WALL, without).astype(np.uint8)

    def look(self, x: float, y: float, heading_deg: float, shift: tuple[float, float], under: Indices) -> None:
        """Add a picture taken at x, y, with the believed position `shift` from there.

        The cells `under` the robot (N, 2), rows and columns at the believed position, are free.
        """
        rays = self._rays(x, y, heading_deg, shift)
        middle = np.array([y + shift[1], x + shift[0]])
        range_cells = max(self._range_cells, float(np.abs(under - middle).max(initial=0.0)))
        corner = np.clip(middle - range_cells - 1, 0, self.seen.shape).astype(np.intp)
        end = np.clip(middle + range_cells + 2, 0, self.seen.shape).astype(np.intp)
        part = slice(corner[0], end[0]), slice(corner[1], end[1])
        seen, fusion = self.seen[part], self.fusion
        hits, passes = np.zeros((2, *seen.shape), dtype=np.int32)
        _cast_rays(self._truth, self._missed, hits, passes, (int(corner[0]), int(corner[1])), rays)
        _fuse(self._hits[part], self._passes[part], hits, passes, fusion, seen)
        rows, columns = (under - corner).T
        seen[rows, columns] = _FREE
        self._hits[part][rows, columns] = 0
        self._passes[part][rows, columns] += fusion.min_passes

    def _rays(self, x: float, y: float, heading_deg: float, shift: tuple[float, float]) -> "_Rays":
        sensor, rng = self._sensor, self._rng
        apart_deg = 0.0 if sensor.is_exact else RAY_DEG
        angles = _ray_angles(heading_deg, self._view_deg, self._range_cells, apart_deg)
        noise = sensor.range_noise_m / self._cell_m * rng.standard_normal(len(angles))
        if sensor.is_exact:
            return _Rays((x, y), shift, angles, noise, self._range_cells)
        turn = math.radians(sensor.heading_noise_deg) * rng.standard_normal()
        lost = rng.random(len(angles)) < sensor.missed_return_fraction
        noise[lost] = math.nan
        cleared_cells = min(self._range_cells, self.fusion.cleared_m / self._cell_m)
        grazing = math.sin(math.radians(GRAZING_DEG))
        return _Rays((x, y), shift, angles, noise, self._range_cells, cleared_cells, turn, grazing)


def unknown_in_view(
    state: States, cell: Indices, headings_deg: Floats, cell_m: float, sensor: SensorSettings
) -> list[Indices]:
    """Return for each heading the unknown cells (N, 2) in view if none were walls."""
    range_cells = sensor.range_m / cell_m
    low = np.maximum(cell - math.ceil(range_cells) - 2, 0)
    window = state[tuple(slice(start, end + math.ceil(range_cells) + 3) for start, end in zip(low, cell, strict=True))]
    window = np.pad(window, 1, constant_values=_WALL)
    bright, missed = np.where(window == _WALL, window, np.uint8(_FREE)), np.zeros(window.shape, dtype=np.bool_)
    row, column = cell - low + 1.5
    shown = []
    for heading_deg in headings_deg:
        hits, passes = np.zeros((2, *window.shape), dtype=np.int32)
        angles = _ray_angles(heading_deg, sensor.field_of_view_deg, range_cells)
        rays = _Rays((column, row), (0.0, 0.0), angles, np.zeros_like(angles), range_cells)
        _cast_rays(bright, missed, hits, passes, (0, 0), rays)
        shown.append(np.argwhere((passes > 0) & (window == _UNKNOWN)) + low - 1)
    return shown


def view_corners_m(home: PartialMap, pose: Floats, sensor: SensorSettings) -> Floats:
    """Return the corners (N, 2) [m] of the view from a pose (x, y [m], heading [degree]), the camera first."""
    truth = np.pad(home.state, 1, constant_values=_UNKNOWN)
    range_cells = sensor.range_m / home.resolution_m
    x, y = (pose[:2] - home.origin_m) / home.resolution_m + 1
    angles = _ray_angles(float(pose[2]), sensor.field_of_view_deg, range_cells)
    ranges_m = _ranges(truth, float(x), float(y), angles, range_cells) * home.resolution_m
    ends = pose[:2] + ranges_m[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([pose[None, :2], ends])


def _ray_angles(heading_deg: float, view_deg: float, range_cells: float, apart_deg: float = 0.0) -> Floats:
    """Return directions of rays [radian], up to half a cell apart at their ends, at least `apart_deg`."""
    rays = int(2 * math.radians(view_deg) * range_cells) + 2
    if apart_deg > 0.0:
        rays = min(rays, int(view_deg / apart_deg) + 2)
    return math.radians(heading_deg) + math.radians(view_deg) * (np.arange(rays) / (rays - 1) - 0.5)


class _Rays(NamedTuple):
    """Rays of one picture: start, believed minus true position, and angles [radian].

    `noise` is NaN without a reading, `range_cells` and `cleared_cells` limit readings and rays without a wall,
    `grazing` is the sine of the smallest angle to a face with a reading.
    """

    start: tuple[float, float]
    shift: tuple[float, float]
    angles: Floats
    noise: Floats
    range_cells: float
    cleared_cells: float = math.inf
    turn: float = 0.0
    grazing: float = 0.0


class _Walk(NamedTuple):
    """A ray in one of its cells, and where it enters and leaves the cell [cells].

    At a corner it crosses one of the two cells beside it.
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
def _cast_rays(truth, missed, hits, passes, corner, rays):
    """Count rays of one picture that end in walls and cross cells, from the cell `corner` on."""
    (x, y), shift, angles, noise, range_cells, cleared_cells, turn, grazing = rays
    for ray in range(len(angles)):
        echo, reading = _read(truth, missed, x, y, angles[ray], range_cells, grazing)
        reading += noise[ray]
        if math.isnan(reading):
            continue
        length = min(range_cells, cleared_cells) if echo == _FAR else range_cells
        walk = _start(x + shift[0], y + shift[1], angles[ray] + turn)
        row, column = walk.row - corner[0], walk.column - corner[1]
        while 0 <= row < hits.shape[0] and 0 <= column < hits.shape[1] and walk.enters <= length:
            if echo != _FAR and walk.leaves > reading:
                if echo == _WALL_ECHO:
                    hits[row, column] += 1
                break
            passes[row, column] += 1
            walk = _next(walk)
            row, column = walk.row - corner[0], walk.column - corner[1]


@njit(cache=True)
def _fuse(all_hits, all_passes, hits, passes, fusion, seen):
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            hit, passed = hits[row, column], passes[row, column]
            if hit + passed == 0:
                continue
            if fusion.by_scan:
                hit, passed = min(hit, 1), 1 - min(hit, 1)
            all_hits[row, column] += hit
            all_passes[row, column] += passed + fusion.passes_of_hit * hit
            if all_passes[row, column] >= fusion.min_passes:
                is_wall = all_hits[row, column] > fusion.max_free * all_passes[row, column]
                seen[row, column] = _WALL if is_wall else _FREE


@njit(cache=True)
def _ranges(truth, x, y, angles, range_cells):
    missed, ranges = np.zeros(truth.shape, np.bool_), np.empty(len(angles))
    for ray in range(len(angles)):
        ranges[ray] = _read(truth, missed, x, y, angles[ray], range_cells, 0.0)[1]
    return ranges


@njit(cache=True)
def _read(truth, missed, x, y, angle, range_cells, grazing):
    """Return what ends a ray (wall, unknown cell, nothing), and a distance within that cell.

    The distance is NaN where a wall is missed, or met at a sine of less than `grazing` to its face.
    """
    walk, row = _start(x, y, angle), -1
    while walk.enters <= range_cells:
        if truth[walk.row, walk.column] == _WALL:
            sine = abs(math.cos(angle)) if walk.row == row else abs(math.sin(angle))
            is_lost = missed[walk.row, walk.column] or sine < grazing
            return _WALL_ECHO, math.nan if is_lost else (walk.enters + walk.leaves) / 2
        if truth[walk.row, walk.column] == _UNKNOWN:
            return _NO_ECHO, (walk.enters + walk.leaves) / 2
        row = walk.row
        walk = _next(walk)
    return _FAR, range_cells


@njit(cache=True)
def _start(x, y, angle):
    along_x, along_y = math.cos(angle), math.sin(angle)
    column, row = math.floor(x), math.floor(y)
    step_x, step_y = (1 if along_x > 0 else -1), (1 if along_y > 0 else -1)
    pace_x, pace_y = 1.0 / max(abs(along_x), 1e-12), 1.0 / max(abs(along_y), 1e-12)
    next_x = pace_x * (column + 1 - x if along_x > 0 else x - column)
    next_y = pace_y * (row + 1 - y if along_y > 0 else y - row)
    leaves = max(min(next_x, next_y), 1e-9)
    return _Walk(row, column, 0.0, leaves, step_x, step_y, pace_x, pace_y, next_x, next_y)


@njit(cache=True)
def _next(walk):
    row, column, next_x, next_y = walk.row, walk.column, walk.next_x, walk.next_y
    if next_x < next_y:
        column, next_x = column + walk.step_x, next_x + walk.pace_x
    else:
        row, next_y = row + walk.step_y, next_y + walk.pace_y
    leaves = max(min(next_x, next_y), walk.leaves + 1e-9)
    return _Walk(row, column, walk.leaves, leaves, walk.step_x, walk.step_y, walk.pace_x, walk.pace_y, next_x, next_y)
