"""Picture files of uncompressed images: JPEG and PNG by Pillow, where it is installed.

Sans-I/O: files are bytes. Source: REP 118 and ``sensor_msgs/image_encodings`` for encodings; JPEG takes 8-bit grey and
colour, PNG also alpha, Bayer patterns and 16 bits. Every other encoding has no picture file here.
"""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from typing import Final, NamedTuple

import numpy as np

from gdp.errors import DropReason, RemoteError
from gdp.extras import MissingExtraError
from proxy.wire.message import PictureFormat

try:
    from PIL import Image
except ImportError:  # the extra `images` is not installed
    HAS_LIBRARY = False
else:
    HAS_LIBRARY = True

_PNG_LEVEL: Final = 1  # of zlib: 6 takes eight times as long and saves a seventh


class Layout(NamedTuple):
    """Layout of an image in memory. ``step``: bytes from one row to the next."""

    width: int
    height: int
    encoding: str
    step: int


class _Pixels(NamedTuple):
    mode: str  # of Pillow
    raw_mode: str  # order of the bytes of a pixel
    size: int  # bytes of a pixel
    has_jpeg: bool = False


_GREY: Final = _Pixels("L", "L", 1)
_WIDE: Final = _Pixels("I;16", "I;16", 2)
_PIXELS: Final = {
    "rgb8": _Pixels("RGB", "RGB", 3, has_jpeg=True),
    "bgr8": _Pixels("RGB", "BGR", 3, has_jpeg=True),
    "8UC3": _Pixels("RGB", "BGR", 3, has_jpeg=True),  # as OpenCV orders them
    "mono8": _Pixels("L", "L", 1, has_jpeg=True),
    "8UC1": _Pixels("L", "L", 1, has_jpeg=True),
    "rgba8": _Pixels("RGBA", "RGBA", 4),
    "bgra8": _Pixels("RGBA", "BGRA", 4),
    "8UC4": _Pixels("RGBA", "BGRA", 4),
    "mono16": _WIDE,
    "16UC1": _WIDE,
    **dict.fromkeys(("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), _GREY),
}


def check_pictures() -> None:
    """Raise ``MissingExtraError`` where there is no Pillow."""
    if not HAS_LIBRARY:
        raise MissingExtraError("Pillow is not installed: pip install 'gdp-ros[images]'")


def encode_picture(pixels: bytes | memoryview, layout: Layout, to: PictureFormat, quality: int) -> bytes | None:
    """Return a picture file; None where the format has none for this layout, or it would be no shorter.

    Args:
        pixels: ``height`` rows of ``step`` bytes, little-endian.
        quality: 1 to 100, of JPEG.

    Raises:
        MissingExtraError: there is no Pillow.
    """
    check_pictures()
    kind = _kind(layout, to)
    if kind is None or len(pixels) != layout.height * layout.step:
        return None
    size = layout.width, layout.height
    file = BytesIO()
    try:
        picture = Image.frombuffer(
            kind.mode, size, np.frombuffer(pixels, np.uint8), "raw", kind.raw_mode, layout.step, 1
        )
        if to == "jpeg":
            picture.save(file, "JPEG", quality=quality)
        else:
            picture.save(file, "PNG", compress_level=_PNG_LEVEL)
    except (OSError, ValueError):
        return None  # beyond the format's limits, such as 65,500 pixels of JPEG
    return file.getvalue() if file.tell() < len(pixels) else None


def decode_picture(file: bytes | memoryview, layout: Layout, of: PictureFormat) -> bytes:
    """Return the pixels of a picture file: ``height`` rows of ``step`` bytes, those after a row's last pixel zero.

    Raises:
        MissingExtraError: there is no Pillow.
        RemoteError: the file is not of this format and layout. Memory is bounded by ``height * step``.
    """
    check_pictures()
    kind = _kind(layout, of)
    if kind is None:
        raise RemoteError(DropReason.MALFORMED, f"{of}: no picture of {layout.encoding[:20]!r} images")
    try:
        with Image.open(BytesIO(file), formats=(of.upper(),)) as picture:
            if picture.size != (layout.width, layout.height) or picture.mode != kind.mode:
                detail = f"{of}: {picture.mode} {picture.size} where {layout} was stated"
                raise RemoteError(DropReason.MALFORMED, detail[:200])
            pixels: bytes = picture.tobytes("raw", kind.raw_mode)
    except (
        Image.DecompressionBombError,
        Image.DecompressionBombWarning,
        EOFError,
        IndexError,
        OSError,
        SyntaxError,
        ValueError,
        struct.error,
        zlib.error,
    ) as error:
        raise RemoteError(DropReason.MALFORMED, f"{of}: {type(error).__name__}: {error}"[:200]) from error
    row_bytes = layout.width * kind.size
    if row_bytes == layout.step:
        return pixels
    rows = np.zeros((layout.height, layout.step), np.uint8)
    rows[:, :row_bytes] = np.frombuffer(pixels, np.uint8).reshape(layout.height, row_bytes)
    return rows.tobytes()


def _kind(layout: Layout, to: PictureFormat) -> _Pixels | None:
    kind = _PIXELS.get(layout.encoding)
    if kind is None or (to == "jpeg" and not kind.has_jpeg):
        return None
    return kind if layout.width > 0 and layout.height > 0 and layout.step >= layout.width * kind.size else None
