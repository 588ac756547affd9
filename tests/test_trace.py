"""The trace against closed forms, what it may not depend on, and what it refuses."""

import dataclasses
import functools
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import fresnel

from sionna_partial.constants import SPEED_OF_LIGHT_M_S, CellState, LinkState
from sionna_partial.errors import MemoryLimitError, PositionError, PredictorError, SettingsError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import link_features
from sionna_partial.settings import Material, SceneSettings, TraceSettings
from sionna_partial.tracing import engine, simulation
from sionna_partial.tracing.engine import load_sionna
from sionna_partial.tracing.gradients import gain_gradients
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.simulation import InvalidLinks, Simulation, trace_links

WAVELENGTH_M = SPEED_OF_LIGHT_M_S / 28e9
all_paths = functools.partial(TraceSettings, power_tolerance_db=0.0)
NO_FLOOR = SceneSettings(floor_extent="none")
SPECULAR = all_paths(diffraction=False)


def _map(shape: tuple[int, int], resolution_m: float = 0.1) -> NDArray[np.uint8]:
    return np.full(shape, CellState.FREE, dtype=np.uint8)


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


def _free_space_gain_db(distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
    return 20 * np.log10(WAVELENGTH_M / (4 * np.pi * distance_m))


def _slab_reflection(cos_incidence: float, material: Material, polarisation: str) -> complex:
    """Reflection coefficient of a single-layer slab (ITU-R P.2040-3, equations 31, 32 and 37)."""
    eta = material.relative_permittivity - 1j * material.conductivity_s_m / (2 * np.pi * 28e9 * 8.8541878128e-12)
    root = np.sqrt(eta - (1 - cos_incidence**2))
    if polarisation == "te":
        single = (cos_incidence - root) / (cos_incidence + root)
    else:
        single = (eta * cos_incidence - root) / (eta * cos_incidence + root)
    phase = np.exp(-2j * 2 * np.pi * material.thickness_m / WAVELENGTH_M * root)
    return complex(single * (1 - phase) / (1 - single**2 * phase))


def _paths_of(links: TracedLinks, rx: int) -> NDArray[np.intp]:
    return np.flatnonzero(links.path_rx == rx)


def test_free_space_gain_delay_and_angles() -> None:
    partial = PartialMap(_map((100, 100)), 0.1)
    tx, rx = np.array([1.0, 2.0, 1.5]), np.array([[4.0, 6.0, 1.5], [1.0, 2.0, 2.5], [9.0, 2.0, 1.5]])
    links = trace_links(partial, tx, rx, scene_settings=NO_FLOOR)
    distance = np.linalg.norm(rx - tx, axis=1)
    assert (links.link_state == LinkState.LOS).all()
    assert links.path_rx.tolist() == [0, 1, 2]
    np.testing.assert_allclose(links.gain_db, _free_space_gain_db(distance), atol=1e-3)
    np.testing.assert_allclose(links.delay_s, distance / SPEED_OF_LIGHT_M_S, rtol=1e-5)
    np.testing.assert_allclose(links.departure_rad[0], [np.pi / 2, np.arctan2(4, 3)], atol=1e-5)
    np.testing.assert_allclose(links.arrival_rad[0], [np.pi / 2, np.arctan2(-4, -3)], atol=1e-5)


def test_one_mirror_image_with_the_slab_reflection_coefficient() -> None:
    """Vertical antennas see the TE coefficient of the slab, horizontal ones the TM coefficient."""
    state = _map((60, 100))
    state[50, :] = CellState.WALL
    tx, rx = np.array([1.0, 2.0, 1.5]), np.array([[5.0, 3.0, 1.5]])
    links = trace_links(PartialMap(state, 0.1), tx, rx, trace_settings=SPECULAR, scene_settings=NO_FLOOR)
    wall_y = 5.05
    length = np.hypot(4.0, (wall_y - 2.0) + (wall_y - 3.0))
    cos_incidence = ((wall_y - 2.0) + (wall_y - 3.0)) / length
    direct, mirrored = _paths_of(links, 0)
    te, tm = (_slab_reflection(cos_incidence, Material(), each) for each in ("te", "tm"))
    found = np.abs(links.transfer[mirrored]) * 4 * np.pi * length / WAVELENGTH_M
    np.testing.assert_allclose(found, np.diag(np.abs([te, tm])), rtol=1e-3, atol=1e-6)
    assert links.delay_s[mirrored] * SPEED_OF_LIGHT_M_S == pytest.approx(length, rel=1e-5)
    x = 1.0 + 4.0 * (wall_y - 2.0) / ((wall_y - 2.0) + (wall_y - 3.0))
    np.testing.assert_allclose(links.vertices_m[mirrored, 0], [x, wall_y, 1.5], atol=1e-4)
    assert np.isnan(links.vertices_m[mirrored, 1:]).all()
    assert links.interactions[mirrored].tolist() == [1, 0, 0, 0, 0, 0]
    total = abs(links.a[direct]) ** 2 + abs(links.a[mirrored]) ** 2
    assert links.gain_db[0] == pytest.approx(10 * np.log10(total), abs=1e-6)


def test_corridor_of_two_walls_has_every_image() -> None:
    state = _map((41, 400))
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


def test_a_wall_without_end_gives_outage() -> None:
    state = _map((40, 40))
    state[:, 20] = CellState.WALL
    links = trace_links(PartialMap(state, 0.1), (1.0, 1.0, 1.5), [[3.0, 1.0, 1.5]])
    assert links.link_state.tolist() == [LinkState.OUTAGE]
    assert links.gain_db.tolist() == [-150.0]
    assert len(links.a) == 0


def test_unknown_space_is_free() -> None:
    state = np.full((50, 50), CellState.UNKNOWN, dtype=np.uint8)
    links = trace_links(PartialMap(state, 0.1), (0.5, 0.5, 1.5), (4.5, 3.5, 1.0))
    assert links.rx.shape == (1, 3)
    np.testing.assert_allclose(links.gain_db, _free_space_gain_db(np.linalg.norm([4.0, 3.0, 0.5])), atol=1e-3)


def _grid(partial: PartialMap, spacing_m: float) -> NDArray[np.float64]:
    x0, y0, x1, y1 = partial.bounds_m
    x, y = np.meshgrid(np.arange(x0 + spacing_m / 2, x1, spacing_m), np.arange(y0 + spacing_m / 2, y1, spacing_m))
    rx = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)])
    return rx[partial.state_at(rx) != CellState.WALL]


@pytest.mark.parametrize("settings", [TraceSettings(), all_paths(open_ends=True)])
@pytest.mark.parametrize("partial", [_room(), _half_seen_room()], ids=["complete", "partial"])
def test_the_answer_depends_on_no_other_receiver_and_no_run(partial: PartialMap, settings: TraceSettings) -> None:
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
        ((0.05, 1.0, 1.5), [[1.0, 1.0, 1.0]], r"tx = .* is inside a wall"),
        ((9.0, 1.0, 1.5), [[1.0, 1.0, 1.0]], r"tx = .* is outside the map"),
        ([(1.0, 1.0, 1.5), (0.05, 1.0, 1.5)], [[2.0, 1.0, 1.5]], r"^tx2 = \(0.05, 1.0, 1.5\) is inside a wall"),
        ((1.0, 1.0, 1.5), [[1.0, 1.0, 3.0]], r"rx\[0\] = .* is not between floor and ceiling"),
        ([[(1.0, 1.0, 1.5)]], [[1.0, 1.0, 1.0]], r"tx has shape \(1, 1, 3\): give x, y, z in metres, \(3,\) or \(N"),
        ((1.0, 1.0, 1.5), [[1.0, 1.0, 1.0], [1.0]], r"rx = .* is not numeric: give x, y, z in metres\."),
        (np.zeros((0, 3)), [[2.0, 1.0, 1.5]], r"tx has shape .0, 3.: give at least 1 position"),
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


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("trace_settings", 5, "trace_settings = 5 is not allowed: give TraceSettings"),
        ("scene_settings", 5, "scene_settings = 5 is not allowed: give SceneSettings"),
        ("memory_gb", -1, "memory_gb = -1 is not allowed"),
        ("memory_gb", math.nan, "memory_gb = nan is not allowed"),
        ("invalid", "skip", "invalid = 'skip' is not allowed: choose one of raise, nan"),
    ],
)
def test_arguments_are_checked(argument: str, value: Any, message: str) -> None:
    with pytest.raises(SettingsError, match=f"^{message}"):
        trace_links(_room(), (1.0, 1.0, 1.5), [[2.0, 1.0, 1.5]], **{argument: value})


def test_material_of_the_map_comes_before_that_of_the_settings() -> None:
    concrete = Material(itu="concrete")
    tx, receivers = (1.0, 1.0, 1.5), [[2.0, 1.0, 1.5]]
    asked = trace_links(_room(), tx, receivers, scene_settings=SceneSettings(concrete))
    own = trace_links(replace(_room(), material=concrete), tx, receivers)
    assert own.scene_settings == asked.scene_settings
    assert own.a.tobytes() == asked.a.tobytes()
    assert own.a.tobytes() != trace_links(_room(), tx, receivers).a.tobytes()
    with pytest.raises(SettingsError, match="'wet_ground' is defined for 1-10 GHz"):
        trace_links(replace(_room(), material=Material(itu="wet_ground")), tx, receivers)


def test_links_shorter_than_friis_allows_are_refused() -> None:
    settings = all_paths(frequency_hz=10e6)
    with pytest.raises(PositionError, match=r"is 1.* m from the transmitter.*: leave out receivers nearer than 2.39 m"):
        trace_links(_room(), (1.0, 1.0, 1.5), [[2.0, 1.0, 1.5]], trace_settings=settings)


def _screen() -> tuple[PartialMap, float]:
    """A wall that ends in the middle of the map, and x of its end [m]."""
    state = _map((80, 120))
    state[40, :60] = CellState.WALL
    return PartialMap(state, 0.1), 5.95


def _field(links: TracedLinks, count: int) -> NDArray[np.complex128]:
    """Complex sum (count,) of all paths of each receiver."""
    phased = links.a * np.exp(-2j * np.pi * 28e9 * links.delay_s)
    return np.bincount(links.path_rx, phased.real, count) + 1j * np.bincount(links.path_rx, phased.imag, count)


def test_the_field_behind_an_open_wall_end_follows_the_fresnel_integral() -> None:
    partial, edge_x = _screen()
    tx = np.array([edge_x, 0.55, 1.5])
    rx = np.column_stack([edge_x + np.linspace(-0.15, 0.15, 16), np.full(16, 7.05), np.full(16, 1.5)])
    settings = all_paths(max_depth=1)
    total = _field(trace_links(partial, tx, rx, trace_settings=settings, scene_settings=NO_FLOOR), len(rx))
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

    def test_rays_are_shot_in_the_same_scene(self) -> None:
        settings = all_paths(max_depth=1, samples_per_tx=2000, diffuse_reflection=True)
        ends = (1.0, 1.5, 1.5), [(2.0, 3.0, 1.4), (2.3, 1.0, 1.4)]
        simulation = Simulation(_half_seen_room(), settings)
        for links in (simulation.links(*ends), trace_links(simulation, *ends)):
            np.testing.assert_array_equal(links.a, trace_links(_half_seen_room(), *ends, trace_settings=settings).a)
        with pytest.raises(SettingsError, match="diffuse_reflection = True is not allowed: paths that are found by"):
            simulation.paths(*ends)

    def test_it_stands_for_a_map(self) -> None:
        simulation = Simulation(_half_seen_room(), all_paths(max_depth=1))
        ends = (1.0, 1.5, 1.5), [(2.0, 3.0, 1.4)]
        for call in (trace_links, gain_gradients):
            here, there = call(simulation, *ends), call(_half_seen_room(), *ends, trace_settings=all_paths(max_depth=1))
            np.testing.assert_array_equal(here.gain_db, there.gain_db)
        for name in ("trace_settings", "scene_settings"):
            with pytest.raises(SettingsError, match=f"^{name} = .*: the Simulation that was given has its own"):
                trace_links(simulation, *ends, **{name: getattr(simulation, name)})
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
        phi = link_features(_room(), stored)
        np.testing.assert_array_equal(phi.gain_db, here.gain_db)

    def test_a_link_without_paths_leaves_empty_files(self, tmp_path: Path) -> None:
        stored = trace_links(_room(), (1.0, 1.0, 1.5), np.zeros((0, 3)), folder=tmp_path)
        assert stored.vertices_m.shape == (0, 6, 3)

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

    @pytest.mark.parametrize(("invalid", "tx"), [("raise", (1.0, 1.0, 1.5)), ("nan", (3.05, 0.5, 1.5))])
    def test_positions_are_refused(self, invalid: InvalidLinks, tx: tuple[float, ...]) -> None:
        with pytest.raises(PositionError):
            trace_links(_room(), tx, self.RX, invalid=invalid)


class TestTables:
    TX = ((1.0, 1.0, 1.5), (5.0, 1.0, 1.5))
    RX = ((2.0, 1.0, 1.5), (4.0, 3.0, 1.5), (9.0, 1.0, 1.5))

    @pytest.fixture
    def links(self) -> TracedLinks:
        return trace_links(_room(), self.TX, self.RX, invalid="nan")

    def test_to_xarray(self, links: TracedLinks, tmp_path: Path) -> None:
        table = links.to_xarray()
        assert dict(table.gain_db.sizes) == {"tx": 2, "rx": 3}
        assert table.rx_m.sel(axis="y").values.tolist() == [1.0, 3.0, 1.0]
        assert table.departure_rad.sel(angle="azimuth").shape == table.a.shape == (len(links.a),)
        assert table.transfer.sel(at_rx="theta", at_tx="theta").values.tolist() == links.a.tolist()
        units = {"delay_s": "s", "vertices_m": "m", "gain_db": "dB", "arrival_rad": "rad"}
        assert {name: table[name].units for name in units} == units
        assert table.attrs["frequency_hz"] == 28e9
        assert json.loads(table.attrs["trace_settings"])["max_depth"] == 6
        assert trace_links(_room(), self.TX[0], self.RX[:2]).to_xarray().gain_db.dims == ("rx",)

    def test_rows_of_links(self, links: TracedLinks) -> None:
        table = links.to_dataframe()
        assert table["tx"].tolist() == [0, 0, 0, 1, 1, 1]
        assert table["rx_y_m"].tolist() == [1.0, 3.0, 1.0] * 2
        assert np.array_equal(table["gain_db"], links.gain_db.ravel(), equal_nan=True)
        assert table["paths"].tolist() == np.bincount(3 * links.path_tx + links.path_rx, minlength=6).tolist()
        assert np.isnan(table["delay_s"][[2, 5]]).all()
        linked = table[table["link_state"] == LinkState.LOS]
        assert linked["delay_s"].tolist() == pytest.approx(linked["distance_m"] / SPEED_OF_LIGHT_M_S, rel=1e-5)

    def test_rows_of_paths(self, links: TracedLinks) -> None:
        table = links.to_dataframe("paths")
        power = (10.0 ** (table["gain_db"] / 10.0)).groupby([table["tx"], table["rx"]]).sum()
        assert 10.0 * np.log10(power.loc[0, 0]) == pytest.approx(links.gain_db[0, 0])
        assert table["interactions"][0] == ""
        assert set("".join(table["interactions"])) <= set("18-")
        with pytest.raises(SettingsError, match="of = 'rays' is not allowed: choose one of links, paths"):
            links.to_dataframe("rays")  # type: ignore[arg-type]
