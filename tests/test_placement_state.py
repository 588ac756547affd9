from pathlib import Path

import numpy as np
import pytest

from sionna_partial.checkpoint import Checkpoint
from sionna_partial.errors import OutputError
from sionna_partial.placement.climb import Climb
from sionna_partial.placement.state import PlacementState

STARTS_M, SCORES = np.array([[0.1, 1.0 / 3.0, 1.5], [2.0, 3.0, 1.5]]), np.array([0.5, 1.0 / 7.0])
CLIMB = Climb(STARTS_M[:1], SCORES[:1])


class TestPlacementState:
    def test_goes_on_with_the_same_numbers(self, tmp_path: Path) -> None:
        checkpoint = Checkpoint(tmp_path / "search.json", "a")
        PlacementState(checkpoint).keep(STARTS_M, SCORES, [CLIMB], 2)
        again = PlacementState(checkpoint)
        assert again.starts_m.tobytes() == STARTS_M.tobytes()
        assert again.start_scores.tobytes() == SCORES.tobytes()
        assert [climb.record for climb in again.climbs] == [CLIMB.record]
        assert again.steps == 2

    def test_begins_with_nothing(self, tmp_path: Path) -> None:
        for path in (None, tmp_path / "search.json"):
            state = PlacementState(Checkpoint(path, "a"))
            assert (len(state.starts_m), len(state.climbs), state.steps) == (0, 0, 0)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("found", [None, [], {}, {"starts_m": 3}])
    def test_what_no_search_keeps(self, found: object, tmp_path: Path) -> None:
        checkpoint = Checkpoint(tmp_path / "search.json", "a")
        checkpoint.write(found)
        with pytest.raises(OutputError, match=r"search\.json' is not what a run has kept .*: remove it, or choose"):
            PlacementState(checkpoint)
