"""Homes of a data set: a robot explores a home, and links are traced on each of its maps and on the home."""

import hashlib
import logging
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.checks import is_whole, require, shown
from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.errors import MapError
from sionna_partial.exploration.explore import explore_trajectory
from sionna_partial.files import SCENE_FILES
from sionna_partial.lab.datasets.settings import MIXED_SENSORS, SHORT_LINK_M, DatasetSettings
from sionna_partial.lab.datasets.table import CIR, LinkTable
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.prediction.features import LinkFeatures, link_features
from sionna_partial.settings import HOME_KINDS, Fusion, HomeKind, SensorSettings
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.simulation import Simulation
from sionna_partial.worlds.homes import make_home

Home = int | tuple[int, HomeKind | None] | str | os.PathLike[str]
"""Seed of `make_home`, (seed, kind), or path of a complete map or of a folder of maps."""

MAP_SUFFIXES = (".yaml", ".yml", ".npz")

COMMON_STEMS = ("map", "scene")
"""Names of map files for which the home has the name of the folder."""

NEAREST_M = 0.1

FROM_BORDER_CELLS = 0.25

_LIDAR_FRACTION = 2 / 3

MAX_DRAWS = 1000

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class HomeSource:
    """A home to build from: name, seed of `make_home` or absolute path of a complete map, and kind."""

    name: str
    origin: int | str
    kind: HomeKind | None = None

    @property
    def record(self) -> dict[str, object]:
        kind = {"kind": self.kind} if self.kind else {}
        return {"name": self.name, "seed" if isinstance(self.origin, int) else "path": self.origin, **kind}

    def load(self) -> PartialMap:
        return make_home(self.origin, self.kind) if isinstance(self.origin, int) else load_map(self.origin)


def home_sources(homes: Iterable[Home]) -> list[HomeSource]:
    """Return the homes to build from, in order; homes of a folder are sorted by name.

    A map has the name of its file, or of its folder if the file is called map or scene.
    """
    if not isinstance(homes, Iterable) or isinstance(homes, (str, bytes)):
        raise MapError(f"homes = {homes!r} is no list: give seeds of make_home, or paths of complete maps, in a list.")
    sources: dict[str, HomeSource] = {}
    for home in homes:
        for source in _sources(home):
            other = sources.setdefault(source.name, source)
            if other is not source:
                raise MapError(
                    f"two homes are called {source.name!r}, {other.origin!r} and {source.origin!r}: leave one out, or "
                    "rename its file or folder."
                )
    if not sources:
        raise MapError("homes is empty: give seeds of make_home, or paths of complete maps.")
    return list(sources.values())


def _sources(home: Home) -> Iterator[HomeSource]:
    if isinstance(home, int) and not isinstance(home, bool):
        yield HomeSource(f"make_home({home})", home)
    elif isinstance(home, tuple) and len(home) == 2:
        seed, kind = home
        require(is_whole(seed), "seed", seed, "give a whole number of 0 or more.")
        require(kind is None or kind in HOME_KINDS, "kind", kind, f"choose one of {HOME_KINDS}, or None.")
        yield HomeSource(f"make_home({seed}, {kind})" if kind else f"make_home({seed})", seed, kind)
    elif isinstance(home, (str, os.PathLike)):
        path = Path(os.path.abspath(home))
        if not os.path.exists(path):
            raise MapError(f"path = '{path}' is not there: give complete maps, or a folder with maps in it.")
        yield from _maps_at(path)
    else:
        raise MapError(
            f"home = {shown(home)} is neither a seed nor a path: give a seed of make_home or a complete map."
        )


def _maps_at(path: Path) -> Iterator[HomeSource]:
    files = [path]
    if path.is_dir():
        entries = [path] if _scene_file(path) else sorted(path.iterdir())
        maps = (_scene_file(each) if each.is_dir() else each for each in entries)
        files = [each for each in maps if each and (each.name in SCENE_FILES or each.suffix.lower() in MAP_SUFFIXES)]
    if not files:
        raise MapError(
            f"path = '{path}' holds no map: give a folder with maps ({', '.join(MAP_SUFFIXES)}), or with folders that "
            f"have a {' or '.join(SCENE_FILES)}."
        )
    for file in files:
        yield HomeSource(file.parent.name if file.stem in COMMON_STEMS else file.stem, str(file))


def _scene_file(folder: Path) -> Path | None:
    return next((folder / name for name in SCENE_FILES if (folder / name).is_file()), None)


@dataclass(frozen=True)
class _Positions:
    tx_m: list[Floats]
    rx_m: list[Floats]
    anywhere: list[Bools]


def home_links(home: PartialMap, name: str, settings: DatasetSettings) -> LinkTable:
    """Trace the links of a complete home on the robot's map at every stage, and on the complete home.

    Half of a transmitter's receivers are in free cells of the home, half (`anywhere`) in any cell of the map area that
    is no wall; of each half, `short_link_fraction` within `SHORT_LINK_M`. No receiver is in a cell that a robot with
    errors mapped as a wall, or within `NEAREST_M` of its transmitter.

    The truth is outage for a receiver outside the free cells of the home (paper, "Indoor-Outdoor Estimation"), else the
    trace on the complete home. Positions and robot depend on `name` and the settings only. The table is ordered
    by stage, then by transmitter.
    """
    require_map("home", home)
    home = map_area(closed_home(home, name), settings.margin_m)
    rng = np.random.default_rng(_home_seed(name, settings))
    seed, sensor = int(rng.integers(2**31)), home_sensor(name, settings)
    maps = explore_trajectory(home, settings.stages, seed, sensor=sensor, progress=False).maps
    by_fraction = not all(map(is_whole, settings.stages))
    if by_fraction and settings.stages[-1] == 1 and maps[-1].is_nearly_complete:
        maps[-1] = enclosed_map(maps[-1])
    positions = _draw_positions(home, maps, name, settings, rng)
    inside, link_state, gain_db, cir = _truth(home, positions, settings)
    return LinkTable.concatenate(
        LinkTable(
            home=np.full(len(phi), name),
            stage=np.full(len(phi), stage, dtype=np.float64),
            features=phi,
            maps=(partial,),
            map_index=np.zeros(len(phi), dtype=np.int64),
            link_state=link_state,
            gain_db=gain_db,
            inside=inside,
            anywhere=np.concatenate(positions.anywhere),
            observed_fraction=np.full(len(phi), partial.observed_fraction),
            complete_maps={name: home},
            cir=cir,
        )
        for stage, partial, phi in zip(settings.stages, maps, _features(maps, positions, settings), strict=True)
    )


def closed_home(home: PartialMap, name: str) -> PartialMap:
    """Return a complete home, with walls around its grid if only these are missing."""
    if home.is_complete:
        return home
    ny, nx = home.shape
    closed = home.window(-1, -1, (ny + 2, nx + 2), CellState.WALL)
    if not (home.state == CellState.FREE).any():
        raise MapError(f"home {name!r} has no free cell: give maps of whole homes, with rooms.")
    if not closed.is_complete:
        raise MapError(
            f"home {name!r} is not complete, a free cell touches an unknown one: give maps of whole homes, whose free "
            "cells end at walls."
        )
    _log.warning("home %r has free cells at the border of its grid: they are taken to end at walls there", name)
    return closed


def enclosed_map(partial: PartialMap) -> PartialMap:
    """Return a map whose unknown cells beside free ones are walls: complete, with the errors of the robot."""
    beside_free = ndimage.binary_dilation(partial.state == CellState.FREE)
    closing = beside_free & (partial.state == CellState.UNKNOWN)
    return replace(partial, state=np.where(closing, CellState.WALL, partial.state).astype(np.uint8))


def home_sensor(name: str, settings: DatasetSettings) -> SensorSettings:
    """Return the sensor of the settings, or one drawn by the name of the home."""
    if isinstance(settings.sensor, SensorSettings):
        return settings.sensor
    rng = np.random.default_rng([1, *_home_seed(name, settings)])
    values = {key: low + rng.random() ** 2 * (high - low) for key, (low, high) in MIXED_SENSORS.items()}
    values["field_of_view_deg"] = float(rng.uniform(*MIXED_SENSORS["field_of_view_deg"]))
    values["range_m"] = float(np.exp(rng.uniform(*np.log(MIXED_SENSORS["range_m"]))))
    if rng.random() < _LIDAR_FRACTION:
        values["field_of_view_deg"] = 360.0
    fusions = get_args(Fusion)
    return SensorSettings(**values, fusion=fusions[rng.integers(len(fusions))])


def _home_seed(name: str, settings: DatasetSettings) -> list[int]:
    return [settings.seed, *hashlib.sha256(name.encode()).digest()]


def map_area(home: PartialMap, margin_m: float) -> PartialMap:
    """Cut or extend a map to the bounding box of its known cells and a margin."""
    known = np.argwhere(home.state != CellState.UNKNOWN)
    margin = math.ceil(margin_m / home.resolution_m - 1e-9)
    (row0, column0), (row1, column1) = known.min(axis=0), known.max(axis=0) + 1
    shape = int(row1 - row0) + 2 * margin, int(column1 - column0) + 2 * margin
    return home.window(int(row0) - margin, int(column0) - margin, shape, CellState.UNKNOWN)


def _draw_positions(
    home: PartialMap, maps: list[PartialMap], name: str, settings: DatasetSettings, rng: np.random.Generator
) -> _Positions:
    open_cells = np.logical_and.reduce([each.state != CellState.WALL for each in (home, *maps)])
    free = open_cells & (home.state == CellState.FREE)
    links, count = settings.links_per_home, settings.transmitters_per_home
    tx_m = list(points_in(free, count, home, settings.tx_height_m, rng))
    receivers, anywhere = [], []
    for index, tx in enumerate(tx_m):
        number = links * (index + 1) // count - links * index // count
        parts = [_receivers(cells, number, home, name, tx, settings, rng) for cells in (free, open_cells)]
        receivers.append(np.concatenate(parts))
        anywhere.append(np.arange(2 * number) >= number)
    return _Positions(tx_m, receivers, anywhere)


def _receivers(
    cells: Bools,
    count: int,
    home: PartialMap,
    name: str,
    tx_m: Floats,
    settings: DatasetSettings,
    rng: np.random.Generator,
) -> Floats:
    short, height_m = round(settings.short_link_fraction * count), settings.rx_height_m
    x, y = (home.origin_m[axis] + (np.arange(home.shape[1 - axis]) + 0.5) * home.resolution_m for axis in (0, 1))
    near_cells = np.hypot(x[None] - tx_m[0], y[:, None] - tx_m[1]) <= SHORT_LINK_M
    drawn = [(cells, count - short), (cells & near_cells, short)]
    rx_m = np.concatenate([points_in(where, number, home, height_m, rng) for where, number in drawn])
    for _ in range(MAX_DRAWS):
        near = np.linalg.norm(rx_m - tx_m, axis=1) < NEAREST_M
        if not near.any():
            return rx_m
        rx_m[near] = points_in(cells, int(near.sum()), home, height_m, rng)
    raise MapError(f"home {name!r} is too small, all of it is within {NEAREST_M:g} m of a transmitter: leave it out.")


def points_in(cells: Bools, count: int, home: PartialMap, height_m: float, rng: np.random.Generator) -> Floats:
    """Draw points (count, 3) uniformly from cells, off their borders [m]."""
    rows, columns = np.nonzero(cells)
    index = rng.integers(len(rows), size=count)
    inner = rng.uniform(FROM_BORDER_CELLS, 1.0 - FROM_BORDER_CELLS, (count, 2))
    points = np.stack([columns[index], rows[index]], axis=1) + inner
    return np.column_stack([home.origin_m + points * home.resolution_m, np.full(count, height_m)])


def _truth(
    home: PartialMap, positions: _Positions, settings: DatasetSettings
) -> tuple[Bools, States, Floats, dict[str, Floats]]:
    """Return inside (N,), link state, path gain [dB] and impulse response `CIR` of receivers."""
    inside = [home.state_at(rx) == CellState.FREE for rx in positions.rx_m]
    indoors = [rx[where] for rx, where in zip(positions.rx_m, inside, strict=True)]
    links = _traced(home, positions.tx_m, indoors, settings, polarisations=2 if settings.cir_paths else 1)
    where = np.concatenate(inside)
    link_state = np.full(len(where), LinkState.OUTAGE, dtype=np.uint8)
    gain_db = np.full(len(where), GAIN_FLOOR_DB)
    link_state[where] = np.concatenate([each.link_state for each in links])
    gain_db[where] = np.concatenate([each.gain_db for each in links])
    cir: dict[str, Any] = {}
    parts = [_strongest(each, settings.cir_paths) for each in links if settings.cir_paths]
    for name, missing, found in zip(CIR, (0.0, 0.0, np.nan), zip(*parts, strict=True), strict=False):
        cir[name] = np.full((len(where), settings.cir_paths), missing, np.float32)
        cir[name][where] = np.concatenate(found)
    return where, link_state, gain_db, cir


def _strongest(links: TracedLinks, count: int) -> tuple[Floats, Floats, Floats]:
    """Return the arrays (N, count) of `CIR` of the strongest paths, the strongest first."""
    response = links.cir(normalize_delays=False)
    gain, delay_s = response["a"].to_numpy()[:, 0, 0], response["delay_s"].to_numpy()
    order = np.argsort(-np.abs(gain), axis=1, kind="stable")[:, :count]
    more = [(0, 0), (0, count - order.shape[1])]
    gain, delay_s = (np.take_along_axis(each, order, axis=1) for each in (gain, delay_s))
    gain, delay_s = np.pad(gain, more), np.pad(delay_s, more, constant_values=np.nan)
    return gain.real, gain.imag, delay_s


def _traced(
    partial: PartialMap,
    tx_m: list[Floats],
    rx_m: list[Floats],
    settings: DatasetSettings,
    polarisations: Literal[1, 2] = 1,
) -> list[TracedLinks]:
    scene_settings = replace(settings.scene, material=settings.scene.traced_material)
    simulation = Simulation(partial, settings.trace, scene_settings)
    pairs = zip(tx_m, rx_m, strict=True)
    return [simulation.links(*ends, polarisations=polarisations, progress=False) for ends in pairs]


def _features(maps: list[PartialMap], positions: _Positions, settings: DatasetSettings) -> list[LinkFeatures]:
    """Return the features on each map; equal maps are traced once."""
    features: list[LinkFeatures] = []
    for index, partial in enumerate(maps):
        if index and partial == maps[index - 1]:
            features.append(features[-1])
            continue
        links = _traced(partial, positions.tx_m, positions.rx_m, settings)
        features.append(LinkFeatures.concatenate([link_features(partial, each) for each in links]))
    return features
