"""Widgets of the page, which pass what a user chooses to the session of the window, and their layout."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from sionna_partial.apps.app.session import Session
from sionna_partial.errors import SionnaPartialError

NARROW: dict[str, Any] = {"max_width": 128}
"""Width of fields beside longer texts, which would be cut off on a phone [pixels]."""

_UPLOAD = "document.getElementById(id).click()"


class Widgets:
    """Widgets of one window: refusals of the session are shown, and values that it shows call nothing."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.is_showing = False
        self._drawn: dict[str, tuple[Any, ...]] = {}

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Show the session: widgets that change within call nothing."""
        self.is_showing = True
        try:
            yield
        finally:
            self.is_showing = False

    def once(self, name: str, key: tuple[Any, ...], draw: Callable[[], None]) -> None:
        """Draw a part of the page if its contents have changed."""
        if self._drawn.get(name) != key:
            draw()
            self._drawn[name] = key

    def guarded(self, take: Callable[..., object], *given: Any) -> None:
        try:
            take(*given)
        except SionnaPartialError as error:
            self._session.jobs.refuse(error)

    def select(
        self, title: str, options: Iterable[Any] = (), take: Callable[[str], object] | None = None, **look: Any
    ) -> Any:
        """Make a choice of texts, or of pairs of a value and its text."""
        from bokeh.models.widgets.inputs import Select

        return self._on(Select(title=title, options=[*options], **look), take)

    def number(
        self, title: str, take: Callable[[float], object] | None = None, attribute: str = "value_throttled", **look: Any
    ) -> Any:
        from bokeh.models.widgets.inputs import Spinner

        return self._on(Spinner(title=title, **look), take, attribute)

    def numbers(
        self, rows: Iterable[tuple[str, str, float, Any, Any]], take: Callable[[str, float], object], **look: Any
    ) -> dict[str, Any]:
        """Make numbers by name, of name, title, step, and lowest and highest value; `take` gets name and value."""
        return {
            name: self.number(title, partial(take, name), name=name, step=step, low=low, high=high, **look)
            for name, title, step, low, high in rows
        }

    def slider(self, title: str, take: Callable[[float], object], attribute: str = "value", **look: Any) -> Any:
        from bokeh.models.widgets.sliders import Slider

        return self._on(Slider(title=title, step=1, **look), take, attribute)

    def name(self, title: str, take: Callable[[str], object]) -> Any:
        from bokeh.models.widgets.inputs import TextInput

        return self._on(TextInput(title=title), take)

    def button(self, label: str, take: Callable[[], object] | None = None, **look: Any) -> Any:
        from bokeh.models.widgets.buttons import Button

        button = Button(label=label, name=label, **look)
        if take is not None:
            button.on_click(lambda _: self.guarded(take))
        return button

    def upload(self, label: str, element: str) -> Any:
        """Make a button that opens the file field of the page with an id."""
        from bokeh.models import CustomJS

        button = self.button(label)
        button.js_on_click(CustomJS(args={"id": element}, code=_UPLOAD))
        return button

    def _on(self, model: Any, take: Callable[[Any], object] | None, attribute: str = "value") -> Any:
        if take is None:
            return model

        def changed(_name: str, _old: Any, new: Any) -> None:
            if self.is_showing:
                return
            if new is None:  # a field was emptied: its old value is shown again
                self._session.jobs.show()
            else:
                self.guarded(take, new)

        model.on_change(attribute, changed)
        return model


def text(name: str, **look: Any) -> Any:
    from bokeh.models.widgets.markups import Div

    return Div(name=name, sizing_mode="stretch_width", **look)


def pair(*models: Any) -> Any:
    """Lay widgets out in a row of equal widths."""
    from bokeh.layouts import row

    for model in models:
        model.sizing_mode, model.width = "stretch_width", None
    return row(*models, sizing_mode="stretch_width")


def wide(*models: Any) -> Any:
    """Lay widgets out in a column."""
    from bokeh.layouts import column

    for model in models:
        model.sizing_mode = "stretch_width"
    return column(*models, sizing_mode="stretch_width")
