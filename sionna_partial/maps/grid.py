"""Cells and positions of a grid: states, free-standing walls, unknown rooms, polygons, the nearest free cells."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, States, largest_by_area
from sionna_partial.checks import float_array, real_array, shown
from sionna_partial.constants import DEFAULT_HEIGHT_M, CellState
from sionna_partial.errors import MapError, PositionError

FREE_STANDING_M = 2.5
"""Extent along x and y up to which free-standing walls are furniture [m]."""

ROOM_M, BODY_M = 0.6, 0.3
"""Radius of a disc that fits into an unknown room, and of one that can enter it [m]."""

FAR_EXTENTS = 2.0
"""Distance from the middle of a map, in its extents, from which positions have another unit or map."""

POCKET_M = 0.4
"""Edge of a square in unknown regions that a robot would look into [m]."""

_BORDER_CELLS = 1e-6

_FREEST = np.array([CellState.FREE, CellState.UNKNOWN, CellState.WALL], dtype=np.uint8)
_RANK = np.argsort(_FREEST)


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


def state_at(
    state: States, resolution_m: float, origin_m: tuple[float, float], points_m: NDArray[np.floating]
) -> States:
    """Return the states of `PartialMap.state_at`."""
    cells = (np.asarray(points_m, dtype=float)[..., :2] - origin_m) / resolution_m
    padded = np.pad(state, 1, constant_values=CellState.UNKNOWN)
    ny, nx = state.shape
    freest = np.full(cells.shape[:-1], _RANK[CellState.WALL])
    for shift_x, shift_y in itertools.product((-_BORDER_CELLS, _BORDER_CELLS), repeat=2):
        column = np.clip(np.floor(cells[..., 0] + shift_x) + 1, 0, nx + 1).astype(np.intp)
        row = np.clip(np.floor(cells[..., 1] + shift_y) + 1, 0, ny + 1).astype(np.intp)
        freest = np.minimum(freest, _RANK[padded[row, column]])
    return _FREEST[freest]


def position_array(name: str, points_m: object, *, least: int = 1) -> Floats:
    """Return positions (3,) or (N, 3) [m] as a float64 array; a PositionError names them."""
    points = float_array(name, points_m, PositionError, "give x, y, z in metres.")
    if points.shape[-1:] != (3,) or points.ndim not in (1, 2):
        raise PositionError(f"{name} has shape {points.shape}: give x, y, z in metres, (3,) or (N, 3).")
    if points.size < 3 * least:
        raise PositionError(f"{name} has shape {points.shape}: give at least {least} position.")
    return points


def with_height(points_m: Floats) -> Floats:
    """Return positions (..., 3) [m]; positions (..., 2) get the default height."""
    return np.insert(points_m, 2, DEFAULT_HEIGHT_M, axis=-1) if points_m.shape[-1:] == (2,) else points_m


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


def frontier_cells(state: States) -> Bools:
    """Return free cells that share an edge with an unknown one, or the grid's border."""
    unknown = np.pad(state == CellState.UNKNOWN, 1, constant_values=True)
    touches = unknown[2:, 1:-1] | unknown[:-2, 1:-1] | unknown[1:-1, 2:] | unknown[1:-1, :-2]
    return np.asarray(touches & (state == CellState.FREE))


def uniform_cells(state: States) -> NDArray[np.int32]:
    """Return the number of cells in every direction, corners included, with the state of each cell."""
    uniform = np.full(state.shape, max(state.shape), dtype=np.int32)
    for kind in CellState:
        cells = state == kind
        if cells.any() and not cells.all():
            uniform[cells] = ndimage.distance_transform_cdt(cells, "chessboard")[cells] - 1
    return uniform


def unknown_pockets(state: States, resolution_m: float) -> Bools:
    """Return unknown cells of enclosed regions without a square of `POCKET_M`, as in furniture and pillars."""
    unknown = np.pad(state == CellState.UNKNOWN, 1, constant_values=True)
    size = max(1, math.ceil(POCKET_M / resolution_m - 1e-6))
    regions, count = ndimage.label(unknown, np.ones((3, 3), dtype=bool))
    wide = np.zeros(count + 1, dtype=bool)
    wide[regions[ndimage.binary_opening(unknown, np.ones((size, size), dtype=bool))]] = True
    wide[regions[0, 0]] = True
    return (unknown & ~wide[regions])[1:-1, 1:-1]


def has_unknown_room(state: States, resolution_m: float) -> bool:
    """Return whether there is an unknown room as in `PartialMap.is_nearly_complete`, or no wall."""
    state = np.pad(state, math.ceil(BODY_M / resolution_m) + 1, constant_values=CellState.UNKNOWN)
    unknown, opened = state == CellState.UNKNOWN, state != CellState.WALL
    if opened.all():
        return True
    clear = ndimage.distance_transform_edt(opened) * resolution_m > BODY_M
    parts, count = ndimage.label(clear, np.ones((3, 3), dtype=bool))
    from_free = np.zeros(count + 1, dtype=bool)
    from_free[parts[clear & (state == CellState.FREE)]] = True
    regions, count = ndimage.label(unknown)
    entered = np.unique(regions[unknown & from_free[parts]])
    radii_m = largest_by_area(ndimage.distance_transform_edt(unknown), regions, count)[entered] * resolution_m
    return bool(((entered == regions[0, 0]) | (radii_m >= ROOM_M)).any())


def free_standing(state: States, resolution_m: float) -> Bools:
    """Return free-standing wall cells (ny, nx), as `PartialMap.with_obstacle_height`.

    Unknown cells that only walls touch belong to them.
    """
    state, square = np.pad(state, 1, constant_values=CellState.UNKNOWN), np.ones((3, 3), dtype=bool)
    unknown, _ = ndimage.label(state == CellState.UNKNOWN)
    is_open = np.zeros(unknown.max() + 1, dtype=bool)
    is_open[unknown[ndimage.binary_dilation(state == CellState.FREE)]] = True
    is_open[unknown[0, 0]] = True
    beyond = is_open[unknown] & (unknown > 0)
    solid = (state != CellState.FREE) & ~beyond
    pieces, _ = ndimage.label(solid, square)
    most = FREE_STANDING_M / resolution_m + 1e-6
    small = [max(part.stop - part.start for part in extent) <= most for extent in ndimage.find_objects(pieces)]
    stands = np.array([False, *small])
    stands[pieces[ndimage.binary_dilation(beyond, square)]] = False
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
    within = ndimage.binary_fill_holes(obstacle > 0) & (state == CellState.UNKNOWN)
    found = [(math.inf, np.where((obstacle > 0) | within, CellState.FREE, state))]
    for number in np.unique(obstacle[obstacle > 0]).tolist():
        other = np.where(state == CellState.UNKNOWN, CellState.UNKNOWN, CellState.FREE)
        found.append((heights_m[number - 1], np.where(obstacle == number, CellState.WALL, other)))
    return found


def turned_hint(grid: Grid, points_m: Floats) -> str:
    """Suggest transposed states if positions (N, 3), at least three, would all be free."""
    turns = {"upside down (numpy.flipud)": grid.state[::-1], "with rows and columns swapped (.T)": grid.state.T}
    can_tell = len(points_m) >= 3 and bool((np.abs(points_m) < 1e8).all())
    for name, state in turns.items() if can_tell else ():
        if (state_at(state, grid.resolution_m, grid.origin_m, points_m) == CellState.FREE).all():
            return f" All {len(points_m)} are free on the map {name}."
    return ""


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
