"""Loads the LLVM library of Dr.Jit before Dr.Jit and TensorFlow meet.

Dr.Jit compiles its kernels with an LLVM that it finds by itself, and accepts versions 15 and 16, which abort the
process in path solving. TensorFlow exports LLVM symbols that would replace those of that library. So pip's library is
loaded here, with its own symbols first, and `DRJIT_LIBLLVM_PATH` names it for Dr.Jit and for child processes.
"""

import ctypes
import functools
import os
import re
import sys
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final

from sionna_partial.errors import BackendError

PATH_VARIABLE: Final = "DRJIT_LIBLLVM_PATH"
"""Environment variable from which Dr.Jit takes the path of its LLVM library."""

PIP_PACKAGE = "karellen-llvm-core"
"""PyPI package with a complete LLVM library."""

OLDEST_MAJOR = 17
"""Oldest LLVM that compiles path kernels: 15 and 16 abort with "Cannot select"."""

_RUNTIME_LIBRARIES = ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1")
_INSTALL = f"""run pip install "{PIP_PACKAGE}>=19.1.7,<24\""""
_UNSET = f"unset {PATH_VARIABLE} and {_INSTALL}, or set it to the full path of an LLVM {OLDEST_MAJOR} or newer"


@dataclass(frozen=True)
class LlvmLibrary:
    """The LLVM library that Dr.Jit uses; `source` is the environment variable or the PyPI package that named it."""

    path: Path
    version: str
    source: str


def load_llvm() -> LlvmLibrary:
    """Load the LLVM library that `DRJIT_LIBLLVM_PATH` names, or pip's; later calls return what the first one loaded.

    Call it before importing mitsuba, drjit or sionna; whether TensorFlow was imported before does not matter. Raises a
    BackendError that says what to do if there is no library, or none that works; if the process is a fork of one that
    loaded it; or if its working directory was deleted, on which native libraries abort.
    """
    library, process = _loaded_library()
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


@functools.cache
def _loaded_library() -> tuple[LlvmLibrary, int]:
    """Load the library; return it, and the process that did."""
    named = os.environ.get(PATH_VARIABLE)
    path = _started_library() or (_named_library(named) if named else _pip_library())
    try:
        version = _version(_open_library(path))
    except OSError as error:
        raise BackendError(f"{PATH_VARIABLE} = '{path}' cannot be used ({error}): {_UNSET}.") from error
    if int(version.partition(".")[0]) < OLDEST_MAJOR:
        fault = f"LLVM {version} is older than {OLDEST_MAJOR} and cannot compile path kernels"
        raise BackendError(f"{PATH_VARIABLE} = '{path}' cannot be used ({fault}): {_UNSET}.")
    os.environ[PATH_VARIABLE] = str(path)
    return LlvmLibrary(path, version, PATH_VARIABLE if named else PIP_PACKAGE), os.getpid()


def _started_library() -> Path | None:
    """Return the library that Dr.Jit runs on already, because drjit was imported first."""
    drjit = sys.modules.get("drjit")
    if drjit is None:
        return None
    major = drjit.detail.llvm_version()[0]
    with suppress(OSError):
        lines = Path("/proc/self/maps").read_text().splitlines()
        mapped = dict.fromkeys(line.split(maxsplit=5)[-1] for line in lines if "libLLVM" in line)
        if major >= OLDEST_MAJOR and mapped:
            return Path(next(iter(mapped)))
    found = f"LLVM {major}" if major > 0 else "no LLVM"
    raise BackendError(
        f"drjit was imported before sionna_partial could choose an LLVM, and runs on {found}: call "
        f"sionna_partial.llvm.load_llvm() before importing drjit, mitsuba or sionna, and {_INSTALL}."
    )


def _named_library(name: str) -> Path:
    """Return a path that child processes in other folders can use; the dynamic loader finds a bare name."""
    return Path(name).absolute() if "/" in name else Path(name)


def _pip_library() -> Path:
    """Return the real file of the library that pip installed."""
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
