"""Homes that take no time, die, hang or raise: they take the place of real ones in the processes of a data set.

`processes_make_fakes` puts a `sitecustomize` module on the path of those processes; it calls `install` when they start.
"""

import hashlib
import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from predictor_links import walls_of_links

from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.datasets.shards import LinkTable
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import ATTENUATION_LENGTHS_M, LinkContext, LinkFeatures
from sionna_partial.settings import DatasetSettings

KILLS, HANGS, RAISES, KILLS_ONCE, UNWRITABLE = 666, 667, 668, 669, 670
"""Seeds of homes that end their process, never end, raise, end their process at the first try, and find a full disk."""

HOME_S = 0.15
"""Time that a fake home takes [s]."""


def processes_make_fakes(folder: Path) -> str:
    """Write the `sitecustomize` module, and return what to put in front of the path of Python."""
    (folder / "sitecustomize.py").write_text(
        f"import sys\nsys.path.insert(0, {str(Path(__file__).parent)!r})\n" + _CODE
    )
    return str(folder)


_CODE = """
if "home_links import serve" in " ".join(sys.orig_argv):
    import dataset_fakes
    dataset_fakes.install()
"""


def install() -> None:
    """Replace the making and the tracing of homes in this process."""
    from sionna_partial.datasets import home_links

    home_links.make_home = make_home  # type: ignore[assignment]
    home_links.home_links = fake_links  # type: ignore[assignment]


def make_home(seed: int, kind: str | None = None) -> SimpleNamespace:
    """Do what the seed stands for; the process number goes into a file beside `sitecustomize`."""
    notes = Path(sys.modules["sitecustomize"].__file__ or "").parent
    (notes / f"process-{os.getpid()}").touch()
    if (notes / "harmless").exists():
        return SimpleNamespace()
    if seed == KILLS or (seed == KILLS_ONCE and not (notes / "killed").exists()):
        (notes / "killed").touch()
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


def fake_links(home: object, name: str, settings: DatasetSettings | None = None) -> LinkTable:
    """Make up links that depend on the name and the seed."""
    settings = settings or DatasetSettings()
    rng = np.random.default_rng([settings.seed, *hashlib.sha256(name.encode()).digest()])
    count = 2 * settings.links_per_home * len(settings.stages)
    tx_m, rx_m = rng.uniform(0.0, 9.0, (2, count, 3))
    distance_m = np.linalg.norm(rx_m - tx_m, axis=1)
    gains_db = rng.uniform(GAIN_FLOOR_DB, -40.0, (count, len(ATTENUATION_LENGTHS_M)))
    maps = tuple(_map(rng) for _ in settings.stages)
    strongest_m = rng.uniform(0.0, 9.0, count)
    map_index = np.repeat(np.arange(len(maps)), 2 * settings.links_per_home)
    state = rng.integers(0, 3, count).astype(np.uint8)
    context = LinkContext.on_maps(
        maps,
        map_index,
        tx_m=tx_m,
        rx_m=rx_m,
        link_state=state[::-1],
        unobserved_distance_m=distance_m / 2,
        indirect_gain_db=gains_db,
        strongest_unobserved_m=strongest_m,
        **walls_of_links(count),
    )
    return LinkTable(
        home=np.full(count, name),
        stage=np.repeat(settings.stages, 2 * settings.links_per_home).astype(np.float64),
        features=LinkFeatures(
            state[::-1].copy(), distance_m / 2, distance_m, rng.uniform(GAIN_FLOOR_DB, -40.0, count), context
        ),
        maps=maps,
        map_index=map_index,
        link_state=state,
        gain_db=rng.uniform(GAIN_FLOOR_DB, -40.0, count),
        inside=rng.integers(0, 2, count).astype(bool),
        anywhere=np.tile(np.repeat([False, True], settings.links_per_home), len(settings.stages)),
        observed_fraction=rng.uniform(0.0, 1.0, count),
        complete_maps={name: _map(rng)},
    )


def _map(rng: np.random.Generator) -> PartialMap:
    shape, origin_m = rng.integers(3, 9, 2), tuple(rng.uniform(-1.0, 1.0, 2))
    interior_cells = int(rng.integers(50)) if rng.random() < 0.5 else None
    return PartialMap(rng.integers(0, 3, shape), rng.uniform(0.5, 1.0), origin_m, rng.uniform(2.0, 4.0), interior_cells)


def _full_disk() -> Exception:
    from sionna_partial.errors import OutputError

    return OutputError("the disk is full")
