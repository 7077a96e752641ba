"""Types of the messages that the three tasks of the FogROS papers send and get back.

Sans-I/O. The messages are those of the clients that the authors publish. Types of packages that have no wheel are
replaced by standard ones that carry the same numbers.

Source: github.com/BerkeleyAutomation: ``fogros2-examples`` (``vslam/TUTORIAL.md``: the TUM dataset freiburg1;
``mpt/mpt_ros/src/mpt_ros_client.cpp``: meshes of OMPL's "cubicles", ``MotionPlanRequest``), ``fogros-demos``
(``gqcnn-ros/nodes/gqcnn_ros_client.py``), ``gqcnn`` (``data/calib/phoxi/phoxi.intr``: 516 x 386).
"""

from __future__ import annotations

from typing import Final

IMAGE: Final = "sensor_msgs/msg/Image"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"
POSE: Final = "geometry_msgs/msg/PoseStamped"
OCTETS: Final = "std_msgs/msg/UInt8MultiArray"
NUMBERS: Final = "std_msgs/msg/Float64MultiArray"
