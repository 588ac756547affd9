import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from coverage_fakes import PICTURE, map_of
from meshes import room

from sionna_partial.errors import OutputError
from sionna_partial.inverse.placement_climb import Climb
from sionna_partial.inverse.placement_state import PlacementState, search_fingerprint, write_json
from sionna_partial.maps.map_files import load_map

STARTS_M, SCORES = np.array([[0.1, 1.0 / 3.0, 1.5], [2.0, 3.0, 1.5]]), np.array([0.5, 1.0 / 7.0])
CLIMB = Climb(STARTS_M[:1], SCORES[:1])


class TestPlacementState:
    def test_goes_on_with_the_same_numbers(self, tmp_path: Path) -> None:
        path = tmp_path / "search.json"
        PlacementState(path, "a").keep(STARTS_M, SCORES, [CLIMB], 2)
        again = PlacementState(path, "a")
        assert again.starts_m.tobytes() == STARTS_M.tobytes()
        assert again.start_scores.tobytes() == SCORES.tobytes()
        assert [climb.record for climb in again.climbs] == [CLIMB.record]
        assert again.steps == 2

    def test_begins_with_nothing(self, tmp_path: Path) -> None:
        for path in (None, tmp_path / "search.json"):
            state = PlacementState(path, "a")
            assert (len(state.starts_m), len(state.climbs), state.steps) == (0, 0, 0)
        assert list(tmp_path.iterdir()) == []

    def test_another_search(self, tmp_path: Path) -> None:
        path = tmp_path / "search.json"
        PlacementState(path, "a").keep(STARTS_M, SCORES, [], 0)
        with pytest.raises(OutputError, match=r"search\.json' is that of another map or other arguments: remove it"):
            PlacementState(path, "b")

    @pytest.mark.parametrize("text", ["", "[]", "{}", '{"search": "a", "starts_m": 3}', "\x00"])
    def test_damaged_file(self, text: str, tmp_path: Path) -> None:
        path = tmp_path / "search.json"
        path.write_text(text, encoding="utf-8")
        with pytest.raises(OutputError, match=r"search\.json' is not that of a search .*: remove it, or choose"):
            PlacementState(path, "a")

    def test_folder(self, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match="is not that of a search"):
            PlacementState(tmp_path, "a")


class TestFingerprint:
    def test_of_equal_searches(self) -> None:
        assert search_fingerprint(map_of(PICTURE), {"seed": 1}) == search_fingerprint(map_of(PICTURE), {"seed": 1})

    def test_of_others(self, tmp_path: Path) -> None:
        room().export(tmp_path / "room.ply")
        mesh, partial = load_map(tmp_path / "room.ply"), map_of(PICTURE)
        assert mesh.mesh is not None
        higher = dataclasses.replace(mesh.mesh, vertices_m=np.add(mesh.mesh.vertices_m, [0.0, 0.0, 1e-3]))
        maps = [
            *(partial, map_of(PICTURE.replace("..#?", ".##?")), dataclasses.replace(partial, resolution_m=0.4)),
            *(dataclasses.replace(partial, origin_m=(0.0, 0.0)), dataclasses.replace(partial, wall_height_m=2.5)),
            *(mesh, dataclasses.replace(mesh, mesh=higher)),
        ]
        found = [search_fingerprint(each, {"seed": 1}) for each in maps]
        assert len({*found, search_fingerprint(partial, {"seed": 2})}) == len(maps) + 1


def test_equal_records_are_equal_files(tmp_path: Path) -> None:
    write_json(tmp_path / "a", {"x": 0.1, "y": [1, 2]})
    write_json(tmp_path / "b", {"y": [1, 2], "x": 0.1})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert json.loads((tmp_path / "a").read_text()) == {"x": 0.1, "y": [1, 2]}
