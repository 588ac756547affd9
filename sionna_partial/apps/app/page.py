"""The page of the app: draws the state of a session with Bokeh, and passes clicks to the session."""

import functools
import html
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sionna_partial.apps.app.answer import LAYERS, OUTLINES, Answer, measured_powers_dbm
from sionna_partial.apps.app.drawing import AREA, BRUSHES, LENGTH, PAINTS, STROKES, Drawing, Stroke
from sionna_partial.apps.app.files import FILES
from sionna_partial.apps.app.maps import MORE_STEPS
from sionna_partial.apps.app.marks import UNUSED, USED, aims_m
from sionna_partial.apps.app.picture import Picture
from sionna_partial.apps.app.planning import ROUNDING_M
from sionna_partial.apps.app.radio import MATERIALS, MODELS, MOST_TRANSMITTERS, PRESETS
from sionna_partial.apps.app.session import Session
from sionna_partial.errors import SionnaPartialError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.coverage_viewer import server_codes
from sionna_partial.plots.report import LIKELY, room_fractions
from sionna_partial.plots.style import material_colour
from sionna_partial.resources import demo_homes
from sionna_partial.settings import WALL_MATERIALS, material_name

_ANTENNAS = {"iso": "isotropic", "dipole": "short dipole", "hw_dipole": "dipole", "tr38901": "sector"}
_WALLS = {"": "below 24 GHz", "opaque": "never", "through": "always"}
_DIRECTIONS = {"": "at the client", "1": "weaker of both ways"}
_REGIONS = {"ETSI": "Europe (ETSI)", "FCC": "USA (FCC)"}
_UNITS = {"frequency_hz": 1e9, "bandwidth_hz": 1e6}
_COMPUTED_FOR = {"": "the partial map", "1": "the whole home (truth)"}
_STRONGEST = "the strongest"
_FILE_NAMES = {
    "png": "PNG",
    "html": "HTML",
    "nc": "NetCDF",
    "tif": "GeoTIFF",
    "yaml": "ROS map",
    "pdf": "Report (PDF)",
    "project": "Save the project",
}

_NARROW: dict[str, Any] = {"max_width": 128}
"""Width of fields beside longer texts, which would be cut off on a phone [pixels]."""

_AREA_HINT = "Drag around the area, or click on its corners and double-click on the last one."
_UPLOAD = "document.getElementById(id).click()"
_COPY = """
const copied = navigator.clipboard ? navigator.clipboard.writeText(area.value) : Promise.reject()
copied.then(() => { message.text = "Copied." }, () => { message.text = "Select the lines, and copy them with Ctrl-C." })
"""
_LOST = (
    "message.text = 'The connection has ended: start sionna-partial app again, and open the address that it prints.'"
)

TEMPLATE = Path(__file__).with_name("page.html").read_text(encoding="utf-8")


class Page:
    """Page of one window, whose files are downloaded below `files_url`."""

    def __init__(self, document: Any, files_url: str) -> None:
        from bokeh.models import CustomJS

        self._files_url = files_url
        self.session = Session(document.add_next_tick_callback, self.show)
        self._is_showing = False
        self._drawn: dict[str, Any] = {}
        self._line_m: list[tuple[float, float]] = []
        self.picture = Picture()
        self.picture.points.on_change("data", self._on_points)
        self.picture.points.selected.on_change("indices", self._on_selected)
        self.picture.stroke.on_change("data", self._on_stroke)
        self._make_choices()
        self._make_map_controls()
        self._make_transmitter_controls()
        self._make_radio_controls()
        for name, model in self._roots().items():
            model.name = name
            document.add_root(model)
        document.js_on_event("connection_lost", CustomJS(args={"message": self.message}, code=_LOST))

    # Widgets

    def _make_choices(self) -> None:
        from bokeh.models.widgets.inputs import Select
        from bokeh.models.widgets.markups import Div
        from bokeh.models.widgets.sliders import Slider

        session, transmitter = self.session, lambda name: self.session.look(transmitter=name)
        self.layer = self._on(
            Select(title="Layer", name="layer", value="p_above", options=self._options()),
            lambda name: session.look(layer=name),
        )
        self.which = self._on(Select(title="Shown for", value="", **_NARROW), transmitter)
        self.truth = self._on(
            Select(title="Computed for", value="", options=list[Any](_COMPUTED_FOR.items())),
            lambda value: session.look(truth=bool(value)),
        )
        self.threshold = self._on(
            Slider(title="Threshold [dBm]", name="threshold", start=-130, end=-30, step=1, value=-67),
            lambda value: session.radios.set(threshold_dbm=float(value)),
        )
        self.outline = self._on(
            Select(
                title="Line at the threshold",
                name="outline",
                value="p_above",
                options=list[Any](OUTLINES.items()),
                max_width=148,
            ),
            lambda name: session.look(outline=name),
        )
        presets: list[Any] = [("", "own values"), *((name, name) for name in PRESETS)]
        self.preset = self._on(Select(title="Band", name="preset", options=presets), self._use_preset)
        materials: list[Any] = [(name, name or "unknown") for name in MATERIALS]
        self.material = self._on(
            Select(title="Material of walls", name="material", options=materials),
            lambda name: session.radios.set(material=name),
        )
        self.message = Div(
            name="message", sizing_mode="stretch_width", html_attributes={"role": "status", "aria-live": "polite"}
        )
        self.warnings = Div(name="warnings", sizing_mode="stretch_width", html_attributes={"role": "status"})
        self.summary = Div(name="summary", sizing_mode="stretch_width")
        self.cancel = self._button("Cancel", lambda: self.session.jobs.cancel(), button_type="danger", width=90)

    def _make_map_controls(self) -> None:
        from bokeh.models.widgets.inputs import Select, Spinner
        from bokeh.models.widgets.markups import Div
        from bokeh.models.widgets.sliders import Slider

        homes: list[Any] = [("", "choose one"), *((name, name) for name in demo_homes())]
        self.example = self._on(Select(title="Example home", options=homes), self._open_example)
        self.map_text = Div(name="map_text", sizing_mode="stretch_width")
        self.stroke = self._on(Select(title="Dragging on the map", name="stroke", value=""), lambda _: self.show())
        self.hint = Div(text=_AREA_HINT)
        self.paint = Select(title="Material", name="paint", options=list[Any](WALL_MATERIALS), value="concrete")
        self.brush = Spinner(title="Brush [m]", name="brush", low=0.05, high=20, step=0.05, value=0.5)
        self.length = self._on(
            Spinner(title="Known length [m]", name="length", low=0.01, high=10_000, step=0.1),
            lambda value: self.session.maps.measure(self._line_m, float(value)),
        )
        self.dark = self._on(
            Slider(title="Walls up to shade", name="dark", start=0, end=254, step=1, value=127),
            lambda value: self.session.maps.change_source(threshold=int(value)),
            "value_throttled",
        )
        self.layer_of_walls = self._on(Select(title="Layer of the drawing", name="wall_layer"), lambda _: self.show())
        materials: list[Any] = [(name, name or "unknown") for name in MATERIALS]
        self.layer_material = self._on(
            Select(title="Its material", name="wall_layer_material", options=materials), self._set_layer_material
        )
        self.undo = self._button("Undo", lambda: self.session.maps.undo())
        self.picture.follow(self.stroke, self.brush, self.dark)

    def _make_transmitter_controls(self) -> None:
        from bokeh.models.widgets.inputs import Select, Spinner, TextInput

        self.chosen = self._on(Select(title="Transmitter"), self._choose)
        self.name = self._on(TextInput(title="Name"), lambda value: self._change(new_name=value))
        self.fields = {
            name: self._on(
                Spinner(title=title, name=name, step=step, low=low, high=high, format="0.[00]"),
                functools.partial(lambda name, value: self._change(**{name: float(value)}), name),
                "value_throttled",
            )
            for name, title, step, low, high in (
                ("x_m", "x [m]", 0.25, None, None),
                ("y_m", "y [m]", 0.25, None, None),
                ("z_m", "Height [m]", 0.1, 0, 100),
                ("eirp_dbm", "Power [dBm]", 1, -100, 100),
            )
        }
        models: list[Any] = [(name, name or "own power") for name in MODELS]
        self.model = self._on(Select(title="Kind", name="model", options=models), lambda name: self._change(model=name))
        self.channel = self._on(
            Select(title="Channel", name="channel", value="", **_NARROW), lambda name: self._change(channel=name)
        )
        self.goal = Spinner(title="Covered floor [%]", name="goal", low=1, high=100, step=1, value=95)
        self.most = Spinner(title="At most", name="most", low=1, high=MOST_TRANSMITTERS, step=1, value=4)
        self.plan_channels = self._button("Plan channels", lambda: self.session.searches.plan_channels())
        self.pattern = self._on(
            Select(title="Antenna", name="pattern", options=list[Any](_ANTENNAS.items())),
            lambda value: self._change_antenna("pattern", value),
        )
        self.aims = {
            name: self._on(
                Spinner(title=title, name=name, step=5, low=low, high=high, format="0.[0]", max_width=80),
                functools.partial(self._change_antenna, name),
                "value_throttled",
            )
            for name, title, low, high in (
                ("azimuth_deg", "Azimuth [\u00b0]", -360, 360),
                ("downtilt_deg", "Downtilt [\u00b0]", -90, 90),
            )
        }

    def _make_radio_controls(self) -> None:
        from bokeh.models.widgets.inputs import Select, Spinner, TextAreaInput
        from bokeh.models.widgets.markups import Div

        self.walls = self._on(
            Select(title="Paths through walls", options=list[Any](_WALLS.items()), value=""),
            lambda value: self.session.radios.set(through_walls={"": None, "opaque": False, "through": True}[value]),
        )
        self.both_ways = self._on(
            Select(title="Received power", name="both_ways", options=list[Any](_DIRECTIONS.items()), value=""),
            lambda value: self.session.radios.set(both_ways=bool(value)),
        )
        self.region = self._on(
            Select(title="Power limits of", name="region", options=list[Any](_REGIONS.items())),
            lambda name: self.session.radios.set(region=name),
        )
        self.radio = {
            name: self._on(
                Spinner(title=title, name=name, step=step, low=low, high=high, format="0.[000]"),
                functools.partial(self._set_field, name, unit),
                "value_throttled",
            )
            for name, title, unit, step, low, high in (
                ("frequency_hz", "Frequency [GHz]", 1e9, 0.1, 0.1, 300),
                ("bandwidth_hz", "Bandwidth [MHz]", 1e6, 10, 0.01, 10_000),
                ("rx_height_m", "Receiver height [m]", 1.0, 0.1, 0, 100),
                ("spacing_m", "Between receivers [m]", 1.0, 0.05, 0.05, 10),
                ("client_dbm", "Client's power [dBm]", 1.0, 1, -100, 100),
            )
        }
        self.access_point = self._on(
            Select(title="Access point of the survey", name="access_point", value=""),
            lambda name: self.session.surveys.assign(name),
        )
        self.measured_text = Div(name="measured_text", sizing_mode="stretch_width")
        self.links = Div(sizing_mode="stretch_width", stylesheets=[_LINKS])
        self.python = TextAreaInput(title="The same in Python", rows=8, stylesheets=[_CODE], name="python")

    def _roots(self) -> dict[str, Any]:
        from bokeh.layouts import row
        from bokeh.models import CustomJS

        session = self.session
        upload_map, upload_csv, upload_logo, copy = (
            self._button(name)
            for name in (
                "Open a map, floor plan or project\u2026",
                "Import a survey\u2026",
                "Logo for the report\u2026",
                "Copy as Python",
            )
        )
        upload_map.js_on_click(CustomJS(args={"id": "map-file"}, code=_UPLOAD))
        upload_csv.js_on_click(CustomJS(args={"id": "csv-file"}, code=_UPLOAD))
        upload_logo.js_on_click(CustomJS(args={"id": "logo-file"}, code=_UPLOAD))
        copy.js_on_click(CustomJS(args={"area": self.python, "message": self.message}, code=_COPY))
        self.forget = self._button("Forget the measurements", lambda: session.surveys.forget_measurements())
        self.remove_logo = self._button("Remove the logo", lambda: session.take_logo(b"", ""))
        self.more = self._button(f"Explore {MORE_STEPS} more steps", lambda: session.maps.explore_more())
        x, y, z, eirp = self.fields.values()
        frequency, bandwidth, height, spacing, client = self.radio.values()
        return {
            "status": _wide(row(self.message, self.cancel), self.warnings),
            "band": _pair(self.preset, self.material),
            "layers": _pair(self.layer, self.which),
            "lines": _pair(self.outline, self.truth),
            "choices": _pair(self.threshold),
            "picture": self.picture.plot,  # nothing above it changes its height with an answer: a drag would miss
            "summary": self.summary,
            "links": self.links,
            "map": _wide(
                self.example,
                upload_map,
                self.map_text,
                _pair(self.length, self.dark),
                _pair(self.layer_of_walls, self.layer_material),
                self.stroke,
                self.hint,
                _pair(self.paint, self.brush),
                self.undo,
            ),
            "transmitters": _wide(
                _pair(self.chosen, self.name),
                _pair(x, y),
                _pair(z, eirp),
                _pair(self.model, self.channel),
                _pair(self.pattern, *self.aims.values()),
                _pair(
                    self._button("Add", lambda: session.radios.add()),
                    self._button("Remove", lambda: session.radios.remove(session.chosen)),
                ),
                self._button("Place it for me", lambda: session.searches.place(), button_type="primary"),
                _pair(self.goal, self.most),
                self._button("Place several for me", self._place_several),
                self.plan_channels,
            ),
            "radio": _wide(
                _pair(frequency, bandwidth),
                _pair(self.walls, self.region),
                _pair(self.both_ways, client),
                _pair(height, spacing),
            ),
            "robot": _wide(
                self.more,
                self._button("Best next views", lambda: session.searches.find_views()),
                upload_csv,
                self.access_point,
                self.measured_text,
                self.forget,
            ),
            "repeat": _wide(upload_logo, self.remove_logo, self.python, copy),
        }

    def _on(self, model: Any, take: Callable[[Any], object], attribute: str = "value") -> Any:
        """Call a function with the chosen value; a refusal is shown."""

        def changed(_name: str, _old: Any, new: Any) -> None:
            if self._is_showing:
                return
            if new is None:  # a field was emptied: its old value is shown again
                self.show()
            else:
                self._guarded(take, new)

        model.on_change(attribute, changed)
        return model

    def _button(self, label: str, take: Callable[[], object] | None = None, **style: Any) -> Any:
        from bokeh.models.widgets.buttons import Button

        button = Button(label=label, name=label, **style)
        if take is not None:
            button.on_click(lambda _: self._guarded(take))
        return button

    def _guarded(self, take: Callable[..., object], *given: Any) -> None:
        try:
            take(*given)
        except SionnaPartialError as error:
            self.session.jobs.refuse(error)

    # Callbacks

    def _on_points(self, _name: str, _old: Any, new: Any) -> None:
        if not self._is_showing:
            self._guarded(self.session.radios.put, [*zip(new["name"], new["x"], new["y"], strict=True)])

    def _on_selected(self, _name: str, _old: Any, new: list[int]) -> None:
        """Choose a clicked or dragged transmitter; clearing the selection here would end a drag."""
        if new and not self._is_showing:
            self._choose(self.picture.points.data["name"][new[-1]])

    def _on_stroke(self, _name: str, _old: Any, new: Any) -> None:
        """Keep a drawn length until its number is typed, or draw a correction."""
        points_m = [*zip(map(float, new["x"]), map(float, new["y"]), strict=True)]
        if not points_m or self._is_showing:
            return
        if self.stroke.value == LENGTH:
            self._line_m = points_m
            return
        self.picture.stroke.data = {"x": [], "y": [], "r": []}
        material = self.paint.value if self.stroke.value in PAINTS else ""
        stroke = Stroke(self.stroke.value, tuple(points_m), float(self.brush.value or 0.0), material)
        self._guarded(self.session.maps.draw, stroke)

    def _set_layer_material(self, name: str) -> None:
        assert isinstance(self.session.source, Drawing)
        materials = {**self.session.source.materials, self.layer_of_walls.value: name}
        self.session.maps.change_source(materials={layer: each for layer, each in materials.items() if each})

    def _place_several(self) -> None:
        self.session.searches.place_several(float(self.goal.value or 0.0) / 100.0, int(self.most.value or 1))

    def _open_example(self, name: str) -> None:
        if name:
            self.session.maps.open_example(name)

    def _use_preset(self, name: str) -> None:
        if name:
            self.session.radios.use_preset(name)

    def _choose(self, name: str) -> None:
        if name in self.session.transmitters:
            self.session.chosen = name
        self.show()

    def _change_antenna(self, name: str, value: Any) -> None:
        antenna = self.session.transmitters[self.session.chosen].antenna
        self._change(antenna=replace(antenna, **{name: value}))

    def _set_field(self, name: str, unit: float, value: float) -> None:
        self.session.radios.set(**{name: float(value) * unit})

    def _change(self, **values: Any) -> None:
        self.session.radios.change(self.session.chosen, **values)

    # Updates

    def show(self) -> None:
        self._is_showing = True
        try:
            self._show_status()
            key = self.session.partial, self.session.title, self.session.steps, self.session.plan
            self._once("map", key, self._show_map)
            self._show_strokes()
            self._show_layers()
            self._show_transmitters()
            self._show_measured()
            self._show_answer()
            self._once("views", (self.session.views,), lambda: self.picture.show_views(self.session.views))
        finally:
            self._is_showing = False

    def _once(self, name: str, key: tuple[Any, ...], draw: Callable[[], None]) -> None:
        if self._drawn.get(name) != key:
            draw()
            self._drawn[name] = key

    def _show_status(self) -> None:
        status = self.session.jobs.status
        text = html.escape(status.message)
        if status.fraction is not None:
            text = f'<progress max="1" value="{status.fraction:.2f}" aria-label="progress"></progress> {text}'
        answer = self.session.answer
        if answer is not None and status.fraction is None and "wall_material" in answer.coverage.attrs:
            text += f" Probability of wall materials: {html.escape(str(answer.coverage.attrs['wall_material']))}."
        colour = "#a1232f" if status.is_error else "#1a1a1a"
        self.message.text = f'<span style="color:{colour}">{text}</span>'
        self.cancel.visible = status.fraction is not None
        self.warnings.text = "<br>".join(f"<b>Note:</b> {html.escape(each)}" for each in self.session.warnings)
        self.warnings.visible = bool(self.session.warnings)

    def _show_map(self) -> None:
        partial, session = self.session.partial, self.session
        self.picture.show_map(partial, session.plan)
        self._line_m = []
        self.length.value = None
        self.stroke.value = "" if self.stroke.value == LENGTH else self.stroke.value
        self.more.visible = self.truth.visible = session.home is not None
        self.example.value = session.title if session.home is not None else ""
        if session.plan is not None:
            self.dark.value = session.plan.threshold
        if partial is None:
            self.map_text.text = f"<b>{html.escape(session.title)}</b>"
            return
        x0, y0, x1, y1 = partial.bounds_m
        seen = "complete" if partial.is_complete else f"{partial.observed_fraction:.0%} observed"
        size = f"{x1 - x0:.1f} x {y1 - y0:.1f} m, cells of {partial.resolution_m:g} m"
        robot = f"; robot after {session.steps} steps" if session.home is not None else ""
        self.map_text.text = f"<b>{html.escape(session.title)}</b>: {size}, {seen}{robot}{_legend(partial)}"

    def _show_strokes(self) -> None:
        plan = self.session.plan
        self.length.visible = self.dark.visible = plan is not None
        self.undo.visible = bool(self.session.strokes)
        is_measured = plan is None or plan.pixel_m is not None
        kinds = [kind for kind in STROKES if plan is not None or kind != LENGTH]
        options = [("", "moves transmitters"), *((kind, STROKES[kind]) for kind in kinds)]
        self.stroke.options = options if is_measured else [(LENGTH, STROKES[LENGTH])]
        if self.stroke.value not in [kind for kind, _ in self.stroke.options]:
            self.stroke.value = self.stroke.options[0][0]
        for model, users in ((self.brush, BRUSHES), (self.paint, PAINTS), (self.hint, (AREA,))):
            model.visible = self.stroke.value in users
        self._once("unit", (is_measured,), lambda: self.picture.show_unit("m" if is_measured else "pixels"))

    def _show_layers(self) -> None:
        """Show the layers of a drawing that are walls."""
        source, partial = self.session.source, self.session.partial
        is_drawing = isinstance(source, Drawing) and partial is not None
        self.layer_of_walls.visible = self.layer_material.visible = is_drawing
        if isinstance(source, Drawing) and partial is not None and partial.import_source is not None:
            self.layer_of_walls.options = [each.name for each in partial.import_source.used]
            if self.layer_of_walls.value not in self.layer_of_walls.options:
                self.layer_of_walls.value = next(iter(self.layer_of_walls.options), "")
            self.layer_material.value = source.materials.get(self.layer_of_walls.value, "")

    def _show_transmitters(self) -> None:
        session = self.session
        names = [*session.transmitters]
        each = [*session.transmitters.values()]
        colours = server_codes(MOST_TRANSMITTERS)
        rows: dict[str, Any] = {
            "x": [tx.x_m for tx in each],
            "y": [tx.y_m for tx in each],
            "name": names,
            "colour": colours[: len(names)],
        }
        if not _are_drawn(rows, self.picture.points.data):
            self.picture.points.data = rows
        self.chosen.options, self.chosen.value = [*names], session.chosen
        self.name.value = session.chosen
        chosen = session.transmitters.get(session.chosen)
        shown = [(self.fields, chosen), (self.aims, chosen and chosen.antenna)]
        for fields, of in shown:
            for name, field in fields.items():
                field.value, field.disabled = (None, True) if of is None else (getattr(of, name), False)
        self.pattern.value, self.pattern.disabled = chosen.antenna.pattern if chosen else "iso", chosen is None
        for field in self.aims.values():  # an isotropic antenna points nowhere
            field.disabled |= self.pattern.value == "iso"
        lines = aims_m(session.partial, each)
        aims = {"xs": [line[:, 0].tolist() for line in lines], "ys": [line[:, 1].tolist() for line in lines]}
        self._once("aims", (repr(aims),), functools.partial(setattr, self.picture.aims, "data", aims))
        self.name.disabled = chosen is None
        self.model.value, self.model.disabled = chosen.model if chosen else "", chosen is None
        settings = session.settings
        channels = dict.fromkeys(["", *settings.channels, *(tx.channel for tx in each)])
        self.channel.options = [(channel, channel or "shared by all") for channel in channels]
        self.channel.value, self.channel.disabled = chosen.channel if chosen else "", chosen is None
        self.plan_channels.visible = len(names) > 1
        options = [("", _STRONGEST)] * (len(names) != 1) + [(name, name) for name in names]
        self.which.options, self.layer.options = options, self._options()
        view = session.shown_view
        self.which.value = view.transmitter if len(names) != 1 else names[0]
        self.layer.value, self.outline.value, self.truth.value = view.layer, view.outline, "1" * view.truth
        self.both_ways.value, self.region.value = "1" * settings.both_ways, settings.region
        self.radio["client_dbm"].visible = settings.both_ways
        for name in self.radio:
            unit = _UNITS.get(name, 1.0)
            self.radio[name].value = getattr(settings, name) / unit
        self.walls.value = {None: "", False: "opaque", True: "through"}[settings.through_walls]
        self.material.value, self.preset.value = settings.material, settings.preset
        if self.threshold.value != settings.threshold_dbm:
            self.threshold.value = settings.threshold_dbm
        self.python.value = session.python()

    def _show_measured(self) -> None:
        session = self.session
        self.measured_text.visible = self.forget.visible = session.measured is not None
        chosen, options = session.transmitters.get(session.chosen), session.survey.options if session.survey else []
        self.access_point.options, self.access_point.visible = options, bool(options and chosen)
        self.access_point.title = f"Access point of the survey for {session.chosen}"
        if session.survey and chosen:
            self.access_point.value = session.survey.access_point_at(chosen.position_m)
        of_map = session.partial, repr(session.transmitters), session.settings.frequency_hz
        key = session.measured, *of_map, session.answer and session.answer.coverage
        self._once("measured", key, self._show_points)

    def _show_points(self) -> None:
        (rx_m, used), measured = self.session.measured_points(), self.session.measured
        colours = [USED if each else UNUSED for each in used]
        values: Any = [] if measured is None else measured.gain_db
        of_points = {"x": rx_m[:, 0], "y": rx_m[:, 1], "value": values, "name": self.session.measured_names()}
        self.picture.measured.data = of_points | {"colour": colours}
        unused = f", {(~used).sum()} of them not used (white)" if not used.all() else ""
        fits = [
            f"{power_dbm:.0f} dBm of {html.escape(name)}"
            for name, power_dbm in measured_powers_dbm(self.session.answer)
        ]
        fitting = f". As received powers, they fit {', '.join(fits)}" if fits else ""
        self.measured_text.text = f"{len(used)} measured points{unused}{fitting}"

    def _options(self) -> list[Any]:
        return [(name, LAYERS[name].title) for name in self.session.layers]

    def _show_answer(self) -> None:
        session, answer, partial = self.session, self.session.answer, self.session.partial
        view, threshold_dbm = session.shown_view, session.settings.threshold_dbm
        self._once("answer", (answer, view, threshold_dbm), self._show_values)
        for layer, parts in self.picture.parts.items():
            for part in parts:
                part.visible = layer == view.layer
        kinds = [*FILES] if answer is not None and answer.is_final else ["project"]
        links = (
            f'<a href="{self._files_url}/{kind}" download="{FILES[kind]}">{_FILE_NAMES[kind]}</a>' for kind in kinds
        )
        self.remove_logo.visible = session.logo is not None
        self.remove_logo.label = f"Remove the logo {session.logo[0]}" if session.logo else ""
        self.links.text = " ".join(links) if partial is not None else ""
        title = "Map" if answer is None else answer.title(view, threshold_dbm)
        settings = session.settings if answer is None else answer.settings
        text = " " if partial is None else settings.text(partial)
        self.picture.plot.title.text = f"{title}\n{text}"  # two lines always: their space is found once

    def _show_values(self) -> None:
        answer, threshold_dbm = self.session.answer, self.session.settings.threshold_dbm
        self.picture.show_answer(answer, self.session.shown_view, threshold_dbm)
        self.summary.text = "" if answer is None else _summary(answer, threshold_dbm)


_CODE = "textarea { font-family: monospace; font-size: 12px; white-space: pre }"
_LINKS = (
    "a { display: inline-block; padding: 0.25em 0.7em; margin: 0.15em; border: 1px solid #93a1b0; border-radius: 6px }"
)


def _pair(*models: Any) -> Any:
    from bokeh.layouts import row

    for model in models:
        model.sizing_mode, model.width = "stretch_width", None
    return row(*models, sizing_mode="stretch_width")


def _wide(*models: Any) -> Any:
    from bokeh.layouts import column

    for model in models:
        model.sizing_mode = "stretch_width"
    return column(*models, sizing_mode="stretch_width")


def _are_drawn(rows: dict[str, Any], drawn: dict[str, Any]) -> bool:
    """Return whether the page has these transmitters, up to rounding: sending them again would disturb a drag."""
    same = all([*drawn[name]] == rows[name] for name in ("name", "colour"))
    return same and all(np.allclose(drawn[axis], rows[axis], rtol=0.0, atol=ROUNDING_M) for axis in "xy")


def _legend(partial: PartialMap) -> str:
    used = np.unique(0 if partial.wall_material is None else partial.wall_material)
    materials = [partial.wall_materials[number - 1] for number in used if number]
    return "".join(
        f'<br><span style="color:{material_colour(each)}">\u25a0</span> {html.escape(material_name(each))}'
        for each in materials
    )


def _summary(answer: Answer, threshold_dbm: float) -> str:
    """Return the covered fractions, and the errors in a home that is known."""
    given: dict[str, Any] = {"probability": LIKELY, "eirp_dbm": answer.eirp_dbm}
    area = answer.coverage.radio.area(threshold_dbm, **given)["fraction"]
    rows = [*zip(answer.coverage["tx"].to_numpy(), *area.to_numpy()[:2], strict=True)]
    if len(rows) > 1:
        together = answer.coverage.radio.area(threshold_dbm, any_transmitter=True, **given)["fraction"]
        rows.insert(0, ("any transmitter", *together.to_numpy()[:2]))
    fractions = (
        f"<b>{html.escape(str(name))}</b> {float(seen):.0%} of the observed floor, {float(every):.0%} of all"
        for name, seen, every in rows
    )
    text = f"Above {threshold_dbm:g} dBm with probability {LIKELY:g}: {'; '.join(fractions)}."
    rooms = room_fractions(answer.coverage, threshold_dbm, answer.eirp_dbm)
    if rooms:
        each = ", ".join(f"{html.escape(room)} {fraction:.0%}" for room, fraction in rooms)
        text += f" Rooms, the least covered first: {each}."
    found = answer.agreement()
    if found is not None:
        text += f" Against the whole home: link state right on {found[0]:.0%} of its floor, RMSE {found[1]:.1f} dB."
    return text
