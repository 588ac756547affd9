"""Meshes as Mitsuba scenes, for tests that shoot rays at them."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sionna_partial.tracing.engine import open_scene
from sionna_partial.tracing.mesh.faces import face_tree, group_planes
from sionna_partial.tracing.power import materials_of
from sionna_partial.tracing.walls import Cells, SolidMesh, closed_bodies

MATERIAL = (
    '<bsdf type="radio-material" id="material"><float name="relative_permittivity" value="3.0"/>'
    '<float name="conductivity" value="0.1"/><float name="thickness" value="0.1"/></bsdf>'
)

TURN = trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)
"""A rotation that leaves no wall of a box upright."""


def load_meshes(folder: Path, *meshes: trimesh.Trimesh) -> Any:
    """Write meshes as the shapes of a scene, and load it into Sionna RT."""
    shapes = ""
    for number, mesh in enumerate(meshes):
        mesh.export(folder / f"{number}.ply")
        shapes += (
            f'<shape type="ply" id="mesh{number}"><string name="filename" value="{number}.ply"/>'
            '<boolean name="face_normals" value="true"/><ref name="bsdf" id="material"/></shape>'
        )
    xml = folder / "scene.xml"
    xml.write_text(f'<scene version="2.1.0">{MATERIAL}{shapes}</scene>')
    return open_scene(xml, 28e9)


def shapes_of(scene: Any, count: int) -> list[Any]:
    """Mitsuba shapes in the order in which `load_meshes` was given the meshes."""
    return [scene.objects[f"mesh{number}"].mi_mesh for number in range(count)]


def joined(*meshes: trimesh.Trimesh) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and triangles of all meshes, counted one mesh after the other."""
    whole = trimesh.util.concatenate(list(meshes))
    return np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int64)


def opaque(*meshes: trimesh.Trimesh) -> SolidMesh:
    """The faces of all meshes, which let nothing through, of drywall at 28 GHz."""
    vertices, triangles = joined(*meshes)
    planes, none, material = group_planes(vertices, triangles), triangles[:0], np.zeros(len(triangles), np.int64)
    cells = Cells(np.zeros((1, 1), bool), 1.0, 0.0)
    faces = face_tree(vertices[none], planes.plane), planes, closed_bodies(vertices, none)
    return SolidMesh(*faces, cells, materials_of([(2.94, 0.1226, 0.1)], 28e9), material)
