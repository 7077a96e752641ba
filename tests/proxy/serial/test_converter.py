"""Message converter between ROS 1 and ROS 2."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from gdp.errors import DropReason, RemoteError
from proxy.serial.channel import Channel, DefinitionFormat, Qos, RosVersion
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import canonical

LITTLE = b"\x00\x01\x00\x00"
RULE = "=" * 80 + "\n"
LASTING = Qos(depth=5, reliability="reliable", durability="transient_local")
HEADER1 = f"{RULE}MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
HEADER2 = f"{RULE}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
MIXED = f"""\
bool flag
byte octet
char letter
int8 i8
uint16 u16
int64 i64
float32 f32
string name
float64[3] three
float64[] many
uint8[] data
byte[5] five
bool[] flags
string[2] names
Inner inner
Inner[] inners
Inner[2] twice
Flat[] flats
Nothing nothing
Nothing[] nothings
{RULE}MSG: a/Inner
uint8 a
float64 b
string c
{RULE}MSG: a/Flat
uint8 a
float64 b
{RULE}MSG: a/Nothing
"""


def channel(definition: str, ros: RosVersion, definition_format: DefinitionFormat = "msg") -> Channel:
    return Channel("/t", "a/msg/B", ros, definition=definition, definition_format=definition_format)


def standard(type_name: str, ros: RosVersion) -> Channel:
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_JAZZY)
    text, md5 = store.generate_msgdef(type_name, ros)
    return Channel("/t", type_name, ros, hash=md5 if ros == 1 else "", definition=text, definition_format="msg")


def to_ros2(one: str, other: str, raw: bytes) -> bytes:
    return MessageConverter(channel(one, 1), channel(other, 2)).convert(raw)


def to_ros1(one: str, other: str, raw: bytes) -> bytes:
    return MessageConverter(channel(one, 2), channel(other, 1)).convert(raw)


def difference(there: Channel, here: Channel) -> str:
    with pytest.raises(DefinitionError) as refusal:
        MessageConverter(there, here)
    return str(refusal.value)


# --- differences without meaning


def test_a_header_loses_its_sequence_number_and_gains_a_zero() -> None:
    ros1 = struct.pack("<IIII", 7, 1, 2, 3) + b"map"
    ros2 = LITTLE + struct.pack("<III", 1, 2, 4) + b"map\0"
    one, other = f"Header header\n{HEADER1}", f"std_msgs/Header header\n{HEADER2}"
    assert to_ros2(one, other, ros1) == ros2
    assert to_ros1(other, one, ros2) == bytes(4) + ros1[4:]


def test_a_sequence_number_on_both_sides_is_kept() -> None:
    one = f"Head header\n{RULE}MSG: a/Head\nuint32 seq\ntime stamp\nstring frame_id\n"
    other = one.replace("time", "builtin_interfaces/Time")
    raw = struct.pack("<IIII", 7, 1, 2, 0)
    assert to_ros2(one, other, raw) == LITTLE + struct.pack("<IIIIB", 7, 1, 2, 1, 0)


def test_times_and_durations_are_builtin_on_one_side_alone() -> None:
    one, other = "time t\nduration d\n", "builtin_interfaces/Time t\nbuiltin_interfaces/Duration d\n"
    raw = struct.pack("<IIii", 5, 6, -7, 8)
    assert to_ros2(one, other, raw) == LITTLE + raw
    assert to_ros1(other, one, LITTLE + raw) == raw


@pytest.mark.parametrize(("text", "raw"), [("time t\n", (1 << 31, 0)), ("duration t\n", (0, 0xFFFFFFFF))])
def test_a_ros_1_time_that_ros_2_has_no_form_for_is_refused(text: str, raw: tuple[int, int]) -> None:
    converter = MessageConverter(channel(text, 1), channel(text, 2))
    with pytest.raises(RemoteError) as refusal:
        converter.convert(struct.pack("<II", *raw))
    assert refusal.value.reason is DropReason.MALFORMED


def test_a_ros_2_time_before_1970_has_no_form_in_ros_1() -> None:
    with pytest.raises(RemoteError):
        to_ros1("builtin_interfaces/Time t\n", "time t\n", LITTLE + struct.pack("<iI", -1, 0))


def test_a_byte_keeps_its_bits() -> None:
    text = "byte a\nbyte[] b\nbyte[2] c\n"
    raw = b"\x80" + struct.pack("<I", 1) + b"\xff\xfe\xfd"
    there = to_ros2(text, text, raw)
    assert there == LITTLE + b"\x80\0\0\0" + raw[1:]
    assert to_ros1(text, text, there) == raw


def test_a_type_without_fields_has_a_byte_in_ros_2() -> None:
    assert to_ros2("", "", b"") == LITTLE + b"\0"
    assert to_ros1("", "", LITTLE + b"\x09") == b""


def test_names_of_types_and_case_of_fields_do_not_matter() -> None:
    one, other = f"In K\n{RULE}MSG: a/In\nint32 X\n", f"Other k\n{RULE}MSG: a/Other\nint32 x\n"
    assert to_ros2(one, other, struct.pack("<i", -3)) == LITTLE + struct.pack("<i", -3)


def test_big_endian_messages_are_read_too() -> None:
    assert to_ros1("int32[] a\n", "int32[] a\n", bytes(4) + struct.pack(">Ii", 1, -2)) == struct.pack("<Ii", 1, -2)


def test_every_kind_of_field_crosses_and_comes_back() -> None:
    ros1, ros2 = channel(MIXED, 1), channel(MIXED, 2)
    inner = struct.pack("<BdI", 9, 2.5, 2) + b"hi"
    raw = (
        struct.pack("<?bBbHqf", True, -1, 255, -2, 3, -4, 0.5)
        + struct.pack("<I", 3)
        + b"abc"
        + struct.pack("<3dI2d", 1, 2, 3, 2, 4, 5)
        + struct.pack("<I3s5sI2?", 3, b"xyz", b"\xff\xfe\xfd\xfc\xfb", 2, True, False)
        + struct.pack("<I1sI2s", 1, b"p", 2, b"qr")
        + inner
        + struct.pack("<I", 1)
        + inner * 3
        + struct.pack("<IBdBd", 2, 1, 1.5, 2, 2.5)
        + struct.pack("<I", 3)
    )
    there = MessageConverter(ros1, ros2).convert(raw)
    assert canonical(ros2, there) == there
    assert MessageConverter(ros2, ros1).convert(there) == raw


# --- bounds, and channels of one ROS


@pytest.mark.parametrize(
    ("loose", "tight", "raw"),
    [
        ("string a\n", "string<=3 a\n", struct.pack("<I", 4) + b"abcd"),
        ("string[] a\n", "string<=3[] a\n", struct.pack("<II", 1, 4) + b"abcd"),
        ("float64[] a\n", "float64[<=1] a\n", struct.pack("<I2d", 2, 1, 2)),
        (f"I[] a\n{RULE}MSG: a/I\nstring s\n", f"I[] a\n{RULE}MSG: a/I\nstring<=3 s\n", b"\1\0\0\0\4\0\0\0abcd"),
    ],
)
def test_what_is_beyond_a_bound_is_refused_and_what_is_within_is_not(loose: str, tight: str, raw: bytes) -> None:
    converter = MessageConverter(channel(loose, 1), channel(tight, 2))
    with pytest.raises(RemoteError, match="at most"):
        converter.convert(raw)
    assert converter.convert(bytes(4)).startswith(LITTLE)
    assert to_ros1(tight, loose, to_ros2(loose, loose, raw)) == raw


def test_channels_of_one_ros_and_of_equal_form_forward_the_same_bytes() -> None:
    for ros in (1, 2):
        one, other = channel("string<=2 a\n", ros), channel("string a\n", ros)
        raw = b"whatever"
        assert MessageConverter(one, other).convert(raw) is raw


def test_a_tighter_bound_is_looked_after_within_ros_2_too() -> None:
    converter = MessageConverter(channel("string a\n", 2), channel("string<=2 a\n", 2))
    with pytest.raises(RemoteError):
        converter.convert(LITTLE + struct.pack("<I", 4) + b"abc\0")


def test_an_equal_hash_stands_for_definitions_that_are_not_there() -> None:
    blind = Channel("/t", "a/msg/B", 2, hash="RIHS01_ab")
    assert MessageConverter(blind, blind).convert(b"x") == b"x"
    assert "no definition" in difference(blind, Channel("/t", "a/msg/B", 2, hash="RIHS01_cd"))
    assert "no definition" in difference(Channel("/t", "a/msg/B", 2), Channel("/t", "a/msg/B", 2))


# --- differences that matter


@pytest.mark.parametrize(
    ("there", "here", "said"),
    [
        ("float64 x\n", "float32 x\n", "x: float64 there, float32 here"),
        ("int32 x\n", "uint32 x\n", "x: int32 there, uint32 here"),
        ("string x\n", "wstring x\n", "x: string there, wstring here"),
        ("int32 x\n", "int32[] x\n", "x: int32 there, int32[] here"),
        ("int32[2] x\n", "int32[3] x\n", "x: int32[2] there, int32[3] here"),
        ("int32[2] x\n", "int32[] x\n", "x: int32[2] there, int32[] here"),
        ("int32 x\n", "int32 x\nint32 y\n", "y: nothing there, int32 here"),
        ("int32 x\nint32 y\n", "int32 x\n", "y: int32 there, nothing here"),
        ("int32 x\nint32 y\n", "int32 y\nint32 x\n", "y: called x there"),
        ("time x\n", "duration x\n", "x: builtin_interfaces/msg/Time there, builtin_interfaces/msg/Duration here"),
        ("time x\n", "int64 x\n", "x: builtin_interfaces/msg/Time there, int64 here"),
        (
            f"In[] p\n{RULE}MSG: a/In\nIn2 q\n{RULE}MSG: a/In2\nfloat64 x\n",
            f"In[] p\n{RULE}MSG: a/In\nIn2 q\n{RULE}MSG: a/In2\nfloat32 x\n",
            "p[].q.x: float64 there, float32 here",
        ),
    ],
)
def test_the_first_difference_is_named(there: str, here: str, said: str) -> None:
    assert difference(channel(there, 1), channel(here, 2)) == said


def test_a_sequence_number_missing_in_one_ros_is_a_difference() -> None:
    one, other = f"Header header\n{HEADER1}", f"Header header\n{HEADER2.replace('builtin_interfaces/Time', 'time')}"
    assert difference(channel(one, 1), channel(other, 1)) == "header.stamp: called seq there"


# --- how a channel looks in the other ROS


def test_a_standard_type_has_its_published_definition_and_hash_on_the_other_side() -> None:
    info = translated_channel(standard("sensor_msgs/msg/CameraInfo", 2), 1)
    assert info.hash == "c9a58c1b0b154e0e6da7578cb991d214"
    assert "float64[] D\n" in info.definition
    text = translated_channel(standard("std_msgs/msg/String", 1), 2)
    assert text.hash == "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


@pytest.mark.parametrize("name", ["Empty", "Char", "Byte", "Header", "Time", "Duration", "ByteMultiArray"])
def test_a_ros_1_type_there_and_back_is_itself(name: str) -> None:
    before = standard(f"std_msgs/msg/{name}", 1)
    assert translated_channel(translated_channel(before, 2), 1).hash == before.hash


def test_a_custom_type_is_rewritten_field_by_field() -> None:
    top = "uint8 LOW=1\nHeader header\nchar Letter\nduration[2] waits\nPart[] parts\n"
    text = f"{top}{HEADER1}{RULE}MSG: a/Part\nbyte b\n"
    converter = translated_channel(channel(text, 1), 2)
    top, *used = converter.definition.split(RULE)
    assert top.split("\n")[:-1] == [
        "uint8 LOW=1",
        "std_msgs/Header header",
        "uint8 letter",
        "builtin_interfaces/Duration[2] waits",
        "a/Part[] parts",
    ]
    assert {section.split("\n")[0] for section in used} == {
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
        "MSG: builtin_interfaces/Duration",
        "MSG: a/Part",
    }
    assert (converter.type_name, converter.ros, converter.definition_format) == ("a/msg/B", 2, "msg")
    back = translated_channel(converter, 1)
    assert "duration[2] waits" in back.definition
    assert "uint32 seq" in back.definition
    MessageConverter(channel(text, 1), back)


def test_bounds_and_the_dummy_of_an_empty_type_are_not_in_ros_1() -> None:
    text = f"string<=5[<=2] a\nint32[<=3] b\nNone c\n{RULE}MSG: a/None\n"
    definition = translated_channel(channel(text, 2), 1).definition
    assert definition == f"string[] a\nint32[] b\na/None c\n{RULE}MSG: a/None\n"


def test_idl_has_a_ros_1_form_too() -> None:
    text = "module a { module msg { struct B { sequence<octet> data; boolean flag; string<4> s; }; }; };\n"
    converter = translated_channel(channel(f"{RULE}IDL: a/msg/B\n{text}", 2, "idl"), 1)
    assert converter.definition == "byte[] data\nbool flag\nstring s\n"


def test_a_wide_string_has_no_form_in_ros_1() -> None:
    text = f"In[] list\n{RULE}MSG: a/In\nint32 x\nwstring<=4[] words\n"
    with pytest.raises(DefinitionError, match=r"^list\[\]\.words\[\]: wstring"):
        translated_channel(channel(text, 2), 1)


def test_fields_that_differ_in_case_alone_have_no_form_in_ros_2() -> None:
    with pytest.raises(DefinitionError, match="case"):
        translated_channel(channel("int32 k\nint32 K\n", 1), 2)


def test_a_channel_without_a_definition_has_no_translation() -> None:
    with pytest.raises(DefinitionError, match="no definition"):
        translated_channel(Channel("/t", "a/msg/B", 1), 2)


def test_latched_is_transient_local_in_ros_2() -> None:
    ros1 = Channel(
        "/t",
        "std_msgs/msg/String",
        1,
        hash="",
        definition="string data\n",
        definition_format="msg",
        latched=True,
        callerid="/talker",
    )
    ros2 = translated_channel(ros1, 2)
    assert [(qos.depth, qos.reliability, qos.durability) for qos in ros2.qos] == [(1, "reliable", "transient_local")]
    assert ros2.callerid is None
    back = translated_channel(
        Channel(
            "/t", "std_msgs/msg/String", 2, hash="", definition="string data\n", definition_format="msg", qos=(LASTING,)
        ),
        1,
    )
    assert back.latched
    assert back.qos == ()
    assert translated_channel(channel("", 1), 2).qos == ()


def test_in_its_own_ros_a_channel_needs_no_translation() -> None:
    about = channel("string data\n", 2)
    assert translated_channel(about, 2) is about


# --- arbitrary bytes

EITHER = (
    MessageConverter(channel(MIXED, 1), channel(MIXED, 2)),
    MessageConverter(channel(MIXED, 2), channel(MIXED, 1)),
)
STAMPED = (
    MessageConverter(channel(f"Header header\n{HEADER1}", 1), channel(f"Header header\n{HEADER2}", 2)),
    MessageConverter(channel(f"Header header\n{HEADER2}", 2), channel(f"Header header\n{HEADER1}", 1)),
)


def refusal(converter: MessageConverter, raw: bytes) -> DropReason | None:
    try:
        there = converter.convert(raw)
    except RemoteError as error:
        return error.reason
    assert canonical(converter.target, there) == there
    return None


@pytest.mark.parametrize("converter", [*EITHER, *STAMPED], ids=["mixed-1", "mixed-2", "stamped-1", "stamped-2"])
@given(raw=st.binary(max_size=200), prefix=st.sampled_from([b"", LITTLE, bytes(4)]))
def test_arbitrary_bytes_are_converted_or_refused(converter: MessageConverter, raw: bytes, prefix: bytes) -> None:
    assert refusal(converter, prefix + raw) in (None, DropReason.MALFORMED)


@given(at=st.integers(0, 300), value=st.integers(0, 255))
def test_an_altered_message_is_converted_or_refused(at: int, value: int) -> None:
    whole = bytearray(EITHER[0].convert(bytes(500)[: _empty_size()]))
    whole[at % len(whole)] = value
    assert refusal(EITHER[1], bytes(whole)) in (None, DropReason.MALFORMED)


def _empty_size() -> int:
    """Return the length of the message whose bytes are all zero."""
    return next(size for size in range(500) if refusal(EITHER[0], bytes(size)) is None)
