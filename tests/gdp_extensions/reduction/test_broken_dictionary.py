"""Dictionaries of remote publishers that are none."""

from __future__ import annotations

import pytest

from gdp.errors import RemoteError
from gdp_extensions.reduction.compression import BodyDecompressor
from proxy.serial.channel import Channel
from proxy.serial.serializer import Encoding
from proxy.wire.message import RosMessage, Step, TopicDescription
from tests.attacks.test_recorder import Recorder, channel, described, ros_message

BROKEN = bytes.fromhex("37a430ec") + b"\xff" * 200  # the magic number of a dictionary, and no dictionary


def broken(encoding: Encoding = "cdr", *channels: Channel) -> bytes:
    """Return a description with a dictionary that is none."""
    return TopicDescription(encoding, channels or (channel(),), is_compressed=True, dictionary=BROKEN).to_wire()


def test_y01_a_broken_dictionary_is_refused_with_its_description() -> None:
    with pytest.raises(RemoteError, match="zstd"):
        BodyDecompressor(100, BROKEN)


def test_y01_a_description_with_a_broken_dictionary_costs_its_publisher_only() -> None:
    recorder = Recorder()
    recorder.receive(broken(), *[RosMessage(0, 0, b"x" * 40, Step.ZSTD).to_wire()] * 5, ros_message())
    assert recorder.faults.counts["malformed"] == 1
    assert (recorder.lost, recorder.sink.written) == (6, [])
    recorder.receive(described(channel()), ros_message(), publisher=b"q" * 32)
    assert recorder.sink.written == [("/chatter", b"\0\1\0\0x")]
