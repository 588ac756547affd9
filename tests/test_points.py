"""Point clouds as maps: every format, written by other tools, and what is free, wall and unknown."""

import re
from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from pypcd4 import Encoding, PointCloud
from small_maps import states

from sionna_partial.constants import CellState
from sionna_partial.errors import MapError
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.importers import cloud_files
from sionna_partial.maps.importers import points as points_module
from sionna_partial.maps.importers.points import map_from_points
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap

FREE, WALL, UNKNOWN = (int(state) for state in CellState)
INSIDE, IN_WALL, OUTSIDE = (2.0, 1.5), (2.0, 3.01), (2.0, 4.5)


def shell(low: tuple[float, float, float], high: tuple[float, float, float], rng: np.random.Generator) -> NDArray:
    low_m, size = np.array(low), np.subtract(high, low)
    faces = []
    for axis in range(3):
        area = np.delete(size, axis).prod()
        for end in (0, 1):
            points = rng.random((round(1000 * area), 3))
            points[:, axis] = end
            faces.append(low_m + points * size)
    return np.concatenate(faces)


def room(floor_m: float = 0.0, noise_m: float = 0.005) -> NDArray:
    """Floor, ceiling and walls of a room of 5 x 3 x 2.6 m, a table, a thick pillar, and stray points."""
    rng = np.random.default_rng(0)
    parts = [shell((0.02, 0.02, 0), (5.02, 3.02, 2.6), rng), shell((3.02, 1.02, 0), (3.52, 1.52, 2.6), rng)]
    parts += [shell((1.0, 1.0, 0.7), (1.8, 1.6, 0.75), rng), rng.uniform((-2, -2, 0), (8, 6, 2), (40, 3))]
    points = np.concatenate(parts)
    points += rng.normal((0.0, 0.0, floor_m), noise_m, points.shape)
    return points


ROOM = room()


def write(path: Path, points: NDArray) -> Path:
    kind = path.suffix
    if kind in (".las", ".laz"):
        header = laspy.LasHeader(point_format=3, version="1.2")
        header.scales, header.offsets = (0.001,) * 3, points.min(axis=0)
        las = laspy.LasData(header)
        las.x, las.y, las.z = points.T
        las.write(path)
    elif kind == ".pcd":
        name = path.stem.rpartition("_")[2]
        encoding = Encoding(name) if name in ("ascii", "binary") else Encoding.BINARY_COMPRESSED
        PointCloud.from_xyz_points(points.astype(np.float32)).save(path, encoding=encoding)
    elif kind == ".ply":
        trimesh.PointCloud(points).export(path)
    else:
        head = f"{len(points)}\n" if kind == ".pts" else "//X,Y,Z,R\n"
        columns = np.column_stack([points, np.zeros(len(points))])
        with path.open("w") as stream:
            stream.write(head)
            np.savetxt(stream, columns, fmt="%.4f", delimiter=" " if kind == ".pts" else ",")
    return path


def require_room(partial: PartialMap) -> None:
    assert states(partial, INSIDE, IN_WALL, OUTSIDE, (3.27, 1.27)) == [FREE, WALL, UNKNOWN, UNKNOWN]
    assert states(partial, (1.4, 1.3), (3.03, 1.3)) == [FREE, WALL]  # under the table; the pillar
    assert partial.wall_height_m == pytest.approx(2.6, abs=0.02)
    assert partial.is_complete
    assert (partial.state == FREE).sum() * 0.05**2 == pytest.approx(5 * 3 - 0.25, rel=0.05)


FORMATS = ("room.las", "room.laz", "room_ascii.pcd", "room_binary.pcd", "room.pcd", "room.ply", "room.xyz", "room.pts")


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_room(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, ROOM)
    partial = load_map(path)
    require_room(partial)
    assert load_map(path, wall_height_m=2.2).wall_height_m == 2.2


@pytest.mark.parametrize(
    ("floor_m", "height_m", "noise_m"), [(0.0, 2.5, 0.0), (0.024, 2.6, 0.003), (-1.23, 2.62, 0.02), (7.0, 2.75, 0.003)]
)
def test_wall_height(floor_m: float, height_m: float, noise_m: float) -> None:
    """A flat surface without noise fills one layer of voxels, with noise two."""
    rng = np.random.default_rng(1)
    points = shell((0.02, 0.02, 0), (5.02, 4.02, height_m), rng)
    points[:, 2] += rng.normal(floor_m, noise_m, len(points))
    assert map_from_points(points).wall_height_m == pytest.approx(height_m, abs=0.02)


def test_feet() -> None:
    points = shell((0, 0, 0), (40, 30, 9), np.random.default_rng(0))[::9]
    message = r"points spans 40.1 x 30.1 m, with a storey of 9 m, as if it were in feet: give unit_m=0.3048 for"
    with pytest.warns(MapWarning, match=message):
        map_from_points(points)
    assert map_from_points(points, unit_m=1).wall_height_m == pytest.approx(9.0, abs=0.02)
    partial = map_from_points(points, unit_m=0.3048, resolution_m=0.1)
    assert partial.wall_height_m == pytest.approx(9 * 0.3048, abs=0.02)
    report = partial.import_report
    assert report is not None
    assert (report.unit_m, report.rooms, report.used[0].count) == (0.3048, 1, len(points))
    assert report.extent_m == pytest.approx((40 * 0.3048, 30 * 0.3048), abs=0.3)


def test_map_coordinates(tmp_path: Path) -> None:
    shift = np.array([500_000.0, 4_500_000.0, 0.0])
    far = load_map(write(tmp_path / "room.laz", ROOM + shift))
    require_room(PartialMap(far.state, 0.05, tuple(np.subtract(far.origin_m, shift[:2])), far.wall_height_m))


def test_y_up() -> None:
    turned = ROOM[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
    require_room(map_from_points(turned, up="y"))
    with pytest.warns(MapWarning, match='points looks as if y pointed up: give up="y" to turn it'):
        map_from_points(turned)


@pytest.mark.parametrize("lean_deg", [2.0, 9.0])
def test_leaning_clouds_are_levelled(lean_deg: float) -> None:
    turn = trimesh.transformations.rotation_matrix(np.radians(lean_deg), (1.0, 0.3, 0.0))[:3, :3]
    with pytest.warns(
        MapWarning,
        match=rf"points leans by ({lean_deg - 0.1:.1f}|{lean_deg:.1f}|{lean_deg + 0.1:.1f}) degrees, and is levelled",
    ):
        partial = map_from_points(ROOM @ turn.T)
    assert partial.wall_height_m == pytest.approx(2.6, abs=0.02)
    assert partial.import_report.free_area_m2 == pytest.approx(
        map_from_points(ROOM).import_report.free_area_m2, rel=0.04
    )
    assert {row.name: row.count for row in partial.import_report.used} == {"points": len(ROOM)}


def test_clouds_that_lean_too_far() -> None:
    turn = trimesh.transformations.rotation_matrix(np.radians(14.0), (1.0, 0.0, 0.0))[:3, :3]
    with pytest.raises(MapError, match=r"points leans by 1[34]\.\d degrees, so that its floor is not level: turn it"):
        map_from_points(ROOM @ turn.T)


@pytest.mark.parametrize(
    ("up", "axes"), [("-z", [(1, 0, 0), (0, -1, 0), (0, 0, -1)]), ("-y", [(1, 0, 0), (0, 0, -1), (0, 1, 0)])]
)
def test_clouds_upside_down(up: str, axes: list[tuple[int, int, int]]) -> None:
    """Furniture stands on the floor."""
    low = np.concatenate([ROOM, shell((0.3, 2.0, 0.4), (2.3, 2.9, 0.45), np.random.default_rng(1))])
    cloud = low @ np.array(axes).T
    with pytest.warns(MapWarning, match=f'looks as if {up} pointed up: give up="{up}" to turn it'):
        map_from_points(cloud)
    require_room(map_from_points(cloud, up=up))


def test_degrees() -> None:
    with pytest.raises(MapError, match="as if in degrees of longitude and latitude: project it to metres"):
        map_from_points(ROOM * (1e-5, 1e-5, 1.0) + (11.57, 48.15, 0.0))


def test_two_storeys() -> None:
    upper = np.add(ROOM, (10.0, 0.0, 2.9))
    both = np.concatenate([ROOM, upper])
    require_room(map_from_points(both, observed=[(0, 0), (5.1, 0), (5.1, 3.1), (0, 3.1)]))
    partial = map_from_points(both, height_band_m=(3.9, 4.7))
    assert states(partial, INSIDE, (12.0, 1.5)) == [UNKNOWN, FREE]
    assert partial.wall_height_m == pytest.approx(2.6, abs=0.02)


def test_walls_alone() -> None:
    walls = ROOM[(ROOM[:, 2] > 0.3) & (ROOM[:, 2] < 2.3)]
    walls = walls[(np.abs(walls[:, :2] - (1.4, 1.3)) > 0.6).any(axis=1)]
    with pytest.warns(MapWarning, match="has 0 m2 free in an extent of 5.05 x 3.05 m: give .* sensor_positions_m"):
        assert states(map_from_points(walls), INSIDE) == [UNKNOWN]
    partial = map_from_points(walls, sensor_positions_m=[(1.0, 1.25, 0.9), (1.01, 1.25, 0.9)])
    assert states(partial, INSIDE, IN_WALL, OUTSIDE, (4.5, 1.25)) == [FREE, WALL, UNKNOWN, UNKNOWN]
    around = map_from_points(walls, sensor_positions_m=[(1.0, 1.25), (4.5, 2.0)])
    assert states(around, (4.5, 1.25)) == [FREE]


def test_parts_and_order_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "room.xyz", ROOM)
    whole, text = map_from_points(ROOM), load_map(path)
    for module in (points_module, cloud_files):
        monkeypatch.setattr(module, "PART", 700)
    monkeypatch.setattr(cloud_files, "PART_BYTES", 5000)
    assert map_from_points(np.random.default_rng(1).permutation(ROOM)) == whole
    assert load_map(path) == text


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"points": np.zeros((3, 2))}, "points has shape (3, 2): give x, y, z in metres, (N, 3), or the path of a"),
        ({"points": np.zeros((0, 3))}, "points holds no finite point: give a cloud with x, y, z in metres"),
        ({"points": ROOM / 1000}, "points spans 0.05 x 0.05 x 0.05 m: give unit_m, the length of its unit in metres"),
        ({"points": [(0, 0, 0), (1e5, 0, 0)]}, "points spans more than 52,429 m: remove stray points, or cut it"),
        ({"points": [(0, 0, 0), (1e9, 0, 0)]}, "points holds coordinates above 1e+08 m: give a cloud in metres"),
        ({"points": [(0, 0, 0), (9e3, 9e3, 0)]}, "more than 100,000,000: give"),
        ({"sensor_positions_m": (1.0, 2.0)}, "sensor_positions_m has shape (2,) or values that are not finite: give x"),
        ({"sensor_positions_m": [(1.0, 2.0)], "up": "y"}, 'with up = "y": give x, y, z of the cloud, (M, 3)'),
        ({"sensor_positions_m": [(1e7, 0.0)]}, "sensor_positions_m has [10000000.0, 0.0], more than 200 m from the"),
    ],
)
def test_refused(given: dict, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(MapError, match=re.escape(message)):
        map_from_points(**{"points": ROOM, **given})


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("room_binary.pcd", rb"POINTS \d+", b"POINTS 999999999999"),
        ("room_binary.pcd", rb"FIELDS x y z", b"FIELDS a b c"),
        ("room.ply", rb"element vertex \d+", b"element vertex 99999999999"),
        ("room.xyz", rb"\n", b"\nx,y,z\n"),
    ],
)
def test_lying_header(tmp_path: Path, name: str, old: bytes, new: bytes) -> None:
    path = write(tmp_path / name, ROOM[::50])
    path.write_bytes(re.sub(old, new, path.read_bytes(), count=1 if b"\\n" not in old else 3))
    with pytest.raises(MapError, match=r"is damaged or no [A-Z]+ \(.+\): export it again\."):
        map_from_points(path)


def test_other_files(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"room.e57' is no point cloud: give one of .pcd, .las, .laz,"):
        map_from_points(tmp_path / "room.e57")
    with pytest.raises(MapError, match=r"room.las' cannot be read \(No such file or directory\)"):
        map_from_points(tmp_path / "room.las")


def test_compressed_pcd_holds_what_an_uncompressed_one_does(tmp_path: Path) -> None:
    floor = np.random.default_rng(0).uniform((0.02, 0.02, 0.0), (4.0, 3.0, 0.01), (2000, 3))
    points = np.concatenate([floor, floor * (1.0, 0.0, 0.0) + (0.0, 2.98, 1.0) + floor[::-1] * (0.0, 0.0, 100.0)])
    compressed, plain = (load_map(write(tmp_path / name, points)) for name in ("room.pcd", "room_binary.pcd"))
    assert compressed == plain


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.pts", b"3\n0 0 0\n1 1 1\n", "announces 3 points, and has 2"),
        ("a.xyz", b"0 0 0\n1 1 1\n2 2", "without a line end and may be cut"),
        ("a.las", b"LASF".ljust(100, b"\0") + b"\xff" * 4 + bytes(200), "4294967295 and 0 variable length records"),
        (
            "a.pcd",
            b"VERSION .7\nFIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1000000000\nWIDTH 1\nHEIGHT 1\n"
            b"POINTS 1\nDATA binary\n",
            "announces 1000000003 values for each point",
        ),
    ],
)
def test_files_that_announce_more_than_they_hold(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MapError, match=message):
        map_from_points(tmp_path / name)
