"""ROS map_server maps: a YAML file and an image, read as nav2_map_server reads them."""

import math
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from sionna_partial.arrays import Bools, Floats, Indices, States, with_neighbours
from sionna_partial.checks import is_whole, number_of, shown
from sionna_partial.constants import DEFAULT_WALL_HEIGHT_M, CellState
from sionna_partial.errors import MapError, SettingsError
from sionna_partial.files import is_path, lies_in, open_regular, read_bytes
from sionna_partial.maps.environment import MAX_CELLS, ODD_CELLS, ImportNotes, MapWarning, turn_grid
from sionna_partial.maps.partial_map import MAX_INTERIOR_CELLS, PartialMap
from sionna_partial.settings import Material

MODES = ("trinary", "scale", "raw")

UNKNOWN_SHADE = 205

MAX_YAML_BYTES = 1_000_000

MAX_IMAGE_BYTES = 16 * MAX_CELLS

DARK_OCCUPANCY = 0.51
"""Occupancy from which a grey pixel looks like a wall; 127 and 128 often mean unknown."""

SPREAD_FRACTION, REPORTED_FRACTION = 0.25, 0.1
"""Fractions of seen cells between the thresholds from which a map has continuous values, and from which a map of other
values gets a warning. No value may have more than the first fraction of these cells."""

SEPARATION = 4.0
"""Least distance between the mean occupancies of free and wall cells, in standard deviations. Halves of a uniform
distribution have 3.5."""

VALLEY_PERCENT, VALLEY_FRACTION = 2.0, 0.5
"""Half the width of the valley between free cells and walls [percent], and its largest count relative to the counts
around both means."""

FEW_CELLS = 100
"""Number of dark grey pixels, or of wall cells, up to which there is no warning."""

TOUCHED_WALLS = 0.1
"""Fraction of the walls that free cells touch up to which a map looks inflated."""

MAX_YAW_RAD = 6.2832
"""Largest yaw of an origin [rad]: one turn, rounded up; larger values are degrees."""


class _Sheet(NamedTuple):
    source: Path
    image: Path
    mode: str
    negate: bool
    occupied_thresh: float
    free_thresh: float


class _EachKeyOnce(yaml.SafeLoader):
    """Loader that refuses duplicate keys; YAML keeps the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        twice = next((key for index, key in enumerate(keys) if key in keys[:index]), None)
        if twice is not None:
            raise yaml.YAMLError(f"it has the key {twice!r} twice")
        return super().construct_mapping(node, deep)


class _Pixels(NamedTuple):
    """Decoded image, row 0 at the top.

    An opaque pixel of grey shade s (0 to 255) has the level s * `per_shade` + `opaque`.
    """

    level: NDArray[np.uint16]
    per_shade: int = 1
    opaque: int = 0
    alpha: NDArray[np.uint8] | None = None

    @property
    def brightness(self) -> Floats:
        """Brightness of each level, 0 to 1."""
        full = 255 * self.per_shade + self.opaque
        return np.arange(full + 1) / full


def read_ros_map(path: Path, *, strict: bool = False, confined: bool = False) -> PartialMap:
    """Read a ROS map_server YAML and its image, and the mesh if the YAML belongs to an exported scene.

    `strict` reads every pixel as map_server does, even where unknown cells become free or wall. `confined` refuses an
    image outside the YAML's folder.
    """
    raw = _read_yaml(path)
    sheet = _read_sheet(path, raw, confined=confined)
    resolution_m = _number(path, raw, "resolution", 1e-3, 10.0, "metres per cell (not cells per metre)")
    origin = _origin(path, _required(path, raw, "origin"))
    height_m = _number(path, {"wall_height": DEFAULT_WALL_HEIGHT_M, **raw}, "wall_height", 0.1, 100.0, "metres")
    interior = raw.get("interior_cells")
    if interior is not None and not (is_whole(interior) and interior <= MAX_INTERIOR_CELLS):
        raise _refuse(path, "interior_cells", interior, "give the number of free cells of the complete home.")
    material = _material(path, "material", raw.get("material"))
    pixels = _read_pixels(sheet)
    notes = ImportNotes(path, 1.0, f"resolution of the YAML, {resolution_m:g} m for a cell")
    state = _fitted_state(pixels, sheet, notes, strict=strict)
    if state is None:
        state = _classify(pixels, sheet)
        if sheet.mode != "raw" and not strict:
            _keep_unknown(state, pixels, sheet)
        if not (strict or _warn_of_inflation(state, sheet)):
            _warn_of_dark_unknown(state, pixels, sheet)
    state, cell_m, origin_m = turn_grid(np.flipud(state), resolution_m, origin)
    if interior is not None:
        interior *= round(resolution_m / cell_m) ** 2
    mesh = None
    if "mesh" in raw:
        from sionna_partial.maps.mesh.files import read_exported_mesh  # few maps have a mesh, and trimesh is heavy

        mesh = read_exported_mesh(path.parent, raw["mesh"], raw.get("scene_offset"))
    layers: dict[str, Any] = {}
    for name, (listed, target, made) in LAYER_KEYS.items():
        if name in raw:
            given = raw[name]
            image = _image_path(path, given.get("image") if isinstance(given, dict) else None, confined=confined)
            cells = _decode(sheet._replace(image=image))
            layers[target] = tuple(made(path, name, value) for value in _listed(path, name, given, listed))
            layers[name] = _layer(path, name, cells, (listed, layers[target]), pixels.level.shape, origin)
    partial = PartialMap(state, cell_m, origin_m, height_m, interior, mesh, material, **layers)
    return notes.attached_to(partial)


def _listed(path: Path, name: str, given: Any, listed: str) -> list[Any]:
    if not isinstance(given.get(listed), list):
        raise _refuse(path, name, given, f"give an image and a list of {listed}, as save_map does.")
    other = sorted(str(key) for key in given if key not in ("image", listed))
    if other:
        raise MapError(f"{path}: {name} has the unknown keys {shown(other)}: give image and {listed} alone.")
    values: list[Any] = given[listed]
    return values


def _layer(
    path: Path,
    name: str,
    image: Image.Image,
    counted: tuple[str, tuple[Any, ...]],
    shape: tuple[int, ...],
    origin: tuple[float, float, float],
) -> States:
    if image.mode != "L" or image.size != shape[::-1]:
        what = f"an image of {shape[1]} x {shape[0]} shades of grey, 8 bits each: 0 the default, k the k-th listed."
        raise MapError(f"{path}: the image of {name} is of another size or kind: give {what}")
    cells, (listed, values) = np.flipud(np.asarray(image)), counted
    if None in values:
        raise MapError(f"{path}: {name} names none of its {listed} at entry {values.index(None) + 1}: give each one.")
    if cells.max(initial=0) > len(values):
        what = f"has shades up to {cells.max()} for {len(values)} {listed}"
        raise MapError(f"{path}: {name} {what}: list one for each shade from 1 on.")
    turns = round(origin[2] / (math.pi / 2))
    if abs(origin[2] - turns * math.pi / 2) * math.hypot(*cells.shape) > 0.5:
        raise _refuse(path, "origin", [*origin], f"with {name} its yaw must be a quarter turn, or 0.")
    return np.rot90(cells, -turns)


def states_from_percent(percent: NDArray[np.integer], occupied_percent: float, free_percent: float) -> States:
    """Return the CellState of ROS occupancy values as nav2's map_saver draws them.

    Values outside 0 to 100 percent are unknown.
    """
    state = np.full(percent.shape, CellState.UNKNOWN, dtype=np.uint8)
    state[(percent >= 0) & (percent <= free_percent)] = CellState.FREE
    state[(percent <= 100) & (percent >= occupied_percent)] = CellState.WALL
    return state


def fitted_threshold(
    percent: Floats, count: Indices, free_percent: float, occupied_percent: float, notes: ImportNotes, remedy: str
) -> float | None:
    """Return the occupancy that separates free cells and walls in a map of continuous values, else None.

    Such a map, as of Cartographer, has many values between the thresholds. The result is in the valley of the
    histogram (V,), between two well separated distributions with means below and above 50 percent. An empty remedy
    keeps the caller's thresholds.
    """
    between, total = (percent > free_percent) & (percent < occupied_percent), int(count.sum())
    inside = int(count[between].sum())
    if not inside:
        return None
    where = f"an occupancy between {free_percent:g} and {occupied_percent:g} %"
    what = f"{notes.file}: {inside / total:.0%} of the seen cells have {where}"
    is_varied = count[between].max() <= SPREAD_FRACTION * inside
    is_spread = is_varied and inside > max(FEW_CELLS, SPREAD_FRACTION * total)
    threshold = _split(percent, count, between) if remedy and is_spread else None
    if threshold is None:
        notes.skip("seen cells", inside, f"{where}: unknown")
        if remedy and is_varied and inside > max(ODD_CELLS, REPORTED_FRACTION * total):
            warnings.warn(f"{what} and are read as unknown. {remedy}", MapWarning, stacklevel=4)
        return None
    decided = f"walls are the cells from {threshold:.1f} % on, and other seen cells are free"
    notes.notes.append(f"{inside:,} of {total:,} seen cells have {where}: {decided}")
    warnings.warn(f"{what}, as in a map of probabilities: {decided}. {remedy}", MapWarning, stacklevel=4)
    return threshold


def _split(percent: Floats, count: Indices, allowed: Bools) -> float | None:
    order = np.argsort(percent)
    order = order[count[order] > 0]
    value, weight, allowed = percent[order], count[order].astype(np.float64), allowed[order]
    sums = np.cumsum([weight, weight * value, weight * value**2], axis=1)
    low, high = sums[:, :-1], sums[:, -1:] - sums[:, :-1]
    (low_mean, low_var), (high_mean, high_var) = (
        (part[1] / part[0], np.maximum(part[2] / part[0] - (part[1] / part[0]) ** 2, 1.0)) for part in (low, high)
    )
    good = (allowed[:-1] | allowed[1:]) & (low_mean < 50.0) & (high_mean > 50.0)
    good &= high_mean - low_mean >= SEPARATION * np.sqrt((low_var + high_var) / 2)
    middle = (value[:-1] + value[1:]) / 2
    around, around_low, around_high = (
        (np.abs(value - place[:, None]) < VALLEY_PERCENT) @ weight for place in (middle, low_mean, high_mean)
    )
    good &= around < VALLEY_FRACTION * np.minimum(around_low, around_high)
    if not good.any():
        return None
    wide = (np.abs(value - middle[:, None]) < 2.5 * VALLEY_PERCENT) @ weight
    return float(middle[np.lexsort((-np.diff(value), wide, ~good))[0]])


def _refuse(sheet: Path, field: str, value: object, remedy: str) -> MapError:
    return MapError(f"{sheet}: {field} = {shown(value)} is not allowed: {remedy}")


def _read_sheet(path: Path, raw: Mapping[Any, Any], *, confined: bool) -> _Sheet:
    occupied = _number(path, raw, "occupied_thresh", 0.0, 1.0)
    free = _number(path, raw, "free_thresh", 0.0, 1.0)
    if free >= occupied:
        raise _refuse(path, "free_thresh", free, f"give less than occupied_thresh, which is {occupied:g}.")
    mode = raw.get("mode", "trinary")
    if not isinstance(mode, str) or mode.lower() not in MODES:
        raise _refuse(path, "mode", mode, f"choose one of {', '.join(MODES)}.")
    negate = _required(path, raw, "negate")
    if not isinstance(negate, int) or negate not in (0, 1):
        raise _refuse(path, "negate", negate, "give 0 (dark is wall) or 1 (bright is wall).")
    image = _image_path(path, _required(path, raw, "image"), confined=confined)
    return _Sheet(path, image, mode.lower(), bool(negate), occupied, free)


def _material(path: Path, field: str, value: object) -> Material | None:
    try:
        if isinstance(value, str):
            return Material.named(value)
        return None if value is None else Material(**value)  # type: ignore[arg-type]
    except (TypeError, SettingsError) as error:
        names = ", ".join(field.name for field in fields(Material))
        raise _refuse(path, field, value, f"give a name, or {names} ({error}).") from error


def _height_m(path: Path, field: str, value: object) -> float:
    return _number(path, {field: value}, field, 0.01, 100.0, "metres")


def _room_name(path: Path, field: str, value: object) -> str:
    if not isinstance(value, str):
        raise _refuse(path, field, value, "give names of rooms.")
    return value


LAYER_KEYS: dict[str, tuple[str, str, Callable[[Path, str, Any], Any]]] = {
    "wall_material": ("materials", "wall_materials", _material),
    "obstacle": ("heights", "obstacle_heights_m", _height_m),
    "room": ("names", "room_names", _room_name),
}
"""Layers by their keys in the YAML: key of their values, field of the map, reader of a value."""


def _read_yaml(path: Path) -> dict[Any, Any]:
    try:
        loader = _EachKeyOnce(read_bytes(path, "path", MapError, MAX_YAML_BYTES, "give the YAML of a ROS map."))
        raw = loader.get_single_data()
    except MapError:
        raise
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise MapError(f"path = '{path}' is not valid YAML ({reason}): correct it or save the map again.") from error
    if not isinstance(raw, dict):
        what = f"holds {shown(raw)} in place of keys such as image, resolution and origin"
        raise MapError(f"path = '{path}' {what}: give the YAML that a ROS map_saver wrote.")
    return raw


def _required(path: Path, raw: Mapping[Any, Any], key: str) -> Any:
    if key not in raw:
        raise MapError(f"{path}: {key} is missing: add it, as in the YAML that a ROS map_saver writes.")
    return raw[key]


def _number(path: Path, raw: Mapping[Any, Any], key: str, low: float, high: float, unit: str = "") -> float:
    value = _required(path, raw, key)
    number = _float(value)
    if not low <= number <= high:
        raise _refuse(path, key, value, f"give a number{unit and f' of {unit}'} in [{low:g}, {high:g}].")
    return number


def _float(value: object) -> float:
    """Return a number, NaN for anything else. YAML 1.1 reads 5e-2 as text."""
    try:
        return float(value) if isinstance(value, str) else number_of(value)
    except ValueError:
        return math.nan


def _origin(path: Path, value: object) -> tuple[float, float, float]:
    numbers = [_float(number) for number in value] if isinstance(value, list) else []
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise _refuse(path, "origin", value, "give [x, y, yaw] of the lower-left corner, in metres and radians.")
    x, y, yaw = numbers
    if abs(yaw) > MAX_YAW_RAD:
        raise _refuse(path, "origin", value, "its third number is the yaw in radians, one turn at most (not degrees).")
    return x, y, yaw


def _image_path(path: Path, value: object, *, confined: bool) -> Path:
    if not isinstance(value, str) or not value or not is_path(value):
        raise _refuse(path, "image", value, "give the file name of the map image.")
    image = path.parent / value
    if confined and not lies_in(path.parent, value):
        raise _refuse(path, "image", value, "the image of an exported scene lies in the scene's folder.")
    if not os.path.isfile(image):
        raise _refuse(path, "image", value, f"there is no file '{image}'; put the image there or correct the name.")
    return image


def _read_pixels(sheet: _Sheet) -> _Pixels:
    image = _decode(sheet)
    if image.mode.startswith("I"):
        return _Pixels(np.asarray(image).astype(np.uint16), per_shade=257)
    transparent = image.has_transparency_data
    if image.mode in ("1", "L") and not transparent:
        return _Pixels(np.asarray(image.convert("L")).astype(np.uint16))
    channels = np.asarray(image.convert("RGBA" if transparent else "RGB"))
    # Alpha counts as a fourth channel in trinary mode alone (nav2 map_io.cpp, loadMapFromFile).
    four = transparent and sheet.mode == "trinary"
    level = channels[..., : 4 if four else 3].sum(axis=-1, dtype=np.uint16)
    return _Pixels(level, 3, 255 if four else 0, channels[..., 3] if transparent else None)


def _decode(sheet: _Sheet) -> Image.Image:
    image = opened_image(sheet.image, f"{sheet.source}: image = {shown(str(sheet.image))}", ("PPM", "PNG", "BMP"))
    if image.mode == "F":
        raise _refuse(sheet.source, "image", str(sheet.image), "it holds floating-point shades; save a PGM or PNG.")
    return image


def opened_image(path: Path, given: str, formats: tuple[str, ...]) -> Image.Image:
    """Return an image of at most `MAX_CELLS` pixels; errors begin with `given`."""
    try:
        with (
            open_regular(path, given.partition(" = ")[0], MapError, MAX_IMAGE_BYTES) as stream,
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(stream, formats=formats)
            too_large = image.width * image.height > MAX_CELLS
            if not too_large:
                image.load()
    except MapError:
        raise
    except Image.DecompressionBombError:
        too_large = True
    except Exception as error:  # decoders fail in many ways on damaged files
        kinds = " or ".join(", ".join(formats).replace("PPM", "PGM").rsplit(", ", 1))
        remedy = f"it is damaged or not a {kinds} ({error}); save the map again."
        raise MapError(f"{given} is not allowed: {remedy}") from error
    if too_large:
        remedy = f"it has more than {MAX_CELLS:,} cells; cut the map to the building or coarsen it."
        raise MapError(f"{given} is not allowed: {remedy}")
    return image


def bare_image(path: Path) -> MapError:
    remedy = f"give its YAML, such as '{path.with_suffix('.yaml')}'"
    if path.suffix.lower() != ".pgm":
        remedy += ", or resolution_m, the metres per pixel of a floor plan: a known length [m] over its pixels"
    return MapError(f"path = '{path}' is a bare image without resolution and origin: {remedy}.")


def _classify(pixels: _Pixels, sheet: _Sheet) -> States:
    """Classify pixels as nav2's loadMapFromFile does, unknown between the thresholds."""
    shade = pixels.brightness
    if sheet.mode == "raw":
        occupied, free = np.rint(100 * sheet.occupied_thresh), np.rint(100 * sheet.free_thresh)
        table = states_from_percent(np.rint(255 * shade).astype(int), occupied, free)
    else:
        occupancy = shade if sheet.negate else 1.0 - shade
        table = np.full(occupancy.shape, CellState.UNKNOWN, dtype=np.uint8)
        table[occupancy > sheet.occupied_thresh] = CellState.WALL
        table[occupancy < sheet.free_thresh] = CellState.FREE
    state = table[pixels.level]
    if sheet.mode == "scale" and pixels.alpha is not None:
        state[pixels.alpha < 255] = CellState.UNKNOWN
    return state


def _fitted_state(pixels: _Pixels, sheet: _Sheet, notes: ImportNotes, *, strict: bool) -> States | None:
    """Return the states of a map of continuous values, with fitted thresholds; None for any other map.

    Transparent pixels are unknown, and the shade 205, 127 or 128 if far more frequent than its neighbours.
    """
    shade = pixels.brightness
    if sheet.mode == "raw":
        percent = np.rint(255.0 * shade)
        unknown = percent > 100
    else:
        percent, unknown = 100.0 * (shade if sheet.negate else 1.0 - shade), np.zeros(len(shade), dtype=bool)
    opaque = np.ones(pixels.level.shape, dtype=bool) if pixels.alpha is None else pixels.alpha == 255
    count = np.bincount(pixels.level[opaque], minlength=len(shade))
    if sheet.mode != "raw":
        marks = [255 - UNKNOWN_SHADE if sheet.negate else UNKNOWN_SHADE, 127, 128]
        levels = np.array(marks) * pixels.per_shade + pixels.opaque
        level = int(levels[np.argmax(count[levels])])
        beside = np.delete(count, levels)[max(level - 10 * pixels.per_shade, 0) : level + 10 * pixels.per_shade]
        unknown[level] = count[level] > 2 * beside.max(initial=0)
    thresholds = 100.0 * sheet.free_thresh, 100.0 * sheet.occupied_thresh
    remedy = "Pass strict=True to read the file to the letter, or set free_thresh and occupied_thresh in it."
    remedy = "" if strict else remedy
    threshold = fitted_threshold(percent, np.where(unknown, 0, count), *thresholds, notes, remedy)
    if threshold is None:
        return None
    table = np.where(percent >= threshold, CellState.WALL, CellState.FREE).astype(np.uint8)
    table[unknown] = CellState.UNKNOWN
    return np.where(opaque, table[pixels.level], np.uint8(CellState.UNKNOWN))


def _warn_of_inflation(state: States, sheet: _Sheet) -> bool:
    """Warn if hardly any free cell touches a wall, as around inflated obstacles."""
    wall, free = state == CellState.WALL, state == CellState.FREE
    faces = wall & with_neighbours(~wall)
    apart = 1.0 - (faces & with_neighbours(free)).sum() / max(1, faces.sum())
    inflated = bool(faces.sum() > FEW_CELLS and free.any() and apart >= 1.0 - TOUCHED_WALLS)
    if inflated:
        what = f"grey (unknown) lies between {apart:.0%} of the walls and the free cells, as in an inflated costmap"
        remedy = "links across it would be unobserved; save the map of the topic /map or of the static layer."
        warnings.warn(f"{sheet.source}: {what}: {remedy}", MapWarning, stacklevel=4)
    return inflated


def _warn_of_dark_unknown(state: States, pixels: _Pixels, sheet: _Sheet) -> None:
    shade = pixels.brightness[pixels.level]
    occupancy = shade if sheet.negate else 1.0 - shade
    dark = (state == CellState.UNKNOWN) & (occupancy > DARK_OCCUPANCY)
    dark &= True if pixels.alpha is None else pixels.alpha > 0
    if sheet.mode == "raw" or dark.sum() <= max((state == CellState.WALL).sum(), FEW_CELLS):
        return
    lowest = float(occupancy[dark].min())
    what = f"{int(dark.sum()):,} dark grey cells (occupancy from {lowest:.2f}) are read as unknown"
    remedy = f"if they are walls, set occupied_thresh, now {sheet.occupied_thresh:g}, below {lowest:.2f}."
    warnings.warn(f"{sheet.source}: {what}: {remedy}", MapWarning, stacklevel=4)


def _keep_unknown(state: States, pixels: _Pixels, sheet: _Sheet) -> None:
    """Keep transparent pixels and the shade 205 unknown, in place.

    With a free_thresh above 0.196 (older nav2 wrote 0.25), or an alpha channel, 205 would read as free.
    """
    shade, warned = 255 - UNKNOWN_SHADE if sheet.negate else UNKNOWN_SHADE, []
    lost = (pixels.level == shade * pixels.per_shade + pixels.opaque) & (state == CellState.FREE)
    if lost.sum() > (state == CellState.UNKNOWN).sum():
        state[lost] = CellState.UNKNOWN
        count = f"{int(lost.sum())} cells of shade {shade}"
        warned.append(f"{count} would read as free (free_thresh {sheet.free_thresh:g})")
    if pixels.alpha is not None:
        clear = (pixels.alpha == 0) & (state != CellState.UNKNOWN)
        if clear.any():
            state[clear] = CellState.UNKNOWN
            warned.append(f"{int(clear.sum())} transparent cells would read as free or wall")
    for what in warned:
        message = f"{sheet.source}: {what}; they are kept unknown. Pass strict=True to read the file to the letter."
        warnings.warn(message, MapWarning, stacklevel=4)
