"""Command line: one subcommand for each arrow from a map to its coverage."""

import itertools
import logging
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from sionna_partial import __version__
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, DEFAULT_HEIGHT_M
from sionna_partial.errors import SionnaPartialError
from sionna_partial.files import atomic_files, require_writable
from sionna_partial.settings import Material, SceneSettings, TraceSettings

FORMATS = (".nc", ".tif", ".csv", ".png", ".yaml")
"""Formats of a coverage map."""


class _ErrorLineGroup(TyperGroup):
    """Reports an error that is the user's to mend in one line, with exit code 2."""

    def invoke(self, ctx: Any) -> Any:
        """Run the subcommand."""
        try:
            return super().invoke(ctx)
        except SionnaPartialError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(2) from None


class _TransmitterCommand(TyperCommand):
    """Takes `--tx X Y` and `--tx X Y Z`: an option with two or three values."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the numbers after --tx to one value."""
        return super().parse_args(ctx, join_numbers(args, "--tx"))


class _WarningLine(logging.Handler):
    """Writes warnings as one line each."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record to stderr as it is now."""
        typer.echo(f"{record.levelname.lower()}: {record.getMessage()}", err=True)


app = typer.Typer(
    cls=_ErrorLineGroup,
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

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
FrequencyOption = Annotated[float, typer.Option(help="Carrier frequency [Hz].")]


def main() -> None:
    """Run the command line (entry point `sionna-partial`)."""
    app(prog_name="sionna-partial")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _prepare(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Predict radio coverage from a robot's partial map."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    logging.getLogger("sionna_partial").addHandler(_WarningLine(logging.WARNING))
    warnings.showwarning = lambda message, *_, **__: typer.echo(f"warning: {message}", err=True)


@app.command(cls=_TransmitterCommand)
def predict(
    map_path: MapArgument,
    tx: Annotated[
        str, typer.Option(metavar="X Y [Z]", help="Transmitter [m], 1.5 m high without Z.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="Folder for the coverage files.", show_default=False)],
    rx_height: Annotated[float, typer.Option(help="Height of the receivers [m].")] = DEFAULT_HEIGHT_M,
    spacing: Annotated[float, typer.Option(help="Distance between receivers [m].")] = 0.15,
    frequency: FrequencyOption = CARRIER_FREQUENCY_HZ,
    material: MaterialOption = "",
    max_depth: Annotated[int, typer.Option(help="Largest number of interactions on a path.")] = 6,
    predictor: Annotated[str, typer.Option(help="'paper', or a .keras file. Default: the shipped one.")] = "",
    strict: StrictOption = False,
    height_band: HeightBandOption = None,
    up: UpOption = None,
    formats: Annotated[list[str], typer.Option("--format", help="Format; may be repeated.")] = list(FORMATS),  # noqa: B006
) -> None:
    """Predict the coverage of a transmitter on a partial map."""
    position = parse_position(tx)
    suffixes = [_parse_format(name) for name in formats]
    scene_settings = SceneSettings(material=parse_material(material))
    trace_settings = TraceSettings(frequency_hz=frequency, max_depth=max_depth)
    from sionna_partial.maps.map_files import load_map

    partial = load_map(map_path, strict=strict, height_band_m=height_band, up=up)
    require_writable(out)
    with _progress() as report:
        report(0.0, "loading the predictor")
        from sionna_partial.coverage import predict_map
        from sionna_partial.export import save_coverage

        coverage = predict_map(
            partial,
            position,
            rx_height_m=rx_height,
            spacing_m=spacing,
            predictor=predictor or None,
            scene_settings=scene_settings,
            trace_settings=trace_settings,
            progress=lambda share, message: report(0.9 * share, message),
        )
        names = [f"coverage{suffix}" for suffix in dict.fromkeys(suffixes)]
        with atomic_files(out) as folder:
            for index, name in enumerate(names):
                report(0.9 + 0.1 * index / len(names), f"writing {name}")
                save_coverage(coverage, folder / name)
    _print_files([out / name for name in names])


@app.command("export-scene")
def export_scene_command(
    map_path: MapArgument,
    out: Annotated[Path, typer.Option(help="New or empty folder for the scene.", show_default=False)],
    material: MaterialOption = "",
    frequency: FrequencyOption = CARRIER_FREQUENCY_HZ,
    strict: StrictOption = False,
    height_band: HeightBandOption = None,
    up: UpOption = None,
) -> None:
    """Write a map as a scene folder that stock Sionna RT loads."""
    settings = SceneSettings(material=parse_material(material))
    settings.material.require_frequency(frequency)
    from sionna_partial.maps.map_files import load_map
    from sionna_partial.tracing.scene import export_scene

    partial = load_map(map_path, strict=strict, height_band_m=height_band, up=up)
    scene = export_scene(partial, out, settings, frequency_hz=frequency)
    _print_files([scene])


@app.command()
def explore(
    out: Annotated[Path, typer.Option(help="Folder for the maps.", show_default=False)],
    home: Annotated[Path | None, typer.Option(help="Map of a complete home. Default: one made from --seed.")] = None,
    steps: Annotated[list[int], typer.Option(help="Robot steps; may be repeated.")] = [50, 100, 150, 200],  # noqa: B006
    seed: Annotated[int, typer.Option(help="Seed of the home and of the robot.")] = 0,
    height_band: HeightBandOption = None,
    up: UpOption = None,
) -> None:
    """Explore a home with a robot, and write its partial maps."""
    from sionna_partial.maps.explore import explore as explore_home
    from sionna_partial.maps.homes import make_home
    from sionna_partial.maps.map_files import load_map, save_map

    complete = load_map(home, height_band_m=height_band, up=up) if home else make_home(seed)
    suffix = ".yaml" if complete.mesh is None else ".npz"
    maps = {f"steps_{count:03d}{suffix}": partial for count, partial in _by_steps(explore_home, complete, steps, seed)}
    maps[f"complete{suffix}"] = complete
    for name, partial in maps.items():
        save_map(partial, out / name)
    _print_files([out / name for name in maps])


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo-output"),
) -> None:
    """Predict a half-explored home, and compare with the truth."""
    require_writable(out)
    with _progress() as report:
        report(0.0, "loading the predictor")
        from sionna_partial.demo import run_demo

        result = run_demo(out, report)
    typer.echo(result.table)
    _print_files(list(result.files.values()))


@app.command()
def info() -> None:
    """Say what is found, what is missing, and what to do."""
    from rich.console import Console
    from rich.table import Column, Table

    from sionna_partial.info import findings

    table = Table("", Column("found", overflow="fold"), Column("what to do", overflow="fold"))
    usable = True
    for finding in findings():
        table.add_row(finding.name, finding.value, finding.remedy or "-")
        usable = usable and not finding.remedy
    Console().print(table)
    raise typer.Exit(0 if usable else 1)


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


def _parse_format(name: str) -> str:
    suffix = "." + name.lower().lstrip(".")
    if suffix not in FORMATS:
        raise typer.BadParameter(f"--format {name!r} is not known: choose from {', '.join(FORMATS)}.")
    return suffix


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _by_steps(
    explore_home: Callable[..., list[Any]], home: Any, steps: Sequence[int], seed: int
) -> Iterator[tuple[int, Any]]:
    return zip(steps, explore_home(home, steps=tuple(steps), seed=seed), strict=True)


@contextmanager
def _progress() -> Iterator[Callable[[float, str], None]]:
    """Show progress on stderr: a bar on a terminal, its last state elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("starting", total=1.0)
        try:
            yield lambda share, message: bar.update(task, completed=share, description=message)
        except BaseException:
            bar.live.transient, console.quiet = True, not console.is_terminal  # the error that follows stands alone
            raise
        bar.update(task, completed=1.0, description="done")


def _print_files(files: Sequence[Path]) -> None:
    for file in files:
        typer.echo(f"wrote {file}")
