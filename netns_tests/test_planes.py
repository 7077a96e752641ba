"""Every data plane on real devices: the fixtures, the ingress filters, and ports that come and go.

A plane's ports are ``p0`` to ``p2``; ``q0`` to ``q2`` are the other ends of their links, where the test sends and
listens.
"""

from __future__ import annotations

import os
import socket
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from functools import partial
from itertools import chain
from random import Random
from typing import ClassVar
from weakref import WeakKeyDictionary

import pytest

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import ETHERTYPE, Kind, decode
from gdp.ports import raw, sockets
from gdp.ports.kernel.plane import KernelPlane
from gdp.ports.mmsg import MmsgBatch
from gdp.ports.netdev import NetdevPlane
from gdp.ports.plane import MAC_BYTES, Plane
from gdp.ports.raw import RawPlane
from gdp.ports.scapy_plane import ScapyPlane
from gdp.sansio import BROADCAST, ReceivedFrame
from gdp.switch.table import Table
from lab.namespaces import Space, wait_for_carrier
from lab.process import until
from tests.fixtures_forwarding import (
    BOTH,
    CASES,
    ENTRIES,
    IN,
    IN_MAC,
    MTUS,
    NARROW,
    NARROW_MAC,
    ONE,
    PACES,
    PEER_MACS,
    WIDE,
    WIDE_MAC,
    frame,
    leaves,
)

pytestmark = pytest.mark.netns

PORT_MACS = {IN: IN_MAC, WIDE: WIDE_MAC, NARROW: NARROW_MAC}
PATIENCE_S = 10.0  # limit of a test; the awaited event comes at once
LOOK_S = 0.05  # a frame that the kernel forwards wakes no poll
BURST = 140  # more than two batches, less than an unprivileged socket's buffer holds
MARK = frame(BOTH, b"mark")
EXPECTED: WeakKeyDictionary[Plane, int] = WeakKeyDictionary()  # frames that a plane was expected to take

MakePlane = Callable[[Sequence[str], Table | None], Plane]


def _by_ctypes(ifnames: Sequence[str], table: Table | None) -> Plane:
    """Raw plane as it is where no compiler built the burst core."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raw, "make_batch", MmsgBatch)
        return RawPlane(ifnames, table)


KINDS: dict[str, MakePlane] = {
    "raw": RawPlane,
    "raw-ctypes": _by_ctypes,
    "scapy": ScapyPlane,
    "kernel": KernelPlane,
    "kernel-no-peer": partial(KernelPlane, peer=False),
    "kernel-clsact": partial(KernelPlane, clsact=True),
}


ALIKE = ("raw-ctypes", "kernel-no-peer", "kernel-clsact")  # each differs from another kind in a part of its way
EVERY_KIND = pytest.mark.parametrize("make", list(KINDS.values()), ids=list(KINDS), indirect=True)


@pytest.fixture(
    params=[
        pytest.param(kind, id=name, marks=[pytest.mark.nightly] if name in ALIKE else [])
        for name, kind in KINDS.items()
    ]
)
def make(request: pytest.FixtureRequest, space: Space) -> Iterator[MakePlane]:
    """Factory of planes of one kind; the links exist, and the planes are closed at the end."""
    for port, mac in PORT_MACS.items():
        space.veth(f"p{port}", f"q{port}", mac, PEER_MACS[port], MTUS[port])
    made: list[Plane] = []

    def make(ifnames: Sequence[str], table: Table | None) -> Plane:
        made.append(request.param(ifnames, table))
        return made[-1]

    yield make
    for plane in made:
        plane.close()


@pytest.fixture
def ends(make: MakePlane) -> Iterator[dict[int, socket.socket]]:
    """Other ends of the links: plain packet sockets that see what arrives there."""
    opened = {port: far_end(f"q{port}") for port in PORT_MACS}
    yield opened
    for end in opened.values():
        end.close()


@pytest.fixture
def switch(make: MakePlane) -> Plane:
    """Plane that forwards by the fixtures' table."""
    table = Table()
    for key, hops in ENTRIES.items():
        table.install(key, hops, float("inf"), paces=PACES.get(key, ()))
    return make(["p0", "p1", "p2"], table)


@pytest.fixture
def node(make: MakePlane) -> Plane:
    """Plane without a table."""
    return make(["p0"], None)


def far_end(ifname: str) -> socket.socket:
    end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    end.setsockopt(263, 23, 1)  # SOL_PACKET, PACKET_IGNORE_OUTGOING
    end.setsockopt(socket.SOL_SOCKET, 33, 4 << 20)  # SO_RCVBUFFORCE: a burst comes while this process waits
    end.bind((ifname, ETHERTYPE))
    end.settimeout(PATIENCE_S)
    return end


def numbered(count: int) -> list[bytes]:
    return [frame(ONE, number.to_bytes(4, "big") + os.urandom(400)) for number in range(count)]


def poll_until(plane: Plane, done: Callable[[], bool]) -> list[ReceivedFrame]:
    """Poll until a condition holds; return the punted frames."""
    arrivals: list[ReceivedFrame] = []
    until(done, meanwhile=lambda: arrivals.extend(plane.poll(LOOK_S)))
    return arrivals


def _idle(plane: Plane) -> bool:
    """Return whether no frame waits for the plane."""
    assert isinstance(plane, NetdevPlane)
    return not plane._epoll.poll(0)


def take_in(plane: Plane, count: int) -> list[ReceivedFrame]:
    """Poll until the plane took ``count`` frames more than the previous calls asked for; return the punted frames.

    The reference is not its present count: the kernel may have forwarded the frames while they were sent.
    """
    wanted = EXPECTED[plane] = EXPECTED.get(plane, 0) + count
    return poll_until(plane, lambda: plane.counters.frames_in >= wanted)


# decisions


@EVERY_KIND
def test_each_fixture_becomes_what_the_reference_says(switch: Plane, ends: dict[int, socket.socket]) -> None:
    for case in CASES:
        before = deepcopy(switch.counters)
        ends[IN].send(case.frame)
        arrivals = take_in(switch, 1)
        ends[IN].send(MARK)
        arrivals += take_in(switch, 1)
        expected = [ReceivedFrame(IN, PEER_MACS[IN], case.frame[14:])] if case.punted else []
        assert arrivals == expected, case.name
        for port in (WIDE, NARROW):
            out = [case.out[port]] if port in case.out else []
            assert [ends[port].recv(1 << 16) for _ in out] == out, case.name
            assert ends[port].recv(1 << 16) == leaves(MARK, port)[port], case.name  # so no other frame left before it
        after = switch.counters
        found = {DropReason(r): n - before.drops[r] for r, n in enumerate(after.drops) if n != before.drops[r]}
        assert found == Counter(case.drops), case.name
        assert after.forwarded == after.frames_out == before.frames_out + len(case.out) + 2, case.name
        assert after.punted == before.punted + len(arrivals), case.name


@EVERY_KIND
def test_frames_of_all_fixtures_in_one_burst_get_each_its_own_decision(
    switch: Plane, ends: dict[int, socket.socket]
) -> None:
    order = Random(7).choices(CASES, k=4 * len(CASES))
    for case in order:
        ends[IN].send(case.frame)
    arrivals = take_in(switch, len(order))
    assert sorted(arrival.frame for arrival in arrivals) == sorted(case.frame[14:] for case in order if case.punted)
    for port in (WIDE, NARROW):  # urgent frames overtake the rest
        expected = [case.out[port] for case in order if port in case.out]
        assert sorted(ends[port].recv(1 << 16) for _ in expected) == sorted(expected)
    reasons = list(chain.from_iterable(case.drops for case in order))
    assert [switch.counters.drops[reason] for reason in DropReason] == [reasons.count(reason) for reason in DropReason]


def test_a_plane_counts_what_came_from_each_port_punted_forwarded_or_dropped(
    switch: Plane, ends: dict[int, socket.socket]
) -> None:
    for case in CASES:
        ends[IN].send(case.frame)
    ends[WIDE].send(WIDE_MAC + MARK[MAC_BYTES:])
    take_in(switch, len(CASES) + 1)
    assert [switch.frames_from(port) for port in (IN, WIDE, NARROW)] == [len(CASES), 1, 0]


def test_an_entry_installed_while_it_runs_counts_at_once(make: MakePlane, ends: dict[int, socket.socket]) -> None:
    table = Table()
    plane = make(["p0", "p1"], table)
    ends[IN].send(frame(ONE))
    assert len(take_in(plane, 1)) == 1
    table.install(ONE, ENTRIES[ONE], float("inf"))
    ends[IN].send(frame(ONE))
    assert take_in(plane, 1) == []
    assert ends[WIDE].recv(1 << 16) == leaves(frame(ONE), WIDE)[WIDE]


# ingress


def test_a_node_without_a_table_gets_everything(node: Plane, ends: dict[int, socket.socket]) -> None:
    ends[IN].send(frame(ONE, hops_left=0)[:60])
    ends[IN].send(frame(ONE, b"x", padding=b"padding"))
    arrivals = take_in(node, 2)
    assert [(a.port, a.mac) for a in arrivals] == [(0, PEER_MACS[IN])] * 2
    assert [a.frame for a in arrivals] == [frame(ONE, hops_left=0)[14:60], frame(ONE, b"x", padding=b"padding")[14:]]


@pytest.mark.parametrize(
    "before",
    [
        bytes([2, 0, 0, 0, 0, 99]) + frame(ONE, kind=Kind.HELLO)[6:],
        bytes([1, 0x80, 0xC2, 0, 0, 0]) + frame(ONE, kind=Kind.HELLO)[6:],
        BROADCAST + frame(ONE)[6:],
        frame(ONE)[:12] + b"\x08\x00" + frame(ONE)[14:],
    ],
    ids=["another station's", "multicast", "broadcast data", "another ethertype"],
)
def test_what_is_none_of_our_business_is_not_even_counted(
    before: bytes, switch: Plane, ends: dict[int, socket.socket]
) -> None:
    ends[IN].send(before)
    ends[IN].send(MARK)
    assert take_in(switch, 1) == []
    assert ends[WIDE].recv(1 << 16) == leaves(MARK, WIDE)[WIDE]
    assert switch.counters.frames_in == 1


def test_a_broadcast_hello_is_punted(switch: Plane, ends: dict[int, socket.socket]) -> None:
    hello = BROADCAST + frame(bytes(32), kind=Kind.HELLO)[6:]
    ends[IN].send(hello)
    assert take_in(switch, 1) == [ReceivedFrame(IN, PEER_MACS[IN], hello[14:])]


def test_what_a_neighbour_sends_after_its_hello_comes_after_it(node: Plane, ends: dict[int, socket.socket]) -> None:
    node.set_neighbours(IN, [PEER_MACS[IN]])
    kinds = [Kind.HELLO, Kind.ADVERTISE]  # the hello opens the session that the advertisement belongs to
    for kind in kinds:
        ends[IN].send(frame(ONE, kind=kind))
    assert [decode(arrival.frame).kind for arrival in take_in(node, len(kinds))] == kinds


def test_a_plane_does_not_hear_itself(node: Plane, ends: dict[int, socket.socket]) -> None:
    assert node.transmit(0, PORT_MACS[IN], [frame(ONE, kind=Kind.HELLO)[14:]]) == 1
    ends[IN].send(MARK)
    assert [arrival.frame for arrival in take_in(node, 1)] == [MARK[14:]]


# sending


@EVERY_KIND
def test_many_frames_leave_whole_and_in_order(node: Plane, ends: dict[int, socket.socket]) -> None:
    frames = numbered(700)
    ether = PEER_MACS[IN] + PORT_MACS[IN] + b"\x88\xb5"
    for at in range(0, 700, BURST):
        burst = [each[14:] for each in frames[at : at + BURST]]
        assert node.transmit(0, PEER_MACS[IN], burst) == BURST
        assert [ends[IN].recv(1 << 16) for _ in burst] == [ether + each for each in burst]
    assert node.counters.frames_out == 700
    assert node.counters.forwarded == 0


def test_many_frames_arrive_whole_and_in_order(node: Plane, ends: dict[int, socket.socket]) -> None:
    frames = numbered(700)
    for at in range(0, 700, BURST):
        burst = frames[at : at + BURST]
        for each in burst:
            ends[IN].send(each)
        assert [arrival.frame for arrival in take_in(node, BURST)] == [each[14:] for each in burst]


def test_a_frame_above_the_mtu_is_counted_and_the_others_leave(node: Plane, ends: dict[int, socket.socket]) -> None:
    assert node.transmit(0, PEER_MACS[IN], [bytes(1_500), bytes(1_501), b"x" * 96]) == 2
    assert [len(ends[IN].recv(1 << 16)) for _ in range(2)] == [1_514, 110]
    assert node.counters.drops[DropReason.TOO_BIG] == 1


def test_sending_to_a_removed_port_counts_as_down(node: Plane) -> None:
    node.remove_port(0)
    assert node.transmit(0, PEER_MACS[IN], [bytes(96), bytes(96)]) == 0
    assert node.counters.drops[DropReason.PORT_DOWN] == 2
    assert 0 not in node.ports


def test_a_removed_port_costs_its_copies_alone(switch: Plane, ends: dict[int, socket.socket]) -> None:
    switch.remove_port(NARROW)
    ends[IN].send(MARK)
    take_in(switch, 1)
    assert ends[WIDE].recv(1 << 16) == leaves(MARK, WIDE)[WIDE]
    assert switch.counters.drops[DropReason.PORT_DOWN] == 1


def test_what_the_kernel_drops_is_counted(
    make: MakePlane, ends: dict[int, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sockets, "_BUFFER_BYTES", 4_096)
    plane = make(["p0"], None)
    for _ in range(500):
        ends[IN].send(frame(ONE, bytes(1_000)))
    while plane.poll(0.001) or not _idle(plane):
        continue
    counters = plane.counters
    assert counters.drops[DropReason.PORT_FULL] > 0
    assert counters.frames_in + counters.drops[DropReason.PORT_FULL] == 500


# ports that come and go


def changes(plane: Plane) -> list[tuple[int, bool]]:
    """Return a list that grows with each port that goes up or down."""
    heard: list[tuple[int, bool]] = []
    plane.on_link(lambda port, up: heard.append((port, up)))
    return heard


def test_a_cut_link_is_noticed_and_so_is_its_repair(
    switch: Plane, space: Space, ends: dict[int, socket.socket]
) -> None:
    heard = changes(switch)
    space.ip("link", "set", "q1", "down")
    poll_until(switch, lambda: heard == [(WIDE, False)])
    assert not switch.ports[WIDE].up
    ends[IN].send(MARK)
    take_in(switch, 1)
    assert ends[NARROW].recv(1 << 16) == leaves(MARK, NARROW)[NARROW]
    assert switch.counters.drops[DropReason.PORT_DOWN] == 1
    space.ip("link", "set", "q1", "up")
    poll_until(switch, lambda: heard == [(WIDE, False), (WIDE, True)])
    wait_for_carrier("q1")
    ends[WIDE].close()
    ends[WIDE] = far_end("q1")
    ends[IN].send(MARK)
    take_in(switch, 1)
    assert ends[WIDE].recv(1 << 16) == leaves(MARK, WIDE)[WIDE]


def test_a_device_switched_off_is_a_port_down_and_works_again_when_on(
    node: Plane, space: Space, ends: dict[int, socket.socket]
) -> None:
    heard = changes(node)
    space.ip("link", "set", "p0", "down")
    poll_until(node, lambda: heard == [(0, False)])
    assert node.transmit(0, PEER_MACS[IN], [bytes(96)]) == 0
    space.ip("link", "set", "p0", "up")
    poll_until(node, lambda: heard == [(0, False), (0, True)])
    wait_for_carrier("q0")
    ends[IN].send(MARK)
    assert len(take_in(node, 1)) == 1


@EVERY_KIND
def test_a_deleted_device_is_a_port_down_until_one_of_its_name_returns(
    node: Plane, space: Space, ends: dict[int, socket.socket]
) -> None:
    heard = changes(node)
    space.ip("link", "del", "p0")
    poll_until(node, lambda: heard == [(0, False)])
    assert node.transmit(0, PEER_MACS[IN], [bytes(96)]) == 0
    new_mac = bytes([2, 0, 0, 0, 0, 77])
    space.veth("p0", "q0", new_mac, PEER_MACS[IN])
    poll_until(node, lambda: heard[-1] == (0, True))
    assert node.ports[0].mac == new_mac
    ends[IN].close()
    ends[IN] = far_end("q0")
    ends[IN].send(new_mac + MARK[6:])
    assert [arrival.frame for arrival in take_in(node, 1)] == [MARK[14:]]
    assert node.transmit(0, PEER_MACS[IN], [bytes(96)]) == 1
    assert ends[IN].recv(1 << 16)[6:12] == new_mac


def test_a_larger_mtu_lets_larger_frames_through(node: Plane, space: Space, ends: dict[int, socket.socket]) -> None:
    for name in ("p0", "q0"):
        space.ip("link", "set", name, "mtu", "9000")
    poll_until(node, lambda: node.ports[0].mtu == 9_000)
    large = frame(ONE, os.urandom(9_000 - 96))
    ends[IN].send(large)
    assert [arrival.frame for arrival in take_in(node, 1)] == [large[14:]]
    assert node.transmit(0, PEER_MACS[IN], [large[14:]]) == 1
    assert ends[IN].recv(1 << 16)[14:] == large[14:]


def test_a_port_added_while_it_runs_carries_frames(make: MakePlane, ends: dict[int, socket.socket]) -> None:
    table = Table()
    plane = make(["p0"], table)
    port = plane.add_port("p1")
    assert plane.ports[port].up
    table.install(ONE, ((port, leaves(MARK, WIDE)[WIDE][:12]),), float("inf"))
    ends[IN].send(frame(ONE))
    take_in(plane, 1)
    assert ends[WIDE].recv(1 << 16) == leaves(frame(ONE), WIDE)[WIDE]


def test_a_port_index_is_never_given_twice(node: Plane) -> None:
    node.remove_port(0)
    assert node.add_port("p0") == 1


def test_a_device_that_is_not_there_is_refused(node: Plane) -> None:
    with pytest.raises(LocalError, match="p9: no such device"):
        node.add_port("p9")


def test_a_device_that_may_come_later_is_opened_when_it_appears(node: Plane, space: Space) -> None:
    heard: list[tuple[int, bool]] = []
    node.on_link(lambda port, up: heard.append((port, up)))
    port = node.add_port("p9", may_be_absent=True)
    assert not node.ports[port].up
    space.veth("p9", "q9", bytes([2, 0, 0, 0, 0, 9]), PEER_MACS[IN])
    poll_until(node, lambda: node.ports[port].up)
    assert heard == [(port, True)]
    assert node.ports[port].mac == bytes([2, 0, 0, 0, 0, 9])
    assert node.transmit(port, PEER_MACS[IN], [frame(ONE)[14:]]) == 1


def test_a_device_given_twice_is_refused(node: Plane) -> None:
    with pytest.raises(LocalError, match="given twice"):
        node.add_port("p0")


def test_a_device_with_too_small_an_mtu_is_refused(node: Plane, space: Space) -> None:
    space.ip("link", "set", "p1", "mtu", "500")
    with pytest.raises(LocalError, match="MTU 500 is below"):
        node.add_port("p1")


def test_a_wrong_device_among_good_ones_leaves_no_socket_behind(make: MakePlane) -> None:
    before = set(os.listdir("/proc/self/fd"))
    with pytest.raises(LocalError):
        make(["p0", "p9"], None)
    assert set(os.listdir("/proc/self/fd")) <= before


# the loop


def test_a_watched_file_wakes_the_poll(node: Plane) -> None:
    one, other = socket.socketpair()
    with one, other:
        heard: list[bytes] = []
        node.watch(one, lambda: heard.append(one.recv(10)))
        other.send(b"wake")
        assert node.poll(PATIENCE_S) == []
        assert heard == [b"wake"]
        node.unwatch(one)
        other.send(b"again")
        assert node.poll(0) == []
        assert heard == [b"wake"]


def test_polling_with_nothing_to_do_returns_nothing(node: Plane) -> None:
    node.poll(0)
    assert node.poll(0) == []


def test_an_idle_plane_reads_the_kernels_drops_after_a_burst_or_half_a_second(space: Space) -> None:
    space.veth("p0", "q0", IN_MAC, PEER_MACS[IN])
    plane, reads = _Auditing(["p0"]), _Auditing.reads
    try:
        plane._audit_s = float("inf")
        plane.poll(0.001)
        assert reads == []
        with far_end("q0") as end:
            for _ in range(16):
                end.send(MARK)
        poll_until(plane, lambda: plane.counters.frames_in == 16)
        plane.poll(0)
        plane.poll(0)
        assert len(reads) == 1
        plane._audit_s = 0.0  # half a second later
        plane.poll(0.001)
        assert len(reads) == 2
    finally:
        plane.close()


class _Auditing(RawPlane):
    """Plane that notes when it reads the kernel's drops."""

    reads: ClassVar[list[int]] = []

    def _kernel_drops(self) -> int:
        self.reads.append(1)
        return super()._kernel_drops()
