"""Grids turned by the yaw of their origin."""

import logging
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.ndimage import label

from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps import ros_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.ros_map import turn_grid

FREE, WALL, UNKNOWN = (int(state) for state in CellState)
GRID = np.array([[0, 1, 2], [0, 0, 1]], dtype=np.uint8)
grids = arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.integers(0, 2))


@pytest.mark.parametrize(
    ("yaw", "state", "origin_m"),
    [
        (0.0, [[0, 1, 2], [0, 0, 1]], (10.0, 20.0)),
        (math.pi / 2, [[0, 0], [0, 1], [1, 2]], (9.0, 20.0)),
        (math.pi, [[1, 0, 0], [2, 1, 0]], (8.5, 19.0)),
        (-math.pi / 2, [[2, 1], [1, 0], [0, 0]], (10.0, 18.5)),
        (2 * math.pi, [[0, 1, 2], [0, 0, 1]], (10.0, 20.0)),
        (1.57, [[0, 0], [0, 1], [1, 2]], (9.0, 20.0)),
    ],
)
def test_quarter_turns(yaw: float, state: list[list[int]], origin_m: tuple[float, float]) -> None:
    turned, resolution_m, place = turn_grid(GRID, 0.5, (10.0, 20.0, yaw))
    assert turned.tolist() == state
    assert resolution_m == 0.5
    assert place == origin_m


@given(grids, st.integers(-4, 4))
def test_quarter_turns_move_every_cell_by_the_rotation(state: np.ndarray, turns: int) -> None:
    """A world point has the state that the grid has at the point turned back about the corner."""
    yaw = turns * math.pi / 2
    partial = PartialMap(*turn_grid(state, 1.0, (3.0, -2.0, yaw))[:1], 1.0, turn_grid(state, 1.0, (3.0, -2.0, yaw))[2])
    v, u = np.mgrid[: state.shape[0], : state.shape[1]] + 0.5
    x = 3.0 + math.cos(yaw) * u - math.sin(yaw) * v
    y = -2.0 + math.sin(yaw) * u + math.cos(yaw) * v
    assert np.array_equal(partial.state_at(np.stack([x, y], axis=-1)), state)
    assert partial.state.size == state.size


@given(grids, st.floats(-6.28, 6.28), st.integers(0, 2**32 - 1))
def test_any_turn_keeps_the_state_of_places(state: np.ndarray, yaw: float, seed: int) -> None:
    """New cells have the state of the old grid at their centre; only a free one may have become wall."""
    new, cell, (x0, y0) = turn_grid(state, 1.0, (3.0, -2.0, yaw))
    if cell == 1.0:
        return
    row, column = np.mgrid[: new.shape[0], : new.shape[1]]
    x, y = x0 + (column + 0.5) * cell - 3.0, y0 + (row + 0.5) * cell + 2.0
    back = np.stack([math.cos(yaw) * x + math.sin(yaw) * y, math.cos(yaw) * y - math.sin(yaw) * x], axis=-1)
    fraction = np.abs(back - np.rint(back)).min(axis=-1)
    clear = fraction > 1e-6
    expected = PartialMap(state, 1.0).state_at(back)
    differs = clear & (new != expected)
    assert (expected[differs] == FREE).all()
    assert (new[differs] == WALL).all()
    assert cell == 0.5


def room(ny: int, nx: int) -> np.ndarray:
    """Build a closed room with walls of one cell amid unknown cells."""
    state = np.full((ny + 4, nx + 4), UNKNOWN, dtype=np.uint8)
    state[1:-1, 1:-1] = WALL
    state[2:-2, 2:-2] = FREE
    return state


@given(st.integers(1, 12), st.integers(1, 12), st.floats(-6.28, 6.28), st.booleans())
def test_closed_rooms_stay_closed(ny: int, nx: int, yaw: float, corners: bool) -> None:
    """Also where the walls meet at a corner alone."""
    state = room(ny, nx)
    if not corners:
        for row in (1, -2):
            state[row, [1, -2]] = UNKNOWN
    new, resolution_m, origin_m = turn_grid(state, 0.1, (0.0, 0.0, yaw))
    assert PartialMap(new, resolution_m, origin_m).is_complete
    assert label(new != WALL, np.ones((3, 3)))[1] == 2 or not corners


def test_diagonal_walls_stay_closed() -> None:
    """A diamond of cells that touch at corners alone, free inside."""
    y, x = np.mgrid[-12:13, -12:13]
    reach = np.abs(x) + np.abs(y)
    state = np.where(reach < 10, FREE, np.where(reach == 10, WALL, UNKNOWN)).astype(np.uint8)
    assert PartialMap(state, 0.1).is_complete
    for yaw in np.linspace(-3, 3, 41):
        new, resolution_m, origin_m = turn_grid(state, 0.1, (0.0, 0.0, yaw))
        assert PartialMap(new, resolution_m, origin_m).is_complete
        if resolution_m < 0.1:
            assert (new == FREE).sum() == pytest.approx(4 * (state == FREE).sum(), rel=0.06)


def test_frontiers_stay_open() -> None:
    """Turning closes no opening towards unknown cells."""
    state = room(10, 10)
    state[1, 4:8] = FREE
    new, resolution_m, origin_m = turn_grid(state, 0.1, (0.0, 0.0, 0.4))
    assert not PartialMap(new, resolution_m, origin_m).is_complete
    assert (new == WALL).sum() == pytest.approx(4 * (state == WALL).sum(), rel=0.05)


def test_small_tilt_is_below_the_resolution() -> None:
    state = room(96, 96)
    limit = 0.5 / math.hypot(100, 100)
    assert turn_grid(state, 0.1, (0.0, 0.0, 0.99 * limit))[1] == 0.1
    assert turn_grid(state, 0.1, (0.0, 0.0, 1.01 * limit))[1] == 0.05


def test_turning_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        turn_grid(GRID, 0.1, (0.0, 0.0, 0.3))
    assert "origin yaw 0.3 rad: the map is turned onto cells of 0.05 m" in caplog.text


def test_too_many_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_map, "MAX_CELLS", 30)
    with pytest.raises(
        MapError, match=r"origin = \[0.0, 1.0, 0.5\] has a yaw for which the map needs 7 x 8 cells, more"
    ):
        turn_grid(GRID, 0.1, (0.0, 1.0, 0.5))
