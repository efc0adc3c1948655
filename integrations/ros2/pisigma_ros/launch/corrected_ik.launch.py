"""Launch the node of corrected joint values, configured and activated."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

ARGUMENTS = {"host": "127.0.0.1", "port": "5006", "json_port": "5005", "joint_states_max_age": "1.0"}


def generate_launch_description():
    """Return the node, with parameters from the command line."""
    parameters = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value) for name, value in ARGUMENTS.items()),
            LifecycleNode(
                package="pisigma_ros",
                executable="corrected_ik",
                name="corrected_ik",
                namespace="",
                parameters=[parameters],
            ),
        ]
    )
