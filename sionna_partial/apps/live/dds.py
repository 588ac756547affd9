"""Topics of a DDS domain (ROS 2), without ROS: participants, quality of service, and types of messages."""

import os
import time
from collections.abc import Mapping
from functools import cache
from typing import Any

from sionna_partial.apps.live.answers import LiveAnswer
from sionna_partial.apps.live.coverage import LiveCoverage
from sionna_partial.apps.live.topics import DEFINITIONS, Listener, Topics
from sionna_partial.checks import require_whole
from sionna_partial.errors import SettingsError
from sionna_partial.maps.importers.bags import MAX_MESSAGE_BYTES
from sionna_partial.resources import optional_packages

HIGHEST_DOMAIN = 232

MOST_AT_ONCE = 100
"""Messages of a topic that are taken before the next topic's."""

POLL_S = 0.02
"""Time between two polls [s]."""

_LIMITS = (
    "<CycloneDDS><Domain><Internal>"
    f"<MaxSampleSize>{MAX_MESSAGE_BYTES} B</MaxSampleSize></Internal></Domain></CycloneDDS>"
)


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
