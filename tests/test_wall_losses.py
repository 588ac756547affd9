"""Losses of the walls of a map, and the prediction of links through walls."""

import functools
import logging
import re
from dataclasses import replace

import numpy as np
import pytest
from predictor_links import QUIET

import sionna_partial as sp
from sionna_partial.arrays import Floats
from sionna_partial.constants import CellState, LinkState
from sionna_partial.lab.datasets.home_links import home_links
from sionna_partial.lab.datasets.traces import LinkTraces, settings_for
from sionna_partial.lab.metrics import measure
from sionna_partial.prediction.features import LinkFeatures, mean_wall_loss_db
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.prediction.unseen_walls import (
    DISPERSION,
    LARGEST_LOSS_DB,
    LOSS_OF_WALL,
    SEEN_STD_DB,
    UNSEEN_STD,
    WALL_LOSSES,
    WallTrace,
    by_mean_losses,
)
from sionna_partial.tracing.power import MOST_LOSS_DB, wall_loss_db

WIFI = sp.TraceSettings(5e9, max_depth=2)
OPAQUE = replace(WIFI, refraction=False)
DRYWALL = sp.SceneSettings(material="drywall")
TX, RX = (1.0, 2.0, 1.5), [(x, 2.0, 1.5) for x in (3.0, 5.0, 6.0, 7.0)]
"""Transmitter, and receivers in a row, the last far in the unknown [m]: traced together, they need the same kernels."""


def half_seen() -> sp.PartialMap:
    """Two rooms behind each other, of which the robot saw the first and the door."""
    state = np.zeros((40, 80), dtype=np.uint8)
    state[[0, -1]], state[:, [0, -1]], state[:15, 40] = 1, 1, 1
    state[:, 45:] = 2
    return sp.PartialMap(state, 0.1)


def all_seen() -> sp.PartialMap:
    """The same rooms, complete."""
    state = np.where(half_seen().state == 2, 0, half_seen().state).astype(np.uint8)
    state[[0, -1]], state[:, -1] = 1, 1
    return sp.PartialMap(state, 0.1)


def test_walls_of_a_map_count_by_their_cells() -> None:
    partial, settings = half_seen(), (WIFI, sp.SceneSettings())
    losses = [wall_loss_db(sp.Material.named(name), 5e9) for name in ("drywall", "metal")]
    assert mean_wall_loss_db(partial, *settings) == losses[0]
    front = partial.with_wall_material("metal", np.indices(partial.shape)[0] == 0)
    fraction = np.mean(np.nonzero(partial.state == CellState.WALL)[0] == 0)
    assert mean_wall_loss_db(front, *settings) == pytest.approx(np.dot([1.0 - fraction, fraction], losses))
    nothing = sp.PartialMap(np.full((3, 3), CellState.UNKNOWN), 0.1)
    assert mean_wall_loss_db(nothing, *settings) == losses[0]
    assert mean_wall_loss_db(partial, replace(WIFI, refraction=False), settings[1]) == MOST_LOSS_DB


def test_longer_unobserved_lines_lose_more_and_are_less_certain() -> None:
    model = sp.LinkModel(half_seen(), trace_settings=WIFI, scene_settings=DRYWALL)
    found = model.predict(TX, RX)
    assert found.p_los[0] == 1.0
    assert (np.diff(found.p_los) < 0.0).all()
    assert (np.diff(found.gain_mean_db) < 0.0).all()
    assert (np.diff(found.gain_std_db) > 0.0).all()
    np.testing.assert_allclose(found.p_los + found.p_nlos + found.p_outage, 1.0)


@functools.cache
def traced_row() -> LinkFeatures:
    return sp.LinkModel(half_seen(), trace_settings=WIFI).features(TX, RX)


def some_links(count: int, wall_loss_db: float = 5.0) -> LinkFeatures:
    """Return equal links that are traced in LOS, with walls of some loss."""
    phi = traced_row().take(np.full(count, len(RX) - 1))
    assert phi.context is not None
    return replace(phi, context=replace(phi.context, wall_loss_db=np.full(count, wall_loss_db)))


def predicted(phi: LinkFeatures, walls: Floats, max_walls: int = 8) -> LinkPrediction:
    return LinkPrediction.of_parts(*by_mean_losses(WallTrace.of(phi), walls, max_walls))


def test_without_unseen_walls_and_in_outage_nothing_is_uncertain() -> None:
    phi = some_links(3)
    states = np.array([LinkState.LOS, LinkState.NLOS, LinkState.OUTAGE], dtype=np.uint8)
    phi = replace(phi, link_state=states, gain_db=np.append(phi.gain_db[:2], -150.0))
    found = predicted(phi, np.array([0.0, 0.0, 2.0]))
    assert found.p_los.tolist() == [1.0, 0.0, 0.0]
    assert found.p_outage.tolist() == [0.0, 0.0, 1.0]
    np.testing.assert_allclose(found.gain_mean_db, phi.gain_db)
    np.testing.assert_allclose(found.gain_std_db, [SEEN_STD_DB, SEEN_STD_DB, 0.0])


def test_links_through_more_walls_than_a_path_may_cross_are_often_in_outage() -> None:
    phi, walls = some_links(6, 2.0), np.array([0.0, 1.0, 4.0, 8.0, 16.0, 24.0])
    few, default, most = (predicted(phi, walls, max_walls) for max_walls in (4, 8, 16))
    for found in (few, default, most):
        np.testing.assert_allclose(found.p_los + found.p_nlos + found.p_outage, 1.0)
        assert (np.diff(found.p_outage) >= 0.0).all()
    assert default.p_outage[1] < 1e-3
    assert 0.1 < default.p_outage[4] < 0.5
    assert (few.p_outage[2:] > default.p_outage[2:]).all()
    assert (default.p_outage[2:] > most.p_outage[2:]).all()


def test_intervals_hold_gains_behind_walls_of_unknown_number() -> None:
    rng, phi, walls = np.random.default_rng(1), some_links(4000), np.full(4000, 3.0)
    count = rng.poisson(walls * rng.gamma(1.0 / DISPERSION, DISPERSION, 4000))
    loss_db = LOSS_OF_WALL * 5.0 * count
    gain_db = phi.gain_db - loss_db / (1.0 + loss_db / LARGEST_LOSS_DB)
    gain_db += rng.normal(size=4000) * np.hypot(SEEN_STD_DB, UNSEEN_STD * 5.0 * np.sqrt(count))
    state = np.where(count == 0, LinkState.LOS, LinkState.NLOS).astype(np.uint8)
    found = predicted(phi, walls, max_walls=16)
    assert 0.85 < measure(found, state, gain_db).coverage_90 < 0.97


def test_the_default_through_walls() -> None:
    """The default predictor below 24 GHz, named in the coverage; a predictor that was asked for predicts."""
    options = {"spacing_m": 0.5, "trace_settings": WIFI}
    coverage = sp.predict_map(half_seen(), TX, **options)
    assert coverage.attrs["predictor"] == WALL_LOSSES
    assert coverage.attrs["walls"] == "through walls"
    assert float(coverage.p_outage.max()) < 1e-3
    opaque = sp.predict_map(half_seen(), TX, spacing_m=0.5, trace_settings=OPAQUE)
    assert opaque.attrs["predictor"] == "map"
    assert sp.predict_map(half_seen(), TX, predictor="paper", **options).attrs["predictor"] == "paper"


@QUIET
def test_predictor_of_links_through_walls(caplog: pytest.LogCaptureFixture) -> None:
    """It predicts links through walls without a warning, and those on opaque walls with one."""
    links = home_links(all_seen(), "home", sp.lab.DatasetSettings(links_per_home=20, stages=(0, 5), trace=WIFI))
    assert (links.context.wall_loss_db < MOST_LOSS_DB).all()
    learning = settings_for(LinkTraces(5e9, diffraction=True, through_walls=True), networks="paths", passes=2)
    predictor = sp.Predictor.fit(links.features, links.link_state, links.gain_db, settings=replace(learning, steps=5))
    assert np.isfinite(predictor.predict(links.features).gain_mean_db).all()
    opaque = ["trained through walls, and is used on opaque walls"]
    for trace, expected in ((WIFI, []), (OPAQUE, opaque)):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            sp.LinkModel(half_seen(), predictor, trace).predict(TX, RX)
        assert re.findall("trained .* used .* walls", "\n".join(caplog.messages)) == expected
