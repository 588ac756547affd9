"""Reports of evaluations: Evaluation -> report.md, report.json, stages.png, calibration.png."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sionna_partial.files import atomic_files
from sionna_partial.lab.datasets.table import stage_name
from sionna_partial.lab.evaluation import Difference, Evaluation, Row
from sionna_partial.lab.metrics import DEFINITIONS

REPORT_FILES = ("report.md", "report.json", "stages.png", "calibration.png")

_COLUMNS = {
    "links": ("links", "d"),
    "accuracy": ("accuracy ± error", ".3f"),
    "rmse_db": ("RMSE ± error [dB]", ".2f"),
    "rmse_linked_db": ("RMSE without outages", ".2f"),
    "nll_state": ("NLL state", ".3f"),
    "nll": ("NLL", ".3f"),
    "calibration_error": ("calibration error", ".3f"),
    "coverage_90": ("in 90 %", ".3f"),
}
_ERRORS = {"accuracy": "accuracy_error", "rmse_db": "rmse_error_db"}
_WHERE = {"indoor": "receivers indoors", "anywhere": "receivers anywhere on the map, outage outdoors"}
_ENDS_SEEN = {"all": "", "both": ", both ends seen", "one": ", one end seen", "none": ", no end seen"}
_MISSING = "-"
_ERROR = "standard error over homes of the figures of each home."


def summary(evaluation: Evaluation) -> str:
    """Return accuracy and gain error on test homes, a column per stage, as Markdown."""
    tables = []
    for receivers, title in _WHERE.items():
        rows = evaluation.select(homes="test", receivers=receivers, ends_seen="all")
        if rows:
            tables.append(f"### Test homes ({len(evaluation.homes['test'])}), {title}\n\n{_by_stage(rows)}")
    shown = "\n".join(f"{name}: {DEFINITIONS[key]}" for key, name in (("accuracy", "accuracy"), ("rmse_db", "RMSE")))
    shown += f"\n±: {_ERROR}"
    return "\n\n".join([*tables, shown, *evaluation.notes])


def markdown(evaluation: Evaluation) -> str:
    """Return the whole report, definitions first."""
    counts = " and ".join(f"{len(names)} {kind}" for kind, names in evaluation.homes.items())
    head = [
        f"# Evaluation of predictor `{evaluation.predictor}`",
        f"SHA-256 {evaluation.fingerprint}. {counts} homes of the data set; test homes are those that the predictor "
        "was not trained on.",
        *evaluation.notes,
        "\n".join(f"- **{_COLUMNS[name][0]}**: {text}" for name, text in DEFINITIONS.items()) + f"\n- **±**: {_ERROR}",
        f"`{_MISSING}` stands where there is no finite value, as of the likelihood of a gain that is predicted "
        "without standard deviation.",
    ]
    sections = [_section(evaluation, "test", ends_seen=ends) for ends in _ENDS_SEEN]
    if "train" in evaluation.homes:
        sections.append(_section(evaluation, "train"))
    for homes in evaluation.homes:
        if evaluation.select(homes=homes, receivers="anywhere", ends_seen="all"):
            sections.append(_section(evaluation, homes, "anywhere"))
    return "\n\n".join([*head, *sections, *_differences(evaluation)]) + "\n"


def as_json(evaluation: Evaluation) -> dict[str, Any]:
    """Return the report for JSON, with null for values that are not finite."""
    return {
        "predictor": evaluation.predictor,
        "sha256": evaluation.fingerprint,
        "homes": {kind: list(names) for kind, names in evaluation.homes.items()},
        "notes": list(evaluation.notes),
        "definitions": DEFINITIONS,
        "rows": [_without_nan({**asdict(row), "metrics": row.metrics.as_json()}) for row in evaluation.rows],
        "differences": [_without_nan(asdict(each)) for each in evaluation.differences],
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


def _without_nan(values: dict[str, Any]) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in values.items()}


def save_report(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write `REPORT_FILES`, all or none, and return them."""
    from sionna_partial.plots.result_plots import plot_reliability, plot_stages
    from sionna_partial.plots.style import figure_png

    text = json.dumps(as_json(evaluation), indent=2, allow_nan=False) + "\n"
    figures = figure_png(plot_stages(evaluation)), figure_png(plot_reliability(evaluation.calibrations))
    contents = (markdown(evaluation).encode(), text.encode(), *figures)
    with atomic_files(folder) as files:
        for name, content in zip(REPORT_FILES, contents, strict=True):
            (files / name).write_bytes(content)
    return [folder / name for name in REPORT_FILES]


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], *, names: int = 1) -> str:
    """Return a Markdown table, the first `names` columns to the left, figures to the right."""
    cells = [list(header), *map(list, rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    sides = [str.ljust] * names + [str.rjust] * (len(widths) - names)
    head, *lines = [[side(text, width) for side, text, width in zip(sides, row, widths, strict=True)] for row in cells]
    rule = ["-" * width for width in widths[:names]] + ["-" * (width - 1) + ":" for width in widths[names:]]
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *lines))


def _differences(evaluation: Evaluation) -> Iterable[str]:
    for receivers, where, first in (("indoor", "indoors", "predictor"), ("anywhere", "anywhere", "with indoor model")):
        rows = [each for each in evaluation.differences if each.receivers == receivers]
        if rows:
            title = f"Test homes, receivers {where}: {first} minus other, mean and standard error over homes"
            header = ["stage", "other", "homes", "accuracy", "RMSE [dB]"]
            yield f"### {title}\n\n{markdown_table(header, map(_difference_cells, rows), names=2)}"


def _by_stage(rows: Sequence[Row]) -> str:
    stages, models = (list(dict.fromkeys(getattr(row, name) for row in rows)) for name in ("stage", "model"))
    found = {(row.model, row.stage): f"{_measured(row, 'accuracy')}, {_measured(row, 'rmse_db')} dB" for row in rows}
    header = ["accuracy, RMSE", *(stage_name(stage) for stage in stages)]
    cells = ([model, *(found.get((model, stage), _MISSING) for stage in stages)] for model in models)
    return markdown_table(header, cells)


def _section(evaluation: Evaluation, homes: str, receivers: str = "indoor", ends_seen: str = "all") -> str:
    cells = [
        [stage_name(row.stage), row.model, *(_measured(row, name) for name in _COLUMNS)]
        for row in evaluation.select(homes=homes, receivers=receivers, ends_seen=ends_seen)
        if row.metrics.links
    ]
    table = markdown_table(["stage", "model", *(label for label, _ in _COLUMNS.values())], cells, names=2)
    return f"### {homes.capitalize()} homes, {_WHERE[receivers]}{_ENDS_SEEN[ends_seen]}\n\n{table}"


def _measured(row: Row, name: str) -> str:
    """Return a figure of merit, with its standard error if it has one."""
    form = _COLUMNS[name][1]
    text = _text(getattr(row.metrics, name), form)
    return f"{text} ± {_text(getattr(row, _ERRORS[name]), form)}" if name in _ERRORS else text


def _difference_cells(each: Difference) -> list[str]:
    pairs = ((each.accuracy, each.accuracy_error, ".3f"), (each.rmse_db, each.rmse_error_db, ".2f"))
    texts = [f"{value:+{form}} ± {_text(error, form)}" for value, error, form in pairs]
    return [stage_name(each.stage), each.baseline, str(each.homes), *texts]


def _text(value: float, form: str) -> str:
    return _MISSING if math.isnan(value) else format(value, form)
