"""Our paths against the truth on complete and partial maps of homes, with every disagreement named.

Truth is stock Sionna RT in tiles of at most 100 receivers, with 1e6 rays and a table of 3e7 entries. What counts, and
how paths that only one side has are checked, is stated by `agreement` in `stock.py`. Run it with

    python benchmarks/trace_truth.py --seeds 20000 20001 --receivers 60

Link by link on a map of your own: gains of both, and the strongest path that either lacks, for the links that differ
most.

    python benchmarks/trace_truth.py --maps scenes/apartment/complete --links 20 --tx 7.0 9.8 1.5 --depth 1
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from stock import (
    Paths,
    agreement,
    is_bent,
    is_real,
    isolated,
    link,
    meant,
    pair_paths,
    paths_of,
    trace_stock,
    true_paths,
)

import sionna_partial as sp
from sionna_partial.scene.scene import SceneGeometry, build_scene
from sionna_partial.tracing.interactions import DIFFRACTION

NEAR_DB = 0.5
"""Largest difference of equal gains [dB]."""

COLUMNS = ("missed", "extra", "real", "leaks", "twice")


def main() -> None:
    """Compare on every map, and print one line for each and the sums."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="*", type=int, default=[20_000, 20_001, 20_002, 20_003], help="for make_home")
    parser.add_argument("--maps", nargs="*", type=Path, default=[], help="complete maps to compare on as well")
    parser.add_argument("--steps", nargs="*", type=int, default=[50, 150], help="stages besides the complete map")
    parser.add_argument("--receivers", type=int, default=60, help="receivers of each map")
    parser.add_argument("--rays", type=int, default=1_000_000)
    parser.add_argument("--links", type=int, help="print so many links of --maps, and no table of all maps")
    parser.add_argument("--tx", nargs=3, type=float, help="transmitter of --links [m]; default: a free cell")
    parser.add_argument("--depth", type=int, default=1, help="largest number of interactions of --links")
    arguments = parser.parse_args()
    if arguments.links is not None:
        for path in arguments.maps:
            print_links(sp.load_map(path), arguments)
        return
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
    tx, rx = places(partial, receivers)
    depth = 3 if diffraction else 6
    settings = sp.TraceSettings(max_depth=depth, diffraction=diffraction, power_tolerance_db=0.0)
    links = sp.trace_links(partial, tx, rx, trace_settings=settings)
    with TemporaryDirectory() as folder:
        sp.export_scene(partial, folder + "/scene")
        stock = isolated(true_paths, folder + "/scene", tx, rx, rays=rays, max_depth=depth, diffraction=diffraction)
    truth = meant(partial, tx, rx, stock["paths"])
    return agreement(partial, tx, rx, paths_of(links), truth) | {"twice": stock["repeats"]}


def places(partial: sp.PartialMap, receivers: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw a transmitter (3,) and receivers (N, 3) in free cells [m]."""
    rng = np.random.default_rng(0)
    cells = rng.permutation(np.argwhere(partial.state == sp.CellState.FREE))[: receivers + 1, ::-1]
    positions = (cells + 0.5) * partial.resolution_m + partial.origin_m
    heights = np.append(1.5, rng.uniform(0.8, 2.0, len(positions) - 1))
    return np.append(positions[0], heights[0]), np.column_stack([positions, heights])[1:]


def print_links(partial: sp.PartialMap, arguments: argparse.Namespace) -> None:
    """Print the gains of the links that differ most, and for each the strongest path that only one side has."""
    tx, rx = places(partial, arguments.receivers)
    tx = tx if arguments.tx is None else np.array(arguments.tx)
    settings = sp.TraceSettings(max_depth=arguments.depth, power_tolerance_db=0.0)
    ours = paths_of(sp.trace_links(partial, tx, rx, trace_settings=settings))
    with TemporaryDirectory() as folder:
        sp.export_scene(partial, folder + "/scene")
        options = {"rays": arguments.rays, "max_depth": arguments.depth, "diffraction": True}
        stock = isolated(trace_stock, folder + "/scene", tx, rx, **options)["paths"]
    geometry, shift = build_scene(partial), np.array([*partial.origin_m, 0.0])
    rows, equal, explained = [], 0, 0
    for position, mine, theirs in zip(rx, ours, stock, strict=True):
        alone = [
            {name: np.delete(values, pairs, axis=0) for name, values in paths.items()}
            for paths, pairs in zip((mine, theirs), pair_paths(mine, theirs).T, strict=True)
        ]
        gains_db = link(mine)[1], link(theirs)[1]
        joined_db = 10.0 * np.log10(10.0 ** (gains_db[1] / 10.0) + (np.abs(alone[0]["a"]) ** 2).sum())
        equal += abs(gains_db[0] - gains_db[1]) <= NEAR_DB
        explained += abs(gains_db[0] - gains_db[1]) > NEAR_DB >= abs(gains_db[0] - joined_db)
        named = [strongest(geometry, paths, (tx, position), shift) for paths in alone]
        rows.append((abs(gains_db[0] - gains_db[1]), position, gains_db, named))
    print("| receiver [m] | ours, stock [dB] | strongest path that stock lacks | that ours lacks |\n|---|---|---|---|")
    for _, position, gains_db, named in sorted(rows, key=lambda row: -row[0])[: arguments.links]:
        print(f"| {places_m(position)} | {gains_db[0]:.1f}, {gains_db[1]:.1f} | {named[0]} | {named[1]} |")
    print(f"{len(rx)} links: {equal} within {NEAR_DB} dB, {explained} more with the paths that stock lacks")


def strongest(
    geometry: SceneGeometry, paths: Paths, ends: tuple[NDArray[np.float64], ...], shift: NDArray[np.float64]
) -> str:
    """Describe the strongest of the paths of one receiver: its interactions, its edge, and whether a wall blocks it."""
    if not len(paths["a"]):
        return ""
    best = int(np.abs(paths["a"]).argmax())
    vertices_m = paths["vertices_m"][best]
    points = np.concatenate([ends[0][None], vertices_m[np.isfinite(vertices_m[:, 0])], ends[1][None]])
    text = f"{20.0 * np.log10(np.abs(paths['a'][best])):.1f} dB"
    if is_bent(paths)[best]:
        at = int((paths["interactions"][best] == DIFFRACTION).argmax())
        legs = np.diff(points, axis=0)[[at, at + 1]]
        legs /= np.linalg.norm(legs, axis=1, keepdims=True)
        turn = np.degrees(np.arccos(np.clip(legs[0] @ legs[1], -1.0, 1.0)))
        text += (
            f", turns by {turn:.0f} degrees at {places_m(points[at + 1])}, {edge_of(geometry, points[at + 1] - shift)}"
        )
    reflections = len(points) - 2 - is_bent(paths)[best]
    text += f", {reflections} reflections" * bool(reflections)
    return text + ", through a wall" * (not is_real(geometry, ends[0] - shift, ends[1] - shift, vertices_m - shift))


def edge_of(geometry: SceneGeometry, point: NDArray[np.float64]) -> str:
    """Describe the edge at a point of the scene by its narrowest face."""
    near = np.linalg.norm(geometry.walls_m - point[:2], axis=2).min(axis=1) < 0.01
    if not near.any() or not 1e-3 < point[2] < geometry.top_m[near].max() - 1e-3:
        return "a rim of floor or ceiling"
    width_m = np.linalg.norm(np.diff(geometry.walls_m[near], axis=1), axis=2).min()
    return "a free end" if near.sum() == 1 else f"an edge of a face of {width_m:.2f} m"


def places_m(point: NDArray[np.float64]) -> str:
    """Format a position."""
    return "(" + ", ".join(f"{value:.2f}" for value in point) + ")"


if __name__ == "__main__":
    main()
