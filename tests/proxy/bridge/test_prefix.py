"""Prefix of a whole robot, from end to end, and names that are denied."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Sites, named
from tests.proxy.bridge.test_actions import RULE as FOLD
from tests.proxy.bridge.test_actions import ActionClient, ActionServer

CHATTER = f"name: /chatter, type: {STRING}"
MINE = "prefix: robot1"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def test_a_topic_of_a_robot_arrives_under_its_prefix_by_a_pattern_of_the_station(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[f"{CHATTER}, {MINE}"])
    station = sites.add(SERVER, imports=["name: /robot1/*"], holds=[named("/robot1/chatter")])
    ear, talker = Ear(station.graph, "/robot1/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])


def test_a_pattern_of_a_robot_has_its_prefix_and_the_station_may_take_it_away(sites: Sites) -> None:
    held = [named("/robot1/chatter")]
    robot = sites.add(ROBOT, expose=[f"name: /**, {MINE}"], holds=held)
    station = sites.add(SERVER, imports=[f"name: /**, {MINE}"], holds=held)
    ear, talker = Ear(station.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])


def test_a_command_to_the_prefixed_name_arrives_under_the_local_name(sites: Sites) -> None:
    station = sites.add(SERVER, expose=[f"name: /robot1/cmd, type: {STRING}"])
    robot = sites.add(ROBOT, imports=[f"name: /cmd, type: {STRING}, {MINE}"])
    ear, talker = Ear(robot.graph, "/cmd"), station.graph.publish("/joystick", "/robot1/cmd", STRING)
    assert sites.run(3, station.is_read)
    talker.publish(string("go"))
    assert sites.run(1, lambda: ear.texts == ["go"])


def test_a_service_of_a_robot_is_called_under_its_prefix(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[f"kind: service, name: /switch, type: {SET_BOOL}, {MINE}"])
    station = sites.add(SERVER, imports=[f"kind: service, name: /robot1/switch, type: {SET_BOOL}"])
    LocalServer(robot.graph, answer=lambda raw: switched(f"got {raw[-1]}"))
    caller = Client(station.graph, "/robot1/switch")
    assert sites.run(3, caller.sees_server)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("got 1")])


def test_an_action_of_a_robot_is_seen_where_the_prefix_is_taken_away(sites: Sites) -> None:
    robot = sites.add(SERVER, expose=[f"{FOLD}, {MINE}"])
    station = sites.add(ROBOT, imports=[f"{FOLD}, {MINE}"])
    ActionServer(robot.graph)
    assert sites.run(3, ActionClient(station.graph).sees_server)


def test_robots_with_one_file_and_two_prefixes_do_not_mix(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[f"{CHATTER}, {MINE}"])
    station = sites.add(SERVER, imports=[f"{CHATTER}, prefix: robot2"])
    Ear(station.graph, "/chatter")
    robot.graph.publish("/talker", "/chatter", STRING)
    sites.run(2)
    assert not robot.is_read()
