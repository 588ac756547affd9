"""Paths by shooting rays: against closed forms, and independent of other receivers and runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from test_trace import NO_FLOOR, WAVELENGTH_M, _room

from sionna_partial.constants import SPEED_OF_LIGHT_M_S, CellState
from sionna_partial.coverage.job import predict_map
from sionna_partial.errors import BackendError, SettingsError
from sionna_partial.llvm import load_sionna
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.export import export_scene
from sionna_partial.scene.scene import build_scene, write_scene
from sionna_partial.settings import ITU_BANDS_GHZ, SceneSettings, TraceSettings
from sionna_partial.tracing.engine import open_scene
from sionna_partial.tracing.interactions import (
    DIFFRACTION,
    DIFFUSE,
    REFLECTION,
    REFRACTION,
    only_by_rays,
    with_defaults,
)
from sionna_partial.tracing.paths import SolvedPaths, join_paths
from sionna_partial.tracing.stock import listed_before, stock_paths

TX = np.array([1.03, 2.93, 1.4])
RX = np.array([[2.21, 1.12, 1.2], [5.02, 2.03, 1.5], [4.02, 0.93, 1.5]])
"""In the room: in sight, seen through the door, and beside it."""


def _write(partial: PartialMap, folder: Path, settings: SceneSettings | None = None) -> Path:
    geometry = build_scene(partial, settings)
    return write_scene(geometry, folder, offset_m=geometry.origin_m)


def _solve(xml: Path, settings: TraceSettings, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> SolvedPaths:
    return join_paths(list(stock_paths(open_scene(xml, settings.frequency_hz), settings, tx, rx)), settings.max_depth)


@pytest.fixture(scope="module")
def room_xml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _write(_room(), tmp_path_factory.mktemp("room"))


class TestStockPaths:
    def test_free_space(self, tmp_path: Path) -> None:
        xml = _write(PartialMap(np.full((40, 40), CellState.FREE, np.uint8), 0.1), tmp_path, NO_FLOOR)
        rx = np.array([[3.0, 3.5, 1.4], [1.0, 2.0, 2.9]])
        paths = _solve(xml, TraceSettings(max_depth=0), np.array([1.0, 2.0, 1.4]), rx)
        assert paths.path_rx.tolist() == [0, 1]
        assert not paths.interactions.any()
        np.testing.assert_allclose(paths.delay_s, np.array([2.5, 1.5]) / SPEED_OF_LIGHT_M_S, rtol=1e-6)
        np.testing.assert_allclose(np.abs(paths.a), WAVELENGTH_M / (4 * np.pi * np.array([2.5, 1.5])), rtol=1e-4)
        np.testing.assert_allclose(paths.departure_rad[0], [np.pi / 2, np.arctan2(1.5, 2.0)], atol=1e-6)
        np.testing.assert_allclose(paths.arrival_rad[1, 0], np.pi, atol=1e-6)

    def test_diffuse_reflections_obey_the_length_of_their_way(self, tmp_path: Path) -> None:
        state = np.full((60, 60), CellState.FREE, np.uint8)
        state[50, :] = CellState.WALL
        xml = _write(PartialMap(state, 0.1), tmp_path, NO_FLOOR)
        text = xml.read_text()
        xml.write_text(text.replace("</bsdf>", '<float name="scattering_coefficient" value="0.5" /></bsdf>'))
        settings = TraceSettings(max_depth=1, diffuse_reflection=True, samples_per_tx=2_000)
        tx, rx = np.array([1.0, 2.0, 1.5]), np.array([[4.0, 3.0, 1.5]])
        paths = _solve(xml, settings, tx, rx)
        diffuse = paths.interactions[:, 0] == 2
        assert diffuse.sum() > 20
        points = paths.vertices_m[diffuse, 0]
        np.testing.assert_allclose(points[:, 1], 5.05, atol=1e-4)
        length = np.linalg.norm(points - tx, axis=1) + np.linalg.norm(points - rx, axis=1)
        np.testing.assert_allclose(paths.delay_s[diffuse] * SPEED_OF_LIGHT_M_S, length, rtol=1e-5)

    def test_the_answer_depends_on_no_other_receiver_and_no_run(self, room_xml: Path) -> None:
        options = {"refraction": True, "diffraction": True, "diffuse_reflection": True}
        settings = TraceSettings(max_depth=3, samples_per_tx=5_000, **options)
        together, again = (_solve(room_xml, settings, TX, RX) for _ in range(2))
        alone = _solve(room_xml, settings, TX, RX[2:])
        last = together.path_rx == 2
        assert last.sum() == len(alone.a) > 10
        for name in ("a", "delay_s", "departure_rad", "arrival_rad", "interactions", "vertices_m"):
            assert getattr(together, name).tobytes() == getattr(again, name).tobytes()
            assert getattr(together, name)[last].tobytes() == getattr(alone, name).tobytes()

    def test_a_receiver_that_nothing_reaches(self, tmp_path: Path) -> None:
        state = np.full((40, 40), CellState.FREE, np.uint8)
        state[:, 20] = CellState.WALL
        xml = _write(PartialMap(state, 0.1), tmp_path)
        settings = TraceSettings(max_depth=0, samples_per_tx=1000)
        paths = _solve(xml, settings, np.array([1.0, 1.0, 1.5]), np.array([[3.0, 1.0, 1.5]]))
        assert paths.vertices_m.shape == (0, 1, 3)

    def test_failure_of_sionna_is_a_backend_error(self, room_xml: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*_: object, **__: object) -> None:
            raise RuntimeError("out of memory")

        monkeypatch.setattr(load_sionna(), "PathSolver", fail)
        message = r"^Sionna RT 2\.\S+ cannot solve the paths \(RuntimeError\('out of memory'\)\): lower samples_per_tx"
        with pytest.raises(BackendError, match=message):
            list(stock_paths(open_scene(room_xml, 28e9), TraceSettings(), TX, RX))


class TestRadioMap:
    def test_coverage_and_solver_on_one_grid(self, tmp_path: Path) -> None:
        settings = TraceSettings(max_depth=1, diffraction=False, samples_per_tx=200_000)
        tx = {"door": (1.03, 0.52, 2.3), "wall": (4.1, 2.2, 2.1)}
        coverage = predict_map(_room(), tx, spacing_m=0.5, predictor="paper", trace_settings=settings, progress=False)
        scene = load_sionna().load_scene(str(export_scene(_room(), tmp_path / "scene") / "scene.xml"))
        floor = coverage.radio.radio_map(scene)
        x, y = np.meshgrid(coverage.x, coverage.y)
        np.testing.assert_allclose(floor.cell_centers.numpy()[..., :2], np.stack([x, y], axis=-1), atol=1e-5)
        mean_db = coverage.gain_mean_db.to_numpy()
        expected = np.where(mean_db > -150.0, 10.0 ** (mean_db / 10.0), 0.0)
        np.testing.assert_allclose(floor.path_gain.numpy(), expected, rtol=1e-5)
        assert [*scene.transmitters] == ["door", "wall"]
        stock = coverage.radio.stock_gain(scene)
        assert stock.dims == ("tx", "y", "x")
        in_sight = (coverage.partial_link_state == 1) & (coverage.distance_m > 1.0)
        assert in_sight.sum() > 20
        assert abs(stock - coverage.partial_gain_db).where(in_sight).quantile(0.9) < 1.0

    def test_what_cannot_be_compared_is_named(self, room_xml: Path) -> None:
        coverage = predict_map(_room(), (1.03, 0.52, 1.5), spacing_m=0.5, predictor="paper", progress=False)
        with pytest.raises(SettingsError, match=r"scene = 'scene.xml' is not allowed: give a scene of sionna.rt.load"):
            coverage.radio.radio_map("scene.xml")
        with pytest.raises(SettingsError, match=r"rx_height_m = 1.5 is the height of tx, and RadioMapSolver misses"):
            coverage.radio.stock_gain(open_scene(room_xml, 28e9))


def test_one_path_of_each_kind_is_listed() -> None:
    """Diffuse reflections are samples."""
    interactions = np.array([[1, 0], [1, 0], [1, 0], [4, 0], [1, 1], [1, 1], [0, 0], [0, 0]], np.uint8)
    vertices = np.full((8, 2, 3), np.nan)
    vertices[:4, 0] = [[1, 2, 3], [1.004, 2, 2.996], [1.05, 2, 3], [1, 2, 3]]
    vertices[4:6] = [[[1, 2, 3], [4, 5, 6]], [[1, 2, 3], [4, 5.08, 6]]]
    assert listed_before(interactions, vertices).tolist() == [False, True, False, False, False, False, False, True]
    assert not listed_before(np.array([[2, 0], [2, 0], [1, 2], [1, 2]], np.uint8), np.ones((4, 2, 3))).any()
    assert listed_before(np.zeros((0, 2), np.uint8), np.zeros((0, 2, 3))).shape == (0,)


def test_bands_and_numbers_are_those_of_sionna() -> None:
    load_sionna()
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    assert {name: tuple(bands) for name, bands in ITU_MATERIALS_PROPERTIES.items()} == ITU_BANDS_GHZ
    theirs = load_sionna().constants.InteractionType
    numbers = theirs.SPECULAR, theirs.DIFFUSE, theirs.REFRACTION, theirs.DIFFRACTION
    assert numbers == (REFLECTION, DIFFUSE, REFRACTION, DIFFRACTION)


def test_by_default_candidates_alone_find_the_paths() -> None:
    for settings in (TraceSettings(5e9), TraceSettings(28e9)):
        for environment in ("plan", "mesh"):
            assert only_by_rays(with_defaults(settings, environment), environment) == []
    asked = replace(settings, diffuse_reflection=True, refraction=True, diffraction=True)
    assert [kind.setting for kind in only_by_rays(asked, "plan")] == ["diffuse_reflection"]
    assert [kind.setting for kind in only_by_rays(asked, "mesh")] == ["diffuse_reflection", "diffraction"]
