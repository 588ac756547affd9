"""Lines of a DXF on some of its layers, also in blocks."""

import io
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.errors import MapError

MAX_PIECES, MAX_PARTS, MAX_NESTING = 1_000_000, 2_000_000, 16
"""Most pieces of lines, most blocks with their entities, and deepest nesting of blocks."""

FLAT_FRACTION = 0.001
"""Distance of a polygon from its curve, relative to the extent of the curve."""

LINE_TYPES = {
    *("LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE", "HATCH", "SOLID", "TRACE", "MLINE"),
    *("3DFACE", "MESH"),
}
"""Types with lines in the plan; of faces, the upright ones."""

XREF, HIDDEN = "external reference", "hidden"
"""Kinds of entities that are not read: external references, and those that AutoCAD does not show."""

Segments = Floats
"""Ends (N, 2, 2) of pieces of lines."""

UPRIGHT_RATIO = 0.1
"""Largest vertical part of the normal of an upright face."""


def opened(content: bytes) -> Any:
    """Parse a complete DXF, if necessary by ezdxf's slow recovery."""
    from ezdxf import recover
    from ezdxf.document import Drawing
    from ezdxf.filemanagement import dxf_stream_info
    from ezdxf.lldxf.const import DXFError
    from ezdxf.lldxf.tagger import binary_tags_loader

    is_binary = content.startswith(b"AutoCAD Binary DXF")
    if not content.endswith(b"EOF\0") if is_binary else content[-100:].split()[-1:] != [b"EOF"]:
        raise ValueError("it does not end with EOF")
    if is_binary:
        return Drawing.load(binary_tags_loader(content))
    try:
        encoding = dxf_stream_info(io.StringIO(content.decode("latin-1"))).encoding
        return Drawing.read(io.TextIOWrapper(io.BytesIO(content), encoding, errors="surrogateescape"))
    except (DXFError, ArithmeticError, ValueError, LookupError, AttributeError, TypeError):
        return recover.read(io.BytesIO(content))[0]


class DrawnLines:
    """Lines of a drawing by layer. Each block is read once.

    `counts` has the numbers of entities by layer (in lower case) and type, including blocks, whose entities on layer 0
    take the layer of the INSERT. `names` are the layers as written.
    """

    def __init__(self, path: Path, drawing: Any) -> None:
        self._path, self._drawing = path, drawing
        self.names = {layer.dxf.name.lower(): layer.dxf.name for layer in drawing.layers}
        self._frozen = {layer.dxf.name.lower() for layer in drawing.layers if layer.is_frozen()}
        self._counted: dict[str, Counter[tuple[str, str]]] = {}
        self._read: dict[str, dict[str, Segments]] = {}
        space = drawing.modelspace()
        self.counts = self._count(space, MAX_NESTING)
        if sum(self.counts.values()) - len(space) > MAX_PARTS:
            raise self._too_large()

    def line_counts(self) -> Counter[str]:
        found = Counter[str]()
        for (layer, kind), count in self.counts.items():
            found[layer] += count * (kind in LINE_TYPES)
        return found

    def segments(self, layers: set[str]) -> tuple[Segments, NDArray[np.str_]]:
        """Return pieces (N, 2, 2) of lines on some layers, in units of the drawing, and their layers (N,)."""
        self._read.clear()
        found = self._lines(self._drawing.modelspace(), layers, MAX_NESTING)
        kept = {layer: found[layer] for layer in sorted(found) if layer in layers}
        pieces = [segments[..., :2].reshape(-1, 2, 2) for segments in kept.values()]
        names = np.repeat(np.array([*kept] or [""]), [len(part) for part in pieces] or [0])
        return np.concatenate([np.zeros((0, 2, 2)), *pieces]), names

    def _count(self, entities: Iterable[Any], nesting: int) -> Counter[tuple[str, str]]:
        found = Counter[tuple[str, str]]()
        for entity in entities:
            name, kind = _layer_of(entity), entity.dxftype()
            layer = name.lower()
            self.names.setdefault(layer, name)
            if not self._shows(entity):
                found[layer, HIDDEN] += entity.mcount if kind == "INSERT" else 1
                continue
            if kind != "INSERT":
                found[layer, kind] += 1
                continue
            name, times = entity.dxf.get("name", ""), entity.mcount
            found["", kind] += times
            block = entity.block()
            if block is not None and block.block.is_xref:
                found[name, XREF] += times
            elif block is not None and nesting:
                if name not in self._counted:
                    self._counted[name] = Counter()  # a block within itself is empty
                    self._counted[name] = self._count(block, nesting - 1)
                for (own, inner), count in self._counted[name].items():
                    found[layer if own == "0" else own, inner] += count * times
        return found

    def _shows(self, entity: Any) -> bool:
        """Return whether an entity is visible, and no INSERT on a frozen layer, which hides its block on any layer."""
        is_insert = entity.dxftype() == "INSERT"
        is_invisible = entity.dxf.hasattr("invisible") and entity.dxf.invisible
        return not is_invisible and not (is_insert and _layer_of(entity).lower() in self._frozen)

    def _lines(self, entities: Iterable[Any], layers: set[str], nesting: int) -> dict[str, Segments]:
        parts: dict[str, list[Segments]] = {}
        pieces = 0
        for entity in entities:
            layer = _layer_of(entity).lower()
            if not self._shows(entity):
                continue
            if entity.dxftype() == "INSERT":
                found = self._inserted(entity, layer, layers, nesting)
            elif layer in layers or layer == "0":
                found = [(layer, lines) for lines in _pieces(entity) if np.isfinite(lines).all()]
            else:
                continue
            for name, lines in found:
                parts.setdefault(name, []).append(lines)
                pieces += len(lines)
            if pieces > MAX_PIECES:
                raise self._too_large()
        return {name: np.concatenate(lines) for name, lines in parts.items()}

    def _inserted(self, insert: Any, layer: str, layers: set[str], nesting: int) -> list[tuple[str, Segments]]:
        name, block = insert.dxf.get("name", ""), insert.block()
        wanted = {own: layer if own == "0" else own for own, _ in self._counted.get(name, ())}
        wanted = {own: target for own, target in wanted.items() if target in layers or target == "0"}
        if not wanted or not nesting:
            return []
        if name not in self._read:
            self._read[name] = {}  # a block within itself is empty
            self._read[name] = self._lines(block, layers, nesting - 1)
        own = {layer: lines for layer, lines in self._read[name].items() if layer in wanted}
        shifts = _grid(insert)
        if sum(map(len, own.values())) * len(shifts) > MAX_PIECES:
            raise self._too_large()
        matrix = np.array(list(insert.matrix44())).reshape(4, 4)
        return [
            (wanted[layer], (lines @ matrix[:3, :3] + matrix[3, :3] + shifts).reshape(-1, 2, 3))
            for layer, lines in own.items()
        ]

    def _too_large(self) -> MapError:
        what = f"{MAX_PARTS:,} entities in blocks, or {MAX_PIECES:,} pieces of lines"
        return MapError(f"path = '{self._path}' has more than {what}: save the walls alone, exploded, as a drawing.")


def _grid(insert: Any) -> Floats:
    """Return the shifts (N, 1, 1, 3) of an INSERT that repeats a block on a grid."""
    from ezdxf.math import Vec3

    ocs, turned = insert.ocs(), math.radians(insert.dxf.rotation)
    shifts = np.zeros((1, 3))
    for count, spacing, angle in (
        (insert.dxf.column_count, insert.dxf.column_spacing, turned),
        (insert.dxf.row_count, insert.dxf.row_spacing, turned + math.pi / 2),
    ):
        along = np.array(ocs.to_wcs(Vec3.from_angle(angle)).xyz) * spacing
        shifts = (shifts[:, None] + np.arange(max(count, 1) if spacing else 1)[:, None] * along).reshape(-1, 3)
    return shifts[:, None, None]


def _layer_of(entity: Any) -> str:
    return str(entity.dxf.layer) if entity.dxf.hasattr("layer") else "0"  # objects of other programs have none


def _pieces(entity: Any) -> Iterator[Segments]:
    kind = entity.dxftype()
    if kind == "LINE":
        yield np.array([[entity.dxf.start.xyz, entity.dxf.end.xyz]])
    elif kind == "MLINE" or (kind == "POLYLINE" and (entity.is_poly_face_mesh or entity.is_polygon_mesh)):
        for part in entity.virtual_entities():
            yield from _pieces(part)
    elif kind == "3DFACE":
        yield from _upright([corner.xyz for corner in entity.wcs_vertices()])
    elif kind == "MESH":
        for face in entity.faces:
            yield from _upright([tuple(entity.vertices[number]) for number in face])
    elif kind in LINE_TYPES:
        for corners in _curves(entity):
            yield np.stack([corners[:-1], corners[1:]], axis=1)


def _upright(corners: list[tuple[float, ...]]) -> Iterator[Segments]:
    """Yield the line under an upright face."""
    points = np.array(corners, dtype=np.float64)
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    if np.isfinite(points).all() and abs(normal[2]) < UPRIGHT_RATIO * np.linalg.norm(normal):
        apart = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=2)
        yield points[[[*np.unravel_index(np.argmax(apart), apart.shape)]]]


def _curves(entity: Any) -> Iterator[Floats]:
    from ezdxf.path import from_hatch, make_path

    if entity.dxftype() in ("LWPOLYLINE", "POLYLINE") and entity.has_width:
        yield from _wide(entity)
        return
    for path in from_hatch(entity) if entity.dxftype() == "HATCH" else [make_path(entity)]:
        corners = np.array([corner.xyz for corner in path.control_vertices()])
        if len(corners) > 1 and path.has_curves:
            flat = max(FLAT_FRACTION * float(np.ptp(corners[:, :2], axis=0).max()), 1e-9)
            corners = np.array([corner.xyz for corner in path.flattening(flat, segments=4)])
        if len(corners) > 1:
            yield corners


def _wide(entity: Any) -> Iterator[Floats]:
    """Yield the outlines of the segments of a polyline with widths."""
    from ezdxf.math import Vec3
    from ezdxf.render.trace import TraceBuilder

    ocs = entity.ocs()
    for trace in TraceBuilder.from_polyline(entity, segments=16):
        for face in trace.faces():
            corners = [Vec3(corner) for corner in face]
            yield np.array([ocs.to_wcs(corner).xyz for corner in [*corners, corners[0]]])
