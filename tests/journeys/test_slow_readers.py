"""Slow reader among many: best-effort traffic continues, reliable traffic waits for a bounded time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import pytest

from gdp.client.participant import Participant
from gdp.errors import DropReason
from gdp.frame.codec import CONTROL_FROM, decode
from gdp.intervals import READER
from gdp.limits import WINDOW_BYTES
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from lab.simulation import Simulation
from lab.topology import chain
from tests.journeys.flows import LEASE_S, Flow, flowing
from tests.lanes import nightly

SOURCE, NEAR, FAR, SLOW = "s1/left", "s1/near", "s3/right", "s2/slow"
QUEUE_FRAMES = 64  # of the slow reader
SOON_S = 0.02  # more than the path needs, less than any timer of a publisher or reader


class Behind:
    """Member whose program is slow: data waits in its socket's short queue, statements of neighbours do not.

    Attributes:
        frames_s: how many frames a second get through; 0: none.
        dropped: frames that found the queue full.
    """

    def __init__(self, member: Participant, frames_s: float) -> None:
        self._member = member
        self._queue = deque[tuple[float, ReceivedFrame]]()  # with the time of arrival
        self._at_s = 0.0
        self.frames_s = frames_s
        self.dropped = 0

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        self._member.add_port(index, mac, mtu, cost, now)

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        for arrival in arrivals:
            if decode(arrival.frame).kind >= CONTROL_FROM:
                self._member.receive([arrival], now)
            elif len(self._queue) < QUEUE_FRAMES:
                self._at_s = self._at_s if self._queue else max(self._at_s, now.mono_s)
                self._queue.append((now.mono_s, arrival))
            else:
                self.dropped += 1

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        self._member.port_changed(port, up, now)

    def handle_timer(self, now: Timestamps) -> None:
        while self._queue and self.frames_s and self._at_s <= now.mono_s:
            self._at_s += 1 / self.frames_s
            came_s, arrival = self._queue.popleft()
            self._member.receive([arrival._replace(waited_s=now.mono_s - came_s)], now)
        self._member.handle_timer(now)

    def get_timer(self) -> float | None:
        due_s = self._member.get_timer()
        if not self._queue or not self.frames_s:
            return due_s
        return self._at_s if due_s is None else min(due_s, self._at_s)

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        self._member.count_arrivals(frames_from)

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        return self._member.poll_neighbours()

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        return self._member.frames_to_send(now_s)

    def frames_sent(self, now_s: float) -> None:
        self._member.frames_sent(now_s)


def world_with_a_slow_one(frames_s: float) -> tuple[Simulation, Behind]:
    """Return three switches, a source with a local reader, a far reader, and a slow one on the path."""
    world = Simulation(topology=chain(3), lease_s=LEASE_S)
    world.add_member(NEAR, "s1")
    slow = Behind(world.add_member(SLOW, "s2"), frames_s)
    world.network.replace(SLOW, slow)
    assert world.run_until_attached()
    return world, slow


def late_of(flow: Flow, count: int, every_s: float, size: int, labels: Sequence[str]) -> list[tuple[str, int]]:
    """Stream from now on; the list fills with messages that reached a reader late or never."""
    late: list[tuple[str, int]] = []

    def look(label: str, number: int) -> None:
        if number not in flow.numbers(label):
            late.append((label, number))

    flow.stream(count, every_s, size)
    for number in range(count):
        for label in labels:
            flow.world.network.call(number * every_s + SOON_S, partial(look, label, number))
    return late


def test_best_effort_a_slow_reader_makes_the_others_neither_lose_nor_wait() -> None:
    world, slow = world_with_a_slow_one(frames_s=50)
    flow = flowing(world, source=SOURCE, readers=(NEAR, FAR, SLOW), reliable=False)
    world.network.run(0.1)  # a counted reader has not yet received its first number
    late = late_of(flow, 400, 0.005, 500, (NEAR, FAR))
    world.network.run(20)
    assert late == []
    assert flow.numbers(NEAR) == flow.numbers(FAR) == list(range(400))
    got = flow.numbers(SLOW)
    assert got == sorted(set(got))
    assert len(got) + slow.dropped == 400
    (writer_proxy,) = world.members[SLOW].subscriptions.writer_proxies()
    assert writer_proxy.losses.total == 400 - len(got) > 0
    flow.outlive()


def test_reliable_a_slow_reader_slows_its_own_publisher_and_no_other_topic_of_the_node() -> None:
    world, slow = world_with_a_slow_one(frames_s=0)
    slow.frames_s = 1e6
    held = flowing(world, "/held", SOURCE, (NEAR, SLOW))
    other = flowing(world, "/other", SOURCE, (FAR,))
    slow.frames_s = 0
    held.stream(200, 0.001, size=50_000)  # more than may be in flight
    late = late_of(other, 400, 0.01, 500, (FAR,))
    world.network.run(4)
    assert len(held.numbers(NEAR)) < 200  # it waits for the slow one
    world.network.run(1)
    assert late == []
    assert world.network.run(2 * READER.lease_s, lambda: held.has(NEAR, 200))
    assert held.numbers(NEAR) == list(range(200))
    other.outlive()


@pytest.mark.parametrize("frames_s", [0, *nightly(20)])
def test_reliable_after_the_lease_the_slow_one_holds_nothing_and_learns_what_it_will_not_get(frames_s: int) -> None:
    world, slow = world_with_a_slow_one(frames_s=1e6)
    flow = flowing(world, source=SOURCE, readers=(NEAR, FAR, SLOW))
    world.network.run(SOON_S)  # the slow one knows where to begin
    slow.frames_s = frames_s
    flow.stream(200, 0.001, size=50_000)
    assert world.network.run(4 * READER.lease_s, lambda: flow.has(NEAR, 200) and flow.has(FAR, 200))
    assert world.network.run(5, flow.publisher.is_acknowledged)
    assert len(flow.numbers(SLOW)) < 200
    slow.frames_s = 1e6
    world.network.run(2)  # it takes the frames that still wait for it
    flow.publish((1_000).to_bytes(4, "big"))
    assert world.network.run(10, lambda: all(flow.numbers(label)[-1:] == [1_000] for label in (NEAR, FAR, SLOW)))
    (writer_proxy,) = world.members[SLOW].subscriptions.writer_proxies()
    assert len(flow.got[SLOW]) + writer_proxy.losses.total == 201
    assert flow.numbers(NEAR) == flow.numbers(FAR) == [*range(200), 1_000]
    flow.outlive()


def test_reliable_a_reader_that_lagged_holds_its_publisher_again_only_after_a_suspension() -> None:
    world, slow = world_with_a_slow_one(frames_s=1e6)
    flow = flowing(world, source=SOURCE, readers=(NEAR, SLOW))
    slow.frames_s = 0
    flow.stream(200, 0.001, size=50_000)
    assert world.network.run(4 * READER.lease_s, lambda: flow.has(NEAR, 200))
    slow.frames_s = 1e6
    world.network.run(0.5)  # it reports again
    slow.frames_s = 0
    before = len(flow.numbers(NEAR))
    flow.stream(200, 0.001, size=50_000)
    assert world.network.run(2, lambda: flow.has(NEAR, before + 200))  # no reader waited for it
    flow.outlive(NEAR)


def test_a_reader_that_dies_holds_its_publisher_for_no_longer_than_its_lease() -> None:
    world, _ = world_with_a_slow_one(frames_s=1e6)
    flow = flowing(world, source=SOURCE, readers=(NEAR, SLOW))
    world.network.stop(SLOW)
    flow.stream(200, 0.001, size=50_000)
    assert world.network.run(READER.lease_s + 1, lambda: flow.has(NEAR, 200))
    assert flow.numbers(NEAR) == list(range(200))
    assert flow.is_read_by(1)
    flow.outlive(NEAR)


def test_best_effort_the_oldest_unsent_messages_are_dropped_and_counted() -> None:
    world, _ = world_with_a_slow_one(frames_s=1e6)
    flow = flowing(world, source=SOURCE, readers=(FAR,), reliable=False)
    world.network.set_link(world.leads[SOURCE], up=False)
    size, count = 1_000_000, 50
    for number in range(count):
        flow.publish(number.to_bytes(4, "big") + bytes(size - 4))
    dropped = flow.publisher.drops[DropReason.MEMORY_FULL]
    kept = count - dropped
    assert kept * size <= WINDOW_BYTES < (kept + 1) * (size + size // 8)
    world.network.set_link(world.leads[SOURCE], up=True)
    assert world.network.run(4, lambda: flow.has(FAR, kept))
    assert flow.numbers(FAR) == list(range(dropped, count))
    flow.outlive()
