"""Link states compared with those that Wireless InSite found in real homes.

Each home is a folder with a ROS map, `tx.csv` (tx, x, y, z) and `links.csv.gz` (tx, x, y, link_state, snr_db), whose
link states are 0 outage, 1 LOS, 2 and 3 NLOS; the positions name pixels, whose centres lie half a cell to the right and
below. Links are traced three times: with the package's defaults at the written positions, with the same at the pixels'
centres, and there with the settings that come closest to what the reference did. Run it with

    python benchmarks/wireless_insite.py --homes ../shared/gibson

With `--orders` it prints instead which links Wireless InSite reaches, by the kinds of their simplest paths.
"""

import argparse
import csv
import gzip
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.links import TracedLinks

STATES = {sp.LinkState.OUTAGE: "outage", sp.LinkState.LOS: "LOS", sp.LinkState.NLOS: "NLOS"}
RX_HEIGHT_M = 1.5
NEAREST_M = 0.05
"""Shortest distance of a link that is compared [m]."""

CELLS = sp.SceneSettings(outline="cells")
WALLS_ALONE = sp.SceneSettings(outline="cells", floor_extent="none", ceiling=False)
REFERENCE = sp.TraceSettings(max_depth=3, diffraction_walls=1, power_tolerance_db=0.0)
TRIALS = {
    "defaults, as written": (False, None, None),
    "defaults, at centres": (True, None, None),
    "cells, at centres": (True, REFERENCE, CELLS),
}
"""Whether receivers and transmitters are moved to the pixels' centres, and how links are traced."""


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


@dataclass(frozen=True)
class Trial:
    """States (L,) of a home's links in the reference and in ours, our paths, and how many positions were left out."""

    truth: NDArray[np.uint8]
    found: NDArray[np.uint8]
    links: list[TracedLinks]
    transmitters_left_out: int
    receivers_left_out: int

    @property
    def agreement(self) -> float:
        """Share of links with equal states."""
        return float(np.mean(self.truth == self.found))


def main() -> None:
    """Trace every home, and print what agrees."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parents[2] / "shared" / "gibson"
    parser.add_argument("--homes", type=Path, default=default, help="folder of homes (default: %(default)s)")
    parser.add_argument("--receivers", type=int, default=100, help="for each transmitter (default: %(default)s)")
    parser.add_argument("--transmitters", type=int, default=10, help="of each home, at most (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the receivers that are drawn (default: %(default)s)")
    parser.add_argument("--orders", action="store_true", help="print instead which kinds of paths it has")
    arguments = parser.parse_args()
    folders = sorted(path.parent for path in arguments.homes.glob("*/links.csv.gz"))
    if not folders:
        sys.exit(f"--homes {arguments.homes}: no folder there holds links.csv.gz; give the folder of the Gibson homes.")
    homes = [read(folder, arguments.transmitters, arguments.receivers, arguments.seed) for folder in folders]
    if arguments.orders:
        print_orders(homes)
    else:
        trials = print_agreement(homes)
        print_left_out(trials)
        print_states(trials["cells, at centres"])


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


def trace(
    reference: Reference, at_centres: bool, settings: sp.TraceSettings | None, scene_settings: sp.SceneSettings | None
) -> Trial:
    """Trace the links of a home whose ends are in free cells."""
    home, half_m = reference.home, reference.home.resolution_m / 2
    shift = np.array([half_m, -half_m, 0.0]) * at_centres
    tx_m, rx_m, truth, blocked, left_out = [], [], [], 0, 0
    for tx, rx, state in zip(reference.tx_m, reference.rx_m, reference.state, strict=True):
        tx, rx = tx + shift, rx + shift
        if home.state_at(tx[None])[0] != sp.CellState.FREE:
            blocked += 1
            continue
        kept = (home.state_at(rx) == sp.CellState.FREE) & (np.linalg.norm(rx - tx, axis=1) > NEAREST_M)
        left_out += int((~kept).sum())
        tx_m.append(tx)
        rx_m.append(rx[kept])
        truth.append(state[kept])
    simulation = sp.Simulation(home, settings, scene_settings)
    links = [simulation.links(*each) for each in zip(tx_m, rx_m, strict=True)]
    found = np.concatenate([each.link_state for each in links])
    return Trial(np.concatenate(truth), found, links, blocked, left_out)


def print_agreement(homes: Sequence[Reference]) -> dict[str, list[Trial]]:
    """Print the fraction of links with equal states, a line for each home, and give all trials."""
    print(f"{'home':>12}{'links':>8}" + "".join(f"{name:>24}" for name in TRIALS))
    trials: dict[str, list[Trial]] = {name: [] for name in TRIALS}
    for reference in homes:
        for name, how in TRIALS.items():
            trials[name].append(trace(reference, *how))
        fractions = "".join(f"{each[-1].agreement:>24.3f}" for each in trials.values())
        print(f"{reference.name:>12}{len(trials['cells, at centres'][-1].truth):>8}{fractions}", flush=True)
    fractions = {name: [trial.agreement for trial in each] for name, each in trials.items()}
    for name, measure in {"mean": np.mean, "spread": np.std, "lowest": np.min}.items():
        print(f"{name:>20}" + "".join(f"{measure(each):>24.3f}" for each in fractions.values()))
    return trials


def print_left_out(trials: dict[str, list[Trial]]) -> None:
    """Print how many transmitters and receivers were not compared."""
    for name, each in trials.items():
        blocked, receivers = (
            sum(getattr(trial, field) for trial in each) for field in ("transmitters_left_out", "receivers_left_out")
        )
        print(f"{name}: left out {blocked} transmitters and {receivers} receivers of the others, not in free cells")


def print_states(trials: Sequence[Trial]) -> None:
    """Print which states stand for which, over all homes, and how often LOS differs."""
    truth, found = (np.concatenate([getattr(trial, name) for trial in trials]) for name in ("truth", "found"))
    print("\nshare of all links: rows Wireless InSite, columns cells, at centres")
    print(" " * 10 + "".join(f"{name:>10}" for name in STATES.values()))
    for state, name in STATES.items():
        fractions = [np.mean((truth == state) & (found == other)) for other in STATES]
        print(f"{name:>10}" + "".join(f"{fraction:>10.4f}" for fraction in fractions))
    differs = np.mean((truth == sp.LinkState.LOS) != (found == sp.LinkState.LOS))
    print(f"line of sight differs in {differs:.2%} of all links")


def print_orders(homes: Sequence[Reference]) -> None:
    """Print how many links Wireless InSite reaches, by the kinds of the simplest paths that each has.

    Links without line of sight, traced over walls alone with up to two reflections around a diffraction.
    """
    links, reached = Counter[str](), Counter[str]()
    for reference in homes:
        trial = trace(reference, True, sp.TraceSettings(max_depth=3, power_tolerance_db=0.0), WALLS_ALONE)
        kinds = [kind for each in trial.links for kind in simplest(each)]
        for kind, state, found in zip(kinds, trial.truth, trial.found, strict=True):
            if found != sp.LinkState.LOS:
                links[kind] += 1
                reached[kind] += int(state != sp.LinkState.OUTAGE)
    print("links without line of sight, by their simplest paths (R reflection, D diffraction, in order)")
    print(f"{'simplest paths':>24}{'links':>8}{'reached by Wireless InSite':>30}")
    for kind, count in links.most_common():
        print(f"{kind:>24}{count:>8}{reached[kind] / count:>30.3f}")


def simplest(links: TracedLinks) -> list[str]:
    """Kinds of the paths of fewest interactions of each receiver (N,), such as "D" or "DR, RD"."""
    letters = ["".join("D" if kind == DIFFRACTION else "R" for kind in row if kind) for row in links.interactions]
    kinds: list[set[str]] = [set() for _ in links.rx]
    for rx, word in zip(links.path_rx, letters, strict=True):
        kinds[rx].add(word)
    names = []
    for each in kinds:
        fewest = min((len(word) for word in each), default=0)
        shortest = {word if "D" in word else "reflections" for word in each if len(word) == fewest}
        names.append(", ".join(sorted(shortest)) or "none")
    return names


if __name__ == "__main__":
    main()
