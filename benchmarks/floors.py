r"""Predictors on the links of a data set: all and short ones, floor by floor, those in the unseen, and certain ones.

The data set is one of `sionna-partial dataset`. Further predictors are `.keras` files. Run

    sionna-partial dataset floors --homes 0 --map ../shared/floors --field-of-view 360 --range 12 \
        --stage 0 --stage 0.25 --stage 0.5 --stage 0.75 --short-links 0.5
    python benchmarks/floors.py floors
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.lab.datasets.table import LinkTable
from sionna_partial.lab.metrics import Metrics, measure

SHORT_M, WRONG_DB = 25.0, 0.5
"""Length of short links [m], and by how much a certain gain may be off [dB]."""

DISTANCES = 30
"""Number of intervals of distance, of as many links each."""


def main() -> None:
    """Print a table for each question."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("predictors", nargs="*", help="in addition to the shipped ones")
    arguments = parser.parse_args()
    links = sp.lab.read_dataset(arguments.dataset)
    links = links.take(~links.anywhere)
    found = {name: sp.Predictor.load(name).predict(links.phi) for name in ("map", "paper", *arguments.predictors)}
    groups = {"all links": np.ones(len(links.home), dtype=bool)}
    groups[f"shorter than {SHORT_M:g} m"] = links.phi.distance_m < SHORT_M
    groups |= {f"all links of {home}": links.home == home for home in np.unique(links.home)}
    for title, group in groups.items():
        print(f"\n{title}\n\n| stage | {' | '.join(found)} |\n|{'---|' * (1 + len(found))}")
        for stage in np.unique(links.stage):
            chosen = np.flatnonzero(group & (links.stage == stage))
            row = [text(rated(prediction, links, chosen)) for prediction in found.values()]
            print(f"| {stage:g} | {' | '.join(row)} |")
    unobserved(found, links)
    certain(found["map"], links)


def rated(prediction: sp.LinkPrediction, links: LinkTable, chosen: NDArray[np.intp]) -> Metrics:
    """Measure what is predicted of some links."""
    return measure(prediction.take(chosen), links.link_state[chosen], links.gain_db[chosen])


def text(metrics: Metrics) -> str:
    """Accuracy, RMSE and calibration error."""
    return f"{metrics.accuracy:.3f}, {metrics.rmse_db:.2f} dB, {metrics.calibration_error:.3f}"


def unobserved(found: dict[str, sp.LinkPrediction], links: LinkTable) -> None:
    """Print the RMSE of links with neither end observed, and over all links if all others were predicted exactly.

    Beside them stands the function of distance that fits the true gains of these links best.
    """
    context = links.phi.context
    assert context is not None
    neither = ~(context.tx_seen | context.rx_seen)
    print("\nneither end observed: RMSE [dB]; the RMSE over all links if the others were exact\n")
    print(f"| stage | fraction of links | {' | '.join(found)} | best of distance |")
    print("|---" * (3 + len(found)) + "|")
    for stage in np.unique(links.stage):
        here = links.stage == stage
        chosen = neither & here
        gain_db, fraction = links.gain_db[chosen], chosen.sum() / here.sum()
        fitted_db = np.empty(len(gain_db))
        for each in np.array_split(np.argsort(links.phi.distance_m[chosen]), DISTANCES):
            fitted_db[each] = gain_db[each].mean()
        guesses = [*(prediction.gain_mean_db[chosen] for prediction in found.values()), fitted_db]
        errors = [np.sqrt(np.mean((guess_db - gain_db) ** 2)) for guess_db in guesses]
        row = [f"{each:.2f}; {np.sqrt(fraction) * each:.2f}" for each in errors]
        print(f"| {stage:g} | {fraction:.2f} | {' | '.join(row)} |")


def certain(prediction: sp.LinkPrediction, links: LinkTable) -> None:
    """Print how often certain gains of links with both ends observed are wrong."""
    context = links.phi.context
    assert context is not None
    sure = (prediction.gain_std_db == 0.0) & context.tx_seen & context.rx_seen
    off_db = np.abs(prediction.gain_mean_db - links.gain_db)
    print(f"\n| stage | certain links with both ends observed | more than {WRONG_DB:g} dB off |\n|---|---|---|")
    for stage in np.unique(links.stage):
        here = sure & (links.stage == stage)
        print(f"| {stage:g} | {here.sum()} | {(off_db[here] > WRONG_DB).mean() if here.any() else 0.0:.2f} |")


if __name__ == "__main__":
    main()
