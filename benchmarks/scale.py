"""Time and memory of `predict_map` on large maps: growth with receivers, with wall segments, and real buildings.

Every measurement runs in a process of its own, on all cores: the first call of the process (cold), and the same again
(warm). Buildings are predicted at 28 and at 5.2 GHz. Exponents of growth are fitted to warm times above one second. Run
it with

    python benchmarks/scale.py --maps ../shared/slam/*.yaml ../shared/floors/*/map.yaml

which takes about an hour on two cores; `--only buildings --maps ../shared/slam/depot.yaml`, for instance, measures one
more map among the buildings. Maps that are not there are skipped.
"""

import argparse
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from stock import isolated, peak_memory_gb

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.scene.scene import build_scene

RECEIVERS = 20_000
"""Number of receivers in a building, about."""

FREQUENCIES_HZ = (28e9, 5.2e9)

_COLUMNS = "map", "GHz", "segments", "receivers", "cold [s]", "warm [s]", "paths for a receiver", "peak memory"
HEAD = f"\n| {' | '.join(_COLUMNS)} |\n|{'---|' * len(_COLUMNS)}"


def main() -> None:
    """Measure, and print a table for each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=["receivers", "segments", "buildings"])
    parser.add_argument("--maps", type=Path, nargs="+", default=[], help="of buildings, or of robots")
    arguments = parser.parse_args()
    only = arguments.only
    if only in (None, "receivers"):
        growth("receivers", [("hall", count) for count in (3_000, 12_000, 50_000, 250_000)])
    if only in (None, "segments"):
        growth("segments", [(f"pillars {side}", 3_000) for side in (10, 20, 35, 50)])
    if only in (None, "buildings"):
        buildings(path for path in arguments.maps if path.exists())


def growth(what: str, cases: list[tuple[str, int]]) -> None:
    """Print time and memory of several cases, and the exponent of the time."""
    print(HEAD)
    sizes, seconds = [], []
    for name, count in cases:
        row = isolated(measure, name, count)
        sizes.append(row[what])
        seconds.append(row["seconds"])
    large = np.array(seconds) > 1.0
    if large.sum() > 1:
        exponent = np.polyfit(np.log(np.array(sizes)[large]), np.log(np.array(seconds)[large]), 1)[0]
        print(f"time grows with {what} to the power {exponent:.2f}")


def buildings(maps: Iterable[Path]) -> None:
    """Print the same for a hall as a robot maps it, complete and half, and for real maps."""
    print(HEAD)
    for name in ("hall", "half hall", *maps):
        for frequency_hz in FREQUENCIES_HZ:
            isolated(measure, str(name), RECEIVERS, frequency_hz)


def measure(name: str, count: int, frequency_hz: float = FREQUENCIES_HZ[0]) -> dict:
    """Predict one map with about so many receivers, cold and warm, and print a row."""
    partial = named_map(name)
    free = np.argwhere(partial.state == CellState.FREE)
    middle = free[len(free) // 2]
    distance = ndimage.distance_transform_edt(partial.state == CellState.FREE)
    near = np.abs(free - middle).sum(axis=1) < 3.0 / partial.resolution_m
    row, column = max(free[near], key=lambda cell: distance[tuple(cell)])
    tx = np.array(partial.origin_m) + (np.array([column, row]) + 0.5) * partial.resolution_m
    known = (partial.state != CellState.WALL).sum() * partial.resolution_m**2
    settings, seconds = sp.TraceSettings(frequency_hz), []
    for _ in range(2):
        start = time.perf_counter()
        coverage = sp.predict_map(partial, tx, spacing_m=np.sqrt(known / count), trace_settings=settings)
        seconds.append(time.perf_counter() - start)
    memory_gb, valid = peak_memory_gb(), coverage["valid"].to_numpy()
    x, y = np.meshgrid(coverage["x"], coverage["y"])
    some = np.column_stack([x[valid], y[valid], np.full(valid.sum(), 1.5)])[:: max(1, int(valid.sum()) // 200)]
    links = sp.trace_links(partial, (*tx, 1.5), some, trace_settings=settings)
    segments, receivers = len(build_scene(partial).segments), int(valid.sum())
    print(
        f"| {name} | {frequency_hz / 1e9:g} | {segments} | {receivers} | {seconds[0]:.1f} | {seconds[1]:.1f} "
        f"| {len(links.a) / len(some):.0f} | {memory_gb:.2f} GB |",
        flush=True,
    )
    return {"segments": segments, "receivers": receivers, "seconds": seconds[1]}


def named_map(name: str) -> sp.PartialMap:
    """Make or read a map."""
    if name.startswith("pillars"):
        return pillars(int(name.split()[1]))
    if name.endswith("hall"):
        return hall(half=name.startswith("half"))
    return sp.load_map(name)


def hall(*, half: bool = False) -> sp.PartialMap:
    """Make a hall of 30 x 15 m with machines and columns as a robot maps it: ragged walls, tilted by 3 degrees."""
    rng, resolution_m = np.random.default_rng(0), 0.05
    free = np.zeros((340, 640), dtype=bool)
    free[20:-20, 20:-20] = True
    y, x = np.mgrid[: free.shape[0], : free.shape[1]]
    for number in range(14):
        angle = rng.uniform(0, np.pi) if number % 2 else 0.0
        u, v = _turned(x - rng.uniform(40, 600), y - rng.uniform(40, 300), angle)
        free &= ~((np.abs(u) < rng.uniform(5, 30)) & (np.abs(v) < rng.uniform(4, 20)))
    for _ in range(12):
        free &= np.hypot(x - rng.uniform(40, 600), y - rng.uniform(40, 300)) > rng.uniform(2, 6)
    inside = ndimage.distance_transform_edt(free) - ndimage.distance_transform_edt(~free)
    noise = ndimage.gaussian_filter(rng.normal(size=free.shape), 1.0)
    ragged = ndimage.rotate(inside + 0.8 * noise / noise.std(), 3.0, order=1, cval=-50.0)
    labels, _ = ndimage.label(ragged > 0)
    room = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    wall = ~room & (ndimage.distance_transform_edt(~room) < 2.5)
    state = np.where(room, CellState.FREE, np.where(wall, CellState.WALL, CellState.UNKNOWN)).astype(np.uint8)
    if half:
        state[:, 2 * state.shape[1] // 3 :] = CellState.UNKNOWN
    return sp.PartialMap(state, resolution_m)


def _turned(x: NDArray[np.float64], y: NDArray[np.float64], angle: float) -> tuple[NDArray, NDArray]:
    return x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)


def pillars(side: int) -> sp.PartialMap:
    """Make a closed field of `side` x `side` pillars of 0.4 m, 2 m apart."""
    state = np.zeros((20 * side + 40, 20 * side + 40), dtype=np.uint8)
    for view in (state, state[::-1], state.T, state.T[::-1]):
        view[:2] = CellState.WALL
    for row in range(side):
        for column in range(side):
            bottom, left = 25 + 20 * row + 3 * (column % 2), 25 + 20 * column + 2 * (row % 3)
            state[bottom : bottom + 4, left : left + 4] = CellState.WALL
    return sp.PartialMap(state, 0.1)


if __name__ == "__main__":
    main()
