"""The shipped predictor, evaluated on two shipped homes that it was not trained on, is as good as it was or better."""

from dataclasses import replace

import numpy as np
import pytest
from coverage_cases import shipped
from predictor_links import QUIET

import sionna_partial as sp
from sionna_partial.datasets.home_links import home_links
from sionna_partial.datasets.shards import LinkTable
from sionna_partial.evaluation import WITH_INDOOR, Evaluation
from sionna_partial.maps.wall_cells import LEAST_NOISE
from sionna_partial.prediction.features import excess_noise
from sionna_partial.prediction.map_networks import SEEN_WIDENING, WIDENING
from sionna_partial.prediction.predictor import MOST_UNSEEN_DB, NARROWER, LinkPrediction
from sionna_partial.resources import scenes_folder

pytestmark = QUIET

HOMES = ("apartment", "house")
SETTINGS = sp.DatasetSettings(links_per_home=200, transmitters_per_home=4, stages=(100, 200))


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    tables = (home_links(sp.load_map(scenes_folder() / name / "complete"), name, SETTINGS) for name in HOMES)
    return sp.evaluate(None, LinkTable.concatenate(tables))


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


@pytest.mark.parametrize(("range_noise_m", "low", "high"), [(0.0, 0.0, LEAST_NOISE), (0.03, 0.5, 1.0)])
def test_a_map_with_range_noise_is_predicted_less_certainly(range_noise_m: float, low: float, high: float) -> None:
    sensor = sp.SensorSettings(range_noise_m=range_noise_m, field_of_view_deg=360.0, range_m=5.0)
    settings = replace(SETTINGS, links_per_home=100, stages=(100,), sensor=sensor)
    links = home_links(sp.make_home(3, "apartment"), "home", settings)
    wall_noise = links.context.wall_noise[0]
    assert low <= wall_noise <= high
    phi = links.phi
    phi = replace(phi, context=replace(phi.context, both_seen=np.zeros(len(links), dtype=bool)))
    as_exact = replace(phi, context=replace(phi.context, wall_noise=np.zeros(len(links))))
    wider, usual = (shipped().predict(each) for each in (phi, as_exact))
    both_seen = links.context.tx_seen & links.context.rx_seen
    assert 10 < both_seen.sum() < len(links) - 10
    excess = excess_noise(wall_noise)
    ratio = 1.0 + excess * np.where(both_seen, SEEN_WIDENING, WIDENING)
    np.testing.assert_allclose(wider.gain_nlos_std_db, ratio * usual.gain_nlos_std_db, rtol=1e-6)
    np.testing.assert_allclose(wider.gain_los_std_db, ratio * usual.gain_los_std_db, rtol=1e-6)
    np.testing.assert_array_equal(wider.p_los, usual.p_los)
    np.testing.assert_array_equal(wider.gain_nlos_mean_db, usual.gain_nlos_mean_db)


@pytest.mark.parametrize(("name", "frequency_hz"), [("map", 60e9), ("paper", 5e9)])
def test_seen_links_are_right_at_any_frequency(name: str, frequency_hz: float) -> None:
    partial = sp.load_map(scenes_folder() / "apartment" / "step100")
    settings = sp.TraceSettings(frequency_hz=frequency_hz)
    coverage = sp.predict_map(partial, (7.0, 9.8, 1.5), spacing_m=0.5, predictor=name, trace_settings=settings)
    seen = (coverage.partial_link_state == sp.LinkState.LOS) & (coverage.unobserved_distance_m == 0.0)
    error_db = (coverage.gain_los_mean_db - coverage.partial_gain_db).where(seen & coverage.observed)
    assert abs(error_db).max() < 0.5


CABINET = (slice(20, 24), slice(20, 24))


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_on_a_nearly_complete_map_the_trace_counts_with_its_errors(noise: float) -> None:
    """Both ends seen, the mean is close to the trace, and never certain; otherwise the networks predict alone."""
    state = np.full((50, 80), sp.CellState.WALL)
    state[1:-1, 1:-1] = sp.CellState.FREE
    state[CABINET] = sp.CellState.UNKNOWN
    state[1:38, 40:42] = sp.CellState.WALL
    partial = sp.PartialMap(state, 0.1)
    vars(partial)["wall_noise"] = noise
    rx_m = [(1.0, 4.5, 1.5), (6.0, 1.0, 1.5), (7.5, 4.8, 1.5), (7.9, 0.4, 1.5), (2.2, 2.2, 1.5)]
    phi = sp.link_features(partial, sp.trace_links(partial, (1.0, 1.0, 1.5), rx_m))
    assert phi.context.nearly_complete.tolist() == [True, True, True, True, False]
    alone = replace(phi, context=replace(phi.context, both_seen=np.zeros(5, dtype=bool)))
    ours, networks = (shipped().predict(each) for each in (phi, alone))
    np.testing.assert_allclose(ours.p_los + ours.p_nlos + ours.p_outage, 1.0)
    assert (ours.gain_std_db[:4] > 0.1).all()
    assert ours.gain_mean_db[4] == networks.gain_mean_db[4]
    if noise == 0.0:
        assert (abs(ours.gain_mean_db - phi.gain_db)[:4] < 3.0).all()
        assert (ours.gain_std_db[:4] < 8.0).all()
    exact = LinkPrediction.of_nearly_complete(replace(phi, context=replace(phi.context, wall_noise=np.zeros(5))), 28e9)
    rough = LinkPrediction.of_nearly_complete(phi, 28e9)
    assert (rough.gain_std_db >= exact.gain_std_db).all()
    incomplete = replace(phi.context, nearly_complete=np.zeros(5, dtype=bool))
    hidden = replace(incomplete, indirect_gain_db=np.column_stack([phi.context.indirect_gain_db[:, :-1], [-150.0] * 5]))
    unseen = replace(hidden, both_seen=np.zeros(5, dtype=bool))
    seen = incomplete.both_seen & (np.ptp(incomplete.indirect_gain_db[:, [0, -1]], axis=1) < MOST_UNSEEN_DB)
    traced = seen & (phi.link_state == sp.LinkState.NLOS) & (rough.gain_std_db < NARROWER * networks.gain_std_db)
    assert traced.any()
    open_map, open_path, alone_too = (
        shipped().predict(replace(phi, context=context)).gain_mean_db for context in (incomplete, hidden, unseen)
    )
    np.testing.assert_array_equal(open_map, networks.where(traced, rough).gain_mean_db)
    np.testing.assert_array_equal(open_path, alone_too)
    complete = replace(phi, context=replace(phi.context, complete=np.ones(5, dtype=bool)))
    assert (shipped().predict(complete).gain_std_db[:4] == 0.0).all()
