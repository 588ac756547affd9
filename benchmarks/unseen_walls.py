"""Gains through walls that were not seen, in four bands: the trace, multi-wall models, and the prediction.

A robot has explored each home for 0, 50, 100 and 200 steps; links are anywhere indoors, the truth is the trace of the
complete home through its walls, at 28 and 60 GHz as well. The table has the root mean square error [dB] of the traced
gain, of two multi-wall models, and of the prediction; the fractions of true gains within 1.645 standard deviations of
its mean, and in its central 90 % interval; and the calibration error of P(gain > threshold). Predictions contain the
deviation of measured powers from a trace (5.8 dB, `RESIDUAL_DB`), which a simulated truth does not have: the last three
columns are without it. A multi-wall model is free space less a factor times the losses of the walls that are known,
less a loss for each unobserved metre, less a constant. The three are fitted to the links of all other homes of the row,
or to the very links of the row, which no one can do beforehand. Procedural homes, or complete maps of a folder with one
folder each:

    python benchmarks/unseen_walls.py --homes 8 [--kind floor]
    python benchmarks/unseen_walls.py --maps ../shared/gibson --homes 20
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sionna_partial as sp
from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S, CellState, LinkState
from sionna_partial.lab.metrics import measure
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.prediction.features import LinkFeatures, link_features
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.settings import HOME_KINDS, HomeKind

BANDS_GHZ = {2.4: "brick", 5.0: "drywall", 28.0: "drywall", 60.0: "glass"}
STEPS = (0, 50, 100, 200)
LINKS, TRANSMITTERS, NEAREST_M = 80, 1, 0.3
WITHIN_90, BINS = 1.6449, np.linspace(0.0, 1.0, 16)
MOST_LOSS_DB = 60.0


class Links(NamedTuple):
    """Links of one transmitter at one step: number of the home, features, prediction and true gain."""

    home: int
    phi: LinkFeatures
    prediction: LinkPrediction
    true_db: np.ndarray

    def multi_wall(self, band_ghz: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the gain of free space (N,), and the terms (N, 3) that a multi-wall model subtracts [dB]."""
        distance_m, context = self.phi.distance_m, self.phi.context
        assert context is not None
        free_db = 20.0 * np.log10(SPEED_OF_LIGHT_M_S / (4e9 * np.pi * band_ghz * distance_m))
        known_db = np.clip(free_db - context.straight_gain_db, 0.0, MOST_LOSS_DB)
        return free_db, np.stack([known_db, self.phi.unobserved_distance_m, np.ones(len(distance_m))], axis=1)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", type=Path, metavar="FOLDER")
    parser.add_argument("--homes", type=int, default=8)
    parser.add_argument("--kind", choices=HOME_KINDS, help="of procedural homes")
    parser.add_argument("--first-seed", type=int, default=91_000)
    parser.add_argument("--predictor", metavar="NAME|FILE")
    arguments = parser.parse_args()
    rows = defaultdict(list)
    for seed, home in homes(arguments.maps, arguments.homes, arguments.first_seed, arguments.kind):
        for band_ghz, step, links in links_of(home, seed, arguments.predictor):
            rows[band_ghz, step].append(links)
    print_table(rows)


def print_table(rows: dict[tuple[float, int], list[Links]]) -> None:
    """Print a line for each band and step, from the links of each home."""
    columns = "band, walls", "steps", "links", "trace", "multi-wall", "multi-wall, fitted", "prediction"
    spreads = "within 1.645 std", "in central 90 %", "ECE of P(gain > t)"
    print("|", " | ".join([*columns, *spreads, *(f"{name}, without residual" for name in spreads)]), "|")
    print("|---" * (len(columns) + 2 * len(spreads)) + "|")
    for (band_ghz, step), parts in sorted(rows.items()):
        true_db, traced_db = (
            np.concatenate(each) for each in zip(*((p.true_db, p.phi.gain_db) for p in parts), strict=True)
        )
        prediction = LinkPrediction.concatenate([part.prediction for part in parts])
        found = [part.multi_wall(band_ghz) for part in parts]
        others = []
        for number, (free_db, losses) in enumerate(found):
            rest = [k for k, part in enumerate(parts) if part.home != parts[number].home] or [number]
            others.append(free_db + losses @ _fitted([found[k] for k in rest], [parts[k].true_db for k in rest]))
        free_db, losses = (np.concatenate(each) for each in zip(*found, strict=True))
        oracle_db = free_db + losses @ _fitted(found, [part.true_db for part in parts])
        answers = traced_db, np.concatenate(others), oracle_db, prediction.gain_mean_db
        figures = [f"{np.sqrt(np.mean((each - true_db) ** 2)):.2f}" for each in answers]
        spreads = [*_spreads(prediction, true_db), *_spreads(LinkPrediction.mixture(*prediction.materials), true_db)]
        what = f"{band_ghz:g} GHz, {BANDS_GHZ[band_ghz]} | {step} | {len(true_db)}"
        print(f"| {what} | {' | '.join([*figures, *spreads])} |", flush=True)


def _spreads(prediction: LinkPrediction, true_db: np.ndarray) -> tuple[str, str, str]:
    """Return fractions within 1.645 standard deviations and in the central 90 %, and the calibration error."""
    holds = np.mean(np.abs(prediction.gain_mean_db - true_db) <= WITHIN_90 * prediction.gain_std_db + 1e-6)
    state = np.where(true_db > GAIN_FLOOR_DB, LinkState.NLOS, LinkState.OUTAGE).astype(np.uint8)
    central = measure(prediction, state, true_db).coverage_90
    errors = [
        calibration_error(prediction, true_db, threshold) for threshold in np.quantile(true_db, (0.25, 0.5, 0.75))
    ]
    return f"{holds:.2f}", f"{central:.2f}", f"{np.mean(errors):.3f}"


def _fitted(found: list[tuple[np.ndarray, np.ndarray]], true_db: list[np.ndarray]) -> np.ndarray:
    """Return the constants (3,) of a multi-wall model that fit links best."""
    free_db, losses = (np.concatenate(each) for each in zip(*found, strict=True))
    return np.linalg.lstsq(losses, np.concatenate(true_db) - free_db, rcond=1e-3)[0]


def homes(
    folder: Path | None, count: int, first_seed: int, kind: HomeKind | None = None
) -> Iterator[tuple[int, sp.PartialMap]]:
    """Yield seeds of links and complete homes."""
    for index in range(count):
        if folder is None:
            yield first_seed + index, sp.make_home(first_seed + index, kind)
        else:
            yield index, sp.load_map(sorted(folder.glob("*/map.yaml"))[index])


def links_of(home: sp.PartialMap, seed: int, predictor: str | None = None) -> Iterator[tuple[float, int, Links]]:
    """Yield band, step and links of a home."""
    maps = sp.explore(home, steps=STEPS, seed=0)
    for band_ghz, material in BANDS_GHZ.items():
        settings = sp.TraceSettings(1e9 * band_ghz, refraction=True), sp.SceneSettings(material=material)
        for step, *found in _links(home, maps, settings, np.random.default_rng(seed), predictor):
            yield band_ghz, step, Links(seed, *found)


def _links(
    home: sp.PartialMap,
    maps: list[sp.PartialMap],
    settings: tuple[sp.TraceSettings, sp.SceneSettings],
    rng: np.random.Generator,
    predictor: str | None,
) -> Iterator[tuple[int, LinkFeatures, LinkPrediction, np.ndarray]]:
    """Yield number of steps, features, predictions and true gains of links from each transmitter."""
    models = [sp.LinkModel(each, predictor, *settings) for each in maps]
    points_m = cell_centres_m(home, np.argwhere(home.state == CellState.FREE))
    points_m = np.column_stack([points_m, np.full(len(points_m), 1.5)])
    points_m = points_m[home.radios_can_stand(points_m)]
    truth = sp.Simulation(home, *settings)
    for _ in range(TRANSMITTERS):
        tx_m, *others = rng.permutation(points_m)[: LINKS + 1]
        rx_m = np.array([each for each in others if np.linalg.norm(each - tx_m) > NEAREST_M])
        true_db = truth.links(tx_m, rx_m).gain_db
        for step, model in zip(STEPS, models, strict=True):
            stands = model.partial.radios_can_stand(rx_m)
            if model.partial.radios_can_stand(tx_m[None]).all() and stands.any():
                traced = model.simulation.links(tx_m, rx_m[stands], polarisations=1)
                phi = link_features(model.partial, traced)
                assert phi.context is not None
                yield step, phi, model.predict_features(phi), true_db[stands]


def calibration_error(prediction: LinkPrediction, true_db: np.ndarray, threshold_db: float) -> float:
    """Return the expected calibration error of P(gain > threshold) in 15 bins."""
    probability, above = prediction.probability_above(threshold_db), true_db > threshold_db
    index = np.clip(np.digitize(probability, BINS) - 1, 0, len(BINS) - 2)
    gaps = [abs(probability[index == k].sum() - above[index == k].sum()) for k in range(len(BINS) - 1)]
    return float(sum(gaps) / len(true_db))


if __name__ == "__main__":
    main()
