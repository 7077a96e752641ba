"""Reload of rules and delegations while messages flow."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from gdp.client.participant import Topic
from proxy.bridge.flow_rows import topic_counts
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Granted, Machine, Sites, named
from tests.proxy.endpoints.fake import Publication

CHATTER = f"name: /chatter, type: {STRING}"
OTHER = f"name: /other, type: {STRING}"
SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def flowing(sites: Sites) -> tuple[Machine, Machine, Publication, Ear]:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    return robot, server, talker, ear


def test_a_rule_that_is_added_carries_and_the_untouched_one_loses_nothing(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    other, more = Ear(server.graph, "/other"), robot.graph.publish("/talker", "/other", STRING)
    sites.every(0.005, 600, lambda number: talker.publish(string(str(number))))
    sites.run(1)
    sites.reload(robot, expose=[OTHER, CHATTER])
    sites.reload(server, imports=[OTHER, CHATTER])
    assert sites.run(1, lambda: robot.is_read() and len(list(robot.member.publications)) == 2)
    more.publish(string("hello"))
    sites.run(3)
    assert other.texts == ["hello"]
    assert ear.texts == [str(number) for number in range(600)]


def test_flows_that_begin_and_end_later_are_reported_each_once(sites: Sites) -> None:
    robot, _, _, _ = flowing(sites)
    assert [(each.flow_spec.local, each.is_begun) for each in robot.bridge.poll_changes()] == [("/chatter", True)]
    sites.reload(robot, expose=[OTHER])
    robot.graph.publish("/talker", "/other", STRING)
    assert sites.run(1, lambda: robot.carried == {("/other", True)})
    changes = {(each.flow_spec.local, each.is_begun) for each in robot.bridge.poll_changes()}
    assert changes == {("/chatter", False), ("/other", True)}
    assert robot.bridge.poll_changes() == []


def test_metrics_have_a_row_for_each_topic_and_no_name_unless_it_is_allowed(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    (out,), (into,) = (topic_counts(each.bridge.flows, has_names=True) for each in (robot, server))
    assert (out.topic, out.direction, out.messages, out.lost, out.readers) == ("/chatter", "out", 1, 0, 1)
    assert (into.topic, into.direction, into.messages, into.size) == ("/chatter", "in", 1, out.size)
    (secret,) = topic_counts(robot.bridge.flows, has_names=False)
    assert secret.topic == robot.bridge.flows[0][0].name.short


def test_a_rule_that_is_removed_carries_no_more_and_the_untouched_one_loses_nothing(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    sites.reload(robot, expose=[CHATTER, OTHER])
    sites.reload(server, imports=[CHATTER, OTHER])
    other, more = Ear(server.graph, "/other"), robot.graph.publish("/talker", "/other", STRING)
    assert sites.run(2, lambda: robot.is_read() and len(list(robot.member.publications)) == 2)
    sites.every(0.005, 400, lambda number: talker.publish(string(str(number))))
    sites.run(0.5)
    sites.reload(robot, expose=[CHATTER])
    sites.run(0.5)
    more.publish(string("private"))
    sites.reload(server, imports=[CHATTER])
    sites.run(3)
    assert (other.heard, robot.carried, server.carried) == ([], {("/chatter", True)}, {("/chatter", False)})
    assert not [each for each in server.graph.publications if each.end.name == "/other"]
    assert ear.texts == [str(number) for number in range(400)]


def test_a_rule_that_changes_holds_from_then_on(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites)
    sites.reload(robot, expose=[f"{CHATTER}, max_bytes: 50"])
    sites.run(1)
    assert robot.is_read()
    for text in ("x" * 100, "small"):
        talker.publish(string(text))
    sites.run(1)
    assert ear.texts == ["small"]


def test_a_rule_of_another_encoding_goes_on_above_the_numbers(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    for number, encoding in enumerate(("cbor", "cdr", "json")):
        talker.publish(string(f"{number}"))
        sites.run(0.5)
        sites.reload(robot, expose=[f"{CHATTER}, encoding: {encoding}"])
        assert sites.run(3, robot.is_read)
        sites.run(0.5)
    talker.publish(string("3"))
    sites.run(1)
    assert ear.texts == ["0", "1", "2", "3"]
    assert [stats.duplicated for stats in server.bridge.stats] == [0]


def test_a_new_epoch_takes_effect_without_a_message_lost(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    sites.every(0.005, 600, lambda number: talker.publish(string(str(number))))
    for at, machine in ((1.0, server), (1.5, robot)):
        sites.world.network.call(at, partial(renew, sites, machine, {1: 1, 2: 7}))
    sites.run(5)
    assert ear.texts == [str(number) for number in range(600)]
    assert (robot.faults, server.faults) == ({}, {})


def renew(sites: Sites, machine: Machine, fills: dict[int, int]) -> None:
    """Give a machine the secrets of more epochs."""
    config = machine.bridge.rules
    held = sites.held(machine.member, config)
    more = {epoch: bytes([fill]) * 32 for epoch, fill in fills.items() if epoch > 1}
    topics = [Topic(each.delegation, {**each.secrets, **more}) for each in held]
    machine.bridge.reload(config, Granted(held.directory, topics))


def test_a_delegation_that_comes_later_is_found_by_a_reload(sites: Sites, caplog: pytest.LogCaptureFixture) -> None:
    robot = sites.add(ROBOT, expose=[CHATTER], holds=[])
    server = sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    sites.run(2)
    assert robot.faults == {"no-delegation": 1}
    assert [text for text in caplog.messages if text.startswith("/chatter: no-delegation: ")]
    sites.reload(robot, expose=[CHATTER])
    assert sites.run(1, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])


def test_a_delegation_that_is_gone_ends_its_flow(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites)
    sites.reload(robot, expose=[CHATTER], holds=[])
    sites.run(1)
    talker.publish(string("not any more"))
    sites.run(2)
    assert (ear.heard, robot.carried) == ([], set())


def test_a_pattern_takes_what_a_removed_rule_named_without_a_number_again(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    talker.publish(string("1"))
    sites.run(0.5)
    sites.reload(robot, expose=["name: /chat*"], holds=[named("/chatter")])
    assert sites.run(3, robot.is_read)
    talker.publish(string("2"))
    sites.run(1)
    assert ear.texts == ["1", "2"]
    assert [stats.duplicated for stats in server.bridge.stats] == [0]


def test_calls_under_way_go_on_through_a_reload_of_other_rules(sites: Sites) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    local, caller = LocalServer(server.graph), Client(client.graph)
    assert sites.run(3, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: local.asked == 1)
    sites.reload(server, expose=[OTHER, SWITCH])
    sites.reload(client, imports=[OTHER, SWITCH])
    sites.run(1)
    local.waiting[0][1](switched("yes"))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])


def test_a_server_whose_rule_changes_is_understood_from_then_on(sites: Sites) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: switched("yes"))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    for encoding in ("cbor", "cdr", "json"):
        sites.reload(server, expose=[f"{SWITCH}, encoding: {encoding}"])
        sites.run(2)
        assert caller.sees_server()
        caller.call(switch(on=True))
        sites.run(1)
    assert caller.outcomes == [switched("yes")] * 3
    assert (server.faults, client.faults) == ({}, {})


def test_a_client_whose_rule_changes_is_understood_from_then_on(sites: Sites) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: switched("yes"))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    for encoding in ("cbor", "cdr", "json"):
        sites.reload(client, imports=[f"{SWITCH}, encoding: {encoding}"])
        sites.run(2)
        assert caller.sees_server()
        caller.call(switch(on=True))
        sites.run(1)
    assert caller.outcomes == [switched("yes")] * 3
    assert (server.faults, client.faults) == ({}, {})


def test_a_pattern_that_is_added_and_removed_costs_the_untouched_topic_nothing(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    image = robot.graph.publish("/camera", "/camera/left/image", STRING)
    view = Ear(server.graph, "/camera/left/image")
    sites.every(0.005, 800, lambda number: talker.publish(string(str(number))))
    sites.run(0.5)
    sites.reload(robot, expose=["name: /camera/**", CHATTER], holds=[named("/chatter")])
    assert sites.run(1, lambda: bool(robot.bridge.undelegated))
    sites.reload(robot, expose=["name: /camera/**", CHATTER], holds=[named("/chatter"), named("/camera/left/image")])
    sites.reload(server, imports=[f"name: /camera/left/image, type: {STRING}", CHATTER])
    assert sites.run(2, lambda: robot.is_read() and len(list(robot.member.publications)) == 2)
    image.publish(string("an image"))
    assert sites.run(1, lambda: view.texts == ["an image"])
    sites.reload(robot, expose=[CHATTER])
    sites.run(4)
    assert robot.carried == {("/chatter", True)}
    assert ear.texts == [str(number) for number in range(800)]


def test_what_a_rule_finds_without_a_delegation_is_listed_until_it_has_one(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=["name: /camera/**"], holds=[])
    camera = robot.graph.publish("/camera", "/camera/image", STRING)
    robot.graph.publish("/talker", "/chatter", STRING)
    sites.run(1)
    (lacking,) = robot.bridge.undelegated
    assert (lacking.local, lacking.type_name, lacking.is_exposed) == ("/camera/image", STRING, True)
    sites.reload(robot, expose=["name: /camera/**"], holds=[named("/camera/image")])
    sites.run(1)
    assert robot.bridge.undelegated == []
    camera.close()
    sites.reload(robot, expose=["name: /camera/**"], holds=[])
    sites.run(1)
    assert robot.bridge.undelegated == []
