"""What all subcommands share: options, numbers, progress, and the files that were written."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from sionna_partial.settings import Material

MapArgument = Annotated[
    Path,
    typer.Argument(
        metavar="MAP", help="ROS map_server YAML, exported scene folder, .npz, or mesh.", show_default=False
    ),
]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="Read the map file to the letter, even if it looks wrong.")
]
HeightBandOption = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="LOW HIGH", help="Of a mesh: z between which its surfaces are walls [m].", show_default=False),
]
UpOption = Annotated[
    str | None, typer.Option(metavar="y|z", help="Of a mesh: the axis that points up.", show_default=False)
]
MaterialOption = Annotated[
    str, typer.Option(help="ITU material name, or permittivity,conductivity[S/m],thickness[m]. Default: drywall.")
]
FieldOfViewOption = Annotated[float, typer.Option(help="Angle that the robot sees at once, up to 360 [degree].")]
RangeOption = Annotated[float, typer.Option("--range", help="How far it sees [m].")]
RangeNoiseOption = Annotated[float, typer.Option(help="Standard deviation of its ranges [m].")]
DriftOption = Annotated[float, typer.Option(help="Growth of its error of position [m per m of way].")]
MissedWallsOption = Annotated[float, typer.Option(help="Share of walls that it misses, as glass [1].")]
FrequencyOption = Annotated[float, typer.Option(help="Carrier frequency [Hz].")]
MaxDepthOption = Annotated[int, typer.Option(help="Largest number of interactions on a path.")]
DiffractionOption = Annotated[
    bool, typer.Option("--diffraction/--no-diffraction", help="Whether paths bend around vertical edges of walls.")
]
WallHeightOption = Annotated[
    float | None, typer.Option(help="Height of walls and ceiling [m]. Default: the map's.", show_default=False)
]
MemoryOption = Annotated[float, typer.Option("--memory", help="Memory that the process may take [GB].")]
PredictorOption = Annotated[str, typer.Option(help="'map', 'paper', or a .keras file. Default: 'map'.")]

LINE_S = 60.0
"""Time between two lines of progress where there is no terminal [s]."""


class TransmitterCommand(TyperCommand):
    """Takes `--tx X Y` and `--tx X Y Z`: an option with two or three values."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the numbers after --tx to one value."""
        return super().parse_args(ctx, join_numbers(args, "--tx"))


def join_numbers(args: Sequence[str], option: str) -> list[str]:
    """Join the numbers that follow `option`, negative ones too, to the one value that a parser can take."""
    joined: list[str] = []
    rest = list(args)
    while rest:
        arg = rest.pop(0)
        if arg.startswith(f"{option}="):
            rest.insert(0, arg.removeprefix(f"{option}="))
            arg = option
        if arg == option:
            words = list(itertools.takewhile(_is_number, rest)) or rest[:1]
            del rest[: len(words)]
            parse_position(" ".join(words))
            arg = f"{option}={' '.join(words)}"
        joined.append(arg)
    return joined


def parse_position(text: str) -> tuple[float, ...]:
    """Transmitter position from "X Y" or "X Y Z" [m]."""
    words = text.replace(",", " ").split()
    if len(words) not in (2, 3) or not all(map(_is_number, words)):
        raise typer.BadParameter(f"--tx {text!r} is not a position: give --tx X Y or --tx X Y Z in metres.")
    return tuple(map(float, words))


def parse_material(text: str) -> Material:
    """Material from an ITU name or "permittivity,conductivity,thickness"; the default for ""."""
    if not text:
        return Material()
    words = text.split(",")
    if len(words) == 1:
        return Material(itu=text)
    if len(words) != 3 or not all(map(_is_number, words)):
        raise typer.BadParameter(
            f"--material {text!r} is neither an ITU name nor permittivity,conductivity,thickness: "
            "give for example concrete, or 2.94,0.1226,0.1."
        )
    permittivity, conductivity_s_m, thickness_m = map(float, words)
    return Material(permittivity, conductivity_s_m, thickness_m)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@contextmanager
def show_progress() -> Iterator[Callable[[float, str], None]]:
    """Show progress and the time left on stderr: a bar on a terminal, a line a minute elsewhere."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    done = (BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(), TextColumn("{task.fields[rest]}"))
    started = monotonic()
    with _bar_or_lines(TextColumn("{task.description}"), *done) as (bar, say):
        task = bar.add_task("starting", total=1.0, rest="")

        def report(share: float, message: str) -> None:
            elapsed_s = monotonic() - started
            rest = time_left(elapsed_s * (1.0 / share - 1.0)) if share > 0.0 and elapsed_s > 2.0 else ""
            bar.update(task, completed=share, description=message, rest=rest)
            say(f"{share:.0%} {message} {rest}".rstrip())

        try:
            yield report
        except BaseException:
            bar.live.transient = True  # the error that follows stands alone
            raise
        bar.update(task, completed=1.0, description="done")


@contextmanager
def show_rate(unit: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show on stderr how many things are done, how many a minute, and the time left.

    A terminal has a bar, other output a line a minute, and one at the start and the end. Things that were done when it
    was first told do not count for the rate.

    Parameters
    ----------
    unit : str
        What the things are, in the plural.

    Yields
    ------
    callable
        To be called as ``report(done, total, message)``.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn(unit), TextColumn("{task.fields[pace]}"))
    with _bar_or_lines(*columns, TextColumn("{task.description}")) as (bar, say):
        task = bar.add_task("", total=None, pace="")
        first: tuple[int, float] | None = None

        def report(done: int, total: int, message: str) -> None:
            nonlocal first
            now, starting = monotonic(), first is None
            first = first or (done, now)
            pace = rate_and_rest(done - first[0], total - done, now - first[1])
            bar.update(task, completed=done, total=total, pace=pace, description=message)
            line = f"{done} of {total} {unit} {pace} {message}".replace("  ", " ")
            say(line, at_once=starting or done == total)

        yield report


@contextmanager
def _bar_or_lines(*columns: Any) -> Iterator[tuple[Any, Callable[..., None]]]:
    """Open a bar on stderr, and what says a line where there is no terminal: once a minute, or at once."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    said = monotonic()

    def say(line: str, *, at_once: bool = False) -> None:
        nonlocal said
        if not console.is_terminal and (at_once or monotonic() - said >= LINE_S):
            said = monotonic()
            typer.echo(line, err=True)

    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        yield bar, say


def rate_and_rest(done: int, rest: int, elapsed_s: float) -> str:
    """Return how many a minute were done, and how long the rest takes at that rate; "" where nothing was done."""
    if not done or elapsed_s <= 0.0:
        return ""
    return f"({60.0 * done / elapsed_s:.3g}/min, {time_left(rest * elapsed_s / done)})"


def time_left(rest_s: float) -> str:
    """Return a time [s] as hours, minutes and seconds that are left."""
    seconds = round(rest_s)
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02} left"


def print_files(files: Sequence[Path]) -> None:
    """Say which files were written."""
    for file in files:
        typer.echo(f"wrote {file}")
