"""Writer of an MCAP file in chunks, each of which is complete in the file once it is flushed.

I/O. Source: MCAP format specification, https://mcap.dev/spec; the metadata of channels are those of
rosbag2_storage_mcap.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from enum import Enum
from io import BytesIO, FileIO, StringIO
from typing import BinaryIO, Final

from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability

from proxy.endpoints.core.endpoint import Origin
from proxy.recordings.mcap_format import CHUNK_HEAD, FOOTER, MAGIC, MESSAGE_HEAD, RECORD, Opcode
from proxy.serial.channel import Channel, DefinitionFormat, Qos

CHUNK_BYTES: Final = 1 << 20  # a chunk is written when it has more
_ENCODINGS: Final[dict[DefinitionFormat, str]] = {"msg": "ros2msg", "idl": "ros2idl", "": ""}


class McapWriter:
    """An MCAP file in progress.

    Args:
        file: empty, open for writing without a buffer.

    Attributes:
        written: messages in complete chunks.
    """

    def __init__(self, file: BinaryIO | FileIO) -> None:
        self.file = file
        self._end = 0  # of what is complete in the file
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels = 0
        self._described = {Opcode.SCHEMA: BytesIO(), Opcode.CHANNEL: BytesIO()}  # their records, for the summary
        self._chunk = BytesIO()
        self._index: dict[int, list[tuple[int, int]]] = {}  # of the chunk: by channel, stamp and offset
        self._pending = 0  # messages of the chunk
        self._chunks = BytesIO()  # index records of those before it
        self._chunk_count = 0
        self._counts: dict[int, int] = {}
        self._span = (1 << 63, 0)
        self.written = 0
        self._append(MAGIC + _record(Opcode.HEADER, _text("ros2") + _text("gdp")))

    def connect(self, channel: Channel) -> None:
        """Add a channel; the first has number 0. Raises ``struct.error``: one too many."""
        key = channel.type_name, channel.definition
        if key not in self._schemas:
            self._schemas[key] = len(self._schemas) + 1  # 0: no schema
            definition = channel.definition.encode("utf-8", "replace")
            words = _text(channel.type_name) + _text(_ENCODINGS[channel.definition_format])
            self._describe(Opcode.SCHEMA, struct.pack("<H", self._schemas[key]) + words + _sized(definition))
        about = {"offered_qos_profiles": offered(channel), "topic_type_hash": channel.hash}
        head = struct.pack("<HH", self._channels, self._schemas[key])
        self._describe(Opcode.CHANNEL, head + _text(channel.topic) + _text("cdr") + _map(about))
        self._counts[self._channels] = 0
        self._channels += 1

    def write(self, number: int, stamp_ns: int, raw: bytes, origin: Origin) -> None:
        """Add a message to the chunk; its log time is the stamp, its publish time and number are those of the origin.

        Raises:
            OSError: the chunk is full, and cannot be written.
        """
        self._index.setdefault(number, []).append((stamp_ns, self._chunk.tell()))
        self._chunk.write(RECORD.pack(Opcode.MESSAGE, MESSAGE_HEAD.size + len(raw)))
        sequence = origin.sequence & 0xFFFFFFFF
        self._chunk.write(MESSAGE_HEAD.pack(number, sequence, stamp_ns, origin.published_ns))
        self._chunk.write(raw)
        self._pending += 1
        if self._chunk.tell() > CHUNK_BYTES:
            self.flush()

    @property
    def unwritten_bytes(self) -> int:
        """Return about the most bytes that the file still takes until it is complete."""
        described = sum(each.tell() for each in self._described.values())
        indexed = 32 * self._pending + 138 * self._channels
        return self._chunk.tell() + indexed + described + self._chunks.tell() + 1_024

    def flush(self) -> None:
        """Write the chunk and its index.

        Raises:
            OSError: it cannot be written; the file ends before it, and its messages are lost.
        """
        records = self._chunk.getvalue()
        if not records:
            return
        index, self._index, self._chunk, self._pending = self._index, {}, BytesIO(), 0
        stamps = [stamp_ns for each in index.values() for stamp_ns, _ in each] or [0]
        span = min(stamps), max(stamps)
        head = CHUNK_HEAD.pack(*span, len(records), zlib.crc32(records)) + _text("")
        chunk = _record(Opcode.CHUNK, head + struct.pack("<Q", len(records)) + records)
        places, offsets = b"", b""
        for number, pairs in index.items():
            offsets += struct.pack("<HQ", number, self._end + len(chunk) + len(places))
            packed = b"".join(struct.pack("<QQ", *each) for each in pairs)
            places += _record(Opcode.MESSAGE_INDEX, struct.pack("<H", number) + _sized(packed))
        about = struct.pack("<QQQQ", *span, self._end, len(chunk)) + _sized(offsets)
        about += struct.pack("<Q", len(places)) + _text("") + struct.pack("<QQ", len(records), len(records))
        self._append(chunk + places)
        self._chunks.write(_record(Opcode.CHUNK_INDEX, about))
        self._chunk_count += 1
        for number, pairs in index.items():
            self._counts[number] += len(pairs)
        if index:
            self._span = min(self._span[0], span[0]), max(self._span[1], span[1])
        self.written = sum(self._counts.values())

    def finish(self) -> None:
        """Write what is left, then the summary; the file is complete and stays open.

        Raises:
            OSError: it cannot be written.
        """
        self.flush()
        data_end = _record(Opcode.DATA_END, bytes(4))
        start = self._end + len(data_end)
        first, last = self._span if self.written else (0, 0)
        counts = (len(self._schemas), len(self._counts), 0, 0, self._chunk_count)
        statistics = struct.pack("<QHIIIIQQ", self.written, *counts, first, last)
        statistics += _sized(b"".join(struct.pack("<HQ", *each) for each in self._counts.items()))
        groups = (
            *((code, records.getvalue()) for code, records in self._described.items()),
            (Opcode.CHUNK_INDEX, self._chunks.getvalue()),
            (Opcode.STATISTICS, _record(Opcode.STATISTICS, statistics)),
        )
        summary, offsets = b"", b""
        for code, records in groups:
            if records:
                offsets += _record(Opcode.SUMMARY_OFFSET, struct.pack("<BQQ", code, start + len(summary), len(records)))
            summary += records
        footer = RECORD.pack(Opcode.FOOTER, FOOTER.size) + struct.pack("<QQ", start, start + len(summary))
        crc = zlib.crc32(summary + offsets + footer)
        self._append(data_end + summary + offsets + footer + struct.pack("<I", crc) + MAGIC)

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self.file.write(rest) :]
        except OSError:
            self.file.truncate(self._end)  # what is complete stays readable, and there is space for the summary
            self.file.seek(self._end)
            raise
        self._end += len(data)

    def _describe(self, code: int, content: bytes) -> None:
        record = _record(code, content)
        self._described[code].write(record)
        self._chunk.write(record)


def _record(code: int, content: bytes) -> bytes:
    return RECORD.pack(code, len(content)) + content


def _sized(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def _text(text: str) -> bytes:
    return _sized(text.encode("utf-8", "replace"))


def _map(items: Mapping[str, str]) -> bytes:
    return _sized(b"".join(_text(key) + _text(value) for key, value in items.items()))


def offered(channel: Channel) -> str:
    """Return the offered profiles as rosbag2 writes them; empty: there are none."""
    if not channel.qos:
        return ""
    from ruamel.yaml import YAML

    stream = StringIO()
    yaml = YAML(typ="safe")
    yaml.default_flow_style = False
    yaml.dump([_profile(each) for each in channel.qos], stream)
    return stream.getvalue().strip()


def _profile(qos: Qos) -> dict[str, object]:
    """Return a profile as version 9 of rosbag2's metadata has it."""
    deadline, lifespan, lease = ({"sec": sec, "nsec": nsec} for sec, nsec in (qos.deadline, qos.lifespan, qos.lease))
    return {
        "history": _policy(QosHistory, qos.history),
        "depth": qos.depth,
        "reliability": _policy(QosReliability, qos.reliability),
        "durability": _policy(QosDurability, qos.durability),
        "deadline": deadline,
        "lifespan": lifespan,
        "liveliness": _policy(QosLiveliness, qos.liveliness),
        "liveliness_lease_duration": lease,
        "avoid_ros_namespace_conventions": qos.plain_names,
    }


def _policy(policies: type[Enum], word: str) -> str:
    return word if word in map(str.lower, policies.__members__) else "unknown"
