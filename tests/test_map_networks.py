"""The networks that read maps and paths: inputs, outputs, symmetry, and that rooms are learnt from maps."""

import functools
import math

import numpy as np
import pytest
from predictor_links import FREQUENCY_HZ, NLOS, OUTAGE, QUIET, features, make_seen_links
from scipy.integrate import trapezoid
from scipy.stats import norm

from sionna_partial.constants import CellState
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction import map_networks as module
from sionna_partial.prediction import map_training as training
from sionna_partial.prediction.evaluate import Network
from sionna_partial.prediction.map_networks import (
    LINE_POINTS,
    LINK_INPUTS,
    LINK_NETWORK,
    MAP_FEATURES,
    MAP_NETWORK,
    MapFeatures,
    expert_parts,
    line_points_m,
    link_outputs,
    mean_features,
    predict_by_context,
    scaled_inputs,
)
from sionna_partial.prediction.map_training import context_networks, fit_context_networks, symmetric
from sionna_partial.prediction.paper_networks import STD_RANGE_DB, import_keras
from sionna_partial.prediction.space import MapSpace
from sionna_partial.settings import PredictorSettings

pytestmark = QUIET

FREE, WALL, UNKNOWN = CellState.FREE, CellState.WALL, CellState.UNKNOWN


def inputs(phi):
    return dict(zip(LINK_INPUTS, scaled_inputs(phi, FREQUENCY_HZ).T, strict=True))


@pytest.fixture(scope="module")
def networks():
    """Return networks with random weights everywhere, biases included, so that their outputs are about 1."""
    rng = np.random.default_rng(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "_WIDTHS", (4, 8))
        found = context_networks(0)
    for weight in (weight for network in found.values() for weight in network.weights):
        shape = tuple(weight.shape)
        spread = 1.4 / math.sqrt(math.prod(shape[:-1])) if len(shape) > 1 else 0.3
        value = rng.normal(0.0, spread, shape)
        value = np.exp(value) if weight.path.endswith(("gamma", "variance")) else value
        weight.assign(np.asarray(symmetric(value)) if len(shape) == 4 else value)
    return {name: Network.from_keras(network) for name, network in found.items()}


@pytest.fixture(scope="module")
def home():
    state = np.random.default_rng(1).choice([FREE, WALL, UNKNOWN], size=(18, 14), p=[0.5, 0.1, 0.4])
    return PartialMap(state, 1.0, (-8.0, -8.0))


def test_length_in_walls():
    thin, thick = (PartialMap(np.array([[FREE] * 2 + [WALL] * cells + [FREE] * 2] * 4), 0.25) for cells in (1, 8))
    tx_m, rx_m = np.array([0.1, 0.1, 1.5]), np.array([1.1, 0.9, 1.5])
    slant = math.hypot(1.0, 0.8)
    maps = ((thin, thick), np.array([0, 0, 1, 1]))
    found = inputs(features(maps, [rx_m, (0.4, 0.9, 1.5), rx_m, (2.9, 0.9, 1.5)], tx_m=tx_m))
    np.testing.assert_allclose(found["walled"], [0.25 * slant, 0.0, 0.6 * slant, 1.0], rtol=1e-6)


def test_single_precision_whatever_the_policy():
    keras = import_keras()
    keras.config.set_dtype_policy("float64")
    try:
        found = context_networks(0)
    finally:
        keras.config.set_dtype_policy("float32")
    assert {str(weight.dtype) for network in found.values() for weight in network.weights} == {"float32"}


def test_outputs_decoded_by_hand():
    """Logits by LinkState; LOS up to 10 dB over free space, NLOS 25 dB below it, in steps of 20 dB."""
    offset = module._LOS_OFFSET
    outputs = np.array(
        [
            [0.0, 0.0, 0.0, -1e3, 0.0, 0.0, 0.0],
            [math.log(2.0), math.log(6.0), 0.0, -offset, -0.5, 40.0, -40.0],
            [5.0, 0.0, 0.0, 0.0, -9.0, 0.0, 0.0],
        ]
    )
    possible = np.array([[True] * 3, [True] * 3, [False, True, True]])
    probabilities, means_db, stds_db = expert_parts(outputs, np.array([-70.0, -80.0, -60.0]), possible)
    np.testing.assert_allclose(probabilities.T, [[1 / 3] * 3, [2 / 9, 6 / 9, 1 / 9], [0.0, 0.5, 0.5]])
    np.testing.assert_allclose(means_db[0], -150.0)
    np.testing.assert_allclose(means_db[1:, :2].T, [[-70.0, -95.0], [-75.0, -115.0]])
    assert means_db[NLOS, 2] == -150.0
    middle = math.sqrt(STD_RANGE_DB[0] * STD_RANGE_DB[1])
    np.testing.assert_allclose(stds_db.T[:2], [[0.0, middle, middle], [0.0, *STD_RANGE_DB[::-1]]], rtol=1e-6)


def test_points_of_links_and_what_is_read_there():
    tx_m, rx_m = np.array([[1.0, 2.0, 1.5]]), np.array([[4.0, -2.0, 1.0]])
    points = line_points_m(tx_m, rx_m)
    assert points.shape == (1, 2 + LINE_POINTS, 2)
    assert points[0, :2].tolist() == [[1.0, 2.0], [4.0, -2.0]]
    np.testing.assert_allclose(points[0, 2:].mean(axis=0), [2.5, 0.0])
    back = line_points_m(rx_m, tx_m)
    np.testing.assert_allclose(back[0, 2:][::-1], points[0, 2:], atol=1e-12)
    of_points, mean = np.random.default_rng(2).normal(size=(1, 2 + LINE_POINTS, 3)), np.array([[4.0, 5.0, 6.0]])
    found = link_outputs({LINK_NETWORK: lambda x: x}, np.array([[7.0]]), (of_points, mean))
    ends, line = of_points[0, :2], of_points[0, 2:]
    np.testing.assert_allclose(found[0], [7.0, *ends.sum(axis=0), *ends.prod(axis=0), *line.mean(axis=0), *mean[0]])


def test_mean_features_are_of_known_cells():
    known = np.array([[[0.0, 0.0, 1.0], [0.5, 0.5, 0.0]], [[1.0, 0.0, 0.0], [0.0, 0.5, 0.5]]])[None]
    features = np.array([[[9.0], [1.0]], [[2.0], [3.0]]])[None]
    np.testing.assert_allclose(mean_features(features, known), [[(1.0 + 2.0 + 0.5 * 3.0) / 2.5]])
    assert mean_features(features, 0.0 * known) == 0.0


class TestMapNetwork:
    def test_kernels_of_new_networks_are_symmetric(self):
        (kernel,) = (
            each for each in context_networks(1)[MAP_NETWORK].weights if "down_0" in each.path and "kernel" in each.path
        )
        value = np.asarray(kernel.value)
        for turned in (value[::-1], value[:, ::-1], value.transpose(1, 0, 2, 3)):
            np.testing.assert_allclose(turned, value, atol=1e-7)
        assert np.ptp(value) > 0.1

    def test_features_turn_with_the_map(self, networks, home):
        features_of = MapFeatures(networks)
        found, mean = features_of(MapSpace(home))
        assert found.shape[-1] == MAP_FEATURES
        for turned, back in (
            (np.rot90(home.state), lambda x: np.rot90(x, -1)),
            (home.state[:, ::-1], lambda x: x[:, ::-1]),
            (home.state.T, lambda x: x.transpose(1, 0, 2)),
        ):
            other, other_mean = features_of(MapSpace(PartialMap(np.ascontiguousarray(turned), 1.0, (3.7, 0.2))))
            np.testing.assert_allclose(other_mean, mean, rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(back(other), found, rtol=1e-4, atol=1e-4)
        assert np.ptp(found, axis=(0, 1)).min() > 0.1

    def test_maps_are_read_once(self, networks, home):
        calls, read = [], networks[MAP_NETWORK]
        features_of = MapFeatures({MAP_NETWORK: lambda image: calls.append(image) or read(image)})
        one, other = MapSpace(home), MapSpace(PartialMap(home.state[:9], 1.0))
        found = [features_of(space) for space in (one, other, one, MapSpace(home))]
        assert found[0] is found[2] is found[3]
        assert len(calls) == 2


class TestPredictByContext:
    def test_links_of_several_maps_keep_their_order(self, networks, home):
        rng, nothing = np.random.default_rng(9), PartialMap(np.full((40, 40), UNKNOWN), 0.5, (-9.0, -9.0))
        rx_m, tx_m = rng.uniform(-7.5, 7.5, (40, 3)), rng.uniform(-3, 3, (40, 3))
        phi = features(((home, nothing), rng.integers(0, 2, 40)), rx_m, tx_m=tx_m, unobserved_m=0.2)
        together = predict_by_context(networks, phi, FREQUENCY_HZ, MapFeatures(networks))
        for number in range(0, 40, 7):
            one_link = phi.take(slice(number, number + 1))
            alone = predict_by_context(networks, one_link, FREQUENCY_HZ, MapFeatures(networks))
            for one, all_of_them in zip(alone, together, strict=True):
                np.testing.assert_allclose(one[:, 0], all_of_them[:, number], rtol=1e-4, atol=1e-4)

    def test_more_links_of_one_map_than_are_read_at_once(self, networks, home, monkeypatch):
        phi = features(home, np.random.default_rng(10).uniform(-7.5, 7.5, (50, 3)))
        at_once = predict_by_context(networks, phi, FREQUENCY_HZ, MapFeatures(networks))
        monkeypatch.setattr(module, "_LINKS_AT_ONCE", 7)
        for one, other in zip(
            at_once, predict_by_context(networks, phi, FREQUENCY_HZ, MapFeatures(networks)), strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


ROOMS, ROOM_CELLS, RESOLUTION_M = 4, 8, 0.5
HALF_M = ROOMS * ROOM_CELLS * RESOLUTION_M / 2
GAIN_DB = -90.0


@functools.cache
def make_room_links(maps, links, seed):
    """Return features, true states and gains of links that differ only in the rooms of their receivers.

    Half of the rooms of each map are seen: links there are NLOS, the others in outage. Transmitter and receivers stand
    in cells that are not seen.
    """
    rng, count = np.random.default_rng(seed), maps * links
    partial, in_seen_room, rx_m = [], [], []
    for _ in range(maps):
        seen = np.kron(rng.permutation(ROOMS**2).reshape(ROOMS, ROOMS) % 2, np.ones((ROOM_CELLS, ROOM_CELLS))) > 0
        position = rng.permutation(seen.size)[:links]
        state = np.where(seen, FREE, UNKNOWN)
        state.ravel()[position] = state[len(seen) // 2, len(seen) // 2] = UNKNOWN
        partial.append(PartialMap(state, RESOLUTION_M, (-HALF_M, -HALF_M)))
        in_seen_room.append(seen.ravel()[position])
        cells = np.column_stack(np.divmod(position, len(seen)))[:, ::-1] + rng.uniform(size=(links, 2))
        rx_m.append(np.column_stack([RESOLUTION_M * cells - HALF_M, np.full(links, 1.5)]))
    where, tx_m = (tuple(partial), np.repeat(np.arange(maps), links)), (0.01, 0.01, 1.5)
    known = {"unobserved_m": 3.0, "distance_m": 5.0, "state": NLOS, "gain_db": -90.0, "indirect_db": -90.0}
    phi = features(where, np.concatenate(rx_m), tx_m=tx_m, **known)
    order = rng.permutation(count)
    linked = np.concatenate(in_seen_room)[order]
    gain_db = np.where(linked, rng.normal(GAIN_DB, 3.0, count), -150.0)
    return phi.take(order), np.where(linked, NLOS, OUTAGE).astype(np.uint8), gain_db


TRAINING, OTHERS = (24, 60, 1), (6, 100, 2)


def test_the_rooms_of_receivers_are_learnt_from_maps(monkeypatch):
    others, state, _ = make_room_links(*OTHERS)
    monkeypatch.setattr(training, "LEARNING_RATE", 0.01)
    monkeypatch.setattr(training, "_WIDTHS", (8, 16))
    found = fit_context_networks(*make_room_links(*TRAINING), PredictorSettings("map", passes=11))
    networks = {name: Network.from_keras(network) for name, network in found.items()}
    probabilities, means_db, _ = predict_by_context(networks, others, FREQUENCY_HZ, MapFeatures(networks))
    assert (probabilities.argmax(axis=0) == state).mean() > 0.9
    assert means_db[NLOS][state == NLOS].mean() == pytest.approx(GAIN_DB, abs=4.0)
    for kernel in (each for each in found[MAP_NETWORK].weights if len(each.shape) == 4):
        np.testing.assert_allclose(np.asarray(symmetric(kernel.value)), np.asarray(kernel.value), atol=1e-6)


def test_diverging_training():
    phi, state, gain_db = make_seen_links(200)
    with pytest.raises(PredictorError, match=r"training diverged in step 0: give another seed\."):
        fit_context_networks(phi, state, gain_db + np.inf, PredictorSettings("paths", passes=1))


def test_crps_is_the_integral_of_the_squared_difference_of_distributions():
    gain_db = np.linspace(-60.0, 60.0, 120_001)
    errors_db, stds_db = np.array([0.0, 2.5, -7.0, 20.0]), np.array([1.0, 4.0, 3.0, 0.5])
    below = norm.cdf(gain_db / stds_db[:, None])
    expected = trapezoid((below - (gain_db >= errors_db[:, None])) ** 2, gain_db)
    np.testing.assert_allclose(training._crps(errors_db, stds_db), expected, atol=2e-3)


def test_examples_are_passes_of_all_maps_with_points_in_their_images():
    """Maps of other sizes lie in larger images; map features are read where `MapSpace.read` reads them."""
    partial = [PartialMap(np.random.default_rng(n).integers(0, 3, (6 + 20 * n, 8)), 0.5) for n in range(3)]
    index = np.repeat(np.arange(3), 20)
    rx_m = np.random.default_rng(5).uniform(0.0, 4.0, (60, 3))
    phi = features((tuple(partial), index), rx_m, tx_m=(1.0, 2.0, 1.5))
    numbers = -np.arange(60.0)  # as gains
    examples, seen = training._Examples(phi, np.ones(60, np.uint8), numbers, PredictorSettings("map")), []
    assert len(examples) == 3
    for columns, images, image, cells, weights in examples.batches(4, np.random.default_rng(4)):
        drawn = -columns["true_gain_db"].astype(int)
        seen.append(sorted(drawn.tolist()))
        np.testing.assert_array_equal(columns["inputs"], scaled_inputs(phi, FREQUENCY_HZ)[drawn])
        flat = images.reshape(-1, images.shape[-1])
        found = (flat[cells] * weights[..., None]).sum(axis=2)
        for number in drawn:
            space, points = phi.context.spaces[index[number]], line_points_m(phi.context.tx_m[[number]], rx_m[[number]])
            np.testing.assert_allclose(found[drawn == number], space.read(space.image, points), atol=1e-5)
            ny, nx, _ = space.image.shape
            np.testing.assert_array_equal(images[image[drawn == number]][:, :ny, :nx], space.image[None])
    whole = [links for links in seen if len(links) == 60]
    assert whole
    assert {number for links in seen for number in links} == set(range(60))
