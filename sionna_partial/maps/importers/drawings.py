"""Drawings (DXF) -> PartialMap: walls are lines on layers."""

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.arrays import States
from sionna_partial.checks import number_of, shown
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M, DRAWING_SUFFIXES, CellState
from sionna_partial.errors import MapError
from sionna_partial.files import decoding, input_path, read_bytes
from sionna_partial.maps.environment import ImportNotes, MapWarning
from sionna_partial.maps.import_report import ENCLOSED_FRACTION
from sionna_partial.maps.importers.drawing_lines import HIDDEN, LINE_TYPES, XREF, DrawnLines, Segments, opened
from sionna_partial.maps.importers.drawing_units import POSSIBLE_M, unit_of, wall_thickness
from sionna_partial.maps.importers.wall_layers import NO_WALL, PARTIAL_HEIGHT, skip_reason
from sionna_partial.maps.mesh.cells import (
    DEFAULT_RESOLUTION_M,
    crossed_cells,
    fitted_grid,
    require_no_degrees,
    require_unit,
    states_of_lines,
)
from sionna_partial.maps.mesh.cut import BORDER_M
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import Material

MAX_DRAWING_BYTES = 100_000_000

FOREIGN = "AEC_", "ACAD_PROXY"
"""Prefixes of types of objects that the DXF does not contain as lines."""

MAX_ADDED, MAX_GROWTH = 8, 2.5
"""Most layers tried if walls enclose hardly any area, and their largest relative extent."""


def map_from_drawing(
    path: str | os.PathLike[str],
    *,
    wall_layers: Sequence[str] | None = None,
    layer_materials: Mapping[str, Material | str] | None = None,
    layer_heights_m: Mapping[str, float] | None = None,
    unit_m: float | None = None,
    resolution_m: float = DEFAULT_RESOLUTION_M,
    wall_height_m: float = DEFAULT_WALL_HEIGHT_M,
) -> PartialMap:
    """Make a map from a DXF floor plan.

    Walls are lines, polylines, arcs, circles, ellipses, splines and borders of hatches in the model space, also in
    blocks. Enclosed areas up to 0.5 m wide are solid walls drawn by both faces; others, doors included, are free, and
    openings of up to 2 m in outer walls count as closed for that. All other cells are unknown. `import_report` lists
    unit and layers.

    Parameters
    ----------
    path : path-like
        DXF, text or binary.
    wall_layers : sequence of str or None
        Layers with the walls, with wildcards `*` and `?`. By default visible layers named as walls, columns or
        windows, in one of 38 languages or by the AIA/NCS standard, except demolished ones. If they enclose hardly any
        area, also the layer that closes most rooms, with a `MapWarning`. Without such names, the only layer with lines,
        with a `MapWarning`; several are refused, with a list of their lines.
    layer_materials : mapping of str to Material or str, or None
        Materials of the walls on layers, with wildcards; the last layer wins.
    layer_heights_m : mapping of str to float, or None
        Heights of the walls on layers [m], with wildcards. By default walls reach the ceiling, with a `MapWarning` for
        layers whose names mean a partial height.
    unit_m : float or None
        Length of a unit of the drawing [m]. By default the unit of its `$INSUNITS`, or another one, with a
        `MapWarning`, if extent, doors, walls and texts fit only that.
    resolution_m : float
        Edge of a cell [m].
    wall_height_m : float
        Height of walls and ceiling [m].

    Raises
    ------
    MapError
        For a missing, damaged or too large file, an unclear unit, or layers without walls around an area.

    Examples
    --------
    >>> import ezdxf, sionna_partial as sp
    >>> drawing = ezdxf.new(units=4)  # millimetres
    >>> corners = [(0, 0), (5000, 0), (5000, 4000), (0, 4000)]
    >>> _ = drawing.modelspace().add_lwpolyline(corners, close=True, dxfattribs={"layer": "WALLS"})
    >>> drawing.saveas("plan.dxf")
    >>> sp.importers.map_from_drawing("plan.dxf").state_at([[2.0, 2.0], [5.02, 2.0], [6.0, 2.0]]).tolist()
    [0, 1, 2]
    """
    source = input_path(path, "path", MapError, f"give a drawing ({', '.join(DRAWING_SUFFIXES)}).")
    require_unit(unit_m)
    unit = None if unit_m is None else number_of(unit_m)
    names = _given_layers(wall_layers)
    content = read_bytes(source, "path", MapError, MAX_DRAWING_BYTES, "purge it, or delete what is no wall.")
    with decoding(source, "no DXF", MapError):
        plan = _Plan.of(source, opened(content))
        reasons = plan.skip_reasons(names)
        layers = {layer for layer, reason in reasons.items() if not reason}
        segments, on_layer = plan.segments(layers)
        notes = ImportNotes(source, unit or 0.0, "unit_m")
        if unit is None:
            require_no_degrees(f"path = '{source}'", np.stack([segments.min(axis=(0, 1)), segments.max(axis=(0, 1))]))
            notes.unit_m, notes.unit_source = plan.unit(segments)
        state, empty = _cells(source, segments * notes.unit_m, notes.unit_m, resolution_m)
        if names is None and _enclosed(state) < ENCLOSED_FRACTION:
            added = _closing_layer(plan, reasons, segments, notes.unit_m, resolution_m)
            if added is not None:
                reasons[added], layers = "", layers | {added}
                segments, on_layer = plan.segments(layers)
                state, empty = _cells(source, segments * notes.unit_m, notes.unit_m, resolution_m)
        plan.note(notes, reasons)
        materials = _by_layer("layer_materials", plan, layers, layer_materials, material_given)
        heights_m = _by_layer("layer_heights_m", plan, layers, layer_heights_m, _height_given)
    if not (state == CellState.FREE).any():
        raise MapError(
            f"path = '{source}': the walls of {shown(sorted(layers))} enclose nothing: name the layers that close the "
            f"rooms as wall_layers; it has {plan.listed()}."
        )
    partial = PartialMap(state, empty.resolution_m, empty.origin_m, wall_height_m)
    lines = segments * notes.unit_m
    partial = with_materials(partial, lines, on_layer, materials) if materials else partial
    partial = _with_heights(source, partial, lines, on_layer, heights_m)
    _warn_of_close_lines(source, segments, notes.unit_m, partial.resolution_m)
    size = "give the unit_m in which it is drawn (0.001 for millimetres), or the wall_layers of one plan."
    area = f"name the layers that close the rooms as wall_layers; it has {plan.listed()}."
    return notes.attached_to(partial, size=size, doors=size, area=area)


class _Plan(NamedTuple):
    """Layers of a drawing (in lower case) with their visibility, and its lines."""

    path: Path
    drawing: Any
    visible: dict[str, bool]
    lines: DrawnLines

    @classmethod
    def of(cls, path: Path, drawing: Any) -> "_Plan":
        lines = DrawnLines(path, drawing)
        visible = {layer: True for layer, kind in lines.counts if kind not in ("INSERT", XREF, HIDDEN)}
        visible |= {layer.dxf.name.lower(): layer.is_on() and not layer.is_frozen() for layer in drawing.layers}
        return cls(path, drawing, visible, lines)

    def unit(self, segments: Segments) -> tuple[float, str]:
        header, texts = self.drawing.header, self.drawing.modelspace().query("TEXT MTEXT")
        names = {"TEXT": "height", "MTEXT": "char_height"}
        heights = np.array([float(text.dxf.get(names[text.dxftype()], 0.0)) for text in texts])
        code, is_metric = int(header.get("$INSUNITS", 0)), header.get("$MEASUREMENT", 1) == 1
        return unit_of(self.path, code, is_metric, segments, heights)

    def listed(self) -> str:
        counts = self.lines.line_counts()
        names = sorted(self.visible, key=lambda layer: (-counts[layer], layer))
        texts = (f"{self.lines.names.get(name, name)} ({counts[name]:,} lines)" for name in names[:40])
        return f"{len(names)} layers: {', '.join(texts)}"

    def preview(self, layers: set[str]) -> str:
        """Return number, length and extent of the lines on layers, the longest first."""
        segments, on_layer = self.lines.segments(layers)
        counts, found = self.lines.line_counts(), []
        for layer in layers:
            own = segments[on_layer == layer]
            if len(own):
                x, y = np.ptp(own.reshape(-1, 2), axis=0)
                length = float(np.linalg.norm(own[:, 1] - own[:, 0], axis=1).sum())
                name = self.lines.names.get(layer, layer)
                found.append((-length, f"'{name}' ({counts[layer]:,} lines, {length:.4g} long, on {x:.4g} x {y:.4g})"))
        texts = [text for _, text in sorted(found)]
        more = f", and {len(texts) - 20} more" if len(texts) > 20 else ""
        return f"{', '.join(texts[:20])}{more} [units of the drawing]"

    def skip_reasons(self, names: Sequence[str] | None) -> dict[str, str]:
        if names is not None:
            found = {
                layer: "" if any(fnmatch(layer, name.lower()) for name in names) else "not in wall_layers"
                for layer in self.visible
            }
            if all(found.values()):
                what = f"wall_layers = {shown(names)} are none of path = '{self.path}'"
                raise MapError(f"{what}: it has {self.listed()}.")
            return found
        found = {layer: skip_reason(layer) if shows else "hidden" for layer, shows in self.visible.items()}
        if all(found.values()):
            counts = self.lines.line_counts()
            shown_layers = {layer for layer, shows in self.visible.items() if shows and counts[layer]}
            message = f"path = '{self.path}' has no layer whose name looks like walls"
            if len(shown_layers) > 1:
                remedy = f"give wall_layers (--wall-layer), one or more of {self.preview(shown_layers)}"
                raise MapError(f"{message}: {remedy}.")
            message = f"{message}, so all lines are walls"
            warnings.warn(f"{message}: name them as wall_layers; it has {self.listed()}.", MapWarning, stacklevel=4)
            found = {layer: "" if reason != "hidden" else reason for layer, reason in found.items()}
        return found

    def segments(self, layers: set[str]) -> tuple[Segments, NDArray[np.str_]]:
        segments, on_layer = self.lines.segments(layers)
        if not len(segments):
            remedy = f"name layers with lines as wall_layers; it has {self.listed()}."
            raise MapError(f"path = '{self.path}' has no lines on {shown(sorted(layers))}: {remedy}")
        return segments, on_layer

    def note(self, notes: ImportNotes, reasons: dict[str, str]) -> None:
        lost = dict[str, int]()
        for (name, kind), count in self.lines.counts.items():
            layer = self.lines.names.get(name, name)
            if kind == XREF or kind.startswith(FOREIGN):
                what, remedy = (kind, "explode them") if kind != XREF else (name, "bind it")
                notes.skip(what, count, f"{'object of another program' if kind != XREF else kind}: {remedy}")
                lost[what] = lost.get(what, 0) + count
            elif kind == HIDDEN:
                notes.skip(layer, count, "invisible, or blocks on a frozen layer")
            elif kind in LINE_TYPES:
                notes.skip(layer, count, reasons.get(name, NO_WALL))
            elif kind != "INSERT" and not reasons.get(name, NO_WALL):
                notes.skip(f"{kind} on {layer}", count, "type without lines")
        if lost:
            texts = ", ".join(f"{name} ({count:,})" for name, count in sorted(lost.items())[:20])
            what = f"path = '{self.path}' has objects of other programs or external references, which are not read"
            remedy = "explode or bind them in the program that the drawing comes from, and save it as DXF."
            warnings.warn(f"{what}: {texts}: {remedy}", MapWarning, stacklevel=4)


def _cells(path: Path, segments: Segments, unit_m: float, resolution_m: float) -> tuple[States, PartialMap]:
    extent = np.ptp(segments.reshape(-1, 2), axis=0)
    if not POSSIBLE_M[0] <= extent.max() <= POSSIBLE_M[1]:
        raise MapError(
            f"path = '{path}' has walls that span {extent[0]:g} x {extent[1]:g} m with unit_m = {unit_m:g}: give the "
            "unit_m in which it is drawn (0.001 for millimetres), or the wall_layers of one plan."
        )
    empty = fitted_grid(np.stack([segments.min(axis=(0, 1)), segments.max(axis=(0, 1))]), resolution_m)
    return states_of_lines(segments, empty), empty


def _enclosed(state: States) -> float:
    return float((state == CellState.FREE).sum() / state.size)


def _closing_layer(
    plan: _Plan, reasons: dict[str, str], segments: Segments, unit_m: float, resolution_m: float
) -> str | None:
    """Return the layer that closes the rooms with the smallest area, and warn of it."""
    counts, found = plan.lines.line_counts(), dict[str, float]()
    others = [layer for layer, reason in reasons.items() if reason == NO_WALL and counts[layer]]
    extent = np.ptp(segments.reshape(-1, 2), axis=0).max()
    for layer in sorted(others, key=lambda layer: -counts[layer])[:MAX_ADDED]:
        both = np.concatenate([segments, plan.segments({layer})[0]])
        if np.ptp(both.reshape(-1, 2), axis=0).max() <= MAX_GROWTH * extent:
            state, empty = _cells(plan.path, both * unit_m, unit_m, resolution_m)
            if _enclosed(state) >= 2 * ENCLOSED_FRACTION:
                found[layer] = float((state == CellState.FREE).sum()) * empty.resolution_m**2
    if not found:
        return None
    best = min(found, key=found.__getitem__)
    used = shown(sorted(layer for layer, reason in reasons.items() if not reason))
    what = f"path = '{plan.path}' has walls on {used} that enclose hardly any area"
    added = f"layer '{plan.lines.names[best]}' ({counts[best]:,} lines) is read as walls, too"
    what += f", so {added}, which then enclose {found[best]:.3g} m2"
    warnings.warn(f"{what}: give wall_layers; it has {plan.listed()}.", MapWarning, stacklevel=4)
    return best


def _warn_of_close_lines(path: Path, segments: Segments, unit_m: float, resolution_m: float) -> None:
    thickness_m = wall_thickness(segments) * unit_m
    if 0 < thickness_m < resolution_m:
        what = f"path = '{path}' has lines {thickness_m:.2g} m apart, closer than resolution_m = {resolution_m:g}"
        remedy = f"give a resolution_m of {thickness_m / 2:.1g}, or the unit_m in which it is drawn."
        warnings.warn(f"{what}, with unit_m = {unit_m:g}: {remedy}", MapWarning, stacklevel=3)


def _by_layer(name: str, plan: _Plan, layers: set[str], given: Any, checked: Any) -> dict[Any, set[str]]:
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise MapError(f"{name} = {shown(given)} is not allowed: give values by the names of layers.")
    found: dict[Any, set[str]] = {}
    for pattern, value in given.items():
        value = checked(pattern, value)
        own = {layer for layer in layers if fnmatch(layer, str(pattern).lower())}
        if not own:
            what = f"{name}[{shown(pattern)}] names no layer with walls of path = '{plan.path}'"
            raise MapError(f"{what}: it has {plan.listed()}.")
        found[value] = found.get(value, set()) | own
    return found


def material_given(name: str, value: object) -> Material:
    material = Material.named(value) if isinstance(value, str) else value
    if not isinstance(material, Material):
        raise MapError(f"layer_materials[{shown(name)}] = {shown(value)} is no material: give one, or its name.")
    return material


def _height_given(name: str, value: object) -> float:
    height_m = number_of(value)
    if not 0.01 <= height_m <= 100:
        raise MapError(
            f"layer_heights_m[{shown(name)}] = {shown(value)} is not allowed: give a height of 0.01 to 100 m."
        )
    return height_m


def with_materials(
    partial: PartialMap, segments: Segments, on_layer: NDArray[np.str_], materials: dict[Material, set[str]]
) -> PartialMap:
    owner = _owners(partial, segments, on_layer, [*materials.values()])
    return replace(partial, wall_material=owner, wall_materials=tuple(materials))


def _with_heights(
    path: Path, partial: PartialMap, segments: Segments, on_layer: NDArray[np.str_], heights_m: dict[float, set[str]]
) -> PartialMap:
    named = set().union(*heights_m.values())
    low = sorted(layer for layer in set(on_layer.tolist()) - named if PARTIAL_HEIGHT.search(layer))
    if low:
        what = f"path = '{path}' has walls of partial height on {shown(low)}, which are read up to the ceiling"
        remedy = f"give layer_heights_m to map_from_drawing, such as {{'{low[0]}': 1.1}}, or wall_layers without them."
        warnings.warn(f"{what}: {remedy}", MapWarning, stacklevel=3)
    owner = _owners(partial, segments, on_layer, [*heights_m.values()]) if heights_m else np.zeros((1, 1))
    for number, height_m in enumerate(heights_m, 1):
        partial = partial.with_obstacle_height(height_m, owner == number)
    return partial


def _owners(
    partial: PartialMap, segments: Segments, on_layer: NDArray[np.str_], groups: Sequence[set[str]]
) -> NDArray[np.uint8]:
    """Return the group of layers (from 1) with the nearest line to each cell (ny, nx), 0 for others."""
    lines = (segments - partial.origin_m) / partial.resolution_m
    drawn = np.zeros(partial.shape, dtype=np.uint8)
    for number, layers in enumerate([set(on_layer.tolist()), *groups]):
        chosen = np.isin(on_layer, sorted(layers))
        drawn[crossed_cells(lines[chosen], partial.shape, BORDER_M / partial.resolution_m)] = number + 1
    nearest = ndimage.distance_transform_edt(drawn == 0, return_distances=False, return_indices=True)
    return np.asarray(drawn[tuple(nearest)] - 1)


def _given_layers(wall_layers: Sequence[str] | None) -> Sequence[str] | None:
    plain = not isinstance(wall_layers, str) and isinstance(wall_layers, Sequence)
    if wall_layers is not None and not (plain and wall_layers and all(isinstance(name, str) for name in wall_layers)):
        raise MapError(f"wall_layers = {shown(wall_layers)} is not allowed: give names of layers, such as ['WALLS'].")
    return wall_layers
