"""Tasks of FogROS G's Table I: the robot's request, the server's computation, and the check of the answer.

Reads recorded frames and meshes when a task is made; otherwise sans-I/O. The sizes of images and the types are those of
the clients that the authors publish, with standard types where a package has no wheel. The number of a request is in
its messages' headers, as ``frame_id``, or in their layouts, as ``data_offset``; requests numbered 0 are greetings.
Source: github.com/BerkeleyAutomation: ``fogros2-examples`` (``vslam/TUTORIAL.md``: the TUM dataset freiburg1;
``mpt/mpt_ros/src/mpt_ros_client.cpp``: meshes of OMPL's "cubicles", ``MotionPlanRequest``), ``fogros-demos``
(``gqcnn-ros/nodes/gqcnn_ros_client.py``), ``gqcnn`` (``data/calib/phoxi/phoxi.intr``: 516 x 386).

    vSLAM             colour (rgb8) and depth (16UC1) of 640 x 480 -> pose          stand-in: odometry.py
    motion planning   meshes of OMPL's Home and a request -> path                   OMPL's RRTConnect, FCL
    grasp planning    depth (32FC1) and mask of 516 x 386, camera -> grasp          stand-in: examples/grasp
"""

from __future__ import annotations

import array
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped
from machine import data_folder
from numpy.typing import NDArray
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


if TYPE_CHECKING:
    from planning import Problem

_FRAMES: Final = (2, 3, 4, 5)  # the first of the five recorded frames is too far from the second to be matched well
_NEAR_M: Final = 0.1
_TURNED_RAD: Final = 0.1
_PLANNER: Final = "RRTConnect"
_PLANNING_LIMIT_S: Final = 1_000.0


class Vslam:
    """Motion of the camera since the frame before. The camera passes through the recorded frames, back and forth."""

    parts = (("color", IMAGE), ("depth", IMAGE))
    answer = ("pose", POSE)

    def __init__(self) -> None:
        from odometry import Features, transform_of

        files = (f"{kind}_{at}.png" for kind in ("color", "depth") for at in _FRAMES)
        folder = data_folder("rgbd", ["pose.txt", *files])
        colors = {at: _read(folder / f"color_{at}.png")[:, :, ::-1] for at in _FRAMES}
        depths = {at: _read(folder / f"depth_{at}.png", cv2.IMREAD_UNCHANGED) for at in _FRAMES}
        poses = [line.split() for line in (folder / "pose.txt").read_text(encoding="ascii").splitlines()]
        self._poses = {at: transform_of(tuple(map(float, poses[at - 1]))) for at in _FRAMES}
        self._images = {at: [_image("rgb8", colors[at]), _image("16UC1", depths[at])] for at in _FRAMES}
        self._before = Features.of(np.ascontiguousarray(colors[_FRAMES[0]]), depths[_FRAMES[0]])

    def warm_up(self) -> None:
        """Compute request 0."""
        self.compute(self.request(0))

    def request(self, number: int) -> list[Message]:
        """Return colour and depth of a frame."""
        return list(self._images[_frame(number)])

    def compute(self, messages: Sequence[Message]) -> Message:
        """Return the motion as a pose; without a header's ``stamp`` of 1 s it was not found."""
        from odometry import Features, motion

        color, depth = (_pixels(message) for message in messages)
        after = Features.of(color, depth.reshape(color.shape[:2]))
        found = motion(self._before, after)
        self._before = after
        answer = PoseStamped()
        if found is not None:
            answer.header.stamp.sec = 1
            place, turn = answer.pose.position, answer.pose.orientation
            place.x, place.y, place.z = (float(each) for each in found[:3, 3])
            vector = cv2.Rodrigues(found[:3, :3])[0].ravel()
            turn.x, turn.y, turn.z = (float(each) for each in vector)  # a rotation vector, in radians
            turn.w = 0.0
        return answer

    def is_right(self, number: int, answer: Message) -> bool:
        """Return whether the motion is within 0.1 m and 0.1 rad of the recorded one."""
        if not isinstance(answer, PoseStamped) or answer.header.stamp.sec != 1:
            return False
        truth = np.linalg.inv(self._poses[_frame(number)]) @ self._poses[_frame(number - 1)]
        place, turn = answer.pose.position, answer.pose.orientation
        apart_m = float(np.linalg.norm(truth[:3, 3] - (place.x, place.y, place.z)))
        rotation = cv2.Rodrigues(np.array([turn.x, turn.y, turn.z]))[0]
        turned_rad = float(np.linalg.norm(cv2.Rodrigues(rotation.T @ truth[:3, :3])[0]))
        return apart_m <= _NEAR_M and turned_rad <= _TURNED_RAD


class MotionPlanning:
    """Path of a rigid body through OMPL's Home. Every request carries both meshes."""

    parts = (("environment_mesh", OCTETS), ("robot_mesh", OCTETS), ("motion_plan_request", NUMBERS))
    answer = ("motion_plan", NUMBERS)

    def __init__(self) -> None:
        from planning import be_quiet, limits

        be_quiet()
        folder = data_folder("planning", ["Home.cfg", "Home_env.dae", "Home_robot.dae"])
        self._limits = limits(folder, "Home")
        meshes = ((folder / f"Home_{what}.dae").read_bytes() for what in ("env", "robot"))
        octets = [UInt8MultiArray(data=array.array("B", mesh)) for mesh in meshes]
        numbers = [number for place in self._limits for number in place]
        self._messages = [*octets, Float64MultiArray(data=array.array("d", numbers))]

    def warm_up(self) -> None:
        """Read both meshes once; the planner itself has nothing to load."""
        self._problem(self._messages)

    def request(self, number: int) -> list[Message]:
        """Return environment, robot, and start, goal and bounds."""
        del number
        return list(self._messages)

    def compute(self, messages: Sequence[Message]) -> Message:
        """Return the path, seven numbers a state; empty: none was found in time."""
        way = self._problem(messages).solve(_PLANNER, _PLANNING_LIMIT_S, lambda: False)
        return Float64MultiArray(data=array.array("d", [number for place in way for number in place]))

    def is_right(self, number: int, answer: Message) -> bool:
        """Return whether the path begins at the start and ends at the goal."""
        del number
        if not isinstance(answer, Float64MultiArray) or len(answer.data) < 2 * 7:
            return False
        start, goal, _, _ = self._limits
        return bool(np.allclose(answer.data[:3], start) and np.allclose(answer.data[-7:-4], goal))

    @staticmethod
    def _problem(messages: Sequence[Message]) -> Problem:
        from planning import Problem

        world, robot, asked = messages
        start, goal, low, high = (tuple(asked.data[at : at + 3]) for at in (0, 3, 6, 9))
        return Problem.of(bytes(robot.data), bytes(world.data), start, goal, low, high)


class GraspPlanning:
    """Grasp of an armchair, in three of the recorded frames in turn."""

    parts = (("camera_info", CAMERA), ("image_raw", IMAGE), ("mask_raw", IMAGE))
    answer = ("grasp", POSE)

    def __init__(self) -> None:
        from grasp.frames import FILES, SHAPE, read_frames
        from odometry import CAMERA as MATRIX

        height, width = SHAPE
        info = CameraInfo(height=height, width=width, k=MATRIX.ravel().tolist())
        self._frames = read_frames(data_folder("rgbd", FILES))
        self._messages = [[info, _image("32FC1", each.depth), _image("mono8", each.mask)] for each in self._frames]

    def warm_up(self) -> None:
        """Compute request 0."""
        self.compute(self.request(0))

    def request(self, number: int) -> list[Message]:
        """Return camera, depth and mask."""
        return list(self._messages[number % len(self._messages)])

    def compute(self, messages: Sequence[Message]) -> Message:
        """Return the grasp: middle (column, row, metres), and angle, width and quality as orientation x, y, z."""
        from grasp.sampler import plan_grasp

        info, depth, mask = messages
        found = plan_grasp(_pixels(depth), _pixels(mask), float(info.k[0]), seed=1)
        answer = PoseStamped()
        if found is not None:
            place, turn = answer.pose.position, answer.pose.orientation
            place.x, place.y, place.z = found.column, found.row, found.depth_m
            turn.x, turn.y, turn.z = found.angle_rad, found.width_m, found.quality
        return answer

    def is_right(self, number: int, answer: Message) -> bool:
        """Return whether the middle of the grasp is on the object, and the gripper opens wide enough."""
        from grasp.frames import is_right
        from grasp.sampler import Grasp

        if not isinstance(answer, PoseStamped):
            return False
        place, turn = answer.pose.position, answer.pose.orientation
        return is_right(
            Grasp(place.y, place.x, turn.x, place.z, turn.y, turn.z), self._frames[number % len(self._frames)]
        )


OffloadTask: TypeAlias = "Vslam | MotionPlanning | GraspPlanning"

TASKS: Final[Mapping[str, Callable[[], OffloadTask]]] = {
    "vSLAM": Vslam,
    "motion planning": MotionPlanning,
    "grasp planning": GraspPlanning,
}

_KINDS: Final = {"rgb8": (np.uint8, 3), "16UC1": (np.uint16, 1), "32FC1": (np.float32, 1), "mono8": (np.uint8, 1)}


def _read(path: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """Return the pixels of an image file. Raises ``FileNotFoundError``: it is missing, or no image."""
    image = cv2.imread(str(path), flags)
    if image is None:
        raise FileNotFoundError(path)
    return image


def _frame(number: int) -> int:
    """Return the frame of a request: 2 (request 0), 3, 4, 5, 4, 3, 2, ..."""
    last = len(_FRAMES) - 1
    at = number % (2 * last)
    return _FRAMES[min(at, 2 * last - at)]


def _image(encoding: str, pixels: NDArray[Any]) -> Image:
    height, width = pixels.shape[:2]
    raw = np.ascontiguousarray(pixels).tobytes()
    return Image(height=height, width=width, encoding=encoding, step=len(raw) // height, data=array.array("B", raw))


def _pixels(message: Message) -> NDArray[Any]:
    kind, channels = _KINDS[message.encoding]
    shape = (message.height, message.width, channels) if channels > 1 else (message.height, message.width)
    return np.frombuffer(bytes(message.data), dtype=kind).reshape(shape)
