"""Topics of a robot to a LiveCoverage and back: their names, types and messages, and recordings of them."""

import os
import re
import time
from collections import ChainMap
from collections.abc import Container, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sionna_partial.apps.live.answers import LiveAnswer, LiveTransmitter, LiveViews
from sionna_partial.apps.live.coverage import LiveCoverage
from sionna_partial.checks import Checked, require
from sionna_partial.errors import MapError
from sionna_partial.maps.importers.bags import GRID, open_recording

MOST_FRAMES = 1000
"""Number of frames outside the robot's chain that are kept of each topic."""

GRID_TYPE, VIEWS_TYPE = "nav_msgs/msg/OccupancyGrid", "geometry_msgs/msg/PoseArray"

UPDATE_TYPE, CONNECTION_TYPE = "map_msgs/msg/OccupancyGridUpdate", "wireless_msgs/msg/Connection"
FILTER_TYPE = "nav2_msgs/msg/CostmapFilterInfo"
DEFINITIONS = {
    UPDATE_TYPE: "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data",
    CONNECTION_TYPE: (
        "float32 bitrate\nint16 txpower\nstring link_quality_raw\nfloat32 link_quality\nint16 signal_level\n"
        "int16 noise_level\nstring essid\nstring bssid\nfloat64 frequency"
    ),
    FILTER_TYPE: ("std_msgs/Header header\nuint8 type\nstring filter_mask_topic\nfloat32 base\nfloat32 multiplier"),
}
"""Definitions of messages that no type store has."""

POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"

KEEPOUT = 0
"""Type of nav2's keepout filter."""

TF_TYPE = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class Topics(Checked):
    """Names of topics.

    Parameters
    ----------
    map, prefix : str
        Topic of the map ("_updates" is added for its updates); prefix of published topics.
    robot_frame : str
        Frame of the robot in `/tf` and `/tf_static`.
    powers, connections : mapping
        Transmitter of each topic of `std_msgs/Float32` with received powers, and of `wireless_msgs/Connection`; None
        for a single one, or for the access point of a connection.
    key_values : str
        Topic of `diagnostic_msgs/KeyValue` with names of transmitters and powers; "" for none.
    unknown : bool
        Also publish the predictions for unknown cells, on the topic with the suffix "/unknown".

    Raises
    ------
    SettingsError
        For names that no topic can have.
    """

    map: str = "/map"
    prefix: str = "/radio"
    robot_frame: str = "base_link"
    powers: Mapping[str, str | None] = field(default_factory=dict)
    key_values: str = ""
    unknown: bool = False
    connections: Mapping[str, str | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        names = {"map": self.map, "prefix": self.prefix}
        for each in ("powers", "connections"):
            given = getattr(self, each)
            require(isinstance(given, Mapping), each, given, "give a mapping of topics to transmitters.")
            names |= {f"{each} {topic}": topic for topic in given}
        names |= {"key_values": self.key_values} if self.key_values else {}
        for name, topic in names.items():
            good = isinstance(topic, str) and re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", topic)
            require(bool(good), name, topic, "give the full name of a topic, such as /map.")
        require(bool(self.robot_frame), "robot_frame", self.robot_frame, "give a frame, such as base_link.")

    def types(self) -> dict[str, str]:
        """Return the message type of each subscribed topic."""
        types = {self.map: GRID_TYPE, f"{self.map}_updates": UPDATE_TYPE, "/tf": TF_TYPE, "/tf_static": TF_TYPE}
        types |= dict.fromkeys(self.powers, "std_msgs/msg/Float32") | dict.fromkeys(self.connections, CONNECTION_TYPE)
        types |= dict.fromkeys(filter(None, (self.key_values, self.transmitters)), "diagnostic_msgs/msg/KeyValue")
        return types | {f"{self.prefix}/request_views": "std_msgs/msg/Empty"}

    @property
    def transmitters(self) -> str:
        """Return the topic of `diagnostic_msgs/KeyValue` with positions of transmitters, see `Listener`."""
        return f"{self.prefix}/transmitters"

    def published(self, names: Mapping[str, object]) -> dict[str, str]:
        """Return the message type of each topic published for the named transmitters; None is to be located."""
        types = {f"{self.prefix}/next_views": VIEWS_TYPE}
        for name, position in names.items():
            topic = f"{self.prefix}/{name}"
            for grid in (topic, f"{topic}/unknown") if self.unknown else (topic,):
                types |= {grid: GRID_TYPE, f"{grid}/filter_info": FILTER_TYPE}
            types |= {f"{topic}/position": POSE_TYPE, f"{topic}/region": GRID_TYPE} if position is None else {}
        return types

    def messages(self, answer: LiveAnswer, sent: Container[str] = ()) -> dict[str, tuple[str, dict[str, Any]]]:
        """Return topic, message and type of each part of an answer.

        The first grid comes with its topic for nav2's keepout filter. The filter starts again with each such message,
        which is left out once it has been `sent`.
        """
        if isinstance(answer, LiveViews):
            return {f"{self.prefix}/next_views": (VIEWS_TYPE, answer.message())}
        topic = f"{self.prefix}/{answer.name}"
        if isinstance(answer, LiveTransmitter):
            region = GRID_TYPE, answer.region_message()
            return {f"{topic}/position": (POSE_TYPE, answer.message()), f"{topic}/region": region}
        messages = {topic: (GRID_TYPE, answer.message())}
        if self.unknown:
            messages[f"{topic}/unknown"] = GRID_TYPE, answer.message(unknown=True)
        for grid in [*messages]:
            if f"{grid}/filter_info" not in sent:
                info = {"header": answer.header, "type": KEEPOUT, "filter_mask_topic": grid}
                messages[f"{grid}/filter_info"] = FILTER_TYPE, info | {"base": 0.0, "multiplier": 1.0}
        return messages


class _Transform(NamedTuple):
    """Pose of a frame in its parent: rotation matrix and position [m]."""

    parent: str
    turn: NDArray[np.float64]
    position_m: NDArray[np.float64]


class Listener:
    """Passes messages of topics to a `LiveCoverage`.

    The value of a transmitter is "x y" or "x y z" [m]; an empty value removes it.
    """

    def __init__(self, live: LiveCoverage, topics: Topics) -> None:
        self.live, self.topics = live, topics
        for option in ("powers", "connections"):
            for topic, name in getattr(topics, option).items():
                finds = option == "connections" and not live.tx_m
                known = name in live.tx_m if name is not None else finds or len(live.tx_m) == 1
                remedy = f"name one of the transmitters {', '.join(live.tx_m)}."
                require(known, f"{option}[{topic!r}]", name, remedy)
        self._frames = ChainMap[str, _Transform]({}, {})  # of /tf and of /tf_static

    def take(self, topic: str, message: Any, time_s: float | None = None) -> None:
        """Take a message that arrived at `time_s`, by default now."""
        now_s, topics, live = time.monotonic() if time_s is None else time_s, self.topics, self.live
        try:
            if topic == topics.map:
                live.on_map(message)
            elif topic == f"{topics.map}_updates":
                live.on_map_update(message)
            elif topic in ("/tf", "/tf_static"):
                self._take_transforms(message, now_s, self._frames.maps[topic == "/tf_static"])
            elif topic in topics.powers:
                live.on_power(message.data, now_s, topics.powers[topic])
            elif topic in topics.connections:
                live.on_connection(message, now_s, topics.connections[topic])
            elif topic == topics.key_values:
                live.on_power(float(message.value), now_s, message.key)
            elif topic == topics.transmitters:
                live.on_transmitter(message.key, [*map(float, message.value.split())] or None)
            else:
                live.request_views()
        except Exception as error:  # messages may hold anything
            live.report(f"a message of {topic} is dropped ({type(error).__name__}: {error}).")

    def _take_transforms(self, message: Any, now_s: float, frames: MutableMapping[str, _Transform]) -> None:
        for each in message.transforms:
            turn, move = each.transform.rotation, each.transform.translation
            position_m = np.array([move.x, move.y, move.z], dtype=np.float64)
            quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64)
            child, parent = each.child_frame_id.lstrip("/"), each.header.frame_id.lstrip("/")
            if not np.isfinite([*position_m, *quaternion]).all() or not quaternion.any():
                raise ValueError(f"the transform from {parent!r} to {child!r} is not finite")
            frames.pop(child, None)  # the newest is the last
            frames[child] = _Transform(parent, Rotation.from_quat(quaternion).as_matrix(), position_m)
        position_m, frame, chain = np.zeros(3), self.topics.robot_frame.lstrip("/"), set[str]()
        while frame != self.live.frame and frame in self._frames and frame not in chain:
            chain.add(frame)
            frame, turn, origin_m = self._frames[frame]
            position_m = turn @ position_m + origin_m
        others = [name for name in frames if name not in chain] if len(frames) > MOST_FRAMES else []
        for name in others[:-MOST_FRAMES]:
            del frames[name]
        if frame == self.live.frame and chain & {each.child_frame_id.lstrip("/") for each in message.transforms}:
            self.live.on_pose(float(position_m[0]), float(position_m[1]), now_s)


def replay(listener: Listener, path: str | os.PathLike[str], rate: float = 0.0) -> None:
    """Replay a recording at `rate` times its speed; 0 waits for the answer to each map.

    Raises
    ------
    MapError
        For anything but an intact rosbag with the topic of the map.
    """
    with open_recording(path, MapError) as recording:
        recording.topic_of(listener.topics.map, (GRID,))
        start_s = time.monotonic()
        for message in recording.messages(*listener.topics.types()):
            if rate:
                time.sleep(max(0.0, start_s + message.time_s / rate - time.monotonic()))
            listener.take(message.topic, message.content, message.time_s)
            while not rate and listener.live.step():
                pass
