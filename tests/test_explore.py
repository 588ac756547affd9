import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import OBSERVED, room, scene_mesh, surface_m2
from scipy.spatial.distance import pdist

from sionna_partial.constants import CellState
from sionna_partial.errors import MapError, SettingsError
from sionna_partial.maps.explore import CAMERA_RANGE_M, FORWARD_M, explore
from sionna_partial.maps.homes import make_home
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.mesh_map import MeshReading, cut_to_known, mesh_map
from sionna_partial.maps.partial_map import PartialMap

GIBSON = Path(__file__).resolve().parents[1] / ".." / "shared" / "gibson"

CLOSET = """
##################
#........##......#
#........##......#
#........##......#
#........##......#
#........#########
#........#########
#................#
#................#
#................#
##################
"""
"""A bent room, and a closet (upper right) without a door."""

STAIRS = """
#########
#.....###
#....##.#
#...##..#
#..##...#
#.##....#
###.....#
#########
"""
"""Two rooms on either side of a diagonal wall."""


def plan(text: str, resolution_m: float = 0.2) -> PartialMap:
    rows = text.split()[::-1]
    cells = {".": CellState.FREE, "#": CellState.WALL, "?": CellState.UNKNOWN}
    return PartialMap(np.array([[cells[c] for c in row] for row in rows], dtype=np.uint8), resolution_m)


def seen_free(partial: PartialMap) -> int:
    return int((partial.state == CellState.FREE).sum())


@settings(deadline=None, max_examples=15)
@given(home_seed=st.integers(0, 10**6), seed=st.integers(0, 10**6))
def test_what_is_seen_is_true_and_grows(home_seed, seed):
    home = make_home(home_seed, "apartment", resolution_m=0.1)
    before = np.full(home.shape, CellState.UNKNOWN)
    for partial in explore(home, (0, 1, 30, 60), seed):
        known = partial.state != CellState.UNKNOWN
        assert (partial.state[known] == home.state[known]).all()
        assert (partial.state[before != CellState.UNKNOWN] == before[before != CellState.UNKNOWN]).all()
        assert partial.interior_cells == home.interior_cells
        assert (partial.resolution_m, partial.origin_m) == (home.resolution_m, home.origin_m)
        before = partial.state


def test_meshes_are_cut_to_what_is_seen():
    home = mesh_map(scene_mesh(*room().geometry.values()), MeshReading(observed=OBSERVED))
    nothing, little, everything = explore(home, (0, 3, 200))
    assert len(nothing.mesh.triangles) == 0
    assert 0.0 < surface_m2(little.mesh) < surface_m2(everything.mesh) <= surface_m2(home.mesh) + 1e-6
    for partial in (nothing, little, everything):
        assert partial == cut_to_known(partial)
        assert partial.height_range_m == (0.0, 3.0)


def test_nothing_is_seen_before_the_first_step():
    (partial,) = explore(plan(CLOSET), (0,))
    assert (partial.state == CellState.UNKNOWN).all()
    assert partial.observed_fraction == 0.0


def test_one_step_sees_a_quarter_of_a_disc():
    hall = PartialMap(np.zeros((301, 301), dtype=np.uint8), 0.05)
    for seed in range(5):
        (partial,) = explore(hall, (1,), seed)
        rows, columns = np.nonzero(partial.state == CellState.FREE)
        spread_m = pdist(np.stack([rows, columns], axis=1)).max() * 0.05
        assert spread_m <= math.sqrt(2) * (CAMERA_RANGE_M + FORWARD_M) + 0.2
        assert len(rows) * 0.05**2 <= math.pi / 4 * CAMERA_RANGE_M**2 * 1.4


def test_view_has_no_gaps():
    """Cells well inside the cone of view are all seen, up to the range of the camera."""
    hall = PartialMap(np.zeros((301, 301), dtype=np.uint8), 0.05)
    (partial,) = explore(hall, (1,), seed=3)
    free = partial.state == CellState.FREE
    inside = free[1:-1, 1:-1]
    neighbours = [free[1:-1, :-2], free[1:-1, 2:], free[:-2, 1:-1], free[2:, 1:-1]]
    holes = ~inside & np.logical_and.reduce(neighbours)
    assert holes.sum() <= 0.001 * inside.sum()


def test_closed_closet_is_never_seen():
    home = plan(CLOSET)
    for seed in range(12):
        (partial,) = explore(home, (300,), seed)
        left, right = home.state.copy(), home.state.copy()
        left[:, 9:][4:] = right[:, :10] = CellState.WALL
        right[:4] = CellState.WALL
        seen = partial.state == CellState.FREE
        assert (seen & (right == CellState.FREE)).any() != (seen & (left == CellState.FREE)).any()


def test_diagonal_walls_are_tight():
    home = plan(STAIRS)
    lower_right = np.add.outer(-np.arange(8), np.arange(9)) > 1
    for seed in range(12):
        (partial,) = explore(home, (200,), seed)
        seen = partial.state == CellState.FREE
        assert (seen & lower_right).any() != (seen & ~lower_right).any()


def test_robot_sees_all_of_a_small_home_and_then_stays():
    home = plan(CLOSET.replace("#......#", "########"))
    for seed in range(6):
        maps = explore(home, (300, 301, 1000), seed)
        assert maps[0].observed_fraction > 0.99
        assert maps[1] == maps[0] == maps[2]


def test_unknown_cells_stay_unknown_and_stop_the_view():
    home = plan("\n".join(["###########", *["#....?....#"] * 6, "###########"]))
    for seed in range(6):
        (partial,) = explore(home, (100,), seed)
        assert (partial.state[:, 5][1:-1] == CellState.UNKNOWN).all()
        columns = np.nonzero((partial.state == CellState.FREE).any(axis=0))[0]
        assert (columns < 5).all() or (columns > 5).all()


@pytest.mark.parametrize("text", [".", "..", "#.#", ".#.\n#.#", "?.?"])
def test_tiny_homes_do_not_trap_the_simulator(text):
    (partial,) = explore(plan(text), (20,))
    assert 1 <= seen_free(partial) <= text.count(".")


def test_equal_seeds_give_equal_maps_and_others_differ():
    home = make_home(4)
    assert explore(home, (40,), 1) == explore(home, (40,), 1)
    assert explore(home, (40,), 1) != explore(home, (40,), 2)


def test_stages_do_not_depend_on_which_are_asked_for():
    home = make_home(5)
    assert explore(home, (20, 40, 60), 1)[1:] == explore(home, np.array([40, 60]), 1)


@pytest.mark.parametrize("steps", [(), (5, 5), (10, 5), (-1,), (1.5,), (True,), 50, None, (10**9,)])
def test_steps_must_increase(steps):
    with pytest.raises(
        SettingsError, match=r"steps = .* is not allowed: give increasing whole numbers of 0 to 100,000"
    ):
        explore(plan(CLOSET), steps)


@pytest.mark.parametrize("seed", [-1, 0.5, "1", False])
def test_seed_must_be_a_whole_number(seed):
    with pytest.raises(SettingsError, match=r"seed = .* is not allowed: give a whole number of 0 or more\."):
        explore(plan(CLOSET), seed=seed)


def test_home_must_be_a_map():
    with pytest.raises(MapError, match=r"home is of type str: give a PartialMap, such as load_map returns\."):
        explore("home.yaml")


def test_home_must_have_free_cells():
    with pytest.raises(MapError, match=r"home has 0 free cells: .* give a map with free cells\."):
        explore(plan("##\n?#"))


@pytest.mark.skipif(not GIBSON.is_dir(), reason="the real homes are not here")
def test_observed_fractions_on_real_homes():
    homes = [load_map(path) for path in sorted(GIBSON.glob("*/map.yaml"))]
    seen = [[partial.observed_fraction for partial in explore(home)] for home in homes]
    assert np.mean(seen, axis=0) == pytest.approx([0.30, 0.45, 0.55, 0.62], abs=0.07)
