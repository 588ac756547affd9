"""Contents of a map: its source, cells and their layers, and walls extruded from them (`FloorPlan`) or triangles.

Another kind, such as voxels, needs a class like these, a writer in `scene.write_map`, and a path finder in
`tracing/finder.py`.
"""

import logging
import math
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, States, with_neighbours
from sionna_partial.checks import number_of, real_array, shown
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.settings import Material

MAX_CELLS = 100_000_000

MAX_WALL_MATERIALS = 255
"""Most materials, obstacle heights or rooms of a map: one byte per cell counts them."""

ODD_CELLS = 1000
"""Number of cells from which a map should have free and wall cells."""

_log = logging.getLogger(__name__)
_Map = TypeVar("_Map", bound=Any)

EnvironmentKind = Literal["plan", "mesh"]

FAR_M = 1000.0
"""Largest coordinate of a scene, with float32 steps of 0.06 mm [m]; farther maps are moved."""


def equal_fields(one: Any, other: Any) -> bool:
    """Return whether two objects of one dataclass, which may hold arrays, are equal."""
    names = [field.name for field in fields(one) if field.compare]
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@dataclass(frozen=True)
class FloorPlan:
    """Walls from floor to ceiling in all wall cells of a map.

    `is_extruded`: the cells show the walls at any height. `suffixes`: suffixes of map files, the usual one first.
    `receivers_at_once`: receivers whose paths are found at once, which bounds the memory.
    """

    state: States
    wall_height_m: float
    wall_material: NDArray[np.uint8] | None
    wall_materials: tuple[Material, ...]

    kind: ClassVar[EnvironmentKind] = "plan"
    is_extruded: ClassVar[bool] = True
    suffixes: ClassVar[tuple[str, ...]] = ".yaml", ".yml", ".npz"
    receivers_at_once: ClassVar[int] = 20_000

    @property
    def height_range_m(self) -> tuple[float, float]:
        """World z of floor and ceiling [m]."""
        return 0.0, self.wall_height_m

    def known_materials(self, default: Material) -> set[Material]:
        """Return materials that the map may need, also for floor and ceiling; `default` for unnamed ones."""
        return {default, *self.wall_materials}

    def scene_materials(self, default: Material) -> dict[str, Material]:
        """Return used materials by their names in the scene."""
        used = [0] if self.wall_material is None else np.unique(np.append(self.wall_material, 0)).tolist()
        return {f"material{index or ''}": (default, *self.wall_materials)[index] for index in used}

    @property
    def wall_sizes(self) -> tuple[tuple[Material | None, ...], Floats]:
        """Materials of walls, None for unnamed ones, and their numbers of cells or areas."""
        walls, cells = self.state == CellState.WALL, 0 if self.wall_material is None else self.wall_material
        counts = np.bincount(np.broadcast_to(cells, walls.shape)[walls], minlength=1 + len(self.wall_materials))
        return (None, *self.wall_materials), counts.astype(np.float64)

    def with_materials(self, materials: dict[str, Material]) -> dict[str, Any]:
        """Return the fields of a map with other materials, by names in the scene."""
        of_walls = tuple(materials.get(f"material{index}", old) for index, old in enumerate(self.wall_materials, 1))
        return {"material": materials["material"], "wall_materials": of_walls}

    def with_height(self, _height_m: float) -> dict[str, Any]:
        """Return the fields that depend on the height of the walls [m]."""
        return {}

    def scene_offset_m(self, bounds_m: tuple[float, float, float, float]) -> list[float]:
        """Return the world position [m] of the scene's origin: x and y, or x, y and z."""
        return [*bounds_m[:2]] if max(map(abs, bounds_m)) > FAR_M else [0.0, 0.0]

    def sheet(self) -> dict[str, object]:
        """Return further keys in a map's YAML."""
        return {}

    def arrays(self) -> dict[str, Any]:
        """Return further arrays in a map's `.npz`."""
        return {}


def fractions_by_material(materials: tuple[Material | None, ...], sizes: Floats) -> dict[Material | None, float]:
    """Return the fractions of the walls by their material, from `wall_sizes`; without walls all are of the first."""
    fractions = sizes / sizes.sum() if sizes.any() else np.ones(1)
    of_material: dict[Material | None, float] = {}
    for material, fraction in zip(materials, fractions.tolist(), strict=False):
        of_material[material] = of_material.get(material, 0.0) + fraction
    return {material: fraction for material, fraction in of_material.items() if fraction > 0.0}


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
            uniform[cells] = scipy.ndimage.distance_transform_cdt(cells, "chessboard")[cells] - 1
    return uniform


def turn_grid(state: States, resolution_m: float, origin: tuple[float, float, float]) -> tuple[States, float, Any]:
    """Rotate a grid (ny, nx) by the yaw of its origin (x, y, yaw) onto the world axes; UNKNOWN outside.

    Quarter turns are exact. A tilt that moves no cell by more than half its size is ignored. Any other yaw samples the
    grid at cells of half the size: walls stay at least two cells thick, more than a diagonal step needs (sqrt 2). Gaps
    where walls meet only at a corner are closed.

    Returns the state, the edge of its cells [m], and world x and y of its lower-left corner [m].
    """
    x, y, yaw = origin
    ny, nx = state.shape
    turns = round(yaw / (math.pi / 2))
    if abs(yaw - turns * math.pi / 2) * math.hypot(ny, nx) <= 0.5:
        left, down = ((0, 0), (ny, 0), (nx, ny), (0, nx))[turns % 4]
        return np.rot90(state, -turns), resolution_m, (x - left * resolution_m, y - down * resolution_m)
    cell_m = resolution_m / 2
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])  # acts on (y, x)
    corners = np.array([(0, 0), (ny, 0), (0, nx), (ny, nx)]) @ turn.T * resolution_m
    low = corners.min(axis=0)
    rows, columns = (int(n) for n in np.ceil((corners.max(axis=0) - low) / cell_m - 1e-9))
    if rows * columns > MAX_CELLS:
        what = f"has a yaw for which the map needs {rows} x {columns} cells, more than {MAX_CELLS:,}"
        raise MapError(f"origin = {list(origin)} {what}: set the yaw to 0, or cut or coarsen the map.")
    _log.warning("origin yaw %g rad: the map is turned onto cells of %g m.", yaw, cell_m)
    first = turn.T @ ((low + cell_m / 2) / resolution_m) - 0.5

    def turned(grid: States) -> States:
        shape, unknown = (rows, columns), CellState.UNKNOWN
        return scipy.ndimage.affine_transform(
            grid, turn.T / 2, first, shape, order=0, mode="grid-constant", cval=unknown
        )

    result = turned(state)
    frontier = with_neighbours(frontier_cells(state))
    result[frontier_cells(result) & (turned(frontier.astype(np.uint8)) == 0)] = CellState.WALL
    return result, cell_m, (x + float(low[1]), y + float(low[0]))


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


class MapWarning(UserWarning):
    """A map file that was read with corrections, or whose map is not plausible.

    `report` is the `ImportReport` of the map, or None.
    """

    report: Any = None


@dataclass(frozen=True)
class Elements:
    """Elements of one name or type, their number, and the reason for skipping them."""

    name: str
    count: int
    reason: str = ""


@dataclass(frozen=True)
class ImportSource:
    """Facts about a file that its reader reports: see `ImportReport`."""

    file: str
    unit_m: float = 1.0
    unit_source: str = "format"
    used: tuple[Elements, ...] = ()
    skipped: tuple[Elements, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass
class ImportNotes:
    """Notes of a reader for an `ImportReport`."""

    file: str | os.PathLike[str]
    unit_m: float = 1.0
    unit_source: str = "format"
    notes: list[str] = field(default_factory=list)
    _counts: dict[tuple[str, str], int] = field(default_factory=dict)

    def use(self, name: str, count: int = 1) -> None:
        self.skip(name, count, "")

    def skip(self, name: str, count: int, reason: str) -> None:
        self._counts[name, reason] = self._counts.get((name, reason), 0) + count

    def attached_to(self, partial: _Map, *, size: str = "", doors: str = "", area: str = "", free: str = "") -> _Map:
        """Return a PartialMap with its report, and warn of implausible results, as `ImportReport.faults`."""
        rows = [Elements(name, count, reason) for (name, reason), count in sorted(self._counts.items()) if count]
        used, skipped = (tuple(row for row in rows if bool(row.reason) == skip) for skip in (False, True))
        source = ImportSource(str(self.file), self.unit_m, self.unit_source, used, skipped, tuple(self.notes))
        partial = replace(partial, import_source=source)
        if size or doors or area or free:
            for fault in partial.import_report.faults(size, doors, area, free):
                warning = MapWarning(f"path = '{self.file}' {fault}")
                warning.report = partial.import_report
                warnings.warn(warning, stacklevel=4)
        return partial
