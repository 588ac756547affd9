"""Contents of a map: walls extruded from its cells (`FloorPlan`), or the triangles of a mesh (`Mesh`).

`PartialMap.environment` alone decides which of the two a map has. Another kind, such as voxels, takes a
class like these, a way to write it in `scene.write_map`, and a way to find its paths in `tracing/finder.py`.
"""

import json
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from sionna_partial.maps.mesh.mesh import SceneMesh, material_records
from sionna_partial.settings import Material

FAR_M = 1000.0
"""Largest coordinate that a scene keeps [m]: float32 has steps of 0.06 mm there. Maps that reach farther are moved."""

EnvironmentKind = Literal["plan", "mesh"]


@dataclass(frozen=True)
class FloorPlan:
    """Walls from floor to ceiling in all wall cells of a map, with the fields that a map has for them.

    `is_extruded` is whether the cells show what a line at any height crosses. `suffixes` are those of the map files
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
        """Return the materials that it may need, `default` where it names none; those of floor and ceiling count."""
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

    def sheet(self, image: str) -> dict[str, object]:
        """Return its keys in a map's YAML, where `image` has the materials of the cells."""
        if self.wall_material is None:
            return {}
        return {"wall_material": {"image": image, "materials": material_records(self.wall_materials)}}

    def arrays(self) -> dict[str, Any]:
        """Return its arrays in a map's `.npz`."""
        if self.wall_material is None:
            return {}
        records = json.dumps(material_records(self.wall_materials))
        return {"wall_material": self.wall_material, "wall_materials": records}


@dataclass(frozen=True)
class Mesh:
    """Observed part of a mesh, with the methods of `FloorPlan`.

    It has fewer paths than a floor plan, and costs rays for all receivers that are not found together.
    """

    mesh: SceneMesh

    kind: ClassVar[EnvironmentKind] = "mesh"
    is_extruded: ClassVar[bool] = False
    suffixes: ClassVar[tuple[str, ...]] = (".npz",)
    receivers_at_once: ClassVar[int] = 50_000

    @property
    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest world z that a radio may have [m]."""
        assert self.mesh.height_range_m is not None  # a mesh has it once it is built
        return self.mesh.height_range_m

    def known_materials(self, default: Material) -> set[Material]:
        """Return the materials of its triangles likewise."""
        return set(self.scene_materials(default).values())

    def scene_materials(self, default: Material) -> dict[str, Material]:
        """Return them by their names in its scene."""
        used = np.unique(self.mesh.material).tolist()
        return {f"material{index}": self.mesh.materials[index] or default for index in used}

    def with_materials(self, materials: dict[str, Material]) -> dict[str, Any]:
        """Return the fields of a map with other materials likewise."""
        named = tuple(materials.get(f"material{index}", old) for index, old in enumerate(self.mesh.materials))
        return {"mesh": replace(self.mesh, materials=named)}

    def with_height(self, height_m: float) -> dict[str, Any]:
        """Return the fields of a map on whose mesh radios may be up to a height above its lowest point [m]."""
        low_m, _ = self.height_range_m
        return {"mesh": replace(self.mesh, height_range_m=(low_m, low_m + height_m))}

    def scene_offset_m(self, bounds_m: tuple[float, float, float, float]) -> list[float]:
        """Return the world position [m] of the origin of a scene in whole metres."""
        (x0, y0, x1, y1), heights_m = bounds_m, self.height_range_m
        return [_whole_offset_m(low, high) for low, high in ((x0, x1), (y0, y1), heights_m)]

    def sheet(self, _image: str) -> dict[str, object]:
        """Return its keys in the YAML of an exported scene, which has the triangles."""
        return {
            "mesh": {"height_range": [*self.height_range_m], "materials": material_records(self.mesh.materials)},
        }

    def arrays(self) -> dict[str, Any]:
        """Return its arrays in a map's `.npz`."""
        return {
            "mesh_vertices_m": self.mesh.vertices_m,
            "mesh_triangles": self.mesh.triangles,
            "mesh_material": self.mesh.material,
            "mesh_materials": json.dumps(material_records(self.mesh.materials)),
            "mesh_height_range_m": self.mesh.height_range_m,
        }


def _whole_offset_m(low_m: float, high_m: float) -> float:
    """Whole number of metres that takes a far axis to the origin, and takes no digit from any number beyond it."""
    if max(abs(low_m), abs(high_m)) <= FAR_M:
        return 0.0
    return float(np.floor(max(low_m, 0.0)) + np.ceil(min(high_m, 0.0)))
