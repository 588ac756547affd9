"""What a search for a place has found so far: in memory, and in a file from which a stopped search goes on."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.checkpoint import Checkpoint
from sionna_partial.placement.climb import Climb


class PlacementState:
    """Starts and climbs of a search.

    Parameters
    ----------
    checkpoint : Checkpoint
        It is read if there is one, and written whenever something was found.

    Raises
    ------
    OutputError
        If the checkpoint is not that of this search.

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

    def __init__(self, checkpoint: Checkpoint) -> None:
        self._checkpoint = checkpoint
        begun = np.zeros((0, 3)), np.zeros(0), list[Climb](), 0
        self.starts_m, self.start_scores, self.climbs, self.steps = checkpoint.read(_parsed) or begun

    def keep(
        self, starts_m: NDArray[np.float64], start_scores: NDArray[np.float64], climbs: Sequence[Climb], steps: int
    ) -> None:
        """Note what was found."""
        self.starts_m, self.start_scores, self.climbs, self.steps = starts_m, start_scores, list(climbs), steps
        record = {
            "starts_m": starts_m.tolist(),
            "start_scores": start_scores.tolist(),
            "steps": steps,
            "climbs": [climb.record for climb in climbs],
        }
        self._checkpoint.write(record)


def _parsed(record: Mapping[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64], list[Climb], int]:
    climbs = [Climb.of_record(each) for each in record["climbs"]]
    return np.array(record["starts_m"]), np.array(record["start_scores"]), climbs, int(record["steps"])
