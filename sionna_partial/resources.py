"""Files that ship with the package, optional libraries, and names that load theirs on first use."""

import ast
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from sionna_partial.errors import BackendError, SceneError, SionnaPartialError
from sionna_partial.process import signals_held

EXTRAS = {
    "app": ("bokeh", "tornado"),
    "channels": ("dask", "zarr"),
    "datasets": ("dask", "distributed", "pyarrow", "rasterio"),
    "geo": ("rasterio",),
    "ifc": ("ifcopenshell",),
    "live": ("cyclonedds", "rosbags", "websockets"),
    "maps": ("ezdxf", "laspy", "lazrs", "pypcd4", "rosbags"),
}
"""Optional packages by extra of pyproject.toml; `all` installs every one."""

HOMES_FILE = "homes.json"
"""File in the scenes folder with the origin of each home and its transmitter position."""

_PACKAGE = Path(__file__).resolve().parent

PREDICTORS_FOLDER = _PACKAGE / "predictors"


@contextmanager
def optional_packages(error: type[SionnaPartialError] = BackendError) -> Iterator[None]:
    """Turn a failed import of an optional package into an `error` with the command that installs it."""
    try:
        yield
    except ImportError as cause:
        package = (cause.name or "").partition(".")[0]
        extras = [extra for extra, packages in EXTRAS.items() if package in packages]
        if not extras:
            raise
        remedy = " or ".join(f"pip install '.[{extra}]'" for extra in extras)
        raise error(f"{package} is not installed: {remedy} in the repository, or '.[all]'.") from cause


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose stub `__init__.pyi` lists its public names."""
    this = sys.modules[package]
    stub = ast.parse(Path(str(this.__file__)).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    module_of = {alias.name: str(node.module) for node in imports for alias in node.names}

    def load(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with signals_held(), optional_packages():
            module = import_module(module_of[name])
            is_module = hasattr(module, "__path__")  # packages offer their modules, modules what they define
            value = import_module(f"{module.__name__}.{name}") if is_module else getattr(module, name)
        setattr(this, name, value)
        return value

    names = sorted(module_of)
    return load, lambda: names, names


def scenes_folder() -> Path:
    """Return the folder of the demo scenes: inside the installed package, or at the top of the repository."""
    for folder in (_PACKAGE / "scenes", _PACKAGE.parent / "scenes"):
        if (folder / HOMES_FILE).is_file():
            return folder
    raise SceneError(f"The demo scenes are missing in '{_PACKAGE / 'scenes'}': install sionna-partial again.")


def demo_homes() -> dict[str, dict[str, Any]]:
    """Return the demo homes by name, each a folder in `scenes_folder`.

    "transmitter" is the position (x, y, z) [m], the rest is how the home was made.
    """
    path = scenes_folder() / HOMES_FILE
    try:
        homes = json.loads(path.read_text(encoding="utf-8"))
        return {name: home | {"transmitter": tuple(map(float, home["transmitter"]))} for name, home in homes.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise SceneError(f"path = '{path}' cannot be read ({error!r}): install sionna-partial again.") from error
