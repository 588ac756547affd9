"""Figures of an evaluation: figures of merit at each stage of exploration, and calibration of the probabilities."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from sionna_partial.checks import require
from sionna_partial.datasets.link_table import stage_name
from sionna_partial.evaluation.evaluate import Evaluation, Row
from sionna_partial.evaluation.metrics import CONFIDENCE_BINS, PIT_BINS, Calibration
from sionna_partial.plots.style import BLUE, Figure

_PANELS = {
    "accuracy": "accuracy of the link state",
    "rmse_db": "RMSE of the path gain [dB]",
    "rmse_linked_db": "RMSE without outages [dB]",
}
_COLOURS = (BLUE, "#ee6677", "#228833", "#bbbbbb", "#ccbb44", "#66ccee", "#aa3377", "#000000")
"""Paul Tol's bright colours, the predictor's darkened, and black, for all that `evaluate` compares."""

_STYLES: dict[str, dict[str, Any]] = {
    "test": {"marker": "o", "linestyle": "-"},
    "train": {"marker": "s", "linestyle": "--", "fillstyle": "none"},
}
_IDEAL: dict[str, Any] = {"color": "0.3", "linewidth": 0.9, "linestyle": "--"}


def plot_stages(evaluation: Evaluation) -> Figure:
    """Draw accuracy and gain errors against the stage of exploration, receivers indoors (paper, Fig. 6).

    The predictor and every baseline have a colour each. Solid lines are test homes; the dashed line is the predictor
    on its training homes.
    """
    rows = [row for row in evaluation.select(receivers="indoor", ends_seen="all") if row.metrics.links]
    require(len(rows) > 0, "evaluation.rows", (), "evaluate links with receivers drawn indoors.")
    figure = Figure(figsize=(12.0, 4.0), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(_PANELS))
    for axis, (name, label) in zip(axes, _PANELS.items(), strict=True):
        _draw_lines(axis, rows, name)
        axis.set(xlabel="steps, or observed fraction", title=label)
        axis.set_ylim(0.0, 1.0 if name == "accuracy" else None)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    return figure


def _draw_lines(axis: Axes, rows: list[Row], name: str) -> None:
    """Draw one figure of merit."""
    models = list(dict.fromkeys(row.model for row in rows))
    for model, colour in zip(models, itertools.cycle(_COLOURS), strict=False):
        for homes, style in _STYLES.items():
            some = [row for row in rows if (row.model, row.homes) == (model, homes)]
            if some and (homes == "test" or model == "predictor"):
                label = model if homes == "test" else f"{model}, training homes"
                points = zip(*((row.stage, getattr(row.metrics, name)) for row in some), strict=True)
                axis.plot(*points, color=colour, label=label, markersize=4, **style)
    axis.set_xticks(sorted({row.stage for row in rows}))
    axis.grid(alpha=0.3)


def plot_reliability(stages: Mapping[float, Calibration]) -> Figure:
    """Draw reliability diagrams of the link state (above) and histograms of the gain's transform (below), by stage.

    In a reliability diagram, discs of calibrated states lie on the dashed line; the area of a disc is its number of
    links. In a histogram, a calibrated gain fills all bins up to the dashed line; a hill is a standard deviation too
    large, a bowl one too small, a slope a mean that is too high (falling) or too low (rising).
    """
    require(len(stages) > 0, "stages", dict(stages), "give at least one calibration.")
    figure = Figure(figsize=(max(1.8 * len(stages), 5.4), 4.6), dpi=170, layout="constrained")
    axes = figure.subplots(2, len(stages), squeeze=False, sharey="row")
    edges = np.linspace(0.0, 1.0, PIT_BINS + 1)
    for (above, below), (stage, calibration) in zip(axes.T, stages.items(), strict=True):
        state = calibration.state
        filled = state.links > 0
        sizes = 8.0 + 400.0 * state.links[filled] / max(state.links.sum(), 1)
        above.plot([0.0, 1.0], [0.0, 1.0], **_IDEAL)
        above.scatter(state.confidence[filled], state.accuracy[filled], s=sizes, color=BLUE, alpha=0.8)
        above.set(xlim=(0.3, 1.02), ylim=(0.0, 1.05))
        above.set_xticks(np.arange(0.4, 1.01, 0.2))
        above.set_xticks(np.arange(5, CONFIDENCE_BINS + 1) / CONFIDENCE_BINS, minor=True)
        above.set_title(f"{stage_name(stage)},\nerror {state.error:.3f}", fontsize="medium")
        below.stairs(calibration.gain_pit * PIT_BINS, edges, fill=True, color=BLUE, alpha=0.8)
        below.axhline(1.0, **_IDEAL)
        below.set(xlim=(0.0, 1.0))
        below.set_xticks([0.0, 0.5, 1.0])
    middle = axes[:, len(stages) // 2]
    middle[0].set_xlabel("probability of the likeliest link state")
    middle[1].set_xlabel("predicted probability of a smaller path gain")
    axes[0, 0].set_ylabel("accuracy")
    axes[1, 0].set_ylabel("density")
    figure.suptitle("Calibration of the link state (above) and of the path gain (below)")
    return figure
