"""Maps from and to files, arrays, simulators and SLAM."""

import io
import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from meshes import OBSERVED, room, surface_m2
from small_maps import HOUSE

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError, OutputError, SettingsError
from sionna_partial.maps import map_files
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.importers.bags import map_from_occupancy
from sionna_partial.maps.importers.simulators import map_from_habitat, map_from_slam
from sionna_partial.maps.map_files import load_map, save_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import Material

FREE, WALL, UNKNOWN = (int(state) for state in CellState)

states = arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 2))
partials = st.builds(
    PartialMap,
    states,
    st.floats(1e-3, 10.0),
    st.tuples(st.floats(-1e8, 1e8), st.floats(-1e8, 1e8)),
    st.floats(0.1, 100.0),
    st.none() | st.integers(0, 10**9),
    material=st.sampled_from([None, Material(np.float32(5.31), np.float64(0.1), 1), Material(itu="brick")]),
)
SMALL = PartialMap(np.array([[0, 1], [2, 0]]), 0.05, (1.5, -2.0), 2.5, 3)


@pytest.mark.parametrize("suffix", [".yml", ".NPZ"])
@settings(max_examples=40)
@given(partial=partials)
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, suffix: str, partial: PartialMap) -> None:
    folder = tmp_path_factory.mktemp("map")
    save_map(partial, folder / f"home{suffix}")
    assert load_map(folder / f"home{suffix}") == partial
    assert load_map(f"{folder}/home{suffix}", wall_height_m=4.0) == replace(partial, wall_height_m=4.0)
    assert len(list(folder.iterdir())) == (1 if "NPZ" in suffix.upper() else 2)


def test_what_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"partial is of type ndarray: give a PartialMap, such as load_map returns\."):
        save_map(SMALL.state, tmp_path / "home.npz")  # type: ignore[arg-type]
    with pytest.raises(OutputError, match=r"home.pgm' has the suffix '.pgm': choose .yaml, .yml or .npz"):
        save_map(SMALL, tmp_path / "home.pgm")
    message = r"extra = {'score': 1} cannot be held by '.*home\.npz': leave it out, or choose \.yaml\."
    with pytest.raises(OutputError, match=message):
        save_map(SMALL, tmp_path / "home.npz", extra={"score": 1})
    assert list(tmp_path.iterdir()) == []


def export(folder: Path, image: str = "map.pgm") -> Path:
    save_map(SMALL, folder / "map.yaml", extra={"scene_offset": [1.0, 2.0]})
    (folder / "scene.xml").write_text("<scene/>")
    sheet = yaml.safe_load((folder / "map.yaml").read_text())
    (folder / "map.yaml").write_text(yaml.safe_dump({**sheet, "image": image}))
    return folder


def test_scene_folder(tmp_path: Path) -> None:
    folder = export(tmp_path / "scene")
    assert load_map(folder) == load_map(folder / "scene.xml") == load_map(folder / "map.yaml") == SMALL
    assert load_map(folder, wall_height_m=4.0).wall_height_m == 4.0


NOT_THERE = r"is not (there|a path): give a ROS map YAML \(.yaml, .yml\), a map written by"
OUTSIDE = "is not allowed: the image of an exported scene lies in"


def link_to_the_outside(folder: Path) -> None:
    (folder / "map.pgm").rename(folder.parent / "outside.pgm")
    (folder / "map.pgm").symlink_to(folder.parent / "outside.pgm")


@pytest.mark.parametrize(
    ("spoil", "name", "message"),
    [
        *(
            (lambda folder, image=image: export(folder, image), "", f"image = '{image}' {OUTSIDE}")
            for image in ("../map.pgm", "/etc/map.pgm")
        ),
        (link_to_the_outside, "", rf"image = 'map\.pgm' {OUTSIDE}"),
        (lambda folder: (folder / "scene.xml").unlink(), "", "is no scene: it has 0 .xml files; give the path of one"),
        (lambda folder: (folder / "map.yaml").unlink(), "", "scene.xml' holds no shape: give a Mitsuba scene with"),
        *(
            (lambda folder: None, f"sub/{name}", NOT_THERE)
            for name in ("gone.yaml", "gone.npz", "gone", "a" * 300, "a\0b", "")
        ),
        *(
            (lambda folder, name=name: (folder / name).write_bytes(b"P5\n1 1\n255\n\x00"), name, message)
            for name, message in (
                ("map.png", r"is a bare image without resolution and origin: give its YAML, .*map.yaml'"),
                ("map.dae", r"map\.dae' is of no known kind: give a ROS map YAML"),
                ("coverage.nc", "is a coverage, no map: give the map that it was computed from"),
            )
        ),
    ],
)
def test_refused(tmp_path: Path, spoil: Callable[[Path], object], name: str, message: str) -> None:
    spoil(export(tmp_path / "scene"))
    with pytest.raises(MapError, match=message):
        load_map(f"{tmp_path}/scene/{name}")


@pytest.fixture
def room_file(tmp_path: Path) -> Path:
    path = tmp_path / "room.ply"
    room().to_mesh().export(path)
    return path


def test_mesh_file(room_file: Path) -> None:
    partial = load_map(room_file)
    assert partial.mesh is not None
    assert (len(partial.mesh.triangles), partial.origin_m) == (24, (-0.05, -0.05))
    assert (partial.height_range_m, partial.wall_height_m) == ((0.0, 3.0), 3.0)
    assert load_map(room_file, wall_height_m=9.0).height_range_m == (0.0, 9.0)
    part = load_map(room_file, observed=OBSERVED[:3], resolution_m=0.1, height_band_m=(0.2, 2.9), up="z")
    assert part.mesh is not None
    assert surface_m2(part.mesh) < surface_m2(partial.mesh)
    assert load_map(room_file, observed=part, resolution_m=0.1, height_band_m=(0.2, 2.9)) == part
    assert load_map(room_file, up="y").height_range_m == (0.0, 4.0)


def test_mesh_in_npz(tmp_path: Path, room_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for partial in (load_map(room_file), load_map(room_file, observed=OBSERVED[:3], wall_height_m=8.0)):
        save_map(partial, tmp_path / "home.npz")
        assert load_map(tmp_path / "home.npz") == partial
    assert load_map(tmp_path / "home.npz", wall_height_m=4.0).height_range_m == (0.0, 4.0)
    with pytest.raises(OutputError, match=r"home.yaml' cannot hold the map's mesh: choose .npz, or use export_scene"):
        save_map(partial, tmp_path / "home.yaml")
    monkeypatch.setattr(map_files, "_MESH_BYTES", 500)
    with pytest.raises(MapError, match=r"home.npz' holds more than 5,000,000 triangles: cut or simplify the mesh"):
        load_map(tmp_path / "home.npz")
    monkeypatch.undo()
    with np.load(tmp_path / "home.npz") as content:
        arrays = {key: content[key] for key in content if key != "mesh_vertices_m"}
    (tmp_path / "home.npz").write_bytes(npz_bytes(**arrays))
    with pytest.raises(MapError, match=r"home.npz' is damaged or was not written by save_map"):
        load_map(tmp_path / "home.npz")


def test_arguments_for_meshes_alone(tmp_path: Path) -> None:
    save_map(SMALL, tmp_path / "home.npz")
    folder = export(tmp_path / "scene")
    with pytest.raises(MapError, match=r"resolution_m is for scans, .* alone, but path = '.*home.npz' is none: leave"):
        load_map(tmp_path / "home.npz", resolution_m=0.1)
    with pytest.raises(SettingsError, match="strict = 1 is not allowed: give True or False"):
        load_map(folder, strict=1)  # type: ignore[arg-type]
    with pytest.raises(MapError, match=r"up is for scans alone, but path = '.*' is an exported map \(remove its"):
        load_map(folder, up="z")


def npz_bytes(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


WHOLE = {"state": SMALL.state, "resolution_m": 0.05, "origin_m": (0.0, 0.0), "wall_height_m": 3.0}


DAMAGED = "is damaged or was not written by save_map"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *((content, DAMAGED) for content in (b"", npz_bytes(**WHOLE)[:-30], npz_bytes(state=SMALL.state))),
        (npz_bytes(**WHOLE | {"state": np.array([[None]])}), DAMAGED),
        (npz_bytes(**WHOLE | {"material": "brick"}), DAMAGED),
        (npz_bytes(**WHOLE | {"resolution_m": 50.0}), "resolution_m = 50.0 is not allowed"),
    ],
)
def test_damaged_npz(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "home.npz"
    path.write_bytes(content)
    with pytest.raises(MapError, match=re.escape(message)):
        load_map(path)


def test_npz_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_files, "MAX_CELLS", 5000)
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("must not be unpacked"))
    (tmp_path / "home.npz").write_bytes(npz_bytes(**{**WHOLE, "state": np.zeros((100, 100), np.uint8)}))
    with pytest.raises(MapError, match="holds more than 5,000 cells: cut the map or coarsen it"):
        load_map(tmp_path / "home.npz")


def test_npz_with_a_lying_header(tmp_path: Path) -> None:
    """A header of 10^12 cells over a few bytes ends in an error, not in the memory."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (10**6, 10**6)})
    whole, lying = io.BytesIO(npz_bytes(**WHOLE)), tmp_path / "home.npz"
    with zipfile.ZipFile(whole) as source, zipfile.ZipFile(lying, "w") as target:
        for name in source.namelist():
            target.writestr(name, header.getvalue() if name == "state.npy" else source.read(name))
    with pytest.raises(MapError, match="is damaged"):
        load_map(lying)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (np.zeros((40, 30)), r"home.npz' has 1,200 free cells and no wall, so that nothing obstructs or reflects"),
        (np.eye(40) == 0, r"home.npz' has 1,560 wall cells and 40 free ones, as if inverted: look at its states"),
    ],
)
def test_odd_states(tmp_path: Path, state: np.ndarray, message: str) -> None:
    save_map(PartialMap(state.astype(int), 0.1), tmp_path / "home.npz")
    with pytest.warns(MapWarning, match=message):
        load_map(tmp_path / "home.npz")


def test_occupancy_grid() -> None:
    data = [[-1, 0, 25], [26, 64, 65], [100, 50, 255]]
    partial = map_from_occupancy(data, 0.1, origin_m=(1.0, 2.0))
    assert partial.state.tolist() == [[2, 0, 0], [2, 2, 1], [1, 2, 2]]
    assert partial.origin_m == (1.0, 2.0)
    tight = map_from_occupancy(np.array(data, np.int16), 0.1, occupied_percent=50, free_percent=0)
    assert tight.state.tolist() == [[2, 0, 2], [2, 1, 1], [1, 1, 2]]


@pytest.mark.parametrize(
    ("top_down", "seen", "state"),
    [
        # Row 0 is the largest y; revealed border is wall; nothing else that is hidden is known.
        (["0222", "0211", "0022"], ["0110", "0110", "0010"], ["2112", "2102", "2212"]),
        # Habitat reveals no cell that is not navigable: those beside a revealed navigable one ended the view.
        (["0000", "0111", "0001"], ["0000", "0110", "0000"], ["2112", "1002", "2112"]),
        # Start 4, path 7, view point 8 are navigable; a target 6 or box 9 may cover anything.
        (["4678935"], ["1111111"], ["0200200"]),
    ],
)
def test_habitat(top_down: list[str], seen: list[str], state: list[str]) -> None:
    cells, revealed, expected = (np.array([[*map(int, row)] for row in rows]) for rows in (top_down, seen, state))
    partial = map_from_habitat(cells, revealed, 0.1, origin_m=(-1.0, 4.0))
    assert np.flipud(partial.state).tolist() == expected.tolist()
    assert partial.origin_m == (-1.0, 4.0)


def test_slam_channels() -> None:
    obstacle, explored = [[0.0, 0.9, 0.9], [0.5, 0.49, 0.0]], [[1.0, 1.0, 0.2], [0.5, 0.6, 0.49]]
    partial = map_from_slam(obstacle, explored, 0.05, origin_m=(-1.0, -2.0), wall_height_m=2.0)
    assert partial == PartialMap(np.array([[0, 1, 2], [1, 0, 2]]), 0.05, (-1.0, -2.0), 2.0)
    assert map_from_slam(obstacle, explored, 0.05, threshold=0.95).state.tolist() == [[0, 0, 2], [2, 2, 2]]
    booleans = map_from_slam([[True, True, False]], [[True, False, True]], 0.05)
    assert booleans.state.tolist() == [[WALL, UNKNOWN, FREE]]


@pytest.mark.parametrize(
    ("kind", "arrays", "options", "message"),
    [
        ("array", ([[np.nan]],), {}, "array has dtype float64: give integers"),
        ("array", ([[-1, 0, 100]],), {}, "UNKNOWN 2, or map_from_occupancy for -1 to 100 percent."),
        ("occupancy", ([[0, 101]],), {}, "data holds 101: give -1 for unknown, or the occupancy in percent, 0 to 100"),
        ("occupancy", ([[0]],), {"free_percent": 65}, "free_percent = 65 and occupied_percent = 65 are not allowed"),
        ("occupancy", ([[0]],), {"occupied_percent": 0.65, "free_percent": 0.25}, "such as 25 and 65"),
        ("habitat", ([[0, 1]], [[1]]), {}, "fog_of_war has shape (1, 1) and top_down (1, 2): give arrays of one shape"),
        ("habitat", ([[1, -1]], [[1, 1]]), {}, "top_down holds values -1 to 1: give Habitat's map, 0 to 255"),
        ("slam", ([[np.nan]], [[1]]), {}, "obstacle holds values outside [0, 1] (or NaN): give probabilities or"),
        ("slam", ([[0]], [[1]]), {"threshold": 0.0}, "threshold = 0.0 is not allowed: give a number in (0, 1]"),
    ],
)
def test_wrong_arrays(kind: str, arrays: tuple[object, ...], options: dict[str, float], message: str) -> None:
    with pytest.raises(MapError, match=re.escape(message)):
        getattr(sp if kind == "array" else sp.importers, f"map_from_{kind}")(*arrays, 0.05, **options)


def test_map_of_a_robot_comes_back(tmp_path: Path) -> None:
    partial = load_map(HOUSE)
    assert partial == load_map(HOUSE, strict=True)
    save_map(partial, tmp_path / "copy.yaml")
    assert load_map(tmp_path / "copy.yaml") == partial
    assert np.bincount(partial.state.ravel()).tolist() == [20_661, 5_813, 80_206]
