"""Subcommands dataset, train and evaluate."""

import itertools
import shlex
from pathlib import Path
from typing import Annotated, cast

import typer

import sionna_partial as sp
import sionna_partial.cli.options as opt
from sionna_partial.constants import CARRIER_FREQUENCY_HZ
from sionna_partial.display import counting
from sionna_partial.lab.datasets.settings import SHORT_LINK_M, DatasetSettings
from sionna_partial.settings import HOME_KINDS, HomeKind, NetworkKind, PredictorSettings, SceneSettings, TraceSettings

DEFAULT_HOMES = 100
"""Default number of procedural homes."""

FIRST_SEED = 20_000
"""First seed, outside the training seeds of the shipped predictor (`make predictor`)."""

_DATASET_HELP = "Folder that `dataset` wrote, or several; homes may be in more than one."
_STAGE_HELP = "Steps, such as --stage 0 --stage 50, or fractions observed, such as 0 and 0.25."
_NETWORKS_HELP = "Its input: the paper's features, what each path crosses, and the map around the transmitter."

Datasets = Annotated[list[Path], typer.Argument(metavar="DATASET", help=_DATASET_HELP, show_default=False)]


@opt.with_options
def dataset(
    *,
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
    stages: Annotated[list[float], typer.Option("--stage", help=_STAGE_HELP)] = list(DatasetSettings.stages),  # noqa: B006
    seed: Annotated[int, typer.Option(help="Seed of positions and robots.")] = DatasetSettings.seed,
    sensor: opt.Sensor,
    mixed_sensors: Annotated[
        bool, typer.Option("--mixed-sensors", help="Draw a sensor for each home, in place of the options above.")
    ] = False,
    frequency: opt.Frequency = CARRIER_FREQUENCY_HZ,
    material: opt.MaterialText = "",
    cir_paths: Annotated[
        int, typer.Option(help="Also store impulse responses, of so many strongest paths of each link. 0: none.")
    ] = DatasetSettings.cir_paths,
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
    settings = DatasetSettings(
        links_per_home=links,
        transmitters_per_home=transmitters,
        stages=tuple(int(each) if each.is_integer() else each for each in sorted({*map(float, stages)})),
        seed=seed,
        sensor="mixed" if mixed_sensors else sensor,
        short_link_fraction=short_links,
        scene=SceneSettings(material=opt.parse_material(material) if material else None),
        trace=TraceSettings(frequency_hz=frequency),
        cir_paths=cir_paths,
    )
    count = homes if homes is not None else 0 if maps else DEFAULT_HOMES
    seeds = range(first_seed, first_seed + count)
    in_turn = itertools.cycle(cast("list[HomeKind]", kinds or []))
    sources = [*(zip(seeds, in_turn, strict=False) if kinds else seeds), *(maps or [])]
    with counting(None, "homes", command=True) as report:
        where = {"scheduler": scheduler, "workers": workers}
        result = sp.lab.build_dataset(out, sources, settings, home_time_limit_s=time_limit, progress=report, **where)  # type: ignore[arg-type]
    built = f"{len(result.built)} built in {result.elapsed_s / 60.0:.1f} min"
    typer.echo(f"homes in {result.folder}: {built}, {len(result.skipped)} already there")
    for name, error in result.failed.items():
        typer.echo(f"{name} failed: {error.splitlines()[0]}", err=True)
    if result.failed:
        reasons = f"the others can be used: {result.folder / 'failed'} has the reasons"
        typer.echo(f"homes that failed: {len(result.failed)}; {reasons}; the same command tries them again.", err=True)
    raise typer.Exit(1 if result.failed else 0)


def train(
    folders: Datasets,
    out: Annotated[Path, typer.Option(metavar="RUN", help="Folder for predictor and baselines.", show_default=False)],
    test_fraction: Annotated[float, typer.Option(help="Fraction of the homes that is kept for testing.")] = 0.3,
    networks: Annotated[NetworkKind, typer.Option(help=_NETWORKS_HELP)] = "map",
    passes: Annotated[
        int, typer.Option(help="Passes of all networks but the paper's over the links.")
    ] = PredictorSettings.passes,
    seed: Annotated[int, typer.Option(help="Seed of the split and of the training.")] = PredictorSettings.seed,
) -> None:
    """Train a predictor, and test it on other homes.

    RUN gets predictor.keras, which `predict --predictor` takes, baselines fitted to the same links, and the split of
    the homes.
    """
    with opt.reporting_to(out, "reading links") as report:
        from sionna_partial.lab.datasets.traces import open_links, settings_for
        from sionna_partial.lab.reports import summary

        links, traces = open_links(folders)
        settings = settings_for(traces, networks=networks, passes=passes, seed=seed)
        run = sp.lab.train(links, test_fraction=test_fraction, settings=settings, progress=report)
        files = run.save(out)
    typer.echo(summary(run.evaluation) if run.evaluation else "all homes were trained on: nothing was measured")
    opt.print_files(out, [file.name for file in files])
    if run.evaluation:
        command = f"sionna-partial evaluate {shlex.join(map(str, folders))}"
        typer.echo(f"all figures of merit: {command} --predictor {out / 'predictor.keras'} --out REPORT")


def evaluate(
    folders: Datasets,
    out: Annotated[Path, typer.Option(metavar="REPORT", help="Folder for the report.", show_default=False)],
    predictor: Annotated[str, typer.Option(metavar="NAME|FILE", help="'map', 'paper', or a .keras file.")] = "map",
) -> None:
    """Evaluate a predictor against baselines.

    REPORT gets all figures of merit with their definitions (report.md, report.json), and pictures. Homes of the data
    set that the predictor was not trained on are test homes.
    """
    with opt.reporting_to(out, "reading links") as report:
        from sionna_partial.lab.reports import REPORT_FILES, save_report, summary

        result = sp.lab.evaluate(predictor, folders, progress=report)
        save_report(result, out)
    typer.echo(summary(result))
    opt.print_files(out, REPORT_FILES)
