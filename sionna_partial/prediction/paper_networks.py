"""Networks of the paper's predictor, side by side in one Keras 3 model.

Inputs are scaled and clamped to the range of the training links; only the anchor, the traced or the free-space gain, is
extrapolated.
"""

import itertools
import logging
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S, LinkState
from sionna_partial.errors import BackendError, PredictorError
from sionna_partial.llvm import load_llvm
from sionna_partial.prediction.evaluate import array_ops
from sionna_partial.prediction.features import LinkFeatures, shifted_gain_db
from sionna_partial.process import signals_held
from sionna_partial.settings import PredictorSettings

if TYPE_CHECKING:
    import keras

NEAREST_M = 0.01
"""Distance below which the free-space gain is constant [m]."""

STATE_INPUTS = ("distance_m", "unobserved_distance_m")
GAIN_INPUTS = (*STATE_INPUTS, "gain_db")
INDOOR_INPUTS = ("unobserved_distance_m",)
"""Unscaled inputs of the paper's networks."""

STD_RANGE_DB = (0.3, 40.0)

_LINKS_AT_ONCE = 65_536
_LARGEST = 1e30
_DEFAULT_RANGES = {"distance_m": (0.0, 30.0), "unobserved_distance_m": (0.0, 30.0), "gain_db": (GAIN_FLOOR_DB, -40.0)}
_PRIOR_LINKS = 10
_WEIGHT_PENALTY = 0.01
_INDOORS = 20.0

_log = logging.getLogger(__name__)

Ranges = Mapping[str, tuple[float, float]]
Networks = Mapping[str, Any]
"""Networks by name: a `Network` for arrays, or a Keras model for tensors."""


def free_space_gain_db(distance_m: ArrayLike, frequency_hz: float, ops: ModuleType = np) -> Any:
    """Return Friis' path gain between isotropic antennas [dB]; `ops` is NumPy, or keras.ops for tensors."""
    return gain_at_1m_db(frequency_hz) - 20.0 * ops.log10(ops.maximum(distance_m, NEAREST_M))


def gain_at_1m_db(frequency_hz: float) -> float:
    return 20.0 * math.log10(SPEED_OF_LIGHT_M_S / (4.0 * math.pi * frequency_hz))


@dataclass(frozen=True)
class GainNetwork:
    """Network for the gain given a link state and partial link states: one row of the paper's table.

    Untrained, gain minus anchor has the mean `prior_offset_db` and the standard deviation `prior_std_db`.
    """

    name: str
    link_state: LinkState
    partial_states: tuple[LinkState, ...]
    inputs: tuple[str, ...]
    hidden_units: int
    prior_offset_db: float
    prior_std_db: float

    @property
    def anchored_to_trace(self) -> bool:
        """Return whether the mean is an offset from the traced gain, not from the free-space gain."""
        return self.partial_states == (LinkState.LOS,) and "gain_db" in self.inputs

    def anchor_db(self, phi: LinkFeatures, frequency_hz: float) -> Floats:
        """Return the gain (N,) to which the network adds the offset [dB]."""
        return phi.gain_db if self.anchored_to_trace else free_space_gain_db(phi.distance_m, frequency_hz)


_NOT_LOS = (LinkState.NLOS, LinkState.OUTAGE)

GAIN_NETWORKS = (
    GainNetwork("gain_los_given_los", LinkState.LOS, (LinkState.LOS,), GAIN_INPUTS, 20, 0.0, 6.0),
    GainNetwork("gain_los_given_nlos_outage", LinkState.LOS, _NOT_LOS, ("distance_m",), 10, 0.0, 6.0),
    GainNetwork("gain_nlos_given_nlos_outage", LinkState.NLOS, _NOT_LOS, GAIN_INPUTS, 20, -20.0, 15.0),
    GainNetwork("gain_nlos_given_los", LinkState.NLOS, (LinkState.LOS,), ("distance_m",), 10, -20.0, 15.0),
)
"""Gain networks of the paper (tab:path_loss_network). An outage needs none."""

STATE_NETWORKS = {state: f"state_given_{state.name.lower()}" for state in LinkState}
"""Multinomial logistic classifiers of the link state by partial link state (paper, Section III-D)."""

INDOOR_NETWORKS = {state: f"indoor_given_{state.name.lower()}" for state in LinkState}
"""Logistic classifiers P(indoor) by partial link state (paper, "Indoor-Outdoor Estimation")."""

OUTPUT_WIDTHS = {
    **dict.fromkeys(STATE_NETWORKS.values(), len(LinkState)),
    **{row.name: 2 for row in GAIN_NETWORKS},
    **dict.fromkeys(INDOOR_NETWORKS.values(), 1),
}

_BACKEND, _DATA_FORMAT = "tensorflow", "channels_last"


def import_keras() -> ModuleType:
    """Import Keras after libLLVM, which must precede TensorFlow."""
    load_llvm()
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    os.environ.setdefault("TF_ENABLE_ONEDNN_OPTS", "0")
    asked = os.environ.get("KERAS_BACKEND", _BACKEND)
    if asked == _BACKEND:
        try:
            with signals_held():
                import keras
        except ImportError as error:
            raise BackendError(f"Keras cannot be imported ({error}): set KERAS_BACKEND={_BACKEND}.") from error
        asked = keras.config.backend()
    if asked != _BACKEND:
        raise BackendError(f"the backend of Keras is {asked!r}: set KERAS_BACKEND={_BACKEND} before Keras is imported.")
    if keras.config.image_data_format() != _DATA_FORMAT:
        raise BackendError(
            f"image_data_format = {keras.config.image_data_format()!r} is not supported: "
            f"call keras.config.set_image_data_format({_DATA_FORMAT!r})."
        )
    return keras


class _TensorFlow:
    """TensorFlow, imported after Keras at first use."""

    def __getattr__(self, name: str) -> Any:
        import_keras()
        import tensorflow

        setattr(self, name, getattr(tensorflow, name))
        return getattr(tensorflow, name)


tf: Any = _TensorFlow()


def logistic(name: str, inputs: tuple[str, ...], ranges: Ranges, bias: ArrayLike) -> "keras.Model":
    """Build a logistic classifier on clamped inputs: softmax or, for one event, sigmoid."""
    keras = import_keras()
    count = np.size(bias)
    tensors, scaled = _scaled_inputs(inputs, ranges)
    activation = "softmax" if count > 1 else "sigmoid"
    dense = layer(keras, "Dense", "probability", count, activation=activation, kernel_initializer="zeros")
    network = keras.Model(tensors, dense(scaled), name=name)
    dense.bias.assign(np.asarray(bias, dtype=np.float32))
    return network


def gain_network(
    row: GainNetwork, ranges: Ranges, offset_db: float, std_db: float, frequency_hz: float, seed: int
) -> "keras.Model":
    """Build a gain network (N, 2): mean [dB] and natural logarithm of the variance [dB^2]; constant until trained."""
    keras = import_keras()
    tensors, hidden = _scaled_inputs(row.inputs, ranges)
    for number in (1, 2):
        start = keras.initializers.GlorotUniform(seed=seed + number)
        units, name = row.hidden_units, f"hidden_{number}"
        hidden = layer(keras, "Dense", name, units, activation="relu", kernel_initializer=start)(hidden)
    shape = layer(keras, "Dense", "mean_shape", 1, kernel_initializer="zeros")(hidden)
    offset = layer(keras, "Rescaling", "offset_db", std_db, offset_db)(shape)
    if row.anchored_to_trace:
        anchor = tensors["gain_db"]
    else:
        decades = keras.ops.log10(keras.ops.maximum(tensors["distance_m"], NEAREST_M))
        anchor = layer(keras, "Rescaling", "free_space_gain_db", -20.0, gain_at_1m_db(frequency_hz))(decades)
    mean = layer(keras, "Add", "mean_db")([anchor, offset])
    low, high = (2.0 * math.log(std) for std in STD_RANGE_DB)
    first = min(max((2.0 * math.log(max(std_db, 1e-9)) - low) / (high - low), 0.02), 0.98)
    spread = layer(keras, "Dense", "spread_shape", 1, activation="sigmoid", kernel_initializer="zeros")
    log_variance = layer(keras, "Rescaling", "log_variance", high - low, low)(spread(hidden))
    spread.bias.assign([math.log(first / (1.0 - first))])
    return keras.Model(tensors, layer(keras, "Concatenate", "gain")([mean, log_variance]), name=row.name)


def assemble(networks: Mapping[str, "keras.Model"]) -> "keras.Model":
    """Put the networks of `OUTPUT_WIDTHS` and any others, with own inputs, side by side in one model."""
    keras = import_keras()
    inputs = {name: keras.Input((1,), name=name, dtype="float32") for name in GAIN_INPUTS}
    outputs = {name: networks[name]({key: inputs[key] for key in networks[name].input}) for name in OUTPUT_WIDTHS}
    for name in sorted(networks.keys() - outputs.keys()):
        own = own_input(name)
        inputs[own] = keras.Input(networks[name].input_shape[1:], name=own, dtype="float32")
        outputs[name] = networks[name](inputs[own])
    return keras.Model(inputs, outputs, name="predictor")


def own_input(name: str) -> str:
    return f"input_of_{name}"


def parts(model: "keras.Model") -> dict[str, "keras.Model"]:
    return {name: model.get_layer(name) for name in model.output}


def network_inputs(phi: LinkFeatures, names: tuple[str, ...] = GAIN_INPUTS) -> dict[str, NDArray[np.float32]]:
    columns = {name: np.clip(getattr(phi, name), -_LARGEST, _LARGEST) for name in names}
    return {name: column.astype(np.float32)[:, None] for name, column in columns.items()}


def distribution_by_paper(
    networks: Networks, inputs: Mapping[str, Any], link_state: States, shift_db: Any = 0.0, ops: Any = array_ops
) -> tuple[Any, Any, Any]:
    """Evaluate the paper's networks on `inputs` (N, 1) of `GAIN_INPUTS` and partial link states (N,).

    `shift_db` is the free-space gain at the networks' frequency less the one at the links' frequency; `ops` is
    `array_ops`, or keras.ops for tensors. Return probabilities, means and standard deviations of the gain [dB], each
    (3, N) by LinkState.
    """
    inputs = {**inputs, "gain_db": shifted_gain_db(inputs["gain_db"], shift_db, ops)}
    inputs = {name: ops.cast(values, "float32") for name, values in inputs.items()}

    def outputs(name: str) -> Any:
        network = networks[name]
        return ops.cast(network({key: inputs[key] for key in network.input}), "float64")

    probabilities: Any = 0.0
    for state, name in STATE_NETWORKS.items():
        probabilities = ops.where((link_state == state)[:, None], outputs(name), probabilities)
    nothing = np.zeros(len(link_state))
    means_db, stds_db = [nothing + GAIN_FLOOR_DB] * len(LinkState), [nothing] * len(LinkState)
    for row in GAIN_NETWORKS:
        served, found = np.isin(link_state, row.partial_states), outputs(row.name)
        mean_db = ops.maximum(found[:, 0] - shift_db, GAIN_FLOOR_DB)
        means_db[row.link_state] = ops.where(served, mean_db, means_db[row.link_state])
        stds_db[row.link_state] = ops.where(served, ops.exp(0.5 * found[:, 1]), stds_db[row.link_state])
    total = ops.sum(probabilities, axis=1, keepdims=True)
    return ops.transpose(probabilities / total), ops.stack(means_db), ops.stack(stds_db)


def evaluate_paper(networks: Networks, phi: LinkFeatures, frequency_hz: float) -> tuple[Floats, Floats, Floats]:
    """Return `distribution_by_paper` for N links as arrays."""
    shift_db = phi.free_space_shift_db(frequency_hz)
    blocks = [
        distribution_by_paper(networks, network_inputs(block), block.link_state, shift_db) for block in _blocks(phi)
    ]
    probabilities, means_db, stds_db = (np.concatenate(part, axis=1) for part in zip(*blocks, strict=True))
    return probabilities, means_db, stds_db


def evaluate_indoor(networks: Networks, phi: LinkFeatures) -> Floats:
    p_indoor = np.zeros(len(phi))
    for state, name in INDOOR_NETWORKS.items():
        served = phi.link_state == state
        blocks = [networks[name](network_inputs(block, INDOOR_INPUTS)) for block in _blocks(phi.take(served))]
        p_indoor[served] = np.concatenate(blocks)[:, 0]
    return p_indoor


def _blocks(phi: LinkFeatures) -> Iterator[LinkFeatures]:
    for start in range(0, max(1, len(phi)), _LINKS_AT_ONCE):
        yield phi.take(slice(start, start + _LINKS_AT_ONCE))


def network_ranges(networks: Mapping[str, Any]) -> dict[str, dict[str, list[float]]]:
    ranges = {}
    for name in OUTPUT_WIDTHS:
        network = networks[name]
        scaling = network.options["scaled"]
        names = [key for key in GAIN_INPUTS if key in network.input]
        spans = zip(names, scaling["scale"], scaling["offset"], strict=True)
        ranges[name] = {key: [-offset / scale, (1.0 - offset) / scale] for key, scale, offset in spans}
    return ranges


def _scaled_inputs(names: tuple[str, ...], ranges: Ranges) -> tuple[dict[str, Any], Any]:
    keras = import_keras()
    tensors = {name: keras.Input((1,), name=name, dtype="float32") for name in names}
    columns = list(tensors.values())
    joined = layer(keras, "Concatenate", "joined")(columns) if len(columns) > 1 else columns[0]
    scale = [1.0 / (ranges[name][1] - ranges[name][0]) for name in names]
    offset = [-ranges[name][0] * factor for name, factor in zip(names, scale, strict=True)]
    scaled = layer(keras, "Rescaling", "scaled", scale, offset)(joined)
    return tensors, layer(keras, "ReLU", "clamped", max_value=1.0)(scaled)


def layer(keras: ModuleType, kind: str, name: str, *arguments: Any, **options: Any) -> Any:
    """Return a stock layer in single precision, regardless of the user's global policy."""
    return getattr(keras.layers, kind)(*arguments, name=name, dtype="float32", **options)


def fit_networks(phi: LinkFeatures, link_state: States, gain_db: Floats, settings: PredictorSettings) -> "keras.Model":
    """Fit classifiers and gain networks to links and their true states and gains [dB] (N,), all indoors."""
    networks = {}
    for partial_state, name in STATE_NETWORKS.items():
        cell = phi.link_state == partial_state
        links, states = phi.take(cell), link_state[cell]
        counts = np.bincount(states, minlength=len(LinkState)) + 1.0
        networks[name] = logistic(name, STATE_INPUTS, _ranges(links, settings), np.log(counts / counts.sum()))
        if len(links) >= settings.minimum_links:
            _fit_logistic(networks[name], links, states)
    for row in GAIN_NETWORKS:
        cell = (link_state == row.link_state) & np.isin(phi.link_state, row.partial_states)
        networks[row.name] = _fit_gain(row, phi.take(cell), gain_db[cell], settings)
    for name in INDOOR_NETWORKS.values():
        networks[name] = logistic(name, INDOOR_INPUTS, _DEFAULT_RANGES, [_INDOORS])
    return assemble(networks)


def fit_indoor_networks(
    model: "keras.Model", phi: LinkFeatures, inside: Bools, settings: PredictorSettings
) -> "keras.Model":
    """Return the networks of `model` with P(indoor) fitted to N links; `inside` (N,) is True indoors.

    A partial link state with fewer than `minimum_links` links keeps its network.
    """
    networks = parts(model)
    for partial_state, name in INDOOR_NETWORKS.items():
        cell = phi.link_state == partial_state
        if cell.sum() >= settings.minimum_links:
            links = phi.take(cell)
            networks[name] = logistic(name, INDOOR_INPUTS, _ranges(links, settings), [0.0])
            _fit_logistic(networks[name], links, inside[cell].astype(np.uint8))
    return assemble(networks)


def _fit_gain(row: GainNetwork, phi: LinkFeatures, gain_db: Floats, settings: PredictorSettings) -> "keras.Model":
    offsets_db = gain_db - row.anchor_db(phi, settings.frequency_hz)
    count = len(phi) + _PRIOR_LINKS
    mean_db = (offsets_db.sum() + _PRIOR_LINKS * row.prior_offset_db) / count
    prior = row.prior_std_db**2 + (row.prior_offset_db - mean_db) ** 2
    variance = (((offsets_db - mean_db) ** 2).sum() + _PRIOR_LINKS * prior) / count
    first_db, seed = (float(mean_db), math.sqrt(variance)), settings.seed + 10 * GAIN_NETWORKS.index(row)
    network = gain_network(row, _ranges(phi, settings), *first_db, settings.frequency_hz, seed)
    if len(phi) >= settings.minimum_links:
        _train(network, phi, gain_db, settings)
    return network


def _ranges(phi: LinkFeatures, settings: PredictorSettings) -> Ranges:
    if len(phi) < settings.minimum_links:
        return _DEFAULT_RANGES
    spans = {name: (float(getattr(phi, name).min()), float(getattr(phi, name).max())) for name in _DEFAULT_RANGES}
    return {name: (low, max(high, low + 1.0)) for name, (low, high) in spans.items()}


def _fit_logistic(network: "keras.Model", phi: LinkFeatures, truth: States) -> None:
    """Fit a logistic classifier by cross-entropy; a slight penalty keeps weights finite for separable classes."""
    keras = import_keras()
    scaled = keras.Model(network.input, network.get_layer("clamped").output)(network_inputs(phi, tuple(network.input)))
    rows = np.concatenate([np.asarray(scaled, dtype=np.float64), np.ones((len(phi), 1))], axis=1)
    classes = max(2, network.output.shape[1])
    picked = truth[:, None] == np.arange(classes)

    def loss(flat: Floats) -> tuple[float, Floats]:
        weights = flat.reshape(-1, classes)
        log_p = scipy.special.log_softmax(rows @ weights, axis=1)
        slope = rows.T @ (np.exp(log_p) - picked) + _WEIGHT_PENALTY * weights
        return -log_p[picked].sum() + 0.5 * _WEIGHT_PENALTY * (flat**2).sum(), slope.ravel()

    found = scipy.optimize.minimize(
        loss, np.zeros(rows.shape[1] * classes), jac=True, method="L-BFGS-B", options={"maxiter": 1000}
    )
    weights = found.x.reshape(-1, classes)
    if network.output.shape[1] == 1:
        weights = weights[:, 1:] - weights[:, :1]
    network.get_layer("probability").set_weights([weights[:-1], weights[-1]])
    _log.info("%s: cross-entropy %.4f over %d links", network.name, found.fun / len(phi), len(phi))


def _gaussian_loss(gain_db: Any, prediction: Any) -> Any:
    ops = import_keras().ops
    mean, log_variance = prediction[:, :1], prediction[:, 1:]
    return 0.5 * (log_variance + ops.square(gain_db - mean) * ops.exp(-log_variance))


def _train(network: "keras.Model", phi: LinkFeatures, gain_db: Floats, settings: PredictorSettings) -> None:
    keras = import_keras()
    trainer = keras.Model(network.input, network.output)
    decay = keras.optimizers.schedules.CosineDecay(settings.learning_rate, settings.steps)
    trainer.compile(optimizer=keras.optimizers.Adam(decay), loss=_gaussian_loss, jit_compile=False)
    inputs = network_inputs(phi, tuple(network.input))
    seed = (settings.seed, [row.name for row in GAIN_NETWORKS].index(network.name))
    batches = _batches(inputs, gain_db.astype(np.float32)[:, None], settings.batch_size, np.random.default_rng(seed))
    history = trainer.fit(batches, steps_per_epoch=settings.steps, shuffle=False, verbose=0)
    _log.info("%s: loss %.4f over %d links", network.name, history.history["loss"][-1], len(phi))
    if not all(np.isfinite(weights).all() for weights in network.get_weights()):
        raise PredictorError(
            f"training of {network.name} diverged: learning_rate = {settings.learning_rate:g}, give a smaller one."
        )


def _batches(
    inputs: dict[str, NDArray[np.float32]], gain_db: NDArray[np.float32], size: int, rng: np.random.Generator
) -> Iterator[tuple[dict[str, NDArray[np.float32]], NDArray[np.float32]]]:
    for start in itertools.cycle(range(0, len(gain_db), size)):
        if start == 0:
            order = rng.permutation(len(gain_db))
        index = order[start : start + size]
        yield {name: column[index] for name, column in inputs.items()}, gain_db[index]
