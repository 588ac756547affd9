"""Homes -> data set: a folder of shards, built by dask workers in one or several runs."""

import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, wait
from distributed.comm import parse_address, parse_host_port

from sionna_partial.checks import CountProgress, require, require_number, require_whole, settings_or_default
from sionna_partial.display import Shown, counting
from sionna_partial.errors import BackendError, OutputError, SettingsError
from sionna_partial.files import LOCK_FILE, atomic_write, locked_folder, output_path, read_bytes, temporary_folder
from sionna_partial.lab.datasets.home_links import Home, HomeSource, home_sources
from sionna_partial.lab.datasets.home_processes import (
    HomeResult,
    HomeTask,
    allow_homes,
    installed_versions,
    run_home,
    settings_record,
    stop_homes,
)
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.lab.datasets.shards import FAILED_FOLDER, INDEX_FILE, SHARDS_FOLDER, file_stem
from sionna_partial.process import NEW_FOLDER, cleaned_up, core_count

POLL_S = 1.0

ANY_PORT = "127.0.0.1:0"
"""Address of dask's dashboard, whose usual port may be taken."""

MAX_SCHEDULER_BYTES, MAX_INDEX_BYTES = 1_000_000, 4_000_000_000
"""Largest scheduler file, and largest index [bytes]."""

LEFTOVERS = (".tmp-", NEW_FOLDER)

CONNECT_S = 30.0


@dataclass(frozen=True)
class DatasetReport(Shown):
    """Homes that a run built or found, and reasons of failures by name."""

    folder: Path
    built: tuple[str, ...]
    skipped: tuple[str, ...]
    failed: Mapping[str, str]
    elapsed_s: float


def build_dataset(
    folder: str | os.PathLike[str],
    homes: Iterable[Home],
    settings: DatasetSettings | None = None,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    home_time_limit_s: float = 900.0,
    progress: CountProgress | bool | None = None,
) -> DatasetReport:
    """Build a data set of the links of many homes, on all cores or on a dask cluster.

    The folder gets `dataset.json` (settings, homes, versions), `shards/<home>.parquet` for each home, and
    `failed/<home>.json` for each failed home. Shards are written whole or not at all. The same call continues an ended
    run, with the same bytes. Homes may be added later. Changes of a map file are not noticed: build in a new folder.

    Every home has a process of its own: one that raises, crashes or hangs fails alone. It is tried again if its
    process or worker died.

    Parameters
    ----------
    folder : path-like
        Folder of the data set. All workers of a `scheduler` must share it under the same path.
    homes : iterable of int, (int, str) or path-like
        Seeds of `make_home`, pairs of a seed and a kind, and complete maps or folders of them (`home_sources`).
    settings : DatasetSettings, optional
    scheduler : str, optional
        Address of a dask scheduler (tcp://host:8786), or path of a scheduler file. Default: this machine.
    workers : int, optional
        Number of homes at a time on this machine; default: its usable cores.
    home_time_limit_s : float
        Time limit of a home [s].
    progress : bool or callable, optional
        As in `predict_map`, but a callable is called as ``progress(homes_done, homes, message)``.

    Returns
    -------
    DatasetReport
        Names of `built` and `skipped` homes, reasons of the `failed`, and `elapsed_s`.

    Raises
    ------
    SettingsError
        For an argument out of range, or if the folder holds a data set of other settings, homes or versions.
    MapError
        If there is no home, or a path does not exist.
    OutputError
        If the folder cannot be written, has other content or another run, or a worker cannot see it or make homes.
    BackendError
        If the scheduler cannot be reached.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> settings = sp.lab.DatasetSettings(links_per_home=4, transmitters_per_home=1, stages=(0, 5))
    >>> report = sp.lab.build_dataset("links", [7], settings, workers=1)
    >>> report.built
    ('make_home(7)',)
    """
    start = time.monotonic()
    settings = settings_or_default("settings", settings, DatasetSettings)
    require_number("home_time_limit_s", home_time_limit_s, 0.0, 1e6, open_low=True)
    require(scheduler is None or isinstance(scheduler, str), "scheduler", scheduler, "give an address or a file.")
    if workers is not None:
        require_whole("workers", workers, 1, 1000)
        if scheduler is not None:
            raise SettingsError(f"workers = {workers!r} is for this machine, and scheduler is given: leave one out.")
    target, sources = Path(os.path.abspath(output_path(folder))), home_sources(homes)
    built: list[str] = []
    failed: dict[str, str] = {}
    with counting(progress, "homes") as count, locked_folder(target):
        tasks = _prepare(target, sources, settings, home_time_limit_s)
        skipped = tuple(task.source.name for task in tasks if task.is_done)
        missing = [task for task in tasks if task.source.name not in skipped]
        for name in skipped:
            _failure_path(target, name).unlink(missing_ok=True)

        def report(message: str) -> None:
            count(len(skipped) + len(built) + len(failed), len(tasks), message)

        if missing:
            report("starting the workers")
            at_once = min(workers or core_count(), len(missing))
            with _connected(scheduler, at_once) as client, client.as_current():
                for task, result in _results(client, missing, report):
                    name, note = task.source.name, _failure_path(target, task.source.name)
                    if result.outcome == "unusable":
                        raise OutputError(f"{result.error} The homes that are built stay: run it again.")
                    if result.outcome == "done":
                        built.append(name)
                        note.unlink(missing_ok=True)
                    else:
                        failed[name] = result.error
                        with atomic_write(note, "w") as stream:
                            json.dump({"home": task.source.record, "error": result.error}, stream, indent=2)
                    report(f"{name} {'built' if result.outcome == 'done' else 'failed'}")
    return DatasetReport(target, tuple(built), skipped, failed, time.monotonic() - start)


def _results(
    client: Client, tasks: list[HomeTask], report: Callable[[str], None]
) -> Iterator[tuple[HomeTask, HomeResult]]:
    waiting, running = tasks[::-1], dict[Future, HomeTask]()
    while waiting or running:
        try:
            room = sum(client.nthreads().values()) - len(running)
        except (OSError, RuntimeError) as error:
            raise _lost(error) from error
        for _ in range(min(room, len(waiting))):
            task = waiting.pop()
            running[client.submit(run_home, task, pure=False)] = task
        if not running:
            report("waiting for a worker")
            time.sleep(POLL_S)
            continue
        with suppress(TimeoutError):
            for future in wait(list(running), timeout=POLL_S, return_when="FIRST_COMPLETED").done:
                yield running.pop(future), _result(future)


def _prepare(
    folder: Path, sources: list[HomeSource], settings: DatasetSettings, home_time_limit_s: float
) -> list[HomeTask]:
    """Write or check `dataset.json`, remove remains of killed runs, and return the tasks."""
    path, versions = folder / INDEX_FILE, installed_versions()
    homes = [source.record for source in sources]
    index = {"versions": versions, "settings": settings_record(settings), "homes": homes}
    text = json.dumps(index, indent=2, sort_keys=True) + "\n"
    _require_same(folder, json.loads(text))
    for parent in (folder, folder / SHARDS_FOLDER, folder / FAILED_FOLDER):
        for left in (each for start in LEFTOVERS for each in parent.glob(f"{start}*")):
            shutil.rmtree(left, ignore_errors=True)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        with atomic_write(path, "w") as stream:
            stream.write(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return [HomeTask(str(folder), digest, source, settings, versions, home_time_limit_s) for source in sources]


def _require_same(folder: Path, index: dict[str, Any]) -> None:
    path = folder / INDEX_FILE
    if not path.exists():
        names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
        others = [name for name in names if name != LOCK_FILE and not name.startswith(LEFTOVERS)]
        if others:
            raise OutputError(
                f"folder = '{folder}' has other content than a data set ({others[0]}): choose a new or an empty folder."
            )
        return
    try:
        differences = list(_differences(json.loads(read_bytes(path, "path", OutputError, MAX_INDEX_BYTES)), index))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise OutputError(f"'{path}' is damaged ({error}): choose a new folder.") from error
    if differences:
        name, before, now = differences[0]
        more = f" (and {len(differences) - 1} more)" if len(differences) > 1 else ""
        raise SettingsError(
            f"{name} was {before} when '{folder}' was begun, and is {now}{more}: take what it was, or a new folder."
        )


def _differences(earlier: dict[str, Any], now: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield name, old and new value of each difference; new homes are none."""
    for part in ("settings", "versions"):
        before, after = (dict(_leaves(index[part], part)) for index in (earlier, now))
        for name in sorted(before.keys() | after.keys()):
            was, is_now = (json.dumps(values[name]) if name in values else "not there" for values in (before, after))
            if was != is_now:
                yield name, was, is_now
    homes = {home["name"]: home for home in now["homes"]}
    for home in earlier["homes"]:
        other = homes.get(home["name"])
        if other is None:
            yield f"home {home['name']!r}", "in the list of homes", "not in it"
        elif other != home:
            was, is_now = (json.dumps(one.get("path", one.get("seed"))) for one in (home, other))
            yield f"home {home['name']!r}", was, is_now


def _leaves(tree: object, name: str) -> Iterator[tuple[str, object]]:
    if not isinstance(tree, dict):
        yield name, tree
        return
    for key, value in tree.items():
        yield from _leaves(value, f"{name}.{key}")


def _failure_path(folder: Path, name: str) -> Path:
    return folder / FAILED_FOLDER / f"{file_stem(name)}.json"


@contextmanager
def _connected(scheduler: str | None, workers: int) -> Iterator[Client]:
    if scheduler is not None:
        with _remote_client(scheduler) as client:
            yield client
        return
    allow_homes()
    with (
        temporary_folder() as scratch,
        dask.config.set({"temporary-directory": str(scratch)}),  # a killed dask leaves its own behind
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=False,  # homes have processes of their own
            dashboard_address=ANY_PORT,
            worker_dashboard_address=ANY_PORT,
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
        cleaned_up(stop_homes),
    ):
        yield client


def _remote_client(scheduler: str) -> Client:
    by_file = scheduler.endswith(".json") or Path(scheduler).is_file()
    where = {"scheduler_file": scheduler} if by_file else {"address": scheduler}
    if by_file and not Path(scheduler).is_file():
        raise BackendError(f"scheduler = {scheduler!r} is not there: give the file that dask scheduler writes.")
    try:
        if by_file:  # a client that fails on a damaged file hangs in garbage collection (docs/development.md)
            written = json.loads(read_bytes(Path(scheduler), "scheduler", BackendError, MAX_SCHEDULER_BYTES))
            parse_host_port(parse_address(written["address"])[1])
        return Client(**where, timeout=CONNECT_S, set_as_default=False)
    except Exception as error:  # damaged files fail in many ways
        raise BackendError(
            f"scheduler = {scheduler!r} does not answer ({error}): give the address that dask scheduler prints, such "
            "as tcp://host:8786, or its scheduler file."
        ) from error


def _result(future: Future) -> HomeResult:
    if future.status == "finished":
        result: HomeResult = future.result()
        return result
    if future.status != "error":
        raise _lost(future.status)
    error = future.exception()
    if isinstance(error, KilledWorker):
        return HomeResult("failed", "its workers died again and again, see their logs")
    return HomeResult("failed", f"{type(error).__name__}: {error}")


def _lost(reason: object) -> BackendError:
    return BackendError(f"the scheduler is gone ({reason}): run it again, the homes that are built stay.")
