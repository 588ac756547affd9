"""How much of segments runs through unknown cells: by hand, in exact fractions, and by its properties."""

from fractions import Fraction
from itertools import pairwise, product

import numpy as np
import pytest
from extruded import HALF, drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.unobserved import line_fractions, unobserved_lengths_m

FREE, WALL, UNKNOWN = (int(state) for state in (CellState.FREE, CellState.WALL, CellState.UNKNOWN))


def length_m(partial, start, end):
    return unobserved_lengths_m(partial, np.array([start], dtype=float), np.array([end], dtype=float))[0]


@pytest.mark.parametrize(
    ("start", "end", "expected_m"),
    [
        ((1.5, 2.5, 1.5), (7.5, 2.5, 1.5), 2.5),
        ((3.0, 2.5, 0.5), (7.0, 2.5, 2.5), np.sqrt(20) / 2),
        ((6.5, 2.5, 0.5), (6.5, 2.5, 2.0), 1.5),
        ((0.0, 2.5, 1.5), (12.0, 2.5, 1.5), 6.0),
        ((-5.0, -1.0, 1.5), (12.0, -1.0, 1.5), 17.0),
    ],
    ids=str,
)
def test_length_by_hand(start, end, expected_m):
    assert length_m(HALF, start, end) == pytest.approx(expected_m, abs=1e-12)


@pytest.mark.parametrize(("below", "above", "expected_m"), [(".", "?", 0.0), ("#", "?", 1.0), ("#", "#", 0.0)])
def test_segment_along_a_border_is_in_the_freest_cell(below, above, expected_m):
    origin_m, ends = (0.1, 0.7), np.array([[0.1, 0.1], [0.2, 0.1]])
    for first, second in ((below, above), (above, below)):
        flat = drawn(f"?{second}?\n?{first}?", resolution_m=0.1, origin_m=origin_m)
        for partial, ends_m in ((flat, ends), (PartialMap(flat.state.T, 0.1, origin_m), ends[:, ::-1])):
            found = length_m(partial, *np.column_stack([ends_m + origin_m, [1.0, 1.0]]))
            assert found == pytest.approx(0.1 * expected_m, abs=1e-6)


def test_many_segments_are_measured_as_few():
    """By several threads."""
    starts, ends = np.random.default_rng(2).uniform(-1.0, 11.0, (2, 50_000, 2))
    blocks = [line_fractions(HALF.state, *each) for each in zip(np.split(starts, 10), np.split(ends, 10), strict=True)]
    np.testing.assert_array_equal(line_fractions(HALF.state, starts, ends), np.concatenate(blocks))


grids = hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.integers(0, 2))
thousandths = st.integers(-2_000, 11_000) | st.integers(-2, 11).map(lambda cells: 1_000 * cells)
cells = st.tuples(thousandths, thousandths)
"""Places in thousandths of a cell, many of them on the border of cells."""


def shares(state, *pairs):
    """Return the unknown fraction of segments between positions in thousandths of a cell."""
    starts, ends = (np.array(positions) / 1_000 for positions in zip(*pairs, strict=True))
    return line_fractions(state, starts, ends)[:, CellState.UNKNOWN]


def is_unknown(state, x, y):
    """Whether the freest of the cells that hold a point is unknown."""
    columns, rows = ({value.__floor__(), value.__ceil__() - 1} for value in (x, y))
    ny, nx = state.shape
    inside = product(rows, columns)
    found = {int(state[row, column]) if 0 <= row < ny and 0 <= column < nx else UNKNOWN for row, column in inside}
    return FREE not in found and UNKNOWN in found


def exact_fraction(state, start, end):
    """Return the unknown fraction of a segment in exact fractions: between two grid lines it is in one cell."""
    positions = [Fraction(position, 1_000) for position in start]
    steps = [Fraction(there - here, 1_000) for here, there in zip(start, end, strict=True)]
    met = {Fraction(0), Fraction(1)}
    for position, step in zip(positions, steps, strict=True):
        met |= {(line - position) / step for line in range(-3, 13) if step}
    fraction = Fraction(0)
    for here, there in pairwise(sorted(each for each in met if 0 <= each <= 1)):
        if is_unknown(state, *(at + (here + there) / 2 * step for at, step in zip(positions, steps, strict=True))):
            fraction += there - here
    return float(fraction)


class TestWalls:
    @given(st.data())
    def test_what_is_known_and_outside_is_no_wall(self, data):
        """Not a rounding of it: any length at all is a feature of the networks."""
        state = data.draw(hnp.arrays(np.uint8, (3, 4), elements=st.sampled_from([FREE, UNKNOWN])))
        start, end = (np.array([data.draw(cells)]) / 1_000 for _ in range(2))
        assert line_fractions(state, start, end)[:, CellState.WALL] == 0.0


@settings(max_examples=200)
@given(grids, cells, cells)
def test_exact(state, start, end):
    assert shares(state, (start, end))[0] == pytest.approx(exact_fraction(state, start, end), abs=1e-9)


positions = st.tuples(st.floats(-0.3, 1.3), st.floats(-0.3, 1.3), st.floats(0.0, 3.0))


def scaled(partial, position):
    """Return the world point of a position in fractions of the map."""
    x0, y0, x1, y1 = partial.bounds_m
    return np.array([x0 + position[0] * (x1 - x0), y0 + position[1] * (y1 - y0), position[2]])


@given(grids, positions, positions, st.data())
def test_between_zero_and_length_and_never_raised_by_revealing_cells(state, start, end, data):
    seen = data.draw(hnp.arrays(np.uint8, state.shape, elements=st.sampled_from([FREE, WALL, UNKNOWN, UNKNOWN])))
    before, after = PartialMap(state, 0.3), PartialMap(np.where(state == CellState.UNKNOWN, seen, state), 0.3)
    start_m, end_m = scaled(before, start), scaled(before, end)
    length_before_m = length_m(before, start_m, end_m)
    assert 0.0 <= length_before_m <= np.nextafter(np.linalg.norm(end_m - start_m), np.inf)
    assert before.is_complete or length_m(after, start_m, end_m) <= length_before_m + 1e-9
