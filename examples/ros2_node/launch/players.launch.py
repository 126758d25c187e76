"""Two players, each with a node of its own."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "artefact": "folder that `hno export` wrote",
    "game": "name of the game that it must be of",
    "theta": "one type for each player, such as 2.0,4.0",
}


def generate_launch_description() -> LaunchDescription:
    """One node for each of two players; topics are player_1/state and so on."""
    given = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ARGUMENTS}
    nodes = [
        Node(
            package="hno_controller",
            executable="controller",
            name=f"controller_{player}",
            parameters=[{**given, "player": player}],
            output="screen",
        )
        for player in (1, 2)
    ]
    return LaunchDescription(
        [*(DeclareLaunchArgument(name, description=said) for name, said in ARGUMENTS.items()), *nodes]
    )
