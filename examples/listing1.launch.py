"""First listing of the FogROS2-FT paper: a detector on two machines, its client on the robot.

``fog launch examples/listing1.launch.py --dry-run``; supply the packages yourself.
"""

from fog import CloudMachine, FogCluster, LaunchDescription, Node, SpotMachine


def generate_launch_description() -> LaunchDescription:
    detector = Node(package="detection", executable="detector")
    FogCluster(
        cloud_nodes=[detector],
        deployments=[
            CloudMachine(region="us-west-1", hardware="cpu:16"),
            SpotMachine(region="us-east-1", hardware="T4"),
        ],
    )
    return LaunchDescription([Node(package="robot", executable="robot_client")])
