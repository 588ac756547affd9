"""Outlines of wall cells: their number on noisy maps, leaks of partly observed walls, time.

- Segments: number of outline segments per metre of outline, on maps with noise and on maps of the same buildings
  without.
- Leaks: links that cross a wall of the complete map where the partial map has a wall cell within two cells, but cross
  no outline of the partial map; those of them where the wall was observed on both sides of the crossing, within eight
  cells; and the opposite, links that cross an outline of the partial map only.
- Time: of a floor of 2650 x 880 cells.

FOLDER holds floors, one folder with a map.yaml for each. Run it with

    python benchmarks/outlines.py --floors ../shared/floors
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.scene.outlines import wall_outlines

FIRST_SEED = 60_000
STEPS = (50, 100, 150, 200)
FLOOR_STEPS = (50, 150, 400)
LIDAR = {"field_of_view_deg": 360.0, "range_m": 12.0}
NOISES = {
    "lidar, noise 2 cm, drift 1 %, 5 % missed": {
        "range_noise_m": 0.02,
        "drift_m_per_m": 0.01,
        "missed_wall_fraction": 0.05,
    },
    "lidar, noise 5 cm, drift 1 %, 5 % missed": {
        "range_noise_m": 0.05,
        "drift_m_per_m": 0.01,
        "missed_wall_fraction": 0.05,
    },
}
LINKS = 2000
NEAR_CELLS = 2.0
SIDE_CELLS = 8
LARGE = (880, 2650)


@dataclass(frozen=True)
class Leaks:
    """Numbers of links."""

    links: int
    blocked: int
    leaks: int
    leaks_between: int
    false_blocks: int


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--floors", type=Path, metavar="FOLDER", default=Path("../shared/floors"))
    parser.add_argument("--homes", type=int, default=6)
    parser.add_argument("--only", choices=["segments", "leaks", "time"])
    arguments = parser.parse_args()
    floors = [sp.load_map(path) for path in sorted(arguments.floors.glob("*/map.yaml"))]
    homes = [sp.make_home(FIRST_SEED + index) for index in range(arguments.homes)]
    if arguments.only in (None, "segments"):
        print_segments(homes, floors)
    if arguments.only in (None, "leaks"):
        print_leaks(homes, floors)
    if arguments.only in (None, "time") and floors:
        print_time(floors)


def print_segments(homes: list[sp.PartialMap], floors: list[sp.PartialMap]) -> None:
    """Segments per metre of outline, with noise and without."""
    print("| maps | noise | clean [1/m] | noisy [1/m] | ratio |\n|---|---|---|---|---|")
    for kind, buildings in (("homes", homes), ("floors", floors[::3])):
        for name, cleans, noisies in noise_cases(buildings):
            clean, noisy = segments_per_m(cleans), segments_per_m(noisies)
            print(f"| {kind} | {name} | {clean:.3f} | {noisy:.3f} | {noisy / clean:.2f} |", flush=True)


def noise_cases(buildings: list[sp.PartialMap]) -> Iterator[tuple[str, list[sp.PartialMap], list[sp.PartialMap]]]:
    """Names, maps without and maps with noise."""
    for fraction in (0.05, 0.15, 0.3):
        noisy = [ragged(building, fraction, seed) for seed, building in enumerate(buildings)]
        yield f"{fraction:.0%} of face cells lost, as many added", buildings, noisy
    exact = [explored(building, **LIDAR) for building in buildings]
    for name, errors in NOISES.items():
        yield name, exact, [explored(building, **LIDAR, **errors) for building in buildings]


def ragged(building: sp.PartialMap, fraction: float, seed: int) -> sp.PartialMap:
    """Take cells off the faces of walls, and put as many on."""
    rng = np.random.default_rng(seed)
    wall = building.state == CellState.WALL
    face = wall & ndimage.binary_dilation(building.state == CellState.FREE)
    inside = ndimage.binary_opening(wall, structure=np.ones((2, 2)))
    state = building.state.copy()
    state[face & inside & (rng.random(wall.shape) < fraction)] = CellState.FREE
    state[ndimage.binary_dilation(wall) & ~wall & (rng.random(wall.shape) < fraction)] = CellState.WALL
    return sp.PartialMap(state, building.resolution_m)


def explored(building: sp.PartialMap, **sensor: float) -> sp.PartialMap:
    """Send a robot around."""
    return sp.explore(building, (200,), 0, sensor=sp.SensorSettings(**sensor))[0]


def segments_per_m(maps: list[sp.PartialMap]) -> float:
    """Divide the number of segments by their length."""
    outlines = [wall_outlines(each) for each in maps]
    lengths_m = [np.linalg.norm(np.diff(each.vertices_m[each.segments], axis=1), axis=2).sum() for each in outlines]
    return float(sum(len(each.segments) for each in outlines) / sum(lengths_m))


def print_leaks(homes: list[sp.PartialMap], floors: list[sp.PartialMap]) -> None:
    """Leaks and the opposite error."""
    lidar = sp.SensorSettings(**LIDAR)
    print("| maps | steps | links | behind observed walls | leaks | between observed cells | partial map only |")
    print("|---|---|---|---|---|---|---|")
    cases = (
        ("homes", homes, STEPS, None),
        ("floors, lidar", floors[::3], FLOOR_STEPS, lidar),
        ("floors", floors[::3], FLOOR_STEPS, None),
    )
    for kind, buildings, steps, sensor in cases:
        maps = [sp.explore(building, steps, 0, sensor=sensor) for building in buildings]
        for stage, count in enumerate(steps):
            found = [astuple(leaks(building, seen[stage])) for building, seen in zip(buildings, maps, strict=True)]
            print(f"| {kind} | {count} | {' | '.join(map(str, np.sum(found, axis=0)))} |", flush=True)


def leaks(building: sp.PartialMap, partial: sp.PartialMap, seed: int = 0) -> Leaks:
    """Count links from free cells that were seen to free cells of the building."""
    rng = np.random.default_rng(seed)
    ends = [
        (rng.choice(np.argwhere(each.state == CellState.FREE), LINKS)[:, ::-1] + rng.random((LINKS, 2)))
        for each in (partial, building)
    ]
    links = shapely.linestrings(np.stack(ends, axis=1))
    truth, seen = (cell_outlines(each) for each in (building, partial))
    link, wall = shapely.STRtree(truth).query(links, predicate="intersects")
    points = shapely.get_coordinates(shapely.centroid(shapely.intersection(links[link], truth[wall])))
    along = np.diff(shapely.get_coordinates(truth).reshape(-1, 2, 2), axis=1)[wall, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    distance = ndimage.distance_transform_edt(partial.state != CellState.WALL)
    near = at(distance, points) <= NEAR_CELLS
    sides = [
        np.min([at(distance, points + sign * step * along) for step in range(1, SIDE_CELLS + 1)], axis=0)
        for sign in (-1, 1)
    ]
    between = near & (np.maximum(*sides) <= 1.0)
    partly = np.isin(np.arange(LINKS), shapely.STRtree(seen).query(links, predicate="intersects")[0])
    by_seen, by_sides = (np.isin(np.arange(LINKS), link[each]) for each in (near, between))
    false = partly & ~np.isin(np.arange(LINKS), link)
    counts = (by_seen, by_seen & ~partly, by_sides & ~partly, false)
    return Leaks(LINKS, *(int(each.sum()) for each in counts))


def at(grid: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values of a grid at points [cells]; infinite outside."""
    column, row = np.floor(points.T).astype(int) + 1
    padded = np.pad(grid, 1, constant_values=np.inf)
    return np.asarray(padded[np.clip(row, 0, padded.shape[0] - 1), np.clip(column, 0, padded.shape[1] - 1)])


def cell_outlines(partial: sp.PartialMap) -> NDArray[np.object_]:
    """Segments of outlines [cells]."""
    outlines = wall_outlines(partial)
    return shapely.linestrings(outlines.vertices_m[outlines.segments] / partial.resolution_m)


def print_time(floors: list[sp.PartialMap]) -> None:
    """Time of a large floor, clean and ragged."""
    largest = max(floors, key=lambda each: each.state.size).state
    tiled = np.pad(largest, [(0, max(0, size - have)) for size, have in zip(LARGE, largest.shape, strict=True)], "wrap")
    large = sp.PartialMap(tiled[: LARGE[0], : LARGE[1]], 0.1)
    print("| map | segments | time [s] |\n|---|---|---|")
    for name, each in (("clean", large), ("ragged", ragged(large, 0.15, 0))):
        wall_outlines(sp.PartialMap(each.state[:100, :100], 0.1))
        start = time.perf_counter()
        count = len(wall_outlines(each).segments)
        print(f"| {LARGE[1]} x {LARGE[0]} cells, {name} | {count} | {time.perf_counter() - start:.1f} |", flush=True)


if __name__ == "__main__":
    main()
