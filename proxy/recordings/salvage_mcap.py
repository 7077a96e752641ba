"""Salvage of an MCAP file: read record by record, without its summary, if it is truncated or was never indexed.

I/O, reading only.
Source: MCAP format specification, https://mcap.dev/spec (opcodes 0x01 to 0x0F, little-endian).
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from proxy.endpoints.core.endpoint import Origin
from proxy.recordings.channels import from_ros2, offered_qos
from proxy.recordings.mcap_format import CHUNK_HEAD, FOOTER, MAGIC, MESSAGE_HEAD, RECORD, Opcode
from proxy.recordings.salvage_ros1 import channel_of
from proxy.recordings.source import Chunk, Heads, Place, Scan, ScannedSource
from proxy.recordings.unpacking import SalvageError, unpack
from proxy.serial.channel import Channel, DefinitionFormat

_FOOTER_BYTES: Final = RECORD.size + FOOTER.size + len(MAGIC)

_ID: Final = struct.Struct("<H")
_IDS: Final = struct.Struct("<HH")
_COUNT: Final = struct.Struct("<I")
_LENGTH: Final = struct.Struct("<Q")
_FORMATS: Final[dict[str, DefinitionFormat]] = {"ros2msg": "msg", "ros2idl": "idl", "omgidl": "idl", "ros1msg": "msg"}


def is_indexed(path: Path) -> bool:
    """Return whether the file has its end, and an undamaged summary that names a chunk."""
    with path.open("rb") as file:
        if file.seek(0, os.SEEK_END) < len(MAGIC) + _FOOTER_BYTES:
            return False
        end = file.seek(-_FOOTER_BYTES, os.SEEK_END)
        footer = file.read()
        if not (footer.endswith(MAGIC) and footer.startswith(RECORD.pack(Opcode.FOOTER, FOOTER.size))):
            return False
        start, _, crc = FOOTER.unpack_from(footer, RECORD.size)
        if not 0 < start < end:
            return False
        file.seek(start)
        summary = file.read(end - start)
    covered = summary + footer[: RECORD.size + FOOTER.size - _COUNT.size]
    return crc in (0, zlib.crc32(covered)) and any(code == Opcode.CHUNK_INDEX for code in _codes(summary))


def _codes(records: bytes) -> Iterator[int]:
    """Yield the opcodes of records."""
    at = 0
    while at + RECORD.size <= len(records):
        code, length = RECORD.unpack_from(records, at)
        yield code
        at += RECORD.size + length


def scan(path: Path) -> ScannedSource:
    """Return the readable part; errors as of ``Scan.source``."""
    return _Found().source(path, MAGIC)


def _origin(head: bytes) -> Origin:
    _, sequence, _, published_ns = MESSAGE_HEAD.unpack(head)
    return Origin(published_ns, sequence)


class _Found(Scan):
    form = "an MCAP file"
    heads = Heads(MESSAGE_HEAD.size, _origin)

    def __init__(self) -> None:
        super().__init__()
        self._schemas: dict[int, tuple[str, DefinitionFormat, str]] = {}

    def traverse(self, file: BinaryIO, size: int) -> str:
        """Read every record; return why it ended early, empty where it did not."""
        while True:
            at = file.tell()
            head = file.read(RECORD.size)
            if len(head) < RECORD.size:
                return f"the file ends in the middle, at byte {size}"
            code, length = RECORD.unpack(head)
            start = at + RECORD.size
            if code in (Opcode.DATA_END, Opcode.FOOTER):
                return ""
            there = min(length, size - start)
            try:
                if code == Opcode.CHUNK:
                    self._chunk(file.read(there), start)
                elif there == length and code == Opcode.MESSAGE:
                    self._message(file.read(MESSAGE_HEAD.size), -1, start, length)
                elif there == length and code in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._describe(code, file.read(there))
            except (struct.error, UnicodeDecodeError, SalvageError) as error:
                if there < length:
                    return f"the file ends in the middle, at byte {size}"
                return f"a record at byte {at} cannot be read ({error})"
            if there < length:
                return f"the file ends in the middle, at byte {size}"
            file.seek(start + length)

    def _chunk(self, record: bytes, start: int) -> None:
        _, _, unpacked_size, _ = CHUNK_HEAD.unpack_from(record)
        compression, at = _text(record, CHUNK_HEAD.size)
        (size,) = _LENGTH.unpack_from(record, at)
        at += _LENGTH.size
        size = min(size, len(record) - at)
        data = unpack(compression, record[at : at + size], unpacked_size)
        if len(data) < unpacked_size:
            self.stats.missing_bytes = unpacked_size - len(data)
        self.stats.scanned_bytes += len(data)
        self.chunks.append(Chunk(start + at, size, compression, unpacked_size))
        at = 0
        while at + RECORD.size <= len(data):
            code, length = RECORD.unpack_from(data, at)
            at += RECORD.size
            if at + length > len(data):
                return
            if code == Opcode.MESSAGE:
                self._message(data[at : at + MESSAGE_HEAD.size], len(self.chunks) - 1, at, length)
            elif code in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._describe(code, data[at : at + length])
            at += length

    def _message(self, head: bytes, chunk: int, start: int, length: int) -> None:
        channel, _, stamp_ns, _ = MESSAGE_HEAD.unpack(head)
        if channel in self._omitted:
            return
        if channel not in self._index or length < MESSAGE_HEAD.size:
            raise SalvageError(f"a message of an unknown channel {channel}")
        size = length - MESSAGE_HEAD.size
        self.stats.messages += 1
        self.places.append(
            Place(stamp_ns, len(self.places), self._index[channel], chunk, start + MESSAGE_HEAD.size, size)
        )

    def _describe(self, code: int, record: bytes) -> None:
        if code == Opcode.SCHEMA:
            (number,) = _ID.unpack_from(record)
            name, at = _text(record, _ID.size)
            encoding, at = _text(record, at)
            text, _ = _text(record, at)
            self._schemas[number] = (name, _FORMATS.get(encoding, ""), text)
            return
        number, schema = _IDS.unpack_from(record)
        if number in self._index or number in self._omitted:
            return
        topic, at = _text(record, _IDS.size)
        encoding, at = _text(record, at)
        self.add(number, topic, lambda: self._channel(topic, encoding, schema, _map(record, at)))

    def _channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> Channel:
        name, definition_format, definition = self._schemas.get(schema, ("", "", ""))
        if encoding == "ros1":
            about = {"type": name, "message_definition": definition} | metadata
            return channel_of(topic, {key.encode(): value.encode() for key, value in about.items()})
        if encoding != "cdr":
            raise SalvageError(f"it is in {encoding or 'no encoding that is named'}, not CDR")
        profiles = offered_qos(topic, metadata.get("offered_qos_profiles", ""), self.left_out)
        digest = metadata.get("topic_type_hash", "")
        return from_ros2(topic, name, digest, definition, definition_format, profiles)


def _text(record: bytes, at: int) -> tuple[str, int]:
    """Return a text, and where it ends. It need not be UTF-8: comments of a definition often are not."""
    (size,) = _COUNT.unpack_from(record, at)
    end = at + _COUNT.size + size
    if end > len(record):
        raise SalvageError("a text longer than its record")
    return record[at + _COUNT.size : end].decode("utf-8", "replace"), end


def _map(record: bytes, at: int) -> dict[str, str]:
    (size,) = _COUNT.unpack_from(record, at)
    at += _COUNT.size
    end = min(at + size, len(record))
    items = {}
    while at < end:
        key, at = _text(record, at)
        items[key], at = _text(record, at)
    return items
