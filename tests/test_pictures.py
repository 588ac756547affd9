"""Floor plans as pictures: walls by threshold, scale, orientation, and what is skipped."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError

PIXEL_M = 0.02
FREE, WALL, UNKNOWN = CellState


def plan(wall: int = 30, ground: int = 240) -> np.ndarray:
    """Return two rooms of 4 x 3 m and 2 x 3 m, walls 0.2 m thick, a door of 0.9 m, thin furniture and a label."""
    shade = np.full((250, 400), ground, np.uint8)
    shade[40:210, 40:370] = wall
    shade[50:200, 50:250] = shade[50:200, 260:360] = ground
    shade[60:105, 250:260] = ground
    shade[120, 100:150] = shade[120:150, 100] = wall  # a table
    shade[150:165, 300:308] = wall  # a letter
    return shade


def write(path: Path, shade: np.ndarray) -> Path:
    Image.fromarray(shade).save(path, **({"quality": 90} if path.suffix == ".jpg" else {}))
    return path


@pytest.mark.parametrize(("name", "shades"), [("plan.png", (30, 240)), ("plan.jpg", (250, 60))])
def test_walls_by_threshold(tmp_path: Path, name: str, shades: tuple[int, int]) -> None:
    partial = sp.load_map(write(tmp_path / name, plan(*shades)), resolution_m=PIXEL_M)
    report = partial.import_report
    assert report is not None
    assert partial.resolution_m == pytest.approx(2 * PIXEL_M)
    assert (report.rooms, report.extent_m) == (2, pytest.approx((6.6, 3.4), abs=0.09))
    assert report.free_area_m2 == pytest.approx(4 * 3 + 2 * 3 + 0.2 * 0.9, abs=0.7)
    assert report.door_widths_m == pytest.approx((0.9,), abs=0.09)
    room, door, table, letter, outside = ((2, 2), (5.1, 3.3), (2.6, 2.6), (6.08, 1.8), (0.2, 0.2))
    assert partial.state_at(np.array([room, door, table, letter, outside])).tolist() == [FREE] * 4 + [UNKNOWN]
    assert partial.state_at(np.array([(0.9, 2.0), (5.1, 1.0)])).tolist() == [WALL, WALL]
    assert "separate marks: 1 (text or symbols up to 0.5 m)" in str(report)


@pytest.mark.parametrize("spacing", [6, 10])
def test_thin_lines_beside_hatched_walls(tmp_path: Path, spacing: int) -> None:
    """Walls 20 cm thick, hatched at 45 degrees, with a door leaf, its arc and a threshold in thin lines."""
    solid = np.repeat(np.repeat(plan(), 2, axis=0), 2, axis=1) < 100
    solid &= ndimage.binary_opening(solid, np.ones((8, 8)))
    solid[300:330, 600:616] = False  # the letter
    row, column = np.indices(solid.shape)
    dark = solid & ((row + column) % round(spacing * np.sqrt(2)) == 0) | (solid & ~ndimage.binary_erosion(solid))
    dark[120:210, 500] = dark[120, 410:500] = True
    angle = np.linspace(0, np.pi / 2, 500)
    dark[np.rint(120 + 90 * np.sin(angle)).astype(int), np.rint(500 - 90 * np.cos(angle)).astype(int)] = True
    report = sp.load_map(
        write(tmp_path / "plan.png", np.where(dark, 30, 240).astype(np.uint8)), resolution_m=0.01
    ).import_report
    assert report.rooms == 2
    assert report.door_widths_m == pytest.approx((0.9,), abs=0.1)
    assert report.free_area_m2 == pytest.approx(4 * 3 + 2 * 3 + 0.2 * 0.9, abs=0.7)
    assert {row.name for row in report.skipped} == {"thin lines"}


def test_other_pictures(tmp_path: Path) -> None:
    clear = np.zeros((*plan().shape, 4), np.uint8)
    clear[..., 3] = np.where(plan() < 100, 255, 0)
    expected = sp.load_map(write(tmp_path / "plan.png", plan()), resolution_m=PIXEL_M)
    assert sp.load_map(write(tmp_path / "clear.png", clear), resolution_m=PIXEL_M) == expected
    deep = write(tmp_path / "deep.png", plan().astype(np.uint16) * 200)
    assert sp.load_map(deep, resolution_m=PIXEL_M) == expected
    faces = plan()
    faces[42:208, 42:48] = faces[42:208, 362:368] = faces[42:48, 42:368] = faces[202:208, 42:368] = 240
    faces[120:150, 100:150] = 240
    outlined = sp.load_map(write(tmp_path / "faces.png", faces), resolution_m=PIXEL_M)
    assert outlined.state_at(np.array([(0.9, 2.0), (2.0, 2.0)])).tolist() == [WALL, FREE]


@pytest.mark.parametrize(
    ("shade", "resolution_m", "message"),
    [
        (plan(), None, "or resolution_m, the metres per pixel of a floor plan: a known length [m] over its pixels"),
        (plan(), 1e-5, "resolution_m = 1e-05 is not allowed"),
        (plan(), 0.002, "resolution_m = 0.002 makes walls that span 0.8 m: give the metres per pixel"),
        (np.full((50, 60), 9, np.uint8), 0.02, "has one shade alone: give a picture of walls"),
        (np.eye(200, dtype=np.uint8)[::-1] * 255, 0.02, "has walls that enclose nothing with resolution_m = 0.02"),
        (np.eye(9, dtype=np.uint8) * 255, 0.02, "has no connected walls longer than 0.5 m with resolution_m = 0.02"),
    ],
)
def test_what_is_no_plan(tmp_path: Path, shade: np.ndarray, resolution_m: float | None, message: str) -> None:
    with pytest.raises(MapError, match=re.escape(message)):
        sp.load_map(write(tmp_path / "plan.png", shade), resolution_m=resolution_m)


def test_damaged_pictures(tmp_path: Path) -> None:
    path = write(tmp_path / "plan.png", plan())
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(MapError, match=r"plan\.png' is not allowed: it is damaged or not a PNG, JPEG or BMP \("):
        sp.load_map(path, resolution_m=PIXEL_M)
