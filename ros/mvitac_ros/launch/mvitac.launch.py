"""ros2 launch mvitac_ros mvitac.launch.py export:=exports/first vision:=/camera/image_raw touch:=/gel/image_raw"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {"export": None, "vision": "", "touch": "", "background": "", "rate": "30.0", "always": "false"}
KINDS = {"rate": float, "always": bool}


def generate_launch_description():
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=KINDS.get(name, str)) for name in ARGUMENTS
    }
    node = Node(package="mvitac_ros", executable="node", name="mvitac", output="screen", parameters=[parameters])
    return LaunchDescription(
        [*(DeclareLaunchArgument(name, default_value=value) for name, value in ARGUMENTS.items()), node]
    )
