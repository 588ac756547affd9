"""What a search for a place has found so far: in memory, and in a file from which a stopped search goes on."""

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.errors import OutputError
from sionna_partial.files import atomic_write
from sionna_partial.inverse.placement_climb import Climb
from sionna_partial.maps.partial_map import PartialMap


class PlacementState:
    """Starts and climbs of a search.

    Parameters
    ----------
    path : path-like or None
        JSON file that is read if it is there, and written whenever something was found.
    fingerprint : str
        Of the map and the arguments (`search_fingerprint`).

    Raises
    ------
    OutputError
        If the file is not that of this search.

    Attributes
    ----------
    starts_m : (S, 3) float64 array
        Places that were looked at to choose where climbs start [m]; none in the beginning.
    start_scores : (S,) float64 array
        The objective there.
    climbs : list of Climb
    steps : int
        Number of steps that they have taken.
    """

    def __init__(self, path: str | os.PathLike[str] | None, fingerprint: str) -> None:
        self._path, self._fingerprint = path, fingerprint
        self.starts_m, self.start_scores = np.zeros((0, 3)), np.zeros(0)
        self.climbs: list[Climb] = []
        self.steps = 0
        if path is not None and Path(path).exists():
            self._read(Path(path))

    def keep(
        self, starts_m: NDArray[np.float64], start_scores: NDArray[np.float64], climbs: Sequence[Climb], steps: int
    ) -> None:
        """Note what was found."""
        self.starts_m, self.start_scores, self.climbs, self.steps = starts_m, start_scores, list(climbs), steps
        if self._path is not None:
            record = {
                "search": self._fingerprint,
                "starts_m": starts_m.tolist(),
                "start_scores": start_scores.tolist(),
                "steps": steps,
                "climbs": [climb.record for climb in climbs],
            }
            write_json(self._path, record)

    def _read(self, path: Path) -> None:
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            same = record["search"] == self._fingerprint
            self.starts_m, self.start_scores = np.array(record["starts_m"]), np.array(record["start_scores"])
            self.climbs = [Climb.of_record(each) for each in record["climbs"]]
            self.steps = int(record["steps"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise OutputError(
                f"checkpoint = '{path}' is not that of a search ({error!r}): remove it, or choose another name."
            ) from error
        if not same:
            raise OutputError(
                f"checkpoint = '{path}' is that of another map or other arguments: remove it, or choose another name."
            )


def write_json(path: str | os.PathLike[str], record: dict[str, Any]) -> None:
    """Write a JSON file, whole or not at all; equal records give equal bytes."""
    with atomic_write(path, "w") as stream:
        stream.write(json.dumps(record, indent=1, sort_keys=True) + "\n")


def search_fingerprint(partial: PartialMap, settings: dict[str, Any]) -> str:
    """SHA-256 of a map and of the settings of a search, in hexadecimal: of all that its result depends on."""
    found = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    found.update(repr((partial.shape, partial.resolution_m, partial.origin_m, partial.height_range_m)).encode())
    found.update(partial.state.tobytes())
    if partial.mesh is not None:
        found.update(partial.mesh.vertices_m.tobytes() + partial.mesh.triangles.tobytes())
        found.update(repr(partial.mesh.materials).encode() + partial.mesh.material.tobytes())
    return found.hexdigest()
