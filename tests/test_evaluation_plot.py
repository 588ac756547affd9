import dataclasses

import numpy as np
import pytest
from link_tables import fitted_baselines, make_table
from predictor_links import QUIET, quick_predictor

from sionna_partial.errors import SettingsError
from sionna_partial.evaluation.evaluate import evaluate
from sionna_partial.plots.evaluation_plot import plot_stages
from sionna_partial.plots.figures import figure_png

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
                rows = evaluation.select(homes="test", receivers="indoor", ends_seen="all", answer=answer)
                expected = [[row.stage, getattr(row.metrics, name)] for row in rows]
                np.testing.assert_array_equal(lines[answer].get_xydata(), expected)

    def test_of_training_homes_only_the_predictor(self, evaluation):
        labels = [line.get_label() for line in plot_stages(evaluation).axes[0].get_lines()]
        assert [label for label in labels if "training" in label] == ["predictor, training homes"]
        assert len(labels) == len({row.answer for row in evaluation.select(receivers="indoor")}) + 1

    def test_every_line_has_a_colour_of_its_own(self, evaluation):
        lines = plot_stages(evaluation).axes[0].get_lines()
        assert len({line.get_color() for line in lines if "training" not in line.get_label()}) == len(lines) - 1

    def test_no_training_homes(self, evaluation):
        rows = tuple(row for row in evaluation.rows if row.homes == "test")
        figure = plot_stages(dataclasses.replace(evaluation, rows=rows))
        assert len(figure.axes[0].get_lines()) == len({row.answer for row in rows if row.receivers == "indoor"})

    def test_equal_files(self, evaluation):
        one, other = (figure_png(plot_stages(evaluation)) for _ in range(2))
        assert one == other

    def test_nothing_to_draw(self, evaluation):
        rows = tuple(row for row in evaluation.rows if row.receivers == "anywhere")
        with pytest.raises(SettingsError, match="evaluate links with receivers drawn indoors"):
            plot_stages(dataclasses.replace(evaluation, rows=rows))
