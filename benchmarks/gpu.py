"""Stock Sionna RT on the device that Mitsuba finds, a graphics card first: time, and agreement with our trace.

The scene of a map and our gains are written to a folder, and stock's solvers run on it: `PathSolver` with all receivers
in one call and in tiles, and `RadioMapSolver`. Our trace runs on the CPU in a process of its own. Run it with

    python benchmarks/gpu.py scenes/house/complete --tx 4.5 11.0 2.0 --out gpu-output

On a CPU choose small numbers: `--spacing 0.6 --depth 3 --rays 10000 --samples 1000000`. A folder from another machine
is used again with `--out gpu-output` alone.
"""

import argparse
import platform
import re
import subprocess
import time
from collections.abc import Callable
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stock import TRUTH_TABLE, isolated, stock_scene

import sionna_partial as sp
from sionna_partial.llvm import load_llvm
from sionna_partial.tracing.stock import MapPlane

VARIANTS = {"cuda": "cuda_ad_mono_polarized", "llvm": "llvm_ad_mono_polarized"}
"""Variants of Mitsuba for Sionna RT, the preferred one first."""

RX_HEIGHT_M = 1.5


def main() -> None:
    """Write the folder if a map is given, run stock's solvers, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", nargs="?", help="complete floor plan; without it, --out has a scene already")
    parser.add_argument("--tx", nargs=3, type=float, help="transmitter [m]; not at the height of the receivers, 1.5 m")
    parser.add_argument("--out", type=Path, default=Path("gpu-output"))
    parser.add_argument("--spacing", type=float, default=0.15, help="of receivers [m]")
    parser.add_argument("--depth", type=int, default=6, help="largest number of reflections")
    parser.add_argument("--tile", type=int, default=100, help="receivers of a tile")
    parser.add_argument("--rays", nargs="*", type=int, default=[100_000, 1_000_000], help="of PathSolver")
    parser.add_argument("--samples", nargs="*", type=int, default=[10**6, 10**8, 10**9], help="of RadioMapSolver")
    arguments = parser.parse_args()
    if arguments.map is not None:
        if arguments.tx is None or abs(arguments.tx[2] - RX_HEIGHT_M) < 0.1:
            parser.error("--tx: give x, y, z; RadioMapSolver misses rays at the height of the receivers, 1.5 m")
        isolated(write, arguments.map, arguments.tx, arguments.out, arguments.spacing, arguments.depth)
    ours = np.load(arguments.out / "ours.npz")
    folder, count, rt = str(arguments.out / "scene"), len(ours["rx"]), sionna_rt()
    print(
        f"{count} receivers, depth {ours['depth']}, reflections only; stock: Sionna RT {metadata.version('sionna-rt')}"
    )
    print(f"on {device()}; ours: {ours['seconds']:.2f} s on {ours['machine']}\n")
    print("| stock | time | links within 0.5 dB | within 3 dB |\n|---|---|---|---|")
    for name, tile in (("one call", count), (f"tiles of {arguments.tile} receivers", arguments.tile)):
        for rays in arguments.rays:
            print_row(
                f"`PathSolver`, {name}, {rays:.0e} rays", ours, partial(solve_paths, rt, folder, ours, tile, rays)
            )
    for samples in arguments.samples:
        print_row(f"`RadioMapSolver`, {samples:.0e} samples", ours, partial(solve_map, rt, folder, ours, samples))


def write(path: str, tx: list[float], out: Path, spacing_m: float, depth: int) -> dict[str, Any]:
    """Write the scene of a map, the receivers, and the gains and time of our trace (the second, warm)."""
    plan, settings = sp.load_map(path), sp.TraceSettings(max_depth=depth, diffraction=False, refraction=False)
    sp.export_scene(plan, out / "scene")
    x0, y0, x1, y1 = plan.bounds_m
    x, y = (np.arange(low + spacing_m / 2, high, spacing_m) for low, high in ((x0, x1), (y0, y1)))
    rows, columns = (index.ravel() for index in np.indices((len(y), len(x))))
    rx = np.column_stack([x[columns], y[rows], np.full(len(rows), RX_HEIGHT_M)])
    kept = (plan.state_at(rx) == sp.CellState.FREE) & (np.linalg.norm(rx - tx, axis=1) > 0.1)
    for _ in range(2):
        start = time.perf_counter()
        links = sp.trace_links(plan, tx, rx[kept], trace_settings=settings)
        seconds = time.perf_counter() - start
    grid = {"x_m": x, "y_m": y, "spacing_m": spacing_m, "row": rows[kept], "column": columns[kept]}
    traced = {"tx": np.array(tx), "rx": rx[kept], "gain_db": links.gain_db, "depth": depth, "seconds": seconds}
    np.savez(out / "ours.npz", machine=cpu(), **grid, **traced)
    return {}


def sionna_rt() -> Any:
    """Import Sionna RT with the first variant of Mitsuba that runs here."""
    load_llvm()
    import drjit as dr
    import mitsuba as mi

    name = "cuda" if dr.has_backend(dr.JitBackend.CUDA) else "llvm"
    mi.set_variant(VARIANTS[name])
    import sionna.rt

    return sionna.rt


def device() -> str:
    """Return the name of the card, or of the processor, that Mitsuba uses."""
    import mitsuba as mi

    if not mi.variant().startswith("cuda"):
        return cpu()
    query = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    return subprocess.run(query, check=True, capture_output=True, text=True).stdout.splitlines()[0]


def cpu() -> str:
    """Return the name of the processor."""
    path = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.*)", path.read_text(encoding="utf-8")) if path.exists() else None
    return found[1] if found else platform.processor()


def solve_paths(rt: Any, folder: str, ours: Any, tile: int, rays: int) -> NDArray[np.float64]:
    """Return the power (N,) of all links by `PathSolver` on tiles of receivers."""
    power = []
    for first in range(0, len(ours["rx"]), tile):
        found = rt.PathSolver()(
            stock_scene(rt, folder, ours["tx"], ours["rx"][first : first + tile]),
            max_depth=int(ours["depth"]),
            refraction=False,
            samples_per_src=rays,
            max_num_paths_per_src=TRUTH_TABLE,
        )
        real, imaginary = (part.numpy().astype(np.float64) for part in found.a)
        power.append((real**2 + imaginary**2).sum(axis=(1, 2, 3, 4)))
    return np.concatenate(power)


def solve_map(rt: Any, folder: str, ours: Any, samples: int) -> NDArray[np.float64]:
    """Return the power (N,) of the cells of the receivers by `RadioMapSolver`."""
    plane = MapPlane(ours["x_m"], ours["y_m"], float(ours["spacing_m"]), RX_HEIGHT_M)
    found = rt.RadioMapSolver()(
        stock_scene(rt, folder, ours["tx"], ours["rx"][:0]),
        **plane.arguments,
        samples_per_tx=samples,
        max_depth=int(ours["depth"]),
        refraction=False,
    )
    return found.path_gain.numpy()[0, ours["row"], ours["column"]].astype(np.float64)


def print_row(name: str, ours: Any, solve: Callable[[], NDArray[np.float64]]) -> None:
    """Print the time of a solver, and the fractions of the links with a path of ours whose gains agree."""
    start = time.perf_counter()
    power = solve()
    seconds = time.perf_counter() - start
    gain_db = 10.0 * np.log10(np.maximum(power, 1e-15))
    apart_db = np.abs(gain_db - ours["gain_db"])[ours["gain_db"] > -150.0]
    print(f"| {name} | {seconds:.1f} s | {np.mean(apart_db <= 0.5):.1%} | {np.mean(apart_db <= 3.0):.1%} |", flush=True)


if __name__ == "__main__":
    main()
