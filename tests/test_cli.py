"""The command line: what it passes on, what it prints, and how it fails."""

import inspect
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import yaml
from commands import arguments_of, run
from coverage_cases import PICTURE, TX, map_of
from PIL import Image

import sionna_partial as sp
from sionna_partial import __version__, cli
from sionna_partial.cli.options import parse_frequency
from sionna_partial.exploration.explore import explore
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.maps.map_files import load_map, save_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import Material, SceneSettings, SensorSettings, TraceSettings

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


def say(text: str) -> str:
    """Output without line breaks that depend on the width."""
    return " ".join(text.split())


TRACE = "--frequency 60e9 --max-depth 2 --no-diffraction --through-walls --material 4,0.1,0.2 --predictor paper"
BEAM, RECEIVERS = "--tx-antenna dipole --azimuth 90 --tilt 10", "--rx-height 1 --spacing 0.5 --memory 1.5"
TRACED = {
    "trace_settings": TraceSettings(60e9, 2, diffraction=False, refraction=True),
    "scene_settings": SceneSettings(material=Material(4.0, 0.1, 0.2)),
    "predictor": "paper",
}
ARGUMENTS = [
    (
        f"predict --tx 1 2 2 --receivers anywhere {BEAM} {RECEIVERS} {TRACE}",
        "predict_map",
        {"tx": (1.0, 2.0, 2.0), "tx_antenna": sp.Antenna("dipole", 90.0, 10.0), "rx_height_m": 1.0, "spacing_m": 0.5}
        | {"receivers": "anywhere", "memory_gb": 1.5, **TRACED},
    ),
    (
        f"network --tx 1,2 --tx 2,2,3 --tx-antenna iso {BEAM} {RECEIVERS} {TRACE}",
        "predict_map",
        {"tx": [(1.0, 2.0, 1.5), (2.0, 2.0, 3.0)], "rx_height_m": 1.0, "spacing_m": 0.5, "memory_gb": 1.5, **TRACED}
        | {"tx_antenna": [sp.Antenna(pattern, 90.0, 10.0) for pattern in ("iso", "dipole")]},
    ),
    (
        "network --tx 1,2 --tx 2,2 --tx-power 10 --tx-power 20 --noise-figure 5 --bandwidth 2e7 --load 0.5 "
        "--sinr-threshold 3",
        "predict_map predict_network",
        {"tx_power_dbm": [10.0, 20.0], "noise_figure_db": 5.0, "bandwidth_hz": 2e7, "load": 0.5}
        | {"sinr_threshold_db": 3.0},
    ),
    (
        f"place --objective percentile --threshold -90 --height 2 --rx-height 1 --seed 3 {TRACE}",
        "place_transmitter",
        {"objective": "percentile", "threshold_db": -90.0, "tx_height_m": 2.0, "rx_height_m": 1.0, "seed": 3, **TRACED},
    ),
    (
        f"place --count 3 --threshold -90 --height 2 --rx-height 1 --seed 3 {TRACE}",
        "place_transmitters",
        {"count": 3, "threshold_db": -90.0, "tx_height_m": 2.0, "rx_height_m": 1.0, "seed": 3, **TRACED},
    ),
    (
        f"next --tx 1 2 --goal area --count 2 --start 3 4 --threshold -90 --field-of-view 360 --range 8 {TRACE}",
        "next_views",
        {"tx": (1.0, 2.0), "goal": "area", "count": 2, "start": (3.0, 4.0), "threshold_db": -90.0, **TRACED}
        | {"sensor": SensorSettings(field_of_view_deg=360.0, range_m=8.0)},
    ),
    (
        "channels --tx 1 2 --rx RX --memory 1.5 --frequency 60e9 --max-depth 2 --no-diffraction",
        "trace_links",
        {"tx": (1.0, 2.0, 1.5), "rx": [(2.0, 1.0, 1.5)], "memory_gb": 1.5}
        | {"trace_settings": TraceSettings(60e9, 2, diffraction=False, power_tolerance_db=0.0)},
    ),
    (
        "export-scene --material floorboard --frequency 60e9",
        "export_scene",
        {"scene_settings": SceneSettings(material=Material.named("floorboard")), "frequency_hz": 60e9},
    ),
    (
        "explore --home MAP --seed 3 --steps 6 --steps 2 --policy coverage --tx 1 2 --range-noise 0.6 --drift 0.2 "
        "--missed-walls 0.5 --field-of-view 90 --range 5 --heading-noise 3 --missed-returns 0.1 --fusion cartographer",
        "explore_trajectory",
        {"steps": [*range(7)], "seed": 3, "policy": "coverage", "tx": (1.0, 2.0)}
        | {
            "sensor": SensorSettings(
                *(0.6, 0.2, 0.5, 90.0, 5.0), heading_noise_deg=3.0, missed_return_fraction=0.1, fusion="cartographer"
            )
        },
    ),
    (
        "dataset --homes 2 --first-seed 7 --links 20 --transmitters 2 --stage 50 --stage 0 --seed 3 "
        "--field-of-view 360 --range 8 --range-noise 0.02 --drift 0.01 --missed-walls 0.1 --material concrete "
        "--frequency 60e9 --workers 3 --time-limit 60",
        "lab.build_dataset",
        {"homes": [7, 8], "workers": 3, "scheduler": None, "home_time_limit_s": 60.0}
        | {
            "settings": DatasetSettings(
                *(20, 2, (0, 50)),
                seed=3,
                sensor=SensorSettings(0.02, 0.01, 0.1, 360.0, 8.0),
                scene=SceneSettings(material=Material.named("concrete")),
                trace=TraceSettings(60e9),
            )
        },
    ),
    (
        "dataset --homes 3 --first-seed 7 --stage 0.25 --stage 0 --kind floor --kind hall --mixed-sensors "
        "--short-links 0.5 --cir-paths 9 --scheduler there",
        "lab.build_dataset",
        {"homes": [(7, "floor"), (8, "hall"), (9, "floor")], "scheduler": "there"}
        | {"settings": DatasetSettings(stages=(0, 0.25), sensor="mixed", short_link_fraction=0.5, cir_paths=9)},
    ),
    (
        "calibrate --measurements RX --material 4,0.1,0.2 --frequency 60e9 --max-depth 2 --no-diffraction",
        "measurements.recordings.load_survey calibrate_materials",
        {"start": Material(4.0, 0.1, 0.2), "scene_settings": SceneSettings(material=Material(4.0, 0.1, 0.2))}
        | {"trace_settings": TraceSettings(60e9, 2, diffraction=False)},
    ),
    (
        "export-scene --strict --up y --height-band 2.5 2.9 --wall-height 2.7 --unit 0.01 --storey EG --resolution 0.1 "
        "--obstacle-height 1.2 --wall-layer A --material-of A=brick",
        "load_map",
        {"strict": True, "up": "y", "height_band_m": (2.5, 2.9), "wall_height_m": 2.7, "unit_m": 0.01, "storey": "EG"}
        | {"resolution_m": 0.1, "obstacle_height_m": 1.2, "wall_layers": ["A"]}
        | {"layer_materials": {"A": Material.named("brick")}},
    ),
    ("dataset --map a.npz --map b", "lab.build_dataset", {"homes": [Path("a.npz"), Path("b")]}),
]
"""Command and options, functions that it calls, and arguments of the last."""


@pytest.mark.parametrize(("words", "functions", "expected"), ARGUMENTS, ids=lambda value: str(value)[:24])
def test_options_arrive(
    words: str, functions: str, expected: Any, map_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rx.csv").write_text("x,y,z\n2,1,1.5\n")
    name, *options = words.replace("MAP", str(map_path)).replace("RX", str(tmp_path / "rx.csv")).split()
    given = {"dataset": [tmp_path / "out"], "explore": ["--out", tmp_path / "out"]}
    given |= {"channels": [map_path, "--out", tmp_path / "a.nc"]}
    found = arguments_of(
        monkeypatch, functions, name, *given.get(name, [map_path, "--out", tmp_path / "out"]), *options
    )
    assert {name: found[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("words", "function", "aside"),
    [
        ("predict MAP --tx 1 2 --out OUT", "predict_map", {"tx": (1.0, 2.0), "tx_antenna": sp.Antenna()}),
        ("place MAP --out OUT", "place_transmitter", {}),
        ("place MAP --count 2 --out OUT", "place_transmitters", {}),
        ("next MAP --out OUT", "next_views", {}),
        ("export-scene MAP --out OUT", "export_scene", {}),
        ("dataset OUT", "lab.build_dataset", {"homes": [*range(20_000, 20_100)]}),
        ("evaluate LINKS --out OUT", "lab.evaluate", {"dataset": [Path("LINKS")], "predictor": "map"}),
    ],
)
def test_defaults_are_the_functions(
    words: str, function: str, aside: dict[str, Any], map_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    defaults = {
        name: parameter.default for name, parameter in inspect.signature(attrgetter(function)(sp)).parameters.items()
    }
    empty = {"trace_settings": TraceSettings(), "scene_settings": SceneSettings(), "sensor": SensorSettings()}
    empty |= {"settings": DatasetSettings()}
    found = arguments_of(
        monkeypatch, function, *words.replace("MAP", str(map_path)).replace("OUT", str(tmp_path)).split()
    )
    for name, value in found.items():
        if name not in ("scene", "partial", "folder", "progress"):
            expected = aside.get(name, defaults[name])
            assert value == (empty.get(name) if expected is None else expected), name


AT = ("--tx", "1", "1")


class TestPredict:
    def test_files_and_answer(self, tmp_path: Path) -> None:
        save_map(map_of(PICTURE), tmp_path / "map.yaml")
        out, options = tmp_path / "out", "--spacing 0.5 --power 15 --threshold -67 --frequency 5.2GHz"
        result = run("predict", tmp_path / "map.yaml", "--tx", *TX, "--out", out, *options.split())
        names = [f"coverage{suffix}" for suffix in (".nc", ".tif", ".csv", ".png", ".html", ".yaml")]
        walls, *lines, answer = result.stdout.splitlines()
        assert walls.startswith("walls: drywall ")
        assert lines == [f"wrote {out / name}" for name in names]
        assert {path.name for path in out.iterdir()} == {*names, "coverage.pgm"}
        coverage = sp.load_coverage(out / "coverage.nc")
        assert coverage.attrs["frequency_hz"] == 5.2e9
        observed, every = coverage.radio.area(-67.0, eirp_dbm=15.0).fraction.values
        text = f"{100 * observed:.0f} % of the observed floor, {100 * every:.0f} % of all, above -67 dBm"
        assert answer == f"{text} with probability 0.9, at 15 dBm; open {out / 'coverage.png'}"

    def test_frequencies(self) -> None:
        units = {"5.2GHz": 5.2e9, "2400 MHz": 2.4e9, "60e9hz": 60e9, "900000kHz": 9e8}
        for text, frequency_hz in {**units, "ch36": 5.18e9, "CH 6": 2.437e9, "ch14": 2.484e9}.items():
            assert parse_frequency(text) == pytest.approx(frequency_hz)
        for text in ("GHz", "5,2GHz"):
            with pytest.raises(typer.BadParameter, match="is not a frequency: give hertz, or a number with its unit"):
                parse_frequency(text)
        with pytest.raises(typer.BadParameter, match=r"'6' is 6 Hz: give ch6 for this Wi-Fi channel \(2\.437 GHz\),"):
            parse_frequency("6")
        with pytest.raises(typer.BadParameter, match="'ch20' is no channel: give ch1 to ch14, ch32 to ch177, or"):
            parse_frequency("ch20")

    @pytest.mark.parametrize(
        ("words", "tx"),
        [
            (["--tx", "-3.2", "-4.1", "1.5"], (-3.2, -4.1, 1.5)),
            (["--tx", "-.5", "+1e-1"], (-0.5, 0.1, 1.5)),
            (["--tx", "1 2"], (1.0, 2.0, 1.5)),
            (["--tx=-1,2"], (-1.0, 2.0, 1.5)),
        ],
    )
    def test_position(self, room: PartialMap, tmp_path: Path, words: list[str], tx: tuple[float, ...]) -> None:
        save_map(replace(room, origin_m=(50.0, 50.0)), tmp_path / "map.yaml")
        for ordered in ([*words, tmp_path / "map.yaml"], [tmp_path / "map.yaml", *words]):
            result = run("predict", *ordered, "--out", tmp_path, exit_code=2)
            assert result.stderr.startswith(f"error: tx = {tx} is outside the map")
            assert len(result.stderr.splitlines()) == 1

    def test_options_in_groups(self) -> None:
        text = run("predict", "--help").stdout
        titles = [line for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
        assert titles == ["Transmitter:", "Radio:", "Walls:", "Map:", "Output:", "Options:"]
        assert text.index("Transmitter:") < text.index("--power") < text.index("Radio:") < text.index("--frequency")
        assert "--tx X Y [Z]" in text

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--tx", "1", "2", "3", "4"], "is not a position: give --tx X Y or --tx X Y Z in metres."),
            (["--tx"], "is not a position: give --tx X Y or --tx X Y Z in metres."),
            ([*AT, "--material", "cheese"], "error: material = 'cheese' is not allowed: choose one of drywall, brick"),
            ([*AT, "--material", "2,3"], "--material '2,3' is neither a name nor permittivity,conductivity,thickness"),
            ([*AT, "--format", "jpg"], "--format 'jpg' is not known: choose from .nc, .tif, .csv, .png, .html,"),
            ([*AT, "--logo", "acme.png"], "--logo is for the report: give --format pdf as well."),
            ([*AT, "--format", "pdf", "--logo", "acme.png"], "error: logo = 'acme.png' cannot be read (No such file"),
            ([*AT, "--memory", "0.1"], "error: memory_gb = 0.1 is too little"),
            ([*AT, "--power", "1e9"], "error: --power = 1000000000.0 is not allowed: give a number in [-200, 200]."),
        ],
    )
    def test_wrong_option(self, map_path: Path, tmp_path: Path, words: list[str], message: str) -> None:
        result = run("predict", map_path, "--out", tmp_path / "out", *words, exit_code=2)
        assert message in say(result.stderr)
        assert not (tmp_path / "out").exists()

    def test_files_are_written_together_or_not_at_all(
        self, map_path: Path, files_that_fit: Callable[[int], None], tmp_path: Path
    ) -> None:
        out, words = tmp_path / "out", ["--tx", 1, 1, "--spacing", 0.5]
        files_that_fit(2)
        full, blocked = (run("predict", map_path, *words, "--out", to, exit_code=2) for to in (out, map_path / "out"))
        assert full.stderr.startswith(f"error: path = '{out}' could not be written (No space left on device)")
        assert blocked.stderr.startswith(f"error: path = '{map_path / 'out'}' could not be written")
        assert len(full.stderr.splitlines()) == len(blocked.stderr.splitlines()) == 1
        assert not out.exists()
        files_that_fit(99)
        formats = ("--format", "nc", "--format", ".CSV", "--format", "nc", "--format", "pdf")
        Image.new("L", (30, 10)).save(tmp_path / "acme.png")
        result = run("predict", map_path, *words, "--out", out, *formats, "--logo", tmp_path / "acme.png")
        assert sorted(path.name for path in out.iterdir()) == ["coverage.csv", "coverage.nc", "coverage.pdf"]
        assert result.stdout == "".join(f"wrote {out / f'coverage.{kind}'}\n" for kind in ("nc", "csv", "pdf"))


def test_texts_of_files_do_not_reach_the_terminal_raw() -> None:
    name = "a\x1b[2J\nb\u202e.yaml"
    result = run("predict", name, "--tx", "1 1", "--out", "x", exit_code=2)
    assert "a\\x1b[2J b\\u202e.yaml" in result.stderr
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.filterwarnings("always::sionna_partial.maps.partial_map.MapWarning")
@pytest.mark.parametrize("strict", [False, True])
def test_strict_and_warnings_of_one_line_each(strict: bool, map_path: Path, tmp_path: Path) -> None:
    sheet = yaml.safe_load(map_path.read_text()) | {"free_thresh": 0.25, "origin": [-2.0, -1.0, 0.5]}
    map_path.write_text(yaml.safe_dump(sheet))
    result = run("export-scene", map_path, "--out", tmp_path / "scene", *["--strict"] * strict)
    assert load_map(tmp_path / "scene") == load_map(map_path, strict=strict)
    words = ["Pass --strict to read the file to the letter."] * (not strict)
    words += ["origin yaw 0.5 rad: the map is turned"]
    for line, word in zip(result.stderr.splitlines(), words, strict=True):
        assert line.startswith("warning: ")
        assert word in line


class TestExplore:
    def test_made_home(self, tmp_path: Path) -> None:
        result = run("explore", "--out", tmp_path / "maps", "--seed", "7", "--steps", "6", "--steps", "2")
        names = ["steps_002.yaml", "steps_006.yaml", "complete.yaml", "exploration.png", "exploration.gif"]
        assert result.stdout.splitlines() == [f"wrote {tmp_path / 'maps' / name}" for name in names]
        home = sp.make_home(7)
        for name, partial in zip(names, [*explore(home, (2, 6), 7), home], strict=False):
            assert np.array_equal(load_map(tmp_path / "maps" / name).state, partial.state)
        with Image.open(tmp_path / "maps" / "exploration.gif") as animation:
            assert animation.n_frames == 7


def test_works_without_data_llvm_and_tensorflow(tmp_path: Path) -> None:
    package = tmp_path / "sionna_partial"
    shutil.copytree(Path(sp.__file__).parent, package, ignore=shutil.ignore_patterns("predictors", "__pycache__"))
    block = "import sys; sys.modules.update(tensorflow=None, keras=None, drjit=None, mitsuba=None)"
    code = f"{block}\nfrom sionna_partial.cli.app import app\napp(['info'])"
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": "/no/such/libLLVM.so", "COLUMNS": "1000"}
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 1, result.stderr
    assert "unset DRJIT_LIBLLVM_PATH and run pip install" in result.stdout
    assert "sionna-rt" in result.stdout
    for missing in (f"'{package / 'predictors'}' holds none", f"are missing in '{package / 'scenes'}'"):
        assert f"{missing}: install sionna-partial again." in result.stdout


def test_version_of_the_package() -> None:
    assert run("--version").stdout == f"{__version__}\n"


def test_options_that_are_no_lists_are_given_once() -> None:
    for name, command in typer.main.get_command(cli.app).commands.items():  # type: ignore[attr-defined]
        for option in (each for each in command.params if each.opts[0].startswith("--")):
            words = [] if option.is_flag else ["1", "2"] if option.name == "tx" else ["1"] * option.nargs
            rest = ["--no-such-option"] * option.multiple  # which ends the command
            again = (option.secondary_opts or option.opts)[0]
            result = run(name, option.opts[0], *words, again, *words, *rest, exit_code=2)
            assert (f"{option.opts[0]} is given 2 times: give it once." in result.stderr) != option.multiple
