"""Procedural homes compared with real ones: sizes, shapes, and statistics of links.

Each statistic is one number per home; the table gives its mean and standard deviation over homes, how many standard
deviations of the real homes apart the means are, and the ratio of the standard deviations (ours to theirs). Offices are
listed as well: a kind of their own, which the real homes do not have. FOLDER holds one folder with a map.yaml for each
real home. Run it with

    python benchmarks/homes.py --gibson ../shared/gibson --out docs
"""

import argparse
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage

import sionna_partial as sp
from sionna_partial.files import atomic_write
from sionna_partial.plots.style import figure_png
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.scene.outlines import wall_outlines

FIRST_SEED = 70_000
HEIGHT_M = 1.5
NEAREST_M = 0.1
PASSAGE_M = 0.9
SMALLEST_CORE_M2 = 0.5
STEPS = 100
TRANSMITTERS = 8
RECEIVERS = 60
EDGES_M = np.array([0.0, 1, 2, 3, 4, 5, 6, 8, 10, 13])
FEWEST_LINKS = 8
REAL, OURS, OFFICES = "Gibson", "apartments, houses", "offices"
COLOURS = {REAL: "#000000", OURS: "#bb5566", OFFICES: "#ddaa33"}
SHEET = {"apartment": 10, "house": 10, "office": 5}
SHEET_IN = 7.2


@dataclass(frozen=True)
class Statistics:
    """One home. Links have random free ends 1.5 m above the floor."""

    area_m2: float
    span_m: float
    hull_fraction: float
    perimeter_per_area: float
    islands_per_100_m2: float
    room_m2: float
    segments_per_m: float
    segments_per_m2: float
    visible_fraction: float
    los_fraction: float
    nlos_fraction: float
    outage_fraction: float
    link_m: float
    solid_fraction: float
    unobserved_fraction: float


@dataclass(frozen=True)
class Measured:
    """Statistics of one home, and its rates (bins,) of LOS and outage against distance; NaN for too few links."""

    statistics: Statistics
    los_rate: NDArray[np.float64]
    outage_rate: NDArray[np.float64]


LABELS = {
    "area_m2": "free area [m²]",
    "span_m": "largest extent [m]",
    "hull_fraction": "free fraction of the convex hull",
    "perimeter_per_area": "perimeter per free area [1/m]",
    "islands_per_100_m2": "islands per 100 m² free",
    "room_m2": "mean room [m²]",
    "segments_per_m": "outline segments per length [1/m]",
    "segments_per_m2": "outline segments per free area [1/m²]",
    "visible_fraction": "area visible from a free point",
    "los_fraction": "links in LOS",
    "nlos_fraction": "links in NLOS",
    "outage_fraction": "links in outage",
    "link_m": "mean length of a link [m]",
    "solid_fraction": "fraction of a link not in free space",
    "unobserved_fraction": f"d_unobs / d after {STEPS} steps",
}
"""Names of the statistics in the table and the picture. Rooms are the parts that passages of at most 0.9 m join."""


def main() -> None:
    """Measure, print the table, draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gibson", type=Path, help="folder of the real homes; without it, ours alone are measured")
    parser.add_argument("--homes", type=int, default=80, help="apartments and houses, three and two in five")
    parser.add_argument("--offices", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("benchmark-output"))
    arguments = parser.parse_args()
    real = sorted(arguments.gibson.glob("*/map.yaml")) if arguments.gibson else []
    groups = {
        REAL: [measure(sp.load_map(path), seed) for seed, path in enumerate(real)],
        OURS: [measure(home, FIRST_SEED + k) for k, home in enumerate(our_homes(arguments.homes))],
        OFFICES: [measure(sp.make_home(FIRST_SEED + k, "office"), k) for k in range(arguments.offices)],
    }
    groups = {name: homes for name, homes in groups.items() if homes}
    print("\n".join(table(groups)))
    for name, figure in {"homes.png": draw(groups), "homes_sheet.png": draw_homes()}.items():
        with atomic_write(arguments.out / name) as stream:
            stream.write(figure_png(figure))
        print(f"wrote {arguments.out / name}")


def our_homes(count: int) -> Iterator[sp.PartialMap]:
    """Make apartments and houses, three and two in five."""
    for k in range(count):
        yield sp.make_home(FIRST_SEED + k, "apartment" if k % 5 < 3 else "house")


def measure(home: sp.PartialMap, seed: int) -> Measured:
    """Measure one home with links that the seed draws."""
    free = home.state == sp.CellState.FREE
    hull = shapely.MultiPoint(np.argwhere(free) * home.resolution_m).convex_hull
    outlines = wall_outlines(home)
    outline_m = np.linalg.norm(np.diff(outlines.vertices_m[outlines.segments], axis=1), axis=2).sum()
    links, distance_m, solid_m, unobserved_m = random_links(home, seed)
    is_los, is_outage = (links.link_state.ravel() == state for state in (sp.LinkState.LOS, sp.LinkState.OUTAGE))
    statistics = Statistics(
        area_m2=area_m2(home),
        span_m=shapely.minimum_bounding_radius(hull) * 2,
        hull_fraction=area_m2(home) / hull.area,
        perimeter_per_area=perimeter_cells(free) * home.resolution_m / area_m2(home),
        islands_per_100_m2=100 * (ndimage.label(np.pad(~free, 1, constant_values=True))[1] - 1) / area_m2(home),
        room_m2=area_m2(home) / room_count(free, home.resolution_m),
        segments_per_m=len(outlines.segments) / outline_m,
        segments_per_m2=len(outlines.segments) / area_m2(home),
        visible_fraction=float(np.mean(solid_m == 0)),
        los_fraction=float(is_los.mean()),
        nlos_fraction=float(np.mean(~is_los & ~is_outage)),
        outage_fraction=float(is_outage.mean()),
        link_m=distance_m.mean(),
        solid_fraction=float(np.mean(solid_m / distance_m)),
        unobserved_fraction=float(np.mean(unobserved_m / distance_m)),
    )
    return Measured(statistics, rate(distance_m, is_los), rate(distance_m, is_outage))


def random_links(
    home: sp.PartialMap, seed: int
) -> tuple[sp.TracedLinks, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Trace links between random free positions; also their lengths, and those outside free and observed cells [m]."""
    rng = np.random.default_rng(seed)
    free = home.state == sp.CellState.FREE
    cells = rng.permutation(np.argwhere(free))[: TRANSMITTERS + RECEIVERS, ::-1] + 0.5
    positions = np.column_stack([cells * home.resolution_m + home.origin_m, np.full(len(cells), HEIGHT_M)])
    tx, rx = positions[:TRANSMITTERS], positions[TRANSMITTERS:]
    rx = rx[np.linalg.norm(rx[:, None] - tx, axis=2).min(axis=1) > NEAREST_M]
    solid = replace(home, state=np.where(free, sp.CellState.FREE, sp.CellState.UNKNOWN))
    seen = sp.explore(home, (STEPS,), seed=seed)[0]
    missing_m = [
        np.concatenate([unobserved_lengths_m(partial, position, rx) for position in tx]) for partial in (solid, seen)
    ]
    return sp.trace_links(home, tx, rx), np.linalg.norm(rx - tx[:, None], axis=2).ravel(), *missing_m


def perimeter_cells(free: NDArray[np.bool_]) -> float:
    """Length of the border of the free area [cells], by the crossings of lines in four directions (Crofton)."""
    f = np.pad(free, 1)
    straight = (f[:, 1:] != f[:, :-1]).sum() + (f[1:] != f[:-1]).sum()
    diagonal = (f[1:, 1:] != f[:-1, :-1]).sum() + (f[1:, :-1] != f[:-1, 1:]).sum()
    return math.pi / 8 * (straight + diagonal / math.sqrt(2))


def room_count(free: NDArray[np.bool_], resolution_m: float) -> int:
    """Count the parts that passages of at most `PASSAGE_M` join."""
    labels, _ = ndimage.label(ndimage.distance_transform_edt(free) * resolution_m > PASSAGE_M / 2)
    return max(1, int((np.bincount(labels.ravel())[1:] * resolution_m**2 > SMALLEST_CORE_M2).sum()))


def rate(distance_m: NDArray[np.float64], chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Fraction (bins,) of the links of each distance that are chosen; NaN where there are too few links."""
    links, hits = (np.histogram(values, EDGES_M)[0] for values in (distance_m, distance_m[chosen]))
    return np.where(links >= FEWEST_LINKS, hits / np.maximum(links, 1), math.nan)


def table(groups: dict[str, list[Measured]]) -> Iterator[str]:
    """Lines of the table, as Markdown: mean and spread over homes, and how far ours are from the real ones."""
    both = REAL in groups and OURS in groups
    heads = ["", *(f"{name} ({len(homes)})" for name, homes in groups.items())]
    heads += ["means apart", "ratio of spreads"] if both else []
    yield "| " + " | ".join(heads) + " |"
    yield "|---" * len(heads) + "|"
    for label, values in columns(groups).items():
        row = [label, *(f"{plain(np.nanmean(each))} ± {plain(np.nanstd(each))}" for each in values.values())]
        if both:
            real, ours = values[REAL], values[OURS]
            row.append(f"{(np.nanmean(ours) - np.nanmean(real)) / np.nanstd(real):+.1f}")
            row.append(f"{np.nanstd(ours) / np.nanstd(real):.1f}")
        yield "| " + " | ".join(row) + " |"


def plain(number: float) -> str:
    """Write a number with about three digits and no exponent."""
    return f"{number:.0f}" if number >= 100 else f"{number:.1f}" if number >= 10 else f"{number:.2f}"


def columns(groups: dict[str, list[Measured]]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Values (homes,) of each group under each label of the table."""
    found = {
        label: {name: np.array([getattr(home.statistics, key) for home in homes]) for name, homes in groups.items()}
        for key, label in LABELS.items()
    }
    for key, state in (("los_rate", "LOS"), ("outage_rate", "outage")):
        for bin_, (low, high) in enumerate(itertools.pairwise(EDGES_M)):
            found[f"{state} at {low:g} to {high:g} m"] = {
                name: np.array([getattr(home, key)[bin_] for home in homes]) for name, homes in groups.items()
            }
    return found


def draw(groups: dict[str, list[Measured]]) -> Figure:
    """Draw the distribution of each statistic, and the rates against distance with their spread over homes."""
    figure = Figure(figsize=(7.2, 9.4), layout="constrained", dpi=160)
    *panels, los, outage, legend = figure.subplots(6, 3).ravel()
    for axis, (key, label) in zip(panels, LABELS.items(), strict=True):
        for row, (name, homes) in enumerate(groups.items()):
            values = [getattr(home.statistics, key) for home in homes]
            style = {"facecolor": COLOURS[name], "alpha": 0.3}
            axis.boxplot(
                [values],
                positions=[row],
                orientation="horizontal",
                whis=(5, 95),
                widths=0.6,
                patch_artist=True,
                showfliers=False,
                boxprops=style,
                medianprops={"color": "black"},
            )
            axis.plot(values, row + np.linspace(-0.2, 0.2, len(values)), ".", color=COLOURS[name], markersize=2)
        axis.set(xlim=(0, None), yticks=[], ylim=(len(groups) - 0.5, -0.5))
        axis.set_xlabel(label, fontsize=8)
        axis.tick_params(labelsize=7)
    draw_rates(los, groups, "los_rate", "links in LOS")
    draw_rates(outage, groups, "outage_rate", "links in outage")
    legend.legend(*los.get_legend_handles_labels(), loc="center", frameon=False, fontsize=9)
    legend.set_axis_off()
    return figure


def draw_rates(axis: Axes, groups: dict[str, list[Measured]], key: str, label: str) -> None:
    """Draw mean rates against distance, with bands of one standard deviation over homes."""
    middle_m = (EDGES_M[1:] + EDGES_M[:-1]) / 2
    for name, homes in groups.items():
        rates = np.array([getattr(home, key) for home in homes])
        counted = (~np.isnan(rates)).sum(axis=0) > 1
        mean, spread = np.nanmean(rates[:, counted], axis=0), np.nanstd(rates[:, counted], axis=0)
        axis.plot(middle_m[counted], mean, color=COLOURS[name], label=name)
        axis.fill_between(middle_m[counted], mean - spread, mean + spread, color=COLOURS[name], alpha=0.15, linewidth=0)
    axis.set(ylim=(0, 1), xlim=(0, None))
    axis.set_xlabel("distance [m]", fontsize=8)
    axis.set_ylabel(label, fontsize=8)
    axis.tick_params(labelsize=7)


def draw_homes() -> Figure:
    """Draw homes of each kind, a row each."""
    homes = {kind: [sp.make_home(FIRST_SEED + k, kind) for k in range(count)] for kind, count in SHEET.items()}
    rows = {f"{kind}s": [(f"{area_m2(home):.0f} m²", home) for home in each] for kind, each in homes.items()}
    return draw_sheet(rows, gap_m=2.0)


def area_m2(home: sp.PartialMap) -> float:
    """Area of the free cells [m^2]."""
    return float((home.state == sp.CellState.FREE).sum()) * home.resolution_m**2


def draw_sheet(rows: dict[str, list[tuple[str, sp.PartialMap]]], gap_m: float) -> Figure:
    """Draw maps with their names in rows, all at one scale: free white, walls black, the rest grey."""
    sizes = [[np.subtract(home.bounds_m[2:], home.bounds_m[:2]) for _, home in row] for row in rows.values()]
    width = max(sum(size[0] + gap_m for size in row) for row in sizes)
    heights = [max(size[1] for size in row) + gap_m + 0.03 * width for row in sizes]
    figure = Figure(figsize=(SHEET_IN, SHEET_IN * sum(heights) / width + 0.3), layout="constrained", dpi=200)
    axis = figure.add_subplot()
    tops = np.cumsum([0.0, *heights])
    for row, row_sizes, y in zip(rows.values(), sizes, tops[1:], strict=True):
        slack = (width - sum(size[0] for size in row_sizes)) / len(row)
        x = slack / 2
        for (name, home), (w, h) in zip(row, row_sizes, strict=True):
            shades = np.choose(home.state, [255, 0, 200])
            axis.imshow(shades[::-1], "gray", vmin=0, vmax=255, extent=(x, x + w, y, y - h))
            axis.text(x + w / 2, y - h - 0.004 * width, name, ha="center", va="bottom", fontsize=6)
            x += w + slack
    axis.set(xlim=(0, width), ylim=(tops[-1] + gap_m / 2, 0), aspect="equal", yticks=(tops[:-1] + tops[1:]) / 2)
    axis.set_yticklabels(rows, rotation=90, va="center", fontsize=7)
    axis.set_xlabel("all at one scale [m]", fontsize=7)
    axis.tick_params(axis="y", length=0)
    axis.tick_params(axis="x", labelsize=7)
    axis.spines[["left", "right", "top"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main()
