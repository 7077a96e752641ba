"""Loops and doubled bridges: nothing circulates and nothing is delivered twice, whichever bridge leads."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.proxy.bridge import known
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites
from tests.proxy.endpoints.fake import FakeGraph

CHATTER = f"name: /chatter, type: {STRING}"
CONVERTER, FAR_CONVERTER = "nuc1/twin", "nuc5/twin"
BOTH = (CHATTER,)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def graph() -> FakeGraph:
    return FakeGraph(2, known.channels(), known.services())


def streams(*machines: Machine) -> list[Machine]:
    """Return the proxies that publish on the overlay."""
    return [machine for machine in machines if list(machine.member.publications)]


def carried(*machines: Machine) -> int:
    """Return how many messages they have sent out."""
    return sum(machine.context.traffic.messages_out for machine in machines)


def test_a_topic_both_exposed_and_imported_does_not_circulate(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=BOTH, imports=BOTH), sites.add(SERVER, expose=BOTH, imports=BOTH)
    ears = Ear(robot.graph, "/chatter"), Ear(server.graph, "/chatter")
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("once"))
    sites.run(5)
    assert [ear.texts for ear in ears] == [["once"], ["once"]]
    assert carried(robot, server) == 1


def test_talkers_on_both_sides_of_one_topic_are_heard_once_everywhere(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=BOTH, imports=BOTH), sites.add(SERVER, expose=BOTH, imports=BOTH)
    ears = Ear(robot.graph, "/chatter"), Ear(server.graph, "/chatter")
    talkers = [machine.graph.publish("/talker", "/chatter", STRING) for machine in (robot, server)]
    assert sites.run(3, lambda: robot.is_read() and server.is_read())
    for number in range(10):
        for at, talker in enumerate(talkers):
            talker.publish(string(f"{at} {number}"))
        sites.run(0.05)
    sites.run(5)
    expected = sorted(f"{at} {number}" for at in range(2) for number in range(10))
    assert [sorted(ear.texts) for ear in ears] == [expected, expected]
    assert carried(robot, server) == 20


def test_two_proxies_on_one_graph_send_a_message_once(sites: Sites) -> None:
    shared = graph()
    twins = sites.add(ROBOT, expose=[CHATTER], graph=shared), sites.add(CONVERTER, expose=[CHATTER], graph=shared)
    server = sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), shared.publish("/talker", "/chatter", STRING)
    sites.run(5)
    assert len(streams(*twins)) == 1
    talker.publish(string("once"))
    sites.run(5)
    assert ear.texts == ["once"]


def test_two_proxies_on_one_graph_bring_a_message_in_once(sites: Sites) -> None:
    shared = graph()
    twins = (
        sites.add(SERVER, imports=[CHATTER], graph=shared),
        sites.add(FAR_CONVERTER, imports=[CHATTER], graph=shared),
    )
    robot = sites.add(ROBOT, expose=[CHATTER])
    ear, talker = Ear(shared, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    sites.run(5)
    talker.publish(string("once"))
    sites.run(5)
    assert ear.texts == ["once"]
    assert sorted(len(converter.bridge.flows) for converter in twins) == [0, 1]


def test_two_proxies_on_each_graph_that_expose_and_import_the_same_topic(sites: Sites) -> None:
    left, right = graph(), graph()
    machines = [
        sites.add(label, graph=shared, expose=BOTH, imports=BOTH)
        for label, shared in ((ROBOT, left), (CONVERTER, left), (SERVER, right), (FAR_CONVERTER, right))
    ]
    ears = Ear(left, "/chatter"), Ear(right, "/chatter")
    talkers = [each.publish("/talker", "/chatter", STRING) for each in (left, right)]
    sites.run(5)
    for number in range(20):
        for at, talker in enumerate(talkers):
            talker.publish(string(f"{at} {number}"))
        sites.run(0.05)
    sites.run(5)
    expected = sorted(f"{at} {number}" for at in range(2) for number in range(20))
    assert [sorted(ear.texts) for ear in ears] == [expected, expected]
    assert carried(*machines) == 40


def test_a_proxy_that_exposes_next_to_one_that_imports_does_not_send_messages_back(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    shared = graph()
    sites.add(ROBOT, expose=[CHATTER], graph=shared)
    sites.add(CONVERTER, imports=[CHATTER], graph=shared)
    far = sites.add(SERVER, expose=BOTH, imports=BOTH)
    ears = Ear(shared, "/chatter"), Ear(far.graph, "/chatter")
    talkers = [each.publish("/talker", "/chatter", STRING) for each in (shared, far.graph)]
    sites.run(5)
    for text, talker in zip(("near", "far"), talkers, strict=True):
        talker.publish(string(text))
    sites.run(5)
    assert "near" in ears[0].texts
    assert "far" in ears[1].texts
    assert all(len(ear.texts) == len(set(ear.texts)) for ear in ears)
    # one direction stays closed
    assert len([text for text in caplog.messages if text.startswith("/chatter: other-bridge: ")]) == 1


@pytest.mark.parametrize("is_killed", [False, True], ids=["goes", "dies"])
def test_the_other_bridge_takes_over_within_a_second_when_the_leading_proxy(sites: Sites, *, is_killed: bool) -> None:
    shared = graph()
    twins = sites.add(ROBOT, expose=[CHATTER], graph=shared), sites.add(CONVERTER, expose=[CHATTER], graph=shared)
    server = sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), shared.publish("/talker", "/chatter", STRING)
    sites.run(5)
    (leading,) = streams(*twins)
    (other,) = (converter for converter in twins if converter is not leading)
    talker.publish(string("1"))
    sites.run(1)
    if is_killed:
        sites.kill(leading)
    else:
        sites.leave(leading)
    assert sites.run(1, other.is_read)
    talker.publish(string("2"))
    sites.run(5)
    assert ear.texts == ["1", "2"]


def test_a_proxy_of_higher_rank_that_comes_later_takes_over_without_a_message_twice(sites: Sites) -> None:
    shared = graph()
    names = {label: sites.name(label) for label in (ROBOT, CONVERTER)}
    late, early = sorted(names, key=lambda label: names[label])
    first = sites.add(early, expose=[CHATTER], graph=shared)
    server = sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), shared.publish("/talker", "/chatter", STRING)
    assert sites.run(5, first.is_read)
    sites.every(0.05, 100, lambda number: talker.publish(string(str(number))))
    sites.run(2)
    second = sites.add(late, expose=[CHATTER], graph=shared)
    sites.run(6)
    assert len(streams(first, second)) == 1
    assert len(ear.texts) == len(set(ear.texts))
    assert len(ear.texts) >= 90


def test_two_bridges_of_a_service_serve_it_once(sites: Sites) -> None:
    shared, rule = graph(), f"kind: service, name: /switch, type: {known.SET_BOOL}"
    local = LocalServer(shared, answer=lambda _: switched("yes"))
    twins = sites.add(SERVER, expose=[rule], graph=shared), sites.add(FAR_CONVERTER, expose=[rule], graph=shared)
    client = sites.add(ROBOT, imports=[rule])
    sites.run(5)
    assert len(streams(*twins)) == 1
    caller = Client(client.graph)
    caller.call(switch(on=True))
    sites.run(2)
    assert (local.asked, caller.outcomes) == (1, [switched("yes")])


def test_two_bridges_that_import_a_service_call_it_once_and_the_other_takes_over(sites: Sites) -> None:
    shared, rule = graph(), f"kind: service, name: /switch, type: {known.SET_BOOL}"
    far = sites.add(SERVER, expose=[rule])
    local = LocalServer(far.graph, answer=lambda _: switched("yes"))
    twins = sites.add(ROBOT, imports=[rule], graph=shared), sites.add(CONVERTER, imports=[rule], graph=shared)
    caller = Client(shared)
    sites.run(5)
    assert len(shared.servers) == 1
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])
    sites.leave(next(converter for converter in twins if converter.bridge.flows))
    assert sites.run(1.5, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: len(caller.outcomes) == 2)
    assert (caller.outcomes, local.asked) == ([switched("yes")] * 2, 2)


def test_the_virtual_server_of_one_proxy_is_not_exposed_by_another(sites: Sites) -> None:
    shared, rule = graph(), f"kind: service, name: /switch, type: {known.SET_BOOL}"
    far = sites.add(SERVER, expose=[rule])
    LocalServer(far.graph)
    importing = sites.add(ROBOT, imports=[rule], graph=shared)
    exposing = sites.add(CONVERTER, expose=[rule], graph=shared)
    sites.run(5)
    assert len(importing.bridge.flows) == 1
    assert shared.servers
    assert exposing.bridge.flows == []
    assert not list(exposing.member.publications)
