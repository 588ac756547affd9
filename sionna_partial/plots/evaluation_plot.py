"""Figure of how good a predictor and simpler answers are at each stage of exploration."""

import itertools
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sionna_partial.evaluation.evaluate import Evaluation, Row
from sionna_partial.settings import require

_PANELS = {
    "accuracy": "accuracy of the link state",
    "rmse_db": "RMSE of the path gain [dB]",
    "rmse_linked_db": "RMSE without outages [dB]",
}
_COLOURS = ("#004488", "#ee6677", "#228833", "#bbbbbb", "#ccbb44", "#66ccee", "#aa3377")
"""Paul Tol's bright colours, the predictor's darkened, for all answers that `evaluate` compares."""

_STYLES: dict[str, dict[str, Any]] = {
    "test": {"marker": "o", "linestyle": "-"},
    "train": {"marker": "s", "linestyle": "--", "fillstyle": "none"},
}


def plot_stages(evaluation: Evaluation) -> Figure:
    """Draw accuracy and gain errors against the steps of exploration, receivers indoors (paper, Fig. 6).

    The predictor and every baseline have a colour each. Solid lines are test homes; the dashed line is the predictor
    on its training homes.

    Parameters
    ----------
    evaluation : Evaluation

    Returns
    -------
    matplotlib.figure.Figure
        Not known to pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        If nothing was measured on links with receivers indoors.
    """
    rows = [row for row in evaluation.select(receivers="indoor", ends_seen="all") if row.metrics.links]
    require(len(rows) > 0, "evaluation.rows", (), "evaluate links with receivers drawn indoors.")
    figure = Figure(figsize=(12.0, 4.0), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(_PANELS))
    for axis, (name, label) in zip(axes, _PANELS.items(), strict=True):
        _draw(axis, rows, name)
        axis.set(xlabel="steps, or observed fraction", title=label)
        axis.set_ylim(0.0, 1.0 if name == "accuracy" else None)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    return figure


def _draw(axis: Axes, rows: list[Row], name: str) -> None:
    """Draw one figure of merit: a line for each answer."""
    answers = list(dict.fromkeys(row.answer for row in rows))
    for answer, colour in zip(answers, itertools.cycle(_COLOURS), strict=False):
        for homes, style in _STYLES.items():
            some = [row for row in rows if (row.answer, row.homes) == (answer, homes)]
            if not some or (homes == "train" and answer != "predictor"):
                continue
            points = [(row.stage, getattr(row.metrics, name)) for row in some]
            label = answer if homes == "test" else f"{answer}, training homes"
            axis.plot(*zip(*points, strict=True), color=colour, label=label, markersize=4, **style)
    axis.set_xticks(sorted({row.stage for row in rows}))
    axis.grid(alpha=0.3)
