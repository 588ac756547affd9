"""What the paths of hand-made links cross, and what maps show of links and leave possible."""

import dataclasses
import math

import numpy as np
import pytest
from extruded import drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from predictor_links import features
from traced import made_links

from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.lab.datasets.home_links import home_links
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import ATTENUATION_LENGTHS_M, LinkContext, link_features
from sionna_partial.prediction.space import MapSpace
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.trace import trace_links
from sionna_partial.worlds.homes import make_home

FREE, WALL, UNKNOWN = CellState.FREE, CellState.WALL, CellState.UNKNOWN
DEPTH = 4


def room(resolution_m=1.0, unknown_from=5):
    """Return 8 by 3 free cells in walls; nothing is known from a column of cells on, but for the outer wall."""
    state = np.full((5, 10), WALL)
    state[1:-1, 1:-1] = FREE
    state[1:-1, unknown_from:-1] = UNKNOWN
    return PartialMap(state, resolution_m)


HALF, WHOLE = room(), room(unknown_from=9)
TX = (1.5, 2.5, 1.5)
NEAR, FAR = (4.5, 2.5, 1.5), (7.5, 2.5, 1.5)


def of_paths(*paths, partial=HALF, tx=TX, rx=FAR):
    """Return the context of one link with paths (complex gain, vertices)."""
    interactions = np.zeros((len(paths), DEPTH), dtype=np.uint8)
    vertices_m = np.full((len(paths), DEPTH, 3), np.nan)
    for number, (_, vertices) in enumerate(paths):
        interactions[number, : len(vertices)] = 1
        vertices_m[number, : len(vertices)] = np.reshape(vertices, (-1, 3))
    transfer = np.array([gain for gain, _ in paths], dtype=complex).reshape(-1, 1, 1)
    return link_features(
        partial, made_links(tx, [rx], transfer=transfer, interactions=interactions, vertices_m=vertices_m)
    ).context


def gains_db(power, crossed_m):
    """Return the gain at each attenuation length of paths that cross so much unobserved space."""
    power, crossed_m = np.array(power), np.array(crossed_m)
    kept = [
        crossed_m == 0.0 if length_m == 0.0 else np.exp(-crossed_m / length_m) for length_m in ATTENUATION_LENGTHS_M
    ]
    return [10 * math.log10(max((power * each).sum(), 1e-15)) for each in kept]


class TestPaths:
    def test_direct_path_is_left_out(self):
        bounced = (1e-4, [(6.5, 2.5, 1.5)])
        found, without = of_paths((0.5, []), bounced, rx=NEAR), of_paths(bounced, rx=NEAR)
        assert found.straight_gain_db == pytest.approx([-6.02], abs=0.01)
        assert without.straight_gain_db == [GAIN_FLOOR_DB]
        assert same(dataclasses.replace(found, straight_gain_db=without.straight_gain_db), without)

    def test_rounding_at_the_border_of_the_unknown_hides_no_path(self):
        found = of_paths((0.01, [(5.0 + 1e-5, 2.5, 1.5)]), rx=NEAR)
        assert found.indirect_gain_db[0, -1] == pytest.approx(-40.0)
        assert of_paths((0.01, [(5.01, 2.5, 1.5)]), rx=NEAR).indirect_gain_db[0, -1] == GAIN_FLOOR_DB

    def test_on_a_complete_map_paths_between_unknown_cells_are_unobserved(self):
        """Their vertices are on known walls, from which nothing unknown can be reached."""
        partial = drawn("#####????? #...#????? #...#????? #####?????", 1.0)
        tx, wall, rx = (6.5, 2.5, 1.5), (4.5, 2.0, 1.5), (8.5, 1.5, 1.5)
        assert partial.is_complete
        found = of_paths((0.01, [wall]), partial=partial, tx=tx, rx=rx)
        crossed_m = 0.75 * math.dist(tx, wall) + 0.875 * math.dist(wall, rx)
        assert found.strongest_unobserved_m == pytest.approx([crossed_m])
        assert found.indirect_gain_db[0] == pytest.approx(gains_db([1e-4], [crossed_m]))

    @given(st.integers(0, 2**32))
    def test_random_paths_leg_by_leg(self, seed):
        rng = np.random.default_rng(seed)
        paths = []
        for _ in range(int(rng.integers(0, 6))):
            vertices = rng.uniform((0.0, 0.0, 0.0), (10.0, 5.0, 3.0), (int(rng.integers(1, DEPTH + 1)), 3))
            paths.append((complex(*rng.normal(size=2)) * 1e-3, vertices))
        found = of_paths(*paths)
        crossed_m = [
            unobserved_lengths_m(HALF, np.array([TX, *vertices]), np.array([*vertices, FAR])).sum()
            for _, vertices in paths
        ]
        power = [abs(a) ** 2 for a, _ in paths]
        assert found.indirect_gain_db[0] == pytest.approx(gains_db(power, crossed_m), abs=1e-6)
        assert (np.diff(found.indirect_gain_db[0]) <= 1e-9).all()
        expected_m = crossed_m[int(np.argmax(power))] if paths else 6.0
        assert found.strongest_unobserved_m == pytest.approx([expected_m], abs=1e-9)


class TestLinks:
    def test_with_the_direct_path_it_is_the_gain_of_the_trace(self):
        partial = room(0.5, unknown_from=7)
        rx = np.array([(1.2, 1.4, 1.5), (3.1, 0.9, 1.2), (4.2, 1.6, 1.5)])
        links = trace_links(partial, (0.8, 0.7, 1.5), rx, trace_settings=TraceSettings(max_depth=2))
        found = link_features(partial, links).context
        direct = ~links.interactions.any(axis=1)
        power = np.bincount(links.path_rx[direct], np.abs(links.a[direct]) ** 2, minlength=3)
        total_db = 10 * np.log10(power + 10 ** (found.indirect_gain_db[:, 0] / 10))
        np.testing.assert_allclose(total_db, links.gain_db, atol=1e-6)
        assert (found.indirect_gain_db[:, 0] > found.indirect_gain_db[:, -1]).any()
        assert direct.sum() == 3


def same(first, second):
    names = {field.name for field in dataclasses.fields(LinkContext)} - {"spaces", "map_index"}
    spaces = ([each.spaces[number] for number in each.map_index] for each in (first, second))
    pairs = [(getattr(first, name), getattr(second, name)) for name in names]
    return next(spaces) == next(spaces) and all(np.array_equal(one, other) for one, other in pairs)


def context_of(count=3, partial=HALF, tx=TX, rx=NEAR):
    return features(partial, np.tile(rx, (count, 1)), tx_m=tx).context


def test_fields_of_maps_are_shared_by_links_that_are_taken_and_joined():
    one, two = context_of(2), context_of(3, partial=WHOLE)
    both = LinkContext.concatenate([one, two, one.take(slice(1)), two.take(np.array([2]))])
    assert both.spaces == (*one.spaces, *two.spaces)
    assert both.map_index.tolist() == [0, 0, 1, 1, 1, 0, 1]
    assert same(both.take(slice(2, 5)), two)
    assert not same(both.take(slice(3)), two)


class TestSeen:
    @pytest.mark.parametrize(
        ("position", "seen"),
        [
            ((4.5, 2.5, 1.5), True),
            ((5.5, 2.5, 1.5), False),
            ((5.0, 2.5, 1.5), True),  # on the border, in the freer cell
            ((9.0, 2.5, 1.5), False),  # between a wall and the unknown
            ((0.5, 0.0, 1.5), False),  # on the border of the map, a wall inside and unknown outside
            ((-0.5, 2.5, 1.5), False),
        ],
        ids=str,
    )
    def test_by_hand(self, position, seen):
        assert context_of(2, rx=position).rx_seen.tolist() == [seen, seen]
        assert context_of(2, tx=position).tx_seen.tolist() == [seen, seen]
        assert context_of(1, rx=position).tx_seen.tolist() == [True]

    def test_each_link_on_its_own_map(self):
        both = features(((HALF, WHOLE), np.array([0, 1, 1])), (FAR, FAR, (0.5, -1.0, 1.5)), tx_m=TX).context
        assert both.rx_seen.tolist() == [False, True, False]
        assert both.tx_seen.tolist() == [True, True, True]
        assert both.complete.tolist() == [False, True, True]
        assert both.take(np.array([2, 0])).complete.tolist() == [True, False]
        assert both.map_index.tolist() == [0, 1, 1]
        for number, partial in enumerate((HALF, WHOLE, WHOLE)):
            space, (tx_m, rx_m) = MapSpace.of(partial), (both.tx_m[[number]], both.rx_m[[number]])
            assert both.spaces[both.map_index[number]] is space
            assert both.exposure[number].tolist() == [*space.exposure_at(tx_m), *space.exposure_at(rx_m)]
            assert both.route[number] == pytest.approx(space.routes(tx_m[0], rx_m)[0])
        assert not context_of(1, partial=WHOLE, tx=(-1.0, -1.0, 1.5), rx=(11.0, 6.0, 1.5)).complete.any()


OUTAGE, LOS, NLOS = LinkState.OUTAGE, LinkState.LOS, LinkState.NLOS
ALL = {OUTAGE, LOS, NLOS}


def possible(partial, tx, rx, state):
    """Return the states that are possible for a link between points counted in cells, which is traced in a state."""
    tx_m, rx_m = (np.array([0.5 * x, 0.5 * y, 1.5]) for x, y in (tx, rx))
    unobserved_m = unobserved_lengths_m(partial, tx_m, rx_m[None])
    phi = features(partial, rx_m, tx_m=tx_m, unobserved_m=unobserved_m, state=state)
    return {LinkState(each) for each in np.flatnonzero(phi.context.possible[0])}


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

SLANTED = drawn("???????? ?#...... ..#..... ...#.... ....#... .....#.. ......#? ????????")

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
    @pytest.mark.parametrize("state", LinkState)
    def test_nothing_is_seen_through_a_known_wall(self, state):
        """Nor is it if the outline of the wall has a gap; all of the line being observed, the trace is right."""
        rx = (8.5, 6.2)
        assert state == LOS or possible(SCREEN, (1.5, 4.5), rx, state) == ALL - {LOS}
        cut = dataclasses.replace(SCREEN, state=np.where(np.arange(10) == 4, CellState.UNKNOWN, SCREEN.state))
        assert LOS not in possible(cut, (1.5, 4.5), rx, state)

    @pytest.mark.parametrize("noise", [0.0, 1.0])
    @pytest.mark.parametrize("length", [2.5, 3.5])
    def test_three_cells_of_wall_leave_no_los_but_traced_on_exact_walls(self, length, noise):
        """Through a wall from its end, the lines beside the direct one are clear."""
        post = drawn("?........ ......... .#######. ......... ?........")
        vars(post)["_noise_field"] = np.full(post.shape, noise)
        for state in LinkState:
            found = possible(post, (8.5 - length, 2.5), (8.5, 2.5), state)
            assert (LOS in found) == (length < 3.0 or (state, noise) == (LOS, 0.0))

    def test_lines_past_an_end_or_along_a_face_are_in_doubt_and_free_ones_as_traced(self):
        assert possible(SCREEN, (0.5, 3.5), (9.5, 1.5), NLOS) == ALL
        assert possible(SCREEN, (4.9, 6.5), (5.1, 0.5), LOS) == ALL
        assert possible(SCREEN, (1.5, 1.0), (9.5, 0.6), LOS) == {LOS}
        assert possible(SCREEN, (1.5, 1.0), (9.5, 0.6), NLOS) == ALL - {LOS}

    def test_double_walls_and_walls_whose_cells_touch_at_corners(self):
        """A line may slip between two cells, but not through the wall that they stand for."""
        for state in LinkState:
            assert LOS not in possible(DOUBLE, (1.5, 3.5), (9.5, 5.5), state)
        for shift in (0.0, 0.25, 0.5):
            assert LOS not in possible(SLANTED, (2.0 + shift, 2.0 + shift), (4.5 + shift, 5.5 + shift), NLOS)


class TestRegions:
    def test_known_walls_separate_regions(self):
        assert possible(ROOM, (8.4, 3.5), (4.5, 4.5), OUTAGE) == {OUTAGE}
        assert possible(ROOM, (4.5, 4.5), (11.5, 6.5), OUTAGE) == {OUTAGE}
        crop = drawn("...#... ...#... ...#... ...#...")
        assert possible(crop, (1.5, 1.5), (5.5, 2.5), OUTAGE) == ALL - {LOS}
        assert possible(ROOM, (3.5, 3.5), (5.5, 4.5), LOS) == {LOS}
        assert OUTAGE not in possible(ROOM, (3.5, 3.5), (5.5, 4.5), NLOS)
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


def test_rules_hold_on_explored_homes():
    """Where the true home is traced, at most one link in a thousand contradicts them."""
    chosen = DatasetSettings(links_per_home=200, transmitters_per_home=2, stages=(50, 150))
    tables = [home_links(make_home(seed), f"home {seed}", chosen) for seed in (91000, 91001, 91002)]
    decided = wrong = 0
    for table in tables:
        states = table.context.possible
        decided += (~states.all(axis=1)).sum()
        wrong += (~states[np.arange(len(table)), table.link_state]).sum()
    assert decided > 800
    assert wrong <= decided / 1000
