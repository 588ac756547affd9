"""Floor plans as pictures -> PartialMap: walls are dark, wide lines."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps
from scipy import ndimage

from sionna_partial.arrays import Bools, Indices, States
from sionna_partial.checks import number_of, shown
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.environment import ImportNotes
from sionna_partial.maps.importers.drawing_units import POSSIBLE_M
from sionna_partial.maps.mesh.cells import DEFAULT_RESOLUTION_M, states_of_lines
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.ros_map import bare_image, opened_image

THIN_M, FILLED_FRACTION = 0.06, 0.3
"""Width of thin lines (furniture, doors, dimensions) [m], and least fraction of dark pixels in wider lines on plans
with filled walls."""

HATCH_M, THINNEST_M, HATCHED_FRACTION = 0.15, 0.1, 0.02
"""Widest space between the lines of a hatch, least thickness of hatched walls [m], and least fraction of dark pixels
inside them: walls of two lines have none."""

MARK_M = 0.5
"""Largest extent along x and y of text or symbols [m]."""


def read_picture(path: Path, *, resolution_m: float | None = None, threshold: int | None = None) -> PartialMap:
    """Read a floor plan from a picture with dark walls on bright ground, or the inverse.

    `resolution_m` is the edge of a pixel, `threshold` the largest shade of walls in `wall_shades`, by default
    Otsu's. The origin is the lower-left corner.
    """
    if resolution_m is None:
        raise bare_image(path)
    pixel_m = number_of(resolution_m)
    if not 1e-4 <= pixel_m <= 10.0:
        remedy = "give the metres per pixel, a known length [m] over its number of pixels, from 0.0001 to 10."
        raise MapError(f"resolution_m = {shown(resolution_m)} is not allowed: {remedy}")
    notes = ImportNotes(path, pixel_m, "resolution_m, metres per pixel")
    wall = _walls(path, pixel_m, threshold, notes)
    factor = max(1, math.floor(DEFAULT_RESOLUTION_M / pixel_m + 1e-6))
    wall = np.flipud(wall)
    wall = np.pad(wall, [(0, -size % factor) for size in wall.shape])
    ny, nx = (size // factor for size in wall.shape)
    wall = np.asarray(wall.reshape(ny, factor, nx, factor).any(axis=(1, 3)))
    rows, columns = (np.flatnonzero(wall.any(axis=axis)) for axis in (1, 0))
    wall = np.pad(wall[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], 1)
    cell_m = factor * pixel_m
    extent_m = cell_m * max(wall.shape)
    if not POSSIBLE_M[0] <= extent_m <= POSSIBLE_M[1]:
        remedy = "give the metres per pixel, a known length [m] over its number of pixels."
        raise MapError(f"resolution_m = {pixel_m:g} makes walls that span {extent_m:g} m: {remedy}")
    origin_m = (columns[0] - 1) * cell_m, (rows[0] - 1) * cell_m
    empty = PartialMap(np.full(wall.shape, CellState.UNKNOWN), cell_m, origin_m)
    state = states_of_lines(np.zeros((0, 2, 2)), empty, wall)
    if not (state == CellState.FREE).any():
        remedy = "give a picture in which walls are the darkest lines and close rooms, up to doors of 2 m."
        raise MapError(f"path = '{path}' has walls that enclose nothing with resolution_m = {pixel_m:g}: {remedy}")
    remedy = "give the metres per pixel as resolution_m."
    return notes.attached_to(replace(empty, state=state), size=remedy, doors=remedy)


def wall_shades(path: Path) -> tuple[States, int, bool]:
    """Return shades of grey (rows, columns), dark for walls, Otsu's threshold, and whether they were inverted."""
    shade = _shades(path)
    count = np.bincount(shade.ravel(), minlength=256)
    if np.count_nonzero(count) < 2:
        raise MapError(f"path = '{path}' has one shade alone: give a picture of walls on a ground of another shade.")
    threshold = otsu_threshold(count)
    if (shade <= threshold).mean() > 0.5:
        return 255 - shade, 254 - threshold, True
    return shade, threshold, False


def _walls(path: Path, pixel_m: float, threshold: int | None, notes: ImportNotes) -> Bools:
    shade, otsu, is_inverted = wall_shades(path)
    most, source = (otsu, "Otsu's threshold") if threshold is None else (threshold, "as given")
    wall = shade <= most
    side = f"above {254 - most}" if is_inverted else f"up to {most}"
    notes.notes.append(f"walls: shades {side} of 255 ({source})")
    width = round(THIN_M / pixel_m)
    if width > 1:
        wide = ndimage.binary_opening(wall, np.ones((width, width), dtype=bool))
        if wide.sum() < FILLED_FRACTION * wall.sum():
            wide = _hatched(wall, pixel_m)
        if wide.any():
            notes.skip("thin lines", ndimage.label(wall & ~wide)[1], f"narrower than {width * pixel_m:.2g} m")
            wall = wide
    pieces, _ = ndimage.label(wall, np.ones((3, 3), dtype=bool))
    longest = MARK_M / pixel_m
    small = [max(part.stop - part.start for part in extent) <= longest for extent in ndimage.find_objects(pieces)]
    notes.skip("separate marks", sum(small), f"text or symbols up to {MARK_M:g} m")
    wall = np.array([False, *(not is_small for is_small in small)])[pieces]
    notes.use("connected walls", len(small) - sum(small))
    if not wall.any():
        what = f"path = '{path}' has no connected walls longer than {MARK_M:g} m with resolution_m = {pixel_m:g}"
        raise MapError(f"{what}: give the metres per pixel, or a picture with darker walls.")
    return np.asarray(wall)


def _hatched(wall: Bools, pixel_m: float) -> Bools:
    """Return the pixels (rows, columns) of hatched walls with the space between their lines, none without such walls.

    Separate marks are left out first: the letters of a text would close to a wall.
    """
    margin = math.ceil(HATCH_M / pixel_m)
    pieces, _ = ndimage.label(np.pad(wall, margin), np.ones((3, 3), dtype=bool))
    longest = [0, *(max(side.stop - side.start for side in box) for box in ndimage.find_objects(pieces))]
    lines = (np.array(longest) * pixel_m > MARK_M)[pieces]
    radius, width = HATCH_M / 2 / pixel_m, max(2, round(THINNEST_M / pixel_m))
    closed = ndimage.distance_transform_edt(ndimage.distance_transform_edt(~lines) <= radius) > radius
    band = ndimage.binary_opening(closed, np.ones((width, width), dtype=bool))
    inside = ndimage.distance_transform_edt(band) > THIN_M / pixel_m / 2
    is_hatched = (lines & inside).sum() >= HATCHED_FRACTION * inside.sum() > 0
    if not (is_hatched and (lines & band).sum() >= FILLED_FRACTION * lines.sum()):
        return np.zeros_like(wall)
    return np.asarray(band[margin:-margin, margin:-margin])


def _shades(path: Path) -> States:
    image = ImageOps.exif_transpose(opened_image(path, f"path = '{path}'", ("PNG", "JPEG", "BMP")))
    if image.mode.startswith(("I", "F")):
        values = np.asarray(image, dtype=np.float64)
        return np.asarray(255 * (values - values.min()) / max(float(np.ptp(values)), 1e-9), dtype=np.uint8)
    if image.has_transparency_data:
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image.convert("RGBA"))
    return np.asarray(image.convert("L"))


def otsu_threshold(count: Indices) -> int:
    """Return the largest shade of the darker class (Otsu, IEEE Trans. SMC-9, 1979)."""
    shade = np.arange(len(count))
    dark, total = np.cumsum(count)[:-1], count.sum()
    mean_dark = np.cumsum(count * shade)[:-1] / np.maximum(dark, 1)
    mean_bright = ((count * shade).sum() - np.cumsum(count * shade)[:-1]) / np.maximum(total - dark, 1)
    between = dark * (total - dark) * (mean_dark - mean_bright) ** 2
    return int(np.flatnonzero(between == between.max()).mean())
