"""A coverage map in one panel: a layer, walls, the unobserved area, transmitters, and the line at a threshold."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.ndimage import distance_transform_edt, maximum_filter

from sionna_partial.arrays import Bools, Floats
from sionna_partial.coverage.dataset import TX_COORDINATES, WALL_PARTS
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.localisation import likely_region
from sionna_partial.plots.layers import Layer
from sionna_partial.plots.style import FAILS, STAR, material_colour, named_walls, shade
from sionna_partial.settings import material_name

TRANSMITTER: dict[str, Any] = STAR | {"markersize": 12}

UNSEEN_OPACITY = 0.45
"""Opacity of walls that only the reference map has."""

_MAX_PIXELS = 3000
"""Longest side of the picture of walls [pixels]."""

_FAILS, _HALO = "\\\\\\", 0.8
_HATCH, _HATCH_COLOUR = "//", (1.0, 1.0, 1.0, 0.55)
_NAME: dict[str, Any] = {"fontsize": "small", "parse_math": False, "bbox": {"fc": "white", "ec": "none", "pad": 0.8}}


def draw_layer(
    axis: Axes, coverage: xr.Dataset, layer: Layer, reference: xr.Dataset | None = None, *, halo: bool = False
) -> None:
    """Draw a layer of one transmitter, with the walls of a reference map in grey, and white around walls."""
    extent = extent_m(coverage)
    wall = wall_cells(coverage)
    picture = _fill(np.asarray(layer.picture(coverage)), coverage["valid"].to_numpy(), wall)
    axis.imshow(picture, extent=extent, origin="lower", interpolation="nearest", norm=layer.norm, cmap=layer.cmap)
    axis.imshow(shade(outside(coverage), grey=255), extent=extent, origin="lower", interpolation="nearest")
    _hatch_unknown(axis, coverage)
    if reference is not None:
        axis.imshow(
            shade(wall_cells(reference), opacity=UNSEEN_OPACITY), extent=extent_m(reference), origin="lower", zorder=3
        )
    if halo:  # walls stay visible on dark layers
        around = maximum_filter(wall, size=3) & ~wall
        axis.imshow(shade(around, grey=255, opacity=_HALO), extent=extent, origin="lower", zorder=3)
    axis.imshow(shade(wall), extent=extent, origin="lower", zorder=3)
    if "transmitter_m" in coverage.attrs:
        x, y, _ = coverage.attrs["transmitter_m"]
        axis.plot(x, y, zorder=4, **TRANSMITTER)
    for x_m, y_m, inside in likely_area(coverage):
        for colour, width in (("white", 2.4), ("black", 1.0)):
            axis.contour(x_m, y_m, inside, levels=[0.5], colors=colour, linewidths=width, zorder=4)
    axis.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")


def likely_area(coverage: xr.Dataset) -> list[tuple[Floats, Floats, Floats]]:
    """Return, as `unobserved_area`, cells with 90 % of an unknown transmitter's posterior, or nothing."""
    if "p_transmitter" not in coverage:
        return []
    x, y = (coverage[f"tx_{name}"].to_numpy() for name in "xy")
    step_m = max([*np.diff(x), *np.diff(y)], default=1.0)
    axes = (np.r_[axis_m[0] - step_m, axis_m, axis_m[-1] + step_m] for axis_m in (x, y))
    return [(*axes, np.pad(likely_region(coverage["p_transmitter"].to_numpy()), 1).astype(float))]


def extent_m(coverage: xr.Dataset | xr.DataArray) -> tuple[float, float, float, float]:
    """Return the limits x0, x1, y0, y1 of a map with the attribute `spacing_m` [m]."""
    half = coverage.attrs["spacing_m"] / 2
    x, y = coverage["x"].to_numpy(), coverage["y"].to_numpy()
    return x[0] - half, x[-1] + half, y[0] - half, y[-1] + half


def wall_cells(coverage: xr.Dataset) -> Bools:
    """Return the walls in up to 6 x 6 parts of a cell."""
    bits = coverage["wall_parts"].to_numpy()
    fine = next((parts for parts in (6, 3, 2) if max(bits.shape) * parts <= _MAX_PIXELS), 1)
    merge = WALL_PARTS // fine
    wall = np.zeros((bits.shape[0], fine, bits.shape[1], fine), dtype=bool)
    for row, column in np.ndindex(WALL_PARTS, WALL_PARTS):
        wall[:, row // merge, :, column // merge] |= (bits >> (WALL_PARTS * row + column) & 1).astype(bool)
    return wall.reshape(bits.shape[0] * fine, bits.shape[1] * fine)


def outside(coverage: xr.Dataset) -> Bools:
    """Return the unknown cells of a complete map, where no receiver can be."""
    return ~coverage["observed"].to_numpy() & bool(coverage.attrs.get("map_complete", 0))


def _fill(picture: Floats, valid: Bools, wall: Bools) -> Floats:
    """Refine a picture to the size of `wall`, and fill cells without receiver by the nearest.

    Otherwise walls thinner than a cell would have a white border.
    """
    fine = wall.shape[0] // valid.shape[0]
    bare = ~valid.repeat(fine, axis=0).repeat(fine, axis=1)
    row, column = np.indices(bare.shape)
    if bare.any() and not bare.all():
        row, column = distance_transform_edt(bare, return_distances=False, return_indices=True)
    return picture[row // fine, column // fine]


def hatched(coverage: xr.Dataset) -> Bools:
    """Return the unobserved cells where a receiver can be."""
    return ~coverage["observed"].to_numpy() & ~outside(coverage)


def unobserved_area(coverage: xr.Dataset) -> tuple[Floats, Floats, Floats]:
    """Return x (nx + 2,) and y (ny + 2,) of cells with a border, and hatched cells as 1."""
    step = coverage.attrs["spacing_m"] * np.array([-1.0, 1.0])
    x, y = (np.r_[axis_m[0] + step[0], axis_m, axis_m[-1] + step[1]] for axis_m in (coverage["x"], coverage["y"]))
    return x, y, np.pad(hatched(coverage), 1, mode="edge").astype(float)


def _hatch_unknown(axis: Axes, coverage: xr.Dataset) -> None:
    x, y, unknown = unobserved_area(coverage)
    if not unknown.any():
        return
    area = axis.contourf(x, y, unknown, levels=[0.5, 1.5], colors="none", hatches=[_HATCH], zorder=2)
    area.set_edgecolor(_HATCH_COLOUR)
    area.set_linewidth(0.5)
    area.set_hatch_linewidth(0.5)


def to_the_edge(coverage: xr.Dataset, values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return x and y with the edges of the map, and values (ny + 2, nx + 2) that continue to them, for contours."""
    x0, x1, y0, y1 = extent_m(coverage)
    return np.r_[x0, coverage["x"], x1], np.r_[y0, coverage["y"], y1], np.pad(values, 1, mode="edge")


@dataclass(frozen=True)
class Outline:
    """Line at a level of values (ny, nx), hatching where they are below it, and the legends of both."""

    values: Floats
    level: float
    line: str
    fails: str

    def draw(self, axis: Axes, coverage: xr.Dataset) -> list[Line2D | Patch]:
        """Draw both, and return the handles of the legend."""
        filled = _fill(self.values, np.isfinite(self.values), np.zeros(self.values.shape, dtype=bool))
        x, y, values = to_the_edge(coverage, np.where(outside(coverage), np.nan, filled))
        handles: list[Line2D | Patch] = []
        if not np.isfinite(values).any():
            return handles
        lowest, highest = np.nanmin(values), np.nanmax(values)
        if lowest < self.level:
            fails = axis.contourf(x, y, values, levels=[lowest - 1.0, self.level], colors="none", hatches=[_FAILS])
            fails.set(edgecolor=FAILS, linewidth=0.0, zorder=2.5)
            handles.append(Patch(facecolor="none", edgecolor=FAILS, hatch=2 * _FAILS, linewidth=0.0, label=self.fails))
        if lowest < self.level < highest:
            for colour, width in (("white", 2.4), ("black", 1.2)):
                axis.contour(x, y, values, levels=[self.level], colors=colour, linewidths=width, zorder=3.5)
            handles.append(Line2D([], [], color="black", linewidth=1.2, label=self.line))
        return handles


def draw_named_walls(axis: Axes, partial: PartialMap | None) -> list[Patch]:
    """Draw the walls whose material the map names in its colour, and return the handles of the legend."""
    if partial is None:
        return []
    x0, y0, x1, y1 = partial.bounds_m
    for material, where in named_walls(partial).items():
        picture = np.zeros((*where.shape, 4))
        picture[where] = to_rgba(material_colour(material))
        axis.imshow(picture, extent=(x0, x1, y0, y1), origin="lower", interpolation="nearest", zorder=3.2)
    return [Patch(facecolor=material_colour(each), label=material_name(each)) for each in named_walls(partial)]


def draw_names(axis: Axes, coverage: xr.Dataset) -> None:
    """Draw all transmitters with their names."""
    x_m, y_m = (coverage[name].to_numpy() for name in TX_COORDINATES[:2])
    axis.plot(x_m, y_m, zorder=4, **TRANSMITTER)
    for place in zip(coverage["tx"].to_numpy(), zip(x_m, y_m, strict=True), strict=True):
        axis.annotate(*place, (7, 0), textcoords="offset points", va="center", zorder=5, **_NAME)


def hatched_key() -> Patch:
    """Return the legend of the unobserved area."""
    return Patch(facecolor="0.55", hatch=2 * _HATCH, edgecolor="white", linewidth=0.0, label="not observed")
