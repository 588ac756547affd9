"""The shipped predictor, evaluated on two shipped homes that it was not trained on, is as good as it was or better."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from coverage_cases import shipped
from predictor_links import QUIET, assert_symmetric

import sionna_partial as sp
from sionna_partial.lab.datasets.home_links import home_links
from sionna_partial.lab.datasets.table import LinkTable
from sionna_partial.lab.evaluation import WITH_INDOOR, Evaluation
from sionna_partial.prediction.map_networks import MapFeatures
from sionna_partial.prediction.space import MapSpace
from sionna_partial.resources import scenes_folder

pytestmark = QUIET

HOMES = ("apartment", "house")
SETTINGS = sp.lab.DatasetSettings(links_per_home=200, transmitters_per_home=4, stages=(100, 200))


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    tables = (home_links(sp.load_map(scenes_folder() / name / "complete"), name, SETTINGS) for name in HOMES)
    return sp.lab.evaluate(None, LinkTable.concatenate(tables))


def test_figures_of_merit_stay_in_their_band(evaluation: Evaluation) -> None:
    for receivers, model, stage, accuracy, rmse_db in (
        ("indoor", "predictor", 100, 0.59, 26.2),
        ("indoor", "predictor", 200, 0.69, 21.7),
        ("anywhere", WITH_INDOOR, 200, 0.84, 18.3),
    ):
        (row,) = evaluation.select(receivers=receivers, model=model, stage=stage, ends_seen="all")
        assert row.metrics.links == 2 * SETTINGS.links_per_home
        assert row.metrics.accuracy >= accuracy - 0.05
        assert row.metrics.rmse_db <= rmse_db + 3.0
    rows = evaluation.select(receivers="indoor", stage=200, ends_seen="all")
    metrics = {row.model: row.metrics for row in rows}
    for baseline in ("distance only", "partial trace"):
        assert metrics["predictor"].accuracy > metrics[baseline].accuracy
        assert metrics["predictor"].rmse_db < metrics[baseline].rmse_db


def explored(**sensor: float) -> LinkTable:
    """Return 100 links on a map of a home that a lidar has seen in part."""
    lidar = sp.SensorSettings(field_of_view_deg=360.0, range_m=5.0, **sensor)
    return home_links(
        sp.make_home(3, "apartment"), "home", replace(SETTINGS, links_per_home=100, stages=(100,), sensor=lidar)
    )


@pytest.fixture(scope="module")
def noisy() -> LinkTable:
    return explored(range_noise_m=0.03)


def test_links_beside_noisy_walls_are_predicted_less_certainly(noisy: LinkTable) -> None:
    """The noise near the ends of a link counts; nothing is certain beside it, on whatever map."""
    context = noisy.context
    assert context.wall_noise.max() > 0.3
    assert explored().context.wall_noise.max() < 0.05
    as_exact, enclosed = (
        replace(noisy.phi, context=replace(context, **change))
        for change in (
            {"wall_noise": np.zeros(len(noisy))},
            {"exposure": np.zeros((len(noisy), 2)), "complete": np.ones(len(noisy), dtype=bool)},
        )
    )
    rough, exact, closed = (shipped().predict(phi) for phi in (noisy.phi, as_exact, enclosed))
    both_seen = context.tx_seen & context.rx_seen & (noisy.phi.link_state != sp.LinkState.OUTAGE)
    assert np.median((rough.gain_nlos_std_db - exact.gain_nlos_std_db)[both_seen]) > 0.0
    beside = both_seen & (context.wall_noise > 0.3)
    assert beside.sum() > 5
    assert closed.gain_std_db[beside].min() > 0.1


def test_swapped_ends_are_predicted_alike(noisy: LinkTable) -> None:
    assert_symmetric(shipped(), noisy.phi)


@pytest.mark.parametrize("turn", [lambda cells: np.rot90(cells), lambda cells: cells[:, ::-1]])
def test_map_features_turn_with_the_map(turn: Callable[[Any], Any]) -> None:
    partial = sp.load_map(scenes_folder() / "apartment" / "step100")
    turned = sp.PartialMap(np.ascontiguousarray(turn(partial.state)), partial.resolution_m, (3.21, -1.7))
    features_of = MapFeatures(shipped().network.layers)
    (expected, _), (found, _) = (features_of(MapSpace(each)) for each in (partial, turned))
    np.testing.assert_allclose(found, turn(expected), atol=1e-3 * np.ptp(expected))


@pytest.mark.parametrize(("name", "frequency_hz"), [("map", 60e9), ("paper", 5e9)])
def test_seen_links_are_right_at_any_frequency(name: str, frequency_hz: float) -> None:
    partial = sp.load_map(scenes_folder() / "apartment" / "step100")
    settings = sp.TraceSettings(frequency_hz=frequency_hz)
    coverage = sp.predict_map(partial, (7.0, 9.8, 1.5), spacing_m=0.5, predictor=name, trace_settings=settings)
    seen = (coverage.partial_link_state == sp.LinkState.LOS) & (coverage.unobserved_distance_m == 0.0)
    error_db = (coverage.gain_los_mean_db - coverage.partial_gain_db).where(seen & coverage.observed)
    assert abs(error_db).max() < 0.5
