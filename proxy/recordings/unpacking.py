"""Decompression of untrusted chunks: never more bytes than their header states, or than the cap.

I/O, reading only. rosbags decompresses without a bound; ``bound_rosbags`` puts these functions into its tables.
"""

from __future__ import annotations

import bz2
import os
import sys
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import ReaderError as ReaderError2
from rosbags.rosbag2 import storage_mcap

from gdp.errors import LocalError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

CHUNK_MAX_BYTES: Final = 64 << 20  # unpacked; more than twice the largest message that can be sent
_FILE_RATIO_MAX: Final = 100  # unpacked bytes for each byte of a compressed file, in addition to the first 64 MiB
_ASKED_BYTES: Final = 4 << 10  # may be requested without checking the file's length
_WINDOW_LOG_MAX: Final = 26  # memory of a zstd decoder: 64 MiB


class SalvageError(LocalError):
    """Not even the beginning of a file is a valid recording."""


def unpack(compression: str, data: bytes, size: int | None = None, *, is_whole: bool = False) -> bytes:
    """Return the decompressed part of a chunk; a truncated chunk yields its beginning, unless ``is_whole``.

    Args:
        size: unpacked bytes as its header states; None: unknown.

    Raises:
        SalvageError: the compression is unknown, the bytes are not of it, or they unpack to more than ``size`` or than
            ``CHUNK_MAX_BYTES``, or are cut off and ``is_whole``.
    """
    if size is not None and size > CHUNK_MAX_BYTES:
        raise SalvageError(f"a chunk of {size} bytes; at most {CHUNK_MAX_BYTES} are read")
    limit = CHUNK_MAX_BYTES if size is None else size
    unpacker: LZ4FrameDecompressor | zstd.ZstdDecompressor | bz2.BZ2Decompressor
    try:
        match compression:
            case "" | "none":
                return data
            case "lz4":
                unpacker = LZ4FrameDecompressor()
            case "zstd":
                unpacker = zstd.ZstdDecompressor(
                    options={int(zstd.DecompressionParameter.window_log_max): _WINDOW_LOG_MAX}
                )
            case "bz2":
                unpacker = bz2.BZ2Decompressor()
            case _:
                raise SalvageError(f"compression {compression[:40]!r} is not supported")
        unpacked = bytes(unpacker.decompress(data, max_length=limit + 1))
    except (RuntimeError, OSError, ValueError, EOFError, zstd.ZstdError) as error:
        raise SalvageError(f"a chunk cannot be unpacked: {error}") from error
    if len(unpacked) > limit:
        raise SalvageError(f"a chunk that unpacks to more than {limit} bytes")
    if is_whole and not unpacker.eof:
        raise SalvageError("its end is missing")
    return unpacked


def file_max_bytes(size: int) -> int:
    """Return the maximum length of a file that is unpacked from ``size`` bytes."""
    return CHUNK_MAX_BYTES + _FILE_RATIO_MAX * size


def unpack_file(path: Path, to: Path) -> None:
    """Unpack a zstd file, unless it would fill the disk: unpacks to more than any recording does.

    Raises:
        SalvageError: it does, or is no zstd.
        OSError: it cannot be read or written.
    """
    limit = file_max_bytes(path.stat().st_size)
    try:
        with zstd.open(path, "rb") as packed, to.open("wb") as file:
            while piece := packed.read(1 << 20):
                if file.tell() + len(piece) > limit:
                    raise SalvageError(f"{path.name} unpacks to more than {limit} bytes")
                file.write(piece)
    except (EOFError, zstd.ZstdError) as error:
        raise SalvageError(f"{path.name} cannot be unpacked: {error}") from error


def bound_rosbags() -> None:
    """Make rosbags unpack within the same bounds, and read no record that is longer than its file."""
    rosbag1_reader.read_bytes = _read_bytes
    storage_mcap.read_exact = _read_exact
    storage_mcap.DECOMPRESSORS["lz4"] = lambda data, size: unpack("lz4", data, size)
    storage_mcap.DECOMPRESSORS["zstd"] = lambda data, size: unpack("zstd", data, size)
    rosbag1_reader.decompressors["bz2"] = lambda data: unpack("bz2", data)
    rosbag1_reader.decompressors["lz4"] = lambda data: unpack("lz4", data)


def _read_bytes(src: BinaryIO, size: int) -> bytes:
    """Read this many bytes of a ROS 1 bag, or of a chunk."""
    data = _read_there(src, size)
    if len(data) != size:
        raise ReaderError1(f"a record of {size} bytes is longer than what holds it")
    return data


def _read_exact(bio: BinaryIO, size: int) -> bytes:
    """Read this many bytes of an MCAP file, or of a chunk."""
    data = _read_there(bio, size)
    if len(data) != size:
        raise ReaderError2(f"a record of {size} bytes is longer than what holds it")
    return data


def _read_there(file: BinaryIO, size: int) -> bytes:
    """Read at most this many bytes; a file reserves memory for the requested size, also beyond its end."""
    if size > _ASKED_BYTES and not isinstance(file, BytesIO):
        size = max(0, min(size, os.fstat(file.fileno()).st_size - file.tell()))
    return file.read(size)
