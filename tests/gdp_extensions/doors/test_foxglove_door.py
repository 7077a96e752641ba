"""Foxglove door between a bridge on the simulated ring and real WebSocket clients on loopback."""

from __future__ import annotations

import json
import socket
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest

pytest.importorskip("websockets")

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from gdp.errors import LocalError
from gdp_extensions.doors.core.foxglove_protocol import SUBPROTOCOLS
from gdp_extensions.doors.core.foxglove_session import FoxgloveSession
from gdp_extensions.doors.endpoint import DoorEndpoint, DoorSettings
from lab.process import until
from proxy.bridge.bridge import Bridge
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.delegated_rules import DelegatedRules, rules_of
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Faults
from proxy.endpoints.core.endpoint import Event, MessageReceived, RequestReceived, Role, TypeResolved
from proxy.endpoints.core.qos import default
from proxy.serial.standard_types import known_channel
from tests.gdp_extensions.doors.rights import Everything
from tests.proxy.bridge import known
from tests.proxy.bridge import test_actions as actions
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites
from tests.proxy.endpoints.fake import FakeEndpoint, FakeGraph

PATIENCE_S = 20.0


def door_of(rights: DelegatedRules | None = None, **bounds: int) -> DoorEndpoint:
    settings = DoorSettings(
        label="foxglove",
        listen="127.0.0.1:" + str(free_port()),
        origins=("https://app.example",),
        subprotocols=SUBPROTOCOLS,
        token="",
        tls=None,
        **bounds,
    )
    return DoorEndpoint(
        settings, lambda hub, number, queue: FoxgloveSession(hub, number, "test", queue), lambda: rights or Everything()
    )


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


@pytest.fixture
def door() -> Iterator[DoorEndpoint]:
    door = door_of()
    yield door
    door.shut_down()


@contextmanager
def client(door: DoorEndpoint, origin: str | None = None) -> Iterator[ClientConnection]:
    """Connect to a door; its first message says what it can do."""
    host, port = door.address
    address = f"ws://{host}:{port}"
    with connect(
        address,
        subprotocols=[Subprotocol(SUBPROTOCOLS[0])],
        origin=None if origin is None else Origin(origin),
        max_size=None,
    ) as found:
        assert heard(found)["op"] == "serverInfo"
        yield found


def heard(client: ClientConnection) -> dict[str, object]:
    """Return the next text message."""
    message = client.recv(PATIENCE_S)
    assert isinstance(message, str), message
    fields = json.loads(message)
    assert isinstance(fields, dict)
    return fields


def advertised(client: ClientConnection) -> int:
    """Return the number of the one channel in the next message."""
    fields = heard(client)
    assert fields["op"] == "advertise"
    channels = fields["channels"]
    assert isinstance(channels, list)
    assert len(channels) == 1
    return int(channels[0]["id"])


def subscribe(client: ClientConnection, number: int, channel: int) -> None:
    client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": number, "channelId": channel}]}))


def message(client: ClientConnection) -> tuple[int, bytes]:
    """Return subscription and content of the next message, which is binary."""
    data = client.recv(PATIENCE_S)
    assert isinstance(data, bytes), data
    opcode, number, _ = struct.unpack_from("<BIQ", data)
    assert opcode == 1
    return number, data[13:]


def taken(door: DoorEndpoint, events: list[Event]) -> list[Event]:
    """Return the events until now, with those that are new."""
    events += door.poll_events()
    return events


def readers(door: DoorEndpoint) -> set[tuple[Role, str]]:
    return {(each.role, each.name) for each in door.graph()}


def test_a_client_gets_what_it_subscribes_to(door: DoorEndpoint) -> None:
    handle = door.advertise(known_channel("/chat", known.STRING))
    with client(door) as foxglove:
        subscribe(foxglove, 5, advertised(foxglove))
        until(lambda: (Role.SUBSCRIBES, "/chat") in readers(door))
        door.publish(handle, known.string("hello"))
        assert message(foxglove) == (5, known.string("hello"))
        foxglove.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [5]}))
        until(lambda: not readers(door))
    until(lambda: door.clients == 0)


def test_a_replaced_publisher_keeps_its_channel_and_subscriptions(door: DoorEndpoint) -> None:
    handle = door.advertise(known_channel("/chat", known.STRING))
    with client(door) as foxglove:
        subscribe(foxglove, 5, advertised(foxglove))
        until(lambda: bool(readers(door)))
        door.close(handle)
        again = door.advertise(known_channel("/chat", known.STRING))
        door.publish(again, known.string("hello"))
        assert message(foxglove) == (5, known.string("hello"))
        door.close(again)
        assert heard(foxglove)["op"] == "unadvertise"
        until(lambda: not readers(door))


def test_a_late_client_gets_the_last_message_of_a_latched_topic(door: DoorEndpoint) -> None:
    channel = replace(known_channel("/map", known.STRING), qos=(default(latched=True, depth=1),), latched=True)
    handle = door.advertise(channel)
    for text in ("old", "new"):
        door.publish(handle, known.string(text))
    with client(door) as foxglove:
        subscribe(foxglove, 1, advertised(foxglove))
        assert message(foxglove) == (1, known.string("new"))


def test_a_client_publishes_what_the_bridge_takes(door: DoorEndpoint) -> None:
    with client(door) as foxglove:
        channels = [{"id": 3, "topic": "/say", "encoding": "cdr", "schemaName": known.STRING}]
        foxglove.send(json.dumps({"op": "advertise", "channels": channels}))
        until(lambda: (Role.PUBLISHES, "/say") in readers(door))
        handle = door.subscribe("/say", known.STRING, None)
        events = list[Event]()
        until(lambda: any(isinstance(each, TypeResolved) for each in taken(door, events)))
        foxglove.send(struct.pack("<BI", 1, 3) + known.string("hi"))
        until(lambda: any(isinstance(each, MessageReceived) for each in taken(door, events)))
        (got,) = (event for event in events if isinstance(event, MessageReceived))
        assert (got.handle, got.raw) == (handle, known.string("hi"))


def test_a_client_without_the_right_hears_the_command() -> None:
    door = door_of(rules_of([]))
    try:
        with client(door) as foxglove:
            channels = [{"id": 3, "topic": "/say", "encoding": "cdr", "schemaName": known.STRING}]
            foxglove.send(json.dumps({"op": "advertise", "channels": channels}))
            said = heard(foxglove)
            assert said["op"] == "status"
            assert "'gdp delegate name --right publish --kind topic --name /say" in str(said["message"])
            assert not readers(door)
    finally:
        door.shut_down()


def test_a_service_is_called_and_a_refusal_has_its_reason(door: DoorEndpoint) -> None:
    handle = door.serve(known.services()[known.SET_BOOL])
    with client(door) as foxglove:
        assert heard(foxglove)["op"] == "advertiseServices"
        for call in (1, 2):
            foxglove.send(struct.pack("<BIII", 2, handle, call, 3) + b"cdr" + known.switch(on=True))
        events = list[Event]()
        until(lambda: len([each for each in taken(door, events) if isinstance(each, RequestReceived)]) == 2)
        asked = [each for each in events if isinstance(each, RequestReceived)]
        assert asked[0].raw == known.switch(on=True)
        door.answer(handle, asked[0].ticket, known.switched("yes"))
        response = foxglove.recv(PATIENCE_S)
        assert response == struct.pack("<BIII", 3, handle, 1, 3) + b"cdr" + known.switched("yes")
        door.refuse(handle, asked[1].ticket, "no server")
        assert heard(foxglove) == {
            "op": "serviceCallFailure",
            "serviceId": handle,
            "callId": 2,
            "message": "no server",
        }
        foxglove.send(struct.pack("<BIII", 2, 99, 4, 3) + b"cdr")
        assert "no service 99" in str(heard(foxglove)["message"])


def test_a_client_that_does_not_read_costs_the_others_nothing() -> None:
    """Publish 60 MB: the one client gets all of it in order, and the other's queue drops whole messages."""
    door = door_of(queue_max_bytes=1 << 20)
    handle = door.advertise(known_channel("/chat", known.STRING))
    try:
        with client(door) as fast, client(door) as slow:
            for each in (fast, slow):
                subscribe(each, 1, advertised(each))
            until(lambda: len(door.graph()) == 2)
            for number in range(300):
                door.publish(handle, struct.pack("<I", number) * 50_000)
                _, raw = message(fast)
                assert struct.unpack_from("<I", raw) == (number,)
            assert door.dropped > 100
            numbers, statuses = list[int](), list[str]()
            while not numbers or numbers[-1] < 299:
                data = slow.recv(PATIENCE_S)
                if isinstance(data, str):
                    statuses.append(data)
                else:
                    assert len(data) == 13 + 200_000  # whole
                    numbers.append(*struct.unpack_from("<I", data, 13))
            assert numbers == sorted(set(numbers))
            assert len(numbers) == 300 - door.dropped
            assert any("reads too slowly" in each for each in statuses)
    finally:
        door.shut_down()


def test_a_page_of_another_origin_is_refused(door: DoorEndpoint) -> None:
    with client(door, origin="https://app.example"):
        assert door.clients == 1
    with pytest.raises(InvalidStatus) as caught, client(door, origin="https://evil.example"):
        pass
    assert caught.value.response.status_code == 403


def test_a_client_without_the_subprotocol_is_refused(door: DoorEndpoint) -> None:
    with pytest.raises(InvalidStatus), connect("ws://{}:{}".format(*door.address)):
        pass


def test_an_address_in_use_is_an_error_that_says_what_to_do(door: DoorEndpoint) -> None:
    host, port = door.address
    with pytest.raises(LocalError, match="choose another address with --listen"):
        DoorEndpoint(
            DoorSettings(label="foxglove", listen=f"{host}:{port}"),
            lambda hub, number, queue: FoxgloveSession(hub, number, "test", queue),
            Everything,
        )


def test_too_many_clients_are_refused() -> None:
    door = door_of(clients_max=1)
    try:
        with client(door):
            with pytest.raises(ConnectionClosed) as caught, client(door):
                pass
            assert "has 1 clients already" in str(caught.value)
    finally:
        door.shut_down()


def with_door(sites: Sites, *, expose: Sequence[str], imports: Sequence[str]) -> Machine:
    """Add a machine whose graph is a door."""
    sites.world.add_member(SERVER, SERVER.partition("/")[0])
    assert sites.world.run_until_attached()
    member, config = sites.world.members[SERVER], sites.config(expose, imports)
    site, door = BridgeContext(member, Traffic(), Faults()), door_of()
    bridge = Bridge(site, config, [door], sites.held(member, config))
    machine = Machine(SERVER, member, FakeGraph(2, {}), cast("list[FakeEndpoint]", [door]), site, bridge)
    sites.machines.append(machine)
    return machine


def received(sites: Sites, client: ClientConnection) -> str | bytes:
    """Return the next message of a client, while virtual time passes."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            return client.recv(0.01)
        except TimeoutError:
            assert time.monotonic() < end_s
            sites.run(0.05)


def test_topics_cross_the_overlay_in_both_directions(tmp_path: Path) -> None:
    chat, say = f"name: /chat, type: {known.STRING}", f"name: /say, type: {known.STRING}"
    sites = Sites(tmp_path)
    robot = sites.add(ROBOT, expose=[chat], imports=[say])
    viewer = with_door(sites, expose=[say], imports=[chat])
    door = cast("DoorEndpoint", viewer.endpoints[0])
    try:
        ear = Ear(robot.graph, "/say")
        talker = robot.graph.publish("/talker", "/chat", known.STRING)
        with client(door) as foxglove:
            (channel,) = json.loads(received(sites, foxglove))["channels"]
            assert not robot.is_read()  # as long as no client subscribes
            subscribe(foxglove, 1, channel["id"])
            channels = [{"id": 3, "topic": "/say", "encoding": "cdr", "schemaName": known.STRING}]
            foxglove.send(json.dumps({"op": "advertise", "channels": channels}))
            until(lambda: bool(sites.run(0.05) and robot.is_read() and viewer.is_read()))
            talker.publish(known.string("hello"))
            data = received(sites, foxglove)
            assert isinstance(data, bytes)
            assert data[13:] == known.string("hello")
            foxglove.send(struct.pack("<BI", 1, 3) + known.string("hi"))
            until(lambda: bool(sites.run(0.05) and ear.heard))
            assert ear.texts == ["hi"]
    finally:
        door.shut_down()


def test_a_type_that_only_the_publisher_knows_reaches_a_client(tmp_path: Path) -> None:
    own = known.custom("own_msgs/msg/Pair", "int32 a\nint32 b\n")
    sites = Sites(tmp_path)
    graph = FakeGraph(2, {own.type_name: own})
    robot = sites.add(ROBOT, expose=[f"name: /pair, type: {own.type_name}"], graph=graph)
    door = cast(
        "DoorEndpoint", with_door(sites, expose=[], imports=[f"name: /pair, type: {own.type_name}"]).endpoints[0]
    )
    try:
        talker = graph.publish("/talker", "/pair", own.type_name)
        with client(door) as foxglove:
            until(lambda: bool(sites.run(0.05) and robot.is_read()))  # the door itself reads, for the definition
            talker.publish(b"\0\1\0\0" + struct.pack("<ii", 1, 2))
            (channel,) = json.loads(received(sites, foxglove))["channels"]
            assert channel["schema"] == own.definition
            subscribe(foxglove, 1, channel["id"])
            until(lambda: any(each.node != "/door" for each in door.graph()))
            until(lambda: bool(sites.run(0.05) and robot.is_read()))
            talker.publish(b"\0\1\0\0" + struct.pack("<ii", 3, 4))
            data = received(sites, foxglove)
            assert isinstance(data, bytes)
            assert data[17:] == struct.pack("<ii", 3, 4)
    finally:
        door.shut_down()


def test_a_service_of_the_robot_is_called_through_the_overlay(tmp_path: Path) -> None:
    rule = f"kind: service, name: /switch, type: {known.SET_BOOL}"
    sites = Sites(tmp_path)
    robot = sites.add(ROBOT, expose=[rule])
    door = cast("DoorEndpoint", with_door(sites, expose=[], imports=[rule]).endpoints[0])
    try:
        asked = list[bytes]()

        def serve(raw: bytes, done: Callable[[bytes | str], None]) -> None:
            asked.append(raw)
            done(known.switched("done"))

        robot.graph.serve("/server", "/switch", known.SET_BOOL, serve)
        with client(door) as foxglove:
            (service,) = json.loads(received(sites, foxglove))["services"]
            assert service["request"]["schema"].strip() == "bool data"
            foxglove.send(struct.pack("<BIII", 2, service["id"], 7, 3) + b"cdr" + known.switch(on=True))
            wanted = struct.pack("<BIII", 3, service["id"], 7, 3) + b"cdr" + known.switched("done")
            assert received(sites, foxglove) == wanted
            assert asked == [known.switch(on=True)]
    finally:
        door.shut_down()


def test_a_goal_is_its_services_and_topics_for_a_client_without_words_for_actions(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    robot = sites.add(ROBOT, expose=[actions.RULE])
    door = cast("DoorEndpoint", with_door(sites, expose=[], imports=[actions.RULE]).endpoints[0])
    try:
        server = actions.ActionServer(robot.graph)
        offered, channels = dict[str, int](), dict[str, int]()
        with client(door) as foxglove:

            def call(part: str, raw: bytes) -> None:
                service = offered[f"{actions.AT}{part}"]
                foxglove.send(struct.pack("<BIII", 2, service, 1, 3) + b"cdr" + raw)

            def answer() -> bytes:
                data = received(sites, foxglove)
                assert isinstance(data, bytes)
                return data[16:] if data[0] == 3 else data[13:]

            while len(offered) < 3 or len(channels) < 2:
                fields = json.loads(received(sites, foxglove))
                offered |= {each["name"]: each["id"] for each in fields.get("services", ())}
                channels |= {each["topic"]: each["id"] for each in fields.get("channels", ())}
            subscribe(foxglove, 1, channels[f"{actions.AT}feedback"])
            until(lambda: bool(readers(door)))
            call("send_goal", actions.goal(1, 10))
            assert answer() == actions.ACCEPTED
            call("get_result", actions.goal_id(1))
            until(lambda: bool(sites.run(0.05) and server.results.waiting))
            server.feedback.publish(actions.sequence(1, 0, 1))
            assert answer() == actions.sequence(1, 0, 1)
            call("cancel_goal", actions.goal_id(1))
            assert answer() == actions.CANCELED
            server.results.waiting[0][1](actions.result(0, 1, 1))
            assert answer() == actions.result(0, 1, 1)
    finally:
        door.shut_down()
