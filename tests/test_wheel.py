"""The wheel holds all that a user needs, and nothing else."""

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def names(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        return archive.namelist()


def test_package_is_whole(names: list[str]) -> None:
    sources = {f"sionna_partial/{path.name}" for path in (ROOT / "sionna_partial").glob("*.py")}
    assert sources | {"sionna_partial/py.typed", "sionna_partial/__init__.pyi"} <= set(names)
    assert any(name.endswith("licenses/LICENSE") for name in names)


@pytest.mark.parametrize("folder", ["predictors", "scenes"])
def test_data_is_whole(names: list[str], folder: str) -> None:
    place = ROOT / ("scenes" if folder == "scenes" else "sionna_partial/predictors")
    files = {path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()}
    files = {file for file in files if "__pycache__" not in file}
    assert files
    assert {f"sionna_partial/{folder}/{file}" for file in files} <= set(names)


def test_nothing_else_is_in_it(names: list[str]) -> None:
    tops = {name.partition("/")[0] for name in names}
    assert tops == {"sionna_partial", "sionna_partial-0.1.0.dist-info"}
    assert not [name for name in names if "test" in name or "__pycache__" in name]


@pytest.mark.slow
def test_demo_runs_from_the_wheel_alone(wheel: Path, tmp_path: Path) -> None:
    """Install the lock and the wheel in a new environment, and run the demo in an empty folder."""
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    lock = ["--only-binary", ":all:", "--require-hashes", "-r", ROOT / "requirements.lock"]
    subprocess.run([*install, *lock], check=True, timeout=1800)
    subprocess.run([*install, wheel], check=True, timeout=300)
    (tmp_path / "empty").mkdir()
    result = subprocess.run(
        [python.parent / "sionna-partial", "demo", "--out", "results"],
        cwd=tmp_path / "empty",
        env={name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "DRJIT", "VIRTUAL"))},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr
    written = [
        tmp_path / "empty" / line.removeprefix("wrote ") for line in result.stdout.splitlines() if "wrote" in line
    ]
    assert written
    assert all(file.stat().st_size for file in written)
