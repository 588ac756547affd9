"""Scores of predictions stage by stage, their paired differences over homes, and Markdown tables of them."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.datasets.link_table import LinkTable
from sionna_partial.evaluation.evaluate import home_scores, mean_and_error
from sionna_partial.evaluation.metrics import DEFINITIONS, Metrics, measure
from sionna_partial.files import atomic_write
from sionna_partial.reports import markdown_table

INDOORS = "Receivers were drawn indoors. A stage is the number of steps that the robot has explored."

DIFFERENCES = (
    "One minus the other on the same links: the mean over homes of the homes' differences ± its standard error, which "
    "knows nothing of how another training would have come out."
)


@dataclass(frozen=True, eq=False)
class StageScore:
    """How good an answer is at one stage: over all links, and over those of each home (H,)."""

    metrics: Metrics
    accuracies: NDArray[np.float64]
    rmses_db: NDArray[np.float64]


NAMES = {
    "accuracy": "accuracy",
    "rmse_db": "RMSE",
    "calibration_error": "calibration error",
    "coverage_90": "in 90 %",
}
"""What tables call the figures of merit."""

Scores = Mapping[int, StageScore]
"""By steps."""


def score(answer: sp.LinkPrediction, links: LinkTable) -> Scores:
    """Measure an answer for links at each of their stages."""
    scores = {}
    for step in map(int, np.unique(links.stage)):
        here = links.stage == step
        some, given = links.take(here), answer.take(here)
        scores[step] = StageScore(measure(given, some.link_state, some.gain_db), *home_scores(given, some))
    return scores


def stage_table(head: str, rows: Iterable[tuple[str, Scores]], cell: str) -> str:
    """Tabulate answers by stage; `cell` formats the figures of merit, such as "{accuracy:.3f}"."""
    named = list(rows)
    cells = ([name, *(cell.format(**vars(each.metrics)) for each in scores.values())] for name, scores in named)
    return markdown_table(stage_header(head, named[0][1]), cells)


def difference_tables(pairs: Sequence[tuple[str, Scores, Scores]]) -> str:
    """Tabulate the first scores minus the second by stage: accuracy, then RMSE."""
    tables = []
    for head, name, form in (("accuracy", "accuracies", "+.3f"), ("RMSE [dB]", "rmses_db", "+.2f")):
        rows = (
            [title, *(_difference(getattr(one[step], name), getattr(other[step], name), form) for step in one)]
            for title, one, other in pairs
        )
        tables.append(markdown_table(stage_header(head, pairs[0][1]), rows))
    return "\n\n".join(tables)


def stage_header(head: str, scores: Scores) -> list[str]:
    """Head of a table with a column for each stage."""
    return [head, *(f"{step} steps" for step in scores)]


def definitions(names: Iterable[str]) -> str:
    """Say what figures of merit are, a line for each."""
    return "\n".join(f"- {NAMES[name]}: {DEFINITIONS[name]}" for name in names)


def publish(report: str, out: Path | None) -> None:
    """Print a report, and write it to a file if one is given."""
    print(report)
    if out:
        with atomic_write(out, "w") as stream:
            stream.write(report + "\n")
        say(f"wrote {out}")


def say(message: str) -> None:
    """Report progress."""
    print(message, file=sys.stderr, flush=True)


def _difference(one: NDArray[np.float64], other: NDArray[np.float64], form: str) -> str:
    mean, error = mean_and_error(one - other)
    return f"{mean:{form}} ± " + ("-" if np.isnan(error) else f"{error:{form.removeprefix('+')}}")
