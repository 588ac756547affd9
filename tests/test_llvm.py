"""LLVM is found, tried and loaded so that Dr.Jit and TensorFlow live together, in either order."""

import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from sionna_partial import llvm, llvm_probe
from sionna_partial.errors import BackendError
from sionna_partial.llvm import load_llvm

OLD_LIBRARIES = (Path("/usr/lib/llvm-14/lib/libLLVM.so"), Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1"))

TRACE = "print(llvm_probe.solved_lengths_m())"
LIVE_TOGETHER = {
    "tensorflow first": ("import tensorflow", "load_llvm()", TRACE),
    "tensorflow last": ("load_llvm()", TRACE, "import tensorflow"),
}
AND_THEN = """
import io
import numpy as np
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


def run_python(*lines: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a Python of its own, without the DRJIT_LIBLLVM_PATH of this one."""
    start = "from sionna_partial import llvm_probe\nfrom sionna_partial.llvm import load_llvm\n"
    base = {name: value for name, value in os.environ.items() if name != llvm.PATH_VARIABLE}
    modules = os.pathsep.join(filter(None, [str(Path(llvm.__file__).parents[1]), base.get("PYTHONPATH")]))
    return subprocess.run(
        [sys.executable, "-c", start + "\n".join(lines)],
        env=base | {"PYTHONPATH": modules} | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    """Leave this process as if nothing had been chosen, probed or cached; nothing is loaded into it."""
    monkeypatch.setenv(llvm.PATH_VARIABLE, "put back in the end")
    monkeypatch.delenv(llvm.PATH_VARIABLE)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(llvm, "open_library", lambda path: None)
    monkeypatch.setattr(llvm, "SYSTEM_FOLDERS", (str(tmp_path / "system"),))
    monkeypatch.setattr(llvm, "_pip_libraries", list)
    (tmp_path / "system").mkdir()
    return monkeypatch


def make_library(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"not really a library")
    return path


@pytest.mark.parametrize("order", LIVE_TOGETHER)
def test_dr_jit_and_tensorflow_live_together(order: str) -> None:
    result = run_python(*LIVE_TOGETHER[order], AND_THEN, TRACE)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    lengths = [line for line in lines if line.startswith("[")]
    assert len(lengths) == 2
    assert lengths[0] == lengths[1]
    assert json.loads(lengths[0]) == pytest.approx(llvm_probe.LENGTHS_M, abs=1e-3)
    assert "mitsuba refused" in lines


def test_library_is_loaded_once_and_named_for_dr_jit() -> None:
    library = load_llvm()
    assert load_llvm() is library
    assert os.environ[llvm.PATH_VARIABLE] == str(library.path)
    assert int(library.version.partition(".")[0]) >= llvm.OLDEST_MAJOR
    assert library.path.is_file()


def test_child_process_takes_the_library_of_its_parent() -> None:
    path = str(load_llvm().path)
    result = run_python("print(load_llvm().source, load_llvm().path)", **{llvm.PATH_VARIABLE: path})
    assert result.stdout.split(maxsplit=1) == [llvm.PATH_VARIABLE, path + "\n"], result.stderr


def test_library_without_links_to_its_runtime_works_from_a_path_with_spaces(tmp_path: Path) -> None:
    original = load_llvm().path.resolve()
    runtimes = [file for file in original.parent.glob("*-unknown-linux-gnu/*.so.*") if not file.is_symlink()]
    if not runtimes:
        pytest.skip("this LLVM does not bring its own C++ runtime")
    for file in (original, *runtimes):
        copy = tmp_path / "a b" / file.relative_to(original.parent)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, copy)
    path = tmp_path / "a b" / original.name
    result = run_python("load_llvm()", TRACE, **{llvm.PATH_VARIABLE: str(path), "XDG_CACHE_HOME": str(tmp_path)})
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == pytest.approx(llvm_probe.LENGTHS_M, abs=1e-3)


def test_drjit_may_be_imported_first_on_a_good_library() -> None:
    path = str(load_llvm().path)
    result = run_python("import drjit", "print(load_llvm().path)", TRACE, **{llvm.PATH_VARIABLE: path})
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(str(load_llvm().path.resolve()))


@pytest.mark.parametrize(("version", "found"), [((15, 0, 7), "LLVM 15"), ((-1, -1, -1), "no LLVM")])
def test_drjit_imported_first_on_a_bad_library(fresh: pytest.MonkeyPatch, version: tuple[int, ...], found: str) -> None:
    drjit = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: version))
    fresh.setitem(sys.modules, "drjit", drjit)  # type: ignore[arg-type]
    with pytest.raises(BackendError, match=f"drjit was imported before .* runs on {found}: call .*load_llvm"):
        load_llvm.__wrapped__()


@pytest.mark.usefixtures("fresh")
class TestNamedByTheUser:
    """DRJIT_LIBLLVM_PATH is taken as it is set, and nothing else in its place."""

    def refusal(self, monkeypatch: pytest.MonkeyPatch, name: str) -> str:
        monkeypatch.setenv(llvm.PATH_VARIABLE, name)
        with pytest.raises(BackendError, match=f"{llvm.PATH_VARIABLE} = '{name}' cannot be used") as error:
            load_llvm.__wrapped__()
        assert 'pip install "karellen-llvm-core>=19.1.7,<24"' in str(error.value)
        return str(error.value)

    @pytest.mark.parametrize("name", ["/no/such/libLLVM.so", "libLLVM-none.so"])
    def test_missing_file(self, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
        assert "no such file" in self.refusal(monkeypatch, name)

    @pytest.mark.parametrize("path", OLD_LIBRARIES, ids=lambda path: path.name)
    def test_old_library_is_refused_before_it_aborts(self, monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
        if not path.exists():
            pytest.skip(f"{path} is not on this machine")
        assert "is older than 17 and cannot compile path kernels" in self.refusal(monkeypatch, str(path))

    def test_file_that_is_no_library(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        path = make_library(tmp_path / "libLLVM-99.so")
        assert "file too short" in self.refusal(monkeypatch, str(path))

    def test_bare_name_is_looked_up(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
        path = make_library(tmp_path / "libLLVM-99.so")
        monkeypatch.setenv(llvm.PATH_VARIABLE, path.name)
        assert list(llvm._candidates()) == [(path, llvm.PATH_VARIABLE)]

    def test_relative_path_stays_valid_elsewhere(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        make_library(tmp_path / "libLLVM-99.so")
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv(llvm.PATH_VARIABLE, "./libLLVM-99.so")
        monkeypatch.setattr(llvm, "_probe", lambda path: llvm._Verdict("99.0", ""))
        assert load_llvm.__wrapped__().path == tmp_path / "libLLVM-99.so"
        assert os.environ[llvm.PATH_VARIABLE] == str(tmp_path / "libLLVM-99.so")


class TestSearch:
    """pip's library comes first, then the newest of the system; old ones never."""

    def test_system_libraries_are_new_enough_and_newest_first(self, fresh: pytest.MonkeyPatch, tmp_path: Path) -> None:
        system = tmp_path / "system"
        for name in ("libLLVM-14.so.1", "libLLVM-14.0.6.so", "libLLVM-15.so.1", "libLLVM-16.so", "libLLVM-19.so.1"):
            make_library(system / name)
        make_library(system / "libLLVM.so.22.1")
        (system / "libLLVM.so").symlink_to("libLLVM-15.so.1")
        (system / "libLLVM-22.so").symlink_to("libLLVM.so.22.1")
        assert [path.name for path in llvm._system_libraries()] == ["libLLVM.so.22.1", "libLLVM-19.so.1"]

    def test_old_system_libraries_are_as_good_as_none(self, fresh: pytest.MonkeyPatch, tmp_path: Path) -> None:
        make_library(tmp_path / "system" / "libLLVM-15.so.1")
        with pytest.raises(BackendError, match=r"No LLVM of version 17 or newer .* none was found: run pip install"):
            load_llvm.__wrapped__()

    def test_pip_library_comes_first(self, fresh: pytest.MonkeyPatch, tmp_path: Path) -> None:
        mine, theirs = make_library(tmp_path / "libLLVM.so.19.1"), make_library(tmp_path / "system/libLLVM.so.22.1")
        fresh.setattr(llvm, "_pip_libraries", lambda: [mine])
        fresh.setattr(llvm, "_probe", lambda path: llvm._Verdict("19.1.7", ""))
        assert load_llvm.__wrapped__() == llvm.LlvmLibrary(mine, "19.1.7", "karellen-llvm-core")
        assert [path for path, _ in llvm._candidates()] == [mine]
        fresh.delenv(llvm.PATH_VARIABLE)
        assert list(llvm._candidates()) == [(mine, "karellen-llvm-core"), (theirs, "system")]

    def test_next_library_is_tried_and_said(
        self, fresh: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        broken, sound = make_library(tmp_path / "libLLVM.so.23.1"), make_library(tmp_path / "system/libLLVM.so.22.1")
        fresh.setattr(llvm, "_pip_libraries", lambda: [broken])
        fresh.setattr(llvm, "_probe", lambda path: llvm._Verdict("22.1", "it crashed" if path == broken else ""))
        with caplog.at_level(logging.WARNING):
            assert load_llvm.__wrapped__() == llvm.LlvmLibrary(sound, "22.1", "system")
        assert f"LLVM {broken} (karellen-llvm-core) cannot be used: it crashed" in caplog.text

    def test_all_refused_libraries_are_named(self, fresh: pytest.MonkeyPatch, tmp_path: Path) -> None:
        for name in ("libLLVM.so.22.1", "libLLVM.so.19.1"):
            make_library(tmp_path / "system" / name)
        fresh.setattr(llvm, "_probe", lambda path: llvm._Verdict("", "it crashed"))
        with pytest.raises(BackendError, match=r"libLLVM.so.22.1 \(it crashed\); .*libLLVM.so.19.1 \(it crashed\)"):
            load_llvm.__wrapped__()

    def test_pip_library_is_a_real_file(self) -> None:
        assert all(path.is_file() and not path.is_symlink() for path in llvm._pip_libraries())


class TestVerdict:
    """The probe runs when nothing is known of a library."""

    @pytest.fixture
    def probed(self, fresh: pytest.MonkeyPatch) -> list[Path]:
        probed: list[Path] = []

        def probe(path: Path) -> llvm._Verdict:
            probed.append(path)
            return llvm._Verdict("19.1.7", "it crashed" if "bad" in path.name else "")

        fresh.setattr(llvm, "_probe", probe)
        return probed

    def test_good_one_is_remembered_until_the_file_changes(self, probed: list[Path], tmp_path: Path) -> None:
        library = make_library(tmp_path / "libLLVM.so.19.1")
        assert llvm._verdict(library) == llvm._verdict(library) == llvm._Verdict("19.1.7", "")
        assert len(probed) == 1
        os.utime(library, (1, 1))
        llvm._verdict(library)
        assert len(probed) == 2

    def test_bad_one_is_tried_again(self, probed: list[Path], tmp_path: Path) -> None:
        library = make_library(tmp_path / "bad.so")
        llvm._verdict(library)
        llvm._verdict(library)
        assert len(probed) == 2

    @pytest.mark.parametrize("versions", [{"drjit": "1.5.1"}, {"sionna-rt": "2.2.1"}])
    def test_other_versions_are_tried_again(
        self, probed: list[Path], fresh: pytest.MonkeyPatch, tmp_path: Path, versions: dict[str, str]
    ) -> None:
        library = make_library(tmp_path / "libLLVM.so.19.1")
        llvm._verdict(library)
        fresh.setattr(llvm, "_host_version", lambda name: versions.get(name, "same"))
        llvm._verdict(library)
        assert len(probed) == 2

    def test_damaged_cache_is_overwritten(self, probed: list[Path], tmp_path: Path) -> None:
        library = make_library(tmp_path / "libLLVM.so.19.1")
        llvm._verdict(library)
        (cache,) = (tmp_path / "cache").rglob("*.json")
        for damaged in ("{", '{"no": 1}', "[]"):
            cache.write_text(damaged)
            llvm._verdict(library)
        llvm._verdict(library)
        assert len(probed) == 4

    def test_cache_that_cannot_be_written_is_done_without(
        self, probed: list[Path], fresh: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        fresh.setenv("XDG_CACHE_HOME", "/proc/no-such-folder")
        assert not llvm._verdict(make_library(tmp_path / "libLLVM.so.19.1")).fault

    def test_host_that_is_not_installed(self) -> None:
        with pytest.raises(BackendError, match="no-such-host is not installed: run pip install sionna-partial"):
            llvm._host_version("no-such-host")


class TestProbe:
    """What a child process reports of a library."""

    def child(self, monkeypatch: pytest.MonkeyPatch, **answer: object) -> llvm._Verdict:
        result = SimpleNamespace(**({"stdout": "", "stderr": "", "returncode": -6} | answer))
        monkeypatch.setattr(subprocess, "run", lambda *_, **__: result)
        return llvm._probe(Path("libLLVM.so"))

    def test_answer_is_the_last_line(self, monkeypatch: pytest.MonkeyPatch) -> None:
        verdict = self.child(monkeypatch, stdout='chatter\n{"version": "19.1.7", "fault": ""}')
        assert verdict == llvm._Verdict("19.1.7", "")

    def test_abort_is_reported_with_its_reason(self, monkeypatch: pytest.MonkeyPatch) -> None:
        verdict = self.child(monkeypatch, stderr="LLVM ERROR: Cannot select: x\nmore\n")
        assert verdict.fault == "LLVM ERROR: Cannot select: x, exit code -6"
        assert self.child(monkeypatch).fault == "it crashed, exit code -6"

    def test_silence_is_a_fault(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def wait(*_: object, **__: object) -> None:
            raise subprocess.TimeoutExpired("python", 300)

        monkeypatch.setattr(subprocess, "run", wait)
        assert llvm._probe(Path("libLLVM.so")).fault == "no answer within 300 s"

    def test_wrong_paths_are_a_fault(self, monkeypatch: pytest.MonkeyPatch) -> None:
        path = load_llvm().path
        monkeypatch.setattr(llvm_probe, "solved_lengths_m", lambda: [2.0])
        assert llvm_probe.probe(path)[1].startswith("path lengths are [2.0] m instead of")
        monkeypatch.setattr(llvm_probe, "solved_lengths_m", lambda: [2.0, 8.0**0.5])
        assert llvm_probe.probe(path) == (load_llvm().version, "")

    def test_library_of_another_kind_is_a_fault(self) -> None:
        import _ctypes

        version, fault = llvm_probe.probe(Path(_ctypes.__file__))
        assert (version, fault) == ("", "it is no libLLVM, or one of unknown version")
