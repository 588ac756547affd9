"""Maps of simulated robots beside maps of real ones: walls, gaps, specks and range noise.

- Runs: lengths of runs of wall cells that begin at a free cell, along rows and columns in both directions: fractions of
  1, 2, 3, 4, and 5 or more cells.
- Specks: fraction of wall cells in pieces of three cells or fewer.
- Gaps: one or two free cells between wall cells of a row or column, as a fraction of the runs.
- Ragged: fraction of edges of walls that are shifted by one cell between two edges in line.
- Noise: mean of `PartialMap.noise_near` over the free cells.

Simulated lidars of 12 m (halls: 20 m) drive through furnished homes and warehouses until they have seen most of them.
SHARED is the folder with real maps. With --agree, `ROBOTS` map one home each from a start of its own, and their
predictions (28 GHz) are compared where all have seen the receiver: mean absolute difference of the mean gain, and
fraction of equal most probable states, with the complete home and among pairs of robots. Run it with

    python benchmarks/robots.py --shared ../shared
    python benchmarks/robots.py --agree 74000 74001 74002
"""

import argparse
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

import sionna_partial as sp
from sionna_partial.arrays import row_runs
from sionna_partial.constants import CellState
from sionna_partial.errors import SionnaPartialError
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.settings import Fusion

REAL = ("slam/*.yaml", "ros/*.yaml", "measured/dae/map.yaml", "measured/bleflat/robot.yaml", "vacuum/*.json")
ERRORS = {"drift_m_per_m": 0.0005, "heading_noise_deg": 0.2}
RANGE_NOISES_M = (0.0, 0.005, 0.01, 0.02, 0.03)
FIRST_SEED, OBSERVED = 74_000, 0.9
ROBOTS = (
    *(("vacuum", 0.005), ("vacuum", 0.01), ("vacuum", 0.02), ("vacuum", 0.03)),
    *(("slam_toolbox", 0.01), ("gmapping", 0.01), ("cartographer", 0.01)),
)
RECEIVERS, CLEARANCE_M, HEIGHT_M = 300, 0.3, 1.5
COLUMNS = ("1", "2", "3", "4", "5+", "specks", "gaps", "ragged", "noise")


def main() -> None:
    """Print one row for each real map, and the mean over buildings for each simulated robot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--homes", type=int, default=4)
    parser.add_argument("--warehouses", type=int, default=1)
    parser.add_argument("--agree", type=int, nargs="+", metavar="SEED")
    arguments = parser.parse_args()
    if arguments.agree:
        for seed in arguments.agree:
            print_agreement(seed)
        return
    print("| map | " + " | ".join(COLUMNS) + " |\n" + "|---" * (1 + len(COLUMNS)) + "|")
    for name, partial in real_maps(arguments.shared):
        print(row(name, shape(partial)), flush=True)
    cases = ((None, arguments.homes, 12.0), ("warehouse", arguments.warehouses, 20.0))
    for kind, count, range_m in (case for case in cases if case[1]):
        buildings = [sp.make_home(FIRST_SEED + index, kind) for index in range(count)]
        for fusion in get_args(Fusion):
            for noise_m in RANGE_NOISES_M:
                errors = ERRORS if noise_m else {}
                lidar = sp.SensorSettings(noise_m, field_of_view_deg=360.0, range_m=range_m, fusion=fusion, **errors)
                shapes = [shape(sp.explore(building, (OBSERVED,), 0, sensor=lidar)[0]) for building in buildings]
                print(row(f"{kind or 'homes'}, {fusion}, {100 * noise_m:g} cm", np.mean(shapes, axis=0)), flush=True)


def print_agreement(seed: int) -> None:
    """Print the differences between predictions on maps that robots made of one home."""
    home, maps = sp.make_home(seed), []
    for number, (fusion, noise_m) in enumerate(ROBOTS):
        lidar = sp.SensorSettings(noise_m, field_of_view_deg=360.0, range_m=12.0, fusion=fusion, **ERRORS)
        maps += sp.explore(home, (OBSERVED,), number, sensor=lidar)
    roomy = ndimage.distance_transform_edt(home.state == CellState.FREE) * home.resolution_m > CLEARANCE_M
    points_m = cell_centres_m(home, np.argwhere(roomy))
    seen = np.all([partial.state_at(points_m) == CellState.FREE for partial in maps], axis=0)
    points_m = np.random.default_rng(seed).permutation(points_m[seen])[: RECEIVERS + 1]
    tx_m, *rx_m = np.column_stack([points_m, np.full(len(points_m), HEIGHT_M)])
    truth, *found = (sp.LinkModel(scene).predict(tx_m, rx_m) for scene in (home, *maps))
    for (fusion, noise_m), partial, prediction in zip(ROBOTS, maps, found, strict=True):
        name = f"home {seed}, {fusion}, {100 * noise_m:g} cm, noise {noise(partial):.2f}"
        print(row(name, differences(prediction, truth)), flush=True)
    pairs = np.array([differences(*pair) for pair in combinations(found, 2)])
    print(row(f"home {seed}, {len(pairs)} pairs", pairs.mean(axis=0)), flush=True)


def differences(prediction: sp.LinkPrediction, other: sp.LinkPrediction) -> NDArray[np.float64]:
    """Return the mean absolute difference of the mean gain [dB], and the fraction of equal most probable states."""
    difference_db = np.abs(prediction.gain_mean_db - other.gain_mean_db).mean()
    return np.array([difference_db, (prediction.link_state == other.link_state).mean()])


def real_maps(folder: Path) -> Iterator[tuple[str, sp.PartialMap]]:
    """Names and maps of real robots that can be read."""
    for path in (path for pattern in REAL for path in sorted(folder.glob(pattern))):
        try:
            yield f"{path.parent.name}/{path.stem}", sp.load_map(path)
        except SionnaPartialError as error:
            print(f"| {path.name}: {error} |")


def shape(partial: sp.PartialMap) -> NDArray[np.float64]:
    """Return the values of `COLUMNS`."""
    lengths, gaps, edges, ragged = np.zeros(6), 0, 0, 0
    for turns in range(4):
        state = np.pad(np.rot90(partial.state, turns), 1, constant_values=CellState.UNKNOWN)
        wall = state == CellState.WALL
        row, start, end = row_runs(wall)
        length = np.minimum(end - start, 5)[state[row, start - 1] == CellState.FREE]
        lengths += np.bincount(length, minlength=6)
        row, start, end = row_runs(state == CellState.FREE)
        gaps += int(((end - start <= 2) & wall[row, start - 1] & wall[row, end]).sum())
        edge = wall[:, :-1] & ~wall[:, 1:]
        shifted = np.pad(edge[:, :-1], ((0, 0), (1, 0))) | np.pad(edge[:, 1:], ((0, 0), (0, 1)))
        edges += int(edge.sum())
        ragged += int((edge[:-2] & edge[2:] & ~edge[1:-1] & shifted[1:-1]).sum())
    wall = partial.state == CellState.WALL
    sizes = np.bincount(ndimage.label(wall, structure=np.ones((3, 3)))[0].ravel())[1:]
    specks = sizes[sizes <= 3].sum() / max(1, wall.sum())
    runs = max(1.0, lengths.sum())
    return np.array([*lengths[1:] / runs, specks, gaps / runs, ragged / max(1, edges), noise(partial)])


def noise(partial: sp.PartialMap) -> float:
    """Return the mean range noise of the walls near free cells."""
    free_m = cell_centres_m(partial, np.argwhere(partial.state == CellState.FREE))
    return float(partial.noise_near(free_m).mean())


def row(name: str, values: NDArray[np.float64]) -> str:
    """Return one row of the table."""
    return f"| {name} | " + " | ".join(f"{value:.2f}" for value in values) + " |"


if __name__ == "__main__":
    main()
