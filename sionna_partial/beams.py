"""Exact specular candidates of an extruded floor plan, by beam tracing in the plan.

A wall of full height reflects a path in the plan just as a line does, so which chains of walls can join a transmitter
to a receiver is a question in two dimensions. From the image of the transmitter, the visible walls split the view
into beams; each beam reflects about its wall, and the receivers inside a beam are the only ones that its chain of
walls can reach. Floor and ceiling follow analytically, by unfolding the height.

Coordinates inside a beam: with the image source S and the window from A to B, a point is S + r ((1 - t)(A - S) +
t (B - S)). The window is r = 1, t runs over the beam from 0 to 1, and on any line 1 / r is linear in t, so the nearest
wall is the upper envelope of straight segments in (t, 1 / r).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

FLOOR = -2
"""Surface index of the floor in a candidate."""

CEILING = -3
"""Surface index of the ceiling in a candidate."""

TOLERANCE_M = 1e-4
"""Width by which beams are widened [m]: transmitter, receivers and corners share one lattice, and the solver that
checks the candidates computes in single precision."""

_ROOT_ANGLE_RAD = 0.1234567
"""Direction of the first root beam [rad]: no wall of a lattice map is parallel to it."""


@dataclass(frozen=True)
class Beams:
    """All (chain of walls, receiver) pairs that a specular path can join.

    Nodes form a tree: a node is one beam, its chain the walls from the root down to it.

    Parameters
    ----------
    parent, segment : (M,) int32 arrays
        Parent node (-1 at the roots) and the wall segment that reflected the beam.
    source : (M, 2) float64 array
        Image of the transmitter [m].
    pair_node, pair_rx : (K,) int32 arrays
        The pairs, ordered by chain and then by receiver, each chain of wall lines once for a receiver.
    """

    parent: NDArray[np.int32]
    segment: NDArray[np.int32]
    source: NDArray[np.float64]
    pair_node: NDArray[np.int32]
    pair_rx: NDArray[np.int32]


@dataclass(frozen=True)
class SpecularCandidates:
    """Geometrically possible paths, to be verified by the path solver.

    Parameters
    ----------
    rx : (C,) int32 array
        Receiver of each candidate.
    surface : (C, D) int32 array
        Wall segment (>= 0), FLOOR or CEILING of every bounce in order from the transmitter; -1 where there is none.
    vertices_m : (C, D, 3) float64 array
        Points of reflection [m].
    """

    rx: NDArray[np.int32]
    surface: NDArray[np.int32]
    vertices_m: NDArray[np.float64]


def trace_beams(
    walls_m: NDArray[np.float64], tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], max_depth: int
) -> Beams:
    """Find every chain of at most `max_depth` walls and the receivers it can reach, seen from above.

    Parameters
    ----------
    walls_m : (S, 2, 2) array
        End points of the wall segments [m].
    tx_m : (2,) array
        Transmitter [m].
    rx_m : (N, 2) array
        Receivers [m].
    max_depth : int
        Largest number of wall reflections.
    """
    pieces_m, owner = _split_at_crossings(walls_m)
    line = _line_ids(pieces_m)
    order, bins, grid = _bin_points(rx_m)
    parent, piece, depth, source, pair_node, pair_rx = _trace_beams(
        pieces_m, line, tx_m, max_depth, np.ascontiguousarray(rx_m[order]), bins, grid
    )
    chain = _chain_ids(parent, np.append(line, -1)[piece], depth)
    pair_rx = order[pair_rx].astype(np.int32)
    _, first = np.unique(chain[pair_node] * max(1, len(rx_m)) + pair_rx, return_index=True)
    return Beams(parent, np.append(owner, -1)[piece].astype(np.int32), source, pair_node[first], pair_rx[first])


def specular_candidates(
    beams: Beams,
    walls_m: NDArray[np.float64],
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    *,
    height_m: float,
    horizontal: bool,
    max_depth: int,
    pairs_per_block: int = 40_000,
) -> Iterator[tuple[SpecularCandidates, float]]:
    """Add the reflections off floor and ceiling, block by block.

    Parameters
    ----------
    beams : Beams
        Result of `trace_beams` for the same plan.
    walls_m : (S, 2, 2) array
        End points of the wall segments [m].
    tx_m, rx_m : (3,) and (N, 3) arrays
        Transmitter and receivers [m], between floor (z = 0) and ceiling.
    height_m : float
        Height of the ceiling [m].
    horizontal : bool
        Whether there are floor and ceiling at all.
    max_depth : int
        Largest number of interactions of a path.
    pairs_per_block : int
        Number of pairs in a block, which bounds the memory.

    Yields
    ------
    SpecularCandidates
    float
        Share of all pairs done with this block.
    """
    for start in range(0, len(beams.pair_node), pairs_per_block):
        stop = min(start + pairs_per_block, len(beams.pair_node))
        candidates = SpecularCandidates(
            *_expand_heights(
                beams.parent,
                beams.segment,
                beams.source,
                beams.pair_node[start:stop],
                beams.pair_rx[start:stop],
                walls_m,
                tx_m,
                rx_m,
                height_m,
                horizontal,
                max_depth,
            )
        )
        yield candidates, stop / len(beams.pair_node)


def _bin_points(points: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.float64]]:
    """Sort points into square bins: their order, the start of each bin (row by row), and (x0, y0, edge, columns)."""
    if len(points) == 0:
        return np.zeros(0, np.intp), np.zeros(2, np.int64), np.array([0.0, 0.0, 1.0, 1.0])
    low, high = points.min(axis=0), points.max(axis=0)
    edge = max(0.05, float(np.sqrt(np.prod(high - low + 1e-3) / len(points))) * 2.0, float((high - low).max()) / 2000)
    columns, rows = np.floor((high - low) / edge).astype(np.int64) + 1
    cell = np.floor((points - low) / edge).astype(np.int64)
    index = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(index, kind="stable")
    bins = np.searchsorted(index[order], np.arange(rows * columns + 1))
    return order, bins, np.array([low[0], low[1], edge, columns])


def _chain_ids(parent: NDArray[np.int32], line: NDArray[np.int32], depth: NDArray[np.int32]) -> NDArray[np.int64]:
    """Number the chains of wall lines, so that beams split by a gap in one line share a number."""
    chain = np.zeros(len(parent), np.int64)
    lines = int(line.max(initial=0)) + 1
    used = 1
    for level in range(1, int(depth.max(initial=0)) + 1):
        nodes = np.flatnonzero(depth == level)
        _, number = np.unique(chain[parent[nodes]] * lines + line[nodes], return_inverse=True)
        chain[nodes] = used + number
        used += int(number.max(initial=-1)) + 1
    return chain


@njit(cache=True)
def _split_at_crossings(walls):  # type: ignore[no-untyped-def]
    """Cut segments where others cross them: the pieces (K, 2, 2), which meet only at ends, and their owners (K,)."""
    pieces, owner, count = np.empty((2 * len(walls) + 1, 2, 2)), np.empty(2 * len(walls) + 1, np.int32), 0
    cut = np.empty(len(walls) + 2)
    for i in range(len(walls)):
        ax, ay = walls[i, 1, 0] - walls[i, 0, 0], walls[i, 1, 1] - walls[i, 0, 1]
        cut[0], cut[1], cuts = 0.0, 1.0, 2
        for j in range(len(walls)):
            bx, by = walls[j, 1, 0] - walls[j, 0, 0], walls[j, 1, 1] - walls[j, 0, 1]
            cx, cy = walls[j, 0, 0] - walls[i, 0, 0], walls[j, 0, 1] - walls[i, 0, 1]
            area = ax * by - ay * bx
            if i == j or abs(area) < 1e-12:
                continue
            u, v = (cx * by - cy * bx) / area, (cx * ay - cy * ax) / area
            if 1e-9 < u < 1.0 - 1e-9 and 1e-9 < v < 1.0 - 1e-9:
                cut[cuts] = u
                cuts += 1
        places = np.sort(cut[:cuts])
        pieces, owner = _grow(pieces, count + cuts), _grow(owner, count + cuts)
        for k in range(cuts - 1):
            for end in range(2):
                u = places[k + end]
                pieces[count, end, 0] = walls[i, 0, 0] + u * ax if u < 1.0 else walls[i, 1, 0]
                pieces[count, end, 1] = walls[i, 0, 1] + u * ay if u < 1.0 else walls[i, 1, 1]
            owner[count] = i
            count += 1
    return pieces[:count].copy(), owner[:count].copy()


@njit(cache=True)
def _line_ids(walls):  # type: ignore[no-untyped-def]
    """Number the infinite lines that the segments lie on; collinear segments share one."""
    count = walls.shape[0]
    line = np.full(count, -1, np.int32)
    used = 0
    for i in range(count):
        if line[i] >= 0:
            continue
        line[i] = used
        px, py = walls[i, 0, 0], walls[i, 0, 1]
        dx, dy = walls[i, 1, 0] - px, walls[i, 1, 1] - py
        length = np.hypot(dx, dy)
        for j in range(i + 1, count):
            if line[j] >= 0:
                continue
            near = True
            for end in range(2):
                away = (dx * (walls[j, end, 1] - py) - dy * (walls[j, end, 0] - px)) / length
                near = near and abs(away) < 1e-6
            if near:
                line[j] = used
        used += 1
    return line


@njit(cache=True)
def _grow(array, size):  # type: ignore[no-untyped-def]
    """Return the array, enlarged to hold `size` rows if it does not."""
    if size <= array.shape[0]:
        return array
    larger = np.empty((max(size, 2 * array.shape[0]),) + array.shape[1:], array.dtype)
    larger[: array.shape[0]] = array
    return larger


@njit(cache=True)
def _trace_beams(walls, line, tx, max_depth, points, bins, grid):  # type: ignore[no-untyped-def]
    """Breadth-first beam tree and the points inside each beam (see `trace_beams`)."""
    beam = np.empty((1024, 6))
    parent, segment, depth = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024, np.int32)
    count = 4
    for quadrant in range(4):
        low = _ROOT_ANGLE_RAD + 0.5 * np.pi * quadrant
        high = low + 0.5 * np.pi
        beam[quadrant] = (
            tx[0],
            tx[1],
            tx[0] + np.cos(low),
            tx[1] + np.sin(low),
            tx[0] + np.cos(high),
            tx[1] + np.sin(high),
        )
        parent[quadrant], segment[quadrant], depth[quadrant] = -1, -1, 0
    pair_node, pair_rx, pairs = np.empty(4096, np.int32), np.empty(4096, np.int32), 0
    piece = np.empty((2 * len(walls) + 3, 4))
    piece_wall = np.empty(2 * len(walls) + 3, np.int32)
    node = 0
    while node < count:
        pieces = _visible_pieces(walls, line, beam[node], segment[node], piece, piece_wall)
        for i in range(pieces):
            found = _points_in_piece(beam[node], segment[node] >= 0, piece[i], points, bins, grid)
            pair_node, pair_rx = _grow(pair_node, pairs + len(found)), _grow(pair_rx, pairs + len(found))
            pair_node[pairs : pairs + len(found)] = node
            pair_rx[pairs : pairs + len(found)] = found
            pairs += len(found)
            if piece_wall[i] < 0 or depth[node] == max_depth:
                continue
            beam, parent = _grow(beam, count + 1), _grow(parent, count + 1)
            segment, depth = _grow(segment, count + 1), _grow(depth, count + 1)
            if _reflect(beam[node], piece[i], walls[piece_wall[i]], beam[count]):
                parent[count], segment[count], depth[count] = node, piece_wall[i], depth[node] + 1
                count += 1
        node += 1
    return (
        parent[:count].copy(),
        segment[:count].copy(),
        depth[:count].copy(),
        beam[:count, :2].copy(),
        pair_node[:pairs].copy(),
        pair_rx[:pairs].copy(),
    )


@njit(cache=True)
def _clip(beam, wall, reflected):  # type: ignore[no-untyped-def]
    """Part of a wall inside a beam and beyond its window, as (t0, w0, t1, w1) with w = 1 / r and t0 < t1.

    Returns t0 >= t1 if there is none.
    """
    ax, ay = beam[2] - beam[0], beam[3] - beam[1]
    bx, by = beam[4] - beam[0], beam[5] - beam[1]
    area = ax * by - ay * bx
    px, py = wall[0, 0] - beam[0], wall[0, 1] - beam[1]
    qx, qy = wall[1, 0] - beam[0], wall[1, 1] - beam[1]
    alpha0, beta0 = (px * by - py * bx) / area, (ax * py - ay * px) / area
    alpha1, beta1 = (qx * by - qy * bx) / area, (ax * qy - ay * qx) / area
    nearest = 1.0 + 1e-9 if reflected else 1e-9
    low, high = 0.0, 1.0
    for start, stop in ((alpha0, alpha1), (beta0, beta1), (alpha0 + beta0 - nearest, alpha1 + beta1 - nearest)):
        if start < 0.0 and stop < 0.0:
            return 1.0, 0.0, 0.0, 0.0
        if start < 0.0:
            low = max(low, start / (start - stop))
        elif stop < 0.0:
            high = min(high, start / (start - stop))
    if low >= high:
        return 1.0, 0.0, 0.0, 0.0
    r0 = alpha0 + beta0 + low * (alpha1 + beta1 - alpha0 - beta0)
    r1 = alpha0 + beta0 + high * (alpha1 + beta1 - alpha0 - beta0)
    t0 = (beta0 + low * (beta1 - beta0)) / r0
    t1 = (beta0 + high * (beta1 - beta0)) / r1
    if t0 < t1:
        return t0, 1.0 / r0, t1, 1.0 / r1
    return t1, 1.0 / r1, t0, 1.0 / r0


@njit(cache=True)
def _visible_pieces(walls, line, beam, own, piece, piece_wall):  # type: ignore[no-untyped-def]
    """Split a beam by the nearest wall: pieces (t0, w0, t1, w1), w = 0 where nothing is hit, and their walls."""
    found = np.empty((len(walls), 4))
    index = np.empty(len(walls), np.int32)
    edge = np.empty(2 * len(walls) + 2)
    edge[0], edge[1] = 0.0, 1.0
    count = 0
    for i in range(len(walls)):
        if own >= 0 and line[i] == line[own]:
            continue
        t0, w0, t1, w1 = _clip(beam, walls[i], own >= 0)
        if t1 - t0 > 1e-12:
            found[count] = (t0, w0, t1, w1)
            index[count] = i
            edge[2 * count + 2], edge[2 * count + 3] = min(max(t0, 0.0), 1.0), min(max(t1, 0.0), 1.0)
            count += 1
    edges = np.sort(edge[: 2 * count + 2])
    pieces = 0
    for i in range(len(edges) - 1):
        t0, t1 = edges[i], edges[i + 1]
        if t1 - t0 < 1e-12:
            continue
        middle = 0.5 * (t0 + t1)
        best, best_w = -1, 0.0
        for k in range(count):
            if found[k, 0] <= middle <= found[k, 2]:
                slope = (found[k, 3] - found[k, 1]) / (found[k, 2] - found[k, 0])
                w = found[k, 1] + slope * (middle - found[k, 0])
                if w > best_w:
                    best, best_w = k, w
        wall = index[best] if best >= 0 else -1
        w0, w1 = 0.0, 0.0
        if best >= 0:
            slope = (found[best, 3] - found[best, 1]) / (found[best, 2] - found[best, 0])
            w0, w1 = best_w + slope * (t0 - middle), best_w + slope * (t1 - middle)
        same = pieces > 0 and (
            piece_wall[pieces - 1] == wall
            or (wall >= 0 and piece_wall[pieces - 1] >= 0 and line[piece_wall[pieces - 1]] == line[wall])
        )
        if same:
            piece[pieces - 1, 2], piece[pieces - 1, 3] = t1, w1
        else:
            piece[pieces] = (t0, w0, t1, w1)
            piece_wall[pieces] = wall
            pieces += 1
    return pieces


@njit(cache=True)
def _reflect(beam, piece, wall, child):  # type: ignore[no-untyped-def]
    """Write the beam reflected by one visible piece of a wall; False if it is too thin to matter."""
    sx, sy = beam[0], beam[1]
    ends = np.empty((2, 2))
    for k in range(2):
        t, w = piece[2 * k], piece[2 * k + 1]
        ends[k, 0] = sx + ((1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)) / w
        ends[k, 1] = sy + ((1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)) / w
    dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
    away = (dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])) / (dx * dx + dy * dy)
    width = np.hypot(ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1])
    distance = abs(away) * np.hypot(dx, dy)
    if width < 1e-9 or distance < 1e-9:
        return False
    child[0], child[1] = sx + 2.0 * away * dy, sy - 2.0 * away * dx
    child[2:4], child[4:6] = ends[1], ends[0]
    area = (child[2] - child[0]) * (child[5] - child[1]) - (child[3] - child[1]) * (child[4] - child[0])
    return area > 1e-15


@njit(cache=True)
def _points_in_piece(beam, reflected, piece, points, bins, grid):  # type: ignore[no-untyped-def]
    """Indices of the points between the window of a beam and one piece of its view."""
    sx, sy = beam[0], beam[1]
    corner = np.empty((4, 2))
    x0, y0, edge, columns = grid[0], grid[1], grid[2], int(grid[3])
    rows = (len(bins) - 1) // columns
    reach = abs(sx - x0) + abs(sy - y0) + edge * (columns + rows) + 1.0
    direction = np.empty((2, 2))
    for k in range(2):
        t, w = piece[2 * k], piece[2 * k + 1]
        direction[k, 0] = (1.0 - t) * (beam[2] - sx) + t * (beam[4] - sx)
        direction[k, 1] = (1.0 - t) * (beam[3] - sy) + t * (beam[5] - sy)
        far = 2.0 * reach / np.hypot(direction[k, 0], direction[k, 1])
        r_far = 1.0 / w if w * far > 1.0 else far
        r_near = 1.0 if reflected else 0.0
        corner[k] = (sx + r_near * direction[k, 0], sy + r_near * direction[k, 1])
        corner[3 - k] = (sx + r_far * direction[k, 0], sy + r_far * direction[k, 1])
    normal, offset = _inward_edges(corner)
    found = np.empty(16, np.int32)
    count = 0
    low = corner[:, 1].min() - TOLERANCE_M
    high = corner[:, 1].max() + TOLERANCE_M
    first = max(0, int(np.floor((low - y0) / edge)))
    last = min(rows - 1, int(np.floor((high - y0) / edge)))
    for row in range(first, last + 1):
        left, right = _span(corner, y0 + row * edge - TOLERANCE_M, y0 + (row + 1) * edge + TOLERANCE_M)
        start = max(0, int(np.floor((left - TOLERANCE_M - x0) / edge)))
        stop = min(columns - 1, int(np.floor((right + TOLERANCE_M - x0) / edge)))
        if start > stop:
            continue
        for i in range(bins[row * columns + start], bins[row * columns + stop + 1]):
            inside = True
            for k in range(4):
                side = normal[k, 0] * points[i, 0] + normal[k, 1] * points[i, 1] - offset[k]
                if side < -TOLERANCE_M:
                    inside = False
                    break
            if inside:
                found = _grow(found, count + 1)
                found[count] = i
                count += 1
    return found[:count]


@njit(cache=True)
def _inward_edges(corner):  # type: ignore[no-untyped-def]
    """Unit inward normals and offsets of a clockwise quadrilateral; an edge of no length bounds nothing."""
    normal, offset = np.zeros((4, 2)), np.full(4, -1.0)
    for k in range(4):
        dx, dy = corner[(k + 1) % 4, 0] - corner[k, 0], corner[(k + 1) % 4, 1] - corner[k, 1]
        length = np.hypot(dx, dy)
        if length > 0.0:
            normal[k] = (dy / length, -dx / length)
            offset[k] = normal[k, 0] * corner[k, 0] + normal[k, 1] * corner[k, 1]
    return normal, offset


@njit(cache=True)
def _span(corner, low, high):  # type: ignore[no-untyped-def]
    """Smallest and largest x of a convex quadrilateral within the strip low <= y <= high."""
    left, right = np.inf, -np.inf
    for k in range(4):
        px, py = corner[k, 0], corner[k, 1]
        qx, qy = corner[(k + 1) % 4, 0], corner[(k + 1) % 4, 1]
        if low <= py <= high:
            left, right = min(left, px), max(right, px)
        for level in (low, high):
            if (py - level) * (qy - level) < 0.0:
                x = px + (level - py) / (qy - py) * (qx - px)
                left, right = min(left, x), max(right, x)
    return left, right


@njit(cache=True)
def _expand_heights(  # type: ignore[no-untyped-def]
    parent, segment, source, pair_node, pair_rx, walls, tx, rx, height, horizontal, max_depth
):
    """Every order of wall, floor and ceiling reflections of each pair (see `specular_candidates`)."""
    depth_size = max(1, max_depth)
    chain = np.empty(depth_size, np.int64)
    place = np.empty((depth_size, 3))
    total = 0
    for i in range(len(pair_node)):
        left = max_depth - _chain_length(parent, pair_node[i])
        total += 1 + 2 * left if horizontal else 1
    out_rx = np.empty(total, np.int32)
    surface = np.full((total, depth_size), -1, np.int32)
    vertices = np.zeros((total, depth_size, 3))
    count = 0
    for i in range(len(pair_node)):
        target = rx[pair_rx[i]]
        k, good = _unfold(parent, segment, source, pair_node[i], walls, target, chain, place)
        if not good:
            continue
        for bounces in range(max_depth - k + 1 if horizontal else 1):
            for first in range(2 if bounces else 1):
                out_rx[count] = pair_rx[i]
                _merge(
                    chain[:k],
                    place[:k],
                    tx,
                    target,
                    height,
                    bounces,
                    FLOOR if first == 0 else CEILING,
                    surface[count],
                    vertices[count],
                )
                count += 1
    return out_rx[:count].copy(), surface[:count].copy(), vertices[:count].copy()


@njit(cache=True)
def _chain_length(parent, node):  # type: ignore[no-untyped-def]
    length = 0
    while parent[node] >= 0:
        length += 1
        node = parent[node]
    return length


@njit(cache=True)
def _unfold(parent, segment, source, node, walls, target, chain, place):  # type: ignore[no-untyped-def]
    """Wall reflection points of one pair: (x, y, share of the path's length) in order from the transmitter.

    Returns the number of reflections and whether all points exist.
    """
    k = _chain_length(parent, node)
    x, y = target[0], target[1]
    total = np.hypot(x - source[node, 0], y - source[node, 1])
    for level in range(k - 1, -1, -1):
        sx, sy = source[node, 0], source[node, 1]
        wall = walls[segment[node]]
        dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
        from_source = dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])
        from_point = dx * (y - wall[0, 1]) - dy * (x - wall[0, 0])
        if abs(from_source - from_point) < 1e-15 or total == 0.0:
            return k, False
        share = from_source / (from_source - from_point)
        x, y = sx + share * (x - sx), sy + share * (y - sy)
        chain[level] = segment[node]
        place[level] = (x, y, np.hypot(x - sx, y - sy) / total)
        node = parent[node]
    return k, True


@njit(cache=True)
def _merge(chain, place, tx, target, height, bounces, first, surface, vertices):  # type: ignore[no-untyped-def]
    """Write one candidate: wall reflections and `bounces` alternating floor and ceiling reflections in path order."""
    to_first = tx[2] if first == FLOOR else height - tx[2]
    last_is_floor = (bounces % 2 == 1) == (first == FLOOR)
    from_last = target[2] if last_is_floor else height - target[2]
    climb = to_first + (bounces - 1) * height + from_last if bounces else 1.0
    walls, flats = 0, 0
    px, py, done = tx[0], tx[1], 0.0
    for depth in range(len(chain) + bounces):
        share = (to_first + flats * height) / climb if flats < bounces else 2.0
        is_floor = (flats % 2 == 0) == (first == FLOOR)
        if walls < len(chain) and place[walls, 2] <= share:
            px, py, done = place[walls, 0], place[walls, 1], place[walls, 2]
            surface[depth] = chain[walls]
            vertices[depth] = (px, py, _height_at(done, tx[2], target[2], height, bounces, first, to_first, climb))
            walls += 1
            continue
        nx, ny, stop = target[0], target[1], 1.0
        if walls < len(chain):
            nx, ny, stop = place[walls, 0], place[walls, 1], place[walls, 2]
        part = (share - done) / (stop - done) if stop > done else 0.0
        surface[depth] = FLOOR if is_floor else CEILING
        vertices[depth] = (px + part * (nx - px), py + part * (ny - py), 0.0 if is_floor else height)
        flats += 1


@njit(cache=True)
def _height_at(share, tx_z, rx_z, height, bounces, first, to_first, climb):  # type: ignore[no-untyped-def]
    """Height of a path after a share of its length."""
    if bounces == 0:
        return tx_z + share * (rx_z - tx_z)
    travelled = share * climb
    if travelled <= to_first:
        return tx_z - travelled if first == FLOOR else tx_z + travelled
    legs = int((travelled - to_first) // height)
    rest = travelled - to_first - legs * height
    rising = (legs % 2 == 0) == (first == FLOOR)
    return rest if rising else height - rest
