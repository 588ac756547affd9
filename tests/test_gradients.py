"""Gradients of gains agree with formulas in double precision (`test_path_set` compares with differences)."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from meshes import room
from numpy.typing import NDArray
from pillar_room import RX_M, TX_M, small_room

import sionna_partial as sp
from sionna_partial.constants import SPEED_OF_LIGHT_M_S, CellState, LinkState
from sionna_partial.errors import PositionError, SettingsError
from sionna_partial.tracing.gradients import GainGradients, gain_gradients
from sionna_partial.tracing.interactions import REFRACTION

SLOPES = (
    *("tx_db_per_m", "relative_permittivity_db", "conductivity_db_per_s_m", "thickness_db_per_m"),
    "frequency_db_per_hz",
)
FIELD = sp.PartialMap(np.zeros((40, 60), dtype=np.uint8), 0.1)
OPEN = sp.SceneSettings(floor_extent="none")
FLOOR = sp.SceneSettings(ceiling=False, material=sp.Material(thickness_m=0.02))
TX = np.array([1.03, 1.92, 1.4])
RX = np.array([[3.2, 2.1, 1.1], [1.5, 3.3, 0.4], [5.1, 0.7, 2.2], [1.1, 1.8, 0.2]])
SETTINGS = sp.TraceSettings(max_depth=2, power_tolerance_db=0.0)


def all_slopes(found: GainGradients) -> NDArray[np.float64]:
    """Derivatives (7, N), those of the position first."""
    return np.vstack([found.tx_db_per_m.T, *(getattr(found, name) for name in SLOPES[1:])])


def floor_gain_db(parameters: NDArray[np.float64], rx: NDArray[np.float64]) -> float:
    """Gain [dB] over a floor at z = 0 in double precision (ITU-R P.2040-3, eq. 31b and 37; vertical waves are TM)."""
    x, y, z, permittivity, conductivity, thickness_m, frequency_hz = parameters
    wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz
    across_m = np.hypot(rx[0] - x, rx[1] - y)
    eta = permittivity - 1j * conductivity / (2 * np.pi * frequency_hz * 8.8541878128e-12)
    reflected_m = np.hypot(across_m, rx[2] + z)
    cosine = (rx[2] + z) / reflected_m
    root = np.sqrt(eta - (1 - cosine**2))
    face = (eta * cosine - root) / (eta * cosine + root)
    through = np.exp(-4j * np.pi * thickness_m / wavelength_m * root)
    slab = face * (1 - through) / (1 - face**2 * through)
    power = np.abs(slab) ** 2 / reflected_m**2 + 1 / (across_m**2 + (rx[2] - z) ** 2)
    return 10 * np.log10(power * (wavelength_m / (4 * np.pi)) ** 2)


def floor_slopes(material: sp.Material, rx: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives (7,) of `floor_gain_db`, by central differences in double precision."""
    constants = (material.relative_permittivity, material.conductivity_s_m, material.thickness_m, 28e9)
    at = np.array([*TX, *constants])
    steps = np.diag([1e-5, 1e-5, 1e-5, 1e-5, 1e-6, 1e-8, 1e4])
    return np.array([(floor_gain_db(at + d, rx) - floor_gain_db(at - d, rx)) / (2 * d.sum()) for d in steps])


@pytest.fixture(scope="module")
def found() -> GainGradients:
    return gain_gradients(small_room(), TX_M, RX_M, trace_settings=SETTINGS)


class TestAgainstFormulas:
    def test_line_of_sight(self) -> None:
        found = gain_gradients(FIELD, TX, RX, scene_settings=OPEN)
        away = TX - RX
        expected = -20 / np.log(10) * away / (away**2).sum(axis=1, keepdims=True)
        np.testing.assert_allclose(found.tx_db_per_m, expected, rtol=2e-5, atol=1e-6)
        np.testing.assert_allclose(found.frequency_db_per_hz, -20 / np.log(10) / 28e9, rtol=1e-5)
        assert not all_slopes(found)[3:6].any()
        assert (found.link_state == LinkState.LOS).all()

    @pytest.mark.parametrize(
        "material",
        [FLOOR.material, sp.Material(7.0, 0.02, 0.011), sp.Material(1.2, 2.0, 0.01)],
        ids=["drywall", "low loss", "lossy"],
    )
    def test_reflection_off_the_floor(self, material: sp.Material) -> None:
        found = gain_gradients(FIELD, TX, RX, scene_settings=dataclasses.replace(FLOOR, material=material))
        expected = np.stack([floor_slopes(material, rx) for rx in RX], axis=1)
        scale = np.abs(expected).max(axis=1, keepdims=True)
        np.testing.assert_allclose(all_slopes(found) / scale, expected / scale, rtol=0.01, atol=2e-4)


def test_paths_through_a_wall_by_differences() -> None:
    state = np.zeros((40, 60), dtype=np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = state[:30, 29] = CellState.WALL
    settings = sp.TraceSettings(5.2e9, max_depth=1, diffraction=False, power_tolerance_db=0.0)
    material, rx_m = sp.Material(3.0, 0.03, 0.05), [(4.2, 1.1, 1.1), (5.1, 0.7, 2.2)]

    def gains_db(tx_m: object = TX, frequency_hz: float = 5.2e9, **change: float) -> NDArray[np.float64]:
        trace = dataclasses.replace(settings, frequency_hz=frequency_hz)
        scene = sp.SceneSettings(material=dataclasses.replace(material, **change))
        links = sp.trace_links(sp.PartialMap(state, 0.1), tx_m, rx_m, trace_settings=trace, scene_settings=scene)
        assert (links.interactions == REFRACTION).any()
        return links.gain_db

    def slope(step: float, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
        return (high - low) / (2 * step)

    scene_settings = sp.SceneSettings(material=material)
    partial = sp.PartialMap(state, 0.1)
    found = gain_gradients(partial, TX, rx_m, trace_settings=settings, scene_settings=scene_settings)
    steps_m = 2e-3 * np.eye(3)
    expected = [slope(2e-3, gains_db(TX - step), gains_db(TX + step)) for step in steps_m]
    for name, step in {"relative_permittivity": 1e-2, "conductivity_s_m": 1e-3, "thickness_m": 1e-4}.items():
        value = getattr(material, name)
        expected.append(slope(step, gains_db(**{name: value - step}), gains_db(**{name: value + step})))
    expected.append(slope(1e7, gains_db(frequency_hz=5.19e9), gains_db(frequency_hz=5.21e9)))
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(all_slopes(found) / scale, expected / scale, atol=0.05)


class TestGainGradients:
    def test_gain_and_state_are_those_of_the_trace(self, found: GainGradients) -> None:
        links = sp.trace_links(small_room(), TX_M, RX_M, trace_settings=SETTINGS)
        np.testing.assert_array_equal(found.link_state, links.link_state)
        np.testing.assert_allclose(found.gain_db, links.gain_db, rtol=1e-13)
        np.testing.assert_array_equal([*found.tx, *found.rx.ravel()], [*links.tx, *links.rx.ravel()])
        assert (found.trace_settings, found.scene_settings) == (links.trace_settings, links.scene_settings)

    def test_outage_has_no_slopes(self) -> None:
        state = np.zeros((22, 60), dtype=np.uint8)
        state[[0, -1], :] = state[:, [0, 29, -1]] = CellState.WALL
        found = gain_gradients(sp.PartialMap(state, 0.1), (1.0, 1.1, 1.5), [(4.5, 0.8, 1.2), (1.7, 0.7, 1.1)])
        assert found.link_state.tolist() == [LinkState.OUTAGE, LinkState.LOS]
        assert found.gain_db[0] == -150
        assert not all_slopes(found)[:, 0].any()
        assert all_slopes(found)[:, 1].all()

    def test_progress_rises_to_one(self) -> None:
        calls: list[tuple[float, str]] = []
        gain_gradients(small_room(), TX_M, RX_M, trace_settings=SETTINGS, progress=lambda *call: calls.append(call))
        fractions, messages = zip(*calls, strict=True)
        assert list(fractions) == sorted(fractions)
        assert fractions[0] == 0.0
        assert fractions[-1] == pytest.approx(1.0)
        stages = ["building the scene", "differentiating reflections", "differentiating diffractions"]
        assert list(dict.fromkeys(messages)) == stages


class TestErrors:
    def test_rays_are_shot(self) -> None:
        message = "diffuse_reflection = True is not allowed: paths that are found by shooting rays have no gradients"
        with pytest.raises(SettingsError, match=message):
            gain_gradients(FIELD, TX, RX, trace_settings=sp.TraceSettings(diffuse_reflection=True))

    def test_diffraction_on_a_mesh(self, tmp_path: Path) -> None:
        room().export(tmp_path / "room.ply")
        with pytest.raises(SettingsError, match="diffraction = True is not allowed: paths that are found by shooting"):
            gain_gradients(tmp_path / "room.ply", TX, TX[None] + 0.1, trace_settings=sp.TraceSettings(diffraction=True))

    def test_several_transmitters(self) -> None:
        with pytest.raises(PositionError, match=r"tx has shape \(2, 3\): give one transmitter as \(3,\)\."):
            gain_gradients(FIELD, [TX, TX], RX)

    def test_positions_and_settings_as_for_the_trace(self) -> None:
        with pytest.raises(PositionError, match="rx"):
            gain_gradients(FIELD, TX, [(99.0, 1.0, 1.0)])
        with pytest.raises(SettingsError, match="frequency_hz"):
            gain_gradients(FIELD, TX, RX, scene_settings=sp.SceneSettings(material=sp.Material(itu="wet_ground")))
