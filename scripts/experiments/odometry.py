"""RGB-D visual odometry: the motion of a camera between two frames, from ORB features and their depth.

Sans-I/O, but for OpenCV's own random state, which is seeded for each pair. Stand-in for ORB-SLAM2, whose tracking
begins the same way (ORB features, matching, perspective-n-point with RANSAC); there is no map, no loop closure, no
bundle adjustment.

Source: Mur-Artal and Tardos, ORB-SLAM2, section III; OpenCV's ``ORB`` and ``solvePnPRansac``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Transform: TypeAlias = "NDArray[np.float64]"  # 4 x 4, homogeneous

CAMERA: Final = np.array([[518.0, 0, 325.5], [0, 519.0, 253.5], [0, 0, 1]])  # of the recorded frames, in pixels
DEPTH_SCALE: Final = 1_000.0  # depth units a metre
_FEATURES: Final = 2_000
_ITERATIONS: Final = 2_000
_REPROJECTION_PIXELS: Final = 3.0
_CONFIDENCE: Final = 0.9999
_LEAST_POINTS: Final = 6

cv2.setNumThreads(1)  # a machine here has one core


@dataclass(frozen=True, slots=True)
class Features:
    """Features of a frame: pixels and descriptors, and its depth."""

    pixels: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    depth: NDArray[np.uint16]

    @classmethod
    def of(cls, color: NDArray[np.uint8], depth: NDArray[np.uint16]) -> Features:
        """Detect the features of a frame.

        ``color``: uint8 [height, width, 3], RGB. ``depth``: uint16 [height, width], ``DEPTH_SCALE`` units a metre; 0:
        unknown.
        """
        points, descriptors = cv2.ORB.create(_FEATURES).detectAndCompute(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), None)
        return cls(np.array([point.pt for point in points]), np.asarray(descriptors, dtype=np.uint8), depth)

    def positions(self, which: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return x, y, z in metres of some features, in the camera's frame; z is 0 where the depth is unknown."""
        u, v = self.pixels[which].T
        z = self.depth[np.rint(v).astype(int), np.rint(u).astype(int)] / DEPTH_SCALE
        return np.stack([(u - CAMERA[0, 2]) * z / CAMERA[0, 0], (v - CAMERA[1, 2]) * z / CAMERA[1, 1], z], axis=1)


def motion(before: Features, after: Features) -> Transform | None:
    """Return the transform from the camera's frame before to that after; None if too few features match."""
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(before.descriptors, after.descriptors)
    old = np.array([match.queryIdx for match in matches], dtype=np.intp)
    new = np.array([match.trainIdx for match in matches], dtype=np.intp)
    positions = before.positions(old)
    known = positions[:, 2] > 0
    if known.sum() < _LEAST_POINTS:
        return None
    cv2.setRNGSeed(1)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        positions[known],
        after.pixels[new][known],
        CAMERA,
        None,
        iterationsCount=_ITERATIONS,
        reprojectionError=_REPROJECTION_PIXELS,
        confidence=_CONFIDENCE,
    )
    if not found:
        return None
    turn, shift = cv2.Rodrigues(rotation)[0], translation.ravel()
    return _transform(turn.astype(np.float64), shift.astype(np.float64))


def transform_of(pose: tuple[float, ...]) -> Transform:
    """Return the transform of a pose: x, y, z in metres and a quaternion x, y, z, w."""
    x, y, z, qx, qy, qz, qw = pose
    turn = np.array([
        [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw)],
        [2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw)],
        [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy)],
    ])  # fmt: skip
    return _transform(turn, np.array([x, y, z]))


def _transform(turn: NDArray[np.float64], shift: NDArray[np.float64]) -> Transform:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turn, shift
    return found
