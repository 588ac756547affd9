"""What is known of links beside the paper's features, as arrays: TracedLinks + PartialMap -> LinkContext."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.constants import CellState, LinkState
from sionna_partial.display import Shown
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.unobserved import (
    GRAZE,
    in_cells,
    is_enclosed,
    lengths_in_unknown_m,
    map_line_fractions,
    walled_lengths_m,
)
from sionna_partial.prediction.windows import draw_windows, transmitters
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.trace import path_gain_db

ATTENUATION_LENGTHS_M = (math.inf, 4.0, 1.0, 0.25, 0.0)
"""Attenuation lengths of unobserved space [m]: a path that crosses u of it counts exp(-u / length)."""

_PATHS_AT_ONCE = 100_000
"""Number of paths that are measured together, which bounds the memory."""

SEEN_M = 1e-3
"""Unobserved length below which a path is wholly in observed space [m]."""

_ASIDE_CELLS = 1.5
"""How far to both sides a line has to run into known walls to cross one: the uncertainty of a map [cells]."""


@dataclass(frozen=True, eq=False)
class LinkContext(Shown):
    """What the paths of N links cross, what the map leaves possible, and what it shows around their transmitters.

    Parameters
    ----------
    tx_m, rx_m : (N, 3) float64 arrays
        Positions of transmitter and receiver [m].
    tx_seen, rx_seen : (N,) bool arrays
        Whether they are in observed cells.
    complete : (N,) bool array
        Whether the map is complete, and one of the ends is in an observed cell: then the trace is the truth.
    walled_m : (N,) float64 array
        Length of the direct line in cells of known walls [m]: outlines of walls may leave them open.
    possible : (N, 3) bool array
        Whether the map leaves each LinkState possible; at least one is.
    indirect_gain_db : (N, len(ATTENUATION_LENGTHS_M)) float64 array
        Gain of all traced paths but the direct one, each attenuated by the unobserved space that it crosses [dB], at
        least -150: of all of them first, of those wholly in observed space last.
    strongest_unobserved_m : (N,) float64 array
        Unobserved length of the strongest path but the direct one [m]; the distance where there is none.
    windows : (W, *WINDOWS) uint8 array, optional
        What the map networks read around the transmitters.
    window_index : (N,) int array
        The transmitter, and window, of each link.
    """

    tx_m: Floats
    rx_m: Floats
    tx_seen: Bools
    rx_seen: Bools
    complete: Bools
    walled_m: Floats
    possible: Bools
    indirect_gain_db: Floats
    strongest_unobserved_m: Floats
    window_index: Indices
    windows: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        """Return the number of links N."""
        return len(self.tx_m)

    @classmethod
    def on_maps(
        cls,
        maps: Sequence[PartialMap],
        map_index: NDArray[np.int64],
        *,
        tx_m: Floats,
        rx_m: Floats,
        link_state: NDArray[np.uint8],
        unobserved_distance_m: Floats,
        indirect_gain_db: Floats,
        strongest_unobserved_m: Floats,
    ) -> "LinkContext":
        """Compute what the maps show of links, without windows.

        `map_index` (N,) is the map of each link; the other arrays are as in `LinkFeatures` and `LinkContext`.
        """
        count = len(map_index)
        tx_seen, rx_seen, complete = (np.zeros(count, dtype=bool) for _ in range(3))
        walled_m, possible = np.zeros(count), np.ones((count, len(LinkState)), dtype=bool)
        for number in np.unique(map_index):
            here, partial = map_index == number, maps[number]
            ends = tx_m[here], rx_m[here]
            tx_seen[here], rx_seen[here] = (partial.state_at(end_m) != CellState.UNKNOWN for end_m in ends)
            complete[here] = is_enclosed(partial, *ends)
            walled_m[here] = walled_lengths_m(partial, *ends)
            seen, walled = unobserved_distance_m[here] == 0.0, walled_m[here] > 0.0
            possible[here] = _possible_states(partial, ends, link_state[here], seen, walled)
        found = (tx_seen, rx_seen, complete, walled_m, possible)
        _, window_index = transmitters(map_index, tx_m)
        return cls(tx_m, rx_m, *found, indirect_gain_db, strongest_unobserved_m, window_index)

    def with_windows(self, maps: Sequence[PartialMap], map_index: NDArray[np.int64]) -> "LinkContext":
        """Return the context with the windows of the maps that `on_maps` was given."""
        keys, window_index = transmitters(map_index, self.tx_m)
        return replace(self, windows=draw_windows(maps, keys), window_index=window_index)

    def take(self, index: NDArray[np.generic] | slice) -> "LinkContext":
        """Return the links that an index array, a mask (N,) or a slice selects; the windows are shared."""
        return LinkContext(**{name: getattr(self, name)[index] for name in _COLUMNS}, windows=self.windows)

    @classmethod
    def concatenate(cls, parts: Sequence["LinkContext"]) -> "LinkContext":
        """Return the links of all `parts`, one part after the other; without windows unless all parts have them."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        first: dict[int, int] = {}
        index, windows, count = [], [], 0
        for part in parts:
            key = id(part if part.windows is None else part.windows)
            if key not in first:
                first[key] = count
                count += part.window_index.max(initial=-1) + 1 if part.windows is None else len(part.windows)
                windows.append(part.windows)
            index.append(part.window_index + first[key])
        columns["window_index"] = np.concatenate(index)
        drawn = [each for each in windows if each is not None]
        if len(drawn) < len(windows):
            return cls(**columns)
        return cls(**columns, windows=drawn[0] if len(drawn) == 1 else np.concatenate(drawn))


_COLUMNS = tuple(field.name for field in fields(LinkContext) if field.name != "windows")


class IndirectPaths:
    """Sums over the indirect paths from T transmitters to N receivers (T, 3) and (N, 3) [m], while they are traced."""

    def __init__(self, partial: PartialMap, tx_m: Floats, rx_m: Floats) -> None:
        self.partial, self.tx_m, self.rx_m = partial, tx_m, rx_m
        count = len(tx_m) * len(rx_m)
        self._power, self._strongest = np.zeros((len(ATTENUATION_LENGTHS_M), count)), np.zeros(count)
        self._strongest_m = np.linalg.norm(rx_m - tx_m[:, None], axis=2).ravel()

    def add(self, paths: TracedLinks | SolvedPaths) -> None:
        """Add paths, in world coordinates."""
        for start in range(0, len(paths.a), _PATHS_AT_ONCE):
            block = slice(start, start + _PATHS_AT_ONCE)
            indirect = start + np.flatnonzero(np.any(paths.interactions[block] > 0, axis=1))
            tx, rx = paths.path_tx[indirect], paths.path_rx[indirect]
            interactions, vertices_m = paths.interactions[indirect], paths.vertices_m[indirect]
            unobserved_m = path_unobserved_m(self.partial, self.tx_m[tx], interactions, vertices_m, self.rx_m[rx])
            self._add(tx.astype(np.int64) * len(self.rx_m) + rx, np.abs(paths.a[indirect]) ** 2, unobserved_m)

    def _add(self, link: NDArray[np.int64], power: Floats, unobserved_m: Floats) -> None:
        for total, length_m in zip(self._power, ATTENUATION_LENGTHS_M, strict=True):
            np.add.at(total, link, power * attenuation(unobserved_m, length_m))
        order = np.argsort(power, kind="stable")
        strongest = np.full(len(self._strongest), -1)
        strongest[link[order]] = order
        links = np.flatnonzero(strongest >= 0)
        links = links[power[strongest[links]] >= self._strongest[links]]
        self._strongest[links], self._strongest_m[links] = power[strongest[links]], unobserved_m[strongest[links]]

    def context(self, link_state: NDArray[np.uint8], unobserved_distance_m: Floats) -> LinkContext:
        """Return the context of all T N links, transmitter by transmitter, without windows."""
        tx_m, rx_m = np.repeat(self.tx_m, len(self.rx_m), axis=0), np.tile(self.rx_m, (len(self.tx_m), 1))
        return LinkContext.on_maps(
            (self.partial,),
            np.zeros(len(tx_m), dtype=np.int64),
            tx_m=tx_m,
            rx_m=rx_m,
            link_state=link_state,
            unobserved_distance_m=unobserved_distance_m,
            indirect_gain_db=np.stack([path_gain_db(total) for total in self._power], axis=1),
            strongest_unobserved_m=self._strongest_m,
        )


def path_unobserved_m(
    partial: PartialMap, start_m: Floats, interactions: NDArray[np.uint8], vertices_m: Floats, end_m: Floats
) -> Floats:
    """Return the length (P,) [m] of paths in unknown cells; 0 for links that a complete map encloses.

    They lead from `start_m` (P, 3) by `vertices_m` (P, D, 3), where `interactions` (P, D) is not 0, to `end_m` (P, 3).
    """
    total_m = np.zeros(len(start_m))
    rows = np.flatnonzero(~is_enclosed(partial, start_m, end_m))
    here_m = start_m[rows]
    for depth in range(interactions.shape[1] if len(rows) else 0):
        there = interactions[rows, depth] > 0
        there_m = vertices_m[rows[there], depth]
        total_m[rows[there]] += lengths_in_unknown_m(partial, here_m[there], there_m)
        here_m[there] = there_m
    total_m[rows] += lengths_in_unknown_m(partial, here_m, end_m[rows])
    return total_m


def traced_unobserved_m(partial: PartialMap, links: TracedLinks, paths: Indices) -> Floats:
    """Return the same length (P,) [m] of some paths of traced links, by their numbers (P,)."""
    tx_m, rx_m = links.tx.reshape(-1, 3)[links.path_tx[paths]], links.rx[links.path_rx[paths]]
    return path_unobserved_m(partial, tx_m, links.interactions[paths], links.vertices_m[paths], rx_m)


def attenuation(unobserved_m: Floats, length_m: float) -> Floats:
    """Return the fraction (P,) of the power of paths that unobserved space of an attenuation length [m] lets pass."""
    return np.exp(-unobserved_m / length_m) if length_m > 0.0 else (unobserved_m < SEEN_M).astype(np.float64)


def _possible_states(
    partial: PartialMap, ends_m: tuple[Floats, Floats], link_state: NDArray[np.uint8], seen: Bools, walled: Bools
) -> Bools:
    """Return which link states a map leaves possible (N, 3), whatever the networks predict.

    - A direct line that crosses a known wall has no LOS. It crosses one where the lines a cell and a half to its left
      and right both run into known walls, and it does itself (`walled`), or is blocked in the trace: past the corner or
      along the face of a wall, one of the three stays clear.
    - On a direct line that is wholly observed (`seen`) and meets no wall, LOS is as traced.
    - Regions are the parts of a map that known walls separate, gaps of two cells or less being closed. Where the ends
      are in different regions, or in one that is wholly observed, an outage of the trace is an outage, and in one that
      is wholly observed there is no other.

    The cells of a mesh do not show at which height its surfaces are: there the second rule alone holds.
    """
    los, states = link_state == LinkState.LOS, np.arange(len(LinkState))
    possible, blocked = np.ones((len(los), len(LinkState)), dtype=bool), np.zeros(len(los), dtype=bool)
    if partial.mesh is None:
        doubtful = (walled & ~(seen & los)) | ~los
        blocked[doubtful] = _crosses_wall(partial, *(end_m[doubtful] for end_m in ends_m))
        walled_off, enclosed = _regions(partial, *ends_m)
        outage = (walled_off | enclosed) & (link_state == LinkState.OUTAGE)
        possible[outage] = states == LinkState.OUTAGE
        possible[enclosed & ~outage, LinkState.OUTAGE] = False
        seen = seen & ~walled
    possible[blocked | (seen & ~los), LinkState.LOS] = False
    possible[seen & los] = states == LinkState.LOS
    return possible


def _crosses_wall(partial: PartialMap, tx_m: Floats, rx_m: Floats) -> Bools:
    """Whether the lines `_ASIDE_CELLS` to the left and right of direct lines (N,) both run into known walls."""
    starts, ends = in_cells(partial, tx_m), in_cells(partial, rx_m)
    along = ends - starts
    lengths = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), GRAZE)
    aside = _ASIDE_CELLS * np.stack([-along[:, 1], along[:, 0]], axis=1) / lengths
    left, right = (
        map_line_fractions(partial, starts + step, ends + step)[:, CellState.WALL] > GRAZE for step in (aside, -aside)
    )
    return left & right


def _regions(partial: PartialMap, tx_m: Floats, rx_m: Floats) -> tuple[Bools, Bools]:
    """Whether both ends of links (N,) are in different regions, and whether both are in one that is wholly observed."""
    state = np.pad(partial.state, 1, constant_values=CellState.UNKNOWN)
    regions, count = ndimage.label(~ndimage.binary_dilation(state == CellState.WALL, np.ones((3, 3), dtype=bool)))
    observed = np.ones(count + 1, dtype=bool)
    observed[regions[state == CellState.UNKNOWN]] = False
    tx, rx = (_region_at(partial, regions, points_m) for points_m in (tx_m, rx_m))
    known = (tx > 0) & (rx > 0)
    return known & (tx != rx), known & (tx == rx) & observed[tx]


def _region_at(partial: PartialMap, regions: NDArray[np.int32], points_m: Floats) -> NDArray[np.int32]:
    """Return the region (N,) of points (N, 3) [m], which may be in it or beside it; 0 where there is none, or two.

    `regions` (ny + 2, nx + 2) are those of the map's cells and of the cells around it; 0 within a cell of a wall.
    """
    row, column = partial.cell_index(points_m)
    around = [
        regions[np.clip(row + 1 + up, 0, len(regions) - 1), np.clip(column + 1 + right, 0, regions.shape[1] - 1)]
        for up, right in itertools.product((-1, 0, 1), repeat=2)
    ]
    largest = np.max(around, axis=0)
    alone = np.all([(each == 0) | (each == largest) for each in around], axis=0)
    return np.where(alone, largest, 0)
