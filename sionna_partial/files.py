"""Input of bounded size; output that is written completely or not at all, by one process at a time."""

import errno
import io
import os
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from sionna_partial.checks import require, shown
from sionna_partial.errors import OutputError, SionnaPartialError
from sionna_partial.process import own_folder, signals_held
from sionna_partial.resources import optional_packages

if TYPE_CHECKING:
    import xarray as xr

SCENE_FILES = ("scene.xml", "map.yaml")

CALIBRATED_FILE = "calibrated.npz"

LOCK_FILE = ".lock"

HIDDEN, TEMPORARY = ".tmp-sionna_partial_", "sionna_partial_"
"""Prefixes of hidden folders beside outputs, and of folders for temporary files."""

_REMEDIES = {
    errno.EACCES: "choose a folder that you may write to, or change its permissions.",
    errno.EPERM: "choose a folder that you may write to, or change its permissions.",
    errno.EROFS: "this disk is read-only; choose a folder on another one.",
    errno.ENOSPC: "the disk is full; free some space or choose another disk.",
    errno.EDQUOT: "your quota is used up; free some space or choose another disk.",
    errno.ENOTDIR: "a part of the path is a file; choose another folder.",
    errno.EEXIST: "a part of the path is a file; choose another folder.",
    errno.EISDIR: "this path is a folder; give the name of a file.",
    errno.ENOENT: "nothing can be made there; choose another folder.",
    errno.ENAMETOOLONG: "choose a shorter name.",
}


def open_regular(
    path: str | os.PathLike[str],
    field: str,
    error: type[SionnaPartialError],
    most: int,
    remedy: str = "give a smaller file.",
) -> IO[bytes]:
    """Open a regular file of at most `most` bytes. Pipes and devices, which may block, raise an `error`."""
    source = input_path(path, field, error, "give the name of a file.")
    try:
        stream = open(source, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    except (OSError, ValueError) as cause:
        reason = getattr(cause, "strerror", None) or cause
        raise error(f"{field} = '{path}' cannot be read ({reason}): check the path.") from cause
    status, reason = os.fstat(stream.fileno()), ""
    if not stat.S_ISREG(status.st_mode):
        reason = "is a pipe or a device: give a file."
    elif status.st_size > most:
        reason = f"has more than {most:,} bytes: {remedy}"
    if reason:
        stream.close()
        raise error(f"{field} = '{path}' {reason}")
    return stream


def read_bytes(
    path: str | os.PathLike[str],
    field: str,
    error: type[SionnaPartialError],
    most: int,
    remedy: str = "give a smaller file.",
) -> bytes:
    with open_regular(path, field, error, most, remedy) as stream:
        try:
            return stream.read(os.fstat(stream.fileno()).st_size + 1)
        except OSError as cause:
            raise error(f"{field} = '{path}' cannot be read ({cause.strerror}): check the disk.") from cause


def require_plain_hdf5(file: Any, most: int) -> None:
    """Raise a ValueError if HDF5 content links to other files or has more than `most` bytes of arrays.

    `file` is a path or an open stream. External storage and virtual data sets count as links.
    """
    import h5py

    total = 0

    def fault(name: str, link: Any) -> str | None:
        nonlocal total
        if not isinstance(link, h5py.HardLink):
            return f"{name!r} is a link, which may lead to another file"
        entry = content[name]
        if isinstance(entry, h5py.Dataset):
            if entry.is_virtual or entry.external:
                return f"{name!r} has its data in another file"
            total += (entry.size or 0) * entry.dtype.itemsize
        return f"its arrays have more than {most:,} bytes" if total > most else None

    with h5py.File(file, "r") as content:
        found = content.visititems_links(fault)
    if found:
        raise ValueError(found)


def write_netcdf(table: "xr.Dataset", encoding: Mapping[Any, Any], stream: Any) -> None:
    """Write a Dataset as NetCDF 4 to an unbuffered, readable stream; equal Datasets give equal bytes.

    `Dataset.to_netcdf` lets HDF5 write time stamps, and keeps the order of variables.
    """
    import h5netcdf
    import h5py
    import numpy as np
    import xarray as xr
    from h5py import h5f, h5fd, h5p
    from xarray.backends import H5NetCDFStore
    from xarray.backends.common import ArrayWriter

    for name, value in table.attrs.items():
        kind = np.asarray(value).dtype.kind
        require(kind in "biufSU", f"attribute {name}", value, "give a number or a text.")
    creation, access, writer = h5p.create(h5p.FILE_CREATE), h5p.create(h5p.FILE_ACCESS), ArrayWriter()
    creation.set_obj_track_times(False)
    for set_order in (creation.set_link_creation_order, creation.set_attr_creation_order):
        set_order(h5p.CRT_ORDER_TRACKED | h5p.CRT_ORDER_INDEXED)
    sink = _Sink(stream)
    access.set_fileobj_driver(h5fd.fileobj_driver, sink)
    of_axes = sorted(table.coords, key=lambda name: (name not in table.dims, str(name)))
    axes = {name: table[name].variable for name in of_axes}
    ordered = xr.Dataset(coords=axes, attrs=table.attrs).assign(table.data_vars).drop_encoding()
    file_id = h5f.create(b"stream", h5f.ACC_TRUNC, creation, access)
    with h5py.File(file_id) as file, h5netcdf.File(file, "w") as netcdf:
        ordered.dump_to_store(H5NetCDFStore(netcdf), writer=writer, encoding=encoding)
        for _ in _blocks_written(writer.sources, writer.targets):
            sink.require_written()
    sink.require_written()


class _Sink(io.RawIOBase):
    """Raw stream for HDF5, which crashes if a write fails. `require_written` raises the error later.

    Data after a failed write are kept in memory.
    """

    def __init__(self, stream: Any) -> None:
        self._stream, self._at, self._end = stream, 0, 0
        self._error: tuple[Any, ...] = ()
        self._kept: list[tuple[int, bytes]] = []

    def require_written(self) -> None:
        if self._error:
            raise OSError(*self._error)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = self._end if whence == io.SEEK_END else offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        self._stream.seek(self._at)
        self._stream.readinto(view)
        for at, content in self._kept:
            first, last = max(at, self._at), min(at + len(content), self._at + len(view))
            if first < last:
                view[first - self._at : last - self._at] = content[first - at : last - at]
        return len(view)

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        try:
            self.require_written()
            self._stream.seek(self._at)
            done = 0
            while done < len(view):
                done += self._stream.write(view[done:])
        except OSError as error:
            self._error = self._error or error.args  # its frames would keep memory that HDF5 frees
            self._kept.append((self._at, bytes(view)))
        self._end = max(self._end, self._at + len(view))
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        self._end = self._end if size is None else size
        with suppress(OSError):
            self._stream.truncate(self._end)
        return self._end


def _blocks_written(sources: list[Any], targets: list[Any]) -> Iterator[None]:
    """Compute dask arrays with equal blocks, block by block: `dask.array.store` varies the order."""
    if not sources:
        return
    import dask
    from dask.array.core import slices_from_chunks

    for regions in zip(*(slices_from_chunks(source.chunks) for source in sources), strict=True):
        blocks = dask.compute(*(source[region] for source, region in zip(sources, regions, strict=True)))
        for target, region, block in zip(targets, regions, blocks, strict=True):
            target[region] = block
        yield


@contextmanager
def decoding(
    path: Path, fault: str, error: type[SionnaPartialError], remedy: str = "export it again."
) -> Iterator[None]:
    """Convert exceptions of decoders on damaged files to an `error`; our own errors pass."""
    try:
        with optional_packages(error):
            yield
    except (SionnaPartialError, Warning):
        raise
    except Exception as cause:
        reason = " ".join(f"{cause or type(cause).__name__}".split())[:200]
        raise error(f"path = '{path}' is damaged or {fault} ({reason}): {remedy}") from cause


def is_path(path: object) -> bool:
    """Return whether a file can have this path: no NUL, no unpaired surrogates."""
    try:
        return isinstance(path, (str, os.PathLike)) and b"\0" not in os.fsencode(path)
    except UnicodeEncodeError:
        return False


def input_path(path: object, field: str, error: type[SionnaPartialError], remedy: str) -> Path:
    if not is_path(path):
        given = os.fspath(path) if isinstance(path, os.PathLike) else path
        raise error(f"{field} = {shown(given)} is not a path: {remedy}")
    return Path(path)  # type: ignore[arg-type]


def output_path(path: object) -> Path:
    if not is_path(path):
        raise OutputError(f"path = {path!r} is not a path: give the name of a file or folder.")
    return Path(path)  # type: ignore[arg-type]


def lies_in(folder: Path, name: str) -> bool:
    inside = bool(name) and is_path(name) and not Path(name).is_absolute() and ".." not in Path(name).parts
    return inside and Path(os.path.realpath(folder / name)).is_relative_to(os.path.realpath(folder))


def require_plain_folder(folder: Path) -> None:
    """Raise a ValueError for a folder with links, pipes or devices, which readers would follow."""
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            mode = os.lstat(os.path.join(parent, name)).st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise ValueError(f"{name!r} is a link, a pipe or a device")


def unzipped(content: bytes, most: int) -> dict[str, bytes]:
    """Return the files of a zip archive by name; a ValueError if it is damaged or unpacks to more."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            size = sum(entry.file_size for entry in entries)
            found = {entry.filename: archive.read(entry) for entry in entries} if size <= most else {}
    except Exception as error:  # each compression has errors of its own
        raise ValueError(f"it is damaged: {error or type(error).__name__}") from error
    if size > most or len(found) != len(entries):
        raise ValueError(f"it unpacks to more than {most:,} bytes" if size > most else "it has a name twice")
    return found


def zipped(contents: Mapping[str, bytes]) -> bytes:
    """Return files as a zip archive; equal files give equal bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in contents.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return stream.getvalue()


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Provide a temporary path for a library to write to, and move the file to `path` on success.

    The temporary file has the name of `path`, in a hidden folder beside it, so that side files of the library vanish.
    Missing parent folders are made. The target of a link is replaced.
    """
    name = output_path(path).name
    target = Path(os.path.realpath(path))
    with _hidden_folder(target, target.parent) as hidden:
        _require_file(target)
        yield hidden / name
        _sync(hidden / name)
        os.replace(hidden / name, target)


@contextmanager
def atomic_write(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a file that appears at `path` when it is complete; text ("w") is UTF-8."""
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    with atomic_path(path) as temporary, temporary.open(mode, encoding=encoding, newline=newline) as stream:
        yield stream


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Open a scene folder that appears at `path` when it is complete.

    In an exported scene folder (with `SCENE_FILES`), new entries replace old ones of the same name, all or none, and
    other files are kept. A folder with other content is refused.
    """
    target = output_path(path)
    with _hidden_folder(target, target if os.path.isdir(target) else target.parent) as hidden:
        folder = hidden / "new"
        folder.mkdir()
        others = [entry for entry in target.iterdir() if entry != hidden] if target.is_dir() else []
        if others and not all((target / name).is_file() for name in SCENE_FILES):
            raise OutputError(
                f"path = '{target}' is a folder with other content than an exported scene "
                f"({' and '.join(SCENE_FILES)}): choose a new or an empty folder."
            )
        if os.path.lexists(target) and not target.is_dir():
            raise OutputError(f"path = '{target}' is a file: choose a new or an empty folder.")
        yield folder
        for file in folder.rglob("*"):
            if file.is_file():
                _sync(file)
        if target.is_dir():
            _swap_entries(folder, target, hidden / "old")
        else:
            os.replace(folder, target)


@contextmanager
def atomic_files(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Open a folder whose files appear together in the folder `path` when they are complete.

    Files of the same names are replaced, all or none; targets of links are replaced.
    """
    target = output_path(path)
    with _hidden_folder(target, target) as hidden:
        folder = hidden / "new"
        folder.mkdir()
        yield folder
        with ExitStack() as linked:
            for file in [*folder.iterdir()]:
                _require_file(target / file.name)
                if (target / file.name).is_symlink():
                    shutil.move(file, linked.enter_context(atomic_path(target / file.name)))
            _swap_entries(folder, target, hidden / "old")


@contextmanager
def temporary_folder() -> Iterator[Path]:

    def failed(cause: OSError) -> OutputError:
        return OutputError(
            f"no temporary file could be written ({cause.strerror or cause}): free some space in the folder of "
            "temporary files, or set TMPDIR to one that you may write to."
        )

    try:
        parent = Path(tempfile.gettempdir())
    except OSError as error:
        raise failed(error) from error
    with _own_folder(parent, TEMPORARY, failed) as folder:
        yield folder


def require_writable(folder: str | os.PathLike[str]) -> None:
    target = output_path(folder)
    with _hidden_folder(target, target):
        pass


@contextmanager
def locked_folder(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Make a folder and lock it against other processes; the lock ends with the process."""
    from filelock import FileLock, Timeout

    target = output_path(folder)
    require_writable(target)
    with ExitStack() as lock:
        try:
            target.mkdir(parents=True, exist_ok=True)
            lock.enter_context(FileLock(target / LOCK_FILE, timeout=0))
        except Timeout:
            raise OutputError(
                f"folder = '{target}' is being written by another process: wait until that has ended, or choose "
                "another folder."
            ) from None
        except OSError as error:
            raise _output_error(target / LOCK_FILE, error) from error
        yield


def _hidden_folder(target: Path, parent: Path) -> AbstractContextManager[Path]:
    return _own_folder(parent, HIDDEN, lambda cause: _output_error(target, cause))


@contextmanager
def _own_folder(parent: Path, prefix: str, failed: Callable[[OSError], OutputError]) -> Iterator[Path]:
    folder: Path | None = None
    try:
        with own_folder(parent, prefix) as folder:
            yield folder
    except OSError as error:
        cause = error.__cause__ if isinstance(error, OutputError) and str(folder) in str(error) else error
        if isinstance(cause, OSError) and not isinstance(cause, SionnaPartialError):
            raise failed(cause) from error
        raise


def _output_error(target: Path, error: OSError) -> OutputError:
    remedy = _REMEDIES.get(error.errno or 0, "check the path and the disk.")
    return OutputError(f"path = '{target}' could not be written ({error.strerror or error}): {remedy}")


def _require_file(path: Path) -> None:
    if path.is_dir():
        raise _output_error(path, IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR)))
    if path.exists() and not path.is_file():
        raise OutputError(f"path = '{path}' is a pipe or a device: give the name of a file.")


def _swap_entries(new: Path, target: Path, aside: Path) -> None:
    """Move entries of `new` into `target`, and replaced ones to `aside`; undo all on failure."""
    aside.mkdir()
    with signals_held(), ExitStack() as undo:
        for name in sorted(entry.name for entry in new.iterdir()):
            if os.path.lexists(target / name):
                os.replace(target / name, aside / name)
                undo.callback(os.replace, aside / name, target / name)
            os.replace(new / name, target / name)
            undo.callback(os.replace, target / name, new / name)
        undo.pop_all()


def _sync(file: Path) -> None:
    with file.open("rb") as stream:
        os.fsync(stream.fileno())
