"""Compression of message bodies with Zstandard, where it makes them shorter.

Sans-I/O. Source: RFC 8878 (Zstandard). One body is one frame without checksum: the seal around it proves integrity. A
body that would not shrink by ``GAIN_MIN`` travels as it is. After bodies that did not shrink, the compressor leaves out
attempts for a growing number of messages, so that a topic of pictures costs nearly nothing.
"""

from __future__ import annotations

import sys
from typing import Final

from gdp.errors import DropReason, LocalError, RemoteError
from proxy.wire.message import DICTIONARY_MAX_BYTES

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

GAIN_MIN: Final = 0.03  # share of the body that compression must save
_SMALL_BYTES: Final = 32  # shorter bodies are never tried: a frame adds up to 9 bytes
_FAILURES_MAX: Final = 3  # attempts without gain in a row, before attempts are left out
_REST_MAX: Final = 256  # messages between two attempts
_WINDOW_LOG_MAX: Final = 25  # memory of a decoder: 32 MiB, above the largest message


class BodyCompressor:
    """Compressor of one topic's bodies.

    Args:
        level: 1 (fast) to ``LEVEL_MAX``.
        dictionary: that ``check_dictionary`` accepts; empty: none.
    """

    __slots__ = ("_compressor", "_failures", "_rest")

    def __init__(self, level: int, dictionary: bytes = b"") -> None:
        options = {
            int(zstd.CompressionParameter.compression_level): level,
            int(zstd.CompressionParameter.dict_id_flag): 0,  # the description contains the dictionary
        }
        self._compressor = zstd.ZstdCompressor(
            options=options, zstd_dict=zstd.ZstdDict(dictionary) if dictionary else None
        )
        self._failures = 0
        self._rest = 0  # messages until the next attempt

    def compress(self, body: bytes) -> bytes | None:
        """Return the compressed body; None where it travels as it is."""
        if len(body) < _SMALL_BYTES:
            return None
        if self._rest:
            self._rest -= 1
            return None
        frame: bytes = self._compressor.compress(body, self._compressor.FLUSH_FRAME)
        if len(frame) <= (1 - GAIN_MIN) * len(body):
            self._failures = 0
            return frame
        self._failures += 1
        if self._failures >= _FAILURES_MAX:
            self._rest = min(1 << self._failures, _REST_MAX)
        return None


class BodyDecompressor:
    """Decompressor of the bodies of one publisher.

    Args:
        max_bytes: longest body after decompression.
        dictionary: empty: none.

    Raises:
        RemoteError: the dictionary is none.
    """

    __slots__ = ("_dictionary", "_max_bytes", "_options")

    def __init__(self, max_bytes: int, dictionary: bytes = b"") -> None:
        self._max_bytes = max_bytes
        self._options = {int(zstd.DecompressionParameter.window_log_max): _WINDOW_LOG_MAX}
        try:
            self._dictionary = zstd.ZstdDict(dictionary) if dictionary else None
            self._decompressor()  # the dictionary itself checks its first bytes only
        except (ValueError, zstd.ZstdError) as error:
            raise RemoteError(DropReason.MALFORMED, f"zstd: {error}") from error

    def decompress(self, frame: bytes) -> bytes:
        """Return the body; memory is bounded by ``max_bytes``, whatever the frame states.

        Raises:
            RemoteError: the bytes are not exactly one frame, or it holds more than ``max_bytes``.
        """
        try:
            decompressor = self._decompressor()
            body: bytes = decompressor.decompress(frame, max_length=self._max_bytes + 1)
        except zstd.ZstdError as error:
            raise RemoteError(DropReason.MALFORMED, f"zstd: {error}"[:200]) from error
        if len(body) > self._max_bytes:
            raise RemoteError(DropReason.MALFORMED, f"zstd: a body of more than {self._max_bytes} bytes")
        if not decompressor.eof or decompressor.unused_data:
            raise RemoteError(DropReason.MALFORMED, "zstd: not exactly one frame")
        return body

    def _decompressor(self) -> zstd.ZstdDecompressor:
        made: zstd.ZstdDecompressor = zstd.ZstdDecompressor(zstd_dict=self._dictionary, options=self._options)
        return made


def check_dictionary(dictionary: bytes) -> bytes:
    """Return the dictionary, which ``zstd --train`` made.

    Raises:
        LocalError: it is too long, or no such dictionary.
    """
    if len(dictionary) > DICTIONARY_MAX_BYTES:
        detail = f"a dictionary of {len(dictionary)} bytes; at most {DICTIONARY_MAX_BYTES} travel to each reader"
        raise LocalError(f"{detail} (zstd --train --maxdict={DICTIONARY_MAX_BYTES})")
    try:
        BodyCompressor(1, dictionary).compress(bytes(_SMALL_BYTES))
    except (ValueError, zstd.ZstdError) as error:
        raise LocalError(f"no dictionary of zstd --train: {error}") from error
    return dictionary
