"""Messages of the three tasks of the FogROS papers: their types, and the number of a request in each of them.

Sans-I/O. The messages are those of the clients that the authors publish. Types of packages that have no wheel are
replaced by standard ones that carry the same numbers. The number of a request is in its messages' headers, as
``frame_id``, or in their layouts, as ``data_offset``; requests numbered 0 are greetings.

Source: github.com/BerkeleyAutomation: ``fogros2-examples`` (``vslam/TUTORIAL.md``: the TUM dataset freiburg1;
``mpt/mpt_ros/src/mpt_ros_client.cpp``: meshes of OMPL's "cubicles", ``MotionPlanRequest``), ``fogros-demos``
(``gqcnn-ros/nodes/gqcnn_ros_client.py``), ``gqcnn`` (``data/calib/phoxi/phoxi.intr``: 516 x 386).
"""

from __future__ import annotations

from typing import Final, TypeAlias

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

Message: TypeAlias = "CameraInfo | Float64MultiArray | Image | PoseStamped | UInt8MultiArray"

IMAGE: Final = "sensor_msgs/msg/Image"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"
POSE: Final = "geometry_msgs/msg/PoseStamped"
OCTETS: Final = "std_msgs/msg/UInt8MultiArray"
NUMBERS: Final = "std_msgs/msg/Float64MultiArray"
TYPES: Final = {
    CAMERA: CameraInfo,
    IMAGE: Image,
    NUMBERS: Float64MultiArray,
    OCTETS: UInt8MultiArray,
    POSE: PoseStamped,
}


def set_number(message: Message, number: int) -> None:
    """Write the number of its request into a message."""
    if isinstance(message, Float64MultiArray | UInt8MultiArray):
        message.layout.data_offset = number
    else:
        message.header.frame_id = str(number)


def number_of(message: Message) -> int:
    """Return the number of the request of a message."""
    if isinstance(message, Float64MultiArray | UInt8MultiArray):
        return int(message.layout.data_offset)
    return int(message.header.frame_id)
