"""What the mean loss of walls predicts of links whose paths go through walls: the base that networks correct.

The gain falls by the mean loss of the known walls times the number of walls that unobserved space has on a direct line,
on average. The constants were fitted to procedural homes at 5 GHz, of drywall and of brick, and to procedural floors
and halls; `benchmarks/unseen_walls.py` measures others. They predict by default: networks that corrected them were no
better on real homes and floors.
"""

from typing import Any, NamedTuple

import numpy as np

from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.prediction.features import LinkFeatures, context_of

WALL_LOSSES = "the mean loss of unobserved walls"
"""Stands for the predictor's name in coverage maps."""

LOS_RANGE_M, LOS_FALL = 2.2, 2.2
"""Unobserved length at which a link that is traced in line of sight has LOS in half of all cases [m], and the exponent
with which that falls beyond."""

WALLS_RANGE_M = 10.0
"""Unobserved length from which on walls add little [m]: other paths than the direct one are the strongest there."""

FIRST_WALLS, WALLS_PER_M = 0.6, 0.19
"""Walls that a link loses which turns out to have no LOS, and those on each of the first unobserved metres of its
direct line."""

HIDDEN_WALLS_PER_M, HIDDEN_FROM_M = 0.18, 1.5
"""Walls on each unobserved metre, beyond the first, of links that are traced without LOS: unseen reflections make up
for part of them."""

LOS_GAIN_DB, SEEN_STD_DB, LOS_STD_DB, UNSEEN_STD = 1.0, 0.5, 0.4, 0.5
"""By how much unseen reflections add to a link with LOS, for the square root of a metre; standard deviations of gains
whose direct line is observed, and of links with LOS likewise [dB]; and of all other links, in losses of a wall [1]."""

_WEIGHT_DB, _LEAST_UNIT_DB, _UNIT_WALLS, _MOST_LOSS_DB = 20.0, 3.0, 0.5, 30.0


class MeanLosses(NamedTuple):
    """Distributions of N links by the mean loss of walls, or tensors of any shape (...) in place of N.

    Parameters
    ----------
    p : (N, 3) array
        Probability of each LinkState.
    means_db, stds_db : (N, 2) arrays
        Means and standard deviations of the gain given LOS, and given NLOS [dB].
    weight : (N,) array
        Weight of an error in training, relative to one of opaque walls: it falls with the loss of a wall.
    """

    p: Any
    means_db: Any
    stds_db: Any
    weight: Any

    @classmethod
    def of(cls, phi: LinkFeatures) -> "MeanLosses":
        """Predict links (N,) from features of a trace through walls, which have a context.

        A link that is traced in line of sight has LOS the rarer, the longer its direct line is unobserved.
        """
        wall_loss_db = context_of(phi).wall_loss_db
        unseen_m, los = phi.unobserved_distance_m, phi.link_state == LinkState.LOS
        p_los = np.where(los, 1.0 / (1.0 + (unseen_m / LOS_RANGE_M) ** LOS_FALL), 0.0)
        walled_m = WALLS_RANGE_M * np.log1p(unseen_m / WALLS_RANGE_M)
        root_m = np.sqrt(walled_m)
        hidden = HIDDEN_WALLS_PER_M * np.maximum(walled_m - HIDDEN_FROM_M, 0.0)
        walls = np.where(los, FIRST_WALLS + WALLS_PER_M * walled_m, hidden)
        mean_db = np.maximum(phi.gain_db - wall_loss_db * walls, GAIN_FLOOR_DB)
        p_outage = np.where(mean_db > GAIN_FLOOR_DB, 0.0, 1.0 - p_los)
        los_db = np.minimum(phi.gain_db + LOS_GAIN_DB * root_m, 0.0)
        los_std_db = np.hypot(SEEN_STD_DB, LOS_STD_DB * root_m)
        std_db = np.hypot(SEEN_STD_DB, UNSEEN_STD * wall_loss_db * root_m)
        return cls(
            p=np.stack([p_outage, p_los, 1.0 - p_los - p_outage], axis=1),
            means_db=np.stack([los_db, mean_db], axis=1),
            stds_db=np.stack([los_std_db, std_db], axis=1),
            weight=_WEIGHT_DB / (_LEAST_UNIT_DB + _UNIT_WALLS * np.minimum(wall_loss_db, _MOST_LOSS_DB)),
        )
