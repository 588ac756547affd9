"""Maps in and out: files of this package, arrays, and the readers of other formats."""

from __future__ import annotations

import io
import json
import os
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial as bind
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import States
from sionna_partial.checks import require_bool, shown
from sionna_partial.constants import (
    BAG_SUFFIXES,
    DEFAULT_WALL_HEIGHT_M,
    DRAWING_SUFFIXES,
    IFC_SUFFIXES,
    MESH_SUFFIXES,
    PICTURE_SUFFIXES,
    POINT_SUFFIXES,
    VACUUM_SUFFIXES,
    CellState,
)
from sionna_partial.display import later
from sionna_partial.errors import MapError, OutputError
from sionna_partial.files import (
    CALIBRATED_FILE,
    SCENE_FILES,
    atomic_write,
    decoding,
    input_path,
    output_path,
    read_bytes,
)
from sionna_partial.maps.environment import MAX_CELLS, ODD_CELLS, ImportSource, MapWarning, grid_array, layers_of
from sionna_partial.maps.mesh.scene_mesh import MAX_MESH_BYTES, MAX_TRIANGLES, SceneMesh
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.maps.ros_map import bare_image, read_ros_map
from sionna_partial.maps.ros_map_writer import write_ros_map
from sionna_partial.settings import Material

ACCEPTED = (
    "a ROS map YAML (.yaml, .yml), a map written by save_map (.npz), an exported scene (folder or scene.xml), "
    "the folder of a calibration, "
    f"a Mitsuba scene (folder or .xml), a mesh ({', '.join(MESH_SUFFIXES)}), a point cloud "
    f"({', '.join(POINT_SUFFIXES)}, .ply), a drawing ({', '.join(DRAWING_SUFFIXES)}), "
    f"a building model ({', '.join(IFC_SUFFIXES)}), the map of a vacuum robot ({', '.join(VACUUM_SUFFIXES)}), "
    f"a floor plan as a picture ({', '.join(PICTURE_SUFFIXES)}), or a rosbag ({', '.join(BAG_SUFFIXES)}, or a folder)"
)

_MESH_BYTES = 24 * 3 * MAX_TRIANGLES + 1000

COVERAGE_SUFFIXES = (".nc", ".tif", ".tiff")


def load_map(
    path: str | os.PathLike[str],
    *,
    strict: bool = False,
    wall_height_m: float | None = None,
    height_band_m: tuple[float, float] | None = None,
    observed: ArrayLike | PartialMap | None = None,
    resolution_m: float | None = None,
    up: str | None = None,
    layer_materials: Mapping[str, Material | str] | None = None,
    wall_layers: Sequence[str] | None = None,
    unit_m: float | None = None,
    storey: str | None = None,
    obstacle_height_m: float | None = None,
) -> PartialMap:
    """Read a map from a file or a folder.

    In a mesh, observed cells with a surface in the height band are walls, other observed cells are free. The map
    carries the mesh, cut at the border of its known cells.

    Parameters
    ----------
    path : path-like
        - ROS map_server YAML (modes trinary, scale and raw; PGM, PNG or BMP image)
        - `.npz` of `save_map`
        - exported scene (folder or `scene.xml`), or folder of `sionna-partial calibrate`
        - mesh in metres (PLY, GLB, GLTF, OBJ, STL)
        - Mitsuba scene of meshes with radio materials of Sionna RT (`.xml`, or a folder with one)
        - point cloud in metres (PCD, PLY, LAS, LAZ, XYZ, PTS): see `map_from_points`
        - DXF floor plan: see `map_from_drawing`
        - picture of a floor plan (PNG, JPEG, BMP), with `resolution_m`
        - building model (IFC, extra `ifc`): walls, columns, windows and curtain walls, 1.2 m above a storey; doors are
          open
        - map of a vacuum robot (Valetudo JSON, Valeronoi .vwm), whose segments become `PartialMap.room`
        - rosbag (.bag, .mcap, .db3, or a folder): see `map_from_bag`
    strict : bool
        Read a ROS map exactly as map_server does. By default the shade 205 (unknown in saved maps) and transparent
        pixels of a trinary map stay unknown, with a `MapWarning`.
    wall_height_m : float or None
        Instead of the file's wall height [m]. For a mesh, the height above its lowest point up to which radios may be.
    height_band_m : (float, float) or None
        World z between which surfaces of a mesh, or points of a cloud, are walls [m]. By default 1.0 to 1.8 m
        above the lowest point of a mesh, or the lowest floor of a cloud.
    observed : (M, 2) array-like, PartialMap or None
        Observed part of a mesh: polygon in world x and y [m], or a map with known cells. By default all cells above
        or below which the mesh has a surface.
    resolution_m : float or None
        Edge of the cells of a mesh, cloud, drawing or building model [m], by default 0.05; for a picture, metres per
        pixel (required).
    up : {"z", "y", "-z", "-y"} or None
        Axis of a mesh or cloud that points up: by default y for glTF (its specification) and z for others, with a
        `MapWarning` if floor, ceiling or furniture show another one. Scans that lean by up to 10 degrees are levelled,
        with a `MapWarning`; others are refused.
    layer_materials : mapping of str to Material or str, or None
        Materials by layers of a drawing (see `map_from_drawing`), or by types of a building model, such as "IfcWall";
        "IfcDoor" closes the doors.
    wall_layers : sequence of str or None
        As in `map_from_drawing`.
    unit_m : float or None
        Length of a unit of a drawing, mesh or cloud [m], by default the drawing's header, and 1 for meshes and clouds.
    storey : str or None
        Storey of a building model; optional if only one has walls.
    obstacle_height_m : float or None
        Height of free-standing obstacles on a floor plan [m] (see `PartialMap.with_obstacle_height`).

    Returns
    -------
    PartialMap
        In world axes, with the yaw of the origin applied: quarter turns are exact, any other yaw halves the size of
        the cells. `import_report` lists used and skipped elements.

    Raises
    ------
    MapError
        For a missing, damaged or unknown file, a value out of range, or an argument for another kind of file.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.save_map(sp.map_from_array([[1, 1, 1], [1, 0, 2]], resolution_m=0.1), "home.yaml")
    >>> sp.load_map("home.yaml").state.tolist()
    [[1, 1, 1], [1, 0, 2]]
    """
    makers = "For arrays there are map_from_array, map_from_occupancy and map_from_points."
    source = input_path(path, "path", MapError, f"give {ACCEPTED}. {makers}")
    require_bool("strict", strict)
    if not os.path.isdir(source) and not os.path.isfile(source):
        raise MapError(f"path = '{source}' is not there: give {ACCEPTED}.")
    file, reader = _reader_of(source)
    given: dict[str, Any] = {"height_band_m": height_band_m, "observed": observed, "resolution_m": resolution_m}
    given |= {"up": up, "layer_materials": layer_materials, "storey": storey}
    given |= {"wall_layers": wall_layers, "unit_m": unit_m}
    for name, value in given.items():
        if value is not None and name not in reader.options:
            kinds = _OPTIONS_OF.get(name, "scans")
            raise MapError(f"{name} is for {kinds} alone, but path = '{source}' is {reader.what}: leave it out.")
    given["strict"] = strict or None
    partial = reader.read(file, **{name: given[name] for name in reader.options if given[name] is not None})
    if partial.import_source is None:
        partial = replace(partial, import_source=ImportSource(str(source)))
    if partial.environment.is_extruded:
        _warn_of_odd_states(f"path = '{source}'", partial.state)
    if wall_height_m is not None:
        partial = replace(partial, wall_height_m=wall_height_m)
        partial = replace(partial, **partial.environment.with_height(partial.wall_height_m))
    return partial if obstacle_height_m is None else partial.with_obstacle_height(obstacle_height_m)


def _warn_of_odd_states(what: str, state: States) -> None:
    """Warn of a map without walls or free cells, or that looks inverted."""
    count = np.bincount(state.ravel(), minlength=len(CellState))
    free, wall = int(count[CellState.FREE]), int(count[CellState.WALL])
    if state.size < ODD_CELLS:
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


def save_map(partial: PartialMap, path: str | os.PathLike[str], *, extra: Mapping[str, object] | None = None) -> None:
    """Write a map so that `load_map` returns an equal one.

    Parameters
    ----------
    partial : PartialMap
    path : path-like
        `.yaml` or `.yml` (ROS map_server, with a `.pgm` of the same stem; not for meshes) or `.npz`.
    extra : mapping or None
        Further keys for the YAML.

    Raises
    ------
    MapError
        For anything but a PartialMap.
    OutputError
        For another suffix, a mesh or `extra` in a format without them, or if writing fails; no partial file remains.

    Examples
    --------
    >>> import tempfile, sionna_partial as sp
    >>> partial = sp.map_from_array([[1, 1, 1], [1, 0, 2]], resolution_m=0.1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sp.save_map(partial, f"{folder}/home.npz")
    ...     sp.load_map(f"{folder}/home.npz") == partial
    True
    """
    require_map("partial", partial)
    target = output_path(path)
    suffix = target.suffix.lower()
    if suffix in (".yaml", ".yml"):
        if suffix not in partial.environment.suffixes:
            raise OutputError(f"path = '{target}' cannot hold the map's mesh: choose .npz, or use export_scene.")
        write_ros_map(partial, target, extra)
    elif suffix == ".npz":
        if extra is not None:
            raise OutputError(f"extra = {shown(extra)} cannot be held by '{target}': leave it out, or choose .yaml.")
        content: dict[str, Any] = {
            "state": partial.state,
            "resolution_m": partial.resolution_m,
            "origin_m": partial.origin_m,
            "wall_height_m": partial.wall_height_m,
        }
        if partial.interior_cells is not None:
            content["interior_cells"] = partial.interior_cells
        if partial.material is not None:
            content["material"] = json.dumps(asdict(partial.material))
        for name, (cells, counted, values) in partial.layers().items():
            content[name], content[counted] = cells, values if name == "obstacle" else json.dumps(values)
        with atomic_write(target) as stream:
            np.savez_compressed(stream, **content, **partial.environment.arrays())
    else:
        raise OutputError(f"path = '{target}' has the suffix '{target.suffix}': choose .yaml, .yml or .npz.")


def map_from_array(
    array: ArrayLike,
    resolution_m: float,
    *,
    origin_m: tuple[float, float] = (0.0, 0.0),
    wall_height_m: float = DEFAULT_WALL_HEIGHT_M,
) -> PartialMap:
    """Make a map from an array of CellState integers.

    Parameters
    ----------
    array : (ny, nx) integers
        FREE 0, WALL 1, UNKNOWN 2. Row 0 holds the smallest y (turn images with `numpy.flipud`).
    resolution_m : float
        Edge of a cell [m].
    origin_m : (float, float)
        World x and y of the lower-left corner of cell [0, 0] [m].
    wall_height_m : float
        Height of walls and ceiling [m].

    Raises
    ------
    MapError
        For another shape, other values, or a number out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.map_from_array([[1, 1, 1], [1, 0, 2]], resolution_m=0.1).is_complete
    False
    """
    return PartialMap(grid_array("array", array, "iub"), resolution_m, origin_m, wall_height_m)


def _importer(reader: str) -> Callable[..., PartialMap]:
    """Return a reader of the importers, which are imported when a file of theirs is read."""
    return lambda source, **options: later(reader)(source, **options)


_read_cloud = _importer("maps.importers.points:map_from_points")

_UNIT_SOURCES = {".xml": "Mitsuba scene", **dict.fromkeys((".glb", ".gltf"), "specification of glTF")}


def _read_mesh(source: Path, **options: Any) -> PartialMap:
    from sionna_partial.maps.mesh.cells import MeshReading, mesh_map
    from sionna_partial.maps.mesh.files import read_mesh, read_mitsuba_scene

    reading, suffix = MeshReading(**options), source.suffix.lower()
    notes = reading.notes(source, _UNIT_SOURCES.get(suffix, "taken for metres"))
    is_scene = suffix == ".xml"  # the unit of Sionna RT's scenes is the metre
    mesh = read_mitsuba_scene(source, notes) if is_scene else read_mesh(source, reading.up, notes)
    return reading.attached(notes, mesh_map(mesh, reading, is_metric=is_scene))


def _read_ply(source: Path, **options: Any) -> PartialMap:
    is_cloud = later("maps.importers.cloud_files:is_cloud")(source)
    return (_read_cloud if is_cloud else _read_mesh)(source, **options)


def _read_npz(source: Path) -> PartialMap:
    with decoding(source, "was not written by save_map", MapError, "save it again."):
        content = io.BytesIO(read_bytes(source, "path", MapError, MAX_MESH_BYTES))
        with zipfile.ZipFile(content) as archive:
            sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
        if sizes.pop("state.npy") > MAX_CELLS + 1000:
            raise MapError(f"path = '{source}' holds more than {MAX_CELLS:,} cells: cut the map or coarsen it.")
        if max(sizes.values(), default=0) > _MESH_BYTES:
            raise MapError(f"path = '{source}' holds more than {MAX_TRIANGLES:,} triangles: cut or simplify the mesh.")
        with np.load(content, allow_pickle=False) as content:
            state, resolution_m = content["state"], content["resolution_m"].item()
            origin_m, height_m = tuple(content["origin_m"].tolist()), content["wall_height_m"].item()
            interior = int(content["interior_cells"]) if "interior_cells" in content else None
            material = Material(**json.loads(str(content["material"]))) if "material" in content else None
            layers = layers_of(content, np.asarray, lambda data: data.tolist() if data.ndim else json.loads(str(data)))
            mesh = None
            if "mesh_triangles" in content:
                vertices_m, triangles = content["mesh_vertices_m"], content["mesh_triangles"]
                records = json.loads(str(content["mesh_materials"]))
                materials = tuple(None if record is None else Material(**record) for record in records)
                low, high = content["mesh_height_range_m"].tolist()
                mesh = SceneMesh(vertices_m, triangles, content["mesh_material"], materials, (low, high))
    return PartialMap(state, resolution_m, origin_m, height_m, interior, mesh, material, **layers)


class _Reader(NamedTuple):
    what: str
    read: Callable[..., PartialMap]
    options: tuple[str, ...] = ()


_OPTIONS_OF = {
    "layer_materials": "drawings and building models",
    "storey": "building models",
    "wall_layers": "drawings",
    "unit_m": "drawings and scans",
    "resolution_m": "scans, drawings, building models and pictures",
}
"""Kinds of files that options are for, other than scans."""

_OF_SCANS = ("height_band_m", "observed", "resolution_m", "up", "unit_m")
_BAG = _Reader("a rosbag", _importer("maps.importers.bags:map_from_bag"))
_MITSUBA = _Reader("a Mitsuba scene", _read_mesh, _OF_SCANS)
_CALIBRATED = _Reader("the map of a calibration", _read_npz)
_EXPORTED = _Reader(
    "an exported map (remove its map.yaml to read the meshes of its scene alone)", bind(read_ros_map, confined=True)
)

_READERS = {
    **dict.fromkeys((".yaml", ".yml"), _Reader("none", read_ros_map, ("strict",))),
    ".npz": _Reader("none", _read_npz),
    **dict.fromkeys(MESH_SUFFIXES, _Reader("a mesh", _read_mesh, _OF_SCANS)),
    **dict.fromkeys(POINT_SUFFIXES, _Reader("a point cloud", _read_cloud, _OF_SCANS)),
    ".ply": _Reader("a mesh or a point cloud", _read_ply, _OF_SCANS),
    **dict.fromkeys(
        DRAWING_SUFFIXES,
        _Reader(
            "a drawing",
            _importer("maps.importers.drawings:map_from_drawing"),
            ("resolution_m", "layer_materials", "wall_layers", "unit_m"),
        ),
    ),
    **dict.fromkeys(
        IFC_SUFFIXES,
        _Reader(
            "a building model",
            _importer("maps.importers.ifc:map_from_ifc"),
            ("resolution_m", "layer_materials", "storey"),
        ),
    ),
    **dict.fromkeys(
        VACUUM_SUFFIXES, _Reader("the map of a vacuum robot", _importer("maps.importers.vacuum:read_vacuum_map"))
    ),
    **dict.fromkeys(
        PICTURE_SUFFIXES, _Reader("a picture", _importer("maps.importers.pictures:read_picture"), ("resolution_m",))
    ),
    **dict.fromkeys(BAG_SUFFIXES, _BAG),
}
"""Readers by suffix."""


def _reader_of(source: Path) -> tuple[Path, _Reader]:
    suffix = source.suffix.lower()
    if suffix not in BAG_SUFFIXES and (source / "metadata.yaml").is_file():
        return source, _BAG
    if suffix == ".xml" or (source.is_dir() and suffix not in BAG_SUFFIXES):
        return _reader_of_scene(source)
    if suffix in COVERAGE_SUFFIXES:
        remedy = "give the map that it was computed from; xarray.open_dataset reads a coverage (.nc)."
        raise MapError(f"path = '{source}' is a coverage, no map: {remedy}")
    if suffix == ".pgm":
        raise bare_image(source)
    if suffix not in _READERS:
        raise MapError(f"path = '{source}' is of no known kind: give {ACCEPTED}.")
    return source, _READERS[suffix]


def _reader_of_scene(source: Path) -> tuple[Path, _Reader]:
    """Return the file of an exported scene, an only Mitsuba scene, or a calibration's map."""
    folder = source if source.is_dir() else source.parent
    scenes = sorted(folder.glob("*.xml")) if source.is_dir() else [source]
    if folder / "scene.xml" in scenes and all((folder / name).is_file() for name in SCENE_FILES):
        return folder / "map.yaml", _EXPORTED
    if source.is_dir() and not scenes and (folder / CALIBRATED_FILE).is_file():
        return folder / CALIBRATED_FILE, _CALIBRATED
    if len(scenes) != 1:
        remedy = f"give the path of one, or {ACCEPTED}."
        raise MapError(f"path = '{source}' is no scene: it has {len(scenes)} .xml files; {remedy}")
    return scenes[0], _MITSUBA
