"""Launch descriptions: the paper's Listing 1 unchanged, for ``fog launch`` and for ROS 2's ``ros2 launch``.

``lazy_names`` has the names that a launch file uses; ``load`` runs a file; ``cluster_spec`` checks a ``FogCluster``;
``resolve`` finds executables; ``interface_discovery`` finds the interfaces of nodes; ``ros_action`` is the cluster as
an action of ROS 2's ``launch``.

A part of a launch file that is wrong raises ``LocalError``; the text states what was expected.
"""
