"""Progress of long work: a bar in a terminal or a notebook, lines of a command elsewhere, or what a caller does."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from importlib import import_module
from time import monotonic
from typing import Any, Protocol

from sionna_partial.checks import CountProgress, Progress, require

WAIT_S, DRAW_S, LINE_S = 2.0, 0.1, 60.0
"""Time until a bar appears, between two pictures of it in a notebook, and between two lines [s]."""


@contextmanager
def reporting(progress: Progress | bool | None, *, command: bool = False) -> Iterator[Progress]:
    """Open what work reports to: a callable itself, nothing for False, and else a bar with the time left.

    The bar appears when the work takes longer than 2 s; without a terminal or a notebook there is none. A `command`
    has it at once, and prints a line a minute where there is none.
    """
    if callable(progress):
        yield progress
        return
    with _display(progress, command=command) as draw:
        started = monotonic()

        def report(fraction: float, message: str) -> None:
            elapsed_s = monotonic() - started
            rest = _time_left(elapsed_s * (1.0 / fraction - 1.0)) if fraction > 0.0 and elapsed_s > WAIT_S else ""
            draw(fraction, f"{fraction:.0%} {message} {rest}".rstrip())

        yield report


@contextmanager
def counting(progress: CountProgress | bool | None, unit: str, *, command: bool = False) -> Iterator[CountProgress]:
    """Open the same for things (`unit`, in the plural) that are counted, with how many are done a minute.

    Those that were done at the first report do not count for the rate. A command also prints the first and last line.
    """
    if callable(progress):
        yield progress
        return
    with _display(progress, command=command) as draw:
        first: tuple[int, float] | None = None

        def report(done: int, total: int, message: str) -> None:
            nonlocal first
            now, starting = monotonic(), first is None
            first = first or (done, now)
            pace = rate_and_rest(done - first[0], total - done, now - first[1])
            text = f"{done} of {total} {unit} {pace} {message}".replace("  ", " ")
            draw(done / max(1, total), text, at_once=starting or done == total)

        yield report


def part_of(report: Progress, low: float, high: float) -> Progress:
    """Return what reports a part of the work, from one fraction to another."""
    return lambda fraction, message: report(low + (high - low) * fraction, message)


def rate_and_rest(done: int, rest: int, elapsed_s: float) -> str:
    """Return how many a minute were done, and how long the rest takes at that rate; "" where nothing was done."""
    if not done or elapsed_s <= 0.0:
        return ""
    return f"({60.0 * done / elapsed_s:.3g}/min, {_time_left(rest * elapsed_s / done)})"


def _time_left(rest_s: float) -> str:
    seconds = round(rest_s)
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02} left"


class _Bar(Protocol):
    """What shows progress."""

    def draw(self, fraction: float, text: str, *, at_once: bool) -> None: ...

    def close(self, *, done: bool) -> None: ...


@contextmanager
def _display(progress: object, *, command: bool) -> Iterator[Callable[..., None]]:
    """Open what shows a fraction and a text."""
    require(progress is None or isinstance(progress, bool), "progress", progress, "give True, False or a callable.")
    bar = None if progress is False else _bar(command=command)
    started = monotonic()

    def draw(fraction: float, text: str, *, at_once: bool = False) -> None:
        if bar and (command or monotonic() - started >= WAIT_S):
            bar.draw(fraction, text, at_once=at_once)

    try:
        yield draw
    except BaseException:  # the error that follows stands alone
        if bar:
            bar.close(done=False)
        raise
    if bar:
        bar.close(done=True)


def _bar(*, command: bool) -> _Bar | None:
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if hasattr(shell, "kernel"):
        return _NotebookBar()
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_terminal:
        return _TerminalBar(console)
    return _Lines() if command else None


class _TerminalBar:
    def __init__(self, console: Any) -> None:
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        self._bar = Bar(
            BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False), console=console
        )
        self._task = self._bar.add_task("", total=1.0)

    def draw(self, fraction: float, text: str, *, at_once: bool) -> None:
        self._bar.update(self._task, completed=fraction, description=text)
        self._bar.start()

    def close(self, *, done: bool) -> None:
        if self._bar.live.is_started:
            if done:
                self._bar.update(self._task, completed=1.0, description="done")
            self._bar.live.transient = not done
            self._bar.stop()


class _NotebookBar:
    """A bar of plain HTML, as `rich` has none without ipywidgets."""

    def __init__(self) -> None:
        self._started, self._drawn, self._handle = monotonic(), -DRAW_S, None

    def draw(self, fraction: float, text: str, *, at_once: bool) -> None:
        if monotonic() - self._drawn >= DRAW_S:
            self._show(f'<progress value="{fraction:.3f}" max="1"></progress> {escape(text)}')

    def close(self, *, done: bool) -> None:
        if self._handle is not None:
            took_s = monotonic() - self._started
            self._show(f'<progress value="1" max="1"></progress> done in {took_s:.0f} s' if done else "")

    def _show(self, html: str) -> None:
        ipython, self._drawn = import_module("IPython.display"), monotonic()
        if self._handle is None:
            self._handle = ipython.display(ipython.HTML(html), display_id=True)
        else:
            self._handle.update(ipython.HTML(html))


class _Lines:
    def __init__(self) -> None:
        self._printed = monotonic()

    def draw(self, fraction: float, text: str, *, at_once: bool) -> None:
        if at_once or monotonic() - self._printed >= LINE_S:
            self._printed = monotonic()
            print(text, file=sys.stderr, flush=True)

    def close(self, *, done: bool) -> None:
        pass
