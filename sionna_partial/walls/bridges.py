"""Short gaps that range sampling left in seen walls -> edges that close them."""

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.walls.cells import MAX_FREE_GAP_M, MAX_GAP_CELLS, MIN_RUN_CELLS
from sionna_partial.walls.chains import WallGraph, step_back

_LOOK_EDGES = 5
_AHEAD_COSINE = 0.65
_STRAIGHT_COSINE = 0.9
_OPPOSED_COSINE = -0.5
_TIP = 0.999


def find_bridges(graph: WallGraph, partial: PartialMap, bridge_gap_m: float) -> NDArray[np.int64]:
    """Find edges that close short gaps in thin walls.

    A gap lies ahead of a wall end or beside a lone cell, is at most `MAX_GAP_CELLS` and `bridge_gap_m` long, and leads
    to another end that faces it. Across UNKNOWN cells alone it may also lead to a side of a wall, and around a corner
    whose one cell was not seen; across FREE cells it must be short (`MAX_FREE_GAP_M`) and in line with the walls on
    both sides.

    Parameters
    ----------
    graph : WallGraph
        Points without edges are lone cells.
    partial : PartialMap
    bridge_gap_m : float
        Longest gap that is bridged [m].

    Returns
    -------
    (B, 2) int64 array
        Indices of points to connect. No bridge crosses a wall or another bridge.
    """
    longest = min(MAX_GAP_CELLS, int(bridge_gap_m / partial.resolution_m + 1e-6))
    pairs = _near_pairs(graph, longest)
    walled, free = _crossed_states(graph, partial, pairs)
    pairs, free = pairs[~walled], free[~walled]
    directions, cells = _end_directions(graph, np.unique(pairs))
    kept = _facing(graph, pairs, free, directions, cells, partial.resolution_m)
    return _first_come(graph, pairs[kept])


def _near_pairs(graph: WallGraph, longest: int) -> NDArray[np.int64]:
    """Pairs (end, other point) with one to `longest` cells between them."""
    ends = np.nonzero(graph.degree <= 1)[0]
    if longest < 1 or len(ends) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    tree = cKDTree(graph.points)
    near = tree.query_ball_point(graph.points[ends], 2 * longest + 2.5, p=np.inf, return_sorted=True)
    pairs = np.stack([np.repeat(ends, [len(n) for n in near]), np.concatenate([np.asarray(n) for n in near])], 1)
    apart = np.abs(graph.points[pairs[:, 1]] - graph.points[pairs[:, 0]]).max(axis=1)
    both = graph.degree[pairs[:, 1]] <= 1
    return pairs[(apart >= 4) & ~(both & (pairs[:, 0] > pairs[:, 1]))].astype(np.int64)


def _crossed_states(
    graph: WallGraph, partial: PartialMap, pairs: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether a WALL and whether a FREE cell lies on the line between the points of each pair.

    Where the line runs along the border of two cells, it takes the one that is UNKNOWN.
    """
    start, end = graph.points[pairs[:, 0]], graph.points[pairs[:, 1]]
    count = np.abs(end - start).max(axis=1, initial=0) // 2
    walled, free = np.zeros(len(pairs), dtype=bool), np.zeros(len(pairs), dtype=bool)
    for k in range(1, MAX_GAP_CELLS + 1):
        between = k < count
        place = start + (end - start) * (k / np.maximum(count, 1))[:, None]
        cells = [np.floor((place + tip) / 2).astype(int) for tip in (-_TIP, 0.0, _TIP)]
        states = [partial.state[row, column] for column, row in (cell.T for cell in cells)]
        walled |= between & (states[1] == CellState.WALL)
        free |= between & np.all([state != CellState.UNKNOWN for state in states], axis=0)
    return walled, free


def _end_directions(graph: WallGraph, ends: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Outward unit vectors (V, 2) of wall ends, zero elsewhere, and the cells of straight wall behind them."""
    directions, cells = np.zeros((len(graph.points), 2)), np.zeros(len(graph.points), dtype=np.int64)
    beside = graph.neighbours()
    for end in ends.tolist():
        if len(beside[end]) == 1:
            back = step_back(end, beside[end][0], beside, _LOOK_EDGES)
            vector = (graph.points[end] - graph.points[back[-1]]).astype(float)
            directions[end] = vector / max(float(np.hypot(*vector)), 1.0)
            cells[end] = len(back)
    return directions, cells


def _facing(
    graph: WallGraph,
    pairs: NDArray[np.int64],
    free: NDArray[np.bool_],
    directions: NDArray[np.float64],
    cells: NDArray[np.int64],
    resolution_m: float,
) -> NDArray[np.bool_]:
    """Whether the gap between the points of each pair is one in a seen wall."""
    a, b = pairs.T
    vector = (graph.points[b] - graph.points[a]).astype(float)
    gap_m = (np.abs(vector).max(axis=1, initial=0) / 2 - 1) * resolution_m
    vector /= np.maximum(np.hypot(*vector.T), 1.0)[:, None]
    degree = graph.degree
    ahead = (degree[a] == 0) | ((directions[a] * vector).sum(axis=1) >= _AHEAD_COSINE)
    back = (degree[b] == 0) | ((directions[b] * -vector).sum(axis=1) >= _AHEAD_COSINE)
    to_side = (degree[b] >= 2) & (degree[a] == 1)
    straight = (directions[a] * -directions[b]).sum(axis=1) >= _STRAIGHT_COSINE
    in_line = straight & (np.minimum(cells[a], cells[b]) >= MIN_RUN_CELLS) & (gap_m <= MAX_FREE_GAP_M)
    one_cell = np.abs(graph.points[b] - graph.points[a]).max(axis=1, initial=0) <= 4
    corner = one_cell & (degree[a] <= 1) & (degree[b] <= 1)
    return np.where(free, ahead & back & in_line, corner | (ahead & (back | to_side)))


def _first_come(graph: WallGraph, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Choose bridges: end to end before end to side, short before long, one at an end, two opposed at a lone cell."""
    a, b = pairs.T
    vectors = (graph.points[b] - graph.points[a]).astype(float)
    lengths = np.hypot(*vectors.T)
    degree = graph.degree
    taken: dict[int, list[NDArray[np.float64]]] = {}
    chosen = []
    for k in np.lexsort((b, a, lengths, degree[b] >= 2)).tolist():
        unit = vectors[k] / lengths[k]
        ends = ((int(a[k]), unit), (int(b[k]), -unit))
        if all(_has_room(int(degree[end]), taken.get(end, []), out) for end, out in ends):
            for end, out in ends:
                taken.setdefault(end, []).append(out)
            chosen.append(k)
    return _without_crossings(graph, pairs[chosen])


def _has_room(degree: int, taken: list[NDArray[np.float64]], out: NDArray[np.float64]) -> bool:
    if degree >= 2 or not taken:
        return True
    return degree == 0 and len(taken) == 1 and float(taken[0] @ out) <= _OPPOSED_COSINE


def _without_crossings(graph: WallGraph, bridges: NDArray[np.int64]) -> NDArray[np.int64]:
    if not len(bridges):
        return bridges
    lines = shapely.linestrings(graph.points[np.concatenate([bridges, graph.edges])].astype(float))
    first, second = shapely.STRtree(lines).query(lines[: len(bridges)], predicate="crosses")
    crossing = np.unique(first[(second >= len(bridges)) | (second < first)])
    return np.delete(bridges, crossing, axis=0)
