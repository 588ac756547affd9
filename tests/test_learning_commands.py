"""The commands train and evaluate on a small data set: what they write, what they say, and how they fail."""

import json
from pathlib import Path
from typing import Any

import pytest
from link_tables import fitted_baselines, make_dataset, make_table
from predictor_links import QUIET, quick_predictor
from typer.testing import CliRunner, Result

from sionna_partial import cli
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import PredictorSettings

pytestmark = [QUIET, pytest.mark.usefixtures("command_line")]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Homes with too few links for the networks of the paper to be trained."""
    return make_dataset(tmp_path_factory.mktemp("dataset"), make_table(homes=3, links=40))


@pytest.fixture(scope="module")
def predictor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A predictor with its baselines beside it, trained on none of the homes."""
    path = tmp_path_factory.mktemp("run") / "predictor.keras"
    quick_predictor().save(path)
    fitted_baselines().save(path.parent)
    return path


def run(*args: object) -> Result:
    return CliRunner().invoke(cli.app, [str(arg) for arg in args])


class TestTrain:
    @pytest.mark.parametrize("networks", ["paper", "map"])
    def test_what_it_writes_and_says(self, networks: str, dataset: Path, tmp_path: Path) -> None:
        out = tmp_path / "run"
        options = ["--test-fraction", 0.5, "--networks", networks, "--passes", 2, "--seed", 3]
        result = run("train", dataset, "--out", out, *options)
        assert result.exit_code == 0, result.output
        names = ["distance.json", "distance.keras", "majority.json", "predictor.json", "predictor.keras", "split.json"]
        assert sorted(path.name for path in out.iterdir()) == names
        *lines, hint = result.stdout.splitlines()
        assert lines[-6:] == [f"wrote {out / name}" for name in names]
        assert hint.endswith(f"sionna-partial evaluate {dataset} --predictor {out / 'predictor.keras'} --out REPORT")
        assert "### Test homes (2), receivers indoors" in result.stdout
        found = Predictor.load(out / "predictor.keras").settings
        assert (found.networks, found.passes, found.seed, found.frequency_hz) == (networks, 2, 3, 28e9)
        split = json.loads((out / "split.json").read_text())
        assert (split["test_fraction"], len(split["train"]), len(split["test"])) == (0.5, 1, 2)

    def test_defaults_and_the_frequency_of_the_data_set(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        folder = make_dataset(tmp_path, make_table(homes=1, links=5), frequency_hz=60e9, diffraction=False)
        seen: dict[str, Any] = {}

        def train(links: Any, **options: Any) -> Any:
            seen.update(options)
            raise KeyboardInterrupt

        monkeypatch.setattr("sionna_partial.training.train", train)
        run("train", folder, "--out", tmp_path / "run")
        assert seen["settings"] == PredictorSettings("map", frequency_hz=60e9, diffraction=False)
        assert seen["test_fraction"] == 0.3

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--test-fraction", 1], "error: test_fraction = 1.0 is not allowed: give a number in [0, 0.99]."),
            (["--passes", 0], "error: passes = 0 is not allowed: give a whole number in [1, 1000000]."),
            (["--seed", -1], "error: seed = -1 is not allowed: give a whole number in [0, 1000000000]."),
        ],
    )
    def test_bad_options(self, words: list[object], message: str, dataset: Path, tmp_path: Path) -> None:
        result = run("train", dataset, "--out", tmp_path / "run", *words)
        assert result.exit_code == 2
        assert result.stderr.strip() == message
        assert not (tmp_path / "run").exists()

    def test_no_data_set(self, tmp_path: Path) -> None:
        result = run("train", tmp_path / "none", "--out", tmp_path / "run")
        assert result.exit_code == 2
        assert f"error: folder = '{tmp_path / 'none'}' is no data set" in result.stderr

    def test_nothing_is_trained_that_cannot_be_written(self, dataset: Path, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        result = run("train", dataset, "--out", tmp_path / "file" / "run")
        assert result.exit_code == 2
        assert "could not be written" in result.stderr


class TestEvaluate:
    def test_what_it_writes_and_says(self, dataset: Path, predictor: Path, tmp_path: Path) -> None:
        out = tmp_path / "report"
        result = run("evaluate", dataset, "--predictor", predictor, "--out", out)
        assert result.exit_code == 0, result.output
        names = ["report.md", "report.json", "stages.png", "calibration.png"]
        assert result.stdout.splitlines()[-4:] == [f"wrote {out / name}" for name in names]
        assert "| with indoor model    |" in result.stdout
        assert json.loads((out / "report.json").read_text())["predictor"] == str(predictor)
        assert f"# Evaluation of predictor `{predictor}`" in (out / "report.md").read_text()

    def test_the_shipped_default(self, dataset: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        seen: list[Any] = []

        def evaluate(*arguments: Any, progress: Any) -> Any:
            seen.extend(arguments)
            raise KeyboardInterrupt

        monkeypatch.setattr("sionna_partial.evaluation.evaluate.evaluate", evaluate)
        run("evaluate", dataset, "--out", tmp_path / "report")
        assert seen == ["map", [dataset]]

    def test_unknown_predictor(self, dataset: Path, tmp_path: Path) -> None:
        result = run("evaluate", dataset, "--predictor", "nobody", "--out", tmp_path / "report")
        assert result.exit_code == 2
        assert result.stderr.strip().endswith("error: path = 'nobody' is no predictor: give the path of a .keras file.")

    def test_trained_on_all_homes(self, dataset: Path, tmp_path: Path) -> None:
        trained = run("train", dataset, "--out", tmp_path / "run", "--test-fraction", 0, "--networks", "paper")
        assert "all homes were trained on: nothing was measured" in trained.stdout
        result = run("evaluate", dataset, "--predictor", tmp_path / "run/predictor.keras", "--out", tmp_path / "report")
        assert result.exit_code == 2
        assert "was trained on all 3 homes of the data set: give a data set of other homes" in result.stderr
        assert not (tmp_path / "report").exists()
