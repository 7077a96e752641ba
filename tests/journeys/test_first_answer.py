"""A request to two servers: a slow, lossy or silent one does not delay the answer of the near one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from statistics import median
from typing import Final

import pytest

from gdp.client.participant import Participant, Topic
from gdp.frame.codec import CONTROL_FROM, ETHER_BYTES, Kind, decode
from gdp.message.loss import LossReason
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from gdp.service.replication import ALL
from gdp.session.protocol.client_core import Call
from gdp.session.protocol.server_core import ServerCore
from gdp.session.protocol.wire import message_to_wire
from gdp.trust.right import Right
from lab.network import SimLink
from tests.draws import IS_LONG
from tests.gdp.session.simulated import Simulated, world_of
from tests.lanes import nightly

ROBOT, NEAR, OTHER, WATCH = "robot", "near", "other", "watch"
NEAR_S, UPLINK_BYTES_S, SERVER_BYTES_S, FIFO_S = 0.005, 100e6 / 8, 1e9 / 8, 0.1
EVERY_S: Final = 0.25
CALLS: Final = {100: 40, 307_200: 10, 2_000_000: 4} if IS_LONG else {100: 20, 307_200: 6, 2_000_000: 3}  # by bytes
LARGE: Final = max(CALLS)
CASES: Final = ("far", "thin", "lossy", "stalled")
JOINED_AFTER, REQUESTS = 40, 120 if IS_LONG else 80  # requests: before a server joins, and in all
SHARE: Final = 1.1  # of the time of the near server alone

pytestmark = pytest.mark.momentary("it is about how long a call takes, and all leases stand meanwhile")


class Stalled:
    """Member that still speaks with its switch, and gets no data any more."""

    def __init__(self, member: Participant) -> None:
        self._member = member
        self.add_port, self.port_changed = member.add_port, member.port_changed
        self.count_arrivals, self.poll_neighbours = member.count_arrivals, member.poll_neighbours
        self.handle_timer, self.get_timer, self.frames_sent = (
            member.handle_timer,
            member.get_timer,
            member.frames_sent,
        )

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        self._member.receive([each for each in arrivals if decode(each.frame).kind >= CONTROL_FROM], now)

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        return self._member.frames_to_send(now_s)


@dataclass
class Replicas:
    """Robot, its switch, and one or two servers that answer at once."""

    servers: tuple[str, ...]
    near_s: float = NEAR_S
    uplink_bytes_s: float = UPLINK_BYTES_S
    net: Simulated = field(init=False)
    links: Mapping[str, SimLink] = field(init=False)
    serving: dict[str, ServerCore] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rights: dict[str, dict[str, list[Right]]] = {each: {"plan": [Right.SERVE]} for each in self.servers}
        rights[ROBOT] = {"plan": [Right.CALL]}
        rights[WATCH] = {"news": [Right.PUBLISH]}
        for each in self.servers:
            rights[each]["news"] = [Right.READ]
        self.net = world_of(rights)
        leads = self.net.world.leads
        self.links = {each: leads[f"s/{each}"] for each in rights}
        for each in self.servers:
            link = self.links[each]
            link.delay_s, link.bytes_s, link.fifo_s = self.near_s, SERVER_BYTES_S, FIFO_S
        self.links[ROBOT].bytes_s, self.links[ROBOT].fifo_s = self.uplink_bytes_s, FIFO_S

    def begin(self, case: str) -> None:
        """Let the other server be as the case says, and the client know both."""
        other = self.links.get(OTHER, SimLink())
        if case == "far":
            other.delay_s += 0.1
        elif case == "thin":
            other.bytes_s = 1e6 / 8
        elif case == "lossy":
            other.loss = 0.05
        for label in self.servers:
            self.serve(label)
        self.call(1, 1)
        member = self.net.cores[ROBOT].member
        assert self.run(10.0, lambda: len(member.services.peers(self.topic.name)) == len(self.servers))
        self.call(1, 2)
        if case == "stalled":
            self.net.world.network.replace(f"s/{OTHER}", Stalled(self.net.cores[OTHER].member))
        elif case == "frozen":
            self.freeze(OTHER)

    def serve(self, label: str) -> None:
        """Let a server serve from now on."""
        core = self.net.cores[label]
        self.serving[label] = core.serve(core.resolve("plan", Right.SERVE), at_once=None, is_global=True, urgent=False)
        self.net.send(label)

    def freeze(self, label: str) -> None:
        del self.serving[label]
        self.net.world.network.freeze(f"s/{label}")

    @property
    def topic(self) -> Topic:
        return self.net.cores[ROBOT].resolve("plan", Right.CALL)

    def run(self, duration_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass, and servers answer."""

        def work() -> bool:
            for label in (ROBOT, *self.serving):
                core = self.net.cores[label]
                core.handle(self.net.now_s)
                server = self.serving.get(label)
                while server is not None and server.turns:
                    server.finish(server.turns.popleft().number, b"done", self.net.now_s)
                self.net.send(label)
            return until()

        return self.net.world.network.run(duration_s, work)

    def call(self, size: int, count: int, every_s: float = EVERY_S) -> list[float]:
        """Call again and again; return how many seconds each call took."""
        core, took_s = self.net.cores[ROBOT], list[float]()
        for _ in range(count):
            call, begun_s = Call(payload=bytes(size), timeout_s=20.0, replication=ALL), self.net.now_s
            core.call(self.topic, call, begun_s)
            self.net.send(ROBOT)
            assert self.run(20.0, lambda call=call: call.is_done)  # type: ignore[misc]
            assert call.response is not None, call.error
            took_s.append(self.net.now_s - begun_s)
            self.run(max(begun_s + every_s - self.net.now_s, 0.0))
        return took_s

    def count_frames(self, from_label: str, to_label: str) -> list[int]:
        """Return a list of one number: the bytes of data that enter a link from now on."""
        seen = [0]

        def tap(_at_s: float, a: str, b: str, frame: bytes) -> None:
            if (a, b) == (from_label, to_label) and decode(frame, ETHER_BYTES).kind in (Kind.DATA, Kind.PARITY):
                seen[0] += len(frame)

        self.net.world.network.taps.append(tap)
        return seen


@cache
def near_alone(size: int, uplink_bytes_s: float = UPLINK_BYTES_S) -> list[float]:
    replicas = Replicas((NEAR,), uplink_bytes_s=uplink_bytes_s)
    replicas.begin("alone")
    return replicas.call(size, CALLS[size])


def assert_as_fast(took_s: list[float], alone_s: list[float]) -> None:
    said = [round(1e3 * each, 1) for each in took_s], [round(1e3 * each, 1) for each in alone_s]
    assert median(took_s) <= SHARE * median(alone_s), said
    assert max(took_s) <= SHARE * max(alone_s), said


@pytest.mark.parametrize(
    ("case", "size"),
    [pytest.param(case, size, marks=pytest.mark.nightly if size == LARGE else []) for case in CASES for size in CALLS],
)
def test_a_second_server_does_not_delay_the_first_answer(case: str, size: int) -> None:
    replicas = Replicas((OTHER, NEAR))
    replicas.begin(case)
    if case == "stalled":
        replicas.run(2.0)  # it has missed its reports
    assert_as_fast(replicas.call(size, CALLS[size]), near_alone(size))


@pytest.mark.parametrize("size", [*list(CALLS)[:-1], *nightly(LARGE)])
def test_the_call_that_meets_a_server_as_it_freezes_takes_a_few_round_trips_more(size: int) -> None:
    replicas = Replicas((OTHER, NEAR))
    replicas.begin("frozen")
    alone_s = near_alone(size)
    first_s, *later_s = replicas.call(size, CALLS[size])
    assert first_s <= alone_s[0] + 0.06
    assert_as_fast(later_s, alone_s)


@pytest.mark.parametrize("case", ["as near", *nightly("far")])
def test_a_server_that_joins_while_requests_follow_each_other_delays_at_most_the_call_that_meets_it(case: str) -> None:
    replicas = Replicas((OTHER, NEAR))
    replicas.links[OTHER].delay_s += 0.1 * (case == "far")
    replicas.serve(NEAR)
    core, begun_s = replicas.net.cores[ROBOT], list[float]()
    open_calls: dict[int, Call] = {}
    took_s: dict[int, float] = {}

    def ask() -> None:
        call = open_calls[len(begun_s)] = Call(payload=bytes(307_200), timeout_s=20.0, replication=ALL)
        begun_s.append(replicas.net.now_s)
        core.call(replicas.topic, call, replicas.net.now_s)
        replicas.net.send(ROBOT)

    def look() -> bool:
        for number in [number for number, call in open_calls.items() if call.is_done]:
            del open_calls[number]
            took_s[number] = replicas.net.now_s - begun_s[number]
        return len(took_s) == REQUESTS

    replicas.call(1, 2)
    for number in range(REQUESTS):
        replicas.net.world.network.call(0.1 * number, ask)
    replicas.net.world.network.call(0.1 * JOINED_AFTER + 0.02, partial(replicas.serve, OTHER))
    assert replicas.run(20.0, look)
    assert len(core.member.services.peers(replicas.topic.name)) == 2
    before_s = median(took_s[number] for number in range(20, JOINED_AFTER))
    after_s = sorted(took_s[number] for number in range(JOINED_AFTER, REQUESTS))
    assert after_s[-1] <= 2 * before_s, [round(1e3 * each, 1) for each in after_s[-5:]]
    assert after_s[-3] <= SHARE * before_s, [round(1e3 * each, 1) for each in after_s[-5:]]


def test_on_a_thin_uplink_a_far_server_costs_no_time_and_hardly_a_byte_once_its_path_is_known() -> None:
    size, thin_bytes_s = 307_200, 20e6 / 8
    replicas = Replicas((OTHER, NEAR), uplink_bytes_s=thin_bytes_s)
    replicas.begin("far")
    assert_as_fast(replicas.call(size, CALLS[size]), near_alone(size, thin_bytes_s))
    sent = replicas.count_frames("s/robot", "s")
    replicas.call(size, 5)
    assert sent[0] <= 1.35 * 5 * size


def test_requests_to_a_server_behind_a_thin_link_do_not_fill_its_queue() -> None:
    replicas = Replicas((OTHER, NEAR))
    replicas.begin("thin")
    watch, reader = replicas.net.cores[WATCH], replicas.net.cores[OTHER]
    publisher = watch.member.advertise(watch.resolve("news", Right.PUBLISH), b"-", reliable=True)
    inbox = reader.subscribe(reader.resolve("news", Right.READ), 1_000)
    for label in (WATCH, OTHER):
        replicas.net.send(label)
    assert replicas.run(2.0, lambda: publisher.readers == 1)
    sent_s, late_s = dict[int, float](), list[float]()

    def say(number: int) -> None:
        sent_s[number] = replicas.net.now_s
        publisher.publish(message_to_wire(0, number.to_bytes(4, "big")), replicas.net.now_s)
        replicas.net.send(WATCH)

    def listen() -> None:
        while inbox.messages:
            number = int.from_bytes(inbox.messages.popleft().payload, "big")
            late_s.append(replicas.net.now_s - sent_s[number])

    replicas.call(307_200, 3)  # the first ones measure the path
    for number in range(100):
        replicas.net.world.network.call(0.02 * number, partial(say, number))
        for part in range(20):
            replicas.net.world.network.call(0.02 * number + 0.001 * part, listen)
    replicas.call(307_200, 8)
    replicas.run(1.0)
    listen()
    assert len(late_s) == 100
    assert sorted(late_s)[94] <= 0.06, sorted(late_s)[-10:]


def test_an_ended_call_sends_nothing_more_to_the_other_server_which_learns_that_it_ended() -> None:
    replicas = Replicas((OTHER, NEAR))
    replicas.begin("thin")
    replicas.call(307_200, 4)
    branch = replicas.count_frames("s", f"s/{OTHER}")
    replicas.call(307_200, 4)
    assert branch[0] <= 4 * 0.1 * 307_200
    replicas.run(2.0)
    losses = [each.losses.counts for each in replicas.net.cores[OTHER].member.subscriptions.writer_proxies()]
    assert sum(each[LossReason.CALL_ENDED] for each in losses) > 0
    assert all(each.keys() <= {LossReason.CALL_ENDED} for each in losses)
    replicas.links[OTHER].bytes_s = SERVER_BYTES_S
    replicas.freeze(NEAR)
    assert replicas.call(1, 4)[-1] <= 1.0  # the other one answers


@pytest.mark.parametrize("every_s", [0.2, 1.0])
def test_a_path_that_is_idle_between_requests_keeps_its_window(every_s: float) -> None:
    replicas = Replicas((NEAR,), near_s=0.03)
    replicas.begin("alone")
    took_s = replicas.call(307_200, 20, every_s)
    assert took_s[9] <= 1.1 * median(took_s[10:]), [round(1e3 * each) for each in took_s]
    assert max(took_s[3:]) <= 0.75 * took_s[0], [round(1e3 * each) for each in took_s]
