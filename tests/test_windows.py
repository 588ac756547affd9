"""Windows around transmitters, against a reckoning with every cell of the map and every cell of the window."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.unobserved import (
    CELLS_M,
    CHANNELS,
    WINDOW_CELLS,
    map_windows,
)

FREE, WALL, UNKNOWN = CellState.FREE, CellState.WALL, CellState.UNKNOWN
CELL_M = CELLS_M[0]
SHAPE = (WINDOW_CELLS, WINDOW_CELLS, len(CHANNELS))
HALF_M = WINDOW_CELLS * CELL_M / 2
ROUNDING = 0.51 / 255
TX_M = np.array([0.0, 0.0])


def transmitter_window(partial, tx_m):
    """Return the nearest of the windows around a transmitter."""
    return map_windows(partial, tx_m[None])[0, 0]


def channel(window, name):
    """Return a channel of a window, in [0, 1]."""
    return window[..., CHANNELS.index(name)] / 255


def assert_alike(first, second):
    """Check that two windows are equal, but for rounding to the 255th above or below."""
    np.testing.assert_allclose(first.astype(int), second.astype(int), rtol=0, atol=1)
    assert np.mean(first != second) < 0.02


def middles_m(tx_m):
    """Return the centres (WINDOW_CELLS**2, 2) of the cells of a window, row by row [m]."""
    offsets = (np.arange(WINDOW_CELLS) + 0.5) * CELL_M - HALF_M
    x, y = np.meshgrid(tx_m[0] + offsets, tx_m[1] + offsets)
    return np.column_stack([x.ravel(), y.ravel()])


def cells_m(partial, *states):
    """Return the lower-left corners (K, 2) of the cells in some states [m]."""
    rows, columns = np.nonzero(np.isin(partial.state, states))
    return partial.origin_m + np.column_stack([columns, rows]) * partial.resolution_m


def covered(partial, tx_m, state):
    """Return the fraction of each cell of a window that the map's cells in a state cover, cell by cell."""
    low = middles_m(tx_m) - CELL_M / 2
    total = np.zeros(len(low))
    for corner in cells_m(partial, state):
        sides = np.minimum(low + CELL_M, corner + partial.resolution_m) - np.maximum(low, corner)
        total += np.prod(np.maximum(sides, 0.0), axis=1) / CELL_M**2
    return total.reshape(SHAPE[:2])


def crossed(partial, tx_m, *states, wider_m=0.0):
    """Return the fraction of each line from the transmitter to a cell of its window inside the map's cells in states.

    Each cell of the map, wider on all sides, cuts its own piece out of each line (Liang and Barsky 1984).
    """
    steps = middles_m(tx_m) - tx_m
    total = np.zeros(len(steps))
    for corner in cells_m(partial, *states):
        first, last = (corner - wider_m - tx_m) / steps, (corner + partial.resolution_m + wider_m - tx_m) / steps
        enter = np.minimum(first, last).max(axis=1).clip(0.0, 1.0)
        leave = np.maximum(first, last).min(axis=1).clip(0.0, 1.0)
        total += np.maximum(leave - enter, 0.0)
    return total.reshape(SHAPE[:2])


maps = st.builds(
    PartialMap,
    hnp.arrays(np.uint8, st.tuples(st.integers(1, 8), st.integers(1, 8)), elements=st.sampled_from([0, 1, 2])),
    st.sampled_from([0.05, 0.1, 0.25, 0.3, 0.7, 1.0, 4.0]),
    st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0)),
)
shares = st.tuples(st.floats(-1.0, 2.0), st.floats(-1.0, 2.0))


def placed(partial, fraction):
    """Return the position of a transmitter in fractions of the map, off round numbers [m]."""
    x0, y0, x1, y1 = partial.bounds_m
    return np.array([x0 + fraction[0] * (x1 - x0) + 0.00123, y0 + fraction[1] * (y1 - y0) + 0.00377])


class TestTransmitterWindow:
    @settings(max_examples=20, deadline=None)
    @given(maps, shares)
    def test_fractions_of_free_and_wall_are_exact(self, partial, fraction):
        tx_m = placed(partial, fraction)
        window = transmitter_window(partial, tx_m)
        assert window.shape == SHAPE
        assert window.dtype == np.uint8
        for name, state in (("free", FREE), ("wall", WALL)):
            expected = covered(partial, tx_m, state)
            np.testing.assert_allclose(channel(window, name), expected, atol=ROUNDING)

    @settings(max_examples=20, deadline=None)
    @given(maps, shares)
    def test_lines_are_exact(self, partial, fraction):
        tx_m = placed(partial, fraction)
        window = transmitter_window(partial, tx_m)
        np.testing.assert_allclose(channel(window, "seen"), crossed(partial, tx_m, FREE, WALL), atol=ROUNDING)
        of_walls, hidden = crossed(partial, tx_m, WALL), channel(window, "hidden")
        assert set(np.unique(hidden)) <= {0.0, 1.0}
        sure = (of_walls > 1e-5) | (crossed(partial, tx_m, WALL, wider_m=1e-5) == 0.0)
        np.testing.assert_array_equal(hidden[sure], of_walls[sure] > 1e-5)
        assert sure.mean() > 0.9

    def test_detours(self):
        """None in the open or off a wall at the transmitter, long out of a closed room, shorter through a door."""

        def detours(state):
            return channel(transmitter_window(PartialMap(state, CELL_M, (-HALF_M, -HALF_M)), TX_M), "detour")

        state, half = np.full((WINDOW_CELLS, WINDOW_CELLS), FREE), WINDOW_CELLS // 2
        assert not detours(state).any()
        state[half - 1 : half + 1, half - 1 : half + 1] = WALL
        assert not detours(state).any()
        state[:] = FREE
        low, high = half - 8, half + 8
        state[low : high + 1, [low, high]] = state[[low, high], low : high + 1] = WALL
        inside, beyond = np.s_[low + 1 : high, low + 1 : high], np.s_[low + 4 : high - 4, high + 1]
        shut = detours(state)
        state[low + 6 : high - 6, low] = FREE
        door = detours(state)
        assert not shut[inside].any()
        assert (shut[beyond] == 1.0).all()
        assert not door[inside].any()
        assert (door[beyond] > 0.0).all()
        assert (door <= shut).all()
        assert door.sum() < 0.9 * shut.sum()


class TestScales:
    def test_the_far_window_is_the_near_one_of_a_building_that_is_as_much_smaller(self):
        state = np.random.default_rng(8).choice([FREE, WALL, UNKNOWN], size=(60, 90), p=[0.8, 0.05, 0.15])
        times = CELLS_M[1] / CELLS_M[0]
        near = map_windows(PartialMap(state, 0.1), np.array([[4.13, 2.51]]))[0, 0]
        far = map_windows(PartialMap(state, 0.1 * times), times * np.array([[4.13, 2.51]]))[0, 1]
        assert_alike(far, near)

    def test_finer_maps_are_drawn_coarser(self):
        """Cells of 1.2 m are drawn from cells of 0.3 m: any wall makes a wall, and half of a cell free makes it so."""
        state = np.full((12, 18), UNKNOWN)
        state[0, 0], state[:6, 6:9], state[6:, 12:14] = WALL, FREE, FREE
        coarse = np.full((2, 3), UNKNOWN)
        coarse[0, 0], coarse[0, 1] = WALL, FREE
        tx_m = np.array([[5.03, 4.01]])
        one, two = (map_windows(partial, tx_m)[0, 1] for partial in (PartialMap(state, 0.05), PartialMap(coarse, 0.3)))
        names = [CHANNELS.index(name) for name in ("free", "seen")]
        np.testing.assert_array_equal(one[..., names], two[..., names])

    def test_walls_beside_the_transmitter_do_not_hide_everything_from_afar(self):
        """They fill the coarse cell in which it stands."""
        state = np.full((400, 400), FREE)
        state[:, 199] = WALL
        hidden = map_windows(PartialMap(state, 0.05), np.array([[10.02, 10.02]]))[0, 1, ..., CHANNELS.index("hidden")]
        assert not hidden[32, 33:40].any()
