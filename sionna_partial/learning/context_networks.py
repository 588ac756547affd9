"""The networks that see where links run, as Keras 3 models: a map network and a link network.

The map network reads the window around the transmitter and writes `MAP_FEATURES` numbers into each of its cells: a
U-Net (Ronneberger, Fischer and Brox 2015). What it makes of an empty window is taken off, so that a map says nothing
where nothing was observed. The link network reads what the trace knows of a link, and the numbers at its receiver. It
says P(link state), and mean and log-variance of the gain in line of sight and without.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.learning.certainty import possible_states
from sionna_partial.learning.features import LinkFeatures
from sionna_partial.learning.link_context import REACHES_M, LinkContext
from sionna_partial.learning.networks import STD_RANGE_DB, free_space_gain_db, import_keras, layer, own_input
from sionna_partial.learning.windows import CHANNELS, WINDOW_CELLS, transmitter_windows, window_places

if TYPE_CHECKING:
    import keras

Shape = tuple[int | None, ...]

MAP_NETWORK, LINK_NETWORK = "map_network", "link_network"
"""Names of the two networks."""

MAP_FEATURES = 16
"""Number of values of a cell that the link network reads."""

LINK_OUTPUTS = 7
"""Logits of the link states, then mean and spread of the gain given LOS, and given NLOS."""

_WIDTHS = (16, 32, 48, 64)
_HIDDEN_UNITS = 64
_LOS_MOST_DB = 10.0
"""Largest mean gain given LOS, over free space [dB]: other paths add power to the direct one, and never so much."""

_LOS_OFFSET = -1.5
_NLOS_OFFSET_DB, _NLOS_SCALE_DB = -25.0, 20.0
_STATISTICS_MOMENTUM = 0.9
_SCALE_M, _SCALE_DB = 15.0, 100.0
_NEAREST_M = 0.1
_IMPOSSIBLE = -1e30
_LINKS_AT_ONCE, _WINDOWS_AT_ONCE = 65_536, 8


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
    context, los = context_of(phi), phi.link_state == LinkState.LOS
    walled = context.walled_m > 0.0
    certain = los & (phi.unobserved_distance_m == 0.0) & ~walled
    states = (phi.link_state == state for state in LinkState)
    return np.stack([*states, context.tx_seen, context.rx_seen, certain, los & walled], axis=1) * 1.0


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
    columns = [
        *(ops.minimum(numbers.walled_m, 1.0), distance_m / _SCALE_M, ops.log(near_m)),
        *(unobserved_m / _SCALE_M, unobserved_m / near_m, (distance_m - unobserved_m) / _SCALE_M),
        numbers.strongest_unobserved_m / _SCALE_M,
        *((gain_db - GAIN_FLOOR_DB) / _SCALE_DB for gain_db in (numbers.gain_db, free_db, *indirect_db)),
        *(ops.clip((gain_db - free_db) / 30.0, -2.0, 0.5) for gain_db in (numbers.gain_db, *indirect_db)),
    ]
    return ops.concatenate([marks, ops.stack(columns, axis=1)], axis=1)


def link_inputs(phi: LinkFeatures, frequency_hz: float) -> NDArray[np.float32]:
    """Return the inputs (N, `LINK_INPUTS`) of the link network for the features of N links, which have a context."""
    return input_columns(link_marks(phi), LinkNumbers.of(phi), frequency_hz).astype(np.float32)


LINK_MARKS = len(LinkState) + 4
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
        link_network=((LINK_INPUTS + MAP_FEATURES,), (LINK_OUTPUTS,)),
        map_network=((*_SQUARE, len(CHANNELS)), (*_SQUARE, MAP_FEATURES)),
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
        Whether there is a map network; without one, the link network knows nothing but the trace.

    Returns
    -------
    dict of str to keras.Model
    """
    keras = import_keras()
    start = _Seeds(keras, seed)
    networks = {LINK_NETWORK: _link_network(keras, start, LINK_INPUTS + (MAP_FEATURES if with_map else 0))}
    return networks | ({MAP_NETWORK: _map_network(keras, start)} if with_map else {})


def look(
    networks: Mapping[str, "keras.Model"], windows: Any, links: Any, places: Any, *, training: bool = False
) -> Any:
    """Evaluate the networks on R links of each of B windows.

    Parameters
    ----------
    networks : mapping of str to keras.Model
        By name.
    windows : (B, WINDOW_CELLS, WINDOW_CELLS, len(CHANNELS)) float32 tensor
        In [0, 255]; without a map network they are not read, and may be None.
    links : (B, R, LINK_INPUTS) float32 tensor
    places : (B, R, 2) float32 tensor
        Of the receivers: x, y in cells of the window.
    training : bool
        See `read_maps`.

    Returns
    -------
    (B, R, LINK_OUTPUTS) float32 tensor
    """
    known = read_maps(networks, windows, training=training) if MAP_NETWORK in networks else None
    return read_links(networks, known, links, places)


def read_maps(networks: Mapping[str, "keras.Model"], windows: Any, *, training: bool = False) -> Any:
    """Let the map network read windows.

    Parameters
    ----------
    networks : mapping of str to keras.Model
        By name.
    windows : (B, WINDOW_CELLS, WINDOW_CELLS, len(CHANNELS)) float32 tensor
        In [0, 255].
    training : bool
        Whether values are normalised by the statistics of these windows, which are kept, rather than by the kept ones.

    Returns
    -------
    (B, WINDOW_CELLS, WINDOW_CELLS, MAP_FEATURES) float32 tensor
        What each cell says beyond what one of an empty window does.
    """
    import tensorflow as tf

    maps = networks[MAP_NETWORK](tf.concat([windows, tf.zeros_like(windows[:1])], axis=0), training=training)
    return maps[:-1] - maps[-1:]


def read_links(networks: Mapping[str, "keras.Model"], known: Any, links: Any, places: Any) -> Any:
    """Let the link network read R links of each of B windows: (B, R, LINK_OUTPUTS) float32 tensor.

    Parameters
    ----------
    networks : mapping of str to keras.Model
        By name.
    known : (B, WINDOW_CELLS, WINDOW_CELLS, MAP_FEATURES) float32 tensor or None
        From `read_maps`; None without a map network.
    links, places : tensors
        See `look`.
    """
    import tensorflow as tf

    if known is not None:
        links = tf.concat([links, _between(known, places)], axis=-1)
    outputs = networks[LINK_NETWORK](tf.reshape(links, (-1, links.shape[-1])))
    return tf.reshape(outputs, (tf.shape(places)[0], -1, LINK_OUTPUTS))


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
    inputs, places = link_inputs(phi, frequency_hz), window_places(context)
    outputs = np.zeros((len(phi), LINK_OUTPUTS))
    for known, links in _by_window(networks, context):
        for start in range(0, len(links), _LINKS_AT_ONCE):
            here = links[start : start + _LINKS_AT_ONCE]
            outputs[here] = read_links(networks, known, inputs[None, here], places[None, here])[0]
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


def _map_network(keras: Any, start: _Seeds) -> "keras.Model":
    def convolved(x: Any, units: int, name: str) -> Any:
        options = {"padding": "same", "use_bias": False, "kernel_initializer": start()}
        x = layer(keras, "Conv2D", name, units, 3, **options)(x)
        x = layer(keras, "BatchNormalization", f"{name}_normal", momentum=_STATISTICS_MOMENTUM)(x)
        return layer(keras, "ReLU", f"{name}_active")(x)

    window = keras.Input((WINDOW_CELLS, WINDOW_CELLS, len(CHANNELS)), name="window", dtype="float32")
    shares = layer(keras, "Rescaling", "shares", 1.0 / 255.0)(window)
    x = convolved(shares, _WIDTHS[0], "down_0")
    levels = []
    for depth, units in enumerate(_WIDTHS[1:], 1):
        levels.append(x)
        x = layer(keras, "MaxPooling2D", f"pool_{depth}")(x)
        x = convolved(convolved(x, units, f"down_{depth}"), units, f"down_{depth}_again")
    for depth in reversed(range(len(levels))):
        x = layer(keras, "UpSampling2D", f"grow_{depth}")(x)
        x = convolved(layer(keras, "Concatenate", f"join_{depth}")([x, levels[depth]]), _WIDTHS[depth], f"up_{depth}")
        x = convolved(x, _WIDTHS[depth], f"up_{depth}_again") if depth else x
    joined = layer(keras, "Concatenate", "all")([x, shares])
    values = layer(keras, "Conv2D", "values", MAP_FEATURES, 1, kernel_initializer=start())(joined)
    return keras.Model(window, values, name=MAP_NETWORK)


def _link_network(keras: Any, start: _Seeds, inputs: int) -> "keras.Model":
    x = link = keras.Input((inputs,), name="link", dtype="float32")
    for number in (1, 2):
        options = {"activation": "silu", "kernel_initializer": start()}
        x = layer(keras, "Dense", f"hidden_{number}", _HIDDEN_UNITS, **options)(x)
    outputs = layer(keras, "Dense", "outputs", LINK_OUTPUTS, kernel_initializer="zeros")(x)
    return keras.Model(link, outputs, name=LINK_NETWORK)


def _by_window(networks: Mapping[str, Any], context: LinkContext) -> Iterator[tuple[Any, NDArray[np.intp]]]:
    """Yield what the map network knows of each window (1, ...), and its links; without one None and all links."""
    if MAP_NETWORK not in networks:
        yield None, np.arange(len(context))
        return
    windows, index = transmitter_windows(context)
    for start in range(0, len(windows), _WINDOWS_AT_ONCE):
        known = read_maps(networks, windows[start : start + _WINDOWS_AT_ONCE].astype(np.float32))
        for number in range(len(known)):
            yield known[number : number + 1], np.flatnonzero(index == start + number)


def _between(maps: Any, places: Any) -> Any:
    """Values (B, R, C) of maps (B, S, S, C) at places (B, R, 2) [cells], bilinear between the middles of cells."""
    import tensorflow as tf

    middles = tf.range(WINDOW_CELLS, dtype=tf.float32) + 0.5
    x, y = tf.unstack(tf.maximum(1.0 - tf.abs(places[..., None] - middles), 0.0), axis=2)
    return tf.einsum("brx,brxc->brc", x, tf.einsum("bry,byxc->brxc", y, maps))
