"""Writer of a recording: ROS 2 messages as one MCAP file, ROS 1 messages as a bag.

I/O. Until it is complete, the file has the suffix ``.partial``. What was flushed can be read whatever happens:
``gdp recording finish`` completes the file of a killed process. A disk that fills is watched: the recording ends while
there is space for its index.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

from gdp.closing import ClosedOnExit
from gdp.errors import LocalError
from gdp.stores.files import sync
from proxy.endpoints.core.endpoint import Origin
from proxy.recordings.mcap_writer import CHUNK_BYTES, McapWriter
from proxy.serial.bounded_cache import digest_of
from proxy.serial.channel import Channel, RosVersion
from proxy.serial.schema import definition_bytes

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

log = logging.getLogger(__name__)

PARTIAL: Final = ".partial"
_STAMPS_NS: Final = {1: (1 << 32) * 1_000_000_000, 2: 1 << 63}
_CONNECTIONS_MAX: Final = 4_096  # each is kept, with its definition, until the file is finished
_DEFINITIONS_MAX_BYTES: Final = 64 << 20
_SPARE_BYTES: Final = 256 << 10  # of the disk, for what others write meanwhile and for the file system's own blocks
_ANY_MD5: Final = "*"  # ROS 1's own value for an unknown one


class BagWriter(ClosedOnExit):
    """A recording in progress. Close it, or use it as a context; what was written stays in any case.

    Args:
        path: the file to create, ``.mcap`` for ROS 2 or ``.bag`` for ROS 1.
        ros: version of the messages; one recording holds one kind.

    Attributes:
        failure: why nothing is written any more; empty while it is.
        is_closed: nothing more can be written.

    Raises:
        LocalError: the file exists, or cannot be created.
    """

    def __init__(self, path: Path | str, ros: RosVersion) -> None:
        self.path = Path(path)
        self.partial = self.path.with_name(self.path.name + PARTIAL)
        self.ros = ros
        self.failure = ""
        _refuse_existing(self.path)
        try:
            _put_aside(self.partial)
            self._format: McapWriter | _Ros1Format = (
                _Ros1Format(self.partial) if ros == 1 else McapWriter(self.partial.open("xb", buffering=0))
            )
            fcntl.flock(self._format.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            sync(self.path.parent)
        except OSError as error:
            raise LocalError(f"{self.path} cannot be made: {error.strerror}") from error
        self._handles: dict[tuple[object, ...], int] = {}  # by the properties that the format can distinguish
        self._definitions_bytes = 0
        self._syncs = ThreadPoolExecutor(1, "sync")
        self._synced: Future[None] | None = None
        self._synced_bytes = 0  # of the file, when it was last put on the disk
        self.is_closed = False

    @property
    def written(self) -> int:
        """Return the messages that can be read from the file, whatever happens now."""
        return self._format.written

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
            if len(self._handles) >= _CONNECTIONS_MAX or size > _DEFINITIONS_MAX_BYTES:
                raise LocalError(f"{channel.topic} cannot be recorded: the recording has too many channels")
            self._check_open()
            self._format.connect(channel)
            self._definitions_bytes = size
            self._handles[reporter] = len(self._handles)
        return self._handles[reporter]

    def write(self, handle: int, stamp_ns: int, raw: bytes, origin: Origin | None = None) -> None:
        """Record one message.

        Args:
            stamp_ns: Unix time; of ROS 1 at most 32 bits of seconds.
            raw: the message in its own wire form.
            origin: time and number of its publisher, which a bag of ROS 1 cannot hold; None: the stamp, and 0.

        Raises:
            LocalError: closed, a stamp out of range, or the disk is full; ``failure`` has the reason.
        """
        if not 0 <= stamp_ns < _STAMPS_NS[self.ros]:
            raise LocalError(f"{self.path}: a stamp of {stamp_ns} ns cannot be recorded")
        self._check_open()
        try:
            free = os.fstatvfs(self._format.file.fileno())
            if free.f_bavail * free.f_frsize < self._format.unwritten_bytes + 2 * len(raw) + _SPARE_BYTES:
                self._fail(f"no space is left on the disk of {self.path.parent.absolute()}")
            self._format.write(handle, stamp_ns, raw, origin or Origin(stamp_ns, 0))
        except OSError as error:
            self._fail(f"{self.path} cannot be written: {error.strerror}")

    def flush(self) -> None:
        """Write what is kept in memory, and have it put on the disk meanwhile; a failure becomes ``failure``."""
        if self.failure or self.is_closed:
            return
        try:
            self._format.flush()
            if self._synced is None or self._synced.done():
                if self._synced is not None:
                    self._synced.result()
                if (size_bytes := self._format.file.tell()) > self._synced_bytes:
                    self._synced = self._syncs.submit(os.fdatasync, self._format.file.fileno())
                    self._synced_bytes = size_bytes
        except OSError as error:
            self.failure = f"{self.path} cannot be written: {error.strerror}"

    def close(self) -> None:
        """Complete the file and give it its name; further calls have no effect.

        Raises:
            LocalError: it cannot be completed; what was written stays under ``partial``.
        """
        if self.is_closed:
            return
        self.is_closed = True
        try:
            self._format.finish()
            sync(self.partial)
            _refuse_existing(self.path)
            self.partial.rename(self.path)
            sync(self.path.parent)
        except OSError as error:
            why = f"{self.path} cannot be written: {error.strerror}"
            raise LocalError(
                f"{why}; {self.written} messages are in {self.partial}: gdp recording finish {self.partial}"
            ) from error
        finally:
            self._syncs.shutdown()
            with contextlib.suppress(OSError):  # of a write that has failed, and is reported
                self._format.file.close()

    def _check_open(self) -> None:
        if self.is_closed:
            raise LocalError(f"{self.path} is closed")
        if self.failure:
            raise LocalError(self.failure)

    def _fail(self, failure: str) -> None:
        self.failure = failure
        raise LocalError(failure)


class _Ros1Format:
    """A ROS 1 bag in progress, written by rosbags."""

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Writer, WriterError  # a recorder of ROS 2 needs no module of rosbags

        self._refused = WriterError, AssertionError
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
        indexed = 12 * self._pending + 8 * len(self._connections)
        chunks = len(self._writer.chunks) * (128 + 8 * len(self._connections))
        return self._writer.chunks[-1].data.tell() + indexed + chunks + self._definitions_bytes + 8_192

    def connect(self, channel: Channel) -> None:
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
        except self._refused as error:
            raise LocalError(f"{channel.topic} cannot be recorded: {error}") from error
        self._connections.append(connection)

    def write(self, number: int, stamp_ns: int, raw: bytes, origin: Origin) -> None:
        del origin
        self._writer.write(self._connections[number], stamp_ns, raw)
        self._pending += 1
        if self._writer.chunks[-1].data.tell() > CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        try:
            self._writer.write_chunk(self._writer.chunks[-1])
            self.file.flush()
        except OSError as error:
            self._torn = error
            raise
        self.written += self._pending
        self._pending = 0

    def finish(self) -> None:
        if self._torn is not None:
            raise self._torn
        self.flush()
        self._writer.close()


def _refuse_existing(path: Path) -> None:
    """Refuse to record into an existing file, with a ``LocalError``."""
    if path.exists():
        raise LocalError(f"{path} exists already")


def _put_aside(partial: Path) -> None:
    """Give the file of a run that was killed another name, so that a new run can record.

    Raises:
        LocalError: another process writes it.
    """
    if not partial.exists():
        return
    with partial.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise LocalError(f"{partial} is being written by another process") from error
        name = partial.name.removesuffix(PARTIAL)
        stem, suffix = Path(name).stem, Path(name).suffix
        places = (partial.with_name(f"{stem}-killed{number}{suffix}{PARTIAL}") for number in count(1))
        place = next(each for each in places if not each.exists() and not each.with_suffix("").exists())
        partial.rename(place)
    log.warning("a run that was killed left a recording: gdp recording finish %s", place)


def _reporter(channel: Channel) -> tuple[object, ...]:
    definition = digest_of(channel.definition)
    about = (channel.hash, channel.qos) if channel.ros == 2 else (channel.hash, channel.latched, channel.callerid)
    return channel.topic, channel.type_name, definition, channel.definition_format, *about
