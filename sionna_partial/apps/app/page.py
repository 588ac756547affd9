"""The page of the app: draws the state of a session with Bokeh, and passes clicks to the session."""

import html
from pathlib import Path
from typing import Any

from sionna_partial.apps.app.answer import LAYERS, OUTLINES, Answer
from sionna_partial.apps.app.files import FILES
from sionna_partial.apps.app.picture import Picture
from sionna_partial.apps.app.radio import PRESETS
from sionna_partial.apps.app.sections import (
    MATERIAL_OPTIONS,
    MapSection,
    RadioSection,
    RobotSection,
    TransmitterSection,
)
from sionna_partial.apps.app.session import Session
from sionna_partial.apps.app.widgets import NARROW, Widgets, pair, text, wide
from sionna_partial.plots.report import LIKELY, room_fractions

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
_COPY = """
const copied = navigator.clipboard ? navigator.clipboard.writeText(area.value) : Promise.reject()
copied.then(() => { message.text = "Copied." }, () => { message.text = "Select the lines, and copy them with Ctrl-C." })
"""
_LOST = (
    "message.text = 'The connection has ended: start sionna-partial app again, and open the address that it prints.'"
)
_CODE = "textarea { font-family: monospace; font-size: 12px; white-space: pre }"
_LINKS = (
    "a { display: inline-block; padding: 0.25em 0.7em; margin: 0.15em; border: 1px solid #93a1b0; border-radius: 6px }"
)

TEMPLATE = Path(__file__).with_name("page.html").read_text(encoding="utf-8")


class Page:
    """Page of one window, whose files are downloaded below `files_url`."""

    def __init__(self, document: Any, files_url: str) -> None:
        from bokeh.models import CustomJS

        self._files_url = files_url
        self.session = Session(document.add_next_tick_callback, self.show)
        self._widgets, self.picture = Widgets(self.session), Picture()
        self._make_status()
        self._make_choices()
        self._make_files()
        self.map = MapSection(self._widgets, self.session, self.picture)
        self.transmitters = TransmitterSection(self._widgets, self.session, self.picture)
        self.radio = RadioSection(self._widgets, self.session)
        self.robot = RobotSection(self._widgets, self.session, self.picture)
        for name, model in self._roots().items():
            model.name = name
            document.add_root(model)
        document.js_on_event("connection_lost", CustomJS(args={"message": self.message}, code=_LOST))

    def _make_status(self) -> None:
        self.message = text("message", html_attributes={"role": "status", "aria-live": "polite"})
        self.warnings = text("warnings", html_attributes={"role": "status"})
        self.cancel = self._widgets.button("Cancel", lambda: self.session.jobs.cancel(), button_type="danger", width=90)

    def _make_choices(self) -> None:
        session, select = self.session, self._widgets.select
        presets = [("", "own values"), *((name, name) for name in PRESETS)]
        self.preset = select("Band", presets, self._use_preset, name="preset")
        self.material = select(
            "Material of walls", MATERIAL_OPTIONS, lambda name: session.radios.set(material=name), name="material"
        )
        self.layer = select(
            "Layer", self._layers(), lambda name: session.look(layer=name), name="layer", value="p_above"
        )
        self.which = select("Shown for", (), lambda name: session.look(transmitter=name), **NARROW)
        self.outline = select(
            "Line at the threshold",
            OUTLINES.items(),
            lambda name: session.look(outline=name),
            name="outline",
            value="p_above",
            max_width=148,
        )
        self.truth = select("Computed for", _COMPUTED_FOR.items(), lambda value: session.look(truth=bool(value)))
        self.threshold = self._widgets.slider(
            "Threshold [dBm]",
            lambda value: session.radios.set(threshold_dbm=float(value)),
            name="threshold",
            start=-130,
            end=-30,
            value=-67,
        )

    def _make_files(self) -> None:
        from bokeh.models import CustomJS
        from bokeh.models.widgets.inputs import TextAreaInput
        from bokeh.models.widgets.markups import Div

        self.summary = text("summary")
        self.links = Div(sizing_mode="stretch_width", stylesheets=[_LINKS])
        self.remove_logo = self._widgets.button("Remove the logo", lambda: self.session.take_logo(b"", ""))
        self.python = TextAreaInput(title="The same in Python", rows=8, stylesheets=[_CODE], name="python")
        self.copy = self._widgets.button("Copy as Python")
        self.copy.js_on_click(CustomJS(args={"area": self.python, "message": self.message}, code=_COPY))

    def _roots(self) -> dict[str, Any]:
        from bokeh.layouts import row

        return {
            "status": wide(row(self.message, self.cancel), self.warnings),
            "band": pair(self.preset, self.material),
            "layers": pair(self.layer, self.which),
            "lines": pair(self.outline, self.truth),
            "choices": pair(self.threshold),
            "picture": self.picture.plot,  # nothing above it changes its height with an answer: a drag would miss
            "summary": self.summary,
            "links": self.links,
            "map": self.map.root,
            "transmitters": self.transmitters.root,
            "radio": self.radio.root,
            "robot": self.robot.root,
            "repeat": wide(
                self._widgets.upload("Logo for the report\u2026", "logo-file"),
                self.remove_logo,
                self.python,
                self.copy,
            ),
        }

    def _use_preset(self, name: str) -> None:
        if name:
            self.session.radios.use_preset(name)

    def _layers(self) -> list[tuple[str, str]]:
        return [(name, LAYERS[name].title) for name in self.session.layers]

    def show(self) -> None:
        """Show the state of the session."""
        with self._widgets.showing():
            self._show_status()
            for section in (self.map, self.transmitters, self.radio, self.robot):
                section.show()
            self._show_choices()
            self._show_answer()
            self._show_files()

    def _show_status(self) -> None:
        status, answer = self.session.jobs.status, self.session.answer
        message = html.escape(status.message)
        if status.fraction is not None:
            message = f'<progress max="1" value="{status.fraction:.2f}" aria-label="progress"></progress> {message}'
        elif answer is not None and "wall_material" in answer.coverage.attrs:
            message += f" Probability of wall materials: {html.escape(str(answer.coverage.attrs['wall_material']))}."
        colour = "#a1232f" if status.is_error else "#1a1a1a"
        self.message.text = f'<span style="color:{colour}">{message}</span>'
        self.cancel.visible = status.fraction is not None
        self.warnings.text = "<br>".join(f"<b>Note:</b> {html.escape(each)}" for each in self.session.warnings)
        self.warnings.visible = bool(self.session.warnings)

    def _show_choices(self) -> None:
        session, names = self.session, [*self.session.transmitters]
        view, settings = session.shown_view, session.settings
        self.which.options = [("", _STRONGEST)] * (len(names) != 1) + [(name, name) for name in names]
        self.which.value = view.transmitter if len(names) != 1 else names[0]
        self.layer.options, self.layer.value = self._layers(), view.layer
        self.outline.value, self.truth.value = view.outline, "1" * view.truth
        self.truth.visible = session.home is not None
        self.material.value, self.preset.value = settings.material, settings.preset
        if self.threshold.value != settings.threshold_dbm:
            self.threshold.value = settings.threshold_dbm

    def _show_answer(self) -> None:
        session, answer, partial = self.session, self.session.answer, self.session.partial
        view, threshold_dbm = session.shown_view, session.settings.threshold_dbm
        self._widgets.once("answer", (answer, view, threshold_dbm), self._show_values)
        for layer, parts in self.picture.parts.items():
            for part in parts:
                part.visible = layer == view.layer
        title = "Map" if answer is None else answer.title(view, threshold_dbm)
        settings = session.settings if answer is None else answer.settings
        below = " " if partial is None else settings.text(partial)
        self.picture.plot.title.text = f"{title}\n{below}"  # two lines always: their space is found once

    def _show_values(self) -> None:
        answer, threshold_dbm = self.session.answer, self.session.settings.threshold_dbm
        self.picture.show_answer(answer, self.session.shown_view, threshold_dbm)
        self.summary.text = "" if answer is None else _summary(answer, threshold_dbm)

    def _show_files(self) -> None:
        session, answer = self.session, self.session.answer
        kinds = [*FILES] if answer is not None and answer.is_final else ["project"]
        links = (
            f'<a href="{self._files_url}/{kind}" download="{FILES[kind]}">{_FILE_NAMES[kind]}</a>' for kind in kinds
        )
        self.links.text = " ".join(links) if session.partial is not None else ""
        self.remove_logo.visible = session.logo is not None
        self.remove_logo.label = f"Remove the logo {session.logo[0]}" if session.logo else ""
        self.python.value = session.python()


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
