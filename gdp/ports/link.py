"""What the kernel says about network devices: address, MTU, carrier, and when they change.

Place: I/O; one NETLINK_ROUTE socket, for the namespace it was opened in. Read by hand because a switch on a small
machine should not carry a netlink library: the two messages needed here are a few lines.
Source: rtnetlink(7), netlink(7); ``struct nlmsghdr`` and ``struct ifinfomsg`` in host byte order::

    nlmsghdr   length (4)  type (2)  flags (2)  sequence (4)  port id (4)
    ifinfomsg  family (1)  pad (1)  type (2)  index (4, signed)  flags (4)  change (4)
    attribute  length (2)  type (2)  value, padded to 4 bytes
"""

from __future__ import annotations

import errno
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Final, NamedTuple

__all__ = ["Link", "LinkWatch"]

_HEADER: Final = struct.Struct("=IHHII")
_INFO: Final = struct.Struct("=BxHiII")
_ATTRIBUTE: Final = struct.Struct("=HH")

_RTMGRP_LINK: Final = 1
_NLMSG_ERROR, _NLMSG_DONE = 2, 3
_RTM_NEWLINK, _RTM_DELLINK, _RTM_GETLINK = 16, 17, 18
_NLM_F_REQUEST, _NLM_F_DUMP = 0x1, 0x300
_IFLA_ADDRESS, _IFLA_IFNAME, _IFLA_MTU = 1, 3, 4
_IFF_UP, _IFF_LOWER_UP = 0x1, 0x10000
_READ_BYTES: Final = 1 << 16
_BUFFER_BYTES: Final = 1 << 20
_FOREVER_S: Final = 5.0  # a dump is answered by the kernel at once; this only keeps a bug from hanging a node


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


class LinkWatch:
    """The links of this namespace, and news of them.

    Raises:
        OSError: the kernel has no such sockets (never on an ordinary Linux).
    """

    def __init__(self) -> None:
        self._news = _open(_RTMGRP_LINK)
        self._news.setblocking(False)
        self._known = {link.ifindex: link for link in self.all()}

    def fileno(self) -> int:
        """Return what to wait on; readable when there is news."""
        return self._news.fileno()

    def close(self) -> None:
        self._news.close()

    def ask(self, ifname: str) -> Link | None:
        """Ask for one device; None when there is none of that name.

        A device with a carrier swallows what is sent until the kernel has activated it, a little later; since Linux 6.8
        this question (and no other) waits for that, so ``up`` is true of the first frame.
        """
        name = ifname.encode() + b"\0"
        padding = bytes(-len(name) % 4)
        attribute = _ATTRIBUTE.pack(_ATTRIBUTE.size + len(name), _IFLA_IFNAME) + name + padding
        return next(iter(self._question(attribute, 0)), None)

    def all(self) -> list[Link]:
        """Ask for every device there is now."""
        return self._question(b"", _NLM_F_DUMP)

    def _question(self, attribute: bytes, flags: int) -> list[Link]:
        """Ask the kernel, in a socket of its own so that news does not come between."""
        body = _INFO.pack(socket.AF_UNSPEC, 0, 0, 0, 0) + attribute
        links: list[Link] = []
        with _open(0) as question:
            question.settimeout(_FOREVER_S)
            question.send(_HEADER.pack(_HEADER.size + len(body), _RTM_GETLINK, _NLM_F_REQUEST | flags, 1, 0) + body)
            while True:
                for kind, answer in _messages(question.recv(_READ_BYTES)):
                    if kind in (_NLMSG_DONE, _NLMSG_ERROR):
                        return links
                    links += _links(kind, answer)
                if not flags:
                    return links

    def news(self) -> list[Link]:
        """Return what changed since last asked, in order.

        Where news came faster than it was read, the kernel skips some; then all there is comes last, and what is
        missing from it before, as gone.
        """
        links: list[Link] = []
        skipped = False
        while True:
            try:
                data = self._news.recv(_READ_BYTES)
            except BlockingIOError:
                break
            except OSError as error:  # told before the older news that is still waiting
                if error.errno != errno.ENOBUFS:
                    raise
                skipped = True
                continue
            for kind, body in _messages(data):
                links += _links(kind, body)
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


def _open(groups: int) -> socket.socket:
    opened = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    opened.bind((0, groups))
    return opened


def _messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and body of each netlink message; the kernel wrote them, so lengths are right."""
    at = 0
    while at + _HEADER.size <= len(data):
        length, kind, *_ = _HEADER.unpack_from(data, at)
        if length < _HEADER.size:
            return
        yield kind, data[at + _HEADER.size : at + length]
        at += length + 3 & ~3


def _links(kind: int, body: bytes) -> list[Link]:
    """Return the one device that a message tells of, or none: bridges and wireless drivers also use these types."""
    if kind not in (_RTM_NEWLINK, _RTM_DELLINK):
        return []
    family, _, ifindex, flags, _ = _INFO.unpack_from(body)
    values = dict(_attributes(body))
    if family != socket.AF_UNSPEC or not values.keys() >= {_IFLA_IFNAME, _IFLA_MTU}:
        return []
    gone = kind == _RTM_DELLINK
    return [
        Link(
            ifindex=ifindex,
            ifname=values[_IFLA_IFNAME].rstrip(b"\0").decode(errors="replace"),
            mac=values.get(_IFLA_ADDRESS, b""),
            mtu=int.from_bytes(values[_IFLA_MTU], sys.byteorder),
            up=bool(flags & _IFF_UP and flags & _IFF_LOWER_UP) and not gone,
            gone=gone,
        )
    ]


def _attributes(body: bytes) -> Iterator[tuple[int, bytes]]:
    at = _INFO.size
    while at + _ATTRIBUTE.size <= len(body):
        length, kind = _ATTRIBUTE.unpack_from(body, at)
        if length < _ATTRIBUTE.size:
            return
        yield kind, body[at + _ATTRIBUTE.size : at + length]
        at += length + 3 & ~3
