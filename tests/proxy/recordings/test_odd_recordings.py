"""Recordings as other tools and accidents leave them: what is there is read, and what is not is said."""

from __future__ import annotations

import sqlite3
import struct
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from proxy.recordings.channels import ros2_type
from proxy.recordings.reader import BagReader
from proxy.serial.schema import parse

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

STRING: Final = "std_msgs/msg/String"
T0: Final = 1_700_000_000_000_000_000
QOS: Final = (
    "- history: 1\n  depth: 10\n  reliability: {}\n  durability: 2\n  deadline: {{sec: 0, nsec: 0}}\n"
    "  lifespan: {{sec: 0, nsec: 0}}\n  liveliness: 1\n  liveliness_lease_duration: {{sec: 0, nsec: 0}}\n"
    "  avoid_ros_namespace_conventions: false"
)


def cdr(text: str) -> bytes:
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


def ros1(text: str) -> bytes:
    return len(text).to_bytes(4, "little") + text.encode()


def database(path: Path, messages: Sequence[bytes], first: int = 0) -> Path:
    with sqlite3.connect(path) as made:
        made.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles)"
        )
        made.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        made.execute("INSERT INTO topics VALUES(1, '/chatter', ?, 'cdr', ?)", (STRING, QOS.format(1)))
        rows = [(1, T0 + first + number, raw) for number, raw in enumerate(messages)]
        made.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
    made.close()
    return path


def metadata(folder: Path, files: Sequence[str], *, reliability: int = 1, compression: str = "") -> None:
    qos = QOS.format(reliability).replace("\n", "\\n")
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 4\n  storage_identifier: sqlite3\n"
        "  relative_file_paths:\n" + "".join(f"    - {name}\n" for name in files) + "  message_count: 4\n"
        f"  compression_format: '{'zstd' if compression else ''}'\n  compression_mode: '{compression}'\n"
        "  duration: {nanoseconds: 1}\n  starting_time: {nanoseconds_since_epoch: 1}\n"
        "  topics_with_message_count:\n    - topic_metadata:\n        name: /chatter\n"
        f'        type: {STRING}\n        serialization_format: cdr\n        offered_qos_profiles: "{qos}"\n'
        "      message_count: 4\n"
    )


# topic, encoding, name of the schema, its encoding and data, metadata
Made = tuple[str, str, str, str, bytes, dict[str, str]]


def _text(data: str | bytes) -> bytes:
    raw = data.encode() if isinstance(data, str) else data
    return struct.pack("<I", len(raw)) + raw


def _record(code: int, data: bytes) -> bytes:
    return struct.pack("<BQ", code, len(data)) + data


def mcap(path: Path, channels: Sequence[Made], messages: Sequence[tuple[int, bytes]], profile: str = "ros2") -> Path:
    """Write MCAP of one chunk, with its index and a summary (https://mcap.dev/spec)."""
    described = b""
    for number, (topic, encoding, name, schema_encoding, data, extra) in enumerate(channels, 1):
        described += _record(3, struct.pack("<H", number) + _text(name) + _text(schema_encoding) + _text(data))
        about = b"".join(_text(key) + _text(value) for key, value in extra.items())
        described += _record(4, struct.pack("<HH", number, number) + _text(topic) + _text(encoding) + _text(about))
    chunk, places = described, dict[int, list[tuple[int, int]]]()
    for at, (channel, raw) in enumerate(messages):
        places.setdefault(channel + 1, []).append((T0 + at, len(chunk)))
        chunk += _record(5, struct.pack("<HIQQ", channel + 1, at, T0 + at, T0 + at) + raw)
    times = struct.pack("<QQ", T0, T0 + len(messages))
    out = b"\x89MCAP0\r\n" + _record(1, _text(profile) + _text("test"))
    at_chunk = len(out)
    out += _record(6, times + struct.pack("<QI", len(chunk), 0) + _text("") + struct.pack("<Q", len(chunk)) + chunk)
    at_index, offsets = len(out), b""
    for number, rows in places.items():
        offsets += struct.pack("<HQ", number, len(out))
        out += _record(7, struct.pack("<H", number) + _text(b"".join(struct.pack("<QQ", *row) for row in rows)))
    index_bytes = len(out) - at_index
    out += _record(15, bytes(4))
    at_summary = len(out)
    place = times + struct.pack("<QQ", at_chunk, at_index - at_chunk) + _text(offsets)
    sizes = struct.pack("<Q", index_bytes) + _text("") + struct.pack("<QQ", len(chunk), len(chunk))
    counts = b"".join(struct.pack("<HQ", number, len(rows)) for number, rows in places.items())
    numbers = struct.pack("<QHIIII", len(messages), len(channels), len(channels), 0, 0, 1)
    out += described + _record(8, place + sizes) + _record(11, numbers + times + _text(counts))
    path.write_bytes(out + _record(2, struct.pack("<QQI", at_summary, 0, 0)) + b"\x89MCAP0\r\n")
    return path


def given(path: Path) -> tuple[dict[str, list[bytes]], str]:
    """Return the messages of each topic, and what could not be read; announced is as much as given."""
    with BagReader(path) as bag:
        found: dict[str, list[bytes]] = {channel.topic: [] for channel in bag.channels}
        for message in bag.messages():
            found[bag.channels[message.channel].topic].append(message.raw)
        assert bag.count == sum(map(len, found.values()))
        assert bag.counts is None or sum(bag.counts) == bag.count
        return found, bag.unread


TEXTS: Final = [cdr(f"m{number}") for number in range(4)]


@pytest.mark.parametrize("reliability", [1, 2])
@pytest.mark.parametrize("name", ["run", "run #3", "50%", "what?"])
def test_metadata_does_not_decide_which_messages_are_read(tmp_path: Path, name: str, reliability: int) -> None:
    folder = tmp_path / name
    folder.mkdir()
    file = database(folder / "run_0.db3", TEXTS)
    metadata(folder, ["run_0.db3"], reliability=reliability)
    assert given(folder) == given(file) == ({"/chatter": TEXTS}, "")


def _empty(folder: Path) -> None:
    (folder / "metadata.yaml").write_bytes(b"")


def _cut(folder: Path) -> None:
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text[: text.index("topics_with")])


def _garbled(folder: Path) -> None:
    (folder / "metadata.yaml").write_bytes(b"[{")


@pytest.mark.parametrize(("damage", "said"), [(_empty, "states no files"), (_cut, ""), (_garbled, "cannot be read")])
def test_all_storage_files_are_read_though_the_metadata_is_broken(
    tmp_path: Path, damage: Callable[[Path], None], said: str
) -> None:
    database(tmp_path / "run_0.db3", TEXTS[:2])
    database(tmp_path / "run_1.db3", TEXTS[2:], first=10)
    metadata(tmp_path, ["run_0.db3", "run_1.db3"])
    damage(tmp_path)
    found, unread = given(tmp_path)
    assert found == {"/chatter": TEXTS}
    assert said in unread
    assert bool(unread) == bool(said)


def test_a_part_that_is_gone_or_broken_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    database(tmp_path / "run_1.db3", TEXTS)
    (tmp_path / "run_2.mcap").write_bytes(b"no recording")
    metadata(tmp_path, ["run_0.db3", "run_1.db3", "run_2.mcap"])
    found, unread = given(tmp_path)
    assert found == {"/chatter": TEXTS}
    assert "run_0.db3, which metadata.yaml names, is not there" in unread
    assert "run_2.mcap cannot be read" in unread


@pytest.mark.parametrize("with_metadata", [True, False])
@pytest.mark.parametrize("how", ["file", "message"])
def test_compressed_files_and_messages_are_unpacked_with_and_without_metadata(
    tmp_path: Path, how: str, *, with_metadata: bool
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    messages = [zstd.compress(raw) for raw in TEXTS] if how == "message" else TEXTS
    file = database(tmp_path / "run_0.db3", messages)
    name = "run_0.db3"
    if how == "file":
        name = "run_0.db3.zstd"
        (folder / name).write_bytes(zstd.compress(file.read_bytes()))
    else:
        (folder / name).write_bytes(file.read_bytes())
    if with_metadata:
        metadata(folder, [name], compression=how.upper())
    assert given(folder) == given(folder / name) == ({"/chatter": TEXTS}, "")


CHATTER: Final[Made] = ("/chatter", "cdr", STRING, "ros2msg", b"string data", {})


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        (("/cfg", "json", "cfg", "jsonschema", b"{}", {}), "topic /cfg is left out: it is in json, not CDR"),
        (("/cfg", "protobuf", "cfg", "protobuf", b"\xff\xfe", {}), "topic /cfg is left out: it is in protobuf"),
        (("/cfg", "cdr", "a/srv/B_Event", "ros2msg", b"int64 a\n---\nint64 b\n", {}), "topic /cfg is carried unread"),
        (("/cfg", "cdr", "a/msg/B", "ros2msg", b"string a # \xe9\n", {}), ""),
        (("/cfg", "cdr", "a/msg/B", "", b"", {}), ""),
        (("/cfg", "cdr", "a/msg/B", "ros2msg", b"\x0cint8\x0b a\x0c\n", {}), ""),
        (("/cfg", "", "a/msg/B", "ros2msg", b"int8 a", {}), "topic /cfg is left out: it is in no encoding"),
        (("/cfg", "cdr", "a/msg/B", "ros2msg", b"int8 a", {"offered_qos_profiles": "- ["}), "given without its QoS"),
    ],
)
def test_one_odd_topic_never_refuses_the_others(tmp_path: Path, odd: Made, said: str) -> None:
    messages = [(0, TEXTS[0]), (1, b"\0\1\0\0\5"), (0, TEXTS[1])]
    found, unread = given(mcap(tmp_path / "a.mcap", [CHATTER, odd], messages))
    assert found["/chatter"] == TEXTS[:2]
    assert said in unread
    assert bool(unread) == bool(said)
    if "left out" not in said:
        assert found["/cfg"] == [b"\0\1\0\0\5"]


def test_an_mcap_of_ros_1_is_read_as_the_bag_that_it_came_from(tmp_path: Path) -> None:
    md5 = "992ce8a1687cec8c8bd883ec73ca41d1"
    about = {"md5sum": md5, "callerid": "/talker", "latching": "1", "topic": "chatter"}
    channel: Made = ("chatter", "ros1", "std_msgs/String", "ros1msg", b"string data\n", about)
    path = mcap(tmp_path / "a.mcap", [channel], [(0, ros1("x"))], profile="ros1")
    assert given(path) == ({"/chatter": [ros1("x")]}, "")
    with BagReader(path) as bag:
        (found,) = bag.channels
        assert (found.ros, found.type_name, found.hash, found.latched) == (1, STRING, md5, True)
        assert found.callerid == "/talker"


def _database_of_odd_text(folder: Path) -> Path:
    path = database(folder / "a.db3", TEXTS)
    with sqlite3.connect(path) as made:
        made.execute("CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)")
        text = "INSERT INTO message_definitions VALUES(?, 'ros2msg', CAST(? AS TEXT))"
        made.execute(text, (STRING, b"# \xa1\nstring data"))
        made.execute("INSERT INTO topics VALUES(2, CAST(? AS TEXT), NULL, 'cdr', '- [')", (b"/caf\xe9",))
    made.close()
    return path


def _mcap_of_odd_text(folder: Path) -> Path:
    other: Made = ("/cafX", "cdr", "a/msg/BX", "ros2msg", b"string a", {"by": "X"})
    path = mcap(folder / "a.mcap", [CHATTER, other], [(0, raw) for raw in TEXTS])
    path.write_bytes(path.read_bytes().replace(b"X", b"\xe9"))
    return path


def _bag_of_odd_text(folder: Path) -> Path:
    with Ros1Writer(folder / "a.bag") as writer:
        typestore = get_typestore(Stores.ROS1_NOETIC)
        chatter = writer.add_connection("/chatter", STRING, typestore=typestore)
        writer.add_connection("/cafX", "a/msg/BX", msgdef="string data # X", md5sum="0" * 31 + "X")
        for raw in TEXTS:
            writer.write(chatter, T0, raw)
    path = folder / "a.bag"
    path.write_bytes(path.read_bytes().replace(b"X", b"\xe9"))
    return path


@pytest.mark.parametrize("made", [_database_of_odd_text, _mcap_of_odd_text, _bag_of_odd_text])
def test_no_text_of_a_recording_need_be_utf_8(tmp_path: Path, made: Callable[[Path], Path]) -> None:
    found, unread = given(made(tmp_path))
    assert found == {"/chatter": TEXTS, "/caf\ufffd": []}
    assert not unread or "/caf\ufffd is given without its QoS" in unread


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (zstd.compress(TEXTS[0])[:-4], "its end is missing"),
        (b"\x1f\x8b\x08more", "compression 'gzip' is not supported"),
    ],
)
def test_a_message_that_cannot_be_unpacked_is_named_and_does_not_pass_as_one(
    tmp_path: Path, raw: bytes, said: str
) -> None:
    path = mcap(tmp_path / "a.mcap", [CHATTER], [(0, TEXTS[0]), (0, raw), (0, TEXTS[1])])
    with BagReader(path) as bag:
        assert [message.raw for message in bag.messages()] == TEXTS[:2]
        assert bag.missing == 1
        assert f"a message of /chatter cannot be unpacked: {said}" in bag.unread


@pytest.mark.parametrize("constant", ["string NONE=", "string  NONE = ", "int8 A=1\t# one"])
def test_a_bag_with_odd_text_in_a_definition_is_read_whole(tmp_path: Path, constant: str) -> None:
    with Ros1Writer(tmp_path / "a.bag") as writer:
        text = f"{constant}\n# caf\u00e9\nstring data\n"
        odd = writer.add_connection("odd", "own_msgs/msg/Odd", msgdef=text, md5sum="0" * 32)
        typestore = get_typestore(Stores.ROS1_NOETIC)
        chatter = writer.add_connection("chatter", STRING, typestore=typestore)
        writer.write(odd, T0, ros1("a"))
        writer.write(chatter, T0 + 1, ros1("b"))
    data = (tmp_path / "a.bag").read_bytes()
    (tmp_path / "a.bag").write_bytes(data.replace("\u00e9".encode(), b"\xe9\xe9"))  # Latin-1, as long
    assert given(tmp_path / "a.bag") == ({"/odd": [ros1("a")], "/chatter": [ros1("b")]}, "")
    with BagReader(tmp_path / "a.bag") as bag:
        odd_channel = next(each for each in bag.channels if each.topic == "/odd")
        assert parse(odd_channel.type_name, odd_channel.definition, odd_channel.definition_format, 1).fields


@pytest.mark.parametrize(
    "name",
    [STRING, "std_msgs/String", "std_msgs::msg::String", "std_msgs::msg::dds_::String_", "std_msgs/msg/dds_/String_"],
)
def test_a_type_has_its_name_in_ros_2_whichever_tool_recorded_it(name: str) -> None:
    assert ros2_type(name) == STRING


def test_a_type_of_dds_is_read_under_its_name_in_ros_2(tmp_path: Path) -> None:
    idl = b"module std_msgs { module msg { struct String { string data; }; }; };"
    path = mcap(tmp_path / "a.mcap", [("chatter", "cdr", "std_msgs::msg::String", "omgidl", idl, {})], [(0, TEXTS[0])])
    assert given(path) == ({"/chatter": TEXTS[:1]}, "")
    with BagReader(path) as bag:
        (channel,) = bag.channels
        assert channel.type_name == STRING
        assert parse(channel.type_name, channel.definition, channel.definition_format, 2).fields[0][0] == "data"
