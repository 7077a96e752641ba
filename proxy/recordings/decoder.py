"""Decoder of a recording: ROS 1 bag, sqlite3, MCAP, alone or as a rosbag2 folder; also a truncated one.

I/O, reading only. rosbags reads bags and MCAP with an index; ``salvage_*`` read all other files from the beginning. It
runs in a process of its own (``child``), because a recording may come from anyone.
Errors: a recording that cannot be read at all raises ``ConfigError`` with the file and the reason; a loss is reported
in ``unread``.
"""

from __future__ import annotations

import contextlib
import functools
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import apsw
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as ReaderError2
from rosbags.rosbag2 import metadata as rosbag2_metadata
from ruamel.yaml.error import YAMLError

from gdp.closing import ClosedOnExit
from gdp.errors import ConfigError, LocalError
from proxy.recordings import mcap_format, salvage_mcap, salvage_ros1, salvage_sqlite
from proxy.recordings.channels import from_connection
from proxy.recordings.plain_yaml import BoundedYaml, load_plain
from proxy.recordings.source import COMPRESSIONS, ZSTD, JoinedSource, Message, Source
from proxy.recordings.unpacking import SalvageError, bound_rosbags, unpack, unpack_file
from proxy.serial.channel import Channel
from proxy.serial.schema import DefinitionError, UnparsedError, parse

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

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
_STORAGE: Final = ("*.mcap", "*.db3", "*.mcap.zstd", "*.db3.zstd")


class BagDecoder(ClosedOnExit):
    """An open recording.

    Args:
        path: a ``.bag``, ``.mcap`` or ``.db3`` file, or a rosbag2 folder.

    Attributes:
        channels: every topic of every publisher, in the recording's order.

    Raises:
        ConfigError: it cannot be read.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            with contextlib.ExitStack() as stack:
                self._source = _open(self.path, stack)
                stack.callback(self._source.close)
                self._stack = stack.pop_all()
        except _FOREIGN as error:
            raise ConfigError(str(self.path), "", f"cannot be read: {_reason(error)}") from error
        checked = [_checked(channel) for channel in self._source.channels]
        self.channels = [channel for channel, _ in checked]
        self._opaque = [reason for _, reason in checked if reason]
        self._packed = ""  # why a message that is compressed by itself was left out

    @property
    def count(self) -> int:
        """Return the number of messages that ``messages`` will yield, as far as known in advance."""
        return self._source.count

    @property
    def counts(self) -> list[int] | None:
        """Return the messages of each channel; None where the recording has no index with them."""
        return self._source.counts

    @property
    def unread(self) -> str:
        """Return why some messages could not be read, and about how many; empty if all could.

        The text is final after ``messages``.
        """
        return "; ".join(filter(None, (self._source.unread, self._packed, *self._opaque)))

    def messages(self) -> Iterator[Message]:
        """Yield (channel index, stamp in ns, bytes) in time order; a file that ends early is no error.

        Raises:
            ConfigError: there is not enough memory; ``MemoryError`` is its cause.
        """
        try:
            yield from filter(None, map(self._unpacked, self._source.messages()))
        except MemoryError as error:
            raise ConfigError(str(self.path), "", f"cannot be read: {_reason(error)}") from error

    def _unpacked(self, message: Message) -> Message | None:
        """Return a message of ROS 2 that is compressed by itself as it was (CDR begins with a zero byte); None: not."""
        channel, raw = self.channels[message.channel], message.raw
        if channel.ros == 1:
            return message
        other = next((name for magic, name in COMPRESSIONS.items() if raw.startswith(magic)), "")
        if not (other or raw.startswith(ZSTD)):
            return message
        try:
            return message._replace(raw=unpack(other or "zstd", raw, is_whole=True))
        except SalvageError as error:
            self._packed = self._packed or f"a message of {channel.topic} cannot be unpacked: {error}"
            return None

    def close(self) -> None:
        """Close the files."""
        self._stack.close()


def _checked(channel: Channel) -> tuple[Channel, str]:
    """Return a channel, without a definition that cannot be read, and the reason; its messages are then opaque."""
    try:
        parse(channel.type_name, channel.definition, channel.definition_format, channel.ros)
    except UnparsedError as error:
        bare = replace(channel, definition="", definition_format="")
        return bare, f"topic {channel.topic} is carried unread: {error}"
    except DefinitionError:
        pass  # an absent or unusual one
    return channel, ""


def _reason(error: BaseException) -> str:
    text = str(error.strerror) if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split())[:300] or type(error).__name__


def _open(path: Path, stack: contextlib.ExitStack) -> Source:
    """Open a recording; ``stack`` removes what is unpacked for it."""
    if path.is_dir():
        return _open_folder(path, stack)
    with path.open("rb") as file:
        magic = file.read(16)
    if not magic:
        raise LocalError("the file is empty")
    if magic.startswith(b"#ROSBAG"):
        return _open_ros1(path)
    if magic.startswith(mcap_format.MAGIC):
        return _open_mcap(path)
    if magic.startswith(salvage_sqlite.MAGIC):
        return salvage_sqlite.SqliteSource(path)
    if magic.startswith(ZSTD):
        unpacked = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unpacked-"))) / path.stem
        unpack_file(path, unpacked)
        return _open(unpacked, stack)
    for start, name in COMPRESSIONS.items():
        if magic.startswith(start):
            raise LocalError(f"it is compressed by {name}: unpack it first")
    raise LocalError("neither a ROS 1 bag nor MCAP nor sqlite3")


def _open_folder(path: Path, stack: contextlib.ExitStack) -> Source:
    """Open the storage files of a folder, whatever its metadata.yaml says: that is written last, and is edited."""
    storage = sorted(file for pattern in _STORAGE for file in path.glob(pattern) if file.stat().st_size)
    if not storage:
        raise LocalError("the folder has no storage file (.mcap or .db3) with anything in it")
    parts: list[Source] = []
    lacking = _lacking(path / "metadata.yaml", {file.name for file in storage})
    for file in storage:
        try:
            parts.append(_open(file, stack))
        except _FOREIGN as error:
            lacking.append(f"{file.name} cannot be read: {_reason(error)}")
    if not parts:
        raise LocalError("; ".join(lacking))
    return JoinedSource(parts, lacking)


def _lacking(metadata: Path, there: set[str]) -> list[str]:
    """Return what a folder states that it has, and has not."""
    if not metadata.exists():
        return []
    try:
        if metadata.stat().st_size > _METADATA_MAX_BYTES:
            raise LocalError(f"more than {_METADATA_MAX_BYTES} bytes")
        match load_plain(metadata.read_text(encoding="utf-8", errors="replace")):
            case {"rosbag2_bagfile_information": {"relative_file_paths": list(names)}}:
                files = [Path(str(name)).name for name in names]
                return [_absent(metadata, name) for name in files if name not in there]
    except _FOREIGN as error:
        return [f"{metadata.name} cannot be read ({_reason(error)}); all storage files are"]
    return [f"{metadata.name} states no files; all storage files are read"]


def _absent(metadata: Path, name: str) -> str:
    return f"{name}, which {metadata.name} names, is {'empty' if (metadata.parent / name).exists() else 'not there'}"


def _open_mcap(path: Path) -> Source:
    if path.suffix == ".mcap" and salvage_mcap.is_indexed(path):
        try:
            return _IndexedSource(Reader2(path), functools.partial(salvage_mcap.scan, path))
        except _FOREIGN:
            pass  # a profile or an encoding that rosbags does not read
    return salvage_mcap.scan(path)


def _open_ros1(path: Path) -> Source:
    try:
        return _IndexedSource(Reader1(path), functools.partial(salvage_ros1.scan, path))
    except _FOREIGN:
        return salvage_ros1.scan(path)  # no index, or a truncated one


class _IndexedSource:
    """A recording whose index rosbags can read; what follows damage is found by a scan of the file."""

    def __init__(self, reader: Reader1 | Reader2, scan: Callable[[], Source]) -> None:
        self._reader = reader
        self._scan = scan
        reader.open()
        try:
            self.channels = [from_connection(connection) for connection in reader.connections]
        except _FOREIGN:
            reader.close()
            raise
        self.count = reader.message_count
        self.counts: list[int] | None = [connection.msgcount for connection in reader.connections]
        self.unread = ""
        self._index = {_key(connection): index for index, connection in enumerate(reader.connections)}

    def messages(self) -> Iterator[Message]:
        given, last_ns, equal = 0, -1, 0  # how many of the newest time
        try:
            for connection, stamp_ns, raw in self._reader.messages():
                if isinstance(raw, int | str):
                    raise ReaderError2("a message that is not bytes")
                yield Message(self._index[_key(connection)], stamp_ns, bytes(raw))
                given += 1
                equal = equal + 1 if stamp_ns == last_ns else 1
                last_ns = stamp_ns
        except MemoryError:
            raise
        except _FOREIGN as error:
            found = 0
            for message in self._rest(last_ns, equal):
                found += 1
                yield message
            if given + found < self.count:
                more = f", {found} more were found behind it" if found else ""
                self.unread = f"after {given} of {self.count} messages: {_reason(error)}{more}"

    def _rest(self, last_ns: int, equal: int) -> Iterator[Message]:
        """Yield the messages after a time, and those of that time but for the first ``equal``."""
        known = {(each.topic, each.type_name): index for index, each in enumerate(self.channels)}
        try:
            with contextlib.closing(self._scan()) as scanned:
                indexes = [known.get((each.topic, each.type_name)) for each in scanned.channels]
                for message in scanned.messages():
                    index = indexes[message.channel]
                    is_equal = message.stamp_ns == last_ns
                    if message.stamp_ns < last_ns or index is None or (is_equal and equal > 0):
                        equal -= is_equal
                        continue
                    yield message._replace(channel=index)
        except MemoryError:
            raise
        except _FOREIGN:
            return  # the count shows what is missing

    def close(self) -> None:
        self._reader.close()


bound_rosbags()
rosbag2_metadata.YAML = BoundedYaml  # type: ignore[attr-defined]


def _key(connection: Connection) -> tuple[int, str]:
    return connection.id, connection.topic
