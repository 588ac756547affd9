"""Files that ship with the package, and optional libraries."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sionna_partial.errors import BackendError, SceneError, SionnaPartialError

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
