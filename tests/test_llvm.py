"""LLVM is found and loaded so that Dr.Jit, TensorFlow and stock Sionna RT live together, in any order."""

import json
import os
import re
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
ALIVE = """
import tensorflow as tf
links = sp.DifferentiableScene(room, predictor="paper").links((1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)])
tx_m, tape = tf.Variable(links.base.tx_m), tf.GradientTape(persistent=True)
with tape:
    found = links(tx_m=tx_m)
print(tape.gradient(found.gain_mean_db, tx_m).shape)
held = next(links._paths._passes(links.base, ("tx_m",)))
"""


IMPORTS = {
    "ours": "import sionna_partial as sp",
    "sionna": "import sionna.rt",
    "mitsuba": "import drjit, mitsuba; mitsuba.set_variant('llvm_ad_mono_polarized')",
    "tensorflow": "import tensorflow",
}
ORDERS = ("tensorflow ours sionna mitsuba", "mitsuba sionna ours tensorflow")
"""Ours before Dr.Jit, and after it. Dr.Jit between TensorFlow and ours is below."""

STOCK_AND_OURS = """
import tempfile
import numpy as np, sionna.rt as rt
state = np.zeros((20, 40), np.uint8)
state[[0, -1]] = state[:, [0, -1]] = 1
room = sp.PartialMap(state, 0.1)
scene = rt.load_scene(str(sp.export_scene(room, tempfile.mkdtemp()) / "scene.xml"))
scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.add(rt.Transmitter("tx", [1.0, 1.0, 1.5]))
scene.add(rt.Receiver("rx", [3.0, 1.0, 1.5]))
shortest = [rt.PathSolver()(scene, max_depth=1, samples_per_src=1000).tau.numpy().min()]
shortest += [sp.trace_links(room, (1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)]).delay_s.min()]
print([round(299792458.0 * float(delay_s), 3) for delay_s in shortest])
"""
REFUSED = (
    r"sionna_partial\.errors\.BackendError: Dr\.Jit was imported before sionna_partial and runs on {}, which fails: "
    r"put the line `import sionna_partial` before those that import sionna\.rt, mitsuba or drjit\."
)
IN_THE_WAY = r"(no LLVM|LLVM 1[56])"
INTERPOSED = r"(no LLVM|LLVM \d+) with symbols of TensorFlow"
NO_KERAS = {"TF_USE_LEGACY_KERAS": "1"}
"""For `import tensorflow` with all its libraries, but without Keras 3, which takes a third of the time."""


def run(*lines: str, folder: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run lines in a Python of its own, without the DRJIT_LIBLLVM_PATH of this one."""
    base = {name: value for name, value in os.environ.items() if name != llvm.PATH_VARIABLE}
    modules = os.pathsep.join(filter(None, [str(Path(llvm.__file__).parents[1]), base.get("PYTHONPATH")]))
    return subprocess.run(
        [sys.executable, "-c", "\n".join(lines)],
        env=base | {"PYTHONPATH": modules} | environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
    )


def output(done: subprocess.CompletedProcess[str]) -> str:
    """Output of a Python that ended well."""
    assert done.returncode == 0, done.stderr
    return done.stdout


def run_python(*lines: str, folder: Path | None = None, **environment: str) -> str:
    return output(run(START, *lines, folder=folder, **environment))


def require_refusal(done: subprocess.CompletedProcess[str], message: str) -> None:
    """Check that a Python ended in a one-line error before anything else, and did not crash on its way out."""
    assert (done.returncode, done.stdout) == (1, ""), done.stderr
    assert re.fullmatch(message, done.stderr.splitlines()[-1])


@pytest.mark.parametrize("names", ORDERS)
def test_any_order_of_imports_works_or_ends_in_one_line(names: str) -> None:
    """Where it works, TensorFlow and Dr.Jit live on together: Keras trains, Mitsuba raises, a trace is the same.

    The process ends well with derivatives of both alive.
    """
    order = names.split()
    done = run(*(IMPORTS[name] for name in order), STOCK_AND_OURS, TRACE, AND_THEN, TRACE, ALIVE)
    if done.returncode and order.index("mitsuba") < order.index("ours"):
        require_refusal(done, REFUSED.format(IN_THE_WAY))  # not on a machine where Dr.Jit finds an LLVM that works
        return
    both, first, refused, again, shape = output(done).splitlines()
    assert both == "[2.0, 2.0]"
    assert first == again
    assert json.loads(first)[0] == pytest.approx(2.0 / 299792458.0, rel=1e-5)
    assert (refused, shape) == ("mitsuba refused", "(3,)")
    assert "leak" not in done.stderr.lower()


def test_stock_figures_and_preview_import_what_they_show() -> None:
    shown = """
import sys
from sionna_partial.llvm import load_sionna
rt = load_sionna()
print({"ipywidgets", "pythreejs", "matplotlib.pyplot"} & {*sys.modules})
scene = rt.load_scene()
scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
figures = scene.tx_array.antenna_pattern.show()
scene.preview()
import ipywidgets, matplotlib.pyplot as plt
print([type(figure) is plt.Figure for figure in figures], ipywidgets.widgets.__name__, rt.Previewer.__module__)
"""
    before, *_, after = run_python(shown, MPLBACKEND="Agg").splitlines()
    assert before == "set()"
    assert after == "[True, True, True] ipywidgets.widgets sionna.rt.preview"


def test_folder_named_coverage_is_not_the_library_that_numba_looks_for(tmp_path: Path) -> None:
    (tmp_path / "coverage").mkdir()
    assert output(run("import sionna_partial, numba", "print(numba.__name__)", folder=tmp_path)) == "numba\n"


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
        then = "import tensorflow as tf", "print(float(tf.constant(2.5)))"
        answer = output(run("import drjit", START, TRY, TRACE, *then, **NO_KERAS, **{llvm.PATH_VARIABLE: path}))
        assert answer.startswith(f"{llvm.PATH_VARIABLE} {path}\n[")
        assert answer.endswith("]\n2.5\n")

    def test_on_a_library_with_symbols_of_tensorflow_or_none(self) -> None:
        path = str(load_llvm().path)
        done = run("import tensorflow, drjit", START, **NO_KERAS, **{llvm.PATH_VARIABLE: path})
        require_refusal(done, REFUSED.format(INTERPOSED))
        forget = f"import drjit, os; del os.environ['{llvm.PATH_VARIABLE}']"
        require_refusal(run(forget, START, **{llvm.PATH_VARIABLE: "/no/such/libLLVM.so"}), REFUSED.format("no LLVM"))


def test_named_by_the_user_is_taken_as_it_is_set(tmp_path: Path) -> None:
    """Nothing else in its place."""
    import _ctypes

    pipe, text = tmp_path / "libLLVM.so", tmp_path / "libLLVM-99.so"
    os.mkfifo(pipe)
    text.write_bytes(b"not really a library")
    messages = {"/no/such/libLLVM.so": "No such file", "libLLVM-none.so": "No such file", str(pipe): "it is no file"}
    messages |= {str(text): "file too short", _ctypes.__file__: "it is no LLVM of version 17 or newer"}
    messages |= {str(path): "it is no LLVM of version 17 or newer" for path in OLD_LIBRARIES if path.exists()}
    tries = [f"os.environ['{llvm.PATH_VARIABLE}'] = {name!r}{TRY}" for name in messages]
    first = next(iter(messages))
    answers = output(run("import os", START, *tries, **{llvm.PATH_VARIABLE: first})).splitlines()
    for answer, (name, message) in zip(answers, messages.items(), strict=True):
        assert answer.startswith(f"{llvm.PATH_VARIABLE} = '{name}' cannot be used (")
        assert message in answer
        assert f'): unset {llvm.PATH_VARIABLE} and run pip install "karellen-llvm-core>=19.1.7,<24"' in answer


def test_without_any_library(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.delenv(llvm.PATH_VARIABLE, raising=False)
    monkeypatch.setattr(metadata, "distribution", missing)
    with pytest.raises(BackendError, match=r'^No LLVM library is installed: run pip install "karellen-llvm-core>='):
        llvm._loaded_library.__wrapped__()


def test_a_postponed_module_is_there_for_other_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """They import it, and call what is in it, while Sionna RT is being imported."""
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    with llvm._postponed("colorsys"):
        import colorsys

        hue_of = colorsys.rgb_to_hsv
        assert isinstance(colorsys, llvm._Postponed)
        assert hue_of(1.0, 0.0, 0.0) == (0.0, 1.0, 1.0)
    assert sys.modules["colorsys"].rgb_to_hsv is colorsys.rgb_to_hsv
