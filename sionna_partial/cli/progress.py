"""Progress of long commands on stderr: a bar on a terminal, a line a minute elsewhere."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Any

import typer

from sionna_partial.checks import Progress

LINE_S = 60.0
"""Time between two lines of progress where there is no terminal [s]."""


@contextmanager
def show_progress() -> Iterator[Progress]:
    """Show the fraction that is done and the time left."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    done = (BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(), TextColumn("{task.fields[rest]}"))
    started = monotonic()
    with _bar_or_lines(TextColumn("{task.description}"), *done) as (bar, print_line):
        task = bar.add_task("starting", total=1.0, rest="")

        def report(fraction: float, message: str) -> None:
            elapsed_s = monotonic() - started
            rest = _time_left(elapsed_s * (1.0 / fraction - 1.0)) if fraction > 0.0 and elapsed_s > 2.0 else ""
            bar.update(task, completed=fraction, description=message, rest=rest)
            print_line(f"{fraction:.0%} {message} {rest}".rstrip())

        try:
            yield report
        except BaseException:
            bar.live.transient = True  # the error that follows stands alone
            raise
        bar.update(task, completed=1.0, description="done")


@contextmanager
def show_rate(unit: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show how many things (`unit`, in the plural) are done, how many a minute, and the time left.

    The callable takes how many are done, their number, and a message. Those that were done at its first call do not
    count for the rate. Without a terminal, there is a line at the start and the end, too.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn(unit), TextColumn("{task.fields[pace]}"))
    with _bar_or_lines(*columns, TextColumn("{task.description}")) as (bar, print_line):
        task = bar.add_task("", total=None, pace="")
        first: tuple[int, float] | None = None

        def report(done: int, total: int, message: str) -> None:
            nonlocal first
            now, starting = monotonic(), first is None
            first = first or (done, now)
            pace = rate_and_rest(done - first[0], total - done, now - first[1])
            bar.update(task, completed=done, total=total, pace=pace, description=message)
            line = f"{done} of {total} {unit} {pace} {message}".replace("  ", " ")
            print_line(line, at_once=starting or done == total)

        yield report


@contextmanager
def _bar_or_lines(*columns: Any) -> Iterator[tuple[Any, Callable[..., None]]]:
    """Open a bar on stderr, and what prints a line where there is no terminal: once a minute, or at once."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    printed = monotonic()

    def print_line(line: str, *, at_once: bool = False) -> None:
        nonlocal printed
        if not console.is_terminal and (at_once or monotonic() - printed >= LINE_S):
            printed = monotonic()
            typer.echo(line, err=True)

    with Bar(*columns, console=console, disable=not console.is_terminal) as bar:
        yield bar, print_line


def rate_and_rest(done: int, rest: int, elapsed_s: float) -> str:
    """Return how many a minute were done, and how long the rest takes at that rate; "" where nothing was done."""
    if not done or elapsed_s <= 0.0:
        return ""
    return f"({60.0 * done / elapsed_s:.3g}/min, {_time_left(rest * elapsed_s / done)})"


def _time_left(rest_s: float) -> str:
    seconds = round(rest_s)
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02} left"
