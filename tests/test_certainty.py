"""What maps leave no doubt about: on small grids written out, and against truth on explored homes."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sionna_partial.prediction.certainty import possible_states
from test_context_networks import features

from sionna_partial.constants import CellState, LinkState
from sionna_partial.datasets.home_links import home_links
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.settings import DatasetSettings

OUTAGE, LOS, NLOS = LinkState.OUTAGE, LinkState.LOS, LinkState.NLOS
CELLS = {".": CellState.FREE, "#": CellState.WALL, "?": CellState.UNKNOWN}
ALL = {OUTAGE, LOS, NLOS}


def drawn(plan):
    """Return the map, with cells of 0.5 m, that a drawing shows; its last line has the smallest y."""
    rows = [[CELLS[cell] for cell in line] for line in plan.split()]
    return PartialMap(np.array(rows[::-1], dtype=np.uint8), 0.5)


def possible(partial, tx, rx, state):
    """Return the states that are possible for a link between points counted in cells, which is traced in a state."""
    tx_m, rx_m = (np.array([0.5 * x, 0.5 * y, 1.5]) for x, y in (tx, rx))
    unobserved_m = unobserved_lengths_m(partial, tx_m, rx_m[None])
    phi = features(partial, rx_m, tx_m=tx_m, unobserved_m=unobserved_m, state=state)
    return {LinkState(each) for each in np.flatnonzero(possible_states(phi)[0])}


SCREEN = drawn(
    """
    ??????????
    .....#....
    .....#....
    .....#....
    .....#....
    .....#....
    ..........
    ..........
    """
)
"""A wall one cell thick, seen from both sides, which ends at the height of 2 cells."""

DOUBLE = drawn("?????????? .....##?.. .....##?.. .....##?.. .....##?.. .....##?.. .....##?.. ??????????")

SLANTED = drawn(
    """
    ????????
    ?#......
    ..#.....
    ...#....
    ....#...
    .....#..
    ......#?
    ????????
    """
)

ROOM = drawn(
    """
    ?#######????
    ?#.....#.???
    ?#.....#.???
    ?#.....#.???
    ?#.....#.???
    ?#######.???
    ?........???
    """
)
"""A closed room, and a little of what is around it."""


class TestWalls:
    @pytest.mark.parametrize("state", [OUTAGE, LOS, NLOS])
    @pytest.mark.parametrize("rx", [(9.5, 5.5), (8.5, 6.2), (6.5, 4.5)])
    def test_nothing_is_seen_through_a_known_wall(self, rx, state):
        """Nor is it if the outline of the wall has a gap; all of the line being observed, the trace is right."""
        if state != LOS:
            assert possible(SCREEN, (1.5, 4.5), rx, state) == ALL - {LOS}
        cut = dataclasses.replace(SCREEN, state=np.where(np.arange(10) == 4, CellState.UNKNOWN, SCREEN.state))
        assert LOS not in possible(cut, (1.5, 4.5), rx, state)

    def test_past_the_end_of_a_wall_and_along_its_face_the_trace_is_in_doubt(self):
        assert possible(SCREEN, (0.5, 3.5), (9.5, 1.5), NLOS) == ALL
        assert possible(SCREEN, (4.9, 6.5), (5.1, 0.5), LOS) == ALL

    @pytest.mark.parametrize("y", [1.5, 3.0, 5.5])
    def test_double_walls(self, y):
        for state in (OUTAGE, LOS, NLOS):
            assert LOS not in possible(DOUBLE, (1.5, 3.5), (9.5, y), state)

    @pytest.mark.parametrize("shift", np.linspace(0.0, 1.0, 5))
    def test_walls_whose_cells_touch_at_corners(self, shift):
        """A line may slip between two cells, but not through the wall that they stand for."""
        assert LOS not in possible(SLANTED, (2.0 + shift, 2.0 + shift), (4.5 + shift, 5.5 + shift), NLOS)

    def test_where_nothing_is_known_everything_is_possible(self):
        nothing = PartialMap(np.full((9, 9), CellState.UNKNOWN), 0.5)
        for state in (OUTAGE, LOS, NLOS):
            assert possible(nothing, (1.5, 1.5), (6.5, 3.5), state) == ALL

    def test_a_free_line_that_is_observed_is_as_traced(self):
        assert possible(SCREEN, (1.5, 1.0), (9.5, 0.6), LOS) == {LOS}
        assert possible(SCREEN, (1.5, 1.0), (9.5, 0.6), NLOS) == ALL - {LOS}


class TestRegions:
    def test_a_closed_room_keeps_its_outages(self):
        assert possible(ROOM, (4.5, 4.5), (8.4, 3.5), OUTAGE) == {OUTAGE}
        assert possible(ROOM, (8.4, 3.5), (4.5, 4.5), OUTAGE) == {OUTAGE}
        assert possible(ROOM, (4.5, 4.5), (11.5, 6.5), OUTAGE) == {OUTAGE}

    def test_what_is_not_in_outage_in_it_is_in_none(self):
        assert possible(ROOM, (3.5, 3.5), (5.5, 4.5), LOS) == {LOS}
        assert OUTAGE not in possible(ROOM, (3.5, 3.5), (5.5, 4.5), NLOS)

    def test_a_door_makes_one_region_of_two(self):
        state = ROOM.state.copy()
        state[2:5, 7] = CellState.FREE
        assert {OUTAGE, NLOS} <= possible(dataclasses.replace(ROOM, state=state), (4.5, 4.5), (8.4, 1.2), OUTAGE)


grids = hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.sampled_from([0, 0, 1, 2]))
points = st.tuples(st.floats(0.0, 9.0), st.floats(0.0, 9.0))


@settings(max_examples=100, deadline=None)
@given(grids, points, points, st.sampled_from(LinkState))
def test_some_state_is_always_possible_and_swapping_the_ends_changes_nothing(state, tx, rx, traced):
    partial = PartialMap(state, 0.5)
    found = possible(partial, tx, rx, traced)
    assert found
    assert found == possible(partial, rx, tx, traced)
    assert possible(PartialMap(state.T, 0.5), tx[::-1], rx[::-1], traced) == found


@settings(max_examples=100, deadline=None)
@given(grids, points, points)
def test_a_trace_without_walls_is_not_contradicted(state, tx, rx):
    """LOS traced on an observed line is possible; without a wall on it, it is certain."""
    found = possible(PartialMap(np.where(state == CellState.UNKNOWN, CellState.FREE, state), 0.5), tx, rx, LOS)
    inside = max(*tx, *rx) <= min(state.shape)
    assert not inside or LOS in found


def test_rules_hold_on_explored_homes():
    """Where the true home is traced, at most one link in a thousand contradicts them."""
    from sionna_partial.simulation.homes import make_home

    chosen = DatasetSettings(links_per_home=200, transmitters_per_home=2, stages=(50, 150))
    tables = [home_links(make_home(seed), f"home {seed}", chosen) for seed in (91000, 91001, 91002)]
    decided = wrong = 0
    for table in tables:
        states = possible_states(table.phi)
        decided += (~states.all(axis=1)).sum()
        wrong += (~states[np.arange(len(table)), table.link_state]).sum()
    assert decided > 800
    assert wrong <= decided / 1000
