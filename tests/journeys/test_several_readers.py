"""A reliable topic and images to several readers, over links that the images keep full: neither starves the other."""

from __future__ import annotations

from collections import defaultdict
from functools import partial
from itertools import pairwise

import pytest

from gdp.simulation.simulation import Simulation
from gdp.simulation.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import advertise

SWITCHES = ("s0", "s1", "s2", "s3", "s4")
READERS = ("s2/r2", "s3/r3", "s4/r4")
IMAGE_BYTES, OFFERED = 30_000, 2.0  # images offer so much of the link
FULL_S, SETTLED_S = 15.0, 2.0


def world_of() -> Simulation:
    links = (Link("s0", "s1"), Link("s1", "s2"), Link("s2", "s3"), Link("s1", "s4"))
    ends = [Attachment("s1", "rib", "rib"), Attachment("s0", "proxy", "robot")]
    ends += [Attachment(each[:2], "proxy", each[3:]) for each in READERS]
    world = Simulation(
        topology=Topology(links, (DomainPlan("home", SWITCHES),), tuple(ends)),
        keepalive_ms=None,
    )
    assert world.run_until_attached()
    return world


@pytest.mark.parametrize(("mbit_s", "slow"), [(4.0, 1.0), (20.0, 1.0), (4.0, 0.5)])
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
