"""Reader of recordings: whole, truncated, damaged and refused files."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import sqlite3
import struct
from itertools import pairwise
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from gdp.errors import ConfigError, LocalError
from proxy.recordings.decoder import BagDecoder
from proxy.recordings.reader import BagReader
from proxy.recordings.source import Message
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel, Qos, RosVersion
from tests.proxy.recordings.samples import READABLE, UNREADABLE, recording

LATCHED = Qos(depth=1, reliability="reliable", durability="transient_local")
PLAIN = Qos(history="keep_all", depth=0, reliability="best_effort", durability="volatile", plain_names=True)
START_NS = 1_700_000_000_000_000_000


def string(ros: RosVersion, topic: str = "/chatter", **more: object) -> Channel:
    hash_ = "992ce8a1687cec8c8bd883ec73ca41d1" if ros == 1 else "RIHS01_" + "df" * 32
    known = {"topic": topic, "type_name": "std_msgs/msg/String", "ros": ros, "hash": hash_}
    return Channel(**{**known, "definition": "string data\n", "definition_format": "msg", **more})  # type: ignore[arg-type]


def raw(ros: RosVersion, text: bytes) -> bytes:
    if ros == 1:
        return struct.pack("<I", len(text)) + text
    return b"\x00\x01\x00\x00" + struct.pack("<I", len(text) + 1) + text + b"\0"


def numbered(ros: RosVersion, count: int, size: int = 200) -> list[bytes]:
    return [raw(ros, b"%d " % number + b"x" * size) for number in range(count)]


def record(path: Path, ros: RosVersion, messages: list[bytes]) -> None:
    with BagWriter(path, ros) as bag:
        handle = bag.add(string(ros))
        for number, message in enumerate(messages):
            bag.write(handle, START_NS + number, message)


def read(path: Path) -> tuple[list[Message], str]:
    with BagReader(path) as bag:
        messages = list(bag.messages())
        assert bag.count >= len(messages)
        return messages, bag.unread


def cut(path: Path, share: float) -> Path:
    short = path.with_name(f"short{path.suffix}")
    short.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    return short


# --- whole recordings


def test_a_process_with_more_than_1024_descriptors_reads_a_recording(tmp_path: Path) -> None:
    record(tmp_path / "one.mcap", 2, numbered(2, 3))
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, hard), hard))
    try:
        with contextlib.ExitStack() as held:
            for _ in range(1024):
                held.callback(os.close, os.open(os.devnull, os.O_RDONLY))
            assert len(read(tmp_path / "one.mcap")[0]) == 3
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("name", READABLE)
def test_a_shared_recording_is_read_whole_and_in_time_order(name: str) -> None:
    messages, unread = read(recording(name))
    assert unread == ""
    assert messages
    assert all(early.stamp_ns <= late.stamp_ns for early, late in pairwise(messages))


@pytest.mark.parametrize("name", READABLE)
def test_a_shared_recording_recorded_again_is_the_same(name: str, tmp_path: Path) -> None:
    with BagReader(recording(name)) as bag:
        ros = bag.channels[0].ros
        copy = tmp_path / ("copy.bag" if ros == 1 else "copy.mcap")
        with BagWriter(copy, ros) as out:
            handles = [out.add(channel) for channel in bag.channels]
            for message in bag.messages():
                out.write(handles[message.channel], message.stamp_ns, message.raw)
        with BagReader(copy) as again:
            assert again.channels == bag.channels
            assert sorted(again.messages()) == sorted(bag.messages())


def test_a_storage_file_alone_is_read_as_its_folder_is() -> None:
    folder = recording("rosbag2_test")
    assert [message[1:] for message in read(folder / "rosbag2_test_0.db3")[0]] == [
        message[1:] for message in read(folder)[0]
    ]


def test_caller_ids_and_latching_are_kept_in_ros_1(tmp_path: Path) -> None:
    channels = [string(1, callerid="/a", latched=True), string(1, callerid="/b"), string(1, callerid=None)]
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        for channel in channels:
            bag.write(bag.add(channel), START_NS, raw(1, b"x"))
    with BagReader(tmp_path / "a.bag") as bag:
        assert bag.channels == channels


def test_quality_of_service_is_kept_in_ros_2(tmp_path: Path) -> None:
    channels = [string(2, "/a", qos=(LATCHED, PLAIN), latched=True), string(2, "/b", qos=(PLAIN,)), string(2, "/c")]
    with BagWriter(tmp_path / "a.mcap", 2) as bag:
        for channel in channels:
            bag.write(bag.add(channel), START_NS, raw(2, b"x"))
    with BagReader(tmp_path / "a.mcap") as bag:
        assert [(channel.qos, channel.latched) for channel in bag.channels] == [
            (channel.qos, channel.latched) for channel in channels
        ]


def test_a_recording_without_definitions_gets_those_of_humble() -> None:
    with BagReader(recording("rosbag2_test")) as bag:
        assert all(channel.definition_format == "msg" for channel in bag.channels)
        assert all(channel.hash.startswith("RIHS01_") for channel in bag.channels)


# --- recordings that end early


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize(("name", "ros"), [("a.bag", 1), ("a.mcap", 2)])
def test_a_recording_that_ends_in_the_middle_gives_what_is_there(
    tmp_path: Path, name: str, ros: RosVersion, share: float
) -> None:
    sent = numbered(ros, 10_000)
    record(tmp_path / name, ros, sent)
    messages, unread = read(cut(tmp_path / name, share))
    assert 0.8 * share * len(sent) < len(messages) < len(sent)
    assert [message.raw for message in messages] == sent[: len(messages)]
    assert "ends in the middle" in unread
    assert f"{len(messages)} messages were found" in unread
    assert "more are lost" in unread


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_a_database_that_ends_in_the_middle_gives_what_is_there(tmp_path: Path, share: float) -> None:
    whole = tmp_path / "a.db3"
    shutil.copy(recording("rosbag2_test") / "rosbag2_test_0.db3", whole)
    messages, unread = read(cut(whole, share))
    expected = {message[1:] for message in read(whole)[0]}
    assert 0.5 * share * len(expected) < len(messages) < len(expected)
    assert {message[1:] for message in messages} <= expected
    assert "more are lost" in unread


@pytest.mark.parametrize("compression", [Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4])
def test_a_compressed_bag_that_ends_in_the_middle_gives_what_is_there(
    tmp_path: Path, compression: Writer1.CompressionFormat
) -> None:
    sent = numbered(1, 20_000)
    writer = Writer1(tmp_path / "a.bag")
    writer.set_compression(compression)
    with writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", msgdef="string data\n", md5sum="992c")
        for number, message in enumerate(sent):
            writer.write(connection, START_NS + number, message)
    messages, unread = read(cut(tmp_path / "a.bag", 0.6))
    assert 0 < len(messages) < len(sent)
    assert [message.raw for message in messages] == sent[: len(messages)]
    assert unread


def compressed_mcap(folder: Path, sent: list[bytes]) -> Path:
    writer = Writer2(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", msgdef="string data\n", rihs01="RIHS01_0")
        for number, message in enumerate(sent):
            writer.write(connection, START_NS + number, message)
    return folder / f"{folder.name}.mcap"


def test_a_compressed_mcap_that_ends_in_the_middle_gives_what_is_there(tmp_path: Path) -> None:
    sent = numbered(2, 20_000)
    messages, unread = read(cut(compressed_mcap(tmp_path / "a", sent), 0.6))
    assert 0 < len(messages) < len(sent)
    assert [message.raw for message in messages] == sent[: len(messages)]
    assert unread


def test_a_folder_whose_storage_ends_in_the_middle_gives_what_is_there(tmp_path: Path) -> None:
    sent = numbered(2, 5_000)
    storage = compressed_mcap(tmp_path / "a", sent)
    storage.write_bytes(storage.read_bytes()[:-2_000])
    messages, unread = read(tmp_path / "a")
    assert [message.raw for message in messages] == sent[: len(messages)]
    assert unread


def test_a_folder_that_was_never_closed_is_read_from_its_files_in_time_order(tmp_path: Path) -> None:
    for number, name in enumerate(("b.mcap", "a.mcap")):
        with BagWriter(tmp_path / name, 2) as bag:
            handle = bag.add(string(2))
            for stamp in range(3):
                bag.write(handle, START_NS + 2 * stamp + number, raw(2, b"%d" % (2 * stamp + number)))
    with BagReader(tmp_path) as bag:
        assert len(bag.channels) == 1
        assert [message.raw for message in bag.messages()] == [raw(2, b"%d" % number) for number in range(6)]
        assert bag.unread == ""


def test_a_bag_that_was_never_closed_is_read_without_its_index(tmp_path: Path) -> None:
    writer = Writer1(tmp_path / "a.bag")
    writer.open()
    connection = writer.add_connection("/a", "std_msgs/msg/String", msgdef="string data\n", md5sum="992c")
    sent = numbered(1, 10_000)
    for number, message in enumerate(sent):
        writer.write(connection, START_NS + number, message)
    writer.abort()
    messages, unread = read(tmp_path / "a.bag")
    assert [message.raw for message in messages] == sent[: len(messages)]
    assert len(messages) > 8_000
    assert "never closed" in unread


def test_an_mcap_without_an_index_is_sorted_by_time(tmp_path: Path) -> None:
    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    def entry(code: int, body: bytes) -> bytes:
        return struct.pack("<BQ", code, len(body)) + body

    magic = b"\x89MCAP0\r\n"
    parts = [magic, entry(1, text("ros2") + text("test"))]
    parts.append(entry(3, struct.pack("<H", 1) + text("std_msgs/msg/String") + text("ros2msg") + text("string data\n")))
    parts.append(entry(4, struct.pack("<HH", 1, 1) + text("/a") + text("cdr") + struct.pack("<I", 0)))
    for stamp in (3, 1, 2):
        parts.append(entry(5, struct.pack("<HIQQ", 1, 0, stamp, stamp) + raw(2, b"%d" % stamp)))
    parts += [entry(15, bytes(4)), entry(2, bytes(20)), magic]
    (tmp_path / "a.mcap").write_bytes(b"".join(parts))
    messages, unread = read(tmp_path / "a.mcap")
    assert [message.raw for message in messages] == [raw(2, b"%d" % stamp) for stamp in (1, 2, 3)]
    assert unread == ""


def test_a_journal_that_was_never_folded_in_is_read(tmp_path: Path) -> None:
    shutil.copy(recording("rosbag2_test") / "rosbag2_test_0.db3", tmp_path / "a.db3")
    before = len(read(tmp_path / "a.db3")[0])
    db = sqlite3.connect(tmp_path / "a.db3")
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, 1, ?)", (b"late",))
    db.commit()
    messages, unread = read(tmp_path / "a.db3")
    db.close()
    assert len(messages) == before + 1
    assert unread == ""


def test_a_journal_without_its_index_is_read_and_nothing_is_written_next_to_it(tmp_path: Path) -> None:
    shutil.copy(recording("rosbag2_test") / "rosbag2_test_0.db3", tmp_path / "a.db3")
    before = len(read(tmp_path / "a.db3")[0])
    db = sqlite3.connect(tmp_path / "a.db3")
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, 1, ?)", (b"late",))
    db.commit()
    (tmp_path / "copy").mkdir()
    for name in ("a.db3", "a.db3-wal"):
        shutil.copy(tmp_path / name, tmp_path / "copy" / name)
    db.close()
    messages, unread = read(tmp_path / "copy" / "a.db3")
    assert len(messages) == before + 1
    assert unread == ""
    assert {each.name for each in (tmp_path / "copy").iterdir()} == {"a.db3", "a.db3-wal"}


def test_damage_inside_a_whole_file_is_reported_and_not_raised(tmp_path: Path) -> None:
    sent = numbered(2, 20_000)
    storage = compressed_mcap(tmp_path / "a", sent)
    damaged = bytearray(storage.read_bytes())
    second = damaged.index(b"zstd", damaged.index(b"zstd") + 4)  # the second chunk's compression, before its data
    damaged[second + 30 : second + 60] = bytes(30)
    (tmp_path / "b.mcap").write_bytes(damaged)
    messages, unread = read(tmp_path / "b.mcap")
    assert [message.raw for message in messages] == sent[: len(messages)]
    assert len(messages) < len(sent)
    assert f"after {len(messages)} of {len(sent)} messages" in unread


# --- unreadable recordings


def test_a_topic_whose_definition_cannot_be_read_is_carried_unread_and_named() -> None:
    with BagReader(recording(UNREADABLE)) as bag:
        assert len(list(bag.messages())) == bag.count > 0
        opaque = [channel.topic for channel in bag.channels if not channel.definition_format]
        assert opaque
        assert all(f"topic {topic} is carried unread" in bag.unread for topic in opaque)
        assert "cannot be parsed" in bag.unread


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.bag", b"", "empty"),
        ("a.mcap", b"hello" * 100, "neither"),
        ("a.bag", b"#ROSBAG V1.2\n" + bytes(100), "2.0"),
        ("a.bag", b"#ROSBAG V2.0\n", "no connection"),
        ("a.mcap", b"\x89MCAP0\r\n" + bytes(100), "cannot be read"),
        ("a.db3", b"SQLite format 3\0" + bytes(5_000), "database"),
    ],
)
def test_a_file_that_is_no_recording_is_named_with_the_reason(
    tmp_path: Path, name: str, content: bytes, reason: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=reason) as refusal:
        BagReader(tmp_path / name)
    assert refusal.value.where == str(tmp_path / name)


def test_a_missing_file_or_an_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        BagReader(tmp_path / "none.bag")
    with pytest.raises(ConfigError, match="no storage file"):
        BagReader(tmp_path)


def test_a_recording_cut_anywhere_near_its_beginning_never_raises_anything_else(tmp_path: Path) -> None:
    for name, ros in (("a.bag", 1), ("a.mcap", 2)):
        record(tmp_path / name, ros, numbered(ros, 3))  # type: ignore[arg-type]
        whole = (tmp_path / name).read_bytes()
        start = 4_000 if ros == 1 else 0  # the rest of a bag's first 4 KiB is padding
        for size in [*range(0, 60), *range(start, min(len(whole), start + 1_500), 3)]:
            (tmp_path / f"short{name}").write_bytes(whole[:size])
            try:
                with BagDecoder(tmp_path / f"short{name}") as bag:
                    list(bag.messages())
            except ConfigError:
                continue


# --- recording


def test_a_recording_does_not_replace_another(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", 2, numbered(2, 1))
    with pytest.raises(LocalError, match="exists already"):
        BagWriter(tmp_path / "a.mcap", 2)


def test_a_recording_appears_when_it_is_closed_and_leaves_nothing_else(tmp_path: Path) -> None:
    for name, ros in (("a.bag", 1), ("a.mcap", 2)):
        bag = BagWriter(tmp_path / name, ros)  # type: ignore[arg-type]
        assert not (tmp_path / name).exists()
        bag.close()
        bag.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.bag", "a.mcap"]


def test_a_recording_that_fails_keeps_what_was_written(tmp_path: Path) -> None:
    def fail() -> None:
        with BagWriter(tmp_path / "a.mcap", 2) as bag:
            bag.write(bag.add(string(2)), START_NS, raw(2, b"x"))
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    assert [message.raw for message in read(tmp_path / "a.mcap")[0]] == [raw(2, b"x")]


def test_equal_channels_share_a_handle(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap", 2) as bag:
        assert bag.add(string(2)) == bag.add(string(2))
        others = [string(2, "/other"), string(2, hash="RIHS01_other"), string(2, definition="string data\n# other\n")]
        assert sorted(bag.add(each) for each in [string(2), *others]) == [0, 1, 2, 3]


def test_a_channel_of_the_other_ros_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap", 2) as bag, pytest.raises(LocalError, match="of ROS 1"):
        bag.add(string(1))


def test_a_channel_about_which_little_is_known_can_be_recorded(tmp_path: Path) -> None:
    for name, ros in (("a.bag", 1), ("a.mcap", 2)):
        with BagWriter(tmp_path / name, ros) as bag:  # type: ignore[arg-type]
            bag.write(bag.add(Channel("/a", "x/msg/Y", ros)), START_NS, b"\x00\x01\x00\x00\x05")  # type: ignore[arg-type]
        assert [message.raw for message in read(tmp_path / name)[0]] == [b"\x00\x01\x00\x00\x05"]


def test_a_stamp_that_a_bag_cannot_hold_is_the_callers_fault(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag", 1) as bag:
        handle = bag.add(string(1))
        with pytest.raises(LocalError, match="stamp"):
            bag.write(handle, 1 << 63, raw(1, b"x"))
