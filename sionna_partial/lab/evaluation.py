"""Figures of merit of predictions; evaluation of a predictor and baselines on training and test homes."""

import itertools
import json
import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, States
from sionna_partial.checks import Progress, shown
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.display import Shown, reporting
from sionna_partial.errors import PredictorError
from sionna_partial.files import atomic_write, read_bytes
from sionna_partial.lab.datasets.shards import Dataset, LinkTable, LinkTraces, open_links, require_like, stage_name
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.predictor import Predictor, warm_predictor
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.settings import PredictorSettings

_log = logging.getLogger(__name__)

CONFIDENCE_BINS = 15
"""Equal-width bins of the confidence in the calibration error."""

PIT_BINS = 20
"""Equal-width bins of the gain's probability integral transform in `Calibration`."""

INTERVAL = (0.05, 0.95)

_NO_SPREAD_DB = 1e-6
"""Standard deviation below which a gain has no spread [dB]."""

LEAST_PROBABILITY = 1e-4
"""Smallest probability of the true link state in a likelihood: a map with errors may exclude the true state."""

LEAST_STD_DB, LEAST_DENSITY = 0.1, LEAST_PROBABILITY / -GAIN_FLOOR_DB
"""Limits for the true gain in a likelihood [dB, 1/dB]: a trace on a map with errors is certain but may be wrong."""

DEFINITIONS = {
    "links": "number of links that were measured.",
    "accuracy": "fraction of links whose most probable link state is the true one.",
    "rmse_db": "root mean square of predictive mean minus true path gain [dB]; an outage counts -150 dB on both sides.",
    "rmse_linked_db": "the same over the links that are not in outage in truth [dB].",
    "nll_state": f"mean of -log P(true link state) [nat]; P counts at least {LEAST_PROBABILITY:g}.",
    "nll": "mean of -log P(true link state) - log p(true gain in dB given it) [nat], P as before; an outage has no "
    f"second term, a standard deviation counts at least {LEAST_STD_DB:g} dB, p at least {LEAST_DENSITY:.1g} per dB.",
    "calibration_error": "expected calibration error of the link state: |accuracy - mean confidence| in "
    f"{CONFIDENCE_BINS} bins of equal width, weighted by their links; the confidence is the probability of the "
    "most probable state.",
    "coverage_90": "fraction of links whose true gain lies in the central 90 % interval, by the randomised probability "
    "integral transform, spread evenly over the probability of an outage; 0.9 is right.",
}

MAJORITY_FILE, DISTANCE_FILE = "majority.json", "distance.keras"

_MAX_BYTES = 1_000_000

OFFICES = ("mixed", "open")

_INDOOR_STD_DB = (0.0, 3.0, 8.03)

ENDS_SEEN = {"both": 2, "one": 1, "none": 0}
"""Number of ends of a link in observed cells."""

WITHOUT_INDOOR, WITH_INDOOR = "without indoor model", "with indoor model"
"""Predictions for receivers anywhere."""

ALWAYS_OUTAGE = "always outage"

FEWEST_HOMES = 5
"""Number of test homes below which standard errors over homes have no meaning."""


@dataclass(frozen=True)
class Metrics:
    """Figures of merit of one prediction of N links (`DEFINITIONS`), nan if undefined.

    Undefined are all without links, `rmse_linked_db` if all links are in outage, and `coverage_90` of a prediction
    without spread.
    """

    links: int
    accuracy: float
    rmse_db: float
    rmse_linked_db: float
    nll_state: float
    nll: float
    calibration_error: float
    coverage_90: float

    def as_json(self) -> dict[str, Any]:
        """Return the figures by name, None for nan."""
        return {name: None if math.isnan(value) else value for name, value in asdict(self).items()}


@dataclass(frozen=True, eq=False)
class Reliability(Shown):
    """Links, mean confidence and accuracy in bins of the confidence (`CONFIDENCE_BINS`,); 0 in an empty bin."""

    links: NDArray[np.int64]
    confidence: Floats
    accuracy: Floats

    @property
    def error(self) -> float:
        """Expected calibration error; nan without links."""
        total = self.links.sum()
        return float((self.links * np.abs(self.accuracy - self.confidence)).sum() / total) if total else math.nan


@dataclass(frozen=True, eq=False)
class Calibration(Shown):
    """Calibration of link state and gain.

    `gain_pit` (PIT_BINS,) is the histogram of the randomised probability integral transform of the true gains, uniform
    for a calibrated prediction.
    """

    state: Reliability
    gain_pit: Floats


def measure(prediction: LinkPrediction, link_state: States, gain_db: Floats) -> Metrics:
    """Compare a prediction with the true link states and gains [dB] of N links; an outage has -150 dB."""
    outage = link_state == LinkState.OUTAGE
    errors_db = gain_errors_db(prediction, link_state, gain_db)
    nll_state, nll = _negative_log_likelihoods(prediction, link_state, gain_db)
    low, high = pit_fractions(prediction, link_state, gain_db, np.array(INTERVAL))
    return Metrics(
        links=len(link_state),
        accuracy=_mean(prediction.link_state == link_state),
        rmse_db=math.sqrt(_mean(errors_db**2)),
        rmse_linked_db=math.sqrt(_mean(errors_db[~outage] ** 2)),
        nll_state=nll_state,
        nll=nll,
        calibration_error=reliability(prediction, link_state).error,
        coverage_90=float(high - low) if (prediction.gain_std_db > _NO_SPREAD_DB).any() else math.nan,
    )


def calibration(prediction: LinkPrediction, link_state: States, gain_db: Floats) -> Calibration:
    fractions = pit_fractions(prediction, link_state, gain_db, np.linspace(0.0, 1.0, PIT_BINS + 1))
    return Calibration(reliability(prediction, link_state), np.diff(fractions))


def gain_errors_db(prediction: LinkPrediction, link_state: States, gain_db: Floats) -> Floats:
    """Return predictive mean minus true gain (N,) [dB]; an outage has -150 dB."""
    return prediction.gain_mean_db - np.where(link_state == LinkState.OUTAGE, GAIN_FLOOR_DB, gain_db)


def reliability(prediction: LinkPrediction, link_state: States) -> Reliability:
    confidence = np.max([prediction.p_outage, prediction.p_los, prediction.p_nlos], axis=0)
    bins = np.minimum((confidence * CONFIDENCE_BINS).astype(np.intp), CONFIDENCE_BINS - 1)
    links = np.bincount(bins, minlength=CONFIDENCE_BINS)
    right = (prediction.link_state == link_state).astype(np.float64)
    sums = (np.bincount(bins, weights, minlength=CONFIDENCE_BINS) for weights in (confidence, right))
    return Reliability(links, *(total / np.maximum(links, 1) for total in sums))


def pit_fractions(prediction: LinkPrediction, link_state: States, gain_db: Floats, levels: Floats) -> Floats:
    """Return the fractions of links (K,) whose probability integral transform is below some levels (K,) in [0, 1].

    The transform is the predicted probability of a smaller gain, spread evenly over a probability mass such as an
    outage (randomised, in expectation). A calibrated prediction returns the levels.
    """
    if len(link_state) == 0:
        return np.full(len(levels), np.nan)
    gain_db = np.where(link_state == LinkState.OUTAGE, GAIN_FLOOR_DB, gain_db)
    below, upto = (1.0 - prediction.probability_above(at_db) for at_db in (np.nextafter(gain_db, -np.inf), gain_db))
    width = np.maximum(upto - below, 1e-12)
    return np.array([np.clip((level - below) / width, 0.0, 1.0).mean() for level in levels])


def _negative_log_likelihoods(prediction: LinkPrediction, link_state: States, gain_db: Floats) -> tuple[float, float]:
    los, outage = link_state == LinkState.LOS, link_state == LinkState.OUTAGE
    p = np.select([los, outage], [prediction.p_los, prediction.p_outage], prediction.p_nlos)
    mean_db = np.where(los, prediction.gain_los_mean_db, prediction.gain_nlos_mean_db)
    std_db = np.maximum(np.where(los, prediction.gain_los_std_db, prediction.gain_nlos_std_db), LEAST_STD_DB)
    state = -np.log(np.maximum(p, LEAST_PROBABILITY))
    gain = 0.5 * ((gain_db - mean_db) / std_db) ** 2 + np.log(std_db * math.sqrt(2.0 * math.pi))
    gain = np.where(outage, 0.0, np.minimum(gain, -math.log(LEAST_DENSITY)))
    return _mean(state), _mean(state + gain)


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else math.nan


@dataclass(frozen=True)
class Majority:
    """Equal prediction for every link: fractions, means and standard deviations [dB] of the training links by state.

    A state without links has the gain of an outage.
    """

    fractions: tuple[float, ...]
    means_db: tuple[float, ...]
    stds_db: tuple[float, ...]

    @classmethod
    def fit(cls, link_state: States, gain_db: Floats) -> "Majority":
        """Fit to true link states (N,) and gains (N,) [dB]."""
        groups = [gain_db[link_state == state] for state in LinkState]
        known = [group if len(group) else np.array([GAIN_FLOOR_DB]) for group in groups]
        return cls(
            tuple(len(group) / len(gain_db) for group in groups),
            tuple(float(group.mean()) for group in known),
            tuple(float(group.std()) for group in known),
        )

    def predict(self, phi: LinkFeatures) -> LinkPrediction:
        """Return the same distribution for N links."""
        rows = (self.fractions, self.means_db, self.stds_db)
        return LinkPrediction.of_parts(*(np.repeat(np.array(row)[:, None], len(phi), axis=1) for row in rows))


@dataclass(frozen=True, eq=False)
class Baselines(Shown):
    """Baselines fitted to the training links of a predictor."""

    majority: Majority
    distance: Predictor

    @classmethod
    def fit(cls, links: LinkTable, settings: PredictorSettings) -> "Baselines":
        """Fit to links with receivers drawn indoors."""
        blind = nothing_seen(links.features, settings.frequency_hz)
        homes = list(dict.fromkeys(map(str, links.home)))
        distance = Predictor.fit(
            blind, links.link_state, links.gain_db, homes=homes, settings=replace(settings, networks="paper")
        )
        return cls(Majority.fit(links.link_state, links.gain_db), distance)

    def save(self, folder: Path) -> None:
        """Write the files into a folder."""
        self.distance.save(folder / DISTANCE_FILE)
        rows = zip(LinkState, self.majority.fractions, self.majority.means_db, self.majority.stds_db, strict=True)
        content = {
            state.name: {"share": fraction, "gain_mean_db": mean_db, "gain_std_db": std_db}
            for state, fraction, mean_db, std_db in rows
        }
        with atomic_write(folder / MAJORITY_FILE, "w") as stream:
            stream.write(json.dumps(content, indent=2) + "\n")

    @classmethod
    def load(cls, folder: Path) -> "Baselines":
        """Read the files of `save`."""
        path = folder / MAJORITY_FILE
        try:
            content = json.loads(read_bytes(path, "path", PredictorError, _MAX_BYTES))
            cells = [content[state.name] for state in LinkState]
            columns = (tuple(float(cell[name]) for cell in cells) for name in ("share", "gain_mean_db", "gain_std_db"))
            majority = Majority(*columns)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise PredictorError(
                f"path = '{path}' cannot be read ({error!r}): copy it again, or train the predictor beside it anew."
            ) from error
        return cls(majority, warm_predictor(folder / DISTANCE_FILE))


def nothing_seen(phi: LinkFeatures, frequency_hz: float) -> LinkFeatures:
    """Return the features of N links on an empty map, where only the distance is known."""
    frequency_hz = phi.frequency_hz or frequency_hz
    gain_db = np.maximum(free_space_gain_db(phi.distance_m, frequency_hz), GAIN_FLOOR_DB)
    state = np.full(len(phi), LinkState.LOS)
    return LinkFeatures(state, phi.distance_m, phi.distance_m, gain_db, frequency_hz=frequency_hz)


def indoor_los_probability(distance_m: Floats, office: str) -> Floats:
    """Return the LOS probability of 3GPP TR 38.901 V18.0.0, Table 7.4.2-1, at horizontal distances (N,) [m]."""
    d = distance_m
    if office == "mixed":
        near, far = np.exp(-(d - 1.2) / 4.7), 0.32 * np.exp(-(d - 6.5) / 32.6)
        return np.select([d <= 1.2, d < 6.5], [1.0, near], far)
    near, far = np.exp(-(d - 5.0) / 70.8), 0.54 * np.exp(-(d - 49.0) / 211.7)
    return np.select([d <= 5.0, d <= 49.0], [1.0, near], far)


def indoor_gain_db(distance_m: Floats, frequency_hz: float) -> dict[LinkState, Floats]:
    """Return the path gain [dB] of 3GPP TR 38.901 V18.0.0, Table 7.4.1-1, "InH - Office", at distances (N,) [m].

    The model covers 1 to 150 m and 0.5 to 100 GHz, and is extended to 1 cm here. There is no shadow fading.
    """
    decades, frequency = np.log10(np.maximum(distance_m, 0.01)), np.log10(frequency_hz / 1e9)
    los_db = 32.4 + 17.3 * decades + 20.0 * frequency
    nlos_db = np.maximum(los_db, 38.3 * decades + 17.30 + 24.9 * frequency)
    return {LinkState.LOS: -los_db, LinkState.NLOS: -nlos_db}


def tr38901_indoor(phi: LinkFeatures, frequency_hz: float, office: str) -> LinkPrediction:
    """Predict with the indoor model of 3GPP TR 38.901, which has no outage; both ends have the same height."""
    p_los = indoor_los_probability(phi.distance_m, office)
    gains_db = indoor_gain_db(phi.distance_m, phi.frequency_hz or frequency_hz)
    nothing = np.zeros(len(phi))
    means_db = np.stack([nothing + GAIN_FLOOR_DB, gains_db[LinkState.LOS], gains_db[LinkState.NLOS]])
    stds_db = np.stack([nothing + std_db for std_db in _INDOOR_STD_DB])
    probabilities = np.stack([nothing, p_los, 1.0 - p_los])
    return LinkPrediction.of_parts(probabilities, np.maximum(means_db, GAIN_FLOOR_DB), stds_db)


def baseline_predictions(
    baselines: Baselines, paper: Predictor | None, phi: LinkFeatures, frequency_hz: float
) -> Mapping[str, LinkPrediction]:
    distance = baselines.distance
    return ({} if paper is None else {"paper": paper.predict(phi)}) | {
        "distance only": distance.predict(nothing_seen(phi, frequency_hz)),
        "majority": baselines.majority.predict(phi),
        "partial trace": LinkPrediction.of_trace(phi),
        **{f"TR 38.901 {office} office": tr38901_indoor(phi, frequency_hz, office) for office in OFFICES},
    }


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
    return _mean(values), float(error)


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
