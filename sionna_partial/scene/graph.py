"""Wall cells -> a graph of lattice edges through the centres of the boundary cells."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.scene.polylines import WallGraph

_KEY = 1 << 32


def wall_graph(wall: NDArray[np.bool_]) -> WallGraph:
    """Connect the centres of boundary wall cells.

    Edges join wall cells that touch by a side, unless both blocks of two by two cells beside the edge are full, and
    by a corner where a block holds just these two. Spurs of one cell are cut off. Single cells become squares.

    Parameters
    ----------
    wall : (ny, nx) bool array
        Cleaned wall cells.

    Returns
    -------
    WallGraph
    """
    graph = _cut_spurs(_index(_lattice_edges(wall)))
    return _index(np.concatenate([graph.points[graph.edges], _squares(_lone_cells(wall))]))


def lattice_graph(wall: NDArray[np.bool_]) -> WallGraph:
    """Connect the centres of boundary wall cells as they are: no gap is bridged, no spur cut off.

    Edges are those of `wall_graph`; cells that touch no other become squares.

    Parameters
    ----------
    wall : (ny, nx) bool array

    Returns
    -------
    WallGraph
    """
    return _index(np.concatenate([_lattice_edges(wall), _squares(_lone_cells(wall))]))


def _lattice_edges(wall: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Edges (E, 2, 2) of the outline, from x, y to x, y in half cells."""
    w = np.pad(wall, 1)
    block = w[:-1, :-1] & w[:-1, 1:] & w[1:, :-1] & w[1:, 1:]
    across = w[:, :-1] & w[:, 1:]
    across[1:-1] &= ~(block[:-1] & block[1:])
    upright = w[:-1] & w[1:]
    upright[:, 1:-1] &= ~(block[:, :-1] & block[:, 1:])
    rising = w[:-1, :-1] & w[1:, 1:] & ~w[:-1, 1:] & ~w[1:, :-1]
    falling = ~w[:-1, :-1] & ~w[1:, 1:] & w[:-1, 1:] & w[1:, :-1]
    kinds = ((across, 0, 0, 1, 0), (upright, 0, 0, 0, 1), (rising, 0, 0, 1, 1), (falling, 1, 0, 0, 1))
    parts = []
    for mask, x0, y0, x1, y1 in kinds:
        row, column = np.nonzero(mask)
        parts.append(np.stack([column + x0, row + y0, column + x1, row + y1], 1).reshape(-1, 2, 2))
    return 2 * np.concatenate(parts).astype(np.int64) - 1


def _lone_cells(wall: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Centres (n, 2) [half cells] of wall cells that touch no other."""
    around = ndimage.convolve(wall.astype(np.uint8), np.ones((3, 3), dtype=np.uint8), mode="constant")
    row, column = np.nonzero(wall & (around == 1))
    return 2 * np.stack([column, row], 1).astype(np.int64) + 1


def _squares(centres: NDArray[np.int64]) -> NDArray[np.int64]:
    corners = centres[:, None] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.stack([corners, np.roll(corners, -1, axis=1)], 2).reshape(-1, 2, 2)


def _index(ends: NDArray[np.int64]) -> WallGraph:
    """Graph of edges given by their ends (E, 2, 2)."""
    unique, inverse = np.unique(ends[..., 1].ravel() * _KEY + ends[..., 0].ravel(), return_inverse=True)
    edges = np.sort(inverse.reshape(-1, 2), axis=1)
    edges = np.unique(edges, axis=0) if len(edges) else edges
    return WallGraph(np.stack([unique % _KEY, unique // _KEY], 1), edges.astype(np.int64))


def _cut_spurs(graph: WallGraph) -> WallGraph:
    """Remove edges that stick out of a junction, unless nothing else is there."""
    degree = graph.degree
    ends = degree[graph.edges]
    spur = (ends.min(axis=1) == 1) & (ends.max(axis=1) >= 3)
    junction = np.where(ends[:, 0] > ends[:, 1], graph.edges[:, 0], graph.edges[:, 1])
    spurs = np.bincount(junction[spur], minlength=len(degree))
    spur &= spurs[junction] < degree[junction]
    return _index(graph.points[graph.edges[~spur]])
