import functools
from typing import get_args

import numpy as np
import pytest
from extruded import drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import OBSERVED, room, scene_mesh, surface_m2
from small_maps import HOUSE, VACUUM

from sionna_partial.constants import CellState
from sionna_partial.errors import SettingsError, SionnaPartialError
from sionna_partial.exploration.explore import Exploration, explore, explore_trajectory
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.mesh.cells import MeshReading, cut_to_known, mesh_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.wall_cells import LEAST_NOISE
from sionna_partial.settings import Fusion, SensorSettings
from sionna_partial.worlds.homes import make_home
from sionna_partial.worlds.robot import FORWARD_M, TURN_DEG

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


plan = functools.partial(drawn, resolution_m=0.2)
NOISY = SensorSettings(0.05, 0.02, 0.1)


@pytest.fixture(scope="module")
def home() -> PartialMap:
    return make_home(4, "apartment")


@pytest.fixture(scope="module")
def exploration(home: PartialMap) -> Exploration:
    return explore_trajectory(home, (0, 30, 60), 3)


@settings(deadline=None, max_examples=8)
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
    assert little == cut_to_known(little)
    assert little.height_range_m == (0.0, 3.0)


def test_closed_closet_is_never_seen():
    home = plan(CLOSET)
    for seed in range(6):
        (partial,) = explore(home, (300,), seed)
        left, right = home.state.copy(), home.state.copy()
        left[:, 9:][4:] = right[:, :10] = CellState.WALL
        right[:4] = CellState.WALL
        seen = partial.state == CellState.FREE
        assert (seen & (right == CellState.FREE)).any() != (seen & (left == CellState.FREE)).any()


def test_robot_sees_all_of_a_small_home_and_then_stays():
    home = plan(CLOSET.replace("#......#", "########"))
    for seed in range(3):
        found = explore_trajectory(home, (300, 301, 1000), seed)
        maps = found.maps
        assert maps[0].observed_fraction > 0.99
        assert maps[1] == maps[0] == maps[2]
        assert (found.poses[-500:] == found.poses[-1]).all()


@pytest.mark.parametrize("door_cells", [10, 4])
def test_narrow_doors_take_a_slim_robot(door_cells):
    state = np.full((40, 83), CellState.WALL, dtype=np.uint8)
    state[1:-1, 1:41] = state[1:-1, 42:-1] = state[10 : 10 + door_cells, 41] = CellState.FREE
    (partial,) = explore(PartialMap(state, 0.05), (400,), 0)
    assert partial.observed_fraction > 0.9


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
    assert 1 <= (partial.state == CellState.FREE).sum() <= text.count(".")


@pytest.mark.parametrize("sensor", [None, NOISY], ids=["exact", "noisy"])
def test_equal_seeds_give_equal_explorations_and_others_differ(home, sensor):
    first, again, other = (explore_trajectory(home, (60,), seed, sensor=sensor) for seed in (3, 3, 4))
    assert first.states.tobytes() == again.states.tobytes() != other.states.tobytes()
    assert first.believed_poses.tobytes() == again.believed_poses.tobytes()


@pytest.mark.parametrize("sensor", [None, NOISY], ids=["exact", "noisy"])
def test_stages_do_not_depend_on_which_are_asked_for(home, sensor):
    assert explore(home, (20, 40, 60), 3, sensor=sensor)[1:] == explore(home, np.array([40, 60]), 3, sensor=sensor)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(
            ({"steps": steps}, "give increasing whole numbers of 0 to 100,000")
            for steps in ((5, 5), (1.5,), 50, (10**9,))
        ),
        *(({"steps": steps}, r"fractions of the free area in \[0, 1\]") for steps in ((0.5, 0.25), (0.5, 1.5))),
        ({"seed": -1}, r"seed = -1 is not allowed: give a whole number of 0 or more\."),
        ({"policy": "haste"}, "policy = 'haste' is not allowed: choose one of random, coverage"),
        ({"policy": "coverage", "tx": (99.0, 0.0)}, "tx = .* is outside the map"),
        ({"sensor": 0.1}, r"sensor = 0\.1 is not allowed: give SensorSettings\(\.\.\.\), or None"),
        ({"home": "home.yaml"}, r"home is of type str: give a PartialMap, such as load_map returns\."),
        ({"home": plan("##\n?#")}, r"home has 0 free cells: .* give a map with free cells\."),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(SionnaPartialError, match=message):
        explore(**{"home": plan(CLOSET), **arguments})


@pytest.mark.parametrize(("path", "expected"), [(HOUSE, [0.10, 0.18, 0.26]), (VACUUM, [0.49, 0.53, 0.74])])
def test_observed_fractions_on_cluttered_homes(path, expected):
    seen = [partial.observed_fraction for partial in explore(load_map(path), (50, 100, 200), seed=0)]
    assert seen == pytest.approx(expected, abs=0.05)


class TestFractions:
    def test_each_is_reached_and_not_long_before(self, home):
        exploration = explore_trajectory(home, (0, 0.5), 3)
        assert exploration.steps[0] == 0
        assert (
            exploration.observed_fractions[1]
            >= 0.5
            > explore(home, (exploration.steps[1] - 1,), 3)[0].observed_fraction
        )
        assert exploration.maps == explore(home, exploration.steps, 3)

    def test_what_cannot_be_seen_is_given_up(self):
        exploration = explore_trajectory(plan(CLOSET), (0.1, 0.99), 0)
        assert exploration.observed_fractions[1] < 0.99
        assert len(exploration.poses) == exploration.steps[1] + 1 < 2000


class TestTrajectory:
    def test_it_is_the_trajectory_of_explore(self, home, exploration):
        assert exploration.maps == explore(home, (0, 30, 60), 3)
        assert exploration.steps == (0, 30, 60)
        fractions = [partial.observed_fraction for partial in exploration.maps]
        assert exploration.observed_fractions.tolist() == pytest.approx(fractions, abs=1e-12)

    def test_each_action_is_a_turn_or_a_move_and_not_both(self, exploration):
        moved_m = np.hypot(*np.diff(exploration.poses[:, :2], axis=0).T)
        turned_deg = (np.diff(exploration.poses[:, 2]) + 180.0) % 360.0 - 180.0
        assert len(exploration.poses) == 61
        assert (moved_m <= FORWARD_M + 1e-9).all()
        assert (np.isclose(np.abs(turned_deg), TURN_DEG) | (turned_deg == 0)).all()
        assert ((moved_m == 0) | (turned_deg == 0)).all()
        assert (moved_m > 0).sum() > 10

    def test_the_robot_is_on_free_cells_and_knows_it(self, home, exploration):
        assert (home.state_at(exploration.poses[:, :2]) == CellState.FREE).all()
        assert (exploration.maps[-1].state_at(exploration.poses[:, :2]) == CellState.FREE).all()
        assert np.array_equal(exploration.poses, exploration.believed_poses)

    def test_some_of_the_moments(self, home, exploration):
        some = exploration.at([30])
        assert (some.steps, some.maps) == ((30,), exploration.maps[1:2])
        assert np.array_equal(some.poses, explore_trajectory(home, (30,), 3).poses)
        assert len(some.believed_poses) == 31
        for steps in ((), (30, 31)):
            with pytest.raises(SettingsError, match=r"steps = .* is not allowed: choose from the steps that were kept"):
                exploration.at(steps)


class TestSensor:
    def test_wall_noise_grows_with_range_noise(self, home):
        lidars = [SensorSettings(noise_m, field_of_view_deg=360.0, range_m=12.0) for noise_m in (0.0, 0.02, 0.05)]
        maps = [home, *(explore(home, (200,), 3, sensor=lidar)[0] for lidar in lidars)]
        free_m = [cell_centres_m(each, np.argwhere(each.state == CellState.FREE)) for each in maps]
        exact, *found = (each.noise_near(at_m).mean() for each, at_m in zip(maps, free_m, strict=True))
        assert exact == 0.0
        assert found[0] <= LEAST_NOISE < 0.5 < found[1] < found[2] - 0.02

    @pytest.mark.parametrize("fusion", get_args(Fusion))
    def test_without_errors_all_mappers_make_the_true_map(self, home, fusion):
        assert explore(home, (20,), 3, sensor=SensorSettings(fusion=fusion)) == explore(home, (20,), 3)

    def test_drift_grows_with_the_distance_travelled(self, home):
        exploration = explore_trajectory(home, (60,), 3, sensor=SensorSettings(drift_m_per_m=0.02))
        error_m = np.hypot(*(exploration.believed_poses - exploration.poses)[:, :2].T)
        travelled_m = np.concatenate([[0.0], np.hypot(*np.diff(exploration.poses[:, :2], axis=0).T).cumsum()])
        assert travelled_m[-1] > 3.0
        assert error_m[0] == 0.0
        assert error_m == pytest.approx(0.02 * travelled_m, abs=0.02)
        assert np.array_equal(exploration.believed_poses[:, 2], exploration.poses[:, 2])

    def test_much_error_does_not_break_the_robot(self):
        for seed in range(4):
            maps = explore(plan(CLOSET), (50, 300), seed, sensor=SensorSettings(1.0, 1.0, 0.5))
            assert [partial.shape for partial in maps] == [(11, 18)] * 2
