"""Training of the networks that see where links run, by proper scores, window by window."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.constants import LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.map_networks import (
    context_networks,
    decode,
    link_inputs,
    look,
    receiver_offsets_m,
)
from sionna_partial.prediction.paper_networks import free_space_gain_db, import_keras
from sionna_partial.prediction.windows import transmitter_places, transmitter_windows
from sionna_partial.settings import PredictorSettings
from sionna_partial.tracing.trace import Progress

if TYPE_CHECKING:
    import keras

WINDOWS_AT_ONCE, LINKS_OF_WINDOW = 16, 100
"""Number of windows in a gradient step, and of links that are drawn for each of them."""

LEARNING_RATE, WEIGHT_DECAY = 4e-3, 1e-4
"""Of AdamW; the rate falls to 0 along a cosine."""

GAIN_WEIGHT = 0.05
"""Weight of the score of the gain beside the log-likelihood of the link state [1/dB]."""

_REPORT_STEPS = 50

_log = logging.getLogger(__name__)


def fit_context_networks(
    phi: LinkFeatures,
    link_state: NDArray[np.uint8],
    gain_db: NDArray[np.float64],
    settings: PredictorSettings,
    *,
    progress: Progress | None = None,
) -> dict[str, "keras.Model"]:
    """Fit the networks that see where links run; every receiver is taken to be indoors.

    Windows are turned and mirrored at random. The same links and settings give the same weights.

    Parameters
    ----------
    phi : LinkFeatures
        Of N links, with a context.
    link_state : (N,) uint8 array of LinkState
        True link state.
    gain_db : (N,) float64 array
        True omnidirectional path gain [dB].
    settings : PredictorSettings
        With `networks` "paths" or "map".
    progress : callable, optional
        Called as ``progress(share_done, message)``.

    Returns
    -------
    dict of str to keras.Model
        By name.

    Raises
    ------
    PredictorError
        If the training diverges.
    """
    networks = context_networks(settings.seed, with_map=settings.networks == "map")
    examples = _Examples.of_links(phi, link_state, gain_db, settings)
    steps = math.ceil(settings.passes * len(examples) / WINDOWS_AT_ONCE)
    step = _gradient_step(networks, steps)
    report = progress or (lambda share, message: None)
    losses = []
    for number, batch in enumerate(examples.batches(steps, np.random.default_rng(settings.seed))):
        losses.append(float(step(**batch)))
        if number % _REPORT_STEPS == 0:
            recent = np.mean(losses[-_REPORT_STEPS:])
            report(number / steps, f"step {number} of {steps}, loss {recent:.4f}")
    _log.info("%d steps on %d windows: loss %.4f", steps, len(examples), np.mean(losses[-_REPORT_STEPS:]))
    if not np.isfinite(losses).all():
        raise PredictorError(f"training diverged in step {int(np.argmin(np.isfinite(losses)))}: give another seed.")
    return networks


@dataclass(frozen=True, eq=False)
class _Examples:
    """Training links, ordered by window.

    Parameters
    ----------
    images : mapping of str to (W, K, S, S, ...) uint8 arrays
        Of the windows, by the names of the arguments of a gradient step; none without a map network.
    first : (W + 1,) int array
        Where the links of each window begin.
    columns : mapping of str to (N, ...) arrays
        Of the links, by the names of the arguments of a gradient step.
    """

    images: Mapping[str, NDArray[np.uint8]]
    first: NDArray[np.intp]
    columns: Mapping[str, NDArray[np.generic]]

    @classmethod
    def of_links(
        cls,
        phi: LinkFeatures,
        link_state: NDArray[np.uint8],
        gain_db: NDArray[np.float64],
        settings: PredictorSettings,
    ) -> "_Examples":
        context = phi.context
        assert context is not None
        (_, index), images = transmitter_places(context), {}
        if settings.networks == "map":
            images["windows"] = transmitter_windows(context)
        order = np.argsort(index, kind="stable")
        columns = {
            "links": link_inputs(phi, settings.frequency_hz),
            "offsets_m": receiver_offsets_m(context),
            "free_db": free_space_gain_db(phi.distance_m, settings.frequency_hz).astype(np.float32),
            "link_state": link_state.astype(np.int32),
            "gain_db": gain_db.astype(np.float32),
        }
        first = np.searchsorted(index[order], np.arange(index.max() + 2))
        return cls(images, first, {name: column[order] for name, column in columns.items()})

    def __len__(self) -> int:
        """Return the number of windows W."""
        return len(self.first) - 1

    def batches(self, steps: int, rng: np.random.Generator) -> Iterator[dict[str, NDArray[np.generic]]]:
        """Yield the arguments of so many gradient steps."""
        order = np.zeros(0, dtype=np.intp)
        for _ in range(steps):
            while len(order) < WINDOWS_AT_ONCE:
                order = np.concatenate([order, rng.permutation(len(self))])
            chosen, order = order[:WINDOWS_AT_ONCE], order[WINDOWS_AT_ONCE:]
            yield self._batch(chosen, rng)

    def _batch(self, chosen: NDArray[np.intp], rng: np.random.Generator) -> dict[str, NDArray[np.generic]]:
        low, high = self.first[chosen], self.first[chosen + 1]
        links = rng.integers(low[:, None], high[:, None], (len(chosen), LINKS_OF_WINDOW))
        batch = {name: column[links] for name, column in self.columns.items()}
        turns = rng.integers(8, size=len(chosen))
        for name, images in self.images.items():
            turned = [_turned(image, turn) for image, turn in zip(images[chosen], turns, strict=True)]
            batch[name] = np.stack(turned).astype(np.float32)
        offsets_m = zip(batch["offsets_m"], turns, strict=True)
        batch["offsets_m"] = np.stack([_turned_offsets(offset_m, turn) for offset_m, turn in offsets_m])
        return batch


def _turned(image: NDArray[np.uint8], turn: int) -> NDArray[np.uint8]:
    """One of the eight ways to lay squares (K, S, S, C)."""
    image = image[:, :, ::-1] if turn & 1 else image
    image = image[:, ::-1] if turn & 2 else image
    return image.transpose(0, 2, 1, 3) if turn & 4 else image


def _turned_offsets(offsets_m: NDArray[np.float32], turn: int) -> NDArray[np.float32]:
    """Where offsets (R, 2) from the middle are when the window is laid that way [m]."""
    x, y = offsets_m.T
    x = -x if turn & 1 else x
    y = -y if turn & 2 else y
    return np.stack([y, x] if turn & 4 else [x, y], axis=1)


def _gradient_step(networks: Mapping[str, "keras.Model"], steps: int) -> Callable[..., Any]:
    """Return a function that takes one of so many gradient steps and returns the loss."""
    import tensorflow as tf

    keras = import_keras()
    rate = keras.optimizers.schedules.CosineDecay(LEARNING_RATE, steps)
    optimizer = keras.optimizers.AdamW(rate, weight_decay=WEIGHT_DECAY)
    weights = [weight for name in sorted(networks) for weight in networks[name].trainable_variables]

    def step(
        links: Any,
        offsets_m: Any,
        free_db: Any,
        link_state: Any,
        gain_db: Any,
        windows: Any = None,
    ) -> Any:
        with tf.GradientTape() as tape:
            outputs = look(networks, windows, links, offsets_m, training=True)
            log_p, means_db, log_variances = decode(outputs, free_db)
            loss = -tf.reduce_mean(tf.gather(log_p, link_state, batch_dims=2))
            scores_db = _ranked_score(gain_db[..., None] - means_db, tf.exp(0.5 * log_variances))
            states = tf.constant([LinkState.LOS, LinkState.NLOS], dtype=tf.int32)
            linked = tf.cast(link_state[..., None] == states, tf.float32)
            loss += GAIN_WEIGHT * tf.reduce_mean(tf.reduce_sum(scores_db * linked, axis=-1))
        optimizer.apply_gradients(zip(tape.gradient(loss, weights), weights, strict=True))
        return loss

    compiled: Callable[..., Any] = tf.function(step, jit_compile=False)
    return compiled


def _ranked_score(errors_db: Any, stds_db: Any) -> Any:
    """Continuous ranked probability score of Gaussians [dB] (Gneiting and Raftery 2007, Eq. 21).

    Gains have longer tails than Gaussians. The likelihood widens them until the tails are covered, which makes the
    90 % interval too wide for most links; this score does not.
    """
    import tensorflow as tf

    z = errors_db / stds_db
    density = tf.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    return stds_db * (z * tf.math.erf(z / math.sqrt(2.0)) + 2.0 * density - 1.0 / math.sqrt(math.pi))
