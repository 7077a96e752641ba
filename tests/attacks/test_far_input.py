"""Attacks by descriptions, messages and responses: each costs its sender only, and never the proxy or another topic."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import cbor2
import pytest

from gdp.control.boundary import ErrorBoundary
from proxy.bridge.core.decoder import MessageDecoder
from proxy.bridge.core.reduction import MessageExpander
from proxy.bridge.virtual_server import VirtualServer
from proxy.serial.channel import Channel, RosVersion
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.empty import NoAnswer
from proxy.serial.rosbridge_json import RosbridgeCodec
from proxy.serial.schema import DefinitionError
from proxy.serial.serializer import Encoding, Serializer, canonical
from proxy.wire.message import RosMessage, Step, TopicDescription
from tests.attacks.test_recorder import Recorder, channel, described, ros_message
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites

RULE = "=" * 80 + "\n"
CHATTER, OTHER = f"name: /chatter, type: {STRING}", f"name: /other, type: {STRING}"
SWITCH, LAMP = (f"kind: service, name: {name}, type: {SET_BOOL}" for name in ("/switch", "/lamp"))
NO_ITEMS = [
    f"{base}{size} a\n{after}"
    for base in ("bool", "byte", "uint8", "int8", "int64", "float32", "float64", "string", "Inner", "Nothing")
    for size in ("[0]", "[<=0]")
    for after in ("", "int8 b\n", f"{base}[2] b\nfloat64 c\n")
]
NESTED = [f"Empty{size} a\nint8 b\n" for size in ("", "[2]", "[]", "[0]")]
ROS: tuple[RosVersion, ...] = (1, 2)
ENCODINGS: tuple[Encoding, ...] = ("json", "cbor", "cdr")


@pytest.fixture
def contained() -> Iterator[None]:
    ErrorBoundary.reraises = False
    yield
    ErrorBoundary.reraises = True


def defined(definition: str, ros: RosVersion) -> Channel:
    inner = f"{RULE}MSG: a/Inner\nint8 a\n{RULE}MSG: a/Nothing\n{RULE}MSG: a/Empty\nfloat64[0] a\n"
    return Channel("/chatter", "a/msg/B", ros, definition=definition + inner, definition_format="msg")


def fitting(codec: Serializer, ros: RosVersion) -> bytes:
    """Return the shortest message of zeros that fits a definition."""
    head = b"" if ros == 1 else b"\0\1\0\0"
    return next(head + bytes(size) for size in range(64) if b"$raw" not in codec.encode(head + bytes(size)))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("ros", ROS)
@pytest.mark.parametrize("definition", NO_ITEMS + NESTED)
def test_y02_an_array_of_no_items_is_read_and_written(definition: str, ros: RosVersion, encoding: Encoding) -> None:
    source = defined(definition, ros)
    codec, native = Serializer(source, encoding), Serializer(source, "json")
    assert codec.opaque == ""
    raw = fitting(native, ros)
    assert canonical(source, codec.decode(codec.encode(raw))) == canonical(source, raw)
    if encoding == "json" and "[0] a" in definition:
        assert json.loads(codec.encode(raw))["a"] in ([], "")


@pytest.mark.parametrize("definition", NO_ITEMS + NESTED)
def test_y02_an_array_of_no_items_is_read_by_recorder_and_door(definition: str) -> None:
    source = defined(definition, 2)
    raw = fitting(Serializer(source, "json"), 2)
    assert isinstance(json.loads(RosbridgeCodec(source).to_json(raw)), dict)
    recorder = Recorder()
    body = Serializer(source, "cbor").encode(raw)
    recorder.receive(TopicDescription("cbor", (source,)).to_wire(), ros_message(body=body))
    assert recorder.sink.written == [("/chatter", canonical(source, raw))]


@pytest.mark.parametrize("definition", NO_ITEMS + NESTED)
def test_y02_an_array_of_no_items_has_a_form_in_the_other_ros_or_is_refused(definition: str) -> None:
    source = defined(definition, 1)
    try:
        target = translated_channel(source, 2)
        there, back = MessageConverter(source, target), MessageConverter(target, source)
    except DefinitionError:
        assert "[0]" in source.definition  # ROS 2 has no fixed array of no items
        return
    raw = fitting(Serializer(source, "json"), 1)
    assert back.convert(there.convert(raw)) == raw


@pytest.mark.parametrize("definition", NO_ITEMS + NESTED)
def test_y02_a_service_whose_response_has_an_array_of_no_items_has_an_empty_response(definition: str) -> None:
    response = defined(definition, 2)
    empty = NoAnswer(response).to_raw("no answer")
    assert canonical(response, empty) == empty
    assert b"$raw" not in Serializer(response, "json").encode(empty)


def test_y03_whatever_step_a_message_states_an_error_of_the_tree_comes_out() -> None:
    steps = [Step(0), Step.ZSTD, Step.IMAGE, Step.ZSTD | Step.IMAGE]
    recorder = Recorder()
    for encoding, stated, definition in itertools.product(ENCODINGS, steps, NO_ITEMS[::7]):
        description = TopicDescription(
            encoding,
            (defined(definition, 2),),
            is_compressed=bool(stated & Step.ZSTD),
            image="png" if stated & Step.IMAGE else None,
        ).to_wire()
        recorder.receive(description, *(RosMessage(0, 0, b"{}", each).to_wire() for each in steps))
    assert recorder.faults.counts["internal"] == 0
    assert recorder.faults.counts["malformed"] > 0


def test_y10_a_type_with_two_fields_of_one_name_has_no_form_and_its_messages_lose_nothing() -> None:
    source = defined("Inner a\nint8 a\n", 2)
    assert "two fields of one name" in Serializer(source, "json").opaque
    assert Serializer(source, "json").decode(Serializer(source, "json").encode(b"\0\1\0\0xy")) == b"\0\1\0\0xy"
    with pytest.raises(DefinitionError):
        NoAnswer(source)


@pytest.mark.parametrize("key", ["e", "c", "z", "d", "i"])
def test_y09_a_description_of_any_values_is_read_or_refused(key: str) -> None:
    fields = cbor2.loads(described(channel()))
    recorder = Recorder()
    values: tuple[object, ...] = (None, True, -1, 1 << 64, 1.5, "", b"", [], {}, [[]], [{}], {"": {}})
    for value in values:
        recorder.receive(cbor2.dumps(fields | {key: value}, canonical=True), ros_message())
    assert recorder.faults.counts["internal"] == 0
    recorder.receive(described(channel()), ros_message())
    assert recorder.sink.written[-1] == ("/chatter", b"\0\1\0\0x")


@pytest.mark.usefixtures("contained")
def test_y04_an_error_of_ours_is_counted_and_logged_once_and_its_publisher_quarantined(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    recorder = Recorder()
    with monkeypatch.context() as patch:
        patch.setattr(MessageExpander, "expand", _fault)
        recorder.receive(described(channel()), *[ros_message()] * 5)
    recorder.receive(described(channel()), ros_message())
    recorder.receive(described(channel()), ros_message(), publisher=b"q" * 32)
    assert (recorder.faults.counts["internal"], recorder.faults.counts["quarantined"]) == (3, 3)
    assert recorder.lost == 6
    assert len(recorder.sink.written) == 1
    assert len([text for text in caplog.messages if "a fault of ours" in text]) == 1


def _fault(*_: object, **__: object) -> None:
    raise ZeroDivisionError("a fault of ours")


def _chatting(sites: Sites) -> tuple[Machine, Machine, Ear, Ear]:
    """Return a publisher of two topics, the machine that imports both, and a listener of each there."""
    robot, server = sites.add(ROBOT, expose=[CHATTER, OTHER]), sites.add(SERVER, imports=[CHATTER, OTHER])
    ears = Ear(server.graph, "/chatter"), Ear(server.graph, "/other")
    for topic in ("/chatter", "/other"):
        robot.graph.publish("/talker", topic, STRING)
    assert sites.run(3, robot.is_read)
    return robot, server, *ears


def _say(sites: Sites, robot: Machine, topic: str, text: str) -> None:
    (talker,) = (each for each in robot.graph.publications if each.end.name == topic)
    talker.publish(string(text))
    sites.run(0.5)


@pytest.mark.usefixtures("contained")
def test_y05_a_topic_goes_on_while_another_of_the_same_publisher_draws_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sites = Sites(tmp_path)
    robot, server, chatter, other = _chatting(sites)
    decode = MessageDecoder.decode
    with monkeypatch.context() as patch:
        patch.setattr(
            MessageDecoder,
            "decode",
            lambda self, body, restore=None: _fault() if b"bad" in body else decode(self, body, restore),
        )
        for number in range(5):
            _say(sites, robot, "/chatter", f"bad {number}")
            _say(sites, robot, "/other", f"good {number}")
    assert chatter.texts == []
    assert other.texts == [f"good {number}" for number in range(5)]
    assert server.faults == {"internal": 3, "quarantined": 2}
    sites.run(11)
    _say(sites, robot, "/chatter", "again")
    assert chatter.texts == ["again"]


@pytest.mark.usefixtures("contained")
@pytest.mark.parametrize(
    ("place", "is_client"),
    [
        ("proxy.bridge.exposed_service.Request.from_wire", False),
        ("proxy.bridge.remote_clients.RemoteClients.incoming", False),
        ("proxy.bridge.imported_service.Answer.from_wire", True),
        ("proxy.bridge.server_discovery.RemoteServer.set_description", True),
        ("proxy.bridge.imported_service.NoAnswer.of", True),
    ],
)
def test_y06_a_service_goes_on_while_another_draws_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, is_client: bool
) -> None:
    sites = Sites(tmp_path)
    server, client = sites.add(SERVER, expose=[SWITCH, LAMP]), sites.add(ROBOT, imports=[SWITCH, LAMP])
    LocalServer(server.graph, name="/lamp", answer=lambda _: switched("lamp"))
    lamp = Client(client.graph, name="/lamp")
    assert sites.run(3, lamp.sees_server)
    with monkeypatch.context() as patch:
        patch.setattr(place, _fault)
        LocalServer(server.graph, answer=lambda _: switched("yes"))
        caller = Client(client.graph)
        sites.run(3, caller.sees_server)
        caller.call(switch(on=True))
        sites.run(2)
    assert (client if is_client else server).faults["internal"] >= 1
    lamp.call(switch(on=True))
    assert sites.run(2, lambda: lamp.outcomes == [switched("lamp")])


@pytest.mark.usefixtures("contained")
def test_y06_a_request_that_the_local_server_cannot_be_given_is_answered_with_a_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sites = Sites(tmp_path)
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: switched("yes"))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    with monkeypatch.context() as patch:
        patch.setattr(server.endpoint, "call", _fault)
        caller.call(switch(on=True))
        assert sites.run(2, lambda: len(caller.outcomes) == 1)
    assert isinstance(caller.outcomes[0], str)
    caller.call(switch(on=True))
    assert sites.run(2, lambda: caller.outcomes[1:] == [switched("yes")])


@pytest.mark.usefixtures("contained")
def test_y06_a_response_that_local_clients_cannot_be_given_does_not_end_the_proxy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sites = Sites(tmp_path)
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: switched("yes"))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    with monkeypatch.context() as patch:
        patch.setattr(VirtualServer, "flush", _fault)
        caller.call(switch(on=True))
        sites.run(1)
    assert client.faults["internal"] >= 1
    sites.run(15)
    caller.call(switch(on=True))
    assert sites.run(2, lambda: switched("yes") in caller.outcomes)


@pytest.mark.usefixtures("contained")
def test_y07_an_error_about_a_local_message_ends_that_message_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sites = Sites(tmp_path)
    robot, _, chatter, other = _chatting(sites)
    sites.run(1)  # until both topics are described
    with monkeypatch.context() as patch:
        patch.setattr("proxy.bridge.exposed_topic.ExposedTopic.handle_event", _fault)
        _say(sites, robot, "/chatter", "lost")
    _say(sites, robot, "/chatter", "heard")
    _say(sites, robot, "/other", "heard too")
    assert (chatter.texts, other.texts) == (["heard"], ["heard too"])
    assert robot.faults == {"internal": 1}
