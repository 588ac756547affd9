"""Shared style of all figures: colours, shaded cells, legends, and equal PNG files for equal figures."""

import io
import math
from collections.abc import Sequence
from typing import Any

import matplotlib.figure
import numpy as np
from matplotlib import colormaps
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.constants import LinkState

YELLOW, RED, BLUE = "#ddaa33", "#bb5566", "#004488"
"""Paul Tol's high-contrast colours: distinguishable with any colour vision and in grey."""

STATE_COLOURS = {LinkState.LOS: YELLOW, LinkState.NLOS: RED, LinkState.OUTAGE: BLUE}
"""The better the link, the brighter."""

STAR: dict[str, Any] = {"marker": "*", "markerfacecolor": "white", "markeredgecolor": "black", "linestyle": "none"}
"""Marker of the transmitter."""

BORDER_M = 0.3
"""Width of the border around the known cells in a picture [m]."""


_SHEET_ASPECT = 1.5

WALL, UNKNOWN = "black", "0.86"
"""Colours of cells on maps; free ones are white."""

_SERVERS = "tab20"

_POINTS = 72
"""Pixels of a notebook for each inch of a figure."""


class Figure(matplotlib.figure.Figure):
    """A figure that a notebook shows when a cell ends with it, although pyplot has no part in it."""

    def _repr_png_(self) -> tuple[bytes, dict[str, float]]:
        width, height = self.get_size_inches() * _POINTS
        return figure_png(self), {"width": round(width), "height": round(height)}


def figure_png(figure: matplotlib.figure.Figure, width_px: float = math.inf) -> bytes:
    """Return a figure as a PNG file, at most so wide; equal figures give equal bytes."""
    buffer = io.BytesIO()
    dpi = min(figure.dpi, width_px / figure.get_figwidth())
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def shade(where: Bools, grey: int = 0, opacity: float = 1.0) -> NDArray[np.uint8]:
    """Paint some cells grey, black by default, and leave the rest transparent: (ny, nx, 4)."""
    picture = np.full((*where.shape, 4), grey, dtype=np.uint8)
    picture[..., 3] = np.uint8(255 * opacity) * where
    return picture


def window_m(points_m: Floats) -> tuple[float, float, float, float]:
    """Limits x0, x1, y0, y1 of a picture of points (N, 2) with a border [m]."""
    (x0, y0), (x1, y1) = points_m.min(axis=0) - BORDER_M, points_m.max(axis=0) + BORDER_M
    return float(x0), float(x1), float(y0), float(y1)


def corners_m(cells: Bools, origin_m: tuple[float, float], resolution_m: float) -> Floats:
    """Lower-left and upper-right corners of cells (2N, 2) [m]."""
    corners = np.argwhere(cells)[:, ::-1]
    return np.vstack([corners, corners + 1]) * resolution_m + origin_m


def sheet_columns(count: int, aspect: float) -> int:
    """Choose the columns of a sheet that is neither high nor wide, with few empty panels; none of up to four panels."""

    def fault(columns: int) -> float:
        rows = math.ceil(count / columns)
        return abs(math.log(columns * aspect / rows / _SHEET_ASPECT)) + 4 * (rows * columns - count) / count

    return min(range(1, count + 1), key=fault)


def server_colours(count: int) -> list[tuple[float, ...]]:
    """Colours of so many transmitters, which repeat beyond 20."""
    cmap = colormaps[_SERVERS]
    return [cmap(number % cmap.N) for number in range(count)]


def legend_below(
    figure: Figure, handles: Sequence[Line2D | Patch], columns: int | None = None, title: str = ""
) -> None:
    """Draw a legend below the axes, in one row by default, with a line above it."""
    count = columns or len(handles)
    figure.legend(handles=handles, loc="outside lower center", ncols=count, frameon=False, title=title or None)
