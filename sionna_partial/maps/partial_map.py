"""PartialMap: the observed part of a floor plan, cell by cell."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices, States, read_only
from sionna_partial.checks import float_array, is_whole, number_of, position_array, require, require_number, shown
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M, CellState
from sionna_partial.display import Pictured
from sionna_partial.errors import MapError, PositionError
from sionna_partial.maps.environment import (
    LAYERS,
    FloorPlan,
    ImportSource,
    checked_state,
    equal_fields,
    fractions_by_material,
    frontier_cells,
    layer_cells,
    layer_values,
    metres,
    uniform_cells,
)
from sionna_partial.maps.environment import MapWarning as MapWarning
from sionna_partial.maps.grid import cells_within, free_standing, has_unknown_room, states_by_height, unit_hint, window
from sionna_partial.maps.import_report import ImportReport, report_of
from sionna_partial.maps.mesh.scene_mesh import SceneMesh
from sionna_partial.maps.wall_cells import noise_field, thick_walls
from sionna_partial.settings import Material

MAX_INTERIOR_CELLS = 2**53

_BORDER_CELLS = 1e-6

_FREEST = np.array([CellState.FREE, CellState.UNKNOWN, CellState.WALL], dtype=np.uint8)
_RANK = np.argsort(_FREEST)

OUTLINE_M = 0.3
"""Largest distance of an outline from the cells of its wall [m]."""


@read_only
@dataclass(frozen=True, eq=False)
class PartialMap(Pictured, plot="plots.style:plot_map"):
    """A floor plan of free, wall and unknown cells on a regular grid.

    World axes: x right, y up, z up, in metres. Everything outside the grid is unknown. Arrays are read-only.

    Parameters
    ----------
    state : (ny, nx) uint8 array of CellState
        Row 0 holds the smallest y.
    resolution_m : float
        Edge of a cell [m], between 1 mm and 10 m.
    origin_m : (float, float)
        World x and y of the lower-left corner of the grid [m].
    wall_height_m : float
        Height of walls and ceiling of a plan [m]. A mesh has its own (`height_range_m`).
    interior_cells : int or None
        Number of free cells of the complete home, if known.
    mesh : SceneMesh or None
        Observed part of the building, instead of walls extruded from the cells.
    material : Material or None
        Material of walls, floor and ceiling, or of unnamed parts of the mesh; None is the material of SceneSettings.
    wall_material : (ny, nx) uint8 array or None
        Material of each wall cell: k for `wall_materials[k - 1]`, 0 for `material` (see `with_wall_material`). Not for
        meshes.
    wall_materials : tuple of Material
        At most 255.
    obstacle : (ny, nx) uint8 array or None
        Wall cells that end below the ceiling: k for the height `obstacle_heights_m[k - 1]`, 0 for full walls (see
        `with_obstacle_height`). Not for meshes.
    obstacle_heights_m : tuple of float
        At most 255 [m].
    room : (ny, nx) uint8 array or None
        Room of each free cell: k for `room_names[k - 1]`, 0 for none.
    room_names : tuple of str
        At most 255 names, such as the segments of a vacuum robot's map.
    import_source : ImportSource or None
        Facts about the source file, for `import_report`; ignored by equality.

    Raises
    ------
    MapError
        For another shape, other values, or a number out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> partial = sp.PartialMap([[0, 0, 1], [0, 2, 2]], resolution_m=0.5)
    >>> partial.shape, partial.bounds_m, partial.is_complete
    ((2, 3), (0.0, 0.0, 1.5, 1.0), False)
    """

    state: States
    resolution_m: float
    origin_m: tuple[float, float] = (0.0, 0.0)
    wall_height_m: float = DEFAULT_WALL_HEIGHT_M
    interior_cells: int | None = None
    mesh: SceneMesh | None = None
    material: Material | None = None
    wall_material: NDArray[np.uint8] | None = None
    wall_materials: tuple[Material, ...] = ()
    obstacle: NDArray[np.uint8] | None = None
    obstacle_heights_m: tuple[float, ...] = ()
    room: NDArray[np.uint8] | None = None
    room_names: tuple[str, ...] = ()
    import_source: ImportSource | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "state", checked_state(self.state))
        object.__setattr__(self, "resolution_m", metres("resolution_m", self.resolution_m, 1e-3, 10.0))
        remedy = "give the (x, y) of the lower-left corner in metres."
        origin = float_array("origin_m", self.origin_m, MapError, remedy)
        if origin.shape != (2,):
            raise MapError(f"origin_m = {shown(self.origin_m)}: {remedy}")
        object.__setattr__(self, "origin_m", tuple(metres("origin_m", value, -1e8, 1e8) for value in origin))
        object.__setattr__(self, "wall_height_m", metres("wall_height_m", self.wall_height_m, 0.1, 100.0))
        cells = self.interior_cells
        if cells is not None and not (is_whole(cells) and cells <= MAX_INTERIOR_CELLS):
            raise MapError(f"interior_cells = {shown(cells)} is not allowed: give the number of free cells, or None.")
        object.__setattr__(self, "interior_cells", None if cells is None else int(cells))
        if not isinstance(self.mesh, SceneMesh | None):
            raise MapError(f"mesh is of type {type(self.mesh).__name__}: give a SceneMesh, or None for a plan.")
        if not isinstance(self.material, Material | None):
            kind = type(self.material).__name__
            raise MapError(f"material is of type {kind}: give a Material, or None for that of SceneSettings.")
        for name, (counted, of, checked) in LAYERS.items():
            object.__setattr__(self, counted, checked(layer_values(counted, getattr(self, counted))))
            object.__setattr__(self, name, self._checked_layer(name, counted, of))

    def _checked_layer(self, name: str, counted: str, of: CellState) -> NDArray[np.uint8] | None:
        values = getattr(self, name)
        if values is not None and self.mesh is not None and of == CellState.WALL:
            raise MapError(f"{name} is for floor plans: a mesh has walls of its own.")
        count = len(getattr(self, counted))
        return None if values is None else layer_cells(name, values, self.state, counted, count, of)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PartialMap):
            return NotImplemented
        return equal_fields(self, other)

    def layers(self) -> dict[str, tuple[States, str, list[Any]]]:
        """Return the layers by name: cells (ny, nx), the field that they index, and its values as plain data."""
        found = {}
        for name, (counted, _, _) in LAYERS.items():
            if (cells := getattr(self, name)) is not None:
                values = [asdict(value) if isinstance(value, Material) else value for value in getattr(self, counted)]
                found[name] = cells, counted, values
        return found

    def window(self, row: int, column: int, shape: tuple[int, int], beyond: CellState) -> "PartialMap":
        """Return `shape` cells from a row and column on; cells outside the grid are `beyond`."""
        (x, y), layers = self.origin_m, dict[str, Any]()
        for name, (cells, *_) in self.layers().items():
            layers[name] = window(cells, row, column, shape, 0)
        origin_m = x + column * self.resolution_m, y + row * self.resolution_m
        return replace(self, state=window(self.state, row, column, shape, beyond), origin_m=origin_m, **layers)

    def with_wall_material(self, material: Material | str, where: object) -> "PartialMap":
        """Return the map with the walls of an area made of a material.

        Parameters
        ----------
        material : Material or str
            The material, or a name for `Material.named`.
        where : (ny, nx) bool array, (M, 2) array-like, or shapely geometry
            Cells, or a polygon or geometry in world x and y [m] that contains the centres of cells.

        Raises
        ------
        MapError
            For an area of another kind, a mesh, or more than 255 materials.
        SettingsError
            For an unknown material.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> home = sp.make_home(3, "apartment")
        >>> shell = home.with_wall_material("concrete", [(-1, -1), (0.3, -1), (0.3, 9), (-1, 9)])
        >>> [material.itu for material in shell.wall_materials]
        ['concrete']
        """
        material = Material.named(material) if isinstance(material, str) else material
        return self._with_layer("wall_material", material, self.cells_within(where))

    def with_obstacle_height(self, height_m: float, where: object = None) -> "PartialMap":
        """Return the map with the walls of an area ending at a height, such as furniture that a low lidar sees.

        Paths pass over such obstacles, and radios may be above them.

        Parameters
        ----------
        height_m : float
            Height of their tops [m]; from `wall_height_m` on they are full walls.
        where : (ny, nx) bool array, (M, 2) array-like, shapely geometry or None
            As in `with_wall_material`. None selects free-standing walls, pillars included: pieces within 2.5 m along x
            and y with only free cells around.

        Raises
        ------
        MapError
            For a height that is not positive, an area of another kind, a mesh, or more than 255 heights.

        Examples
        --------
        >>> import numpy as np, sionna_partial as sp
        >>> room = np.pad(np.zeros((30, 40), np.uint8), 1, constant_values=1)
        >>> room[10:14, 10:18] = 1  # a table
        >>> low = sp.PartialMap(room, resolution_m=0.1).with_obstacle_height(0.75)
        >>> low.radios_can_stand(np.array([[1.5, 1.2, 0.7], [1.5, 1.2, 1.0], [0.05, 1.2, 1.0]])).tolist()
        [False, True, False]
        """
        height_m = metres("height_m", height_m, 0.01, 100.0)
        area = free_standing(self.state, self.resolution_m) if where is None else self.cells_within(where)
        return self._with_layer("obstacle", height_m, area, is_default=height_m >= self.wall_height_m)

    def _with_layer(self, name: str, value: Any, area: Bools, *, is_default: bool = False) -> "PartialMap":
        counted, _, checked = LAYERS[name]
        values, old = getattr(self, counted), getattr(self, name)
        values = checked(layer_values(counted, values if value in values else (*values, value)))
        cells = np.zeros(self.shape, np.uint8) if old is None else old.copy()
        cells[area] = 0 if is_default else values.index(value) + 1
        changes: dict[str, Any] = {name: cells, counted: values}
        return replace(self, **changes)

    def cells_within(self, where: object) -> Bools:
        """Return the cells (ny, nx) of an area, as `where` of `with_wall_material`."""
        return cells_within(self, where)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns (ny, nx)."""
        ny, nx = self.state.shape
        return ny, nx

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """World (x_min, y_min, x_max, y_max) of the grid [m]."""
        (x, y), (ny, nx) = self.origin_m, self.shape
        return x, y, x + nx * self.resolution_m, y + ny * self.resolution_m

    @property
    def environment(self) -> FloorPlan | SceneMesh:
        """Walls extruded from the cells, or the mesh."""
        return self.mesh or FloorPlan(self.state, self.wall_height_m, self.wall_material, self.wall_materials)

    @property
    def height_range_m(self) -> tuple[float, float]:
        """World z of floor and ceiling, or of the ends of a mesh [m], between which radios must be."""
        range_m = self.environment.height_range_m
        assert range_m is not None  # a mesh has it once it is built
        return range_m

    @cached_property
    def import_report(self) -> ImportReport | None:
        """Report of the source file, None without one."""
        return None if self.import_source is None else report_of(self.import_source, self.state, self.resolution_m)

    @cached_property
    def is_complete(self) -> bool:
        """True if no free cell touches an unknown one by an edge; False without free cells.

        The space beyond the grid is unknown.
        """
        return bool((self.state == CellState.FREE).any() and not frontier_cells(self.state).any())

    @cached_property
    def is_nearly_complete(self) -> bool:
        """True if no unknown room can be entered.

        An unknown region is a room if it reaches beyond the grid or holds a disc of `ROOM_M`, and a disc of `BODY_M`
        can enter it from free cells. Meshes are never nearly complete.
        """
        if self.is_complete or not self.environment.is_extruded:
            return self.is_complete
        return not has_unknown_room(self.state, self.resolution_m)

    @cached_property
    def _noise_field(self) -> Floats:
        return noise_field(self.state, self.resolution_m)

    def noise_near(self, points_m: NDArray[np.floating]) -> Floats:
        """Return the range noise of the walls within a few metres of points (..., 2 or 3) [m]: 0 (exact) to 1.

        It is continuous, turns and moves with the map, and is 0 where walls show no noise or there are none.

        Examples
        --------
        >>> import numpy as np, sionna_partial as sp
        >>> home = sp.make_home(74000)
        >>> lidar = sp.SensorSettings(range_noise_m=0.02, field_of_view_deg=360.0, range_m=12.0)
        >>> seen = sp.explore(home, (0.9,), 0, sensor=lidar)[0]
        >>> middle_m = np.array([np.mean(np.reshape(home.bounds_m, (2, 2)), axis=0)])
        >>> home.noise_near(middle_m).item(), seen.noise_near(middle_m).item() > 0.5
        (0.0, True)
        """
        cells = (np.asarray(points_m, dtype=float)[..., :2] - self.origin_m) / self.resolution_m - 0.5
        row_column = np.moveaxis(cells[..., ::-1], -1, 0)
        return np.asarray(scipy.ndimage.map_coordinates(self._noise_field, row_column, order=1, mode="nearest"))

    @cached_property
    def wall_fractions(self) -> dict[Material | None, float]:
        """Fractions of the walls by their named material; None for the others."""
        return fractions_by_material(*self.environment.wall_sizes)

    @property
    def _unnamed_cells(self) -> Bools:
        walls = self.state == CellState.WALL
        return walls if self.wall_material is None else walls & (self.wall_material == 0)

    @cached_property
    def thick_walls(self) -> Bools:
        """Result of the function `thick_walls` for walls without a named material."""
        return thick_walls(self.state == CellState.WALL, self._unnamed_cells, self.resolution_m)

    @property
    def wall_class_count(self) -> int:
        """Number of classes of walls without a named material: 1, or 2 where some walls are thick."""
        return 1 + bool(self.thick_walls.any())

    @cached_property
    def unnamed_walls(self) -> Floats:
        """Fractions (2,) of the walls that are thin or thick, and whose material the map does not name."""
        thick = self.thick_walls.sum() / max(1, self._unnamed_cells.sum())
        fraction = self.wall_fractions.get(None, 0.0) if self.material is None else 0.0
        return fraction * np.array([1.0 - thick, thick])

    @cached_property
    def _nearest_classes(self) -> NDArray[np.uint8]:
        """Result of `wall_classes` for the nearest wall of each cell; named walls are at most `OUTLINE_M` away."""
        away, (row, column) = scipy.ndimage.distance_transform_edt(self.state != CellState.WALL, return_indices=True)
        classes = (1 + self.thick_walls[row, column]).astype(np.uint8)
        if self.wall_material is not None:
            classes[(self.wall_material[row, column] > 0) & (away * self.resolution_m <= OUTLINE_M)] = 0
        return classes

    def wall_classes(self, points_m: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return the class (...,) of the wall at each point (..., 3) [m]: 0 named material, else 1 thin or 2 thick.

        Points of NaN get any class.
        """
        if self.wall_fractions.keys() == {None} and self.wall_class_count == 1:
            return np.ones(points_m.shape[:-1], dtype=np.uint8)
        cells = np.nan_to_num((points_m[..., :2] - self.origin_m) / self.resolution_m)
        column, row = np.moveaxis(np.clip(np.floor(cells).astype(np.intp), 0, np.array(self.shape)[::-1] - 1), -1, 0)
        classes = self._nearest_classes[row, column]
        if self.mesh is not None and self.wall_fractions.keys() != {None}:
            named = np.isfinite(points_m).all(axis=-1)
            named[named] = self.mesh.is_named_at(points_m[named])
            classes[named] = 0
        return classes

    @cached_property
    def uniform_cells(self) -> NDArray[np.int32]:
        """Result of the function `uniform_cells` for `state`."""
        return uniform_cells(self.state)

    @property
    def observed_fraction(self) -> float:
        """Fraction of the interior that has been seen, in [0, 1].

        Free cells over `interior_cells` if known; else 1 for a complete map, and the fraction of known cells otherwise.
        """
        if self.interior_cells is not None:
            return min(1.0, float((self.state == CellState.FREE).sum()) / max(1, self.interior_cells))
        if self.is_complete:
            return 1.0
        return float((self.state != CellState.UNKNOWN).mean())

    def cell_index(self, points_m: NDArray[np.floating]) -> tuple[Indices, Indices]:
        """Rows and columns (...) of world points (..., 2 or 3) [m], possibly outside the grid."""
        points = np.asarray(points_m, dtype=float)
        column = np.floor((points[..., 0] - self.origin_m[0]) / self.resolution_m + 1e-9).astype(np.intp)
        row = np.floor((points[..., 1] - self.origin_m[1]) / self.resolution_m + 1e-9).astype(np.intp)
        return row, column

    def state_at(self, points_m: NDArray[np.floating]) -> States:
        """Return the CellState at world points (..., 2 or 3) [m]; UNKNOWN outside the grid.

        A point on a border is FREE before UNKNOWN before WALL: planners put radios on corners of cells beside walls.
        """
        cells = (np.asarray(points_m, dtype=float)[..., :2] - self.origin_m) / self.resolution_m
        padded = np.pad(self.state, 1, constant_values=CellState.UNKNOWN)
        ny, nx = self.shape
        freest = np.full(cells.shape[:-1], _RANK[CellState.WALL])
        for shift_x, shift_y in itertools.product((-_BORDER_CELLS, _BORDER_CELLS), repeat=2):
            column = np.clip(np.floor(cells[..., 0] + shift_x) + 1, 0, nx + 1).astype(np.intp)
            row = np.clip(np.floor(cells[..., 1] + shift_y) + 1, 0, ny + 1).astype(np.intp)
            freest = np.minimum(freest, _RANK[padded[row, column]])
        return _FREEST[freest]

    @cached_property
    def wall_levels(self) -> tuple[tuple[float, "PartialMap"], ...]:
        """Heights up to which walls reach [m], and maps with the walls of that height, full walls first.

        The first height is infinite; its map has free cells instead of obstacles and the areas that they enclose.
        """
        if self.obstacle is None:
            return ((math.inf, self),)
        plain = replace(self, obstacle=None)
        states = states_by_height(self.state, self.obstacle, self.obstacle_heights_m)
        return tuple((top_m, replace(plain, state=state)) for top_m, state in states)

    def is_wall_at(self, points_m: Floats) -> Bools:
        """Return whether world points (..., 3) [m] are in walls, or in obstacles below their height."""
        found = [
            (points_m[..., 2] <= top_m) & (level.state_at(points_m) == CellState.WALL)
            for top_m, level in self.wall_levels
        ]
        return np.asarray(np.any(found, axis=0))

    def require_positions(self, name: str, points_m: object, *, least: int = 1, names: Sequence[str] = ()) -> Floats:
        """Check radio positions (3,) or (N, 3) [m], and return them as a float64 array.

        Messages contain the argument's `name` and the `names` of positions.

        Raises
        ------
        PositionError
            For another shape, fewer than `least`, values that are not finite, or points outside the map, in a wall,
            or not between floor and ceiling. Unknown cells are allowed (the paper needs them).
        """
        points = position_array(name, points_m, least=least)
        flat = points.reshape(-1, 3)
        for fault, what, remedy in self._position_faults(flat):
            if fault.any():
                index = int(np.argmax(fault))
                which = name if points.ndim == 1 else names[index] if names else f"{name}[{index}]"
                more = f" (and {int(fault.sum()) - 1} more)" if fault.sum() > 1 else ""
                remedy += self._turned_hint(flat) or unit_hint(self.bounds_m, flat[index], self.radios_can_stand)
                raise PositionError(f"{which} = {tuple(flat[index].tolist())}{more} {what}: {remedy}")
        return points

    def _turned_hint(self, points_m: Floats) -> str:
        """Suggest transposed states if positions (N, 3), at least three, would all be free."""
        turns = {"upside down (numpy.flipud)": self.state[::-1], "with rows and columns swapped (.T)": self.state.T}
        can_tell = len(points_m) >= 3 and self.environment.is_extruded and bool((np.abs(points_m) < 1e8).all())
        for name, state in turns.items() if can_tell else ():
            if (PartialMap(state, self.resolution_m, self.origin_m).state_at(points_m) == CellState.FREE).all():
                return f" All {len(points_m)} are free on the map {name}."
        return ""

    def radios_can_stand(self, points_m: Floats) -> Bools:
        """Return whether radios can be at points (N, 3) [m]."""
        return ~np.any([fault for fault, _, _ in self._position_faults(points_m)], axis=0)

    def _position_faults(self, points_m: Floats) -> list[tuple[Bools, str, str]]:
        x0, y0, x1, y1 = self.bounds_m
        low, high = self.height_range_m
        finite = np.asarray(np.isfinite(points_m).all(axis=1))
        x, y, z = np.where(finite[:, None], points_m, 0.0).T
        walled = self.is_wall_at(np.column_stack([np.clip(x, x0, x1), np.clip(y, y0, y1), z]))
        outside = (x < x0) | (x > x1) | (y < y0) | (y > y1)
        beyond = f"is outside the map, which spans x {x0:g} to {x1:g} m and y {y0:g} to {y1:g} m"
        too_high = f"is not between floor and ceiling ({low:g} to {high:g} m)"
        return [
            (~finite, "is not finite", "give finite numbers in metres."),
            (outside, beyond, "move it inside, or extend the map with unknown cells."),
            ((z <= low) | (z >= high), too_high, "change its height z or the map's wall_height_m."),
            (walled, "is inside a wall", "move it to a free or unknown cell."),
        ]


def require_height(partial: PartialMap, name: str, height_m: object) -> None:
    """Raise a SettingsError unless a height is between floor and ceiling of a map."""
    low_m, high_m = partial.height_range_m
    require_number(name, height_m, low_m, high_m, open_low=True)
    require(number_of(height_m) < high_m, name, height_m, f"stay below the ceiling at {high_m:g} m.")


def require_map(name: str, value: object) -> None:
    """Raise a MapError unless `value` is a PartialMap."""
    if not isinstance(value, PartialMap):
        raise MapError(f"{name} is of type {type(value).__name__}: give a PartialMap, such as load_map returns.")
