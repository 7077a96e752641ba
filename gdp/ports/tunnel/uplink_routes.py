"""Routes of one uplink: packets with its mark leave through its device, or not at all.

I/O; policy routing of rtnetlink(7), ip-rule(8). WireGuard binds its socket to no device, but marks its packets::

    rule  5000  fwmark M  lookup table M      copies of the main table's routes through the device
    rule  5001  fwmark M  unreachable         the device is away or has no address: no other uplink is used

Everything here has the routing protocol 71. ``M`` follows from the name of the tunnel device. So a start recognises
what a dead run of the same switch left, and removes it. The table follows the routes of the uplink.

Answers come in at a device that may not be the one of the default route. A strict reverse-path filter (``rp_filter`` 1,
RFC 3704) drops them; ``warning`` reports it. ``src_valid_mark`` does not help, because incoming packets have no mark.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import socket
import struct
import sys
from collections.abc import Iterable
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Final, NamedTuple

from gdp.errors import LocalError
from gdp.ports.netlink import (
    ADDRESS_GROUPS,
    LINK_GROUP,
    NUMBER,
    ROUTE,
    ROUTE_GROUPS,
    Change,
    NetlinkSocket,
    Notifications,
    RefusedError,
    Rtm,
    attribute,
    nested,
)
from gdp.ports.tunnel.devices import refusal_text

log = logging.getLogger(__name__)

PROTOCOL: Final = 71  # of routes and rules; free in iproute2's rt_protos
_GROUPS: Final = LINK_GROUP | ADDRESS_GROUPS | ROUTE_GROUPS | 0x80 | 1 << 18  # RTMGRP_IPV4_RULE; IPV6_RULE is 19
_PRIORITY: Final = 5_000
# above the tables of the system; with bit 0x10000 it is no mark of Tailscale, 0x40000 or 0x80000 of 0xff0000
_MARK: Final = 0x40010000
_MARK_BITS: Final = 0x3FFE1FFF  # follow from the name; the bits of Kubernetes (0xc000) and CNI (0x2000) stay 0

_NEXT_HOP: Final = struct.Struct("=HBBi")
_TABLE_MAIN: Final = 254
_UNICAST: Final = 1
_ONLINK: Final = 4  # RTNH_F_ONLINK
_CLONED: Final = 0x200  # RTM_F_CLONED
_TO_TABLE, _UNREACHABLE = 1, 7  # FR_ACT_TO_TBL, FR_ACT_UNREACHABLE
_FRA_PRIORITY, _FRA_FWMARK, _FRA_TABLE, _FRA_FWMASK, _FRA_PROTOCOL = 6, 10, 15, 16, 21
_RTA_DST, _RTA_OIF, _RTA_GATEWAY, _RTA_PRIORITY, _RTA_PREFSRC = 1, 4, 5, 6, 7
_RTA_METRICS, _RTA_MULTIPATH, _RTA_TABLE, _RTA_VIA, _RTA_PREF = 8, 9, 15, 18, 20
_COPIED: Final = (_RTA_DST, _RTA_GATEWAY, _RTA_PRIORITY, _RTA_PREFSRC, _RTA_METRICS, _RTA_VIA, _RTA_PREF)
_FAMILIES: Final = (socket.AF_INET, socket.AF_INET6)
_NO_FAMILY: Final = (errno.EAFNOSUPPORT, errno.EOPNOTSUPP)
_GONE: Final = (errno.ESRCH, errno.ENOENT, errno.ENODEV)
_SETTINGS: Final = Path("/proc/sys/net/ipv4/conf")
_STRICT: Final = 1


class _Route(NamedTuple):
    """A unicast route, apart from its table and protocol."""

    family: int
    ifindex: int
    length: int
    tos: int
    scope: int
    flags: int
    attributes: tuple[tuple[int, bytes], ...]

    @property
    def has_gateway(self) -> bool:
        """Return whether it needs another route first."""
        return any(kind in (_RTA_GATEWAY, _RTA_VIA) for kind, _ in self.attributes)

    def body(self, table: int) -> bytes:
        """Return the bytes of a request after the netlink header."""
        head = ROUTE.pack(self.family, self.length, 0, self.tos, 0, PROTOCOL, self.scope, _UNICAST, self.flags)
        named = attribute(_RTA_TABLE, NUMBER.pack(table)) + attribute(_RTA_OIF, NUMBER.pack(self.ifindex))
        return head + named + b"".join(attribute(kind, value) for kind, value in self.attributes)


def mark_of(ifname: str) -> int:
    """Return the mark of the packets of the tunnel device with this name, which is also the number of its table."""
    digest = hashlib.sha256(b"gdp-uplink" + ifname.encode()).digest()
    return _MARK | int.from_bytes(digest[:4], "big") & _MARK_BITS


def remove_leftovers(marks: Iterable[int]) -> None:
    """Remove the rules and routes of marks that no running switch uses. Raises ``LocalError``: the kernel refuses."""
    with closing(NetlinkSocket()) as netlink:
        for mark in marks:
            _remove_all(netlink, mark)


class UplinkRoutes:
    """Rules and table of one uplink until ``close``. For one thread; the switch's lock keeps a second run away.

    Args:
        uplink: device that marked packets leave by; it may be absent for a time.
        mark: of the packets, and number of the table.

    Raises:
        LocalError: another program uses the table, the kernel has no policy routing, or this user may not change
            routes. Nothing is left then.
    """

    def __init__(self, uplink: str, mark: int) -> None:
        self._uplink = uplink
        self._mark = mark
        with ExitStack() as opened:
            self._netlink = NetlinkSocket()
            opened.callback(self._netlink.close)
            self._news = opened.enter_context(closing(Notifications(_GROUPS)))
            _remove_all(self._netlink, mark)
            opened.callback(_remove_all, self._netlink, mark)
            if any(_routes(self._netlink, family, mark) for family in _FAMILIES):
                raise LocalError(f"uplink {uplink}: another program uses the routing table {mark}")
            self.sync()
            if not _rules(self._netlink, socket.AF_INET, mark):
                raise LocalError("this kernel has no policy routing (ip rule), which uplinks need")
            self._opened = opened.pop_all()

    def fileno(self) -> int:
        """Return a descriptor that is readable when ``sync`` may have work."""
        return self._news.fileno()

    @property
    def warning(self) -> str:
        """Return why packets of this uplink may be lost, and what to do; empty if nothing is known."""
        modes = []
        for scope in ("all", self._uplink):
            with suppress(OSError, ValueError):  # no IPv4, or no such device now
                modes.append(int((_SETTINGS / scope / "rp_filter").read_text(encoding="ascii")))
        if max(modes, default=0) != _STRICT:
            return ""
        return (
            f"{self._uplink}: its strict reverse-path filter drops answers while another uplink has the default route;"
            f" loosen it with: sysctl -w net.ipv4.conf.{self._uplink}.rp_filter=2"
        )

    def sync(self) -> None:
        """Make rules and table as they should be; a change that is refused now is tried again at the next event.

        Raises:
            LocalError: this user may not change routes, or the kernel does not answer.
        """
        self._news.has_news()
        try:
            device = self._netlink.link_named(self._uplink)
            ifindex = 0 if device is None else device.ifindex
            for family in _FAMILIES:
                self._reconcile_rules(family)
                wanted = _routes(self._netlink, family, _TABLE_MAIN, ifindex) if ifindex else []
                present = _routes(self._netlink, family, self._mark)
                for route in sorted(set(present) - set(wanted), key=_gateways_first):
                    self._change(Rtm.DELROUTE, route.body(self._mark))
                for route in sorted(set(wanted) - set(present), key=_gateways_first, reverse=True):
                    self._change(Rtm.NEWROUTE, route.body(self._mark), Change.CREATE | Change.EXCLUSIVE)
        except RefusedError as error:
            raise LocalError(f"uplink {self._uplink}: rules of routing: {refusal_text(error)}") from error

    def close(self) -> None:
        """Remove the rules, the routes and both sockets."""
        self._opened.close()

    def _reconcile_rules(self, family: int) -> None:
        wanted = {_rule(family, self._mark, action) for action in (_TO_TABLE, _UNREACHABLE)}
        for rule in wanted - set(_rules(self._netlink, family, self._mark)):
            try:
                self._netlink.change(Rtm.NEWRULE, rule, Change.CREATE | Change.EXCLUSIVE)
            except RefusedError as error:
                if error.number not in (errno.EEXIST, *_NO_FAMILY):
                    raise

    def _change(self, kind: Rtm, body: bytes, flags: int = 0) -> None:
        """Add or remove a route. A refusal is a race with another change, of which an event follows."""
        try:
            self._netlink.change(kind, body, flags)
        except RefusedError as error:
            if error.number in (errno.EPERM, errno.EACCES):
                raise
            log.debug("route not changed uplink=%s kind=%d reason=%s", self._uplink, kind, os.strerror(error.number))


def _gateways_first(route: _Route) -> tuple[bool, _Route]:
    return not route.has_gateway, route


def _remove_all(netlink: NetlinkSocket, mark: int) -> None:
    """Remove the rules of a mark, then the routes of its table, as far as they are ours."""
    try:
        for family in _FAMILIES:
            for rule in _rules(netlink, family, mark):
                _change_unless_gone(netlink, Rtm.DELRULE, rule)
            for route in sorted(_routes(netlink, family, mark, protocol=PROTOCOL), key=_gateways_first):
                _change_unless_gone(netlink, Rtm.DELROUTE, route.body(mark))
    except RefusedError as error:
        raise LocalError(f"rules of routing of an uplink: {refusal_text(error)}") from error


def _change_unless_gone(netlink: NetlinkSocket, kind: Rtm, body: bytes) -> None:
    try:
        netlink.change(kind, body)
    except RefusedError as error:
        if error.number not in _GONE:
            raise


def _rule(family: int, mark: int, action: int) -> bytes:
    """Return the body of a request about one of our rules."""
    priority = _PRIORITY + (action == _UNREACHABLE)
    body = ROUTE.pack(family, 0, 0, 0, 0, 0, 0, action, 0) + attribute(_FRA_PRIORITY, NUMBER.pack(priority))
    body += attribute(_FRA_FWMARK, NUMBER.pack(mark)) + attribute(_FRA_FWMASK, NUMBER.pack(0xFFFFFFFF))
    body += attribute(_FRA_PROTOCOL, bytes([PROTOCOL]))
    return body + (attribute(_FRA_TABLE, NUMBER.pack(mark)) if action == _TO_TABLE else b"")


def _rules(netlink: NetlinkSocket, family: int, mark: int) -> list[bytes]:
    """Return the present ones of our two rules of a mark."""
    try:
        found = netlink.dump(Rtm.GETRULE, ROUTE.pack(family, 0, 0, 0, 0, 0, 0, 0, 0))
    except RefusedError as error:
        if error.number in _NO_FAMILY:
            return []
        raise
    rules = []
    for message in found:
        if message.kind != Rtm.NEWRULE:
            continue
        values, action = nested(message.body[ROUTE.size :]), ROUTE.unpack_from(message.body)[7]
        is_ours = values.get(_FRA_PROTOCOL) == bytes([PROTOCOL]) and _number(values, _FRA_FWMARK) == mark
        is_ours = is_ours and _number(values, _FRA_PRIORITY) == _PRIORITY + (action == _UNREACHABLE)
        if is_ours and (action == _UNREACHABLE or _number(values, _FRA_TABLE) == mark):
            rules.append(_rule(family, mark, action))
    return rules


def _routes(
    netlink: NetlinkSocket, family: int, table: int, ifindex: int | None = None, protocol: int | None = None
) -> list[_Route]:
    """Return the unicast routes of a table, through one device or any, of one protocol or any."""
    try:
        found = netlink.dump(Rtm.GETROUTE, ROUTE.pack(family, 0, 0, 0, 0, 0, 0, 0, 0))
    except RefusedError as error:
        if error.number in _NO_FAMILY:
            return []
        raise
    routes = []
    for message in found:
        if message.kind != Rtm.NEWROUTE:
            continue
        _, length, _, tos, short, its_protocol, scope, type_, flags = ROUTE.unpack_from(message.body)
        values = nested(message.body[ROUTE.size :])
        is_wanted = type_ == _UNICAST and not flags & _CLONED and protocol in (None, its_protocol)
        if not is_wanted or (_number(values, _RTA_TABLE) or short) != table:
            continue
        for hop, hop_flags in _hops(values, flags):
            device = _number(hop, _RTA_OIF)
            if ifindex in (None, device):
                copied = tuple((kind, hop[kind]) for kind in _COPIED if kind in hop)
                routes.append(_Route(family, device, length, tos, scope, hop_flags & _ONLINK, copied))
    return routes


def _hops(values: dict[int, bytes], flags: int) -> list[tuple[dict[int, bytes], int]]:
    """Return a route's attributes and flags once for each device: the first hop of several through one counts."""
    data = values.get(_RTA_MULTIPATH)
    if data is None:
        return [(values, flags)]
    found: dict[int, tuple[dict[int, bytes], int]] = {}
    at = 0
    while at + _NEXT_HOP.size <= len(data):
        length, hop_flags, _, ifindex = _NEXT_HOP.unpack_from(data, at)
        own = nested(data[at + _NEXT_HOP.size : at + length])
        found.setdefault(ifindex, ({**values, **own, _RTA_OIF: NUMBER.pack(ifindex)}, hop_flags))
        at += max(length, _NEXT_HOP.size) + 3 & ~3
    return list(found.values())


def _number(values: dict[int, bytes], kind: int) -> int:
    return int.from_bytes(values.get(kind, b""), sys.byteorder)
