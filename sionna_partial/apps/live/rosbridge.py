"""Topics of a rosbridge server (ROS 1 and 2): JSON messages by a web socket."""

import json
import logging
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

from sionna_partial.apps.live.answers import LiveAnswer
from sionna_partial.apps.live.coverage import LiveCoverage
from sionna_partial.apps.live.topics import Listener, Topics
from sionna_partial.checks import shown
from sionna_partial.errors import SettingsError
from sionna_partial.resources import optional_packages

MAX_BYTES = 100_000_000
"""Size of the largest accepted message [bytes]."""

RETRY_S = 1.0
"""Time between two attempts to connect [s]."""

_log = logging.getLogger(__name__)


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
