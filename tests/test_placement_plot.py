import numpy as np
import pytest
from matplotlib.collections import PatchCollection
from placement_cases import placed

from sionna_partial.errors import SettingsError
from sionna_partial.placement.placement import TransmitterPlacement
from sionna_partial.plots.result_plots import plot_placement
from sionna_partial.plots.style import RED, figure_png


@pytest.fixture
def placement() -> TransmitterPlacement:
    return placed()


class TestPlotPlacement:
    def test_shows_the_refinement_and_the_best(self, placement: TransmitterPlacement) -> None:
        lines = plot_placement(placement).axes[0].lines
        (red,) = (np.column_stack(line.get_data()) for line in lines if line.get_color() == RED)
        np.testing.assert_array_equal(red, placement.trajectory_m[:, :2])
        star = next(line for line in lines if line.get_marker() == "*")
        np.testing.assert_array_equal(np.ravel(star.get_data()), placement.position_m[:2])

    def test_shows_the_starts(self, placement: TransmitterPlacement) -> None:
        points = [np.asarray(each.get_offsets()) for each in plot_placement(placement).axes[0].collections]
        assert any(
            len(each) == len(placement.starts_m) and (each == placement.starts_m[:, :2]).all() for each in points
        )

    def test_shows_what_is_covered(self, placement: TransmitterPlacement) -> None:
        axis = plot_placement(placement).axes[0]
        (squares,) = (each for each in axis.collections if isinstance(each, PatchCollection))
        np.testing.assert_array_equal(squares.get_array(), placement.values)
        assert len(np.unique(squares.get_alpha())) == len(np.unique(placement.weight))

    def test_says_where_and_how_good(self, placement: TransmitterPlacement) -> None:
        figure = plot_placement(placement)
        x, y, z = placement.position_m
        title = f"Transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m, predicted coverage {placement.score:.1%}"
        assert figure.axes[0].get_title() == title
        assert figure.axes[1].get_ylabel() == "probability of more than -100 dB"

    def test_worst_tenth(self) -> None:
        figure = plot_placement(placed(objective="percentile"))
        assert "worst tenth at" in figure.axes[0].get_title()
        assert figure.axes[1].get_ylabel() == "mean path gain [dB]"

    def test_all_of_it_is_in_the_picture(self, placement: TransmitterPlacement) -> None:
        axis = plot_placement(placement).axes[0]
        (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
        for x, y, _ in (*placement.starts_m, *placement.trajectory_m):
            assert x0 < x < x1
            assert y0 < y < y1

    def test_equal_placements_are_equal_pictures(self, placement: TransmitterPlacement) -> None:
        assert figure_png(plot_placement(placement)) == figure_png(plot_placement(placement))

    def test_something_else(self) -> None:
        message = "placement = 'dict' is not allowed: give what place_transmitter returned"
        with pytest.raises(SettingsError, match=message):
            plot_placement({})  # type: ignore[arg-type]
