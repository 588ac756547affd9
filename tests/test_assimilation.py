"""Measured gains change correlated predictions, and no others."""

import functools
import logging
from dataclasses import fields

import numpy as np
import pytest
from extruded import drawn
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.errors import MeasurementError, PositionError
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.measurements.evidence import MOST_POINTS, positive

HOUSE = drawn(
    """
    ########################
    #..........#??????????##
    #..........#???????????#
    #..........#???????????#
    #......................?
    #......................?
    #..........#..........##
    #..........#..........##
    ########################
    """,
    resolution_m=0.4,
)
TX = np.array([8.0, 2.2, 1.5])
UNSEEN = np.array([7.0, 2.8, 1.5])
RNG = np.random.default_rng(0)
LEFT = np.column_stack([RNG.uniform(0.6, 4.2, 30), RNG.uniform(0.6, 3.0, 30), np.full(30, 1.5)])
OPTIONS = {"spacing_m": 0.4}


@functools.cache
def model() -> sp.LinkModel:
    """Predict the house, warm: links that several tests ask for are traced once."""
    return sp.LinkModel(HOUSE, "paper")


def prior(count: int, p_outage: float = 0.5, mean_db: float = -95.0, std_db: float = 8.0) -> sp.LinkPrediction:
    ones = np.ones(count)
    return sp.LinkPrediction.of_parts(
        np.stack([p_outage * ones, 0.0 * ones, (1 - p_outage) * ones]),
        np.stack([-150.0 * ones, -70.0 * ones, mean_db * ones]),
        np.stack([0.0 * ones, 3.0 * ones, std_db * ones]),
    )


def fitted(
    rx_m: NDArray[np.float64],
    gain_db: NDArray[np.float64],
    partial: sp.PartialMap = HOUSE,
    p_outage: float = 0.5,
    **options: object,
) -> Assimilation:
    measured = sp.Measurements(UNSEEN, rx_m, gain_db, **options)
    return Assimilation.fit(partial, UNSEEN, measured, prior(len(rx_m), p_outage))


def test_what_is_measured_is_what_is_predicted_there():
    gains_db = np.where(LEFT[:, 0] > 2.5, -85.0, -100.0)
    after = fitted(LEFT, gains_db, std_db=1.0).update(LEFT, prior(30))
    assert np.abs(after.gain_mean_db - gains_db).mean() < 4.0
    assert (after.gain_std_db < prior(30).gain_std_db / 2).all()
    assert (after.p_outage < 0.05).all()


def test_neighbours_hear_what_a_measurement_hears():
    at, beside = LEFT[:1], LEFT[:1] + np.array([0.5, 0.0, 0.0])
    heard, lost = (fitted(at, np.array([gain_db]), sensitivity_db=-120.0) for gain_db in (-90.0, -120.0))
    assert heard.update(beside, prior(1)).p_outage[0] < 0.3
    assert lost.update(beside, prior(1)).p_outage[0] > 0.6


def test_walls_stop_what_measurements_tell():
    closed = drawn("#######\n#..#..#\n#..#..#\n#######")
    here, there = np.array([[1.0, 1.0, 1.5]]), np.array([[2.5, 1.0, 1.5]])
    measured = fitted(here, np.array([-80.0]), closed)
    before, after = prior(1), measured.update(there, prior(1))
    assert all(getattr(before, each.name) == getattr(after, each.name) for each in fields(after))
    assert measured.update(here, prior(1)).p_outage[0] < 0.3


def test_where_nothing_was_seen_measurements_tell_of_places_farther_away():
    """A seen transmitter: what misleads predictions are walls not seen, and these shadow whole rooms."""
    seen_tx, at = LEFT[0], UNSEEN[None]
    measured = sp.Measurements(seen_tx, at, [-90.0])
    posterior = Assimilation.fit(HOUSE, seen_tx, measured, prior(1))
    farther, in_sight = posterior.update([(8.6, 2.8, 1.5), (8.6, 1.0, 1.5)], prior(2)).p_outage
    assert farther < 0.4
    assert in_sight > 0.48


def test_a_certain_state_stays_and_its_gain_heeds_the_measurement():
    certain = prior(30, p_outage=0.0, mean_db=-80.0, std_db=0.0)
    measured = sp.Measurements(UNSEEN, LEFT, np.full(30, -84.0))
    posterior = Assimilation.fit(HOUSE, UNSEEN, measured, certain)
    after = posterior.update(LEFT, certain)
    assert (after.p_nlos == 1.0).all()
    assert (after.gain_std_db == 0.0).all()
    assert (after.gain_mean_db < -80.5).all()
    assert np.abs(after.gain_mean_db + posterior.offset_db + 84.0).max() < posterior.noise_db


def test_what_measurements_have_in_common_is_an_offset():
    """Powers in dBm, with transmit power and antenna gains, give the same as path gains."""
    gains_db = np.where(LEFT[:, 0] > 2.5, -90.0, -98.0)
    truth, shifted = fitted(LEFT, gains_db, p_outage=0.0), fitted(LEFT, gains_db + 60.0, p_outage=0.0)
    assert abs(truth.offset_db) < 1.0
    assert 45.0 < shifted.offset_db < 75.0
    after, other = (each.update(LEFT, prior(30, 0.0)).gain_mean_db for each in (truth, shifted))
    assert np.abs(after - gains_db).max() < 4.0
    assert np.abs(other + shifted.offset_db - gains_db - 60.0).max() < 4.0


@pytest.mark.parametrize(("low_db", "is_logged"), [(0.0, False), (12.0, True)])
def test_gains_that_are_low_everywhere_are_logged_by_the_error_of_their_offset(caplog, low_db, is_logged):
    gain_db = wifi().predict(TX, LEFT).gain_mean_db - low_db
    with caplog.at_level(logging.WARNING):
        coverage = sp.predict_map(wifi(), TX, spacing_m=1.6, measurements=sp.Measurements(TX, LEFT, gain_db))
    assert ("dB below the predicted ones: taken for an offset" in caplog.text) == is_logged
    assert coverage.attrs["measured_offset_db"] == pytest.approx(-low_db, abs=3.0)


def test_an_offset_is_known_better_from_more_measurements():
    gains_db = np.where(LEFT[:, 0] > 2.5, -60.0, -68.0)
    errors_db = [fitted(LEFT[:count], gains_db[:count], p_outage=0.0).offset_std_db for count in (3, 30)]
    assert 0.1 < errors_db[1] < errors_db[0] < 12.0


def test_one_deep_value_is_no_offset():
    deep = fitted(LEFT[:1], np.array([-120.0]), p_outage=0.05)
    assert abs(deep.offset_db) < 5.0
    after = deep.update(LEFT[:1], prior(1, p_outage=0.05))
    assert after.gain_mean_db[0] < -112.0


def test_powers_say_how_deep_shadows_are():
    """Predicted shadows are twice as deep as those that a real radio met."""
    free_db = -61.4 - 20.0 * np.log10(np.linalg.norm(LEFT - UNSEEN, axis=1))
    depth_db = np.linspace(0.0, 40.0, 30)
    certain = prior(30, p_outage=0.0, mean_db=free_db - depth_db, std_db=0.0)
    measured = sp.Measurements(UNSEEN, LEFT, free_db - depth_db / 2 + 50.0)
    posterior = Assimilation.fit(HOUSE, UNSEEN, measured, certain)
    assert posterior.shadow_scale == pytest.approx(0.5, abs=0.1)
    assert np.abs(posterior.update(LEFT, certain).gain_mean_db + posterior.offset_db - measured.gain_db).max() < 4.0


def test_other_transmitters_teach_the_loss_of_walls_and_the_offset():
    """Walls cost half of what is predicted, and radios are 50 dB too strong: known from others before five powers."""
    depth_db, through_walls = np.linspace(0.0, 40.0, 30), {"frequency_hz": 2.4e9, "through_walls": True}

    def links(tx_m: NDArray[np.float64]) -> tuple[sp.Measurements, sp.LinkPrediction]:
        free_db = -40.0 - 20.0 * np.log10(np.linalg.norm(LEFT - tx_m, axis=1))
        walls = prior(30, p_outage=0.0, mean_db=free_db - depth_db, std_db=0.0)
        return sp.Measurements(tx_m, LEFT, free_db - depth_db / 2.0 + 30.0), walls

    others = [
        Assimilation.fit(HOUSE, tx_m, *links(tx_m), **through_walls)
        for tx_m in (TX, TX + np.array([0.4, -0.8, 0.0]), TX - np.array([1.2, 0.4, 0.0]))
    ]
    measured, walls = links(UNSEEN)
    shallow = np.arange(3)
    alone, taught = (
        Assimilation.fit(HOUSE, UNSEEN, measured.take(shallow), walls.take(shallow), others=some, **through_walls)
        for some in ([], others)
    )
    assert taught.shadow_scale == pytest.approx(0.5, abs=0.25)
    assert abs(taught.shadow_scale - 0.5) < abs(alone.shadow_scale - 0.5) / 2.0
    error_db = [
        np.abs(each.update(LEFT, walls).gain_mean_db + each.offset_db - measured.gain_db).mean()
        for each in (taught, alone)
    ]
    assert error_db[0] < 0.6 * error_db[1]


def test_contradictions_count_as_noise():
    twice = np.concatenate([LEFT, LEFT + np.array([0.05, 0.0, 0.0])])
    agreeing, contrary = (fitted(twice, np.repeat([-90.0, -90.0 - gap], 30)) for gap in (0.5, 18.0))
    assert contrary.noise_db > 2 * agreeing.noise_db
    assert contrary.update(LEFT, prior(30)).gain_std_db.mean() > agreeing.update(LEFT, prior(30)).gain_std_db.mean()
    assert fitted(LEFT, np.full(30, -90.0), std_db=2.5).noise_db == pytest.approx(2.5)


def test_thousands_of_measurements_are_averaged_where_they_are_dense():
    many = np.column_stack([RNG.uniform(0.6, 4.2, 5000), RNG.uniform(0.6, 3.0, 5000), np.full(5000, 1.5)])
    measured = fitted(many, -90.0 + 3.0 * RNG.standard_normal(5000))
    assert len(measured._fits[0].weights) <= MOST_POINTS
    assert np.abs(measured.update(LEFT, prior(30)).gain_mean_db + 90.0).max() < 4.0


class TestPredictMap:
    def table(self) -> dict[str, object]:
        return {"tx": TX, "rx": LEFT, "gain_db": np.full(30, -75.0), "std_db": np.full(30, 1.0)}

    def test_a_hidden_transmitter_is_heard(self):
        before = sp.predict_map(model(), UNSEEN, **OPTIONS)
        table = self.table() | {"tx": UNSEEN}
        after = sp.predict_map(model(), UNSEEN, measurements=table, **OPTIONS)
        left = (after.x < 4.0) & (after.y < 3.0) & after.valid
        assert float(after.p_outage.where(left).mean()) < float(before.p_outage.where(left).mean())
        assert float(np.abs(after.gain_mean_db + 75.0).where(left).mean()) < 4.0
        assert after.attrs["measured_links"] == len(LEFT)
        assert after.attrs["measured_noise_db"] == pytest.approx(1.0)

    def test_others_in_the_file_count_through_walls(self):
        positions = np.stack([TX, TX - [0.0, 0.8, 0.0], [0.2, 0.2, 1.5], [99.0, 0.0, 1.5]])
        table = {"tx": np.repeat(positions, 30, axis=0), "rx": np.tile(LEFT, (4, 1)), "gain_db": np.full(120, -75.0)}
        one = {name: values[:30] for name, values in table.items()}
        both = {name: values[:60] for name, values in table.items()}
        scales = [
            sp.predict_map(wifi(), TX, measurements=each, **OPTIONS).attrs["measured_shadow_scale"]
            for each in (one, both, table)
        ]
        assert scales[1] == scales[2] != scales[0]

    def test_unusable_measurements_are_refused(self):
        many = {"rx": np.repeat(LEFT, 1000, axis=0), "gain_db": np.full(30_000, -75.0), "std_db": 1.0}
        for change, error, message in (
            ({"tx": TX - 2.0}, MeasurementError, "none within 0.5 m of tx"),
            ({"rx": np.tile([0.2, 0.2, 1.5], (30, 1))}, MeasurementError, "in walls or at the transmitter"),
            ({"rx": LEFT + 99.0}, PositionError, "rx of the measurements"),
            (many, MeasurementError, "30,000 links of this transmitter, more than 20,000"),
            ({"std_db": [1.0, 2.0]}, MeasurementError, r"std_db has shape \(2,\)"),
            ({"sensitivity_db": -999}, MeasurementError, "sensitivity_db = -999 is not allowed"),
        ):
            with pytest.raises(error, match=message):
                sp.predict_map(model(), TX, measurements=self.table() | change, **OPTIONS)
        with pytest.raises(MeasurementError, match="prior has 3 links, and measured 30: give the same links"):
            Assimilation.fit(HOUSE, UNSEEN, sp.Measurements(UNSEEN, LEFT, np.full(30, -84.0)), prior(3))


def test_through_walls_the_variance_is_of_process_offset_factor_and_fading_together():
    """The predicted variance equals the Gaussian posterior of a new power, whose offset and factor are as uncertain."""
    measured = sp.Measurements(UNSEEN, LEFT[:6], [-80.0, -84.0, -88.0, -81.0, -90.0, -79.0])
    posterior = Assimilation.fit(HOUSE, UNSEEN, measured, prior(6, 0.0, std_db=0.0), through_walls=True)
    (fit,), links, rx = posterior._fits, posterior._links, LEFT[6:]
    measured_at = links.walks.points_m
    free_db = [links.free_space_db(points_m) for points_m in (measured_at, rx)]
    given, new = (np.stack([np.ones(len(each)), -95.0 - each]) for each in free_db)
    across = fit.kind.trace_std_db**2 * links.correlation(rx, fit.kind) + given.T @ fit.kind.covariance @ new
    among = fit.kind.trace_std_db**2 * positive(links.correlation(measured_at, fit.kind))
    among = among + given.T @ fit.kind.covariance @ given
    explained = (across * np.linalg.solve(among + fit.noise_db**2 * np.eye(6), across)).sum(axis=0)
    total = fit.kind.trace_std_db**2 + (new * (fit.kind.covariance @ new)).sum(axis=0) + fit.fading_db**2
    found = posterior.update(rx, prior(len(rx), 0.0, std_db=0.0))
    np.testing.assert_allclose(found.gain_std_db**2, total - explained)


@functools.cache
def wifi() -> sp.LinkModel:
    return sp.LinkModel(HOUSE, trace_settings=sp.TraceSettings(5e9))


SOURCES = {"a": TX, "b": TX - [0.0, 0.8, 0.0]}


def measured_links(offset_db: float = 0.0, **changes: object) -> dict[str, np.ndarray]:
    """Gains of two transmitters of the map, and of a third one, that fall off with distance; every ninth is lost."""
    tx = np.repeat([*SOURCES.values(), LEFT[0] + [0.0, 0.0, 0.5]], len(LEFT), axis=0)
    rx = np.tile(LEFT, (3, 1))
    gain_db = -62.0 - 25.0 * np.log10(np.linalg.norm(rx - tx, axis=1) + 0.1) + 3.0 * np.sin(9.0 * rx[:, 0]) + offset_db
    return {"tx": tx, "rx": rx, "gain_db": np.where(np.arange(len(rx)) % 9 == 4, -150.0, gain_db), **changes}


LIMITS_DB = {"sensitivity_db": -95.0}


@pytest.mark.parametrize(
    ("house", "kind"), [(model, "one"), (model, "unknown position"), (wifi, "one"), (wifi, "several")]
)
def test_the_gain_of_a_flat_antenna_is_added_to_predictions(house, kind):
    """With measurements that contain the gain, predictions rise by exactly the gain where there is a path."""
    gain_db = 7.0
    measured = measured_links(-25.0 if kind == "several" else 0.0, **LIMITS_DB if kind == "one" else {})
    tx = SOURCES if kind == "several" else TX
    if kind == "unknown position":
        tx, measured = None, {name: values[:8] for name, values in measured.items() if name != "tx"}
    before = sp.predict_map(house(), tx, spacing_m=1.6, measurements=measured)
    flat = sp.AntennaPattern("flat", gain_db, np.zeros(360), np.zeros(360))
    louder = {name: values + gain_db if name.endswith("_db") else values for name, values in measured.items()}
    after = sp.predict_map(house(), tx, spacing_m=1.6, tx_antenna=flat, measurements=louder)
    for name in ("p_los", "p_nlos", "p_outage", "p_indoor"):
        np.testing.assert_allclose(after[name], before[name], atol=1e-6)
    for name in ("gain_los_mean_db", "gain_nlos_mean_db"):
        seen = (before["valid"] == 1) & (before[name] > -145.0)
        np.testing.assert_allclose((after[name] - before[name]).to_numpy()[seen], gain_db, atol=2e-5)
    for name in ("measured_offset_db", "measured_shadow_scale", "measured_noise_db"):
        assert after.attrs.get(name) == pytest.approx(before.attrs.get(name), abs=1e-6)


def test_the_antenna_of_another_transmitter_changes_nothing():
    flat = sp.AntennaPattern("flat", 15.0, np.zeros(360), np.zeros(360))
    alone = sp.predict_map(wifi(), SOURCES, spacing_m=1.6, measurements=measured_links())
    table = measured_links()
    table["gain_db"][len(LEFT) : 2 * len(LEFT)] += 15.0
    other = sp.predict_map(wifi(), SOURCES, spacing_m=1.6, measurements=table, tx_antenna={"a": None, "b": flat})
    np.testing.assert_allclose(other.sel(tx="a")["gain_mean_db"], alone.sel(tx="a")["gain_mean_db"], atol=2e-5)
