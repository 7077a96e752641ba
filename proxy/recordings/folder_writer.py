"""Writer of a ROS 2 bag as a folder: ``metadata.yaml`` and a ``.db3`` file (SQLite), as rosbag2's older default.

I/O. Until it is complete, the folder has the suffix ``.partial``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Writer, WriterError

from gdp.errors import LocalError
from proxy.recordings.channels import offered_qos
from proxy.recordings.mcap_writer import offered
from proxy.recordings.writer import PARTIAL
from proxy.serial.channel import Channel


class FolderWriter:
    """A folder in progress; ``open_folder`` makes it.

    Attributes:
        written: messages so far.
    """

    def __init__(self, bag: Writer) -> None:
        self._bag = bag
        self._connections: dict[tuple[object, ...], Connection] = {}
        self.written = 0

    def write(self, channel: Channel, stamp_ns: int, raw: bytes) -> None:
        """Write one message. Raises ``LocalError``: its channel is not of ROS 2, or of an unknown type."""
        key = channel.topic, channel.type_name, channel.qos
        if key not in self._connections:
            if channel.ros != 2 or not channel.hash:
                raise LocalError(f"{channel.topic}: a folder holds ROS 2 messages of known types; export it to .mcap")
            self._connections[key] = self._bag.add_connection(
                channel.topic,
                channel.type_name,
                msgdef=channel.definition,
                rihs01=channel.hash,
                offered_qos_profiles=offered_qos(channel.topic, offered(channel), []),
            )
        self._bag.write(self._connections[key], stamp_ns, raw)
        self.written += 1


@contextmanager
def open_folder(path: Path) -> Iterator[FolderWriter]:
    """Yield the writer of a new folder, which gets its name when all was written.

    Raises:
        LocalError: it exists, or cannot be written.
    """
    partial = path.with_name(path.name + PARTIAL)
    if path.exists():
        raise LocalError(f"{path} exists already")
    try:
        with Writer(partial, version=9) as bag:
            yield FolderWriter(bag)
        for each in partial.iterdir():
            each.rename(each.with_name(each.name.replace(partial.name, path.name)))
        metadata = partial / "metadata.yaml"
        metadata.write_text(metadata.read_text().replace(f"{partial.name}.db3", f"{path.name}.db3"))
        partial.rename(path)
    except (WriterError, OSError) as error:
        raise LocalError(f"{path} cannot be written: {error}") from error
