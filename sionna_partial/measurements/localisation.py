"""Localisation of a transmitter: measured gains -> posterior over positions."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr, logsumexp

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import Progress
from sionna_partial.constants import DEFAULT_HEIGHT_M, CellState
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.assimilation import FREE_P_POWERS, LIKELY_NOISE_DB, Walks, grouped
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.prediction.predictor import LinkPrediction

Predict = Callable[[Floats, Floats], tuple[LinkPrediction, Floats, Floats]]
"""Return the links from a position (3,) to others (N, 3) [m]: prediction without the antenna at the others, its gain
(N,) [dB], and P(indoor) of the others (N,).
"""

MOST_POSITIONS, LEAST_SPACING_M, BEYOND_M = 1500, 0.25, 10.0
"""Number of candidates, their smallest spacing, and largest distance from free cells [m]."""

MOST_GROUPS, MOST_GROUPS_THROUGH_WALLS = 25, 40
"""Number of groups of neighbouring measurements; one of each group is traced."""

CORRELATION_M = 3.0
"""Correlation length of prediction errors along walks [m]; with it the 90 % region holds 90 % of the transmitters of
procedural homes, unreceived ones included.
"""

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
    through_walls: bool = False,
) -> TransmitterPosterior:
    """Compare positions by the likelihood of measurements of one transmitter, weighted by P(indoor).

    By reciprocity, links are predicted from the measured positions to all others that are `allowed`. The
    log-likelihood is divided by the number of correlated neighbours. Unknown wall materials are compared together
    with the positions.
    """
    posterior = _grid(partial, measured)
    points_m = posterior.points_m
    received = measured.gain_db > measured.sensitivity_db
    groups = MOST_GROUPS_THROUGH_WALLS if through_walls else MOST_GROUPS
    some = measured.take(grouped(measured.rx, received, groups)[0])
    possible = np.flatnonzero(allowed(points_m))
    if not len(possible):
        raise PositionError("a transmitter can be nowhere: no position is away from walls and measurements.")
    partial.require_positions("tx", points_m[possible])
    log_p, weights, p_indoor = np.zeros(()), np.ones(1), np.zeros(len(possible))
    for index, each_m in enumerate(some.rx):
        report(index / len(some), "comparing positions of the transmitter")
        prediction, antenna_db, indoor = predict(each_m, points_m[possible])
        p_indoor += indoor / len(some)
        materials, weights = prediction.by_material
        one = some.take(np.array([index]))
        log_p = log_p + np.stack([_log_likelihood(each, one, antenna_db) for each in materials])
    walks_m = Walks(partial, some.rx, 10.0 * CORRELATION_M).lengths_m(some.rx)
    log_p *= len(some) / np.exp(-walks_m / CORRELATION_M).sum()
    log_p = logsumexp(log_p + np.log(weights)[:, None, None], axis=0)
    log_p += _log_offset_prior()[:, None] + np.log(np.maximum(p_indoor, OUTDOOR))
    joint = np.exp(log_p - logsumexp(log_p))
    posterior.probability.ravel()[possible] = joint.sum(axis=0)
    p_powers = np.zeros(posterior.probability.shape)
    p_powers.ravel()[possible] = joint[OFFSETS_DB != 0.0].sum(axis=0) / np.maximum(joint.sum(axis=0), 1e-300)
    return replace(posterior, p_powers=p_powers)


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


def _log_offset_prior() -> Floats:
    weight = np.where(OFFSETS_DB == 0.0, 0.0, np.exp(-0.5 * (OFFSETS_DB / OFFSET_STD_DB) ** 2))
    return np.log(FREE_P_POWERS * weight / weight.sum() + (1.0 - FREE_P_POWERS) * (OFFSETS_DB == 0.0))
