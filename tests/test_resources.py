"""Demo scenes are found in a wheel and in the repository; optional packages are asked for by the command."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sionna_partial import resources
from sionna_partial.errors import SceneError


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(resources, "_PACKAGE", tmp_path / "package")
    return tmp_path / "package"


def add_homes(folder: Path, text: str = '{"flat": {"seed": 3, "transmitter": [1, 2, 1.5]}}') -> Path:
    folder.mkdir(parents=True)
    (folder / "homes.json").write_text(text)
    return folder


def test_scenes_of_the_package_come_before_those_of_the_repository(package: Path) -> None:
    (package / "scenes").mkdir(parents=True)
    with pytest.raises(SceneError, match=r"demo scenes are missing in '.*scenes': install sionna-partial again\."):
        resources.scenes_folder()
    in_repository = add_homes(package.parent / "scenes")
    assert resources.scenes_folder() == in_repository
    (package / "scenes").rmdir()
    in_package = add_homes(package / "scenes")
    assert resources.scenes_folder() == in_package


@pytest.mark.parametrize("text", ["{", "[]", '{"flat": {"transmitter": ["x"]}}'])
def test_damaged_description(package: Path, text: str) -> None:
    add_homes(package / "scenes", text)
    with pytest.raises(SceneError, match=r"homes.json' cannot be read \(.*\): install sionna-partial again\."):
        resources.demo_homes()


WITHOUT_OPTIONAL_PACKAGES = """
import json, sys
from pathlib import Path

import sionna_partial as sp
from sionna_partial.resources import EXTRAS
sys.modules.update((package, None) for packages in EXTRAS.values() for package in packages)
partial = sp.load_map(sys.argv[1])
coverage = sp.predict_map(partial, (1.5, 1.5, 1.5), spacing_m=0.5)
for suffix in ("nc", "csv", "png", "yaml"):
    sp.save_coverage(coverage, f"coverage.{suffix}")
assert sp.load_coverage("coverage.nc").equals(coverage)
messages = {}
for name in ("plan.dxf", "house.ifc", "drive.bag", "scan.pcd", "scan.las"):
    Path(name).write_bytes(b"")
for what, call in {
    "plan.dxf": sp.load_map, "house.ifc": sp.load_map, "drive.bag": sp.load_map, "scan.pcd": sp.load_map,
    "scan.las": sp.load_map, "coverage.tif": coverage.radio.save, "coverage.html": coverage.radio.save,
    "make_home": lambda _: sp.make_home(3), "save_channels": lambda _: sp.channels.save_channels,
    "build_dataset": lambda _: sp.lab.build_dataset,
}.items():
    try:
        call(what)
    except sp.SionnaPartialError as error:
        messages[what] = str(error)
from sionna_partial.cli.app import main
print(json.dumps(messages), flush=True)
sys.argv = ["sionna-partial", "app", sys.argv[1]]
main()
"""


def test_base_installation_predicts_and_names_what_else_is_needed(tmp_path: Path) -> None:
    import sionna_partial as sp

    cells = [[1, 1, 1, 1], [1, 0, 0, 1], [1, 0, 0, 1], [1, 1, 1, 1]]
    sp.save_map(sp.map_from_array(cells, resolution_m=1.0), tmp_path / "map.yaml")
    root = str(Path(resources.__file__).resolve().parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([root, *filter(None, sys.path)])}
    command = [sys.executable, "-c", WITHOUT_OPTIONAL_PACKAGES, "map.yaml"]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
    assert result.stdout, result.stderr
    messages = json.loads(result.stdout.splitlines()[0])
    assert messages == {
        what: f"{package} is not installed: {remedy} in the repository, or '.[all]'."
        for what, package, remedy in [
            ("plan.dxf", "ezdxf", "pip install '.[maps]'"),
            ("house.ifc", "ifcopenshell", "pip install '.[ifc]'"),
            ("drive.bag", "rosbags", "pip install '.[live]' or pip install '.[maps]'"),
            ("scan.pcd", "pypcd4", "pip install '.[maps]'"),
            ("scan.las", "laspy", "pip install '.[maps]'"),
            ("coverage.tif", "rasterio", "pip install '.[datasets]' or pip install '.[geo]'"),
            ("coverage.html", "bokeh", "pip install '.[app]'"),
            ("make_home", "rasterio", "pip install '.[datasets]' or pip install '.[geo]'"),
            ("save_channels", "dask", "pip install '.[channels]' or pip install '.[datasets]'"),
            ("build_dataset", "dask", "pip install '.[channels]' or pip install '.[datasets]'"),
        ]
    }
    assert result.returncode == 2
    assert "bokeh is not installed: pip install '.[app]'" in " ".join(result.stderr.split())
