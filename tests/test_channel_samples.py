"""Draws of channels: exact where all is known, as predicted elsewhere, and correlated in space."""

import numpy as np
import pytest
from coverage_cases import shipped

import sionna_partial as sp
from sionna_partial.channels.samples import ChannelSamples, sample_channels
from sionna_partial.errors import MemoryLimitError, SettingsError
from sionna_partial.lab.training.paths import example, fit_path_model
from sionna_partial.resources import scenes_folder
from sionna_partial.tracing.antennas import dft_codebook, planar_array

TX = (7.0, 9.8, 1.5)


@pytest.fixture(scope="module")
def home() -> sp.PartialMap:
    return sp.load_map(scenes_folder() / "apartment" / "complete" / "map.yaml")


@pytest.fixture(scope="module")
def receivers(home: sp.PartialMap) -> np.ndarray:
    cells = np.random.default_rng(0).permutation(np.argwhere(home.state == sp.CellState.FREE))[:40]
    rx_m = np.insert((cells[:, ::-1] + 0.5) * home.resolution_m + home.origin_m, 2, 1.5, axis=1)
    return rx_m[home.radios_can_stand(rx_m) & (np.linalg.norm(rx_m - TX, axis=1) > 0.2)]


@pytest.fixture(scope="module")
def partial() -> sp.PartialMap:
    return sp.load_map(scenes_folder() / "apartment" / "step100" / "map.yaml")


@pytest.fixture(scope="module")
def samples(partial: sp.PartialMap, receivers: np.ndarray) -> ChannelSamples:
    return sample_channels(partial, TX, receivers, n=100)


def test_on_a_complete_map_every_draw_is_the_trace(home: sp.PartialMap, receivers: np.ndarray) -> None:
    links = sp.trace_links(home, TX, receivers)
    samples = sample_channels(home, TX, receivers, n=3)
    assert len(links.a) > 20
    for draw in range(3):
        drawn = samples.links(draw)
        for name in ("transfer", "delay_s", "departure_rad", "arrival_rad", "path_rx", "gain_db", "link_state"):
            np.testing.assert_array_equal(getattr(drawn, name), getattr(links, name))


def test_draws_agree_with_the_prediction_and_with_themselves(
    partial: sp.PartialMap, receivers: np.ndarray, samples: ChannelSamples
) -> None:
    prediction = shipped().predict(sp.link_features(partial, sp.trace_links(partial, TX, receivers)))
    for state, probability in zip(sp.LinkState, prediction.by_state[0], strict=True):
        assert np.abs((samples.link_state == state).mean(axis=0) - probability).max() < 0.02
    assert np.abs(samples.gain_db.mean(axis=0) - prediction.gain_mean_db).mean() < 1.0
    for draw in range(0, 100, 20):
        links = samples.links(draw)
        power = np.bincount(links.path_rx, np.abs(links.a) ** 2, len(receivers))
        received = links.link_state != sp.LinkState.OUTAGE
        np.testing.assert_allclose(10 * np.log10(power[received]), links.gain_db[received], atol=1e-6)
        assert (power[~received] == 0.0).all()
        direct = np.bincount(links.path_rx[(links.interactions == 0).all(axis=1)], minlength=len(receivers))
        np.testing.assert_array_equal(direct > 0, links.link_state == sp.LinkState.LOS)
    assert np.ptp(samples.gain_db, axis=0).max() > 20.0


def room() -> sp.PartialMap:
    """A complete room of 6 x 4 m with a wall into it."""
    state = np.zeros((42, 62), dtype=np.uint8)
    state[[0, -1]] = state[:, [0, -1]] = state[:30, 30, None] = sp.CellState.WALL
    return sp.PartialMap(state, 0.1)


@pytest.mark.parametrize("case", ["brick", "unknown material", "partial map"])
def test_mean_and_spread_of_draws_are_predicted(case: str, partial: sp.PartialMap, receivers: np.ndarray) -> None:
    """Through walls with the residual of a trace, and over materials; 5 GHz, and 28 GHz on a partial map."""
    if case == "partial map":
        model, tx, rx = sp.LinkModel(partial), TX, receivers[:12]
    else:
        material = sp.Material.named("brick") if case == "brick" else None
        settings = sp.TraceSettings(5e9, max_depth=2), sp.SceneSettings(material=material)
        model, tx = sp.LinkModel(room(), None, *settings), (1.0, 2.0, 1.5)
        rx = np.array([(5.0, 2.3, 1.2), (2.5, 1.0, 1.0), (2.2, 3.5, 1.5), (4.0, 1.0, 1.5), (5.5, 3.7, 1.5)])
    drawn, expected = sample_channels(model, tx, rx, n=3000), model.predict(tx, rx)
    clear = expected.gain_nlos_mean_db - 3.0 * expected.gain_nlos_std_db > -150.0  # no gain is below the floor
    assert clear.sum() >= 4
    assert np.abs(drawn.gain_db.mean(axis=0) - expected.gain_mean_db)[clear].max() < 0.15
    assert np.abs(drawn.gain_db.std(axis=0) - expected.gain_std_db)[clear].max() < 0.15
    links = drawn.links(7)
    power = np.bincount(links.path_rx, np.abs(links.a) ** 2, len(rx))
    received = links.link_state != sp.LinkState.OUTAGE
    np.testing.assert_allclose(10 * np.log10(power[received]), links.gain_db[received], atol=1e-6)


def test_what_was_seen_is_in_every_draw(partial: sp.PartialMap) -> None:
    rx_m = np.array([(7.8, 10.2, 1.5)])
    seen = sp.link_features(partial, sp.trace_links(partial, TX, rx_m)).context.indirect_gain_db[0, -1]
    assert seen > -90.0
    direct = np.abs(sp.trace_links(partial, TX, rx_m).a[0]) ** 2
    samples = sample_channels(partial, TX, rx_m, n=100)
    for drawn in map(samples.links, range(100)):
        indirect = np.abs(drawn.a[(drawn.interactions > 0).any(axis=1)]) ** 2
        shared = np.abs(drawn.a[(drawn.interactions == 0).all(axis=1)]).item() ** 2 / direct  # factor of all paths
        assert 10 * np.log10(indirect.sum() / shared) > seen - 0.1


def test_the_order_of_transmitters_does_not_matter(home: sp.PartialMap) -> None:
    cells = np.argwhere(home.state == sp.CellState.UNKNOWN)[::500, ::-1]
    outside = np.insert((cells + 0.5) * home.resolution_m + home.origin_m, 2, 1.5, axis=1)
    model = sp.LinkModel(home)
    for order in ([0, 1], [1, 0]):
        drawn = sample_channels(model, np.array([TX, outside[0]])[order], outside[1:], n=16)
        np.testing.assert_allclose(drawn.gain_db[:, order[0]].std(axis=0), 0.0, atol=1e-9)
        assert drawn.gain_db[:, order[1]].std(axis=0).max() > 1.0


def test_paths_of_draws_are_made_one_by_one(partial: sp.PartialMap, receivers: np.ndarray) -> None:
    samples = sample_channels(partial, TX, receivers, n=400, memory_gb=0.05)
    power = [np.bincount(each.path_rx, np.abs(each.a) ** 2).sum() for each in map(samples.links, (399, 0, 399))]
    assert power[0] == power[2] != power[1]
    with pytest.raises(MemoryLimitError, match=r"400 draws take up to .* Use links\(draw\)"):
        samples.cir()
    with pytest.raises(MemoryLimitError, match=r"10,000 draws of \d+ links take up to .* fewer draws"):
        sample_channels(partial, TX, receivers, n=10_000, memory_gb=0.01)
    with pytest.raises(SettingsError, match="draw = 400"):
        samples.links(400)
    with pytest.raises(SettingsError, match="n = 0"):
        sample_channels(partial, TX, receivers, n=0)


def test_channels_of_draws(samples: ChannelSamples, partial: sp.PartialMap, receivers: np.ndarray) -> None:
    arrays = {"tx_array": planar_array(2, 2)}
    cfr = samples.cfr(np.arange(4) * 1e6, **arrays)
    assert cfr.h.sizes == {"draw": 100, "link": len(receivers), "rx_ant": 1, "tx_ant": 4, "frequency": 4}
    np.testing.assert_allclose(cfr.h[7], samples.links(7).cfr(np.arange(4) * 1e6, **arrays).h, atol=1e-8)
    assert samples.beam_gains(dft_codebook(2, 2), **arrays).gain_db.sizes["draw"] == 100
    two, again, other = (
        sample_channels(partial, [TX, (7.0, 10.5, 1.5)], receivers[:5], n=4, seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(again.drawn.transfer, two.drawn.transfer)
    assert not np.array_equal(other.gain_db, two.gain_db)
    assert len(sample_channels(partial, TX, np.zeros((0, 3)), n=5).drawn.a) == 0
    assert two.spreads().delay_spread_s.sizes == {"draw": 4, "tx": 2, "rx": 5}
    assert two.cir(tx_orientation_rad=np.zeros((2, 3))).sizes["draw"] == 4
    np.testing.assert_array_equal(two.links(3).gain_db, two.gain_db[3])


def test_a_path_model_learns_what_survives(home: sp.PartialMap, receivers: np.ndarray) -> None:
    maps = [*sp.explore(home, (20, 60), 0), home]
    examples = [example(each, home, np.array([TX]), receivers) for each in maps]
    assert examples[-1].exists.all()  # on the whole of the home every path is there
    model = fit_path_model(examples)
    inputs = np.concatenate([each.inputs for each in examples])
    exists = np.concatenate([each.exists for each in examples])
    los = inputs[:, -1] == 1.0
    found = np.where(los, *(model.survival(inputs[:, :-1], state) for state in (sp.LinkState.LOS, sp.LinkState.NLOS)))
    assert found[exists].mean() > found[~exists].mean() + 0.1
    assert (np.diff(model.first) <= 24).all()
