"""Our paths against the truth on complete and partial maps of homes, with every disagreement named.

Truth is stock Sionna RT in tiles of at most 100 receivers, with 1e6 rays and a table of 3e7 entries. What counts, and
how paths that only one side has are checked, is stated in `agreement.py`. Run it with

    python benchmarks/trace_truth.py --seeds 20000 20001 --receivers 60
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from agreement import agreement, meant, paths_of
from stock import isolated, true_paths

import sionna_partial as sp

COLUMNS = ("missed", "extra", "real", "leaks", "twice")


def main() -> None:
    """Compare on every map, and print one line for each and the sums."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="*", type=int, default=[20_000, 20_001, 20_002, 20_003], help="for make_home")
    parser.add_argument("--maps", nargs="*", type=Path, default=[], help="complete maps to compare on as well")
    parser.add_argument("--steps", nargs="*", type=int, default=[50, 150], help="stages besides the complete map")
    parser.add_argument("--receivers", type=int, default=60, help="receivers of each map")
    parser.add_argument("--rays", type=int, default=1_000_000)
    arguments = parser.parse_args()
    homes = [(f"home {seed}", sp.make_home(seed)) for seed in arguments.seeds]
    homes += [(path.parent.name if path.suffix else path.name, sp.load_map(path)) for path in arguments.maps]
    for diffraction in (False, True):
        print(f"\n{'one diffraction, depth 3' if diffraction else 'specular, depth 6'}")
        print(f"{'map':22}{'truth':>8}{'recall':>9}{'state':>8}{'gain':>8}" + "".join(f"{c:>8}" for c in COLUMNS))
        rows = []
        for name, home in homes:
            stages = sp.explore(home, steps=arguments.steps, seed=0) if arguments.steps else []
            for stage, partial in zip([*arguments.steps, "complete"], [*stages, home], strict=True):
                rows.append(compare(partial, arguments.receivers, arguments.rays, diffraction=diffraction))
                print(f"{name + '/' + str(stage):22}{cells(rows[-1])}", flush=True)
        print(f"{'all':22}{cells({key: sum(row[key] for row in rows) for key in rows[0]})}")
    print(
        "\ntruth: its paths that are real; recall: fraction found by ours; missed: not found; state: link state equal;"
        "\ngain: within 0.5 dB; extra: our paths that truth lacks; real: of them, those that cross no wall;"
        "\nleaks: paths of truth that cross a wall; twice: paths that stock listed again"
    )


def cells(row: dict[str, int]) -> str:
    """Format the counts of one map."""
    row = {**row, "missed": row["truth"] - row["found"]}
    fractions = (row["found"] / max(1, row["truth"]), row["same_state"] / row["links"], row["same_gain"] / row["links"])
    numbers = "".join(f"{fraction:>{width}.4f}" for fraction, width in zip(fractions, (9, 8, 8), strict=True))
    return f"{row['truth']:>8}{numbers}" + "".join(f"{row[name]:>8}" for name in COLUMNS)


def compare(partial: sp.PartialMap, receivers: int, rays: int, *, diffraction: bool) -> dict[str, int]:
    """Count what agrees between our trace and the truth, for a seeded transmitter and receivers in free cells."""
    rng = np.random.default_rng(0)
    cells = rng.permutation(np.argwhere(partial.state == sp.CellState.FREE))[: receivers + 1, ::-1]
    positions = (cells + 0.5) * partial.resolution_m + partial.origin_m
    heights = np.append(1.5, rng.uniform(0.8, 2.0, len(positions) - 1))
    tx, rx = np.append(positions[0], heights[0]), np.column_stack([positions, heights])[1:]
    depth = 3 if diffraction else 6
    settings = sp.TraceSettings(max_depth=depth, diffraction=diffraction, power_tolerance_db=0.0)
    links = sp.trace_links(partial, tx, rx, trace_settings=settings)
    with TemporaryDirectory() as folder:
        sp.export_scene(partial, folder + "/scene")
        stock = isolated(true_paths, folder + "/scene", tx, rx, rays=rays, max_depth=depth, diffraction=diffraction)
    truth = meant(partial, tx, rx, stock["paths"])
    return agreement(partial, tx, rx, paths_of(links), truth) | {"twice": stock["repeats"]}


if __name__ == "__main__":
    main()
