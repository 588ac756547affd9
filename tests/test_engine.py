"""The engine: its verdict depends on a candidate alone, nothing is compiled twice, and Sionna RT is the tested one."""

import dataclasses
import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from extruded import ROOM, diffracted_blocks, extrude, specular_blocks
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.llvm import MITSUBA_VARIANT
from sionna_partial.scene.scene import SceneGeometry, build_scene, write_scene
from sionna_partial.tracing import engine
from sionna_partial.tracing.engine import SceneSolver, engine_fault
from sionna_partial.tracing.path_set import PARAMETERS
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.plan.edges import find_wedges

SHAPES = ("walls", "floor", "ceiling")
TX = np.array([1.07, 1.93, 1.2])
RX = np.array([[2.3, 3.1, 2.1], [4.7, 1.2, 0.4], [5.2, 3.4, 1.9], [4.1, 0.3, 1.1]])


def _solver(geometry: SceneGeometry, folder: Path) -> SceneSolver:
    xml = write_scene(geometry, folder, offset_m=geometry.origin_m)
    return SceneSolver(xml, geometry.shapes, sp.TraceSettings())


def _specular(geometry: SceneGeometry, tx: NDArray[np.float64], rx: NDArray[np.float64], depth: int) -> Candidates:
    return specular_blocks(geometry, tx, rx, depth)[0][0]


def _diffracted(geometry: SceneGeometry, tx: NDArray[np.float64], rx: NDArray[np.float64], depth: int) -> Candidates:
    return diffracted_blocks(geometry, find_wedges(geometry, open_ends=False), tx, rx, depth)[0][0]


class TestVerify:
    def test_order_of_candidates_changes_no_verdict(self, tmp_path: Path) -> None:
        """Embree loses hits of rays that are called coherent and are not."""
        home = sp.make_home(9)
        geometry = build_scene(home)
        free = (np.argwhere(home.state == CellState.FREE)[::80, ::-1] + 0.5) * home.resolution_m
        positions = np.column_stack([free, np.full(len(free), 1.5)])
        tx, rx = positions[len(positions) // 2], np.delete(positions, len(positions) // 2, axis=0)
        candidates = _specular(geometry, tx, rx, 6)
        solver = _solver(geometry, tmp_path)
        order = np.random.default_rng(0).permutation(len(candidates.rx))
        shuffled = candidates.rows(order)
        counts = [
            np.bincount(solver.verify(each, tx, rx)[0].path_rx, minlength=len(rx)) for each in (candidates, shuffled)
        ]
        np.testing.assert_array_equal(*counts)

    @pytest.mark.parametrize("missing", [("ceiling",), ("walls",), SHAPES])
    def test_shapes_that_the_scene_lacks_count_no_faces(self, missing: tuple[str, ...], tmp_path: Path) -> None:
        walls = np.zeros((0, 2, 2)) if "walls" in missing else ROOM[:4]
        floor_m = () if "floor" in missing else ((0, 0, 6, 4),)
        geometry = extrude(walls, floor_m=floor_m, ceiling="ceiling" not in missing)
        rx = np.array([[4.9, 3.1, 1.7]])
        candidates = _specular(geometry, TX, rx, 1)
        solver = _solver(geometry, tmp_path)
        paths = solver.verify(candidates, TX, rx)[0]
        assert len(solver.verify(candidates.rows(np.zeros(0, np.intp)), TX, rx)[0].a) == 0
        expected = 1 + 4 * ("walls" not in missing) + ("floor" not in missing) + (not missing or missing == ("walls",))
        assert len(paths.a) == len(candidates.rx) == expected

    def test_materials_of_other_scenes_are_left_out(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Dr.Jit calls the materials of all scenes that there are, which takes time for each."""
        geometry = extrude(ROOM)
        solvers = [_solver(geometry, tmp_path) for _ in range(2)]
        from sionna.rt import RadioMaterial  # after LLVM

        matrix, evaluated = RadioMaterial._specular_reflection_transmission_matrix, []

        def evaluate(material, *arguments):
            evaluated.append(material.scene)
            return matrix(material, *arguments)

        monkeypatch.setattr(RadioMaterial, "_specular_reflection_transmission_matrix", evaluate)
        candidates = _specular(geometry, TX, RX, 2)
        for solver in solvers:
            paths, _ = solver.verify(candidates, TX, RX)
            assert evaluated
            assert all(scene is solver._scene for scene in evaluated)
            evaluated.clear()
        others, _ = solvers[0].verify(candidates, TX, RX)
        np.testing.assert_array_equal(others.transfer, paths.transfer)


class TestCompiling:
    @pytest.mark.parametrize("make", [_specular, _diffracted], ids=["specular", "diffracted"])
    def test_nothing_is_compiled_twice(self, make, tmp_path: Path) -> None:
        """Other receivers, other numbers of candidates and arrays elsewhere in memory: the kernels are there."""
        geometry = extrude(ROOM)
        solver = _solver(geometry, tmp_path)
        import drjit as dr  # after LLVM

        candidates = make(geometry, TX, RX, 2)
        solver.verify(candidates, TX, RX)[0]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            for skip in range(1, 8):
                fewer = _elsewhere(candidates, skip).rows(np.arange(skip, len(candidates.rx)))
                solver.verify(fewer, TX + 0.01 * skip, RX)[0]
            launched, compiled = _launched_and_compiled()
        assert launched >= 7
        assert compiled == 0

    @pytest.mark.parametrize("derived", [[], ["thickness_m", "frequency_hz"]], ids=["traces", "derivatives"])
    def test_other_scenes_are_not_compiled(self, derived: list[str]) -> None:
        """In a process of its own: kernels depend on kinds of materials that other tests have left.

        Kernels that other processes left on the disk count as well.
        """
        done = subprocess.run([sys.executable, "-c", SCENES, *derived], capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        launched, compiled = map(int, done.stdout.split())
        assert launched >= 30
        assert compiled == 0

    def test_further_variables_are_not_compiled(self) -> None:
        """Derivatives by x, y and z have the same kernels; those by materials and frequency too."""
        cells = np.pad(np.full((10, 14), CellState.FREE), 1, constant_values=CellState.WALL)
        settings = sp.TraceSettings(max_depth=1, diffraction=False, refraction=False)
        simulation = sp.Simulation(sp.map_from_array(cells, resolution_m=0.4), settings)
        import drjit as dr  # after LLVM

        paths, compiled = simulation.paths((2.0, 2.2, 1.4), [(1.0, 1.0, 1.5)]), []
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            for _, name, entry, slopes in paths._passes(paths.base, PARAMETERS):
                dr.eval(slopes)
                launched, new = _launched_and_compiled()
                assert launched
                if new and (entry or name in PARAMETERS[2:]):
                    compiled.append(name)
        assert compiled == []


def _launched_and_compiled() -> tuple[int, int]:
    """Numbers of kernels since the last call that were launched, and of those that this process did not have."""
    import drjit as dr

    kernels = dr.kernel_history([dr.KernelType.JIT])
    return len(kernels), sum(kernel["cache_disk"] or not kernel["cache_hit"] for kernel in kernels)


def _elsewhere(candidates: Candidates, skip: int) -> Candidates:
    """Copy candidates to addresses that are off by `skip` of their numbers."""
    moved = {}
    for name in ("rx", "kind", "face", "vertices_m"):
        values = getattr(candidates, name)
        moved[name] = np.concatenate([np.zeros(skip, values.dtype), values.ravel()])[skip:].reshape(values.shape)
    return dataclasses.replace(candidates, **moved)


SCENES = """
import sys
import numpy as np
import sionna_partial as sp

cells = np.ones((12, 16), np.uint8)
cells[1:-1, 1:-1] = sp.CellState.FREE
room, rx, alive = sp.map_from_array(cells, resolution_m=0.4), [(1.0, 1.0, 1.5), (4.1, 3.3, 1.1)], []

def solve(material, frequency_hz):
    settings = sp.TraceSettings(frequency_hz, max_depth=1, diffraction=False, refraction=False)
    alive.append(sp.Simulation(room, trace_settings=settings, scene_settings=sp.SceneSettings(material=material)))
    paths = alive[-1].paths((2.0, 2.2, 1.4), rx)
    paths.slopes(paths.base, sys.argv[1:])

solve(sp.Material(itu="brick"), 28e9)
import drjit as dr
with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
    dr.kernel_history_clear()
    solve(sp.Material(itu="brick"), 27.3e9)
    solve(sp.Material(itu="wood"), 7.7e9)
    solve(sp.Material(5.0, 0.5, conductivity_exponent=0.77), 28e9)
    kernels = dr.kernel_history([dr.KernelType.JIT])
print(len(kernels), sum(kernel["cache_disk"] or not kernel["cache_hit"] for kernel in kernels))
"""
"""Scenes at other frequencies and of all kinds of materials, alive together."""

WITH_VARIANT = """
from sionna_partial.errors import BackendError
from sionna_partial.llvm import load_llvm
from sionna_partial.tracing.engine import load_sionna
load_llvm()
import mitsuba
mitsuba.set_variant('scalar_rgb')
try:
    load_sionna()
except BackendError as error:
    print(error)
"""


def test_variant_of_someone_else_is_refused() -> None:
    """In a process of its own, where someone else set the variant."""
    command = [sys.executable, "-c", WITH_VARIANT]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    remedy = f"call mitsuba.set_variant('{MITSUBA_VARIANT}') before the first trace, or import sionna_partial in a"
    expected = f"mitsuba variant = 'scalar_rgb' is not supported: {remedy} process of its own."
    assert done.stdout.strip() == expected


class TestEngineFault:
    @pytest.fixture(autouse=True)
    def _fresh_process(self) -> Iterator[None]:
        engine_fault.cache_clear()
        yield
        engine_fault.cache_clear()

    def test_other_release_or_missing_field_is_named(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr(engine, "TESTED_VERSION", "2.1")
        with caplog.at_level(logging.WARNING):
            faults = {engine_fault() for _ in range(3)}
        assert len(faults) == len(caplog.records) == 1
        assert "is not of the release 2.1, for which the fast engine was made. Its public path solver" in caplog.text
        assert 'run pip install "sionna-rt==2.2.*"' in caplog.text
        monkeypatch.undo()
        engine_fault.cache_clear()
        monkeypatch.setattr(engine, "_BUFFER_FIELDS", engine._BUFFER_FIELDS | {"_a_new_one"})
        assert engine_fault().endswith("has no PathsBuffer._a_new_one, which the fast engine fills")
