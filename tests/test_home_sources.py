"""Names of homes, and where they come from."""

from pathlib import Path

import pytest

from sionna_partial.datasets.home_sources import HomeSource, home_sources
from sionna_partial.errors import MapError, SettingsError
from sionna_partial.simulation.homes import make_home


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


@pytest.mark.parametrize(("home", "name"), [((-1, "hall"), "seed = -1"), ((3, "castle"), "kind = 'castle'")])
def test_pairs_are_checked(home: tuple[int, str], name: str) -> None:
    with pytest.raises(SettingsError, match=f"{name} is not allowed"):
        home_sources([home])  # type: ignore[list-item]


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


def test_no_home() -> None:
    with pytest.raises(MapError, match="homes is empty: give seeds of make_home, or paths of complete maps"):
        home_sources([])


def test_folder_without_maps(maps: Path) -> None:
    with pytest.raises(
        MapError, match=r"empty' holds no map: give a folder with maps \(\.yaml, \.yml, \.npz\), or with"
    ):
        home_sources([maps / "empty"])


def test_path_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="nowhere' is not there: give complete maps"):
        home_sources([tmp_path / "nowhere"])


@pytest.mark.parametrize("home", [True, 1.5, None])
def test_neither_seed_nor_path(home: object) -> None:
    with pytest.raises(MapError, match=f"home = {home} is neither a seed nor a path: give a seed"):
        home_sources([home])  # type: ignore[list-item]
