"""Grids whose origin has a yaw, turned onto the world axes."""

import logging
import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, binary_dilation

from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.partial_map import MAX_CELLS

logger = logging.getLogger(__name__)


def turn_grid(
    state: NDArray[np.uint8], resolution_m: float, origin: tuple[float, float, float]
) -> tuple[NDArray[np.uint8], float, tuple[float, float]]:
    """Turn a grid about its lower-left corner by the yaw of its origin.

    Quarter turns are exact. A remaining tilt that moves no cell by more than half its size is below the map's
    resolution and left out. Any other yaw puts the grid onto cells of half the size, each with the state found at its
    centre: a wall of one cell stays at least two new cells thick, more than a diagonal step needs (sqrt 2), so that no
    wall gets holes. Where walls met at a corner alone, the gap is closed; a complete map stays complete.

    Parameters
    ----------
    state : (ny, nx) uint8 array of CellState
        Row 0 holds the smallest y of the grid's own axes.
    resolution_m : float
        Edge of a cell [m].
    origin : (float, float, float)
        World x and y [m] and yaw [rad] of the lower-left corner.

    Returns
    -------
    state : (ny', nx') uint8 array of CellState
        Along world axes; UNKNOWN outside the turned grid.
    resolution_m : float
        Edge of its cells [m].
    origin_m : (float, float)
        World x and y of its lower-left corner [m].

    Raises
    ------
    MapError
        If the turned grid has too many cells.
    """
    x, y, yaw = origin
    ny, nx = state.shape
    turns = round(yaw / (math.pi / 2))
    if abs(yaw - turns * math.pi / 2) * math.hypot(ny, nx) > 0.5:
        return _resample(state, resolution_m, origin)
    left, down = ((0, 0), (ny, 0), (nx, ny), (0, nx))[turns % 4]
    return np.rot90(state, -turns), resolution_m, (x - left * resolution_m, y - down * resolution_m)


def _resample(
    state: NDArray[np.uint8], resolution_m: float, origin: tuple[float, float, float]
) -> tuple[NDArray[np.uint8], float, tuple[float, float]]:
    x, y, yaw = origin
    cell = resolution_m / 2
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])  # acts on (y, x)
    ny, nx = state.shape
    corners = np.array([(0, 0), (ny, 0), (0, nx), (ny, nx)]) @ turn.T * resolution_m
    low = corners.min(axis=0)
    rows, columns = (int(n) for n in np.ceil((corners.max(axis=0) - low) / cell - 1e-9))
    if rows * columns > MAX_CELLS:
        raise MapError(
            f"origin = {list(origin)} has a yaw for which the map needs {rows} x {columns} cells, "
            f"more than {MAX_CELLS:,}: set the yaw to 0, or cut or coarsen the map."
        )
    logger.warning("origin yaw %g rad: the map is turned onto cells of %g m.", yaw, cell)
    first = turn.T @ ((low + cell / 2) / resolution_m) - 0.5

    def turned(grid: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Sample a grid of the map's shape at the centres of the new cells."""
        shape, unknown = (rows, columns), CellState.UNKNOWN
        return affine_transform(grid, turn.T / 2, first, shape, order=0, mode="grid-constant", cval=unknown)

    result = turned(state)
    frontier = binary_dilation(_touches_unknown(state), np.ones((3, 3)))
    result[_touches_unknown(result) & (turned(frontier.astype(np.uint8)) == 0)] = CellState.WALL
    return result, cell, (x + float(low[1]), y + float(low[0]))


def _touches_unknown(state: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Free cells that share an edge with an unknown one; outside the grid all is unknown."""
    near: NDArray[np.bool_] = binary_dilation(state == CellState.UNKNOWN, border_value=1)
    return near & (state == CellState.FREE)
