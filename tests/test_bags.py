"""Rosbags of ROS 1 and 2: maps, poses, and received powers, in files that the library rosbags wrote."""

import math
import re
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbag_files import KINDS, START_S, Messages, messages_of, write_bag

from sionna_partial.errors import MapError, MeasurementError
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.importers.bags import map_from_bag, map_from_occupancy
from sionna_partial.maps.map_files import load_map
from sionna_partial.measurements.measurements import measurements_of
from sionna_partial.measurements.recordings import load_survey, measurements_from_bag, poses_from_bag

EARLY, LATE, SIDE = [[-1, -1, -1], [-1, 0, 100]], [[100, 0, 0], [0, 0, 100]], [[0, 100]]
TIMES = np.arange(0.0, 10.01, 0.5)


def way(time_s: Any) -> tuple[Any, Any, Any]:
    return 1.0 + 0.5 * time_s, 2.0 + 0.1 * time_s, 0.02 * time_s


@pytest.fixture(params=KINDS, scope="module")
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    name: str = request.param
    make = messages_of(name)
    rows: list[tuple[str, float, Any]] = [
        ("/map", 1.0, make.grid(EARLY)),
        ("/map", 6.0, make.grid(LATE)),
        ("/costmap", 2.0, make.grid(SIDE)),
        ("/goal_pose", 0.5, make.pose_stamped(START_S, 99.0, 99.0, 0.0)),
        ("/tf_static", 0.0, make.transform(START_S, "base_link", "antenna", 0.3, 0.0, 0.0)),
        ("/tf", 0.0, make.transform(START_S, "map", "odom", 1.0, 2.0, math.pi / 2)),
    ]
    for time_s in TIMES:
        x, y, yaw = way(time_s)
        rows.append(("/amcl_pose", time_s, make.pose_stamped(START_S + time_s, x, y, yaw)))
        turned = (y - 2.0, 1.0 - x, yaw - math.pi / 2)  # in odom, which is turned by a quarter
        rows.append(("/odom", time_s, make.odometry(START_S + time_s, *turned)))
        rows.append(("/tf", time_s, make.transform(START_S + time_s, "odom", "base_link", *turned)))
        rows.append(("/rssi", time_s + 0.2, make.power(-50.0 - time_s)))
        rows.append(("/stamped", time_s + 0.4, make.stamped_power(START_S + time_s + 0.1, -60.0 - time_s)))
    return write_bag(tmp_path_factory.mktemp("drive") / name, rows)


class TestMaps:
    def test_last_map(self, drive: Path) -> None:
        partial = load_map(drive)
        assert partial.state.tolist() == [[1, 0, 0], [0, 0, 1]]
        assert (partial.origin_m, partial.resolution_m) == ((1.0, 2.0), 0.5)
        assert load_map(drive, wall_height_m=2.5).wall_height_m == 2.5
        assert map_from_bag(drive, time_s=5.9).state.tolist() == [[2, 2, 2], [2, 0, 1]]
        assert map_from_bag(drive, time_s=6.0) == map_from_bag(drive, time_s=1e6) == load_map(drive)
        assert map_from_bag(drive, topic="/costmap").state.tolist() == [[0, 1]]

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"time_s": 0.5}, r"has no map up to time_s = 0\.5: topic /map has its first map 1 s after the start: g"),
            ({"time_s": -1}, r"time_s = -1 is not allowed: give seconds since the start of the recording"),
            ({"topic": "/odom"}, r"has no OccupancyGrid topic '/odom': name one of its topics: /amcl_pose"),
        ],
    )
    def test_refused(self, drive: Path, given: Any, message: str) -> None:
        with pytest.raises(MapError, match=message):
            map_from_bag(drive, **given)


def test_the_only_grid_is_the_map(tmp_path: Path) -> None:
    name, grid = "drive_mcap", Messages(2).grid(SIDE)
    one = write_bag(tmp_path / name, [("/projected_map", 0.0, grid)])
    assert load_map(one).state.tolist() == [[0, 1]]
    two = write_bag(tmp_path / f"two_{name}", [("/a", 0.0, grid), ("/b", 0.0, grid)])
    with pytest.raises(MapError, match=r"has 2 OccupancyGrid topics: name one of its topics: /a \(OccupancyGrid\), /b"):
        load_map(two)
    broken = Messages(2).grid([[101]])
    with pytest.raises(MapError, match=r"topic /map: data holds 101: give -1 for unknown"):
        load_map(write_bag(tmp_path / f"bad_{name}", [("/map", 0.0, broken)]))


def test_single_files_of_ros_2(tmp_path: Path) -> None:
    rows = [("/map", 0.0, Messages(2).grid(LATE))]
    files = [file for name in KINDS[1:] for file in write_bag(tmp_path / name, rows).glob("drive*")]
    assert [load_map(file).state.tolist() for file in files] == [[[1, 0, 0], [0, 0, 1]]] * 2


class TestPoses:
    @pytest.mark.parametrize("topic", [None, "/tf", "/amcl_pose", "/odom"])
    def test_poses_are_in_the_map(self, drive: Path, topic: str | None) -> None:
        poses = poses_from_bag(drive, topic=topic)
        x, y, yaw = way(TIMES)
        np.testing.assert_allclose(poses.time_s, TIMES, atol=1e-6)
        np.testing.assert_allclose(poses.position_m, np.column_stack([x, y, 0 * x]), atol=1e-6)
        np.testing.assert_allclose(poses.yaw_rad, yaw, atol=1e-6)
        assert poses.attrs["frame_id"] == "map"

    def test_pose_of_the_antenna(self, drive: Path) -> None:
        x, y, yaw = way(TIMES)
        poses = poses_from_bag(drive, frame="antenna")
        np.testing.assert_allclose(poses.position_m[:, 0], x + 0.3 * np.cos(yaw), atol=1e-6)
        np.testing.assert_allclose(poses.position_m[:, 1], y + 0.3 * np.sin(yaw), atol=1e-6)
        with pytest.raises(MeasurementError, match="no transform leads from 'map' to 'camera'; its frames are antenna"):
            poses_from_bag(drive, frame="camera")

    def test_odometry_without_a_map(self, tmp_path: Path) -> None:
        make = Messages(2)
        rows = [("/odom", time, make.odometry(START_S + time, time, 0.0, 0.0)) for time in (0.0, 1.0)]
        bag = write_bag(tmp_path / "drive_mcap", [*rows, ("/empty", 0.0, make.power(0.0))])
        with pytest.warns(MapWarning, match=r"poses of /odom are in the frame 'odom', and no transform leads to 'map'"):
            poses = poses_from_bag(bag)
        assert poses.position_m[:, 0].values.tolist() == [0.0, 1.0]
        with pytest.raises(MeasurementError, match=r"has no .* topic '/empty': name one of its topics"):
            poses_from_bag(bag, topic="/empty")
        with pytest.raises(MapError, match=r"has 0 OccupancyGrid topics: name one of its topics: /empty \(Float32\)"):
            load_map(bag)


class TestTwoRobots:
    """A bag with /robot1/tf and /robot2/tf: robot 1 drives at y = 1, robot 2 at y = 8."""

    BAG = Path(__file__).parent / "reports" / "two_robots" / "two_mcap"

    @pytest.mark.parametrize(("robot", "y_m"), [("robot1", 1.0), ("robot2", 8.0)])
    def test_a_named_topic_is_the_only_one(self, robot: str, y_m: float) -> None:
        topic = f"/{robot}/tf"
        table = measurements_from_bag(self.BAG, f"/{robot}/rssi", tx_power_dbm=0.0, pose_topic=topic)
        np.testing.assert_allclose(table.rx_y, y_m)
        np.testing.assert_allclose(poses_from_bag(self.BAG, topic=topic).position_m[:, 1], y_m)

    def test_without_a_name_the_user_is_asked(self) -> None:
        message = r"'base_link' on several topics, as of several robots: name one of /robot1/tf, /robot2/tf as topic"
        with pytest.raises(MeasurementError, match=message):
            poses_from_bag(self.BAG)

    def test_odometry_and_static_transforms_of_one_robot(self, tmp_path: Path) -> None:
        make, rows = Messages(2), []
        for robot, x in (("robot1", 1.0), ("robot2", 5.0)):
            rows.append((f"/{robot}/tf_static", 0.0, make.transform(START_S, "map", "odom", x, 0.0, 0.0)))
            rows.append((f"/{robot}/tf", 0.0, make.transform(START_S, "odom", "base_link", 0.5, 0.0, 0.0)))
            rows += [(f"/{robot}/odom", time, make.odometry(START_S + time, time, 0.0, 0.0)) for time in (0.0, 1.0)]
        bag = write_bag(tmp_path / "drive_mcap", rows)
        assert poses_from_bag(bag, topic="/robot2/odom").position_m[:, 0].values.tolist() == [5.0, 6.0]
        assert poses_from_bag(bag, topic="/robot2/tf").position_m[:, 0].values.tolist() == [5.5]


class TestPowers:
    TX = (2.0, 2.5, 1.4)

    def test_by_the_times_of_recording(self, drive: Path) -> None:
        with pytest.warns(MapWarning, match="1 of 21 powers are not finite or without a pose; they are left out"):
            table = measurements_from_bag(drive, "/rssi", self.TX, tx_power_dbm=20.0)
        x, y, _ = way(TIMES[:-1] + 0.2)
        np.testing.assert_allclose(table.gain_db, -70.0 - TIMES[:-1], atol=1e-4)
        np.testing.assert_allclose(table.time_s, TIMES[:-1] + 0.2, atol=1e-6)
        measured = measurements_of(table)
        np.testing.assert_allclose(measured.rx, np.column_stack([x, y, 0 * x + 1.5]), atol=1e-5)
        np.testing.assert_allclose(measured.tx, np.tile(self.TX, (20, 1)))

    def test_the_only_topic_of_powers_as_any_survey(self, drive: Path) -> None:
        with pytest.warns(MapWarning, match="1 of 21 powers"):
            measured = load_survey(drive, self.TX)
        np.testing.assert_allclose(measured.gain_db, -50.0 - TIMES[:-1], atol=1e-4)
        with pytest.raises(MeasurementError, match=r"access_point is not for a rosbag \('.*drive.*'\), which has one"):
            load_survey(drive, access_point="home")

    def test_by_stamps(self, drive: Path, tmp_path: Path) -> None:
        options = {"field": "temperature", "pose_topic": "/odom", "rx_height_m": 0.4}
        with pytest.warns(MapWarning, match="1 of 21 powers"):
            table = measurements_from_bag(drive, "/stamped", self.TX, tx_power_dbm=0, **options)
        np.testing.assert_allclose(table.rx_x, way(TIMES[:-1] + 0.1)[0], atol=1e-5)
        assert (table.rx_z == 0.4).all()
        table.to_dataframe().to_csv(tmp_path / "measured.csv")
        np.testing.assert_allclose(measurements_of(tmp_path / "measured.csv").rx, measurements_of(table).rx)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"topic": "/power"}, "has no message topic '/power': name one of its topics: /amcl_pose (PoseStamped)"),
            ({"field": "rssi"}, "field = 'rssi' is no number in the messages of /rssi: give one of data."),
            ({"tx_power_dbm": None}, "tx_power_dbm = None is not allowed: give a number of dBm"),
            ({"tx_power_dbm": -80}, "is not allowed: path gains are negative; give minus the path loss"),
            ({"tx": (1, 2)}, "tx has shape (2,) for 20 gains"),
        ],
    )
    @pytest.mark.filterwarnings("ignore::sionna_partial.maps.partial_map.MapWarning")
    def test_refused(self, drive: Path, given: Any, message: str) -> None:
        every = {"topic": "/rssi", "tx": self.TX, "tx_power_dbm": 20.0, **given}
        with pytest.raises(MeasurementError, match=re.escape(message)):
            measurements_from_bag(drive, **every)

    def test_powers_without_poses(self, tmp_path: Path) -> None:
        make = Messages(1)
        rows = [("/pose", 9.0, make.pose_stamped(START_S, 0.0, 0.0, 0.0)), ("/rssi", 0.0, make.power(-60.0))]
        with pytest.raises(MeasurementError, match=r"topic /rssi has 1 powers \(0.0 to 0.0 s\), none of them finite"):
            measurements_from_bag(write_bag(tmp_path / "drive.bag", rows), "/rssi", self.TX, tx_power_dbm=0.0)


class TestMessages:
    @pytest.mark.parametrize("yaw", [math.pi / 2, -0.3])
    def test_message_with_yaw(self, yaw: float) -> None:
        """Cells turn about the origin of the message, which is in the axes of the world."""
        grid = Messages(2).grid([[0] * 8, [0] * 8, [100] * 8], (3.0, -1.0, yaw))
        partial = map_from_occupancy(grid, wall_height_m=2.0)
        turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        points = np.array([(0.75, 0.25), (3.75, 0.75), (0.75, 1.25), (3.25, 1.25), (0.75, 2.0)]) @ turn + (3.0, -1.0)
        assert partial.state_at(points).tolist() == [0, 0, 1, 1, 2]
        assert partial.wall_height_m == 2.0

    def test_messages_of_other_libraries(self) -> None:
        zero = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
        origin = SimpleNamespace(position=zero, orientation=zero)
        info = SimpleNamespace(resolution=0.1, width=2, height=1, origin=origin)
        assert map_from_occupancy(SimpleNamespace(info=info, data=(0, -1))).state.tolist() == [[0, 2]]

    @pytest.mark.parametrize(
        ("change", "given", "message"),
        [
            ({}, {"resolution_m": 0.1}, "resolution_m and origin_m are those of the message: leave them out"),
            ({"data": [0]}, {}, "data has 1 values for 1 x 2 cells: give the whole message"),
            ({"info": None}, {}, "data is no OccupancyGrid ("),
            (None, {}, "resolution_m is missing: give the edge of a cell in metres, or an Occ"),
        ],
    )
    def test_refused(self, change: dict[str, Any] | None, given: dict[str, Any], message: str) -> None:
        grid = [[0]] if change is None else Messages(2).grid(SIDE)
        for name, value in (change or {}).items():
            object.__setattr__(grid, name, value)
        with pytest.raises(MapError, match=re.escape(message)):
            map_from_occupancy(grid, **given)

    def test_tilted_map(self) -> None:
        grid = Messages(2).grid(SIDE)
        object.__setattr__(grid.info.origin.orientation, "x", 1.0)
        with pytest.raises(
            MapError, match=r"info.origin.orientation = \[1.0, 0.0, 0.0, 1.0\] is not level: give a yaw"
        ):
            map_from_occupancy(grid)


def test_other_files(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"path = 3 is not a path: give a rosbag \(.bag, .mcap, .db3, or a folder\)"):
        map_from_bag(3)  # type: ignore[arg-type]
    with pytest.raises(MeasurementError, match=r"drive.bag' cannot be read \(No such file or directory\)"):
        poses_from_bag(tmp_path / "drive.bag")


class TestHostileStorage:
    """Storage whose reader would not end, or would read another file."""

    def test_views(self, tmp_path: Path) -> None:
        with closing(sqlite3.connect(tmp_path / "a.db3")) as database:
            database.execute("CREATE TABLE topics (id INTEGER)")
            database.execute("CREATE VIEW messages AS SELECT id FROM topics")
        with pytest.raises(MapError, match="it has views in place of tables"):
            map_from_bag(tmp_path / "a.db3")

    def test_names_that_are_uris(self, tmp_path: Path) -> None:
        (tmp_path / "..%2Fother.db3").touch()
        with pytest.raises(MapError, match=r"characters % . # in it: rename it"):
            map_from_bag(tmp_path / "..%2Fother.db3")

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (struct.pack("<BQ16xQ", 6, 24, 20 * 10**9), "a chunk of 20,000,000,000 bytes"),
            (struct.pack("<BQ", 3, 19) + b"uint8[4000000000] a", "arrays of 4,000,000,000 values"),
        ],
    )
    def test_huge_chunks_and_arrays(self, tmp_path: Path, content: bytes, message: str) -> None:
        (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + content)
        with pytest.raises(MapError, match=message):
            map_from_bag(tmp_path / "a.mcap")
