"""Figure of next views: the map, the uncertainty of the prediction, and the poses from which a robot lowers it."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Wedge

from sionna_partial.checks import require_type
from sionna_partial.constants import CellState
from sionna_partial.exploration.next_views import NextView, NextViews
from sionna_partial.plots.map_plot import draw_map
from sionna_partial.plots.style import BLUE, RED, STAR, WALL, YELLOW, Figure, corners_m, legend_below, window_m

_WIDTH_IN, _DPI = 8.0, 130
_AROUND_M, _VIEW_M, _VIEW_DEG = 1.5, 0.9, 60.0


def plot_next_views(views: NextViews) -> Figure:
    """Draw the map, the predicted uncertainty, and the ranked poses with their paths and frontiers.

    Parameters
    ----------
    views : NextViews
        From `next_views`.

    Returns
    -------
    matplotlib.figure.Figure
        Not registered with pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        For something else than NextViews.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> partial = sp.explore(sp.make_home(3), steps=(60,), seed=0)[0]
    >>> figure = sp.plot_next_views(sp.next_views(partial, goal="area"))
    >>> figure.savefig("next_views.png")
    """
    require_type("views", views, NextViews, "give what next_views returned.")
    partial = views.partial
    known_m = corners_m(partial.state != CellState.UNKNOWN, partial.origin_m, partial.resolution_m)
    low, high = np.array(partial.bounds_m).reshape(2, 2)
    shown_m = [np.clip(known_m + side, low, high) for side in (-_AROUND_M, _AROUND_M)]
    x0, x1, y0, y1 = window_m(np.vstack([*shown_m, views.tx_m[:, :2]]))
    height = min(max((_WIDTH_IN - 1.8) * (y1 - y0) / (x1 - x0), 3.0), 12.0)
    figure = Figure(figsize=(_WIDTH_IN, height + 1.2), dpi=_DPI, layout="constrained")
    axis = figure.add_subplot()
    draw_map(axis, partial)
    if len(views.tx_m):
        _draw_uncertainty(figure, axis, views)
    for rank, view in reversed([*enumerate(views, start=1)]):
        _draw_view(axis, rank, view)
    axis.plot(*views.start_m, marker="o", color=BLUE, markersize=7, markeredgecolor="white", zorder=5)
    axis.plot(*views.tx_m[:, :2].T, markersize=15, zorder=5, **STAR)
    axis.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axis.set_title(f"{len(views)} next views, the best first", fontsize="medium")
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=BLUE, marker="o", markevery=[0], label="start and path"),
        Line2D([], [], color=RED, linewidth=3, label="frontier"),
        Patch(color=YELLOW, label="next view"),
        Patch(color=WALL, label="wall"),
    ]
    if len(views.tx_m):
        handles.insert(0, Line2D([], [], label="transmitter", markersize=13, **STAR))
    legend_below(figure, handles)
    return figure


def _draw_uncertainty(figure: Figure, axis: Axes, views: NextViews) -> None:
    x, y = views.uncertainty.x.to_numpy(), views.uncertainty.y.to_numpy()
    half = 0.5 * views.uncertainty.attrs["spacing_m"]
    style: dict[str, Any] = {
        "extent": (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half),
        "origin": "lower",
        "zorder": 0.7,
    }
    most = 1.0 if views.goal == "coverage" else math.log2(3)
    picture = axis.imshow(views.uncertainty.mean("tx"), cmap="Purples", vmin=0.0, vmax=most, alpha=0.85, **style)
    figure.colorbar(picture, ax=axis, label="uncertainty of the link [bit]", shrink=0.8)


def _draw_view(axis: Axes, rank: int, view: NextView) -> None:
    axis.plot(*view.path_m.T, color=BLUE, linewidth=1.0, alpha=0.7, zorder=3.5)
    axis.plot(*view.frontier_m.T, color=RED, marker="s", markersize=2, linestyle="none", zorder=3.6)
    ends_deg = view.heading_deg + np.array([-0.5, 0.5]) * _VIEW_DEG
    axis.add_patch(Wedge(tuple(view.position_m), _VIEW_M, *ends_deg, color=YELLOW, alpha=0.8, linewidth=0, zorder=4))
    label = {"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": "black", "linewidth": 0.8}
    axis.text(
        float(view.position_m[0]),
        float(view.position_m[1]),
        str(rank),
        fontsize=8,
        ha="center",
        va="center",
        bbox=label,
        zorder=6,
    )
