"""The trace against closed forms, what it may not depend on, and what it refuses."""

import dataclasses
import functools
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import fresnel

from sionna_partial.constants import SPEED_OF_LIGHT_M_S, CellState, LinkState
from sionna_partial.errors import MemoryLimitError, PositionError, PredictorError, SettingsError
from sionna_partial.llvm import load_sionna
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import link_features
from sionna_partial.settings import Material, SceneSettings, TraceSettings
from sionna_partial.tracing import engine, simulation
from sionna_partial.tracing.gradients import gain_gradients
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.power import reflection_loss_db
from sionna_partial.tracing.simulation import Simulation
from sionna_partial.tracing.trace import trace_links

WAVELENGTH_M = SPEED_OF_LIGHT_M_S / 28e9
all_paths = functools.partial(TraceSettings, power_tolerance_db=0.0)
NO_FLOOR = SceneSettings(floor_extent="none")
SPECULAR = all_paths(diffraction=False)


def _room() -> PartialMap:
    """6 m x 4 m of free cells in walls, parted by a wall with a door of 1 m."""
    state = np.full((42, 62), CellState.WALL, dtype=np.uint8)
    state[1:-1, 1:-1] = CellState.FREE
    state[1:15, 30] = CellState.WALL
    state[25:-1, 30] = CellState.WALL
    return PartialMap(state, 0.1)


def _half_seen_room() -> PartialMap:
    state = _room().state.copy()
    state[:, 45:] = CellState.UNKNOWN
    state[:6, :20] = CellState.UNKNOWN
    return PartialMap(state, 0.1)


def test_free_space_gain_delay_and_angles() -> None:
    partial = PartialMap(np.zeros((100, 100), np.uint8), 0.1)
    tx, rx = np.array([1.0, 2.0, 1.5]), np.array([[4.0, 6.0, 1.5], [1.0, 2.0, 2.5], [9.0, 2.0, 1.5]])
    links = trace_links(partial, tx, rx, scene_settings=NO_FLOOR)
    distance = np.linalg.norm(rx - tx, axis=1)
    assert (links.link_state == LinkState.LOS).all()
    assert links.path_rx.tolist() == [0, 1, 2]
    np.testing.assert_allclose(links.gain_db, 20 * np.log10(WAVELENGTH_M / (4 * np.pi * distance)), atol=1e-3)
    np.testing.assert_allclose(links.delay_s, distance / SPEED_OF_LIGHT_M_S, rtol=1e-5)
    np.testing.assert_allclose(links.departure_rad[0], [np.pi / 2, np.arctan2(4, 3)], atol=1e-5)
    np.testing.assert_allclose(links.arrival_rad[0], [np.pi / 2, np.arctan2(-4, -3)], atol=1e-5)


def test_one_mirror_image_with_the_slab_reflection_coefficient() -> None:
    """Vertical antennas see the TE coefficient of the slab, horizontal ones the TM coefficient."""
    state = np.zeros((60, 100), np.uint8)
    state[50, :] = CellState.WALL
    tx, rx = np.array([1.0, 2.0, 1.5]), np.array([[5.0, 3.0, 1.5]])
    links = trace_links(PartialMap(state, 0.1), tx, rx, trace_settings=SPECULAR, scene_settings=NO_FLOOR)
    wall_y, (direct, mirrored) = 5.05, range(len(links.a))
    across = (wall_y - 2.0) + (wall_y - 3.0)
    length, angle_deg = np.hypot(4.0, across), np.degrees(np.arctan2(4.0, across))
    slab = dataclasses.astuple(Material())[:3]
    loss_db = [reflection_loss_db(*slab, 28e9, angle_deg, polarisation) for polarisation in ("te", "tm")]
    found = np.abs(links.transfer[mirrored]) * 4 * np.pi * length / WAVELENGTH_M
    np.testing.assert_allclose(found, np.diag(10.0 ** (np.array(loss_db) / -20.0)), rtol=1e-3, atol=1e-6)
    assert links.delay_s[mirrored] * SPEED_OF_LIGHT_M_S == pytest.approx(length, rel=1e-5)
    x = 1.0 + 4.0 * (wall_y - 2.0) / across
    np.testing.assert_allclose(links.vertices_m[mirrored, 0], [x, wall_y, 1.5], atol=1e-4)
    assert np.isnan(links.vertices_m[mirrored, 1:]).all()
    assert links.interactions[mirrored].tolist() == [1, 0, 0, 0, 0, 0]
    total = abs(links.a[direct]) ** 2 + abs(links.a[mirrored]) ** 2
    assert links.gain_db[0] == pytest.approx(10 * np.log10(total), abs=1e-6)


def test_corridor_of_two_walls_has_every_image() -> None:
    state = np.zeros((41, 400), np.uint8)
    state[[0, 40], :] = CellState.WALL
    low, high = 0.05, 4.05
    tx, rx = np.array([19.0, 1.25, 1.5]), np.array([[21.0, 3.05, 1.5]])
    links = trace_links(PartialMap(state, 0.1), tx, rx, trace_settings=SPECULAR, scene_settings=NO_FLOOR)
    width, offsets = high - low, [rx[0, 1] - tx[1]]
    for count, first in itertools.product(range(1, 7), (low, high)):
        to_first = abs(tx[1] - first)
        last = first if count % 2 == 1 else (low + high - first)
        offsets.append(to_first + (count - 1) * width + abs(rx[0, 1] - last))
    expected = np.sort(np.hypot(2.0, offsets))
    np.testing.assert_allclose(links.delay_s * SPEED_OF_LIGHT_M_S, expected, rtol=1e-5)


def _grid(partial: PartialMap, spacing_m: float) -> NDArray[np.float64]:
    x0, y0, x1, y1 = partial.bounds_m
    x, y = np.meshgrid(np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m))
    rx = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)])
    return rx[partial.state_at(rx) != CellState.WALL]


@pytest.mark.parametrize("settings", [TraceSettings(), all_paths(open_ends=True)])
def test_the_answer_depends_on_no_other_receiver_and_no_run(settings: TraceSettings) -> None:
    partial = _half_seen_room()
    tx, rx = (1.05, 2.95, 1.5), _grid(partial, 0.3)
    together, again = (trace_links(partial, tx, rx, trace_settings=settings) for _ in range(2))
    for name in ("a", "delay_s", "departure_rad", "arrival_rad", "interactions", "vertices_m", "gain_db"):
        assert getattr(together, name).tobytes() == getattr(again, name).tobytes()
    some = np.arange(0, len(rx), 17)
    apart = trace_links(partial, tx, rx[some], trace_settings=settings)
    np.testing.assert_array_equal(apart.link_state, together.link_state[some])
    np.testing.assert_array_equal(apart.gain_db, together.gain_db[some])


def test_the_number_of_threads_changes_nothing() -> None:
    load_sionna()
    import drjit as dr

    tx, rx = (1.05, 2.95, 1.5), _grid(_room(), 0.2)
    threads, runs = dr.thread_count(), []
    try:
        for count in (1, 2, 3):
            dr.set_thread_count(count)
            runs.append(trace_links(_room(), tx, rx))
    finally:
        dr.set_thread_count(threads)
    for name in ("a", "delay_s", "departure_rad", "vertices_m", "gain_db", "path_rx"):
        assert len({getattr(run, name).tobytes() for run in runs}) == 1


def test_rays_are_announced(caplog: pytest.LogCaptureFixture) -> None:
    tx, rx = (1.0, 1.0, 1.5), [[2.0, 1.0, 1.5]]
    trace_links(_room(), tx, rx)
    assert not caplog.messages
    trace_links(_room(), tx, rx, trace_settings=all_paths(max_depth=1, diffuse_reflection=True, samples_per_tx=1000))
    assert caplog.messages == [
        "diffuse reflection: Sionna RT shoots 1000 rays for one receiver after the other, and finds most paths, not all"
    ]


@pytest.mark.parametrize(
    ("tx", "rx", "message"),
    [
        ((np.nan, 1.0, 1.5), [[1.0, 1.0, 1.0]], r"tx = \(nan, 1.0, 1.5\) is not finite"),
        ([(1.0, 1.0, 1.5), (0.05, 1.0, 1.5)], [[2.0, 1.0, 1.5]], r"^tx2 = \(0.05, 1.0, 1.5\) is inside a wall"),
        ((1.0, 1.0, 1.5), [[1.0, 1.0, 3.0]], r"rx\[0\] = .* is not between floor and ceiling"),
        ((1.0, 1.0, 1.5), [[1.0, 1.0, 1.0], [1.0]], r"rx = .* is not numeric: give x, y, z in metres\."),
        ((1.0, 1.0, 1.5), [[1.0, 1.0]], r"rx has shape \(1, 2\): give x, y, z in metres, \(3,\) or \(N, 3\)"),
        (
            (1.0, 1.0, 1.5),
            [[2.0, 1.0, 1.0], [1.0, 1.005, 1.5]],
            r"rx\[1\] = \(1.0, 1.005, 1.5\) is 0.005 m from the transmitter.*: leave out receivers nearer than 0.011 m",
        ),
    ],
)
def test_positions_are_checked(tx: object, rx: object, message: str) -> None:
    with pytest.raises(PositionError, match=message):
        trace_links(_room(), tx, rx)  # type: ignore[arg-type]


def test_arguments_are_checked() -> None:
    for values in ({"trace_settings": 5}, {"memory_gb": math.nan}, {"invalid": "skip"}):
        ((name, value),) = values.items()
        with pytest.raises(SettingsError, match=f"^{name} = {value!r} is not allowed"):
            trace_links(_room(), (1.0, 1.0, 1.5), [[2.0, 1.0, 1.5]], **values)


def test_links_shorter_than_friis_allows_are_refused() -> None:
    settings = all_paths(frequency_hz=10e6)
    with pytest.raises(PositionError, match=r"is 1.* m from the transmitter.*: leave out receivers nearer than 2.39 m"):
        trace_links(_room(), (1.0, 1.0, 1.5), [[2.0, 1.0, 1.5]], trace_settings=settings)


def test_the_field_behind_an_open_wall_end_follows_the_fresnel_integral() -> None:
    state, edge_x = np.zeros((80, 120), np.uint8), 5.95
    state[40, :60] = CellState.WALL
    tx = np.array([edge_x, 0.55, 1.5])
    rx = np.column_stack([edge_x + np.linspace(-0.15, 0.15, 16), np.full(16, 7.05), np.full(16, 1.5)])
    settings = all_paths(max_depth=1)
    links = trace_links(PartialMap(state, 0.1), tx, rx, trace_settings=settings, scene_settings=NO_FLOOR)
    total = np.zeros(len(rx), complex)
    np.add.at(total, links.path_rx, links.a * np.exp(-2j * np.pi * 28e9 * links.delay_s))
    direct = WAVELENGTH_M / (4 * np.pi * np.linalg.norm(rx - tx, axis=1))
    before, after = 4.05 - tx[1], 7.05 - 4.05
    clearance = (rx[:, 0] - edge_x) * before / (before + after)
    v = -clearance * np.sqrt(2 * (before + after) / (WAVELENGTH_M * before * after))
    s, c = fresnel(v)
    knife_edge = np.abs((0.5 - c) - 1j * (0.5 - s)) / np.sqrt(2)
    np.testing.assert_allclose(np.abs(total) / direct, knife_edge, atol=0.05)


class TestSimulation:
    def test_a_second_call_loads_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Whatever was traced before, links are those of a trace of their own, with either polarisation."""
        partial, rng, opened = _half_seen_room(), np.random.default_rng(0), []
        rx = [np.column_stack([rng.uniform(0.5, 2.5, (n, 2)), np.full(n, 1.4)]) for n in (7, 0, 3)]
        tx = np.array([[1.0, 1.5, 1.5], [2.0, 3.0, 1.2], [2.1, 3.0, 1.2]])
        alone = [trace_links(partial, *each) for each in zip(tx, rx, strict=True)]
        load = engine.open_scene
        monkeypatch.setattr(engine, "open_scene", lambda *each: opened.append(each) or load(*each))
        simulation = Simulation(partial)
        for polarisations in (2, 1):
            for expected, *ends in zip(alone, tx, rx, strict=True):
                links = simulation.links(*ends, polarisations=polarisations)
                assert links.transfer.shape[1:] == (polarisations, polarisations)
                for name in ("tx", "rx", "link_state", "gain_db", "path_rx", "delay_s", "a", "vertices_m"):
                    np.testing.assert_array_equal(getattr(links, name), getattr(expected, name))
                assert links.trace_settings == expected.trace_settings
        assert len(opened) == 1

    def test_it_stands_for_a_map(self) -> None:
        settings = TraceSettings(max_depth=1)
        simulation = Simulation(_half_seen_room(), settings)
        ends = (1.0, 1.5, 1.5), [(2.0, 3.0, 1.4)]
        here = gain_gradients(simulation, *ends).gain_db
        assert here == gain_gradients(_half_seen_room(), *ends, trace_settings=settings).gain_db
        with pytest.raises(SettingsError, match=r"^trace_settings = .*: the Simulation that was given has its own"):
            trace_links(simulation, *ends, trace_settings=simulation.trace_settings)
        with pytest.raises(SettingsError, match="polarisations = 3 is not allowed: give 1 or 2"):
            simulation.links(*ends, polarisations=3)


class TestPathsOnDisk:
    def test_they_are_those_in_memory(self, tmp_path: Path) -> None:
        tx, rx = [(1.05, 2.95, 1.5), (4.05, 1.95, 1.5)], _grid(_room(), 0.5)
        here, stored = trace_links(_room(), tx, rx), trace_links(_room(), tx, rx, folder=tmp_path / "paths")
        assert isinstance(stored.vertices_m, np.memmap)
        for field in dataclasses.fields(TracedLinks):
            if not field.name.endswith("settings"):
                np.testing.assert_array_equal(getattr(stored, field.name), getattr(here, field.name))
        nothing = trace_links(_room(), tx, np.zeros((0, 3)), folder=tmp_path / "nothing")
        assert nothing.vertices_m.shape == (0, 6, 3)

    def test_nothing_half_written_stays(self, tmp_path: Path) -> None:
        def stop(fraction: float, message: str) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            trace_links(_room(), (1.0, 1.0, 1.5), [[2.0, 1.0, 1.5]], folder=tmp_path / "paths", progress=stop)
        assert not list(tmp_path.iterdir())


class TestMemory:
    def test_paths_that_do_not_fit_are_refused_first(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        caplog.set_level("INFO", "sionna_partial")
        monkeypatch.setattr(simulation, "LARGE_JOB", 1_000)
        rx = _grid(_room(), 0.04)[::6]
        assert len(rx) > 1_600
        with pytest.raises(MemoryLimitError, match=r"memory_gb = 0.001 is too little for about .* give a folder"):
            trace_links(_room(), (1.05, 2.95, 1.5), rx, trace_settings=SPECULAR, memory_gb=0.001)
        (message,) = [message for message in caplog.messages if "paths" in message]
        estimate = int(message.split()[1])
        links = trace_links(_room(), (1.05, 2.95, 1.5), rx, trace_settings=SPECULAR)
        assert len(links.a) == pytest.approx(estimate, rel=0.2)


class TestInvalidLinks:
    RX = ((2.0, 1.0, 1.5), (3.05, 0.5, 1.5), (1.0, 1.0, 1.5), (9.0, 1.0, 1.5), (np.nan, 1.0, 1.5), (4.0, 3.0, 1.5))
    """Good; in a wall; at the first transmitter; outside; not finite; good."""

    @pytest.mark.parametrize("folder", [False, True])
    def test_the_others_are_traced(self, folder: bool, tmp_path: Path) -> None:
        tx, good = [(1.0, 1.0, 1.5), (5.0, 1.0, 1.5)], [0, 2, 5]
        where = {"folder": tmp_path / "paths"} if folder else {}
        links = trace_links(_room(), tx, self.RX, invalid="nan", **where)
        expected = trace_links(_room(), tx[1], np.array(self.RX)[good])
        assert links.valid.astype(int).tolist() == [[1, 0, 0, 0, 0, 1], [1, 0, 1, 0, 0, 1]]
        assert np.array_equal(links.valid, np.isfinite(links.gain_db))
        assert (links.link_state[~links.valid] == 255).all()
        assert np.array_equal(links.gain_db[1, good], expected.gain_db)
        assert np.array_equal(np.array(good)[expected.path_rx], links.path_rx[links.path_tx == 1])
        assert not np.isin(links.path_rx, [1, 3, 4]).any()

    def test_none_is_valid(self) -> None:
        links = trace_links(_room(), (1.0, 1.0, 1.5), self.RX[1:5], invalid="nan")
        assert np.isnan(links.gain_db).all()
        assert len(links.a) == 0
        with pytest.raises(PredictorError, match=r"links has 4 that were not traced: trace rx\[links.valid\]"):
            link_features(_room(), links)


class TestTables:
    TX = ((1.0, 1.0, 1.5), (5.0, 1.0, 1.5))
    RX = ((2.0, 1.0, 1.5), (4.0, 3.0, 1.5), (9.0, 1.0, 1.5))

    @pytest.fixture
    def links(self) -> TracedLinks:
        return trace_links(_room(), self.TX, self.RX, invalid="nan")

    def test_to_xarray(self, links: TracedLinks) -> None:
        table = links.to_xarray()
        assert dict(table.gain_db.sizes) == {"tx": 2, "rx": 3}
        assert table.departure_rad.sel(angle="azimuth").shape == table.a.shape == (len(links.a),)
        assert table.transfer.sel(at_rx="theta", at_tx="theta").values.tolist() == links.a.tolist()
        assert table.attrs["frequency_hz"] == 28e9
        assert json.loads(table.attrs["trace_settings"])["max_depth"] == 6
        assert trace_links(_room(), self.TX[0], self.RX[:2]).to_xarray().gain_db.dims == ("rx",)

    def test_rows(self, links: TracedLinks) -> None:
        table = links.to_dataframe()
        assert table["tx"].tolist() == [0, 0, 0, 1, 1, 1]
        assert table["rx_y_m"].tolist() == [1.0, 3.0, 1.0] * 2
        assert table["paths"].tolist() == np.bincount(3 * links.path_tx + links.path_rx, minlength=6).tolist()
        assert np.isnan(table["delay_s"][[2, 5]]).all()
        linked = table[table["link_state"] == LinkState.LOS]
        assert linked["delay_s"].tolist() == pytest.approx(linked["distance_m"] / SPEED_OF_LIGHT_M_S, rel=1e-5)
        table = links.to_dataframe("paths")
        power = (10.0 ** (table["gain_db"] / 10.0)).groupby([table["tx"], table["rx"]]).sum()
        assert 10.0 * np.log10(power.loc[0, 0]) == pytest.approx(links.gain_db[0, 0])
        assert set("".join(table["interactions"])) == set("18-")
        with pytest.raises(SettingsError, match="of = 'rays' is not allowed: choose one of links, paths"):
            links.to_dataframe("rays")  # type: ignore[arg-type]
