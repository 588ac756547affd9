"""Train a predictor on some homes of a data set and evaluate it on the others."""

import json
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sionna_partial.checks import Progress, require_number, settings_or_default
from sionna_partial.display import Shown, part_of, reporting
from sionna_partial.errors import PredictorError, PredictorWarning
from sionna_partial.files import atomic_files, atomic_write
from sionna_partial.lab.baselines import Baselines
from sionna_partial.lab.datasets.traces import Dataset, LinkTraces, open_links, require_like, settings_for
from sionna_partial.lab.evaluation import Evaluation, evaluate
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import PredictorSettings

PREDICTOR_FILE, SPLIT_FILE = "predictor.keras", "split.json"

TEST_FRACTION = 0.3

FEW_HOMES = 20
"""Number of training homes below which the networks "map" may be worse than the distance alone."""


@dataclass(frozen=True, eq=False)
class TrainingRun(Shown):
    """Result of `train`: a predictor with test figures in its card, baselines, and the evaluation on test homes."""

    predictor: Predictor
    baselines: Baselines
    train_homes: tuple[str, ...]
    test_homes: tuple[str, ...]
    test_fraction: float
    evaluation: Evaluation | None

    def save(self, folder: str | Path) -> list[Path]:
        """Write predictor, baselines, their cards and `split.json`, all or none; return the files."""
        split = {
            "test_fraction": self.test_fraction,
            "seed": self.predictor.settings.seed,
            "train": list(self.train_homes),
            "test": list(self.test_homes),
        }
        with atomic_files(folder) as files:
            self.predictor.save(files / PREDICTOR_FILE)
            self.baselines.save(files)
            with atomic_write(files / SPLIT_FILE, "w") as stream:
                stream.write(json.dumps(split, indent=2) + "\n")
            names = sorted(file.name for file in files.iterdir())
        return [Path(folder) / name for name in names]


def split_homes(homes: list[str], test_fraction: float, seed: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Split homes at random into sorted training and test homes.

    The sorted names are shuffled by the seed; the first `test_fraction` of them, at least one and not all, are test
    homes. A fraction of 0 keeps none. The order of `homes` does not matter.
    """
    require_number("test_fraction", test_fraction, 0.0, 0.99)
    if len(homes) < (2 if test_fraction else 1):
        number = "1 home" if len(homes) == 1 else f"{len(homes)} homes"
        raise PredictorError(
            f"dataset has {number}: give at least 2 to train on some and test on others, or test_fraction = 0."
        )
    shuffled = np.random.default_rng(seed).permutation(sorted(homes))
    count = min(max(round(test_fraction * len(homes)), 1), len(homes) - 1) if test_fraction else 0
    return tuple(sorted(map(str, shuffled[count:]))), tuple(sorted(map(str, shuffled[:count])))


def train(
    dataset: Dataset,
    *,
    test_fraction: float = TEST_FRACTION,
    settings: PredictorSettings | None = None,
    progress: Progress | bool | None = None,
) -> TrainingRun:
    """Train a predictor and baselines on some homes, and evaluate them on the others.

    Homes are split at random; all links of a home are on one side. Link state and gain are learned from receivers drawn
    indoors, P(indoor) from receivers drawn anywhere but not in observed cells. Equal links and settings give equal
    files.

    Parameters
    ----------
    dataset : LinkTable, path, or sequence of paths
        Links, or folders of `sionna-partial dataset`; a home may be in several.
    test_fraction : float
        Fraction of test homes, in [0, 1).
    settings : PredictorSettings, optional
        By default networks "map", with a `PredictorWarning` for fewer than 20 homes, and the frequency, diffraction and
        paths through walls of the data set, which must be equal. The seed also splits the homes.
    progress : bool or callable, optional
        As in `predict_map`.

    Returns
    -------
    TrainingRun
        `save(folder)` writes it.

    Raises
    ------
    SettingsError
        For a fraction out of range.
    PredictorError
        If the data set cannot be read, was traced with other settings, or has too few homes or links; or if the
        training diverges.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> settings = sp.lab.PredictorSettings("paper")
    >>> run = sp.lab.train("links", test_fraction=0.0, settings=settings)  # that build_dataset wrote
    >>> run.train_homes
    ('make_home(7)',)
    """
    table, traces = open_links(dataset)
    settings = settings_for(traces) if settings is None else settings
    settings = settings_or_default("settings", settings, PredictorSettings)
    remedy = "give PredictorSettings with frequency_hz, diffraction and through_walls of the data set."
    require_like(traces, LinkTraces.of_settings(settings), "settings are for links", remedy)
    train_homes, test_homes = split_homes(list(dict.fromkeys(map(str, table.home))), test_fraction, settings.seed)
    links = table.take(np.isin(table.home, train_homes))
    indoors, unsure = links.take(~links.anywhere), links.take(links.anywhere & ~links.context.rx_seen)
    if settings.networks == "map" and len(train_homes) < FEW_HOMES:
        what = f"the networks 'map' are trained on {len(train_homes)} homes, fewer than {FEW_HOMES}"
        remedy = "choose the networks 'paper' (PredictorSettings('paper'), --networks paper), or make more homes."
        warnings.warn(f"{what}, and may be worse than the distance alone: {remedy}", PredictorWarning, stacklevel=2)
    with reporting(progress) as report:
        report(0.0, f"training on {len(indoors)} links in {len(train_homes)} homes")
        predictor = Predictor.fit(
            indoors.features,
            indoors.link_state,
            indoors.gain_db,
            homes=train_homes,
            settings=settings,
            progress=part_of(report, 0.0, 0.6),
        )
        predictor = predictor.fit_indoor(unsure.features, unsure.inside)
        report(0.6, "training the baselines")
        baselines = Baselines.fit(indoors, settings)
        run = TrainingRun(predictor, baselines, train_homes, test_homes, test_fraction, None)
        if not test_homes:
            return run
        tests = table.take(np.isin(table.home, test_homes))
        result = evaluate(predictor, tests, baselines=baselines, progress=part_of(report, 0.7, 1.0))
    return replace(run, predictor=replace(predictor, metrics=_card_metrics(result)), evaluation=result)


def _card_metrics(evaluation: Evaluation) -> dict[str, Any]:
    """Return the figures of test homes for the card, by receivers, stage and predictor.

    The shipped paper's predictor is left out, so that a card does not depend on the shipped predictors.
    """
    metrics: dict[str, Any] = {"held_out_homes": list(evaluation.homes["test"])}
    for receivers, name in (("indoor", "exploration_steps"), ("anywhere", "exploration_steps_receivers_anywhere")):
        stages: dict[str, dict[str, Any]] = {}
        for row in evaluation.select(homes="test", receivers=receivers, ends_seen="all"):
            if row.model != "paper":
                stages.setdefault(f"{row.stage:g}", {})[row.model] = row.metrics.as_json()
        metrics[name] = stages
    return metrics
