"""Plot of the page: map, layers, transmitters, measured points and next views."""

import itertools
import math
from typing import Any

import numpy as np
from contourpy import contour_generator
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.apps.app.answer import LAYERS, LEVELS, RATE, Answer, View
from sionna_partial.apps.app.drawing import AREA, BRUSHES, STRAIGHT, Plan
from sionna_partial.apps.app.marks import VIEW
from sionna_partial.apps.app.radio import MOST_TRANSMITTERS
from sionna_partial.constants import CellState
from sionna_partial.exploration.next_views import NextViews
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.coverage_viewer import STATES, add_layer
from sionna_partial.plots.panel import Outline, extent_m, outside, to_the_edge
from sionna_partial.plots.style import FAILS, INK, material_colour

_UNSELECT = "points.selection_manager.clear()"
"""Otherwise the next drag would move a clicked transmitter as well."""

_STROKE = """
const is_area = mode.value == encloses
if (mode.value == "" || name == "doubletap" && !(is_area && live.data.x.length)) return
const {x, y} = cb_obj, near_m = (range.end - range.start) / 100
const again = is_area && name == "tap" && live.data.x.length > 2 &&
    Math.hypot(live.data.x.at(-1) - x, live.data.y.at(-1) - y) < near_m // a slow double click is two of them
const data = name == "panstart" || name == "tap" && !is_area ? {x: [], y: []} : live.data
const [xs, ys] = [data.x, data.y].map(each => [...each].slice(0, straight.includes(mode.value) ? 1 : Infinity))
xs.push(x); ys.push(y)
const drawn = {x: xs, y: ys, r: xs.map(() => wide.includes(mode.value) ? brush.value / 2 : 0)}
const is_done = name == "panend" || again || name == (is_area ? "doubletap" : "tap")
live.data = is_done ? {x: [], y: [], r: []} : drawn
if (is_done) stroke.data = drawn
"""
"""Draws a stroke in the browser, and sends it at its end."""

_PEN = "#0066ff"
"""Colour of strokes."""

_BELOW_PIXELS = 100
"""Height of axis and colour bar of every layer."""

_HANDLE_PIXELS = 44
"""Diameter in which a finger grabs a transmitter."""

_HOVERED = ("p_los", "p_nlos", "p_outage")
_MOST_PIXELS, _FEWEST_PIXELS, _HATCHED, _HALO = 1000, 600, 3, 4
_TOOLTIPS = (
    ("x, y", "$x{0.00} m, $y{0.00} m"),
    ("most probable state", "@link_state{custom}"),
    ("LOS, NLOS, outage", "@p_los{0.00}, @p_nlos{0.00}, @p_outage{0.00}"),
    ("path gain", "@gain_mean_db{0.0} ± @gain_std_db{0.0} dB"),
    ("received power", "@power_mean_dbm{0.0} dBm"),
    ("SNR", "@snr_mean_db{0.0} dB"),
    ("P(above threshold)", "@p_above{0.00}"),
    ("mean rate", "@rate_mbit_s{0} Mbit/s"),
)
_GROUND = ("#ffffff", "#000000", "#b9bec4", "#e4e6e9", "#ffffff")
_WALLS = ("#00000000", "#000000", "#00000000", "#ffffff60", "#ffffffcc")
"""Colours of free cells, walls, unknown cells, hatches and cells beside walls, below and above the coverage."""

_LABEL: dict[str, Any] = {
    "text_baseline": "middle",
    "text_font_size": "13px",
    "background_fill_color": "white",
    "background_fill_alpha": 0.75,
}
_MARK: dict[str, Any] = {"fill_color": VIEW, "line_color": "black"}


class Picture:
    def __init__(self) -> None:
        from bokeh.models import ColumnDataSource, FixedTicker, LinearColorMapper

        self.ground = ColumnDataSource({"cells": [], "x": [], "y": [], "dw": [], "dh": []})
        of_values = ("x", "y", "dw", "dh", *LAYERS, *_HOVERED)
        self.values = ColumnDataSource({name: [] for name in of_values}, name="values")
        self.shades = ColumnDataSource({name: [] for name in ("cells", "x", "y", "dw", "dh")})
        self.outline = ColumnDataSource({"xs": [], "ys": []})
        self.fails = ColumnDataSource({"xs": [], "ys": []}, name="fails")
        self.stroke, self._live = (
            ColumnDataSource({"x": [], "y": [], "r": []}, name=name) for name in ("drawn", "live")
        )
        self.points = ColumnDataSource({"x": [], "y": [], "name": [], "colour": []}, name="points")
        self.aims = ColumnDataSource({"xs": [], "ys": []})
        self.routes = ColumnDataSource({"xs": [], "ys": []})
        self.measured = ColumnDataSource({name: [] for name in ("x", "y", "value", "name", "colour")}, name="measured")
        self.poses = ColumnDataSource({"x": [], "y": [], "angle": [], "rank": []})
        plot = self.plot = _empty_plot()
        where = {"x": "x", "y": "y", "dw": "dw", "dh": "dh"}
        self._mappers = LinearColorMapper(palette=[*_GROUND], low=-0.5), LinearColorMapper(palette=[*_WALLS], low=-0.5)
        greys = [f"#{shade:02x}{shade:02x}{shade:02x}" for shade in range(256)]
        self.wall_shades = LinearColorMapper(palette=greys, low=0, high=255, low_color="#cc3311")
        known = plot.image(image="cells", source=self.ground, color_mapper=self._mappers[0], **where)
        plot.x_range.renderers = plot.y_range.renderers = [known]  # the axes stay with the map, whatever is drawn
        geometry = {"source": self.values, **where}
        words = {"link_state": STATES, "best_server": [""] * MOST_TRANSMITTERS}
        self.parts = {
            name: add_layer(plot, geometry, name, layer, words.get(name, ()), "below") for name, layer in LAYERS.items()
        }
        for name, (_, bar) in self.parts.items():
            bar.height, bar.padding, bar.title_standoff = 10, 3, 2
            bar.title = bar.title or LAYERS[name].title  # bars of one height
            if name in (*LEVELS, RATE):
                bar.ticker = FixedTicker()
        clear = LinearColorMapper(palette=[f"#000000{alpha:02x}" for alpha in INK], low=0, high=len(INK) - 1)
        self.ink = plot.image(image="cells", source=self.shades, color_mapper=clear, visible=False, **where)
        hatch: dict[str, Any] = {"hatch_pattern": "left_diagonal_line", "hatch_color": FAILS, "hatch_weight": 1.5}
        look: dict[str, Any] = {"fill_color": FAILS, "fill_alpha": 0.01, "line_color": None, **hatch}
        fails = plot.multi_polygons("xs", "ys", source=self.fails, hatch_scale=14, **look)  # no fill hides hatches
        lines = [
            plot.multi_line("xs", "ys", source=self.outline, line_color=colour, line_width=width)
            for colour, width in (("white", 4), ("black", 2))
        ]
        plot.image(image="cells", source=self.ground, color_mapper=self._mappers[1], **where)
        self._add_legend([fails], [lines[1]])
        self.plan = plot.image(image="cells", source=self.shades, color_mapper=self.wall_shades, **where)
        self._add_marks()

    def _add_legend(self, fails: list[Any], lines: list[Any]) -> None:
        """Add a legend of one line above the map, so that its height stays."""
        from bokeh.models.annotations.legends import Legend, LegendItem

        plot = self.plot
        nowhere: dict[str, Any] = {"x": [math.nan], "y": [math.nan], "size": 12, "line_color": "black"}
        unseen = plot.scatter(marker="square", fill_color="#b9bec4", hatch_pattern="/", hatch_color="white", **nowhere)
        self.keys = {
            "fails": LegendItem(label={"value": ""}, renderers=fails),
            "line": LegendItem(label={"value": ""}, renderers=lines),
            "unseen": LegendItem(label={"value": "not observed"}, renderers=[unseen]),
        }
        look: dict[str, Any] = {"orientation": "horizontal", "border_line_color": None, "padding": 0, "margin": 2}
        look["spacing"] = 10
        plot.add_layout(Legend(items=[*self.keys.values()], label_text_font_size="12px", **look), "above")

    def _add_marks(self) -> None:
        """Draw the top layers, with the tools that read and move them."""
        from bokeh.models import CustomJS, HoverTool, PointDrawTool

        plot = self.plot
        for source in (self.stroke, self._live):
            plot.circle("x", "y", radius="r", source=source, fill_color=_PEN, line_color=None, alpha=0.4)
            plot.line("x", "y", source=source, line_color=_PEN, line_width=3)
            plot.scatter("x", "y", source=source, fill_color=_PEN, line_color=None)
        self._area = plot.patch("x", "y", source=self._live, fill_color=_PEN, fill_alpha=0.3, line_color=None)
        look: dict[str, Any] = {"fill_color": "colour", "line_color": "black"}
        points = plot.scatter("x", "y", source=self.measured, size=7, **look)
        plot.multi_line("xs", "ys", source=self.routes, line_color="black", line_dash="dashed", line_width=2)
        plot.scatter("x", "y", source=self.poses, marker="triangle", angle="angle", size=15, **_MARK)
        plot.text("x", "y", text="rank", source=self.poses, x_offset=9, **_LABEL)
        plot.multi_line("xs", "ys", source=self.aims, line_color="black", line_width=4)
        plot.scatter("x", "y", source=self.points, marker="star", size=24, nonselection_alpha=1.0, **look)
        plot.text("x", "y", text="name", source=self.points, x_offset=13, **_LABEL)
        handles = plot.scatter("x", "y", source=self.points, size=_HANDLE_PIXELS, alpha=0.0, nonselection_alpha=0.0)
        tool = PointDrawTool(renderers=[handles], empty_value="", description="Put and move transmitters")
        hover = HoverTool(
            renderers=[parts[0] for parts in self.parts.values()],
            tooltips=[*_TOOLTIPS],
            formatters={"@link_state": _state_words()},
        )
        measured = HoverTool(renderers=[points], tooltips=[("measured", "@value{0.0} of @name")], attachment="above")
        plot.add_tools(hover, measured, tool)
        plot.toolbar.active_tap = tool
        self._tools = tool, hover, measured
        plot.js_on_event("tap", CustomJS(args={"points": self.points}, code=_UNSELECT))

    def follow(self, mode: Any, brush: Any, threshold: Any) -> None:
        """Draw strokes by the kind and width of two controls, and the walls of a plan by a slider."""
        from bokeh.models import CustomJS

        given = {"mode": mode, "brush": brush, "stroke": self.stroke, "live": self._live}
        given |= {"range": self.plot.x_range, "straight": [*STRAIGHT], "wide": [*BRUSHES], "encloses": AREA}
        for name in ("panstart", "pan", "panend", "tap", "doubletap"):
            self.plot.js_on_event(name, CustomJS(args=given | {"name": name}, code=_STROKE))
        code = f"area.visible = mode.value == '{AREA}'; live.data = {{x: [], y: [], r: []}}"
        code += "; for (const tool of tools) tool.active = !mode.value"
        args = {"tools": [*self._tools], "mode": mode, "live": self._live, "area": self._area}
        mode.js_on_change("value", CustomJS(args=args, code=code))
        shown = {"walls": self.wall_shades, "plan": self.plan, "slider": threshold}
        code = "walls.low = slider.value + 1; plan.visible = true"
        threshold.js_on_change("value", CustomJS(args=shown, code=code))

    def show_unit(self, unit: str) -> None:
        for name, axis in (("x", self.plot.xaxis), ("y", self.plot.yaxis)):
            axis.axis_label = f"{name} [{unit}]"

    def show_map(self, partial: PartialMap | None, plan: Plan | None) -> None:
        """Draw a map, or a plan that has no scale yet."""
        for source in (self.stroke, self._live):
            source.data = {"x": [], "y": [], "r": []}
        has_map = partial is not None
        (x0, y0, x1, y1), cells = (0.0, 0.0, *(plan.size_m if plan else (1.0, 1.0))), np.zeros((1, 1), np.uint8)
        colours = []
        if partial is not None:
            (x0, y0, x1, y1), cells = partial.bounds_m, hatched_pixels(partial)
            self.keys["unseen"].visible = bool((cells == _HATCHED).any())
            colours = [material_colour(each) for each in partial.wall_materials]
        for mapper, palette in zip(self._mappers, (_GROUND, _WALLS), strict=True):
            mapper.update(palette=[*palette, *colours], high=len(palette) + len(colours) - 0.5)
        self.ground.data = {"cells": [cells], "x": [x0], "y": [y0], "dw": [x1 - x0], "dh": [y1 - y0]}
        if plan is not None:
            width_m, height_m = plan.size_m
            merge = math.ceil(max(plan.shade.shape) / _MOST_PIXELS)
            shade = np.flipud(ndimage.minimum_filter(plan.shade, merge)[::merge, ::merge])
            self.shades.data = {"cells": [shade], "x": [0.0], "y": [0.0], "dw": [width_m], "dh": [height_m]}
            self.wall_shades.low = plan.threshold + 1
        self.plan.visible, self.ink.visible = plan is not None and not has_map, plan is not None and has_map

    def show_answer(self, answer: Answer | None, view: View, threshold_dbm: float) -> None:
        """Draw the layers of a view."""
        if answer is None:
            self.values.data = {column: [] for column in self.values.data}
            self.outline.data, self.fails.data = {"xs": [], "ys": []}, {"xs": [], "ys": []}
            self.keys["fails"].visible = self.keys["line"].visible = False
            return
        one = answer.layers_of(view.transmitter, threshold_dbm, truth=view.truth)
        x0, x1, y0, y1 = extent_m(one)
        valid = (one["valid"].to_numpy() == 1) & ~outside(one)
        row, column = np.indices(valid.shape)
        if valid.any():  # a wall thinner than a cell leaves none without a value, for the eye alone
            apart, (row, column) = ndimage.distance_transform_edt(~valid, return_indices=True)
            valid = apart < 2.0
        columns: dict[str, Any] = {"x": [x0], "y": [y0], "dw": [x1 - x0], "dh": [y1 - y0]}
        for layer in (*LAYERS, *_HOVERED):
            values = one[layer].to_numpy() if layer in one else np.full(valid.shape, np.nan)
            columns[layer] = [np.where(valid, values[row, column], np.nan).astype(np.float32)]
        self.values.data = columns
        outline = answer.outline(view, one, threshold_dbm)
        self._show_outline(outline, one, columns[view.outline][0] if outline else np.full(valid.shape, np.nan))
        for name, (_, bar) in self.parts.items():
            scale = answer.scale(name, view.transmitter, threshold_dbm)
            if scale is not None:
                bar.ticker.ticks, bar.title = [*scale.ticks], scale.title
                bar.major_label_overrides = dict(zip(scale.ticks, scale.names, strict=True))
                bar.color_mapper.update(palette=[*scale.palette], low=scale.low, high=scale.high)

    def _show_outline(self, outline: Outline | None, one: Any, shown: Any) -> None:
        """Draw the line at the threshold, and hatch the side that fails."""
        lines: list[Any] = []
        areas: list[Any] = []
        x_m, y_m, values = to_the_edge(one, shown)
        values = np.ma.masked_invalid(values)
        if outline is not None and values.count():
            field: Any = contour_generator(x_m, y_m, values, fill_type="OuterOffset")
            lines = field.lines(outline.level)
            below = min(float(values.min()), outline.level) - 1.0
            for points, offsets in zip(*field.filled(below, outline.level), strict=True):
                areas.append([points[start:end] for start, end in itertools.pairwise(offsets)])
        self.outline.data = {"xs": [line[:, 0] for line in lines], "ys": [line[:, 1] for line in lines]}
        rings: list[Any] = [[[[ring[:, axis].tolist() for ring in area]] for area in areas] for axis in (0, 1)]
        self.fails.data = dict(zip(("xs", "ys"), rings, strict=True))
        self.keys["fails"].visible, self.keys["line"].visible = bool(areas), bool(lines)
        if outline is not None:
            self.keys["fails"].label, self.keys["line"].label = {"value": outline.fails}, {"value": outline.line}

    def show_views(self, views: NextViews | None) -> None:
        """Draw next views of a robot, and the ways to them."""
        shown = views or ()
        self.routes.data = {"xs": [view.path_m[:, 0] for view in shown], "ys": [view.path_m[:, 1] for view in shown]}
        self.poses.data = {
            "x": [view.position_m[0] for view in shown],
            "y": [view.position_m[1] for view in shown],
            "angle": [math.radians(view.heading_deg - 90.0) for view in shown],
            "rank": [str(number) for number in range(1, len(shown) + 1)],
        }


def _empty_plot() -> Any:
    from bokeh.models import DataRange1d
    from bokeh.plotting import figure

    plot: Any = figure(
        x_range=DataRange1d(range_padding=0.02),
        y_range=DataRange1d(range_padding=0.02),
        match_aspect=True,
        sizing_mode="stretch_both",
        x_axis_label="x [m]",
        y_axis_label="y [m]",
        title="Map\n ",
        tools="pan,wheel_zoom,box_zoom,reset",
        active_drag=None,
        active_scroll=None,
        min_border_bottom=_BELOW_PIXELS,
        background_fill_color="#d9dce0",
    )
    plot.toolbar.logo, plot.grid.visible, plot.title.text_font_size = None, False, "12px"
    return plot


def hatched_pixels(partial: PartialMap) -> NDArray[np.uint8]:
    """Return the cells of a map in 600 to 1000 rows or columns.

    States, 3 for a hatch, 4 for a cell beside a wall, 4 + k for a wall of material k.
    """
    merge = math.ceil(max(partial.shape) / _MOST_PIXELS)
    ny, nx = (math.ceil(n / merge) for n in partial.shape)
    padded = np.full((ny * merge, nx * merge), CellState.UNKNOWN, dtype=np.uint8)
    padded[: partial.shape[0], : partial.shape[1]] = partial.state
    blocks = padded.reshape(ny, merge, nx, merge)
    free = np.where((blocks == CellState.FREE).any(axis=(1, 3)), CellState.FREE, CellState.UNKNOWN)
    cells = np.where((blocks == CellState.WALL).any(axis=(1, 3)), CellState.WALL, free).astype(np.uint8)
    if partial.wall_material is not None:
        padded[:] = 0
        padded[: partial.shape[0], : partial.shape[1]] = partial.wall_material
        number = padded.reshape(ny, merge, nx, merge).max(axis=(1, 3))
        cells = np.where(number > 0, np.minimum(number, 255 - _HALO) + _HALO, cells)
    finer = max(1, round(_FEWEST_PIXELS / max(cells.shape)))
    cells = cells.repeat(finer, axis=0).repeat(finer, axis=1)
    row, column = np.indices(cells.shape)
    stripe = (row + column) % (max(cells.shape) // 50 + 1) < max(cells.shape) // 400 + 1
    is_wall = (cells == CellState.WALL) | (cells > _HALO)
    cells = np.where((cells == CellState.UNKNOWN) & stripe & (not partial.is_complete), _HATCHED, cells)
    return np.where(ndimage.binary_dilation(is_wall) & ~is_wall, _HALO, cells).astype(np.uint8)


def _state_words() -> Any:
    from bokeh.models import CustomJSHover

    return CustomJSHover(code=f"return {STATES!r}[value] ?? 'no receiver'")
