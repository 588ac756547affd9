"""Processes that make the homes of a data set.

Each home is made in a process of its own, which serves one home after the other, so that libraries load once. Pools of
concurrent.futures and pebble, and dask's Nanny, start a user's script without a `__main__` guard again, and lack a time
limit per home and the last lines of a dead process.
"""

import contextlib
import faulthandler
import hashlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
from dataclasses import asdict, dataclass
from importlib.metadata import version
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Literal

from sionna_partial.errors import BackendError, OutputError, PredictorError, SionnaPartialError
from sionna_partial.files import temporary_folder
from sionna_partial.lab.datasets.home_links import HomeSource, home_links, home_sensor
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.lab.datasets.shards import INDEX_FILE, shard_metadata, shard_path, write_shard
from sionna_partial.llvm import load_llvm
from sionna_partial.process import cleaned_up, end_process

ATTEMPTS = 3
"""Number of processes that may die over a home: one may have been killed from outside."""

IDLE_S = 60.0

GRACE_S = 60.0
"""Time beyond a home's limit to start and end [s]."""

TIMEOUT_LINE = "Timeout ("
"""First words that faulthandler writes at a time-out."""

LAST_LINES = 20

PACKAGES = ("sionna-partial", "sionna-rt", "mitsuba", "drjit", "numpy", "numba", "scipy", "shapely", "pyarrow")
"""Packages whose versions may change the bytes of a data set."""

ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

_idle: list["_HomeProcess"] = []
_alive: set["_HomeProcess"] = set()
_stopped = threading.Event()


@dataclass(frozen=True)
class HomeTask:
    """A home to be made, the folder of its data set, and the SHA-256 of the folder's `dataset.json`."""

    folder: str
    index_sha256: str
    source: HomeSource
    settings: DatasetSettings
    versions: dict[str, str]
    time_limit_s: float

    @property
    def metadata(self) -> dict[str, object]:
        sensor, settings = asdict(home_sensor(self.source.name, self.settings)), settings_record(self.settings)
        return {"home": self.source.record, "sensor": sensor, "settings": settings, "versions": self.versions}

    @property
    def is_done(self) -> bool:
        """Return whether the home's shard is whole and of these settings."""
        try:
            notes = shard_metadata(shard_path(self.folder, self.source.name))
        except PredictorError:
            return False
        return all(notes.get(name) == value for name, value in self.metadata.items())

    def make(self) -> None:
        table = home_links(self.source.load(), self.source.name, self.settings)
        write_shard(table, shard_path(self.folder, self.source.name), self.metadata)


@dataclass(frozen=True)
class HomeResult:
    """Result of a home; "unusable" is a worker that can make no home. The first line of `error` is its summary."""

    outcome: Literal["done", "failed", "unusable"]
    error: str = ""


def settings_record(settings: DatasetSettings) -> dict[str, object]:
    return asdict(settings) | {"stages": list(settings.stages)}


def installed_versions() -> dict[str, str]:
    return {package: version(package) for package in PACKAGES}


def run_home(task: HomeTask) -> HomeResult:
    """Make a home in a process of its own; return its errors."""
    fault = _fault_of_worker(task)
    if fault:
        return HomeResult("unusable", fault)
    if task.is_done:
        return HomeResult("done")
    lines: list[str] = []
    for _ in range(ATTEMPTS):
        if _stopped.is_set():
            return HomeResult("failed", "stopped")
        process = next((each for each in iter(_take_idle, None) if each.is_alive), None) or _HomeProcess()
        if _stopped.is_set():  # while it started
            process.kill()
        result = process.make(task)
        if isinstance(result, HomeResult):
            _idle.append(process)
            return result
        lines = result
        if any(line.startswith(TIMEOUT_LINE) for line in lines):
            limit = f"took longer than {task.time_limit_s:g} s, the time limit of a home"
            return HomeResult("failed", "\n".join([limit, "It was at", *lines]))
    died = f"its process died {ATTEMPTS} times {lines[-1]}"
    return HomeResult("failed", "\n".join([died, "The last one wrote", *lines]))


def allow_homes() -> None:
    """Allow homes again after `stop_homes`."""
    _stopped.clear()


def stop_homes() -> None:
    """Kill the processes of all threads, with unfinished homes."""
    _stopped.set()
    for process in list(_alive):
        process.kill()
    for idle in iter(_take_idle, None):
        idle.close()


def serve(descriptor: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    threading.Thread(target=_end_with_worker, daemon=True).start()
    link = Connection(descriptor)
    fault = _fault_of_libraries()
    with contextlib.suppress(EOFError):
        while link.poll(IDLE_S):
            task = link.recv()
            faulthandler.dump_traceback_later(task.time_limit_s, exit=True)
            result = HomeResult("unusable", fault) if fault else _made(task)
            faulthandler.cancel_dump_traceback_later()
            link.send(result)


class _HomeProcess:
    def __init__(self) -> None:
        self._link, far_end = Pipe()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        self._scratch = contextlib.ExitStack()
        scratch = self._scratch.enter_context(temporary_folder())
        own = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "TMPDIR": str(scratch)}
        with far_end:
            descriptor = far_end.fileno()
            code = f"from sionna_partial.lab.datasets.home_processes import serve; serve({descriptor})"
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", code],
                stdin=subprocess.PIPE,
                stdout=self._log,
                stderr=self._log,
                pass_fds=[descriptor],
                env=os.environ | ONE_THREAD | own,
            )
        self._scratch.enter_context(cleaned_up(self.kill))
        _alive.add(self)

    @property
    def is_alive(self) -> bool:
        """Return whether it runs; release the resources of a dead one."""
        if self._process.poll() is None:
            return True
        self.close()
        return False

    def make(self, task: HomeTask) -> HomeResult | list[str]:
        """Make a home; return the last lines of the process if it died or took too long."""
        self._log.seek(0)
        self._log.truncate()
        in_time = True
        with contextlib.suppress(EOFError, OSError):
            self._link.send(task)
            in_time = self._link.poll(task.time_limit_s + GRACE_S)
            if in_time:
                result: HomeResult = self._link.recv()
                return result
        self.kill()
        lines = self._last_lines() if in_time else [f"{TIMEOUT_LINE}killed)"]
        self.close()
        return lines

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        _alive.discard(self)

    def close(self) -> None:
        self.kill()
        self._link.close()
        self._log.close()
        self._scratch.close()
        if self._process.stdin:
            self._process.stdin.close()

    def _last_lines(self) -> list[str]:
        code = self._process.returncode
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        late = [number for number, line in enumerate(lines) if line.startswith(TIMEOUT_LINE)]
        return [*(lines[late[0] :][:LAST_LINES] if late else lines[-LAST_LINES:]), f"({how})"]


def _take_idle() -> _HomeProcess | None:
    with contextlib.suppress(IndexError):
        return _idle.pop()
    return None


def _fault_of_worker(task: HomeTask) -> str:
    where = f"the worker on {socket.gethostname()}"
    index = Path(task.folder) / INDEX_FILE
    remedy = "give a folder on a file system that all workers share."
    try:
        if hashlib.sha256(index.read_bytes()).hexdigest() != task.index_sha256:
            return f"{where} sees another '{index}': {remedy}"
    except OSError as error:
        return f"{where} cannot read '{index}' ({error.strerror}): {remedy}"
    for name, found in installed_versions().items():
        if task.versions[name] != found:
            wanted = task.versions[name]
            return f"{where} has {name} {found}, the data set is made with {wanted}: install that version."
    return ""


def _made(task: HomeTask) -> HomeResult:
    try:
        task.make()
    except (BackendError, OutputError) as error:
        return HomeResult("unusable", str(error))
    except SionnaPartialError as error:
        return HomeResult("failed", str(error))
    except Exception as error:
        return HomeResult("failed", f"{type(error).__name__}: {error}\n{traceback.format_exc()}")
    return HomeResult("done")


def _fault_of_libraries() -> str:
    """Start Dr.Jit with one thread; return the reason of a failure, or an empty string."""
    try:
        load_llvm()
    except BackendError as error:
        return str(error)
    import drjit as dr

    dr.set_thread_count(1)
    return ""


def _end_with_worker() -> None:
    """End when the worker's end of a pipe closes."""
    os.read(sys.stdin.fileno(), 1)
    end_process(1)
