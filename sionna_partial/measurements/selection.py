"""Measurements that a prediction uses: of its transmitters and of others, at positions that the map allows."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from sionna_partial.arrays import Bools, Floats
from sionna_partial.errors import MeasurementError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements, measurements_of
from sionna_partial.tracing.positions import clear_of_walls, nearest_m

SAME_TX_M = 0.5
"""Distance within which a measured transmitter is the predicted one [m]."""

MOST_MEASUREMENTS = 20_000

MOST_OTHERS, MOST_OF_OTHER = 12, 100
"""Number of other transmitters, and of their links, for the loss of walls."""

_log = logging.getLogger(__name__)


def measurements_of_each(
    partial: PartialMap, sources_m: Sequence[Floats], measurements: Any, frequency_hz: float
) -> list[Measurements | None]:
    """Return measurements of transmitters, (1, 3) or unknown (0, 3) [m], or None; at least one has some."""
    measured = measurements_of(measurements)
    nearest = nearest_transmitters(measured.tx, sources_m)
    used = [bool(near.any()) or len(sources_m) == 1 for near in nearest]
    used[0] |= not any(used)
    return [
        _measured(partial, tx_m, measured, near, frequency_hz) if is_used else None
        for tx_m, near, is_used in zip(sources_m, nearest, used, strict=True)
    ]


def nearest_transmitters(tx_m: Floats, sources_m: Sequence[Floats]) -> Bools:
    """Return (T, N) whether the transmitter at (1, 3) is the nearest to the measured one and the same [m].

    Transmitters at one position share their measurements; an unknown position (0, 3) has none.
    """
    apart_m = np.array([np.linalg.norm(tx_m - (each_m if len(each_m) else np.nan), axis=1) for each_m in sources_m])
    apart_m = apart_m.reshape(len(sources_m), len(tx_m))
    return np.asarray((apart_m <= SAME_TX_M) & (apart_m <= apart_m.min(axis=0, initial=np.inf)))


def measurements_of_others(
    partial: PartialMap, sources_m: Sequence[Floats], measurements: Any, frequency_hz: float
) -> list[Measurements]:
    """Return usable links of the other transmitters nearest to those at (1, 3) [m]."""
    measured = measurements_of(measurements)
    usable = np.linalg.norm(measured.rx - measured.tx, axis=1) >= nearest_m(frequency_hz)
    for ends_m in (measured.tx, measured.rx):
        usable &= partial.radios_can_stand(ends_m)
        usable[usable] = clear_of_walls(partial, ends_m[usable])
    measured = measured.take(usable)
    places_m, of_position = np.unique(measured.tx, axis=0, return_inverse=True)
    apart_m = np.min([np.linalg.norm(places_m - tx_m, axis=1) for tx_m in sources_m], axis=0)
    others = []
    for position in np.argsort(apart_m, kind="stable")[:MOST_OTHERS]:
        links = np.flatnonzero(of_position.ravel() == position)
        others.append(measured.take(links[np.unique(np.linspace(0, len(links) - 1, MOST_OF_OTHER).astype(int))]))
    return others


def _measured(
    partial: PartialMap, tx_m: Floats, measured: Measurements, nearest: Bools, frequency_hz: float
) -> Measurements:
    measured = _of_transmitter(measured, tx_m[0], nearest) if len(tx_m) else _of_unknown(measured)
    if len(measured) > MOST_MEASUREMENTS:
        raise MeasurementError(
            f"measurements has {len(measured):,} links of this transmitter, more than {MOST_MEASUREMENTS:,}: average "
            "those that are near each other."
        )
    usable = can_be_used(partial, tx_m, measured.rx, frequency_hz)
    if not usable.any():
        raise MeasurementError(
            f"all {len(measured):,} receivers of the measurements are in walls or at the transmitter: check that their "
            "frame is that of the map."
        )
    if not usable.all():
        message = "%d of %d measurements are not used: their receivers are in walls or at the transmitter"
        _log.warning(message, int((~usable).sum()), len(usable))
    measured = measured.take(usable)
    partial.require_positions("rx of the measurements", measured.rx, least=0)
    return measured


def can_be_used(partial: PartialMap, tx_m: Floats, rx_m: Floats, frequency_hz: float) -> Bools:
    """Return whether receivers (N, 3) [m] are outside walls and transmitters (K, 3) [m]."""
    usable = clear_of_walls(partial, rx_m)
    for each_m in tx_m:
        usable &= np.linalg.norm(rx_m - each_m, axis=1) >= nearest_m(frequency_hz)
    return usable


def _of_transmitter(measured: Measurements, tx_m: Floats, nearest: Bools) -> Measurements:
    measured.require_transmitters()
    if not nearest.any():
        apart_m = np.linalg.norm(measured.tx - tx_m, axis=1)
        closest = ", ".join(f"{x:g}" for x in measured.tx[apart_m.argmin()]) if len(measured) else "none"
        raise MeasurementError(
            f"measurements has {len(measured):,} links, and none within {SAME_TX_M:g} m of tx = "
            f"({', '.join(f'{x:g}' for x in tx_m)}): the nearest transmitter is at ({closest}). Give measurements of "
            "the transmitter that is predicted, in the frame of the map."
        )
    return measured.take(nearest)


def _of_unknown(measured: Measurements) -> Measurements:
    known = measured.tx_known
    if not known.all():
        return measured.take(~known)
    if len(measured) and np.linalg.norm(measured.tx - measured.tx[0], axis=1).max() > SAME_TX_M:
        raise MeasurementError("tx = None, and measurements are of several transmitters: give those of one, or its tx.")
    _log.warning("tx = None: the position of the transmitter in the measurements is not used")
    return measured
