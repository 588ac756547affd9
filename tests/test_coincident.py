"""Transmitters, receivers, images and ends of walls on one lattice: traces are those of positions a little aside."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.tracing.positions import clear_of_walls

REPORTS = Path(__file__).parent / "reports"
WIDTH_M, DEPTH_M, HEIGHT_M, CELL_M = 8.0, 6.0, 2.7, 0.05
WALLS = {
    "sheet": [((4, 0), (4, 3))],
    "cross": [((3, 4), (6, 4)), ((4, 2), (4, 5))],
}
SETTINGS = {
    "opaque": {"frequency_hz": 28e9, "max_depth": 3},
    "through walls": {"frequency_hz": 5e9, "max_depth": 2},
}
TX_M = ((2.0, 2.0, 1.35), (1.0, 3.0, 1.0))
ASIDE_M = np.array([4e-6, -3e-6, 1e-6])

Floats = NDArray[np.float64]


def as_plan(walls: list[tuple[tuple[int, int], tuple[int, int]]]) -> sp.PartialMap:
    """Draw a room whose walls run through lattice points, seen from the middle of their cells."""
    count_x, count_y = round(WIDTH_M / CELL_M) + 1, round(DEPTH_M / CELL_M) + 1
    state = np.zeros((count_y, count_x), np.uint8)
    state[[0, -1]] = state[:, [0, -1]] = sp.CellState.WALL
    for (x0, y0), (x1, y1) in walls:
        rows, columns = (slice(round(a / CELL_M), round(b / CELL_M) + 1) for a, b in ((y0, y1), (x0, x1)))
        state[rows, columns] = sp.CellState.WALL
    return sp.PartialMap(state, CELL_M, (-CELL_M / 2, -CELL_M / 2), wall_height_m=HEIGHT_M)


def lattice(partial: sp.PartialMap, tx_m: tuple[float, float, float]) -> Floats:
    """Return the lattice points (N, 3) [m] where receivers can stand."""
    x, y = np.meshgrid(np.arange(1.0, WIDTH_M), np.arange(1.0, DEPTH_M))
    rx_m = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.35)])
    return rx_m[clear_of_walls(partial, rx_m) & (np.linalg.norm(rx_m - tx_m, axis=1) > 0.1)]


def assert_as_aside(partial: sp.PartialMap, settings: sp.TraceSettings) -> None:
    """Compare gains on the lattice with gains beside it, where these agree: no end of a wall is grazed."""
    simulation, compared = sp.Simulation(partial, settings), 0
    for tx_m in TX_M:
        rx_m = lattice(partial, tx_m)
        gain_db = simulation.links(tx_m, rx_m).gain_db
        one_db, other_db = (
            simulation.links(tx_m + sign * ASIDE_M, rx_m - sign * ASIDE_M[[1, 0, 2]]).gain_db for sign in (1.0, -1.0)
        )
        assert np.isfinite(gain_db).all()
        alike = np.abs(one_db - other_db) < 0.03
        np.testing.assert_allclose(gain_db[alike], one_db[alike], rtol=0, atol=0.1)
        compared += int(alike.sum())
    assert compared > 30


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("walls", WALLS)
def test_plans(walls: str, settings: str) -> None:
    assert_as_aside(as_plan(WALLS[walls]), sp.TraceSettings(**SETTINGS[settings]))


def test_a_receiver_at_an_image_of_the_transmitter_in_a_mesh() -> None:
    """The image in the sheet is at the first receiver; right values are of stock Sionna RT."""
    partial = sp.load_map(REPORTS / "mesh_image" / "room.ply")
    settings = sp.TraceSettings(frequency_hz=5e9, max_depth=3)
    links = sp.trace_links(partial, (1.0, 1.0, 1.5), [(7.0, 1.0, 1.5), (2.0, 4.0, 1.5)], trace_settings=settings)
    np.testing.assert_allclose(links.gain_db, [-63.5, -55.4], rtol=0, atol=0.1)
