"""Link states compared with those that Wireless InSite found in real homes.

Each home is a folder with a ROS map, `tx.csv` (tx, x, y, z) and `links.csv.gz` (tx, x, y, link_state, snr_db), whose
link states are 0 outage, 1 LOS, 2 and 3 NLOS; the positions name pixels, whose centres lie half a cell to the right and
below. Links are traced three times: with the package's defaults at the written positions, with the same at the pixels'
centres, and there with the settings nearest to the reference's. Run it with

    python benchmarks/wireless_insite.py --homes ../shared/gibson
"""

import argparse
import csv
import gzip
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp

RX_HEIGHT_M = 1.5
NEAREST_M = 0.05
"""Shortest distance of a link that is compared [m]."""

CELLS = sp.SceneSettings(outline="cells")
REFERENCE = sp.TraceSettings(max_depth=3, diffraction_walls=1, power_tolerance_db=0.0)
TRIALS = {
    "defaults, as written": (False, None, None),
    "defaults, at centres": (True, None, None),
    "cells, at centres": (True, REFERENCE, CELLS),
}
"""Shift of the ends to the pixels' centres, trace settings and scene settings."""


@dataclass(frozen=True)
class Reference:
    """A home with its transmitters (3,) and, for each, drawn receivers (N, 3) and their states (N,).

    Places are as written [m].
    """

    name: str
    home: sp.PartialMap
    tx_m: list[NDArray[np.float64]]
    rx_m: list[NDArray[np.float64]]
    state: list[NDArray[np.uint8]]


def main() -> None:
    """Trace every home, and print what agrees."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parents[2] / "shared" / "gibson"
    parser.add_argument("--homes", type=Path, default=default, help="folder of homes (default: %(default)s)")
    parser.add_argument("--receivers", type=int, default=100, help="for each transmitter (default: %(default)s)")
    parser.add_argument("--transmitters", type=int, default=10, help="of each home, at most (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the receivers that are drawn (default: %(default)s)")
    arguments = parser.parse_args()
    folders = sorted(path.parent for path in arguments.homes.glob("*/links.csv.gz"))
    if not folders:
        sys.exit(f"--homes {arguments.homes}: no folder there holds links.csv.gz; give the folder of the Gibson homes.")
    print(f"{'home':>12}" + "".join(f"{name:>24}" for name in TRIALS))
    fractions = []
    for folder in folders:
        reference = read(folder, arguments.transmitters, arguments.receivers, arguments.seed)
        fractions.append([agreement(reference, *how) for how in TRIALS.values()])
        print(f"{reference.name:>12}" + "".join(f"{each:>24.3f}" for each in fractions[-1]), flush=True)
    for name, measure in {"mean": np.mean, "lowest": np.min}.items():
        print(f"{name:>12}" + "".join(f"{each:>24.3f}" for each in measure(fractions, axis=0)))


def read(folder: Path, transmitters: int, receivers: int, seed: int) -> Reference:
    """Read a home, and draw receivers of its first transmitters."""
    with (folder / "tx.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))[:transmitters]
    with gzip.open(folder / "links.csv.gz", "rt", encoding="utf-8") as stream:
        links = list(csv.DictReader(stream))
    owner = np.array([link["tx"] for link in links])
    positions = np.array([(float(link["x"]), float(link["y"]), RX_HEIGHT_M) for link in links])
    state = np.minimum([int(link["link_state"]) for link in links], sp.LinkState.NLOS).astype(np.uint8)
    rng, drawn = np.random.default_rng(seed), []
    for row in rows:
        drawn.append(rng.permutation(np.flatnonzero(owner == row["tx"]))[:receivers])
    return Reference(
        name=folder.name,
        home=sp.load_map(folder / "map.yaml"),
        tx_m=[np.array([float(row[axis]) for axis in "xyz"]) for row in rows],
        rx_m=[positions[index] for index in drawn],
        state=[state[index] for index in drawn],
    )


def agreement(
    reference: Reference, at_centres: bool, settings: sp.TraceSettings | None, scene_settings: sp.SceneSettings | None
) -> float:
    """Return the fraction of equal link states of a home, of links whose ends are in free cells."""
    home, half_m = reference.home, reference.home.resolution_m / 2
    shift = np.array([half_m, -half_m, 0.0]) * at_centres
    simulation, equal = sp.Simulation(home, settings, scene_settings), []
    for tx, rx, state in zip(reference.tx_m, reference.rx_m, reference.state, strict=True):
        tx, rx = tx + shift, rx + shift
        if home.state_at(tx[None])[0] == sp.CellState.FREE:
            kept = (home.state_at(rx) == sp.CellState.FREE) & (np.linalg.norm(rx - tx, axis=1) > NEAREST_M)
            equal.append(simulation.links(tx, rx[kept]).link_state == state[kept])
    return float(np.mean(np.concatenate(equal)))


if __name__ == "__main__":
    main()
