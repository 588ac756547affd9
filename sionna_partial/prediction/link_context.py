"""Where links run: what their paths cross, and the maps around them. TracedLinks + PartialMap -> LinkContext."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sionna_partial.constants import CellState
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.unobserved import is_enclosed, unobserved_lengths_m, walled_lengths_m
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.trace import TracedLinks, path_gain_db

REACHES_M = (math.inf, 4.0, 1.0, 0.25, 0.0)
"""How far paths are taken to get through unobserved space [m]: a path that crosses u of it counts exp(-u / reach)."""

_PATHS_AT_ONCE = 100_000
"""Number of paths that are measured together, which bounds the memory."""

SEEN_M = 1e-3
"""Unobserved length below which a path is wholly in observed space [m]."""


@dataclass(frozen=True, eq=False)
class LinkContext:
    """What the map shows along and around N links, beyond the paper's features.

    Parameters
    ----------
    maps : tuple of M PartialMap
        The maps on which the links were traced.
    map_index : (N,) int64 array
        Which of them is each link's.
    tx_m, rx_m : (N, 3) float64 arrays
        Positions of transmitter and receiver [m].
    indirect_gain_db : (N, R) float64 array
        Gain of all traced paths but the direct one, each path weakened by the unobserved space that it crosses, for
        each of `REACHES_M` [dB], at least -150: of all of them first, of those wholly in observed space last.
    strongest_unobserved_m : (N,) float64 array
        Unobserved length of the strongest path but the direct one [m]; the distance where there is none.

    Raises
    ------
    PredictorError
        For arrays of other shapes, or a map that is not there.
    """

    maps: tuple[PartialMap, ...]
    map_index: NDArray[np.int64]
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    indirect_gain_db: NDArray[np.float64]
    strongest_unobserved_m: NDArray[np.float64]

    def __post_init__(self) -> None:
        count = len(self.map_index)
        shapes = {"tx_m": (3,), "rx_m": (3,), "indirect_gain_db": (len(REACHES_M),), "strongest_unobserved_m": ()}
        for name, shape in shapes.items():
            found = np.shape(getattr(self, name))
            if found != (count, *shape):
                raise PredictorError(f"{name} has shape {found}: give {(count, *shape)}, a row for each link.")
        there = (self.map_index >= 0) & (self.map_index < len(self.maps))
        if not there.all():
            index = int(np.argmin(there))
            raise PredictorError(
                f"map_index[{index}] = {self.map_index[index]} is not allowed: give places in maps, which has "
                f"{len(self.maps)}, from 0."
            )

    def __len__(self) -> int:
        """Return the number of links N."""
        return len(self.map_index)

    @cached_property
    def tx_seen(self) -> NDArray[np.bool_]:
        """Whether each transmitter (N,) is in an observed cell of its map."""
        return self._seen(self.tx_m)

    @cached_property
    def rx_seen(self) -> NDArray[np.bool_]:
        """Whether each receiver (N,) is in an observed cell of its map."""
        return self._seen(self.rx_m)

    @cached_property
    def walled_m(self) -> NDArray[np.float64]:
        """Length of the direct line of each link (N,) in cells of known walls [m]: outlines may leave them open."""
        walled_m = np.zeros(len(self))
        for number in np.unique(self.map_index):
            here = self.map_index == number
            walled_m[here] = walled_lengths_m(self.maps[number], self.tx_m[here], self.rx_m[here])
        return walled_m

    @cached_property
    def complete(self) -> NDArray[np.bool_]:
        """Whether the map of each link (N,) is complete, and knows one of its ends."""
        complete = np.array([each.is_complete for each in self.maps], dtype=bool)[self.map_index]
        return complete & (self.tx_seen | self.rx_seen)

    def take(self, index: NDArray[np.generic] | slice) -> "LinkContext":
        """Return the links that an index array, a mask (N,) or a slice selects."""
        return LinkContext(self.maps, *(getattr(self, name)[index] for name in _COLUMNS))

    @classmethod
    def concatenate(cls, parts: Sequence["LinkContext"]) -> "LinkContext":
        """Return the links of all `parts`, one part after the other."""
        if not parts:
            raise PredictorError("parts is empty: give at least one LinkContext.")
        places: dict[int, int] = {}
        maps: list[PartialMap] = []
        index = []
        for part in parts:
            for each in part.maps:
                if places.setdefault(id(each), len(maps)) == len(maps):
                    maps.append(each)
            index.append(np.array([places[id(each)] for each in part.maps], dtype=np.int64)[part.map_index])
        columns = (np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS[1:])
        return cls(tuple(maps), np.concatenate(index), *columns)

    def _seen(self, places_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        seen = np.zeros(len(self), dtype=bool)
        for number in np.unique(self.map_index):
            here = self.map_index == number
            seen[here] = self.maps[number].state_at(places_m[here]) != CellState.UNKNOWN
        return seen


_COLUMNS = ("map_index", "tx_m", "rx_m", "indirect_gain_db", "strongest_unobserved_m")


class ContextSums:
    """What the paths of links cross, summed up while they are traced.

    Parameters
    ----------
    partial : PartialMap
        The map on which the links are traced.
    tx_m, rx_m : (T, 3) and (N, 3) float64 arrays
        Transmitters and receivers [m].
    """

    def __init__(self, partial: PartialMap, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> None:
        self._partial, self._tx_m, self._rx_m = partial, tx_m, rx_m
        count = len(tx_m) * len(rx_m)
        self._power, self._strongest = np.zeros((len(REACHES_M), count)), np.zeros(count)
        self._strongest_m = np.linalg.norm(rx_m - tx_m[:, None], axis=2).ravel()

    def add(self, paths: TracedLinks | SolvedPaths) -> None:
        """Add paths, in world coordinates."""
        for start in range(0, len(paths.a), _PATHS_AT_ONCE):
            block = slice(start, start + _PATHS_AT_ONCE)
            indirect = start + np.flatnonzero(np.any(paths.interactions[block] > 0, axis=1))
            tx, rx = paths.path_tx[indirect], paths.path_rx[indirect]
            self._add(
                tx.astype(np.int64) * len(self._rx_m) + rx,
                np.abs(paths.a[indirect]) ** 2,
                path_unobserved_m(
                    self._partial,
                    self._tx_m[tx],
                    paths.interactions[indirect],
                    paths.vertices_m[indirect],
                    self._rx_m[rx],
                ),
            )

    def _add(self, link: NDArray[np.int64], power: NDArray[np.float64], unobserved_m: NDArray[np.float64]) -> None:
        for total, reach in zip(self._power, REACHES_M, strict=True):
            np.add.at(total, link, power * kept_shares(unobserved_m, reach))
        order = np.argsort(power, kind="stable")
        strongest = np.full(len(self._strongest), -1)
        strongest[link[order]] = order
        links = np.flatnonzero(strongest >= 0)
        links = links[power[strongest[links]] >= self._strongest[links]]
        self._strongest[links], self._strongest_m[links] = power[strongest[links]], unobserved_m[strongest[links]]

    def context(self) -> LinkContext:
        """Return the context of all T N links, transmitter by transmitter."""
        tx_m = np.repeat(self._tx_m, len(self._rx_m), axis=0)
        rx_m = np.tile(self._rx_m, (len(self._tx_m), 1))
        gains_db = np.stack([path_gain_db(total) for total in self._power], axis=1)
        return LinkContext((self._partial,), np.zeros(len(tx_m), np.int64), tx_m, rx_m, gains_db, self._strongest_m)


def path_unobserved_m(
    partial: PartialMap,
    start_m: NDArray[np.float64],
    interactions: NDArray[np.uint8],
    vertices_m: NDArray[np.float64],
    end_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Measure the length of paths in unknown cells.

    Parameters
    ----------
    partial : PartialMap
    start_m, end_m : (P, 3) float64 arrays
        Ends of the paths [m].
    interactions : (P, D) uint8 array
        0 where there is none.
    vertices_m : (P, D, 3) float64 array
        Places of the interactions [m].

    Returns
    -------
    (P,) float64 array
        [m]; 0 for links that a complete map encloses.
    """
    total_m = np.zeros(len(start_m))
    crossing = ~is_enclosed(partial, start_m, end_m)
    if not crossing.all():
        rows = np.flatnonzero(crossing)
        if len(rows):
            total_m[rows] = path_unobserved_m(partial, start_m[rows], interactions[rows], vertices_m[rows], end_m[rows])
        return total_m
    here_m = start_m.copy()
    for depth in range(interactions.shape[1]):
        bends = np.flatnonzero(interactions[:, depth])
        there_m = vertices_m[bends, depth]
        total_m[bends] += unobserved_lengths_m(partial, here_m[bends], there_m)
        here_m[bends] = there_m
    return total_m + unobserved_lengths_m(partial, here_m, end_m)


def kept_shares(unobserved_m: NDArray[np.float64], reach_m: float) -> NDArray[np.float64]:
    """Return the share (P,) of the power of paths that gets through the unobserved space that they cross [m]."""
    return np.exp(-unobserved_m / reach_m) if reach_m > 0.0 else (unobserved_m < SEEN_M).astype(np.float64)
