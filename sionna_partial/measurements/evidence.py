"""Evidence of measurements: their kinds, noise and materials as hypotheses, and the Gaussian process under each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import log_ndtr, logsumexp

from sionna_partial.arrays import Bools, Floats
from sionna_partial.constants import CellState
from sionna_partial.measurements.kinds import Kind, kinds_through_walls
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.walks import Walks
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.prediction.wall_materials import (
    FADINGS_DB,
    OTHERS_WEIGHT,
    OWN_WEIGHT,
    STDS_DB,
    Residuals,
    log_std_prior,
    mean_square,
)

UNSEEN_RANGE_M = 12.0
"""Correlation length of residuals if both links have an end in an unseen cell [m]."""

LOCAL_VARIANCE, LOCAL_M = 0.2, 0.5
"""Fraction of the variance of residuals with the correlation length `LOCAL_M` [m]."""

NOISES_DB, LIKELY_NOISE_DB, NOISE_SPREAD = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0), 3.0, 0.25
"""Candidate standard deviations of measurements where none is given, the most probable one, and the prior standard
deviation of its logarithm [dB].
"""

MOST_POINTS = 300
"""Number of positions above which neighbours are averaged."""

LEAST_EXPLAINED = 1e-6
"""Smallest eigenvalue of a correlation, and smallest explained fraction of the variance of an informed link."""

_SWEEPS, _DAMPING = 8, 0.5


def correlation(walks: Walks, points_m: Floats, kind: Kind, *, tx_seen: bool) -> Floats:
    """Return the correlation (P, N) of residuals at the points of walks and at points (N, 3) [m]."""
    walks_m = walks.lengths_m(points_m)
    seen = [tx_seen & (walks.partial.state_at(each_m) == CellState.FREE) for each_m in (walks.points_m, points_m)]
    range_m = np.where(seen[0][:, None] | seen[1], kind.seen_range_m, UNSEEN_RANGE_M)
    return (1 - LOCAL_VARIANCE) * np.exp(-walks_m / range_m) + LOCAL_VARIANCE * np.exp(-walks_m / LOCAL_M)


@dataclass(frozen=True, eq=False)
class LinkGeometry:
    """Walks from the measured receivers, transmitter (3,) [m], and frequency of links."""

    walks: Walks
    tx_m: Floats
    frequency_hz: float

    @property
    def tx_seen(self) -> bool:
        """True if the transmitter is in a free cell."""
        return bool(self.walks.partial.state_at(self.tx_m[None])[0] == CellState.FREE)

    def free_space_db(self, rx_m: Floats) -> Floats:
        """Return the gain (N,) in free space [dB]."""
        return free_space_gain_db(np.linalg.norm(rx_m - self.tx_m, axis=1), self.frequency_hz)

    def correlation(self, rx_m: Floats, kind: Kind) -> Floats:
        """Return the correlation (P, N) of residuals at measured receivers and at others (N, 3) [m]."""
        return correlation(self.walks, rx_m, kind, tx_seen=self.tx_seen)


class Sample(NamedTuple):
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
    def of(cls, measured: Measurements, antenna_db: Floats) -> Sample:
        """Group measurements, without the gain of the transmitter's antenna [dB]."""
        level_db, received = measured.of_paths(antenna_db)
        first, group, size = grouped(measured.rx, received, MOST_POINTS)
        return cls(measured, level_db, measured.rx[first], received[first], size, group)

    def averaged(self, values: Floats) -> Floats:
        """Return the means (P,) of values (M,) in each group."""
        return np.bincount(self.group, weights=values) / self.size

    def noises_db(self) -> dict[float, Floats]:
        """Return standard deviations (P,) of averages by the noise of a measurement [dB]."""
        std_db = self.measured.std_db
        if std_db is None:
            return {noise_db: noise_db / np.sqrt(self.size) for noise_db in NOISES_DB}
        return {LIKELY_NOISE_DB: np.sqrt(self.averaged(std_db**2) / self.size)}


class Hypothesis(NamedTuple):
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
        """Covariance (P, P) of residuals with an unknown offset and factor."""
        return self.correlation + self.design.T @ self.kind.covariance @ self.design

    def log_evidence(self, received: Bools) -> float:
        """Return the logarithm of the likelihood of the received groups, up to a constant."""
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


class Fit(NamedTuple):
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
    def of(cls, best: Hypothesis, received: Bools, fading_db: float = 0.0) -> Fit:
        """Return the process under the most probable hypothesis."""
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


def hypotheses(
    sample: Sample, links: LinkGeometry, prior: LinkPrediction, kinds: Sequence[Kind], p_powers: float
) -> Iterator[Hypothesis]:
    """Yield a hypothesis for each kind and noise of measurements of links that are predicted by `prior`."""
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
            each = Hypothesis(log_p, kind, mean_db, design, correlation, residual, noise_db / scale_db)
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


class Compared(NamedTuple):
    """Measurements of one transmitter through walls, and their kinds under K candidate materials."""

    sample: Sample
    links: LinkGeometry
    materials: Sequence[LinkPrediction]
    kinds: Sequence[Sequence[Kind]]
    correlation: Floats

    @classmethod
    def of(
        cls,
        sample: Sample,
        links: LinkGeometry,
        materials: Sequence[LinkPrediction],
        others: Sequence[Sequence[tuple[Floats, Floats]]],
    ) -> Compared:
        """Return kinds whose priors are updated by `others`, each with precisions and shifts by material."""
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

    def fit(self, material: int, posterior: _Posterior) -> Fit:
        """Return the process under a candidate material."""
        best, fading_db = self._hypothesis(material, posterior)
        return Fit.of(best, self.sample.received, fading_db)

    def in_common(self, material: int, posterior: _Posterior) -> tuple[Floats, Floats]:
        """Return `Hypothesis.in_common` of the most probable kind under a candidate material."""
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

    def _hypothesis(self, material: int, posterior: _Posterior) -> tuple[Hypothesis, float]:
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
        return Hypothesis(0.0, kind, noise_db, design, self.correlation, residual, noise), fading_db


def _fitting(log_evidence: Floats, candidates: int) -> Floats:
    """Return the evidence (K, S, N) of another transmitter, averaged over its candidates if they differ."""
    if len(log_evidence) in (1, candidates):
        return log_evidence
    return logsumexp(log_evidence, axis=0, keepdims=True) - math.log(len(log_evidence))


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
    return (vectors * np.maximum(values, LEAST_EXPLAINED)) @ vectors.T


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
