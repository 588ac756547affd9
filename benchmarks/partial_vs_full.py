"""Trace of a robot's map against the trace of the whole home, for the shipped homes at every stage of exploration.

Links run from each home's transmitter to a grid of receivers inside it. Run it with

    python benchmarks/partial_vs_full.py --spacing 0.3
"""

import argparse

import numpy as np
from stock import grid_m

import sionna_partial as sp
from sionna_partial.resources import demo_homes, scenes_folder


def main() -> None:
    """Print a row for each home and stage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", nargs="+", default=list(demo_homes()), help="names below scenes/")
    parser.add_argument("--spacing", type=float, default=0.15, help="receiver spacing [m]")
    arguments = parser.parse_args()
    print("| home | steps | links | observed | equal link state | gain within 0.5 dB | RMSE [dB] |")
    print("|---|---|---|---|---|---|---|")
    for home in arguments.homes:
        print_stages(home, arguments.spacing)


def print_stages(home: str, spacing_m: float) -> None:
    """Compare every stage of a home, from nothing observed on, with the complete home; outages count -150 dB."""
    folder, tx = scenes_folder() / home, demo_homes()[home]["transmitter"]
    complete = sp.load_map(folder / "complete")
    nothing = np.full_like(complete.state, sp.CellState.UNKNOWN)
    stages = {0: sp.PartialMap(nothing, complete.resolution_m, complete.origin_m, complete.wall_height_m)}
    stages |= {int(path.name.removeprefix("step")): sp.load_map(path) for path in sorted(folder.glob("step*"))}
    rx = grid_m(complete, spacing_m)
    for partial in stages.values():
        rx = rx[partial.state_at(rx) != sp.CellState.WALL]
    truth, interior = sp.trace_links(complete, tx, rx), (complete.state == sp.CellState.FREE).sum()
    for step, partial in stages.items():
        links = sp.trace_links(partial, tx, rx)
        observed = (partial.state == sp.CellState.FREE).sum() / interior
        equal, error_db = np.mean(links.link_state == truth.link_state), np.abs(links.gain_db - truth.gain_db)
        fractions = f"{observed:.2f} | {equal:.2f} | {np.mean(error_db <= 0.5):.2f}"
        print(f"| {home} | {step} | {len(rx)} | {fractions} | {np.sqrt(np.mean(error_db**2)):.1f} |", flush=True)


if __name__ == "__main__":
    main()
