"""Launch file of a proxy: ``ros2 launch gdp_proxy proxy.launch.py config:=/srv/robot/proxy.yaml``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description():
    """Return one node, whose parameters are the arguments of the launch."""
    arguments = {
        "config": ("/etc/gdp/proxy.yaml", "rules, keys and the device towards the switch", str),
        "await_iface": ("60.0", "seconds to wait for the device, which a switch may just be making", float),
        "check": ("false", "validate the configuration and end", bool),
        "verbose": ("false", "log decisions, too", bool),
    }
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text, _) in arguments.items()
    ]
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind) for name, (_, _, kind) in arguments.items()
    }
    node = Node(package="gdp_proxy", executable="proxy", name="gdp_proxy", output="screen", parameters=[parameters])
    return LaunchDescription([*declared, node])
