"""Links of a known model, and predictors trained on them, for the tests."""

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from sionna_partial.constants import CellState, LinkState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction import map_training
from sionna_partial.prediction.features import ATTENUATION_LENGTHS_M, LinkContext, LinkFeatures
from sionna_partial.prediction.paper_networks import free_space_gain_db, import_keras, tf
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import PredictorSettings

QUIET = pytest.mark.filterwarnings("ignore:__array__ implementation doesn't accept a copy:DeprecationWarning:keras")
"""Keras converts TensorFlow arrays in a way that NumPy deprecates."""

FREQUENCY_HZ = 28e9
QUICK = PredictorSettings(steps=15, minimum_links=50)
OUTAGE, LOS, NLOS = LinkState.OUTAGE, LinkState.LOS, LinkState.NLOS


def make_links(count, seed=0):
    """Return features, and truth from a known model: links are as in the partial trace where all was seen."""
    rng = np.random.default_rng(seed)
    distance_m = rng.uniform(0.5, 15.0, count)
    unobserved_m = distance_m * rng.uniform(0.0, 1.0, count)
    partial_state = rng.integers(0, 3, count)
    free_db = free_space_gain_db(distance_m, FREQUENCY_HZ)
    partial_db = np.select([partial_state == OUTAGE, partial_state == LOS], [-150.0, free_db + 1.0], free_db - 20.0)
    phi = LinkFeatures(partial_state, unobserved_m, distance_m, partial_db)
    kept = rng.uniform(size=count) < p_kept(phi)
    state = np.where(kept, partial_state, np.where(partial_state == OUTAGE, NLOS, OUTAGE))
    mean_db, std_db = true_gain(phi, state)
    gain_db = np.where(state == OUTAGE, -150.0, mean_db + std_db * rng.normal(size=count))
    return phi, state, gain_db


@functools.cache
def corridors():
    """Return maps of a corridor along x: nothing seen, the end of the receivers, that of the transmitter at 0, both."""
    maps = []
    for tx_seen, rx_seen in itertools.product((False, True), repeat=2):
        state = np.full((2, 32), CellState.UNKNOWN)
        state[0, :1], state[0, 1:] = (CellState.FREE if seen else CellState.UNKNOWN for seen in (tx_seen, rx_seen))
        maps.append(PartialMap(state, 0.5, (-0.25, -0.25)))
    return tuple(maps)


def corridor_of(phi):
    """Return the corridor of each link; transmitters are seen up to 10 m, receivers where less than 2 m are unknown."""
    return 2 * (phi.distance_m < 10.0) + (phi.unobserved_distance_m < 2.0)


def walls_of_links(count, loss_db=60.0):
    return {
        "straight_gain_db": np.full(count, -150.0),
        "straight_walls": np.zeros(count),
        "wall_loss_db": np.full(count, loss_db),
    }


def make_context(phi):
    count = len(phi)
    tx_m = np.tile([0.0, 0.0, 1.5], (count, 1))
    linked, crossed_m = phi.link_state != OUTAGE, phi.unobserved_distance_m
    kept = np.stack([np.exp(-crossed_m / length) if length else crossed_m < 1e-3 for length in ATTENUATION_LENGTHS_M]).T
    power = 10.0 ** ((phi.gain_db - 6.0 * (phi.link_state == LOS)) / 10.0) * linked
    return LinkContext.on_maps(
        corridors(),
        corridor_of(phi),
        tx_m=tx_m,
        rx_m=tx_m + np.column_stack([phi.distance_m, np.zeros((count, 2))]),
        indirect_gain_db=10.0 * np.log10(np.maximum(power[:, None] * kept, 1e-15)),
        strongest_unobserved_m=np.where(linked, crossed_m, phi.distance_m),
        **walls_of_links(count),
        link_state=phi.link_state,
        unobserved_distance_m=crossed_m,
    )


def make_seen_links(count, seed=0):
    phi, state, gain_db = make_links(count, seed)
    return dataclasses.replace(phi, context=make_context(phi)), state, gain_db


def features(
    partial,
    rx_m,
    *,
    tx_m=(0.0, 0.0, 1.5),
    unobserved_m=0.0,
    state=LOS,
    gain_db=-70.0,
    indirect_db=-150.0,
    distance_m=None,
):
    """Return features of links on one map, or several with one for each link, with a context.

    All paths but the direct one have the gains `indirect_db`.
    """
    rx_m = np.atleast_2d(np.asarray(rx_m, dtype=np.float64))
    count = len(rx_m)
    maps, map_index = partial if isinstance(partial, tuple) else ((partial,), np.zeros(count, dtype=np.int64))
    tx_m = np.broadcast_to(np.asarray(tx_m, dtype=np.float64), (count, 3))
    unobserved_m, state = np.full(count, unobserved_m), np.full(count, state, dtype=np.uint8)
    context = LinkContext.on_maps(
        maps,
        map_index,
        tx_m=tx_m,
        rx_m=rx_m,
        link_state=state,
        unobserved_distance_m=unobserved_m,
        indirect_gain_db=np.full((count, len(ATTENUATION_LENGTHS_M)), indirect_db),
        strongest_unobserved_m=unobserved_m,
        **walls_of_links(count),
    )
    distance_m = np.linalg.norm(rx_m - tx_m, axis=1) if distance_m is None else np.full(count, distance_m)
    return LinkFeatures(state, unobserved_m, distance_m, np.full(count, gain_db), context)


def p_kept(phi):
    return 1.0 / (1.0 + np.exp(0.8 * phi.unobserved_distance_m - 3.0))


def true_gain(phi, state):
    free_db = free_space_gain_db(phi.distance_m, FREQUENCY_HZ)
    mean_db = np.where(state == LOS, free_db + 1.0, free_db - 20.0 - phi.unobserved_distance_m)
    return mean_db, np.where(state == LOS, 1.0 + 0.2 * phi.unobserved_distance_m, 6.0)


def arrays(prediction):
    return {name: getattr(prediction, name) for name in prediction.COLUMNS}


def assert_valid(prediction):
    total = prediction.p_los + prediction.p_nlos + prediction.p_outage
    np.testing.assert_allclose(total, 1.0, atol=1e-12)
    for name, values in arrays(prediction).items():
        assert np.isfinite(values).all(), name
        if "_mean_" in name:
            assert (values >= -150.0).all(), name
        else:
            assert (values >= 0.0).all(), name


def assert_symmetric(predictor, phi):
    """Predict links with their ends swapped, some of which have one end seen, to the same."""
    of = phi.context
    assert (of.tx_seen != of.rx_seen).any()
    ends = {"tx_m": of.rx_m, "rx_m": of.tx_m, "tx_seen": of.rx_seen, "rx_seen": of.tx_seen}
    swapped = dataclasses.replace(phi, context=dataclasses.replace(of, **ends, exposure=of.exposure[:, ::-1]))
    one, other = (arrays(predictor.predict(each)) for each in (phi, swapped))
    for name, values in one.items():
        np.testing.assert_allclose(other[name], values, rtol=1e-5, atol=1e-5, err_msg=name)


@functools.cache
def quick_predictor():
    return Predictor.fit(*make_links(900), homes=["a", "b"], settings=QUICK)


@contextmanager
def shallow_map_networks() -> Iterator[None]:
    """Let map networks have few layers, see few maps at once, and take their few steps without a graph of TensorFlow.

    The graph, which takes longer to trace than many steps, is that of `test_map_networks` and `test_predictor_files`.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_training, "_WIDTHS", (4, 8))
        patch.setattr(map_training, "MAPS_AT_ONCE", 4)
        import_keras()
        tf.config.run_functions_eagerly(True)
        try:
            yield
        finally:
            tf.config.run_functions_eagerly(False)


def fit_context_predictor(networks, seed=0):
    """Train a predictor that sees where links run, for two steps; its networks of the paper are untrained."""
    links = make_seen_links(300)
    settings = PredictorSettings(networks, passes=2, minimum_links=1_000_000, seed=seed)
    with shallow_map_networks():
        return Predictor.fit(*links, homes=["a", "b"], settings=settings)


@functools.cache
def context_predictor(networks):
    return fit_context_predictor(networks)
