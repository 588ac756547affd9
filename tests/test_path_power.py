"""TensorFlow sees what NumPy and Dr.Jit compute, and their first derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from pillar_room import RX_M, TX_M, small_room

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.differentiable.path_power import STEEPEST, moved_lengths_m, moved_paths
from sionna_partial.differentiable.smooth_lengths import SmoothLengths
from sionna_partial.prediction.paper_networks import import_keras
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.tracing.path_set import PARAMETERS, PathScene, PathSet

TX = np.array([1.1, 1.7, 1.4])


@pytest.fixture(scope="module")
def tf():
    import_keras()
    import tensorflow

    return tensorflow


@pytest.fixture(scope="module")
def paths() -> PathSet:
    return PathScene(small_room(), settings=sp.TraceSettings(max_depth=1)).paths(TX_M, RX_M)


@pytest.fixture(scope="module")
def empty() -> PathSet:
    return PathScene(small_room(), settings=sp.TraceSettings(max_depth=1)).paths(TX_M, [])


def variables(tf, paths, *names):
    return {name: tf.Variable(getattr(paths.base, name)) for name in names}


def upstream(paths, seed=0):
    """Return weights of the powers and of the vertices of paths, for a scalar of both."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.5, 1.5, len(paths)) / paths.power.sum(), rng.normal(size=paths.vertices_m.shape)


class CountedPaths:
    """Paths that count how often they are differentiated with respect to the transmitter."""

    def __init__(self, paths):
        self.base, self.at, self.times, self._paths = paths.base, paths.at, 0, paths

    def transmitter_slopes(self, parameters):
        self.times += 1
        return self._paths.transmitter_slopes(parameters)


class TestMovedPaths:
    def test_values(self, tf, paths):
        there = {"tx_m": paths.base.tx_m + 0.01, "conductivity_s_m": np.array([0.3])}
        power, vertices_m = moved_paths(paths, {name: tf.constant(value) for name, value in there.items()})
        expected, expected_m = paths.at(replace(paths.base, **there))
        assert (power.dtype, vertices_m.dtype) == (tf.float64, tf.float64)
        np.testing.assert_array_equal(power, expected)
        np.testing.assert_array_equal(vertices_m, np.nan_to_num(expected_m))
        assert not vertices_m.numpy()[paths.interactions == 0].any()

    def test_nothing_given_is_the_trace(self, tf, paths):
        power, vertices_m = moved_paths(paths, {})
        np.testing.assert_array_equal(power, paths.power)
        np.testing.assert_array_equal(vertices_m, np.nan_to_num(paths.vertices_m))

    def test_gradient(self, tf, paths):
        of_power, of_vertices = upstream(paths)
        given = variables(tf, paths, *PARAMETERS)
        with tf.GradientTape() as tape:
            power, vertices_m = moved_paths(paths, {name: tf.identity(each) for name, each in given.items()})
            value = tf.reduce_sum(power * of_power) + tf.reduce_sum(vertices_m * of_vertices)
        found, slopes = tape.gradient(value, given), paths.slopes(paths.base)
        power_by_tx, vertices_by_tx = paths.transmitter_slopes(paths.base)
        expected = {name: of_power @ slopes[name] for name in PARAMETERS}
        expected["tx_m"] = of_power @ power_by_tx + np.einsum("pdi,pdij->j", of_vertices, vertices_by_tx)
        for name in PARAMETERS:
            assert found[name].shape == getattr(paths.base, name).shape
            np.testing.assert_allclose(np.ravel(found[name]), expected[name], rtol=1e-9, err_msg=name)
            assert np.all(found[name].numpy() != 0.0)

    def test_gradient_by_differences(self, tf, paths):
        _, of_vertices = upstream(paths)

        def value(place):
            power, vertices_m = moved_paths(paths, {"tx_m": place})
            gain = tf.math.log(tf.math.unsorted_segment_sum(power, paths.path_rx, 3))
            return tf.reduce_sum(gain) + tf.reduce_sum(vertices_m * of_vertices)

        place = tf.Variable(paths.base.tx_m)
        with tf.GradientTape() as tape:
            here = value(tf.identity(place))
        steps = 2e-3 * np.eye(3)
        ends = [[value(tf.constant(paths.base.tx_m + sign * step)).numpy() for step in steps] for sign in (1, -1)]
        expected = (np.array(ends[0]) - ends[1]) / 4e-3
        np.testing.assert_allclose(tape.gradient(here, place), expected, rtol=0.01)

    def test_slopes_are_those_of_where_it_was_evaluated(self, tf, paths):
        place = tf.Variable(paths.base.tx_m)
        before = paths.base.tx_m.copy()
        with tf.GradientTape() as tape:
            value = tf.reduce_sum(moved_paths(paths, {"tx_m": tf.convert_to_tensor(place)})[0])
        place.assign_add([0.3, -0.2, 0.1])
        np.testing.assert_array_equal(paths.base.tx_m, before)
        np.testing.assert_allclose(tape.gradient(value, place), paths.transmitter_slopes(paths.base)[0].sum(axis=0))

    def test_persistent_tape_differentiates_the_paths_once(self, tf, paths):
        counted = CountedPaths(paths)
        place = tf.Variable(paths.base.tx_m)
        with tf.GradientTape(persistent=True) as tape:
            power, vertices_m = moved_paths(counted, {"tx_m": tf.identity(place)})
            total = tf.math.unsorted_segment_sum(power, paths.path_rx, 3)
        assert counted.times == 0
        one, again = tape.gradient(total, place), tape.gradient(total, place)
        np.testing.assert_array_equal(one, again)
        tape.gradient(vertices_m, place)
        assert counted.times == 1

    @pytest.mark.parametrize("at_once", [True, False])
    def test_jacobian(self, tf, paths, at_once):
        given = variables(tf, paths, "tx_m", "thickness_m", "frequency_hz")
        with tf.GradientTape(persistent=True) as tape:
            power, vertices_m = moved_paths(paths, {name: tf.identity(each) for name, each in given.items()})
        options = {"experimental_use_pfor": at_once}
        found, slopes = tape.jacobian(power, given, **options), paths.slopes(paths.base)
        assert {name: tuple(each.shape) for name, each in found.items()} == {
            "tx_m": (len(paths), 3), "thickness_m": (len(paths), 1), "frequency_hz": (len(paths),)
        }  # fmt: skip
        for name, each in found.items():
            np.testing.assert_allclose(np.reshape(each, slopes[name].shape), slopes[name], rtol=1e-12)
        if at_once:
            of_vertices = tape.jacobian(vertices_m, given["tx_m"], **options)
            np.testing.assert_allclose(of_vertices, paths.transmitter_slopes(paths.base)[1], rtol=1e-12)

    def test_a_part_of_the_paths(self, tf, paths):
        """TensorFlow hands back derivatives of single entries in another form."""
        given = variables(tf, paths, "tx_m", "conductivity_s_m")
        with tf.GradientTape() as tape:
            power, vertices_m = moved_paths(paths, {name: tf.identity(each) for name, each in given.items()})
            value = tf.reduce_sum(tf.gather(power, [3, 5])) + 0.0 * tf.reduce_sum(tf.gather(vertices_m, [2]))
        found, slopes = tape.gradient(value, given), paths.slopes(paths.base)
        for name, each in found.items():
            np.testing.assert_allclose(each, slopes[name][[3, 5]].sum(axis=0), rtol=1e-9)

    def test_second_derivatives_are_refused(self, tf, paths):
        place = tf.Variable(paths.base.tx_m)
        with tf.GradientTape() as outer:
            with tf.GradientTape() as tape:
                value = tf.reduce_sum(tf.math.log(moved_paths(paths, {"tx_m": tf.identity(place)})[0]))
            slope = tape.gradient(value, place)
        with pytest.raises(LookupError, match="links have first derivatives only"):
            outer.gradient(slope, place)

    def test_no_paths(self, tf, empty):
        given = variables(tf, empty, *PARAMETERS)
        with tf.GradientTape() as tape:
            power, vertices_m = moved_paths(empty, {name: tf.identity(each) for name, each in given.items()})
            value = tf.reduce_sum(power) + tf.reduce_sum(vertices_m)
        assert (power.shape, vertices_m.shape[0]) == ((0,), 0)
        assert not any(np.any(each) for each in tape.gradient(value, given).values())


@pytest.fixture(scope="module")
def rx_m():
    return np.array([[5.6, 3.1, 1.2], [5.1, 0.62, 1.9], [4.4, 2.3, 0.7], [2.1, 0.4, 1.5], [1.4, 3.3, 2.1]])


@pytest.fixture(scope="module")
def partial():
    """Return a map that is known up to a slanting line."""
    x, y = np.meshgrid(np.arange(60), np.arange(40))
    state = np.where(x + 0.4 * y > 38, CellState.UNKNOWN, CellState.FREE).astype(np.uint8)
    return sp.PartialMap(state, 0.1)


class TestMovedLengths:
    def of(self, tf, partial, rx_m, place):
        """Return lengths to receivers from where the transmitter is now."""
        first = np.broadcast_to(TX, rx_m.shape)
        exact_m = unobserved_lengths_m(partial, first, rx_m)
        ends = tf.broadcast_to(place, rx_m.shape), tf.constant(rx_m)
        return exact_m, moved_lengths_m(SmoothLengths(partial, CellState.UNKNOWN), exact_m, (first, rx_m), ends)

    def test_exact_where_it_was_traced(self, tf, partial, rx_m):
        exact_m, found_m = self.of(tf, partial, rx_m, tf.constant(TX))
        assert (exact_m > 0.5).tolist() == [True, True, True, False, False]
        np.testing.assert_array_equal(found_m, exact_m)

    def test_what_was_seen_stays_so(self, tf, partial, rx_m):
        place = tf.constant(TX + np.array([3.4, 1.0, 0.0]))
        assert (unobserved_lengths_m(partial, place.numpy(), rx_m)[3:] > 0.3).all()
        with tf.GradientTape() as tape:
            tape.watch(place)
            found_m = self.of(tf, partial, rx_m, place)[1][3:]
        assert found_m.numpy().tolist() == [0.0, 0.0]
        assert tape.gradient(found_m, place).numpy().tolist() == [0.0, 0.0, 0.0]

    def test_follows_the_frontier(self, tf, partial, rx_m):
        """As the exact length does over a while, not in each cell."""
        step = np.array([0.0, 0.3, 0.0])
        _, found_m = self.of(tf, partial, rx_m, tf.constant(TX + step))
        np.testing.assert_allclose(found_m, unobserved_lengths_m(partial, TX + step, rx_m), atol=0.08)

    def test_gradient_by_differences(self, tf, partial, rx_m):
        place = tf.constant(TX)
        with tf.GradientTape() as tape:
            tape.watch(place)
            found_m = self.of(tf, partial, rx_m, place)[1]
        jacobian = tape.jacobian(found_m, place)
        steps = 1e-5 * np.eye(3)
        ends = [[self.of(tf, partial, rx_m, tf.constant(TX + s * step))[1].numpy() for step in steps] for s in (1, -1)]
        np.testing.assert_allclose(jacobian, np.transpose(np.subtract(*ends) / 2e-5), rtol=1e-4, atol=1e-7)
        assert (np.abs(jacobian[:3, :2]).max(axis=1) > 0.01).all()

    def test_both_ends_count(self, tf, partial):
        """A segment in the unknown is as long as it is."""
        ends = [tf.Variable([[x, y, 1.5]], dtype=tf.float64) for x, y in ((5.2, 1.3), (5.7, 3.4))]
        base = tuple(end.numpy() for end in ends)
        lengths = SmoothLengths(partial, CellState.UNKNOWN)
        with tf.GradientTape() as tape:
            exact_m = unobserved_lengths_m(partial, *base)
            found_m = moved_lengths_m(lengths, exact_m, base, tuple(map(tf.convert_to_tensor, ends)))
        along = (base[1] - base[0]) / exact_m
        for slope, sign in zip(tape.gradient(found_m, ends), (-1, 1), strict=True):
            np.testing.assert_allclose(slope, sign * along, rtol=1e-9, atol=1e-12)

    def test_steepest(self, tf, partial):
        """Where the exact length is larger by far than the smooth one, it grows `STEEPEST` times as fast."""
        lengths = SmoothLengths(partial, CellState.UNKNOWN)
        start, end = np.array([[1.0, 1.0, 1.5]]), np.array([[4.5, 1.0, 1.5]])
        smooth_m = lengths(start, end)
        moved = tf.constant(end + np.array([0.25, 0.0, 0.0]))
        grown_m = lengths(start, moved.numpy()) - smooth_m
        assert grown_m > 0.2
        for times, pace in ((0.5, 0.5), (2.0, 2.0), (3.9, 3.9), (4.1, STEEPEST), (100.0, STEEPEST)):
            exact_m = times * smooth_m
            found_m = moved_lengths_m(lengths, exact_m, (start, end), (tf.constant(start), moved))
            np.testing.assert_allclose(found_m, exact_m + pace * grown_m, rtol=1e-12)

    def test_no_length_is_negative(self, tf, partial):
        lengths = SmoothLengths(partial, CellState.UNKNOWN)
        start, end = np.array([[1.0, 1.0, 1.5]]), np.array([[4.5, 1.0, 1.5]])
        near = tf.constant(np.array([[1.5, 1.0, 1.5]]))
        for times in (0.5, 1.0, 50.0):
            exact_m = times * lengths(start, end)
            found_m = moved_lengths_m(lengths, exact_m, (start, end), (tf.constant(start), near))
            assert found_m.numpy()[0] >= 0.0

    def test_complete_map_and_no_segments(self, tf):
        complete = sp.PartialMap(np.pad(np.zeros((8, 8), dtype=np.uint8), 1, constant_values=1), 0.5)
        lengths, nothing = SmoothLengths(complete, CellState.UNKNOWN), np.zeros((0, 3))
        assert moved_lengths_m(lengths, np.zeros(0), (nothing, nothing), (tf.constant(nothing),) * 2).shape == (0,)
        ends = np.array([[1.0, 1.0, 1.0]]), np.array([[99.0, 1.0, 1.0]])
        assert moved_lengths_m(lengths, np.zeros(1), ends, tuple(map(tf.constant, ends))).numpy().tolist() == [0.0]

    def test_second_derivatives_are_refused(self, tf, partial, rx_m):
        place = tf.Variable(TX)
        with tf.GradientTape() as outer:
            with tf.GradientTape() as tape:
                value = tf.reduce_sum(self.of(tf, partial, rx_m, tf.convert_to_tensor(place))[1] ** 2)
            slope = tape.gradient(value, place)
        with pytest.raises(LookupError, match="first derivatives only"):
            outer.gradient(slope, place)
