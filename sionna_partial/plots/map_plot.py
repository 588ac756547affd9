"""Figure of a map, with the positions of radios."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats
from sionna_partial.checks import float_array
from sionna_partial.constants import CellState
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.plots.style import BLUE, STAR, UNKNOWN, WALL, Figure, legend_below, shade, window_m

_WIDTH_IN, _DPI = 6.4, 110


def plot_map(partial: PartialMap, *, tx: ArrayLike | None = None, rx: ArrayLike | None = None) -> Figure:
    """Draw a map, and where radios would stand on it: whether it is the right way up is seen before predicting.

    Positions outside the map are drawn, too.

    Parameters
    ----------
    partial : PartialMap
    tx : (2,), (3,), (T, 2) or (T, 3) array-like, optional
        Transmitters, world x, y and z [m].
    rx : (2,), (3,), (N, 2) or (N, 3) array-like, optional
        Receivers [m].

    Returns
    -------
    matplotlib.figure.Figure
        Not registered with pyplot: it need not be closed.

    Raises
    ------
    MapError
        For something else than a PartialMap.
    PositionError
        For positions that are not finite, or have another shape.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(3)
    >>> figure = sp.plot_map(home, tx=(2.0, 3.0, 1.5))
    >>> figure.savefig("map.png")
    """
    require_map("partial", partial)
    tx_m, rx_m = _positions("tx", tx), _positions("rx", rx)
    x0, y0, x1, y1 = partial.bounds_m
    left, right, low, high = window_m(np.vstack([[[x0, y0], [x1, y1]], tx_m, rx_m]))
    height = min(max((_WIDTH_IN - 0.8) * (high - low) / (right - left), 1.6), 2.0 * _WIDTH_IN)
    figure = Figure(figsize=(_WIDTH_IN, height + 1.0), dpi=_DPI, layout="constrained")
    axis = figure.add_subplot()
    draw_map(axis, partial)
    axis.plot(*rx_m.T, linestyle="none", marker="o", markersize=3, color=BLUE, zorder=4)
    axis.plot(*tx_m.T, markersize=15, zorder=5, **STAR)
    axis.set(xlim=(left, right), ylim=(low, high), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axis.set_title(f"{x1 - x0:.1f} x {y1 - y0:.1f} m, {partial.observed_fraction:.0%} observed", fontsize="medium")
    handles: dict[Line2D | Patch, bool] = {
        Line2D([], [], label="transmitter", markersize=13, **STAR): len(tx_m) > 0,
        Line2D([], [], label="receiver", linestyle="none", marker="o", markersize=3, color=BLUE): len(rx_m) > 0,
        Patch(color=WALL, label="wall"): bool((partial.state == CellState.WALL).any()),
        Patch(facecolor=UNKNOWN, edgecolor="0.6", label="not observed"): True,
    }
    legend_below(figure, [handle for handle, drawn in handles.items() if drawn])
    return figure


def draw_map(axis: Axes, partial: PartialMap) -> None:
    """Draw the cells: free ones white, walls black, unknown ones grey."""
    x0, y0, x1, y1 = partial.bounds_m
    axis.set_facecolor(UNKNOWN)
    for state, grey, order in ((CellState.FREE, 255, 0.5), (CellState.WALL, 0, 3.0)):
        picture, extent = shade(partial.state == state, grey), (x0, x1, y0, y1)
        axis.imshow(picture, extent=extent, origin="lower", interpolation="nearest", zorder=order)


def _positions(name: str, values: ArrayLike | None) -> Floats:
    """Return x and y (N, 2) of positions [m]; none for None."""
    if values is None:
        return np.zeros((0, 2))
    remedy = "give x and y, or x, y and z, in metres: (3,) or (N, 3)."
    points = np.atleast_2d(float_array(name, values, PositionError, remedy))
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise PositionError(f"{name} has shape {np.shape(values)}: {remedy}")
    if not np.isfinite(points).all():
        raise PositionError(f"{name} has values that are not finite: {remedy}")
    return points[:, :2]
