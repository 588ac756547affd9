"""Small IFC models that the tests read."""

from typing import Any

import ifcopenshell
import numpy as np
from ifcopenshell import api


class Building:
    """Rooms of 4 x 5 m on storeys, in millimetres, with walls from corner to corner."""

    def __init__(self, *storeys: float) -> None:
        self.model = ifcopenshell.file(schema="IFC4")
        project = api.run("root.create_entity", self.model, ifc_class="IfcProject", name="P")
        api.run("unit.assign_unit", self.model, length={"is_metric": True, "raw": "MILLIMETERS"})
        whole = api.run("context.add_context", self.model, context_type="Model")
        self.body = api.run(
            "context.add_context",
            self.model,
            context_type="Model",
            context_identifier="Body",
            target_view="MODEL_VIEW",
            parent=whole,
        )
        self.building = self._within(project, "IfcBuilding", "B")
        self.storeys = [self._within(self.building, "IfcBuildingStorey", f"Level {k}") for k in range(len(storeys))]
        for storey, level_m in zip(self.storeys, storeys, strict=True):
            self._place(storey, (0.0, 0.0, level_m))

    def _within(self, parent: Any, kind: str, name: str) -> Any:
        child = api.run("root.create_entity", self.model, ifc_class=kind, name=name)
        api.run("aggregate.assign_object", self.model, products=[child], relating_object=parent)
        return child

    def _place(self, product: Any, at_m: tuple[float, ...], turn_rad: float = 0.0) -> None:
        matrix = np.eye(4)
        matrix[:2, :2] = [[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]]
        matrix[:3, 3] = at_m
        api.run("geometry.edit_object_placement", self.model, product=product, matrix=matrix, is_si=True)

    def part(
        self, kind: str, start: tuple[float, ...], end: tuple[float, ...], level: int = 0, deep: float = 0.2
    ) -> Any:
        """Add a box along a line from z to z of its ends."""
        part = api.run("root.create_entity", self.model, ifc_class=kind)
        length, turn = np.hypot(end[0] - start[0], end[1] - start[1]), np.arctan2(end[1] - start[1], end[0] - start[0])
        shape = api.run(
            "geometry.add_wall_representation",
            self.model,
            context=self.body,
            length=length,
            height=end[2] - start[2],
            thickness=deep,
            offset=-deep / 2,
        )
        api.run("geometry.assign_representation", self.model, product=part, representation=shape)
        self._place(part, start, turn)
        api.run("spatial.assign_container", self.model, products=[part], relating_structure=self.storeys[level])
        return part

    def made_of(self, part: Any, *layers: tuple[str, float]) -> None:
        materials = api.run("material.add_material_set", self.model, name="S", set_type="IfcMaterialLayerSet")
        for name, thickness in layers:
            material = api.run("material.add_material", self.model, name=name)
            layer = api.run("material.add_layer", self.model, layer_set=materials, material=material)
            layer.LayerThickness = thickness
        api.run("material.assign_material", self.model, products=[part], material=materials)

    def of_list(self, part: Any, *names: str) -> None:
        materials = [api.run("material.add_material", self.model, name=name) for name in names]
        whole = materials[0] if len(names) == 1 else self.model.createIfcMaterialList(materials)
        self.model.createIfcRelAssociatesMaterial(ifcopenshell.guid.new(), None, None, None, [part], whole)

    def rooms(self, level_m: float, level: int) -> list[Any]:
        z = level_m, level_m + 2.8
        corners = [(0.0, 0.0), (8.0, 0.0), (8.0, 5.0), (0.0, 5.0)]
        walls = [
            self.part("IfcWall", (*a, z[0]), (*b, z[1]), level)
            for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)
            if a != (8.0, 0.0)
        ]
        walls += [self.part("IfcWallStandardCase", (8.0, 0.0, z[0]), (8.0, 2.0, z[1]), level)]
        walls += [self.part("IfcWall", (8.0, 3.0, z[0]), (8.0, 5.0, z[1]), level)]
        self.part("IfcWindow", (8.0, 2.0, z[0] + 0.9), (8.0, 3.0, z[0] + 2.0), level, 0.06)
        inner = self.part("IfcWall", (4.0, 0.0, z[0]), (4.0, 2.0, z[1]), level, 0.1)
        self.part("IfcWall", (4.0, 3.0, z[0]), (4.0, 5.0, z[1]), level, 0.1)
        self.part("IfcDoor", (4.0, 2.0, z[0]), (4.0, 3.0, z[0] + 2.0), level, 0.05)
        self.part("IfcColumn", (6.0, 2.5, z[0]), (6.8, 2.5, z[1]), level, 0.8)
        self.part("IfcFurniture", (1.0, 3.0, z[0]), (2.0, 3.0, z[0] + 2.0), level, 0.4)
        return [*walls, inner]


def whole_of(building: Building, whole: Any, *parts: Any) -> None:
    building.model.createIfcRelAggregates(ifcopenshell.guid.new(), None, None, None, whole, parts)
