"""Topics from one graph to another: participants that come and go, reachability, and local names that stay local."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest

from gdp.intervals import READER
from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites, named
from tests.proxy.endpoints.fake import Publication

CHATTER = f"name: /chatter, type: {STRING}"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def talk(machine: Machine, topic: str = "/chatter", node: str = "/talker") -> Publication:
    return machine.graph.publish(node, topic, STRING)


def pair(sites: Sites, out: str = CHATTER, into: str = CHATTER) -> tuple[Machine, Machine]:
    """Return a machine that exposes, and one that imports."""
    return sites.add(ROBOT, expose=[out]), sites.add(SERVER, imports=[into])


def flowing(sites: Sites, out: str = CHATTER) -> tuple[Machine, Machine, Publication, Ear]:
    """Return both machines, with a talker at the one and a listener at the other that have found each other."""
    robot, server = pair(sites, out)
    ear, talker = Ear(server.graph, "/chatter"), talk(robot)
    assert sites.run(3, robot.is_read)
    return robot, server, talker, ear


def test_messages_reach_a_far_listener_in_order(sites: Sites) -> None:
    _, _, talker, ear = flowing(sites)
    sites.every(0.01, 50, lambda number: talker.publish(string(str(number))))
    assert sites.run(2, lambda: len(ear.heard) == 50)
    assert ear.texts == [str(number) for number in range(50)]


def test_the_listener_shows_a_virtual_publisher_and_the_talker_a_virtual_subscription(sites: Sites) -> None:
    robot, server, _, _ = flowing(sites)
    assert [each.end.node for each in server.graph.publications if each.end.name == "/chatter"] == [
        server.endpoint._node
    ]
    assert [each.end.node for each in robot.graph.subscriptions("/chatter", STRING)] == [robot.endpoint._node]


def test_the_first_message_of_a_late_talker_arrives_if_it_waits_for_its_reader(sites: Sites) -> None:
    robot, server = pair(sites)
    ear = Ear(server.graph, "/chatter")
    sites.run(20)
    talker = talk(robot)
    assert sites.run(1, robot.is_read)
    talker.publish(string("first"))
    assert sites.run(0.2, lambda: ear.texts == ["first"])


def test_a_talker_that_leaves_is_withdrawn_and_one_that_returns_goes_on_above_its_numbers(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    talker.publish(string("before"))
    assert sites.run(1, lambda: len(ear.heard) == 1)
    talker.close()
    assert sites.run(
        READER.lease_s + 1,
        lambda: not list(robot.member.publications) and not list(server.member.subscriptions.writer_proxies()),
    )
    talker = talk(robot)
    assert sites.run(1, robot.is_read)
    talker.publish(string("after"))
    assert sites.run(1, lambda: len(ear.heard) == 2)
    assert ear.texts == ["before", "after"]
    assert [stats.duplicated for stats in server.bridge.stats] == [0]


def test_the_last_messages_of_a_publisher_that_leaves_at_once_arrive(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites)
    talker.publish(string("goodbye"))
    talker.close()
    assert sites.run(1, lambda: ear.texts == ["goodbye"])
    assert sites.run(READER.lease_s + 1, lambda: not list(robot.member.publications))


@pytest.mark.parametrize("size", [20, 60_000])
def test_the_last_message_of_a_publisher_that_leaves_at_once_arrives_by_a_thin_link_that_loses_it(
    sites: Sites, size: int
) -> None:
    robot, _, talker, ear = flowing(sites)
    lead = sites.world.leads[robot.label]
    lead.bytes_s, lead.fifo_s = 1e6 / 8, 0.1  # 0.5 s for the large one
    lead.loss = 1.0
    sites.world.network.call(0.2, partial(setattr, lead, "loss", 0.01))
    talker.publish(string("x" * size))
    talker.close()
    assert sites.run(5, lambda: len(ear.heard) == 1)
    assert sites.run(READER.lease_s + 1, lambda: not list(robot.member.publications))
    assert robot.faults == {}


def test_messages_that_stay_unconfirmed_after_their_publisher_has_gone_are_reported(sites: Sites) -> None:
    robot, _, talker, _ = flowing(sites)
    sites.world.leads[robot.label].loss = 1.0
    for number in range(3):
        talker.publish(string(str(number)))
    talker.close()
    sites.run(9)
    assert (len(list(robot.member.publications)), robot.faults) == (1, {})
    assert sites.run(2, lambda: not list(robot.member.publications))
    assert robot.faults == {"unconfirmed": 1}


def test_a_publisher_that_returns_while_its_last_messages_are_under_way_goes_on(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites)
    lead = sites.world.leads[robot.label]
    lead.loss = 1.0
    talker.publish(string("last"))
    talker.close()
    sites.run(0.3)
    again = talk(robot)
    sites.run(0.1)
    lead.loss = 0.0
    assert sites.run(10, robot.is_read)
    again.publish(string("again"))
    assert sites.run(2, lambda: ear.texts[-1:] == ["again"])
    assert robot.faults == {"unconfirmed": 1}  # what the first one sent last is reported, not confirmed


def test_a_rule_that_ends_ends_its_flow_at_once(sites: Sites) -> None:
    robot, _, talker, _ = flowing(sites)
    sites.world.leads[robot.label].loss = 1.0
    talker.publish(string("last"))
    sites.run(0.1)
    sites.reload(robot)
    sites.run(0.2)
    assert not list(robot.member.publications)


def test_a_message_that_arrives_when_its_flow_has_ended_is_counted(
    sites: Sites, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, server, talker, ear = flowing(sites)
    with monkeypatch.context() as busy:
        busy.setattr(server.member, "poll_messages", list)  # what comes is not read yet
        talker.publish(string("too late"))
        sites.run(0.2)
        sites.reload(server)
    sites.run(0.2)
    assert (server.context.traffic.unread, ear.texts) == (1, [])


def test_two_talkers_of_one_topic_are_both_heard_and_one_may_leave(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites)
    other = talk(robot, node="/other")
    sites.run(1)
    talker.publish(string("one"))
    other.publish(string("two"))
    talker.close()
    sites.run(1)
    other.publish(string("three"))
    assert sites.run(1, lambda: len(ear.heard) == 3)
    assert sorted(ear.texts) == ["one", "three", "two"]


def test_the_tree_stands_only_while_somebody_local_reads(sites: Sites) -> None:
    robot, server = pair(sites)
    talk(robot)
    sites.run(3)
    assert [each.topic for each in server.member.subscriptions] == []
    ear = Ear(server.graph, "/chatter")
    assert sites.run(1, robot.is_read)
    ear.leave()
    assert sites.run(1, lambda: not [each.topic for each in server.member.subscriptions] and robot.is_read(0))
    again = Ear(server.graph, "/chatter")
    assert sites.run(1, robot.is_read)
    robot.graph.publications[-1].publish(string("again"))
    assert sites.run(1, lambda: again.texts == ["again"])


def test_readers_on_several_machines_each_hear_a_message_once(sites: Sites) -> None:
    robot, server, talker, ear = flowing(sites)
    third = sites.add("nuc3/third", imports=[CHATTER])
    ears = [ear, Ear(server.graph, "/chatter", node="/second"), Ear(third.graph, "/chatter")]
    assert sites.run(2, lambda: robot.is_read(2))
    talker.publish(string("all"))
    sites.run(1)
    assert [each.texts for each in ears] == [["all"]] * 3


def test_what_no_rule_names_stays_local(sites: Sites) -> None:
    robot, server, _, _ = flowing(sites)
    private = talk(robot, "/secret")
    ear = Ear(server.graph, "/secret")
    sites.run(2)
    private.publish(string("?"))
    sites.run(2)
    assert (ear.heard, robot.carried, server.carried) == ([], {("/chatter", True)}, {("/chatter", False)})


def test_messages_without_a_far_reader_are_counted_and_not_sent(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[CHATTER])
    talker = talk(robot)
    sites.run(2)
    talker.publish(string("kept for readers that wait"))
    sites.run(READER.lease_s + 1)
    talker.publish(string("?"))
    sites.run(1)
    assert (robot.context.traffic.unread, robot.stream.losses.total) == (1, 2)


def test_each_side_may_call_the_topic_otherwise(sites: Sites) -> None:
    robot, server = pair(sites, f"{CHATTER}, remap: /said", f"{CHATTER}, remap: /robot/chatter")
    ear, talker = Ear(server.graph, "/robot/chatter"), talk(robot, "/said")
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])


def test_a_pattern_carries_what_is_delegated_and_tells_what_is_not(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    granted = [named("/camera/left"), named("/camera/right")]
    robot = sites.add(ROBOT, expose=["name: /camera/*"], holds=granted)
    server = sites.add(SERVER, imports=["name: /camera/*"], holds=granted)
    talkers = [talk(robot, f"/camera/{side}") for side in ("left", "right", "third")]
    ears = [Ear(server.graph, f"/camera/{side}") for side in ("left", "right", "third")]
    assert sites.run(3, lambda: robot.is_read() and len(list(robot.member.publications)) == 2)
    for talker in talkers:
        talker.publish(string("?"))
    sites.run(1)
    assert [len(ear.heard) for ear in ears] == [1, 1, 0]
    (exposing, importing) = (text for text in caplog.messages if "no-delegation" in text)
    assert "gdp delegate" in exposing
    assert "no delegation to publish" in exposing
    assert "/camera/third" in exposing
    assert "no delegation to read" in importing


def test_the_type_of_a_rule_may_be_discovered(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=["name: /chatter"], holds=[named("/chatter")])
    server = sites.add(SERVER, imports=["name: /chatter"], holds=[named("/chatter")])
    ear, talker = Ear(server.graph, "/chatter"), talk(robot)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])


def test_a_rate_limit_thins_evenly_and_counts(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites, f"{CHATTER}, max_hz: 10")
    sites.every(0.01, 200, lambda number: talker.publish(string(str(number))))
    sites.run(3)
    assert 19 <= len(ear.heard) <= 21
    assert robot.context.traffic.thinned == 200 - len(ear.heard)
    numbers = [int(text) for text in ear.texts]
    assert all(4 <= after - before <= 12 for before, after in pairwise(numbers))


def test_a_rate_limit_lets_a_slower_topic_pass_whole(sites: Sites) -> None:
    robot, _, talker, ear = flowing(sites, f"{CHATTER}, max_hz: 10")
    sites.every(0.1, 50, lambda number: talker.publish(string(str(number))))
    sites.run(6)
    assert (len(ear.heard), robot.context.traffic.thinned) == (50, 0)


def test_the_limits_of_an_import_hold_where_it_is(sites: Sites) -> None:
    robot, server = pair(sites, into=f"{CHATTER}, max_hz: 10, max_bytes: 100")
    third = sites.add("nuc3/third", imports=[CHATTER])
    thinned, whole = Ear(server.graph, "/chatter"), Ear(third.graph, "/chatter")
    talker = talk(robot)
    assert sites.run(3, lambda: robot.is_read(2))
    sites.every(0.01, 200, lambda number: talker.publish(string(str(number))))
    sites.run(3)
    talker.publish(string("x" * 200))
    sites.run(1)
    assert 19 <= len(thinned.heard) <= 22
    assert len(whole.heard) == 201
    assert server.faults == {"too-large": 1}
    assert server.context.traffic.thinned == 200 - len(thinned.heard)


def test_a_message_above_the_rules_limit_is_reported_once_and_the_rest_flows(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot, _, talker, ear = flowing(sites, f"{CHATTER}, max_bytes: 100")
    for text in ("x" * 200, "y" * 300, "small"):
        talker.publish(string(text))
    assert sites.run(1, lambda: ear.texts == ["small"])
    assert robot.faults == {"too-large": 2}
    (reported,) = caplog.messages
    assert reported.startswith("/chatter: too-large: ")


def test_a_talker_faster_than_the_path_is_reported_once_and_goes_on_later(
    sites: Sites, caplog: pytest.LogCaptureFixture
) -> None:
    robot, server, talker, ear = flowing(sites, f"{CHATTER}, encoding: cdr")
    sites.world.leads[SERVER].loss = 1.0
    big = string("x" * 5_000_000)
    for number in range(12):
        sites.world.network.call(0.1 * number, lambda: talker.publish(big))
    sites.run(2)
    assert robot.faults["too-fast"] >= 3
    assert len(caplog.messages) == 1
    sites.world.leads[SERVER].loss = 0.0
    assert sites.run(30, lambda: robot.is_read() and robot.stream.is_acknowledged())
    talker.publish(string("after"))
    assert sites.run(10, lambda: "after" in (text[:5] for text in ear.texts))
    assert server.faults == {}
