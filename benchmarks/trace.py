"""Our trace compared with stock Sionna RT: time, memory, recall and agreement, and growth with receivers and walls.

By default ours leaves out weak paths that change no link's power by more than 0.1 dB; "every path" keeps them.
Every measurement runs in a process of its own; stock and ours run on one core, and ours on all cores besides. Truth is
stock Sionna RT in tiles of at most 100 receivers with a hash table of 3e7 entries and 1e6 rays, on a seeded sample of
the receivers. Run it with

    python benchmarks/trace.py --out benchmark-output

which takes half an hour on two cores; `--only growth`, for instance, runs one part.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from agreement import agreement, meant, paths_of
from matplotlib.figure import Figure
from numpy.typing import NDArray
from stock import Paths, isolated, limit_cores, peak_memory_gb, trace_stock, true_paths

import sionna_partial as sp
from sionna_partial.resources import demo_homes, scenes_folder
from sionna_partial.scene.scene import build_scene

STOCK_RAYS, STOCK_TABLE = 100_000, 10_000_000
"""Stock on the full grid: few rays, as its time grows with rays x receivers, and a table large for its memory."""


def main() -> None:
    """Measure, print the tables, draw the growth curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmark-output"))
    parser.add_argument("--maps", nargs="+", default=["house/complete", "house/step100"], help="below scenes/")
    parser.add_argument("--receivers", type=int, default=3000)
    parser.add_argument("--sample", type=int, default=100, help="receivers in the sample for truth")
    parser.add_argument("--only", choices=["reflections", "diffraction", "mesh", "predict", "first", "growth"])
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.maps:
        for kind in ("reflections", "diffraction"):
            if arguments.only in (None, kind):
                compare(name, arguments.receivers, arguments.sample, diffraction=kind == "diffraction")
        if arguments.only in (None, "mesh"):
            compare_mesh(name, arguments.receivers, arguments.sample)
        if arguments.only in (None, "predict"):
            time_prediction(name)
    if arguments.only in (None, "first"):
        time_first_call(arguments.maps[0])
    if arguments.only in (None, "growth"):
        draw_growth(arguments.out / "trace_growth.png")


def compare(name: str, count: int, sample_size: int, *, diffraction: bool) -> None:
    """Print stock full grid, stock tiles and ours side by side for one floor plan."""
    folder, tx = str(scenes_folder() / name), np.array(demo_homes()[name.split("/")[0]]["transmitter"])
    partial = sp.load_map(folder)
    walls = len(build_scene(partial).segments)
    kind = "one diffraction and reflections" if diffraction else "reflections"
    settings = sp.TraceSettings(diffraction=diffraction)
    _compare(f"{name}: {walls} walls, {kind}", folder, partial, tx, count, sample_size, settings)


def compare_mesh(name: str, count: int, sample_size: int) -> None:
    """Print the same for the scene of a floor plan that is traced as a mesh, like a scan."""
    tx = np.array(demo_homes()[name.split("/")[0]]["transmitter"])
    with tempfile.TemporaryDirectory() as folder:
        parts = [trimesh.load(path, force="mesh") for path in sorted((scenes_folder() / name / "meshes").glob("*.ply"))]
        trimesh.util.concatenate(parts).export(f"{folder}/scan.ply")
        partial = sp.load_map(f"{folder}/scan.ply")
        sp.export_scene(partial, f"{folder}/scan")
        faces = len(partial.mesh.triangles)
        settings = sp.TraceSettings(diffraction=False)
        _compare(f"{name} as a mesh: {faces} triangles", f"{folder}/scan", partial, tx, count, sample_size, settings)


def _compare(
    title: str,
    folder: str,
    partial: sp.PartialMap,
    tx: NDArray[np.float64],
    count: int,
    sample_size: int,
    settings: sp.TraceSettings,
) -> None:
    rx = receivers(partial, tx, count)
    sample = np.sort(np.random.default_rng(0).choice(len(rx), min(sample_size, len(rx)), replace=False))
    options = {"max_depth": settings.max_depth, "diffraction": settings.diffraction}
    runs = {"ours, all cores": isolated(trace_ours, folder, tx, rx, settings)}
    runs["ours"] = isolated(trace_ours, folder, tx, rx, settings, cores=1)
    every = replace(settings, power_tolerance_db=0.0)
    runs["ours, every path"] = isolated(trace_ours, folder, tx, rx, every, cores=1)
    runs["stock, all at once"] = isolated(
        trace_stock, folder, tx, rx, tile=len(rx), rays=STOCK_RAYS, table=STOCK_TABLE, cores=1, **options
    )
    tiles = isolated(true_paths, folder, tx, rx[sample], **options)

    def comparable(paths: list[Paths]) -> list[Paths]:
        return meant(partial, tx, rx[sample], paths) if settings.diffraction else paths

    truth = comparable(tiles["paths"])
    print(f"\n{title}, {len(rx)} receivers, depth {settings.max_depth}; truth on {len(sample)} of them")
    print(f"{'':20}{'time [s]':>10}{'first [s]':>11}{'memory [GB]':>13}{'recall':>9}{'state':>8}{'gain':>8}")
    scaled = tiles["seconds"] * len(rx) / len(sample)
    print(
        f"{'stock, tiles':20}{scaled:>10.2f}{'':>11}{tiles['memory_gb']:>13.2f}  (truth; time scaled to all receivers)"
    )
    for label in ("stock, all at once", "ours", "ours, every path", "ours, all cores"):
        run = runs[label]
        found = comparable([run["paths"][k] for k in sample])
        match = agreement(partial, tx, rx[sample], found, truth)
        fractions = (
            match["found"] / match["truth"],
            *(match[key] / match["links"] for key in ("same_state", "same_gain")),
        )
        first = f"{run['first_s']:>11.2f}" if "first_s" in run else f"{'':>11}"
        numbers = "".join(f"{fraction:>{width}.4f}" for fraction, width in zip(fractions, (9, 8, 8), strict=True))
        print(f"{label:20}{run['seconds']:>10.2f}{first}{run['memory_gb']:>13.2f}{numbers}")
    print(
        f"on one core, ours is {runs['stock, all at once']['seconds'] / runs['ours']['seconds']:.0f} times faster;",
        end=" ",
    )
    print(
        f"truth: {match['truth']} paths, and {tiles['repeats']} listed twice, {match['leaks']} through a wall; ours has"
    )
    print(f"{match['extra']} more, of which {match['real']} are confirmed to cross nothing", flush=True)


def receivers(partial: sp.PartialMap, tx: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """About `count` receivers at the height of the transmitter on a square grid, none within 1 cm of a wall."""
    free = (partial.state == sp.CellState.FREE).sum() * partial.resolution_m**2
    spacing_m = math.sqrt(free / count)
    x0, y0, x1, y1 = partial.bounds_m
    x, y = np.meshgrid(np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m))
    rx = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, tx[2])])
    for dx, dy in ((0.01, 0.01), (0.01, -0.01), (-0.01, 0.01), (-0.01, -0.01)):
        rx = rx[partial.state_at(rx[:, :2] + (dx, dy)) == sp.CellState.FREE]
    return rx


def trace_ours(
    folder: str,
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    settings: sp.TraceSettings,
    *,
    cores: int | None = None,
) -> dict:
    """Time `trace_links`, first call and warm (median of three)."""
    limit_cores(cores)
    partial, seconds = sp.load_map(folder), []
    for _ in range(4):
        start = time.perf_counter()
        links = sp.trace_links(partial, tx, rx, trace_settings=settings)
        seconds.append(time.perf_counter() - start)
    memory_gb = peak_memory_gb()
    result = {"first_s": seconds[0], "seconds": float(np.median(seconds[1:])), "memory_gb": memory_gb}
    return result | {"paths": paths_of(links), "walls": len(build_scene(partial).segments)}


def time_prediction(name: str) -> None:
    """Print the time of a coverage map over that of the trace in it, both warm."""
    ratio = isolated(_prediction_ratio, str(scenes_folder() / name), demo_homes()[name.split("/")[0]]["transmitter"])
    print(f"\n{name}: predict_map with {ratio['receivers']} receivers costs {ratio['ratio']:.2f} times its trace, warm")


def _prediction_ratio(folder: str, tx: list[float]) -> dict:
    partial, model, traces, maps = sp.load_map(folder), sp.Predictor.load(), [], []
    coverage = sp.predict_map(partial, tx, predictor=model)
    y, x = np.nonzero(coverage["valid"].to_numpy())
    rx = np.column_stack([coverage["x"][x], coverage["y"][y], np.full(len(x), 1.5)])
    for _ in range(3):
        start = time.perf_counter()
        sp.trace_links(partial, tx, rx)
        middle = time.perf_counter()
        sp.predict_map(partial, tx, predictor=model)
        traces.append(middle - start)
        maps.append(time.perf_counter() - middle)
    return {"receivers": len(rx), "ratio": float(np.median(maps) / np.median(traces))}


def time_first_call(name: str) -> None:
    """Print how long the first call of a process takes, right after an installation and later."""
    tx = demo_homes()[name.split("/")[0]]["transmitter"]
    code = (
        "import time; start = time.perf_counter(); import sionna_partial as sp;"
        f"sp.trace_links({str(scenes_folder() / name)!r}, {tx}, [{[tx[0] + 0.5, tx[1], tx[2]]}]);"
        "print(time.perf_counter() - start)"
    )
    with tempfile.TemporaryDirectory() as empty:
        environment = os.environ | {"HOME": empty, "NUMBA_CACHE_DIR": f"{empty}/numba"}
        seconds = [
            float(subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True).stdout)
            for _ in range(2)
        ]
    print(f"\nfirst call: {seconds[0]:.1f} s with nothing compiled, {seconds[1]:.1f} s in any later process")


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
    """Time a warehouse of many racks with about `count` receivers, reflections only."""
    partial, tx = warehouse(aisles), np.array([0.5, 0.5, 1.5])
    with tempfile.TemporaryDirectory() as folder:
        sp.save_map(partial, f"{folder}/map.npz")
        rx = receivers(partial, tx, count)
        run = trace_ours(f"{folder}/map.npz", tx, rx, sp.TraceSettings(diffraction=False))
    return {"receivers": len(rx), **{name: run[name] for name in ("walls", "seconds", "memory_gb")}}


def draw_growth(path: Path) -> None:
    """Draw and print the growth of the time with receivers and with walls."""
    by_receivers = [isolated(trace_warehouse, 4, count) for count in (1000, 3000, 10_000, 25_000)]
    by_walls = [isolated(trace_warehouse, aisles, 3000) for aisles in (2, 4, 10, 20, 40)]
    figure = Figure(figsize=(9, 4), layout="constrained")
    for axes, runs, name in zip(figure.subplots(1, 2), (by_receivers, by_walls), ("receivers", "walls"), strict=True):
        axes.plot([run[name] for run in runs], [run["seconds"] for run in runs], "o-")
        axes.set(xlabel=f"number of {name}", ylabel="warm trace [s]", xlim=(0, None), ylim=(0, None))
        rows = [(run[name], round(run["seconds"], 3), round(run["memory_gb"], 2)) for run in runs]
        print(f"\n{name}, time [s], memory [GB]: {json.dumps(rows)}")
    figure.savefig(path, dpi=150)
    print(f"growth curves: {path}")


if __name__ == "__main__":
    main()
