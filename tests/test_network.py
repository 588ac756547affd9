"""Several transmitters: their maps, networks, and where to put them."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import sionna_partial as sp
from sionna_partial.channels.joint import JointLatents
from sionna_partial.coverage.link_budget import schemes
from sionna_partial.errors import OutputError, PositionError, SettingsError
from sionna_partial.placement import several
from sionna_partial.placement.several import _greedy, _swapped

TX = {"west": (1.0, 1.0, 1.5), "east": (4.5, 2.5, 1.5)}


@pytest.fixture(scope="module")
def half_seen() -> sp.PartialMap:
    state = np.pad(np.zeros((30, 55), np.uint8), ((1, 1), (1, 0)), constant_values=1)
    return sp.PartialMap(np.pad(state, ((0, 0), (0, 15)), constant_values=2), 0.1)


@pytest.fixture(scope="module")
def model(half_seen: sp.PartialMap) -> sp.LinkModel:
    return sp.LinkModel(half_seen)


@pytest.fixture(scope="module")
def coverage(model: sp.LinkModel) -> xr.Dataset:
    return sp.predict_map(model, TX, spacing_m=0.4)


def test_the_map_of_each_transmitter_is_that_of_a_call_of_its_own(
    model: sp.LinkModel, coverage: xr.Dataset, tmp_path: Path
) -> None:
    alone = sp.predict_map(model, TX["east"], spacing_m=0.4)
    for name, values in alone.data_vars.items():
        np.testing.assert_array_equal(coverage.sel(tx="east")[name], values)
    assert repr(coverage.sel(tx="east").radio) == repr(alone.radio)
    sp.save_coverage(coverage, tmp_path / "two.nc")
    assert sp.load_coverage(tmp_path / "two.nc").identical(coverage)


def test_powers_of_a_complete_map_give_sinr_and_rate_by_hand() -> None:
    room = sp.PartialMap(np.pad(np.zeros((30, 40), np.uint8), 1, constant_values=1), 0.1)
    coverage = sp.predict_map(room, [TX["west"], (3.5, 2.5, 1.5)], spacing_m=0.5)
    network = sp.predict_network(coverage, tx_power_dbm=[10.0, 13.0], noise_figure_db=5.0, bandwidth_hz=1e8, load=0.5)
    gain_db = coverage["gain_mean_db"].to_numpy()
    power_mw = 10 ** ((gain_db + np.array([10.0, 13.0])[:, None, None]) / 10)
    noise_mw = 10 ** ((-174.0 + 80.0 + 5.0) / 10)
    sinr = power_mw.max(axis=0) / (noise_mw + 0.5 * power_mw.min(axis=0))
    valid = coverage["valid"].all("tx").to_numpy()
    np.testing.assert_allclose(network["sinr_mean_db"].to_numpy()[valid], 10 * np.log10(sinr[valid]), atol=1e-3)
    np.testing.assert_allclose(network["rate_bit_s"].to_numpy()[valid], 1e8 * np.log2(1 + sinr[valid]), rtol=1e-4)
    np.testing.assert_array_equal(network["best_server"].to_numpy()[valid], power_mw.argmax(axis=0)[valid])
    margin_db = 10 * np.log10(power_mw.max(axis=0) / power_mw.min(axis=0))
    np.testing.assert_allclose(network["handover_margin_db"].to_numpy()[valid], margin_db[valid], atol=1e-3)
    assert np.isnan(network["sinr_mean_db"].to_numpy()[~valid]).all()


def test_rates_of_a_standard_are_those_of_its_schemes() -> None:
    room = sp.PartialMap(np.pad(np.zeros((30, 40), np.uint8), 1, constant_values=1), 0.1)
    wifi = sp.TraceSettings(5.2e9, refraction=False)
    coverage = sp.predict_map(room, [TX["west"], (3.5, 2.5, 1.5)], spacing_m=0.5, trace_settings=wifi)
    given = {"tx_power_dbm": -25.0, "bandwidth_hz": 80e6, "channels": ["36", "52"], "n": 2}
    network = sp.predict_network(coverage, standard="wifi6", **given)
    valid = np.isfinite(network["sinr_mean_db"].to_numpy())
    sinr_db, rate = (network[name].to_numpy()[valid] for name in ("sinr_mean_db", "rate_bit_s"))
    table = schemes("wifi6", 80e6, 5.2e9)
    expected = [max([each.rate_bit_s for each in table if each.snr_db <= one], default=0.0) for one in sinr_db]
    np.testing.assert_allclose(rate, expected, rtol=1e-6)
    assert len(np.unique(rate)) > 2
    assert network["rate_bit_s"].long_name == "mean rate of wifi6, one spatial stream"
    with pytest.raises(SettingsError, match="bandwidth_hz"):
        sp.predict_network(coverage, standard="wifi6", bandwidth_hz=1e8)


def test_probabilities_agree_with_the_maps(coverage: xr.Dataset) -> None:
    network = sp.predict_network(coverage, n=200)
    outage, valid = coverage["p_outage"], coverage["valid"].all("tx")
    low, high = outage.prod("tx"), outage.min("tx")
    all_out = network["p_all_outage"]
    assert bool(((all_out <= high + 1e-6) | ~valid).all())
    assert bool(((all_out >= np.minimum(low, high) - 0.1) | ~valid).all())
    total = network["p_best"].sum("tx") + all_out
    np.testing.assert_allclose(total.to_numpy()[valid], 1.0, atol=1e-5)
    assert network.identical(sp.predict_network(coverage, n=200))


def test_channels_divide_the_interference() -> None:
    room = sp.PartialMap(np.pad(np.zeros((30, 70), np.uint8), 1, constant_values=1), 0.1)
    tx = {"a": (1.0, 1.0, 1.5), "b": (1.6, 1.0, 1.5), "c": (6.0, 2.5, 1.5)}
    coverage = sp.predict_map(room, tx, spacing_m=0.5)
    shared, apart = (sp.predict_network(coverage, channels=plan, n=20) for plan in (None, {"a": 1, "b": 6, "c": 11}))
    noise_dbm = -174.0 + 80.0 + 7.0
    valid = coverage["valid"].all("tx").to_numpy()
    snr_db = (coverage["gain_mean_db"].max("tx") + 20.0 - noise_dbm).to_numpy()
    np.testing.assert_allclose(apart["sinr_mean_db"].to_numpy()[valid], snr_db[valid], atol=1e-3)
    assert (apart["sinr_mean_db"] > shared["sinr_mean_db"]).to_numpy()[valid].all()
    proposed = sp.predict_network(coverage, channels=[36, 52], n=20)
    rates = [float(found["rate_bit_s"].mean()) for found in (shared, proposed, apart)]
    assert rates == sorted(rates)
    near, other, far = proposed["channel"].values.tolist()
    assert near != other  # the two nearest
    assert {near, other, far} == {"36", "52"}
    for channels, match in (
        ({"a": 1}, "give a channel to each of a, b, c"),
        ([], r"give a list, such as \[1, 6, 11\]"),
    ):
        with pytest.raises(SettingsError, match=match):
            sp.predict_network(coverage, channels=channels)


def test_any_transmitter_covers_at_least_as_much_as_each(half_seen: sp.PartialMap, model: sp.LinkModel) -> None:
    tx = {"on a receiver": (1.0, 1.0, 1.5), "in the unseen": (4.6, 2.6, 1.5)}
    coverage = sp.predict_map(model, tx, spacing_m=0.4)
    assert (coverage["valid"].any("tx") & ~coverage["valid"].all("tx")).sum() == 2
    for threshold_dbm in (-90.0, -60.0, -40.0):
        each, together = (coverage.radio.area(threshold_dbm, any_transmitter=every) for every in (False, True))
        for name in ("fraction", "fraction_mean"):
            assert (each[name] <= together[name] + 1e-9).all()
        assert each["area_m2"].equals(together["area_m2"])
    network = sp.predict_network(coverage)
    assert network["best_server"].sel(x=1.0, y=1.0, method="nearest").item() == 0
    assert (network["p_all_outage"] <= coverage["p_outage"].min("tx") + 1e-6).all()


def test_links_through_the_same_unknown_cells_are_alike() -> None:
    partial = sp.PartialMap(np.full((60, 60), 2, np.uint8), 0.1)
    tx_m = np.array([[1.0, 1.0, 1.5]] * 3)
    rx_m = np.array([[5.0, 5.0, 1.5], [5.0, 4.8, 1.5], [1.0, 5.0, 1.5]])
    correlation = JointLatents(partial).correlation(tx_m, rx_m)
    assert correlation[0, 1] > 0.7 > 0.5 > correlation[0, 2]
    quantiles = JointLatents(partial).quantiles(tx_m, rx_m, 100, [[0]])[0]
    assert (np.sort(quantiles, axis=0) * 100 // 1 == np.arange(100)[:, None]).all()  # evenly spread


def test_several_are_placed_greedily_and_then_swapped(
    half_seen: sp.PartialMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(several, "CANDIDATES", 12)
    monkeypatch.setattr(several, "DRAWS", 40)
    covered = np.array([[1, 1, 1, 1, 0, 0], [1, 1, 0, 0, 1, 0], [0, 0, 1, 1, 0, 1]], dtype=bool)[None]
    weight = np.full(6, 1 / 6)
    greedy, scores = _greedy(covered, weight, 2)
    assert (greedy[0], scores) == (0, pytest.approx([4 / 6, 5 / 6]))
    assert sorted(_swapped(covered, weight, greedy)) == [1, 2]
    direct = sp.LinkModel(half_seen, "paper", sp.TraceSettings(max_depth=0, diffraction=False))
    placed = sp.place_transmitters(direct, 2, threshold_db=-75.0)
    assert (half_seen.state_at(placed.positions_m) == sp.CellState.FREE).all()
    assert placed.scores[1] >= placed.scores[0]
    np.testing.assert_allclose(placed.added.sum(), placed.score)
    few = sp.place_transmitters(direct, 6, goal=float(placed.scores[0]) + 0.01, threshold_db=-75.0)
    assert few.score >= placed.scores[0] + 0.01
    assert 2 <= len(few.positions_m) < 6
    assert (few.added > 0.0).all()
    assert len(sp.place_transmitters(direct, 2, goal=1.0, threshold_db=-60.0).positions_m) == 2
    with pytest.raises(SettingsError, match=r"goal = 95 is not allowed"):
        sp.place_transmitters(direct, goal=95, threshold_db=-75.0)
    own = sp.place_transmitters(direct, 1, rx=[(1.0, 1.0, 1.5)], threshold_db=-75.0)
    assert own.score > 0.9
    assert own.rx_m.shape == (1, 3)
    assert len(sp.plots.plot_network_placement(placed).axes) == 2


def test_what_is_no_network_is_refused(half_seen: sp.PartialMap, coverage: xr.Dataset) -> None:
    for options, match in (
        ({"tx_power_dbm": [1.0, 2.0, 3.0]}, "one for each of the 2 transmitters"),
        ({"load": 1.5}, "load"),
        ({"sinr_threshold_db": float("nan")}, "sinr_threshold_db"),
    ):
        with pytest.raises(SettingsError, match=match):
            sp.predict_network(coverage, **options)
    for other, match in (
        (coverage.isel(tx=[]), "give each a name"),
        (coverage.assign(valid=coverage.valid & False), "no position at which a receiver"),
        (coverage.isel(tx=0), "no dimension tx"),
        (coverage.assign_coords(tx=["a\nb", "b"]), "of printable characters"),
    ):
        with pytest.raises(SettingsError, match=match):
            sp.predict_network(other)
    with pytest.raises(PositionError, match="at least 1 position"):
        sp.predict_map(half_seen, np.zeros((0, 3)), spacing_m=0.4)
    for names in ((1, "1"), ("\udc80", "b")):
        with pytest.raises(SettingsError, match="give each a name of its own, of printable characters"):
            sp.predict_map(half_seen, dict.fromkeys(names, (3.0, 1.0, 1.5)))
    with pytest.raises(SettingsError, match="count"):
        sp.place_transmitters(half_seen, 0)


def test_the_order_of_dimensions_does_not_count(coverage: xr.Dataset) -> None:
    turned = sp.predict_network(coverage.transpose("y", "x", "tx"), n=10)
    xr.testing.assert_equal(turned, sp.predict_network(coverage, n=10))


@pytest.mark.parametrize("value", [np.datetime64("now"), object(), 2**70])
def test_attributes_that_no_file_holds(coverage: xr.Dataset, tmp_path: Path, value: object) -> None:
    with pytest.raises(SettingsError, match="attribute mine = "):
        sp.save_coverage(coverage.chunk(x=3).assign_attrs(mine=value), tmp_path / "coverage.nc")
    assert not [*tmp_path.iterdir()]


def test_files_and_pictures(coverage: xr.Dataset, tmp_path: Path) -> None:
    network = sp.predict_network(coverage)
    for suffix in (".nc", ".tif", ".csv", ".png"):
        sp.save_network(network, tmp_path / f"network{suffix}")
        assert (tmp_path / f"network{suffix}").stat().st_size > 1000
    assert xr.load_dataset(tmp_path / "network.nc").sizes["tx"] == 2
    with pytest.raises(OutputError, match=r"\.txt"):
        sp.save_network(network, tmp_path / "network.txt")
    sp.save_network(xr.load_dataset(tmp_path / "network.nc"), tmp_path / "again.nc")
    assert (tmp_path / "again.nc").read_bytes() == (tmp_path / "network.nc").read_bytes()
    others = coverage, network.drop_vars("p_best"), network.isel(x=0), network.assign_attrs(load="much")
    others += (network.astype(str),)
    for other in others:
        with pytest.raises(SettingsError, match="give what predict_network returned"):
            sp.plots.plot_network(other)
