"""Cells of a map -> the wall cells that outlines run through: holes filled, faces smoothed, short gaps closed."""

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from sionna_partial.arrays import Bools, Indices, States
from sionna_partial.constants import CellState

MAX_GAP_CELLS = 2
"""Longest gap of FREE cells in a wall that is closed, and longest bump or notch that is levelled [cells]."""

MAX_FREE_GAP_M = 0.11
"""Longest gap of FREE cells that is closed [m]: log-odds mapping erases single wall cells."""

MIN_RUN_CELLS = 3
"""Length of a wall on both sides of a gap from which on the gap belongs to a seen wall [cells]."""

DEEP_CELLS = 4
"""Depth behind the face of a deep wall in which cells are FREE [cells]."""

PINHOLE_CELLS = 6
"""Largest hole in a wall that is filled [cells]."""

_TURNS = (0, 2, -1, 1)
"""Quarter turns of a mask, so that each side is at row 0 once, and each corner at row and column 0."""

_SQUARE = np.ones((3, 3), dtype=bool)
_POST_CELLS = 3
_RAGGED = 0.006, 0.012
"""Fractions of ragged edges from which on depth is a sign of noise, in part and in full.

Plans have less than 0.001, and up to 0.01 where they are tilted. Simulated lidars with range noise have 0.007 to 0.1,
maps of real robots with walls of more than one layer 0.012 to 0.07.
"""

_DEPTH_M = 0.0125
"""Depth of the wall cells behind faces at which the noise is 1 - 1/e [m].

Simulated lidars of 1, 2, 3 and 5 cm range noise make 0.002, 0.03, 0.05 and 0.08 m, real robots 0 to 0.08 m.
"""


class CleanWalls(NamedTuple):
    """Wall cells (ny, nx) that bear outlines.

    `peeled` (ny, nx) face FREE ones and were taken off walls two cells thick: the outline lies between both layers.
    `noise` is 0 where walls are exact, to 1 where range noise made them thick and rough.
    """

    cells: Bools
    peeled: Bools
    noise: float


def wall_cells(state: States, resolution_m: float, bridge_gap_m: float = 0.5) -> CleanWalls:
    """Clean the wall cells among the states (ny, nx) of a map.

    Enclosed pinholes are filled; notches and bumps of one cell depth and at most two cells length are levelled; gaps of
    UNKNOWN cells in seen walls are closed (up to `bridge_gap_m`), and short ones of FREE cells in straight walls
    (`MAX_FREE_GAP_M`). Of walls that were seen from FREE cells, only the cells beside these are left: what is behind
    was not seen. Of deep walls these are the cells that rays meet, and those of inner corners. Walls two cells thick
    are thinned. Thin walls, posts and specks stay.
    """
    wall = _fill_pinholes(state == CellState.WALL)
    free = ~_fill_pinholes((state != CellState.FREE) | wall)
    wall |= _hidden_corners(wall, free)[0]
    longest = int(bridge_gap_m / resolution_m + 1e-6)
    filled = _unknown_gaps(wall, free, longest)
    noise = _noise(wall | filled, free, resolution_m)
    wall, free = _levelled(wall | filled, free)
    more = _unknown_gaps(wall, free, longest)
    wall, filled = wall | more, filled | more
    wall |= _short_gaps(wall, free, resolution_m, bridge_gap_m)
    wall |= _short_gaps(wall.T, free.T, resolution_m, bridge_gap_m).T
    seen = wall & ndimage.binary_dilation(free, structure=_SQUARE) & ~_hidden_corners(wall, free)[1]
    label, count = ndimage.label(wall, structure=_SQUARE)
    unseen = np.ones(count + 1, dtype=bool)  # pieces that no free cell is beside
    unseen[label[seen]] = False
    thinned, peeled = _thin(seen | (wall & (unseen[label] | filled)), free)
    return CleanWalls(thinned, peeled, noise)


def _hidden_corners(wall: Bools, free: Bools) -> tuple[Bools, Bools]:
    """Cells between two faces of a deep wall that no ray meets: those of inner corners, and those behind other ones.

    Both touch a FREE cell by a corner alone. The faces end at an inner corner; behind an outer one, and behind a step
    of a tilted face, another FREE cell is beside one of them. Deep are walls without FREE cells within `DEEP_CELLS`.
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


def _noise(wall: Bools, free: Bools, resolution_m: float) -> float:
    """Return the noise of `CleanWalls`.

    Rays that end at a wall without noise mark one layer of cells with smooth faces; with noise they mark several, with
    rough ones. Walls of plans are thick too, but smooth.
    """
    facing = wall & ndimage.binary_dilation(free, structure=_SQUARE)
    depth_m = float((wall & ~facing).sum() / max(1, facing.sum()) * resolution_m)
    ragged = np.interp(ragged_edges(wall), _RAGGED, (0.0, 1.0))
    return float(ragged * -math.expm1(-depth_m / _DEPTH_M)) if depth_m > 0.0 else 0.0


def ragged_edges(wall: Bools) -> float:
    """Return the fraction of edges of walls that are shifted by one cell between two edges in line.

    A straight wall has none, at any tilt, but at its ends.
    """
    edges = ragged = 0
    for turns in _TURNS:
        turned = np.pad(np.rot90(wall, turns), 1)
        edge = turned[:, :-1] & ~turned[:, 1:]
        shifted = np.zeros_like(edge)
        shifted[:, 1:] |= edge[:, :-1]
        shifted[:, :-1] |= edge[:, 1:]
        edges += int(edge.sum())
        ragged += int((edge[:-2] & edge[2:] & ~edge[1:-1] & shifted[1:-1]).sum())
    return ragged / max(1, edges)


def _levelled(wall: Bools, free: Bools) -> tuple[Bools, Bools]:
    """Return the walls and the FREE cells with level faces."""
    for level in (_without_bumps, _without_notches) * 2:
        for turns in _TURNS:
            turned = level(np.rot90(wall, turns), np.rot90(free, turns))
            wall, free = (np.rot90(mask, -turns) for mask in turned)
    return wall, free


def _unknown_gaps(wall: Bools, free: Bools, longest: int) -> Bools:
    """Return the UNKNOWN cells that close gaps between two pieces of wall.

    A gap is a row of UNKNOWN cells beside FREE ones, at most `longest`, that ends at two pieces. The shortest line
    between these closes it, or, where rays passed that line, the row itself.
    """
    gap = ndimage.binary_dilation(free) & ~free & ~wall
    label, _ = ndimage.label(gap, structure=_SQUARE)
    pieces, _ = ndimage.label(wall & ndimage.binary_dilation(gap, structure=_SQUARE), structure=_SQUARE)
    filled = np.zeros_like(wall)
    for index, box in enumerate(ndimage.find_objects(label), start=1):
        if max(side.stop - side.start for side in box) <= longest:
            around = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in box)
            row = label[around] == index
            ends = np.where(ndimage.binary_dilation(row, structure=_SQUARE), pieces[around], 0)
            if len(np.unique(ends)) > 2:
                low, high = (np.argwhere(ends == value) for value in (ends[ends > 0].min(), ends.max()))
                apart = np.abs(low[:, None] - high[None]).max(axis=2)
                from_to = low[np.argmin(apart) // len(high)], high[np.argmin(apart) % len(high)]
                line = np.zeros(ends.shape, dtype=bool)
                line[tuple(np.rint(np.linspace(*from_to, int(apart.min()) + 1)).astype(int).T)] = True
                filled[around] |= row if (free[around] & line).any() else line
    return filled & ~wall


def row_runs(mask: Bools) -> tuple[Indices, Indices, Indices]:
    """Row, first column and one past the last column of every horizontal run of True, in reading order."""
    step = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, start = np.nonzero(step == 1)
    return row, start, np.nonzero(step == -1)[1]


def _fill_pinholes(wall: Bools) -> Bools:
    label, count = ndimage.label(np.pad(~wall, 1, constant_values=True))
    size = np.bincount(label.ravel(), minlength=count + 1)
    size[[0, label[0, 0]]] = PINHOLE_CELLS + 1
    return wall | (size <= PINHOLE_CELLS)[label[1:-1, 1:-1]]


def _without_notches(was_wall: Bools, was_free: Bools) -> tuple[Bools, Bools]:
    """Fill notches of one or two FREE cells in faces that look towards larger rows: walls and FREE cells."""
    wall, free = was_wall.copy(), was_free.copy()
    row, start, end = row_runs(free)
    keep = (end - start <= MAX_GAP_CELLS) & (start > 0) & (end < wall.shape[1]) & (row >= 1)
    for i, a, b in zip(row[keep], start[keep], end[keep], strict=True):
        if was_wall[i, a - 1] and was_wall[i, b] and not free[i - 1, a - 1 : b + 1].any():
            wall[i, a:b], free[i, a:b] = True, False
    return wall, free


def _without_bumps(was_wall: Bools, was_free: Bools) -> tuple[Bools, Bools]:
    """Move bumps of one or two cells back into faces that look towards larger rows: walls and FREE cells."""
    wall, free = was_wall.copy(), was_free.copy()
    row, start, end = row_runs(wall)
    keep = (end - start <= MAX_GAP_CELLS) & (start > 0) & (end < wall.shape[1]) & (row >= 1)
    for i, a, b in zip(row[keep], start[keep], end[keep], strict=True):
        sides = was_free[i, a - 1] and was_free[i, b] and was_wall[i - 1, a - 1] and was_wall[i - 1, b]
        if sides and not was_free[i - 1, a:b].any() and was_free[i + 1 : i + 2, a - 1 : b + 1].all():
            wall[i, a:b], free[i, a:b], wall[i - 1, a:b] = False, True, True
    return wall, free


def _short_gaps(wall: Bools, free: Bools, resolution_m: float, bridge_gap_m: float) -> Bools:
    """Return the cells of short horizontal gaps between walls that are longer than they are thick."""
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
    label, _ = ndimage.label(filled)
    thickness = [0] + [rows.stop - rows.start for rows, _ in ndimage.find_objects(label)]
    for k in index:
        filled[row[k], end[k] : start[k + 1]] = beside[k] >= thickness[label[row[k], end[k]]]
    return filled


def _thin(wall: Bools, free: Bools) -> tuple[Bools, Bools]:
    """Thin walls of two cells to one, keeping the cells that face FREE ones where only one side does."""
    label, _ = ndimage.label(wall, structure=_SQUARE)
    small = [False] + [max(s.stop - s.start for s in box) <= _POST_CELLS for box in ndimage.find_objects(label)]
    kept = ndimage.binary_opening(wall, structure=_SQUARE) | np.array(small, dtype=bool)[label]
    facing = ndimage.binary_dilation(free, structure=_SQUARE)
    kept |= ~ndimage.binary_opening(wall, structure=np.ones((2, 2), dtype=bool))
    width, height = np.zeros((2, *wall.shape), dtype=np.uint8)  # of the runs through every cell, at most 255
    for length, cells in ((width, wall), (height.T, wall.T)):
        _, start, end = row_runs(cells)
        length[cells] = np.repeat(np.minimum(end - start, 255), end - start)
    thinned = np.pad(wall, 1)
    for removable in (~kept & ~facing, ~kept):
        for (dy, dx), across in (((1, 0), height), ((-1, 0), height), ((0, 1), width), ((0, -1), width)):
            side = ~np.roll(thinned, (-dy, -dx), (0, 1))
            thinned &= ~_peeled(thinned, side & np.pad(removable & (across <= np.minimum(width, height)), 1))
    return thinned[1:-1, 1:-1], wall & ~thinned[1:-1, 1:-1] & facing


def _peeled(wall: Bools, candidates: Bools) -> Bools:
    """Return the candidates whose removal, one after the other, neither parts the wall nor opens it nor shortens it."""
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
