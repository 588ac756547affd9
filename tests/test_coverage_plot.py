import io
import re

import numpy as np
import pytest
from coverage_cases import shipped, small_coverage
from matplotlib import pyplot
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.path import Path
from PIL import Image

from sionna_partial.constants import LinkState
from sionna_partial.coverage.job import predict_map
from sionna_partial.errors import SettingsError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.coverage_plot import plot_comparison, plot_coverage
from sionna_partial.plots.layers import mix_state_colours
from sionna_partial.plots.report import plot_report
from sionna_partial.plots.style import STATE_COLOURS, figure_png

LOS, NLOS, OUTAGE = (
    np.array(to_rgb(STATE_COLOURS[state])) for state in (LinkState.LOS, LinkState.NLOS, LinkState.OUTAGE)
)


@pytest.fixture(scope="module")
def figure():
    return plot_coverage(small_coverage(), threshold_db=-80.0)


def panels(figure):
    return [axis for axis in figure.axes if axis.get_xlim() != (0.0, 1.0) and axis.images and axis.axison]


def test_colours_are_weighted_by_the_probabilities():
    np.testing.assert_allclose(mix_state_colours(0.5, 0.2, 0.3), 0.5 * LOS + 0.2 * NLOS + 0.3 * OUTAGE)
    assert np.isnan(mix_state_colours(np.nan, np.nan, np.nan)).all()


def at_receivers(panel, coverage):
    image = np.asarray(panel.images[0].get_array())
    refine = image.shape[0] // coverage.sizes["y"]
    assert np.isfinite(image).all()
    return image[refine // 2 :: refine, refine // 2 :: refine][coverage["valid"].to_numpy()]


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_most_probable_state_has_its_colour(coverage, figure):
    panel = panels(figure)[0]
    assert panel.get_title() == "Most probable link state"
    drawn = panel.images[0].to_rgba(at_receivers(panel, coverage))[..., :3]
    state = coverage["link_state"].to_numpy()[coverage["valid"].to_numpy()]
    np.testing.assert_allclose(drawn, np.array([OUTAGE, LOS, NLOS])[state.astype(int)])


def test_other_panels_show_their_variable_with_fixed_scales(coverage):
    names = {"gain_mean_db": (-150, -60), "gain_std_db": (0, 40), "p_los": (0, 1)}
    for panel, (name, limits) in zip(panels(plot_coverage(coverage, layers=list(names))), names.items(), strict=True):
        assert panel.images[0].get_clim() == limits
        expected = coverage[name].to_numpy()[coverage["valid"].to_numpy()]
        np.testing.assert_allclose(at_receivers(panel, coverage), expected)
    (panel,) = panels(plot_coverage(coverage.assign_attrs(walls="through walls"), layers=["gain_mean_db"]))
    assert panel.images[0].get_clim() == (-110, -30)


def test_the_probability_of_more_than_a_threshold(coverage, figure):
    panel = panels(figure)[3]
    assert panel.get_title() == "P(path gain > \N{MINUS SIGN}80 dB)"
    known = coverage.stack(rx=("y", "x")).isel(rx=coverage["valid"].to_numpy().ravel())
    draws = np.random.default_rng(0).normal(size=(20_000, 1))
    los, nlos = (
        draws * known[f"gain_{s}_std_db"].to_numpy() + known[f"gain_{s}_mean_db"].to_numpy() for s in ("los", "nlos")
    )
    above = (los > -80.0).mean(axis=0) * known["p_los"] + (nlos > -80.0).mean(axis=0) * known["p_nlos"]
    np.testing.assert_allclose(at_receivers(panel, coverage), above, atol=0.02)


def test_legend_and_colour_bars_name_what_is_drawn(coverage, figure):
    labels = {axis.get_ylabel() for axis in figure.axes}
    assert {"dB", "probability"} <= labels
    assert legend(figure) == ["transmitter", "LOS", "NLOS", "outage", "wall", "not observed"]
    seen = coverage.assign(observed=coverage["observed"] | True, wall_parts=0 * coverage["wall_parts"])
    assert legend(plot_coverage(seen, layers=("p_los",))) == ["transmitter"]
    assert "wall, not observed" not in legend(plot_comparison({"truth": coverage, "again": coverage}))
    blind = plot_comparison({"truth": coverage, "blind": seen})
    assert "wall, not observed" in legend(blind)
    observed = f", {coverage.attrs['map_observed_fraction']:.0%} observed"
    assert [panel.get_title() for panel in panels(blind)[:2]] == [f"{name}{observed}" for name in ("truth", "blind")]
    assert len(panels(blind)) == 4


def test_walls_are_black_where_they_are_and_nowhere_else(coverage, figure):
    walls = panels(figure)[0].images[-1]
    assert walls.get_extent() == pytest.approx((-1.0, 5.0, 2.0, 6.0))
    rgba = walls.get_array()
    x, y = np.meshgrid(np.linspace(-1, 5, 2 * rgba.shape[1] + 1)[1::2], np.linspace(2, 6, 2 * rgba.shape[0] + 1)[1::2])
    nearest = coverage["cell_state"].sel(x=x[0], y=y[:, 0], method="nearest").to_numpy()
    np.testing.assert_array_equal(rgba[..., 3] == 255, nearest == 1)
    assert not rgba[..., :3].any()


def test_the_unknown_area_is_hatched_and_a_known_map_is_not(coverage, figure):
    def hatches(figure):
        return [item for item in panels(figure)[0].collections if item.get_hatch() or getattr(item, "hatches", None)]

    (area,) = hatches(figure)
    (outline,) = area.get_paths()
    x, y = np.meshgrid(coverage["x"], coverage["y"])
    points = np.column_stack([x.ravel(), y.ravel()])
    inside = np.logical_xor.reduce([Path(ring).contains_points(points) for ring in outline.to_polygons()])
    np.testing.assert_array_equal(inside.reshape(x.shape), ~coverage["observed"].to_numpy())
    known = coverage.assign(observed=coverage["observed"] | True)
    assert not hatches(plot_coverage(known))


def test_the_transmitter_is_marked_in_each_panel_of_a_figure_unknown_to_pyplot(figure):
    assert isinstance(figure, Figure)
    assert not pyplot.get_fignums()
    for panel in panels(figure):
        (star,) = panel.lines
        assert (star.get_xdata()[0], star.get_ydata()[0]) == (0.6, 3.6)
        assert panel.get_xlim() == pytest.approx((-1.0, 5.0))


def test_several_transmitters_have_a_row_each(several, figure):
    found = plot_coverage(several, layers=("link_state", "gain_mean_db", "state_mixture"))
    rows = np.array(panels(found)).reshape(2, 3)
    assert [row[0].get_ylabel().split("\n")[0] for row in rows] == [*several["tx"].to_numpy()]
    assert [panel.get_title() for panel in rows[0]] == ["Most probable link state", "Mean path gain", "Link state"]
    for row, tx in zip(rows, several["tx"], strict=True):
        one = several.sel(tx=tx)
        expected = one["gain_mean_db"].to_numpy()[one["valid"].to_numpy()]
        np.testing.assert_array_equal(at_receivers(row[1], one), expected)
        assert [star.get_xdata()[0] for star in row[1].lines] == [one["tx_x"]]
    assert found.get_suptitle() == "Coverage for receivers that are indoors\n2 transmitters, 28 GHz, opaque walls"
    assert legend(found) == legend(figure)


def test_the_report_has_names_any_transmitter_uncertainty_and_material(several):
    figure = plot_report(several, eirp_dbm=[20.0, 30.0], threshold_dbm=-67.0, heading=("flat_2.png", "2026-11-25"))
    (text,) = [text.get_text() for axis in figure.axes for text in axis.texts if "Uncertainty" in text.get_text()]
    rows = text.split("\n\n")[0].splitlines()
    assert [row.split(" ")[0] for row in rows] == ["Observed", *several["tx"].to_numpy(), "any"]
    assert "20 dBm" in rows[1]
    assert [row.count("%") for row in rows] == [0, 8, 8, 8]
    assert re.search(r"Material of the walls: \w+", text)
    assert "flat_2.png" in figure.get_suptitle()
    low = plot_report(several.isel(y=slice(8)), eirp_dbm=20.0, threshold_dbm=-67.0)
    assert len([axis for axis in low.axes if axis.get_title()]) == 3


def test_the_outside_is_blank_on_a_complete_map_alone(coverage):
    for complete in (0, 1):
        coverage.attrs["map_complete"] = complete
        blank = panels(plot_coverage(coverage))[0].images[1].get_array()
        expected = ~coverage["observed"].to_numpy() & bool(complete)
        np.testing.assert_array_equal(blank[..., 3] > 0, expected)


@pytest.mark.parametrize("shape", [(1, 1), (40, 1)])
def test_maps_of_any_shape_are_drawn(shape):
    partial = PartialMap(np.full(shape, 2, dtype=np.uint8), 0.5)
    small = predict_map(partial, (0.1, 0.1), spacing_m=0.5, predictor=shipped())
    for figure in (plot_coverage(small), plot_comparison({"one": small, "two": small})):
        with Image.open(io.BytesIO(figure_png(figure))) as image:
            assert max(image.size) < 8000


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda data: plot_coverage(data.drop_vars("p_los")), "coverage lacks p_los"),
        (lambda _: plot_comparison({}), r"coverages = \{\} is not allowed: give at least one coverage map"),
        (lambda data: plot_coverage(data, layers=("p_los", "gain")), "layers = 'gain' is not allowed: choose one of"),
        (lambda data: plot_coverage(data, threshold_db=-151), "threshold_db = -151 is not allowed"),
    ],
)
def test_what_cannot_be_drawn_is_named(coverage, draw, message):
    with pytest.raises(SettingsError, match=message):
        draw(coverage)
