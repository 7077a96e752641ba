"""MCAP format: its magic, and the records that are written and read here.

Sans-I/O. Source: MCAP format specification, https://mcap.dev/spec (opcodes, little-endian).
"""

from __future__ import annotations

import struct
from typing import Final

MAGIC: Final = b"\x89MCAP0\r\n"
RECORD: Final = struct.Struct("<BQ")  # opcode, bytes
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK_HEAD: Final = struct.Struct("<QQQI")  # first time, last time, unpacked bytes, crc
FOOTER: Final = struct.Struct("<QQI")  # start of the summary, of its offsets, crc


class Opcode:
    """Kinds of records; plain numbers, because each record of a file is compared with some."""

    HEADER: Final = 0x01
    FOOTER: Final = 0x02
    SCHEMA: Final = 0x03
    CHANNEL: Final = 0x04
    MESSAGE: Final = 0x05
    CHUNK: Final = 0x06
    MESSAGE_INDEX: Final = 0x07
    CHUNK_INDEX: Final = 0x08
    STATISTICS: Final = 0x0B
    SUMMARY_OFFSET: Final = 0x0E
    DATA_END: Final = 0x0F
