"""Subcommand for several transmitters: network."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

import sionna_partial as sp
import sionna_partial.cli.options as opt
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, DEFAULT_HEIGHT_M, MEMORY_GB
from sionna_partial.files import atomic_files, require_writable
from sionna_partial.progress import reporting


def network(
    map_path: opt.Map,
    tx: Annotated[
        list[str],
        typer.Option(metavar="X Y [Z]", help="Transmitter [m]; once for each.", show_default=False),
    ],
    out: Annotated[Path, typer.Option(help="Folder for coverage, network and picture.", show_default=False)],
    tx_power: Annotated[float, typer.Option(help="Transmit power of each [dBm].")] = 20.0,
    noise_figure: Annotated[float, typer.Option(help="Of the receivers [dB].")] = 7.0,
    bandwidth: Annotated[float, typer.Option(help="Bandwidth [Hz].")] = 100e6,
    load: Annotated[float, typer.Option(help="Fraction of time in which an interferer transmits.")] = 1.0,
    sinr_threshold: Annotated[float, typer.Option(help="SINR that a receiver needs [dB].")] = 0.0,
    spacing: Annotated[float, typer.Option(help="Distance between receivers [m].")] = 0.25,
    rx_height: opt.RxHeight = DEFAULT_HEIGHT_M,
    frequency: opt.Frequency = CARRIER_FREQUENCY_HZ,
    material: opt.MaterialText = "",
    max_depth: opt.MaxDepth = 6,
    diffraction: opt.Diffraction = True,
    predictor: opt.PredictorName = "",
    strict: opt.Strict = False,
    height_band: opt.HeightBand = None,
    up: opt.Up = None,
    wall_height: opt.WallHeight = None,
    memory: opt.Memory = MEMORY_GB,
) -> None:
    """Predict best server, SINR and rate of several transmitters on a partial map."""
    from sionna_partial.network import LinkBudget, transmit_powers_dbm

    positions = [(*opt.parse_position(each), DEFAULT_HEIGHT_M)[:3] for each in tx]
    scene_settings, trace_settings = opt.settings_of(material, frequency, max_depth, diffraction)
    partial = sp.load_map(map_path, strict=strict, wall_height_m=wall_height, height_band_m=height_band, up=up)
    powers_dbm = transmit_powers_dbm(tx_power, len(positions))
    budget = LinkBudget(noise_figure, bandwidth, load, sinr_threshold)
    require_writable(out)
    with reporting(None, command=True) as report:
        report(0.0, "loading the predictor")
        coverage = sp.predict_map(
            partial,
            positions,
            rx_height_m=rx_height,
            spacing_m=spacing,
            predictor=predictor or None,
            scene_settings=scene_settings,
            trace_settings=trace_settings,
            memory_gb=memory,
            progress=lambda fraction, message: report(0.8 * fraction, message),
        )
        report(0.8, "drawing links together")
        found = sp.network_map(coverage, tx_power_dbm=powers_dbm, **asdict(budget))
        with atomic_files(out) as folder:
            report(0.9, "writing")
            for name in ("coverage.nc", "coverage.html"):
                sp.save_coverage(coverage, folder / name)
            sp.save_network(found, folder / "network.nc")
            sp.plot_network(found).savefig(folder / "network.png")
    opt.print_files(out, ["coverage.nc", "coverage.html", "network.nc", "network.png"])
