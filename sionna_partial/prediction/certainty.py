"""What a map leaves no doubt about: the link states that are possible, whatever the networks say.

A predicted distribution is restricted to these states (`context_networks.distribution`). Lines and
regions are drawn on the cells of the map:

- A direct line that crosses a known wall has no LOS. It crosses one where the lines a cell and a half to its left and
  right both run into known walls, and it does itself, or is blocked in the trace: past the corner or along the face of
  a wall, one of the three stays clear.
- On a direct line that is wholly observed and meets no wall, LOS is what the trace says.
- Regions are the parts of a map that known walls separate, gaps of two cells or less being closed. Where the ends are
  in different regions, or in one that is wholly observed, an outage of the trace is an outage, and in one that is
  wholly observed there is no other.

The cells of a mesh do not show at which height its surfaces are: there the second rule alone holds.
"""

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.constants import CellState, LinkState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.unobserved import GRAZE, in_cells, map_line_fractions

_ASIDE_CELLS = 1.5
"""How far to both sides a line has to run into known walls to cross one: the uncertainty of a map [cells]."""

_CELL_AROUND = np.ones((3, 3), dtype=bool)


def possible_states(phi: LinkFeatures) -> NDArray[np.bool_]:
    """Return which states the map leaves possible (N, 3) for N links with a context, by LinkState; at least one."""
    assert phi.context is not None
    context, traced = phi.context, phi.link_state
    possible = np.ones((len(phi), len(LinkState)), dtype=bool)
    for number in np.unique(context.map_index):
        here = np.flatnonzero(context.map_index == number)
        partial, tx_m, rx_m = context.maps[number], context.tx_m[here], context.rx_m[here]
        seen, walled, state = phi.unobserved_distance_m[here] == 0.0, context.walled_m[here] > 0.0, traced[here]
        los, blocked = state == LinkState.LOS, np.zeros(len(here), dtype=bool)
        if partial.mesh is None:
            doubtful = (walled & ~(seen & los)) | ~los
            blocked[doubtful] = _beside_walls(partial, tx_m[doubtful], rx_m[doubtful])
            walled_off, enclosed = _enclosures(partial, tx_m, rx_m)
            outage = (walled_off | enclosed) & (state == LinkState.OUTAGE)
            possible[here[outage]] = np.arange(len(LinkState)) == LinkState.OUTAGE
            possible[here[enclosed & ~outage], LinkState.OUTAGE] = False
            seen &= ~walled
        possible[here[blocked | (seen & ~los)], LinkState.LOS] = False
        possible[here[seen & los]] = np.arange(len(LinkState)) == LinkState.LOS
    return possible


def _beside_walls(partial: PartialMap, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the lines `_ASIDE_CELLS` to the left and right of direct lines (N,) both run into known walls."""
    starts, ends = in_cells(partial, tx_m), in_cells(partial, rx_m)
    along = ends - starts
    lengths = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), GRAZE)
    aside = _ASIDE_CELLS * np.stack([-along[:, 1], along[:, 0]], axis=1) / lengths
    left, right = (
        map_line_fractions(partial, starts + step, ends + step)[:, CellState.WALL] > GRAZE for step in (aside, -aside)
    )
    return left & right


def _enclosures(
    partial: PartialMap, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether both ends of links (N,) are in different regions, and whether both are in one that is wholly observed."""
    state = np.pad(partial.state, 1, constant_values=CellState.UNKNOWN)
    regions, count = ndimage.label(~ndimage.binary_dilation(state == CellState.WALL, _CELL_AROUND))
    observed = np.ones(count + 1, dtype=bool)
    observed[regions[state == CellState.UNKNOWN]] = False
    tx, rx = (_region_at(partial, regions, points_m) for points_m in (tx_m, rx_m))
    known = (tx > 0) & (rx > 0)
    return known & (tx != rx), known & (tx == rx) & observed[tx]


def _region_at(partial: PartialMap, regions: NDArray[np.int32], points_m: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the region (N,) of points (N, 3) [m], which may be in it or beside it; 0 where there is none, or two.

    Parameters
    ----------
    partial : PartialMap
    regions : (ny + 2, nx + 2) int32 array
        Of its cells, and of those around it; 0 within a cell of a wall.
    points_m : (N, 3) float64 array
        [m]
    """
    row, column = partial.cell_index(points_m)
    around = [
        regions[np.clip(row + 1 + up, 0, len(regions) - 1), np.clip(column + 1 + right, 0, regions.shape[1] - 1)]
        for up, right in itertools.product((-1, 0, 1), repeat=2)
    ]
    largest = np.max(around, axis=0)
    alone = np.all([(each == 0) | (each == largest) for each in around], axis=0)
    return np.where(alone, largest, 0)
