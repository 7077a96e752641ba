"""Questions to the kernel about devices, their queues and filters: netlink by hand, as in ``gdp/ports/link.py``.

Place: I/O; a socket for each question, in the namespace of whoever asks.
Source: rtnetlink(7), netlink(7); ``struct nlmsghdr``, ``struct ifinfomsg`` and ``struct tcmsg`` in host byte order.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from typing import Final

__all__ = ["CLSACT_EGRESS", "ROOT", "LinkAttribute", "filters", "link", "listen", "nested", "queues"]

CLSACT_EGRESS: Final = 0xFFFFFFF3
ROOT: Final = 0xFFFFFFFF

_HEADER: Final = struct.Struct("=IHHII")
_INFO: Final = struct.Struct("=BxHiII")
_TRAFFIC: Final = struct.Struct("=BxxxiIII")
_ATTRIBUTE: Final = struct.Struct("=HH")
_RTMGRP_TC: Final = 8
_NLMSG_ERROR, _NLMSG_DONE = 2, 3
_RTM_NEWLINK, _RTM_GETLINK = 16, 18
_RTM_NEWQDISC, _RTM_GETQDISC = 36, 38
_RTM_NEWTFILTER, _RTM_GETTFILTER = 44, 46
_NLM_F_REQUEST, _NLM_F_DUMP = 0x1, 0x300
_NESTED: Final = 0x8000  # NLA_F_NESTED
_READ_BYTES: Final = 1 << 16
_FOREVER_S: Final = 5.0  # the kernel answers at once; this only keeps a bug from hanging a node


class LinkAttribute:
    """Attributes of a device, as far as they are used."""

    QDISC: Final = 6
    LINKINFO: Final = 18
    STATS64: Final = 23
    LINK_NETNSID: Final = 37


def link(ifindex: int) -> dict[int, bytes]:
    """Return the attributes of one device; none where there is no such device."""
    body = _INFO.pack(socket.AF_UNSPEC, 0, ifindex, 0, 0)
    for kind, answer in _ask(_RTM_GETLINK, body, 0):
        if kind == _RTM_NEWLINK:
            return nested(answer[_INFO.size :])
    return {}


def queues() -> Iterator[tuple[int, int, dict[int, bytes]]]:
    """Yield ifindex, parent and attributes of every queueing discipline of this namespace."""
    for kind, answer in _ask(_RTM_GETQDISC, _TRAFFIC.pack(socket.AF_UNSPEC, 0, 0, 0, 0), _NLM_F_DUMP):
        if kind == _RTM_NEWQDISC:
            _, ifindex, _, parent, _ = _TRAFFIC.unpack_from(answer)
            yield ifindex, parent, nested(answer[_TRAFFIC.size :])


def filters(ifindex: int, parent: int) -> int:
    """Return how many filters stand at one place of a device."""
    question = _TRAFFIC.pack(socket.AF_UNSPEC, ifindex, 0, parent, 0)
    return [kind for kind, _ in _ask(_RTM_GETTFILTER, question, _NLM_F_DUMP)].count(_RTM_NEWTFILTER)


def nested(body: bytes) -> dict[int, bytes]:
    """Return attributes by type."""
    found: dict[int, bytes] = {}
    at = 0
    while at + _ATTRIBUTE.size <= len(body):
        length, kind = _ATTRIBUTE.unpack_from(body, at)
        found[kind & ~_NESTED] = body[at + _ATTRIBUTE.size : at + length]
        at += max(length, _ATTRIBUTE.size) + 3 & ~3
    return found


def listen() -> socket.socket:
    """Return a socket that hears of queues and filters that change; never blocking."""
    opened = _open(_RTMGRP_TC)
    opened.setblocking(False)
    return opened


def _ask(kind: int, body: bytes, flags: int) -> list[tuple[int, bytes]]:
    answers: list[tuple[int, bytes]] = []
    with _open(0) as question:
        question.settimeout(_FOREVER_S)
        question.send(_HEADER.pack(_HEADER.size + len(body), kind, _NLM_F_REQUEST | flags, 1, 0) + body)
        while True:
            for answer, content in _messages(question.recv(_READ_BYTES)):
                if answer in (_NLMSG_DONE, _NLMSG_ERROR):
                    return answers
                answers.append((answer, content))
            if not flags:
                return answers


def _open(groups: int) -> socket.socket:
    opened = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE)
    opened.bind((0, groups))
    return opened


def _messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + _HEADER.size <= len(data):
        length, kind, *_ = _HEADER.unpack_from(data, at)
        yield kind, data[at + _HEADER.size : at + length]
        at += max(length, _HEADER.size) + 3 & ~3
