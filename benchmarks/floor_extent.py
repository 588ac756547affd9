"""Whether floor and ceiling should reach beyond what the robot has seen: two data sets of the same links, side by side.

In one, partial maps have floor and ceiling in the observed area alone, in the other over the whole map. Each trains the
paper's predictor on the same homes; it and the partial trace alone are measured on the homes held out, and compared
home by home. The data sets are built in FOLDER, or gone on with, or those that are there already are read. Run it with

    python benchmarks/floor_extent.py --folder build/floor --homes 150
    python benchmarks/floor_extent.py --read build/floor/observed build/floor/map
"""

import argparse
import json
from pathlib import Path
from typing import Literal

import numpy as np
from stage_scores import DIFFERENCES, INDOORS, Scores, definitions, difference_tables, publish, say, score, stage_table

import sionna_partial as sp
from sionna_partial.datasets.dataset import build_dataset
from sionna_partial.datasets.dataset_links import open_links
from sionna_partial.datasets.link_table import LinkTable
from sionna_partial.datasets.shards import INDEX_FILE
from sionna_partial.settings import DatasetSettings, SceneSettings
from sionna_partial.training import split_homes

Extent = Literal["observed", "map"]

EXTENTS: tuple[Extent, Extent] = ("observed", "map")
"""What floor and ceiling of partial maps span: what the robot has seen, or the whole map."""

SEED = 0
"""Of the split of the homes, and of the trainings."""

SAME_DB = 0.5
"""Gains that differ by no more are the same [dB]."""


def main() -> None:
    """Build or read both data sets, train, measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("build/floor_extent"), help="where data sets are built")
    parser.add_argument("--homes", type=int, default=150, help="to build")
    parser.add_argument("--first-seed", type=int, default=10_000, help="of these homes")
    parser.add_argument("--read", type=Path, nargs=2, metavar=("OBSERVED", "MAP"), help="data sets to read instead")
    parser.add_argument("--test-share", type=float, default=0.3, help="share of the homes that is held out")
    parser.add_argument("--out", type=Path, help="Markdown file to write")
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.homes)
    folders = arguments.read or [build(arguments.folder / extent, extent, seeds) for extent in EXTENTS]
    tables = same_links(*(read(*pair) for pair in zip(folders, EXTENTS, strict=True)))
    train_homes, test_homes = split_homes(sorted(set(map(str, tables[0].home))), arguments.test_share, SEED)
    if not test_homes:
        raise SystemExit(f"--test-share {arguments.test_share:g} leaves no home to measure on: give more than 0.")
    scores = {}
    for extent, links in zip(EXTENTS, tables, strict=True):
        say(f"floor and ceiling: {extent}, training on {len(train_homes)} homes, measuring on {len(test_homes)}")
        scores[extent] = measured(links, train_homes, test_homes)
    report = "\n\n".join([introduction(tables, train_homes, test_homes), *result(scores)])
    publish(report, arguments.out)


def build(folder: Path, extent: Extent, seeds: range) -> Path:
    """Build a data set, or go on with it."""
    settings = DatasetSettings(scene=SceneSettings(floor_extent=extent))
    report = build_dataset(
        folder, seeds, settings, progress=lambda done, homes, message: say(f"{extent}: {done} of {homes}, {message}")
    )
    for name, reason in report.failed.items():
        say(f"{name} failed, it is left out: {reason.splitlines()[0]}")
    return folder


def read(folder: Path, extent: Extent) -> LinkTable:
    """Read the links of a data set whose receivers were drawn indoors."""
    say(f"reading {folder}")
    links, _ = open_links(folder)
    index = json.loads((folder / INDEX_FILE).read_text(encoding="utf-8"))
    found = index["settings"]["scene"]["floor_extent"]
    if found != extent:
        raise SystemExit(f"--read: floor and ceiling of {folder} are {found!r}: give the data set with {extent!r}.")
    return links.take(~links.anywhere)


def same_links(observed: LinkTable, whole: LinkTable) -> tuple[LinkTable, LinkTable]:
    """Take the homes that both data sets have, and check that their links are the same."""
    homes = np.intersect1d(observed.home, whole.home)
    one, other = (links.take(np.isin(links.home, homes)) for links in (observed, whole))
    same = len(one) == len(other) > 0 and np.array_equal(one.home, other.home)
    if not same or any(
        not np.array_equal(getattr(one.context, end), getattr(other.context, end)) for end in ("tx_m", "rx_m")
    ):
        raise SystemExit("--read: the data sets have other links: build both from the same homes, with the same seed.")
    return one, other


def measured(links: LinkTable, train_homes: tuple[str, ...], test_homes: tuple[str, ...]) -> dict[str, Scores]:
    """Train the paper's predictor, and measure it and the partial trace on other homes."""
    learned, asked = (links.take(np.isin(links.home, homes)) for homes in (train_homes, test_homes))
    predictor = sp.Predictor.fit(learned.phi, learned.link_state, learned.gain_db, homes=train_homes)
    return {
        "partial trace": score(sp.LinkPrediction.of_trace(asked.phi), asked),
        "paper's predictor": score(predictor.predict(asked.phi), asked),
    }


def introduction(tables: tuple[LinkTable, LinkTable], train_homes: tuple[str, ...], test_homes: tuple[str, ...]) -> str:
    """Say what was done, and how far the truth is the same."""
    observed, whole = tables
    other_gain = np.abs(observed.gain_db - whole.gain_db) > SAME_DB
    other_truth = np.mean((observed.link_state != whole.link_state) | other_gain)
    return (
        "# Whether floor and ceiling reach beyond the observed area\n\n"
        f"{len(train_homes)} homes to train on, {len(test_homes)} others to measure on; both data sets have the same "
        f"{len(observed)} links. {INDOORS} Each is measured against the trace of the complete home with its own floor "
        f"and ceiling; these two truths differ in state, or by more than {SAME_DB:g} dB, in {100 * other_truth:.2f} % "
        "of the links."
    )


def result(scores: dict[Extent, dict[str, Scores]]) -> list[str]:
    """Tabulate scores, and their paired differences over homes."""
    observed, whole = (scores[extent] for extent in EXTENTS)
    rows = [(f"{name}, {extent}", scores[extent][name]) for name in observed for extent in EXTENTS]
    pairs = [(f"{name}, map minus observed", whole[name], observed[name]) for name in observed]
    return [
        stage_table("accuracy, RMSE [dB]", rows, "{accuracy:.3f}, {rmse_db:.2f}"),
        DIFFERENCES,
        difference_tables(pairs),
        definitions(("accuracy", "rmse_db")),
    ]


if __name__ == "__main__":
    main()
