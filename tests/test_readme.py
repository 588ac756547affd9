"""The README's lines run as they stand, one after the other, on a shipped map."""

import re
import shutil
from pathlib import Path

import matplotlib as mpl
import pytest
import trimesh

from sionna_partial.resources import scenes_folder

README = Path(__file__).resolve().parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    """Code blocks of the README in one language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```$", README.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )


def test_python_lines_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mpl.use("Agg")
    for name in ("map.yaml", "map.pgm"):
        shutil.copy(scenes_folder() / "apartment" / "step100" / name, tmp_path)
    trimesh.creation.box((7.0, 5.0, 3.0), transform=trimesh.transformations.translation_matrix((3, 2, 1.5))).export(
        tmp_path / "scan.ply"
    )
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(block, names)
    assert (tmp_path / "coverage.nc").stat().st_size > 10_000
    assert (tmp_path / "coverage.png").stat().st_size > 10_000
    assert (tmp_path / "scene" / "scene.xml").is_file()
    assert len(names["maps"]) == 4  # type: ignore[arg-type]


def test_files_that_are_linked_are_there() -> None:
    text = README.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)]+)\)", text) if "://" not in link]
    assert links
    assert [link for link in links if not (README.parent / link).is_file()] == []


def test_make_targets_that_are_named_exist() -> None:
    makefile = (README.parent / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"`make ([a-z-]+)`", README.read_text(encoding="utf-8"))):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
