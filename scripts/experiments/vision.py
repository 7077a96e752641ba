"""Frames with objects, and classical computer vision that finds them: the load of figures 6 and 7.

Sans-I/O.

Stand-ins, and no neural networks: object detection by correlation with a template (FFT), segmentation by smoothing,
thresholds and connected components. Both are typical CPU work on an image. Their time does not depend on its content,
and their answer can be checked, since the frames are drawn here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

__all__ = ["SHAPE", "Grey", "Scene", "count_regions", "find_objects"]

Grey: TypeAlias = "NDArray[np.uint8]"

SHAPE: Final = (480, 640)
_RADIUS: Final = 14  # radius of a disc, in pixels
_CELL: Final = 80  # an object stands in the middle third of a cell, so none touches another
_NOISE: Final = 12.0
_THRESHOLD: Final = 0.75  # share of the best correlation
_SCALES: Final = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0)  # sigmas of the smoothing, in pixels; an odd number


@dataclass(frozen=True, slots=True)
class Scene:
    """Frame and its contents. ``centres``: row and column of the middle of each object, in pixels."""

    frame: Grey
    centres: tuple[tuple[int, int], ...]

    @classmethod
    def draw(cls, seed: int) -> Scene:
        """Return a scene of three to twelve discs on a noisy ground; the same one for the same seed."""
        random = np.random.default_rng(seed)
        rows, columns = SHAPE[0] // _CELL, SHAPE[1] // _CELL
        cells = random.choice(rows * columns, size=int(random.integers(3, 13)), replace=False)
        third = _CELL // 3
        image = np.full(SHAPE, 70.0)
        down, right = np.ogrid[: SHAPE[0], : SHAPE[1]]
        centres = []
        for cell in sorted(int(each) for each in cells):
            row = cell // columns * _CELL + third + int(random.integers(third))
            column = cell % columns * _CELL + third + int(random.integers(third))
            image[(down - row) ** 2 + (right - column) ** 2 <= _RADIUS**2] = 190.0
            centres.append((row, column))
        image += random.normal(0.0, _NOISE, SHAPE)
        return cls(np.clip(image, 0, 255).astype(np.uint8), tuple(centres))

    def agrees(self, found: list[tuple[int, int]], *, tolerance: int = 3) -> bool:
        """Return whether exactly the objects were found, each within so many pixels."""
        near = [
            any(abs(r - row) <= tolerance and abs(c - column) <= tolerance for r, c in found)
            for row, column in self.centres
        ]
        return len(found) == len(self.centres) and all(near)


def find_objects(frame: Grey) -> list[tuple[int, int]]:
    """Return row and column of each disc (about 15 ms of one core)."""
    image = frame.astype(np.float32)
    image -= image.mean()
    spectrum = fft.rfft2(image)
    score = fft.irfft2(spectrum * np.conj(_template(_RADIUS)), s=SHAPE)
    peaks = (score > _THRESHOLD * score.max()) & (score == ndimage.maximum_filter(score, size=2 * _RADIUS + 1))
    return [(int(row), int(column)) for row, column in np.argwhere(peaks)]


def count_regions(frame: Grey, coarse: int = 1) -> int:
    """Return how many bright regions a frame is segmented into (about 60 ms of one core).

    Args:
        frame: the image.
        coarse: step in rows and columns (4: about 3 ms).
    """
    image = frame[::coarse, ::coarse].astype(np.float32)
    votes = np.zeros(image.shape, dtype=np.uint8)
    for sigma in _SCALES:
        smooth = ndimage.gaussian_filter(image, sigma / coarse)
        votes += smooth > (smooth.min() + smooth.max()) / 2
    return int(ndimage.label(votes > len(_SCALES) // 2)[1])


def _template(radius: int) -> NDArray[np.complex64]:
    """Return the spectrum of a disc around the origin, of mean 0 and length 1."""
    down, right = (np.minimum(np.arange(size), size - np.arange(size)) for size in SHAPE)
    inside = down[:, None] ** 2 + right[None, :] ** 2 <= radius**2
    ring = down[:, None] ** 2 + right[None, :] ** 2 <= (2 * radius) ** 2
    shape = np.where(inside, 1.0, np.where(ring, -inside.sum() / (ring.sum() - inside.sum()), 0.0))
    return np.asarray(fft.rfft2((shape / np.linalg.norm(shape)).astype(np.float32)))
