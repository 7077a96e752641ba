"""Priority of urgent frames wherever frames queue: the tests check an order, never a time."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator

import pytest
from pyroute2 import IPRoute

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import ETHER_BYTES, FLAGS_AT, Flag, Kind, decode
from gdp.ports.raw import RawPlane
from gdp.sansio import ReceivedFrame
from lab.namespaces import Space
from netns_tests.rows import KINDS, Row, frame, mac_of
from netns_tests.test_planes import far_end, poll_until

pytestmark = pytest.mark.netns

ORDINARY, URGENT = 120, 5
CLOSED, OPEN = 500, 10_000_000  # bytes/s of the narrow link, while it fills and then
BURST_BYTES = 3_028  # two frames of it leave at once

Lay = Callable[[], Row]


@pytest.fixture(params=list(KINDS))
def lay(request: pytest.FixtureRequest, space: Space) -> Iterator[Lay]:
    """Factory of a row of one kind of plane whose first switch has a narrow egress with bands by priority."""
    made: list[Row] = []

    def lay() -> Row:
        try:
            made.append(Row(space, request.param))
        except LocalError as error:
            pytest.skip(str(error).partition("\n")[0])
        narrow("b0")
        made[-1].until(lambda: True)  # so that it has received the event
        return made[-1]

    yield lay
    for row in made:
        row.close()


def narrow(ifname: str) -> None:
    """Put a nearly closed token bucket at a device, with ``pfifo_fast`` in it: every kernel has both."""
    with IPRoute() as here:
        index = socket.if_nametoindex(ifname)
        here.tc("add", "tbf", index, 0x10000, rate=CLOSED, burst=BURST_BYTES, limit=1 << 20)
        here.tc("add", "pfifo_fast", index, 0x20000, parent=0x10001)


def widen(ifname: str) -> None:
    """Release the frames that wait at a device, starting with the next frame that comes to it."""
    with IPRoute() as here:
        index = socket.if_nametoindex(ifname)
        here.tc("change", "tbf", index, 0x10000, rate=OPEN, burst=BURST_BYTES, limit=1 << 20)


def is_urgent(packet: bytes) -> bool:
    """Return whether a frame, from its Ethernet header on, is flagged urgent."""
    return bool(packet[ETHER_BYTES + FLAGS_AT] & Flag.URGENT)


def numbers(packets: list[bytes], *, urgent: bool) -> list[int]:
    """Return the numbers of the frames of one traffic class, in order."""
    return [decode(each, ETHER_BYTES).number for each in packets if is_urgent(each) == urgent]


def test_urgent_frames_overtake_what_waits_for_a_narrow_link(lay: Lay) -> None:
    row = lay()
    row.send(*(frame(payload=bytes(1_300), number=number) for number in range(ORDINARY)))
    for _ in range(4):
        row.poll(0)  # now they wait for the link
    row.send(*(frame(urgent=True, number=number) for number in range(URGENT)))
    row.poll(0)
    widen("b0")
    row.send(frame(number=ORDINARY))
    row.settle()
    assert (row.sums(), row.drops()) == ((ORDINARY + URGENT + 1,) * 2, {})
    assert max(at for at, each in enumerate(row.delivered) if is_urgent(each)) < ORDINARY // 2
    assert numbers(row.delivered, urgent=True) == list(range(URGENT))
    assert numbers(row.delivered, urgent=False) == list(range(ORDINARY + 1))


def test_without_the_flag_the_same_frames_come_last(lay: Lay) -> None:
    row = lay()
    row.send(*(frame(payload=bytes(1_300), number=number) for number in range(ORDINARY)))
    for _ in range(4):
        row.poll(0)
    row.send(*(frame(number=ORDINARY + number) for number in range(URGENT)))
    row.poll(0)
    widen("b0")
    row.send(frame(number=ORDINARY + URGENT))
    row.settle()
    assert numbers(row.delivered, urgent=False) == list(range(ORDINARY + URGENT + 1))


def test_urgent_frames_pass_before_a_flood_that_waits_at_a_switch(space: Space) -> None:
    row = Row(space, "raw")
    row.send(*(frame(number=number) for number in range(ORDINARY)))  # no plane is polled
    row.send(*(frame(urgent=True, number=number) for number in range(URGENT)))
    row.settle()
    row.close()
    assert [is_urgent(each) for each in row.delivered[:URGENT]] == [True] * URGENT
    assert len(row.delivered) == ORDINARY + URGENT


@pytest.fixture
def reader(space: Space) -> Iterator[RawPlane]:
    """Node's plane on ``p0``; the far end is ``q0``."""
    space.veth("p0", "q0", mac_of("a1"), mac_of("q0"))
    plane = RawPlane(["p0"])
    yield plane
    plane.close()


def hello_frame(number: int = 0, source: bytes = b"") -> bytes:
    hello = frame(bytes(32), number=number)
    hello = hello[: ETHER_BYTES + 1] + bytes([Kind.HELLO]) + hello[ETHER_BYTES + 2 :]
    return hello[:6] + source + hello[6 + len(source) :]


def test_a41_a_neighbours_hello_is_not_lost_in_a_flood_of_strangers(reader: RawPlane) -> None:
    reader.set_neighbours(0, {hello_frame()[6:12]})
    with far_end("q0") as sender:
        for number in range(5_000):
            sender.send(hello_frame(number, b"\x06" + number.to_bytes(5, "big")))
        sender.send(hello_frame(9_999))
    got = poll_until(reader, lambda: reader.counters.punted > 0)
    assert decode(got[0].frame).number == 9_999
    begun_s = now_s = time.monotonic()
    while now_s < begun_s + 0.3:
        got += reader.poll(0.05)
        now_s = time.monotonic()
    assert len(got) <= 1 + 128 + 64 + 500 * (now_s - begun_s + 0.1)
    assert reader.counters.drops[DropReason.PORT_FULL] > 4_000


def test_a_neighbour_that_has_gone_is_a_stranger_again_for_the_plane(reader: RawPlane) -> None:
    own = hello_frame()[6:12]
    for known in ({own}, set(), {own, bytes(6)}, {bytes(6)}):
        reader.set_neighbours(0, known)
        with far_end("q0") as sender:
            sender.send(hello_frame(7))
        had = reader.counters.punted
        got = poll_until(reader, lambda had=had: reader.counters.punted > had)  # type: ignore[misc]
        assert [decode(each.frame).number for each in got] == [7]


def test_a_reader_that_did_not_read_for_a_while_gets_first_what_neighbours_say_then_what_is_urgent(
    reader: RawPlane,
) -> None:
    hello = hello_frame()
    reader.set_neighbours(0, {hello[6:12]})
    with far_end("q0") as sender:
        for number in range(ORDINARY):
            sender.send(frame(number=number))
        for number in range(URGENT):
            sender.send(frame(urgent=True, number=number))
        sender.send(hello)
    got: list[ReceivedFrame] = []
    while len(got) <= ORDINARY + URGENT:
        had = len(got)
        got += poll_until(reader, lambda had=had: reader.counters.punted > had)  # type: ignore[misc]
    headers = [decode(each.frame) for each in got]
    assert headers[0].kind == Kind.HELLO
    assert [each.number for each in headers[1 : URGENT + 1] if each.flags & Flag.URGENT] == list(range(URGENT))
    assert [each.number for each in headers[URGENT + 1 :]] == list(range(ORDINARY))


def test_a_node_sends_urgent_frames_past_its_own_that_wait_for_the_link(reader: RawPlane) -> None:
    narrow("p0")
    with far_end("q0") as end:
        ordinary = [frame(payload=bytes(1_300), number=number)[ETHER_BYTES:] for number in range(ORDINARY)]
        urgent = [frame(urgent=True, number=number)[ETHER_BYTES:] for number in range(URGENT)]
        assert reader.transmit(0, mac_of("q0"), ordinary) == ORDINARY
        assert reader.transmit(0, mac_of("q0"), urgent) == URGENT
        widen("p0")
        assert reader.transmit(0, mac_of("q0"), ordinary[:1]) == 1
        got = [end.recv(1 << 16) for _ in range(ORDINARY + URGENT + 1)]
    assert max(at for at, each in enumerate(got) if is_urgent(each)) < ORDINARY // 2
