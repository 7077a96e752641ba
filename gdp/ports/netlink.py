"""Netlink sockets: requests to the kernel about devices, queues and filters, and the parser of its messages.

I/O; every socket stays in the namespace that it was opened in. The parser is written by hand, because pyroute2 takes
0.13 s and 10 MiB in every node (ADR 363).
Source: rtnetlink(7), netlink(7); ``struct nlmsghdr``, ``struct nlmsgerr``, ``struct ifinfomsg`` and ``struct tcmsg`` in
host byte order. The end of a dump may carry an error, as an error message does::

    nlmsghdr   length (4)  type (2)  flags (2)  sequence (4)  port id (4)
    ifinfomsg  family (1)  pad (1)  type (2)  index (4, signed)  flags (4)  change (4)
    attribute  length (2)  type (2)  value, padded to 4 bytes
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import sys
from collections.abc import Iterable, Iterator
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

from gdp.errors import LocalError

CLSACT_INGRESS: Final = 0xFFFFFFF2  # TC_H_MAKE(TC_H_CLSACT, TC_H_MIN_INGRESS)
CLSACT_EGRESS: Final = 0xFFFFFFF3
ROOT: Final = 0xFFFFFFFF
LINK_GROUP: Final = 1  # RTMGRP_LINK: devices that change
ADDRESS_GROUPS: Final = 0x10 | 0x100  # RTMGRP_IPV4_IFADDR, RTMGRP_IPV6_IFADDR
ROUTE_GROUPS: Final = 0x40 | 0x400  # RTMGRP_IPV4_ROUTE, RTMGRP_IPV6_ROUTE
TRAFFIC_GROUP: Final = 8  # RTMGRP_TC: queues and filters that change
ROUTE: Final = struct.Struct("=BBBBBBBBI")  # struct rtmsg, struct fib_rule_hdr
TRAFFIC: Final = struct.Struct("=BxxxiIII")
NUMBER: Final = struct.Struct("=I")

_HEADER: Final = struct.Struct("=IHHII")
_INFO: Final = struct.Struct("=BxHiII")
_ATTRIBUTE: Final = struct.Struct("=HH")
_SIGNED: Final = struct.Struct("=i")
_READ_BYTES: Final = 1 << 16
_NLMSG_ERROR, _NLMSG_DONE = 2, 3
_NLM_F_REQUEST, _NLM_F_ACK, _NLM_F_DUMP = 0x1, 0x4, 0x300
_NESTED: Final = 0x8000  # NLA_F_NESTED
_TCA_KIND, _TCA_OPTIONS, _TCA_BPF_NAME = 1, 2, 7
_FOREVER_S: Final = 5.0  # the kernel replies at once; the limit only keeps a bug from blocking a node


class Rtm(IntEnum):
    """Types of messages, as far as they are used here."""

    NEWLINK, DELLINK, GETLINK, SETLINK = 16, 17, 18, 19
    NEWADDR, GETADDR = 20, 22
    NEWROUTE, DELROUTE, GETROUTE = 24, 25, 26
    NEWRULE, DELRULE, GETRULE = 32, 33, 34
    NEWQDISC, GETQDISC = 36, 38
    NEWTFILTER, GETTFILTER = 44, 46


class Change(IntFlag):
    """Flags of a request that makes something: ``NLM_F_``."""

    REPLACE, EXCLUSIVE, CREATE = 0x100, 0x200, 0x400


class LinkAttribute(IntEnum):
    """Attributes of a device, as far as they are used here."""

    ADDRESS = 1
    IFNAME = 3
    MTU = 4
    LINK = 5  # ifindex of the other end of a pair, in its namespace
    QDISC = 6
    TXQLEN = 13
    LINKINFO = 18
    IFALIAS = 20
    STATS64 = 23
    LINK_NETNSID = 37
    XDP = 43
    TARGET_NETNSID = 46


class Message(NamedTuple):
    """One netlink message: its type, sequence number and the bytes after its header."""

    kind: int
    sequence: int
    body: bytes


class DeviceInfo(NamedTuple):
    """The body of a message about a device: address family, ifindex, ``IFF_`` flags, attributes by type."""

    family: int
    ifindex: int
    flags: int
    attributes: dict[int, bytes]

    @classmethod
    def from_body(cls, body: bytes) -> DeviceInfo:
        """Return the device of a message of type ``RTM_NEWLINK`` or ``RTM_DELLINK``."""
        family, _, ifindex, flags, _ = _INFO.unpack_from(body)
        return cls(family, ifindex, flags, nested(body[_INFO.size :]))

    def text(self, kind: LinkAttribute) -> str:
        """Return an attribute as text; empty if it is missing."""
        return self.attributes.get(kind, b"").rstrip(b"\0").decode(errors="replace")

    def number(self, kind: LinkAttribute) -> int:
        """Return an attribute as a number; 0 if it is missing."""
        return int.from_bytes(self.attributes.get(kind, b""), sys.byteorder)


class RefusedError(LocalError):
    """The kernel replied with an error, of this ``errno``."""

    def __init__(self, number: int) -> None:
        super().__init__(f"netlink question: {os.strerror(number)}")
        self.number = number


class NetlinkSocket:
    """One socket for requests. For one thread at a time.

    Every request raises ``LocalError`` if the kernel refuses it or does not reply; an error never looks like an empty
    reply. The next request may follow all the same.

    Raises:
        LocalError: the socket cannot be opened.
    """

    def __init__(self) -> None:
        self._socket = _open(0)
        self._socket.settimeout(_FOREVER_S)
        self._sequence = 0
        self._has_leftovers = False

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def links(self) -> list[DeviceInfo]:
        """Return each device of the namespace."""
        return _devices(self.dump(Rtm.GETLINK, _INFO.pack(socket.AF_UNSPEC, 0, 0, 0, 0)))

    def link_named(self, ifname: str) -> DeviceInfo | None:
        """Return the device of this name; None if it does not exist."""
        body = _INFO.pack(socket.AF_UNSPEC, 0, 0, 0, 0) + attribute(LinkAttribute.IFNAME, ifname.encode() + b"\0")
        try:
            return next(iter(_devices(self.question(Rtm.GETLINK, body))), None)
        except RefusedError as error:
            if error.number in (errno.ENODEV, errno.ERANGE, errno.EINVAL):  # ERANGE, EINVAL: an invalid name
                return None
            raise

    def link(self, ifindex: int, namespace: int | None = None) -> dict[int, bytes]:
        """Return the attributes of one device; none if it does not exist.

        Args:
            namespace: another namespace that holds the device, by this namespace's number for it.
        """
        body = _INFO.pack(socket.AF_UNSPEC, 0, ifindex, 0, 0)
        if namespace is not None:
            body += attribute(LinkAttribute.TARGET_NETNSID, _SIGNED.pack(namespace))
        try:
            found = _devices(self.question(Rtm.GETLINK, body))
        except RefusedError as error:
            if error.number == errno.ENODEV:
                return {}
            raise
        return found[0].attributes if found else {}

    def change(self, kind: Rtm, body: bytes, flags: int = 0) -> None:
        """Send a request that changes something, and wait until the kernel has done so.

        Args:
            body: the bytes after the netlink header.

        Raises:
            RefusedError: the kernel refuses.
        """
        self._ask(kind, body, _NLM_F_ACK | flags)

    def question(self, kind: Rtm, body: bytes) -> list[Message]:
        """Return the reply to a request for one object.

        Raises:
            RefusedError: the kernel refuses, or there is no such object.
        """
        return self._ask(kind, body, 0)

    def dump(self, kind: Rtm, body: bytes) -> list[Message]:
        """Return the reply to a request for all objects. Raises ``RefusedError``: the kernel refuses."""
        return self._ask(kind, body, _NLM_F_DUMP)

    def queues(self) -> list[tuple[int, int, dict[int, bytes]]]:
        """Return ifindex, parent and attributes of every queueing discipline of the namespace."""
        found: list[tuple[int, int, dict[int, bytes]]] = []
        for kind, _, answer in self.dump(Rtm.GETQDISC, TRAFFIC.pack(socket.AF_UNSPEC, 0, 0, 0, 0)):
            if kind == Rtm.NEWQDISC:
                _, ifindex, _, parent, _ = TRAFFIC.unpack_from(answer)
                found.append((ifindex, parent, nested(answer[TRAFFIC.size :])))
        return found

    def filters(self, ifindex: int, parent: int) -> list[str]:
        """Return the filters at one location of a device, by the names of those that are programs; others have none.

        A filter's chain may be listed with it.
        """
        answers = self.dump(Rtm.GETTFILTER, TRAFFIC.pack(socket.AF_UNSPEC, ifindex, 0, parent, 0))
        return [_program_name(nested(body[TRAFFIC.size :])) for kind, _, body in answers if kind == Rtm.NEWTFILTER]

    def _ask(self, kind: int, body: bytes, flags: int) -> list[Message]:
        if self._has_leftovers:
            self._forget()
        self._sequence += 1
        header = _HEADER.pack(_HEADER.size + len(body), kind, _NLM_F_REQUEST | flags, self._sequence & 0xFFFFFFFF, 0)
        self._has_leftovers = True
        try:
            self._socket.send(header + body)
            answers = self._answers(is_dump=bool(flags))
        except OSError as error:
            raise LocalError(f"netlink question: {error}") from error
        self._has_leftovers = False
        return answers

    def _answers(self, *, is_dump: bool) -> list[Message]:
        answers: list[Message] = []
        while True:
            for message in messages(self._socket.recv(_READ_BYTES)):
                if message.sequence != self._sequence & 0xFFFFFFFF:
                    continue
                if message.kind in (_NLMSG_DONE, _NLMSG_ERROR):
                    number = _SIGNED.unpack_from(message.body)[0] if len(message.body) >= _SIGNED.size else 0
                    if number:
                        raise RefusedError(-number)
                    return answers
                answers.append(message)
            if answers and not is_dump:
                return answers

    def _forget(self) -> None:
        """Read the rest of a failed request: while its dump lasts, the kernel starts no other."""
        self._socket.setblocking(False)
        try:
            while True:
                self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            self._has_leftovers = False
        except OSError as error:
            raise LocalError(f"netlink question: {error}") from error
        finally:
            self._socket.settimeout(_FOREVER_S)


class Notifications:
    """What the kernel reports of these groups, such as ``LINK_GROUP``, until ``close``.

    Args:
        buffer_bytes: space for unread ones; 0: the system's default.

    Raises:
        LocalError: the kernel opens no such socket.
    """

    def __init__(self, groups: int, buffer_bytes: int = 0) -> None:
        self._socket = _open(groups)
        self._socket.setblocking(False)
        if buffer_bytes:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)

    def fileno(self) -> int:
        """Return the descriptor to wait on; readable when there are notifications."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def read(self) -> tuple[list[bytes], bool]:
        """Return the datagrams that arrived since the last call, and whether the kernel skipped some."""
        datagrams, has_skipped = [], False
        while True:
            try:
                datagrams.append(self._socket.recv(_READ_BYTES))
            except BlockingIOError:
                return datagrams, has_skipped
            except OSError as error:  # ENOBUFS precedes older notifications that still wait
                if error.errno != errno.ENOBUFS:
                    raise
                has_skipped = True

    def has_news(self) -> bool:
        """Discard what arrived since the last call; return whether there was anything, read or skipped."""
        datagrams, has_skipped = self.read()
        return bool(datagrams) or has_skipped


def messages(data: bytes) -> Iterator[Message]:
    """Yield the messages of one datagram from the kernel."""
    at = 0
    while at + _HEADER.size <= len(data):
        length, kind, _, sequence, _ = _HEADER.unpack_from(data, at)
        yield Message(kind, sequence, data[at + _HEADER.size : at + length])
        at += max(length, _HEADER.size) + 3 & ~3


def nested(body: bytes) -> dict[int, bytes]:
    """Return attributes by type."""
    found: dict[int, bytes] = {}
    at = 0
    while at + _ATTRIBUTE.size <= len(body):
        length, kind = _ATTRIBUTE.unpack_from(body, at)
        found[kind & ~_NESTED] = body[at + _ATTRIBUTE.size : at + length]
        at += max(length, _ATTRIBUTE.size) + 3 & ~3
    return found


def attribute(kind: int, value: bytes) -> bytes:
    """Return an attribute with its padding; the value of a nested one is further attributes."""
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value + bytes(-len(value) % 4)


def _devices(answers: Iterable[Message]) -> list[DeviceInfo]:
    return [DeviceInfo.from_body(each.body) for each in answers if each.kind == Rtm.NEWLINK]


def _program_name(facts: dict[int, bytes]) -> str:
    if facts.get(_TCA_KIND, b"").rstrip(b"\0") != b"bpf":
        return ""
    return nested(facts.get(_TCA_OPTIONS, b"")).get(_TCA_BPF_NAME, b"").rstrip(b"\0").decode(errors="replace")


def _open(groups: int) -> socket.socket:
    try:
        opened = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE)
    except OSError as error:
        raise LocalError(f"netlink socket: {error}") from error
    try:
        opened.bind((0, groups))
    except OSError as error:
        opened.close()
        raise LocalError(f"netlink socket: {error}") from error
    return opened
