"""Input is a regular file of bounded size; output is written whole or not at all."""

import errno
import gc
import io
import os
import re
import resource
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.apps.app.files import stored_map
from sionna_partial.channels.files import load_channels
from sionna_partial.errors import MapError, OutputError, SettingsError
from sionna_partial.export import load_coverage
from sionna_partial.files import (
    atomic_files,
    atomic_folder,
    atomic_path,
    atomic_write,
    lies_in,
    locked_folder,
    read_bytes,
    require_writable,
    temporary_folder,
    unzipped,
    zipped,
)


def tree(folder: Path) -> dict[str, bytes | None]:
    return {
        str(entry.relative_to(folder)): entry.read_bytes() if entry.is_file() else None for entry in folder.rglob("*")
    }


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pipe", "is a pipe or a device: give a file"),
        ("large", "has more than 3 bytes: give a smaller file"),
        (".", "cannot be read (Is a directory): check the path"),
        ("nowhere", "cannot be read (No such file or directory): check the path"),
        ("a\0b", "is not a path: give the name of a file."),
        ("/proc/self/mem", "cannot be read (Input/output error): check the disk"),
    ],
)
def test_only_small_regular_files_are_read(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "small").write_bytes(b"abc")
    (tmp_path / "large").write_bytes(b"abcd")
    os.mkfifo(tmp_path / "pipe")
    assert read_bytes(tmp_path / "small", "map", MapError, 3) == b"abc"
    with pytest.raises(MapError, match=rf"^map = '.*{re.escape(message)}"):
        read_bytes(tmp_path / name, "map", MapError, 3)


def test_paths_that_no_file_can_have(tmp_path: Path) -> None:
    assert not any(lies_in(tmp_path, name) for name in ("a\0b.yaml", "a\ud800b.yaml"))
    (tmp_path / "loop").symlink_to("loop")
    assert lies_in(tmp_path, "loop")


def broken_zip() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("map.yaml", b"image: map.pgm\n" * 100)
    content = bytearray(stream.getvalue())
    content[content.index(b"map.yaml") + 8] ^= 0xFF
    return bytes(content)


@pytest.mark.parametrize("content", [b"", b"PK\3\4", broken_zip()])
def test_damaged_zip(content: bytes) -> None:
    """A wrong type of a block of deflate raises a zlib.error, which is no error of zipfile."""
    with pytest.raises(ValueError, match="it is damaged: "):
        unzipped(content, 10_000)
    with pytest.raises(MapError, match=r"the zip cannot be read \(it is damaged: .*: give a zip of a ROS map's YAML"):
        stored_map([("map.zip", content)], Path("nowhere"))


def test_zip_is_small_and_returns_what_it_holds() -> None:
    contents = {"zeros": bytes(10**6), "text": b"text"}
    assert len(zipped(contents)) < 10_000
    assert unzipped(zipped(contents), 10**7) == contents


def test_channels_with_a_pipe(tmp_path: Path) -> None:
    (tmp_path / "a.zarr").mkdir()
    os.mkfifo(tmp_path / "a.zarr" / "zarr.json")
    with pytest.raises(SettingsError, match=r"cannot be read \('zarr.json' is a link, a pipe or a device\): give"):
        load_channels(tmp_path / "a.zarr")


def test_files_are_whole_and_have_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "usual").touch()
    with atomic_write(tmp_path / "a.txt", "w") as stream:
        stream.write("20 °C\r\n")
        assert not (tmp_path / "a.txt").exists()
    for content in (b"first", b"second"):
        with atomic_write(tmp_path / "new" / "a.bin") as stream:
            stream.write(content)
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "usual").stat().st_mode
    assert tree(tmp_path) == {"usual": b"", "a.txt": "20 °C\r\n".encode(), "new": None, "new/a.bin": b"second"}


def test_links_stay(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "file")
    with atomic_write(tmp_path / "link") as stream:
        stream.write(b"new")
    assert tree(tmp_path) == {"link": b"new", "file": b"new"}
    with atomic_files(tmp_path) as folder:
        (folder / "link").write_bytes(b"newer")
        (folder / "other").write_bytes(b"whole")
    assert (tmp_path / "link").is_symlink()
    assert tree(tmp_path) == {"link": b"newer", "file": b"newer", "other": b"whole"}


def test_path_keeps_the_name_and_drops_side_files(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "map.tif") as temporary:
        assert (temporary.name, temporary.parent.parent) == ("map.tif", tmp_path)
        temporary.write_bytes(b"picture")
        temporary.with_suffix(".tif.aux.xml").write_bytes(b"side file")
    assert tree(tmp_path) == {"map.tif": b"picture"}


@pytest.mark.parametrize("failure", [MapError("no map"), KeyboardInterrupt()])
def test_failure_of_the_caller_leaves_nothing_and_passes_through(tmp_path: Path, failure: BaseException) -> None:
    (tmp_path / "a.bin").write_bytes(b"old")
    for target in ("a.bin", "new/deep/b.bin"):
        with pytest.raises(type(failure)), atomic_write(tmp_path / target) as stream:  # noqa: PT012
            stream.write(b"half")
            raise failure
    assert tree(tmp_path) == {"a.bin": b"old"}


@pytest.mark.parametrize(
    ("call", "number", "remedy"),
    [
        ("fsync", errno.ENOSPC, "the disk is full; free some space or choose another disk."),
        ("replace", errno.EACCES, "choose a folder that you may write to, or change its permissions."),
        ("replace", errno.EIO, "check the path and the disk."),
    ],
)
def test_failing_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, number: int, remedy: str) -> None:
    (tmp_path / "a.bin").write_bytes(b"old")

    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OutputError) as caught, atomic_write(tmp_path / "a.bin") as stream:
        stream.write(b"new")
    assert str(caught.value) == f"path = '{tmp_path}/a.bin' could not be written ({os.strerror(number)}): {remedy}"
    assert tree(tmp_path) == {"a.bin": b"old"}


IN_THE_WAY = [
    *((opened, "file/below/a", "a part of the path is a file; choose") for opened in (atomic_write, atomic_folder)),
    (atomic_write, ".", "this path is a folder; give the name of a file"),
    (atomic_write, "a" * 300, "choose a shorter name"),
    *((atomic_folder, name, "is a file: choose a new or an empty folder") for name in ("file", "dangling")),
    (atomic_write, "pipe", "pipe' is a pipe or a device: give the name of a file"),
    (require_writable, "file/deep", "a part of the path is a file; choose another folder"),
    (require_writable, "/proc/new", r"'/proc/new' could not be .* \(No such file.*: nothing can be made there; choose"),
]


@pytest.mark.parametrize(("opened", "name", "message"), IN_THE_WAY)
def test_what_is_in_the_way_is_named_and_stays(tmp_path: Path, opened: Any, name: str, message: str) -> None:
    (tmp_path / "file").write_bytes(b"old")
    (tmp_path / "dangling").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe")
    before = tree(tmp_path)
    with pytest.raises(OutputError, match=message), opened(tmp_path / name):
        pytest.fail("must not be entered")
    assert tree(tmp_path) == before


SCENE = {"map.yaml": b"map", "scene.xml": b"scene", "meshes/walls.ply": b"walls"}


def write_scene(folder: Path, mark: bytes, names: tuple[str, ...] = tuple(SCENE)) -> None:
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(mark + SCENE[name])


def scene_tree(mark: bytes) -> dict[str, bytes | None]:
    return {"meshes": None, **{name: mark + content for name, content in SCENE.items()}}


def test_folder_appears_whole_and_is_replaced(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "scene"
    with atomic_folder(target) as folder:
        write_scene(folder, b"old ")
        assert not target.exists()
    assert tree(tmp_path / "deep") == {"scene": None} | {f"scene/{key}": at for key, at in scene_tree(b"old ").items()}
    (target / "meshes" / "stale.ply").write_bytes(b"stale")
    (target / "coverage.nc").write_bytes(b"precious")
    with atomic_folder(target) as folder:
        write_scene(folder, b"new ")
    assert tree(target) == {**scene_tree(b"new "), "coverage.nc": b"precious"}


@pytest.mark.parametrize("names", [("scene.xml",), ("map.yaml",)])
def test_other_folders_are_refused(tmp_path: Path, names: tuple[str, ...]) -> None:
    write_scene(tmp_path, b"mine ", names)
    before = tree(tmp_path)
    message = r"other content than an exported scene \(scene.xml and map.yaml\): choose a new"
    with pytest.raises(OutputError, match=message), atomic_folder(tmp_path):
        pytest.fail("must not be entered")
    assert tree(tmp_path) == before


@pytest.mark.parametrize("failing", range(6))
def test_failed_swap_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int) -> None:
    write_scene(tmp_path, b"old ")
    moves, move = [], os.replace

    def replace(source: Path, target: Path) -> None:
        moves.append(source)
        if len(moves) == failing + 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        move(source, target)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(OutputError, match="Input/output error"), atomic_folder(tmp_path) as folder:
        write_scene(folder, b"new ")
    assert len(moves) == 1 + 2 * failing
    assert tree(tmp_path) == scene_tree(b"old ")


@pytest.mark.parametrize("path", [5, "a\0.bin"])
def test_what_is_no_path_is_named(tmp_path: Path, path: object) -> None:
    message = re.escape(f"path = {path!r} is not a path: give the name of a file or folder.")
    for write in (atomic_path, atomic_write, atomic_folder, atomic_files):
        with pytest.raises(OutputError, match=message), write(path):  # type: ignore[operator]
            pytest.fail("must not be entered")
    with pytest.raises(OutputError, match=message):
        require_writable(path)  # type: ignore[arg-type]


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"old")
    for target in (tmp_path, tmp_path / "new" / "deep"):
        message = re.escape(f"path = '{target}' could not be written (No space left on device): the disk is full")
        with pytest.raises(OutputError, match=message), atomic_files(target) as folder:  # noqa: PT012
            (folder / "a.bin").write_bytes(b"new")
            with atomic_write(folder / "b.bin"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert tree(tmp_path) == {"a.bin": b"old"}
    with atomic_files(tmp_path) as folder:
        for name in ("a.bin", "b.bin"):
            (folder / name).write_bytes(b"new")
        assert (tmp_path / "a.bin").read_bytes() == b"old"
    assert tree(tmp_path) == {"a.bin": b"new", "b.bin": b"new"}


@pytest.mark.parametrize(("name", "message"), [("a.bin", "this path is a folder"), ("pipe", "is a pipe or a device")])
def test_in_the_way_of_several_files(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "a.bin").mkdir()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match=message), atomic_files(tmp_path) as folder:
        (folder / name).write_bytes(b"new")
    assert tree(tmp_path) == {"a.bin": None, "pipe": None}


def test_full_temporary_folder_is_named() -> None:
    message = r"no temporary file could be written \(No space left on device\): free some space .* or set TMPDIR"
    with pytest.raises(OutputError, match=message), temporary_folder() as folder:
        Path("/dev/full").write_bytes(b"some")
    assert not folder.exists()
    with pytest.raises(OutputError, match=message), temporary_folder() as folder, atomic_write(folder / "a"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a file of Python itself
def test_file_size_limit_leaves_whole_files(tmp_path: Path) -> None:
    """HDF5 must not see a failed write: it crashes then."""
    partial = sp.PartialMap(np.pad(np.zeros((20, 20), np.uint8), 1, constant_values=1), 0.1)
    links = sp.trace_links(partial, (1.0, 1.0, 1.5), [(1.5, 1.5, 1.5)], progress=False)
    calls: dict[str, Callable[[Path], object]] = {
        "npz": lambda path: sp.save_map(partial, path),
        "yaml": lambda path: sp.save_map(partial, path),
        "nc": lambda path: sp.channels.save_channels(links, path, progress=False),
        "zarr": lambda path: sp.channels.save_channels(links.cir(), path, progress=False),
        "scene": lambda path: sp.export_scene(partial, path),
    }
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for name, call in calls.items():
        call(tmp_path / f"whole.{name}")
        for size in (0, 150, 1000, 4000):
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
            try:
                with suppress(sp.SionnaPartialError):
                    call(tmp_path / f"{size}.{name}")
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    gc.collect()
    names = {path.name for path in tmp_path.iterdir()}
    assert not {name for name in names if name.startswith(".")}
    assert {f"{size}.nc" for size in (0, 150, 1000, 4000)}.isdisjoint(names)
    assert {path.stem for path in tmp_path.glob("*.pgm")} == {path.stem for path in tmp_path.glob("*.yaml")}


LOCK = """
import sys
from sionna_partial.files import locked_folder
with locked_folder(sys.argv[1]):
    print("locked", flush=True)
    sys.stdin.read()
"""


class TestLockedFolder:
    def test_another_process_is_waited_for_until_it_dies(self, tmp_path: Path) -> None:
        command = [sys.executable, "-c", LOCK, str(tmp_path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
            assert holder.stdout is not None
            holder.stdout.readline()
            words = "is being written by another process: wait until that has ended"
            with pytest.raises(OutputError, match=words), locked_folder(tmp_path):
                pass
            holder.kill()
        with locked_folder(tmp_path):
            assert tree(tmp_path) == {".lock": b""}

    def test_folder_is_made_and_unlocked_after_an_error(self, tmp_path: Path) -> None:
        for _ in range(2):
            with pytest.raises(ZeroDivisionError), locked_folder(tmp_path / "deep"):
                raise ZeroDivisionError
        assert tree(tmp_path) == {"deep": None, "deep/.lock": b""}
        (tmp_path / ".lock").mkdir()
        with pytest.raises(OutputError, match=r"\.lock' could not be written \(Is a directory\)"):
            locked_folder(tmp_path).__enter__()


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(shape=(4,), dtype="f4")
    layout[:] = h5py.VirtualSource("other.h5", "a", shape=(4,))
    file.create_virtual_dataset("v", layout)


HDF5_FAULTS = {
    "'v' has its data in another file": _virtual,
    "'e' has its data": lambda file: file.create_dataset("e", (4,), "f4", external=[("/etc/passwd", 0, 16)]),
    "'x' is a link": lambda file: file.__setitem__("x", h5py.ExternalLink("other.h5", "/a")),
    "more than 4,000,000,000 bytes": lambda file: file.create_dataset("b", (60_000, 60_000), "f8", chunks=(100, 100)),
}


@pytest.mark.parametrize("fault", HDF5_FAULTS)
def test_hdf5_files_hold_their_data_themselves(tmp_path: Path, fault: str) -> None:
    with h5py.File(tmp_path / "file.nc", "w") as file:
        HDF5_FAULTS[fault](file)
    for load in (load_coverage, load_channels) if "bytes" not in fault else (load_coverage,):
        with pytest.raises(SettingsError, match=fault):
            load(tmp_path / "file.nc")
