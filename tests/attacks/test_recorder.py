"""Attacks of a publisher on a recording proxy, and on one with a live graph."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gdp.client.delivery import Delivered
from gdp.client.participant import Message, Participant, Topic
from gdp.message.loss import Losses
from gdp.names import Name
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.counters import Traffic
from proxy.bridge.decoder_cache import DecoderCache
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault, Faults
from proxy.bridge.imported_topic import ImportedTopic
from proxy.config.config import Rule
from proxy.endpoints.core.endpoint import Origin
from proxy.recordings.endpoint import RecordingEndpoint
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel, Qos, RosVersion
from proxy.wire.message import CHANNELS_MAX, RosMessage, TopicDescription

TOPIC = Name(b"t" * 32)
RULE = Rule.model_construct(name="/chatter", max_bytes=1 << 20)


class Sink:
    """Recording in memory."""

    path = Path("memory.mcap")
    ros: RosVersion = 2

    def __init__(self) -> None:
        self.channels: list[Channel] = []
        self.written: list[tuple[str, bytes]] = []

    def add(self, channel: Channel) -> int:
        if channel not in self.channels:
            self.channels.append(channel)
        return self.channels.index(channel)

    def write(self, handle: int, stamp_ns: int, raw: bytes, origin: Origin | None = None) -> None:
        self.written.append((self.channels[handle].topic, raw))


class Recorder:
    """Path from a member to a recording, about one topic: /chatter."""

    def __init__(self) -> None:
        self.sink = Sink()
        self.faults = Faults()
        member = SimpleNamespace(losses_of=lambda _: Losses(), diagnostics=SimpleNamespace(clock_of=lambda *_: None))
        self.endpoint = RecordingEndpoint(cast(BagWriter, self.sink), [("/chatter", "a/msg/B")])
        context = BridgeContext(cast(Participant, member), Traffic(), self.faults)
        flow_spec = FlowSpec(False, "/chatter", "a/msg/B", TOPIC, RULE)
        self.flow = ImportedTopic(
            context, EndpointDispatcher(self.endpoint), flow_spec, cast(Topic, SimpleNamespace(name=TOPIC))
        )

    @property
    def lost(self) -> int:
        return self.flow.stats.lost

    def receive(self, description: bytes, *wires: bytes, publisher: bytes = b"p" * 32) -> None:
        for number, wire in enumerate(wires):
            self.flow.receive(_message(description, Delivered(publisher, 1, number, wire, 1, 1)), 0.0)


def _message(description: bytes, delivered: Delivered) -> Message:
    fields: dict[str, Any] = {"topic": TOPIC, "description": description, "delivered": delivered}
    return Message(**fields)


def described(*channels: Channel) -> bytes:
    return TopicDescription("cdr", channels).to_wire()


def channel(topic: str = "/chatter", definition: str = "int8 a\n", depth: int = 1) -> Channel:
    qos = Qos(depth=depth, reliability="reliable", durability="volatile")
    return Channel(topic, "a/msg/B", 2, definition=definition, definition_format="msg", qos=(qos,))


def ros_message(number: int = 0, body: bytes = b"\0\1\0\0x") -> bytes:
    return RosMessage(number, 0, body).to_wire()


def test_a25_a_recording_has_the_topic_of_the_rule_whatever_its_publisher_says() -> None:
    recorder = Recorder()
    recorder.receive(described(channel("/emergency_stop")), ros_message())
    assert recorder.sink.written == [("/chatter", b"\0\1\0\0x")]
    assert [each.topic for each in recorder.sink.channels] == ["/chatter"]


def test_a26_a_recorder_keeps_a_bounded_part_of_changing_descriptions() -> None:
    recorder = Recorder()
    for number in range(100):
        recorder.receive(described(channel(definition=f"int8 a{number}\n" + "#\n" * 30_000)), ros_message())
    sources = recorder.flow._sources
    assert len(sources) <= 8
    assert sources.held_bytes <= 1 << 20


def test_a26_a_publisher_has_a_bounded_number_of_channels_in_a_recording() -> None:
    recorder = Recorder()
    for depth in range(CHANNELS_MAX + 20):
        recorder.receive(described(channel(depth=depth)), ros_message())
    assert len(recorder.sink.channels) == CHANNELS_MAX
    recorder.receive(described(channel(depth=1_000)), ros_message(), publisher=b"q" * 32)
    assert len(recorder.sink.channels) == CHANNELS_MAX + 1


def test_a26_a_description_that_comes_again_after_it_was_forgotten_has_its_old_channel() -> None:
    recorder = Recorder()
    for round_ in range(2):
        for depth in range(20):
            recorder.receive(described(channel(depth=depth)), ros_message())
        assert len(recorder.sink.channels) == 20, round_
    assert len(recorder.sink.written) == 40


def test_a26_descriptions_are_bounded_by_their_bytes_and_the_least_used_goes() -> None:
    sources = DecoderCache[int](count_max=100, bytes_max=100_000, each_max=4)
    for number in range(200):
        sources.put(bytes([number]), bytes(20_000), number)
        assert sources.held_bytes <= 100_000
    assert sources.get(bytes([199]), bytes(20_000)) == 199
    for number in range(10):
        sources.put(b"one", bytes([number]), number)
    assert (bytes([199]), bytes(20_000)) in sources
    assert len([number for number in range(10) if (b"one", bytes([number])) in sources]) == 4


def test_a26_what_was_refused_costs_once_while_it_is_kept() -> None:
    recorder = Recorder()
    recorder.receive(b"\xff" * 100, *[ros_message()] * 50)
    assert recorder.faults.counts["malformed"] == 1
    assert recorder.lost == 50


def test_a54_a_far_publisher_writes_neither_lines_nor_escapes_into_the_log(caplog: pytest.LogCaptureFixture) -> None:
    recorder = Recorder()
    evil = Channel("/chatter", "x\nERROR all is lost\x1b[2J", 2)
    with caplog.at_level(logging.DEBUG):
        recorder.receive(described(evil), ros_message())
    text = "".join(record.getMessage() for record in caplog.records)
    assert "all is lost" in text
    assert text.isprintable()


def test_a54_many_messages_that_cannot_be_taken_are_logged_in_a_few_lines(caplog: pytest.LogCaptureFixture) -> None:
    recorder = Recorder()
    with caplog.at_level(logging.DEBUG):
        recorder.receive(described(channel()), *[b""] * 16_000)
    assert len(caplog.records) <= 3
    assert sum(len(record.getMessage()) for record in caplog.records) < 1_000
    assert "10000 times" in caplog.messages[-1]
    assert recorder.faults.counts["malformed"] == 16_000
    assert recorder.lost == 16_000


def test_a54_a_fault_tells_far_words_as_one_short_line(caplog: pytest.LogCaptureFixture) -> None:
    Faults().report("/t", Fault.OTHER_TYPE, "the far side sends \r\n\x1b]0;owned\x07\u202e" + "x" * 100_000)
    assert caplog.messages[0].isprintable()
    assert len(caplog.messages[0]) < 400
