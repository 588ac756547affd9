"""ROS messages and recordings: OccupancyGrids as maps, and rosbags of ROS 1 and 2 (.bag, .mcap, .db3, folders)."""

import math
import os
import re
import sqlite3
import struct
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.checks import number_of, shown
from sionna_partial.constants import BAG_SUFFIXES, DEFAULT_WALL_HEIGHT_M
from sionna_partial.errors import MapError, SionnaPartialError
from sionna_partial.files import decoding, input_path, open_regular
from sionna_partial.maps.environment import MAX_CELLS, ImportNotes, grid_array, turn_grid
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.ros_map import fitted_threshold, states_from_percent
from sionna_partial.resources import optional_packages

MAX_BAG_BYTES = 10**12
"""Largest recording [bytes]; only requested messages are read."""

MAX_MESSAGE_BYTES = MAX_CELLS + 100_000

MAX_CHUNK_BYTES = 2 * 10**9

_MCAP_MAGIC, _MCAP_SCHEMA, _MCAP_CHUNK = b"\x89MCAP0\r\n", 3, 6

MAX_TILT_RAD = 0.01

OCCUPIED_PERCENT, FREE_PERCENT = 65, 25
"""Occupancy from which a cell is wall, and up to which it is free (defaults of nav2's map_saver) [percent]."""

GRID = "OccupancyGrid"


class Message(NamedTuple):
    """A message: seconds since the start of the recording, the header's stamp (or None), content and topic."""

    time_s: float
    stamp_s: float | None
    content: Any
    topic: str


class Recording:
    """An open rosbag; errors of its reader become `error`s that name the path."""

    def __init__(self, path: Path, reader: Any, error: type[SionnaPartialError]) -> None:
        self.path, self.error, self._reader = path, error, reader

    @property
    def kinds(self) -> dict[str, str]:
        return {link.topic: link.msgtype.rpartition("/")[2] for link in self._reader.connections}

    @property
    def duration_s(self) -> float:
        return self._reader.duration / 1e9 if self._reader.message_count else 0.0

    def topic_of(self, given: str | None, kinds: tuple[str, ...], usual: str = "") -> str:
        """Return a topic of one of several message types: the given, the usual, or the only one."""
        topics = [topic for topic, kind in self.kinds.items() if not kinds or kind in kinds]
        if given is None and (usual in topics or len(topics) == 1):
            return usual if usual in topics else topics[0]
        if given in topics:
            return str(given)
        wanted = " or ".join(kinds) or "message"
        what = f"has {len(topics)} {wanted} topics" if given is None else f"has no {wanted} topic {shown(given)}"
        found = ", ".join(f"{name} ({kind})" for name, kind in sorted(self.kinds.items())[:30]) or "none"
        raise self.error(f"path = '{self.path}' {what}: name one of its topics: {found}.")

    def messages(self, *topics: str, until_s: float = math.inf) -> Iterator[Message]:
        for each in self.raw(*topics, until_s=until_s):
            yield self.decoded(*each)

    def raw(self, *topics: str, until_s: float = math.inf) -> Iterator[tuple[float, bytes, str, str]]:
        links = [link for link in self._reader.connections if link.topic in topics]
        start = self._reader.start_time
        stop = None if until_s > self.duration_s else start + round(until_s * 1e9) + 1
        for link, time_ns, raw in self._reader.messages(links, stop=stop) if links else ():
            yield (time_ns - start) / 1e9, raw, link.msgtype, link.topic

    def decoded(self, time_s: float, raw: bytes, kind: str, topic: str) -> Message:
        if len(raw) > MAX_MESSAGE_BYTES:
            size = f"a {kind} of {len(raw):,} bytes, more than {MAX_MESSAGE_BYTES:,}"
            raise self.error(f"path = '{self.path}' holds {size}: record a coarser map.")
        content = self._reader.deserialize(raw, kind)
        stamp = getattr(getattr(content, "header", None), "stamp", None)
        return Message(time_s, None if stamp is None else stamp.sec + stamp.nanosec / 1e9, content, topic)


@contextmanager
def _plain_storage(files: Iterable[Path]) -> Iterator[None]:
    """Raise a ValueError for storage that its reader cannot handle: SQLite views, huge MCAP chunks and arrays."""
    for file in files:
        if file.suffix == ".db3":
            with closing(sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)) as database:
                if database.execute("SELECT 1 FROM sqlite_master WHERE type = 'view'").fetchone():
                    raise ValueError("it has views in place of tables")
        if file.suffix == ".mcap":
            with file.open("rb") as stream:
                _require_plain_mcap(stream)
    yield


def _require_plain_mcap(stream: IO[bytes]) -> None:
    stream.seek(len(_MCAP_MAGIC))
    while len(head := stream.read(9)) == 9:
        kind, length = struct.unpack("<BQ", head)
        if kind == _MCAP_SCHEMA:
            schema = stream.read(min(length, MAX_MESSAGE_BYTES))
            largest = max(map(int, re.findall(rb"\[(?:<=)?(\d{1,20})\]", schema)), default=0)
            if largest > MAX_MESSAGE_BYTES:
                raise ValueError(f"it describes messages with arrays of {largest:,} values")
            length -= len(schema)
        if kind == _MCAP_CHUNK:
            (unpacked,) = struct.unpack("<16xQ", stream.read(24))
            if unpacked > MAX_CHUNK_BYTES:
                raise ValueError(f"it has a chunk of {unpacked:,} bytes")
            length -= 24
        stream.seek(length, os.SEEK_CUR)


@contextmanager
def open_recording(path: str | os.PathLike[str], error: type[SionnaPartialError]) -> Iterator[Recording]:
    with optional_packages(error):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    source = input_path(path, "path", error, f"give a rosbag ({', '.join(BAG_SUFFIXES)}, or a folder).")
    files = [*source.iterdir()] if os.path.isdir(source) else [source]
    for file in files:
        open_regular(file, "path", error, MAX_BAG_BYTES).close()
        if file.suffix == ".db3" and {*"%?#"} & {*str(file)}:  # its reader takes the name for a URI
            raise error(f"path = '{file}' has one of the characters % ? # in it: rename it.")
    store = Stores.ROS1_NOETIC if source.suffix.lower() == ".bag" else Stores.LATEST
    remedy = "record it again, or repair it with rosbag reindex (ROS 1) or ros2 bag reindex."
    with (
        decoding(source, "no rosbag", error, remedy),
        _plain_storage(files),
        AnyReader([source], default_typestore=get_typestore(store)) as reader,
    ):
        yield Recording(source, reader, error)


def map_from_bag(path: str | os.PathLike[str], *, topic: str | None = None, time_s: float | None = None) -> PartialMap:
    """Read a map from a rosbag of ROS 1 (.bag) or ROS 2 (.mcap, .db3, or a folder), without ROS.

    Parameters
    ----------
    path : path-like
    topic : str or None
        A topic of `nav_msgs/OccupancyGrid`; by default `/map`, or the only one.
    time_s : float or None
        Seconds since the start of the recording: the last map up to then, by default the last of all.

    Raises
    ------
    MapError
        If the file is not a rosbag, is damaged, or has no such topic or map.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.importers.map_from_bag("drive.bag").bounds_m  # of a recording of yours
    (1.0, 2.0, 3.0, 3.5)
    """
    limit = math.inf if time_s is None else number_of(time_s)
    if not limit >= 0:
        raise MapError(f"time_s = {shown(time_s)} is not allowed: give seconds since the start of the recording.")
    with open_recording(path, MapError) as recording:
        name, last = recording.topic_of(topic, (GRID,), "/map"), None
        for message in recording.raw(name, until_s=limit):
            last = message
        if last is None:
            first_s = next((time for time, *_ in recording.raw(name)), math.inf)
            what = "is empty" if first_s == math.inf else f"has its first map {first_s:g} s after the start"
            given = "" if time_s is None else f" up to time_s = {limit:g}"
            remedy = "name another topic." if first_s == math.inf else "give a later time_s."
            raise MapError(f"path = '{recording.path}' has no map{given}: topic {name} {what}: {remedy}")
        grid = recording.decoded(*last).content
        try:
            partial = map_from_occupancy(grid)
            assert partial.import_source is not None
            return replace(partial, import_source=replace(partial.import_source, file=str(recording.path)))
        except MapError as error:
            raise MapError(f"path = '{recording.path}', topic {name}: {error}") from error


def map_from_occupancy(
    data: Any,
    resolution_m: float | None = None,
    *,
    origin_m: tuple[float, float] | None = None,
    wall_height_m: float = DEFAULT_WALL_HEIGHT_M,
    occupied_percent: float | None = None,
    free_percent: float | None = None,
) -> PartialMap:
    """Make a map from a ROS `nav_msgs/OccupancyGrid`: the message itself, or its array.

    Parameters
    ----------
    data : OccupancyGrid or (height, width) integers
        Any object with `info` and `data` of the message (rclpy, rospy, rosbags), or an array: percent, and -1 (or 255)
        for unknown. Row 0 holds the smallest y, as in ROS.
    resolution_m, origin_m, wall_height_m
        As of `map_from_array`. A message has its own resolution and origin, whose yaw is applied as in `load_map`.
    occupied_percent, free_percent : float or None
        From the first value a cell is wall; up to the second it is free. By default 65 and 25, as in nav2's map_saver,
        or, for continuous values as of Cartographer, one fitted threshold, with a `MapWarning`.

    Raises
    ------
    MapError
        For other values, a number out of range, or an origin that is not level.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.importers.map_from_occupancy([[100, 100], [0, -1]], 0.05).state.tolist()
    [[1, 1], [0, 2]]
    """
    yaw = 0.0
    if hasattr(data, "info") and hasattr(data, "data"):
        if resolution_m is not None or origin_m is not None:
            raise MapError("resolution_m and origin_m are those of the message: leave them out.")
        data, resolution_m, (x, y, yaw) = occupancy_parts(data)
        origin_m = (x, y)
    elif resolution_m is None:
        raise MapError("resolution_m is missing: give the edge of a cell in metres, or an OccupancyGrid message.")
    corner_m = (0.0, 0.0) if origin_m is None else origin_m
    return map_of_percent(data, resolution_m, corner_m, yaw, wall_height_m, occupied_percent, free_percent)


def map_of_percent(
    data: ArrayLike,
    resolution_m: float,
    origin_m: tuple[float, float],
    yaw: float,
    wall_height_m: float = DEFAULT_WALL_HEIGHT_M,
    occupied_percent: float | None = None,
    free_percent: float | None = None,
) -> PartialMap:
    """Make a map from percent, x and y of the lower-left corner [m], and the yaw [rad]."""
    values = grid_array("data", data, "iu")
    outside = ((values < -1) | (values > 100)) & (values != 255)
    if outside.any():
        raise MapError(f"data holds {values[outside][0]}: give -1 for unknown, or the occupancy in percent, 0 to 100.")
    is_given = free_percent is not None or occupied_percent is not None
    free_percent = FREE_PERCENT if free_percent is None else free_percent
    occupied_percent = OCCUPIED_PERCENT if occupied_percent is None else occupied_percent
    free, occupied = number_of(free_percent), number_of(occupied_percent)
    if not 0 <= free < occupied <= 100 or occupied <= 1:
        given = f"free_percent = {shown(free_percent)} and occupied_percent = {shown(occupied_percent)}"
        raise MapError(f"{given} are not allowed: give 0 <= free_percent < occupied_percent <= 100, such as 25 and 65.")
    notes = ImportNotes("data", 1.0, "resolution_m")
    count = np.bincount(values[(values >= 0) & (values <= 100)], minlength=101)
    remedy = "" if is_given else "Give free_percent and occupied_percent to choose others."
    found = fitted_threshold(np.arange(101.0), count, free, occupied, notes, remedy)
    free, occupied = (free, occupied) if found is None else (found, found)
    state = states_from_percent(values, occupied, free)
    partial = PartialMap(state, resolution_m, origin_m, wall_height_m)
    if yaw:
        turned = turn_grid(partial.state, partial.resolution_m, (*partial.origin_m, yaw))
        partial = PartialMap(*turned, wall_height_m)
    return notes.attached_to(partial)


def occupancy_parts(message: Any) -> tuple[NDArray[Any], float, tuple[float, float, float]]:
    """Return cells (height, width), their edge, and x, y and yaw of the origin."""
    try:
        info, origin = message.info, message.info.origin
        size, resolution_m = (int(info.height), int(info.width)), number_of(info.resolution)
        x, y = number_of(origin.position.x), number_of(origin.position.y)
        quaternion = np.array([number_of(getattr(origin.orientation, name)) for name in "xyzw"])
        cells = np.asarray(message.data)
    except (AttributeError, TypeError, ValueError) as error:
        raise MapError(f"data is no OccupancyGrid ({error}): give one with info and data, or an array.") from error
    if min(size) < 1:
        raise MapError(f"info has {size[0]} x {size[1]} cells: give a map with cells.")
    if cells.ndim != 1 or len(cells) != size[0] * size[1]:
        raise MapError(f"data has {cells.size} values for {size[0]} x {size[1]} cells: give the whole message.")
    length = float(np.linalg.norm(quaternion))
    qx, qy, qz, qw = quaternion / length if length else (0.0, 0.0, 0.0, 1.0)  # many leave it at zero
    if not 2 * math.hypot(qx, qy) <= MAX_TILT_RAD:
        raise MapError(f"info.origin.orientation = {shown(quaternion.tolist())} is not level: give a yaw alone.")
    return cells.reshape(size), resolution_m, (x, y, 2 * math.atan2(qz, qw))
