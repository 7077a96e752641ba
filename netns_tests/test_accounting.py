"""Frame accounting on real devices: sent = delivered + dropped by reason + punted, with none in flight.

Discards of the kernel are known as follows. A full packet socket: the socket's own statistics. A queue or device that
refuses: the error of the send, or, for what the kernel plane forwards, the statistics of the device and the queue. A
device at which no process listens: that device's ``rx_dropped``.

One discard has no report: a frame that the kernel plane redirects to a device that is gone, until the node has read
that news (in the tests: the next poll). It counts as forwarded.
"""

from __future__ import annotations

import json
import signal
import socket
from collections.abc import Callable, Iterator

import pytest
from pyroute2 import IPRoute

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import Flag, decode
from gdp.ports import sockets
from gdp.ports.raw import RawPlane
from gdp.switch.table import Table
from lab.machine import LabMachine
from lab.namespaces import Space
from lab.process import LabProcess, calling
from netns_tests.rows import FORGOTTEN, KINDS, NOWHERE_NAME, UNKNOWN, B, Row, frame, mac_of
from netns_tests.test_planes import PATIENCE_S, far_end, poll_until

pytestmark = pytest.mark.netns

MakeRow = Callable[..., Row]


@pytest.fixture(params=list(KINDS))
def lay(request: pytest.FixtureRequest, space: Space) -> Iterator[MakeRow]:
    """Factory of a row of one kind of plane; the row is closed at the end."""
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


def discarded(ifname: str) -> int:
    """Return how many frames a device's kernel could not deliver."""
    with IPRoute() as here:
        (link,) = here.get_links(socket.if_nametoindex(ifname))
        return int(link.get_attr("IFLA_STATS64")["rx_dropped"])


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
            frame()[:-1],  # shorter than its header states
            frame()[:16],  # not even flags
        )
    row.settle()
    assert row.sums() == (row.sent, row.sent)
    assert (len(row.delivered), row.punted) == (rounds, rounds)
    assert row.drops() == {
        DropReason.NO_ROUTE: rounds,
        DropReason.HOPS_EXPIRED: 3 * rounds,
        DropReason.TOO_BIG: rounds,
        DropReason.TRUNCATED: 2 * rounds,
    }


def test_a_name_that_one_switch_forgets_in_the_middle_of_a_stream_is_punted_there(lay: MakeRow) -> None:
    row = lay()
    row.send(*[frame(FORGOTTEN)] * 50)
    row.settle()
    row.last_table.remove(FORGOTTEN)
    row.send(*[frame(FORGOTTEN)] * 50)
    row.settle()
    assert (len(row.delivered), row.punted, row.drops()) == (50, 50, {})


@pytest.mark.parametrize("end", ["c0", pytest.param("c1", marks=pytest.mark.nightly)])
def test_a_link_that_is_taken_down_under_a_stream_costs_only_what_is_counted(lay: MakeRow, end: str) -> None:
    row = lay()
    row.send(*[frame()] * 40)
    row.poll(0)
    row.space.ip("link", "set", end, "down")
    row.send(*[frame()] * 40)  # before the switches receive the link event
    row.until(lambda: not row.planes[1].ports[1].up)
    row.send(*[frame()] * 40)
    row.settle()
    row.space.ip("link", "set", end, "up")
    row.until(lambda: row.planes[1].ports[1].up and row.planes[2].ports[0].up)
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
    row.space.ip("link", "del", "c0")
    row.until(lambda: not row.planes[1].ports[1].up and not row.planes[2].ports[0].up)
    row.send(*[frame()] * 40)
    row.settle()
    assert row.sums() == (540, 540)
    assert (len(row.delivered), row.drops()) == (500, {DropReason.PORT_DOWN: 40})


def test_a_device_that_is_deleted_and_made_again_under_a_stream_loses_nothing_uncounted(lay: MakeRow) -> None:
    row = lay()
    for _ in range(3):
        row.send(*[frame()] * 100)
        row.poll()
        row.discarded += discarded("c1")  # sent by the second switch before the third had opened the device
        row.space.ip("link", "del", "c0")
        row.until(lambda: not row.planes[1].ports[1].up and not row.planes[2].ports[0].up)
        row.send(*[frame()] * 10)
        row.space.veth("c0", "c1", mac_of("c0"), mac_of("c1"))
        row.until(lambda: row.planes[1].ports[1].up and row.planes[2].ports[0].up)
    row.discarded += discarded("c1")
    row.send(*[frame()] * 100)
    row.settle()
    assert row.sums() == (430, 430)
    assert len(row.delivered) >= 100
    assert set(row.drops()) <= {DropReason.PORT_DOWN, DropReason.PORT_FULL}


def test_the_drops_of_a_full_socket_are_counted_with_its_punts(lay: MakeRow, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "_BUFFER_BYTES", 4_096)
    row = lay()
    row.send(*[frame(UNKNOWN, bytes(1_000))] * 500)
    row.settle()
    assert row.sums() == (500, 500)
    assert row.punted > 0
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


def test_what_comes_to_a_reader_that_has_left_is_counted_by_its_device(lay: MakeRow) -> None:
    row = lay()
    row.send(*[frame()] * 50)
    row.settle()
    row.b.close()
    row.b = far_end("d0")  # no frame comes in there
    row.send(*[frame()] * 50)
    row.until(lambda: discarded("d1") >= 50)
    assert (len(row.delivered), discarded("d1"), row.drops()) == (50, 50, {})


def count_frames(ifname: str, buffer_bytes: str) -> None:
    """Count a device's frames until an urgent one has come and no more follow; a process of its own.

    ``buffer_bytes``: of socket memory on each lane.
    """
    sockets._BUFFER_BYTES = int(buffer_bytes)  # type: ignore[misc]
    plane = RawPlane([ifname])
    print("ready", flush=True)
    numbers: list[int] = []
    is_over = False
    while True:
        arrivals = plane.poll(0.0 if is_over else None)
        headers = [decode(each.frame) for each in arrivals]
        numbers += [each.number for each in headers if not each.flags & Flag.URGENT]
        if is_over and not arrivals:
            break
        is_over = is_over or len(headers) > sum(not each.flags & Flag.URGENT for each in headers)
    said = {"numbers": numbers, "dropped": plane.counters.drops[DropReason.PORT_FULL]}
    plane.close()
    print(json.dumps(said), flush=True)


def readers(machine: LabMachine, **buffers: int) -> list[LabProcess]:
    """Start processes that read one device each with this buffer size in bytes; return them when they do."""
    started = [machine.launch(calling(count_frames, *each)) for each in buffers.items()]
    for child in started:
        assert child.read_line(PATIENCE_S) == b"ready"
    return started


@pytest.mark.parametrize("kind", KINDS)
def test_of_three_readers_the_one_that_stands_still_alone_loses_and_counts_it(
    space: Space, machine: LabMachine, kind: str
) -> None:
    count, large, small = 2_000, 16 << 20, 256 << 10
    for link in "abcd":
        space.veth(f"{link}0", f"{link}1", mac_of(f"{link}0"), mac_of(f"{link}1"))
    hops = tuple((at, mac_of(f"{link}1") + mac_of(f"{link}0")) for at, link in enumerate("bcd", 1))
    table = Table()
    table.install(B, hops, float("inf"))
    *quick, slow = readers(machine, b1=large, c1=large, d1=small)
    with far_end("a0") as sender:
        try:
            plane = KINDS[kind](["a1", "b0", "c0", "d0"], table)
        except LocalError as error:
            pytest.skip(str(error).partition("\n")[0])
        slow.send(signal.SIGSTOP)
        for number in range(count):
            sender.send(frame(payload=bytes(500), number=number))
            plane.poll(0)
        poll_until(plane, lambda: plane.counters.forwarded >= 3 * count)
        sender.send(frame(urgent=True))
        poll_until(plane, lambda: plane.counters.forwarded >= 3 * (count + 1))
        slow.send(signal.SIGCONT)
        said = [json.loads(each.output(PATIENCE_S)) for each in (*quick, slow)]
        drops = plane.counters.drops
        plane.close()
    assert sum(drops) == 0
    for each in said[:2]:
        assert (each["numbers"], each["dropped"]) == (list(range(count)), 0)
    lost = said[2]["dropped"]
    assert lost > 0
    assert len(said[2]["numbers"]) + lost == count
    assert said[2]["numbers"] == sorted(set(said[2]["numbers"]))
