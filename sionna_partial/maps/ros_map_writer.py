"""ROS map_server maps, written: a YAML file and PGM images."""

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from sionna_partial.checks import shown
from sionna_partial.constants import CellState
from sionna_partial.errors import OutputError
from sionna_partial.files import atomic_write
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.ros_map import LAYER_KEYS, MAX_YAML_BYTES, UNKNOWN_SHADE

OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
"""Thresholds of written maps (map_server's; the shade 205 stays unknown)."""


class _Plain(yaml.SafeDumper):
    """Dumper that writes NumPy numbers and arrays as Python numbers and lists."""


_Plain.add_multi_representer(
    np.generic,  # type: ignore[type-abstract]
    lambda dumper, value: dumper.represent_data(value.item()),
)
_Plain.add_multi_representer(np.ndarray, lambda dumper, value: dumper.represent_data(value.tolist()))


def write_ros_map(partial: PartialMap, path: Path, extra: Mapping[str, object] | None = None) -> None:
    """Write a map as `path` (YAML) and a PGM image of the same stem.

    With a mesh, the YAML completes the exported scene beside it.
    """
    sheet: dict[str, object] = {"wall_height": partial.wall_height_m}
    if partial.interior_cells is not None:
        sheet["interior_cells"] = int(partial.interior_cells)
    if partial.material is not None:
        sheet["material"] = asdict(partial.material)
    sheet |= partial.environment.sheet()
    images = {}
    for name, (cells, _, values) in partial.layers().items():
        image = f"{path.stem}_{name}.pgm"
        sheet[name] = {"image": image, LAYER_KEYS[name][0]: values}
        images[path.with_name(image)] = cells
    shades = np.empty(len(CellState), dtype=np.uint8)
    shades[[CellState.FREE, CellState.WALL, CellState.UNKNOWN]] = 254, 0, UNKNOWN_SHADE
    sheet = ros_sheet(path, "trinary", partial.resolution_m, partial.origin_m) | sheet
    images[path.with_suffix(".pgm")] = shades[partial.state]
    write_ros_files(path, _yaml_text(sheet, {} if extra is None else extra), images)


def ros_sheet(path: Path, mode: str, resolution_m: float, origin_m: Iterable[float]) -> dict[str, object]:
    """Return the map_server keys of a YAML, for a PGM image of the same stem."""
    return {
        "image": path.with_suffix(".pgm").name,
        "mode": mode,
        "resolution": resolution_m,
        "origin": [*origin_m, 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESHOLD,
        "free_thresh": FREE_THRESHOLD,
    }


def write_ros_files(path: Path, text: str, images: Mapping[Path, NDArray[np.uint8]]) -> None:
    with atomic_write(path, "w") as sheet, ExitStack() as together:
        sheet.write(text)
        sheet.flush()  # a full disk fails here, not after the pictures are there
        for image, pixels in images.items():
            picture = together.enter_context(atomic_write(image))
            picture.write(b"P5\n%d %d\n255\n" % pixels.shape[::-1])
            picture.write(np.flipud(pixels).tobytes())


def _yaml_text(sheet: Mapping[str, object], extra: Mapping[str, object]) -> str:
    names = [] if not isinstance(extra, Mapping) else [*extra]
    own = sorted({*sheet, "interior_cells", "material", "mesh", *LAYER_KEYS}.intersection(map(str, names)))
    if own or names != [name for name in names if isinstance(name, str)] or not isinstance(extra, Mapping):
        what = f"holds {own[0]!r}, which the map sets itself" if own else "has keys that are no text"
        raise OutputError(f"extra = {shown(extra)} {what}: give a mapping of further keys.")
    try:
        text: str = yaml.dump({**sheet, **extra}, Dumper=_Plain, sort_keys=False, default_flow_style=None)
        size = len(text.encode())
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise OutputError(
            f"extra cannot be written as YAML ({reason}): give numbers, texts, lists and mappings."
        ) from error
    if size > MAX_YAML_BYTES:
        raise OutputError(
            f"extra makes a YAML of {size:,} bytes, more than {MAX_YAML_BYTES:,}: leave large values out."
        )
    return text
