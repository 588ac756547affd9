"""PartialMap -> wall outlines: few straight segments through the centres of the boundary wall cells."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.graph import wall_graph
from sionna_partial.scene.lines import fit_runs
from sionna_partial.scene.polylines import Chain, WallGraph, turns, wall_chains
from sionna_partial.scene.wall_cells import wall_cells

_REACH_CELLS = 1.0
_OFFSET_CELLS = 1.0
_MIN_SHIFT_CELLS = 0.25


@dataclass(frozen=True, eq=False)
class Outlines:
    """Wall outlines in the map's local frame, whose origin is the lower-left corner of the grid.

    Parameters
    ----------
    vertices_m : (V, 2) float64 array
        Ends of the segments [m]. Segments that meet share a vertex; every vertex is used.
    segments : (S, 2) int64 array
        Indices into `vertices_m` of the two ends of every segment. Where just two segments meet, one ends and the other
        begins.
    """

    vertices_m: NDArray[np.float64]
    segments: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Fit:
    """A chain's corners (n,), as indices into its points, and the straight runs between them."""

    corners: NDArray[np.int64]
    starts: NDArray[np.int64]
    lines: NDArray[np.float64]


def wall_outlines(partial: PartialMap, *, tolerance_cells: float = 0.5, bridge_gap_m: float = 0.5) -> Outlines:
    """Outline the walls of a map.

    A wall one or two cells thick becomes one line, a thicker one its two faces, a lone cell a square. Of a wall that
    was seen from one side, the face on that side is outlined. Only WALL cells, and short gaps between them, bear
    outlines. An end that UNKNOWN cells follow reaches the border of the last cell. A map that is turned, mirrored,
    padded with UNKNOWN cells or moved has the same outlines, transformed; only where a map equals its own mirror image
    may they depend on the orientation.

    Parameters
    ----------
    partial : PartialMap
    tolerance_cells : float
        Largest distance of an outline from the lattice line through the cell centres [cells]. From 0.5 on, the
        staircase of a tilted wall becomes one straight line. Up to twice as much is allowed on maps whose walls range
        noise made thick and rough, and again twice as much where a face turns to and fro at least once in 10 cells.
    bridge_gap_m : float
        Longest gap of UNKNOWN cells in a seen wall that is closed [m].

    Returns
    -------
    Outlines
        Segments meet only at shared vertices.
    """
    state, corner = _crop(partial.state, 1 + int(bridge_gap_m / partial.resolution_m + 1e-6))
    turned, turn = _canonical(state)
    cells = assemble(_lines(PartialMap(turned, partial.resolution_m), tolerance_cells, bridge_gap_m), 1.0)
    vertices = turn.back(_extended(cells, turned)) + corner
    return Outlines(vertices * partial.resolution_m, cells.segments)


def _extended(outlines: Outlines, state: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Vertices [cells], with ends that UNKNOWN cells follow moved from the centre of the last cell to its border."""
    vertices, segments = outlines.vertices_m.copy(), outlines.segments
    ends, tails = segments.ravel(), segments[:, ::-1].ravel()
    along = vertices[ends] - vertices[tails]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    column, row = np.clip(np.floor(vertices[ends] + along).astype(int), 0, np.array(state.shape)[::-1] - 1).T
    is_open = (np.bincount(ends)[ends] == 1) & (state[row, column] == CellState.UNKNOWN)
    tips = shapely.linestrings(np.stack([vertices[ends], vertices[ends] + 0.5 * along], axis=1)[is_open])
    index = np.nonzero(is_open)[0]
    tip, line = shapely.STRtree(np.append(shapely.linestrings(vertices[segments]), tips)).query(tips, "intersects")
    own = (line == index[tip] // 2) | (line == len(segments) + tip)
    index = np.delete(index, tip[~own])
    vertices[ends[index]] += 0.5 * along[index]
    return vertices


def _lines(partial: PartialMap, tolerance_cells: float, bridge_gap_m: float) -> list[NDArray[np.float64]]:
    """Polylines (n, 2) [cells] that meet only at equal vertices."""
    walls = wall_cells(partial, bridge_gap_m)
    graph = wall_graph(walls.cells)
    chains = wall_chains(graph)
    places, shift = graph.points / 2.0, _layer_shift(graph.points, walls.peeled)
    fits = [_fit(places, shift, chain, (1.0 + walls.noise) * tolerance_cells) for chain in chains]
    plain = [np.full(len(f.lines), graph.points[c.points[0], 0] % 2 == 0) for c, f in zip(chains, fits, strict=True)]
    while True:
        lines, runs = _polylines(graph, places, chains, fits, plain)
        if not _keep_crossing(lines, runs, plain):
            return lines


def _crop(state: NDArray[np.uint8], margin: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Cut cells to the walls and a margin around, and return where the lower-left corner was [cells]."""
    row, column = (np.nonzero((state == CellState.WALL).any(axis=axis))[0] for axis in (1, 0))
    (bottom, top), (left, right) = ((used[0], used[-1]) if len(used) else (0, 0) for used in (row, column))
    padded = np.pad(state, margin, constant_values=CellState.UNKNOWN)
    part = padded[bottom : top + 2 * margin + 1, left : right + 2 * margin + 1]
    return part, np.array([left, bottom], dtype=float) - margin


@dataclass(frozen=True)
class _Turn:
    """Transposes a grid or not, then flips rows and columns or not."""

    transpose: bool
    flips: tuple[bool, bool]
    shape: tuple[int, int]

    def apply(self, state: NDArray[np.uint8]) -> NDArray[np.uint8]:
        turned = state.T if self.transpose else state
        return np.ascontiguousarray(turned[:: -1 if self.flips[0] else 1, :: -1 if self.flips[1] else 1])

    def back(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 2) of the turned grid, in the original one."""
        height, width = self.shape[::-1] if self.transpose else self.shape
        flipped = np.where(self.flips[::-1], np.array([width, height]) - points, points)
        return flipped[:, ::-1] if self.transpose else flipped


def _canonical(state: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], _Turn]:
    """Turn or mirror a grid to its one orientation of the smallest bytes: the outlines turn with the map."""
    turns = [_Turn(t, (r, c), state.shape) for t in (False, True) for r in (False, True) for c in (False, True)]
    turned = [turn.apply(state) for turn in turns]
    best = min(range(8), key=lambda k: (turned[k].shape, turned[k].tobytes()))
    return turned[best], turns[best]


def _layer_shift(points: NDArray[np.int64], peeled: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Vectors [cells] from lattice points towards the layer that was peeled off a wall two cells thick, or zero."""
    peeled = np.pad(peeled, 2)
    column, row = points.T // 2 + 2
    towards = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    beside = np.stack([peeled[row + dy, column + dx] for dx, dy in towards.tolist()], axis=1)
    return beside @ towards / (1 + beside.sum(axis=1, keepdims=True))


def _fit(places: NDArray[np.float64], shift: NDArray[np.float64], chain: Chain, tolerance: float) -> _Fit:
    """Straight runs of a chain, moved to the middle of walls two cells thick."""
    points = places[chain.points]
    corners = np.concatenate([[0], np.nonzero(turns(points))[0] + 1, [len(points) - 1]])
    starts, lines = fit_runs(points[corners], tolerance)
    first = corners[starts]
    mean = np.add.reduceat(shift[chain.points], first) / np.diff(np.append(first, len(points)))[:, None]
    normal = np.stack([-lines[:, 3], lines[:, 2]], axis=1)
    offset = (mean * normal).sum(axis=1, keepdims=True)
    lines[:, :2] += np.where(np.abs(offset) > _MIN_SHIFT_CELLS, offset, 0.0) * normal
    return _Fit(corners, starts, lines)


def _polylines(
    graph: WallGraph,
    places: NDArray[np.float64],
    chains: list[Chain],
    fits: list[_Fit],
    plain: list[NDArray[np.bool_]],
) -> tuple[list[NDArray[np.float64]], list[NDArray[np.int64]]]:
    """Vertices [cells] of every chain, and the run that each of its segments belongs to.

    Runs that are `plain` (squares, and where lines would cross) keep their corners.
    """
    nodes = _place_nodes(graph, places, chains, fits, plain)
    lines, runs = [], []
    for chain, fit, keep in zip(chains, fits, plain, strict=True):
        before, after = _runs_beside(fit, chain, np.arange(len(chain.points)))
        fixed = np.array([point in nodes for point in chain.points])
        breaks = fixed.copy()
        breaks[fit.corners[keep[after[fit.corners]]]] = True
        breaks[np.append(fit.corners[fit.starts], len(chain.points) - 1)] = True
        route, owner = [], []
        for k in np.nonzero(breaks)[0].tolist():
            if fixed[k]:
                route.append(nodes[chain.points[k]][None])
            elif keep[before[k]] or keep[after[k]]:
                route.append(places[chain.points[k]][None])
            else:
                route.append(_meet(fit.lines[[before[k], after[k]]], places[chain.points[k]]))
            owner += [before[k]] * (len(route[-1]) - 1) + [after[k]]
        if chain.closed and not fixed[-1]:
            owner = owner[len(route[0]) - 1 :]
            route[0] = route[-1][-1:]
        lines.append(np.round(np.concatenate(route), 6).astype(np.float64))
        runs.append(np.array(owner[:-1], dtype=np.int64))
    return lines, runs


def _runs_beside(fit: _Fit, chain: Chain, k: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find the runs of a chain before and after its points k."""
    first = fit.corners[fit.starts]
    before, after = np.searchsorted(first, k) - 1, np.searchsorted(first, k, side="right") - 1
    if chain.closed:
        return before % len(first), np.where(k == len(chain.points) - 1, 0, after)
    return np.maximum(before, 0), after


def _place_nodes(
    graph: WallGraph,
    places: NDArray[np.float64],
    chains: list[Chain],
    fits: list[_Fit],
    plain: list[NDArray[np.bool_]],
) -> dict[int, NDArray[np.float64]]:
    """Places [cells] of chain ends and junctions: where the lines that meet there come closest."""
    is_node = graph.degree != 2
    lines: dict[int, list[NDArray[np.float64]]] = {}
    pinned: set[int] = set()
    for chain, fit, keep in zip(chains, fits, plain, strict=True):
        before, after = _runs_beside(fit, chain, np.arange(len(chain.points)))
        for k in np.nonzero(is_node[chain.points])[0].tolist():
            runs = np.unique([before[k], after[k]])
            lines.setdefault(chain.points[k], []).extend(fit.lines[runs])
            if keep[runs].any():
                pinned.add(chain.points[k])
    return {
        point: places[point] if point in pinned else _closest(np.array(through), places[point])
        for point, through in lines.items()
    }


def _closest(lines: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Point of least squared distance to lines (k, 4), or the middle of the feet of `place` if that is far away."""
    normal = np.stack([-lines[:, 3], lines[:, 2]], axis=1)
    offset = (normal * (lines[:, :2] - place)).sum(axis=1)
    moved = np.linalg.lstsq(normal, offset, rcond=0.05)[0]
    return place + (moved if np.hypot(*moved) <= _REACH_CELLS else (offset[:, None] * normal).mean(axis=0))


def _meet(pair: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vertices (1 or 2, 2) where two runs with lines (2, 4) meet near a point."""
    direction = pair[:, 2:]
    cross = direction[0, 0] * direction[1, 1] - direction[0, 1] * direction[1, 0]
    feet = pair[:, :2] + ((place - pair[:, :2]) * direction).sum(axis=1, keepdims=True) * direction
    if abs(cross) > 0.05:
        normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        meeting = np.linalg.solve(normal, (normal * pair[:, :2]).sum(axis=1))
        if np.hypot(*(meeting - place)) <= _REACH_CELLS:
            return meeting[None]
    if np.hypot(*(feet[1] - feet[0])) > _OFFSET_CELLS:
        return feet
    return feet.mean(axis=0)[None]


def _keep_crossing(
    lines: list[NDArray[np.float64]], runs: list[NDArray[np.int64]], plain: list[NDArray[np.bool_]]
) -> bool:
    """Make runs plain whose segments meet others away from a shared vertex; say whether there were any."""
    if not lines:
        return False
    pairs = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
    owner = np.repeat(np.arange(len(lines)), [len(line) - 1 for line in lines])
    owner = np.stack([owner, np.concatenate(runs)], axis=1)
    length = (pairs[:, 0] != pairs[:, 1]).any(axis=1)
    owner, pairs = owner[length], pairs[length]
    segments = shapely.linestrings(pairs)
    first, second = shapely.STRtree(segments).query(segments, predicate="intersects")
    first, second = first[first < second], second[first < second]
    same = (pairs[first][:, :, None] == pairs[second][:, None]).all(axis=3).any(axis=(1, 2))
    touch = shapely.intersection(segments[first], segments[second])
    bad = ~same | (shapely.get_type_id(touch) != 0)
    found = False
    for chain, run in owner[np.unique([first[bad], second[bad]])].tolist():
        found |= not plain[chain][run]
        plain[chain][run] = True
    return found


def assemble(lines: list[NDArray[np.float64]], resolution_m: float) -> Outlines:
    """Join polylines (n, 2) [cells] whose segments meet only at equal vertices."""
    if not lines:
        return Outlines(np.zeros((0, 2)), np.zeros((0, 2), dtype=np.int64))
    pairs = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
    vertices, inverse = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    along = inverse.reshape(-1, 2)
    segments = along[np.unique(np.sort(along, axis=1), axis=0, return_index=True)[1]]
    segments = segments[segments[:, 0] != segments[:, 1]]
    return Outlines(vertices * resolution_m, segments.astype(np.int64))
