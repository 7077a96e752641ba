"""One encoder, readers behind links of 100, 5 and 1 Mbit/s and behind a lossy one, several switches away.

Each gets whole images as fast as its own link carries them: no reader waits for another.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from functools import partial

import pytest

from gdp.client.send_options import SendOptions
from gdp.errors import DropReason
from gdp.frame.pace import kbit_s_of
from gdp.message.loss import LossReason
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.draws import TIMES
from tests.journeys.flows import Flow, advertise

SWITCHES = ("s0", "s1", "s2", "f1", "f2", "m1", "m2", "t1", "t2", "l1")
FAST, MEDIUM, THIN, LOSSY = "f2/fast", "m2/medium", "t2/thin", "l1/lossy"
MBIT_S = {("s2", "f1"): 100.0, ("m1", "m2"): 5.0, ("s2", "t1"): 1.0, ("s2", "l1"): 100.0}
DELAY_S = 0.01  # of these links, one way
FIFO_S = 1.0
IMAGE_BYTES, RATE = 30_000, 30.0  # 7.2 Mbit/s
WIRE_BYTES = 33_020  # in 22 frames, with headers and seals
SETTLED_S, MEASURED_S = 5.0, 8.0 * TIMES
LEASE_S = 24.0


@dataclass
class Arrivals:
    """Images that came to one reader while it was measured: how many, and how old each was."""

    ages_s: list[float] = field(default_factory=list)

    @property
    def p99_s(self) -> float:
        """Return the age that at most one in a hundred exceeds."""
        return sorted(self.ages_s)[int(len(self.ages_s) * 0.99)]

    @property
    def mbit_s(self) -> float:
        """Return the rate of images, in bits on the link; one was under way when the time was over."""
        return (len(self.ages_s) + 1) * WIRE_BYTES * 8 / MEASURED_S / 1e6


def world_of() -> Simulation:
    links = [Link("s0", "s1"), Link("s1", "s2"), Link("f1", "f2"), Link("t1", "t2"), Link("s2", "m1")]
    links += [Link(*ends) for ends in MBIT_S]
    ends = [Attachment("s1", "rib", "rib"), Attachment("s0", "proxy", "robot")]
    ends += [Attachment(label[:2], "proxy", label[3:]) for label in (FAST, MEDIUM, THIN, LOSSY)]
    topology = Topology(tuple(links), (DomainPlan("home", SWITCHES),), tuple(ends))
    world = Simulation(topology=topology, lease_s=LEASE_S, keepalive_ms=None)
    assert world.run_until_attached()
    return world


def images_to(world: Simulation, *readers: str) -> Flow:
    """Return best-effort images with these readers, and the links as thin as they are."""
    flow = advertise(world, "/image", "s0/robot", reliable=False, options=SendOptions(own_pace=True))
    for label in readers:
        flow.read_by(label)
    assert world.network.run(5, lambda: flow.is_read_by(len(readers)))
    for (a, b), mbit_s in MBIT_S.items():
        cable = world.cables[frozenset((a, b))]
        cable.bytes_s, cable.delay_s, cable.fifo_s = mbit_s * 1e6 / 8, DELAY_S, FIFO_S
        if "l1" in (a, b):
            # bursts are counted in frames: reports are so few that a burst of theirs would last for seconds
            cable.loss, cable.burst_frames, cable.spared = 0.02, 8.0, "s2"
    return flow


def measure(flow: Flow) -> dict[str, Arrivals]:
    world, network = flow.world, flow.world.network
    begun_s = network.now.mono_s
    for number in range(int((SETTLED_S + MEASURED_S) * RATE)):
        network.call(number / RATE, partial(flow.publish, number.to_bytes(4, "big") + bytes(IMAGE_BYTES - 4)))
    came: defaultdict[str, Arrivals] = defaultdict(Arrivals)
    while (now_s := network.now.mono_s - begun_s) < SETTLED_S + MEASURED_S:
        network.run(0.005)
        for label in flow.got:
            for each in world.members[label].poll_messages():
                assert len(each.delivered.message) == IMAGE_BYTES
                if now_s >= SETTLED_S:
                    number = int.from_bytes(each.delivered.message[:4], "big")
                    came[label].ages_s.append(network.now.mono_s - begun_s - number / RATE)
    return came


@pytest.mark.momentary("it is about how many images come in how long, and all leases stand meanwhile")
def test_each_reader_gets_whole_images_at_the_pace_of_its_own_link() -> None:
    flow = images_to(world_of(), FAST, MEDIUM, THIN, LOSSY)
    came = measure(flow)
    assert len(came[FAST].ages_s) >= 0.95 * MEASURED_S * RATE
    assert came[FAST].p99_s <= 0.1
    for label, mbit_s in ((MEDIUM, 5.0), (THIN, 1.0)):
        assert came[label].mbit_s >= 0.9 * mbit_s
        assert came[label].p99_s <= 0.3 + WIRE_BYTES * 8 / (mbit_s * 1e6)
    assert came[LOSSY].mbit_s >= 0.9 * RATE * WIRE_BYTES * 8 / 1e6
    assert came[LOSSY].p99_s <= 0.4
    for label in came:
        (writer_proxy,) = flow.world.members[label].subscriptions.writer_proxies()
        is_thinned = writer_proxy.losses.counts[LossReason.THINNED] > 0
        assert is_thinned or label not in (MEDIUM, THIN)
        assert writer_proxy.delivery.delivered + writer_proxy.losses.total <= (SETTLED_S + MEASURED_S) * RATE
    assert flow.world.network.drops[DropReason.THINNED] > 0
    assert 700 <= least_kbit_s(flow.world, "s2") <= 1_300 < 3_500 <= least_kbit_s(flow.world, "m1") <= 6_500


def least_kbit_s(world: Simulation, label: str) -> int:
    """Return the rate of the slowest branch at a switch, which leaves out what it does not carry."""
    trees = world.switches[label].multicast.trees.all()
    return min(kbit_s_of(branch.pace) or 100_000 for tree in trees for branch in tree.branches.values())
