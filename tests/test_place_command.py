"""The command place: what it passes on, what it writes and prints, and how it fails."""

import json
from pathlib import Path

import pytest
from PIL import Image
from placement_cases import TWO_ROOMS, home
from typer.testing import CliRunner, Result

from sionna_partial import cli
from sionna_partial.maps.map_files import save_map

pytestmark = pytest.mark.usefixtures("command_line")


@pytest.fixture
def map_path(tmp_path: Path) -> Path:
    save_map(home(TWO_ROOMS), tmp_path / "map.yaml")
    return tmp_path / "map.yaml"


def run(*args: object) -> Result:
    return CliRunner().invoke(cli.app, ["place", *(str(arg) for arg in args)])


def test_what_it_writes_and_says(map_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "place"
    result = run(map_path, "--out", out)
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
    result = run(map_path, "--out", tmp_path / "place", "--objective", "percentile")
    assert "\nthe worst tenth of the receivers is predicted at " in result.stdout


def test_options(map_path: Path, tmp_path: Path) -> None:
    options = ["--threshold", -90, "--height", 2, "--rx-height", 1, "--seed", 3, "--frequency", 27e9, "--max-depth", 0]
    assert run(map_path, "--out", tmp_path / "place", *options, "--material", "concrete").exit_code == 0
    settings = json.loads((tmp_path / "place" / "placement.json").read_text())["settings"]
    expected = {"threshold_db": -90.0, "tx_height_m": 2.0, "rx_height_m": 1.0, "seed": 3, "objective": "coverage"}
    assert {name: settings[name] for name in expected} == expected
    assert (settings["trace_settings"]["frequency_hz"], settings["trace_settings"]["max_depth"]) == (27e9, 0)
    assert settings["scene_settings"]["material"]["itu"] == "concrete"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--threshold", 3], "error: threshold_db = 3.0 is not allowed: give a number in (-150, 0]."),
        (["--height", 9], "error: tx_height_m = 9.0 is not allowed: give a number in (0, 3]."),
    ],
)
def test_errors_are_one_line(options: list[object], message: str, map_path: Path, tmp_path: Path) -> None:
    result = run(map_path, "--out", tmp_path / "place", *options)
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1] == message
    assert not (tmp_path / "place").exists()


def test_unknown_objective(map_path: Path, tmp_path: Path) -> None:
    result = run(map_path, "--out", tmp_path / "place", "--objective", "best")
    assert result.exit_code == 2
    assert "'best' is not one of 'coverage', 'percentile'" in result.stderr
