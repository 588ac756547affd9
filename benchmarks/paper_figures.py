"""The results of the paper again, with its predictor and its set-up: 8 homes to train on, 4 others to test on.

Made are the accuracy of the link state and the error of the path gain against the steps of exploration (paper, Fig. 6),
the maps of one test home with nothing and with a part of it observed (paper, Fig. 5), and checks of both ends: with
nothing observed the prediction is a function of the distance alone, and on a complete map it is the trace. The paper
does not say how an outage counts in its error, so several definitions are shown. All is repeated with other robots,
transmitters, receivers and first weights; only the homes stay.

Without --homes, the homes are procedural ones that the shipped predictor was not trained on: `make_home` with
consecutive seeds, an apartment and a house in turn. Run it with

    python benchmarks/paper_figures.py --out paper-output
    python benchmarks/paper_figures.py --out paper-output-gibson --homes ../shared/gibson
"""

import argparse
import csv
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.demo import NOTHING, PARTIAL, TRUTH, comparison_table
from sionna_partial.files import atomic_files
from sionna_partial.lab.datasets.home_links import closed_home, home_links, home_sources, map_area
from sionna_partial.lab.datasets.table import LinkTable
from sionna_partial.lab.metrics import measure
from sionna_partial.plots.coverage_plot import plot_comparison
from sionna_partial.plots.style import BLUE, RED, figure_png
from sionna_partial.settings import PredictorSettings
from sionna_partial.worlds.homes import HomeKind

Homes = dict[str, sp.PartialMap]

TRAIN = ("Adrian", "Bowlus", "Brevort", "Capistrano", "Colebrook", "Dryville", "Goffs", "Hominy")
TEST = ("Shelbiana", "Kerrtown", "Micanopy", "Sodaville")
"""Homes of the Gibson set; Shelbiana is the example of the paper."""

PAPER = {0: {"accuracy": 0.65, "rmse_db": 18.0}, 200: {"accuracy": 0.90, "rmse_db": 11.0}}
"""What the paper reports of its test homes, about, by exploration steps."""

EXAMPLE_STEPS, EXAMPLE_SEEN, EXAMPLE_ROBOTS = 150, 0.51, 30
"""Of so many robots, the example shows the one whose observed fraction is nearest to that of the paper."""

DISTANCES_M = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Distances at which predictions with nothing observed are compared [m]."""

ROUNDING = 1e-4
"""What the single precision of the networks may do to probabilities [1] and gains [dB]."""

MEASURES = {
    "accuracy": "accuracy of the link state",
    "rmse_db": "(a) RMSE with outages at -150 dB [dB]",
    "rmse_linked_db": "(b) RMSE without outages [dB]",
    "rmse_given_state_db": "(c) RMSE given the true state [dB]",
}

HEAD = """Link state and path gain by exploration steps: mean of {repeats} repetitions, and their standard deviation
Training homes: {train}
Test homes: {test}
{links} links in each home, with receivers indoors

(a) all links; an outage counts -150 dB in truth and in the predictive mean
(b) the same predictive mean, over the links that are not in outage in truth
(c) over these links, the mean given the true link state
both observed: fraction of links with transmitter and receiver in observed cells; accuracy and (a) over these
"""


@dataclass(frozen=True)
class Score:
    """Figures of one repetition at one stage: `Metrics`, and the error given the true link state.

    Those of links with both ends in observed cells are nan where there are none.
    """

    homes: str
    step: int
    repetition: int
    links: int
    observed_fraction: float
    outages: float
    accuracy: float
    rmse_db: float
    rmse_linked_db: float
    rmse_given_state_db: float
    both_ends_seen: float
    both_ends_seen_accuracy: float
    both_ends_seen_rmse_db: float


@dataclass(frozen=True)
class Ends:
    """Both ends of one home; spreads and errors are largest values and root mean squares.

    Nothing observed: differences between predictions at equal distance. Complete: the coverage map and the networks,
    which are not used there, against the trace.
    """

    home: str
    links_of_equal_distance: int
    spread_of_probabilities: float
    spread_of_gains_db: float
    links: int
    accuracy: float
    rmse_db: float
    networks_accuracy: float
    networks_rmse_db: float


def main() -> None:
    """Repeat the experiment, print and draw what came out, and check both ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("paper-output"))
    parser.add_argument("--homes", type=Path, help="folder of complete maps; default: procedural homes")
    parser.add_argument("--first-seed", type=int, default=30_000, help="of the procedural homes")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--links", type=int, default=400, help="of each home")
    arguments = parser.parse_args()
    train, test = read_homes(arguments.homes) if arguments.homes else made_homes(arguments.first_seed)
    scores, fitted = [], []
    for repetition in range(arguments.repeats):
        links = all_links(train | test, arguments.links, repetition)
        fitted.append(fit(links, list(train), repetition))
        for kind, homes in (("train", train), ("test", test)):
            scores += rate(fitted[-1], links, homes, kind, repetition)
    example, predictor = next(iter(test)), fitted[0]
    positions = transmitters(arguments.homes, example, test[example])
    coverages, caption = example_maps(example, test[example], positions, predictor)
    ends = [check_ends(name, home, predictor) for name, home in test.items()]
    head = HEAD.format(repeats=arguments.repeats, train=", ".join(train), test=", ".join(test), links=arguments.links)
    table = "\n".join([head, score_table(scores), caption, "", comparison_table(coverages), ends_table(ends)])
    print(table)
    results = {
        "paper": PAPER,
        "scores": [
            {name: None if value != value else value for name, value in asdict(each).items()} for each in scores
        ],
        "example": caption,
        "ends": [asdict(each) for each in ends],
    }
    with atomic_files(arguments.out) as folder:
        (folder / "table.txt").write_text(table + "\n", encoding="utf-8")
        (folder / "results.json").write_text(json.dumps(results, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        (folder / "paper_curves.png").write_bytes(figure_png(draw_curves(scores, list(test))))
        (folder / "paper_maps.png").write_bytes(
            figure_png(plot_comparison(coverages, ("state_mixture", "gain_mean_db")))
        )
    print(f"wrote paper_curves.png, paper_maps.png, table.txt and results.json to {arguments.out}")
    require_both_ends(ends)


def made_homes(first_seed: int) -> tuple[Homes, Homes]:
    """Make 8 training and 4 test homes, apartments and houses in turn."""
    in_turn: tuple[HomeKind, ...] = ("apartment", "house")
    kinds = itertools.islice(itertools.cycle(in_turn), len(TRAIN) + len(TEST))
    homes = {f"{kind} {seed}": sp.make_home(seed, kind) for seed, kind in enumerate(kinds, first_seed)}
    return split(homes, list(homes)[: len(TRAIN)], list(homes)[len(TRAIN) :])


def read_homes(folder: Path) -> tuple[Homes, Homes]:
    """Read the Gibson homes that have reference traces, or else the first 12 homes of a folder."""
    sources = {source.name: source for source in home_sources([folder])}
    wanted = [*TRAIN, *TEST] if set(TRAIN + TEST) <= sources.keys() else list(sources)[: len(TRAIN) + len(TEST)]
    if len(wanted) < len(TRAIN) + len(TEST):
        raise SystemExit(f"--homes {folder} has {len(wanted)} homes: give a folder with {len(TRAIN) + len(TEST)}.")
    return split(
        {name: closed_home(sources[name].load(), name) for name in wanted}, wanted[: len(TRAIN)], wanted[len(TRAIN) :]
    )


def split(homes: Homes, train: list[str], test: list[str]) -> tuple[Homes, Homes]:
    """Part homes by name."""
    return {name: homes[name] for name in train}, {name: homes[name] for name in test}


def all_links(homes: Homes, count: int, repetition: int) -> LinkTable:
    """Trace links of all homes at all stages, with receivers indoors."""
    settings = sp.lab.DatasetSettings(links_per_home=count, seed=repetition)
    links = LinkTable.concatenate(home_links(home, name, settings) for name, home in homes.items())
    return links.take(~links.anywhere)


def fit(links: LinkTable, homes: list[str], repetition: int) -> sp.Predictor:
    """Fit the paper's predictor to the links of some homes, all stages together."""
    some = links.take(np.isin(links.home, homes))
    settings = PredictorSettings(seed=repetition)
    return sp.Predictor.fit(some.phi, some.link_state, some.gain_db, homes=homes, settings=settings)


def rate(predictor: sp.Predictor, links: LinkTable, homes: Homes, kind: str, repetition: int) -> list[Score]:
    """Measure a predictor on some homes, stage by stage."""
    scores = []
    for step in map(int, np.unique(links.stage)):
        some = links.take(np.isin(links.home, list(homes)) & (links.stage == step))
        answer = predictor.predict(some.phi)
        metrics = measure(answer, some.link_state, some.gain_db)
        seen = some.context.tx_seen & some.context.rx_seen
        of_seen = measure(answer.take(seen), some.link_state[seen], some.gain_db[seen])
        score = Score(
            homes=kind,
            step=step,
            repetition=repetition,
            links=len(some),
            observed_fraction=float(some.observed_fraction.mean()),
            outages=float(np.mean(some.link_state == sp.LinkState.OUTAGE)),
            accuracy=metrics.accuracy,
            rmse_db=metrics.rmse_db,
            rmse_linked_db=metrics.rmse_linked_db,
            rmse_given_state_db=error_given_state_db(answer, some),
            both_ends_seen=float(seen.mean()),
            both_ends_seen_accuracy=of_seen.accuracy,
            both_ends_seen_rmse_db=of_seen.rmse_db,
        )
        scores.append(score)
    return scores


def error_given_state_db(answer: sp.LinkPrediction, links: LinkTable) -> float:
    """Root mean square error of the mean gain given the true link state, over links not in outage [dB]."""
    mean_db = np.where(links.link_state == sp.LinkState.LOS, answer.gain_los_mean_db, answer.gain_nlos_mean_db)
    error_db = (mean_db - links.gain_db)[links.link_state != sp.LinkState.OUTAGE]
    return float(np.sqrt(np.mean(error_db**2)))


def transmitters(folder: Path | None, name: str, home: sp.PartialMap) -> NDArray[np.float64]:
    """Places of transmitters in a home (T, 3) [m]: those of its `tx.csv`, if there is one, else any."""
    path = folder / name / "tx.csv" if folder else None
    if path is None or not path.is_file():
        return free_places(home, 20)
    with path.open(newline="", encoding="utf-8") as stream:
        return np.array([[float(row[axis]) for axis in "xyz"] for row in csv.DictReader(stream)])


def example_maps(
    name: str, home: sp.PartialMap, positions: NDArray[np.float64], predictor: sp.Predictor
) -> tuple[dict[str, xr.Dataset], str]:
    """Predict the coverage of a home, of nothing of it, and of a part of it, and describe which part.

    The transmitter is at the first of the positions that the robot has observed.
    """
    area = map_area(home, 0.0)
    robots = [sp.explore(area, steps=(0, EXAMPLE_STEPS), seed=seed) for seed in range(EXAMPLE_ROBOTS)]
    chosen = int(np.argmin([abs(known.observed_fraction - EXAMPLE_SEEN) for _, known in robots]))
    nothing, known = robots[chosen]
    tx = positions[np.argmax(known.state_at(positions) == sp.CellState.FREE)]
    maps = {TRUTH: area, NOTHING: nothing, PARTIAL: known}
    coverages = {title: sp.predict_map(partial, tx, predictor=predictor) for title, partial in maps.items()}
    inside = int((coverages[TRUTH]["valid"] & (coverages[TRUTH]["cell_state"] == sp.CellState.FREE)).sum())
    x0, y0, x1, y1 = area.bounds_m
    caption = (
        f"Example: {name}, {x1 - x0:.1f} x {y1 - y0:.1f} m, {coverages[TRUTH]['valid'].size} positions 0.15 m apart, "
        f"{inside} of them indoors;\n{100 * known.observed_fraction:.0f} % observed after {EXAMPLE_STEPS} steps "
        f"(robot {chosen} of {EXAMPLE_ROBOTS}, the nearest to the paper's {100 * EXAMPLE_SEEN:.0f} %)"
    )
    return coverages, caption


def check_ends(name: str, home: sp.PartialMap, predictor: sp.Predictor) -> Ends:
    """Compare predictions with nothing observed at equal distances, and those on the complete map with the trace."""
    links, probabilities, gains_db = nothing_observed(home, predictor)
    tx = free_places(home, 1)[0]
    coverage = sp.predict_map(home, tx, predictor=predictor)
    valid = coverage["valid"].to_numpy() & (coverage["cell_state"] == sp.CellState.FREE).to_numpy()
    y, x = (axis[valid] for axis in np.meshgrid(coverage["y"], coverage["x"], indexing="ij"))
    truth = sp.trace_links(home, tx, np.column_stack([x, y, np.full(len(x), coverage.attrs["rx_height_m"])]))
    networks = predictor.predict(sp.link_features(home, truth))
    gain_db = coverage["gain_mean_db"].to_numpy()[valid]
    return Ends(
        home=name,
        links_of_equal_distance=links,
        spread_of_probabilities=probabilities,
        spread_of_gains_db=gains_db,
        links=len(x),
        accuracy=float(np.mean(coverage["link_state"].to_numpy()[valid] == truth.link_state)),
        rmse_db=float(np.sqrt(np.mean((gain_db - truth.gain_db.astype(np.float32)) ** 2))),
        networks_accuracy=float(np.mean(networks.link_state == truth.link_state)),
        networks_rmse_db=float(np.sqrt(np.mean((networks.gain_mean_db - truth.gain_db) ** 2))),
    )


def nothing_observed(home: sp.PartialMap, predictor: sp.Predictor) -> tuple[int, float, float]:
    """Predict from 20 positions in 20 directions to each distance: links, largest spread of probabilities, of gains."""
    (nothing,) = sp.explore(map_area(home, max(DISTANCES_M)), steps=(0,))
    angle = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, (20, len(DISTANCES_M)))
    away = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1) * np.array(DISTANCES_M)[:, None]
    tx = list(free_places(home, 20))
    simulation = sp.Simulation(nothing)
    links = [simulation.links(position, (position + away).reshape(-1, 3)) for position in tx]
    phi = sp.LinkFeatures.concatenate([sp.link_features(nothing, each) for each in links])
    answer = predictor.predict(phi)
    spreads = {
        column: np.ptp(values.reshape(-1, len(DISTANCES_M)), axis=0).max() for column, values in asdict(answer).items()
    }
    probabilities = max(spread for column, spread in spreads.items() if column.startswith("p_"))
    return len(phi), float(probabilities), float(max(spread for c, spread in spreads.items() if c.startswith("gain_")))


def free_places(home: sp.PartialMap, count: int) -> NDArray[np.float64]:
    """Draw positions (count, 3) in free cells, 1.5 m high [m]."""
    rows, columns = np.nonzero(home.state == sp.CellState.FREE)
    index = np.random.default_rng(0).integers(len(rows), size=count)
    position = home.origin_m + (np.stack([columns, rows], axis=1)[index] + 0.5) * home.resolution_m
    return np.column_stack([position, np.full(count, 1.5)])


def score_table(scores: list[Score]) -> str:
    """Tabulate scores, a line for each stage, with the paper's next to them."""
    heads = ("homes", "steps", "observed", "outages", "accuracy", "(a) [dB]", "(b) [dB]", "(c) [dB]")
    lines = [_line(heads, "both observed", "paper")]
    for kind, step in itertools.product(("test", "train"), sorted({score.step for score in scores})):
        some = [asdict(score) for score in scores if (score.homes, score.step) == (kind, step)]
        columns = {name: np.array([score[name] for score in some]) for name in some[0] if name != "homes"}
        means = {name: values.mean() for name, values in columns.items()}
        cells = [f"{means['observed_fraction']:.2f}", f"{means['outages']:.2f}"]
        for name in MEASURES:
            digits = 3 if name == "accuracy" else 1
            cells.append(f"{means[name]:.{digits}f} ± {columns[name].std():.{digits}f}")
        fraction, accuracy, rmse_db = (means[f"both_ends_seen{name}"] for name in ("", "_accuracy", "_rmse_db"))
        both = f"{fraction:.2f}: {accuracy:.3f}, {rmse_db:.1f} dB" if fraction else "-"
        reported = PAPER.get(step) if kind == "test" else None
        paper = f"{reported['accuracy']:.2f}, {reported['rmse_db']:.0f} dB" if reported else "-"
        lines.append(_line((kind, step, *cells), both, paper))
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[object], both: str, paper: str) -> str:
    home, step, seen, outages, *figures = cells
    narrow = f"{home:>5}{step:>7}{seen:>9}{outages:>9}"
    return narrow + "".join(f"{figure:>15}" for figure in figures) + f"{both:>24}{paper:>14}"


def ends_table(ends: list[Ends]) -> str:
    """Tabulate both ends, a line for each home."""
    lines = [
        "Both ends. Nothing observed: largest difference between predictions at equal distance, over "
        f"{len(DISTANCES_M)} distances,",
        "20 positions and 20 directions. Complete map: the prediction against the trace, and against the networks,",
        "which are not used there.",
        "",
        f"{'home':>18}{'probability':>14}{'gain [dB]':>12}{'accuracy':>12}{'RMSE [dB]':>12}{'networks alone':>20}",
    ]
    for each in ends:
        networks = f"{each.networks_accuracy:.3f}, {each.networks_rmse_db:.1f} dB"
        spreads = f"{each.spread_of_probabilities:>14.1e}{each.spread_of_gains_db:>12.1e}"
        lines.append(f"{each.home:>18}{spreads}{each.accuracy:>12.3f}{each.rmse_db:>12.3f}{networks:>20}")
    return "\n".join(lines) + "\n"


def require_both_ends(ends: list[Ends]) -> None:
    """Fail unless the predictions interpolate."""
    for each in ends:
        equal = max(each.spread_of_probabilities, each.spread_of_gains_db) <= ROUNDING
        if not equal or each.accuracy != 1.0 or each.rmse_db != 0.0:
            raise SystemExit(f"{each.home}: the prediction does not interpolate, {each}")
    print("both ends hold in all test homes")


def draw_curves(scores: list[Score], test: list[str]) -> Figure:
    """Draw each measure against the steps of exploration, test and train; bands hold all repetitions."""
    figure = Figure(figsize=(7.2, 6.0), layout="constrained", dpi=170)
    steps = sorted({score.step for score in scores})
    axes = figure.subplots(2, 2, sharex=True).ravel()
    for axis, (name, label) in zip(axes, MEASURES.items(), strict=True):
        for kind, colour, marker in (("test", BLUE, "o"), ("train", RED, "s")):
            some = [score for score in scores if score.homes == kind]
            values = np.array([[getattr(score, name) for score in some if score.step == step] for step in steps])
            axis.plot(steps, values.mean(axis=1), color=colour, marker=marker, label=f"{kind} homes")
            axis.fill_between(steps, values.min(axis=1), values.max(axis=1), color=colour, alpha=0.2, linewidth=0)
        paper = [reported["accuracy" if name == "accuracy" else "rmse_db"] for reported in PAPER.values()]
        axis.plot(list(PAPER), paper, "*", color="black", markersize=11, fillstyle="none", label="paper, test homes")
        axis.set(title=label, ylim=(0.5, 1.0) if name == "accuracy" else (0, 26))
        axis.title.set_fontsize("medium")
        axis.set_xticks(steps)
        axis.grid(alpha=0.3)
    for axis in axes[2:]:
        axis.set_xlabel("exploration steps")
    figure.suptitle(f"Test homes: {', '.join(test)}", fontsize="medium")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


if __name__ == "__main__":
    main()
