"""Display of results: in one line at a prompt, and with a picture under it in a notebook."""

from base64 import b64encode
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from html import escape
from pkgutil import resolve_name
from typing import Any, ClassVar

from sionna_partial.checks import shown
from sionna_partial.resources import optional_packages

LONGEST = 240
"""Length of the longest line [characters]."""

THUMBNAIL_PX = 640
"""Largest width of a picture [pixels]."""

_FEW = 4


def later(name: str) -> Any:
    """Return a function of a later room, as "plots.map_plot:plot_map", whose module is imported by no result."""
    with optional_packages():
        return resolve_name(f"sionna_partial.{name}")


def picture_html(line: str, plot: str, value: object) -> str:
    """Return HTML of a line and of the figure that a function makes of a value."""
    png = later("plots.style:figure_png")(later(plot)(value), width_px=THUMBNAIL_PX)
    return f'<code>{escape(line)}</code><br><img src="data:image/png;base64,{b64encode(png).decode()}">'


def _one_line(value: Any) -> str:
    texts = (f"{each.name}={_brief(getattr(value, each.name))}" for each in fields(value) if each.repr)
    line = f"{type(value).__name__}({', '.join(texts)})"
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 4]}...)"


def _brief(value: Any) -> str:
    """Return small values as they are, arrays by type and shape, and others by type and length."""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return f"{value.dtype} {value.shape}" if value.size > _FEW else _brief(value.tolist())
    if isinstance(value, float):
        return f"{value:.6g}"
    if is_dataclass(value):
        return f"{type(value).__name__}(...)"
    if isinstance(value, Mapping) or (isinstance(value, tuple | list) and len(value) > _FEW):
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(_brief, value))}{',' * (len(value) == 1)})"
    return shown(value)


class Shown:
    """Base of dataclasses that are shown in one line."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.__repr__ = _one_line  # type: ignore[method-assign]  # in the class itself, else dataclass writes its own


class Pictured(Shown):
    """Base of those that notebooks show with a picture, made by a function that the class names as `plot`."""

    _plot: ClassVar[str]

    def __init_subclass__(cls, *, plot: str, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls._plot = plot

    def _repr_html_(self) -> str:
        return picture_html(repr(self), self._plot, self)
