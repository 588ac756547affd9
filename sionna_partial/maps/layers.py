"""Values of the cells of a map: states, and layers that give each cell one of a few materials, heights or rooms."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import States
from sionna_partial.checks import number_of, real_array, shown
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.settings import Material

MAX_CELLS = 100_000_000

MAX_WALL_MATERIALS = 255
"""Most materials, obstacle heights or rooms of a map: one byte per cell counts them."""


def metres(name: str, value: object, low: float, high: float) -> float:
    """Return a number of metres, or raise a MapError that names it."""
    number = number_of(value)
    if not low <= number <= high:
        raise MapError(f"{name} = {shown(value)} is not allowed: give a number of metres in [{low:g}, {high:g}].")
    return number


def grid_array(name: str, values: ArrayLike, kinds: str, wanted: str = "integers") -> NDArray[Any]:
    """Return a two-dimensional array of one of the dtype kinds, or raise a MapError."""
    array = real_array(name, values, MapError, f"give {wanted}, in a two-dimensional array (ny, nx).", kinds)
    if array.ndim != 2 or array.size == 0:
        raise MapError(f"{name} has shape {array.shape}: give a two-dimensional array (ny, nx) with at least one cell.")
    return array


def checked_state(values: ArrayLike) -> States:
    """Return the states of a map, read-only."""
    wanted = "CellState integers FREE 0, WALL 1, UNKNOWN 2"
    state = grid_array("state", values, "iub", wanted)
    if state.size > MAX_CELLS:
        cells = f"{state.shape[0]} x {state.shape[1]} cells, more than {MAX_CELLS:,}"
        raise MapError(f"state has {cells}: cut the map to the building or coarsen it.")
    if state.min() < 0 or state.max() > max(CellState):
        values = f"state has values {state.min()} to {state.max()}: use {wanted}"
        is_percent = state.min() >= -1 and state.max() in (100, 255)
        raise MapError(f"{values}{', or map_from_occupancy for -1 to 100 percent' if is_percent else ''}.")
    state = np.array(state, dtype=np.uint8)
    state.setflags(write=False)
    return state


def layer_values(name: str, given: object) -> tuple[Any, ...]:
    """Return the materials, heights or names of a layer as a tuple."""
    values = tuple(given) if isinstance(given, tuple | list) else (given,)
    if len(values) > MAX_WALL_MATERIALS:
        raise MapError(f"{name} has {len(values)} entries: give at most {MAX_WALL_MATERIALS}.")
    return values


def _checked_heights(heights: tuple[Any, ...]) -> tuple[float, ...]:
    return tuple(metres("obstacle_heights_m", height_m, 0.01, 100.0) for height_m in heights)


def _checked_materials(materials: tuple[Any, ...]) -> tuple[Material, ...]:
    other = next((type(material).__name__ for material in materials if not isinstance(material, Material)), None)
    if other is not None:
        raise MapError(f"wall_materials holds a {other}: give a tuple of Material, such as Material.named returns.")
    return materials


def _checked_names(names: tuple[Any, ...]) -> tuple[str, ...]:
    if len({*names}) < len(names) or not all(isinstance(name, str) and name and name.isprintable() for name in names):
        raise MapError(f"room_names = {shown(names)} is not allowed: give different texts of printable characters.")
    return names


LAYERS: dict[str, tuple[str, CellState, Callable[[tuple[Any, ...]], tuple[Any, ...]]]] = {
    "wall_material": ("wall_materials", CellState.WALL, _checked_materials),
    "obstacle": ("obstacle_heights_m", CellState.WALL, _checked_heights),
    "room": ("room_names", CellState.FREE, _checked_names),
}
"""Layers: field of the values, state of the cells, check of the values."""


def layers_of(found: Mapping[str, Any], cells: Callable[[Any], Any], values: Callable[[Any], Any]) -> dict[str, Any]:
    """Return the layers of a file; two functions decode cells and plain values (`layers`)."""
    layers = {name: cells(found[name]) for name in LAYERS if name in found}
    counted = {LAYERS[name][0]: values(found[LAYERS[name][0]]) for name in layers}
    return layers | {
        name: tuple(Material(**value) if isinstance(value, dict) else value for value in plain)
        for name, plain in counted.items()
    }


def layer_cells(
    name: str, values: ArrayLike, state: States, counted: str, count: int, of: CellState
) -> NDArray[np.uint8] | None:
    """Return the cells of a layer, 0 where the state is another, or None if all are 0."""
    cells = grid_array(name, values, "iub")
    if cells.shape != state.shape:
        raise MapError(f"{name} has shape {cells.shape} and state {state.shape}: give arrays of one shape.")
    if cells.min() < 0 or cells.max() > count:
        what = f"{name} has values {cells.min()} to {cells.max()}, and {counted} has {count} entries"
        raise MapError(f"{what}: give one for each value from 1 on; 0 is the default.")
    cells = np.where(state == of, cells, 0).astype(np.uint8)
    cells.setflags(write=False)
    return cells if cells.any() else None
