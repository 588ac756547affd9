"""Train the shipped predictor, the paper's, on procedural homes, and measure it on homes that it has not seen.

In every home a robot explores; each link is traced on the complete home, which is the truth, and on what the robot has
seen after 0, 50, 100, 150 and 200 steps, which gives the features. Training and held-out homes are disjoint. The same
arguments give the same file. Run it with

    python benchmarks/train_paper_predictor.py
"""

import argparse
import multiprocessing
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial as bind
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sionna_partial.constants import DEFAULT_HEIGHT_M, GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.learning.features import LinkFeatures, link_features
from sionna_partial.learning.fitting import PredictorSettings
from sionna_partial.learning.networks import free_space_gain_db
from sionna_partial.learning.predictor import LinkPrediction, Predictor
from sionna_partial.maps.explore import explore
from sionna_partial.maps.homes import make_home
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.tracing.trace import trace_links

STAGES = (0, 50, 100, 150, 200)
FIRST_HOME = 10_000
TRANSMITTERS = 2
NEAREST_M = 0.1
INTERVAL = (0.05, 0.95)
MODELS = ("predictor", "distance only", "majority", "partial trace")


@dataclass(frozen=True)
class Links:
    """N links at all stages of exploration: features, truth, and where the receiver was drawn."""

    stage: NDArray[np.int64]
    phi: LinkFeatures
    link_state: NDArray[np.uint8]
    gain_db: NDArray[np.float64]
    inside: NDArray[np.bool_]
    uniform: NDArray[np.bool_]

    def take(self, index: NDArray[np.generic]) -> "Links":
        """Return the links that a mask or index array selects."""
        return Links(*(_take(getattr(self, field.name), index) for field in fields(self)))

    @classmethod
    def concatenate(cls, parts: Iterable["Links"]) -> "Links":
        """Return the links of all parts."""
        columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(cls)}
        phi = LinkFeatures.concatenate(columns.pop("phi"))
        return cls(phi=phi, **{name: np.concatenate(values) for name, values in columns.items()})


def main() -> None:
    """Make the links, train, measure, print the table, and write the predictor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=100, help="training homes")
    parser.add_argument("--held-out", type=int, default=40, help="homes to measure on")
    parser.add_argument("--links", type=int, default=400, help="links in a home, traced at each stage")
    parser.add_argument("--steps", type=int, default=PredictorSettings.steps, help="gradient steps of each network")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=PREDICTORS_FOLDER / "paper.keras")
    arguments = parser.parse_args()
    first = FIRST_HOME + 1000 * arguments.seed
    seeds = range(first, first + arguments.homes + arguments.held_out)
    homes = make_links(seeds, arguments.links, arguments.workers)
    train, test = Links.concatenate(homes[: arguments.homes]), Links.concatenate(homes[arguments.homes :])
    names = [f"make_home({seed})" for seed in seeds]
    settings = PredictorSettings(steps=arguments.steps, seed=arguments.seed)
    predictor, metrics = train_and_measure(train, test, names[: arguments.homes], settings)
    metrics = {"held_out_homes": names[arguments.homes :], "exploration_steps": metrics}
    replace(predictor, metrics=metrics).save(arguments.out)
    print(f"wrote {arguments.out}, SHA-256 {predictor.fingerprint}")


def make_links(seeds: range, count: int, workers: int) -> list[Links]:
    """Make the links of all homes, in processes of their own."""
    start, homes = time.monotonic(), []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        for links in pool.map(bind(home_links, count=count), seeds):
            homes.append(links)
            print(f"home {len(homes)} of {len(seeds)}, {time.monotonic() - start:.0f} s", flush=True)
    return homes


def home_links(seed: int, count: int) -> Links:
    """Trace `count` links with indoor receivers, and as many with receivers anywhere on the map, at every stage."""
    home, rng = make_home(seed), np.random.default_rng(seed)
    stages = explore(home, steps=STAGES, seed=seed)
    tx_m = points_in(home.state == CellState.FREE, TRANSMITTERS, home, rng)
    share = count // TRANSMITTERS
    parts = []
    for tx in tx_m:
        free, anywhere = home.state == CellState.FREE, home.state != CellState.WALL
        rx_m = np.concatenate([points_in(free, share, home, rng), points_in(anywhere, share, home, rng)])
        uniform = np.arange(len(rx_m)) >= share
        apart = np.linalg.norm(rx_m - tx, axis=1) >= NEAREST_M
        rx_m, uniform = rx_m[apart], uniform[apart]
        truth, inside = trace_links(home, tx, rx_m), home.state_at(rx_m) == CellState.FREE
        for step, seen in zip(STAGES, stages, strict=True):
            phi = link_features(seen, trace_links(seen, tx, rx_m))
            parts.append(Links(np.full(len(rx_m), step), phi, truth.link_state, truth.gain_db, inside, uniform))
    return Links.concatenate(parts)


def points_in(cells: NDArray[np.bool_], count: int, home: PartialMap, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw points (count, 3) uniformly from cells, a fifth of a cell off their borders."""
    rows, columns = np.nonzero(cells)
    index = rng.integers(len(rows), size=count)
    places = np.stack([columns[index], rows[index]], axis=1) + rng.uniform(0.2, 0.8, (count, 2))
    height_m = np.full((count, 1), DEFAULT_HEIGHT_M)
    return np.concatenate([home.origin_m + places * home.resolution_m, height_m], axis=1)


def train_and_measure(
    train: Links, test: Links, names: list[str], settings: PredictorSettings
) -> tuple[Predictor, dict[str, dict[str, dict[str, float]]]]:
    """Train on some homes; measure on others, stage by stage, beside three simpler answers."""
    indoors, anywhere = train.take(~train.uniform), train.take(train.uniform)
    start = time.monotonic()
    predictor = Predictor.fit(indoors.phi, indoors.link_state, indoors.gain_db, homes=names, settings=settings)
    predictor = predictor.fit_indoor(anywhere.phi, anywhere.inside)
    blind = Predictor.fit(nothing_seen(indoors.phi), indoors.link_state, indoors.gain_db, settings=settings)
    print(f"trained on {len(indoors.phi)} links in {time.monotonic() - start:.0f} s")
    metrics = {}
    for step in STAGES:
        here = test.take((test.stage == step) & ~test.uniform)
        answers = (
            predictor.predict(here.phi),
            blind.predict(nothing_seen(here.phi)),
            majority(indoors, len(here.phi)),
            LinkPrediction.of_trace(here.phi),
        )
        metrics[str(step)] = {name: measure(answer, here) for name, answer in zip(MODELS, answers, strict=True)}
        around = test.take((test.stage == step) & test.uniform)
        right = (predictor.predict_indoor(around.phi) > 0.5) == around.inside
        metrics[str(step)]["indoor"] = {"accuracy": float(right.mean()), "share": float(around.inside.mean())}
    print_table(metrics)
    return predictor, metrics


def nothing_seen(phi: LinkFeatures) -> LinkFeatures:
    """Return the features of the same links on an empty map, where distance is all that is known."""
    gain_db = np.maximum(free_space_gain_db(phi.distance_m, PredictorSettings().frequency_hz), GAIN_FLOOR_DB)
    return LinkFeatures(np.full(len(phi), LinkState.LOS), phi.distance_m, phi.distance_m, gain_db)


def majority(train: Links, count: int) -> LinkPrediction:
    """Answer with the shares, means and spreads of the link states in training, whatever the link."""
    cells = [train.gain_db[train.link_state == state] for state in LinkState]
    columns = ([len(cell) / len(train.gain_db), cell.mean(), cell.std()] for cell in cells)
    return LinkPrediction.of_parts(
        *(np.repeat(np.array(row)[:, None], count, axis=1) for row in zip(*columns, strict=True))
    )


def measure(answer: LinkPrediction, links: Links) -> dict[str, float]:
    """Return accuracy, RMSE [dB], negative log-likelihood of (state, gain) [nat], and coverage of the 90 % interval."""
    result = {
        "accuracy": float((answer.link_state == links.link_state).mean()),
        "rmse_db": float(np.sqrt(np.mean((answer.gain_mean_db - links.gain_db) ** 2))),
    }
    if answer.gain_std_db.any():
        result |= {
            "nll": float(-log_likelihood(answer, links).mean()),
            "coverage_90": float(interval_coverage(answer, links).mean()),
        }
    return result


def log_likelihood(answer: LinkPrediction, links: Links) -> NDArray[np.float64]:
    """Log-likelihood (N,) of true link state and, unless it is outage, true gain."""
    los, nlos = links.link_state == LinkState.LOS, links.link_state == LinkState.NLOS
    p = np.select([los, nlos], [answer.p_los, answer.p_nlos], answer.p_outage)
    mean = np.where(los, answer.gain_los_mean_db, answer.gain_nlos_mean_db)
    std = np.where(los, answer.gain_los_std_db, answer.gain_nlos_std_db)
    density = -0.5 * ((links.gain_db - mean) / std) ** 2 - np.log(std * np.sqrt(2.0 * np.pi))
    return np.log(np.maximum(p, 1e-12)) + np.where(los | nlos, density, 0.0)


def interval_coverage(answer: LinkPrediction, links: Links) -> NDArray[np.float64]:
    """Share (N,) of the probability integral transform of the true gain in the central 90 %; 0.9 when calibrated.

    The transform of an outage, a point mass, is uniform between 0 and its probability.
    """
    low, high = INTERVAL
    below = answer.p_outage + sum(
        p * ndtr((links.gain_db - mean) / std)
        for p, mean, std in (
            (answer.p_los, answer.gain_los_mean_db, answer.gain_los_std_db),
            (answer.p_nlos, answer.gain_nlos_mean_db, answer.gain_nlos_std_db),
        )
    )
    mass = np.clip(np.minimum(answer.p_outage, high) - low, 0.0, None) / np.maximum(answer.p_outage, 1e-12)
    return np.where(links.link_state == LinkState.OUTAGE, mass, (below >= low) & (below <= high))


def print_table(metrics: dict[str, dict[str, dict[str, float]]]) -> None:
    """Print one row for each stage and model."""
    print(f"\n{'steps':>5}  {'held-out homes':16}{'accuracy':>9}{'RMSE [dB]':>11}{'NLL':>8}{'in 90 %':>9}")
    for step, models in metrics.items():
        for name in MODELS:
            row = models[name]
            rest = f"{row['nll']:8.2f}{row['coverage_90']:9.3f}" if "nll" in row else f"{'-':>8}{'-':>9}"
            print(f"{step:>5}  {name:16}{row['accuracy']:9.3f}{row['rmse_db']:11.2f}{rest}")
        indoor = models["indoor"]
        print(f"{step:>5}  indoors or not  {indoor['accuracy']:9.3f}  ({indoor['share']:.3f} are indoors)")


def _take(values: LinkFeatures | NDArray[np.generic], index: NDArray[np.generic]) -> object:
    return values.take(index) if isinstance(values, LinkFeatures) else values[index]


if __name__ == "__main__":
    main()
