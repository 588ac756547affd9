"""The commands dataset, train and evaluate: what they pass on, what they write and print, and how they fail."""

import json
import re
from pathlib import Path

import pytest
from commands import arguments_of, run
from link_tables import fitted_baselines, make_dataset, make_table
from predictor_links import QUIET, quick_predictor

from sionna_partial.cli.learning import DEFAULT_HOMES, FIRST_SEED
from sionna_partial.constants import CellState
from sionna_partial.lab.datasets.home_links import home_sources
from sionna_partial.maps.map_files import save_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.settings import PredictorSettings

pytestmark = [QUIET, pytest.mark.usefixtures("command_line")]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Homes with too few links for the networks of the paper to be trained."""
    return make_dataset(tmp_path_factory.mktemp("dataset"), make_table(homes=3, links=40))


@pytest.fixture(scope="module")
def predictor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "predictor.keras"
    quick_predictor().save(path)
    fitted_baselines().save(path.parent)
    return path


class TestDataset:
    def test_made_homes_are_new_to_the_shipped_predictors(self) -> None:
        names = {source.name for source in home_sources(range(FIRST_SEED, FIRST_SEED + DEFAULT_HOMES))}
        known = json.loads((PREDICTORS_FOLDER / "paper.json").read_text(encoding="utf-8"))["homes"]
        assert known
        assert not names & {*known}

    def test_failed_homes_are_named(self, tmp_path: Path) -> None:
        save_map(PartialMap([[CellState.FREE, CellState.UNKNOWN]], 1.0), tmp_path / "one.npz")
        result = run("dataset", tmp_path / "out", "--map", tmp_path / "one.npz", exit_code=1)
        line = rf"homes in {re.escape(str(tmp_path / 'out'))}: 0 built in [\d.]+ min, 0 already there\n"
        assert re.fullmatch(line, result.stdout)
        assert "one failed: home 'one' is not complete, a free cell touches an unknown one" in result.stderr
        assert "homes that failed: 1; the others can be used" in result.stderr
        assert "the same command tries them again" in result.stderr


def test_defaults_of_train(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = arguments_of(monkeypatch, "lab.train", "train", dataset, "--out", tmp_path / "run")
    assert (found["test_fraction"], found["settings"]) == (0.3, PredictorSettings("map"))


@pytest.mark.filterwarnings("ignore::sionna_partial.errors.PredictorWarning")
def test_what_train_writes_and_says(tmp_path: Path) -> None:
    table, out = make_table(homes=3, links=20), tmp_path / "run"
    dataset = make_dataset(tmp_path / "links", table, frequency_hz=60e9, diffraction=False)
    words = "--test-fraction 0.5 --networks paper --passes 2 --seed 3"
    result = run("train", dataset, "--out", out, *words.split())
    names = ["distance.json", "distance.keras", "majority.json", "predictor.json", "predictor.keras", "split.json"]
    assert sorted(path.name for path in out.iterdir()) == names
    *lines, hint = result.stdout.splitlines()
    assert lines[-6:] == [f"wrote {out / name}" for name in names]
    assert hint.endswith(f"sionna-partial evaluate {dataset} --predictor {out / 'predictor.keras'} --out REPORT")
    settings = PredictorSettings("paper", 60e9, diffraction=False, passes=2, seed=3)
    assert Predictor.load(out / "predictor.keras").settings == settings
    split = json.loads((out / "split.json").read_text())
    assert (split["test_fraction"], len(split["train"]), len(split["test"])) == (0.5, 1, 2)
    assert "### Test homes (2), receivers indoors" in result.stdout


class TestEvaluate:
    def test_what_it_writes_and_says(self, dataset: Path, predictor: Path, tmp_path: Path) -> None:
        out = tmp_path / "report"
        result = run("evaluate", dataset, "--out", out, "--predictor", predictor)
        names = ["report.md", "report.json", "stages.png", "calibration.png"]
        assert result.stdout.splitlines()[-4:] == [f"wrote {out / name}" for name in names]
        assert "| with indoor model    |" in result.stdout
        assert json.loads((out / "report.json").read_text())["predictor"] == str(predictor)
        assert f"# Evaluation of predictor `{predictor}`" in (out / "report.md").read_text()

    def test_trained_on_all_homes(self, dataset: Path, tmp_path: Path) -> None:
        trained = run("train", dataset, "--out", tmp_path / "run", "--test-fraction", 0, "--networks", "paper")
        assert "all homes were trained on: nothing was measured" in trained.stdout
        words = ("--predictor", tmp_path / "run/predictor.keras", "--out", tmp_path / "report")
        result = run("evaluate", dataset, *words, exit_code=2)
        assert "was trained on all 3 homes of the data set: give a data set of other homes" in result.stderr
        assert not (tmp_path / "report").exists()
