"""Display of results at a prompt and in a notebook, and of progress."""

import sys
from base64 import b64encode
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import fields, is_dataclass
from functools import cache
from html import escape
from pkgutil import resolve_name
from typing import Any, ClassVar

from sionna_partial.checks import CountProgress, Progress, require, shown
from sionna_partial.process import told_of_compilations
from sionna_partial.resources import optional_packages

LONGEST = 240

THUMBNAIL_PX = 640

_FEW = 4

_COMPILING = "compiling, once: kernel {} of 90 to 150"

WAIT_S, COMMAND_WAIT_S, LINE_S = 2.0, 0.1, 60.0
"""Delays of bars in calls and commands, and time between lines without a terminal [s]."""


def later(name: str) -> Any:
    """Return a function such as "plots.style:plot_map", imported when it is called."""
    with optional_packages():
        return resolve_name(f"sionna_partial.{name}")


def picture_html(line: str, plot: str, value: object) -> str:
    png = later("plots.style:figure_png")(later(plot)(value), width_px=THUMBNAIL_PX)
    return f'<code>{escape(line)}</code><br><img src="data:image/png;base64,{b64encode(png).decode()}">'


def _one_line(value: Any) -> str:
    texts = (f"{each.name}={_brief(getattr(value, each.name))}" for each in fields(value) if each.repr)
    line = f"{type(value).__name__}({', '.join(texts)})"
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 4]}...)"


def _brief(value: Any) -> str:
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
    """Base of dataclasses with a repr of one line."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.__repr__ = _one_line  # type: ignore[method-assign]  # in the class itself, else dataclass writes its own


class Pictured(Shown):
    """Base of dataclasses that notebooks show with the picture of the function named by `plot`."""

    _plot: ClassVar[str]

    def __init_subclass__(cls, *, plot: str, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls._plot = plot

    def _repr_html_(self) -> str:
        return picture_html(repr(self), self._plot, self)


@contextmanager
def reporting(progress: Progress | bool | None, *, command: bool = False) -> Iterator[Progress]:
    """Open the receiver of progress reports: a callable itself, none for False, else a bar.

    The bar appears after 2 s in terminals and notebooks; a `command` shows it after 0.1 s, and prints a line a minute
    without a terminal. A call without a terminal prints one line if kernels compile (`told_of_compilations`).
    """
    if callable(progress):
        with _compilations_reported_to(progress) as report:
            yield report
        return
    with _bar(progress, command, total=1.0, bar_format="{percentage:3.0f}%|{bar}| {elapsed}<{remaining} {desc}") as bar:

        def draw(fraction: float, message: str) -> None:
            bar.set_description_str(message, refresh=message == _COMPILING.format(1))
            bar.update(fraction - bar.n)

        unseen = bar.disable and progress is not False
        with nullcontext(draw) if unseen else _compilations_reported_to(draw) as report:
            yield report
        bar.update(1.0 - bar.n)


@contextmanager
def _compilations_reported_to(progress: Progress) -> Iterator[Progress]:
    """Report compilations between other reports: the first call on a machine may take a minute longer."""
    reached = 0.0

    def report(fraction: float, message: str) -> None:
        nonlocal reached
        reached = fraction
        progress(fraction, message)

    with told_of_compilations(lambda number: progress(reached, _COMPILING.format(number))):
        yield report


@contextmanager
def counting(progress: CountProgress | bool | None, unit: str, *, command: bool = False) -> Iterator[CountProgress]:
    """Open a receiver of counts of `unit` (plural); the rate excludes the first count."""
    if callable(progress):
        yield progress
        return
    style = f"{{n_fmt}} of {{total_fmt}} {unit} |{{bar}}| {{elapsed}}<{{remaining}} {{desc}}"
    with ExitStack() as stack:
        bar: Any = None

        def report(done: int, total: int, message: str) -> None:
            nonlocal bar
            bar = bar or stack.enter_context(_bar(progress, command, total=total, initial=done, bar_format=style))
            bar.set_description_str(message, refresh=False)
            bar.update(done - bar.n)

        yield report


def part_of(report: Progress, low: float, high: float) -> Progress:
    return lambda fraction, message: report(low + (high - low) * fraction, message)


@contextmanager
def _bar(progress: object, command: bool, **options: Any) -> Iterator[Any]:
    """Open a bar of tqdm, which vanishes before an error."""
    require(progress is None or isinstance(progress, bool), "progress", progress, "give True, False or a callable.")
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    drawn = sys.stderr.isatty() or hasattr(shell, "kernel")
    options |= {"disable": progress is False or not (drawn or command), "smoothing": 0.0, "file": sys.stderr}
    options |= {"delay": COMMAND_WAIT_S if command else WAIT_S}
    if not drawn:
        options |= {"mininterval": LINE_S, "maxinterval": LINE_S}
    with _tqdm()(**options, dynamic_ncols=drawn, leave=True) as bar:
        try:
            yield bar
        except BaseException:
            bar.leave = False
            raise


@cache
def _tqdm() -> Any:
    from tqdm import tqdm

    class Bar(tqdm):
        monitor_interval = 0  # no thread

    return Bar
