"""The position of a transmitter from measured gains, and the coverage averaged over it."""

import functools
import logging

import numpy as np
import pytest
import xarray as xr
from extruded import drawn
from scipy.spatial.distance import cdist
from typer.testing import CliRunner

import sionna_partial as sp
from sionna_partial.checks import no_progress
from sionna_partial.cli import app
from sionna_partial.errors import MeasurementError, PositionError
from sionna_partial.measurements.localisation import (
    MOST_GROUPS,
    MOST_TRACED,
    TransmitterPosterior,
    likely_region,
    locate_transmitter,
)
from sionna_partial.measurements.measurements import measurements_of
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.tracing.positions import clear_of_walls

HOUSE = drawn(
    """
    #################
    #......#????????#
    #......#????????#
    #...............?
    #...............?
    #......#.......##
    #################
    """,
    resolution_m=0.4,
)
TX = np.array([4.5, 1.3, 1.5])
PLACES = np.array([(1.0, 0.7, 1.5), (2.3, 1.4, 1.5), (3.9, 1.5, 1.5), (5.3, 0.6, 1.5), (1.1, 1.9, 1.5)])
OPTIONS, COARSE = {"spacing_m": 0.4}, {"spacing_m": 1.2}


@functools.cache
def model() -> sp.LinkModel:
    """Predict the house, warm: links that several tests ask for are traced once."""
    return sp.LinkModel(HOUSE, "paper")


def table(**changes: object) -> dict[str, object]:
    gain_db = sp.trace_links(model(), TX, PLACES, progress=False).gain_db
    return {"rx": PLACES, "gain_db": gain_db, "std_db": 1.0, **changes}


@pytest.fixture(scope="module")
def coverage() -> xr.Dataset:
    return sp.predict_map(model(), measurements=table(), **OPTIONS)


class TestCoverage:
    def test_a_transmitter_in_sight_is_found(self, coverage):
        assert np.linalg.norm(coverage.attrs["transmitter_m"] - TX) < 0.6
        assert coverage.attrs["transmitter_std_m"] < 1.5
        assert float(coverage.p_transmitter.sum()) == pytest.approx(1.0)
        row, column = (
            np.abs(coverage[axis].to_numpy() - at).argmin() for axis, at in (("tx_y", TX[1]), ("tx_x", TX[0]))
        )
        assert likely_region(coverage.p_transmitter.to_numpy())[row, column]
        assert "transmitter near (" in repr(coverage.radio)

    def test_coverage_is_about_that_of_the_position(self, coverage):
        known = sp.predict_map(model(), TX, **OPTIONS)
        left = (known.x < 2.8) & known.valid & coverage.valid
        assert float(np.abs(coverage.gain_mean_db - known.gain_mean_db).where(left).mean()) < 4.0
        total = coverage.p_los + coverage.p_nlos + coverage.p_outage
        assert float(np.abs(total - 1.0).max()) < 1e-5

    def test_every_format_takes_it(self, coverage, tmp_path):
        for suffix in (".nc", ".tif", ".csv", ".png", ".html", ".yaml"):
            sp.save_coverage(coverage, tmp_path / f"coverage{suffix}")
        assert sp.load_coverage(tmp_path / "coverage.nc").identical(coverage)
        figure = sp.plots.plot_coverage(coverage, layers=("link_state",))
        assert "transmitter, 90 %" in [text.get_text() for text in figure.legends[0].get_texts()]

    @pytest.mark.parametrize("offset_db", [-40.0, 31.0])
    def test_powers_are_located_too(self, offset_db, caplog):
        power_db = table()["gain_db"] + offset_db
        with caplog.at_level(logging.WARNING):
            found = sp.predict_map(model(), measurements=table(gain_db=power_db), **COARSE)
        assert np.linalg.norm(found.attrs["transmitter_m"] - TX) < 1.5
        warned = "powers were measured and no path gains" in caplog.text
        assert warned or abs(found.attrs["measured_offset_db"] - offset_db) < 10.0

    def test_powers_through_walls_of_an_unknown_material(self):
        through_walls = sp.LinkModel(HOUSE, None, sp.TraceSettings(2.4e9))
        power_db = through_walls.predict(TX, PLACES).gain_mean_db - 30.0
        found = sp.predict_map(through_walls, measurements=table(gain_db=power_db), **COARSE)
        assert np.linalg.norm(found.attrs["transmitter_m"] - TX) < 2.0
        assert float(found.p_transmitter.sum()) == pytest.approx(1.0)
        assert found.attrs["measured_offset_db"] == pytest.approx(-30.0, abs=10.0)
        assert "wall_material" in found.attrs

    def test_its_height_may_be_known(self):
        found = sp.predict_map(model(), measurements=table(tx=[np.nan, np.nan, 2.0]), **COARSE)
        assert found.attrs["transmitter_m"][2] == 2.0

    @pytest.mark.usefixtures("command_line")
    def test_the_command_needs_no_transmitter(self, tmp_path):
        sp.save_map(HOUSE, tmp_path / "house.yaml")
        rows = [f"{x},{y},{gain}" for (x, y, _), gain in zip(PLACES, table()["gain_db"], strict=True)]
        (tmp_path / "measured.csv").write_text("\n".join(["rx_x,rx_y,gain_db", *rows, ""]))
        command = ["predict", tmp_path / "house.yaml", "--measurements", tmp_path / "measured.csv"]
        command += ["--out", tmp_path / "out", "--spacing", 1.2, "--predictor", "paper", "--format", ".nc"]
        result = CliRunner().invoke(app, [str(word) for word in command])
        assert result.exit_code == 0, result.output
        assert "p_transmitter" in sp.load_coverage(tmp_path / "out" / "coverage.nc")


def test_what_is_refused():
    with pytest.raises(PositionError, match="tx = None: give x, y and z in metres, or measurements"):
        sp.predict_map(model(), **OPTIONS)
    message = "5 of 5 links without the position of the transmitter: give tx"
    with pytest.raises(MeasurementError, match=message):
        sp.predict_map(model(), TX, measurements=table())
    with pytest.raises(MeasurementError, match=message):
        sp.calibrate_materials(HOUSE, table())
    tx = np.tile(TX, (5, 1)) + np.arange(5)[:, None] * [0.3, 0.0, 0.0]
    with pytest.raises(MeasurementError, match="tx = None, and measurements are of several transmitters"):
        sp.predict_map(model(), measurements=table(tx=tx), **OPTIONS)
    closet = drawn("###\n#.#\n###", resolution_m=0.1)
    with pytest.raises(PositionError, match="a transmitter can be nowhere"):
        sp.predict_map(closet, measurements=sp.Measurements(None, [[0.15, 0.15, 1.5]], [-60.0]), spacing_m=0.05)
    for half_known in ((np.nan, 1.0, 1.5), (1.0, 1.0, np.nan)):
        with pytest.raises(MeasurementError, match=r"tx\[0, \d\] = (nan|1)"):
            sp.Measurements(half_known, PLACES, np.full(5, -70.0))


def test_a_position_that_is_not_used_is_named(caplog):
    with caplog.at_level(logging.WARNING):
        sp.predict_map(model(), measurements=table(tx=TX), **COARSE)
    assert "the position of the transmitter in the measurements is not used" in caplog.text


def test_links_without_a_transmitter_are_read(tmp_path):
    (tmp_path / "measured.csv").write_text("tx_z,rx_x,rx_y,gain_db\n2.1,1,2,-70\n")
    found = measurements_of(tmp_path / "measured.csv")
    assert (found.tx_known.tolist(), found.tx[0, 2]) == ([False], 2.1)


def test_moments_and_draws_of_a_posterior():
    probability = np.array([[0.05, 0.0, 0.65], [0.0, 0.28, 0.02]])
    posterior = TransmitterPosterior(np.array([0.0, 1.0, 2.0]), np.array([0.0, 5.0]), 1.5, probability)
    assert likely_region(probability).tolist() == [[False, False, True], [False, True, False]]
    assert posterior.position_m.tolist() == [2.0, 0.0, 1.5]
    assert posterior.std_m == pytest.approx(np.sqrt(0.05 * 4 + 0.28 * 26 + 0.02 * 25))
    positions_m, weights, _ = posterior.draw(10)
    assert dict(zip(map(tuple, positions_m[:, :2].tolist()), weights.tolist(), strict=True)) == {
        (0.0, 0.0): 0.1,
        (2.0, 0.0): 0.6,
        (1.0, 5.0): 0.3,
    }


def test_few_draws_have_the_spread_of_a_posterior():
    x_m, y_m = np.arange(0.0, 10.0, 0.25), np.arange(0.0, 8.0, 0.25)
    probability = np.exp(-0.5 * (((x_m - 5.0) / 1.2) ** 2 + ((y_m[:, None] - 4.0) / 0.8) ** 2))
    posterior = TransmitterPosterior(x_m, y_m, 1.5, probability / probability.sum())
    positions_m, weights, _ = posterior.draw(4)
    assert weights.tolist() == [0.25] * 4
    np.testing.assert_allclose(weights @ positions_m, posterior.position_m, atol=0.6)
    square_m2 = weights @ ((positions_m - posterior.position_m) ** 2).sum(axis=1)
    assert 0.5 < np.sqrt(square_m2) / posterior.std_m < 1.5


@pytest.mark.parametrize("through_walls_hz", [None, 2.4e9])
def test_hundreds_of_powers_take_no_more_links_than_some(through_walls_hz):
    hall, links, errors_m = sp.map_from_array(np.zeros((24, 36), int), resolution_m=0.5), [], []
    tx_m = np.array([[11.3, 4.2, 1.5]])
    for count in (20, 500):
        rng, asked = np.random.default_rng(3), []
        rx_m = rng.uniform([1.0, 1.0, 1.5], [17.0, 11.0, 1.5], (count, 3))
        power = free_space(tx_m, rx_m)[0].gain_mean_db + 4.0 * rng.normal(size=count) - 30.0

        def predict(place_m, points_m, asked=asked):
            asked.append(len(points_m))
            return free_space(place_m, points_m)

        clear = functools.partial(clear_of_walls, hall)
        found = locate_transmitter(
            hall, sp.Measurements(None, rx_m, power), clear, predict, no_progress, through_walls_hz=through_walls_hz
        )
        links.append(asked)
        errors_m.append(np.linalg.norm(found.position_m - tx_m))
        assert float(found.probability.sum()) == pytest.approx(1.0)
    assert max(map(len, links)) <= 2 * (MOST_GROUPS if through_walls_hz is None else MOST_TRACED)
    assert sum(links[1]) <= 1.3 * sum(links[0]) <= 1.3 * MOST_GROUPS * 1500 / 2
    assert errors_m[1] < min(1.0, errors_m[0] + 0.3)


def free_space(place_m, points_m):
    gain_db = free_space_gain_db(np.linalg.norm(points_m - place_m, axis=1), 2.4e9)
    los = np.array([0.0, 1.0, 0.0])[:, None] + 0.0 * gain_db
    return sp.LinkPrediction.of_parts(los, np.stack([gain_db] * 3), 0.0 * los), 0.0 * gain_db, np.ones(len(gain_db))


@pytest.mark.parametrize("sensitivity_db", [-150.0, -88.0])  # a third is not received
def test_correlated_errors_of_powers_are_allowed_for(sensitivity_db):
    hall, found = sp.map_from_array(np.zeros((24, 36), int), resolution_m=0.5), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        tx_m, rx_m = (rng.uniform([1.0, 1.0, 1.5], [17.0, 11.0, 1.5], (count, 3)) for count in (1, 30))
        covariance_db2 = 16.0 * np.exp(-cdist(rx_m, rx_m) / 4.0) + 9.0 * np.eye(30)
        power = free_space(tx_m, rx_m)[0].gain_mean_db + rng.multivariate_normal(np.full(30, -30.0), covariance_db2)
        measured = sp.Measurements(None, rx_m, power, sensitivity_db=sensitivity_db)
        clear = functools.partial(clear_of_walls, hall)
        posterior = locate_transmitter(hall, measured, clear, free_space, no_progress, through_walls_hz=2.4e9)
        region = likely_region(posterior.probability)
        cell = np.linalg.norm(posterior.points_m - tx_m, axis=1).argmin()
        found.append((np.linalg.norm(posterior.position_m - tx_m), region.ravel()[cell], region.mean()))
    errors_m, inside, area = np.transpose(found)
    assert np.median(errors_m) < 2.0
    assert inside.mean() >= 0.8
    assert area.mean() < 0.25


def test_mixtures_have_the_moments_of_their_parts():
    ones = np.ones(2)
    parts = [
        sp.LinkPrediction.of_parts(
            np.stack([p_outage * ones, 0.0 * ones, (1.0 - p_outage) * ones]),
            np.stack([-150.0 * ones, -60.0 * ones, mean_db * ones]),
            np.stack([0.0 * ones, ones, std_db * ones]),
        )
        for p_outage, mean_db, std_db in ((0.2, -80.0, 4.0), (0.6, -100.0, 8.0))
    ]
    mixed = sp.LinkPrediction.mixture(parts, np.array([0.25, 0.75]))
    np.testing.assert_allclose(mixed.p_outage, 0.25 * 0.2 + 0.75 * 0.6)
    np.testing.assert_allclose(mixed.gain_mean_db, 0.25 * parts[0].gain_mean_db + 0.75 * parts[1].gain_mean_db)
    square = [each.gain_std_db**2 + each.gain_mean_db**2 for each in parts]
    np.testing.assert_allclose(mixed.gain_std_db**2 + mixed.gain_mean_db**2, 0.25 * square[0] + 0.75 * square[1])
    assert (mixed.gain_los_mean_db == -60.0).all()
