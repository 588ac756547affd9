"""Meshes that several tests use."""

from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.files import temporary_folder
from sionna_partial.maps.mesh.scene_mesh import SceneMesh, merged_mesh

OBSERVED = [(0.0, 0.0), (5.0, 0.0), (5.0, 4.0), (0.0, 4.0)]
"""Floor of the room."""


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    solid = trimesh.creation.box(np.subtract(high, low))
    solid.apply_translation(np.add(low, high) / 2)
    return solid


def room() -> trimesh.Scene:
    """A room of 5 x 4 x 3 m, and in it a wall of 10 cm that leaves a door."""
    return trimesh.Scene([box((0, 0, 0), (5, 4, 3)), box((2.95, 0, 0), (3.05, 3, 3))])


def scene_mesh(*solids: trimesh.Trimesh) -> SceneMesh:
    whole = trimesh.util.concatenate(solids)
    return merged_mesh(np.array(whole.vertices), whole.faces, np.zeros(len(whole.faces), np.intp), (None,))


def meshed(plan: sp.PartialMap, *named: sp.Material) -> sp.PartialMap:
    """Return a plan with the mesh of its scene, whose faces have a name if they are of the given materials."""
    with temporary_folder() as folder:
        sp.export_scene(plan, folder / "scene")
        (folder / "scene" / "map.yaml").unlink()
        mesh = sp.load_map(folder / "scene" / "scene.xml").mesh
    assert mesh is not None
    mesh = replace(mesh, materials=tuple(each if each in named else None for each in mesh.materials))
    return replace(plan, wall_material=None, wall_materials=(), mesh=mesh)


def surface_m2(mesh: SceneMesh) -> float:
    return float(areas_m2(mesh).sum())


def areas_m2(mesh: SceneMesh) -> NDArray[np.float64]:
    a, b, c = mesh.corners_m.transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def open_edges(mesh: SceneMesh) -> NDArray[np.float64]:
    """Ends (E, 2, 3) of the edges that one triangle has alone."""
    edges = np.sort(mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    return mesh.vertices_m[edges[count == 1]]
