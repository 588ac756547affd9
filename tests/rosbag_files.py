"""Rosbags of a robot that drives along a line, written by the library rosbags as ROS 1, ROS 2 sqlite3 and mcap."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("drive.bag", "drive_sqlite3", "drive_mcap")
START_S = 1_700_000_000.0


class Messages:
    def __init__(self, ros: int) -> None:
        self.ros = ros
        self.types = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        if ros == 1:
            transforms = get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            self.types.register(transforms)

    def new(self, name: str, *values: Any) -> Any:
        package, kind = name.split("/")
        return self.types.types[f"{package}/msg/{kind}"](*values)

    def header(self, time_s: float, frame: str) -> Any:
        seconds = math.floor(time_s)
        stamp = self.new("builtin_interfaces/Time", seconds, round((time_s - seconds) * 1e9))
        return self.new("std_msgs/Header", *([0] if self.ros == 1 else []), stamp, frame)

    def pose(self, x: float, y: float, yaw: float) -> Any:
        point = self.new("geometry_msgs/Point", x, y, 0.0)
        turn = self.new("geometry_msgs/Quaternion", 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        return self.new("geometry_msgs/Pose", point, turn)

    def grid(
        self, cells: ArrayLike, origin: tuple[float, float, float] = (1.0, 2.0, 0.0), resolution_m: float = 0.5
    ) -> Any:
        data, header = np.array(cells, dtype=np.int8), self.header(START_S, "map")
        ny, nx = data.shape
        info = self.new("nav_msgs/MapMetaData", header.stamp, resolution_m, nx, ny, self.pose(*origin))
        return self.new("nav_msgs/OccupancyGrid", header, info, data.ravel())

    def pose_stamped(self, time_s: float, x: float, y: float, yaw: float, frame: str = "map") -> Any:
        return self.new("geometry_msgs/PoseStamped", self.header(time_s, frame), self.pose(x, y, yaw))

    def odometry(self, time_s: float, x: float, y: float, yaw: float) -> Any:
        pose = self.new("geometry_msgs/PoseWithCovariance", self.pose(x, y, yaw), np.zeros(36))
        vector = self.new("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        twist = self.new("geometry_msgs/Twist", vector, vector)
        twist = self.new("geometry_msgs/TwistWithCovariance", twist, np.zeros(36))
        return self.new("nav_msgs/Odometry", self.header(time_s, "odom"), "base_link", pose, twist)

    def transform(self, time_s: float, parent: str, child: str, x: float, y: float, yaw: float) -> Any:
        pose = self.pose(x, y, yaw)
        shift = self.new("geometry_msgs/Vector3", x, y, 0.0)
        transform = self.new("geometry_msgs/Transform", shift, pose.orientation)
        stamped = self.new("geometry_msgs/TransformStamped", self.header(time_s, parent), child, transform)
        return self.new("tf2_msgs/TFMessage", [stamped])

    def power(self, dbm: float) -> Any:
        return self.new("std_msgs/Float32", dbm)

    def stamped_power(self, time_s: float, dbm: float) -> Any:
        """A temperature, the simplest of the common messages with a stamp and a number."""
        return self.new("sensor_msgs/Temperature", self.header(time_s, "antenna"), dbm, 0.0)


def messages_of(name: str) -> Messages:
    return Messages(1 if name.endswith(".bag") else 2)


def write_bag(path: Path, rows: Sequence[tuple[str, float, Any]]) -> Path:
    """Write messages (topic, seconds since the start, message) as the kind of bag that the name of the path means."""
    maker = messages_of(path.name)
    if maker.ros == 1:
        writer: Any = Writer1(path)
    else:
        plugin = StoragePlugin.SQLITE3 if "sqlite3" in path.name else StoragePlugin.MCAP
        writer = Writer2(path, version=8, storage_plugin=plugin)
    links: dict[str, Any] = {}
    with writer:
        for topic, time_s, message in sorted(rows, key=lambda row: row[1]):
            kind = message.__msgtype__
            if topic not in links:
                links[topic] = writer.add_connection(topic, kind, typestore=maker.types)
            encode = maker.types.serialize_ros1 if maker.ros == 1 else maker.types.serialize_cdr
            writer.write(links[topic], round((START_S + time_s) * 1e9), encode(message, kind))
    return path


def write_drive(path: Path) -> Path:
    """Write the bag that the documentation reads: a map, ten poses along x, and as many powers."""
    make = messages_of(path.name)
    rows: list[tuple[str, float, Any]] = [("/map", 1.0, make.grid([[100, 0, 0, 100]] * 3))]
    for time_s in range(10):
        rows.append(("/amcl_pose", time_s, make.pose_stamped(START_S + time_s, 5.0 + 0.2 * time_s, 8.0, 0.0)))
        rows.append(("/rssi", time_s, make.power(-50.0)))
    return write_bag(path, rows)
