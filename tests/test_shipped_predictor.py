"""The shipped predictor, evaluated on two shipped homes that it was not trained on, is as good as it was or better."""

from dataclasses import replace

import numpy as np
import pytest
from predictor_links import QUIET

import sionna_partial as sp
from sionna_partial.datasets.home_links import home_links
from sionna_partial.datasets.link_table import LinkTable
from sionna_partial.evaluation.evaluate import WITH_INDOOR, Evaluation
from sionna_partial.prediction.map_networks import LEAST_NOISE, SEEN_WIDENING, WIDENING
from sionna_partial.resources import scenes_folder

pytestmark = QUIET

HOMES = ("apartment", "house")
SETTINGS = sp.DatasetSettings(links_per_home=200, transmitters_per_home=4, stages=(100, 200))


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    tables = (home_links(sp.load_map(scenes_folder() / name / "complete"), name, SETTINGS) for name in HOMES)
    return sp.evaluate(None, LinkTable.concatenate(tables))


@pytest.mark.parametrize(
    ("receivers", "model", "stage", "accuracy", "rmse_db"),
    [
        ("indoor", "predictor", 100, 0.59, 26.2),
        ("indoor", "predictor", 200, 0.69, 21.7),
        ("anywhere", WITH_INDOOR, 100, 0.83, 19.0),
        ("anywhere", WITH_INDOOR, 200, 0.84, 18.3),
    ],
)
def test_figures_of_merit_stay_in_their_band(
    evaluation: Evaluation, receivers: str, model: str, stage: int, accuracy: float, rmse_db: float
) -> None:
    (row,) = evaluation.select(receivers=receivers, model=model, stage=stage, ends_seen="all")
    assert row.metrics.links == 2 * SETTINGS.links_per_home
    assert row.metrics.accuracy >= accuracy - 0.05
    assert row.metrics.rmse_db <= rmse_db + 3.0


def test_map_is_worth_more_than_the_distance_alone(evaluation: Evaluation) -> None:
    rows = evaluation.select(receivers="indoor", stage=200, ends_seen="all")
    metrics = {row.model: row.metrics for row in rows}
    for baseline in ("distance only", "partial trace"):
        assert metrics["predictor"].accuracy > metrics[baseline].accuracy
        assert metrics["predictor"].rmse_db < metrics[baseline].rmse_db


@pytest.mark.parametrize(("range_noise_m", "noise"), [(0.0, 0.0), (0.03, 1.0)])
def test_a_map_with_range_noise_is_predicted_less_certainly(range_noise_m: float, noise: float) -> None:
    settings = replace(SETTINGS, stages=(100,), sensor=sp.SensorSettings(range_noise_m=range_noise_m))
    links = home_links(sp.make_home(3, "apartment"), "home", settings)
    wall_noise = links.context.wall_noise[0]
    assert wall_noise == pytest.approx(noise, abs=LEAST_NOISE)
    phi = links.phi
    as_exact = replace(phi, context=replace(phi.context, wall_noise=np.zeros(len(links))))
    wider, usual = (sp.Predictor.load().predict(each) for each in (phi, as_exact))
    both_seen = links.context.tx_seen & links.context.rx_seen
    assert 10 < both_seen.sum() < len(links) - 10
    excess = max(wall_noise - LEAST_NOISE, 0.0) / (1.0 - LEAST_NOISE)
    ratio = 1.0 + excess * np.where(both_seen, SEEN_WIDENING, WIDENING)
    np.testing.assert_allclose(wider.gain_nlos_std_db, ratio * usual.gain_nlos_std_db, rtol=1e-6)
    np.testing.assert_allclose(wider.gain_los_std_db, ratio * usual.gain_los_std_db, rtol=1e-6)
    np.testing.assert_array_equal(wider.p_los, usual.p_los)
    np.testing.assert_array_equal(wider.gain_nlos_mean_db, usual.gain_nlos_mean_db)


@pytest.mark.parametrize("name", ["map", "paper"])
@pytest.mark.parametrize("frequency_hz", [5e9, 60e9])
def test_seen_links_are_right_at_any_frequency(name: str, frequency_hz: float) -> None:
    partial = sp.load_map(scenes_folder() / "apartment" / "step100")
    settings = sp.TraceSettings(frequency_hz=frequency_hz)
    coverage = sp.predict_map(partial, (7.0, 9.8, 1.5), spacing_m=0.5, predictor=name, trace_settings=settings)
    seen = (coverage.partial_link_state == sp.LinkState.LOS) & (coverage.unobserved_distance_m == 0.0)
    error_db = (coverage.gain_los_mean_db - coverage.partial_gain_db).where(seen & coverage.observed)
    assert abs(error_db).max() < 0.5
