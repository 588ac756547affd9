"""A robot in another process, by real DDS on the loopback interface; a rosbridge server of a few lines; the command."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbag_files import Messages, write_bag
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

import sionna_partial as sp
from sionna_partial import cli
from sionna_partial.apps.live import rosbridge
from sionna_partial.apps.live.coverage import LiveCoverage
from sionna_partial.apps.live.dds import Dds, filled, struct
from sionna_partial.apps.live.incoming import LiveSettings
from sionna_partial.apps.live.rosbridge import Rosbridge
from sionna_partial.apps.live.topics import (
    CONNECTION_TYPE,
    FILTER_TYPE,
    GRID_TYPE,
    POSE_TYPE,
    VIEWS_TYPE,
    Listener,
    Topics,
)

pytest.importorskip("cyclonedds")
pytest.importorskip("websockets")

CELLS = [[100, 100, 100, 100], [100, 0, 0, -1], [100, 100, 100, 100]]
POSE = {"position": dict.fromkeys("xyz", 0.0), "orientation": {**dict.fromkeys("xyz", 0.0), "w": 1.0}}
HEADER = {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "map"}
INFO = {"map_load_time": HEADER["stamp"], "resolution": 1.0, "width": 4, "height": 3, "origin": POSE}
GRID = {"header": HEADER, "info": INFO, "data": np.ravel(CELLS).tolist()}
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer Address='localhost'/></Peers></Discovery></Domain></CycloneDDS>"
)
LIVE = ["--tx", "1.5", "1.5", "1.5", "--spacing", "0.25", "--frequency", "28GHz"]

ROBOT = """
import sys, time
from test_live_transports import GRID, GRID_TYPE
from sionna_partial.apps.live.dds import Dds, filled
from sionna_partial.apps.live.topics import Topics
robot = Dds(Topics(map="/unused"), {})
writer = robot._writer("/map", GRID_TYPE)
writer.write(filled(GRID_TYPE, GRID))
reader = robot._reader("/radio/tx", GRID_TYPE, True)
for _ in range(30_000):
    for each in reader.take(1):
        print(each.header.frame_id, each.info.width, *each.data, flush=True)
    time.sleep(0.02)
"""


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    number = str(100 + os.getpid() % 100)
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", number)
    return {**os.environ, "PYTHONPATH": f"{Path(__file__).parent}{os.pathsep}{Path(__file__).parents[1]}"}


class TestDds:
    @pytest.mark.parametrize(
        ("kind", "values"),
        [
            (GRID_TYPE, GRID),
            (VIEWS_TYPE, {"header": HEADER, "poses": [POSE, POSE]}),
            (POSE_TYPE, {"header": HEADER, "pose": {"pose": POSE, "covariance": [0.0] * 36}}),
        ],
    )
    def test_wire_format_is_that_of_ros(self, kind: str, values: dict[str, Any]) -> None:
        store = get_typestore(Stores.ROS2_HUMBLE)
        message = store.deserialize_cdr(filled(kind, values).serialize(), kind)
        assert (message.header.frame_id, message.header.stamp.nanosec) == ("map", 8)
        assert struct(kind).deserialize(bytes(store.serialize_cdr(message, kind))) == filled(kind, values)

    def test_messages_that_no_type_store_has(self) -> None:
        info = {"header": HEADER, "type": 0, "filter_mask_topic": "/radio/tx", "base": 0.0, "multiplier": 1.0}
        message = struct(FILTER_TYPE).deserialize(filled(FILTER_TYPE, info).serialize())
        assert (message.filter_mask_topic, message.multiplier) == ("/radio/tx", 1.0)
        strings = dict.fromkeys(("link_quality_raw", "essid", "bssid"), "AA:00:00:00:00:01")
        numbers = dict.fromkeys(("bitrate", "txpower", "link_quality", "signal_level", "noise_level"), -60)
        connection = filled(CONNECTION_TYPE, {**strings, **numbers, "frequency": 5.18})
        live = LiveCoverage({}, print, await_frequency=True)
        live.on_map(struct(GRID_TYPE).deserialize(filled(GRID_TYPE, GRID).serialize()))
        live.on_pose(1.5, 1.5, 0.0)
        live.on_connection(struct(CONNECTION_TYPE).deserialize(connection.serialize()), 0.0)
        assert [len(powers) for powers in live._powers.values()] == [1]
        assert struct(FILTER_TYPE).__idl_typename__ == "nav2_msgs.msg.dds_.CostmapFilterInfo_"

    def test_robot_in_another_process(self, domain: dict[str, str]) -> None:
        command = [sys.executable, "-m", "sionna_partial", "live", *LIVE]
        pipes: dict[str, Any] = {"env": domain, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        with (
            subprocess.Popen([sys.executable, "-c", ROBOT], **pipes) as robot,
            subprocess.Popen(command, **pipes) as live,
        ):
            try:
                frame, width, *cost = robot.stdout.readline().split()
                assert (frame, width, len(cost)) == ("map", "4", 12)
                assert [int(each) for each in cost][:5] == [-1] * 5
                robot.kill()  # a robot that disappears
                live.send_signal(signal.SIGINT)
                output, errors = live.communicate(timeout=600)
            finally:
                robot.kill()
                live.kill()
        assert live.returncode == 130, errors
        assert output.startswith(f"waiting for /map of DDS domain {domain['ROS_DOMAIN_ID']}; Ctrl-C ends")
        assert "map 1, tx: coarse after" in output

    def test_bytes_that_are_no_message(self, domain: dict[str, str], caplog: pytest.LogCaptureFixture) -> None:
        class Reader:
            def take(self, _: int) -> Any:
                raise ValueError("cut short")

        live = LiveCoverage((1.5, 1.5, 1.5), print)
        robot = Dds(Topics(), {"tx": None})
        robot._readers = [("/map", Reader())]
        robot.poll(Listener(live, Topics()))
        robot.close()
        assert caplog.text.count("a message of /map cannot be decoded (ValueError: cut short)") == 1

    def test_refused_domain(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for number in ("233", "map"):
            monkeypatch.setenv("ROS_DOMAIN_ID", number)
            with pytest.raises(sp.SionnaPartialError, match=r"domain|ROS_DOMAIN_ID"):
                Dds(Topics(), {})


class Server:
    """A rosbridge server that sends texts to who subscribes to /map, and keeps what it gets."""

    def __init__(self, texts: list[str]) -> None:
        from websockets.sync.server import serve

        self.texts, self.got = texts, list[Any]()
        self._server = serve(self._serve, "127.0.0.1", 0)
        self.url = f"ws://127.0.0.1:{self._server.socket.getsockname()[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _serve(self, connection: Any) -> None:
        for text in connection:
            message = json.loads(text)
            self.got.append(message)
            if message["op"] == "subscribe" and message["topic"] == "/map":
                for each in self.texts:
                    connection.send(each)
            if message["op"] == "publish":
                return

    def close(self) -> None:
        self._server.shutdown()


@pytest.fixture
def server() -> Iterator[Server]:
    hostile = ["{", "[]", '{"op": "publish", "topic": "/map", "msg": {"data": null}}', '{"op": "status", "msg": "x"}']
    server = Server([*hostile, json.dumps({"op": "publish", "topic": "/map", "msg": GRID})])
    yield server
    server.close()


class TestRosbridge:
    def test_server_that_starts_again(self, server: Server, caplog: pytest.LogCaptureFixture) -> None:
        topics = Topics()
        robot = Rosbridge(server.url, topics, {"tx": None})
        live = LiveCoverage((1.5, 1.5, 1.5), robot.publish, LiveSettings(spacing_m=0.25))
        thread = live.start()
        for _ in range(2):  # the second time it gets the last answer at once
            robot.connect(Listener(live, topics))
        live.close()
        thread.join(60)
        published = [each for each in server.got if each["op"] == "publish"]
        assert len(published) >= 2
        assert (published[0]["topic"], published[0]["msg"]["info"]["width"]) == ("/radio/tx", 4)
        advertised = {each["topic"]: each["type"] for each in server.got if each["op"] == "advertise"}
        assert advertised["/radio/tx"] == "nav_msgs/OccupancyGrid"
        assert "a message is dropped (JSONDecodeError" in caplog.text
        assert "it ended the connection; it is tried again every 1 s" in caplog.text

    def test_too_large_and_no_server(
        self, server: Server, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr(rosbridge, "MAX_BYTES", 100)
        server.texts = ["x" * 200]
        with socket.create_server(("127.0.0.1", 0)) as free:
            closed = f"ws://127.0.0.1:{free.getsockname()[1]}"
        for url, line in ((server.url, "1009 (message too big)"), (closed, "Connection refused; it is tried again")):
            robot = Rosbridge(url, Topics(), {})
            robot.connect(Listener(LiveCoverage((1.5, 1.5, 1.5), robot.publish), Topics()))
            assert line in caplog.text

    def test_refused_address(self) -> None:
        for url in ("robot:9090", "ws://robot:99999", "ws://robot/\0"):
            with pytest.raises(sp.SionnaPartialError, match="give for example ws://robot:9090"):
                Rosbridge(url, Topics(), {})


@pytest.mark.usefixtures("command_line")
class TestCommand:
    def test_recording(self, tmp_path: Path) -> None:
        path = write_bag(tmp_path / "drive_mcap", [("/map", 0.0, Messages(2).grid(CELLS, (0.0, 0.0, 0.0), 1.0))])
        out = tmp_path / "out"
        result = CliRunner().invoke(cli.app, ["live", *LIVE, "--bag", str(path), "--rate", "0", "--out", str(out)])
        assert result.exit_code == 0, result.output
        assert [line.partition(" after")[0] for line in result.stdout.splitlines()] == [
            "map 1, tx: coarse",
            "map 1, tx: final",
            f"wrote {out / 'tx.nc'}",
        ]
        expected = sp.predict_map(sp.importers.map_from_bag(path), (1.5, 1.5, 1.5), spacing_m=0.25)
        assert sp.load_coverage(out / "tx.nc").equals(expected)

    def test_a_transmitter_is_located_at_the_end_of_a_recording(self, tmp_path: Path) -> None:
        make, cells = Messages(2), np.pad(np.zeros((10, 12), dtype=int), 1, constant_values=100)
        rows = [("/map", 0.0, make.grid(cells, (0.0, 0.0, 0.0)))]
        for number, x in enumerate((1.2, 2.3, 3.4, 4.6, 5.2, 6.1), 1):
            rows.append(("/tf", float(number), make.transform(number, "map", "base_link", x, 1.3, 0.0)))
            rows.append(("/rssi", number + 0.1, make.power(-30.0 - 4.0 * abs(x - 5.0))))
        bag, options = write_bag(tmp_path / "drive_mcap", rows), ["--frequency", "5.2GHz", "--spacing", "0.5"]
        result = CliRunner().invoke(
            cli.app, ["live", "--power", "/rssi", *options, "--bag", str(bag), "--rate", "0", "--out", str(tmp_path)]
        )
        assert result.exit_code == 0, result.output
        final, found, _ = result.stdout.splitlines()
        assert final.startswith("map 1, tx: final after")
        x_m = re.fullmatch(r"tx: at \((.*), .*\) m, .* m2 hold 90 %", found)
        assert x_m is not None
        assert float(x_m[1]) == pytest.approx(5.0, abs=1.5)
        assert "p_transmitter" in sp.load_coverage(tmp_path / "tx.nc")

    def test_refused(self, tmp_path: Path) -> None:
        result = CliRunner().invoke(cli.app, ["live", *LIVE, "--name", "a", "--name", "b"])
        assert (result.exit_code, "2 --name for 1 --tx" in result.stderr) == (2, True)
        for words, line in (
            (LIVE[:-2], "--frequency is missing: give for example 5.2GHz, or a --connection with it."),
            (LIVE[-2:], "--tx is missing: give X Y Z, or --power, --key-values or --connection."),
        ):
            result = CliRunner().invoke(cli.app, ["live", *words])
            assert (result.exit_code, line in " ".join(result.stderr.split())) == (2, True)
