"""Launch descriptions: the paper's Listing 1 as it stands, by ``fog launch`` or by ROS 2's own ``ros2 launch``.

``words`` is what a launch file says; ``load`` runs one; ``wish`` checks what a ``FogCluster`` asks for; ``resolve``
finds executables; ``probe`` learns what nodes offer; ``ros_action`` is the cluster as an action of ROS 2's ``launch``.
"""
