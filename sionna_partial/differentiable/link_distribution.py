"""The predicted distribution of links as TensorFlow tensors: what objectives and losses are made of."""

from dataclasses import dataclass, fields
from typing import Any

from sionna_partial.constants import LinkState
from sionna_partial.prediction.predictor import LinkPrediction


@dataclass(frozen=True, eq=False)
class LinkDistribution:
    """Predictive distribution of link state and path gain of N links, as tensors that derive from what it depends on.

    Parameters
    ----------
    p_los, p_nlos, p_outage : (N,) float64 tensors
        Probabilities of the link states; they sum to 1.
    gain_mean_db, gain_std_db : (N,) float64 tensors
        Mean and standard deviation of the whole distribution, an outage counting -150 dB [dB].
    gain_los_mean_db, gain_los_std_db, gain_nlos_mean_db, gain_nlos_std_db : (N,) float64 tensors
        The same given line of sight, and given paths without it [dB].
    """

    p_los: Any
    p_nlos: Any
    p_outage: Any
    gain_mean_db: Any
    gain_std_db: Any
    gain_los_mean_db: Any
    gain_los_std_db: Any
    gain_nlos_mean_db: Any
    gain_nlos_std_db: Any

    @classmethod
    def of_parts(cls, probabilities: Any, means_db: Any, stds_db: Any) -> "LinkDistribution":
        """Put the distribution together as `LinkPrediction.of_parts` does: probabilities and so on are (3, N)."""
        import tensorflow as tf

        mean_db = tf.reduce_sum(probabilities * means_db, axis=0)
        variance = tf.reduce_sum(probabilities * (stds_db**2 + (means_db - mean_db) ** 2), axis=0)
        spread = variance > 0.0
        return cls(
            p_los=probabilities[LinkState.LOS],
            p_nlos=probabilities[LinkState.NLOS],
            p_outage=probabilities[LinkState.OUTAGE],
            gain_mean_db=mean_db,
            gain_std_db=tf.where(spread, tf.sqrt(tf.where(spread, variance, 1.0)), 0.0),
            gain_los_mean_db=means_db[LinkState.LOS],
            gain_los_std_db=stds_db[LinkState.LOS],
            gain_nlos_mean_db=means_db[LinkState.NLOS],
            gain_nlos_std_db=stds_db[LinkState.NLOS],
        )

    @classmethod
    def of_prediction(cls, prediction: LinkPrediction) -> "LinkDistribution":
        """Take what was predicted as constants."""
        import tensorflow as tf

        return cls(*(tf.constant(getattr(prediction, each.name), dtype=tf.float64) for each in fields(cls)))

    def coverage(self, threshold_db: float, softness_db: float = 0.0) -> Any:
        """Return the probability (N,) that the gain exceeds a threshold [dB].

        Parameters
        ----------
        threshold_db : float
            Above -150 dB, the gain of an outage [dB].
        softness_db : float
            Standard deviation of a further, Gaussian spread of the gain [dB]. Where nothing is uncertain the
            probability is a step, which has no slope to climb; this makes it one.
        """
        import tensorflow as tf

        covered = tf.zeros_like(self.p_los)
        for probability, mean_db, std_db in (
            (self.p_los, self.gain_los_mean_db, self.gain_los_std_db),
            (self.p_nlos, self.gain_nlos_mean_db, self.gain_nlos_std_db),
        ):
            variance = std_db**2 + softness_db**2
            spread, above_db = variance > 0.0, mean_db - threshold_db
            share = 0.5 * tf.math.erfc(-above_db / tf.sqrt(2.0 * tf.where(spread, variance, 1.0)))
            covered += probability * tf.where(spread, share, tf.cast(above_db > 0.0, share.dtype))
        return covered
