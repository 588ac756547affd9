"""Localisation of a transmitter: measured gains -> posterior over positions."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr, logsumexp

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import Progress
from sionna_partial.constants import DEFAULT_HEIGHT_M, CellState
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.assimilation import (
    FREE_P_POWERS,
    LIKELY_NOISE_DB,
    Kind,
    correlation,
    grouped,
    kinds_through_walls,
    positive,
)
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.walks import Walks
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.predictor import LinkPrediction
from sionna_partial.prediction.wall_materials import FADINGS_DB, OWN_WEIGHT, RESIDUAL_DB, Residuals, log_std_prior

Links = tuple[LinkPrediction, Floats, Floats]

Predict = Callable[[Floats, Floats], Links]
"""Return the links from a position (3,) to others (N, 3) [m]: prediction without the antenna at the others, its gain
(N,) [dB], and P(indoor) of the others (N,).
"""

MOST_POSITIONS, LEAST_SPACING_M, BEYOND_M = 1500, 0.25, 10.0
"""Number of candidates, their smallest spacing, and largest distance from free cells [m]."""

MOST_GROUPS, MOST_GROUPS_THROUGH_WALLS = 25, 40
"""Number of groups of neighbouring measurements; one of each group is traced."""

CORRELATION_M, FARTHEST_M = 3.0, 30.0
"""Correlation length of prediction errors along walks with opaque walls, with which the 90 % region holds 90 % of the
transmitters of procedural homes, unreceived ones included; and length of the longest walks [m].
"""

BLOCK = 64
"""Number of positions that are compared at once through walls."""

TRACE_STD_DB, P_ANYTHING, RANGE_DB = 1.0, 0.02, 90.0
"""Standard deviation of a trace through observed space [dB]; probability and range [dB] of outliers."""

OFFSETS_DB, OFFSET_STD_DB = np.arange(-60.0, 61.0, 3.0), 40.0
"""Candidate offsets of powers, and the prior standard deviation of the offset [dB]."""

OUTDOOR = 1e-6

REGION = 0.9


@dataclass(frozen=True, eq=False)
class TransmitterPosterior:
    """Probability (ny, nx) of the cells of a grid with centres x (nx,) and y (ny,) [m], at one height [m].

    `p_powers` (ny, nx) is the probability, given the cell, that the measurements are powers with an offset.
    """

    x_m: Floats
    y_m: Floats
    height_m: float
    probability: Floats
    p_powers: Floats | None = None

    @property
    def points_m(self) -> Floats:
        """Centres of all cells (ny nx, 3) [m]."""
        x_m, y_m = np.meshgrid(self.x_m, self.y_m)
        return np.column_stack([x_m.ravel(), y_m.ravel(), np.full(x_m.size, self.height_m)])

    @cached_property
    def position_m(self) -> Floats:
        """Cell (3,) with the smallest expected distance [m]."""
        points_m, weights = self.points_m, self.probability.ravel()
        possible = weights > 0.0
        expected_m = [np.linalg.norm(points_m[possible] - each, axis=1) @ weights[possible] for each in points_m]
        return points_m[np.where(possible, expected_m, math.inf).argmin()]

    @property
    def std_m(self) -> float:
        """Root mean square distance from `position_m` [m]."""
        square = ((self.points_m - self.position_m) ** 2).sum(axis=1)
        return float(np.sqrt(square @ self.probability.ravel()))

    def draw(self, count: int) -> tuple[Floats, Floats, list[float | None]]:
        """Draw positions (K, 3) systematically [m]; return also their weights (K,) and P(powers)."""
        weights = self.probability.ravel()
        drawn = np.searchsorted(np.cumsum(weights) / weights.sum(), (np.arange(count) + 0.5) / count)
        chosen, times = np.unique(drawn, return_counts=True)
        p_powers = [None] * len(chosen) if self.p_powers is None else self.p_powers.ravel()[chosen].tolist()
        return self.points_m[chosen], times / count, p_powers


def likely_region(probability: Floats) -> Bools:
    """Return the smallest set of cells with 90 % probability."""
    order = np.argsort(-probability, axis=None, kind="stable")
    inside = np.cumsum(probability.ravel()[order]) < REGION * probability.sum()
    region = np.zeros(probability.size, dtype=bool)
    region[order[: inside.sum() + 1]] = True
    return region.reshape(probability.shape)


def locate_transmitter(
    partial: PartialMap,
    measured: Measurements,
    allowed: Callable[[Floats], Bools],
    predict: Predict,
    report: Progress,
    *,
    through_walls_hz: float | None = None,
) -> TransmitterPosterior:
    """Compare positions by the likelihood of measurements of one transmitter, weighted by P(indoor).

    By reciprocity, links are predicted from the measured positions to all others that are `allowed`. Through walls, at
    the frequency `through_walls_hz`, residuals are the process of `Assimilation`. With opaque walls, the log-likelihood
    is divided by the number of correlated neighbours.
    """
    posterior = _grid(partial, measured)
    points_m = posterior.points_m
    received = measured.gain_db > measured.sensitivity_db
    groups = MOST_GROUPS if through_walls_hz is None else MOST_GROUPS_THROUGH_WALLS
    some = measured.take(grouped(measured.rx, received, groups)[0])
    possible = np.flatnonzero(allowed(points_m))
    if not len(possible):
        raise PositionError("a transmitter can be nowhere: no position is away from walls and measurements.")
    partial.require_positions("tx", points_m[possible])
    links = []
    for index, each_m in enumerate(some.rx):
        report(index / len(some), "comparing positions of the transmitter")
        links.append(predict(each_m, points_m[possible]))
    if through_walls_hz is None:
        log_p = _log_independent(partial, some, links)
    else:
        log_p = _log_process(partial, some, links, points_m[possible], through_walls_hz)
    log_p += np.log([[1.0 - FREE_P_POWERS], [FREE_P_POWERS]])
    log_p += np.log(np.maximum(np.mean([indoor for *_, indoor in links], axis=0), OUTDOOR))
    joint = np.exp(log_p - logsumexp(log_p))
    posterior.probability.ravel()[possible] = joint.sum(axis=0)
    p_powers = np.zeros(posterior.probability.shape)
    p_powers.ravel()[possible] = joint[1] / np.maximum(joint.sum(axis=0), 1e-300)
    return replace(posterior, p_powers=p_powers)


def _log_independent(partial: PartialMap, measured: Measurements, links: Sequence[Links]) -> Floats:
    """Return the log-likelihood (2, N) of gains and of powers with opaque walls: residuals are independent."""
    log_p = np.zeros(())
    for at, (prediction, antenna_db, _) in enumerate(links):
        log_p = log_p + _log_likelihood(prediction, measured.take(np.array([at])), antenna_db)
    walks_m = Walks(partial, measured.rx, FARTHEST_M).lengths_m(measured.rx)
    log_p *= len(measured) / np.exp(-walks_m / CORRELATION_M).sum()
    weights = np.where(OFFSETS_DB == 0.0, 0.0, np.exp(-0.5 * (OFFSETS_DB / OFFSET_STD_DB) ** 2))
    powers = logsumexp(log_p, axis=0, b=(weights / weights.sum())[:, None])
    return np.stack([log_p[OFFSETS_DB == 0.0][0], powers])


def _log_process(
    partial: PartialMap, measured: Measurements, links: Sequence[Links], points_m: Floats, frequency_hz: float
) -> Floats:
    """Return the log-likelihood (2, N) of gains and of powers through walls: residuals are a Gaussian process."""
    materials, weights = zip(*(prediction.by_material for prediction, *_ in links), strict=True)
    mean_db, std_db = (
        np.array([[getattr(each, name) for each in of_link] for of_link in materials]).transpose(2, 1, 0)
        for name in ("gain_mean_db", "gain_std_db")
    )
    levels_db = [measured.take(np.array([at])).of_paths(antenna_db)[0] for at, (_, antenna_db, _) in enumerate(links)]
    above_db = np.transpose(levels_db)[:, None] - mean_db
    below_db = mean_db - free_space_gain_db(cdist(points_m, measured.rx), frequency_hz)[:, None]
    received = measured.of_paths(0.0)[1]
    noise_db = 0.0 if measured.std_db is None else float(np.sqrt(np.mean(measured.std_db**2)))
    walks, seen = Walks(partial, measured.rx, FARTHEST_M), partial.state_at(points_m) == CellState.FREE
    kinds = kinds_through_walls(len(materials[0]))
    log_p = np.empty((len(kinds), len(points_m)))
    for tx_seen in (True, False):
        correlated = positive(correlation(walks, measured.rx, kinds[0], tx_seen=tx_seen))
        at = np.flatnonzero(seen == tx_seen)
        for some in (at[first : first + BLOCK] for first in range(0, len(at), BLOCK)):
            residuals_db = above_db[some], below_db[some], std_db[some]
            for number, kind in enumerate(kinds):
                of_material = _log_evidence(kind, correlated, received, *residuals_db, noise_db)
                log_p[number, some] = logsumexp(of_material + np.log(weights[0]), axis=1)
    return log_p


def _log_evidence(
    kind: Kind,
    correlation: Floats,
    received: Bools,
    above_db: Floats,
    below_db: Floats,
    std_db: Floats,
    noise_db: float,
) -> Floats:
    """Return the log-evidence (N, K) of N positions and K materials; residuals are (N, K, P) [dB].

    Residuals of links that were not received are independent, given the mean of the others.
    """
    count = received.sum()
    above, below, std = (each[..., received].reshape(-1, count) for each in (above_db, below_db, std_db))
    correlation, covariance = correlation[np.ix_(received, received)], kind.covariance[None]
    residuals = Residuals(correlation, np.ones(count), above, below, std, covariance)
    log_p = OWN_WEIGHT * residuals.log_evidence(np.hypot(FADINGS_DB, noise_db)) + log_std_prior()
    prior_count = RESIDUAL_DB**2 / kind.covariance[0, 0]
    offset_db = above_db[..., received].sum(axis=-1, keepdims=True) / (count + prior_count)
    bounds = log_ndtr((above_db - offset_db)[..., ~received] / np.hypot(std_db[..., ~received], RESIDUAL_DB))
    of_rows: Floats = logsumexp(log_p, axis=(1, 2)).reshape(above_db.shape[:2])
    return of_rows + OWN_WEIGHT * bounds.sum(axis=-1)


def _grid(partial: PartialMap, measured: Measurements) -> TransmitterPosterior:
    cells = np.argwhere(partial.state == CellState.FREE)[:, ::-1]
    low_m, high_m = np.reshape(partial.bounds_m, (2, 2))
    if len(cells):
        first_m, last_m = (ends * partial.resolution_m + partial.origin_m for ends in (cells.min(0), cells.max(0) + 1))
        low_m, high_m = np.maximum(low_m, first_m - BEYOND_M), np.minimum(high_m, last_m + BEYOND_M)
    spacing_m = max(LEAST_SPACING_M, math.sqrt(np.prod(high_m - low_m) / MOST_POSITIONS))
    x_m, y_m = (
        (low + high) / 2.0 + spacing_m * (np.arange(count) - (count - 1) / 2.0)
        for low, high in zip(low_m, high_m, strict=True)
        for count in [max(1, int((high - low) / spacing_m))]
    )
    height_m = measured.tx[0, 2] if np.isfinite(measured.tx[0, 2]) else DEFAULT_HEIGHT_M
    return TransmitterPosterior(x_m, y_m, float(height_m), np.zeros((len(y_m), len(x_m))))


def _log_likelihood(prediction: LinkPrediction, measured: Measurements, antenna_db: Floats) -> Floats:
    probabilities, means_db, stds_db = prediction.by_state
    noise_db = LIKELY_NOISE_DB if measured.std_db is None else measured.std_db[0]
    spread_db = np.sqrt(stds_db**2 + noise_db**2 + TRACE_STD_DB**2)
    level_db, received = measured.of_paths(antenna_db)
    z = (level_db - OFFSETS_DB[:, None, None] - means_db) / spread_db
    log_density = -0.5 * (z**2 + math.log(2.0 * math.pi)) - np.log(spread_db)
    log_density, anything = np.where(received, log_density, log_ndtr(z)), np.where(received, 1.0 / RANGE_DB, 0.5)
    with np.errstate(divide="ignore"):
        expected = logsumexp(log_density + np.log(probabilities), axis=1)
    return np.logaddexp(math.log1p(-P_ANYTHING) + expected, np.log(P_ANYTHING * anything))
