"""Kernel plane on real devices: every frame is accounted for, and the frames it leaves to Python."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyroute2 import IPRoute

from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.ports.kernel.abi import BRANCHES_MAX
from gdp.ports.kernel.device import TxDrops
from gdp.ports.kernel.plane import KernelPlane
from gdp.switch.forwarder import Forward, decide, rewrite
from gdp.switch.table import Hops
from lab.namespaces import Space
from lab.process import until
from netns_tests.conftest import MakeKernel
from netns_tests.test_planes import PORT_MACS, far_end
from tests.fixtures_forwarding import (
    BOTH,
    DEAD,
    GONE,
    HALF,
    IN,
    MTUS,
    NARROW,
    ONE,
    OTHER_SOURCE,
    SPLIT,
    TO_ABSENT,
    TO_NARROW,
    TO_WIDE,
    UNKNOWN,
    WIDE,
    filled,
    frame,
)

pytestmark = pytest.mark.netns

PATIENCE_S = 10.0
LOOK_S = 0.05


@pytest.fixture
def ends(make_kernel: MakeKernel) -> Iterator[dict[int, socket.socket]]:
    opened = {port: far_end(f"q{port}") for port in PORT_MACS}
    yield opened
    for end in opened.values():
        end.close()


def settle(plane: KernelPlane, taken: int) -> int:
    """Poll until the plane took this many frames since it was made; return how many were punted."""
    punted: list[object] = []
    until(
        lambda: plane.counters.frames_in >= taken and not plane._epoll.poll(0),
        "all frames",
        PATIENCE_S,
        lambda: punted.extend(plane.poll(LOOK_S)),
    )
    return len(punted)


def waiting(end: socket.socket) -> list[bytes]:
    """Return the received frames."""
    end.setblocking(False)
    got: list[bytes] = []
    while True:
        try:
            got.append(end.recv(1 << 16))
        except BlockingIOError:
            end.settimeout(PATIENCE_S)
            return got


def test_what_was_sent_is_delivered_or_dropped_by_reason(
    make_kernel: MakeKernel, ends: dict[int, socket.socket]
) -> None:
    plane = make_kernel(filled())
    kinds = {
        "one hop": frame(ONE),
        "two hops": frame(BOTH),
        "too big for one of two": frame(BOTH, bytes(900)),
        "unknown": frame(UNKNOWN),
        "expired": frame(ONE, hops_left=1),
        "too big": frame(SPLIT, bytes(900), source=OTHER_SOURCE),
        "truncated": frame(ONE, length=99),
        "down": frame(DEAD),
        "one of two down": frame(HALF),
        "nowhere": frame(GONE, source=OTHER_SOURCE),
        "a neighbour's": frame(ONE, kind=Kind.HELLO),
    }
    rounds = 20
    for _ in range(rounds):
        for each in kinds.values():
            ends[IN].send(each)
    punted = settle(plane, rounds * len(kinds))
    delivered = len(waiting(ends[WIDE])) + len(waiting(ends[NARROW]))
    counters = plane.counters
    copies_more = 3 * rounds  # two egress ports: three of the kinds have one copy more than there are frames
    dropped = sum(counters.drops)
    assert counters.frames_in == rounds * len(kinds)
    assert rounds * len(kinds) + copies_more == delivered + dropped + punted
    assert counters.forwarded == delivered == 5 * rounds
    assert {DropReason(reason): count for reason, count in enumerate(counters.drops) if count} == {
        DropReason.TRUNCATED: rounds,
        DropReason.HOPS_EXPIRED: rounds,
        DropReason.TOO_BIG: 2 * rounds,
        DropReason.NO_ROUTE: rounds,
        DropReason.PORT_DOWN: 2 * rounds,
    }
    assert counters.punted == punted == 2 * rounds


def test_a_frame_that_the_kernel_takes_wakes_no_thread(make_kernel: MakeKernel, ends: dict[int, socket.socket]) -> None:
    plane = make_kernel(filled())
    plane.poll(0)
    for _ in range(5):
        ends[IN].send(frame(ONE))
        assert ends[WIDE].recv(1 << 16)
    assert plane._counters.frames_in == 0
    assert plane.counters.forwarded == 5


def test_what_a_full_queue_refuses_is_counted(make_kernel: MakeKernel, ends: dict[int, socket.socket]) -> None:
    with IPRoute() as ask:  # a queue of one frame that sends one in a second or so
        tbf = {"handle": 0x10000, "rate": 1_000, "burst": 1_600, "limit": 1_600}
        ask.tc("add", "tbf", socket.if_nametoindex("p1"), **tbf)
    plane = make_kernel(filled())
    plane.poll(0)
    given = frame(ONE, bytes(1_300))
    for _ in range(20):
        ends[IN].send(given)
    settle(plane, 20)
    refused = 20 - 2  # one left at once, one is queued
    until(lambda: plane.counters.drops[DropReason.PORT_FULL] >= refused, meanwhile=lambda: plane.poll(LOOK_S))
    assert plane._counters.frames_in == 0
    assert plane.counters.drops[DropReason.PORT_FULL] == refused
    assert plane.counters.forwarded == 20


def test_what_was_refused_until_the_end_is_counted(make_kernel: MakeKernel, ends: dict[int, socket.socket]) -> None:
    with IPRoute() as ask:
        ask.tc("add", "tbf", socket.if_nametoindex("p1"), handle=0x10000, rate=1_000, burst=1_600, limit=1_600)
    plane = make_kernel(filled())
    for _ in range(20):
        ends[IN].send(frame(ONE, bytes(1_300)))
    plane.close()
    assert plane.counters.drops[DropReason.PORT_FULL] == 20 - 2


def test_an_idle_poll_asks_no_device(make_kernel: MakeKernel, monkeypatch: pytest.MonkeyPatch) -> None:
    plane = make_kernel(filled())
    looks: list[object] = []
    monkeypatch.setattr(TxDrops, "poll", lambda *given: looks.append(given))
    plane._next_upkeep_s = float("inf")
    for _ in range(5):
        plane.poll(0)
    assert looks == []
    plane._next_upkeep_s = plane._next_look_s = 0.0
    plane.poll(0)
    assert len(looks) == 1


GROUPS = st.lists(st.sampled_from([TO_WIDE, TO_NARROW, TO_ABSENT]), min_size=2, max_size=6).map(tuple)


def test_generated_groups_copy_as_the_reference_says(make_kernel: MakeKernel, ends: dict[int, socket.socket]) -> None:
    table = filled()
    plane = make_kernel(table)

    @settings(deadline=None, max_examples=40)
    @given(hops=GROUPS, size=st.sampled_from([0, 604, 605, 1404]), hops_left=st.sampled_from([2, 64, 127]))
    def check(hops: Hops, size: int, hops_left: int) -> None:
        table.install(ONE, hops, float("inf"))
        before = plane.counters
        taken, drops = before.frames_in, list(before.drops)
        given = frame(ONE, bytes(size), hops_left=hops_left)
        said = decide(given, {ONE: hops}, MTUS)
        assert isinstance(said, Forward)
        ends[IN].send(given)
        settle(plane, taken + 1)
        for port in (WIDE, NARROW):
            assert waiting(ends[port]) == [rewrite(given, macs) for to, macs in said.hops if to == port]
        lost = [after - former for after, former in zip(plane.counters.drops, drops, strict=True)]
        assert lost == [said.lost.count(reason) for reason in DropReason]

    check()


@pytest.mark.parametrize(("branches", "by_kernel"), [(BRANCHES_MAX, 1), (BRANCHES_MAX + 1, 0)])
def test_a_larger_group_than_the_kernel_knows_is_copied_by_python(
    make_kernel: MakeKernel, ends: dict[int, socket.socket], branches: int, by_kernel: int
) -> None:
    hops = tuple((WIDE, n.to_bytes(6, "big") + bytes(6)) for n in range(branches))
    plane = make_kernel(filled({ONE: hops}))
    ends[IN].send(frame(ONE))
    settle(plane, 1)
    assert waiting(ends[WIDE]) == [rewrite(frame(ONE), macs) for _, macs in hops]
    assert plane.left_out == 1 - by_kernel
    assert plane._counters.frames_in == 1 - by_kernel


def test_an_entry_that_does_not_fit_in_the_kernel_is_forwarded_by_python_until_it_does(
    make_kernel: MakeKernel, ends: dict[int, socket.socket]
) -> None:
    names = [n.to_bytes(32, "big") for n in range(1, 6)]
    table = filled(dict.fromkeys(names, (TO_WIDE,)))
    plane = make_kernel(table, entries_max=2)
    assert plane.left_out == 3
    for name in names:
        ends[IN].send(frame(name))
    settle(plane, 5)
    assert len(waiting(ends[WIDE])) == 5
    assert (plane._counters.forwarded, plane.counters.forwarded) == (3, 5)
    for name in names[:3]:
        table.remove(name)
    assert plane.left_out == 0
    for name in names:
        ends[IN].send(frame(name))
    assert settle(plane, 10) == 3
    assert len(waiting(ends[WIDE])) == 2
    assert plane._counters.forwarded == 3


def test_each_entry_counts_its_frames_and_bytes(make_kernel: MakeKernel, ends: dict[int, socket.socket]) -> None:
    plane = make_kernel(filled())
    for each, count in ((frame(ONE), 3), (frame(BOTH, bytes(50)), 2), (frame(SPLIT, source=OTHER_SOURCE), 1)):
        for _ in range(count):
            ends[IN].send(each)
    settle(plane, 6)
    assert plane.entry_counts() == {
        ONE: (3, 3 * len(frame(ONE))),
        BOTH: (2, 2 * len(frame(BOTH, bytes(50)))),
        SPLIT + OTHER_SOURCE: (1, len(frame(SPLIT))),
    }
    assert list(plane.entry_counts(1)) == [ONE]


def test_frames_of_a_removed_entry_are_not_forwarded(make_kernel: MakeKernel, ends: dict[int, socket.socket]) -> None:
    table = filled()
    plane = make_kernel(table)
    table.remove(ONE)
    table.install(SPLIT, (TO_NARROW,), 5.0)
    ends[IN].send(frame(ONE))
    ends[IN].send(frame(SPLIT))
    assert settle(plane, 2) == 1
    assert len(waiting(ends[NARROW])) == 1
    table.expire(5.0)
    ends[IN].send(frame(SPLIT))
    assert settle(plane, 3) == 1


def test_a_deleted_port_is_down_for_the_kernel_too(
    make_kernel: MakeKernel, space: Space, ends: dict[int, socket.socket]
) -> None:
    plane = make_kernel(filled())
    space.ip("link", "del", "p1")
    until(lambda: not plane.ports[WIDE].up, meanwhile=lambda: plane.poll(LOOK_S))
    for each in (frame(ONE), frame(BOTH)):
        ends[IN].send(each)
    settle(plane, 2)
    assert len(waiting(ends[NARROW])) == 1
    assert plane.counters.drops[DropReason.PORT_DOWN] == 2
    assert plane._counters.drops[DropReason.PORT_DOWN] == 0
