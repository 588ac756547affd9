"""Which homes a data set is built from: homes made from seeds, and complete maps from files."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sionna_partial.errors import MapError
from sionna_partial.files import SCENE_FILES
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import HOME_KINDS, HomeKind, is_whole, require
from sionna_partial.simulation.homes import make_home

Home = int | tuple[int, HomeKind | None] | str | os.PathLike[str]
"""Seed of `make_home`, seed and kind, or path of a complete map or of a folder of them."""

MAP_SUFFIXES = (".yaml", ".yml", ".npz")
"""Files in a folder that are taken for maps."""

COMMON_STEMS = ("map", "scene")
"""Names of map files that say nothing of the home: it has the name of the folder."""


@dataclass(frozen=True)
class HomeSource:
    """A home to build from.

    Parameters
    ----------
    name : str
        Name of the home; its shard has it too.
    origin : int or str
        Seed of `make_home`, or absolute path of a complete map.
    kind : HomeKind or None
        Kind that `make_home` makes.
    """

    name: str
    origin: int | str
    kind: HomeKind | None = None

    @property
    def record(self) -> dict[str, object]:
        """What a data set notes about the home."""
        kind = {"kind": self.kind} if self.kind else {}
        return {"name": self.name, "seed" if isinstance(self.origin, int) else "path": self.origin, **kind}

    def load(self) -> PartialMap:
        """Make or read the home; errors are those of `make_home` and `load_map`."""
        return make_home(self.origin, self.kind) if isinstance(self.origin, int) else load_map(self.origin)


def home_sources(homes: Iterable[Home]) -> list[HomeSource]:
    """Name the homes to build from.

    Parameters
    ----------
    homes : iterable of int or path-like
        Seeds of `make_home`, or pairs of a seed and a kind (None: drawn); complete maps that `load_map` reads; folders
        of such maps, directly or each in a folder with a `map.yaml` or `scene.xml`. A map has the name of its file, or
        of its folder if the file is called map or scene.

    Returns
    -------
    list of HomeSource
        In the order of `homes`; those of a folder in the order of their names.

    Raises
    ------
    MapError
        If there is no home, or a path is not there or holds no map, or two homes have one name.
    """
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
        if not path.exists():
            raise MapError(f"path = '{path}' is not there: give complete maps, or a folder with maps in it.")
        yield from _maps_at(path)
    else:
        raise MapError(f"home = {home!r} is neither a seed nor a path: give a seed of make_home, or a complete map.")


def _maps_at(path: Path) -> Iterator[HomeSource]:
    if path.is_file():
        yield _of_file(path)
        return
    inner = [_of_folder(path)] if _is_home(path) else [_of_entry(entry) for entry in sorted(path.iterdir())]
    found = [source for source in inner if source is not None]
    if not found:
        raise MapError(
            f"path = '{path}' holds no map: give a folder with maps ({', '.join(MAP_SUFFIXES)}), or with folders that "
            f"have a {' or '.join(SCENE_FILES)}."
        )
    yield from found


def _of_entry(entry: Path) -> HomeSource | None:
    """Return the map that an entry of a folder of maps is; None for other files and folders."""
    if entry.is_dir():
        return _of_folder(entry) if _is_home(entry) else None
    return _of_file(entry) if entry.suffix.lower() in MAP_SUFFIXES else None


def _is_home(folder: Path) -> bool:
    return any((folder / name).is_file() for name in SCENE_FILES)


def _of_folder(folder: Path) -> HomeSource:
    file = next(folder / name for name in SCENE_FILES if (folder / name).is_file())
    return HomeSource(folder.name, str(file))


def _of_file(file: Path) -> HomeSource:
    return HomeSource(file.parent.name if file.stem in COMMON_STEMS else file.stem, str(file))
