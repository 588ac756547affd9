"""IFC building models -> PartialMap: a storey cut at the height of windows, by the types of what is cut."""

import re
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
from sionna_partial.maps.drawings import Segments, material_given, states_of_lines, with_materials
from sionna_partial.maps.mesh.cells import DEFAULT_RESOLUTION_M, fitted_grid
from sionna_partial.maps.mesh.mesh import MAX_TRIANGLES
from sionna_partial.maps.partial_map import PartialMap, cell_centres_m
from sionna_partial.process import core_count
from sionna_partial.settings import Material

MAX_IFC_BYTES = 500_000_000
"""Largest model that is read [bytes]."""

CUT_M = 1.2001
"""Height above the storey at which walls are cut [m]: that of plans, above sills and tables, and on no round number."""

LEAST_STOREY_M = 2.0
"""Height from which on the next storey is the ceiling of one [m]: levels nearer by are of stairs or foundations."""

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
"""Types that are walls, with all of their subtypes, and the name of their material; None is the default one."""

NAMES = {
    "coated glass": r"coated glass|low.?e\b",
    "glass": r"glas|glaz|vitr",
    "reinforced concrete": r"reinforced|stahlbeton",
    "concrete": r"concrete|beton|\bcmu\b",
    "brick": r"brick|masonry|ziegel|mauerwerk|klinker|brique",
    "drywall": r"drywall|dry wall|gypsum|plasterboard|gips",
    "wood": r"wood|timber|lumber|holz|\bbois",
    "metal": r"metal|steel|stahl|alumini|iron",
}
"""What names of materials contain, by our names for them; the first that fits counts."""


class _Piece(NamedTuple):
    """What is cut of a part of a building: its material, None for the default, the lines, and what they enclose [m]."""

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

    Walls, columns, windows and the parts of curtain walls are cut 1.2 m above the storey. What they enclose is free,
    as on a drawing. Doors are open, unless `layer_materials` has a material for "IfcDoor".
    """
    try:
        import ifcopenshell
        import ifcopenshell.geom
    except ImportError as error:
        raise MapError(f"path = '{path}' needs ifcopenshell: pip install '.[ifc]' in the repository.") from error
    content = read_bytes(path, "path", MapError, MAX_IFC_BYTES, "export the storey alone.")
    if not content.lstrip().startswith(b"ISO-10303-21;") or b"END-ISO-10303-21;" not in content[-1000:]:
        raise MapError(f"path = '{path}' is damaged or no IFC (it is no whole STEP file): export it again as .ifc.")
    with decoding(path, "no IFC", MapError):
        model = ifcopenshell.file.from_string(content.decode("utf-8", "replace"))
        floor_m, height_m = _storey(path, model, storey)
        pieces = _pieces(path, model, floor_m + CUT_M, _given(path, model, layer_materials or {}))
    if not pieces:
        raise MapError(f"path = '{path}' has no walls {CUT_M:.1f} m above the storey: give another storey.")
    return _map_of(path, pieces, resolution_m, height_m)


def _map_of(path: Path, pieces: list[_Piece], resolution_m: float, height_m: float) -> PartialMap:
    """Lay what was cut on cells."""
    segments = np.concatenate([each.segments for each in pieces])
    empty = fitted_grid(np.stack([segments.min(axis=(0, 1)), segments.max(axis=(0, 1))]), resolution_m)
    state = states_of_lines(segments, empty, _covered([each.area for each in pieces], empty))
    if not (state == CellState.FREE).any():
        raise MapError(f"path = '{path}' has walls that enclose nothing on this storey: give another storey.")
    partial = PartialMap(state, empty.resolution_m, empty.origin_m, height_m)
    materials = list(dict.fromkeys(each.material for each in pieces))
    owner = np.repeat([str(materials.index(each.material)) for each in pieces], [len(each.segments) for each in pieces])
    named = {each: {str(number)} for number, each in enumerate(materials) if each is not None}
    return with_materials(partial, segments, owner, named) if named else partial


def _storey(path: Path, model: Any, name: str | None) -> tuple[float, float]:
    """World z of the storey that is asked for, or the only one with walls, and the height of its ceiling above [m]."""
    from ifcopenshell.util.element import get_container
    from ifcopenshell.util.placement import get_local_placement
    from ifcopenshell.util.unit import calculate_unit_scale

    unit_m = calculate_unit_scale(model)
    every = model.by_type("IfcBuildingStorey")
    level_m = {each: float(get_local_placement(each.ObjectPlacement)[2, 3]) * unit_m for each in every}
    walls = model.by_type("IfcWall")
    if not walls or not every:
        raise MapError(f"path = '{path}' has {len(walls)} walls on {len(every)} storeys: export a building with both.")
    used = {get_container(wall, ifc_class="IfcBuildingStorey") for wall in walls}
    chosen = [each for each in every if each in used or not used & {*every}]
    if name is not None:
        chosen = [each for each in every if (each.Name or "").casefold() == str(name).casefold()]
    if len(chosen) != 1:
        named = ", ".join(f"'{each.Name}' at {level_m[each]:.2f} m" for each in sorted(every, key=level_m.__getitem__))
        what = f"storey = {shown(name)} is one of {len(chosen)} of path = '{path}'"
        raise MapError(f"{what}: give the name of one as storey; it has {named[:1000]}.")
    floor_m = level_m[chosen[0]]
    above = [level - floor_m for level in level_m.values() if level - floor_m >= LEAST_STOREY_M]
    return floor_m, min(above, default=DEFAULT_WALL_HEIGHT_M)


def _given(path: Path, model: Any, given: Mapping[str, Material | str]) -> dict[str, Material]:
    """Return the materials that are given for patterns of types."""
    found = dict[str, Material]()
    for name, value in given.items():
        present = [kind for kind in TYPES if model.by_type(kind) and fnmatch(kind.lower(), str(name).lower())]
        if not present:
            kinds = ", ".join(kind for kind in TYPES if model.by_type(kind))
            raise MapError(f"layer_materials[{shown(name)}] names no walls of path = '{path}': it has {kinds}.")
        found |= dict.fromkeys(present, material_given(name, value))
    return found


def _pieces(path: Path, model: Any, height_m: float, given: dict[str, Material]) -> list[_Piece]:
    """Cut what is a wall at a height [m]; windows and doors come after the walls that they are in."""
    import ifcopenshell.geom

    kinds = [kind for kind in TYPES if kind != DOOR or kind in given]
    products = [each for kind in kinds for each in model.by_type(kind) if each.Representation]
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    pieces, triangles = dict[tuple[int, int], _Piece](), 0
    shapes: Any = ifcopenshell.geom.iterator(settings, model, core_count(), include=products) if products else ()
    for shape in shapes:
        mesh, product = shape.geometry, model.by_id(shape.id)
        corners_m = np.reshape(mesh.verts, (-1, 3))[np.reshape(mesh.faces, (-1, 3)).astype(np.intp)]
        triangles += len(corners_m)
        if triangles > MAX_TRIANGLES:
            raise MapError(f"path = '{path}' has more than {MAX_TRIANGLES:,} triangles: export the storey alone.")
        segments = _cut(corners_m, height_m)
        if len(segments):
            number, kind = next((number, kind) for number, kind in enumerate(kinds) if product.is_a(kind))
            material = given.get(kind) or _material(product, TYPES[kind])
            area = shapely.build_area(shapely.multilinestrings(segments))
            pieces[-number, shape.id] = _Piece(material, segments, area)
    return [pieces[key] for key in sorted(pieces)]


def _cut(corners_m: Floats, height_m: float) -> Segments:
    """Cut triangles (F, 3, 3) [m] by a horizontal plane: segments (N, 2, 2) [m] whose ends meet to the last digit."""
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
    """Cells (ny, nx) whose centres are within one of the areas [m]."""
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


def _material(product: Any, usual: str | None) -> Material | None:
    """Return the material of a part: that of its type if it is named, else of its thickest layer with a known name."""
    from ifcopenshell.util.element import get_material

    found = get_material(product, should_skip_usage=True)
    layers = _layers(found) if found is not None else []
    names = [(thickness, name) for thickness, text in layers if (name := _known(text))]
    if usual is not None and (not names or usual in {name for _, name in names}):
        return Material.named(usual)
    return Material.named(max(names, key=lambda layer: layer[0])[1]) if names else None


def _layers(found: Any) -> list[tuple[float, str]]:
    """Thickness (0 where there is none) and name of each material of a set."""
    if found.is_a("IfcMaterial"):
        return [(0.0, found.Name or "")]
    of_kind = {
        "IfcMaterialLayerSet": "MaterialLayers",
        "IfcMaterialConstituentSet": "MaterialConstituents",
        "IfcMaterialProfileSet": "MaterialProfiles",
        "IfcMaterialList": "Materials",
    }
    parts = getattr(found, of_kind.get(found.is_a(), ""), None) or ()
    materials = ((float(getattr(each, "LayerThickness", 0.0)), getattr(each, "Material", each)) for each in parts)
    return [(thickness, material.Name or "") for thickness, material in materials if material is not None]


def _known(text: str) -> str | None:
    """Return our name of a material that a text names."""
    return next((name for name, pattern in NAMES.items() if re.search(pattern, text, re.IGNORECASE)), None)
