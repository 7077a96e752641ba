"""Grasp planning on a depth image: antipodal pairs of edge pixels, ranked by how well they oppose each other.

Sans-I/O. Stand-in for Dex-Net: candidates are sampled as Dex-Net samples them (pixel pairs on depth edges whose normals
oppose each other, no wider than the gripper opens). Dex-Net then ranks them with a neural network (GQ-CNN), whose
weights are not available here. This module ranks them by friction angle, clearance and distance to the object's middle.

Source: Mahler et al., Dex-Net 2.0 (RSS 2017), section V-B, for the sampling.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

__all__ = ["WIDEST_M", "Grasp", "plan_grasp"]

WIDEST_M: Final = 1.0  # the recorded frames show furniture
_NARROWEST_M: Final = 0.02
_EDGE_M: Final = 0.15  # a step in depth that is an edge
_FRICTION: Final = 0.8  # coefficient
_SAMPLES: Final = 200_000
_SMOOTH_PIXELS: Final = 2.0
_CLEARANCE_PIXELS: Final = 4.0
_BATCH: Final = 20_000


@dataclass(frozen=True, slots=True)
class Grasp:
    """Parallel-jaw grasp: position, width, quality.

    Args:
        row: of the middle between the jaws, in pixels.
        column: the same.
        angle_rad: of the line between the jaws in the image, from the columns' axis.
        depth_m: of the object there.
        width_m: between the jaws.
        quality: 0 to 1.
    """

    row: float
    column: float
    angle_rad: float
    depth_m: float
    width_m: float
    quality: float


def plan_grasp(depth: NDArray[np.float32], mask: NDArray[np.uint8], focal: float, seed: int) -> Grasp | None:
    """Return the best grasp that was sampled; None if the mask has no edge pair that can be grasped.

    Args:
        depth: float32 [height, width], metres; 0: unknown.
        mask: uint8 [height, width]; other than 0: the object.
        focal: of the camera, in pixels.
        seed: of the sampling.
    """
    inside = mask != 0
    smooth = ndimage.gaussian_filter(inside.astype(np.float32), _SMOOTH_PIXELS)
    down, right = np.gradient(smooth)
    surroundings = ndimage.maximum_filter(np.where(inside, 0, depth), size=7)
    edge = inside & ~ndimage.binary_erosion(inside) & (surroundings - depth > _EDGE_M)
    rows, columns = np.nonzero(edge)
    if len(rows) < 2:
        return None
    normals = -np.stack([down[rows, columns], right[rows, columns]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-9
    middle = np.array(ndimage.center_of_mass(inside))
    clearance = ndimage.distance_transform_edt(~inside)
    chance = np.random.default_rng(seed)
    best: Grasp | None = None
    for _ in range(_SAMPLES // _BATCH):
        one, other = chance.integers(len(rows), size=(2, _BATCH))
        at = np.stack([rows[one], columns[one]], axis=1), np.stack([rows[other], columns[other]], axis=1)
        line = (at[1] - at[0]).astype(float)
        pixels = np.linalg.norm(line, axis=1)
        axis = line / (pixels[:, None] + 1e-9)
        depths = (depth[rows[one], columns[one]] + depth[rows[other], columns[other]]) / 2
        widths = pixels * depths / focal
        # cosine of the angle between each jaw's force and the surface's normal there
        cosines = np.minimum((axis * normals[other]).sum(axis=1), -(axis * normals[one]).sum(axis=1))
        fits = (cosines > math.cos(math.atan(_FRICTION))) & (widths > _NARROWEST_M) & (widths < WIDEST_M)
        if not fits.any():
            continue
        centre = (at[0] + at[1]) / 2
        off = np.linalg.norm(centre - middle, axis=1) / np.hypot(*mask.shape)
        ends = (
            np.rint(at[1] + _CLEARANCE_PIXELS * axis).astype(int),
            np.rint(at[0] - _CLEARANCE_PIXELS * axis).astype(int),
        )
        capacity = np.minimum(
            *(clearance[e[:, 0].clip(0, mask.shape[0] - 1), e[:, 1].clip(0, mask.shape[1] - 1)] for e in ends)
        )
        quality = np.where(fits, cosines * (1 - off) * np.minimum(capacity / _CLEARANCE_PIXELS, 1), -1.0)
        top = int(quality.argmax())
        if quality[top] > (best.quality if best else 0):
            angle_rad = math.atan2(axis[top, 0], axis[top, 1])
            place = float(centre[top, 0]), float(centre[top, 1])
            best = Grasp(*place, angle_rad, float(depths[top]), float(widths[top]), float(quality[top]))
    return best
