"""Figures of coverage maps and of networks, and a one-page report."""

import io
import itertools
import json
import math
import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, ListedColormap, Normalize, to_rgb, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.checks import require, require_choice, require_number
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.coverage.dataset import (
    TX_COORDINATES,
    WALL_PARTS,
    probability_above,
    require_coverage,
    transmitter_text,
    transmitters_of,
)
from sionna_partial.coverage.grid import named_transmitter
from sionna_partial.coverage.network import require_network
from sionna_partial.coverage.radio import FLOORS
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.localisation import likely_region
from sionna_partial.plots.logo import read_logo
from sionna_partial.plots.style import (
    FAILS,
    INK,
    STAR,
    STATE_COLOURS,
    Figure,
    legend_below,
    material_colour,
    named_walls,
    server_colours,
    shade,
    sheet_columns,
)
from sionna_partial.settings import Material, material_name

DEFAULT_LAYERS = ("link_state", "gain_mean_db", "gain_std_db", "p_above")
"""Panels of `plot_coverage`."""

_NARROW_IN, _WIDE_IN, _HIGHEST_IN, _KEY_IN, _KEY_PAD_IN, _DPI, _MAX_PIXELS = 9.0, 11.0, 16.0, 0.75, 0.35, 170, 3000
_ROW_NAME, _LOW_ASPECT, _OUTAGE_NOTE = 16, 0.2, "an outage counts as a path gain of \N{MINUS SIGN}150 dB"
_NETWORK_WIDTH_IN, _NETWORK_DPI = 10.0, 130
_GAINS_DB, _GAINS_THROUGH_WALLS_DB = (GAIN_FLOOR_DB, -60.0), (-110.0, -30.0)
_FAILS, _HALO, _TITLE_WIDTH = "\\\\\\", 0.8, 90
_HATCH, _HATCH_COLOUR = "//", (1.0, 1.0, 1.0, 0.55)
_UNSEEN_OPACITY = 0.45
_STAR: dict[str, Any] = STAR | {"markersize": 12}
_A4_IN, _REPORTED_DB, _LIKELY = (8.27, 11.69), np.arange(20.0, -11.0, -10.0), 0.9
_STEPS = 2**20
_ONLY, _LOGO_IN, _TITLE_BESIDE_LOGO = "tx", (1.8, 0.55), 62
_REPORT_LINE_IN, _REPORT_WIDTH, _MOST_ROOMS, _BESIDE_IN, _BELOW_IN = 0.14, 124, 12, (1.1, 0.45), (0.5, 1.0)
_NAME: dict[str, Any] = {"fontsize": "small", "parse_math": False, "bbox": {"fc": "white", "ec": "none", "pad": 0.8}}


@dataclass(frozen=True)
class Layer:
    """Picture (ny, nx) of a quantity with its colour scale, or (ny, nx, 3); no label, no colour bar."""

    title: str
    picture: Callable[[xr.Dataset], NDArray[Any]]
    norm: Normalize | None = None
    cmap: str | Colormap | None = None
    label: str = ""
    ticks: tuple[Sequence[float], Sequence[str]] | None = None


@dataclass(frozen=True)
class Scale:
    """Colours of a layer in steps from `low` to `high`, its ticks and their names, and the title of its bar."""

    palette: Sequence[str]
    low: float
    high: float
    ticks: Sequence[float]
    names: Sequence[str]
    title: str

    def of(self, layer: Layer) -> Layer:
        """Return a layer with this scale."""
        norm, cmap = Normalize(self.low, self.high), ListedColormap([*self.palette])
        return replace(layer, norm=norm, cmap=cmap, label=self.title, ticks=(self.ticks, self.names))


def mix_state_colours(p_los: ArrayLike, p_nlos: ArrayLike, p_outage: ArrayLike) -> Floats:
    """Return the colours (..., 3) of link states, mixed by their probabilities (paper, Section IV-C)."""
    colours = np.array([to_rgb(STATE_COLOURS[state]) for state in (LinkState.LOS, LinkState.NLOS, LinkState.OUTAGE)])
    return np.stack([p_los, p_nlos, p_outage], axis=-1).astype(np.float64) @ colours


def coverage_layers(threshold_db: float, coverage: xr.Dataset | None = None) -> dict[str, Layer]:
    """Return layers by name; gains through walls are less spread."""
    through_walls = coverage is not None and coverage.attrs.get("walls") == "through walls"
    probability = Normalize(0.0, 1.0), "cividis", "probability"
    colours = ListedColormap([STATE_COLOURS[state] for state in sorted(LinkState)])
    layers = {
        "link_state": Layer("Most probable link state", _variable("link_state"), Normalize(0, 2), colours),
        "state_mixture": Layer(
            "Link state", lambda data: mix_state_colours(data["p_los"], data["p_nlos"], data["p_outage"])
        ),
        "gain_mean_db": Layer(
            "Mean path gain",
            _variable("gain_mean_db"),
            Normalize(*(_GAINS_THROUGH_WALLS_DB if through_walls else _GAINS_DB)),
            "viridis",
            "dB",
        ),
        "gain_std_db": Layer(
            "Std. dev. of the path gain", _variable("gain_std_db"), Normalize(0.0, 40.0), "magma_r", "dB"
        ),
        "p_above": Layer(
            f"P(path gain > {round(threshold_db, 1):g} dB)".replace("-", "\N{MINUS SIGN}"),
            lambda data: probability_above(data, threshold_db),
            *probability,
        ),
    }
    names = {"p_los": "P(LOS)", "p_nlos": "P(NLOS)", "p_outage": "P(outage)"}
    return layers | {name: Layer(title, _variable(name), *probability) for name, title in names.items()}


def _variable(name: str) -> Callable[[xr.Dataset], NDArray[Any]]:
    return lambda data: data[name].to_numpy()


def plot_coverage(
    coverage: xr.Dataset, *, layers: Sequence[str] = DEFAULT_LAYERS, threshold_db: float = -100.0
) -> Figure:
    """Draw link state, mean gain, its standard deviation, and where the gain exceeds a threshold.

    Each transmitter has a row. Walls are black, the unobserved area hatched, the transmitter a star; a line encloses
    90 % of the posterior of an unknown position. On a complete map the outside is blank. The figure is not
    registered with pyplot.

    Parameters
    ----------
    coverage : xarray.Dataset
        From `predict_map` or `load_coverage`.
    layers : sequence of str
        Panels: "link_state" (the most probable), "p_los", "p_nlos", "p_outage", "state_mixture" (colours mixed by
        probability, as in the paper), "gain_mean_db", "gain_std_db", "p_above".
    threshold_db : float
        Path gain of the panel "p_above", P(gain > threshold), in [-150, 0] dB.

    Raises
    ------
    SettingsError
        For anything but a coverage map, another layer, or a threshold out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> import xarray as xr
    >>> coverage = xr.load_dataset("coverage.nc")  # or directly from predict_map
    >>> figure = sp.plots.plot_coverage(coverage)
    >>> figure.savefig("coverage.png")
    >>> states = sp.plots.plot_coverage(coverage, layers=("p_los", "p_nlos", "p_outage"))
    """
    maps = transmitters_of(coverage)
    chosen = _choose(layers, threshold_db, coverage)
    figure = _plot_rows(maps, chosen) if len(maps) > 1 else _plot_sheet(next(iter(maps.values())), chosen)
    figure.suptitle(headline("Coverage", maps).replace(": ", "\n", 1))
    _add_legend(figure, [*maps.values()], chosen)
    return figure


def _plot_sheet(coverage: xr.Dataset, layers: Sequence[Layer]) -> Figure:
    aspect = coverage.sizes["x"] / coverage.sizes["y"]
    columns = sheet_columns(len(layers), aspect)
    figure, axes = _panels(math.ceil(len(layers) / columns), columns, aspect, keys_in=_KEY_IN * columns)
    panels = list(itertools.chain(*axes))
    for axis in panels[len(layers) :]:
        axis.set_axis_off()
    for axis, layer in zip(panels, layers, strict=False):
        _draw(axis, coverage, layer)
        axis.set_title(layer.title, fontsize="medium" if columns > 2 else "large")
        _add_key([axis], layer)
    return figure


def _plot_rows(maps: Mapping[str, xr.Dataset], layers: Sequence[Layer]) -> Figure:
    sizes = next(iter(maps.values())).sizes
    figure, axes = _panels(len(maps), len(layers), sizes["x"] / sizes["y"], keys_in=0.3)
    for row, (name, coverage) in zip(axes, maps.items(), strict=True):
        for axis, layer in zip(row, layers, strict=True):
            _draw(axis, coverage, layer)
        row[0].set_ylabel(f"{textwrap.shorten(name, _ROW_NAME, placeholder='...')}\n\ny [m]", parse_math=False)
    for column, layer in zip(zip(*axes, strict=True), layers, strict=True):
        column[0].set_title(layer.title, fontsize="medium")
        _add_key(column, layer, _KEY_PAD_IN / figure.get_figheight())
    return figure


def plot_comparison(
    coverages: Mapping[str, xr.Dataset], layers: Sequence[str] = ("link_state", "gain_mean_db")
) -> Figure:
    """Draw coverage maps of one area: a column per title, a row per layer (paper, Fig. 5).

    Walls that only the first map contains are grey in the others.
    """
    require(len(coverages) > 0, "coverages", dict(coverages), "give at least one coverage map.")
    coverages = {title: require_coverage(coverage) for title, coverage in coverages.items()}
    first, *others = coverages.values()
    chosen = _choose(layers, -100.0, first)
    figure, axes = _panels(len(chosen), len(coverages), first.sizes["x"] / first.sizes["y"], keys_in=1.6)
    for row, layer in zip(axes, chosen, strict=True):
        for axis, coverage in zip(row, coverages.values(), strict=True):
            _draw(axis, coverage, layer, first)
        row[0].set_ylabel(f"{layer.title}\n\ny [m]")
        _add_key(row, layer)
    for axis, (title, coverage) in zip(axes[0], coverages.items(), strict=True):
        axis.set_title(_heading(title, coverage))
    figure.suptitle(headline("Coverage by what is observed of the map", {"": first}).replace(": ", "\n", 1))
    _add_legend(figure, [first, *others], chosen)
    return figure


def _choose(layers: Sequence[str], threshold_db: float, coverage: xr.Dataset) -> list[Layer]:
    require_number("threshold_db", threshold_db, GAIN_FLOOR_DB, 0.0)
    known = coverage_layers(threshold_db, coverage)
    named = isinstance(layers, Sequence) and not isinstance(layers, str) and len(layers) > 0
    require(named, "layers", layers, f"give some of {', '.join(known)}.")
    for name in layers:
        require_choice("layers", name, known)
    return [known[name] for name in layers]


def headline(what: str, maps: Mapping[str, xr.Dataset]) -> str:
    """Return a title: transmitters, frequency, walls and, for a partial map, receivers."""
    attributes = next(iter(maps.values())).attrs
    if attributes.get("receivers") == "indoor" and not attributes["map_complete"]:
        what = f"{what} for receivers that are indoors"
    walls = f", {attributes['walls']}" if "walls" in attributes else ""
    return f"{what}: {transmitter_text(maps)}, {attributes['frequency_hz'] / 1e9:g} GHz{walls}"


def _heading(title: str, coverage: xr.Dataset) -> str:
    observed = float(coverage.attrs["map_observed_fraction"])
    partial = observed > 0.0 and not coverage.attrs["map_complete"]
    return f"{title}, {observed:.0%} observed" if partial else title


def _panels(rows: int, columns: int, aspect: float, *, keys_in: float) -> tuple[Figure, list[list[Axes]]]:
    """Make a page-wide figure with panels of one scale; colour bars take `keys_in`."""
    page = _NARROW_IN if columns < 3 else _WIDE_IN
    highest = 12.0 if rows == 1 else max(_HIGHEST_IN / rows, 2.5)
    height = min(max(((page - 0.55 - keys_in) / columns - 0.1) / aspect, 0.4), highest)
    figure = Figure(figsize=(page, rows * (height + 0.35) + 1.6), dpi=_DPI, layout="compressed")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axis in axes.flat:
        axis.set(xlabel="x [m]", ylabel="y [m]")
        axis.label_outer()
    return figure, axes.tolist()


def _add_key(axes: Sequence[Axes], layer: Layer, pad_below: float = 0.0) -> None:
    if layer.label:
        colours = ScalarMappable(layer.norm, layer.cmap)
        where: dict[str, Any] = {"location": "right", "pad": 0.05}
        if pad_below:
            where = {"location": "bottom", "pad": pad_below, "shrink": 0.88}
        extend = "neither" if layer.label == "probability" else "max"
        figure: Any = axes[0].figure
        bar = figure.colorbar(colours, ax=axes, panchor=False, extend=extend, **where)
        bar.set_label(layer.label)
        (x0, x1), (y0, y1) = axes[0].get_xlim(), axes[0].get_ylim()
        is_low = not pad_below and (y1 - y0) / (x1 - x0) < _LOW_ASPECT
        bar.locator = MaxNLocator(2 if is_low else 4 if pad_below else 6)
        if is_low:
            bar.ax.yaxis.label.set(rotation=0, ha="left", va="center")
    elif layer.norm is None:
        _draw_triangle(axes[-1].inset_axes((0.32, -0.7, 0.36, 0.4) if pad_below else (1.02, 0.3, 0.36, 0.4)))


def _draw_triangle(key: Axes) -> None:
    height = 3**0.5 / 2
    x, y = np.meshgrid(np.linspace(0.0, 1.0, 200), np.linspace(0.0, 1.0, 200))
    p_nlos = x - y / 2
    picture = np.clip(mix_state_colours(1.0 - p_nlos - y, p_nlos, y), 0.0, 1.0)
    image = key.imshow(picture, extent=(0.0, 1.0, 0.0, height), origin="lower", interpolation="bilinear")
    outline = Polygon([(0.0, 0.0), (1.0, 0.0), (0.5, height)], fill=False, edgecolor="0.3", linewidth=0.6)
    key.add_patch(outline)
    image.set_clip_path(outline)
    key.set(xlim=(-0.35, 1.35), ylim=(-0.3, 1.25), aspect="equal")
    key.set_axis_off()
    for x_text, y_text, name, align in (
        (0.0, -0.08, "LOS", "top"),
        (1.0, -0.08, "NLOS", "top"),
        (0.5, height + 0.05, "outage", "bottom"),
    ):
        key.text(x_text, y_text, name, ha="center", va=align, fontsize="small")


def _draw(
    axis: Axes, coverage: xr.Dataset, layer: Layer, reference: xr.Dataset | None = None, halo_px: int = 0
) -> None:
    extent = extent_m(coverage)
    wall = wall_cells(coverage)
    picture = _fill(np.asarray(layer.picture(coverage)), coverage["valid"].to_numpy(), wall)
    axis.imshow(picture, extent=extent, origin="lower", interpolation="nearest", norm=layer.norm, cmap=layer.cmap)
    axis.imshow(shade(outside(coverage), grey=255), extent=extent, origin="lower", interpolation="nearest")
    _hatch_unknown(axis, coverage)
    if reference is not None:
        axis.imshow(
            shade(wall_cells(reference), opacity=_UNSEEN_OPACITY), extent=extent_m(reference), origin="lower", zorder=3
        )
    if halo_px:  # walls stay visible on dark layers
        around = maximum_filter(wall, size=2 * halo_px + 1) & ~wall
        axis.imshow(shade(around, grey=255, opacity=_HALO), extent=extent, origin="lower", zorder=3)
    axis.imshow(shade(wall), extent=extent, origin="lower", zorder=3)
    if "transmitter_m" in coverage.attrs:
        x, y, _ = coverage.attrs["transmitter_m"]
        axis.plot(x, y, zorder=4, **_STAR)
    for x_m, y_m, inside in likely_area(coverage):
        for colour, width in (("white", 2.4), ("black", 1.0)):
            axis.contour(x_m, y_m, inside, levels=[0.5], colors=colour, linewidths=width, zorder=4)
    axis.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")


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


def _hatched(coverage: xr.Dataset) -> Bools:
    return ~coverage["observed"].to_numpy() & ~outside(coverage)


def unobserved_area(coverage: xr.Dataset) -> tuple[Floats, Floats, Floats]:
    """Return x (nx + 2,) and y (ny + 2,) of cells with a border, and hatched cells as 1."""
    step = coverage.attrs["spacing_m"] * np.array([-1.0, 1.0])
    x, y = (np.r_[axis_m[0] + step[0], axis_m, axis_m[-1] + step[1]] for axis_m in (coverage["x"], coverage["y"]))
    return x, y, np.pad(_hatched(coverage), 1, mode="edge").astype(float)


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


def _draw_named_walls(axis: Axes, partial: PartialMap | None) -> list[Patch]:
    """Draw the walls whose material the map names in its colour, and return the handles of the legend."""
    if partial is None:
        return []
    x0, y0, x1, y1 = partial.bounds_m
    for material, where in named_walls(partial).items():
        picture = np.zeros((*where.shape, 4))
        picture[where] = to_rgba(material_colour(material))
        axis.imshow(picture, extent=(x0, x1, y0, y1), origin="lower", interpolation="nearest", zorder=3.2)
    return [Patch(facecolor=material_colour(each), label=material_name(each)) for each in named_walls(partial)]


def _draw_names(axis: Axes, coverage: xr.Dataset) -> None:
    x_m, y_m = (coverage[name].to_numpy() for name in TX_COORDINATES[:2])
    axis.plot(x_m, y_m, zorder=4, **_STAR)
    for place in zip(coverage["tx"].to_numpy(), zip(x_m, y_m, strict=True), strict=True):
        axis.annotate(*place, (7, 0), textcoords="offset points", va="center", zorder=5, **_NAME)


def plot_layer(
    coverage: xr.Dataset,
    one: xr.Dataset,
    layer: Layer,
    outline: Outline | None,
    partial: PartialMap,
    title: str,
    plan: tuple[States, tuple[float, float]] | None = None,
    draw_marks: Callable[[Axes], Sequence[Line2D | Patch]] | None = None,
) -> Figure:
    """Draw a layer of `one` (y, x) with all transmitters of `coverage`, as on the page of the app.

    `plan` has shades (rows, columns) of a floor plan, and its width and height [m]; `draw_marks` draws on the axes, and
    returns handles of the legend.
    """
    aspect = one.sizes["x"] / one.sizes["y"]
    figure, ((axis,),) = _panels(1, 1, aspect, keys_in=1.2)
    _draw(axis, one, layer, halo_px=1)
    if plan is not None:
        shade, (width_m, height_m) = plan
        picture = np.zeros((*shade.shape, 4), dtype=np.uint8)
        picture[..., 3] = np.array(INK)[shade]
        limits = axis.get_xlim(), axis.get_ylim()
        axis.imshow(picture, extent=(0.0, width_m, 0.0, height_m), zorder=1.5)
        axis.set(xlim=limits[0], ylim=limits[1])
    handles: list[Line2D | Patch] = [Line2D([], [], label="transmitter", **_STAR), *_draw_named_walls(axis, partial)]
    handles += [Patch(facecolor="black", label="wall")] if wall_cells(one).any() else []
    handles += outline.draw(axis, one) if outline else []
    if _hatched(one).any():
        handles.append(_not_observed())
    handles += draw_marks(axis) if draw_marks else []
    _draw_names(axis, coverage)
    bar = figure.colorbar(ScalarMappable(layer.norm, layer.cmap), ax=axis, label=layer.label, panchor=False)
    if layer.ticks is not None:
        bar.set_ticks(layer.ticks[0], labels=layer.ticks[1])
    heading, _, more = title.partition("\n")
    axis.set_title(layer.title)
    figure.suptitle(f"{heading}\n{textwrap.fill(more, _TITLE_WIDTH)}", parse_math=False)
    legend_below(figure, handles, columns=4)
    return figure


def likely_area(coverage: xr.Dataset) -> list[tuple[Floats, Floats, Floats]]:
    """Return, as `unobserved_area`, cells with 90 % of an unknown transmitter's posterior, or nothing."""
    if "p_transmitter" not in coverage:
        return []
    x, y = (coverage[f"tx_{name}"].to_numpy() for name in "xy")
    step_m = max([*np.diff(x), *np.diff(y)], default=1.0)
    axes = (np.r_[axis_m[0] - step_m, axis_m, axis_m[-1] + step_m] for axis_m in (x, y))
    return [(*axes, np.pad(likely_region(coverage["p_transmitter"].to_numpy()), 1).astype(float))]


def _add_legend(figure: Figure, coverages: Sequence[xr.Dataset], layers: Sequence[Layer]) -> None:
    """Draw the legend; walls of the first map alone are "not observed" in the others."""
    handles: list[Line2D | Patch] = [Line2D([], [], label="transmitter", **_STAR)]
    located = any("p_transmitter" in coverage for coverage in coverages)
    if located:
        handles.append(Line2D([], [], color="black", linewidth=1.0, label="transmitter, 90 %"))
    if any(layer.norm is not None and not layer.label for layer in layers):
        states = (LinkState.LOS, "LOS"), (LinkState.NLOS, "NLOS"), (LinkState.OUTAGE, "outage")
        handles += [Patch(facecolor=STATE_COLOURS[state], label=name) for state, name in states]
    walls = [wall_cells(coverage) for coverage in coverages]
    if any(wall.any() for wall in walls):
        handles.append(Patch(facecolor="black", label="wall"))
    if any((walls[0] & ~wall).any() for wall in walls[1:]):
        handles.append(Patch(facecolor="black", alpha=_UNSEEN_OPACITY, label="wall, not observed"))
    if any(_hatched(coverage).any() for coverage in coverages):
        handles.append(_not_observed())
    note = _OUTAGE_NOTE if any(layer.label == "dB" for layer in layers) else ""
    legend_below(figure, handles, columns=4 if located else None, title=note)


def _not_observed() -> Patch:
    return Patch(facecolor="0.55", hatch=2 * _HATCH, edgecolor="white", linewidth=0.0, label="not observed")


def report_pdf(coverage: xr.Dataset, **given: Any) -> bytes:
    """Return `plot_report` as PDF; equal arguments give equal bytes."""
    figure, stream = plot_report(coverage, **given), io.BytesIO()
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axis in figure.axes:  # the last bits of the layout depend on memory addresses
        axis.set_position(np.round(np.multiply(axis.get_position(original=True).bounds, _STEPS)) / _STEPS)
    figure.savefig(stream, format="pdf", metadata={"CreationDate": None, "Title": "Radio coverage"})
    return stream.getvalue()


def plot_report(
    coverage: xr.Dataset,
    *,
    eirp_dbm: ArrayLike,
    threshold_dbm: float,
    heading: Sequence[str] = (),
    scene: PartialMap | None = None,
    logo: str | os.PathLike[str] | bytes | None = None,
) -> Figure:
    """Draw a report of one page: maps, covered area of transmitters and rooms, uncertainty, materials of walls.

    Parameters
    ----------
    coverage : xarray.Dataset
        From `predict_map`, of up to about ten transmitters.
    eirp_dbm : float or (T,) array-like
        Power of each transmitter, with its antenna [dBm].
    threshold_dbm : float
        Received power that a receiver needs [dBm].
    heading : sequence of str
        Parts of the title, such as a name and a date.
    scene : PartialMap, optional
        The map, which has the materials of walls.
    logo : path-like or bytes, optional
        PNG or JPEG of up to 1 MB, for the upper right corner.

    Raises
    ------
    SettingsError
        For anything but a coverage map, a wrong number of powers, or a file that is no such logo.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(3)
    >>> coverage = sp.predict_map(home, {"hall": (2.0, 3.0, 1.5)}, spacing_m=0.5)
    >>> figure = sp.plots.plot_report(coverage, eirp_dbm=23.0, threshold_dbm=-67.0, scene=home)
    >>> figure.savefig("report.pdf")
    """
    maps, picture = transmitters_of(coverage), None if logo is None else read_logo(logo)
    if "tx" not in coverage.dims:
        maps = {_ONLY: next(iter(maps.values()))}
        coverage = named_transmitter(coverage, _ONLY)
    count = np.size(eirp_dbm)
    require(count in (1, len(maps)), "eirp_dbm", eirp_dbm, f"give one power, or {len(maps)}.")
    powers_dbm, partial = np.broadcast_to(np.asarray(eirp_dbm, dtype=np.float64), len(maps)), scene
    notes = (textwrap.fill(note, _REPORT_WIDTH) for note in _report_notes(coverage, partial))
    text = "\n\n".join([_report_table(coverage, maps, powers_dbm, threshold_dbm), *notes])
    text_in = _REPORT_LINE_IN * (text.count("\n") + 2)
    figure = Figure(figsize=_A4_IN, layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(_A4_IN[1] - text_in, text_in))
    _draw_report(parts[0], coverage, maps, powers_dbm, threshold_dbm, _A4_IN[1] - text_in - 0.6, partial)
    lines = " \N{MIDDLE DOT} ".join(["Radio coverage", *heading]), headline("Prediction", maps)
    width = _TITLE_WIDTH if picture is None else _TITLE_BESIDE_LOGO
    look: dict[str, Any] = {} if picture is None else {"x": 0.02, "ha": "left"}
    title = "\n".join(textwrap.fill(line, width) for line in lines)
    figure.suptitle(title, fontsize="medium", parse_math=False, **look)
    if picture is not None:
        _draw_logo(figure, picture)
    axis = parts[1].subplots()
    axis.set_axis_off()
    axis.text(0.02, 1.0, text, va="top", family="monospace", fontsize=7.5, parse_math=False, transform=axis.transAxes)
    return figure


def _draw_logo(figure: Figure, picture: States) -> None:
    """Draw a logo in the upper right corner, beside the title."""
    rows, columns = picture.shape[:2]
    scale = min(_LOGO_IN[0] / columns, _LOGO_IN[1] / rows)
    width, height = columns * scale / _A4_IN[0], rows * scale / _A4_IN[1]
    axis = figure.add_axes((0.98 - width, 0.99 - height, width, height))
    axis.set_in_layout(False)
    axis.imshow(picture, aspect="auto", interpolation="antialiased")
    axis.set_axis_off()


def _report_grid(most: int, aspect: float, height_in: float) -> tuple[int, int]:
    """Return the number of panels, two or more, and the columns that give them most of the page.

    Colour bars are beside the panels of one column, else below each panel.
    """

    def area(grid: tuple[int, int]) -> float:
        count, columns = grid
        more_in = _BESIDE_IN if columns == 1 else _BELOW_IN
        width_in = min(_A4_IN[0] / columns - more_in[0], aspect * (height_in / math.ceil(count / columns) - more_in[1]))
        return count * max(width_in, 0.0) ** 2

    return max(((count, columns) for count in range(2, most + 1) for columns in (1, 2, count)), key=area)


def _draw_report(
    pictures: Any,
    coverage: xr.Dataset,
    maps: Mapping[str, xr.Dataset],
    powers_dbm: Floats,
    threshold_dbm: float,
    height_in: float,
    partial: PartialMap | None,
) -> None:
    power = coverage.radio.power(eirp_dbm=powers_dbm)["power_mean_dbm"].to_numpy()
    strongest = np.nan_to_num(power, nan=-np.inf).argmax(axis=0)
    thresholds_db = np.clip(threshold_dbm - powers_dbm, GAIN_FLOOR_DB, 0.0)
    above = np.fmax.reduce(
        [probability_above(*pair) for pair in zip(maps.values(), thresholds_db.tolist(), strict=True)]
    )
    outline = Outline(above, _LIKELY, f"P = {_LIKELY:g}", f"P(> {threshold_dbm:g} dBm) < {_LIKELY:g}")
    spread = _taken(coverage["gain_std_db"].to_numpy(), strongest)
    level, probability = Normalize(threshold_dbm - 30.0, threshold_dbm + 40.0), Normalize(0.0, 1.0)
    servers = Normalize(-0.5, len(maps) - 0.5), ListedColormap(server_colours(len(maps)))
    panels = [
        Layer("Mean received power", lambda _: _taken(power, strongest), level, "viridis", "dBm"),
        Layer(f"P(received power > {threshold_dbm:g} dBm)", lambda _: above, probability, "cividis", "probability"),
        Layer("Strongest transmitter", lambda _: strongest.astype(float), *servers),
        Layer("Standard deviation", lambda _: spread, Normalize(0.0, 30.0), "magma", "dB"),
    ]
    if len(maps) == 1:
        del panels[2]
    count, columns = _report_grid(len(panels), coverage.sizes["x"] / coverage.sizes["y"], height_in)
    axes = pictures.subplots(math.ceil(count / columns), columns, squeeze=False).ravel()
    one = next(iter(maps.values()))
    for axis, layer in zip(axes[:count], panels, strict=False):
        _draw(axis, one, layer, halo_px=1)
        handles = [*_draw_named_walls(axis, partial), *outline.draw(axis, one)]
        _draw_names(axis, coverage)
        axis.set_title(layer.title, fontsize="medium")
        where = {"location": "right" if columns == 1 else "bottom", "shrink": 0.9}
        bar = pictures.colorbar(ScalarMappable(layer.norm, layer.cmap), ax=axis, label=layer.label, **where)
        if not layer.label:
            bar.set_ticks(range(len(maps)), labels=[name[:_ROW_NAME] for name in maps])
    for axis in axes[count:]:
        axis.set_axis_off()
    if handles:
        pictures.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize="small")


def _taken(values: Floats, index: NDArray[np.integer[Any]]) -> Floats:
    return np.take_along_axis(values, index[None], axis=0)[0]


def _report_table(
    coverage: xr.Dataset, maps: Mapping[str, xr.Dataset], powers_dbm: Floats, threshold_dbm: float
) -> str:
    rows = [f"Observed floor / all floor above, with P = {_LIKELY:g}"]
    for (name, one), power_dbm in zip(maps.items(), powers_dbm, strict=True):
        x, y, z = one.attrs["transmitter_m"]
        rows.append(f"{name[:_ROW_NAME]} at ({x:z.2f}, {y:z.2f}, {z:z.2f}) m, {power_dbm:g} dBm")
    rows += ["any transmitter"] if len(maps) > 1 else []
    rooms = room_fractions(coverage, threshold_dbm, powers_dbm)[:_MOST_ROOMS]
    rows = [row.ljust(max(map(len, rows))) for row in rows]
    for level_dbm in threshold_dbm + _REPORTED_DB:
        given: Any = {"probability": _LIKELY, "eirp_dbm": powers_dbm}
        area = coverage.radio.area(level_dbm, **given)["fraction"].to_numpy().T
        together = coverage.radio.area(level_dbm, any_transmitter=True, **given)["fraction"].to_numpy()
        cells = [f"{seen:.0%} /{every:>4.0%}" for seen, every, *_ in (*area, together)]
        rows = [row + cell.rjust(13) for row, cell in zip(rows, [f"{level_dbm:g} dBm", *cells], strict=False)]
    if rooms:
        each = ", ".join(f"{name} {fraction:.0%}" for name, fraction in rooms)
        of_rooms = f"Rooms above {threshold_dbm:g} dBm, the least covered first: {each}"
        rows += ["", textwrap.fill(of_rooms, _REPORT_WIDTH)]
    return "\n".join(rows)


def room_fractions(coverage: xr.Dataset, threshold_dbm: float, powers_dbm: ArrayLike) -> list[tuple[str, float]]:
    """Return the rooms of a map of named transmitters and their covered fractions, the least covered first."""
    area = coverage.radio.area(threshold_dbm, probability=_LIKELY, eirp_dbm=powers_dbm, any_transmitter=True)
    of_rooms = area["fraction"].isel(floor=slice(len(FLOORS), None))
    rooms = zip(map(str, of_rooms["floor"].to_numpy()), of_rooms.to_numpy().tolist(), strict=True)
    return sorted([room for room in rooms if np.isfinite(room[1])], key=lambda room: room[1])


def _report_notes(coverage: xr.Dataset, partial: PartialMap | None) -> list[str]:
    attributes = coverage.attrs
    notes = [
        f"Receivers are {attributes['rx_height_m']:g} m high and {attributes['spacing_m']:g} m apart. Axes are in m. "
        f"{attributes['map_observed_fraction']:.0%} of the map is observed. Predictor: {attributes['predictor']}. "
        f"The hatched side of a line is not above the threshold with a probability of {_LIKELY:g}. Unobserved floor "
        "counts with the probability that it is indoors."
    ]
    if "measured_links" in attributes:
        notes[0] += f" {attributes['measured_links']:,} measured powers correct the prediction."
    std_db = coverage["gain_std_db"].to_numpy()
    observed = np.broadcast_to(coverage["observed"].to_numpy() == 1, std_db.shape) & np.isfinite(std_db)
    spreads = [
        f"{std_db[where].mean():.1f} dB on the {what} floor"
        for what, where in (("observed", observed), ("unobserved", ~observed & np.isfinite(std_db)))
        if where.any() and not (attributes["map_complete"] and what == "unobserved")
    ]
    uncertainty = f"Uncertainty: the mean standard deviation of the path gain is {', '.join(spreads)}. "
    if attributes["map_complete"]:
        uncertainty += (
            "The map is complete, and rays were traced in it: errors of the map, and furniture that it lacks, "
        )
        uncertainty += f"are {'' if 'wall_material' in attributes else 'not '}in that deviation."
    else:
        uncertainty += (
            "Rays were traced in the observed part; the rest is a distribution learned from other buildings. "
        )
        uncertainty += "An area counts where that distribution exceeds the power with the probability above."
    fractions = {} if partial is None else partial.wall_fractions
    named = [f"{material_name(each)} ({part:.0%} of the walls)" for each, part in fractions.items() if each]
    if "wall_material" in attributes:
        walls = f"{'others ' if named else ''}not known; probabilities: {attributes['wall_material']}. That is part of "
        walls = ", ".join([*named, walls + "the deviation"])
    else:
        material = Material(**json.loads(attributes["scene_settings"])["material"])
        walls = ", ".join([*named, material_name(material) if None in fractions or not named else "no others"])
        walls += "" if partial else ", except walls whose material the map has"
        walls += "; no path passes through walls" if attributes.get("walls") == "opaque walls" else ""
    return [*notes, uncertainty, f"Material of the walls: {walls}."]


def plot_network(network: xr.Dataset) -> Figure:
    """Draw best server, mean SINR, probability of enough SINR, and mean rate of a network.

    Parameters
    ----------
    network : xarray.Dataset
        From `predict_network`.

    Raises
    ------
    SettingsError
        For anything but a network map.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> coverage = sp.predict_map(sp.make_home(7), {"a": (3.0, 4.0, 2.2), "b": (6.0, 3.0, 1.0)}, spacing_m=0.5)
    >>> figure = sp.plots.plot_network(sp.predict_network(coverage))
    >>> figure.savefig("network.png")
    """
    require_network(network)
    aspect = network.sizes["x"] / network.sizes["y"]
    height = min(max((_NETWORK_WIDTH_IN / 2 - 1.2) / aspect, 2.0), 9.0)
    figure = Figure(figsize=(_NETWORK_WIDTH_IN, 2 * height + 1.6), dpi=_NETWORK_DPI, layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    names = [str(name) for name in network["tx"].to_numpy()]
    servers = ListedColormap(server_colours(len(names)))
    best, norm = network["best_server"].to_numpy(), Normalize(-0.5, len(names) - 0.5)
    _draw_network(axes[0, 0], network, np.where(best >= 0, best, np.nan), servers, norm)
    axes[0, 0].set_title("Most probable best server")
    bar = figure.colorbar(ScalarMappable(norm, servers), ax=axes[0, 0], ticks=range(len(names)))
    bar.ax.set_yticklabels(names, parse_math=False)
    threshold_db = float(network.attrs["sinr_threshold_db"])
    rate_name = str(network["rate_bit_s"].attrs.get("long_name", "mean rate")).capitalize()
    top_bit_s = float(np.nanmax(network["rate_bit_s"])) / 1e6 if np.isfinite(network["rate_bit_s"]).any() else 1.0
    layers = (
        (axes[0, 1], "sinr_mean_db", 1.0, Normalize(-20.0, 40.0), "Mean SINR [dB]"),
        (axes[1, 0], "p_sinr_above", 1.0, Normalize(0.0, 1.0), f"P(SINR > {threshold_db:g} dB)"),
        (axes[1, 1], "rate_bit_s", 1e-6, Normalize(0.0, top_bit_s), f"{rate_name} [Mbit/s]"),
    )
    for axis, name, scale, norm, title in layers:
        _draw_network(axis, network, scale * network[name].to_numpy(), "viridis", norm)
        figure.colorbar(ScalarMappable(norm, "viridis"), ax=axis)
        axis.set_title(title)
    for axis in axes.flat:
        axis.label_outer()
    seen = Line2D([], [], color="0.7", label="border of the observed part")
    legend_below(figure, [Line2D([], [], label="transmitter", **_STAR), seen])
    bandwidth_mhz = float(network.attrs["bandwidth_hz"]) / 1e6
    what = f"Network of {len(names)} transmitter{'s' * (len(names) > 1)}"
    figure.suptitle(f"{what}, {bandwidth_mhz:g} MHz, load {network.attrs['load']:g}")
    return figure


def _draw_network(
    axis: Axes, network: xr.Dataset, picture: Floats, cmap: str | ListedColormap, norm: Normalize
) -> None:
    extent = extent_m(network)
    shown = np.ma.masked_invalid(picture)
    axis.imshow(shown, extent=extent, origin="lower", interpolation="nearest", norm=norm, cmap=cmap)
    axis.imshow(shade(wall_cells(network)), extent=extent, origin="lower", zorder=3)
    unseen = ~network["observed"].to_numpy().astype(bool)
    if min(unseen.shape) > 1:
        axis.contour(network["x"], network["y"], unseen, levels=[0.5], colors="0.7", linewidths=0.8)
    x, y, _ = (network[name].to_numpy() for name in TX_COORDINATES)
    axis.plot(x, y, zorder=4, **_STAR)
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
