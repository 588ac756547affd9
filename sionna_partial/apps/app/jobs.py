"""Jobs that can be cancelled, take turns with the jobs of other windows, and collect warnings."""

import logging
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from sionna_partial.apps.refining import GivenWay
from sionna_partial.checks import Progress, reason_of
from sionna_partial.errors import SionnaPartialError

_log = logging.getLogger(__name__)


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
        """Let other jobs compute; raise `GivenWay` when this one was cancelled."""
        if not self.is_cancelled.is_set():
            TURNS.pass_on()
        if self.is_cancelled.is_set():
            raise GivenWay


Work: TypeAlias = Callable[[Progress], Iterator[Callable[[], None]]]
"""A computation, which yields functions to be called in the thread of the window."""


class WindowJobs:
    """Jobs of one window, one after the other, in a thread of their own.

    A new job cancels the one before it and drops its results. `call` runs a function in the thread of the window;
    `show` is called in that thread after changes.
    """

    def __init__(self, call: Callable[[Callable[[], None]], object], show: Callable[[], None]) -> None:
        self._call, self.show = call, show
        self._waiting: deque[Callable[[], None]] = deque()
        self._job: Job | None = None
        self._worker = ThreadPoolExecutor(1, "coverage of a window")
        self._job_warnings: list[str] = []
        self.status = Status()

    def do(self, function: Callable[[], None]) -> None:
        """Run a function in the thread of the window, after those that wait; called in any thread."""
        self._waiting.append(function)
        self._call(self._do_all)

    def _do_all(self) -> None:
        while self._waiting:
            try:
                self._waiting.popleft()()
            except Exception as error:  # shown by the page, which stays alive
                self.cancel()
                self.refuse(_reason(error))

    def begin(self, work: Work) -> None:
        """Start a job, and cancel the one before."""
        if self._job is not None:
            self._job.is_cancelled.set()
        job = self._job = Job(self._tell)
        self.status = Status("Waiting", 0.0)
        self.show()
        with suppress(RuntimeError):  # a window that was closed computes nothing
            self._worker.submit(self._run, job, work)

    def cancel(self) -> None:
        if self._job is not None:
            self._job.is_cancelled.set()
            self._job = None
            self._conclude(Status("Cancelled."))

    def refuse(self, error: object) -> None:
        self.status = Status(str(error), is_error=True)
        self.show()

    def close(self) -> None:
        """Cancel the job, and accept no other one."""
        self._call, self.show = lambda function: None, lambda: None
        self.cancel()
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _run(self, job: Job, work: Work) -> None:
        """Compute a job in turns with other windows."""
        try:
            with TURNS, collected_warnings(job.warnings):
                job.report(0.0, "starting")
                for change in work(job.report):
                    self.do(partial(self._take, job, change))
                    job.pass_on()
                end = Status("Ready.")
        except GivenWay:
            return
        except Exception as error:  # shown by the page, which stays alive
            end = Status(_reason(error), is_error=True)
        self.do(partial(self._end, job, end))

    def _tell(self, job: Job, status: Status) -> None:
        def tell() -> None:
            if job is self._job:
                self.status = status
                self.show()

        self.do(tell)

    def _take(self, job: Job, change: Callable[[], None]) -> None:
        if job is self._job:
            change()
            self._job_warnings += job.warnings
            self.show()

    def _end(self, job: Job, end: Status) -> None:
        if job is self._job:
            self._job = None
            self._job_warnings += job.warnings
            self._conclude(end)

    def _conclude(self, status: Status) -> None:
        """Show the end of a job."""
        self.status = status
        self.show()


def _reason(error: Exception) -> str:
    """Return the reason of an error, whose trace is logged if it is not ours."""
    if not isinstance(error, SionnaPartialError | OSError | MemoryError):
        _log.error("a job of the app failed", exc_info=error)
    return reason_of(error)


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
