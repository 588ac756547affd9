"""What each input of the predictor adds: variants with more and more inputs, trained on the same links.

Most homes of a data set are used for training, the others for testing. The variants are also tested on the homes of
further data sets, such as real ones, explored several times. All are trained, which takes minutes to hours; --also
tests predictors that have been trained before, on homes that they were not trained on. The output are Markdown tables:
accuracy, gain error and calibration at each stage of exploration, and paired differences over homes. Run it with

    sionna-partial dataset homes --homes 300 --first-seed 10000
    for seed in 0 1 2 3; do sionna-partial dataset gibson-$seed --homes 0 --map ../shared/gibson --seed $seed; done
    python benchmarks/ablation.py homes --test gibson-? --also shipped=map --out ablation.md
"""

import argparse
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.files import atomic_write
from sionna_partial.lab.datasets.shards import LinkTable, LinkTraces, open_links, require_like, settings_for
from sionna_partial.lab.evaluation import DEFINITIONS, Metrics, home_scores, mean_and_error, measure
from sionna_partial.lab.reports import markdown_table
from sionna_partial.lab.training.predictor import split_homes
from sionna_partial.settings import NetworkKind

SEED = 0
"""Of the split of the homes, and of the trainings."""


INDOORS = "Receivers were drawn indoors. A stage is the number of steps that the robot has explored."

DIFFERENCES = (
    "One minus the other on the same links: the mean over homes of the homes' differences ± its standard error, which "
    "does not include the variation between trainings."
)


@dataclass(frozen=True, eq=False)
class StageScore:
    """Figures of merit of a prediction at one stage: over all links, and over those of each home (H,)."""

    metrics: Metrics
    accuracies: NDArray[np.float64]
    rmses_db: NDArray[np.float64]


NAMES = {
    "accuracy": "accuracy",
    "rmse_db": "RMSE",
    "calibration_error": "calibration error",
    "coverage_90": "90 % interval",
}
"""What tables call the figures of merit."""

Scores = Mapping[int, StageScore]
"""By steps."""


@dataclass(frozen=True)
class Variant:
    """A predictor to train: its networks and their inputs."""

    networks: NetworkKind
    inputs: str


VARIANTS = {
    "paper": Variant("paper", "the paper's networks, with four features of a link"),
    "paths": Variant(
        "paths",
        "a network that also has what each path crosses, which ends are observed, and the walls on the direct line",
    ),
    "map": Variant("map", "in addition, a network that has the map around the transmitter"),
}
"""What is trained, each with more inputs than the one before."""

BASE = "paper"


@dataclass(frozen=True, eq=False)
class TestSet:
    """Links of homes that no variant is trained on."""

    title: str
    links: LinkTable
    traces: LinkTraces | None

    @property
    def homes(self) -> set[str]:
        """Their names."""
        return set(map(str, self.links.home))


def main() -> None:
    """Train, measure, and print the tables."""
    arguments = parse_arguments()
    links, traces = indoor_links(arguments.dataset)
    names = list(dict.fromkeys(map(str, links.home)))[: arguments.homes]
    train_homes, test_homes = split_homes(names, arguments.test_fraction, SEED)
    if not test_homes:
        raise SystemExit(f"--test-fraction {arguments.test_fraction:g} leaves no home to measure on: give more than 0.")
    held_out = TestSet("Homes held out", links.take(np.isin(links.home, test_homes)), traces)
    links = links.take(np.isin(links.home, train_homes))
    sets = [held_out, *(TestSet(f"Homes of {quoted(folders)}", *indoor_links(*folders)) for folders in arguments.test)]
    known = {name: sp.Predictor.load(path) for name, path in arguments.also}
    if len(known) < len(arguments.also):
        raise SystemExit("--also has a name twice: give each predictor a name of its own.")
    require_unknown_homes(sets, train_homes)
    require_same_traces(sets, traces, known)
    scores: list[dict[str, Scores]] = [{} for _ in sets]
    predictors = itertools.chain(trained(links, traces, arguments.passes), known.items())
    for name, predictor in predictors:
        for each, found in zip(sets, scores, strict=True):
            if each.homes.isdisjoint(predictor.homes):
                say(f"{name}: measuring, {each.title}")
                found[name] = score(predictor.predict(each.links.phi), each.links)
    head = introduction(arguments, links, known)
    report = "\n\n".join(
        [head, *(section(*pair, list(known)) for pair in zip(sets, scores, strict=True)), definitions()]
    )
    publish(report, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="folder that `sionna-partial dataset` wrote")
    parser.add_argument(
        "--test",
        type=Path,
        action="append",
        nargs="+",
        default=[],
        metavar="DATASET",
        help="data sets of other homes, measured as one; may be repeated",
    )
    parser.add_argument("--passes", type=int, default=6, help="how many times the networks see the links")
    parser.add_argument("--homes", type=int, help="of the data set, the first; default: all")
    parser.add_argument("--test-fraction", type=float, default=0.15, help="fraction of these homes that is held out")
    parser.add_argument(
        "--also", type=named_predictor, nargs="+", default=[], metavar="NAME=PREDICTOR", help=".keras file, or `map`"
    )
    parser.add_argument("--out", type=Path, help="Markdown file to write")
    return parser.parse_args()


def named_predictor(text: str) -> tuple[str, str]:
    """Part NAME=PREDICTOR."""
    name, _, path = text.partition("=")
    if not name or not path or name in VARIANTS:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not NAME=PREDICTOR with a new name: give for example shipped=map."
        )
    return name, path


def quoted(folders: list[Path]) -> str:
    """Name data sets."""
    return ", ".join(f"`{folder}`" for folder in folders)


def indoor_links(*folders: Path) -> tuple[LinkTable, LinkTraces | None]:
    """Read the links of data sets whose receivers were drawn indoors."""
    say(f"reading {', '.join(map(str, folders))}")
    links, traces = open_links(folders)
    return links.take(~links.anywhere), traces


def require_unknown_homes(sets: list[TestSet], train_homes: tuple[str, ...]) -> None:
    """Refuse to measure on homes that are trained on."""
    for each in sets:
        known = sorted(each.homes & set(train_homes))
        if known:
            raise SystemExit(f"{each.title}: {known[0]!r} is trained on, give a data set of other homes.")


def require_same_traces(sets: list[TestSet], traces: LinkTraces | None, known: dict[str, sp.Predictor]) -> None:
    """Refuse links that were traced otherwise than those of a training."""
    settings = {"the variants": settings_for(traces)} | {name: each.settings for name, each in known.items()}
    for (name, trained_on), each in itertools.product(settings.items(), sets):
        whose, remedy = f"{each.title}: {name} were fitted to links", "leave it out, or give links with such traces."
        require_like(each.traces, LinkTraces.of_settings(trained_on), whose, remedy)


def trained(links: LinkTable, traces: LinkTraces | None, passes: int) -> Iterator[tuple[str, sp.Predictor]]:
    """Train each variant in turn on the same links."""
    homes = list(dict.fromkeys(map(str, links.home)))
    for name, variant in VARIANTS.items():
        say(f"{name}: training on {len(links)} links in {len(homes)} homes")
        predictor = sp.Predictor.fit(
            links.phi,
            links.link_state,
            links.gain_db,
            homes=homes,
            settings=settings_for(traces, networks=variant.networks, passes=passes, seed=SEED),
            progress=narrator(name),
        )
        yield name, predictor


def narrator(name: str) -> Callable[[float, str], None]:
    """Return what reports the progress of a training."""
    return lambda fraction, message: say(f"{name}: {100 * fraction:.0f} %, {message}")


def introduction(arguments: argparse.Namespace, links: LinkTable, known: dict[str, sp.Predictor]) -> str:
    """State what was done, and what the names mean."""
    homes = len(np.unique(links.home))
    passes = "1 pass" if arguments.passes == 1 else f"{arguments.passes} passes"
    variants = [f"- **{name}**: {variant.inputs}" for name, variant in VARIANTS.items()]
    others = [f"- **{name}**: trained before, on {len(model.homes)} homes" for name, model in known.items()]
    lines = [
        "# What each input of the predictor adds",
        f"Trained on the same {len(links)} links in {homes} homes of `{arguments.dataset}`, with {passes} "
        f"of the networks that are not the paper's. {INDOORS} Each predictor has the inputs of those above it:",
        "\n".join(variants + others),
    ]
    return "\n\n".join(lines)


def section(tests: TestSet, found: dict[str, Scores], known: list[str]) -> str:
    """Tables of one set of homes."""
    left_out = [
        f"{name} is left out here: it was trained on some of these homes." for name in known if name not in found
    ]
    parts = [
        f"## {tests.title}",
        " ".join([f"Homes: {len(tests.homes)}; links at all stages: {len(tests.links)}.", *left_out]),
        stage_table("accuracy, RMSE [dB]", found.items(), "{accuracy:.3f}, {rmse_db:.2f}"),
        DIFFERENCES,
        difference_tables(list(comparisons(found))),
        stage_table("calibration error, 90 % interval", found.items(), "{calibration_error:.3f}, {coverage_90:.3f}"),
    ]
    return "\n\n".join(parts)


def comparisons(found: dict[str, Scores]) -> Iterator[tuple[str, Scores, Scores]]:
    """Pair each predictor with the one before it, and with the paper's."""
    for before, name in itertools.pairwise(found):
        for other in dict.fromkeys((before, BASE)):
            yield f"{name} minus {other}", found[name], found[other]


def score(prediction: sp.LinkPrediction, links: LinkTable) -> Scores:
    """Measure a prediction of links at each of their stages."""
    scores = {}
    for step in map(int, np.unique(links.stage)):
        here = links.stage == step
        some, given = links.take(here), prediction.take(here)
        scores[step] = StageScore(measure(given, some.link_state, some.gain_db), *home_scores(given, some))
    return scores


def stage_table(head: str, rows: Iterable[tuple[str, Scores]], cell: str) -> str:
    """Tabulate predictions by stage; `cell` formats the figures of merit, such as "{accuracy:.3f}"."""
    named = list(rows)
    cells = ([name, *(cell.format(**vars(each.metrics)) for each in scores.values())] for name, scores in named)
    return markdown_table(stage_header(head, named[0][1]), cells)


def difference_tables(pairs: Sequence[tuple[str, Scores, Scores]]) -> str:
    """Tabulate the first scores minus the second by stage: accuracy, then RMSE."""
    tables = []
    for head, name, form in (("accuracy", "accuracies", "+.3f"), ("RMSE [dB]", "rmses_db", "+.2f")):
        rows = (
            [title, *(_difference(getattr(one[step], name), getattr(other[step], name), form) for step in one)]
            for title, one, other in pairs
        )
        tables.append(markdown_table(stage_header(head, pairs[0][1]), rows))
    return "\n\n".join(tables)


def stage_header(head: str, scores: Scores) -> list[str]:
    """Head of a table with a column for each stage."""
    return [head, *(f"{step} steps" for step in scores)]


def definitions() -> str:
    """Section that defines the figures of merit."""
    return "## Definitions\n\n" + "\n".join(f"- {label}: {DEFINITIONS[name]}" for name, label in NAMES.items())


def publish(report: str, out: Path | None) -> None:
    """Print a report, and write it to a file if one is given."""
    print(report)
    if out:
        with atomic_write(out, "w") as stream:
            stream.write(report + "\n")
        say(f"wrote {out}")


def say(message: str) -> None:
    """Report progress."""
    print(message, file=sys.stderr, flush=True)


def _difference(one: NDArray[np.float64], other: NDArray[np.float64], form: str) -> str:
    mean, error = mean_and_error(one - other)
    return f"{mean:{form}} ± " + ("-" if np.isnan(error) else f"{error:{form.removeprefix('+')}}")


if __name__ == "__main__":
    main()
