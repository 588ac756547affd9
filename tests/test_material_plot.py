"""The picture of a calibration shows the numbers that it has."""

import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.calibration.material_fit import Posterior
from sionna_partial.plots.result_plots import ANGLES_DEG, plot_calibration

CONCRETE, BRICK = sp.Material(5.24, 0.6), sp.Material(3.9, 0.04)


def calibration(
    materials: tuple[sp.Material, ...] = (CONCRETE,), undetermined: tuple[str, ...] = ()
) -> sp.MaterialCalibration:
    open_now = Posterior(np.array([5.0, 5.5]), np.array([0.5, 0.7]), np.array([0.5, 0.5]))
    gain_db = np.linspace(-120.0, -60.0, 20)
    return sp.MaterialCalibration(
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
    search, links, _ = plot_calibration(calibration()).axes
    assert search.lines[0].get_ydata().tolist() == [3.0, 2.5, 2.4]
    labels = [text.get_text() for text in links.get_legend().get_texts()]
    assert labels == ["start, RMSE 5.0 dB", "calibrated, RMSE 1.0 dB"]
    before, after = (points.get_offsets() for points in links.collections)
    assert len(before) == len(after) == 18
    np.testing.assert_allclose(after[:, 1] - after[:, 0], 1.0)


def test_reflection_has_its_band() -> None:
    found = calibration()
    axis = plot_calibration(found).axes[2]
    loss_db, std_db = found.reflection_loss_db(ANGLES_DEG)
    np.testing.assert_allclose(axis.lines[1].get_ydata(), loss_db)
    (band,) = axis.collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert heights.max() == pytest.approx((loss_db + 2.0 * std_db).max())
    texts = [text.get_text() for text in axis.get_legend().get_texts()]
    assert texts == ["start: 2.94, 0.12 S/m", "calibrated: 5.24, 0.6 S/m"]


def test_a_picture_for_each_material() -> None:
    figure = plot_calibration(calibration((CONCRETE, BRICK)))
    assert [axis.get_title() for axis in figure.axes] == ["Search", "Links", "Material 0", "Material 1"]


@pytest.mark.parametrize(
    ("undetermined", "note"),
    [((), ""), (("permittivity", "conductivity"), "; the measurements cannot determine permittivity, conductivity")],
)
def test_title_says_what_is_not_known(undetermined: tuple[str, ...], note: str) -> None:
    title = plot_calibration(calibration(undetermined=undetermined)).get_suptitle()
    assert title == f"Material from 18 of 20 measured links, noise 2.9 dB{note}"
