"""Link monitor: the state of network devices (address, MTU, carrier) as the kernel reports it, and its changes.

I/O; two NETLINK_ROUTE sockets (``netlink.py``), so that no notification comes between a request and its reply.
"""

from __future__ import annotations

import errno
import socket
import sys
from contextlib import ExitStack, closing
from typing import Final, NamedTuple

from gdp.ports.netlink import (
    LINK_GROUP,
    READ_BYTES,
    RTM_DELLINK,
    RTM_NEWLINK,
    DeviceInfo,
    LinkAttribute,
    Message,
    NetlinkSocket,
    listen,
    messages,
)

__all__ = ["Link", "LinkMonitor"]

_IFF_UP, _IFF_LOWER_UP = 0x1, 0x10000
_BUFFER_BYTES: Final = 1 << 20


class Link(NamedTuple):
    """One device as the kernel describes it.

    Attributes:
        up: switched on and with a carrier.
        gone: deleted, or moved to another namespace.
    """

    ifindex: int
    ifname: str
    mac: bytes
    mtu: int
    up: bool
    gone: bool


class LinkMonitor:
    """The links of this namespace, and notifications of their changes.

    Raises:
        LocalError: the kernel has no such sockets (never on an ordinary Linux), or refuses a request of a method.
    """

    def __init__(self) -> None:
        with ExitStack() as opened:
            self._questions = opened.enter_context(closing(NetlinkSocket()))
            self._news = opened.enter_context(listen(LINK_GROUP))
            self._news.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            self._known = {link.ifindex: link for link in self.all()}
            opened.pop_all()

    def fileno(self) -> int:
        """Return the descriptor to wait on; readable when there are notifications."""
        return self._news.fileno()

    def close(self) -> None:
        """Close both sockets."""
        self._news.close()
        self._questions.close()

    def get(self, ifname: str) -> Link | None:
        """Return one device; None if there is none of that name.

        A device with a carrier drops sent frames until the kernel activates it a little later. Since Linux 6.8 this
        request (and no other) waits for that, so ``up`` holds for the first frame.
        """
        return next((link for each in self._questions.link_named(ifname) for link in _links(each)), None)

    def all(self) -> list[Link]:
        """Return every present device."""
        return [link for each in self._questions.links() for link in _links(each)]

    def poll(self) -> list[Link]:
        """Return the changes since the last call, in order.

        If notifications arrived faster than they were read, the kernel skips some. Then all present devices come last,
        preceded by the missing ones, marked as gone.
        """
        links: list[Link] = []
        skipped = False
        while True:
            try:
                data = self._news.recv(READ_BYTES)
            except BlockingIOError:
                break
            except OSError as error:  # ENOBUFS precedes older notifications that still wait
                if error.errno != errno.ENOBUFS:
                    raise
                skipped = True
                continue
            for message in messages(data):
                links += _links(message)
        if skipped:
            now = self.all()
            lost = self._known.keys() - {link.ifindex for link in now}
            links += [self._known[ifindex]._replace(up=False, gone=True) for ifindex in lost]
            links += now
        for link in links:
            if link.gone:
                self._known.pop(link.ifindex, None)
            else:
                self._known[link.ifindex] = link
        return links


def _links(message: Message) -> list[Link]:
    """Return the one device of a message, or none: bridges and wireless drivers also use these types."""
    if message.kind not in (RTM_NEWLINK, RTM_DELLINK):
        return []
    info = DeviceInfo.from_body(message.body)
    values = info.attributes
    if info.family != socket.AF_UNSPEC or not values.keys() >= {LinkAttribute.IFNAME, LinkAttribute.MTU}:
        return []
    gone = message.kind == RTM_DELLINK
    return [
        Link(
            ifindex=info.ifindex,
            ifname=values[LinkAttribute.IFNAME].rstrip(b"\0").decode(errors="replace"),
            mac=values.get(LinkAttribute.ADDRESS, b""),
            mtu=int.from_bytes(values[LinkAttribute.MTU], sys.byteorder),
            up=bool(info.flags & _IFF_UP and info.flags & _IFF_LOWER_UP) and not gone,
            gone=gone,
        )
    ]
