"""Simulated network: delay, loss, order and links as configured, and a clock that only machines hold back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import pytest

from gdp.errors import DropReason, LocalError
from gdp.sansio import BROADCAST, OutgoingFrames, ReceivedFrame, Timestamps
from lab.network import SimLink, SimNetwork


class Talker:
    """Machine that sends frames on command and records those it receives."""

    def __init__(self, network: SimNetwork) -> None:
        self.network = network
        self.out: list[OutgoingFrames] = []
        self.got: list[tuple[float, bytes]] = []
        self.links: list[bool] = []
        self.facts: list[tuple[int, int]] = []  # MTU and cost of its port, as reported
        self.due_s: float | None = None
        self.called_s: list[float] = []

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        self.facts.append((mtu, cost))

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        self.got += [(now.mono_s, each.frame) for each in arrivals]

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        self.links.append(up)

    def handle_timer(self, now: Timestamps) -> None:
        self.called_s.append(now.mono_s)
        self.due_s = None

    def get_timer(self) -> float | None:
        return self.due_s

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        pass

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        return {}

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        out, self.out = self.out, []
        return out

    def frames_sent(self, now_s: float) -> None:
        pass

    def say(self, *frames: bytes) -> None:
        self.out.append(OutgoingFrames(0, BROADCAST, frames))


class Spinner(Talker):
    """Machine whose timer is always due."""

    def handle_timer(self, now: Timestamps) -> None:
        self.due_s = now.mono_s - 1


def two(sim_link: SimLink) -> tuple[SimNetwork, Talker, Talker]:
    network = SimNetwork()
    a, b = Talker(network), Talker(network)
    network.add("a", a)
    network.add("b", b)
    network.connect("a", "b", sim_link, cost=7)
    return network, a, b


def send(network: SimNetwork, a: Talker, *frames: bytes) -> None:
    a.say(*frames)
    network.send_pending("a")


def test_a_frame_arrives_after_the_cables_delay() -> None:
    network, a, b = two(SimLink(0.25))
    begin_s = network.now.mono_s
    send(network, a, b"frame")
    network.run(1)
    assert b.got == [(begin_s + 0.25, b"frame")]


def test_a_sim_link_without_jitter_keeps_the_order() -> None:
    network, a, b = two(SimLink())
    send(network, a, *(bytes([n]) for n in range(100)))
    network.run(1)
    assert [frame for _, frame in b.got] == [bytes([n]) for n in range(100)]


def test_a_sim_link_with_jitter_lets_frames_overtake() -> None:
    network, a, b = two(SimLink(jitter_s=0.1))
    send(network, a, *(bytes([n]) for n in range(100)))
    network.run(1)
    frames = [frame for _, frame in b.got]
    assert frames != sorted(frames)
    assert len(frames) == 100


def test_a_lossy_sim_link_loses_its_share() -> None:
    network, a, b = two(SimLink(loss=0.5))
    send(network, a, *[b"x"] * 1_000)
    network.run(1)
    assert 400 < len(b.got) < 600
    assert network.lost == 1_000 - len(b.got)


def test_equal_seeds_give_equal_runs() -> None:
    runs = []
    for _ in range(2):
        network, a, b = two(SimLink(loss=0.5, jitter_s=0.1))
        send(network, a, *(bytes([n]) for n in range(100)))
        network.run(1)
        runs.append(b.got)
    assert runs[0] == runs[1]


def test_a_frame_above_the_mtu_is_counted() -> None:
    network, a, b = two(SimLink(mtu=100))
    send(network, a, bytes(101), bytes(100))
    network.run(1)
    assert (len(b.got), network.drops) == (1, {DropReason.TOO_BIG: 1})


def test_a_pulled_sim_link_carries_nothing_and_both_ends_know() -> None:
    sim_link = SimLink(0.5)
    network, a, b = two(sim_link)
    send(network, a, b"under way")
    network.set_link(sim_link, up=False)
    send(network, a, b"too late")
    network.run(2)
    assert (a.links, b.links, b.got) == ([False], [False], [])
    assert network.drops == {DropReason.PORT_DOWN: 1}


def test_a_sim_link_that_changes_tells_both_ends_and_carries_what_it_now_takes() -> None:
    sim_link = SimLink()
    network, a, b = two(sim_link)
    network.set_mtu(sim_link, 100)
    network.set_cost(sim_link, 9)
    assert a.facts == b.facts == [(1_500, 7), (100, 7), (100, 9)]
    send(network, a, bytes(101), bytes(100))
    network.run(1)
    assert (len(b.got), network.drops) == (1, {DropReason.TOO_BIG: 1})


def test_a_sim_link_that_changes_while_pulled_is_reported_when_it_is_back() -> None:
    sim_link = SimLink()
    network, a, _ = two(sim_link)
    network.set_link(sim_link, up=False)
    network.set_mtu(sim_link, 100)
    assert a.facts == [(1_500, 7)]
    network.set_link(sim_link, up=True)
    assert a.facts == [(1_500, 7), (100, 7)]


def test_a_timer_comes_at_its_second_and_no_sooner() -> None:
    network, a, _ = two(SimLink())
    due_s = network.now.mono_s + 3.0
    a.due_s = due_s
    network.send_pending("a")
    network.run(2.9)
    assert a.called_s == []
    network.run(0.2)
    assert a.called_s == [pytest.approx(due_s)]


def test_a_machine_that_is_never_satisfied_is_named() -> None:
    network = SimNetwork()
    spinner = Spinner(network)
    network.add("spinner", spinner)
    spinner.due_s = 0.0
    network.send_pending("spinner")
    with pytest.raises(LocalError, match="spinner"):
        network.run(1)


def test_who_was_killed_neither_hears_nor_is_called() -> None:
    network, a, b = two(SimLink())
    b.due_s = network.now.mono_s + 0.5
    network.send_pending("b")
    network.stop("b")
    send(network, a, b"frame")
    network.run(1)
    assert (b.got, b.called_s) == ([], [])


def test_a_restarted_machine_has_its_ports_as_they_are() -> None:
    sim_link = SimLink()
    network, _, _ = two(sim_link)
    network.set_link(sim_link, up=False)
    again = Talker(network)
    network.replace("b", again)
    assert (again.facts, again.links) == ([(1_500, 7)], [False])


def test_time_goes_on_to_the_end_though_nothing_happens() -> None:
    network = SimNetwork()
    begin_s = network.now.mono_s
    assert network.run(5) is True
    assert network.now.mono_s == begin_s + 5
    assert network.run(1, lambda: False) is False


def test_an_invalid_port_is_the_callers_mistake() -> None:
    network, a, _ = two(SimLink())
    a.out.append(OutgoingFrames(9, BROADCAST, [b"x"]))
    with pytest.raises(LocalError):
        network.send_pending("a")
