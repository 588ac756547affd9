"""Predict radio coverage from a robot's partial map of a building.

Public names, listed in `__init__.pyi`, load their modules and libraries on first use. The import also chooses the LLVM
library of Dr.Jit: import this package before `sionna.rt`, `mitsuba` or `drjit`.
"""

import ast
import sys
from importlib import import_module
from importlib.util import find_spec as _find_spec
from pathlib import Path

from sionna_partial.llvm import choose_llvm as _choose_llvm
from sionna_partial.process import signals_held as _signals_held
from sionna_partial.resources import optional_packages as _optional_packages

__version__ = "0.1.0"

_choose_llvm()

if "coverage" not in sys.modules and getattr(_find_spec("coverage"), "origin", "") is None:
    # a folder of that name, as of results, is no library: numba, which looks for one, would fail on it
    sys.modules["coverage"] = None  # type: ignore[assignment]

_MODULE_OF = {
    alias.name: str(node.module)
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
__all__ = sorted([*_MODULE_OF, "__version__"])


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with _signals_held(), _optional_packages():
        value: object = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
