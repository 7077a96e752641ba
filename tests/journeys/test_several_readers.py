"""A reliable topic and images to several readers, over links that the images keep full: neither starves the other."""

from __future__ import annotations

from collections import defaultdict
from functools import partial
from itertools import pairwise

import pytest

from gdp.intervals import SCAPY_KEEPALIVE_MS
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import advertise, outlive_together
from tests.lanes import nightly

SWITCHES = ("s0", "s1", "s2", "s3", "s4")
READERS = ("s2/r2", "s3/r3", "s4/r4")
IMAGE_BYTES, OFFERED = 30_000, 2.0  # images offer so much of the link
FULL_S, SETTLED_S = 10.0, 2.0
LEASE_S = 8.0  # a shorter one may end before a renewal has passed a full link


def world_of(keepalive_ms: int | None = None) -> Simulation:
    links = (Link("s0", "s1"), Link("s1", "s2"), Link("s2", "s3"), Link("s1", "s4"))
    ends = [Attachment("s1", "rib", "rib"), Attachment("s0", "proxy", "robot")]
    ends += [Attachment(each[:2], "proxy", each[3:]) for each in READERS]
    world = Simulation(
        topology=Topology(links, (DomainPlan("home", SWITCHES),), tuple(ends)),
        lease_s=LEASE_S,
        keepalive_ms=keepalive_ms,
    )
    assert world.run_until_attached()
    return world


@pytest.mark.parametrize(("mbit_s", "slow"), [(4.0, 0.5), *nightly((4.0, 1.0), (20.0, 1.0))])
def test_a_reliable_topic_and_images_to_three_readers_share_full_links(mbit_s: float, slow: float) -> None:
    """``slow``: rate of the link to one reader, as a share of the others'."""
    world = world_of()
    flows = {
        "/odom": advertise(world, "/odom", "s0/robot"),
        "/imu": advertise(world, "/imu", "s0/robot", reliable=False),
        "/image": advertise(world, "/image", "s0/robot", reliable=False),
    }
    for flow in flows.values():
        for label in READERS:
            flow.read_by(label)
    assert world.network.run(5, lambda: all(flow.is_read_by(len(READERS)) for flow in flows.values()))
    for ends, cable in world.cables.items():
        cable.bytes_s = mbit_s * 1e6 / 8 * (slow if ends == frozenset(("s1", "s4")) else 1.0)
        cable.fifo_s = 0.2
    sizes = {
        "/odom": (10.0, 100),
        "/imu": (10.0, 100),
        "/image": (OFFERED * mbit_s * 1e6 / 8 / IMAGE_BYTES, IMAGE_BYTES),
    }
    for name, (rate, size) in sizes.items():
        for number in range(int(FULL_S * rate)):
            world.network.call(number / rate, partial(flows[name].publish, number.to_bytes(4, "big") + bytes(size)))
    names = {flow.topic.name: name for name, flow in flows.items()}
    came_s: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    begun_s = world.network.now.mono_s
    while world.network.now.mono_s < begun_s + FULL_S:
        world.network.run(0.05)
        for label in READERS:
            for each in world.members[label].poll_messages():
                came_s[names[each.topic], label].append(world.network.now.mono_s - begun_s)
    for label in READERS:
        for name in ("/odom", "/image"):
            times = [SETTLED_S, *(at_s for at_s in came_s[name, label] if at_s > SETTLED_S), FULL_S]
            assert max(b - a for a, b in pairwise(times)) <= 1.5, f"{name} at {label}"
        assert len(came_s["/odom", label]) >= 0.9 * FULL_S * 10
    images = min(len(came_s["/image", label]) for label in READERS)
    assert images * IMAGE_BYTES * 8 >= 0.4 * slow * mbit_s * 1e6 * FULL_S
    world.network.run(20)  # a slow reader that no longer counted has caught up
    for label in READERS:
        world.members[label].poll_messages()
    flows["/odom"].outlive()


MAP_BYTES, MAP_RATE = 1_000_000, 4e6 / 8


def test_a_reader_that_begins_while_a_large_message_leaves_does_not_delay_it() -> None:
    world = world_of(SCAPY_KEEPALIVE_MS)
    flow = advertise(world, "/map", "s0/robot")
    flow.read_by(READERS[0])
    assert world.network.run(5, lambda: flow.is_read_by(1))
    world.cables[frozenset(("s0", "s1"))].bytes_s = MAP_RATE
    flow.publish(bytes(MAP_BYTES))
    world.network.run(0.2)
    flow.read_by(READERS[2])  # its first message is the next one
    begun_s = world.network.now.mono_s
    assert world.network.run(20, lambda: flow.has(READERS[0], 1))
    assert world.network.now.mono_s - begun_s <= 1.3 * MAP_BYTES / MAP_RATE
    assert flow.is_read_by(2)
    flow.outlive()


def test_topics_reach_a_reader_that_restarts_and_the_others_at_once() -> None:
    world = world_of()
    flows = [advertise(world, f"/odom/{number}", "s0/robot") for number in range(3)]
    flows.append(advertise(world, "/image", "s0/robot", reliable=False))
    killed, other = READERS[:2]
    for flow in flows:
        flow.read_by(killed)
        flow.read_by(other)
    assert world.network.run(5, lambda: all(flow.is_read_by(2) for flow in flows))
    for cable in world.cables.values():
        cable.bytes_s, cable.fifo_s = 4e6 / 8, 0.2
    world.network.stop(killed)
    for flow in flows[:-1]:
        flow.stream(120, 0.1, 100)
    flows[-1].stream(360, 1 / 30, IMAGE_BYTES)
    world.network.run(5.0)  # the path to it has timed out again and again
    world.members[other].poll_messages()
    world.restart_member(killed)
    for flow in flows:
        flow.read_by(killed)
    came_s: defaultdict[tuple[str, bytes], list[float]] = defaultdict(list)
    restarted_s = world.network.now.mono_s
    while world.network.now.mono_s < restarted_s + 6:
        world.network.run(0.05)
        for label in (killed, other):
            for each in world.members[label].poll_messages():
                came_s[label, each.topic].append(world.network.now.mono_s - restarted_s)
    for flow in flows:
        assert came_s[killed, flow.topic.name][0] <= 1.0
        assert max(b - a for a, b in pairwise(came_s[other, flow.topic.name])) <= 0.5
    world.network.run(10)
    for label in (killed, other):
        world.members[label].poll_messages()
    outlive_together(*flows)


def test_the_slowest_reader_of_a_topic_is_known_to_govern_it() -> None:
    world = world_of(SCAPY_KEEPALIVE_MS)
    flow = advertise(world, "/image", "s0/robot", reliable=False)
    for label in READERS:
        flow.read_by(label)
    assert world.network.run(5, lambda: flow.is_read_by(len(READERS)))
    thin = world.cables[frozenset(("s1", "s4"))]
    thin.bytes_s, thin.fifo_s = 2e6 / 8, 0.2
    flow.stream(150, 1 / 30, IMAGE_BYTES)
    world.network.run(5.0)
    governing = flow.publisher.governing_paths.governing_reader()
    assert governing is not None
    reader, rtt_s, bytes_s = governing
    assert reader == world.members["s4/r4"].name
    assert 0.001 <= rtt_s <= 0.3
    assert 0.5 <= bytes_s / (2e6 / 8) <= 2.0
    world.network.run(2.0)
    flow.outlive()
