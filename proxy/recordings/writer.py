"""Writer of a recording: ROS 2 messages as one MCAP file, ROS 1 messages as a bag.

I/O. A recording gets its name when it is closed; until then it is a hidden file in the same folder. So a killed process
leaves nothing that looks complete.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Final

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag1 import WriterError as WriterError1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2 import WriterError as WriterError2

from gdp.errors import LocalError
from proxy.recordings.channels import to_qos
from proxy.serial.bounded_cache import digest_of
from proxy.serial.channel import Channel, RosVersion
from proxy.serial.schema import definition_bytes

__all__ = ["BagWriter"]

_UNKNOWN_HASH: Final = "RIHS01_" + "0" * 64
_STAMPS_NS: Final = {1: (1 << 32) * 1_000_000_000, 2: 1 << 63}
_CONNECTIONS_MAX: Final = 4_096  # rosbags keeps each, and its definition, until the file is finished
_DEFINITIONS_MAX_BYTES: Final = 64 << 20
_ANY_MD5: Final = "*"  # ROS 1's own value for an unknown one


class BagWriter:
    """A recording in progress. Close it, or use it as a context: an exception inside discards it.

    Args:
        path: the file to create, ``.mcap`` for ROS 2 or ``.bag`` for ROS 1.
        ros: version of the messages; one recording holds one kind.

    Raises:
        LocalError: the file exists, or cannot be created.
    """

    def __init__(self, path: Path | str, ros: RosVersion) -> None:
        self.path = Path(path)
        self.ros = ros
        if self.path.exists():
            raise LocalError(f"{self.path} exists already")
        try:
            self._folder = Path(tempfile.mkdtemp(prefix=f".{self.path.name}.", dir=self.path.parent))
        except OSError as error:
            raise LocalError(f"{self.path} cannot be made: {error.strerror}") from error
        self._handles: dict[tuple[object, ...], int] = {}  # by the properties that the format can distinguish
        self._definitions_bytes = 0
        self._connections: list[Connection] = []
        self._writer1: Writer1 | None = None
        self._writer2: Writer2 | None = None
        if ros == 1:
            self._writer1 = Writer1(self._folder / "bag")
            self._writer1.open()
        else:
            self._writer2 = Writer2(self._folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer2.open()

    def add(self, channel: Channel) -> int:
        """Return the handle of a channel, the same for an equal one.

        Raises:
            LocalError: a channel of the other ROS, one that the format cannot hold, or one too many.
        """
        if channel.ros != self.ros:
            raise LocalError(f"{channel.topic} is of ROS {channel.ros}, the recording of ROS {self.ros}")
        reporter = _reporter(channel)
        if reporter not in self._handles:
            size = self._definitions_bytes + definition_bytes(channel.definition)
            if len(self._connections) >= _CONNECTIONS_MAX or size > _DEFINITIONS_MAX_BYTES:
                raise LocalError(f"{channel.topic} cannot be recorded: the recording has too many channels")
            try:
                self._connections.append(self._connect(channel))
            except (WriterError1, WriterError2, AssertionError) as error:
                raise LocalError(f"{channel.topic} cannot be recorded: {error}") from error
            self._definitions_bytes = size
            self._handles[reporter] = len(self._connections) - 1
        return self._handles[reporter]

    def write(self, handle: int, stamp_ns: int, raw: bytes) -> None:
        """Record one message.

        Args:
            stamp_ns: Unix time; of ROS 1 at most 32 bits of seconds.
            raw: the message in its own wire form.

        Raises:
            LocalError: closed, a stamp out of range, or the disk is full.
        """
        connection = self._connections[handle]
        if not 0 <= stamp_ns < _STAMPS_NS[self.ros]:
            raise LocalError(f"{self.path}: a stamp of {stamp_ns} ns cannot be recorded")
        try:
            if self._writer1 is not None:
                self._writer1.write(connection, stamp_ns, raw)
            elif self._writer2 is not None:
                self._writer2.write(connection, stamp_ns, raw)
            else:
                raise LocalError(f"{self.path} is closed")
        except OSError as error:
            raise LocalError(f"{self.path} cannot be written: {error.strerror}") from error

    def close(self) -> None:
        """Finish the file and rename it; further calls have no effect.

        Raises:
            LocalError: it cannot be written.
        """
        if self._writer1 is None and self._writer2 is None:
            return
        try:
            self._finish().rename(self.path)
        except OSError as error:
            raise LocalError(f"{self.path} cannot be written: {error.strerror}") from error
        finally:
            self.discard()

    def discard(self) -> None:
        """Delete the unfinished file."""
        writer1, self._writer1 = self._writer1, None
        writer2, self._writer2 = self._writer2, None
        if writer1 is not None:
            writer1.abort()
        if writer2 is not None:
            writer2.abort()
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def _finish(self) -> Path:
        if self._writer1 is not None:
            self._writer1.close()
            self._writer1 = None
        if self._writer2 is not None:
            self._writer2.close()
            self._writer2 = None
            return self._folder / "bag" / "bag.mcap"
        return self._folder / "bag"

    def _connect(self, channel: Channel) -> Connection:
        if self._writer1 is not None:
            return self._writer1.add_connection(
                channel.topic,
                channel.type_name,
                msgdef=channel.definition,
                md5sum=channel.hash or _ANY_MD5,
                callerid=channel.callerid,
                latching=1 if channel.latched else None,
            )
        if self._writer2 is not None:
            return self._writer2.add_connection(
                channel.topic,
                channel.type_name,
                msgdef=channel.definition,
                rihs01=channel.hash or _UNKNOWN_HASH,
                offered_qos_profiles=[to_qos(profile) for profile in channel.qos],
            )
        raise LocalError(f"{self.path} is closed")


def _reporter(channel: Channel) -> tuple[object, ...]:
    if channel.ros == 2:  # the hash and the definition belong to the type, not to the channel
        return channel.topic, channel.type_name, channel.qos
    definition = digest_of(channel.definition)
    return channel.topic, channel.type_name, definition, channel.hash, channel.latched, channel.callerid
