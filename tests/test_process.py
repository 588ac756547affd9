"""What a process owes others: signals, forks, leftovers of dead processes, caches."""

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import numba
import numpy as np
import pytest

from sionna_partial import llvm
from sionna_partial.errors import BackendError
from sionna_partial.prediction.paper_networks import import_keras
from sionna_partial.process import njit, own_folder, signals_held

COMMAND = "import sys; sys.argv = ['sionna-partial', *sys.argv[1:]]; from sionna_partial.cli import main; "


def python(code: str, *arguments: object, **options: object) -> "subprocess.Popen[str]":
    words = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(words, text=True, stderr=subprocess.PIPE, **options)  # type: ignore[call-overload,no-any-return]


class TestSignals:
    def test_the_command_line_ends_at_once_and_leaves_nothing(self, tmp_path: Path) -> None:
        code = COMMAND + (
            "from sionna_partial.process import own_folder, end_at_signals; from pathlib import Path; import time\n"
            "end_at_signals()\n"
            "with own_folder(Path(sys.argv[1]) / 'new', 'x'):\n    Path(sys.argv[1], 'ready').touch(); time.sleep(600)"
        )
        process = python(code, tmp_path)
        while not (tmp_path / "ready").exists():
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=600.0)
        assert (process.returncode, errors) == (128 + signal.SIGTERM, "interrupted\n")
        assert [path.name for path in tmp_path.iterdir()] == ["ready"]

    def test_an_interrupt_while_the_command_line_is_imported_is_one_line(self) -> None:
        code = (
            "import signal, sys\nclass Press:\n    def find_spec(name, *_):\n"
            "        name == 'typer' and signal.raise_signal(signal.SIGINT)\nsys.meta_path.insert(0, Press)\n" + COMMAND
        )
        process = python(code)
        assert (process.communicate(timeout=600.0)[1], process.returncode) == ("interrupted\n", 130)

    def test_held_signals_come_later(self) -> None:
        done = False
        with pytest.raises(KeyboardInterrupt), signals_held():  # noqa: PT012
            os.kill(os.getpid(), signal.SIGINT)
            done = True
        assert done
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_folders_of_dead_processes_are_removed(tmp_path: Path) -> None:
    code = "import sys, time; from pathlib import Path; from sionna_partial.process import own_folder\n"
    code += "with own_folder(Path(sys.argv[1]), 'left_'):\n    print(flush=True); time.sleep(600)"
    process = python(code, tmp_path, stdout=subprocess.PIPE)
    assert process.stdout
    process.stdout.readline()
    for name, age_s in {"left_other": 1e6, ".new-sionna_partial_a": 1.0, ".new-sionna_partial_b": 100.0}.items():
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    with own_folder(tmp_path, "left_"):
        assert len(list(tmp_path.iterdir())) == 4
    (tmp_path / ".new-sionna_partial_a").rmdir()  # a living process may be about to lock it
    process.kill()
    process.communicate()
    with own_folder(tmp_path, "left_") as mine:
        assert {path.name for path in tmp_path.iterdir()} == {mine.name, "left_other"}
    assert [path.name for path in tmp_path.iterdir()] == ["left_other"]


def refusal(_: object = None) -> str:
    try:
        llvm.load_llvm()
    except BackendError as error:
        return str(error)
    return "accepted"


def test_a_fork_of_a_process_that_has_started_the_libraries_is_refused() -> None:
    llvm.load_llvm()
    context = multiprocessing.get_context("fork")
    reader, writer = context.Pipe()
    child = context.Process(target=lambda: writer.send(refusal()))
    child.start()
    assert reader.poll(30.0)
    assert "multiprocessing.get_context('spawn')" in reader.recv()
    child.join()


def test_a_deleted_working_directory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert refusal() == "the working directory was deleted: change to one that is there (cd)."


def test_another_backend_of_keras_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    keras = import_keras()
    keras.config.set_image_data_format("channels_first")
    try:
        with pytest.raises(BackendError, match="image_data_format = 'channels_first' is not supported: call keras"):
            import_keras()
    finally:
        keras.config.set_image_data_format("channels_last")
    monkeypatch.setenv("KERAS_BACKEND", "jax")
    with pytest.raises(BackendError, match="the backend of Keras is 'jax': set KERAS_BACKEND=tensorflow"):
        import_keras()


def test_compiled_code_is_cached_where_that_can_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from numba import config

    monkeypatch.setattr(config, "CACHE_DIR", "")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    code = compile("def half(x):\n    return x / 2", "/proc/nowhere/half.py", "exec")
    names: dict[str, object] = {}
    exec(code, names)
    assert njit(cache=True)(names["half"])(3.0) == 1.5
    assert not config.CACHE_DIR or Path(config.CACHE_DIR).parent == tmp_path


def test_integers_of_compiled_callers_share_one_compilation() -> None:
    inner = njit()(lambda number: number + 1)
    outer = njit()(lambda narrow: inner(0) + inner(narrow))
    assert (outer(np.int32(3)), len(inner._inner.signatures)) == (5, 1)


def test_cached_code_of_another_version_of_the_package_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its index may name types that have moved, and its code what other modules have been.

    Nor does a call from Python use what compiled callers have cached, which has no wrapper for Python.
    """
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    script = tmp_path / "half.py"
    script.write_text(
        "from sionna_partial.process import njit\n\n\n"
        "@njit(cache=True)\ndef half(x):\n    return x / 2\n\n\n"
        "@njit(cache=True)\ndef quarter(x):\n    return half(x) / 2\n\n\n"
        "print(quarter(2.0), half(3.0), half.stats.cache_hits)\n"
    )
    run = [sys.executable, str(script)]
    outputs = [subprocess.run(run, check=True, capture_output=True, text=True).stdout for _ in range(2)]
    for index in (tmp_path / "__pycache__").glob("*.nbi"):
        index.write_bytes(pickle.dumps(numba.__version__) + b"cpackage_that_is_gone\nThing\n.")
    outputs.append(subprocess.run(run, check=True, capture_output=True, text=True).stdout)
    compiled, cached = "0.5 1.5 Counter()\n", "0.5 1.5 Counter({(float64,): 1})\n"
    assert outputs == [compiled, cached, compiled]
