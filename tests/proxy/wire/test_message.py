"""Envelopes of ROS messages and their description: they read back as written, and arbitrary bytes are refused."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gdp.crypto.cbor import Value, encode
from gdp.errors import DropReason, LocalError, RemoteError
from proxy.serial.channel import Channel
from proxy.wire.message import CHANNELS_MAX, RosMessage, Step, TopicDescription

CHANNEL = Channel(topic="/chatter", type_name="std_msgs/msg/String", ros=2)


@given(
    st.integers(0, CHANNELS_MAX - 1),
    st.integers(0, (1 << 64) - 1),
    st.binary(max_size=200),
    st.sampled_from((Step(0), Step.IMAGE, Step.ZSTD, Step.IMAGE | Step.ZSTD)),
)
def test_a_ros_message_comes_back_as_it_was(channel: int, stamp_ns: int, body: bytes, steps: Step) -> None:
    ros_message = RosMessage(channel, stamp_ns, body, steps)
    assert RosMessage.from_wire(ros_message.to_wire()) == ros_message


@given(st.binary(max_size=40))
def test_arbitrary_bytes_are_a_ros_message_or_a_remote_error(wire: bytes) -> None:
    try:
        ros_message = RosMessage.from_wire(wire)
    except RemoteError:
        return
    assert ros_message.to_wire() == wire


def test_a_ros_message_of_another_version_says_so() -> None:
    with pytest.raises(RemoteError) as caught:
        RosMessage.from_wire(b"\x02" + bytes(10))
    assert caught.value.reason is DropReason.BAD_VERSION


def test_a_step_that_is_unknown_here_is_refused_as_of_another_version() -> None:
    with pytest.raises(RemoteError) as caught:
        RosMessage.from_wire(b"\x01\x80" + bytes(9))
    assert caught.value.reason is DropReason.BAD_VERSION


@pytest.mark.parametrize(
    "reductions", [{}, {"is_compressed": True}, {"is_compressed": True, "dictionary": b"d" * 90}, {"image": "png"}]
)
def test_a_description_comes_back_as_it_was(reductions: dict[str, Any]) -> None:
    description = TopicDescription("cbor", (CHANNEL,) * 3, **reductions)
    assert TopicDescription.from_cbor(description.to_wire()) == description


def test_more_channels_than_allowed_are_refused_at_home() -> None:
    with pytest.raises(LocalError):
        TopicDescription("json", (CHANNEL,) * (CHANNELS_MAX + 1)).to_wire()


@pytest.mark.parametrize(
    "field", [{"z": "lz77"}, {"z": 1}, {"i": "gif"}, {"i": b"jpeg"}, {"d": "text"}, {"d": bytes(33 << 10)}]
)
def test_a_reduction_that_is_unknown_here_is_refused(field: dict[str, Value]) -> None:
    fields: dict[str, Value] = {"e": "cdr", "c": [CHANNEL.to_wire()], **field}
    with pytest.raises(RemoteError):
        TopicDescription.from_cbor(encode(fields))


@given(st.binary(max_size=100))
@example(b"\xa0")
@example(b"\xa2\x61c\x80\x61e\x64json")  # no channel
@example(b"\xa2\x61c\x81\x01\x61e\x64json")  # a channel that is a number
@example(b"\xa2\x61c\x81\x41\xa0\x61e\x64yaml")
@example(b"\xd8\x1e\x82\x01\x00")  # a fraction with nothing below the line
@example(b"\xc4\x82\x1b\x7f\xff\xff\xff\xff\xff\xff\xff\x01")  # a decimal of absurd size
@example(b"\x81" * 5_000)
def test_arbitrary_bytes_are_no_description(wire: bytes) -> None:
    with pytest.raises(RemoteError) as caught:
        TopicDescription.from_cbor(wire)
    assert caught.value.reason is DropReason.MALFORMED
