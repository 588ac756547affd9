"""ImportReport: elements of a file that a reader used and skipped, and the size of the resulting map."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.constants import CellState
from sionna_partial.display import Shown
from sionna_partial.maps.environment import Elements, ImportSource
from sionna_partial.process import njit

MAX_ROOM_CELLS = 1_000_000
"""Size above which plans are coarsened to count rooms [cells]."""

OPENING_RATIO = 0.65
"""Largest width of an opening, relative to the widest circle in the smaller room beside it."""

SMALLEST_RADIUS_CELLS = 4.0
"""Radius of the widest circle in the smallest room [cells]."""

SIZES_M, DOORS_M = (3.0, 300.0), (0.5, 3.0)
"""Plausible longer sides of a building, and plausible widths of doors [m]."""

ENCLOSED_FRACTION = 0.1
"""Smallest free fraction of the extent of a building."""

FREE_FRACTION = 0.01
"""Smallest free fraction of the extent of any map."""

SHOWN_ROWS = 30


class Rooms(NamedTuple):
    """Number of rooms, and widths of the widest openings between them [m], one for each joined room."""

    number: int
    openings_m: Floats


def rooms_of(free: Bools, resolution_m: float) -> Rooms:
    """Find rooms and openings among the free cells (ny, nx) of a plan.

    Cells are visited by falling distance from walls. An opening is where two wider areas meet.
    """
    factor = math.ceil(math.sqrt(free.size / MAX_ROOM_CELLS))
    if factor > 1:
        for axis, size in enumerate(free.shape):  # a block is free if all of its cells are
            free = np.logical_and.reduceat(free, np.arange(0, size, factor), axis=axis)
    clearance = scipy.ndimage.distance_transform_edt(np.pad(free, 1)).astype(np.float32)
    inside = np.flatnonzero(clearance)
    order = inside[np.argsort(-clearance.ravel()[inside], kind="stable")]
    openings, areas = _join(clearance.ravel(), order, clearance.shape[1], OPENING_RATIO, SMALLEST_RADIUS_CELLS)
    return Rooms(areas + len(openings), np.sort((2.0 * openings - 1.0) * resolution_m * factor))


@njit(cache=True)
def _join(clearance, order, nx, ratio, smallest):
    parent = np.full(len(clearance), -1)
    openings, count, areas = np.zeros(len(order)), 0, 0
    for cell in order:
        parent[cell] = root = cell
        for neighbour in (cell - nx, cell - 1, cell + 1, cell + nx):
            other = neighbour
            if parent[other] < 0:
                continue
            while parent[other] != other:
                parent[other] = parent[parent[other]]
                other = parent[other]
            if other == root:
                continue
            high, low = (root, other) if clearance[root] >= clearance[other] else (other, root)
            if clearance[low] >= smallest and clearance[cell] <= ratio * clearance[low]:
                openings[count] = clearance[cell]
                count += 1
            parent[low] = root = high
    for cell in order:
        areas += parent[cell] == cell and clearance[cell] >= smallest
    return openings[:count].copy(), areas


@dataclass(frozen=True)
class ImportReport(ImportSource, Shown):
    """Report of a map that was read from a file; size, rooms and doors follow from its cells.

    Parameters
    ----------
    file : str
        Path of the file.
    unit_m : float
        Length of a unit of the file [m].
    unit_source : str
        A header, an option, the file format, or a guess.
    used, skipped : tuple of Elements
        Elements of the file.
    notes : tuple of str
        Further decisions.
    extent_m : (float, float)
        Extent of the known cells along x and y [m].
    rooms : int
    free_area_m2 : float
        Area of the free cells [m^2].
    door_widths_m : tuple of float
        Widths of the openings between rooms, to a cell [m].
    """

    extent_m: tuple[float, float] = (0.0, 0.0)
    rooms: int = 0
    free_area_m2: float = 0.0
    door_widths_m: tuple[float, ...] = ()

    def __str__(self) -> str:
        (x, y), widths = self.extent_m, self.door_widths_m
        doors = f"{widths[0]:.2f} to {widths[-1]:.2f} m (median {np.median(widths):.2f} m)" if widths else "none"
        lines = {
            "file": self.file,
            "unit": f"{self.unit_m:g} m ({self.unit_source})",
            "extent": f"{x:.4g} x {y:.4g} m",
            "rooms": f"{self.rooms}",
            "free area": f"{self.free_area_m2:.4g} m2",
            "doors": f"{len(widths)}: {doors}" if widths else doors,
            "used": _listed(self.used),
            "skipped": _listed(self.skipped),
            "notes": list(self.notes),
        }
        rows = [
            (name, text) for name, value in lines.items() for text in ([value] if isinstance(value, str) else value)
        ]
        names = [
            name if name != before else "" for (name, _), (before, _) in zip(rows, [("", ""), *rows], strict=False)
        ]
        return "\n".join(f"{name:11}{text}" for name, (_, text) in zip(names, rows, strict=True))

    def faults(self, size: str, doors: str, area: str, free: str) -> Iterable[str]:
        """Yield implausible results with their remedies; an empty remedy skips its check."""
        (x, y), widths = self.extent_m, self.door_widths_m
        if size and not SIZES_M[0] <= max(x, y) <= SIZES_M[1]:
            yield f"spans {x:.4g} x {y:.4g} m, with {self._unit}: {size}"
        if doors and widths and not any(DOORS_M[0] <= width <= DOORS_M[1] for width in widths):
            yield f"has doors of {widths[0]:.2f} to {widths[-1]:.2f} m, with {self._unit}: {doors}"
        if area and self.free_area_m2 < ENCLOSED_FRACTION * x * y:
            yield f"encloses {self.free_area_m2:.3g} m2 in an extent of {x:.4g} x {y:.4g} m: {area}"
        elif free and max(x, y) > 0 and self.free_area_m2 < FREE_FRACTION * x * y:
            yield f"has {self.free_area_m2:.3g} m2 free in an extent of {x:.4g} x {y:.4g} m: {free}"

    @property
    def _unit(self) -> str:
        return f"a unit of {self.unit_m:g} m ({self.unit_source})"


def report_of(source: ImportSource, state: States, resolution_m: float) -> ImportReport:
    free = state == CellState.FREE
    rooms = rooms_of(free, resolution_m)
    (y, x) = next(iter(scipy.ndimage.find_objects((state != CellState.UNKNOWN).astype(np.uint8))), (slice(0, 0),) * 2)
    extent_m = (x.stop - x.start) * resolution_m, (y.stop - y.start) * resolution_m
    area_m2, doors_m = float(free.sum()) * resolution_m**2, tuple(rooms.openings_m.tolist())
    return ImportReport(
        **vars(source), extent_m=extent_m, rooms=rooms.number, free_area_m2=area_m2, door_widths_m=doors_m
    )


def _listed(rows: tuple[Elements, ...]) -> list[str]:
    texts = [f"{row.name}: {row.count:,}{f' ({row.reason})' if row.reason else ''}" for row in rows[:SHOWN_ROWS]]
    more = len(rows) - SHOWN_ROWS
    return [*texts, f"and {more:,} more"] if more > 0 else texts
