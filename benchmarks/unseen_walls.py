"""Gains through walls that were not seen, in four bands: the mean loss of walls, the trace, and a multi-wall model.

A robot has explored each home for 0, 50, 100 and 200 steps; links are anywhere indoors, the truth is the trace of the
complete home through its walls, at 28 and 60 GHz as well. The table has the root mean square error [dB] of the traced
gain, of a multi-wall model, and of the prediction, how often its 90 % interval holds the truth, and the calibration
error of P(gain > threshold). The multi-wall model is free space less a factor times the losses of the walls that are
known, less a loss for each unobserved metre, less a constant: all three are fitted to the very links of the row, which
no one can do beforehand. Procedural homes, or complete maps of a folder with one folder each:

    python benchmarks/unseen_walls.py --homes 8
    python benchmarks/unseen_walls.py --maps ../shared/gibson --homes 8
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import sionna_partial as sp
from sionna_partial.constants import SPEED_OF_LIGHT_M_S, CellState
from sionna_partial.maps.partial_map import cell_centres_m
from sionna_partial.prediction.predictor import LinkPrediction

BANDS_GHZ = {2.4: "brick", 5.0: "drywall", 28.0: "drywall", 60.0: "glass"}
STEPS = (0, 50, 100, 200)
LINKS, TRANSMITTERS, NEAREST_M = 80, 2, 0.3
WITHIN_90, BINS = 1.6449, np.linspace(0.0, 1.0, 16)
MOST_LOSS_DB = 60.0


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", type=Path, metavar="FOLDER")
    parser.add_argument("--homes", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=91_000)
    arguments = parser.parse_args()
    rows = defaultdict(list)
    for seed, home in homes(arguments.maps, arguments.homes, arguments.first_seed):
        maps = sp.explore(home, steps=STEPS, seed=0)
        for band_ghz, material in BANDS_GHZ.items():
            settings = sp.TraceSettings(1e9 * band_ghz, refraction=True), sp.SceneSettings(material=material)
            for step, links in _links(home, maps, settings, np.random.default_rng(seed)):
                rows[band_ghz, step].append(links)
    print(
        "| band, walls | steps | links | trace | multi-wall, fitted | prediction | 90 % interval | ECE of P(gain > t) |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for (band_ghz, step), parts in sorted(rows.items()):
        table = np.concatenate([part for part, _ in parts])
        prediction = LinkPrediction.concatenate([part for _, part in parts])
        true_db, traced_db, known_db, unseen_m, distance_m = table.T
        free_db = 20.0 * np.log10(SPEED_OF_LIGHT_M_S / (4e9 * np.pi * band_ghz * distance_m))
        inputs = np.stack([np.minimum(known_db, MOST_LOSS_DB), unseen_m, np.ones(len(table))], axis=1)
        fitted, *_ = np.linalg.lstsq(inputs, true_db - free_db, rcond=None)
        answers = traced_db, free_db + inputs @ fitted, prediction.gain_mean_db
        figures = [f"{np.sqrt(np.mean((each - true_db) ** 2)):.2f}" for each in answers]
        holds = np.mean(np.abs(prediction.gain_mean_db - true_db) <= WITHIN_90 * prediction.gain_std_db + 1e-6)
        errors = [
            calibration_error(prediction, true_db, threshold) for threshold in np.quantile(true_db, (0.25, 0.5, 0.75))
        ]
        what = f"{band_ghz:g} GHz, {BANDS_GHZ[band_ghz]} | {step} | {len(table)}"
        print(f"| {what} | {' | '.join(figures)} | {holds:.2f} | {np.mean(errors):.3f} |")


def homes(folder: Path | None, count: int, first_seed: int) -> Iterator[tuple[int, sp.PartialMap]]:
    """Yield seeds of links and complete homes."""
    for index in range(count):
        if folder is None:
            yield first_seed + index, sp.make_home(first_seed + index)
        else:
            yield index, sp.load_map(sorted(folder.glob("*/map.yaml"))[index])


def _links(
    home: sp.PartialMap,
    maps: list[sp.PartialMap],
    settings: tuple[sp.TraceSettings, sp.SceneSettings],
    rng: np.random.Generator,
) -> Iterator[tuple[int, tuple[np.ndarray, LinkPrediction]]]:
    """Yield, for each number of steps, columns of links and their prediction."""
    trace_settings, scene_settings = settings
    straight = replace(trace_settings, max_depth=0, diffraction=False)
    models = [(sp.LinkModel(each, None, *settings), sp.Simulation(each, straight, scene_settings)) for each in maps]
    points_m = cell_centres_m(home, np.argwhere(home.state == CellState.FREE))
    points_m = np.column_stack([points_m, np.full(len(points_m), 1.5)])
    points_m = points_m[home.radios_can_stand(points_m)]
    truth = sp.Simulation(home, *settings)
    for _ in range(TRANSMITTERS):
        tx_m, *others = rng.permutation(points_m)[: LINKS + 1]
        rx_m = np.array([each for each in others if np.linalg.norm(each - tx_m) > NEAREST_M])
        true_db = truth.links(tx_m, rx_m).gain_db
        for step, (model, direct) in zip(STEPS, models, strict=True):
            stands = model.partial.radios_can_stand(rx_m)
            if not (model.partial.radios_can_stand(tx_m[None]).all() and stands.any()):
                continue
            phi, found = model.features(tx_m, rx_m[stands]), model.predict(tx_m, rx_m[stands])
            distance_m = phi.distance_m
            free_db = 20.0 * np.log10(SPEED_OF_LIGHT_M_S / (4.0 * np.pi * trace_settings.frequency_hz * distance_m))
            known_db = free_db - direct.links(tx_m, rx_m[stands]).gain_db
            columns = true_db[stands], phi.gain_db, known_db, phi.unobserved_distance_m, distance_m
            yield step, (np.stack(columns, axis=1), found)


def calibration_error(prediction: LinkPrediction, true_db: np.ndarray, threshold_db: float) -> float:
    """Return the expected calibration error of P(gain > threshold) in 15 bins."""
    probability, above = prediction.probability_above(threshold_db), true_db > threshold_db
    index = np.clip(np.digitize(probability, BINS) - 1, 0, len(BINS) - 2)
    gaps = [abs(probability[index == k].sum() - above[index == k].sum()) for k in range(len(BINS) - 1)]
    return float(sum(gaps) / len(true_db))


if __name__ == "__main__":
    main()
