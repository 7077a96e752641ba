"""Liveliness: who publishes, reads, serves and calls a name, and what changes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from proxy.bridge.liveliness import LivelinessTracker, NameLiveliness, Party, names_from_fields
from proxy.bridge.status_topic import StatusTopic, string_message
from proxy.config.status_topic import StatusTopicConfig
from proxy.endpoints.core.qos import default
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switched, text_of
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites

CHATTER = f"name: /chatter, type: {STRING}"
SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"
NODE = "ab" * 32


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def roles(machine: Machine, sites: Sites) -> set[str]:
    return {party.role for name in machine.bridge.liveliness(sites.now_s) for party in name.parties}


def name(*parties: Party) -> NameLiveliness:
    return NameLiveliness("topic", "/scan", "/robot1/scan", False, True, parties)


def changes(tracker: LivelinessTracker, now_s: float, *parties: Party) -> list[str]:
    return [each.change for each in tracker.update([name(*parties)], now_s)]


def test_both_ends_of_a_topic_know_each_other_and_when_it_was_heard(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    sites.run(2)
    (publisher,) = server.bridge.liveliness(sites.now_s)[0].parties
    assert publisher.node == sites.name(ROBOT).to_text()
    assert 1.5 < (publisher.heard_ago_s or 0.0) < 3.5
    assert [each.role for each in robot.bridge.liveliness(sites.now_s)[0].parties] == ["reader"]


def test_both_ends_of_a_service_know_each_other(sites: Sites) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: switched("done"))
    assert sites.run(3, Client(client.graph).sees_server)
    assert sites.run(1, lambda: (roles(server, sites), roles(client, sites)) == ({"client"}, {"server"}))


def test_a_topic_that_no_local_node_reads_is_not_joined(sites: Sites) -> None:
    server = sites.add(SERVER, imports=[CHATTER])
    sites.run(1)
    assert [each.is_joined for each in server.bridge.liveliness(sites.now_s)] == [False]


def test_a_publisher_appears_is_silent_is_heard_and_goes() -> None:
    tracker = LivelinessTracker(2.0)
    assert changes(tracker, 10.0, Party("publisher", NODE)) == ["appears"]
    assert changes(tracker, 11.0, Party("publisher", NODE)) == []
    assert changes(tracker, 12.1, Party("publisher", NODE)) == ["silent"]
    assert changes(tracker, 13.0, Party("publisher", NODE, 0.1)) == ["heard"]
    assert changes(tracker, 16.0, Party("publisher", NODE, 3.1)) == ["silent"]
    assert changes(tracker, 17.0) == ["goes"]


def test_a_deadline_is_for_publishers_and_others_are_silent_when_they_stop_reporting() -> None:
    tracker = LivelinessTracker(2.0)
    assert changes(tracker, 10.0, Party("reader", NODE)) == ["appears"]
    assert changes(tracker, 20.0, Party("reader", NODE)) == []
    assert changes(tracker, 21.0, Party("reader", NODE, is_silent=True)) == ["silent"]


def test_a_status_is_read_as_it_was_written() -> None:
    written = [name(Party("publisher", NODE, 1.5), Party("reader", NODE, is_silent=True))]
    assert [each.to_fields() for each in names_from_fields([each.to_fields() for each in written])] == [
        each.to_fields() for each in written
    ]


@pytest.mark.parametrize("ros", [1, 2])
def test_the_status_text_is_a_string_of_either_ros(ros: int) -> None:
    assert text_of(string_message("grüße", 2 if ros == 2 else 1), 2 if ros == 2 else 1) == "grüße"


def test_the_status_topic_is_latched_and_follows_what_changes(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    (dispatcher,) = server.bridge._dispatchers
    server.bridge._status_topics = [StatusTopic(dispatcher, StatusTopicConfig())]
    Ear(server.graph, "/chatter")
    robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    sites.run(1)
    late = Ear(server.graph, "/gdp_status", qos=default(latched=True))
    sites.run(1)
    (shown,) = json.loads(late.texts[-1])["names"]
    assert (shown["local"], [each["role"] for each in shown["parties"]]) == ("/chatter", ["publisher"])
