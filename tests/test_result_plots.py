import dataclasses
import re

import numpy as np
import pytest
from link_tables import fitted_baselines, make_table
from matplotlib.collections import PatchCollection
from placement_cases import placed
from predictor_links import QUIET, quick_predictor

import sionna_partial as sp
from sionna_partial.calibration.calibration import MaterialCalibration
from sionna_partial.calibration.material_fit import Posterior
from sionna_partial.errors import SettingsError
from sionna_partial.lab.evaluation import evaluate
from sionna_partial.lab.metrics import CONFIDENCE_BINS, PIT_BINS, Calibration, Reliability
from sionna_partial.plots.result_plots import (
    ANGLES_DEG,
    plot_calibration,
    plot_placement,
    plot_reliability,
    plot_stages,
)
from sionna_partial.plots.style import RED


def test_a_placement_is_drawn_with_starts_refinement_and_coverage() -> None:
    placement = placed()
    axis, colour_bar, *_ = plot_placement(placement).axes
    (red,) = (np.column_stack(line.get_data()) for line in axis.lines if line.get_color() == RED)
    np.testing.assert_array_equal(red, placement.trajectory_m[:, :2])
    star = next(line for line in axis.lines if line.get_marker() == "*")
    np.testing.assert_array_equal(np.ravel(star.get_data()), placement.position_m[:2])
    assert any(np.array_equal(points.get_offsets(), placement.starts_m[:, :2]) for points in axis.collections)
    (squares,) = (shown for shown in axis.collections if isinstance(shown, PatchCollection))
    np.testing.assert_array_equal(squares.get_array(), placement.values)
    x, y, z = placement.position_m
    assert axis.get_title() == f"Transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m, predicted coverage {placement.score:.1%}"
    assert colour_bar.get_ylabel() == "probability of more than -100 dB"


def test_worst_tenth() -> None:
    figure = plot_placement(placed(objective="percentile"))
    assert "worst tenth at" in figure.axes[0].get_title()
    assert figure.axes[1].get_ylabel() == "mean path gain [dB]"


CONCRETE, BRICK = sp.Material(5.24, 0.6), sp.Material(3.9, 0.04)


def calibrated(
    materials: tuple[sp.Material, ...] = (CONCRETE,), undetermined: tuple[str, ...] = ()
) -> MaterialCalibration:
    open_now = Posterior(np.array([5.0, 5.5]), np.array([0.5, 0.7]), np.array([0.5, 0.5]))
    gain_db = np.linspace(-120.0, -60.0, 20)
    return MaterialCalibration(
        permittivity=5.24,
        conductivity_s_m=0.6,
        permittivity_std=0.25,
        conductivity_std_s_m=0.1,
        undetermined=undetermined,
        loss=np.array([3.0, 2.5, 2.4]),
        noise_db=2.9,
        offset_db=0.0,
        used=np.arange(20) > 1,
        left_out={"measured outage": 2},
        gain_db=gain_db,
        gain_before_db=gain_db - 5.0,
        gain_after_db=gain_db + 1.0,
        start=(sp.Material(),) * len(materials),
        materials=materials,
        posteriors=(open_now,) * len(materials),
        scene=sp.PartialMap(np.zeros((2, 2), dtype=np.uint8), 0.1),
        trace_settings=sp.TraceSettings(),
    )


def test_search_and_links() -> None:
    search, links, _ = plot_calibration(calibrated()).axes
    assert search.lines[0].get_ydata().tolist() == [3.0, 2.5, 2.4]
    labels = [text.get_text() for text in links.get_legend().get_texts()]
    assert labels == ["start, RMSE 5.0 dB", "calibrated, RMSE 1.0 dB"]
    before, after = (points.get_offsets() for points in links.collections)
    assert len(before) == len(after) == 18
    np.testing.assert_allclose(after[:, 1] - after[:, 0], 1.0)


def test_reflection_has_its_band() -> None:
    found = calibrated()
    axis = plot_calibration(found).axes[2]
    loss_db, std_db = found.reflection_loss_db(ANGLES_DEG)
    np.testing.assert_allclose(axis.lines[1].get_ydata(), loss_db)
    (band,) = axis.collections
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx((loss_db + 2.0 * std_db).max())
    texts = [text.get_text() for text in axis.get_legend().get_texts()]
    assert texts == ["start: 2.94, 0.12 S/m", "calibrated: 5.24, 0.6 S/m"]


def test_a_picture_for_each_material() -> None:
    figure = plot_calibration(calibrated((CONCRETE, BRICK), ("permittivity", "conductivity")))
    assert [axis.get_title() for axis in figure.axes] == ["Search", "Links", "Material 0", "Material 1"]
    note = "; the measurements cannot determine permittivity, conductivity"
    assert figure.get_suptitle() == f"Material from 18 of 20 measured links, noise 2.9 dB{note}"


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
            assert [label for label in lines if "training" in label] == ["predictor, training homes"]
            for answer in ("predictor", "partial trace"):
                rows = evaluation.select(homes="test", receivers="indoor", ends_seen="all", model=answer)
                expected = [[row.stage, getattr(row.metrics, name)] for row in rows]
                np.testing.assert_array_equal(lines[answer].get_xydata(), expected)

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
    @pytest.mark.parametrize(
        ("plot", "message"),
        [
            (plot_placement, "placement = {} is not allowed: give what place_transmitter returned"),
            (sp.plots.plot_network_placement, "place_transmitters"),
            (sp.plots.plot_exploration, "exploration = {} is not allowed: give what explore_trajectory"),
            (plot_reliability, "stages = {} is not allowed: give at least one"),
        ],
    )
    def test_other_values_are_refused(self, plot, message):
        with pytest.raises(SettingsError, match=re.escape(message)):
            plot({})

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
