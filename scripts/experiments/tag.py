"""Camera that sees an AprilTag: frames drawn for a known pose, and the pose found in them by OpenCV.

Sans-I/O. ::

    tag frame: x right, y down, z into the tag; corners at half a size     pixel = K (R corner + t), no distortion

Each pixel of a drawn frame is the mean of nine rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from vision import SHAPE, Grey

_FAMILY: Final = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
_BORDER, _TOTAL = 8, 10  # modules from black edge to black edge, and with the white margin
_SIZE_M: Final = 0.16  # metres from black edge to black edge
_CAMERA: Final = np.array([[600.0, 0, SHAPE[1] / 2], [0, 600.0, SHAPE[0] / 2], [0, 0, 1]])  # K, in pixels
_RAYS: Final = 3  # a side of a pixel; the middle one passes through its centre
_GROUND, _WHITE, _BLACK = 120, 230, 20
_CORNERS: Final = _SIZE_M / 2 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of the tag: ``turn``: rotation matrix, row by row; ``at``: its middle, in metres before the camera."""

    turn: tuple[float, ...]
    at: tuple[float, ...]

    @classmethod
    def on_its_way(cls, number: int) -> Pose:
        """Return the pose in a frame: the tag sways before the camera, and consecutive frames differ."""
        phase = 0.1 * number
        about_x, about_y, about_z = 0.35 * math.sin(0.9 * phase), 0.4 * math.cos(0.7 * phase), 0.5 * math.sin(phase)
        turn = _about(0, about_x) @ _about(1, about_y) @ _about(2, about_z)
        at = (0.08 * math.sin(0.8 * phase), 0.05 * math.cos(1.1 * phase), 0.7 + 0.15 * math.sin(0.5 * phase))
        return cls(tuple(float(each) for each in turn.flat), at)

    def apart_m(self, other: Pose) -> float:
        """Return the distance between two poses' middles, in metres."""
        return math.dist(self.at, other.at)

    def turned_rad(self, other: Pose) -> float:
        """Return the angle between two poses."""
        trace = float(np.dot(self.turn, other.turn))
        return math.acos(max(-1.0, min(1.0, (trace - 1) / 2)))


class TagCamera:
    """Camera that draws the tag, and finds it (5 ms of one core)."""

    def __init__(self) -> None:
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
        self._detector = cv2.aruco.ArucoDetector(_FAMILY, settings)
        bits = np.pad(_FAMILY.generateImageMarker(0, _BORDER), (_TOTAL - _BORDER) // 2, constant_values=255)
        self._modules = np.where(bits, _WHITE, _BLACK).astype(np.uint8)

    def draw(self, pose: Pose) -> Grey:
        """Return the image that a camera would take."""
        turn, module_m = np.reshape(pose.turn, (3, 3)), _SIZE_M / _BORDER
        rays = np.array([[_RAYS, 0, _RAYS // 2], [0, _RAYS, _RAYS // 2], [0, 0, 1]])
        middle_m = module_m * (1 - _TOTAL) / 2  # of the first module
        modules = np.array([[module_m, 0, middle_m], [0, module_m, middle_m], [0, 0, 1]])
        to_rays = rays @ _CAMERA @ np.column_stack((turn[:, 0], turn[:, 1], pose.at)) @ modules
        size = (SHAPE[1] * _RAYS, SHAPE[0] * _RAYS)
        image = cv2.warpPerspective(self._modules, to_rays, size, flags=cv2.INTER_NEAREST, borderValue=_GROUND)
        return np.asarray(cv2.resize(image, SHAPE[::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def find(self, frame: Grey) -> Pose | None:
        """Return the pose of the tag, or None if it is not seen."""
        corners, found, _ = self._detector.detectMarkers(frame)
        if found is None or len(found) != 1:
            return None
        _, turn, at = cv2.solvePnP(_CORNERS, corners[0], _CAMERA, None)
        return Pose(tuple(float(each) for each in cv2.Rodrigues(turn)[0].flat), tuple(float(each) for each in at.flat))


def _about(axis: int, angle: float) -> NDArray[np.float64]:
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.eye(3)
    a, b = (each for each in range(3) if each != axis)
    turn[a, a], turn[a, b], turn[b, a], turn[b, b] = cos, -sin, sin, cos
    return turn
