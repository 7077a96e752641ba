"""Counter replicated on two spot machines: if one fails, the other has the same count (docs/how-to/state.md).

A rented machine needs the wheel of the node, as ``echo.launch.py`` says.
"""

from fog import FogCluster, LaunchDescription, Node, SpotMachine


def generate_launch_description() -> LaunchDescription:
    counter = Node(package="fog_demo", executable="counter")
    cluster = FogCluster(
        name="counter",
        cloud_nodes=[counter],
        deployments=[SpotMachine(hardware="cpu:1"), SpotMachine(hardware="cpu:1")],
        services={"/count": {"type": "std_srvs/srv/SetBool", "state": "ordered", "state_node": "/counter"}},
    )
    return LaunchDescription([cluster])
