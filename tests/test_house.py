"""The house rules that a machine can check: one direction, light imports, declared dependencies, public names."""

import ast
import json
import operator
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from types import CodeType, ModuleType

import pytest
from public_names import EVERY, GROUPS, TOP

import sionna_partial
from sionna_partial.display import _COMPILING
from sionna_partial.process import _Kernel
from sionna_partial.resources import EXTRAS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "sionna_partial"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8")

ROOMS = {
    "foundations": (
        *(
            "process",
            "arrays",
            "constants",
            "errors",
            "resources",
            "checks",
            "display",
            "settings",
            "files",
            "columns",
            "llvm",
        ),
    ),
    "maps": (
        *(
            "environment",
            "mesh.cut",
            "mesh.scene_mesh",
            "straight_runs",
            "wall_cells",
            "import_report",
            "grid",
            "partial_map",
            "mesh.cells",
            "mesh.upright",
            "mesh.files",
            "ros_map",
            "ros_map_writer",
            "map_files",
        ),
    ),
    "maps.importers": (
        *("wall_layers", "drawing_units", "drawing_lines", "drawings", "pictures", "ifc_layers", "ifc"),
        *("bags", "vacuum", "cloud_files", "points", "simulators"),
    ),
    "worlds": ("buildings", "homes", "camera", "robot"),
    "scene": ("outlines", "scene", "export"),
    "tracing": (
        *("interactions", "power", "paths", "select", "line", "mesh.faces", "walls", "engine", "antennas"),
        *("antenna_files", "array_paths", "responses", "links"),
        *(
            "plan.room",
            "plan.obstacles",
            "plan.clipping",
            "plan.views",
            "plan.layers",
            "plan.beams",
            "plan.reflections",
        ),
        *("plan.arrivals", "plan.joining", "plan.edges"),
        *("mesh.sequences", "mesh.reflections", "stock", "finder"),
        *("path_set", "positions", "simulation", "trace", "gradients"),
    ),
    "prediction": (
        *("evaluate", "unobserved", "space", "features", "rule"),
        *("paper_networks", "map_networks", "map_training", "predictor_files", "unseen_walls", "predictor"),
        *("path_model", "wall_materials", "moved_links"),
    ),
    "measurements": (
        *("surveys", "measurements", "selection", "recordings", "walks", "kinds", "evidence", "assimilation"),
        "localisation",
    ),
    "coverage": (
        "coverage.link_budget",
        "coverage.dataset",
        "coverage.radio",
        "link_model",
        "coverage.grid",
        "coverage.job",
    ),
    "channels": ("files", "joint", "draws", "samples"),
    "networks": ("coverage.network",),
    "differentiable": ("differentiable",),
    "calibration": ("link_paths", "material_fit", "calibration"),
    "placement": ("area", "placement", "several"),
    "exploration": ("next_views", "explore"),
    "lab": (
        *("datasets.settings", "datasets.table", "datasets.shards", "datasets.traces"),
        *("datasets.home_links", "datasets.home_processes"),
        *("datasets.dataset", "metrics", "baselines", "evaluation"),
        *("training.predictor", "training.paths", "training.walls"),
    ),
    "plots": (
        *("style", "logo", "layers", "panel", "coverage_plot", "report", "coverage_viewer"),
        *("exploration_plot", "result_plots"),
    ),
    "results": ("export", "demo", "info", "lab.reports"),
    "apps": ("refining",),
    "apps.live": ("answers", "incoming", "coverage", "topics", "dds", "rosbridge"),
    "apps.app": (
        *("jobs", "radio", "files", "drawing", "survey", "marks", "answer"),
        *("state", "predicting", "maps", "planning", "session", "picture"),
        *("widgets", "sections", "page", "server"),
    ),
    "cli": ("options", "prediction", "learning", "planning", "app"),
    "command": ("__main__",),
}
"""Rooms in reading order, and the modules of each: a module imports only from those before it."""

FILES = {"foundations", "coverage", "networks", "differentiable", "results", "command"}
"""Rooms whose modules are given by their full names."""

MODULES = tuple(
    module if room in FILES else f"{room}.{module}" for room, modules in ROOMS.items() for module in modules
)

IN_FUNCTIONS = {"tensorflow", "keras", "sionna", "mitsuba", "drjit", "bokeh", "tornado"}
"""Imported where they are needed, after `load_llvm`, never at the top of a module."""

HEAVY = IN_FUNCTIONS | {
    *("numpy", "scipy", "numba", "skimage", "shapely", "trimesh", "matplotlib", "xarray", "rasterio", "h5netcdf"),
    *("h5py", "PIL", "yaml", "pandas", "pyarrow", "dask", "distributed", "rosbags", "ezdxf", "laspy", "pypcd4"),
    "ifcopenshell",
}
"""Not loaded by `import sionna_partial`, nor by `--help`."""

HOMES = {
    **dict.fromkeys(["drjit", "mitsuba", "sionna"], ("tracing.", "llvm")),
    **dict.fromkeys(["tensorflow", "keras"], ("prediction.", "differentiable", "lab.training.")),
    "matplotlib": ("plots.",),
    "bokeh": ("plots.", "apps.app."),
}
"""Beginnings of the modules that may import these libraries."""

STRAYS = {
    ("scene.scene", "sionna"): "the table of ITU materials",
    ("lab.datasets.home_processes", "drjit"): "the threads of a worker",
}
"""Modules that import one of them all the same, and what for."""

PLOTS_ARE_FOR = ("plots.", "apps.app.", "cli.", "export", "demo", "lab.reports")
"""Beginnings of the modules that may import plots: they are a leaf."""

IMPORTERS = {
    f"maps.importers.{reader}"
    for reader in (
        *("bags:map_from_bag", "drawings:map_from_drawing", "pictures:read_picture", "ifc:map_from_ifc"),
        *("cloud_files:is_cloud", "points:map_from_points", "vacuum:read_vacuum_map"),
    )
}
"""What `load_map` imports when it meets a file of that kind."""

LATER = {"export:save_coverage"} | IMPORTERS
"""What strings name in later rooms, besides plots; the first is for `coverage.radio.save`."""

CLIENTS = ("maps.importers.", "apps.", "lab.", "cli.", "__main__")
"""Beginnings of the modules that the core does without."""

CLIENTS_ARE_FOR = {
    "measurements.recordings": "recordings of robots",
    "measurements.surveys": "surveys of vacuum robots",
    "plots.result_plots": "pictures of evaluations",
}
"""Other modules that import them, and what for."""

NOT_IMPORTED = {
    "dask": "what distributed is the scheduler of; the cluster's commands are `dask scheduler` and `dask worker`",
    "karellen-llvm-core": "a shared library, which sionna_partial.llvm finds and loads",
    "tensorflow-cpu": "the backend that keras imports",
    "zarr": "what xarray writes and reads .zarr with",
}
"""Declared dependencies that no module imports, and why they are needed."""

COME_WITH = {
    "contourpy": "matplotlib",
    "drjit": "sionna-rt",
    "mitsuba": "sionna-rt",
    "pandas": "xarray",
    "rich": "typer",
}
"""Imported packages that a declared one cannot do without, and which it therefore installs in a version that fits."""


NAMES_OF_0_1 = """
    Assimilation CellState ChannelSamples DatasetSettings DifferentiableScene Exploration GainGradients LinkFeatures
    LinkPrediction LinkState Material MaterialCalibration Measurements NetworkPlacement NextView NextViews
    PartialMap PlacementSettings Predictor PredictorSettings SceneSettings SensorSettings SionnaPartialError
    TraceSettings TracedLinks TransmitterPlacement animate_exploration build_dataset calibrate_materials
    dft_codebook evaluate explore explore_trajectory export_scene gain_gradients link_features load_channels
    load_coverage load_map make_home map_from_array map_from_bag map_from_drawing map_from_habitat
    map_from_occupancy map_from_points map_from_slam measurements_from_bag network_map next_views place_transmitter
    place_transmitters plot_calibration plot_coverage plot_exploration plot_map plot_network plot_network_placement
    plot_next_views plot_placement poses_from_bag predict_map read_dataset sample_channels save_channels
    save_coverage save_map save_network trace_links train
"""
"""Public names of version 0.1.0."""


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))


def imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield str(node.module)


def imported_at_the_top(tree: ast.Module) -> set[str]:
    statements = [
        node for node in tree.body if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test))
    ]
    outside = [node for node in statements if not isinstance(node, ast.FunctionDef | ast.ClassDef)]
    return {name.partition(".")[0] for node in outside for name in imported(node)}


@cache
def own_imports(module: str) -> set[str]:
    prefix = "sionna_partial."
    return {name.removeprefix(prefix) for name in imported(tree_of(module)) if name.startswith(prefix)}


@cache
def own_strings(module: str) -> set[str]:
    """Return what strings name in modules of the package, such as "plots.style:plot_map"."""
    constants = (node.value for node in ast.walk(tree_of(module)) if isinstance(node, ast.Constant))
    texts = [text for text in constants if isinstance(text, str)]
    named = {name for text in texts for name in re.findall(r"sionna_partial\.([\w.]*\w)", text)}
    named |= {text for text in texts if re.fullmatch(r"[\w.]+:\w+", text)}
    return {name for name in named if name.partition(":")[0] in MODULES}


def declared(kind: str) -> set[str]:
    extras = PROJECT["optional-dependencies"]
    lines = extras["dev"] if kind == "dev" else sum((extras[name] for name in EXTRAS), PROJECT["dependencies"])
    return {re.split(r"[^\w.-]", line)[0] for line in lines}


def modules_after(*steps: str) -> list[set[str]]:
    """Modules that a Python of its own has loaded after each step; packages end with a dot."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])}
    loaded = "[name + '.' * hasattr(each, '__path__') for name, each in sys.modules.items()]"
    code = "\n".join(["import sys, json", *(f"{step}\nprint(json.dumps({loaded}))" for step in steps)])
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    return [set(json.loads(line)) for line in result.stdout.splitlines() if line.startswith("[")]


def libraries(modules: set[str]) -> set[str]:
    return {name.partition(".")[0] for name in modules}


class TestOneDirection:
    def test_every_module_is_listed(self) -> None:
        files = (path.relative_to(PACKAGE).with_suffix("") for path in PACKAGE.rglob("*.py") if path.stem != "__init__")
        assert sorted(MODULES) == sorted(".".join(file.parts) for file in files)

    def test_modules_import_only_from_those_before_them(self) -> None:
        late = {module: own_imports(module) - set(MODULES[:number]) for number, module in enumerate(MODULES)}
        assert {module: names for module, names in late.items() if names} == {}

    def test_strings_name_only_modules_before_them_plots_and_what_is_listed(self) -> None:
        named = {(number, name) for number, module in enumerate(MODULES) for name in own_strings(module)}
        late = {name for number, name in named if name.partition(":")[0] not in MODULES[: number + 1]}
        assert {name for name in late if not name.startswith("plots.")} == LATER

    def test_the_core_does_without_its_clients(self) -> None:
        core = [module for module in MODULES if not module.startswith(CLIENTS)]
        users = {module for module in core if any(name.startswith(CLIENTS) for name in own_imports(module))}
        assert users == CLIENTS_ARE_FOR.keys()
        named = {(module, name) for module in core for name in own_strings(module) if name.startswith(CLIENTS)}
        assert named == {("maps.map_files", name) for name in IMPORTERS}

    def test_plots_are_a_leaf(self) -> None:
        users = [module for module in MODULES if any(name.startswith("plots.") for name in own_imports(module))]
        assert [module for module in users if not module.startswith(PLOTS_ARE_FOR)] == []

    def test_each_heavy_library_has_its_rooms(self) -> None:
        found = {(module, name.partition(".")[0]) for module in MODULES for name in imported(tree_of(module))}
        strays = {(module, name) for module, name in found if name in HOMES and not module.startswith(HOMES[name])}
        assert strays == STRAYS.keys()

    def test_only_the_command_line_uses_the_lazy_names(self) -> None:
        for module in MODULES:
            lazy = any(
                isinstance(node, ast.Import) and node.names[0].name == "sionna_partial"
                for node in ast.walk(tree_of(module))
            )
            assert not lazy or module.startswith("cli."), module

    def test_libraries_that_need_llvm_first_are_imported_in_functions(self) -> None:
        assert [module for module in MODULES if imported_at_the_top(tree_of(module)) & IN_FUNCTIONS] == []


class TestLightImports:
    def test_help(self) -> None:
        code = """
import typer
from sionna_partial.cli.app import app
for name in ("", *typer.main.get_command(app).commands):
    try:
        app([*filter(None, [name]), "--help"])
    except SystemExit as end:
        assert end.code == 0, name
"""
        assert not libraries(modules_after(code)[-1]) & HEAVY

    def test_package_reader_and_prediction(self) -> None:
        path = ROOT / "scenes/apartment/step100/map.yaml"
        package, reader, prediction = modules_after(
            "import sionna_partial as sp", f"sp.load_map({str(path)!r})", "sp.predict_map"
        )
        assert not libraries(package) & (HEAVY | {"typer", "rich"})
        others = {f"sionna_partial.{name}" for name in ("maps.importers.", "maps.mesh.cells", "maps.mesh.files")}
        assert not reader & (others | {"scipy.ndimage."})
        clients = {f"sionna_partial.{name}" for name in CLIENTS}
        assert not (package | reader | prediction) & clients
        assert not libraries(reader) & {"numba", "rosbags", "ezdxf", "laspy", "pypcd4", "trimesh"}
        own = [name for name in prediction if name.startswith("sionna_partial.") and not name.endswith(".")]
        assert len(own) <= 77

    def test_figures_do_without_data_sets(self) -> None:
        """Reading data sets takes pyarrow, which is optional."""
        loaded = modules_after("from sionna_partial.plots import plot_placement, plot_report, plot_map")[-1]
        assert "sionna_partial.lab.metrics" in loaded
        assert "sionna_partial.lab.datasets.shards" not in loaded

    def test_predictions_do_without_tensorflow_and_dask(self) -> None:
        """With the networks of opaque walls at 28 GHz, with the unseen walls below 24 GHz."""
        path = ROOT / "scenes/apartment/step050/map.yaml"
        calls = (
            f"sp.predict_map({str(path)!r}, (2, 2), spacing_m=2, trace_settings=sp.TraceSettings({hz:g}, max_depth=1))"
            for hz in (28e9, 5.2e9)
        )
        last = modules_after("import sionna_partial as sp", *(f"assert {call}.map_complete == 0" for call in calls))[-1]
        assert not libraries(last) & {"tensorflow", "keras", "dask", "trimesh", "ipywidgets", "pythreejs", "IPython"}
        assert not last & {"scipy.optimize.", "matplotlib.pyplot"}

    def test_a_prediction_runs_few_modules(self) -> None:
        codes: set[CodeType] = set()
        predict = sionna_partial.predict_map
        sys.setprofile(lambda frame, *_: codes.add(frame.f_code))
        try:
            predict(ROOT / "scenes/apartment/step050/map.yaml", (2.0, 2.0), spacing_m=2.0)
        finally:
            sys.setprofile(None)
        files = {code.co_filename for code in codes if code.co_name != "<module>"}
        assert len([name for name in files if name.startswith(str(PACKAGE))]) <= 45

    @pytest.mark.parametrize(("place", "frequency_hz"), [(0, 28e9), (1, 5.2e9)])
    def test_the_first_prediction_compiles_as_many_kernels_as_its_bar_says(
        self, place: int, frequency_hz: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        called: set[_Kernel] = set()
        call = _Kernel.__call__
        monkeypatch.setattr(_Kernel, "__call__", lambda kernel, *given: called.add(kernel) or call(kernel, *given))
        settings = sionna_partial.TraceSettings(frequency_hz)
        sionna_partial.predict_map(
            ROOT / "scenes/apartment/step100/map.yaml", (7.0, 9.8), spacing_m=2.0, trace_settings=settings
        )
        waiting = [*called]
        while waiting:
            function = waiting.pop().__wrapped__  # type: ignore[attr-defined]
            callees = map(function.__globals__.get, function.__code__.co_names)
            waiting += (new := {each for each in callees if isinstance(each, _Kernel)} - called)
            called |= new
        said = [int(number) for number in re.findall(r"\d+", _COMPILING)][place]
        assert len(called) == pytest.approx(said, rel=0.1)


class TestPublicNames:
    def test_names_resolve_to_what_they_say(self) -> None:
        for module in MODULES:
            import_module(f"sionna_partial.{module}")
        for name, value in EVERY.items():
            assert not isinstance(value, ModuleType)
            assert getattr(value, "__name__", name) == name.rpartition(".")[2]
        assert dir(sionna_partial) == sorted(sionna_partial.__all__)

    def test_there_are_few(self) -> None:
        assert len(TOP) <= 40
        assert {*sionna_partial.__all__} == {*TOP, *GROUPS, "__version__"}

    def test_names_of_version_0_1_warn_and_are_the_same_objects(self) -> None:
        for name in sorted({*NAMES_OF_0_1.split()} - {*TOP}):
            message = rf"^sionna_partial\.{name} is deprecated: use sionna_partial\.[\w.]*\w\.$"
            with pytest.warns(DeprecationWarning, match=message) as warned:
                found = getattr(sionna_partial, name)
            there = str(warned[0].message).rpartition(" sionna_partial.")[2].removesuffix(".")
            assert operator.attrgetter(there)(sionna_partial) is found
            assert warned[0].filename == __file__
            assert found.__name__ in (name, "predict_network")

    def test_unknown_name(self) -> None:
        with pytest.raises(AttributeError, match="module 'sionna_partial' has no attribute 'teleport'"):
            sionna_partial.teleport  # noqa: B018

    def test_version_is_that_of_the_project(self) -> None:
        assert sionna_partial.__version__ == PROJECT["version"]


class TestDependencies:
    def test_what_is_imported_is_declared(self) -> None:
        own = {*sys.stdlib_module_names, "sionna_partial"}
        names = {name.partition(".")[0] for module in MODULES for name in imported(tree_of(module))} - own
        distributions = metadata.packages_distributions()
        used = {distributions[name][0].lower().replace("_", "-") for name in names}
        assert COME_WITH.keys() < used
        assert declared("run") == used - COME_WITH.keys() | NOT_IMPORTED.keys()

    def test_packages_of_extras_are_known_to_the_error_that_names_them(self) -> None:
        extras = {name: lines for name, lines in PROJECT["optional-dependencies"].items() if name not in ("all", "dev")}
        packages = {name: {*re.findall(r"\w+(?=[]>[])", " ".join(lines))} for name, lines in extras.items()}
        assert packages == {name: {*known} for name, known in EXTRAS.items()}
        assert PROJECT["optional-dependencies"]["all"] == [f"sionna-partial[{','.join(sorted(extras))}]"]

    def test_what_is_declared_is_locked(self) -> None:
        locked = set(re.findall(r"^([\w.-]+)==", LOCK, flags=re.MULTILINE))
        assert declared("run") | declared("dev") <= locked

    def test_lock_holds_nothing_of_the_machine_that_made_it(self) -> None:
        pinned = re.compile(r"[\w.-]+==\S+( ;.*)? \\|    --hash=sha256:[0-9a-f]{64}( \\)?|\s*#.*|")
        assert [line for line in LOCK.splitlines() if not pinned.fullmatch(line)] == []
        assert not re.search(r"file:/|://|/opt|/work|/tmp", LOCK)
