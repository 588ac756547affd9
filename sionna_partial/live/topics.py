"""Topics of a robot: which method of a LiveCoverage takes each message, and where the robot is by its transforms."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sionna_partial.live.coverage import LiveCoverage, LiveGrid, LiveViews

MOST_FRAMES = 1000
"""Number of frames of a robot that are kept."""

GRID_TYPE, VIEWS_TYPE = "nav_msgs/msg/OccupancyGrid", "geometry_msgs/msg/PoseArray"
"""Types of what is published."""

UPDATE_TYPE = "map_msgs/msg/OccupancyGridUpdate"
UPDATE_TEXT = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data"
"""Definition of the one message that no type store has."""

TF_TYPE = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class Topics:
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
    """

    map: str = "/map"
    prefix: str = "/radio"
    robot_frame: str = "base_link"
    powers: Mapping[str, str | None] = field(default_factory=dict)
    key_values: str = ""

    def types(self) -> dict[str, str]:
        """Return the message type of each topic that is listened to."""
        types = {self.map: GRID_TYPE, f"{self.map}_updates": UPDATE_TYPE, "/tf": TF_TYPE, "/tf_static": TF_TYPE}
        types |= dict.fromkeys(self.powers, "std_msgs/msg/Float32")
        types |= {self.key_values: "diagnostic_msgs/msg/KeyValue"} if self.key_values else {}
        return types | {f"{self.prefix}/request_views": "std_msgs/msg/Empty"}

    def published(self, names: Mapping[str, object]) -> dict[str, str]:
        """Return the message type of each topic that is published for transmitters of these names."""
        return {f"{self.prefix}/{name}": GRID_TYPE for name in names} | {f"{self.prefix}/next_views": VIEWS_TYPE}

    def topic_of(self, answer: LiveGrid | LiveViews) -> str:
        """Return where an answer is published."""
        return f"{self.prefix}/{answer.name if isinstance(answer, LiveGrid) else 'next_views'}"


class _Transform(NamedTuple):
    """Pose of a frame in its parent: rotation matrix and position [m]."""

    parent: str
    turn: NDArray[np.float64]
    position_m: NDArray[np.float64]


class Listener:
    """Hands the messages of topics to a `LiveCoverage`, whatever they hold."""

    def __init__(self, live: LiveCoverage, topics: Topics) -> None:
        self.live, self.topics = live, topics
        self._frames: dict[str, _Transform] = {}

    def take(self, topic: str, message: Any, time_s: float | None = None) -> None:
        """Take a message that came at `time_s`, now by default."""
        now_s, topics, live = time.monotonic() if time_s is None else time_s, self.topics, self.live
        try:
            if topic == topics.map:
                live.on_map(message)
            elif topic == f"{topics.map}_updates":
                live.on_map_update(message)
            elif topic in ("/tf", "/tf_static"):
                self._take_transforms(message, now_s)
            elif topic in topics.powers:
                live.on_power(message.data, now_s, topics.powers[topic])
            elif topic == topics.key_values:
                live.on_power(float(message.value), now_s, message.key)
            else:
                live.request_views()
        except Exception as error:  # messages may hold anything
            live.report(f"a message of {topic} is dropped ({type(error).__name__}: {error}).")

    def _take_transforms(self, message: Any, now_s: float) -> None:
        for each in message.transforms:
            turn, move = each.transform.rotation, each.transform.translation
            position_m = np.array([move.x, move.y, move.z], dtype=np.float64)
            quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64)
            child, parent = each.child_frame_id.lstrip("/"), each.header.frame_id.lstrip("/")
            if not np.isfinite([*position_m, *quaternion]).all() or not quaternion.any():
                raise ValueError(f"the transform from {parent!r} to {child!r} is not finite")
            if child in self._frames or len(self._frames) < MOST_FRAMES:
                self._frames[child] = _Transform(parent, Rotation.from_quat(quaternion).as_matrix(), position_m)
        position_m, frame, passed = np.zeros(3), self.topics.robot_frame, set[str]()
        while frame != self.live.frame and frame in self._frames and frame not in passed:
            passed.add(frame)
            frame, turn, origin_m = self._frames[frame]
            position_m = turn @ position_m + origin_m
        if frame == self.live.frame and passed & {each.child_frame_id.lstrip("/") for each in message.transforms}:
            self.live.on_pose(float(position_m[0]), float(position_m[1]), now_s)
