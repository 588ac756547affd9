"""Localisation of a transmitter: measured gains -> posterior over positions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr, logsumexp

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import Progress
from sionna_partial.constants import DEFAULT_HEIGHT_M, CellState
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.evidence import LIKELY_NOISE_DB, correlation, grouped, positive
from sionna_partial.measurements.kinds import FREE_P_POWERS, Kind, kinds_through_walls
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.walks import Walks
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.prediction.wall_materials import FADINGS_DB, OWN_WEIGHT, RESIDUAL_DB, Residuals, log_std_prior

Links = tuple[LinkPrediction, Floats, Floats]

Predict = Callable[[Floats, Floats], Links]
"""Return the links from a position (3,) to others (N, 3) [m]: prediction without the antenna at the others, its gain
(N,) [dB], and P(indoor) of the others (N,).
"""

MOST_POSITIONS, LEAST_SPACING_M, BEYOND_M = 1500, 0.25, 10.0
"""Number of candidates, their smallest spacing, and largest distance from free cells [m]."""

MOST_GROUPS, MOST_GROUPS_THROUGH_WALLS = 20, 40
"""Number of groups of neighbouring measurements, whose means are compared with predictions."""

MOST_TRACED = 16
"""Number of positions that are traced through walls; other groups have the loss over free space of the nearest one."""

REFINED = 12
"""Largest likely region whose positions are all compared, in blocks of 2 x 2: a larger one needs no finer grid."""

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
        weights = self.probability.ravel()
        possible = weights > 0.0
        points_m = self.points_m[possible]
        return points_m[(cdist(points_m, points_m) @ weights[possible]).argmin()]

    @property
    def std_m(self) -> float:
        """Root mean square distance from `position_m` [m]."""
        square = ((self.points_m - self.position_m) ** 2).sum(axis=1)
        return float(np.sqrt(square @ self.probability.ravel()))

    def draw(self, count: int) -> tuple[Floats, Floats, list[float | None]]:
        """Draw positions (K, 3) systematically, near ones in a row [m]; return also weights (K,) and P(powers)."""
        weights = self.probability.ravel()
        order = _spatial_order(self.points_m[:, :2], weights, np.flatnonzero(weights > 0.0))
        sums = np.cumsum(weights[order])
        drawn = order[np.searchsorted(sums / sums[-1], (np.arange(count) + 0.5) / count)]
        chosen, times = np.unique(drawn, return_counts=True)
        p_powers = [None] * len(chosen) if self.p_powers is None else self.p_powers.ravel()[chosen].tolist()
        return self.points_m[chosen], times / count, p_powers


def _spatial_order(points_m: Floats, weights: Floats, cells: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return cells in an order that divides them by halves of their weight, along their greater extent."""
    if len(cells) < 2:
        return cells
    axis = int(np.ptp(points_m[cells], axis=0).argmax())
    cells = cells[np.argsort(points_m[cells, axis], kind="stable")]
    sums = np.cumsum(weights[cells])
    middle = int(np.clip(np.searchsorted(sums, 0.5 * sums[-1], side="right"), 1, len(cells) - 1))
    parts = cells[:middle], cells[middle:]
    return np.concatenate([_spatial_order(points_m, weights, part) for part in parts])


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

    By reciprocity, links are predicted from some of the measured positions, each with the mean of its neighbours, to
    one of four others that are `allowed`, then to all in the likely region if it is small. Through walls, at the
    frequency `through_walls_hz`, residuals are the process of `Assimilation`. With opaque walls, the log-likelihood is
    divided by the number of correlated neighbours.
    """
    posterior = _grid(partial, measured)
    means = _Means.of(measured, MOST_GROUPS if through_walls_hz is None else MOST_GROUPS_THROUGH_WALLS)
    traced = np.arange(len(means.size)) if through_walls_hz is None else means.traced(partial)
    sources, of_group = np.unique(traced, return_inverse=True)
    points_m = posterior.points_m
    noise_db = 0.0 if measured.std_db is None else float(np.sqrt(np.mean(measured.std_db**2)))
    possible = allowed(points_m)
    if not possible.any():
        raise PositionError("a transmitter can be nowhere: no position is away from walls and measurements.")
    partial.require_positions("tx", points_m[possible])

    def compare(positions: NDArray[np.intp], begin: float) -> Floats:
        """Return the log-probability (2, K) of positions, up to a constant."""
        links = []
        for index, each_m in enumerate(means.measured.rx[sources]):
            report(begin + 0.5 * index / len(sources), "comparing positions of the transmitter")
            links.append(predict(each_m, points_m[positions]))
        if through_walls_hz is None:
            log_p = _log_independent(partial, means, links)
        else:
            of_groups = [links[source] for source in of_group]
            log_p = _log_process(partial, means, of_groups, traced, points_m[positions], through_walls_hz, noise_db)
        log_p += np.log([[1.0 - FREE_P_POWERS], [FREE_P_POWERS]])
        return log_p + np.log(np.maximum(np.mean([indoor for *_, indoor in links], axis=0), OUTDOOR))

    block = _blocks(*posterior.probability.shape)
    first, of_first = np.unique(block[possible], return_index=True)
    log_p = np.full((2, block.max() + 1), -np.inf)
    log_p[:, first] = compare(np.flatnonzero(possible)[of_first], 0.0)
    log_p = np.where(possible, log_p[:, block], -np.inf)
    likely = likely_region(np.asarray(np.bincount(block, _normalised(log_p).sum(axis=0)), dtype=np.float64))
    if likely.sum() <= REFINED:
        finer = np.flatnonzero(possible & likely[block])
        log_p[:, finer] = compare(finer, 0.5)
    joint = _normalised(log_p)
    shape = posterior.probability.shape
    p_powers = joint[1] / np.maximum(joint.sum(axis=0), 1e-300)
    return replace(posterior, probability=joint.sum(axis=0).reshape(shape), p_powers=p_powers.reshape(shape))


class _Means(NamedTuple):
    """Means of P groups of neighbouring measurements, each at the position nearest to the middle of its group.

    `size` (P,) are the numbers of measurements, `received` (P,) whether these were received. `rx_m` (M, 3) are their
    positions, `group` (M,) their groups.
    """

    measured: Measurements
    size: Floats
    received: Bools
    rx_m: Floats
    group: NDArray[np.intp]

    @classmethod
    def of(cls, measured: Measurements, most: int) -> _Means:
        received = measured.of_paths(0.0)[1]
        first, group, size = grouped(measured.rx, received, most)

        def mean(values: Floats) -> Floats:
            return np.bincount(group, weights=values) / size

        middle_m = np.stack([mean(axis_m) for axis_m in measured.rx.T], axis=1)
        apart_m = np.linalg.norm(measured.rx - middle_m[group], axis=1)
        order = np.lexsort([apart_m, group])
        nearest = order[np.searchsorted(group[order], np.arange(len(size)))]
        std_db = np.full(len(group), LIKELY_NOISE_DB) if measured.std_db is None else measured.std_db
        means = Measurements(
            measured.tx[nearest],
            measured.rx[nearest],
            mean(measured.gain_db),
            np.sqrt(mean(std_db**2) / size),
            measured.sensitivity_db,
        )
        return cls(means, size.astype(np.float64), received[first], measured.rx, group)

    def traced(self, partial: PartialMap) -> NDArray[np.intp]:
        """Return for each group (P,) the group whose position is traced for it: of `MOST_TRACED`, on a short walk."""
        rx_m = self.measured.rx
        kept = np.sort(grouped(rx_m, np.ones(len(rx_m), dtype=bool), MOST_TRACED)[0])
        walks_m = Walks(partial, rx_m[kept], FARTHEST_M).lengths_m(rx_m)
        around_m = FARTHEST_M + np.linalg.norm(rx_m[kept, None] - rx_m, axis=-1)
        nearest: NDArray[np.intp] = kept[np.where(np.isfinite(walks_m), walks_m, around_m).argmin(axis=0)]
        return nearest

    def free_space_db(self, points_m: Floats, frequency_hz: float) -> Floats:
        """Return the mean free-space gain (N, P) of the links between positions (N, 3) and each group [dB]."""
        member = (self.group[:, None] == np.arange(len(self.size))) / self.size
        return free_space_gain_db(cdist(points_m, self.rx_m), frequency_hz) @ member


def _blocks(ny: int, nx: int) -> NDArray[np.intp]:
    """Return the number (ny nx,) of the block of 2 x 2 positions that each belongs to."""
    row, column = np.divmod(np.arange(ny * nx), nx)
    return row // 2 * ((nx + 1) // 2) + column // 2


def _normalised(log_p: Floats) -> Floats:
    joint: Floats = np.exp(log_p - logsumexp(log_p))
    return joint


def _log_independent(partial: PartialMap, means: _Means, links: Sequence[Links]) -> Floats:
    """Return the log-likelihood (2, N) of gains and of powers with opaque walls: residuals are independent."""
    log_p, measured = np.zeros(()), means.measured
    for at, (prediction, antenna_db, _) in enumerate(links):
        log_p = log_p + _log_likelihood(prediction, measured.take(np.array([at])), antenna_db)
    walks_m = Walks(partial, measured.rx, FARTHEST_M).lengths_m(measured.rx)
    log_p *= len(measured) / np.exp(-walks_m / CORRELATION_M).sum()
    weights = np.where(OFFSETS_DB == 0.0, 0.0, np.exp(-0.5 * (OFFSETS_DB / OFFSET_STD_DB) ** 2))
    powers = logsumexp(log_p, axis=0, b=(weights / weights.sum())[:, None])
    return np.stack([log_p[OFFSETS_DB == 0.0][0], powers])


def _log_process(
    partial: PartialMap,
    means: _Means,
    links: Sequence[Links],
    traced: NDArray[np.intp],
    points_m: Floats,
    frequency_hz: float,
    noise_db: float,
) -> Floats:
    """Return the log-likelihood (2, N) of gains and of powers through walls: residuals are a Gaussian process.

    `links` are those of the position that is `traced` for each group.
    """
    measured = means.measured
    materials, weights = zip(*(prediction.materials for prediction, *_ in links), strict=True)
    mean_db, std_db = (
        np.array([[getattr(each, name) for each in of_link] for of_link in materials]).transpose(2, 1, 0)
        for name in ("gain_mean_db", "gain_std_db")
    )
    levels_db = [measured.take(np.array([at])).of_paths(antenna_db)[0] for at, (_, antenna_db, _) in enumerate(links)]
    below_db = mean_db - free_space_gain_db(cdist(points_m, measured.rx[traced]), frequency_hz)[:, None]
    above_db = np.transpose(levels_db)[:, None] - below_db - means.free_space_db(points_m, frequency_hz)[:, None]
    walks, seen = Walks(partial, measured.rx, FARTHEST_M), partial.state_at(points_m) == CellState.FREE
    kinds = kinds_through_walls(len(materials[0]))
    log_p = np.empty((len(kinds), len(points_m)))
    for tx_seen in (True, False):
        correlated = positive(correlation(walks, measured.rx, kinds[0], tx_seen=tx_seen))
        at = np.flatnonzero(seen == tx_seen)
        for some in (at[first : first + BLOCK] for first in range(0, len(at), BLOCK)):
            residuals_db = above_db[some], below_db[some], std_db[some]
            for number, kind in enumerate(kinds):
                of_material = _log_evidence(kind, correlated, means, *residuals_db, noise_db)
                log_p[number, some] = logsumexp(of_material + np.log(weights[0]), axis=1)
    return log_p


def _log_evidence(
    kind: Kind,
    correlation: Floats,
    means: _Means,
    above_db: Floats,
    below_db: Floats,
    std_db: Floats,
    noise_db: float,
) -> Floats:
    """Return the log-evidence (N, K) of N positions and K materials; residuals are (N, K, P) [dB].

    Residuals of links that were not received are independent, given the mean of the others.
    """
    received = means.received
    count, size = received.sum(), means.size[received]
    above, below, std = (each[..., received].reshape(-1, count) for each in (above_db, below_db, std_db))
    correlation, covariance = correlation[np.ix_(received, received)], kind.covariance[None]
    residuals = Residuals(correlation, size, above, below, std, covariance)
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
