import dataclasses
import re

import numpy as np
import pytest
from link_tables import fitted_baselines, make_table
from predictor_links import QUIET, quick_predictor

from sionna_partial.errors import SettingsError
from sionna_partial.evaluation.evaluate import evaluate
from sionna_partial.evaluation.metrics import CONFIDENCE_BINS, PIT_BINS, Calibration, Reliability
from sionna_partial.plots.result_plots import plot_reliability, plot_stages

pytestmark = QUIET


@pytest.fixture(scope="module")
def evaluation():
    predictor = dataclasses.replace(quick_predictor(), homes=("home 1",))
    return evaluate(predictor, make_table(homes=3, stages=(0, 50, 100)), baselines=fitted_baselines())


class TestPlotStages:
    def test_lines_show_the_figures_of_test_homes(self, evaluation):
        axes = plot_stages(evaluation).axes
        for axis, name in zip(axes, ("accuracy", "rmse_db", "rmse_linked_db"), strict=True):
            lines = {line.get_label(): line for line in axis.get_lines()}
            for answer in ("predictor", "distance only", "partial trace", "TR 38.901 open office"):
                rows = evaluation.select(homes="test", receivers="indoor", ends_seen="all", model=answer)
                expected = [[row.stage, getattr(row.metrics, name)] for row in rows]
                np.testing.assert_array_equal(lines[answer].get_xydata(), expected)

    def test_of_training_homes_only_the_predictor(self, evaluation):
        labels = [line.get_label() for line in plot_stages(evaluation).axes[0].get_lines()]
        assert [label for label in labels if "training" in label] == ["predictor, training homes"]
        assert len(labels) == len({row.model for row in evaluation.select(receivers="indoor")}) + 1

    def test_every_line_has_a_colour_of_its_own(self, evaluation):
        lines = plot_stages(evaluation).axes[0].get_lines()
        assert len({line.get_color() for line in lines if "training" not in line.get_label()}) == len(lines) - 1

    def test_nothing_to_draw(self, evaluation):
        rows = tuple(row for row in evaluation.rows if row.receivers == "anywhere")
        with pytest.raises(SettingsError, match="evaluate links with receivers drawn indoors"):
            plot_stages(dataclasses.replace(evaluation, rows=rows))


def calibration(error=0.0, links=100):
    """Calibration with two bins of `links` links, less often right than their confidence by `error`."""
    counts, confidence = np.zeros(CONFIDENCE_BINS, dtype=np.int64), np.zeros(CONFIDENCE_BINS)
    counts[[8, 13]], confidence[[8, 13]] = links, [0.55, 0.9]
    accuracy = np.where(counts > 0, confidence - error, 0.0)
    return Calibration(Reliability(counts, confidence, accuracy), np.linspace(0.5, 1.5, PIT_BINS) / PIT_BINS)


class TestPlotReliability:
    def test_a_column_for_each_stage(self):
        figure = plot_reliability({0: calibration(), 50: calibration(0.1), 200: calibration(0.2)})
        titles = [axis.get_title() for axis in figure.axes if axis.get_title()]
        assert titles == ["0 steps,\nerror 0.000", "50 steps,\nerror 0.100", "200 steps,\nerror 0.200"]
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

    def test_nothing_to_draw(self):
        with pytest.raises(SettingsError, match=re.escape("stages = {} is not allowed: give at least one")):
            plot_reliability({})
