"""DXF floor plans -> PartialMap: lines of the wall layers on cells, and what they enclose."""

import io
import math
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.checks import number_of, shown
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M, DRAWING_SUFFIXES, CellState
from sionna_partial.errors import MapError
from sionna_partial.files import decoding, input_path, read_bytes
from sionna_partial.maps.mesh.cells import DEFAULT_RESOLUTION_M, fitted_grid, mark_cells
from sionna_partial.maps.mesh.cut import BORDER_M
from sionna_partial.maps.partial_map import MapWarning, PartialMap
from sionna_partial.settings import Material

MAX_DRAWING_BYTES = 100_000_000
"""Largest drawing that is read [bytes]."""

MAX_PIECES, MAX_PARTS, MAX_NESTING = 1_000_000, 200_000, 16
"""Most pieces of lines, most blocks and entities in them, and most blocks within blocks."""

WALL_NAMES = re.compile(
    r"wall|wand|wänd|mauer|mur(?!al)|pared|parete|vägg|vegg|muur|sciana|ściana|стен|colum|pillar|s-cols|stütze|partition|"
    r"window|glaz|fenster|fenetre|fenêtre|ventana|finestra",
    re.IGNORECASE,
)
"""What names of layers with walls, columns and windows contain, in some languages of Europe."""

NO_WALL_NAMES = re.compile(r"head|text|dim|anno|iden|note|furn|möbel|mobel", re.IGNORECASE)
"""What names of layers contain that describe walls, or close doors (headers, in the names of the AIA)."""

UNITS_M = {1.0: "metres", 0.01: "centimetres", 0.001: "millimetres"}
"""Units in which plans without a unit are drawn [m]."""

PLAUSIBLE_M, POSSIBLE_M = (4.0, 60.0), (1.0, 2000.0)
"""Longer side of a building, where its unit is guessed, and of any one [m]."""

OPENING_M, SOLID_M = 2.0, 0.5
"""Widest opening of outer walls that leaves rooms indoors; width of the widest wall drawn by both of its faces [m]."""

FLAT_FRACTION = 0.001
"""Distance of a polygon from its curve, in extents of the curve."""

_LINES = {"LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE", "HATCH", "SOLID"}

Segments = Floats
"""Ends (N, 2, 2) of pieces of lines."""


def map_from_drawing(
    path: str | os.PathLike[str],
    *,
    wall_layers: Sequence[str] | None = None,
    layer_materials: Mapping[str, Material | str] | None = None,
    unit_m: float | None = None,
    resolution_m: float = DEFAULT_RESOLUTION_M,
    wall_height_m: float = DEFAULT_WALL_HEIGHT_M,
) -> PartialMap:
    """Make a map of a DXF floor plan.

    Lines, polylines, arcs, circles, ellipses, splines and borders of hatches in the model space are walls, also those
    in blocks. So is what they enclose if it is nowhere wider than 0.5 m: walls that are drawn by both faces are solid.
    What else they enclose is free, doors included; openings of up to 2 m in the outer walls are closed for that, not
    on the map. All other cells are unknown.

    Parameters
    ----------
    path : path-like
        The drawing (DXF, text or binary).
    wall_layers : sequence of str or None
        Layers with the walls, `*` and `?` as in file names. By default visible layers whose names look like walls,
        columns or windows, and all visible ones, with a `MapWarning`, if there are none.
    layer_materials : mapping of str to Material or str, or None
        Materials of the walls on layers, `*` and `?` as in file names, or their names as of `Material.named`. Where
        there are lines of several, the last holds. All other walls are of the default.
    unit_m : float or None
        Length of a unit of the drawing [m], 0.001 for millimetres. By default that of its `$INSUNITS`. Without one it
        is guessed if only one of m, cm and mm makes a building, with a `MapWarning`.
    resolution_m : float
        Edge of a cell [m].
    wall_height_m : float
        Height of walls and ceiling [m].

    Returns
    -------
    PartialMap

    Raises
    ------
    MapError
        If there is no such file, it is damaged or too large, its unit is not clear, it has no such layers, or its walls
        enclose nothing.

    Examples
    --------
    >>> import ezdxf, sionna_partial as sp
    >>> drawing = ezdxf.new(units=4)  # millimetres
    >>> corners = [(0, 0), (5000, 0), (5000, 4000), (0, 4000)]
    >>> _ = drawing.modelspace().add_lwpolyline(corners, close=True, dxfattribs={"layer": "WALLS"})
    >>> drawing.saveas("plan.dxf")
    >>> sp.map_from_drawing("plan.dxf").state_at([[2.0, 2.0], [5.02, 2.0], [6.0, 2.0]]).tolist()
    [0, 1, 2]
    """
    source = input_path(path, "path", MapError, f"give a drawing ({', '.join(DRAWING_SUFFIXES)}).")
    unit = _given_unit(unit_m)
    names = _given_layers(wall_layers)
    content = read_bytes(source, "path", MapError, MAX_DRAWING_BYTES, "purge it, or delete what is no wall.")
    with decoding(source, "no DXF", MapError):
        drawing = _opened(content)
        layers = _wall_layers(source, drawing, names)
        segments, on_layer = _segments(source, drawing, layers)
        materials = _of_layers(source, drawing, layers, layer_materials or {})
        unit = unit or _unit(source, drawing, segments)
    segments = segments * unit
    extent = np.ptp(segments.reshape(-1, 2), axis=0)
    if not POSSIBLE_M[0] <= extent.max() <= POSSIBLE_M[1]:
        raise MapError(
            f"path = '{source}' has walls that span {extent[0]:g} x {extent[1]:g} m with unit_m = {unit:g}: give the "
            "unit_m in which it is drawn (0.001 for millimetres), or the wall_layers of one plan."
        )
    empty = fitted_grid(np.stack([segments.min(axis=(0, 1)), segments.max(axis=(0, 1))]), resolution_m)
    state = states_of_lines(segments, empty)
    if not (state == CellState.FREE).any():
        raise MapError(
            f"path = '{source}': the walls of {shown(sorted(layers))} enclose nothing: name the layers that close the "
            f"rooms as wall_layers; it has {_listed(drawing)}."
        )
    partial = PartialMap(state, empty.resolution_m, empty.origin_m, wall_height_m)
    return with_materials(partial, segments, on_layer, materials) if materials else partial


def _of_layers(
    path: Path, drawing: Any, layers: set[str], given: Mapping[str, Material | str]
) -> dict[Material, set[str]]:
    """Return which of the layers with walls are of each material."""
    from fnmatch import fnmatch

    if not isinstance(given, Mapping):
        raise MapError(f"layer_materials = {shown(given)} is not allowed: give materials by the names of layers.")
    found: dict[Material, set[str]] = {}
    for name, value in given.items():
        material = material_given(name, value)
        own = {layer for layer in layers if fnmatch(layer, str(name).lower())}
        if not own:
            what = f"layer_materials[{shown(name)}] names no layer with walls of path = '{path}'"
            raise MapError(f"{what}: it has {_listed(drawing)}.")
        found[material] = found.get(material, set()) | own
    return found


def material_given(name: str, value: object) -> Material:
    """Return the material that `layer_materials` has for a name."""
    material = Material.named(value) if isinstance(value, str) else value
    if not isinstance(material, Material):
        raise MapError(f"layer_materials[{shown(name)}] = {shown(value)} is no material: give one, or its name.")
    return material


def with_materials(
    partial: PartialMap, segments: Segments, on_layer: NDArray[np.str_], materials: dict[Material, set[str]]
) -> PartialMap:
    """Give each wall the material of the nearest line."""
    lines = (segments - partial.origin_m) / partial.resolution_m
    drawn = np.zeros(partial.shape, dtype=np.uint8)
    for number, layers in enumerate([set(on_layer.tolist()), *materials.values()]):
        chosen, cells = np.isin(on_layer, sorted(layers)), np.zeros(partial.shape, dtype=np.bool_)
        corners = np.zeros((int(chosen.sum()), 5, 2))
        corners[:, :2] = lines[chosen]
        mark_cells(corners, np.full(len(corners), 2), cells, BORDER_M / partial.resolution_m, True)
        drawn[cells] = number + 1
    nearest = ndimage.distance_transform_edt(drawn == 0, return_distances=False, return_indices=True)
    return replace(partial, wall_material=drawn[tuple(nearest)] - 1, wall_materials=tuple(materials))


def _given_unit(unit_m: float | None) -> float | None:
    if unit_m is not None and not 1e-6 <= number_of(unit_m) <= 1e6:
        raise MapError(f"unit_m = {shown(unit_m)} is not allowed: give the length of a unit in metres, such as 0.001.")
    return None if unit_m is None else number_of(unit_m)


def _given_layers(wall_layers: Sequence[str] | None) -> Sequence[str] | None:
    plain = not isinstance(wall_layers, str) and isinstance(wall_layers, Sequence)
    if wall_layers is not None and not (plain and wall_layers and all(isinstance(each, str) for each in wall_layers)):
        raise MapError(f"wall_layers = {shown(wall_layers)} is not allowed: give names of layers, such as ['WALLS'].")
    return wall_layers


def _opened(content: bytes) -> Any:
    """Parse a DXF, which has to end as one."""
    from ezdxf import recover
    from ezdxf.document import Drawing
    from ezdxf.lldxf.tagger import binary_tags_loader

    is_binary = content.startswith(b"AutoCAD Binary DXF")
    if not content.endswith(b"EOF\0") if is_binary else content.split()[-1:] != [b"EOF"]:
        raise ValueError("it does not end with EOF")
    return Drawing.load(binary_tags_loader(content)) if is_binary else recover.read(io.BytesIO(content))[0]


def _layers(drawing: Any) -> dict[str, bool]:
    """Names of all layers, and whether they are visible; those that are only used have no settings."""
    used = (entity.dxf.layer for entity in drawing.entitydb.values() if entity.dxf.hasattr("layer"))
    settings = {layer.dxf.name: layer.is_on() and not layer.is_frozen() for layer in drawing.layers}
    known = {name.lower() for name in settings}
    return {name: True for name in used if name.lower() not in known} | settings


def _listed(drawing: Any) -> str:
    names = sorted(_layers(drawing))
    return f"{len(names)} layers: {', '.join(names[:40])}"


def _wall_layers(path: Path, drawing: Any, names: Sequence[str] | None) -> set[str]:
    """Names, in lower case, of the layers with walls."""
    from fnmatch import fnmatch

    every = {name.lower(): is_visible for name, is_visible in _layers(drawing).items()}
    if names is not None:
        found = {layer for layer in every if any(fnmatch(layer, name.lower()) for name in names)}
        if not found:
            raise MapError(f"wall_layers = {shown(names)} are none of path = '{path}': it has {_listed(drawing)}.")
        return found
    visible = {name for name, is_visible in every.items() if is_visible}
    found = {name for name in visible if WALL_NAMES.search(name) and not NO_WALL_NAMES.search(name)}
    if not found:
        message = f"path = '{path}' has no layer whose name looks like walls, so all lines are walls"
        warnings.warn(f"{message}: name them as wall_layers; it has {_listed(drawing)}.", MapWarning, stacklevel=3)
    return found or visible


def _segments(path: Path, drawing: Any, layers: set[str]) -> tuple[Segments, NDArray[np.str_]]:
    """Pieces (N, 2, 2) of lines on some layers of the model space, in units of the drawing, and their layers (N,)."""
    pieces: list[tuple[float, float, float, float]] = []
    on_layer: list[str] = []
    parts = 0
    for entity in _entities(drawing.modelspace(), "", MAX_NESTING):
        parts += entity is None or entity.is_virtual
        if parts > MAX_PARTS or len(pieces) > MAX_PIECES:
            what = f"{MAX_PARTS:,} entities in blocks, or {MAX_PIECES:,} pieces of lines"
            raise MapError(f"path = '{path}' has more than {what}: save the walls alone, exploded, as a drawing.")
        if entity is not None and entity.dxf.layer.lower() in layers and entity.dxftype() in _LINES:
            for corners in _curves(entity):
                points = np.array([(corner.x, corner.y) for corner in corners], dtype=np.float64).reshape(-1, 2)
                if np.isfinite(points).all():
                    pieces.extend(np.hstack([points[:-1], points[1:]]).tolist())
                    on_layer.extend([entity.dxf.layer.lower()] * (len(points) - 1))
    if not pieces:
        raise MapError(
            f"path = '{path}' has no lines on {shown(sorted(layers))}: name layers with lines as wall_layers; it has "
            f"{_listed(drawing)}."
        )
    return np.array(pieces).reshape(-1, 2, 2), np.array(on_layer)


def _entities(entities: Iterable[Any], layer: str, nesting: int) -> Iterator[Any]:
    """Yield entities with those of blocks, None for each block; what is on layer 0 in a block is on the block's own."""
    for entity in entities:
        if layer and entity.dxf.layer == "0":
            entity.dxf.layer = layer
        if entity.dxftype() == "INSERT":
            for each in entity.multi_insert() if entity.mcount > 1 else [entity]:
                yield None
                if nesting:
                    yield from _entities(each.virtual_entities(), entity.dxf.layer, nesting - 1)
        elif entity.dxftype() == "MLINE":
            yield from _entities(entity.virtual_entities(), entity.dxf.layer, nesting - 1) if nesting else ()
        else:
            yield entity


def _curves(entity: Any) -> Iterator[Any]:
    """Corners of the polygons that an entity consists of."""
    from ezdxf.path import from_hatch, make_path

    for path in from_hatch(entity) if entity.dxftype() == "HATCH" else [make_path(entity)]:
        corners = np.array([(corner.x, corner.y) for corner in path.control_vertices()])
        if len(corners) > 1:
            yield path.flattening(max(FLAT_FRACTION * float(np.ptp(corners, axis=0).max()), 1e-9), segments=4)


def _unit(path: Path, drawing: Any, segments: Segments) -> float:
    """Length of a unit of a drawing [m]."""
    from ezdxf import units
    from ezdxf.enums import InsertUnits

    code = drawing.header.get("$INSUNITS", 0)
    if code in range(1, 25):
        return float(units.conversion_factor(InsertUnits(code), InsertUnits.Meters))
    size = float(np.ptp(segments.reshape(-1, 2), axis=0).max())
    found = [unit for unit in UNITS_M if PLAUSIBLE_M[0] <= size * unit <= PLAUSIBLE_M[1]]
    what = f"path = '{path}' has no unit ($INSUNITS = {code}), and walls of {size:g} units"
    if len(found) != 1:
        raise MapError(f"{what}: give unit_m, 0.001 if they are millimetres, 0.01 for centimetres, 1 for metres.")
    warnings.warn(f"{what}, which are read as {UNITS_M[found[0]]}: give unit_m.", MapWarning, stacklevel=3)
    return found[0]


def states_of_lines(segments: Segments, empty: PartialMap, solid: Bools | None = None) -> States:
    """Cell states (ny, nx): walls, those of `solid` among them, what they enclose, and unknown cells."""
    cell_m = empty.resolution_m
    corners = np.zeros((len(segments), 5, 2))
    corners[:, :2] = (segments - empty.origin_m) / cell_m
    margin = math.ceil(OPENING_M / cell_m)
    cells = np.zeros(empty.shape, dtype=np.bool_)
    mark_cells(corners, np.full(len(segments), 2), cells, BORDER_M / cell_m, True)
    wall = np.pad(cells if solid is None else cells | solid, margin)
    # A disc of half the opening's width that rolls along the outer walls does not enter the building.
    radius = OPENING_M / 2 / cell_m
    to_wall = ndimage.distance_transform_edt(~wall)
    area, _ = ndimage.label(to_wall > radius)
    outside = ndimage.distance_transform_edt(area != area[0, 0]) <= radius
    area, count = ndimage.label(~(wall | outside))
    widest_m = 2 * cell_m * ndimage.maximum(to_wall, area, np.arange(count + 1))
    inside = area > 0
    state = np.full(wall.shape, CellState.UNKNOWN, dtype=np.uint8)
    state[inside] = CellState.FREE
    state[wall | (inside & (widest_m <= SOLID_M)[area])] = CellState.WALL
    return state[margin:-margin, margin:-margin]
