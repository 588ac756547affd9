"""LiveCoverage: newest map first, coarse and then fine, and nothing that a robot sends ends it."""

import logging
import math
import re
from pathlib import Path
from types import SimpleNamespace as Fields
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import sionna_partial as sp
from sionna_partial import cli
from sionna_partial.errors import SettingsError
from sionna_partial.live import topics
from sionna_partial.live.coverage import LiveGrid, LiveViews
from sionna_partial.live.topics import Listener, Topics

ROOM = [[100, 100, 100, 100, 100], [100, 0, 0, 0, -1], [100, 0, 0, 0, -1], [100, 100, 100, 100, 100]]
TX = (1.5, 1.5, 1.5)


def message(cells: Any = ROOM, *, yaw: float = 0.0, at: tuple[float, float] = (0.0, 0.0), **header: Any) -> Fields:
    data = np.array(cells)
    turn = Fields(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    origin = Fields(position=Fields(x=at[0], y=at[1], z=0.0), orientation=turn)
    info = Fields(width=data.shape[1], height=data.shape[0], resolution=1.0, origin=origin)
    stamp = Fields(sec=header.get("sec", 0), nanosec=0)
    return Fields(header=Fields(stamp=stamp, frame_id=header.get("frame", "map")), info=info, data=data.ravel())


class Heard(list[Any]):
    def __init__(self, tx: Any = TX, **settings: Any) -> None:
        self.live = sp.LiveCoverage(tx, self.append, sp.LiveSettings(**{"spacing_m": 0.2, **settings}))

    def step(self) -> list[tuple[int, bool]]:
        self.clear()
        self.live.step()
        return [(each.map_number, each.is_final) for each in self if isinstance(each, LiveGrid)]


def grown(cells: Any = ROOM) -> list[list[int]]:
    return [[100 if value == -1 else value for value in row] for row in cells]


class TestOrder:
    def test_coarse_then_fine_as_predict_map(self) -> None:
        heard = Heard()
        heard.live.on_map(message())
        assert heard.step() == [(1, False), (1, True)]
        assert heard[0].coverage.attrs["spacing_m"] == 0.8
        expected = sp.predict_map(sp.map_from_occupancy(message()), TX, spacing_m=0.2)
        assert heard[-1].coverage.identical(expected)
        assert heard.step() == []
        heard.live.on_map(message(sec=6))
        assert heard.step() == []

    def test_newer_map_comes_before_a_fine_answer_but_not_forever(self) -> None:
        heard, rooms = Heard(), [ROOM, grown(), ROOM, grown()]
        heard.live.on_map(message(rooms[0]))
        published = heard.live._publish

        def publish(answer: LiveGrid) -> None:  # while the coarse answer is computed the next map comes
            published(answer)
            if not answer.is_final and answer.map_number < len(rooms):
                heard.live.on_map(message(rooms[answer.map_number]))

        heard.live._publish = publish  # type: ignore[assignment]
        steps = [heard.step() for _ in rooms]
        assert steps == [[(1, False)], [(2, False), (2, True)], [(3, False)], [(4, False), (4, True)]]


class TestMaps:
    def test_costs_of_turned_maps_are_those_at_the_cells(self) -> None:
        yaw = -2.5
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        heard = Heard((*turn @ TX[:2], 1.5), threshold_db=-62.0, max_cost=100)
        heard.live.on_map(message(grown(), yaw=yaw))
        heard.step()
        p_above = heard[-1].coverage.radio.probability_above(-62.0)
        for row, column in np.argwhere(np.array(grown()) == 0):
            x, y = turn @ (column + 0.5, row + 0.5)
            expected = 100.0 * (1.0 - float(p_above.sel(x=x, y=y, method="nearest")))
            at_transmitter = bool(np.isnan(expected))  # where the nearest receiver counts
            assert at_transmitter or heard[-1].cost[row, column] == pytest.approx(expected, abs=0.51)
        costs = heard[-1].cost[heard[-1].cost >= 0]
        assert costs.min() < 20
        assert costs.max() == 100

    def test_update(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard()
        update = Fields(header=message().header, x=4, y=1, width=1, height=2, data=[100, 100])
        heard.live.on_map_update(update)
        heard.live.on_map(message())
        heard.live.on_map_update(update)
        assert heard.step() == [(2, False), (2, True)]
        assert heard[-1].coverage.attrs["map_complete"] == 1
        for faulty in ({"x": 5}, {"data": [100]}, {"data": [65636, 65636]}, {"data": [0.5, 0.5]}):
            heard.live.on_map_update(Fields(**{**vars(update), **faulty}))
        heard.live.on_map_update(Fields())
        assert heard.step() == []
        assert "no map has come before it" in caplog.text
        assert "1 x 2 cells at (5, 1) are not on the map of 5 x 4 cells" in caplog.text
        assert "data holds 65636" in caplog.text
        assert "data has dtype float64" in caplog.text

    def test_refused_by_name_and_a_clock_that_starts_again(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard()
        heard.live.on_map(message(sec=100))
        heard.step()
        for faulty, line in (
            (message(frame="odom"), "frame_id = 'odom': the transmitters are given in 'map'"),
            (message(sec=99), "it is 1.00 s older than the last one"),
            (message(grown(), sec=10**300), "is no time"),
            (message([[100, 7, 120]]), "data holds 120"),
            (message(yaw=math.nan), "is not level"),
            (Fields(**{**vars(message(grown())), "data": [0] * 7}), "7 values for 4 x 5 cells"),
            (None, "data is no OccupancyGrid"),
        ):
            heard.live.on_map(faulty)
            assert heard.step() == []
            assert line in caplog.text
        heard.live.on_map(message(grown(), sec=3))
        assert heard.step() == [(2, False), (2, True)]

    def test_a_failure_does_not_end_it(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard()
        published = heard.live._publish
        heard.live._publish = lambda answer: published(answer.lost)  # type: ignore[union-attr]
        heard.live.on_map(message())
        assert heard.step() == []
        assert "map for tx not answered: this failed (AttributeError" in caplog.text
        heard.live._publish = published
        heard.live.on_map(message(grown()))
        assert heard.step() == [(2, False), (2, True)]


class TestTransmitters:
    def test_by_name(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard({"desk": TX, "door": (3.4, 2.4, 2.0), "far": (90.0, 1.0, 1.0)})
        heard.live.on_map(message())
        heard.step()
        assert [each.name for each in heard] == ["desk", "door"] * 2
        assert "map for far not answered" in caplog.text

    def test_refused(self) -> None:
        for tx in ((1.0, math.nan, 1.0), {}, {"a b": TX}, "here"):
            with pytest.raises(sp.SionnaPartialError, match="tx"):
                sp.LiveCoverage(tx, print)
        with pytest.raises(SettingsError, match=r"powers\['/rssi'\] = 'attic' is not allowed: name one of the"):
            Listener(Heard().live, Topics(powers={"/rssi": "attic"}))

    def test_powers(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard(refresh_s=0.1)
        heard.live.on_power(-60.0, 1.0)
        heard.live.on_map(message(grown()))
        heard.step()
        for faulty in ((math.nan, 1.0, 1.0), (None, 1.0, 1.0)):
            heard.live.on_pose(*faulty)
        heard.live.on_pose(3.2, 2.2, 10.0)
        heard.live.on_power(math.nan, 10.0)
        heard.live.on_power(-60.0, 10.0, "other")
        heard.live.on_power(-60.0, 99.0)
        heard.live._stepped_s = -math.inf
        assert heard.step() == []
        heard.live.on_power(-60.0, 10.5)
        assert heard.step() == [(1, True)]
        assert heard[-1].coverage.attrs["measured_links"] == 1
        heard.live.on_pose(*TX[:2], 20.0)
        heard.live.on_power(-20.0, 20.0)  # at the transmitter itself
        heard.live._stepped_s = -math.inf
        assert heard.step() == [(1, True)]
        assert heard[-1].coverage.attrs["measured_links"] == 1
        assert "are not used" not in caplog.text
        for line in ("the robot's position is not known", "is no position", "the transmitters are tx"):
            assert line in caplog.text


@pytest.mark.usefixtures("command_line")
def test_the_files_for_nav2_name_what_is_published() -> None:
    nav2 = Path(__file__).parents[1] / "examples" / "nav2"
    costmap = yaml.safe_load((nav2 / "nav2_params.yaml").read_text("utf-8"))["global_costmap"]["global_costmap"]
    displays = yaml.safe_load((nav2 / "radio.rviz").read_text("utf-8"))["Visualization Manager"]["Displays"]
    shown = {display["Topic"]["Value"] for display in displays}
    assert {*Topics().published({"tx": None}), "/map"} <= shown
    assert costmap["ros__parameters"]["use_maximum"]
    assert costmap["ros__parameters"]["radio_layer"]["map_topic"] in shown
    named = re.findall(r'"(--[a-z-]+)"', (nav2 / "radio.launch.py").read_text("utf-8"))
    options = CliRunner().invoke(cli.app, ["live", "--help"]).output
    assert named
    assert [option for option in named if option not in options] == []


def test_unknown_cells_have_their_own_grid_and_costs_are_no_obstacles() -> None:
    partial = sp.load_map(Path(__file__).parents[1] / "scenes" / "apartment/step100/map.yaml")
    heard = Heard((7.0, 9.8, 1.5), spacing_m=1.0, threshold_db=-80.0)
    percent = np.array([0, 100, -1])[partial.state]
    sent = message(percent, at=partial.origin_m)
    sent.info.resolution = partial.resolution_m
    heard.live.on_map(sent)
    heard.step()
    grid = heard[-1]
    assert (grid.cost[percent != 0] == -1).all()
    assert (grid.unknown_cost[percent != -1] == -1).all()
    assert grid.cost.max() == grid.unknown_cost.max() == 98  # nav2 reads 99 and 100 as obstacles
    assert len({*grid.cost.ravel().tolist()}) > 10
    assert (grid.unknown_cost >= 0).sum() > 0.9 * (percent == -1).sum()
    assert list(Topics(unknown=True).messages(grid)) == ["/radio/tx", "/radio/tx/unknown"]
    assert list(Topics().messages(grid)) == ["/radio/tx"]
    assert Topics(unknown=True).published({"tx": None}).keys() >= {"/radio/tx", "/radio/tx/unknown"}


class TestChangedTransmitters:
    def test_added_moved_and_removed(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard()
        listener = Listener(heard.live, Topics())
        listener.take("/map", message(grown()))
        heard.step()
        for key, value in [("door", "3.5 2.5"), ("tx", "2.5 1.5 1.5"), ("", "1 1"), ("door", "1 2 3 4"), ("wall", "")]:
            listener.take("/radio/transmitters", Fields(key=key, value=value))
        for line in ("tx has the name ''", "tx door = [1.0, 2.0, 3.0, 4.0] is no position", "'wall' is not known"):
            assert line in caplog.text
        assert heard.step() == [(1, False)] * 2 + [(1, True)] * 2
        final = {each.name: each.coverage for each in heard if each.is_final}
        assert final["tx"].attrs["transmitter_m"].tolist() == [2.5, 1.5, 1.5]
        assert final["door"].attrs["transmitter_m"].tolist() == [3.5, 2.5, 1.5]
        heard.live.on_pose(1.5, 2.5, 0.0)
        heard.live.on_power(-50.0, 0.1, "tx")
        listener.take("/radio/transmitters", Fields(key="tx", value=""))
        heard.step()
        assert [(each.name, each.is_final) for each in heard] == [("tx", True), ("door", False), ("door", True)]
        assert (heard[0].cost == -1).all()
        assert heard.live._powers == {"door": {}}
        listener.take("/radio/transmitters", Fields(key="door", value=""))
        heard.live.request_views()
        heard.step()
        assert [each.name for each in heard] == ["door"]

    def test_an_answer_for_the_old_position_is_not_published(self) -> None:
        heard = Heard()
        heard.live.on_map(message())
        published = heard.live._publish

        def publish(answer: LiveGrid) -> None:
            published(answer)
            if len(heard) == 1:
                heard.live.on_transmitter("tx", (2.5, 2.5, 1.5))

        heard.live._publish = publish  # type: ignore[assignment]
        assert heard.step() == [(1, False)]
        assert heard.step() == [(1, False), (1, True)]
        assert heard[-1].coverage.attrs["transmitter_m"].tolist() == [2.5, 2.5, 1.5]


class TestListener:
    @staticmethod
    def transform(parent: str, child: str, x: float, yaw: float = 0.0) -> Fields:
        turn = Fields(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        transform = Fields(translation=Fields(x=x, y=0.0, z=0.0), rotation=turn)
        return Fields(header=Fields(frame_id=parent), child_frame_id=child, transform=transform)

    def test_pose_from_transforms(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard()
        listener = Listener(heard.live, Topics())
        listener.take("/map", message())
        links = [self.transform("/map", "odom", 2.0, math.pi / 2), self.transform("odom", "base_link", 1.0)]
        listener.take("/tf_static", Fields(transforms=links[:1]))
        listener.take("/tf", Fields(transforms=links[1:]), 7.0)
        assert heard.live._pose == pytest.approx((2.0, 1.0, 7.0))
        cycle = [self.transform("base_link", "odom", math.inf), self.transform("base_link", "odom", 0.0)]
        for each in cycle:
            listener.take("/tf", Fields(transforms=[each]))
        listener.take("/tf", Fields())
        listener.take("/tf", Fields(transforms=[self.transform("base_link", "wheel", 0.1)]), 9.0)  # not in the chain
        assert heard.live._pose[2] == 7.0  # type: ignore[index]
        assert "is not finite" in caplog.text

    def test_any_number_of_other_frames(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Others come before the frames of the robot, between them, or after them; few of them are kept."""
        monkeypatch.setattr(topics, "MOST_FRAMES", 10)
        others = [Fields(transforms=[self.transform("map", f"other{number}", 1.0)]) for number in range(25)]
        for topic, when in (("/tf", 0), ("/tf_static", 0), ("/tf", 1), ("/tf", 2), ("/tf_static", 2)):
            live = Heard().live
            listener = Listener(live, Topics(robot_frame="/base_link"))
            listener.take("/map", message())
            messages = [
                ("/tf_static", Fields(transforms=[self.transform("map", "odom", 2.0)])),
                ("/tf", Fields(transforms=[self.transform("odom", "base_link", 1.0)])),
            ]
            messages[when:when] = [(topic, other) for other in others]
            for at, each in enumerate([*messages, messages[-1]]):
                listener.take(*each, float(at))
            listener.take("/tf", Fields(transforms=[self.transform("odom", "base_link", 1.5)]), 99.0)
            assert live._pose == pytest.approx((3.5, 0.0, 99.0))
            assert len(listener._frames) <= 13

    def test_powers_and_views(self) -> None:
        heard = Heard({"desk": (5.5, 5.5, 1.5), "door": (9.4, 9.4, 2.0)})
        listener = Listener(heard.live, Topics(powers={"/rssi": "door"}, key_values="/wifi"))
        listener.take("/map", message(np.kron(ROOM, np.ones((4, 4), dtype=int))))
        heard.step()
        heard.live.on_pose(6.5, 6.5, 1.0)
        listener.take("/rssi", Fields(data=-60.0), 1.0)
        listener.take("/wifi", Fields(key="desk", value="-50.5"), 1.0)
        listener.take("/wifi", Fields(key="desk", value="loud"), 1.0)
        powers = {name: next(iter(each.values()))[2] for name, each in heard.live._powers.items()}
        assert powers == {"desk": -50.5, "door": -60.0}
        listener.take("/radio/request_views", Fields())
        heard.live.on_pose(6.5, 3.9, 1.0)  # in the wall by an error of the robot's
        heard.step()
        assert isinstance(heard[0], LiveViews)
        assert [*heard[0].message()["poses"][0]] == ["position", "orientation"]
        assert [*listener.topics.messages(heard[0])] == ["/radio/next_views"]


def test_lines_are_not_repeated(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    heard = Heard()
    for _ in range(5):
        heard.live.on_pose(math.nan, 0.0, 0.0)
        heard.live.on_map(None)
    assert len(caplog.records) == 2
