"""Writer of a ROS 1 bag by rosbags, in chunks that are written here.

I/O.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import BinaryIO, Final

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer, WriterError

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import Origin
from proxy.recordings.mcap_writer import CHUNK_BYTES
from proxy.serial.channel import Channel

_ANY_MD5: Final = "*"  # ROS 1's own value for an unknown one


class Ros1Writer:
    """A ROS 1 bag in progress.

    Attributes:
        written: messages in complete chunks.

    Raises:
        LocalError: rosbags did not open it.
    """

    def __init__(self, path: Path) -> None:
        self._writer = Writer(path)
        self._writer.chunk_threshold = sys.maxsize  # chunks are written here
        self._writer.open()
        if self._writer.bio is None:
            raise LocalError(f"{path}: rosbags did not open it")
        self.file: BinaryIO = self._writer.bio
        self._connections: list[Connection] = []
        self._definitions_bytes = 0
        self._torn: OSError | None = None  # a chunk was written in part
        self._pending = 0
        self.written = 0

    @property
    def unwritten_bytes(self) -> int:
        """Return about the most bytes that the file still takes until it is complete."""
        indexed = 12 * self._pending + 8 * len(self._connections)
        chunks = len(self._writer.chunks) * (128 + 8 * len(self._connections))
        return self._writer.chunks[-1].data.tell() + indexed + chunks + self._definitions_bytes + 8_192

    def connect(self, channel: Channel) -> None:
        """Add a channel; the first has number 0. Raises ``LocalError``: the format cannot hold it."""
        self._definitions_bytes += len(channel.definition) + 1_024
        try:
            connection = self._writer.add_connection(
                channel.topic,
                channel.type_name,
                msgdef=channel.definition,
                md5sum=channel.hash or _ANY_MD5,
                callerid=channel.callerid,
                latching=1 if channel.latched else None,
            )
        except (WriterError, AssertionError) as error:
            raise LocalError(f"{channel.topic} cannot be recorded: {error}") from error
        self._connections.append(connection)

    def write(self, number: int, stamp_ns: int, raw: bytes, origin: Origin) -> None:
        """Add a message to the chunk. Raises ``OSError``: the chunk is full, and cannot be written."""
        del origin
        self._writer.write(self._connections[number], stamp_ns, raw)
        self._pending += 1
        if self._writer.chunks[-1].data.tell() > CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the chunk. Raises ``OSError``: it cannot be written."""
        try:
            self._writer.write_chunk(self._writer.chunks[-1])
            self.file.flush()
        except OSError as error:
            self._torn = error
            raise
        self.written += self._pending
        self._pending = 0

    def finish(self) -> None:
        """Write what is left; the file is complete and stays open. Raises ``OSError``: it cannot be written."""
        if self._torn is not None:
            raise self._torn
        self.flush()
        self._writer.close()
