"""Figures of coverage maps and of networks."""

import itertools
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import MaxNLocator

from sionna_partial.arrays import Floats, States
from sionna_partial.checks import require, require_choice, require_number
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.coverage.dataset import TX_COORDINATES, require_coverage, transmitters_of
from sionna_partial.coverage.network import require_network
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.layers import Layer, coverage_layers, headline, mix_state_colours
from sionna_partial.plots.panel import (
    TRANSMITTER,
    UNSEEN_OPACITY,
    Outline,
    draw_layer,
    draw_named_walls,
    draw_names,
    extent_m,
    hatched,
    hatched_key,
    wall_cells,
)
from sionna_partial.plots.style import (
    INK,
    STATE_COLOURS,
    Figure,
    legend_below,
    server_colours,
    shade,
    sheet_columns,
)

DEFAULT_LAYERS = ("link_state", "gain_mean_db", "gain_std_db", "p_above")
"""Panels of `plot_coverage`."""

_NARROW_IN, _WIDE_IN, _HIGHEST_IN, _DPI = 9.0, 11.0, 16.0, 170
"""Widths of figures of up to two and of more columns, and the height of all rows [inch]."""

_KEY_IN, _KEY_PAD_IN, _LOW_ASPECT = 0.75, 0.35, 0.2
"""Width of a colour bar and its distance below a panel [inch]; aspect from which a bar beside it has few ticks."""

_ROW_NAME, _TITLE_WIDTH = 16, 90
"""Lengths of names and titles [characters]."""

_NETWORK_WIDTH_IN, _NETWORK_DPI = 10.0, 130
_OUTAGE_NOTE = "an outage counts as a path gain of \N{MINUS SIGN}150 dB"


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
        draw_layer(axis, coverage, layer)
        axis.set_title(layer.title, fontsize="medium" if columns > 2 else "large")
        _add_key([axis], layer)
    return figure


def _plot_rows(maps: Mapping[str, xr.Dataset], layers: Sequence[Layer]) -> Figure:
    sizes = next(iter(maps.values())).sizes
    figure, axes = _panels(len(maps), len(layers), sizes["x"] / sizes["y"], keys_in=0.3)
    for row, (name, coverage) in zip(axes, maps.items(), strict=True):
        for axis, layer in zip(row, layers, strict=True):
            draw_layer(axis, coverage, layer)
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
            draw_layer(axis, coverage, layer, first)
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
    draw_layer(axis, one, layer, halo=True)
    if plan is not None:
        shade, (width_m, height_m) = plan
        picture = np.zeros((*shade.shape, 4), dtype=np.uint8)
        picture[..., 3] = np.array(INK)[shade]
        limits = axis.get_xlim(), axis.get_ylim()
        axis.imshow(picture, extent=(0.0, width_m, 0.0, height_m), zorder=1.5)
        axis.set(xlim=limits[0], ylim=limits[1])
    handles: list[Line2D | Patch] = [
        Line2D([], [], label="transmitter", **TRANSMITTER),
        *draw_named_walls(axis, partial),
    ]
    handles += [Patch(facecolor="black", label="wall")] if wall_cells(one).any() else []
    handles += outline.draw(axis, one) if outline else []
    if hatched(one).any():
        handles.append(hatched_key())
    handles += draw_marks(axis) if draw_marks else []
    draw_names(axis, coverage)
    bar = figure.colorbar(ScalarMappable(layer.norm, layer.cmap), ax=axis, label=layer.label, panchor=False)
    if layer.ticks is not None:
        bar.set_ticks(layer.ticks[0], labels=layer.ticks[1])
    heading, _, more = title.partition("\n")
    axis.set_title(layer.title)
    figure.suptitle(f"{heading}\n{textwrap.fill(more, _TITLE_WIDTH)}", parse_math=False)
    legend_below(figure, handles, columns=4)
    return figure


def _add_legend(figure: Figure, coverages: Sequence[xr.Dataset], layers: Sequence[Layer]) -> None:
    """Draw the legend; walls of the first map alone are "not observed" in the others."""
    handles: list[Line2D | Patch] = [Line2D([], [], label="transmitter", **TRANSMITTER)]
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
        handles.append(Patch(facecolor="black", alpha=UNSEEN_OPACITY, label="wall, not observed"))
    if any(hatched(coverage).any() for coverage in coverages):
        handles.append(hatched_key())
    note = _OUTAGE_NOTE if any(layer.label == "dB" for layer in layers) else ""
    legend_below(figure, handles, columns=4 if located else None, title=note)


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
    legend_below(figure, [Line2D([], [], label="transmitter", **TRANSMITTER), seen])
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
    axis.plot(x, y, zorder=4, **TRANSMITTER)
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
