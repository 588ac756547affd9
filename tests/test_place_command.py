"""The command place: what it passes on, what it writes and says, and how it fails."""

import json
from pathlib import Path
from typing import Any

import pytest
from coverage_fakes import map_of
from PIL import Image
from placement_fakes import HALF_SEEN, use_fake_search
from typer.testing import CliRunner, Result

import sionna_partial as sp
from sionna_partial import cli
from sionna_partial.maps.map_files import save_map
from sionna_partial.placement import placement

pytestmark = pytest.mark.usefixtures("command_line")


@pytest.fixture
def map_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    use_fake_search(monkeypatch)
    save_map(map_of(HALF_SEEN, 0.5, (0.0, 0.0)), tmp_path / "map.yaml")
    return tmp_path / "map.yaml"


def run(*args: object) -> Result:
    return CliRunner().invoke(cli.app, ["place", *(str(arg) for arg in args)])


def test_what_it_writes_and_says(map_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "place"
    result = run(map_path, "--out", out)
    assert result.exit_code == 0, result.output
    record = json.loads((out / "placement.json").read_text())
    x, y, z = record["position_m"]
    covered = f"{record['score']:.1%} of the receivers are predicted above -100 dB"
    assert result.stdout.splitlines() == [
        f"transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m: {covered}",
        f"wrote {out / 'placement.json'}",
        f"wrote {out / 'placement.png'}",
    ]
    with Image.open(out / "placement.png") as picture:
        assert picture.width > 500


def test_worst_places(map_path: Path, tmp_path: Path) -> None:
    result = run(map_path, "--out", tmp_path / "place", "--objective", "percentile")
    assert "m: the worst tenth of the receivers is predicted at " in result.stdout


def test_what_it_passes_on(map_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[dict[str, Any]] = []
    true = placement.place_transmitter

    def place_transmitter(scene: Any, **options: Any) -> placement.TransmitterPlacement:
        calls.append(options)
        return true(scene, seed=options["seed"])

    monkeypatch.setattr(sp, "place_transmitter", place_transmitter)
    options = ["--threshold", -90, "--height", 2, "--rx-height", 1, "--seed", 3, "--frequency", 27e9, "--max-depth", 2]
    options += ["--predictor", "paper", "--material", "concrete"]
    assert run(map_path, "--out", tmp_path / "place", *options).exit_code == 0
    (found,) = calls
    assert {name: found[name] for name in ("threshold_db", "height_m", "rx_height_m", "seed", "predictor")} == {
        "threshold_db": -90.0,
        "height_m": 2.0,
        "rx_height_m": 1.0,
        "seed": 3,
        "predictor": "paper",
    }
    assert (found["trace_settings"].frequency_hz, found["trace_settings"].max_depth) == (27e9, 2)
    assert found["scene_settings"].material.itu == "concrete"
    assert found["objective"] == "coverage"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--threshold", 3], "error: threshold_db = 3.0 is not allowed: give a number in (-150, 0]."),
        (["--height", 9], "error: height_m = 9.0 is not allowed: give a number in (0, 3]."),
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
