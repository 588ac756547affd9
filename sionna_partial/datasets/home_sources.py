"""Homes of a data set: homes made from seeds, and complete maps from files."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sionna_partial.checks import is_whole, require, shown
from sionna_partial.errors import MapError
from sionna_partial.files import SCENE_FILES
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import HOME_KINDS, HomeKind
from sionna_partial.worlds.homes import make_home

Home = int | tuple[int, HomeKind | None] | str | os.PathLike[str]
"""Seed of `make_home`, seed and kind, or path of a complete map or of a folder of them."""

MAP_SUFFIXES = (".yaml", ".yml", ".npz")
"""Files in a folder that are taken for maps."""

COMMON_STEMS = ("map", "scene")
"""Names of map files that do not name the home: it has the name of the folder."""


@dataclass(frozen=True)
class HomeSource:
    """A home to build from: its name, seed of `make_home` or absolute path of a complete map, and kind."""

    name: str
    origin: int | str
    kind: HomeKind | None = None

    @property
    def record(self) -> dict[str, object]:
        """Entry of the home in a data set."""
        kind = {"kind": self.kind} if self.kind else {}
        return {"name": self.name, "seed" if isinstance(self.origin, int) else "path": self.origin, **kind}

    def load(self) -> PartialMap:
        """Make or read the home, with the errors of `make_home` and `load_map`."""
        return make_home(self.origin, self.kind) if isinstance(self.origin, int) else load_map(self.origin)


def home_sources(homes: Iterable[Home]) -> list[HomeSource]:
    """Name the homes to build from, in their order; those of a folder in the order of their names.

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
    """Return the map in a folder of one home."""
    return next((folder / name for name in SCENE_FILES if (folder / name).is_file()), None)
