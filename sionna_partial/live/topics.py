"""Topics of a robot: which method of a LiveCoverage takes each message, and where the robot is by its transforms."""

import re
import time
from collections import ChainMap
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sionna_partial.checks import Checked, require
from sionna_partial.live.coverage import LiveCoverage, LiveGrid, LiveViews

MOST_FRAMES = 1000
"""Number of frames outside the robot's chain that are kept, the newest ones of `/tf` and of `/tf_static`."""

GRID_TYPE, VIEWS_TYPE = "nav_msgs/msg/OccupancyGrid", "geometry_msgs/msg/PoseArray"
"""Types of what is published."""

UPDATE_TYPE = "map_msgs/msg/OccupancyGridUpdate"
UPDATE_TEXT = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data"
"""Definition of the one message that no type store has."""

TF_TYPE = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class Topics(Checked):
    """Names of topics.

    Parameters
    ----------
    map, prefix : str
        Topic of the map, to which "_updates" is added for its updates; what published topics begin with.
    robot_frame : str
        Frame of the robot, whose position in the map is read from `/tf` and `/tf_static`.
    powers : mapping
        Topics of `std_msgs/Float32` with received powers, and the transmitter of each; None where there is one alone.
    key_values : str
        Topic of `diagnostic_msgs/KeyValue` with the name of a transmitter and its power; "" for none.
    unknown : bool
        Whether the predictions for cells that the map does not know are published, with "/unknown" behind the topic.

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

    def __post_init__(self) -> None:
        super().__post_init__()
        require(isinstance(self.powers, Mapping), "powers", self.powers, "give a mapping of topics to transmitters.")
        names = {"map": self.map, "prefix": self.prefix, **{f"powers {name}": name for name in self.powers}}
        names |= {"key_values": self.key_values} if self.key_values else {}
        for name, topic in names.items():
            good = isinstance(topic, str) and re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", topic)
            require(bool(good), name, topic, "give the full name of a topic, such as /map.")
        require(bool(self.robot_frame), "robot_frame", self.robot_frame, "give a frame, such as base_link.")

    def types(self) -> dict[str, str]:
        """Return the message type of each topic that is listened to."""
        types = {self.map: GRID_TYPE, f"{self.map}_updates": UPDATE_TYPE, "/tf": TF_TYPE, "/tf_static": TF_TYPE}
        types |= dict.fromkeys(self.powers, "std_msgs/msg/Float32")
        types |= dict.fromkeys(filter(None, (self.key_values, self.transmitters)), "diagnostic_msgs/msg/KeyValue")
        return types | {f"{self.prefix}/request_views": "std_msgs/msg/Empty"}

    @property
    def transmitters(self) -> str:
        """Topic of `diagnostic_msgs/KeyValue` with the name and the position of a transmitter: see `Listener`."""
        return f"{self.prefix}/transmitters"

    def published(self, names: Mapping[str, object]) -> dict[str, str]:
        """Return the message type of each topic that is published for transmitters of these names."""
        ends = ("", "/unknown") if self.unknown else ("",)
        grids = {f"{self.prefix}/{name}{end}": GRID_TYPE for name in names for end in ends}
        return grids | {f"{self.prefix}/next_views": VIEWS_TYPE}

    def messages(self, answer: LiveGrid | LiveViews) -> dict[str, tuple[str, dict[str, Any]]]:
        """Return the messages of an answer by topic, each with its type."""
        if isinstance(answer, LiveViews):
            return {f"{self.prefix}/next_views": (VIEWS_TYPE, answer.message())}
        topic = f"{self.prefix}/{answer.name}"
        unknown = {f"{topic}/unknown": (GRID_TYPE, answer.message(unknown=True))} if self.unknown else {}
        return {topic: (GRID_TYPE, answer.message())} | unknown


class _Transform(NamedTuple):
    """Pose of a frame in its parent: rotation matrix and position [m]."""

    parent: str
    turn: NDArray[np.float64]
    position_m: NDArray[np.float64]


class Listener:
    """Hands the messages of topics to a `LiveCoverage`, whatever they hold.

    The value of a transmitter is its position, "x y" or "x y z" [m]; an empty value removes it.
    """

    def __init__(self, live: LiveCoverage, topics: Topics) -> None:
        self.live, self.topics = live, topics
        for topic, name in topics.powers.items():
            known = name in live.tx_m if name is not None else len(live.tx_m) == 1
            remedy = f"name one of the transmitters {', '.join(live.tx_m)}."
            require(known, f"powers[{topic!r}]", name, remedy)
        self._frames = ChainMap[str, _Transform]({}, {})  # of /tf and of /tf_static

    def take(self, topic: str, message: Any, time_s: float | None = None) -> None:
        """Take a message that came at `time_s`, now by default."""
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
