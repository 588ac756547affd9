"""Training of the predictor's networks by maximum likelihood."""

import itertools
import logging
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_softmax

from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.paper_networks import (
    GAIN_NETWORKS,
    INDOOR_INPUTS,
    INDOOR_NETWORKS,
    STATE_INPUTS,
    STATE_NETWORKS,
    GainNetwork,
    Ranges,
    assemble,
    gain_network,
    import_keras,
    logistic,
    network_inputs,
    parts,
)
from sionna_partial.settings import PredictorSettings

if TYPE_CHECKING:
    import keras

_DEFAULT_RANGES = {"distance_m": (0.0, 30.0), "unobserved_distance_m": (0.0, 30.0), "gain_db": (GAIN_FLOOR_DB, -40.0)}
_PRIOR_LINKS = 10
_WEIGHT_PENALTY = 0.01
_INDOORS = 20.0

_log = logging.getLogger(__name__)


def fit_networks(
    phi: LinkFeatures, link_state: NDArray[np.uint8], gain_db: NDArray[np.float64], settings: PredictorSettings
) -> "keras.Model":
    """Fit the classifiers and the gain networks; every receiver is taken to be indoors.

    Parameters
    ----------
    phi : LinkFeatures
        Of N links.
    link_state : (N,) uint8 array of LinkState
        True link state.
    gain_db : (N,) float64 array
        True omnidirectional path gain [dB].
    settings : PredictorSettings

    Returns
    -------
    keras.Model

    Raises
    ------
    PredictorError
        If the training diverges.
    """
    networks = {}
    for partial_state, name in STATE_NETWORKS.items():
        cell = phi.link_state == partial_state
        networks[name] = _fit_states(name, phi.take(cell), link_state[cell], settings)
    for row in GAIN_NETWORKS:
        cell = (link_state == row.link_state) & np.isin(phi.link_state, row.partial_states)
        networks[row.name] = _fit_gain(row, phi.take(cell), gain_db[cell], settings)
    for name in INDOOR_NETWORKS.values():
        networks[name] = logistic(name, INDOOR_INPUTS, _DEFAULT_RANGES, [_INDOORS])
    return assemble(networks)


def fit_indoor_networks(
    model: "keras.Model", phi: LinkFeatures, inside: NDArray[np.bool_], settings: PredictorSettings
) -> "keras.Model":
    """Return the networks of `model` with P(indoor) fitted to N links, `inside` (N,) saying which are indoors.

    A partial link state with fewer links than `minimum_links` keeps what `model` has.
    """
    networks = parts(model)
    for partial_state, name in INDOOR_NETWORKS.items():
        cell = phi.link_state == partial_state
        if cell.sum() >= settings.minimum_links:
            links = phi.take(cell)
            networks[name] = logistic(name, INDOOR_INPUTS, _ranges(links, settings), [0.0])
            _fit_logistic(networks[name], links, inside[cell].astype(np.uint8))
    return assemble(networks)


def _fit_states(
    name: str, phi: LinkFeatures, link_state: NDArray[np.uint8], settings: PredictorSettings
) -> "keras.Model":
    counts = np.bincount(link_state, minlength=len(LinkState)) + 1.0
    network = logistic(name, STATE_INPUTS, _ranges(phi, settings), np.log(counts / counts.sum()))
    if len(phi) >= settings.minimum_links:
        _fit_logistic(network, phi, link_state)
    return network


def _fit_gain(
    row: GainNetwork, phi: LinkFeatures, gain_db: NDArray[np.float64], settings: PredictorSettings
) -> "keras.Model":
    offsets_db = gain_db - row.anchor_db(phi, settings.frequency_hz)
    count = len(phi) + _PRIOR_LINKS
    mean_db = (offsets_db.sum() + _PRIOR_LINKS * row.prior_offset_db) / count
    prior = row.prior_std_db**2 + (row.prior_offset_db - mean_db) ** 2
    variance = (((offsets_db - mean_db) ** 2).sum() + _PRIOR_LINKS * prior) / count
    seed = settings.seed + 10 * GAIN_NETWORKS.index(row)
    network = gain_network(
        row, _ranges(phi, settings), float(mean_db), math.sqrt(variance), settings.frequency_hz, seed
    )
    if len(phi) >= settings.minimum_links:
        _train(network, phi, gain_db, settings)
    return network


def _ranges(phi: LinkFeatures, settings: PredictorSettings) -> Ranges:
    """Range of every feature of the links; a wide one if they are too few to tell."""
    if len(phi) < settings.minimum_links:
        return _DEFAULT_RANGES
    spans = {name: (float(getattr(phi, name).min()), float(getattr(phi, name).max())) for name in _DEFAULT_RANGES}
    return {name: (low, max(high, low + 1.0)) for name, (low, high) in spans.items()}


def _fit_logistic(network: "keras.Model", phi: LinkFeatures, truth: NDArray[np.uint8]) -> None:
    """Set the weights of a logistic classifier to those of the smallest cross-entropy, a convex problem.

    A slight penalty keeps weights finite where a straight line parts the classes.
    """
    keras = import_keras()
    scaled = keras.Model(network.input, network.get_layer("clamped").output)(network_inputs(phi, tuple(network.input)))
    rows = np.concatenate([np.asarray(scaled, dtype=np.float64), np.ones((len(phi), 1))], axis=1)
    classes = max(2, network.output.shape[1])
    picked = truth[:, None] == np.arange(classes)

    def loss(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        weights = flat.reshape(-1, classes)
        log_p = log_softmax(rows @ weights, axis=1)
        slope = rows.T @ (np.exp(log_p) - picked) + _WEIGHT_PENALTY * weights
        return -log_p[picked].sum() + 0.5 * _WEIGHT_PENALTY * (flat**2).sum(), slope.ravel()

    found = minimize(loss, np.zeros(rows.shape[1] * classes), jac=True, method="L-BFGS-B", options={"maxiter": 1000})
    weights = found.x.reshape(-1, classes)
    if network.output.shape[1] == 1:
        weights = weights[:, 1:] - weights[:, :1]
    network.get_layer("probability").set_weights([weights[:-1], weights[-1]])
    _log.info("%s: cross-entropy %.4f over %d links", network.name, found.fun / len(phi), len(phi))


def _gaussian_loss(gain_db: Any, prediction: Any) -> Any:
    """Negative log-likelihood of gains (N, 1) under means and log-variances (N, 2), up to a constant."""
    ops = import_keras().ops
    mean, log_variance = prediction[:, :1], prediction[:, 1:]
    return 0.5 * (log_variance + ops.square(gain_db - mean) * ops.exp(-log_variance))


def _train(
    network: "keras.Model", phi: LinkFeatures, gain_db: NDArray[np.float64], settings: PredictorSettings
) -> None:
    """Minimise the loss of a gain network in place; the same links and settings give the same weights."""
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
    """Yield shuffled batches without end."""
    for start in itertools.cycle(range(0, len(gain_db), size)):
        if start == 0:
            order = rng.permutation(len(gain_db))
        index = order[start : start + size]
        yield {name: column[index] for name, column in inputs.items()}, gain_db[index]
