"""The worked examples run as they stand, and say what they promise."""

import re
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run_example(name: str, *arguments: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run an example as a script."""
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


def test_place_transmitter(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "placement.png"
    run_example("place_transmitter.py", "--out", picture, monkeypatch=monkeypatch)
    predicted, truth, middle = map(float, re.findall(r"([\d.]+)%", capsys.readouterr().out))
    assert 0.0 < predicted < 100.0
    assert truth > middle
    assert picture.stat().st_size > 10_000


def test_calibrate_materials(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "calibration.png"
    run_example("calibrate_materials.py", "--out", picture, monkeypatch=monkeypatch)
    said = capsys.readouterr().out
    reflections = re.findall(r"loses ([\d.]+) \+- ([\d.]+) dB; in truth ([\d.]+) dB", said)
    for found, std, truth in (map(float, numbers) for numbers in reflections):
        assert abs(found - truth) <= max(0.6, 2.5 * std)
    assert len(reflections) == 4
    assert "cannot be determined: " in said
    assert picture.stat().st_size > 10_000
