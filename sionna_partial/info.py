"""Report on this machine: installed parts, missing parts and remedies."""

import platform
import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from sionna_partial import __version__
from sionna_partial.errors import SionnaPartialError
from sionna_partial.llvm import load_llvm
from sionna_partial.prediction.predictor import SHIPPED
from sionna_partial.resources import PREDICTORS_FOLDER, demo_homes
from sionna_partial.tracing.engine import REMEDY, engine_fault

LIBRARIES = ("sionna-rt", "mitsuba", "drjit", "tensorflow-cpu", "keras", "numpy")
"""PyPI packages whose versions are reported; others only if they are missing."""


@dataclass(frozen=True)
class Finding:
    """A line of the report; the remedy is "" if all is well."""

    name: str
    value: str
    remedy: str = ""


def findings() -> Iterator[Finding]:
    """Yield findings on platform, LLVM, libraries and shipped data."""
    yield Finding("sionna-partial", __version__)
    yield _python()
    yield Finding("processor", _processor_name())
    yield from _llvm()
    yield from map(_library, LIBRARIES)
    yield from (finding for finding in map(_library, _other_libraries()) if finding.remedy)
    yield _predictors()
    yield _demo_scenes()


def _python() -> Finding:
    system, machine = platform.system(), platform.machine()
    supported = (system, machine) == ("Linux", "x86_64")
    remedy = "" if supported else "sionna-partial is made for x86-64 Linux: use such a machine or a container."
    return Finding("Python", f"{platform.python_version()} on {platform.platform()}", remedy)


def _processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.machine())


def _llvm() -> Iterator[Finding]:
    try:
        library = load_llvm()
    except SionnaPartialError as error:
        yield Finding("LLVM", "not usable", str(error))
    else:
        yield Finding("LLVM", library.version)
        yield Finding("LLVM library", str(library.path))
        yield Finding("LLVM source", library.source)
        yield _fast_engine()


def _fast_engine() -> Finding:
    try:
        fault = engine_fault()
    except (ImportError, SionnaPartialError) as error:
        return Finding("fast engine", "off", str(error))
    return Finding("fast engine", f"off: {fault}", REMEDY) if fault else Finding("fast engine", "on")


def _other_libraries() -> list[str]:
    try:
        required = metadata.requires("sionna-partial") or []
    except metadata.PackageNotFoundError:
        return []
    names = [re.split(r"[^\w.-]", line)[0] for line in required if "extra ==" not in line]
    return [name for name in names if name not in LIBRARIES]


def _library(name: str) -> Finding:
    try:
        return Finding(name, metadata.version(name))
    except metadata.PackageNotFoundError:
        return Finding(name, "not installed", f"run pip install {name}, or install sionna-partial again.")


def _predictors() -> Finding:
    found = ", ".join(name for name in SHIPPED if (PREDICTORS_FOLDER / f"{name}.keras").is_file())
    remedy = "" if found else f"'{PREDICTORS_FOLDER}' holds none: install sionna-partial again."
    return Finding("predictors", found or "none", remedy)


def _demo_scenes() -> Finding:
    try:
        return Finding("demo scenes", ", ".join(demo_homes()))
    except SionnaPartialError as error:
        return Finding("demo scenes", "none", str(error))
