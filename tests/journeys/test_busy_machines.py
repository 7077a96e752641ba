"""Fast paths between machines whose programs wait for a processor: these waits are no congestion."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import pytest

from gdp.client.participant import Participant
from gdp.client.send_options import SendOptions
from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from lab.network import SimNetwork
from lab.simulation import Simulation
from tests.journeys.flows import advertise
from tests.journeys.test_short_queues import PAIR

SENDER, READER = "a/robot", "b/reader"
BYTES_S = 300e6  # that a program seals or opens
IMAGE_BYTES, EVERY_S = 921_600, 1 / 30
FIRST = 6  # images, after which the path is known
COUNT = 24


class Program:
    """Member whose program waits for a processor each time that frames have come, and works for each byte.

    Args:
        wait_s: shortest and longest wait.
        hidden_s: up to so much of it is in the kernel, or before a report leaves, where no clock of an end sees it.
        seed: of the waits.
    """

    def __init__(
        self,
        member: Participant,
        network: SimNetwork,
        label: str,
        wait_s: tuple[float, float],
        hidden_s: float,
        seed: int = 0,
    ) -> None:
        self._member, self._network, self._label = member, network, label
        self._wait_s, self._hidden_s = wait_s, hidden_s
        self._random = random.Random(f"{label} {seed}" if seed else label)
        self._came: list[tuple[float, ReceivedFrame]] = []
        self._free_s = 0.0

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        self._member.add_port(index, mac, mtu, cost, now)

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        self._member.count_arrivals(frames_from)

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        if not self._came:
            busy_s = max(self._free_s - now.mono_s, 0.0)
            self._network.call(busy_s + self._random.uniform(*self._wait_s), self._read)
        self._came += ((now.mono_s, arrival) for arrival in arrivals)

    def _read(self) -> None:
        came, self._came = self._came, []
        now, hidden_s = self._network.now, self._random.uniform(0.0, self._hidden_s)
        waited = [each._replace(waited_s=max(now.mono_s - at_s - hidden_s, 0.0)) for at_s, each in came]
        self._member.receive(waited, now)
        self._work(now.mono_s, sum(len(each.frame) for each in waited))

    def _work(self, now_s: float, size: int) -> None:
        self._free_s = now_s + size / BYTES_S
        self._network.call(size / BYTES_S, partial(self._network.send_pending, self._label))

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        self._member.port_changed(port, up, now)

    def handle_timer(self, now: Timestamps) -> None:
        self._member.handle_timer(now)

    def get_timer(self) -> float | None:
        due_s = self._member.get_timer()
        return None if due_s is None or self._came else max(due_s, self._free_s)

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        return self._member.poll_neighbours()

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        if now_s < self._free_s - 1e-9:
            return []
        transmits = self._member.frames_to_send(now_s)
        if transmits:
            self._work(now_s, sum(len(frame) for each in transmits for frame in each.frames))
        return transmits

    def frames_sent(self, now_s: float) -> None:
        self._member.frames_sent(now_s)


@pytest.mark.momentary("what is tried is how long single images take")
@pytest.mark.parametrize(
    ("wait_s", "hidden_s", "is_reliable"),
    [((0.0002, 0.003), 0.003, True), ((0.0001, 0.02), 0.012, True), ((0.0001, 0.02), 0.012, False)],
)
def test_an_image_does_not_wait_for_reports_that_wait_for_a_processor(
    wait_s: tuple[float, float], hidden_s: float, *, is_reliable: bool
) -> None:
    world = Simulation(topology=PAIR, keepalive_ms=None)
    network = world.network
    for link in (*world.cables.values(), *world.leads.values()):
        link.delay_s = 0.00002
    for label, each_hidden_s in ((SENDER, hidden_s), (READER, 0.0)):
        network.replace(label, Program(world.members[label], network, label, wait_s, each_hidden_s))
    assert world.run_until_attached()
    flow = advertise(world, "/image", SENDER, reliable=is_reliable)
    flow.read_by(READER)
    assert network.run(5, lambda: flow.is_read_by(1))
    begun_s: list[float] = []
    left_s: dict[int, float] = {}

    def tap(at_s: float, start: str, _: str, frame: bytes) -> None:
        if start == SENDER and (header := decode(frame, ETHER_BYTES)).kind == Kind.DATA:
            left_s[header.number] = at_s

    network.taps.append(tap)
    for number in range(COUNT):
        begun_s.append(network.now.mono_s)
        flow.publish(number.to_bytes(4, "big") + bytes(IMAGE_BYTES))
        network.run(EVERY_S)
    network.run(1)
    assert flow.numbers(READER) == list(range(COUNT))
    took_s = [left_s[number] - at_s for number, at_s in zip(sorted(left_s), begun_s, strict=True)]
    late = [each for each in took_s[FIRST:] if each > 1.25 * IMAGE_BYTES / BYTES_S]
    assert len(late) <= (COUNT - FIRST) // 10, late


@pytest.mark.momentary("what is tried is how fast what may wait leaves")
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    ("wait_s", "hidden_s", "least_bytes_s"),
    [((0.0001, 0.003), 0.003, 20e6), ((0.0001, 0.02), 0.005, 2e6), ((0.002, 0.04), 0.012, 0.5e6)],
)
def test_what_may_wait_does_not_take_waits_for_a_processor_for_a_queue(
    wait_s: tuple[float, float], hidden_s: float, least_bytes_s: float, seed: int
) -> None:
    world = Simulation(topology=PAIR, keepalive_ms=None)
    network = world.network
    for link in (*world.cables.values(), *world.leads.values()):
        link.delay_s = 0.00002
    for label in (SENDER, READER):
        network.replace(label, Program(world.members[label], network, label, wait_s, hidden_s, seed))
    assert world.run_until_attached()
    flow = advertise(world, "/history", SENDER, options=SendOptions(priority="background"))
    flow.read_by(READER)
    assert network.run(5, lambda: flow.is_read_by(1))
    for number in range(200):
        flow.publish(number.to_bytes(4, "big") + bytes(40_000))
    assert network.run(8e6 / least_bytes_s, lambda: flow.has(READER, 200))
