"""Building and training of the networks that read maps and the paths of links, by Keras."""

import functools
import itertools
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices, States
from sionna_partial.checks import Progress
from sionna_partial.constants import LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.prediction.features import LinkFeatures, context_of
from sionna_partial.prediction.map_networks import (
    LINK_INPUTS,
    LINK_INPUTS_WITH_MAP,
    LINK_NETWORK,
    LINK_OUTPUTS,
    MAP_CHANNELS,
    MAP_FEATURES,
    MAP_NETWORK,
    expert_parts,
    line_points_m,
    link_outputs,
    links_by_map,
    mean_features,
    rule_values,
    scaled_inputs,
)
from sionna_partial.prediction.paper_networks import import_keras, layer, tf
from sionna_partial.prediction.rule import GATE_INPUTS, GATE_NETWORK, GATE_OUTPUTS, Parts, predicted
from sionna_partial.prediction.space import MapSpace
from sionna_partial.settings import PredictorSettings

if TYPE_CHECKING:
    import keras

MAPS_AT_ONCE = 8
"""Maps per gradient step, of similar size."""

LEARNING_RATE, WEIGHT_DECAY = 4e-3, 1e-4
"""Parameters of AdamW; the rate falls to 0 along a cosine."""

GAIN_WEIGHT, LIKELIHOOD_WEIGHT = 0.05, 0.25
"""Weights of the gain's CRPS [1/dB] and log-likelihood against the log-likelihood of the link state.

The likelihood widens the 90 % intervals to cover long tails, such as the errors of maps whose noise does not show.
"""

EXPERT_WEIGHT = 0.5
"""Weight of the score of the networks alone against the score of the mixture with the trace."""

BATCH_STATISTICS = 0.6
"""Fraction of the steps that normalise by the statistics of a batch; the last ones normalise as predictions do.

Batches have maps of similar size, and so other statistics than all maps together.
"""

_WIDTHS = (16, 32, 48, 64)
_HIDDEN_UNITS, _GATE_UNITS = 160, 24
_STATISTICS_MOMENTUM = 0.9
_LEAST_PROBABILITY, _LEAST_STD_DB, _MOST_SQUARE = 1e-4, 0.3, 50.0
_REPORT_STEPS = 50

_log = logging.getLogger(__name__)


def context_networks(seed: int, *, with_map: bool = True) -> dict[str, "keras.Model"]:
    keras, start = import_keras(), kernel_starts(seed)
    inputs = LINK_INPUTS_WITH_MAP if with_map else len(LINK_INPUTS)
    networks = {
        LINK_NETWORK: _dense_network(keras, start, LINK_NETWORK, (inputs, _HIDDEN_UNITS, LINK_OUTPUTS)),
        GATE_NETWORK: _dense_network(keras, start, GATE_NETWORK, (len(GATE_INPUTS), _GATE_UNITS, GATE_OUTPUTS)),
    }
    return networks | ({MAP_NETWORK: _map_network(keras, start)} if with_map else {})


def kernel_starts(seed: int) -> Callable[[], Any]:
    keras, seeds = import_keras(), itertools.count(1000 * seed + 1)
    return lambda: keras.initializers.GlorotUniform(seed=next(seeds))


def _map_network(keras: Any, start: Callable[[], Any]) -> "keras.Model":
    image = keras.Input((None, None, MAP_CHANNELS), name="image", dtype="float32")
    joined = layer(keras, "Concatenate", "all")([u_net(keras, start, image, _WIDTHS), image])
    values = layer(keras, "Conv2D", "values", MAP_FEATURES, 1, kernel_initializer=start())(joined)
    network = keras.Model(image, values, name=MAP_NETWORK)
    for weight in network.trainable_variables:
        weight.assign(symmetric(weight.value))
    return network


def symmetric(kernel: Any) -> Any:
    """Return the mean over the eight turned and mirrored kernels (h, w, C, D); other weights as they are."""
    if len(kernel.shape) != len("hwcd"):
        return kernel
    ops = import_keras().ops
    mirrored = sum(ops.flip(kernel, axis) for axis in ((0,), (1,), (0, 1))) + kernel
    return (mirrored + ops.transpose(mirrored, (1, 0, 2, 3))) / 8.0


def u_net(keras: Any, start: Callable[[], Any], image: Any, widths: tuple[int, ...]) -> Any:
    """Return the output (B, H, W, widths[0]) of a U-Net for images (B, H, W, C); `start` yields initial kernels."""

    def convolved(x: Any, units: int, name: str) -> Any:
        options = {"padding": "same", "use_bias": False, "kernel_initializer": start()}
        x = layer(keras, "Conv2D", name, units, 3, **options)(x)
        x = layer(keras, "BatchNormalization", f"{name}_normal", momentum=_STATISTICS_MOMENTUM)(x)
        return layer(keras, "ReLU", f"{name}_active")(x)

    x = convolved(image, widths[0], "down_0")
    levels = []
    for depth, units in enumerate(widths[1:], 1):
        levels.append(x)
        x = layer(keras, "MaxPooling2D", f"pool_{depth}")(x)
        x = convolved(convolved(x, units, f"down_{depth}"), units, f"down_{depth}_again")
    for depth in reversed(range(len(levels))):
        x = layer(keras, "UpSampling2D", f"grow_{depth}")(x)
        x = convolved(layer(keras, "Concatenate", f"join_{depth}")([x, levels[depth]]), widths[depth], f"up_{depth}")
        x = convolved(x, widths[depth], f"up_{depth}_again") if depth else x
    return x


def _dense_network(keras: Any, start: Callable[[], Any], name: str, sizes: tuple[int, int, int]) -> "keras.Model":
    inputs, units, outputs = sizes
    x = link = keras.Input((inputs,), name="link", dtype="float32")
    for number in (1, 2):
        options = {"activation": "silu", "kernel_initializer": start()}
        x = layer(keras, "Dense", f"hidden_{number}", units, **options)(x)
    return keras.Model(link, layer(keras, "Dense", "outputs", outputs, kernel_initializer="zeros")(x), name=name)


def fit_context_networks(
    phi: LinkFeatures,
    link_state: States,
    gain_db: Floats,
    settings: PredictorSettings,
    *,
    progress: Progress | None = None,
) -> dict[str, "keras.Model"]:
    """Fit the networks of `settings` and the gate, together, to links with a context."""
    networks = context_networks(settings.seed, with_map=settings.networks == "map")
    examples = _Examples(phi, link_state, gain_db, settings)
    steps = math.ceil(settings.passes * len(examples) / MAPS_AT_ONCE)
    step = _gradient_step(networks, steps)
    losses = []
    for number, batch in enumerate(examples.batches(steps, np.random.default_rng(settings.seed))):
        losses.append(float(step(number < BATCH_STATISTICS * steps, *batch)))
        if progress and number % _REPORT_STEPS == 0:
            recent = np.mean(losses[-_REPORT_STEPS:])
            progress(number / steps, f"step {number} of {steps}, loss {recent:.4f}")
    _log.info("%d steps on %d maps: loss %.4f", steps, len(examples), np.mean(losses[-_REPORT_STEPS:]))
    if not np.isfinite(losses).all():
        raise PredictorError(f"training diverged in step {int(np.argmin(np.isfinite(losses)))}: give another seed.")
    return networks


class _Examples:
    """Training links by map."""

    def __init__(self, phi: LinkFeatures, link_state: States, gain_db: Floats, settings: PredictorSettings) -> None:
        context, reads = context_of(phi), settings.networks == "map"
        maps = [(context.spaces[index], links) for index, links in enumerate(links_by_map(phi)) if len(links)]
        self._maps = sorted(maps, key=lambda each: math.prod(each[0].shape))
        self._ends_m = (context.tx_m, context.rx_m) if reads else None
        values = rule_values(phi, settings.frequency_hz)
        columns = values | {"inputs": scaled_inputs(phi, settings.frequency_hz), "true_gain_db": gain_db}
        self._columns = {
            name: np.asarray(column, dtype=np.float32 if np.asarray(column).dtype.kind == "f" else None)
            for name, column in columns.items()
        } | {"true_state": link_state.astype(np.int32)}

    def __len__(self) -> int:
        return len(self._maps)

    def batches(self, steps: int, rng: np.random.Generator) -> Iterator[tuple[Any, ...]]:
        starts: list[int] = []
        for _ in range(steps):
            if not starts:  # maps of similar size, from another first map in each pass
                first = int(rng.integers(MAPS_AT_ONCE)) - MAPS_AT_ONCE + 1
                starts = rng.permutation(np.arange(first, len(self), MAPS_AT_ONCE)).tolist()
            start = starts.pop()
            maps = self._maps[max(start, 0) : start + MAPS_AT_ONCE]
            links = np.concatenate([links for _, links in maps])
            columns = {name: column[links] for name, column in self._columns.items()}
            yield (columns, *(self._images(maps) if self._ends_m else ()))

    def _images(self, maps: Sequence[tuple[MapSpace, Indices]]) -> tuple[Any, ...]:
        """Return images (B, H, W, C) of equal size, the image of N links, cells of points (N, P, 4), and weights."""
        assert self._ends_m is not None
        ny, nx = (max(space.shape[axis] for space, _ in maps) for axis in (0, 1))
        images, cells, weights = [], [], []
        for number, (space, links) in enumerate(maps):
            more = [(0, ny - space.shape[0]), (0, nx - space.shape[1]), (0, 0)]
            images.append(np.pad(space.image, more, mode="edge"))
            index, weight = space.corners(line_points_m(*(end_m[links] for end_m in self._ends_m)))
            row, column = np.divmod(index, space.shape[1])
            cells.append((number * ny + row) * nx + column)
            weights.append(weight)
        return (
            np.stack(images),
            np.repeat(np.arange(len(maps), dtype=np.int32), [len(links) for _, links in maps]),
            np.concatenate(cells).astype(np.int32),
            np.concatenate(weights).astype(np.float32),
        )


def _gradient_step(networks: Mapping[str, "keras.Model"], steps: int) -> Callable[..., Any]:
    weights = [weight for name in sorted(networks) for weight in networks[name].trainable_variables]
    optimizer, ops = adam_w(weights, steps), import_keras().ops

    def step(of_batch: bool, columns: Any, *of_images: Any) -> Any:
        with tf.GradientTape() as tape:
            of_map = None
            if of_images:
                images, image, cells, point_weights = of_images
                features = networks[MAP_NETWORK](images, training=of_batch)
                mean = tf.gather(mean_features(features, images, ops), image)
                found = tf.gather(tf.reshape(features, (-1, MAP_FEATURES)), cells)
                of_map = tf.reduce_sum(found * point_weights[..., None], axis=2), mean
            outputs = link_outputs(networks, columns["inputs"], of_map, ops)
            expert = expert_parts(outputs, columns["free_db"], columns["possible"], ops)
            mixed = predicted(columns, expert, networks[GATE_NETWORK], ops)
            truth = columns["true_state"], columns["true_gain_db"]
            loss = _score(mixed, *truth) + EXPERT_WEIGHT * _score(expert, *truth)
        slopes = [symmetric(slope) for slope in tape.gradient(loss, weights)]
        optimizer.apply_gradients(zip(slopes, weights, strict=True))
        return loss

    compiled: dict[bool, Callable[..., Any]] = {}

    def step_on(of_batch: bool, *batch: Any) -> Any:
        if of_batch not in compiled:
            sizes = tf.nest.map_structure(_of_any_size, batch)  # otherwise TensorFlow traces the step for several
            options = {"input_signature": sizes, "autograph": False, "jit_compile": False}
            compiled[of_batch] = tf.function(functools.partial(step, of_batch), **options)
        return compiled[of_batch](*batch)

    return step_on


def _of_any_size(array: NDArray[Any]) -> Any:
    """Describe arrays with any number of rows, and images of any size."""
    *sizes, last = array.shape
    return tf.TensorSpec([None] * len(sizes) + [last] if sizes else [None], array.dtype)


def _score(parts: Parts, state: Any, gain_db: Any) -> Any:
    """Return the cross-entropy of the link state, and the score of the gain given the true state."""
    chosen = tf.one_hot(state, len(LinkState), axis=0)
    probabilities, means_db, stds_db = parts
    p_true = tf.reduce_sum(probabilities * chosen, axis=0)
    errors_db, stds_db = gain_db - means_db, tf.maximum(stds_db, _LEAST_STD_DB)
    likelihood = 0.5 * tf.minimum((errors_db / stds_db) ** 2, _MOST_SQUARE) + tf.math.log(stds_db)
    scores = (GAIN_WEIGHT * _crps(errors_db, stds_db) + LIKELIHOOD_WEIGHT * likelihood)[1:] * chosen[1:]
    entropy = -tf.reduce_mean(tf.math.log(tf.maximum(p_true, _LEAST_PROBABILITY)))
    return entropy + tf.reduce_mean(tf.reduce_sum(scores, axis=0))


def adam_w(weights: Sequence[Any], steps: int) -> Any:
    keras = import_keras()
    rate = keras.optimizers.schedules.CosineDecay(LEARNING_RATE, steps)
    optimizer = keras.optimizers.AdamW(rate, weight_decay=WEIGHT_DECAY)
    optimizer.build(weights)  # otherwise TensorFlow traces the step twice
    return optimizer


def _crps(errors_db: Any, stds_db: Any) -> Any:
    """Continuous ranked probability score of Gaussians [dB] (Gneiting and Raftery 2007, Eq. 21).

    Unlike the likelihood, it does not widen the 90 % interval to cover the long tails of gains.
    """
    z = errors_db / stds_db
    density = tf.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    return stds_db * (z * tf.math.erf(z / math.sqrt(2.0)) + 2.0 * density - 1.0 / math.sqrt(math.pi))
