"""Figures of merit of predictions: errors, likelihoods and calibration."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, States
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.display import Shown
from sionna_partial.prediction.rule import LinkPrediction

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
        accuracy=mean(prediction.link_state == link_state),
        rmse_db=math.sqrt(mean(errors_db**2)),
        rmse_linked_db=math.sqrt(mean(errors_db[~outage] ** 2)),
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
    return mean(state), mean(state + gain)


def mean(values: NDArray[Any]) -> float:
    """Return the mean of values (N,), nan without values."""
    return float(values.mean()) if len(values) else math.nan
