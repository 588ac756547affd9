"""The command place: what it passes on, what it writes and prints, and how it fails."""

import json
from pathlib import Path

import pytest
from commands import run
from PIL import Image
from placement_cases import TWO_ROOMS, home

from sionna_partial.maps.map_files import save_map

pytestmark = pytest.mark.usefixtures("command_line")


@pytest.fixture
def map_path(tmp_path: Path) -> Path:
    save_map(home(TWO_ROOMS), tmp_path / "map.yaml")
    return tmp_path / "map.yaml"


def test_what_it_writes_and_says(map_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "place"
    result = run("place", map_path, "--out", out)
    assert result.exit_code == 0, result.output
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--threshold", 3], "error: threshold_db = 3.0 is not allowed: give a number in (-150, 0]."),
        (["--height", 9], "error: tx_height_m = 9.0 is not allowed: give a number in (0, 3]."),
    ],
)
def test_errors_are_one_line(options: list[object], message: str, map_path: Path, tmp_path: Path) -> None:
    result = run("place", map_path, "--out", tmp_path / "place", *options)
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1] == message
    assert not (tmp_path / "place").exists()


def test_unknown_objective(map_path: Path, tmp_path: Path) -> None:
    result = run("place", map_path, "--out", tmp_path / "place", "--objective", "best")
    assert result.exit_code == 2
    assert "'best' is not one of 'coverage', 'percentile'" in result.stderr
