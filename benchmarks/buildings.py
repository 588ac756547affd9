"""Large procedural buildings compared with real office floors: sizes, shapes, lines of sight, observed area.

Everything is measured on the cells, without tracing. Each statistic is one number per building; the table gives its
mean and standard deviation over buildings. FOLDER holds one folder with a map.yaml for each real floor. Run it with

    python benchmarks/buildings.py --floors ../shared/floors --out docs
"""

import argparse
import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from homes import area_m2, draw_sheet, perimeter_cells, plain, room_count
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage

import sionna_partial as sp
from sionna_partial.files import atomic_write
from sionna_partial.plots.style import figure_png

FIRST_SEED = 80_000
KINDS = ("floor", "hall", "warehouse")
LINKS = 20_000
EDGES_M = (0.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 25.0, 40.0)
STEPS = (150, 400, 800)
LIDAR = sp.SensorSettings(field_of_view_deg=360.0, range_m=12.0)
FEWEST_LINKS = 20


def main() -> None:
    """Measure, print the table, draw the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--floors", type=Path, help="folder of the real floors; without it, ours alone are measured")
    parser.add_argument("--count", type=int, default=20, help="buildings of each kind")
    parser.add_argument("--out", type=Path, default=Path("benchmark-output"))
    arguments = parser.parse_args()
    paths = sorted(arguments.floors.glob("*/map.yaml")) if arguments.floors else []
    groups = {"real floors": [measure(sp.load_map(path), seed) for seed, path in enumerate(paths)]}
    for kind in KINDS:
        groups[f"{kind}s"] = [measure(sp.make_home(FIRST_SEED + k, kind), k) for k in range(arguments.count)]
    print("\n".join(table({name: buildings for name, buildings in groups.items() if buildings})))
    with atomic_write(arguments.out / "buildings_sheet.png") as stream:
        stream.write(figure_png(draw_buildings(paths)))
    print(f"wrote {arguments.out / 'buildings_sheet.png'}")


def measure(home: sp.PartialMap, seed: int) -> dict[str, float]:
    """Measure one building with links and a robot that the seed draws; values by their labels."""
    free, cell_m = home.state == sp.CellState.FREE, home.resolution_m
    clearance_m = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * cell_m
    distance_m, is_los = lines_of_sight(free, cell_m, seed)
    values = {
        "free area [m²]": area_m2(home),
        "perimeter per free area [1/m]": perimeter_cells(free) * cell_m / area_m2(home),
        "mean room [m²]": area_m2(home) / room_count(free, cell_m),
        "largest part without a closed door": float(np.bincount(ndimage.label(free)[0][free]).max() / free.sum()),
        "mean clearance [m]": float(clearance_m[free].mean()),
        "free area farther than 2 m from walls": float((clearance_m[free] > 2.0).mean()),
        "mean length of a link [m]": float(distance_m.mean()),
        "links in LOS": float(is_los.mean()),
        "mean length of a link in LOS [m]": float(distance_m[is_los].mean()),
    }
    for low, high in itertools.pairwise(EDGES_M):
        here = (distance_m >= low) & (distance_m < high)
        rate = float(is_los[here].mean()) if here.sum() >= FEWEST_LINKS else math.nan
        values[f"LOS at {low:g} to {high:g} m"] = rate
    exploration = sp.explore_trajectory(home, STEPS, seed, sensor=LIDAR)
    for step, fraction in zip(STEPS, exploration.observed_fractions, strict=True):
        values[f"area observed after {step} steps [m²]"] = float(fraction) * area_m2(home)
    return values


def lines_of_sight(free: NDArray[np.bool_], cell_m: float, seed: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Length [m] of links between random free positions, half of them within 25 m; whether free cells join the ends."""
    rng = np.random.default_rng(seed)
    cells = np.argwhere(free)
    start, end = cells[rng.integers(len(cells), size=(2, LINKS))] + 0.5
    turn, apart = rng.uniform(0.0, math.tau, LINKS // 2), 25.0 * np.sqrt(rng.random(LINKS // 2)) / cell_m
    near = start[: LINKS // 2] + apart[:, None] * np.stack([np.sin(turn), np.cos(turn)], axis=1)
    row, column = np.clip(near, 0, np.subtract(free.shape, 1)).astype(np.intp).T
    fits = free[row, column] & (near >= 0).all(axis=1) & (near < free.shape).all(axis=1)
    start = np.concatenate([start[: LINKS // 2][fits], start[LINKS // 2 :]])
    end = np.concatenate([near[fits], end[LINKS // 2 :]])
    return np.linalg.norm(end - start, axis=1) * cell_m, np.array(
        [_is_free(free, one, other) for one, other in zip(start, end, strict=True)]
    )


def _is_free(free: NDArray[np.bool_], start: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    """Whether a line runs through free cells alone, looked up twice per cell."""
    count = int(2 * np.abs(end - start).max()) + 2
    rows, columns = (np.linspace(*ends, count).astype(np.intp) for ends in zip(start, end, strict=True))
    return bool(free[rows, columns].all())


def table(groups: dict[str, list[dict[str, float]]]) -> Iterator[str]:
    """Lines of the table, as Markdown."""
    yield "| " + " | ".join(["", *(f"{name} ({len(buildings)})" for name, buildings in groups.items())]) + " |"
    yield "|---" * (len(groups) + 1) + "|"
    for label in next(iter(groups.values()))[0]:
        columns = [np.array([building[label] for building in buildings]) for buildings in groups.values()]
        cells = [f"{plain(np.nanmean(values))} ± {plain(np.nanstd(values))}" for values in columns]
        yield "| " + " | ".join([label, *cells]) + " |"


def draw_buildings(paths: list[Path]) -> Figure:
    """Draw real floors, if there are any, above buildings of each kind."""
    rows = {"real floors": [sp.load_map(path) for path in paths[::2]]} if paths else {}
    rows |= {f"{kind}s": [sp.make_home(FIRST_SEED + k, kind) for k in range(4)] for kind in KINDS}
    named = {name: [(f"{area_m2(home):.0f} m²", home) for home in row] for name, row in rows.items()}
    return draw_sheet(named, gap_m=8.0)


if __name__ == "__main__":
    main()
