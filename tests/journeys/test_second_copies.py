"""Ends of a flow with two paths: no message is late, lost or doubled when one path fails or loses frames."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass, field
from functools import partial

import pytest

from gdp.client.participant import Participant
from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, HOPS_AT, SECOND_PATH, Header, Kind, decode, encode
from gdp.sansio import ReceivedFrame
from gdp.trust.right import Right
from lab.network import SimLink
from tests.journeys.flows import Flow
from tests.journeys.services import Party, meet, work
from tests.journeys.test_two_paths import Site, site
from tests.lanes import nightly

pytestmark = pytest.mark.momentary("a cut, and the seconds before and after it, are what these tests are about")

READER = "s1/rs1"
PERIOD_S = 0.02
SLOW_S = 0.015  # delay of the second link
LATE_S = SLOW_S + 0.008  # delay of the slower path as a whole, below every report and repair
ALARMS = (DropReason.REPLAYED, DropReason.LATE, DropReason.DUPLICATE)


@dataclass
class Pair:
    """A publisher and a reader with two links between their switches, the second one slower."""

    at: Site
    flow: Flow
    period_s: float = PERIOD_S
    sent: int = 0
    late: list[int] = field(default_factory=list)

    @property
    def reader(self) -> Participant:
        """Return the reader."""
        return self.at.world.members[READER]

    @property
    def cables(self) -> list[SimLink]:
        """Return the faster and the slower link."""
        return [cable for _, _, cable in self.at.cables]

    def publish(self, count: int, size: int) -> None:
        """Publish numbered messages from now on, and note which of them come late."""
        for place in range(count):
            number = self.sent + place
            message = number.to_bytes(4, "big") + bytes(size)
            self.at.world.network.call(place * self.period_s, partial(self.flow.publish, message))
            self.at.world.network.call(place * self.period_s + LATE_S, partial(self._check, number))
        self.sent += count

    def _check(self, number: int) -> None:
        if number not in self.flow.numbers(READER):
            self.late.append(number)

    def check_all_came(self) -> None:
        """Check that every message came once, in order, in time, and that nothing looks like an attack."""
        assert self.late == []
        assert self.flow.numbers(READER) == list(range(self.sent))
        assert self.reader.subscriptions.losses_of(self.flow.topic.name).total == 0
        drops = Counter(self.reader.drops()) + Counter(self.flow.member.drops())
        assert {reason: count for reason, count in drops.items() if reason in ALARMS and count} == {}


def pair(*, reliable: bool = True, paths: int = 2, seed: int = 1) -> Pair:
    """Return a settled pair; a message has come over each link."""
    at = site([("s0", "s1", 10), ("s0", "s1", 12)], ("s1",), seed=seed)
    at.cables[1][2].delay_s = SLOW_S
    world, member = at.world, at.world.members["s0/robot"]
    topic = world.topic("/camera", member, [Right.PUBLISH])
    publisher = member.advertise(topic, b"described", reliable=reliable, paths=2)
    world.network.send_pending("s0/robot")
    flow = Flow(world, "/camera", "s0/robot", topic, publisher)
    flow.got[READER] = []
    reader = world.members[READER]
    reader.subscribe(world.topic("/camera", reader, [Right.READ]), paths=paths)
    world.network.send_pending(READER)
    assert world.network.run(5, lambda: flow.is_read_by(1))
    world.network.run(4.0)
    made = Pair(at, flow)
    made.publish(20, 200)
    world.network.run(2.0)
    assert made.late == []
    return made


@pytest.mark.parametrize(
    ("which", "reliable", "size"),
    [
        (0, True, 200),
        (0, False, 20_000),
        (1, True, 20_000),
        *nightly((0, True, 20_000), (0, False, 200), (1, True, 200), (1, False, 200), (1, False, 20_000)),
    ],
)
def test_a_path_that_fails_at_any_moment_costs_nothing(which: int, reliable: bool, size: int) -> None:
    rng = random.Random(size + which)
    made = pair(reliable=reliable, seed=which + 1)
    for _ in range(2):
        made.publish(150, size)
        made.at.world.network.run(1.0 + rng.random() * PERIOD_S)
        made.cables[which].loss = 1.0
        made.at.world.network.run(2.5)
        made.cables[which].loss = 0.0
        made.at.world.network.run(6.0)
    made.check_all_came()
    assert made.reader.drops()[DropReason.SECOND_COPY]


@pytest.mark.parametrize(
    ("reliable", "period_s"), [(True, PERIOD_S), (False, 0.003), *nightly((True, 0.003), (False, PERIOD_S))]
)
def test_what_one_path_loses_is_awaited_from_the_other_and_not_requested(reliable: bool, period_s: float) -> None:
    made = pair(reliable=reliable)
    made.period_s = period_s
    made.cables[0].loss = 0.05
    made.publish(400, 3_000)
    made.at.world.network.run(1.0 + 400 * period_s)
    made.check_all_came()
    assert made.flow.publisher.protection.repairs == 0


def test_what_neither_path_brings_is_requested() -> None:
    made = pair()
    made.cables[0].loss = made.cables[1].loss = 0.05
    made.publish(200, 10_000)
    made.at.world.network.run(2.0 + 200 * PERIOD_S)
    assert made.flow.numbers(READER) == list(range(made.sent))
    assert made.reader.subscriptions.losses_of(made.flow.topic.name).total == 0
    assert 0 < made.flow.publisher.protection.repairs < 100


def test_a_reader_confirms_over_both_paths_and_its_reports_count_once() -> None:
    made = pair()
    notes: list[bytes] = []

    def tap(_at_s: float, a: str, _b: str, frame: bytes) -> None:
        if a == READER and decode(frame, ETHER_BYTES).kind == Kind.ACKNACK:
            notes.append(frame[ETHER_BYTES:])

    made.at.world.network.taps.append(tap)
    made.publish(50, 200)
    made.at.world.network.run(2.0)
    second = [note for note in notes if note[HOPS_AT] & SECOND_PATH]
    assert len(notes) == 2 * len(second) > 0
    assert made.flow.publisher.acknowledgements.acknowledged == made.sent
    assert made.flow.publisher.is_acknowledged()
    made.check_all_came()


def test_without_a_reader_that_wants_two_paths_nothing_is_sent_twice() -> None:
    made = pair(paths=1)
    copies = [frame for _, frame in _frames(made, 10) if frame[HOPS_AT] & SECOND_PATH]
    assert copies == []


def test_a_second_copy_is_the_first_but_for_one_bit() -> None:
    made = pair()
    frames = [frame for kind, frame in _frames(made, 10) if kind == Kind.DATA]
    first = [frame for frame in frames if not frame[HOPS_AT] & SECOND_PATH]
    second = [frame for frame in frames if frame[HOPS_AT] & SECOND_PATH]
    without = [frame[:HOPS_AT] + bytes([frame[HOPS_AT] & ~SECOND_PATH]) + frame[HOPS_AT + 1 :] for frame in second]
    assert without == first


@pytest.mark.parametrize("which", [0, 1], ids=["faster", "slower"])
def test_a_call_over_two_paths_is_answered_in_time_while_one_of_them_fails(which: int) -> None:
    at = site([("s0", "s1", 10), ("s0", "s1", 12)], ("s1",))
    at.cables[1][2].delay_s = SLOW_S
    network = at.world.network
    server = Party(at.world, "s0/robot", Right.SERVE, paths=2)
    client = Party(at.world, READER, Right.CALL, paths=2)
    assert meet(at.world, server, client)
    work(at.world, server, client, until_s=4.0)
    late: list[int] = []

    def check(number: int) -> None:
        if b"%d by s0/robot" % number not in client.bodies():
            late.append(number)

    for number in range(100):
        network.call(number * 0.05, partial(client.publish, b"%d" % number))
        network.call(number * 0.05 + 2 * LATE_S, partial(check, number))
    work(at.world, server, client, until_s=1.0)
    at.cables[which][2].loss = 1.0
    work(at.world, server, client, until_s=2.5)
    at.cables[which][2].loss = 0.0
    work(at.world, server, client, until_s=4.0)
    assert late == []
    assert client.bodies() == [b"%d by s0/robot" % number for number in range(100)]


def test_answers_are_sent_once_where_no_second_path_leads_to_the_client() -> None:
    at = site([("s0", "s1", 10)], ("s1",))
    seen: list[int] = []

    def tap(_at_s: float, a: str, _b: str, frame: bytes) -> None:
        header = decode(frame, ETHER_BYTES)
        if a == "s0/robot" and header.kind == Kind.DATA:
            seen.append(header.hops_left & SECOND_PATH)

    at.world.network.taps.append(tap)
    server = Party(at.world, "s0/robot", Right.SERVE, paths=2)
    client = Party(at.world, READER, Right.CALL, paths=2)
    assert meet(at.world, server, client)
    client.publish(b"1")
    assert work(at.world, server, client, until_s=5.0, have=1)
    assert seen == [0]


def test_a_second_copy_to_an_unknown_name_is_dropped_and_no_rib_is_asked() -> None:
    made = pair()
    world, robot = made.at.world, made.flow.member
    switch = world.switches["s0"]
    (link,) = [each for each in switch.hello_protocol.neighbours.all_up() if each.name == robot.name]
    header = Header(Kind.DATA, 0, SECOND_PATH | 64, 0, 0, 1, 0, 1, 1, b"\x55" * 32, robot.name)
    switch.frames_to_send(0.0)
    before = Counter(switch.drops())
    switch.receive([ReceivedFrame(link.port, link.mac, encode(header))], world.network.now)
    assert Counter(switch.drops()) - before == {DropReason.NO_SECOND_PATH: 1}
    assert switch.frames_to_send(0.0) == []


def _frames(made: Pair, count: int) -> list[tuple[int, bytes]]:
    """Return the frames that the publisher sends while it publishes some messages, with their kinds."""
    frames: list[tuple[int, bytes]] = []

    def tap(_at_s: float, a: str, _b: str, frame: bytes) -> None:
        kind = decode(frame, ETHER_BYTES).kind
        if a == "s0/robot" and kind in (Kind.DATA, Kind.HEARTBEAT):
            frames.append((kind, frame[ETHER_BYTES:]))

    made.at.world.network.taps.append(tap)
    made.publish(count, 5_000)
    made.at.world.network.run(2.0)
    assert frames
    return frames
