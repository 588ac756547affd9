"""Evidence of measured powers for candidates of the material of walls, and for the size of residuals.

Residuals of a trace are a Gaussian process of standard deviation s, white noise n, an offset and a factor on the loss
of walls that all links have in common. Candidates differ in their residuals alone, so that one eigenvalue
decomposition of the correlation serves all candidates and all s and n.
"""

import math
from typing import NamedTuple

import numpy as np

from sionna_partial.arrays import Floats
from sionna_partial.prediction.wall_materials import LIKELY_FADING_DB, LIKELY_STD_DB

STDS_DB, STD_SPREAD = (2.5, 3.5, 5.0, 7.0, 10.0), 0.4
"""Standard deviations of the process that are tried [dB], and the standard deviation of their logarithm."""

FADINGS_DB = np.array([1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0])
"""Standard deviations of what differs from receiver to receiver that are tried [dB]."""

FADING_SPREAD = 0.5
"""Standard deviation of their logarithm before any measurement."""

OWN_WEIGHT, OTHERS_WEIGHT = 0.5, 0.3
"""Exponents of the evidence of a transmitter, and of other transmitters of the building: errors of a trace are
correlated over more than the process has."""


class Residuals(NamedTuple):
    """Residuals of P averages of `size` (P,) measurements under K candidates.

    `correlation` (P, P); residuals (K, P) less the expected common part, predictions above free space (K, P), and
    standard deviations of the predictions without the process (K, P) [dB]; prior covariance (K, 2, 2) of offset [dB]
    and factor.
    """

    correlation: Floats
    size: Floats
    residual_db: Floats
    below_db: Floats
    std_db: Floats
    covariance: Floats

    def log_evidence(self, noises_db: Floats) -> Floats:
        """Return the log-likelihood (K, S, N) for `STDS_DB` and standard deviations of noise [dB], but for a constant.

        Noise is taken to be as large, relative to the process, at all P.
        """
        root = np.sqrt(self.size)
        values, vectors = np.linalg.eigh(self.correlation * root[:, None] * root)
        values = np.maximum(values, 1e-6)
        rows_db = np.stack([self.residual_db, np.ones_like(self.below_db), self.below_db], axis=1) * root
        found = np.empty((len(rows_db), len(STDS_DB), len(noises_db)))
        for s, process_db in enumerate(STDS_DB):
            scale_db = np.hypot(self.std_db, process_db)
            rows = (rows_db / scale_db[:, None]) @ vectors
            relative = noises_db**2 * (scale_db**-2.0).sum(axis=1)[:, None] / max(len(root), 1)
            spectrum = values + relative[..., None]
            products = rows[:, :, None] * rows[:, None]
            gram = (1.0 / spectrum) @ products.reshape(len(rows), 9, -1).swapaxes(1, 2)
            gram = gram.reshape(*spectrum.shape[:2], 3, 3)
            common = np.linalg.inv(self.covariance)[:, None] + gram[..., 1:, 1:]
            shift = gram[..., 1:, 0]
            square = gram[..., 0, 0] - (shift * np.linalg.solve(common, shift[..., None])[..., 0]).sum(axis=-1)
            volume = np.log(spectrum).sum(axis=-1) + np.linalg.slogdet(self.covariance[:, None] @ common)[1]
            found[:, s] = -0.5 * (square + volume) - np.log(scale_db).sum(axis=1)[:, None]
        return found


def log_std_prior() -> Floats:
    """Return the log-probability (S, N) of `STDS_DB` and `FADINGS_DB`, but for a constant."""
    apart = np.log(np.array(STDS_DB) / LIKELY_STD_DB) / STD_SPREAD
    fading_apart = np.log(FADINGS_DB / LIKELY_FADING_DB) / FADING_SPREAD
    log_prior: Floats = -0.5 * apart[:, None] ** 2 - 0.5 * fading_apart**2
    return log_prior


def mean_square(values: Floats, weights: Floats) -> float:
    """Return the root of the weighted mean square."""
    return math.sqrt(float(weights @ values**2 / weights.sum()))
