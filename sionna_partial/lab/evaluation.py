"""Evaluation of a predictor and baselines on training and test homes."""

import itertools
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sionna_partial.arrays import Floats
from sionna_partial.checks import Progress, shown
from sionna_partial.display import Shown, reporting
from sionna_partial.errors import PredictorError
from sionna_partial.lab.baselines import MAJORITY_FILE, Baselines, baseline_predictions
from sionna_partial.lab.datasets.table import LinkTable, stage_name
from sionna_partial.lab.datasets.traces import Dataset, LinkTraces, open_links, require_like
from sionna_partial.lab.metrics import Calibration, Metrics, calibration, gain_errors_db, mean, measure
from sionna_partial.prediction.predictor import Predictor, warm_predictor
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.resources import PREDICTORS_FOLDER

_log = logging.getLogger(__name__)

ENDS_SEEN = {"both": 2, "one": 1, "none": 0}
"""Number of ends of a link in observed cells."""

WITHOUT_INDOOR, WITH_INDOOR = "without indoor model", "with indoor model"
"""Predictions for receivers anywhere."""

ALWAYS_OUTAGE = "always outage"

FEWEST_HOMES = 5
"""Number of test homes below which standard errors over homes have no meaning."""


@dataclass(frozen=True)
class Row:
    """Figures of merit of one prediction on a selection of links.

    Parameters
    ----------
    homes : {"test", "train"}
        The predictor was trained on "train" homes.
    receivers : {"indoor", "anywhere"}
    stage : float
        Exploration steps; below 1, the wanted observed fraction.
    ends_seen : {"all", "both", "one", "none"}
        All links, or by the number of ends in observed cells.
    model : str
        "predictor" or a baseline.
    metrics : Metrics
    accuracy_error, rmse_error_db : float
        Standard errors over homes of their accuracies and of their `rmse_db` [dB], nan for fewer than two homes.
    """

    homes: str
    receivers: str
    stage: float
    ends_seen: str
    model: str
    metrics: Metrics
    accuracy_error: float
    rmse_error_db: float


@dataclass(frozen=True)
class Difference:
    """Predictor minus baseline on the same links: mean and standard error over test homes, nan for one home."""

    receivers: str
    stage: float
    baseline: str
    homes: int
    accuracy: float
    accuracy_error: float
    rmse_db: float
    rmse_error_db: float


@dataclass(frozen=True, eq=False)
class Evaluation(Shown):
    """Result of `evaluate`.

    Parameters
    ----------
    predictor, fingerprint : str
        Name and SHA-256 of the predictor.
    homes : mapping of str to tuple of str
        Names of the "test" and "train" homes.
    rows : tuple of Row
    differences : tuple of Difference
    calibrations : mapping of float to Calibration
        Calibration on test homes, receivers indoors, by stage.
    notes : tuple of str
        Remarks for the reader.
    """

    predictor: str
    fingerprint: str
    homes: Mapping[str, tuple[str, ...]]
    rows: tuple[Row, ...]
    differences: tuple[Difference, ...]
    calibrations: Mapping[float, Calibration]
    notes: tuple[str, ...]

    def select(self, **wanted: object) -> list[Row]:
        """Return the rows with given field values, such as ``select(homes="test", stage=200)``."""
        return [row for row in self.rows if all(getattr(row, name) == value for name, value in wanted.items())]


def evaluate(
    predictor: Predictor | str | Path | None,
    dataset: Dataset,
    *,
    baselines: Baselines | None = None,
    progress: Progress | bool | None = None,
) -> Evaluation:
    """Evaluate a predictor and baselines on the links of a data set, stage by stage.

    Homes in the predictor's card are training homes, all others test homes. For receivers drawn anywhere, the predictor
    is evaluated with and without P(indoor); a receiver in an observed cell is indoors for certain.

    Parameters
    ----------
    predictor : None, "map", "paper", path or Predictor
    dataset : LinkTable, path, or sequence of paths
        Links, or folders of `sionna-partial dataset`; a home may be in several.
    baselines : Baselines, optional
        By default the baselines in the folder of the predictor, else the shipped ones.
    progress : bool or callable, optional
        As in `predict_map`.

    Returns
    -------
    Evaluation
        Figures of merit (`select` filters them), paired differences, calibrations and notes.

    Raises
    ------
        If the data set or a predictor cannot be read, the data set has no links or other traces than the predictor's,
        or the predictor was trained on all homes.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> evaluation = sp.lab.evaluate("paper", "links")  # that build_dataset wrote
    >>> (row,) = evaluation.select(stage=5, receivers="indoor", ends_seen="all", model="predictor")
    >>> row.metrics.links
    4
    """
    model = Predictor.load(predictor)
    links, traces = open_links(dataset)
    remedy = "choose another predictor, or build a data set with such traces."
    require_like(
        traces, LinkTraces.of_settings(model.settings), f"predictor '{model.name}' was trained on links", remedy
    )
    homes = _homes(model, links)
    if not isinstance(baselines, Baselines | None):
        raise PredictorError(
            f"baselines = {shown(baselines)} is not allowed: give Baselines, or None for those shipped."
        )
    fitted, shipped = baselines or Baselines.load(_baselines_folder(model)), _shipped(model)
    frequency_hz = model.settings.frequency_hz
    rows, differences, calibrations = [], [], {}
    parts = list(itertools.product(homes, map(float, np.unique(links.stage))))
    with reporting(progress) as report:
        for index, (name, stage) in enumerate(parts):
            report(index / len(parts), f"measuring on {name} homes at {stage_name(stage)}")
            part = links.take(np.isin(links.home, homes[name]) & (links.stage == stage))
            prediction = model.predict(part.features)
            for receivers in ("indoor", "anywhere"):
                drawn = part.anywhere == (receivers == "anywhere")
                if not drawn.any():
                    continue
                some, own = part.take(drawn), prediction.take(drawn)
                if receivers == "indoor":
                    others = baseline_predictions(fitted, shipped.get("paper"), some.features, frequency_hz)
                    predictions = {"predictor": own, **others}
                    if "map" in shipped:
                        predictions["map"] = shipped["map"].predict(some.phi)
                else:
                    predictions = _anywhere(model, some, own)
                rows += list(_rows(name, receivers, stage, some, predictions))
                if name == "test":
                    differences += list(_differences(receivers, stage, some, predictions))
                    if receivers == "indoor":
                        calibrations[stage] = calibration(own, some.link_state, some.gain_db)
    notes = tuple(_notes(model, {**shipped, "distance only": fitted.distance}, homes["test"]))
    return Evaluation(model.name, model.fingerprint, homes, tuple(rows), tuple(differences), calibrations, notes)


def home_scores(prediction: LinkPrediction, links: LinkTable) -> tuple[Floats, Floats]:
    """Return accuracy and root mean square gain error [dB] of each home (H,), sorted by name."""
    _, home, count = np.unique(links.home, return_inverse=True, return_counts=True)
    right = np.bincount(home, prediction.link_state == links.link_state)
    squares = np.bincount(home, gain_errors_db(prediction, links.link_state, links.gain_db) ** 2)
    return right / count, np.sqrt(squares / count)


def mean_and_error(values: Floats) -> tuple[float, float]:
    """Return the mean over homes (H,) and its standard error, nan for one home."""
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return mean(values), float(error)


def _anywhere(model: Predictor, links: LinkTable, indoors: LinkPrediction) -> dict[str, LinkPrediction]:
    p_indoor = np.where(links.context.rx_seen, 1.0, model.predict_indoor(links.features))
    outage = indoors.anywhere(np.zeros(len(links)))
    return {WITH_INDOOR: indoors.anywhere(p_indoor), WITHOUT_INDOOR: indoors, ALWAYS_OUTAGE: outage}


def _notes(model: Predictor, others: Mapping[str, Predictor], test: tuple[str, ...]) -> Iterator[str]:
    fitted = others["distance only"]
    those = "those" if set(fitted.homes) == set(model.homes) else "others than those"
    if len(test) < FEWEST_HOMES:
        count = "1 test home is" if len(test) == 1 else f"{len(test)} test homes are"
        yield f"{count} too few to compare predictors: homes differ by more than predictors. Evaluate on 20 or more."
    yield f"Majority and distance only were fitted to {len(fitted.homes)} homes, {those} of the predictor."
    for name, other in others.items():
        known = len(set(other.homes) & set(test))
        if known:
            yield f"{name!r} was trained on {known} of the {len(test)} test homes."


def _homes(model: Predictor, links: LinkTable) -> dict[str, tuple[str, ...]]:
    names = list(dict.fromkeys(map(str, links.home)))
    trained = set(model.homes)
    test, train = (tuple(name for name in names if (name in trained) == seen) for seen in (False, True))
    if not test:
        raise PredictorError(
            f"predictor '{model.name}' was trained on all {len(train)} homes of the data set: "
            "give a data set of other homes, such as other seeds, or train with test_fraction above 0."
        )
    return {"test": test} | ({"train": train} if train else {})


def _baselines_folder(model: Predictor) -> Path:
    beside = Path(model.name).parent
    return beside if model.name.endswith(".keras") and (beside / MAJORITY_FILE).is_file() else PREDICTORS_FOLDER


def _shipped(model: Predictor) -> dict[str, Predictor]:
    here, found = LinkTraces.of_settings(model.settings), {}
    for name in ("paper", "map"):
        try:
            shipped = warm_predictor(name)
        except PredictorError as error:  # older inputs: a training whose networks have others must not end here
            _log.warning("the shipped predictor %r is no baseline: %s", name, error)
            continue
        if here.is_like(LinkTraces.of_settings(shipped.settings)) and model.fingerprint != shipped.fingerprint:
            found[name] = shipped
    return found


def _rows(
    homes: str, receivers: str, stage: float, links: LinkTable, predictions: Mapping[str, LinkPrediction]
) -> Iterator[Row]:
    ends = links.context.tx_seen.astype(np.int64) + links.context.rx_seen
    cells = {"all": np.ones(len(links), dtype=bool)} | {name: ends == count for name, count in ENDS_SEEN.items()}
    for name, cell in cells.items():
        some = links.take(cell)
        for model, prediction in predictions.items():
            found = prediction.take(cell)
            errors = (mean_and_error(scores)[1] for scores in home_scores(found, some))
            measured = measure(found, some.link_state, some.gain_db)
            yield Row(homes, receivers, stage, name, model, measured, *errors)


def _differences(
    receivers: str, stage: float, links: LinkTable, predictions: Mapping[str, LinkPrediction]
) -> Iterator[Difference]:
    scores = {model: home_scores(prediction, links) for model, prediction in predictions.items()}
    first, *others = scores
    for baseline in others:
        accuracy, rmse_db = (one - other for one, other in zip(scores[first], scores[baseline], strict=True))
        yield Difference(receivers, stage, baseline, len(accuracy), *mean_and_error(accuracy), *mean_and_error(rmse_db))
