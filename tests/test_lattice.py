"""Staircases drawn as small plans, and what holds for every plan."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from extruded import drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.outlines import lattice_outlines
from sionna_partial.scene.scene import build_scene
from sionna_partial.settings import SceneSettings

Segment = tuple[tuple[float, float], ...]


def in_cells(partial: PartialMap) -> NDArray[np.float64]:
    """Segments (S, 2, 2) in cells."""
    outlines = lattice_outlines(partial)
    return np.round(outlines.vertices_m / partial.resolution_m, 6)[outlines.segments]


def segment_set(text: str) -> set[Segment]:
    return {tuple(sorted((x, y) for x, y in pair)) for pair in in_cells(drawn(text)).tolist()}


def path(*points: tuple[float, float]) -> set[Segment]:
    """Segments of a polyline."""
    return {tuple(sorted(pair)) for pair in pairwise(points)}


class TestDrawings:
    def test_a_straight_wall_is_one_segment_with_open_ends(self) -> None:
        assert segment_set("....... .#####. .......") == path((1.5, 1.5), (5.5, 1.5))
        assert segment_set("... .#. .#. .#. ...") == path((1.5, 1.5), (1.5, 3.5))

    def test_a_tilted_wall_is_its_stairs(self) -> None:
        stairs = path((1.5, 1.5), (3.5, 1.5), (3.5, 2.5), (5.5, 2.5))
        assert segment_set("....... ...###. .###... .......") == stairs

    def test_cells_that_touch_by_a_corner_are_joined(self) -> None:
        assert segment_set("....... ....##. .###... .......") == path((1.5, 1.5), (3.5, 1.5), (4.5, 2.5), (5.5, 2.5))
        assert segment_set("..... .#... ..#.. ...#. .....") == path((1.5, 3.5), (3.5, 1.5))

    def test_a_corner_that_touches_by_edges_has_no_diagonal(self) -> None:
        assert segment_set("##. #.. ...") == path((0.5, 1.5), (0.5, 2.5), (1.5, 2.5))

    def test_a_ring_is_closed(self) -> None:
        room = path((0.5, 0.5), (4.5, 0.5), (4.5, 3.5), (0.5, 3.5), (0.5, 0.5))
        assert segment_set("##### #...# #...# #####") == room
        assert segment_set(".#. #.# .#.") == path((0.5, 1.5), (1.5, 2.5), (2.5, 1.5), (1.5, 0.5), (0.5, 1.5))

    def test_walls_that_meet_share_a_vertex(self) -> None:
        arms = path((0.5, 2.5), (2.5, 2.5), (4.5, 2.5)) | path((2.5, 0.5), (2.5, 2.5))
        assert segment_set("##### ..#.. ..#..") == arms

    @pytest.mark.parametrize("rows", [2, 3, 5])
    def test_of_a_thick_wall_only_the_faces_are_left(self, rows: int) -> None:
        high = rows - 0.5
        assert segment_set("###### " * rows) == path((0.5, 0.5), (5.5, 0.5), (5.5, high), (0.5, high), (0.5, 0.5))

    def test_a_lone_cell_is_its_border(self) -> None:
        assert segment_set("... .#. ...") == path((1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 2.0), (1.0, 1.0))

    @pytest.mark.parametrize("gap", [".", "?"])
    def test_no_gap_is_bridged(self, gap: str) -> None:
        ends = path((1.5, 1.5), (2.5, 1.5)) | path((4.5, 1.5), (5.5, 1.5))
        assert segment_set(f"....... .##{gap}##. .......") == ends

    @pytest.mark.parametrize("state", [".", "?"])
    def test_without_walls_there_is_nothing(self, state: str) -> None:
        outlines = lattice_outlines(drawn(f"{state * 4} {state * 4}"))
        assert outlines.vertices_m.shape == (0, 2)
        assert outlines.segments.shape == (0, 2)


MAPS = st.tuples(st.integers(0, 2**32 - 1), st.integers(1, 20), st.integers(1, 20), st.floats(0.05, 0.9))


def random_map(seed: int, ny: int, nx: int, share: float) -> PartialMap:
    state = np.random.default_rng(seed).choice(3, (ny, nx), p=[(1 - share) / 2, share, (1 - share) / 2])
    return PartialMap(state.astype(np.uint8), 0.1)


@settings(max_examples=60, deadline=None)
@given(MAPS)
def test_segments_meet_only_at_shared_vertices(case: tuple[int, int, int, float]) -> None:
    outlines = lattice_outlines(random_map(*case))
    lines = shapely.linestrings(outlines.vertices_m[outlines.segments])
    assert set(outlines.segments.ravel().tolist()) == set(range(len(outlines.vertices_m)))
    for a, b in shapely.STRtree(lines).query(lines, predicate="intersects").T.tolist():
        if a < b:
            shared = set(outlines.segments[a].tolist()) & set(outlines.segments[b].tolist())
            assert len(shared) == 1
            assert shapely.intersection(lines[a], lines[b]).geom_type == "Point"


@settings(max_examples=60, deadline=None)
@given(MAPS)
def test_where_two_segments_meet_one_ends_the_other_begins_and_they_turn(case: tuple[int, int, int, float]) -> None:
    outlines = lattice_outlines(random_map(*case))
    count = len(outlines.vertices_m)
    begins, ends = (np.bincount(outlines.segments[:, side], minlength=count) for side in (0, 1))
    two = begins + ends == 2
    assert (begins[two] == 1).all()
    after, before = (np.argsort(outlines.segments[:, side], kind="stable") for side in (0, 1))
    along = np.diff(outlines.vertices_m[outlines.segments], axis=1)[:, 0]
    for vertex in np.flatnonzero(two):
        first = along[before[np.searchsorted(outlines.segments[before, 1], vertex)]]
        then = along[after[np.searchsorted(outlines.segments[after, 0], vertex)]]
        assert abs(first[0] * then[1] - first[1] * then[0]) > 1e-6


@settings(max_examples=60, deadline=None)
@given(MAPS)
def test_every_wall_cell_is_on_the_outline_or_deep_inside_and_no_other_is(case: tuple[int, int, int, float]) -> None:
    partial = random_map(*case)
    lines = shapely.multilinestrings(shapely.linestrings(in_cells(partial)))
    row, column = np.indices(partial.shape)
    distance = shapely.distance(lines, shapely.points(column + 0.5, row + 0.5))
    wall = np.pad(partial.state == CellState.WALL, 1)
    around = np.lib.stride_tricks.sliding_window_view(wall, (3, 3)).sum(axis=(2, 3))
    wall = wall[1:-1, 1:-1]
    assert distance[wall & (around > 1) & (around < 9)].max(initial=0.0) < 1e-9
    assert distance[wall & (around == 9)].min(initial=1.0) > 0.9
    assert distance[wall & (around == 1)].max(initial=0.5) == pytest.approx(0.5)
    if wall.any():
        assert distance[~wall].min(initial=1.0) > 0.49


def test_settings_choose_the_staircase() -> None:
    partial = drawn("......... ...####.. .###..... .........", resolution_m=0.05)
    lines, cells = build_scene(partial), build_scene(partial, SceneSettings(outline="cells"))
    expected = lattice_outlines(partial)
    np.testing.assert_array_equal(cells.vertices_m, expected.vertices_m)
    np.testing.assert_array_equal(cells.segments, expected.segments)
    assert (len(lines.segments), len(cells.segments)) == (1, 3)
    other = build_scene(partial, SceneSettings(outline="cells", outline_tolerance_cells=2.0, bridge_gap_m=1.0))
    np.testing.assert_array_equal(other.vertices_m, cells.vertices_m)
