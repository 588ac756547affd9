"""Finds, probes and loads a libLLVM before Dr.Jit and TensorFlow meet.

Dr.Jit compiles its kernels with an LLVM that it finds by itself, and takes versions 15 and 16 that abort the process in
path solving. TensorFlow exports LLVM symbols that would take the place of those of that library. So the library is
chosen here, tried once in a process of its own, and loaded with its own symbols first. `DRJIT_LIBLLVM_PATH` then names
it for Dr.Jit, and for child processes.
"""

import ctypes
import functools
import glob
import hashlib
import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final, Literal

from sionna_partial.errors import BackendError, OutputError
from sionna_partial.files import atomic_write

PATH_VARIABLE: Final = "DRJIT_LIBLLVM_PATH"
"""Environment variable with which Dr.Jit is told what to load."""

PIP_REQUIREMENT = "karellen-llvm-core>=19.1.7,<24"
"""PyPI package with a complete libLLVM."""

OLDEST_MAJOR = 17
"""Oldest LLVM that compiles path kernels: 15 and 16 abort with "Cannot select"."""

PROBE_TIMEOUT_S = 300
"""Longest time of a probe [s]; it takes 3 to 5 s."""

SYSTEM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64/llvm*/lib",
    "/usr/local/lib",
    f"{sys.prefix}/lib",
)
"""Where a libLLVM of the system, or of a conda environment, may lie (glob patterns)."""

_VERSIONED_NAME = re.compile(r"libLLVM(?:-(\d[\d.]*)\.so(?:\.[\d.]+)?|\.so\.(\d[\d.]*))")
_RUNTIME_LIBRARIES = ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1")
_INSTALL = f"""run pip install "{PIP_REQUIREMENT}\""""
_UNSET = f"""unset {PATH_VARIABLE} and {_INSTALL}, or set it to the full path of an LLVM {OLDEST_MAJOR} or newer"""

_log = logging.getLogger(__name__)

LlvmSource = Literal["DRJIT_LIBLLVM_PATH", "karellen-llvm-core", "system"]


@dataclass(frozen=True)
class LlvmLibrary:
    """The libLLVM that Dr.Jit uses.

    Parameters
    ----------
    path : pathlib.Path
    version : str
        As the library reports it, for example "23.1.4".
    source : {"DRJIT_LIBLLVM_PATH", "karellen-llvm-core", "system"}
        Where it was found. A child process finds it in the environment variable that its parent has set.
    """

    path: Path
    version: str
    source: LlvmSource


@dataclass(frozen=True)
class _Verdict:
    """What the probe of a library said: its version, and a fault or ""."""

    version: str
    fault: str


@functools.cache
def load_llvm() -> LlvmLibrary:
    """Load a libLLVM that works; later calls return what the first one found.

    Call it before importing mitsuba, drjit or sionna; whether TensorFlow was imported before does not matter.
    The library is `DRJIT_LIBLLVM_PATH` where that is set, else that of karellen-llvm-core, else the newest of the
    system. The first time on a machine it solves a few paths in a child process, which takes 3 to 5 s.

    Returns
    -------
    LlvmLibrary

    Raises
    ------
    BackendError
        If there is none, or none that works; the message says what to do.
    """
    refused = []
    for path, source in _candidates():
        verdict = _verdict(path)
        if not verdict.fault:
            open_library(path)
            os.environ[PATH_VARIABLE] = str(path)
            return LlvmLibrary(path, verdict.version, source)
        if source == PATH_VARIABLE:
            raise BackendError(f"{PATH_VARIABLE} = '{path}' cannot be used ({verdict.fault}): {_UNSET}.")
        _log.warning("LLVM %s (%s) cannot be used: %s", path, source, verdict.fault)
        refused.append(f"{path} ({verdict.fault})")
    what = "; ".join(refused) or "none was found"
    raise BackendError(f"No LLVM of version {OLDEST_MAJOR} or newer can be used, {what}: {_INSTALL}.")


def open_library(path: Path) -> ctypes.CDLL:
    """Load a libLLVM with its own symbols first, and the C++ runtime beside it where there is one.

    The runtime of karellen-llvm-core is loaded by full path, since the links to it may be missing, and for this library
    alone: shown to all, it would crash matplotlib.

    Raises
    ------
    OSError
        If the file is no library, or one of its own libraries is missing.
    """
    for stem in _RUNTIME_LIBRARIES:
        for runtime in sorted(path.resolve().parent.glob(f"*-unknown-linux-gnu/{stem}*"))[-1:]:
            ctypes.CDLL(str(runtime), mode=os.RTLD_NOW | os.RTLD_LOCAL)
    return ctypes.CDLL(str(path), mode=os.RTLD_NOW | os.RTLD_LOCAL | os.RTLD_DEEPBIND)


def library_version(library: ctypes.CDLL, path: Path) -> str:
    """Version of a loaded libLLVM: as it reports it, or from the name of an old one that cannot; "" if unknown."""
    if hasattr(library, "LLVMGetVersion"):
        numbers = [ctypes.c_uint() for _ in range(3)]
        library.LLVMGetVersion(*map(ctypes.byref, numbers))
        return ".".join(str(number.value) for number in numbers)
    return _name_version(path)


def _candidates() -> Iterator[tuple[Path, LlvmSource]]:
    """Libraries to try, best first."""
    named = os.environ.get(PATH_VARIABLE)
    started = _started_library()
    if started is not None:
        yield started, PATH_VARIABLE if named else "system"
    elif named:
        yield _named_library(named), PATH_VARIABLE
    else:
        pip_libraries = _pip_libraries()
        for path in pip_libraries[:1]:
            yield path, "karellen-llvm-core"
        for path in _system_libraries():
            if path not in pip_libraries:
                yield path, "system"


def _started_library() -> Path | None:
    """Library that Dr.Jit runs on already, because drjit was imported first."""
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
    """Library that the user names: a path, or a bare name in the folders of the dynamic loader."""
    if "/" in name:
        return Path(name).absolute()
    folders = os.environ.get("LD_LIBRARY_PATH", "").split(":") + _system_folders()
    return next((Path(folder, name) for folder in folders if folder and Path(folder, name).exists()), Path(name))


def _pip_libraries() -> list[Path]:
    """Real files of the libLLVM that pip installed."""
    with suppress(metadata.PackageNotFoundError):
        files = metadata.distribution("karellen-llvm-core").files or []
        located = [Path(str(file.locate())) for file in files if _VERSIONED_NAME.fullmatch(file.name)]
        return list(dict.fromkeys(path.resolve() for path in located if path.exists()))
    return []


def _system_folders() -> list[str]:
    return [folder for pattern in SYSTEM_FOLDERS for folder in sorted(glob.glob(pattern))]


def _system_libraries() -> list[Path]:
    """Real files of every libLLVM that is new enough, newest first."""
    found = {path.resolve() for folder in _system_folders() for path in Path(folder).glob("libLLVM*.so*")}
    return sorted((path for path in found if _name_major(path) >= OLDEST_MAJOR), key=_name_major, reverse=True)


def _name_version(path: Path) -> str:
    match = _VERSIONED_NAME.fullmatch(path.resolve().name)
    return (match[1] or match[2]).strip(".") if match else ""


def _name_major(path: Path) -> int:
    return int(_name_version(path).partition(".")[0] or 0)


def _verdict(path: Path) -> _Verdict:
    """Verdict on a library, from the cache where it is known to work."""
    if not path.is_file():
        return _Verdict("", "no such file")
    cache = _cache_file(path)
    with suppress(OSError, ValueError, TypeError):
        if cache is not None:
            return _Verdict(**json.loads(cache.read_text(encoding="utf-8")))
    verdict = _probe(path)
    if cache is not None and not verdict.fault:
        with suppress(OutputError), atomic_write(cache, "w") as stream:
            json.dump({"version": verdict.version, "fault": ""}, stream)
    return verdict


def _cache_file(path: Path) -> Path | None:
    """Where the verdict on a library is kept: one file for each library, host software and processor."""
    stat = path.stat()
    key = [
        str(path.resolve()),
        stat.st_mtime_ns,
        stat.st_size,
        _host_version("drjit"),
        _host_version("sionna-rt"),
        _processor(),
    ]
    digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:24]
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None
    return folder / "sionna_partial" / f"llvm-{digest}.json"


def _host_version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        raise BackendError(f"{name} is not installed: run pip install sionna-partial again.") from None


def _processor() -> str:
    """Model and instruction sets of the processor, which LLVM compiles for."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return "".join(next((line for line in lines if line.startswith(key)), "") for key in ("model name", "flags"))
    return ""


def _probe(path: Path) -> _Verdict:
    """Solve paths with a library in a child process, which an unfit library aborts."""
    _log.info("trying LLVM %s", path)
    modules = os.pathsep.join(folder or os.getcwd() for folder in sys.path)
    environment = os.environ | {PATH_VARIABLE: str(path), "PYTHONPATH": modules}
    command = [sys.executable, "-P", "-m", "sionna_partial.llvm_probe", str(path)]
    try:
        child = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return _Verdict("", f"no answer within {PROBE_TIMEOUT_S} s")
    with suppress(ValueError, TypeError):
        return _Verdict(**json.loads(child.stdout.rpartition("\n")[2]))
    lines = [line.strip() for line in child.stderr.splitlines() if line.strip()]
    error = next((line for line in lines if "LLVM ERROR" in line), lines[-1] if lines else "it crashed")
    return _Verdict("", f"{error[:120]}, exit code {child.returncode}")
