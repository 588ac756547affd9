"""LLVM is found and loaded so that Dr.Jit and TensorFlow live together, in either order."""

import json
import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from sionna_partial import llvm
from sionna_partial.errors import BackendError
from sionna_partial.llvm import load_llvm

OLD_LIBRARIES = (Path("/usr/lib/llvm-14/lib/libLLVM.so"), Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1"))

START = """
import numpy as np
import sionna_partial as sp
from sionna_partial.errors import BackendError
from sionna_partial.llvm import load_llvm
"""
TRACE = """
room = sp.PartialMap(np.zeros((20, 40), np.uint8), 0.1)
print(sp.trace_links(room, (1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)]).delay_s.tolist())
"""
TRY = """
try:
    library = load_llvm()
    print(library.source, library.path)
except BackendError as error:
    print(error)
"""
LIVE_TOGETHER = {
    "tensorflow first": ("import tensorflow", "load_llvm()", TRACE),
    "tensorflow last": ("load_llvm()", TRACE, "import tensorflow"),
}
AND_THEN = """
import io
import matplotlib.figure, mitsuba as mi, keras
matplotlib.figure.Figure().savefig(io.BytesIO())
try:
    mi.load_string("<scene version='3.0.0'><shape type='no-such-shape'/></scene>")
except RuntimeError:
    print("mitsuba refused")
model = keras.Sequential([keras.layers.Input((2,)), keras.layers.Dense(1)])
model.compile("adam", "mse")
model.fit(np.ones((8, 2)), np.ones(8), verbose=0)
"""


def run_python(*lines: str, folder: Path | None = None, **environment: str) -> str:
    """Output of a Python of its own, without the DRJIT_LIBLLVM_PATH of this one; it ends well."""
    base = {name: value for name, value in os.environ.items() if name != llvm.PATH_VARIABLE}
    modules = os.pathsep.join(filter(None, [str(Path(llvm.__file__).parents[1]), base.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-c", START + "\n".join(lines)],
        env=base | {"PYTHONPATH": modules} | environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("order", LIVE_TOGETHER)
def test_dr_jit_and_tensorflow_live_together(order: str) -> None:
    lines = run_python(*LIVE_TOGETHER[order], AND_THEN, TRACE).splitlines()
    first, second = (line for line in lines if line.startswith("["))
    assert first == second
    assert json.loads(first)[0] == pytest.approx(2.0 / 299792458.0, rel=1e-5)
    assert "mitsuba refused" in lines


def test_library_is_loaded_once_and_named_for_dr_jit() -> None:
    library = load_llvm()
    assert load_llvm() is library
    assert os.environ[llvm.PATH_VARIABLE] == str(library.path)
    assert int(library.version.partition(".")[0]) >= llvm.OLDEST_MAJOR


def test_library_of_pip_is_taken_by_its_real_file() -> None:
    source, path = run_python(TRY).split(maxsplit=1)
    assert source == "karellen-llvm-core"
    assert Path(path.strip()).is_file()
    assert not Path(path.strip()).is_symlink()


def test_child_process_takes_the_library_of_its_parent() -> None:
    path = str(load_llvm().path)
    assert run_python(TRY, **{llvm.PATH_VARIABLE: path}) == f"{llvm.PATH_VARIABLE} {path}\n"


def test_library_without_links_to_its_runtime_works_from_a_path_with_spaces(tmp_path: Path) -> None:
    original = load_llvm().path.resolve()
    runtimes = [file for file in original.parent.glob("*-unknown-linux-gnu/*.so.*") if not file.is_symlink()]
    if not runtimes:
        pytest.skip("this LLVM does not bring its own C++ runtime")
    for file in (original, *runtimes):
        copy = tmp_path / "a b" / file.relative_to(original.parent)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, copy)
    assert run_python(TRACE, **{llvm.PATH_VARIABLE: str(tmp_path / "a b" / original.name)}).startswith("[")


def test_relative_path_stays_valid_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "here").symlink_to(load_llvm().path.parent)
    name = f"./here/{load_llvm().path.name}"
    expected = f"{llvm.PATH_VARIABLE} {tmp_path / name}\n"
    assert run_python(TRY, folder=tmp_path, **{llvm.PATH_VARIABLE: name}) == expected


class TestDrjitImportedFirst:
    def test_on_a_good_library(self) -> None:
        path = str(load_llvm().path)
        answer = run_python("import drjit", TRY, TRACE, **{llvm.PATH_VARIABLE: path})
        assert answer.startswith(f"{llvm.PATH_VARIABLE} {path}\n[")

    def test_on_none(self) -> None:
        answer = run_python("import drjit", TRY, **{llvm.PATH_VARIABLE: "/no/such/libLLVM.so"})
        assert "drjit was imported before sionna_partial could choose an LLVM, and runs on no LLVM: call" in answer
        assert "sionna_partial.llvm.load_llvm() before importing drjit" in answer


class TestNamedByTheUser:
    """DRJIT_LIBLLVM_PATH is taken as it is set, and nothing else in its place."""

    def refusal(self, name: str) -> str:
        answer = run_python(TRY, **{llvm.PATH_VARIABLE: name})
        assert answer.startswith(f"{llvm.PATH_VARIABLE} = '{name}' cannot be used (")
        assert f'): unset {llvm.PATH_VARIABLE} and run pip install "karellen-llvm-core>=19.1.7,<24"' in answer
        return answer

    @pytest.mark.parametrize("name", ["/no/such/libLLVM.so", "libLLVM-none.so"])
    def test_missing_file(self, name: str) -> None:
        assert "No such file" in self.refusal(name)

    @pytest.mark.parametrize("path", OLD_LIBRARIES, ids=lambda path: path.name)
    def test_old_library_is_refused_before_it_aborts(self, path: Path) -> None:
        if not path.exists():
            pytest.skip(f"{path} is not on this machine")
        assert "it is no LLVM of version 17 or newer" in self.refusal(str(path))

    def test_file_that_is_no_library(self, tmp_path: Path) -> None:
        path = tmp_path / "libLLVM-99.so"
        path.write_bytes(b"not really a library")
        assert "file too short" in self.refusal(str(path))

    def test_library_of_another_kind(self) -> None:
        import _ctypes

        assert "it is no LLVM of version 17 or newer" in self.refusal(_ctypes.__file__)


def test_without_any_library(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.delenv(llvm.PATH_VARIABLE, raising=False)
    monkeypatch.setattr(metadata, "distribution", missing)
    with pytest.raises(BackendError, match=r'^No LLVM library is installed: run pip install "karellen-llvm-core>='):
        llvm._loaded_library.__wrapped__()
