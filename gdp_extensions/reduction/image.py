"""Images of a topic: cut to a region, and with a picture file in place of the pixels, both ways.

Sans-I/O. A reduced ``sensor_msgs/Image`` stays one: only its field ``data`` holds a file. Header, size, encoding,
``is_bigendian`` and ``step`` are those of the image that its reader gets. So both ROS versions and every encoding carry
it.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

import numpy as np

from gdp.errors import DropReason, RemoteError
from gdp_extensions.reduction.picture import Layout, decode_picture, encode_picture
from proxy.config.reduction import Region
from proxy.serial.channel import Channel
from proxy.serial.serializer import native_codec
from proxy.wire.message import PictureFormat

_NAMED: Final = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "mono16": 2, "rgb16": 6, "bgr16": 6}
_OPENCV: Final = re.compile(r"(8|16|32|64)[USF]C(\d{1,2})")
_BAYER: Final = re.compile(r"bayer_[a-z]{4}(8|16)")


class _Image(NamedTuple):
    layout: Layout
    is_bigendian: bool
    data: memoryview


class ImageReducer:
    """Reducer of one channel's images.

    Args:
        picture: format of files; None: pixels stay.
        region: in pixels; the image has those inside.

    Raises:
        DefinitionError: the channel has no usable definition.
    """

    __slots__ = ("_codec", "_picture", "_region")

    def __init__(self, channel: Channel, picture: PictureFormat | None, region: Region | None) -> None:
        self._codec = native_codec(channel)
        self._picture: PictureFormat | None = picture
        self._region = region

    def reduce(self, raw: bytes, quality: int) -> tuple[bytes, bool]:
        """Return the message, and whether ``data`` is a picture file; what cannot be reduced is returned unchanged.

        Args:
            raw: the message as ROS wrote it.
            quality: of JPEG, 1 to 100.

        Raises:
            MissingExtraError: there is no Pillow.
        """
        tree = self._codec.to_tree(raw)
        image = _image_of(tree)
        if image is None or not isinstance(tree, dict):
            return raw, False
        cut = None if self._region is None else _cut(image, self._region)
        if cut is not None:
            image = cut
            width, height, _, step = image.layout
            tree |= {"width": width, "height": height, "step": step, "data": image.data}
        file = None
        if self._picture is not None and not (image.is_bigendian and image.layout.encoding in ("mono16", "16UC1")):
            file = encode_picture(image.data, image.layout, self._picture, quality)
        if file is not None:
            tree["data"] = memoryview(file)
        elif cut is None:
            return raw, False
        return self._codec.to_raw(tree), file is not None


class ImageRestorer:
    """Restorer of one channel's images.

    Args:
        max_bytes: of an image's pixels.

    Raises:
        DefinitionError: the channel has no usable definition.
    """

    __slots__ = ("_codec", "_max_bytes", "_picture")

    def __init__(self, channel: Channel, picture: PictureFormat, max_bytes: int) -> None:
        self._codec = native_codec(channel)
        self._picture: PictureFormat = picture
        self._max_bytes = max_bytes

    def restore(self, raw: bytes) -> bytes:
        """Return the message with pixels in place of the picture file.

        Raises:
            RemoteError: it is no image, its file does not fit it, or it is larger than ``max_bytes``.
            MissingExtraError: there is no Pillow.
        """
        tree = self._codec.to_tree(raw)
        image = _image_of(tree)
        if image is None or not isinstance(tree, dict):
            raise RemoteError(DropReason.MALFORMED, "a picture file in a message that is no image")
        if image.layout.height * image.layout.step > self._max_bytes:
            raise RemoteError(DropReason.MALFORMED, f"an image of more than {self._max_bytes} bytes")
        tree["data"] = memoryview(decode_picture(image.data, image.layout, self._picture))
        return self._codec.to_raw(tree)


def _image_of(tree: object) -> _Image | None:
    """Return the image in the tree of a message; None where its definition is not that of images."""
    match tree:
        case {
            "width": int(width),
            "height": int(height),
            "encoding": memoryview() as encoding,
            "is_bigendian": int(order),
            "step": int(step),
            "data": memoryview() as data,
        }:
            layout = Layout(width, height, bytes(encoding[:40]).decode("ascii", "replace"), step)
            return _Image(layout, bool(order), data)
    return None


def _cut(image: _Image, region: Region) -> _Image | None:
    """Return the pixels inside the region; None where the image has none or its encoding is unknown."""
    width, height, encoding, step = image.layout
    size, grid = _pixel(encoding)
    if not size or step < width * size or len(image.data) != height * step:
        return None
    (left, right), (top, bottom) = (_inside(region.x, width, grid), _inside(region.y, height, grid))
    if left >= right or top >= bottom:
        return None
    rows = np.frombuffer(image.data, np.uint8).reshape(height, step)
    part = rows[top:bottom, left * size : right * size].tobytes()
    layout = Layout(right - left, bottom - top, encoding, (right - left) * size)
    return image._replace(layout=layout, data=memoryview(part))


def _pixel(encoding: str) -> tuple[int, int]:
    """Return the bytes of a pixel, 0 if unknown, and the grid on which a cut keeps the pattern of colours."""
    if found := _BAYER.fullmatch(encoding):
        return int(found[1]) // 8, 2
    if found := _OPENCV.fullmatch(encoding):
        return int(found[1]) // 8 * int(found[2]), 1
    return _NAMED.get(encoding, 0), 1


def _inside(bounds: tuple[float, float] | None, count: int, grid: int) -> tuple[int, int]:
    """Return the first row or column inside the bounds, and the one after the last."""
    if bounds is None:
        return 0, count
    begin, end = (int(min(max(bound, 0), count)) for bound in bounds)
    return begin // grid * grid, min(-(-end // grid) * grid, count)
