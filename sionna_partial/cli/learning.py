"""Subcommands of learning: dataset, train, evaluate."""

import itertools
import shlex
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from sionna_partial.cli.shell import (
    DriftOption,
    FieldOfViewOption,
    FrequencyOption,
    MaterialOption,
    MissedWallsOption,
    RangeNoiseOption,
    RangeOption,
    parse_material,
    print_files,
    show_progress,
    show_rate,
)
from sionna_partial.constants import CARRIER_FREQUENCY_HZ
from sionna_partial.files import require_writable
from sionna_partial.settings import (
    HOME_KINDS,
    SHORT_LINK_M,
    DatasetSettings,
    HomeKind,
    NetworkKind,
    PredictorSettings,
    SceneSettings,
    SensorSettings,
    TraceSettings,
)

DatasetsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="DATASET",
        help="Folder that `dataset` wrote, or several; homes may be in more than one.",
        show_default=False,
    ),
]


DEFAULT_HOMES = 100
"""Number of homes that are made where no map is given."""

FIRST_SEED = 20_000
"""Seed of the first of them: not one of those that the shipped predictor was trained on (`make predictor`)."""


def dataset(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the data set.", show_default=False)],
    homes: Annotated[
        int | None, typer.Option(min=0, help=f"Homes to make. Default: {DEFAULT_HOMES}, or 0 with --map.")
    ] = None,
    first_seed: Annotated[int, typer.Option(min=0, help="Seed of the first of them.")] = FIRST_SEED,
    kinds: Annotated[
        list[str] | None,
        typer.Option("--kind", help=f"Kinds to make in turn: {', '.join(HOME_KINDS)}. Default: drawn.", metavar="KIND"),
    ] = None,
    maps: Annotated[
        list[Path] | None,
        typer.Option("--map", help="Complete map, or a folder of maps; may be repeated.", show_default=False),
    ] = None,
    links: Annotated[
        int, typer.Option(help="Links of a home with receivers indoors; as many more have them anywhere.")
    ] = DatasetSettings.links_per_home,
    short_links: Annotated[
        float, typer.Option(help=f"Fraction of the links that are drawn shorter than {SHORT_LINK_M:g} m [1].")
    ] = DatasetSettings.short_link_fraction,
    transmitters: Annotated[int, typer.Option(help="Transmitters of a home.")] = DatasetSettings.transmitters_per_home,
    stages: Annotated[
        list[float],
        typer.Option("--stage", help="Steps, such as --stage 0 --stage 50, or fractions observed, such as 0 and 0.25."),
    ] = list(DatasetSettings.stages),  # noqa: B006
    seed: Annotated[int, typer.Option(help="Seed of places and robots.")] = DatasetSettings.seed,
    field_of_view: FieldOfViewOption = SensorSettings.field_of_view_deg,
    range_m: RangeOption = SensorSettings.range_m,
    range_noise: RangeNoiseOption = SensorSettings.range_noise_m,
    drift: DriftOption = SensorSettings.drift_m_per_m,
    missed_walls: MissedWallsOption = SensorSettings.missed_wall_fraction,
    mixed_sensors: Annotated[
        bool, typer.Option("--mixed-sensors", help="Draw a sensor for each home, in place of the five options above.")
    ] = False,
    frequency: FrequencyOption = CARRIER_FREQUENCY_HZ,
    material: MaterialOption = "",
    workers: Annotated[
        int | None, typer.Option(help="Homes at a time on this machine. Default: one for each core.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address or scheduler file of a dask cluster, whose workers see OUT.", metavar="ADDRESS|FILE"
        ),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Time that a home may take [s].")] = 900.0,
) -> None:
    """Build a data set from homes, or go on with it.

    OUT gets the links of each home. Stop it at any time, and give the same command, or one with more homes, again.
    """
    sensor = SensorSettings(range_noise, drift, missed_walls, field_of_view, range_m)
    settings = DatasetSettings(
        links_per_home=links,
        transmitters_per_home=transmitters,
        stages=tuple(int(each) if each.is_integer() else each for each in sorted({*map(float, stages)})),
        seed=seed,
        sensor="mixed" if mixed_sensors else sensor,
        short_link_fraction=short_links,
        scene=SceneSettings(material=parse_material(material)),
        trace=TraceSettings(frequency_hz=frequency),
    )
    count = homes if homes is not None else 0 if maps else DEFAULT_HOMES
    seeds = range(first_seed, first_seed + count)
    in_turn = itertools.cycle(cast("list[HomeKind]", kinds or []))
    with show_rate("homes") as report:
        from sionna_partial.datasets.dataset import build_dataset

        result = build_dataset(
            out,
            [*(zip(seeds, in_turn, strict=False) if kinds else seeds), *(maps or [])],
            settings,
            scheduler=scheduler,
            workers=workers,
            home_time_limit_s=time_limit,
            progress=report,
        )
    _say_what_was_done(result)
    raise typer.Exit(1 if result.failed else 0)


def train(
    folders: DatasetsArgument,
    out: Annotated[Path, typer.Option(metavar="RUN", help="Folder for predictor and baselines.", show_default=False)],
    test_fraction: Annotated[float, typer.Option(help="Fraction of the homes that is kept for testing.")] = 0.3,
    networks: Annotated[
        NetworkKind,
        typer.Option(help="What it sees: the paper's features, what each path crosses, and the map around."),
    ] = "map",
    passes: Annotated[
        int, typer.Option(help="How many times the networks beside the paper's see the links.")
    ] = PredictorSettings.passes,
    seed: Annotated[int, typer.Option(help="Seed of the split and of the training.")] = PredictorSettings.seed,
) -> None:
    """Train a predictor, and test it on other homes.

    RUN gets predictor.keras, which `predict --predictor` takes, simpler answers fitted to the same links, and the split
    of the homes.
    """
    require_writable(out)
    with show_progress() as report:
        report(0.0, "reading links")
        from sionna_partial.datasets.dataset_links import open_links, settings_for
        from sionna_partial.reports import summary
        from sionna_partial.training import PREDICTOR_FILE
        from sionna_partial.training import train as train_predictor

        links, traces = open_links(folders)
        settings = settings_for(traces, networks=networks, passes=passes, seed=seed)
        run = train_predictor(links, test_fraction=test_fraction, settings=settings, progress=report)
        files = run.save(out)
    typer.echo(summary(run.evaluation) if run.evaluation else "all homes were trained on: nothing was measured")
    print_files(files)
    if run.evaluation:
        typer.echo(
            f"all figures of merit: sionna-partial evaluate {shlex.join(map(str, folders))} "
            f"--predictor {out / PREDICTOR_FILE} --out REPORT"
        )


def evaluate(
    folders: DatasetsArgument,
    out: Annotated[Path, typer.Option(metavar="REPORT", help="Folder for the report.", show_default=False)],
    predictor: Annotated[str, typer.Option(metavar="NAME|FILE", help="'map', 'paper', or a .keras file.")] = "map",
) -> None:
    """Judge a predictor beside simpler answers.

    REPORT gets all figures of merit with their definitions (report.md, report.json), and pictures. Homes of the data
    set that the predictor was not trained on are test homes.
    """
    require_writable(out)
    with show_progress() as report:
        report(0.0, "reading links")
        from sionna_partial.evaluation.evaluate import evaluate as evaluate_predictor
        from sionna_partial.reports import save_report, summary

        result = evaluate_predictor(predictor, folders, progress=report)
        files = save_report(result, out)
    typer.echo(summary(result))
    print_files(files)


def _say_what_was_done(result: Any) -> None:
    """Print what was built, and which homes are missing and why."""
    minutes = result.elapsed_s / 60.0
    typer.echo(
        f"homes in {result.folder}: {len(result.built)} built in {minutes:.1f} min, {len(result.skipped)} already there"
    )
    for name, error in result.failed.items():
        typer.echo(f"{name} failed: {error.splitlines()[0]}", err=True)
    if result.failed:
        typer.echo(
            f"homes that failed: {len(result.failed)}; the others can be used: {result.folder / 'failed'} says why; "
            "the same command tries them again.",
            err=True,
        )
