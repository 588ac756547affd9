"""IFC building models -> PartialMap: a storey cut at the height of windows, by the types of its elements."""

import math
from collections import Counter
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import shown
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M, CellState
from sionna_partial.errors import MapError
from sionna_partial.files import decoding, read_bytes
from sionna_partial.maps.environment import ImportNotes
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.maps.import_report import SHOWN_ROWS
from sionna_partial.maps.importers.drawing_lines import Segments
from sionna_partial.maps.importers.drawings import material_given, with_materials
from sionna_partial.maps.importers.ifc_layers import Layer, described, slab
from sionna_partial.maps.mesh.cells import DEFAULT_RESOLUTION_M, fitted_grid, states_of_lines
from sionna_partial.maps.mesh.scene_mesh import MAX_TRIANGLES
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.process import core_count
from sionna_partial.resources import optional_packages
from sionna_partial.settings import Material

MAX_IFC_BYTES = 500_000_000

CUT_M = 1.2001
"""Height of the cut above the storey [m]: above sills and tables, and not a round number."""

LEAST_STOREY_M = 2.0
"""Height from which the next storey is the ceiling [m]; closer levels belong to stairs or foundations."""

BESIDE_M, BESIDE_RATIO = 0.02, 2.0
"""Distance of walls side by side [m], and least length along them over the thickness: others are corners."""

DOOR = "IfcDoor"

TYPES = {
    "IfcWindow": "glass",
    DOOR: "door",
    "IfcPlate": "glass",
    "IfcMember": "metal",
    "IfcCurtainWall": "glass",
    "IfcColumn": "concrete",
    "IfcWall": None,
}
"""Types that are walls, with their subtypes, and the name of their material; None is the default."""

CURTAIN_PARTS = {"IfcPlate": "CURTAIN_PANEL", "IfcMember": "MULLION"}
"""Types that are walls as parts of curtain walls only, and their predefined types there; others are in stairs, roofs
and railings."""

PANES = ("IfcWindow", "IfcCurtainWall")
"""Types whose panes count instead of their frames."""


class _Cut(NamedTuple):
    """Lines of an element's body in a horizontal plane, and the area inside [m]."""

    product: Any
    segments: Segments
    area: shapely.Geometry


class _Wall(NamedTuple):
    """Type of an element in the file and in `TYPES`, its layers, and its area in the plane of the cut [m]."""

    name: str
    kind: str
    is_wall: bool
    layers: list[Layer]
    area: shapely.Geometry

    @property
    def width_m(self) -> float:
        return _width_m(self.area)


class _Piece(NamedTuple):
    """Material of an element (None: default), with lines and area as in `_Cut`."""

    material: Material | None
    segments: Segments
    area: shapely.Geometry


def map_from_ifc(
    path: Path,
    *,
    storey: str | None = None,
    layer_materials: Mapping[str, Material | str] | None = None,
    resolution_m: float = DEFAULT_RESOLUTION_M,
) -> PartialMap:
    """Make a map of a storey of an IFC model; see `load_map`.

    An element without a body has the bodies of its parts.
    """
    with optional_packages(MapError):
        import ifcopenshell
        import ifcopenshell.geom
        from ifcopenshell.util.unit import calculate_unit_scale
    content = read_bytes(path, "path", MapError, MAX_IFC_BYTES, "export the storey alone.")
    if not content.lstrip().startswith(b"ISO-10303-21;") or b"END-ISO-10303-21;" not in content[-1000:]:
        raise MapError(f"path = '{path}' is damaged or no IFC (it is no whole STEP file): export it again as .ifc.")
    with decoding(path, "no IFC", MapError):
        model = ifcopenshell.file.from_string(content.decode("utf-8", "replace"))
        notes = ImportNotes(path, float(calculate_unit_scale(model)), "units of the IfcProject")
        floor_m, height_m = _storey(path, model, storey, notes)
        pieces = _pieces(model, floor_m + CUT_M, _given(path, model, layer_materials or {}), notes)
    if not pieces:
        raise MapError(f"path = '{path}' has no walls {CUT_M:.1f} m above the storey: give another storey.")
    partial = _map_of(path, pieces, resolution_m, height_m)
    remedy = "look at the elements that were skipped in the import_report, and at the storey."
    return notes.attached_to(partial, size="correct the units of the model.", area=remedy)


def _map_of(path: Path, pieces: list[_Piece], resolution_m: float, height_m: float) -> PartialMap:
    segments = np.concatenate([piece.segments for piece in pieces])
    empty = fitted_grid(np.stack([segments.min(axis=(0, 1)), segments.max(axis=(0, 1))]), resolution_m)
    state = states_of_lines(segments, empty, _covered([piece.area for piece in pieces], empty))
    if not (state == CellState.FREE).any():
        raise MapError(f"path = '{path}' has walls that enclose nothing on this storey: give another storey.")
    partial = PartialMap(state, empty.resolution_m, empty.origin_m, height_m)
    materials = list(dict.fromkeys(piece.material for piece in pieces))
    numbers = [str(materials.index(piece.material)) for piece in pieces]
    owner = np.repeat(numbers, [len(piece.segments) for piece in pieces])
    named = {material: {str(number)} for number, material in enumerate(materials) if material is not None}
    return with_materials(partial, segments, owner, named) if named else partial


def _storey(path: Path, model: Any, name: str | None, notes: ImportNotes) -> tuple[float, float]:
    """Return world z of the given storey, or the only one with walls, and its height [m]."""
    from ifcopenshell.util.element import get_container
    from ifcopenshell.util.placement import get_local_placement

    unit_m = notes.unit_m
    every = model.by_type("IfcBuildingStorey")
    level_m = {storey: float(get_local_placement(storey.ObjectPlacement)[2, 3]) * unit_m for storey in every}
    walls = [wall for kind in ("IfcWall", "IfcCurtainWall") for wall in model.by_type(kind)]
    if not walls or not every:
        raise MapError(f"path = '{path}' has {len(walls)} walls on {len(every)} storeys: export a building with both.")
    used = {get_container(wall, ifc_class="IfcBuildingStorey") for wall in walls}
    chosen = [storey for storey in every if storey in used or not used & {*every}]
    if name is not None:
        chosen = [storey for storey in every if (storey.Name or "").casefold() == str(name).casefold()]
    if len(chosen) != 1:
        by_level = sorted(every, key=level_m.__getitem__)
        named = ", ".join(f"'{storey.Name}' at {level_m[storey]:z.2f} m" for storey in by_level)
        what = f"storey = {shown(name)} is one of {len(chosen)} of path = '{path}'"
        raise MapError(f"{what}: give the name of one as storey; it has {named[:1000]}.")
    floor_m = level_m[chosen[0]]
    notes.notes.append(f"storey '{chosen[0].Name}' at {floor_m:g} m, cut {CUT_M:.1f} m above it")
    above = [level - floor_m for level in level_m.values() if level - floor_m >= LEAST_STOREY_M]
    return floor_m, min(above, default=DEFAULT_WALL_HEIGHT_M)


def _given(path: Path, model: Any, given: Mapping[str, Material | str]) -> dict[str, Material]:
    found = dict[str, Material]()
    for name, value in given.items():
        present = [kind for kind in TYPES if model.by_type(kind) and fnmatch(kind.lower(), str(name).lower())]
        if not present:
            kinds = ", ".join(kind for kind in TYPES if model.by_type(kind))
            raise MapError(f"layer_materials[{shown(name)}] names no walls of path = '{path}': it has {kinds}.")
        found |= dict.fromkeys(present, material_given(name, value))
    return found


def _pieces(model: Any, height_m: float, given: dict[str, Material], notes: ImportNotes) -> list[_Piece]:
    kinds = [kind for kind in TYPES if kind != DOOR or kind in given]
    owner_of = _bodies(model, kinds)
    cuts = _cuts(model, height_m, [model.by_id(body) for body in owner_of], notes)
    of_owner: dict[tuple[int, int], list[_Cut]] = {}
    for body, (number, owner) in owner_of.items():
        of_owner.setdefault((-number, owner.id()), []).extend([cuts[body]] if body in cuts else [])
    found, lines_m = list[_Wall](), list[Segments]()
    for (number, owner_id), bodies in sorted(of_owner.items()):
        owner, kind = model.by_id(owner_id), kinds[-number]
        if not any(len(body.segments) for body in bodies):
            reason = f"nothing {CUT_M:.1f} m above the storey" if bodies else "no body of its own"
            notes.skip(owner.is_a(), 1, reason)
            continue
        own = [body for body in bodies if body.product.id() == owner_id and len(body.segments)]
        bodies = own or [body for body in bodies if len(body.segments)]
        for name in [owner.is_a(), *(body.product.is_a() for body in bodies if not own)]:
            notes.use(name)
        area, segments = shapely.union_all([body.area for body in bodies]), [body.segments for body in bodies]
        is_wall = owner.is_a("IfcWall")
        found.append(_Wall(owner.is_a(), kind, is_wall, _layers_of(owner, bodies, notes.unit_m), area))
        lines_m.append(np.concatenate(segments))
    for element in model.by_type("IfcElement"):
        if element.id() not in owner_of and element.Representation and not element.is_a("IfcFeatureElement"):
            is_door = element.is_a(DOOR)
            notes.skip(element.is_a(), 1, "open; layer_materials for IfcDoor closes it" if is_door else "no wall")
    return _with_slabs(found, lines_m, given, notes)


def _with_slabs(
    found: list[_Wall], lines_m: list[Segments], given: dict[str, Material], notes: ImportNotes
) -> list[_Piece]:
    pieces, sets = [], Counter[str]()
    for wall, beside, segments_m in zip(found, _beside(found), lines_m, strict=True):
        layers = wall.layers + beside
        width_m = _width_m(wall.area) if wall.is_wall else None
        material = given.get(wall.kind) or slab(layers, TYPES[wall.kind], width_m)
        sets[described(wall.name, layers, material)] += 1
        pieces.append(_Piece(material, segments_m, wall.area))
    lines = [f"{count} x {text}" for text, count in sets.most_common()]
    more = [f"and {len(lines) - SHOWN_ROWS} more sets of layers"] if len(lines) > SHOWN_ROWS else []
    notes.notes += [*lines[:SHOWN_ROWS], *more]
    return pieces


def _beside(walls: list[_Wall]) -> list[list[Layer]]:
    """Return the layers of the wall at the side of each wall: finishes and insulation may be walls of their own."""
    solid = [index for index, wall in enumerate(walls) if wall.is_wall and not wall.area.is_empty]
    around = [shapely.buffer(walls[index].area, BESIDE_M, cap_style="flat", join_style="mitre") for index in solid]
    found: list[list[Layer]] = [[] for _ in walls]
    if not solid:
        return found
    overlaps: dict[int, list[tuple[float, int]]] = {}
    for one, other in shapely.STRtree(around).query(around, predicate="intersects").T.tolist():
        if one != other:
            length_m = shapely.intersection(around[one], around[other]).area / (2 * BESIDE_M)
            overlaps.setdefault(one, []).append((length_m, solid[other]))
    for one, lengths_m in overlaps.items():
        wall, (length_m, other) = walls[solid[one]], max(lengths_m)
        if sum(length for length, _ in lengths_m) > _length_m(wall.area) / 2 and length_m > BESIDE_RATIO * wall.width_m:
            found[solid[one]] = walls[other].layers or [Layer("unnamed", round(walls[other].width_m, 3))]
    return found


def _bodies(model: Any, kinds: list[str]) -> dict[int, tuple[int, Any]]:
    """Return type number and wall of each element that may have a body: walls and their parts."""
    owner_of = {
        element.id(): (number, element)
        for number, kind in enumerate(kinds)
        for element in model.by_type(kind)
        if kind not in CURTAIN_PARTS or _is_of_curtain_wall(element)
    }
    waiting = [(element, *owner) for owner in owner_of.values() for element in owner[1:]]
    while waiting:
        element, number, owner = waiting.pop()
        for relation in getattr(element, "IsDecomposedBy", None) or ():
            for part in relation.RelatedObjects:
                if part.id() not in owner_of and part.is_a("IfcElement") and not part.is_a(DOOR):
                    owner_of[part.id()] = number, owner
                    waiting.append((part, number, owner))
    return owner_of


def _is_of_curtain_wall(element: Any) -> bool:
    if getattr(element, "PredefinedType", None) in CURTAIN_PARTS.values():
        return True
    wholes = [relation.RelatingObject for relation in getattr(element, "Decomposes", None) or ()]
    return any(whole.is_a("IfcCurtainWall") or _is_of_curtain_wall(whole) for whole in wholes)


def _cuts(model: Any, height_m: float, products: list[Any], notes: ImportNotes) -> dict[int, _Cut]:
    import ifcopenshell.geom

    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    products = [product for product in products if product.Representation]
    cuts, triangles = dict[int, _Cut](), 0
    shapes: Any = ifcopenshell.geom.iterator(settings, model, core_count(), include=products) if products else ()
    for shape in shapes:
        mesh = shape.geometry
        corners_m = np.reshape(mesh.verts, (-1, 3))[np.reshape(mesh.faces, (-1, 3)).astype(np.intp)]
        triangles += len(corners_m)
        if triangles > MAX_TRIANGLES:
            raise MapError(f"path = '{notes.file}' has more than {MAX_TRIANGLES:,} triangles: export the storey alone.")
        segments = _cut(corners_m, height_m)
        area = shapely.build_area(shapely.multilinestrings(segments))
        cuts[shape.id] = _Cut(model.by_id(shape.id), segments, area)
    return cuts


def _cut(corners_m: Floats, height_m: float) -> Segments:
    above = corners_m[..., 2] > height_m
    crossed = np.flatnonzero(above.any(axis=1) & ~above.all(axis=1))
    corners_m, above = corners_m[crossed], above[crossed]
    alone = np.argmax(above == (above.sum(axis=1) == 1)[:, None], axis=1)  # the corner that the two others are not with
    rows, ends = np.arange(len(crossed)), []
    for step in (1, 2):
        pair = np.stack([corners_m[rows, alone], corners_m[rows, (alone + step) % 3]], axis=1)
        pair = np.take_along_axis(pair, np.argsort(pair[..., 2], axis=1)[..., None], axis=1)  # low, high
        part = (height_m - pair[:, 0, 2]) / (pair[:, 1, 2] - pair[:, 0, 2])
        ends.append(pair[:, 0, :2] + part[:, None] * (pair[:, 1, :2] - pair[:, 0, :2]))
    segments = np.stack(ends, axis=1).round(6)
    return np.asarray(segments[(segments[:, 0] != segments[:, 1]).any(axis=1)])


def _covered(areas: list[shapely.Geometry], empty: PartialMap) -> Bools:
    cells, (ny, nx) = np.zeros(empty.shape, dtype=bool), empty.shape
    for area in areas:
        if area.is_empty:
            continue
        (bottom, top), (left, right) = (np.sort(index) for index in empty.cell_index(np.reshape(area.bounds, (2, 2))))
        row, column = np.mgrid[max(bottom, 0) : min(top + 1, ny), max(left, 0) : min(right + 1, nx)]
        centres = cell_centres_m(empty, np.stack([row, column], axis=-1))
        shapely.prepare(area)
        cells[row, column] |= shapely.contains_xy(area, centres[..., 0], centres[..., 1])
    return cells


def _layers_of(owner: Any, bodies: list[_Cut], unit_m: float) -> list[Layer]:
    """Return the layers of a wall, or of its parts, which are as thick as their area over the length of the wall.

    Members of walls are their studs.
    """
    from ifcopenshell.util.element import get_material

    found = get_material(owner, should_skip_usage=True)
    if found is not None:
        layers = _layers(found, unit_m)
        is_pane = any(owner.is_a(kind) for kind in PANES)
        return [layer for layer in layers if "glass" in (layer.name or "")] if is_pane else layers
    layers, length_m = list[Layer](), _length_m(shapely.union_all([body.area for body in bodies]))
    for body in bodies:
        source = get_material(body.product, should_skip_usage=True)
        of_part = [] if source is None else _layers(source, unit_m)
        if owner.is_a("IfcWall") and body.product.is_a("IfcMember"):
            of_part = [Layer("stud", 0.0)]
        if len(of_part) == 1 and not of_part[0].thickness_m and owner.is_a("IfcWall") and length_m > 0:
            of_part = [of_part[0]._replace(thickness_m=body.area.area / length_m)]
        layers += of_part
    total_m = dict[str, float]()
    for layer in layers:
        total_m[layer.text] = total_m.get(layer.text, 0.0) + layer.thickness_m
    return [Layer(text, round(thickness_m, 3)) for text, thickness_m in total_m.items()]


def _length_m(area: shapely.Geometry) -> float:
    """Return the length of a wall, bent or straight, from the area of its parts [m]."""
    width_m = _width_m(area)
    strip_m = area.area / width_m / max(1, len(shapely.get_parts(area))) if width_m > 0 else 0.0
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area))
    return max(strip_m, *np.linalg.norm(np.diff(corners, axis=0), axis=1).tolist(), 0.0)


def _width_m(area: shapely.Geometry) -> float:
    """Return the width of strips from area and perimeter [m]."""
    count, perimeter_m = max(1, len(shapely.get_parts(area))), area.length
    return float(perimeter_m - math.sqrt(max(0.0, perimeter_m**2 - 16 * count * area.area))) / (4 * count)


def _layers(found: Any, unit_m: float) -> list[Layer]:
    if found.is_a("IfcMaterial"):
        return [Layer(found.Name or "", 0.0)]
    of_kind = {
        "IfcMaterialLayerSet": "MaterialLayers",
        "IfcMaterialConstituentSet": "MaterialConstituents",
        "IfcMaterialProfileSet": "MaterialProfiles",
        "IfcMaterialList": "Materials",
    }
    layers = []
    for part in getattr(found, of_kind.get(found.is_a(), ""), None) or ():
        material = getattr(part, "Material", part)
        role = getattr(part, "Name", None) if part.is_a("IfcMaterialConstituent") else None
        names = [name for name in (material.Name if material is not None else None, role) if name]
        layers.append(Layer(" ".join(names), round(float(getattr(part, "LayerThickness", None) or 0.0) * unit_m, 4)))
    return layers
