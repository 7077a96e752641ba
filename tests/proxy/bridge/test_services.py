"""Services from end to end: each call gets its own response once, or fails with a reason."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from gdp.client.send_options import SendOptions
from proxy.bridge.flow_rows import flow_rows
from proxy.serial.channel import RosVersion
from tests.proxy.bridge import known
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites
from tests.proxy.endpoints.fake import FakeGraph

SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"
ECHO = "own_srvs/srv/Echo"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def pair(sites: Sites, out: str = SWITCH, into: str = SWITCH) -> tuple[Machine, Machine]:
    """Return the machine with the server, and the one with the clients."""
    return sites.add(SERVER, expose=[out]), sites.add(ROBOT, imports=[into])


def served(sites: Sites) -> tuple[LocalServer, Client]:
    """Return a server and a far client that sees it."""
    server, client = pair(sites)
    local, caller = LocalServer(server.graph), Client(client.graph)
    assert sites.run(3, caller.sees_server)
    return local, caller


@pytest.mark.parametrize("sign", ["always", "session"])
def test_the_first_call_is_answered(sites: Sites, sign: str) -> None:
    server, client = pair(sites, f"{SWITCH}, sign: {sign}", f"{SWITCH}, sign: {sign}")
    LocalServer(server.graph, answer=lambda raw: switched(f"got {raw[-1]}"))
    caller = Client(client.graph)
    assert sites.run(1, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(0.2, lambda: caller.outcomes == [switched("got 1")])


def test_both_sides_of_a_service_send_as_their_rules_say(sites: Sites) -> None:
    server, client = pair(sites, f"{SWITCH}, weight: 5, max_bits_s: 2000000", f"{SWITCH}, weight: 9")
    LocalServer(server.graph)
    assert sites.run(3, Client(client.graph).sees_server)
    options = [publisher.options for machine in (server, client) for publisher in list(machine.member.publications)]
    assert options == [SendOptions(weight=5, max_bits_s=2e6), SendOptions(weight=9)]


def test_a_server_that_appears_late_is_seen_within_a_second_and_its_first_call_answered(sites: Sites) -> None:
    server, client = pair(sites)
    caller = Client(client.graph)
    sites.run(20)
    assert not caller.sees_server()
    LocalServer(server.graph, answer=lambda _: switched("yes"))
    assert sites.run(1, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(0.2, lambda: caller.outcomes == [switched("yes")])


def test_five_hundred_calls_at_once_get_their_own_answers_in_whatever_order(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    echo = {ECHO: known.service(ECHO, "string text\n", "string text\n")}
    graphs = [FakeGraph(2, known.channels(), echo) for _ in range(2)]
    rule = f"kind: service, name: /switch, type: {ECHO}, timeout_s: 60"
    server = sites.add(SERVER, expose=[rule], graph=graphs[0])
    client = sites.add(ROBOT, imports=[rule], graph=graphs[1])
    local, caller = LocalServer(server.graph, type_name=ECHO), Client(client.graph)
    assert sites.run(3, caller.sees_server)
    for number in range(500):
        caller.call(known.string(str(number)))
    assert sites.run(10, lambda: local.asked == 500)
    random.Random(1).shuffle(local.waiting)
    for raw, done in local.waiting:
        done(known.string(f"answer to {known.text_of(raw)}"))
    assert sites.run(10, lambda: len(caller.outcomes) == 500)
    sites.run(1)
    expected = {number: [known.string(f"answer to {number}")] for number in range(500)}
    assert caller.got == expected


def test_clients_on_several_machines_each_get_their_own_answers(sites: Sites) -> None:
    server, client = pair(sites)
    third = sites.add("nuc3/third", imports=[SWITCH])
    LocalServer(server.graph, answer=lambda raw: switched(f"got {raw[-1]}"))
    remote_clients = [Client(client.graph), Client(third.graph)]
    assert sites.run(3, lambda: all(caller.sees_server() for caller in remote_clients))
    for on, caller in enumerate(remote_clients):
        for _ in range(20):
            caller.call(switch(on=bool(on)))
    assert sites.run(3, lambda: all(len(caller.outcomes) == 20 for caller in remote_clients))
    assert [set(caller.outcomes) for caller in remote_clients] == [{switched("got 0")}, {switched("got 1")}]


def test_two_far_servers_are_both_asked_and_the_first_answer_wins(sites: Sites) -> None:
    server, client = pair(sites)
    other = sites.add("nuc3/other", expose=[SWITCH])
    slow, fast = LocalServer(server.graph), LocalServer(other.graph, answer=lambda _: switched("fast"))
    caller = Client(client.graph)
    sites.run(3)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("fast")])
    sites.run(0.2)
    assert (slow.asked, fast.asked) == (1, 1)
    slow.waiting[0][1](switched("slow"))
    sites.run(1)
    assert caller.outcomes == [switched("fast")]


@pytest.mark.parametrize("there", [1, 2])
@pytest.mark.parametrize("here", [1, 2])
@pytest.mark.parametrize("encoding", ["json", "cbor", "cdr"])
def test_a_client_and_a_server_of_either_ros(sites: Sites, there: RosVersion, here: RosVersion, encoding: str) -> None:
    rule = f"{SWITCH}, encoding: {encoding}"
    server, client = sites.add(SERVER, expose=[rule], ros=there), sites.add(ROBOT, imports=[rule], ros=here)
    requests: list[bytes] = []

    def answer(raw: bytes) -> bytes:
        requests.append(raw)
        return switched("grüße", there)

    LocalServer(server.graph, answer=answer)
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    caller.call(switch(on=True, ros=here))
    assert sites.run(1, lambda: bool(caller.outcomes))
    assert (requests, caller.outcomes) == ([switch(on=True, ros=there)], [switched("grüße", here)])


def test_a_service_type_that_the_client_does_not_know_comes_with_its_definition(sites: Sites) -> None:
    rule = f"kind: service, name: /echo, type: {ECHO}"
    knows = FakeGraph(2, known.channels(), {ECHO: known.service(ECHO, "string text\n", "string text\n")})
    server, client = sites.add(SERVER, expose=[rule], graph=knows), sites.add(ROBOT, imports=[rule])
    LocalServer(server.graph, "/echo", ECHO, lambda raw: raw)
    caller = Client(client.graph, "/echo")
    assert sites.run(3, caller.sees_server)
    caller.call(known.string("hello"))
    assert sites.run(1, lambda: caller.outcomes == [known.string("hello")])


def test_services_that_differ_are_reported_with_the_first_difference_and_there_is_no_virtual_server(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    rule = f"kind: service, name: /echo, type: {ECHO}"
    graphs = [
        FakeGraph(2, known.channels(), {ECHO: known.service(ECHO, f"{word} value\n", "string text\n")})
        for word in ("int32", "int64")
    ]
    server = sites.add(SERVER, expose=[rule], graph=graphs[0])
    client = sites.add(ROBOT, imports=[rule], graph=graphs[1])
    LocalServer(server.graph, "/echo", ECHO, lambda raw: raw)
    caller = Client(client.graph, "/echo")
    sites.run(3)
    assert not caller.sees_server()
    assert any(text.startswith("/echo: other-type: ") and "value: " in text for text in caplog.messages)


def test_rules_of_both_sides_may_allow_fields_that_one_side_lacks(sites: Sites) -> None:
    rule = f"kind: service, name: /echo, type: {ECHO}, fields: default"
    server = sites.add(SERVER, expose=[rule], graph=_echoing("string text\nint8 more\n", "string text\n"))
    client = sites.add(ROBOT, imports=[rule], graph=_echoing("string text\n", "string text\nint8 more\n"))
    LocalServer(server.graph, "/echo", ECHO, lambda raw: raw[:-1])
    caller = Client(client.graph, "/echo")
    assert sites.run(3, caller.sees_server)
    caller.call(known.string("hello"))
    assert sites.run(1, lambda: caller.outcomes == [known.string("hello") + b"\0"])
    assert client.faults == {"other-type": 1}


def _echoing(request: str, response: str) -> FakeGraph:
    return FakeGraph(2, known.channels(), {ECHO: known.service(ECHO, request, response)})


def test_each_side_may_call_the_service_otherwise(sites: Sites) -> None:
    server, client = pair(sites, f"{SWITCH}, remap: /lamp/set", f"{SWITCH}, remap: /far/lamp")
    LocalServer(server.graph, "/lamp/set", answer=lambda _: switched("yes"))
    caller = Client(client.graph, "/far/lamp")
    assert sites.run(3, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])


def test_a_large_request_and_a_large_answer_arrive_whole(sites: Sites) -> None:
    rule = f"kind: service, name: /echo, type: {ECHO}"
    echo = {ECHO: known.service(ECHO, "string text\n", "string text\n")}
    graphs = [FakeGraph(2, known.channels(), echo) for _ in range(2)]
    server = sites.add(SERVER, expose=[rule], graph=graphs[0])
    client = sites.add(ROBOT, imports=[rule], graph=graphs[1])
    LocalServer(server.graph, "/echo", ECHO, lambda raw: raw)
    caller = Client(client.graph, "/echo")
    assert sites.run(3, caller.sees_server)
    caller.call(known.string("x" * 500_000))
    assert sites.run(3, lambda: caller.outcomes == [known.string("x" * 500_000)])


def test_rows_of_both_sides_count_requests_and_their_bytes(sites: Sites) -> None:
    server, client = pair(sites)
    LocalServer(server.graph, answer=lambda _: switched("yes"))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    for _ in range(3):
        caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == 3 * [switched("yes")])
    (out,), (into,) = (list(flow_rows(each.bridge.flows, (), each.member)) for each in (server, client))
    assert (out.messages, into.messages) == (3, 3)
    assert into.bytes == 3 * len(switch(on=True))
    assert out.bytes == server.context.traffic.bytes_in > 0
