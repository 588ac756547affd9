"""Topics of a robot to a LiveCoverage and back: recordings, DDS (ROS 2) or rosbridge (ROS 1), without ROS."""

import json
import logging
import os
import re
import time
from collections import ChainMap
from collections.abc import Container, Mapping, MutableMapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sionna_partial.apps.live.answers import LiveAnswer, LiveTransmitter, LiveViews
from sionna_partial.apps.live.coverage import LiveCoverage
from sionna_partial.checks import Checked, require, require_whole, shown
from sionna_partial.errors import MapError, SettingsError
from sionna_partial.maps.importers.bags import GRID, MAX_MESSAGE_BYTES, open_recording
from sionna_partial.resources import optional_packages

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

HIGHEST_DOMAIN = 232

MOST_AT_ONCE = 100
"""Messages of a topic that are taken before the next topic's."""

POLL_S = 0.02
"""Time between two polls [s]."""

_LIMITS = (
    "<CycloneDDS><Domain><Internal>"
    f"<MaxSampleSize>{MAX_MESSAGE_BYTES} B</MaxSampleSize></Internal></Domain></CycloneDDS>"
)

MAX_BYTES = 100_000_000
"""Size of the largest accepted message [bytes]."""

RETRY_S = 1.0
"""Time between two attempts to connect [s]."""

_log = logging.getLogger(__name__)


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


class Dds:
    """The topics of one DDS domain.

    `CYCLONEDDS_URI` chooses interfaces and peers, as for ROS 2 with Cyclone DDS.

    Parameters
    ----------
    topics : Topics
    names : mapping
        Transmitters by name.
    domain : int or None
        None is `ROS_DOMAIN_ID`, or 0.

    Raises
    ------
    SettingsError
        For an invalid domain, or one that cannot be joined.
    """

    def __init__(self, topics: Topics, names: Mapping[str, object], domain: int | None = None) -> None:
        number = _domain(domain)
        with optional_packages(SettingsError):
            from cyclonedds.core import DDSException
            from cyclonedds.domain import Domain, DomainParticipant
        try:
            config = ",".join(filter(None, [os.environ.get("CYCLONEDDS_URI"), _LIMITS]))
            self._domain: Any = Domain(number, config)
            self._participant: Any = DomainParticipant(number)
        except DDSException as error:
            remedy = "check CYCLONEDDS_URI and the network interfaces."
            raise SettingsError(f"DDS domain {number} cannot be joined ({error.msg}): {remedy}") from error
        self.topics, self.source, self._sent = topics, f"DDS domain {number}", set[str]()
        self._readers = [
            (topic, self._reader(topic, kind, latched))
            for topic, kind in topics.types().items()
            for latched in ((True, False) if topic in (topics.map, "/tf_static") else (False,))
        ]
        self._writers = {topic: self._writer(topic, kind) for topic, kind in topics.published(names).items()}

    def publish(self, answer: LiveAnswer) -> None:
        """Publish an answer reliably; late subscribers get the last one."""
        for topic, (kind, message) in self.topics.messages(answer, self._sent).items():
            if topic not in self._writers:
                self._writers[topic] = self._writer(topic, kind)
            self._writers[topic].write(filled(kind, message))
            self._sent.add(topic)

    def listen(self, live: LiveCoverage) -> None:
        """Pass messages to a `LiveCoverage` without end."""
        listener = Listener(live, self.topics)
        while True:
            self.poll(listener)
            time.sleep(POLL_S)

    def poll(self, listener: Listener) -> None:
        """Pass the messages that have arrived."""
        for topic, reader in self._readers:
            for _ in range(MOST_AT_ONCE):
                try:
                    samples = reader.take(1)
                except Exception as error:  # bytes that are no message of its type
                    listener.live.report(f"a message of {topic} cannot be decoded ({type(error).__name__}: {error}).")
                    continue
                if not samples:
                    break
                if samples[0].sample_info.valid_data:
                    listener.take(topic, samples[0])

    def close(self) -> None:
        """Leave the domain."""
        self._readers, self._writers, self._participant, self._domain = [], {}, None, None

    def _reader(self, topic: str, kind: str, latched: bool) -> Any:
        from cyclonedds.sub import DataReader

        qos = _qos(latched=latched, reliable=latched, depth=1 if topic == self.topics.map else 100)
        return DataReader(self._participant, self._topic(topic, kind), qos=qos)

    def _writer(self, topic: str, kind: str) -> Any:
        from cyclonedds.pub import DataWriter

        qos = _qos(latched=True, reliable=True, depth=1)
        return DataWriter(self._participant, self._topic(topic, kind), qos=qos)

    def _topic(self, topic: str, kind: str) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._participant, f"rt{topic}", struct(kind))


def _domain(given: int | None) -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if given is None and not text.isdecimal():
        raise SettingsError(f"ROS_DOMAIN_ID = {text!r} is no number: give 0 to {HIGHEST_DOMAIN}.")
    number = int(text) if given is None else given
    require_whole("domain", number, 0, HIGHEST_DOMAIN)
    return number


def _qos(*, latched: bool, reliable: bool, depth: int) -> Any:
    """Return the quality of service of nav2's maps if latched, else one for any publisher."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    return Qos(
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.Reliability.Reliable(duration(milliseconds=100)) if reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


@cache
def _store() -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    for kind, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, kind))
    return store


@cache
def struct(kind: str) -> Any:
    """Return the DDS type of a message type, named as in ROS 2."""
    from cyclonedds.idl import make_idl_struct

    package, _, name = kind.split("/")
    fields = {each: _field_type(*description) for each, description in _store().fielddefs[kind][1]}
    return make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)


def _field_type(node: Any, description: Any) -> Any:
    from cyclonedds.idl import types

    if node.name == "NAME":
        return struct(description)
    if node.name == "BASE":
        return {"string": str, "bool": bool}.get(description[0]) or getattr(types, description[0])
    inner, count = description
    if node.name == "SEQUENCE":
        return types.sequence[_field_type(*inner)]  # type: ignore[misc]
    return types.array[_field_type(*inner), count]  # type: ignore[misc]


def filled(kind: str, values: Mapping[str, Any]) -> Any:
    """Return a message from nested mappings."""
    given = {}
    for name, (node, description) in _store().fielddefs[kind][1]:
        value = values[name]
        if node.name == "NAME":
            value = filled(description, value)
        elif isinstance(value, list) and description[0][0].name == "NAME":
            value = [filled(description[0][1], each) for each in value]
        given[name] = value
    return struct(kind)(**given)


class Rosbridge:
    """The topics of a rosbridge server; lost connections are opened again.

    Parameters
    ----------
    url : str
        For example "ws://robot:9090".
    topics : Topics
    names : mapping
        Transmitters by name.

    Raises
    ------
    SettingsError
        For any other address.
    """

    def __init__(self, url: str, topics: Topics, names: Mapping[str, object]) -> None:
        with optional_packages(SettingsError):
            from websockets.uri import parse_uri
        try:
            good = bool(re.fullmatch(r"wss?://[^/\s]+(/[!-~]*)?", url) and parse_uri(url).host)
        except ValueError:  # a port that is none
            good = False
        if not good:
            raise SettingsError(f"rosbridge = {shown(url)} is not allowed: give for example ws://robot:9090.")
        self.url = self.source = url
        self.topics, self._published = topics, topics.published(names)
        self._socket: Any = None
        self._last: dict[str, str] = {}

    def publish(self, answer: LiveAnswer) -> None:
        """Publish an answer; a restarted server gets the last ones."""
        for topic, (kind, message) in self.topics.messages(answer, self._last).items():
            if topic not in self._published:
                self._published[topic] = kind
                self._advertise(topic)
            self._last[topic] = json.dumps({"op": "publish", "topic": topic, "msg": message})
            self._send(self._last[topic])

    def listen(self, live: LiveCoverage) -> None:
        """Pass messages to a `LiveCoverage` without end."""
        listener = Listener(live, self.topics)
        while True:
            self.connect(listener)
            time.sleep(RETRY_S)

    def connect(self, listener: Listener) -> None:
        """Pass messages until the connection ends, and log why it did."""
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        try:
            with connect(self.url, max_size=MAX_BYTES, open_timeout=5.0) as self._socket:
                _log.info("connected to %s", self.url)
                self._greet()
                for text in self._socket:
                    self._take(listener, text)
                reason = "it ended the connection"
        except (OSError, WebSocketException) as error:
            reason = str(error)
        finally:
            self._socket = None
        listener.live.report(f"{self.url}: {reason}; it is tried again every {RETRY_S:g} s.")

    def _greet(self) -> None:
        for topic in [*self._published]:
            self._advertise(topic)
        for topic, kind in self.topics.types().items():
            depth = 1 if topic == self.topics.map else 0
            request = {"op": "subscribe", "topic": topic, "type": _old(kind), "queue_length": depth}
            self._send(json.dumps(request))
        for text in [*self._last.values()]:
            self._send(text)

    def _advertise(self, topic: str) -> None:
        kind = _old(self._published[topic])
        self._send(json.dumps({"op": "advertise", "topic": topic, "type": kind, "latch": True}))

    def _send(self, text: str) -> None:
        from websockets.exceptions import WebSocketException

        socket = self._socket
        if socket is not None:
            with suppress(OSError, WebSocketException):  # the listening side logs it
                socket.send(text)

    def _take(self, listener: Listener, text: str | bytes) -> None:
        try:
            message = json.loads(text, object_hook=lambda fields: SimpleNamespace(**fields))
            operation, topic = getattr(message, "op", None), getattr(message, "topic", None)
            if operation == "publish" and topic in self.topics.types():
                listener.take(topic, message.msg)
            elif operation == "status":
                listener.live.report(f"{self.url}: {shown(message.msg)}")
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            listener.live.report(f"{self.url}: a message is dropped ({type(error).__name__}: {error}).")


def _old(kind: str) -> str:
    """Return a type without "msg", as rosbridge of ROS 1 and 2 accepts it."""
    package, _, name = kind.split("/")
    return f"{package}/{name}"
