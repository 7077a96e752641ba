"""Calls that cannot be served: each fails once, with its reason, and no later call suffers."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.intervals import READER
from gdp.names import Name
from lab.network import SimLink
from proxy.bridge.exposed_service import ExposedService
from tests.proxy.bridge import known
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites
from tests.proxy.endpoints.fake import FakeGraph

SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"
OTHER = "nuc3/other"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def pair(sites: Sites, more: str = "") -> tuple[Machine, Machine, LocalServer, Client]:
    """Return the machine with the server, the one with the client, and both of these."""
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH + more])
    local, caller = LocalServer(server.graph), Client(client.graph)
    assert sites.run(3, caller.sees_server)
    return server, client, local, caller


def test_the_servers_reason_reaches_the_client(sites: Sites) -> None:
    server, client, local, caller = pair(sites)
    local.answer = lambda _: "the lamp is broken"
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == ["the lamp is broken"])
    assert (server.faults, client.faults) == ({"refused": 1}, {"refused": 1})


def test_without_a_far_server_there_is_no_virtual_one(sites: Sites) -> None:
    sites.add(SERVER, expose=[SWITCH])
    client = sites.add(ROBOT, imports=[SWITCH])
    caller = Client(client.graph)
    sites.run(3)
    assert not caller.sees_server()
    caller.call(switch(on=True))
    assert caller.outcomes == ["no server"]


def test_a_server_that_leaves_mid_call_fails_it_with_a_reason(sites: Sites) -> None:
    server, _, local, caller = pair(sites)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    local.handle.close()
    assert sites.run(1, lambda: len(caller.outcomes) == 1)
    assert caller.outcomes == ["the server is gone"]
    assert sites.run(1.5, lambda: not caller.sees_server())
    assert server.faults == {"no-server": 1}


def test_the_answer_of_a_server_that_leaves_at_once_arrives(sites: Sites) -> None:
    _, _, local, caller = pair(sites)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    local.waiting[0][1](switched("goodbye"))
    local.handle.close()
    assert sites.run(1, lambda: len(caller.outcomes) == 1)
    assert caller.outcomes == [switched("goodbye")]


def answered_into_a_dead_link(sites: Sites) -> tuple[SimLink, Client]:
    """Let a server answer and leave while its machine's link loses everything; return the link and the client."""
    server, _, local, caller = pair(sites)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    lead = sites.world.leads[server.label]
    lead.loss = 1.0
    local.waiting[0][1](switched("goodbye"))
    local.handle.close()
    sites.run(0.3)
    return lead, caller


def test_the_answer_of_a_server_that_leaves_at_once_arrives_by_a_link_that_loses_it(sites: Sites) -> None:
    lead, caller = answered_into_a_dead_link(sites)
    lead.loss = 0.0
    assert sites.run(1, lambda: len(caller.outcomes) == 1)
    assert caller.outcomes == [switched("goodbye")]
    assert sites.run(1.5, lambda: not caller.sees_server())


def test_requests_to_a_server_that_has_gone_are_refused_while_its_last_answer_is_under_way(sites: Sites) -> None:
    lead, caller = answered_into_a_dead_link(sites)
    caller.call(switch(on=False))
    lead.loss = 0.0
    assert sites.run(1, lambda: len(caller.outcomes) == 2)
    assert caller.outcomes[0] == switched("goodbye")
    assert caller.outcomes[1] in ("the server is gone", "the far server is gone")


def test_a_proxy_that_dies_mid_call_fails_it_before_the_client_gives_up(sites: Sites) -> None:
    server, _, local, caller = pair(sites, ", timeout_s: 60")
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    sites.kill(server)
    assert sites.run(READER.lease_s + 2, lambda: len(caller.outcomes) == 1)
    assert caller.outcomes == ["the far server is gone"]
    assert sites.run(1.5, lambda: not caller.sees_server())


def test_a_server_that_comes_back_is_called_again(sites: Sites) -> None:
    server, _, local, caller = pair(sites)
    local.handle.close()
    assert sites.run(1, lambda: not caller.sees_server())
    LocalServer(server.graph, answer=lambda _: switched("back"))
    assert sites.run(1, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(0.2, lambda: caller.outcomes == [switched("back")])


def test_a_server_that_is_replaced_at_once_answers_the_next_call(sites: Sites) -> None:
    server, _, local, caller = pair(sites)
    local.handle.close()
    LocalServer(server.graph, answer=lambda _: switched("new"))
    sites.run(1)
    assert caller.sees_server()
    caller.call(switch(on=True))
    assert sites.run(0.5, lambda: caller.outcomes == [switched("new")])


def test_a_call_without_an_answer_fails_in_time_on_both_sides(sites: Sites) -> None:
    server, client, local, caller = pair(sites, ", timeout_s: 2")
    caller.call(switch(on=True))
    assert not sites.run(1.9, lambda: bool(caller.outcomes))
    assert sites.run(0.2, lambda: caller.outcomes == ["no answer within 2 s"])
    sites.run(1)
    assert local.asked == 1
    assert (server.faults, client.faults) == ({"timed-out": 1}, {"timed-out": 1})


@pytest.mark.parametrize(
    ("more", "outcomes"), [("", [b"\0\1\0\0" + bytes(16)]), (", on_timeout: silent", ["no answer within 2 s"])]
)
def test_a_timeout_answers_an_empty_response_unless_it_is_to_be_silent(
    sites: Sites, more: str, outcomes: list[bytes | str]
) -> None:
    plan = known.service("test_msgs/srv/Plan", "int64 goal\n", "int32[] path\nfloat64 cost\n")
    services = {plan.type_name: plan}
    graphs = [FakeGraph(2, known.channels(), services) for _ in range(2)]
    rule = "kind: service, name: /plan, type: test_msgs/srv/Plan"
    sites.add(SERVER, expose=[rule], graph=graphs[0])
    client = sites.add(ROBOT, imports=[f"{rule}, timeout_s: 2{more}"], graph=graphs[1])
    LocalServer(graphs[0], name="/plan", type_name="test_msgs/srv/Plan")
    caller = Client(graphs[1], name="/plan")
    assert sites.run(3, caller.sees_server)
    caller.call(b"\0\1\0\0" + bytes(8))
    assert sites.run(2.2, lambda: caller.outcomes == outcomes)
    assert client.faults == {"timed-out": 1}


def test_a_late_answer_never_answers_the_next_call(sites: Sites) -> None:
    _, _, local, caller = pair(sites, ", timeout_s: 2")
    caller.call(switch(on=True))
    sites.run(3)
    caller.call(switch(on=False))
    assert sites.run(1, lambda: len(local.waiting) == 2)
    local.waiting[0][1](switched("late"))
    sites.run(0.5)
    local.waiting[1][1](switched("in time"))
    sites.run(1)
    assert list(caller.got.values()) == [["no answer within 2 s"], [switched("in time")]]


def test_an_answer_that_overtakes_an_earlier_calls_goes_to_its_own(sites: Sites) -> None:
    _, _, local, caller = pair(sites)
    for on in (True, False):
        caller.call(switch(on=on))
    assert sites.run(1, lambda: len(local.waiting) == 2)
    for raw, done in reversed(local.waiting):
        done(switched(str(raw[-1])))
    assert sites.run(1, lambda: len(caller.outcomes) == 2)
    assert list(caller.got.values()) == [[switched("1")], [switched("0")]]


def test_a_restarted_client_proxy_calls_again_and_gets_nothing_of_its_former_incarnation(sites: Sites) -> None:
    _, client, local, caller = pair(sites)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    sites.restart(client)
    assert sites.run(10, caller.sees_server)
    local.waiting[0][1](switched("for the former life"))
    caller.call(switch(on=False))
    assert sites.run(3, lambda: local.asked == 2)
    local.waiting[1][1](switched("for the new one"))
    assert sites.run(2, lambda: bool(caller.got[1]))
    sites.run(1)
    assert caller.got == {0: [], 1: [switched("for the new one")]}


def test_a_restarted_server_proxy_serves_again(sites: Sites) -> None:
    server, _, local, caller = pair(sites)
    local.answer = lambda _: switched("yes")
    sites.restart(server)
    sites.run(READER.lease_s + 2)
    assert caller.sees_server()
    caller.call(switch(on=True))
    assert sites.run(0.5, lambda: caller.outcomes == [switched("yes")])


def test_one_of_two_servers_that_refuses_does_not_fail_the_call_and_both_do(sites: Sites) -> None:
    _, _, local, caller = pair(sites)
    other = sites.add(OTHER, expose=[SWITCH])
    second = LocalServer(other.graph)
    sites.run(3)
    local.answer = lambda _: "I cannot"
    caller.call(switch(on=True))
    sites.run(1)
    assert (caller.outcomes, local.asked, second.asked) == ([], 1, 1)
    second.waiting[0][1](switched("I can"))
    assert sites.run(1, lambda: caller.outcomes == [switched("I can")])
    second.answer = lambda _: "nor can I"
    caller.call(switch(on=True))
    assert sites.run(1, lambda: len(caller.got[1]) == 1)
    assert caller.got[1][0] in ("I cannot", "nor can I")


def test_one_of_two_servers_that_dies_does_not_fail_the_call(sites: Sites) -> None:
    server, _, local, caller = pair(sites, ", timeout_s: 60")
    other = sites.add(OTHER, expose=[SWITCH])
    second = LocalServer(other.graph)
    sites.run(3)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == second.asked == 1)
    sites.kill(server)
    sites.run(READER.lease_s + 2)
    assert caller.outcomes == []
    assert caller.sees_server()
    second.waiting[0][1](switched("yes"))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])


def test_a_call_goes_to_a_server_that_returns_in_the_moment_in_which_the_last_one_goes(
    sites: Sites, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, client, local, caller = pair(sites, ", timeout_s: 60")
    other = sites.add(OTHER, expose=[SWITCH])
    second = LocalServer(other.graph)
    sites.run(3)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == second.asked == 1)
    connected = list[Name]()
    monkeypatch.setattr(client.member.services, "peers", lambda _: connected)
    for label in (SERVER, OTHER):
        connected[:] = [sites.name(label)]
        sites.run(1)
    assert caller.outcomes == []
    second.waiting[0][1](switched("yes"))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])


def test_a_call_that_the_one_refused_fails_when_the_other_dies(sites: Sites) -> None:
    _, _, local, caller = pair(sites, ", timeout_s: 60")
    other = sites.add(OTHER, expose=[SWITCH])
    second = LocalServer(other.graph)
    sites.run(3)
    local.answer = lambda _: "I cannot"
    caller.call(switch(on=True))
    assert sites.run(1, lambda: second.asked == 1)
    sites.kill(other)
    assert sites.run(READER.lease_s + 2, lambda: caller.outcomes == ["the far server is gone"])


def test_a_request_above_the_rules_limit_fails_with_a_reason_and_the_next_is_served(sites: Sites) -> None:
    echo = "own_srvs/srv/Echo"
    rule = f"kind: service, name: /switch, type: {echo}, max_bytes: 1000"
    services = {echo: known.service(echo, "string text\n", "string text\n")}
    graphs = [FakeGraph(2, known.channels(), services) for _ in range(2)]
    server = sites.add(SERVER, expose=[rule], graph=graphs[0])
    client = sites.add(ROBOT, imports=[rule], graph=graphs[1])
    local = LocalServer(server.graph, type_name=echo, answer=lambda raw: known.string("y" * (len(raw) * 20)))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    for size in (2_000, 100, 10):
        caller.call(known.string("x" * size))
    assert sites.run(2, lambda: len(caller.outcomes) == 3)
    too_large, answer_too_large, fine = caller.outcomes
    assert isinstance(too_large, str)
    assert "max_bytes is 1000" in too_large
    assert isinstance(answer_too_large, str)
    assert "max_bytes is 1000" in answer_too_large
    assert isinstance(fine, bytes)
    assert local.asked == 2
    assert (client.faults["too-large"], server.faults["too-large"]) == (1, 1)


def test_a_request_that_does_not_fit_its_definition_fails_with_a_reason(sites: Sites) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH], ros=1), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: switched("yes", 1))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    caller.call(b"\0\1\0\0" + bytes(77))
    assert sites.run(1, lambda: len(caller.outcomes) == 1)
    assert isinstance(caller.outcomes[0], str)


def test_an_answer_that_does_not_fit_its_definition_fails_the_call_with_a_reason(sites: Sites) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH], ros=1), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: b"")
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: len(caller.outcomes) == 1)
    assert isinstance(caller.outcomes[0], str)


def test_calls_under_way_fail_when_the_clients_proxy_drops_the_rule(sites: Sites) -> None:
    _, client, local, caller = pair(sites)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    sites.reload(client)
    assert sites.run(1, lambda: caller.outcomes == ["the proxy no longer carries this service"])
    assert not caller.sees_server()


def test_a_message_for_a_client_that_is_not_connected_is_counted_as_unread_once(sites: Sites) -> None:
    server, _, _, _ = pair(sites)
    ((_, flow),) = server.bridge.flows
    assert isinstance(flow, ExposedService)
    flow._responses.send_wire(Name(b"g" * 32), b"an answer")
    assert (server.context.traffic.unread, server.context.traffic.messages_out) == (1, 0)
