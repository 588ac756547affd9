"""Contents of a map: walls extruded from its cells (`FloorPlan`), or triangles (`SceneMesh`).

`PartialMap.environment` alone decides which of the two a map has. Another kind, such as voxels, takes a
class like these, a way to write it in `scene.write_map`, and a way to find its paths in `tracing/finder.py`.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.checks import float_array, real_array, shown
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M
from sionna_partial.display import Shown
from sionna_partial.errors import MapError
from sionna_partial.maps.mesh.cut import SEAM_M, close_seams, cut_triangles, merge_points
from sionna_partial.settings import Material

MAX_TRIANGLES = 5_000_000
"""Largest number of triangles of a mesh: more should be cut or simplified first."""

MAX_MESH_BYTES = 2_000_000_000
"""Largest file of a mesh that is read [bytes]: more should be cut or simplified first."""

MAX_MATERIALS = 256
"""Largest number of materials of a mesh: each triangle has one byte for its own."""

MAX_COORDINATE_M = 1e8
"""Largest coordinate of a mesh [m]: more is a unit error."""

FLAT_M = 0.1
"""Height below which a mesh is flat, so that radios stand on it, not between its ends [m]."""

DEGENERATE_M = 1e-6
"""Triangles lower than this over their longest edge have no direction, and are dropped [m]."""

EnvironmentKind = Literal["plan", "mesh"]

FAR_M = 1000.0
"""Largest coordinate that a scene keeps [m]: float32 has steps of 0.06 mm there. Maps that reach farther are moved."""


@read_only
@dataclass(frozen=True, eq=False)
class SceneMesh(Shown):
    """Triangles in world axes (x right, y up, z up), in metres. There may be none: nothing has been observed then.

    Triangles are kept in the order of their materials, and vertices in the order in which triangles use them; both
    are sorted that way when the mesh is built. Degenerate triangles and unused vertices are dropped.

    Parameters
    ----------
    vertices_m : (V, 3) float64 array
        Corners [m]; triangles that meet share them. Kept read-only.
    triangles : (F, 3) int64 array
        Indices into `vertices_m`, at most `MAX_TRIANGLES` triangles. Kept read-only.
    material : (F,) uint8 array
        Index into `materials` of every triangle. Kept read-only.
    materials : tuple of Material or None
        None is the material of SceneSettings.
    height_range_m : (float, float) or None
        Lowest and highest world z that a radio may have [m]. By default the ends of the mesh; of a flat mesh, 3 m
        above it. What is cut from a mesh keeps its range.

    Raises
    ------
    MapError
        For arrays of other shapes, values that are not finite, or indices out of range.
    """

    vertices_m: Floats
    triangles: NDArray[np.int64]
    material: NDArray[np.uint8]
    materials: tuple[Material | None, ...] = (None,)
    height_range_m: tuple[float, float] | None = None

    kind: ClassVar[EnvironmentKind] = "mesh"
    is_extruded: ClassVar[bool] = False
    suffixes: ClassVar[tuple[str, ...]] = (".npz",)
    receivers_at_once: ClassVar[int] = 50_000

    def __post_init__(self) -> None:
        vertices = _vertices(self.vertices_m)
        triangles = _indices("triangles", self.triangles, (3,), len(vertices), "vertices_m")
        if len(triangles) > MAX_TRIANGLES:
            rows = f"{len(triangles):,} rows, more than {MAX_TRIANGLES:,}"
            raise MapError(f"triangles has {rows}: cut or simplify the mesh.")
        materials = _materials(self.materials)
        material = _indices("material", self.material, (), len(materials), "materials")
        if len(material) != len(triangles):
            raise MapError(f"material has {len(material)} entries for {len(triangles)} triangles: give one for each.")
        kept = np.nonzero(_is_wide(vertices[triangles]))[0]
        kept = kept[np.argsort(material[kept], kind="stable")]
        used, first, inverse = np.unique(triangles[kept], return_index=True, return_inverse=True)
        order = np.argsort(first)
        arrays: dict[str, NDArray[Any]] = {
            "vertices_m": vertices[used[order]],
            "triangles": np.argsort(order)[inverse].reshape(-1, 3).astype(np.int64),
            "material": material[kept].astype(np.uint8),
        }
        for name, array in arrays.items():
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        object.__setattr__(self, "materials", materials)
        object.__setattr__(self, "height_range_m", _height_range(self.height_range_m, arrays["vertices_m"]))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SceneMesh):
            return NotImplemented
        return equal_fields(self, other)

    @property
    def bounds_m(self) -> Floats:
        """Lowest and highest x, y, z (2, 3) [m]; NaN where there is no triangle."""
        if not len(self.triangles):
            return np.full((2, 3), np.nan)
        return np.stack([self.vertices_m.min(axis=0), self.vertices_m.max(axis=0)])

    @property
    def corners_m(self) -> Floats:
        """Corners (F, 3, 3) of every triangle [m]."""
        return self.vertices_m[self.triangles]

    def within(self, area: Any) -> "SceneMesh":
        """Cut the mesh at the border of an area (shapely, world x and y [m]) seen from above.

        Triangles in the area, and walls on its border, stay as they are; those across its border are cut there.
        Triangles that shared edges still do; where a neighbour is cut in the middle of an edge, its edge gets that
        vertex too. Cut points within `SEAM_M` of one another, or of a vertex, are one. There may be no triangle left.
        """
        whole, pieces, source = cut_triangles(self.corners_m, area)
        count = len(self.vertices_m)
        vertices = np.concatenate([self.vertices_m, pieces.reshape(-1, 3)])
        cut = merge_points(vertices, SEAM_M)[count:].reshape(-1, 3)
        wide = _is_wide(vertices[cut])
        source = np.concatenate([np.nonzero(whole)[0], source[wide]])
        order = np.argsort(source, kind="stable")
        triangles = np.concatenate([self.triangles[whole], cut[wide]])[order]
        triangles, split = close_seams(vertices, triangles, count)
        return replace(self, vertices_m=vertices, triangles=triangles, material=self.material[source[order][split]])

    def known_materials(self, default: Material) -> set[Material]:
        """Return the materials of its triangles, as `FloorPlan.known_materials`."""
        return set(self.scene_materials(default).values())

    def scene_materials(self, default: Material) -> dict[str, Material]:
        """Return the materials of its triangles by their names in its scene."""
        used = np.unique(self.material).tolist()
        return {f"material{index}": self.materials[index] or default for index in used}

    def with_materials(self, materials: dict[str, Material]) -> dict[str, Any]:
        """Return the fields of a map with other materials, by their names in its scene."""
        named = tuple(materials.get(f"material{index}", old) for index, old in enumerate(self.materials))
        return {"mesh": replace(self, materials=named)}

    def with_height(self, height_m: float) -> dict[str, Any]:
        """Return the fields of a map on whose mesh radios may be up to a height above its lowest point [m]."""
        low_m, _ = self._heights_m
        return {"mesh": replace(self, height_range_m=(low_m, low_m + height_m))}

    def scene_offset_m(self, bounds_m: tuple[float, float, float, float]) -> list[float]:
        """Return the world position [m] of the origin of a scene in whole metres."""
        (x0, y0, x1, y1), heights_m = bounds_m, self._heights_m
        return [_whole_offset_m(low, high) for low, high in ((x0, x1), (y0, y1), heights_m)]

    def sheet(self) -> dict[str, object]:
        """Return its keys in the YAML of an exported scene, which has the triangles."""
        return {"mesh": {"height_range": [*self._heights_m], "materials": material_records(self.materials)}}

    def arrays(self) -> dict[str, Any]:
        """Return its arrays in a map's `.npz`."""
        return {
            "mesh_vertices_m": self.vertices_m,
            "mesh_triangles": self.triangles,
            "mesh_material": self.material,
            "mesh_materials": json.dumps(material_records(self.materials)),
            "mesh_height_range_m": self._heights_m,
        }

    @property
    def _heights_m(self) -> tuple[float, float]:
        assert self.height_range_m is not None  # a mesh has it once it is built
        return self.height_range_m


def merged_mesh(
    vertices_m: Floats,
    triangles: NDArray[np.int64],
    material: NDArray[np.integer],
    materials: tuple[Material | None, ...],
) -> SceneMesh:
    """Build a mesh whose triangles share the vertices that they have in common."""
    mesh = SceneMesh(vertices_m, triangles, material.astype(np.uint8), materials)
    return replace(mesh, triangles=merge_points(mesh.vertices_m)[mesh.triangles].astype(np.int64))


def material_records(materials: Iterable[Material | None]) -> list[dict[str, Any] | None]:
    """Return the materials of a mesh, or of walls, as plain data for files."""
    return [None if material is None else asdict(material) for material in materials]


def equal_fields(one: Any, other: Any) -> bool:
    """Return whether two objects of one dataclass, which may hold arrays, are equal."""
    names = [field.name for field in fields(one) if field.compare]
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def _vertices(values: ArrayLike) -> Floats:
    vertices = float_array("vertices_m", values, MapError, "give x, y, z in metres, (V, 3).")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MapError(f"vertices_m has shape {vertices.shape}: give x, y, z in metres, (V, 3).")
    wrong = ~(np.abs(vertices) <= MAX_COORDINATE_M).all(axis=1)
    if wrong.any():
        index = int(np.argmax(wrong))
        raise MapError(
            f"vertices_m[{index}] = {tuple(vertices[index].tolist())} is not allowed: give finite numbers of metres, "
            f"at most {MAX_COORDINATE_M:g}; repair the mesh."
        )
    return vertices


def _indices(name: str, values: ArrayLike, row: tuple[int, ...], count: int, target: str) -> NDArray[np.int64]:
    """Return indices (F, *row) into `count` items, or raise a MapError."""
    wanted = "(F, 3)" if row else "(F,)"
    indices = real_array(name, values, MapError, f"give integers {wanted}.")
    if indices.ndim != 1 + len(row) or indices.shape[1:] != row or indices.dtype.kind not in "iu":
        raise MapError(f"{name} is {indices.dtype} of shape {indices.shape}: give integers {wanted}.")
    wrong = (indices < 0) | (indices >= count)
    if wrong.any():
        raise MapError(
            f"{name} holds the index {indices[wrong][0]}, but {target} has {count} entries: give 0 to {count - 1}; "
            "repair the mesh."
        )
    return indices.astype(np.int64)


def _materials(values: tuple[Material | None, ...]) -> tuple[Material | None, ...]:
    if not isinstance(values, list | tuple) or not all(isinstance(each, Material | None) for each in values):
        raise MapError(f"materials = {shown(values)} is not allowed: give Material(...) or None for each.")
    materials = tuple(values)
    if len(materials) > MAX_MATERIALS:
        raise MapError(
            f"materials has {len(materials)} entries, more than {MAX_MATERIALS}: give like ones the same material."
        )
    return materials


def _is_wide(corners_m: Floats) -> Bools:
    """Triangles (F, 3, 3) that are not degenerate."""
    edges = np.roll(corners_m, -1, axis=1) - corners_m
    longest = np.linalg.norm(edges, axis=2).max(axis=1, initial=0.0)
    doubled_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return doubled_area > DEGENERATE_M * longest


def _height_range(given: tuple[float, float] | None, vertices_m: Floats) -> tuple[float, float]:
    if given is None:
        z = vertices_m[:, 2] if len(vertices_m) else np.zeros(1)
        low, high = float(z.min()), float(z.max())
        return low, high if high - low >= FLAT_M else low + DEFAULT_WALL_HEIGHT_M
    return height_pair("height_range_m", given)


def height_pair(name: str, given: tuple[float, float]) -> tuple[float, float]:
    """Return two heights as numbers, or raise a MapError."""
    remedy = "give (low, high), z in metres, low < high."
    pair = float_array(name, given, MapError, remedy)
    if pair.shape != (2,) or not -MAX_COORDINATE_M <= pair[0] < pair[1] <= MAX_COORDINATE_M:
        raise MapError(f"{name} = {shown(given)} is not allowed: {remedy}")
    return float(pair[0]), float(pair[1])


@dataclass(frozen=True)
class FloorPlan:
    """Walls from floor to ceiling in all wall cells of a map, with the fields that a map has for them.

    `is_extruded`: the cells show the walls at any height. `suffixes` are the suffixes of the map files
    that can hold it, the usual one first. `receivers_at_once` is the number of receivers whose paths are found at once,
    which bounds the memory.
    """

    wall_height_m: float
    wall_material: NDArray[np.uint8] | None
    wall_materials: tuple[Material, ...]

    kind: ClassVar[EnvironmentKind] = "plan"
    is_extruded: ClassVar[bool] = True
    suffixes: ClassVar[tuple[str, ...]] = ".yaml", ".yml", ".npz"
    receivers_at_once: ClassVar[int] = 8_000

    @property
    def height_range_m(self) -> tuple[float, float]:
        """World z of floor and ceiling [m]."""
        return 0.0, self.wall_height_m

    def known_materials(self, default: Material) -> set[Material]:
        """Return the materials that it may need, also of floor and ceiling; `default` for unnamed ones."""
        return {default, *self.wall_materials}

    def scene_materials(self, default: Material) -> dict[str, Material]:
        """Return the materials that it uses, by their names in its scene."""
        used = [0] if self.wall_material is None else np.unique(np.append(self.wall_material, 0)).tolist()
        return {f"material{index or ''}": (default, *self.wall_materials)[index] for index in used}

    def with_materials(self, materials: dict[str, Material]) -> dict[str, Any]:
        """Return the fields of a map with other materials, by their names in its scene."""
        of_walls = tuple(materials.get(f"material{index}", old) for index, old in enumerate(self.wall_materials, 1))
        return {"material": materials["material"], "wall_materials": of_walls}

    def with_height(self, _height_m: float) -> dict[str, Any]:
        """Return the fields that follow another height of the walls [m]."""
        return {}

    def scene_offset_m(self, bounds_m: tuple[float, float, float, float]) -> list[float]:
        """Return the world position [m] of the origin of a scene, x and y, or x, y and z."""
        return [*bounds_m[:2]] if max(map(abs, bounds_m)) > FAR_M else [0.0, 0.0]

    def sheet(self) -> dict[str, object]:
        """Return its keys in a map's YAML, besides the layers of the map."""
        return {}

    def arrays(self) -> dict[str, Any]:
        """Return its arrays in a map's `.npz`, besides the layers of the map."""
        return {}


def _whole_offset_m(low_m: float, high_m: float) -> float:
    """Whole number of metres that takes a far axis to the origin, and takes no digit from any number beyond it."""
    if max(abs(low_m), abs(high_m)) <= FAR_M:
        return 0.0
    return float(np.floor(max(low_m, 0.0)) + np.ceil(min(high_m, 0.0)))
