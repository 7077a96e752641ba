"""Urgent topics over a path that loses frames: messages come in time without a repair, and copies stay few."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass, field
from functools import partial

import pytest

from gdp.client.participant import Participant
from gdp.client.send_options import SendOptions
from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, NUMBER_AT, Kind, decode
from gdp.trust.right import Right
from lab.network import SimLink
from tests.journeys.flows import Flow
from tests.journeys.test_two_paths import site
from tests.lanes import nightly

pytestmark = pytest.mark.momentary("loss and copies within a round trip are what these tests are about")

READER = "s1/rs1"
ONE_WAY_S = 0.030
IN_TIME_S = ONE_WAY_S + 0.010
ALARMS = (DropReason.REPLAYED, DropReason.LATE, DropReason.DUPLICATE)


@dataclass
class Radio:
    """A publisher, a reader, and one link between their switches that loses frames."""

    flow: Flow
    cable: SimLink
    sent: int = 0
    came: list[int] = field(default_factory=list)
    late: list[int] = field(default_factory=list)
    copies: Counter[bytes] = field(default_factory=Counter)  # DATA frames on the link, by their bytes
    copy_s: list[float] = field(default_factory=list)
    copied_bytes: int = 0

    @property
    def reader(self) -> Participant:
        """Return the reader."""
        return self.flow.world.members[READER]

    @property
    def now_s(self) -> float:
        """Return the present second."""
        return self.flow.world.network.now.mono_s

    def publish(self, count: int, period_s: float, size: int = 100) -> None:
        """Publish numbered messages at a steady rate, and let a second more pass."""
        network = self.flow.world.network
        for place in range(count):
            network.call(place * period_s, partial(self._publish, self.sent + place, size))
        self.sent += count
        network.run(count * period_s + 1.0)
        self._collect()

    def _publish(self, number: int, size: int) -> None:
        self.flow.publish(number.to_bytes(4, "big") + bytes(size - 4))
        self.flow.world.network.call(IN_TIME_S, partial(self._check, number))

    def _check(self, number: int) -> None:
        self._collect()
        if number not in self.came[-200:]:
            self.late.append(number)

    def _collect(self) -> None:
        self.came += [int.from_bytes(each.delivered.message[:4], "big") for each in self.reader.poll_messages()]

    def tap(self, at_s: float, a: str, _b: str, frame: bytes) -> None:
        """Count the frames that leave the publisher again."""
        if a == self.flow.source and decode(frame, ETHER_BYTES).kind == Kind.DATA:
            key = frame[ETHER_BYTES + NUMBER_AT : ETHER_BYTES + NUMBER_AT + 12]  # number and fragment
            self.copies[key] += 1
            if self.copies[key] > 1:
                self.copy_s.append(at_s)
                self.copied_bytes += len(frame)

    def alarms(self) -> dict[DropReason, int]:
        """Return what looks like an attack, at either end."""
        drops = Counter(self.reader.drops()) + Counter(self.flow.member.drops())
        return {reason: drops[reason] for reason in ALARMS if drops[reason]}


def radio(*, loss: float, reliable: bool = False, seed: int = 1, fec: bool = True, urgent: bool = True) -> Radio:
    """Return a topic that is read over a link of 30 ms."""
    at = site([("s0", "s1", 10)], ("s1",), seed=seed)
    world, member = at.world, at.world.members["s0/robot"]
    cable = at.cables[0][2]
    cable.delay_s = ONE_WAY_S - 2 * world.delay_s
    topic = world.topic("/cmd_vel", member, [Right.PUBLISH])
    options = SendOptions(fec=fec)
    publisher = member.advertise(topic, b"described", reliable=reliable, urgent=urgent, options=options)
    world.network.send_pending("s0/robot")
    flow = Flow(world, "/cmd_vel", "s0/robot", topic, publisher)
    reader = world.members[READER]
    reader.subscribe(world.topic("/cmd_vel", reader, [Right.READ]))
    world.network.send_pending(READER)
    assert world.network.run(5, lambda: flow.is_read_by(1))
    world.network.run(1.0)
    reader.poll_messages()
    made = Radio(flow, cable)
    world.network.taps.append(made.tap)
    cable.loss = loss
    return made


@pytest.mark.parametrize("count", [2_000, *nightly(4_000, 20_000)])
def test_urgent_messages_survive_5_percent_of_loss_without_a_round_trip(count: int) -> None:
    made = radio(loss=0.05, seed=2)
    made.publish(count, 0.02)
    assert len(made.late) <= 0.001 * made.sent
    assert len(set(made.came)) == len(made.came) >= 0.999 * made.sent
    assert made.came == sorted(made.came)
    assert made.alarms() == {}


def test_reliable_urgent_messages_come_in_time_and_are_hardly_ever_requested() -> None:
    made = radio(loss=0.05, reliable=True)
    made.publish(2_000, 0.02)
    assert made.came == list(range(made.sent))
    assert len(made.late) <= 0.01 * made.sent  # later messages wait for the one that is repaired
    assert made.flow.publisher.protection.repairs <= 0.002 * made.sent
    assert made.alarms() == {}


def test_without_loss_no_copy_leaves_after_the_first_seconds() -> None:
    made = radio(loss=0.0)
    begun_s = made.now_s
    made.publish(1_000, 0.02)
    assert made.copy_s
    assert max(made.copy_s) < begun_s + 8.0
    assert made.late == []
    assert made.came == list(range(made.sent))


def test_a_burst_that_loses_what_leaves_within_milliseconds_does_not_lose_all_copies() -> None:
    made = radio(loss=0.0, seed=3)
    network, rng = made.flow.world.network, random.Random(3)

    def fade(loss: float, pause_s: float) -> None:
        """Lose everything for the time of three frames of 1,500 bytes at 14 Mbit/s, then nothing for a while."""
        made.cable.loss = loss
        after_s = rng.expovariate(20.0) if loss else 0.0026
        network.call(pause_s, partial(fade, 1.0 - loss, after_s))

    fade(0.0, 0.05)
    made.publish(1_500, 0.02)
    assert len(made.late) <= 0.004 * made.sent
    assert made.alarms() == {}


@pytest.mark.parametrize("fec", [True, False])
def test_copies_keep_within_their_bytes_at_5_khz(fec: bool) -> None:
    made = radio(loss=0.05, fec=fec)
    begun_s = made.now_s
    made.publish(2_500, 0.0002)
    assert made.copied_bytes <= (0.25 + made.now_s - begun_s) * 64_000 * 1.1
    assert bool(made.copied_bytes) is fec


def test_topics_that_are_not_urgent_are_sent_once() -> None:
    made = radio(loss=0.05, urgent=False)
    made.publish(100, 0.02)
    assert made.copy_s == []


def test_copies_begin_when_loss_begins() -> None:
    made = radio(loss=0.0)
    made.publish(500, 0.02)
    made.cable.loss = 0.05
    made.publish(250, 0.02)
    late, sent = len(made.late), made.sent
    made.publish(1_000, 0.02)
    assert len(made.late) - late <= 0.005 * (made.sent - sent)


@pytest.mark.parametrize(("loss", "least", "most"), [(0.0, 0, 8), (0.05, 15, 25)])
def test_joins_are_renewed_more_often_over_a_link_that_loses_frames(loss: float, least: int, most: int) -> None:
    made = radio(loss=loss)
    network = made.flow.world.network
    network.run(20.0)  # keepalives measure the link
    refreshes = set()

    def count(_at_s: float, a: str, _b: str, frame: bytes) -> None:
        header = decode(frame, ETHER_BYTES)
        if a == "s1" and header.kind == Kind.JOIN_REFRESH:
            refreshes.add(header.number)

    network.taps.append(count)
    network.run(10.0)
    assert least <= len(refreshes) <= most
