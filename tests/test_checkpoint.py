import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from coverage_fakes import PICTURE, map_of
from meshes import room

from sionna_partial.checkpoint import Checkpoint, run_fingerprint, write_json
from sionna_partial.errors import OutputError
from sionna_partial.maps.map_files import load_map


class TestCheckpoint:
    def test_keeps_what_was_found(self, tmp_path: Path) -> None:
        checkpoint = Checkpoint(tmp_path / "run.json", "a")
        assert checkpoint.read(list) is None
        checkpoint.write([1.0 / 3.0, 2])
        assert Checkpoint(tmp_path / "run.json", "a").read(tuple) == (1.0 / 3.0, 2)

    def test_without_a_path_it_keeps_nothing(self) -> None:
        checkpoint = Checkpoint(None, "a")
        checkpoint.write([1])
        assert checkpoint.read(list) is None

    def test_of_another_run(self, tmp_path: Path) -> None:
        Checkpoint(tmp_path / "run.json", "a").write([1])
        before = (tmp_path / "run.json").read_bytes()
        with pytest.raises(OutputError, match=r"run\.json' is that of another map or other arguments: remove it"):
            Checkpoint(tmp_path / "run.json", "b").read(list)
        assert (tmp_path / "run.json").read_bytes() == before

    @pytest.mark.parametrize("text", ["", "[]", "{}", '{"fingerprint": "a"}', '{"fingerprint": "a", "found": 3}', "\0"])
    def test_damaged_file(self, text: str, tmp_path: Path) -> None:
        (tmp_path / "run.json").write_text(text, encoding="utf-8")
        with pytest.raises(OutputError, match=r"run\.json' is not what a run has kept .*: remove it, or choose"):
            Checkpoint(tmp_path / "run.json", "a").read(list)

    def test_folder(self, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match="is not what a run has kept"):
            Checkpoint(tmp_path, "a").read(list)

    def test_no_path(self) -> None:
        with pytest.raises(OutputError, match=re.escape("path = 3 is not a path")):
            Checkpoint(3, "a")  # type: ignore[arg-type]


class TestFingerprint:
    def test_of_equal_runs(self) -> None:
        one, other = (run_fingerprint(map_of(PICTURE), {"seed": 1}, np.arange(3.0)) for _ in range(2))
        assert one == other

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
        found = [run_fingerprint(each, {"seed": 1}) for each in maps]
        found += [run_fingerprint(partial, {"seed": 2}), run_fingerprint(partial, {"seed": 1}, np.ones(2))]
        assert len(set(found)) == len(maps) + 2


def test_equal_records_are_equal_files(tmp_path: Path) -> None:
    write_json(tmp_path / "a", {"x": 0.1, "y": [1, 2]})
    write_json(tmp_path / "b", {"y": [1, 2], "x": 0.1})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert json.loads((tmp_path / "a").read_text()) == {"x": 0.1, "y": [1, 2]}
