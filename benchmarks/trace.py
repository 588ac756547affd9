"""Our trace compared with stock Sionna RT: time, memory, recall and agreement.

By default ours leaves out weak paths that change no link's power by more than 0.1 dB; "every path" keeps them.
Every measurement runs in a process of its own; stock and ours run on one core, and ours on all cores besides. Truth is
stock Sionna RT in tiles of at most 100 receivers with a hash table of 3e7 entries and 1e6 rays, on a seeded sample of
the receivers. Run it with

    python benchmarks/trace.py
"""

import argparse
import math
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from stock import (
    Paths,
    agreement,
    grid_m,
    isolated,
    limit_cores,
    meant,
    paths_of,
    peak_memory_gb,
    trace_stock,
    true_paths,
)

import sionna_partial as sp
from sionna_partial.resources import demo_homes, scenes_folder
from sionna_partial.scene.scene import build_scene

STOCK_RAYS, STOCK_TABLE = 100_000, 10_000_000
"""Stock on the full grid: few rays, as its time grows with rays x receivers, and a table large for its memory."""


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", nargs="+", default=["house/complete", "house/step100"], help="below scenes/")
    parser.add_argument("--receivers", type=int, default=3000)
    parser.add_argument("--sample", type=int, default=100, help="receivers in the sample for truth")
    parser.add_argument("--reflections-only", action="store_true")
    arguments = parser.parse_args()
    settings = sp.TraceSettings(diffraction=not arguments.reflections_only)
    for name in arguments.maps:
        compare(name, arguments.receivers, arguments.sample, settings)


def compare(name: str, count: int, sample_size: int, settings: sp.TraceSettings) -> None:
    """Print stock full grid, stock tiles and ours side by side for one floor plan."""
    folder, tx = str(scenes_folder() / name), np.array(demo_homes()[name.split("/")[0]]["transmitter"])
    partial = sp.load_map(folder)
    title = f"{name}: {len(build_scene(partial).segments)} walls, diffraction {settings.diffraction}"
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
    rx = grid_m(partial, math.sqrt(free / count), tx[2])
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
    return result | {"paths": paths_of(links)}


if __name__ == "__main__":
    main()
