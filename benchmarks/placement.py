"""Placement of a transmitter against an exhaustive search, on homes that nothing was trained on.

Homes are made from seeds that no predictor was trained on, and explored. The exhaustive search evaluates every free
cell of a grid of 0.5 m, with the receivers, the weights, the predictor and the objective of `sp.place_transmitter`:
links are traced on a scene that is built once, and predicted. Every placement is evaluated by the full trace: the
fraction of receivers in the complete home, on a grid of 0.5 m, whose gain exceeds the threshold. Times are those of the
processor, after a warm-up. "starts only" is the best of the starts, before any refinement.

A run that was stopped continues with the maps that are missing. Run it with

    python benchmarks/placement.py --out benchmark-output/placement
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from functools import partial as bind
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.placement.placement import PlacementArea, link_values, placement_area, placement_score
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.settings import PlacementSettings

FIRST_SEED = 50_100
SPACING_M, HEIGHT_M = 0.5, 1.5
POSITIONS_AT_ONCE = 16
METHODS = ("ours", "starts only")


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmark-output/placement"))
    parser.add_argument("--homes", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--steps", type=int, nargs="+", default=[50, 100, 150, 200], help="-1 is the complete home")
    parser.add_argument("--threshold", type=float, default=-100.0, help="[dB]")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.homes):
        for step, make in maps_of(seed, arguments.steps):
            path = arguments.out / f"{seed}_{step}_{arguments.threshold:g}.json"
            if not path.exists():
                row = {"seed": seed, "steps": step} | measure(*make(), arguments.threshold)
                path.write_text(json.dumps(row), encoding="utf-8")
            rows.append(json.loads(path.read_text(encoding="utf-8")))
            print(line(rows[-1]), flush=True)
    for step in arguments.steps:
        summary([row for row in rows if row["steps"] == step], f"after {step} steps" if step >= 0 else "complete homes")
    summary(rows, "all")


def maps_of(seed: int, steps: list[int]) -> Iterator[tuple[int, Callable[[], tuple[sp.PartialMap, sp.PartialMap]]]]:
    """Give each stage of a home, and how to make its partial and its complete map."""
    for step in steps:

        def make(step: int = step) -> tuple[sp.PartialMap, sp.PartialMap]:
            home = sp.make_home(seed)
            return home if step < 0 else sp.explore(home, steps=(step,), seed=seed)[0], home

        yield step, make


def measure(partial: sp.PartialMap, home: sp.PartialMap, threshold_db: float) -> dict[str, Any]:
    """Place a transmitter in several ways, and evaluate every position."""
    model = sp.Predictor.load()
    settings = PlacementSettings(threshold_db=threshold_db, tx_height_m=HEIGHT_M, rx_height_m=HEIGHT_M)
    area = placement_area(partial, HEIGHT_M, HEIGHT_M, None if partial.is_complete else model)
    grid_m = grid(partial)
    search = bind(sp.place_transmitter, partial, predictor=model, threshold_db=threshold_db, tx_height_m=HEIGHT_M)
    search()  # warms up
    exhaustive(area, grid_m[:2], model, settings)
    ours, ours_s = timed(search)
    scores, exhaustive_s = timed(lambda: exhaustive(area, grid_m, model, settings))
    start_m = ours.starts_m[int(np.argmax(ours.start_scores))]
    positions_m = np.stack([ours.position_m, start_m, grid_m[int(np.argmax(scores))]])
    again = exhaustive(area, positions_m, model, settings)
    truths = truth(home, positions_m, threshold_db)
    names = (*METHODS, "exhaustive")
    return {
        "positions": len(grid_m),
        "receivers": len(area.rx_m),
        "score": dict(zip(names, again.tolist(), strict=True)),
        "truth": dict(zip(names, truths.tolist(), strict=True)),
        "seconds": {"ours": ours_s, "exhaustive": exhaustive_s},
    }


def exhaustive(
    area: PlacementArea, positions_m: NDArray[np.float64], model: sp.Predictor, settings: PlacementSettings
) -> NDArray[np.float64]:
    """Return the objective at every position, the fastest public way: scenes are built once for many positions."""
    scores, simulation = [], sp.Simulation(area.partial)
    for start in range(0, len(positions_m), POSITIONS_AT_ONCE):
        some_m = positions_m[start : start + POSITIONS_AT_ONCE]
        far = [np.linalg.norm(area.rx_m - tx_m, axis=1) > 0.02 for tx_m in some_m]
        for tx_m, kept in zip(some_m, far, strict=True):
            phi = sp.link_features(area.partial, simulation.links(tx_m, area.rx_m[kept]))
            prediction = LinkPrediction.of_trace(phi) if area.partial.is_complete else model.predict(phi)
            values = np.full(len(kept), 1.0)  # a receiver at the transmitter is covered
            values[kept] = link_values(prediction, settings)
            scores.append(placement_score(values, area.weight, settings))
    return np.array(scores)


def truth(home: sp.PartialMap, positions_m: NDArray[np.float64], threshold_db: float) -> NDArray[np.float64]:
    """Fraction of the receivers in a complete home whose gain exceeds the threshold, for each position."""
    rx_m = np.add(grid(home), [0.03, 0.02, 0.0])
    rx_m = rx_m[home.state_at(rx_m) == sp.CellState.FREE]
    far = [rx_m[np.linalg.norm(rx_m - tx_m, axis=1) > 0.02] for tx_m in positions_m]
    simulation = sp.Simulation(home)
    links = [simulation.links(*each) for each in zip(positions_m, far, strict=True)]
    return np.array([np.mean(each.gain_db > threshold_db) for each in links])


def grid(partial: sp.PartialMap) -> NDArray[np.float64]:
    """Free positions (P, 3) on a grid of 0.5 m."""
    x0, y0, x1, y1 = partial.bounds_m
    x, y = np.meshgrid(np.arange(x0 + SPACING_M / 2, x1, SPACING_M), np.arange(y0 + SPACING_M / 2, y1, SPACING_M))
    positions_m = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT_M)])
    return positions_m[partial.state_at(positions_m) == sp.CellState.FREE]


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """Run something, and return how long the processor took [s]."""
    start = time.process_time()
    return run(), time.process_time() - start


def line(row: dict[str, Any]) -> str:
    """One map as a line."""
    truths = ", ".join(f"{name} {fraction:.3f}" for name, fraction in row["truth"].items())
    ratio = row["seconds"]["ours"] / row["seconds"]["exhaustive"]
    return f"{row['seed']} {row['steps']:>4}: {row['positions']:>4} positions, truth {truths}, time {ratio:.3f}"


def summary(rows: list[dict[str, Any]], title: str) -> None:
    """Print the means, and the paired differences to the exhaustive search with their standard errors over homes."""
    if not rows:
        return
    homes = sorted({row["seed"] for row in rows})
    positions = np.mean([row["positions"] for row in rows])
    print(f"\n{title}: {len(rows)} maps of {len(homes)} homes, {positions:.0f} positions")
    print(f"| {'search':16} | covered in truth | minus exhaustive | predicted | minus exhaustive | time / exhaustive |")
    print("|---|---|---|---|---|---|")
    total = sum(row["seconds"]["exhaustive"] for row in rows)
    for name in ("exhaustive", *METHODS):
        cells = [f"{name:16}"]
        for kind in ("truth", "score"):
            values = {home: [row[kind][name] for row in rows if row["seed"] == home] for home in homes}
            gaps = [
                np.mean([row[kind][name] - row[kind]["exhaustive"] for row in rows if row["seed"] == home])
                for home in homes
            ]
            error = np.std(gaps, ddof=1) / np.sqrt(len(homes)) if len(homes) > 1 else np.nan
            cells += [f"{np.mean([np.mean(each) for each in values.values()]):.3f}"]
            cells += [f"{np.mean(gaps):+.3f} ± {error:.3f}" if name != "exhaustive" else ""]
        if name in rows[0]["seconds"]:
            each = np.mean([row["seconds"][name] / row["seconds"]["exhaustive"] for row in rows])
            cells += [f"{sum(row['seconds'][name] for row in rows) / total:.3f} (mean of ratios {each:.3f})"]
        else:
            cells += [""]
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
