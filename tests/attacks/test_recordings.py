"""Attacks with recordings: files of an untrusted author."""

from __future__ import annotations

import bz2
import functools
import sqlite3
import struct
import sys
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
from rosbags.rosbag1 import reader
from rosbags.rosbag2 import storage_mcap

from gdp.errors import ConfigError, LocalError
from proxy.recordings.channels import offered_qos
from proxy.recordings.decoder import BagDecoder
from tests.attacks.work import lines_run

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

BOMB_BYTES = 320 << 20
MAGIC = b"\x89MCAP0\r\n"
TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles)"
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id, 1 AS topic_id,"


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def record(code: int, body: bytes) -> bytes:
    return struct.pack("<BQ", code, len(body)) + body


@functools.cache
def packed(compression: str, size: int) -> bytes:
    piece = bytes(1 << 20)
    if compression == "zstd":
        packer = zstd.ZstdCompressor()
        return b"".join([*(packer.compress(piece) for _ in range(size >> 20)), packer.flush()])
    if compression == "bz2":
        bzip = bz2.BZ2Compressor()
        return b"".join(bzip.compress(piece) for _ in range(size >> 20)) + bzip.flush()
    with lz4.frame.LZ4FrameCompressor() as frame:
        return b"".join([frame.begin(), *(frame.compress(piece) for _ in range(size >> 20)), frame.flush()])


def mcap(path: Path, compression: str, data: bytes, said: int) -> Path:
    """Write a file with one channel and one chunk, and no summary."""
    schema = record(3, struct.pack("<H", 1) + text(b"a/msg/B") + text(b"ros2msg") + text(b"int8 a\n"))
    channel = record(4, struct.pack("<HH", 1, 1) + text(b"/t") + text(b"cdr") + text(b""))
    head = struct.pack("<QQQI", 0, 1, said, 0) + text(compression.encode()) + struct.pack("<Q", len(data))
    path.write_bytes(MAGIC + record(1, text(b"ros2") + text(b"")) + schema + channel + record(6, head + data))
    return path


def ros1(path: Path, compression: str, data: bytes, said: int) -> Path:
    """Write a bag with one chunk and no index."""

    def part(header: dict[bytes, bytes], body: bytes) -> bytes:
        fields = b"".join(struct.pack("<I", len(k + v) + 1) + k + b"=" + v for k, v in header.items())
        return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(body)) + body

    about = {b"topic": b"/t", b"type": b"a/B", b"md5sum": b"0" * 32, b"message_definition": b"int8 a\n"}
    fields = b"".join(struct.pack("<I", len(k + v) + 1) + k + b"=" + v for k, v in about.items())
    connection = part({b"op": b"\7", b"conn": bytes(4), b"topic": b"/t"}, fields)
    chunk = part({b"op": b"\5", b"compression": compression.encode(), b"size": struct.pack("<I", said)}, data)
    path.write_bytes(b"#ROSBAG V2.0\n" + connection + chunk)
    return path


def database(path: Path, *statements: str) -> Path:
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()
    return path


def memory_of(work: Callable[[], Any]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def read(path: Path) -> int:
    """Return how many messages a recording gives, -1 where it is refused."""
    try:
        with BagDecoder(path) as bag:
            return sum(1 for _ in bag.messages())
    except ConfigError:
        return -1


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("said", [1_000, 32 << 20, BOMB_BYTES, (1 << 64) - 1])
def test_a28_a_chunk_of_an_mcap_takes_no_more_memory_than_it_says_and_than_the_cap(
    tmp_path: Path, compression: str, said: int
) -> None:
    path = mcap(tmp_path / "a.mcap", compression, packed(compression, BOMB_BYTES), said)
    limit = 4 * min(said, 64 << 20) + (16 << 20)
    assert memory_of(lambda: read(path)) < limit


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
@pytest.mark.parametrize("said", [1_000, BOMB_BYTES])
def test_a28_a_chunk_of_a_ros_1_bag_takes_no_more_memory_than_it_says_and_than_the_cap(
    tmp_path: Path, compression: str, said: int
) -> None:
    path = ros1(tmp_path / "a.bag", compression, packed(compression, BOMB_BYTES), said)
    assert memory_of(lambda: read(path)) < 4 * min(said, 64 << 20) + (16 << 20)


def test_a28_rosbags_unpacks_within_the_same_bounds() -> None:
    for name in ("zstd", "lz4"):
        with pytest.raises(LocalError):
            storage_mcap.DECOMPRESSORS[name](packed(name, BOMB_BYTES), 1_000)
    for name in ("bz2", "lz4"):
        with pytest.raises(LocalError):
            reader.decompressors[name](packed(name, BOMB_BYTES))


def test_a28_a_folder_of_compressed_messages_or_files_unpacks_within_bounds(tmp_path: Path) -> None:
    bomb = packed("zstd", BOMB_BYTES)
    path = tmp_path / "m"
    path.mkdir()
    about = "{{rosbag2_bagfile_information: {{version: 4, compression_mode: {}, compression_format: zstd}}}}"
    (path / "metadata.yaml").write_text(about.format("MESSAGE"))
    with sqlite3.connect(path / "m_0.db3") as connection:
        connection.execute(TOPICS)
        connection.execute(MESSAGES)
        connection.execute("INSERT INTO topics VALUES (1, '/t', 'a/msg/B', 'cdr', '')")
        connection.execute("INSERT INTO messages VALUES (1, 1, 1, ?)", (bomb,))
        connection.execute("INSERT INTO messages VALUES (2, 1, 2, ?)", (zstd.compress(b"abcd"),))
    connection.close()
    with BagDecoder(path) as bag:
        messages = list(bag.messages())
        assert [message.raw for message in messages] == [b"abcd"]
        assert "more than" in bag.unread
    path = tmp_path / "f"
    path.mkdir()
    (path / "metadata.yaml").write_text(about.format("FILE"))
    (path / "f_0.db3.zstd").write_bytes(bomb)
    with pytest.raises(ConfigError, match="unpacks to more"):
        BagDecoder(path)


@pytest.mark.parametrize("suffix", [".db3", ".db"])
@pytest.mark.parametrize(
    "statements",
    [
        (TOPICS, f"CREATE VIEW messages AS {ENDLESS} 1 AS timestamp, x'00' AS data FROM c"),
        (MESSAGES, f"CREATE VIEW topics AS {ENDLESS} 1 AS name, 1 AS type, 'cdr' AS serialization_format FROM c"),
        (TOPICS, MESSAGES, f"CREATE VIEW schema AS SELECT max(id) AS schema_version FROM ({ENDLESS} 1 AS z FROM c)"),
        (TOPICS, "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)"),
    ],
    ids=["messages", "topics", "schema", "virtual"],
)
def test_a29_a_database_with_views_or_virtual_tables_is_refused(
    tmp_path: Path, suffix: str, statements: Sequence[str]
) -> None:
    path = database(tmp_path / f"a{suffix}", *statements)
    with pytest.raises(ConfigError, match=r"cannot be read"):
        BagDecoder(path)


@pytest.mark.parametrize("suffix", [".db3", ".db"])
def test_a29_a_tree_of_pages_that_shares_its_leaves_ends(tmp_path: Path, suffix: str) -> None:
    rows = [f"INSERT INTO messages VALUES ({at}, 1, {at}, zeroblob(900))" for at in range(4_000)]
    topic = "INSERT INTO topics VALUES (1, '/t', 'a/msg/B', 'cdr', '')"
    path = database(tmp_path / f"a{suffix}", TOPICS, MESSAGES, topic, *rows)
    raw = bytearray(path.read_bytes())
    interior = [at for at in range(4_096, len(raw), 4_096) if raw[at] == 5]
    for at in interior:  # each page of the tree points to the root again
        (count,) = struct.unpack_from(">H", raw, at + 3)
        for cell in range(count):
            (offset,) = struct.unpack_from(">H", raw, at + 12 + 2 * cell)
            raw[at + offset : at + offset + 4] = struct.pack(">I", interior[0] // 4_096 + 1)
    path.write_bytes(raw)
    with lines_run(1_000_000):
        assert read(path) <= 4_000


def test_a29_a_value_that_is_no_bytes_costs_no_memory(tmp_path: Path) -> None:
    topic = "INSERT INTO topics VALUES (1, '/t', 'a/msg/B', 'cdr', '')"
    for suffix in (".db3", ".db"):
        path = database(
            tmp_path / f"a{suffix}", TOPICS, MESSAGES, topic, "INSERT INTO messages VALUES (1, 1, 1, 2000000000)"
        )
        assert memory_of(functools.partial(read, path)) < 16 << 20


@pytest.mark.parametrize(
    "qos",
    ["!!python/object:x []", "- {", "[" * 3_000, "- history: {a: b}", "&a [*a]", "- 1\n- 2", "\x00", "- history: 99"],
)
@pytest.mark.parametrize("suffix", [".db3", ".db"])
def test_a66_qos_that_is_no_yaml_of_ours_is_refused_as_a_recording(tmp_path: Path, qos: str, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with sqlite3.connect(path) as connection:
        connection.execute(TOPICS)
        connection.execute(MESSAGES)
        connection.execute("INSERT INTO topics VALUES (1, '/t', 'a/msg/B', 'cdr', ?)", (qos,))
    connection.close()
    assert read(path) in (0, -1)


@pytest.mark.parametrize("opening", ["[", "{", "- ", "[&a ", "? "])
def test_b08_qos_of_nothing_but_openings_costs_little(opening: str) -> None:
    with lines_run(30_000):
        assert offered_qos("/t", opening * (8_000 // len(opening)), []) == []


def test_b08_metadata_of_nothing_but_openings_cost_little(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("[" * 8_000)
    database(tmp_path / "a_0.db3", TOPICS, MESSAGES)
    with lines_run(30_000):
        assert read(tmp_path) == 0  # its database has no messages


@pytest.mark.parametrize("suffix", ["bag", "mcap"])
def test_b09_a_record_that_is_longer_than_its_file_reserves_no_memory(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    if suffix == "bag":
        head = b"op=\3"
        fields = b"".join(
            struct.pack("<I", len(each)) + each
            for each in (head, b"index_pos=" + struct.pack("<Q", 13), b"conn_count=\1\0\0\0", b"chunk_count=\1\0\0\0")
        )
        path.write_bytes(b"#ROSBAG V2.0\n" + text(fields) + struct.pack("<I", 0xFFFFFFF0) + bytes(100))
        data = bytearray(path.read_bytes())
        at = data.index(b"index_pos=") + 10
        data[at : at + 8] = struct.pack("<Q", len(data) - 104)  # the index begins with a record of 4 GB
        path.write_bytes(data)
    else:
        footer = record(2, struct.pack("<QQI", 8, 0, 0))
        path.write_bytes(MAGIC + struct.pack("<BQ", 1, 1 << 31) + bytes(100) + footer + MAGIC)
    assert memory_of(lambda: read(path)) < 1 << 20
