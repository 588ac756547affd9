import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from sionna_partial.constants import CellState
from sionna_partial.errors import SettingsError
from sionna_partial.exploration.explore import Exploration, explore_trajectory
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.exploration_plot import MAX_PANELS, animate_exploration, plot_exploration
from sionna_partial.plots.style import BLUE, RED
from sionna_partial.settings import SensorSettings


@pytest.fixture(scope="module")
def home() -> PartialMap:
    state = np.full((90, 140), CellState.UNKNOWN, dtype=np.uint8)
    state[20:70, 20:120] = CellState.WALL
    state[21:69, 21:119] = CellState.FREE
    state[21:55, 70] = CellState.WALL
    return PartialMap(state, 0.05, (-3.0, 8.0))


@pytest.fixture(scope="module")
def exploration(home: PartialMap) -> Exploration:
    return explore_trajectory(home, range(0, 61, 10), 2)


def panels(figure: Figure) -> list:
    return [axis for axis in figure.axes if axis.images]


class TestPlotExploration:
    def test_cells_have_their_colours(self, home, exploration):
        image = panels(plot_exploration(exploration.at((30,))))[0].images[0]
        state, picture = exploration.at((30,)).states[0], image.get_array()
        assert image.get_extent() == pytest.approx((-3.0, 4.0, 8.0, 12.5))
        assert image.origin == "lower"
        assert (picture[state == CellState.FREE] == 1.0).all()
        assert (picture[state == CellState.WALL] == 0.0).all()
        hidden = (state == CellState.UNKNOWN) & (home.state == CellState.WALL)
        assert 0 < picture[hidden][0, 0] < 1

    def test_the_way_ends_at_the_robot_and_its_view_in_the_room(self, home, exploration):
        (last,) = panels(plot_exploration(exploration.at((60,))))
        way = next(line for line in last.lines if len(line.get_xdata()) == 61)
        assert np.array_equal(np.stack(way.get_data(), axis=1), exploration.poses[:, :2])
        robot = last.lines[-1]
        assert (robot.get_xdata()[0], robot.get_ydata()[0]) == tuple(exploration.poses[-1, :2])
        tip = robot.get_marker().vertices[0]
        assert np.degrees(np.arctan2(tip[1], tip[0])) % 360 == pytest.approx(exploration.poses[-1, 2])
        (view,) = last.patches
        corners = view.get_xy()
        assert tuple(corners[0]) == tuple(exploration.poses[-1, :2])
        assert (home.state_at(corners) != CellState.UNKNOWN).all()

    def test_a_map_that_drifts_shows_both_ways(self, home):
        drifting = explore_trajectory(home, (40,), 2, sensor=SensorSettings(drift_m_per_m=0.05))
        figure = plot_exploration(drifting)
        trajectories = [line for line in panels(figure)[0].lines if len(line.get_xdata()) == 41]
        assert np.array_equal(trajectories[0].get_xdata(), drifting.poses[:, 0])
        assert np.array_equal(trajectories[1].get_xdata(), drifting.believed_poses[:, 0])
        texts = [text.get_text() for text in figure.legends[0].texts]
        assert texts[:2] == ["estimated trajectory", "true trajectory"]

    def test_many_moments_are_thinned(self, home):
        many = explore_trajectory(home, range(0, 40), 2)
        titles = [panel.get_title() for panel in panels(plot_exploration(many))]
        assert len(titles) == MAX_PANELS
        assert (titles[0], titles[-1]) == ("step 0: 0% seen", f"step 39: {many.observed_fractions[-1]:.0%} seen")


class TestAnimateExploration:
    def test_frames_and_colours(self, exploration, tmp_path):
        way = tmp_path / "way.gif"
        animate_exploration(exploration, way)
        with Image.open(way) as animation:
            assert animation.n_frames == len(exploration.steps)
            fractions = []
            for index in range(animation.n_frames):
                animation.seek(index)
                pixels = np.asarray(animation.convert("RGB"))
                fractions.append((pixels == 255).all(axis=2).mean())
            found = {colour for _, colour in animation.convert("RGB").getcolors(1 << 20)}
        assert fractions[0] < fractions[1] < fractions[-1]
        assert {tuple(round(255 * value) for value in to_rgb(colour)) for colour in (BLUE, RED)} <= found

    def test_equal_explorations_give_equal_bytes(self, exploration, tmp_path):
        names = [tmp_path / "first.gif", tmp_path / "again.GIF"]
        for name in names:
            animate_exploration(exploration.at((0, 60)), name)
        assert names[0].read_bytes() == names[1].read_bytes()

    def test_other_suffixes_are_refused(self, exploration, tmp_path):
        with pytest.raises(SettingsError, match=r"path = '.*way\.mp4' is not allowed: give a name that ends with"):
            animate_exploration(exploration, tmp_path / "way.mp4")
        assert list(tmp_path.iterdir()) == []
