"""How far measured gains lie from predicted ones: a density with few parameters, which are fitted along.

Most links are off by the noise of the measurement alone, which is normal [dB]. Some that have no line of sight are
stronger, because they have paths that the map does not show, and some weaker, because something stands in the way: the
noise and an exponential are added up there.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

NOISES_DB = tuple(float(noise) for noise in np.geomspace(0.7, 15.0, 24))
MISSED_SHARES, BLOCKED_SHARES = (0.0, 0.1, 0.25, 0.5, 0.75), (0.0, 0.05, 0.2)
"""Values of the parameters of GainErrors among which the likeliest are found."""

MISSED_DB, BLOCKED_DB = 8.0, 12.0
"""Mean of how much stronger links with missed paths are, and how much weaker links with blocked paths [dB]."""

STRAY_SHARE = 0.01
"""Share of links with a line of sight that are off either way, and smallest share of the others."""

EXPECTED_NOISE_DB, NOISE_SPREAD = 3.0, 0.7
"""Median of the noise before anything is measured [dB], and standard deviation of its logarithm."""

SHARE_SCALE = 0.5
"""Mean of the shares before anything is measured."""


@dataclass(frozen=True)
class GainErrors:
    """Density of measured less predicted gains.

    Parameters
    ----------
    noise_db : float
        Standard deviation of the noise [dB].
    missed_share, blocked_share : float
        Shares of links without line of sight that are stronger and weaker than predicted.
    """

    noise_db: float
    missed_share: float
    blocked_share: float

    def penalty(self) -> float:
        """Negative logarithm of how likely these parameters are before anything is measured, but for a constant."""
        spread = math.log(self.noise_db / EXPECTED_NOISE_DB) / NOISE_SPREAD
        return 0.5 * spread**2 + (self.missed_share + self.blocked_share) / SHARE_SCALE

    def curve(
        self, error_db: NDArray[np.float64], is_direct: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Negative logarithm of the density of errors (..., N), and its first and second derivatives.

        Parameters
        ----------
        error_db : (..., N) float64 array
            Measured less predicted gain [dB].
        is_direct : (N,) bool array
            Whether the link has a line of sight.
        """
        parts = _components(error_db, self.noise_db)
        share = _shares(is_direct, self.missed_share, self.blocked_share)
        top = np.max(parts, axis=0)
        normal, missed, blocked = (weight * np.exp(part - top) for weight, part in zip(share, parts, strict=True))
        bell = np.exp(parts[0] - top)
        density = normal + missed + blocked
        variance = self.noise_db**2
        pulled = -error_db / variance * normal
        slope = pulled + (share[1] * bell - missed) / MISSED_DB - (share[2] * bell - blocked) / BLOCKED_DB
        bend = normal * (error_db**2 / variance - 1.0) / variance
        down = -error_db / variance * bell
        bend += (share[1] * down - (share[1] * bell - missed) / MISSED_DB) / MISSED_DB
        bend -= (share[2] * down + (share[2] * bell - blocked) / BLOCKED_DB) / BLOCKED_DB
        first = -slope / density
        return -np.log(density) - top, first, first**2 - bend / density


def fit_errors(error_db: NDArray[np.float64], is_direct: NDArray[np.bool_]) -> tuple[GainErrors, float]:
    """Find the likeliest density for errors.

    Parameters
    ----------
    error_db : (N,) float64 array
        Measured less predicted gain [dB].
    is_direct : (N,) bool array
        Whether the link has a line of sight.

    Returns
    -------
    GainErrors
    float
        Negative logarithm of the likelihood of the errors, with the penalty of the density.
    """
    kinds = np.exp(np.maximum(_components(error_db, np.array(NOISES_DB)[:, None]), -700.0))
    losses = {}
    for missed, blocked in itertools.product(MISSED_SHARES, BLOCKED_SHARES):
        shares = _shares(is_direct, missed, blocked)
        density = np.einsum("ksn,kn->sn", kinds, shares)
        for noise_db, loss in zip(NOISES_DB, -np.log(np.maximum(density, 1e-300)).sum(axis=1), strict=True):
            found = GainErrors(noise_db, missed, blocked)
            losses[found] = float(loss) + found.penalty()
    return min(losses.items(), key=lambda item: item[1])


def _shares(is_direct: NDArray[np.bool_], missed: float, blocked: float) -> NDArray[np.float64]:
    """Shares (3, N) of noise alone, of missed and of blocked paths; no link is free of either."""
    stray = STRAY_SHARE / 2.0
    off = np.where(is_direct, stray, np.maximum([[missed], [blocked]], stray))
    return np.stack([1.0 - off.sum(axis=0), *off])


def _components(error_db: NDArray[np.float64], noise_db: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithms (3, ..., N) of the densities of noise alone, of missed paths and of blocked ones."""
    normal = -0.5 * (error_db / noise_db) ** 2 - np.log(noise_db * math.sqrt(2.0 * math.pi))
    return np.stack(
        [
            normal,
            _with_exponential(error_db, noise_db, MISSED_DB),
            _with_exponential(-error_db, noise_db, BLOCKED_DB),
        ]
    )


def _with_exponential(
    error_db: NDArray[np.float64], noise_db: float | NDArray[np.float64], mean_db: float
) -> NDArray[np.float64]:
    """Logarithm of the density of normal noise to which an exponential is added."""
    ratio = noise_db / mean_db
    tail: NDArray[np.float64] = log_ndtr(error_db / noise_db - ratio)
    return 0.5 * ratio**2 - error_db / mean_db - math.log(mean_db) + tail
