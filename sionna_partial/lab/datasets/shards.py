"""Folders of data sets: one Parquet shard per home, read as one LinkTable."""

import base64
import hashlib
import io
import json
import os
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.checks import is_whole, shown
from sionna_partial.errors import MapError, PredictorError
from sionna_partial.files import atomic_write, input_path, open_regular, read_bytes
from sionna_partial.lab.datasets.table import CIR, COLUMNS, LinkTable
from sionna_partial.maps.environment import layers_of
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkContext, LinkFeatures
from sionna_partial.prediction.map_networks import FEATURES, columns_of, features_of_columns
from sionna_partial.settings import Material

INDEX_FILE, SHARDS_FOLDER, FAILED_FOLDER = "dataset.json", "shards", "failed"

FORMAT = "sionna-partial links 4"

_MAX_LINKS, _MAX_CELLS, _MAX_BYTES = 10_000_000, 100_000_000, 4_000_000_000

_MAX_NAME_BYTES = 200
"""Length above which names are shortened for files [bytes]."""

_PREFIX = "sionna_partial."

_TYPES = {
    "home": pa.string(),
    "map_index": pa.int64(),
    **dict.fromkeys(("link_state", "partial_link_state"), pa.uint8()),
    **dict.fromkeys(("inside", "anywhere"), pa.bool_()),
}

_NAMES = (
    *COLUMNS[:2],
    *(f"{end}_{axis}_m" for end in ("tx", "rx") for axis in "xyz"),
    *(name for columns in FEATURES.values() for name in columns),
    "map_index",
    *COLUMNS[2:],
)


def _fields(cir_paths: int) -> list[pa.Field]:
    lists = dict.fromkeys(CIR, pa.list_(pa.float32(), cir_paths)) if cir_paths else {}
    types = {name: _TYPES.get(name, pa.float64()) for name in _NAMES} | lists
    return [pa.field(name, kind, nullable=False) for name, kind in types.items()]


def _columns(table: LinkTable) -> dict[str, Any]:
    context = table.context
    return {
        **{name: getattr(table, name) for name in COLUMNS},
        **{f"tx_{axis}_m": context.tx_m[:, index] for index, axis in enumerate("xyz")},
        **{f"rx_{axis}_m": context.rx_m[:, index] for index, axis in enumerate("xyz")},
        **columns_of(table.features),
        "map_index": table.map_index,
    }


def write_shard(table: LinkTable, path: str | os.PathLike[str], metadata: Mapping[str, object]) -> None:
    """Write links as a Parquet file, whole or not at all; equal links and metadata give equal bytes.

    Positions have a column per axis (`tx_x_m`); frequency, maps and `metadata` are JSON in the file's metadata.
    """
    maps = {
        "partial": [_packed(each) for each in table.maps],
        "complete": {name: _packed(home) for name, home in table.complete_maps.items()},
    }
    notes = {"format": FORMAT, "frequency_hz": table.features.frequency_hz, "maps": maps, **metadata}
    cir_paths = next((values.shape[1] for values in table.cir.values()), 0)
    notes |= {"cir_paths": cir_paths} if cir_paths else {}
    texts = {_PREFIX + name: json.dumps(notes[name], sort_keys=True) for name in sorted(notes)}
    schema, columns = pa.schema(_fields(cir_paths), metadata=texts), _columns(table)
    lists = {name: pa.FixedSizeListArray.from_arrays(values.ravel(), cir_paths) for name, values in table.cir.items()}
    values = [lists.get(each.name, pa.array(columns.get(each.name, []), type=each.type)) for each in schema]
    memory = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(values, schema=schema), memory, compression="zstd", write_page_checksum=True)
    with atomic_write(path) as stream:
        stream.write(memory.getvalue())


def read_shard(path: str | os.PathLike[str]) -> LinkTable:
    notes = shard_metadata(path)
    try:
        file = pq.ParquetFile(path, page_checksum_verification=True)
        if file.metadata.num_rows > _MAX_LINKS:
            raise PredictorError(f"path = '{path}' has more than {_MAX_LINKS:,} links: give a shard of one home.")
        table = file.read()
    except (OSError, pa.ArrowException) as error:
        raise _damaged(path, error) from error
    try:
        columns = {name: table[name].to_numpy() for name in _NAMES}
        lists = {name: table[name].combine_chunks().flatten().to_numpy() for name in table.column_names if name in CIR}
        cir = {name: values.reshape(table.num_rows, -1) for name, values in lists.items()}
        return _links_of(columns, notes, cir)
    except (KeyError, TypeError, ValueError, IndexError, zlib.error, MapError, PredictorError) as error:
        raise _damaged(path, error) from error


def shard_metadata(path: str | os.PathLike[str]) -> dict[str, object]:
    with open_regular(path, "path", PredictorError, _MAX_BYTES):
        pass
    try:
        schema = pq.read_schema(path)
        texts = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items()}
        notes = {key.removeprefix(_PREFIX): json.loads(text) for key, text in texts.items() if key.startswith(_PREFIX)}
    except (OSError, ValueError, RecursionError, pa.ArrowException) as error:
        raise _damaged(path, error) from error
    cir_paths = notes.get("cir_paths", 0)
    wanted = _fields(cir_paths) if is_whole(cir_paths) and cir_paths < _MAX_CELLS else []
    if notes.get("format") != FORMAT or [(each.name, each.type) for each in schema] != [
        (each.name, each.type) for each in wanted
    ]:
        raise PredictorError(
            f"path = '{path}' is no shard of this version ({FORMAT}): give a folder that `sionna-partial dataset` "
            "wrote, or build the data set again."
        )
    return notes


def read_dataset(folder: str | os.PathLike[str], homes: Iterable[str] | None = None) -> LinkTable:
    """Read the links of the built homes of a data set, in the order of its list of homes.

    Parameters
    ----------
    folder : path-like
        Folder from `build_dataset`.
    homes : iterable of str, optional
        Names of the homes to read, in this order; by default all.

    Returns
    -------
    LinkTable
        With `home`, `stage`, features `phi`, true `link_state` and `gain_db`, `inside` and `anywhere`.

    Raises
    ------
    PredictorError
        If the folder has no data set, a home is missing, or a shard is damaged.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> links = sp.lab.read_dataset("links")  # that build_dataset wrote
    >>> links.gain_db.shape
    (16,)
    """
    known = [home["name"] for home in read_index(folder)["homes"]]
    built = [name for name in known if shard_path(folder, name).is_file()]
    wanted = built if homes is None else list(homes) if isinstance(homes, Iterable) else [homes]
    if isinstance(homes, str) or not all(isinstance(name, str) for name in wanted):
        raise PredictorError(f"homes = {shown(homes)} is not allowed: give names of homes, or None for all.")
    missing = [name for name in wanted if name not in built]
    if missing:
        raise PredictorError(f"home {missing[0]!r} is not in '{folder}': choose from {_few(built)}.")
    if not wanted:
        raise PredictorError(f"folder = '{folder}' has no home yet: run `sionna-partial dataset` again until it has.")
    return LinkTable.concatenate(read_shard(shard_path(folder, name)) for name in wanted)


def read_index(folder: str | os.PathLike[str]) -> dict[str, Any]:
    remedy = "give a folder that `sionna-partial dataset` wrote."
    path = input_path(folder, "folder", PredictorError, remedy) / INDEX_FILE
    if not os.path.exists(path):
        raise PredictorError(
            f"folder = '{folder}' is no data set, it has no {INDEX_FILE}: give a folder that `sionna-partial dataset` "
            "wrote."
        )
    try:
        index: dict[str, Any] = json.loads(read_bytes(path, "path", PredictorError, _MAX_BYTES))
        if not all(isinstance(home["name"], str) for home in index["homes"]):
            raise TypeError("names of homes are not text")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise PredictorError(f"'{path}' is damaged ({error!r}): build the data set again in a new folder.") from error
    return index


def shard_path(folder: str | os.PathLike[str], name: str) -> Path:
    return Path(folder) / SHARDS_FOLDER / f"{file_stem(name)}.parquet"


def file_stem(name: str) -> str:
    """Return the name of a home; a long name is cut, with its hash at the end."""
    content = name.encode(errors="surrogateescape")
    if len(content) <= _MAX_NAME_BYTES:
        return name
    return f"{content[:150].decode(errors='ignore')}-{hashlib.sha256(content).hexdigest()[:16]}"


def _links_of(columns: dict[str, Any], notes: Any, cir: Mapping[str, Floats]) -> LinkTable:
    positions = {
        f"{end}_m": np.column_stack([columns.pop(f"{end}_{axis}_m") for axis in "xyz"]) for end in ("tx", "rx")
    }
    maps, map_index = tuple(_unpacked(each) for each in notes["maps"]["partial"]), columns.pop("map_index")
    found = features_of_columns(columns)
    of_context = {name: found.pop(name) for name in [*found] if name in LinkContext.__dataclass_fields__}
    traced = {name: found[name] for name in ("link_state", "unobserved_distance_m")}
    context = LinkContext.on_maps(maps, map_index, **traced, **of_context, **positions)
    table = {name: columns[name] for name in COLUMNS if name != "home"}
    home = columns["home"].astype(np.str_)
    complete_maps = {name: _unpacked(each) for name, each in notes["maps"]["complete"].items()}
    phi = LinkFeatures(**found, context=context, frequency_hz=notes["frequency_hz"])
    shared: dict[str, Any] = {"maps": maps, "map_index": map_index, "complete_maps": complete_maps, "cir": cir}
    return LinkTable(home=home, features=phi, **shared, **table)


def _packed(partial: PartialMap) -> dict[str, object]:
    material: dict[str, object] = {} if partial.material is None else {"material": asdict(partial.material)}
    for name, (cells, counted, values) in partial.layers().items():
        material |= {name: _deflated(cells), counted: values}
    return {
        "shape": list(partial.shape),
        "cells": _deflated(partial.state),
        "resolution_m": partial.resolution_m,
        "origin_m": list(partial.origin_m),
        "wall_height_m": partial.wall_height_m,
        "interior_cells": partial.interior_cells,
        **material,
    }


def _deflated(cells: NDArray[np.uint8]) -> str:
    return base64.b64encode(zlib.compress(cells.tobytes(), 9)).decode()


def _unpacked(entry: Any) -> PartialMap:
    rows, columns = map(int, entry["shape"])
    if not 0 < rows * columns <= _MAX_CELLS:
        raise PredictorError(f"a map of {rows:,} x {columns:,} cells is more than {_MAX_CELLS:,}")

    def inflated(text: str) -> NDArray[np.uint8]:
        cells = zlib.decompressobj().decompress(base64.b64decode(text), rows * columns + 1)
        return np.frombuffer(cells, dtype=np.uint8).reshape(rows, columns)

    rest = {name: entry[name] for name in ("resolution_m", "wall_height_m", "interior_cells")}
    if "material" in entry:
        rest["material"] = Material(**entry["material"])
    layers = layers_of(entry, inflated, list)
    return PartialMap(inflated(entry["cells"]), origin_m=tuple(entry["origin_m"]), **rest, **layers)


def _damaged(path: str | os.PathLike[str], error: Exception) -> PredictorError:
    reason = str(error).strip().partition("\n")[0]
    return PredictorError(
        f"'{path}' is damaged, or no Parquet file ({reason}): delete it and run `sionna-partial dataset` again, "
        "which builds what is missing."
    )


def _few(names: list[str]) -> str:
    listed = ", ".join(map(repr, names[:5])) or "nothing, no home has been built"
    return listed + (f" and {len(names) - 5} more" if len(names) > 5 else "")
