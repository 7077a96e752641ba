"""Damaged recordings of every writer that can be had: ours gives each message that a plain reader gives, or says so.

A plain reader is the format's own tool: the ``mcap`` package for MCAP, rosbags for bags, SQLite for databases.
"""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from gdp.errors import ConfigError, LocalError
from proxy.recordings.decoder import BagDecoder
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel, RosVersion
from tests.draws import draws

T0: Final = 1_700_000_000_000_000_000
STRING: Final = "std_msgs/msg/String"
DEFINITION: Final = "string data\n"
MD5: Final = "992ce8a1687cec8c8bd883ec73ca41d1"


class Sent(NamedTuple):
    """One message to record: topic number, time after the first in nanoseconds, body."""

    topic: int
    after_ns: int
    raw: bytes


def cdr(number: int, size: int) -> bytes:
    text = b"%d " % number + b"x" * size + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(text)) + text


def _ours(path: Path, sent: Sequence[Sent], ros: RosVersion) -> None:
    with BagWriter(path, ros) as bag:
        for number, each in enumerate(sent):
            handle = bag.add(
                Channel(f"/t{each.topic}", STRING, ros, hash=MD5, definition=DEFINITION, definition_format="msg")
            )
            bag.write(handle, T0 + each.after_ns, each.raw)
            if number % 5 == 4:
                bag.flush()


def _rosbags1(path: Path, sent: Sequence[Sent], compression: Any = None) -> None:
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    writer.chunk_threshold = 2_000
    with writer:
        known = {
            topic: writer.add_connection(f"/t{topic}", STRING, msgdef=DEFINITION, md5sum=MD5)
            for topic in {each.topic for each in sent}
        }
        for each in sent:
            writer.write(known[each.topic], T0 + each.after_ns, each.raw)


def _rosbags2(path: Path, sent: Sequence[Sent], plugin: StoragePlugin) -> None:
    folder = path.with_suffix("")
    with Ros2Writer(folder, version=9, storage_plugin=plugin) as writer:
        known = {
            topic: writer.add_connection(f"/t{topic}", STRING, msgdef=DEFINITION, rihs01="RIHS01_" + "0" * 64)
            for topic in {each.topic for each in sent}
        }
        for each in sent:
            writer.write(known[each.topic], T0 + each.after_ns, each.raw)
    (made,) = folder.glob(f"*{path.suffix}")
    made.rename(path)


def _mcap(path: Path, sent: Sequence[Sent], **options: Any) -> None:
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=2_000, **options)
        writer.start("ros2")
        schema = writer.register_schema(STRING, "ros2msg", DEFINITION.encode())
        known: dict[int, int] = {}
        for number, each in enumerate(sent):
            if each.topic not in known:
                known[each.topic] = writer.register_channel(f"/t{each.topic}", "cdr", schema)
            at_ns = T0 + each.after_ns
            writer.add_message(known[each.topic], at_ns, each.raw, at_ns, number)
        writer.finish()  # type: ignore[no-untyped-call]


WRITERS: Final[dict[str, Callable[[Path, Sequence[Sent]], None]]] = {
    "ours.mcap": lambda path, sent: _ours(path, sent, 2),
    "ours.bag": lambda path, sent: _ours(path, sent, 1),
    "rosbags.bag": _rosbags1,
    "rosbags-bz2.bag": lambda path, sent: _rosbags1(path, sent, Ros1Writer.CompressionFormat.BZ2),
    "rosbags-lz4.bag": lambda path, sent: _rosbags1(path, sent, Ros1Writer.CompressionFormat.LZ4),
    "rosbags.mcap": lambda path, sent: _rosbags2(path, sent, StoragePlugin.MCAP),
    "rosbags.db3": lambda path, sent: _rosbags2(path, sent, StoragePlugin.SQLITE3),
    "mcap-zstd.mcap": lambda path, sent: _mcap(path, sent, compression=CompressionType.ZSTD),
    "mcap-lz4.mcap": lambda path, sent: _mcap(path, sent, compression=CompressionType.LZ4),
    "mcap-plain.mcap": lambda path, sent: _mcap(path, sent, compression=CompressionType.NONE),
    "mcap-chunkless.mcap": lambda path, sent: _mcap(path, sent, use_chunking=False),
    "mcap-without-index.mcap": lambda path, sent: _mcap(path, sent, use_statistics=False, use_summary_offsets=False),
}


def plain(path: Path) -> list[bytes]:
    """Return the bodies that the format's own tool gives, up to its first error."""
    found: list[bytes] = []
    with suppress(Exception):  # each tool has errors of its own
        found.extend(_plain(path))
    return found


def _plain(path: Path) -> Iterator[bytes]:
    if path.suffix == ".mcap":
        for record in StreamReader(io.BytesIO(path.read_bytes()), validate_crcs=True).records:
            if isinstance(record, McapMessage):
                yield record.data
    elif path.suffix == ".db3":
        with closing(sqlite3.connect(path)) as database:
            yield from (bytes(raw) for (raw,) in database.execute("SELECT data FROM messages ORDER BY timestamp"))
    else:
        with AnyReader([path]) as reader:
            yield from (bytes(raw) for _, _, raw in reader.messages())


def read(path: Path) -> tuple[list[bytes], str]:
    """Return the bodies that are given, and what is said of others; in this process, where a coverage tool sees it."""
    try:
        decoder = BagDecoder(path)
    except (LocalError, ConfigError) as error:
        return [], str(error)
    with closing(decoder):
        found = [message.raw for message in decoder.messages()]
        return found, decoder.unread or ("fewer than announced" if len(found) < decoder.count else "")


messages = st.lists(
    st.builds(Sent, st.integers(0, 2), st.integers(0, 10**9), st.builds(cdr, st.integers(0, 99), st.integers(0, 900))),
    min_size=1,
    max_size=25,
)
harm = st.one_of(
    st.tuples(st.just("cut"), st.floats(0, 1), st.just(0)),
    st.tuples(st.just("flip"), st.floats(0, 1), st.integers(1, 255)),
    st.tuples(st.just("zero"), st.floats(0, 1), st.integers(1, 600)),
    st.tuples(st.just("insert"), st.floats(0, 1), st.integers(1, 600)),
)


def harmed(data: bytes, kind: str, place: float, value: int) -> bytes:
    at = min(round(place * len(data)), len(data) - 1)
    match kind:
        case "cut":
            return data[:at]
        case "flip":
            return data[:at] + bytes([data[at] ^ value]) + data[at + 1 :]
        case "zero":
            return data[:at] + bytes(len(data[at : at + value])) + data[at + value :]
    return data[:at] + b"\x05" * value + data[at:]


@pytest.mark.parametrize("name", WRITERS)
@draws(6)
@given(sent=messages, damage=st.none() | harm)
def test_no_message_that_a_plain_reader_gives_is_left_out_silently(
    tmp_path_factory: pytest.TempPathFactory, name: str, sent: list[Sent], damage: tuple[str, float, int] | None
) -> None:
    path = tmp_path_factory.mktemp("damaged") / name
    WRITERS[name](path, sent)
    if damage is None:
        given_now, said = read(path)
        assert (sorted(given_now), said) == (sorted(each.raw for each in sent), "")
        return
    path.write_bytes(harmed(path.read_bytes(), *damage))
    expected, (given_now, said) = plain(path), read(path)
    missing = list(expected)
    for raw in given_now:
        if raw in missing:
            missing.remove(raw)
    assert not missing or said
