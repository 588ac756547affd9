"""Loads the LLVM library of Dr.Jit before Dr.Jit and TensorFlow meet, and Sionna RT after it.

Dr.Jit accepts LLVM 15 and 16, which abort the process in path solving, and TensorFlow exports LLVM symbols that would
replace its symbols. So pip's library is loaded when `sionna_partial` is imported, with its own symbols first, and
`DRJIT_LIBLLVM_PATH` names it for Dr.Jit, stock Sionna RT and child processes.
"""

import ctypes
import functools
import os
import pkgutil
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from sionna_partial.errors import BackendError
from sionna_partial.process import signals_held

PATH_VARIABLE: Final = "DRJIT_LIBLLVM_PATH"
"""Environment variable with the path of Dr.Jit's LLVM library."""

PIP_PACKAGE = "karellen-llvm-core"
"""PyPI package with a complete LLVM library."""

OLDEST_MAJOR = 17
"""Oldest LLVM that compiles path kernels: 15 and 16 abort with "Cannot select"."""

MITSUBA_VARIANT = "llvm_ad_mono_polarized"

_RUNTIME_LIBRARIES = ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1")
_INSTALL = f"""run pip install "{PIP_PACKAGE}>=19.1.7,<24\""""
_UNSET = f"unset {PATH_VARIABLE} and {_INSTALL}, or set it to the full path of an LLVM {OLDEST_MAJOR} or newer"


@dataclass(frozen=True)
class LlvmLibrary:
    """The LLVM library that Dr.Jit uses; `source` is the environment variable or the PyPI package that named it."""

    path: Path
    version: str
    source: str


def choose_llvm() -> None:
    """Load the library that Dr.Jit will find, when the package is imported.

    Raises a BackendError where Dr.Jit already runs on one that cannot compile. A library that cannot be loaded is an
    error of `load_llvm` only: functions without Dr.Jit work.
    """
    try:
        _loaded_library()
    except BackendError:
        if sys.modules.get("drjit"):
            raise


def load_llvm() -> LlvmLibrary:
    """Return the LLVM library that `DRJIT_LIBLLVM_PATH` names, or pip's, for Dr.Jit.

    Call it before importing mitsuba, drjit or sionna. Raises a BackendError with the remedy if no library is found or
    works, if the process is a fork of one that called it, or if its working directory was deleted, on which native
    libraries abort.
    """
    library, process = _loaded_library(), _first_process()
    if process != os.getpid():
        raise BackendError(
            f"process {os.getpid()} is a fork of process {process}, which has started Dr.Jit or TensorFlow: they do "
            "not run in forks; start processes with multiprocessing.get_context('spawn')."
        )
    try:
        os.getcwd()
    except OSError as error:
        raise BackendError("the working directory was deleted: change to one that is there (cd).") from error
    return library


def load_sionna() -> ModuleType:
    """Import Sionna RT with a working LLVM, or raise a BackendError with the remedy."""
    load_llvm()
    with signals_held():
        import mitsuba as mi

        if mi.variant() is None:
            mi.set_variant(MITSUBA_VARIANT)
    if mi.variant() != MITSUBA_VARIANT:
        raise BackendError(
            f"mitsuba variant = {mi.variant()!r} is not supported: call mitsuba.set_variant('{MITSUBA_VARIANT}') "
            "before the first trace, or import sionna_partial in a process of its own."
        )
    loaded = "sionna.rt.rcs" in sys.modules
    with signals_held(), _postponed(*() if loaded else _DISPLAYS):
        import sionna.rt.rcs  # which loading a scene imports

    return sionna.rt


_DISPLAYS = "ipywidgets", "ipywidgets.embed", "pythreejs", "IPython.display", "matplotlib.pyplot"
"""Modules that Sionna RT imports to show things, which takes longer than the rest of its import."""


class _Postponed(ModuleType):
    """A module, or a name in one, that is imported on its first use after `_postponed` has ended."""

    def __init__(self, name: str, module: str) -> None:
        super().__init__(name)
        self._module = module

    def __getattr__(self, name: str) -> Any:
        if not self._waits:
            return getattr(pkgutil.resolve_name(self.__name__), name)
        if name.startswith("__"):
            raise AttributeError(name)
        return _Postponed(f"{self.__name__}.{name}", self._module)

    def __call__(self, *args: Any, **options: Any) -> Any:
        if self._waits:  # another thread has imported it meanwhile
            sys.modules.pop(self._module, None)
        return pkgutil.resolve_name(self.__name__)(*args, **options)

    @property
    def _waits(self) -> bool:
        return isinstance(sys.modules.get(self._module), _Postponed)


@contextmanager
def _postponed(*names: str) -> Iterator[None]:
    """Let modules that are imported meanwhile do without these, which they load when they use them."""
    waiting = {name: _Postponed(name, name) for name in names if name not in sys.modules}
    sys.modules.update(waiting)
    try:
        yield
    finally:
        for name, module in waiting.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]


@functools.cache
def _first_process() -> int:
    return os.getpid()


@functools.cache
def _loaded_library() -> LlvmLibrary:
    named = os.environ.get(PATH_VARIABLE)
    started = _started_library() if sys.modules.get("drjit") else None
    try:
        path = started or (_named_library(named) if named else _pip_library())
        version = _version(_open_library(path))
    except OSError as error:
        raise BackendError(f"{PATH_VARIABLE} = '{named}' cannot be used ({error}): {_UNSET}.") from error
    if int(version.partition(".")[0]) < OLDEST_MAJOR:
        fault = f"LLVM {version} is older than {OLDEST_MAJOR} and cannot compile path kernels"
        raise BackendError(f"{PATH_VARIABLE} = '{path}' cannot be used ({fault}): {_UNSET}.")
    os.environ[PATH_VARIABLE] = str(path)
    return LlvmLibrary(path, version, PATH_VARIABLE if named else PIP_PACKAGE)


def _started_library() -> Path | None:
    """Return the library that Dr.Jit runs on already; raise a BackendError if it cannot compile path kernels."""
    order, major = list(sys.modules), sys.modules["drjit"].detail.llvm_version()[0]
    found = f"LLVM {major}" if major > 0 else "no LLVM"
    if "tensorflow" in order and order.index("tensorflow") < order.index("drjit"):
        found += " with symbols of TensorFlow"
        _end_without_destructors()
    elif major >= OLDEST_MAJOR:
        lines = Path("/proc/self/maps").read_text().splitlines()
        return Path(next(line.split(maxsplit=5)[-1] for line in lines if "libLLVM" in line))
    elif os.environ.get(PATH_VARIABLE):
        return None
    raise BackendError(
        f"Dr.Jit was imported before sionna_partial and runs on {found}, which fails: put the line "
        "`import sionna_partial` before those that import sionna.rt, mitsuba or drjit."
    )


def _end_without_destructors() -> None:
    """Skip the destructors of native libraries at exit: this LLVM's free memory of TensorFlow's."""
    libc = ctypes.CDLL(None)
    libc.on_exit(libc._exit, None)


def _named_library(name: str) -> Path:
    """Return a path that child processes in other folders can use; the dynamic loader finds a bare name.

    Pipes are refused: loading one would block.
    """
    if "/" not in name:
        return Path(name)
    path = Path(name).absolute()
    if path.exists() and not path.is_file():
        raise OSError("it is no file")
    return path


def _pip_library() -> Path:
    with suppress(metadata.PackageNotFoundError):
        for file in metadata.distribution(PIP_PACKAGE).files or []:
            if re.fullmatch(r"libLLVM(-\d[\d.]*)?\.so[\d.]*", file.name) and Path(str(file.locate())).exists():
                return Path(str(file.locate())).resolve()
    raise BackendError(f"No LLVM library is installed: {_INSTALL}.")


def _open_library(path: Path) -> ctypes.CDLL:
    """Load a library with its own symbols first, and the C++ runtime beside it where there is one.

    The runtime of pip's library is loaded by full path, since the links to it may be missing, and for this library
    alone: visible to all, it would crash matplotlib.
    """
    for stem in _RUNTIME_LIBRARIES:
        for runtime in sorted(path.resolve().parent.glob(f"*-unknown-linux-gnu/{stem}*"))[-1:]:
            ctypes.CDLL(str(runtime), mode=os.RTLD_NOW | os.RTLD_LOCAL)
    return ctypes.CDLL(str(path), mode=os.RTLD_NOW | os.RTLD_LOCAL | os.RTLD_DEEPBIND)


def _version(library: ctypes.CDLL) -> str:
    """Return the version that a library reports; those before 17 have no function for it."""
    if not hasattr(library, "LLVMGetVersion"):
        raise OSError(f"it is no LLVM of version {OLDEST_MAJOR} or newer")
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, numbers))
    return ".".join(str(number.value) for number in numbers)
