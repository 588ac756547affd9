"""Benefit of measured gains on a robot's trajectory for predictions on a half-explored home.

In every home a robot with a camera explores; transmitters and receivers are drawn indoors. Gains at N points on its
trajectory, equally spaced, or at N random points indoors, are traced in the complete home, with 2 dB of noise and a
sensitivity of -120 dB. Changes of accuracy and RMSE from the prediction without measurements are means over homes,
with the standard error over homes; homes with fewer than 30 links in a group are left out of it. Run it with

    python benchmarks/measurements.py ../shared/gibson/*/map.yaml
    python benchmarks/measurements.py --unknown --transmitters 12 ../shared/gibson/*/map.yaml

With --unknown the position of the transmitter is to be found from 20 gains on the way: its distance from the truth, how
often the 90 % region has it, and the distances of the strongest measurement and of a path-loss fit by grid search.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stock import drawn_points_m, given_homes

import sionna_partial as sp
from sionna_partial.constants import DEFAULT_HEIGHT_M
from sionna_partial.lab.metrics import measure
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.measurements.localisation import Predict, likely_region, locate_transmitter

Links = tuple[sp.LinkPrediction, NDArray[np.uint8], NDArray[np.float64]]

NOISE_DB, SENSITIVITY_DB = 2.0, -120.0
RECEIVERS, ON_THE_WAY = 200, 20
TRIALS = (("on the way", 5), ("on the way", ON_THE_WAY), ("anywhere indoors", 20))
"""Places and numbers of measured gains."""

GROUPS = ("all links", "transmitter unseen", "transmitter seen")
FEWEST_LINKS = 30
NEAREST_M = 0.1


@dataclass(frozen=True)
class Linked:
    """Links from one transmitter to N positions: truth, and the prediction without measurements."""

    rx_m: NDArray[np.float64]
    link_state: NDArray[np.uint8]
    gain_db: NDArray[np.float64]
    prior: sp.LinkPrediction


def main() -> None:
    """Measure all homes, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", type=Path, help="complete maps")
    parser.add_argument("--made", type=int, default=24, help="number of procedural homes without maps")
    parser.add_argument("--step", type=int, default=200, help="steps that the robot has explored")
    parser.add_argument("--transmitters", type=int, default=12, help="in each home")
    parser.add_argument("--unknown", action="store_true", help="find the position of the transmitter")
    arguments = parser.parse_args()
    homes = given_homes(arguments.maps, arguments.made)
    if arguments.unknown:
        unknown_transmitters(homes, arguments.step, arguments.transmitters)
        return
    links: dict[tuple[str, str, int], list[Links]] = defaultdict(list)
    for seed, (name, home) in enumerate(homes):
        for key, parts in home_links(home, arguments.step, arguments.transmitters, seed).items():
            predictions, *truth = zip(*parts, strict=True)
            of_home = (sp.LinkPrediction.concatenate(predictions), *map(np.concatenate, truth))
            if len(of_home[1]) >= FEWEST_LINKS:
                links[key].append(of_home)
        print(f"{name} done", flush=True)
    print_changes(links)


def home_links(home: sp.PartialMap, step: int, count: int, seed: int) -> dict[tuple[str, str, int], list[Links]]:
    """Return predictions, link states and gains [dB] by group, place and number of measurements."""
    rng = np.random.default_rng(seed)
    partial, way_m = explored(home, step, seed)
    links: dict[tuple[str, str, int], list[Links]] = defaultdict(list)
    anywhere_m, rx_m = (drawn_points_m(home, partial, number, rng) for number in (20, RECEIVERS))
    for tx_m in drawn_points_m(home, partial, count, rng):
        at, on_way, anywhere = (linked(home, partial, tx_m, each_m) for each_m in (rx_m, way_m, anywhere_m))
        seen = bool(partial.state_at(tx_m[None])[0] == sp.CellState.FREE)
        found = {("nowhere", 0): at.prior}
        for place, number in TRIALS:
            known = anywhere if place == "anywhere indoors" else on_way
            found[place, number] = measured(partial, tx_m, known, number, at, rng)
        for group in (GROUPS[0], GROUPS[1 + seen]):
            for key, prediction in found.items():
                links[group, *key].append((prediction, at.link_state, at.gain_db))
    return links


def explored(home: sp.PartialMap, step: int, seed: int) -> tuple[sp.PartialMap, NDArray[np.float64]]:
    """Return the map of a robot in a home, and the positions (W, 3) on its way [m]."""
    exploration = sp.explore_trajectory(home, (step,), seed)
    partial = exploration.maps[0]
    way_m = np.unique(exploration.poses[:, :2], axis=0, return_index=True)[1]
    way_m = np.insert(exploration.poses[np.sort(way_m), :2], 2, DEFAULT_HEIGHT_M, axis=1)
    return partial, way_m[home.radios_can_stand(way_m) & partial.radios_can_stand(way_m)]


def linked(home: sp.PartialMap, partial: sp.PartialMap, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> Linked:
    """Trace the links of a transmitter on the home and on the partial map, and predict them."""
    rx_m = rx_m[np.linalg.norm(rx_m - tx_m, axis=1) > NEAREST_M]
    truth = sp.trace_links(home, tx_m, rx_m)
    phi = sp.link_features(partial, sp.trace_links(partial, tx_m, rx_m))
    return Linked(rx_m, truth.link_state, truth.gain_db, sp.Predictor.load().predict(phi))


def measured(
    partial: sp.PartialMap, tx_m: NDArray[np.float64], known: Linked, number: int, at: Linked, rng: np.random.Generator
) -> sp.LinkPrediction:
    """Return the prediction at some positions with so many measured gains."""
    chosen = np.unique(np.linspace(0, len(known.rx_m) - 1, number).round().astype(int))
    gain_db = known.gain_db[chosen] + NOISE_DB * rng.standard_normal(len(chosen))
    heard_db = np.maximum(gain_db, SENSITIVITY_DB)
    gains = sp.Measurements(tx_m, known.rx_m[chosen], heard_db, sensitivity_db=SENSITIVITY_DB)
    return Assimilation.fit(partial, tx_m, gains, known.prior.take(chosen)).update(at.rx_m, at.prior)


def print_changes(links: dict[tuple[str, str, int], list[Links]]) -> None:
    """Print a row for each group, as Markdown."""
    print(f"| links | without | {' | '.join(f'{number} {place}' for place, number in TRIALS)} |\n" + "|---" * 5 + "|")
    for group in GROUPS:
        base = home_errors(links[group, "nowhere", 0])
        cells = ["{:.3f}, {:.1f} dB".format(*base.mean(axis=0))]
        for trial in TRIALS:
            change = home_errors(links[group, *trial]) - base
            mean, error = change.mean(axis=0), change.std(axis=0, ddof=min(1, len(change) - 1)) / np.sqrt(len(change))
            cells.append(f"{mean[0]:+.3f} ± {error[0]:.3f}, {mean[1]:+.1f} ± {error[1]:.1f} dB")
        print(f"| {group} ({len(base)} homes) | {' | '.join(cells)} |")


def home_errors(links: list[Links]) -> NDArray[np.float64]:
    """Return accuracy and RMSE [dB] of each home (H, 2)."""
    found = [measure(*of_home) for of_home in links]
    return np.array([(each.accuracy, each.rmse_db) for each in found])


def unknown_transmitters(homes: Iterable[tuple[str, sp.PartialMap]], step: int, count: int) -> None:
    """Find transmitters at unknown positions, and print the table."""
    found = []
    for seed, (name, home) in enumerate(homes):
        rng = np.random.default_rng(seed)
        partial, way_m = explored(home, step, seed)
        places_m = way_m[np.unique(np.linspace(0, len(way_m) - 1, ON_THE_WAY).round().astype(int))]
        tx_m = drawn_points_m(home, partial, count, rng)
        tx_m = tx_m[np.linalg.norm(tx_m[:, None] - places_m, axis=2).min(axis=1) > NEAREST_M]
        gains_db = sp.trace_links(home, tx_m, places_m, progress=False).gain_db
        gains_db = np.maximum(gains_db + NOISE_DB * rng.standard_normal(gains_db.shape), SENSITIVITY_DB)
        predict = prediction_from(partial)
        for truth_m, gain_db in zip(tx_m, gains_db, strict=True):
            known = sp.Measurements(None, places_m, gain_db, sensitivity_db=SENSITIVITY_DB)
            seen = partial.state_at(truth_m[None])[0] == sp.CellState.FREE
            found.append([seen, *position_errors(partial, known, truth_m, predict)])
        print(f"{name} done", flush=True)
    print("| transmitter | posterior | strongest | path-loss fit | in the 90 % region |\n" + "|---" * 5 + "|")
    rows = np.array(found)
    for seen in np.unique(rows[:, 0])[::-1]:
        of_group = rows[rows[:, 0] == seen]
        cells = [f"{np.median(each):.1f}, {each.mean():.1f} m" for each in of_group[:, 1:4].T]
        print(
            f"| {'seen' if seen else 'unseen'} ({len(of_group)}) | "
            + " | ".join(cells)
            + f" | {of_group[:, 4].mean():.2f} |"
        )


def prediction_from(partial: sp.PartialMap) -> Predict:
    """Return a function that predicts links from a position, each once for all transmitters."""
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
    """Return distances from the truth [m] of three estimates, and whether the 90 % region has it."""

    def allowed(points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        apart_m = np.linalg.norm(points_m[:, None] - measured.rx, axis=2)
        return partial.radios_can_stand(points_m) & (apart_m.min(axis=1) > 0.02)

    found = locate_transmitter(partial, measured, allowed, predict, lambda *_: None)
    points_m, region = found.points_m, likely_region(found.probability).ravel()
    possible = found.probability.ravel() > 0.0
    cell = np.where(possible, np.linalg.norm(points_m - truth_m, axis=1), np.inf).argmin()
    log_m = np.log10(np.linalg.norm(points_m[:, None] - measured.rx, axis=2) + 1e-3)
    log_m -= log_m.mean(axis=1, keepdims=True)
    gain_db = measured.gain_db - measured.gain_db.mean()
    slope = np.minimum(log_m @ gain_db / (log_m**2).sum(axis=1), 0.0)
    square = ((gain_db - slope[:, None] * log_m) ** 2).sum(axis=1)
    fitted_m = points_m[np.where(possible, square, np.inf).argmin()]
    estimates = (found.position_m, measured.rx[measured.gain_db.argmax()], fitted_m)
    distances = [float(np.linalg.norm(each - truth_m)) for each in estimates]
    return [*distances, float(region[cell])]


if __name__ == "__main__":
    main()
