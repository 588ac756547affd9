"""Style of all figures, reproducible PNG files, and the figure of a map."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

import matplotlib.figure
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import float_array
from sionna_partial.constants import CellState, LinkState
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.settings import WALL_MATERIALS, Material, material_name

YELLOW, RED, BLUE = "#ddaa33", "#bb5566", "#004488"
"""Paul Tol's high-contrast colours, for any colour vision and in grey."""

STATE_COLOURS = {LinkState.LOS: YELLOW, LinkState.NLOS: RED, LinkState.OUTAGE: BLUE}
"""Colours of link states, bright for good links."""

STAR: dict[str, Any] = {"marker": "*", "markerfacecolor": "white", "markeredgecolor": "black", "linestyle": "none"}
"""Marker of the transmitter."""

BORDER_M = 0.3
"""Border around the known cells [m]."""


_SHEET_ASPECT = 1.5

WALL, UNKNOWN = "black", "0.86"
"""Colours of cells; free ones are white."""

_SERVERS = "tab20"

_MATERIALS = ("#aa7744", "#cc3311", "#777777", "#444466", "#33bbee", "#0077bb", "#ee7733", "#ee3377", "#9933cc")
_OTHER_MATERIAL = "#004488"
"""Colours of `WALL_MATERIALS`, and of other materials."""

FAILS = "#d4145a"
"""Colour of the hatching where the threshold is not exceeded."""

INK = tuple(round(0.7 * (255 - shade)) for shade in range(256))
"""Opacities of black, by the shade of a floor plan's picture above a coverage."""

_POINTS = 72
"""Pixels of a notebook per inch."""

_WIDTH_IN, _DPI = 6.4, 110


class Figure(matplotlib.figure.Figure):
    """A figure that notebooks show although pyplot does not manage it."""

    def _repr_png_(self) -> tuple[bytes, dict[str, float]]:
        width, height = self.get_size_inches() * _POINTS
        return figure_png(self), {"width": round(width), "height": round(height)}


def figure_png(figure: matplotlib.figure.Figure, width_px: float = math.inf) -> bytes:
    """Return a figure as PNG of limited width; equal figures give equal bytes."""
    buffer = io.BytesIO()
    dpi = min(figure.dpi, width_px / figure.get_figwidth())
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def shade(where: Bools, grey: int = 0, opacity: float = 1.0) -> NDArray[np.uint8]:
    """Paint cells, black by default, others transparent: (ny, nx, 4)."""
    picture = np.full((*where.shape, 4), grey, dtype=np.uint8)
    picture[..., 3] = np.uint8(255 * opacity) * where
    return picture


def window_m(points_m: Floats) -> tuple[float, float, float, float]:
    """Return the limits x0, x1, y0, y1 of points (N, 2) with a border [m]."""
    (x0, y0), (x1, y1) = points_m.min(axis=0) - BORDER_M, points_m.max(axis=0) + BORDER_M
    return float(x0), float(x1), float(y0), float(y1)


def corners_m(cells: Bools, origin_m: tuple[float, float], resolution_m: float) -> Floats:
    """Return the lower-left and upper-right corners of cells (2N, 2) [m]."""
    corners = np.argwhere(cells)[:, ::-1]
    return np.vstack([corners, corners + 1]) * resolution_m + origin_m


def sheet_columns(count: int, aspect: float) -> int:
    """Return the columns of a nearly square sheet with few empty panels."""

    def fault(columns: int) -> float:
        rows = math.ceil(count / columns)
        return abs(math.log(columns * aspect / rows / _SHEET_ASPECT)) + 4 * (rows * columns - count) / count

    return min(range(1, count + 1), key=fault)


def server_colours(count: int) -> list[tuple[float, ...]]:
    """Return the colours of transmitters, which repeat beyond 20."""
    cmap = colormaps[_SERVERS]
    return [cmap(number % cmap.N) for number in range(count)]


def material_colour(material: Material) -> str:
    """Return the CSS colour of walls of a material."""
    return dict(zip(WALL_MATERIALS, _MATERIALS, strict=True)).get(material_name(material), _OTHER_MATERIAL)


def named_walls(partial: PartialMap) -> dict[Material, Bools]:
    """Return the wall cells (ny, nx) of each material that the map names."""
    if partial.wall_material is None:
        return {}
    cells = {each: partial.wall_material == number for number, each in enumerate(partial.wall_materials, 1)}
    return {material: where for material, where in cells.items() if where.any()}


def legend_below(
    figure: Figure, handles: Sequence[Line2D | Patch], columns: int | None = None, title: str = ""
) -> None:
    """Draw a legend below the axes, in one row by default."""
    count = columns or len(handles)
    figure.legend(handles=handles, loc="outside lower center", ncols=count, frameon=False, title=title or None)


def plot_map(partial: PartialMap, *, tx: ArrayLike | None = None, rx: ArrayLike | None = None) -> Figure:
    """Draw a map and radios on it, also outside the map, to check scale and orientation.

    Parameters
    ----------
    partial : PartialMap
    tx : (2,), (3,), (T, 2) or (T, 3) array-like, optional
        Transmitters [m].
    rx : (2,), (3,), (N, 2) or (N, 3) array-like, optional
        Receivers [m].

    Raises
    ------
    MapError
        For anything but a PartialMap.
    PositionError
        For positions that are not finite, or have another shape.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(3)
    >>> figure = sp.plots.plot_map(home, tx=(2.0, 3.0, 1.5))
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
    """Draw the cells."""
    x0, y0, x1, y1 = partial.bounds_m
    axis.set_facecolor(UNKNOWN)
    for state, grey, order in ((CellState.FREE, 255, 0.5), (CellState.WALL, 0, 3.0)):
        picture, extent = shade(partial.state == state, grey), (x0, x1, y0, y1)
        axis.imshow(picture, extent=extent, origin="lower", interpolation="nearest", zorder=order)


def _positions(name: str, values: ArrayLike | None) -> Floats:
    if values is None:
        return np.zeros((0, 2))
    remedy = "give x and y, or x, y and z, in metres: (3,) or (N, 3)."
    points = np.atleast_2d(float_array(name, values, PositionError, remedy))
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise PositionError(f"{name} has shape {np.shape(values)}: {remedy}")
    if not np.isfinite(points).all():
        raise PositionError(f"{name} has values that are not finite: {remedy}")
    return points[:, :2]
