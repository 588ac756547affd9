"""Time from a map message to the first, coarse grid and to the final one, and memory over many updates.

    .venv/bin/python benchmarks/live.py --updates 1000

prints the table of docs/live.md: the shipped apartment, and a hall of 30 x 15 m that is half seen.

    .venv/bin/python benchmarks/live.py --depot ../shared/slam/depot.yaml

prints every update of a robot with a lidar of 8 m that maps a whole depot.

    .venv/bin/python benchmarks/live.py --growing --frequency 5.2

prints the processor time of a new process on the apartment as it grows, with one thread if OMP_NUM_THREADS and
NUMBA_NUM_THREADS are 1.
"""

import argparse
import resource
import statistics
import time
from pathlib import Path
from types import SimpleNamespace as Fields

import numpy as np
from stock import peak_memory_gb

import sionna_partial as sp
from sionna_partial.apps.live.answers import LiveGrid
from sionna_partial.apps.live.coverage import LiveCoverage
from sionna_partial.apps.live.incoming import LiveSettings
from sionna_partial.constants import CellState

APARTMENT = Path(__file__).resolve().parents[1] / "scenes/apartment"
PERCENT = np.array([0, 100, -1])


def message(partial: sp.PartialMap) -> Fields:
    """Return a map as an OccupancyGrid."""
    ny, nx = partial.shape
    x, y = partial.origin_m
    turn = Fields(x=0.0, y=0.0, z=0.0, w=1.0)
    origin = Fields(position=Fields(x=x, y=y, z=0.0), orientation=turn)
    info = Fields(width=nx, height=ny, resolution=partial.resolution_m, origin=origin)
    return Fields(info=info, data=PERCENT[partial.state].ravel())


def half_seen_hall(fraction: float) -> sp.PartialMap:
    """Return a hall of 30 x 15 m with columns, of which the left part has been seen."""
    state = np.full((300, 600), int(CellState.FREE), dtype=np.uint8)
    state[[0, -1]] = state[:, [0, -1]] = CellState.WALL
    for x in range(60, 600, 60):
        state[100:106, x : x + 6] = state[200:206, x : x + 6] = CellState.WALL
    state[150:153, 120:480] = CellState.WALL
    state[:, int(fraction * 600) :] = CellState.UNKNOWN
    return sp.PartialMap(state, 0.05)


def free_position(partial: sp.PartialMap) -> tuple[float, float, float]:
    """Return a free position in the middle of the free cells."""
    cells = np.argwhere(partial.state == CellState.FREE)
    row, column = cells[np.argmin(np.linalg.norm(cells - cells.mean(axis=0), axis=1))]
    x, y = np.add(partial.origin_m, (np.array([column, row]) + 0.5) * partial.resolution_m)
    return float(x), float(y), 1.5


def latencies(maps: list[sp.PartialMap], rounds: int, spacing_m: float) -> tuple[float, float]:
    """Return the median times to the coarse and the final grid [s], of a warm process."""
    ages: dict[bool, list[float]] = {False: [], True: []}
    tx = free_position(maps[0])
    live = LiveCoverage(tx, lambda grid: ages[grid.is_final].append(grid.age_s), LiveSettings(spacing_m=spacing_m))
    for number in range(rounds * len(maps)):
        live.on_map(message(maps[number % len(maps)]))
        live.step()
    return statistics.median(ages[False][1:]), statistics.median(ages[True][1:])


def memory_mb() -> float:
    """Return the resident memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6


def growth_mb(maps: list[sp.PartialMap], updates: int) -> tuple[float, float]:
    """Return the memory after a fifth of the updates, and after all of them [MB]."""
    live = LiveCoverage(free_position(maps[0]), lambda _: None, LiveSettings(spacing_m=0.6))
    early = 0.0
    for number in range(updates):
        live.on_map(message(maps[number % len(maps)]))
        live.step()
        if number == updates // 5:
            early = memory_mb()
    return early, memory_mb()


def depot_maps(path: Path, steps: range) -> list[sp.PartialMap]:
    """Return the maps of a robot that drives through a map of SLAM, whose unknown cells are taken for walls."""
    known = sp.load_map(path)
    state = np.where(known.state == CellState.UNKNOWN, CellState.WALL, known.state).astype(np.uint8)
    whole = sp.PartialMap(state, known.resolution_m, known.origin_m)
    return sp.explore(whole, steps=[*steps], sensor=sp.SensorSettings(field_of_view_deg=360.0, range_m=8.0))


def drive(maps: list[sp.PartialMap], spacing_m: float, frequency_hz: float) -> None:
    """Print time and memory of every update of a robot that maps a building."""
    grids: list[LiveGrid] = []
    processor_s: list[float] = []

    def publish(grid: LiveGrid) -> None:
        grids.append(grid)
        processor_s.append(time.process_time())

    settings = LiveSettings(spacing_m=spacing_m)
    trace_settings = sp.TraceSettings(frequency_hz)
    live = LiveCoverage(free_position(maps[0]), publish, settings, trace_settings=trace_settings)
    live._warm_up()  # as `run` does before the first map
    print(f"\nprocessor time until the first map: {time.process_time():.1f} s")
    print("\n| map | free [m2] | coarse grid [s] | final grid [s] | processor [s] | memory [GB] |")
    print("|---|---|---|---|---|---|")
    for number, partial in enumerate(maps):
        grids.clear()
        processor_s[:] = [time.process_time()]
        live.on_map(message(partial))
        live.step()
        first_s, final_s = (next(grid.age_s for grid in grids if grid.is_final == final) for final in (False, True))
        free_m2 = float((partial.state == CellState.FREE).sum()) * partial.resolution_m**2
        coarse_s, fine_s = np.diff(processor_s)
        times = f"{first_s:.1f} | {final_s:.1f} | {coarse_s:.1f}, {fine_s:.1f}"
        print(f"| {number} | {free_m2:.1f} | {times} | {memory_mb() / 1e3:.2f} |", flush=True)
    print(f"peak memory: {peak_memory_gb():.2f} GB")


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--spacing", type=float, default=0.15, help="of the receivers of a robot's map [m]")
    parser.add_argument("--depot", type=Path, help="map of SLAM; measures nothing else")
    parser.add_argument("--growing", action="store_true", help="measures the apartment as it grows, and nothing else")
    parser.add_argument("--frequency", type=float, default=28.0, help="of the depot, and of --growing [GHz]")
    given = parser.parse_args()
    apartment = [sp.load_map(APARTMENT / f"step{step:03d}/map.yaml") for step in (50, 100, 150)]
    if given.depot or given.growing:
        maps = depot_maps(given.depot, range(1, 402, 100)) if given.depot else apartment
        drive(maps, given.spacing, given.frequency * 1e9)
        return
    large = [half_seen_hall(fraction) for fraction in (0.5, 0.6, 0.7)]
    print("| map | cells | first grid [s] | final grid [s] |\n|---|---|---|---|")
    for name, maps in (("apartment", apartment), ("hall of 30 x 15 m", large)):
        first_s, final_s = latencies(maps, given.rounds, 0.15)
        ny, nx = maps[0].shape
        print(f"| {name} | {nx} x {ny} | {first_s:.1f} | {final_s:.1f} |", flush=True)
    if given.updates:
        early_mb, late_mb = growth_mb(apartment, given.updates)
        after = f"{early_mb:.0f} MB after {given.updates // 5} updates, {late_mb:.0f} MB after {given.updates}"
        print(f"\nmemory: {after}")


if __name__ == "__main__":
    main()
