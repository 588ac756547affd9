"""ROS map_server YAML and image, read as nav2_map_server reads them."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import label

from sionna_partial.constants import CellState
from sionna_partial.errors import MapError, OutputError
from sionna_partial.maps import environment
from sionna_partial.maps.environment import MapWarning, turn_grid
from sionna_partial.maps.importers.bags import map_from_occupancy
from sionna_partial.maps.map_files import load_map, save_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.maps.ros_map_writer import write_ros_map

SHEET: dict[str, Any] = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": [-1.0, 2.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}
FREE, WALL, UNKNOWN = (int(state) for state in CellState)


def write_sheet(folder: Path, *, without: str = "", **changes: object) -> Path:
    sheet = {key: value for key, value in {**SHEET, **changes}.items() if key != without}
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump(sheet))
    return path


def write_map(folder: Path, shades: object, **changes: object) -> Path:
    array = np.asarray(shades)
    suffix = ".pgm" if array.ndim == 2 and array.dtype != np.uint16 else ".png"
    array = array if array.dtype == np.uint16 else array.astype(np.uint8)
    Image.fromarray(array).save(folder / f"map{suffix}")
    return write_sheet(folder, image=f"map{suffix}", **changes)


def load_state(folder: Path, shades: object, *, strict: bool = False, **changes: object) -> list[list[int]]:
    """Read a map made of shades, turned back so that its first row is the image's top row."""
    return load_map(write_map(folder, shades, **changes), strict=strict).state[::-1].tolist()


def test_orientation_and_place(tmp_path: Path) -> None:
    partial = load_map(write_map(tmp_path, [[0, 205, 205], [254, 254, 205]]))
    assert partial.state.tolist() == [[FREE, FREE, UNKNOWN], [WALL, UNKNOWN, UNKNOWN]]
    assert partial.origin_m == (-1.0, 2.0)
    assert partial.resolution_m == 0.05
    assert partial.wall_height_m == 3.0
    assert partial.interior_cells is None
    assert partial.state_at(np.array([[-0.99, 2.01], [-0.99, 2.09]])).tolist() == [FREE, WALL]


PGMS = (
    b"P5\n3 1\n255\n\x00\xcd\xfe",
    b"P2\n# hand made\n3 1\n255\n0 # wall\n205\n# free:\n254\n",
    b"P5\n3 1\n100\n\x00\x32\x64",
    b"P5\n3 1\n65535\n\x00\x00\xcd\xcd\xff\xff",
)


@pytest.mark.parametrize("content", PGMS)
def test_every_pgm(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "map.pgm").write_bytes(content)
    assert load_map(write_sheet(tmp_path)).state.tolist() == [[WALL, UNKNOWN, FREE]]


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "I;16", "BMP"])
def test_every_image_mode(tmp_path: Path, mode: str) -> None:
    grey = Image.fromarray(np.array([[0, 150, 255]], dtype=np.uint8))
    if mode == "I;16":
        grey = Image.fromarray(np.array([[0, 150 * 257, 65535]], dtype=np.uint16))
    name = "map.bmp" if mode == "BMP" else "map.png"
    (grey if mode in ("I;16", "BMP") else grey.convert(mode)).save(tmp_path / name)
    state = load_map(write_sheet(tmp_path, image=name)).state.tolist()
    assert state == [[WALL, FREE if mode == "1" else UNKNOWN, FREE]]


BLACK, WHITE, CLEAR = [0, 0, 0, 255], [255] * 4, [255, 255, 255, 0]


@pytest.mark.parametrize(
    ("pixels", "options", "states"),
    [
        # Colours are averaged; occupancy > occupied_thresh is wall, < free_thresh free (negated 51 and 204: 0.2, 0.8).
        ([[255, 0, 0], [255, 255, 250], [20, 10, 30], [0, 255, 255]], {}, [WALL, FREE, WALL, UNKNOWN]),
        ([50, 51, 52, 203, 204, 205], {"free_thresh": 0.2, "occupied_thresh": 0.8, "negate": 1}, [0, 2, 2, 2, 2, 1]),
        # Raw pixels are percent of occupancy; above 100 they are unknown; negate is ignored.
        *(([0, 19, 20, 21, 64, 65, 100, 101], {"mode": "raw", "negate": k}, [0, 0, 0, 2, 2, 1, 1, 2]) for k in (0, 1)),
        # Alpha is a fourth channel in trinary mode: opaque grey 60 has the mean (180 + 255) / 4, transparent white 3/4.
        ([BLACK, [60, 60, 60, 255], WHITE, CLEAR], {}, [WALL, UNKNOWN, FREE, UNKNOWN]),
        ([[60, 60, 60, 255], WHITE, [0, 0, 0, 254], CLEAR], {"mode": "Scale"}, [WALL, FREE, UNKNOWN, UNKNOWN]),
        ([0, 128, 205, 254], {"free_thresh": 0.25}, [WALL, UNKNOWN, FREE, FREE]),  # more would be unknown otherwise
    ],
)
def test_pixels_are_read_as_by_nav2(tmp_path: Path, pixels: Any, options: dict[str, Any], states: list[int]) -> None:
    assert load_state(tmp_path, [pixels], **options) == [states]


def test_transparent_is_unknown(tmp_path: Path) -> None:
    pixels = [[[0, 0, 0, 0], [255, 255, 255, 255], [0, 0, 0, 255], [0, 0, 0, 0]]]
    with pytest.warns(MapWarning, match="2 transparent cells would read as free or wall; they are kept unknown"):
        assert load_state(tmp_path, pixels) == [[UNKNOWN, FREE, WALL, UNKNOWN]]
    assert load_state(tmp_path, pixels, strict=True) == [[WALL, FREE, WALL, WALL]]


@pytest.mark.parametrize("colour", ["grey", "grey, 16 bit", "RGB", "RGBA, negated"])
def test_205_stays_unknown(tmp_path: Path, colour: str) -> None:
    shades = np.array([[0, 254, 205], [205, 205, 254]])
    state = [[WALL, FREE, UNKNOWN], [UNKNOWN, UNKNOWN, FREE]]
    negate = "negated" in colour
    pixels = 255 - shades if negate else shades
    if "16 bit" in colour:
        pixels = (pixels * 257).astype(np.uint16)
    if "RGB" in colour:
        opaque = np.full(shades.shape, 255)
        pixels = np.stack([pixels] * 3 + [opaque] * ("RGBA" in colour), axis=-1)
    thresholds = {"free_thresh": 0.55, "occupied_thresh": 0.9} if colour == "RGBA, negated" else {"free_thresh": 0.25}
    shade = 50 if negate else 205
    with pytest.warns(MapWarning, match=rf"3 cells of shade {shade} would read as free") as caught:
        read = load_state(tmp_path, pixels, negate=int(negate), **thresholds)
    assert (read, caught[0].filename) == (state, __file__)
    letter = load_state(tmp_path, pixels, negate=int(negate), strict=True, **thresholds)
    assert letter == [[WALL, FREE, FREE], [FREE, FREE, FREE]]


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_205_of_reports(mode: str) -> None:
    """A free_thresh of 0.25 makes 4,400 unknown cells around a room free; 205 in mode raw is above 100 percent."""
    path = Path(__file__).parent / "reports" / "shade_205" / f"{mode}.yaml"
    message = "and no wall, so that" if mode == "raw" else "4400 cells of shade 205 would read as free"
    with pytest.warns(MapWarning, match=message):
        partial = load_map(path)
    free, unknown = {"raw": (396, 13604)}.get(mode, (9204, 4400))
    assert np.bincount(partial.state.ravel(), minlength=3)[[FREE, UNKNOWN]].tolist() == [free, unknown]
    if mode != "raw":
        assert (load_map(path, strict=True).state == FREE).sum() == 13604


def test_dark_grey_walls(tmp_path: Path) -> None:
    shades = np.repeat(np.array([[90, 90, 254], [0, 205, 254]], dtype=np.uint8), 60, axis=0)
    path = write_map(tmp_path, 255 - shades, negate=1)
    message = r"120 dark grey cells \(occupancy from 0\.65\) are read as unknown: if they are walls, set occupied_thr"
    with pytest.warns(MapWarning, match=message):
        assert load_map(path).state[[0, -1]].tolist() == [[WALL, UNKNOWN, FREE], [UNKNOWN, UNKNOWN, FREE]]
    assert load_state(tmp_path, [[90, 127, 127, 0]] * 150)[0] == [UNKNOWN, UNKNOWN, UNKNOWN, WALL]


def test_inflated_costmap(tmp_path: Path) -> None:
    shades = np.full((80, 80), 254)
    shades[20:60, 20:60] = 120
    shades[22:58, 22:58] = 0
    with pytest.warns(MapWarning, match=r"between 100% of the walls and the free cells, as in an inflated costmap"):
        load_map(write_map(tmp_path, shades, mode="scale"))
    shades[20:60, 20:22] = 254
    load_map(write_map(tmp_path, shades, mode="scale"))


def test_numbers_as_people_write_them(tmp_path: Path) -> None:
    """YAML 1.1 takes 5e-2 for a text; yaml-cpp, and so ROS, for a number. `negate: no` is a boolean."""
    path = write_map(tmp_path, [[0, 205, 254]])
    path.write_text(
        "image: map.pgm\nmode: trinary\nresolution: 5e-2\norigin: [1, 2.5e+0, 0]\nnegate: no\n"
        "occupied_thresh: .65\nfree_thresh: 0.196\nother: [1, {a: b}]\nwall_height: 2\ninterior_cells: 7\n"
    )
    partial = load_map(path)
    assert (partial.resolution_m, partial.origin_m) == (0.05, (1.0, 2.5))
    assert (partial.wall_height_m, partial.interior_cells) == (2.0, 7)
    assert load_map(path, wall_height_m=2.4).wall_height_m == 2.4


def test_missing_keys(tmp_path: Path) -> None:
    (tmp_path / "map.pgm").write_bytes(PGMS[0])
    for key in SHEET:
        with pytest.raises(MapError, match=f"map.yaml: {key} is missing: add it"):
            load_map(write_sheet(tmp_path, without=key))


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        ("resolution", (0, 50, 10**400, math.nan, "fine", None, True, [0.05]), r"a number of metres per cell"),
        ("occupied_thresh", (-0.1, 65, "high"), r"give a number in \[0, 1\]"),
        ("free_thresh", (-0.1, 19.6, "low"), r"give a number in \[0, 1\]"),
        ("free_thresh", (0.65, 0.9), "give less than occupied_thresh, which is 0.65"),
        ("origin", ([0, 0], [0] * 4, [0, math.nan, 0], [0, 0, "north"], 7, None, "0, 0"), r"give \[x, y, yaw\] of the"),
        ("origin", ([0, 0, 90],), r"the yaw in radians, one turn at most \(not degrees\)"),
        ("negate", (2, -1, 0.0, "maybe", None), "give 0 .dark is wall. or 1 .bright is wall."),
        ("mode", ("ternary", 3, None), "choose one of trinary, scale, raw"),
        ("image", ("", None, 3, ["map.pgm"], "a\0b", "a\ud800b"), "give the file name of the map image"),
        ("image", ("gone.pgm", ".", "a" * 300, "loop"), "there is no file '.*'; put the image there"),
        ("wall_height", (0, -3, math.nan, "tall"), r"give a number of metres in \[0.1, 100\]"),
        ("material", (3, {"color": "red"}, {"relative_permittivity": 0.5}), "give a name, or relative_perm.*itu"),
        ("interior_cells", (-1, 2.5, "many", True), "give the number of free cells"),
    ],
)
def test_wrong_value(tmp_path: Path, key: str, values: tuple[object, ...], message: str) -> None:
    (tmp_path / "map.pgm").write_bytes(PGMS[0])
    (tmp_path / "loop").symlink_to("loop")
    for value in values:
        path = write_sheet(tmp_path, **{key: value})
        with pytest.raises(MapError, match=f"{re.escape(str(path))}: {key} = .* is not allowed: .*{message}"):
            load_map(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "holds None in place of keys such as image, resolution and origin"),
        (b"P5\n3 1\n255\n\x00\xcd\xfe", "is not valid YAML"),
        (b"image: a.pgm\nimage: b.pgm", r"is not valid YAML \(it has the key 'image' twice\)"),
        (b"a: 2020-99-99", r"is not valid YAML \(month must be"),
        (b"[" * 2000, "is not valid YAML"),
        (b"a: !!python/object/apply:os.system ['true']", "is not valid YAML"),
        (b"#" * 1_000_001, "has more than 1,000,000 bytes: give the YAML of a ROS map"),
    ],
)
def test_damaged_yaml(tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "map.yaml"
    path.write_bytes(text)
    with pytest.raises(MapError, match=f"path = '{re.escape(str(path))}' {message}"):
        load_map(path)


def test_yaml_bomb_stays_short(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
    (tmp_path / "map.yaml").write_text("\n".join([*lines, "occupied_thresh: *a11"]))
    with pytest.raises(MapError, match=r"occupied_thresh = .* is not allowed") as caught:
        load_map(tmp_path / "map.yaml")
    assert len(str(caught.value)) < 1000


NO_IMAGE, TOO_MANY = "it is damaged or not a PGM, PNG or BMP", "it has more than 100,000,000 cells; cut the map to the"


@pytest.mark.parametrize(
    ("message", "content"),
    [
        *((NO_IMAGE, b"P5" + end) for end in (b"\n3 1\n255\n\x00\xcd", b"\nthree 1\n255\n\x00\xcd\xfe")),
        *((NO_IMAGE, content) for content in (b"", b"GIF89a\x01\x00\x01\x00\x00\x00\x00;", b"\x89PNG\r\n\x1a\nIHDR")),
        *((TOO_MANY, b"P5\n%d %d\n255\n" % size) for size in ((10_001, 10_000), (2**30, 2**30))),
        ("it holds floating-point shades; save a PGM or PNG", b"Pf\n1 1\n-1.0\n\x00\x00\x80\x3f"),
    ],
)
def test_damaged_image(tmp_path: Path, message: str, content: bytes) -> None:
    (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(MapError, match=rf"image = '.*map\.pgm' is not allowed: {message}"):
        load_map(write_sheet(tmp_path))


def test_interior_cells_follow_the_cell_size(tmp_path: Path) -> None:
    partial = load_map(write_map(tmp_path, np.full((9, 9), 254), origin=[0, 0, 0.5], interior_cells=81))
    assert (partial.resolution_m, partial.interior_cells) == (0.025, 324)


PARTIAL = PartialMap(np.array([[0, 1, 2], [2, 1, 0]]), 0.1, (1 / 3, -2e5 - 0.1), 2.4, 17)


def test_written_map_to_the_letter(tmp_path: Path) -> None:
    save_map(PARTIAL, tmp_path / "home.yaml", extra={"scene_offset": [1.5, 2.0]})
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["home.pgm", "home.yaml"]
    assert (tmp_path / "home.pgm").read_bytes() == b"P5\n3 2\n255\n" + bytes([205, 0, 254, 254, 0, 205])
    assert yaml.safe_load((tmp_path / "home.yaml").read_text()) == {
        "image": "home.pgm",
        "mode": "trinary",
        "resolution": 0.1,
        "origin": [1 / 3, -2e5 - 0.1, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
        "wall_height": 2.4,
        "interior_cells": 17,
        "scene_offset": [1.5, 2.0],
    }
    for strict in (False, True):
        assert load_map(tmp_path / "home.yaml", strict=strict) == PARTIAL


def test_further_keys(tmp_path: Path) -> None:
    partial, extra = PartialMap([[0, 1]], 0.5), {"score": np.float32(1.5), "steps": np.int64(3), "path": np.eye(2)}
    write_ros_map(partial, tmp_path / "map.yaml", extra)
    sheet = yaml.safe_load((tmp_path / "map.yaml").read_text())
    assert (sheet["score"], sheet["steps"], sheet["path"]) == (1.5, 3, [[1, 0], [0, 1]])
    refused: list[tuple[object, str]] = [
        ({"resolution": 0.5}, "holds 'resolution', which the map sets itself: give a mapping of further keys"),
        ({3: 4}, "extra = {3: 4} has keys that are no text: give a mapping"),
        (5, "extra = 5 has keys that are no text: give a mapping"),
        ({"a": object()}, r"extra cannot be written as YAML \(.*\): give numbers, texts, lists and mappings"),
        ({"a": "x" * 1_000_000}, "extra makes a YAML of .* bytes, more than 1,000,000: leave large values out"),
    ]
    for further, message in refused:
        with pytest.raises(OutputError, match=message):
            write_ros_map(partial, tmp_path / "other.yaml", further)  # type: ignore[arg-type]
    assert not (tmp_path / "other.yaml").exists()


@pytest.mark.parametrize("blocked", ["home.yaml", "home.pgm"])
def test_neither_file_without_the_other(tmp_path: Path, blocked: str) -> None:
    (tmp_path / blocked).mkdir()
    with pytest.raises(OutputError, match=f"{blocked}' could not be written"):
        save_map(PARTIAL, tmp_path / "home.yaml")
    assert [entry.name for entry in tmp_path.iterdir()] == [blocked]


grids = arrays(np.uint8, array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.integers(0, 2))


@settings(max_examples=50)
@given(grids, st.integers(-4, 4))
def test_quarter_turns_move_every_cell_by_the_rotation(state: np.ndarray, turns: int) -> None:
    yaw = turns * math.pi / 2
    partial = PartialMap(*turn_grid(state, 1.0, (3.0, -2.0, yaw)))
    v, u = np.mgrid[: state.shape[0], : state.shape[1]] + 0.5
    x = 3.0 + math.cos(yaw) * u - math.sin(yaw) * v
    y = -2.0 + math.sin(yaw) * u + math.cos(yaw) * v
    assert np.array_equal(partial.state_at(np.stack([x, y], axis=-1)), state)


@settings(max_examples=50)
@given(grids, st.floats(-6.28, 6.28))
def test_any_turn_keeps_the_state_of_places(state: np.ndarray, yaw: float) -> None:
    """New cells have the state of the old grid at their centre; only a free one may have become wall."""
    new, cell, (x0, y0) = turn_grid(state, 1.0, (3.0, -2.0, yaw))
    if cell == 1.0:
        return
    row, column = np.mgrid[: new.shape[0], : new.shape[1]]
    x, y = x0 + (column + 0.5) * cell - 3.0, y0 + (row + 0.5) * cell + 2.0
    back = np.stack([math.cos(yaw) * x + math.sin(yaw) * y, math.cos(yaw) * y - math.sin(yaw) * x], axis=-1)
    fraction = np.abs(back - np.rint(back)).min(axis=-1)
    clear = fraction > 1e-6
    differs = clear & (new != PartialMap(state, 1.0).state_at(back))
    assert (new[differs] == WALL).all()
    assert (PartialMap(state, 1.0).state_at(back)[differs] == FREE).all()
    assert cell == 0.5


def room(ny: int, nx: int) -> np.ndarray:
    state = np.full((ny + 4, nx + 4), UNKNOWN, dtype=np.uint8)
    state[1:-1, 1:-1] = WALL
    state[2:-2, 2:-2] = FREE
    return state


@given(st.integers(1, 12), st.integers(1, 12), st.floats(-6.28, 6.28), st.booleans())
def test_closed_rooms_stay_closed(ny: int, nx: int, yaw: float, corners: bool) -> None:
    state = room(ny, nx)
    if not corners:
        for row in (1, -2):
            state[row, [1, -2]] = UNKNOWN
    new, resolution_m, origin_m = turn_grid(state, 0.1, (0.0, 0.0, yaw))
    assert PartialMap(new, resolution_m, origin_m).is_complete
    assert label(new != WALL, np.ones((3, 3)))[1] == 2 or not corners
    state[1, 2] = FREE
    assert not PartialMap(turn_grid(state, 0.1, (0.0, 0.0, yaw))[0], resolution_m).is_complete


def test_small_tilt_is_below_the_resolution(caplog: pytest.LogCaptureFixture) -> None:
    state = room(96, 96)
    limit = 0.5 / math.hypot(100, 100)
    assert turn_grid(state, 0.1, (0.0, 0.0, 0.99 * limit))[1] == 0.1
    assert not caplog.text
    assert turn_grid(state, 0.1, (0.0, 0.0, 1.01 * limit))[1] == 0.05
    assert "rad: the map is turned onto cells of 0.05 m" in caplog.text


def test_too_many_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "MAX_CELLS", 30)
    with pytest.raises(MapError, match=r"origin = \[0.0, 1.0, 0.5\] has a yaw for which the map needs 7 x 8 cells,"):
        turn_grid(PARTIAL.state, 0.1, (0.0, 1.0, 0.5))


REPORTS = Path(__file__).parent / "reports"


def levels(*parts: tuple[int, int, int]) -> NDArray[np.int64]:
    values = np.concatenate([np.repeat(np.arange(low, high + 1), count) for low, high, count in parts])
    size = math.ceil(math.sqrt(len(values)))
    return np.append(values, np.full(size**2 - len(values), -1)).reshape(size, size)


class TestContinuousValues:
    def test_thresholds_fit_the_map(self) -> None:
        path = REPORTS / "continuous_occupancy" / "carto.yaml"
        with pytest.warns(MapWarning, match=r"95% of the seen cells have an occupancy between 19.6 and 65 %"):
            partial = load_map(path)
        assert np.bincount(partial.state.ravel()).tolist() == [26_480, 1_520, 15_200]
        assert "26,543 of 28,000 seen cells have an occupancy between" in str(partial.import_report)
        shade = np.asarray(Image.open(path.with_suffix(".pgm")))[::-1]
        percent = np.where(shade == 128, -1, np.rint(100 * (1 - shade / 255))).astype(np.int8)
        with pytest.warns(MapWarning, match=r"walls are the cells from 54.0 % on, and other seen cells are free"):
            assert np.array_equal(map_from_occupancy(percent, 0.05).state, partial.state)
        given = map_from_occupancy(percent, 0.05, free_percent=25)
        assert np.bincount(given.state.ravel()).tolist() == [2_854, 1_457, 38_889]
        assert "skipped    seen cells: 23,689 (an occupancy between 25 and 65 %: unknown)" in str(given.import_report)
        with pytest.warns(MapWarning, match="1,457 wall cells and 0 free ones"):
            load_map(path, strict=True)

    @pytest.mark.parametrize(
        ("parts", "free", "wall"),
        [
            ([(10, 40, 400), (70, 95, 30)], 31 * 400, 26 * 30),
            ([(30, 45, 900), (60, 80, 9)], 16 * 900, 21 * 9),
        ],
    )
    def test_valleys(self, parts: list[tuple[int, int, int]], free: int, wall: int) -> None:
        with pytest.warns(MapWarning, match="as in a map of probabilities"):
            partial = map_from_occupancy(levels(*parts), 0.05)
        assert np.bincount(partial.state.ravel(), minlength=2)[:2].tolist() == [free, wall]

    @pytest.mark.parametrize("parts", [[(20, 60, 100)], [(28, 48, 500)], [(50, 99, 100)]])
    def test_values_that_are_not_separate(self, parts: list[tuple[int, int, int]]) -> None:
        message = "seen cells have an occupancy between 25 and 65 % and are read as unknown. Give free_percent"
        with pytest.warns(MapWarning, match=message):
            partial = map_from_occupancy(levels(*parts), 0.05)
        assert partial.import_report is not None
        percent = levels(*parts)
        assert partial.import_report.skipped[0].count == ((percent > 25) & (percent < 65)).sum()

    @pytest.mark.parametrize(
        "parts", [[(0, 0, 5000), (50, 50, 3000), (100, 100, 500)], [(0, 0, 5000), (26, 64, 20), (99, 100, 500)]]
    )
    def test_other_maps_keep_the_standard_thresholds(self, parts: list[tuple[int, int, int]]) -> None:
        percent = levels(*parts)
        standard = map_from_occupancy(percent, 0.05, free_percent=25, occupied_percent=65)
        assert np.array_equal(map_from_occupancy(percent, 0.05).state, standard.state)
