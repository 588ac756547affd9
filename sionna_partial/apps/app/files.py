"""Uploaded maps and projects, which are not trusted, and downloads."""

import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import xarray as xr

from sionna_partial.apps.app.jobs import logged_warnings
from sionna_partial.apps.app.radio import MOST_TRANSMITTERS, RadioSettings, Transmitter, require_name
from sionna_partial.arrays import Floats
from sionna_partial.checks import require, shown
from sionna_partial.constants import (
    BAG_SUFFIXES,
    DRAWING_SUFFIXES,
    GAIN_FLOOR_DB,
    IFC_SUFFIXES,
    MESH_SUFFIXES,
    PICTURE_SUFFIXES,
    POINT_SUFFIXES,
    VACUUM_SUFFIXES,
    CellState,
)
from sionna_partial.errors import MapError
from sionna_partial.export import save_coverage
from sionna_partial.files import decoding, unzipped, zipped
from sionna_partial.maps.map_files import load_map, save_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.ros_map import read_ros_map
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.plots.logo import read_logo
from sionna_partial.plots.report import report_pdf
from sionna_partial.tracing.antennas import Antenna

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

_MAP, _TEXT, _SOURCE, _LOGO, _MEASURED = "map.npz", "project.json", "source", "logo", "measured.csv"
_VERSION, _MOST_TEXT = 1, 20_000_000
_ARRAYS = ("tx", "rx", "gain_db", "std_db")


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


def file_name(uploaded: str, default: str) -> str:
    """Return the name of an uploaded file for a temporary folder, and for messages; other characters become _."""
    return re.sub(r"[^\w. -]", "_", PurePath(uploaded).name)[-100:].lstrip(".") or default


def _unzipped(content: bytes) -> list[tuple[str, bytes]]:
    try:
        return [*unzipped(content, MOST_BYTES).items()]
    except ValueError as error:
        raise MapError(f"the zip cannot be read ({error}): give a zip of a ROS map's YAML and image.") from error


def coverage_file(
    kind: str,
    coverage: xr.Dataset,
    eirp_dbm: Floats,
    threshold_dbm: float,
    heading: Sequence[str] = (),
    *,
    scene: PartialMap | None = None,
    logo: bytes | None = None,
) -> bytes:
    """Return the content of one of `FILES`; a ROS map is a zip.

    `heading` and `logo` are for the report, `scene` for both.
    """
    if kind == "pdf":
        return report_pdf(
            coverage, eirp_dbm=eirp_dbm, threshold_dbm=threshold_dbm, heading=heading, scene=scene, logo=logo
        )
    with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
        path = Path(folder) / f"coverage.{kind}"
        save_coverage(coverage, path, scene=scene, threshold_db=np.clip(threshold_dbm - eirp_dbm, GAIN_FLOOR_DB, 0.0))
        made = {each.name: each.read_bytes() for each in sorted(Path(folder).iterdir())}
        return made[path.name] if kind != "yaml" else zipped(made)


@dataclass(frozen=True)
class Project:
    """State of a window: `source` is the file of its map, with settings, on which `strokes` were drawn."""

    partial: PartialMap
    title: str
    transmitters: Mapping[str, Transmitter] = field(default_factory=dict)
    settings: RadioSettings | None = None
    measured: Measurements | None = None
    view: Mapping[str, Any] = field(default_factory=dict)
    source: tuple[str, bytes, Mapping[str, Any]] | None = None
    strokes: Sequence[Mapping[str, Any]] = ()
    logo: tuple[str, bytes] | None = None


def project_file(project: Project) -> bytes:
    """Return a zip of an `.npz` map and a JSON."""
    measured = project.measured
    record = {
        "version": _VERSION,
        "title": project.title,
        "transmitters": {name: asdict(each) for name, each in project.transmitters.items()},
        "settings": None if project.settings is None else asdict(project.settings),
        "measured": None if measured is None else _measured_record(measured),
        "view": {**project.view},
        "source": None,
        "strokes": [*project.strokes],
        "logo": project.logo and project.logo[0],
    }
    files = {_LOGO: project.logo[1]} if project.logo else dict[str, bytes]()
    if measured is not None:
        files[_MEASURED] = _measured_csv(measured)
    if project.source is not None:
        name, content, values = project.source
        record["source"], files[_SOURCE] = [PurePath(name).name, {**values}], content
    with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
        save_map(project.partial, Path(folder) / _MAP)
        files |= {_MAP: (Path(folder) / _MAP).read_bytes(), _TEXT: json.dumps(record, indent=1).encode()}
        return zipped(files)


def uploaded_project(files: Sequence[tuple[str, bytes]]) -> Project | None:
    """Read a project from uploaded files (name, content); None for other files.

    A damaged project, or values out of range, raise a SionnaPartialError.
    """
    if len(files) != 1 or PurePath(files[0][0]).suffix.lower() != ".zip":
        return None
    try:
        contents = unzipped(files[0][1], MOST_BYTES)
    except ValueError:  # `uploaded_map` raises an error with the reason
        return None
    if _TEXT not in contents:
        return None
    with decoding(Path("project.zip"), "was not saved by the app", MapError, "save it again."):
        require(len(contents[_TEXT]) <= _MOST_TEXT, _TEXT, len(contents[_TEXT]), f"give up to {_MOST_TEXT:,} bytes.")
        record = json.loads(contents[_TEXT])
        require(record["version"] == _VERSION, "version", record["version"], f"this version reads {_VERSION}.")
        with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
            (Path(folder) / _MAP).write_bytes(contents[_MAP])
            partial = load_map(Path(folder) / _MAP)
        return _project(partial, record, contents)


def _project(partial: PartialMap, record: dict[str, Any], contents: Mapping[str, bytes]) -> Project:
    content, logo = contents.get(_SOURCE), contents.get(_LOGO)
    if logo is not None:
        read_logo(logo)
    title, settings, measured, transmitters = str(record["title"])[:100], record["settings"], record["measured"], {}
    require(
        len(record["transmitters"]) <= MOST_TRANSMITTERS, "transmitters", len(record["transmitters"]), "give fewer."
    )
    for name, values in record["transmitters"].items():
        require_name(name)
        transmitters[name] = Transmitter(**values | {"antenna": Antenna(**values["antenna"])})
    links = None if measured is None else Measurements(**measured)
    if links is not None:
        outside = partial.state_at(links.rx) != CellState.WALL  # links in walls are kept, and not used
        partial.require_positions("rx of the measurements", links.rx[outside], least=0)
    return Project(
        partial,
        title,
        transmitters,
        None if settings is None else RadioSettings(**settings),
        links,
        record.get("view", {}),
        (str(record["source"][0]), content, record["source"][1]) if content and record.get("source") else None,
        record.get("strokes", ()),
        None if logo is None else (str(record["logo"])[:100], logo),
    )


def _measured_record(measured: Measurements) -> dict[str, Any]:
    arrays = {name: getattr(measured, name) for name in _ARRAYS}
    listed = {name: None if values is None else values.tolist() for name, values in arrays.items()}
    return {**listed, "sensitivity_db": measured.sensitivity_db}


def _measured_csv(measured: Measurements) -> bytes:
    """Return the measurements as a CSV for `load_measurements`."""
    columns = {f"{end}_{axis}": getattr(measured, end)[:, at] for end in ("tx", "rx") for at, axis in enumerate("xyz")}
    columns |= {"gain_db": measured.gain_db}
    columns |= {} if measured.std_db is None else {"std_db": measured.std_db}
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    return "".join(",".join(map(str, row)) + "\n" for row in [columns, *rows]).encode()


def script(project: Project, python_map: Sequence[str]) -> str:
    """Return the Python lines that compute the coverage of a project, whose map some lines read."""
    settings, transmitters = project.settings or RadioSettings(), project.transmitters.values()
    powers, antennas = [each.eirp_dbm for each in transmitters], [each.antenna for each in transmitters]
    trace = [f"frequency_hz={settings.frequency_hz!r}"]
    trace += [] if settings.through_walls is None else [f"refraction={settings.through_walls}"]
    given = [f"rx_height_m={settings.rx_height_m!r}", f"spacing_m={settings.spacing_m!r}"]
    given += ["receivers='inside'", f"trace_settings=sp.TraceSettings({', '.join(trace)})"]
    given += [f"scene_settings=sp.SceneSettings(material={settings.material!r})"] if settings.material else []
    measured = f'measurements="{_MEASURED}"'  # as in the file of "Save the project"
    given += [measured] if project.measured is not None else []
    power = [f"eirp_dbm={powers!r}"]
    if settings.both_ways:
        power.append(f"client_dbm={[settings.uplink_dbm(each) for each in transmitters]!r}")
    if any(each != Antenna() for each in antennas):
        given.append(f"tx_antenna=[{', '.join(f'sp.{each!r}' for each in antennas)}]")
    tx_m = {name: each.position_m for name, each in project.transmitters.items()}
    lines = [
        *("import sionna_partial as sp", "", *python_map, f"tx = {tx_m!r}"),
        *("coverage = sp.predict_map(", "    partial,", "    tx,", *(f"    {each}," for each in given), ")"),
        f"power = coverage.radio.power({', '.join(power)})",
        f"area = coverage.radio.area({settings.threshold_dbm!r}, {', '.join(power)})",
        'coverage.radio.save("coverage.nc")',
    ]
    plan = {name: each.channel for name, each in project.transmitters.items()}
    if any(plan.values()):
        bandwidth = f"bandwidth_hz={settings.bandwidth_hz!r}"
        lines.append(f"network = sp.predict_network(coverage, tx_power_dbm={powers!r}, {bandwidth}, channels={plan!r})")
    return "\n".join(lines) + "\n"
