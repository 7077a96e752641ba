"""Backup branches: a topic's frames have another path before any switch has computed one."""

from __future__ import annotations

import pytest

from gdp.frame.codec import Kind
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import LEASE_S, Flow, Tap, flowing

P, R, NEAR, HERE = "s1/robot", "s4/reader", "s2/near", "s1/here"
PERIOD_S = 0.002


def square(mtu: int = 1_500) -> Simulation:
    """Return ``P - s1 - s2 - s4 - R`` with a path of higher cost by s3, settled."""
    topology = Topology(
        (Link("s1", "s2", 10), Link("s2", "s4", 10), Link("s1", "s3", 12, mtu=mtu), Link("s3", "s4", 10)),
        (DomainPlan("home", ("s1", "s2", "s3", "s4")),),
        (
            Attachment("s3", "rib", "rib"),
            Attachment("s1", "proxy", "robot"),
            Attachment("s4", "proxy", "reader"),
            Attachment("s2", "proxy", "near"),
            Attachment("s1", "proxy", "here"),
        ),
    )
    world = Simulation(topology=topology, lease_s=LEASE_S)
    assert world.run_until_attached()
    return world


def protected(world: Simulation, *readers: str) -> Flow:
    """Return a best-effort flow whose trees have asked for their backups."""
    flow = flowing(world, source=P, readers=readers or (R,), reliable=False)
    world.network.run(3.0)
    return flow


def frames(world: Simulation, a: str, b: str) -> Tap:
    """Return the frames that pass a link from now on."""
    tap = Tap(a, b)
    world.network.taps.append(tap)
    return tap


@pytest.mark.momentary("what is sent between a cut and its discovery is what this is about")
def test_no_message_is_lost_where_the_backup_is_taken_before_anybody_knows() -> None:
    world = square()
    flow = protected(world)
    flow.stream(200, PERIOD_S, size=100)
    world.network.run(0.05)
    world.cables[frozenset(("s1", "s2"))].is_up = False  # the port is down; no machine has received the event
    world.network.run(0.1)
    in_flight = set(range(200)) - set(flow.numbers(R)) - set(range(70, 200))
    assert len(in_flight) <= 2
    world.network.set_link(world.cables[frozenset(("s1", "s2"))], up=False)
    world.network.run(2.0)
    assert set(range(200)) - set(flow.numbers(R)) == in_flight
    assert len(flow.numbers(R)) == 200 - len(in_flight)


def test_a_backup_carries_nothing_while_its_branch_stands_and_everything_after() -> None:
    world = square()
    flow = protected(world)
    aside = frames(world, "s1", "s3")
    flow.outlive()
    assert aside.count(Kind.DATA) == 0
    world.network.set_link(world.cables[frozenset(("s1", "s2"))], up=False)
    flow.outlive()
    assert aside.count(Kind.DATA) > 0
    world.network.set_link(world.cables[frozenset(("s1", "s2"))], up=True)
    world.network.run(20.0)
    aside = frames(world, "s1", "s3")
    flow.outlive()
    assert aside.count(Kind.DATA) == 0


@pytest.mark.parametrize("cut", [("s1", "s2"), ("s2", "s4")])
def test_each_reader_has_its_messages_once_whichever_branch_is_lost(cut: tuple[str, str]) -> None:
    world = square()
    flow = protected(world, R, NEAR, HERE)
    world.network.set_link(world.cables[frozenset(cut)], up=False)
    world.network.run(0.1)
    flow.outlive()


def test_a_backup_that_messages_would_not_fit_protects_nothing_and_narrows_nothing() -> None:
    world = square(mtu=700)
    flow = protected(world)
    assert all(not tree.protection for tree in world.switches["s1"].multicast.trees.all())
    straight = frames(world, "s1", "s2")
    flow.stream(1, PERIOD_S, size=1_300)
    world.network.run(0.5)
    assert straight.count(Kind.DATA) == 1
    flow.outlive()


def test_a_reader_that_leaves_takes_its_backup_along() -> None:
    world = square()
    flow = protected(world)
    assert [len(world.switches[each].multicast.trees) > 0 for each in ("s1", "s2", "s3", "s4")] == [True] * 4
    topic = flow.topic.name
    world.members[R].unsubscribe(topic)
    world.network.send_pending(R)
    world.network.run(1.0)
    assert all(not switch.multicast.trees.of_topic(topic) for switch in world.switches.values())
    flow.outlive(negative=True)
