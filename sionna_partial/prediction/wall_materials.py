"""The unknown material of walls: candidates for the losses of crossings and reflections, prior and evidence.

Paths do not depend on the material of the walls, only their powers do: each candidate adds a loss to every crossing and
reflection of a trace with drywall. The prior is a mixture of log-normal distributions around the mean losses of common
materials (`tracing.power.wall_loss_db`; ITU-R P.2040-3, 3GPP TR 38.901). Measured powers are evidence (`Assimilation`):
residuals of a trace are a Gaussian process, white noise, a common offset and a common factor on the loss of walls.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Floats
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.prediction.features import LinkFeatures, context_of
from sionna_partial.settings import DRYWALL, WALL_MATERIALS
from sionna_partial.tracing.paths import path_gain_db
from sionna_partial.tracing.power import wall_loss_db

COMMON = {"drywall": 0.4, "brick": 0.35, "concrete": 0.25}
"""Wall materials and their prior probabilities."""

MODELS_HZ = (1e9, 40e9)
"""Frequencies that all material models cover [Hz]."""

SCATTER = math.log(1.7)
"""Standard deviation of the logarithm of losses of one material."""

CROSSINGS, LARGEST_DB, REFLECTIONS_DB = 8, (21.0, 40.0), (0.0, 3.0)
"""Number of candidate wall losses, limits of the largest, and extra losses of a reflection [dB]."""

P_SAME, EVERY = 0.7, 2
"""Prior probability that thin and thick walls are of one material, and step of the losses that they have otherwise."""

BELOW = 1.3
"""Ratio of the smallest mean loss of a common material to the smallest candidate."""

LIKELY_STD_DB, LIKELY_FADING_DB = 5.0, 3.0
"""Most probable standard deviations of measured powers about a trace [dB]: of a spatial process, and of fading
(`benchmarks/reality.py`).
"""

RESIDUAL_DB = math.hypot(LIKELY_STD_DB, LIKELY_FADING_DB)
"""Prior standard deviation of gains about a trace [dB]."""

STDS_DB, STD_SPREAD = (2.5, 3.5, 5.0, 7.0, 10.0), 0.4
"""Candidate standard deviations of the process [dB], and the prior standard deviation of their logarithm."""

FADINGS_DB = np.array([1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0])
"""Candidate standard deviations of fading [dB]."""

FADING_SPREAD = 0.5
"""Prior standard deviation of the logarithm of fading."""

OWN_WEIGHT, OTHERS_WEIGHT = 0.5, 0.3
"""Exponents of the evidence of a transmitter's own powers and of other transmitters' powers, whose errors correlate."""


@dataclass(frozen=True, eq=False)
class WallMaterials:
    """Candidates for the material of the walls.

    Parameters
    ----------
    crossing_db : (K, 2) float64 array
        Losses per crossing of thin and thick walls beyond drywall [dB]; equal unless the map has both.
    reflection_db : (K,) float64 array
        Loss per reflection beyond drywall [dB].
    prior : (K,) float64 array
        Probability of each candidate.
    names : (K, 2) str array
        The `COMMON` materials with the nearest loss on a logarithmic scale.
    traced_db : float
        Loss of a crossed wall of drywall [dB].
    """

    crossing_db: Floats
    reflection_db: Floats
    prior: Floats
    names: NDArray[np.str_]
    traced_db: float

    @classmethod
    @lru_cache(maxsize=16)
    def at(cls, frequency_hz: float, class_count: int = 1) -> "WallMaterials":
        covered_hz = min(max(frequency_hz, MODELS_HZ[0]), MODELS_HZ[1])
        mean_db = np.array([wall_loss_db(WALL_MATERIALS[name], covered_hz) for name in COMMON])
        losses_db = np.geomspace(mean_db.min() / BELOW, np.clip(mean_db.max(), *LARGEST_DB), CROSSINGS)
        apart = np.log(losses_db[:, None] / mean_db)
        density = np.exp(-0.5 * (apart / SCATTER) ** 2)
        of_loss = density / density.sum(axis=0) @ [*COMMON.values()]
        prior, level = np.tile(of_loss / len(REFLECTIONS_DB), len(REFLECTIONS_DB)), np.arange(CROSSINGS)
        pairs, reflection_db = np.tile(level, (2, len(REFLECTIONS_DB))), np.repeat(REFLECTIONS_DB, CROSSINGS)
        if class_count > 1:
            of_few = of_loss.reshape(-1, EVERY).sum(axis=1)
            differ = np.array(np.nonzero(~np.eye(len(of_few), dtype=bool)))
            of_pair = of_few[differ].prod(axis=0)
            prior = np.append(P_SAME * prior, (1.0 - P_SAME) * of_pair / of_pair.sum())
            pairs = np.append(pairs, level[EVERY - 1 :: EVERY][differ], axis=1)
            reflection_db = np.append(reflection_db, np.full(len(of_pair), np.mean(REFLECTIONS_DB)))
        traced_db = wall_loss_db(DRYWALL, frequency_hz)
        names = np.array([*COMMON])[np.abs(apart).argmin(axis=1)]
        return cls((losses_db - traced_db)[pairs.T], reflection_db, prior, names[pairs.T], traced_db)

    def under(self, phi: LinkFeatures, fractions: Floats) -> list[LinkFeatures]:
        """Return the features under each candidate; `fractions` (2,) of walls are from `PartialMap.unnamed_walls`."""
        pairs = zip(self.crossing_db, self.reflection_db.tolist(), strict=True)
        return [with_extra_losses(phi, *pair, fractions) for pair in pairs]

    def attributes(self, weights: Floats, fractions: Floats) -> dict[str, str | float]:
        mean_db = float(weights @ self.crossing_db @ fractions / fractions.sum())
        return {"wall_material": self.text(weights), "wall_loss_db": mean_db + self.traced_db}

    def text(self, weights: Floats) -> str:
        thin, thick = (_probabilities(weights, names) for names in self.names.T)
        return thin if thin == thick else f"{thin}; thick walls {thick}"


def with_extra_losses(
    phi: LinkFeatures, crossing_db: Floats, reflection_db: float, fractions: ArrayLike = (1.0, 0.0)
) -> LinkFeatures:
    """Return features with additional losses (2,) per crossing of a thin or thick wall and per reflection [dB]."""
    assert phi.path_power is not None
    power, sizes, context = phi.path_power, phi.path_power.shape[1:], context_of(phi)
    losses_db = [*crossing_db[: len(sizes) - 1], reflection_db]
    for loss_db, size in zip(reversed(losses_db), reversed(sizes), strict=True):
        power = power @ 10.0 ** (-loss_db * np.arange(size) / 10.0)
    gain_db = path_gain_db(power)
    states = np.where(gain_db > GAIN_FLOOR_DB, phi.link_state, LinkState.OUTAGE)
    change_db = float(np.dot(crossing_db, fractions))
    straight_db = context.straight_gain_db - change_db / np.sum(fractions) * context.straight_walls
    context = replace(
        context,
        straight_gain_db=np.maximum(straight_db, GAIN_FLOOR_DB),
        wall_loss_db=context.wall_loss_db + change_db,
    )
    return replace(phi, gain_db=gain_db, link_state=states, context=context)


def _probabilities(weights: Floats, names: NDArray[np.str_]) -> str:
    shown = sorted(((round(float(weights[names == name].sum()), 2), name) for name in COMMON), reverse=True)
    return ", ".join(f"{name} {p:.2f}".replace(" 0.", " .") for p, name in shown if p > 0.0)


class Residuals(NamedTuple):
    """Residuals of P averages of `size` (P,) measurements under K candidates.

    `correlation` is (P, P); residuals less the expected common part, predictions above free space, and standard
    deviations without the process are (K, P) [dB]; `covariance` (K, 2, 2) is the prior of offset [dB] and factor.
    """

    correlation: Floats
    size: Floats
    residual_db: Floats
    below_db: Floats
    std_db: Floats
    covariance: Floats

    def log_evidence(self, noises_db: Floats) -> Floats:
        """Return the log-likelihood (K, S, N), up to a constant, for `STDS_DB` and noises [dB].

        The ratio of noise to process is assumed equal at all P.
        """
        root = np.sqrt(self.size)
        values, vectors = np.linalg.eigh(self.correlation * root[:, None] * root)
        values = np.maximum(values, 1e-6)
        rows_db = np.stack([self.residual_db, np.ones_like(self.below_db), self.below_db], axis=1) * root
        found, prior = np.empty((len(rows_db), len(STDS_DB), len(noises_db))), np.linalg.inv(self.covariance)
        for s, process_db in enumerate(STDS_DB):
            scale_db = np.hypot(self.std_db, process_db)
            rows = (rows_db / scale_db[:, None]) @ vectors
            relative = noises_db**2 * (scale_db**-2.0).sum(axis=1)[:, None] / max(len(root), 1)
            spectrum = values + relative[..., None]
            products = rows[:, :, None] * rows[:, None]
            gram = (1.0 / spectrum) @ products.reshape(len(rows), 9, len(root)).swapaxes(1, 2)
            gram = gram.reshape(*spectrum.shape[:2], 3, 3)
            offset, factor = (prior[:, at, at, None] + gram[..., at + 1, at + 1] for at in (0, 1))
            both, (first, second) = prior[:, 0, 1, None] + gram[..., 1, 2], np.moveaxis(gram[..., 1:, 0], -1, 0)
            determinant = offset * factor - both**2
            explained = (factor * first**2 - 2.0 * both * first * second + offset * second**2) / determinant
            volume = np.log(spectrum).sum(axis=-1) + np.log(determinant) - np.linalg.slogdet(prior)[1][:, None]
            found[:, s] = -0.5 * (gram[..., 0, 0] - explained + volume) - np.log(scale_db).sum(axis=1)[:, None]
        return found


def log_std_prior() -> Floats:
    apart = np.log(np.array(STDS_DB) / LIKELY_STD_DB) / STD_SPREAD
    fading_apart = np.log(FADINGS_DB / LIKELY_FADING_DB) / FADING_SPREAD
    log_prior: Floats = -0.5 * apart[:, None] ** 2 - 0.5 * fading_apart**2
    return log_prior


def mean_square(values: Floats, weights: Floats) -> float:
    """Return the root of the weighted mean square."""
    return math.sqrt(float(weights @ values**2 / weights.sum()))
