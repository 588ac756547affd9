"""Wall cells -> cells for outlines -> chains of cells -> straight runs."""

import math
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices, States, with_neighbours
from sionna_partial.constants import CellState
from sionna_partial.process import njit

MAX_GAP_CELLS = 2
"""Longest FREE gap that is closed, and longest bump or notch that is levelled [cells]."""

MAX_FREE_GAP_M = 0.11
"""Longest gap of FREE cells that is closed [m]: log-odds mapping erases single wall cells."""

MIN_RUN_CELLS = 3
"""Least length of wall on both sides of a gap in a seen wall [cells]."""

DEEP_CELLS = 4
"""Depth behind the face of a deep wall in which cells are FREE [cells]."""

PINHOLE_CELLS = 6
"""Largest hole in a wall that is filled [cells]."""

_TURNS = (0, 2, -1, 1)

_SQUARE = np.ones((3, 3), dtype=bool)
_POST_CELLS = 3
_ROUGH, _DEEP = 0.05, 0.3
"""Levelled cells, and wall cells behind faces, per cell of a face, from which `CleanWalls.roughness` is 1."""

ROUGH_WINDOW_M = 1.5
"""Standard deviation of the window in which they are counted [m]."""

_FACE_CELLS = 5
"""Length of the faces on which a cell that sticks out is a sign of range noise [cells]."""

_UNEVEN = 0.004, 0.007
"""Fractions of uneven faces from which depth is range noise, in part and in full. Plans have less than 0.005, maps
with range noise 0.006 to 0.1.
"""

_DEPTH_M = 0.014
"""Depth of the wall cells behind faces at which the square of the noise is 1 - 1/e [m]."""

THICK_M, THICK_FRACTIONS = 0.15, (0.1, 0.9)
"""Thickness of thick walls [m], and fractions of their length between which thickness distinguishes walls."""

_EXACT_DEPTH_M, _SIGNS_PER_FACE = 0.001, 0.003
"""Depth of the cells behind exact faces, as of walls cut out of meshes [m]; signs of noise per cell of a face at which
depth is range noise to 1 - 1/e. A single sign is none: exact walls have them at corners.
"""

LEAST_NOISE = 0.05
"""Noise up to which a map counts as exact, as of cells cut out of meshes."""

CENTRED_NOISE = 0.35, 0.7
"""Noise near a wall from which its outline moves to the middle of its layers of cells, and where it arrives there: with
ranges of less than 1 cm, walls are best outlined as on exact maps.
"""

RAGGED_FACTOR = 2.0
"""Largest distance of a line from ragged walls, in tolerances."""

_CORNERS = 64

_RESIDUAL_COST = 3.0

_RAGGED_TURNS = 4

_RAGGED_SPACING = 10.0

_LEVEL_CELLS = 1.0

_ALL_LINES = np.array([[-1.05, -3.0], [1.05, -3.0], [1.05, 3.0], [-1.05, 3.0]])
"""Corners (slope, offset) of the polygon of lines that are not steep and pass near the origin."""


class CleanWalls(NamedTuple):
    """Wall cells (ny, nx) for outlines.

    `peeled` (ny, nx) were removed from walls two cells thick, whose outline is between both layers. `roughness`
    (ny, nx), 0 to 1, counts ragged cells of thick walls in a window.
    """

    cells: Bools
    peeled: Bools
    roughness: Floats


def wall_cells(state: States, resolution_m: float, bridge_gap_m: float = 0.5) -> CleanWalls:
    """Clean the wall cells of a map with states (ny, nx).

    Enclosed pinholes are filled, notches and bumps of one by at most two cells levelled, and gaps in seen walls
    closed: of UNKNOWN cells up to `bridge_gap_m`, of FREE cells in straight walls up to `MAX_FREE_GAP_M`. Of walls seen
    from FREE cells only the cells beside these, and inner corners of deep walls, are kept. Walls two cells thick are
    thinned.
    """
    wall = _fill_pinholes(state == CellState.WALL)
    free = ~_fill_pinholes((state != CellState.FREE) | wall)
    wall |= _hidden_corners(wall, free)[0]
    longest = int(bridge_gap_m / resolution_m + 1e-6)
    filled = _unknown_gaps(wall, free, longest)
    wall, free, roughness = _levelled(wall | filled, free, resolution_m)
    more = _unknown_gaps(wall, free, longest)
    wall, filled = wall | more, filled | more
    rows, columns = (_short_gaps(*turned, resolution_m, bridge_gap_m) for turned in ((wall, free), (wall.T, free.T)))
    wall |= rows | columns.T
    seen = wall & with_neighbours(free) & ~_hidden_corners(wall, free)[1]
    label, count = scipy.ndimage.label(wall, structure=_SQUARE)
    unseen = np.ones(count + 1, dtype=bool)  # pieces that no free cell is beside
    unseen[label[seen]] = False
    thinned, peeled = _thin(seen | (wall & (unseen[label] | filled)), free)
    return CleanWalls(thinned, peeled, roughness)


def thick_walls(walls: Bools, counted: Bools, resolution_m: float) -> Bools:
    """Return the cells (ny, nx) of thick walls if some of the `counted` wall cells are thin, and others thick."""
    thickness, (low, high) = np.minimum(*_run_lengths(walls)), THICK_FRACTIONS
    thick, length = counted & (thickness * resolution_m > THICK_M - 1e-6), 1.0 / np.maximum(thickness, 1)
    fraction = length.sum(where=thick) / max(1.0, length.sum(where=counted))
    return thick & (low < fraction < high)


def _run_lengths(wall: Bools) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return width and height of the runs through every cell, at most 255."""
    width, height = np.zeros((2, *wall.shape), dtype=np.uint8)
    for length, cells in ((width, wall), (height.T, wall.T)):
        _, start, end = row_runs(cells)
        length[cells] = np.repeat(np.minimum(end - start, 255), end - start)
    return width, height


def _hidden_corners(wall: Bools, free: Bools) -> tuple[Bools, Bools]:
    """Return the cells of a deep wall that no ray meets: at inner corners, and behind outer ones.

    Both touch a FREE cell only by a corner. Walls without FREE cells within `DEEP_CELLS` are deep.
    """
    inner, behind = np.zeros((2, *wall.shape), dtype=bool)
    ahead = np.arange(DEEP_CELLS)
    for turns in _TURNS:
        is_wall, is_free = (np.pad(np.rot90(mask, turns), DEEP_CELLS) for mask in (wall, free))
        row, column = np.nonzero(is_free[:-1, :-1] & is_wall[:-1, 1:] & is_wall[1:, :-1])
        row, column = row + 1, column + 1
        deep = ~is_free[row[:, None, None] + ahead[:, None], column[:, None, None] + ahead].any(axis=(1, 2))
        row, column = row[deep], column[deep]
        ends = ~(is_free[row - 2, column] | is_free[row, column - 2])
        for found, which in ((inner, ends), (behind, ~ends)):
            corners = np.zeros_like(is_wall)
            corners[row[which], column[which]] = True
            found |= np.rot90(corners[DEEP_CELLS:-DEEP_CELLS, DEEP_CELLS:-DEEP_CELLS], -turns)
    return inner, behind & ~inner


def wall_noise(state: States, resolution_m: float) -> float:
    """Return the range noise of a map with states (ny, nx): 0 (exact) to 1.

    Exact rays mark one layer of wall cells, noisy ones several, which vary along a wall. Walls of plans are deep, but
    their faces are lattice lines.
    """
    wall = state == CellState.WALL
    facing = wall & with_neighbours(state == CellState.FREE)
    depth_m = float((wall & ~facing).sum() / max(1, facing.sum()) * resolution_m)
    depth = math.sqrt(-math.expm1(-depth_m / _DEPTH_M))
    return depth * float(np.interp(_uneven_faces(state), _UNEVEN, (0.0, 1.0))) if depth > 0.0 else 0.0


def noise_field(state: States, resolution_m: float, windows_m: tuple[float, float] = (3.0, 5.0)) -> Floats:
    """Return the local range noise (ny, nx) of the walls around the centre of each cell: 0 (exact or no walls) to 1.

    Depth is as in `wall_noise`, in a window; it is noise where cells stick out behind the faces of walls. `windows_m`
    are the standard deviations of the windows for the depth, and for these signs [m].
    """
    wall, near_free = state == CellState.WALL, with_neighbours(state == CellState.FREE)
    ragged, faces = _ragged_behind(wall, state != CellState.UNKNOWN) & ~near_free, wall & near_free
    hidden, around = (counted_near(cells, windows_m[0] / resolution_m) for cells in (wall & ~near_free, faces))
    signs, farther = (counted_near(cells, windows_m[1] / resolution_m) for cells in (ragged, faces))
    depth_m = np.maximum(hidden / (around + 1.0) * resolution_m - _EXACT_DEPTH_M, 0.0)
    evidence = np.maximum(signs - 1.0, 0.0) / (_SIGNS_PER_FACE * (farther + 1.0))
    return np.asarray(np.sqrt(-np.expm1(-depth_m / _DEPTH_M)) * -np.expm1(-evidence))


def counted_near(cells: NDArray[np.generic], deviation: float) -> Floats:
    """Add up cells with the weights of a window that is 1 in its middle, about a Gaussian: three box filters."""
    half = round((math.sqrt(4.0 * deviation**2 + 1.0) - 1.0) / 2.0)
    counts = np.pad(cells.astype(np.float64), half)  # so that unknown cells around a map change nothing
    for _ in range(3):
        counts = scipy.ndimage.uniform_filter(counts, 2 * half + 1, mode="constant")
    return 2.0 * math.pi * deviation**2 * counts[half : half + cells.shape[0], half : half + cells.shape[1]]


def _ragged_behind(wall: Bools, known: Bools) -> Bools:
    """Return wall cells with at most one neighbour by a side, or that stick out of a diagonal into unknown space."""
    sides = scipy.ndimage.convolve(wall.astype(np.uint8), [[0, 1, 0], [1, 0, 1], [0, 1, 0]], mode="constant")
    ragged = wall & (sides <= 1)
    for turns in _TURNS:
        walls, knowns = (np.pad(np.rot90(mask, turns), 3) for mask in (wall, known))
        found = walls.copy()
        for shift in ((-1, 0), (0, -1), (1, -1), (-1, 1)):
            found &= ~np.roll(knowns, shift, (0, 1))
        for shift in ((1, 0), (0, 1), (2, -1), (-1, 2), (3, -2), (-2, 3)):
            found &= np.roll(walls, shift, (0, 1))
        ragged |= np.rot90(found[3:-3, 3:-3], -turns)
    return ragged


def _uneven_faces(state: States) -> float:
    """Return the fraction of faces where the middle cell of a lattice line sticks out, in front or behind."""
    count = uneven = 0
    for turns in _TURNS:
        front, back = _seen_faces(np.rot90(state, turns))
        count += front.shape[1]
        behind, before = (_is_line(line) & _sticks_out(other) for line, other in ((front, back), (back, -front)))
        uneven += int((behind | before).sum())
    return uneven / max(1, count)


def _seen_faces(state: States) -> tuple[Indices, Indices]:
    """Return first and end columns (_FACE_CELLS, N) of walls in adjacent rows, between FREE and UNKNOWN cells."""
    state = np.pad(state, ((1, _FACE_CELLS), (2, 2)), constant_values=CellState.UNKNOWN)
    row, start, end = row_runs(state == CellState.WALL)
    seen = (state[row, start - 1] == CellState.FREE) & (state[row, end] == CellState.UNKNOWN)
    row, start, end = row[seen], start[seen], end[seen]
    number = np.full(state.shape, -1, dtype=np.int32)
    number[row, start] = np.arange(len(row))
    chain = [np.arange(len(row))]
    for ahead in range(1, _FACE_CELLS):
        column = start[chain[-1]]
        following = np.max([number[row + ahead, column + aside] for aside in (-1, 0, 1)], axis=0)
        row, chain = row[following >= 0], [cells[following >= 0] for cells in (*chain, following)]
    faces = np.array(chain)
    return start[faces], end[faces]


def _is_line(columns: Indices) -> Bools:
    """Return whether steps between rows are at most 2, all to the same side."""
    size, sideways = abs(np.diff(columns, axis=0)), abs(columns[-1] - columns[0])
    return np.logical_and(size.max(axis=0) <= 2, size.sum(axis=0) == sideways)


def _sticks_out(columns: Indices) -> Bools:
    first, before, middle, after, last = columns
    return _is_line(np.array([first, before, after, last])) & (2 * middle - before - after == 2)


def _levelled(wall: Bools, free: Bools, resolution_m: float) -> tuple[Bools, Bools, Floats]:
    facing = wall & with_neighbours(free)
    hidden, was_free = wall & ~facing, free
    for level in (_bumps, _notches) * 2:
        opened, filled = np.zeros((2, *wall.shape), dtype=bool)
        for turns in _TURNS:  # all faces at once, so that none comes first
            found = level(np.rot90(wall, turns), np.rot90(free, turns))
            for total, mask in zip((opened, filled), found, strict=True):
                total |= np.rot90(mask, -turns)
        opened &= ~filled
        wall, free = (wall & ~opened) | filled, (free & ~filled) | opened
    deviation = ROUGH_WINDOW_M / resolution_m
    levels, depths, faces = (counted_near(cells, deviation) for cells in (free != was_free, hidden, facing))
    rough = np.maximum(levels - 1.0, 0.0) / (faces + 1.0) / _ROUGH  # a single cell is none
    deep = depths / (faces + 1.0) / _DEEP
    return wall, free, np.minimum(rough, 1.0) * np.minimum(deep, 1.0)


def _unknown_gaps(wall: Bools, free: Bools, longest: int) -> Bools:
    """Return the UNKNOWN cells that close gaps between two pieces of wall.

    A gap is a row of at most `longest` such cells beside FREE ones. The shortest line between the pieces closes it,
    or the row itself where rays passed that line.
    """
    gap = scipy.ndimage.binary_dilation(free) & ~free & ~wall
    label, _ = scipy.ndimage.label(gap, structure=_SQUARE)
    pieces, _ = scipy.ndimage.label(wall & with_neighbours(gap), structure=_SQUARE)
    filled = np.zeros_like(wall)
    for index, box in enumerate(scipy.ndimage.find_objects(label), start=1):
        if max(side.stop - side.start for side in box) <= longest:
            around = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in box)
            row = label[around] == index
            ends = np.where(with_neighbours(row), pieces[around], 0)
            if len(np.unique(ends)) > 2:
                line = _shortest_line(ends, row + 2 * free[around])
                filled[around] |= row if (free[around] & line).any() else line
    return filled & ~wall


def _shortest_line(ends: NDArray[np.int32], others: NDArray[np.integer]) -> Bools:
    """Return the cells of the shortest line between two numbered pieces, the same however the grid is turned."""
    _, transpose, flips = canonical(((ends > 0) + 2 * others).astype(np.uint8))
    turned = turned_grid(ends, transpose, flips)
    numbers = turned[turned > 0]
    low, high = (np.argwhere(turned == value) for value in (numbers[0], numbers[numbers != numbers[0]][0]))
    apart = np.abs(low[:, None] - high[None]).max(axis=2)
    from_to = low[np.argmin(apart) // len(high)], high[np.argmin(apart) % len(high)]
    line = np.zeros(turned.shape, dtype=bool)
    line[tuple(np.rint(np.linspace(*from_to, int(apart.min()) + 1)).astype(int).T)] = True
    return _turned_back(line, transpose, flips)


def canonical(state: States) -> tuple[States, bool, tuple[bool, bool]]:
    """Turn or mirror a grid to the orientation with the smallest bytes, so that results turn with it.

    Returns the grid, whether it was transposed, and whether columns and rows were then flipped.
    """
    turns = [(swap, (x, y)) for swap in (False, True) for y in (False, True) for x in (False, True)]
    grids = [(turned_grid(state, *turn), *turn) for turn in turns]
    return min(grids, key=lambda turned: (turned[0].shape, turned[0].tobytes()))


def _turned_back(grid: Bools, transpose: bool, flips: tuple[bool, bool]) -> Bools:
    grid = grid[:: -1 if flips[1] else 1, :: -1 if flips[0] else 1]
    return grid.T if transpose else grid


def turned_grid(grid: NDArray[Any], transpose: bool, flips: tuple[bool, bool]) -> NDArray[Any]:
    grid = grid.T if transpose else grid
    return np.ascontiguousarray(grid[:: -1 if flips[1] else 1, :: -1 if flips[0] else 1])


def frontier_cells(state: States) -> Bools:
    """Return free cells that share an edge with an unknown one, or the grid's border."""
    unknown = np.pad(state == CellState.UNKNOWN, 1, constant_values=True)
    touches = unknown[2:, 1:-1] | unknown[:-2, 1:-1] | unknown[1:-1, 2:] | unknown[1:-1, :-2]
    return np.asarray(touches & (state == CellState.FREE))


def uniform_cells(state: States) -> NDArray[np.int32]:
    """Return the number of cells in every direction, corners included, with the state of each cell."""
    uniform = np.full(state.shape, max(state.shape), dtype=np.int32)
    for kind in CellState:
        cells = state == kind
        if cells.any() and not cells.all():
            uniform[cells] = scipy.ndimage.distance_transform_cdt(cells, "chessboard")[cells] - 1
    return uniform


def row_runs(mask: Bools) -> tuple[Indices, Indices, Indices]:
    """Return row, first and end column of horizontal runs of True, in reading order."""
    step = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, start = np.nonzero(step == 1)
    return row, start, np.nonzero(step == -1)[1]


def _fill_pinholes(wall: Bools) -> Bools:
    label, count = scipy.ndimage.label(np.pad(~wall, 1, constant_values=True))
    size = np.bincount(label.ravel(), minlength=count + 1)
    size[[0, label[0, 0]]] = PINHOLE_CELLS + 1
    return wall | (size <= PINHOLE_CELLS)[label[1:-1, 1:-1]]


def _notches(wall: Bools, free: Bools) -> tuple[Bools, Bools]:
    """Return no cells to open, and those that fill notches of one or two FREE cells in faces towards larger rows."""
    filled = np.zeros_like(wall)
    row, start, end = row_runs(free)
    keep = (end - start <= MAX_GAP_CELLS) & (start > 0) & (end < wall.shape[1]) & (row >= 1)
    for i, a, b in zip(row[keep], start[keep], end[keep], strict=True):
        filled[i, a:b] = wall[i, a - 1] and wall[i, b] and not free[i - 1, a - 1 : b + 1].any()
    return np.zeros_like(wall), filled


def _bumps(wall: Bools, free: Bools) -> tuple[Bools, Bools]:
    """Return the bumps of one or two cells on faces towards larger rows, and the cells below them."""
    bumps, below = np.zeros((2, *wall.shape), dtype=bool)
    row, start, end = row_runs(wall)
    keep = (end - start <= MAX_GAP_CELLS) & (start > 0) & (end < wall.shape[1]) & (row >= 1)
    for i, a, b in zip(row[keep], start[keep], end[keep], strict=True):
        sides = free[i, a - 1] and free[i, b] and wall[i - 1, a - 1] and wall[i - 1, b]
        if sides and not free[i - 1, a:b].any() and free[i + 1 : i + 2, a - 1 : b + 1].all():
            bumps[i, a:b], below[i - 1, a:b] = True, True
    return bumps, below


def _short_gaps(wall: Bools, free: Bools, resolution_m: float, bridge_gap_m: float) -> Bools:
    row, start, end = row_runs(wall)
    gap = np.where(row[1:] == row[:-1], start[1:] - end[:-1], 0)
    longest = min(MAX_GAP_CELLS, int(bridge_gap_m / resolution_m + 1e-6))
    run = np.minimum(end - start, wall.shape[1])
    beside = np.minimum(run[1:], run[:-1])
    index = np.nonzero((gap > 0) & (gap <= longest) & (beside >= MIN_RUN_CELLS))[0]
    seen = np.array([free[row[k], end[k] : start[k + 1]].any() for k in index], dtype=bool)
    index = index[~(seen & (gap[index] * resolution_m > MAX_FREE_GAP_M))]
    filled = np.zeros_like(wall)
    for k in index:
        filled[row[k], end[k] : start[k + 1]] = True
    label, _ = scipy.ndimage.label(filled)
    thickness = [0] + [rows.stop - rows.start for rows, _ in scipy.ndimage.find_objects(label)]
    for k in index:
        filled[row[k], end[k] : start[k + 1]] = beside[k] >= thickness[label[row[k], end[k]]]
    return filled


def _thin(wall: Bools, free: Bools) -> tuple[Bools, Bools]:
    """Thin walls of two cells to one; the only layer that faces FREE cells is kept."""
    label, _ = scipy.ndimage.label(wall, structure=_SQUARE)
    small = [False] + [max(s.stop - s.start for s in box) <= _POST_CELLS for box in scipy.ndimage.find_objects(label)]
    kept = scipy.ndimage.binary_opening(wall, structure=_SQUARE) | np.array(small, dtype=bool)[label]
    facing = with_neighbours(free)
    kept |= ~scipy.ndimage.binary_opening(wall, structure=np.ones((2, 2), dtype=bool))
    padded, facing_there = np.pad(wall, 1), np.pad(facing, 1)
    width, height = (np.pad(lengths, 1) for lengths in _run_lengths(wall))
    thinned, (label, _) = padded.copy(), scipy.ndimage.label(np.pad(wall & ~kept, 1), structure=_SQUARE)
    for index, box in enumerate(scipy.ndimage.find_objects(label), start=1):
        around = tuple(slice(side.start - 1, side.stop + 1) for side in box)
        cells = padded[around], label[around] == index, facing_there[around]
        _, swap, flips = canonical((cells[0] + 2 * cells[1] + 4 * cells[2]).astype(np.uint8))
        lengths = (height, width) if swap else (width, height)
        parts = *cells, lengths[0][around], lengths[1][around]
        left = _thinned(*(turned_grid(part, swap, flips) for part in parts))
        thinned[around] &= _turned_back(left, swap, flips)
    thinned = thinned[1:-1, 1:-1]
    return thinned, wall & ~thinned & facing


def _thinned(
    wall: Bools, removable: Bools, facing: Bools, width: NDArray[np.uint8], height: NDArray[np.uint8]
) -> Bools:
    """Remove layers of cells, sides one by one; the result depends on how the grid is turned."""
    thinned = wall.copy()
    for cells in (removable & ~facing, removable):
        for (dy, dx), across in (((1, 0), height), ((-1, 0), height), ((0, 1), width), ((0, -1), width)):
            side = ~np.roll(thinned, (-dy, -dx), (0, 1))
            thinned &= ~_peeled(thinned, side & cells & (across <= np.minimum(width, height)))
    return thinned


def _peeled(wall: Bools, candidates: Bools) -> Bools:
    """Return candidates whose removal, one by one, neither splits, opens nor shortens the wall."""
    left = wall.copy()
    rows, columns = np.nonzero(candidates)
    for parity in range(4):
        mine = (rows % 2 * 2 + columns % 2) == parity
        row, column = rows[mine], columns[mine]
        ring = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
        around = np.stack([left[row + dy, column + dx] for dy, dx in ring])
        empty = ~around
        corners = [empty[k] & ~(empty[k] & empty[k + 1] & empty[(k + 2) % 8]) for k in (0, 2, 4, 6)]
        simple = np.sum(corners, axis=0) == 1
        gone = simple & (around.sum(axis=0) >= 2)
        left[row[gone], column[gone]] = False
    return wall & ~left


def fit_runs(points: Floats, tolerance: float | Floats) -> tuple[NDArray[np.int64], Floats]:
    """Split a polyline (n, 2) [cells] of straight elements into few straight runs.

    A run is allowed if a line passes within `tolerance` [cells], of all elements or of each (n - 1,), of the middle of
    every unit edge, along the axis that the line is steeper against. Ragged polylines, which turn back at least four
    times and once in 10 cells, get `RAGGED_FACTOR` times the tolerance. The split minimises the number of runs plus
    three times their residual variances, in squared mean tolerances. Lines are least-squares within the tolerance, or
    parallel to an axis for ragged runs if that moves their ends by at most half a cell.

    Returns the first corner of every run (r,), and a point x, y and the direction x, y of its line (r, 4).
    """
    upright, lying = np.ascontiguousarray(points[:, ::-1]), np.ascontiguousarray(points)
    tolerances = np.ascontiguousarray(np.broadcast_to(tolerance + 1e-6, len(points) - 1))
    previous, along_y = np.zeros(len(points), np.int64), np.zeros(len(points), np.bool_)
    _find_runs(lying, upright, tolerances, np.full(len(points), np.inf), previous, along_y)
    starts, lines, end = [], [], len(points) - 1
    while end > 0:
        starts.append(int(previous[end]))
        x, y, along, across = _line(upright if along_y[end] else lying, starts[-1], end, tolerances)
        lines.append((y, x, across, along) if along_y[end] else (x, y, along, across))
        end = starts[-1]
    return np.array(starts[::-1], np.int64), np.array(lines[::-1]).reshape(-1, 4)


@njit(cache=True)
def _find_runs(points, swapped, tolerances, cost, previous, along_y):
    cost[0] = 0.0
    for i in range(len(points) - 1):
        if cost[i] + 1.0 < cost[i + 1]:
            cost[i + 1], previous[i + 1] = cost[i] + 1.0, i
            along_y[i + 1] = abs(points[i + 1, 1] - points[i, 1]) > abs(points[i + 1, 0] - points[i, 0])
        _extend(points, tolerances, i, False, cost, previous, along_y)
        _extend(swapped, tolerances, i, True, cost, previous, along_y)


@njit(cache=True)
def _extend(points, tolerances, start, swap, cost, previous, along_y):
    """Lengthen the run from `start` while a line fits; note cheaper splits."""
    near, near_size = _all_lines()
    far, far_size = _all_lines()
    moments, weighted = np.zeros(6), 0.0
    sign, turn, reversals = 0.0, 0.0, 0
    for k in range(start, len(points) - 1):
        ahead, aside = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        if ahead * sign < 0.0:
            return
        sign = ahead if sign == 0.0 else sign
        reversals += int(aside * turn < 0.0)
        turn = aside if aside != 0.0 else turn
        element = _middles(points, start, k)
        near_size = _clip_element(near, near_size, element, tolerances[k])
        far_size = _clip_element(far, far_size, element, RAGGED_FACTOR * tolerances[k])
        if far_size == 0:
            return
        _accumulate(moments, element)
        weighted += element[4] * tolerances[k]
        length = abs(points[k + 1, 0] - points[start, 0])
        if near_size > 0 or (reversals >= _RAGGED_TURNS and reversals * _RAGGED_SPACING >= length):
            tolerance = max(weighted / moments[0], 0.25)
            total = cost[start] + 1.0 + _RESIDUAL_COST * _residual_variance(moments) / tolerance**2
            if total < cost[k + 1] - 1e-12:
                cost[k + 1], previous[k + 1], along_y[k + 1] = total, start, swap


@njit(cache=True)
def _line(points, start, end, tolerances):
    """Return a point and the direction of the line that fits a run."""
    for factor in (1.0, RAGGED_FACTOR):
        moments = np.zeros(6)
        polygon, size = _all_lines()
        for k in range(start, end):
            element = _middles(points, start, k)
            size = _clip_element(polygon, size, element, factor * tolerances[k])
            _accumulate(moments, element)
        ragged = factor > 1.0
        if size > 0:
            break
    mean_x, mean_y = moments[1] / moments[0], moments[2] / moments[0]
    spread = moments[3] - moments[1] * mean_x
    slope = (moments[4] - moments[1] * mean_y) / spread if spread > 1e-9 else 0.0
    if ragged and abs(slope * (points[end, 0] - points[start, 0])) <= _LEVEL_CELLS:
        slope = 0.0
    offset = mean_y - slope * mean_x
    fits = True
    for k in range(start, end):
        x0, y0, x1, y1, _ = _middles(points, start, k)
        limit = RAGGED_FACTOR * tolerances[k] if ragged else tolerances[k]
        fits = fits and max(abs(slope * x0 + offset - y0), abs(slope * x1 + offset - y1)) <= limit
    if size > 0 and not fits:
        slope, offset = 0.0, 0.0
        for k in range(size):
            slope, offset = slope + polygon[k, 0], offset + polygon[k, 1]
        slope, offset = slope / size, offset / size
    x, y, norm = points[start, 0] + mean_x, points[start, 1] + slope * mean_x + offset, np.sqrt(1.0 + slope * slope)
    return x, y, 1.0 / norm, slope / norm


@njit(cache=True)
def _clip_element(polygon, size, element, tolerance):
    x0, y0, x1, y1, steps = element
    if size > 0:
        size = _clip(polygon, size, x0, y0, tolerance)
    if size > 0 and steps > 1:
        size = _clip(polygon, size, x1, y1, tolerance)
    return size


@njit(cache=True)
def _middles(points, origin, k):
    x, y = points[k, 0] - points[origin, 0], points[k, 1] - points[origin, 1]
    dx, dy = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
    a, b = abs(round(dx)), abs(round(dy))
    while b > 0:
        a, b = b, a % b
    steps = max(a, 1)
    half_x, half_y = 0.5 * dx / steps, 0.5 * dy / steps
    return x + half_x, y + half_y, x + dx - half_x, y + dy - half_y, steps


@njit(cache=True)
def _accumulate(moments, element):
    """Add the middles of unit edges to the moments: sums of 1, x, y, xx, xy, yy."""
    x0, y0, x1, y1, steps = element
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    spread = (steps + 1.0) / (12.0 * (steps - 1.0)) if steps > 1 else 0.0
    dx, dy = x1 - x0, y1 - y0
    moments[0] += steps
    moments[1] += steps * x
    moments[2] += steps * y
    moments[3] += steps * (x * x + spread * dx * dx)
    moments[4] += steps * (x * y + spread * dx * dy)
    moments[5] += steps * (y * y + spread * dy * dy)


@njit(cache=True)
def _residual_variance(moments):
    mean_x, mean_y = moments[1] / moments[0], moments[2] / moments[0]
    xx = moments[3] / moments[0] - mean_x * mean_x
    xy = moments[4] / moments[0] - mean_x * mean_y
    yy = moments[5] / moments[0] - mean_y * mean_y
    return max(0.0, 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)))


@njit(cache=True)
def _all_lines():
    polygon = np.empty((_CORNERS, 2))
    for k in range(len(_ALL_LINES)):
        polygon[k, 0], polygon[k, 1] = _ALL_LINES[k, 0], _ALL_LINES[k, 1]
    return polygon, len(_ALL_LINES)


@njit(cache=True)
def _clip(polygon, size, x, y, tolerance):
    """Keep the lines that pass (x, y) within the tolerance along y; return the number of corners left."""
    kept = np.empty((_CORNERS, 2))
    for side in (1.0, -1.0):
        count = 0
        for k in range(size):
            slope, offset = polygon[k, 0], polygon[k, 1]
            next_slope, next_offset = polygon[(k + 1) % size, 0], polygon[(k + 1) % size, 1]
            inside = tolerance - side * (slope * x + offset - y)
            next_inside = tolerance - side * (next_slope * x + next_offset - y)
            if inside >= 0.0:
                kept[count, 0], kept[count, 1] = slope, offset
                count += 1
            if inside * next_inside < 0.0:
                fraction = inside / (inside - next_inside)
                kept[count, 0] = slope + (next_slope - slope) * fraction
                kept[count, 1] = offset + (next_offset - offset) * fraction
                count += 1
            if count > _CORNERS - 2:
                return 0
        size = count
        for k in range(size):
            polygon[k, 0], polygon[k, 1] = kept[k, 0], kept[k, 1]
    return size
