"""Subcommands back from links to what they depend on: calibrate, place."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sionna_partial.cli.shell import (
    DiffractionOption,
    FrequencyOption,
    HeightBandOption,
    MapArgument,
    MaterialOption,
    MaxDepthOption,
    PredictorOption,
    StrictOption,
    UpOption,
    WallHeightOption,
    parse_material,
    print_files,
    show_progress,
)
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, DEFAULT_HEIGHT_M
from sionna_partial.files import atomic_files, require_writable
from sionna_partial.settings import Objective, SceneSettings, TraceSettings

if TYPE_CHECKING:
    from sionna_partial.calibration.calibration import MaterialCalibration
    from sionna_partial.placement.placement import TransmitterPlacement

TABLE_ANGLES_DEG = (0.0, 30.0, 45.0, 60.0)
"""Angles of incidence of the printed losses [degrees]."""


def calibrate(
    map_path: MapArgument,
    measurements: Annotated[
        Path,
        typer.Option(
            metavar="CSV", help="Columns tx_x,tx_y,tx_z,rx_x,rx_y,rx_z [m], gain_db [dB].", show_default=False
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Folder for the calibrated map, the numbers and a picture.", show_default=False)
    ],
    material: MaterialOption = "",
    frequency: FrequencyOption = CARRIER_FREQUENCY_HZ,
    max_depth: MaxDepthOption = 6,
    diffraction: DiffractionOption = True,
    strict: StrictOption = False,
    height_band: HeightBandOption = None,
    up: UpOption = None,
    wall_height: WallHeightOption = None,
) -> None:
    """Find the material of a building from measured path gains.

    The folder --out gets the map with the calibrated material (predict takes it), the numbers as JSON, and a picture.
    """
    scene_settings = SceneSettings(material=parse_material(material))
    settings = TraceSettings(frequency, max_depth, diffraction=None if diffraction else False)
    from sionna_partial.maps.map_files import load_map, save_map
    from sionna_partial.measurements.measurements import measurements_of

    measured = measurements_of(measurements)
    partial = load_map(map_path, strict=strict, wall_height_m=wall_height, height_band_m=height_band, up=up)
    require_writable(out)
    with show_progress() as report:
        report(0.0, "loading Sionna RT")
        import json

        from sionna_partial.calibration.calibration import calibrate_materials
        from sionna_partial.plots.figures import figure_png
        from sionna_partial.plots.material_plot import plot_calibration

        result = calibrate_materials(
            partial,
            measured,
            start=scene_settings.material if material else None,
            settings=settings,
            scene_settings=scene_settings,
            progress=report,
        )
        with atomic_files(out) as folder:
            save_map(result.scene, folder / "calibrated.npz")
            (folder / "calibration.json").write_text(json.dumps(result.record(), indent=1) + "\n", encoding="utf-8")
            (folder / "calibration.png").write_bytes(figure_png(plot_calibration(result)))
    typer.echo(_table(result))
    print_files([out / name for name in ("calibrated.npz", "calibration.json", "calibration.png")])


def place(
    map_path: MapArgument,
    out: Annotated[Path, typer.Option(help="Folder for the numbers and a picture.", show_default=False)],
    objective: Annotated[
        Objective, typer.Option(help="Mean predicted coverage, or the gain of the worst tenth of the receivers.")
    ] = "coverage",
    threshold: Annotated[float, typer.Option(help="Path gain above which a receiver is covered [dB].")] = -100.0,
    height: Annotated[float, typer.Option(help="Height of the transmitter [m].")] = DEFAULT_HEIGHT_M,
    rx_height: Annotated[float, typer.Option(help="Height of the receivers [m].")] = DEFAULT_HEIGHT_M,
    seed: Annotated[int, typer.Option(help="Seed of the positions that are compared.")] = 0,
    frequency: FrequencyOption = CARRIER_FREQUENCY_HZ,
    material: MaterialOption = "",
    max_depth: MaxDepthOption = 6,
    diffraction: DiffractionOption = True,
    predictor: PredictorOption = "",
    strict: StrictOption = False,
    height_band: HeightBandOption = None,
    up: UpOption = None,
    wall_height: WallHeightOption = None,
) -> None:
    """Find a good position for a transmitter on a partial map.

    The folder --out gets the position and the search as JSON, and a picture.
    """
    scene_settings = SceneSettings(material=parse_material(material))
    trace_settings = TraceSettings(frequency, max_depth, diffraction=None if diffraction else False)
    from sionna_partial.maps.map_files import load_map

    partial = load_map(map_path, strict=strict, wall_height_m=wall_height, height_band_m=height_band, up=up)
    require_writable(out)
    with show_progress() as report:
        report(0.0, "loading the predictor")
        from sionna_partial.placement.placement import place_transmitter
        from sionna_partial.plots.figures import figure_png
        from sionna_partial.plots.placement_plot import plot_placement

        result = place_transmitter(
            partial,
            objective=objective,
            threshold_db=threshold,
            height_m=height,
            seed=seed,
            rx_height_m=rx_height,
            predictor=predictor or None,
            scene_settings=scene_settings,
            trace_settings=trace_settings,
            progress=report,
        )
        with atomic_files(out) as folder:
            result.save(folder / "placement.json")
            (folder / "placement.png").write_bytes(figure_png(plot_placement(result)))
    typer.echo(_found_position(result))
    print_files([out / name for name in ("placement.json", "placement.png")])


def _found_position(result: "TransmitterPlacement") -> str:
    """One line with the position of the transmitter and its score."""
    x, y, z = result.position_m
    if result.settings.objective == "coverage":
        score = f"{result.score:.1%} of the receivers are predicted above {result.settings.threshold_db:g} dB"
    else:
        score = f"the worst tenth of the receivers is predicted at {result.score:.1f} dB"
    return f"transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m: {score}"


def _table(result: "MaterialCalibration") -> str:
    """Tabulate the materials, and how well they explain the measurements."""
    numbers = result.record()
    lines = []
    for which, (found, start) in enumerate(zip(result.materials, result.start, strict=True)):
        own = "" if len(result.materials) == 1 else f"[{which}]"
        spreads = [
            float(values[which]) if own else float(values)
            for values in (result.permittivity_std, result.conductivity_std)
        ]
        loss_db, std_db = result.reflection_loss_db(TABLE_ANGLES_DEG, which=which)
        losses = ", ".join(
            f"{loss:.1f} +- {std:.1f} dB at {angle:g} deg"
            for loss, std, angle in zip(loss_db, std_db, TABLE_ANGLES_DEG, strict=True)
        )
        rows = (
            ("permittivity", found.relative_permittivity, spreads[0], "", start.relative_permittivity),
            ("conductivity", found.conductivity_s_m, spreads[1], " S/m", start.conductivity_s_m),
        )
        for name, value, std, unit, before in rows:
            doubt = "   CANNOT BE DETERMINED" if f"{name}{own}" in result.undetermined else ""
            lines.append(f"{name + own:<18}{value:.4g} +- {std:.2g}{unit} (start {before:.4g}{unit}){doubt}")
        lines.append(f"{'reflection' + own:<18}{losses}")
    left = ", ".join(f"{count} {reason}" for reason, count in result.left_out.items() if count) or "none"
    rmse = numbers["rmse_db"]
    lines.append(f"{'links':<18}{numbers['links_used']} used; left out: {left}")
    lines.append(f"{'traced - measured':<18}{rmse['before']:.2f} dB before, {rmse['after']:.2f} dB after (RMS)")
    lines.append(f"{'noise':<18}{result.noise_db:.1f} dB")
    return "\n".join(lines)
