"""Point clouds -> PartialMap, read in parts and kept as occupied voxels."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import float_array, real_array
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M, CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.environment import ImportNotes
from sionna_partial.maps.importers.cloud_files import PART, Parts, opened_cloud
from sionna_partial.maps.mesh.cells import (
    DEFAULT_BAND_M,
    DEFAULT_RESOLUTION_M,
    MeshReading,
    fitted_grid,
    narrow_areas,
    observed_cells,
    require_metres,
    warn_of_feet,
)
from sionna_partial.maps.mesh.scene_mesh import MAX_COORDINATE_M, height_pair
from sionna_partial.maps.mesh.upright import (
    END_M,
    FURNITURE_M,
    TURNS,
    Ends,
    levelling,
    looks_y_up,
    plateaus_m2,
    surfaces_of_points,
    warn_of_axis,
)
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.process import njit

MAX_SENSOR_M = 200.0
"""Largest distance of a sensor from the map [m]."""

LAYER_M = 0.05
"""Height of a voxel [m]."""

FLOOR_FRACTION = 0.3
"""Least fraction of the cells of the fullest layer in a floor or ceiling."""

SLAB_M = 0.5
"""Largest height of full layers of a floor or ceiling [m]; more is a cloud of walls."""

LOWEST_CEILING_M, BELOW_FLOOR_M, ABOVE_CEILING_M = 1.9, 0.2, 0.15
"""Least height of a ceiling; depth below the floor and height above the ceiling that count [m]."""

WALL_FRACTION = 0.25
"""Least fraction of the layers of the height band in a wall, relative to fuller cells (90 %)."""

THIN_FRACTION = 0.5
"""Cells with certainly less than this fraction of a neighbour's points are noise of its wall."""

WINDOW_M, STRAY_FRACTION = 0.35, 0.2
"""Edge of the squares in which floor cells are counted [m]; fraction of the usual count below which they are strays."""

GAP_M, HOLE_M2 = 0.15, 1.0
"""Half the width of gaps, and area of holes, in a scanned floor that are closed unless walls bound them; smallest free
area."""

POSE_M = 0.25
"""Sensor positions closer than this are merged [m]."""

SAMPLED = 50_000
"""Points of a part from which the direction up is found."""

PLATE_LAYERS, MAX_PLATE_CELLS = 3, 25_000_000
"""Most layers of a flat surface, and most cells in which such surfaces are searched."""

_HALF, _BITS = 1 << 20, 21


class _Axes(NamedTuple):
    """Rotation and shift [m] from the axes of a cloud to the world."""

    turn: Floats
    shift_m: Floats

    def world(self, points_m: Floats) -> Floats:
        if np.array_equal(self.turn, np.eye(3)):
            return points_m
        return points_m @ self.turn.T + self.shift_m


class _Voxels(NamedTuple):
    """Occupied voxels of a cloud, in the world's axes.

    `cells` (V, 3) are their x, y and z, `counts` (V,) their numbers of points, `heights_m` the number of points and the
    sum of their heights [m] in each layer, and `sample` (S, 3) some of the points [m].
    """

    cells: NDArray[np.int64]
    counts: NDArray[np.int64]
    heights_m: dict[int, tuple[int, float]]
    sample: Floats

    @property
    def bounds(self) -> NDArray[np.int64]:
        """Lowest corner, and corner above the highest (2, 3) [voxels]."""
        return np.stack([self.cells.min(axis=0), self.cells.max(axis=0) + 1])


def map_from_points(
    points: ArrayLike | str | os.PathLike[str],
    *,
    sensor_positions_m: ArrayLike | None = None,
    height_band_m: tuple[float, float] | None = None,
    observed: ArrayLike | PartialMap | None = None,
    resolution_m: float | None = None,
    up: str | None = None,
    unit_m: float | None = None,
    wall_height_m: float | None = None,
) -> PartialMap:
    """Make a map from a point cloud.

    Floor and ceiling are the layers with points in most cells. Cells with points in the height band are walls; others
    with points between floor and ceiling, and small gaps, are free. Heights of the map start at the floor. Except PCD
    and PLY, files are read in parts: memory grows with the building, not with the number of points.

    Parameters
    ----------
    points : (N, 3) array-like or path-like
        x, y, z [m]; or a PCD, PLY, LAS, LAZ or text file (XYZ, PTS). Points that are not finite are skipped.
    sensor_positions_m : (M, 2) or (M, 3) array-like, or None
        Sensor positions in the axes of the cloud [m]: the space to its points is free.
    height_band_m : (float, float) or None
        z of the cloud between which points are walls [m], which also selects a storey.
    observed, resolution_m, up, unit_m
        As in `load_map`; by default free and wall cells are observed. Other arguments are in metres.
    wall_height_m : float or None
        Height of walls and ceiling [m]; by default the cloud's ceiling, or 3.

    Raises
    ------
    MapError
        For a damaged, too large or unknown file, a cloud in another unit, or other values.

    Examples
    --------
    >>> import numpy as np, sionna_partial as sp
    >>> x, y = np.meshgrid(np.arange(0.02, 4, 0.04), np.arange(0.02, 3, 0.04))
    >>> floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    >>> wall = np.column_stack([x.ravel(), np.full(x.size, 2.98), y.ravel()])
    >>> room = sp.importers.map_from_points(np.concatenate([floor, wall]))
    >>> room.state_at([[2.0, 1.0], [2.0, 2.97], [2.0, 4.0]]).tolist()
    [0, 1, 2]
    """
    reading = MeshReading(height_band_m, observed, resolution_m, up, unit_m)
    if isinstance(points, str | os.PathLike):
        path = Path(points)
        with opened_cloud(path) as parts:
            partial = _cloud_map(f"path = '{path}'", parts, reading, sensor_positions_m, reading.notes(path))
    else:
        cloud = real_array("points", points, MapError, "give x, y, z in metres, (N, 3), or the path of a file.")
        if cloud.ndim != 2 or cloud.shape[1] != 3:
            raise MapError(f"points has shape {cloud.shape}: give x, y, z in metres, (N, 3), or the path of a file.")

        starts = range(0, len(cloud), PART)
        partial = _cloud_map(
            "points",
            lambda: (cloud[start : start + PART] for start in starts),
            reading,
            sensor_positions_m,
            reading.notes("points"),
        )
    return partial if wall_height_m is None else replace(partial, wall_height_m=wall_height_m)


def _cloud_map(
    what: str,
    parts: Parts,
    reading: MeshReading,
    sensor_positions_m: ArrayLike | None,
    notes: ImportNotes,
) -> PartialMap:
    cell = DEFAULT_RESOLUTION_M if reading.resolution_m is None else reading.resolution_m
    cell = PartialMap(np.full((1, 1), CellState.UNKNOWN), cell).resolution_m
    axes = _Axes(TURNS[reading.up or "z"], np.zeros(3))
    voxels = _occupied_voxels(what, parts(), cell, axes, reading, notes)
    size = np.array([cell, cell, LAYER_M])
    bounds = voxels.bounds * size
    require_metres(what, bounds - [[0.0], [1.0]] * size, reading.height_band_m)
    found = "z" if reading.up is not None else _axis_up(voxels.cells, bounds, cell)
    warn_of_axis(what, found, "z")
    turn = levelling(what, surfaces_of_points(voxels.sample), notes) if found.endswith("z") else np.eye(3)
    if turn[2, 2] < 1.0:
        axes = _Axes(turn @ axes.turn, bounds.mean(axis=0) - turn @ bounds.mean(axis=0))
        voxels = _occupied_voxels(what, parts(), cell, axes, reading, ImportNotes(what))
        bounds = voxels.bounds * size
    sensors = _sensors(sensor_positions_m, reading.up, axes)
    empty = fitted_grid(bounds, cell)
    if sensors is not None:
        x0, y0, x1, y1 = empty.bounds_m
        far = (sensors < np.array([x0, y0]) - MAX_SENSOR_M) | (sensors > np.array([x1, y1]) + MAX_SENSOR_M)
        if far.any():
            at = sensors[far.any(axis=1)][0].tolist()
            raise MapError(f"sensor_positions_m has {at}, more than {MAX_SENSOR_M:g} m from the points: give metres.")
    column, row = (voxels.cells[:, :2] - np.rint(np.array(empty.origin_m) / cell).astype(np.int64)).T
    z = (voxels.cells[:, 2] + 0.5) * LAYER_M
    floor_m, ceiling_m = _floor_and_ceiling(voxels, reading.height_band_m)
    notes.notes.append(f"floor at z = {floor_m:g} m" + ("" if ceiling_m is None else f", ceiling at {ceiling_m:g} m"))
    if ceiling_m is not None:
        warn_of_feet(what, bounds, ceiling_m - floor_m, reading)
    low, high = reading.height_band_m or (floor_m + DEFAULT_BAND_M[0], floor_m + DEFAULT_BAND_M[1])
    band = (z > low) & (z < high)
    wall = _walls(np.ravel_multi_index((row[band], column[band]), empty.shape), voxels.counts[band], empty.shape)
    seen = np.zeros(empty.shape, dtype=np.bool_)
    storey = (z > floor_m - BELOW_FLOOR_M) & (z < (math.inf if ceiling_m is None else ceiling_m + ABOVE_CEILING_M))
    seen[row[storey], column[storey]] = True
    seen &= ~ndimage.binary_dilation(wall, np.ones((3, 3)))  # noise of walls is on both of their sides
    free = _closed(_without_strays(seen, cell), wall, cell)
    if sensors is not None:
        edge = (free | wall) & ndimage.binary_dilation(~(free | wall))
        _see_through(wall, np.argwhere(edge), (sensors - empty.origin_m) / cell, free)
    known = free | wall if reading.observed is None else observed_cells(empty, reading.observed)
    state = np.where(known, np.where(wall, CellState.WALL, CellState.FREE), CellState.UNKNOWN).astype(np.uint8)
    state[_enclosed(state == CellState.FREE, cell)] = CellState.UNKNOWN
    height_m = DEFAULT_WALL_HEIGHT_M if ceiling_m is None else ceiling_m - floor_m
    return reading.attached(notes, replace(empty, state=state, wall_height_m=round(height_m, 2)))


def _sensors(given: ArrayLike | None, up: str | None, axes: _Axes) -> Floats | None:
    if given is None:
        return None
    remedy = "give x, y (and z) in metres, (M, 2) or (M, 3)."
    positions = float_array("sensor_positions_m", given, MapError, remedy)
    if positions.ndim != 2 or positions.shape[1] not in (2, 3) or not np.isfinite(positions).all():
        raise MapError(f"sensor_positions_m has shape {positions.shape} or values that are not finite: {remedy}")
    if positions.shape[1] == 2 and up not in (None, "z"):
        raise MapError(f'sensor_positions_m has shape (M, 2) with up = "{up}": give x, y, z of the cloud, (M, 3).')
    if positions.shape[1] == 3:
        positions = axes.world(positions)
    flat = positions[:, :2]
    return flat[np.unique(np.floor(flat / POSE_M), axis=0, return_index=True)[1]]


def _occupied_voxels(
    what: str,
    parts: Iterable[NDArray[Any]],
    cell_m: float,
    axes: _Axes,
    reading: MeshReading,
    notes: ImportNotes,
) -> _Voxels:
    heights_m: dict[int, tuple[int, float]] = {}
    sample: list[Floats] = []
    base, pending = None, [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))]
    for part in parts:
        points = part[np.isfinite(part).all(axis=1)].astype(np.float64) * (reading.unit_m or 1.0)
        notes.use("points", len(points))
        notes.skip("points", len(part) - len(points), "not finite")
        if not len(points):
            continue
        if np.abs(points).max() > MAX_COORDINATE_M:
            raise MapError(f"{what} holds coordinates above {MAX_COORDINATE_M:g} m: give a cloud in metres.")
        points = axes.world(points)
        sample.append(points[:: max(1, len(points) // SAMPLED)])
        index = np.floor(points / (cell_m, cell_m, LAYER_M) + 1e-9).astype(np.int64)
        base = index[0].copy() if base is None else base
        layers, inverse = np.unique(index[:, 2], return_inverse=True)
        for layer, points_in, sum_m in zip(
            layers.tolist(), np.bincount(inverse).tolist(), np.bincount(inverse, points[:, 2]).tolist(), strict=True
        ):
            old = heights_m.get(layer, (0, 0.0))
            heights_m[layer] = old[0] + points_in, old[1] + sum_m
        index += _HALF - base
        if index.min() < 0 or index.max() >= 2 * _HALF:
            raise MapError(f"{what} spans more than {_HALF * cell_m:,.0f} m: remove stray points, or cut it.")
        key = (index[:, 0] << 2 * _BITS) | (index[:, 1] << _BITS) | index[:, 2]
        pending.append(np.unique(key, return_counts=True))
        if sum(len(keys) for keys, _ in pending[1:]) > max(4 * PART, len(pending[0][0])):
            pending = [_merged(pending)]
    if base is None:
        raise MapError(f"{what} holds no finite point: give a cloud with x, y, z in metres.")
    keys, counts = _merged(pending)
    mask = (1 << _BITS) - 1
    voxels = np.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], axis=1) - _HALF + base
    return _Voxels(voxels, counts, heights_m, np.concatenate(sample))


def _merged(pending: list[tuple[NDArray[np.int64], NDArray[np.int64]]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    keys, inverse = np.unique(np.concatenate([keys for keys, _ in pending]), return_inverse=True)
    return keys, np.bincount(inverse, np.concatenate([counts for _, counts in pending])).astype(np.int64)


def _walls(cell: NDArray[np.int64], count: NDArray[np.int64], shape: tuple[int, int]) -> Bools:
    """Return cells (ny, nx) with points in enough layers of the height band, without noise of walls."""
    size = shape[0] * shape[1]
    layers = np.bincount(cell, minlength=size).reshape(shape)
    points = np.bincount(cell, count, minlength=size).reshape(shape)
    if not len(cell):
        return layers > 0
    fuller = np.quantile(layers[layers > 0], 0.9)
    most = points + 2 * np.sqrt(points)  # of a cell with this many points on average
    is_noise = most < THIN_FRACTION * ndimage.maximum_filter(points, 3)
    return np.asarray((layers >= max(1, math.ceil(WALL_FRACTION * fuller))) & ~is_noise)


def _floor_and_ceiling(voxels: _Voxels, band_m: tuple[float, float] | None) -> tuple[float, float | None]:
    """Return the heights of the floor below a band, by default the lowest, and of the ceiling, if any [m].

    Both are the mean height of points in their two fullest layers.
    """
    layer, heights_m = voxels.cells[:, 2], voxels.heights_m
    first = int(layer.min())
    pairs = np.convolve(np.bincount(layer - first), (1, 1))[1:]  # pairs[k] counts the layers k and k + 1
    full = np.nonzero(pairs >= FLOOR_FRACTION * pairs.max())[0]
    runs = np.split(full, np.nonzero(np.diff(full) > 1)[0] + 1)
    slabs_m = []
    for run in runs:
        if len(run) * LAYER_M <= SLAB_M:
            lower = int(run[np.argmax(pairs[run])]) + first
            counts, sums_m = zip(*(heights_m.get(number, (0, 0.0)) for number in (lower, lower + 1)), strict=True)
            slabs_m.append(round(sum(sums_m) / sum(counts), 3))
    low = math.inf if band_m is None else height_pair("height_band_m", band_m)[0]
    below = [slab for slab in slabs_m if slab < low] or [first * LAYER_M]
    floor_m = below[0] if band_m is None else below[-1]
    return floor_m, next((slab for slab in slabs_m if slab >= floor_m + LOWEST_CEILING_M), None)


def _axis_up(voxels: NDArray[np.int64], bounds: Floats, cell_m: float) -> str:
    layers = [np.bincount(voxels[:, axis] - voxels[:, axis].min()) for axis in (1, 2)]
    fullest = [np.convolve(cells, (1, 1)).max() for cells in layers]
    axis = "y" if looks_y_up(np.ptp(bounds, axis=0), *fullest) else "z"
    size = (cell_m, cell_m, LAYER_M)
    centres = (voxels + 0.5) * size @ TURNS[axis].T
    ends = []
    for height_m in (centres[:, 2] - centres[:, 2].min(), centres[:, 2].max() - centres[:, 2]):
        plates = _plates(centres[height_m < END_M], cell_m)
        ends.append((plates, _plates(centres[(height_m > FURNITURE_M[0]) & (height_m < FURNITURE_M[1])], cell_m)))
    (floor_m2, low_m2), (ceiling_m2, high_m2) = ends
    return f"-{axis}" if Ends(floor_m2, ceiling_m2, low_m2, high_m2).upside_down else axis


def _plates(points_m: Floats, cell_m: float) -> float:
    """Return the area of flat surfaces between two heights [m²]: columns with few points, as wide as furniture."""
    if not len(points_m):
        return 0.0
    cell_m = max(cell_m, LAYER_M)
    index = np.floor(points_m[:, :2] / cell_m).astype(np.int64)
    index -= index.min(axis=0)
    nx, ny = (index.max(axis=0) + 1).tolist()
    if nx * ny > MAX_PLATE_CELLS:
        return 0.0
    layers = np.bincount(index[:, 0] * ny + index[:, 1], minlength=nx * ny).reshape(nx, ny)
    cells = (layers > 0) & (layers <= PLATE_LAYERS)
    return plateaus_m2(cells, cell_m)


def _without_strays(free: Bools, cell_m: float) -> Bools:
    size = 2 * round(WINDOW_M / cell_m / 2) + 1
    around = ndimage.uniform_filter(free.astype(np.float32), size, mode="constant")
    usual = np.quantile(around[free], 0.9) if free.any() else 0.0
    return np.asarray(free & (around >= STRAY_FRACTION * usual))


def _closed(free: Bools, wall: Bools, cell_m: float) -> Bools:
    """Close narrow gaps and small holes of a scanned floor, except at walls."""
    steps = max(1, round(GAP_M / cell_m))
    grown = ndimage.binary_dilation(free, iterations=steps, mask=~wall)
    open_cells = ndimage.binary_dilation(
        np.pad(~(grown | wall), 1, constant_values=True), iterations=steps, mask=np.pad(~wall, 1, constant_values=True)
    )[1:-1, 1:-1]
    closed = free | (grown & ~open_cells)
    hole, count = ndimage.label(~(closed | wall))
    labels = np.arange(count + 1)
    area_m2 = ndimage.sum_labels(np.ones_like(hole), hole, labels) * cell_m**2
    beside = [ndimage.sum_labels(side[1:-1, 1:-1], hole, labels) for side in (_beside(wall), _beside(closed))]
    small = (area_m2 <= HOLE_M2) & (beside[0] < beside[1]) & (labels > 0)
    return closed | small[hole]


def _enclosed(free: Bools, cell_m: float) -> Bools:
    """Return narrow or small free areas, as within walls, pillars and shelves."""
    area, count = ndimage.label(free)
    small = np.bincount(area.ravel(), minlength=count + 1) * cell_m**2 < HOLE_M2
    return narrow_areas(free, cell_m) | (free & small[area])


def _beside(cells: Bools) -> Bools:
    return np.pad(ndimage.binary_dilation(cells), 1)


@njit(cache=True)
def _see_through(wall, targets, sensors, free):
    """Mark the cells between sensors and the cells seen (row, column) as free."""
    ny, nx = wall.shape
    for sensor in range(len(sensors)):
        x0, y0 = sensors[sensor]
        for target in range(len(targets)):
            row, column = targets[target]
            dx, dy = column + 0.5 - x0, row + 0.5 - y0
            steps = int(2 * max(abs(dx), abs(dy))) + 1
            for marking in range(2):
                for step in range(steps):
                    y, x = int(np.floor(y0 + dy * step / steps)), int(np.floor(x0 + dx * step / steps))
                    if not (0 <= y < ny and 0 <= x < nx) or (y == row and x == column):
                        continue
                    if marking:
                        free[y, x] = True
                    elif wall[y, x]:
                        break
                else:
                    continue
                break
