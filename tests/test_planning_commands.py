"""The commands place and calibrate: files, what is printed, and errors."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import run
from PIL import Image
from placement_cases import TWO_ROOMS, home

import sionna_partial as sp

pytestmark = pytest.mark.usefixtures("command_line", "short_search")

HEADER = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,gain_db"
HIDDEN = sp.Material(5.0, 2.0, 0.01)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    state = np.zeros((40, 50), dtype=np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = sp.CellState.WALL
    state[:28, 25] = sp.CellState.WALL
    room = sp.PartialMap(state, 0.1)
    sp.save_map(room, folder / "room.yaml")
    rng = np.random.default_rng(0)
    tx, rx = np.array([1.0, 1.0, 1.5]), rng.uniform([2.8, 0.3, 1.0], [4.7, 3.7, 2.0], (24, 3))
    links = sp.trace_links(
        room, tx, rx, trace_settings=sp.TraceSettings(max_depth=2), scene_settings=sp.SceneSettings(material=HIDDEN)
    )
    rows = [
        ",".join(f"{value:.6f}" for value in (*tx, *position, gain))
        for position, gain in zip(rx, links.gain_db, strict=True)
    ]
    (folder / "measured.csv").write_text("\n".join([HEADER, *rows, ""]))
    return folder


def test_calibrate(measured: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run(
        "calibrate",
        *(measured / "room.yaml", "--measurements", measured / "measured.csv", "--out", out),
        *("--material", "2.94,0.1226,0.01", "--max-depth", 2),
    )
    assert sorted(file.name for file in out.iterdir()) == ["calibrated.npz", "calibration.json", "calibration.png"]
    numbers = json.loads((out / "calibration.json").read_text())
    calibrated = sp.load_map(out)
    assert calibrated == sp.load_map(out / "calibrated.npz")
    assert calibrated.material == sp.Material(numbers["permittivity"], numbers["conductivity_s_m"], 0.01)
    assert numbers["rmse_db"]["after"] < numbers["rmse_db"]["before"]
    assert numbers["start"][0]["relative_permittivity"] == 2.94
    assert (out / "calibration.png").stat().st_size > 10_000
    for words in (
        "permittivity ",
        "(start 2.94)",
        " (start 0.1226 S/m)",
        "24 used; left out: none",
        "dB at 45 deg",
    ):
        assert words in result.output
    doubts = [line for line in result.output.splitlines() if line.endswith("CANNOT BE DETERMINED")]
    assert {line.split()[0] for line in doubts} == {*numbers["undetermined"]}
    assert f"wrote {out / 'calibrated.npz'}" in result.output


def test_unusable_measurements_are_one_line(measured: Path, tmp_path: Path) -> None:
    rows = ["1,1,1.5,3,3,1.5,-70", "1,1,1.5,3,2,1.5,-70"]
    (tmp_path / "bad.csv").write_text("\n".join([HEADER, *rows, ""]))
    words = ("--measurements", tmp_path / "bad.csv", "--out", tmp_path / "out")
    result = run("calibrate", measured / "room.yaml", *words, exit_code=2)
    assert "has 2 usable links of 2, fewer than 10" in result.output
    assert not (tmp_path / "out").exists()


@pytest.fixture
def map_path(tmp_path: Path) -> Path:
    sp.save_map(home(TWO_ROOMS), tmp_path / "map.yaml")
    return tmp_path / "map.yaml"


def test_place(map_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "place"
    result = run("place", map_path, "--out", out)
    record = json.loads((out / "placement.json").read_text())
    x, y, z = record["position_m"]
    assert result.stdout.splitlines() == [
        f"transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m",
        f"{record['score']:.1%} of the receivers are predicted above -100 dB",
        f"wrote {out / 'placement.json'}",
        f"wrote {out / 'placement.png'}",
    ]
    with Image.open(out / "placement.png") as picture:
        assert picture.width > 500


def test_worst_tenth(map_path: Path, tmp_path: Path) -> None:
    result = run("place", map_path, "--out", tmp_path / "place", "--objective", "percentile")
    assert "\nthe worst tenth of the receivers is predicted at " in result.stdout


def test_how_many_and_where(map_path: Path, tmp_path: Path) -> None:
    options = ("--count", "3", "--goal", "1", "--threshold", "-60", "--out", tmp_path / "place")
    lines = run("place", map_path, *options).stdout.splitlines()
    record = json.loads((tmp_path / "place" / "placement.json").read_text())
    added = [float(line.rpartition(" adds ")[2].rstrip("%")) for line in lines[:3]]
    assert added == pytest.approx([100.0 * record["scores"][0], *100.0 * np.diff(record["scores"])], abs=0.06)
    assert lines[3].startswith("the goal of 100.0% is not reached: give a larger --count")
    result = run(
        "place", map_path, "--goal", "1", "--objective", "percentile", "--out", tmp_path / "other", exit_code=2
    )
    assert "leave out --count and --goal" in result.stderr
