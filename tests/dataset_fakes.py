"""Homes that take no time, die, hang or raise: they take the place of real ones in the processes of a data set.

`processes_make_fakes` puts a `sitecustomize` module on the path of those processes; it calls `install` when they start.
"""

import functools
import hashlib
import os
import pickle
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.lab.datasets.table import LinkTable
from sionna_partial.maps.partial_map import PartialMap

KILLS, HANGS, RAISES, KILLS_ONCE, UNWRITABLE = 666, 667, 668, 669, 670
"""Seeds of homes that end their process, never end, raise, end their process at the first try, and find a full disk."""

HOME_S = 0.15

SETTINGS = DatasetSettings(links_per_home=5, transmitters_per_home=1, stages=(0, 50))
TABLES = "tables.pickle"
"""Links of the homes with these settings: the processes, of which many die, would take a second to make theirs."""


def processes_make_fakes(folder: Path) -> str:
    """Write the `sitecustomize` module and the links, and return what to put in front of the path of Python."""
    (folder / TABLES).write_bytes(_tables())
    (folder / "sitecustomize.py").write_text(
        f"import sys\nsys.path.insert(0, {str(Path(__file__).parent)!r})\n" + _CODE
    )
    return str(folder)


@functools.cache
def _tables() -> bytes:
    names = [f"make_home({seed})" for seed in (*range(9), KILLS, HANGS, KILLS_ONCE)]
    return pickle.dumps((SETTINGS, {name: fake_links(None, name, SETTINGS) for name in names}))


_CODE = """
if "home_processes import serve" in " ".join(sys.orig_argv):
    import dataset_fakes
    dataset_fakes.install()
"""


def install() -> None:
    from sionna_partial.lab.datasets import home_links, home_processes

    home_links.make_home = make_home  # type: ignore[assignment]
    home_processes.home_links = stored_links  # type: ignore[assignment]


def make_home(seed: int, kind: str | None = None) -> SimpleNamespace:
    """Do what the seed stands for; the process number goes into a file beside `sitecustomize`."""
    notes = _notes()
    (notes / f"process-{os.getpid()}").touch()
    if (notes / "harmless").exists():
        return SimpleNamespace()
    if seed == KILLS or (seed == KILLS_ONCE and not (notes / f"killed {seed}").exists()):
        (notes / f"killed {seed}").touch()
        print("last words", file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == HANGS:
        time.sleep(1000.0)
    if seed == RAISES:
        raise ZeroDivisionError("a fault of this home")
    if seed == UNWRITABLE:
        raise _full_disk()
    time.sleep(HOME_S)
    return SimpleNamespace()


def _notes() -> Path:
    return Path(sys.modules["sitecustomize"].__file__ or "").parent


def stored_links(home: object, name: str, settings: DatasetSettings) -> LinkTable:
    known, tables = pickle.loads((_notes() / TABLES).read_bytes())
    return tables[name] if settings == known and name in tables else fake_links(home, name, settings)


def fake_links(home: object, name: str, settings: DatasetSettings | None = None) -> LinkTable:
    from link_tables import make_table

    settings = settings or DatasetSettings()
    seed = int.from_bytes(hashlib.sha256(f"{settings.seed} {name}".encode()).digest()[:6])
    table = make_table(1, settings.links_per_home, settings.stages, seed)
    cells = np.random.default_rng(seed).integers(0, 3, (3, 5))
    complete_maps = {name: PartialMap(cells, 0.7, (-0.3, 0.1), 2.4, seed % 50)}
    home_names, stage = np.full(len(table), name), table.stage.astype(np.float64)
    return replace(table, home=home_names, stage=stage, complete_maps=complete_maps)


def _full_disk() -> Exception:
    from sionna_partial.errors import OutputError

    return OutputError("the disk is full")
