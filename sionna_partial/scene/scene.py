"""PartialMap -> SceneGeometry -> Mitsuba XML + PLY: the one place that writes scenes."""

import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.constants import CARRIER_FREQUENCY_HZ, CellState
from sionna_partial.files import atomic_folder
from sionna_partial.maps.mesh.mesh import SceneMesh
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.maps.ros_map import write_ros_map
from sionna_partial.scene.floor_plan import Plan, prepare_plan
from sionna_partial.scene.lattice import lattice_outlines
from sionna_partial.scene.outlines import Outlines, wall_outlines
from sionna_partial.scene.scene_xml import add_material, add_shape, write_ply, write_xml
from sionna_partial.scene.wall_cells import row_runs
from sionna_partial.settings import Material, SceneSettings, settings_or_default

SHAPES = ("walls", "floor", "ceiling")
"""Shapes of an exported floor plan in the order in which faces are counted; those that are empty are left out."""

FAR_M = 1000.0
"""Largest coordinate that a scene keeps [m]: float32 has steps of 0.06 mm there. Maps that reach farther are moved."""


@dataclass(frozen=True)
class SceneGeometry:
    """What is extruded: walls, floor and ceiling of a map, in its local frame.

    The local frame has its origin at the lower-left corner of the grid, on the floor.

    Parameters
    ----------
    vertices_m : (V, 2) float64 array
        Ends of the wall outlines [m].
    segments : (S, 2) int64 array
        Walls, as indices into `vertices_m`.
    open_end : (V,) bool array
        Where a wall ends because observation did: what lies beyond is not free.
    floor_m : (R, 4) float64 array
        Rectangles x0, y0, x1, y1 of floor and ceiling [m]; they do not overlap.
    cell_m : float
        Edge of the square lattice that the rectangles lie on [m].
    height_m : float
        Height of walls and ceiling [m].
    ceiling : bool
        Whether there is a ceiling above the floor.
    material : Material
        Material of everything.
    origin_m : (float, float)
        World x and y of the local frame's origin [m].
    """

    vertices_m: NDArray[np.float64]
    segments: NDArray[np.int64]
    open_end: NDArray[np.bool_]
    floor_m: NDArray[np.float64]
    cell_m: float
    height_m: float
    ceiling: bool
    material: Material
    origin_m: tuple[float, float]

    @property
    def walls_m(self) -> NDArray[np.float64]:
        """End points (S, 2, 2) of the walls [m]."""
        return self.vertices_m[self.segments]

    @cached_property
    def plan(self) -> Plan:
        """The walls, cut where they cross."""
        return prepare_plan(self.walls_m)

    @property
    def floor_face(self) -> int:
        """First face of the floor, -1 if there is none: faces count through walls, floor and ceiling."""
        return 2 * len(self.segments) if len(self.floor_m) else -1

    @property
    def ceiling_face(self) -> int:
        """First face of the ceiling, -1 if there is none."""
        return self.floor_face + len(self.floor_mesh[1]) if len(self.floor_m) and self.ceiling else -1

    @cached_property
    def floor_mesh(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Corners (K, 2) [m] and counterclockwise triangles (T, 3) of the floor."""
        return _triangles(self.floor_m, self.cell_m)


def scene_settings_of(partial: PartialMap, settings: SceneSettings | None, name: str = "settings") -> SceneSettings:
    """Return the settings of a map's scene: its own material, where it has one, takes the place of theirs.

    Parameters
    ----------
    partial : PartialMap
    settings : SceneSettings or None
        None is the default.
    name : str
        What the settings are called, for the message.

    Raises
    ------
    SettingsError
        For settings of another kind.
    """
    settings = settings_or_default(name, settings, SceneSettings)
    return settings if partial.material is None else replace(settings, material=partial.material)


def build_scene(partial: PartialMap, settings: SceneSettings | None = None) -> SceneGeometry:
    """Turn a map into walls, floor and ceiling.

    Parameters
    ----------
    partial : PartialMap
    settings : SceneSettings, optional
        Tolerances, floor extent and material.

    Returns
    -------
    SceneGeometry
    """
    require_map("partial", partial)
    settings = scene_settings_of(partial, settings)
    outlines = _outlines(partial, settings)
    return SceneGeometry(
        vertices_m=outlines.vertices_m,
        segments=outlines.segments,
        open_end=_open_ends(partial, outlines),
        floor_m=_rectangles(_floor_cells(partial, settings.floor_extent)).astype(float) * partial.resolution_m,
        cell_m=partial.resolution_m,
        height_m=partial.wall_height_m,
        ceiling=settings.ceiling,
        material=settings.material,
        origin_m=partial.origin_m,
    )


def export_scene(
    partial: PartialMap,
    folder: str | os.PathLike[str],
    settings: SceneSettings | None = None,
    *,
    frequency_hz: float = CARRIER_FREQUENCY_HZ,
) -> Path:
    """Write a map as a scene folder that stock Sionna RT loads.

    The folder holds `scene.xml`, `meshes/walls.ply`, `meshes/floor.ply` and `meshes/ceiling.ply` (those that are not
    empty), and the map itself as `map.yaml` and `map.pgm`, from which `load_map` reads it back. Scene coordinates are
    the map's world coordinates less `scene_offset` in `map.yaml`: [0, 0], or the lower-left corner of a map that
    reaches farther than `FAR_M` from the origin.

    A map with a mesh has its `meshes/part0.ply` and so on, one for each material, in place of walls, floor and
    ceiling, and a `scene_offset` of three whole numbers; axes on which it lies on both sides of the origin stay.

    Parameters
    ----------
    partial : PartialMap
    folder : path-like
        New or empty folder, or an exported scene that is replaced.
    settings : SceneSettings, optional
        Tolerances, floor extent and material.
    frequency_hz : float
        Frequency [Hz] at which an ITU material is evaluated that Sionna RT cannot load by its name.

    Returns
    -------
    pathlib.Path
        The folder.

    Raises
    ------
    SettingsError
        For a frequency that the material does not cover.
    OutputError
        If writing fails; nothing half written is left behind.
    """
    if isinstance(partial, PartialMap) and partial.mesh is not None:
        return _export_mesh_scene(partial, partial.mesh, folder, settings, frequency_hz)
    geometry = build_scene(partial, settings)
    geometry.material.require_frequency(frequency_hz)
    far = max(abs(value) for value in partial.bounds_m) > FAR_M
    offset_m = partial.origin_m if far else (0.0, 0.0)
    with atomic_folder(folder) as place:
        write_scene(geometry, place, offset_m=offset_m, frequency_hz=frequency_hz)
        write_ros_map(partial, place / "map.yaml", {"scene_offset": list(offset_m)})
    return Path(folder)


def _export_mesh_scene(
    partial: PartialMap,
    mesh: SceneMesh,
    folder: str | os.PathLike[str],
    settings: SceneSettings | None,
    frequency_hz: float,
) -> Path:
    material = scene_settings_of(partial, settings).material
    for used in mesh.used_materials(material):
        used.require_frequency(frequency_hz)
    x0, y0, x1, y1 = partial.bounds_m
    offset_m = [_whole_offset_m(low, high) for low, high in ((x0, x1), (y0, y1), partial.height_range_m)]
    with atomic_folder(folder) as place:
        write_mesh_scene(mesh, place, offset_m=offset_m, default_material=material, frequency_hz=frequency_hz)
        write_ros_map(partial, place / "map.yaml", {"scene_offset": offset_m})
    return Path(folder)


def _whole_offset_m(low_m: float, high_m: float) -> float:
    """Whole number of metres that takes a far axis to the origin, and takes no digit from any number beyond it."""
    if max(abs(low_m), abs(high_m)) <= FAR_M:
        return 0.0
    return float(np.floor(max(low_m, 0.0)) + np.ceil(min(high_m, 0.0)))


def write_scene(
    geometry: SceneGeometry,
    folder: Path,
    *,
    offset_m: tuple[float, float],
    frequency_hz: float = CARRIER_FREQUENCY_HZ,
) -> Path:
    """Write `scene.xml` and its meshes into an existing folder.

    Wall i is made of the triangles 2 i and 2 i + 1; walls that meet share vertices, so that they form wedges.

    Parameters
    ----------
    geometry : SceneGeometry
    folder : pathlib.Path
    offset_m : (float, float)
        World x and y that become the scene's origin [m]; `geometry.origin_m` gives local coordinates.
    frequency_hz : float
        Frequency [Hz] at which an ITU material is evaluated that Sionna RT cannot load by its name.

    Returns
    -------
    pathlib.Path
        `scene.xml`.
    """
    shift = np.array([*np.subtract(geometry.origin_m, offset_m), 0.0])
    (folder / "meshes").mkdir(exist_ok=True)
    scene = ET.Element("scene", version="2.1.0")
    add_material(scene, "material", geometry.material, frequency_hz)
    for name, (vertices, faces) in _meshes(geometry).items():
        if len(faces):
            mesh = trimesh.Trimesh(vertices + shift, faces, process=False)
            mesh.export(folder / "meshes" / f"{name}.ply")
            add_shape(scene, name, "material")
    return write_xml(scene, folder)


def write_mesh_scene(
    mesh: SceneMesh,
    folder: Path,
    *,
    offset_m: Sequence[float],
    default_material: Material,
    frequency_hz: float = CARRIER_FREQUENCY_HZ,
) -> Path:
    """Write `scene.xml` and the meshes of a SceneMesh into an existing folder.

    The shape `part0` has the triangles of the first of the mesh's materials, in their order, `part1` those of the
    second, and so on; parts without triangles are left out. Triangles of a part share their vertices.

    Parameters
    ----------
    mesh : SceneMesh
    folder : pathlib.Path
    offset_m : (x, y) or (x, y, z)
        World position that becomes the scene's origin [m].
    default_material : Material
        Takes the place of None among the mesh's materials.
    frequency_hz : float
        Frequency [Hz] at which an ITU material is evaluated that Sionna RT cannot load by its name.

    Returns
    -------
    pathlib.Path
        `scene.xml`.
    """
    shift = np.zeros(3)
    shift[: len(offset_m)] = offset_m
    (folder / "meshes").mkdir(exist_ok=True)
    scene = ET.Element("scene", version="2.1.0")
    for index in np.unique(mesh.material):
        name, material = f"part{index}", mesh.materials[index] or default_material
        used, triangles = np.unique(mesh.triangles[mesh.material == index], return_inverse=True)
        write_ply(folder / "meshes" / f"{name}.ply", mesh.vertices_m[used] - shift, triangles.reshape(-1, 3))
        add_material(scene, f"material{index}", material, frequency_hz)
        add_shape(scene, name, f"material{index}")
    return write_xml(scene, folder)


def _meshes(geometry: SceneGeometry) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Vertices (V, 3) [m] and triangles (F, 3) of each mesh, in the local frame."""
    low = np.column_stack([geometry.vertices_m, np.zeros(len(geometry.vertices_m))])
    up = np.array([0.0, 0.0, geometry.height_m])
    (a, b), count = geometry.segments.T, len(low)
    walls = np.stack([a, b, b + count, a, b + count, a + count], axis=1).reshape(-1, 3)
    corners, triangles = geometry.floor_mesh
    floor = np.column_stack([corners, np.zeros(len(corners))])
    meshes = {"walls": (np.concatenate([low, low + up]), walls), "floor": (floor, triangles)}
    return meshes | ({"ceiling": (floor + up, triangles[:, ::-1])} if geometry.ceiling else {})


def _outlines(partial: PartialMap, settings: SceneSettings) -> Outlines:
    if settings.outline == "cells":
        return lattice_outlines(partial)
    return wall_outlines(partial, tolerance_cells=settings.outline_tolerance_cells, bridge_gap_m=settings.bridge_gap_m)


def _open_ends(partial: PartialMap, outlines: Outlines) -> NDArray[np.bool_]:
    """Find the vertices (V,) where one wall ends and the cell beyond its end is not free."""
    ends, tails = outlines.segments.ravel(), outlines.segments[:, ::-1].ravel()
    along = outlines.vertices_m[ends] - outlines.vertices_m[tails]
    along *= 0.75 * partial.resolution_m / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    beyond = partial.state_at(outlines.vertices_m[ends] + along + partial.origin_m)
    is_open = np.zeros(len(outlines.vertices_m), dtype=bool)
    is_open[ends] = beyond != CellState.FREE
    return is_open & (np.bincount(ends, minlength=len(is_open)) == 1)


def _triangles(rectangles_m: NDArray[np.float64], cell_m: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners (V, 2) and counterclockwise triangles (F, 3) of an area.

    Triangles share whole edges: an edge inside the area must not look like the rim of a screen, which diffracts.
    """
    area = shapely.simplify(shapely.union_all(shapely.box(*np.rint(rectangles_m / cell_m).T)), 0.0)
    pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(area))
    rings = shapely.get_coordinates(shapely.orient_polygons(pieces)).reshape(-1, 4, 2)[:, :3]
    corners, index = np.unique(rings.reshape(-1, 2), axis=0, return_inverse=True)
    triangles = index.reshape(-1, 3)
    return corners * cell_m, triangles[np.lexsort(triangles.T)].astype(np.int64)


def _floor_cells(partial: PartialMap, extent: str) -> NDArray[np.bool_]:
    """Cells (ny, nx) that floor and ceiling cover."""
    if extent == "none":
        return np.zeros(partial.shape, dtype=bool)
    if extent == "map":
        return np.ones(partial.shape, dtype=bool)
    free = partial.state == CellState.FREE
    beside = ndimage.binary_dilation(free, structure=np.ones((3, 3)))
    return free | (beside & (partial.state == CellState.WALL))


def _rectangles(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Cover the cells of a mask exactly by few rectangles x0, y0, x1, y1 in cells: equal runs of rows merge."""
    row, start, end = row_runs(mask)
    order = np.lexsort((row, end, start))
    row, start, end = row[order], start[order], end[order]
    new = (np.diff(start, prepend=-1) != 0) | (np.diff(end, prepend=-1) != 0) | (np.diff(row, prepend=-2) != 1)
    first = np.nonzero(new)[0]
    last = np.append(first[1:], len(row)) - 1 if len(row) else first
    rectangles = np.stack([start[first], row[first], end[first], row[last] + 1], axis=1)
    return rectangles[np.lexsort((rectangles[:, 0], rectangles[:, 1]))]
