"""Progress of long work: a bar of tqdm, or what a caller does."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any

from sionna_partial.checks import CountProgress, Progress, require

WAIT_S, COMMAND_WAIT_S, LINE_S = 2.0, 0.1, 60.0
"""Time until a bar of a call appears, of a command, and between two lines of a command without a terminal [s]."""


@contextmanager
def reporting(progress: Progress | bool | None, *, command: bool = False) -> Iterator[Progress]:
    """Open what work reports to: a callable itself, nothing for False, and else a bar with the time left.

    The bar appears when the work takes longer than 2 s; without a terminal or a notebook there is none. A `command`
    has it after 0.1 s, and prints a line a minute without a terminal.
    """
    if callable(progress):
        yield progress
        return
    with _bar(progress, command, total=1.0, bar_format="{percentage:3.0f}%|{bar}| {elapsed}<{remaining} {desc}") as bar:

        def report(fraction: float, message: str) -> None:
            bar.set_description_str(message, refresh=False)
            bar.update(fraction - bar.n)

        yield report
        bar.update(1.0 - bar.n)


@contextmanager
def counting(progress: CountProgress | bool | None, unit: str, *, command: bool = False) -> Iterator[CountProgress]:
    """Open the same for things (`unit`, in the plural) that are counted.

    Those that were done at the first report do not count for the rate.
    """
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
    """Return what reports a part of the work, from one fraction to another."""
    return lambda fraction, message: report(low + (high - low) * fraction, message)


@contextmanager
def _bar(progress: object, command: bool, **options: Any) -> Iterator[Any]:
    """Open a bar of tqdm, which stays when the work is done, and vanishes before an error."""
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
