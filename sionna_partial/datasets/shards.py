"""LinkTable <-> Parquet: one shard for each home of a data set."""

import base64
import io
import json
import os
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sionna_partial.datasets.link_table import LinkTable
from sionna_partial.errors import MapError, PredictorError
from sionna_partial.files import atomic_write
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.link_context import ATTENUATION_LENGTHS_M, LinkContext
from sionna_partial.settings import Material

INDEX_FILE, SHARDS_FOLDER, FAILED_FOLDER = "dataset.json", "shards", "failed"
"""What a data set's folder holds: its settings and homes, a shard for each home, a note for each home that failed."""

FORMAT = "sionna-partial links 2"
"""Name and version of the shards' format, in their metadata."""

_PREFIX = "sionna_partial."


@dataclass(frozen=True)
class _Column:
    """A column of a shard: its name and type in the file, and where it comes from."""

    name: str
    kind: pa.DataType
    values: Callable[[LinkTable], NDArray[np.generic]]


def _position(field: str, axis: int) -> _Column:
    name = f"{field.removesuffix('_m')}_{'xyz'[axis]}_m"
    return _Column(name, pa.float64(), lambda table: getattr(table.context, field)[:, axis])


def _indirect_gain(index: int) -> _Column:
    return _Column(_INDIRECT[index], pa.float64(), lambda table: table.context.indirect_gain_db[:, index])


def _of_context(name: str, kind: pa.DataType) -> _Column:
    return _Column(name, kind, lambda table: getattr(table.context, name))


def _of_table(name: str, kind: pa.DataType) -> _Column:
    return _Column(name, kind, lambda table: getattr(table, name))


def _of_features(name: str, field: str, kind: pa.DataType) -> _Column:
    return _Column(name, kind, lambda table: getattr(table.features, field))


_INDIRECT = [f"indirect_gain_reach_{reach:g}_m_db" for reach in ATTENUATION_LENGTHS_M]

_FEATURES = {
    "partial_link_state": "link_state",
    "partial_gain_db": "gain_db",
    "unobserved_distance_m": "unobserved_distance_m",
    "distance_m": "distance_m",
}

_COLUMNS = (
    _of_table("home", pa.string()),
    _of_table("stage", pa.float64()),
    *(_position(field, axis) for field in ("tx_m", "rx_m") for axis in range(3)),
    *(
        _of_features(name, field, pa.uint8() if field == "link_state" else pa.float64())
        for name, field in _FEATURES.items()
    ),
    *(_indirect_gain(index) for index in range(len(ATTENUATION_LENGTHS_M))),
    _of_context("strongest_unobserved_m", pa.float64()),
    _of_table("map_index", pa.int64()),
    _of_table("link_state", pa.uint8()),
    _of_table("gain_db", pa.float64()),
    *(_of_table(name, pa.bool_()) for name in ("inside", "anywhere")),
    _of_table("observed_fraction", pa.float64()),
)


def write_shard(table: LinkTable, path: str | os.PathLike[str], metadata: Mapping[str, object]) -> None:
    """Write links as a Parquet file, whole or not at all. Equal links and metadata give equal bytes.

    Columns are named as in `LinkTable`, with the unit behind the name; positions have a column for each axis
    (`tx_x_m`), and the link state and the gain of the partial trace are `partial_link_state` and `partial_gain_db`. The
    maps are in the file's metadata; `map_index` says on which of them a link was traced.

    Parameters
    ----------
    table : LinkTable
    path : path-like
    metadata : mapping of str to what JSON can hold
        Kept in the file's metadata, each value as JSON under `sionna_partial.` and its name.

    Raises
    ------
    OutputError
        If writing fails; no half a file is left.
    """
    maps = {
        "partial": [_packed(each) for each in table.maps],
        "complete": {name: _packed(home) for name, home in table.complete_maps.items()},
    }
    notes = {"format": FORMAT, "maps": maps, **metadata}
    texts = {_PREFIX + name: json.dumps(notes[name], sort_keys=True) for name in sorted(notes)}
    schema = pa.schema([pa.field(column.name, column.kind, nullable=False) for column in _COLUMNS], metadata=texts)
    values = [pa.array(column.values(table), type=column.kind) for column in _COLUMNS]
    memory = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(values, schema=schema), memory, compression="zstd", write_page_checksum=True)
    with atomic_write(path) as stream:
        stream.write(memory.getvalue())


def read_shard(path: str | os.PathLike[str]) -> LinkTable:
    """Read the links of a shard.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    LinkTable

    Raises
    ------
    PredictorError
        If there is no such file, or it is damaged, or no shard.
    """
    notes = shard_metadata(path)
    try:
        table = pq.ParquetFile(path, page_checksum_verification=True).read()
    except (OSError, pa.ArrowException) as error:
        raise _damaged(path, error) from error
    columns = {name: table[name].to_numpy() for name in table.column_names}
    try:
        return _links_of(columns, notes["maps"])
    except (KeyError, TypeError, ValueError, IndexError, zlib.error, MapError, PredictorError) as error:
        raise _damaged(path, error) from error


def shard_metadata(path: str | os.PathLike[str]) -> dict[str, object]:
    """Read what `write_shard` noted beside the links, without the links.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    dict

    Raises
    ------
    PredictorError
        If there is no such file, or its end is damaged, or it is no shard.
    """
    if not Path(path).is_file():
        raise PredictorError(f"path = '{path}' is not there: give a shard of a data set.")
    try:
        schema = pq.read_schema(path)
        texts = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items()}
        notes = {key.removeprefix(_PREFIX): json.loads(text) for key, text in texts.items() if key.startswith(_PREFIX)}
        names = schema.names
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _damaged(path, error) from error
    expected = pa.schema([(column.name, column.kind) for column in _COLUMNS])
    alike = names == expected.names and schema.types == expected.types
    if notes.get("format") != FORMAT or not alike:
        raise PredictorError(
            f"path = '{path}' is no shard of this version ({FORMAT}): give a folder that `sionna-partial dataset` "
            "wrote, or build the data set again."
        )
    return notes


def read_dataset(folder: str | os.PathLike[str], homes: Iterable[str] | None = None) -> LinkTable:
    """Read the links of a data set, home by home in the order of its list of homes.

    Homes that failed, or have not been built yet, are left out.

    Parameters
    ----------
    folder : path-like
        A folder that `build_dataset` wrote.
    homes : iterable of str, optional
        Names of the homes to read, in this order; by default all that there are.

    Returns
    -------
    LinkTable

    Raises
    ------
    PredictorError
        If the folder holds no data set, a home is not in it, or a shard is damaged.
    """
    index = Path(folder) / INDEX_FILE
    try:
        known = [home["name"] for home in json.loads(index.read_text(encoding="utf-8"))["homes"]]
    except FileNotFoundError as error:
        raise PredictorError(
            f"folder = '{folder}' is no data set, it has no {INDEX_FILE}: give a folder that `sionna-partial dataset` "
            "wrote."
        ) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PredictorError(f"'{index}' is damaged ({error}): build the data set again in a new folder.") from error
    built = [name for name in known if shard_path(folder, name).is_file()]
    wanted = built if homes is None else list(homes)
    missing = [name for name in wanted if name not in built]
    if missing:
        raise PredictorError(f"home {missing[0]!r} is not in '{folder}': choose from {_few(built)}.")
    if not wanted:
        raise PredictorError(f"folder = '{folder}' has no home yet: run `sionna-partial dataset` again until it has.")
    return LinkTable.concatenate(read_shard(shard_path(folder, name)) for name in wanted)


def shard_path(folder: str | os.PathLike[str], name: str) -> Path:
    """Return the path of a home's shard in a data set."""
    return Path(folder) / SHARDS_FOLDER / f"{name}.parquet"


def _links_of(columns: dict[str, Any], notes: Any) -> LinkTable:
    positions = {
        f"{end}_m": np.column_stack([columns.pop(f"{end}_{axis}_m") for axis in "xyz"]) for end in ("tx", "rx")
    }
    maps, map_index = tuple(_unpacked(each) for each in notes["partial"]), columns.pop("map_index")
    features = {field: columns.pop(name) for name, field in _FEATURES.items()}
    context = LinkContext.on_maps(
        maps,
        map_index,
        link_state=features["link_state"],
        unobserved_distance_m=features["unobserved_distance_m"],
        indirect_gain_db=np.column_stack([columns.pop(name) for name in _INDIRECT]),
        strongest_unobserved_m=columns.pop("strongest_unobserved_m"),
        **positions,
    )
    home = columns.pop("home").astype(np.str_)
    complete_maps = {name: _unpacked(each) for name, each in notes["complete"].items()}
    known = {"features": LinkFeatures(**features, context=context), "maps": maps, "map_index": map_index}
    return LinkTable(home=home, complete_maps=complete_maps, **known, **columns)


def _packed(partial: PartialMap) -> dict[str, object]:
    """Return a floor plan as JSON has it, its cells deflated."""
    material = {} if partial.material is None else {"material": asdict(partial.material)}
    cells = base64.b64encode(zlib.compress(partial.state.tobytes(), 9)).decode()
    return {
        "shape": list(partial.shape),
        "cells": cells,
        "resolution_m": partial.resolution_m,
        "origin_m": list(partial.origin_m),
        "wall_height_m": partial.wall_height_m,
        "interior_cells": partial.interior_cells,
        **material,
    }


def _unpacked(entry: Any) -> PartialMap:
    cells = np.frombuffer(zlib.decompress(base64.b64decode(entry["cells"])), dtype=np.uint8)
    rest = {name: entry[name] for name in ("resolution_m", "wall_height_m", "interior_cells")}
    material = Material(**entry["material"]) if "material" in entry else None
    return PartialMap(cells.reshape(entry["shape"]), origin_m=tuple(entry["origin_m"]), material=material, **rest)


def _damaged(path: str | os.PathLike[str], error: Exception) -> PredictorError:
    reason = str(error).strip().partition("\n")[0]
    return PredictorError(
        f"'{path}' is damaged, or no Parquet file ({reason}): delete it and run `sionna-partial dataset` again, "
        "which builds what is missing."
    )


def _few(names: list[str]) -> str:
    shown = ", ".join(map(repr, names[:5])) or "nothing, no home has been built"
    return shown + (f" and {len(names) - 5} more" if len(names) > 5 else "")
