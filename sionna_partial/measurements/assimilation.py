"""Correction of predictions by measurements: a Gaussian process on residuals, over walking lengths."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import log_ndtr, logsumexp

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.checks import float_array, require, require_number, require_type
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.display import Shown
from sionna_partial.errors import MeasurementError, PositionError, SettingsError
from sionna_partial.maps.grid import position_array
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.walks import Walks
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.predictor import LinkPrediction
from sionna_partial.prediction.wall_materials import (
    FADINGS_DB,
    LIKELY_STD_DB,
    OTHERS_WEIGHT,
    OWN_WEIGHT,
    STDS_DB,
    Residuals,
    log_std_prior,
    mean_square,
)
from sionna_partial.settings import FREQUENCIES_HZ

UNSEEN_RANGE_M = 12.0
"""Correlation length of residuals if both links have an end in an unseen cell [m]."""

LOCAL_VARIANCE, LOCAL_M = 0.2, 0.5
"""Fraction of the variance of residuals with the correlation length `LOCAL_M` [m]."""

NOISES_DB, LIKELY_NOISE_DB, NOISE_SPREAD = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0), 3.0, 0.25
"""Candidate standard deviations of measurements where none is given, the most probable one, and the prior standard
deviation of its logarithm [dB].
"""


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


LEAST_WEIGHT = 0.01
"""Smallest probability of a candidate in predictions."""

BETWEEN_STDS = tuple(itertools.product((1.5, 3.0, 6.0, 9.0), (0.1, 0.2, 0.3)))
"""Candidate standard deviations of offset [dB] and factor between transmitters of a building."""

LIKELY_BETWEEN, BETWEEN_SPREAD = (3.0, 0.2), 0.5
"""Most probable of them a priori, and the standard deviation of their logarithms."""

MOST_POINTS = 300
"""Number of positions above which neighbours are averaged."""

_SWEEPS, _DAMPING = 8, 0.5
_RANGES = 5.0
_LEAST_EXPLAINED = 1e-6
_LEAST_P = 1e-6


def correlation(walks: Walks, points_m: Floats, kind: Kind, *, tx_seen: bool) -> Floats:
    """Return the correlation (P, N) of residuals at the points of walks and at points (N, 3) [m]."""
    walks_m = walks.lengths_m(points_m)
    seen = [tx_seen & (walks.partial.state_at(each_m) == CellState.FREE) for each_m in (walks.points_m, points_m)]
    range_m = np.where(seen[0][:, None] | seen[1], kind.seen_range_m, UNSEEN_RANGE_M)
    return (1 - LOCAL_VARIANCE) * np.exp(-walks_m / range_m) + LOCAL_VARIANCE * np.exp(-walks_m / LOCAL_M)


@dataclass(frozen=True, eq=False)
class _Links:
    walks: Walks
    tx_m: Floats
    frequency_hz: float

    @property
    def tx_seen(self) -> bool:
        return bool(self.walks.partial.state_at(self.tx_m[None])[0] == CellState.FREE)

    def free_space_db(self, rx_m: Floats) -> Floats:
        return free_space_gain_db(np.linalg.norm(rx_m - self.tx_m, axis=1), self.frequency_hz)

    def correlation(self, rx_m: Floats, kind: Kind) -> Floats:
        return correlation(self.walks, rx_m, kind, tx_seen=self.tx_seen)


class _Sample(NamedTuple):
    """M measurements in P groups of neighbours: positions (P, 3), received (P,), sizes (P,), group (M,).

    `level_db` (M,) are gains without the antenna, or their upper limits [dB].
    """

    measured: Measurements
    level_db: Floats
    rx_m: Floats
    received: Bools
    size: NDArray[np.intp]
    group: NDArray[np.intp]

    @classmethod
    def of(cls, measured: Measurements, antenna_db: Floats) -> _Sample:
        level_db, received = measured.of_paths(antenna_db)
        first, group, size = grouped(measured.rx, received, MOST_POINTS)
        return cls(measured, level_db, measured.rx[first], received[first], size, group)

    def averaged(self, values: Floats) -> Floats:
        return np.bincount(self.group, weights=values) / self.size

    def noises_db(self) -> dict[float, Floats]:
        """Return standard deviations (P,) of averages by the noise of a measurement [dB]."""
        std_db = self.measured.std_db
        if std_db is None:
            return {noise_db: noise_db / np.sqrt(self.size) for noise_db in NOISES_DB}
        return {LIKELY_NOISE_DB: np.sqrt(self.averaged(std_db**2) / self.size)}


class _Hypothesis(NamedTuple):
    """Kind and noise of measurements; dimensionless residuals, covariance and noise of their process."""

    log_p: float
    kind: Kind
    noise_db: float
    design: Floats
    correlation: Floats
    residual: Floats
    noise: Floats

    @property
    def covariance(self) -> Floats:
        return self.correlation + self.design.T @ self.kind.covariance @ self.design

    def log_evidence(self, received: Bools) -> float:
        z = np.maximum(self.residual, -self.kind.deepest)[received]
        factor = cho_factor(
            self.covariance[np.ix_(received, received)] + np.diag(self.noise[received] ** 2), lower=True
        )
        return float(-0.5 * z @ cho_solve(factor, z) - np.log(np.diag(factor[0])).sum())

    def in_common(self, received: Bools) -> tuple[Floats, Floats]:
        """Return the precision (2, 2) of offset and factor, and its product with their mean, without a prior.

        Correlated residuals count once. Least squares with their covariance would derive the factor on shadows from
        differences between neighbours, which a trace predicts badly.
        """
        design, residual = self.design[:, received], self.residual[received]
        redundancy = self.correlation[np.ix_(received, received)].sum() / max(1, received.sum())
        weight = 1.0 / (max(1.0, redundancy) * (1.0 + self.noise[received] ** 2))
        precision = (design * weight) @ design.T
        return precision, (design * weight) @ residual + precision @ self.kind.mean


class _Fit(NamedTuple):
    """Process under one material: weights (P,) and matrix (P, P) of its predictions.

    `fading_db` is the noise that other receivers share. Offset and factor have the posterior covariance `common` (2, 2)
    and the covariance `coupling` (2, P) with the process.
    """

    kind: Kind
    noise_db: float
    fading_db: float
    offset_db: float
    factor: float
    weights: Floats
    precision: Floats
    common: Floats
    coupling: Floats

    @classmethod
    def of(cls, best: _Hypothesis, received: Bools, fading_db: float = 0.0) -> _Fit:
        weights, precision = _posterior(best.covariance, best.residual, received, best.noise)
        design = best.kind.covariance @ best.design
        offset_db, factor = (best.kind.mean + design @ weights).tolist()
        coupling = design @ precision
        common = best.kind.covariance - coupling @ design.T
        return cls(best.kind, best.noise_db, fading_db, offset_db, factor, weights, precision, common, coupling)

    def common_variance(self, across: Floats, scale_db: Floats, below_db: Floats) -> Floats:
        """Return the variance (N,) added by uncertain offset and factor [dB²]."""
        design = np.stack([np.ones(len(below_db)), below_db])
        shared = self.common @ design - 2.0 * scale_db * (self.coupling @ across)
        return (design * shared).sum(axis=0)


def _hypotheses(
    sample: _Sample, links: _Links, prior: LinkPrediction, kinds: Sequence[Kind], p_powers: float
) -> Iterator[_Hypothesis]:
    measured, received = sample.measured, sample.received
    above_db = sample.level_db - prior.gain_mean_db
    below_db = prior.gain_mean_db - links.free_space_db(measured.rx)
    for kind, p_kind in zip(kinds, (1.0 - p_powers, p_powers), strict=True):
        scale_db = sample.averaged(np.hypot(prior.gain_std_db, kind.trace_std_db))
        offset_db, factor = kind.mean
        residual = sample.averaged(above_db - offset_db - (factor - 1.0) * below_db) / scale_db
        design = np.stack([np.ones(len(residual)), sample.averaged(below_db)]) / scale_db
        correlation = positive(links.correlation(sample.rx_m, kind))
        for each_db, noise_db in sample.noises_db().items():
            log_p = math.log(p_kind) - 0.5 * (math.log(each_db / LIKELY_NOISE_DB) / NOISE_SPREAD) ** 2
            log_p -= np.log(scale_db[received]).sum()
            mean_db = float(np.sqrt(np.mean(noise_db**2 * sample.size)))
            each = _Hypothesis(log_p, kind, mean_db, design, correlation, residual, noise_db / scale_db)
            yield each._replace(log_p=log_p + each.log_evidence(received))


class _Posterior(NamedTuple):
    """Probability of each kind, candidate material, and standard deviation of process and fading: (2, K, S, N)."""

    joint: Floats

    @classmethod
    def of(cls, log_p: Floats) -> _Posterior:
        return cls(np.exp(log_p - logsumexp(log_p)))

    @property
    def of_material(self) -> Floats:
        """Probability (K,) of each material."""
        kinds, _, processes, fadings = range(4)
        return np.asarray(self.joint.sum(axis=(kinds, processes, fadings)))

    def given(self, material: int) -> tuple[int, float, float]:
        """Return the most probable kind given a material, and its deviations of process and fading [dB]."""
        of_kind = self.joint[:, material].sum(axis=(1, 2))
        kind = int(of_kind.argmax())
        weights = self.joint[kind, material] if of_kind[kind] > 0.0 else np.ones(self.joint.shape[2:])
        process_db = mean_square(np.array(STDS_DB), weights.sum(axis=1))
        return kind, process_db, mean_square(FADINGS_DB, weights.sum(axis=0))


class _Compared(NamedTuple):
    """Measurements of one transmitter through walls, and their kinds under K candidate materials."""

    sample: _Sample
    links: _Links
    materials: Sequence[LinkPrediction]
    kinds: Sequence[Sequence[Kind]]
    correlation: Floats

    @classmethod
    def of(
        cls,
        sample: _Sample,
        links: _Links,
        materials: Sequence[LinkPrediction],
        others: Sequence[Sequence[tuple[Floats, Floats]]],
    ) -> _Compared:
        kinds = kinds_through_walls(len(materials))
        learnt = [
            [kind.learnt([other[min(k, len(other) - 1)] for other in others]) for kind in kinds]
            for k in range(len(materials))
        ]
        correlation = positive(links.correlation(sample.rx_m, kinds[0]))
        return cls(sample, links, materials, learnt, correlation)

    def posterior(self, p_powers: float, weights: Floats, others: Sequence[Floats]) -> tuple[_Posterior, Floats]:
        """Return the posterior, and the log-evidence (K, S, N) that these measurements are for other transmitters."""
        received = self.sample.received
        below_db, above_db, std_db = (np.stack(each) for each in zip(*map(self._levels, self.materials), strict=True))
        parts = []
        for kind, log_kind in enumerate(np.log([1.0 - p_powers, p_powers])):
            means = np.array([kinds[kind].mean for kinds in self.kinds])
            residual_db = above_db - means[:, :1] - (means[:, 1:] - 1.0) * below_db
            residuals = Residuals(
                self.correlation[np.ix_(received, received)],
                self.sample.size[received].astype(np.float64),
                residual_db[:, received],
                below_db[:, received],
                std_db[:, received],
                np.stack([kinds[kind].covariance for kinds in self.kinds]),
            )
            parts.append(log_kind + residuals.log_evidence(np.hypot(FADINGS_DB, self._given_db)))
        evidence = np.stack(parts)
        log_prior = np.log(weights)[:, None, None] + log_std_prior()
        for other in others:
            log_prior = log_prior + OTHERS_WEIGHT * _fitting(other, len(weights))
        return _Posterior.of(OWN_WEIGHT * evidence + log_prior), logsumexp(evidence, axis=0)

    def fit(self, material: int, posterior: _Posterior) -> _Fit:
        best, fading_db = self._hypothesis(material, posterior)
        return _Fit.of(best, self.sample.received, fading_db)

    def in_common(self, material: int, posterior: _Posterior) -> tuple[Floats, Floats]:
        return self._hypothesis(material, posterior)[0].in_common(self.sample.received)

    def _levels(self, prior: LinkPrediction) -> tuple[Floats, Floats, Floats]:
        """Return averages (P,) of prior above free space, measurement above prior, and the prior's deviation [dB]."""
        averaged, free_db = self.sample.averaged, self.links.free_space_db(self.sample.measured.rx)
        below_db, above_db = prior.gain_mean_db - free_db, self.sample.level_db - prior.gain_mean_db
        return averaged(below_db), averaged(above_db), averaged(prior.gain_std_db)

    @property
    def _given_db(self) -> float:
        std_db = self.sample.measured.std_db
        return 0.0 if std_db is None else float(np.sqrt(np.mean(std_db**2)))

    def _hypothesis(self, material: int, posterior: _Posterior) -> tuple[_Hypothesis, float]:
        """Return the most probable kind under a candidate material, and the fading [dB]."""
        number, process_db, fading_db = posterior.given(material)
        noise_db = float(np.hypot(fading_db, self._given_db))
        below_db, above_db, std_db = self._levels(self.materials[material])
        kind = self.kinds[material][number]._replace(trace_std_db=process_db)
        scale_db = np.hypot(std_db, process_db)
        residual = (above_db - kind.mean[0] - (kind.mean[1] - 1.0) * below_db) / scale_db
        design = np.stack([np.ones(len(residual)), below_db]) / scale_db
        given_db2 = 0.0 if self.sample.measured.std_db is None else self.sample.averaged(self.sample.measured.std_db**2)
        noise = np.sqrt((fading_db**2 + given_db2) / self.sample.size) / scale_db
        return _Hypothesis(0.0, kind, noise_db, design, self.correlation, residual, noise), fading_db


def _fitting(log_evidence: Floats, candidates: int) -> Floats:
    """Return the evidence (K, S, N) of another transmitter, averaged over its candidates if they differ."""
    if len(log_evidence) in (1, candidates):
        return log_evidence
    return logsumexp(log_evidence, axis=0, keepdims=True) - math.log(len(log_evidence))


@read_only
@dataclass(frozen=True, eq=False)
class Assimilation(Shown):
    """Posterior of the links to other receivers, given measurements of one transmitter (`fit`).

    Residuals (gain minus predicted mean, in predicted standard deviations) are a Gaussian process whose correlation
    decreases with the walking length between receivers. A measurement at or below the sensitivity is an upper bound
    (expectation propagation; Rasmussen and Williams, Gaussian Processes for Machine Learning, sections 3.6 and 3.9).
    Noise and common offset maximise the likelihood; with a large offset, as of a real radio, the predicted loss over
    free space is scaled, too.

    Through walls of an unknown material there is one process per candidate, weighted by its evidence, also from other
    transmitters.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1, 1], [1, 0, 0, 0, 2, 1], [1, 0, 0, 0, 2, 1], [1, 1, 1, 1, 1, 1]]
    >>> partial, tx = sp.map_from_array(cells, resolution_m=1.0), (4.5, 1.5, 1.5)  # in a cell that was not seen
    >>> model = sp.LinkModel(partial)
    >>> measured = sp.Measurements(tx, [(1.5, 1.5, 1.5), (2.5, 2.5, 1.5)], [-81.0, -78.0])
    >>> from sionna_partial.measurements.assimilation import Assimilation
    >>> posterior = Assimilation.fit(partial, tx, measured, model.predict(tx, measured.rx))
    >>> rx = [(2.2, 1.8, 1.5)]
    >>> before = model.predict(tx, rx)
    >>> bool(posterior.update(rx, before).gain_mean_db < before.gain_mean_db)
    True
    """

    noise_db: float
    """Standard deviation of the measurements, given noise and fading [dB]."""

    offset_db: float
    """Common offset of measurements above predictions [dB]."""

    shadow_scale: float
    """Factor on the predicted loss over free space."""

    material_weights: Floats
    """Probability (K,) of each candidate wall material; one element if it is known."""

    _links: _Links = field(repr=False)
    _fits: tuple[_Fit | None, ...] = field(repr=False)
    _in_common: tuple[tuple[Floats, Floats], ...] = field(repr=False)
    _log_evidence: Floats = field(repr=False)

    @property
    def tx_m(self) -> Floats:
        """Transmitter (3,) [m]."""
        return self._links.tx_m

    @property
    def walks(self) -> Walks:
        """Walks from the measured receivers."""
        return self._links.walks

    @property
    def offset_std_db(self) -> float:
        """Standard error of `offset_db` [dB]."""
        fits = [fit for fit in self._fits if fit is not None]
        weights = self.material_weights[self.material_weights > 0.0]
        square_db2 = weights @ [fit.common[0, 0] + fit.offset_db**2 for fit in fits]
        return math.sqrt(max(0.0, float(square_db2) - self.offset_db**2))

    @classmethod
    def fit(
        cls,
        partial: PartialMap,
        tx_m: ArrayLike,
        measured: Measurements,
        prior: LinkPrediction,
        *,
        antenna_db: ArrayLike = 0.0,
        frequency_hz: float = CARRIER_FREQUENCY_HZ,
        p_powers: float | None = None,
        through_walls: bool = False,
        others: Sequence[Assimilation] = (),
        walks: Walks | None = None,
    ) -> Assimilation:
        """Fit the process to measurements.

        Parameters
        ----------
        partial : PartialMap
        tx_m : (3,) array-like
            Transmitter [m].
        measured : Measurements
            M links of this transmitter.
        prior : LinkPrediction
            Prediction of these links without measurements.
        antenna_db : float or (M,) array-like
            Gain of the transmitter's antenna [dB], included in `measured`, not in `prior`; `update` excludes it.
        frequency_hz : float
        p_powers : float, optional
            Prior probability of powers with an unknown offset instead of path gains.
        through_walls : bool
            True for a trace through walls, of a real radio: the loss of walls is inferred, and no trace is certain.
        others : sequence of Assimilation
            Fits to other transmitters of the building through walls, which inform losses and offsets.
        walks : Walks, optional
            `walks` of a fit to the same receivers on the same map, which saves time.

        Raises
        ------
        MeasurementError
            If `prior` has another number of links, or there are neither links nor `others`.
        MapError, PositionError, SettingsError
            For arguments of another kind.
        """
        require_map("partial", partial)
        require_type("measured", measured, Measurements, "give sp.Measurements(...).")
        require_type("prior", prior, LinkPrediction, "give what Predictor.predict returned of the measured links.")
        require_number("frequency_hz", frequency_hz, *FREQUENCIES_HZ)
        if p_powers is not None:
            require_number("p_powers", p_powers, 0.0, 1.0)
        if not len(measured) == len(prior.p_los) or not (len(measured) or others):
            raise MeasurementError(
                f"prior has {len(prior.p_los)} links, and measured {len(measured)}: give the same links, at least one "
                "without others."
            )
        tx_m = position_array("tx_m", tx_m)
        if tx_m.shape != (3,) or not np.isfinite(tx_m).all():
            raise PositionError(f"tx_m = {tx_m.tolist()} is not a position: give x, y, z of one transmitter in metres.")
        gains_db = float_array("antenna_db", antenna_db, SettingsError, "give one gain [dB], or one for each link.")
        good = gains_db.shape in ((), (len(measured),)) and bool(np.isfinite(gains_db).all())
        require(good, "antenna_db", antenna_db, f"give one finite gain [dB], or one for each of {len(measured)} links.")
        sample = _Sample.of(measured, gains_db)
        if p_powers is None:
            p_powers = P_POWERS if partial.state_at(tx_m[None])[0] == CellState.FREE else UNSEEN_P_POWERS
            p_powers = FREE_P_POWERS if through_walls else p_powers
        p_powers = min(max(p_powers, _LEAST_P), 1.0 - _LEAST_P)
        longest_m = _RANGES * max(UNSEEN_RANGE_M, *(kind.seen_range_m for kind in (*KINDS, *KINDS_THROUGH_WALLS)))
        if walks is None or walks.partial is not partial or not np.array_equal(walks.points_m, sample.rx_m):
            walks = Walks(partial, sample.rx_m, longest_m)
        links = _Links(walks, tx_m, float(frequency_hz))
        if through_walls:
            return cls._through_walls(sample, links, prior, p_powers, others)
        hypotheses = _hypotheses(sample, links, prior, KINDS, p_powers)
        fit = _Fit.of(max(hypotheses, key=lambda each: each.log_p), sample.received)
        return cls(fit.noise_db, fit.offset_db, fit.factor, np.ones(1), links, (fit,), (), np.zeros((1, 1, 1)))

    @classmethod
    def _through_walls(
        cls,
        sample: _Sample,
        links: _Links,
        prior: LinkPrediction,
        p_powers: float,
        others: Sequence[Assimilation],
    ) -> Assimilation:
        materials, weights = prior.materials
        compared = _Compared.of(sample, links, materials, [other._in_common for other in others])
        posterior, evidence = compared.posterior(p_powers, weights, [other._log_evidence for other in others])
        of_material = posterior.of_material
        kept = of_material > LEAST_WEIGHT * (len(materials) > 1)
        fits = tuple(compared.fit(k, posterior) if kept[k] else None for k in range(len(materials)))
        of_material = np.where(kept, of_material, 0.0) / of_material[kept].sum()
        common = [(fit.noise_db, fit.offset_db, fit.factor) for fit in fits if fit is not None]
        noise_db, offset_db, factor = (of_material[kept] @ common).tolist()
        in_common = tuple(compared.in_common(k, posterior) for k in range(len(materials)))
        return cls(noise_db, offset_db, factor, of_material, links, fits, in_common, evidence)

    def update(self, rx_m: ArrayLike, prior: LinkPrediction) -> LinkPrediction:
        """Return the prediction of links given the measurements.

        A predicted residual counts as a noisy measurement of the gain, which updates P(link state) and the gains given
        the state by Bayes' rule.

        Parameters
        ----------
        rx_m : (N, 3) array-like
            Receivers [m].
        prior : LinkPrediction
            Prediction of these links without measurements.

        Raises
        ------
        PositionError, SettingsError
            For arguments of another kind.
        """
        require_type("prior", prior, LinkPrediction, "give what Predictor.predict returned of the links.")
        rx_m = np.atleast_2d(position_array("rx_m", rx_m, least=0))
        opaque = self._fits[0] is not None and self._fits[0].kind.exact
        materials = (prior,) if opaque else prior.materials[0]
        updated, across = [], None
        for fit, links in zip(self._fits, materials, strict=True):
            if fit is not None:
                across = self._links.correlation(rx_m, fit.kind) if across is None else across
                updated.append(self._updated(fit, across, rx_m, links))
        return LinkPrediction.mixture(updated, self.material_weights[self.material_weights > 0.0])

    def _updated(self, fit: _Fit, across: Floats, rx_m: Floats, prior: LinkPrediction) -> LinkPrediction:
        """Update links under one material; `across` (P, N) are correlations with measured residuals."""
        kind, below_db = fit.kind, prior.gain_mean_db - self._links.free_space_db(rx_m)
        prior = self._shadowed(rx_m, prior, fit.factor)
        explained = np.clip(np.einsum("pn,pn->n", across, fit.precision @ across), 0.0, 1.0 - 1e-3)
        informed = explained > _LEAST_EXPLAINED
        explained = np.where(informed, explained, 1.0)
        scale_db = np.hypot(prior.gain_std_db, kind.trace_std_db)
        gain_db = prior.gain_mean_db + scale_db * (fit.weights @ across) / explained
        noise_db2 = scale_db**2 * (1.0 - explained) / explained
        probabilities, means_db, stds_db = prior.by_state
        variance = stds_db**2 + kind.trace_std_db**2
        total = variance + noise_db2
        with np.errstate(divide="ignore"):
            logs = np.log(probabilities)
            logs -= np.where(informed, 0.5 * np.log(total) + 0.5 * (gain_db - means_db) ** 2 / total, 0.0)
        weights = np.exp(logs - logs.max(axis=0))
        has_path = np.arange(3)[:, None] != LinkState.OUTAGE
        pull = np.where(informed & has_path, variance / total, 0.0)
        means_db = np.clip(means_db + pull * (gain_db - means_db), GAIN_FLOOR_DB, 0.0)
        common = 0.0 if kind.exact else fit.common_variance(across, scale_db, below_db)
        left = np.maximum(variance * (1.0 - pull) + common, 0.0) + fit.fading_db**2
        left = np.where(has_path, left, 0.0)
        stds_db = np.sqrt(np.maximum(np.minimum(stds_db**2, left) if kind.exact else left, 0.0))
        updated = LinkPrediction.of_parts(weights / weights.sum(axis=0), means_db, stds_db)
        return prior.where(informed, updated) if kind.exact else updated

    def _shadowed(self, rx_m: Floats, prior: LinkPrediction, factor: float) -> LinkPrediction:
        if factor == 1.0:
            return prior
        free_db = self._links.free_space_db(rx_m)
        probabilities, means_db, stds_db = prior.by_state
        scaled_db = np.maximum(free_db + factor * (means_db - free_db), GAIN_FLOOR_DB)
        scaled_db[LinkState.OUTAGE] = GAIN_FLOOR_DB
        return LinkPrediction.of_parts(probabilities, scaled_db, stds_db)


def grouped(rx_m: Floats, received: Bools, most: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Group measurements (M,) by the cells of the finest grid about their middle with at most `most` groups.

    Return the first measurement of each group, the group of each measurement, and the group sizes.
    """
    edge_m, middle_m = 0.01, 0.5 * (rx_m.min(axis=0) + rx_m.max(axis=0)) if len(rx_m) else np.zeros(3)
    while True:
        keys = np.column_stack([np.round((rx_m - middle_m) / edge_m), received])
        _, first, group, count = np.unique(keys, axis=0, return_index=True, return_inverse=True, return_counts=True)
        if len(first) <= most:
            return first, group.ravel(), count
        edge_m *= 1.5


def positive(correlation: Floats) -> Floats:
    """Make a correlation (P, P) positive definite: walks are no Euclidean distances."""
    values, vectors = np.linalg.eigh(0.5 * (correlation + correlation.T))
    return (vectors * np.maximum(values, _LEAST_EXPLAINED)) @ vectors.T


def _posterior(covariance: Floats, residual: Floats, received: Bools, noise: Floats) -> tuple[Floats, Floats]:
    """Return weights (P,) and matrix (P, P) of predictions; residuals not received are upper bounds."""
    precision = np.where(received, 1.0 / noise**2, 0.0)
    shift = precision * residual
    for _ in range(1 if received.all() else _SWEEPS):
        inverse = _inverse(covariance, precision)
        variance = np.diag(covariance - covariance @ inverse @ covariance)
        mean = covariance @ (shift - inverse @ (covariance @ shift))
        cavity = 1.0 / np.maximum(1.0 / variance - precision, 1e-9)
        cavity_mean = cavity * (mean / variance - shift)
        spread = np.sqrt(cavity + noise**2)
        x = (residual - cavity_mean) / spread
        ratio = np.exp(-0.5 * (x**2 + math.log(2.0 * math.pi)) - log_ndtr(x))
        tilted = np.maximum(cavity - cavity**2 * ratio * (x + ratio) / spread**2, 1e-6)
        tilted_mean = cavity_mean - cavity * ratio / spread
        bounded_precision = np.clip(1.0 / tilted - 1.0 / cavity, 0.0, 1e6)
        bounded_shift = tilted_mean / tilted - cavity_mean / cavity
        precision = np.where(received, precision, (1 - _DAMPING) * precision + _DAMPING * bounded_precision)
        shift = np.where(received, shift, (1 - _DAMPING) * shift + _DAMPING * bounded_shift)
    inverse = _inverse(covariance, precision)
    return shift - inverse @ (covariance @ shift), inverse


def _inverse(covariance: Floats, precision: Floats) -> Floats:
    root = np.sqrt(precision)
    factor = cho_factor(np.eye(len(root)) + root[:, None] * covariance * root, lower=True)
    return root[:, None] * cho_solve(factor, np.diag(root))
