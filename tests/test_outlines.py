"""Wall outlines: literal tiny maps, synthetic nasty maps, properties; and staircases."""

import functools
from itertools import pairwise

import extruded
import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from sionna_partial.constants import CellState
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.outlines import Outlines, lattice_outlines, wall_outlines
from sionna_partial.scene.scene import build_scene
from sionna_partial.settings import SceneSettings

drawn = functools.partial(extruded.drawn, resolution_m=0.05)


def in_cells(partial: PartialMap, outlines: Outlines) -> NDArray[np.float64]:
    return np.round(outlines.vertices_m / partial.resolution_m, 4)[outlines.segments]


def segment_set(partial: PartialMap, **options: float) -> set[tuple[tuple[float, ...], ...]]:
    pairs = in_cells(partial, wall_outlines(partial, **options))
    return {tuple(sorted(tuple(end) for end in pair.tolist())) for pair in pairs}


def path(*points: tuple[float, float]) -> set[tuple[tuple[float, ...], ...]]:
    return {tuple(sorted(pair)) for pair in pairwise(points)}


def ring(x0: float, y0: float, x1: float, y1: float) -> set[tuple[tuple[float, ...], ...]]:
    return path((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))


def tilted(angle_deg: float, thickness: float, phase: float = 0.0, gap: tuple[float, float] = (0.0, 0.0)) -> PartialMap:
    """A wall of 100 cells length in free space; thickness 0 gives an 8-connected, -1 a 4-connected staircase."""
    y, x = np.mgrid[:140, :140] + 0.5 - 70.0
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    along, across = x * cosine + (y - phase) * sine, -x * sine + (y - phase) * cosine
    half = {0.0: max(abs(cosine), abs(sine)) / 2, -1.0: (abs(cosine) + abs(sine)) / 2}.get(thickness, thickness / 2)
    wall = (across >= -half) & (across < half) & (abs(along) < 50) & ~((along >= gap[0]) & (along < gap[1]))
    return PartialMap(np.where(wall, CellState.WALL, CellState.FREE).astype(np.uint8), 0.05)


def noisy_plan(thickness: int, fraction: float, around: float, scale: int = 1, seed: int = 0) -> PartialMap:
    """A hall with three stubs; `fraction` of its face cells are lost, `around` of the cells beside are walls."""
    rng = np.random.default_rng(seed)
    ny, nx, y0, y1, x0, x1 = np.array([360, 560, 180, 240, 100, 280]) // scale
    wall = np.zeros((ny, nx), dtype=bool)
    wall[:, :thickness] = wall[:, -thickness:] = wall[:thickness] = wall[-thickness:] = True
    wall[:y0, x1 : x1 + thickness] = wall[y1:, x1 : x1 + thickness] = wall[y0 : y0 + thickness, :x0] = True
    wall = np.pad(wall, 20)
    lost = wall & ~ndimage.binary_erosion(wall) & (rng.random(wall.shape) < fraction)
    more = ndimage.binary_dilation(wall) & ~wall & (rng.random(wall.shape) < around)
    state = np.pad(np.full((ny, nx), CellState.FREE), 20, constant_values=CellState.UNKNOWN)
    state[wall] = CellState.FREE
    return PartialMap(np.where((wall & ~lost) | more, CellState.WALL, state).astype(np.uint8), 0.05)


def farthest_from_walls(partial: PartialMap, outlines: Outlines) -> float:
    row, column = np.nonzero(partial.state == CellState.WALL)
    pairs = in_cells(partial, outlines)
    fraction = np.linspace(0.0, 1.0, 401)[:, None, None]
    points = (pairs[:, 0] * (1 - fraction) + pairs[:, 1] * fraction).reshape(-1, 2)
    return float(cKDTree(np.stack([column, row], 1) + 0.5).query(points)[0].max())


def distances_from_outlines(partial: PartialMap, outlines: Outlines) -> NDArray[np.float64]:
    wall = partial.state == CellState.WALL
    row, column = np.nonzero(wall & ndimage.binary_dilation(partial.state == CellState.FREE))
    lines = shapely.multilinestrings(shapely.linestrings(in_cells(partial, outlines)))
    return np.asarray(shapely.distance(lines, shapely.points(column + 0.5, row + 0.5)))


def kept_regions(partial: PartialMap, outlines: Outlines, scale: int = 5) -> int:
    wall = partial.state == CellState.WALL
    drawing = np.zeros((partial.shape[0] * scale + 1, partial.shape[1] * scale + 1), dtype=bool)
    for start, end in in_cells(partial, outlines) * scale:
        count = int(3 * np.abs(end - start).max()) + 2
        column, row = np.rint(np.linspace(start, end, count)).astype(int).T
        drawing[row, column] = True
    row, column = np.nonzero(ndimage.distance_transform_edt(~wall) > 2.2)
    by_wall, by_line = ndimage.label(~wall)[0], ndimage.label(~ndimage.binary_dilation(drawing))[0]
    by_wall, by_line = by_wall[row, column], by_line[row * scale + scale // 2, column * scale + scale // 2]
    count = len(np.unique(by_wall))
    assert len(np.unique(np.stack([by_wall, by_line]), axis=1).T) == count
    return count


def lines_of(outlines: Outlines) -> int:
    lines = shapely.union_all(shapely.linestrings(outlines.vertices_m[outlines.segments]))
    return shapely.get_num_geometries(shapely.line_merge(lines))


def assert_sound(outlines: Outlines) -> None:
    """Every vertex is used, no segment is a point or twice there, none meets another away from a shared vertex."""
    vertices, segments = outlines.vertices_m, outlines.segments
    assert vertices.dtype == np.float64
    assert set(segments.ravel().tolist()) == set(range(len(vertices)))
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    assert (segments[:, 0] != segments[:, 1]).all()
    assert len(np.unique(np.sort(segments, axis=1), axis=0)) == len(segments)
    lines = shapely.linestrings(vertices[segments])
    first, second = shapely.STRtree(lines).query(lines, predicate="intersects")
    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        if a < b:
            shared = set(segments[a].tolist()) & set(segments[b].tolist())
            assert len(shared) == 1
            assert shapely.intersection(lines[a], lines[b]).geom_type == "Point"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param("........ .######. ........", path((1.5, 1.5), (6.5, 1.5)), id="thin wall"),
        pytest.param("... .#. ...", ring(1.0, 1.0, 2.0, 2.0), id="lone cell"),
        pytest.param("........ .######. .######. ........", path((1.5, 2.0), (6.5, 2.0)), id="two cells thick"),
        pytest.param("........ .######. .######. .######. ........", ring(1.5, 1.5, 6.5, 3.5), id="thick wall"),
        pytest.param(
            "??????????? ??##?#####? ??#######?? ...........", path((2.0, 1.5), (9.0, 1.5)), id="seen at one face"
        ),
        pytest.param("???????? ?######? ?######? ?######? ????????", ring(1.5, 1.5, 6.5, 3.5), id="seen from nowhere"),
        pytest.param("......... ....#.... .#######. .........", path((1.5, 1.5), (7.5, 1.5)), id="spur of one cell"),
        pytest.param("............. .#?#?#?#?#?#. ?????????????", path((1.5, 1.5), (11.5, 1.5)), id="dotted"),
        pytest.param(".......... ..####???? ??????????", path((2.5, 1.5), (6.0, 1.5)), id="open end and jamb"),
        pytest.param("............. .#####?#####. .............", path((1.5, 1.5), (11.5, 1.5)), id="unseen gap"),
        pytest.param(".............. .#####..#####. ..............", path((1.5, 1.5), (12.5, 1.5)), id="short gap"),
        pytest.param(
            "....... .#####. ...#... ...#... ...#...",
            path((1.5, 3.5), (3.5, 3.5), (5.5, 3.5)) | path((3.5, 0.0), (3.5, 3.5)),
            id="walls that meet",
        ),
        pytest.param(
            "???????????????? ??####????####?? ......????...... .......??....... ................",
            path((2.0, 3.5), (14.0, 3.5)),
            id="gap before unknown cells",
        ),
    ],
)
def test_drawings(text: str, expected: set[tuple[tuple[float, ...], ...]]) -> None:
    assert segment_set(drawn(text)) == expected


def test_tolerance_zero_keeps_every_corner() -> None:
    partial = drawn("......... ....####. .####.... .........")
    assert segment_set(partial, tolerance_cells=0.0) == path((1.5, 1.5), (4.5, 1.5), (4.5, 2.5), (7.5, 2.5))
    assert len(segment_set(partial, tolerance_cells=0.5)) == 1


def met_by_rays(partial: PartialMap) -> PartialMap:
    """Leave out the cells of walls that no ray from a FREE cell meets: a lidar that was everywhere has the others."""
    met = ndimage.binary_dilation(partial.state == CellState.FREE)
    state = np.where((partial.state == CellState.WALL) & ~met, CellState.UNKNOWN, partial.state)
    return PartialMap(state.astype(np.uint8), partial.resolution_m)


@pytest.mark.parametrize("angle_deg", [0, 17])
def test_what_no_ray_meets_makes_no_difference(angle_deg: float) -> None:
    """Deep walls around a room, and a pillar in it with rounded corners, some of which are aslant."""
    y, x = np.mgrid[:120, :160] + 0.5
    wall = np.hypot(np.maximum(abs(x - 110) - 18, 0), np.maximum(abs(y - 60) - 18, 0)) < 1.0
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    wall |= np.maximum(abs((x - 50) * cosine + (y - 60) * sine), abs((y - 60) * cosine - (x - 50) * sine)) < 20
    wall |= (x < 10) | (x > 150) | (y < 10) | (y > 110)
    whole = PartialMap(np.where(wall, CellState.WALL, CellState.FREE).astype(np.uint8), 0.1)
    seen = met_by_rays(whole)
    assert (seen.state == CellState.UNKNOWN).any()
    assert segment_set(seen) == segment_set(whole)
    assert segment_set(whole) >= ring(9.5, 9.5, 150.5, 110.5)


@pytest.mark.parametrize(
    "text",
    [
        "...... ####.. ....#. ....#. ....#.",
        "???????????? ???????????# .......##### ......?..... .######..... ............",
        "???????????? ?#########?? .........?#? ..........#? ..........#? ..........#?",
    ],
    ids=["diagonal joint", "unseen step", "unseen corner"],
)
def test_joints_are_closed(text: str) -> None:
    partial = drawn(text)
    outlines = wall_outlines(partial, bridge_gap_m=0.1)
    assert lines_of(outlines) == 1


@pytest.mark.parametrize(
    ("row", "resolution_m", "bridge_gap_m", "left", "right"),
    [
        (".#####???#####.", 0.05, 0.1, 6.0, 9.0),
        (".#####...#####.", 0.05, 0.5, 5.5, 9.5),
        (".#####.#####.", 0.2, 0.5, 5.5, 7.5),
        (".#####?#####.", 0.05, 0.0, 6.0, 7.0),
        (".#####????.#####.", 0.05, 0.5, 6.0, 11.5),
    ],
)
def test_opening_stays_whole(row: str, resolution_m: float, bridge_gap_m: float, left: float, right: float) -> None:
    """A gap that is too long, or across which FREE cells were seen; where it is unknown, walls reach its border."""
    partial = drawn(f"{'.' * len(row)} {row} {'.' * len(row)}", resolution_m=resolution_m)
    expected = path((1.5, 1.5), (left, 1.5)) | path((right, 1.5), (len(row) - 1.5, 1.5))
    assert segment_set(partial, bridge_gap_m=bridge_gap_m) == expected


@pytest.mark.parametrize("cells", [5, 6])
def test_gap_that_no_ray_passed_is_closed_up_to_half_a_metre(cells: int) -> None:
    wall = f"....####{'?' * cells}####...."
    partial = drawn(f"{'?' * len(wall)} {wall} {'.' * len(wall)}", resolution_m=0.1)
    assert len(wall_outlines(partial).segments) == (1 if cells <= 5 else 2)


def test_unobserved_regions_become_no_walls() -> None:
    rows = ["#" * 34, "." * 32 + "??", "." * 8 + "?" * 7 + "." * 17 + "??", "." * 5 + "#" + "?" * 12 + "." * 14 + "??"]
    partial = drawn("\n".join(rows[index] for index in (0, 1, 1, 2, 3, 2, 1, 1, 0)), resolution_m=0.1)
    outlines = wall_outlines(partial)
    assert len(outlines.segments) == 6
    assert farthest_from_walls(partial, outlines) < 0.8


@pytest.mark.parametrize(("angle_deg", "thickness"), [(17, -1.0), (73, 0.0)])
def test_gap_of_a_tilted_wall_is_closed_and_a_door_is_not(angle_deg: float, thickness: float) -> None:
    sampled = tilted(angle_deg, thickness)
    state = sampled.state.copy()
    middle = 70
    rows, columns = np.nonzero(state == CellState.WALL)
    position = columns if angle_deg <= 45 else rows
    state[rows[position == middle], columns[position == middle]] = CellState.UNKNOWN
    assert len(wall_outlines(PartialMap(state, 0.05)).segments) == 1
    door = wall_outlines(tilted(angle_deg, thickness, gap=(-4.0, 4.0)))
    ends = in_cells(sampled, door)
    assert len(ends) == 2
    nearest = np.abs((ends.reshape(-1, 2) - 70) @ [np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))]).min()
    assert nearest > 3.0


@pytest.mark.parametrize(("angle_deg", "thickness"), [(3, -1.0), (45, 0.0), (60, -1.0), (87, 0.0)])
def test_staircase_of_a_tilted_wall_is_one_line(angle_deg: float, thickness: float) -> None:
    for phase in (0.11, 0.8):
        partial = tilted(angle_deg, thickness, phase)
        outlines = wall_outlines(partial)
        assert len(outlines.segments) == 1
        start, end = in_cells(partial, outlines)[0] - 70
        found = np.degrees(np.arctan2(end[1] - start[1], end[0] - start[0]))
        assert abs((found - angle_deg + 90) % 180 - 90) < 0.6
        assert 97 < np.hypot(*(end - start)) < 101
        assert distances_from_outlines(partial, outlines).max() < 0.8


@pytest.mark.parametrize(
    ("thickness", "fraction", "around", "most"),
    [(1, 0.0, 0.3, 26), (4, 0.05, 0.05, 24), (4, 0.15, 0.15, 110)],
)
def test_noisy_walls_have_few_segments(thickness: int, fraction: float, around: float, most: int) -> None:
    partial = noisy_plan(thickness, fraction, around)
    outlines = wall_outlines(partial)
    assert_sound(outlines)
    assert 8 <= len(outlines.segments) <= most
    assert kept_regions(partial, outlines, scale=3) > 0
    assert farthest_from_walls(partial, outlines) < 2.0


@pytest.mark.parametrize(("before", "behind", "noise"), [(0.0, 0.0, 0.0), (0.0, 0.03, 0.1), (0.7, 0.8, 0.5)])
def test_outlines_are_in_the_middle_of_noisy_walls(before: float, behind: float, noise: float) -> None:
    """Range noise fills cells before and behind a wall; single cells behind straight walls are its first sign."""
    rng = np.random.default_rng(1)
    state = np.full((320, 420), CellState.UNKNOWN)
    for margin, fraction in ((9, behind), (10, 1.0), (11, before)):
        inside = state[margin:-margin, margin:-margin]
        inside[rng.random(inside.shape) < fraction] = CellState.WALL
        inside[1:-1, 1:-1] = CellState.FREE
    partial = PartialMap(state.astype(np.uint8), 0.05)
    near = partial.noise_near(np.array([[2.0, 2.0], [10.0, 15.0]]))
    assert (near >= noise).all()
    assert near.any() == (noise > 0.0)
    walls = shapely.LinearRing([[10.5, 10.5], [409.5, 10.5], [409.5, 309.5], [10.5, 309.5]])
    lines = shapely.multilinestrings(shapely.linestrings(in_cells(partial, wall_outlines(partial))))
    assert shapely.distance(lines, shapely.points(shapely.segmentize(walls, 1.0).coords)).mean() < 0.25


def test_outlines_depend_on_the_cells_around_them() -> None:
    """Rough, noisy walls from 11.5 m on move the ends of walls that begin within 5 m by less than a millimetre."""
    rng = np.random.default_rng(4)
    calm = noisy_plan(2, 0.02, 0.02, scale=2, seed=1).state[:230, :230]
    rough = np.where(rng.random(calm.shape) < 0.2, CellState.WALL, calm).astype(np.uint8)
    beside, alone = (PartialMap(np.hstack([calm, *more]), 0.05) for more in ([np.roll(rough, 5, 0)], []))
    here, there = (wall_outlines(partial) for partial in (alone, beside))
    lines = shapely.multilinestrings(shapely.linestrings(there.vertices_m[there.segments]))
    near = here.vertices_m[here.vertices_m[:, 0] < 5.0]
    assert len(near) == 4
    assert shapely.distance(lines, shapely.points(near)).max() < 1e-3


@pytest.mark.parametrize("angle_deg", [0, 7, 20, 45])
@pytest.mark.parametrize("thickness", [1.5, 4.0])
def test_wall_noise_is_of_cells_that_stick_out_of_straight_walls(angle_deg: float, thickness: float) -> None:
    """Walls of plans may be deep and tilted, without noise, also where a doorway leads to the unknown."""
    rng, angle = np.random.default_rng(1), np.radians(angle_deg)
    y, x = np.mgrid[:300, :300] - 149.7
    across = np.maximum(abs(x * np.cos(angle) + y * np.sin(angle)), abs(y * np.cos(angle) - x * np.sin(angle))) - 90.0
    state = np.select([across < 0.0, across < thickness], [CellState.FREE, CellState.WALL], CellState.UNKNOWN)
    state[(abs(x) < 8) & (state == CellState.WALL)] = CellState.FREE
    found = []
    for fraction in (0.0, 0.03, 0.1):
        noisy = (across >= -1.0) & (across < thickness + 1.0) & (rng.random(state.shape) < fraction)
        partial = PartialMap(np.where(noisy, CellState.WALL, state).astype(np.uint8), 0.05)
        near = partial.noise_near(cell_centres_m(partial, np.argwhere(state == CellState.FREE)))
        found.append((near.mean(), near.max()))
    assert max(found[0]) == 0.0
    assert np.min(found[1:]) > 0.2


def test_noise_near_is_local_continuous_and_turns_and_moves_with_the_map() -> None:
    """A corridor of 40 m whose walls are noisy in one half alone."""
    rng = np.random.default_rng(2)
    state = np.full((60, 800), CellState.UNKNOWN, dtype=np.uint8)
    state[10:-10, 10:-10] = CellState.WALL
    state[9:-9, 10:400][rng.random((42, 390)) < 0.3] = CellState.WALL
    state[11:-11, 11:-11] = CellState.FREE
    partial = PartialMap(state, 0.05)
    points_m = np.column_stack([np.linspace(1.0, 39.0, 1000), np.full(1000, 1.7)])
    noise = partial.noise_near(points_m)
    assert noise[:300].min() > 0.6
    assert (noise[-300:] == 0.0).all()
    assert np.abs(np.diff(noise)).max() < 0.03
    for transpose, rows, columns in SYMMETRIES:
        turned = PartialMap(transformed(state, transpose, rows, columns), 0.05, (-3.21, 1e3))
        there_m = transformed_points(points_m / 0.05, state.shape, transpose, rows, columns) * 0.05 + turned.origin_m
        np.testing.assert_allclose(turned.noise_near(there_m), noise, rtol=0, atol=1e-9)
    padded = PartialMap(np.pad(state, ((3, 8), (40, 2)), constant_values=CellState.UNKNOWN), 0.05, (-2.0, -0.15))
    np.testing.assert_allclose(padded.noise_near(points_m), noise, rtol=0, atol=1e-9)


def test_niche_of_a_clean_wall_stays() -> None:
    wall = np.zeros((12, 70), dtype=bool)
    wall[2:7, 5:65] = True
    wall[5:7, 30:40] = False
    partial = PartialMap(np.where(wall, CellState.WALL, CellState.FREE).astype(np.uint8), 0.05)
    pairs = in_cells(partial, wall_outlines(partial))
    assert len(pairs) == 8
    assert (np.abs(pairs[:, 0] - pairs[:, 1]).min(axis=1) == 0).all()


def transformed(state: NDArray[np.uint8], transpose: bool, rows: int, columns: int) -> NDArray[np.uint8]:
    return np.ascontiguousarray((state.T if transpose else state)[::rows, ::columns])


def transformed_points(
    points: NDArray[np.float64], shape: tuple[int, ...], transpose: bool, rows: int, columns: int
) -> NDArray[np.float64]:
    turned = points[:, ::-1] if transpose else points
    height, width = shape[::-1] if transpose else shape
    return np.where([columns < 0, rows < 0], [width, height] - turned, turned)


SYMMETRIES = [
    (transpose, rows, columns)
    for transpose in (False, True)
    for rows in (1, -1)
    for columns in (1, -1)
    if (transpose, rows, columns) != (False, 1, 1)
]
ORIENTATIONS = st.tuples(st.booleans(), st.sampled_from([1, -1]), st.sampled_from([1, -1]))


def random_state(seed: int, kind: str) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    if kind == "cells":
        walls = rng.uniform(0.05, 0.7)
        return rng.choice(3, rng.integers(1, 22, 2), p=[0.6 * (1 - walls), walls, 0.4 * (1 - walls)]).astype(np.uint8)
    lost, more = rng.choice([0.0, 0.1, 0.3], 2)
    state = noisy_plan(int(rng.integers(1, 5)), lost, more, 4, seed).state.copy()
    hidden = ndimage.zoom(rng.random((23, 23)), 8, order=1)[: state.shape[0], : state.shape[1]] < 0.4
    state[hidden] = CellState.UNKNOWN
    return state


@settings(max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(["cells", "rooms"]),
    ORIENTATIONS,
    st.floats(-1e7, 1e7),
    st.tuples(*[st.integers(0, 5)] * 4),
)
def test_outlines_turn_and_move_with_the_map(
    seed: int, kind: str, orientation: tuple[bool, int, int], origin: float, padding: tuple[int, int, int, int]
) -> None:
    state = random_state(seed, kind)
    assume(not any(np.array_equal(transformed(state, *other), state) for other in SYMMETRIES))
    here = wall_outlines(PartialMap(state, 0.05))
    below, above, left, right = padding
    padded = np.pad(
        transformed(state, *orientation), ((below, above), (left, right)), constant_values=CellState.UNKNOWN
    )
    there = wall_outlines(PartialMap(padded, 0.05, (origin, -origin)))
    expected = transformed_points(here.vertices_m / 0.05, state.shape, *orientation)
    np.testing.assert_allclose(there.vertices_m / 0.05 - [left, below], expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(there.segments, here.segments)
    assert_sound(here)
    if kind == "cells" and len(here.segments):
        longest_gap, tolerance = 0.5 / 0.05, 1.5
        assert farthest_from_walls(PartialMap(state, 0.05), here) < longest_gap + tolerance


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param(
            "....... ....##. .###... .......", path((1.5, 1.5), (3.5, 1.5), (4.5, 2.5), (5.5, 2.5)), id="corner touch"
        ),
        pytest.param("##. #.. ...", path((0.5, 1.5), (0.5, 2.5), (1.5, 2.5)), id="no diagonal where edges touch"),
        pytest.param(".#. #.# .#.", path((0.5, 1.5), (1.5, 2.5), (2.5, 1.5), (1.5, 0.5), (0.5, 1.5)), id="diamond"),
        pytest.param(
            "##### ..#.. ..#..", path((0.5, 2.5), (2.5, 2.5), (4.5, 2.5)) | path((2.5, 0.5), (2.5, 2.5)), id="junction"
        ),
        pytest.param("###### ###### ######", ring(0.5, 0.5, 5.5, 2.5), id="thick"),
    ],
)
def test_staircases(text: str, expected: set[tuple[tuple[float, ...], ...]]) -> None:
    partial = drawn(text)
    pairs = in_cells(partial, lattice_outlines(partial)).tolist()
    assert {tuple(sorted((x, y) for x, y in pair)) for pair in pairs} == expected


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_where_two_segments_meet_one_ends_and_the_other_begins(seed: int) -> None:
    outlines = lattice_outlines(PartialMap(random_state(seed, "cells"), 0.1))
    assert_sound(outlines)
    count = len(outlines.vertices_m)
    begins, ends = (np.bincount(outlines.segments[:, side], minlength=count) for side in (0, 1))
    two = begins + ends == 2
    assert (begins[two] == 1).all()


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_every_wall_cell_is_on_the_outline_or_deep_inside_and_no_other_is(seed: int) -> None:
    partial = PartialMap(random_state(seed, "cells"), 0.1)
    lines = shapely.multilinestrings(shapely.linestrings(in_cells(partial, lattice_outlines(partial))))
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
    other = build_scene(partial, SceneSettings(outline="cells", bridge_gap_m=1.0))
    np.testing.assert_array_equal(other.vertices_m, cells.vertices_m)
