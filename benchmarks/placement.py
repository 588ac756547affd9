"""Placement of a transmitter against an exhaustive search, on homes that nothing was trained on.

Homes are made and explored. The exhaustive search evaluates every free cell of a grid of 0.5 m, with the receivers, the
weights, the predictor and the objective of `sp.place_transmitter`. Both positions are evaluated by the full trace: the
fraction of receivers in the complete home, on a grid of 0.5 m, whose gain exceeds the threshold. Times are
processor times after a warm-up. Run it with

    python benchmarks/placement.py
"""

import argparse

import numpy as np
from numpy.typing import NDArray
from stock import grid_m, timed

import sionna_partial as sp
from sionna_partial.placement.area import PlacementArea, placement_area
from sionna_partial.placement.placement import link_values, placement_score
from sionna_partial.settings import PlacementSettings

FIRST_SEED = 50_100
SPACING_M = 0.5
THRESHOLD_DB = -100.0
COLUMNS = (
    "covered, ours",
    "covered, exhaustive",
    "predicted, ours",
    "predicted, exhaustive",
    "time, exhaustive / ours",
)


def main() -> None:
    """Measure, and print a row for each map and their means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=12)
    parser.add_argument("--steps", type=int, nargs="+", default=[50, 100, 150, 200])
    arguments = parser.parse_args()
    print(f"| map | {' | '.join(COLUMNS)} |\n" + "|---" * (1 + len(COLUMNS)) + "|")
    means = []
    for seed in range(FIRST_SEED, FIRST_SEED + arguments.homes):
        home, rows = sp.make_home(seed), []
        for step, partial in zip(arguments.steps, sp.explore(home, arguments.steps, seed), strict=True):
            rows.append(measure(partial, home))
            print(f"| {seed}, {step} steps | {' | '.join(f'{value:.3f}' for value in rows[-1])} |", flush=True)
        means.append(np.mean(rows, axis=0))
    print(f"| mean | {' | '.join(f'{value:.3f}' for value in np.mean(means, axis=0))} |")
    ahead = np.subtract(*np.transpose(means)[:2])
    error = ahead.std(ddof=1) / np.sqrt(len(ahead)) if len(ahead) > 1 else np.nan
    print(f"covered: ours - exhaustive {ahead.mean():+.3f} ± {error:.3f} (standard error over homes)")


def measure(partial: sp.PartialMap, home: sp.PartialMap) -> list[float]:
    """Place a transmitter in both ways, and return the values of `COLUMNS`."""
    model = sp.LinkModel(partial)
    settings = PlacementSettings(threshold_db=THRESHOLD_DB)
    area = placement_area(partial, settings.tx_height_m, settings.rx_height_m, model.predictor)
    positions_m = grid_m(partial, SPACING_M)
    sp.place_transmitter(model, threshold_db=THRESHOLD_DB)  # warms up
    found, ours_s = timed(lambda: sp.place_transmitter(model, threshold_db=THRESHOLD_DB))
    scores, exhaustive_s = timed(lambda: [score(model, area, tx_m, settings) for tx_m in positions_m])
    best_m = positions_m[int(np.argmax(scores))]
    covered = [covered_fraction(home, tx_m) for tx_m in (found.position_m, best_m)]
    return [*covered, score(model, area, found.position_m, settings), max(scores), exhaustive_s / ours_s]


def score(model: sp.LinkModel, area: PlacementArea, tx_m: NDArray[np.float64], settings: PlacementSettings) -> float:
    """Return the objective at a position."""
    far = np.linalg.norm(area.rx_m - tx_m, axis=1) > 0.02
    values = np.ones(len(far))  # a receiver at the transmitter is covered
    values[far] = link_values(model.predict(tx_m, area.rx_m[far]), settings)
    return float(placement_score(values, area.weight, settings))


def covered_fraction(home: sp.PartialMap, tx_m: NDArray[np.float64]) -> float:
    """Return the fraction of the receivers in a complete home whose gain exceeds the threshold."""
    rx_m = np.add(grid_m(home, SPACING_M), [0.03, 0.02, 0.0])
    rx_m = rx_m[(home.state_at(rx_m) == sp.CellState.FREE) & (np.linalg.norm(rx_m - tx_m, axis=1) > 0.02)]
    return float(np.mean(sp.trace_links(home, tx_m, rx_m).gain_db > THRESHOLD_DB))


if __name__ == "__main__":
    main()
