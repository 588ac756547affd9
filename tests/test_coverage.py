import json
import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from coverage_fakes import COMPLETE, PICTURE, TX, FakePredictor, coverage_of_several, map_of, small_coverage, use_fakes
from extruded import drawn
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from sionna_partial import coverage as coverage_module
from sionna_partial.constants import NO_RECEIVER, CellState, LinkState
from sionna_partial.coverage import predict_map
from sionna_partial.coverage_map import ATTRIBUTES, WALL_PARTS, require_coverage
from sionna_partial.errors import MapError, MemoryLimitError, PositionError, SettingsError
from sionna_partial.export import load_coverage
from sionna_partial.maps.map_files import save_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.windows import map_windows
from sionna_partial.settings import Material, SceneSettings, TraceSettings


@pytest.fixture
def fakes(monkeypatch):
    use_fakes(monkeypatch)


@pytest.fixture
def coverage(monkeypatch):
    return small_coverage(monkeypatch)


@pytest.fixture
def no_work(monkeypatch):
    """Fail when anything heavy starts."""

    def heavy(*args, **kwargs):
        pytest.fail("heavy work started before the input was checked")

    for name in ("Tracer", "features_of_paths"):
        monkeypatch.setattr(coverage_module, name, heavy)
    monkeypatch.setattr(coverage_module.Predictor, "load", heavy)


def unknown_map(ny=8, nx=12):
    return PartialMap(np.full((ny, nx), CellState.UNKNOWN, dtype=np.uint8), 0.5)


def test_receivers_stand_at_the_cell_centres_of_a_grid_that_starts_in_the_lower_left_corner(coverage):
    np.testing.assert_allclose(coverage["x"], -1.0 + 0.25 * (np.arange(24) + 0.5))
    np.testing.assert_allclose(coverage["y"], 2.0 + 0.25 * (np.arange(16) + 0.5))


@given(st.floats(0.05, 3.0), st.integers(1, 9), st.integers(1, 9))
@settings(max_examples=60, deadline=None)
def test_every_receiver_lies_on_the_map_and_no_more_would_fit(spacing_m, ny, nx):
    partial = unknown_map(ny, nx)
    assume(abs(spacing_m - min(ny, nx)) > 1e-6)
    if spacing_m > 2 * 0.5 * min(ny, nx):
        with pytest.raises(SettingsError, match="spacing_m"):
            coverage_module._grid_axes(partial, spacing_m)
        return
    for axis, length in zip(coverage_module._grid_axes(partial, spacing_m), (0.5 * nx, 0.5 * ny), strict=True):
        assert axis[0] == pytest.approx(spacing_m / 2)
        assert axis[-1] < length
        assert axis[-1] + spacing_m >= length - 1e-6


def test_masks_follow_the_map(coverage):
    partial = map_of(PICTURE)
    x, y = np.meshgrid(coverage["x"], coverage["y"])
    state = partial.state_at(np.stack([x, y], axis=-1))
    np.testing.assert_array_equal(coverage["cell_state"], state)
    np.testing.assert_array_equal(coverage["observed"], state != CellState.UNKNOWN)
    np.testing.assert_array_equal(coverage["valid"], state != CellState.WALL)


def test_all_documented_variables_are_there_and_nan_exactly_where_no_receiver_stands(coverage):
    assert set(coverage.data_vars) == set(ATTRIBUTES)
    valid = coverage["valid"].to_numpy()
    assert valid.any()
    assert not valid.all()
    for name, layer in coverage.data_vars.items():
        assert layer.dims == ("y", "x")
        if layer.dtype.kind == "f":
            np.testing.assert_array_equal(np.isnan(layer), ~valid, err_msg=name)
    for name in ("link_state", "partial_link_state"):
        np.testing.assert_array_equal(coverage[name] == NO_RECEIVER, ~valid)
        assert set(np.unique(coverage[name].to_numpy()[valid])) <= set(LinkState)


def test_the_answers_of_tracer_and_predictor_are_laid_out_row_by_row(coverage):
    here = coverage.sel(x=2.125, y=3.625)
    distance_m = np.hypot(2.125 - TX[0], 3.625 - TX[1])
    assert float(here["distance_m"]) == pytest.approx(distance_m, rel=1e-6)
    assert int(here["partial_link_state"]) == LinkState.LOS
    assert float(here["partial_gain_db"]) == pytest.approx(-61.4 - 20 * np.log10(distance_m), rel=1e-6)
    far = coverage.sel(x=4.875, y=5.875)
    assert not far["observed"]
    leak = min(0.6, 0.1 * float(far["unobserved_distance_m"]))
    assert leak > 0
    assert float(far["p_outage"]) == pytest.approx(1 - leak, rel=1e-5)
    assert int(far["link_state"]) == LinkState.OUTAGE


def test_what_is_seen_to_be_free_is_indoors_for_certain(coverage):
    free = (coverage["cell_state"] == CellState.FREE).to_numpy()
    unknown = (coverage["cell_state"] == CellState.UNKNOWN).to_numpy()
    assert (coverage["p_indoor"].to_numpy()[free] == 1.0).all()
    assert (coverage["p_indoor"].to_numpy()[unknown] == 0.25).all()


class TestReceiversAnywhere:
    def test_outside_is_mixed_in_as_outage(self, coverage):
        anywhere = predict_map(map_of(PICTURE), TX, spacing_m=0.25, receivers="anywhere")
        for name in ("p_los", "p_nlos"):
            np.testing.assert_allclose(anywhere[name], coverage["p_indoor"] * coverage[name], rtol=1e-6)
        np.testing.assert_allclose(anywhere["p_outage"], 1.0 - anywhere["p_los"] - anywhere["p_nlos"], atol=1e-6)
        parts = zip(("p_outage", "p_los", "p_nlos"), (-150.0, *gains(anywhere)), strict=True)
        mean_db = np.maximum(sum(anywhere[p] * gain for p, gain in parts), -150.0)
        np.testing.assert_allclose(anywhere["gain_mean_db"], mean_db, rtol=1e-5)
        for name in ("p_indoor", "partial_gain_db", "gain_los_mean_db", "gain_nlos_std_db"):
            np.testing.assert_array_equal(anywhere[name], coverage[name])

    def test_attributes_say_whose_probabilities_they_are(self, coverage):
        anywhere = predict_map(map_of(PICTURE), TX, spacing_m=0.25, receivers="anywhere")
        assert coverage.attrs["receivers"] == "indoor"
        assert coverage["p_los"].attrs["long_name"].endswith(", given that the receiver is indoors")
        assert anywhere.attrs["receivers"] == "anywhere"
        assert anywhere["link_state"].attrs["long_name"].endswith(", of a receiver that may be outdoors, in outage")

    def test_on_a_complete_map_outside_is_outage_for_certain(self, fakes):
        indoor, anywhere = (
            predict_map(map_of(COMPLETE), TX, spacing_m=0.25, receivers=whose) for whose in ("indoor", "anywhere")
        )
        valid, free = indoor["valid"].to_numpy(), (indoor["cell_state"] == CellState.FREE).to_numpy()
        outside = valid & ~free
        assert outside.any()
        assert (indoor["p_outage"].to_numpy()[outside] < 1.0).any()
        assert (anywhere["p_outage"].to_numpy()[outside] == 1.0).all()
        assert (anywhere["gain_mean_db"].to_numpy()[outside] == -150.0).all()
        for name in ("p_los", "p_outage", "gain_mean_db", "link_state"):
            np.testing.assert_array_equal(anywhere[name].to_numpy()[free], indoor[name].to_numpy()[free])

    def test_unknown_word(self, no_work):
        message = r"receivers = 'outdoor' is not allowed: choose one of indoor, anywhere\."
        with pytest.raises(SettingsError, match=message):
            predict_map(map_of(PICTURE), TX, receivers="outdoor")


def gains(coverage):
    return coverage["gain_los_mean_db"], coverage["gain_nlos_mean_db"]


def test_on_a_complete_map_the_trace_is_the_answer(fakes, monkeypatch):
    monkeypatch.setattr(FakePredictor, "load", lambda name: pytest.fail("no predictor is needed"))
    partial = map_of(COMPLETE)
    assert partial.is_complete
    coverage = predict_map(partial, TX, spacing_m=0.25)
    valid = coverage["valid"].to_numpy()
    for state, name in ((LinkState.LOS, "p_los"), (LinkState.NLOS, "p_nlos"), (LinkState.OUTAGE, "p_outage")):
        np.testing.assert_array_equal(
            coverage[name].to_numpy()[valid], (coverage["partial_link_state"] == state).to_numpy()[valid]
        )
    np.testing.assert_array_equal(coverage["link_state"], coverage["partial_link_state"])
    np.testing.assert_array_equal(coverage["gain_mean_db"], coverage["partial_gain_db"])
    assert float(coverage["gain_std_db"].max()) == 0.0
    assert float(coverage["unobserved_distance_m"].max()) == 0.0
    free = (coverage["cell_state"] == CellState.FREE).to_numpy()
    np.testing.assert_array_equal(coverage["p_indoor"].to_numpy()[valid], free[valid])
    assert coverage.attrs["predictor_sha256"] == ""


def test_a_transmitter_behind_the_walls_of_a_complete_map_is_predicted():
    """A room that a robot has finished; the transmitter is in one that it never saw."""
    partial = drawn("#####????? #...#????? #...#????? #####?????", 1.0)
    assert partial.is_complete
    coverage = predict_map(partial, (7.5, 2.5, 1.5), spacing_m=0.5)
    unseen, seen = coverage.radio.at(6.5, 1.5), coverage.radio.at(2.5, 1.5)
    assert (coverage.attrs["map_complete"], coverage.attrs["predictor"]) == (0, "map")
    assert 0.0 < float(unseen.p_los) < 1.0
    assert float(seen.p_outage) == 1.0


def test_a_map_without_walls_and_one_that_is_all_unknown_are_answered(fakes):
    free = PartialMap(np.zeros((8, 12), dtype=np.uint8), 0.5)
    for partial in (free, unknown_map()):
        coverage = predict_map(partial, (1.1, 1.1), spacing_m=0.5)
        assert coverage["valid"].all()
        assert np.isfinite(coverage["gain_mean_db"]).all()


def test_a_frequency_too_low_for_the_map_is_named(no_work):
    message = r"every receiver is within 23\.9 m of the transmitter.* frequency_hz = 1e\+06: give a higher frequency"
    with pytest.raises(PositionError, match=message):
        predict_map(unknown_map(), (1.0, 1.0), trace_settings=TraceSettings(frequency_hz=1e6))


@pytest.mark.parametrize("name", ["scene_settings", "trace_settings"])
def test_settings_of_another_kind_are_named(no_work, name):
    kind = name.title().replace("_", "")
    for wrong in (5, {}):
        message = rf"{name} = {wrong} is not allowed: give {kind}\(\.\.\.\), or None for the default\."
        with pytest.raises(SettingsError, match=message):
            predict_map(unknown_map(), (1.0, 1.0), **{name: wrong})


def test_no_receiver_stands_at_the_transmitter(fakes):
    coverage = predict_map(unknown_map(), (1.75, 2.25), spacing_m=0.5)
    at_tx = ~coverage["valid"].to_numpy()
    assert at_tx.sum() == 1
    assert np.isnan(coverage["gain_mean_db"].sel(x=1.75, y=2.25))
    assert coverage["cell_state"].sel(x=1.75, y=2.25) == CellState.UNKNOWN
    assert predict_map(unknown_map(), (1.75, 2.25, 1.6), spacing_m=0.5)["valid"].all()


def test_at_low_frequencies_friis_stays_below_0_db(fakes):
    coverage = predict_map(unknown_map(), (1.75, 2.25), spacing_m=0.5, trace_settings=TraceSettings(frequency_hz=30e6))
    distance_m = np.hypot(coverage["x"] - 1.75, coverage["y"] - 2.25)
    np.testing.assert_array_equal(coverage["valid"], (distance_m >= 9.99308 / (4 * np.pi)).transpose("y", "x"))


def test_receivers_within_a_centimetre_of_a_wall_are_masked(fakes):
    state = np.zeros((6, 6), dtype=np.uint8)
    state[:, 3] = CellState.WALL
    coverage = predict_map(PartialMap(state, 0.5), (0.6, 0.6), spacing_m=0.2)
    x = coverage["x"].to_numpy()
    near_m = np.maximum(1.5 - x, x - 2.0)
    np.testing.assert_array_equal(coverage["valid"].to_numpy().all(axis=0), near_m > 0.01)
    assert 1.5 in np.round(x, 9)


def test_a_wall_thinner_than_a_receiver_cell_is_kept_for_pictures(fakes):
    state = np.zeros((6, 6), dtype=np.uint8)
    state[4, 0] = CellState.WALL
    coverage = predict_map(PartialMap(state, 0.5), (0.6, 0.6), spacing_m=1.5)
    assert coverage["valid"].all()
    expected = np.zeros((2, 2), dtype=np.int64)
    for row in (2, 3):
        for column in (0, 1):
            expected[1, 0] |= 1 << (WALL_PARTS * row + column)
    np.testing.assert_array_equal(coverage["wall_parts"], expected)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("spacing_m", [0.1, 0.3, 0.7, 1.0, 1.1, 1.6])
def test_wall_parts_cover_every_wall_and_nothing_far_from_one(fakes, spacing_m, seed):
    state = (np.random.default_rng(seed).random((7, 9)) < 0.2).astype(np.uint8)
    state[0, 0] = CellState.FREE
    coverage = predict_map(PartialMap(state, 0.5), (0.2, 0.2), spacing_m=spacing_m)
    bits, x_m, y_m = (coverage[name].to_numpy() for name in ("wall_parts", "x", "y"))
    part = np.arange(WALL_PARTS)
    found = (bits[:, None, :, None] >> (WALL_PARTS * part[:, None, None] + part)) & 1
    found = found.reshape(WALL_PARTS * len(y_m), WALL_PARTS * len(x_m)).astype(bool)
    edge = spacing_m / WALL_PARTS
    for row, column in np.ndindex(found.shape):
        low = np.array([column, row]) * edge
        cells = np.argwhere(state)[:, ::-1] * 0.5
        overlap = np.minimum(low + edge, cells + 0.5) - np.maximum(low, cells)
        assert found[row, column] == (overlap > 1e-6).all(axis=1).any()


def test_moving_the_map_moves_the_answer(fakes):
    near = predict_map(map_of(PICTURE), TX, spacing_m=0.25)
    far = predict_map(map_of(PICTURE, origin_m=(499_999.0, 4_500_002.0)), (500_000.6, 4_500_003.6), spacing_m=0.25)
    for name in ATTRIBUTES:
        np.testing.assert_allclose(near[name], far[name], atol=1e-4, err_msg=name)


def test_a_path_is_read(fakes, tmp_path):
    save_map(map_of(PICTURE), tmp_path / "map.yaml")
    xr.testing.assert_identical(
        predict_map(tmp_path / "map.yaml", TX, spacing_m=0.25), predict_map(map_of(PICTURE), TX, spacing_m=0.25)
    )
    with pytest.raises(MapError, match="missing"):
        predict_map(tmp_path / "missing.yaml", TX)


def test_a_predictor_is_used_as_it_is(fakes):
    predictor = FakePredictor()
    predictor.name = "mine"
    assert predict_map(map_of(PICTURE), TX, spacing_m=0.5, predictor=predictor).attrs["predictor"] == "mine"


def test_the_predictor_gets_context_and_windows(fakes, monkeypatch):
    predictor, seen = FakePredictor(), []
    monkeypatch.setattr(predictor, "predict", lambda phi: seen.append(phi) or FakePredictor().predict(phi))
    partial = map_of(PICTURE)
    coverage = predict_map(partial, TX, spacing_m=0.5, predictor=predictor)
    (phi,) = seen
    np.testing.assert_array_equal(phi.context.windows, map_windows(partial, np.array([TX])))
    receivers = np.stack(np.meshgrid(coverage["x"], coverage["y"]), axis=-1)[coverage["valid"].to_numpy()]
    np.testing.assert_allclose(phi.context.rx_m, np.column_stack([receivers, np.full(len(receivers), 1.5)]))
    np.testing.assert_allclose(phi.context.tx_m, np.tile([*TX, 1.5], (len(receivers), 1)))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"trace_settings": TraceSettings(frequency_hz=60e9)}, "at 28 GHz, and is used at 60 GHz: its"),
        (
            {"trace_settings": TraceSettings(diffraction=False)},
            "with diffraction, and is used without diffraction: its",
        ),
        ({"trace_settings": TraceSettings(max_depth=1)}, "with max_depth = 6, and is used with max_depth = 1: its"),
        (
            {"scene_settings": SceneSettings(material=Material(itu="metal"))},
            "on walls that transmit, and is used on walls of metal: its",
        ),
    ],
)
def test_a_predictor_trained_on_other_traces_is_warned_about(fakes, caplog, settings, words):
    predict_map(map_of(PICTURE), TX, spacing_m=0.5)
    assert not caplog.messages
    predict_map(map_of(PICTURE), TX, spacing_m=0.5, **settings)
    (message,) = caplog.messages
    assert message.startswith(f"predictor 'fake' was trained {words}")


def test_settings_reach_the_tracer_and_the_attributes(fakes):
    coverage = predict_map(
        map_of(PICTURE),
        TX,
        rx_height_m=1.0,
        spacing_m=0.5,
        scene_settings=SceneSettings(material=Material(itu="concrete")),
        trace_settings=TraceSettings(frequency_hz=60e9, max_depth=3),
    )
    attributes = coverage.attrs
    assert attributes["Conventions"] == "CF-1.11"
    assert (attributes["frequency_hz"], attributes["rx_height_m"], attributes["spacing_m"]) == (60e9, 1.0, 0.5)
    assert json.loads(attributes["trace_settings"])["max_depth"] == 3
    assert json.loads(attributes["scene_settings"])["material"]["itu"] == "concrete"
    assert "sionna-rt" in attributes["source"]
    assert (attributes["predictor"], attributes["predictor_sha256"]) == ("fake", "0" * 64)
    assert float(coverage["distance_m"].min()) >= 0.5


def test_material_of_the_map_reaches_the_attributes(fakes):
    partial = replace(map_of(PICTURE), material=Material(itu="concrete"))
    coverage = predict_map(partial, TX, spacing_m=0.5)
    assert json.loads(coverage.attrs["scene_settings"])["material"]["itu"] == "concrete"


def test_units_and_flags_follow_cf(coverage):
    assert coverage["x"].attrs["standard_name"] == "projection_x_coordinate"
    for name, layer in coverage.variables.items():
        assert "long_name" in layer.attrs, name
        assert ("units" in layer.attrs) or ("flag_values" in layer.attrs) or name == "wall_parts"
        if "flag_values" in layer.attrs:
            assert len(layer.attrs["flag_values"]) == len(layer.attrs["flag_meanings"].split())
    assert coverage["link_state"].attrs["flag_meanings"] == "outage los nlos no_receiver"


def test_progress_grows_to_1(fakes):
    calls = []
    predict_map(map_of(PICTURE), TX, spacing_m=0.5, progress=lambda share, message: calls.append((share, message)))
    shares = [share for share, _ in calls]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert all(message for _, message in calls)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"tx": (50.0, 3.6)}, PositionError, r"tx = \(50\.0, 3\.6, 1\.5\) is outside the map"),
        ({"tx": (-0.25, 3.6)}, PositionError, r"tx = .* is inside a wall"),
        ({"tx": (0.6, float("nan"))}, PositionError, r"tx = .* is not finite"),
        ({"tx": (0.6, 3.6, 9.0)}, PositionError, r"tx = .* is not between floor and ceiling"),
        ({"tx": "here"}, PositionError, r"tx = 'here' is not numeric"),
        ({"tx": (("a", "b"))}, PositionError, r"tx = \('a', 'b'\) is not numeric"),
        ({"rx_height_m": 0.0}, SettingsError, r"rx_height_m = 0\.0 is not allowed"),
        ({"rx_height_m": 3.0}, SettingsError, r"rx_height_m = 3\.0 is not allowed: stay below the ceiling at 3 m"),
        ({"rx_height_m": float("nan")}, SettingsError, r"rx_height_m = nan is not allowed"),
        ({"spacing_m": 0.0}, SettingsError, r"spacing_m = 0\.0 is not allowed"),
        ({"spacing_m": float("inf")}, SettingsError, r"spacing_m = inf is not allowed"),
        ({"spacing_m": 9.0}, SettingsError, r"spacing_m = 9\.0 .* the map is 6 x 4 m; give 4 or less"),
        (
            {"spacing_m": 0.05, "scene": unknown_map(400, 600)},
            SettingsError,
            r"spacing_m = 0\.05 .* makes 24,000,000 receivers, more than 2,000,000; give 0\.19 or more",
        ),
        (
            {
                "trace_settings": TraceSettings(frequency_hz=60e9),
                "scene_settings": SceneSettings(Material(itu="brick")),
            },
            SettingsError,
            r"frequency_hz = 60000000000\.0 .* 'brick'",
        ),
    ],
)
def test_bad_input_is_refused_before_any_heavy_work(no_work, arguments, error, message):
    arguments = {"scene": map_of(PICTURE), "tx": TX} | arguments
    with pytest.raises(error, match=message):
        predict_map(arguments.pop("scene"), arguments.pop("tx"), **arguments)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data.drop_vars(["p_los", "valid"]), r"coverage lacks p_los, valid: give the xarray\.Dataset"),
        (lambda data: data.drop_attrs(), "coverage lacks transmitter_m, spacing_m, frequency_hz"),
        (lambda data: data.transpose("x", "y"), "coverage lacks p_los"),
        (lambda data: data.isel(x=slice(0, 0)), "coverage lacks receivers"),
        (lambda data: data.drop_vars("x"), "coverage lacks x:"),
        (lambda data: data["p_los"], "coverage is of type DataArray"),
        (lambda data: data.drop_attrs().assign_coords(tx="a"), "coverage lacks transmitter_m"),
        (lambda data: data * 1.0, r"coverage\.link_state = .*float"),
        (lambda data: data.astype(str), r"coverage\.p_los = "),
        (lambda data: data.assign_attrs(spacing_m="x"), r"coverage\.spacing_m = 'x'"),
        (lambda data: data.assign_attrs(frequency_hz=None), r"coverage\.frequency_hz = None"),
        (lambda data: data.assign_attrs(transmitter_m=[1.0, math.nan, 1.5]), r"coverage\.transmitter_m = "),
    ],
)
def test_what_is_no_coverage_map_is_named(coverage, spoil, message):
    require_coverage(coverage)
    with pytest.raises(SettingsError, match=message):
        require_coverage(spoil(coverage))


class TestMemory:
    def test_a_job_that_does_not_fit_is_refused_before_it_starts(self, no_work):
        with pytest.raises(MemoryLimitError, match=r"memory_gb = 0\.1 .* receivers on a map of 96 cells"):
            predict_map(map_of(PICTURE), TX, memory_gb=0.1)

    def test_the_answer_does_not_depend_on_the_blocks(self, coverage, monkeypatch):
        for name in ("_FEWEST_RECEIVERS", "_MOST_RECEIVERS"):
            monkeypatch.setattr(coverage_module, name, 7)
        assert predict_map(map_of(PICTURE), TX, spacing_m=0.25).identical(coverage)


class TestAccessor:
    def test_probability_above_is_that_of_the_mixture(self, coverage):
        above = coverage.radio.probability_above(-70.0)
        assert above.dims == ("y", "x")
        assert above.units == "1"
        los, nlos = (
            coverage[f"p_{state}"]
            * norm.sf(-70.0, coverage[f"gain_{state}_mean_db"], coverage[f"gain_{state}_std_db"] + 1e-9)
            for state in ("los", "nlos")
        )
        valid = (coverage["valid"] & (coverage["gain_los_std_db"] > 0.0)).to_numpy()
        assert np.allclose(above.to_numpy()[valid], (los + nlos).to_numpy()[valid], atol=1e-5)
        assert ((above > 0.01) & (above < 0.99)).any()
        assert np.array_equal(np.isnan(above), ~coverage["valid"])

    def test_an_outage_has_150_db(self, coverage):
        valid = coverage["valid"].to_numpy()
        at_floor = coverage.radio.probability_above(-150.0).to_numpy()[valid]
        outage = coverage["p_outage"].to_numpy()[valid]
        assert (at_floor <= 1.0 - outage + 1e-6).all()
        assert outage.max() > 0.5

    def test_without_uncertainty_it_is_a_step(self, fakes):
        known = predict_map(map_of(COMPLETE), TX, spacing_m=0.5)
        above = known.radio.probability_above(-75.0).to_numpy()
        expected = (known["gain_mean_db"] > -75.0).where(known["valid"].astype(bool))
        assert np.array_equal(above, expected, equal_nan=True)

    def test_at_is_the_nearest_receiver(self, coverage):
        here = coverage.radio.at(0.7, 3.1)
        assert abs(float(here.x) - 0.7) <= 0.125
        assert abs(float(here.y) - 3.1) <= 0.125
        assert here.p_los.item() == coverage.p_los.sel(x=here.x, y=here.y).item()

    @pytest.mark.parametrize(
        ("x", "y", "message"),
        [
            (5.1, 3.0, r"x = 5.1 is not on the map: give a number of metres in -1 to 5 m"),
            (0.0, np.nan, r"y = nan is not on the map: give a number of metres in 2 to 6 m"),
            ("0", 3.0, r"x = '0' is not on the map"),
        ],
    )
    def test_beyond_the_map(self, coverage, x, y, message):
        with pytest.raises(PositionError, match=message):
            coverage.radio.at(x, y)

    def test_several_transmitters(self, monkeypatch):
        several = coverage_of_several(monkeypatch)
        above = several.radio.probability_above(-70.0)
        for tx in several["tx"]:
            assert np.array_equal(above.sel(tx=tx), several.sel(tx=tx).radio.probability_above(-70.0), equal_nan=True)
        assert several.radio.at(0.7, 3.1).p_los.sizes == {"tx": 2}
        assert repr(several.radio) == "<coverage: 24 x 16 receivers, 0.25 m apart, 2 transmitters, 28 GHz>"

    def test_plot_and_save(self, coverage, tmp_path):
        assert len(coverage.radio.plot().axes) > 3
        coverage.radio.save(tmp_path / "coverage.nc")
        loaded = load_coverage(tmp_path / "coverage.nc")
        assert loaded.identical(coverage)
        assert loaded.radio.at(0.7, 3.1).identical(coverage.radio.at(0.7, 3.1))

    @pytest.mark.parametrize("call", ["probability_above", "at", "__repr__"])
    def test_other_datasets_are_refused(self, call):
        other = xr.Dataset({"p_los": ("x", [0.5])})
        arguments = {"probability_above": [-90.0], "at": [0.0, 0.0]}.get(call, [])
        with pytest.raises(SettingsError, match="coverage lacks "):
            getattr(other.radio, call)(*arguments)

    @pytest.mark.parametrize("threshold", [np.nan, "low", True, -151.0])
    def test_thresholds_are_refused(self, coverage, threshold):
        with pytest.raises(SettingsError, match=r"threshold_db = .* is not allowed"):
            coverage.radio.probability_above(threshold)


class TestLoad:
    @pytest.mark.parametrize("content", [b"", b"no NetCDF file", b"\x89HDF\r\n\x1a\n" + bytes(64)])
    def test_other_files_are_refused(self, tmp_path, content):
        (tmp_path / "coverage.nc").write_bytes(content)
        with pytest.raises(SettingsError, match=r"path = '.*coverage.nc' is no NetCDF file .*: give one of save_cov"):
            load_coverage(tmp_path / "coverage.nc")

    def test_no_file(self, tmp_path):
        with pytest.raises(SettingsError, match="cannot be read"):
            load_coverage(tmp_path / "coverage.nc")

    def test_other_datasets_are_refused(self, tmp_path):
        xr.Dataset({"p_los": ("x", [0.5])}).to_netcdf(tmp_path / "coverage.nc", engine="h5netcdf")
        with pytest.raises(SettingsError, match="coverage lacks p_los"):
            load_coverage(tmp_path / "coverage.nc")
