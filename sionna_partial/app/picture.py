"""Plot of the page: map, layers, transmitters, measured points and next views."""

import math
from typing import Any

import numpy as np
from contourpy import contour_generator
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.app.answer import LEVELS, Answer
from sionna_partial.app.drawing import AREA, BRUSHES, STRAIGHT, Plan
from sionna_partial.app.radio import MOST_TRANSMITTERS
from sionna_partial.constants import CellState
from sionna_partial.exploration.next_views import NextViews
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.coverage_plot import extent_m, outside
from sionna_partial.plots.coverage_viewer import STATES, add_layer, level_codes, radio_layers, server_codes
from sionna_partial.settings import WALL_MATERIALS, Material, material_name

LIKELY = 0.9
"""Probability at which an area counts as covered."""

OUTLINES = {"p_above": f"where P = {LIKELY:g}", "power_mean_dbm": "where the mean is", "": "none"}
"""Layers with a line at the threshold."""

LAYERS = radio_layers(MOST_TRANSMITTERS)

_UNSELECT = "points.selection_manager.clear()"
"""Otherwise the next drag would move a clicked transmitter as well."""

_STROKE = """
const is_area = mode.value == encloses
if (mode.value == "" || name == "doubletap" && !is_area) return
const {x, y} = cb_obj, data = name == "panstart" || name == "tap" && !is_area ? {x: [], y: []} : live.data
const [xs, ys] = [data.x, data.y].map(each => [...each].slice(0, straight.includes(mode.value) ? 1 : Infinity))
xs.push(x); ys.push(y)
const drawn = {x: xs, y: ys, r: xs.map(() => wide.includes(mode.value) ? brush.value / 2 : 0)}
const is_done = name == "panend" || name == (is_area ? "doubletap" : "tap")
live.data = is_done ? {x: [], y: [], r: []} : drawn
if (is_done) stroke.data = drawn
"""
"""Draws a stroke in the browser, and sends it at its end."""

_COLOURS = ["#aa7744", "#cc3311", "#777777", "#444466", "#33bbee", "#0077bb", "#ee7733", "#ee3377", "#9933cc"]
_OTHER, _PEN = "#004488", "#0066ff"
"""Colours of `WALL_MATERIALS`, of other walls, and of strokes."""

_BELOW_PIXELS = 130
"""Height of axis and colour bar of every layer."""

_HANDLE_PIXELS = 44
"""Diameter in which a finger grabs a transmitter."""

_HOVERED = ("p_los", "p_nlos", "p_outage")
_MOST_PIXELS, _FEWEST_PIXELS, _HATCHED = 1000, 600, 3
_STEP_DB, _BELOW, _ABOVE = 5.0, 6, 8
"""Steps of scales [dB], and their number below and above the threshold."""

_TOOLTIPS = (
    ("x, y", "$x{0.00} m, $y{0.00} m"),
    ("most probable state", "@link_state{custom}"),
    ("LOS, NLOS, outage", "@p_los{0.00}, @p_nlos{0.00}, @p_outage{0.00}"),
    ("path gain", "@gain_mean_db{0.0} ± @gain_std_db{0.0} dB"),
    ("received power", "@power_mean_dbm{0.0} dBm"),
    ("SNR", "@snr_mean_db{0.0} dB"),
    ("P(above threshold)", "@p_above{0.00}"),
)
_GROUND, _WALLS = ("#ffffff", "#000000", "#b9bec4", "#e4e6e9"), ("#00000000", "#000000", "#00000000", "#ffffff60")
"""Colours of free cells, walls, unknown cells and hatches, below and above the coverage."""

_LABEL: dict[str, Any] = {
    "text_baseline": "middle",
    "text_font_size": "13px",
    "background_fill_color": "white",
    "background_fill_alpha": 0.75,
}
_MARK: dict[str, Any] = {"fill_color": "#ddaa33", "line_color": "black"}


class Picture:
    def __init__(self) -> None:
        from bokeh.models import ColumnDataSource, DataRange1d, FixedTicker, LinearColorMapper
        from bokeh.plotting import figure

        self.ground = ColumnDataSource({"cells": [], "x": [], "y": [], "dw": [], "dh": []})
        of_values = ("x", "y", "dw", "dh", *LAYERS, *_HOVERED)
        self.values = ColumnDataSource({name: [] for name in of_values}, name="values")
        self.shades = ColumnDataSource({name: [] for name in ("cells", "x", "y", "dw", "dh")})
        self.outline = ColumnDataSource({"xs": [], "ys": []})
        self.stroke, self._live = (
            ColumnDataSource({"x": [], "y": [], "r": []}, name=name) for name in ("drawn", "live")
        )
        self.points = ColumnDataSource({"x": [], "y": [], "name": [], "colour": []}, name="points")
        self.aims = ColumnDataSource({"xs": [], "ys": []})
        self.routes = ColumnDataSource({"xs": [], "ys": []})
        self.measured = ColumnDataSource({"x": [], "y": [], "colour": []}, name="measured")
        self.poses = ColumnDataSource({"x": [], "y": [], "angle": [], "rank": []})
        plot: Any = figure(
            x_range=DataRange1d(range_padding=0.02),
            y_range=DataRange1d(range_padding=0.02),
            match_aspect=True,
            sizing_mode="stretch_both",
            x_axis_label="x [m]",
            y_axis_label="y [m]",
            tools="pan,wheel_zoom,box_zoom,reset",
            active_drag=None,
            active_scroll=None,
            min_border_bottom=_BELOW_PIXELS,
            background_fill_color="#d9dce0",
        )
        self.plot = plot
        plot.toolbar.logo, plot.grid.visible = None, False
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
            bar.title = bar.title or LAYERS[name].title  # bars of one height
            if name in LEVELS:
                bar.ticker = FixedTicker()
        for colour, width in (("white", 4), ("black", 2)):
            plot.multi_line("xs", "ys", source=self.outline, line_color=colour, line_width=width)
        plot.image(image="cells", source=self.ground, color_mapper=self._mappers[1], **where)
        self.plan = plot.image(image="cells", source=self.shades, color_mapper=self.wall_shades, **where)
        self._add_marks()

    def _add_marks(self) -> None:
        """Draw the top layers, with the tools that read and move them."""
        from bokeh.models import CustomJS, HoverTool, PointDrawTool

        plot = self.plot
        for source in (self.stroke, self._live):
            plot.circle("x", "y", radius="r", source=source, fill_color=_PEN, line_color=None, alpha=0.4)
            plot.line("x", "y", source=source, line_color=_PEN, line_width=3)
            plot.scatter("x", "y", source=source, fill_color=_PEN, line_color=None)
        self._area = plot.patch("x", "y", source=self._live, fill_color=_PEN, fill_alpha=0.3, line_color=None)
        plot.scatter("x", "y", source=self.measured, size=7, fill_color="colour", line_color="black")
        plot.multi_line("xs", "ys", source=self.routes, line_color="black", line_dash="dashed", line_width=2)
        plot.scatter("x", "y", source=self.poses, marker="triangle", angle="angle", size=15, **_MARK)
        plot.text("x", "y", text="rank", source=self.poses, x_offset=9, **_LABEL)
        plot.multi_line("xs", "ys", source=self.aims, line_color="black", line_width=4)
        look: dict[str, Any] = {"size": 24, "fill_color": "colour", "line_color": "black", "nonselection_alpha": 1.0}
        plot.scatter("x", "y", source=self.points, marker="star", **look)
        plot.text("x", "y", text="name", source=self.points, x_offset=13, **_LABEL)
        handles = plot.scatter("x", "y", source=self.points, size=_HANDLE_PIXELS, alpha=0.0, nonselection_alpha=0.0)
        tool = PointDrawTool(renderers=[handles], empty_value="", description="Put and move transmitters")
        hover = HoverTool(
            renderers=[parts[0] for parts in self.parts.values()],
            tooltips=[*_TOOLTIPS],
            formatters={"@link_state": _state_words()},
        )
        plot.add_tools(hover, tool)
        plot.toolbar.active_tap = tool
        self._tools = tool, hover
        plot.js_on_event("tap", CustomJS(args={"points": self.points}, code=_UNSELECT))

    def follow(self, mode: Any, brush: Any, threshold: Any) -> None:
        """Draw strokes by the kind and width of two controls, and the walls of a plan by a slider."""
        from bokeh.models import CustomJS

        given = {"mode": mode, "brush": brush, "stroke": self.stroke, "live": self._live}
        given |= {"straight": [*STRAIGHT], "wide": [*BRUSHES], "encloses": AREA}
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
        self.plan.visible = plan is not None and not has_map

    def show_answer(
        self, answer: Answer | None, name: str, threshold_dbm: float, *, truth: bool, outline: str = ""
    ) -> None:
        """Draw the layers of a transmitter, or of the strongest for ""; `outline` is one of `OUTLINES`."""
        if answer is None:
            self.values.data = {column: [] for column in self.values.data}
            self.outline.data = {"xs": [], "ys": []}
            return
        one = answer.layers_of(name, threshold_dbm, truth=truth)
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
        lines: list[Any] = []
        if outline:
            height = {"power_mean_dbm": threshold_dbm, "p_above": LIKELY}[outline]
            field: Any = contour_generator(one["x"], one["y"], np.ma.masked_invalid(columns[outline][0]))
            lines = field.lines(height)
        self.outline.data = {"xs": [line[:, 0] for line in lines], "ys": [line[:, 1] for line in lines]}
        self._show_scales(answer.thresholds(name, threshold_dbm), [str(each) for each in answer.coverage["tx"].values])

    def _show_scales(self, thresholds: dict[str, float], names: list[str]) -> None:
        """Set scales in steps of 5 dB whose colours break at the threshold, and the names of servers."""
        for name, threshold in thresholds.items():
            _, bar = self.parts[name]
            low, high = threshold - _BELOW * _STEP_DB, threshold + _ABOVE * _STEP_DB
            bar.ticker.ticks = np.arange(low, high + 1.0, 2.0 * _STEP_DB).tolist()
            bar.color_mapper.update(palette=level_codes(_BELOW, _ABOVE), low=low, high=high)
            bar.title = f"{LAYERS[name].label.partition(';')[0]}; colours break at {threshold:g}"
        _, bar = self.parts["best_server"]
        bar.ticker.ticks, bar.major_label_overrides = [*range(len(names))], dict(enumerate(names))
        bar.color_mapper.update(palette=server_codes(MOST_TRANSMITTERS)[: len(names)], high=len(names) - 0.5)

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


def hatched_pixels(partial: PartialMap) -> NDArray[np.uint8]:
    """Return the cells of a map in 600 to 1000 rows or columns: states, 3 for a hatch, 3 + k for material k."""
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
        cells = np.where(number > 0, np.minimum(number, 255 - _HATCHED) + _HATCHED, cells)
    finer = max(1, round(_FEWEST_PIXELS / max(cells.shape)))
    cells = cells.repeat(finer, axis=0).repeat(finer, axis=1)
    row, column = np.indices(cells.shape)
    stripe = (row + column) % (max(cells.shape) // 50 + 1) < max(cells.shape) // 400 + 1
    return np.where((cells == CellState.UNKNOWN) & stripe & (not partial.is_complete), _HATCHED, cells).astype(np.uint8)


def material_colour(material: Material) -> str:
    return dict(zip(WALL_MATERIALS, _COLOURS, strict=True)).get(material_name(material), _OTHER)


def _state_words() -> Any:
    from bokeh.models import CustomJSHover

    return CustomJSHover(code=f"return {STATES!r}[value] ?? 'no receiver'")
