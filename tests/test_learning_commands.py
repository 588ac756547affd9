"""The commands dataset, train and evaluate: what they pass on, what they write and print, and how they fail."""

import json
from pathlib import Path
from typing import Any

import pytest
from link_tables import fitted_baselines, make_dataset, make_table
from predictor_links import QUIET, quick_predictor
from typer.testing import CliRunner, Result

import sionna_partial as sp
from sionna_partial import cli
from sionna_partial.datasets.dataset import DatasetReport
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.settings import DatasetSettings, Material, PredictorSettings, SensorSettings

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

        monkeypatch.setattr(sp, "build_dataset", build)
        return calls

    def test_defaults(self, calls: list[Any]) -> None:
        result = run("dataset", "out")
        assert result.exit_code == 0
        (call,) = calls
        options = {"scheduler": None, "workers": None, "home_time_limit_s": 900.0}
        assert call == (Path("out"), [*range(20_000, 20_100)], DatasetSettings(), options)
        assert "homes in out: 2 built in 1.5 min, 1 already there" in result.stdout

    def test_options(self, calls: list[Any]) -> None:
        settings = "--links 20 --transmitters 2 --stage 50 --stage 0 --seed 3 --field-of-view 360 --range 8"
        settings += " --range-noise 0.02 --drift 0.01 --missed-walls 0.1 --material concrete"
        where = ("--scheduler", "tcp://host:8786", "--workers", 3, "--time-limit", 60)
        result = run("dataset", "out", "--homes", 2, "--first-seed", 7, *settings.split(), *where)
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

    def test_bad_setting(self, calls: list[Any]) -> None:
        result = run("dataset", "out", "--links", 2)
        assert result.exit_code == 2
        assert result.stderr.startswith("error: links_per_home = 2 is not allowed: give at least 4, one for each of")
        assert calls == []


class TestTrain:
    @pytest.mark.filterwarnings("ignore::sionna_partial.errors.PredictorWarning")
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

        monkeypatch.setattr(sp, "train", train)
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

        monkeypatch.setattr(sp, "evaluate", evaluate)
        run("evaluate", dataset, "--out", tmp_path / "report")
        assert seen == ["map", [dataset]]

    def test_unknown_predictor(self, dataset: Path, tmp_path: Path) -> None:
        result = run("evaluate", dataset, "--predictor", "nobody", "--out", tmp_path / "report")
        assert result.exit_code == 2
        assert result.stderr.strip().endswith(
            "error: path = 'nobody' is no predictor: give 'map' or 'paper', or the path of a .keras file."
        )

    def test_trained_on_all_homes(self, dataset: Path, tmp_path: Path) -> None:
        trained = run("train", dataset, "--out", tmp_path / "run", "--test-fraction", 0, "--networks", "paper")
        assert "all homes were trained on: nothing was measured" in trained.stdout
        result = run("evaluate", dataset, "--predictor", tmp_path / "run/predictor.keras", "--out", tmp_path / "report")
        assert result.exit_code == 2
        assert "was trained on all 3 homes of the data set: give a data set of other homes" in result.stderr
        assert not (tmp_path / "report").exists()
