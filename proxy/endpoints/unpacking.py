"""Decompression of chunks that anyone may have written: never more bytes than their header says, or than the cap.

Layer: I/O, reading only. rosbags decompresses without a bound; ``bound_rosbags`` puts these into its tables.
"""

from __future__ import annotations

import bz2
import sys
from pathlib import Path
from typing import Final

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import storage_mcap

from gdp.errors import LocalError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

__all__ = ["CHUNK_MAX_BYTES", "SalvageError", "bound_rosbags", "check_file", "file_max_bytes", "unpack"]

CHUNK_MAX_BYTES: Final = 64 << 20  # unpacked; more than twice the largest message that can travel
_FILE_RATIO_MAX: Final = 100  # unpacked bytes for each byte of a compressed file, beside the first 64 MiB
_WINDOW_LOG_MAX: Final = 26  # memory of a zstd decoder: 64 MiB


class SalvageError(LocalError):
    """Not even the beginning of a file is a recording."""


def unpack(compression: str, data: bytes, size: int | None = None) -> bytes:
    """Return as much of a chunk as its bytes give; a chunk that ends early gives its beginning.

    Args:
        size: unpacked bytes as its header says; None: unknown.

    Raises:
        SalvageError: the compression is unknown, the bytes are not of it, or they unpack to more than ``size`` or than
            ``CHUNK_MAX_BYTES``.
    """
    if size is not None and size > CHUNK_MAX_BYTES:
        raise SalvageError(f"a chunk of {size} bytes; at most {CHUNK_MAX_BYTES} are read")
    limit = CHUNK_MAX_BYTES if size is None else size
    try:
        match compression:
            case "" | "none":
                return data
            case "lz4":
                unpacked = bytes(LZ4FrameDecompressor().decompress(data, max_length=limit + 1))
            case "zstd":
                options = {int(zstd.DecompressionParameter.window_log_max): _WINDOW_LOG_MAX}
                unpacked = zstd.ZstdDecompressor(options=options).decompress(data, max_length=limit + 1)
            case "bz2":
                unpacked = bz2.BZ2Decompressor().decompress(data, max_length=limit + 1)
            case _:
                raise SalvageError(f"compression {compression[:40]!r} is not supported")
    except (RuntimeError, OSError, ValueError, EOFError, zstd.ZstdError) as error:
        raise SalvageError(f"a chunk cannot be unpacked: {error}") from error
    if len(unpacked) > limit:
        raise SalvageError(f"a chunk that unpacks to more than {limit} bytes")
    return unpacked


def file_max_bytes(size: int) -> int:
    """Return how long a file may become that is unpacked from ``size`` bytes."""
    return CHUNK_MAX_BYTES + _FILE_RATIO_MAX * size


def check_file(path: Path) -> None:
    """Refuse a file of zstd that would fill the disk: one that unpacks to more than any recording does.

    Raises:
        SalvageError: it does, or is no zstd.
        OSError: it cannot be read.
    """
    limit = file_max_bytes(path.stat().st_size)
    count = 0
    try:
        with zstd.open(path, "rb") as file:
            while piece := file.read(1 << 20):
                count += len(piece)
                if count > limit:
                    raise SalvageError(f"{path.name} unpacks to more than {limit} bytes")
    except (EOFError, zstd.ZstdError) as error:
        raise SalvageError(f"{path.name} cannot be unpacked: {error}") from error


def bound_rosbags() -> None:
    """Have rosbags unpack within the same bounds."""
    storage_mcap.DECOMPRESSORS["lz4"] = lambda data, size: unpack("lz4", data, size)
    storage_mcap.DECOMPRESSORS["zstd"] = lambda data, size: unpack("zstd", data, size)
    rosbag1_reader.decompressors["bz2"] = lambda data: unpack("bz2", data)
    rosbag1_reader.decompressors["lz4"] = lambda data: unpack("lz4", data)
