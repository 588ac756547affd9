"""PartialMap -> SceneGeometry -> Mitsuba XML + PLY: the only module that writes scenes."""

import itertools
import logging
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, Indices, row_runs
from sionna_partial.checks import settings_or_default
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, CellState
from sionna_partial.llvm import load_llvm
from sionna_partial.maps.mesh.scene_mesh import SceneMesh
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.scene.outlines import Outlines, Plan, cut_by_material, lattice_outlines, prepare_plan, wall_outlines
from sionna_partial.settings import DRYWALL, ITU_BANDS_GHZ, Material, SceneSettings

_log = logging.getLogger(__name__)

FLAT_SHAPES = ("floor", "ceiling")

SIONNA_LOAD_GHZ = 3.5
"""Frequency at which Sionna RT evaluates materials while loading [GHz]."""


class _Walls(NamedTuple):
    """Outlines, and material index and height [m] of each segment (S,)."""

    outlines: Outlines
    material: Indices
    top_m: Floats


class Lid(NamedTuple):
    """Top of an obstacle: corners (K, 2) [m], triangles (T, 3), height [m], index of the material."""

    corners_m: Floats
    triangles: NDArray[np.int64]
    top_m: float
    material: int


@dataclass(frozen=True)
class SceneGeometry:
    """Walls, floor and ceiling of a map in its local frame: the origin is the lower-left corner of the grid, on z = 0.

    Parameters
    ----------
    vertices_m : (V, 2) float64 array
        Ends of the wall outlines [m].
    segments : (S, 2) int64 array
        Walls, as indices into `vertices_m`, sorted by material.
    open_end : (V,) bool array
        True where a wall ends because observation ended.
    wall_material : (S,) int64 array
        Index into `materials`, whose first is also the material of floor and ceiling.
    top_m : (S,) float64 array
        Height of each wall [m]; less than `height_m` for obstacles.
    lids : tuple of Lid
        Tops of obstacles that enclose an area.
    floor_m : (R, 4) float64 array
        Disjoint rectangles x0, y0, x1, y1 of floor and ceiling [m], on a lattice of `cell_m`.
    origin_m : (float, float)
        World x and y of the local frame's origin [m].
    """

    vertices_m: Floats
    segments: NDArray[np.int64]
    open_end: Bools
    wall_material: NDArray[np.int64]
    materials: tuple[Material, ...]
    top_m: Floats
    lids: tuple[Lid, ...]
    floor_m: Floats
    cell_m: float
    height_m: float
    ceiling: bool
    origin_m: tuple[float, float]

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of the shapes in the order of faces; empty ones are not exported."""
        walls = (f"walls{index or ''}" for index in range(len(self.materials)))
        return (*walls, *FLAT_SHAPES, *(f"lid{number}" for number in range(len(self.lids))))

    @property
    def walls_m(self) -> Floats:
        """End points (S, 2, 2) of the walls [m]."""
        return self.vertices_m[self.segments]

    @cached_property
    def plan(self) -> Plan:
        return prepare_plan(self.walls_m, self.top_m < self.height_m)

    @property
    def floor_face(self) -> int:
        """First face of the floor, -1 without one, counted through walls, floor and ceiling."""
        return 2 * len(self.segments) if len(self.floor_m) else -1

    @property
    def ceiling_face(self) -> int:
        return self.floor_face + len(self.floor_mesh[1]) if len(self.floor_m) and self.ceiling else -1

    @property
    def lid_faces(self) -> list[int]:
        flats = len(self.floor_mesh[1]) * (1 + self.ceiling) if len(self.floor_m) else 0
        return np.cumsum([2 * len(self.segments) + flats, *(len(lid.triangles) for lid in self.lids)])[:-1].tolist()

    @cached_property
    def floor_mesh(self) -> tuple[Floats, NDArray[np.int64]]:
        """Corners (K, 2) [m] and counterclockwise triangles (T, 3) of the floor."""
        return _triangles(self.floor_m, self.cell_m)


def scene_settings_of(partial: PartialMap, settings: SceneSettings | None) -> SceneSettings:
    """Return settings with None replaced by the map's own material or the default."""
    settings = settings_or_default("scene_settings", settings, SceneSettings)
    default = partial.material or settings.traced_material
    used = partial.environment.known_materials(default)
    if used and settings.material not in (None, DRYWALL, *used):
        _log.warning(
            "material = %s of the scene settings is not used: the map or mesh has its own; leave it out, or set that "
            "of the map with dataclasses.replace",
            settings.material,
        )
    return replace(settings, material=default)


def material_is_unknown(partial: PartialMap, settings: SceneSettings) -> bool:
    """Return whether some walls have no material in settings and map."""
    return settings.material is None and bool(partial.unnamed_walls.any())


def build_scene(partial: PartialMap, settings: SceneSettings | None = None) -> SceneGeometry:
    """Convert a map to walls, floor and ceiling."""
    require_map("partial", partial)
    settings = scene_settings_of(partial, settings)
    walls = _walls(partial, settings)
    return SceneGeometry(
        vertices_m=walls.outlines.vertices_m,
        segments=walls.outlines.segments,
        open_end=_open_ends(partial, walls.outlines),
        wall_material=walls.material,
        materials=(settings.traced_material, *partial.wall_materials),
        top_m=walls.top_m,
        lids=tuple(_lids(partial, walls.outlines.vertices_m[walls.outlines.segments], walls.material, walls.top_m)),
        floor_m=_rectangles(floor_cells(partial, settings.floor_extent)).astype(float) * partial.resolution_m,
        cell_m=partial.resolution_m,
        height_m=partial.wall_height_m,
        ceiling=settings.ceiling,
        origin_m=partial.origin_m,
    )


def _walls(partial: PartialMap, settings: SceneSettings) -> _Walls:
    parts, count = list[_Walls](), 0
    for top_m, walls in partial.wall_levels:
        if settings.outline == "cells":
            outlines = lattice_outlines(walls)
        else:
            outlines = wall_outlines(walls, bridge_gap_m=settings.bridge_gap_m)
        outlines, material = cut_by_material(outlines, walls)
        height_m = np.full(len(material), min(top_m, partial.wall_height_m))
        parts.append(_Walls(replace(outlines, segments=outlines.segments + count), material, height_m))
        count += len(outlines.vertices_m)
    material = np.concatenate([part.material for part in parts])
    order = np.argsort(material, kind="stable")
    vertices_m = np.concatenate([part.outlines.vertices_m for part in parts])
    segments = np.concatenate([part.outlines.segments for part in parts])[order]
    return _Walls(
        Outlines(vertices_m, segments), material[order], np.concatenate([each.top_m for each in parts])[order]
    )


def write_map(
    partial: PartialMap,
    folder: Path,
    settings: SceneSettings,
    *,
    offset_m: Sequence[float],
    frequency_hz: float,
) -> tuple[Path, SceneGeometry | SceneMesh]:
    """Write the scene of a map into an existing folder; return its `scene.xml` and its geometry.

    `settings` come from `scene_settings_of`; `offset_m` as in `write_scene`.
    """
    environment = partial.environment
    if isinstance(environment, SceneMesh):
        default = settings.traced_material
        path = write_mesh_scene(
            environment, folder, offset_m=offset_m, default_material=default, frequency_hz=frequency_hz
        )
        return path, environment
    geometry = build_scene(partial, settings)
    return write_scene(geometry, folder, offset_m=offset_m, frequency_hz=frequency_hz), geometry


def write_scene(
    geometry: SceneGeometry, folder: Path, *, offset_m: Sequence[float], frequency_hz: float = CARRIER_FREQUENCY_HZ
) -> Path:
    """Write `scene.xml` and its meshes into an existing folder, and return the path of `scene.xml`.

    World x and y `offset_m` become the origin (`geometry.origin_m` gives local coordinates). Wall i has the triangles
    2 i and 2 i + 1, counted through `geometry.shapes`. Adjacent walls of one material share vertices, forming wedges.
    """
    shift = np.array([*np.subtract(geometry.origin_m, offset_m), 0.0])
    scene = _new_scene(folder)
    meshes = {name: mesh for name, mesh in _meshes(geometry).items() if len(mesh[1])}
    number = {name: 0 if name in FLAT_SHAPES else index for index, name in enumerate(geometry.shapes)}
    number |= {f"lid{index}": lid.material for index, lid in enumerate(geometry.lids)}
    for index in sorted({0, *(number[name] for name in meshes)}):
        _add_material(scene, f"material{index or ''}", geometry.materials[index], frequency_hz)
    for name, (vertices, faces) in meshes.items():
        _write_ply(folder / "meshes" / f"{name}.ply", vertices + shift, faces)
        _add_shape(scene, name, f"material{number[name] or ''}")
    return _write_xml(scene, folder)


def write_mesh_scene(
    mesh: SceneMesh,
    folder: Path,
    *,
    offset_m: Sequence[float],
    default_material: Material,
    frequency_hz: float = CARRIER_FREQUENCY_HZ,
) -> Path:
    """Write `scene.xml` and the meshes of a SceneMesh, and return the path of `scene.xml`.

    Shapes `part0`, `part1`, ... have the triangles of each material in order; empty ones are left out. The world
    position `offset_m`, (x, y) or (x, y, z), becomes the origin.
    """
    shift = np.zeros(3)
    shift[: len(offset_m)] = offset_m
    scene = _new_scene(folder)
    for index in np.unique(mesh.material):
        name, material = f"part{index}", mesh.materials[index] or default_material
        used, triangles = np.unique(mesh.triangles[mesh.material == index], return_inverse=True)
        _write_ply(folder / "meshes" / f"{name}.ply", mesh.vertices_m[used] - shift, triangles.reshape(-1, 3))
        _add_material(scene, f"material{index}", material, frequency_hz)
        _add_shape(scene, name, f"material{index}")
    return _write_xml(scene, folder)


class PowerLaw(NamedTuple):
    """A constant of a material near one frequency: ``value * (frequency ratio) ** exponent``."""

    value: float
    exponent: float


def power_laws(material: Material, frequency_hz: float) -> tuple[PowerLaw, PowerLaw]:
    """Return relative permittivity and conductivity [S/m] around a frequency (ITU-R P.2040-3, eq. 28 and 29)."""
    if material.itu is None:
        grown = (frequency_hz / CARRIER_FREQUENCY_HZ) ** material.conductivity_exponent
        conductivity = PowerLaw(material.conductivity_s_m * grown, material.conductivity_exponent)
        return PowerLaw(material.relative_permittivity, 0.0), conductivity
    load_llvm()
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    frequency_ghz = frequency_hz / 1e9
    bands = ITU_MATERIALS_PROPERTIES[material.itu].items()
    a, b, c, d = next(factors for (low, high), factors in bands if low <= frequency_ghz <= high)
    return PowerLaw(a * frequency_ghz**b, b), PowerLaw(c * frequency_ghz**d, d)


def constants_of(material: Material, frequency_hz: float) -> tuple[float, float]:
    """Return relative permittivity and conductivity [S/m] at a frequency."""
    permittivity, conductivity = power_laws(material, frequency_hz)
    return permittivity.value, conductivity.value


def _new_scene(folder: Path) -> ET.Element:
    (folder / "meshes").mkdir(exist_ok=True)
    return ET.Element("scene", version="2.1.0")


def _write_xml(scene: ET.Element, folder: Path) -> Path:
    ET.indent(scene)
    path = folder / "scene.xml"
    ET.ElementTree(scene).write(path, encoding="utf-8")
    return path


def _write_ply(path: Path, vertices_m: Floats, triangles: NDArray[np.integer]) -> None:
    """Write a mesh in float64; trimesh would round to float32, and takes a quarter of a second to import."""
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, triangles
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices_m)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(lines).encode() + vertices_m.astype("<f8").tobytes() + faces.tobytes())


def _add_shape(scene: ET.Element, name: str, material: str) -> None:
    shape = ET.SubElement(scene, "shape", type="ply", id=name)
    ET.SubElement(shape, "string", name="filename", value=f"meshes/{name}.ply")
    ET.SubElement(shape, "boolean", name="face_normals", value="true")
    ET.SubElement(shape, "ref", name="bsdf", id=material)


def _add_material(scene: ET.Element, name: str, material: Material, frequency_hz: float) -> None:
    """Add an ITU material by name if Sionna RT can load it so, others by constants."""
    itu = material.itu
    # Sionna RT 2.2.0 has no display colour for vacuum, and fails.
    if itu is not None and itu != "vacuum" and any(low <= SIONNA_LOAD_GHZ <= high for low, high in ITU_BANDS_GHZ[itu]):
        bsdf = ET.SubElement(scene, "bsdf", type="itu-radio-material", id=name)
        ET.SubElement(bsdf, "string", name="type", value=itu)
    else:
        permittivity, conductivity_s_m = constants_of(material, frequency_hz)
        bsdf = ET.SubElement(scene, "bsdf", type="radio-material", id=name)
        ET.SubElement(bsdf, "float", name="relative_permittivity", value=repr(float(permittivity)))
        ET.SubElement(bsdf, "float", name="conductivity", value=repr(float(conductivity_s_m)))
    ET.SubElement(bsdf, "float", name="thickness", value=repr(float(material.thickness_m)))


def _meshes(geometry: SceneGeometry) -> dict[str, tuple[Floats, NDArray[np.int64]]]:
    low = np.column_stack([geometry.vertices_m, np.zeros(len(geometry.vertices_m))])
    up = np.array([0.0, 0.0, geometry.height_m])
    (a, b), levels = geometry.segments.T, np.unique([geometry.height_m, *geometry.top_m])
    above = len(low) * (1 + np.searchsorted(levels, geometry.top_m))
    walls = np.stack([a, b, b + above, a, b + above, a + above], axis=1).reshape(-1, 3)
    corners, triangles = geometry.floor_mesh
    floor = np.column_stack([corners, np.zeros(len(corners))])
    ends = 2 * np.searchsorted(geometry.wall_material, np.arange(len(geometry.materials) + 1))
    of_material = (walls[first:last] for first, last in itertools.pairwise(ends))
    vertices = np.concatenate([low, *(low + np.array([0.0, 0.0, level]) for level in levels)])
    meshes = {name: (vertices, faces) for name, faces in zip(geometry.shapes, of_material, strict=False)}
    meshes["floor"] = floor, triangles
    meshes |= {"ceiling": (floor + up, triangles[:, ::-1])} if geometry.ceiling else {}
    for index, lid in enumerate(geometry.lids):
        meshes[f"lid{index}"] = np.column_stack([lid.corners_m, np.full(len(lid.corners_m), lid.top_m)]), lid.triangles
    return meshes


def _open_ends(partial: PartialMap, outlines: Outlines) -> Bools:
    """Return the vertices (V,) where a single wall ends and the next cell is not free."""
    ends, tails = outlines.segments.ravel(), outlines.segments[:, ::-1].ravel()
    along = outlines.vertices_m[ends] - outlines.vertices_m[tails]
    along *= 0.75 * partial.resolution_m / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    beyond = partial.state_at(outlines.vertices_m[ends] + along + partial.origin_m)
    is_open = np.zeros(len(outlines.vertices_m), dtype=bool)
    is_open[ends] = beyond != CellState.FREE
    return is_open & (np.bincount(ends, minlength=len(is_open)) == 1)


def _lids(partial: PartialMap, walls_m: Floats, material: Indices, top_m: Floats) -> Iterator[Lid]:
    """Cover areas inside outlines of obstacles of one height, except mostly free ones."""
    free = partial.state == CellState.FREE
    row, column = np.indices(partial.shape)
    centres_m = (np.stack([column, row], axis=-1) + 0.5) * partial.resolution_m
    for level_m in np.unique(top_m[top_m < partial.wall_height_m]).tolist():
        sides = np.flatnonzero(top_m == level_m)
        lines = shapely.linestrings(walls_m[sides])
        for area in shapely.get_parts(shapely.polygonize(lines)):
            first, last = (np.floor(np.reshape(area.bounds, (2, 2)) / partial.resolution_m)).astype(int)
            window = slice(max(first[1], 0), last[1] + 1), slice(max(first[0], 0), last[0] + 1)
            inside = shapely.contains_xy(area, *np.moveaxis(centres_m[window], -1, 0))
            if 2 * (inside & free[window]).sum() > inside.sum():
                continue
            beside = sides[shapely.covers(shapely.buffer(shapely.boundary(area), 1e-6), lines)]
            most = int(np.bincount(material[beside], minlength=1).argmax())
            parts = shapely.get_parts(shapely.constrained_delaunay_triangles(area))
            yield Lid(*_joined(parts), level_m, most)


def _triangles(rectangles_m: Floats, cell_m: float) -> tuple[Floats, NDArray[np.int64]]:
    """Return corners (V, 2) and counterclockwise triangles (F, 3) of an area.

    Triangles share whole edges: an inner edge must not look like the rim of a screen, which diffracts.
    """
    area = shapely.simplify(shapely.union_all(shapely.box(*np.rint(rectangles_m / cell_m).T)), 0.0)
    corners, triangles = _joined(_pieces(area))
    return corners * cell_m, triangles[np.lexsort(triangles.T)]


def _joined(parts: NDArray[np.object_]) -> tuple[Floats, NDArray[np.int64]]:
    """Return common corners (V, 2) and counterclockwise corner numbers (F, 3) of triangles."""
    rings = shapely.get_coordinates(shapely.orient_polygons(parts)).reshape(-1, 4, 2)[:, :3]
    corners, index = np.unique(rings.reshape(-1, 2), axis=0, return_inverse=True)
    return corners, index.reshape(-1, 3).astype(np.int64)


def _pieces(area: shapely.Geometry) -> NDArray[np.object_]:
    """Return triangles with integer corners, in strips where GEOS fails (docs/development.md)."""
    strips, count = area, 1
    while True:
        try:
            return shapely.get_parts(shapely.constrained_delaunay_triangles(strips))
        except shapely.errors.GEOSException:
            x0, y0, x1, y1 = area.bounds
            count *= 2
            cuts = np.unique(np.floor(np.linspace(x0, x1, count + 1)[1:-1])) + 0.5  # no corner is there
            strips = shapely.intersection(area, shapely.box([x0, *cuts], y0, [*cuts, x1], y1))


def floor_cells(partial: PartialMap, extent: str) -> Bools:
    if extent == "none":
        return np.zeros(partial.shape, dtype=bool)
    free = partial.wall_levels[0][1].state == CellState.FREE
    beside = ndimage.binary_dilation(free, structure=np.ones((3, 3)))
    return free | (beside & (partial.state == CellState.WALL))


def _rectangles(mask: Bools) -> NDArray[np.int64]:
    row, start, end = row_runs(mask)
    order = np.lexsort((row, end, start))
    row, start, end = row[order], start[order], end[order]
    new = (np.diff(start, prepend=-1) != 0) | (np.diff(end, prepend=-1) != 0) | (np.diff(row, prepend=-2) != 1)
    first = np.nonzero(new)[0]
    last = np.append(first[1:], len(row)) - 1 if len(row) else first
    rectangles = np.stack([start[first], row[first], end[first], row[last] + 1], axis=1)
    return rectangles[np.lexsort((rectangles[:, 0], rectangles[:, 1]))]
