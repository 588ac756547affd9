"""The examples of the gallery run as they stand, and what they print is true."""

import re
import runpy
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_example(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    mpl.use("Agg")
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(path), run_name="__main__")
    said = capsys.readouterr().out
    assert [name for name, value in names.items() if isinstance(value, Figure)]
    assert not list(tmp_path.iterdir())
    CHECKS[path.stem](said, names)


def predict_coverage(said: str, names: dict[str, Any]) -> None:
    observed, others = (int(found) for found in re.findall(r"(\d+)% of the (?:observed|others)", said))
    assert observed > 90 > others > 50


def explore_home(said: str, names: dict[str, Any]) -> None:
    deviations = names["std_db"]
    assert deviations[-1] < deviations[0] / 2
    assert abs(names["mean_db"][-1] - names["truth_db"]) < 2 * deviations[-1]


def trace_paths(said: str, names: dict[str, Any]) -> None:
    assert "link 0: LOS" in said
    assert "link 1: NLOS" in said


def ofdm_bit_error_rate(said: str, names: dict[str, Any]) -> None:
    assert float(re.findall(r"theory: ([\d.]+)", said)[0]) < 0.005
    needed_dbm = {state: int(power) for state, power in re.findall(r"(LOS|NLOS): bit .* (-?\d+) dBm", said)}
    assert needed_dbm["LOS"] + 10 < needed_dbm["NLOS"]


def several_transmitters(said: str, names: dict[str, Any]) -> None:
    together, alone = (float(found) for found in re.findall(r"([\d.]+)%(?:;|$)", said, re.MULTILINE)[-2:])
    assert 0.0 < alone < together < 100.0  # one unseen wall may block all three


def place_transmitter(said: str, names: dict[str, Any]) -> None:
    predicted, truth, middle = (float(found) for found in re.findall(r"([\d.]+)%", said))
    assert 0.0 < predicted < 100.0
    assert truth > middle


def calibrate_materials(said: str, names: dict[str, Any]) -> None:
    reflections = re.findall(r"loses ([\d.]+) \+- ([\d.]+) dB; in truth ([\d.]+) dB", said)
    for found, std, truth in (map(float, numbers) for numbers in reflections):
        assert abs(found - truth) <= max(0.6, 2.5 * std)
    assert len(reflections) == 4
    assert "cannot be determined: " in said


CHECKS = {
    check.__name__: check
    for check in (
        *(predict_coverage, explore_home, trace_paths, ofdm_bit_error_rate),
        *(several_transmitters, place_transmitter, calibrate_materials),
    )
}
"""What the output of each example has to say, by its name."""
