"""Recorded depth frames of a scene with an armchair, each with the mask of the armchair.

I/O; reads PNG files with OpenCV. Source of the frames: ``scripts/data/README.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from grasp.sampler import WIDEST_M, Grasp

__all__ = ["FILES", "SHAPE", "Frame", "is_right", "read_frames"]

SHAPE: Final = (386, 516)  # the size of Dex-Net's camera
_CROP: Final = (slice(47, 433), slice(62, 578))
# First and last row and column of a box around the armchair, in the cropped image.
_BOXES: Final = {3: (85, 235, 272, 374), 4: (77, 243, 212, 382), 5: (57, 263, 244, 418)}
FILES: Final = tuple(f"depth_{at}.png" for at in _BOXES)
_THICK_M: Final = 0.4
_UNITS_A_METRE: Final = 1_000.0
_FOCAL: Final = 518.0


@dataclass(frozen=True, slots=True)
class Frame:
    """What a planner needs.

    Args:
        depth: float32 [height, width], metres; 0: unknown.
        mask: uint8 [height, width]; other than 0: the object.
        focal: of the camera, in pixels.
    """

    depth: NDArray[np.float32]
    mask: NDArray[np.uint8]
    focal: float


def read_frames(folder: Path) -> list[Frame]:
    """Return the frames of a folder, in the order of ``FILES``.

    Raises:
        FileNotFoundError: one is missing, or no image.
    """
    return [_frame(folder / name, box) for name, box in zip(FILES, _BOXES.values(), strict=True)]


def is_right(grasp: Grasp, frame: Frame) -> bool:
    """Return whether the middle of a grasp is on the object, and the gripper opens wide enough."""
    return bool(frame.mask[int(grasp.row), int(grasp.column)]) and 0 < grasp.width_m <= WIDEST_M and grasp.quality > 0


def _frame(path: Path, box: tuple[int, int, int, int]) -> Frame:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None:
        raise FileNotFoundError(path)
    top, bottom, left, right = box
    depth = (image[_CROP] / _UNITS_A_METRE).astype(np.float32)
    inside = np.zeros(depth.shape, dtype=bool)
    inside[top:bottom, left:right] = True
    distance_m = np.median(depth[inside & (depth > 0)])
    mask = (inside & (np.abs(depth - distance_m) < _THICK_M)).astype(np.uint8) * 255
    return Frame(depth, mask, _FOCAL)
