"""Networks that read maps and paths, as Keras 3 models.

Map networks are U-Nets (Ronneberger, Fischer and Brox 2015) that return `MAP_FEATURES` numbers per cell of the near and
the far window, less their output for an empty window: unobserved space adds nothing. The link network reads the
features of a link and these numbers at its receiver.
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
    LinkContext,
    LinkFeatures,
    context_of,
    excess_noise,
    shifted_gain_db,
)
from sionna_partial.prediction.paper_networks import (
    STD_RANGE_DB,
    Networks,
    free_space_gain_db,
    import_keras,
    layer,
    tf,
)
from sionna_partial.prediction.unobserved import CELLS_M, CHANNELS, WINDOW_CELLS
from sionna_partial.settings import NetworkKind, PredictorSettings

if TYPE_CHECKING:
    import keras

Shapes = tuple[tuple[int | None, ...], tuple[int | None, ...]]

MAP_NETWORKS, LINK_NETWORK = ("near_map_network", "far_map_network"), "link_network"
"""Names of the networks; map networks in the order of `CELLS_M`."""

MAP_FEATURES = 16

LINK_OUTPUTS = 7
"""Logits of the link states, then mean and spread of the gain given LOS and given NLOS."""

WINDOWS_AT_ONCE, LINKS_OF_WINDOW = 16, 100
"""Windows per gradient step, and links drawn per window."""

LEARNING_RATE, WEIGHT_DECAY = 4e-3, 1e-4
"""Parameters of AdamW; the rate falls to 0 along a cosine."""

GAIN_WEIGHT = 0.05
"""Weight of the gain's score against the log-likelihood of the link state [1/dB]."""

WIDENING, SEEN_WIDENING = 0.15, 0.5
"""Relative increase of standard deviations on maps of full noise, and for links with both ends observed.

Chosen for 90 % coverage of the 90 % intervals on procedural homes explored with range noise, drift and missed walls.
"""

_WIDTHS = ((16, 32, 48, 64), (8, 16, 24, 32))
_HIDDEN_UNITS = 64
_LOS_MOST_DB = 10.0
"""Largest mean gain given LOS over free space [dB]: other paths add at most this power."""

_LOS_OFFSET = -1.5
_NLOS_DB, _NLOS_SCALE_DB = -25.0, 20.0
_STATISTICS_MOMENTUM = 0.9
_FADE_CELLS = 8.0
"""Width of the rim of a window in which its numbers fade to 0 [cells]."""

_IMPOSSIBLE = -1e30
_LINKS_AT_ONCE, _MAPS_AT_ONCE, _MAPS_KEPT = 16_384, 8, 8
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
    **dict.fromkeys(("tx_seen", "rx_seen", "possible", "walled_m"), ()),
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
    return lambda of, ops: ops.log(1.0 + length_m(of) / _SCALE_M)


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
    "tx_seen": _flag("tx_seen"),
    "rx_seen": _flag("rx_seen"),
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

_SQUARE = (WINDOW_CELLS, WINDOW_CELLS)
_LINK_INPUTS_WITH_MAP = len(LINK_INPUTS) + len(CELLS_M) * MAP_FEATURES

CONTEXT_SHAPES: tuple[Mapping[str, Shapes], ...] = (
    {},
    {LINK_NETWORK: ((None, len(LINK_INPUTS)), (None, LINK_OUTPUTS))},
    {
        LINK_NETWORK: ((None, _LINK_INPUTS_WITH_MAP), (None, LINK_OUTPUTS)),
        **dict.fromkeys(MAP_NETWORKS, ((None, *_SQUARE, len(CHANNELS)), (None, *_SQUARE, MAP_FEATURES))),
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


def receiver_offsets_m(phi: LinkFeatures) -> NDArray[np.float32]:
    context = context_of(phi)
    return (context.rx_m - context.tx_m)[:, :2].astype(np.float32)


def context_networks(seed: int, *, with_map: bool = True) -> dict[str, "keras.Model"]:
    keras, start = import_keras(), kernel_starts(seed)
    networks = {LINK_NETWORK: _link_network(keras, start, _LINK_INPUTS_WITH_MAP if with_map else len(LINK_INPUTS))}
    for name, widths in zip(MAP_NETWORKS, _WIDTHS, strict=True) if with_map else ():
        networks[name] = _map_network(keras, start, name, widths)
    return networks


def kernel_starts(seed: int) -> Callable[[], Any]:
    keras, seeds = import_keras(), itertools.count(1000 * seed + 1)
    return lambda: keras.initializers.GlorotUniform(seed=next(seeds))


def _map_network(keras: Any, start: Callable[[], Any], name: str, widths: tuple[int, ...]) -> "keras.Model":
    window = keras.Input((*_SQUARE, len(CHANNELS)), name="window", dtype="float32")
    fractions = layer(keras, "Rescaling", "shares", 1.0 / 255.0)(window)
    joined = layer(keras, "Concatenate", "all")([u_net(keras, start, fractions, widths), fractions])
    values = layer(keras, "Conv2D", "values", MAP_FEATURES, 1, kernel_initializer=start())(joined)
    return keras.Model(window, values, name=name)


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


def _link_network(keras: Any, start: Callable[[], Any], inputs: int) -> "keras.Model":
    x = link = keras.Input((inputs,), name="link", dtype="float32")
    for number in (1, 2):
        options = {"activation": "silu", "kernel_initializer": start()}
        x = layer(keras, "Dense", f"hidden_{number}", _HIDDEN_UNITS, **options)(x)
    outputs = layer(keras, "Dense", "outputs", LINK_OUTPUTS, kernel_initializer="zeros")(x)
    return keras.Model(link, outputs, name=LINK_NETWORK)


def kind_of(networks: Networks) -> NetworkKind:
    return "map" if reads_maps(networks) else "paths" if LINK_NETWORK in networks else "paper"


def reads_maps(networks: Networks) -> bool:
    return MAP_NETWORKS[0] in networks


def read_maps(networks: Networks, windows: Any, ops: Any = array_ops, *, training: bool = False) -> list[Any]:
    """Return the outputs of the map networks for windows (B, *WINDOWS) in [0, 255], less those for an empty window.

    In training, values are normalised by the statistics of this batch. `ops` is `array_ops`, or keras.ops
    for tensors.
    """
    if not reads_maps(networks):
        return []
    windows = ops.concatenate([windows, ops.zeros_like(windows[:1])], axis=0)
    options = {"training": True} if training else {}
    maps = [networks[name](windows[:, scale], **options) for scale, name in enumerate(MAP_NETWORKS)]
    return [each[:-1] - each[-1:] for each in maps]


class MapReader:
    """Reads windows by map networks, and keeps the latest results."""

    def __init__(self, networks: Networks) -> None:
        self._networks = networks
        self._kept: dict[bytes, list[list[Any]]] = {}

    def __call__(self, windows: NDArray[np.uint8]) -> list[list[Any]]:
        """Return `read_maps` of each window (W, *WINDOWS)."""
        key, kept = windows.tobytes(), self._kept
        if key not in kept:
            maps = read_maps(self._networks, windows.astype(np.float32))
            each_window = [[each[at : at + 1] for each in maps] for at in range(len(windows))]
            self._kept = kept = dict([*kept.items()][1 - _MAPS_KEPT :]) | {key: each_window}
        return kept[key]


def read_links(networks: Networks, maps: Sequence[Any], links: Any, offsets_m: Any, ops: Any = array_ops) -> Any:
    """Return the outputs (B, R, LINK_OUTPUTS) of the link network for R links of each of B transmitters."""
    at_receivers = [_interpolated(each, offsets_m / cell_m, ops) for each, cell_m in zip(maps, CELLS_M, strict=False)]
    links = ops.concatenate([links, *at_receivers], axis=-1)
    outputs = networks[LINK_NETWORK](ops.reshape(links, (-1, links.shape[-1])))
    return ops.reshape(outputs, (*offsets_m.shape[:2], LINK_OUTPUTS))


def _interpolated(maps: Any, offsets: Any, ops: Any) -> Any:
    """Interpolate maps (B, S, S, C) at offsets (B, R, 2) from their centres [cells], fading to 0 at the border."""
    half, (receivers, features) = WINDOW_CELLS / 2, (offsets.shape[1], maps.shape[-1])
    inside = ops.clip((half - ops.abs(offsets)) / _FADE_CELLS, 0.0, 1.0)
    centres = np.arange(WINDOW_CELLS, dtype=np.float32) + np.float32(0.5 - half)
    weights = inside[..., None] * ops.maximum(1.0 - ops.abs(offsets[..., None] - centres), 0.0)
    rows = ops.matmul(weights[:, :, 1], ops.reshape(maps, (-1, WINDOW_CELLS, WINDOW_CELLS * features)))
    rows = ops.reshape(rows, (-1, receivers, WINDOW_CELLS, features))
    return ops.matmul(weights[:, :, :1], rows)[:, :, 0]


def decode(outputs: Any, free_db: Any, ops: Any = array_ops) -> tuple[Any, Any, Any]:
    """Return log-probabilities (..., 3), and means [dB] and log-variances (..., 2) given LOS and NLOS."""
    los_db = _LOS_MOST_DB * ops.sigmoid(_LOS_OFFSET + outputs[..., 3])
    nlos_db = _NLOS_DB + _NLOS_SCALE_DB * outputs[..., 4]
    means_db = free_db[..., None] + ops.stack([los_db, nlos_db], axis=-1)
    low, high = (2.0 * math.log(std_db) for std_db in STD_RANGE_DB)
    return ops.log_softmax(outputs[..., :3]), means_db, low + (high - low) * ops.sigmoid(outputs[..., 5:])


def distribution(outputs: Any, free_db: Any, context: LinkContext, ops: Any = array_ops) -> tuple[Any, Any, Any]:
    """Return probabilities, means and standard deviations of the gain [dB], each (3, N) by LinkState.

    Standard deviations grow with the range noise of the map, which the networks do not notice.
    """
    widening = 1.0 + excess_noise(context.wall_noise) * np.where(
        context.tx_seen & context.rx_seen, SEEN_WIDENING, WIDENING
    )
    states = ops.where(context.possible, outputs[:, : len(LinkState)], _IMPOSSIBLE)
    outputs = ops.concatenate([states, outputs[:, len(LinkState) :]], axis=1)
    log_probabilities, gains_db, log_variances = decode(outputs, free_db, ops)
    outage = np.full((1, len(context)), GAIN_FLOOR_DB)
    means_db = ops.concatenate([outage, ops.transpose(ops.maximum(gains_db, GAIN_FLOOR_DB))], axis=0)
    stds_db = ops.concatenate([np.zeros_like(outage), ops.transpose(ops.exp(0.5 * log_variances))], axis=0)
    return ops.transpose(ops.exp(log_probabilities)), means_db, stds_db * widening


def evaluate_context_networks(
    networks: Networks, phi: LinkFeatures, frequency_hz: float, read: MapReader | None = None
) -> tuple[Floats, Floats, Floats]:
    """Return the `distribution` of N links with a context."""
    inputs, offsets_m = scaled_inputs(phi, frequency_hz), receiver_offsets_m(phi)
    outputs = np.zeros((len(phi), LINK_OUTPUTS))
    for maps, links in _by_window(networks, context_of(phi), read):
        for start in range(0, len(links), _LINKS_AT_ONCE):
            here = links[start : start + _LINKS_AT_ONCE]
            outputs[here] = read_links(networks, maps, inputs[None, here], offsets_m[None, here])[0]
    free_db = free_space_gain_db(phi.distance_m, phi.frequency_hz or frequency_hz)
    return distribution(outputs, free_db, context_of(phi))


def _by_window(networks: Networks, context: LinkContext, read: MapReader | None) -> Iterator[tuple[list[Any], Indices]]:
    if not reads_maps(networks):
        yield [], np.arange(len(context))
        return
    assert context.windows is not None
    read = read or MapReader(networks)
    used, links = _links_by_window(context)
    for start in range(0, len(used), _MAPS_AT_ONCE):
        here = slice(start, start + _MAPS_AT_ONCE)
        yield from zip(read(context.windows[used[here]]), links[here], strict=True)


def _links_by_window(context: LinkContext) -> tuple[Indices, list[Indices]]:
    used, counts = np.unique(context.window_index, return_counts=True)
    return used, np.split(np.argsort(context.window_index, kind="stable"), np.cumsum(counts)[:-1])


def fit_context_networks(
    phi: LinkFeatures,
    link_state: States,
    gain_db: Floats,
    settings: PredictorSettings,
    *,
    progress: Progress | None = None,
) -> dict[str, "keras.Model"]:
    """Fit the networks of `settings` to links with a context, with windows turned and mirrored at random."""
    networks = context_networks(settings.seed, with_map=settings.networks == "map")
    examples = _Examples(phi, link_state, gain_db, settings)
    steps = math.ceil(settings.passes * len(examples) / WINDOWS_AT_ONCE)
    step = _gradient_step(networks, steps)
    losses = []
    for number, batch in enumerate(examples.batches(steps, np.random.default_rng(settings.seed))):
        losses.append(float(step(**batch)))
        if progress and number % _REPORT_STEPS == 0:
            recent = np.mean(losses[-_REPORT_STEPS:])
            progress(number / steps, f"step {number} of {steps}, loss {recent:.4f}")
    _log.info("%d steps on %d windows: loss %.4f", steps, len(examples), np.mean(losses[-_REPORT_STEPS:]))
    if not np.isfinite(losses).all():
        raise PredictorError(f"training diverged in step {int(np.argmin(np.isfinite(losses)))}: give another seed.")
    return networks


class _Examples:
    """Training links by window."""

    def __init__(self, phi: LinkFeatures, link_state: States, gain_db: Floats, settings: PredictorSettings) -> None:
        self._used, links = _links_by_window(context_of(phi))
        self._windows = context_of(phi).windows if settings.networks == "map" else None
        self._first = np.cumsum([0, *map(len, links)])
        columns = {
            "links": scaled_inputs(phi, settings.frequency_hz),
            "offsets_m": receiver_offsets_m(phi),
            "free_db": free_space_gain_db(phi.distance_m, settings.frequency_hz).astype(np.float32),
            "link_state": link_state.astype(np.int32),
            "gain_db": gain_db.astype(np.float32),
        }
        order = np.concatenate(links)
        self._columns = {name: column[order] for name, column in columns.items()}

    def __len__(self) -> int:
        return len(self._used)

    def batches(self, steps: int, rng: np.random.Generator) -> Iterator[dict[str, NDArray[np.generic]]]:
        order = np.zeros(0, dtype=np.intp)
        for _ in range(steps):
            while len(order) < WINDOWS_AT_ONCE:
                order = np.concatenate([order, rng.permutation(len(self))])
            chosen, order = order[:WINDOWS_AT_ONCE], order[WINDOWS_AT_ONCE:]
            low, high = self._first[chosen], self._first[chosen + 1]
            links = rng.integers(low[:, None], high[:, None], (len(chosen), LINKS_OF_WINDOW))
            batch = {name: column[links] for name, column in self._columns.items()}
            turns = rng.integers(8, size=len(chosen))
            pairs = zip(batch["offsets_m"], turns, strict=True)
            batch["offsets_m"] = np.stack([turned_offsets(offset_m, turn) for offset_m, turn in pairs])
            if self._windows is not None:
                images = zip(self._windows[self._used[chosen]], turns, strict=True)
                batch["windows"] = np.stack([turned(image, turn) for image, turn in images]).astype(np.float32)
            yield batch


def turned(image: NDArray[np.uint8], turn: int) -> NDArray[np.uint8]:
    """Return one of the eight orientations of squares (K, S, S, C)."""
    image = image[:, :, ::-1] if turn & 1 else image
    image = image[:, ::-1] if turn & 2 else image
    return image.transpose(0, 2, 1, 3) if turn & 4 else image


def turned_offsets(offsets_m: NDArray[np.float32], turn: int) -> NDArray[np.float32]:
    x, y = offsets_m.T
    x = -x if turn & 1 else x
    y = -y if turn & 2 else y
    return np.stack([y, x] if turn & 4 else [x, y], axis=1)


def _gradient_step(networks: Networks, steps: int) -> Callable[..., Any]:
    weights = [weight for name in sorted(networks) for weight in networks[name].trainable_variables]
    optimizer, ops = adam_w(weights, steps), import_keras().ops

    def step(links: Any, offsets_m: Any, free_db: Any, link_state: Any, gain_db: Any, windows: Any = None) -> Any:
        with tf.GradientTape() as tape:
            outputs = read_links(networks, read_maps(networks, windows, ops, training=True), links, offsets_m, ops)
            log_p, means_db, log_variances = decode(outputs, free_db, ops)
            loss = -tf.reduce_mean(tf.gather(log_p, link_state, batch_dims=2))
            scores_db = _crps(gain_db[..., None] - means_db, tf.exp(0.5 * log_variances))
            states = tf.constant([LinkState.LOS, LinkState.NLOS], dtype=tf.int32)
            linked = tf.cast(link_state[..., None] == states, tf.float32)
            loss += GAIN_WEIGHT * tf.reduce_mean(tf.reduce_sum(scores_db * linked, axis=-1))
        optimizer.apply_gradients(zip(tape.gradient(loss, weights), weights, strict=True))
        return loss

    compiled: Callable[..., Any] = tf.function(step, autograph=False, jit_compile=False)
    return compiled


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
