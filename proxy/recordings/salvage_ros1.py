"""Salvage of a ROS 1 bag: read chunk by chunk, without its index, if it was never closed or is truncated.

I/O, reading only.
Source: ROS 1 bag format 2.0, http://wiki.ros.org/Bags/Format/2.0 (records of a header and data, little-endian).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, Final

from rosbags.typesys.msg import normalize_msgtype

from proxy.recordings.channels import from_ros1
from proxy.recordings.source import Chunk, Place, Scan, ScannedSource
from proxy.recordings.unpacking import SalvageError, unpack
from proxy.serial.channel import Channel

MAGIC: Final = b"#ROSBAG V2.0\n"

_MESSAGE, _BAG, _CHUNK, _CONNECTION = 2, 3, 5, 7
_SIZE: Final = struct.Struct("<I")
_LENGTH: Final = struct.Struct("<Q")
_TIME: Final = struct.Struct("<II")


def scan(path: Path) -> ScannedSource:
    """Return the readable part; errors as of ``Scan.source``."""
    return _Found().source(path, MAGIC)


class _Found(Scan):
    form = "a ROS 1 bag of format 2.0"
    empty = "no connection in it"

    def traverse(self, file: BinaryIO, size: int) -> str:
        """Read every record; return why it ended early, empty where it did not."""
        while True:
            at = file.tell()
            if at == size:
                return ""
            try:
                header = _fields(_sized(file, size))
                (length,) = _SIZE.unpack(file.read(_SIZE.size))
                start = file.tell()
                data = file.read(min(length, size - start))
                code = _code(header)
                if code == _BAG:
                    (index_at,) = _LENGTH.unpack(header.get(b"index_pos", bytes(8)))
                    self.unclosed = "" if index_at else "the recording was never closed"
                    self.stats.missing_bytes = max(0, index_at - size)
                    self.stats.scanned_bytes = size
                elif code == _CHUNK:
                    self._chunk(header, data, start)
                elif len(data) == length:
                    self._record(code, header, data, -1, start)
            except (struct.error, EOFError):
                return f"the file ends in the middle, at byte {size}"
            except (UnicodeDecodeError, KeyError, SalvageError) as error:
                return f"a record at byte {at} cannot be read ({error})"
            if len(data) < length:
                return f"the file ends in the middle, at byte {size}"

    def _chunk(self, header: dict[bytes, bytes], packed: bytes, start: int) -> None:
        compression = header[b"compression"].decode()
        (size,) = _SIZE.unpack(header[b"size"])
        data = unpack(compression, packed, size)
        self.chunks.append(Chunk(start, len(packed), compression, size))
        at = 0
        while at + _SIZE.size <= len(data):
            (size,) = _SIZE.unpack_from(data, at)
            fields = data[at + _SIZE.size : at + _SIZE.size + size]
            at += _SIZE.size + size
            if at + _SIZE.size > len(data):
                return
            (size,) = _SIZE.unpack_from(data, at)
            at += _SIZE.size
            if at + size > len(data):
                return
            inner = _fields(fields)
            self._record(_code(inner), inner, data[at : at + size], len(self.chunks) - 1, at)
            at += size

    def _record(self, code: int, header: dict[bytes, bytes], data: bytes, chunk: int, start: int) -> None:
        if code not in (_MESSAGE, _CONNECTION):
            return
        (number,) = _SIZE.unpack(header[b"conn"])
        if code == _MESSAGE:
            seconds, nanoseconds = _TIME.unpack(header[b"time"])
            if number in self._omitted:
                return
            if number not in self._index:
                raise SalvageError(f"a message of an unknown connection {number}")
            self.stats.messages += 1
            stamp_ns = seconds * 1_000_000_000 + nanoseconds
            self.places.append(Place(stamp_ns, len(self.places), self._index[number], chunk, start, len(data)))
        elif number not in self._index and number not in self._omitted:
            topic = header[b"topic"].decode("utf-8", "replace")
            self.add(number, topic, lambda: channel_of(topic, _fields(data)))


def channel_of(topic: str, about: Mapping[bytes, bytes]) -> Channel:
    """Return a channel from a connection's header; its texts need not be UTF-8. Raises ``SalvageError``: no type."""
    callerid = about.get(b"callerid")
    if b"type" not in about:
        raise SalvageError("it has no type")
    return from_ros1(
        topic,
        normalize_msgtype(about[b"type"].decode("utf-8", "replace")),
        about.get(b"md5sum", b"").decode("utf-8", "replace"),
        about.get(b"message_definition", b"").decode("utf-8", "replace"),
        "msg",
        latched=about.get(b"latching") == b"1",
        callerid=None if callerid is None else callerid.decode("utf-8", "replace"),
    )


def _sized(file: BinaryIO, limit: int) -> bytes:
    (size,) = _SIZE.unpack(file.read(_SIZE.size))
    if file.tell() + size > limit:
        raise EOFError
    return file.read(size)


def _fields(data: bytes) -> dict[bytes, bytes]:
    fields = {}
    at = 0
    while at < len(data):
        (size,) = _SIZE.unpack_from(data, at)
        at += _SIZE.size
        name, equals, value = data[at : at + size].partition(b"=")
        if not equals or at + size > len(data):
            raise SalvageError("not a header")
        fields[name] = value
        at += size
    return fields


def _code(header: dict[bytes, bytes]) -> int:
    code = header[b"op"]
    return code[0] if code else 0
