"""The only link to a robot collapses to a hundredth of its rate for 12 s, behind a FIFO that ordinary traffic fills.

Keepalives wait in that FIFO for longer than their detection time, or are dropped. The link is up all the same: frames
come over it. What repeats itself (reminders, reports, relayed advertisements) has to become rarer, or it would keep the
FIFO full by itself.
"""

from __future__ import annotations

from functools import partial
from typing import Final

import pytest

from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import Flow, advertise
from tests.lanes import nightly

FIFO_BYTES: Final = 64_000
ROBOT, READER = "s0/robot", "s2/reader"
BEFORE_S, THIN_S, AFTER_S = 2.0, 12.0, 4.0
ADAPTED_S: Final = 4.0  # after the collapse: what was queued has left, and the senders know the path
STEP_S: Final = 0.05
QUEUE_MAX_S: Final = 1.0  # of a trace's patience
RENEWALS_S: Final = 1.25  # all advertisements are renewed together, 8 s after the first ones
CATCHES_UP_S: Final = 2.5
TOPICS: Final = {  # rate, bytes, reliable, urgent
    "/image": (15, 23_000, False, False),
    "/scan": (10, 1_500, False, False),
    "/imu": (50, 320, False, False),
    "/odom": (30, 700, True, False),
    "/cmd_vel": (10, 50, False, True),
}


class Collapse:
    """Three switches in a row, and what a robot publishes over them."""

    def __init__(self) -> None:
        topology = Topology(
            (Link("s0", "s1"), Link("s1", "s2")),
            (DomainPlan("home", ("s0", "s1", "s2")),),
            (Attachment("s1", "rib", "rib"), Attachment("s0", "proxy", "robot"), Attachment("s2", "proxy", "reader")),
        )
        self.world = world = Simulation(topology=topology, keepalive_ms=None)
        assert world.run_until_attached()
        self.flows = {
            name: advertise(world, name, ROBOT, reliable=reliable, urgent=urgent)
            for name, (_, _, reliable, urgent) in TOPICS.items()
        }
        for flow in self.flows.values():
            flow.read_by(READER)
        assert world.network.run(5, lambda: all(flow.is_read_by(1) for flow in self.flows.values()))
        self.came_s: dict[str, dict[int, float]] = {name: {} for name in TOPICS}
        self.begun_s = world.network.now.mono_s
        for name, (rate, size, _, _) in TOPICS.items():
            for number in range(self.count(name)):
                world.network.call(number / rate, partial(self._publish, self.flows[name], number, size))

    @property
    def link(self) -> SimLink:
        """Return the link that collapses."""
        return self.world.cables[frozenset(("s0", "s1"))]

    def count(self, name: str) -> int:
        """Return how many messages a topic has in all."""
        return int((BEFORE_S + THIN_S + AFTER_S) * TOPICS[name][0])

    @staticmethod
    def _publish(flow: Flow, number: int, size: int) -> None:
        flow.publish(number.to_bytes(4, "big") + bytes(size))

    def run_to(self, until_s: float) -> None:
        """Let time pass until a second after the first message; the link must stay up at both of its ends."""
        network, names = self.world.network, {flow.topic.name: name for name, flow in self.flows.items()}
        while network.now.mono_s < self.begun_s + until_s:
            network.run(STEP_S)
            for each in self.world.members[READER].poll_messages():
                number = int.from_bytes(each.delivered.message[:4], "big")
                self.came_s[names[each.topic]][number] = network.now.mono_s - self.begun_s
            up = [each.name for each in self.world.switches["s1"].hello_protocol.neighbours.all_up()]
            far = [each.name for each in self.world.switches["s0"].hello_protocol.neighbours.all_up()]
            assert self.world.switches["s0"].name in up, f"s1 lost s0 at {network.now.mono_s - self.begun_s:.2f} s"
            assert self.world.switches["s1"].name in far, f"s0 lost s1 at {network.now.mono_s - self.begun_s:.2f} s"

    def queue_s(self) -> float:
        """Return how long a frame now waits in the FIFO of the link."""
        return max(self.link.free_s.values()) - self.world.network.now.mono_s

    def share(self, name: str, from_s: float, until_s: float) -> float:
        """Return which share of the messages published in a period came at all."""
        rate = TOPICS[name][0]
        numbers = range(int(from_s * rate), int(until_s * rate))
        return sum(number in self.came_s[name] for number in numbers) / len(numbers)


@pytest.mark.parametrize("kbit_s", [300, *nightly(1_000)])
def test_a_link_that_collapses_stays_up_carries_what_is_urgent_and_recovers(kbit_s: int) -> None:
    collapse = Collapse()
    collapse.run_to(BEFORE_S)
    collapse.link.bytes_s = kbit_s * 1e3 / 8
    collapse.link.fifo_s = FIFO_BYTES / collapse.link.bytes_s
    thin_until_s = BEFORE_S + THIN_S
    collapse.run_to(BEFORE_S + ADAPTED_S)
    assert collapse.queue_s() <= QUEUE_MAX_S, "what was queued has left"
    collapse.run_to(thin_until_s)
    collapse.link.bytes_s = float("inf")
    collapse.run_to(thin_until_s + CATCHES_UP_S)
    assert max(collapse.came_s["/odom"]) >= int((thin_until_s + CATCHES_UP_S - 0.5) * TOPICS["/odom"][0])
    collapse.run_to(thin_until_s + AFTER_S + 1)
    assert list(collapse.came_s["/odom"]) == list(range(collapse.count("/odom"))), "a reliable topic is whole"
    assert collapse.share("/cmd_vel", BEFORE_S + ADAPTED_S, thin_until_s) >= 0.8
    for name in TOPICS:
        assert collapse.share(name, thin_until_s + CATCHES_UP_S, thin_until_s + AFTER_S) == 1, name
        reader = collapse.world.members[READER]
        lost = reader.subscriptions.losses_of(collapse.flows[name].topic.name).total
        assert len(collapse.came_s[name]) + lost == collapse.count(name), f"{name}: what did not come is counted"
    collapse.flows["/odom"].outlive()


@pytest.mark.nightly
@pytest.mark.momentary("it is about the queue of one link within half a lease")
@pytest.mark.parametrize("before_s", [1.7, 2.0, 2.1, 2.3, 2.6])
def test_no_new_queue_forms_on_a_link_that_collapsed(before_s: float) -> None:
    collapse = Collapse()
    collapse.run_to(before_s)
    collapse.link.bytes_s = 300e3 / 8
    collapse.link.fifo_s = FIFO_BYTES / collapse.link.bytes_s
    for half in range(int(2 * ADAPTED_S), int(2 * THIN_S)):
        collapse.run_to(before_s + half / 2)
        assert collapse.queue_s() <= RENEWALS_S
