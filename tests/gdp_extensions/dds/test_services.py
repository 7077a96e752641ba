"""Services of endpoint ``dds``, with a second one in another process as the peer."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds", reason="Cyclone DDS's Python binding is not installed")

from gdp.errors import LocalError
from gdp_extensions.dds.endpoint import DdsEndpoint
from proxy.endpoints.core.endpoint import CallFailed, Event, RequestReceived, ResponseReceived, Role
from proxy.serial.channel import Channel, Service
from tests.gdp_extensions.dds.peers import CYCLONE, Ears, Peer, peer

SET = "std_srvs/srv/SetBool"
SERVICE = Service("/set", SET, "", Channel("/set", f"{SET}_Request", 2), Channel("/set", f"{SET}_Response", 2))


@pytest.fixture
def domain() -> int:
    return 100 + os.getpid() % 100


@pytest.fixture
def ears(domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ears]:
    monkeypatch.setenv("CYCLONEDDS_URI", CYCLONE)
    endpoint = DdsEndpoint(domain, "gdp_proxy_0123456789ab")
    yield Ears(endpoint)
    endpoint.shut_down()


@pytest.fixture
def robot(domain: int) -> Iterator[Peer]:
    with peer("dds", domain) as found:
        yield found


def request(number: int) -> bytes:
    return b"\x00\x01\x00\x00" + number.to_bytes(8, "little")


def answers(events: list[Event]) -> list[ResponseReceived]:
    return [each for each in events if isinstance(each, ResponseReceived)]


def test_the_first_call_is_answered_at_once(ears: Ears, robot: Peer) -> None:
    robot.tell("serve", topic="/set", type=SET)
    assert ears.wait_end(Role.SERVES, "/set").node == "/robot"
    handle = ears.endpoint.create_client("/set", SET)
    ears.endpoint.call(handle, 41, request(7))
    events = ears.wait(lambda got: bool(answers(got)))
    assert answers(events) == [ResponseReceived(handle, 41, request(7))]


def test_a_thousand_calls_at_once_are_each_answered_with_their_own(ears: Ears, robot: Peer) -> None:
    robot.tell("serve", topic="/set", type=SET)
    ears.wait_end(Role.SERVES, "/set")
    handle = ears.endpoint.create_client("/set", SET)
    for number in range(1_000):
        ears.endpoint.call(handle, number, request(number))
    events = ears.wait(lambda got: len(answers(got)) == 1_000)
    assert {each.call: each.raw for each in answers(events)} == {number: request(number) for number in range(1_000)}


def test_a_local_client_is_answered_by_us(ears: Ears, robot: Peer) -> None:
    handle = ears.endpoint.serve(SERVICE)
    robot.tell("dial", topic="/set", type=SET)
    ears.wait_end(Role.CALLS, "/set")
    for number in range(50):
        robot.tell("call", topic="/set", call=number, hex=request(number).hex())
    events = ears.wait(lambda got: sum(isinstance(each, RequestReceived) for each in got) == 50)
    for asked in reversed([each for each in events if isinstance(each, RequestReceived)]):
        ears.endpoint.answer(handle, asked.ticket, asked.raw)
    assert {each["answered"]: each["raw"] for each in robot.wait_news("answered", None, 50)} == {
        number: request(number).hex() for number in range(50)
    }


def test_a_call_fails_when_its_server_leaves(ears: Ears, robot: Peer) -> None:
    robot.tell("serve", topic="/set", type=SET, mute=True)
    ears.wait_end(Role.SERVES, "/set")
    handle = ears.endpoint.create_client("/set", SET)
    ears.endpoint.call(handle, 41, request(7))
    robot.tell("close", topic="/set")
    events = ears.wait(lambda got: any(isinstance(each, CallFailed) for each in got))
    assert CallFailed(handle, 41, "the server is gone") in events
    ears.endpoint.call(handle, 42, request(7))
    assert CallFailed(handle, 42, "no server") in ears.endpoint.poll_events()


def test_the_response_of_a_dropped_call_is_ignored(ears: Ears, robot: Peer) -> None:
    robot.tell("serve", topic="/set", type=SET)
    ears.wait_end(Role.SERVES, "/set")
    handle = ears.endpoint.create_client("/set", SET)
    ears.endpoint.call(handle, 1, request(1))
    ears.endpoint.drop(handle, 1)
    ears.endpoint.call(handle, 2, request(2))
    events = ears.wait(lambda got: bool(answers(got)))
    assert [each.call for each in answers(events)] == [2]


def test_a_service_is_known_as_bytes_while_it_is_served(ears: Ears, robot: Peer) -> None:
    with pytest.raises(LocalError, match="while a local node serves it"):
        ears.endpoint.service("/set", SET)
    robot.tell("serve", topic="/set", type=SET)
    ears.wait_end(Role.SERVES, "/set")
    assert ears.endpoint.service("/set", SET) == SERVICE


def test_an_endpoint_never_hears_itself(ears: Ears) -> None:
    kind = "std_msgs/msg/String"
    ears.endpoint.subscribe("/chat", kind, None)
    handle = ears.endpoint.advertise(ears.endpoint.channel("/chat", kind))
    server, client = ears.endpoint.serve(SERVICE), ears.endpoint.create_client("/set", SET)
    ears.endpoint.publish(handle, b"\x00\x01\x00\x00\x01\x00\x00\x00\x00\x00\x00\x00")
    ears.endpoint.call(client, 1, request(1))
    assert ears.endpoint.subscribers(handle) == 0
    assert CallFailed(client, 1, "no server") in ears.endpoint.poll_events()
    assert ears.endpoint.graph() == frozenset()
    assert server != client


def test_what_is_opened_and_closed_leaves_nothing_behind(ears: Ears) -> None:
    def rounds(count: int) -> None:
        for at in range(count):
            topic = f"/topic{at % 7}"
            opened = [
                ears.endpoint.subscribe(topic, "std_msgs/msg/String", None),
                ears.endpoint.advertise(ears.endpoint.channel(topic, "std_msgs/msg/String")),
                ears.endpoint.serve(SERVICE),
                ears.endpoint.create_client("/set", SET),
            ]
            ears.endpoint.poll_events()
            for handle in opened:
                ears.endpoint.close(handle)

    def held() -> tuple[int, int, int]:
        gc.collect()
        resident_kb = int(Path("/proc/self/statm").read_text().split()[1]) * 4
        return len(os.listdir("/proc/self/fd")), threading.active_count(), resident_kb

    rounds(100)
    before = held()
    rounds(200)
    after = held()
    assert after[:2] == before[:2]
    assert after[2] - before[2] < 2_000
