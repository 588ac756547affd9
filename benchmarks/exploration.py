"""Fraction of a home that the robot has observed at each stage, compared with the robot of the paper.

Each home is explored from several random starts, and the observed fraction of its free cells is averaged over
these. The table shows the mean over homes, its standard error, and how homes and starts differ. Run it with

    python benchmarks/exploration.py --seeds 8
    python benchmarks/exploration.py --seeds 8 --homes ../shared/gibson
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp

AIM = {50: 0.30, 100: 0.45, 150: 0.55, 200: 0.62}
"""Mean observed fraction [1] that the paper's robot has about, by step: it reports 0.60 at 200 steps, on its homes."""


def main() -> None:
    """Explore all homes and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=Path, help="folder with <home>/map.yaml; default: procedural homes")
    parser.add_argument("--count", type=int, default=40, help="number of procedural homes")
    parser.add_argument("--seeds", type=int, default=4, help="number of explorations of each home")
    arguments = parser.parse_args()
    fractions = np.array([observed(home, range(arguments.seeds)) for home in homes(arguments.homes, arguments.count)])
    print(f"{len(fractions)} homes, {arguments.seeds} explorations each: observed fraction")
    print_table(fractions)


def homes(folder: Path | None, count: int) -> list[sp.PartialMap]:
    """Read the homes of a folder, or make some."""
    if folder is None:
        return [sp.make_home(seed) for seed in range(count)]
    paths = sorted(folder.glob("*/map.yaml"))
    if not paths:
        raise SystemExit(f"--homes {folder}: no home there; give a folder with <home>/map.yaml.")
    return [sp.load_map(path) for path in paths]


def observed(home: sp.PartialMap, seeds: Sequence[int]) -> NDArray[np.float64]:
    """Observed fractions of a home, (seeds, stages)."""
    return np.array([[partial.observed_fraction for partial in sp.explore(home, tuple(AIM), seed)] for seed in seeds])


def print_table(fractions: NDArray[np.float64]) -> None:
    """Print a line for each stage of observed fractions (homes, seeds, stages)."""
    of_home = fractions.mean(axis=1)
    spread = of_home.std(axis=0, ddof=1) if len(fractions) > 1 else np.zeros(len(AIM))
    between_starts = fractions.std(axis=1).mean(axis=0)
    lowest, highest = of_home.min(axis=0), of_home.max(axis=0)
    columns = of_home.mean(axis=0), spread / np.sqrt(len(fractions)), spread, lowest, highest, between_starts
    heads = "step", "mean", "std. error", "over homes", "lowest", "highest", "over starts", "aim"
    print("".join(f"{head:>12}" for head in heads))
    for step, *numbers in zip(AIM, *columns, AIM.values(), strict=True):
        print(f"{step:>12}" + "".join(f"{number:>12.3f}" for number in numbers))


if __name__ == "__main__":
    main()
