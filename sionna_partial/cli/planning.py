"""Subcommands that fit a material or a transmitter position, or plan a robot's route: calibrate, place, next."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

import sionna_partial as sp
import sionna_partial.cli.options as opt
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, DEFAULT_HEIGHT_M
from sionna_partial.files import CALIBRATED_FILE, atomic_files
from sionna_partial.settings import Objective, SensorSettings

TABLE_ANGLES_DEG = (0.0, 30.0, 45.0, 60.0)
"""Angles of incidence of the printed losses [degrees]."""

_CSV_HELP = "Columns tx_x,tx_y,tx_z,rx_x,rx_y,rx_z [m], gain_db [dB]."
_OBJECTIVE_HELP = "Mean predicted coverage, or the gain of the worst tenth of the receivers."


@opt.with_options
def calibrate(
    *,
    measurements: Annotated[Path, typer.Option(metavar="CSV", help=_CSV_HELP, show_default=False)],
    out: Annotated[
        Path, typer.Option(help="Folder for the calibrated map, the numbers and a picture.", show_default=False)
    ],
    column: opt.Columns = None,
    material: opt.MaterialText = "",
    frequency: opt.Frequency = CARRIER_FREQUENCY_HZ,
    max_depth: opt.MaxDepth = 6,
    diffraction: opt.Diffraction = True,
    through_walls: opt.ThroughWalls = None,
    partial: opt.PartialMap,
) -> None:
    """Find the material of a building from measured path gains.

    The folder --out gets the map with the calibrated material, the numbers as JSON, and a picture. predict takes the
    folder as a map.
    """
    settings = opt.settings_of(frequency, material, max_depth, diffraction, through_walls)
    measured = opt.read_measurements(measurements, column)
    with opt.reporting_to(out, "loading Sionna RT") as report:
        result = sp.calibrate_materials(
            partial,
            measured,
            start=settings["scene_settings"].material if material else None,
            **settings,
            progress=report,
        )
        with atomic_files(out) as folder:
            sp.save_map(result.scene, folder / CALIBRATED_FILE)
            (folder / "calibration.json").write_text(json.dumps(result.record(), indent=1) + "\n", encoding="utf-8")
            sp.plot_calibration(result).savefig(folder / "calibration.png")
    typer.echo(_table(result))
    opt.print_files(out, [CALIBRATED_FILE, "calibration.json", "calibration.png"])


@opt.with_options
def place(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the numbers and a picture.", show_default=False)],
    count: Annotated[int, typer.Option(help="Number of transmitters; several are placed for the coverage.")] = 1,
    objective: Annotated[Objective, typer.Option(help=_OBJECTIVE_HELP)] = "coverage",
    threshold: Annotated[float, typer.Option(help="Path gain above which a receiver is covered [dB].")] = -100.0,
    height: Annotated[float, typer.Option(help="Height of the transmitter [m].")] = DEFAULT_HEIGHT_M,
    rx_height: opt.RxHeight = DEFAULT_HEIGHT_M,
    seed: Annotated[int, typer.Option(help="Seed of the positions that are compared.")] = 0,
    settings: opt.Settings,
    predictor: opt.PredictorName = "",
    partial: opt.PartialMap,
) -> None:
    """Find good positions for one transmitter or several on a partial map.

    The folder --out gets the positions and the search as JSON, and a picture.
    """
    if count > 1 and objective != "coverage":
        raise typer.BadParameter(f"--objective {objective} is for one transmitter: leave it out with --count {count}.")
    options: dict[str, Any] = {"threshold_db": threshold, "tx_height_m": height, "rx_height_m": rx_height, "seed": seed}
    options |= {"predictor": predictor or None, **settings}
    result: sp.TransmitterPlacement | sp.NetworkPlacement
    with opt.reporting_to(out, "loading the predictor") as report:
        if count == 1:
            result = sp.place_transmitter(partial, objective=objective, **options, progress=report)
            positions_m, figure = [result.position_m], sp.plot_placement(result)
        else:
            result = sp.place_transmitters(partial, count, **options, progress=report)
            positions_m, figure = [*result.positions_m], sp.plot_network_placement(result)
        with atomic_files(out) as folder:
            result.save(folder / "placement.json")
            figure.savefig(folder / "placement.png")
    for x, y, z in positions_m:
        typer.echo(f"transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m")
    if objective == "coverage":
        typer.echo(f"{result.score:.1%} of the receivers are predicted above {threshold:g} dB")
    else:
        typer.echo(f"the worst tenth of the receivers is predicted at {result.score:.1f} dB")
    opt.print_files(out, ["placement.json", "placement.png"])


@opt.with_options
def next_views(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the poses and a picture.", show_default=False)],
    tx: Annotated[
        str,
        typer.Option(metavar="X Y [Z]", help="Transmitter [m]. Default: that of the measurements, or any."),
    ] = "",
    measurements: opt.Measured = None,
    column: opt.Columns = None,
    access_point: opt.AccessPoint = None,
    goal: Annotated[str, typer.Option(metavar="coverage|state|area", help="What is to become known.")] = "coverage",
    count: Annotated[int, typer.Option(help="Largest number of poses.")] = 5,
    start: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="Where the robot is [m]. Default: amid the free cells.", show_default=False),
    ] = None,
    threshold: Annotated[float, typer.Option(help="Path gain above which a receiver is covered [dB].")] = -100.0,
    field_of_view: opt.FieldOfView = SensorSettings.field_of_view_deg,
    range_m: opt.Range = SensorSettings.range_m,
    settings: opt.Settings,
    predictor: opt.PredictorName = "",
    partial: opt.PartialMap,
) -> None:
    """Rank poses where a robot learns most about the coverage per metre driven.

    The folder --out gets the poses as YAML, as in a geometry_msgs/PoseArray, and a picture.
    """
    position = opt.parse_position(tx) if tx else None
    with opt.reporting_to(out, "predicting"):
        views = sp.next_views(
            partial,
            position,
            opt.read_measurements(measurements, column, position, access_point),
            goal,
            count,
            start=start,
            threshold_db=threshold,
            sensor=SensorSettings(field_of_view_deg=field_of_view, range_m=range_m),
            predictor=predictor or None,
            **settings,
        )
        with atomic_files(out) as folder:
            views.save(folder / "next_views.yaml")
            sp.plot_next_views(views).savefig(folder / "next_views.png")
    unit = "m2" if goal == "area" else "bit"
    for view in views:
        x, y = view.position_m
        typer.echo(
            f"({x:.2f}, {y:.2f}) m, heading {view.heading_deg:.0f} deg, after {view.path_length_m:.1f} m: "
            f"{view.gain:.2f} {unit}, {view.gain_per_m:.2f} {unit}/m"
        )
    if not views:
        typer.echo("nothing unknown can be reached")
    opt.print_files(out, ["next_views.yaml", "next_views.png"])


def _table(result: "sp.MaterialCalibration") -> str:
    """Tabulate the materials, and how well they explain the measurements."""
    numbers = result.record()
    lines = []
    for which, (found, start) in enumerate(zip(result.materials, result.start, strict=True)):
        own = "" if len(result.materials) == 1 else f"[{which}]"
        stds = [float(std[which] if own else std) for std in (result.permittivity_std, result.conductivity_std_s_m)]
        rows = (
            ("permittivity", found.relative_permittivity, stds[0], "", start.relative_permittivity),
            ("conductivity", found.conductivity_s_m, stds[1], " S/m", start.conductivity_s_m),
        )
        for name, value, std, unit, before in rows:
            note = "   CANNOT BE DETERMINED" if f"{name}{own}" in result.undetermined else ""
            lines.append(f"{name + own:<18}{value:.4g} +- {std:.2g}{unit} (start {before:.4g}{unit}){note}")
        losses = zip(*result.reflection_loss_db(TABLE_ANGLES_DEG, which=which), TABLE_ANGLES_DEG, strict=True)
        texts = (f"{loss:.1f} +- {std:.1f} dB at {angle:g} deg" for loss, std, angle in losses)
        lines.append(f"{'reflection' + own:<18}{', '.join(texts)}")
    left = ", ".join(f"{count} {reason}" for reason, count in result.left_out.items() if count) or "none"
    rmse = numbers["rmse_db"]
    lines.append(f"{'links':<18}{numbers['links_used']} used; left out: {left}")
    lines.append(f"{'traced - measured':<18}{rmse['before']:.2f} dB before, {rmse['after']:.2f} dB after (RMS)")
    return "\n".join([*lines, f"{'noise':<18}{result.noise_db:.1f} dB"])
