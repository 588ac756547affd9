"""The networks that read maps and paths: inputs, outputs, and that an empty map contributes nothing."""

import functools
import math

import numpy as np
import pytest
from predictor_links import FREQUENCY_HZ, NLOS, OUTAGE, QUIET, features, make_seen_links
from scipy.integrate import trapezoid
from scipy.stats import norm

from sionna_partial.constants import CellState, LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction import map_networks as module
from sionna_partial.prediction.map_networks import (
    LINK_INPUTS,
    LINK_NETWORK,
    LINK_OUTPUTS,
    MAP_FEATURES,
    MAP_NETWORKS,
    MapReader,
    context_networks,
    decode,
    evaluate_context_networks,
    fit_context_networks,
    read_links,
    read_maps,
    receiver_offsets_m,
    scaled_inputs,
)
from sionna_partial.prediction.paper_networks import STD_RANGE_DB, free_space_gain_db, import_keras
from sionna_partial.prediction.unobserved import CELLS_M, WINDOW_CELLS, WINDOWS
from sionna_partial.settings import PredictorSettings

pytestmark = QUIET

FREE, WALL, UNKNOWN = CellState.FREE, CellState.WALL, CellState.UNKNOWN


def inputs(phi):
    return dict(zip(LINK_INPUTS, scaled_inputs(phi, FREQUENCY_HZ).T, strict=True))


def shaken(networks, seed=0):
    """Give networks random weights everywhere, biases included, so that their outputs are about 1, and return them."""
    rng = np.random.default_rng(seed)
    for weight in (weight for network in networks.values() for weight in network.weights):
        shape = tuple(weight.shape)
        spread = 1.4 / math.sqrt(math.prod(shape[:-1])) if len(shape) > 1 else 0.3
        value = rng.normal(0.0, spread, shape)
        weight.assign(np.exp(value) if weight.path.endswith(("gamma", "variance")) else value)
    return networks


@pytest.fixture(scope="module")
def networks():
    return shaken(context_networks(0))


@pytest.fixture(scope="module")
def home():
    state = np.random.default_rng(1).choice([FREE, WALL, UNKNOWN], size=(16, 16), p=[0.5, 0.1, 0.4])
    return PartialMap(state, 1.0, (-8.0, -8.0))


@pytest.fixture(scope="module")
def nothing():
    return PartialMap(np.full((200, 200), UNKNOWN), 0.5, (-50.0, -50.0))


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


class TestReadMapsAndLinks:
    """With a map network that returns the position of a cell, and a link network that returns its inputs of the map."""

    @staticmethod
    def of_maps(links):
        read = np.reshape(links[:, len(LINK_INPUTS) :], (-1, len(CELLS_M), MAP_FEATURES))
        return np.concatenate([read[:, :, :3].reshape(len(read), -1), read[:, 0, 3:4]], axis=1)

    @staticmethod
    def values(windows):
        """Return x, y of the cells and a window's first channel, or 0 in an empty window, and 100 in both."""
        count = windows.shape[0]
        known = (windows > 0).any(axis=(1, 2, 3), keepdims=True).astype(np.float32)
        y, x = np.mgrid[:WINDOW_CELLS, :WINDOW_CELLS].astype(np.float32)
        positions = np.tile(np.stack([x, y], axis=-1), (count, 1, 1, 1)) * known
        rest = np.full((count, WINDOW_CELLS, WINDOW_CELLS, MAP_FEATURES - 3), 100.0, dtype=np.float32)
        return np.concatenate([positions, windows[..., :1], rest], axis=-1)

    def seen(self, windows, offsets_m):
        offsets_m = np.asarray(offsets_m, dtype=np.float32)
        links = np.zeros((*offsets_m.shape[:2], len(LINK_INPUTS)), dtype=np.float32)
        networks = {**dict.fromkeys(MAP_NETWORKS, self.values), LINK_NETWORK: self.of_maps}
        found = np.asarray(read_links(networks, read_maps(networks, windows.astype(np.float32)), links, offsets_m))
        assert not found[..., -1].any()  # what an empty window gives is subtracted
        return found[..., :-1].reshape(*offsets_m.shape[:2], len(CELLS_M), 3)

    @pytest.fixture
    def windows(self):
        return np.random.default_rng(3).integers(1, 256, (2, *WINDOWS))

    @pytest.mark.parametrize(("scale", "cell_m"), [*enumerate(CELLS_M)])
    def test_exact_at_the_middles_of_cells(self, windows, scale, cell_m):
        rows, columns = np.random.default_rng(4).integers(8, WINDOW_CELLS - 8, (2, 2, 300))
        found = self.seen(windows, (np.stack([columns, rows], axis=-1) + 0.5 - WINDOW_CELLS / 2) * cell_m)
        for number in range(2):
            row, column = rows[number], columns[number]
            expected = np.stack([column, row, windows[number, scale, row, column, 0]], axis=-1)
            np.testing.assert_allclose(found[number, :, scale], expected, rtol=1e-4, atol=5e-3)

    def test_fades_towards_the_border_of_each_window(self, windows):
        """Half of it is left 4 cells from the border, nothing from there on; without a step anywhere."""
        windows[..., 0] = 200
        for scale, cell_m in enumerate(CELLS_M):
            half_m = WINDOW_CELLS / 2 * cell_m
            x_m = half_m - cell_m * np.array([40.0, 8.0, 4.0, 0.0, -1.0, -100.0])
            found = self.seen(windows[:1], np.column_stack([x_m, np.zeros(6)])[None])
            np.testing.assert_allclose(found[0, :, scale, 2], [200, 200, 100, 0, 0, 0], atol=1e-2)
        x_m = np.linspace(0.0, 60.0, 20_001)
        found = self.seen(windows[:1], np.column_stack([x_m, 0.7 * x_m])[None])
        assert abs(np.diff(found[0, :, :, 2], axis=0)).max() < 1.0


def test_outputs_decoded_by_hand():
    """Logits by LinkState; LOS up to 10 dB over free space, NLOS 25 dB below it, in steps of 20 dB."""
    outputs = [[0.0, 0.0, 0.0, -1e3, 0.0, 0.0, 0.0], [math.log(2.0), math.log(6.0), 0.0, 1.5, -0.5, 40.0, -40.0]]
    log_p, means_db, log_variances = decode(np.array(outputs), np.array([-70.0, -80.0]))
    np.testing.assert_allclose(np.exp(log_p), [[1 / 3] * 3, [2 / 9, 6 / 9, 1 / 9]])
    np.testing.assert_allclose(means_db, [[-70.0, -95.0], [-75.0, -115.0]])
    middle = math.sqrt(STD_RANGE_DB[0] * STD_RANGE_DB[1])
    np.testing.assert_allclose(np.exp(0.5 * log_variances), [[middle] * 2, STD_RANGE_DB[::-1]])


class TestEvaluateContextNetworks:
    def test_on_an_empty_map_the_distance_is_all(self, networks, nothing):
        """Whatever the direction, wherever the transmitter is, and whatever is known beyond its window."""
        state = nothing.state.copy()
        state[:, :3] = FREE
        angles = np.linspace(0.0, 2.0 * math.pi, 9)[:-1]
        circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(8)])
        answers = {}
        for distance_m in (2.3, 9.1):
            for partial, tx_m in (
                (nothing, (0.0, 0.0, 1.5)),
                (nothing, (3.17, -4.4, 1.5)),
                (PartialMap(state, 0.5, nothing.origin_m), (3.17, -4.4, 1.5)),
            ):
                phi = features(partial, tx_m + distance_m * circle, tx_m=tx_m, unobserved_m=0.9 * distance_m)
                found = np.stack(evaluate_context_networks(networks, phi, FREQUENCY_HZ))
                one = answers.setdefault(distance_m, found[..., :1])
                np.testing.assert_allclose(found, np.repeat(one, 8, axis=-1), rtol=1e-5, atol=1e-5)
        near, far = answers.values()
        assert abs(near - far)[0].max() > 0.01

    def test_links_of_several_windows_keep_their_order(self, networks, home, nothing):
        rng = np.random.default_rng(9)
        rx_m = rng.uniform(-7.5, 7.5, (40, 3))
        tx_m, map_index = rng.integers(-3, 3, (40, 3)) + 0.4, rng.integers(0, 2, 40)
        phi = features(((home, nothing), map_index), rx_m, tx_m=tx_m)
        assert len(phi.context.windows) > 20
        together = evaluate_context_networks(networks, phi, FREQUENCY_HZ)
        for number in range(0, 40, 7):
            alone = evaluate_context_networks(networks, phi.take(slice(number, number + 1)), FREQUENCY_HZ)
            for one, all_of_them in zip(alone, together, strict=True):
                np.testing.assert_allclose(one[:, 0], all_of_them[:, number], rtol=1e-5, atol=1e-5)

    def test_many_links_of_one_window(self, networks, home):
        phi = features(home, np.random.default_rng(10).uniform(-7.5, 7.5, (50, 3)))
        at_once = evaluate_context_networks(networks, phi, FREQUENCY_HZ)
        many = evaluate_context_networks(networks, phi.take(np.arange(17_000) % 50), FREQUENCY_HZ)
        for one, other in zip(at_once, many, strict=True):
            np.testing.assert_allclose(one, other[:, -50:], rtol=1e-5, atol=1e-5)

    def test_windows_are_read_once(self, networks):
        windows = np.random.default_rng(11).integers(0, 256, (3, *WINDOWS)).astype(np.uint8)
        read = MapReader(networks)
        for some in (windows[:1], windows[1:], windows):
            maps = read(some)
            assert read(some) is maps
            for number, expected in enumerate(read_maps(networks, some.astype(np.float32))):
                np.testing.assert_array_equal(np.concatenate([each[number] for each in maps]), expected)

    def test_gains_stay_above_the_floor(self, home):
        def low(links):
            return np.full((len(links), LINK_OUTPUTS), -50.0, dtype=np.float32)

        phi = features(home, (1.0, 2.0, 1.5), unobserved_m=1.0)
        probabilities, means_db, stds_db = evaluate_context_networks({LINK_NETWORK: low}, phi, FREQUENCY_HZ)
        assert (means_db[[LinkState.OUTAGE, LinkState.NLOS]] == -150.0).all()
        np.testing.assert_allclose(means_db[LinkState.LOS], free_space_gain_db(phi.distance_m, FREQUENCY_HZ))
        np.testing.assert_allclose(probabilities, 1 / 3)
        np.testing.assert_allclose(stds_db[1:], STD_RANGE_DB[0])


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
    for name, value in {"LEARNING_RATE": 0.01, "WINDOWS_AT_ONCE": 8, "_WIDTHS": ((8, 16), (8, 16))}.items():
        monkeypatch.setattr(module, name, value)
    networks = fit_context_networks(*make_room_links(*TRAINING), PredictorSettings("map", passes=14))
    probabilities, means_db, _ = evaluate_context_networks(networks, others, FREQUENCY_HZ)
    assert (probabilities.argmax(axis=0) == state).mean() > 0.9
    assert -np.log(probabilities[state, np.arange(len(state))]).mean() < 0.5 * math.log(2.0)
    assert means_db[NLOS][state == NLOS].mean() == pytest.approx(GAIN_DB, abs=4.0)


def test_diverging_training():
    phi, state, gain_db = make_seen_links(200)
    with pytest.raises(PredictorError, match=r"training diverged in step 0: give another seed\."):
        fit_context_networks(phi, state, gain_db + np.inf, PredictorSettings("paths", passes=1))


def test_crps_is_the_integral_of_the_squared_difference_of_distributions():
    gain_db = np.linspace(-60.0, 60.0, 120_001)
    errors_db, stds_db = np.array([0.0, 2.5, -7.0, 20.0]), np.array([1.0, 4.0, 3.0, 0.5])
    below = norm.cdf(gain_db / stds_db[:, None])
    expected = trapezoid((below - (gain_db >= errors_db[:, None])) ** 2, gain_db)
    np.testing.assert_allclose(module._crps(errors_db, stds_db), expected, atol=2e-3)


def test_examples_are_passes_of_all_windows_turned_with_their_links():
    """The cell of a receiver has the same values after one of the eight turns, which are all taken."""
    phi, state, _ = make_room_links(*OTHERS)
    numbers = np.arange(len(phi), dtype=np.float64)  # as gains
    examples = module._Examples(phi, state, numbers, PredictorSettings("map"))
    inputs, half, cell_m = scaled_inputs(phi, FREQUENCY_HZ), WINDOW_CELLS / 2, 0.3
    turns, windows = set(), []
    for batch in examples.batches(4, np.random.default_rng(4)):
        for number, drawn in enumerate(batch["gain_db"].astype(int)):
            (window,) = set(phi.context.window_index[drawn])
            windows.append(window)
            offsets_m, moved_m = receiver_offsets_m(phi)[drawn], batch["offsets_m"][number]
            before, after = ((each / cell_m + half).astype(int).T[::-1] for each in (offsets_m, moved_m))
            image = batch["windows"][number, 0]
            np.testing.assert_array_equal(image[*after], phi.context.windows[window, 0][*before])
            swapped = not np.allclose(abs(moved_m), abs(offsets_m), atol=1e-4)
            turns.add((swapped, *np.sign(moved_m[0] * (offsets_m[0, ::-1] if swapped else offsets_m[0]))))
            np.testing.assert_array_equal(batch["links"][number], inputs[drawn])
            np.testing.assert_array_equal(batch["link_state"][number], state[drawn])
            free_db = free_space_gain_db(phi.distance_m[drawn], FREQUENCY_HZ)
            np.testing.assert_allclose(batch["free_db"][number], free_db, rtol=1e-6)
    assert len(turns) == 8
    count = len(examples)
    passes = [sorted(windows[start : start + count]) for start in range(0, len(windows) - count, count)]
    assert passes == [list(range(count))] * len(passes) != []
