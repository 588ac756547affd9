import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from sionna_partial.constants import CellState
from sionna_partial.errors import SettingsError
from sionna_partial.exploration.explore import explore
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.worlds.buildings import LARGEST_M
from sionna_partial.worlds.homes import DOOR_M, LARGE_RESOLUTION_M, STYLES, make_home

SEEDS = 20
SCENES = Path(__file__).resolve().parents[1] / "scenes"


@cache
def made(seed: int, kind: str | None = "apartment") -> PartialMap:
    return make_home(seed, kind, resolution_m=0.1)


def free_area_m2(home: PartialMap) -> float:
    return float((home.state == CellState.FREE).sum()) * home.resolution_m**2


@settings(max_examples=10)
@given(seed=st.integers(0, 10**9), kind=st.sampled_from([None, *STYLES]))
def test_every_home_is_complete_and_tight(seed, kind):
    home = make_home(seed, kind, resolution_m=0.1)
    free = home.state == CellState.FREE
    assert home.is_complete
    assert home.interior_cells == free.sum()
    assert home.observed_fraction == 1.0
    around = ndimage.binary_dilation(free) & ~free
    assert (home.state[around] == CellState.WALL).all()
    assert not (home.state[[0, -1]] == CellState.FREE).any()
    assert not (home.state[:, [0, -1]] == CellState.FREE).any()


def parts_of(home: PartialMap) -> list[np.ndarray]:
    labels, count = ndimage.label(home.state == CellState.FREE)
    return sorted((labels == number for number in range(1, count + 1)), key=np.sum, reverse=True)


def test_some_homes_have_rooms_that_nobody_reaches():
    fractions = []
    for home in (made(seed, None) for seed in range(SEEDS)):
        first, *others = parts_of(home)
        if not others:
            continue
        fractions.append(sum(other.sum() for other in others) / sum(part.sum() for part in (first, *others)))
        robot = explore(home, steps=[30])[0].state == CellState.FREE
        assert robot.any()
        assert not (robot & ~first).any()
    assert 0.05 < len(fractions) / SEEDS < 0.45
    assert 0.03 < np.mean(fractions) < 0.25, fractions
    assert max(fractions) < 0.4, fractions


def rooms_of(home: PartialMap, smallest_m2: float) -> int:
    """Number of rooms: where a body wider than any door is shut in."""
    clearance_m = ndimage.distance_transform_edt(home.state == CellState.FREE) * home.resolution_m
    labels, _ = ndimage.label(clearance_m > DOOR_M[1] / 2 + home.resolution_m)
    return int((np.bincount(labels.ravel())[1:] * home.resolution_m**2 > smallest_m2).sum())


def test_equal_seeds_give_equal_homes_and_others_differ():
    for kind in (None, *STYLES):
        drawn = [made(seed, kind) for seed in range(2)]
        assert drawn[0] == make_home(0, kind, resolution_m=0.1)
        assert len({home.state.tobytes() for home in drawn}) == 2


def test_kinds_differ_in_size_and_none_draws_one():
    areas = {kind: [free_area_m2(made(seed, kind)) for seed in range(4)] for kind in (*STYLES, None)}
    assert np.median(areas["apartment"]) < np.median(areas["house"]) < np.median(areas["office"])
    for kind, style in STYLES.items():
        low, high = style.area
        assert all(0.1 * low < area < 1.2 * high for area in areas[kind]), areas
    assert np.std(areas[None]) > 20


LARGE = ("floor", "hall", "warehouse")


@pytest.mark.parametrize("kind", LARGE)
def test_large_kinds_are_as_large_as_buildings_and_no_larger(kind):
    free = [np.argwhere(made(seed, kind).state == CellState.FREE) * LARGE_RESOLUTION_M for seed in range(6)]
    hulls = [shapely.MultiPoint(cells[::7]).minimum_rotated_rectangle.exterior.coords for cells in free]
    widths_m, lengths_m = np.sort([np.linalg.norm(np.diff(hull, axis=0), axis=1)[:2] for hull in hulls]).T
    assert lengths_m.max() > 60
    assert (lengths_m < LARGEST_M[0] + 2).all()
    assert (widths_m < LARGEST_M[1] + 2).all()


def test_floors_have_corridors_and_rooms_and_halls_have_few():
    rooms = {kind: np.median([rooms_of(made(seed, kind), 1.0) for seed in range(4)]) for kind in LARGE}
    assert rooms["floor"] > 15
    assert rooms["floor"] > 3 * max(rooms["hall"], rooms["warehouse"])
    islands = [ndimage.label(made(seed, "warehouse").state != CellState.FREE)[1] - 1 for seed in range(4)]
    assert np.median(islands) > 10  # shelves and legs


def test_doors_of_some_floors_are_closed_and_those_of_none_without_locked_rooms():
    floors = [made(seed, "floor") for seed in range(8)]
    parts = [ndimage.label(floor.state == CellState.FREE)[1] for floor in floors]
    assert sum(count < 6 for count in parts) >= 2
    assert sum(count > 10 for count in parts) >= 2
    assert all(floor.is_complete for floor in floors)
    within = make_home(int(np.argmax(parts)), "floor", locked_rooms=False)
    assert ndimage.label(within.state == CellState.FREE)[1] == 1


def test_resolution_keeps_the_plan():
    fine, coarse = make_home(3, resolution_m=0.05), make_home(3, resolution_m=0.1)
    assert coarse.resolution_m == 0.1
    assert free_area_m2(coarse) == pytest.approx(free_area_m2(fine), rel=0.1)


@pytest.mark.parametrize("name", ["apartment", "house", "office"])
def test_shipped_homes_are_what_their_seeds_make(name):
    recipe = json.loads((SCENES / "homes.json").read_text())[name]
    home = make_home(recipe["seed"], recipe["kind"], locked_rooms=False)
    assert load_map(SCENES / name / "complete") == home
    stages = explore(home, seed=recipe["exploration_seed"])
    assert [load_map(SCENES / name / f"step{steps:03d}") for steps in (50, 100, 150, 200)] == stages
    assert stages[0].state_at(np.array(recipe["transmitter"])) == CellState.FREE


def test_without_locked_rooms_all_is_within_reach_and_the_rest_is_the_same():
    apart = 0
    for seed in range(8):
        home, within = made(seed, None), make_home(seed, resolution_m=0.1, locked_rooms=False)
        assert ndimage.label(within.state == CellState.FREE)[1] == 1
        if ndimage.label(home.state == CellState.FREE)[1] == 1:
            assert home == within
        else:
            apart += 1
            assert (home.state == CellState.FREE).sum() > (within.state == CellState.FREE).sum()
    assert apart


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(({"seed": seed}, "seed = .* give a whole number of 0 or more") for seed in (-1, 1.5, True)),
        ({"kind": "castle"}, "kind = 'castle' is not allowed: choose one of apartment, house"),
        *(({"resolution_m": cell}, r"give a number in \[0\.01, 0\.2\]") for cell in (0.0, 0.5)),
        ({"locked_rooms": 1}, "locked_rooms = 1 is not allowed: give True or False"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(SettingsError, match=message):
        make_home(**{"seed": 0, **arguments})
