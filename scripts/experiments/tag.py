"""Camera that sees an AprilTag: frames drawn for a known pose, and the pose found in them.

Sans-I/O, but for the detector, a C library that keeps its own state.

::

    tag frame: x right, y down, z into the tag; corners at half a size     pixel = K (R corner + t), no distortion

The library supplies the pattern of the tag, but draws none itself; each pixel is the mean of nine rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pupil_apriltags import Detector
from vision import SHAPE, Grey

_FAMILY: Final = "tag36h11"
_SIZE_M: Final = 0.16  # metres from black edge to black edge
_FOCAL: Final = 600.0  # pixels
_CENTRE: Final = (SHAPE[1] / 2, SHAPE[0] / 2)
_RAYS: Final = (-1 / 3, 0.0, 1 / 3)
_GROUND, _WHITE, _BLACK = 120.0, 230.0, 20.0


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


class _OrderedDetector(Detector):  # type: ignore[misc]  # the binding is untyped
    """Detector that is freed before its family.

    pupil-apriltags 1.0.4.post11 frees the family first, and the detector then writes to it.
    """

    def __del__(self) -> None:
        library, detector = vars(self).get("libc"), vars(self).get("tag_detector_ptr")
        if library is not None and detector is not None:
            library.apriltag_detector_destroy(detector)
            library.tag36h11_destroy(self.tag_families[_FAMILY])


class TagCamera:
    """Camera that draws the tag, and finds it (10 to 20 ms of one core)."""

    def __init__(self) -> None:
        self._detector = _OrderedDetector(families=_FAMILY, nthreads=1, quad_decimate=2.0)
        family = self._detector.tag_families[_FAMILY].contents
        self._cells = _pattern(family)
        self._module_m = _SIZE_M / int(family.width_at_border)

    def draw(self, pose: Pose) -> Grey:
        """Return the image that a camera would take."""
        turn, at = np.reshape(pose.turn, (3, 3)), np.asarray(pose.at)
        plane = np.linalg.inv(np.column_stack((turn[:, 0], turn[:, 1], at)))  # from a ray to the tag's plane
        cells, total = self._cells, len(self._cells)
        image = np.zeros(SHAPE)
        down, right = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
        for dy in _RAYS:
            for dx in _RAYS:
                rays = np.stack(((right + dx - _CENTRE[0]) / _FOCAL, (down + dy - _CENTRE[1]) / _FOCAL, np.ones(SHAPE)))
                x, y, w = np.tensordot(plane, rays, axes=1)
                column = np.floor(x / w / self._module_m + total / 2).astype(int)
                row = np.floor(y / w / self._module_m + total / 2).astype(int)
                on_tag = (column >= 0) & (column < total) & (row >= 0) & (row < total)
                image += np.where(on_tag, cells[row.clip(0, total - 1), column.clip(0, total - 1)], _GROUND)
        frame: Grey = (image / len(_RAYS) ** 2).round().astype(np.uint8)
        return frame

    def find(self, frame: Grey) -> Pose | None:
        """Return the pose of the tag, or None if it is not seen."""
        found = self._detector.detect(frame, True, (_FOCAL, _FOCAL, *_CENTRE), _SIZE_M)
        if len(found) != 1:
            return None
        turn, at = found[0].pose_R, found[0].pose_t
        return Pose(tuple(float(each) for each in turn.flat), tuple(float(each) for each in at.flat))


def _pattern(family: object) -> NDArray[np.float64]:
    """Return the grey of each module of the first tag of a family, its white margin included.

    ``family``: the library's C struct ``apriltag_family``.
    """
    total, border = int(family.total_width), int(family.width_at_border)  # type: ignore[attr-defined]
    bits, code = int(family.nbits), int(family.codes[0])  # type: ignore[attr-defined]
    margin = (total - border) // 2
    cells = np.full((total, total), _WHITE)
    cells[margin : margin + border, margin : margin + border] = _BLACK
    for bit in range(bits):
        if code >> (bits - 1 - bit) & 1:
            cells[margin + family.bit_y[bit], margin + family.bit_x[bit]] = _WHITE  # type: ignore[attr-defined]
    return cells


def _about(axis: int, angle: float) -> NDArray[np.float64]:
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.eye(3)
    a, b = (each for each in range(3) if each != axis)
    turn[a, a], turn[a, b], turn[b, a], turn[b, b] = cos, -sin, sin, cos
    return turn
