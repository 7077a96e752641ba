"""Grasp planner on two machines and its client on the robot, in the form of Listing 1 of the FogROS2-FT paper.

``fog launch examples/listing1.launch.py``, or ``ros2 launch examples/listing1.launch.py`` where ROS 2's launch is.

Known of the listing is its form: ``FogCluster(...)`` is created and neither returned nor assigned, its nodes are not
started on the robot, and its deployments are a machine on demand and a spot machine. The printed text itself was not
at hand: names of variables, regions, hardware and the order of its lines may differ. ``grasp`` is a package of this
project (``examples/grasp``), because the authors' planner needs the weights of a neural network.
"""

from fog import CloudMachine, FogCluster, LaunchDescription, Node, SpotMachine


def generate_launch_description() -> LaunchDescription:
    planner = Node(package="grasp", executable="planner")
    client = Node(package="grasp", executable="client", output="screen")
    FogCluster(
        cloud_nodes=[planner],
        deployments=[
            CloudMachine(region="us-west-1", hardware="cpu:16"),
            SpotMachine(region="us-west-2", hardware="cpu:16"),
        ],
    )
    return LaunchDescription([client])
