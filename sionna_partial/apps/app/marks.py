"""Marks on the pictures of the page and of its PNG: measured points, directions of antennas, next views."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sionna_partial.apps.app.radio import Transmitter
from sionna_partial.arrays import Bools, Floats
from sionna_partial.exploration.next_views import NextViews
from sionna_partial.maps.partial_map import PartialMap

USED, UNUSED, VIEW = "#ee6677", "#ffffff", "#ddaa33"
"""Colours of measured points and of next views."""

_AIM = 0.06
"""Length of the direction of an antenna, as a fraction of the map."""


def aims_m(partial: PartialMap | None, transmitters: Iterable[Transmitter]) -> list[Floats]:
    """Return lines (2, 2) [m] along the main directions of antennas."""
    length_m = 0.0 if partial is None else _AIM * partial.resolution_m * max(partial.shape)
    lines = []
    for each in transmitters:
        if each.antenna.pattern == "tr38901":
            start, angle = np.array([each.x_m, each.y_m]), math.radians(each.antenna.azimuth_deg)
            lines.append(np.array([start, start + length_m * np.array([math.cos(angle), math.sin(angle)])]))
    return lines


@dataclass(frozen=True, eq=False)
class Marks:
    """Measured points (N, 3) [m] and whether they are used (N,), lines of antennas [m], next views."""

    points_m: Floats
    used: Bools
    aims_m: Sequence[Floats] = ()
    views: NextViews | None = None

    def draw(self, axis: Any) -> list[Any]:
        """Draw on axes of matplotlib, and return the handles of the legend."""
        look: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 5, "color": "black", "zorder": 3.8}
        handles = []
        for name, colour, which in (("measured", USED, self.used), ("measured, not used", UNUSED, ~self.used)):
            if which.any():
                x_m, y_m, _ = self.points_m[which].T
                handles += axis.plot(x_m, y_m, markerfacecolor=colour, label=name, **look)
        for line_m in self.aims_m:
            axis.plot(*line_m.T, color="black", linewidth=3, zorder=3.9)
        for rank, view in enumerate(self.views or (), start=1):
            axis.plot(*view.path_m.T, color="black", linestyle="--", zorder=3.8)
            turned = 3, 0, view.heading_deg - 90.0
            axis.plot(*view.position_m[:2], marker=turned, markersize=11, color=VIEW, mec="black", zorder=3.9)
            axis.annotate(str(rank), view.position_m[:2], (6, 0), textcoords="offset points", va="center", zorder=5)
        return handles
