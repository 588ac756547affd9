"""Projects: map, transmitters, settings and measurements of a window in one file, which is not trusted."""

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePath
from typing import Any

from sionna_partial.app.files import MOST_BYTES
from sionna_partial.app.radio import MOST_TRANSMITTERS, RadioSettings, Transmitter, require_name
from sionna_partial.checks import require
from sionna_partial.errors import MapError
from sionna_partial.files import decoding, unzipped, zipped
from sionna_partial.maps.map_files import load_map, save_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.tracing.antennas import Antenna

_MAP, _TEXT, _VERSION, _MOST_TEXT = "map.npz", "project.json", 1, 20_000_000
_ARRAYS = ("tx", "rx", "gain_db", "std_db")


@dataclass(frozen=True)
class Project:
    """State of a window."""

    partial: PartialMap
    title: str
    transmitters: Mapping[str, Transmitter] = field(default_factory=dict)
    settings: RadioSettings | None = None
    measured: Measurements | None = None


def project_file(project: Project) -> bytes:
    """Return a zip of an `.npz` map and a JSON."""
    measured = project.measured
    record = {
        "version": _VERSION,
        "title": project.title,
        "transmitters": {name: asdict(each) for name, each in project.transmitters.items()},
        "settings": None if project.settings is None else asdict(project.settings),
        "measured": None if measured is None else _measured_record(measured),
    }
    with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
        save_map(project.partial, Path(folder) / _MAP)
        return zipped({_MAP: (Path(folder) / _MAP).read_bytes(), _TEXT: json.dumps(record, indent=1).encode()})


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
        return _project(partial, record)


def _project(partial: PartialMap, record: dict[str, Any]) -> Project:
    title, settings, measured, transmitters = str(record["title"])[:100], record["settings"], record["measured"], {}
    require(
        len(record["transmitters"]) <= MOST_TRANSMITTERS, "transmitters", len(record["transmitters"]), "give fewer."
    )
    for name, values in record["transmitters"].items():
        require_name(name)
        transmitters[name] = Transmitter(**values | {"antenna": Antenna(**values["antenna"])})
    return Project(
        partial,
        title,
        transmitters,
        None if settings is None else RadioSettings(**settings),
        None if measured is None else Measurements(**measured),
    )


def _measured_record(measured: Measurements) -> dict[str, Any]:
    arrays = {name: getattr(measured, name) for name in _ARRAYS}
    listed = {name: None if values is None else values.tolist() for name, values in arrays.items()}
    return {**listed, "sensitivity_db": measured.sensitivity_db}


def script(project: Project, python_map: Sequence[str]) -> str:
    """Return the Python lines that compute the coverage of a project, whose map some lines read."""
    settings, transmitters = project.settings or RadioSettings(), project.transmitters.values()
    powers, antennas = [each.eirp_dbm for each in transmitters], [each.antenna for each in transmitters]
    trace = [f"frequency_hz={settings.frequency_hz!r}"]
    trace += [] if settings.through_walls is None else [f"refraction={settings.through_walls}"]
    given = [f"rx_height_m={settings.rx_height_m!r}", f"spacing_m={settings.spacing_m!r}"]
    given += [f"trace_settings=sp.TraceSettings({', '.join(trace)})"]
    given += [f"scene_settings=sp.SceneSettings(material={settings.material!r})"] if settings.material else []
    given += ['measurements="measured.csv"'] if project.measured is not None else []
    if any(each != Antenna() for each in antennas):
        given.append(f"tx_antenna=[{', '.join(f'sp.{each!r}' for each in antennas)}]")
    tx_m = {name: each.position_m for name, each in project.transmitters.items()}
    lines = [
        *("import sionna_partial as sp", "", *python_map, f"tx = {tx_m!r}"),
        *("coverage = sp.predict_map(", "    partial,", "    tx,", *(f"    {each}," for each in given), ")"),
        f"power = coverage.radio.power(eirp_dbm={powers!r})",
        f"area = coverage.radio.area({settings.threshold_dbm!r}, eirp_dbm={powers!r})",
        'coverage.radio.save("coverage.nc")',
    ]
    return "\n".join(lines) + "\n"
