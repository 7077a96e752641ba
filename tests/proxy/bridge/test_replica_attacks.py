"""Servers and clients that misbehave within their rights, or die at a bad moment, as seen by the bridge."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.client.delivery import Delivered
from gdp.client.participant import Message
from gdp.errors import LocalError
from gdp.intervals import DAY_S
from proxy.bridge.exposed_service import ExposedService
from proxy.wire.service import Exchange
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites
from tests.proxy.bridge.test_actions import goal, goal_id
from tests.proxy.bridge.test_replicas import SWITCH, actions

pytestmark = pytest.mark.real_signatures


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def test_a_goal_whose_servers_all_die_in_one_moment_fails_and_breaks_nothing(sites: Sites) -> None:
    _, servers, client, caller = actions(sites, mode="mode: some, copies: 1")
    for server in servers:
        server.goals.answer = None
    caller.goals.call(goal(1, 10))
    sites.run(0.1)
    with pytest.MonkeyPatch.context() as patch:
        for who in ("peers", "connected_peers"):
            patch.setattr(client.member.services, who, lambda _: [])
        assert sites.run(2, lambda: len(caller.goals.outcomes) == 1)
    sites.run(1)
    assert client.bridge.flows


def called(sites: Sites, expose: str = SWITCH, timeout_s: str = "60") -> tuple[Machine, LocalServer, Machine, Client]:
    """Return a server's machine, its local server, which does not answer, a client's machine and a client."""
    machine = sites.add(SERVER, expose=[expose])
    local = LocalServer(machine.graph)
    client = sites.add(ROBOT, imports=[f"{SWITCH}, timeout_s: {timeout_s}"])
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    return machine, local, client, caller


def serving_of(machine: Machine) -> ExposedService:
    (_, flow), *_ = machine.bridge.flows
    assert isinstance(flow, ExposedService)
    return flow


def test_the_calls_of_a_client_that_died_are_let_go_though_it_would_have_waited_for_ever(sites: Sites) -> None:
    machine, local, client, caller = called(sites, f"{SWITCH}, at_once: 1", "null")
    for _ in range(3):
        caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    sites.kill(client)
    serving = serving_of(machine)._serving
    assert len(serving) == 3
    assert sites.run(60, lambda: len(serving) == 1)
    local.waiting[0][1](switched("late"))
    assert sites.run(1, lambda: len(serving) == 0)
    assert local.asked == 1


def test_a_call_without_a_limit_ends_at_the_servers_side_all_the_same(sites: Sites) -> None:
    machine, local, _, caller = called(sites, timeout_s="null")
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    due_s = serving_of(machine).get_timer()
    assert due_s is not None
    assert due_s <= sites.now_s + DAY_S


def test_a_goal_may_take_as_long_as_it_likes(sites: Sites) -> None:
    machines, servers, _, caller = actions(sites)
    caller.goals.call(goal(1, 10))
    assert sites.run(1, lambda: len(caller.goals.outcomes) == 1)
    caller.results.call(goal_id(1))
    sites.run(1)
    assert [len(serving_of(machine)._serving) for machine in machines] == [1] * len(servers)
    assert [serving_of(machine).get_timer() for machine in machines] == [None] * len(servers)


def test_a_client_with_too_many_calls_in_flight_gets_an_error(sites: Sites) -> None:
    machine, _, _, caller = called(sites)
    with pytest.MonkeyPatch.context() as patch:

        def full(*_: object) -> int:
            raise LocalError("no more at once")

        patch.setattr(type(serving_of(machine)._serving), "begin", full)
        caller.call(switch(on=True))
        assert sites.run(1, lambda: len(caller.outcomes) == 1)
    assert machine.faults == {"too-fast": 1}


@pytest.mark.parametrize("description", [b"nonsense", Exchange("json", ()).to_cbor()])
def test_a_client_that_cannot_be_understood_is_read_once(sites: Sites, description: bytes) -> None:
    machine, local, client, caller = called(sites)
    client.stream.describe(description)
    sites.run(1)
    read: list[bytes] = []
    with pytest.MonkeyPatch.context() as patch:
        from_wire = Exchange.from_cbor

        def noted(wire: bytes) -> Exchange:
            read.append(wire)
            return from_wire(wire)

        patch.setattr(Exchange, "from_cbor", noted)
        for _ in range(3):
            caller.call(switch(on=True))
        assert sites.run(1, lambda: len(caller.outcomes) == 3)
    assert (local.asked, read, machine.faults) == (0, [description], {"malformed": 3})


def test_requests_of_a_client_without_a_description_do_not_keep_a_server_from_leaving(sites: Sites) -> None:
    machine, _, client, _ = called(sites)
    flow, publisher = serving_of(machine), bytes(client.member.name)
    with pytest.MonkeyPatch.context() as patch:
        (writer_proxy,) = machine.member.subscriptions.writer_proxies_of(machine.stream.topic)
        patch.setattr(writer_proxy, "description", b"")
        for number in range(300):
            flow.receive(Message(machine.stream.topic, Delivered(publisher, 1, number, b"?", 1, 0), b""), sites.now_s)
        flow.drain(sites.now_s)
        assert sites.run(2, lambda: flow.is_drained(sites.now_s))
        assert len(flow._early) == 256
    sites.leave(machine)
    assert machine.faults == {"too-fast": 300}


def test_a_request_that_cannot_be_sent_fails_with_the_reason_and_the_next_goes(sites: Sites) -> None:
    _, local, client, caller = called(sites)
    local.answer = lambda _: switched("yes")
    with pytest.MonkeyPatch.context() as patch:

        def refuse(_: bytes) -> int:
            raise LocalError("above the limits")

        patch.setattr(client.stream, "publish", refuse)
        caller.call(switch(on=True))
        assert sites.run(1, lambda: caller.outcomes == ["above the limits"])
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes[1:] == [switched("yes")])
