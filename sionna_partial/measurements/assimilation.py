"""Correction of predictions by measurements: a Gaussian process on residuals, over walking lengths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats, read_only
from sionna_partial.checks import float_array, position_array, require, require_number, require_type
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.display import Shown
from sionna_partial.errors import MeasurementError, PositionError, SettingsError
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.measurements.evidence import (
    LEAST_EXPLAINED,
    UNSEEN_RANGE_M,
    Compared,
    Fit,
    LinkGeometry,
    Sample,
    hypotheses,
)
from sionna_partial.measurements.kinds import FREE_P_POWERS, KINDS, KINDS_THROUGH_WALLS, P_POWERS, UNSEEN_P_POWERS
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.walks import Walks
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.settings import FREQUENCIES_HZ

LEAST_WEIGHT = 0.01
"""Smallest probability of a candidate in predictions."""

_LEAST_P = 1e-6
_RANGES = 5.0


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

    _links: LinkGeometry = field(repr=False)
    _fits: tuple[Fit | None, ...] = field(repr=False)
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
        sample = Sample.of(measured, gains_db)
        if p_powers is None:
            p_powers = P_POWERS if partial.state_at(tx_m[None])[0] == CellState.FREE else UNSEEN_P_POWERS
            p_powers = FREE_P_POWERS if through_walls else p_powers
        p_powers = min(max(p_powers, _LEAST_P), 1.0 - _LEAST_P)
        longest_m = _RANGES * max(UNSEEN_RANGE_M, *(kind.seen_range_m for kind in (*KINDS, *KINDS_THROUGH_WALLS)))
        if walks is None or walks.partial is not partial or not np.array_equal(walks.points_m, sample.rx_m):
            walks = Walks(partial, sample.rx_m, longest_m)
        links = LinkGeometry(walks, tx_m, float(frequency_hz))
        if through_walls:
            return cls._through_walls(sample, links, prior, p_powers, others)
        found = hypotheses(sample, links, prior, KINDS, p_powers)
        fit = Fit.of(max(found, key=lambda each: each.log_p), sample.received)
        return cls(fit.noise_db, fit.offset_db, fit.factor, np.ones(1), links, (fit,), (), np.zeros((1, 1, 1)))

    @classmethod
    def _through_walls(
        cls,
        sample: Sample,
        links: LinkGeometry,
        prior: LinkPrediction,
        p_powers: float,
        others: Sequence[Assimilation],
    ) -> Assimilation:
        materials, weights = prior.materials
        compared = Compared.of(sample, links, materials, [other._in_common for other in others])
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

    def _updated(self, fit: Fit, across: Floats, rx_m: Floats, prior: LinkPrediction) -> LinkPrediction:
        """Update links under one material; `across` (P, N) are correlations with measured residuals."""
        kind, below_db = fit.kind, prior.gain_mean_db - self._links.free_space_db(rx_m)
        prior = self._shadowed(rx_m, prior, fit.factor)
        explained = np.clip(np.einsum("pn,pn->n", across, fit.precision @ across), 0.0, 1.0 - 1e-3)
        informed = explained > LEAST_EXPLAINED
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
