"""Valid small inputs for hostile cases to spoil, and how each is read."""

import functools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from worker import left_behind

import sionna_partial as sp
from sionna_partial.channels.samples import ChannelSamples

HERE = str(Path(__file__).parent)
sys.path.insert(0, str(Path(HERE).parent))  # files of the other tests

TX = (1.1, 1.1, 1.5)

CUBE = np.array([(x, y, z) for x in (0.0, 4.0) for y in (0.0, 3.0) for z in (0.0, 2.5)])
CLOUD = np.random.default_rng(0).uniform((0, 0, 0), (4, 3, 2.5), (3000, 3))
CLOUD[:2000, 2] = 0.0  # a floor, and a wall at x = 0
CLOUD[2000:, 0] = 0.0
FACES = (
    *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
)


class Wrong(Exception):
    """A result that nobody should trust came back."""


def must_refuse(call: Callable[[], Any]) -> None:
    try:
        result = call()
    except sp.SionnaPartialError:
        return
    raise Wrong(f"accepted, and gave {str(result)[:200]}")


def python(code: str, *, seconds: float = 900.0, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(Path(sp.__file__).parents[1])} | variables
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=seconds, check=False
    )


def must_end_in_one_line(result: subprocess.CompletedProcess[str], *codes: int) -> None:
    """Raise `Wrong` for a traceback, a signal or another exit code than those allowed."""
    if result.returncode not in codes or "Traceback" in result.stderr:
        raise Wrong(f"exit {result.returncode}: {result.stderr[-1500:]}")


def must_end_at_signal(words: Sequence[object], number: signal.Signals, after_s: float) -> None:
    """Start a command, send it a signal, and raise `Wrong` if it is late, prints more than a line, or leaves something.

    Times are those of the processor, which other programs do not change. A process that was killed may leave hidden
    folders, which the next start removes.
    """
    code = "import sys; sys.argv[0] = 'sionna-partial'; from sionna_partial.cli import main; main()"
    environment = os.environ | {"PYTHONPATH": str(Path(sp.__file__).parents[1])}
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    _wait(process, after_s)
    process.send_signal(number)
    in_time = _wait(process, 3.0)
    process.kill()
    errors = process.communicate()[1]
    what = f"{number.name} after {after_s:.2f} s: exit {process.returncode}: {errors[-800:]}"
    if not in_time:
        raise Wrong(f"{what}: later than 3 s")
    if process.returncode not in (0, 128 + number, -number) or "Traceback" in errors:
        raise Wrong(what)
    if process.returncode == 128 + number and errors.count("interrupted") != 1:
        raise Wrong(what)
    if number != signal.SIGKILL and left_behind(Path.cwd()):
        raise Wrong(f"{what} left {left_behind(Path.cwd())}")


def _wait(process: "subprocess.Popen[str]", seconds: float) -> bool:
    """Wait until a process ends (True), or has used so much processor time, or none for 30 s."""
    first_s = used_s = _processor_s(process.pid)
    changed = time.monotonic()
    while process.poll() is None:
        now_s = _processor_s(process.pid)
        if now_s > used_s:
            used_s, changed = now_s, time.monotonic()
        if used_s - first_s > seconds or time.monotonic() - changed > 30.0:
            return False
        time.sleep(0.02)
    return True


def _processor_s(pid: int) -> float:
    with suppress(psutil.Error):
        return float(sum(psutil.Process(pid).cpu_times()[:2]))
    return 0.0


def room() -> sp.PartialMap:
    state = np.zeros((15, 20), dtype=np.uint8)
    state[[0, -1]] = state[:, [0, -1]] = sp.CellState.WALL
    state[:9, 10] = sp.CellState.WALL
    state[2:8, 14:19] = sp.CellState.UNKNOWN
    return sp.PartialMap(state, 0.2)


def _yaml(folder: Path) -> Path:
    sp.save_map(room(), folder / "map.yaml")
    return folder / "map.yaml"


def _npz(folder: Path) -> Path:
    sp.save_map(room(), folder / "map.npz")
    return folder / "map.npz"


def _ply(folder: Path) -> Path:
    rows = ["ply", "format ascii 1.0", f"element vertex {len(CUBE)}", *(f"property float {axis}" for axis in "xyz")]
    rows += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "end_header"]
    rows += [" ".join(map(str, point)) for point in CUBE] + [f"3 {a} {b} {c}" for a, b, c in FACES]
    path = folder / "room.ply"
    path.write_text("\n".join(rows) + "\n", encoding="ascii")
    return path


def _obj(folder: Path) -> Path:
    rows = [f"v {x} {y} {z}" for x, y, z in CUBE] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    path = folder / "room.obj"
    path.write_text("\n".join(rows) + "\n", encoding="ascii")
    return path


def _scene(folder: Path) -> Path:
    sp.export_scene(room(), folder / "scene")
    return folder / "scene" / "scene.xml"


def _csv(folder: Path) -> Path:
    path = folder / "measured.csv"
    rows = [f"1.1,1.1,1.5,{0.5 + 0.1 * k:.2f},2.3,1.5,{-60.0 - k}" for k in range(12)]
    path.write_text("\n".join(["tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,gain_db", *rows]) + "\n", encoding="ascii")
    return path


def _read_csv(path: Path) -> None:
    from short_searches import short_searches

    with short_searches():
        sp.calibrate_materials(room(), path)


def _vacuum(suffix: str, folder: Path) -> Path:
    from vacuum_files import valetudo_map, write_json, write_recording

    path = folder / f"home{suffix}"
    return write_json(path, valetudo_map()) if suffix == ".json" else write_recording(path)


def _read_recording(path: Path) -> None:
    for read in (sp.load_map, sp.load_measurements):
        with suppress(sp.SionnaPartialError):
            read(path)


def _picture(folder: Path) -> Path:
    from PIL import Image

    picture = np.full((90, 120), 255, np.uint8)
    picture[5:85, 5:115] = 0
    picture[9:81, 9:111] = 255
    Image.fromarray(picture).save(folder / "plan.png")
    return folder / "plan.png"


def _antenna(folder: Path) -> Path:
    path, cut = folder / "antenna.msi", "".join(f"{angle} {min(angle, 360 - angle) / 6}\n" for angle in range(360))
    path.write_text(f"NAME a\nGAIN 9 dBi\nHORIZONTAL 360\n{cut}VERTICAL 360\n{cut}", encoding="ascii")
    return path


def _predictor(folder: Path) -> Path:
    shipped = Path(sp.__file__).parent / "predictors"
    for suffix in ("keras", "json"):
        shutil.copy(shipped / f"paper.{suffix}", folder / f"mine.{suffix}")
    return folder / "mine.keras"


@functools.cache
def coverage() -> Any:
    return sp.predict_map(room(), TX, spacing_m=0.5, predictor="paper")


@functools.cache
def two_coverages() -> Any:
    return sp.predict_map(room(), [TX, (2.9, 2.5, 1.5)], spacing_m=0.5, predictor="paper")


@functools.cache
def network() -> Any:
    return sp.predict_network(two_coverages(), n=10)


@functools.cache
def links() -> sp.TracedLinks:
    return sp.trace_links(room(), TX, [(3.1, 2.5, 1.5), (0.9, 2.1, 1.5)])


@functools.cache
def samples() -> ChannelSamples:
    return sp.channels.sample_channels(room(), TX, [(3.1, 2.5, 1.5)], n=3, predictor="paper")


def measured() -> sp.Measurements:
    rx_m = links().rx
    return sp.Measurements(np.tile(TX, (len(rx_m), 1)), rx_m, np.full(len(rx_m), -70.0))


@functools.cache
def prediction() -> sp.LinkPrediction:
    return sp.Predictor.load("paper").predict(sp.link_features(room(), links()))


def _channels(folder: Path) -> Path:
    sp.channels.save_channels(links(), folder / "channels.nc")
    return folder / "channels.nc"


def _read_channels(path: Path) -> None:
    if not python(f"import h5py; h5py.File({str(path)!r}).visititems(print)").returncode:  # HDF5 may crash, not we
        sp.channels.load_channels(path).load()


def _coverage(folder: Path) -> Path:
    sp.save_coverage(coverage(), folder / "coverage.nc")
    return folder / "coverage.nc"


def _read_coverage(path: Path) -> None:
    import xarray as xr

    if python(f"import xarray; xarray.load_dataset({str(path)!r})").returncode:  # HDF5 reads it, and may crash, not we
        return
    stored = xr.load_dataset(path)
    sp.save_coverage(stored, path.with_name("again.csv"))
    sp.plots.plot_coverage(stored)


@functools.cache
def _dataset_folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="hostile_dataset_"))
    trace = sp.TraceSettings(max_depth=2)
    settings = sp.lab.DatasetSettings(links_per_home=8, transmitters_per_home=2, stages=(0, 5), trace=trace)
    sp.lab.build_dataset(folder / "links", [1], settings, workers=1)
    return folder / "links"


def _dataset(folder: Path) -> Path:
    shutil.copytree(_dataset_folder(), folder / "links")
    return next((folder / "links").rglob("*.parquet"))


def _cloud(name: str, folder: Path) -> Path:
    import laspy
    from pypcd4 import PointCloud

    path = folder / name
    if path.suffix == ".pcd":
        PointCloud.from_xyz_points(CLOUD.astype(np.float32)).save(path)
    elif path.suffix == ".xyz":
        np.savetxt(path, CLOUD, fmt="%.3f")
    else:
        cloud = laspy.create()
        cloud.x, cloud.y, cloud.z = CLOUD.T
        cloud.write(path)
    return path


def _drawing(folder: Path) -> Path:
    import ezdxf

    plan = ezdxf.new(units=6)
    plan.modelspace().add_lwpolyline(CUBE[[0, 2, 6, 4], :2], close=True, dxfattribs={"layer": "WALLS"})
    plan.blocks.new("COLUMN").add_circle((0, 0), 0.2)
    plan.modelspace().add_blockref("COLUMN", (2, 1), dxfattribs={"layer": "WALLS"})
    plan.saveas(folder / "plan.dxf")
    return folder / "plan.dxf"


def _bag(name: str, folder: Path) -> Path:
    from rosbag_files import write_drive

    name = {".bag": "drive.bag", ".mcap": "drive_mcap", ".db3": "drive_sqlite3"}[Path(name).suffix]
    bag = write_drive(folder / name)
    return bag if bag.is_file() else next(file for file in bag.iterdir() if file.suffix != ".yaml")


def _read_bag(path: Path) -> None:
    for read in (
        sp.load_map,
        sp.importers.poses_from_bag,
        lambda path: sp.importers.measurements_from_bag(path, "/rssi", TX, tx_power_dbm=20.0),
    ):
        with suppress(sp.SionnaPartialError):
            read(path)


KINDS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], Any]]] = {
    **{
        name: (functools.partial(_cloud, name), sp.load_map)
        for name in ("cloud.las", "cloud.laz", "cloud.pcd", "cloud.xyz")
    },
    "plan.dxf": (_drawing, sp.load_map),
    **{name: (functools.partial(_bag, name), _read_bag) for name in ("drive.bag", "drive.mcap", "drive.db3")},
    "map.yaml": (_yaml, sp.load_map),
    "map.pgm": (lambda folder: _yaml(folder).with_suffix(".pgm"), lambda path: sp.load_map(path.with_suffix(".yaml"))),
    "map.npz": (_npz, sp.load_map),
    "mesh.ply": (_ply, lambda path: sp.load_map(path, resolution_m=0.2)),
    "mesh.obj": (_obj, lambda path: sp.load_map(path, resolution_m=0.2)),
    "scene.xml": (_scene, lambda path: sp.load_map(path, resolution_m=0.2)),
    "scene folder": (_scene, lambda path: sp.load_map(path.parent)),
    "antenna.msi": (_antenna, sp.load_antenna),
    "vacuum.json": (functools.partial(_vacuum, ".json"), sp.load_map),
    "vacuum.vwm": (functools.partial(_vacuum, ".vwm"), _read_recording),
    "plan.png": (_picture, lambda path: sp.load_map(path, resolution_m=0.05)),
    "measurements.csv": (_csv, _read_csv),
    "predictor.keras": (_predictor, sp.Predictor.load),
    "predictor.json": (
        lambda folder: _predictor(folder).with_suffix(".json"),
        lambda path: sp.Predictor.load(path.with_suffix(".keras")),
    ),
    "coverage.nc": (_coverage, _read_coverage),
    "channels.nc": (_channels, _read_channels),
    "dataset.parquet": (_dataset, lambda path: sp.lab.read_dataset(path.parent.parent)),
    "dataset.json": (
        lambda folder: _dataset(folder).parent.parent / "dataset.json",
        lambda path: sp.lab.read_dataset(path.parent),
    ),
}
"""By name of the kind: what writes a valid file into a folder, and what reads it."""


def read(kind: str, path: Path) -> Any:
    return KINDS[kind][1](path)


def valid(kind: str, folder: Path) -> Path:
    return KINDS[kind][0](folder)
