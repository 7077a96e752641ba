"""Channel descriptions and their wire form."""

from __future__ import annotations

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import DropReason, LocalError, RemoteError
from proxy.serial.channel import Channel, Qos

QOS = Qos(depth=10, reliability="reliable", durability="transient_local")


def test_a_description_comes_back_as_it_was() -> None:
    ros2 = Channel(
        "/a",
        "std_msgs/msg/String",
        2,
        hash="RIHS01_ab",
        definition="string data\n",
        definition_format="msg",
        qos=(QOS, QOS),
        latched=True,
    )
    ros1 = Channel(
        "/b",
        "std_msgs/msg/String",
        1,
        hash="992c",
        definition="string data\n",
        definition_format="msg",
        callerid="/talker",
    )
    for channel in (ros1, ros2):
        assert Channel.from_cbor(channel.to_wire()) == channel


def test_an_unknown_caller_is_not_an_empty_one() -> None:
    for callerid in (None, ""):
        channel = Channel("/b", "std_msgs/msg/String", 1, callerid=callerid)
        assert Channel.from_cbor(channel.to_wire()).callerid == callerid


def test_a_definition_too_long_for_a_reader_is_the_callers_fault() -> None:
    with pytest.raises(LocalError, match="/big"):
        Channel("/big", "a/msg/B", 2, definition="x" * 2_000_000, definition_format="msg").to_wire()


@pytest.mark.parametrize(
    "change",
    [
        {"t": 1},
        {"r": 3},
        {"r": True},
        {"f": "xml"},
        {"l": 1},
        {"q": [1]},
        {"q": [[]] * 65},
        {"c": 5},
        {"h": "x" * 1025},
    ],
)
def test_a_wrong_field_is_refused(change: dict[str, object]) -> None:
    fields = {"t": "/a", "n": "a/msg/B", "r": 2, "h": "", "d": "", "f": "", "l": False}
    with pytest.raises(RemoteError) as refusal:
        Channel.from_cbor(cbor2.dumps(fields | change))
    assert refusal.value.reason is DropReason.MALFORMED


def refusal(wire: bytes) -> DropReason | None:
    try:
        Channel.from_cbor(wire)
    except RemoteError as error:
        return error.reason
    return None


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_a_description_or_refused(wire: bytes) -> None:
    assert refusal(wire) in (None, DropReason.MALFORMED)


@given(st.integers(0, 400), st.integers(0, 255))
def test_an_altered_description_is_one_or_refused(at: int, value: int) -> None:
    wire = bytearray(
        Channel(
            "/a",
            "std_msgs/msg/String",
            2,
            hash="RIHS01",
            definition="string data\n",
            definition_format="msg",
            qos=(QOS,),
        ).to_wire()
    )
    wire[at % len(wire)] = value
    assert refusal(bytes(wire)) in (None, DropReason.MALFORMED)


def test_nesting_a_thousand_deep_is_refused() -> None:
    with pytest.raises(RemoteError):
        Channel.from_cbor(b"\x81" * 100_000)
