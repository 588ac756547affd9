"""Kinds of measurements, path gains or received powers, and the prior of what they have in common."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from sionna_partial.arrays import Floats
from sionna_partial.prediction.wall_materials import LIKELY_STD_DB

P_POWERS, UNSEEN_P_POWERS, FREE_P_POWERS = 0.01, 0.0001, 0.95
"""Prior probability that the measurements are powers, not path gains: with the transmitter in a seen cell, in an unseen
cell (an offset may then be an unseen wall), and for paths through walls or an unknown position of the transmitter.

With `P_POWERS`, the 90 % regions of `locate_transmitter` contain 69 % of transmitters if all powers are 8 dB low.
"""


class Kind(NamedTuple):
    """Path gains or powers, with their priors."""

    mean: tuple[float, float]
    """Expected common offset [dB], and common factor on the loss over free space."""

    covariance: Floats

    seen_range_m: float
    """Correlation length of residuals if both ends of a link are in seen cells [m]."""

    trace_std_db: float
    """Standard deviation of measured gains from a trace through observed space [dB]."""

    deepest: float
    """Limit of negative residuals in comparisons: unseen walls make single links arbitrarily deep."""

    exact: bool
    """True if certain predictions stay certain; for a real radio no trace is certain."""

    def learnt(self, others: Sequence[tuple[Floats, Floats]]) -> Kind:
        """Update the prior by other transmitters, with unknown differences between transmitters.

        `others` are pairs of a precision (2, 2) and its product with the mean, without a prior.
        """
        if not others:
            return self
        found = [self._learnt(others, np.minimum(np.diag(stds) ** 2, self.covariance)) for stds in BETWEEN_STDS]
        log_p, means, covariances = (np.array(each) for each in zip(*found, strict=True))
        apart = np.log(np.array(BETWEEN_STDS) / LIKELY_BETWEEN) / BETWEEN_SPREAD
        log_p -= 0.5 * (apart**2).sum(axis=1)
        weights = np.exp(log_p - logsumexp(log_p))
        mean = weights @ means
        scatter = np.einsum("w,wa,wb->ab", weights, means - mean, means - mean)
        covariance = np.tensordot(weights, covariances, 1) + scatter
        return self._replace(mean=(float(mean[0]), float(mean[1])), covariance=covariance)

    def _learnt(self, others: Sequence[tuple[Floats, Floats]], within: Floats) -> tuple[float, Floats, Floats]:
        """Update the prior by other transmitters, whose offset and factor vary with the covariance `within` (2, 2).

        Return the log-evidence of this covariance, and the new mean and covariance.
        """
        precision, shift, log_p = np.zeros((2, 2)), np.zeros(2), 0.0
        for own_precision, own_shift in others:
            scattered = np.linalg.inv(np.eye(2) + own_precision @ within)
            precision, shift = precision + scattered @ own_precision, shift + scattered @ own_shift
            log_p += 0.5 * float(own_shift @ within @ scattered @ own_shift + np.linalg.slogdet(scattered)[1])
        unsure, mean = self.covariance - within, np.array(self.mean)
        left = np.linalg.solve(np.eye(2) + unsure @ precision, unsure)
        change = shift - precision @ mean
        log_p += 0.5 * float(change @ left @ change - np.linalg.slogdet(np.eye(2) + unsure @ precision)[1])
        log_p += float(mean @ shift - 0.5 * mean @ precision @ mean)
        return log_p, mean + left @ change, left + within


GAIN_OFFSET_STD_DB = 2.0
"""Prior standard deviation of a common offset of path gains [dB]."""

KINDS = (
    Kind((0.0, 1.0), np.diag([GAIN_OFFSET_STD_DB, 0.0]) ** 2, 0.8, 1.0, 3.0, True),
    Kind((0.0, 0.5), np.diag([40.0, 0.2]) ** 2, 4.0, 3.0, math.inf, True),
)
"""Traced path gains, and powers at a real radio, with shadows filled by objects missing on maps."""

KINDS_THROUGH_WALLS = tuple(
    Kind((0.0, 1.0), np.diag([offset_db, 1.0]) ** 2, 4.0, LIKELY_STD_DB, math.inf, False)
    for offset_db in (GAIN_OFFSET_STD_DB, 40.0)
)
"""Gains and powers through walls whose loss is from zero to over twice the expected loss."""

UNKNOWN_FACTOR_STD = 0.3
"""Standard deviation of the factor if candidate materials have their own losses."""


def kinds_through_walls(materials: int) -> tuple[Kind, ...]:
    """Return `KINDS_THROUGH_WALLS` for that number of candidate materials."""
    unsure = np.array([1.0, UNKNOWN_FACTOR_STD if materials > 1 else 1.0])
    return tuple(kind._replace(covariance=kind.covariance * np.outer(unsure, unsure)) for kind in KINDS_THROUGH_WALLS)


BETWEEN_STDS = tuple(itertools.product((1.5, 3.0, 6.0, 9.0), (0.1, 0.2, 0.3)))
"""Candidate standard deviations of offset [dB] and factor between transmitters of a building."""

LIKELY_BETWEEN, BETWEEN_SPREAD = (3.0, 0.2), 0.5
"""Most probable of them a priori, and the standard deviation of their logarithms."""
