"""Jobs that can be cancelled, take turns with the jobs of other windows, and collect warnings."""

import logging
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


class CancelledError(Exception):
    """A job was cancelled."""


@dataclass(frozen=True)
class Status:
    """Status line: message, completed fraction or None, and whether it is an error."""

    message: str = ""
    fraction: float | None = None
    is_error: bool = False


class Turns:
    """A first-come, first-served lock."""

    def __init__(self) -> None:
        self._queue: deque[int] = deque()
        self._changed = threading.Condition()

    def __enter__(self) -> None:
        me = threading.get_ident()
        with self._changed:
            self._queue.append(me)
            self._changed.wait_for(lambda: self._queue[0] == me)

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._queue.popleft()
            self._changed.notify_all()

    def pass_on(self) -> None:
        """Let waiting threads have their turns, if this thread has it, and return with the next turn."""
        with self._changed:
            is_wanted = len(self._queue) > 1 and self._queue[0] == threading.get_ident()
        if is_wanted:
            self.__exit__()
            self.__enter__()


TURNS = Turns()
"""One job computes at a time; others continue at its next report, after each block of links."""


class Job:
    """A computation that ends at its next report when it is cancelled."""

    def __init__(self, tell: Callable[["Job", Status], None]) -> None:
        self.is_cancelled = threading.Event()
        self.warnings: list[str] = []
        self._tell = tell

    def report(self, fraction: float, message: str) -> None:
        if not self.is_cancelled.is_set():
            self._tell(self, Status(message, fraction))
        self.pass_on()

    def pass_on(self) -> None:
        """Let other jobs compute; raise a `CancelledError` when this one was cancelled."""
        if not self.is_cancelled.is_set():
            TURNS.pass_on()
        if self.is_cancelled.is_set():
            raise CancelledError


class _Collector(logging.Handler):
    """Handler that collects each warning of one thread once."""

    def __init__(self, found: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._found, self._thread = found, threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if (record.thread, record.levelno) == (self._thread, logging.WARNING) and message not in self._found:
            self._found.append(message)


@contextmanager
def collected_warnings(found: list[str] | None = None) -> Iterator[list[str]]:
    """Collect the warnings that the package logs in this thread."""
    found = [] if found is None else found
    logger, collector = logging.getLogger("sionna_partial"), _Collector(found)
    logger.addHandler(collector)
    try:
        yield found
    finally:
        logger.removeHandler(collector)


@contextmanager
def logged_warnings() -> Iterator[None]:
    """Log each `UserWarning` of readers; warning filters belong to the process, so no report may be made within."""
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            yield
    finally:
        for warning in caught:
            logging.getLogger(__name__).warning("%s", warning.message)
