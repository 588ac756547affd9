"""A worked example: where shall the transmitter go in a home of which a robot has seen a part.

The search sees the partial map alone. Here the rest of the home is known, too, so that the place can be judged: by the
share of the home in which the full trace finds more than the threshold. Run it with

    python examples/place_transmitter.py
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.resources import scenes_folder

THRESHOLD_DB = -100.0
HOME = "apartment"


def main() -> None:
    """Place, draw, and compare with the middle of what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("placement.png"), help="where the picture goes")
    parser.add_argument("--steps", default="step100", help="what the robot has seen: a folder below scenes/apartment")
    arguments = parser.parse_args()
    partial = sp.load_map(scenes_folder() / HOME / arguments.steps)
    home = sp.load_map(scenes_folder() / HOME / "complete")
    found = sp.place_transmitter(partial, objective="coverage", threshold_db=THRESHOLD_DB, seed=0)
    x, y, z = found.position_m
    print(f"place the transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m: predicted coverage {found.score:.1%}")
    print(f"in truth it covers {coverage(home, found.position_m):.1%}")
    print(f"a transmitter in the middle of what was seen covers {coverage(home, middle(partial)):.1%}")
    sp.plot_placement(found).savefig(arguments.out)
    print(f"wrote {arguments.out}; sp.predict_map(partial, found.position_m) predicts the coverage of that place")


def coverage(home: sp.PartialMap, tx: NDArray[np.float64]) -> float:
    """Share of a complete home where the full trace finds a gain above the threshold."""
    cells = np.argwhere(home.state == sp.CellState.FREE)[::97, ::-1] + 0.5
    rx = np.column_stack([cells * home.resolution_m + home.origin_m, np.full(len(cells), 1.5)])
    rx = rx[np.linalg.norm(rx - tx, axis=1) > 0.02]
    return float(np.mean(sp.trace_links(home, tx, rx).gain_db > THRESHOLD_DB))


def middle(partial: sp.PartialMap) -> NDArray[np.float64]:
    """Centre of the free cell that is nearest to the mean of all."""
    cells = np.argwhere(partial.state == sp.CellState.FREE)[:, ::-1] + 0.5
    nearest = cells[np.linalg.norm(cells - cells.mean(axis=0), axis=1).argmin()]
    return np.append(nearest * partial.resolution_m + partial.origin_m, 1.5)


if __name__ == "__main__":
    main()
