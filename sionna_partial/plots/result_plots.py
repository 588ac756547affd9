"""Figures of placements, calibrations and evaluations."""

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator, PercentFormatter

from sionna_partial.calibration.calibration import MaterialCalibration
from sionna_partial.checks import require, require_type
from sionna_partial.constants import CellState
from sionna_partial.lab.datasets.table import stage_name
from sionna_partial.lab.metrics import CONFIDENCE_BINS, PIT_BINS, Calibration
from sionna_partial.placement.placement import TransmitterPlacement
from sionna_partial.placement.several import NetworkPlacement
from sionna_partial.plots.style import (
    BLUE,
    RED,
    STAR,
    UNKNOWN,
    WALL,
    Figure,
    corners_m,
    draw_map,
    legend_below,
    window_m,
)
from sionna_partial.settings import Material
from sionna_partial.tracing.power import reflection_loss_db

if TYPE_CHECKING:
    from sionna_partial.lab.evaluation import Evaluation, Row  # reads data sets with pyarrow, which is optional

_WIDTH_IN, _DPI = 9.0, 130
_STAR: dict[str, Any] = STAR | {"markersize": 15}

ANGLES_DEG = np.linspace(0.0, 85.0, 171)

LARGEST_LOSS_DB = 30.0
"""Largest drawn loss of a reflection [dB]."""

_LINE: dict[str, Any] = {"linewidth": 1.6}

_PANELS = {
    "accuracy": "accuracy of the link state",
    "rmse_db": "RMSE of the path gain [dB]",
    "rmse_linked_db": "RMSE without outages [dB]",
}

_COLOURS = (BLUE, "#ee6677", "#228833", "#bbbbbb", "#ccbb44", "#66ccee", "#aa3377", "#000000")
"""Paul Tol's bright colours (the predictor's darkened) and black."""

_STYLES: dict[str, dict[str, Any]] = {
    "test": {"marker": "o", "linestyle": "-"},
    "train": {"marker": "s", "linestyle": "--", "fillstyle": "none"},
}

_IDEAL: dict[str, Any] = {"color": "0.3", "linewidth": 0.9, "linestyle": "--"}


def plot_placement(placement: TransmitterPlacement) -> Figure:
    """Draw the map, the traced starts, the refinement, and the best position with its coverage.

    Squares are receivers in the colour of their probability of coverage (or mean gain), paler where less probably
    indoors. The refinement that led to the best position is red.

    Parameters
    ----------
    placement : TransmitterPlacement
        From `place_transmitter`.

    Raises
    ------
    SettingsError
        For anything but a TransmitterPlacement.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> found = sp.place_transmitter(sp.make_home(7), objective="coverage", threshold_db=-100.0)
    >>> figure = sp.plots.plot_placement(found)
    >>> figure.savefig("placement.png")
    """
    require_type("placement", placement, TransmitterPlacement, "give what place_transmitter returned.")
    x0, x1, y0, y1 = _window_m(placement)
    height = min(max((_WIDTH_IN - 1.8) * (y1 - y0) / (x1 - x0), 3.0), 14.0)
    figure = Figure(figsize=(_WIDTH_IN, height + 1.2), dpi=_DPI, layout="constrained")
    axis = figure.add_subplot()
    draw_map(axis, placement.partial)
    _draw_receivers(figure, axis, placement, f"probability of more than {placement.settings.threshold_db:g} dB")
    _draw_search(axis, placement)
    axis.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel="x [m]", ylabel="y [m]", title=_headline(placement))
    handles: list[Line2D | Patch] = [
        Line2D([], [], label="transmitter", **_STAR),
        Line2D([], [], color=RED, marker="o", markersize=4, label="refinement"),
        Line2D([], [], linestyle="none", marker="o", markerfacecolor="white", markeredgecolor="black", label="start"),
    ]
    if (placement.partial.state == CellState.WALL).any():
        handles.append(Patch(color=WALL, label="wall"))
    if (placement.partial.state == CellState.UNKNOWN).any():
        handles.append(Patch(facecolor=UNKNOWN, edgecolor="0.6", label="not observed"))
    legend_below(figure, handles)
    return figure


def plot_network_placement(placement: NetworkPlacement) -> Figure:
    """Draw the chosen transmitters, the candidates and the covered receivers.

    Parameters
    ----------
    placement : NetworkPlacement
        From `place_transmitters`.

    Raises
    ------
    SettingsError
        For anything but a NetworkPlacement.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> found = sp.place_transmitters(sp.make_home(7), count=2, threshold_db=-90.0)
    >>> figure = sp.plots.plot_network_placement(found)
    >>> figure.savefig("placement.png")
    """
    require_type("placement", placement, NetworkPlacement, "give what place_transmitters returned.")
    ny, nx = placement.partial.shape
    figure = Figure(figsize=(_WIDTH_IN, min(max(7.0 * ny / nx, 3.0), 14.0) + 1.2), dpi=_DPI, layout="constrained")
    axis = figure.add_subplot()
    draw_map(axis, placement.partial)
    _draw_receivers(figure, axis, placement, f"probability that one is above {placement.settings.threshold_db:g} dB")
    axis.plot(*placement.candidates_m[:, :2].T, "o", markerfacecolor="white", markeredgecolor="black", markersize=5)
    axis.plot(*placement.positions_m[:, :2].T, zorder=6, **_STAR)
    title = f"{len(placement.positions_m)} transmitters, predicted coverage {placement.score:.1%}"
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    candidate = {"marker": "o", "linestyle": "none", "markerfacecolor": "white", "markeredgecolor": "black"}
    handles = [
        Line2D([], [], label="transmitter", markersize=12, **STAR),
        Line2D([], [], label="candidate", **candidate),  # type: ignore[arg-type]
    ]
    legend_below(figure, handles)
    return figure


def _headline(placement: TransmitterPlacement) -> str:
    x, y, z = placement.position_m
    score = placement.score
    if placement.settings.objective == "coverage":
        return f"Transmitter at ({x:z.2f}, {y:z.2f}, {z:z.2f}) m, predicted coverage {score:.1%}"
    return f"Transmitter at ({x:z.2f}, {y:z.2f}, {z:z.2f}) m, worst tenth at {score:z.1f} dB"


def _window_m(placement: TransmitterPlacement) -> tuple[float, float, float, float]:
    partial, half = placement.partial, 0.5 * placement.spacing_m
    known_m = corners_m(partial.state != CellState.UNKNOWN, partial.origin_m, partial.resolution_m)
    counting_m = placement.rx_m[placement.weight > 0.2, :2]
    return window_m(np.vstack([known_m, counting_m - half, counting_m + half]))


def _draw_receivers(
    figure: Figure, axis: Axes, placement: TransmitterPlacement | NetworkPlacement, probability: str
) -> None:
    size = placement.spacing_m
    patches = [Rectangle((x - size / 2, y - size / 2), size, size) for x, y in placement.rx_m[:, :2]]
    coverage = placement.settings.objective == "coverage"
    norm = Normalize(0.0, 1.0) if coverage else Normalize(-150.0, -60.0)
    squares = PatchCollection(patches, cmap="viridis", norm=norm, linewidths=0.0, zorder=1)
    squares.set_array(placement.values)
    squares.set_alpha((0.15 + 0.75 * np.clip(placement.weight, 0.0, 1.0)).tolist())
    axis.add_collection(squares)
    label = probability if coverage else "mean path gain [dB]"
    bar = figure.colorbar(ScalarMappable(norm, "viridis"), ax=axis, label=label, shrink=0.8)
    if coverage:
        bar.ax.yaxis.set_major_formatter(PercentFormatter(1.0))


def _draw_search(axis: Axes, placement: TransmitterPlacement) -> None:
    x, y = placement.starts_m[:, :2].T
    axis.scatter(x, y, s=26, facecolors="white", edgecolors="black", linewidths=1.0, zorder=4)
    x, y = placement.trajectory_m[:, :2].T
    axis.plot(x, y, color=RED, marker="o", markersize=4, linewidth=1.8, zorder=5)
    x, y = placement.position_m[:2]
    axis.plot(x, y, zorder=6, **_STAR)


def plot_calibration(calibration: MaterialCalibration) -> Figure:
    """Draw a calibration of materials.

    Left: loss by step. Middle: measured gains against gains traced with the initial and the calibrated
    material. Right: loss of a reflection with two standard deviations, a panel for each material.

    Parameters
    ----------
    calibration : MaterialCalibration

    Raises
    ------
    SettingsError
        For anything but a MaterialCalibration.

    Examples
    --------
    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> cells = np.pad(np.zeros((3, 4), dtype=int), 1, constant_values=1)
    >>> room, tx = sp.map_from_array(cells, resolution_m=1.0), (1.5, 1.5, 1.5)
    >>> rx = [(x, y, 1.5) for x in (2.2, 2.9, 3.6, 4.3) for y in (1.7, 2.4, 3.1)]
    >>> measured = sp.Measurements(tx, rx, sp.trace_links(room, tx, rx).gain_db)
    >>> found = sp.calibrate_materials(room, measured)
    >>> sp.plots.plot_calibration(found).savefig("calibration.png")
    """
    require_type("calibration", calibration, MaterialCalibration, "give what calibrate_materials returned.")
    count = len(calibration.materials)
    figure = Figure(figsize=(4.2 * (2 + count), 3.9), dpi=150, layout="constrained")
    axes = figure.subplots(1, 2 + count)
    loss = calibration.loss
    axes[0].plot(np.arange(len(loss)), loss, marker="o", markersize=4, color=BLUE, **_LINE)
    axes[0].set(xlabel="step (0 is the start)", ylabel="negative log posterior per link", title="Search")
    axes[0].xaxis.set_major_locator(MaxNLocator(integer=True))
    axes[0].grid(alpha=0.3)
    _draw_gains(axes[1], calibration)
    for which in range(count):
        _draw_reflection(axes[2 + which], calibration, which)
    undetermined = ", ".join(calibration.undetermined)
    note = f"; the measurements cannot determine {undetermined}" if undetermined else ""
    used, count = int(calibration.used.sum()), len(calibration.used)
    figure.suptitle(f"Material from {used} of {count} measured links, noise {calibration.noise_db:.1f} dB{note}")
    return figure


def _draw_gains(axis: Axes, calibration: MaterialCalibration) -> None:
    used = calibration.used
    measured = calibration.gain_db[used]
    pairs = (("start", calibration.gain_before_db, RED), ("calibrated", calibration.gain_after_db, BLUE))
    for name, traced_db, colour in pairs:
        rmse_db = float(np.sqrt(np.mean((traced_db[used] - measured) ** 2)))
        style: dict[str, Any] = {"s": 9, "alpha": 0.6, "linewidths": 0, "color": colour}
        axis.scatter(measured, traced_db[used], label=f"{name}, RMSE {rmse_db:.1f} dB", **style)
    limits = [float(np.min(measured)) - 5.0, float(np.max(measured)) + 5.0]
    axis.plot(limits, limits, color="0.3", linewidth=0.9, linestyle="--")
    axis.set(xlabel="measured gain [dB]", ylabel="traced gain [dB]", title="Links", xlim=limits)
    axis.legend(loc="upper left", fontsize="small")
    axis.grid(alpha=0.3)


def _draw_reflection(axis: Axes, calibration: MaterialCalibration, which: int) -> None:
    start, found = calibration.start[which], calibration.materials[which]
    loss_db, std_db = calibration.reflection_loss_db(ANGLES_DEG, which=which)
    slab = (start.relative_permittivity, start.conductivity_s_m, start.thickness_m)
    before_db = reflection_loss_db(*slab, calibration.trace_settings.frequency_hz, ANGLES_DEG)
    axis.fill_between(ANGLES_DEG, loss_db - 2.0 * std_db, loss_db + 2.0 * std_db, color=BLUE, alpha=0.2, linewidth=0)
    axis.plot(ANGLES_DEG, before_db, color=RED, label=f"start: {_words(start)}", **_LINE)
    axis.plot(ANGLES_DEG, loss_db, color=BLUE, label=f"calibrated: {_words(found)}", **_LINE)
    title = "Reflection at walls" if len(calibration.materials) == 1 else f"Material {which}"
    axis.set(xlabel="angle of incidence [degrees]", ylabel="loss of a reflection [dB]", title=title)
    axis.set(xlim=(0.0, 85.0), ylim=(min(LARGEST_LOSS_DB, 1.15 * float(max(loss_db.max(), before_db.max()))), 0.0))
    axis.legend(loc="lower right", fontsize="small")
    axis.grid(alpha=0.3)


def _words(material: Material) -> str:
    return f"{material.relative_permittivity:.3g}, {material.conductivity_s_m:.2g} S/m"


def plot_stages(evaluation: "Evaluation") -> Figure:
    """Draw accuracy and gain errors of indoor receivers by stage of exploration (paper, Fig. 6).

    Solid lines are test homes, the dashed line the predictor on its training homes.
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


def _draw_lines(axis: Axes, rows: "list[Row]", name: str) -> None:
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

    The confidence is the probability of the most probable state, P(smaller gain) the predicted distribution function at
    the true gain. Calibrated states are on the dashed line (area: number of links), calibrated gains fill all bins up
    to it. A hill shows a standard deviation that is too large, a bowl one that is too small.
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
        above.set_xlabel("confidence")
        above.set_title(f"{stage_name(stage)},\nerror {state.error:.3f}", fontsize="medium")
        below.stairs(calibration.gain_pit * PIT_BINS, edges, fill=True, color=BLUE, alpha=0.8)
        below.axhline(1.0, **_IDEAL)
        below.set(xlim=(0.0, 1.0), xlabel="P(smaller gain)")
        below.set_xticks([0.0, 0.5, 1.0])
    axes[0, 0].set_ylabel("accuracy")
    axes[1, 0].set_ylabel("density")
    figure.suptitle("Calibration of the link state (above) and of the path gain (below)")
    return figure
