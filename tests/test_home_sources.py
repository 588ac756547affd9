"""Names of homes, and where they come from."""

from pathlib import Path
from typing import Any

import pytest

from sionna_partial.datasets.home_links import HomeSource, home_sources
from sionna_partial.errors import MapError, SettingsError
from sionna_partial.worlds.homes import make_home


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    """Two maps in a folder, a map in a folder of its own, an exported scene, and other files."""
    (tmp_path / "house").mkdir()
    (tmp_path / "scene").mkdir()
    (tmp_path / "empty").mkdir()
    for name in ("one.yaml", "two.npz", "picture.png", "house/map.yaml", "scene/map.yaml", "scene/scene.xml"):
        (tmp_path / name).touch()
    return tmp_path


def test_seeds() -> None:
    assert home_sources(range(3, 5)) == [HomeSource("make_home(3)", 3), HomeSource("make_home(4)", 4)]
    assert home_sources([3])[0].record == {"name": "make_home(3)", "seed": 3}
    assert home_sources([3])[0].load() == make_home(3)


def test_seeds_of_a_kind() -> None:
    (hall,) = home_sources([(3, "hall")])
    assert hall == HomeSource("make_home(3, hall)", 3, "hall")
    assert hall.record == {"name": "make_home(3, hall)", "seed": 3, "kind": "hall"}
    assert hall.load() == make_home(3, "hall")
    assert home_sources([(3, None)]) == home_sources([3])


def test_folder_of_maps(maps: Path) -> None:
    found = {source.name: source.origin for source in home_sources([maps])}
    expected = {"house": "house/map.yaml", "one": "one.yaml", "scene": "scene/scene.xml", "two": "two.npz"}
    assert found == {name: str(maps / file) for name, file in expected.items()}


def test_one_map_by_file_and_by_folder(maps: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = HomeSource("house", str(maps / "house" / "map.yaml"))
    monkeypatch.chdir(maps)
    assert home_sources(["house"]) == home_sources([maps / "house" / "map.yaml"]) == [source]
    assert source.record == {"name": "house", "path": str(maps / "house" / "map.yaml")}
    assert home_sources(["picture.png"])[0].name == "picture"


@pytest.mark.parametrize("twice", [[3, 3], ["house", "house/map.yaml"]])
def test_one_name_twice(maps: Path, monkeypatch: pytest.MonkeyPatch, twice: list[int | str]) -> None:
    monkeypatch.chdir(maps)
    with pytest.raises(MapError, match=r"two homes are called '.*', .* and .*: leave one out, or rename"):
        home_sources(twice)


@pytest.mark.parametrize(
    ("homes", "message"),
    [
        ([], "homes is empty: give seeds of make_home, or paths of complete maps"),
        ([(-1, "hall")], "seed = -1 is not allowed"),
        ([(3, "castle")], "kind = 'castle' is not allowed"),
        (["empty"], r"empty' holds no map: give a folder with maps \(\.yaml, \.yml, \.npz\), or with"),
        (["nowhere"], "nowhere' is not there: give complete maps"),
        *(([home], f"home = {home} is neither a seed nor a path: give a seed") for home in (True, 1.5, None)),
    ],
)
def test_refused(maps: Path, monkeypatch: pytest.MonkeyPatch, homes: list[Any], message: str) -> None:
    monkeypatch.chdir(maps)
    with pytest.raises((MapError, SettingsError), match=message):
        home_sources(homes)
