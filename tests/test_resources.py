"""Demo scenes are found in a wheel and in the repository."""

from pathlib import Path

import pytest

from sionna_partial import resources
from sionna_partial.errors import SceneError


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(resources, "_PACKAGE", tmp_path / "package")
    return tmp_path / "package"


def add_homes(folder: Path, text: str = '{"flat": {"seed": 3, "transmitter": [1, 2, 1.5]}}') -> Path:
    folder.mkdir(parents=True)
    (folder / "homes.json").write_text(text)
    return folder


def test_scenes_of_the_package_come_before_those_of_the_repository(package: Path) -> None:
    in_repository = add_homes(package.parent / "scenes")
    assert resources.scenes_folder() == in_repository
    in_package = add_homes(package / "scenes")
    assert resources.scenes_folder() == in_package


def test_homes_have_their_transmitters(package: Path) -> None:
    add_homes(package / "scenes")
    assert resources.demo_homes() == {"flat": {"seed": 3, "transmitter": (1.0, 2.0, 1.5)}}


def test_no_scenes(package: Path) -> None:
    (package / "scenes").mkdir(parents=True)
    with pytest.raises(SceneError, match=r"demo scenes are missing in '.*scenes': install sionna-partial again\."):
        resources.scenes_folder()


@pytest.mark.parametrize("text", ["{", "[]", '{"flat": {}}', '{"flat": {"transmitter": ["x"]}}', '{"flat": 3}'])
def test_damaged_description(package: Path, text: str) -> None:
    add_homes(package / "scenes", text)
    with pytest.raises(SceneError, match=r"homes.json' cannot be read \(.*\): install sionna-partial again\."):
        resources.demo_homes()


def test_shipped_homes_are_folders() -> None:
    homes = resources.demo_homes()
    assert len(homes) >= 3
    for name in homes:
        assert (resources.scenes_folder() / name / "complete" / "scene.xml").is_file()
