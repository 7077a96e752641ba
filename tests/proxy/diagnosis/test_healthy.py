"""A system without a fault raises no alarm."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.diagnosis.answer import Cause
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, string, switch, switched
from tests.proxy.bridge.sites import Ear
from tests.proxy.diagnosis.stage import ROBOT, SERVER, Stage

TWO_DOMAINS = Topology(
    (Link("s1", "s3"),),
    (DomainPlan("top", ("s1",)), DomainPlan("line", ("s3",), upper="top")),
    (Attachment("s1", "rib", "rib"), Attachment("s3", "rib", "rib")),
)
SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


@pytest.mark.parametrize("at", [ROBOT, SERVER])
def test_a_topic_that_flows_arrives(stage: Stage, at: str) -> None:
    stage.add().flow()
    answer = stage.explain(at=at)
    assert (answer.cause, answer.command) == (Cause.ARRIVES, "")


def test_a_topic_at_two_hertz_arrives(stage: Stage) -> None:
    stage.add().flow(hz=2)
    assert stage.explain().cause is Cause.ARRIVES


def test_a_topic_that_was_published_a_minute_ago_is_idle(stage: Stage) -> None:
    stage.add().flow(for_s=2)
    stage.run(60)
    assert stage.explain().cause is Cause.IDLE
    assert stage.explain(at=ROBOT).cause is Cause.IDLE


def test_a_latched_topic_that_was_published_once_is_idle(stage: Stage) -> None:
    stage.add(f"{stage_rule()}, latched: true")
    ear = stage.listen()
    talker = stage.talk(for_s=0)
    stage.run(2)
    talker.publish(string("once"))
    assert stage.run(5, lambda: bool(ear.heard))
    stage.run(20)
    assert stage.explain().cause is Cause.IDLE


def test_a_service_that_is_served_answers(stage: Stage) -> None:
    stage.add(SWITCH, SWITCH)
    local = LocalServer(stage.robot.graph, answer=lambda raw: switched("done"))
    client = Client(stage.server.graph)
    assert stage.run(5, client.sees_server)
    client.call(switch(on=True))
    stage.run(2)
    assert local.asked == 1
    assert stage.explain("/switch").cause is Cause.ARRIVES
    assert stage.explain("/switch", at=ROBOT).cause is Cause.ARRIVES


def test_a_service_without_callers_is_fine(stage: Stage) -> None:
    stage.add(SWITCH, None)
    LocalServer(stage.robot.graph)
    stage.run(10)
    assert stage.explain("/switch", at=ROBOT).cause is Cause.IDLE


@pytest.mark.parametrize("after_s", [0.0, 0.3, 0.6, 1.0])
def test_a_proxy_that_has_just_started_raises_no_alarm(stage: Stage, after_s: float) -> None:
    stage.add()
    stage.uptime_s = after_s
    stage.listen()
    stage.talk()
    stage.run(after_s)
    assert stage.explain().cause in (Cause.STARTING, Cause.ARRIVES)


def test_one_of_two_readers_is_enough(stage: Stage) -> None:
    stage.add().flow()
    Ear(stage.server.graph, "/chatter", node="/second")
    assert stage.explain().cause is Cause.ARRIVES


def test_a_former_fault_is_no_fault(stage: Stage) -> None:
    stage.add("name: /chatter, type: std_msgs/msg/String, max_bytes: 100")
    talker = stage.talk()
    ear = stage.listen()
    talker.publish(string("x" * 500))
    assert stage.run(10, lambda: len(ear.heard) > 5)
    assert stage.explain().cause is Cause.ARRIVES


def test_a_message_that_takes_longer_than_two_samples_are_apart_is_on_its_way(stage: Stage) -> None:
    stage.add()
    stage.listen()
    stage.sites.world.leads[ROBOT].bytes_s = 20_000
    stage.talk(hz=0.2, size=60_000)  # each takes three seconds
    stage.run(11.0)
    answer = stage.explain()
    assert answer.cause is Cause.ARRIVES
    assert "not complete yet" in answer.sentence


def stage_rule() -> str:
    return "name: /chatter, type: std_msgs/msg/String"


def test_a_topic_that_flows_arrives_by_frames_too(stage: Stage) -> None:
    stage.add().flow()
    assert stage.explain_over_network().cause is Cause.ARRIVES


def test_a_topic_that_is_idle_is_idle_by_frames_too(stage: Stage) -> None:
    stage.add().flow(for_s=2)
    stage.run(60)
    assert stage.explain_over_network().cause is Cause.IDLE


def test_a_member_of_another_domain_learns_of_names_that_it_takes_part_in(tmp_path: Path) -> None:
    stage = Stage(tmp_path, topology=TWO_DOMAINS).add()
    stage.flow()
    answer = stage.explain_over_network()
    assert answer.cause is Cause.ARRIVES
    stranger = stage.sites.add("s3/stranger")
    robot = stage.sites.world.members[ROBOT].name.to_text()
    name = stage.robot.stream.topic.to_text()
    assert stage._ask(stage.server, robot, name, "/chatter")
    assert stage._ask(stranger, robot, name, "/chatter") == {}
