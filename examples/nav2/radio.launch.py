"""Launch live radio coverage, nav2 with a radio layer, and RViz.

    ros2 launch examples/nav2/radio.launch.py transmitter:="3.0 4.0 1.5" frequency:=5.2e9

SLAM and the drivers of the robot are launched elsewhere: /map, /tf and /scan have to be there.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

FOLDER = Path(__file__).resolve().parent

ARGUMENTS = {
    "transmitter": ("", "position x y z [m] in the frame of the map"),
    "frequency": ("28e9", "carrier frequency [Hz]"),
    "threshold": ("-100", "path gain above which a receiver is covered [dB]"),
    "params_file": (str(FOLDER / "nav2_params.yaml"), "parameters of nav2, with the radio layer"),
}


def generate_launch_description() -> LaunchDescription:
    """Return the description that `ros2 launch` asks for."""
    of = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    options = {"--tx": "transmitter", "--frequency": "frequency", "--threshold": "threshold"}
    command = ["sionna-partial", "live", *(part for option, name in options.items() for part in (option, of[name]))]
    navigation = PathJoinSubstitution([FindPackageShare("nav2_bringup"), "launch", "navigation_launch.py"])
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=meaning)
                if default
                else DeclareLaunchArgument(name, description=meaning)
                for name, (default, meaning) in ARGUMENTS.items()
            ),
            ExecuteProcess(cmd=command, output="screen", respawn=True, respawn_delay=5.0),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(navigation), launch_arguments={"params_file": of["params_file"]}.items()
            ),
            Node(package="rviz2", executable="rviz2", arguments=["-d", str(FOLDER / "radio.rviz")]),
        ]
    )
