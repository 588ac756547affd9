"""Next views: where they are, how they are ranked, what they are worth, and how bad input is refused."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from extruded import drawn
from matplotlib.figure import Figure
from PIL import Image
from typer.testing import CliRunner

import sionna_partial as sp
from sionna_partial import cli
from sionna_partial.errors import MapError, MeasurementError, OutputError, PositionError, SettingsError

HALL = """
####################
#..................#
#..................#
#..................?
#..................?
#..................?
#..................#
#........##........#
####????##.........#
#?????###..........#
#??????##..........#
####################
"""
"""A hall with a door into the unknown at the right, and a smaller hole at the bottom."""

TX = (1.0, 1.9, 1.5)


@pytest.fixture(scope="module")
def hall() -> sp.PartialMap:
    cells = drawn(HALL, 0.2).state
    return sp.PartialMap(np.pad(cells, ((5, 5), (0, 15)), constant_values=2), 0.2, (-2.0, 3.0))


@pytest.fixture(scope="module")
def model(hall: sp.PartialMap) -> sp.LinkModel:
    """Predict the hall, warm: tests that ask for the same links trace them once."""
    return sp.LinkModel(hall)


def at(x: float, y: float) -> tuple[float, float]:
    return x - 2.0, y + 4.0


@pytest.mark.parametrize("goal", ["coverage", "area"])
def test_views_are_reachable_and_look_at_the_unknown(hall, model, goal):
    views = sp.next_views(model, np.add(TX, (-2.0, 4.0, 0.0)), goal=goal, start=at(1.0, 1.9))
    assert 1 <= len(views) <= 5
    assert [view.gain_per_m for view in views] == sorted((view.gain_per_m for view in views), reverse=True)
    for view in views:
        assert (hall.state_at(view.path_m) == sp.CellState.FREE).all()
        assert (hall.state_at(view.frontier_m) == sp.CellState.FREE).all()
        assert view.path_m[-1] == pytest.approx(view.position_m)
        assert view.path_length_m == pytest.approx(np.linalg.norm(np.diff(view.path_m, axis=0), axis=1).sum())
        ahead = np.array([math.cos(math.radians(view.heading_deg)), math.sin(math.radians(view.heading_deg))])
        assert (hall.state_at(view.position_m + np.outer([0.3, 0.6, 0.9], ahead)) == sp.CellState.UNKNOWN).any()


def test_area_is_that_of_the_unknown_cells_in_view(hall):
    (door, hole) = sorted(sp.next_views(hall, goal="area", start=at(1.0, 1.9)), key=lambda view: -view.gain)
    assert door.position_m == pytest.approx(at(3.9, 1.7), abs=0.25)
    assert door.heading_deg == 0.0
    assert 5.0 < door.gain < 1.2 * math.pi / 4 * 3.2**2
    assert hole.gain < 2.0
    near = sp.next_views(hall, goal="area", start=at(1.0, 1.3))[1]
    assert near.gain == hole.gain
    assert near.gain_per_m > hole.gain_per_m


def test_a_speck_beside_the_robot_is_no_goal(hall):
    state = hall.state.copy()
    row, column = hall.cell_index(np.array([at(1.3, 1.9)]))
    state[row, column] = sp.CellState.UNKNOWN
    speck = sp.PartialMap(state, hall.resolution_m, hall.origin_m)
    views = sp.next_views(speck, goal="area", start=at(1.0, 1.9))
    assert all(np.hypot(*(view.position_m - at(1.3, 1.9))) > 0.5 for view in views)
    assert len(views) == len(sp.next_views(hall, goal="area", start=at(1.0, 1.9)))


def test_transmitters_and_measurements(hall, model):
    tx_m = np.add([TX, (3.0, 2.0, 1.5)], (-2.0, 4.0, 0.0))
    one, two = (sp.next_views(model, tx, goal="state") for tx in (tx_m[0], tx_m))
    anywhere = sp.next_views(model, goal="state")
    assert [views.uncertainty.sizes["tx"] for views in (one, two, anywhere)] == [1, 2, 3]
    assert (hall.state_at(anywhere.tx_m) == sp.CellState.FREE).all()
    np.testing.assert_allclose(two.uncertainty[0], one.uncertainty[0])
    measured = sp.Measurements(tx_m[0], [[*at(3.0, 2.0), 1.5], [*at(3.5, 1.5), 1.5]], [-62.0, -63.0], 2.0)
    posterior = sp.next_views(model, measurements=measured, goal="state")
    assert posterior.tx_m == pytest.approx(tx_m[:1])
    total = float(one.uncertainty.sum()) * one.uncertainty.attrs["spacing_m"] ** 2
    assert 0.0 < one[0].gain <= total


def test_a_transmitter_that_measurements_locate(model):
    tx_m = np.add(TX, (-2.0, 4.0, 0.0))
    rx_m = np.array([[*at(x, y), 1.5] for x in (1.0, 2.0, 3.0) for y in (1.0, 2.0, 3.0)])
    gains_db = sp.trace_links(model, tx_m, rx_m).gain_db
    measured = {"rx": rx_m, "gain_db": gains_db, "std_db": np.full(9, 2.0)}
    views = sp.next_views(model, measurements=measured, goal="state")
    assert np.linalg.norm(views.tx_m - tx_m, axis=1).min() < 1.0
    assert views.uncertainty.sizes["tx"] == len(views.tx_m)
    assert 0.0 < float(views.uncertainty.mean("tx").max()) <= math.log2(3.0)


def test_a_complete_map_has_none():
    views = sp.next_views(drawn("#####\n#...#\n#...#\n#####", 0.5), goal="area")
    assert len(views) == 0
    assert yaml.safe_load(views.to_yaml())["poses"] == []
    assert isinstance(sp.plots.plot_next_views(views), Figure)


def test_poses_as_yaml(hall, tmp_path):
    views = sp.next_views(hall, goal="area", count=1)
    views.save(tmp_path / "views.yaml")
    record = yaml.safe_load((tmp_path / "views.yaml").read_text())
    (pose,), (expected,) = record["poses"], record["views"]
    assert record["header"] == {"frame_id": "map"}
    assert (pose["position"]["x"], pose["position"]["y"]) == pytest.approx(views[0].position_m, abs=1e-3)
    turned = 2.0 * math.degrees(math.atan2(pose["orientation"]["z"], pose["orientation"]["w"]))
    assert turned % 360.0 == pytest.approx(views[0].heading_deg, abs=1e-3)
    assert expected["gain_per_m"] == pytest.approx(views[0].gain_per_m, abs=1e-3)
    with pytest.raises(OutputError, match="could not be written"):
        views.save(tmp_path / "views.yaml" / "views.yaml")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"goal": "fame"}, SettingsError, "goal = 'fame' is not allowed: choose one of coverage, state, area"),
        ({"threshold_db": 3.0}, SettingsError, "threshold_db = 3.0 is not allowed"),
        ({"start": at(-1.0, 9.0)}, PositionError, "start = .* is not in a free cell: give x and y of the robot"),
        ({"tx": (99.0, 1.0, 1.5)}, PositionError, "tx = .* is outside the map"),
        ({"tx": np.tile(at(1.0, 1.9), (21, 1))}, PositionError, "tx has 21 transmitters: give at most 20"),
        ({"tx": at(1.0, 1.9), "measurements": "none.csv"}, MeasurementError, "none.csv' cannot be read"),
    ],
)
def test_bad_input(hall, arguments, error, message):
    with pytest.raises(error, match=message):
        sp.next_views(hall, **arguments)


def test_maps_where_nothing_can_stand():
    with pytest.raises(MapError, match="the map has 0 free cells: a robot needs somewhere to stand"):
        sp.next_views(sp.map_from_array([[2, 2], [2, 2]], resolution_m=1.0))
    with pytest.raises(PositionError, match="tx can be in no free cell clear of walls: give a transmitter"):
        sp.next_views(sp.map_from_array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], resolution_m=0.01))


def test_picture(hall):
    figure = sp.plots.plot_next_views(sp.next_views(hall, goal="area", count=2))
    assert [text.get_text() for text in figure.axes[0].texts] == ["2", "1"]


class TestCoveragePolicy:
    def test_it_drives_elsewhere_than_at_random(self):
        home = sp.make_home(3, "apartment")
        free = np.argwhere(home.state == sp.CellState.FREE)
        tx_m = (free[len(free) // 2][::-1] + 0.5) * home.resolution_m + home.origin_m
        runs = [sp.explore_trajectory(home, (12,), 1, policy="coverage", tx=tx_m) for _ in range(2)]
        usual = sp.explore_trajectory(home, (12,), 1)
        assert np.array_equal(runs[0].poses, runs[1].poses)
        assert np.array_equal(runs[0].poses[0], usual.poses[0])
        assert not np.array_equal(runs[0].poses, usual.poses)


def test_animation_with_predictions(hall, tmp_path):
    exploration = sp.explore_trajectory(hall, (0, 10), 2)
    sp.plots.animate_exploration(exploration, tmp_path / "map.gif")
    sp.plots.animate_exploration(exploration, tmp_path / "all.gif", tx=at(1.0, 1.9))
    with Image.open(tmp_path / "map.gif") as alone, Image.open(tmp_path / "all.gif") as beside:
        assert beside.n_frames == 2
        assert beside.width > 2.9 * alone.width


@pytest.mark.usefixtures("command_line")
class TestCommand:
    def test_what_it_writes_and_says(self, hall, tmp_path: Path):
        sp.save_map(hall, tmp_path / "map.yaml")
        x, y = map(str, at(1.0, 1.9))
        options = ["--tx", x, y, "--start", x, y, "--count", 2, "--out", tmp_path / "o"]
        arguments = ["next", tmp_path / "map.yaml", *options]
        result = CliRunner().invoke(cli.app, [*map(str, arguments)])
        assert result.exit_code == 0, result.output
        lines = result.stdout.splitlines()
        assert [line.startswith("wrote ") for line in lines] == [False, False, True, True]
        assert " deg, after " in lines[0]
        assert len(yaml.safe_load((tmp_path / "o" / "next_views.yaml").read_text())["poses"]) == 2
        with Image.open(tmp_path / "o" / "next_views.png") as picture:
            assert picture.width > 500

    def test_nothing_to_see(self, tmp_path: Path):
        sp.save_map(drawn("#####\n#...#\n#...#\n#####", 0.5), tmp_path / "map.yaml")
        arguments = ["next", tmp_path / "map.yaml", "--goal", "area", "--out", tmp_path / "o"]
        assert "nothing unknown can be reached" in CliRunner().invoke(cli.app, [*map(str, arguments)]).stdout
