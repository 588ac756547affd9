"""The networks that see where links run, as Keras 3 models: two map networks and a link network.

The map networks read the windows around the transmitter, near and far, and write `MAP_FEATURES` numbers into each of
their cells: U-Nets (Ronneberger, Fischer and Brox 2015), a smaller one for afar. What they make of an empty window is
taken off, so that a map says nothing where nothing was observed, and the numbers fade to 0 towards the border of each
window: nothing changes where one ends. The link network reads what the trace gives of a link, and the numbers of all
windows at its receiver. It returns P(link state), and mean and log-variance of the gain in line of sight and without.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.prediction.certainty import possible_states
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.link_context import REACHES_M, LinkContext
from sionna_partial.prediction.paper_networks import STD_RANGE_DB, free_space_gain_db, import_keras, layer, own_input
from sionna_partial.prediction.windows import CELLS_M, CHANNELS, WINDOW_CELLS, map_windows, transmitter_places

if TYPE_CHECKING:
    import keras

Shape = tuple[int | None, ...]

MAP_NETWORKS, LINK_NETWORK = ("near_map_network", "far_map_network"), "link_network"
"""Names of the networks; those of maps are in the order of `CELLS_M`."""

MAP_FEATURES = 16
"""Number of values of a cell that the link network reads."""

LINK_OUTPUTS = 7
"""Logits of the link states, then mean and spread of the gain given LOS, and given NLOS."""

_WIDTHS = ((16, 32, 48, 64), (8, 16, 24, 32))
_HIDDEN_UNITS = 64
_LOS_MOST_DB = 10.0
"""Largest mean gain given LOS, over free space [dB]: other paths add power to the direct one, and never so much."""

_LOS_OFFSET = -1.5
_NLOS_OFFSET_DB, _NLOS_SCALE_DB = -25.0, 20.0
_STATISTICS_MOMENTUM = 0.9
_FADE_CELLS = 8.0
"""Width of the rim of a window in which its numbers fade to 0 [cells]."""

_SCALE_M, _SCALE_DB = 3.0, 100.0
_NEAREST_M = 0.1
_IMPOSSIBLE = -1e30
_LINKS_AT_ONCE, _WINDOWS_AT_ONCE = 16_384, 8


@dataclass(frozen=True)
class LinkNumbers:
    """The numbers among what the trace knows of N links; every one (N,) unless said otherwise, an array or a tensor.

    Parameters
    ----------
    distance_m, unobserved_distance_m : float64
        Length of the direct line, and of its unobserved part [m].
    walled_m : float64
        Its length in cells of known walls [m]: outlines of walls may leave them open.
    gain_db : float64
        Of the partial trace [dB].
    indirect_gain_db : (N, len(REACHES_M)) float64
    strongest_unobserved_m : float64
        See `LinkContext`.
    """

    distance_m: Any
    unobserved_distance_m: Any
    walled_m: Any
    gain_db: Any
    indirect_gain_db: Any
    strongest_unobserved_m: Any

    @classmethod
    def of(cls, phi: LinkFeatures) -> "LinkNumbers":
        """Take them from features with a context."""
        context = context_of(phi)
        return cls(
            phi.distance_m,
            phi.unobserved_distance_m,
            context.walled_m,
            phi.gain_db,
            context.indirect_gain_db,
            context.strongest_unobserved_m,
        )


def context_of(phi: LinkFeatures) -> LinkContext:
    """Return the context that features must have here."""
    assert phi.context is not None
    return phi.context


def link_marks(phi: LinkFeatures) -> NDArray[np.float64]:
    """Return binary features (N, `LINK_MARKS`) of N links, which have a context: 0 or 1."""
    context, states = context_of(phi), (phi.link_state == state for state in LinkState)
    return np.stack([*states, context.tx_seen, context.rx_seen, *possible_states(phi).T], axis=1) * 1.0


def input_columns(marks: Any, numbers: LinkNumbers, frequency_hz: float, ops: ModuleType = np) -> Any:
    """Scale what the trace knows of N links to a few units: the inputs (N, `LINK_INPUTS`) of the link network.

    Parameters
    ----------
    marks : (N, LINK_MARKS) float64 array or tensor
    numbers : LinkNumbers
    frequency_hz : float
        Carrier frequency [Hz].
    ops : module
        NumPy, or keras.ops for tensors.
    """
    distance_m, unobserved_m = numbers.distance_m, numbers.unobserved_distance_m
    free_db, near_m = free_space_gain_db(distance_m, frequency_hz, ops), ops.maximum(distance_m, _NEAREST_M)
    indirect_db = [numbers.indirect_gain_db[:, reach] for reach in range(len(REACHES_M))]
    lengths_m = (distance_m, unobserved_m, distance_m - unobserved_m, numbers.strongest_unobserved_m)
    columns = [
        *(ops.minimum(numbers.walled_m, 1.0), ops.log(near_m), unobserved_m / near_m),
        *(ops.log(1.0 + length_m / _SCALE_M) for length_m in lengths_m),
        *((gain_db - GAIN_FLOOR_DB) / _SCALE_DB for gain_db in (numbers.gain_db, free_db, *indirect_db)),
        *(ops.clip((gain_db - free_db) / 30.0, -2.0, 0.5) for gain_db in (numbers.gain_db, *indirect_db)),
    ]
    return ops.concatenate([marks, ops.stack(columns, axis=1)], axis=1)


def link_inputs(phi: LinkFeatures, frequency_hz: float) -> NDArray[np.float32]:
    """Return the inputs (N, `LINK_INPUTS`) of the link network for the features of N links, which have a context."""
    return input_columns(link_marks(phi), LinkNumbers.of(phi), frequency_hz).astype(np.float32)


LINK_MARKS = len(LinkState) + 2 + len(LinkState)
"""Number of values that `link_marks` gives of a link."""

LINK_INPUTS = LINK_MARKS + 7 + 2 + len(REACHES_M) + 1 + len(REACHES_M)
"""Number of values that `link_inputs` gives of a link."""


@dataclass(frozen=True)
class Shapes:
    """Shapes of what goes in and comes out of networks that `assemble` puts together, by name."""

    inputs: dict[str, Shape]
    outputs: dict[str, Shape]

    @classmethod
    def of(cls, **networks: tuple[Shape, Shape]) -> "Shapes":
        """Take (input, output) of each network, without the first axis."""
        inputs = {own_input(name): (None, *ends[0]) for name, ends in networks.items()}
        return cls(inputs, {name: (None, *ends[1]) for name, ends in networks.items()})


_SQUARE = (WINDOW_CELLS, WINDOW_CELLS)

CONTEXT_SHAPES = (
    Shapes.of(),
    Shapes.of(link_network=((LINK_INPUTS,), (LINK_OUTPUTS,))),
    Shapes.of(
        link_network=((LINK_INPUTS + len(CELLS_M) * MAP_FEATURES,), (LINK_OUTPUTS,)),
        **dict.fromkeys(MAP_NETWORKS, ((*_SQUARE, len(CHANNELS)), (*_SQUARE, MAP_FEATURES))),
    ),
)
"""What a predictor may have beside the networks of the paper: nothing, "paths", or "map"."""


def context_networks(seed: int, *, with_map: bool = True) -> dict[str, "keras.Model"]:
    """Build the networks, untrained, by name.

    Parameters
    ----------
    seed : int
        Of the first weights.
    with_map : bool
        Whether there are map networks; without them, the link network knows nothing but the trace.

    Returns
    -------
    dict of str to keras.Model
    """
    keras = import_keras()
    start = _Seeds(keras, seed)
    told = len(CELLS_M) * MAP_FEATURES if with_map else 0
    networks = {LINK_NETWORK: _link_network(keras, start, LINK_INPUTS + told)}
    if with_map:
        networks |= {
            name: _map_network(keras, start, name, each) for name, each in zip(MAP_NETWORKS, _WIDTHS, strict=True)
        }
    return networks


def look(
    networks: Mapping[str, "keras.Model"], windows: Any, links: Any, offsets_m: Any, *, training: bool = False
) -> Any:
    """Evaluate the networks on R links of each of B transmitters.

    Parameters
    ----------
    networks : mapping of str to keras.Model
        By name.
    windows : (B, *WINDOWS) float32 tensor
        In [0, 255]; without map networks they are not read, and may be None.
    links : (B, R, LINK_INPUTS) float32 tensor
    offsets_m : (B, R, 2) float32 tensor
        Of the receivers from the transmitter: x, y [m].
    training : bool
        See `read_maps`.

    Returns
    -------
    (B, R, LINK_OUTPUTS) float32 tensor
    """
    known = read_maps(networks, windows, training=training) if reads_maps(networks) else []
    return read_links(networks, known, links, offsets_m)


def reads_maps(networks: Mapping[str, "keras.Model"]) -> bool:
    """Whether there are map networks."""
    return MAP_NETWORKS[0] in networks


def read_maps(networks: Mapping[str, "keras.Model"], windows: Any, *, training: bool = False) -> list[Any]:
    """Let the map networks read windows.

    Parameters
    ----------
    networks : mapping of str to keras.Model
        By name.
    windows : (B, *WINDOWS) float32 tensor
        In [0, 255].
    training : bool
        Whether values are normalised by the statistics of these windows, which are kept, rather than by the kept ones.

    Returns
    -------
    list of (B, WINDOW_CELLS, WINDOW_CELLS, MAP_FEATURES) float32 tensors
        What each cell says beyond what one of an empty window does, near and far.
    """
    import tensorflow as tf

    windows = tf.concat([windows, tf.zeros_like(windows[:1])], axis=0)
    maps = [networks[name](windows[:, scale], training=training) for scale, name in enumerate(MAP_NETWORKS)]
    return [each[:-1] - each[-1:] for each in maps]


def read_links(networks: Mapping[str, "keras.Model"], known: Sequence[Any], links: Any, offsets_m: Any) -> Any:
    """Let the link network read R links of each of B transmitters: (B, R, LINK_OUTPUTS) float32 tensor.

    Parameters
    ----------
    networks : mapping of str to keras.Model
        By name.
    known : sequence of (B, WINDOW_CELLS, WINDOW_CELLS, MAP_FEATURES) float32 tensors
        From `read_maps`; none without map networks.
    links, offsets_m : tensors
        See `look`.
    """
    import tensorflow as tf

    at_receivers = [_between(maps, offsets_m / cell_m) for maps, cell_m in zip(known, CELLS_M, strict=False)]
    links = tf.concat([links, *at_receivers], axis=-1)
    outputs = networks[LINK_NETWORK](tf.reshape(links, (-1, links.shape[-1])))
    return tf.reshape(outputs, (tf.shape(offsets_m)[0], -1, LINK_OUTPUTS))


def decode(outputs: Any, free_db: Any) -> tuple[Any, Any, Any]:
    """Return log-probabilities of the link states, and means and log-variances of the gain given LOS and NLOS.

    Parameters
    ----------
    outputs : (..., LINK_OUTPUTS) tensor
    free_db : (...) tensor
        Gain of free space [dB].

    Returns
    -------
    log_probabilities : (..., 3) tensor
        By LinkState.
    means_db, log_variances : (..., 2) tensors
        Of LOS and NLOS [dB, dB^2]. The mean given LOS is that of free space or up to `_LOS_MOST_DB` more.
    """
    import tensorflow as tf

    los_db = _LOS_MOST_DB * tf.sigmoid(_LOS_OFFSET + outputs[..., 3])
    nlos_db = _NLOS_OFFSET_DB + _NLOS_SCALE_DB * outputs[..., 4]
    means_db = free_db[..., None] + tf.stack([los_db, nlos_db], axis=-1)
    low, high = (2.0 * math.log(std_db) for std_db in STD_RANGE_DB)
    return tf.nn.log_softmax(outputs[..., :3]), means_db, low + (high - low) * tf.sigmoid(outputs[..., 5:])


def evaluate_context_networks(
    networks: Mapping[str, "keras.Model"], phi: LinkFeatures, frequency_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Evaluate the networks on N links.

    Parameters
    ----------
    networks : mapping of str to keras.Model
        By name.
    phi : LinkFeatures
        With a context.
    frequency_hz : float
        Carrier frequency [Hz].

    Returns
    -------
    probabilities, means_db, stds_db : (3, N) float64 arrays
        Probability of each LinkState, and mean and standard deviation of the gain given it [dB].
    """
    context = context_of(phi)
    inputs, offsets_m = link_inputs(phi, frequency_hz), receiver_offsets_m(context)
    outputs = np.zeros((len(phi), LINK_OUTPUTS))
    for known, links in _by_window(networks, context):
        for start in range(0, len(links), _LINKS_AT_ONCE):
            here = links[start : start + _LINKS_AT_ONCE]
            outputs[here] = read_links(networks, known, inputs[None, here], offsets_m[None, here])[0]
    free_db = free_space_gain_db(phi.distance_m, frequency_hz)
    possible = possible_states(phi)
    probabilities, means_db, stds_db = distribution(outputs, free_db, possible)
    return np.asarray(probabilities), np.asarray(means_db), np.asarray(stds_db)


def distribution(outputs: Any, free_db: Any, possible: NDArray[np.bool_]) -> tuple[Any, Any, Any]:
    """Read the outputs of the link network for N links; states that the map excludes have probability 0.

    Parameters
    ----------
    outputs : (N, LINK_OUTPUTS) float64 tensor
    free_db : (N,) float64 tensor
        Gain of free space [dB].
    possible : (N, 3) bool array
        From `possible_states`.

    Returns
    -------
    probabilities, means_db, stds_db : (3, N) float64 tensors
        Probability of each LinkState, and mean and standard deviation of the gain given it [dB].
    """
    import tensorflow as tf

    states = tf.where(possible, outputs[:, : len(LinkState)], _IMPOSSIBLE)
    outputs = tf.concat([states, outputs[:, len(LinkState) :]], axis=1)
    log_probabilities, gains_db, log_variances = decode(outputs, free_db)
    outage = tf.fill([1, len(free_db)], tf.constant(GAIN_FLOOR_DB, tf.float64))
    means_db = tf.concat([outage, tf.transpose(tf.maximum(gains_db, GAIN_FLOOR_DB))], axis=0)
    stds_db = tf.concat([tf.zeros_like(outage), tf.transpose(tf.exp(0.5 * log_variances))], axis=0)
    return tf.transpose(tf.exp(log_probabilities)), means_db, stds_db


class _Seeds:
    """First weights, each layer with a seed of its own."""

    def __init__(self, keras: Any, seed: int) -> None:
        self._keras, self._next = keras, 1000 * seed

    def __call__(self) -> Any:
        self._next += 1
        return self._keras.initializers.GlorotUniform(seed=self._next)


def _map_network(keras: Any, start: _Seeds, name: str, widths: tuple[int, ...]) -> "keras.Model":
    def convolved(x: Any, units: int, name: str) -> Any:
        options = {"padding": "same", "use_bias": False, "kernel_initializer": start()}
        x = layer(keras, "Conv2D", name, units, 3, **options)(x)
        x = layer(keras, "BatchNormalization", f"{name}_normal", momentum=_STATISTICS_MOMENTUM)(x)
        return layer(keras, "ReLU", f"{name}_active")(x)

    window = keras.Input((WINDOW_CELLS, WINDOW_CELLS, len(CHANNELS)), name="window", dtype="float32")
    shares = layer(keras, "Rescaling", "shares", 1.0 / 255.0)(window)
    x = convolved(shares, widths[0], "down_0")
    levels = []
    for depth, units in enumerate(widths[1:], 1):
        levels.append(x)
        x = layer(keras, "MaxPooling2D", f"pool_{depth}")(x)
        x = convolved(convolved(x, units, f"down_{depth}"), units, f"down_{depth}_again")
    for depth in reversed(range(len(levels))):
        x = layer(keras, "UpSampling2D", f"grow_{depth}")(x)
        x = convolved(layer(keras, "Concatenate", f"join_{depth}")([x, levels[depth]]), widths[depth], f"up_{depth}")
        x = convolved(x, widths[depth], f"up_{depth}_again") if depth else x
    joined = layer(keras, "Concatenate", "all")([x, shares])
    values = layer(keras, "Conv2D", "values", MAP_FEATURES, 1, kernel_initializer=start())(joined)
    return keras.Model(window, values, name=name)


def _link_network(keras: Any, start: _Seeds, inputs: int) -> "keras.Model":
    x = link = keras.Input((inputs,), name="link", dtype="float32")
    for number in (1, 2):
        options = {"activation": "silu", "kernel_initializer": start()}
        x = layer(keras, "Dense", f"hidden_{number}", _HIDDEN_UNITS, **options)(x)
    outputs = layer(keras, "Dense", "outputs", LINK_OUTPUTS, kernel_initializer="zeros")(x)
    return keras.Model(link, outputs, name=LINK_NETWORK)


def receiver_offsets_m(context: LinkContext) -> NDArray[np.float32]:
    """Return where receivers (N, 2) are as seen from their transmitters: x, y [m]."""
    return (context.rx_m - context.tx_m)[:, :2].astype(np.float32)


def _by_window(networks: Mapping[str, Any], context: LinkContext) -> Iterator[tuple[list[Any], NDArray[np.intp]]]:
    """Yield what the map networks read around each transmitter, and its links; without them nothing, and all links."""
    if not reads_maps(networks):
        yield [], np.arange(len(context))
        return
    places, index = transmitter_places(context)
    links = np.split(np.argsort(index, kind="stable"), np.cumsum(np.bincount(index, minlength=len(places)))[:-1])
    for number in np.unique(places[:, 0]).astype(int):
        rows = np.flatnonzero(places[:, 0] == number)
        windows = map_windows(context.maps[number], places[rows, 1:]).astype(np.float32)
        for start in range(0, len(rows), _WINDOWS_AT_ONCE):
            known = read_maps(networks, windows[start : start + _WINDOWS_AT_ONCE])
            for here, row in enumerate(rows[start : start + _WINDOWS_AT_ONCE]):
                yield [maps[here : here + 1] for maps in known], links[row]


def _between(maps: Any, offsets: Any) -> Any:
    """Values (B, R, C) of maps (B, S, S, C) at offsets (B, R, 2) from their middles [cells].

    They are bilinear between the middles of cells, and fade to 0 towards the border.
    """
    import tensorflow as tf

    half = WINDOW_CELLS / 2
    inside = tf.clip_by_value((half - tf.abs(offsets)) / _FADE_CELLS, 0.0, 1.0)
    middles = tf.range(WINDOW_CELLS, dtype=tf.float32) + 0.5 - half
    x, y = tf.unstack(inside[..., None] * tf.maximum(1.0 - tf.abs(offsets[..., None] - middles), 0.0), axis=2)
    return tf.einsum("brx,brxc->brc", x, tf.einsum("bry,byxc->brxc", y, maps))
