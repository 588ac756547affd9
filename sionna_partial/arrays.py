"""Types of arrays, read-only arrays of dataclasses, grids of cells, and geometry in the plane."""

import math
from dataclasses import fields
from functools import wraps
from typing import Any, TypeAlias, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from sionna_partial.process import njit

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
Indices: TypeAlias = NDArray[np.intp]

States: TypeAlias = NDArray[np.uint8]

_Class = TypeVar("_Class", bound=type)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only array: the array itself, or a copy if it can be written to."""
    if array.flags.writeable:
        array = array.copy()
        array.setflags(write=False)
    return array


def read_only(cls: _Class) -> _Class:
    """Decorate a frozen dataclass: its arrays are read-only, also after unpickling; writable arrays are copied."""
    build: Any = cls.__init__  # type: ignore[misc]

    def freeze(instance: Any) -> None:
        for field in fields(cls):
            value = getattr(instance, field.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(instance, field.name, frozen(value))

    @wraps(build)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        build(self, *args, **kwargs)
        freeze(self)

    def __setstate__(self: Any, state: dict[str, Any]) -> None:
        vars(self).update(state)
        freeze(self)

    cls.__init__, cls.__setstate__ = __init__, __setstate__  # type: ignore[misc, attr-defined]
    return cls


def cross(first: Floats, second: Floats) -> Floats:
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def with_neighbours(mask: Bools) -> Bools:
    """Return a mask (ny, nx) with the eight neighbours of its cells; scipy.ndimage takes longer to import than maps."""
    wide = np.pad(mask, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]


def largest_part(mask: Bools) -> Bools:
    """Return the largest part of a mask (ny, nx) whose cells touch by edges."""
    labels, _ = scipy.ndimage.label(mask)
    return mask & (labels == np.argmax(np.bincount(labels[mask], minlength=1)))


def largest_by_area(values: Floats, area: Indices, count: int) -> Floats:
    """Return the largest value in each of the areas 0 to `count` of `area`; faster than ndimage.maximum."""
    largest = np.zeros(count + 1)
    np.maximum.at(largest, area.ravel(), values.ravel())
    return largest


def row_runs(mask: Bools) -> tuple[Indices, Indices, Indices]:
    """Return row, first and end column of horizontal runs of True, in reading order."""
    step = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, start = np.nonzero(step == 1)
    return row, start, np.nonzero(step == -1)[1]


def run_lengths(mask: Bools) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return width and height of the runs through every cell, at most 255."""
    width, height = np.zeros((2, *mask.shape), dtype=np.uint8)
    for length, cells in ((width, mask), (height.T, mask.T)):
        _, start, end = row_runs(cells)
        length[cells] = np.repeat(np.minimum(end - start, 255), end - start)
    return width, height


def canonical(grid: States) -> tuple[States, bool, tuple[bool, bool]]:
    """Turn or mirror a grid to the orientation with the smallest bytes, so that results turn with it.

    Returns the grid, whether it was transposed, and whether columns and rows were then flipped.
    """
    turns = [(swap, (x, y)) for swap in (False, True) for y in (False, True) for x in (False, True)]
    grids = [(turned_grid(grid, *turn), *turn) for turn in turns]
    return min(grids, key=lambda turned: (turned[0].shape, turned[0].tobytes()))


def turned_back(grid: Bools, transpose: bool, flips: tuple[bool, bool]) -> Bools:
    """Undo `turned_grid`."""
    grid = grid[:: -1 if flips[1] else 1, :: -1 if flips[0] else 1]
    return grid.T if transpose else grid


def turned_grid(grid: NDArray[Any], transpose: bool, flips: tuple[bool, bool]) -> NDArray[Any]:
    """Transpose a grid, then flip its columns and rows."""
    grid = grid.T if transpose else grid
    return np.ascontiguousarray(grid[:: -1 if flips[1] else 1, :: -1 if flips[0] else 1])


def counted_near(cells: NDArray[np.generic], deviation: float) -> Floats:
    """Add up cells with the weights of a window that is 1 in its middle, about a Gaussian: three box filters."""
    half = round((math.sqrt(4.0 * deviation**2 + 1.0) - 1.0) / 2.0)
    counts = np.pad(cells.astype(np.float64), half)  # so that unknown cells around a map change nothing
    for _ in range(3):
        counts = scipy.ndimage.uniform_filter(counts, 2 * half + 1, mode="constant")
    return 2.0 * math.pi * deviation**2 * counts[half : half + cells.shape[0], half : half + cells.shape[1]]


def grid_edges(cost: Floats) -> tuple[Indices, Floats]:
    """Return pairs (2, E) of neighbouring cells of a grid, in eight directions, and the cost of a step between them.

    A cell that costs 0 cannot be crossed, nor the corner where two such cells meet (unlike in skimage's MCP).
    """
    cell, (ny, nx), passable = np.arange(cost.size).reshape(cost.shape), cost.shape, cost > 0
    ends, costs = [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, ny - down), slice(max(0, -right), nx - max(0, right))
        there = slice(down, ny), slice(max(0, right), nx + min(0, right))
        beside = passable[here[0], there[1]] | passable[there[0], here[1]]
        linked = passable[here] & passable[there] & beside
        ends.append([cell[here][linked], cell[there][linked]])
        costs.append(math.hypot(down, right) * (cost[here][linked] + cost[there][linked]) / 2)
    return np.concatenate(ends, axis=1), np.concatenate(costs)


@njit(cache=True, borrows=True)
def span_in_strip(corners, low, high):  # type: ignore[no-untyped-def]
    """Return the smallest and largest x of a convex polygon (n, 2) within low <= y <= high; inf and -inf if outside."""
    left, right = np.inf, -np.inf
    for here in range(len(corners)):
        x, y = corners[here, 0], corners[here, 1]
        next_x, next_y = corners[(here + 1) % len(corners), 0], corners[(here + 1) % len(corners), 1]
        if low <= y <= high:
            left, right = min(left, x), max(right, x)
        for level in (low, high):
            if (y - level) * (next_y - level) < 0.0:
                at = x + (level - y) / (next_y - y) * (next_x - x)
                left, right = min(left, at), max(right, at)
    return left, right
