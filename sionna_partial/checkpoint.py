"""A file that keeps what a run has found: one that was stopped goes on from there."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sionna_partial.errors import OutputError
from sionna_partial.files import atomic_write, output_path
from sionna_partial.maps.partial_map import PartialMap

Found = TypeVar("Found")


class Checkpoint:
    """A JSON file of one run.

    Parameters
    ----------
    path : path-like or None
        None keeps nothing.
    fingerprint : str
        Of the run (`run_fingerprint`).

    Raises
    ------
    OutputError
        If `path` is no path.
    """

    def __init__(self, path: str | os.PathLike[str] | None, fingerprint: str) -> None:
        self.path: Path | None = None if path is None else output_path(path)
        self._fingerprint = fingerprint

    def read(self, parse: Callable[[Any], Found]) -> Found | None:
        """Return what the file keeps, as `parse` makes it of what was written; None if there is no file.

        Raises
        ------
        OutputError
            If the file is not that of this run.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            record = json.loads(self.path.read_bytes())
            same, found = record["fingerprint"] == self._fingerprint, parse(record["found"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise OutputError(
                f"checkpoint = '{self.path}' is not what a run has kept ({error!r}): remove it, or choose another name."
            ) from error
        if not same:
            raise OutputError(
                f"checkpoint = '{self.path}' is that of another map or other arguments: remove it, or choose another "
                "name."
            )
        return found

    def write(self, found: object) -> None:
        """Keep what was found, which JSON can have."""
        if self.path is not None:
            write_json(self.path, {"fingerprint": self._fingerprint, "found": found})


def write_json(path: str | os.PathLike[str], record: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all; equal records give equal bytes."""
    with atomic_write(path, "w") as stream:
        stream.write(json.dumps(record, indent=1, sort_keys=True) + "\n")


def run_fingerprint(partial: PartialMap, settings: Mapping[str, Any], *arrays: NDArray[np.float64]) -> str:
    """SHA-256 of all that a run's result depends on, in hexadecimal: a map, settings that JSON can have, and arrays."""
    found = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    found.update(repr((partial.shape, partial.resolution_m, partial.origin_m, partial.height_range_m)).encode())
    found.update(partial.state.tobytes())
    if partial.mesh is not None:
        found.update(partial.mesh.vertices_m.tobytes() + partial.mesh.triangles.tobytes())
        found.update(repr(partial.mesh.materials).encode() + partial.mesh.material.tobytes())
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()
