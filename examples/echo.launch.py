"""Service on two spot machines and a robot that calls it; ``scripts/fog_demo`` contains all nodes.

``fog launch examples/echo.launch.py rate:=50``

Machines of the provider ``local`` have the robot's packages. A rented machine needs wheels of the nodes, of this
package and of ROS: ``fog wheels dist scripts/fog_demo ros-jazzy-rmw-fastrtps-cpp ros-jazzy-std-msgs --build empy``.
Name the folder in ``software.wheels`` of ``fog.yaml`` (docs/reference/providers.md).
"""

from fog import DeclareLaunchArgument, FogCluster, LaunchConfiguration, LaunchDescription, Node, SpotMachine


def generate_launch_description() -> LaunchDescription:
    rate = DeclareLaunchArgument("rate", default_value="20.0", description="Calls a second.")
    cluster = FogCluster(
        name="echo",
        cloud_nodes=[Node(package="fog_demo", executable="echo")],
        deployments=[SpotMachine(hardware="cpu:1"), SpotMachine(hardware="cpu:1")],
        services={"/echo": "std_srvs/srv/SetBool"},
        idle="30min",
        budget_usd=5.0,
    )
    caller = Node(
        package="fog_demo",
        executable="caller",
        parameters=[{"rate_hz": LaunchConfiguration("rate")}],
        output="screen",
    )
    return LaunchDescription([rate, cluster, caller])
