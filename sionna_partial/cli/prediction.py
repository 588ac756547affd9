"""Subcommands predict, network, channels, export-scene, explore, demo and info."""

import math
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

import sionna_partial as sp
import sionna_partial.cli.options as opt
from sionna_partial.checks import require_number
from sionna_partial.columns import read_columns
from sionna_partial.constants import (
    CARRIER_FREQUENCY_HZ,
    COST_THRESHOLD_DB,
    DEFAULT_HEIGHT_M,
    GAIN_FLOOR_DB,
    MEMORY_GB,
    CellState,
)
from sionna_partial.display import part_of
from sionna_partial.errors import PositionError
from sionna_partial.files import atomic_files
from sionna_partial.settings import Policy, SceneSettings

FORMATS = (".nc", ".tif", ".csv", ".png", ".html", ".yaml")

REPORT = ".pdf"
"""Format of the report, which is written on request."""

FRAMES = 50
"""Approximate number of frames of an animation."""

COLUMNS = (("x", "y", "z"), ("x_m", "y_m", "z_m"), ("rx_x", "rx_y", "rx_z"))
"""Accepted names for columns of positions."""

ROWS_BY_COLUMNS = "ROWSxCOLUMNS"

POWER_DBM, THRESHOLD_DBM = 20.0, -67.0
"""Default transmit power and required received power of Wi-Fi [dBm]."""

PICTURE = "coverage.png"


@opt.with_options
def predict(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the coverage files.", show_default=False)],
    tx: Annotated[
        str,
        typer.Option(metavar="X Y [Z]", help="Transmitter [m]; found from --measurements if not given."),
    ] = "",
    power: Annotated[
        float | None,
        typer.Option(
            help=f"Transmit power, for the covered floor that is printed [dBm]. Default: {POWER_DBM:g}.",
            show_default=False,
        ),
    ] = None,
    tx_antenna: opt.TxAntenna = "iso",
    azimuth: opt.Azimuth = 0.0,
    tilt: opt.Tilt = 0.0,
    threshold: Annotated[
        float | None,
        typer.Option(
            help=f"Received power that a receiver needs [dBm]. Default: {THRESHOLD_DBM:g}.", show_default=False
        ),
    ] = None,
    rx_height: opt.RxHeight = DEFAULT_HEIGHT_M,
    spacing: Annotated[float, typer.Option(help="Distance between receivers [m].")] = 0.15,
    settings: opt.Settings,
    predictor: opt.PredictorName = "",
    measurements: opt.Measured = None,
    column: opt.Columns = None,
    access_point: opt.AccessPoint = None,
    pixel: opt.Pixel = None,
    receivers: Annotated[
        str,
        typer.Option(
            metavar="indoor|anywhere|inside|near",
            help="Receivers; outdoors in outage or omitted (inside), or within 1 m of free cells (near).",
        ),
    ] = "indoor",
    partial: opt.PartialMap,
    memory: opt.Memory = MEMORY_GB,
    formats: Annotated[list[str], typer.Option("--format", help="Format; may be repeated.")] = list(FORMATS),  # noqa: B006
    logo: Annotated[
        Path | None, typer.Option(help="PNG or JPEG for the report (--format pdf).", show_default=False)
    ] = None,
) -> None:
    """Predict the coverage of a transmitter on a partial map."""
    position, antenna = opt.parse_position(tx) if tx else None, opt.parse_antenna(tx_antenna, azimuth, tilt)
    suffixes = [_parse_format(name) for name in formats]
    budget = _budget(power, threshold)
    if logo is not None and REPORT not in suffixes:
        raise typer.BadParameter("--logo is for the report: give --format pdf as well.")
    if logo is not None:
        from sionna_partial.plots.logo import read_logo

        read_logo(logo)  # a wrong one is refused before the prediction
    with opt.reporting_to(out, "loading the predictor") as report:
        coverage = sp.predict_map(
            partial,
            position,
            tx_antenna=antenna,
            rx_height_m=rx_height,
            spacing_m=spacing,
            predictor=predictor or None,
            **settings,
            measurements=opt.read_measurements(measurements, column, position, access_point, pixel),
            receivers=receivers,
            memory_gb=memory,
            progress=part_of(report, 0.0, 0.9),
        )
        names = [f"coverage{suffix}" for suffix in dict.fromkeys(suffixes)]
        with atomic_files(out) as folder:
            for index, name in enumerate(names):
                report(0.9 + 0.1 * index / len(names), f"writing {name}")
                _write(coverage, folder / name, partial, budget, logo)
    if "wall_material" in coverage.attrs:
        typer.echo(f"walls: {coverage.attrs['wall_material']}, mean loss {coverage.attrs['wall_loss_db']:.1f} dB")
    opt.print_files(out, names)
    if budget:
        typer.echo(_covered(coverage, budget) + (f"; open {out / PICTURE}" if PICTURE in names else ""))


def _write(coverage: Any, path: Path, partial: Any, budget: "_Budget | None", logo: Path | None) -> None:
    """Write one file of a coverage map."""
    from sionna_partial.plots.report import report_pdf
    from sionna_partial.plots.style import figure_png

    if path.suffix == REPORT:
        power_dbm, threshold_dbm = budget or (POWER_DBM, THRESHOLD_DBM)
        content = report_pdf(coverage, eirp_dbm=power_dbm, threshold_dbm=threshold_dbm, scene=partial, logo=logo)
        path.write_bytes(content)
    elif path.name == PICTURE and budget:
        path.write_bytes(figure_png(sp.plots.plot_coverage(coverage, threshold_db=budget.gain_db)))
    else:
        sp.save_coverage(coverage, path, scene=partial, threshold_db=budget.gain_db if budget else COST_THRESHOLD_DB)


class _Budget(NamedTuple):
    """Transmit power and required received power [dBm]."""

    power_dbm: float
    threshold_dbm: float

    @property
    def gain_db(self) -> float:
        """Return the required path gain [dB]."""
        return min(max(self.threshold_dbm - self.power_dbm, GAIN_FLOOR_DB), 0.0)


def _budget(power: float | None, threshold: float | None) -> _Budget | None:
    """Return the budget with defaults; None without arguments."""
    for name, value in (("--power", power), ("--threshold", threshold)):
        if value is not None:
            require_number(name, value, -200.0, 200.0)
    if power is None and threshold is None:
        return None
    return _Budget(POWER_DBM if power is None else power, THRESHOLD_DBM if threshold is None else threshold)


def _covered(coverage: Any, budget: _Budget) -> str:
    """Return lines with the covered fractions of the rooms, the last one for the floor."""
    area = coverage.radio.area(budget.threshold_dbm, eirp_dbm=budget.power_dbm)
    rows = zip(area.floor.values, area.fraction.values, strict=True)
    parts = [(name, "none" if math.isnan(fraction) else f"{100 * fraction:.0f} %") for name, fraction in rows]
    (_, observed), (_, every), *rooms = parts
    what = f"above {area.threshold_dbm:g} dBm with probability {area.probability:g}"
    text = f"{observed} of the observed floor, {every} of all, {what}, at {budget.power_dbm:g} dBm"
    listed = ", ".join(f"{name.replace('_', ' ')} {fraction}" for name, fraction in rooms)
    return f"by room: {listed}\n{text}" if listed else text


@opt.with_options
def export_scene(
    *,
    out: Annotated[Path, typer.Option(help="New or empty folder for the scene.", show_default=False)],
    material: opt.MaterialText = "",
    frequency: opt.Frequency = CARRIER_FREQUENCY_HZ,
    partial: opt.PartialMap,
) -> None:
    """Write a map as a scene folder that stock Sionna RT loads."""
    settings = SceneSettings(material=opt.parse_material(material) if material else None)
    settings.traced_material.require_frequency(frequency)
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
            sp.plots.plot_exploration(asked).savefig(folder / "exploration.png")
            report(0.7, "drawing exploration.gif")
            sp.plots.animate_exploration(exploration, folder / "exploration.gif", position)
    opt.print_files(out, [*maps, "exploration.png", "exploration.gif"])


def demo(out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo-output")) -> None:
    """Predict a half-explored home, and compare with the truth."""
    with opt.reporting_to(out, "loading the predictor") as report:
        from sionna_partial.demo import run_demo

        files, table = run_demo(out, report)
    typer.echo(table)
    opt.print_files(out, files)


@opt.with_options
def info(*, partial: opt.PartialMapIfGiven) -> None:
    """Report how a map was read; without a map, what is installed, what is missing, and what to do."""
    if partial is not None:
        typer.echo(str(partial.import_report))
        return
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
    if suffix not in (*FORMATS, REPORT):
        raise typer.BadParameter(f"--format {name!r} is not known: choose from {', '.join((*FORMATS, REPORT))}.")
    return suffix


@opt.with_options
def network(
    *,
    tx: Annotated[
        list[str],
        typer.Option(metavar="X Y [Z]", help="Transmitter [m]; once for each.", show_default=False),
    ],
    out: Annotated[Path, typer.Option(help="Folder for coverage, network and picture.", show_default=False)],
    tx_power: Annotated[
        list[float], typer.Option(help="Transmit power [dBm]; once for all, or once for each.", show_default="20")
    ] = [20.0],  # noqa: B006
    tx_antenna: Annotated[
        list[str],
        typer.Option(
            metavar="PATTERN|FILE", help="As for predict; once for all, or once for each.", show_default="iso"
        ),
    ] = ["iso"],  # noqa: B006
    azimuth: Annotated[
        list[float], typer.Option(help="Of the antennas, counterclockwise from x [degree].", show_default="0")
    ] = [0.0],  # noqa: B006
    tilt: Annotated[
        list[float], typer.Option(help="Of the antennas, below the horizon [degree].", show_default="0")
    ] = [0.0],  # noqa: B006
    noise_figure: Annotated[float, typer.Option(help="Of the receivers [dB].")] = 7.0,
    bandwidth: Annotated[float, typer.Option(help="Bandwidth [Hz].")] = 100e6,
    load: Annotated[float, typer.Option(help="Fraction of time in which an interferer transmits.")] = 1.0,
    sinr_threshold: Annotated[float, typer.Option(help="SINR that a receiver needs [dB].")] = 0.0,
    channel: Annotated[
        list[str],
        typer.Option(
            help="A channel that there is, to propose a plan; or tx1=CHANNEL for each. Default: all share one.",
            show_default=False,
        ),
    ] = [],  # noqa: B006
    standard: Annotated[
        str, typer.Option(metavar="wifi6|wifi7|nr", help="Standard of the rate. Default: Shannon's bound.")
    ] = "",
    spacing: Annotated[float, typer.Option(help="Distance between receivers [m].")] = 0.25,
    rx_height: opt.RxHeight = DEFAULT_HEIGHT_M,
    settings: opt.Settings,
    predictor: opt.PredictorName = "",
    partial: opt.PartialMap,
    memory: opt.Memory = MEMORY_GB,
) -> None:
    """Predict best server, SINR and rate of several transmitters on a partial map."""
    from sionna_partial.coverage.link_budget import LinkBudget, transmit_powers_dbm

    positions = [(*opt.parse_position(each), DEFAULT_HEIGHT_M)[:3] for each in tx]
    powers_dbm = transmit_powers_dbm(tx_power[0] if len(tx_power) == 1 else tx_power, len(positions))
    antennas = [
        opt.parse_antenna(*each)
        for each in zip(*(opt.for_each(values, len(positions)) for values in (tx_antenna, azimuth, tilt)), strict=True)
    ]
    budget = LinkBudget(noise_figure, bandwidth, load, sinr_threshold)
    with opt.reporting_to(out, "loading the predictor") as report:
        coverage = sp.predict_map(
            partial,
            positions,
            tx_antenna=antennas,
            rx_height_m=rx_height,
            spacing_m=spacing,
            predictor=predictor or None,
            **settings,
            memory_gb=memory,
            progress=part_of(report, 0.0, 0.8),
        )
        report(0.8, "drawing links together")
        given = asdict(budget) | {"channels": _parse_channels(channel), "standard": standard or None}
        found = sp.predict_network(coverage, tx_power_dbm=powers_dbm, **given)
        with atomic_files(out) as folder:
            report(0.9, "writing")
            for name in ("coverage.nc", "coverage.html"):
                sp.save_coverage(coverage, folder / name)
            sp.save_network(found, folder / "network.nc")
            sp.plots.plot_network(found).savefig(folder / "network.png")
    if channel:
        typer.echo(", ".join(f"{name}: channel {found.channel.sel(tx=name).item()}" for name in found["tx"].to_numpy()))
    opt.print_files(out, ["coverage.nc", "coverage.html", "network.nc", "network.png"])


def _parse_channels(texts: list[str]) -> dict[str, str] | list[str] | None:
    pairs = [text.partition("=") for text in texts]
    if any(found for _, found, _ in pairs):
        return {name: channel for name, _, channel in pairs}
    return texts or None


@opt.with_options
def channels(
    *,
    tx: Annotated[
        str, typer.Option(metavar="X Y [Z]", help="Transmitter [m], 1.5 m high without Z.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="A .nc or .h5 file, or a new .zarr folder.", show_default=False)],
    rx: Annotated[
        str, typer.Option(metavar="grid|CSV", help="Receivers: all free space, or a file with columns x,y,z [m].")
    ] = "grid",
    spacing: Annotated[float, typer.Option(help="Distance between receivers of the grid [m].")] = 0.5,
    rx_height: opt.RxHeight = DEFAULT_HEIGHT_M,
    array: Annotated[str, typer.Option(metavar=ROWS_BY_COLUMNS, help="Antennas of the transmitter.")] = "1x1",
    rx_array: Annotated[str, typer.Option(metavar=ROWS_BY_COLUMNS, help="Antennas of the receivers.")] = "1x1",
    pattern: Annotated[
        str, typer.Option(metavar="NAME", help="Pattern of the transmitter's: iso, dipole, hw_dipole, tr38901.")
    ] = "iso",
    polarization: Annotated[str, typer.Option(metavar="V|H|VH|cross", help="Polarisation of all antennas.")] = "V",
    orientation: Annotated[
        tuple[float, float, float], typer.Option(metavar="A B C", help="Of the transmitter, about z, y, x [rad].")
    ] = (0.0, 0.0, 0.0),
    layout: Annotated[str, typer.Option(metavar="sionna|deepmimo", help="Axes of the arrays.")] = "sionna",
    settings: opt.Settings,
    partial: opt.PartialMap,
    memory: opt.Memory = MEMORY_GB,
) -> None:
    """Trace a map, and write the channel impulse responses between antenna arrays."""
    position = (*opt.parse_position(tx), DEFAULT_HEIGHT_M)[:3]
    shapes = [_parse_shape(name, text) for name, text in (("array", array), ("rx-array", rx_array))]
    with opt.reporting_to(out.parent, "loading Sionna RT") as report:
        from sionna_partial.channels.files import checked_target
        from sionna_partial.tracing.antennas import planar_array
        from sionna_partial.tracing.positions import valid_links

        checked_target(out, layout)
        arrays = [
            planar_array(*shape, pattern=each, polarization=polarization)
            for shape, each in zip(shapes, (pattern, "iso"), strict=True)
        ]
        if rx == "grid":
            grid_m = _free_grid(partial, spacing, rx_height)
            receivers_m = grid_m[valid_links(partial, position, grid_m, settings["trace_settings"].frequency_hz)[2][0]]
        else:
            receivers_m = _read_positions(Path(rx))
        settings["trace_settings"] = replace(settings["trace_settings"], power_tolerance_db=0.0)
        links = sp.trace_links(
            partial, position, receivers_m, **settings, memory_gb=memory, progress=part_of(report, 0.0, 0.5)
        )
        sp.channels.save_channels(
            links,
            out,
            layout=layout,  # type: ignore[arg-type]
            progress=part_of(report, 0.5, 1.0),
            tx_array=arrays[0],
            rx_array=arrays[1],
            tx_orientation_rad=orientation,
        )
    typer.echo(f"{len(receivers_m)} receivers, {len(links.a)} paths")
    opt.print_files(out.parent, [out.name])


def _parse_shape(name: str, text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    if not found:
        raise typer.BadParameter(f"--{name} {text!r} is no array: give rows and columns, such as 8x8.")
    return int(found[1]), int(found[2])


def _free_grid(partial: Any, spacing_m: float, height_m: float) -> Any:
    import numpy as np

    from sionna_partial.coverage.grid import grid_axes

    x_m, y_m = np.meshgrid(*grid_axes(partial, spacing_m))
    grid_m = np.column_stack([x_m.ravel(), y_m.ravel(), np.full(x_m.size, height_m)])
    return grid_m[partial.state_at(grid_m) == CellState.FREE]


def _read_positions(path: Path) -> list[tuple[float, ...]]:
    remedy = "give a CSV with the columns x,y,z in metres."
    found = read_columns(path, "--rx", PositionError, {name: name for name in sum(COLUMNS, ())}, remedy).numbers
    names = next((names for names in COLUMNS if found.keys() >= {*names}), None)
    if names is None:
        raise PositionError(f"--rx = '{path}' has no positions: {remedy}")
    return [*zip(*(found[name] for name in names), strict=True)]
