"""Attacks with the bytes of a message whose description the publisher chooses."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable

import orjson
import pytest

from gdp.errors import RemoteError
from proxy.serial import serializer as serializer_module
from proxy.serial.channel import Channel, RosVersion
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.empty import NoAnswer
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Encoding, Serializer, canonical

RULE = "=" * 80 + "\n"
HOLLOW = f"A[] a\n{RULE}MSG: a/A\nN[65536] n\n{RULE}MSG: a/N\n"


def channel(definition: str, ros: RosVersion = 1) -> Channel:
    return Channel("/t", "a/msg/B", ros, definition=definition, definition_format="msg")


def memory_of(work: Callable[[], object]) -> int:
    """Return the most bytes that a call held."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("count", [1, 20, 60])
def test_a60_a_message_of_hollow_items_is_refused_within_its_budget(count: int) -> None:
    raw = struct.pack("<I", count) + bytes(64)
    serializer = Serializer(channel(HOLLOW), "json")
    assert memory_of(lambda: serializer.encode(raw)) < 1 << 20
    assert orjson.loads(serializer.encode(raw)).keys() == {"$raw"}
    assert memory_of(lambda: canonical(channel(HOLLOW), raw)) < 1 << 20


def test_a60_a_converted_message_of_hollow_items_is_refused_within_its_budget() -> None:
    source = channel(HOLLOW)
    converter = MessageConverter(source, translated_channel(source, 2))

    def convert() -> None:
        with pytest.raises(RemoteError):
            converter.convert(struct.pack("<I", 60) + bytes(64))

    assert memory_of(convert) < 1 << 20


def test_a60_sequences_of_hollow_items_share_one_budget() -> None:
    serializer = Serializer(channel(f"S[] s\n{RULE}MSG: a/S\nN[] n\n{RULE}MSG: a/N\n"), "json")
    raw = struct.pack("<I", 1_000) + struct.pack("<I", 60_000) * 1_000
    assert memory_of(lambda: serializer.encode(raw)) < 4 << 20


def test_a60_records_within_each_other_are_counted_one_by_one() -> None:
    levels = "".join(f"{RULE}MSG: a/T{n}\nT{n + 1}[1] t\n" for n in range(30))
    serializer = Serializer(channel(f"T0[] t\n{levels}{RULE}MSG: a/T30\nuint8[1] x\n"), "json")
    raw = struct.pack("<I", 100_000) + bytes(100_000)
    assert memory_of(lambda: serializer.encode(raw)) < 4 << 20


def test_a60_few_hollow_items_still_travel_readable() -> None:
    serializer = Serializer(channel(f"N[] n\n{RULE}MSG: a/N\n"), "json")
    raw = struct.pack("<I", 100)
    body = serializer.encode(raw)
    assert orjson.loads(body) == {"n": [{}] * 100}
    assert serializer.decode(body) == raw


def test_a60_many_small_records_still_travel_readable() -> None:
    serializer = Serializer(channel(f"P[] p\n{RULE}MSG: a/P\nfloat32 x\nfloat32 y\nfloat32 z\n"), "cbor")
    raw = struct.pack("<I", 200_000) + bytes(12 * 200_000)
    assert serializer.decode(serializer.encode(raw)) == raw
    assert b"$raw" not in serializer.encode(raw)


@pytest.mark.parametrize(
    "definition", ["float64[4000000000] a\n", f"A[60000] a\n{RULE}MSG: a/A\nC[60000] c\n{RULE}MSG: a/C\n"]
)
def test_a60_an_empty_answer_of_fixed_arrays_is_refused(definition: str) -> None:
    with pytest.raises(DefinitionError):
        NoAnswer(channel(definition, ros=2))


@pytest.mark.parametrize(
    ("encoding", "body"),
    [
        ("cbor", b"\x9a\x00\x08\x00\x00" + b"\x80" * (8 << 16)),
        ("cbor", b"\x9b\x00\x00\x00\x10\x00\x00\x00\x00"),
        ("cbor", b"\x81" * 100_000),
        ("json", b"[" + b"[]," * (3 << 20) + b"[]]"),
    ],
)
def test_a60_a_body_of_empty_lists_is_refused_before_it_is_decoded(
    encoding: Encoding, body: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serializer_module, "_CBOR_ITEMS_MAX", 4 << 16)  # a 16th: counting under tracemalloc is slow
    serializer = Serializer(channel("int8 a\n"), encoding)

    def decode() -> None:
        with pytest.raises(RemoteError):
            serializer.decode(body)

    assert memory_of(decode) < 1 << 20
