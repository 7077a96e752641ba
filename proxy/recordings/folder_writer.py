"""Writer of a ROS 2 bag as a folder: ``metadata.yaml`` and a ``.db3`` file (SQLite), rosbag2's older default.

I/O. A folder without ``metadata.yaml`` is not complete.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Writer, WriterError

from gdp.errors import LocalError
from proxy.recordings.channels import offered_qos
from proxy.recordings.mcap_writer import offered
from proxy.serial.channel import Channel


def write_folder(path: Path, messages: Iterable[tuple[int, Channel, bytes]]) -> int:
    """Write messages, each a stamp in Unix nanoseconds, its channel and its bytes; return how many.

    Raises:
        LocalError: the folder exists or cannot be written, or a channel is not of ROS 2, or of an unknown type.
    """
    connections, written = dict[tuple[object, ...], Connection](), 0
    try:
        with Writer(path, version=9) as bag:
            for stamp_ns, channel, raw in messages:
                topic, type_name = channel.topic, channel.type_name
                if channel.ros != 2 or not channel.hash:
                    raise LocalError(f"{topic}: a folder holds ROS 2 messages of known types; export it to .mcap")
                if (key := (topic, type_name, channel.qos)) not in connections:
                    qos = offered_qos(topic, offered(channel), [])
                    connections[key] = bag.add_connection(
                        topic, type_name, msgdef=channel.definition, rihs01=channel.hash, offered_qos_profiles=qos
                    )
                bag.write(connections[key], stamp_ns, raw)
                written += 1
    except (WriterError, OSError) as error:
        raise LocalError(f"{path} cannot be written: {error}") from error
    return written
