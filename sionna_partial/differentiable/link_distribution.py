"""The predicted distribution of links as TensorFlow tensors: what objectives and losses are made of."""

from dataclasses import dataclass, fields
from types import ModuleType
from typing import Any, Self

from sionna_partial.prediction.paper_networks import import_keras
from sionna_partial.prediction.predictor import LinkPrediction


@dataclass(frozen=True, eq=False)
class LinkDistribution(LinkPrediction):
    """A `LinkPrediction` of (N,) float64 tensors with derivatives."""

    @classmethod
    def of_parts(cls, probabilities: Any, means_db: Any, stds_db: Any, *, ops: ModuleType | None = None) -> Self:
        """Combine the distributions given each LinkState, tensors (3, N)."""
        return super().of_parts(probabilities, means_db, stds_db, ops=ops or import_keras().ops)

    @classmethod
    def of_prediction(cls, prediction: LinkPrediction) -> "LinkDistribution":
        """Take what was predicted as constants."""
        import tensorflow as tf

        return cls(*(tf.constant(getattr(prediction, each.name), dtype=tf.float64) for each in fields(cls)))

    def coverage(self, threshold_db: float, softness_db: float = 0.0) -> Any:
        """Return the probability (N,) that the gain exceeds a threshold above -150 dB [dB].

        Where nothing is uncertain the probability is a step, which has no slope; `softness_db`, the standard deviation
        of a further Gaussian spread of the gain [dB], makes it one.
        """
        import tensorflow as tf

        covered = tf.zeros_like(self.p_los)
        for probability, mean_db, std_db in (
            (self.p_los, self.gain_los_mean_db, self.gain_los_std_db),
            (self.p_nlos, self.gain_nlos_mean_db, self.gain_nlos_std_db),
        ):
            variance = std_db**2 + softness_db**2
            spread, above_db = variance > 0.0, mean_db - threshold_db
            above = 0.5 * tf.math.erfc(-above_db / tf.sqrt(2.0 * tf.where(spread, variance, 1.0)))
            covered += probability * tf.where(spread, above, tf.cast(above_db > 0.0, above.dtype))
        return covered
