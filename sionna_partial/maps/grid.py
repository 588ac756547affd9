"""Cells and positions of a grid: states, free-standing walls, unknown rooms, polygons, the nearest free cells."""

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import scipy
import shapely
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, States, largest_by_area, with_neighbours
from sionna_partial.checks import float_array, real_array, shown
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError

FREE_STANDING_M = 2.5
"""Extent along x and y up to which free-standing walls are furniture [m]."""

ROOM_M, BODY_M = 0.6, 0.3
"""Radius of a disc that fits into an unknown room, and of one that can enter it [m]."""

FAR_EXTENTS = 2.0
"""Distance from the middle of a map, in its extents, from which positions have another unit or map."""

POCKET_M = 0.4
"""Edge of a square in unknown regions that a robot would look into [m]."""


class Grid(Protocol):
    """Cells on a regular grid in the world, such as a PartialMap."""

    @property
    def state(self) -> States:
        """States (ny, nx)."""
        ...

    @property
    def resolution_m(self) -> float:
        """Edge of a cell [m]."""
        ...

    @property
    def origin_m(self) -> tuple[float, float]:
        """World x and y of the lower-left corner [m]."""
        ...


def area_polygon(name: str, corners_m: ArrayLike) -> shapely.Polygon:
    """Return the polygon with corners (M, 2) in x and y [m]; a MapError names the argument."""
    remedy = "give the corners (M, 2) of a polygon without crossings, x and y in metres"
    corners = float_array(name, corners_m, MapError, f"{remedy}.")
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise MapError(f"{name} has shape {corners.shape}: {remedy}.")
    if not np.isfinite(corners).all():
        wrong = corners[~np.isfinite(corners).all(axis=1)][0].tolist()
        raise MapError(f"{name} has the corner {wrong}: {remedy}, all finite.")
    polygon = shapely.Polygon(corners)
    if not polygon.is_valid or not polygon.area:
        what = f"{name} = {shown(corners.tolist())} is no polygon ({shapely.is_valid_reason(polygon)})"
        raise MapError(f"{what}: {remedy}.")
    return polygon


def cell_centres_m(grid: Grid, cells: NDArray[np.generic]) -> Floats:
    """Return x and y of the centres of cells (..., 2), rows and columns [m]."""
    return (np.asarray(cells, dtype=np.float64)[..., ::-1] + 0.5) * grid.resolution_m + grid.origin_m


def nearest_free_m(grid: Grid, at_m: ArrayLike, count: int = 1) -> Floats:
    """Return the centres (K, 2) of the free cells nearest to a position (2,) [m], at most `count`."""
    free_m = cell_centres_m(grid, np.argwhere(grid.state == CellState.FREE))
    return free_m[np.hypot(*(free_m - np.asarray(at_m, dtype=np.float64)).T).argsort(kind="stable")[:count]]


def unknown_pockets(state: States, resolution_m: float) -> Bools:
    """Return unknown cells of enclosed regions without a square of `POCKET_M`, as in furniture and pillars."""
    unknown = np.pad(state == CellState.UNKNOWN, 1, constant_values=True)
    size = max(1, math.ceil(POCKET_M / resolution_m - 1e-6))
    regions, count = scipy.ndimage.label(unknown, np.ones((3, 3), dtype=bool))
    wide = np.zeros(count + 1, dtype=bool)
    wide[regions[scipy.ndimage.binary_opening(unknown, np.ones((size, size), dtype=bool))]] = True
    wide[regions[0, 0]] = True
    return (unknown & ~wide[regions])[1:-1, 1:-1]


def has_unknown_room(state: States, resolution_m: float) -> bool:
    """Return whether there is an unknown room as in `PartialMap.is_nearly_complete`, or no wall."""
    state = np.pad(state, math.ceil(BODY_M / resolution_m) + 1, constant_values=CellState.UNKNOWN)
    unknown, opened = state == CellState.UNKNOWN, state != CellState.WALL
    if opened.all():
        return True
    clear = scipy.ndimage.distance_transform_edt(opened) * resolution_m > BODY_M
    parts, count = scipy.ndimage.label(clear, np.ones((3, 3), dtype=bool))
    from_free = np.zeros(count + 1, dtype=bool)
    from_free[parts[clear & (state == CellState.FREE)]] = True
    regions, count = scipy.ndimage.label(unknown)
    entered = np.unique(regions[unknown & from_free[parts]])
    radii_m = largest_by_area(scipy.ndimage.distance_transform_edt(unknown), regions, count)[entered] * resolution_m
    return bool(((entered == regions[0, 0]) | (radii_m >= ROOM_M)).any())


def free_standing(state: States, resolution_m: float) -> Bools:
    """Return free-standing wall cells (ny, nx), as `PartialMap.with_obstacle_height`.

    Unknown cells that only walls touch belong to them.
    """
    state, square = np.pad(state, 1, constant_values=CellState.UNKNOWN), np.ones((3, 3), dtype=bool)
    unknown, _ = scipy.ndimage.label(state == CellState.UNKNOWN)
    is_open = np.zeros(unknown.max() + 1, dtype=bool)
    is_open[unknown[scipy.ndimage.binary_dilation(state == CellState.FREE)]] = True
    is_open[unknown[0, 0]] = True
    beyond = is_open[unknown] & (unknown > 0)
    solid = (state != CellState.FREE) & ~beyond
    pieces, _ = scipy.ndimage.label(solid, square)
    most = FREE_STANDING_M / resolution_m + 1e-6
    small = [max(part.stop - part.start for part in extent) <= most for extent in scipy.ndimage.find_objects(pieces)]
    stands = np.array([False, *small])
    stands[pieces[with_neighbours(beyond)]] = False
    return np.asarray((stands[pieces] & (state == CellState.WALL))[1:-1, 1:-1])


def window(cells: States, row: int, column: int, shape: tuple[int, int], fill: int) -> States:
    """Return `shape` cells from a row and column on; `fill` is the value outside the grid."""
    ny, nx = cells.shape
    rows, columns = np.arange(row, row + shape[0]), np.arange(column, column + shape[1])
    inside = np.ix_((rows >= 0) & (rows < ny), (columns >= 0) & (columns < nx))
    found = np.full(shape, fill, np.uint8)
    found[inside] = cells[np.ix_(rows[(rows >= 0) & (rows < ny)], columns[(columns >= 0) & (columns < nx)])]
    return found


def cells_within(grid: Grid, where: object) -> Bools:
    """Return the cells (ny, nx) of an area, as `where` of `PartialMap.with_wall_material`."""
    shape = grid.state.shape
    if not isinstance(where, shapely.Geometry):
        area = real_array("where", where, MapError, "give cells (ny, nx) as booleans, or a polygon.", "biuf")
        if area.dtype == np.bool_ and area.shape == shape:
            return area
        if area.dtype == np.bool_:
            what = f"where has shape {area.shape}"
            raise MapError(f"{what}: give booleans {shape}, or corners (M, 2) of a polygon in metres.")
        where = area_polygon("where", area)
    elif not where.is_valid:
        remedy = "give a geometry without crossings, of finite coordinates, or repair it with shapely.make_valid."
        raise MapError(f"where is no area ({shapely.is_valid_reason(where)}): {remedy}")
    centres = cell_centres_m(grid, np.moveaxis(np.indices(shape), 0, -1))
    return np.asarray(shapely.contains_xy(where, centres[..., 0], centres[..., 1]))


def states_by_height(state: States, obstacle: States, heights_m: Sequence[float]) -> list[tuple[float, States]]:
    """Return heights [m] and states of the walls up to them, full walls (infinite) first.

    States of full walls have free cells instead of obstacles and the areas that they enclose.
    """
    within = scipy.ndimage.binary_fill_holes(obstacle > 0) & (state == CellState.UNKNOWN)
    found = [(math.inf, np.where((obstacle > 0) | within, CellState.FREE, state))]
    for number in np.unique(obstacle[obstacle > 0]).tolist():
        other = np.where(state == CellState.UNKNOWN, CellState.UNKNOWN, CellState.FREE)
        found.append((heights_m[number - 1], np.where(obstacle == number, CellState.WALL, other)))
    return found


def unit_hint(bounds_m: Sequence[float], point_m: Floats, can_stand: Callable[[Floats], Bools]) -> str:
    """Ask for metres if a position (3,) would be on the map in another unit."""
    x0, y0, x1, y1 = bounds_m
    if not np.abs(point_m[:2] - ((x0 + x1) / 2, (y0 + y1) / 2)).max() > FAR_EXTENTS * max(x1 - x0, y1 - y0):
        return ""
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2)):
        for scale in (np.array([factor, factor, 1.0]), np.full(3, factor)):
            meant = point_m * scale
            if can_stand(meant[None])[0]:
                text = ", ".join(f"{value:g}" for value in meant)
                return f" Did you mean metres? Taken for {unit} it is at ({text}) m."
    return ""
