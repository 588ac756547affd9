"""A coverage map as one HTML page: its layers, the values under the pointer, and P(gain > threshold) by a slider."""

import html
import json
import re
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import to_hex

from sionna_partial.constants import LinkState
from sionna_partial.coverage import COMPONENTS, DISTRIBUTION
from sionna_partial.plots.coverage_plot import (
    Layer,
    coverage_layers,
    extent_m,
    headline,
    likely_area,
    outside,
    unobserved_area,
    wall_cells,
)

THRESHOLD_DB = -100.0
"""Threshold of P(gain > threshold) before the slider is moved [dB]."""

_WIDTH, _HEIGHT, _SHORTEST, _COLOURS = 760, 1000, 60, 256
_LAYERS = ("link_state", "p_los", "p_nlos", "p_outage", "gain_mean_db", "gain_std_db", "p_above")
_STATES = {LinkState.OUTAGE: "outage", LinkState.LOS: "LOS", LinkState.NLOS: "NLOS"}
_TOOLTIPS = (
    ("x, y", "$x{0.00} m, $y{0.00} m"),
    ("likeliest state", "@link_state{custom}"),
    ("LOS, NLOS, outage", "@p_los{0.000}, @p_nlos{0.000}, @p_outage{0.000}"),
    ("path gain", "@gain_mean_db{0.0} ± @gain_std_db{0.0} dB"),
    ("P(gain > threshold)", "@p_above{0.000}"),
    ("unobserved distance", "@unobserved_distance_m{0.00} m"),
)

_SHOW = """
for (const [name, parts] of Object.entries(layers)) for (const part of parts) part.visible = name == choice.value
const option = choice.options.find(([name, _]) => name == choice.value)
title.text = option[1].replace("threshold", `${slider.value} dB`)
"""

_THRESHOLD = """
const above = (mean, std) => {
    if (!(std > 0)) return mean > slider.value ? 1 : 0
    const z = (mean - slider.value) / std / Math.SQRT2, t = 1 / (1 + 0.3275911 * Math.abs(z))
    const sum = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    const tail = 0.5 * sum * Math.exp(-z * z)
    return z > 0 ? 1 - tail : tail
}
const [p_los, p_nlos, los, los_std, nlos, nlos_std, out] =
    ["p_los", "p_nlos", "gain_los_mean_db", "gain_los_std_db", "gain_nlos_mean_db", "gain_nlos_std_db", "p_above"]
    .map(name => source.data[name][0])
for (let i = 0; i < out.length; i++)
    out[i] = p_los[i] * above(los[i], los_std[i]) + p_nlos[i] * above(nlos[i], nlos_std[i])
source.change.emit()
"""
"""The error function is that of Abramowitz and Stegun, 7.1.26, with an error below 1.5e-7."""

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:">
<title>Coverage map</title>
<style>body {{ font: 15px/1.5 sans-serif; margin: 1.5em; max-width: 900px }} h1 {{ font-size: 1.2em }}</style>
{scripts}
</head>
<body>
<h1>{headline}</h1>
<div id="viewer"></div>
<p>Star: transmitter; a line encloses 90 % of where an unknown one may be. Black: walls. Hatched: not observed. Grey: no
receiver can stand there. In mean and standard deviation of the path gain, an outage counts &minus;150 dB. Predictor:
{predictor}.</p>
<script>Bokeh.embed.embed_item({item}, "viewer")</script>
</body>
</html>
"""


def coverage_page(coverage: xr.Dataset) -> bytes:
    """Return the HTML page of a coverage map, which needs nothing beside it. Equal maps give equal pages."""
    from bokeh.embed import json_item
    from bokeh.resources import Resources

    item = json.dumps(json_item(_viewer(coverage))).replace("</", "<\\/")
    numbers: dict[str, str] = {}
    item = re.sub(r'"p\d+"', lambda name: numbers.setdefault(name[0], f'"p{len(numbers)}"'), item)
    scripts = Resources(mode="inline", components=["bokeh", "bokeh-widgets"]).js_raw
    page = _PAGE.format(
        scripts="\n".join(f"<script>{script}</script>" for script in scripts),
        headline=html.escape(headline("Coverage", coverage)),
        predictor=html.escape(str(coverage.attrs.get("predictor", "unknown"))),
        item=item,
    )
    return page.encode()


def _viewer(coverage: xr.Dataset) -> Any:
    from bokeh.layouts import column, row
    from bokeh.models import CustomJS
    from bokeh.models.widgets.inputs import Select
    from bokeh.models.widgets.sliders import Slider

    layers = {name: layer for name, layer in coverage_layers(THRESHOLD_DB).items() if name in _LAYERS}
    plot = _empty_plot(coverage)
    source = _source(coverage, layers)
    parts = {name: _add_layer(plot, source, coverage, name, layer) for name, layer in layers.items()}
    _add_hover(plot, [images[0] for images in parts.values()])
    _add_map(plot, coverage)
    titles = {name: layers[name].title for name in _LAYERS} | {"p_above": "P(path gain > threshold)"}
    options: list[str | tuple[Any, str]] = [*titles.items()]
    choice = Select(title="Layer", value=_LAYERS[0], options=options, name="layer")
    slider = Slider(title="Threshold [dB]", start=-150, end=-40, step=1, value=THRESHOLD_DB, name="threshold")
    show = CustomJS(args={"layers": parts, "choice": choice, "slider": slider, "title": plot.title}, code=_SHOW)
    choice.js_on_change("value", show)
    slider.js_on_change("value", CustomJS(args={"source": source, "slider": slider}, code=_THRESHOLD), show)
    return column(row(choice, slider), plot)


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


def _source(coverage: xr.Dataset, layers: dict[str, Layer]) -> Any:
    """Values (ny, nx) in one row; NaN where no receiver can stand, and outside a complete map."""
    from bokeh.models import ColumnDataSource

    values = {name: layer.picture(coverage) for name, layer in layers.items()}
    others = {*DISTRIBUTION, *COMPONENTS, "unobserved_distance_m"} - values.keys()
    values |= {name: coverage[name].to_numpy() for name in sorted(others)}
    valid = coverage["valid"].to_numpy() & ~outside(coverage)
    columns = {name: [np.where(valid, each, np.nan).astype(np.float32)] for name, each in values.items()}
    return ColumnDataSource(columns, name="values")


def _add_layer(plot: Any, source: Any, coverage: xr.Dataset, name: str, layer: Layer) -> list[Any]:
    """Draw a layer with its colour bar, and return both; the first layer alone is visible."""
    from bokeh.models import FixedTicker, LinearColorMapper
    from bokeh.models.annotations.legends import ColorBar

    assert layer.norm
    assert layer.cmap
    listed = name == "link_state"
    cmap, half = colormaps.get_cmap(layer.cmap), 0.5 * listed
    palette = [to_hex(colour) for colour in cmap(np.linspace(0.0, 1.0, len(_STATES) if listed else _COLOURS))]
    low, high = float(layer.norm.vmin or 0.0) - half, float(layer.norm.vmax or 0.0) + half
    colours = LinearColorMapper(palette=palette, low=low, high=high, nan_color="#00000000")
    x0, x1, y0, y1 = extent_m(coverage)
    visible = name == _LAYERS[0]
    place = {"x": x0, "y": y0, "dw": x1 - x0, "dh": y1 - y0}
    image = plot.image(image=name, source=source, color_mapper=colours, visible=visible, **place)
    bar = ColorBar(color_mapper=colours, title=layer.label, visible=visible)
    if listed:
        bar.ticker = FixedTicker(ticks=[int(state) for state in _STATES])
        bar.major_label_overrides = {int(state): text for state, text in _STATES.items()}
    plot.add_layout(bar, "right")
    return [image, bar]


def _add_hover(plot: Any, images: list[Any]) -> None:
    from bokeh.models import CustomJSHover, HoverTool

    words = [text for _, text in sorted(_STATES.items())]
    state = CustomJSHover(code=f"return {json.dumps(words)}[value] ?? 'no receiver'")
    plot.add_tools(HoverTool(renderers=images, tooltips=list(_TOOLTIPS), formatters={"@link_state": state}))


def _add_map(plot: Any, coverage: xr.Dataset) -> None:
    """Draw the unobserved area hatched, the walls black, and the transmitter."""
    from bokeh.models import LinearColorMapper

    x0, x1, y0, y1 = extent_m(coverage)
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
    plot.image(image=[wall], x=x0, y=y0, dw=x1 - x0, dh=y1 - y0, color_mapper=black)
    for x, y, inside in likely_area(coverage):
        plot.contour(x, y, inside, levels=[0.5], line_color="white", line_width=3)
        plot.contour(x, y, inside, levels=[0.5], line_color="black", line_width=1.5)
    x_tx, y_tx, _ = coverage.attrs["transmitter_m"]
    plot.scatter([x_tx], [y_tx], marker="star", size=18, fill_color="white", line_color="black")
