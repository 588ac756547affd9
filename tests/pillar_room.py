"""A small room with a pillar, which has edges that diffract, for tests of engines and derivatives."""

import numpy as np

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap

TX_M = np.array([1.03, 1.52, 1.4])
"""Transmitter, which sees one face of the pillar [m]."""

RX_M = np.array([[1.47, 2.51, 1.7], [3.05, 0.61, 1.2], [3.12, 2.57, 1.3]])
"""Receivers [m]: one that sees the transmitter, and two beside and behind the pillar."""


def small_room() -> PartialMap:
    """Make a room of 4 m x 3 m with a pillar."""
    state = np.full((32, 42), CellState.FREE, dtype=np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = CellState.WALL
    state[12:20, 20:26] = CellState.WALL
    return PartialMap(state, 0.1)
