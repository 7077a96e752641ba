"""QoS from end to end: a publisher's promises reach remote readers, and impossible ones are reported."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from gdp.client.send_options import SendOptions
from proxy.endpoints.core.qos import default
from proxy.serial.channel import Qos, RosVersion
from tests.proxy.bridge import known
from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites
from tests.proxy.endpoints.fake import FakeGraph, Publication

CHATTER = f"name: /chatter, type: {STRING}"
LATCHED = default(latched=True, depth=1)
BEST_EFFORT = default(reliable=False)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def pair(sites: Sites, more: str = "") -> tuple[Machine, Machine]:
    return sites.add(ROBOT, expose=[CHATTER + more]), sites.add(SERVER, imports=[CHATTER])


def count_aloud(talker: Publication, number: int) -> None:
    talker.publish(string(str(number)))


def virtual(machine: Machine) -> list[Publication]:
    """Return the virtual publishers of the topic."""
    return [each for each in machine.graph.publications if each.end.name == "/chatter"]


def offered(machine: Machine) -> Qos:
    """Return the offer of the virtual publisher."""
    (publication,) = virtual(machine)
    return publication.qos


@pytest.mark.parametrize("qos", [default(), BEST_EFFORT], ids=["reliable", "best effort"])
def test_the_virtual_publisher_offers_what_the_far_one_does(sites: Sites, qos: Qos) -> None:
    robot, server = pair(sites)
    ear, talker = Ear(server.graph, "/chatter", qos=qos), robot.graph.publish("/talker", "/chatter", STRING, qos)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    assert offered(server).reliability == qos.reliability


def test_an_importing_rule_states_the_qos_until_a_reader_makes_the_far_one_known(sites: Sites) -> None:
    sites.add(ROBOT, expose=[CHATTER])
    server = sites.add(SERVER, imports=[CHATTER + ", reliable: false, latched: true"])
    sites.run(1)
    assert (offered(server).reliability, offered(server).durability) == ("best_effort", "transient_local")


STATED = ", offered: {{reliability: {0.reliability}, durability: {0.durability}, depth: {0.depth}}}"


@pytest.mark.parametrize("qos", [default(), BEST_EFFORT, LATCHED], ids=["reliable", "best effort", "latched"])
def test_the_qos_of_an_offer_is_here_before_any_reader_and_its_publisher_stays(sites: Sites, qos: Qos) -> None:
    robot = sites.add(ROBOT, expose=[CHATTER])
    talker = robot.graph.publish("/talker", "/chatter", STRING, qos)
    sites.run(1)
    ((_, profile),) = robot.bridge.offered_qos
    server = sites.add(SERVER, imports=[CHATTER + STATED.format(profile)])
    sites.run(1)
    before = virtual(server)
    assert (offered(server).reliability, offered(server).durability) == (qos.reliability, qos.durability)
    ear = Ear(server.graph, "/chatter", qos=qos)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    assert virtual(server) == before


def test_another_qos_of_an_offer_replaces_the_publisher_until_the_far_one_is_known(sites: Sites) -> None:
    robot, server = pair(sites)
    sites.run(1)
    sites.reload(server, imports=[CHATTER + STATED.format(LATCHED)])
    sites.run(1)
    assert offered(server).durability == "transient_local"
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("1"))
    assert sites.run(1, lambda: ear.texts == ["1"])
    before = virtual(server)
    sites.reload(server, imports=[CHATTER + STATED.format(BEST_EFFORT)])
    sites.run(1)
    talker.publish(string("2"))
    assert sites.run(1, lambda: ear.texts == ["1", "2"])
    assert virtual(server) == before


def test_the_qos_of_a_topic_that_only_lacks_a_delegation_is_known(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[CHATTER], holds=[])
    robot.graph.publish("/talker", "/chatter", STRING, LATCHED)
    sites.run(1)
    ((spec, profile),) = robot.bridge.offered_qos
    assert (spec.local, profile.durability, profile.depth) == ("/chatter", "transient_local", 1)


def test_a_ros_1_publisher_is_not_replaced_because_the_far_qos_differs(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER], ros=1)
    ear = Ear(server.graph, "/chatter")
    assert sites.run(3, lambda: bool(virtual(server)))
    before = virtual(server)
    talker = robot.graph.publish("/talker", "/chatter", STRING, BEST_EFFORT)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    assert virtual(server) == before


def test_a_ros_1_publisher_is_replaced_when_the_far_one_is_latched(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER], ros=1)
    ear = Ear(server.graph, "/chatter")
    assert sites.run(3, lambda: bool(virtual(server)))
    before = virtual(server)
    robot.graph.publish("/talker", "/chatter", STRING, LATCHED).publish(string("map"))
    assert sites.run(3, lambda: ear.texts == ["map"])
    assert virtual(server) != before


def test_what_is_lost_is_repaired_for_a_reliable_publisher_only(sites: Sites) -> None:
    robot, server = pair(sites)
    other = f"name: /other, type: {STRING}"
    sites.reload(robot, expose=[CHATTER, other])
    sites.reload(server, imports=[CHATTER, other])
    ears = [Ear(server.graph, "/chatter"), Ear(server.graph, "/other", qos=BEST_EFFORT)]
    talkers = [
        robot.graph.publish("/talker", "/chatter", STRING),
        robot.graph.publish("/talker", "/other", STRING, BEST_EFFORT),
    ]
    assert sites.run(3, lambda: robot.is_read() and len(list(robot.member.publications)) == 2)
    sites.world.leads[SERVER].loss = 0.2
    for talker in talkers:
        sites.every(0.01, 100, partial(count_aloud, talker))
    sites.run(10)
    assert ears[0].texts == [str(number) for number in range(100)]
    assert 40 < len(ears[1].heard) < 100
    assert len(set(ears[1].heard)) == len(ears[1].heard)


def test_a_reliable_reader_matches_a_best_effort_source_and_the_others_still_hear(sites: Sites) -> None:
    robot, server = pair(sites)
    easy = Ear(server.graph, "/chatter", qos=BEST_EFFORT)
    talker = robot.graph.publish("/talker", "/chatter", STRING, BEST_EFFORT)
    assert sites.run(3, robot.is_read)
    talker.publish(string("1"))
    assert sites.run(1, lambda: easy.texts == ["1"])
    strict = Ear(server.graph, "/chatter", node="/strict")
    sites.run(1)
    talker.publish(string("2"))
    assert sites.run(1, lambda: strict.texts == ["2"] and easy.texts == ["1", "2"])
    strict.leave()
    sites.run(1)
    talker.publish(string("3"))
    assert sites.run(1, lambda: easy.texts == ["1", "2", "3"])


def test_a_rule_may_say_otherwise_than_the_publisher(sites: Sites) -> None:
    robot, server = pair(sites, ", reliable: false")
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    sites.world.leads[SERVER].loss = 0.3
    sites.every(0.01, 50, lambda number: talker.publish(string(str(number))))
    sites.run(5)
    assert 0 < len(ear.heard) < 50  # no lost message is repaired


def options_of(machine: Machine) -> SendOptions:
    (publisher,) = list(machine.member.publications)
    return publisher.options


def test_the_send_options_are_those_of_the_rule(sites: Sites) -> None:
    robot, _ = pair(sites, ", deadline_ms: 150, weight: 7, max_bits_s: 4000000, repair: never, fec: never")
    robot.graph.publish("/talker", "/chatter", STRING, replace(BEST_EFFORT, lifespan=(9, 0)))
    sites.run(1)
    assert options_of(robot) == SendOptions(deadline_s=0.15, weight=7, max_bits_s=4e6, repairs=False, fec=False)


def test_without_a_deadline_in_the_rule_the_publishers_state_it_at_any_time(sites: Sites) -> None:
    robot, _ = pair(sites)
    robot.graph.publish("/first", "/chatter", STRING, replace(BEST_EFFORT, lifespan=(0, 250_000_000)))
    sites.run(1)
    before = options_of(robot)
    later = robot.graph.publish("/later", "/chatter", STRING, replace(BEST_EFFORT, deadline=(2, 0)))
    sites.run(1)
    assert (before, options_of(robot)) == (SendOptions(deadline_s=0.25), SendOptions(deadline_s=2.0))
    later.close()
    sites.run(1)
    assert options_of(robot) == SendOptions(deadline_s=0.25)


def test_a_latched_message_reaches_who_joins_later_on_the_far_side(sites: Sites) -> None:
    robot, server = pair(sites)
    robot.graph.publish("/talker", "/chatter", STRING, LATCHED).publish(string("map"))
    sites.run(5)
    first = Ear(server.graph, "/chatter", qos=LATCHED)
    assert sites.run(2, lambda: first.texts == ["map"])
    second = Ear(server.graph, "/chatter", qos=LATCHED, node="/second")
    sites.run(2)
    assert (first.texts, second.texts) == (["map"], ["map"])


def test_a_latched_topic_reaches_the_same_reader_again_after_it_left(sites: Sites) -> None:
    robot, server = pair(sites)
    robot.graph.publish("/talker", "/chatter", STRING, LATCHED).publish(string("map"))
    ear = Ear(server.graph, "/chatter", qos=LATCHED)
    assert sites.run(3, lambda: ear.texts == ["map"])
    ear.leave()
    sites.run(3)
    again = Ear(server.graph, "/chatter", qos=LATCHED)
    sites.run(3)
    assert again.texts == ["map"]


def test_what_two_publishers_latched_reaches_a_late_joiner_from_both(sites: Sites) -> None:
    robot, server = pair(sites)
    talkers = [robot.graph.publish(f"/talker{n}", "/chatter", STRING, LATCHED) for n in range(2)]
    sites.run(1)
    for n, talker in enumerate(talkers):
        talker.publish(string(f"from {n}"))
    sites.run(2)
    ear = Ear(server.graph, "/chatter", qos=LATCHED)
    assert sites.run(3, lambda: sorted(ear.texts) == ["from 0", "from 1"])
    second = Ear(server.graph, "/chatter", qos=LATCHED, node="/second")
    sites.run(1)
    assert sorted(second.texts) == ["from 0", "from 1"]


def test_what_a_later_publisher_latches_pushes_nothing_of_the_first_out(sites: Sites) -> None:
    robot, server = pair(sites)
    ear = Ear(server.graph, "/chatter", qos=LATCHED)
    robot.graph.publish("/first", "/chatter", STRING, LATCHED).publish(string("first"))
    assert sites.run(3, lambda: ear.texts == ["first"])
    later = robot.graph.publish("/later", "/chatter", STRING, LATCHED)
    sites.run(1)
    later.publish(string("later"))
    assert sites.run(3, lambda: ear.texts[-1] == "later")
    assert ear.texts == ["first"] * 3 + ["later"]  # again from a publisher that keeps more, and from the first itself
    second = Ear(server.graph, "/chatter", qos=LATCHED, node="/second")
    sites.run(1)
    assert second.texts == ["first", "first", "later"]  # the first one's is kept, and was announced again as kept


def test_what_publishers_on_two_machines_latched_reaches_a_late_joiner_from_both(sites: Sites) -> None:
    robot, server = pair(sites)
    third = sites.add("nuc3/third", expose=[CHATTER])
    for machine, text in ((robot, "robot"), (third, "third")):
        machine.graph.publish("/talker", "/chatter", STRING, LATCHED).publish(string(text))
    sites.run(2)
    ear = Ear(server.graph, "/chatter", qos=LATCHED)
    assert sites.run(3, lambda: sorted(set(ear.texts)) == ["robot", "third"])
    second = Ear(server.graph, "/chatter", qos=LATCHED, node="/second")
    sites.run(1)
    assert sorted(second.texts) == ["robot", "third"]


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("is_early", [True, False], ids=["before the proxy", "after it"])
def test_what_ros_1_publishers_latched_reaches_late_joiners_from_all(
    sites: Sites, ros: RosVersion, *, is_early: bool
) -> None:
    graph = FakeGraph(1, known.channels(1))
    server = sites.add(SERVER, imports=[CHATTER], ros=ros)

    def publish() -> None:
        for n in range(3):
            graph.publish(f"/talker{n}", "/chatter", STRING, LATCHED).publish(string(f"from {n}", 1))

    if is_early:
        publish()
    sites.add(ROBOT, expose=[CHATTER], graph=graph)
    sites.run(1)
    if not is_early:
        publish()
    sites.run(2)
    ear = Ear(server.graph, "/chatter", qos=LATCHED)
    assert sites.run(3, lambda: sorted(ear.texts) == ["from 0", "from 1", "from 2"])
    second = Ear(server.graph, "/chatter", qos=LATCHED, node="/second")
    sites.run(1)
    assert sorted(second.texts) == ["from 0", "from 1", "from 2"]


def test_a_ros_1_topic_that_is_not_latched_gives_late_joiners_nothing_old(sites: Sites) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER], ros=1), sites.add(SERVER, imports=[CHATTER], ros=1)
    talker, first = robot.graph.publish("/talker", "/chatter", STRING), Ear(server.graph, "/chatter")
    assert sites.run(3, robot.is_read)
    talker.publish(string("old", 1))
    sites.run(1)
    second = Ear(server.graph, "/chatter", node="/second")
    sites.run(1)
    assert (first.texts, second.texts) == (["old"], [])


@pytest.mark.parametrize("latched", [True, False])
def test_the_importing_rule_may_latch_what_is_not_or_not_what_is(sites: Sites, *, latched: bool) -> None:
    robot = sites.add(ROBOT, expose=[CHATTER])
    server = sites.add(SERVER, imports=[f"{CHATTER}, latched: {str(latched).lower()}"])
    talker = robot.graph.publish("/talker", "/chatter", STRING, default() if latched else LATCHED)
    Ear(server.graph, "/chatter")
    assert sites.run(3, robot.is_read)
    talker.publish(string("map"))
    sites.run(1)
    assert (offered(server).durability == "transient_local") is latched


def test_a_volatile_reader_gets_only_what_is_new(sites: Sites) -> None:
    robot, server = pair(sites)
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    first = Ear(server.graph, "/chatter")
    assert sites.run(3, robot.is_read)
    talker.publish(string("old"))
    sites.run(1)
    second = Ear(server.graph, "/chatter", node="/second")
    sites.run(1)
    talker.publish(string("new"))
    sites.run(1)
    assert (first.texts, second.texts) == (["old", "new"], ["new"])


def test_a_publisher_that_comes_back_latched_is_latched_from_then_on(sites: Sites) -> None:
    robot, server = pair(sites)
    ear = Ear(server.graph, "/chatter")
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("1"))
    assert sites.run(1, lambda: ear.texts == ["1"])
    talker.close()
    again = robot.graph.publish("/talker", "/chatter", STRING, LATCHED)
    sites.run(1)
    again.publish(string("2"))
    assert sites.run(2, lambda: ear.texts == ["1", "2"])
    late = Ear(server.graph, "/chatter", qos=LATCHED, node="/late")
    sites.run(1)
    assert late.texts[-1:] == ["2"]
    assert ear.texts == ["1", "2"]


def test_a_reader_that_requests_more_than_the_source_offers_hears_what_is_new(sites: Sites) -> None:
    robot, server = pair(sites)
    talker = robot.graph.publish("/talker", "/chatter", STRING, BEST_EFFORT)
    ear = Ear(server.graph, "/chatter", qos=LATCHED)
    assert sites.run(3, robot.is_read)
    talker.publish(string("1"))
    assert sites.run(1, lambda: ear.texts == ["1"])


def test_a_deadline_that_the_far_publisher_keeps_is_offered_here_and_a_shorter_one_is_reported(sites: Sites) -> None:
    robot, server = pair(sites)
    ear = Ear(server.graph, "/chatter", qos=replace(default(), deadline=(2, 0)))
    talker = robot.graph.publish("/talker", "/chatter", STRING, replace(default(), deadline=(1, 0)))
    assert sites.run(3, robot.is_read)
    talker.publish(string("1"))
    assert sites.run(1, lambda: ear.texts == ["1"])
    assert (offered(server).deadline, server.faults) == ((2, 0), {})
    ear.leave()
    Ear(server.graph, "/chatter", qos=replace(default(), deadline=(0, 500_000_000)), node="/strict")
    assert sites.run(1, lambda: server.faults == {"qos": 1})


@pytest.mark.parametrize(
    "qos",
    [replace(default(), deadline=(1, 0)), replace(default(), liveliness="manual_by_topic")],
    ids=["deadline", "liveliness"],
)
def test_promises_beyond_any_network_are_reported_once_and_the_others_receive(
    sites: Sites, qos: Qos, caplog: pytest.LogCaptureFixture
) -> None:
    robot, server = pair(sites)
    Ear(server.graph, "/chatter", qos=qos, node="/strict")
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    for n in range(5):
        Ear(server.graph, f"/unrelated{n}")  # the graph changes, and is checked again
        sites.run(0.2)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    (warning,) = caplog.messages
    assert warning.startswith("/chatter: qos: /strict will get nothing: it requests ")
    assert server.faults["qos"] == 1
