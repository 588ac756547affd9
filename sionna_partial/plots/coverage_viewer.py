"""A coverage map as an HTML page."""

import html
import json
import re
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import ListedColormap, Normalize, to_hex

from sionna_partial.arrays import Floats
from sionna_partial.coverage.dataset import COMPONENTS, DISTRIBUTION, transmitters_of
from sionna_partial.plots.layers import Layer, coverage_layers, headline
from sionna_partial.plots.panel import extent_m, likely_area, outside, unobserved_area, wall_cells
from sionna_partial.plots.style import server_colours
from sionna_partial.resources import optional_packages

THRESHOLD_DB = -100.0
"""Initial threshold of P(gain > threshold) [dB]."""

_WIDTH, _HEIGHT, _SHORTEST, _COLOURS, _STEPS = 760, 1000, 60, 256, 1024
_LAYERS = ("link_state", "p_los", "p_nlos", "p_outage", "gain_mean_db", "gain_std_db", "p_above", "best_server")
STATES = ["outage", "LOS", "NLOS"]
"""Names of link states."""

_STRONGEST = "best server"
_TOOLTIPS = (
    ("x, y", "$x{0.00} m, $y{0.00} m"),
    ("most probable state", "@link_state{custom}"),
    ("LOS, NLOS, outage", "@p_los{0.000}, @p_nlos{0.000}, @p_outage{0.000}"),
    ("path gain", "@gain_mean_db{0.0} ± @gain_std_db{0.0} dB"),
    ("P(gain > threshold)", "@p_above{0.000}"),
    ("unobserved distance", "@unobserved_distance_m{0.00} m"),
)

_SEVERAL = "The best server of a receiver is the transmitter with the largest mean path gain."
_UNKNOWN = "; a line encloses 90 % of where it may be"

_SHOW = """
for (const [name, parts] of Object.entries(layers)) for (const part of parts) part.visible = name == choice.value
const label = select => select.options.find(([name, _]) => name == select.value)[1]
title.text = label(choice).replace("threshold", `${slider.value} dB`)
if (server && choice.value != "best_server") title.text += `: ${label(server)}`
"""

_SERVE = "shown.indices = [Number(server.value)]"

_THRESHOLD = """
const above = (mean, std) => {
    if (!(std > 0)) return mean > slider.value ? 1 : 0
    const z = (mean - slider.value) / std / Math.SQRT2, t = 1 / (1 + 0.3275911 * Math.abs(z))
    const sum = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    const tail = 0.5 * sum * Math.exp(-z * z)
    return z > 0 ? 1 - tail : tail
}
for (const tx of source.data.p_above.keys()) {
    const [p_los, p_nlos, los, los_std, nlos, nlos_std, out] =
        ["p_los", "p_nlos", "gain_los_mean_db", "gain_los_std_db", "gain_nlos_mean_db", "gain_nlos_std_db", "p_above"]
        .map(name => source.data[name][tx])
    for (let i = 0; i < out.length; i++)
        out[i] = p_los[i] * above(los[i], los_std[i]) + p_nlos[i] * above(nlos[i], nlos_std[i])
}
source.change.emit()
"""
"""The error function follows Abramowitz and Stegun, 7.1.26, with an error below 1.5e-7."""

_PAGE = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")


def coverage_page(coverage: xr.Dataset) -> bytes:
    """Return the self-contained HTML page of a coverage map; equal maps give equal pages."""
    with optional_packages():
        from bokeh.embed import json_item
        from bokeh.resources import Resources
    maps = transmitters_of(coverage)
    item = json.dumps(json_item(_viewer(maps))).replace("<", "\\u003c")
    numbers: dict[str, str] = {}
    item = re.sub(r'(?<=id": )"p\d+"', lambda name: numbers.setdefault(name[0], f'"p{len(numbers)}"'), item)
    scripts = Resources(mode="inline", components=["bokeh", "bokeh-widgets"]).js_raw
    page = _PAGE.format(
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
        headline=html.escape(headline("Coverage", maps)),
        several=_SEVERAL * (len(maps) > 1),
        unknown=_UNKNOWN * ("p_transmitter" in coverage),
        predictor=html.escape(str(coverage.attrs.get("predictor", "unknown"))),
        item=item,
    )
    return page.encode()


def _viewer(maps: Mapping[str, xr.Dataset]) -> Any:
    from bokeh.layouts import column, row
    from bokeh.models import CDSView, CustomJS, IndexFilter
    from bokeh.models.widgets.inputs import Select
    from bokeh.models.widgets.sliders import Slider

    words, one = {"link_state": STATES}, next(iter(maps.values()))
    layers = {name: layer for name, layer in coverage_layers(THRESHOLD_DB, one).items() if name in _LAYERS}
    if len(maps) > 1:
        layers["best_server"] = _best_server(maps)
        words["best_server"] = [*maps]
    source, shown, plot = _source(maps, layers), IndexFilter(indices=[0]), _empty_plot(one)
    geometry = {"source": source, "view": CDSView(filter=shown)} | _rectangle(one)
    parts = {name: add_layer(plot, geometry, name, layer, words.get(name, ())) for name, layer in layers.items()}
    _add_hover(plot, [images[0] for images in parts.values()], words)
    _add_map(plot, maps)
    titles = {name: layers[name].title for name in _LAYERS if name in layers}
    titles["p_above"] = "P(path gain > threshold)"
    choice = Select(title="Layer", value=_LAYERS[0], options=list[Any](titles.items()), name="layer")
    slider = Slider(title="Threshold [dB]", start=-150, end=-40, step=1, value=THRESHOLD_DB, name="threshold")
    servers: list[Any] = [(str(at), name) for at, name in enumerate([*maps, _STRONGEST])]
    server = Select(title="Transmitter", value="0", options=servers, name="transmitter") if len(maps) > 1 else None
    show = CustomJS(
        args={"layers": parts, "choice": choice, "slider": slider, "server": server, "title": plot.title}, code=_SHOW
    )
    choice.js_on_change("value", show)
    slider.js_on_change("value", CustomJS(args={"source": source, "slider": slider}, code=_THRESHOLD), show)
    if server is None:
        return column(row(choice, slider), plot)
    plot.title.text += f": {servers[0][1]}"
    server.js_on_change("value", CustomJS(args={"shown": shown, "server": server}, code=_SERVE), show)
    return column(row(server, choice, slider), plot)


def radio_layers(servers: int) -> dict[str, Layer]:
    """Return layers of a transmitter with its power, or of the strongest, by variable."""
    known = coverage_layers(THRESHOLD_DB)
    level = Normalize(-130.0, -30.0), "viridis", "dBm"
    ratio, numbers = (Normalize(-20.0, 50.0), "viridis", "dB"), Normalize(0, servers - 1)
    added: dict[str, tuple[str, Normalize, str | ListedColormap, str]] = {
        "power_mean_dbm": ("Mean received power", *level),
        "snr_mean_db": ("Mean SNR", *ratio),
        "p_above": ("P(power > threshold)", Normalize(0.0, 1.0), "cividis", "probability"),
        "rate_mbit_s": ("Mean rate", Normalize(0.0, 1000.0), "viridis", "Mbit/s"),
        "sinr_mean_db": ("Mean SINR of the strongest", *ratio),
        "best_server": ("Strongest transmitter", numbers, ListedColormap(server_colours(servers)), ""),
    }
    layers = {name: known[name] for name in ("link_state", "gain_mean_db", "gain_std_db")}
    return layers | {
        name: Layer(title, itemgetter(name), norm, cmap, label) for name, (title, norm, cmap, label) in added.items()
    }


def server_codes(count: int) -> list[str]:
    """Return the CSS colours of transmitters."""
    cmap = ListedColormap(server_colours(count))
    return [to_hex(cmap(number)) for number in range(count)]


def level_codes(below: int, above: int) -> list[str]:
    """Return CSS colours for steps below and above a threshold, with a break between them."""
    return _viridis(np.append(np.linspace(0.0, 0.3, below), np.linspace(0.6, 1.0, above)))


def step_codes(count: int) -> list[str]:
    """Return CSS colours for equal steps."""
    return _viridis(np.linspace(0.0, 1.0, count))


def _viridis(parts: Floats) -> list[str]:
    return [to_hex(colour) for colour in colormaps["viridis"](parts)]


def _empty_plot(coverage: xr.Dataset) -> Any:
    from bokeh.models import BoxZoomTool, Range1d
    from bokeh.plotting import figure

    x0, x1, y0, y1 = extent_m(coverage)
    pixels_per_m = min(_WIDTH / (x1 - x0), _HEIGHT / (y1 - y0))
    plot: Any = figure(
        x_range=Range1d(start=x0, end=x1),
        y_range=Range1d(start=y0, end=y1),
        frame_width=max(round(pixels_per_m * (x1 - x0)), _SHORTEST),
        frame_height=max(round(pixels_per_m * (y1 - y0)), _SHORTEST),
        x_axis_label="x [m]",
        y_axis_label="y [m]",
        title=coverage_layers(THRESHOLD_DB)[_LAYERS[0]].title,
        name="plot",
        tools="pan,wheel_zoom,reset,save",
        active_scroll="wheel_zoom",
        background_fill_color="#d0d0d0",
    )
    plot.add_tools(BoxZoomTool(match_aspect=True))
    plot.toolbar.logo = None
    plot.grid.visible = False
    return plot


def _best_server(maps: Mapping[str, xr.Dataset]) -> Layer:
    gain_db = np.stack([each["gain_mean_db"].to_numpy() for each in maps.values()])
    best = np.nan_to_num(gain_db, nan=-np.inf).argmax(axis=0)
    return Layer("Best server", lambda _: best, Normalize(0, len(maps) - 1), ListedColormap(server_colours(len(maps))))


def _source(maps: Mapping[str, xr.Dataset], layers: Mapping[str, Layer]) -> Any:
    """Return values (ny, nx), a row for each transmitter and for the best server.

    NaN without a receiver and outside a complete map; rounding halves the page.
    """
    from bokeh.models import ColumnDataSource

    columns: dict[str, Any] = {name: [] for name in layers}
    for coverage in maps.values():
        values = {name: layer.picture(coverage) for name, layer in layers.items()}
        others = {*DISTRIBUTION, *COMPONENTS, "unobserved_distance_m"} - values.keys()
        values |= {name: coverage[name].to_numpy() for name in sorted(others)}
        valid = coverage["valid"].to_numpy() & ~outside(coverage)
        for name, each in values.items():
            rounded = np.round(np.where(valid, each, np.nan) * _STEPS) / _STEPS
            columns.setdefault(name, []).append(rounded.astype(np.float32))
    if "best_server" in layers:
        best = layers["best_server"].picture(coverage)[None]
        for rows in columns.values():
            rows.append(np.take_along_axis(np.stack(rows), best, axis=0)[0])
    return ColumnDataSource(columns, name="values")


def _rectangle(coverage: xr.Dataset) -> dict[str, float]:
    x0, x1, y0, y1 = extent_m(coverage)
    return {"x": x0, "y": y0, "dw": x1 - x0, "dh": y1 - y0}


def add_layer(
    plot: Any, geometry: Mapping[str, Any], name: str, layer: Layer, words: Sequence[str], side: Any = "right"
) -> list[Any]:
    """Draw a layer and colour bar, and return both; only the first is visible."""
    from bokeh.models import FixedTicker, LinearColorMapper
    from bokeh.models.annotations.legends import ColorBar

    assert layer.norm
    assert layer.cmap
    cmap, half = colormaps.get_cmap(layer.cmap), 0.5 * bool(words)
    palette = [to_hex(colour) for colour in cmap(np.linspace(0.0, 1.0, len(words) or _COLOURS))]
    low, high = float(layer.norm.vmin or 0.0) - half, float(layer.norm.vmax or 0.0) + half
    colours = LinearColorMapper(palette=palette, low=low, high=high, nan_color="#00000000")
    visible = name == _LAYERS[0]
    image = plot.image(image=name, color_mapper=colours, visible=visible, **geometry)
    bar = ColorBar(color_mapper=colours, title=layer.label, visible=visible)
    if words:
        bar.ticker = FixedTicker(ticks=[*range(len(words))])
        bar.major_label_overrides = dict(enumerate(words))
    plot.add_layout(bar, side)
    return [image, bar]


def _add_hover(plot: Any, images: list[Any], words: Mapping[str, Sequence[str]]) -> None:
    from bokeh.models import CustomJSHover, HoverTool

    formatters: dict[str, Any] = {
        f"@{name}": CustomJSHover(code=f"return {json.dumps(each)}[value] ?? 'no receiver'")
        for name, each in words.items()
    }
    best = [("best server", "@best_server{custom}")] if "best_server" in words else []
    plot.add_tools(HoverTool(renderers=images, tooltips=[*_TOOLTIPS, *best], formatters=formatters))


def _add_map(plot: Any, maps: Mapping[str, xr.Dataset]) -> None:
    from bokeh.models import LinearColorMapper

    coverage = next(iter(maps.values()))
    x, y, unknown = unobserved_area(coverage)
    if unknown.any():
        plot.contour(
            x,
            y,
            unknown,
            levels=[0.5, 1.5],
            fill_color="white",
            fill_alpha=0.04,
            hatch_pattern="/",
            hatch_color="white",
            hatch_alpha=0.4,
            hatch_scale=40.0,
        )
    wall = wall_cells(coverage).astype(np.uint8)
    black = LinearColorMapper(palette=["#00000000", "#000000"], low=0, high=1)
    plot.image(image=[wall], color_mapper=black, **_rectangle(coverage))
    for x, y, inside in likely_area(coverage):
        plot.contour(x, y, inside, levels=[0.5], line_color="white", line_width=3)
        plot.contour(x, y, inside, levels=[0.5], line_color="black", line_width=1.5)
    x_tx, y_tx, _ = np.transpose([each.attrs["transmitter_m"] for each in maps.values()])
    plot.scatter(x_tx, y_tx, marker="star", size=18, fill_color="white", line_color="black")
    if len(maps) > 1:
        plot.text(
            x_tx,
            y_tx,
            text=[*maps],
            x_offset=11,
            text_baseline="middle",
            text_font_size="12px",
            background_fill_color="white",
            background_fill_alpha=0.7,
        )
