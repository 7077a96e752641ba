"""Netlink sockets: requests to the kernel about devices, queues and filters, and the parser of its messages.

I/O; every socket stays in the namespace that it was opened in. The parser is written by hand, because a switch on a
small machine should not carry a netlink library.
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
from collections.abc import Iterator
from enum import IntEnum
from typing import Final, NamedTuple

from gdp.errors import LocalError

__all__ = [
    "ADDRESS_GROUPS",
    "CLSACT_EGRESS",
    "CLSACT_INGRESS",
    "LINK_GROUP",
    "READ_BYTES",
    "ROOT",
    "RTM_DELLINK",
    "RTM_NEWLINK",
    "TRAFFIC_GROUP",
    "DeviceInfo",
    "LinkAttribute",
    "Message",
    "NetlinkSocket",
    "RefusedError",
    "attribute",
    "listen",
    "messages",
    "nested",
]

CLSACT_INGRESS: Final = 0xFFFFFFF2  # TC_H_MAKE(TC_H_CLSACT, TC_H_MIN_INGRESS)
CLSACT_EGRESS: Final = 0xFFFFFFF3
ROOT: Final = 0xFFFFFFFF
LINK_GROUP: Final = 1  # RTMGRP_LINK: devices that change
ADDRESS_GROUPS: Final = 0x10 | 0x40 | 0x100 | 0x400  # RTMGRP_IPV4_IFADDR, IPV4_ROUTE, IPV6_IFADDR, IPV6_ROUTE
TRAFFIC_GROUP: Final = 8  # RTMGRP_TC: queues and filters that change
READ_BYTES: Final = 1 << 16
RTM_NEWLINK, RTM_DELLINK = 16, 17

_HEADER: Final = struct.Struct("=IHHII")
_INFO: Final = struct.Struct("=BxHiII")
_TRAFFIC: Final = struct.Struct("=BxxxiIII")
_ATTRIBUTE: Final = struct.Struct("=HH")
_NUMBER: Final = struct.Struct("=i")
_NLMSG_ERROR, _NLMSG_DONE = 2, 3
_RTM_GETLINK: Final = 18
_RTM_NEWQDISC, _RTM_GETQDISC = 36, 38
_RTM_NEWTFILTER, _RTM_GETTFILTER = 44, 46
_NLM_F_REQUEST, _NLM_F_ACK, _NLM_F_DUMP = 0x1, 0x4, 0x300
_NESTED: Final = 0x8000  # NLA_F_NESTED
_TCA_KIND, _TCA_OPTIONS, _TCA_BPF_NAME = 1, 2, 7
_FOREVER_S: Final = 5.0  # the kernel replies at once; the limit only keeps a bug from blocking a node


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

    def links(self) -> list[Message]:
        """Return a message about each device of the namespace."""
        return self._ask(_RTM_GETLINK, _INFO.pack(socket.AF_UNSPEC, 0, 0, 0, 0), _NLM_F_DUMP)

    def link_named(self, ifname: str) -> list[Message]:
        """Return the message about the device of this name; none if it does not exist."""
        body = _INFO.pack(socket.AF_UNSPEC, 0, 0, 0, 0) + attribute(LinkAttribute.IFNAME, ifname.encode() + b"\0")
        try:
            return self._ask(_RTM_GETLINK, body, 0)
        except RefusedError as error:
            if error.number in (errno.ENODEV, errno.ERANGE, errno.EINVAL):  # ERANGE, EINVAL: an invalid name
                return []
            raise

    def link(self, ifindex: int, namespace: int | None = None) -> dict[int, bytes]:
        """Return the attributes of one device; none if it does not exist.

        Args:
            namespace: another namespace that holds the device, by this namespace's number for it.
        """
        body = _INFO.pack(socket.AF_UNSPEC, 0, ifindex, 0, 0)
        if namespace is not None:
            body += _ATTRIBUTE.pack(_ATTRIBUTE.size + _NUMBER.size, LinkAttribute.TARGET_NETNSID)
            body += _NUMBER.pack(namespace)
        try:
            answers = self._ask(_RTM_GETLINK, body, 0)
        except RefusedError as error:
            if error.number == errno.ENODEV:
                return {}
            raise
        found = (DeviceInfo.from_body(each.body).attributes for each in answers if each.kind == RTM_NEWLINK)
        return next(found, {})

    def change(self, kind: int, body: bytes, flags: int = 0) -> None:
        """Send a request that changes something, and wait until the kernel has done so.

        Args:
            kind: ``RTM_`` type of the message.
            body: the bytes after the netlink header.
            flags: ``NLM_F_`` flags in addition to those of every request.

        Raises:
            RefusedError: the kernel refuses.
        """
        self._ask(kind, body, _NLM_F_ACK | flags)

    def question(self, kind: int, body: bytes) -> list[Message]:
        """Return the reply to a request for one object.

        Raises:
            RefusedError: the kernel refuses, or there is no such object.
        """
        return self._ask(kind, body, 0)

    def dump(self, kind: int, body: bytes) -> list[Message]:
        """Return the reply to a request for all objects.

        Raises:
            RefusedError: the kernel refuses.
        """
        return self._ask(kind, body, _NLM_F_DUMP)

    def queues(self) -> list[tuple[int, int, dict[int, bytes]]]:
        """Return ifindex, parent and attributes of every queueing discipline of the namespace."""
        found: list[tuple[int, int, dict[int, bytes]]] = []
        for kind, _, answer in self._ask(_RTM_GETQDISC, _TRAFFIC.pack(socket.AF_UNSPEC, 0, 0, 0, 0), _NLM_F_DUMP):
            if kind == _RTM_NEWQDISC:
                _, ifindex, _, parent, _ = _TRAFFIC.unpack_from(answer)
                found.append((ifindex, parent, nested(answer[_TRAFFIC.size :])))
        return found

    def filters(self, ifindex: int, parent: int) -> list[str]:
        """Return the filters at one location of a device, by the names of those that are programs; others have none.

        A filter's chain may be listed with it.
        """
        question = _TRAFFIC.pack(socket.AF_UNSPEC, ifindex, 0, parent, 0)
        answers = self._ask(_RTM_GETTFILTER, question, _NLM_F_DUMP)
        return [_program_name(nested(body[_TRAFFIC.size :])) for kind, _, body in answers if kind == _RTM_NEWTFILTER]

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
            for message in messages(self._socket.recv(READ_BYTES)):
                if message.sequence != self._sequence & 0xFFFFFFFF:
                    continue
                if message.kind in (_NLMSG_DONE, _NLMSG_ERROR):
                    number = _NUMBER.unpack_from(message.body)[0] if len(message.body) >= _NUMBER.size else 0
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
                self._socket.recv(READ_BYTES)
        except BlockingIOError:
            self._has_leftovers = False
        except OSError as error:
            raise LocalError(f"netlink question: {error}") from error
        finally:
            self._socket.settimeout(_FOREVER_S)


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


def listen(groups: int) -> socket.socket:
    """Return a non-blocking socket that receives notifications of these groups, such as ``LINK_GROUP``.

    Raises:
        LocalError: the kernel opens no such socket.
    """
    opened = _open(groups)
    opened.setblocking(False)
    return opened


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
