"""Figures of placements of one and of several transmitters: the map, the search, and the predicted coverage."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import PercentFormatter

from sionna_partial.checks import require_type
from sionna_partial.constants import CellState
from sionna_partial.placement.placement import TransmitterPlacement
from sionna_partial.placement.several import NetworkPlacement
from sionna_partial.plots.map_plot import draw_map
from sionna_partial.plots.style import RED, STAR, UNKNOWN, WALL, Figure, corners_m, legend_below, window_m

_WIDTH_IN, _DPI = 9.0, 130
_STAR: dict[str, Any] = STAR | {"markersize": 15}


def plot_placement(placement: TransmitterPlacement) -> Figure:
    """Draw the map, the positions that were traced first, the refinement, and the best position with its coverage.

    Squares are receivers, in the colour of their probability of being covered from there (or of their mean gain), the
    paler the less likely they are indoors. The refinement that led to the best position is red.

    Parameters
    ----------
    placement : TransmitterPlacement
        From `place_transmitter`.

    Returns
    -------
    matplotlib.figure.Figure
        Not registered with pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        For something else than a TransmitterPlacement.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> figure = sp.plot_placement(sp.place_transmitter(partial))
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
    """Draw the transmitters that `place_transmitters` chose, the candidates, and the receivers that they cover.

    Parameters
    ----------
    placement : NetworkPlacement

    Returns
    -------
    matplotlib.figure.Figure
        Not registered with pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        For something else than a NetworkPlacement.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> figure = sp.plot_network_placement(sp.place_transmitters(partial, count=2))
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
        return f"Transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m, predicted coverage {score:.1%}"
    return f"Transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m, worst tenth at {score:.1f} dB"


def _window_m(placement: TransmitterPlacement) -> tuple[float, float, float, float]:
    """Part of the map that is drawn: what is known, and what counts (x0, x1, y0, y1) [m]."""
    partial, half = placement.partial, 0.5 * placement.spacing_m
    known_m = corners_m(partial.state != CellState.UNKNOWN, partial.origin_m, partial.resolution_m)
    counting_m = placement.rx_m[placement.weight > 0.2, :2]
    return window_m(np.vstack([known_m, counting_m - half, counting_m + half]))


def _draw_receivers(
    figure: Figure, axis: Axes, placement: TransmitterPlacement | NetworkPlacement, probability: str
) -> None:
    """Draw a square for each receiver, and the colour scale of the probability, or of the mean gain."""
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
