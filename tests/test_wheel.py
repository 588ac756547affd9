"""The wheel, built from the source archive, holds all that a user needs, and nothing else."""

import os
import re
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from sionna_partial.process import COMPILING_ONCE

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    return next(dist.glob("*.whl"))


@pytest.fixture(scope="module")
def archive(dist: Path) -> Path:
    return next(dist.glob("*.tar.gz"))


@pytest.fixture(scope="module")
def names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {*archive.namelist()}


def test_package_and_data_are_whole_and_nothing_else_is_there(names: set[str]) -> None:
    files = {file.relative_to(ROOT).as_posix() for file in (ROOT / "sionna_partial").rglob("*") if file.is_file()}
    files |= {f"sionna_partial/{file.relative_to(ROOT)}" for file in (ROOT / "scenes").rglob("*") if file.is_file()}
    files = {file for file in files if "__pycache__" not in file}
    stubs = {f"sionna_partial/{group}__init__.pyi" for group in ("", "lab/", "maps/importers/")}
    assert {"sionna_partial/py.typed"} | stubs < files <= names
    others = {name.partition("/")[2] for name in names - files}
    assert "licenses/LICENSE" in others
    assert {name.partition("/")[0] for name in names - files} == {"sionna_partial-0.1.0.dist-info"}


def test_source_archive_has_what_its_pages_name(archive: Path) -> None:
    with tarfile.open(archive) as files:
        names = {name.partition("/")[2] for name in files.getnames()}
    assert {"pyproject.toml", "LICENSE", "CITATION.cff", "scenes/scan.ply"} <= names
    linked = re.findall(r"\]\(([\w/]+\.\w+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert {"docs/coverage.png", "CHANGELOG.md"} <= set(linked) <= names
    assert not [name for name in names if name.startswith(("build/", ".venv/")) or "__pycache__" in name]


def published_in(folder: Path, *install: str | Path) -> tuple[Path, dict[str, str]]:
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    subprocess.run([python, *install], check=True, timeout=1800)
    hidden = ("PYTHON", "DRJIT", "VIRTUAL")
    return python, {name: value for name, value in os.environ.items() if not name.startswith(hidden)}


INSTALL = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check")
LOCK = ROOT / "requirements.lock"


@pytest.mark.slow
def test_demo_runs_from_what_is_published_alone(wheel: Path, archive: Path, tmp_path: Path) -> None:
    """Install the lock, then wheel and source archive, in a new environment; run the demo in an empty folder."""
    python, environment = published_in(tmp_path / "venv", ROOT / "install_locked.py")
    (tmp_path / "empty").mkdir()
    for published in (archive, wheel):
        again = [*INSTALL, "--no-deps", "--no-build-isolation", "--force-reinstall", published]
        subprocess.run([python, *again], check=True, timeout=300)
        command = [python.parent / "sionna-partial", "demo", "--out", f"demo{published.suffix}"]
        result = subprocess.run(
            command, cwd=tmp_path / "empty", env=environment, capture_output=True, text=True, timeout=600
        )
        assert result.returncode == 0, result.stderr
        assert published == wheel or "compiling, once: kernel" in result.stderr
        lines = [line.removeprefix("wrote ") for line in result.stdout.splitlines() if "wrote" in line]
        assert lines
        assert all((tmp_path / "empty" / line).stat().st_size for line in lines)


@pytest.mark.pages
def test_base_predicts_without_any_extra(wheel: Path, tmp_path: Path) -> None:
    """Install the wheel without extras, in locked versions; predict, and write all formats that need no extra."""
    versions = re.findall(r"^[\w.-]+==[^\s\\]+", LOCK.read_text(encoding="utf-8"), flags=re.MULTILINE)
    (tmp_path / "versions.txt").write_text("\n".join(versions), encoding="utf-8")
    python, environment = published_in(tmp_path / "venv", *INSTALL, "-c", tmp_path / "versions.txt", wheel)
    code = """
import sionna_partial as sp
from importlib.util import find_spec
from sionna_partial.resources import EXTRAS, scenes_folder
assert not any(map(find_spec, {package for packages in EXTRAS.values() for package in packages}))
coverage = sp.predict_map(scenes_folder() / "apartment" / "step100", (7.0, 9.8, 1.5), spacing_m=1.0)
for suffix in ("nc", "csv", "png", "yaml"):
    coverage.radio.save(f"coverage.{suffix}")
"""
    command = [python, "-c", code]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    assert result.stderr.splitlines().count(COMPILING_ONCE) == 1
    assert {path.suffix for path in tmp_path.glob("coverage.*")} == {".nc", ".csv", ".png", ".yaml", ".pgm"}
