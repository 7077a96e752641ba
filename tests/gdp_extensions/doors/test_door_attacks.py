"""Hostile clients and users at a door, which must cost themselves their connection, and the others nothing."""

from __future__ import annotations

import json
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("websockets")

from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from gdp.errors import GdpError, LocalError
from gdp.ports.socket_owners import SocketOwners
from gdp_extensions.doors import command, node
from gdp_extensions.doors.command import door_token
from gdp_extensions.doors.core.arrivals import Arrivals
from gdp_extensions.doors.core.client_queue import ClientQueue
from gdp_extensions.doors.core.foxglove_session import FoxgloveSession
from gdp_extensions.doors.core.hub import Hub
from gdp_extensions.doors.core.parameters import GET, LIST, SET
from gdp_extensions.doors.core.rosbridge_session import IDS_MAX, RosbridgeSession
from gdp_extensions.doors.endpoint import STRANGERS_MAX, DoorEndpoint, DoorSettings
from lab.process import until
from proxy.endpoints.core.endpoint import Event
from proxy.node import member_config
from proxy.serial.standard_types import known_channel
from tests.draws import draws
from tests.gdp_extensions.doors import test_foxglove_door as foxglove
from tests.gdp_extensions.doors.rights import Everything, goal_id
from tests.gdp_extensions.doors.test_foxglove_door import free_port
from tests.gdp_extensions.doors.test_parameters import service
from tests.proxy.bridge import known

PATIENCE_S = 20.0
TOKEN = "t&ken of 24 characters/+"


@contextmanager
def door_of(token: str = "", host: str = "127.0.0.1") -> Iterator[DoorEndpoint]:
    settings = DoorSettings(label="rosbridge", listen=f"{host}:{free_port()}", token=token)
    clock = count(1.0)
    door = DoorEndpoint(
        settings,
        lambda hub, number, queue: RosbridgeSession(hub, number, queue, lambda: next(clock), goal_id),
        Everything,
    )
    try:
        yield door
    finally:
        door.shut_down()


def is_served(client: ClientConnection) -> bool:
    client.send(json.dumps({"op": "call_service", "service": "/rosapi/topics", "id": "ping"}))
    return bool(json.loads(client.recv(PATIENCE_S))["id"] == "ping")


def hear_all(client: ClientConnection, request: str = "") -> None:
    """Send a request, and take what a client hears until its connection ends."""
    if request:
        client.send(request)
    while True:
        client.recv(PATIENCE_S)


@pytest.mark.parametrize(
    "query", ["", "/", "/?token=", "/?token=wrong", "/?token={0}&token={0}", "/?other={0}", "/{0}"]
)
def test_z02_another_user_of_the_host_does_not_enter_a_door(query: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SocketOwners, "uid_of", lambda *_: 65_534)
    with door_of("known") as door:
        address = "ws://{}:{}".format(*door.address) + query.format("known")
        with pytest.raises(InvalidStatus) as caught, connect(address):
            pass
        assert caught.value.response.status_code == 401
        assert b"known" not in (caught.value.response.body or b"")


@pytest.mark.skipif(os.geteuid() != 0, reason="root is needed to be another user")
@pytest.mark.parametrize("listen", ["127.0.0.1", "[::1]"])
def test_z02_the_kernel_says_whose_program_a_client_is(listen: str) -> None:
    with door_of("known", listen) as door:
        assert [asked_as(user, door.address) for user in (65_534, 0)] == [b"401", b"101"]


def asked_as(user: int, address: tuple[str, int]) -> bytes:
    """Return the status that a program of another user gets, which asks for a WebSocket without a token."""
    said, say = os.pipe()
    child = os.fork()
    if not child:
        os.setresuid(user, user, user)
        with socket.create_connection(address) as client:
            client.sendall(
                b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
            )
            os.write(say, client.recv(64).split()[1])
        os._exit(0)
    os.close(say)
    os.waitpid(child, 0)
    with os.fdopen(said, "rb") as heard:
        return heard.read()


def test_z02_a_program_of_the_doors_user_needs_no_token() -> None:
    with door_of("known") as door, connect("ws://{}:{}".format(*door.address)) as client:
        assert is_served(client)


def test_z02_the_printed_url_leads_in_and_no_other_text_shows_the_token(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), door_of(TOKEN) as door, connect(door.url) as client:
        assert is_served(client)
        logged = [each.getMessage() for each in caplog.records if each.name != "websockets.client"]
        shown = f"{door.label} {door._settings!r} {logged}"
        assert TOKEN not in shown
        assert "%26ken" not in shown


def test_z02_a_door_has_a_new_token_at_each_start_unless_a_private_file_names_one(tmp_path: Path) -> None:
    first, second = (door_token(None, no_token=False) for _ in range(2))
    assert len(first) >= 32
    assert first != second
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    file.chmod(0o600)
    assert door_token(file, no_token=False) == TOKEN
    file.write_text("short")
    with pytest.raises(LocalError, match="at least 16 characters"):
        door_token(file, no_token=False)


def test_z02_an_address_other_than_loopback_without_tls_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    config = SimpleNamespace(iface="viewer0")
    monkeypatch.setattr(member_config, "member_config", lambda *_: (config, tmp_path))
    monkeypatch.setattr(command, "wait_for_device", lambda *_: None)
    monkeypatch.setattr(node, "run_door", lambda *_, **__: None)
    for listen, tls, warnings in (
        ("127.0.0.1:9090", None, 0), ("localhost:9090", None, 0), ("[::1]:9090", None, 0),
        ("0.0.0.0:9090", tmp_path / "door.crt", 0), ("0.0.0.0:9090", None, 1),
    ):  # fmt: skip
        caplog.clear()
        command.serve_door("door", RosbridgeSession, tmp_path, listen, (), command.DoorOptions(tls=tls))  # type: ignore[arg-type]
        assert sum("--tls" in each.getMessage() for each in caplog.records) == warnings, listen


def test_z02_a_door_without_a_token_says_so(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert door_token(None, no_token=True) == ""
    assert "every user of this host" in caplog.text
    with door_of() as door, connect(door.url) as client:
        assert is_served(client)


HUGE = "x" * (32 << 20)
LONG = "x" * (1 << 20)
STRING = {"type": "std_msgs/msg/String"}
REQUESTS: list[dict[str, object]] = [
    {"op": "subscribe", "topic": "/a", **STRING},
    {"op": "unsubscribe", "topic": "/a"},
    {"op": "advertise", "topic": "/a", **STRING},
    {"op": "unadvertise", "topic": "/a"},
    {"op": "publish", "topic": "/a", **STRING, "msg": {"data": "x"}},
    {"op": "call_service", "service": "/add"},
    {"op": "call_service", "service": "/rosapi/topics"},
    {"op": "send_action_goal", "action": "/a", "action_type": "a/action/B"},
    {"op": "cancel_action_goal", "action": "/a"},
    {"op": "set_level", "level": "info"},
    {"op": "nothing"},
]


class Site:
    """Hub and session without a connection."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.hub = Hub(self.events.append, Everything, known_channel)
        self.queue = ClientQueue()
        self.session = RosbridgeSession(self.hub, 1, self.queue, lambda: 1.0, goal_id)
        self.hub.open(self.session)

    def say(self, **fields: object) -> str:
        """Pass a message of the client; return what it is said."""
        try:
            self.session.handle_message(json.dumps(fields), 5)
        except GdpError as error:
            self.session.tell_wrong(str(error))
        said = ""
        while (item := self.queue.pop()) is not None:
            assert isinstance(item, str)
            said += item
        return said


IDS: dict[str, object] = {"text": HUGE, "list": [HUGE], "map": {"id": HUGE}, "many": ["x"] * 100_000}


@pytest.mark.parametrize(
    ("request_", "form"),
    [
        pytest.param(
            each, form, id=f"{each['op']}-{form}", marks=[] if form == "text" or at == 0 else pytest.mark.nightly
        )
        for at, each in enumerate(REQUESTS)
        for form in IDS
    ],
)
def test_z03_an_id_of_32_mib_is_refused_and_not_repeated(request_: dict[str, object], form: str) -> None:
    site = Site()
    said = site.say(**request_, id=IDS[form])
    assert "id: a text of at most 1024 characters was expected" in said
    assert len(said) < 1_000
    assert site.events == []


LEAVES = st.none() | st.booleans() | st.integers() | st.text(max_size=5) | st.sampled_from(["/a", "/n.p", "byte_array"])
JSON = st.recursive(
    LEAVES | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(("data", "id", "name")), inner),
    max_leaves=8,
)
FOXGLOVE_REQUESTS: list[dict[str, object]] = [
    {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]},
    {"op": "unsubscribe", "subscriptionIds": [1]},
    {"op": "advertise", "channels": [{"id": 1, "topic": "/a", "encoding": "cdr", "schemaName": "a/msg/B"}]},
    {"op": "getParameters", "parameterNames": ["/n.p"], "id": "1"},
    {"op": "setParameters", "parameters": [{"name": "/n.p", "value": 1}]},
]
KEYS = sorted({key for each in (*REQUESTS, *FOXGLOVE_REQUESTS) for key in each} | {"id", "args"})
CHANGES = st.dictionaries(st.sampled_from(KEYS), JSON, max_size=4)


@draws(25)
@given(st.lists(st.tuples(st.sampled_from(REQUESTS), CHANGES), max_size=4))
def test_z03_whatever_a_rosbridge_client_sends_is_done_or_one_error(
    sent: list[tuple[dict[str, object], object]],
) -> None:
    site = Site()
    for request_, changes in sent:
        assert isinstance(changes, dict)
        site.say(**{**request_, **changes})


@draws(25)
@given(st.lists(st.tuples(st.sampled_from(FOXGLOVE_REQUESTS), CHANGES), max_size=4), st.binary(max_size=20))
def test_z03_whatever_a_foxglove_client_sends_is_done_or_one_error(
    sent: list[tuple[dict[str, object], object]], raw: bytes
) -> None:
    hub = Hub(lambda event: None, Everything, lambda topic, type_name: None)
    session = FoxgloveSession(hub, 1, "test", ClientQueue())
    hub.open(session)
    for handle, each in enumerate((GET, LIST, SET), 1):
        hub.offer_service(handle, service("/n", each))
    for request_, changes in sent:
        assert isinstance(changes, dict)
        with suppress(GdpError):
            session.handle_message(json.dumps({**request_, **changes}), 5)
    with suppress(GdpError):
        session.handle_message(raw, 5)


@pytest.mark.parametrize("key", ["op", "topic", "type", "service", "action", "action_type", "compression", "level"])
def test_z03_no_text_of_a_client_is_repeated_at_length(key: str) -> None:
    site = Site()
    for each in REQUESTS:
        assert len(site.say(**{**each, key: LONG})) < 10_000


@pytest.mark.parametrize("msg", [{LONG: 1}, {"data": {LONG: LONG}}, {"data": [LONG]}, LONG], ids=range(4))
def test_z03_no_field_of_a_message_is_repeated_at_length(msg: object) -> None:
    site = Site()
    assert len(site.say(op="publish", topic="/a", **STRING, msg=msg)) < 10_000


@pytest.mark.parametrize("op", ["subscribe", "advertise"])
def test_z03_ids_of_a_client_are_bounded_over_all_its_topics(op: str) -> None:
    site = Site()
    said = [site.say(op=op, topic=f"/t{number % 3}", **STRING, id=str(number)) for number in range(IDS_MAX + 2)]
    assert said[:IDS_MAX] == [""] * IDS_MAX
    assert all(f"more than {IDS_MAX} ids" in each for each in said[IDS_MAX:])
    assert site.say(op=f"un{op}", topic="/t0", id="0") == ""
    assert site.say(op=op, topic="/t0", **STRING, id="new") == ""


def test_z03_messages_before_the_bridge_takes_their_topics_are_bounded_together() -> None:
    site = Site()
    for number in range(40):
        site.say(op="publish", topic=f"/t{number}", **STRING, msg={"data": "x" * (1 << 20)})
    kept = sum(len(raw) for each in site.hub._early.values() for _, raw in each)
    assert kept <= 16 << 20
    assert site.hub.dropped_otherwise >= 24


def test_z03_schemas_of_a_foxglove_client_are_bounded_together() -> None:
    hub = Hub(lambda event: None, Everything, lambda topic, type_name: None)
    queue = ClientQueue()
    session = FoxgloveSession(hub, 1, "test", queue)
    schema = {"encoding": "cdr", "schemaName": "a/msg/B", "schemaEncoding": "ros2msg", "schema": "#" * (1 << 20)}
    for number in range(6):
        channels = [{"id": number, "topic": f"/t{number}", **schema}]
        session.handle_message(json.dumps({"op": "advertise", "channels": channels}), 5)
    assert len(list(session.publishes())) == 4


def test_z03_a_client_that_sends_ids_of_32_mib_costs_the_others_nothing() -> None:
    with door_of() as door, connect(door.url) as hostile, connect(door.url) as other:
        for each in REQUESTS[:3]:
            hostile.send(json.dumps({**each, "id": HUGE[: (32 << 20) - 200]}))
            assert is_served(other)
        with pytest.raises(ConnectionClosed):
            hear_all(hostile, json.dumps({"op": "advertise", "topic": "/a", "id": HUGE}))
        assert is_served(other)


def test_z03_messages_that_never_end_cost_their_senders_the_connection() -> None:
    part = b"\x82\xff" + (20 << 20).to_bytes(8, "big") + bytes(4) + bytes(10 << 20)  # half of a frame
    with door_of() as door, connect(door.url) as other, ExitStack() as stack:
        hostile = [stack.enter_context(connect(door.url, close_timeout=0.1)) for _ in range(8)]
        for each in hostile:
            each.socket.sendall(part)
        until(lambda: door.clients <= 7, PATIENCE_S)
        assert door.clients >= 6
        assert is_served(other)


def test_z03_connections_that_say_nothing_are_bounded_and_the_oldest_gives_way() -> None:
    with door_of() as door, ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection(door.address)) for _ in range(STRANGERS_MAX)]
        until(lambda: len(door._strangers) == STRANGERS_MAX)
        with connect("ws://{}:{}".format(*door.address)) as client:
            silent[0].settimeout(PATIENCE_S)
            with suppress(ConnectionResetError):
                assert silent[0].recv(1) == b""
            until(lambda: door.clients == 1 and len(door._strangers) == STRANGERS_MAX - 1)
            client.send(json.dumps({"op": "call_service", "service": "/rosapi/topics"}))
            assert "values" in json.loads(client.recv(PATIENCE_S))


def test_z03_of_messages_on_their_way_the_one_that_began_first_gives_way() -> None:
    arrivals = Arrivals[str](10 << 20)
    for _ in range(100):
        assert arrivals.count("reader", 6) == []  # pongs
    assert arrivals.count("slow", 5 << 20) == []
    assert arrivals.count("reader", 4 << 20) == []
    assert arrivals.count("new", 2 << 20) == ["slow"]
    arrivals.end("reader")
    assert arrivals.count("new", 7 << 20) == []


def test_z03_what_waits_for_all_clients_is_bounded_and_the_one_with_most_gives_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gdp_extensions.doors.endpoint.WAITING_MAX_BYTES", 1_000)
    with door_of() as door, connect(door.url) as first, connect(door.url) as second:
        assert is_served(first)
        assert is_served(second)
        one, two = (each.queue for each in door._clients.values())

        def put() -> None:
            one.put_control("x" * 300)
            two.put_control("x" * 900)

        door._do(put)
        with pytest.raises(ConnectionClosed):
            hear_all(second)
        first.recv(PATIENCE_S)
        assert is_served(first)


def test_y08_a_client_of_a_door_hears_of_a_message_that_cannot_be_written_and_gets_the_next_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    encode = FoxgloveSession.encode
    monkeypatch.setattr(
        FoxgloveSession, "encode", lambda self, item: 1 / 0 if item.raw == b"bad" else encode(self, item)
    )
    door = foxglove.door_of()
    try:
        with foxglove.client(door) as listener:
            handle = door.advertise(replace(known.channel(known.STRING), topic="/chatter"))
            foxglove.subscribe(listener, 7, foxglove.advertised(listener))
            until(lambda: bool(foxglove.readers(door)))
            for raw in (b"bad", b"good"):
                door.publish(handle, raw)
            status = foxglove.heard(listener)
            assert (status["op"], status["level"]) == ("status", 2)
            assert "ZeroDivisionError" in str(status["message"])
            assert foxglove.message(listener) == (7, b"good")
            assert door.dropped == 1
    finally:
        door.shut_down()
