"""Positions of transmitters and receivers: which are allowed on a map."""

from __future__ import annotations

import itertools
import math
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import position_array, transmitter_names
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap

SHORTEST_M = 0.011
"""Shortest distance of a link [m], above `SHORTEST_LEG_M`."""


def nearest_m(frequency_hz: float) -> float:
    """Return the shortest distance of a link [m], for Sionna RT and where Friis' formula is below 0 dB."""
    return max(SHORTEST_M, SPEED_OF_LIGHT_M_S / frequency_hz / (4.0 * math.pi))


def clear_of_walls(partial: PartialMap, points_m: Floats) -> Bools:
    """Return whether points (..., 3) [m] are in no wall, and not within 1.1 cm of one."""
    clear, lower_m = ~partial.is_wall_at(points_m), 0.0 if partial.obstacle is None else -SHORTEST_M
    for corner in itertools.product((-SHORTEST_M, SHORTEST_M), repeat=2):
        clear &= ~partial.is_wall_at(points_m + np.array([*corner, lower_m]))
    return clear


def checked_positions(partial: PartialMap, tx: ArrayLike, rx: ArrayLike, frequency_hz: float) -> tuple[Floats, Floats]:
    """Check the positions; return transmitters (T, 3) and receivers (N, 3)."""
    tx_m, rx_m = _transmitters(partial, tx), _receivers(rx)
    partial.require_positions("rx", rx_m, least=0)
    limit_m = nearest_m(frequency_hz)
    for source_m in tx_m:
        distance_m = np.linalg.norm(rx_m - source_m, axis=1)
        if distance_m.min(initial=math.inf) < limit_m:
            index = int(distance_m.argmin())
            raise PositionError(
                f"rx[{index}] = {tuple(rx_m[index].tolist())} is {distance_m[index]:.3g} m from the transmitter, where "
                f"the path gain has no meaning: leave out receivers nearer than {limit_m:.3g} m."
            )
    return tx_m, rx_m


def valid_links(partial: PartialMap, tx: ArrayLike, rx: ArrayLike, frequency_hz: float) -> tuple[Floats, Floats, Bools]:
    """Return transmitters (T, 3), receivers (N, 3) [m], and which links (T, N) `checked_positions` accepts."""
    tx_m, rx_m = _transmitters(partial, tx), _receivers(rx)
    far = np.linalg.norm(rx_m - tx_m[:, None], axis=-1) >= nearest_m(frequency_hz)
    return tx_m, rx_m, far & partial.radios_can_stand(rx_m)


def _transmitters(partial: PartialMap, tx: ArrayLike) -> Floats:
    points_m = position_array("tx", tx)
    return partial.require_positions("tx", points_m, names=transmitter_names(len(points_m))).reshape(-1, 3)


def _receivers(rx: ArrayLike) -> Floats:
    with suppress(ValueError):  # nested lists of unequal lengths have no size
        rx = np.zeros((0, 3)) if np.size(rx) == 0 else rx
    return position_array("rx", rx, least=0).reshape(-1, 3)
