"""Maps of vacuum robots, and the received powers that they recorded."""

import base64
import copy
import logging
import re
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from small_maps import VACUUM
from vacuum_files import LEFT, PIXEL_CM, ROOMS, SIZE_CM, TOP, recording, valetudo_map, write_json, write_recording

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError, MeasurementError


@pytest.mark.parametrize("compressed", [True, False])
def test_map_of_a_robot(tmp_path: Path, compressed: bool) -> None:
    partial = sp.load_map(write_json(tmp_path / "home.json", valetudo_map(compressed=compressed)))
    marks = np.array([[*row] for row in ROOMS.split()])[::-1]  # y of the file points down
    np.testing.assert_array_equal(partial.state, np.where(marks == "#", CellState.WALL, CellState.FREE))
    assert partial.room is not None
    assert partial.room_names == ("bedroom", "kitchen")
    np.testing.assert_array_equal(partial.room, 1 * (marks == "b") + 2 * (marks == "k"))
    assert partial.resolution_m == PIXEL_CM / 100
    bottom_cm = SIZE_CM - PIXEL_CM * (TOP + len(marks))
    assert partial.bounds_m == pytest.approx((PIXEL_CM * LEFT / 100, bottom_cm / 100, 12.0, bottom_cm / 100 + 3.5))
    assert "no_go_area: 1 (no part" in str(partial.import_report)
    assert "charger at (5.75, 9.25) m" in str(partial.import_report)
    assert partial.state_at(np.array([5.75, 9.25])) == CellState.FREE


@pytest.mark.parametrize("name", ["home.yaml", "home.npz"])
def test_rooms_come_back(tmp_path: Path, name: str) -> None:
    partial = sp.load_map(write_json(tmp_path / "home.json", valetudo_map()))
    sp.save_map(partial, tmp_path / name)
    assert sp.load_map(tmp_path / name) == partial


def test_unknown_cells_and_layers(tmp_path: Path) -> None:
    content = valetudo_map("kkk\n.#k")
    content["layers"] += [{"type": "wall", "pixels": [LEFT, TOP]}, {"type": "wall"}]
    partial = sp.load_map(write_json(tmp_path / "home.json", content))
    free, wall, unknown = CellState
    assert partial.state.tolist() == [[unknown, wall, free], [wall, free, free]]
    assert "unknown: 1 (no floor, segment or wall)" in str(partial.import_report)


def test_map_of_an_apartment() -> None:
    partial = sp.load_map(VACUUM)
    assert partial.import_report is not None
    assert partial.import_report.extent_m == pytest.approx((8.6, 8.05))
    assert (partial.state == CellState.FREE).sum() == 11220


def with_layer(**changes: Any) -> dict[str, Any]:
    return valetudo_map() | {"layers": [*valetudo_map()["layers"], {"type": "floor", **changes}]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1], "path = '*' holds no ValetudoMap: give a map in the JSON of Valetudo"),
        (valetudo_map() | {"pixelSize": 0}, "pixelSize = 0 is not allowed: give a length in centimetres."),
        (valetudo_map() | {"size": None}, "size.y = None is not allowed: give a length in centimetres."),
        (valetudo_map() | {"layers": None}, "layers = None is not allowed: give a map in the JSON of Valetudo"),
        (valetudo_map() | {"layers": []}, "layers has no pixels of a floor or a segment (none): let the robot map"),
        (valetudo_map() | {"layers": [7]}, "layers[0] = 7 is not allowed: give a layer with a type, as Valetudo"),
        (with_layer(pixels=[1, 2, 3]), "layers[4].pixels has shape (3,): give whole numbers from 0 to"),
        (with_layer(pixels=[-1, 2]), "layers[4].pixels has values from -1 to 2: give whole numbers from 0 to"),
        (with_layer(pixels=[1.5, 2]), "layers[4].pixels has dtype float64: give whole numbers"),
        (with_layer(pixels=[10**7, 10**7]), "layers span 9999991 x 9999981 pixels, more than 100,000,000"),
        (with_layer(compressedPixels=[1, 1, 0]), "layers[4].compressedPixels has lengths of 0 to 0: give rows of"),
    ],
)
def test_what_is_no_map(tmp_path: Path, content: object, message: str) -> None:
    with pytest.raises(MapError, match=re.escape(message).replace(r"\*", ".*")):
        sp.load_map(write_json(tmp_path / "home.json", content))


@pytest.mark.parametrize("content", [b"[" * 100_000, b"\xff\xfe"])
def test_what_is_no_json(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "home.json"
    path.write_bytes(content)
    with pytest.raises(MapError, match=r"home.json' is damaged or no JSON \(.*\): export it again\.|holds no Valetudo"):
        sp.load_map(path)


def test_recording(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_recording(tmp_path / "home.vwm")
    partial = sp.load_map(path)
    assert partial == sp.load_map(write_json(tmp_path / "home.json", valetudo_map()))
    with caplog.at_level(logging.WARNING):
        measured = sp.load_measurements(path, tx_power_dbm=20.0)
    assert "home (00:11:22:33:44:bb): 15, home (00:11:22:33:44:aa): 8, unknown (unknown): 1): the first" in caplog.text
    assert (len(measured), measured.tx_known.any()) == (15, False)
    assert measured.rx[0].tolist() == pytest.approx([6.0, 8.75, 0.1])
    assert measured.gain_db[0] == -51 - 1 - 20  # the mean of two powers
    assert (partial.state_at(measured.rx) == CellState.FREE).sum() >= 14
    other = sp.load_measurements(path, access_point="00:11:22:33:44:aa", tx=(6.0, 9.0, 1.0))
    assert (len(other), other.tx[0].tolist()) == (8, [6.0, 9.0, 1.0])
    with pytest.raises(MeasurementError, match=r"access_point = 'home' names 2 access points of .*: give the BSSID"):
        sp.load_measurements(path, access_point="home")
    with pytest.raises(MeasurementError, match=r"columns = .* is for a CSV, and not for 'home.vwm': leave it out"):
        sp.load_measurements(path, columns={"rx_x": "x"})
    (tmp_path / "home.csv").write_text("x,y,rssi\n1,2,-50\n")
    with pytest.raises(MeasurementError, match=r"names 0 access points of measurements 'home\.csv': leave it out"):
        sp.load_measurements(tmp_path / "home.csv", access_point="home")


@pytest.mark.parametrize("pack", [zlib.compress, lambda raw: base64.b64encode(zlib.compress(raw))])
def test_maps_over_mqtt(tmp_path: Path, pack: Callable[[bytes], bytes]) -> None:
    path = write_json(tmp_path / "home.json", valetudo_map())
    packed = tmp_path / "packed.json"
    packed.write_bytes(pack(path.read_bytes()))
    assert sp.load_map(packed) == sp.load_map(path)
    packed.write_bytes(pack(path.read_bytes())[:-400])
    with pytest.raises(MapError, match=r"packed.json' is damaged or no JSON"):
        sp.load_map(packed)


def test_rooms_with_names_of_floors() -> None:
    """A segment named "all" is not the whole floor."""
    partial = replace(sp.make_home(0), room=None, room_names=())
    room = 1 + (np.indices(partial.shape)[1] > partial.shape[1] // 2)
    named = [replace(partial, room=room, room_names=names) for names in (("all", "bath"), ("den", "bath"))]
    marked, usual = (sp.predict_map(home, (3.0, 3.0, 1.5), spacing_m=0.6).radio.area(-60.0) for home in named)
    assert marked.floor.values.tolist() == ["observed", "all", "all_1", "bath"]
    assert marked.area_m2.sel(floor="all").item() == usual.area_m2.sel(floor="all").item()
    assert marked.area_m2.sel(floor="all_1").item() == usual.area_m2.sel(floor="den").item()


def test_coverage_of_rooms(tmp_path: Path) -> None:
    partial = sp.load_map(write_json(tmp_path / "home.json", valetudo_map()))
    coverage = sp.predict_map(partial, {"a": (6.0, 8.0, 1.5), "b": (10.0, 8.0, 1.5)}, spacing_m=0.5)
    assert coverage["room"].attrs["flag_meanings"] == "none bedroom kitchen"
    np.testing.assert_array_equal(coverage["room"], partial.room)
    area = coverage.radio.area(-65.0)
    assert area.floor.values.tolist() == ["observed", "all", "bedroom", "kitchen"]
    assert area.area_m2.sel(floor="kitchen").item() == pytest.approx(25 * 0.25)
    assert area.fraction.sel(floor="kitchen", tx="a") > area.fraction.sel(floor="kitchen", tx="b")
    sp.save_coverage(coverage, tmp_path / "coverage.nc")
    xr.testing.assert_identical(sp.load_coverage(tmp_path / "coverage.nc"), coverage)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"measurements": []}, "has no measurements: let the robot drive while Valeronoi records."),
        ({"measurements": [{"x": 1, "y": 2, "wifi": 9, "data": [-5]}]}, "is damaged or no recording of Valeronoi ("),
        ({"measurements": [{"x": "1", "y": 2, "wifi": 0, "data": [-5]}]}, "rx_x[0] = nan is not allowed"),
        ({"measurements": [{"x": 1, "y": 2, "wifi": 0, "data": ["-5"]}]}, "gain_db[0] = nan is not allowed"),
    ],
)
def test_what_is_no_recording(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    content = copy.deepcopy(recording()) | changes
    with pytest.raises(MeasurementError, match=re.escape(message)):
        sp.load_measurements(write_json(tmp_path / "home.vwm", content))
