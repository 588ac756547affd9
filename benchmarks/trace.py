"""Our trace beside stock Sionna RT: time, memory, recall and agreement, and growth with receivers and walls.

Every measurement runs in a process of its own. Truth is stock Sionna RT in tiles of at most 100 receivers with a hash
table of 3e7 entries and 1e6 rays, on a seeded sample of the receivers. Run it with

    python benchmarks/trace.py --out benchmark-output
"""

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.resources import demo_homes, scenes_folder
from sionna_partial.tracing.scene import build_scene

DEPTH = 6
TILE = 100


def main() -> None:
    """Measure, print the tables, draw the growth curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmark-output"))
    parser.add_argument("--homes", nargs="+", default=["apartment"], help="names below scenes/")
    parser.add_argument("--stages", nargs="+", default=["complete", "step100"])
    parser.add_argument("--spacing", type=float, default=0.15, help="receiver spacing [m]")
    parser.add_argument("--truth-receivers", type=int, default=200, help="receivers in the sample for truth")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for home in arguments.homes:
        for stage in arguments.stages:
            compare(home, stage, arguments.spacing, arguments.truth_receivers)
    draw_growth(arguments.out / "trace_growth.png")


def compare(home: str, stage: str, spacing_m: float, sample_size: int) -> None:
    """Print stock full grid, stock tiles and ours side by side for one map."""
    folder = str(scenes_folder() / home / stage)
    partial, tx = sp.load_map(folder), demo_homes()[home]["transmitter"]
    rx = receivers(partial, spacing_m)
    sample = np.sort(np.random.default_rng(0).choice(len(rx), min(sample_size, len(rx)), replace=False))
    ours = in_process(trace_ours, folder, tx, rx)
    grid = in_process(trace_stock, folder, tx, rx, len(rx), 100_000, 10_000_000)
    tiles = in_process(trace_stock, folder, tx, rx[sample], TILE, 1_000_000, 30_000_000)
    truth = {number: tiles["delays"].get(k, []) for k, number in enumerate(sample)}
    print(
        f"\n{home}/{stage}: {ours['walls']} walls, {len(rx)} receivers, depth {DEPTH}; truth on {len(sample)} receivers"
    )
    print(f"{'':24}{'time [s]':>10}{'memory [GB]':>13}{'recall':>9}{'state':>8}{'gain':>8}")
    for name, result in (("stock, full grid", grid), ("ours, first call", ours), ("ours, warm", ours)):
        seconds = result["cold_s"] if name == "ours, first call" else result["warm_s"]
        state, gain = agreement(result, tiles, sample)
        found = recall(result["delays"], truth)
        print(f"{name:24}{seconds:>10.2f}{result['memory_gb']:>13.2f}{found:>9.4f}{state:>8.3f}{gain:>8.3f}")
    per_grid = tiles["warm_s"] * len(rx) / len(sample)
    print(f"{'stock, tiles (scaled)':24}{per_grid:>10.2f}{tiles['memory_gb']:>13.2f}{1:>9}{1:>8}{1:>8}")
    print(f"ours is {grid['warm_s'] / ours['warm_s']:.0f} times faster than the stock full grid")
    print(f"stock listed {tiles['repeats']} paths of the truth twice; they count once")
    print("recall: share of truth's paths found; state: link state equal; gain: within 0.5 dB (both on the sample)")


def in_process(function: Callable[..., dict], *arguments: object) -> dict:
    """Run a measurement in a fresh process, so that memory and warm-up are its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def receivers(partial: sp.PartialMap, spacing_m: float) -> NDArray[np.float64]:
    """Grid of receivers at 1.5 m, none inside a wall."""
    x0, y0, x1, y1 = partial.bounds_m
    x, y = np.meshgrid(np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m))
    rx = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)])
    return rx[partial.state_at(rx) != sp.CellState.WALL]


def trace_ours(folder: str, tx: list[float], rx: NDArray[np.float64], diffraction: bool = False) -> dict:
    """Time `trace_links`, first call and warm."""
    partial, settings = sp.load_map(folder), sp.TraceSettings(max_depth=DEPTH, diffraction=diffraction)
    seconds = []
    for _ in range(4):
        start = time.perf_counter()
        links = sp.trace_links(partial, tx, rx, settings=settings)
        seconds.append(time.perf_counter() - start)
    return {
        "cold_s": seconds[0],
        "warm_s": float(np.median(seconds[1:])),
        "walls": len(build_scene(partial).segments),
        "delays": group(links.path_rx, links.delay_s),
        "state": links.link_state,
        "gain": links.gain_db,
        "memory_gb": peak_memory_gb(),
    }


def trace_stock(folder: str, tx: list[float], rx: NDArray[np.float64], tile: int, rays: int, table: int) -> dict:
    """Time stock `PathSolver` on tiles of receivers."""
    from sionna_partial.tracing.solver import load_sionna

    rt = load_sionna()
    start = time.perf_counter()
    delays, state, gain, repeats = {}, [], [], 0
    for first in range(0, len(rx), tile):
        part = rx[first : first + tile]
        scene = stock_scene(rt, folder, tx, part)
        paths = rt.PathSolver()(
            scene, max_depth=DEPTH, refraction=False, samples_per_src=rays, max_num_paths_per_src=table
        )
        valid, delay = paths.valid.numpy().reshape(len(part), -1), paths.tau.numpy().reshape(len(part), -1)
        vertices = paths.vertices.numpy().reshape(DEPTH, len(part), -1, 3)
        twice = np.stack([listed_twice(vertices[:, k], valid[k]) for k in range(len(part))])
        repeats += int(twice.sum())
        valid &= ~twice
        power = sum(array.numpy().reshape(len(part), -1).astype(float) ** 2 for array in paths.a)
        direct = (paths.interactions.numpy().reshape(DEPTH, len(part), -1) == 0).all(axis=0)
        delays |= {first + k: delay[k][valid[k]] for k in range(len(part))}
        gain.append(np.maximum(10 * np.log10(np.maximum((power * valid).sum(axis=1), 1e-15)), -150.0))
        state.append(np.where((valid & direct).any(axis=1), 1, np.where(gain[-1] > -150, 2, 0)))
    return {
        "warm_s": time.perf_counter() - start,
        "delays": delays,
        "state": np.concatenate(state),
        "gain": np.concatenate(gain),
        "repeats": repeats,
        "memory_gb": peak_memory_gb(),
    }


def listed_twice(vertices_m: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find the paths (P,) of one receiver that repeat an earlier one: the same reflection points within 1 cm.

    Stock Sionna RT tells paths apart by hashes of rounded planes, and rounding can give one plane two hashes.
    """
    points = vertices_m.transpose(1, 0, 2).reshape(len(valid), -1)
    points = np.where(np.isfinite(points), points, 0.0)
    same = np.abs(points[:, None] - points[None]).max(axis=2) < 0.01
    earlier = np.tri(len(valid), k=-1, dtype=bool)
    return valid & (same & earlier & valid).any(axis=1)


def stock_scene(rt: object, folder: str, tx: list[float], rx: NDArray[np.float64]) -> object:
    """Stock scene with isotropic antennas at the given places."""
    scene = rt.load_scene(f"{folder}/scene.xml")
    scene.frequency = 28e9
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="V"
    )
    scene.add(rt.Transmitter("tx", position=[float(value) for value in tx]))
    for index, position in enumerate(rx):
        scene.add(rt.Receiver(f"rx{index}", position=[float(value) for value in position]))
    return scene


def group(path_rx: NDArray[np.int32], delay_s: NDArray[np.float64]) -> dict[int, NDArray[np.float64]]:
    """Delays of each receiver's paths."""
    start = np.searchsorted(path_rx, np.arange(path_rx.max(initial=-1) + 2))
    return {k: delay_s[start[k] : start[k + 1]] for k in range(len(start) - 1)}


def recall(found: dict[int, NDArray[np.float64]], truth: dict[int, NDArray[np.float64]]) -> float:
    """Share of the true paths whose delay is found at their receiver, each found path counting once."""
    hits = total = 0
    for number, delays in truth.items():
        left = list(np.sort(found.get(number, np.zeros(0))))
        total += len(delays)
        for delay in np.sort(delays):
            match = next((k for k, value in enumerate(left) if abs(value - delay) < 1e-11), None)
            if match is not None:
                del left[match]
                hits += 1
    return hits / max(1, total)


def agreement(result: dict, truth: dict, sample: NDArray[np.intp]) -> tuple[float, float]:
    """Share of the sample with equal link state, and with gain within 0.5 dB."""
    state = np.mean(result["state"][sample] == truth["state"])
    return float(state), float(np.mean(np.abs(result["gain"][sample] - truth["gain"]) <= 0.5))


def peak_memory_gb() -> float:
    """Largest resident memory of this process so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def warehouse(aisles: int) -> sp.PartialMap:
    """Make a hall of 20 m x 3 m an aisle, with racks of different lengths."""
    rng = np.random.default_rng(aisles)
    state = np.zeros((60 * aisles + 2, 402), np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = sp.CellState.WALL
    for aisle in range(aisles):
        for x in range(20, 380, 40):
            y = 60 * aisle + int(rng.integers(10, 30))
            state[y : y + int(rng.integers(6, 24)), x : x + int(rng.integers(6, 24))] = sp.CellState.WALL
    return sp.PartialMap(state, 0.05)


def trace_warehouse(aisles: int, count: int) -> dict:
    """Time a warehouse of many racks with `count` receivers."""
    partial = warehouse(aisles)
    grid = receivers(partial, 0.1)
    rx = grid[np.sort(np.random.default_rng(1).choice(len(grid), min(count, len(grid)), replace=False))]
    with tempfile.TemporaryDirectory() as folder:
        sp.save_map(partial, Path(folder) / "map.yaml")
        return trace_ours(f"{folder}/map.yaml", [0.5, 0.5, 1.5], rx)


def draw_growth(path: Path) -> None:
    """Draw and print the growth of the time with receivers and with walls."""
    by_receivers = [(n, in_process(trace_warehouse, 4, n)) for n in (1000, 3000, 10_000, 25_000)]
    by_walls = [(run["walls"], run) for run in (in_process(trace_warehouse, n, 3000) for n in (2, 4, 10, 20, 40))]
    figure = Figure(figsize=(9, 4), layout="constrained")
    for axes, runs, label in zip(figure.subplots(1, 2), (by_receivers, by_walls), ("receivers", "walls"), strict=True):
        axes.plot([n for n, _ in runs], [run["warm_s"] for _, run in runs], "o-")
        axes.set(xlabel=f"number of {label}", ylabel="warm trace [s]", xlim=(0, None), ylim=(0, None))
        print(json.dumps({label: [(n, round(r["warm_s"], 3), round(r["memory_gb"], 2)) for n, r in runs]}))
    figure.savefig(path, dpi=150)
    print(f"growth curves: {path}")


if __name__ == "__main__":
    main()
