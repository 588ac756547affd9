"""Grids beside nav2, by the rules of its sources: costmaps that grids resize, filters, and required parameters."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from nav2_rules import LETHAL, NO_INFORMATION, Costmap, KeepoutFilter, StaticLayer
from test_live import Heard, message
from typer.testing import CliRunner

from sionna_partial import cli
from sionna_partial.apps.live.answers import LiveGrid
from sionna_partial.apps.live.topics import Topics

NAV2 = Path(__file__).parents[1] / "examples" / "nav2"
ROOM = [[100, 100, 100, 100], [100, 0, 0, -1], [100, 0, 0, -1], [100, 100, 100, 100]]
GROWN = [[100] * 6, [100, 0, 0, 0, 0, 100], [100, 0, 0, 0, 0, 100], [100, 0, 0, 0, 0, -1], [100] * 6]


def as_dict(sent: Any) -> dict[str, Any]:
    """Return a map message as nav2 gets it."""
    position = sent.info.origin.position
    info = {"width": sent.info.width, "height": sent.info.height, "resolution": sent.info.resolution}
    return {"info": info | {"origin": {"position": {"x": position.x, "y": position.y}}}, "data": sent.data}


class Robot:
    """A robot whose SLAM map grows while the first grid is computed, and nav2 beside it."""

    def __init__(self, kind: type[StaticLayer] | type[KeepoutFilter]) -> None:
        self.costmap, self.grids = Costmap(kind), list[LiveGrid]()
        self.heard = Heard(threshold_db=-62.0, max_cost=98)
        self.heard.live._publish = self.publish  # type: ignore[assignment]
        self.maps = [message(ROOM), message(GROWN, at=(0.0, -1.0), sec=1)]

    def send_map(self) -> None:
        sent = self.maps.pop(0)
        self.costmap.static.take(as_dict(sent))
        self.costmap.update()
        self.heard.live.on_map(sent)

    def publish(self, grid: Any) -> None:
        self.grids.append(grid)
        self.costmap.radio.take(grid.message())
        self.costmap.update()

    def drive(self, *, until_final: bool) -> None:
        self.send_map()
        receivers = self.heard.live._receivers

        def late(*given: Any) -> Any:  # the next map comes when a grid has been computed, and is not published yet
            if self.maps and (given[-1] is None) == until_final:
                self.send_map()
            return receivers(*given)

        self.heard.live._receivers = late  # type: ignore[method-assign]
        while self.heard.live.step():
            pass


@pytest.mark.parametrize("until_final", [False, True])
@pytest.mark.parametrize("kind", [StaticLayer, KeepoutFilter])
def test_a_late_grid_never_resizes_the_costmap(
    kind: type[StaticLayer] | type[KeepoutFilter], until_final: bool
) -> None:
    robot = Robot(kind)
    robot.drive(until_final=until_final)
    late = robot.grids[int(until_final)]
    assert (late.map_number, late.is_final, late.cost.shape) == (1, until_final, (5, 6))
    assert late.header["stamp"]["sec"] == 1
    assert [grid.map_number for grid in robot.grids[-2:]] == [2, 2]
    costs = robot.costmap.update()
    percent = np.array(GROWN)
    assert costs.shape == percent.shape
    assert (costs[percent == 100] == LETHAL).all()
    assert (costs[percent == -1] == NO_INFORMATION).all()
    free = costs[percent == 0]
    assert free.max() < 253
    assert free.max() > 0


def test_the_rules_find_an_old_grid_in_a_static_layer_but_a_filter_takes_it() -> None:
    """As it was before: a grid of the first map that comes after the second wipes the walls."""
    for kind, walls in ((StaticLayer, False), (KeepoutFilter, True)):
        heard, costmap = Heard(), Costmap(kind)
        costmap.static.take(as_dict(message(ROOM)))
        heard.live.on_map(message(ROOM))
        heard.step()
        costmap.static.take(as_dict(message(GROWN, at=(0.0, -1.0))))
        costmap.update()
        costmap.radio.take(heard[-1].message())
        assert bool((costmap.update() == LETHAL).sum() == (np.array(GROWN) == 100).sum()) == walls


def test_the_filter_is_told_its_topic_once() -> None:
    heard = Heard()
    heard.live.on_map(message(ROOM))
    heard.step()
    sent: dict[str, Any] = {}
    for grid in heard:
        sent |= (messages := Topics().messages(grid, sent))
        assert ("/radio/tx/filter_info" in messages) == (grid is heard[0])
    kind, info = sent["/radio/tx/filter_info"]
    assert kind == "nav2_msgs/msg/CostmapFilterInfo"
    assert (info["type"], info["filter_mask_topic"], info["base"], info["multiplier"]) == (0, "/radio/tx", 0.0, 1.0)


REQUIRED = {
    "controller_server": ["FollowPath.critics"],
    "collision_monitor": ["polygons", "Stop.type", "Stop.action_type", "observation_sources"],
    "docking_server": ["dock_plugins", "dock.plugin"],
    "global_costmap.global_costmap": ["filters", "radio_filter.plugin", "radio_filter.filter_info_topic"],
}
"""Parameters without default of the nodes that nav2_bringup's navigation_launch.py starts, by nav2's sources."""

NAV2_PARAMETERS = {
    "controller_server": {"controller_plugins": ["FollowPath"], "FollowPath": {"critics": ["PathAlign"]}},
    "collision_monitor": {
        "polygons": ["Stop"],
        "Stop": {"type": "circle", "action_type": "stop"},
        "observation_sources": ["scan"],
    },
    "docking_server": {"dock_plugins": ["dock"], "dock": {"plugin": "opennav_docking::SimpleChargingDock"}},
    "global_costmap.global_costmap": {
        "plugins": ["static_layer", "inflation_layer"],
        "filters": ["keepout_filter"],
        "keepout_filter": {"plugin": "nav2_costmap_2d::KeepoutFilter", "filter_info_topic": "info"},
    },
}
"""A small stand-in for nav2_bringup's nav2_params.yaml."""


def missing(parameters: dict[str, Any]) -> list[str]:
    """Return the required parameters that are not there."""
    found = []
    for node, names in REQUIRED.items():
        of_node = parameters
        for part in (*node.split("."), "ros__parameters"):
            of_node = of_node.get(part, {})
        for name in names:
            value: Any = of_node
            for part in name.split("."):
                value = value.get(part, {})
            if not value:
                found.append(f"{node}.{name}")
    return found


class Action(SimpleNamespace):
    """An action of `launch`: it keeps its arguments."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(given=given, **named)

    def perform(self, context: dict[str, str]) -> str:
        return context.get(self.given[0], "")


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The launch file, with stand-ins for the packages of ROS."""
    (tmp_path / "params").mkdir()
    nodes: dict[str, Any] = {}
    for node, parameters in NAV2_PARAMETERS.items():
        inner = nodes
        for part in node.split("."):
            inner = inner.setdefault(part, {})
        inner["ros__parameters"] = parameters
    (tmp_path / "params" / "nav2_params.yaml").write_text(yaml.safe_dump(nodes), "utf-8")
    names = ("LaunchContext", "LaunchDescription", "PythonLaunchDescriptionSource", "LaunchConfiguration", "Node")
    names += ("DeclareLaunchArgument", "ExecuteProcess", "IncludeLaunchDescription", "OpaqueFunction")
    for module in ("launch", "launch.actions", "launch.launch_description_sources", "launch.substitutions"):
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
    for module in ("launch_ros", "launch_ros.actions", "ament_index_python", "ament_index_python.packages"):
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
    for module in ("launch", "launch.actions", "launch.launch_description_sources", "launch.substitutions"):
        for name in names:
            setattr(sys.modules[module], name, Action)
    sys.modules["launch_ros.actions"].Node = Action  # type: ignore[attr-defined]
    sys.modules["ament_index_python.packages"].get_package_share_directory = lambda _: str(tmp_path)  # type: ignore[attr-defined]
    spec = importlib.util.spec_from_file_location("radio_launch", NAV2 / "radio.launch.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class TestLaunch:
    def test_the_merged_parameters_are_complete(self, launch_file: Any) -> None:
        live, navigation, _ = launch_file.actions({"frequency": "5.2GHz", "transmitter": "3.0 4.0 1.5"})
        parameters = yaml.safe_load(Path(dict(navigation.launch_arguments)["params_file"]).read_text("utf-8"))
        assert missing(parameters) == []
        costmap = parameters["global_costmap"]["global_costmap"]["ros__parameters"]
        assert costmap["filters"] == ["keepout_filter", "radio_filter"]
        assert costmap["plugins"] == ["static_layer", "inflation_layer"]
        fragment = yaml.safe_load((NAV2 / "nav2_params.yaml").read_text("utf-8"))
        assert len(missing(fragment)) == 7  # the fragment alone starts nothing
        assert live.cmd[2:] == ["--name", "tx", "--tx", "3.0", "4.0", "1.5", "--frequency", "5.2GHz"]

    def test_a_frequency_or_a_connection(self, launch_file: Any) -> None:
        assert launch_file.actions({"connection": "/connection"})[0].cmd[-2:] == ["--connection", "/connection"]
        with pytest.raises(RuntimeError, match=r"frequency is missing: give frequency:=5\.2GHz, or a conn"):
            launch_file.actions({"transmitter": "1 2"})
        assert len(launch_file.generate_launch_description().given[0]) == len(launch_file.OPTIONS) + 3

    @pytest.mark.usefixtures("command_line")
    def test_options_and_topics_are_those_of_the_command(self, launch_file: Any) -> None:
        options = CliRunner().invoke(cli.app, ["live", "--help"]).output
        assert [option for option, _ in launch_file.OPTIONS.values() if option not in options] == []
        displays = yaml.safe_load((NAV2 / "radio.rviz").read_text("utf-8"))["Visualization Manager"]["Displays"]
        shown = {display["Topic"]["Value"] for display in displays}
        published = {topic for topic in Topics().published({"tx": None}) if not topic.endswith("filter_info")}
        assert published | {"/map"} <= shown
        text = (NAV2 / "nav2_params.yaml").read_text("utf-8")
        assert re.findall(r"filter_info_topic: (.*)", text) == ["/radio/tx/filter_info"]
