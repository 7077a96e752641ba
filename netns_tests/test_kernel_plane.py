"""The kernel plane on real devices: that every frame is accounted for, and what it leaves to Python."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyroute2 import IPRoute

from gdp.errors import DropReason, LocalError
from gdp.frame.kinds import Kind
from gdp.ports.kernel.assembler import Assembler
from gdp.ports.kernel.device import has_free_peer
from gdp.ports.kernel.plane import KernelPlane
from gdp.ports.kernel.program import UP
from gdp.ports.kernel.shapes import BRANCHES_MAX, PortAt, PortFlag
from gdp.ports.kernel.syscall import create_link, load_program
from gdp.switch.forwarder import Forward, decide, rewrite
from gdp.switch.table import Hop, Table
from gdp.testbed.netns_files import inside
from netns_tests.spaces import Space
from netns_tests.test_planes import PORT_MACS, far_end
from tests.fixtures_forwarding import (
    BOTH,
    DEAD,
    ENTRIES,
    GONE,
    HALF,
    IN,
    MTUS,
    NARROW,
    NOBODY,
    ONE,
    OTHER_SOURCE,
    PEER_MACS,
    SPLIT,
    TO_ABSENT,
    TO_NARROW,
    TO_WIDE,
    WIDE,
    frame,
    leaves,
)

pytestmark = pytest.mark.netns

TCX_EGRESS = 47
PATIENCE_S = 10.0
LOOK_S = 0.05
Make = Callable[..., KernelPlane]


@pytest.fixture
def make(space: Space) -> Iterator[Make]:
    for port, mac in PORT_MACS.items():
        space.veth(f"p{port}", f"q{port}", mac, PEER_MACS[port], MTUS[port])
    made: list[KernelPlane] = []

    def make(table: Table, **settings: int) -> KernelPlane:
        try:
            made.append(KernelPlane(["p0", "p1", "p2"], table, **settings))  # type: ignore[arg-type]
        except LocalError as error:
            pytest.skip(str(error).partition("\n")[0])
        return made[-1]

    yield make
    for plane in made:
        plane.close()


@pytest.fixture
def ends(make: Make) -> Iterator[dict[int, socket.socket]]:
    opened = {port: far_end(f"q{port}") for port in PORT_MACS}
    yield opened
    for end in opened.values():
        end.close()


def filled(entries: dict[bytes, tuple[Hop, ...]] = ENTRIES) -> Table:
    table = Table()
    table.install_many(entries.items(), float("inf"))
    return table


def settle(plane: KernelPlane, taken: int) -> int:
    """Poll until the plane took this many frames since it was made; return how many were handed up."""
    deadline_s = time.monotonic() + PATIENCE_S
    handed_up = 0
    while plane.counters.frames_in < taken or plane._epoll.poll(0):
        assert time.monotonic() < deadline_s, "frames are missing"
        handed_up += len(plane.poll(LOOK_S))
    return handed_up


def waiting(end: socket.socket) -> list[bytes]:
    """Return what has arrived."""
    end.setblocking(False)
    got: list[bytes] = []
    while True:
        try:
            got.append(end.recv(1 << 16))
        except BlockingIOError:
            end.settimeout(PATIENCE_S)
            return got


def test_what_was_sent_is_delivered_or_dropped_by_reason(make: Make, ends: dict[int, socket.socket]) -> None:
    plane = make(filled())
    kinds = {
        "one hop": frame(ONE),
        "two hops": frame(BOTH),
        "too big for one of two": frame(BOTH, bytes(900)),
        "unknown": frame(NOBODY),
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
    handed_up = settle(plane, rounds * len(kinds))
    delivered = len(waiting(ends[WIDE])) + len(waiting(ends[NARROW]))
    counters = plane.counters
    copies_more = 3 * rounds  # two ways: three of the kinds have one copy more than there are frames
    dropped = sum(counters.drops)
    assert counters.frames_in == rounds * len(kinds)
    assert rounds * len(kinds) + copies_more == delivered + dropped + handed_up
    assert counters.forwarded == delivered == 5 * rounds
    assert {DropReason(reason): count for reason, count in enumerate(counters.drops) if count} == {
        DropReason.TRUNCATED: rounds,
        DropReason.HOPS_EXPIRED: rounds,
        DropReason.TOO_BIG: 2 * rounds,
        DropReason.NO_ROUTE: rounds,
        DropReason.PORT_DOWN: 2 * rounds,
    }
    assert counters.handed_up == handed_up == 2 * rounds


def test_what_the_kernel_takes_wakes_nobody(make: Make, ends: dict[int, socket.socket]) -> None:
    plane = make(filled())
    plane.poll(0)
    for _ in range(5):
        ends[IN].send(frame(ONE))
        assert ends[WIDE].recv(1 << 16)
    assert plane._counters.frames_in == 0
    assert plane.counters.forwarded == 5


def test_what_a_full_queue_refuses_is_counted(make: Make, ends: dict[int, socket.socket]) -> None:
    with IPRoute() as ask:  # a queue of one frame that sends one in a second or so
        tbf = {"handle": 0x10000, "rate": 1_000, "burst": 1_600, "limit": 1_600}
        ask.tc("add", "tbf", socket.if_nametoindex("p1"), **tbf)
    plane = make(filled())
    plane.poll(0)
    given = frame(ONE, bytes(1_300))
    for _ in range(20):
        ends[IN].send(given)
    settle(plane, 20)
    while plane.poll(LOOK_S):
        pass
    delivered = len(waiting(ends[WIDE]))
    queued = 1
    assert plane._counters.frames_in == 0
    assert delivered + queued + plane.counters.drops[DropReason.PORT_FULL] == plane.counters.forwarded == 20


GROUPS = st.lists(st.sampled_from([TO_WIDE, TO_NARROW, TO_ABSENT]), min_size=2, max_size=6).map(tuple)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(hops=GROUPS, size=st.sampled_from([0, 604, 605, 1404]), hops_left=st.sampled_from([2, 64, 255]))
def test_generated_groups_copy_as_the_reference_says(
    make: Make, ends: dict[int, socket.socket], hops: tuple[Hop, ...], size: int, hops_left: int
) -> None:
    plane = make(filled({ONE: hops}))
    given = frame(ONE, bytes(size), hops_left=hops_left)
    said = decide(given, {ONE: hops}, MTUS)
    assert isinstance(said, Forward)
    ends[IN].send(given)
    settle(plane, 1)
    for port in (WIDE, NARROW):
        assert waiting(ends[port]) == [rewrite(given, macs) for to, macs in said.hops if to == port]
    assert [plane.counters.drops[reason] for reason in DropReason] == [said.lost.count(reason) for reason in DropReason]
    plane.close()


@pytest.mark.parametrize(("branches", "by_kernel"), [(BRANCHES_MAX, 1), (BRANCHES_MAX + 1, 0)])
def test_a_larger_group_than_the_kernel_knows_is_copied_by_python(
    make: Make, ends: dict[int, socket.socket], branches: int, by_kernel: int
) -> None:
    hops = tuple((WIDE, n.to_bytes(6, "big") + bytes(6)) for n in range(branches))
    plane = make(filled({ONE: hops}))
    ends[IN].send(frame(ONE))
    settle(plane, 1)
    assert waiting(ends[WIDE]) == [rewrite(frame(ONE), macs) for _, macs in hops]
    assert plane.left_out == 1 - by_kernel
    assert plane._counters.frames_in == 1 - by_kernel


def test_what_finds_no_room_in_the_kernel_is_forwarded_by_python_until_there_is(
    make: Make, ends: dict[int, socket.socket]
) -> None:
    names = [n.to_bytes(32, "big") for n in range(1, 6)]
    table = filled(dict.fromkeys(names, (TO_WIDE,)))
    plane = make(table, entries_max=2)
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


def test_each_entry_counts_its_frames_and_bytes(make: Make, ends: dict[int, socket.socket]) -> None:
    plane = make(filled())
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


def test_a_removed_entry_goes_to_nobody_any_more(make: Make, ends: dict[int, socket.socket]) -> None:
    table = filled()
    plane = make(table)
    table.remove(ONE)
    table.install(SPLIT, (TO_NARROW,), 5.0)
    ends[IN].send(frame(ONE))
    ends[IN].send(frame(SPLIT))
    assert settle(plane, 2) == 1
    assert len(waiting(ends[NARROW])) == 1
    table.expire(5.0)
    ends[IN].send(frame(SPLIT))
    assert settle(plane, 3) == 1


def test_a_deleted_port_is_down_for_the_kernel_too(make: Make, space: Space, ends: dict[int, socket.socket]) -> None:
    plane = make(filled())
    space.ip("del", "p1")
    deadline_s = time.monotonic() + PATIENCE_S
    while plane.port_state(WIDE):
        assert time.monotonic() < deadline_s
        plane.poll(LOOK_S)
    for each in (frame(ONE), frame(BOTH)):
        ends[IN].send(each)
    settle(plane, 2)
    assert len(waiting(ends[NARROW])) == 1
    assert plane.counters.drops[DropReason.PORT_DOWN] == 2
    assert plane._counters.drops[DropReason.PORT_DOWN] == 0


@contextlib.contextmanager
def elsewhere() -> Iterator[int]:
    """A namespace of its own, by the process that holds it."""
    with subprocess.Popen(["unshare", "--net", "cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdin is not None
        assert holder.stdout is not None
        holder.stdin.write(b"here\n")
        holder.stdin.flush()
        holder.stdout.readline()  # so it is in its namespace
        yield holder.pid
        holder.stdin.close()


@contextlib.contextmanager
def passing_program() -> Iterator[int]:
    code = Assembler()
    code.leave(UP)
    program = load_program(code.assemble(), "passing", b"Apache-2.0")
    yield program
    os.close(program)


def test_the_other_end_is_reached_straight_only_where_nothing_is_passed_by(space: Space) -> None:
    space.veth("p0", "q0", PORT_MACS[IN], PEER_MACS[IN])
    port = socket.if_nametoindex("p0")
    assert not has_free_peer(port)  # the other end is here
    with elsewhere() as holder, passing_program() as program:
        space.ip("set", "q0", "netns", str(holder))
        assert has_free_peer(port)
        with IPRoute() as ask:
            ask.tc("add", "pfifo", port, handle=0x10000)
            assert not has_free_peer(port)
            ask.tc("del", "pfifo", port, handle=0x10000, parent=0xFFFFFFFF)
            assert has_free_peer(port)
            ask.tc("add", "clsact", port)
            assert has_free_peer(port)
            ask.tc("add-filter", "bpf", port, parent=0xFFFFFFF3, fd=program, name="passing", direct_action=True)
            assert not has_free_peer(port)
            ask.tc("del", "clsact", port)
        link = create_link(program, port, TCX_EGRESS)
        assert not has_free_peer(port)
        os.close(link)
        assert has_free_peer(port)


def is_straight(plane: KernelPlane, port: int) -> bool:
    facts = plane._loaded.ports.get(port.to_bytes(4, sys.byteorder))
    assert facts is not None
    return bool(facts[PortAt.FLAGS] & PortFlag.PEER)


@pytest.mark.parametrize("peer", [True, False])
def test_a_frame_reaches_another_namespace_straight_or_by_the_queue_that_was_put_in_between(
    make: Make, space: Space, peer: bool
) -> None:
    with elsewhere() as holder, far_end("q0") as sender:
        space.ip("set", "q1", "netns", str(holder))
        there = Path(f"/proc/{holder}/ns/net")
        inside(there, lambda: space.ip("set", "q1", "up"))
        space.ready("p1")
        plane = make(filled(), peer=peer)
        with inside(there, lambda: far_end("q1")) as receiver, IPRoute() as ask:
            assert is_straight(plane, WIDE) == peer
            sender.send(frame(ONE))
            assert receiver.recv(1 << 16) == leaves(frame(ONE), WIDE)[WIDE]
            ask.tc("add", "tbf", socket.if_nametoindex("p1"), handle=0x10000, rate=1_000_000, burst=3_000, limit=9_000)
            deadline_s = time.monotonic() + PATIENCE_S
            while is_straight(plane, WIDE):
                assert time.monotonic() < deadline_s
                plane.poll(LOOK_S)
            sender.send(frame(BOTH))
            assert receiver.recv(1 << 16) == leaves(frame(BOTH), WIDE)[WIDE]
        assert plane._counters.frames_in == 0
        assert plane.counters.forwarded == 3
