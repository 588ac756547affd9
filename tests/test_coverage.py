import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from coverage_cases import COMPLETE, PICTURE, TX, map_of, shipped
from extruded import drawn
from predictor_links import arrays
from scipy.stats import norm

from sionna_partial.constants import CellState, LinkState
from sionna_partial.coverage.dataset import ATTRIBUTES, WALL_PARTS, require_coverage
from sionna_partial.coverage.job import predict_map, transmitter_positions
from sionna_partial.coverage.link_budget import access_point_eirp_dbm, eirp_limit_dbm, schemes
from sionna_partial.errors import MemoryLimitError, PositionError, SettingsError
from sionna_partial.export import load_coverage
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import link_features
from sionna_partial.settings import Material, SceneSettings, TraceSettings
from sionna_partial.tracing.trace import trace_links


def predicted(partial, tx=TX, **options):
    return predict_map(partial, tx, **{"predictor": shipped(), **options})


def quickly_predicted(*arguments, **options):
    """Predict where receivers and cells matter, and the gains do not."""
    settings = TraceSettings(max_depth=0, diffraction=False)
    return predicted(*arguments, predictor=shipped("paper"), trace_settings=settings, **options)


@pytest.fixture(scope="module")
def complete():
    """Coverage of the home when all of it is known."""
    return predict_map(map_of(COMPLETE), TX, spacing_m=0.25)


def unknown_map(ny=8, nx=12):
    return PartialMap(np.full((ny, nx), CellState.UNKNOWN, dtype=np.uint8), 0.5)


def test_receivers_are_the_centres_of_a_grid_from_the_lower_left_corner_and_valid_where_no_wall_is(coverage):
    np.testing.assert_allclose(coverage["x"], -1.0 + 0.25 * (np.arange(24) + 0.5))
    np.testing.assert_allclose(coverage["y"], 2.0 + 0.25 * (np.arange(16) + 0.5))
    state = map_of(PICTURE).state_at(np.stack(np.meshgrid(coverage["x"], coverage["y"]), axis=-1))
    np.testing.assert_array_equal(coverage["cell_state"], state)
    np.testing.assert_array_equal(coverage["observed"], state != CellState.UNKNOWN)
    np.testing.assert_array_equal(coverage["valid"], state != CellState.WALL)
    assert set(np.unique(state)) == set(CellState)


def test_variables_have_cf_attributes_and_are_missing_exactly_where_no_receiver_is(coverage):
    assert set(coverage.data_vars) == set(ATTRIBUTES)
    valid = coverage["valid"].to_numpy()
    for name, layer in coverage.data_vars.items():
        assert layer.dims == ("y", "x")
        if layer.dtype.kind == "f":
            np.testing.assert_array_equal(np.isnan(layer), ~valid, err_msg=name)
        flags = layer.attrs.get("flag_values", ())
        assert "long_name" in layer.attrs, name
        assert len(flags) or "units" in layer.attrs or name == "wall_parts"
        assert len(flags) == len(layer.attrs.get("flag_meanings", "").split())
    assert coverage["x"].attrs["standard_name"] == "projection_x_coordinate"


def test_each_receiver_has_the_prediction_of_its_own_link():
    """As traced and predicted step by step, in another order of the receivers, with every path."""
    partial, model, every = map_of(PICTURE), shipped(), TraceSettings(power_tolerance_db=0.0)
    coverage = predicted(partial, spacing_m=0.5, trace_settings=every)
    valid = coverage["valid"].to_numpy()
    x, y = np.meshgrid(coverage["x"], coverage["y"])
    order = np.random.default_rng(0).permutation(valid.sum())
    rx_m = np.column_stack([x[valid], y[valid], np.full(valid.sum(), 1.5)])[order]
    phi = link_features(partial, trace_links(partial, (*TX, 1.5), rx_m, trace_settings=every))
    free = partial.state_at(rx_m) == CellState.FREE
    prediction, p_indoor = model.predict(phi), model.predict_indoor(phi)
    expected = arrays(prediction) | {
        "link_state": prediction.link_state,
        "p_indoor": np.where(free, 1.0, p_indoor),
        "partial_link_state": phi.link_state,
        "partial_gain_db": phi.gain_db,
        "unobserved_distance_m": phi.unobserved_distance_m,
        "distance_m": np.hypot(*(rx_m[:, :2] - TX).T),
    }
    found = {name: coverage[name].to_numpy()[valid][order] for name in expected}
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-4, atol=1e-4, err_msg=name)
    assert 0.0 < p_indoor[~free].min() < p_indoor[~free].max() < 1.0


def test_outside_is_mixed_in_as_outage_and_attributes_say_so(coverage):
    anywhere = predicted(map_of(PICTURE), spacing_m=0.25, receivers="anywhere")
    for name in ("p_los", "p_nlos"):
        np.testing.assert_allclose(anywhere[name], coverage["p_indoor"] * coverage[name], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(anywhere["p_outage"], 1.0 - anywhere["p_los"] - anywhere["p_nlos"], atol=1e-6)
    gains_db = (-150.0, anywhere["gain_los_mean_db"], anywhere["gain_nlos_mean_db"])
    mean_db = sum(anywhere[p] * gain for p, gain in zip(("p_outage", "p_los", "p_nlos"), gains_db, strict=True))
    np.testing.assert_allclose(anywhere["gain_mean_db"], np.maximum(mean_db, -150.0), rtol=1e-5)
    assert [each.attrs["receivers"] for each in (coverage, anywhere)] == ["indoor", "anywhere"]
    assert coverage["p_los"].attrs["long_name"].endswith(", given that the receiver is indoors")


def test_on_a_complete_map_the_trace_is_the_answer(complete):
    assert map_of(COMPLETE).is_complete
    valid, free = complete["valid"] == 1, complete["cell_state"] == CellState.FREE
    np.testing.assert_array_equal(complete["p_los"], (complete["partial_link_state"] == LinkState.LOS).where(valid))
    np.testing.assert_array_equal(complete["link_state"], complete["partial_link_state"])
    np.testing.assert_array_equal(complete["gain_mean_db"], complete["partial_gain_db"])
    assert complete["gain_std_db"].max() == complete["unobserved_distance_m"].max() == 0.0
    np.testing.assert_array_equal(complete["p_indoor"], free.where(valid))
    assert complete.attrs["predictor_sha256"] == ""
    anywhere = predict_map(map_of(COMPLETE), TX, spacing_m=0.25, receivers="anywhere")
    assert (complete["p_outage"].where(valid & ~free) < 1.0).any()
    for name, outside in (("p_los", 0.0), ("p_outage", 1.0), ("gain_mean_db", -150.0), ("link_state", 0)):
        np.testing.assert_array_equal(anywhere[name], complete[name].where(free, outside).where(valid))


def test_a_transmitter_behind_the_walls_of_a_complete_map_is_predicted():
    """A room that a robot has finished; the transmitter is in one that it never saw."""
    partial = drawn("#####????? #...#????? #...#????? #####?????", 1.0)
    assert partial.is_complete
    coverage = predict_map(partial, (7.5, 2.5, 1.5), spacing_m=0.5)
    unseen, seen = coverage.radio.at(6.5, 1.5), coverage.radio.at(2.5, 1.5)
    assert (coverage.attrs["map_complete"], coverage.attrs["predictor"]) == (0, "map")
    assert 0.0 < float(unseen.p_los) < 1.0
    assert float(seen.p_outage) == 1.0


def test_no_receiver_is_at_the_transmitter_or_where_friis_exceeds_0_db():
    coverage = quickly_predicted(unknown_map(), (1.75, 2.25), spacing_m=0.5)
    assert (~coverage["valid"]).sum() == 1
    assert np.isnan(coverage["gain_mean_db"].sel(x=1.75, y=2.25))
    assert coverage["cell_state"].sel(x=1.75, y=2.25) == CellState.UNKNOWN
    assert quickly_predicted(unknown_map(), (1.75, 2.25, 1.6), spacing_m=0.5)["valid"].all()
    low = predicted(unknown_map(), (1.75, 2.25), spacing_m=0.5, trace_settings=TraceSettings(frequency_hz=30e6))
    distance_m = np.hypot(low["x"] - 1.75, low["y"] - 2.25)
    np.testing.assert_array_equal(low["valid"], (distance_m >= 9.99308 / (4 * np.pi)).transpose("y", "x"))


def test_receivers_within_a_centimetre_of_a_wall_are_masked():
    state = np.zeros((6, 6), dtype=np.uint8)
    state[:, 3] = CellState.WALL
    coverage = quickly_predicted(PartialMap(state, 0.5), (0.6, 0.6), spacing_m=0.2)
    near_m = np.maximum(1.5 - coverage["x"], coverage["x"] - 2.0)
    np.testing.assert_array_equal(coverage["valid"].all("y"), near_m > 0.01)


@pytest.mark.parametrize("spacing_m", [0.3, 3.4])
def test_receivers_fill_the_map_and_wall_parts_cover_every_wall_and_nothing_far_from_one(spacing_m):
    state = (np.random.default_rng(round(10 * spacing_m)).random((7, 9)) < 0.2).astype(np.uint8)
    state[0, 0] = CellState.FREE
    coverage = quickly_predicted(PartialMap(state, 0.5), (0.2, 0.2), spacing_m=spacing_m)
    bits, x_m, y_m = (coverage[name].to_numpy() for name in ("wall_parts", "x", "y"))
    for axis, length_m in ((x_m, 4.5), (y_m, 3.5)):
        assert axis[0] == pytest.approx(spacing_m / 2)
        assert axis[-1] < length_m
        assert axis[-1] + spacing_m >= length_m - 1e-6
    part = np.arange(WALL_PARTS)
    found = (bits[:, None, :, None] >> (WALL_PARTS * part[:, None, None] + part)) & 1
    found = found.reshape(WALL_PARTS * len(y_m), WALL_PARTS * len(x_m)).astype(bool)
    edge = spacing_m / WALL_PARTS
    for row, column in np.ndindex(found.shape):
        low = np.array([column, row]) * edge
        cells = np.argwhere(state)[:, ::-1] * 0.5
        overlap = np.minimum(low + edge, cells + 0.5) - np.maximum(low, cells)
        assert found[row, column] == (overlap > 1e-6).all(axis=1).any()


def test_moving_the_map_moves_the_answer(coverage):
    far = predicted(map_of(PICTURE, origin_m=(499_999.0, 4_500_002.0)), (500_000.6, 4_500_003.6), spacing_m=0.25)
    for name in ATTRIBUTES:
        np.testing.assert_allclose(coverage[name], far[name], atol=1e-3, err_msg=name)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, None),
        ({"trace_settings": TraceSettings(frequency_hz=60e9)}, "at 28 GHz, and is used at 60 GHz: its"),
        ({"trace_settings": TraceSettings(diffraction=False)}, "with diffraction, and is used without diffraction"),
        ({"trace_settings": TraceSettings(max_depth=1)}, "with max_depth = 6, and is used with max_depth = 1: its"),
        ({"scene_settings": SceneSettings(Material(itu="metal"))}, "on walls that transmit, and is used on walls of"),
    ],
)
def test_a_predictor_trained_on_other_traces_is_warned_about(caplog, settings, words):
    LinkModel(map_of(PICTURE), shipped(), **settings).predictor  # noqa: B018 - it is read when it is first needed
    found = [message for message in caplog.messages if message.startswith("predictor 'map' was trained ")]
    assert len(found) == (words is not None)
    assert all(words in message for message in found)


def test_settings_reach_the_tracer_and_the_attributes():
    concrete, trace = SceneSettings(material=Material(itu="concrete")), TraceSettings(frequency_hz=60e9, max_depth=3)
    options = {"rx_height_m": 1.0, "spacing_m": 0.5, "trace_settings": trace}
    coverage = predicted(map_of(PICTURE), scene_settings=concrete, **options)
    attributes = coverage.attrs
    assert (attributes["frequency_hz"], attributes["rx_height_m"], attributes["spacing_m"]) == (60e9, 1.0, 0.5)
    assert json.loads(attributes["trace_settings"])["max_depth"] == 3
    assert json.loads(attributes["scene_settings"])["material"]["itu"] == "concrete"
    assert (attributes["predictor"], attributes["predictor_sha256"]) == ("map", shipped().fingerprint)
    assert float(coverage["distance_m"].min()) >= 0.5
    partial = replace(map_of(PICTURE), material=concrete.material)
    of_map = predicted(partial, scene_settings=SceneSettings(material=Material()), **options)
    xr.testing.assert_identical(of_map, coverage)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"tx": (50.0, 3.6)}, PositionError, r"tx = \(50\.0, 3\.6, 1\.5\) is outside the map"),
        ({"rx_height_m": 3.0}, SettingsError, r"rx_height_m = 3\.0 is not allowed: stay below the ceiling at 3 m"),
        ({"spacing_m": 9.0}, SettingsError, r"spacing_m = 9\.0 .* the map is 6 x 4 m; give 4 or less"),
        ({"spacing_m": 0.05, "scene": unknown_map(400, 600)}, SettingsError, "makes 24,000,000 .*; give 0.19 or more"),
        ({"receivers": "outdoor"}, SettingsError, "receivers = 'outdoor' is not allowed: choose one of indoor, any"),
        ({"memory_gb": 0.1}, MemoryLimitError, r"memory_gb = 0\.1 .* receivers on a map of 96 cells"),
        (
            {"trace_settings": TraceSettings(60e9), "scene_settings": SceneSettings(Material(itu="brick"))},
            SettingsError,
            r"frequency_hz = 60000000000\.0 .* 'brick'",
        ),
    ],
)
def test_bad_input_is_refused_before_any_work(arguments, error, message):
    arguments, calls = {"scene": map_of(PICTURE), "tx": TX} | arguments, []
    with pytest.raises(error, match=message):
        predict_map(arguments.pop("scene"), arguments.pop("tx"), **arguments, progress=lambda *call: calls.append(call))
    assert not calls


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data.drop_vars(["p_los", "valid"]), r"coverage lacks p_los, valid: give the xarray\.Dataset"),
        (lambda data: data.transpose("x", "y"), "coverage lacks p_los"),
        (lambda data: data["p_los"], "coverage is of type DataArray"),
        (lambda data: data * 1.0, r"coverage\.observed = .*float"),
        (lambda data: data.assign_attrs(transmitter_m=[1.0, math.nan, 1.5]), r"coverage\.transmitter_m = "),
    ],
)
def test_what_is_no_coverage_map_is_named(coverage, spoil, message):
    require_coverage(coverage)
    with pytest.raises(SettingsError, match=message):
        require_coverage(spoil(coverage))


def test_the_answer_does_not_depend_on_the_blocks():
    fractions = []
    whole = predicted(map_of(PICTURE), spacing_m=0.12)
    in_blocks = predicted(
        map_of(PICTURE), spacing_m=0.12, memory_gb=1.062, progress=lambda done, _: fractions.append(done)
    )
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert whole["valid"].sum() > 1000
    for name in ATTRIBUTES:
        np.testing.assert_allclose(in_blocks[name], whole[name], rtol=1e-5, atol=1e-5, err_msg=name)


class TestAccessor:
    def test_probability_above_is_of_the_mixture(self, coverage, complete, several):
        above = coverage.radio.probability_above(-70.0)
        los, nlos = (
            coverage[f"p_{state}"]
            * norm.sf(-70.0, coverage[f"gain_{state}_mean_db"], coverage[f"gain_{state}_std_db"] + 1e-9)
            for state in ("los", "nlos")
        )
        valid = (coverage["valid"] & (coverage["gain_los_std_db"] > 0.0)).to_numpy()
        assert np.allclose(above.to_numpy()[valid], (los + nlos).to_numpy()[valid], atol=1e-5)
        assert np.array_equal(np.isnan(above), ~coverage["valid"])
        assert not (coverage.radio.probability_above(-150.0) > 1.0 - coverage["p_outage"] + 1e-6).any()
        step = (complete["gain_mean_db"] > -75.0).where(complete["valid"] == 1)
        assert np.array_equal(complete.radio.probability_above(-75.0), step, equal_nan=True)
        each = several.radio.probability_above(-70.0)
        for tx in several["tx"]:
            assert np.array_equal(each.sel(tx=tx), several.sel(tx=tx).radio.probability_above(-70.0), equal_nan=True)

    def test_power_and_snr_are_gains_and_a_link_budget(self, coverage, several):
        power, snr = coverage.radio.power(eirp_dbm=23.0, rx_gain_db=2.0), coverage.radio.snr(bandwidth_hz=20e6)
        np.testing.assert_allclose(power["power_mean_dbm"], coverage["gain_mean_db"] + 25.0, atol=1e-4)
        np.testing.assert_allclose(snr["snr_mean_db"], coverage["gain_mean_db"] + 20.0 + 93.99, atol=1e-2)
        np.testing.assert_array_equal(power["power_std_db"], coverage["gain_std_db"])
        for bad in ({"eirp_dbm": [1.0, 2.0]}, {"rx_gain_db": np.nan}):
            with pytest.raises(SettingsError, match=next(iter(bad))):
                coverage.radio.power(**bad)
        with pytest.raises(SettingsError, match=r"threshold_db = -151.0 is not allowed"):
            coverage.radio.probability_above(-151.0)
        each = several.transpose("y", "x", "tx").radio.power(eirp_dbm=[20.0, 10.0])["power_mean_dbm"]
        np.testing.assert_allclose(each, several["gain_mean_db"] + np.array([20.0, 10.0])[:, None, None], atol=1e-4)

    def test_receivers_outside_a_complete_map_can_be_omitted(self, complete):
        drawing = map_of(COMPLETE)
        inside = predict_map(drawing, TX, spacing_m=float(complete.spacing_m), receivers="inside")
        seen = (complete["cell_state"] != CellState.UNKNOWN).to_numpy()
        assert not seen.all()
        for name in ("gain_mean_db", "valid"):
            values = (found[name].to_numpy()[seen].astype(float) for found in (inside, complete))
            np.testing.assert_allclose(*values, atol=1e-3)
        assert not inside["valid"].to_numpy()[~seen].any()
        assert inside.attrs["receivers"] == "indoor"

    def test_receivers_far_from_free_cells_can_be_omitted(self):
        cells = np.full((4, 12), int(CellState.UNKNOWN), dtype=np.uint8)
        cells[:, :4] = [[1, 1, 1, 1], [1, 0, 0, 2], [1, 0, 0, 2], [1, 1, 1, 1]]
        wide = PartialMap(cells, 1.0)
        every, near = (predict_map(wide, (1.5, 1.5), spacing_m=0.5, receivers=name) for name in ("indoor", "near"))
        kept = (every["valid"] & (every["x"] < 4.0)).to_numpy()
        np.testing.assert_array_equal(near["valid"], kept)
        np.testing.assert_array_equal(near["gain_mean_db"].to_numpy()[kept], every["gain_mean_db"].to_numpy()[kept])

    def test_a_weak_client_decides(self, complete, several):
        weak, strong = (complete.radio.power(eirp_dbm=23.0, client_dbm=client)["power_mean_dbm"] for client in (15, 30))
        np.testing.assert_allclose(weak, complete["gain_mean_db"] + 15.0, atol=1e-4)
        xr.testing.assert_equal(strong, complete.radio.power(eirp_dbm=23.0)["power_mean_dbm"])
        both, down = (several.radio.area(-67.0, client_dbm=client).fraction for client in ([5.0, 40.0], None))
        assert (both.isel(tx=0) < down.isel(tx=0)).any()
        xr.testing.assert_equal(both.isel(tx=1), down.isel(tx=1))
        with pytest.raises(SettingsError, match="client_dbm"):
            complete.radio.snr(client_dbm=np.nan)

    def test_access_points_keep_the_limit_of_their_band(self):
        assert eirp_limit_dbm(5.21e9, 80e6) == 23.0
        assert eirp_limit_dbm(5.21e9, 10e6) == pytest.approx(20.0)
        assert eirp_limit_dbm(6.185e9, 160e6, "FCC") == pytest.approx(27.04, abs=0.01)
        assert eirp_limit_dbm(28e9, 100e6) == math.inf
        assert access_point_eirp_dbm("home router", 5.6e9, 80e6) == 26.0
        assert access_point_eirp_dbm("ceiling access point", 2.442e9, 20e6) == 20.0
        with pytest.raises(SettingsError, match=r"frequency_hz = 28000000000.0 .* choose a band of Wi-Fi"):
            access_point_eirp_dbm("home router", 28e9, 80e6)
        with pytest.raises(SettingsError, match="region = 'MIC'"):
            eirp_limit_dbm(5.21e9, 80e6, "MIC")

    def test_area_above_a_power_is_counted(self, complete, several):
        area = complete.radio.area(-55.0, eirp_dbm=13.0, probability=0.9)
        floor = (complete["valid"] & (complete["cell_state"] == CellState.FREE)).to_numpy() == 1
        above = complete["gain_mean_db"].to_numpy()[floor] > -68.0
        assert 0.2 < above.mean() < 0.8
        assert area.fraction.sel(floor="observed").item() == pytest.approx(above.mean())
        assert area.area_m2.sel(floor="observed").item() == pytest.approx(floor.sum() * complete.spacing_m**2)
        each, together = (several.radio.area(-67.0, any_transmitter=of_all) for of_all in (False, True))
        means, mean = (found.fraction_mean.sel(floor="observed") for found in (each, together))
        assert means.max() <= mean + 1e-9
        assert mean <= means.sum() + 1e-9
        assert (several.radio.area(-400.0).fraction_mean < 1.0).all()  # an outage is never above

    @pytest.mark.parametrize(
        ("standard", "frequency_hz", "bandwidth_hz", "slowest", "fastest"),
        [
            ("wifi6", 2.4e9, 20e6, 8.6e6, 143.4e6),
            ("wifi7", 6.2e9, 320e6, 144.1e6, 2882.4e6),
            ("nr", 28e9, 100e6, 0.2344 * 82e6, 5.5547 * 82e6),
        ],
    )
    def test_rates_are_those_of_the_standards(self, coverage, standard, frequency_hz, bandwidth_hz, slowest, fastest):
        coverage = coverage.assign_attrs(frequency_hz=frequency_hz)
        table = schemes(standard, bandwidth_hz, frequency_hz)
        assert [table[0].rate_bit_s, table[-1].rate_bit_s] == pytest.approx([slowest, fastest], rel=0.003)
        assert all(low.snr_db < high.snr_db and low[1] < high[1] for low, high in pairwise(table))
        rate = coverage.radio.rate(standard, bandwidth_hz=bandwidth_hz, eirp_dbm=200.0)
        np.testing.assert_allclose(rate, coverage.radio.probability_above(-150.0) * table[-1].rate_bit_s, rtol=1e-3)

    @pytest.mark.parametrize(
        ("standard", "frequency_hz", "bandwidth_hz", "message"),
        [
            ("nr", 10e9, 100e6, "nr is defined at 0.41 to 7.125 and 24.25 to 71 GHz"),
            ("wifi6", 2.4e9, 80e6, "channels of wifi6 at 2.4 GHz are 2e.07, 4e.07 Hz wide"),
            ("nr", 28e9, 1.0, "channels of nr at 28 GHz are 5e.07 to 2e.09 Hz wide"),
        ],
    )
    def test_standards_have_bands_and_channels(self, coverage, standard, frequency_hz, bandwidth_hz, message):
        radio = coverage.assign_attrs(frequency_hz=frequency_hz).radio
        with pytest.raises(SettingsError, match=message):
            radio.rate(standard, bandwidth_hz=bandwidth_hz)

    def test_at_is_the_nearest_receiver(self, coverage):
        here = coverage.radio.at(0.7, 3.1)
        assert max(abs(here.x - 0.7), abs(here.y - 3.1)) <= 0.125
        with pytest.raises(PositionError, match=r"x = 5.1 is not on the map: give a number of metres in -1 to 5 m"):
            coverage.radio.at(5.1, 3.0)


def test_other_files_are_not_loaded(tmp_path):
    (tmp_path / "coverage.nc").write_bytes(b"no NetCDF file")
    with pytest.raises(SettingsError, match=r"path = '.*coverage.nc' is no NetCDF file .*: give one of save_cov"):
        load_coverage(tmp_path / "coverage.nc")
    xr.Dataset({"p_los": ("x", [0.5])}).to_netcdf(tmp_path / "coverage.nc", engine="h5netcdf")
    with pytest.raises(SettingsError, match="coverage lacks p_los"):
        load_coverage(tmp_path / "coverage.nc")


def test_unnamed_transmitters_are_counted_from_one():
    partial, here, far = map_of(PICTURE), (0.6, 3.6, 1.5), (900.0, 1.0, 1.5)
    assert transmitter_positions(partial, [here, here])[0] == ["tx1", "tx2"]
    for tx, name in (([here, far], "tx2"), ({"hall": here, "door": far}, "door")):
        with pytest.raises(PositionError, match=rf"^{name} = \(900\.0, .* is outside the map"):
            transmitter_positions(partial, tx)
