"""What measured gains on a robot's trajectory add to predictions on a half-explored home.

In every home a robot with a camera explores; transmitters and receivers are drawn indoors. Gains at N points on its
trajectory, equally spaced, or at N random points indoors, are those of the complete home with 2 dB of noise, and at
most -120 dB is received. Changes of accuracy and RMSE against the prediction without measurements are means over homes,
with the standard error over homes; homes with fewer than 30 links in a group are left out of it. The calibration error
of the link state, and the fraction of gains in the 90 % interval, are over all links. Opponents, from the same
measurements: path loss fitted to them, and the same process with distance alone in place of map and trace. Run it with

    python benchmarks/measurements.py ../shared/gibson/*/map.yaml
    python benchmarks/measurements.py --made 24        # homes of make_home
    python benchmarks/measurements.py --unknown ../shared/gibson/*/map.yaml

With --unknown the position of the transmitter is to be found from 20 gains on the way: its distance from the truth, how
often the 90 % region has it, and the distances of the strongest measurement and of a path-loss fit by grid search. For
one transmitter in each home, the coverage averaged over the posterior is compared with those of the known position.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.lab.evaluation import Baselines, measure, nothing_seen
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.measurements.localisation import Predict, likely_region, locate_transmitter
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.tracing.positions import clear_of_walls

Links = tuple[sp.LinkPrediction, NDArray[np.uint8], NDArray[np.float64]]

FIRST_SEED = 300_000
NOISE_DB, SENSITIVITY_DB = 2.0, -120.0
WAY = {"on the way": (5, 10, 20, 40, 100), "anywhere indoors": (20, 40)}
GROUPS = ("all links", "transmitter unseen", "unseen, receiver seen", "transmitter seen")
FEWEST_LINKS = 30
HEIGHT_M, NEAREST_M = 1.5, 0.1
ON_THE_WAY, SPACING_M = 20, 0.6


@dataclass(frozen=True)
class Linked:
    """Links from one transmitter to N positions: truth, and what is predicted without measurements."""

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
    parser.add_argument("--transmitters", type=int, default=12, help="in each home")
    parser.add_argument("--unknown", action="store_true", help="find the position of the transmitter")
    arguments = parser.parse_args()
    homes = [(path.parent.name, sp.load_map(path)) for path in arguments.maps]
    homes += [(f"make_home({seed})", sp.make_home(seed)) for seed in range(FIRST_SEED, FIRST_SEED + arguments.made)]
    if arguments.unknown:
        unknown_transmitters(homes, arguments.step, arguments.transmitters)
        return
    links: dict[tuple[str, ...], list[Links]] = defaultdict(list)
    for seed, (name, home) in enumerate(homes):
        for key, parts in home_links(home, arguments.step, arguments.transmitters, seed).items():
            predictions, *truth = zip(*parts, strict=True)
            of_home = (sp.LinkPrediction.concatenate(predictions), *map(np.concatenate, truth))
            if len(of_home[1]) >= FEWEST_LINKS:
                links[key].append(of_home)
        print(f"{name} done", flush=True)
    print("\n".join(tables(links)))


def home_links(home: sp.PartialMap, step: int, count: int, seed: int) -> dict[tuple[str, ...], list[Links]]:
    """Predictions, link states and gains [dB] by group, where was measured, number, and method."""
    rng = np.random.default_rng(seed)
    partial, way_m = explored(home, step, seed)
    links: dict[tuple[str, ...], list[Links]] = defaultdict(list)
    anywhere_m, rx_m = (points(home, partial, number, rng) for number in (max(WAY["anywhere indoors"]), 200))
    for tx_m in points(home, partial, count, rng):
        receivers, *measured = linked(home, partial, tx_m, (rx_m, way_m, anywhere_m))
        where = dict(zip(WAY, measured, strict=True))
        seen = bool(partial.state_at(tx_m[None])[0] == sp.CellState.FREE)
        rx_seen = partial.state_at(receivers.rx_m) == sp.CellState.FREE
        every = np.ones_like(rx_seen)
        groups = dict(zip(GROUPS, (every, every & (not seen), rx_seen & (not seen), every & seen), strict=True))
        for method, prediction in predictions(partial, tx_m, where, receivers, rng):
            for group, mask in groups.items():
                links[group, *method].append(
                    (prediction.take(mask), receivers.link_state[mask], receivers.gain_db[mask])
                )
    return links


def explored(home: sp.PartialMap, step: int, seed: int) -> tuple[sp.PartialMap, NDArray[np.float64]]:
    """Return what a robot has seen of a home, and where it was (W, 3) [m]."""
    exploration = sp.explore_trajectory(home, (step,), seed)
    partial = exploration.maps[0]
    way_m = np.unique(exploration.poses[:, :2], axis=0, return_index=True)[1]
    way_m = np.insert(exploration.poses[np.sort(way_m), :2], 2, HEIGHT_M, axis=1)
    return partial, way_m[clear_of_walls(home, way_m) & clear_of_walls(partial, way_m)]


def points(home: sp.PartialMap, partial: sp.PartialMap, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random points (count, 3) in free cells of a home, where links can be predicted [m]."""
    cells = rng.permutation(np.argwhere(home.state == sp.CellState.FREE))
    inside = cells + rng.uniform(0.25, 0.75, cells.shape)
    points_m = np.insert(inside[:, ::-1] * home.resolution_m + home.origin_m, 2, HEIGHT_M, axis=1)
    return points_m[clear_of_walls(home, points_m) & clear_of_walls(partial, points_m)][:count]


def linked(
    home: sp.PartialMap, partial: sp.PartialMap, tx_m: NDArray[np.float64], parts: Sequence[NDArray[np.float64]]
) -> list[Linked]:
    """Trace the links of a transmitter to groups of receivers on the home and on the partial map, and predict them."""
    parts = [rx_m[np.linalg.norm(rx_m - tx_m, axis=1) > NEAREST_M] for rx_m in parts]
    rx_m = np.concatenate(parts)
    truth = sp.trace_links(home, tx_m, rx_m)
    phi = sp.link_features(partial, sp.trace_links(partial, tx_m, rx_m))
    distance = Baselines.load(PREDICTORS_FOLDER).distance
    predicted = sp.Predictor.load().predict(phi), distance.predict(nothing_seen(phi, distance.settings.frequency_hz))
    found, last = [], 0
    for part in parts:
        mask = np.zeros(len(rx_m), dtype=bool)
        mask[last : last + len(part)] = True
        last += len(part)
        found.append(
            Linked(part, truth.link_state[mask], truth.gain_db[mask], *(each.take(mask) for each in predicted))
        )
    return found


def predictions(
    partial: sp.PartialMap, tx_m: NDArray[np.float64], where: dict[str, Linked], at: Linked, rng: np.random.Generator
) -> Iterator[tuple[tuple[str, str, str], sp.LinkPrediction]]:
    """Predictions at some positions, by where was measured, how often, and method."""
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
                fitted = Assimilation.fit(partial, tx_m, measured, source.take(chosen))
                yield (name, str(number), method), fitted.update(at.rx_m, target)
            log_m = [np.log10(np.linalg.norm(rx_m - tx_m, axis=1)) for rx_m in (measured.rx, at.rx_m)]
            slope, start = np.polyfit(log_m[0], heard_db, 1)
            fitted = np.clip(start + slope * log_m[1], -150.0, 0.0)
            ones = np.ones(len(fitted))
            received = fitted > SENSITIVITY_DB
            yield (
                (name, str(number), "path-loss fit"),
                sp.LinkPrediction.of_parts(
                    np.stack([~received, 0 * ones, received]),
                    np.stack([-150 * ones, fitted, fitted]),
                    np.zeros((3, len(ones))),
                ),
            )


def tables(links: dict[tuple[str, ...], list[Links]]) -> Iterator[str]:
    """Lines of a table for each group, as Markdown."""
    methods = ("prediction", "distance alone", "path-loss fit")
    for group in GROUPS:
        base = home_errors(links[group, "nowhere", "0", "prediction"])
        accuracy, rmse_db = base.mean(axis=0)
        yield f"\n{group} ({len(base)} homes; without measurements {accuracy:.3f}, {rmse_db:.1f} dB)\n"
        yield f"| measured | number | {' | '.join(methods)} | calibration error | in the 90 % interval |"
        yield "|---" * 7 + "|"
        for where, numbers in {"nowhere": (0,), **WAY}.items():
            for number in map(str, numbers):
                cells = []
                for method in methods if where in WAY else methods[:1]:
                    change = home_errors(links[group, where, number, method]) - base
                    (d_accuracy, d_rmse), (s_accuracy, s_rmse) = (
                        change.mean(axis=0),
                        change.std(axis=0, ddof=1) / np.sqrt(len(change)),
                    )
                    cells.append(f"{d_accuracy:+.3f} ± {s_accuracy:.3f}, {d_rmse:+.1f} ± {s_rmse:.1f} dB")
                predictions, *truth = zip(*links[group, where, number, "prediction"], strict=True)
                every = measure(sp.LinkPrediction.concatenate(predictions), *map(np.concatenate, truth))
                cells += [""] * (3 - len(cells)) + [f"{every.calibration_error:.3f}", f"{every.coverage_90:.3f}"]
                yield f"| {where} | {number} | " + " | ".join(cells) + " |"


def home_errors(links: list[Links]) -> NDArray[np.float64]:
    """Accuracy and RMSE [dB] of each home (H, 2)."""
    found = [measure(*of_home) for of_home in links]
    return np.array([(each.accuracy, each.rmse_db) for each in found])


def unknown_transmitters(homes: list[tuple[str, sp.PartialMap]], step: int, count: int) -> None:
    """Find transmitters at unknown positions, and print the tables."""
    found, coverages = [], []
    for seed, (name, home) in enumerate(homes):
        rng = np.random.default_rng(seed)
        partial, way_m = explored(home, step, seed)
        places_m = way_m[np.unique(np.linspace(0, len(way_m) - 1, ON_THE_WAY).round().astype(int))]
        tx_m = points(home, partial, count, rng)
        tx_m = tx_m[np.linalg.norm(tx_m[:, None] - places_m, axis=2).min(axis=1) > NEAREST_M]
        gains_db = sp.trace_links(home, tx_m, places_m, progress=False).gain_db
        gains_db = np.maximum(gains_db + NOISE_DB * rng.standard_normal(gains_db.shape), SENSITIVITY_DB)
        predict = prediction_from(partial)
        measured = [sp.Measurements(None, places_m, each, sensitivity_db=SENSITIVITY_DB) for each in gains_db]
        for truth_m, known in zip(tx_m, measured, strict=True):
            seen = partial.state_at(truth_m[None])[0] == sp.CellState.FREE
            found.append([seen, *position_errors(partial, known, truth_m, predict)])
        coverages.append(coverage_errors(home, partial, tx_m[0], measured[0]))
        print(f"{name} done: {np.mean(found, axis=0).round(2)} {np.mean(coverages, axis=0).round(3)}", flush=True)
    print(
        "| transmitter | posterior | strongest | path-loss fit | in the 90 % region | its area |\n" + "|---" * 6 + "|"
    )
    rows = np.array(found)
    for group, of_group in (("all", rows), ("seen", rows[rows[:, 0] == 1]), ("unseen", rows[rows[:, 0] == 0])):
        cells = [f"{np.median(each):.1f}, {each.mean():.1f} m" for each in of_group[:, 1:4].T]
        inside, area_m2 = of_group[:, 4:].mean(axis=0)
        print(f"| {group} ({len(of_group)}) | " + " | ".join(cells) + f" | {inside:.2f} | {area_m2:.0f} m² |")
    methods = ("known", "known, measured", "unknown, measured")
    for method, values in zip(methods, np.swapaxes(coverages, 0, 1), strict=True):
        change = values - np.array(coverages)[:, 0]
        (accuracy, rmse_db), (d_accuracy, d_rmse) = values.mean(axis=0), change.std(axis=0, ddof=1) / len(homes) ** 0.5
        print(f"{method}: {accuracy:.3f}, {rmse_db:.1f} dB; change ± {d_accuracy:.3f}, {d_rmse:.1f} dB")


def prediction_from(partial: sp.PartialMap) -> Predict:
    """Links from a position, predicted once for all transmitters."""
    model, kept = sp.Predictor.load(), {}

    def predict(place_m, points_m):
        key = tuple(place_m)
        if key not in kept:
            phi = sp.link_features(partial, sp.trace_links(partial, place_m, points_m, progress=False))
            free = partial.state_at(points_m) == sp.CellState.FREE
            kept[key] = model.predict(phi), np.zeros(len(phi)), np.where(free, 1.0, model.predict_indoor(phi))
        return kept[key]

    return predict


def position_errors(
    partial: sp.PartialMap, measured: sp.Measurements, truth_m: NDArray[np.float64], predict: Predict
) -> list[float]:
    """Distances from the truth [m] of three estimates, whether the 90 % region has it, and the area of that [m^2]."""

    def allowed(points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        apart_m = np.linalg.norm(points_m[:, None] - measured.rx, axis=2)
        return clear_of_walls(partial, points_m) & (apart_m.min(axis=1) > 0.02)

    found = locate_transmitter(partial, measured, allowed, predict, lambda *_: None)
    points_m, region = found.points_m, likely_region(found.probability).ravel()
    possible = found.probability.ravel() > 0.0
    cell = np.where(possible, np.linalg.norm(points_m - truth_m, axis=1), np.inf).argmin()
    spacing_m = found.x_m[1] - found.x_m[0]
    log_m = np.log10(np.linalg.norm(points_m[:, None] - measured.rx, axis=2) + 1e-3)
    log_m -= log_m.mean(axis=1, keepdims=True)
    gain_db = measured.gain_db - measured.gain_db.mean()
    slope = np.minimum(log_m @ gain_db / (log_m**2).sum(axis=1), 0.0)
    square = ((gain_db - slope[:, None] * log_m) ** 2).sum(axis=1)
    fitted_m = points_m[np.where(possible, square, np.inf).argmin()]
    estimates = (found.position_m, measured.rx[measured.gain_db.argmax()], fitted_m)
    distances = [float(np.linalg.norm(each - truth_m)) for each in estimates]
    return [*distances, float(region[cell]), region.sum() * spacing_m**2]


def coverage_errors(
    home: sp.PartialMap, partial: sp.PartialMap, tx_m: NDArray[np.float64], measured: sp.Measurements
) -> list[tuple[float, float]]:
    """Accuracy and RMSE [dB] indoors: at the known position without and with measurements, at the unknown one with."""
    of_known = sp.Measurements(tx_m, measured.rx, measured.gain_db, sensitivity_db=SENSITIVITY_DB)
    options = {"spacing_m": SPACING_M, "progress": False}
    maps = [
        sp.predict_map(partial, tx_m, **options),
        sp.predict_map(partial, tx_m, measurements=of_known, **options),
        sp.predict_map(partial, measurements=measured, **options),
    ]
    truth = sp.predict_map(home, tx_m, **options)
    inside = truth.valid & (truth.cell_state == sp.CellState.FREE)
    for each in maps:
        inside &= each.valid
    inside = inside.to_numpy()
    return [
        (
            float((each.link_state.to_numpy() == truth.link_state.to_numpy())[inside].mean()),
            float(np.sqrt(((each.gain_mean_db - truth.gain_mean_db).to_numpy()[inside] ** 2).mean())),
        )
        for each in maps
    ]


if __name__ == "__main__":
    main()
