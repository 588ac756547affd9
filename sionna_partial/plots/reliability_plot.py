"""Figure of how far predicted probabilities are what they say."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sionna_partial.datasets.link_table import stage_name
from sionna_partial.evaluation.metrics import CONFIDENCE_BINS, PIT_BINS, Calibration
from sionna_partial.settings import require

_COLOUR = "#004488"
_IDEAL: dict[str, Any] = {"color": "0.3", "linewidth": 0.9, "linestyle": "--"}


def plot_reliability(stages: Mapping[float, Calibration]) -> Figure:
    """Draw reliability diagrams of the link state (above) and histograms of the gain's transform (below).

    In a reliability diagram, discs on the dashed line are right as often as they say; the larger a disc, the more
    links it stands for. In a histogram, a calibrated gain fills all bins up to the dashed line; a hill is a spread too
    wide, a bowl one too narrow, a slope a mean that is too high (falling) or too low (rising).

    Parameters
    ----------
    stages : mapping of float to Calibration
        By stage of exploration.

    Returns
    -------
    matplotlib.figure.Figure
        Not known to pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        If there is no stage.
    """
    require(len(stages) > 0, "stages", dict(stages), "give at least one calibration.")
    figure = Figure(figsize=(max(2.6 * len(stages), 5.2), 5.4), dpi=150, layout="constrained")
    axes = figure.subplots(2, len(stages), squeeze=False, sharey="row")
    for column, (stage, calibration) in enumerate(stages.items()):
        _draw_reliability(axes[0, column], calibration)
        _draw_transform(axes[1, column], calibration)
        axes[0, column].set_title(f"{stage_name(stage)}, error {calibration.state.error:.3f}")
    axes[0, 0].set_ylabel("share that is right")
    axes[1, 0].set_ylabel("density")
    figure.suptitle("Calibration of the link state (above) and of the path gain (below)")
    return figure


def _draw_reliability(axis: Axes, calibration: Calibration) -> None:
    state = calibration.state
    filled = state.links > 0
    share = state.links[filled] / max(state.links.sum(), 1)
    axis.plot([0.0, 1.0], [0.0, 1.0], **_IDEAL)
    axis.scatter(state.confidence[filled], state.accuracy[filled], s=8.0 + 400.0 * share, color=_COLOUR, alpha=0.8)
    axis.set(xlabel="confidence in the likeliest state", xlim=(0.3, 1.02), ylim=(0.0, 1.05))
    axis.set_xticks(np.arange(0.4, 1.01, 0.2))
    axis.set_xticks(np.arange(5, CONFIDENCE_BINS + 1) / CONFIDENCE_BINS, minor=True)


def _draw_transform(axis: Axes, calibration: Calibration) -> None:
    edges = np.linspace(0.0, 1.0, PIT_BINS + 1)
    axis.stairs(calibration.gain_pit * PIT_BINS, edges, fill=True, color=_COLOUR, alpha=0.8)
    axis.axhline(1.0, **_IDEAL)
    axis.set(xlabel="probability of a smaller gain", xlim=(0.0, 1.0))
