"""Trace of a robot's map against the trace of the whole home, for the shipped homes at every stage of exploration.

Links run from each home's transmitter to a grid of receivers inside it. Per home and stage: how far the two traces
agree in link state and gain, the features, and how long each trace takes (the best of three after a warm-up).
Run it with

    python benchmarks/partial_vs_full.py --out benchmark-output
"""

import argparse
import csv
import time
from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.files import atomic_write
from sionna_partial.plots.style import figure_png
from sionna_partial.resources import demo_homes, scenes_folder

RUNS = 3


@dataclass(frozen=True)
class Row:
    """One home at one stage; gains count -150 dB for an outage."""

    home: str
    step: int
    links: int
    observed_fraction: float
    fully_observed_links: float
    mean_unobserved_distance_m: float
    link_state_agreement: float
    gain_within_half_db: float
    gain_median_error_db: float
    gain_rmse_db: float
    partial_trace_s: float
    full_trace_s: float
    time_ratio: float


def main() -> None:
    """Measure, print the table, write it as CSV, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmark-output"))
    parser.add_argument("--homes", nargs="+", default=list(demo_homes()), help="names below scenes/")
    parser.add_argument("--spacing", type=float, default=0.15, help="receiver spacing [m]")
    arguments = parser.parse_args()
    rows = [row for home in arguments.homes for row in compare(home, arguments.spacing)]
    with atomic_write(arguments.out / "partial_vs_full.csv", "w") as stream:
        writer = csv.DictWriter(stream, [field.name for field in fields(Row)], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: f"{v:.6g}" if isinstance(v, float) else v for name, v in asdict(row).items()})
    with atomic_write(arguments.out / "partial_vs_full.png") as stream:
        stream.write(figure_png(draw(rows)))
    print_table(rows)
    print(f"wrote {arguments.out / 'partial_vs_full.csv'} and {arguments.out / 'partial_vs_full.png'}")


def compare(home: str, spacing_m: float) -> Iterator[Row]:
    """Compare every stage of a home, from nothing observed to everything, with the complete home."""
    folder, tx = scenes_folder() / home, demo_homes()[home]["transmitter"]
    complete = sp.load_map(folder / "complete")
    nothing = np.full_like(complete.state, sp.CellState.UNKNOWN)
    stages = {0: sp.PartialMap(nothing, complete.resolution_m, complete.origin_m, complete.wall_height_m)}
    stages |= {int(path.name.removeprefix("step")): sp.load_map(path) for path in sorted(folder.glob("step*"))}
    rx = receivers(complete, stages.values(), spacing_m)
    interior = (complete.state == sp.CellState.FREE).sum()
    truth, full_s = timed_trace(complete, tx, rx)
    for step, partial in stages.items():
        links, partial_s = timed_trace(partial, tx, rx)
        phi = sp.link_features(partial, links)
        error_db = np.abs(links.gain_db - truth.gain_db)
        yield Row(
            home=home,
            step=step,
            links=len(rx),
            observed_fraction=(partial.state == sp.CellState.FREE).sum() / interior,
            fully_observed_links=np.mean(phi.unobserved_distance_m == 0),
            mean_unobserved_distance_m=phi.unobserved_distance_m.mean(),
            link_state_agreement=np.mean(links.link_state == truth.link_state),
            gain_within_half_db=np.mean(error_db <= 0.5),
            gain_median_error_db=np.median(error_db),
            gain_rmse_db=np.sqrt(np.mean(error_db**2)),
            partial_trace_s=partial_s,
            full_trace_s=full_s,
            time_ratio=partial_s / full_s,
        )


def receivers(complete: sp.PartialMap, stages: Iterator[sp.PartialMap], spacing_m: float) -> NDArray[np.float64]:
    """Grid of receivers at 1.5 m on free cells of the home, none inside what a stage takes for a wall."""
    x0, y0, x1, y1 = complete.bounds_m
    x, y = np.meshgrid(np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m))
    rx = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)])
    rx = rx[complete.state_at(rx) == sp.CellState.FREE]
    for partial in stages:
        rx = rx[partial.state_at(rx) != sp.CellState.WALL]
    return rx


def timed_trace(
    partial: sp.PartialMap, tx: tuple[float, float, float], rx: NDArray[np.float64]
) -> tuple[sp.TracedLinks, float]:
    """Trace, and give the shortest time of several runs after a warm-up [s]."""
    links = sp.trace_links(partial, tx, rx)
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        sp.trace_links(partial, tx, rx)
        times.append(time.perf_counter() - start)
    return links, min(times)


def print_table(rows: list[Row]) -> None:
    """Print the rows, a line each."""
    heads = (
        "home",
        "step",
        "links",
        "observed",
        "d_unobs=0",
        "mean d_unobs",
        "state =",
        "gain <0.5 dB",
        "median",
        "RMSE",
    )
    print("".join(f"{head:>13}" for head in (*heads, "partial [s]", "full [s]", "ratio")))
    for row in rows:
        home, step, links, *numbers = astuple(row)
        print(f"{home:>13}{step:>13}{links:>13}" + "".join(f"{number:>13.3f}" for number in numbers))


def draw(rows: list[Row]) -> Figure:
    """Draw agreement, gain error and time against the steps of exploration."""
    figure = Figure(figsize=(12, 3.6), layout="constrained", dpi=150)
    panels = (
        ("link_state_agreement", "links with equal link state"),
        ("gain_rmse_db", "RMSE of the path gain [dB]"),
        ("mean_unobserved_distance_m", "mean unobserved distance [m]"),
        ("time_ratio", "time of the partial trace / full trace"),
    )
    for axis, (name, label) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for home, marker in zip(dict.fromkeys(row.home for row in rows), "os^dvPX*", strict=False):
            line = [(row.step, getattr(row, name)) for row in rows if row.home == home]
            axis.plot(*zip(*line, strict=True), marker=marker, label=home)
        axis.set(xlabel="exploration steps", ylabel=label, ylim=(0, None))
        axis.grid(alpha=0.3)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=8, frameon=False)
    return figure


if __name__ == "__main__":
    main()
