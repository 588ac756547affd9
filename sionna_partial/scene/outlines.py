"""PartialMap -> wall outlines -> plan for beams.

Outlines are straight segments through the centres of boundary wall cells. Walls of a plan meet only at ends.
"""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sionna_partial.arrays import (
    Bools,
    Floats,
    Indices,
    States,
    canonical,
    counted_near,
    cross,
    row_runs,
    span_in_strip,
)
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.straight_runs import fit_runs
from sionna_partial.maps.wall_cells import CENTRED_NOISE, noise_field, wall_cells
from sionna_partial.process import njit

_KEY = 1 << 32
_LOOK_EDGES = 6
_THROUGH_COSINE = -0.85
_REACH_CELLS, _MORE_REACH_CELLS = 1.0, 1.0
_LAYER_CELLS = 3
_PRIOR_MIDDLES = 10
_OFFSET_CELLS = 1.0
_FACING = 2.0

_WINDOW_M = 2.0
"""Standard deviation of the windows for range noise and for the depth of walls [m]."""

_MIN_SHIFT_CELLS = 0.25

Points = Floats

_SAME_LINE_M = 1e-6
"""Distance from a line within which the ends of collinear walls are [m]."""

_WALLS_PER_CELL = 4.0
"""Mean number of wall pieces in occupied cells of the index."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """Wall outlines in the map's local frame, whose origin is the lower-left corner of the grid.

    Parameters
    ----------
    vertices_m : (V, 2) float64 array
        Ends of the segments [m]. Adjacent segments share a vertex.
    segments : (S, 2) int64 array
        Indices into `vertices_m`. Where just two segments meet, one ends and the other begins.
    """

    vertices_m: Floats
    segments: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Graph:
    """Edges (E, 2) between lattice points (V, 2), x and y in half cells; odd numbers are cell centres."""

    points: NDArray[np.int64]
    edges: NDArray[np.int64]

    @cached_property
    def degree(self) -> Indices:
        return np.bincount(self.edges.ravel(), minlength=len(self.points))


@dataclass(eq=False)
class _FittedChain:
    """A chain of points (n,) of a graph, and the straight runs that fit it.

    Runs have lines (R, 4) of a point x, y and a direction x, y [cells], and begin at `first` (R,). The chain turns at
    the indices `corners`. `plain` (R,) runs keep their corners.
    """

    points: NDArray[np.int64]
    corners: Indices
    first: Indices
    lines: Floats
    plain: Bools

    @property
    def closed(self) -> bool:
        return bool(self.points[0] == self.points[-1])

    @cached_property
    def beside(self) -> tuple[Indices, Indices]:
        k = np.arange(len(self.points))
        before, after = np.searchsorted(self.first, k) - 1, np.searchsorted(self.first, k, side="right") - 1
        if self.closed:
            return before % len(self.first), np.where(k == len(k) - 1, 0, after)
        return np.maximum(before, 0), after


def wall_outlines(partial: PartialMap, *, tolerance_cells: float = 0.5, bridge_gap_m: float = 0.5) -> Outlines:
    """Outline the walls of a map by few straight segments, which meet only at shared vertices.

    A wall one or two cells thick becomes one line, a thicker one its two faces, a lone cell a square. Walls seen from
    one side are outlined there. Ends before UNKNOWN cells reach the border of the last cell. Outlines turn, mirror and
    move with the map, unless it equals its mirror image.

    `tolerance_cells` is the largest distance from the lattice line through the cell centres; from 0.5 on, the
    staircase of a tilted wall becomes one line. Thick walls that are rough there get up to twice as much, and again
    twice for ragged faces (`fit_runs`). Range noise puts cells before and behind walls: lines move to their middle as
    the noise within a few metres grows.
    """
    margin = 1 + int(bridge_gap_m / partial.resolution_m + 1e-6)
    row, column = (np.nonzero((partial.state == CellState.WALL).any(axis=axis))[0] for axis in (1, 0))
    (bottom, top), (left, right) = ((used[0], used[-1]) if len(used) else (0, 0) for used in (row, column))
    padded = np.pad(partial.state, margin, constant_values=CellState.UNKNOWN)
    state, transpose, flips = canonical(padded[bottom : top + 2 * margin + 1, left : right + 2 * margin + 1])

    walls = wall_cells(state, partial.resolution_m, bridge_gap_m)
    graph = _wall_graph(walls.cells, cut_spurs=True)
    shift = _layer_shift(graph.points, walls.peeled)
    column, row = graph.points.T // 2
    tolerances = (1.0 + walls.roughness[row, column]) * tolerance_cells
    chains = [_fitted(graph, shift, points, tolerances[points]) for points in _chains(graph)]
    noise = noise_field(state, partial.resolution_m, (_WINDOW_M, _WINDOW_M))[row, column]
    noisy = np.interp(noise, CENTRED_NOISE, (0.0, 1.0))
    if noisy.any():
        _centre(chains, graph, state, noisy, _WINDOW_M / partial.resolution_m)
    while True:
        lines, runs = _polylines(graph, chains, _REACH_CELLS + _MORE_REACH_CELLS * noisy)
        if not _make_crossing_plain(lines, runs, chains):
            break
    outlines = _assembled(lines, 1.0)
    vertices = _extended(outlines, state)
    vertices = np.where(flips, np.array(state.shape[::-1]) - vertices, vertices)
    vertices = (vertices[:, ::-1] if transpose else vertices) + (np.array([left, bottom], dtype=float) - margin)
    return Outlines(vertices * partial.resolution_m, outlines.segments)


def lattice_outlines(partial: PartialMap) -> Outlines:
    """Outline wall cells without simplification: the staircase through the centres of boundary cells.

    Cells that share a side, or two that share only a corner, are joined, except between full blocks of two by two
    cells: thick walls have only faces. A lone cell is a square.
    """
    graph = _wall_graph(partial.state == CellState.WALL, cut_spurs=False)
    lines = []
    for chain in _chains(graph):
        points = graph.points[chain]
        kept = graph.degree[chain] != 2
        kept[1:-1] |= _turns(points)
        kept[[0, -1]] = True
        lines.append(points[kept] / 2.0)
    return _assembled(lines, partial.resolution_m)


def _wall_graph(wall: Bools, *, cut_spurs: bool) -> _Graph:
    """Connect the centres of boundary wall cells (ny, nx).

    Edges join cells by a side, unless both blocks of two by two cells beside it are full, and by a corner of a block
    with only these two. Spurs of one cell are cut off. Single cells become squares.
    """
    w = np.pad(wall, 1)
    block = w[:-1, :-1] & w[:-1, 1:] & w[1:, :-1] & w[1:, 1:]
    across = w[:, :-1] & w[:, 1:]
    across[1:-1] &= ~(block[:-1] & block[1:])
    upright = w[:-1] & w[1:]
    upright[:, 1:-1] &= ~(block[:, :-1] & block[:, 1:])
    rising = w[:-1, :-1] & w[1:, 1:] & ~w[:-1, 1:] & ~w[1:, :-1]
    falling = ~w[:-1, :-1] & ~w[1:, 1:] & w[:-1, 1:] & w[1:, :-1]
    kinds = ((across, 0, 0, 1, 0), (upright, 0, 0, 0, 1), (rising, 0, 0, 1, 1), (falling, 1, 0, 0, 1))
    parts = [np.argwhere(mask)[:, None, ::-1] + np.reshape(ends, (2, 2)) for mask, *ends in kinds]
    graph = _indexed(2 * np.concatenate(parts) - 1)
    if cut_spurs:
        ends_degree = graph.degree[graph.edges]
        spur = (ends_degree.min(axis=1) == 1) & (ends_degree.max(axis=1) >= 3)
        junction = np.where(ends_degree[:, 0] > ends_degree[:, 1], graph.edges[:, 0], graph.edges[:, 1])
        spurs = np.bincount(junction[spur], minlength=len(graph.points))
        spur &= spurs[junction] < graph.degree[junction]
        graph = _indexed(graph.points[graph.edges[~spur]])
    around = ndimage.convolve(wall.astype(np.uint8), np.ones((3, 3), dtype=np.uint8), mode="constant")
    lone = 2 * np.argwhere(wall & (around == 1))[:, ::-1] + 1
    corners = lone[:, None] + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    squares = np.stack([corners, np.roll(corners, -1, axis=1)], 2).reshape(-1, 2, 2)
    return _indexed(np.concatenate([graph.points[graph.edges], squares]))


def _indexed(ends: NDArray[np.int64]) -> _Graph:
    unique, inverse = np.unique(ends[..., 1].ravel() * _KEY + ends[..., 0].ravel(), return_inverse=True)
    edges = np.sort(inverse.reshape(-1, 2), axis=1)
    edges = np.unique(edges, axis=0) if len(edges) else edges
    return _Graph(np.stack([unique % _KEY, unique // _KEY], 1), edges.astype(np.int64))


def _chains(graph: _Graph) -> list[NDArray[np.int64]]:
    """Split a graph into chains of points (n,) that contain every edge once.

    A chain passes junctions with another edge in about the same direction. Loops start at the point farthest from their
    centre.
    """
    beside: list[list[int]] = [[] for _ in range(len(graph.points))]
    for a, b in graph.edges.tolist():
        beside[a].append(b)
        beside[b].append(a)
    onward = _onward(graph, beside)
    chains: list[NDArray[np.int64]] = []
    used: set[tuple[int, int]] = set()
    starts = [(a, b) for a, near in enumerate(beside) if len(near) != 2 for b in near if (b, a) not in onward]
    for a, b in starts + [(a, b) for a, b in graph.edges.tolist()]:
        if (a, b) in used:
            continue
        points = [a, b]
        while True:
            near = beside[points[-1]]
            if len(near) == 2:
                following: int | None = near[1] if near[0] == points[-2] else near[0]
            else:
                following = onward.get((points[-2], points[-1]))
            if following is None or (points[-1], following) == (a, b):
                break
            points.append(following)
        used.update(pairwise(points))
        used.update(pairwise(points[::-1]))
        if points[0] == points[-1]:
            loop = graph.points[points[:-1]]
            start = int(np.argmax(((loop - loop.mean(axis=0)) ** 2).sum(axis=1)))
            points = points[start:-1] + points[: start + 1]
        chains.append(np.array(points))
    return chains


def _onward(graph: _Graph, beside: list[list[int]]) -> dict[tuple[int, int], int]:
    """Return the continuation of a chain at a junction: (from, junction) -> next point."""
    onward: dict[tuple[int, int], int] = {}
    for junction in np.nonzero(graph.degree > 2)[0].tolist():
        arms, tips = beside[junction], []
        for arm in arms:
            previous, tip, count = junction, arm, 1
            while count < _LOOK_EDGES and len(beside[tip]) == 2:
                a, b = beside[tip]
                previous, tip, count = tip, b if a == previous else a, count + 1
            tips.append(tip)
        vectors = (graph.points[tips] - graph.points[junction]).astype(float)
        vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1.0)
        cosine = vectors @ vectors.T
        for flat in np.argsort(cosine, axis=None, kind="stable").tolist():
            a, b = divmod(flat, len(arms))
            if cosine[a, b] > _THROUGH_COSINE:
                break
            if a < b and (arms[a], junction) not in onward and (arms[b], junction) not in onward:
                onward[arms[a], junction] = arms[b]
                onward[arms[b], junction] = arms[a]
    return onward


def _turns(points: NDArray[np.generic]) -> Bools:
    step = np.diff(points.astype(np.float64), axis=0)
    return cross(step[1:], step[:-1]) != 0.0


def _layer_shift(points: NDArray[np.int64], peeled: Bools) -> Points:
    """Return vectors from lattice points towards the peeled layer of a wall, or zero."""
    peeled = np.pad(peeled, 2)
    column, row = points.T // 2 + 2
    towards = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    beside = np.stack([peeled[row + dy, column + dx] for dx, dy in towards.tolist()], axis=1)
    return beside @ towards / (1 + beside.sum(axis=1, keepdims=True))


def _fitted(graph: _Graph, shift: Points, chain: NDArray[np.int64], tolerances: Floats) -> _FittedChain:
    """Fit straight runs to a chain with tolerances (n,)."""
    points = graph.points[chain] / 2.0
    corners = np.concatenate([[0], np.nonzero(_turns(points))[0] + 1, [len(points) - 1]])
    starts, lines = _fit_turned(points[corners], np.minimum(tolerances[corners[:-1]], tolerances[corners[1:]]))
    first = corners[starts]
    mean = np.add.reduceat(shift[chain], first) / np.diff(np.append(first, len(points)))[:, None]
    normal = np.stack([-lines[:, 3], lines[:, 2]], axis=1)
    offset = (mean * normal).sum(axis=1, keepdims=True)
    lines[:, :2] += np.where(np.abs(offset) > _MIN_SHIFT_CELLS, offset, 0.0) * normal
    is_square = graph.points[chain[0], 0] % 2 == 0
    return _FittedChain(chain, corners, first, lines, np.full(len(lines), is_square))


def _fit_turned(points: Floats, tolerances: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Fit runs that turn and mirror with the polyline: in one of its turns, and on average of both directions."""
    middle, forms = (points[0] + points[-1]) / 2.0, []
    for swap, *signs in itertools.product((False, True), (1.0, -1.0), (1.0, -1.0)):
        turned = (points - middle) * signs + 0.0  # no negative zeros
        turned = np.ascontiguousarray(turned[:, ::-1] if swap else turned)
        forms.append((min(turned.tobytes(), turned[::-1].tobytes()), swap, signs, turned))
    _, swap, signs, turned = min(forms, key=lambda form: form[:1])
    (starts, lines), (after, others) = fit_runs(turned, tolerances), fit_runs(turned[::-1], tolerances[::-1])
    if len(after) == len(starts):
        others = others[::-1]
        along = np.sign((lines[:, 2:] * others[:, 2:]).sum(axis=1, keepdims=True))
        lines = (lines + np.hstack([others[:, :2], along * others[:, 2:]])) / 2.0
        lines[:, 2:] /= np.linalg.norm(lines[:, 2:], axis=1, keepdims=True)
    ends = lines.reshape(-1, 2, 2)
    ends = (ends[..., ::-1] if swap else ends) * signs
    ends[:, 0] += middle
    return starts, ends.reshape(-1, 4)


def _centre(chains: list[_FittedChain], graph: _Graph, state: States, noisy: Floats, deviation: float) -> None:
    """Move lines to the middle of `noisy` walls (V,), 0 to 1, on average over their points.

    Where few points are of walls that are seen from one side, lines move away from FREE cells as far as others within
    the `deviation` of a window [cells].
    """
    middle, (column, row) = _to_middle(graph.points, state), graph.points.T // 2
    free = (state == CellState.FREE).astype(np.float64)
    towards_free = np.stack([ndimage.prewitt(free, axis)[row, column] for axis in (1, 0)], axis=1)
    moves, (distances, counts) = [], np.zeros((2, *state.shape))
    for chain in chains:
        last = np.append(chain.first[1:], len(chain.points) - 1)
        for line, start, end, plain in zip(chain.lines, chain.first, last, chain.plain, strict=True):
            points, normal = chain.points[start : end + 1], np.array([-line[3], line[2]])
            axis = int(abs(normal[1]) > abs(normal[0]))
            offset = middle[points, axis] * normal[axis]
            seen = points[np.isfinite(offset)]
            offset = offset[np.isfinite(offset)]
            if not plain:
                moves.append((line, normal, points, offset))
                np.add.at(distances, (row[seen], column[seen]), np.abs(offset))
                np.add.at(counts, (row[seen], column[seen]), 1.0)
    depth = counted_near(distances, deviation) / (counted_near(counts, deviation) + _PRIOR_MIDDLES)
    for line, normal, points, offset in moves:
        away = -np.clip((towards_free[points] @ normal).mean() / _FACING, -1.0, 1.0) * depth[row, column][points].mean()
        move = (offset.sum() + _PRIOR_MIDDLES * away) / (len(offset) + _PRIOR_MIDDLES)
        line[:2] += noisy[points].mean() * move * normal


def _to_middle(points: NDArray[np.int64], state: States) -> Points:
    """Return vectors along x and y to the middle of the wall between a FREE and an UNKNOWN cell; NaN elsewhere."""
    middle = np.full((2, *state.shape), np.nan)
    for offset, cells in ((middle[0], state), (middle[1].T, state.T)):
        row, start, end = row_runs(cells == CellState.WALL)
        sides = np.sort([cells[row, start - 1], cells[row, end]], axis=0)
        taken = (sides == [[CellState.FREE], [CellState.UNKNOWN]]).all(axis=0) & (end - start <= _LAYER_CELLS)
        for i, a, b in zip(row[taken], start[taken], end[taken], strict=True):
            offset[i, a:b] = (a + b - 1) / 2.0 - np.arange(a, b)
    column, row = points.T // 2
    return np.asarray(middle[:, row, column].T)


def _polylines(graph: _Graph, chains: list[_FittedChain], reach: Floats) -> tuple[list[Points], list[Indices]]:
    nodes = _placed_nodes(graph, chains)
    lines, runs = [], []
    for chain in chains:
        (before, after), plain, last = chain.beside, chain.plain, len(chain.points) - 1
        positions = graph.points[chain.points] / 2.0
        fixed = graph.degree[chain.points] != 2
        breaks = fixed.copy()
        breaks[chain.corners[plain[after[chain.corners]]]] = True
        breaks[np.append(chain.first, last)] = True
        route: list[Points] = []
        owner: list[int] = []
        for k in np.nonzero(breaks)[0].tolist():
            if fixed[k]:
                route.append(nodes[int(chain.points[k])][None])
            elif plain[before[k]] or plain[after[k]]:
                route.append(positions[k][None])
            else:
                route.append(_meeting(chain.lines[[before[k], after[k]]], positions[k], reach[chain.points[k]]))
            owner += [before[k]] * (len(route[-1]) - 1) + [after[k]]
        if chain.closed and not fixed[-1]:
            owner = owner[len(route[0]) - 1 :]
            route[0] = route[-1][-1:]
        lines.append(np.round(np.concatenate(route), 6).astype(np.float64))
        runs.append(np.array(owner[:-1], dtype=np.intp))
    return lines, runs


def _placed_nodes(graph: _Graph, chains: list[_FittedChain]) -> dict[int, Points]:
    """Return chain ends and junctions, closest to the lines that meet there."""
    lines: dict[int, list[Floats]] = {}
    pinned: set[int] = set()
    for chain in chains:
        before, after = chain.beside
        for k in np.nonzero(graph.degree[chain.points] != 2)[0].tolist():
            runs, point = np.unique([before[k], after[k]]), int(chain.points[k])
            lines.setdefault(point, []).extend(chain.lines[runs])
            if chain.plain[runs].any():
                pinned.add(point)
    nodes = {}
    for point, through in lines.items():
        position = graph.points[point] / 2.0
        nodes[point] = position if point in pinned else _closest(np.array(through), position)
    return nodes


def _closest(lines: Floats, near: Points) -> Points:
    """Return the least-squares intersection of lines (k, 4), or the mean foot of `near` if far away."""
    normal = np.stack([-lines[:, 3], lines[:, 2]], axis=1)
    offset = (normal * (lines[:, :2] - near)).sum(axis=1)
    moved = np.linalg.lstsq(normal, offset, rcond=0.05)[0]
    return near + (moved if np.hypot(*moved) <= _REACH_CELLS else (offset[:, None] * normal).mean(axis=0))


def _meeting(pair: Floats, near: Points, reach: float) -> Points:
    direction = pair[:, 2:]
    feet = pair[:, :2] + ((near - pair[:, :2]) * direction).sum(axis=1, keepdims=True) * direction
    if abs(cross(direction[0], direction[1])) > 0.05:
        normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        meeting = np.linalg.solve(normal, (normal * pair[:, :2]).sum(axis=1))
        if np.hypot(*(meeting - near)) <= reach:
            return np.asarray(meeting[None])
    if np.hypot(*(feet[1] - feet[0])) > _OFFSET_CELLS:
        return feet
    return feet.mean(axis=0)[None]


def _make_crossing_plain(lines: list[Points], runs: list[Indices], chains: list[_FittedChain]) -> bool:
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
        found |= not chains[chain].plain[run]
        chains[chain].plain[run] = True
    return found


def _assembled(lines: list[Points], cell_m: float) -> Outlines:
    if not lines:
        return Outlines(np.zeros((0, 2)), np.zeros((0, 2), dtype=np.int64))
    pairs = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
    vertices, inverse = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    along = inverse.reshape(-1, 2)
    segments = along[np.unique(np.sort(along, axis=1), axis=0, return_index=True)[1]]
    segments = segments[segments[:, 0] != segments[:, 1]]
    return Outlines(vertices * cell_m, segments.astype(np.int64))


def _extended(outlines: Outlines, state: States) -> Points:
    """Return vertices, with ends before UNKNOWN cells moved to the border of the last cell."""
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


def cut_by_material(outlines: Outlines, partial: PartialMap) -> tuple[Outlines, Indices]:
    """Cut outlines where the material of the wall cells changes, and sort them by material (S,).

    A point has the material of the nearest wall cell; pieces shorter than a cell, the material of a neighbour.
    """
    count = len(outlines.segments)
    if partial.wall_material is None or not count:
        return outlines, np.zeros(count, np.intp)
    _, (row, column) = ndimage.distance_transform_edt(partial.state != CellState.WALL, return_indices=True)
    nearest, cell_m, last = partial.wall_material[row, column], partial.resolution_m, np.array(partial.shape)[::-1] - 1
    vertices, material = [*outlines.vertices_m], list[int]()
    segments = list[tuple[int, int]]()
    for first, end in outlines.segments.tolist():
        start, along = vertices[first], vertices[end] - vertices[first]
        pieces = max(1, math.ceil(4.0 * np.hypot(*along) / cell_m))
        middles = start + (np.arange(pieces)[:, None] + 0.5) / pieces * along
        x, y = np.clip(np.floor(middles / cell_m).astype(np.intp), 0, last).T
        runs: list[tuple[int, int]] = []  # first piece and material
        bounds = np.append(np.flatnonzero(np.diff(nearest[y, x])) + 1, pieces)
        for begin, stop in pairwise([0, *bounds.tolist()]):
            kind = int(nearest[y[begin], x[begin]])
            if not runs or (stop - begin >= min(4, pieces) and kind != runs[-1][1]):
                runs.append((begin, kind))
        if len(runs) > 1 and runs[1][0] < 4:
            runs[:2] = [(0, runs[1][1])]
        ends = [first]
        for begin, _ in runs[1:]:
            ends.append(len(vertices))
            vertices.append(start + begin / pieces * along)
        segments += pairwise([*ends, end])
        material += [kind for _, kind in runs]
    order = np.argsort(material, kind="stable")
    return Outlines(np.array(vertices), np.array(segments, np.int64)[order]), np.array(material, np.intp)[order]


class WallIndex(NamedTuple):
    """Index of the wall pieces that may cross each cell of a square grid, row by row.

    `grid` (5,) is the corner x0, y0 and the edge of cells [m], and the numbers of columns and rows. Cell b has the
    pieces `piece[start[b] : start[b + 1]]`.
    """

    grid: Floats
    start: NDArray[np.int64]
    piece: NDArray[np.int32]


class Plan(NamedTuple):
    """Walls of a floor plan, cut where they cross.

    Pieces have end points `pieces_m` (K, 2, 2) [m], wall segments `owner` (K,), numbers of infinite lines `line` (K,),
    and `low` (K,) where they end below the ceiling.
    """

    pieces_m: Floats
    owner: NDArray[np.int32]
    line: NDArray[np.int32]
    low: Bools
    cells: WallIndex


class PointBins(NamedTuple):
    """Points (N, 2) [m] sorted into square bins, row by row.

    `order` (N,) are the indices before sorting, `start` (B + 1,) the first point of each bin, `grid` (4,) the corner
    x0, y0 and the edge of bins [m], and the number of columns.
    """

    points_m: Floats
    order: NDArray[np.int64]
    start: NDArray[np.int64]
    grid: Floats


def prepare_plan(walls_m: Floats, low: Bools | None = None) -> Plan:
    """Cut walls (S, 2, 2) [m], some of them `low` (S,), where they cross, and find collinear ones."""
    pieces_m, owner = _split_at_crossings(walls_m)
    low = np.zeros(len(walls_m), dtype=np.bool_) if low is None else low
    return Plan(pieces_m, owner, _line_ids(pieces_m), low[owner], _index(pieces_m))


def bin_points(points_m: Floats) -> PointBins:
    """Sort points (N, 2) [m] into bins of a few."""
    if len(points_m) == 0:
        return PointBins(points_m, np.zeros(0, np.int64), np.zeros(2, np.int64), np.array([0.0, 0.0, 1.0, 1.0]))
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    edge = max(0.05, float(np.sqrt(np.prod(high - low + 1e-3) / len(points_m))) * 2.0, float((high - low).max()) / 2000)
    columns, rows = np.floor((high - low) / edge).astype(np.int64) + 1
    cell = np.floor((points_m - low) / edge).astype(np.int64)
    index = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(index, kind="stable")
    start = np.searchsorted(index[order], np.arange(rows * columns + 1))
    return PointBins(points_m[order], order, start, np.array([low[0], low[1], edge, columns]))


@njit(cache=True)
def grow(array, size):
    """Return the array, enlarged if it has fewer than `size` rows."""
    if size <= array.shape[0]:
        return array
    larger = np.empty((max(size, 2 * array.shape[0]),) + array.shape[1:], array.dtype)  # noqa: RUF005 (numba)
    for index in np.ndindex(array.shape):
        larger[index] = array[index]
    return larger


def _split_at_crossings(walls: Floats) -> tuple[Floats, NDArray[np.int32]]:
    """Cut segments where they cross; return pieces (K, 2, 2) that meet only at ends, and owners (K,)."""
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    lines = shapely.linestrings(walls)
    own, other = shapely.STRtree(lines).query(lines, predicate="intersects")
    area = cross(along[own], along[other])
    area[np.abs(area) < 1e-12] = np.inf
    away = start[other] - start[own]
    u, v = cross(away, along[other]) / area, cross(away, along[own]) / area
    crossed = (u > 1e-9) & (u < 1.0 - 1e-9) & (v > 1e-9) & (v < 1.0 - 1e-9)
    owner = np.concatenate([np.repeat(np.arange(len(walls)), 2), own[crossed]])
    fraction = np.concatenate([np.tile([0.0, 1.0], len(walls)), u[crossed]])
    order = np.lexsort([fraction, owner])
    owner, fraction = owner[order], fraction[order, None]
    ends = np.where(fraction < 1.0, start[owner] + fraction * along[owner], walls[owner, 1])
    piece = np.flatnonzero(owner[:-1] == owner[1:])
    return np.stack([ends[piece], ends[piece + 1]], axis=1), owner[piece].astype(np.int32)


def _line_ids(walls: Floats) -> NDArray[np.int32]:
    """Return numbers of infinite lines; collinear segments share one."""
    if len(walls) == 0:
        return np.zeros(0, np.int32)
    along = walls[:, 1] - walls[:, 0]
    length = np.hypot(*along.T)
    angle = np.arctan2(along[:, 1], along[:, 0])
    middle = walls.mean(axis=(0, 1))
    span = float(np.abs(walls - middle).max()) + 1.0
    offset = cross(along, walls[:, 0] - middle) / length
    flip = np.cos(angle) + 1e-3 * np.sin(angle) < 0.0  # one of the two directions of a line
    normal = np.column_stack([np.cos(2 * angle) * span, np.sin(2 * angle) * span, np.where(flip, -offset, offset)])
    first, second = cKDTree(normal).query_pairs(0.1, output_type="ndarray").T
    away = np.abs(cross(along[first, None], walls[second] - walls[first, :1])) / length[first, None]
    back = np.abs(cross(along[second, None], walls[first] - walls[second, :1])) / length[second, None]
    same = (away < _SAME_LINE_M).all(axis=1) & (back < _SAME_LINE_M).all(axis=1)
    pairs = coo_array((np.ones(same.sum()), (first[same], second[same])), shape=(len(walls),) * 2)
    return np.asarray(connected_components(pairs, directed=False)[1], dtype=np.int32)


def _index(walls: Floats) -> WallIndex:
    if len(walls) == 0:
        return WallIndex(np.array([0.0, 0.0, 1.0, 1.0, 1.0]), np.zeros(2, np.int64), np.zeros(0, np.int32))
    low, high = walls.min(axis=(0, 1)), walls.max(axis=(0, 1))
    length = float(np.hypot(*(walls[:, 1] - walls[:, 0]).T).sum())
    edge = max(0.05, length * _WALLS_PER_CELL / len(walls) / 2.0, float((high - low).max()) / 1000)
    columns, rows = np.floor((high - low) / edge).astype(np.int64) + 1
    grid = np.array([low[0], low[1], edge, columns, rows])
    cell, piece = _cells_of(walls, grid)
    order = np.argsort(cell, kind="stable")
    start = np.searchsorted(cell[order], np.arange(rows * columns + 1))
    return WallIndex(grid, start, piece[order])


@njit(cache=True)
def _cells_of(walls, grid):
    x0, y0, edge, columns, rows = grid[0], grid[1], grid[2], int(grid[3]), int(grid[4])
    cell, piece, count = np.empty(1024, np.int64), np.empty(1024, np.int32), np.int64(0)
    for i in range(len(walls)):
        low, high = min(walls[i, 0, 1], walls[i, 1, 1]), max(walls[i, 0, 1], walls[i, 1, 1])
        first = max(0, int(np.floor((low - y0) / edge - 1e-6)))
        last = min(rows - 1, int(np.floor((high - y0) / edge + 1e-6)))
        for row in range(first, last + 1):
            left, right = span_in_strip(walls[i], y0 + (row - 1e-6) * edge, y0 + (row + 1 + 1e-6) * edge)
            start = max(0, int(np.floor((left - x0) / edge - 1e-6)))
            stop = min(columns - 1, int(np.floor((right - x0) / edge + 1e-6)))
            cell, piece = grow(cell, count + columns), grow(piece, count + columns)
            for column in range(start, stop + 1):
                cell[count], piece[count] = row * columns + column, i
                count += 1
    return cell[:count], piece[:count]
