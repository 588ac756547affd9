"""Maps of simulators: Habitat and Active Neural SLAM."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation

from sionna_partial.checks import number_of, shown
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M, CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.layers import grid_array
from sionna_partial.maps.partial_map import PartialMap

HABITAT_INVALID, HABITAT_BORDER = 0, 2
"""Habitat's top-down values: not navigable, and the navigable rim beside it (habitat-lab, maps.py)."""

HABITAT_COVERED = (6, 9)
"""Habitat's drawings that may cover cells that are not navigable: target and its box (maps.py)."""


def map_from_habitat(
    top_down: ArrayLike,
    fog_of_war: ArrayLike,
    resolution_m: float,
    *,
    origin_m: tuple[float, float] = (0.0, 0.0),
    wall_height_m: float = DEFAULT_WALL_HEIGHT_M,
) -> PartialMap:
    """Make a map from Habitat's top-down map and its fog-of-war mask.

    Revealed navigable cells are free. Revealed border cells, and cells that are not navigable (0) beside a free one,
    are walls: the mask reveals no such cell. Cells under agent, path and start are navigable; cells under a target,
    and all others, are unknown.

    Parameters
    ----------
    top_down : (rows, columns) integers
        `info["top_down_map"]["map"]`, or `habitat.utils.visualizations.maps.get_topdown_map`. World x is Habitat's x
        (columns) and y is -z (rows), so that row 0 holds the LARGEST y.
    fog_of_war : (rows, columns) integers or booleans
        `info["top_down_map"]["fog_of_war_mask"]`: nonzero where the agent has seen.
    resolution_m : float
        Metres per pixel.
    origin_m, wall_height_m
        As of `map_from_array`; `origin_m` is `(lower[0], -(lower[2] + rows * resolution_m))` for the lower bound
        of Habitat's `pathfinder.get_bounds()`.

    Raises
    ------
    MapError
        For other or unequal shapes, or a number out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.importers.map_from_habitat([[0, 1, 1, 1]], [[1, 1, 1, 0]], resolution_m=0.05).state.tolist()
    [[1, 0, 0, 2]]
    """
    value, seen = grid_array("top_down", top_down, "iu"), grid_array("fog_of_war", fog_of_war, "iub") != 0
    _require_equal_shapes("fog_of_war", seen, "top_down", value)
    if value.min() < 0 or value.max() > 255:
        raise MapError(f"top_down holds values {value.min()} to {value.max()}: give Habitat's map, 0 to 255.")
    blocked, border = value == HABITAT_INVALID, value == HABITAT_BORDER
    free = seen & ~blocked & ~border & ~np.isin(value, HABITAT_COVERED)
    state = np.full(value.shape, CellState.UNKNOWN, dtype=np.uint8)
    state[free] = CellState.FREE
    state[(seen & border) | (blocked & binary_dilation(free))] = CellState.WALL
    return PartialMap(np.flipud(state), resolution_m, origin_m, wall_height_m)


def map_from_slam(
    obstacle: ArrayLike,
    explored: ArrayLike,
    resolution_m: float,
    *,
    origin_m: tuple[float, float] = (0.0, 0.0),
    wall_height_m: float = DEFAULT_WALL_HEIGHT_M,
    threshold: float = 0.5,
) -> PartialMap:
    """Make a map from the obstacle and explored channels of Active Neural SLAM: explored obstacles are walls.

    Parameters
    ----------
    obstacle, explored : (ny, nx) numbers in [0, 1]
        Probabilities of an obstacle (`map[0]`) and of exploration (`map[1]`). Row 0 holds the smallest y.
    resolution_m, origin_m, wall_height_m
        As of `map_from_array`.
    threshold : float
        Smallest probability that counts.

    Raises
    ------
    MapError
        For other or unequal shapes, other values, or a number out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.importers.map_from_slam([[1.0, 0.0, 0.0]], [[1.0, 1.0, 0.0]], resolution_m=0.05).state.tolist()
    [[1, 0, 2]]
    """
    channels = {
        "obstacle": grid_array("obstacle", obstacle, "iubf", "numbers"),
        "explored": grid_array("explored", explored, "iubf", "numbers"),
    }
    _require_equal_shapes("explored", channels["explored"], "obstacle", channels["obstacle"])
    for name, channel in channels.items():
        if not ((channel >= 0) & (channel <= 1)).all():
            raise MapError(f"{name} holds values outside [0, 1] (or NaN): give probabilities or booleans.")
    if not 0 < number_of(threshold) <= 1:
        raise MapError(f"threshold = {shown(threshold)} is not allowed: give a number in (0, 1].")
    state = np.where(channels["obstacle"] >= threshold, CellState.WALL, CellState.FREE)
    state = np.where(channels["explored"] >= threshold, state, CellState.UNKNOWN)
    return PartialMap(state.astype(np.uint8), resolution_m, origin_m, wall_height_m)


def _require_equal_shapes(name: str, array: NDArray[Any], other: str, like: NDArray[Any]) -> None:
    if array.shape != like.shape:
        raise MapError(f"{name} has shape {array.shape} and {other} {like.shape}: give arrays of one shape.")
