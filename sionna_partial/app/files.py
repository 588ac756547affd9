"""Uploaded maps, whose names are not trusted, and downloads."""

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path, PurePath

import xarray as xr

from sionna_partial.app.jobs import logged_warnings
from sionna_partial.arrays import Floats
from sionna_partial.checks import shown
from sionna_partial.constants import (
    BAG_SUFFIXES,
    DRAWING_SUFFIXES,
    IFC_SUFFIXES,
    MESH_SUFFIXES,
    PICTURE_SUFFIXES,
    POINT_SUFFIXES,
    VACUUM_SUFFIXES,
)
from sionna_partial.errors import MapError
from sionna_partial.export import save_coverage, save_network
from sionna_partial.files import unzipped, zipped
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.ros_map import read_ros_map
from sionna_partial.plots.coverage_plot import report_pdf

MOST_BYTES = 200_000_000
"""Largest upload [bytes]."""

_IMAGES, _SHEETS = (".pgm", *PICTURE_SUFFIXES), (".yaml", ".yml")

MAP_SUFFIXES = (
    *(*_SHEETS, ".npz", *MESH_SUFFIXES, *POINT_SUFFIXES, *DRAWING_SUFFIXES, *IFC_SUFFIXES, *BAG_SUFFIXES),
    *VACUUM_SUFFIXES,
)
"""Suffixes of maps; a ROS map comes with its image, or as a zip of both."""

UPLOADED_SUFFIXES = (*MAP_SUFFIXES, *_IMAGES, ".zip")

FILES = {
    "png": "coverage.png",
    "html": "coverage.html",
    "nc": "coverage.nc",
    "tif": "coverage.tif",
    "yaml": "radio_map.zip",
    "pdf": "report.pdf",
    "project": "project.zip",
}
"""Downloads: kind and file name."""


def uploaded_map(files: Sequence[tuple[str, bytes]]) -> PartialMap:
    """Read a map from files (name, content), or raise a MapError; the reader's warnings are logged."""
    with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder, logged_warnings():
        path = stored_map(files, Path(folder))
        return read_ros_map(path, confined=True) if path.suffix in _SHEETS else load_map(path)


def stored_map(files: Sequence[tuple[str, bytes]], folder: Path) -> Path:
    """Write an uploaded map or picture under our own file names; only the suffixes are kept.

    Other files than one map of `MAP_SUFFIXES`, or more than `MOST_BYTES` unzipped, raise a MapError.
    """
    if len(files) == 1 and PurePath(files[0][0]).suffix.lower() == ".zip":
        files = _unzipped(files[0][1])
    by_suffix = {PurePath(name).suffix.lower(): content for name, content in files}
    sheets = [suffix for suffix in by_suffix if suffix in MAP_SUFFIXES and (suffix in _SHEETS or len(files) == 1)]
    images = [suffix for suffix in by_suffix if suffix in _IMAGES]
    names, one = ", ".join(shown(name) for name, _ in files[:3]), len(files) == 1
    both = "choose the YAML and the image of a ROS map together, or a zip of both."
    if one and {*images} & {*PICTURE_SUFFIXES}:
        sheets, images = images, []
    if one and (images or {*sheets} & {*_SHEETS}):
        raise MapError(f"{names} alone is not a map: {both}")
    if len(sheets) != 1 or len(by_suffix) != len(files) or len(sheets) + len(images) != len(files) or len(images) > 1:
        raise MapError(f"{names} cannot be read: give one map ({', '.join(MAP_SUFFIXES)}); {both}")
    path, content = folder / f"map{sheets[0]}", by_suffix[sheets[0]]
    if images:
        (folder / f"map{images[0]}").write_bytes(by_suffix[images[0]])
        content = re.sub(rb"(?m)^image:.*$", f"image: map{images[0]}".encode(), content)
    path.write_bytes(content)
    return path


def _unzipped(content: bytes) -> list[tuple[str, bytes]]:
    try:
        return [*unzipped(content, MOST_BYTES).items()]
    except ValueError as error:
        raise MapError(f"the zip cannot be read ({error}): give a zip of a ROS map's YAML and image.") from error


def coverage_file(
    kind: str,
    coverage: xr.Dataset,
    network: xr.Dataset | None,
    eirp_dbm: Floats,
    threshold_dbm: float,
    heading: Sequence[str] = (),
) -> bytes:
    """Return the content of one of `FILES`; a ROS map is a zip. `heading` is for the report."""
    if kind == "pdf":
        return report_pdf(coverage, eirp_dbm, threshold_dbm, heading)
    with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
        path = Path(folder) / f"coverage.{kind}"
        if kind == "yaml" and network is not None:
            save_network(network, path)
        else:
            save_coverage(coverage.isel(tx=0) if kind == "yaml" else coverage, path)
        made = {each.name: each.read_bytes() for each in sorted(Path(folder).iterdir())}
        return made[path.name] if kind != "yaml" else zipped(made)
