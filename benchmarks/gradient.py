"""Gradients of the path gain beside finite differences, and what they cost.

Differences are those of the power of fixed paths, as `trace_links` verifies them, at 25 places around each parameter's
value: their slope, and its standard error, come from a polynomial of degree 4. Receivers at which paths of more than
0.1 % of the power appear or vanish between the outermost places are left out; other paths that vanish are left out on
both sides. Sionna RT computes in single precision, so that differences can be unsure by more than 1 % of a small slope:
errors are given as they are, with three standard errors allowed, and for the receivers where the standard error is
below 0.3 % of the slope. Run it with

    python benchmarks/gradient.py
"""

import argparse
import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stock import peak_memory_gb

import sionna_partial as sp
from sionna_partial.resources import demo_homes, scenes_folder
from sionna_partial.tracing.candidates import Candidates
from sionna_partial.tracing.generator import write_scene_of
from sionna_partial.tracing.gradients import path_slopes
from sionna_partial.tracing.solver import Offsets, SceneSolver

REACHES = (0.01, 0.01, 0.025, 0.01, 0.01, 1e-4, 3e7)
"""How far each parameter is moved to either side, in the order of `Offsets`: its own unit."""

SETTINGS = sp.TraceSettings(diffraction=True)

POINTS = 25
DEGREE = 4

LOWERED_M = 0.17
"""Transmitters are lowered: at half the height of a room, and as high as the receivers, derivatives in z are 0 [m]."""


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", nargs="+", default=["apartment"], help="names below scenes/")
    parser.add_argument("--stages", nargs="+", default=["complete", "step100"])
    parser.add_argument("--receivers", type=int, default=500, help="receivers with finite differences")
    parser.add_argument("--spacing", type=float, default=0.15, help="receiver spacing for the cost [m]")
    arguments = parser.parse_args()
    for home in arguments.homes:
        for stage in arguments.stages:
            partial = sp.load_map(scenes_folder() / home / stage)
            tx = np.array(demo_homes()[home]["transmitter"]) - [0.0, 0.0, LOWERED_M]
            grid = receivers(partial, arguments.spacing)
            some = np.sort(
                np.random.default_rng(0).choice(len(grid), min(arguments.receivers, len(grid)), replace=False)
            )
            print(f"\n{home}/{stage}, {len(some)} receivers")
            compare(partial, tx, grid[some])
            cost(partial, tx, grid)


def compare(partial: sp.PartialMap, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> None:
    """Print the errors of the derivatives with respect to each parameter."""
    shift = np.array([*partial.origin_m, 0.0])
    tx, rx = tx - shift, rx - shift
    with tempfile.TemporaryDirectory() as folder:
        base = moved_solver(partial, Path(folder), "", 0.0)
        found = list(paths(base, partial, tx, rx))
        slopes = np.concatenate([path_slopes(base, each, tx, rx) for each in found], axis=1)
        of_rx = np.concatenate([each.rx for each in found])
        print(f"{'':24}{'same':>8}{'<= 1 %':>9}{'or noise':>9}{'where sure':>17}{'median':>10}{'noise':>10}")
        errors = []
        for number, (field, reach) in enumerate(zip(fields(Offsets), REACHES, strict=True)):
            steps = np.linspace(-reach, reach, POINTS)
            power = np.stack([power_at(partial, Path(folder), found, field.name, step, tx, rx) for step in steps])
            kept = (power > 0).all(axis=0)
            exact = sums(of_rx, slopes[number] * kept, len(rx))
            fixed = np.stack([sums(of_rx, row * kept, len(rx)) for row in power])
            errors.append(differences(steps, fixed, exact))
            for row, step in ((fixed[0], -reach), (fixed[-1], reach), (fixed[POINTS // 2], 0.0)):
                traced = 10.0 ** (gain_at(partial, field.name, step, tx + shift, rx + shift) / 10.0)
                errors[-1][:, np.abs(row / traced - 1.0) > 1e-3] = math.nan
            report(field.name, errors[-1], f"{np.isfinite(errors[-1]).all(axis=0).mean() / (exact != 0).mean():.0%}")
        report("x, y, z as one vector", np.sqrt(np.square(errors[:3]).sum(axis=0)), "")


def differences(
    steps: NDArray[np.float64], power: NDArray[np.float64], exact: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Error, size and standard error (3, N) of derivatives, from the power (K, N) at K steps; NaN without paths."""
    power, reach = np.where(power > 0, power, np.nan), steps[-1]
    gain_db, ours = 10.0 * np.log10(power), 10.0 / math.log(10.0) * exact / power[len(steps) // 2]
    matrix = np.vander(steps / reach, DEGREE + 1, increasing=True)
    fit = np.linalg.pinv(matrix) @ gain_db
    rest = ((gain_db - matrix @ fit) ** 2).sum(axis=0) / (len(steps) - DEGREE - 1)
    noise = np.sqrt(rest * np.linalg.inv(matrix.T @ matrix)[1, 1]) / reach
    return np.stack([np.abs(ours - fit[1] / reach), np.abs(fit[1] / reach), noise])


def report(name: str, errors: NDArray[np.float64], kept: str) -> None:
    """Print one line of the table."""
    off, size, noise = errors[:, np.isfinite(errors).all(axis=0)]
    good, sure = off <= 0.01 * size, noise <= 0.003 * size
    print(
        f"{name:24}{kept:>8}{good.mean():>9.1%}{np.mean(off <= 0.01 * size + 3 * noise):>9.1%}"
        f"{good[sure].mean():>9.1%} of {sure.sum():>4}{np.median(off / size):>10.1e}{np.median(noise / size):>10.1e}"
    )


def cost(partial: sp.PartialMap, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> None:
    """Print how long gradients take, as a multiple of the trace, warm."""
    seconds = {}
    for name, function in (("trace", sp.trace_links), ("gradients", sp.gain_gradients)):
        function(partial, tx, rx)
        start = time.perf_counter()
        function(partial, tx, rx)
        seconds[name] = time.perf_counter() - start
    print(
        f"{len(rx)} receivers: trace {seconds['trace']:.2f} s, gradients {seconds['gradients']:.2f} s "
        f"({seconds['gradients'] / seconds['trace']:.1f} times), peak memory of the process "
        f"{peak_memory_gb():.2f} GB"
    )


def receivers(partial: sp.PartialMap, spacing_m: float) -> NDArray[np.float64]:
    """Grid of receivers at 1.5 m, none inside a wall."""
    x0, y0, x1, y1 = partial.bounds_m
    x, y = np.meshgrid(np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m))
    rx = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)])
    return rx[partial.state_at(rx) != sp.CellState.WALL]


def moved_settings(name: str, step: float) -> tuple[sp.TraceSettings, sp.SceneSettings]:
    """Move one parameter by a step."""
    settings, material = SETTINGS, sp.Material()
    if name == "frequency_hz":
        settings = replace(settings, frequency_hz=settings.frequency_hz + step)
    elif hasattr(material, name):
        material = replace(material, **{name: getattr(material, name) + step})
    return settings, sp.SceneSettings(material=material)


def moved_place(name: str, step: float, tx: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move the transmitter by a step if that is the parameter."""
    return tx + step * np.array([name == "x_m", name == "y_m", name == "z_m"])


def gain_at(
    partial: sp.PartialMap, name: str, step: float, tx: NDArray[np.float64], rx: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Path gain [dB] that `trace_links` finds with one parameter moved by a step."""
    settings, scene_settings = moved_settings(name, step)
    place = moved_place(name, step, tx)
    return sp.trace_links(partial, place, rx, settings=settings, scene_settings=scene_settings).gain_db


def moved_solver(partial: sp.PartialMap, folder: Path, name: str, step: float) -> SceneSolver:
    """Write the scene with one parameter moved by a step, and open it."""
    settings, scene_settings = moved_settings(name, step)
    written = write_scene_of(partial, Path(tempfile.mkdtemp(dir=folder)), settings, scene_settings)
    return SceneSolver(written.xml, written.shapes, settings)


def paths(
    solver: SceneSolver, partial: sp.PartialMap, tx: NDArray[np.float64], rx: NDArray[np.float64]
) -> Iterator[Candidates]:
    """Give the candidates that are paths, block by block."""
    with tempfile.TemporaryDirectory() as folder:
        written = write_scene_of(partial, Path(folder), SETTINGS, sp.SceneSettings())
        for candidates, *_ in written.candidates(solver, tx, rx):
            yield candidates.rows(solver.verify_rows(candidates, tx, rx)[1])


def power_at(
    partial: sp.PartialMap,
    folder: Path,
    found: list[Candidates],
    name: str,
    step: float,
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Power of each path with one parameter moved by a step; 0 where it is gone."""
    solver = moved_solver(partial, folder, name, step)
    place, power = moved_place(name, step, tx), []
    for candidates in found:
        solved, rows = solver.verify_rows(candidates, place, rx)
        power.append(np.zeros(len(candidates.rx)))
        power[-1][rows] = np.abs(solved.a) ** 2
    return np.concatenate(power)


def sums(index: NDArray[np.int32], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Add values up by index."""
    return np.bincount(index, weights=values, minlength=count)


if __name__ == "__main__":
    main()
