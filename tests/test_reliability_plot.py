import re

import numpy as np
import pytest

from sionna_partial.errors import SettingsError
from sionna_partial.evaluation.metrics import CONFIDENCE_BINS, PIT_BINS, Calibration, Reliability
from sionna_partial.plots.figures import figure_png
from sionna_partial.plots.reliability_plot import plot_reliability


def calibration(error=0.0, links=100):
    """Calibration with two bins of `links` links, right less often than they say by `error`."""
    counts, confidence = np.zeros(CONFIDENCE_BINS, dtype=np.int64), np.zeros(CONFIDENCE_BINS)
    counts[[8, 13]], confidence[[8, 13]] = links, [0.55, 0.9]
    accuracy = np.where(counts > 0, confidence - error, 0.0)
    return Calibration(Reliability(counts, confidence, accuracy), np.linspace(0.5, 1.5, PIT_BINS) / PIT_BINS)


class TestPlotCalibration:
    def test_a_column_for_each_stage(self):
        figure = plot_reliability({0: calibration(), 50: calibration(0.1), 200: calibration(0.2)})
        titles = [axis.get_title() for axis in figure.axes if axis.get_title()]
        assert titles == ["0 steps, error 0.000", "50 steps, error 0.100", "200 steps, error 0.200"]
        assert len(figure.axes) == 6

    def test_discs_and_bars_show_the_numbers(self):
        above, below = plot_reliability({0: calibration(0.1)}).axes
        (discs,) = above.collections
        np.testing.assert_allclose(discs.get_offsets(), [[0.55, 0.45], [0.9, 0.8]])
        (bars,) = below.patches
        np.testing.assert_allclose(bars.get_data().values, np.linspace(0.5, 1.5, PIT_BINS))
        assert bars.get_data().edges[[0, -1]].tolist() == [0.0, 1.0]

    def test_no_disc_without_links(self):
        above = plot_reliability({0: calibration(links=0)}).axes[0]
        assert len(above.collections[0].get_offsets()) == 0

    def test_equal_files(self):
        one, other = (figure_png(plot_reliability({0: calibration()})) for _ in range(2))
        assert one == other

    def test_nothing_to_draw(self):
        with pytest.raises(
            SettingsError, match=re.escape("stages = {} is not allowed: give at least one calibration.")
        ):
            plot_reliability({})
