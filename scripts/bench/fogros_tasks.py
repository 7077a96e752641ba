"""Messages that the three tasks of the FogROS papers send and get back, as data.

Sans-I/O. Read by the bench and by its nodes. The messages are those of the clients that the authors publish; what
these leave open (the length of a planned path) has a comment. Types of packages that have no wheel are replaced
by standard ones that carry the same numbers.

Source: github.com/BerkeleyAutomation: ``fogros2-examples`` (``vslam/TUTORIAL.md``: the TUM dataset freiburg1;
``mpt/mpt_ros/src/mpt_ros_client.cpp``: meshes of OMPL's "cubicles", ``MotionPlanRequest``), ``fogros-demos``
(``gqcnn-ros/nodes/gqcnn_ros_client.py``), ``gqcnn`` (``data/calib/phoxi/phoxi.intr``: 516 x 386).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

__all__ = ["TASKS", "Part", "Task"]

IMAGE: Final = "sensor_msgs/msg/Image"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"
POSE: Final = "geometry_msgs/msg/PoseStamped"
OCTETS: Final = "std_msgs/msg/UInt8MultiArray"
NUMBERS: Final = "std_msgs/msg/Float64MultiArray"


@dataclass(frozen=True, slots=True)
class Part:
    """One message of a task.

    Attributes:
        count: octets or numbers, of an array.
        width, height, encoding, pixel: of an image; ``pixel`` is bytes.
    """

    topic: str
    type_name: str
    count: int = 0
    width: int = 0
    height: int = 0
    encoding: str = ""
    pixel: int = 0


@dataclass(frozen=True, slots=True)
class Task:
    """Messages that a robot sends, and the answer of the cloud to all of them."""

    name: str
    parts: tuple[Part, ...]
    answer: Part


TASKS: Final = (
    Task(
        "vSLAM",
        (
            Part("color", IMAGE, width=640, height=480, encoding="rgb8", pixel=3),
            Part("depth", IMAGE, width=640, height=480, encoding="16UC1", pixel=2),
        ),
        Part("pose", POSE),
    ),
    Task(
        "motion planning",
        (
            Part("environment_mesh", OCTETS, count=119_265),
            Part("robot_mesh", OCTETS, count=8_575),
            Part("motion_plan_request", NUMBERS, count=23),  # limits 3, start 7, goal 7, bounds 6
        ),
        Part("motion_plan", NUMBERS, count=7 * 50),  # states of seven numbers; fifty is our choice
    ),
    Task(
        "grasp planning",
        (
            Part("camera_info", CAMERA),
            Part("image_raw", IMAGE, width=516, height=386, encoding="32FC1", pixel=4),
            Part("mask_raw", IMAGE, width=516, height=386, encoding="mono8", pixel=1),
        ),
        Part("grasp", POSE),
    ),
)
