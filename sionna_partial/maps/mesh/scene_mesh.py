"""SceneMesh: triangles of a building with their materials."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.checks import float_array, real_array, shown
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M
from sionna_partial.display import Shown
from sionna_partial.errors import MapError
from sionna_partial.maps.environment import FAR_M, EnvironmentKind, equal_fields
from sionna_partial.maps.mesh.cut import SEAM_M, close_seams, cut_triangles, merge_points
from sionna_partial.settings import Material

MAX_TRIANGLES = 5_000_000

MAX_MESH_BYTES = 2_000_000_000

MAX_MATERIALS = 256

MAX_COORDINATE_M = 1e8
"""Largest coordinate of a mesh [m]; more is a unit error."""

FLAT_M = 0.1
"""Height below which a mesh is flat, so that radios are above it [m]."""

DEGENERATE_M = 1e-6
"""Triangles lower than this over their longest edge are dropped [m]."""

NEAR_FACE_M = 1e-3
"""Distance from the bounds of a face up to which points may be on it [m]."""


@read_only
@dataclass(frozen=True, eq=False)
class SceneMesh(Shown):
    """Triangles in world axes (x right, y up, z up), in metres; none where nothing has been observed.

    Triangles are sorted by material, vertices by first use; degenerate triangles and unused vertices are dropped.
    Arrays are read-only.

    Parameters
    ----------
    vertices_m : (V, 3) float64 array
        Corners [m], shared by adjacent triangles.
    triangles : (F, 3) int64 array
        Indices into `vertices_m`; at most `MAX_TRIANGLES` rows.
    material : (F,) uint8 array
        Index into `materials` of every triangle.
    materials : tuple of Material or None
        None is the material of SceneSettings.
    height_range_m : (float, float) or None
        Lowest and highest world z for radios [m], by default of the mesh, or up to 3 m above a flat one. Parts keep the
        range.

    Raises
    ------
    MapError
        For other shapes, values that are not finite, or indices out of range.
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
        """Lowest and highest x, y, z (2, 3) [m]; NaN without triangles."""
        if not len(self.triangles):
            return np.full((2, 3), np.nan)
        return np.stack([self.vertices_m.min(axis=0), self.vertices_m.max(axis=0)])

    @property
    def corners_m(self) -> Floats:
        """Corners (F, 3, 3) of the triangles [m]."""
        return self.vertices_m[self.triangles]

    def within(self, area: Any) -> "SceneMesh":
        """Cut the mesh at the border of an area (shapely, world x and y [m]) seen from above.

        Triangles inside, and walls on the border, are kept. Shared edges stay shared: an edge gets the cut
        points of its neighbours. Cut points within `SEAM_M` of each other or of a vertex are merged.
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
        return set(self.scene_materials(default).values())

    def scene_materials(self, default: Material) -> dict[str, Material]:
        used = np.unique(self.material).tolist()
        return {f"material{index}": self.materials[index] or default for index in used}

    @property
    def wall_sizes(self) -> tuple[tuple[Material | None, ...], Floats]:
        area = np.abs(self._doubled_normals)
        steep_m2 = np.linalg.norm(area, axis=1) * (np.hypot(*area.T[:2]) > area[:, 2])
        return self.materials, np.bincount(self.material, steep_m2, len(self.materials)).astype(np.float64)

    def is_named_at(self, points_m: Floats) -> Bools:
        """Return whether the faces nearest to points (P, 3) [m] on the mesh have a named material."""
        point, face = self._bounds.query(shapely.points(points_m[:, :2]))
        normal = self._doubled_normals[face]
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        corners, along = self.corners_m[face], np.roll(self.corners_m[face], -1, axis=1) - self.corners_m[face]
        there = points_m[point, None] - corners
        inwards = np.cross(normal[:, None], along)
        inside_m = ((there * inwards).sum(axis=2) / np.linalg.norm(along, axis=2)).min(axis=1)
        away_m = np.abs((there[:, 0] * normal).sum(axis=1)) + np.maximum(-inside_m, 0.0)
        order = np.lexsort((away_m, point))
        point, first = np.unique(point[order], return_index=True)
        is_named, named = np.array([material is not None for material in self.materials]), np.zeros(len(points_m), bool)
        named[point] = is_named[self.material[face[order[first]]]]
        return named

    @property
    def _doubled_normals(self) -> Floats:
        """Normals (F, 3) as long as twice the areas [m²]."""
        a, b, c = np.moveaxis(self.corners_m, 1, 0)
        normals: Floats = np.cross(b - a, c - a)
        return normals

    @cached_property
    def _bounds(self) -> shapely.STRtree:
        flat = self.corners_m[..., :2]
        return shapely.STRtree(shapely.box(*(flat.min(axis=1) - NEAR_FACE_M).T, *(flat.max(axis=1) + NEAR_FACE_M).T))

    def with_materials(self, materials: dict[str, Material]) -> dict[str, Any]:
        named = tuple(materials.get(f"material{index}", old) for index, old in enumerate(self.materials))
        return {"mesh": replace(self, materials=named)}

    def with_height(self, height_m: float) -> dict[str, Any]:
        """Return the fields of a map whose radios may be up to a height above the lowest point [m]."""
        low_m, _ = self._heights_m
        return {"mesh": replace(self, height_range_m=(low_m, low_m + height_m))}

    def scene_offset_m(self, bounds_m: tuple[float, float, float, float]) -> list[float]:
        (x0, y0, x1, y1), heights_m = bounds_m, self._heights_m
        return [_whole_offset_m(low, high) for low, high in ((x0, x1), (y0, y1), heights_m)]

    def sheet(self) -> dict[str, object]:
        return {"mesh": {"height_range": [*self._heights_m], "materials": material_records(self.materials)}}

    def arrays(self) -> dict[str, Any]:
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
    mesh = SceneMesh(vertices_m, triangles, material.astype(np.uint8), materials)
    return replace(mesh, triangles=merge_points(mesh.vertices_m)[mesh.triangles].astype(np.int64))


def material_records(materials: Iterable[Material | None]) -> list[dict[str, Any] | None]:
    return [None if material is None else asdict(material) for material in materials]


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
    if not isinstance(values, list | tuple) or not all(isinstance(material, Material | None) for material in values):
        raise MapError(f"materials = {shown(values)} is not allowed: give Material(...) or None for each.")
    materials = tuple(values)
    if len(materials) > MAX_MATERIALS:
        raise MapError(
            f"materials has {len(materials)} entries, more than {MAX_MATERIALS}: give like ones the same material."
        )
    return materials


def _is_wide(corners_m: Floats) -> Bools:
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
    remedy = "give (low, high), z in metres, low < high."
    pair = float_array(name, given, MapError, remedy)
    if pair.shape != (2,) or not -MAX_COORDINATE_M <= pair[0] < pair[1] <= MAX_COORDINATE_M:
        raise MapError(f"{name} = {shown(given)} is not allowed: {remedy}")
    return float(pair[0]), float(pair[1])


def _whole_offset_m(low_m: float, high_m: float) -> float:
    """Return whole metres that move a far axis to the origin without losing digits."""
    if max(abs(low_m), abs(high_m)) <= FAR_M:
        return 0.0
    return float(np.floor(max(low_m, 0.0)) + np.ceil(min(high_m, 0.0)))
