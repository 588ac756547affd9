"""A data set's folder, whatever happens to the process, the workers and the homes while it is built."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from dataset_fakes import HANGS, KILLS, KILLS_ONCE, RAISES, UNWRITABLE, fake_links, processes_make_fakes
from link_tables import assert_same

from sionna_partial.errors import BackendError, MapError, OutputError, SettingsError
from sionna_partial.files import locked_folder
from sionna_partial.lab.datasets import dataset, home_processes
from sionna_partial.lab.datasets.dataset import DatasetReport, build_dataset
from sionna_partial.lab.datasets.home_links import HomeSource
from sionna_partial.lab.datasets.home_processes import HomeResult, HomeTask, run_home
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.lab.datasets.shards import read_dataset, read_shard, shard_path, write_shard

SETTINGS = DatasetSettings(links_per_home=5, transmitters_per_home=1, stages=(0, 50))
SEEDS = range(8)
NAMES = tuple(f"make_home({seed})" for seed in SEEDS)
BUILD = """
import sys
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.lab.datasets.dataset import build_dataset
build_dataset(sys.argv[1], range(8), DatasetSettings(5, 1, (0, 50)), workers=2)
"""


@pytest.fixture
def notes(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let the processes make fake homes; what they note is in this folder."""
    folder = tmp_path_factory.mktemp("fakes")
    monkeypatch.syspath_prepend(processes_make_fakes(folder))
    return folder


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unbroken")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(processes_make_fakes(tmp_path_factory.mktemp("fakes")))
        build_dataset(folder / "set", SEEDS, SETTINGS, workers=1)
    return folder / "set"


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def shards(folder: Path) -> int:
    return len(list(folder.glob("shards/*.parquet")))


def wait_until(true: Callable[[], bool], limit_s: float = 600.0) -> None:
    end = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def is_running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def processes(notes: Path) -> list[int]:
    return [int(path.name.removeprefix("process-")) for path in notes.glob("process-*")]


@contextmanager
def started(*command: object) -> Iterator[subprocess.Popen[str]]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen([*map(str, command)], env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


class TestBuild:
    def test_homes_and_index(self, unbroken: Path) -> None:
        links = read_dataset(unbroken)
        assert tuple(dict.fromkeys(links.home.tolist())) == NAMES
        for name in NAMES:
            assert_same(read_shard(shard_path(unbroken, name)), fake_links(None, name, SETTINGS))
        index = json.loads((unbroken / "dataset.json").read_text())
        assert [home["name"] for home in index["homes"]] == [*NAMES]
        assert index["settings"]["stages"] == [0, 50]
        assert index["versions"].keys() == set(home_processes.PACKAGES)
        assert sorted(path.name for path in unbroken.iterdir()) == [".lock", "dataset.json", "shards"]
        before = files(unbroken)
        report = build_dataset(unbroken, SEEDS, SETTINGS)
        assert (report.skipped, report.built) == (NAMES, ())
        assert files(unbroken) == before

    def test_what_is_missing_or_damaged_or_new_is_built(self, unbroken: Path, tmp_path: Path, notes: Path) -> None:
        folder = tmp_path / "set"
        shutil.copytree(unbroken, folder)
        shard_path(folder, NAMES[3]).write_bytes(shard_path(folder, NAMES[3]).read_bytes()[:100])
        shard_path(folder, NAMES[5]).write_bytes(shard_path(folder, NAMES[6]).read_bytes())
        shard_path(folder, NAMES[7]).unlink()
        calls: list[tuple[int, int, str]] = []
        report = build_dataset(folder, range(9), SETTINGS, workers=1, progress=lambda *call: calls.append(call))
        assert report.built == (NAMES[3], NAMES[5], NAMES[7], "make_home(8)")
        assert (report.skipped, report.failed) == ((*NAMES[:3], NAMES[4], NAMES[6]), {})
        assert calls == [
            (5, 9, "starting the workers"),
            *((6 + k, 9, f"{built} built") for k, built in enumerate(report.built)),
        ]
        rebuilt = files(folder)
        rebuilt.pop("shards/make_home(8).parquet")
        rebuilt["dataset.json"] = (unbroken / "dataset.json").read_bytes()
        assert rebuilt == files(unbroken)


def test_killed_runs_are_continued_to_the_same_bytes(
    unbroken: Path, tmp_path: Path, notes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, temporary = tmp_path / "set", tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    with started(sys.executable, "-c", BUILD, folder) as run:
        wait_until(lambda: shards(folder) >= 2)
        run.kill()
    wait_until(lambda: not any(map(is_running, processes(notes))))
    assert 2 <= shards(folder) < len(SEEDS)
    for parent in (folder, folder / "shards"):
        (parent / ".tmp-0123456789abcdef").mkdir()
        (parent / ".tmp-0123456789abcdef" / "half a file").touch()
        (parent / ".new-sionna_partial_0123456789abcdef").mkdir()
    there = {path: path.stat().st_mtime_ns for path in folder.glob("shards/*.parquet")}
    report = build_dataset(folder, SEEDS, SETTINGS, workers=1)
    assert len(report.skipped) == len(there)
    assert all(path.stat().st_mtime_ns == time_ns for path, time_ns in there.items())
    assert files(folder) == files(unbroken)
    assert not list(temporary.iterdir())


POISONED = (KILLS, 0, HANGS, 1, RAISES, KILLS_ONCE, 2)


@pytest.fixture(scope="module")
def poisoned(tmp_path_factory: pytest.TempPathFactory) -> DatasetReport:
    folder = tmp_path_factory.mktemp("poisoned") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(processes_make_fakes(tmp_path_factory.mktemp("fakes")))
        return build_dataset(folder, POISONED, SETTINGS, workers=2, home_time_limit_s=5.0)


class TestPoisonedHomes:
    def test_they_cost_only_themselves_and_are_listed_with_the_reason(self, poisoned: DatasetReport) -> None:
        assert set(poisoned.built) == {f"make_home({seed})" for seed in (0, 1, 2, KILLS_ONCE)}
        assert poisoned.failed.keys() == {f"make_home({seed})" for seed in (KILLS, HANGS, RAISES)}
        assert set(read_dataset(poisoned.folder).home) == set(poisoned.built)
        for seed, words in (
            (KILLS, ("its process died 3 times (SIGKILL)\n", "last words")),
            (HANGS, ("took longer than 5 s, the time limit of a home\n", "dataset_fakes.py", "in make_home")),
            (RAISES, ("ZeroDivisionError: a fault of this home\nTraceback",)),
        ):
            name = f"make_home({seed})"
            noted = json.loads((poisoned.folder / "failed" / f"{name}.json").read_text())
            assert noted == {"home": {"name": name, "seed": seed}, "error": poisoned.failed[name]}
            assert noted["error"].startswith(words[0])
            assert all(word in noted["error"] for word in words)

    def test_they_are_tried_again_by_the_next_run(self, poisoned: DatasetReport, notes: Path) -> None:
        name = f"make_home({RAISES})"
        write_shard(fake_links(None, name, SETTINGS), shard_path(poisoned.folder, name), task(name, RAISES).metadata)
        (notes / "harmless").touch()
        report = build_dataset(poisoned.folder, POISONED, SETTINGS, workers=1)
        assert set(report.built) == {f"make_home({seed})" for seed in (KILLS, HANGS)}
        assert not list((poisoned.folder / "failed").iterdir())

    def test_full_disk_ends_the_run(self, tmp_path: Path, notes: Path) -> None:
        with pytest.raises(OutputError, match=r"the disk is full.* The homes that are built stay: run it again\."):
            build_dataset(tmp_path / "set", [UNWRITABLE, 1], SETTINGS, workers=1)


class TestRefused:
    def test_other_settings_homes_and_versions(self, unbroken: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        before = files(unbroken)
        other = replace(SETTINGS, seed=1, stages=(0,))
        for homes, settings, message in (
            (SEEDS, other, r"settings\.seed was 0 when '.*' was begun, and is 1 \(and 1 more\): take"),
            (SEEDS[1:], SETTINGS, r"home 'make_home\(0\)' was in the list of homes when .* is not in it:"),
        ):
            with pytest.raises(SettingsError, match=message):
                build_dataset(unbroken, homes, settings)
        with locked_folder(unbroken), pytest.raises(OutputError, match="is being written by another process: wait"):
            build_dataset(unbroken, SEEDS, SETTINGS)
        versions = home_processes.installed_versions() | {"sionna-rt": "9.9"}
        monkeypatch.setattr(dataset, "installed_versions", lambda: versions)
        with pytest.raises(SettingsError, match=r'versions\.sionna-rt was ".*" when .* begun, and is "9\.9": take'):
            build_dataset(unbroken, SEEDS, SETTINGS)
        assert files(unbroken) == before

    def test_arguments(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(dataset, "CONNECT_S", 0.2)
        for error, message, options in (
            (MapError, "homes is empty", {"homes": []}),
            (SettingsError, "workers = 0 is not allowed", {"workers": 0}),
            (SettingsError, "home_time_limit_s = 0.0 is not allowed", {"home_time_limit_s": 0.0}),
            (SettingsError, "workers = 2 is for this machine", {"workers": 2, "scheduler": "tcp://127.0.0.1:1"}),
            (BackendError, r"scheduler = 'nothing\.json' is not there", {"scheduler": "nothing.json"}),
            (BackendError, "scheduler = 'tcp://127.0.0.1:9' does not answer", {"scheduler": "tcp://127.0.0.1:9"}),
        ):
            given: dict[str, Any] = {"homes": SEEDS, "settings": SETTINGS} | options
            with pytest.raises(error, match=message):
                build_dataset(tmp_path / "set", **given)

    def test_home_from_another_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def unread(_: object, tasks: list[HomeTask], *__: object) -> Iterator[tuple[HomeTask, HomeResult]]:
            yield from ((each, HomeResult("failed", "not read")) for each in tasks)

        monkeypatch.setattr(dataset, "_results", unread)
        for folder in ("a", "b"):
            (tmp_path / folder / "villa").mkdir(parents=True)
            (tmp_path / folder / "villa" / "map.yaml").touch()
        assert build_dataset(tmp_path / "set", [tmp_path / "a"], SETTINGS, workers=1).failed.keys() == {"villa"}
        with pytest.raises(SettingsError, match=r"home 'villa' was \".*a/villa/map\.yaml\" when .* is \".*b/villa/map"):
            build_dataset(tmp_path / "set", [tmp_path / "b"], SETTINGS, workers=1)

    def test_folder_with_other_content_or_a_damaged_index(self, tmp_path: Path) -> None:
        (tmp_path / "letter.txt").touch()
        with pytest.raises(OutputError, match=r"other content than a data set \(letter\.txt\): choose a new or an"):
            build_dataset(tmp_path, SEEDS, SETTINGS)
        (tmp_path / "dataset.json").write_text('{"homes": 3, "settings": {}, "versions": {}}')
        with pytest.raises(OutputError, match=r"dataset\.json' is damaged .*: choose a new folder\."):
            build_dataset(tmp_path, SEEDS, SETTINGS)


def test_numbers_of_numpy_are_noted_as_numbers() -> None:
    settings = replace(SETTINGS, seed=np.int64(3), margin_m=np.float32(2.5), stages=(np.int64(0), np.int64(50)))
    plain = replace(SETTINGS, seed=3, margin_m=2.5)
    notes, expected = (replace(task("a", 1), settings=each).metadata for each in (settings, plain))
    assert json.dumps(notes) == json.dumps(expected)


def task(name: str, seed: int, folder: Path = Path("nowhere"), digest: str = "") -> HomeTask:
    return HomeTask(str(folder), digest, HomeSource(name, seed), SETTINGS, home_processes.installed_versions(), 4.0)


def test_worker_that_cannot_make_homes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "dataset.json").write_text("{}")
    (tmp_path / "other" / "dataset.json").write_text("[]")
    known = home_processes.installed_versions()
    for folder, versions, message in (
        ("elsewhere", {}, "cannot read .*: give a folder on a file system that all workers share"),
        ("other", {}, "sees another "),
        ("", {"mitsuba": "1.0"}, "has mitsuba 1.0, the data set is made with .*: install"),
    ):
        mine = task("make_home(1)", 1, tmp_path / folder, hashlib.sha256(b"{}").hexdigest())
        mine = replace(mine, versions=known)
        monkeypatch.setattr(home_processes, "installed_versions", lambda found=known | versions: found)
        result = run_home(mine)
        assert result.outcome == "unusable"
        assert re.search(message, result.error)


def test_slurm_example_whose_worker_is_killed(
    unbroken: Path, tmp_path: Path, notes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without SLURM the script starts a scheduler and a worker; another worker goes on where that one was."""
    script, bin_folder = (
        Path(__file__).parents[1] / "examples" / "slurm" / "dataset.sbatch",
        Path(sys.executable).parent,
    )
    subprocess.run(["bash", "-n", script], check=True)
    monkeypatch.setenv("PATH", f"{bin_folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_SUBMIT_DIR", str(tmp_path))
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    options = ("--homes", 8, "--first-seed", 0, "--links", 5, "--transmitters", 1, "--stage", 0, "--stage", 50)
    with started("bash", script, tmp_path / "set", *options) as run:
        wait_until(lambda: shards(tmp_path / "set") >= 2)
        (worker,) = (each for each in psutil.Process(run.pid).children() if "worker" in each.cmdline())
        for each in [*worker.children(recursive=True), worker]:
            each.kill()
        (file,) = tmp_path.glob("scheduler.*.json")
        lone = ("--nworkers", 1, "--nthreads", 1, "--no-nanny", "--no-dashboard", "--local-directory", notes)
        with started(bin_folder / "dask", "worker", "--scheduler-file", file, *lone):
            _, errors = run.communicate(timeout=600.0)
    assert run.returncode == 0, errors
    assert files(tmp_path / "set") == files(unbroken)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
