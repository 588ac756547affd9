"""Gradients of the predicted mean gain compared with finite differences, and their cost.

On random homes, complete and half explored, the mean gain of `DifferentiableScene` is differentiated with respect to
transmitter, materials and frequency, by TensorFlow through networks, features and Sionna RT. The reference is the slope
of a polynomial of degree 4, and its standard error, through 25 values of the same function around each parameter's
value. On complete maps the prediction is the trace itself; on the others, either predictor's.

Receivers are left out at which paths of more than 0.002 % of the power appear or vanish between the outermost values,
which derivatives do not include; the column "kept" has the fraction of the others. Sionna RT computes in single
precision, so that differences can be inaccurate by more than 1 % of a small slope: fractions of errors below 1 % are
given, and with three standard errors allowed as well. `one_prediction.py` compares slopes with differences of
`LinkModel.predict`. Run it with

    python benchmarks/gradient.py

With --compiling it prints how many kernels a first `gain_gradients` of a process launches and compiles, and how many
more another frequency and another material do; with an empty HOME, Dr.Jit finds none on the disk.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from stock import peak_memory_gb

import sionna_partial as sp
from sionna_partial.differentiable import DifferentiableLinks, DifferentiableScene
from sionna_partial.prediction.paper_networks import import_keras
from sionna_partial.tracing.path_set import PathSet

import_keras()
import tensorflow as tf  # noqa: E402 (after LLVM)

REACHES = {
    "x": 0.003,
    "y": 0.003,
    "z": 0.01,
    "relative_permittivity": 0.01,
    "conductivity_s_m": 0.01,
    "thickness_m": 1e-4,
    "frequency_hz": 3e7,
}
"""Largest step of each parameter to either side, in its own unit."""

POINTS, DEGREE = 25, 4

CHANGE = 2e-5
"""Share of a receiver's power whose coming or going leaves it out: 0.0001 dB within millimetres is a slope."""

Errors = NDArray[np.float64]
"""Error, size and standard error (3, N) of derivatives; NaN where a receiver is left out."""


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[30000, 30001], help="homes")
    parser.add_argument(
        "--steps", type=int, nargs="+", default=[0, 100], help="of the robot; 0 stands for the complete home"
    )
    parser.add_argument("--receivers", type=int, default=60, help="receivers with finite differences")
    parser.add_argument("--spacing", type=float, default=0.3, help="receiver spacing for the cost [m]")
    parser.add_argument("--compiling", action="store_true", help="count compiled kernels instead")
    arguments = parser.parse_args()
    if arguments.compiling:
        count_kernels()
        return
    found: dict[tuple[str, str], list[Errors]] = {}
    for seed in arguments.seeds:
        home = sp.make_home(seed)
        for steps in arguments.steps:
            partial = sp.explore(home, steps=(steps,), seed=seed)[0] if steps else home
            rng = np.random.default_rng(seed)
            tx = place_of(partial, rng)
            grid = receivers(partial, arguments.spacing, tx)
            rx = grid[np.sort(rng.choice(len(grid), min(arguments.receivers, len(grid)), replace=False))]
            for predictor in ("paper", "map") if steps else ("trace",):
                scene = DifferentiableScene(partial, predictor=None if predictor == "trace" else predictor)
                for parameter, errors in compare(scene, tx, rx):
                    found.setdefault((predictor, parameter), []).append(errors)
                cost(scene, tx, grid, f"home {seed}, {steps or 'all'} steps, {predictor}")
    print(f"\n{'':8}{'':24}{'kept':>7}{'<= 1 %':>9}{'or noise':>9}")
    for (predictor, parameter), parts in found.items():
        report(f"{predictor:8}{parameter:24}", np.concatenate(parts, axis=1))


def compare(
    scene: DifferentiableScene, tx: NDArray[np.float64], rx: NDArray[np.float64]
) -> Iterator[tuple[str, Errors]]:
    """Yield the errors of the derivatives with respect to every parameter."""
    paths = scene.simulation.paths(tx, rx)
    links = DifferentiableLinks(scene, paths)
    exact = jacobians(links)
    found: dict[str, Errors] = {}
    for name, width in REACHES.items():
        steps = np.linspace(-width, width, POINTS)
        values = np.stack([links(**{field_of(name): moved(links, name, each)}).gain_mean_db for each in steps])
        found[name] = differences(steps, values, exact[name])
        found[name][:, changes(scene, paths, name, width)] = np.nan
        if exact[name].any():
            yield name, found[name]
    yield "x, y, z as one vector", np.sqrt(sum(found[name] ** 2 for name in "xyz"))


def jacobians(links: DifferentiableLinks) -> dict[str, NDArray[np.float64]]:
    """Differentiate the mean gain with respect to every parameter with TensorFlow: (N,) arrays."""
    values = {field_of(name): tf.Variable(getattr(links.base, field_of(name))) for name in REACHES}
    with tf.GradientTape(persistent=True) as tape:
        gain_db = links(**values).gain_mean_db
    slopes = tape.jacobian(gain_db, values, experimental_use_pfor=False, unconnected_gradients="zero")
    columns = {name: slope.numpy().reshape(len(gain_db), -1) for name, slope in slopes.items()}
    return {name: columns[field_of(name)][:, "xyz".index(name) if name in "xyz" else 0] for name in REACHES}


def field_of(name: str) -> str:
    """Return the argument that a parameter is in."""
    return "tx_m" if name in "xyz" else name


def moved(links: DifferentiableLinks, name: str, step: float) -> NDArray[np.float64]:
    """Return the value of an argument with one parameter moved by a step."""
    direction = np.eye(3)["xyz".index(name)] if name in "xyz" else 1.0
    return getattr(links.base, field_of(name)) + step * direction


def changes(scene: DifferentiableScene, paths: PathSet, name: str, moved_m: float) -> NDArray[np.bool_]:
    """Return whether paths of more than `CHANGE` of a receiver's power appear or vanish within a distance (N,)."""
    changed = np.zeros(len(paths.rx_m), dtype=bool)
    if name not in "xyz":
        return changed  # paths are a matter of geometry
    for step in (-moved_m, moved_m):
        moved = paths.base.tx_m + step * np.eye(3)["xyz".index(name)]
        there = scene.simulation.paths(moved, paths.rx_m)
        kept = paths.at(replace(paths.base, tx_m=moved))[0]
        old = np.bincount(paths.path_rx, weights=paths.power, minlength=len(changed))
        gone = np.bincount(paths.path_rx, weights=paths.power * (kept == 0.0), minlength=len(changed))
        fixed = np.bincount(paths.path_rx, weights=kept, minlength=len(changed))
        new = np.bincount(there.path_rx, weights=there.power, minlength=len(changed))
        changed |= (gone > CHANGE * old) | (np.abs(new - fixed) > CHANGE * np.maximum(old, new))
    return changed


def differences(steps: NDArray[np.float64], values: NDArray[np.float64], exact: NDArray[np.float64]) -> Errors:
    """Error, size and standard error of derivatives, from the values (K, N) at K steps."""
    width = steps[-1]
    matrix = np.vander(steps / width, DEGREE + 1, increasing=True)
    fit = np.linalg.pinv(matrix) @ values
    rest = ((values - matrix @ fit) ** 2).sum(axis=0) / (len(steps) - DEGREE - 1)
    noise = np.sqrt(rest * np.linalg.inv(matrix.T @ matrix)[1, 1]) / width
    return np.stack([np.abs(exact - fit[1] / width), np.abs(fit[1] / width), noise])


def report(name: str, errors: Errors) -> None:
    """Print one line of the table; receivers at which nothing changes with the parameter do not count."""
    kept = np.isfinite(errors).all(axis=0)
    off, size, noise = errors[:, kept & (np.nan_to_num(errors[1]) > 1e-6 * np.nanmax(errors[1]))]
    good, allowed = np.mean(off <= 0.01 * size), np.mean(off <= 0.01 * size + 3 * noise)
    print(f"{name}{kept.mean():>7.1%}{good:>9.1%}{allowed:>9.1%}")


def cost(scene: DifferentiableScene, tx: NDArray[np.float64], rx: NDArray[np.float64], name: str) -> None:
    """Print how long gradients take, as a multiple of the trace, warm."""
    links = scene.links(tx, rx)
    position_m, permittivity = tf.Variable(links.base.tx_m), tf.Variable(links.base.relative_permittivity)

    def gradient(**values: tf.Variable) -> None:
        with tf.GradientTape() as tape:
            loss = tf.reduce_mean(links(**values).gain_mean_db)
        tape.gradient(loss, list(values.values()))

    jobs = {
        "gradient by position": lambda: gradient(tx_m=position_m),
        "by material": lambda: gradient(relative_permittivity=permittivity),
    }
    trace_s = seconds(lambda: sp.trace_links(scene.partial, tx, rx))
    times = ", ".join(f"{job} {seconds(function) / trace_s:.1f}" for job, function in jobs.items())
    print(
        f"{name}, {len(rx)} receivers: trace 1 ({trace_s:.2f} s), {times}; peak {peak_memory_gb():.1f} GB", flush=True
    )


def count_kernels() -> None:
    """Print kernels and processor time of `gain_gradients` on a demo home, for one setting after the other."""
    import drjit as dr

    rx_m = [(6.0, 9.0, 1.5), (8.0, 9.9, 1.3), (5.0, 5.0, 1.2), (7.0, 8.0, 1.0)]
    for frequency_hz, material in ((28e9, "drywall"), (28e9, "drywall"), (27.3e9, "drywall"), (28e9, "brick")):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            start = time.process_time()
            sp.gain_gradients(
                sp.resources.scenes_folder() / "apartment/step100/map.yaml",
                (7.0, 9.8, 1.5),
                rx_m,
                trace_settings=sp.TraceSettings(frequency_hz, max_depth=2),
                scene_settings=sp.SceneSettings(material=sp.Material.named(material)),
            )
            took_s = time.process_time() - start
            kernels = dr.kernel_history([dr.KernelType.JIT])
        new = sum(kernel["cache_disk"] or not kernel["cache_hit"] for kernel in kernels)
        print(f"{frequency_hz / 1e9:g} GHz, {material}: {len(kernels)} launches, {new} compiled, {took_s:.1f} s")


def seconds(function: object) -> float:
    """Return the shorter of two times of a function, after one that compiles [s]."""
    times = []
    for _ in range(3):
        start = time.perf_counter()
        function()  # type: ignore[operator]
        times.append(time.perf_counter() - start)
    return min(times[1:])


def place_of(partial: sp.PartialMap, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a transmitter in a free cell, away from its middle; at half the height of a room slopes in z would be 0."""
    rows, columns = np.nonzero(partial.state == sp.CellState.FREE)
    index = rng.integers(len(rows))
    x, y = np.array(partial.origin_m) + partial.resolution_m * (np.array([columns[index], rows[index]]) + 0.37)
    return np.array([x, y, 1.3])


def receivers(partial: sp.PartialMap, spacing_m: float, tx: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grid of receivers at 1.5 m, none inside a wall or at the transmitter."""
    x0, y0, x1, y1 = partial.bounds_m
    x, y = np.meshgrid(np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m))
    rx = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)])
    return rx[(partial.state_at(rx) != sp.CellState.WALL) & (np.linalg.norm(rx - tx, axis=1) > 0.3)]


if __name__ == "__main__":
    main()
