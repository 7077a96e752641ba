"""Link monitor: the state of network devices (address, MTU, carrier) as the kernel reports it, and its changes.

I/O; two NETLINK_ROUTE sockets (``netlink.py``), so that no notification comes between a request and its reply.
"""

from __future__ import annotations

import socket
from contextlib import ExitStack, closing
from typing import Final, NamedTuple

from gdp.ports.netlink import LINK_GROUP, DeviceInfo, LinkAttribute, NetlinkSocket, Notifications, Rtm, messages

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
            self._news = opened.enter_context(closing(Notifications(LINK_GROUP, _BUFFER_BYTES)))
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
        device = self._questions.link_named(ifname)
        return None if device is None else _link(device)

    def all(self) -> list[Link]:
        """Return every present device."""
        return [link for each in self._questions.links() if (link := _link(each)) is not None]

    def poll(self) -> list[Link]:
        """Return the changes since the last call, in order.

        If notifications arrived faster than they were read, the kernel skips some. Then all present devices come last,
        preceded by the missing ones, marked as gone.
        """
        links: list[Link] = []
        datagrams, has_skipped = self._news.read()
        for message in (each for data in datagrams for each in messages(data)):
            if message.kind in (Rtm.NEWLINK, Rtm.DELLINK):
                link = _link(DeviceInfo.from_body(message.body), gone=message.kind == Rtm.DELLINK)
                links += [] if link is None else [link]
        if has_skipped:
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


def _link(device: DeviceInfo, *, gone: bool = False) -> Link | None:
    """Return a device of a message; None for bridges and wireless drivers, which use the same types."""
    if device.family != socket.AF_UNSPEC or not device.attributes.keys() >= {LinkAttribute.IFNAME, LinkAttribute.MTU}:
        return None
    return Link(
        ifindex=device.ifindex,
        ifname=device.text(LinkAttribute.IFNAME),
        mac=device.attributes.get(LinkAttribute.ADDRESS, b""),
        mtu=device.number(LinkAttribute.MTU),
        up=bool(device.flags & _IFF_UP and device.flags & _IFF_LOWER_UP) and not gone,
        gone=gone,
    )
