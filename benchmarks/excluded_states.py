"""Fraction of links whose states in the complete building are among those that their map leaves possible.

Reads the links of data sets with receivers drawn indoors, and compares what `LinkContext.possible` leaves with the
trace of the complete building. Run it with

    sionna-partial dataset gibson --homes 0 --map ../shared/gibson
    python benchmarks/excluded_states.py gibson
"""

import argparse

import numpy as np

import sionna_partial as sp
from sionna_partial.lab.datasets.table import LinkTable


def main() -> None:
    """Print one row of the table for each data set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", help="folders that `sionna-partial dataset` wrote")
    print(
        "| data set | links where a rule applies | state correct | no LOS | LOS | outage |\n|---|---|---|---|---|---|"
    )
    for folder in parser.parse_args().datasets:
        print(f"| {folder} | " + " | ".join(row(sp.lab.read_dataset(folder))) + " |")


def row(links: LinkTable) -> list[str]:
    """Return the number of links where a rule applies, and the fractions of them that are right, rule by rule."""
    context = links.features.context
    taken = ~links.anywhere & ~context.complete
    possible, state = context.possible[taken], links.link_state[taken]
    right = possible[np.arange(len(state)), state]
    applies = ~possible.all(axis=1)
    alone = possible.sum(axis=1) == 1
    rules = {
        "all": applies,
        "no LOS": ~possible[:, sp.LinkState.LOS] & ~alone,
        "LOS": possible[:, sp.LinkState.LOS] & alone,
        "outage": possible[:, sp.LinkState.OUTAGE] & alone,
    }
    fractions = (f"{right[where].mean():.4f} of {where.sum():,}" if where.any() else "none" for where in rules.values())
    return [f"{applies.sum():,} of {len(state):,} ({applies.mean():.0%})", *fractions]


if __name__ == "__main__":
    main()
