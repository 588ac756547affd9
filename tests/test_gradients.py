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
from sionna_partial.settings import WALL_MATERIALS
from sionna_partial.tracing.gradients import GainGradients, gain_gradients
from sionna_partial.tracing.power import reflection_loss_db

FIELD = sp.PartialMap(np.zeros((40, 60), dtype=np.uint8), 0.1)
FLOOR = sp.SceneSettings(ceiling=False, material=sp.Material(thickness_m=0.02))
TX = np.array([1.03, 1.92, 1.4])
RX = np.array([[3.2, 2.1, 1.1], [1.5, 3.3, 0.4], [5.1, 0.7, 2.2], [1.1, 1.8, 0.2]])


def all_slopes(found: GainGradients) -> NDArray[np.float64]:
    """Derivatives (7, N): of the position, permittivity, conductivity, thickness and frequency."""
    of_material = found.relative_permittivity_db, found.conductivity_db_per_s_m, found.thickness_db_per_m
    return np.vstack([found.tx_db_per_m.T, *of_material, found.frequency_db_per_hz])


def floor_gain_db(parameters: NDArray[np.float64], rx: NDArray[np.float64]) -> float:
    """Gain [dB] over a floor at z = 0 in double precision; vertical waves are TM."""
    x, y, z, *slab, frequency_hz = parameters
    across_m = np.hypot(rx[0] - x, rx[1] - y)
    loss_db = reflection_loss_db(*slab, frequency_hz, np.degrees(np.arctan2(across_m, rx[2] + z)), "tm")
    power = 10 ** (-loss_db / 10) / (across_m**2 + (rx[2] + z) ** 2) + 1 / (across_m**2 + (rx[2] - z) ** 2)
    return 10 * np.log10(power * (SPEED_OF_LIGHT_M_S / frequency_hz / (4 * np.pi)) ** 2)


@pytest.mark.parametrize("material", [FLOOR.material, sp.Material(1.2, 2.0, 0.01)], ids=["drywall", "lossy"])
def test_reflection_off_the_floor(material: sp.Material) -> None:
    found = gain_gradients(FIELD, TX, RX, scene_settings=dataclasses.replace(FLOOR, material=material))
    at = np.array([*TX, material.relative_permittivity, material.conductivity_s_m, material.thickness_m, 28e9])
    expected = [
        [(floor_gain_db(at + step, rx) - floor_gain_db(at - step, rx)) / (2 * step.sum()) for rx in RX]
        for step in np.diag([1e-5, 1e-5, 1e-5, 1e-5, 1e-6, 1e-8, 1e4])
    ]
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(all_slopes(found) / scale, expected / scale, rtol=0.01, atol=2e-4)


def test_gain_state_and_outage() -> None:
    """Of the small room, and a closed one beside it with the last receiver."""
    beside = np.pad(np.full((30, 9), CellState.FREE), ((1, 1), (0, 1)), constant_values=CellState.WALL)
    rooms = dataclasses.replace(small_room(), state=np.hstack([small_room().state, beside]).astype(np.uint8))
    settings, rx = sp.TraceSettings(max_depth=2, power_tolerance_db=0.0), np.vstack([RX_M, [4.7, 1.4, 1.2]])
    found, links = (call(rooms, TX_M, rx, trace_settings=settings) for call in (gain_gradients, sp.trace_links))
    np.testing.assert_array_equal(found.link_state, links.link_state)
    np.testing.assert_allclose(found.gain_db, links.gain_db, rtol=1e-13)
    assert (found.trace_settings, found.scene_settings) == (links.trace_settings, links.scene_settings)
    assert found.link_state[[-1, 0]].tolist() == [LinkState.OUTAGE, LinkState.LOS]
    assert not all_slopes(found)[:, -1].any()
    assert all_slopes(found)[:, 0].all()


def test_frequency_by_differences_for_every_named_material() -> None:
    """One receiver behind a metre of wall of each material."""
    count = len(WALL_MATERIALS)
    state = np.zeros((30, 10 * count), dtype=np.uint8)
    state[15] = CellState.WALL
    kind = np.where(state == CellState.WALL, 1 + np.arange(10 * count) // 10, 0).astype(np.uint8)
    walls = sp.PartialMap(state, 0.1, wall_material=kind, wall_materials=tuple(WALL_MATERIALS.values()))
    tx, rx = (0.5 * count, 0.7, 1.5), [(0.5 + wall, 1.75, 1.5) for wall in range(count)]
    settings = sp.TraceSettings(5.2e9, max_depth=0)
    found = gain_gradients(walls, tx, rx, trace_settings=settings)
    assert (found.link_state != LinkState.OUTAGE).sum() >= count - 1  # metal
    ends = [dataclasses.replace(settings, frequency_hz=5.2e9 + step_hz) for step_hz in (5e6, -5e6)]
    gains_db = [sp.trace_links(walls, tx, rx, trace_settings=each).gain_db for each in ends]
    np.testing.assert_allclose(
        found.frequency_db_per_hz * 1e9, (gains_db[0] - gains_db[1]) / 1e-2, rtol=0.01, atol=0.02
    )


def test_errors(tmp_path: Path) -> None:
    room().export(tmp_path / "room.ply")
    with pytest.raises(SettingsError, match="diffraction = True is not allowed: paths that are found by shooting"):
        gain_gradients(tmp_path / "room.ply", TX, TX[None] + 0.1, trace_settings=sp.TraceSettings(diffraction=True))
    with pytest.raises(PositionError, match=r"tx has shape \(2, 3\): give one transmitter as \(3,\)\."):
        gain_gradients(FIELD, [TX, TX], RX)
