"""Decoders of files: recordings, configurations, parameters, and local state."""

from __future__ import annotations

import io
import json
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

from fog.cluster import ClusterPlan
from fog.host.bundle import read_programs
from fog.launch.cloud_node import parameters_in
from fog.providers.local.machine_file import MachineFile
from fog.supervisor.journal import Journal
from gdp.config.config import SwitchConfig
from gdp.config.yaml_source import read_yaml
from gdp.crypto.pbes2 import SECRET_LABEL, _parts, protect
from gdp.errors import ConfigError, LocalError, RemoteError, StoreError
from proxy.config.config import ProxyConfig
from proxy.recordings.channels import offered_qos
from proxy.recordings.decoder import BagDecoder
from proxy.recordings.source import Message
from proxy.recordings.stream import FrameReader, Kind, frame_head, message_head, opened_to
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel
from tests.fuzzing.decoder import Decoder

__all__ = ["DECODERS"]

_YAML: Final = (b"- ", b": ", b"{", b"}", b"[", b"]", b"&a ", b"*a", b"!!", b"!x ", b"|\n", b"'", b'"', b"\n  ", b"#")
_MCAP_TOKENS: Final = (b"zstd", b"lz4", b"\x89MCAP0\r\n", bytes(8), b"\xff" * 8, b"cdr", b"ros2msg", b"\x06", b"\x04")
_BAG_TOKENS: Final = (b"op=\x05", b"op=\x02", b"conn=", b"compression=lz4", b"compression=bz2", b"size=", b"\xff" * 4)
_QOS: Final = b"- history: 3\n  depth: 1\n  reliability: 1\n  durability: 2\n  deadline: {sec: 1, nsec: 2}\n"
_CONFIG: Final = b"identity: id\ndomain: {root: r.crt}\niface: a\nexpose:\n - {name: /a, type: a/msg/B, owner: o.pub}\n"
_TOPICS: Final = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format"
_TEXT_MAX: Final = 8_192  # bytes: the readers of YAML are slow


def _in_file(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    """Return a function that reads bytes as a file in a folder of its own."""

    def run(data: bytes) -> object:
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            path = Path(folder) / name
            path.write_bytes(data)
            return read(path)

    return run


def _bag(path: Path) -> object:
    with BagDecoder(path) as bag:
        return sum(len(message.raw) for message in bag.messages())


def _folder(path: Path) -> object:
    with sqlite3.connect(path.with_name("a_0.db3")) as file:
        file.execute(f"{_TOPICS})")
        file.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
    file.close()
    return _bag(path.parent)


def _journal(path: Path) -> object:
    journal = Journal(path)
    try:
        return [journal.clusters(), journal.events(), [journal.machines(each.plan.name) for each in journal.clusters()]]
    finally:
        journal.close()


def _frames(data: bytes) -> object:
    pipe = io.BytesIO(data)

    def take(size: int) -> bytes:
        if len(piece := pipe.read(min(size, len(data)))) < size:
            raise LocalError("the pipe is closed")
        return piece

    reader = FrameReader()
    return reader.open(take), sum(len(message.raw) for message in reader.messages(take))


def _qos(data: bytes) -> object:
    return offered_qos("/a", data.decode("latin-1"), [])


def _recording(ros: int) -> bytes:
    suffix = "bag" if ros == 1 else "mcap"
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        path = Path(folder) / f"a.{suffix}"
        with BagWriter(path, 1 if ros == 1 else 2) as writer:
            channel = Channel(
                "/t", "a/msg/B", 1 if ros == 1 else 2, hash="0" * 32, definition="int8 a\n", definition_format="msg"
            )
            handle = writer.add(channel)
            for stamp in range(3):
                writer.write(handle, 10**18 + stamp, b"\x00\x01\x00\x00x" if ros == 2 else b"x")
        return path.read_bytes()


def _database() -> bytes:
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        path = Path(folder) / "a.db3"
        with sqlite3.connect(path) as file:
            file.execute("PRAGMA page_size=512")
            file.execute(f"{_TOPICS}, offered_qos_profiles)")
            file.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
            file.execute("INSERT INTO topics VALUES (1, '/t', 'a/msg/B', 'cdr', '')")
            file.executemany("INSERT INTO messages VALUES (?, 1, ?, ?)", [(at, at, bytes(90)) for at in range(20)])
        file.close()
        return path.read_bytes()


def _journal_file() -> bytes:
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        path = Path(folder) / "journal"
        Journal(path).close()
        return path.read_bytes()


_METADATA: Final = b"""rosbag2_bagfile_information:
  version: 4
  storage_identifier: sqlite3
  relative_file_paths: [a_0.db3]
  duration: {nanoseconds: 1}
  starting_time: {nanoseconds_since_epoch: 1}
  message_count: 0
  compression_format: ""
  compression_mode: ""
  topics_with_message_count:
    - {topic_metadata: {name: /t, type: a/msg/B, serialization_format: cdr, offered_qos_profiles: ""}, message_count: 0}
"""
_PARTS: Final = (
    (Kind.CHANNEL, Channel("/t", "a/msg/B", 2, hash="", definition="int8 a\n", definition_format="msg").to_wire()),
    (Kind.OPENED, opened_to(2, [2])),
    (Kind.BLOCK, b"".join(message_head(Message(0, at, b"abc")) + b"abc" for at in range(2))),
    (Kind.END, b"the file ends"),
)
_FRAMES: Final = b"".join(frame_head(kind, len(data)) + data for kind, data in _PARTS)
_PROGRAMS: Final = json.dumps({"programs": [{"name": "a", "argv": ["b"], "environment": {}}]}).encode()
_PLAN: Final = json.dumps({"name": "a", "nodes": [], "machines": [], "carried": []}).encode()
_MACHINE: Final = json.dumps({"spec": {"offer": {"hardware": {}}}, "started_unix_s": 1, "gateway": ""}).encode()
_REFUSED: Final = (ConfigError, LocalError)
_SQLITE: Final = (b"CREATE VIEW ", b"CREATE TABLE ", b"\x05", b"\x0d", b"\x00\x00\x00\x02", b"\xff" * 8)

DECODERS: Final = (
    Decoder("mcap", _in_file("a.mcap", _bag), (_recording(2),), _REFUSED, _MCAP_TOKENS),
    Decoder("mcap-scan", _in_file("a.dat", _bag), (_recording(2),), _REFUSED, _MCAP_TOKENS),
    Decoder("bag", _in_file("a.bag", _bag), (_recording(1),), _REFUSED, _BAG_TOKENS),
    Decoder("db3", _in_file("a.db3", _bag), (_database(),), _REFUSED, _SQLITE),
    Decoder("db3-scan", _in_file("a.dat", _bag), (_database(),), _REFUSED, _SQLITE),
    Decoder("bag-folder", _in_file("metadata.yaml", _folder), (_METADATA,), _REFUSED, _YAML, size_max=_TEXT_MAX),
    Decoder("bag-stream", _frames, (_FRAMES,), (LocalError, RemoteError)),
    Decoder("qos", _qos, (_QOS,), (LocalError,), _YAML, size_max=_TEXT_MAX),
    Decoder("yaml", _in_file("a.yaml", read_yaml), (_CONFIG,), _REFUSED, _YAML, size_max=_TEXT_MAX),
    Decoder(
        "proxy-config",
        _in_file("p.yaml", ProxyConfig.load),
        (_CONFIG,),
        _REFUSED,
        _YAML,
        size_max=_TEXT_MAX,
        memory_max=8.0,  # a rule of five bytes gets an error for each key that it lacks
    ),
    Decoder("switch-config", _in_file("s.yaml", SwitchConfig.load), (_CONFIG,), _REFUSED, _YAML, size_max=_TEXT_MAX),
    Decoder(
        "parameters",
        _in_file("p.yaml", lambda path: parameters_in(path, "n", "/")),
        (b"n:\n  ros__parameters: {a: 1, b: [1, 2], c: {d: x}}\n",),
        (LocalError,),
        _YAML,
        size_max=_TEXT_MAX,
    ),
    Decoder("journal", _in_file("journal", _journal), (_journal_file(),), (StoreError, LocalError)),
    Decoder("machine-file", _in_file("machine.json", lambda path: MachineFile.read(path.parent)), (_MACHINE,), ()),
    Decoder("pbes2", _parts, (protect(bytes(96), b"p", bytes(32), SECRET_LABEL),), (LocalError,)),
    Decoder("boot", read_programs, (_PROGRAMS,), (LocalError,)),
    Decoder("plan", lambda data: ClusterPlan.from_json(data.decode("latin-1")), (_PLAN,), (LocalError,)),
)
