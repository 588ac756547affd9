"""Channels of traced links: time and memory.

    python benchmarks/channels.py

compares impulse responses of 3,000 receivers (8 x 8 by 2 x 2 antennas), and the gains of 64 x 16 beams, with the trace
of the same links in the same process, the median of several runs after a warm-up; and writes the channels of 25,000
receivers in processes of their own. Times are processor times of one core.
"""

import argparse
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stock import grid_m, isolated, limit_cores, peak_memory_gb, timed

import sionna_partial as sp
from sionna_partial.channels.samples import ChannelSamples
from sionna_partial.resources import demo_homes, scenes_folder
from sionna_partial.tracing.antennas import planar_array

HOME = "house"
_UNIT = dict.fromkeys(("trace", "sample_channels, 100 draws", "sample_channels, paths of 100 draws"), "trace")
_UNIT |= dict.fromkeys(("predict_map", "predict_map, three transmitters"), "predict_map")


def main() -> None:
    """Print the times as ratios to the trace, and what streaming takes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--receivers", type=int, default=3000)
    parser.add_argument("--streamed", type=int, default=25_000)
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    receivers, streamed, runs = arguments.receivers, arguments.streamed, arguments.runs
    seconds = isolated(times, receivers, runs)
    print(f"{receivers} receivers of the {HOME}, one core, processor time, median of {runs} runs")
    for name, value in seconds.items():
        print(f"{name:34}{value:8.3f} s{value / seconds['trace']:8.2f} of the trace")
    print(f"\nthe {HOME} as a robot has seen it after 150 steps")
    seconds = isolated(partial_times, receivers, runs)
    for name, value in seconds.items():
        print(f"{name:34}{value:8.3f} s{value / seconds[_UNIT[name]]:8.2f} of {_UNIT[name]}")
    print(f"\n{streamed} receivers, 8 x 8 by 2 x 2 antennas, written some at a time")
    for suffix in (".nc", ".zarr"):
        row = isolated(stream, streamed, suffix)
        size = f"{row['array_gb']:.1f} GB of arrays, {row['file_gb']:.2f} GB on disk"
        print(f"{suffix:6}{row['seconds']:8.1f} s, {size}, peak memory {row['memory_gb']:.2f} GB")


def times(receivers: int, runs: int) -> dict[str, float]:
    """Median seconds of each step."""
    limit_cores(1)
    partial, tx, rx = _scene(receivers)
    links, arrays = sp.trace_links(partial, tx, rx), _arrays()
    codebooks = sp.channels.dft_codebook(8, 8), sp.channels.dft_codebook(4, 4)
    wide = {**arrays, "rx_array": planar_array(4, 4)}
    subcarriers_hz = np.arange(-32, 32) * 960e3
    steps: dict[str, Callable[[], object]] = {
        "trace": lambda: sp.trace_links(partial, tx, rx),
        "cir, 8x8 by 2x2": lambda: links.cir(**arrays),
        "cfr, 64 subcarriers, 8x8 by 2x2": lambda: links.cfr(subcarriers_hz, **arrays),
        "beam_gains, 64 by 16 beams": lambda: links.beam_gains(*codebooks, **wide),
        "spreads": links.spreads,
    }
    return {name: float(np.median([timed(step)[1] for _ in range(runs + 1)][1:])) for name, step in steps.items()}


def partial_times(receivers: int, runs: int) -> dict[str, float]:
    """Median seconds of draws, and of maps of several transmitters, where not all was seen."""
    limit_cores(1)
    _, tx, rx = _scene(receivers)
    partial = sp.load_map(scenes_folder() / HOME / "step150")
    rx = rx[partial.radios_can_stand(rx)]
    model, three = sp.Predictor.load(), tx + np.array([[0.0, 0.0, 0.0], [0.3, 0.2, 0.0], [-0.2, 0.3, 0.0]])

    def sample() -> ChannelSamples:
        return sp.channels.sample_channels(partial, tx, rx, n=100, predictor=model)

    def sample_paths() -> None:
        samples = sample()
        for draw in range(100):
            samples.links(draw)

    steps: dict[str, Callable[[], object]] = {
        "trace": lambda: sp.trace_links(partial, tx, rx),
        "sample_channels, 100 draws": sample,
        "sample_channels, paths of 100 draws": sample_paths,
        "predict_map": lambda: sp.predict_map(partial, tx, spacing_m=0.25, predictor=model),
        "predict_map, three transmitters": lambda: sp.predict_map(partial, three, spacing_m=0.25, predictor=model),
    }
    return {name: float(np.median([timed(step)[1] for _ in range(runs + 1)][1:])) for name, step in steps.items()}


def stream(receivers: int, suffix: str) -> dict[str, float]:
    """Trace and write, and report seconds of the second and memory of both."""
    limit_cores(1)
    folder = Path(tempfile.mkdtemp())
    try:
        links = sp.trace_links(*_scene(receivers))
        path = folder / f"channels{suffix}"
        _, seconds = timed(lambda: sp.channels.save_channels(links, path, progress=False, **_arrays()))
        files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
        size = sum(each.stat().st_size for each in files)
        array_gb = sp.channels.load_channels(path).a.nbytes / 1e9
        return {
            **{"seconds": seconds, "array_gb": array_gb, "file_gb": size / 1e9},
            "memory_gb": peak_memory_gb(),
        }
    finally:
        shutil.rmtree(folder)


def _arrays() -> dict[str, object]:
    return {"tx_array": planar_array(8, 8, "tr38901"), "rx_array": planar_array(2, 2)}


def _scene(receivers: int) -> tuple[sp.PartialMap, NDArray[np.float64], NDArray[np.float64]]:
    """Return the complete home, its transmitter, and so many receivers in free cells."""
    partial = sp.load_map(scenes_folder() / HOME / "complete")
    rx = grid_m(partial, partial.resolution_m)
    rx = rx[partial.radios_can_stand(rx)]
    tx = np.array(demo_homes()[HOME]["transmitter"])
    rx = rx[np.linalg.norm(rx - tx, axis=1) > 0.1]
    return partial, tx, rx[np.linspace(0, len(rx) - 1, receivers).astype(int)]


if __name__ == "__main__":
    main()
