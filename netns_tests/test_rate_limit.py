"""Rate limit of a device: ordinary frames beyond it are dropped, urgent ones pass, and it can be changed."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from gdp.errors import LocalError
from gdp.frame.codec import ETHERTYPE
from gdp.ports.kernel.device import TxDrops
from gdp.ports.netlink import NetlinkSocket
from gdp.ports.tunnel.rate_limit import limit_rate
from lab.namespaces import Space

pytestmark = pytest.mark.netns

MAC, PEER_MAC = bytes([2, 0, 0, 0, 0, 1]), bytes([2, 0, 0, 0, 0, 2])
RATE = 20_000
FRAME = PEER_MAC + MAC + ETHERTYPE.to_bytes(2, "big") + bytes(1_000)
NUMBER = 200
INTERACTIVE = 6  # TC_PRIO_INTERACTIVE, of the sockets for control and urgent frames


@pytest.fixture
def link(space: Space) -> Iterator[tuple[socket.socket, socket.socket, socket.socket]]:
    """Return sockets of a limited device: for ordinary frames, for urgent ones, and that of the other end."""
    space.veth("one", "two", MAC, PEER_MAC)
    limit_rate("one", RATE)
    ordinary, urgent, far = (
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE)) for _ in range(3)
    )
    for each, ifname in ((ordinary, "one"), (urgent, "one"), (far, "two")):
        each.bind((ifname, ETHERTYPE))
        each.setblocking(False)
    urgent.setsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY, INTERACTIVE)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    yield ordinary, urgent, far
    for each in (ordinary, urgent, far):
        each.close()


def sent(by: socket.socket, frame: bytes, number: int = NUMBER) -> int:
    """Send a frame several times at once; return how many the device took."""
    taken = 0
    for _ in range(number):
        try:
            by.send(frame)
        except OSError:  # ENOBUFS: the queue refused it, which a data plane counts
            continue
        taken += 1
    return taken


def arrived(far: socket.socket, number: int, patience_s: float = 10.0) -> list[bytes]:
    """Return the frames that come, until this number has."""
    found: list[bytes] = []
    far.settimeout(patience_s)
    while len(found) < number:
        found.append(far.recv(2_048))
    return found


def test_ordinary_frames_beyond_the_rate_are_dropped_and_the_others_take_their_time(
    link: tuple[socket.socket, socket.socket, socket.socket],
) -> None:
    ordinary, _, far = link
    begun_s = time.monotonic()
    taken = sent(ordinary, FRAME)
    assert taken < NUMBER / 2
    arrived(far, taken)
    burst_bytes = 16 << 10
    assert time.monotonic() - begun_s >= (taken * len(FRAME) - burst_bytes) / RATE * 0.9


def test_urgent_frames_pass_a_queue_that_is_full(
    link: tuple[socket.socket, socket.socket, socket.socket],
) -> None:
    ordinary, urgent, far = link
    taken = sent(ordinary, FRAME)
    marked = FRAME[:-1] + b"\1"
    assert sent(urgent, marked, 1) == 1
    found = arrived(far, taken + 1)
    assert found.index(marked) < len(found) - 5


def test_a_limit_is_replaced(link: tuple[socket.socket, socket.socket, socket.socket]) -> None:
    ordinary, _, _ = link
    limit_rate("one", 1_000 * RATE)
    assert sent(ordinary, FRAME) == NUMBER


def test_the_drops_are_counted_by_the_kernel_plane(
    link: tuple[socket.socket, socket.socket, socket.socket],
) -> None:
    drops, ifindex = TxDrops(), socket.if_nametoindex("one")
    with closing(NetlinkSocket()) as netlink:
        drops.poll(netlink, [ifindex])
        taken = sent(link[0], FRAME)
        drops.poll(netlink, [ifindex])
    assert drops.total == NUMBER - taken > 0


def test_a_missing_device_is_named(space: Space) -> None:
    with pytest.raises(LocalError, match="nothing"):
        limit_rate("nothing", RATE)
