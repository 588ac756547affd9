"""Evaluations as text and files: Evaluation -> report.md, report.json, stages.png, calibration.png."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from sionna_partial.datasets.link_table import stage_name
from sionna_partial.evaluation.evaluate import Difference, Evaluation, Row
from sionna_partial.evaluation.metrics import DEFINITIONS, Metrics
from sionna_partial.files import atomic_files

REPORT_FILES = ("report.md", "report.json", "stages.png", "calibration.png")

_COLUMNS = {
    "links": ("links", "d"),
    "accuracy": ("accuracy", ".3f"),
    "rmse_db": ("RMSE [dB]", ".2f"),
    "rmse_linked_db": ("RMSE without outages", ".2f"),
    "nll_state": ("NLL state", ".3f"),
    "nll": ("NLL", ".3f"),
    "calibration_error": ("calibration error", ".3f"),
    "coverage_90": ("in 90 %", ".3f"),
}
_WHERE = {"indoor": "receivers indoors", "anywhere": "receivers anywhere on the map, outside in outage"}
_MISSING = "-"


def summary(evaluation: Evaluation) -> str:
    """Return accuracy and gain error on test homes, a column for each stage: what fits a terminal.

    Parameters
    ----------
    evaluation : Evaluation

    Returns
    -------
    str
        Markdown with aligned columns.
    """
    tables = []
    for receivers, title in _WHERE.items():
        rows = evaluation.select(homes="test", receivers=receivers, ends_seen="all")
        if rows:
            tables.append(f"### Test homes ({len(evaluation.homes['test'])}), {title}\n\n{_by_stage(rows)}")
    shown = "\n".join(f"{_COLUMNS[name][0]}: {DEFINITIONS[name]}" for name in ("accuracy", "rmse_db"))
    return "\n\n".join([*tables, shown, *evaluation.notes])


def markdown(evaluation: Evaluation) -> str:
    """Return the whole report, definitions first.

    Parameters
    ----------
    evaluation : Evaluation

    Returns
    -------
    str
    """
    counts = " and ".join(f"{len(names)} {kind}" for kind, names in evaluation.homes.items())
    head = [
        f"# Evaluation of predictor `{evaluation.predictor}`",
        f"SHA-256 {evaluation.fingerprint}. {counts} homes of the data set; test homes are those that the predictor "
        "was not trained on.",
        *evaluation.notes,
        "\n".join(f"- **{_COLUMNS[name][0]}**: {text}" for name, text in DEFINITIONS.items()),
        f"`{_MISSING}` stands where there is no finite value: a likelihood where a trace answers without spread, or a "
        "model holds a state impossible that occurs.",
    ]
    sections = [_metrics_section(evaluation, "test", ends_seen="all")]
    sections += [_metrics_section(evaluation, "test", ends_seen=ends) for ends in ("both", "one", "none")]
    if "train" in evaluation.homes:
        sections.append(_metrics_section(evaluation, "train", ends_seen="all"))
    return "\n\n".join([*head, *sections, *_anywhere(evaluation, evaluation.homes), *_differences(evaluation)]) + "\n"


def as_json(evaluation: Evaluation) -> dict[str, Any]:
    """Return the report as JSON has it: null where there is no finite value.

    Parameters
    ----------
    evaluation : Evaluation

    Returns
    -------
    dict
    """
    return {
        "predictor": evaluation.predictor,
        "sha256": evaluation.fingerprint,
        "homes": {kind: list(names) for kind, names in evaluation.homes.items()},
        "notes": list(evaluation.notes),
        "definitions": DEFINITIONS,
        "rows": [{**asdict(row), "metrics": row.metrics.as_json()} for row in evaluation.rows],
        "differences": [_finite(asdict(difference)) for difference in evaluation.differences],
        "calibration": {
            f"{stage:g}": {
                "links": calibration.state.links.tolist(),
                "confidence": calibration.state.confidence.tolist(),
                "accuracy": calibration.state.accuracy.tolist(),
                "gain_pit": calibration.gain_pit.tolist(),
            }
            for stage, calibration in evaluation.calibrations.items()
        },
    }


def save_report(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write `report.md`, `report.json`, `stages.png` and `calibration.png`, all or none.

    Parameters
    ----------
    evaluation : Evaluation
    folder : pathlib.Path

    Returns
    -------
    list of pathlib.Path
        The files.

    Raises
    ------
    OutputError
        If writing fails.
    """
    from sionna_partial.plots.evaluation_plot import plot_reliability, plot_stages
    from sionna_partial.plots.style import figure_png

    contents = (
        markdown(evaluation).encode(),
        (json.dumps(as_json(evaluation), indent=2, allow_nan=False) + "\n").encode(),
        figure_png(plot_stages(evaluation)),
        figure_png(plot_reliability(evaluation.calibrations)),
    )
    with atomic_files(folder) as place:
        for name, content in zip(REPORT_FILES, contents, strict=True):
            (place / name).write_bytes(content)
    return [folder / name for name in REPORT_FILES]


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], *, names: int = 1) -> str:
    """Lay out a Markdown table, its columns aligned for the eye.

    Parameters
    ----------
    header : sequence of str
    rows : iterable of sequences of str
        As long as `header`.
    names : int
        Number of columns, from the left, that are aligned to the left; the others hold figures.

    Returns
    -------
    str
    """
    cells = [list(header), *map(list, rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    sides = [str.ljust] * names + [str.rjust] * (len(widths) - names)
    head, *lines = [[side(text, width) for side, text, width in zip(sides, row, widths, strict=True)] for row in cells]
    rule = ["-" * width for width in widths[:names]] + ["-" * (width - 1) + ":" for width in widths[names:]]
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *lines))


def _metrics_section(evaluation: Evaluation, homes: str, ends_seen: str) -> str:
    whose = {"all": "", "both": ", both ends seen", "one": ", one end seen", "none": ", no end seen"}[ends_seen]
    rows = evaluation.select(homes=homes, receivers="indoor", ends_seen=ends_seen)
    return _section(f"{homes.capitalize()} homes, {_WHERE['indoor']}{whose}", rows)


def _anywhere(evaluation: Evaluation, kinds: Iterable[str]) -> Iterable[str]:
    """Sections on receivers that may be outside, of "test" or "train" homes."""
    for homes in kinds:
        rows = evaluation.select(homes=homes, receivers="anywhere", ends_seen="all")
        if rows:
            yield _section(f"{homes.capitalize()} homes, {_WHERE['anywhere']}", rows)


def _differences(evaluation: Evaluation) -> Iterable[str]:
    """Sections on paired differences."""
    for receivers, first in (("indoor", "predictor"), ("anywhere", "with indoor model")):
        rows = [each for each in evaluation.differences if each.receivers == receivers]
        if rows:
            where = "indoors" if receivers == "indoor" else "anywhere"
            title = f"Test homes, receivers {where}: {first} minus other, mean and standard error over homes"
            header = ["stage", "other", "homes", "accuracy", "RMSE [dB]"]
            yield f"### {title}\n\n{markdown_table(header, map(_difference_cells, rows), names=2)}"


def _by_stage(rows: Sequence[Row]) -> str:
    """Tabulate accuracy and gain error, a line for each answer and a column for each stage."""
    stages, answers = (list(dict.fromkeys(getattr(row, name) for row in rows)) for name in ("stage", "answer"))
    found = {(row.answer, row.stage): f"{row.metrics.accuracy:.3f} {row.metrics.rmse_db:5.2f} dB" for row in rows}
    header = ["accuracy, RMSE", *(stage_name(stage) for stage in stages)]
    cells = ([answer, *(found.get((answer, stage), _MISSING) for stage in stages)] for answer in answers)
    return markdown_table(header, cells)


def _section(title: str, rows: Sequence[Row]) -> str:
    header = ["stage", "answer", *(label for label, _ in _COLUMNS.values())]
    cells = ([stage_name(row.stage), row.answer, *_cells(row.metrics)] for row in rows if row.metrics.links)
    return f"### {title}\n\n{markdown_table(header, cells, names=2)}"


def _cells(metrics: Metrics) -> list[str]:
    values = {field.name: getattr(metrics, field.name) for field in fields(metrics)}
    return [_text(values[name], form) for name, (_, form) in _COLUMNS.items()]


def _difference_cells(each: Difference) -> list[str]:
    pairs = ((each.accuracy, each.accuracy_error, ".3f"), (each.rmse_db, each.rmse_error_db, ".2f"))
    texts = [f"{value:+{form}} ± {_text(error, form)}" for value, error, form in pairs]
    return [stage_name(each.stage), each.baseline, str(each.homes), *texts]


def _text(value: float, form: str) -> str:
    return _MISSING if math.isnan(value) else format(value, form)


def _finite(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}
