"""Orientation of scans: the axis that points up, its sign, and how far floors and walls lean."""

import math
import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats
from sionna_partial.errors import MapError
from sionna_partial.maps.environment import ImportNotes, MapWarning
from sionna_partial.maps.mesh.cells import LOWEST_CEILING_M, fitted_grid, mark_cells

TURNS = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
"""Rotations (3, 3) from the axes of a file to the world by the axis of the file that points up."""

HIGHEST_ROOM_M, FLOORS_RATIO = 6.0, 1.5
"""Height of usual storeys [m]; ratio of floors to walls from which y of a taller scan points up."""

SMALLEST_LEAN_DEG, LARGEST_LEAN_DEG, SEARCHED_DEG = 0.5, 10.0, 45.0
"""Angles from which scans are levelled, up to which they are, and up to which their direction up is searched."""

CONES_DEG = (8.0, 4.0, 2.0, 1.0)
"""Largest deviations of floors and walls from the direction up, which is refined step by step."""

AGREEING, BETTER = 0.3, 1.5
"""Least fraction of the surfaces that fit a direction up, and least ratio to those that fit the axis."""

BLOCK_M, FLAT_RATIO = 1.0, 0.03
"""Edge of the blocks in which normals are averaged [m]; largest ratio of variances across and along a surface."""

FURNITURE_M, PLATEAU_M, PLATEAU_M2 = (0.3, 1.1), 0.4, 0.5
"""Heights above the floor, least width [m] and least area [m²] of flat surfaces that are furniture."""

PLATEAU_CELL_M = 0.1

END_M = 0.3
"""Height of the lowest and highest parts of a scan, in which floor and ceiling are [m]."""


class Surfaces(NamedTuple):
    """Surfaces of a scan by their normals (N, 3), with either sign, and their areas (N,)."""

    normal: Floats
    area: Floats


class Ends(NamedTuple):
    """Flat surfaces [m²] of floor and ceiling, and of furniture above the lower end and below the upper one."""

    floor_m2: float
    ceiling_m2: float
    low_m2: float
    high_m2: float

    @property
    def upside_down(self) -> bool:
        """Return whether furniture hangs from above, or, without furniture, the only floor is above."""
        if max(self.low_m2, self.high_m2) >= PLATEAU_M2:
            return self.high_m2 > 2.0 * self.low_m2
        return self.ceiling_m2 > 0.0 and self.floor_m2 < 0.1 * self.ceiling_m2


def looks_y_up(extent_m: Floats, across_y: float, across_z: float) -> bool:
    """Return whether a scan is lowest along y, as high as a room, and has most area across y."""
    x, y, z = extent_m
    ratio = 1.0 if y <= HIGHEST_ROOM_M else FLOORS_RATIO
    return bool(LOWEST_CEILING_M <= y < min(x, z) and across_y > ratio * across_z)


def warn_of_axis(what: str, found: str, read: str, why: str = "") -> None:
    """Warn if the axis `found` points up instead of the axis `read`."""
    if found != read:
        remedy = f'give up="{found}" to turn it, or up="{read}" to read it as it is.'
        warnings.warn(f"{what} looks as if {found} pointed up{why}: {remedy}", MapWarning, stacklevel=4)


def surfaces_of(corners_m: Floats) -> Surfaces:
    """Return the mean surfaces of triangles (F, 3, 3), by blocks and directions."""
    doubled = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    axis = np.argmax(np.abs(doubled), axis=1)
    sign = np.where(np.take_along_axis(doubled, axis[:, None], axis=1)[:, 0] < 0.0, -1.0, 1.0)
    doubled *= sign[:, None]
    block = _blocks(corners_m.mean(axis=1)) * 3 + axis
    _, group = np.unique(block, return_inverse=True)
    total = np.stack([np.bincount(group, doubled[:, k]) for k in range(3)], axis=1)
    area = np.linalg.norm(total, axis=1)
    kept = area > 0.0
    return Surfaces(total[kept] / area[kept, None], area[kept] / 2)


def surfaces_of_points(points_m: Floats) -> Surfaces:
    """Return planes fitted to points (N, 3) by blocks, with the numbers of their points as areas."""
    _, group = np.unique(_blocks(points_m), return_inverse=True)
    count = np.bincount(group).astype(np.float64)
    mean = np.stack([np.bincount(group, points_m[:, k]) for k in range(3)], axis=1) / count[:, None]
    away = points_m - mean[group]
    spread = np.empty((len(count), 3, 3))
    for i in range(3):
        for k in range(3):
            spread[:, i, k] = np.bincount(group, away[:, i] * away[:, k]) / count
    variance, axes = np.linalg.eigh(spread)
    flat = (count >= 10) & (variance[:, 0] < FLAT_RATIO * variance[:, 1])
    return Surfaces(axes[flat, :, 0], count[flat])


def _blocks(points_m: Floats) -> NDArray[np.int64]:
    index = np.floor((points_m - points_m.min(axis=0, initial=0.0)) / BLOCK_M).astype(np.int64)
    size = index.max(axis=0, initial=0) + 1
    return (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]


def levelling(what: str, surfaces: Surfaces, notes: ImportNotes) -> Floats:
    """Return the rotation (3, 3) that levels a scan, with a warning, or raise a MapError if it leans too far."""
    up = direction_up(surfaces)
    lean_deg = math.degrees(math.acos(min(up[2], 1.0)))
    if lean_deg < SMALLEST_LEAN_DEG:
        return np.eye(3)
    if lean_deg > LARGEST_LEAN_DEG:
        remedy = f"turn it in the program that it comes from; up to {LARGEST_LEAN_DEG:g} degrees are levelled here."
        raise MapError(f"{what} leans by {lean_deg:.1f} degrees, so that its floor is not level: {remedy}")
    notes.notes.append(f"levelled: it leant by {lean_deg:.1f} degrees")
    warnings.warn(
        f"{what} leans by {lean_deg:.1f} degrees, and is levelled about its middle.", MapWarning, stacklevel=5
    )
    x, y, z = up
    return np.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]]
    )


def direction_up(surfaces: Surfaces) -> Floats:
    """Return the direction (3,) that most floors and ceilings are across, and most walls along; z if none is clear."""
    normal, area = surfaces
    vertical, found = np.array([0.0, 0.0, 1.0]), area.sum()
    if not found > 0.0:
        return vertical
    step = math.radians(2.5)
    tilt = np.arange(-math.radians(SEARCHED_DEG), math.radians(SEARCHED_DEG) + step / 2, step)
    tilts = np.stack(np.meshgrid(tilt, tilt), axis=-1).reshape(-1, 2)
    tilts = tilts[np.argsort(np.hypot(*tilts.T), kind="stable")]  # of equal ones the least is taken
    angle = np.hypot(*tilts.T)
    tried = np.column_stack([tilts * np.sinc(angle / np.pi)[:, None], np.cos(angle)])[
        angle <= math.radians(SEARCHED_DEG)
    ]
    scores = np.zeros(len(tried))
    for start in range(0, len(area), 2_000):
        along = (normal[start : start + 2_000] @ tried.T) ** 2
        fits = np.exp(-(1.0 - along) / (2 * step**2)) + np.exp(-along / (2 * step**2))
        scores += area[start : start + 2_000] @ fits
    up = tried[np.argmax(scores > (1.0 - 1e-9) * scores.max())]
    for cone_deg in CONES_DEG:
        flat, steep = _fitting(normal, up, cone_deg)
        sums = (normal * (area * (1.0 * flat - 1.0 * steep))[:, None]).T @ normal
        values, axes = np.linalg.eigh(sums)
        if values[2] - values[1] < 0.05 * found:
            return vertical
        up = axes[:, 2] * np.sign(axes[:, 2] @ up)
    lean_deg = math.degrees(math.acos(min(abs(float(up[2])), 1.0)))
    agree, level = (area[np.logical_or(*_fitting(normal, axis, lean_deg / 2))].sum() for axis in (up, vertical))
    return up if agree >= AGREEING * found and agree >= BETTER * level else vertical


def _fitting(normal: Floats, up: Floats, deviation_deg: float) -> tuple[Bools, Bools]:
    along = np.abs(normal @ up)
    return along > math.cos(math.radians(deviation_deg)), along < math.sin(math.radians(deviation_deg))


def mesh_ends(corners_m: Floats) -> Ends:
    """Return the flat surfaces at the ends of triangles (F, 3, 3) with z up."""
    doubled = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    size = np.linalg.norm(doubled, axis=1)
    flat = np.abs(doubled[:, 2]) > 0.97 * size
    corners, area, z = corners_m[flat], size[flat] / 2, corners_m[flat, :, 2].mean(axis=1)
    if not len(area):
        return Ends(0.0, 0.0, 0.0, 0.0)
    heights_m = z - corners_m[..., 2].min(), corners_m[..., 2].max() - z
    ends = [float(area[height_m < END_M].sum()) for height_m in heights_m]
    return Ends(*ends, *(_plateaus_m2(corners[(h > FURNITURE_M[0]) & (h < FURNITURE_M[1])]) for h in heights_m))


def _plateaus_m2(corners_m: Floats) -> float:
    if not len(corners_m):
        return 0.0
    bounds_m = np.stack([corners_m.min(axis=(0, 1)), corners_m.max(axis=(0, 1))])
    cell_m = max(PLATEAU_CELL_M, float(np.ptp(bounds_m[:, :2], axis=0).max()) / 2000)
    if cell_m > PLATEAU_M:
        return 0.0
    empty = fitted_grid(bounds_m, cell_m)
    polygons = np.zeros((len(corners_m), 5, 2))
    polygons[:, :3] = (corners_m[..., :2] - empty.origin_m) / cell_m
    cells = np.zeros(empty.shape, dtype=np.bool_)
    mark_cells(polygons, np.full(len(corners_m), 3), cells, 1e-6, True)
    return plateaus_m2(cells, cell_m)


def plateaus_m2(cells: Bools, cell_m: float) -> float:
    """Return the area of the parts of cells (ny, nx) that are as wide as furniture [m²]."""
    width = max(1, math.ceil(PLATEAU_M / cell_m - 1e-9))
    return float(ndimage.binary_opening(cells, np.ones((width, width), dtype=bool)).sum()) * cell_m**2
