"""What a good place for a transmitter is: distributions of the gain at many receivers -> one number."""

from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from sionna_partial.differentiable.link_distribution import LinkDistribution
from sionna_partial.prediction.predictor import LinkPrediction
from sionna_partial.settings import Objective, require, require_number

THRESHOLDS_DB = (-150.0, 0.0)
"""Between what a threshold lies [dB]: above the gain of an outage."""

FULL_SHARE, LAST_SHARE = 0.05, 0.15
"""Of the worst places, sorted by their gain: the share that counts in full, and the share from which on none counts."""


@dataclass(frozen=True)
class PlacementObjective:
    """The number that a placement maximises.

    Parameters
    ----------
    name : {"coverage", "percentile"}
        "coverage" is the weighted mean over receivers of P(gain > threshold). "percentile" is the mean predicted gain
        [dB] of the worst tenth of them: sorted by their mean gain (an outage counting -150 dB), receivers count in full
        up to 5 % of the weight, and linearly less up to 15 %, so that neither the number nor its slope hangs on one of
        them.
    threshold_db : float
        Path gain above which a receiver is covered [dB].
    softness_db : float
        Standard deviation that is added to every gain [dB]. It gives slopes to the coverage where the gain is certain.

    Raises
    ------
    SettingsError
        For another objective, or a threshold out of range.
    """

    name: Objective = "coverage"
    threshold_db: float = -100.0
    softness_db: float = 0.0

    def __post_init__(self) -> None:
        known = get_args(Objective)
        require(self.name in known, "objective", self.name, f"give {' or '.join(map(repr, known))}.")
        require_number("threshold_db", self.threshold_db, *THRESHOLDS_DB, open_low=True)

    @property
    def value_at_transmitter(self) -> float:
        """What a receiver counts that is at the transmitter: it is covered, with a gain of 0 dB."""
        return 1.0 if self.name == "coverage" else 0.0

    @property
    def digits(self) -> int:
        """Number of decimals of a score that do not depend on the number of threads."""
        return 5 if self.name == "coverage" else 3

    def values(self, prediction: LinkPrediction) -> NDArray[np.float64]:
        """Return what counts of each link (N,): P(gain > threshold), or the mean gain [dB]."""
        return np.asarray(self._values(LinkDistribution.of_prediction(prediction)))

    def score(self, values: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
        """Join the values (N,) of receivers with weights (N,)."""
        return float(values @ self._shares(values, weight))

    def tensor(self, distribution: LinkDistribution, weight: NDArray[np.float64]) -> Any:
        """Do the same with the distribution of `DifferentiableLinks`, as a tensor that can be differentiated."""
        import tensorflow as tf

        values = self._values(distribution)
        return tf.reduce_sum(values * tf.cast(self._shares(values.numpy(), weight), values.dtype))

    def _values(self, distribution: LinkDistribution) -> Any:
        if self.name == "percentile":
            return distribution.gain_mean_db
        return distribution.coverage(self.threshold_db, softness_db=self.softness_db)

    def _shares(self, values: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """How much each receiver counts (N,); the sum is 1."""
        if self.name == "coverage":
            return weight / weight.sum()
        order = np.argsort(values, kind="stable")
        ends = np.concatenate([[0.0], np.cumsum(weight[order])]) / weight.sum()
        shares = np.empty(len(values))
        shares[order] = np.diff(_counted(ends)) / _counted(np.ones(1))
        return shares


def _counted(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integral of what the worst places count, from 0 to a share of them."""
    falling = np.clip(share, FULL_SHARE, LAST_SHARE) - FULL_SHARE
    width = LAST_SHARE - FULL_SHARE
    return np.minimum(share, FULL_SHARE) + falling - falling**2 / (2.0 * width)
