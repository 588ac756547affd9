"""PartialMap: the observed part of a floor plan, cell by cell."""

import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, Indices, States, largest_by_area, read_only
from sionna_partial.checks import float_array, is_whole, number_of, real_array, require, require_number, shown
from sionna_partial.constants import DEFAULT_HEIGHT_M, DEFAULT_WALL_HEIGHT_M, CellState
from sionna_partial.display import Pictured
from sionna_partial.errors import MapError, PositionError
from sionna_partial.maps.environment import FloorPlan, SceneMesh, equal_fields
from sionna_partial.maps.import_report import ImportReport, ImportSource, report_of
from sionna_partial.maps.import_report import MapWarning as MapWarning
from sionna_partial.maps.wall_cells import noise_field, thick_walls, wall_noise
from sionna_partial.settings import Material

MAX_CELLS = 100_000_000

MAX_INTERIOR_CELLS = 2**53

MAX_WALL_MATERIALS = 255
"""Most materials, obstacle heights or rooms of a map: one byte per cell counts them."""

FREE_STANDING_M = 2.5
"""Extent along x and y up to which free-standing walls are furniture [m]."""

ODD_CELLS = 1000
"""Number of cells from which a map should have free and wall cells."""

OUTLINE_M = 0.3
"""Largest distance of an outline from the cells of its wall [m]."""

ROOM_M, BODY_M = 0.6, 0.3
"""Radius of a disc that fits into an unknown room, and of one that can enter it [m]."""

POCKET_M = 0.4
"""Edge of a square in unknown regions that a robot would look into [m]."""

FAR_EXTENTS = 2.0
"""Distance from the middle of a map, in its extents, from which positions have another unit or map."""

_BORDER_CELLS = 1e-6


_FREEST = np.array([CellState.FREE, CellState.UNKNOWN, CellState.WALL], dtype=np.uint8)
_RANK = np.argsort(_FREEST)


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
        object.__setattr__(self, "state", _checked_state(self.state))
        object.__setattr__(self, "resolution_m", _number("resolution_m", self.resolution_m, 1e-3, 10.0))
        remedy = "give the (x, y) of the lower-left corner in metres."
        origin = float_array("origin_m", self.origin_m, MapError, remedy)
        if origin.shape != (2,):
            raise MapError(f"origin_m = {shown(self.origin_m)}: {remedy}")
        object.__setattr__(self, "origin_m", tuple(_number("origin_m", value, -1e8, 1e8) for value in origin))
        object.__setattr__(self, "wall_height_m", _number("wall_height_m", self.wall_height_m, 0.1, 100.0))
        cells = self.interior_cells
        if cells is not None and not (is_whole(cells) and cells <= MAX_INTERIOR_CELLS):
            raise MapError(f"interior_cells = {shown(cells)} is not allowed: give the number of free cells, or None.")
        object.__setattr__(self, "interior_cells", None if cells is None else int(cells))
        if not isinstance(self.mesh, SceneMesh | None):
            raise MapError(f"mesh is of type {type(self.mesh).__name__}: give a SceneMesh, or None for a plan.")
        if not isinstance(self.material, Material | None):
            kind = type(self.material).__name__
            raise MapError(f"material is of type {kind}: give a Material, or None for that of SceneSettings.")
        for name, (counted, of, checked) in _LAYERS.items():
            object.__setattr__(self, counted, checked(_values(counted, getattr(self, counted))))
            object.__setattr__(self, name, self._layer(name, counted, of))

    def _layer(self, name: str, counted: str, of: CellState) -> NDArray[np.uint8] | None:
        values = getattr(self, name)
        if values is None:
            return None
        if self.mesh is not None and of == CellState.WALL:
            raise MapError(f"{name} is for floor plans: a mesh has walls of its own.")
        cells, count = grid_array(name, values, "iub"), len(getattr(self, counted))
        if cells.shape != self.shape:
            raise MapError(f"{name} has shape {cells.shape} and state {self.shape}: give arrays of one shape.")
        if cells.min() < 0 or cells.max() > count:
            what = f"{name} has values {cells.min()} to {cells.max()}, and {counted} has {count} entries"
            raise MapError(f"{what}: give one for each value from 1 on; 0 is the default.")
        cells = np.where(self.state == of, cells, 0).astype(np.uint8)
        cells.setflags(write=False)
        return cells if cells.any() else None

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PartialMap):
            return NotImplemented
        return equal_fields(self, other)

    def layers(self) -> dict[str, tuple[States, str, list[Any]]]:
        """Return each layer's cells, the field with its values, and these as plain data."""
        found = {}
        for name, (counted, _, _) in _LAYERS.items():
            if (cells := getattr(self, name)) is not None:
                values = [asdict(value) if isinstance(value, Material) else value for value in getattr(self, counted)]
                found[name] = cells, counted, values
        return found

    def window(self, row: int, column: int, shape: tuple[int, int], beyond: CellState) -> "PartialMap":
        """Return `shape` cells from a row and column on; cells outside the grid are `beyond`."""
        ny, nx = self.shape
        rows, columns = np.arange(row, row + shape[0]), np.arange(column, column + shape[1])
        inside = np.ix_((rows >= 0) & (rows < ny), (columns >= 0) & (columns < nx))
        own = np.ix_(rows[(rows >= 0) & (rows < ny)], columns[(columns >= 0) & (columns < nx)])

        def cut(cells: States, fill: int) -> States:
            window = np.full(shape, fill, np.uint8)
            window[inside] = cells[own]
            return window

        layers: dict[str, Any] = {name: cut(cells, 0) for name, (cells, *_) in self.layers().items()}
        x, y = self.origin_m
        origin_m = x + column * self.resolution_m, y + row * self.resolution_m
        return replace(self, state=cut(self.state, beyond), origin_m=origin_m, **layers)

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
        height_m = _number("height_m", height_m, 0.01, 100.0)
        area = free_standing(self.state, self.resolution_m) if where is None else self.cells_within(where)
        return self._with_layer("obstacle", height_m, area, is_default=height_m >= self.wall_height_m)

    def _with_layer(self, name: str, value: Any, area: Bools, *, is_default: bool = False) -> "PartialMap":
        counted, _, checked = _LAYERS[name]
        values, old = getattr(self, counted), getattr(self, name)
        values = checked(_values(counted, values if value in values else (*values, value)))
        cells = np.zeros(self.shape, np.uint8) if old is None else old.copy()
        cells[area] = 0 if is_default else values.index(value) + 1
        changes: dict[str, Any] = {name: cells, counted: values}
        return replace(self, **changes)

    def cells_within(self, where: object) -> Bools:
        """Return the cells (ny, nx) of an area, as `where` of `with_wall_material`."""
        if not isinstance(where, shapely.Geometry):
            area = real_array("where", where, MapError, "give cells (ny, nx) as booleans, or a polygon.", "biuf")
            if area.dtype == np.bool_ and area.shape == self.shape:
                return area
            if area.dtype == np.bool_:
                what = f"where has shape {area.shape}"
                raise MapError(f"{what}: give booleans {self.shape}, or corners (M, 2) of a polygon in metres.")
            where = area_polygon("where", area)
        elif not where.is_valid:
            remedy = "give a geometry without crossings, of finite coordinates, or repair it with shapely.make_valid."
            raise MapError(f"where is no area ({shapely.is_valid_reason(where)}): {remedy}")
        rows, columns = np.indices(self.shape)
        centres = cell_centres_m(self, np.stack([rows, columns], axis=-1))
        return np.asarray(shapely.contains_xy(where, centres[..., 0], centres[..., 1]))

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
        return not _has_unknown_room(self.state, self.resolution_m)

    @cached_property
    def wall_noise(self) -> float:
        """Range noise from the depth of uneven walls: 0 (exact; always where the map is complete) to 1."""
        return 0.0 if self.is_complete else wall_noise(self.state, self.resolution_m)

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
        return np.asarray(ndimage.map_coordinates(self._noise_field, row_column, order=1, mode="nearest"))

    @cached_property
    def wall_fractions(self) -> dict[Material | None, float]:
        """Fractions of the walls by their named material; None for the others."""
        materials, sizes = self.environment.wall_sizes
        fractions = sizes / sizes.sum() if sizes.any() else np.ones(1)
        of_material: dict[Material | None, float] = {}
        for material, fraction in zip(materials, fractions.tolist(), strict=False):
            of_material[material] = of_material.get(material, 0.0) + fraction
        return {material: fraction for material, fraction in of_material.items() if fraction > 0.0}

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
        """Number of classes of walls without a named material: thick walls are the second."""
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
        away, (row, column) = ndimage.distance_transform_edt(self.state != CellState.WALL, return_indices=True)
        classes = (1 + self.thick_walls[row, column]).astype(np.uint8)
        if self.wall_material is not None:
            classes[(self.wall_material[row, column] > 0) & (away * self.resolution_m <= OUTLINE_M)] = 0
        return classes

    def wall_classes(self, points_m: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return the walls at points (..., 3) [m], or NaN: 0 with a named material, 1 thin or 2 thick without."""
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
        within = ndimage.binary_fill_holes(self.obstacle > 0) & (self.state == CellState.UNKNOWN)
        state = np.where((self.obstacle > 0) | within, CellState.FREE, self.state)
        levels = [(math.inf, replace(plain, state=state))]
        for number in np.unique(self.obstacle[self.obstacle > 0]).tolist():
            other = np.where(self.state == CellState.UNKNOWN, CellState.UNKNOWN, CellState.FREE)
            state = np.where(self.obstacle == number, CellState.WALL, other)
            levels.append((self.obstacle_heights_m[number - 1], replace(plain, state=state)))
        return tuple(levels)

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
                remedy += self._turned_hint(flat) or self._unit_hint(flat[index])
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

    def _unit_hint(self, point_m: Floats) -> str:
        """Ask for metres if a position (3,) would be on the map in another unit."""
        x0, y0, x1, y1 = self.bounds_m
        if not np.abs(point_m[:2] - ((x0 + x1) / 2, (y0 + y1) / 2)).max() > FAR_EXTENTS * max(x1 - x0, y1 - y0):
            return ""
        for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2)):
            for scale in (np.array([factor, factor, 1.0]), np.full(3, factor)):
                meant = point_m * scale
                if self.radios_can_stand(meant[None])[0]:
                    text = ", ".join(f"{value:g}" for value in meant)
                    return f" Did you mean metres? Taken for {unit} it is at ({text}) m."
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


def require_height(partial: PartialMap, name: str, height_m: object) -> None:
    """Raise a SettingsError unless a height is between floor and ceiling of a map."""
    low_m, high_m = partial.height_range_m
    require_number(name, height_m, low_m, high_m, open_low=True)
    require(number_of(height_m) < high_m, name, height_m, f"stay below the ceiling at {high_m:g} m.")


def cell_centres_m(partial: PartialMap, cells: NDArray[np.generic]) -> Floats:
    """Return x and y of the centres of cells (..., 2), rows and columns [m]."""
    return (np.asarray(cells, dtype=np.float64)[..., ::-1] + 0.5) * partial.resolution_m + partial.origin_m


def nearest_free_m(partial: PartialMap, at_m: ArrayLike, count: int = 1) -> Floats:
    """Return the centres (K, 2) of the free cells nearest to a position (2,) [m], at most `count`."""
    free_m = cell_centres_m(partial, np.argwhere(partial.state == CellState.FREE))
    return free_m[np.hypot(*(free_m - np.asarray(at_m, dtype=np.float64)).T).argsort(kind="stable")[:count]]


def aligned_blocks(partial: PartialMap, factor: int) -> tuple[States, Floats]:
    """Return the cells in blocks (ny, factor, nx, factor), and the blocks' lower-left corner.

    Blocks are aligned to the world and padded with unknown cells, so that unknown cells around a map have no effect.
    """
    corner = np.floor(np.round(np.array(partial.origin_m) / partial.resolution_m, 3)).astype(int) % factor
    padding = [(low, -(low + count) % factor) for low, count in zip(corner[::-1], partial.shape, strict=True)]
    state = np.pad(partial.state, padding, constant_values=CellState.UNKNOWN)
    ny, nx = state.shape
    blocks = state.reshape(ny // factor, factor, nx // factor, factor)
    return blocks, np.array(partial.origin_m) - corner * partial.resolution_m


def unknown_pockets(state: States, resolution_m: float) -> Bools:
    """Return unknown cells of enclosed regions without a square of `POCKET_M`, as in furniture and pillars."""
    unknown = np.pad(state == CellState.UNKNOWN, 1, constant_values=True)
    size = max(1, math.ceil(POCKET_M / resolution_m - 1e-6))
    regions, count = ndimage.label(unknown, np.ones((3, 3), dtype=bool))
    wide = np.zeros(count + 1, dtype=bool)
    wide[regions[ndimage.binary_opening(unknown, np.ones((size, size), dtype=bool))]] = True
    wide[regions[0, 0]] = True
    return (unknown & ~wide[regions])[1:-1, 1:-1]


def _has_unknown_room(state: States, resolution_m: float) -> bool:
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


def warn_of_odd_states(what: str, partial: PartialMap) -> None:
    """Warn of a map without walls or free cells, or that looks inverted."""
    count = np.bincount(partial.state.ravel(), minlength=len(CellState))
    free, wall = int(count[CellState.FREE]), int(count[CellState.WALL])
    if partial.state.size < ODD_CELLS:
        return
    if not free + wall:
        seen = "has no free cell and no wall, so that everything is unknown"
    elif not wall:
        seen = f"has {free:,} free cells and no wall, so that nothing obstructs or reflects"
    elif wall > 2 * free:
        seen = f"has {wall:,} wall cells and {free:,} free ones, as if inverted"
    else:
        return
    remedy = "look at its states, and at negate and the thresholds of a ROS map."
    warnings.warn(f"{what} {seen}: {remedy}", MapWarning, stacklevel=3)


def require_map(name: str, value: object) -> None:
    """Raise a MapError unless `value` is a PartialMap."""
    if not isinstance(value, PartialMap):
        raise MapError(f"{name} is of type {type(value).__name__}: give a PartialMap, such as load_map returns.")


def grid_array(name: str, values: ArrayLike, kinds: str, wanted: str = "integers") -> NDArray[Any]:
    """Return a two-dimensional array of one of the dtype kinds, or raise a MapError."""
    array = real_array(name, values, MapError, f"give {wanted}, in a two-dimensional array (ny, nx).", kinds)
    if array.ndim != 2 or array.size == 0:
        raise MapError(f"{name} has shape {array.shape}: give a two-dimensional array (ny, nx) with at least one cell.")
    return array


def _checked_state(values: ArrayLike) -> States:
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


def _values(name: str, given: object) -> tuple[Any, ...]:
    values = tuple(given) if isinstance(given, tuple | list) else (given,)
    if len(values) > MAX_WALL_MATERIALS:
        raise MapError(f"{name} has {len(values)} entries: give at most {MAX_WALL_MATERIALS}.")
    return values


def _checked_heights(heights: tuple[Any, ...]) -> tuple[float, ...]:
    return tuple(_number("obstacle_heights_m", height_m, 0.01, 100.0) for height_m in heights)


def _checked_materials(materials: tuple[Any, ...]) -> tuple[Material, ...]:
    other = next((type(material).__name__ for material in materials if not isinstance(material, Material)), None)
    if other is not None:
        raise MapError(f"wall_materials holds a {other}: give a tuple of Material, such as Material.named returns.")
    return materials


def _checked_names(names: tuple[Any, ...]) -> tuple[str, ...]:
    if len({*names}) < len(names) or not all(isinstance(name, str) and name and name.isprintable() for name in names):
        raise MapError(f"room_names = {shown(names)} is not allowed: give different texts of printable characters.")
    return names


_LAYERS: dict[str, tuple[str, CellState, Callable[[tuple[Any, ...]], tuple[Any, ...]]]] = {
    "wall_material": ("wall_materials", CellState.WALL, _checked_materials),
    "obstacle": ("obstacle_heights_m", CellState.WALL, _checked_heights),
    "room": ("room_names", CellState.FREE, _checked_names),
}
"""Layers: field of the values, state of the cells, check of the values."""


def layers_of(found: Mapping[str, Any], cells: Callable[[Any], Any], values: Callable[[Any], Any]) -> dict[str, Any]:
    """Return the layers of a file; two functions decode cells and plain values (`layers`)."""
    layers = {name: cells(found[name]) for name in _LAYERS if name in found}
    counted = {_LAYERS[name][0]: values(found[_LAYERS[name][0]]) for name in layers}
    return layers | {
        name: tuple(Material(**value) if isinstance(value, dict) else value for value in plain)
        for name, plain in counted.items()
    }


def _number(name: str, value: object, low: float, high: float) -> float:
    number = number_of(value)
    if not low <= number <= high:
        raise MapError(f"{name} = {shown(value)} is not allowed: give a number of metres in [{low:g}, {high:g}].")
    return number
