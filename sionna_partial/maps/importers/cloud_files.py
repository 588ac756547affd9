"""Point cloud files (PCD, PLY, LAS, LAZ, XYZ, PTS) -> parts of x, y, z."""

from __future__ import annotations

import io
import itertools
import os
import re
import struct
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.constants import POINT_SUFFIXES
from sionna_partial.errors import MapError
from sionna_partial.files import decoding, open_regular

MAX_CLOUD_BYTES = 20_000_000_000
"""Largest point cloud [bytes]; `MAX_WHOLE_BYTES` for PCD and PLY, which are read as a whole."""

MAX_WHOLE_BYTES = 2_000_000_000

PART, PART_BYTES = 1_000_000, 32_000_000
"""Points, and bytes of text, that are read at a time."""

MAX_FIELDS, MAX_HEADER_LINES = 1000, 100
"""Most values of a point, and most lines of the header, of a PCD."""


Parts: TypeAlias = Callable[[], Iterable[NDArray[Any]]]
"""Function that yields the points (N, 3) of a cloud in parts, from the first."""


@contextmanager
def opened_cloud(path: Path) -> Iterator[Parts]:
    """Open a point cloud, and return its parts; errors of its decoder become MapErrors."""
    kind = path.suffix.lower().removeprefix(".")
    reader = {"las": _las, "laz": _las, "pcd": _pcd, "ply": _ply}.get(kind, _text)
    most = MAX_WHOLE_BYTES if kind in ("pcd", "ply") else MAX_CLOUD_BYTES
    if f".{kind}" not in (*POINT_SUFFIXES, ".ply"):
        raise MapError(f"path = '{path}' is no point cloud: give one of {', '.join(POINT_SUFFIXES)}, .ply.")
    with (
        open_regular(path, "path", MapError, most, "thin it out, or save it as LAZ.") as stream,
        decoding(path, f"no {kind.upper()}", MapError),
    ):

        def parts() -> Iterator[Floats]:
            stream.seek(0)
            return reader(stream)

        yield parts


def is_cloud(path: Path) -> bool:
    """Return whether a PLY has no faces."""
    with open_regular(path, "path", MapError, MAX_CLOUD_BYTES) as stream:
        header, end, _ = stream.read(100_000).partition(b"end_header")
    if end and re.search(rb"^element\s+tristrips\s+[1-9]", header, re.MULTILINE):
        remedy = "save it with faces, such as by MeshLab or Blender."
        raise MapError(f"path = '{path}' holds triangle strips, which are not read: {remedy}")
    return bool(end) and re.search(rb"^element\s+face\s+[1-9]", header, re.MULTILINE) is None


def _las(stream: IO[bytes]) -> Iterator[Floats]:
    import laspy  # type: ignore[import-untyped]

    _require_records(stream)
    with laspy.open(stream, closefd=False, laz_backend=laspy.LazBackend.Lazrs) as reader:
        count, header = 0, reader.header
        if header.are_points_compressed:
            _require_chunks(stream, header.offset_to_point_data, header.point_count)
        for part in reader.chunk_iterator(PART):
            count += len(part)
            yield np.column_stack([part.x, part.y, part.z])
        _require_count(count, header.point_count)


def _require_records(stream: IO[bytes]) -> None:
    """Raise a ValueError for a LAS that announces more variable length records than fit."""
    header, size = stream.read(247).ljust(247, b"\0"), os.fstat(stream.fileno()).st_size
    points_at, records = struct.unpack_from("<II", header, 96)
    extended = struct.unpack_from("<I", header, 243)[0] if header[25] >= 4 else 0
    if records * 54 > points_at or extended * 60 > size:
        raise ValueError(f"it announces {records} and {extended} variable length records, more than it holds")
    stream.seek(0)


def _require_chunks(stream: IO[bytes], start: int, points: int) -> None:
    """Raise a ValueError for a LAZ with a wrong chunk table: lazrs would exhaust the memory and abort."""
    here, size = stream.tell(), os.fstat(stream.fileno()).st_size
    stream.seek(start)
    (table,) = struct.unpack("<q", stream.read(8))
    if table == -1:  # written at the end, by those who cannot seek
        stream.seek(size - 8)
        (table,) = struct.unpack("<q", stream.read(8))
    stream.seek(table)
    _, chunks = struct.unpack("<II", stream.read(8))
    if chunks > min(points, size - table):
        raise ValueError(f"its table has {chunks} chunks for {points} points")
    stream.seek(here)


def _pcd(stream: IO[bytes]) -> Iterator[Floats]:
    from pypcd4.pypcd4 import MetaData, PointCloud

    lines = [""]
    while len(lines) < MAX_HEADER_LINES and not lines[-1].startswith("DATA"):
        lines.append(stream.readline(1000).decode("ascii").strip())
    header = MetaData.parse_header([line for line in lines if line and not line.startswith("#")])
    if sum(header.count) > MAX_FIELDS:
        raise ValueError(f"it announces {sum(header.count)} values for each point")
    size = header.points * header.build_dtype().itemsize
    inside = os.fstat(stream.fileno()).st_size
    if header.data.value.startswith("binary_") or header.data.value == "binaryscompressed":
        size, inside = int(np.frombuffer(stream.read(8), "<u4")[1]), size
    if size > (inside if header.data.value != "ascii" else MAX_WHOLE_BYTES) or size > MAX_WHOLE_BYTES:
        raise ValueError(f"it announces {header.points} points, more than it holds")
    stream.seek(0)
    cloud = PointCloud.from_fileobj(stream)  # type: ignore[arg-type]
    data = np.atleast_1d(cloud.pc_data)
    _require_count(len(data), header.points)
    for start in range(0, len(data), PART):
        yield np.column_stack([data[axis][start : start + PART] for axis in "xyz"]).astype(np.float64)


def _ply(stream: IO[bytes]) -> Iterator[Floats]:
    import trimesh

    header, _, _ = stream.read(100_000).partition(b"end_header")
    found = re.search(rb"^element\s+vertex\s+(\d+)", header, re.MULTILINE)
    count = int(found[1]) if found else 0
    if count > os.fstat(stream.fileno()).st_size:
        raise ValueError(f"it announces {count} points, more than it holds")
    stream.seek(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damage ends in an error
        vertices = np.asarray(trimesh.load(stream, file_type="ply", process=False).vertices)
    _require_count(len(vertices), count)
    for start in range(0, len(vertices), PART):
        yield vertices[start : start + PART]


def _text(stream: IO[bytes]) -> Iterator[Floats]:
    """Yield the first three columns, after a header or a number of points."""
    separator, first, announced, count = None, True, None, 0
    while block := stream.read(PART_BYTES):
        block += stream.readline(10_000)
        if block[-1:] not in b"\r\n":
            raise ValueError("it ends without a line end and may be cut: copy it again, or add a line end")
        if first:
            lines = block.splitlines(keepends=True)
            start = next((n for n, line in enumerate(lines[:50]) if _columns(line) >= 3), None)
            if start is None:
                raise ValueError("no line has three numbers")
            announced = next((int(line) for line in lines[:start] if line.strip().isdigit()), None)
            separator = next((mark for mark in ",;" if mark.encode() in lines[start]), None)
            block, first = b"".join(lines[start:]), False
        if block.strip():
            points = np.loadtxt(io.BytesIO(block), delimiter=separator, usecols=(0, 1, 2), ndmin=2)
            count += len(points)
            yield points
    if announced is not None:
        _require_count(count, announced)


def _columns(line: bytes) -> int:
    words = re.split(rb"[\s,;]+", line.strip())
    return sum(1 for _ in itertools.takewhile(lambda word: re.fullmatch(rb"[-+]?[\d.]+([eE][-+]?\d+)?", word), words))


def _require_count(count: int, announced: int) -> None:
    if count != announced:
        raise ValueError(f"it announces {announced} points, and has {count}")
