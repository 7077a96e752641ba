"""No frame is lost without a word on real devices: sent = delivered + dropped by reason + handed up, and none in flight.

What the kernel itself discards, and how it is known: a full packet socket by the socket's own statistics; a queue or a
device that refuses, by the error of the send, or for what the kernel plane sends on by the device's and the queue's
statistics. One thing it tells nobody: a frame that the kernel plane redirects to a device that is gone, until the news
of that has been read (in the tests: the next poll). It counts as forwarded.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator

import pytest
from pyroute2 import IPRoute

from gdp.errors import DropReason, LocalError
from gdp.limits import HOPS_MAX
from gdp.ports import sockets
from netns_tests.rows import B, FORGOTTEN, KINDS, NOWHERE_NAME, UNKNOWN, Row, frame, mac_of, waiting
from netns_tests.spaces import Space
from netns_tests.test_planes import far_end

pytestmark = pytest.mark.netns

MakeRow = Callable[..., Row]


@pytest.fixture(params=list(KINDS))
def lay(request: pytest.FixtureRequest, space: Space) -> Iterator[MakeRow]:
    """Lays a row of one kind of plane; it is closed at the end."""
    made: list[Row] = []

    def lay(**mtus: int) -> Row:
        try:
            made.append(Row(space, request.param, **mtus))
        except LocalError as error:
            pytest.skip(str(error).partition("\n")[0])
        return made[-1]

    yield lay
    for row in made:
        row.close()


def test_every_wrong_frame_is_dropped_for_its_own_reason_at_whichever_switch(lay: MakeRow) -> None:
    row = lay(c=700)
    rounds = 20
    for _ in range(rounds):
        row.send(
            frame(),
            frame(UNKNOWN),
            frame(NOWHERE_NAME),
            frame(hops_left=1),
            frame(hops_left=2),
            frame(hops_left=3),
            frame(payload=bytes(900)),  # too long for the third link
            frame()[:-1],  # shorter than it says
            frame()[:16],  # not even flags
        )
    row.settle()
    assert row.sums() == (row.sent, row.sent)
    assert (len(row.delivered), row.handed_up) == (rounds, rounds)
    assert row.drops() == {
        DropReason.NO_ROUTE: rounds,
        DropReason.HOPS_EXPIRED: 3 * rounds,
        DropReason.TOO_BIG: rounds,
        DropReason.TRUNCATED: 2 * rounds,
    }


def test_a_name_that_one_switch_forgets_in_the_middle_of_a_stream_is_handed_up_there(lay: MakeRow) -> None:
    row = lay()
    row.send(*[frame(FORGOTTEN)] * 50)
    row.settle()
    row.last_table.remove(FORGOTTEN)
    row.send(*[frame(FORGOTTEN)] * 50)
    row.settle()
    assert (len(row.delivered), row.handed_up, row.drops()) == (50, 50, {})


@pytest.mark.parametrize("end", ["c0", "c1"])
def test_a_link_that_is_taken_down_under_a_stream_costs_only_what_is_counted(lay: MakeRow, end: str) -> None:
    row = lay()
    row.send(*[frame()] * 40)
    row.poll(0)
    row.space.ip("set", end, "down")
    row.send(*[frame()] * 40)  # before the switches have heard of it
    row.until(lambda: not row.planes[1].port_state(1))
    row.send(*[frame()] * 40)
    row.settle()
    row.space.ip("set", end, "up")
    row.until(lambda: row.planes[1].port_state(1) and row.planes[2].port_state(0))
    before = len(row.delivered)
    row.send(*[frame()] * 40)
    row.settle()
    assert row.sums() == (160, 160)
    assert set(row.drops()) <= {DropReason.PORT_DOWN, DropReason.PORT_FULL}
    assert row.drops()[DropReason.PORT_DOWN] >= 40
    assert len(row.delivered) == before + 40


def test_what_had_arrived_from_a_device_that_is_deleted_goes_on_and_the_rest_is_counted(lay: MakeRow) -> None:
    row = lay()
    row.send(*[frame(number=number) for number in range(500)])
    for _ in range(50):
        row.poll(0, 1)  # now they wait at the third switch, unless the kernel has brought them to B
    row.space.ip("del", "c0")
    row.until(lambda: not row.planes[1].port_state(1) and not row.planes[2].port_state(0))
    row.send(*[frame()] * 40)
    row.settle()
    assert row.sums() == (540, 540)
    assert (len(row.delivered), row.drops()) == (500, {DropReason.PORT_DOWN: 40})


def test_a_device_that_is_deleted_and_made_again_under_a_stream_loses_nothing_uncounted(lay: MakeRow) -> None:
    row = lay()
    for _ in range(3):
        row.send(*[frame()] * 100)
        row.poll()
        row.space.ip("del", "c0")
        row.until(lambda: not row.planes[1].port_state(1) and not row.planes[2].port_state(0))
        row.send(*[frame()] * 10)
        row.space.veth("c0", "c1", mac_of("c0"), mac_of("c1"))
        row.until(lambda: row.planes[1].port_state(1) and row.planes[2].port_state(0))
    row.send(*[frame()] * 100)
    row.settle()
    assert row.sums() == (430, 430)
    assert len(row.delivered) >= 100


def test_what_a_full_socket_drops_is_counted_with_what_it_hands_up(
    lay: MakeRow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sockets, "_BUFFER_BYTES", 4_096)
    row = lay()
    row.send(*[frame(UNKNOWN, bytes(1_000))] * 500)
    row.settle()
    assert row.sums() == (500, 500)
    assert row.handed_up > 0
    assert row.drops()[DropReason.PORT_FULL] > 0


def test_what_a_full_queue_refuses_is_counted_and_what_waits_in_it_arrives(lay: MakeRow) -> None:
    row = lay()
    with IPRoute() as here:
        queue = {"handle": 0x10000, "rate": 200_000, "burst": 3_000, "limit": 20_000}
        here.tc("add", "tbf", socket.if_nametoindex("b0"), **queue)
    row.until(lambda: True)
    row.send(*[frame(payload=bytes(1_300))] * 100)
    row.settle()
    assert row.sums() == (100, 100)
    assert len(row.delivered) >= 10
    assert row.drops() == {DropReason.PORT_FULL: 100 - len(row.delivered)}


def test_a_port_that_is_removed_sends_on_what_had_arrived_at_it(lay: MakeRow) -> None:
    row = lay()
    row.send(*[frame()] * 200)
    row.planes[0].remove_port(0)
    row.settle()
    assert (len(row.delivered), row.drops()) == (200, {})


def test_a_reader_whose_socket_is_gone_costs_the_switches_nothing(lay: MakeRow, space: Space) -> None:
    row = lay()
    with far_end("d0") as tap:  # what leaves the last switch, as it would reach a reader
        tap.setsockopt(263, 23, 0)  # SOL_PACKET, PACKET_IGNORE_OUTGOING
        row.b.close()
        row.b = far_end("a0")  # of which nothing comes
        row.send(*[frame()] * 50)
        left: list[bytes] = []

        def have_left() -> bool:
            left.extend(waiting(tap))
            return len(left) >= 50

        row.until(have_left)
    assert row.drops() == {}
    assert all(B in each for each in left)
