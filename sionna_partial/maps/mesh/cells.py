"""SceneMesh -> PartialMap: the cells in which a mesh has surfaces, and its observed area."""

import math
import os
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, States, largest_by_area, row_runs, span_in_strip
from sionna_partial.checks import number_of, shown
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.environment import MAX_CELLS, ImportNotes, MapWarning
from sionna_partial.maps.grid import area_polygon
from sionna_partial.maps.import_report import ENCLOSED_FRACTION
from sionna_partial.maps.mesh.cut import BORDER_M, clip_slab
from sionna_partial.maps.mesh.scene_mesh import SceneMesh, height_pair
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.process import njit

DEFAULT_BAND_M = (1.0, 1.8)
"""Height band of walls above the lowest point [m]: above tables, below lintels."""

DEFAULT_RESOLUTION_M = 0.05

DEGREES = 0.1
"""Largest extent of a building in degrees."""

SMALLEST_M, HIGHEST_M = 0.1, 100.0
"""Smallest extent along x or y, and largest height, of a mesh in metres [m]."""

LOWEST_CEILING_M = 2.2
"""Height of the lowest rooms [m]."""

FEET_STOREY, FOOT_M, WIDE_RATIO = (7.0, 11.0), 0.3048, 2.0
"""Height of a storey in feet, length of a foot [m], and ratio of width to height above that of tall halls."""

LEVEL_M, LEVEL_FRACTION = 0.1, 0.3
"""Height of a level in which flat surfaces are counted [m]; least fraction of the largest level for floor or
ceiling."""

UPRIGHT_NORMAL = 0.2
"""Largest vertical part of the normal of a wall."""

RIM_M = 0.3
"""Largest width of free rims between walls and unknown cells, which become unknown [m]."""


OPENING_M, SOLID_M = 2.0, 0.5
"""Widest opening of outer walls that leaves rooms indoors; width of the widest wall drawn by both faces [m]."""

UPS = ("z", "y", "-z", "-y")
"""Axes of a file that may point up."""

UNIT_REMEDY = "give unit_m, the length of its unit in metres"


@dataclass(frozen=True)
class MeshReading:
    """Options of `load_map` for meshes."""

    height_band_m: tuple[float, float] | None = None
    observed: ArrayLike | PartialMap | None = None
    resolution_m: float | None = None
    up: str | None = None
    unit_m: float | None = None

    def __post_init__(self) -> None:
        if self.up is not None and not (isinstance(self.up, str) and self.up in UPS):
            raise MapError(f'up = {shown(self.up)} is not allowed: choose "z", "y", "-z" or "-y".')
        require_unit(self.unit_m)

    def notes(self, file: str | os.PathLike[str], unit_source: str = "taken for metres") -> ImportNotes:
        return ImportNotes(file, self.unit_m or 1.0, unit_source if self.unit_m is None else "unit_m")

    def attached(self, notes: ImportNotes, partial: PartialMap) -> PartialMap:
        """Return a map with its report; the extent is checked if all of the file is observed."""
        free = "give the observed area, the height_band_m of its walls, or sensor_positions_m of a cloud."
        return notes.attached_to(partial, size="" if self.observed is not None else f"{UNIT_REMEDY}.", free=free)


def require_unit(unit_m: object) -> None:
    if unit_m is not None and not 1e-6 <= number_of(unit_m) <= 1e6:
        remedy = "give the length of a unit in metres, such as 0.3048 for feet or 0.001 for millimetres."
        raise MapError(f"unit_m = {shown(unit_m)} is not allowed: {remedy}")


def mesh_map(mesh: SceneMesh, reading: MeshReading, *, is_metric: bool = False) -> PartialMap:
    """Convert a mesh to a map that carries it, cut to its known cells; `is_metric` if its format has metres.

    Walls along lattice lines are in the cells above or to the right, or on the other side if those are unknown.
    """
    if reading.unit_m is not None:
        mesh = replace(mesh, vertices_m=mesh.vertices_m * reading.unit_m, height_range_m=None)
    empty = fitted_grid(mesh.bounds_m, DEFAULT_RESOLUTION_M if reading.resolution_m is None else reading.resolution_m)
    require_metres("the mesh", mesh.bounds_m, reading.height_band_m)
    if not is_metric:
        warn_of_feet("the mesh", mesh.bounds_m, _storey_m(mesh), reading)
    band_m = _band(mesh, reading.height_band_m)
    upper = _cells_with_surfaces(mesh, empty, band_m, upper=True)
    if reading.observed is not None:
        known = observed_cells(empty, reading.observed)
    else:
        known = _cells_with_surfaces(mesh, empty, (-math.inf, math.inf), upper=True)
        known |= _without_floor(known, upper, empty) if _is_upright(mesh) else False
    lower = _cells_with_surfaces(mesh, empty, band_m, upper=False)
    lost = np.pad(upper & ~known, ((0, 1), (0, 1)))
    state = np.where(known, CellState.FREE, CellState.UNKNOWN).astype(np.uint8)
    state[known & (upper | (lower & (lost[1:, :-1] | lost[:-1, 1:] | lost[1:, 1:])))] = CellState.WALL
    narrow, is_rim = _narrow(state, empty.resolution_m)
    state[narrow] = np.where(is_rim, CellState.UNKNOWN, CellState.WALL)[narrow]
    partial = replace(empty, state=state, mesh=mesh)
    return partial if reading.observed is None else cut_to_known(partial)


def require_metres(what: str, bounds_m: Floats, height_band_m: object) -> None:
    x, y, z = (float(extent) for extent in np.ptp(bounds_m, axis=0))
    require_no_degrees(what, bounds_m)
    if max(x, y) < SMALLEST_M or (z > HIGHEST_M and height_band_m is None):
        raise MapError(
            f"{what} spans {x:g} x {y:g} x {z:g} m: {UNIT_REMEDY}, 0.01 for centimetres, 1000 for kilometres"
            + (", or give the height_band_m of the walls if it is so high." if z > HIGHEST_M else ".")
        )


def require_no_degrees(what: str, bounds: Floats) -> None:
    """Raise a MapError for longitudes and latitudes: an extent far below a unit, far from the origin of the globe."""
    (low, high), size = bounds[:, :2], np.ptp(bounds[:, :2], axis=0)
    is_on_globe = (np.abs(bounds[:, :2]) <= (180.0, 90.0)).all() or (np.abs(bounds[:, :2]) <= (90.0, 180.0)).all()
    if is_on_globe and size.max() < DEGREES and (np.abs(low + high) / 2 > max(20.0 * size.max(), 1.0)).all():
        where = f"x {low[0]:.7g} to {high[0]:.7g} and y {low[1]:.7g} to {high[1]:.7g}"
        remedy = "project it to metres (such as UTM) in the program that it comes from."
        raise MapError(f"{what} spans {where}, as if in degrees of longitude and latitude: {remedy}")


def warn_of_feet(what: str, bounds_m: Floats, storey_m: float, reading: MeshReading) -> None:
    """Warn of a wide storey with a height usual in feet, unless a unit is given."""
    x, y, _ = np.ptp(bounds_m, axis=0)
    if reading.unit_m is None and FEET_STOREY[0] <= storey_m <= FEET_STOREY[1] and min(x, y) >= WIDE_RATIO * storey_m:
        size = f"{what} spans {x:.3g} x {y:.3g} m, with a storey of {storey_m:.3g} m, as if it were in feet"
        warnings.warn(f"{size}: give unit_m={FOOT_M} for feet, or unit_m=1 for metres.", MapWarning, stacklevel=5)


def _storey_m(mesh: SceneMesh) -> float:
    """Return the height from the lowest floor to the next surface, or of the mesh without one [m]."""
    corners = mesh.corners_m
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(area, axis=1)
    flat = np.abs(area[:, 2]) > 0.99 * size
    low_m, high_m = mesh.bounds_m[:, 2]
    level = np.rint((corners[flat, :, 2].mean(axis=1) - low_m) / LEVEL_M).astype(np.int64)
    areas = np.bincount(level, size[flat], minlength=1)
    levels_m = LEVEL_M * np.flatnonzero(areas >= max(LEVEL_FRACTION * areas.max(), 1e-9))
    above_m = levels_m[levels_m >= levels_m.min(initial=np.inf) + LOWEST_CEILING_M]
    return float(above_m[0] - levels_m[0] if len(above_m) else high_m - low_m)


def cut_to_known(partial: PartialMap) -> PartialMap:
    if partial.mesh is None:
        return partial
    row, start, end = row_runs(partial.state != CellState.UNKNOWN)
    cells = shapely.union_all(shapely.box(start, row, end, row + 1))
    # The lattice lines are multiples of the resolution, so that walls on them are on the border exactly.
    first = np.rint(np.array(partial.origin_m) / partial.resolution_m)
    if np.allclose(first * partial.resolution_m, partial.origin_m, rtol=0, atol=1e-9):
        area = shapely.transform(cells, lambda corners: (corners + first) * partial.resolution_m)
    else:
        area = shapely.transform(cells, lambda corners: corners * partial.resolution_m + partial.origin_m)
    return replace(partial, mesh=partial.mesh.within(area))


def narrow_areas(free: Bools, resolution_m: float, width_m: float = RIM_M) -> Bools:
    """Return free cells (ny, nx) of areas narrower than a width everywhere."""
    area, count = ndimage.label(np.pad(free, 1))
    to_border_m = (ndimage.distance_transform_edt(area > 0) - 0.5) * resolution_m
    widest_m = 2.0 * largest_by_area(to_border_m, area, count)
    narrow: Bools = (widest_m < width_m)[area][1:-1, 1:-1] & free
    return narrow


def _narrow(state: States, resolution_m: float) -> tuple[Bools, Bools]:
    """Return free cells (ny, nx) of narrow areas, and which are rims beside unknown cells; others are inside walls."""
    free = state == CellState.FREE
    unknown = np.pad(state == CellState.UNKNOWN, 1)
    area, count = ndimage.label(free)
    beside = np.zeros(count + 1, dtype=bool)
    beside[area[ndimage.binary_dilation(unknown)[1:-1, 1:-1]]] = True
    return narrow_areas(free, resolution_m), beside[area]


def fitted_grid(bounds_m: Floats, resolution_m: float) -> PartialMap:
    """Return a map of unknown cells around limits of x and y, on multiples of the resolution."""
    one = PartialMap(np.full((1, 1), CellState.UNKNOWN), resolution_m)
    cell = one.resolution_m
    first = np.floor(bounds_m[0, :2] / cell).astype(int) - 1
    nx, ny = (int(count) for count in np.floor(bounds_m[1, :2] / cell + BORDER_M / cell).astype(int) + 2 - first)
    if nx * ny > MAX_CELLS:
        raise MapError(
            f"resolution_m = {cell:g} makes {ny} x {nx} cells, more than {MAX_CELLS:,}: give "
            f"{cell * math.sqrt(1.1 * nx * ny / MAX_CELLS):.2g} or more, check that the file is in metres, or cut it."
        )
    x, y = (float(value) for value in first * cell)
    return PartialMap(np.full((ny, nx), CellState.UNKNOWN), cell, (x, y))


def _band(mesh: SceneMesh, given: tuple[float, float] | None) -> tuple[float, float]:
    if given is None:
        lowest = float(mesh.bounds_m[0, 2])
        return lowest + DEFAULT_BAND_M[0], lowest + DEFAULT_BAND_M[1]
    low, high = height_pair("height_band_m", given)
    lowest, highest = (float(value) for value in mesh.bounds_m[:, 2])
    if high < lowest or low > highest:
        raise MapError(f"height_band_m = {given!r} is outside the mesh, which spans z {lowest:g} to {highest:g} m.")
    return low, high


def observed_cells(empty: PartialMap, observed: ArrayLike | PartialMap) -> Bools:
    """Return the cells (ny, nx) with centres in the polygon or in known cells of the other map."""
    (ny, nx), cell = empty.shape, empty.resolution_m
    x = empty.origin_m[0] + cell * (np.arange(nx) + 0.5)
    y = empty.origin_m[1] + cell * (np.arange(ny) + 0.5)
    if isinstance(observed, PartialMap):
        known = np.pad(observed.state != CellState.UNKNOWN, 1)
        _, column = observed.cell_index(np.stack([x, np.zeros(nx)], axis=1))
        row, _ = observed.cell_index(np.stack([np.zeros(ny), y], axis=1))
        row, column = (np.clip(index + 1, 0, size - 1) for index, size in zip((row, column), known.shape, strict=True))
        cells, is_empty = known[np.ix_(row, column)], not known.any()
    else:
        polygon, is_empty = area_polygon("observed", observed), False
        shapely.prepare(polygon)
        cells = np.stack([shapely.contains_xy(polygon, x, height) for height in y])
    if not cells.any() and not is_empty:
        x0, y0, x1, y1 = empty.bounds_m
        raise MapError(
            f"observed holds no cell of the map, which spans x {x0:g} to {x1:g} m and y {y0:g} to {y1:g} m: give it in "
            "the world axes of the mesh, in metres."
        )
    return cells


def _is_upright(mesh: SceneMesh) -> bool:
    """Return whether most surfaces are walls."""
    corners = mesh.corners_m
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(doubled, axis=1)
    return bool(size[np.abs(doubled[:, 2]) < UPRIGHT_NORMAL * size].sum() > size.sum() / 2)


def _without_floor(known: Bools, wall: Bools, empty: PartialMap) -> Bools:
    """Return the extent of walls (ny, nx) with hardly any floor or ceiling, with a warning; else no cells."""
    state = states_of_lines(np.zeros((0, 2, 2)), empty, wall)
    inside, apart = state == CellState.FREE, ~ndimage.binary_dilation(wall, np.ones((3, 3)))
    if not (inside & apart).any():
        for extent in ndimage.find_objects(wall.astype(np.uint8)):
            inside[extent] = ~wall[extent]
    solid = state == CellState.WALL
    if not (inside & apart).any() or (known & inside).sum() >= ENCLOSED_FRACTION * min(inside.sum(), solid.sum()):
        return np.zeros_like(known)
    remedy = "give its observed area as observed if that is less."
    warnings.warn(
        f"the mesh has no floor, so that all space between its walls is observed: {remedy}", MapWarning, stacklevel=5
    )
    return inside | solid


def _cells_with_surfaces(mesh: SceneMesh, empty: PartialMap, band_m: Any, *, upper: bool) -> Bools:
    """Return the cells (ny, nx) with a surface between two heights; touching borders does not count."""
    corners = mesh.corners_m
    z = corners[..., 2]
    low, high = band_m
    corners = corners[(z.max(axis=1) > low + BORDER_M) & (z.min(axis=1) < high - BORDER_M)]
    limits = (np.full(len(corners), limit) for limit in band_m)
    polygons, sizes = clip_slab(corners, np.ascontiguousarray(corners[..., 2]), *limits)
    flat = (polygons[..., :2] - empty.origin_m) / empty.resolution_m
    cells = np.zeros(empty.shape, dtype=np.bool_)
    mark_cells(flat, sizes, cells, BORDER_M / empty.resolution_m, upper)
    return cells


def states_of_lines(segments: Floats, empty: PartialMap, solid: Bools | None = None) -> States:
    """Return the cell states (ny, nx): walls including `solid`, enclosed area, and unknown cells."""
    cell_m = empty.resolution_m
    cells = crossed_cells((segments - empty.origin_m) / cell_m, empty.shape, BORDER_M / cell_m)
    margin = math.ceil(OPENING_M / cell_m)
    wall = np.pad(cells if solid is None else cells | solid, margin)
    # A disc of half the opening's width that rolls along the outer walls does not enter the building.
    radius = OPENING_M / 2 / cell_m
    to_wall = ndimage.distance_transform_edt(~wall)
    area, _ = ndimage.label(to_wall > radius)
    outside = ndimage.distance_transform_edt(area != area[0, 0]) <= radius
    area, count = ndimage.label(~(wall | outside))
    widest_m = 2 * cell_m * largest_by_area(to_wall, area, count)
    inside = area > 0
    state = np.full(wall.shape, CellState.UNKNOWN, dtype=np.uint8)
    state[inside] = CellState.FREE
    state[wall | (inside & (widest_m <= SOLID_M)[area])] = CellState.WALL
    return state[margin:-margin, margin:-margin]


def crossed_cells(lines: Floats, shape: tuple[int, int], margin: float) -> Bools:
    """Return the cells (ny, nx) that lines (N, 2, 2) [cells] cross by over a margin."""
    corners, cells = np.zeros((len(lines), 5, 2)), np.zeros(shape, dtype=np.bool_)
    corners[:, :2] = lines
    mark_cells(corners, np.full(len(lines), 2), cells, margin, True)
    return cells


@njit(cache=True)
def mark_cells(polygons, sizes, cells, margin, upper):
    """Mark the cells whose inside convex polygons (F, 5, 2) [cells] reach by more than a margin.

    A surface within the margin of a lattice line is in the cells above (or right of) it, or below it.
    """
    ny, nx = cells.shape
    for index in range(len(polygons)):
        if sizes[index] == 0:
            continue
        corners = polygons[index, : sizes[index]]
        first, last = _reached(corners[:, 1].min(), corners[:, 1].max(), margin, upper)
        for row in range(max(first, 0), min(last, ny - 1) + 1):
            low = -np.inf if row == first else float(row)
            high = np.inf if row == last else row + 1.0
            left, right = span_in_strip(corners, low, high)
            if left > right:
                continue
            start, end = _reached(left, right, margin, upper)
            for column in range(max(start, 0), min(end, nx - 1) + 1):
                cells[row, column] = True


@njit(cache=True)
def _reached(low, high, margin, upper):
    first, last = int(np.floor(low + margin)), int(np.ceil(high - margin)) - 1
    if last < first:
        return (first, first) if upper else (last, last)
    return first, last
