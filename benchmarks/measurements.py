"""What measured gains on a robot's way add to predictions on a half-explored home.

In every home a robot with a camera explores; transmitters and receivers are drawn indoors. Gains at N points on the
robot's way, equally spaced, or at N random points indoors, are those of the complete home with 2 dB of noise, and at
most -120 dB is heard. Changes of accuracy and RMSE against the prediction without measurements are means over homes,
with the standard error over homes; homes with fewer than 30 links in a group are left out of it. Opponents, from the
same measurements: path loss fitted to them, and the same process with distance alone in place of map and trace. Run it
with

    python benchmarks/measurements.py ../shared/gibson/*/map.yaml
    python benchmarks/measurements.py --made 24        # homes of make_home
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.coverage import clear_of_walls
from sionna_partial.evaluation.baselines import Baselines, nothing_seen
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.resources import PREDICTORS_FOLDER

FIRST_SEED = 300_000
NOISE_DB, SENSITIVITY_DB = 2.0, -120.0
WAY = {"on the way": (5, 10, 20, 40, 100), "anywhere indoors": (20, 40)}
GROUPS = ("all links", "transmitter unseen", "unseen, receiver seen", "transmitter seen")
FEWEST_LINKS = 30
HEIGHT_M, NEAREST_M = 1.5, 0.1


@dataclass(frozen=True)
class Places:
    """Links from one transmitter to N places: truth, and what is predicted without measurements."""

    rx_m: NDArray[np.float64]
    link_state: NDArray[np.uint8]
    gain_db: NDArray[np.float64]
    prior: sp.LinkPrediction
    by_distance: sp.LinkPrediction


def main() -> None:
    """Measure all homes, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", type=Path, help="complete maps")
    parser.add_argument("--made", type=int, default=0, help="number of procedural homes")
    parser.add_argument("--step", type=int, default=200, help="steps that the robot has explored")
    parser.add_argument("--transmitters", type=int, default=4)
    arguments = parser.parse_args()
    homes = [(path.parent.name, sp.load_map(path)) for path in arguments.maps]
    homes += [(f"make_home({seed})", sp.make_home(seed)) for seed in range(FIRST_SEED, FIRST_SEED + arguments.made)]
    errors: dict[tuple[str, ...], list[tuple[float, float]]] = defaultdict(list)
    for seed, (name, home) in enumerate(homes):
        for key, sums in home_errors(home, arguments.step, arguments.transmitters, seed).items():
            right, square, count = sums.sum(axis=0)
            if count >= FEWEST_LINKS:
                errors[key].append((right / count, np.sqrt(square / count)))
        print(f"{name} done", flush=True)
    print("\n".join(tables(errors)))


def home_errors(home: sp.PartialMap, step: int, count: int, seed: int) -> dict[tuple[str, ...], NDArray[np.float64]]:
    """Links that are right, squared errors [dB^2] and links, by group, where was measured, number, and method."""
    rng = np.random.default_rng(seed)
    exploration = sp.explore_trajectory(home, (step,), seed)
    partial = exploration.maps[0]
    way_m = np.unique(exploration.poses[:, :2], axis=0, return_index=True)[1]
    way_m = np.insert(exploration.poses[np.sort(way_m), :2], 2, HEIGHT_M, axis=1)
    way_m = way_m[clear_of_walls(home, way_m) & clear_of_walls(partial, way_m)]
    sums: dict[tuple[str, ...], list[tuple[float, float, int]]] = defaultdict(list)
    anywhere_m, rx_m = (points(home, partial, number, rng) for number in (max(WAY["anywhere indoors"]), 200))
    for tx_m in points(home, partial, count, rng):
        receivers = places(home, partial, tx_m, rx_m)
        where = {"on the way": places(home, partial, tx_m, way_m)}
        where["anywhere indoors"] = places(home, partial, tx_m, anywhere_m)
        seen = bool(partial.state_at(tx_m[None])[0] == sp.CellState.FREE)
        rx_seen = partial.state_at(receivers.rx_m) == sp.CellState.FREE
        every = np.ones_like(rx_seen)
        groups = dict(zip(GROUPS, (every, every & (not seen), rx_seen & (not seen), every & seen), strict=True))
        for method, prediction in predictions(partial, tx_m, where, receivers, rng):
            right = prediction.link_state == receivers.link_state
            square = (prediction.gain_mean_db - receivers.gain_db) ** 2
            for group, mask in groups.items():
                sums[group, *method].append((right[mask].sum(), square[mask].sum(), int(mask.sum())))
    return {key: np.array(values) for key, values in sums.items()}


def points(home: sp.PartialMap, partial: sp.PartialMap, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random points (count, 3) in free cells of a home, where links can be predicted [m]."""
    cells = rng.permutation(np.argwhere(home.state == sp.CellState.FREE))
    inside = cells + rng.uniform(0.25, 0.75, cells.shape)
    points_m = np.insert(inside[:, ::-1] * home.resolution_m + home.origin_m, 2, HEIGHT_M, axis=1)
    return points_m[clear_of_walls(home, points_m) & clear_of_walls(partial, points_m)][:count]


def places(home: sp.PartialMap, partial: sp.PartialMap, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> Places:
    """Trace the links of a transmitter on the home and on the partial map, and predict them."""
    rx_m = rx_m[np.linalg.norm(rx_m - tx_m, axis=1) > NEAREST_M]
    truth = sp.trace_links(home, tx_m, rx_m)
    phi = sp.link_features(partial, sp.trace_links(partial, tx_m, rx_m))
    distance = Baselines.load(PREDICTORS_FOLDER).distance
    by_distance = distance.predict(nothing_seen(phi, distance.settings.frequency_hz))
    return Places(rx_m, truth.link_state, truth.gain_db, sp.Predictor.load().predict(phi), by_distance)


def predictions(
    partial: sp.PartialMap, tx_m: NDArray[np.float64], where: dict[str, Places], at: Places, rng: np.random.Generator
) -> Iterator[tuple[tuple[str, str, str], sp.LinkPrediction]]:
    """Predictions at some places, by where was measured, how often, and method."""
    yield ("nowhere", "0", "prediction"), at.prior
    for name, numbers in WAY.items():
        known = where[name]
        for number in numbers:
            chosen = np.unique(np.linspace(0, len(known.rx_m) - 1, number).round().astype(int))
            gain_db = known.gain_db[chosen] + NOISE_DB * rng.standard_normal(len(chosen))
            heard_db = np.maximum(gain_db, SENSITIVITY_DB)
            measured = sp.Measurements(tx_m, known.rx_m[chosen], heard_db, sensitivity_db=SENSITIVITY_DB)
            for method, source, target in (
                ("prediction", known.prior, at.prior),
                ("distance alone", known.by_distance, at.by_distance),
            ):
                told = Assimilation(partial, tx_m, measured, source.take(chosen))
                yield (name, str(number), method), told.update(at.rx_m, target)
            log_m = [np.log10(np.linalg.norm(rx_m - tx_m, axis=1)) for rx_m in (measured.rx, at.rx_m)]
            slope, start = np.polyfit(log_m[0], heard_db, 1)
            fitted = np.clip(start + slope * log_m[1], -150.0, 0.0)
            ones = np.ones(len(fitted))
            heard = fitted > SENSITIVITY_DB
            yield (
                (name, str(number), "path-loss fit"),
                sp.LinkPrediction.of_parts(
                    np.stack([~heard, 0 * ones, heard]),
                    np.stack([-150 * ones, fitted, fitted]),
                    np.zeros((3, len(ones))),
                ),
            )


def tables(errors: dict[tuple[str, ...], list[tuple[float, float]]]) -> Iterator[str]:
    """Lines of a table for each group, as Markdown."""
    for group in GROUPS:
        base = np.array(errors[group, "nowhere", "0", "prediction"])
        accuracy, rmse_db = base.mean(axis=0)
        yield f"\n{group} ({len(base)} homes; without measurements {accuracy:.3f}, {rmse_db:.1f} dB)\n"
        yield "| measured | number | prediction | distance alone | path-loss fit |"
        yield "|---|---|---|---|---|"
        for where, numbers in WAY.items():
            for number in numbers:
                cells = []
                for method in ("prediction", "distance alone", "path-loss fit"):
                    change = np.array(errors[group, where, str(number), method]) - base
                    (d_accuracy, d_rmse), (s_accuracy, s_rmse) = (
                        change.mean(axis=0),
                        change.std(axis=0, ddof=1) / np.sqrt(len(change)),
                    )
                    cells.append(f"{d_accuracy:+.3f} ± {s_accuracy:.3f}, {d_rmse:+.1f} ± {s_rmse:.1f} dB")
                yield f"| {where} | {number} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
