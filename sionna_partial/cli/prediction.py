"""Subcommands from a map to its coverage: predict, export-scene, explore, demo, info."""

from pathlib import Path
from typing import Annotated

import typer

import sionna_partial as sp
import sionna_partial.cli.options as opt
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, DEFAULT_HEIGHT_M, MEMORY_GB
from sionna_partial.files import atomic_files
from sionna_partial.progress import part_of
from sionna_partial.settings import Policy, SceneSettings

FORMATS = (".nc", ".tif", ".csv", ".png", ".html", ".yaml")
"""Formats of a coverage map."""

FRAMES = 50
"""About the number of frames in an animation."""


@opt.with_options
def predict(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the coverage files.", show_default=False)],
    tx: Annotated[
        str, typer.Option(metavar="X Y [Z]", help="Transmitter [m]; found from --measurements if not given.")
    ] = "",
    tx_antenna: opt.TxAntenna = "iso",
    azimuth: opt.Azimuth = 0.0,
    tilt: opt.Tilt = 0.0,
    rx_height: opt.RxHeight = DEFAULT_HEIGHT_M,
    spacing: Annotated[float, typer.Option(help="Distance between receivers [m].")] = 0.15,
    settings: opt.Settings,
    predictor: opt.PredictorName = "",
    measurements: opt.Measured = None,
    column: opt.Columns = None,
    receivers: Annotated[
        str, typer.Option(metavar="indoor|anywhere", help="Where receivers are; those outside are in outage.")
    ] = "indoor",
    partial: opt.PartialMap,
    memory: opt.Memory = MEMORY_GB,
    formats: Annotated[list[str], typer.Option("--format", help="Format; may be repeated.")] = list(FORMATS),  # noqa: B006
) -> None:
    """Predict the coverage of a transmitter on a partial map."""
    position, antenna = opt.parse_position(tx) if tx else None, opt.parse_antenna(tx_antenna, azimuth, tilt)
    suffixes = [_parse_format(name) for name in formats]
    with opt.reporting_to(out, "loading the predictor") as report:
        coverage = sp.predict_map(
            partial,
            position,
            tx_antenna=antenna,
            rx_height_m=rx_height,
            spacing_m=spacing,
            predictor=predictor or None,
            **settings,
            measurements=opt.read_measurements(measurements, column, position),
            receivers=receivers,
            memory_gb=memory,
            progress=part_of(report, 0.0, 0.9),
        )
        names = [f"coverage{suffix}" for suffix in dict.fromkeys(suffixes)]
        with atomic_files(out) as folder:
            for index, name in enumerate(names):
                report(0.9 + 0.1 * index / len(names), f"writing {name}")
                sp.save_coverage(coverage, folder / name)
    opt.print_files(out, names)


@opt.with_options
def export_scene(
    *,
    out: Annotated[Path, typer.Option(help="New or empty folder for the scene.", show_default=False)],
    material: opt.MaterialText = "",
    frequency: opt.Frequency = CARRIER_FREQUENCY_HZ,
    partial: opt.PartialMap,
) -> None:
    """Write a map as a scene folder that stock Sionna RT loads."""
    settings = SceneSettings(material=opt.parse_material(material))
    settings.material.require_frequency(frequency)
    scene = sp.export_scene(partial, out, settings, frequency_hz=frequency)
    opt.print_files(scene.parent, [scene.name])


@opt.with_options
def explore(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the maps.", show_default=False)],
    home: Annotated[Path | None, typer.Option(help="Map of a complete home. Default: one made from --seed.")] = None,
    steps: Annotated[list[int], typer.Option(help="Robot steps, such as --steps 9 --steps 99.")] = [50, 100, 150, 200],  # noqa: B006
    seed: Annotated[int, typer.Option(help="Seed of the robot, and of the home that is made.")] = 0,
    sensor: opt.Sensor,
    policy: Annotated[Policy, typer.Option(help="Choice of frontiers: at random, or for the coverage.")] = "random",
    tx: Annotated[
        str, typer.Option(metavar="X Y [Z]", help="Transmitter [m]: of the policy, and predicted in the animation.")
    ] = "",
    height_band: opt.HeightBand = None,
    up: opt.Up = None,
) -> None:
    """Explore a home with a robot, and write what it maps.

    The folder --out gets the partial maps, the complete one, a picture and an animation.
    """
    position = opt.parse_position(tx) if tx else None
    with opt.reporting_to(out, "reading the home" if home else "making a home") as report:
        complete = sp.load_map(home, height_band_m=height_band, up=up) if home else sp.make_home(seed)
        frames = range(0, max(steps) + 1, max(1, max(steps) // FRAMES))
        exploration = sp.explore_trajectory(
            complete,
            sorted({*steps, *frames}),
            seed,
            sensor=sensor,
            policy=policy,
            tx=position,
            progress=part_of(report, 0.1, 0.5),
        )
        asked, suffix = exploration.at(steps), complete.environment.suffixes[0]
        maps = {f"steps_{count:03d}{suffix}": partial for count, partial in zip(asked.steps, asked.maps, strict=True)}
        maps[f"complete{suffix}"] = complete
        with atomic_files(out) as folder:
            for name, partial in maps.items():
                sp.save_map(partial, folder / name)
            report(0.6, "drawing exploration.png")
            sp.plot_exploration(asked).savefig(folder / "exploration.png")
            report(0.7, "drawing exploration.gif")
            sp.animate_exploration(exploration, folder / "exploration.gif", position)
    opt.print_files(out, [*maps, "exploration.png", "exploration.gif"])


def demo(out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo-output")) -> None:
    """Predict a half-explored home, and compare with the truth."""
    with opt.reporting_to(out, "loading the predictor") as report:
        from sionna_partial.demo import run_demo

        files, table = run_demo(out, report)
    typer.echo(table)
    opt.print_files(out, files)


def info() -> None:
    """Report what is found, what is missing, and what to do."""
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


def _parse_format(name: str) -> str:
    suffix = "." + name.lower().lstrip(".")
    if suffix not in FORMATS:
        raise typer.BadParameter(f"--format {name!r} is not known: choose from {', '.join(FORMATS)}.")
    return suffix
