"""Serializer of ROS messages: numbers, text, layout, and hostile bytes."""

from __future__ import annotations

import json
import math
import struct
from typing import Any, get_args

import cbor2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gdp.errors import DropReason, RemoteError
from proxy.serial.channel import Channel, DefinitionFormat, RosVersion
from proxy.serial.serializer import Encoding, Serializer, canonical
from tests.proxy.bridge import known

LITTLE = b"\x00\x01\x00\x00"
READABLE: tuple[Encoding, ...] = ("json", "cbor")
EVERY: tuple[Encoding, ...] = get_args(Encoding)
RULE = "=" * 80 + "\n"

MIXED = f"""\
bool flag
byte octet
char letter
int8 i8
uint16 u16
int32 i32
uint64 u64
int64 i64
float32 f32
float64 f64
string name
float32 after
float64[3] three
float64[] many
float32[] beams
uint8[] data
uint8[5] five
int8[] cells
int64[] longs
bool[] flags
bool[2] pair
string[] names
string[2] two
Inner inner
Inner[] inners
Inner[2] twice
Flat[] flats
Nothing nothing
{RULE}MSG: a/Inner
uint8 a
float64 b
string c
{RULE}MSG: a/Flat
uint8 a
float64 b
{RULE}MSG: a/Nothing
"""


def channel(definition: str, ros: RosVersion = 2, definition_format: DefinitionFormat = "msg") -> Channel:
    return Channel("/t", "a/msg/B", ros, definition=definition, definition_format=definition_format)


def there_and_back(about: Channel, raw: bytes, encoding: Encoding) -> bytes:
    serializer = Serializer(about, encoding)
    return serializer.decode(serializer.encode(raw))


def json_of(about: Channel, raw: bytes) -> object:
    return json.loads(Serializer(about, "json").encode(raw))


def cdr_string(text: bytes) -> bytes:
    return LITTLE + struct.pack("<I", len(text) + 1) + text + b"\0"


# --- numbers


@pytest.mark.parametrize("encoding", READABLE)
@given(bits=st.integers(0, 0xFFFFFFFF))
def test_every_float32_keeps_its_bits(encoding: Encoding, bits: int) -> None:
    about = channel("float32 x\nfloat32[] a\nfloat32[2] b\n")
    raw = LITTLE + struct.pack("<IIIII", bits, 1, bits, bits, 0)
    assert there_and_back(about, raw, encoding) == raw


@pytest.mark.parametrize("encoding", READABLE)
@given(bits=st.integers(0, 0xFFFFFFFFFFFFFFFF))
def test_every_float64_keeps_its_bits(encoding: Encoding, bits: int) -> None:
    about = channel("float64 x\nfloat64[] a\n")
    raw = LITTLE + struct.pack("<QI4xQ", bits, 1, bits)
    assert there_and_back(about, raw, encoding) == raw


@pytest.mark.parametrize("encoding", READABLE)
@pytest.mark.parametrize(
    "bits",
    [0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC00000, 0x7F800001, 0x7FFFFFFF, 0x80000000, 1, 0x15AE43FD, 0x95AE43FD],
)
def test_the_strange_float32_values_keep_their_bits(encoding: Encoding, bits: int) -> None:
    about = channel("float32 x\nfloat32[] a\nfloat32[70] b\n")
    raw = LITTLE + struct.pack("<II", bits, 3) + struct.pack("<I", bits) * 73
    assert there_and_back(about, raw, encoding) == raw


def test_what_is_no_number_has_a_word_in_json() -> None:
    about = channel("float64[] a\nfloat32 b\n")
    raw = LITTLE + struct.pack("<I4x3dI", 3, math.inf, -math.inf, math.nan, 0x7FC00001)
    assert json_of(about, raw) == {"a": ["Infinity", "-Infinity", "NaN"], "b": "NaN:7fc00001"}


def test_an_array_of_float32_has_short_digits() -> None:
    raw = LITTLE + struct.pack("<I2f", 2, 0.1, math.nan)
    assert json_of(channel("float32[] a\n"), raw) == {"a": [0.1, "NaN"]}


@pytest.mark.parametrize("encoding", READABLE)
@given(signed=st.integers(-(1 << 63), (1 << 63) - 1), unsigned=st.integers(0, (1 << 64) - 1))
def test_every_64_bit_integer_is_exact(encoding: Encoding, signed: int, unsigned: int) -> None:
    about = channel("int64 a\nuint64 b\nint64[] c\nuint64[] d\n")
    raw = LITTLE + struct.pack("<qQI4xqI4xQ", signed, unsigned, 1, signed, 1, unsigned)
    assert there_and_back(about, raw, encoding) == raw


def test_integers_that_json_readers_would_round_are_text() -> None:
    raw = LITTLE + struct.pack("<I4x3q", 3, (1 << 53) - 1, 1 << 53, -(1 << 63))
    assert json_of(channel("int64[] a\n"), raw) == {"a": [(1 << 53) - 1, str(1 << 53), str(-(1 << 63))]}


def test_octets_are_base64_and_small_integers_are_not() -> None:
    about = channel("uint8[] a\nbyte[] b\nchar[] c\nint8[] d\n")
    raw = LITTLE + b"".join(struct.pack("<Ibx2x", 1, -1) for _ in range(4))[:-3]
    assert json_of(about, raw) == {"a": "/w==", "b": "/w==", "c": "/w==", "d": [-1]}


def test_arrays_of_numbers_are_typed_arrays_in_cbor() -> None:
    raw = LITTLE + struct.pack("<I2f", 2, 1.0, 2.0)
    tree = cbor2.loads(Serializer(channel("float32[] a\n"), "cbor").encode(raw))
    assert tree["a"].tag == 85
    assert tree["a"].value == raw[8:]


# --- text


@pytest.mark.parametrize("encoding", READABLE)
@given(text=st.binary(max_size=40), more=st.binary(max_size=9))
def test_any_bytes_survive_in_a_string(encoding: Encoding, text: bytes, more: bytes) -> None:
    about = channel("string a\nstring[] b\n", ros=1)
    raw = b"".join(
        [struct.pack("<I", len(text)), text, struct.pack("<II", 1, len(more)), more],
    )
    assert there_and_back(about, raw, encoding) == raw


@pytest.mark.parametrize("encoding", READABLE)
@pytest.mark.parametrize("text", [b"", b"plain", "żółw 🐢".encode(), b"\xff\xfe", b"a\0b", b"\xed\xa0\x80"])
def test_strings_in_cdr_survive(encoding: Encoding, text: bytes) -> None:
    raw = cdr_string(text)
    assert there_and_back(channel("string a\n"), raw, encoding) == raw


def test_a_string_that_is_not_utf_8_is_marked_in_json() -> None:
    assert json_of(channel("string a\n"), cdr_string(b"\xff")) == {"a": {"base64": "/w=="}}


def wide(layout: str, units: list[int]) -> bytes:
    width = 4 if layout == "4" else 2
    count = len(units) * 2 if layout == "2b" else len(units)
    body = struct.pack("<I", count) + b"".join(unit.to_bytes(width, "little") for unit in units)
    return LITTLE + body + bytes(-len(body) % 4) + struct.pack("<i", 7)


@pytest.mark.parametrize("encoding", READABLE)
@pytest.mark.parametrize("layout", ["4", "2", "2b"])
@pytest.mark.parametrize("units", [[], [0x68, 0x69], [0xD83D, 0xDC22, 0x21], [0xD83D], [0x17C, 0xF3, 0x142, 0x77]])
def test_wide_strings_keep_the_layout_that_they_came_in(encoding: Encoding, layout: str, units: list[int]) -> None:
    raw = wide(layout, units)
    assert there_and_back(channel("wstring a\nint32 b\n"), raw, encoding) == raw


def test_a_wide_string_is_readable_in_json() -> None:
    about = channel("wstring a\nint32 b\n")
    assert json_of(about, wide("4", [0x68, 0x69])) == {"a": "hi", "b": 7}
    assert json_of(about, wide("2b", [0x68, 0x69])) == {"a": {"wide": "2b", "text": "hi"}, "b": 7}


# --- whole messages


def mixed_message(seed: int) -> tuple[Channel, bytes]:
    """Message of every kind of field, written by rosbags: the oracle for layout and padding."""
    random = np.random.default_rng(seed)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(MIXED, "a/msg/B"))
    make = store.types

    def size() -> int:
        return int(random.integers(0, 4))

    def inner() -> Any:
        return make["a/msg/Inner"](int(random.integers(256)), float(random.normal()), "c" * size())

    def flat() -> Any:
        return make["a/msg/Flat"](int(random.integers(256)), float(random.normal()))

    message = make["a/msg/B"](
        flag=bool(random.integers(2)),
        octet=int(random.integers(128)),
        letter=int(random.integers(256)),
        i8=int(random.integers(-128, 128)),
        u16=int(random.integers(1 << 16)),
        i32=int(random.integers(-(1 << 31), 1 << 31)),
        u64=int(random.integers(1 << 63)),
        i64=int(random.integers(-(1 << 63), 1 << 62)),
        f32=float(np.float32(random.normal())),
        f64=float(random.normal()),
        name="n" * size(),
        after=1.5,
        three=random.normal(size=3),
        many=random.normal(size=size()),
        beams=random.normal(size=size()).astype(np.float32),
        data=random.integers(0, 256, size(), dtype=np.uint8),
        five=random.integers(0, 256, 5, dtype=np.uint8),
        cells=random.integers(-128, 128, size(), dtype=np.int8),
        longs=random.integers(-(1 << 60), 1 << 60, size(), dtype=np.int64),
        flags=random.integers(0, 2, size()).astype(np.bool_),
        pair=random.integers(0, 2, 2).astype(np.bool_),
        names=["x" * size() for _ in range(size())],
        two=["y" * size(), "z"],
        inner=inner(),
        inners=[inner() for _ in range(size())],
        twice=[inner(), inner()],
        flats=[flat() for _ in range(size())],
        nothing=make["a/msg/Nothing"](),
    )
    return channel(MIXED), bytes(store.serialize_cdr(message, "a/msg/B", little_endian=True))


@pytest.mark.parametrize("encoding", EVERY)
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1 << 30))
def test_a_message_of_every_kind_of_field_survives(encoding: Encoding, seed: int) -> None:
    about, raw = mixed_message(seed)
    assert canonical(about, raw) == raw
    body = Serializer(about, encoding).encode(raw)
    assert b"$raw" not in body
    assert Serializer(about, encoding).decode(body) == raw


def test_padding_and_what_follows_the_last_field_are_tidied() -> None:
    about = channel("uint8 a\nfloat64 b\nuint8 c\n")
    rubbish = b"\x00\x01\x55\x55" + b"\x01" + b"\x77" * 7 + struct.pack("<d", 1.0) + b"\x02" + b"\x99" * 3
    tidy = LITTLE + b"\x01" + bytes(7) + struct.pack("<d", 1.0) + b"\x02"
    assert canonical(about, rubbish) == tidy
    for encoding in READABLE:
        assert there_and_back(about, rubbish, encoding) == tidy
    assert there_and_back(about, rubbish, "cdr") == rubbish


def test_a_bool_is_0_or_1_in_canonical_form() -> None:
    about = channel("bool a\nbool[] b\n")
    raw = LITTLE + b"\x07\0\0\0" + struct.pack("<I", 2) + b"\x09\x00"
    assert canonical(about, raw) == LITTLE + b"\x01\0\0\0" + struct.pack("<I", 2) + b"\x01\x00"


@pytest.mark.parametrize("encoding", READABLE)
def test_big_endian_cdr_arrives_little_endian(encoding: Encoding) -> None:
    about = channel("uint16 a\nfloat64 b\nstring c\nfloat32[] d\nwstring e\nint16[3] f\n")
    values = (7, 1.5, 3, b"ab\0", 1, 2.5, 1, 0x17C)
    layout = "{0}H6xdI3sxIfIIhhh"
    big = b"\x00\x00\x00\x00" + struct.pack(layout.format(">"), *values, 1, 2, -3)
    little = LITTLE + struct.pack(layout.format("<"), *values, 1, 2, -3)
    assert there_and_back(about, big, encoding) == canonical(about, big) == little


def test_a_type_without_fields_has_one_byte_in_ros_2_and_none_in_ros_1() -> None:
    for encoding in EVERY:
        assert there_and_back(channel(""), LITTLE + b"\0", encoding) == LITTLE + b"\0"
        assert there_and_back(channel("", ros=1), b"", encoding) == b""


@pytest.mark.parametrize("encoding", READABLE)
def test_the_sequence_number_of_a_ros_1_header_survives(encoding: Encoding) -> None:
    about = channel(f"Header header\n{RULE}MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n", ros=1)
    raw = struct.pack("<IIII", 4_000_000_000, 3_000_000_000, 5, 3) + b"map"
    assert there_and_back(about, raw, encoding) == raw
    assert Serializer(about, encoding).opaque == ""


# --- bytes that cannot be decoded


@pytest.mark.parametrize("encoding", EVERY)
@pytest.mark.parametrize(
    ("definition", "raw"),
    [
        ("float64 a\n", LITTLE + b"\0\0"),  # too short
        ("uint8 a\n", LITTLE + bytes(20)),  # too long
        ("string a\n", LITTLE + b"\xff\xff\xff\xffabc"),  # a count beyond the message
        ("string[] a\n", LITTLE + b"\xff\xff\xff\xff"),
        ("uint8 a\n", b"\x00\x07\x00\x00\x01"),  # XCDR2
        ("uint8 a\n", b"\x00"),  # no encapsulation at all
    ],
)
def test_a_message_that_does_not_fit_travels_opaque(encoding: Encoding, definition: str, raw: bytes) -> None:
    about = channel(definition)
    assert there_and_back(about, raw, encoding) == raw
    assert canonical(about, raw) == raw


@pytest.mark.parametrize("encoding", READABLE)
def test_a_channel_without_a_definition_travels_opaque_and_says_so(encoding: Encoding) -> None:
    about = channel("", definition_format="")
    assert there_and_back(about, b"\x00\x01\x00\x00whatever", encoding) == b"\x00\x01\x00\x00whatever"
    assert "no definition" in Serializer(about, encoding).opaque


def test_a_count_of_empty_items_costs_no_memory() -> None:
    about = channel(f"Nothing[] a\n{RULE}MSG: a/Nothing\n", ros=1)
    raw = struct.pack("<I", 0xFFFFFFFF)
    assert json.loads(Serializer(about, "json").encode(raw)).keys() == {"$raw"}


# --- messages of a peer


def refusal(about: Channel, body: bytes, encoding: Encoding) -> DropReason | None:
    try:
        Serializer(about, encoding).decode(body)
    except RemoteError as error:
        return error.reason
    return None


@pytest.mark.parametrize("encoding", READABLE)
@given(body=st.binary(max_size=64))
def test_arbitrary_bytes_are_a_message_or_refused(encoding: Encoding, body: bytes) -> None:
    assert refusal(channel(MIXED), body, encoding) in (None, DropReason.MALFORMED)


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["a", "b", "base64", "wide"]), inner),
    max_leaves=6,
)


@pytest.mark.parametrize("encoding", READABLE)
@pytest.mark.parametrize(
    "definition",
    ["int32 a\n", "float32 a\nbool b\n", "string a\n", "wstring a\n", "uint64[] a\n", "float32[2] a\n", "bool[] a\n"],
)
@settings(max_examples=40)
@given(a=_JSON, b=_JSON)
def test_any_value_in_a_field_fits_or_is_refused(encoding: Encoding, definition: str, a: object, b: object) -> None:
    tree = {"a": a, "b": b}
    body = cbor2.dumps(tree) if encoding == "cbor" else json.dumps(tree).encode()
    assert refusal(channel(definition), body, encoding) in (None, DropReason.MALFORMED)


@pytest.mark.parametrize(
    ("definition", "body"),
    [
        ("int32 a\n", b'{"a": 1.5}'),
        ("int32 a\n", b'{"a": 2147483648}'),
        ("int32 a\n", b'{"b": 1}'),
        ("int32 a\n", b"[1]"),
        ("bool a\n", b'{"a": 1}'),
        ("float32 a\n", b'{"a": 1e300}'),
        ("float64 a\n", b'{"a": "nan"}'),
        ("uint8[] a\n", b'{"a": "!!!"}'),
        ("uint8[4] a\n", b'{"a": "AAAA"}'),
        ("int32[] a\n", b'{"a": [1, 2.5]}'),
        ("int32[2] a\n", b'{"a": [1]}'),
        ("string a\n", b'{"a": 5}'),
        ("wstring a\n", b'{"a": {"wide": "3", "text": "x"}}'),
        ("string[] a\n", b'{"a": "abc"}'),
        ("int32 a\n", b'{"$raw": 5}'),
    ],
)
def test_a_value_of_the_wrong_kind_is_refused(definition: str, body: bytes) -> None:
    assert refusal(channel(definition), body, "json") is DropReason.MALFORMED


@pytest.mark.parametrize("encoding", READABLE)
def test_nesting_a_thousand_deep_is_refused(encoding: Encoding) -> None:
    body = b"[" * 100_000 if encoding == "json" else b"\x81" * 100_000
    assert refusal(channel(MIXED), body, encoding) is DropReason.MALFORMED


def test_a_typed_array_of_another_kind_or_length_is_refused() -> None:
    about = channel("float32[] a\n")
    for tag, raw in ((86, bytes(8)), (85, bytes(7)), (64, bytes(4))):
        assert refusal(about, cbor2.dumps({"a": cbor2.CBORTag(tag, raw)}), "cbor") is DropReason.MALFORMED


def test_shared_values_that_stand_for_millions_of_items_are_refused() -> None:
    """Six kilobytes of references: a thousand times the same list, which has a thousand times the same text."""
    about = channel(f"Row[] rows\n{RULE}MSG: a/Row\nstring[] cells\n")

    def many(first: bytes, number: int) -> bytes:
        return b"\x99\x04\x00" + b"\xd8\x1c" + first + (b"\xd8\x1d" + bytes([number])) * 1_023

    cells = b"\xa1" + cbor2.dumps("cells") + many(cbor2.dumps("x" * 100), 1)
    body = b"\xa1" + cbor2.dumps("rows") + many(cells, 0)
    assert refusal(about, body, "cbor") is DropReason.MALFORMED


def test_a_few_bytes_that_announce_many_records_without_fields_are_not_read() -> None:
    channel = known.custom("a/msg/Nothings", f"a/Nothing[] nothings\n{RULE}MSG: a/Nothing\n", 1)
    serializer = Serializer(channel, "json")
    assert json.loads(serializer.encode(struct.pack("<I", 200))) == {"nothings": [{}] * 200}
    assert "$raw" in json.loads(serializer.encode(struct.pack("<I", 1_000)))
