"""Lines of a DXF on layers with walls, named in European languages or by the AIA/NCS standard, and their unit."""

import io
import math
import re
import unicodedata
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.errors import MapError
from sionna_partial.maps.import_report import MapWarning, rooms_of
from sionna_partial.maps.mesh.cells import crossed_cells

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

WALL_WORDS = {
    "English": "wall partition colum pillar s-cols window glaz",
    "German": "wand wänd mauer stütze säule fenster",
    "French": "mur(?!al) cloison poteau fenêtre vitr",
    "Spanish": "pared muro tabique pilar ventana",
    "Italian": "parete pareti tramezz pilastr finestra",
    "Portuguese": "parede alvenaria janela",
    "Dutch": "muur kolom <raam>",
    "Swedish": "vägg pelare fönster",
    "Norwegian": "vegg søyle vindu",
    "Danish": "væg søjle",
    "Finnish": "seinä pilari ikkuna",
    "Estonian": "<sein <aken",
    "Latvian, Lithuanian": "<sien[aou]",
    "Polish": "ścian słup <okn",
    "Czech, Slovak": "<stěn[aoy] <zeď> <zdi zdiv příčk priečk sloup <stĺp",
    "Hungarian": "<fal> <fala válaszfal főfal oszlop pillér ablak",
    "Romanian": "perete pereți zidăr <stâlp fereastr ferestre",
    "Croatian, Serbian, Slovenian": "<zid <stup(?!id) prozor зид прозор",
    "Russian, Bulgarian": "стен перегород колон окн окон",
    "Ukrainian": "стін стін вікн вікон",
    "Greek": "τοίχο τοιχ κολών παράθυρ toich toix",
    "Turkish": "duvar kolon pencere",
    "Indonesian, Malay": "dinding tembok jendela",
    "Vietnamese": "tường tuong vách <cột> cửa_sổ",
    "Chinese": "墙 牆 柱 窗",
    "Japanese": "壁 柱 窓",
    "Korean": "벽 기둥 창문",
    "Thai": "ผนัง กำแพง เสา หน้าต่าง",
    "Arabic, Persian": "جدار حائط عمود نافذة دیوار",
    "Hebrew": "קיר עמוד חלון",
    "Hindi": "दीवार",
}
"""Patterns of names of layers with walls, columns and windows; < and > are ends of words, accents do not count."""


_LETTERS = str.maketrans({"ł": "l", "ø": "o", "æ": "ae", "\u0131": "i"})


def _plain(text: str) -> str:
    """Return text in lower case without accents."""
    kept = (letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    return "".join(kept).casefold().translate(_LETTERS)


_ENDS = {"<": "(?<![^\\W\\d_])", ">": "(?![^\\W\\d_])", "_": "[ _-]?"}
_WALLS = "|".join(word for words in WALL_WORDS.values() for word in _plain(words).split())
WALL_NAMES = re.compile(re.sub("[<>_]", lambda found: _ENDS[found[0]], _WALLS))
"""Words in names of layers with walls, columns and windows, for `_plain` names."""

NO_WALL_NAMES = {
    reason: re.compile(words, re.IGNORECASE)
    for reason, words in {
        "texts, dimensions or door headers": r"head|text|dim|anno|iden|note",
        "furniture": r"furn|möbel|mobel|schrank",
        "doors": r"门窗|門窗",
        "axes": r"芯|轴|軸",
        "lamps or sockets": r"-lite|light|lamp|leucht|lumin|sconce|socket|steckdose|outlet",
        "above the room": r"ovhd|overhead",
        "to be demolished": r"demo(?![a-z])|demol|démol|abbruch|abriss|rückbau|sloop|rivning|wyburz",
    }.items()
}
"""Words in names of layers that describe walls, close doors, or contain walls to be demolished."""

AIA_WALLS = {"WALL", "GLAZ", "COLS", "PRTN"}
"""Major groups of the AIA/NCS standard with walls, windows and columns."""

AIA_STATUS = {"D": "to be demolished", "F": "future work", "M": "to be moved", "T": "temporary"}
"""Status fields of AIA/NCS names of walls outside the finished building."""

AIA_DEMOLITION = {"AD", "ID", "SD"}

PARTIAL_HEIGHT = re.compile(r"(?<![a-z])prht(?![a-z])|partial.?height|halbhoch|brüstung", re.IGNORECASE)
"""Words in names of layers with walls that end below the ceiling."""

NO_WALL = "name of no wall"

_AIA = re.compile(r"([A-Z]{1,2})-([A-Z]{4})((?:-[A-Z0-9]{4})*)(?:-([A-Z1-9]))?", re.IGNORECASE)
_REFERENCE = re.compile(r"\||\$\d+\$")

UNITS_M = {
    "millimetres": 0.001,
    "centimetres": 0.01,
    "metres": 1.0,
    "decimetres": 0.1,
    "inches": 0.0254,
    "feet": 0.3048,
}

RARE = {"decimetres": 8.0, "inches": 3.0, "feet": 3.0}
"""Additional misfit of rare units that the header does not have."""

POSSIBLE_M = (1.0, 2000.0)
"""Plausible longer sides of a building [m]."""

MARGIN, DOUBT, UNIQUE_MARGIN = 5.0, 2.5, 1.0
"""Differences of misfits from which the header's unit is rejected; from which it gives a warning, or is rejected if it
is inches or feet in a metric drawing; and from which one unit is better than all others."""

UPRIGHT_RATIO = 0.1
"""Largest vertical part of the normal of an upright face."""

RASTER_CELLS = 1000
"""Number of cells along the longer side of the plan in which openings are found."""

MOST_LINES = 1500
"""Number of longest lines whose distances are computed."""


def skip_reason(name: str) -> str:
    """Return the reason for which a layer is not read as walls, "" for walls.

    The major group of an AIA/NCS name decides. Names of external references in front are ignored.
    """
    name = unicodedata.normalize("NFC", _REFERENCE.split(name)[-1])
    parts = _AIA.fullmatch(name)
    if parts and parts[2].upper() not in AIA_WALLS and not WALL_NAMES.search(_plain(parts[2])):
        return "major group of no wall (AIA/NCS)"
    is_wall = WALL_NAMES.search(_plain(name))
    for reason, words in NO_WALL_NAMES.items():
        if words.search(name):
            return reason if is_wall else f"{NO_WALL}: {reason}"
    if not parts:
        return "" if is_wall else NO_WALL
    status = "D" if parts[1].upper() in AIA_DEMOLITION else (parts[4] or "").upper()
    return AIA_STATUS.get(status, "")


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


class _Scale(NamedTuple):
    """Usual value of a length [m]; a factor from it is a misfit of 1, limited to `limit`."""

    usual_m: float
    factor: float
    limit: float


SCALES = {
    "an extent": _Scale(20.0, 5.0, 20.0),
    "openings": _Scale(0.9, 1.7, 3.0),
    "gaps in walls": _Scale(0.9, 1.7, 3.0),
    "walls": _Scale(0.2, 3.0, 3.0),
    "texts": _Scale(0.2, 4.0, 3.0),
}


def unit_of(path: Path, code: int, is_metric: bool, segments: Floats, texts: Floats) -> tuple[float, str]:
    """Return the length of a unit of a drawing [m] and its source, or raise a MapError if none fits best.

    `code` is `$INSUNITS`, `is_metric` is `$MEASUREMENT`, `segments` (N, 2, 2) are the lines of the walls, `texts` (T,)
    the heights of texts. The header's unit is used unless one other fits the lengths much better.
    """
    lengths, header_m = lengths_of(segments, texts), _header_unit(code)
    misfits = {name: misfit(lengths, unit_m) + RARE.get(name, 0.0) for name, unit_m in UNITS_M.items()}
    best, second, *_ = sorted(misfits, key=misfits.__getitem__)
    unit_m, is_clear = UNITS_M[best], misfits[second] - misfits[best] >= UNIQUE_MARGIN
    extent, source = lengths["an extent"], f"$INSUNITS = {code} of the header"
    what = f"path = '{path}' has no unit ($INSUNITS = {code}), and walls of {extent:g} units"
    if header_m is not None:
        what = f"path = '{path}' has the unit {header_m:g} m ({source}), and with it {_described(lengths, header_m)}"
        excess = misfit(lengths, header_m) - misfits[best]
        is_possible = POSSIBLE_M[0] <= extent * header_m <= POSSIBLE_M[1]
        if is_possible and (excess < DOUBT or len(lengths) == 1):
            return header_m, source
        needed = DOUBT if is_metric and header_m in (0.0254, 0.3048) else MARGIN
        if is_possible and (excess < needed or not is_clear):
            message = f"{what}; in {best} it would have {_described(lengths, unit_m)}"
            warnings.warn(f"{message}: give unit_m, {header_m:g} or {unit_m:g}.", MapWarning, stacklevel=4)
            return header_m, source
    if not is_clear:
        remedy = "give unit_m, 0.001 if they are millimetres, 0.01 for centimetres, 1 for metres, 0.0254 for inches."
        raise MapError(f"{what}: {remedy}")
    which = "which are read as" if header_m is None else "so it is read in"
    message = f"{what}, {which} {best}, with {_described(lengths, unit_m)}: give unit_m, {unit_m:g} if that is right"
    message += "." if header_m is None else f", {header_m:g} for the unit of the header."
    warnings.warn(message, MapWarning, stacklevel=4)
    return unit_m, f"guess by {', '.join(lengths)}{'' if header_m is None else f', not {source}'}"


def misfit(lengths: dict[str, float], unit_m: float) -> float:
    found = 0.0
    for name, length in lengths.items():
        usual_m, factor, limit = SCALES[name]
        found += min((math.log(length * unit_m / usual_m) / math.log(factor)) ** 2, limit)
    return found


def lengths_of(segments: Floats, texts: Floats) -> dict[str, float]:
    low = segments.min(axis=(0, 1))
    extent = float(np.ptp(segments.reshape(-1, 2), axis=0).max())
    found = {"an extent": extent}
    if not extent > 0:
        return {"an extent": 1e-9}
    openings = rooms_of(*_raster((segments - low) / extent)).openings_m
    if len(openings):
        found["openings"] = float(np.median(openings)) * extent
    thickness = wall_thickness(segments)
    if thickness:
        found["walls"] = thickness
    gap = _usual_gap(segments, extent, 1.5 * thickness)
    if gap:
        found["gaps in walls"] = gap
    texts = texts[texts > 0]
    if len(texts):
        found["texts"] = float(np.median(texts))
    return found


def _header_unit(code: int) -> float | None:
    from ezdxf import units
    from ezdxf.enums import InsertUnits

    known = code in range(1, 25)
    return float(f"{units.conversion_factor(InsertUnits(code), InsertUnits.Meters):.9g}") if known else None


def _described(lengths: dict[str, float], unit_m: float) -> str:
    return ", ".join(f"{name} of {length * unit_m:.3g} m" for name, length in lengths.items())


def _raster(segments: Floats) -> tuple[Bools, float]:
    """Return the cells without lines (ny, nx), with a margin, and their size; the longer side of the plan is 1."""
    cell, margin = 1.0 / RASTER_CELLS, RASTER_CELLS // 10
    lines = segments / cell + margin
    nx, ny = (int(size) for size in np.ceil(lines.max(axis=(0, 1))) + margin)
    return ~crossed_cells(lines, (ny, nx), 1e-6), cell


def _longest(segments: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return direction (radians, in a half turn), offset and two ends along it of the longest lines, (N,)."""
    along = segments[:, 1] - segments[:, 0]
    chosen = np.argsort(-np.hypot(*along.T), kind="stable")[:MOST_LINES]
    along, start = along[chosen], segments[chosen, 0] - segments.mean(axis=(0, 1))
    angle = np.arctan2(along[:, 1], along[:, 0]) % np.pi
    angle[angle > np.pi - 1e-3] -= np.pi
    cosine, sine = np.cos(angle), np.sin(angle)
    offset = start[:, 1] * cosine - start[:, 0] * sine
    first = start[:, 0] * cosine + start[:, 1] * sine
    last = first + along[:, 0] * cosine + along[:, 1] * sine
    return angle, offset, np.minimum(first, last), np.maximum(first, last)


def wall_thickness(segments: Floats) -> float:
    """Return the usual distance between parallel neighbours, 0 for walls of single lines."""
    angle, offset, first, last = _longest(segments)
    length = last - first
    beside = np.minimum.outer(last, last) - np.maximum.outer(first, first) > 0.5 * np.minimum.outer(length, length)
    apart = np.abs(np.subtract.outer(offset, offset))
    parallel = np.abs(np.subtract.outer(angle, angle)) < 0.01
    apart[~(beside & parallel) | (apart < 1e-4 * np.ptp(segments))] = np.inf
    found = float(np.quantile(apart.min(axis=1), 0.4, method="lower"))
    return found if found < np.ptp(segments.reshape(-1, 2), axis=0).max() / 40 else 0.0


def _usual_gap(segments: Floats, extent: float, least: float) -> float:
    """Return the most frequent gap between collinear lines, 0 if there is none."""
    angle, offset, first, last = _longest(segments)
    line = np.stack([np.rint(angle / 0.01), np.rint(offset / (2e-4 * extent))], axis=1)
    _, group = np.unique(line, axis=0, return_inverse=True)
    order = np.lexsort((first, group.ravel()))
    shift = 10.0 * extent * group.ravel()[order]  # keeps the groups apart in the running maximum
    reached = np.maximum.accumulate(last[order] + shift)
    gaps = (first[order] + shift)[1:] - reached[:-1]
    gaps = gaps[(np.diff(shift) == 0) & (gaps > max(least, 1e-3 * extent)) & (gaps < extent / 5)]
    if not len(gaps):
        return 0.0
    near = np.abs(np.log(np.divide.outer(gaps, gaps))) < math.log(1.15)
    return float(np.median(gaps[near[np.argmax(near.sum(axis=1))]]))
