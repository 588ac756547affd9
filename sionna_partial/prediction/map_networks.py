"""Networks that read the map and the paths of links, as Keras 3 models.

The map network is a U-Net (Ronneberger, Fischer and Brox 2015) on the image of a map (`space.MapSpace`) that returns
`MAP_FEATURES` numbers per cell, once for a map. Its kernels are symmetric: turned and mirrored maps give turned and
mirrored features. The link network reads the features of a link, and those of the map at both ends and along the
direct line, symmetrically in the ends, and their mean over all known cells, which tells a home from a hall.
"""

import itertools
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices, States
from sionna_partial.checks import Progress
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.prediction.evaluate import array_ops
from sionna_partial.prediction.features import (
    ATTENUATION_LENGTHS_M,
    LinkFeatures,
    context_of,
    shifted_gain_db,
)
from sionna_partial.prediction.paper_networks import STD_RANGE_DB, free_space_gain_db, import_keras, layer, tf
from sionna_partial.prediction.rule import (
    GATE_INPUTS,
    GATE_NETWORK,
    GATE_OUTPUTS,
    Parts,
    predicted,
)
from sionna_partial.prediction.space import WALK_M, MapSpace
from sionna_partial.settings import NetworkKind, PredictorSettings

if TYPE_CHECKING:
    import keras

Shapes = tuple[tuple[int | None, ...], tuple[int | None, ...]]
Networks = Mapping[str, Callable[[Any], Any]]

MAP_NETWORK, LINK_NETWORK = "map_network", "link_network"

MAP_CHANNELS, MAP_FEATURES = 3, 16
"""Channels of the image of a map, and features of its cells."""

LINE_POINTS = 24
"""Points of the direct line at which the features of the map are averaged."""

LINK_OUTPUTS = 7
"""Logits of the link states, then mean and spread of the gain given LOS and given NLOS."""

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
_LOS_MOST_DB = 10.0
"""Largest mean gain given LOS over free space [dB]: other paths add at most this power."""

_LOS_OFFSET = -1.5
_NLOS_DB, _NLOS_SCALE_DB = -25.0, 20.0
_STATISTICS_MOMENTUM = 0.9

_IMPOSSIBLE = -1e30
_LEAST_PROBABILITY, _LEAST_STD_DB, _MOST_SQUARE = 1e-4, 0.3, 50.0
_LINKS_AT_ONCE, _MAPS_KEPT = 16_384, 8
_REPORT_STEPS = 50

_log = logging.getLogger(__name__)

_LOG_NEAREST_M = 0.1
_SCALE_M, _SCALE_DB, _EXCESS_DB = 3.0, 100.0, 30.0

FEATURES: dict[str, tuple[str, ...]] = {
    "link_state": ("partial_link_state",),
    "gain_db": ("partial_gain_db",),
    **{name: (name,) for name in ("unobserved_distance_m", "distance_m")},
    "indirect_gain_db": tuple(f"indirect_gain_reach_{length_m:g}_m_db" for length_m in ATTENUATION_LENGTHS_M),
    **{name: (name,) for name in ("strongest_unobserved_m", "straight_gain_db", "straight_walls", "wall_loss_db")},
    **dict.fromkeys(("tx_seen", "rx_seen", "possible", "walled_m", "wall_noise", "exposure", "route"), ()),
}
"""Features of links by their names in `LinkFeatures` or `LinkContext`, and their columns in data sets, if stored."""

Values = Mapping[str, Any]
"""Features by name, with `free_db`, the free-space gain, and `near_m`, the distance but at least 10 cm."""

Make = Callable[[Values, ModuleType], Any]


def _is_state(state: LinkState) -> Make:
    return lambda of, ops: 1.0 * (of["link_state"] == state)


def _flag(name: str, column: int | None = None) -> Make:
    return lambda of, ops: 1.0 * (of[name] if column is None else of[name][:, column])


def _log_length(length_m: Callable[[Values], Any]) -> Make:
    return lambda of, ops: ops.log(1.0 + ops.maximum(length_m(of), 0.0) / _SCALE_M)


def _gain(gain_db: Callable[[Values], Any]) -> Make:
    return lambda of, ops: (gain_db(of) - GAIN_FLOOR_DB) / _SCALE_DB


def _excess(gain_db: Callable[[Values], Any]) -> Make:
    return lambda of, ops: ops.clip((gain_db(of) - of["free_db"]) / _EXCESS_DB, -2.0, 0.5)


_INDIRECT: dict[str, Callable[[Values], Any]] = {
    f"indirect_{length_m:g}": lambda of, column=column: of["indirect_gain_db"][:, column]  # type: ignore[misc]
    for column, length_m in enumerate(ATTENUATION_LENGTHS_M)
}

LINK_INPUTS: dict[str, Make] = {
    **{state.name.lower(): _is_state(state) for state in LinkState},
    "both_seen": lambda of, ops: 1.0 * (of["tx_seen"] & of["rx_seen"]),
    "an_end_seen": lambda of, ops: 1.0 * (of["tx_seen"] | of["rx_seen"]),
    "exposure": lambda of, ops: of["exposure"][:, 0] + of["exposure"][:, 1],
    "both_exposed": lambda of, ops: of["exposure"][:, 0] * of["exposure"][:, 1],
    "noise": lambda of, ops: of["wall_noise"],
    "route": lambda of, ops: of["route"] / 10.0,
    "detour": _log_length(lambda of: of["route"] * WALK_M - of["distance_m"]),
    **{f"{state.name.lower()}_possible": _flag("possible", state) for state in LinkState},
    "walled": lambda of, ops: ops.minimum(of["walled_m"], 1.0),
    "log_distance": lambda of, ops: ops.log(of["near_m"]),
    "unobserved_fraction": lambda of, ops: of["unobserved_distance_m"] / of["near_m"],
    "distance": _log_length(lambda of: of["distance_m"]),
    "unobserved": _log_length(lambda of: of["unobserved_distance_m"]),
    "observed": _log_length(lambda of: of["distance_m"] - of["unobserved_distance_m"]),
    "strongest_unobserved": _log_length(lambda of: of["strongest_unobserved_m"]),
    "gain": _gain(lambda of: of["gain_db"]),
    "free_gain": _gain(lambda of: of["free_db"]),
    **{name: _gain(gain_db) for name, gain_db in _INDIRECT.items()},
    "gain_above_free": _excess(lambda of: of["gain_db"]),
    **{f"{name}_above_free": _excess(gain_db) for name, gain_db in _INDIRECT.items()},
}
"""Inputs of the link network in order, dimensionless, as functions of the features."""

_LINK_INPUTS_WITH_MAP = len(LINK_INPUTS) + 4 * MAP_FEATURES
_GATE_SHAPES = {GATE_NETWORK: ((None, len(GATE_INPUTS)), (None, GATE_OUTPUTS))}

CONTEXT_SHAPES: tuple[Mapping[str, Shapes], ...] = (
    {},
    {LINK_NETWORK: ((None, len(LINK_INPUTS)), (None, LINK_OUTPUTS)), **_GATE_SHAPES},
    {
        LINK_NETWORK: ((None, _LINK_INPUTS_WITH_MAP), (None, LINK_OUTPUTS)),
        MAP_NETWORK: ((None, None, None, MAP_CHANNELS), (None, None, None, MAP_FEATURES)),
        **_GATE_SHAPES,
    },
)
"""For "paper", "paths" and "map": inputs and outputs of the added networks."""


def feature_values(phi: LinkFeatures) -> dict[str, Any]:
    return {name: getattr(phi if hasattr(phi, name) else phi.context, name) for name in FEATURES}


def link_inputs(values: Values, frequency_hz: float, shift_db: Any, ops: ModuleType = np) -> Any:
    """Return the inputs (N, len(LINK_INPUTS)) of the link network.

    `shift_db` is the free-space gain at `frequency_hz` less the one at the links' frequency; `ops` is NumPy or
    keras.ops.
    """
    gains_db = {name: shifted_gain_db(values[name], shift_db, ops) for name in ("gain_db", "indirect_gain_db")}
    free_db = free_space_gain_db(values["distance_m"], frequency_hz, ops)
    near_m = ops.maximum(values["distance_m"], _LOG_NEAREST_M)
    of = {**values, **gains_db, "free_db": free_db, "near_m": near_m}
    return ops.stack([make(of, ops) for make in LINK_INPUTS.values()], axis=1)


def columns_of(phi: LinkFeatures) -> dict[str, Floats]:
    values = feature_values(phi)
    stored = ((columns, np.atleast_2d(values[name].T)) for name, columns in FEATURES.items() if columns)
    return {name: column for columns, rows in stored for name, column in zip(columns, rows, strict=True)}


def features_of_columns(columns: Mapping[str, Floats]) -> dict[str, Any]:
    stored = {name: [columns[column] for column in own] for name, own in FEATURES.items() if own}
    return {name: np.column_stack(values) if len(values) > 1 else values[0] for name, values in stored.items()}


def scaled_inputs(phi: LinkFeatures, frequency_hz: float) -> NDArray[np.float32]:
    inputs: Floats = link_inputs(feature_values(phi), frequency_hz, phi.free_space_shift_db(frequency_hz))
    return inputs.astype(np.float32)


def context_networks(seed: int, *, with_map: bool = True) -> dict[str, "keras.Model"]:
    keras, start = import_keras(), kernel_starts(seed)
    inputs = _LINK_INPUTS_WITH_MAP if with_map else len(LINK_INPUTS)
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


def kind_of(networks: Networks) -> NetworkKind:
    return "map" if reads_maps(networks) else "paths" if LINK_NETWORK in networks else "paper"


def reads_maps(networks: Networks) -> bool:
    return MAP_NETWORK in networks


def line_points_m(tx_m: Any, rx_m: Any) -> Any:
    """Return points (N, 2 + LINE_POINTS, 2) [m] of links: both ends, and points along the direct line."""
    along = np.concatenate([[0.0, 1.0], (np.arange(LINE_POINTS) + 0.5) / LINE_POINTS])[:, None]
    return tx_m[:, None, :2] * (1.0 - along) + rx_m[:, None, :2] * along


def link_outputs(networks: Networks, inputs: Any, of_map: tuple[Any, Any] | None, ops: Any = array_ops) -> Any:
    """Return the outputs (N, LINK_OUTPUTS) for inputs (N, I).

    `of_map` has the map features (N, 2 + LINE_POINTS, F) of points, and their mean (N, F) over the known cells.
    """
    if of_map is not None:
        points, mean = of_map
        first, last = points[:, 0], points[:, 1]
        values = [inputs, first + last, first * last, ops.mean(points[:, 2:], axis=1), mean]
        inputs = ops.concatenate(values, axis=1)
    return networks[LINK_NETWORK](inputs)


def mean_features(features: Any, images: Any, ops: Any = array_ops) -> Any:
    """Return the mean (B, F) of map features (B, H, W, F) over the known cells of images."""
    known = images[..., :1] + images[..., 1:2]
    total = ops.sum(features * known, axis=(1, 2))
    return total / ops.maximum(ops.sum(known, axis=(1, 2)), 1.0)


def expert_parts(outputs: Any, free_db: Any, possible: Any, ops: Any = array_ops) -> Parts:
    """Return the distribution of the networks."""
    states = ops.where(possible, outputs[:, : len(LinkState)], _IMPOSSIBLE)
    los_db = _LOS_MOST_DB * ops.sigmoid(_LOS_OFFSET + outputs[:, 3])
    means_db = [free_db + los_db, free_db + _NLOS_DB + _NLOS_SCALE_DB * outputs[:, 4]]
    low, high = (math.log(std_db) for std_db in STD_RANGE_DB)
    stds_db = [ops.exp(low + (high - low) * ops.sigmoid(outputs[:, column])) for column in (5, 6)]
    outage = ops.zeros_like(free_db)
    return (
        ops.transpose(ops.exp(ops.log_softmax(states))),
        ops.maximum(ops.stack([outage + GAIN_FLOOR_DB, *means_db]), GAIN_FLOOR_DB),
        ops.stack([outage, *stds_db]),
    )


def image_features(networks: Networks, image: Any, ops: Any = array_ops) -> tuple[Any, Any]:
    """Return the features (H, W, F) of an image (H, W, C), and their mean (F,)."""
    features = networks[MAP_NETWORK](image[None])
    return features[0], mean_features(features, image[None], ops)[0]


class MapFeatures:
    """Features of the latest maps by a map network."""

    def __init__(self, networks: Networks) -> None:
        self._networks, self._kept = networks, dict[bytes, Any]()

    def __call__(self, space: MapSpace) -> tuple[Any, Any]:
        """Return the features (H, W, F) of the cells of a map, and their mean (F,)."""
        key = space.image.tobytes()
        if key not in self._kept:
            found = image_features(self._networks, space.image)
            self._kept = dict([*self._kept.items()][1 - _MAPS_KEPT :]) | {key: found}
        return self._kept[key]


def read_features(
    space: MapSpace, found: tuple[Any, Any], tx_m: Any, rx_m: Any, ops: Any = array_ops
) -> tuple[Any, Any]:
    """Return the map features of N links that `link_outputs` takes."""
    features, mean = found
    points = space.read(features, line_points_m(tx_m, rx_m), ops)
    return points, ops.zeros_like(points[:, 0]) + mean


def predict_by_context(networks: Networks, phi: LinkFeatures, frequency_hz: float, features: MapFeatures) -> Parts:
    """Predict N links with a context."""
    context, inputs = context_of(phi), scaled_inputs(phi, frequency_hz)
    outputs = np.zeros((len(phi), LINK_OUTPUTS))
    for index, links in enumerate(_links_by_map(phi)):
        for start in range(0, len(links), _LINKS_AT_ONCE):
            here = links[start : start + _LINKS_AT_ONCE]
            of_map = None
            if reads_maps(networks):
                space = context.spaces[index]
                of_map = read_features(space, features(space), context.tx_m[here], context.rx_m[here])
            outputs[here] = link_outputs(networks, inputs[here], of_map)
    values = rule_values(phi, frequency_hz)
    expert = expert_parts(outputs, values["free_db"], context.possible)
    return predicted(values, expert, networks[GATE_NETWORK])


def rule_values(phi: LinkFeatures, frequency_hz: float) -> dict[str, Any]:
    """Return the features that the rule reads."""
    free_db = free_space_gain_db(phi.distance_m, phi.frequency_hz or frequency_hz)
    return feature_values(phi) | {"free_db": free_db}


def _links_by_map(phi: LinkFeatures) -> list[Indices]:
    index, count = context_of(phi).map_index, len(context_of(phi).spaces)
    order = np.argsort(index, kind="stable")
    return np.split(order, np.searchsorted(index[order], np.arange(1, count)))


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
        maps = [(context.spaces[index], links) for index, links in enumerate(_links_by_map(phi)) if len(links)]
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

    compiled: Callable[..., Any] = tf.function(step, autograph=False, jit_compile=False, reduce_retracing=True)
    return compiled


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
