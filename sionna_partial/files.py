"""Output that is written whole or not at all, and by one run at a time."""

import errno
import fcntl
import os
import secrets
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from sionna_partial.errors import OutputError, SionnaPartialError

SCENE_FILES = ("scene.xml", "map.yaml")
"""Files that tell an exported scene folder from any other."""

LOCK_FILE = ".lock"
"""File in a locked folder that says which process writes there."""

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


_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


def output_path(path: object) -> Path:
    """Return a path to write to, or raise an OutputError if it is none."""
    if not isinstance(path, (str, os.PathLike)) or "\0" in os.fspath(path):
        raise OutputError(f"path = {path!r} is not a path: give the name of a file or folder.")
    return Path(path)


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a library a path to write to, and put the file in its place when all went well.

    The temporary path has the name of `path`, in a hidden folder beside it: side files of the library vanish with
    that folder. Missing parent folders are made, and removed again on failure.

    Parameters
    ----------
    path : path-like
        Where the file shall be. A file that is there is replaced.

    Yields
    ------
    pathlib.Path
        Where to write it.

    Raises
    ------
    OutputError
        If writing fails; `path` is then as it was before.
    """
    target = output_path(path)
    with _workplace(target, target.parent) as place:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        temporary = place / target.name
        yield temporary
        _sync(temporary)
        os.replace(temporary, target)


@contextmanager
def atomic_write(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a file that appears at `path` only when it has been written completely.

    Parameters
    ----------
    path : path-like
        Where the file shall be. A file that is there is replaced.
    mode : {"wb", "w"}
        Bytes, or text (UTF-8, line ends as written).

    Yields
    ------
    file object

    Raises
    ------
    OutputError
        If writing fails; `path` is then as it was before.
    """
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    with atomic_path(path) as temporary, temporary.open(mode, encoding=encoding, newline=newline) as stream:
        yield stream


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Open a scene folder that appears at `path` only when it has been written completely.

    A missing folder appears in one step. In an empty folder, or in an exported scene folder (it holds `scene.xml` and
    `map.yaml`), every entry that the new scene has takes the place of the old one, and other files are kept. If one
    cannot be replaced, all are put back.

    Parameters
    ----------
    path : path-like
        Where the folder shall be.

    Yields
    ------
    pathlib.Path
        The folder to write into.

    Raises
    ------
    OutputError
        If writing fails, or if `path` is a file or a folder with other content; `path` is then as it was before.
    """
    target = output_path(path)
    with _workplace(target, target.parent, inside=True) as place:
        folder = place / "new"
        folder.mkdir()
        yield folder
        for file in folder.rglob("*"):
            if file.is_file():
                _sync(file)
        if target.is_dir():
            _swap_entries(folder, target, place / "old")
        else:
            os.replace(folder, target)


@contextmanager
def atomic_files(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Open a folder whose files appear in the folder `path` together, when all have been written completely.

    Files of the same names are replaced, others are kept. If one cannot be replaced, all are put back.

    Parameters
    ----------
    path : path-like
        The folder where the files shall be. It need not be there.

    Yields
    ------
    pathlib.Path
        The folder to write into.

    Raises
    ------
    OutputError
        If writing fails; `path` is then as it was before.
    """
    target = output_path(path)
    with _workplace(target, target) as place:
        folder = place / "new"
        folder.mkdir()
        yield folder
        for file in folder.iterdir():
            if (target / file.name).is_dir():
                raise _output_error(target / file.name, IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR)))
        _swap_entries(folder, target, place / "old")


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Open a folder for files that libraries exchange, and remove it in the end.

    Yields
    ------
    pathlib.Path

    Raises
    ------
    OutputError
        If the disk of temporary files is full or cannot be written.
    """
    try:
        with tempfile.TemporaryDirectory(prefix="sionna_partial_") as folder:
            yield Path(folder)
    except OSError as error:
        cause = error.__cause__ if isinstance(error, OutputError) else error
        if not isinstance(cause, OSError) or cause.errno not in _REMEDIES:
            raise
        raise OutputError(
            f"no temporary file could be written ({cause.strerror}): free some space in the folder of temporary "
            "files, or set TMPDIR to one that you may write to."
        ) from error


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Find out, before long work, whether files can be made in a folder, and leave nothing behind.

    Parameters
    ----------
    folder : path-like
        It need not be there.

    Raises
    ------
    OutputError
        If none can be made.
    """
    target = output_path(folder)
    with suppress(_TriedError), _workplace(target, target):
        raise _TriedError


@contextmanager
def locked_folder(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keep other runs from writing to a folder, which is made if it is not there.

    The system gives the lock back when the process ends, however that is: a lock file that a killed run left locks
    nothing. On a file system without locks, nothing is locked.

    Parameters
    ----------
    folder : path-like

    Raises
    ------
    OutputError
        If another process, or another run in this one, holds the lock, or the folder cannot be written.
    """
    target = output_path(folder)
    require_writable(target)
    try:
        target.mkdir(parents=True, exist_ok=True)
        descriptor = _lock(target / LOCK_FILE)
    except OSError as error:
        if isinstance(error, SionnaPartialError):
            raise
        raise _output_error(target, error) from error
    try:
        yield
    finally:
        (target / LOCK_FILE).unlink(missing_ok=True)
        os.close(descriptor)


def _lock(file: Path) -> int:
    """Open and lock a file, and note there who did."""
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 1000).decode(errors="replace") or "another process"
            os.close(descriptor)
            raise OutputError(
                f"folder = '{file.parent}' is being written by {holder}: wait until that has ended, or choose another "
                "folder."
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                os.close(descriptor)
                raise
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(file)):
                os.truncate(descriptor, 0)
                os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
                return descriptor
        os.close(descriptor)  # its last holder has just removed it


class _TriedError(Exception):
    """Makes a workplace vanish together with the folders that were made for it."""


@contextmanager
def _workplace(target: Path, parent: Path, *, inside: bool = False) -> Iterator[Path]:
    """Make a hidden folder in `parent` (or in `target` if that is a folder and `inside`), and remove it in the end."""
    made: list[Path] = []
    place: Path | None = None
    try:
        if inside:
            _require_scene_or_empty(target)
            parent = target if target.is_dir() else parent
        made = [folder for folder in (parent, *parent.parents) if not folder.exists()]
        place = parent / f".tmp-{secrets.token_hex(8)}"
        place.mkdir(parents=True)
        yield place
    except BaseException as error:
        _clean(place, made)
        if isinstance(error, OutputError) and isinstance(error.__cause__, OSError) and str(place) in str(error):
            raise _output_error(target, error.__cause__) from error  # the user knows no hidden folder
        if isinstance(error, OSError) and not isinstance(error, SionnaPartialError):
            raise _output_error(target, error) from error
        raise
    _clean(place, [])


def _clean(place: Path | None, made: list[Path]) -> None:
    if place is not None:
        shutil.rmtree(place, ignore_errors=True)
    for folder in made:
        with suppress(OSError):
            folder.rmdir()


def _output_error(target: Path, error: OSError) -> OutputError:
    remedy = _REMEDIES.get(error.errno or 0, "check the path and the disk.")
    reason = error.strerror or str(error)
    return OutputError(f"path = '{target}' could not be written ({reason}): {remedy}")


def _require_scene_or_empty(target: Path) -> None:
    if target.is_dir():
        if any(target.iterdir()) and not all((target / name).is_file() for name in SCENE_FILES):
            raise OutputError(
                f"path = '{target}' is a folder with other content than an exported scene "
                f"({' and '.join(SCENE_FILES)}): choose a new or an empty folder."
            )
    elif os.path.lexists(target):
        raise OutputError(f"path = '{target}' is a file: choose a new or an empty folder.")


def _swap_entries(new: Path, target: Path, aside: Path) -> None:
    """Move every entry of `new` into `target`, those that were there to `aside`; undo everything on failure."""
    aside.mkdir()
    with ExitStack() as undo:
        for name in sorted(entry.name for entry in new.iterdir()):
            if os.path.lexists(target / name):
                os.replace(target / name, aside / name)
                undo.callback(os.replace, aside / name, target / name)
            os.replace(new / name, target / name)
            undo.callback(os.replace, target / name, new / name)
        undo.pop_all()


def _sync(file: Path) -> None:
    descriptor = os.open(file, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
