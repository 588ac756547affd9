"""Rosbags: poses of the robot, and received powers as measurements."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from sionna_partial.checks import number_of, shown
from sionna_partial.constants import BAG_SUFFIXES, DEFAULT_HEIGHT_M
from sionna_partial.errors import MeasurementError
from sionna_partial.files import is_path
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.importers.bags import GRID, Message, Recording, open_recording
from sionna_partial.measurements.measurements import Measurements, load_measurements, measurements_of

if TYPE_CHECKING:
    import xarray as xr

TF, _STATIC, _POWERS = "TFMessage", "_static", "Float32"

POSES = ("PoseWithCovarianceStamped", "PoseStamped", "Odometry")

ROBOT_FRAMES = ("base_link", "base_footprint")
"""Usual names of a robot's frame (REP 105)."""


class _Track(NamedTuple):
    """Poses of one frame in another: N times [s], x, y, z [m] (N, 3), N rotations; topics of transforms."""

    parent: str
    time_s: NDArray[np.float64]
    position_m: NDArray[np.float64]
    rotation: Rotation
    topics: tuple[str, ...] = ()

    def at(self, time_s: NDArray[np.float64]) -> _Track:
        """Interpolate; beyond the ends the pose stays."""
        position_m = np.column_stack([np.interp(time_s, self.time_s, axis) for axis in self.position_m.T])
        if len(self.time_s) == 1:
            return _Track(self.parent, time_s, position_m, self.rotation[np.zeros(len(time_s), int)])
        inside_s = np.clip(time_s, self.time_s[0], self.time_s[-1])
        return _Track(self.parent, time_s, position_m, Slerp(self.time_s, self.rotation)(inside_s))


def poses_from_bag(path: str | os.PathLike[str], *, topic: str | None = None, frame: str | None = None) -> xr.Dataset:
    """Read the robot's poses from a rosbag.

    Parameters
    ----------
    path : path-like
    topic : str or None
        Topic of PoseStamped, PoseWithCovarianceStamped or Odometry, or of transforms: of `/robot2/tf` and
        `/robot2/tf_static` alone for `/robot2/tf`. By default transforms from map to robot, else the first topic of
        these types.
    frame : str or None
        Frame of the transforms, such as an antenna's; default `base_link`, or `base_footprint`.

    Returns
    -------
    xarray.Dataset
        On `time`: `time_s` since the start, `position_m` (time, 3) in the map's frame [m], and `yaw_rad`. Odometry
        without a transform to the map drifts, and raises a `MapWarning`.

    Raises
    ------
    MeasurementError
        If the file is no intact rosbag, or has no such poses.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> poses = sp.importers.poses_from_bag("drive.bag")  # a recording of yours
    >>> poses.position_m[0].to_numpy().tolist()
    [5.0, 8.0, 0.0]
    """
    with open_recording(path, MeasurementError) as recording:
        track = _robot_track(recording, topic, frame, stamped=False)
    return _pose_table(track)


def measurements_from_bag(
    path: str | os.PathLike[str],
    topic: str | None = None,
    tx: ArrayLike | None = None,
    *,
    tx_power_dbm: float,
    field: str = "data",
    pose_topic: str | None = None,
    frame: str | None = None,
    rx_height_m: float = DEFAULT_HEIGHT_M,
) -> xr.Dataset:
    """Read received powers from a rosbag as a table of measurements.

    Receivers are at the robot's poses, interpolated to the stamps of the powers, or the recording times if there are
    none. Powers outside the time of the poses and powers that are not finite are left out.

    Parameters
    ----------
    path : path-like
        A .bag, .mcap, .db3, or folder.
    topic : str, optional
        Topic of the received powers [dBm], by default the only one of `std_msgs/Float32`.
    tx : (3,) array-like, optional
        Transmitter [m]; NaN in the table if unknown.
    tx_power_dbm : float
        Received power without path loss: transmit power and antenna gains less cable losses [dBm].
    field : str
        Field of the messages, by default as in `std_msgs/Float32`.
    pose_topic, frame : str or None
        As `topic` and `frame` of `poses_from_bag`.
    rx_height_m : float
        Height of the receiving antenna [m].

    Returns
    -------
    xarray.Dataset
        On `link`: `tx_x`, `tx_y`, `tx_z`, `rx_x`, `rx_y`, `rx_z` [m], `gain_db`, and `time_s` since the start.
        `.to_dataframe().to_csv("measured.csv")` writes a CSV.

    Raises
    ------
    MeasurementError
        If the file is no intact rosbag, has no such powers or poses, or the gains are invalid.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> powers = sp.importers.measurements_from_bag("drive.bag", "/rssi", tx=(7.0, 9.8, 1.5), tx_power_dbm=20.0)
    >>> powers.gain_db.max().item()
    -70.0
    """
    import xarray as xr

    for name, value, unit in (("tx_power_dbm", tx_power_dbm, "dBm"), ("rx_height_m", rx_height_m, "metres")):
        if not math.isfinite(number_of(value)):
            raise MeasurementError(f"{name} = {shown(value)} is not allowed: give a number of {unit}.")
    with open_recording(path, MeasurementError) as recording:
        topic = recording.topic_of(topic, () if topic else (_POWERS,))
        messages = [*recording.messages(topic)]
        powers = np.array([_power(each, field, topic) for each in messages])
        stamped = bool(messages) and all(each.stamp_s for each in messages)
        track = _robot_track(recording, pose_topic, frame, stamped=stamped)
        start_s = (messages[0].stamp_s or 0.0) - messages[0].time_s if stamped else 0.0
    times_s = np.array([each.stamp_s if stamped else each.time_s for each in messages], dtype=np.float64)
    first_s, last_s = track.time_s[[0, -1]]
    used = np.isfinite(powers) & (times_s >= first_s) & (times_s <= last_s)
    if not used.any():
        span = f"{times_s.min():.1f} to {times_s.max():.1f} s" if len(times_s) else "none"
        what = f"{len(powers)} powers ({span}), none of them finite and within the poses"
        raise MeasurementError(
            f"path = '{path}', topic {topic} has {what} ({first_s:.1f} to {last_s:.1f} s): name another topic."
        )
    if not used.all():
        message = f"path = '{path}': {int((~used).sum())} of {len(used)} powers are not finite or without a pose"
        warnings.warn(f"{message}; they are left out.", MapWarning, stacklevel=2)
    rx = track.at(times_s[used]).position_m
    rx[:, 2] = rx_height_m
    measured = Measurements(tx, rx, powers[used] - tx_power_dbm)  # type: ignore[arg-type]
    columns = {f"{end}_{axis}": getattr(measured, end)[:, at] for end in ("tx", "rx") for at, axis in enumerate("xyz")}
    columns |= {"gain_db": measured.gain_db, "time_s": times_s[used] - start_s}
    return xr.Dataset({name: ("link", values) for name, values in columns.items()})


def load_survey(path: str | os.PathLike[str], tx: Any = None, **options: Any) -> Measurements:
    """Read powers of a rosbag's only topic of them, or any file of `load_measurements` with its options."""
    if not is_path(path) or not (Path(path).suffix.lower() in BAG_SUFFIXES or Path(path).is_dir()):
        return load_measurements(path, tx=tx, **options)
    given = [name for name, value in options.items() if value is not None]
    if given or isinstance(tx, Mapping):
        name = given[0] if given else "tx of several"
        raise MeasurementError(f"{name} is not for a rosbag ('{path}'), which has one transmitter: leave it out.")
    return measurements_of(measurements_from_bag(path, tx=tx, tx_power_dbm=0.0))


def _pose_table(track: _Track) -> xr.Dataset:
    import xarray as xr

    x, y, z, w = track.rotation.as_quat().T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    variables = {"position_m": (("time", "axis"), track.position_m), "yaw_rad": ("time", yaw)}
    return xr.Dataset(variables, {"time_s": ("time", track.time_s), "axis": [*"xyz"]}, {"frame_id": track.parent})


def _power(message: Message, field: str, topic: str) -> float:
    names = [name for name in dir(message.content) if not name.startswith("_")]
    try:
        return float(reduce(getattr, field.split("."), message.content))  # type: ignore[arg-type]
    except (AttributeError, TypeError, ValueError) as error:
        raise MeasurementError(
            f"field = {shown(field)} is no number in the messages of {topic}: give one of {', '.join(names)}."
        ) from error


def _robot_track(recording: Recording, topic: str | None, frame: str | None, *, stamped: bool) -> _Track:
    kinds, target = recording.kinds, _map_frame(recording)
    links = _transforms(recording, _transform_topics(kinds, topic), stamped=stamped)
    frames = [frame] if frame else [name for name in ROBOT_FRAMES if name in links]
    if kinds.get(topic or "", TF) == TF:
        for name in frames:
            chain = _chain(recording, links, name, target)
            if chain:
                return _composed(chain)
        if topic is not None or frame is not None:
            known = ", ".join(sorted({*links, *(link.parent for link in links.values())})[:30]) or "none"
            what = f"no transform leads from {target!r} to {' or '.join(map(repr, frames or ROBOT_FRAMES))}"
            raise MeasurementError(f"path = '{recording.path}': {what}; its frames are {known}: name one as frame.")
    if topic is None:
        found = (name for kind in POSES for name in sorted(kinds) if kinds[name] == kind and "goal" not in name)
        topic = next(found, None)
    track = _pose_track(recording, recording.topic_of(topic, POSES), stamped=stamped)
    chain = _chain(recording, links, track.parent, target)
    if track.parent != target and not chain:
        message = f"path = '{recording.path}': poses of {topic} are in the frame {track.parent!r}, and no transform"
        warnings.warn(f"{message} leads to {target!r}; they are taken as they are.", MapWarning, stacklevel=4)
    return _composed([track, *chain])


def _map_frame(recording: Recording) -> str:
    grids = [topic for topic, kind in recording.kinds.items() if kind == GRID]
    first = next(recording.messages(*sorted(grids, key="/map".__ne__)[:1]), None)
    return _frame(first.content.header.frame_id if first else "") or "map"


def _frame(name: str) -> str:
    return name.lstrip("/")


def _pose_track(recording: Recording, topic: str, *, stamped: bool) -> _Track:
    rows, parent = [], "map"
    for message in recording.messages(topic):
        pose = message.content.pose
        pose = getattr(pose, "pose", pose)
        parent = _frame(message.content.header.frame_id)
        rows.append((message.stamp_s if stamped else message.time_s, pose.position, pose.orientation))
    if not rows:
        raise MeasurementError(f"path = '{recording.path}' has no message on {topic}: name another topic.")
    return _track(parent, rows)


def _transform_topics(kinds: Mapping[str, str], topic: str | None) -> list[str]:
    """Return the topics of transforms that belong to a topic of poses: its own, its namespace's, or all."""
    every = [name for name, kind in kinds.items() if kind == TF]
    own = topic if topic in every else f"{(topic or '').rpartition('/')[0]}/tf"
    named = [name for name in every if name in (own, f"{own}{_STATIC}")]
    return named if topic is not None and own in named else every


def _transforms(recording: Recording, topics: Sequence[str], *, stamped: bool) -> dict[str, _Track]:
    rows: dict[tuple[str, str], list[Any]] = {}
    sources: dict[tuple[str, str], dict[str, None]] = {}
    for message in recording.messages(*topics):
        for each in message.content.transforms:
            stamp = each.header.stamp
            time_s = stamp.sec + stamp.nanosec / 1e9 if stamped else message.time_s
            key = _frame(each.child_frame_id), _frame(each.header.frame_id)
            rows.setdefault(key, []).append((time_s, each.transform.translation, each.transform.rotation))
            sources.setdefault(key, {})[message.topic.removesuffix(_STATIC)] = None
    return {key[0]: _track(key[1], each)._replace(topics=(*sources[key],)) for key, each in rows.items()}


def _track(parent: str, rows: Iterable[Any]) -> _Track:
    """Sort poses by time, without repeated times."""
    table = np.array([(time, p.x, p.y, p.z, q.x, q.y, q.z, q.w) for time, p, q in rows], dtype=np.float64)
    table = table[np.isfinite(table).all(axis=1)]
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    if not len(table):
        raise MeasurementError("the recording has no finite pose: name another topic.")
    quaternion = table[:, 4:]
    quaternion[~quaternion.any(axis=1), 3] = 1.0
    return _Track(parent, table[:, 0], table[:, 1:4], Rotation.from_quat(quaternion))


def _chain(recording: Recording, links: Mapping[str, _Track], frame: str, target: str) -> list[_Track]:
    chain: list[_Track] = []
    while frame != target:
        if frame not in links or len(chain) > len(links):
            return []
        chain.append(links[frame])
        if len(links[frame].topics) > 1:
            topics = ", ".join(links[frame].topics)
            raise recording.error(
                f"path = '{recording.path}' has transforms of the frame {frame!r} on several topics, as of several "
                f"robots: name one of {topics} as topic of the poses (pose_topic of measurements_from_bag)."
            )
        frame = links[frame].parent
    return chain


def _composed(chain: list[_Track]) -> _Track:
    """Return poses of a chain's first frame in the last one, at the times of the most frequent transform."""
    time_s = max(chain, key=lambda each: len(each.time_s)).time_s
    position_m, turn = np.zeros((len(time_s), 3)), Rotation.identity(len(time_s))
    for each in (link.at(time_s) for link in chain):
        position_m, turn = each.rotation.apply(position_m) + each.position_m, each.rotation * turn
    return _Track(chain[-1].parent, time_s, position_m, turn)
