"""Decoder of a recording: ROS 1 bag, sqlite3, MCAP, alone or as a rosbag2 folder; also a truncated one.

I/O, reading only. rosbags reads complete files; ``salvage_*`` scans incomplete ones from the beginning. It runs in a
process of its own (``child``), because a recording may come from anyone.
Errors: a recording that cannot be read at all raises ``ConfigError`` with the file and the reason; a loss is reported
in ``unread``.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Final

import apsw
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as ReaderError2
from rosbags.rosbag2 import metadata as rosbag2_metadata
from rosbags.rosbag2 import reader as rosbag2_reader
from ruamel.yaml.error import YAMLError

from gdp.errors import ConfigError, LocalError
from proxy.recordings import salvage_mcap, salvage_ros1, salvage_sqlite
from proxy.recordings.channels import from_connection
from proxy.recordings.plain_yaml import BoundedYaml, load_plain
from proxy.recordings.source import JoinedSource, Message, Source, UnpackedSource
from proxy.recordings.sqlite_guard import guarded
from proxy.recordings.unpacking import bound_rosbags, check_file
from proxy.serial.channel import Channel
from proxy.serial.schema import DefinitionError, UnparsedError, parse

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

__all__ = ["BagDecoder"]

# These are raised by rosbags and the libraries under it for a malformed file.
_FOREIGN: Final = (
    ReaderError1,
    ReaderError2,
    OSError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    AssertionError,
    RuntimeError,
    ArithmeticError,
    AttributeError,
    MemoryError,
    YAMLError,
    LocalError,
    struct.error,
    apsw.Error,
    zstd.ZstdError,
)
_METADATA_MAX_BYTES: Final = 1 << 20
_STORAGE: Final = ("*.mcap", "*.db3")


class BagDecoder:
    """An open recording.

    Args:
        path: a ``.bag``, ``.mcap`` or ``.db3`` file, or a rosbag2 folder.

    Raises:
        ConfigError: it cannot be read.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            self._source = _open(self.path)
        except _FOREIGN as error:
            raise ConfigError(str(self.path), "", f"cannot be read: {_reason(error)}") from error
        try:
            for channel in self._source.channels:
                _check(self.path, channel)
        except ConfigError:
            self._source.close()
            raise

    @property
    def channels(self) -> list[Channel]:
        """Return every topic of every publisher, in the recording's order."""
        return self._source.channels

    @property
    def count(self) -> int:
        """Return the number of messages that ``messages`` will yield, as far as known in advance."""
        return self._source.count

    @property
    def counts(self) -> list[int] | None:
        """Return the messages of each channel; None where the recording has no index with them."""
        return self._source.counts if isinstance(self._source, _IndexedSource) else None

    @property
    def unread(self) -> str:
        """Return why some messages could not be read, and about how many; empty if all could.

        The text is final after ``messages``.
        """
        return self._source.unread

    def messages(self) -> Iterator[Message]:
        """Yield (channel index, stamp in ns, bytes) in time order; a file that ends early is no error.

        Raises:
            ConfigError: there is not enough memory; ``MemoryError`` is its cause.
        """
        try:
            yield from self._source.messages()
        except MemoryError as error:
            raise ConfigError(str(self.path), "", f"cannot be read: {_reason(error)}") from error

    def close(self) -> None:
        """Close the files."""
        self._source.close()

    def __enter__(self) -> BagDecoder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _check(path: Path, channel: Channel) -> None:
    """Refuse a definition that cannot be read; an absent or unusual one only makes its messages opaque."""
    try:
        parse(channel.type_name, channel.definition, channel.definition_format, channel.ros)
    except UnparsedError as error:
        raise ConfigError(str(path), "", f"cannot be read: topic {channel.topic}: {error}") from error
    except DefinitionError:
        return


def _reason(error: BaseException) -> str:
    text = str(error.strerror) if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split())[:300] or type(error).__name__


def _open(path: Path) -> Source:
    if path.is_dir():
        return _open_folder(path)
    with path.open("rb") as file:
        magic = file.read(16)
    if not magic:
        raise LocalError("the file is empty")
    if magic.startswith(b"#ROSBAG"):
        return _open_ros1(path)
    if magic.startswith(salvage_mcap.MAGIC):
        if path.suffix == ".mcap" and salvage_mcap.is_indexed(path):
            return _Rosbag2Source(path)
        return salvage_mcap.scan(path)
    if magic.startswith(salvage_sqlite.MAGIC):
        if path.suffix == ".db3" and salvage_sqlite.is_whole(path):
            return _Rosbag2Source(path)
        return salvage_sqlite.SqliteSource(path)
    raise LocalError("neither a ROS 1 bag nor MCAP nor sqlite3")


def _open_folder(path: Path) -> Source:
    storage = sorted(file for pattern in _STORAGE for file in path.glob(pattern))
    compression = _compression(path / "metadata.yaml")
    if compression == "message":  # each message is unpacked here, within bounds
        return UnpackedSource(JoinedSource([_open(file) for file in storage]))
    if compression == "file":
        for file in path.glob("*.zstd"):
            check_file(file)
    if (path / "metadata.yaml").exists() and all(map(_is_whole, storage)):
        return _Rosbag2Source(path)
    if not storage:
        raise LocalError("the folder has neither metadata.yaml nor a storage file")
    return JoinedSource([_open(file) for file in storage])


def _compression(metadata: Path) -> str:
    """Return the compression that a folder states: ``message``, ``file``, or anything else for none."""
    if not metadata.exists():
        return ""
    if metadata.stat().st_size > _METADATA_MAX_BYTES:
        raise LocalError(f"{metadata.name} has more than {_METADATA_MAX_BYTES} bytes")
    match load_plain(metadata.read_text()):
        case {"rosbag2_bagfile_information": {"compression_mode": str(mode)}}:
            return mode.lower()
    return ""


def _is_whole(storage: Path) -> bool:
    if storage.suffix == ".mcap":
        return salvage_mcap.is_indexed(storage)
    return salvage_sqlite.is_whole(storage)


def _open_ros1(path: Path) -> Source:
    try:
        return _Rosbag1Source(path)
    except _FOREIGN:
        return salvage_ros1.scan(path)  # no index, or a truncated one


class _IndexedSource:
    """A recording whose index rosbags can read."""

    def __init__(self, connections: list[Connection], count: int) -> None:
        self.channels = [from_connection(connection) for connection in connections]
        self.count = count
        self.counts = [connection.msgcount for connection in connections]
        self.unread = ""
        self._index = {_key(connection): index for index, connection in enumerate(connections)}

    def _messages(self, read: Callable[[], Iterator[tuple[Connection, int, bytes]]]) -> Iterator[Message]:
        given = 0
        try:
            for connection, stamp_ns, raw in read():
                if isinstance(raw, int | str):
                    raise ReaderError2("a message that is not bytes")
                yield Message(self._index[_key(connection)], stamp_ns, bytes(raw))
                given += 1
        except MemoryError:
            raise
        except _FOREIGN as error:
            self.unread = f"after {given} of {self.count} messages: {_reason(error)}"


class _Rosbag1Source(_IndexedSource):
    def __init__(self, path: Path) -> None:
        self._reader = Reader1(path)
        self._reader.open()
        super().__init__(self._reader.connections, self._reader.message_count)

    def messages(self) -> Iterator[Message]:
        return self._messages(self._reader.messages)

    def close(self) -> None:
        self._reader.close()


class _Rosbag2Source(_IndexedSource):
    def __init__(self, path: Path) -> None:
        self._reader = Reader2(path)
        with guarded():
            self._reader.open()
        try:
            super().__init__(self._reader.connections, self._reader.message_count)
        except _FOREIGN:
            self._reader.close()
            raise

    def messages(self) -> Iterator[Message]:
        return self._messages(self._reader.messages)

    def close(self) -> None:
        self._reader.close()


bound_rosbags()
rosbag2_reader.YAML = BoundedYaml  # type: ignore[attr-defined]
rosbag2_metadata.YAML = BoundedYaml  # type: ignore[attr-defined]


def _key(connection: Connection) -> tuple[int, str]:
    return connection.id, connection.topic
