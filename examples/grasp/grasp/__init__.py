"""Grasp planning as a ROS service and its client: the application of ``examples/listing1.launch.py``.

``sampler`` plans, ``frames`` reads recorded frames, ``messages`` carries them, ``planner`` and ``client``
are the nodes.
"""
