"""Maps of simulated robots beside maps of real ones: walls, gaps, specks and range noise.

- Runs: lengths of runs of wall cells that begin at a free cell, along rows and columns in both directions: fractions of
  1, 2, 3, 4, and 5 or more cells.
- Specks: fraction of wall cells in pieces of three cells or fewer.
- Gaps: one or two free cells between wall cells of a row or column, as a fraction of the runs.
- Ragged: fraction of edges of walls that are shifted by one cell between two edges in line.
- Noise: `PartialMap.wall_noise`.

Simulated lidars of 12 m (halls: 20 m) drive through furnished homes and warehouses until they have seen most of them.
SHARED is the folder with real maps. Run it with

    python benchmarks/robots.py --shared ../shared
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import SionnaPartialError
from sionna_partial.maps.wall_cells import ragged_edges, row_runs
from sionna_partial.settings import Fusion

REAL = ("slam/*.yaml", "ros/*.yaml", "measured/dae/map.yaml", "measured/bleflat/robot.yaml", "vacuum/*.json")
ERRORS = {"drift_m_per_m": 0.0005, "heading_noise_deg": 0.2}
RANGE_NOISES_M = (0.0, 0.005, 0.01, 0.02, 0.03)
FIRST_SEED, OBSERVED = 74_000, 0.9
COLUMNS = ("1", "2", "3", "4", "5+", "specks", "gaps", "ragged", "noise")


def main() -> None:
    """Print one row for each real map, and the mean over buildings for each simulated robot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--homes", type=int, default=4)
    parser.add_argument("--warehouses", type=int, default=1)
    arguments = parser.parse_args()
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


def real_maps(folder: Path) -> Iterator[tuple[str, sp.PartialMap]]:
    """Names and maps of real robots that can be read."""
    for path in (path for pattern in REAL for path in sorted(folder.glob(pattern))):
        try:
            yield f"{path.parent.name}/{path.stem}", sp.load_map(path)
        except SionnaPartialError as error:
            print(f"| {path.name}: {error} |")


def shape(partial: sp.PartialMap) -> NDArray[np.float64]:
    """Return the values of `COLUMNS`."""
    lengths, gaps = np.zeros(6), 0
    for turns in range(4):
        state = np.pad(np.rot90(partial.state, turns), 1, constant_values=CellState.UNKNOWN)
        wall = state == CellState.WALL
        row, start, end = row_runs(wall)
        length = np.minimum(end - start, 5)[state[row, start - 1] == CellState.FREE]
        lengths += np.bincount(length, minlength=6)
        row, start, end = row_runs(state == CellState.FREE)
        gaps += int(((end - start <= 2) & wall[row, start - 1] & wall[row, end]).sum())
    wall = partial.state == CellState.WALL
    sizes = np.bincount(ndimage.label(wall, structure=np.ones((3, 3)))[0].ravel())[1:]
    specks = sizes[sizes <= 3].sum() / max(1, wall.sum())
    runs = max(1.0, lengths.sum())
    return np.array([*lengths[1:] / runs, specks, gaps / runs, ragged_edges(wall), partial.wall_noise])


def row(name: str, values: NDArray[np.float64]) -> str:
    """Return one row of the table."""
    return f"| {name} | " + " | ".join(f"{value:.2f}" for value in values) + " |"


if __name__ == "__main__":
    main()
