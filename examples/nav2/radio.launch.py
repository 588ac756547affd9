"""Launch live radio coverage, nav2 with the costs of coverage, and RViz.

    ros2 launch examples/nav2/radio.launch.py frequency:=5.2GHz transmitter:="3.0 4.0 1.5"
    ros2 launch examples/nav2/radio.launch.py connection:=/connection   # locates the access point

SLAM and the drivers of the robot are launched elsewhere: /map, /tf and /scan have to be there.
"""

import tempfile
from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

FOLDER = Path(__file__).resolve().parent

OPTIONS = {
    "transmitter": ("--tx", "position x y z [m] in the frame of the map; located by powers if not given"),
    "frequency": ("--frequency", "carrier frequency, such as 5.2GHz; not needed with a connection"),
    "connection": ("--connection", "topic of wireless_msgs/Connection"),
    "power": ("--power", "topic of std_msgs/Float32 with received powers [dBm]"),
    "threshold": ("--threshold", "path gain above which a receiver is covered [dB]"),
}
"""Arguments that are options of `sionna-partial live`."""

OTHERS = {
    "params_file": "parameters of nav2; by default those of nav2_bringup",
    "use_sim_time": "true in a simulation",
}


def merged(parameters: Any, added: Any) -> Any:
    """Return parameters with others added: mappings and lists are joined, other values replaced."""
    if isinstance(parameters, dict) and isinstance(added, dict):
        return parameters | {key: merged(parameters.get(key), value) for key, value in added.items()}
    if isinstance(parameters, list) and isinstance(added, list):
        return parameters + [value for value in added if value not in parameters]
    return added


def merged_file(path: str) -> str:
    """Write the parameters of a file with the radio filter to a new file."""
    parts = [yaml.safe_load(Path(each).read_text("utf-8")) for each in (path, FOLDER / "nav2_params.yaml")]
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as file:
        yaml.safe_dump(merged(*parts), file)
    return file.name


def actions(context: LaunchContext) -> list[Any]:
    """Return the actions for the values of the arguments."""
    given = {name: LaunchConfiguration(name).perform(context).strip() for name in (*OPTIONS, *OTHERS)}
    if not (given["frequency"] or given["connection"]):
        raise RuntimeError("frequency is missing: give frequency:=5.2GHz, or a connection:=TOPIC that has it.")
    options = [word for name, (option, _) in OPTIONS.items() if given[name] for word in (option, *given[name].split())]
    bringup = Path(get_package_share_directory("nav2_bringup"))
    arguments = {"params_file": merged_file(given["params_file"] or str(bringup / "params/nav2_params.yaml"))}
    arguments |= {"use_sim_time": given["use_sim_time"] or "false"}
    navigation = PythonLaunchDescriptionSource(str(bringup / "launch/navigation_launch.py"))
    live = ["sionna-partial", "live", "--name", "tx", *options]
    return [
        ExecuteProcess(cmd=live, output="screen", respawn=True, respawn_delay=5.0),
        IncludeLaunchDescription(navigation, launch_arguments=arguments.items()),
        Node(package="rviz2", executable="rviz2", arguments=["-d", str(FOLDER / "radio.rviz")]),
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the description that `ros2 launch` asks for."""
    meanings = {name: meaning for name, (_, meaning) in OPTIONS.items()} | OTHERS
    arguments = [
        DeclareLaunchArgument(name, default_value="", description=meaning) for name, meaning in meanings.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=actions)])
