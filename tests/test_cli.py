"""The command line: what it passes on, what it says, and how it fails."""

import logging
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from PIL import Image
from typer.testing import CliRunner, Result

import sionna_partial as sp
from sionna_partial import __version__, cli, info
from sionna_partial.cli.options import parse_material
from sionna_partial.errors import BackendError, MapError, OutputError
from sionna_partial.info import Finding
from sionna_partial.maps.map_files import load_map, save_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import Material, SceneSettings, SensorSettings, TraceSettings
from sionna_partial.simulation.explore import explore

pytestmark = pytest.mark.usefixtures("command_line")


@pytest.fixture
def room() -> PartialMap:
    state = np.full((8, 10), 2, dtype=np.uint8)
    state[1:7, 1:9] = 1
    state[2:6, 2:8] = 0
    return PartialMap(state, 0.5, (-2.0, -1.0))


@pytest.fixture
def map_path(room: PartialMap, tmp_path: Path) -> Path:
    path = tmp_path / "map.yaml"
    save_map(room, path)
    return path


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What `predict` passes on, instead of a prediction."""
    calls: list[Any] = []

    def predict_map(scene: Any, tx: Any, *, progress: Any, **settings: Any) -> str:
        progress(0.5, "half way")
        calls.append((scene, tx, settings))
        return "coverage"

    def save_coverage(coverage: str, path: Path) -> None:
        calls.append((coverage, path))

    monkeypatch.setattr(sp, "predict_map", predict_map)
    monkeypatch.setattr(sp, "save_coverage", save_coverage)
    return calls


def run(*args: object) -> Result:
    return CliRunner().invoke(cli.app, [str(arg) for arg in args])


def say(text: str) -> str:
    """Output without line breaks that depend on the width."""
    return " ".join(text.split())


class TestPredict:
    def test_defaults(self, map_path: Path, room: PartialMap, calls: list[Any], tmp_path: Path) -> None:
        result = run("predict", map_path, "--tx", 0.5, 0.5, "--out", tmp_path / "out")
        assert result.exit_code == 0, result.output
        scene, tx, settings = calls[0]
        assert scene == room
        assert tx == (0.5, 0.5)
        assert settings == {
            "rx_height_m": 1.5,
            "spacing_m": 0.15,
            "predictor": None,
            "scene_settings": SceneSettings(),
            "trace_settings": TraceSettings(),
            "receivers": "indoor",
            "measurements": None,
            "memory_gb": 2.0,
        }
        names = [f"coverage{suffix}" for suffix in (".nc", ".tif", ".csv", ".png", ".html", ".yaml")]
        assert [(coverage, path.name) for coverage, path in calls[1:]] == [("coverage", name) for name in names]
        assert result.stdout.splitlines() == [f"wrote {tmp_path / 'out' / name}" for name in names]

    def test_every_option(self, map_path: Path, calls: list[Any], tmp_path: Path) -> None:
        options = "--rx-height 1 --spacing 0.3 --frequency 60e9 --max-depth 2 --predictor paper --material 4,0.1,0.2"
        options += " --receivers anywhere --no-diffraction --wall-height 2.7 --memory 1.5 --format nc --format .CSV"
        result = run("predict", map_path, "--tx", 1, -0.5, 2, "--out", tmp_path, *options.split())
        assert result.exit_code == 0, result.output
        scene, tx, settings = calls[0]
        assert scene.wall_height_m == 2.7
        assert tx == (1.0, -0.5, 2.0)
        assert settings == {
            "rx_height_m": 1.0,
            "spacing_m": 0.3,
            "predictor": "paper",
            "scene_settings": SceneSettings(material=Material(4.0, 0.1, 0.2)),
            "trace_settings": TraceSettings(frequency_hz=60e9, max_depth=2, diffraction=False),
            "receivers": "anywhere",
            "measurements": None,
            "memory_gb": 1.5,
        }
        assert [path.name for _, path in calls[1:]] == ["coverage.nc", "coverage.csv"]

    @pytest.mark.parametrize(
        ("words", "tx"),
        [
            (["--tx", "3.2", "4.1"], (3.2, 4.1)),
            (["--tx", "-3.2", "-4.1", "1.5"], (-3.2, -4.1, 1.5)),
            (["--tx", "-.5", "+1e-1"], (-0.5, 0.1)),
            (["--tx", "1,2,3"], (1.0, 2.0, 3.0)),
            (["--tx", "1 2"], (1.0, 2.0)),
            (["--tx=-1,2"], (-1.0, 2.0)),
        ],
    )
    @pytest.mark.parametrize("first", [True, False])
    def test_position(
        self, map_path: Path, calls: list[Any], tmp_path: Path, words: list[str], tx: tuple[float, ...], first: bool
    ) -> None:
        before, after = ([], [map_path]) if first else ([map_path], [])
        result = run("predict", *before, *words, *after, "--out", tmp_path)
        assert result.exit_code == 0, result.output
        assert calls[0][1] == tx

    @pytest.mark.parametrize("words", [["1"], ["1", "2", "3", "4"], ["a", "b"], ["1,b"], []])
    def test_wrong_position(self, map_path: Path, calls: list[Any], tmp_path: Path, words: list[str]) -> None:
        result = run("predict", map_path, "--out", tmp_path, "--tx", *words)
        assert result.exit_code == 2
        assert "is not a position: give --tx X Y or --tx X Y Z in metres." in say(result.stderr)
        assert not calls

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--material", "cheese"], "error: itu = 'cheese' is not allowed: choose one of vacuum"),
            (["--material", "2,3"], "--material '2,3' is neither an ITU name nor permittivity,conductivity,thickness"),
            (["--material", "0,0,1"], "error: relative_permittivity = 0.0 is not allowed"),
            (["--format", "jpg"], "--format 'jpg' is not known: choose from .nc, .tif, .csv, .png, .html, .yaml."),
            (["--frequency", "1"], "error: frequency_hz = 1.0 is not allowed"),
            (["--max-depth", "11"], "error: max_depth = 11 is not allowed"),
        ],
    )
    def test_wrong_option(
        self, map_path: Path, calls: list[Any], tmp_path: Path, words: list[str], message: str
    ) -> None:
        result = run("predict", map_path, "--tx", 1, 1, "--out", tmp_path, *words)
        assert result.exit_code == 2
        assert message in say(result.stderr)
        assert not calls

    def test_missing_map(self, tmp_path: Path) -> None:
        result = run("predict", tmp_path / "none.yaml", "--tx", 1, 1, "--out", tmp_path / "out")
        assert result.exit_code == 2
        assert result.stderr.startswith("error: path = ")
        assert len(result.stderr.splitlines()) == 1

    @pytest.mark.parametrize("error", [BackendError("no LLVM"), OutputError("disk full"), MapError("bad map")])
    def test_error_is_one_line(
        self, map_path: Path, calls: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception
    ) -> None:
        def fail(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr(sp, "save_coverage", fail)
        result = run("predict", map_path, "--tx", 1, 1, "--out", tmp_path)
        assert result.exit_code == 2
        assert result.stderr == f"error: {error}\n"

    def test_files_are_written_together_or_not_at_all(
        self, map_path: Path, calls: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        def write_some(_: object, path: Path) -> None:
            path.write_text("new")
            if path.suffix == ".csv":
                raise OSError(28, "No space left on device")

        monkeypatch.setattr(sp, "save_coverage", write_some)
        out = tmp_path / "out"
        result = run("predict", map_path, "--tx", 1, 1, "--out", out)
        assert result.exit_code == 2
        assert result.stderr.startswith(f"error: path = '{out}' could not be written (No space left on device)")
        assert not out.exists()
        result = run("predict", map_path, "--tx", 1, 1, "--out", out, "--format", "nc", "--format", "nc")
        assert result.exit_code == 0
        assert [path.name for path in out.iterdir()] == ["coverage.nc"]
        assert result.stdout == f"wrote {out / 'coverage.nc'}\n"

    def test_unwritable_folder_is_named_before_the_work(self, map_path: Path, calls: list[Any], tmp_path: Path) -> None:
        result = run("predict", map_path, "--tx", 1, 1, "--out", map_path / "out")
        assert result.exit_code == 2
        assert result.stderr.startswith(f"error: path = '{map_path / 'out'}' could not be written")
        assert len(result.stderr.splitlines()) == 1
        assert not calls

    def test_strict(self, calls: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        read: list[Any] = []
        monkeypatch.setattr(sp, "load_map", lambda path, **options: read.append((path, options)))
        run("predict", tmp_path, "--tx", 1, 1, "--out", tmp_path)
        run("predict", tmp_path, "--tx", 1, 1, "--out", tmp_path, "--strict", "--up", "y", "--height-band", 0.5, 2)
        assert read == [
            (tmp_path, {"strict": False, "wall_height_m": None, "height_band_m": None, "up": None}),
            (tmp_path, {"strict": True, "wall_height_m": None, "height_band_m": (0.5, 2.0), "up": "y"}),
        ]

    def test_warnings_are_one_line_each(
        self, calls: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, room: PartialMap
    ) -> None:
        def read(path: Path, **_: object) -> PartialMap:
            logging.getLogger("sionna_partial.maps.map_turn").warning("origin yaw %g rad", 0.5)
            with warnings.catch_warnings():
                warnings.simplefilter("always")
                warnings.warn("many cells of shade 205", UserWarning, stacklevel=1)
            return room

        monkeypatch.setattr(sp, "load_map", read)
        result = run("predict", tmp_path, "--tx", 1, 1, "--out", tmp_path)
        assert result.stderr.splitlines()[:2] == ["warning: origin yaw 0.5 rad", "warning: many cells of shade 205"]

    def test_quiet_tensorflow(self, map_path: Path, calls: list[Any], monkeypatch: Any, tmp_path: Path) -> None:
        run("predict", map_path, "--tx", 1, 1, "--out", tmp_path)
        assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "put back in the end"
        monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
        run("predict", map_path, "--tx", 1, 1, "--out", tmp_path)
        assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"


class TestExportScene:
    def test_folder_reads_back(self, map_path: Path, room: PartialMap, tmp_path: Path) -> None:
        result = run("export-scene", map_path, "--out", tmp_path / "scene", "--material", "concrete")
        assert result.exit_code == 0, result.output
        assert (tmp_path / "scene" / "scene.xml").is_file()
        assert load_map(tmp_path / "scene") == room
        assert "concrete" in (tmp_path / "scene" / "scene.xml").read_text()
        assert result.stdout.startswith(f"wrote {tmp_path / 'scene'}")

    def test_frequency_outside_the_material(self, map_path: Path, tmp_path: Path) -> None:
        result = run("export-scene", map_path, "--out", tmp_path / "scene", "--material", "floorboard")
        assert result.exit_code == 2
        assert "error: frequency_hz" in result.stderr
        assert not (tmp_path / "scene").exists()


class TestExplore:
    def test_made_home(self, tmp_path: Path) -> None:
        result = run("explore", "--out", tmp_path / "maps", "--seed", "7", "--steps", "6", "--steps", "2")
        assert result.exit_code == 0, result.output
        names = ["steps_002.yaml", "steps_006.yaml", "complete.yaml", "exploration.png", "exploration.gif"]
        assert result.stdout.splitlines() == [f"wrote {tmp_path / 'maps' / name}" for name in names]
        home = sp.make_home(7)
        for name, partial in zip(names, [*explore(home, (2, 6), 7), home], strict=False):
            assert np.array_equal(load_map(tmp_path / "maps" / name).state, partial.state)
        with Image.open(tmp_path / "maps" / "exploration.gif") as animation:
            assert animation.n_frames == 7

    def test_own_home_and_errors(self, map_path: Path, tmp_path: Path, room: PartialMap) -> None:
        errors = ["--range-noise", "0.6", "--drift", "0.2", "--missed-walls", "0.5"]
        result = run("explore", "--home", map_path, "--out", tmp_path / "maps", "--steps", "4", *errors)
        assert result.exit_code == 0, result.output
        assert load_map(tmp_path / "maps" / "complete.yaml") == room
        (partial,) = explore(room, (4,), sensor=SensorSettings(0.6, 0.2, 0.5))
        assert np.array_equal(load_map(tmp_path / "maps" / "steps_004.yaml").state, partial.state)

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--missed-walls", "2"], "missed_wall_fraction = 2.0 is not allowed: give a number in [0, 1]."),
            (["--steps", "-4"], "steps = [-4] is not allowed: give increasing whole numbers of 0 to 100,000"),
        ],
    )
    def test_wrong_numbers_leave_nothing_behind(
        self, map_path: Path, tmp_path: Path, words: list[str], message: str
    ) -> None:
        result = run("explore", "--home", map_path, "--out", tmp_path / "maps", *words)
        assert result.exit_code == 2
        assert f"error: {message}" in result.stderr
        assert not (tmp_path / "maps").exists()


def test_demo_prints_table_and_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def run_demo(out: Path, progress: Any) -> tuple[list[str], str]:
        progress(0.5, "half way")
        return ["coverage.nc"], "accuracy 0.9"

    monkeypatch.setattr("sionna_partial.demo.run_demo", run_demo)
    result = run("demo", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines() == ["accuracy 0.9", f"wrote {tmp_path / 'coverage.nc'}"]


class TestInfo:
    @pytest.mark.parametrize(("remedy", "code"), [("", 0), ("run pip install it", 1)])
    def test_exit_code_says_whether_all_is_usable(
        self, monkeypatch: pytest.MonkeyPatch, remedy: str, code: int
    ) -> None:
        monkeypatch.setattr(info, "findings", lambda: [Finding("python", "3.11"), Finding("it", "9.9", remedy)])
        result = run("info")
        assert result.exit_code == code
        assert all(word in result.stdout for word in ("python", "3.11", "9.9", remedy))

    def test_works_without_llvm_and_tensorflow(self) -> None:
        block = "import sys; sys.modules.update(tensorflow=None, keras=None, drjit=None, mitsuba=None)"
        code = f"{block}\nfrom sionna_partial.cli.app import app\napp(['info'])"
        environment = os.environ | {"DRJIT_LIBLLVM_PATH": "/no/such/libLLVM.so", "COLUMNS": "200"}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        result = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60
        )
        assert result.returncode == 1, result.stderr
        assert "unset DRJIT_LIBLLVM_PATH and run pip install" in result.stdout
        assert "sionna-rt" in result.stdout


class TestHelp:
    def test_version(self) -> None:
        assert run("--version").stdout == f"{__version__}\n"

    def test_package_is_a_command(self) -> None:
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = [sys.executable, "-m", "sionna_partial", "--version"]
        assert subprocess.check_output(command, env=environment, text=True, timeout=60) == f"{__version__}\n"

    def test_position_is_shown_as_it_is_typed(self) -> None:
        assert "--tx X Y [Z]" in run("predict", "--help").stdout


def test_parse_material() -> None:
    assert parse_material("") == Material()
    assert parse_material("wood") == Material(itu="wood")
    assert parse_material("2.5,0.1,0.05") == Material(2.5, 0.1, 0.05)
    with pytest.raises(typer.BadParameter, match="'a,b,c' is neither an ITU name"):
        parse_material("a,b,c")
