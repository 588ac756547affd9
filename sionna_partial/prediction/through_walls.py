"""What unseen walls change on links whose paths go through walls: known losses times their expected number.

A wall that is not known is taken to lose what the known ones do on average. `unseen_walls` gives the expected number of
walls on a direct line. The constants were fitted to procedural homes of one material and to procedural floors and
halls, whose walls lose 2 to 20 dB; `benchmarks/unseen_walls.py` measures others.
"""

import numpy as np

from sionna_partial.arrays import Floats
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.prediction.features import LinkFeatures, context_of

WALL_LOSSES = "the mean loss of unobserved walls"
"""Stands for the predictor's name in coverage maps."""

LOSS_OF_WALL, LARGEST_LOSS_DB = 0.78, 72.0
"""Loss of an unseen wall in losses of a known one, on lines that are traced in LOS and have none, as other paths add
power; and what many walls come near to [dB]: paths around them are the strongest there."""

FOUND_WALLS = 0.43
"""How many walls unseen reflections make up for, of links that are traced without LOS."""

LOS_GAIN_DB = 2.0
"""By how much unseen reflections add to a link with LOS, for the square root of an expected wall."""

SEEN_STD_DB, LOS_STD_DB, UNSEEN_STD, LARGEST_STD_DB = 0.5, 0.8, 0.72, 25.0
"""Standard deviations of gains whose direct line is observed, and of links with LOS likewise [dB]; those of all other
links, likewise in losses of a wall [1], and the largest of them [dB]."""


def by_mean_losses(phi: LinkFeatures, walls: Floats) -> tuple[Floats, Floats, Floats]:
    """Return probabilities, means and standard deviations of the gain [dB] of links through walls, each (3, N).

    They are by LinkState, from the features of N links, which have a context, and the expected numbers of unseen walls
    on their direct lines (N,). That number has a Poisson distribution: a link that is traced in line of sight has LOS
    if it is 0.
    """
    wall_loss_db, los = context_of(phi).wall_loss_db, phi.link_state == LinkState.LOS
    p_los = np.where(los, np.exp(-walls), 0.0)
    some = walls / np.maximum(-np.expm1(-walls), np.finfo(float).tiny)
    count = np.where(los, np.where(walls > 0.0, some, 1.0), np.maximum(walls - FOUND_WALLS, 0.0))
    loss_db = LOSS_OF_WALL * wall_loss_db * count
    mean_db = np.maximum(phi.gain_db - loss_db / (1.0 + loss_db / LARGEST_LOSS_DB), GAIN_FLOOR_DB)
    p_outage = np.where(mean_db > GAIN_FLOOR_DB, 0.0, 1.0 - p_los)
    root = np.sqrt(walls)
    los_db = np.minimum(phi.gain_db + LOS_GAIN_DB * root, 0.0)
    los_std_db = np.hypot(SEEN_STD_DB, LOS_STD_DB * root)
    std_db = np.hypot(SEEN_STD_DB, np.minimum(UNSEEN_STD * wall_loss_db * root, LARGEST_STD_DB))
    nothing = np.zeros(len(walls))
    return (
        np.stack([p_outage, p_los, 1.0 - p_los - p_outage]),
        np.stack([nothing + GAIN_FLOOR_DB, los_db, mean_db]),
        np.stack([nothing, los_std_db, std_db]),
    )
