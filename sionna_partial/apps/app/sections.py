"""Sections of the page: each has its widgets, their layout `root`, and shows its part of the session."""

import html
from dataclasses import replace
from functools import partial as bind
from typing import Any

import numpy as np

from sionna_partial.apps.app.answer import measured_powers_dbm
from sionna_partial.apps.app.drawing import AREA, BRUSHES, LENGTH, PAINTS, STROKES, Drawing, Stroke
from sionna_partial.apps.app.maps import MORE_STEPS
from sionna_partial.apps.app.marks import UNUSED, USED, aims_m
from sionna_partial.apps.app.picture import Picture
from sionna_partial.apps.app.planning import ROUNDING_M
from sionna_partial.apps.app.radio import MATERIALS, MODELS, MOST_TRANSMITTERS
from sionna_partial.apps.app.session import Session
from sionna_partial.apps.app.widgets import NARROW, Widgets, pair, text, wide
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.coverage_viewer import server_codes
from sionna_partial.plots.style import material_colour
from sionna_partial.resources import demo_homes
from sionna_partial.settings import WALL_MATERIALS, material_name

MATERIAL_OPTIONS = [(name, name or "unknown") for name in MATERIALS]

_ANTENNAS = {"iso": "isotropic", "dipole": "short dipole", "hw_dipole": "dipole", "tr38901": "sector"}
_WALLS = {"": "below 24 GHz", "opaque": "never", "through": "always"}
_THROUGH_WALLS = {"": None, "opaque": False, "through": True}
_DIRECTIONS = {"": "at the client", "1": "weaker of both ways"}
_REGIONS = {"ETSI": "Europe (ETSI)", "FCC": "USA (FCC)"}
_UNITS = {"frequency_hz": 1e9, "bandwidth_hz": 1e6}
_AREA_HINT = "Drag around the area, or click on its corners and double-click on the last one."


class MapSection:
    """The map, and what a user draws on it."""

    def __init__(self, widgets: Widgets, session: Session, picture: Picture) -> None:
        from bokeh.models.widgets.markups import Div

        self._widgets, self._session, self._picture = widgets, session, picture
        self._line_m: list[tuple[float, float]] = []
        homes = [("", "choose one"), *((name, name) for name in demo_homes())]
        self.example = widgets.select("Example home", homes, self._open_example)
        self.text = text("map_text")
        self.stroke = widgets.select("Dragging on the map", (), lambda _: session.jobs.show(), name="stroke")
        self.hint = Div(text=_AREA_HINT)
        self.paint = widgets.select("Material", WALL_MATERIALS, name="paint", value="concrete")
        self.brush = widgets.number("Brush [m]", name="brush", low=0.05, high=20, step=0.05, value=0.5)
        self.length = widgets.number(
            "Known length [m]",
            lambda value: session.maps.measure(self._line_m, float(value)),
            "value",
            name="length",
            low=0.01,
            high=10_000,
            step=0.1,
        )
        self.dark = widgets.slider(
            "Walls up to shade",
            lambda value: session.maps.change_source(threshold=int(value)),
            "value_throttled",
            name="dark",
            start=0,
            end=254,
            value=127,
        )
        self.layer = widgets.select("Layer of the drawing", (), lambda _: session.jobs.show(), name="wall_layer")
        self.layer_material = widgets.select(
            "Its material", MATERIAL_OPTIONS, self._set_layer_material, name="wall_layer_material"
        )
        self.undo = widgets.button("Undo", lambda: session.maps.undo())
        self.root = wide(
            self.example,
            widgets.upload("Open a map, floor plan or project\u2026", "map-file"),
            self.text,
            pair(self.length, self.dark),
            pair(self.layer, self.layer_material),
            self.stroke,
            self.hint,
            pair(self.paint, self.brush),
            self.undo,
        )
        picture.follow(self.stroke, self.brush, self.dark)
        picture.stroke.on_change("data", self._on_stroke)

    def _open_example(self, name: str) -> None:
        if name:
            self._session.maps.open_example(name)

    def _set_layer_material(self, name: str) -> None:
        assert isinstance(self._session.source, Drawing)
        materials = {**self._session.source.materials, self.layer.value: name}
        self._session.maps.change_source(materials={layer: each for layer, each in materials.items() if each})

    def _on_stroke(self, _name: str, _old: Any, new: Any) -> None:
        """Keep a drawn length until its number is typed, or draw a correction."""
        points_m = [*zip(map(float, new["x"]), map(float, new["y"]), strict=True)]
        if not points_m or self._widgets.is_showing:
            return
        if self.stroke.value == LENGTH:
            self._line_m = points_m
            return
        self._picture.stroke.data = {"x": [], "y": [], "r": []}
        material = self.paint.value if self.stroke.value in PAINTS else ""
        stroke = Stroke(self.stroke.value, tuple(points_m), float(self.brush.value or 0.0), material)
        self._widgets.guarded(self._session.maps.draw, stroke)

    def show(self) -> None:
        session = self._session
        self._widgets.once("map", (session.partial, session.title, session.steps, session.plan), self._show_map)
        self._show_strokes()
        self._show_layers()

    def _show_map(self) -> None:
        partial, session = self._session.partial, self._session
        self._picture.show_map(partial, session.plan)
        self._line_m = []
        self.length.value = None
        self.stroke.value = "" if self.stroke.value == LENGTH else self.stroke.value
        self.example.value = session.title if session.home is not None else ""
        if session.plan is not None:
            self.dark.value = session.plan.threshold
        if partial is None:
            self.text.text = f"<b>{html.escape(session.title)}</b>"
            return
        x0, y0, x1, y1 = partial.bounds_m
        seen = "complete" if partial.is_complete else f"{partial.observed_fraction:.0%} observed"
        size = f"{x1 - x0:.1f} x {y1 - y0:.1f} m, cells of {partial.resolution_m:g} m"
        robot = f"; robot after {session.steps} steps" if session.home is not None else ""
        self.text.text = f"<b>{html.escape(session.title)}</b>: {size}, {seen}{robot}{_legend(partial)}"

    def _show_strokes(self) -> None:
        plan = self._session.plan
        self.length.visible = self.dark.visible = plan is not None
        self.undo.visible = bool(self._session.strokes)
        is_measured = plan is None or plan.pixel_m is not None
        kinds = [kind for kind in STROKES if plan is not None or kind != LENGTH]
        options = [("", "moves transmitters"), *((kind, STROKES[kind]) for kind in kinds)]
        self.stroke.options = options if is_measured else [(LENGTH, STROKES[LENGTH])]
        if self.stroke.value not in [kind for kind, _ in self.stroke.options]:
            self.stroke.value = self.stroke.options[0][0]
        for model, users in ((self.brush, BRUSHES), (self.paint, PAINTS), (self.hint, (AREA,))):
            model.visible = self.stroke.value in users
        self._widgets.once("unit", (is_measured,), lambda: self._picture.show_unit("m" if is_measured else "pixels"))

    def _show_layers(self) -> None:
        """Show the layers of a drawing that are walls."""
        source, partial = self._session.source, self._session.partial
        self.layer.visible = self.layer_material.visible = isinstance(source, Drawing) and partial is not None
        if isinstance(source, Drawing) and partial is not None and partial.import_source is not None:
            self.layer.options = [each.name for each in partial.import_source.used]
            if self.layer.value not in self.layer.options:
                self.layer.value = next(iter(self.layer.options), "")
            self.layer_material.value = source.materials.get(self.layer.value, "")


class TransmitterSection:
    """The transmitters, their places, powers, channels and antennas."""

    def __init__(self, widgets: Widgets, session: Session, picture: Picture) -> None:
        self._widgets, self._session, self._picture = widgets, session, picture
        searches = session.searches
        self.chosen = widgets.select("Transmitter", (), self._choose)
        self.name = widgets.name("Name", lambda value: self._change(new_name=value))
        places = (
            ("x_m", "x [m]", 0.25, None, None),
            ("y_m", "y [m]", 0.25, None, None),
            ("z_m", "Height [m]", 0.1, 0, 100),
            ("eirp_dbm", "Power [dBm]", 1, -100, 100),
        )
        self.fields = widgets.numbers(places, lambda name, value: self._change(**{name: float(value)}), format="0.[00]")
        models = [(name, name or "own power") for name in MODELS]
        self.model = widgets.select("Kind", models, lambda name: self._change(model=name), name="model")
        self.channel = widgets.select("Channel", (), lambda name: self._change(channel=name), name="channel", **NARROW)
        self.goal = widgets.number("Covered floor [%]", name="goal", low=1, high=100, step=1, value=95)
        self.most = widgets.number("At most", name="most", low=1, high=MOST_TRANSMITTERS, step=1, value=4)
        self.plan_channels = widgets.button("Plan channels", lambda: searches.plan_channels())
        self.pattern = widgets.select(
            "Antenna", _ANTENNAS.items(), lambda value: self._change_antenna("pattern", value), name="pattern"
        )
        aims = (
            ("azimuth_deg", "Azimuth [\u00b0]", 5, -360, 360),
            ("downtilt_deg", "Downtilt [\u00b0]", 5, -90, 90),
        )
        self.aims = widgets.numbers(aims, self._change_antenna, format="0.[0]", max_width=80)
        self.root = self._laid_out()
        picture.points.on_change("data", self._on_points)
        picture.points.selected.on_change("indices", self._on_selected)

    def _laid_out(self) -> Any:
        session = self._session
        x, y, z, eirp = self.fields.values()
        return wide(
            pair(self.chosen, self.name),
            pair(x, y),
            pair(z, eirp),
            pair(self.model, self.channel),
            pair(self.pattern, *self.aims.values()),
            pair(
                self._widgets.button("Add", lambda: session.radios.add()),
                self._widgets.button("Remove", lambda: session.radios.remove(session.chosen)),
            ),
            self._widgets.button("Place it for me", lambda: session.searches.place(), button_type="primary"),
            pair(self.goal, self.most),
            self._widgets.button("Place several for me", self._place_several),
            self.plan_channels,
        )

    def _on_points(self, _name: str, _old: Any, new: Any) -> None:
        if not self._widgets.is_showing:
            placed = [*zip(new["name"], new["x"], new["y"], strict=True)]
            self._widgets.guarded(self._session.radios.put, placed)

    def _on_selected(self, _name: str, _old: Any, new: list[int]) -> None:
        """Choose a clicked or dragged transmitter; clearing the selection here would end a drag."""
        if new and not self._widgets.is_showing:
            self._choose(self._picture.points.data["name"][new[-1]])

    def _choose(self, name: str) -> None:
        if name in self._session.transmitters:
            self._session.chosen = name
        self._session.jobs.show()

    def _change(self, **values: Any) -> None:
        self._session.radios.change(self._session.chosen, **values)

    def _change_antenna(self, name: str, value: Any) -> None:
        antenna = self._session.transmitters[self._session.chosen].antenna
        self._change(antenna=replace(antenna, **{name: value}))

    def _place_several(self) -> None:
        self._session.searches.place_several(float(self.goal.value or 0.0) / 100.0, int(self.most.value or 1))

    def show(self) -> None:
        session, picture = self._session, self._picture
        names, each = [*session.transmitters], [*session.transmitters.values()]
        rows: dict[str, Any] = {"x": [tx.x_m for tx in each], "y": [tx.y_m for tx in each], "name": names}
        rows["colour"] = server_codes(MOST_TRANSMITTERS)[: len(names)]
        if not _are_drawn(rows, picture.points.data):
            picture.points.data = rows
        lines = aims_m(session.partial, each)
        aims = {"xs": [line[:, 0].tolist() for line in lines], "ys": [line[:, 1].tolist() for line in lines]}
        self._widgets.once("aims", (repr(aims),), bind(setattr, picture.aims, "data", aims))
        self.chosen.options, self.chosen.value = [*names], session.chosen
        channels = dict.fromkeys(["", *session.settings.channels, *(tx.channel for tx in each)])
        self.channel.options = [(channel, channel or "shared by all") for channel in channels]
        self.plan_channels.visible = len(names) > 1
        self._show_chosen()

    def _show_chosen(self) -> None:
        chosen = self._session.transmitters.get(self._session.chosen)
        shown = {
            self.name: self._session.chosen,
            self.model: chosen.model if chosen else "",
            self.channel: chosen.channel if chosen else "",
            self.pattern: chosen.antenna.pattern if chosen else "iso",
            **{field: chosen and getattr(chosen, name) for name, field in self.fields.items()},
            **{field: chosen and getattr(chosen.antenna, name) for name, field in self.aims.items()},
        }
        for field, value in shown.items():
            field.value, field.disabled = value, chosen is None
        for field in self.aims.values():  # an isotropic antenna points nowhere
            field.disabled |= self.pattern.value == "iso"


class RadioSection:
    """Frequency, bandwidth, walls and receivers."""

    def __init__(self, widgets: Widgets, session: Session) -> None:
        self._session, radios = session, session.radios
        self.walls = widgets.select(
            "Paths through walls", _WALLS.items(), lambda value: radios.set(through_walls=_THROUGH_WALLS[value])
        )
        self.both_ways = widgets.select(
            "Received power", _DIRECTIONS.items(), lambda value: radios.set(both_ways=bool(value)), name="both_ways"
        )
        self.region = widgets.select(
            "Power limits of", _REGIONS.items(), lambda name: radios.set(region=name), name="region"
        )
        settings = (
            ("frequency_hz", "Frequency [GHz]", 0.1, 0.1, 300),
            ("bandwidth_hz", "Bandwidth [MHz]", 10, 0.01, 10_000),
            ("rx_height_m", "Receiver height [m]", 0.1, 0, 100),
            ("spacing_m", "Between receivers [m]", 0.05, 0.05, 10),
            ("client_dbm", "Client's power [dBm]", 1, -100, 100),
        )
        self.fields = widgets.numbers(
            settings,
            lambda name, value: radios.set(**{name: float(value) * _UNITS.get(name, 1.0)}),
            format="0.[000]",
        )
        frequency, bandwidth, height, spacing, client = self.fields.values()
        self.root = wide(
            pair(frequency, bandwidth),
            pair(self.walls, self.region),
            pair(self.both_ways, client),
            pair(height, spacing),
        )

    def show(self) -> None:
        settings = self._session.settings
        self.both_ways.value, self.region.value = "1" * settings.both_ways, settings.region
        self.fields["client_dbm"].visible = settings.both_ways
        for name, field in self.fields.items():
            field.value = getattr(settings, name) / _UNITS.get(name, 1.0)
        self.walls.value = {value: name for name, value in _THROUGH_WALLS.items()}[settings.through_walls]


class RobotSection:
    """The simulated robot, and measurements of a real one or of a survey."""

    def __init__(self, widgets: Widgets, session: Session, picture: Picture) -> None:
        self._widgets, self._session, self._picture = widgets, session, picture
        self.more = widgets.button(f"Explore {MORE_STEPS} more steps", lambda: session.maps.explore_more())
        self.access_point = widgets.select(
            "Access point of the survey", (), lambda name: session.surveys.assign(name), name="access_point"
        )
        self.measured = text("measured_text")
        self.forget = widgets.button("Forget the measurements", lambda: session.surveys.forget_measurements())
        self.root = wide(
            self.more,
            widgets.button("Best next views", lambda: session.searches.find_views()),
            widgets.upload("Import a survey\u2026", "csv-file"),
            self.access_point,
            self.measured,
            self.forget,
        )

    def show(self) -> None:
        session = self._session
        self.more.visible = session.home is not None
        self.measured.visible = self.forget.visible = session.measured is not None
        chosen, options = session.transmitters.get(session.chosen), session.survey.options if session.survey else []
        self.access_point.options, self.access_point.visible = options, bool(options and chosen)
        self.access_point.title = f"Access point of the survey for {session.chosen}"
        if session.survey and chosen:
            self.access_point.value = session.survey.access_point_at(chosen.position_m)
        of_map = session.partial, repr(session.transmitters), session.settings.frequency_hz
        key = session.measured, *of_map, session.answer and session.answer.coverage
        self._widgets.once("measured", key, self._show_points)
        self._widgets.once("views", (session.views,), lambda: self._picture.show_views(session.views))

    def _show_points(self) -> None:
        (rx_m, used), measured = self._session.measured_points(), self._session.measured
        colours = [USED if each else UNUSED for each in used]
        values: Any = [] if measured is None else measured.gain_db
        of_points = {"x": rx_m[:, 0], "y": rx_m[:, 1], "value": values, "name": self._session.measured_names()}
        self._picture.measured.data = of_points | {"colour": colours}
        unused = f", {(~used).sum()} of them not used (white)" if not used.all() else ""
        fits = [
            f"{power_dbm:.0f} dBm of {html.escape(name)}"
            for name, power_dbm in measured_powers_dbm(self._session.answer)
        ]
        fitting = f". As received powers, they fit {', '.join(fits)}" if fits else ""
        self.measured.text = f"{len(used)} measured points{unused}{fitting}"


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
