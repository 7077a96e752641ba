"""Capture files: pcap and pcapng to read, pcapng to write.

I/O. Scapy reads, because it is here for the layers anyway. It writes no file of several link types, so the writer is
here. What a block says of its length is checked before memory is asked for.
Source: draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng; LINKTYPE_WIRESHARK_UPPER_PDU (252) and its tags are
those of Wireshark's ``epan/exported_pdu.h``::

    section    0A0D0D0A  length (4)  1A2B3C4D  1 (2)  0 (2)  -1 (8)                              length (4)
    interface  00000001  length (4)  link type (2)  0 (2)  longest frame (4)  options             length (4)
    frame      00000006  length (4)  interface (4)  stamp, high, low (4, 4)  here (4)  was (4)  bytes  length (4)
"""

from __future__ import annotations

import contextlib
import gzip
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, Protocol, cast

from scapy.error import Scapy_Exception
from scapy.utils import RawPcapNgReader, RawPcapReader

from gdp.errors import LocalError

ETHERNET: Final = 1
LONGEST_BYTES: Final = 1 << 18  # Wireshark refuses longer frames
_BLOCK_MAX_BYTES: Final = 16 << 20  # of pcapng: a frame, its comments, names or secrets
_EXPORTED: Final = 252
_MAGICS: Final = frozenset(map(bytes.fromhex, ("a1b2c3d4", "d4c3b2a1", "a1b23c4d", "4d3cb2a1", "0a0d0d0a")))
_GZIP: Final = b"\x1f\x8b"
_NS: Final = 1_000_000_000
_TAG_DISSECTOR: Final = 12
_TAG_FRAME: Final = 30  # number of the frame that it was made from
_IF_NAME: Final = 2
_IF_TSRESOL: Final = 9


class CapturedFrame(NamedTuple):
    """One frame of a capture.

    Args:
        stamp_ns: wall clock.
        ifname: where the file says it, else "".
        wire_bytes: on the link; more than ``data`` has where the capture cut it.
    """

    linktype: int
    ifname: str
    stamp_ns: int
    data: bytes
    wire_bytes: int


class _NgFacts(Protocol):
    """What Scapy reads of a frame in a pcapng file."""

    linktype: int
    tsresol: int | None
    tshigh: int | None
    tslow: int | None
    wirelen: int
    ifname: bytes | str | None


class _BoundedFile:
    """Part of a file's interface that Scapy reads by, which never asks for more bytes than the file has left.

    Raises:
        LocalError: a block is said to be longer than 16 MiB.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._raw = path.open("rb")
        is_packed = self._raw.peek(2)[:2] == _GZIP
        self._file: BinaryIO = cast("BinaryIO", gzip.GzipFile(fileobj=self._raw)) if is_packed else self._raw
        self._left_bytes = _BLOCK_MAX_BYTES if is_packed else os.fstat(self._raw.fileno()).st_size
        self._is_packed = is_packed

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes, fewer at the end of the file."""
        if not 0 <= size <= _BLOCK_MAX_BYTES:
            raise LocalError(f"{self.name}: a block is said to have {size} bytes, more than {_BLOCK_MAX_BYTES}")
        data = self._file.read(min(size, self._left_bytes))
        if not self._is_packed:
            self._left_bytes -= len(data)
        return data

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._raw.close()


def read_capture(path: Path) -> Iterator[CapturedFrame]:
    """Yield the frames of a pcap or pcapng file; an incomplete last one is left out.

    Raises:
        LocalError: the file cannot be read, or is no capture.
    """
    try:
        with contextlib.closing(_BoundedFile(path)) as file:
            magic = file.read(4)
        if magic not in _MAGICS:
            raise LocalError(f"{path}: neither pcap nor pcapng")
        with contextlib.closing(_BoundedFile(path)) as file, RawPcapReader(cast("str", file)) as reader:
            for data, read in reader:
                if isinstance(reader, RawPcapNgReader):
                    facts = cast("_NgFacts", read)
                    stamp_ns = ((facts.tshigh or 0) << 32 | (facts.tslow or 0)) * _NS // (facts.tsresol or 1_000_000)
                    name = facts.ifname or b""
                    ifname = name.decode("utf-8", "replace") if isinstance(name, bytes) else str(name)
                    yield CapturedFrame(facts.linktype, ifname, stamp_ns, data, facts.wirelen)
                else:
                    stamp_ns = read.sec * _NS + read.usec * (1 if reader.nano else 1_000)
                    yield CapturedFrame(reader.linktype, "", stamp_ns, data, read.wirelen)
    except (OSError, EOFError, zlib.error, Scapy_Exception) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise LocalError(f"{path}: {reason}") from error


class PcapngWriter:
    """Writer of a pcapng file with frames of several devices, and of messages that were made from them."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._interfaces: dict[tuple[int, str], int] = {}
        self.frames = 0
        self._block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))

    def write(self, frame: CapturedFrame) -> None:
        """Write a frame as it was captured."""
        self._write(frame.linktype, frame.ifname, frame.stamp_ns, frame.data, frame.wire_bytes)

    def write_opened(self, dissector: str, stamp_ns: int, data: bytes) -> bool:
        """Write bytes for a dissector, which were made from the last frame; return whether they are cut."""
        name = dissector.encode()
        name += bytes(-len(name) % 4)
        tags = struct.pack("!HH", _TAG_DISSECTOR, len(name)) + name
        tags += struct.pack("!HHIHH", _TAG_FRAME, 4, self.frames, 0, 0)
        whole = tags + data
        self._write(_EXPORTED, "opened", stamp_ns, whole[:LONGEST_BYTES], len(whole))
        return len(whole) > LONGEST_BYTES

    def _write(self, linktype: int, ifname: str, stamp_ns: int, data: bytes, wire_bytes: int) -> None:
        interface = self._interfaces.get((linktype, ifname))
        if interface is None:
            interface = self._interfaces[linktype, ifname] = len(self._interfaces)
            options = _option(_IF_TSRESOL, b"\x09") + (_option(_IF_NAME, ifname.encode()) if ifname else b"")
            self._block(1, struct.pack("<HHI", linktype, 0, LONGEST_BYTES) + options + bytes(4))
        head = struct.pack("<IIIII", interface, stamp_ns >> 32, stamp_ns & 0xFFFF_FFFF, len(data), wire_bytes)
        self._block(6, head + data + bytes(-len(data) % 4))
        self.frames += 1

    def _block(self, kind: int, body: bytes) -> None:
        length = struct.pack("<I", len(body) + 12)
        self._file.write(struct.pack("<I", kind) + length + body + length)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)
