"""Losses of the walls of a map, homes whose walls are drawn, and the prediction of links through walls."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from predictor_links import QUIET

import sionna_partial as sp
from sionna_partial.constants import CellState, LinkState
from sionna_partial.datasets.home_links import home_links
from sionna_partial.datasets.home_walls import MIXED_FREQUENCIES_HZ, with_drawn_walls
from sionna_partial.datasets.link_table import LinkTable
from sionna_partial.errors import PredictorError, SettingsError
from sionna_partial.prediction.features import LinkFeatures, WallLosses
from sionna_partial.prediction.map_networks import context_networks, evaluate_context_networks
from sionna_partial.prediction.predictor import LinkPrediction
from sionna_partial.prediction.through_walls import WALL_LOSSES
from sionna_partial.tracing.slab import MOST_LOSS_DB, wall_loss_db, wall_reflection_db

WIFI = sp.TraceSettings(5e9, max_depth=2)


def half_seen() -> sp.PartialMap:
    """Two rooms behind each other, of which the robot saw the first and the door."""
    state = np.zeros((40, 80), dtype=np.uint8)
    state[[0, -1]], state[:, [0, -1]], state[:15, 40] = 1, 1, 1
    state[:, 45:] = 2
    return sp.PartialMap(state, 0.1)


def test_loss_of_a_wall() -> None:
    drywall = sp.Material.named("drywall")
    losses = [wall_loss_db(drywall, 1e9 * band) for band in (2.4, 5.0, 28.0)]
    assert losses == sorted(losses)
    assert 2.0 < losses[0] < 4.0
    assert wall_loss_db(sp.Material.named("metal"), 5e9) == MOST_LOSS_DB
    assert wall_reflection_db(sp.Material.named("metal"), 5e9) < 0.1 < wall_reflection_db(drywall, 5e9)


def test_walls_of_a_map_count_by_their_cells() -> None:
    partial, settings = half_seen(), (WIFI, sp.SceneSettings())
    losses = [wall_loss_db(sp.Material.named(name), 5e9) for name in ("drywall", "metal")]
    assert WallLosses.of(partial, *settings).loss_db == losses[0]
    front = partial.with_wall_material("metal", np.indices(partial.shape)[0] == 0)
    fraction = np.mean(np.nonzero(partial.state == CellState.WALL)[0] == 0)
    assert WallLosses.of(front, *settings).loss_db == pytest.approx(np.dot([1.0 - fraction, fraction], losses))
    nothing = sp.PartialMap(np.full((3, 3), CellState.UNKNOWN), 0.1)
    assert WallLosses.of(nothing, *settings).loss_db == losses[0]
    opaque = WallLosses.of(partial, replace(WIFI, refraction=False), settings[1])
    assert opaque.loss_db == MOST_LOSS_DB


def test_longer_unobserved_lines_lose_more_and_are_less_certain() -> None:
    model = sp.LinkModel(half_seen(), trace_settings=WIFI)
    phi = model.features((1.0, 2.0, 1.5), [(x, 2.0, 1.5) for x in (3.0, 5.0, 6.0, 7.0)])
    found = model.predict((1.0, 2.0, 1.5), [(x, 2.0, 1.5) for x in (3.0, 5.0, 6.0, 7.0)])
    assert phi.unobserved_distance_m[0] == 0.0
    assert found.p_los[0] == 1.0
    assert found.gain_mean_db[0] == pytest.approx(phi.gain_db[0])
    assert (np.diff(found.p_los) < 0.0).all()
    assert (np.diff(found.gain_mean_db) < 0.0).all()
    assert (np.diff(found.gain_std_db) > 0.0).all()
    np.testing.assert_allclose(found.p_los + found.p_nlos + found.p_outage, 1.0)


def test_outages_stay() -> None:
    phi = sp.LinkModel(half_seen(), trace_settings=WIFI).features((1.0, 2.0, 1.5), [(7.0, 2.0, 1.5)])
    lost = replace(phi, gain_db=np.array([-150.0]), link_state=np.array([LinkState.OUTAGE], dtype=np.uint8))
    found = LinkPrediction.of_mean_losses(lost, np.array([2.0]))
    assert (found.p_outage.item(), found.gain_mean_db.item(), found.gain_std_db.item()) == (1.0, -150.0, 0.0)


def test_the_default_through_walls() -> None:
    """The default predictor below 24 GHz, named in the coverage; a predictor that was asked for predicts."""
    tx, options = (1.0, 2.0, 1.5), {"spacing_m": 0.5, "trace_settings": WIFI}
    coverage = sp.predict_map(half_seen(), tx, **options)
    assert coverage.attrs["predictor"] == WALL_LOSSES
    assert coverage.attrs["walls"] == "through walls"
    assert float(coverage.p_outage.max()) == 0.0
    opaque = sp.predict_map(half_seen(), tx, spacing_m=0.5, trace_settings=replace(WIFI, refraction=False))
    assert opaque.attrs["predictor"] == "map"
    assert sp.predict_map(half_seen(), tx, predictor="paper", **options).attrs["predictor"] == "paper"


def test_walls_drawn_for_a_home() -> None:
    """The same for the same name, at a frequency that all materials have; its links have them, too."""
    home, settings = sp.make_home(3), sp.DatasetSettings(walls="mixed", links_per_home=8, stages=(50,))
    drawn = [with_drawn_walls(home, settings, np.random.default_rng(seed)) for seed in (0, *range(20))]
    assert drawn[0] == drawn[1]
    assert len({each.trace.frequency_hz for _, each in drawn}) == 20
    for walls, each in drawn:
        assert each.trace.through_walls
        for material in (each.scene.material, *walls.wall_materials):
            material.require_frequency(each.trace.frequency_hz)
    assert max(len(walls.wall_materials) for walls, _ in drawn) == 2
    links = home_links(home, "home", settings)
    low_hz, high_hz = MIXED_FREQUENCIES_HZ
    assert low_hz < links.features.frequency_hz < high_hz
    assert (links.context.wall_loss_db > 0.0).all()


def test_measured_powers_through_walls() -> None:
    """Offset and loss of walls are found with them, and links that are certain without are so no more."""
    state = np.where(half_seen().state == 2, 0, half_seen().state).astype(np.uint8)
    state[[0, -1]], state[:, -1] = 1, 1
    home = sp.PartialMap(state, 0.1)
    tx, rng = (1.0, 2.0, 1.5), np.random.default_rng(0)
    rx = np.column_stack([rng.uniform(0.5, 7.5, 60), rng.uniform(0.5, 3.5, 60), np.full(60, 1.4)])
    rx = rx[(np.abs(rx[:, 0] - 4.05) > 0.2) & (np.linalg.norm(rx - tx, axis=1) > 0.3)]
    model = sp.LinkModel(home, trace_settings=WIFI)
    power_dbm = model.predict(tx, rx).gain_mean_db + 17.0 + 2.0 * rng.standard_normal(len(rx))
    prior = model.predict(tx, rx[:20])
    assert (prior.gain_std_db == 0.0).any()
    measured = sp.Measurements(tx, rx[:20], power_dbm[:20])
    fitted = sp.Assimilation.fit(home, tx, measured, prior, frequency_hz=5e9, through_walls=True)
    assert fitted.offset_db == pytest.approx(17.0, abs=2.0)
    found = fitted.update(rx[20:], model.predict(tx, rx[20:]))
    error_db = found.gain_mean_db + fitted.offset_db - power_dbm[20:]
    assert np.sqrt(np.mean(error_db**2)) < 4.0
    assert (found.gain_std_db > 0.5).all()


@QUIET
@pytest.mark.parametrize("with_map", [False, True])
def test_untrained_networks_predict_the_mean_losses_of_walls(*, with_map: bool) -> None:
    """They correct them by two standard deviations at most, whatever the walls."""
    points_m = [(x, 2.0, 1.5) for x in (3.0, 5.0, 6.0, 7.0)]
    phi = sp.link_features(half_seen(), sp.trace_links(half_seen(), (1.0, 2.0, 1.5), points_m, trace_settings=WIFI))
    settings = sp.PredictorSettings("map" if with_map else "paths", through_walls=True)
    networks = context_networks(0, with_map=with_map, through_walls=True)
    found = LinkPrediction.of_parts(*evaluate_context_networks(networks, phi, settings))
    base = LinkPrediction.of_mean_losses(phi)
    for name in ("gain_los_mean_db", "gain_nlos_mean_db", "gain_los_std_db", "gain_nlos_std_db"):
        np.testing.assert_allclose(getattr(found, name), getattr(base, name), rtol=1e-6)
    np.testing.assert_allclose(found.p_los, base.p_los, atol=1e-4)
    weights = networks["link_network"].get_weights()
    networks["link_network"].set_weights([*weights[:-1], np.full_like(weights[-1], 1e3)])
    far = LinkPrediction.of_parts(*evaluate_context_networks(networks, phi, settings))
    np.testing.assert_allclose(far.gain_nlos_mean_db, base.gain_nlos_mean_db + 2.0 * base.gain_nlos_std_db, rtol=1e-6)


@QUIET
def test_a_predictor_for_walls_that_let_waves_through() -> None:
    """It reads losses and frequencies of each link, and is used where paths go through walls without a warning."""
    home, settings = sp.make_home(3), sp.DatasetSettings(walls="mixed", links_per_home=60, stages=(50, 100))
    tables = [home_links(home, name, settings) for name in ("one", "two")]
    links = LinkTable.concatenate(tables)
    assert len(np.unique(links.features.carrier_hz)) == 2
    learning = sp.PredictorSettings("paths", passes=4, steps=20, through_walls=True)
    fits = [sp.Predictor.fit(links.features, links.link_state, links.gain_db, settings=learning) for _ in range(2)]
    assert fits[0].fingerprint == fits[1].fingerprint
    found = fits[0].predict(links.features)
    assert np.isfinite(found.gain_mean_db).all()
    apart = [fits[0].predict(each.features).gain_mean_db for each in tables]
    np.testing.assert_allclose(found.gain_mean_db, np.concatenate(apart), atol=1e-3)
    with pytest.raises(PredictorError, match="parts have a frequency_hz, and none: give it for all"):
        LinkFeatures.concatenate([links.features, replace(links.features, frequency_hz=None)])
    with pytest.raises(PredictorError, match=r"frequency_hz\[0\] = 0 is not allowed: give frequencies in Hz"):
        replace(links.features, frequency_hz=np.zeros(len(links)))
    with pytest.raises(SettingsError, match="links through walls have no gradients"):
        sp.DifferentiableScene(half_seen(), predictor=fits[0])
