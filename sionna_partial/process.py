"""Signals, temporary folders, cores and the cache of compiled code."""

import contextlib
import fcntl
import hashlib
import os
import secrets
import shutil
import signal
import socket
import stat
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from typing import Any, TypeVar

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

GRACE_S = 1.0
"""Time for native code to return before the process ends [s]."""

NEW_FOLDER = ".new-sionna_partial_"
"""Prefix of own folders that are not locked yet."""

UNLOCKED_S = 60.0
"""Age at which an unlocked folder is known to be of a killed process [s]."""

COMPILING_ONCE = "compiling, once: about 40 s"
"""Announcement where no bar is drawn."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_cleanups: list[Callable[[], object]] = []
_told: list[Callable[[int], None]] = []
_announced = threading.Event()


@contextmanager
def cleaned_up(cleanup: Callable[[], object]) -> Iterator[None]:
    """Call `cleanup` at the end, also if a signal ends the process."""
    _cleanups.append(cleanup)
    try:
        yield
    finally:
        cleanup()
        with suppress(ValueError):
            _cleanups.remove(cleanup)


def end_process(code: int) -> None:
    """Clean up and exit without unwinding: interrupted native code would abort."""
    while _cleanups:  # first what stops other threads, which may add some
        with suppress(Exception):
            _cleanups.pop(0)()
    os._exit(code)


def end_at_signals() -> None:
    """Let signals end this process even in native code; ignored signals remain ignored."""

    def end(number: int, _: object = None) -> None:
        with suppress(OSError):
            os.write(2, b"\x1b[?25h\ninterrupted\n" if os.isatty(2) else b"interrupted\n")  # with the cursor
        end_process(128 + number)

    def watch() -> None:
        number = os.read(reader, 1)[0]
        time.sleep(GRACE_S)
        end(number)

    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)
    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def signals_held() -> Iterator[None]:
    """Delay signals during an import of a native library or a move of files."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, Any]] = []
    handlers = {number: signal.getsignal(number) for number in ENDING}
    held = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in held:
        signal.signal(number, lambda *call: came.append(call))
    try:
        yield
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
        for first, frame in came[:1]:
            held[signal.Signals(first)](first, frame)


@contextmanager
def own_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """Make a folder in `parent`, and remove it at the end with new parents that are empty.

    Folders of killed processes of this machine are removed, too: a folder is locked while its process lives.
    """
    mine = prefix + hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]
    made = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    new, folder = (parent / f"{start}{secrets.token_hex(8)}" for start in (NEW_FOLDER, mine))

    def remove() -> None:
        for each in (new, folder):
            shutil.rmtree(each, ignore_errors=True)
        for each in made:
            with suppress(OSError):
                each.rmdir()

    with cleaned_up(remove), contextlib.ExitStack() as lock:
        new.mkdir(0o700, parents=True)
        lock.enter_context(_locked(new))
        new.rename(folder)
        old = (each for each in parent.glob(f"{NEW_FOLDER}*") if time.time() - each.lstat().st_mtime > UNLOCKED_S)
        for others in (parent.glob(f"{mine}*"), old):
            with suppress(OSError):
                for other in others:
                    with suppress(OSError), _locked(other, must=True):
                        shutil.rmtree(other, ignore_errors=True)
        yield folder


@contextmanager
def _locked(folder: Path, *, must: bool = False) -> Iterator[None]:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        with contextlib.nullcontext() if must else suppress(OSError):  # some file systems have no locks
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def in_order(function: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """Yield ``function(item)`` in order, by a thread per core, at most two items per core ahead."""
    waiting: deque[Future[_Result]] = deque()
    with ThreadPoolExecutor(core_count()) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) >= 2 * core_count():
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def njit(*, borrows: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator for functions that numba compiles, with a cache, if necessary in a temporary folder.

    Division by zero gives infinity or NaN as in NumPy: Python's checks take time in every loop. Wrappers for C would
    only take time to compile. A function that `borrows` neither makes arrays nor returns any: numba then counts no
    references, which for tuples of arrays takes most of the time to compile.
    """
    options = {"error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": not borrows} | options
    return lambda function: _Kernel(function, options)


class _Kernel:
    """A function that numba compiles; numba takes longer to import than a map to load, and is imported at first use."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._options = options
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        return self._compiled(*arguments)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of numba's dispatcher: `_numba_type_` is what compiled callers see."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._inner if name == "_numba_type_" else self._compiled, name)

    @cached_property
    def _compiled(self) -> Any:
        return self._dispatcher()

    @cached_property
    def _inner(self) -> Any:
        """For compiled callers, without the wrappers for calls by Python, which take time to compile."""
        return self._dispatcher(no_cpython_wrapper=True)

    def _dispatcher(self, **options: Any) -> Any:
        import numba

        _tell_of_compilations()
        function, options = self.__wrapped__, self._options | options  # type: ignore[attr-defined]
        try:
            compiled = numba.njit(**options)(function)
        except RuntimeError:  # neither the package nor the home folder can be written
            numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = _private_folder()
            with suppress(RuntimeError):
                return _with_wide_integers(_outdated_by_others(numba.njit(**options)(function)))
            return _with_wide_integers(numba.njit(**(options | {"cache": False}))(function))
        return _with_wide_integers(_outdated_by_others(compiled))


@contextmanager
def told_of_compilations(tell: Callable[[int], None]) -> Iterator[None]:
    """Call `tell` with a running number before each kernel compiles; of nested receivers only the first is called.

    Without any receiver the first compilation of a process is announced on stderr.
    """
    _told.append(tell)
    try:
        yield
    finally:
        _told.remove(tell)


@cache
def _tell_of_compilations() -> None:
    from numba.core import event

    class Listener(event.Listener):
        number = 0

        def on_start(self, event: Any) -> None:
            if not (event.data["dispatcher"].py_func.__module__ or "").startswith("numba."):
                self.number += 1
                (_told or [_announce_compilations])[0](self.number)

        def on_end(self, event: object) -> None:
            """Do nothing: the next compilation begins, or the work goes on."""

    event.register("numba:compile", Listener())


def _announce_compilations(_: int) -> None:
    if not _announced.is_set():
        _announced.set()
        print(COMPILING_ONCE, file=sys.stderr, flush=True)


def _with_wide_integers(compiled: Any) -> Any:
    """Let compiled callers pass int64: numba would compile again for each literal and each narrower integer."""
    from numba import types

    def wide(kind: Any) -> Any:
        kind = kind.literal_type if isinstance(kind, types.Literal) else kind
        return types.int64 if isinstance(kind, types.Integer) and kind.bitwidth < 64 else kind

    def call_template(arguments: Any, named: Any) -> Any:
        return template(tuple(map(wide, arguments)), {name: wide(kind) for name, kind in named.items()})

    with suppress(AttributeError):  # NUMBA_DISABLE_JIT leaves the function itself
        template, compiled.get_call_template = compiled.get_call_template, call_template
    return compiled


def _outdated_by_others(compiled: Any) -> Any:
    """Invalidate cached code when any compiled module changes: numba checks only one.

    Code without wrappers for Python has entries of its own. A full disk only prevents caching.
    """

    def save_overload(*arguments: Any) -> None:
        with suppress(OSError):
            saved(*arguments)

    def index_key(*arguments: Any) -> Any:
        return *key(*arguments), compiled.targetoptions.get("no_cpython_wrapper")

    with suppress(AttributeError):
        saved, compiled._cache.save_overload = compiled._cache.save_overload, save_overload
        key, compiled._cache._index_key = compiled._cache._index_key, index_key
        compiled._cache._cache_file._version += f" {_compiled_sources()}"
    return compiled


@cache
def _compiled_sources() -> str:
    package, total = Path(__file__).parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        if b"njit" in source:
            total.update(str(path.relative_to(package)).encode() + source)
    return total.hexdigest()


def _private_folder() -> str:
    """Return a folder that only this user can write to, as cached code is executed; "" without."""
    with suppress(OSError):
        folder = Path(tempfile.gettempdir()) / f"sionna-partial-numba-{os.getuid()}"
        folder.mkdir(0o700, exist_ok=True)
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022:
            return str(folder)
    return ""
