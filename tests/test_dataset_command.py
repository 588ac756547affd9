"""The subcommands of learning: what they pass on, and what they say."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from sionna_partial import cli
from sionna_partial.cli.shell import rate_and_rest, show_rate
from sionna_partial.datasets.dataset import DatasetReport
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.settings import DatasetSettings, Material, SensorSettings

pytestmark = pytest.mark.usefixtures("command_line")


def run(*args: object) -> Result:
    return CliRunner().invoke(cli.app, [str(arg) for arg in args])


class TestDataset:
    @pytest.fixture
    def calls(self, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
        """What `dataset` passes on, instead of a data set; homes from files fail."""
        calls: list[Any] = []

        def build(folder: Path, homes: list[int | Path], settings: DatasetSettings, **options: Any) -> DatasetReport:
            options.pop("progress")(1, len(homes), "half way")
            calls.append((folder, homes, settings, options))
            failed = {str(home): "the roof fell in\nTraceback" for home in homes if isinstance(home, Path)}
            return DatasetReport(folder, ("a", "b"), ("c",), failed, 90.0)

        monkeypatch.setattr("sionna_partial.datasets.dataset.build_dataset", build)
        return calls

    def test_defaults(self, calls: list[Any]) -> None:
        result = run("dataset", "out")
        assert result.exit_code == 0
        (call,) = calls
        options = {"scheduler": None, "workers": None, "home_time_limit_s": 900.0}
        assert call == (Path("out"), [*range(20_000, 20_100)], DatasetSettings(), options)
        assert "homes in out: 2 built in 1.5 min, 1 already there" in result.stdout

    def test_options(self, calls: list[Any]) -> None:
        settings = (
            "--links",
            20,
            "--transmitters",
            2,
            "--stage",
            50,
            "--stage",
            0,
            "--seed",
            3,
            "--field-of-view",
            360,
            "--range",
            8,
            "--range-noise",
            0.02,
            "--drift",
            0.01,
            "--missed-walls",
            0.1,
            "--material",
            "concrete",
        )
        where = ("--scheduler", "tcp://host:8786", "--workers", 3, "--time-limit", 60)
        result = run("dataset", "out", "--homes", 2, "--first-seed", 7, *settings, *where)
        assert result.exit_code == 0
        _, homes, passed, options = calls[0]
        assert homes == [7, 8]
        assert (passed.links_per_home, passed.transmitters_per_home, passed.stages, passed.seed) == (20, 2, (0, 50), 3)
        assert passed.sensor == SensorSettings(0.02, 0.01, 0.1, 360.0, 8.0)
        assert passed.scene.material == Material(itu="concrete")
        assert options == {"scheduler": "tcp://host:8786", "workers": 3, "home_time_limit_s": 60.0}

    def test_kinds_in_turn_fractions_and_mixed_sensors(self, calls: list[Any]) -> None:
        options = ("--kind", "floor", "--kind", "hall", "--mixed-sensors", "--short-links", 0.5)
        result = run("dataset", "out", "--homes", 3, "--first-seed", 7, "--stage", 0.25, "--stage", 0, *options)
        assert result.exit_code == 0
        _, homes, passed, _ = calls[0]
        assert homes == [(7, "floor"), (8, "hall"), (9, "floor")]
        assert (passed.stages, passed.sensor, passed.short_link_fraction) == ((0, 0.25), "mixed", 0.5)

    def test_maps_alone_and_failed_homes(self, calls: list[Any]) -> None:
        result = run("dataset", "out", "--map", "one.yaml", "--map", "two")
        assert calls[0][1] == [Path("one.yaml"), Path("two")]
        assert result.exit_code == 1
        assert "one.yaml failed: the roof fell in\ntwo failed: the roof fell in\n" in result.stderr
        assert "homes that failed: 2; the others can be used" in result.stderr
        assert "the same command tries them again" in result.stderr

    def test_default_homes_are_new_to_the_shipped_predictor(self, calls: list[Any]) -> None:
        run("dataset", "out")
        known = json.loads((PREDICTORS_FOLDER / "paper.json").read_text(encoding="utf-8"))["homes"]
        assert known
        assert not {f"make_home({seed})" for seed in calls[0][1]} & set(known)

    def test_maps_and_seeds(self, calls: list[Any]) -> None:
        run("dataset", "out", "--map", "one.yaml", "--homes", 1)
        assert calls[0][1] == [20_000, Path("one.yaml")]

    def test_bad_setting(self, calls: list[Any]) -> None:
        result = run("dataset", "out", "--links", 2)
        assert result.exit_code == 2
        assert result.stderr.startswith("error: links_per_home = 2 is not allowed: give at least 4, one for each of")
        assert calls == []


class TestRate:
    @pytest.mark.parametrize(
        ("done", "rest", "elapsed_s", "text"),
        [
            (0, 10, 5.0, ""),
            (10, 20, 30.0, "(20/min, 0:01:00 left)"),
            (3, 5000, 6.0, "(30/min, 2:46:40 left)"),
            (4, 0, 6.0, "(40/min, 0:00:00 left)"),
        ],
    )
    def test_rate_and_rest(self, done: int, rest: int, elapsed_s: float, text: str) -> None:
        assert rate_and_rest(done, rest, elapsed_s) == text

    def test_what_was_there_does_not_count(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        now = 100.0
        monkeypatch.setattr("sionna_partial.cli.shell.monotonic", lambda: now)
        with show_rate("homes") as report:
            report(50, 60, "starting")
            now = 110.0
            report(52, 60, "too soon for another line")
            now = 130.0
            report(55, 60, "too soon too")
            now = 190.0
            report(60, 60, "the end")
        lines = ["50 of 60 homes starting", "60 of 60 homes (6.67/min, 0:00:00 left) the end"]
        assert capsys.readouterr().err.splitlines() == lines
