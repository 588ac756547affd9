"""Maps of vacuum robots: ValetudoMap JSON, alone, packed for MQTT, or in a recording of Valeronoi -> PartialMap."""

from __future__ import annotations

import base64
import json
import os
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats, Indices
from sionna_partial.checks import number_of, real_array, shown
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError, SionnaPartialError, one_line
from sionna_partial.files import read_bytes
from sionna_partial.maps.environment import MAX_CELLS, MAX_WALL_MATERIALS, ImportNotes
from sionna_partial.maps.partial_map import PartialMap

MAX_BYTES = 200_000_000

CENTIMETRES = 100.0
"""Units of `size`, `pixelSize` and positions in a metre."""

STATES = {"floor": CellState.FREE, "segment": CellState.FREE, "wall": CellState.WALL}
"""States of cells by type of layer; walls replace floor."""

_GIVE = "give a map in the JSON of Valetudo (__class ValetudoMap), or a recording of Valeronoi (.vwm) with its map"
_COLUMNS = {"pixels": 2, "compressedPixels": 3}


class VacuumFrame(NamedTuple):
    """Frame of a ValetudoMap, with y down, in world axes from the lower-left corner."""

    size_y_m: float
    pixel_m: float

    def world_m(self, points_cm: ArrayLike) -> Floats:
        """Return x and y [m] of positions (N, 2) of the file [cm]."""
        x, y = np.asarray(points_cm, dtype=np.float64).reshape(-1, 2).T / CENTIMETRES
        return np.column_stack([x, self.size_y_m - y])


def read_json(
    path: str | os.PathLike[str], field: str, error: type[SionnaPartialError]
) -> tuple[dict[str, Any], dict[str, Any], VacuumFrame]:
    """Return the content of a JSON file, its ValetudoMap and its frame."""
    content = _inflated(read_bytes(path, field, error, MAX_BYTES))
    try:
        raw = json.loads(content)
    except (ValueError, RecursionError) as cause:
        reason = " ".join(str(cause).split())[:200]
        raise error(f"{field} = '{path}' is damaged or no JSON ({reason}): export it again.") from cause
    found = raw.get("map", raw) if isinstance(raw, dict) else raw
    if not isinstance(found, dict) or found.get("__class") != "ValetudoMap":
        raise error(f"{field} = '{path}' holds no ValetudoMap: {_GIVE}.")
    size = found.get("size")
    lengths_cm = {"size.y": size.get("y") if isinstance(size, dict) else size, "pixelSize": found.get("pixelSize")}
    for name, value in lengths_cm.items():
        if not 0.1 <= number_of(value) <= 1e6:
            raise error(f"{path}: {name} = {shown(value)} is not allowed: give a length in centimetres.")
    return raw, found, VacuumFrame(*(number_of(value) / CENTIMETRES for value in lengths_cm.values()))


def _inflated(content: bytes) -> bytes:
    """Return the JSON of a message over MQTT, which Valetudo packs by zlib, and some brokers in base64."""
    packed = content
    if content.strip()[:2] in (b"eJ", b"eN", b"eA", b"eF"):  # the first byte of zlib, 0x78
        with suppress(ValueError):
            packed = base64.b64decode(b"".join(content.split()), validate=True)
    if packed[:1] != b"\x78":
        return content
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(packed, MAX_BYTES)
    except zlib.error:
        return content
    return found if unpacker.eof else content


def read_vacuum_map(path: Path) -> PartialMap:
    """Read the ValetudoMap in a JSON file or in a recording of Valeronoi.

    Floor and segments are free, cells in no layer are unknown. Segments are the rooms of the map.
    """
    _, raw, frame = read_json(path, "path", MapError)
    size = f"pixelSize of the map, {CENTIMETRES * frame.pixel_m:g} cm"
    notes = ImportNotes(path, 1 / CENTIMETRES, f"format; {size}")
    layers = [_Layer.of(path, number, layer) for number, layer in enumerate(_listed(path, "layers", raw.get("layers")))]
    used = [layer for layer in layers if layer.kind in STATES and len(layer.cells)]
    if not any(STATES[layer.kind] == CellState.FREE for layer in used):
        found = ", ".join(sorted({layer.kind for layer in layers})) or "none"
        raise MapError(
            f"{path}: layers has no pixels of a floor or a segment ({found}): let the robot map a room first."
        )
    corners = np.array([end for layer in used for end in (layer.cells.min(axis=0), layer.cells.max(axis=0))])
    (left, top), (right, bottom) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    nx, ny = right - left + 1, bottom - top + 1
    if nx * ny > MAX_CELLS:
        raise MapError(f"{path}: layers span {nx} x {ny} pixels, more than {MAX_CELLS:,}: export the map again.")
    state, room = np.full((ny, nx), CellState.UNKNOWN, np.uint8), np.zeros((ny, nx), np.uint8)
    names = [*dict.fromkeys(layer.name for layer in used if layer.kind == "segment")][:MAX_WALL_MATERIALS]
    for layer in sorted(used, key=lambda layer: STATES[layer.kind]):
        where = bottom - layer.cells[:, 1], layer.cells[:, 0] - left
        state[where] = STATES[layer.kind]
        if layer.kind == "segment" and layer.name in names:
            room[where] = names.index(layer.name) + 1
    for layer in layers:
        name = f"segment '{layer.name}'" if layer.kind == "segment" else layer.kind
        notes.skip(name, len(layer.cells), "" if layer.kind in STATES else "no floor, segment or wall")
    _note_entities(path, raw.get("entities"), frame, notes)
    origin_m = left * frame.pixel_m, frame.size_y_m - (bottom + 1) * frame.pixel_m
    rooms: dict[str, Any] = {"room": room, "room_names": tuple(names)} if names else {}
    return notes.attached_to(PartialMap(state, frame.pixel_m, origin_m, **rooms))


class _Layer(NamedTuple):
    kind: str
    name: str
    cells: Indices

    @classmethod
    def of(cls, path: Path, number: int, raw: Any) -> _Layer:
        where = f"layers[{number}]"
        if not isinstance(raw, dict) or not isinstance(raw.get("type"), str):
            raise MapError(
                f"{path}: {where} = {shown(raw)} is not allowed: give a layer with a type, as Valetudo writes."
            )
        data = raw.get("metaData")
        data = data if isinstance(data, dict) else {}
        name = data.get("name") or f"room {data.get('segmentId', number)}"
        name = one_line(str(name)[:80])
        parts = [_whole(path, f"{where}.{key}", raw.get(key) or [], count) for key, count in _COLUMNS.items()]
        pixels, (x, y, length) = parts[0], parts[1].T
        if len(length) and not (length.min() >= 1 and length.sum() <= MAX_CELLS):
            what = f"{where}.compressedPixels has lengths of {length.min()} to {length.max()}"
            raise MapError(f"{path}: {what}: give rows of [x, y, length] with lengths from 1 to {MAX_CELLS:,} in all.")
        run = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
        runs = np.column_stack([np.repeat(x, length) + run, np.repeat(y, length)])
        return cls(raw["type"], name, np.concatenate([pixels, runs]))


def _whole(path: Path, name: str, values: Any, columns: int) -> Indices:
    remedy = f"give whole numbers from 0 to {MAX_CELLS:,}, {columns} for each pixel or row"
    array = real_array(f"{path}: {name}", values, MapError, f"{remedy}.", "iu" if values != [] else "iuf")
    if array.ndim != 1 or array.size % columns:
        raise MapError(f"{path}: {name} has shape {array.shape}: {remedy}.")
    if array.size and not (array.min() >= 0 and array.max() <= MAX_CELLS):
        raise MapError(f"{path}: {name} has values from {array.min()} to {array.max()}: {remedy}.")
    return array.astype(np.intp).reshape(-1, columns)


def _listed(path: Path, name: str, value: Any) -> Sequence[Any]:
    if not isinstance(value, list):
        raise MapError(f"{path}: {name} = {shown(value)} is not allowed: {_GIVE}.")
    return value


def _note_entities(path: Path, entities: Any, frame: VacuumFrame, notes: ImportNotes) -> None:
    listed = [entity for entity in _listed(path, "entities", entities or []) if isinstance(entity, Mapping)]
    for kind, count in Counter(str(entity.get("type"))[:80] for entity in listed).items():
        notes.skip(kind, count, "no part of the building")
    for entity in listed:
        points = entity.get("points")
        if entity.get("type") == "charger_location" and isinstance(points, list) and len(points) == 2:
            x, y = frame.world_m([[number_of(value) for value in points]])[0]
            notes.notes.append(f"charger at ({x:z.2f}, {y:z.2f}) m")
