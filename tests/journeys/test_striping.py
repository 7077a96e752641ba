"""Large messages over two paths: each carries what it can, and either may fail."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.client.participant import Participant
from gdp.frame.codec import ETHER_BYTES, SECOND_PATH, Kind, decode
from gdp.limits import SPREAD
from gdp.trust.right import Right
from tests.journeys.flows import Flow
from tests.journeys.test_two_paths import Site, site
from tests.lanes import nightly

pytestmark = pytest.mark.momentary("shares of paths within seconds are what these tests are about")

READER = "s1/rs1"
SIZE = 60_000
EVERY_S = 0.1


class Striped:
    """A publisher and a reader, with two links of given rates (bytes a second) between their switches."""

    def __init__(self, rates: tuple[float, float], *, reliable: bool = True, paths: int = SPREAD) -> None:
        self.at: Site = site([("s0", "s1", 10), ("s0", "s1", 12)], ("s1",))
        world, member = self.at.world, self.at.world.members["s0/robot"]
        self.network, self.cables = world.network, [cable for _, _, cable in self.at.cables]
        topic = world.topic("/camera", member, [Right.PUBLISH])
        publisher = member.advertise(topic, b"described", reliable=reliable, paths=paths)
        world.network.send_pending("s0/robot")
        self.flow = Flow(world, "/camera", "s0/robot", topic, publisher)
        self.flow.got[READER] = []
        self.reader: Participant = world.members[READER]
        self.reader.subscribe(world.topic("/camera", self.reader, [Right.READ]), paths=paths)
        world.network.send_pending(READER)
        assert world.network.run(5, lambda: self.flow.is_read_by(1))
        world.network.run(4.0)
        for cable, rate in zip(self.cables, rates, strict=True):
            cable.bytes_s = rate
        self.bytes_by_cable = [0, 0]
        self.sent_s: dict[int, float] = {}
        self.came_s: dict[int, float] = {}
        world.network.taps.append(self._tap)

    def _tap(self, _at_s: float, a: str, b: str, frame: bytes) -> None:
        if (a, b) == ("s0", "s1"):
            header = decode(frame, ETHER_BYTES)
            if header.kind == Kind.DATA:
                self.bytes_by_cable[header.hops_left & SECOND_PATH > 0] += len(frame)

    def _has(self, number: int) -> bool:
        return number in self.flow.numbers(READER)

    def run(self, count: int) -> list[float]:
        """Publish messages one after the other; return how long each took."""
        took = []
        for _ in range(count):
            number = len(self.sent_s)
            begun_s = self.sent_s[number] = self.network.now.mono_s
            self.flow.publish(number.to_bytes(4, "big") + bytes(SIZE))
            assert self.network.run(5.0, partial(self._has, number)), number
            took.append(self.network.now.mono_s - begun_s)
            self.network.run(max(begun_s + EVERY_S - self.network.now.mono_s, 0.0))
        return took

    def second_share(self) -> float:
        """Return which part of the data bytes went over the second path since the last call."""
        first, second = self.bytes_by_cable
        self.bytes_by_cable = [0, 0]
        return second / (first + second)


@pytest.mark.parametrize(
    ("rates", "share", "reliable"),
    [
        ((2e6, 2e6), 0.5, True),
        ((4e6, 1e6), 0.2, False),
        ((1e6, 4e6), 0.8, True),
        *nightly(((2e6, 2e6), 0.5, False), ((4e6, 1e6), 0.2, True), ((1e6, 4e6), 0.8, False)),
    ],
)
def test_each_path_carries_what_it_can(rates: tuple[float, float], share: float, reliable: bool) -> None:
    striped = Striped(rates, reliable=reliable)
    striped.run(20)
    striped.second_share()
    took = striped.run(20)
    assert striped.second_share() == pytest.approx(share, abs=0.08)
    assert sum(took) / 20 < 1.2 * SIZE / sum(rates) + 0.004
    assert striped.flow.numbers(READER) == list(range(40))


@pytest.mark.parametrize("which", [1, *nightly(0)])
def test_a_path_that_fails_takes_no_message_along_and_gets_its_share_back(which: int) -> None:
    striped = Striped((2e6, 2e6))
    striped.run(10)
    striped.cables[which].loss = 1.0
    striped.run(10)
    took = striped.run(5)
    assert max(took) < 1.3 * SIZE / 2e6 + 0.02
    striped.cables[which].loss = 0.0
    striped.run(60)
    striped.second_share()
    striped.run(10)
    assert striped.second_share() == pytest.approx(0.5, abs=0.15)
    assert striped.flow.numbers(READER) == list(range(95))
    assert striped.reader.subscriptions.losses_of(striped.flow.topic.name).total == 0


def test_short_messages_take_both_paths() -> None:
    striped = Striped((2e6, 2e6))
    striped.flow.publish((0).to_bytes(4, "big") + bytes(100))
    striped.network.run(1.0)
    assert striped.second_share() == pytest.approx(0.5)
