"""PartialMap: free, wall and unknown cells of a floor plan."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from meshes import box, scene_mesh
from scipy import ndimage

from sionna_partial.constants import CellState
from sionna_partial.errors import MapError, PositionError
from sionna_partial.maps import environment
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import Material

FREE, WALL, UNKNOWN = (int(state) for state in CellState)

PLAN = PartialMap(np.array([[1, 1, 1, 1], [1, 0, 0, 2], [1, 1, 1, 1]]), 0.5, (10.0, -4.0), wall_height_m=2.5)
states = arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=8), elements=st.integers(0, 2))


def test_state_is_a_read_only_copy() -> None:
    array = np.zeros((2, 2), dtype=np.uint8)
    partial = PartialMap(array, 0.1)
    array[0, 0] = WALL
    assert partial.state[0, 0] == FREE
    with pytest.raises(ValueError, match="read-only"):
        partial.state[0, 0] = WALL


def test_equality() -> None:
    mesh, other = scene_mesh(box((0, 0, 0), (1, 1, 1))), scene_mesh(box((0, 0, 0), (1, 1, 2)))
    changes = {"state": np.full((3, 4), 1), "resolution_m": 0.25, "origin_m": (10.0, -4.5), "wall_height_m": 2.4}
    for name, value in {**changes, "interior_cells": 2, "material": Material(), "mesh": mesh}.items():
        assert replace(PLAN, **{name: value}) != PLAN  # type: ignore[arg-type]
    assert replace(PLAN) == PLAN
    assert replace(PLAN, mesh=replace(mesh)) == replace(PLAN, mesh=mesh) != replace(PLAN, mesh=other)


@given(states, st.floats(1e-3, 10.0), st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)))
def test_every_cell_centre_has_its_index_and_state(state: np.ndarray, resolution_m: float, origin_m: tuple) -> None:
    partial = PartialMap(state, resolution_m, origin_m)
    row, column = np.mgrid[: state.shape[0], : state.shape[1]]
    centres = np.stack([column, row], axis=-1) * resolution_m + resolution_m / 2 + np.array(origin_m)
    found = partial.cell_index(centres)
    assert np.array_equal(found[0], row)
    assert np.array_equal(found[1], column)
    assert np.array_equal(partial.state_at(centres), state)


@given(st.integers(-50, 50), st.sampled_from([0.05, 0.1, 0.03, 1 / 3]), st.sampled_from([0.0, -24.0, 7.7]))
def test_cell_edges_belong_to_the_cell_that_they_begin(cell: int, resolution_m: float, origin: float) -> None:
    partial = PartialMap(np.zeros((2, 2)).astype(int), resolution_m, (origin, origin))
    edge = origin + cell * resolution_m
    assert [int(index) for index in partial.cell_index(np.array([edge, edge]))] == [cell, cell]


def test_outside_is_unknown() -> None:
    points = np.array([[9.99, -3.0], [12.0, -3.0], [11.0, -4.01], [11.0, -2.5], [1e9, 1e9]])
    assert PLAN.state_at(points).tolist() == [UNKNOWN] * 5
    assert PLAN.state_at(np.array([10.7, -3.2])).shape == ()


@pytest.mark.parametrize(
    ("block", "state"),
    [
        ([[1, 1], [1, 1]], WALL),
        ([[1, 1], [1, 2]], UNKNOWN),
        ([[1, 2], [0, 1]], FREE),
        ([[2, 1], [1, 0]], FREE),
    ],
)
def test_a_corner_has_the_freest_state_around_it(block: list[list[int]], state: int) -> None:
    partial = PartialMap(np.array(block), 0.05, (7.7, -24.0))
    assert {int(partial.state_at(np.array([7.75 + d, -23.95 - d]))) for d in (-1e-9, 0.0, 1e-9)} == {state}


@given(states)
def test_is_complete(state: np.ndarray) -> None:
    padded = np.pad(state, 1, constant_values=UNKNOWN)
    beside = ndimage.binary_dilation(padded == UNKNOWN)
    assert PartialMap(state, 0.1).is_complete == ((state == FREE).any() and not (beside & (padded == FREE)).any())


def test_observed_fraction() -> None:
    ring = np.array([[2, 1, 2], [1, 0, 1], [2, 1, 2]])
    assert PartialMap(ring, 0.1).observed_fraction == 1.0
    assert PartialMap(np.array([[1, 0, 2, 2]]), 0.1).observed_fraction == 0.5
    assert PartialMap(ring, 0.1, interior_cells=4).observed_fraction == 0.25
    assert PartialMap(np.array([[0, 0]]), 0.1, interior_cells=1).observed_fraction == 1.0
    assert PartialMap(np.array([[2]]), 0.1, interior_cells=0).observed_fraction == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"state": [0, 1]}, "state has shape (2,): give a two-dimensional array (ny, nx) with at least one cell"),
        ({"state": [[0], [0, 1]]}, "state = [[0], [0, 1]] is not numeric: give CellState integers"),
        ({"mesh": "room.ply"}, "mesh is of type str: give a SceneMesh, or None for a plan."),
        ({"state": [[0, 3]]}, "state has values 0 to 3: use CellState integers FREE 0, WALL 1, UNK"),
        ({"resolution_m": 0.0}, "resolution_m = 0.0 is not allowed: give a number of metres in [0.001, 10]"),
        ({"origin_m": (0.0,)}, "origin_m = (0.0,): give the (x, y) of the lower-left corner in metres"),
        ({"interior_cells": True}, "interior_cells = True is not allowed: give the number of free cells, or None"),
        ({"state": [np.ma.masked_array([0, 1], [0, 1])]}, "state has masked values, whose data would be read: fill"),
        ({"origin_m": (0.0, np.inf)}, "origin_m = inf is not allowed: give a number of metres in [-1e+08, 1e+08]"),
        ({"material": "brick"}, "material is of type str: give a Material, or None for that of SceneSettings."),
    ],
)
def test_wrong_map(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(MapError, match=re.escape(message)):
        PartialMap(**{"state": [[0]], "resolution_m": 0.1, **arguments})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ((10.75, -3.25), "tx has shape (2,): give x, y, z in metres, (3,) or (N, 3)"),
        ("here", "tx = 'here' is not numeric: give x, y, z in metres"),
        ((np.nan, -3.25, 1.5), "tx = (nan, -3.25, 1.5) is not finite: give finite numbers in metres"),
        ((9, -3.25, 1.5), "tx = (9.0, -3.25, 1.5) is outside the map, which spans x 10 to 12 m and y -4 to -2.5 m: m"),
        (np.ma.masked_array((10.75, -3.25, 1.5), [0, 0, 1]), "tx has masked values, whose data would be read"),
        ((True, False, True), "tx has dtype bool: give x, y, z in metres"),
        ((10.75, -3.25, 2.5), "tx = (10.75, -3.25, 2.5) is not between floor and ceiling (0 to 2.5 m): change its hei"),
        ((10.25, -3.25, 1.5), "tx = (10.25, -3.25, 1.5) is inside a wall: move it to a free or unknown cell"),
        (
            [(10.75, -3.25, 1.5), (10.25, -3.25, 1.5), (10.25, -2.75, 1.5)],
            "tx[1] = (10.25, -3.25, 1.5) (and 1 more) is",
        ),
    ],
)
def test_wrong_positions(points: object, message: str) -> None:
    with pytest.raises(PositionError, match=re.escape(message)):
        PLAN.require_positions("tx", points)


@pytest.mark.parametrize("point", [(10750, -3250, 1500), (1075, -325, 1.5)])
def test_positions_in_other_units(point: tuple[float, float, float]) -> None:
    with pytest.raises(PositionError, match=r"Did you mean metres\? Taken for (milli|centi)metres it is at .* m\.$"):
        PLAN.require_positions("tx", point)


def test_too_many_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "MAX_CELLS", 11)
    with pytest.raises(MapError, match="state has 3 x 4 cells, more than 11: cut the map to the building or coarsen"):
        PartialMap(PLAN.state, 0.5)


def test_names_of_positions() -> None:
    with pytest.raises(PositionError, match=r"^door = \(10\.25, -3\.25, 1\.5\) is inside a wall"):
        PLAN.require_positions("tx", [(10.75, -3.25, 1.5), (10.25, -3.25, 1.5)], names=["hall", "door"])


@pytest.mark.parametrize(
    ("turn", "hint"),
    [(np.flipud, "on the map upside down (numpy.flipud)."), (np.transpose, "on the map with rows and columns swapped")],
)
def test_turned_arrays(turn: Callable[[np.ndarray], np.ndarray], hint: str) -> None:
    state = np.full((4, 9), WALL)
    state[1, 1:8] = state[2, 1] = FREE
    rx = [(x + 0.5, y, 1.5) for x, y in ((1, 1.5), (4, 1.5), (7, 1.5), (1, 2.5))]
    with pytest.raises(PositionError, match=re.escape(f"All 4 are free {hint}")):
        PartialMap(turn(state), 1.0).require_positions("rx", rx)


@given(states, arrays(np.float64, (5, 3), elements=st.floats(-1.0, 2.0)))
def test_positions_pass_where_the_map_allows_them(state: np.ndarray, points: np.ndarray) -> None:
    partial = PartialMap(state, 0.2, (-0.2, 0.1), 1.5)
    x0, y0, x1, y1 = partial.bounds_m
    x, y, z = points.T
    inside = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1) & (z > 0) & (z < 1.5)
    allowed = inside & (partial.state_at(points) != WALL)
    for point, good in zip(points, allowed, strict=True):
        if good:
            assert np.array_equal(partial.require_positions("rx", point), point)
        else:
            with pytest.raises(PositionError, match="rx = "):
                partial.require_positions("rx", point)


def test_mesh_says_how_high_radios_may_be() -> None:
    mesh = scene_mesh(box((10, -4, 100), (12, -3, 104)))
    partial = replace(PLAN, mesh=mesh)
    assert (PLAN.height_range_m, partial.height_range_m) == ((0.0, 2.5), (100.0, 104.0))
    assert partial.require_positions("tx", (10.75, -3.25, 103.9)).tolist() == [10.75, -3.25, 103.9]
    for z in (1.5, 100.0, 104.0):
        with pytest.raises(PositionError, match=r"is not between floor and ceiling \(100 to 104 m\)"):
            partial.require_positions("tx", (10.75, -3.25, z))


def furnished() -> np.ndarray:
    """A room of 4 m x 4 m, cells of 10 cm, with a cabinet: 80 x 50 cm that nobody saw, behind a slit of one cell."""
    state = np.full((60, 60), UNKNOWN)
    state[9:51, 9:51] = WALL
    state[10:50, 10:50] = FREE
    state[20:27, 20:30] = WALL
    state[21:26, 21:29] = UNKNOWN
    state[20, 24] = FREE
    return state


@pytest.mark.parametrize(
    ("where", "kind", "nearly"),
    [
        (np.s_[0:0, 0:0], FREE, True),
        (np.s_[21:40, 21:29], UNKNOWN, True),  # the cabinet is open, no disc of 60 cm fits in
        (np.s_[24:45, 24:45], UNKNOWN, False),
        (np.s_[49:52, 30:34], FREE, True),  # a slit in the outer wall
        (np.s_[49:60, 30:34], FREE, False),  # through which a robot has seen what is free outside
        (np.s_[49:52, 30:40], FREE, False),
    ],
)
def test_is_nearly_complete(where: tuple[slice, slice], kind: int, nearly: bool) -> None:
    state = furnished()
    state[where] = kind
    partial = PartialMap(state, 0.1)
    assert not partial.is_complete
    assert partial.is_nearly_complete == nearly
    assert PartialMap(state[::-1].T, 0.1).is_nearly_complete == nearly
