"""Messages of the tasks of the FogROS papers in rclpy's types, and the number of a request in each of them.

Every message carries the number of its request in its header's ``frame_id`` or its layout's ``data_offset``; requests
numbered 0 are greetings.
"""

from __future__ import annotations

from typing import Final, TypeAlias

from fogros_tasks import CAMERA, IMAGE, NUMBERS, OCTETS, POSE
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

Message: TypeAlias = "CameraInfo | Float64MultiArray | Image | PoseStamped | UInt8MultiArray"

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
