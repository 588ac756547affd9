"""LiveCoverage: newest map first, coarse and then fine, and nothing that a robot sends ends it."""

import logging
import math
from pathlib import Path
from types import SimpleNamespace as Fields
from typing import Any

import numpy as np
import pytest
from PIL import Image

import sionna_partial as sp
from sionna_partial.apps.live import topics
from sionna_partial.apps.live.answers import LiveGrid, LiveTransmitter, LiveViews
from sionna_partial.apps.live.coverage import LiveCoverage
from sionna_partial.apps.live.incoming import LiveSettings
from sionna_partial.apps.live.topics import Listener, Topics
from sionna_partial.errors import SettingsError

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
        self.live = LiveCoverage(tx, self.append, LiveSettings(**{"spacing_m": 0.2, **settings}))

    def step(self) -> list[tuple[int, bool]]:
        self.clear()
        self.live.step()
        return [(each.map_number, each.is_final) for each in self if isinstance(each, LiveGrid)]


def grown(cells: Any = ROOM) -> list[list[int]]:
    return [[100 if value == -1 else value for value in row] for row in cells]


class TestOrder:
    def test_coarse_then_fine_as_predict_map(self, tmp_path: Path) -> None:
        heard = Heard()
        heard.live.on_map(message())
        assert heard.step() == [(1, False), (1, True)]
        assert heard[0].coverage.attrs["spacing_m"] == 0.8
        expected = sp.predict_map(sp.importers.map_from_occupancy(message()), TX, spacing_m=0.2)
        assert heard[-1].coverage.identical(expected)  # every receiver is near a free cell
        sp.save_coverage(expected, tmp_path / "cost.yaml", scene=sp.importers.map_from_occupancy(message()))
        percent = np.flipud(np.asarray(Image.open(tmp_path / "cost.pgm"))).astype(int)
        np.testing.assert_array_equal(np.where(percent == 255, -1, percent), heard[-1].cost)
        assert heard.step() == []
        heard.live.on_map(message(sec=6))
        assert heard.step() == []

    def test_newer_map_comes_before_a_fine_answer_but_not_forever(self) -> None:
        """The first final grid is not interrupted either: the robot has none yet."""
        heard, rooms = Heard(), [ROOM, grown(), ROOM, grown()]
        heard.live.on_map(message(rooms[0]))
        published = heard.live._publish

        def publish(answer: LiveGrid) -> None:  # while the coarse answer is computed the next map comes
            published(answer)
            if not answer.is_final and answer.map_number < len(rooms):
                heard.live.on_map(message(rooms[answer.map_number]))

        heard.live._publish = publish  # type: ignore[assignment]
        steps = [heard.step() for _ in rooms]
        assert steps == [[(1, False), (1, True)], [(2, False)], [(3, False), (3, True)], [(4, False), (4, True)]]


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
    def test_outside_the_map_that_slam_has_so_far(self) -> None:
        """Outside is unknown: the grid is that of a map with unknown cells up to the transmitter."""
        heard, tx = Heard(), (8.5, 1.5, 1.5)
        heard.live.on_map(message())
        assert heard.step() == [(1, False), (1, True)]
        heard.live.on_transmitter("tx", tx)
        assert heard.step() == [(1, False), (1, True)]
        assert heard[-1].cost.shape == np.shape(ROOM)
        wide = sp.importers.map_from_occupancy(
            message(np.pad(ROOM, ((1, 1), (1, 9)), constant_values=-1), at=(-1.0, -1.0))
        )
        expected = sp.predict_map(wide, tx, spacing_m=0.2, area_m=(0.0, 0.0, 5.0, 4.0))
        for name in ("p_los", "gain_mean_db", "unobserved_distance_m"):
            np.testing.assert_allclose(heard[-1].coverage[name], expected[name], atol=1e-3, err_msg=name)
        assert float(heard[-1].coverage["unobserved_distance_m"].max()) > 4.0
        with pytest.raises(SettingsError, match=r"area_m = .* is not allowed: give x and y of two corners on the map"):
            sp.predict_map(wide, tx, spacing_m=0.2, area_m=(0.0, 0.0, 50.0, 4.0))

    @pytest.mark.parametrize(("frequency_hz", "threshold_db"), [(28e9, -100.0), (5.2e9, -80.0)])
    def test_coarse_costs_are_upper_bounds(self, frequency_hz: float, threshold_db: float) -> None:
        partial = sp.load_map(Path(__file__).parents[1] / "scenes" / "apartment/step100/map.yaml")
        grids: list[Any] = []
        settings = LiveSettings(spacing_m=0.3, threshold_db=threshold_db)
        trace_settings = sp.TraceSettings(frequency_hz=frequency_hz)
        live = LiveCoverage((7.0, 9.8, 1.5), grids.append, settings, trace_settings=trace_settings)
        sent = message(np.array([0, 100, -1])[partial.state], at=partial.origin_m)
        sent.info.resolution = partial.resolution_m
        live.on_map(sent)
        live.step()
        coarse, final = (grid.cost.astype(int) for grid in grids)
        assert ((coarse >= 0) == (final >= 0)).mean() > 0.999
        assert (final - coarse)[(final >= 0) & (coarse >= 0)].max() <= 4
        assert coarse[final >= 0].min() < 50  # they still tell something

    def test_by_name(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard({"desk": TX, "door": (3.4, 2.4, 2.0), "far": (290.0, 1.0, 1.0)})
        heard.live.on_map(message())
        heard.step()
        assert [each.name for each in heard] == ["desk", "door"] * 2
        assert "tx far is 285 m outside the map, more than 200 m: check its unit and its frame" in caplog.text

    def test_refused(self) -> None:
        for tx in ((1.0, math.nan, 1.0), {"a b": TX}, "here"):
            with pytest.raises(sp.SionnaPartialError, match="tx"):
                LiveCoverage(tx, print)
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


def test_unknown_cells_have_their_own_grid_and_costs_are_no_obstacles() -> None:
    partial = sp.load_map(Path(__file__).parents[1] / "scenes" / "apartment/step100/map.yaml")
    heard = Heard((7.0, 9.8, 1.5), spacing_m=1.0, threshold_db=-80.0, every_unknown=True)
    percent = np.array([0, 100, -1])[partial.state]
    sent = message(percent, at=partial.origin_m)
    sent.info.resolution = partial.resolution_m
    heard.live.on_map(sent)
    heard.step()
    grid = heard[-1]
    assert (grid.cost[percent != 0] == -1).all()
    assert (grid.unknown_cost[percent != -1] == -1).all()
    assert grid.cost.max() == grid.unknown_cost.max() == 98  # nav2 reads 99 and 100 as obstacles
    assert len({*grid.cost.ravel().tolist()}) > 5
    assert (grid.unknown_cost >= 0).sum() > 0.9 * (percent == -1).sum()
    assert [*Topics(unknown=True).messages(grid)][:2] == ["/radio/tx", "/radio/tx/unknown"]
    assert list(Topics().messages(grid)) == ["/radio/tx", "/radio/tx/filter_info"]
    assert Topics(unknown=True).published({"tx": None}).keys() >= {"/radio/tx", "/radio/tx/unknown"}
    near = Heard((7.0, 9.8, 1.5), spacing_m=1.0, threshold_db=-80.0)
    near.live.on_map(sent)
    near.step()
    np.testing.assert_array_equal(near[-1].cost, grid.cost)
    predicted, all_valid = (each.coverage["valid"].to_numpy() for each in (near[-1], grid))
    assert predicted.sum() < 0.9 * all_valid.sum()


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
        heard.live.on_map(message(grown()))
        heard.step()
        heard.live.on_map(message())
        published = heard.live._publish

        def publish(answer: LiveGrid) -> None:
            published(answer)
            if len(heard) == 1:
                heard.live.on_transmitter("tx", (2.5, 2.5, 1.5))

        heard.live._publish = publish  # type: ignore[assignment]
        assert heard.step() == [(2, False)]
        assert heard.step() == [(2, False), (2, True)]
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


def connection(level: int, bssid: str = "AA:00:00:00:00:01", frequency: float = 5.2) -> Fields:
    return Fields(signal_level=level, bssid=bssid, essid="home", frequency=frequency)


class TestLocated:
    def test_position_and_region_from_powers(self, caplog: pytest.LogCaptureFixture) -> None:
        heard = Heard(None, spacing_m=0.5, refresh_s=0.1)
        listener = Listener(heard.live, Topics(powers={"/rssi": None}))
        listener.take("/map", message(np.kron(grown(), np.ones((3, 3), dtype=int))))
        heard.step()
        assert not heard
        tx, free_m = (8.5, 6.5), [(3.6, 3.6), (5.1, 4.2), (7.4, 3.4), (10.2, 4.6), (4.4, 7.2), (6.6, 5.4), (9.8, 8.2)]
        for number, at in enumerate(free_m):
            heard.live.on_pose(*at, float(number))
            power_dbm = 20.0 - 61.4 - 20.0 * math.log10(math.dist(at, tx))
            listener.take("/rssi", Fields(data=power_dbm), float(number))
        heard.live._stepped_s = -math.inf
        assert heard.step() == [(1, True)]
        grid, found = heard
        assert isinstance(found, LiveTransmitter)
        assert math.dist(found.position_m[:2], tx) < 3.0
        assert grid.coverage.attrs["measured_links"] == len(free_m)
        topics = listener.topics.messages(found)
        assert {topic: kind for topic, (kind, _) in topics.items()} == {
            topic: kind
            for topic, kind in listener.topics.published(heard.live.tx_m).items()
            if topic.endswith(("position", "region"))
        }
        region = topics["/radio/tx/region"][1]
        assert {*region["data"]} == {0, 100}
        assert region["info"]["width"] * region["info"]["height"] == len(region["data"])
        variance = topics["/radio/tx/position"][1]["pose"]["covariance"][0]
        assert 0.0 < variance < 30.0

    def test_access_points_and_their_frequency_from_connections(self, caplog: pytest.LogCaptureFixture) -> None:
        live = LiveCoverage({}, print, await_frequency=True)
        listener = Listener(live, Topics(connections={"/connection": None}))
        listener.take("/map", message(grown()))
        assert not live.step()  # it waits for the frequency
        live.on_pose(1.5, 1.5, 1.0)
        for frequency, bssid in ((5.18, "AA:00:00:00:00:01"), (5180.0, "AA:00:00:00:00:02"), (2.412, "BB:00"), (0, "")):
            listener.take("/connection", connection(-60, bssid, frequency), 1.0)
        assert live._model_settings["trace_settings"].frequency_hz == pytest.approx(5.18e9)
        assert {name: len(powers) for name, powers in live._powers.items()} == {
            "ap_aa0000000001": 1,
            "ap_aa0000000002": 1,
        }
        assert "at 2.412 GHz: grids are at 5.18 GHz" in caplog.text
        assert "it has no access point or frequency" in caplog.text

    def test_a_named_one_is_not_mixed_with_others(self, caplog: pytest.LogCaptureFixture) -> None:
        live = LiveCoverage(None, print, await_frequency=True)
        listener = Listener(live, Topics(connections={"/connection": None}))
        listener.take("/map", message(grown()))
        for number in (1, 2):
            live.on_pose(1.5, float(number), 1.0)
            listener.take("/connection", connection(-60, f"AA:00:00:00:00:0{number}"), 1.0)
        assert len(live._powers["tx"]) == 1
        assert "tx is the access point AA:00:00:00:00:01" in caplog.text


def test_lines_are_not_repeated(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    heard = Heard()
    for _ in range(5):
        heard.live.on_pose(math.nan, 0.0, 0.0)
        heard.live.on_map(None)
    assert len(caplog.records) == 2
