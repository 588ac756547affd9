"""Scanned and modelled meshes, read through trimesh."""

import json
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sionna_partial.errors import MapError
from sionna_partial.maps.mesh.mesh import MAX_TRIANGLES, SceneMesh, merged_mesh
from sionna_partial.maps.ros_map import MapWarning

MESH_SUFFIXES = (".ply", ".glb", ".gltf", ".obj", ".stl")
"""File formats of meshes."""

MAX_MESH_BYTES = 2_000_000_000
"""Largest mesh file that is read [bytes]: more should be cut or simplified first."""

LOWEST_CEILING_M = 2.2
"""Height of the lowest rooms [m]: what is lower along y does not stand on its side."""


class _Neighbours(trimesh.resolvers.FilePathResolver):  # type: ignore[misc]
    """Gives the buffers of a .gltf that lie in its folder, and nothing else."""

    def get(self, name: str) -> bytes:
        """Return the content of a file."""
        return confined_path(Path(self.parent), name, f"'{self.file_path}' asks for the file").read_bytes()


def read_mesh(path: Path, up: str | None = None) -> SceneMesh:
    """Read a mesh file. Its looks (colours, textures) are ignored.

    Parameters
    ----------
    path : pathlib.Path
        A PLY, GLB, GLTF, OBJ or STL file in metres. The nodes of a scene are placed by their transforms.
    up : {"z", "y"} or None
        Axis of the file that points up. None is z, with a warning if that looks wrong.

    Returns
    -------
    SceneMesh
        With z up, and one material, None.

    Raises
    ------
    MapError
        If the file is damaged, empty, too large, or asks for files outside its folder.
    """
    vertices, triangles = read_triangles(path, path.suffix.lower().removeprefix("."))
    if up is None and _looks_y_up(vertices, triangles):
        message = f'path = \'{path}\' looks as if y pointed up: give up="y" to turn it, or up="z" to read it as it is.'
        warnings.warn(message, MapWarning, stacklevel=4)
    if up == "y":
        vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    return checked_mesh(path, vertices, triangles, np.zeros(len(triangles), dtype=np.intp), (None,))


def read_triangles(path: Path, kind: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read the triangles of a mesh file as they are.

    Parameters
    ----------
    path : pathlib.Path
    kind : {"ply", "glb", "gltf", "obj", "stl"}

    Returns
    -------
    vertices_m : (V, 3) float64 array
        In the axes of the file [m].
    triangles : (F, 3) int64 array
        Indices into `vertices_m`, in range.

    Raises
    ------
    MapError
        As `read_mesh` does.
    """
    try:
        size = path.stat().st_size
        if size > MAX_MESH_BYTES:
            raise MapError(f"path = '{path}' has more than {MAX_MESH_BYTES:,} bytes: cut or simplify the mesh.")
        if kind == "gltf":
            json.loads(path.read_bytes())  # trimesh would look for another file
        with path.open("rb") as stream, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a damaged file the error tells
            scene = trimesh.load_scene(
                stream, file_type=kind, resolver=_Neighbours(os.fspath(path)), process=False, skip_materials=True
            )
            parts = [*_placed_parts(path, scene)]
    except MapError:
        raise
    except Exception as error:  # decoders fail in many ways on damaged files
        raise MapError(
            f"path = '{path}' is damaged or no {kind.upper()} mesh ({error}): export the mesh again."
        ) from error
    if not any(len(triangles) for _, triangles in parts):
        raise MapError(f"path = '{path}' holds 0 triangles: give a mesh with surfaces, not points or lines alone.")
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    triangles = np.concatenate([triangles + start for (_, triangles), start in zip(parts, starts, strict=False)])
    if len(triangles) > MAX_TRIANGLES:
        raise MapError(
            f"path = '{path}' holds {len(triangles):,} triangles, more than {MAX_TRIANGLES:,}: cut or simplify it."
        )
    return np.concatenate([vertices for vertices, _ in parts]), triangles


def checked_mesh(
    path: Path,
    vertices_m: NDArray[np.float64],
    triangles: NDArray[np.int64],
    material: NDArray[np.intp],
    materials: tuple[Any, ...],
) -> SceneMesh:
    """Build a mesh of a file, its vertices merged, or raise a MapError that names the file.

    Parameters
    ----------
    path : pathlib.Path
        The file, for messages.
    vertices_m, triangles, material, materials
        As in SceneMesh.

    Returns
    -------
    SceneMesh
        With at least one triangle.
    """
    try:
        mesh = merged_mesh(vertices_m, triangles, material, materials)
    except MapError as error:
        raise MapError(f"path = '{path}': {error}") from error
    if not len(mesh.triangles):
        raise MapError(f"path = '{path}' holds degenerate triangles alone: give a mesh with surfaces, in metres.")
    return mesh


def confined_path(folder: Path, name: str, what: str) -> Path:
    """Return the path of a file that another file names, or raise a MapError unless it lies in the folder.

    Parameters
    ----------
    folder : pathlib.Path
    name : str
        What the other file says.
    what : str
        Subject of the message.

    Returns
    -------
    pathlib.Path
    """
    inside = bool(name) and "\0" not in name and not Path(name).is_absolute() and ".." not in Path(name).parts
    if not inside or not (folder / name).resolve().is_relative_to(folder.resolve()):
        raise MapError(f"{what} {name!r}, which is not allowed: put it into '{folder}' and give its relative path.")
    if not (folder / name).is_file():
        raise MapError(f"{what} {name!r}, which is not there: put it into '{folder}', or correct the name.")
    return folder / name


def _placed_parts(path: Path, scene: Any) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Vertices and triangles of every node of a trimesh scene, in the axes of the scene."""
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name]
        if not isinstance(part, trimesh.Trimesh):
            continue
        vertices, triangles = np.asarray(part.vertices, dtype=np.float64), np.asarray(part.faces, dtype=np.int64)
        wrong = (triangles < 0) | (triangles >= len(vertices))
        if wrong.any():
            raise MapError(
                f"path = '{path}' has a triangle with vertex {triangles[wrong][0]}, but {len(vertices)} vertices: "
                "export the mesh again."
            )
        yield vertices @ transform[:3, :3].T + transform[:3, 3], triangles


def _looks_y_up(vertices_m: NDArray[np.float64], triangles: NDArray[np.int64]) -> bool:
    """Whether the mesh is lowest along y, yet as high as a room, and more of it faces along y than z, as floors do."""
    corners = vertices_m[triangles]
    if not np.isfinite(corners).all():
        return False
    extent = corners.max(axis=(0, 1)) - corners.min(axis=(0, 1))
    area = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    facing = np.bincount(np.argmax(area, axis=1), weights=np.linalg.norm(area, axis=1), minlength=3)
    return bool(LOWEST_CEILING_M <= extent[1] < min(extent[0], extent[2]) and facing[1] > facing[2])
