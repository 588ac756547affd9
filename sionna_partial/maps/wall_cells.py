"""Wall cells of a map -> cells for outlines, and the range noise that they show."""

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sionna_partial.arrays import (
    Bools,
    Floats,
    States,
    canonical,
    counted_near,
    row_runs,
    run_lengths,
    turned_back,
    turned_grid,
    with_neighbours,
)
from sionna_partial.constants import CellState

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
    thickness, (low, high) = np.minimum(*run_lengths(walls)), THICK_FRACTIONS
    thick, length = counted & (thickness * resolution_m > THICK_M - 1e-6), 1.0 / np.maximum(thickness, 1)
    fraction = length.sum(where=thick) / max(1.0, length.sum(where=counted))
    return thick & (low < fraction < high)


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


def noise_field(state: States, resolution_m: float, windows_m: tuple[float, float] = (3.0, 5.0)) -> Floats:
    """Return the local range noise (ny, nx) of the walls around the centre of each cell: 0 (exact or no walls) to 1.

    Exact rays mark one layer of wall cells, noisy ones several. Walls of plans are deep, too: depth is noise where
    cells stick out behind the faces of walls. `windows_m` are the standard deviations of the windows for the depth, and
    for these signs [m].
    """
    wall, near_free = state == CellState.WALL, with_neighbours(state == CellState.FREE)
    ragged, faces = _ragged_behind(wall, state != CellState.UNKNOWN) & ~near_free, wall & near_free
    hidden, around = (counted_near(cells, windows_m[0] / resolution_m) for cells in (wall & ~near_free, faces))
    signs, farther = (counted_near(cells, windows_m[1] / resolution_m) for cells in (ragged, faces))
    depth_m = np.maximum(hidden / (around + 1.0) * resolution_m - _EXACT_DEPTH_M, 0.0)
    evidence = np.maximum(signs - 1.0, 0.0) / (_SIGNS_PER_FACE * (farther + 1.0))
    return np.asarray(np.sqrt(-np.expm1(-depth_m / _DEPTH_M)) * -np.expm1(-evidence))


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
    return turned_back(line, transpose, flips)


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
    width, height = (np.pad(lengths, 1) for lengths in run_lengths(wall))
    thinned, (label, _) = padded.copy(), scipy.ndimage.label(np.pad(wall & ~kept, 1), structure=_SQUARE)
    for index, box in enumerate(scipy.ndimage.find_objects(label), start=1):
        around = tuple(slice(side.start - 1, side.stop + 1) for side in box)
        cells = padded[around], label[around] == index, facing_there[around]
        _, swap, flips = canonical((cells[0] + 2 * cells[1] + 4 * cells[2]).astype(np.uint8))
        lengths = (height, width) if swap else (width, height)
        parts = *cells, lengths[0][around], lengths[1][around]
        left = _thinned(*(turned_grid(part, swap, flips) for part in parts))
        thinned[around] &= turned_back(left, swap, flips)
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
