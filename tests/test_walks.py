"""Lengths of walks: doors stay open, and neither origin nor orientation of a map changes a length."""

import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.measurements.walks import Walks
from sionna_partial.tracing.positions import clear_of_walls

TX = np.array([1.03, 2.41, 1.5])


def two_rooms(door_m: float, resolution_m: float = 0.05, wall_m: float = 0.3) -> sp.PartialMap:
    """Rooms of 3 x 4 m, with a door near the middle of the wall between them, and an unseen corner."""
    cells = {name: round(value / resolution_m) for name, value in {"x": 3.0, "y": 4.0, "wall": wall_m}.items()}
    state = np.full((cells["y"] + 2 * cells["wall"], 2 * cells["x"] + 3 * cells["wall"]), CellState.WALL)
    for left in (cells["wall"], cells["x"] + 2 * cells["wall"]):
        state[cells["wall"] : -cells["wall"], left : left + cells["x"]] = CellState.FREE
    door = round(2.1 / resolution_m)
    state[door : door + round(door_m / resolution_m)] = np.where(
        np.isin(np.arange(state.shape[1]), range(cells["wall"] + cells["x"], 2 * cells["wall"] + cells["x"])),
        CellState.FREE,
        state[door],
    )
    state[-cells["wall"] - 9 : -cells["wall"], -cells["wall"] - 9 : -cells["wall"]] = CellState.UNKNOWN
    return sp.map_from_array(state, resolution_m=resolution_m)


POINTS = np.array([(1.0, 1.0, 1.5), (2.85, 2.2, 1.5), (3.31, 0.35, 1.5), (4.0, 3.0, 1.5), (5.725, 0.475, 1.5), TX])
EVERYWHERE = np.stack([*np.meshgrid(np.arange(0.325, 6.6, 0.35), np.arange(0.32, 4.3, 0.35)), 1.5 + np.zeros((12, 18))])
RX = np.moveaxis(EVERYWHERE, 0, -1).reshape(-1, 3)


@pytest.mark.parametrize("resolution_m", [0.05, 0.02, 0.1])
def test_a_door_of_half_a_metre_is_open_wherever_the_origin_is(resolution_m):
    partial = two_rooms(0.5, resolution_m)
    left, right = np.array([[2.5, 2.35, 1.5]]), np.array([[4.1, 2.35, 1.5]])
    for shift_m in np.arange(0.0, 0.3, 0.05):
        at = np.array([shift_m, 2.0 * shift_m, 0.0])
        moved = sp.map_from_array(partial.state, resolution_m=resolution_m, origin_m=tuple(at[:2]))
        assert Walks(moved, left + at, 60.0).lengths_m(right + at).item() == pytest.approx(1.6, abs=0.25)
    closed = two_rooms(0.0, resolution_m)
    assert Walks(closed, left, 60.0).lengths_m(right).item() == np.inf


def lying(partial, points_m, how):
    """Return the map and points (N, 3) [m] moved, turned by 90 degrees, mirrored, or with unknown cells around."""
    cell_m = partial.resolution_m
    size_m = partial.shape[0] * cell_m
    turned = np.column_stack([size_m - points_m[:, 1], points_m[:, 0], points_m[:, 2]])
    return {
        "moved": (partial.state, (0.137, -7.311), points_m + np.array([0.137, -7.311, 0.0])),
        "turned": (np.rot90(partial.state, -1), (0.0, 0.0), turned),
        "mirrored": (partial.state.T, (0.0, 0.0), points_m[:, [1, 0, 2]]),
        "padded": (
            np.pad(partial.state, ((3, 8), (7, 0)), constant_values=2),
            (-7.0 * cell_m, -3.0 * cell_m),
            points_m,
        ),
    }[how]


@pytest.mark.parametrize("how", ["moved", "turned", "mirrored", "padded"])
@pytest.mark.parametrize("resolution_m", [0.05, 0.04, 0.1])
def test_lengths_depend_on_the_rooms_alone(how, resolution_m):
    partial = two_rooms(0.5, resolution_m)
    rx_m = RX[clear_of_walls(partial, RX)]
    expected_m = Walks(partial, POINTS, 60.0).lengths_m(rx_m)
    state, origin_m, points_m = lying(partial, np.concatenate([POINTS, rx_m]), how)
    other = sp.map_from_array(state, resolution_m=resolution_m, origin_m=origin_m)
    found_m = Walks(other, points_m[: len(POINTS)], 60.0).lengths_m(points_m[len(POINTS) :])
    np.testing.assert_allclose(found_m, expected_m, atol=1e-4)
    assert np.isfinite(found_m).all()


@pytest.mark.parametrize("how", ["moved", "turned", "mirrored"])
def test_corrected_means_depend_on_the_rooms_alone(how):
    def corrected_db(partial, tx_m, given_m, rx_m):
        def prior(points_m):
            mean_db = -60.0 - 25.0 * np.log10(np.linalg.norm(points_m - tx_m, axis=1) + 0.3)
            parts = np.stack([0.1 + 0.0 * mean_db, 0.4 + 0.0 * mean_db, 0.5 + 0.0 * mean_db])
            return sp.LinkPrediction.of_parts(
                parts, np.stack([-150.0 + 0.0 * mean_db, mean_db, mean_db - 8.0]), 6.0 * parts
            )

        measured = sp.Measurements(tx_m, given_m, np.linspace(-75.0, -60.0, len(given_m)))
        return Assimilation.fit(partial, tx_m, measured, prior(given_m)).update(rx_m, prior(rx_m)).gain_mean_db

    partial = two_rooms(0.5)
    rx_m = RX[clear_of_walls(partial, RX)]
    given_m = rx_m[7::23]
    expected_db = corrected_db(partial, TX, given_m, rx_m)
    state, origin_m, points_m = lying(partial, np.concatenate([TX[None], given_m, rx_m]), how)
    other = sp.map_from_array(state, resolution_m=0.05, origin_m=origin_m)
    found_db = corrected_db(other, points_m[0], points_m[1 : 1 + len(given_m)], points_m[1 + len(given_m) :])
    np.testing.assert_allclose(found_db, expected_db, atol=0.01)
