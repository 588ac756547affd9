import dataclasses
import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sionna_partial.constants import CellState, LinkState
from sionna_partial.errors import MapError, PositionError, PredictorError
from sionna_partial.learning.features import LinkFeatures, link_features, unobserved_distance_m
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.trace import TracedLinks

SYMBOLS = {".": CellState.FREE, "#": CellState.WALL, "?": CellState.UNKNOWN}


def drawn(text, resolution_m=1.0, origin_m=(0.0, 0.0)):
    """Return the map of an ASCII drawing, top line = largest y."""
    rows = [[SYMBOLS[symbol] for symbol in line.strip()] for line in text.split()][::-1]
    return PartialMap(np.array(rows), resolution_m, origin_m)


HALF = drawn("""
    ##########
    #....????#
    #....????#
    #....????#
    ##########
""")


def phi_of(count=3):
    ones = np.ones(count)
    return LinkFeatures(np.full(count, LinkState.LOS), 0.5 * ones, ones * np.arange(1, count + 1), -60.0 * ones)


def traced(tx, rx, gain_db=-60.0, state=LinkState.NLOS):
    count = len(rx)
    return TracedLinks(
        tx=np.asarray(tx, dtype=float),
        rx=np.asarray(rx, dtype=float),
        link_state=np.full(count, state, dtype=np.uint8),
        gain_db=np.full(count, gain_db),
        path_tx=np.zeros(0, dtype=np.int32),
        path_rx=np.zeros(0, dtype=np.int32),
        a=np.zeros(0, dtype=complex),
        delay_s=np.zeros(0),
        departure_rad=np.zeros((0, 2)),
        arrival_rad=np.zeros((0, 2)),
        interactions=np.zeros((0, 6), dtype=np.uint8),
        vertices_m=np.zeros((0, 6, 3)),
        settings=TraceSettings(),
        scene_settings=SceneSettings(),
    )


@pytest.mark.parametrize(
    ("tx", "rx", "expected_m"),
    [
        ((1.5, 2.5, 1.5), (4.5, 2.5, 1.5), 0.0),
        ((1.5, 2.5, 1.5), (7.5, 2.5, 1.5), 2.5),
        ((6.5, 2.5, 1.5), (7.5, 2.5, 1.5), 1.0),
        ((1.5, 2.5, 1.5), (9.5, 2.5, 1.5), 4.0),
        ((3.5, 1.5, 1.5), (6.5, 3.5, 1.5), np.hypot(3, 2) / 2),
        ((3.0, 2.5, 0.5), (7.0, 2.5, 2.5), np.sqrt(20) / 2),
        ((6.5, 2.5, 0.5), (6.5, 2.5, 2.0), 1.5),
        ((2.5, 2.5, 0.5), (2.5, 2.5, 2.0), 0.0),
        ((6.5, 2.5, 1.5), (6.5, 2.5, 1.5), 0.0),
        ((0.0, 2.5, 1.5), (12.0, 2.5, 1.5), 6.0),
        ((-5.0, -1.0, 1.5), (12.0, -1.0, 1.5), 17.0),
        ((-5.0, 2.5, 1.5), (-3.0, 2.5, 1.5), 2.0),
    ],
    ids=str,
)
def test_length_by_hand(tx, rx, expected_m):
    assert unobserved_distance_m(HALF, tx, [rx]) == pytest.approx([expected_m], abs=1e-12)


def test_diagonal_through_corners_by_hand():
    chess = drawn("""
        ?.
        .?
    """)
    diagonal = [(2.0, 2.0, 1.0)], [(2.0, 0.0, 1.0)]
    assert unobserved_distance_m(chess, (0.0, 0.0, 1.0), diagonal[0]) == pytest.approx([0.0], abs=1e-9)
    assert unobserved_distance_m(chess, (0.0, 2.0, 1.0), diagonal[1]) == pytest.approx([np.sqrt(8)], abs=1e-5)


@pytest.mark.parametrize(
    ("below", "above", "expected_m"),
    [(".", "?", 0.0), ("?", ".", 0.0), ("#", "?", 1.0), ("?", "#", 1.0), ("#", "#", 0.0), ("?", "?", 1.0)],
)
@pytest.mark.parametrize("origin_m", [(0.0, 0.0), (0.1, 0.7)])
def test_segment_along_a_border_is_in_the_freest_cell(below, above, expected_m, origin_m):
    partial = drawn(f"?{above}?\n?{below}?", 0.1, origin_m)
    x, y = np.add(origin_m, (0.1, 0.1))
    found = unobserved_distance_m(partial, (x, y, 1.0), [(x + 0.1, y, 1.0)])
    assert found == pytest.approx([0.1 * expected_m], abs=1e-6)


def test_zero_everywhere_on_a_complete_map():
    room = drawn("""
        ?????
        ?###?
        ?#.#?
        ?###?
        ?????
    """)
    assert room.is_complete
    rx = np.array([(0.5, 0.5, 1.0), (2.5, 2.4, 1.0), (9.0, 9.0, 1.0)])
    assert unobserved_distance_m(room, (2.5, 2.5, 1.0), rx).tolist() == [0.0, 0.0, 0.0]


def test_everything_on_an_unknown_map():
    nothing = PartialMap(np.full((4, 6), CellState.UNKNOWN), 0.5)
    rx = np.random.default_rng(0).uniform(0.1, 1.9, (50, 3))
    distance_m = np.linalg.norm(rx - (0.3, 0.2, 1.0), axis=1)
    np.testing.assert_allclose(unobserved_distance_m(nothing, (0.3, 0.2, 1.0), rx), distance_m, rtol=1e-12)


def test_no_receivers():
    assert unobserved_distance_m(HALF, (1.5, 2.5, 1.5), np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    ("tx", "rx", "message"),
    [
        ((1.0, 2.0), [(1.0, 2.0, 3.0)], "tx has shape (2,): give x, y, z in metres, (3,)."),
        ((1.0, 2.0, 1.0), (1.0, 2.0, 3.0), "rx has shape (3,): give x, y, z in metres, (N, 3)."),
        ((1.0, np.nan, 1.0), [(1.0, 2.0, 3.0)], "tx holds a position that is not finite"),
        ((1.0, 2.0, 1.0), [(1.0, np.inf, 3.0)], "rx holds a position that is not finite"),
    ],
)
def test_bad_positions(tx, rx, message):
    with pytest.raises(PositionError, match=re.escape(message)):
        unobserved_distance_m(HALF, tx, rx)


grids = hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.integers(0, 2))
places = st.tuples(st.floats(-0.3, 1.3), st.floats(-0.3, 1.3), st.floats(0.0, 3.0))


def scaled(partial, place):
    """Return the world point of a place in fractions of the map."""
    x0, y0, x1, y1 = partial.bounds_m
    return np.array([x0 + place[0] * (x1 - x0), y0 + place[1] * (y1 - y0), place[2]])


@given(grids, places, places)
def test_between_zero_and_distance(state, start, end):
    partial = PartialMap(state, 0.3)
    tx, rx = scaled(partial, start), scaled(partial, end)
    length_m = unobserved_distance_m(partial, tx, rx[None])[0]
    assert 0.0 <= length_m <= np.linalg.norm(rx - tx)


@given(grids, places, places, st.data())
def test_revealing_cells_never_raises_it(state, start, end, data):
    seen = data.draw(hnp.arrays(np.uint8, state.shape, elements=st.sampled_from([0, 1, 2, 2])))
    revealed = np.where(state == CellState.UNKNOWN, seen, state)
    before, after = PartialMap(state, 0.3), PartialMap(revealed, 0.3)
    assume(not before.is_complete)
    tx, rx = scaled(before, start), scaled(before, end)[None]
    assert unobserved_distance_m(after, tx, rx)[0] <= unobserved_distance_m(before, tx, rx)[0] + 1e-9


@given(grids, places, places)
def test_same_both_ways(state, start, end):
    partial = PartialMap(state, 0.3)
    tx, rx = scaled(partial, start), scaled(partial, end)
    there = unobserved_distance_m(partial, tx, rx[None])
    assert unobserved_distance_m(partial, rx, tx[None]) == pytest.approx(there, abs=1e-5)


@given(grids, places, places)
def test_moving_the_map_changes_nothing(state, start, end):
    here, there = PartialMap(state, 0.25), PartialMap(state, 0.25, origin_m=(500_000.0, 4_500_000.0))
    tx, rx = scaled(here, start), scaled(here, end)
    shift = (500_000.0, 4_500_000.0, 0.0)
    moved = unobserved_distance_m(there, tx + shift, (rx + shift)[None])
    assert moved == pytest.approx(unobserved_distance_m(here, tx, rx[None]), abs=1e-5)


@settings(max_examples=30)
@given(grids, places, places)
def test_agrees_with_dense_samples(state, start, end):
    partial = PartialMap(state, 0.3)
    assume(not partial.is_complete)
    tx, rx = scaled(partial, start), scaled(partial, end)
    count = 4000
    samples = tx + (np.arange(count)[:, None] + 0.5) / count * (rx - tx)
    share = (partial.state_at(samples) == CellState.UNKNOWN).mean()
    distance_m = np.linalg.norm(rx - tx)
    crossings = sum(state.shape) + 2
    tolerance_m = crossings * distance_m / count + 1e-9
    assert unobserved_distance_m(partial, tx, rx[None])[0] == pytest.approx(share * distance_m, abs=tolerance_m)


def test_link_features():
    rx = np.array([(4.5, 2.5, 1.5), (7.5, 2.5, 1.5)])
    phi = link_features(HALF, traced((1.5, 2.5, 1.5), rx, -72.0))
    assert phi.link_state.dtype == np.uint8
    assert phi.link_state.tolist() == [LinkState.NLOS, LinkState.NLOS]
    assert phi.distance_m.tolist() == [3.0, 6.0]
    assert phi.unobserved_distance_m == pytest.approx([0.0, 2.5])
    assert phi.gain_db.tolist() == [-72.0, -72.0]


def test_link_features_of_no_links():
    assert len(link_features(HALF, traced((1.5, 2.5, 1.5), np.zeros((0, 3))))) == 0


def test_take_and_concatenate():
    phi = phi_of(3)
    assert phi.take(slice(1, 3)).distance_m.tolist() == [2.0, 3.0]
    assert phi.take(np.array([True, False, True])).distance_m.tolist() == [1.0, 3.0]
    joined = LinkFeatures.concatenate([phi.take(slice(0, 1)), phi.take(slice(1, 3))])
    for field in dataclasses.fields(phi):
        assert np.array_equal(getattr(joined, field.name), getattr(phi, field.name))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"link_state": [1, 1]}, "link_state has shape (2,): give one number for each of the 3 links."),
        ({"link_state": [1, 1, 3]}, "link_state[2] = 3 is not allowed: use LinkState: OUTAGE 0, LOS 1, NLOS 2."),
        ({"distance_m": [1.0, np.nan, 3.0]}, "distance_m[1] = nan is not allowed: give finite numbers."),
        ({"distance_m": [-1.0, 2.0, 3.0]}, "distance_m[0] = -1 is not allowed: a distance is not negative."),
        ({"distance_m": [[1.0, 2.0, 3.0]]}, "distance_m has shape (1, 3)"),
        ({"unobserved_distance_m": [0.5, 0.5, 3.5]}, "unobserved_distance_m[2] = 3.5 is not allowed: it lies between"),
        ({"unobserved_distance_m": [-0.5, 0.5, 0.5]}, "unobserved_distance_m[0] = -0.5 is not allowed"),
        ({"gain_db": [-60.0, -151.0, -60.0]}, "gain_db[1] = -151 is not allowed: clip gains at -150 dB"),
        ({"gain_db": ["x", "y", "z"]}, "gain_db = ['x', 'y', 'z'] is not numeric: give an array of 3 numbers."),
    ],
)
def test_bad_features(change, message):
    with pytest.raises(PredictorError, match=re.escape(message)):
        dataclasses.replace(phi_of(3), **change)


def test_nothing_to_concatenate():
    with pytest.raises(PredictorError, match="parts is empty: give at least one LinkFeatures"):
        LinkFeatures.concatenate([])


def test_swapped_arguments_are_named():
    with pytest.raises(MapError, match=r"partial is of type str: give a PartialMap, such as load_map returns\."):
        link_features("map.yaml", None)
