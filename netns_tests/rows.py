"""Row of three switches' planes on real devices of one namespace, driven by the test's thread.

::

    A a0 -- a1 [s1] b0 -- b1 [s2] c0 -- c1 [s3] d0 -- d1 B           A and B are plain packet sockets
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise

from gdp.errors import DropReason
from gdp.frame.codec import ETHERTYPE, Flag, Header, Kind, encode
from gdp.limits import HOPS_MAX
from gdp.ports.kernel.plane import KernelPlane
from gdp.ports.netdev import NetdevPlane
from gdp.ports.raw import RawPlane
from gdp.switch.table import NOWHERE, Table
from lab.namespaces import Space
from lab.process import until
from netns_tests.test_planes import LOOK_S, far_end

B, UNKNOWN, NOWHERE_NAME, FORGOTTEN = (bytes([0xE0 + n]) * 32 for n in range(4))
KINDS: Mapping[str, Callable[[Sequence[str], Table], NetdevPlane]] = {"raw": RawPlane, "kernel": KernelPlane}
LINKS = ("a", "b", "c", "d")
BUFFER_BYTES = 1 << 26
SO_SNDBUFFORCE, SO_RCVBUFFORCE = 32, 33


def mac_of(ifname: str) -> bytes:
    """Return the address of a device of the row."""
    return b"\x02\x00\x00\x00" + ifname.encode()


def frame(
    name: bytes = B, payload: bytes = b"payload", *, hops_left: int = HOPS_MAX, urgent: bool = False, number: int = 0
) -> bytes:
    """Return a frame as A sends it to the first switch."""
    flags = Flag.LAST | (Flag.URGENT if urgent else 0)
    header = Header(Kind.DATA, flags, hops_left, 0, len(payload), number, 0, 1, 1, name, b"\xaa" * 32)
    return mac_of("a1") + mac_of("a0") + ETHERTYPE.to_bytes(2, "big") + encode(header) + payload


def waiting(end: socket.socket) -> Iterator[bytes]:
    """Yield the received frames."""
    end.setblocking(False)
    while True:
        try:
            yield end.recv(1 << 16)
        except BlockingIOError:
            return


class Row:
    """Planes of a row, and the frames that A and B saw.

    Args:
        kind: a key of ``KINDS``.
        mtus: of links by letter; others have 1,500.

    Attributes:
        sent: frames that A's device took.
        delivered: frames that came to B, in order.
        discarded: frames that the kernel could not deliver, as counted by the test.
        punted: frames that planes gave to their node, which does not use them here.
    """

    def __init__(self, space: Space, kind: str, **mtus: int) -> None:
        for link in LINKS:
            space.veth(f"{link}0", f"{link}1", mac_of(f"{link}0"), mac_of(f"{link}1"), mtus.get(link, 1_500))
        self.space = space
        self.sent = self.punted = self.discarded = 0
        self.delivered: list[bytes] = []
        self.a, self.b = far_end("a0"), far_end("d1")
        # holds the frames that wait at the next queue
        self.a.setsockopt(socket.SOL_SOCKET, SO_SNDBUFFORCE, BUFFER_BYTES)
        self.b.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER_BYTES)
        self.planes: list[NetdevPlane] = []
        for left, right in pairwise(LINKS):
            table = Table()
            to_next = (1, mac_of(f"{right}1") + mac_of(f"{right}0"))
            table.install(B, (to_next,), float("inf"))
            table.install(NOWHERE_NAME, NOWHERE, float("inf"))
            table.install(FORGOTTEN, (to_next,), float("inf"))
            self.planes.append(KINDS[kind]([f"{left}1", f"{right}0"], table))
            self.last_table = table

    def send(self, *frames: bytes) -> None:
        """Let A send; no plane is polled during this time."""
        for each in frames:
            self.sent += self.a.send(each) == len(each)

    def poll(self, *planes: int) -> None:
        """Poll these planes once, or all if none is given."""
        for plane in [self.planes[at] for at in planes] or self.planes:
            self.punted += len(plane.poll(0))

    def until(self, done: Callable[[], bool]) -> None:
        """Poll all planes until a condition holds."""

        def look() -> None:
            self.poll()
            self.punted += len(self.planes[-1].poll(LOOK_S / 10))
            self.delivered += waiting(self.b)

        until(done, self.sums, meanwhile=look)

    def drops(self) -> dict[DropReason, int]:
        """Return the drops of all planes, by reason."""
        lists = [plane.counters.drops for plane in self.planes]
        found = {reason: sum(counts[reason] for counts in lists) for reason in DropReason}
        return {reason: count for reason, count in found.items() if count}

    def sums(self) -> tuple[int, int]:
        """Return the number of frames sent, and the number whose fate is known."""
        return self.sent, len(self.delivered) + sum(self.drops().values()) + self.punted + self.discarded

    def settle(self) -> None:
        """Return when every frame sent is accounted for and no frame moves."""
        self.until(lambda: self.sums()[1] >= self.sent)
        for plane in self.planes:
            while arrivals := plane.poll(LOOK_S):
                self.punted += len(arrivals)
        self.delivered += waiting(self.b)

    def close(self) -> None:
        """Close every socket."""
        for plane in self.planes:
            plane.close()
        self.a.close()
        self.b.close()
