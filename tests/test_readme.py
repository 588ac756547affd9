"""The README's lines run as they stand, one after the other, on a shipped map."""

import re
import shutil
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import trimesh

import sionna_partial as sp
from sionna_partial.calibration import material_search
from sionna_partial.resources import scenes_folder

README = Path(__file__).resolve().parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    """Code blocks of the README in one language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```$", README.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )


def write_measurements(folder: Path) -> None:
    """Write made-up gains of 30 links beside the map."""
    partial = sp.load_map(folder / "map.yaml")
    cells = np.argwhere(partial.state == sp.CellState.FREE)
    rx = cells[np.random.default_rng(0).choice(len(cells), 30, replace=False)][:, ::-1] + 0.5
    rx = np.column_stack([rx * partial.resolution_m + partial.origin_m, np.full(30, 1.5)])
    links = sp.trace_links(partial, (7.0, 9.8, 1.5), rx)
    rows = np.column_stack([np.tile(links.tx, (30, 1)), rx, links.gain_db])
    header = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,gain_db"
    np.savetxt(folder / "measured.csv", rows, delimiter=",", header=header, comments="")


def test_python_lines_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mpl.use("Agg")
    for name in ("map.yaml", "map.pgm"):
        shutil.copy(scenes_folder() / "apartment" / "step100" / name, tmp_path)
    trimesh.creation.box((7.0, 5.0, 3.0), transform=trimesh.transformations.translation_matrix((3, 2, 1.5))).export(
        tmp_path / "scan.ply"
    )
    write_measurements(tmp_path)
    for name, value in {"MOST_TEETH": 1, "MOST_CELLS": 60, "FEW_TEETH": 1, "TEETH_PARTS": 1, "COARSE_PARTS": 8}.items():
        monkeypatch.setattr(material_search, name, value)  # a short search
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(block, names)
    assert (tmp_path / "calibration.png").stat().st_size > 10_000
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
