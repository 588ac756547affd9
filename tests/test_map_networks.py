"""The networks that read maps and paths: inputs, outputs, and that an empty map contributes nothing."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from predictor_links import FREQUENCY_HZ, NLOS, QUIET, features, make_seen_links

from sionna_partial.constants import CellState, LinkState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import ATTENUATION_LENGTHS_M
from sionna_partial.prediction.map_networks import (
    CONTEXT_SHAPES,
    LINK_INPUTS,
    LINK_NETWORK,
    LINK_OUTPUTS,
    MAP_FEATURES,
    MAP_NETWORKS,
    MapReader,
    context_networks,
    decode,
    evaluate_context_networks,
    read_links,
    read_maps,
    scaled_inputs,
)
from sionna_partial.prediction.paper_networks import STD_RANGE_DB, free_space_gain_db, import_keras
from sionna_partial.prediction.unobserved import CELLS_M, WINDOW_CELLS, WINDOWS

pytestmark = QUIET

FREE, WALL, UNKNOWN = CellState.FREE, CellState.WALL, CellState.UNKNOWN


def inputs(phi):
    """Return the columns of `scaled_inputs` by name."""
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
    """A map of all three kinds of cells, 16 m wide, the origin in its middle."""
    state = np.random.default_rng(1).choice([FREE, WALL, UNKNOWN], size=(16, 16), p=[0.5, 0.1, 0.4])
    return PartialMap(state, 1.0, (-8.0, -8.0))


@pytest.fixture(scope="module")
def nothing():
    return PartialMap(np.full((200, 200), UNKNOWN), 0.5, (-50.0, -50.0))


class TestLinkInputs:
    def test_every_column_is_there_and_finite(self):
        found = scaled_inputs(make_seen_links(500)[0], FREQUENCY_HZ)
        assert found.shape == (500, len(LINK_INPUTS))
        assert found.dtype == np.float32
        assert np.isfinite(found).all()
        same = {name for name, spread in zip(LINK_INPUTS, np.ptp(found, axis=0), strict=True) if spread == 0.0}
        assert same == {"walled", *(f"{state.name.lower()}_possible" for state in LinkState)}

    @settings(max_examples=30, deadline=None)
    @given(
        st.sampled_from(LinkState), st.just(0.0) | st.floats(1e-3, 900.0), st.floats(0.0, 1.0), st.floats(-150.0, 30.0)
    )
    def test_a_few_units_whatever_the_link(self, state, distance_m, fraction, gain_db):
        """In a building of any size."""
        floor = PartialMap(np.zeros((1, 100), dtype=np.uint8), 10.0, (-5.0, -5.0))
        position = (distance_m, 0.0, 1.5)
        phi = features(floor, position, unobserved_m=fraction * distance_m, state=state, gain_db=gain_db)
        found = inputs(phi)
        assert all(np.isfinite(column).all() for column in found.values())
        assert max(abs(column[0]) for column in found.values()) < 7.0
        assert all(-2.0 <= column[0] <= 0.5 for name, column in found.items() if name.endswith("_above_free"))

    @pytest.mark.parametrize("cell", [FREE, UNKNOWN])
    def test_which_states_the_map_leaves_possible(self, cell):
        partial = PartialMap(np.array([[FREE, cell, FREE]]), 0.5)
        phi = features(partial, (1.3, 0.2, 1.5), tx_m=(0.1, 0.2, 1.5), unobserved_m=0.5 * (cell == UNKNOWN))
        found = inputs(phi)
        columns = [found[f"{state.name.lower()}_possible"][0] for state in LinkState]
        assert columns == ([1, 1, 1] if cell == UNKNOWN else [0, 1, 0])

    def test_length_in_walls(self):
        """Along the line, on the link's own map, no more than 1 m."""
        thin, thick = (PartialMap(np.array([[FREE] * 2 + [WALL] * cells + [FREE] * 2] * 4), 0.25) for cells in (1, 8))
        tx_m, rx_m = np.array([0.1, 0.1, 1.5]), np.array([1.1, 0.9, 1.5])
        slant = math.hypot(1.0, 0.8)
        maps = ((thin, thick), np.array([0, 0, 1, 1]))
        found = inputs(features(maps, [rx_m, (0.4, 0.9, 1.5), rx_m, (2.9, 0.9, 1.5)], tx_m=tx_m))
        np.testing.assert_allclose(found["walled"], [0.25 * slant, 0.0, 0.6 * slant, 1.0], rtol=1e-6)

    def test_lengths(self, home):
        found = inputs(features(home, (3.0, 4.0, 1.5), unobserved_m=2.0, state=NLOS))
        for name, expected in {
            "distance": math.log(8.0 / 3.0),
            "log_distance": math.log(5.0),
            "unobserved": math.log(5.0 / 3.0),
            "unobserved_fraction": 0.4,
            "observed": math.log(2.0),
            "strongest_unobserved": math.log(5.0 / 3.0),
        }.items():
            assert found[name] == pytest.approx(expected), name

    def test_gains(self, home):
        indirect_db = np.array([-80.0, -85.0, -95.0, -120.0, -150.0])
        found = inputs(features(home, (3.0, 4.0, 1.5), gain_db=-76.0, indirect_db=indirect_db))
        free_db = float(free_space_gain_db(5.0, FREQUENCY_HZ))
        assert free_db == pytest.approx(-75.37, abs=0.01)
        for name, gain_db in (
            *(("gain", -76.0), ("free_gain", free_db)),
            *(
                (f"indirect_{length_m:g}", gain_db)
                for length_m, gain_db in zip(ATTENUATION_LENGTHS_M, indirect_db, strict=True)
            ),
        ):
            assert found[name] == pytest.approx((gain_db + 150.0) / 100.0), name
            if name != "free_gain":
                above = min(max((gain_db - free_db) / 30.0, -2.0), 0.5)
                assert found[f"{name}_above_free"] == pytest.approx(above, abs=1e-6), name

    def test_moving_turning_and_mirroring_everything_changes_nothing(self, home):
        rx_m = np.random.default_rng(2).uniform(-7.9, 7.9, (60, 3))
        tx_m = np.tile([0.31, -0.17, 1.5], (60, 1))
        expected = inputs(features(home, rx_m, tx_m=tx_m))
        assert np.ptp(expected["walled"]) > 0.5
        assert np.ptp(expected["rx_seen"]) == 1.0
        moved = PartialMap(home.state, 1.0, (492.0, -8.0))
        turned = PartialMap(np.rot90(home.state, -1), 1.0, (-8.0, -8.0))
        mirrored = PartialMap(home.state[:, ::-1], 1.0, (-8.0, -8.0))
        for partial, where in (
            (moved, lambda at_m: at_m + np.array([500.0, 0.0, 0.0])),
            (turned, lambda at_m: at_m[:, [1, 0, 2]] * (-1.0, 1.0, 1.0)),
            (mirrored, lambda at_m: at_m * (-1.0, 1.0, 1.0)),
        ):
            for name, column in inputs(features(partial, where(rx_m), tx_m=where(tx_m))).items():
                np.testing.assert_allclose(column, expected[name], atol=1e-6, err_msg=name)


class TestContextNetworks:
    @pytest.mark.parametrize("with_map", [False, True])
    def test_shapes_are_those_that_are_documented(self, with_map):
        found = context_networks(0, with_map=with_map)
        shapes = CONTEXT_SHAPES[1 + with_map]
        assert {name: (network.input_shape, network.output_shape) for name, network in found.items()} == shapes

    def test_the_seed_sets_every_first_weight_that_is_not_0(self):
        one, again, other = (context_networks(seed) for seed in (3, 3, 4))
        for name, network in one.items():
            weights = (each[name].get_weights() for each in (one, again, other))
            for weight, same, different in zip(*weights, strict=True):
                np.testing.assert_array_equal(weight, same)
                assert np.any(weight != different) == (np.ptp(weight) > 0.0), name
            assert sum(np.ptp(weight) > 0.0 for weight in network.get_weights()) >= 2

    def test_single_precision_whatever_the_policy(self):
        keras = import_keras()
        keras.config.set_dtype_policy("float64")
        try:
            found = context_networks(0)
        finally:
            keras.config.set_dtype_policy("float32")
        assert {str(weight.dtype) for network in found.values() for weight in network.weights} == {"float32"}


class TestReadMapsAndLinks:
    """With a map network that returns the position of a cell, and a link network that returns its inputs of the map."""

    SCALES = len(CELLS_M)

    @staticmethod
    def of_maps(links):
        """Return the first three numbers of each scale, and one of the rest."""
        read = np.reshape(links[:, len(LINK_INPUTS) :], (-1, len(CELLS_M), MAP_FEATURES))
        return np.concatenate([read[:, :, :3].reshape(len(read), -1), read[:, 0, 3:4]], axis=1)

    @staticmethod
    def values(windows, training):
        """Return x, y of the cells and a window's first channel, or 0 in an empty window, and 100 in both."""
        import tensorflow as tf

        count = windows.shape[0]
        known = tf.cast(tf.reduce_any(windows > 0, axis=(1, 2, 3), keepdims=True), tf.float32)
        y, x = np.mgrid[:WINDOW_CELLS, :WINDOW_CELLS].astype(np.float32)
        positions = np.tile(np.stack([x, y], axis=-1), (count, 1, 1, 1)) * known
        rest = np.full((count, WINDOW_CELLS, WINDOW_CELLS, MAP_FEATURES - 3), 100.0, dtype=np.float32)
        return tf.concat([positions, windows[..., :1], rest], axis=-1)

    def seen(self, windows, offsets_m):
        offsets_m = np.asarray(offsets_m, dtype=np.float32)
        links = np.zeros((*offsets_m.shape[:2], len(LINK_INPUTS)), dtype=np.float32)
        networks = {**dict.fromkeys(MAP_NETWORKS, self.values), LINK_NETWORK: self.of_maps}
        found = np.asarray(read_links(networks, read_maps(networks, windows.astype(np.float32)), links, offsets_m))
        return found[..., :-1].reshape(*offsets_m.shape[:2], self.SCALES, 3), found[..., -1]

    @pytest.fixture
    def windows(self):
        return np.random.default_rng(3).integers(1, 256, (2, *WINDOWS))

    @pytest.mark.parametrize(("scale", "cell_m"), [*enumerate(CELLS_M)])
    def test_exact_at_the_middles_of_cells(self, windows, scale, cell_m):
        rows, columns = np.random.default_rng(4).integers(8, WINDOW_CELLS - 8, (2, 2, 300))
        found, _ = self.seen(windows, (np.stack([columns, rows], axis=-1) + 0.5 - WINDOW_CELLS / 2) * cell_m)
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
            found, _ = self.seen(windows[:1], np.column_stack([x_m, np.zeros(6)])[None])
            np.testing.assert_allclose(found[0, :, scale, 2], [200, 200, 100, 0, 0, 0], atol=1e-2)
        x_m = np.linspace(0.0, 60.0, 20_001)
        found, _ = self.seen(windows[:1], np.column_stack([x_m, 0.7 * x_m])[None])
        assert abs(np.diff(found[0, :, :, 2], axis=0)).max() < 1.0

    def test_what_an_empty_window_gives_is_subtracted(self, windows):
        _, rest = self.seen(windows, np.zeros((2, 1, 2)))
        assert not rest.any()
        found, _ = self.seen(np.zeros_like(windows), np.zeros((2, 1, 2)))
        assert not found.any()

    def test_without_a_map_network_links_alone_are_read(self):
        links = np.random.default_rng(6).normal(size=(2, 3, len(LINK_INPUTS))).astype(np.float32)
        networks = {LINK_NETWORK: lambda rows: rows[:, :LINK_OUTPUTS]}
        outputs = read_links(networks, read_maps(networks, None), links, np.zeros((2, 3, 2), dtype=np.float32))
        np.testing.assert_array_equal(outputs, links[..., :LINK_OUTPUTS])


class TestDecode:
    @pytest.fixture(autouse=True)
    def llvm_before_tensorflow(self):
        import_keras()

    @settings(max_examples=50, deadline=None)
    @given(st.lists(st.floats(-1e4, 1e4), min_size=LINK_OUTPUTS, max_size=LINK_OUTPUTS), st.floats(-120.0, -20.0))
    def test_a_distribution_whatever_the_network_returns(self, outputs, free_db):
        log_p, means_db, log_variances = decode(np.array([outputs]), np.array([free_db]))
        assert np.exp(log_p).sum() == pytest.approx(1.0)
        assert np.isfinite(means_db).all()
        std_db = np.exp(0.5 * np.asarray(log_variances))
        assert (std_db >= STD_RANGE_DB[0] * (1 - 1e-9)).all()
        assert (std_db <= STD_RANGE_DB[1] * (1 + 1e-9)).all()

    def test_by_hand(self):
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

    def test_on_a_map_the_place_counts(self, networks, home):
        """The links are equal in all but where the receivers are: only the map network sees a difference."""
        position = np.array([[2.5, 0.5, 1.5], [0.5, 2.5, 1.5]])
        state = home.state.copy()
        state[8:12, 8:12] = FREE
        phi = features(PartialMap(state, 1.0, (-8.0, -8.0)), position, tx_m=(0.5, 0.5, 1.5), unobserved_m=1.0)
        one, other = scaled_inputs(phi, FREQUENCY_HZ)
        np.testing.assert_array_equal(one, other)
        probabilities, *_ = evaluate_context_networks(networks, phi, FREQUENCY_HZ)
        assert abs(probabilities[:, 0] - probabilities[:, 1]).max() > 1e-3

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

    def test_windows_are_read_once_and_the_same_when_compiled(self, networks):
        windows = np.random.default_rng(11).integers(0, 256, (3, *WINDOWS)).astype(np.uint8)
        read = MapReader(networks)
        for some in (windows[:1], windows[1:], windows):  # all but the first are read by compiled networks
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

    def test_no_links(self, networks, home):
        phi = features(home, (1.0, 2.0, 1.5)).take(slice(0))
        assert [each.shape for each in evaluate_context_networks(networks, phi, FREQUENCY_HZ)] == [(3, 0)] * 3
